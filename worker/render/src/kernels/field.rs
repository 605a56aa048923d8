//! Splatting of a field: a voxel adds its value to the planes that its kernel meets, and to their
//! derivatives.
//!
//! What a voxel adds is `((payload * w_z) * w_y) * w_x` with four weights each, one for each channel
//! ([`crate::primitives::field_taps`]). Loops are written plainly; rows of records have lanes of
//! AVX2, which must equal them.

use crate::kernels::composite::Sum;
use crate::kernels::pixel_records::{Record, Recorded, STRIDE};
use crate::kernels::{Level, Simd, times, whole};
use crate::primitives::field_taps::FieldTaps;
use crate::primitives::footprint::{Footprint, Sections};

/// Numbers that planes of a field are summed in.
pub trait FieldSum: Recorded + Sum {
    /// One channel of a weight, or of a payload times weights.
    type Term: Copy + Default + std::fmt::Debug;

    /// Returns a payload in raw units; it rounds to nothing if it adds nothing.
    fn payload_of(raw: f32) -> Self::Term;
    /// Returns whether a payload is nothing.
    fn is_nothing(payload: Self::Term) -> bool;
    /// `term * weight`.
    fn weighted(term: Self::Term, weight: Self::Term) -> Self::Term;
    /// `self + term`.
    #[must_use]
    fn with(self, term: Self::Term) -> Self;
    /// The weights of a table.
    fn taps(taps: &FieldTaps) -> &[[Self::Term; 4]];
    /// Weights along `axis`: see [`Footprint::weights`].
    fn window<'b>(
        footprint: &'b Footprint<'_>,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<[Self::Term; 4]>,
    ) -> (i32, &'b [[Self::Term; 4]]);
    /// Adds a row of planes, by slot, to the records of pixels beside each other: weights by pixel,
    /// the same for all slots.
    ///
    /// # Panics
    /// If there are not as many records as weights.
    fn add_row<const N: usize>(
        simd: Simd,
        records: &mut [Record<Self, N>],
        row: &[Four<Self>; N],
        wx: &[Four<Self>],
    );
    /// Adds as [`FieldSum::add_row`] does, with weights by pixel and slot.
    ///
    /// # Panics
    /// If there are not as many records as weights.
    fn add_woven_row<const N: usize>(
        simd: Simd,
        records: &mut [Record<Self, N>],
        row: &[Four<Self>; N],
        wx: &[[Four<Self>; N]],
    );
}

/// [`FieldSum::add_row`] plainly.
#[inline(always)]
fn add_row<S: FieldSum, const N: usize>(
    records: &mut [Record<S, N>],
    row: &[Four<S>; N],
    wx: &[Four<S>],
) {
    for (record, &wx) in records[..wx.len()].iter_mut().zip(wx) {
        for slot in 0..N {
            let term = weighted::<S>(row[slot], wx);
            for c in 0..4 {
                record[slot][c] = record[slot][c].with(term[c]);
            }
        }
    }
}

/// [`FieldSum::add_woven_row`] plainly.
#[inline(always)]
fn add_woven_row<S: FieldSum, const N: usize>(
    records: &mut [Record<S, N>],
    row: &[Four<S>; N],
    wx: &[[Four<S>; N]],
) {
    for (record, wx) in records[..wx.len()].iter_mut().zip(wx) {
        for slot in 0..N {
            let term = weighted::<S>(row[slot], wx[slot]);
            for c in 0..4 {
                record[slot][c] = record[slot][c].with(term[c]);
            }
        }
    }
}

/// The rows of a field in lanes of AVX2.
#[cfg(target_arch = "x86_64")]
mod wide {
    use crate::kernels::pixel_records::Record;
    use std::arch::x86_64::*;

    /// Registers of a row of eight planes, at most.
    const PARTS: usize = 8;

    #[target_feature(enable = "avx2")]
    #[inline]
    pub(super) fn shorts<const N: usize, const WOVEN: bool>(
        records: &mut [Record<i16, N>],
        row: &[[i16; 4]; N],
        wx: &[i16],
    ) {
        const { assert!(N == 4 || N == 8) };
        let step = if WOVEN { 4 * N } else { 4 };
        let mut rows = [_mm256_setzero_si256(); PARTS];
        for (i, to) in rows[..N / 4].iter_mut().enumerate() {
            // SAFETY: a row has N planes of 8 bytes, four of them 32.
            *to = unsafe { _mm256_loadu_si256(row.as_ptr().cast::<__m256i>().add(i)) };
        }
        for (record, wx) in records.iter_mut().zip(wx.chunks_exact(step)) {
            let at: *mut __m256i = record.as_mut_ptr().cast();
            // SAFETY: weights are of four channels, 8 bytes, or of N slots; a record has N planes.
            unsafe {
                let all = _mm256_set1_epi64x(wx.as_ptr().cast::<i64>().read_unaligned());
                for (i, row) in rows[..N / 4].iter().enumerate() {
                    let wx = if WOVEN {
                        _mm256_loadu_si256(wx.as_ptr().cast::<__m256i>().add(i))
                    } else {
                        all
                    };
                    let sums = _mm256_loadu_si256(at.add(i));
                    let sums = _mm256_add_epi16(sums, _mm256_mulhrs_epi16(*row, wx));
                    _mm256_storeu_si256(at.add(i), sums);
                }
            }
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    pub(super) fn longs<const N: usize, const WOVEN: bool>(
        records: &mut [Record<i32, N>],
        row: &[[f32; 4]; N],
        wx: &[f32],
    ) {
        const { assert!(N == 4 || N == 8) };
        let step = if WOVEN { 4 * N } else { 4 };
        let mut rows = [_mm256_setzero_ps(); PARTS];
        for (i, to) in rows[..N / 2].iter_mut().enumerate() {
            // SAFETY: a row has N planes of 16 bytes, two of them 32.
            *to = unsafe { _mm256_loadu_ps(row.as_ptr().cast::<f32>().add(8 * i)) };
        }
        for (record, wx) in records.iter_mut().zip(wx.chunks_exact(step)) {
            let at: *mut __m256i = record.as_mut_ptr().cast();
            // SAFETY: weights are of four channels, 16 bytes, or of N slots; a record has N planes.
            unsafe {
                let four = _mm_loadu_ps(wx.as_ptr());
                let all = _mm256_set_m128(four, four);
                for (i, row) in rows[..N / 2].iter().enumerate() {
                    let wx = if WOVEN { _mm256_loadu_ps(wx.as_ptr().add(8 * i)) } else { all };
                    let term = _mm256_cvtps_epi32(_mm256_mul_ps(*row, wx));
                    let sums = _mm256_loadu_si256(at.add(i));
                    _mm256_storeu_si256(at.add(i), _mm256_add_epi32(sums, term));
                }
            }
        }
    }
}

/// Calls the rows in lanes where the machine has them, or the plain ones.
macro_rules! in_lanes {
    ($simd:expr, $wide:ident, $woven:literal, $plain:expr, ($records:expr, $row:expr, $wx:expr)) => {
        match $simd.0 {
            // SAFETY: the value proves that the instructions are there; AVX-512 has AVX2 in it.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 | Level::Avx512 => unsafe {
                wide::$wide::<N, $woven>(&mut $records[..$wx.len()], $row, flat($wx));
            },
            _ => $plain,
        }
    };
}

/// Weights one after the other.
#[inline(always)]
fn flat<T: bytemuck::NoUninit + bytemuck::AnyBitPattern, W: bytemuck::NoUninit>(wx: &[W]) -> &[T] {
    bytemuck::cast_slice(wx)
}

impl FieldSum for i16 {
    type Term = i16;

    #[inline(always)]
    fn payload_of(raw: f32) -> i16 {
        whole(raw)
    }

    #[inline(always)]
    fn is_nothing(payload: i16) -> bool {
        payload == 0
    }

    #[inline(always)]
    fn weighted(term: i16, weight: i16) -> i16 {
        times(term, weight)
    }

    #[inline(always)]
    fn with(self, term: i16) -> i16 {
        self.wrapping_add(term)
    }

    #[inline(always)]
    fn taps(taps: &FieldTaps) -> &[[i16; 4]] {
        taps.fixed()
    }

    #[inline(always)]
    fn window<'b>(
        footprint: &'b Footprint<'_>,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<[i16; 4]>,
    ) -> (i32, &'b [[i16; 4]]) {
        footprint.field_weights_fixed(axis, pos, clip, buffer)
    }

    #[inline(always)]
    fn add_row<const N: usize>(
        simd: Simd,
        records: &mut [Record<i16, N>],
        row: &[Four<i16>; N],
        wx: &[Four<i16>],
    ) {
        in_lanes!(simd, shorts, false, add_row::<i16, N>(records, row, wx), (records, row, wx));
    }

    #[inline(always)]
    fn add_woven_row<const N: usize>(
        simd: Simd,
        records: &mut [Record<i16, N>],
        row: &[Four<i16>; N],
        wx: &[[Four<i16>; N]],
    ) {
        in_lanes!(
            simd,
            shorts,
            true,
            add_woven_row::<i16, N>(records, row, wx),
            (records, row, wx)
        );
    }
}

impl FieldSum for i32 {
    type Term = f32;

    #[inline(always)]
    fn payload_of(raw: f32) -> f32 {
        raw
    }

    #[inline(always)]
    fn is_nothing(payload: f32) -> bool {
        payload == 0.0
    }

    #[inline(always)]
    fn weighted(term: f32, weight: f32) -> f32 {
        term * weight
    }

    #[inline(always)]
    fn with(self, term: f32) -> i32 {
        self.wrapping_add(super::nearest_signed(term))
    }

    #[inline(always)]
    fn taps(taps: &FieldTaps) -> &[[f32; 4]] {
        taps.floats()
    }

    #[inline(always)]
    fn window<'b>(
        footprint: &'b Footprint<'_>,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<[f32; 4]>,
    ) -> (i32, &'b [[f32; 4]]) {
        footprint.field_weights(axis, pos, clip, buffer)
    }

    #[inline(always)]
    fn add_row<const N: usize>(
        simd: Simd,
        records: &mut [Record<i32, N>],
        row: &[Four<i32>; N],
        wx: &[Four<i32>],
    ) {
        in_lanes!(simd, longs, false, add_row::<i32, N>(records, row, wx), (records, row, wx));
    }

    #[inline(always)]
    fn add_woven_row<const N: usize>(
        simd: Simd,
        records: &mut [Record<i32, N>],
        row: &[Four<i32>; N],
        wx: &[[Four<i32>; N]],
    ) {
        in_lanes!(simd, longs, true, add_woven_row::<i32, N>(records, row, wx), (records, row, wx));
    }
}

/// A payload or a product in its four channels.
pub type Four<S> = [<S as FieldSum>::Term; 4];

/// Weights by column and slot, and by row and slot.
pub type WovenWindow<'a, S, const N: usize> = (&'a [[Four<S>; N]], &'a [[Four<S>; N]]);

/// `term * weight`, channel by channel.
#[inline(always)]
pub fn weighted<S: FieldSum>(term: Four<S>, weight: Four<S>) -> Four<S> {
    // Plain loops: closures of std's array functions are not compiled for the instruction set.
    let mut out = [S::Term::default(); 4];
    for c in 0..4 {
        out[c] = S::weighted(term[c], weight[c]);
    }
    out
}

/// Adds one plane of one voxel to the pixels of rows `y0..` and columns `x0..` of a plane with
/// `stride` pixels a row.
///
/// # Panics
/// If the footprint leaves the plane.
#[inline(always)]
pub fn splat<S: FieldSum>(
    plane: &mut [[S; 4]],
    stride: usize,
    (x0, wx): (usize, &[Four<S>]),
    (y0, wy): (usize, &[Four<S>]),
    section: Four<S>,
) {
    for (j, &wy) in wy.iter().enumerate() {
        let row = weighted::<S>(section, wy);
        let from = (y0 + j) * stride + x0;
        for (pixel, &wx) in plane[from..from + wx.len()].iter_mut().zip(wx) {
            let term = weighted::<S>(row, wx);
            for c in 0..4 {
                pixel[c] = pixel[c].with(term[c]);
            }
        }
    }
}

/// Adds a voxel to all its planes in pixel records from `at` on: weights by column, by row, and by
/// slot.
///
/// # Panics
/// If the footprint leaves the records.
#[inline(always)]
pub fn splat_records<S: FieldSum, const N: usize>(
    simd: Simd,
    records: &mut [Record<S, N>],
    at: usize,
    (wx, wy): (&[Four<S>], &[Four<S>]),
    planes: &[Four<S>; N],
) {
    for (j, &wy) in wy.iter().enumerate() {
        let mut row = [[S::Term::default(); 4]; N];
        for slot in 0..N {
            row[slot] = weighted::<S>(planes[slot], wy);
        }
        S::add_row::<N>(simd, &mut records[at + j * STRIDE..], &row, wx);
    }
}

/// Adds a voxel whose planes have footprints of their own: weights by column and slot, by row and
/// slot, zero where a plane has none.
///
/// # Panics
/// If the window leaves the records.
#[inline(always)]
pub fn splat_woven<S: FieldSum, const N: usize>(
    simd: Simd,
    records: &mut [Record<S, N>],
    at: usize,
    (wx, wy): WovenWindow<'_, S, N>,
    planes: &[Four<S>; N],
) {
    for (j, wy) in wy.iter().enumerate() {
        let mut row = [[S::Term::default(); 4]; N];
        for slot in 0..N {
            row[slot] = weighted::<S>(planes[slot], wy[slot]);
        }
        S::add_woven_row::<N>(simd, &mut records[at + j * STRIDE..], &row, wx);
    }
}

/// Returns the weights of the planes that a voxel at depth `z` (in phases) meets.
#[inline(always)]
pub fn planes_of<S: FieldSum>(sections: &Sections, z: i32) -> &[Four<S>] {
    let (from, count) = sections.row(z);
    &S::taps(sections.field())[from..from + count]
}
