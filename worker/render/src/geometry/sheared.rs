//! Parts of orthographic views whose kernel leans, in whole-number sums.
//!
//! Positions are integers, as in [`crate::geometry::ortho`]. A voxel's sections lie beside it by a
//! number of subpixels that the phase of its depth decides ([`Leaning`]), and so may their rows.
//! They are added as those of perspective views are ([`crate::geometry::perspective`]), or, where
//! footprints are small, as [`shear`] says.

use crate::geometry::batch::{Axes, Batch};
use crate::geometry::open_sheets::{Chunk, Due, EDGE, Queues, Sheets, Stage, Store, slot, walk};
use crate::geometry::ortho::toss;
use crate::kernels::pixel_records::shear::{self, Slant};
use crate::kernels::pixel_records::sheet_offsets::{Apart, BATCH, WINDOW, Woven, after};
use crate::kernels::pixel_records::{MOST, Recorded, Splat};
use crate::kernels::toss::{Packing, Tossing};
use crate::kernels::{Simd, Work, whole_registers};
use crate::part::{Io, Part, Pixels};
use crate::primitives::footprint::Leaning;
use crate::primitives::sizes::PART;
use crate::scene::{Flat, Frame};
use crate::visibility::open_mask::OpenMask;
use slabcast_common::message::Counters;
use slabcast_common::view::SUBPIXELS;

/// Memory for waiting voxels that a render thread keeps from part to part.
#[derive(Default)]
pub(crate) struct Waiting {
    queues: Queues<Splat>,
    tossing: Tossing,
    batch: Box<Batch>,
}

/// Constants for drawing parts of a view whose kernel leans: integer positions and the offsets of
/// sections.
#[derive(Clone, Copy)]
pub struct Lean<'a> {
    /// Integer positions of voxels in the view, and the reach of their footprints.
    pub flat: &'a Flat,
    leaning: &'a Leaning,
}

/// Returns the constants for drawing parts of `frame` with a leaning kernel; `None` if the view
/// needs another way.
pub fn accepts(frame: &Frame) -> Option<Lean<'_>> {
    let (flat, leaning) = (frame.flat.as_ref()?, frame.leaning.as_ref()?);
    let fits = flat.reach.iter().all(|reach| 2 * reach + 2 < WINDOW as i32);
    fits.then_some(Lean { flat, leaning })
}

/// Draws a part in records of eight sheets, since few kernels that lean fit four, as work that is
/// compiled once for each instruction set.
pub struct RenderSheared<'a, S: Recorded> {
    pub(crate) part: Part<'a>,
    pub(crate) lean: Lean<'a>,
    pub(crate) store: &'a mut Store<S>,
    pub(crate) waiting: &'a mut Waiting,
    pub(crate) pixels: &'a mut Pixels,
    pub(crate) io: Io<'a>,
}

impl<S: Recorded> Work for RenderSheared<'_, S> {
    type Out = ();
    #[inline(always)]
    fn run(self, simd: Simd) {
        let RenderSheared { part, lean, store, waiting, pixels, io } = self;
        let footprint = part.frame.footprints.at(0).expect("a flat view's sheets are all drawn");
        let mut axes = Axes::new(part.frame, 0, &footprint);
        let Waiting { queues, tossing, batch } = waiting;
        if shear::in_lanes::<S>(simd) {
            let phases = axes.phases.each_ref().map(|phases| phases[0]);
            axes.layers.slant = lean.leaning.slant(phases);
        }
        let across = Woven::default();
        let stage = LeaningStage { part: &part, simd, lean, axes, tossing, batch, across };
        let sheets = Sheets::<S, MOST>::new(simd, store, part.frame.sections.most());
        walk(&part, stage, sheets, queues, pixels, io);
    }
}

struct LeaningStage<'a, S: Recorded, const N: usize> {
    part: &'a Part<'a>,
    simd: Simd,
    lean: Lean<'a>,
    /// Weights across and down, the same in all sheets.
    axes: Axes<'a, S, N>,
    tossing: &'a mut Tossing,
    batch: &'a mut Batch,
    /// Weights of the voxel at hand by column and by row.
    across: Woven<S::Weight, N>,
}

impl<S: Recorded, const N: usize> Stage<Sheets<'_, S, N>> for LeaningStage<'_, S, N> {
    type Voxel = Splat;

    #[inline(always)]
    fn reach(&self) -> [i32; 2] {
        self.lean.flat.reach
    }

    #[inline(always)]
    fn toss(
        &mut self,
        which: usize,
        open: &OpenMask,
        queues: &mut Queues<Splat>,
        counters: &mut Counters,
    ) {
        let asked = (which, open, queues, counters);
        toss(self.part, self.simd, self.lean.flat, Packing::Aside, self.tossing, asked);
    }

    #[inline(always)]
    fn splat(
        &mut self,
        due: &Due<'_, Splat>,
        k: i32,
        sheets: &mut Sheets<'_, S, N>,
        open: &OpenMask,
        counters: &mut Counters,
    ) {
        for some in due.chunks(BATCH) {
            let n = self.take(&some, k, open);
            self.add(n, k, sheets, open, (some.len(), counters));
        }
    }
}

impl<S: Recorded, const N: usize> LeaningStage<'_, S, N> {
    /// Takes over those of `some` voxels, which are due at sheet `k`, near which anything is open;
    /// says how many.
    #[inline(always)]
    fn take(&mut self, some: &Chunk<'_, Splat>, k: i32, open: &OpenMask) -> usize {
        let most = self.part.frame.sections.most() as i32;
        let cull = self.part.frame.scene.quality.cull;
        some.keep(k, |n, v, gone| {
            self.put(n, v, most - gone);
            !cull | open.is_near(v.cell())
        })
    }

    /// Takes over `v`, which has `left` sheets left, as voxel `i` of the batch.
    #[inline(always)]
    fn put(&mut self, i: usize, v: &Splat, left: i32) {
        let most = self.part.frame.sections.most() as i32;
        let Batch { samples, normals, apart, .. } = &mut *self.batch;
        [apart.at[0][i], apart.at[1][i]] = v.aside_of();
        (samples[i], normals[i], apart.left[i]) = (v.sample, v.normal(), left);
        apart.deep[i] = v.phase() * most as u32 + (most - left) as u32;
    }

    /// Places each section of the first `n` voxels of the batch, and the windows that hold all of a
    /// voxel's.
    #[inline(always)]
    fn place(&mut self, n: usize, k: i32) {
        let n = whole_registers::<BATCH>(n);
        let apart = &mut self.batch.apart;
        let Lean { leaning, .. } = self.lean;
        let most = self.part.frame.sections.most() as i32;
        let row = leaning.row();
        // Rows first, since columns may hang on them.
        for axis in [1, 0] {
            apart.begin(axis, n);
            let phases = &self.axes.phases[axis][0];
            let aside = (leaning.most(axis) > 0.0).then(|| leaning.subpixels(axis));
            if let Some(aside) = aside {
                let from = (slot::<N>(k), most as usize);
                apart.lean::<N>(self.simd, axis, n, aside, from);
            }
            let skewed = axis == 0 && row != 0;
            let mut before = None;
            for at in 0..N {
                let sheet = after::<N>(slot::<N>(k), at);
                if sheet >= most {
                    continue;
                }
                let Apart { first, from, places, at: own, .. } = &mut *apart;
                if let Some(before) = before.filter(|_| aside.is_none() && !skewed) {
                    // All in one place, also those of sheets that a voxel has no more.
                    first[axis][at] = first[axis][before];
                    from[axis][at] = from[axis][before];
                    places[axis][at] = places[axis][before];
                    continue;
                }
                before = Some(at);
                let place = &mut places[axis][at];
                if aside.is_none() {
                    place[..n].copy_from_slice(&own[axis][..n]);
                }
                if skewed {
                    let phases = [phases, &self.axes.phases[1][0]];
                    apart.hold_skewed(at, n, (phases, row), sheet);
                    continue;
                }
                for i in 0..n {
                    first[axis][at][i] = phases.first_at(place[i]);
                    from[axis][at][i] = phases.begin((place[i] & (SUBPIXELS - 1)) as usize) as u32;
                }
                // Where all lie in one place every voxel has some in the first.
                let sheets = if aside.is_some() { sheet } else { 0 };
                apart.hold(axis, at, n, (phases.len as i32, sheets));
            }
            apart.cut(axis, n);
        }
    }

    /// Where the columns of each of the first `n` voxels of the batch lie, which all its sections
    /// have, and the windows that hold these: from the first of them to the last.
    #[inline(always)]
    fn place_stacked(&mut self, n: usize, slant: &Slant<'_>) {
        let n = whole_registers::<BATCH>(n);
        let (slot, across) = (self.axes.layers.slot, &self.axes.phases[0][0]);
        let apart = &mut self.batch.apart;
        let Apart { first, from, at, lo, hi, left, deep, .. } = &mut *apart;
        let (subpixels, down) = (slant.subpixels[1], &slant.phases[1]);
        let mut ends = [[0; BATCH]; 2];
        for i in 0..n {
            let begin = deep[i] as usize;
            let of = [begin, (begin + left[i] as usize).wrapping_sub(1)];
            for (end, of) in ends.iter_mut().zip(of) {
                end[i] = at[1][i] + subpixels[of.min(subpixels.len() - 1)];
            }
        }
        for i in 0..n {
            let column = across.first_at(at[0][i]);
            first[0][slot][i] = column;
            from[0][slot][i] = across.begin((at[0][i] & (SUBPIXELS - 1)) as usize) as u32;
            (lo[0][i], hi[0][i]) = (column, column + across.len as i32);
            let [a, b] = [down.first_at(ends[0][i]), down.first_at(ends[1][i])];
            (lo[1][i], hi[1][i]) = (a.min(b), a.max(b) + down.len as i32);
        }
        apart.cut(0, n);
        apart.cut(1, n);
    }

    /// Adds the first `n` voxels of the batch, of `counted` there were, to their sheets from `k`
    /// on.
    #[inline(always)]
    fn add(
        &mut self,
        n: usize,
        k: i32,
        sheets: &mut Sheets<'_, S, N>,
        open: &OpenMask,
        counted: (usize, &mut Counters),
    ) {
        self.axes.layers.slot = slot::<N>(k);
        match self.axes.layers.slant {
            Some(slant) if slant.skewed => {
                shear::windows(self.simd, &slant, &mut self.batch.apart, n);
            }
            Some(slant) => self.place_stacked(n, &slant),
            None => self.place(n, k),
        }
        let (part, across) = ((self.part, open), &mut self.across);
        self.batch.add(part, (n, k), &self.axes, None, across, sheets, counted);
    }
}

const _: () = assert!(EDGE == PART as usize && WINDOW <= EDGE);
