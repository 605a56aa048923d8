//! Axes from attributes of datasets: ilastik's `axistags`, labels of dimensions, and distances in
//! `element_size_um` (Fiji, ilastik) and `resolution` (CREMI and others, mostly with `units`).

use super::axes::{Axis, Role};
use super::file;
use crate::error::Problem;
use crate::units::Step;
use hdf5_reader::{Attribute, Dataset};

/// Attributes that hold distances along z, y and x, and the unit that their name states.
const STEPS: [(&str, Option<&str>); 5] = [
    ("element_size_um", Some("um")),
    ("resolution", None),
    ("voxel_size", None),
    ("pixel_size", None),
    ("spacing", None),
];

/// Returns the role of an axis of this name.
pub(super) fn role(name: &str) -> Role {
    match name.to_ascii_lowercase().as_str() {
        "x" => Role::Space(0),
        "y" => Role::Space(1),
        "z" => Role::Space(2),
        "t" | "time" => Role::Time,
        "c" | "channel" | "channels" => Role::Channel,
        _ => Role::Unknown,
    }
}

/// Returns the axes of a dataset, the slowest first, with what its attributes say of them.
pub(super) fn axes(dataset: &Dataset, shape: &[u64]) -> Result<Vec<Axis>, Problem> {
    let attributes = dataset.attributes();
    let mut axes: Vec<Axis> = shape.iter().map(|n| Axis::of_size(*n)).collect();
    let mut names = file::texts(&attributes, "DIMENSION_LABELS");
    let tags = file::text(&attributes, "axistags").map(|text| keys(&text)).unwrap_or_default();
    if tags.len() == shape.len() {
        names = tags;
    }
    if names.len() == shape.len() {
        axes.iter_mut().zip(&names).for_each(|(axis, name)| axis.role = role(name));
        // Two axes of one letter say nothing.
        let letters: Vec<Role> = axes.iter().map(|a| a.role).collect();
        for (i, axis) in axes.iter_mut().enumerate() {
            let twice = letters.iter().filter(|l| **l == letters[i]).count() > 1;
            if twice && matches!(axis.role, Role::Space(_)) {
                axis.role = Role::Unknown;
            }
        }
    }
    let Some((numbers, unit)) = steps(&attributes) else { return Ok(axes) };
    // Three numbers are of the axes of space, which are the last three where nothing names them.
    let of_space = |a: &&mut Axis| matches!(a.role, Role::Space(_) | Role::Unknown);
    let all = numbers.len() == axes.len();
    let mut targets: Vec<&mut Axis> = axes.iter_mut().filter(|a| all || of_space(a)).collect();
    let units = file::texts(&attributes, "units");
    let (skip, count) = (targets.len().saturating_sub(numbers.len()), numbers.len());
    if targets.len() < count {
        return Ok(axes);
    }
    for (i, (axis, number)) in targets.iter_mut().skip(skip).zip(numbers).enumerate() {
        if number > 0.0 && number.is_finite() {
            let own = if units.len() == count { units.get(i) } else { units.first() };
            let unit = unit.map(str::to_owned).or_else(|| own.cloned());
            axis.step = Step { number: Some(number), unit };
        }
    }
    Ok(axes)
}

/// Returns the distances that an attribute gives, three or more, and the unit in its name.
fn steps(attributes: &[Attribute]) -> Option<(Vec<f64>, Option<&'static str>)> {
    STEPS.iter().find_map(|(name, unit)| {
        let numbers = file::numbers(attributes, name)?;
        (numbers.len() >= 3).then_some((numbers, *unit))
    })
}

/// Returns the keys of ilastik's axis tags, in the order of the axes: the values of `"key": "z"`.
fn keys(json: &str) -> Vec<String> {
    json.split("\"key\"")
        .skip(1)
        .filter_map(|rest| Some(rest.split('"').nth(1)?.to_string()))
        .collect()
}
