//! Converts 32- and 64-bit integers and doubles to codes of 16 or 32 bits.
//!
//! The conversion depends on the range, which is known only after the last number. Keeping all
//! numbers and making a second list beside them would take half as much memory again as the file's
//! voxels; reading a compressed file twice would double the time. So numbers are collected in
//! pieces, and each piece is freed once it was converted.

use crate::error::Problem;
use crate::numbers::{Beside, Wide};
use crate::samples::reserve;
use slabcast_common::volume::{Samples, ValueMap};

/// Bytes of a piece, the memory needed beyond the file's voxels. glibc returns an allocation above
/// 32 MiB to the system when it is freed (`M_MMAP_THRESHOLD` never grows beyond that) and may keep
/// smaller ones. A multiple of the chunks of 128 KiB in which bytes arrive.
pub(crate) const PIECE_BYTES: usize = 33 << 20;

/// Converts integers to u16 codes if their range fits, else to f32 codes in 0..1. Notes by how much
/// they were rounded, or keeps the integers.
pub(crate) fn compact_integers<T: Wide + Ord + Into<i128>>(
    pieces: Vec<Vec<T>>,
    beside: &Beside,
) -> Result<(Samples, ValueMap), Problem> {
    let all = || pieces.iter().flatten();
    let min: i128 = (*all().min().expect("a volume has a sample")).into();
    let max: i128 = (*all().max().expect("a volume has a sample")).into();
    // Can't overflow: 64-bit integers differ by less than 2^64.
    let span = max - min;
    let map = integer_map(min, max);
    if fits_u16(min, max) {
        // Values are f64.
        const EXACT: i128 = 1 << 53;
        let exact = min >= -EXACT && max <= EXACT;
        let code = |v: T| (Into::<i128>::into(v) - min) as u16;
        if exact {
            return Ok((Samples::U16(convert(pieces, code)?), map));
        }
        // Half the distance of neighbouring f64s at these sizes, at least 1.
        beside.rounded::<T>((min.abs().max(max.abs()) as f64 * f64::EPSILON / 2.0).max(1.0));
        return Ok((Samples::U16(convert_beside(pieces, map, beside, code)?), map));
    }
    let mut most = 0.0f64;
    let codes = convert_beside(pieces, map, beside, |v| {
        let v: i128 = v.into();
        let code = unit_code(v, min, span);
        most = most.max((map.value(code.into()) - v as f64).abs());
        code
    })?;
    beside.rounded::<T>(most);
    Ok((Samples::F32(codes), map))
}

/// Returns whether codes of 16 bits hold integers from `min` to `max`.
pub(crate) fn fits_u16(min: i128, max: i128) -> bool {
    max - min <= i128::from(u16::MAX)
}

/// Returns the map from codes to integers from `min` to `max`.
pub(crate) fn integer_map(min: i128, max: i128) -> ValueMap {
    let scale = if fits_u16(min, max) { 1.0 } else { (max - min) as f64 };
    ValueMap { scale, offset: min as f64 }
}

/// Returns the code, 0 to 1, of an integer whose range is too wide for 16 bits.
#[inline]
pub(crate) fn unit_code(v: i128, min: i128, span: i128) -> f32 {
    ((v - min) as f64 / span as f64) as f32
}

const F32_MAX: f64 = f32::MAX as f64;

/// Least size of a filler, and how many times it is as large as all other values. Fillers in use
/// are 1e20, 1e30, 9.97e36 (NetCDF), 3.4e38 and 1.8e308; a hot voxel of an image is smaller. Beside
/// a factor of 1e9 the others would be one step of f32 (2^24), and pictures show nothing of them.
const FILLER_MIN: f64 = 1e15;
const FILLER_RATIO: f64 = 1e9;
/// Least number of values that tell a filler from a value like others.
const FILLER_VALUES: usize = 64;

/// Looks for a filler among values.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Fillers {
    /// Size of the largest value.
    pub(crate) first: f64,
    /// Size of the largest that is smaller.
    second: f64,
    count: usize,
}

impl Fillers {
    /// Looks at the size of a finite value.
    #[inline]
    pub(crate) fn add(&mut self, size: f64) {
        self.count += 1;
        if size > self.first {
            (self.first, self.second) = (size, self.first);
        } else if size > self.second && size < self.first {
            self.second = size;
        }
    }

    /// Returns the size above which values stand for none; `None` without such. They are one value,
    /// with either sign.
    pub(crate) fn limit(&self) -> Option<f64> {
        let &Fillers { first, second, count } = self;
        let is_filler = first >= FILLER_MIN && second > 0.0 && first / FILLER_RATIO > second;
        (is_filler && count >= FILLER_VALUES).then_some(second)
    }
}

fn filler_limit(all: impl Iterator<Item = f64>) -> Option<f64> {
    let mut found = Fillers::default();
    all.map(f64::abs).filter(|size| size.is_finite()).for_each(|size| found.add(size));
    found.limit()
}

/// Replaces fillers in f32 samples by NaN. Notes them, or keeps the samples.
pub(crate) fn without_fillers(
    mut codes: Vec<f32>,
    beside: &Beside,
) -> Result<(Samples, ValueMap), Problem> {
    let map = ValueMap::IDENTITY;
    let Some(limit) = filler_limit(codes.iter().map(|&v| v.into())) else {
        return Ok((Samples::F32(codes), map));
    };
    let is_filler = |v: &f32| v.is_finite() && f64::from(*v).abs() > limit;
    if let Some(filler) = codes.iter().copied().find(is_filler) {
        beside.filler(filler.into());
    }
    if beside.keeps() {
        let mut kept = Vec::new();
        reserve(&mut kept, codes.len())?;
        kept.extend_from_slice(&codes);
        beside.leave(vec![kept], map);
    }
    codes.iter_mut().filter(|v| is_filler(v)).for_each(|v| *v = f32::NAN);
    Ok((Samples::F32(codes), map))
}

/// Converts doubles to f32 codes; rescales them where f32 would overflow, flush to zero or be too
/// coarse. Notes by how much they were rounded, or keeps the doubles. A filler becomes NaN.
pub(crate) fn compact_doubles(
    pieces: Vec<Vec<f64>>,
    beside: &Beside,
) -> Result<(Samples, ValueMap), Problem> {
    let all = || pieces.iter().flatten().copied();
    // By a filler's range all others would become one code.
    let limit = filler_limit(all());
    if let Some(filler) = limit.and_then(|limit| all().find(|v| v.is_finite() && v.abs() > limit)) {
        beside.filler(filler);
    }
    let limit = limit.unwrap_or(f64::MAX);
    let inside = all().filter(|v| v.abs() <= limit);
    let (lo, hi) =
        inside.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)));
    let map = double_map(lo, hi);
    let mut most = 0.0f64;
    let codes = convert_beside(pieces, map, beside, |v| {
        if v.is_finite() && v.abs() > limit {
            return f32::NAN;
        }
        let code = double_code(v, map);
        // The difference of infinities is NaN, which `max` leaves out.
        most = most.max((map.value(code.into()) - v).abs());
        code
    })?;
    beside.rounded::<f64>(most);
    Ok((Samples::F32(codes), map))
}

/// Returns the map from f32 codes to doubles from `lo` to `hi`; `lo` is above `hi` if there are
/// none.
pub(crate) fn double_map(lo: f64, hi: f64) -> ValueMap {
    if lo > hi || f32_keeps_range(lo, hi) {
        ValueMap::IDENTITY
    } else if hi == lo {
        ValueMap { scale: 1.0, offset: lo }
    } else if (hi - lo).is_finite() {
        ValueMap { scale: hi - lo, offset: lo }
    } else {
        // The span overflows f64: codes are -1..1 around the middle.
        ValueMap { scale: hi / 2.0 - lo / 2.0, offset: hi / 2.0 + lo / 2.0 }
    }
}

/// Returns the code of a double.
#[inline]
pub(crate) fn double_code(v: f64, map: ValueMap) -> f32 {
    ((v - map.offset) / map.scale) as f32
}

/// Returns whether f32 can hold values from `lo` to `hi` directly: none overflows, and rounding
/// (2^-24 of the largest) or flushing to zero stays below 1/65536 of the span, the step of a 16-bit
/// scanner.
fn f32_keeps_range(lo: f64, hi: f64) -> bool {
    let largest = lo.abs().max(hi.abs());
    let span = hi - lo;
    if largest > F32_MAX {
        return false;
    }
    if span == 0.0 {
        return f64::from(lo as f32) == lo;
    }
    largest <= 256.0 * span && span >= 65536.0 * f64::from(f32::MIN_POSITIVE)
}

/// Converts all pieces to one list, freeing each piece after it was converted.
fn convert<T: Copy, U>(
    pieces: Vec<Vec<T>>,
    mut code: impl FnMut(T) -> U,
) -> Result<Vec<U>, Problem> {
    let mut codes = Vec::new();
    reserve(&mut codes, pieces.iter().map(Vec::len).sum())?;
    for piece in pieces {
        codes.extend(piece.iter().map(|&v| code(v)));
    }
    Ok(codes)
}

/// Converts all pieces to one list, and leaves them beside if they are to be kept.
fn convert_beside<T: Wide, U>(
    pieces: Vec<Vec<T>>,
    map: ValueMap,
    beside: &Beside,
    mut code: impl FnMut(T) -> U,
) -> Result<Vec<U>, Problem> {
    if !beside.keeps() {
        return convert(pieces, code);
    }
    let mut codes = Vec::new();
    reserve(&mut codes, pieces.iter().map(Vec::len).sum())?;
    codes.extend(pieces.iter().flatten().map(|&v| code(v)));
    beside.leave(pieces, map);
    Ok(codes)
}
