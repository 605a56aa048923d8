//! Voxels whose sections have footprints of their own, as in perspective: each lies elsewhere on
//! the screen and is of another width.
//!
//! A voxel's weights are put side by side by column and slot, and by row and slot
//! ([`Recorded::weave`]), so that all its sections are added to a pixel's record at once
//! ([`Recorded::splat_deep`]). With AVX2, AVX-512 and NEON, where windows are at most [`LINE`]
//! pixels wide, what lies in a window is worked out for many voxels at once (`lines`), and weights
//! are put side by side in registers.

use super::shear::Slant;
use super::{BySlot, MOST, Record, Recorded, RowAt, STRIDE, Table};
#[cfg(target_arch = "x86_64")]
use crate::kernels::Level;
use crate::kernels::Simd;
use crate::primitives::footprint::{Lean, Phases};
pub(crate) use crate::primitives::sizes::LINE;
use crate::primitives::sizes::PART;
use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS};

/// Number of voxels that are placed, shaded and splatted together.
pub const BATCH: usize = 64;

/// One value for each voxel of a batch.
pub type Each<T> = [T; BATCH];

/// Largest width of a window in pixels along an axis: a footprint of eight pixels a vox.
pub const WINDOW: usize = 40;

/// Places of a batch of voxels whose sections have footprints of their own. Arrays are by axis
/// (across, down), then slot, then voxel.
pub struct Apart {
    /// First pixel of each footprint, from the part's corner.
    pub first: [[Each<i32>; MOST]; 2],
    /// Index in the weight table at which each footprint's weights begin.
    pub from: [[Each<u32>; MOST]; 2],
    /// Positions of footprints, in subpixels from the part's corner; known where rows are offset
    /// from each other.
    pub places: [[Each<i32>; MOST]; 2],
    /// Positions of voxels, in subpixels from the part's corner; known where sections are offset
    /// from their voxels.
    pub at: [Each<i32>; 2],
    /// First pixel, by axis, of the window inside the part that holds all footprints of a voxel.
    pub lo: [Each<i32>; 2],
    /// One past the last pixel, by axis, of the window inside the part that holds all footprints of
    /// a voxel.
    pub hi: [Each<i32>; 2],
    /// Number of sheets that each voxel has left, counted from the one at hand.
    pub left: Each<i32>,
    /// Index at which each voxel's weights in depth begin, for the sheets it has left.
    pub deep: Each<u32>,
    /// Indices in the batch of the voxels to add.
    pub kept: Each<u32>,
}

impl Default for Apart {
    fn default() -> Self {
        Apart {
            first: [[[0; BATCH]; MOST]; 2],
            from: [[[0; BATCH]; MOST]; 2],
            places: [[[0; BATCH]; MOST]; 2],
            at: [[0; BATCH]; 2],
            lo: [[0; BATCH]; 2],
            hi: [[0; BATCH]; 2],
            left: [0; BATCH],
            deep: [0; BATCH],
            kept: [0; BATCH],
        }
    }
}

impl Apart {
    /// Offsets the sections of the first `n` voxels along `axis`. `aside` has the offset in each
    /// sheet for each depth phase, in subpixels
    /// ([`Leaning::subpixels`](crate::primitives::footprint::Leaning::subpixels)). `sheets` is the
    /// slot of the first sheet and the number of sheets. Sections behind a voxel's last may get any
    /// place.
    #[inline(always)]
    pub fn lean<const N: usize>(
        &mut self,
        simd: Simd,
        axis: usize,
        n: usize,
        aside: &[i32],
        sheets: (usize, usize),
    ) {
        let (places, at) = (&mut self.places[axis], &self.at[axis]);
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                lean::sixteen::<N>((places, &self.deep, at, aside), n, sheets)
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { lean::eight::<N>((places, &self.deep, at, aside), n, sheets) },
            _ => {
                let (first, sheets) = sheets;
                for sheet in 0..sheets.min(N) {
                    let place = &mut places[(first + sheet) % N];
                    for i in 0..n {
                        let which = self.deep[i] as usize + sheet;
                        place[i] = at[i] + aside[which.min(aside.len() - 1)];
                    }
                }
            }
        }
    }

    /// Begins windows of the first `n` voxels along `axis`.
    #[inline(always)]
    pub(crate) fn begin(&mut self, axis: usize, n: usize) {
        self.lo[axis][..n].fill(i32::MAX);
        self.hi[axis][..n].fill(i32::MIN);
    }

    /// Widens the windows to hold footprints of `len` pixels along `axis` in `slot`, of the voxels
    /// that have more than `sheets` sheets left.
    #[inline(always)]
    pub fn hold(&mut self, axis: usize, slot: usize, n: usize, (len, sheets): (i32, i32)) {
        let first = &self.first[axis][slot];
        let (lo, hi) = (&mut self.lo[axis], &mut self.hi[axis]);
        for i in 0..n {
            let here = sheets < self.left[i];
            lo[i] = lo[i].min(if here { first[i] } else { i32::MAX });
            hi[i] = hi[i].max(if here { first[i] + len } else { i32::MIN });
        }
    }

    /// Widens the windows across to hold footprints in `slot` whose rows are offset from each
    /// other: `row` is [`Lean::row_fixed`]. Rows must have been placed.
    #[inline(always)]
    pub fn hold_skewed(
        &mut self,
        slot: usize,
        n: usize,
        ([x, y], row): ([&Phases; 2], i64),
        sheets: i32,
    ) {
        for i in 0..n {
            let place = self.places.each_ref().map(|places| places[slot][i]);
            // The first and the last row lie farthest aside.
            let top = self.first[1][slot][i];
            let ends = [top, top + y.len as i32 - 1];
            let [a, b] = ends.map(|y| x.first_at(along_row(row, place, y)));
            if sheets < self.left[i] {
                self.lo[0][i] = self.lo[0][i].min(a.min(b));
                self.hi[0][i] = self.hi[0][i].max(a.max(b) + x.len as i32);
            }
        }
    }

    /// Clips the windows of the first `n` voxels along `axis` to the part.
    #[inline(always)]
    pub fn cut(&mut self, axis: usize, n: usize) {
        for lo in &mut self.lo[axis][..n] {
            *lo = (*lo).max(0);
        }
        for hi in &mut self.hi[axis][..n] {
            *hi = (*hi).min(PART);
        }
    }

    /// First column and row of the window of voxel `i`, and how many there are. Columns begin at a
    /// multiple of `step`, and so many they are.
    #[inline(always)]
    pub(crate) fn window(&self, i: usize, step: i32) -> ([usize; 2], [usize; 2]) {
        let [x, y] = [self.lo[0][i] / step * step, self.lo[1][i]];
        let wide = (self.hi[0][i] - x + step - 1) / step * step;
        ([x, y].map(|lo| lo as usize), [wide, self.hi[1][i] - y].map(|n| n as usize))
    }
}

/// [`Apart::lean`]: a voxel's sheets lie beside each other in the table, and voxels in what comes
/// out.
#[cfg(target_arch = "x86_64")]
mod lean {
    use super::{BATCH, Each, LINE};
    use crate::kernels::lanes::{Eight, Lanes, Sixteen};
    use crate::kernels::pixel_records::MOST;

    /// Arguments of a lean: positions of sections by slot, indices of voxels' weights in depth,
    /// positions of voxels, and offsets of sections.
    type At<'a> = (&'a mut [Each<i32>; MOST], &'a Each<u32>, &'a Each<i32>, &'a [i32]);

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(super) fn sixteen<const N: usize>(at: At<'_>, n: usize, sheets: (usize, usize)) {
        // SAFETY: these are the instructions.
        unsafe { some::<Sixteen, N>(at, n, sheets) }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    pub(super) fn eight<const N: usize>(at: At<'_>, n: usize, sheets: (usize, usize)) {
        // SAFETY: these are the instructions.
        unsafe { some::<Eight, N>(at, n, sheets) }
    }

    #[inline(always)]
    unsafe fn some<L: Lanes, const N: usize>(
        (places, deep, at, aside): At<'_>,
        n: usize,
        (first, sheets): (usize, usize),
    ) {
        let last = aside.len().checked_sub(MOST).expect("a voxel's sheets and more");
        for i in (0..n.min(BATCH)).step_by(L::LANES) {
            let some = i..i + L::LANES;
            // Those of no voxel at hand are anything.
            let mut which = [0; LINE];
            for (to, &deep) in which[..L::LANES].iter_mut().zip(&deep[some.clone()]) {
                *to = deep.min(last as u32);
            }
            // SAFETY: the caller's. Fours begin at most at the `last`, and four later; as many
            // lanes are left in what comes out.
            unsafe {
                let at = L::load(at[some.clone()].as_ptr().cast());
                for four in 0..sheets.min(N).div_ceil(4) {
                    let from = aside[4 * four..].as_ptr().cast();
                    for (j, aside) in L::fours(from, 1, which.as_ptr()).into_iter().enumerate() {
                        let place = &mut places[(first + 4 * four + j) % N];
                        L::store(place[some.clone()].as_mut_ptr().cast(), L::plus(at, aside));
                    }
                }
            }
        }
    }
}

/// Weights in the sheets that voxels reach, from the sheet of `slot` on.
#[derive(Clone, Copy)]
pub struct Layers<'a, S: Recorded, const N: usize> {
    /// Tables of the weights across and down the picture, by axis and slot.
    pub across: [[Table<'a, S::Weight>; N]; 2],
    /// Table of the weights in depth, a row for each depth phase.
    pub deep: Table<'a, S::Depth>,
    /// Slot of the first sheet, 0 to N - 1.
    pub slot: usize,
    /// Whether a voxel has the same columns, with the same weights, in all these sheets.
    pub alike: bool,
    /// Offsets of sections from each other, where places are looked up as voxels are added (shear);
    /// else `None`.
    pub slant: Option<Slant<'a>>,
}

impl<'a, S: Recorded, const N: usize> Layers<'a, S, N> {
    /// Weights in depth of voxel `i`, by slot.
    #[inline(always)]
    pub(super) fn depths(&self, apart: &Apart, i: usize) -> BySlot<S::Depth, N> {
        let weights = &self.deep.weights[apart.deep[i] as usize..][..apart.left[i] as usize];
        let mut deep = [S::Depth::default(); N];
        for (sheet, &w) in weights.iter().enumerate() {
            deep[(self.slot + sheet) % N] = w;
        }
        deep
    }

    /// Weights of voxel `i` along `axis`, in a window that begins at `lo`.
    #[inline(always)]
    fn rows(&self, apart: &Apart, i: usize, axis: usize, lo: usize) -> [RowAt<'a, S::Weight>; N] {
        // Loops, since closures of arrays are compiled for the baseline.
        let mut rows = [RowAt::NONE; N];
        for (at, row) in rows.iter_mut().enumerate() {
            let Table { weights: table, len } = self.across[axis][at];
            *row = RowAt::none_of(table);
            if self.after(at) < apart.left[i] {
                let from = apart.from[axis][at][i] as usize;
                *row = RowAt { table, from, len, column: apart.first[axis][at][i] - lo as i32 };
            }
        }
        rows
    }

    /// Returns by how many sheets the next sheet of `slot` lies behind the first one.
    #[inline(always)]
    pub fn after(&self, slot: usize) -> i32 {
        after::<N>(self.slot, slot)
    }
}

/// Returns by how many sheets the next sheet of `slot` lies behind the one that slot `first` holds,
/// 0 to N - 1.
#[inline(always)]
pub fn after<const N: usize>(first: usize, slot: usize) -> i32 {
    ((slot + N - first) % N) as i32
}

/// Memory for weights of one voxel that are put side by side, by column or row and slot.
pub struct Woven<W, const N: usize> {
    /// By slot, of a window's columns and of its rows.
    by_slot: [[BySlot<W, N>; WINDOW]; 2],
    /// Across and down.
    #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
    pub(super) spans: [lines::Spans<N>; 2],
}

impl<W: Copy + Default, const N: usize> Default for Woven<W, N> {
    fn default() -> Self {
        Woven {
            by_slot: [[[W::default(); N]; WINDOW]; 2],
            #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
            spans: Default::default(),
        }
    }
}

/// Arguments of [`Recorded::splat_apart`] for windows of a known width.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(super) type ApartAt<'a, S, const N: usize> = (
    &'a mut [Record<S, N>],
    (&'a Apart, &'a [<S as Recorded>::Payload]),
    &'a Layers<'a, S, N>,
    &'a mut [lines::Spans<N>; 2],
);

/// [`Recorded::splat_apart`], voxel by voxel.
#[inline(always)]
pub(super) fn splat_apart<S: Recorded, const N: usize>(
    simd: Simd,
    records: &mut [Record<S, N>],
    (apart, payloads): (&Apart, &[S::Payload]),
    layers: &Layers<'_, S, N>,
    woven: &mut Woven<S::Weight, N>,
) {
    for (&i, &payload) in apart.kept.iter().zip(payloads) {
        let i = i as usize % BATCH;
        let ([x, y], wide) = apart.window(i, S::step::<N>());
        let deep = layers.depths(apart, i);
        for (axis, lo) in [x, y].into_iter().enumerate() {
            let rows = layers.rows(apart, i, axis, lo);
            S::weave(simd, rows, wide[axis], &mut woven.by_slot[axis]);
        }
        let [columns, lines] = [0, 1].map(|axis| &woven.by_slot[axis][..wide[axis]]);
        S::splat_deep(simd, records, y * STRIDE + x, (columns, lines), payload, &deep);
    }
}

/// Returns the middle along x, in subpixels, of row `y` of a footprint at `place`; `row` is
/// [`Lean::row_fixed`].
#[inline(always)]
pub(crate) fn along_row(row: i64, [x, y_of]: [i32; 2], y: i32) -> i32 {
    let middle = (y << SUBPIXEL_BITS) + SUBPIXELS / 2;
    x + Lean::along_row(row, i64::from(middle - y_of)) as i32
}

/// Adds voxels as [`Recorded::splat_apart`] does, where rows are offset from each other, too: each
/// row has weights of its own. `row` is [`Lean::row_fixed`]; `phases` has the layout of the weights
/// across in each slot.
#[inline(always)]
pub fn splat_skewed<S: Recorded, const N: usize>(
    simd: Simd,
    records: &mut [Record<S, N>],
    (apart, payloads): (&Apart, &[S::Payload]),
    (layers, (row, phases)): (&Layers<'_, S, N>, (i64, &[Phases; N])),
    woven: &mut Woven<S::Weight, N>,
) {
    for (&i, &payload) in apart.kept.iter().zip(payloads) {
        let i = i as usize % BATCH;
        let ([x, y], [wide, high]) = apart.window(i, S::step::<N>());
        let deep = layers.depths(apart, i);
        let [columns, lines] = &mut woven.by_slot;
        S::weave(simd, layers.rows(apart, i, 1, y), high, lines);
        for (line, y) in (y..y + high).enumerate() {
            let mut rows = [RowAt::NONE; N];
            for (at, to) in rows.iter_mut().enumerate() {
                let Table { weights: table, len } = layers.across[0][at];
                *to = RowAt::none_of(table);
                if layers.after(at) < apart.left[i] {
                    let place = [apart.places[0][at][i], apart.places[1][at][i]];
                    let place = along_row(row, place, y as i32);
                    let phase = place & (SUBPIXELS - 1);
                    let column = (place >> SUBPIXEL_BITS) + phases[at].first(phase) - x as i32;
                    *to = RowAt { table, from: phases[at].begin(phase as usize), len, column };
                }
            }
            S::weave(simd, rows, wide, columns);
            let across = (&columns[..wide], &lines[line..=line]);
            S::splat_deep(simd, records, y * STRIDE + x, across, payload, &deep);
        }
    }
}

#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(super) mod lines {
    use super::{Apart, BATCH, Each, LINE, Layers};
    use crate::kernels::lanes::Lanes;
    use crate::kernels::pixel_records::Recorded;
    use crate::primitives::sizes::PART;
    use std::ops::Range;

    /// Columns that the windows of all voxels fit which are added, a multiple of the step, which is
    /// 1 or 2; `None` if there are windows of more than [`LINE`] pixels.
    #[inline(always)]
    pub(crate) fn widest(apart: &Apart, kept: &[u32], step: i32) -> Option<usize> {
        let n = kept.last().map_or(0, |&last| last as usize % BATCH + 1);
        // Of all, since loops over numbers beside each other are fast; few are left out.
        let most = [0, 1].map(|axis| {
            let step = if axis == 0 { step } else { 1 };
            let ends = apart.lo[axis][..n].iter().zip(&apart.hi[axis][..n]);
            let wide = ends.map(|(&lo, &hi)| (hi - (lo & -step) + step - 1) & -step);
            wide.fold(0, i32::max) as usize
        });
        most.iter().all(|&most| most <= LINE).then_some(most[0])
    }

    /// First column of a window of `wide` columns from `first`, moved to lie inside the part.
    #[inline(always)]
    pub(crate) fn inside(first: usize, wide: usize) -> usize {
        first.min(PART as usize - wide)
    }

    /// Spans of weights along an axis: for each slot and voxel the pixels that have a weight. The
    /// arrays are kilobytes and a bucket may have few voxels, so they are reused from bucket to
    /// bucket; entries behind the bucket's voxels are stale.
    pub(crate) struct Spans<const N: usize> {
        /// Pixels of a window that have a weight, a bit each.
        present: [Each<u32>; N],
        /// Index at which the weight of a window's first pixel would be.
        at: [Each<i32>; N],
    }

    impl<const N: usize> Default for Spans<N> {
        fn default() -> Self {
            Spans { present: [[0; BATCH]; N], at: [[0; BATCH]; N] }
        }
    }

    /// Weights in each slot along an axis for windows of at most [`LINE`] pixels. Those that are
    /// present lie in the slot's weights.
    pub(crate) struct Lines<'a, W, const N: usize> {
        spans: &'a Spans<N>,
        weights: [&'a [W]; N],
    }

    impl<'a, W, const N: usize> Lines<'a, W, N> {
        /// Returns the weights across and down of the voxels in `kept`, which ascends. Windows
        /// begin at columns that are multiples of `step` and are moved inside to be `wide` columns;
        /// they may have any number of rows. Columns that are alike are those of the first slot
        /// alone.
        ///
        /// # Safety
        /// For machines with the instructions of `L`.
        #[inline(always)]
        pub(crate) unsafe fn both<L: Lanes, S: Recorded<Weight = W>>(
            apart: &Apart,
            kept: &[u32],
            layers: &Layers<'a, S, N>,
            [across, down]: &'a mut [Spans<N>; 2],
            (wide, step): (usize, i32),
        ) -> [Lines<'a, W, N>; 2] {
            let n = kept.last().map_or(0, |&last| last as usize % BATCH + 1);
            // SAFETY: the caller has the instructions.
            unsafe {
                let slots = if layers.alike { layers.slot..layers.slot + 1 } else { 0..N };
                let across = Lines::new::<L, S>(apart, layers, across, n, (0, slots, wide, step));
                let down = Lines::new::<L, S>(apart, layers, down, n, (1, 0..N, 0, 1));
                [across, down]
            }
        }

        /// Returns the weights of the first `n` voxels along `axis` in some slots, under the rules
        /// of [`Lines::both`].
        #[inline(always)]
        unsafe fn new<L: Lanes, S: Recorded<Weight = W>>(
            apart: &Apart,
            layers: &Layers<'a, S, N>,
            spans: &'a mut Spans<N>,
            n: usize,
            (axis, slots, wide, step): (usize, Range<usize>, usize, i32),
        ) -> Lines<'a, W, N> {
            let mut weights: [&[W]; N] = [&[]; N];
            for slot in 0..N {
                if !slots.contains(&slot) {
                    spans.present[slot] = [0; BATCH];
                    continue;
                }
                let table = &layers.across[axis][slot];
                weights[slot] = table.weights;
                let last = table.weights.len().checked_sub(table.len).expect("a row of the table");
                let [last, len] = [last, table.len].map(|n| n.min(i32::MAX as usize) as i32);
                for i in (0..n.min(BATCH)).step_by(L::LANES) {
                    let some = i..i + L::LANES;
                    let lo = apart.lo[axis][some.clone()].as_ptr().cast();
                    let first = apart.first[axis][slot][some.clone()].as_ptr().cast();
                    let from = apart.from[axis][slot][some.clone()].as_ptr();
                    let bits_to = spans.present[slot][some.clone()].as_mut_ptr();
                    let from_to = spans.at[slot][some].as_mut_ptr().cast();
                    // SAFETY: as many lanes as there are begin at each.
                    unsafe {
                        let mut lo = L::load(lo);
                        if axis == 0 {
                            lo = L::min(L::and(lo, L::set(-step)), L::set(PART - wide as i32));
                        }
                        let column = L::minus(L::load(first), lo);
                        // From a footprint's first pixel to behind its last, of those that are
                        // looked at. In sheets that a voxel does not reach there may be some: its
                        // section is nothing there.
                        let (zero, one, line) = (L::set(0), L::set(1), L::set(LINE as i32));
                        let begin = L::min(L::max(column, zero), line);
                        let end = L::min(L::max(L::plus(column, L::set(len)), zero), line);
                        let bits = L::minus(L::up_each(one, end), L::up_each(one, begin));
                        L::store(bits_to, bits);
                        // What is read lies in the table, whatever a begin says.
                        let from = L::max(L::min(L::load(from), L::set(last)), zero);
                        L::store(from_to, L::minus(from, column));
                    }
                }
            }
            Lines { spans, weights }
        }

        /// Returns which weights of voxel `i` there are in `slot`, a bit each, and where that of
        /// the first pixel would lie.
        #[inline(always)]
        pub(crate) fn of(&self, slot: usize, i: usize) -> (u32, *const W) {
            let from = self.weights[slot].as_ptr();
            (self.spans.present[slot][i], from.wrapping_offset(self.spans.at[slot][i] as isize))
        }

        /// Returns [`Lines::of`] with [`LINE`] weights from that of the first pixel on, where the
        /// table has them all.
        #[inline(always)]
        pub(crate) fn around(&self, slot: usize, i: usize) -> (u32, Option<&'a [W; LINE]>) {
            let around = usize::try_from(self.spans.at[slot][i]).ok();
            let around = around.and_then(|at| self.weights[slot].get(at..)?.first_chunk());
            (self.spans.present[slot][i], around)
        }

        /// One by one, what is not present zero.
        pub(crate) fn one_by_one(&self, slot: usize, i: usize) -> [W; LINE]
        where
            W: Copy + Default,
        {
            std::array::from_fn(|j| {
                let is_present = self.spans.present[slot][i] >> j & 1 == 1;
                let at = self.spans.at[slot][i] + j as i32;
                if is_present { self.weights[slot][at as usize] } else { W::default() }
            })
        }
    }
}
