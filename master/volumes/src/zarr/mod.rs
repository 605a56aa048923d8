//! Zarr arrays (versions 2 and 3, with shards) and OME-Zarr pyramids, from a folder.
//!
//! An array is decoded chunk by chunk straight to its place in the volume; a shard's index is
//! read first, and then one inner chunk after another. Of a pyramid the finest level is taken
//! that fits the memory it may have.
//!
//! The reader is our own, since a volume needs a corner of the format (regular grids, five
//! codecs), and the `zarrs` crate adds 75 crates to build, one of them with an advisory (`lru`).
//! zstd and lz4 are by `ruzstd` and `lz4_flex`, both in Rust.

mod array;
mod blosc;
mod codec;
mod json;

use crate::error::{OpenErrorKind, Problem, quoted};
use crate::{Hints, Opened};
use array::Array;
use json::{Json, path_in};
use serde_json::Value;
use slabcast_common::volume::{Lattice, Volume};
use std::path::Path;

/// Whether a folder is a Zarr node.
pub(crate) fn is_node(folder: &Path) -> bool {
    ["zarr.json", ".zarray", ".zgroup", ".zattrs"].iter().any(|f| folder.join(f).is_file())
}

/// Opens the array or the pyramid that a folder is.
pub(crate) fn open(folder: &Path, hints: &Hints) -> Result<Opened, Problem> {
    let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut notes = Vec::new();
    if array::is_array(folder) {
        let array = Array::open(folder)?;
        let placed = Placed::bare(&array)?;
        // Chunks may be missing, so that no size of files bounds what an array asks for.
        let budget = hints.max_bytes.unwrap_or_else(|| free_memory() / 4 * 3);
        if placed.bytes(&array) > budget {
            return Err(Problem::new(
                OpenErrorKind::TooLarge,
                "shape",
                format!("{:?} takes more than {} MiB", array.shape, budget >> 20),
                "give more with --max-bytes, or use a machine with more memory",
            ));
        }
        return read(array, placed, &name, notes);
    }
    let mut group = folder.to_path_buf();
    let mut scales = multiscales(&group)?;
    // The layout of bioformats2raw: each picture in a numbered group of its own.
    if scales.is_none() && is_node(&folder.join("0")) && !array::is_array(&folder.join("0")) {
        group = folder.join("0");
        scales = multiscales(&group)?;
        notes.push("the first picture (0) of several was read".into());
    }
    let Some(scales) = scales else {
        return Err(Problem::unsupported(
            "multiscales",
            "is missing: this Zarr group is no OME-Zarr picture",
            "give the folder of an array in it",
        ));
    };
    if scales.len() == 0 {
        return Err(Problem::malformed("multiscales", "is empty", "give the folder of an array"));
    }
    let image = scales.at(0);
    let axes = Axes::of(&image)?;
    let levels = image.required("datasets")?;
    let count = levels.len();
    let open = |level: usize| -> Result<(Array, Placed), Problem> {
        let dataset = levels.at(level);
        let array = Array::open(&path_in(&group, dataset.required("path")?.text()?)?)?;
        let placed = axes.place(&array, &image, &dataset)?;
        Ok((array, placed))
    };
    let level = match hints.level {
        Some(level) if (level as usize) < count => level as usize,
        Some(level) => {
            return Err(Problem::malformed(
                "--level",
                format!("{level} is not there: the picture has {count} levels"),
                format!("give 0 (the finest) to {}", count.saturating_sub(1)),
            ));
        }
        None => {
            let budget = hints.max_bytes.unwrap_or_else(|| free_memory() / 4);
            let mut found = None;
            for level in 0..count {
                match open(level) {
                    Ok((array, placed)) if placed.bytes(&array) <= budget => {
                        found = Some(level);
                        break;
                    }
                    Ok(_) => {}
                    // Beyond our own limits, as the finest level of a large picture may well be.
                    Err(p) if p.kind == OpenErrorKind::TooLarge && level + 1 < count => {}
                    Err(p) => return Err(p),
                }
            }
            let Some(level) = found else {
                let shown = quoted(&name);
                return Err(Problem::new(
                    OpenErrorKind::TooLarge,
                    "datasets",
                    format!("no level of {shown} fits into {} MiB", budget >> 20),
                    "give more with --max-bytes, or a level with --level",
                ));
            };
            level
        }
    };
    let (array, placed) = open(level)?;
    if count > 1 {
        let [x, y, z] = placed.dims;
        notes.push(format!(
            "level {level} of 0 to {} was read ({x} x {y} x {z}); see --level and --max-bytes",
            count - 1
        ));
    }
    read(array, placed, &name, notes)
}

/// Where the machine does not say how much memory it has free.
const BUDGET_BYTES: u64 = 4 << 30;

/// Memory that is free. A pyramid may take a quarter: bricks, encoded bricks and frames need
/// theirs too.
fn free_memory() -> u64 {
    let text = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let line = text.lines().find(|l| l.starts_with("MemAvailable:"));
    let kib = line.and_then(|l| l.split_ascii_whitespace().nth(1)?.parse::<u64>().ok());
    kib.map_or(BUDGET_BYTES, |kib| kib * 1024)
}

fn read(
    array: Array,
    placed: Placed,
    name: &str,
    mut notes: Vec<String>,
) -> Result<Opened, Problem> {
    let lattice = Lattice {
        origin: glam::DVec3::from_array(placed.origin),
        ..Lattice::from_spacing(placed.dims.map(|n| n as u32), placed.spacing)
    };
    notes.extend(placed.notes.iter().cloned());
    let (samples, map) = array.read(&placed)?;
    lattice
        .check()
        .map_err(|e| Problem::malformed("coordinateTransformations", e, "correct the scale"))?;
    let file_type = array.number.name();
    let volume = Volume::new(name, file_type, false, lattice, samples, map);
    Ok(Opened { volume, notes })
}

/// The list of pictures of a group, if it has one.
fn multiscales(group: &Path) -> Result<Option<Json>, Problem> {
    let v3 = group.join("zarr.json");
    if v3.is_file() {
        let meta = Json::read(&v3)?;
        let attributes = meta.get("attributes");
        let ome = attributes.as_ref().and_then(|a| a.get("ome"));
        return Ok(ome
            .and_then(|o| o.get("multiscales"))
            .or_else(|| attributes?.get("multiscales")));
    }
    let v2 = group.join(".zattrs");
    if v2.is_file() {
        return Ok(Json::read(&v2)?.get("multiscales"));
    }
    Ok(None)
}

/// Which axes of an array are x, y and z, and where its samples lie.
pub(crate) struct Placed {
    /// Sizes along x, y, z.
    pub(crate) dims: [u64; 3],
    /// The array's axis for each of them; none has one sample.
    pub(crate) axes: [Option<usize>; 3],
    spacing: [f64; 3],
    origin: [f64; 3],
    notes: Vec<String>,
}

impl Placed {
    /// The last three axes are z, y, x.
    fn bare(array: &Array) -> Result<Placed, Problem> {
        let rank = array.shape.len();
        let axes = [1, 2, 3].map(|back| rank.checked_sub(back));
        Placed::new(array, axes, [1.0; 3], [0.0; 3], |_| None)
    }

    fn new(
        array: &Array,
        axes: [Option<usize>; 3],
        spacing: [f64; 3],
        origin: [f64; 3],
        name: impl Fn(usize) -> Option<String>,
    ) -> Result<Placed, Problem> {
        let mut notes = Vec::new();
        for (a, &n) in array.shape.iter().enumerate() {
            if n > 1 && !axes.contains(&Some(a)) {
                let name = name(a).unwrap_or_else(|| format!("axis {a}"));
                notes.push(format!("the first of {n} along {name} was read"));
            }
        }
        let dims = axes.map(|a| a.map_or(1, |a| array.shape[a]));
        // Before anything is counted in bytes.
        crate::samples::Layout::new(dims, array.number, array.endian, "shape")?;
        Ok(Placed { dims, axes, spacing, origin, notes })
    }

    /// Bytes of the samples in the file's type.
    fn bytes(&self, array: &Array) -> u64 {
        self.dims.iter().product::<u64>() * array.number.bytes()
    }
}

/// The axes of a picture.
struct Axes {
    names: Vec<String>,
    /// Millimetres of an axis's unit.
    mm: Vec<f64>,
}

impl Axes {
    fn of(image: &Json) -> Result<Axes, Problem> {
        let mut axes = Axes { names: Vec::new(), mm: Vec::new() };
        let list = image.get("axes");
        let count = list.as_ref().map_or(0, Json::len);
        // Before version 0.4 axes were words, and before 0.3 always these.
        if count == 0 {
            axes.names = ["t", "c", "z", "y", "x"].map(String::from).to_vec();
            axes.mm = vec![1.0; 5];
        }
        for i in 0..count {
            let axis = list.as_ref().expect("it has entries").at(i);
            let (name, unit) = match &axis.value {
                Value::String(name) => (name.clone(), None),
                _ => (
                    axis.required("name")?.text()?.to_string(),
                    axis.get("unit").and_then(|u| u.value.as_str().map(String::from)),
                ),
            };
            axes.names.push(name.to_lowercase());
            axes.mm.push(match unit.as_deref() {
                Some("meter") => 1000.0,
                Some("centimeter") => 10.0,
                Some("micrometer") => 1e-3,
                Some("nanometer") => 1e-6,
                _ => 1.0,
            });
        }
        Ok(axes)
    }

    /// Where a level's samples lie: its own scale and translation, then the picture's.
    fn place(&self, array: &Array, image: &Json, dataset: &Json) -> Result<Placed, Problem> {
        let rank = array.shape.len();
        if self.names.len() != rank {
            return Err(Problem::malformed(
                "axes",
                format!("has {} entries for an array of {rank} axes", self.names.len()),
                "correct the picture's metadata",
            ));
        }
        let axes = ["x", "y", "z"].map(|name| self.names.iter().position(|n| n == name));
        if axes[0].is_none() || axes[1].is_none() {
            return Err(Problem::unsupported(
                "axes",
                format!("{} has no x and y", quoted(&self.names.join(", "))),
                "give the folder of an array",
            ));
        }
        let (mut scale, mut shift) = (vec![1.0; rank], vec![0.0; rank]);
        for owner in [dataset, image] {
            let Some(list) = owner.get("coordinateTransformations") else { continue };
            for i in 0..list.len() {
                let step = list.at(i);
                let numbers = |key: &str| step.get(key).map(|n| n.numbers(rank)).transpose();
                if let Some(by) = numbers("scale")? {
                    for a in 0..rank {
                        scale[a] *= by[a];
                        shift[a] *= by[a];
                    }
                }
                if let Some(by) = numbers("translation")? {
                    (0..rank).for_each(|a| shift[a] += by[a]);
                }
            }
        }
        let at = |list: &[f64], or: f64| axes.map(|a| a.map_or(or, |a| list[a] * self.mm[a]));
        Placed::new(array, axes, at(&scale, 1.0), at(&shift, 0.0), |a| {
            self.names.get(a).map(|n| quoted(n))
        })
    }
}

#[cfg(test)]
pub(crate) mod tests;
