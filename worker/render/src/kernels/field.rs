//! Splatting of a field: a voxel adds its value to the planes that its kernel meets, and to their
//! derivatives.
//!
//! What a voxel adds is `((payload * w_z) * w_y) * w_x` with four weights each, one for each channel
//! ([`crate::primitives::field_taps`]). Loops are plain and of known length where it matters;
//! compilers make lanes of them for every instruction set.

use crate::kernels::composite::Sum;
use crate::kernels::pixel_records::{Record, Recorded, STRIDE};
use crate::kernels::whole;
use crate::primitives::field_taps::FieldTaps;
use crate::primitives::footprint::{Footprint, Sections};

/// Numbers that planes of a field are summed in.
pub trait FieldSum: Recorded<Pixel = [Self; 4]> + Sum {
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
        // As `times`, in the form that compilers turn into one instruction.
        ((((i32::from(term) * i32::from(weight)) >> 14) + 1) >> 1) as i16
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
}

/// A payload or a product in its four channels.
pub type Four<S> = [<S as FieldSum>::Term; 4];

/// `term * weight`, channel by channel.
#[inline(always)]
pub fn weighted<S: FieldSum>(term: Four<S>, weight: Four<S>) -> Four<S> {
    std::array::from_fn(|c| S::weighted(term[c], weight[c]))
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
            *pixel = std::array::from_fn(|c| pixel[c].with(term[c]));
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
    records: &mut [Record<S, N>],
    at: usize,
    (wx, wy): (&[Four<S>], &[Four<S>]),
    planes: &[Four<S>; N],
) {
    for (j, &wy) in wy.iter().enumerate() {
        let row: [Four<S>; N] = std::array::from_fn(|slot| weighted::<S>(planes[slot], wy));
        let from = at + j * STRIDE;
        for (record, &wx) in records[from..from + wx.len()].iter_mut().zip(wx) {
            for slot in 0..N {
                let term = weighted::<S>(row[slot], wx);
                for c in 0..4 {
                    record[slot][c] = record[slot][c].with(term[c]);
                }
            }
        }
    }
}

/// Returns the index of the first plane's weights of a voxel at depth phase `z` in the table of
/// `sections`, and their number.
#[inline(always)]
pub fn planes_of<S: FieldSum>(sections: &Sections, z: i32) -> &[Four<S>] {
    let (from, count) = sections.row(z);
    &S::taps(sections.field())[from..from + count]
}
