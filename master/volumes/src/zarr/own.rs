//! Attribute `slabcast` of the OME-Zarr files that slabcast writes: facts that OME-Zarr can't hold.
//!
//! OME-Zarr has a scale and a translation along each axis, but neither directions nor slope and
//! intercept. The attribute has them, so that a converted volume is read back unchanged. Other
//! programs ignore it.

use super::json::{Json, path};
use crate::error::Problem;
use crate::source::Folder;
use glam::DVec3;
use serde_json::{Value, json};
use slabcast_common::volume::{Lattice, ValueMap};

/// Version of the attribute.
const VERSION: u64 = 1;

/// The attribute of a pyramid.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Own {
    /// Number type of the samples in the file that was converted, for people.
    pub(crate) file_type: String,
    pub(crate) anatomical: bool,
    /// Map from numbers to values, if it is not the identity.
    pub(crate) rescale: Option<ValueMap>,
    pub(crate) steps: [DVec3; 3],
    pub(crate) origin: DVec3,
}

/// Returns the error for a field of the attribute.
pub(super) fn bad(field: &str, what: &str) -> Problem {
    let remedy = "convert the volume again, or remove the attribute";
    Problem::malformed(format!("attributes slabcast {field}"), what, remedy)
}

impl Own {
    /// Reads the attribute of a group of Zarr 3; `None` if it has none.
    pub(super) fn read(root: &Folder, group: &str) -> Result<Option<Own>, Problem> {
        if !root.has(&path(group, "zarr.json")) {
            return Ok(None);
        }
        let meta = Json::read(root, group, "zarr.json")?;
        let Some(own) = meta.get("attributes").and_then(|a| a.get("slabcast")) else {
            return Ok(None);
        };
        let version = own.required("version")?;
        if version.value != VERSION {
            return Err(Problem::unsupported(
                "attributes slabcast version",
                format!("is {}, and {VERSION} is read", version.value),
                "read it with a newer slabcast",
            ));
        }
        let vector = |json: &Json| Ok::<_, Problem>(DVec3::from_slice(&json.numbers(3)?));
        let steps = own.required("steps")?;
        if steps.len() != 3 {
            return Err(steps.bad("three vectors"));
        }
        let number = |json: Option<Json>| {
            json.ok_or_else(|| bad("rescale", "has no slope or intercept"))?
                .value
                .as_f64()
                .ok_or_else(|| bad("rescale", "has a slope or intercept that is no number"))
        };
        let rescale = match own.get("rescale") {
            None => None,
            Some(map) => Some(ValueMap {
                scale: number(map.get("scale"))?,
                offset: number(map.get("offset"))?,
            }),
        };
        Ok(Some(Own {
            file_type: own.required("file_type")?.text()?.chars().take(60).collect(),
            anatomical: own.required("anatomical")?.value == true,
            rescale,
            steps: [vector(&steps.entry(0))?, vector(&steps.entry(1))?, vector(&steps.entry(2))?],
            origin: vector(&own.required("origin")?)?,
        }))
    }

    /// Returns the attribute's value as JSON.
    pub(crate) fn to_json(&self) -> Value {
        let mut own = json!({
            "version": VERSION,
            "file_type": self.file_type,
            "anatomical": self.anatomical,
            "steps": self.steps.map(|s| s.to_array()),
            "origin": self.origin.to_array(),
        });
        if let Some(map) = self.rescale {
            own["rescale"] = json!({"scale": map.scale, "offset": map.offset});
        }
        own
    }

    /// Returns the lattice of a level with the directions of the attribute. `placed` is the level's
    /// lattice from the format's metadata.
    ///
    /// # Errors
    /// The spacings of attribute and metadata differ.
    pub(super) fn lattice(&self, level: usize, placed: Lattice) -> Result<Lattice, Problem> {
        // Level 0's number of samples is not needed: steps and origin of a level do not depend on
        // it.
        let mut lattice = Lattice { dims: placed.dims, steps: self.steps, origin: self.origin };
        let wanted = placed.spacing();
        for _ in 0..level {
            // Axes are halved as long as the format's metadata say so.
            let near = |a: usize| wanted[a] > 1.5 * lattice.spacing()[a];
            let halved = [near(0), near(1), near(2)];
            for a in (0..3).filter(|&a| halved[a]) {
                lattice.steps[a] *= 2.0;
                lattice.origin += lattice.steps[a] * 0.25;
            }
        }
        let spacing = lattice.spacing();
        let same = |a: usize| (spacing[a] - wanted[a]).abs() <= 1e-6 * wanted[a].abs();
        match (0..3).all(same) {
            true => Ok(lattice),
            false => Err(bad("steps", "differ in length from the scale of the picture")),
        }
    }
}
