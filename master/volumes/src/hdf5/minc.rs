//! MINC 2: `minc-2.0/image/0/image` with the order of its dimensions, their start, step and direction, and
//! the real values of each slice's range. As nibabel reads it.

use super::axes::{Axis, Role};
use super::file::{self, Tree};
use super::number::Stored;
use super::stream::{Scale, Values, numbers_of};
use crate::error::{Problem, quoted};
use crate::units::Step;
use glam::DVec3;
use hdf5_reader::Dataset;

/// Path of the finest picture.
pub(super) const IMAGE: &str = "minc-2.0/image/0/image";
const FOLDER: &str = "minc-2.0/image/0";

fn malformed(field: &str, what: impl Into<String>) -> Problem {
    Problem::malformed(field, what, "get the file again")
}

/// Returns the axes of the picture, the slowest first, and its values.
pub(super) fn read(
    tree: &Tree,
    image: &Dataset,
    shape: &[u64],
    notes: &mut Vec<String>,
) -> Result<(Vec<Axis>, Values), Problem> {
    let order = file::text(&image.attributes(), "dimorder")
        .ok_or_else(|| malformed("dimorder", "is missing"))?;
    let names: Vec<&str> = order.split(',').map(str::trim).take(shape.len()).collect();
    if names.len() != shape.len() {
        let what = format!("{} names other axes than the {} there", quoted(&order), shape.len());
        return Err(malformed("dimorder", what));
    }
    let axes = names.iter().zip(shape).map(|(name, size)| axis(tree, name, *size, notes));
    Ok((axes.collect::<Result<_, _>>()?, values(tree, image, shape)?))
}

/// Returns a dimension.
fn axis(tree: &Tree, name: &str, size: u64, notes: &mut Vec<String>) -> Result<Axis, Problem> {
    let (letter, along) = match name {
        "xspace" => (0, DVec3::X),
        "yspace" => (1, DVec3::Y),
        "zspace" => (2, DVec3::Z),
        "time" => return Ok(Axis { role: Role::Time, ..Axis::of_size(size) }),
        "vector_dimension" => return Ok(Axis { role: Role::Voxel, ..Axis::of_size(size) }),
        _ => return Ok(Axis::of_size(size)),
    };
    let dimension = tree.dataset(&format!("minc-2.0/dimensions/{name}")).ok();
    let attributes = dimension.map(|d| d.attributes()).unwrap_or_default();
    if file::text(&attributes, "spacing").is_some_and(|s| s.starts_with("irregular")) {
        return Err(Problem::unsupported(
            name,
            "has irregular steps",
            "resample it, for instance with mincresample",
        ));
    }
    let step = file::number(&attributes, "step").filter(|s| *s != 0.0);
    if step.is_none() {
        notes.push(format!("the file does not say the step along {name}; 1 mm was taken"));
    }
    let step = step.unwrap_or(1.0);
    let direction = file::several::<3>(&attributes, "direction_cosines").map(DVec3::from_array);
    Ok(Axis {
        size,
        role: Role::Space(letter),
        step: Step { number: Some(step.abs()), unit: file::text(&attributes, "units") },
        falls: step < 0.0,
        start: file::number(&attributes, "start").unwrap_or(0.0),
        direction: Some(direction.unwrap_or(along)),
        of_body: true,
    })
}

/// Returns how the stored numbers of the picture become values: those from the least to the greatest
/// valid number span the range of `image-min` and `image-max`, of the whole or of each slice.
fn values(tree: &Tree, image: &Dataset, shape: &[u64]) -> Result<Values, Problem> {
    let stored = Stored::of(image, IMAGE)?;
    // Floats are values themselves.
    let Some((least, most)) = stored.number.limits() else { return Ok(Values::default()) };
    let range = file::several::<2>(&image.attributes(), "valid_range");
    let [low, high] = range.unwrap_or([least, most]);
    if !(low < high && low >= least && high <= most) {
        let what = format!("{low} to {high} is no range of {}", stored.number.name());
        return Err(malformed("valid_range", what));
    }
    let mut ends = Vec::new();
    let mut ranks = Vec::new();
    for name in ["image-min", "image-max"] {
        let dataset = tree.dataset(&format!("{FOLDER}/{name}"));
        let Ok(dataset) = dataset else { return Err(malformed(name, "is missing")) };
        let rank = dataset.shape().len();
        let fits = rank < shape.len() && dataset.shape() == &shape[..rank] && rank <= 2;
        let numbers = numbers_of(&dataset, name)?;
        if !fits || !numbers.iter().all(|n| n.is_finite()) {
            let what = format!("has the shape {:?}, which is not of slices", dataset.shape());
            return Err(malformed(name, what));
        }
        ranks.push(rank);
        ends.push(numbers);
    }
    let [mins, maxs] = &ends[..] else { unreachable!("two names") };
    if ranks[0] != ranks[1] {
        return Err(malformed("image-max", "has another shape than image-min"));
    }
    let line = |(min, max): (&f64, &f64)| {
        let slope = (max - min) / (high - low);
        [slope, min - low * slope]
    };
    let lines: Vec<[f64; 2]> = mins.iter().zip(maxs).map(line).collect();
    let first = *lines.first().ok_or_else(|| malformed("image-max", "is empty"))?;
    let scale = match lines.iter().all(|l| *l == first) && first[0] != 0.0 {
        true => Scale::Whole(first),
        false => Scale::Slices { axes: ranks[0], lines },
    };
    let clip = ((low, high) != (least, most)).then_some([low, high]);
    Ok(Values { clip, scale, ..Values::default() })
}
