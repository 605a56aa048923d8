//! A tile part of a perspective view in whole sums: sections with footprints of their own.
//!
//! A voxel's sections lie on sheets of different scale, so each has its own place and width on the
//! screen, rarely more than a pixel apart. Their weights are put side by side, by column, row and
//! slot, and added to the records of the window that holds them all, as in [`crate::flat`]. Voxels
//! are tested at the place where their own depth puts them, in a mask grown by what sections may lie
//! aside of it. Where that is far, as very near the eye, [`crate::general`] takes over.

use crate::footprint::Phases;
use crate::mask::{OpenMask, REACH_MOST};
use crate::splat::records::{BySlot, Recorded, SLOTS, STRIDE};
use crate::splat::{Accumulate, Simd, Work};
use crate::stack::{EDGE, Queues, Sheets, Stage, Store, slot, walk};
use crate::tile::{Io, PART, Part, Pixels, Seen};
use slabcast_common::brick::Brick;
use slabcast_common::message::Counters;
use slabcast_common::view::{Projection, SUBPIXEL_BITS, SUBPIXELS, round_i32};

/// Phases of a subpixel as a mask.
const PHASES: usize = SUBPIXELS as usize - 1;

/// Pixels of a window at most, along an axis: a footprint of eight pixels a vox.
const WINDOW: usize = 40;

/// A voxel waiting in the bucket of its first sheet.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DeepVoxel {
    /// Which of the part's bricks, and which voxel of it.
    brick: u32,
    voxel: u16,
    /// The pixel of the part that is nearest to its centre: [`OpenMask::near_all`].
    cell: u16,
}

/// Memory for voxels that a render thread keeps from part to part.
#[derive(Default)]
pub(crate) struct Waiting {
    queues: Queues<DeepVoxel>,
    tossing: Box<Tossing>,
}

/// Voxels of a brick on their way to buckets.
struct Tossing {
    /// Eye coordinates.
    eye: [[f64; 512]; 3],
    /// Screen position at their own depth, in subpixels from the part's corner; depth in phases.
    at: [[i32; 512]; 3],
    cells: [u32; 512],
    fate: [u32; 512],
}

impl Default for Tossing {
    fn default() -> Self {
        Tossing { eye: [[0.0; 512]; 3], at: [[0; 512]; 3], cells: [0; 512], fate: [0; 512] }
    }
}

/// What a perspective part needs to be rendered here.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Deep {
    focal: f64,
    distance: f64,
    /// Pixels from the one that holds a centre within which all sections stay.
    reach: i32,
}

/// Whether `part` may be rendered here.
pub(crate) fn takes(part: &Part<'_>) -> Option<Deep> {
    let (frame, view) = (part.frame, &part.frame.view);
    let Projection::Persp { focal, distance } = view.projection else { return None };
    let most = frame.sections.most();
    if most > SLOTS || part.bricks() == 0 {
        return None;
    }
    // Scales fall with depth: those of the nearest sheet and of a voxel's length in front of it
    // bound all others, and show that no sheet is clipped.
    let nearest = part.brick(0).projected.sheets.first;
    let footprint = frame.footprints.at(nearest)?;
    let own = footprint.reach()?;
    let front = view.scale_at(nearest - most as i32 - 1)?;
    // A section's plane and the voxel's own depth are less than that apart.
    let depth_apart = (0.5 * most as f64 + 1.0) * view.thickness;
    let middle = view.size.map(|n| f64::from(n) * 0.5);
    let r = &part.rect;
    let aside = [r.x0, r.x1].map(|x| (f64::from(x) - middle[0]).abs());
    let above = [r.y0, r.y1].map(|y| (f64::from(y) - middle[1]).abs());
    let farthest = aside.into_iter().chain(above).fold(0.0, f64::max) + 64.0;
    // x / (z + dz) lies within |x / z| dz / z of x / z.
    let apart = farthest * depth_apart * front / focal;
    let reach = f64::from(own) + libm::ceil(apart) + 2.0;
    let fits = reach <= f64::from(REACH_MOST) && 2.0 * reach + 2.0 < WINDOW as f64;
    fits.then_some(Deep { focal, distance, reach: reach as i32 })
}

/// Renders a part: compiled for each instruction set as a whole.
pub(crate) struct RenderDeep<'a, S: Recorded> {
    pub(crate) part: Part<'a>,
    pub(crate) deep: Deep,
    pub(crate) simd: Simd,
    pub(crate) store: &'a mut Store<S>,
    pub(crate) waiting: &'a mut Waiting,
    pub(crate) pixels: &'a mut Pixels,
    pub(crate) io: Io<'a>,
}

impl<S: Recorded> Work for RenderDeep<'_, S> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        let RenderDeep { part, deep, simd, store, waiting, pixels, io } = self;
        let Waiting { queues, tossing } = waiting;
        let [x, y] = [[[S::Weight::default(); SLOTS]; WINDOW]; 2];
        let stage = DeepStage { part: &part, deep, tossing, across: [x, y] };
        walk(&part, stage, (simd, store), queues, pixels, io);
    }
}

struct DeepStage<'a, S: Recorded> {
    part: &'a Part<'a>,
    deep: Deep,
    tossing: &'a mut Tossing,
    /// Weights of the voxel at hand by column and by row.
    across: [[BySlot<S::Weight>; WINDOW]; 2],
}

/// Footprints of one sheet.
#[derive(Clone, Copy)]
struct Layer<'a, S: Recorded> {
    scale: f64,
    axes: [Axis<'a, S>; 2],
}

/// Weights along one axis, and where they lie.
type Axis<'a, S> = (Phases<'a>, &'a [<S as Accumulate>::Weight]);

/// A footprint along one axis: the first pixel, from the part's corner, and where weights begin.
#[derive(Clone, Copy, Debug, Default)]
struct Window {
    first: i32,
    from: usize,
    len: i32,
}

impl<S: Recorded> Stage<S> for DeepStage<'_, S> {
    type Voxel = DeepVoxel;

    #[inline(always)]
    fn reach(&self) -> i32 {
        self.deep.reach
    }

    #[inline(always)]
    fn toss(
        &mut self,
        which: usize,
        open: &OpenMask,
        queues: &mut Queues<DeepVoxel>,
        counters: &mut Counters,
    ) {
        let Part { frame, rect, slab, .. } = self.part;
        let Some(Seen { brick, corner, .. }) = self.part.open_brick(which, open, counters) else {
            return;
        };
        let cull = frame.scene.quality.cull;
        let (sections, view, n) = (&frame.sections, &frame.view, brick.len());
        let Tossing { eye, at, cells, fate } = &mut *self.tossing;
        for (i, &local) in brick.index.iter().enumerate() {
            let v = corner.eye + frame.offsets()[usize::from(local)];
            (eye[0][i], eye[1][i], eye[2][i]) = (v.x, v.y, v.z);
        }
        let middle = [
            f64::from(view.size[0]) * 0.5 - f64::from(rect.x0),
            f64::from(view.size[1]) * 0.5 - f64::from(rect.y0),
        ];
        let per_depth = f64::from(SUBPIXELS) * self.deep.focal;
        let (far, middle) = (1e6, middle.map(|m| m * f64::from(SUBPIXELS)));
        for i in 0..n {
            let scale = per_depth / (eye[2][i] + self.deep.distance);
            // Places are tests, not pixels: far ones may be anything that is far.
            at[0][i] = round_i32((eye[0][i] * scale + middle[0]).clamp(-far, far));
            at[1][i] = round_i32((eye[1][i] * scale + middle[1]).clamp(-far, far));
            at[2][i] = view.depth_in_phases(eye[2][i]);
        }
        let [x, y, z] = at;
        open.near_all(&x[..n], &y[..n], cells, fate);
        let wanted = if cull { 3 } else { 1 };
        let (mut reached, mut kept) = (0, 0);
        for i in 0..n {
            let (first, count) = sections.span(z[i]);
            if fate[i] == 0 || first >= slab.end || first + count as i32 <= slab.first {
                continue;
            }
            reached += 1;
            if fate[i] < wanted {
                continue;
            }
            kept += 1;
            let voxel = DeepVoxel { brick: which as u32, voxel: i as u16, cell: cells[i] as u16 };
            if first < slab.first {
                queues.carried.push((voxel, first));
            } else {
                queues.buckets[(first - slab.first) as usize].push(voxel);
            }
        }
        counters.tossed += kept;
        counters.culled += reached - kept;
    }

    #[inline(always)]
    fn splat(
        &mut self,
        bucket: &[DeepVoxel],
        k: i32,
        sheets: &mut Sheets<'_, S>,
        open: &OpenMask,
        counters: &mut Counters,
    ) {
        if bucket.is_empty() {
            return;
        }
        let layers = layers(self.part, k);
        let cull = self.part.frame.scene.quality.cull;
        for v in bucket {
            let added = (!cull || open.is_near(v.cell.into()))
                && self.add(v, (k, k), &layers, sheets, open);
            counters.splatted += u64::from(added);
            counters.culled += u64::from(!added);
        }
    }

    #[inline(always)]
    fn splat_carried(
        &mut self,
        carried: &[(DeepVoxel, i32)],
        sheets: &mut Sheets<'_, S>,
        open: &OpenMask,
        counters: &mut Counters,
    ) {
        let k = self.part.slab.first;
        let layers = layers(self.part, k);
        for (v, first) in carried {
            let added = self.add(v, (*first, k), &layers, sheets, open);
            counters.splatted += u64::from(added);
            counters.culled += u64::from(!added);
        }
    }
}

/// Footprints of the sheets from `k` that a voxel may reach.
#[inline(always)]
fn layers<'a, S: Recorded>(part: &'a Part<'_>, k: i32) -> [Layer<'a, S>; SLOTS] {
    let last = (k + part.frame.sections.most() as i32 - 1).min(part.frame.footprints.last());
    std::array::from_fn(|i| {
        // Sheets farther back than a voxel reaches are not asked for; any will do.
        let sheet = (k + i as i32).min(last);
        let footprint = part.frame.footprints.at(sheet).expect("no sheet of the part is clipped");
        let axes = [0, 1].map(|axis| {
            footprint.phases(axis).zip(S::across(&footprint, axis)).expect("footprints have tables")
        });
        Layer { scale: footprint.scale, axes }
    })
}

impl<S: Recorded> DeepStage<'_, S> {
    /// Adds a voxel that begins at sheet `first` to its sheets from `k` on, which `layers` are of;
    /// not where all that it would touch is shut. Whether it did.
    #[inline(always)]
    fn add(
        &mut self,
        v: &DeepVoxel,
        (first, k): (i32, i32),
        layers: &[Layer<'_, S>; SLOTS],
        sheets: &mut Sheets<'_, S>,
        open: &OpenMask,
    ) -> bool {
        let Part { frame, rect, .. } = self.part;
        let Seen { brick, corner, .. } = self.part.brick(v.brick as usize);
        let brick: &Brick = brick;
        let voxel = usize::from(v.voxel);
        let placed = frame.place(corner, brick.index[voxel]);
        let (_, count) = frame.sections.span(placed.z);
        let count = (count as i32 - (k - first)) as usize % (SLOTS + 1);

        // Where each section lies, and the window that holds them all.
        let mut windows = [[Window::default(); 2]; SLOTS];
        let (mut lo, mut hi) = ([i32::MAX; 2], [i32::MIN; 2]);
        let (origin, eye) = ([rect.x0, rect.y0], [placed.eye.x, placed.eye.y]);
        for (layer, window) in layers[..count].iter().zip(&mut windows) {
            for axis in 0..2 {
                let at = frame.view.screen_along(axis, eye[axis], layer.scale);
                let phases = &layer.axes[axis].0;
                let (pixel, phase) = ((at >> SUBPIXEL_BITS) as i32, at as usize & PHASES);
                let first = pixel - origin[axis] + phases.firsts[phase];
                let len = phases.len as i32;
                window[axis] = Window { first, from: phases.begin(phase), len };
                lo[axis] = lo[axis].min(first);
                hi[axis] = hi[axis].max(first + len);
            }
        }
        // Inside the part.
        let lo = lo.map(|p| p.max(0));
        let hi = hi.map(|p| p.min(PART));
        if lo[0] >= hi[0] || lo[1] >= hi[1] {
            return false;
        }
        if frame.scene.quality.cull {
            let rows = (lo[1]..hi[1]).fold(0, |rows, y| rows | open.row(y as usize));
            if rows & (u64::MAX >> (64 - (hi[0] - lo[0]))) << lo[0] == 0 {
                return false;
            }
        }
        let payload = S::payload(frame.payload(brick, voxel, placed.eye));
        let wide = [0, 1].map(|axis| (hi[axis] - lo[axis]) as usize);
        for axis in 0..2 {
            self.across[axis][..wide[axis]].fill([S::Weight::default(); SLOTS]);
        }
        let mut deep = [S::Depth::default(); SLOTS];
        let z = &S::deep(&frame.sections)[self.row(placed.z)..][(k - first) as usize..];
        for i in 0..count {
            let slot = slot(k + i as i32);
            deep[slot] = z[i];
            for axis in 0..2 {
                let w = &windows[i][axis];
                // Its own part of the window.
                let begin = (w.first - lo[axis]).max(0);
                let skip = (lo[axis] - w.first).clamp(0, w.len);
                let n = (w.len - skip).min(wide[axis] as i32 - begin).max(0) as usize;
                let weights = &layers[i].axes[axis].1[w.from + skip as usize..][..n];
                let to = &mut self.across[axis][begin as usize..][..n];
                for j in 0..n {
                    to[j][slot] = weights[j];
                }
            }
        }
        let [columns, lines] = [0, 1].map(|axis| &self.across[axis][..wide[axis]]);
        let at = lo[1] as usize * STRIDE + lo[0] as usize;
        S::splat_deep(sheets.simd, sheets.records, at, (columns, lines), payload, &deep);
        sheets.touch(k, [lo[0] as u8, lo[1] as u8], wide);
        true
    }

    /// Where the weights of depth `z` begin.
    #[inline(always)]
    fn row(&self, z: i32) -> usize {
        let sections = &self.part.frame.sections;
        (z & (sections.phases() - 1)) as usize * sections.most()
    }
}

const _: () = assert!(EDGE == PART as usize && WINDOW <= EDGE);
