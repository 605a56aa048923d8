//! NetCDF-4, and other files with scales of dimensions: coordinates and their units, and the attributes
//! by which stored numbers become values (the Climate and Forecast conventions).

use super::axes::{Axis, Role};
use super::file::{self, Tree};
use super::labels;
use super::number::Stored;
use super::stream::{Scale, Values, numbers_of};
use crate::error::{Problem, quoted};
use crate::samples::DIM_MAX;
use crate::units::Step;
use hdf5_reader::Dataset;

/// Beginning of `NAME` of a netCDF dimension without coordinates.
const NO_VARIABLE: &str = "This is a netCDF dimension but not a netCDF variable";
/// Most difference of two steps along an axis, as a part of the mean.
const UNEVEN: f64 = 1e-3;

/// Gives axes the places of their coordinates, where the dataset names them.
pub(super) fn place(
    tree: &Tree,
    dataset: &Dataset,
    axes: &mut [Axis],
    notes: &mut Vec<String>,
) -> Result<(), Problem> {
    let attributes = dataset.attributes();
    let Some(list) = file::find(&attributes, "DIMENSION_LIST") else { return Ok(()) };
    let bytes = dataset.vlen_reference_size();
    let all = tree.datasets()?;
    for (axis, reference) in axes.iter_mut().zip(list.raw_data.chunks_exact(bytes)) {
        let Some(address) = tree.first_reference(reference) else { continue };
        let Some((path, scale)) = all.iter().find(|(_, d)| d.address() == address) else {
            continue;
        };
        let name = path.rsplit('/').next().unwrap_or(path);
        if axis.role == Role::Unknown {
            axis.role = labels::role(name);
        }
        let about = scale.attributes();
        let is_bare = file::text(&about, "NAME").is_some_and(|n| n.starts_with(NO_VARIABLE));
        if is_bare || scale.shape() != [axis.size] || axis.size > DIM_MAX {
            continue;
        }
        if let Some(letter) = file::text(&about, "axis") {
            axis.role = labels::role(&letter);
        }
        let unit = file::text(&about, "units");
        if unit.as_ref().is_some_and(|u| u.contains(" since ")) {
            axis.role = Role::Time;
        }
        let Ok(coordinates) = numbers_of(scale, name) else { continue };
        let ([first, .., last], Role::Unknown | Role::Space(_)) = (&coordinates[..], axis.role)
        else {
            continue;
        };
        let step = (last - first) / (coordinates.len() as f64 - 1.0);
        if !(step.is_finite() && step != 0.0) {
            notes.push(format!("the coordinates of {} do not rise or fall", quoted(name)));
            continue;
        }
        let uneven = |w: &[f64]| (w[1] - w[0] - step).abs() > UNEVEN * step.abs();
        if coordinates.windows(2).any(uneven) {
            notes.push(format!(
                "the coordinates of {} are uneven, and are drawn as if they were even",
                quoted(name)
            ));
        }
        axis.step = Step { number: Some(step.abs()), unit };
        axis.falls = step < 0.0;
        axis.start = *first;
    }
    Ok(())
}

/// Returns how the stored numbers of a dataset become values, by its attributes.
pub(super) fn values(
    dataset: &Dataset,
    path: &str,
    notes: &mut Vec<String>,
) -> Result<Values, Problem> {
    let stored = Stored::of(dataset, path)?;
    let attributes = dataset.attributes();
    let mut values = Values::default();
    let scale = file::number(&attributes, "scale_factor");
    let offset = file::number(&attributes, "add_offset");
    if scale.is_some() || offset.is_some() {
        let scale = scale.unwrap_or(1.0);
        if !scale.is_normal() {
            return Err(Problem::malformed(
                "scale_factor",
                format!("is {scale:?}"),
                "correct it, or take it away",
            ));
        }
        values.scale = Scale::Whole([scale, offset.unwrap_or(0.0)]);
        notes.push("scale_factor and add_offset were applied".into());
    }
    let said = file::text(&attributes, "_Unsigned").map(|t| t.to_ascii_lowercase());
    values.unsigned = said.as_deref() == Some("true");
    let stored = values.stored(stored);
    for name in ["_FillValue", "missing_value"] {
        for fill in file::numbers(&attributes, name).unwrap_or_default() {
            let above = stored.number.limits().map_or(0.0, |(_, most)| most + 1.0);
            let fill = if values.unsigned && fill < 0.0 { fill + above } else { fill };
            if !values.fill.contains(&fill) && !fill.is_nan() {
                values.fill.push(fill);
            }
        }
    }
    if !values.fill.is_empty() {
        let kind = values.number(stored).name();
        let fills: Vec<String> = values.fill.iter().take(3).map(|f| format!("{f}")).collect();
        notes.push(format!(
            "places of the fill value {} have no value; the numbers became {kind}",
            fills.join(", ")
        ));
    }
    Ok(values)
}
