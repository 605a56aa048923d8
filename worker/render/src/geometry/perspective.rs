//! Parts of perspective views in whole-number sums: each section has a footprint of its own.
//!
//! In perspective a voxel's sections lie on sheets of different scale, so each has its own position
//! and width on the screen, rarely more than a pixel apart. Sections of a kernel that leans lie
//! beside each other in any view ([`crate::primitives::footprint::Leaning`]), and so may their
//! rows. Their weights are interleaved by column, row and slot, and added to the records of the
//! window that holds them all, as in [`crate::geometry::ortho`]. Voxels are tested at the position
//! of their own depth, in a mask grown by how far sections may lie from it. Where that is far, as
//! close to the eye, [`crate::geometry::general`] draws.

use crate::geometry::batch::{Axes, Batch};
use crate::geometry::open_sheets::{Chunk, Due, EDGE, Queues, Sheets, Stage, Store, slot, walk};
use crate::geometry::shared_rows::SharedRowsSheets;
use crate::kernels::pixel_records::sheet_offsets::{Apart, BATCH, Each, WINDOW, Woven, after};
use crate::kernels::pixel_records::{MOST, Recorded};
use crate::kernels::row_records::{Shape, Tiered};
use crate::kernels::toss::{self, Kept, Sieve, Sifted, Tossing, prefetch};
use crate::kernels::{Simd, Work, whole_registers};
use crate::part::{Io, Part, Pixels};
use crate::primitives::footprint::Leaning;
use crate::primitives::lattice_rows::LatticeRows;
use crate::primitives::sizes::PART;
use crate::scene::Frame;
use crate::visibility::open_mask::{OpenMask, REACH_MOST};
use slabcast_common::message::Counters;
use slabcast_common::occlusion::Rect;
use slabcast_common::view::{Projection, SUBPIXEL_BITS, SUBPIXELS, round_i32};

/// A voxel waiting in the bucket of its first sheet, with all that drawing it takes: nobody goes
/// back to the brick.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DeepVoxel {
    /// Eye coordinates in vox.
    eye: [f64; 3],
    /// Sample code of the voxel, as bits.
    sample: u32,
    normal: u16,
    /// The pixel of the part that is nearest to its centre: [`OpenMask::near_all`].
    cell: u16,
}

/// Memory for waiting voxels that a render thread keeps from part to part.
#[derive(Default)]
pub(crate) struct Waiting {
    queues: Queues<DeepVoxel>,
    tossing: Box<Tossing>,
    batch: Box<Batch>,
    places: Box<Places>,
}

/// Positions of the voxels of a batch.
struct Places {
    /// Eye coordinates.
    eye: [Each<f64>; 3],
    /// Position of a section of each voxel along an axis.
    aside: Each<f64>,
    /// In a level view, which lattice row each belongs to, the columns that hold its sections, and
    /// by slot where among all tiers of a sheet it begins.
    lattice_row: Each<i32>,
    columns: Each<u64>,
    places: [Each<u32>; MOST],
}

impl Default for Places {
    fn default() -> Self {
        Places {
            eye: [[0.0; BATCH]; 3],
            aside: [0.0; BATCH],
            lattice_row: [0; BATCH],
            columns: [0; BATCH],
            places: [[0; BATCH]; MOST],
        }
    }
}

/// Constants for drawing one part of a perspective view: focal length, distance and reach.
#[derive(Clone, Copy, Debug)]
pub struct Deep {
    focal: f64,
    distance: f64,
    /// Number of pixels along x and y between the one that holds a voxel's centre and the edge of
    /// its farthest section.
    pub reach: [i32; 2],
}

/// Returns what drawing `part` here takes, if it may be drawn here.
pub(crate) fn accepts(part: &Part<'_>) -> Option<Deep> {
    deep(part.frame, &part.rect, part.nearest()?)
}

/// Returns what drawing the part `r` of `frame` takes, if its bricks begin at sheet `nearest` or
/// behind; `None` if sections may lie too far from their voxels.
pub fn deep(frame: &Frame, r: &Rect, nearest: i32) -> Option<Deep> {
    let view = &frame.view;
    let leaning = frame.leaning.as_ref();
    let Projection::Persp { focal, distance } = view.projection else { return None };
    let most = frame.sections.most();
    // Scales fall with depth: those of the nearest sheet and of a voxel's length in front of it
    // bound all others, and show that no sheet is clipped.
    let footprint = frame.footprints.at(nearest)?;
    let own = footprint.reach()?;
    let front = view.scale_at(nearest - most as i32 - 1)?;
    // From a voxel's own depth to the middle of a sheet that it reaches: to the sheet's far side at
    // most, and half a sheet back.
    let (ahead, behind, shift) = frame.sections.reach();
    let reaches = f64::from(ahead.max(behind) + 1) / f64::from(1 << shift);
    let depth_apart = (reaches + 0.5) * view.thickness;
    let middle = view.size.map(|n| f64::from(n) * 0.5);
    let aside = [r.x0, r.x1].map(|x| (f64::from(x) - middle[0]).abs());
    let above = [r.y0, r.y1].map(|y| (f64::from(y) - middle[1]).abs());
    let farthest = aside.into_iter().chain(above).fold(0.0, f64::max);
    // Where the kernel leans a section is farther aside, and its outermost rows are.
    let leans = leaning.map_or([0.0; 2], |leaning| leaning.pixels(front, own));
    // x / (z + dz) lies within |x / z| dz / z of x / z, and each is rounded to a subpixel; of
    // voxels so many pixels outside of the part.
    let reach_of = |outside: f64| {
        let apart = (farthest + outside) * depth_apart * front / focal + 4.0 / f64::from(SUBPIXELS);
        [0, 1].map(|axis| f64::from(own[axis]) + libm::ceil(apart + leans[axis]))
    };
    // None that is farther outside than a mask is grown at most touches the part; so none that is
    // farther than what those reach does.
    let [x, y] = reach_of(f64::from(REACH_MOST));
    let of_any = x.max(y);
    let reach = reach_of(of_any);
    let fits = of_any <= f64::from(REACH_MOST)
        && reach.iter().all(|reach| 2.0 * reach + 2.0 < WINDOW as f64);
    fits.then_some(Deep { focal, distance, reach: reach.map(|reach| reach as i32) })
}

/// Work that draws one part of a perspective view into pixel records; it is compiled once for each
/// instruction set.
pub struct RenderPerspective<'a, S: Recorded, const N: usize> {
    pub(crate) part: Part<'a>,
    pub(crate) deep: Deep,
    pub(crate) store: &'a mut Store<S>,
    pub(crate) waiting: &'a mut Waiting,
    pub(crate) pixels: &'a mut Pixels,
    pub(crate) io: Io<'a>,
}

impl<S: Recorded, const N: usize> Work for RenderPerspective<'_, S, N> {
    type Out = ();
    #[inline(always)]
    fn run(self, simd: Simd) {
        let RenderPerspective { part, deep, store, waiting, pixels, io } = self;
        let (stage, queues) = DeepStage::new(&part, deep, simd, waiting);
        let sheets = Sheets::<S, N>::new(simd, store, part.frame.sections.most());
        walk(&part, stage, sheets, queues, pixels, io);
    }
}

/// Work that draws one part of a perspective view with a level camera into row records; it is
/// compiled once for each instruction set.
pub struct RenderPerspectiveSharedRows<'a, S: Recorded, const N: usize> {
    pub(crate) deep: RenderPerspective<'a, S, N>,
    pub(crate) lattice_rows: &'a LatticeRows,
}

impl<S: Tiered, const N: usize> Work for RenderPerspectiveSharedRows<'_, S, N> {
    type Out = ();
    #[inline(always)]
    fn run(self, simd: Simd) {
        let RenderPerspectiveSharedRows { deep, lattice_rows } = self;
        let RenderPerspective { part, deep, store, waiting, pixels, io } = deep;
        let (stage, queues) = DeepStage::new(&part, deep, simd, waiting);
        let frame = part.frame;
        // The nearest sheet has the widest footprints, the last one most lattice rows.
        let nearest = part.nearest().and_then(|nearest| frame.footprints.at(nearest));
        let widest = nearest.and_then(|footprint| footprint.phases(0));
        let len = widest.expect("a table of a sheet that is not clipped").len;
        let last = frame.footprints.at(frame.footprints.last()).expect("one behind it");
        let shape = Shape::new::<S>(lattice_rows.rows(PART, last.scale), len);
        let sheets = SharedRowsSheets::<S, N>::new(simd, store, &part, lattice_rows, shape);
        walk(&part, stage, sheets, queues, pixels, io);
    }
}

/// How a part's voxels get into its sheets.
struct DeepStage<'a, S: Recorded, const N: usize> {
    /// Of the sheets that voxels reached last; none before the first.
    footprints: Option<Footprints<'a, S, N>>,
    drawing: Drawing<'a, S, N>,
}

/// All of that but footprints, which are read while this changes.
struct Drawing<'a, S: Recorded, const N: usize> {
    part: &'a Part<'a>,
    deep: Deep,
    simd: Simd,
    tossing: &'a mut Tossing,
    batch: &'a mut Batch,
    places: &'a mut Places,
    /// Weights of the voxel at hand by column and by row.
    across: Woven<S::Weight, N>,
}

impl<'a, S: Recorded, const N: usize> DeepStage<'a, S, N> {
    /// With what waits beside it.
    #[inline(always)]
    fn new(
        part: &'a Part<'a>,
        deep: Deep,
        simd: Simd,
        waiting: &'a mut Waiting,
    ) -> (Self, &'a mut Queues<DeepVoxel>) {
        let Waiting { queues, tossing, batch, places } = waiting;
        let across = Woven::default();
        let drawing = Drawing { part, deep, simd, tossing, batch, places, across };
        (DeepStage { footprints: None, drawing }, queues)
    }
}

/// Footprints of sheets by slot.
struct Footprints<'a, S: Recorded, const N: usize> {
    axes: Axes<'a, S, N>,
    scales: [f64; N],
    /// Sheet whose footprint each slot has.
    sheets: [i32; N],
}

impl<'a, S: Recorded, const N: usize> Footprints<'a, S, N> {
    /// Of sheet `k`, in all slots.
    #[inline(always)]
    fn new(part: &'a Part<'_>, k: i32) -> Self {
        let footprint = part.frame.footprints.at(k).expect(DRAWN);
        let axes = Axes::new(part.frame, k, &footprint);
        Footprints { axes, scales: [footprint.scale; N], sheets: [k; N] }
    }

    /// Takes the footprints of the sheets from `k` that a voxel may reach: from one sheet to the
    /// next only one of them is new.
    #[inline(always)]
    fn come_to(&mut self, part: &'a Part<'_>, k: i32) {
        let footprints = &part.frame.footprints;
        let last = (k + part.frame.sections.most() as i32 - 1).min(footprints.last());
        let slot = slot::<N>(k);
        self.axes.layers.slot = slot;
        for at in 0..N {
            // Sheets farther back than a voxel reaches are not asked for; any will do.
            let sheet = (k + after::<N>(slot, at)).min(last);
            if self.sheets[at] != sheet {
                let footprint = footprints.at(sheet).expect(DRAWN);
                self.axes.put(at, &footprint);
                (self.scales[at], self.sheets[at]) = (footprint.scale, sheet);
            }
        }
    }
}

/// Message for a sheet without a footprint: [`takes`] has excluded it.
const DRAWN: &str = "no sheet of the part is clipped";

impl<S: Recorded, const N: usize> Drawing<'_, S, N> {
    /// Tests brick `which` of the part, then its voxels, and tosses the rest into buckets
    /// ([`Stage::toss`]).
    #[inline(always)]
    fn toss_all(
        &mut self,
        which: usize,
        open: &OpenMask,
        queues: &mut Queues<DeepVoxel>,
        counters: &mut Counters,
    ) {
        let Part { frame, rect, slab, .. } = self.part;
        let Some((brick, corner)) = self.part.open_brick(which, open, counters) else { return };
        if let Some(next) = self.part.peek(which + 1) {
            prefetch(next);
        }
        let view = &frame.view;
        let places = toss::DeepBrick {
            view,
            offsets: frame.offsets(),
            corner: corner.eye.to_array(),
            per_depth: f64::from(SUBPIXELS) * self.deep.focal,
            distance: self.deep.distance,
            middle: [(0, rect.x0), (1, rect.y0)].map(|(axis, origin)| {
                (f64::from(view.size[axis]) * 0.5 - f64::from(origin)) * f64::from(SUBPIXELS)
            }),
        };
        let sieve = Sieve {
            places,
            open,
            cull: frame.scene.quality.cull,
            sections: &frame.sections,
            sheets: [slab.first, slab.end],
        };
        let Sifted { reached, kept } = sieve.sift(self.simd, brick, self.tossing);
        for Kept { first, local, cell, normal, sample } in self.tossing.kept(kept) {
            let voxel = DeepVoxel { eye: sieve.places.eye(local), sample, normal, cell };
            if first < slab.first {
                queues.carried.push((voxel, first));
            } else {
                queues.buckets[(first - slab.first) as usize].push(&voxel);
            }
        }
        counters.tossed += kept as u64;
        counters.culled += (reached - kept) as u64;
    }

    /// Takes over those of `some` voxels, which are due at sheet `k`, near which anything is open;
    /// says how many.
    #[inline(always)]
    fn take(&mut self, some: &Chunk<'_, DeepVoxel>, k: i32, open: &OpenMask) -> usize {
        let most = self.part.frame.sections.most() as i32;
        let cull = self.part.frame.scene.quality.cull;
        some.keep(k, |n, v, gone| {
            self.put(n, v, most - gone);
            !cull || open.is_near(v.cell.into())
        })
    }
}

/// [`Stage`] for open sheets that voxels are added to by `$add`.
macro_rules! stage {
    ($bound:ident, $sheets:ident, $add:ident) => {
        impl<S: $bound, const N: usize> Stage<$sheets<'_, S, N>> for DeepStage<'_, S, N> {
            type Voxel = DeepVoxel;

            #[inline(always)]
            fn reach(&self) -> [i32; 2] {
                self.drawing.deep.reach
            }

            #[inline(always)]
            fn toss(
                &mut self,
                which: usize,
                open: &OpenMask,
                queues: &mut Queues<DeepVoxel>,
                counters: &mut Counters,
            ) {
                self.drawing.toss_all(which, open, queues, counters);
            }

            #[inline(always)]
            fn splat(
                &mut self,
                due: &Due<'_, DeepVoxel>,
                k: i32,
                sheets: &mut $sheets<'_, S, N>,
                open: &OpenMask,
                counters: &mut Counters,
            ) {
                let DeepStage { footprints, drawing } = self;
                let part = drawing.part;
                let footprints = footprints.get_or_insert_with(|| Footprints::new(part, k));
                footprints.come_to(part, k);
                for some in due.chunks(BATCH) {
                    let n = drawing.take(&some, k, open);
                    drawing.$add(n, k, footprints, sheets, open, (some.len(), counters));
                }
            }
        }
    };
}

stage!(Recorded, Sheets, add);
stage!(Tiered, SharedRowsSheets, add_level);

impl<S: Recorded, const N: usize> Drawing<'_, S, N> {
    /// Takes over `v`, which has `left` sheets left, as voxel `i` of the batch.
    #[inline(always)]
    fn put(&mut self, i: usize, v: &DeepVoxel, left: i32) {
        for axis in 0..3 {
            self.places.eye[axis][i] = v.eye[axis];
        }
        let Batch { samples, normals, apart, .. } = &mut *self.batch;
        (samples[i], normals[i], apart.left[i]) = (v.sample, v.normal, left);
    }

    /// Places each section of the first `n` voxels of the batch, and the windows that hold all of a
    /// voxel's, along some axes: rows before columns, which may depend on them.
    #[inline(always)]
    fn place(
        &mut self,
        (n, k): (usize, i32),
        Footprints { axes, scales, .. }: &Footprints<'_, S, N>,
        along: &[usize],
    ) {
        let Part { frame, rect, .. } = self.part;
        let Places { eye, aside, .. } = &mut *self.places;
        let n = whole_registers::<BATCH>(n);
        let apart = &mut self.batch.apart;
        let view = &frame.view;
        let (most, phases) = (frame.sections.most() as i32, frame.sections.phases());
        for i in 0..n {
            let phase = view.depth_in_phases(eye[2][i]) & (phases - 1);
            apart.deep[i] = (phase * most + most - apart.left[i]) as u32;
        }
        let leaning = frame.leaning.as_ref();
        let row = leaning.map_or(0, Leaning::row);
        for &axis in along {
            let origin = [rect.x0, rect.y0][axis];
            apart.begin(axis, n);
            let lean = leaning.filter(|leaning| leaning.most(axis) > 0.0);
            for at in 0..N {
                let sheet = after::<N>(slot::<N>(k), at);
                if sheet >= most {
                    continue;
                }
                let Apart { first, from, places, deep, .. } = &mut *apart;
                let (phases, scale) = (&axes.phases[axis][at], scales[at]);
                let mut eye = &eye[axis];
                if let Some(lean) = lean {
                    let table = lean.aside(axis);
                    for i in 0..n {
                        // What lies behind a voxel's last section is not drawn.
                        let which = deep[i] as usize + sheet as usize;
                        aside[i] = eye[i] + table[which.min(table.len() - 1)];
                    }
                    eye = aside;
                }
                if row != 0 {
                    let place = &mut places[axis][at];
                    for i in 0..n {
                        let at = view.screen_coordinate(axis, eye[i], scale);
                        place[i] = (at - (i64::from(origin) << SUBPIXEL_BITS)) as i32;
                    }
                    if axis == 0 {
                        let phases = [phases, &axes.phases[1][at]];
                        apart.hold_skewed(at, n, (phases, row), sheet);
                        continue;
                    }
                }
                let (to_first, to_from) = (&mut first[axis][at], &mut from[axis][at]);
                for i in 0..n {
                    let at = view.screen_coordinate(axis, eye[i], scale);
                    let (pixel, phase) =
                        ((at >> SUBPIXEL_BITS) as i32, at as i32 & (SUBPIXELS - 1));
                    to_first[i] = pixel - origin + phases.first(phase);
                    to_from[i] = phases.begin(phase as usize) as u32;
                }
                apart.hold(axis, at, n, (phases.len as i32, sheet));
            }
            apart.cut(axis, n);
        }
    }

    /// Adds the first `n` voxels of the batch, of `counted` there were, to their sheets from `k`
    /// on.
    #[inline(always)]
    fn add(
        &mut self,
        n: usize,
        k: i32,
        footprints: &Footprints<'_, S, N>,
        sheets: &mut Sheets<'_, S, N>,
        open: &OpenMask,
        counted: (usize, &mut Counters),
    ) {
        self.place((n, k), footprints, &[1, 0]);
        let (part, eyes, across) =
            ((self.part, open), Some(&mut self.places.eye), &mut self.across);
        self.batch.add(part, (n, k), &footprints.axes, eyes, across, sheets, counted);
    }
}

impl<S: Tiered, const N: usize> Drawing<'_, S, N> {
    /// [`Drawing::add`] to tiers.
    #[inline(always)]
    fn add_level(
        &mut self,
        n: usize,
        k: i32,
        footprints: &Footprints<'_, S, N>,
        sheets: &mut SharedRowsSheets<'_, S, N>,
        open: &OpenMask,
        counted: (usize, &mut Counters),
    ) {
        let Axes { layers, .. } = &footprints.axes;
        let frame = self.part.frame;
        let lattice_rows = frame.lattice_rows.as_ref().expect("a level view");
        let shape = sheets.tiers.shape();
        let most = frame.sections.most() as i32;
        self.place((n, k), footprints, &[0]);
        let cull = frame.scene.quality.cull;
        let hull = sheets.hull(k, most as usize, cull.then_some(open));
        let Places { eye, lattice_row, columns, places, .. } = &mut *self.places;
        let Batch { apart: Apart { lo, hi, first, .. }, near, .. } = &mut *self.batch;
        let (per, base) = lattice_rows.by_eye();
        let all = whole_registers::<BATCH>(n);
        for i in 0..all {
            lattice_row[i] = round_i32(eye[1][i] * per + base);
        }
        for i in 0..all {
            let [lo, hi] = [lo[0][i], hi[0][i]];
            // Of voxels that have none, and of what fills a register, these are any numbers.
            let beyond = (EDGE as u32).wrapping_sub(hi.wrapping_sub(lo) as u32);
            let inside = u64::MAX.wrapping_shr(beyond).wrapping_shl(lo as u32);
            columns[i] = if lo < hi { inside } else { 0 };
            near[i] = columns[i] & hull.open(lattice_row[i]);
        }
        for (at, places) in places[..N].iter_mut().enumerate() {
            let sheet = layers.after(at);
            if sheet < most {
                let base = hull.bases[sheet as usize % MOST];
                for i in 0..all {
                    let tier = (lattice_row[i] - base).clamp(0, shape.rows as i32 - 1) as u32;
                    places[i] = shape.place_in(tier, first[0][at][i]);
                }
            }
        }
        let mut payloads = [S::Payload::default(); BATCH];
        let asked = (sheets.simd, frame);
        let some = self.batch.light::<S>(asked, n, Some(eye), &mut payloads, counted);
        let apart = &self.batch.apart;
        for &i in &apart.kept[..some] {
            let i = i as usize % BATCH;
            sheets.hull.touch(lattice_row[i], columns[i]);
        }
        sheets.touch_hull();
        let voxels = (apart, &payloads[..some]);
        S::add_apart(sheets.simd, &mut sheets.tiers, voxels, places, layers);
    }
}

const _: () = assert!(EDGE == PART as usize && WINDOW <= EDGE);
