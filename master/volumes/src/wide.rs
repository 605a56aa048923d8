//! Converts 32- and 64-bit integers and doubles to codes of 16 or 32 bits.
//!
//! The conversion depends on the range, which is known only after the last number. Keeping all
//! numbers and making a second list beside them would take half as much memory again as the file's
//! voxels; reading a compressed file twice would double the time. So numbers are collected in
//! pieces, and each piece is freed once it was converted.

use crate::error::Problem;
use crate::samples::reserve;
use slabcast_common::volume::{Samples, ValueMap};

/// Bytes of a piece, the memory needed beyond the file's voxels. glibc returns an allocation above
/// 32 MiB to the system when it is freed (`M_MMAP_THRESHOLD` never grows beyond that) and may keep
/// smaller ones. A multiple of the chunks of 128 KiB in which bytes arrive.
pub(crate) const PIECE_BYTES: usize = 33 << 20;

/// Converts integers to u16 codes if their range fits, else to f32 codes in 0..1. `wide` widens a
/// number.
pub(crate) fn compact_integers<T: Copy + Ord>(
    pieces: Vec<Vec<T>>,
    wide: impl Fn(T) -> i128,
) -> Result<(Samples, ValueMap), Problem> {
    let all = || pieces.iter().flatten();
    let min = wide(*all().min().expect("a volume has a sample"));
    let max = wide(*all().max().expect("a volume has a sample"));
    // Can't overflow: 64-bit integers differ by less than 2^64.
    let span = max - min;
    if span <= i128::from(u16::MAX) {
        let codes = convert(pieces, |v| (wide(v) - min) as u16)?;
        return Ok((Samples::U16(codes), ValueMap { scale: 1.0, offset: min as f64 }));
    }
    let codes = convert(pieces, |v| ((wide(v) - min) as f64 / span as f64) as f32)?;
    Ok((Samples::F32(codes), ValueMap { scale: span as f64, offset: min as f64 }))
}

/// Converts doubles to f32 codes; rescales them where f32 would overflow, flush to zero or be too
/// coarse.
pub(crate) fn compact_doubles(pieces: Vec<Vec<f64>>) -> Result<(Samples, ValueMap), Problem> {
    let finite = || pieces.iter().flatten().copied().filter(|v| v.is_finite());
    let (lo, hi) =
        finite().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)));
    let map = if lo > hi || f32_keeps_range(lo, hi) {
        ValueMap::IDENTITY
    } else if hi == lo {
        ValueMap { scale: 1.0, offset: lo }
    } else if (hi - lo).is_finite() {
        ValueMap { scale: hi - lo, offset: lo }
    } else {
        // The span overflows f64: codes are -1..1 around the middle.
        ValueMap { scale: hi / 2.0 - lo / 2.0, offset: hi / 2.0 + lo / 2.0 }
    };
    let codes = convert(pieces, |v| ((v - map.offset) / map.scale) as f32)?;
    Ok((Samples::F32(codes), map))
}

/// Returns whether f32 can hold values from `lo` to `hi` directly: none overflows, and rounding
/// (2^-24 of the largest) or flushing to zero stays below 1/65536 of the span, the step of a 16-bit
/// scanner.
fn f32_keeps_range(lo: f64, hi: f64) -> bool {
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

/// Converts all pieces to one list, freeing each piece after it was converted.
fn convert<T: Copy, U>(pieces: Vec<Vec<T>>, code: impl Fn(T) -> U) -> Result<Vec<U>, Problem> {
    let mut codes = Vec::new();
    reserve(&mut codes, pieces.iter().map(Vec::len).sum())?;
    for piece in pieces {
        codes.extend(piece.iter().map(|&v| code(v)));
    }
    Ok(codes)
}
