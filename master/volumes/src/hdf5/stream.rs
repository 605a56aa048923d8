//! The numbers of a dataset, read some planes at a time, converted and written in order.

use super::Source;
use super::axes::Placed;
use super::file;
use super::number::{Stored, Word};
use crate::confined::wire::Preface;
use crate::error::{OpenErrorKind, Problem, quoted};
use crate::samples::Number;
use hdf5_reader::{Dataset, SliceInfo, SliceInfoElem};
use std::io::Write;

/// Bytes of the numbers that are read at a time: as much memory again holds what is written.
const BATCH_BYTES: u64 = 64 << 20;
/// Most numbers of a dataset that is read whole: coordinates, ranges of slices.
const WHOLE_MAX: u64 = 1 << 20;

/// Slopes and intercepts from numbers to values.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Scale {
    /// One for all numbers.
    Whole([f64; 2]),
    /// One for each index along the slowest `axes` of the dataset.
    Slices { axes: usize, lines: Vec<[f64; 2]> },
}

/// Map from the stored numbers of a dataset to values.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Values {
    pub(super) scale: Scale,
    /// Numbers below and above are raised and lowered to these.
    pub(super) clip: Option<[f64; 2]>,
    /// Stored numbers that stand for no value.
    pub(super) fill: Vec<f64>,
    /// Whether signed numbers are meant without sign.
    pub(super) unsigned: bool,
}

impl Default for Values {
    fn default() -> Values {
        Values { scale: Scale::Whole([1.0, 0.0]), clip: None, fill: Vec::new(), unsigned: false }
    }
}

impl Values {
    /// Returns the type of the stored numbers as they are meant.
    pub(super) fn stored(&self, stored: Stored) -> Stored {
        let number = match stored.number {
            Number::I8 => Number::U8,
            Number::I16 => Number::U16,
            Number::I32 => Number::U32,
            Number::I64 => Number::U64,
            other => other,
        };
        if self.unsigned { Stored { number, ..stored } } else { stored }
    }

    /// Returns whether values are computed here: those without value, and those of slices that differ,
    /// can't be said by one slope and intercept.
    fn computes(&self) -> bool {
        !self.fill.is_empty() || matches!(self.scale, Scale::Slices { .. })
    }

    /// Returns the type of the numbers that are written.
    pub(super) fn number(&self, stored: Stored) -> Number {
        let stored = self.stored(stored);
        match self.computes() {
            true if stored.bytes() <= 2 || stored.number == Number::F32 => Number::F32,
            true => Number::F64,
            false => stored.number,
        }
    }
}

/// Returns the bytes of a block of a dataset, in the file's byte order.
fn block(dataset: &Dataset, block: &SliceInfo, bytes: usize) -> Result<Vec<u8>, Problem> {
    fn words<const N: usize>(d: &Dataset, block: &SliceInfo) -> Result<Vec<u8>, Problem> {
        let array = d.read_slice::<Word<N>>(block).map_err(|e| file::problem("dataset", &e))?;
        let mut out = Vec::new();
        crate::samples::reserve(&mut out, array.len() * N)?;
        array.iter().for_each(|w| out.extend_from_slice(&w.0));
        Ok(out)
    }
    match bytes {
        1 => words::<1>(dataset, block),
        2 => words::<2>(dataset, block),
        4 => words::<4>(dataset, block),
        _ => words::<8>(dataset, block),
    }
}

/// Returns all numbers of a small dataset, as values.
pub(super) fn numbers_of(dataset: &Dataset, name: &str) -> Result<Vec<f64>, Problem> {
    let stored = Stored::of(dataset, name)?;
    if dataset.num_elements().map_or(true, |n| n > WHOLE_MAX) {
        return Err(Problem::unsupported(
            quoted(name),
            "is too large for what it says",
            "get the file again",
        ));
    }
    // A single number has no axes, and none of them can be read in part.
    let mut bytes = dataset.read_raw_bytes().map_err(|e| file::problem(&quoted(name), &e))?;
    let size = stored.bytes();
    if stored.big_endian {
        bytes.chunks_exact_mut(size).for_each(<[u8]>::reverse);
    }
    Ok(bytes.chunks_exact(size).map(|b| stored.value(b)).collect())
}

/// Writes the preface of a dataset, then its samples, x fastest.
pub(super) fn write(
    source: &Source,
    stored: Stored,
    placed: &Placed,
    name: &str,
    notes: Vec<String>,
    out: &mut dyn Write,
) -> Result<(), Problem> {
    let io = |e: std::io::Error| Problem::io("pipe", &e);
    let Source { dataset, values, path, .. } = source;
    let (stored, number) = (values.stored(stored), values.number(stored));
    let size = stored.bytes() as u64;
    let [nx, ny, nz] = placed.lattice.dims.map(u64::from);
    let [kz, ky, kx] = placed.kept;
    let chunk = dataset.chunks().unwrap_or_default();
    let deep = |axis: usize| chunk.get(axis).map_or(1, |n| u64::from(*n).max(1));
    // Whole chunks where they fit, so that none is unpacked twice.
    let at_a_time = |fit: u64, chunk: u64| if fit >= chunk { fit - fit % chunk } else { fit };
    let planes = at_a_time((BATCH_BYTES / (nx * ny * size)).max(1), deep(kz));
    let rows = match planes {
        1 => at_a_time((BATCH_BYTES / (nx * size)).max(1), deep(ky)),
        _ => ny,
    };
    let mut preface = Some(Preface {
        name: name.into(),
        number,
        lattice: placed.lattice,
        anatomical: placed.anatomical,
        rescale: match &values.scale {
            Scale::Whole(line) if !values.computes() => *line,
            _ => [1.0, 0.0],
        },
        float: values.computes(),
        notes,
    });
    let mut converted = Vec::new();
    for z in (0..nz).step_by(planes as usize) {
        let z_end = (z + planes).min(nz);
        for y in (0..ny).step_by(rows as usize) {
            let y_end = (y + rows).min(ny);
            let along = |axis: usize| match axis {
                axis if axis == kz => SliceInfoElem::Slice { start: z, end: z_end, step: 1 },
                axis if axis == ky => SliceInfoElem::Slice { start: y, end: y_end, step: 1 },
                axis if axis == kx => SliceInfoElem::Slice { start: 0, end: nx, step: 1 },
                axis => SliceInfoElem::Index(placed.at[axis]),
            };
            let selections = (0..dataset.ndim()).map(along).collect();
            let mut bytes = block(dataset, &SliceInfo { selections }, stored.bytes())
                .map_err(|p| Problem { field: quoted(path), ..p })?;
            if bytes.len() as u64 != (z_end - z) * (y_end - y) * nx * size {
                return Err(Problem::new(
                    OpenErrorKind::Damaged,
                    quoted(path),
                    "has another size than its shape says",
                    "get the file again",
                ));
            }
            if stored.big_endian {
                bytes.chunks_exact_mut(stored.bytes()).for_each(<[u8]>::reverse);
            }
            // What fails at the first samples can still be told in full.
            if let Some(preface) = preface.take() {
                preface.write(out).map_err(io)?;
            }
            if !values.computes() && values.clip.is_none() && !stored.half {
                out.write_all(&bytes).map_err(io)?;
                continue;
            }
            for (i, row) in bytes.chunks_exact((nx * size) as usize).enumerate() {
                let mut place = placed.at.clone();
                (place[kz], place[ky]) = (z + i as u64 / (y_end - y), y + i as u64 % (y_end - y));
                convert(row, stored, number, values, &place, dataset.shape(), &mut converted);
                out.write_all(&converted).map_err(io)?;
            }
        }
    }
    out.flush().map_err(io)
}

/// Converts a row of little-endian numbers. `place` is its index along the axes of `shape`.
fn convert(
    row: &[u8],
    stored: Stored,
    number: Number,
    values: &Values,
    place: &[u64],
    shape: &[u64],
    out: &mut Vec<u8>,
) {
    out.clear();
    let [slope, intercept] = match &values.scale {
        // The preface has it.
        Scale::Whole(_) if !values.computes() => [1.0, 0.0],
        Scale::Whole(line) => *line,
        Scale::Slices { axes, lines } => {
            let index = place.iter().zip(shape).take(*axes).fold(0, |n, (i, size)| n * size + i);
            lines.get(index as usize).copied().unwrap_or([1.0, 0.0])
        }
    };
    for word in row.chunks_exact(stored.bytes()) {
        let mut value = stored.value(word);
        if !values.computes()
            && number.limits().is_some()
            && values.clip.is_none_or(|[low, high]| (low..=high).contains(&value))
        {
            out.extend_from_slice(word);
            continue;
        }
        if values.fill.contains(&value) {
            value = f64::NAN;
        } else if let Some([low, high]) = values.clip {
            value = value.clamp(low, high);
        }
        let value = value * slope + intercept;
        match number {
            Number::F32 => out.extend((value as f32).to_le_bytes()),
            Number::F64 => out.extend(value.to_le_bytes()),
            _ => out.extend_from_slice(&(value as i128).to_le_bytes()[..stored.bytes()]),
        }
    }
}
