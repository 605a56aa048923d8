//! Imaris (.ims): `DataSet/ResolutionLevel 0/TimePoint T/Channel C/Data`, whose blocks are padded, and
//! the box of the whole in `DataSetInfo/Image`.

use super::axes::{Axis, Role};
use super::file::{self, Tree};
use crate::error::{Problem, quoted};
use crate::pick::{self, Kind, Pick};
use crate::samples::DIM_MAX;
use crate::units::Step;

const FINEST: &str = "DataSet/ResolutionLevel 0";

/// Extents and unit of an Imaris picture, from its attributes.
pub(super) struct Imaris {
    /// Least and greatest coordinate along x, y and z.
    extents: [[f64; 2]; 3],
    unit: Option<String>,
}

/// Returns whether a path is one of the samples of Imaris.
pub(super) fn is_data(path: &str) -> bool {
    path.starts_with("DataSet/ResolutionLevel ") && path.ends_with("/Data")
}

fn malformed(field: &str, what: impl Into<String>) -> Problem {
    Problem::malformed(field, what, "get the file again, or save it with Imaris once more")
}

impl Imaris {
    /// Reads what an Imaris file says; `None` of another file.
    pub(super) fn of(tree: &Tree) -> Result<Option<Imaris>, Problem> {
        let (Some(image), Some(_)) = (tree.group("DataSetInfo/Image"), tree.group(FINEST)) else {
            return Ok(None);
        };
        let attributes =
            image.attributes().map_err(|e| file::problem("`DataSetInfo/Image`", &e))?;
        let number = |name: String| {
            let text = file::text(&attributes, &name);
            let number = text.as_ref().and_then(|t| t.parse().ok()).filter(|x: &f64| x.is_finite());
            number.ok_or_else(|| malformed(&name, "is no number"))
        };
        let mut extents = [[0.0; 2]; 3];
        for (i, extent) in extents.iter_mut().enumerate() {
            *extent = [number(format!("ExtMin{i}"))?, number(format!("ExtMax{i}"))?];
        }
        Ok(Some(Imaris { extents, unit: file::text(&attributes, "Unit") }))
    }

    /// Returns the path of the samples of a time and a channel, at the finest level.
    pub(super) fn choose(
        &self,
        tree: &Tree,
        pick: Pick,
        notes: &mut Vec<String>,
    ) -> Result<String, Problem> {
        let count = |path: &str, word: &str| -> Result<u64, Problem> {
            let Some(group) = tree.group(path) else {
                return Err(malformed(&quoted(path), "is not there"));
            };
            let (groups, _) = group.member_names().map_err(|e| file::problem(&quoted(path), &e))?;
            Ok(groups.iter().filter(|name| name.starts_with(word)).count() as u64)
        };
        let times = count(FINEST, "TimePoint ")?;
        let channels = count(&format!("{FINEST}/TimePoint 0"), "Channel ")?;
        let axes = [
            pick::Axis::new(Kind::Channel, "channels", channels),
            pick::Axis::new(Kind::Time, "times", times),
        ];
        let (at, said) = pick.choose(&axes, "DataSet")?;
        notes.extend(said);
        Ok(format!("{FINEST}/TimePoint {}/Channel {}/Data", at[1], at[0]))
    }

    /// Gives the axes of samples at a path their sizes without padding, and their places.
    pub(super) fn place(&self, tree: &Tree, path: &str, axes: &mut [Axis]) -> Result<(), Problem> {
        let [z, y, x] = axes else {
            return Err(malformed(&quoted(path), format!("has {} axes, not three", axes.len())));
        };
        let folder = path.trim_end_matches("/Data");
        let attributes = tree.group(folder).and_then(|g| g.attributes().ok()).unwrap_or_default();
        for (i, (axis, name)) in [(x, "X"), (y, "Y"), (z, "Z")].into_iter().enumerate() {
            let field = format!("ImageSize{name}");
            let size = match file::text(&attributes, &field) {
                // Old files have no padding.
                None => axis.size,
                Some(text) => text
                    .parse()
                    .ok()
                    .filter(|n| (1..=axis.size.min(DIM_MAX)).contains(n))
                    .ok_or_else(|| malformed(&field, format!("{} fits no data", quoted(&text))))?,
            };
            let [from, to] = self.extents[i];
            let step = (to - from) / size as f64;
            if !(step.is_finite() && step != 0.0) {
                return Err(malformed(&format!("ExtMax{i}"), format!("{to:?} after {from:?}")));
            }
            axis.size = size;
            axis.role = Role::Space(i);
            axis.step = Step { number: Some(step.abs()), unit: self.unit.clone() };
            axis.falls = step < 0.0;
            // The box is that of the voxels, not of their middles.
            axis.start = from + step / 2.0;
        }
        Ok(())
    }
}
