//! Numbers that are wider than what is kept of them: 32- and 64-bit integers, and doubles.
//!
//! How they are kept depends on their range, which is known when the last has come. Keeping all
//! of them until then and making a second list beside would take half as much again as the file's
//! voxels, and reading a packed file twice would take twice the time. So they are kept in pieces,
//! and each piece is given back to the system once its numbers were taken over.

use crate::error::Problem;
use crate::samples::reserve;
use slabcast_common::volume::{Samples, ValueMap};

/// Bytes of a piece. glibc hands an allocation above 32 MiB back to the system whenever it is
/// freed (`M_MMAP_THRESHOLD` never grows beyond that); of smaller pieces it may keep all. One
/// piece is what this takes beyond the file's voxels. A multiple of 128 KiB, in which bytes come.
pub(crate) const PIECE_BYTES: usize = 33 << 20;

/// 32- and 64-bit integers in 16 bits where they fit, else in f32.
pub(crate) fn narrow<T: Copy + Ord>(
    pieces: Vec<Vec<T>>,
    wide: impl Fn(T) -> i128,
) -> Result<(Samples, ValueMap), Problem> {
    let all = || pieces.iter().flatten();
    let min = wide(*all().min().expect("a volume has a sample"));
    let max = wide(*all().max().expect("a volume has a sample"));
    // 64-bit integers are never more than 2^64 apart, so i128 can't overflow.
    let span = max - min;
    if span <= i128::from(u16::MAX) {
        let codes = taken_over(pieces, |v| (wide(v) - min) as u16)?;
        return Ok((Samples::U16(codes), ValueMap { scale: 1.0, offset: min as f64 }));
    }
    let codes = taken_over(pieces, |v| ((wide(v) - min) as f64 / span as f64) as f32)?;
    Ok((Samples::F32(codes), ValueMap { scale: span as f64, offset: min as f64 }))
}

/// f64 as f32, by way of a map where f32 would overflow, flush to zero or be too coarse.
pub(crate) fn single(pieces: Vec<Vec<f64>>) -> Result<(Samples, ValueMap), Problem> {
    let finite = || pieces.iter().flatten().copied().filter(|v| v.is_finite());
    let (lo, hi) =
        finite().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)));
    let map = if lo > hi || held_by_f32(lo, hi) {
        ValueMap::IDENTITY
    } else if hi == lo {
        ValueMap { scale: 1.0, offset: lo }
    } else if (hi - lo).is_finite() {
        ValueMap { scale: hi - lo, offset: lo }
    } else {
        // The span itself is beyond f64: codes are -1..1 around the middle.
        ValueMap { scale: hi / 2.0 - lo / 2.0, offset: hi / 2.0 + lo / 2.0 }
    };
    let codes = taken_over(pieces, |v| ((v - map.offset) / map.scale) as f32)?;
    Ok((Samples::F32(codes), map))
}

/// Whether f32 holds values from `lo` to `hi` as they are: none overflows, and rounding (2^-24
/// of the largest) or flushing stays below a 65536th of the span, a 16-bit scanner's step.
fn held_by_f32(lo: f64, hi: f64) -> bool {
    let largest = lo.abs().max(hi.abs());
    let span = hi - lo;
    if largest > f64::from(f32::MAX) {
        return false;
    }
    if span == 0.0 {
        return f64::from(lo as f32) == lo;
    }
    largest <= 256.0 * span && span >= 65536.0 * f64::from(f32::MIN_POSITIVE)
}

/// One list out of the pieces, which go as they are used up.
fn taken_over<T: Copy, U>(pieces: Vec<Vec<T>>, code: impl Fn(T) -> U) -> Result<Vec<U>, Problem> {
    let mut codes = Vec::new();
    reserve(&mut codes, pieces.iter().map(Vec::len).sum())?;
    for piece in pieces {
        codes.extend(piece.iter().map(|&v| code(v)));
    }
    Ok(codes)
}
