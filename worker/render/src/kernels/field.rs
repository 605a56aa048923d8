//! Splatting of a field: a voxel adds its value to the planes that its kernel meets, and to their
//! derivatives.
//!
//! A voxel adds `((payload * w_z) * w_y) * w_x` with four weights each, one for each channel
//! ([`crate::primitives::field_taps`]). Loops are written plainly; pixel records have
//! registers of x86 as well (`lanes`), which must equal them.

#[cfg(target_arch = "x86_64")]
mod lanes;

#[cfg(target_arch = "x86_64")]
use crate::kernels::Level;
use crate::kernels::composite::Sum;
use crate::kernels::pixel_records::{Record, Recorded, STRIDE};
use crate::kernels::{Simd, times, whole};
use crate::primitives::field_taps::FieldTaps;
use crate::primitives::footprint::{Footprint, Sections};

/// Numbers that planes of a field are summed in.
pub trait FieldSum: Recorded + Sum {
    /// One channel of a weight, or of a payload times weights.
    type Term: bytemuck::Pod + Default + std::fmt::Debug;

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
    /// Adds a voxel's planes, by slot, to the pixel records from `at` on. Weights are by column and
    /// by row, four each; if `WOVEN`, four for each slot.
    ///
    /// # Panics
    /// If the footprint leaves the records.
    fn splat<const N: usize, const WOVEN: bool>(
        simd: Simd,
        records: &mut [Record<Self, N>],
        at: usize,
        weights: (&[Self::Term], &[Self::Term]),
        planes: &[Four<Self>; N],
    );
}

/// [`FieldSum::splat`] plainly.
#[inline(always)]
fn splat_plain<S: FieldSum, const N: usize, const WOVEN: bool>(
    records: &mut [Record<S, N>],
    at: usize,
    (wx, wy): (&[S::Term], &[S::Term]),
    planes: &[Four<S>; N],
) {
    let step = if WOVEN { 4 * N } else { 4 };
    for (j, wy) in wy.chunks_exact(step).enumerate() {
        let records = &mut records[at + j * STRIDE..][..wx.len() / step];
        for (record, wx) in records.iter_mut().zip(wx.chunks_exact(step)) {
            for slot in 0..N {
                for c in 0..4 {
                    let of = if WOVEN { 4 * slot + c } else { c };
                    let row = S::weighted(planes[slot][c], wy[of]);
                    record[slot][c] = record[slot][c].with(S::weighted(row, wx[of]));
                }
            }
        }
    }
}

/// Weights one after the other.
#[inline(always)]
fn flat<T: bytemuck::Pod, W: bytemuck::NoUninit>(wx: &[W]) -> &[T] {
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
    fn splat<const N: usize, const WOVEN: bool>(
        simd: Simd,
        records: &mut [Record<i16, N>],
        at: usize,
        weights: (&[i16], &[i16]),
        planes: &[[i16; 4]; N],
    ) {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                lanes::shorts512::<N, WOVEN>(records, at, weights, planes);
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { lanes::shorts256::<N, WOVEN>(records, at, weights, planes) },
            _ => splat_plain::<i16, N, WOVEN>(records, at, weights, planes),
        }
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
    fn splat<const N: usize, const WOVEN: bool>(
        simd: Simd,
        records: &mut [Record<i32, N>],
        at: usize,
        weights: (&[f32], &[f32]),
        planes: &[[f32; 4]; N],
    ) {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                lanes::longs512::<N, WOVEN>(records, at, weights, planes);
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { lanes::longs256::<N, WOVEN>(records, at, weights, planes) },
            _ => splat_plain::<i32, N, WOVEN>(records, at, weights, planes),
        }
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
    S::splat::<N, false>(simd, records, at, (flat(wx), flat(wy)), planes);
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
    S::splat::<N, true>(simd, records, at, (flat(wx), flat(wy)), planes);
}

/// Returns the weights of the planes that a voxel at depth `z` (in phases) meets.
#[inline(always)]
pub fn planes_of<S: FieldSum>(sections: &Sections, z: i32) -> &[Four<S>] {
    let (from, count) = sections.row(z);
    &S::taps(sections.field())[from..from + count]
}
