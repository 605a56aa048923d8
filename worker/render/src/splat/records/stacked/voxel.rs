//! What is looked up of a stacked voxel when it is added: where in the tables its weights begin.

use super::{COLUMNS, ROWS, Stacked};
use crate::splat::records::apart::lines::inside;
use crate::splat::records::apart::{Apart, Layers};
use crate::splat::records::{MOST, Record, Recorded};
use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS};
use std::arch::x86_64::*;

/// What is added, where and by which weights.
pub(super) type At<'a, S, const N: usize> = (
    &'a mut [Record<S, N>],
    (&'a Apart, &'a [<S as Recorded>::Payload]),
    &'a Layers<'a, S, N>,
    Stacked<'a>,
);

/// A voxel that is added.
pub(super) struct Voxel<'a, S: Recorded> {
    /// First column and row, and how many rows.
    pub(super) at: [usize; 2],
    pub(super) high: usize,
    /// Weights in depth, from its first sheet on.
    pub(super) deep: &'a [S::Depth],
    /// Those of the columns from the first on, zero where it has none.
    pub(super) across: &'a [S::Weight; COLUMNS],
    /// By slot, where in [the table down](Lookup::down) the weights of the rows from the first on begin. [`ROWS`]
    /// weights can be read from each, and what is none of the section's is zero.
    pub(super) begins: [u32; MOST],
}

/// Where voxels' weights are looked up.
pub(super) struct Lookup<'a, S: Recorded> {
    stacked: Stacked<'a>,
    /// Weights across and down: around each phase's there are [`ROWS`] zeros on either side.
    across: &'a [S::Weight],
    pub(super) down: &'a [S::Weight],
    deep: &'a [S::Depth],
    /// The slot of voxels' first sheet, and which sheet behind it each slot has.
    slot: usize,
    pub(super) turn: __m256i,
}

impl<'a, S: Recorded> Lookup<'a, S> {
    /// Of voxels whose first sheet is that of `layers`.
    ///
    /// # Safety
    /// For machines with AVX2.
    ///
    /// # Panics
    /// If tables have not as many zeros.
    #[inline(always)]
    pub(super) unsafe fn new<const N: usize>(
        layers: &Layers<'a, S, N>,
        stacked: Stacked<'a>,
    ) -> Self {
        assert_eq!(N, MOST, "records of eight sheets");
        let slot = layers.slot;
        let [across, down] = [0, 1].map(|axis| &layers.across[axis][slot]);
        let phases = &stacked.down;
        assert!(phases.begin(0) >= ROWS && across.len <= COLUMNS);
        assert!(down.weights.len() >= phases.begin(SUBPIXELS as usize - 1) + phases.len + ROWS);
        // SAFETY: the caller has the instructions.
        let turn = unsafe {
            let slots = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
            let after = _mm256_sub_epi32(slots, _mm256_set1_epi32(slot as i32));
            _mm256_and_si256(after, _mm256_set1_epi32(MOST as i32 - 1))
        };
        let (across, down, deep) = (across.weights, down.weights, layers.deep.weights);
        Lookup { stacked, across, down, deep, slot, turn }
    }

    /// Voxel `i`, in a window of `WIDE` columns.
    ///
    /// # Safety
    /// For machines with AVX2.
    #[inline(always)]
    pub(super) unsafe fn voxel<const WIDE: usize>(&self, apart: &Apart, i: usize) -> Voxel<'a, S> {
        let ([x, y], [_, high]) = apart.window(i, 1);
        debug_assert!(high <= ROWS, "what a frame's voxels have at most");
        let x = inside(x, WIDE);
        let deep = &self.deep[apart.deep[i] as usize..][..apart.left[i] as usize];
        // Zeros reach as far as a footprint may lie from where its window begins.
        let aside = apart.first[0][self.slot][i] - x as i32;
        let from = apart.from[0][self.slot][i].wrapping_add_signed(-aside) as usize;
        let across = self.across[from..].first_chunk().expect("a footprint in its window");
        // SAFETY: the caller has the instructions.
        let begins = unsafe { self.begins(apart.at[1][i], apart.deep[i], y as i32) };
        Voxel { at: [x, y], high: high.min(ROWS), deep, across, begins }
    }

    /// [`Voxel::begins`] for rows from `lo` on; `place`: where the voxel is itself; `deep`: where its sections begin in
    /// the table of what they are aside.
    #[inline(always)]
    unsafe fn begins(&self, place: i32, deep: u32, lo: i32) -> [u32; MOST] {
        let Stacked { subpixels, down } = &self.stacked;
        let aside: &[i32; MOST] =
            subpixels[deep as usize..].first_chunk().expect("a voxel's sheets");
        let mut begins = [0; MOST];
        // SAFETY: the caller has the instructions; eight numbers are 32 bytes.
        unsafe {
            let all = |n: i32| _mm256_set1_epi32(n);
            let places = _mm256_add_epi32(all(place), _mm256_loadu_si256(aside.as_ptr().cast()));
            let phase = _mm256_and_si256(places, all(SUBPIXELS - 1));
            let pixel = _mm256_srai_epi32::<{ SUBPIXEL_BITS as i32 }>(places);
            // All bits are minus one.
            let less = _mm256_cmpgt_epi32(phase, all(down.more_from() - 1));
            let first = _mm256_sub_epi32(pixel, less);
            // A section that is none of the window's may be as far off as zeros reach.
            let row = _mm256_add_epi32(first, all(down.first(0) - lo));
            let row = _mm256_max_epi32(row, all(-(down.len as i32)));
            let row = _mm256_min_epi32(row, all(ROWS as i32));
            let begin = _mm256_mullo_epi32(phase, all((down.begin(1) - down.begin(0)) as i32));
            let begin = _mm256_add_epi32(begin, all(down.begin(0) as i32));
            let begin = _mm256_permutevar8x32_epi32(_mm256_sub_epi32(begin, row), self.turn);
            _mm256_storeu_si256(begins.as_mut_ptr().cast(), begin);
        }
        begins
    }
}
