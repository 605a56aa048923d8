//! Look-ups for one sheared voxel as it is added: the indices in the tables at which the weights of
//! its sections begin.

use super::{COLUMNS, ROWS, Slant};
use crate::kernels::pixel_records::sheet_offsets::lines::inside;
use crate::kernels::pixel_records::sheet_offsets::{Apart, BATCH, LINE, Layers};
use crate::kernels::pixel_records::{MOST, Record, Recorded};
use crate::primitives::footprint::Phases;
use crate::primitives::sizes::PART;
use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS};
use std::arch::x86_64::*;

/// Sums, places and weights of one call.
pub(super) type At<'a, S, const N: usize> = (
    &'a mut [Record<S, N>],
    (&'a Apart, &'a [<S as Recorded>::Payload]),
    &'a Layers<'a, S, N>,
    Slant<'a>,
);

/// By slot, where in a table the weights of a section begin for rows or columns from some one on.
/// As many weights can be read from each as there may be rows or columns, and what is none of the
/// section's is zero.
pub(super) type Begins = [u32; MOST];

/// A voxel that is added.
pub(super) struct Voxel<'a, S: Recorded> {
    /// First row, and how many.
    pub(super) y: usize,
    pub(super) high: usize,
    /// Weights in depth, from its first sheet on.
    pub(super) deep: &'a [S::Depth],
    /// Of its rows.
    pub(super) begins: Begins,
}

/// Tables in which voxels' weights are looked up.
pub(super) struct Lookup<'a, S: Recorded> {
    slant: Slant<'a>,
    /// Weights across and down: around each phase's there are [`ROWS`] zeros on either side.
    pub(super) across: &'a [S::Weight],
    pub(super) down: &'a [S::Weight],
    deep: &'a [S::Depth],
    /// The slot of voxels' first sheet, and which sheet behind it each slot has.
    slot: usize,
    pub(super) turn: __m256i,
}

/// Rows of a voxel, one after the other.
pub(super) struct Rows<'a> {
    across: &'a Phases,
    /// By slot, where a section's middle is in subpixels, and which are none of the voxel's: the
    /// greatest number in their lanes, and the least in others.
    places: __m256i,
    none: __m256i,
    /// How far the row that comes is aside of that in units of 2^-16 subpixels, by every other
    /// slot, and how much farther the one after is.
    even: __m256i,
    odd: __m256i,
    step: __m256i,
}

impl<'a, S: Recorded> Lookup<'a, S> {
    /// Of voxels whose first sheet is that of `layers`.
    ///
    /// # Safety
    /// For machines with AVX2, as all here.
    ///
    /// # Panics
    /// If tables have not as many zeros.
    #[inline(always)]
    pub(super) unsafe fn new<const N: usize>(layers: &Layers<'a, S, N>, slant: Slant<'a>) -> Self {
        assert_eq!(N, MOST, "records of eight sheets");
        let slot = layers.slot;
        let [across, down] = [0, 1].map(|axis| {
            let (weights, phases) = (layers.across[axis][slot].weights, &slant.phases[axis]);
            assert!(phases.begin(0) >= ROWS && slant.wide <= COLUMNS);
            assert!(weights.len() >= phases.begin(SUBPIXELS as usize - 1) + phases.len + ROWS);
            assert!(phases.begin(1) - phases.begin(0) < 1 << 15);
            weights
        });
        // SAFETY: the caller has the instructions.
        let turn = unsafe {
            let slots = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
            let after = _mm256_sub_epi32(slots, _mm256_set1_epi32(slot as i32));
            _mm256_and_si256(after, _mm256_set1_epi32(MOST as i32 - 1))
        };
        Lookup { slant, across, down, deep: layers.deep.weights, slot, turn }
    }

    /// Voxel `i`.
    #[inline(always)]
    pub(super) unsafe fn voxel(&self, apart: &Apart, i: usize) -> Voxel<'a, S> {
        let ([_, y], [_, high]) = apart.window(i, 1);
        debug_assert!(high <= ROWS, "what a frame's voxels have at most");
        let deep = &self.deep_from(apart, i)[..apart.left[i] as usize];
        // SAFETY: the caller has the instructions.
        let begins = unsafe {
            let (first, phase) = firsts(self.places(apart, i, 1), &self.slant.phases[1]);
            begins((first, phase), y as i32, &self.slant.phases[1])
        };
        Voxel { y, high: high.min(ROWS), deep, begins }
    }

    /// Returns the table in depth from the first weight of voxel `i` on.
    #[inline(always)]
    pub(super) fn deep_from(&self, apart: &Apart, i: usize) -> &'a [S::Depth] {
        &self.deep[apart.deep[i] as usize..]
    }

    /// The first column of voxel `i` in a window of `WIDE` columns, and the weights from there on:
    /// the same in all sheets.
    #[inline(always)]
    pub(super) fn columns<const WIDE: usize>(
        &self,
        apart: &Apart,
        i: usize,
    ) -> (usize, &'a [S::Weight; LINE]) {
        let ([x, _], _) = apart.window(i, 1);
        let x = inside(x, WIDE);
        // Zeros reach as far as a footprint may lie from where its window begins.
        let aside = apart.first[0][self.slot][i] - x as i32;
        let from = apart.from[0][self.slot][i].wrapping_add_signed(-aside) as usize;
        (x, self.across[from..].first_chunk().expect("a footprint in its window"))
    }

    /// Rows of voxel `i` from row `y` on.
    #[inline(always)]
    pub(super) unsafe fn rows(&self, apart: &Apart, i: usize, y: usize) -> Rows<'_> {
        let row = self.slant.row;
        // SAFETY: the caller has the instructions.
        unsafe {
            let middle = (y as i32) * SUBPIXELS + SUBPIXELS / 2;
            let below = _mm256_sub_epi32(_mm256_set1_epi32(middle), self.places(apart, i, 1));
            let [even, odd] = along(row, below);
            Rows {
                across: &self.slant.phases[0],
                places: self.places(apart, i, 0),
                none: none(apart, i, self.turn),
                even,
                odd,
                step: _mm256_set1_epi64x(i64::from(row) * i64::from(SUBPIXELS)),
            }
        }
    }

    /// Returns the positions of the sections of voxel `i` along an axis, by slot.
    #[inline(always)]
    unsafe fn places(&self, apart: &Apart, i: usize, axis: usize) -> __m256i {
        // SAFETY: the caller has the instructions.
        unsafe { _mm256_permutevar8x32_epi32(places(&self.slant, apart, i, axis), self.turn) }
    }
}

impl Rows<'_> {
    /// The first column of the next row in a window of `WIDE` columns, which holds what it has of
    /// all sections, and where the weights from there on begin.
    #[inline(always)]
    pub(super) unsafe fn next<const WIDE: usize>(&mut self) -> (usize, Begins) {
        // SAFETY: the caller has the instructions.
        unsafe {
            let aside = in_subpixels([self.even, self.odd]);
            self.even = _mm256_add_epi64(self.even, self.step);
            self.odd = _mm256_add_epi64(self.odd, self.step);
            let (first, phase) = firsts(_mm256_add_epi32(self.places, aside), self.across);
            let least = _mm256_max_epi32(first, self.none);
            let halves = (_mm256_castsi256_si128(least), _mm256_extracti128_si256::<1>(least));
            let least = _mm_min_epi32(halves.0, halves.1);
            let least = _mm_min_epi32(least, _mm_shuffle_epi32::<0b01_00_11_10>(least));
            let least = _mm_min_epi32(least, _mm_shuffle_epi32::<0b10_11_00_01>(least));
            let x = inside(_mm_cvtsi128_si32(least).max(0) as usize, WIDE);
            (x, begins((first, phase), x as i32, self.across))
        }
    }
}

/// Finds the [windows](Apart::lo) of the first `n` voxels, whose sections are skewed: what
/// [`Apart::hold_skewed`] and [`Apart::cut`] do, of all sections of a voxel at once.
///
/// # Safety
/// For machines with AVX2.
#[inline(always)]
pub(super) unsafe fn windows(slant: &Slant<'_>, apart: &mut Apart, n: usize) {
    let [x, y] = &slant.phases;
    // SAFETY: the caller has the instructions; four numbers are 16 bytes.
    unsafe {
        let all = |n: i32| _mm256_set1_epi32(n);
        let sheets = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
        for i in 0..n.min(BATCH) {
            // Not in closures, which may be compiled for the baseline.
            let (at_x, at_y) = (places(slant, apart, i, 0), places(slant, apart, i, 1));
            let none = none(apart, i, sheets);
            let top = firsts(at_y, y).0;
            // The first and the last row lie farthest aside.
            let below = _mm256_slli_epi32::<{ SUBPIXEL_BITS as i32 }>(top);
            let below = _mm256_sub_epi32(_mm256_add_epi32(below, all(SUBPIXELS / 2)), at_y);
            let last = _mm256_add_epi32(below, all((y.len as i32 - 1) * SUBPIXELS));
            let a = firsts(_mm256_add_epi32(at_x, in_subpixels(along(slant.row, below))), x).0;
            let b = firsts(_mm256_add_epi32(at_x, in_subpixels(along(slant.row, last))), x).0;
            let across = ends(_mm256_min_epi32(a, b), _mm256_max_epi32(a, b), none);
            let down = ends(top, top, none);
            let low = _mm256_unpacklo_epi64(across, down);
            let ends = _mm256_max_epi32(low, _mm256_unpackhi_epi64(across, down));
            let halves = (_mm256_castsi256_si128(ends), _mm256_extracti128_si256::<1>(ends));
            let mut ends = [0; 4];
            _mm_storeu_si128(ends.as_mut_ptr().cast(), _mm_max_epi32(halves.0, halves.1));
            for (axis, len) in [x.len, y.len].into_iter().enumerate() {
                apart.lo[axis][i] = (-ends[2 * axis]).max(0);
                apart.hi[axis][i] = (ends[2 * axis + 1] + len as i32).min(PART);
            }
        }
    }
}

/// The least of some numbers with the other sign and the greatest of others, by turns, but for
/// those of [no section](none): two in each half.
#[inline(always)]
unsafe fn ends(least: __m256i, greatest: __m256i, none: __m256i) -> __m256i {
    // SAFETY: the caller has the instructions.
    unsafe {
        let least = _mm256_sub_epi32(_mm256_setzero_si256(), _mm256_max_epi32(least, none));
        let some = _mm256_xor_si256(none, _mm256_set1_epi32(-1));
        let greatest = _mm256_min_epi32(greatest, some);
        let low = _mm256_unpacklo_epi32(least, greatest);
        _mm256_max_epi32(low, _mm256_unpackhi_epi32(least, greatest))
    }
}

/// Returns the positions of the sections of voxel `i` along an axis, from its first sheet on.
#[inline(always)]
unsafe fn places(slant: &Slant<'_>, apart: &Apart, i: usize, axis: usize) -> __m256i {
    let aside = slant.subpixels[axis][apart.deep[i] as usize..].first_chunk::<MOST>();
    let aside = aside.expect("a voxel's sheets").as_ptr();
    // SAFETY: the caller has the instructions; eight numbers are 32 bytes.
    unsafe {
        let at = _mm256_set1_epi32(apart.at[axis][i]);
        _mm256_add_epi32(at, _mm256_loadu_si256(aside.cast()))
    }
}

/// Compares `sheets`, counted from voxel `i`'s first, with the sheets that it reaches: `i32::MIN`
/// in lanes of sheets that it reaches, `i32::MAX` in the others.
#[inline(always)]
unsafe fn none(apart: &Apart, i: usize, sheets: __m256i) -> __m256i {
    // SAFETY: the caller has the instructions.
    unsafe {
        let reached = _mm256_cmpgt_epi32(_mm256_set1_epi32(apart.left[i]), sheets);
        _mm256_xor_si256(reached, _mm256_set1_epi32(i32::MAX))
    }
}

/// How far rows are aside that lie so many subpixels below the middle of a footprint, in units of
/// 2^-16 subpixels, to be rounded down: every other one, and those between
/// ([`Lean::along_row`](slabcast_common::kernel::Lean::along_row)).
#[inline(always)]
unsafe fn along(row: i32, below: __m256i) -> [__m256i; 2] {
    // SAFETY: the caller has the instructions.
    unsafe {
        let (row, half) = (_mm256_set1_epi32(row), _mm256_set1_epi64x(1 << 15));
        let even = _mm256_mul_epi32(row, below);
        let odd = _mm256_mul_epi32(row, _mm256_srli_epi64::<32>(below));
        [_mm256_add_epi64(even, half), _mm256_add_epi64(odd, half)]
    }
}

/// [Those](along), rounded: of numbers of 64 bits those from the 16th on.
#[inline(always)]
unsafe fn in_subpixels([even, odd]: [__m256i; 2]) -> __m256i {
    // SAFETY: the caller has the instructions.
    unsafe {
        let (even, odd) = (_mm256_srli_epi64::<16>(even), _mm256_slli_epi64::<16>(odd));
        _mm256_blend_epi32::<0b1010_1010>(even, odd)
    }
}

/// The first pixels of footprints at some places, and their phases.
#[inline(always)]
unsafe fn firsts(places: __m256i, phases: &Phases) -> (__m256i, __m256i) {
    // SAFETY: the caller has the instructions.
    unsafe {
        let all = |n: i32| _mm256_set1_epi32(n);
        let phase = _mm256_and_si256(places, all(SUBPIXELS - 1));
        let pixel = _mm256_srai_epi32::<{ SUBPIXEL_BITS as i32 }>(places);
        // All bits are minus one.
        let less = _mm256_cmpgt_epi32(phase, all(phases.more_from() - 1));
        (_mm256_sub_epi32(_mm256_add_epi32(pixel, all(phases.first(0))), less), phase)
    }
}

/// Returns the indices at which the weights of [those](firsts) begin for pixels from `lo` on.
#[inline(always)]
unsafe fn begins((first, phase): (__m256i, __m256i), lo: i32, phases: &Phases) -> Begins {
    let mut begins = [0; MOST];
    // SAFETY: the caller has the instructions; eight numbers are 32 bytes.
    unsafe {
        let all = |n: i32| _mm256_set1_epi32(n);
        // A section that has none of these may be as far off as zeros reach.
        let row = _mm256_sub_epi32(first, all(lo));
        let row = _mm256_max_epi32(row, all(-(phases.len as i32)));
        let row = _mm256_min_epi32(row, all(ROWS as i32));
        // Both are below 2^15.
        let begin = _mm256_madd_epi16(phase, all((phases.begin(1) - phases.begin(0)) as i32));
        let begin = _mm256_add_epi32(begin, all(phases.begin(0) as i32));
        _mm256_storeu_si256(begins.as_mut_ptr().cast(), _mm256_sub_epi32(begin, row));
    }
    begins
}
