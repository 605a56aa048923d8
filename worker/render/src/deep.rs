//! A tile part of a perspective view in whole sums: sections with footprints of their own.
//!
//! A voxel's sections lie on sheets of different scale, so each has its own place and width on the
//! screen, rarely more than a pixel apart. Their weights are put side by side, by column, row and
//! slot, and added to the records of the window that holds them all, as in [`crate::flat`]. Voxels
//! are tested at the place where their own depth puts them, in a mask grown by what sections may lie
//! aside of it. Where that is far, as very near the eye, [`crate::general`] takes over.

use crate::footprint::Phases;
use crate::mask::{OpenMask, REACH_MOST};
use crate::splat::records::{BySlot, MOST, Recorded, RowAt, STRIDE};
use crate::splat::toss::prefetch;
use crate::splat::{Accumulate, Simd, Work};
use crate::stack::{EDGE, Queues, Sheets, Stage, Store, slot, walk};
use crate::tile::{Io, PART, Part, Pixels};
use slabcast_common::message::Counters;
use slabcast_common::shade::NO_NORMAL;
use slabcast_common::view::{Projection, SUBPIXEL_BITS, SUBPIXELS, round_i32};

/// Pixels of a window at most, along an axis: a footprint of eight pixels a vox.
const WINDOW: usize = 40;

/// A voxel waiting in the bucket of its first sheet, with all that drawing it takes: nobody goes back
/// to the brick.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DeepVoxel {
    /// Eye coordinates in vox.
    eye: [f64; 3],
    /// Its sample's bits.
    sample: u32,
    normal: u16,
    /// The pixel of the part that is nearest to its centre: [`OpenMask::near_all`].
    cell: u16,
}

/// Memory for voxels that a render thread keeps from part to part.
#[derive(Default)]
pub(crate) struct Waiting {
    queues: Queues<DeepVoxel>,
    tossing: Box<Tossing>,
    batch: Box<Batch>,
}

/// Voxels of a brick on their way to buckets.
struct Tossing {
    /// Eye coordinates.
    eye: [[f64; 512]; 3],
    /// Screen position at their own depth, in subpixels from the part's corner; depth in phases.
    at: [[i32; 512]; 3],
    cells: [u32; 512],
    fate: [u32; 512],
    samples: [u32; 512],
}

impl Default for Tossing {
    fn default() -> Self {
        Tossing {
            eye: [[0.0; 512]; 3],
            at: [[0; 512]; 3],
            cells: [0; 512],
            fate: [0; 512],
            samples: [0; 512],
        }
    }
}

/// Voxels that are placed, shaded and splatted together.
const BATCH: usize = 64;

/// A number a voxel.
type Each<T> = [T; BATCH];

/// Voxels on their way from a bucket to the records.
struct Batch {
    eye: [Each<f64>; 3],
    samples: Each<u32>,
    normals: Each<u16>,
    /// Sheets that a voxel has left, from the one at hand.
    left: Each<i32>,
    /// Depths in phases.
    z: Each<i32>,
    /// First pixels of footprints, from the part's corner, and where weights begin: by axis and slot.
    first: [[Each<i32>; MOST]; 2],
    from: [[Each<u32>; MOST]; 2],
    /// By axis, the window that holds all footprints of a voxel.
    lo: [Each<i32>; 2],
    hi: [Each<i32>; 2],
    /// Voxels that touch an open pixel.
    kept: Each<u32>,
    light: [Each<f32>; 4],
}

impl Default for Batch {
    fn default() -> Self {
        Batch {
            eye: [[0.0; BATCH]; 3],
            samples: [0; BATCH],
            normals: [0; BATCH],
            left: [0; BATCH],
            z: [0; BATCH],
            first: [[[0; BATCH]; MOST]; 2],
            from: [[[0; BATCH]; MOST]; 2],
            lo: [[0; BATCH]; 2],
            hi: [[0; BATCH]; 2],
            kept: [0; BATCH],
            light: [[0.0; BATCH]; 4],
        }
    }
}

impl Batch {
    /// Takes over `v`, which has `left` sheets left, as voxel `i`.
    #[inline(always)]
    fn put(&mut self, i: usize, v: &DeepVoxel, left: i32) {
        for axis in 0..3 {
            self.eye[axis][i] = v.eye[axis];
        }
        (self.samples[i], self.normals[i], self.left[i]) = (v.sample, v.normal, left);
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
    // Scales fall with depth: those of the nearest sheet and of a voxel's length in front of it
    // bound all others, and show that no sheet is clipped.
    let nearest = part.nearest()?;
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
pub(crate) struct RenderDeep<'a, S: Recorded, const N: usize> {
    pub(crate) part: Part<'a>,
    pub(crate) deep: Deep,
    pub(crate) simd: Simd,
    pub(crate) store: &'a mut Store<S>,
    pub(crate) waiting: &'a mut Waiting,
    pub(crate) pixels: &'a mut Pixels,
    pub(crate) io: Io<'a>,
}

impl<S: Recorded, const N: usize> Work for RenderDeep<'_, S, N> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        let RenderDeep { part, deep, simd, store, waiting, pixels, io } = self;
        let Waiting { queues, tossing, batch } = waiting;
        let [x, y] = [[[S::Weight::default(); N]; WINDOW]; 2];
        let stage = DeepStage { part: &part, deep, tossing, batch, across: [x, y] };
        walk::<S, N, _>(&part, stage, (simd, store), queues, pixels, io);
    }
}

struct DeepStage<'a, S: Recorded, const N: usize> {
    part: &'a Part<'a>,
    deep: Deep,
    tossing: &'a mut Tossing,
    batch: &'a mut Batch,
    /// Weights of the voxel at hand by column and by row.
    across: [[BySlot<S::Weight, N>; WINDOW]; 2],
}

/// Footprints of one sheet.
#[derive(Clone, Copy)]
struct Layer<'a, S: Recorded> {
    scale: f64,
    axes: [Axis<'a, S>; 2],
}

/// Weights along one axis, and where they lie.
type Axis<'a, S> = (Phases, &'a [<S as Accumulate>::Weight]);

impl<S: Recorded, const N: usize> Stage<S, N> for DeepStage<'_, S, N> {
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
        let Some((brick, corner)) = self.part.open_brick(which, open, counters) else { return };
        if let Some(next) = self.part.peek(which + 1) {
            prefetch(next);
        }
        let cull = frame.scene.quality.cull;
        let (sections, view, n) = (&frame.sections, &frame.view, brick.len());
        let Tossing { eye, at, cells, fate, samples } = &mut *self.tossing;
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
        brick.values.bits(samples);
        let normals = brick.normals.as_deref();
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
            let voxel = DeepVoxel {
                eye: eye.each_ref().map(|e| e[i]),
                sample: samples[i],
                normal: normals.map_or(NO_NORMAL, |n| n[i]),
                cell: cells[i] as u16,
            };
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
        sheets: &mut Sheets<'_, S, N>,
        open: &OpenMask,
        counters: &mut Counters,
    ) {
        if bucket.is_empty() {
            return;
        }
        let layers = layers(self.part, k);
        let most = self.part.frame.sections.most() as i32;
        let cull = self.part.frame.scene.quality.cull;
        for some in bucket.chunks(BATCH) {
            let mut n = 0;
            for v in some {
                self.batch.put(n, v, most);
                n += usize::from(!cull || open.is_near(v.cell.into()));
            }
            let added = self.add(n, k, &layers, sheets, open);
            counters.splatted += added;
            counters.culled += some.len() as u64 - added;
        }
    }

    #[inline(always)]
    fn splat_carried(
        &mut self,
        carried: &[(DeepVoxel, i32)],
        sheets: &mut Sheets<'_, S, N>,
        open: &OpenMask,
        counters: &mut Counters,
    ) {
        let k = self.part.slab.first;
        let layers = layers(self.part, k);
        let most = self.part.frame.sections.most() as i32;
        for some in carried.chunks(BATCH) {
            for (i, (v, first)) in some.iter().enumerate() {
                self.batch.put(i, v, most - (k - first));
            }
            let added = self.add(some.len(), k, &layers, sheets, open);
            counters.splatted += added;
            counters.culled += some.len() as u64 - added;
        }
    }
}

/// Footprints of the sheets from `k` that a voxel may reach, by slot.
#[inline(always)]
fn layers<'a, S: Recorded, const N: usize>(part: &'a Part<'_>, k: i32) -> [Layer<'a, S>; N] {
    let last = (k + part.frame.sections.most() as i32 - 1).min(part.frame.footprints.last());
    std::array::from_fn(|at| {
        // Sheets farther back than a voxel reaches are not asked for; any will do.
        let sheet = (k + after::<N>(k, at)).min(last);
        let footprint = part.frame.footprints.at(sheet).expect("no sheet of the part is clipped");
        let axes = [0, 1].map(|axis| {
            footprint.phases(axis).zip(S::across(&footprint, axis)).expect("footprints have tables")
        });
        Layer { scale: footprint.scale, axes }
    })
}

/// How many sheets behind sheet `k` is the next one that `at` is the slot of.
#[inline(always)]
fn after<const N: usize>(k: i32, at: usize) -> i32 {
    ((at + N - slot::<N>(k)) % N) as i32
}

impl<S: Recorded, const N: usize> DeepStage<'_, S, N> {
    /// Adds the first `n` voxels of the batch to their sheets from `k` on, which `layers` are of; not
    /// those around which all is shut. How many it added.
    #[inline(always)]
    fn add(
        &mut self,
        n: usize,
        k: i32,
        layers: &[Layer<'_, S>; N],
        sheets: &mut Sheets<'_, S, N>,
        open: &OpenMask,
    ) -> u64 {
        let Part { frame, rect, .. } = self.part;
        let Batch { eye, samples, normals, left, z, first, from, lo, hi, kept, light } =
            &mut *self.batch;
        let view = &frame.view;
        for (z, &depth) in z[..n].iter_mut().zip(&eye[2]) {
            *z = view.depth_in_phases(depth);
        }
        // Where each section lies, and the windows that hold all of a voxel's.
        let most = frame.sections.most() as i32;
        for (axis, origin) in [rect.x0, rect.y0].into_iter().enumerate() {
            let (eye, lo, hi) = (&eye[axis][..n], &mut lo[axis][..n], &mut hi[axis][..n]);
            lo.fill(i32::MAX);
            hi.fill(i32::MIN);
            for (at, layer) in layers.iter().enumerate() {
                let sheet = after::<N>(k, at);
                if sheet >= most {
                    continue;
                }
                let phases = &layer.axes[axis].0;
                let (len, scale) = (phases.len as i32, layer.scale);
                let (first, from) = (&mut first[axis][at][..n], &mut from[axis][at][..n]);
                for i in 0..n {
                    let at = view.screen_along(axis, eye[i], scale);
                    let (pixel, phase) =
                        ((at >> SUBPIXEL_BITS) as i32, at as i32 & (SUBPIXELS - 1));
                    first[i] = pixel - origin + phases.first(phase);
                    from[i] = phases.begin(phase as usize) as u32;
                }
                for i in 0..n {
                    let here = sheet < left[i];
                    lo[i] = if here { lo[i].min(first[i]) } else { lo[i] };
                    hi[i] = if here { hi[i].max(first[i] + len) } else { hi[i] };
                }
            }
            // Inside the part.
            for i in 0..n {
                (lo[i], hi[i]) = (lo[i].max(0), hi[i].min(PART));
            }
        }
        let (mut some, cull) = (0, frame.scene.quality.cull);
        for i in 0..n {
            let ([x0, y0], [x1, y1]) = ([lo[0][i], lo[1][i]], [hi[0][i], hi[1][i]]);
            if x0 >= x1 || y0 >= y1 {
                continue;
            }
            let columns = (u64::MAX >> (64 - (x1 - x0))) << x0;
            if cull && (y0..y1).fold(0, |rows, y| rows | open.row(y as usize)) & columns == 0 {
                continue;
            }
            kept[some] = i as u32;
            for eye in &mut *eye {
                eye[some] = eye[i];
            }
            (samples[some], normals[some]) = (samples[i], normals[i]);
            some += 1;
        }
        let eyes = eye.each_ref().map(|e| &e[..some]);
        frame.payloads(&samples[..some], &normals[..some], Some(eyes), light);
        let sections = S::deep(&frame.sections);
        for (j, &i) in kept[..some].iter().enumerate() {
            let i = i as usize % BATCH;
            // From an even column, and as many: two of them may lie in one register.
            let lo = [lo[0][i] & !1, lo[1][i]];
            let wide = [(hi[0][i] - lo[0] + 1) & !1, hi[1][i] - lo[1]].map(|n| n as usize);
            let mut deep = [S::Depth::default(); N];
            let gone = (most - left[i]) as usize;
            let row = (z[i] & (frame.sections.phases() - 1)) as usize * most as usize;
            for (sheet, &w) in sections[row..][..most as usize][gone..].iter().enumerate() {
                deep[(slot::<N>(k) + sheet) % N] = w;
            }
            for axis in 0..2 {
                // Loops, since closures of arrays are compiled for the baseline.
                let mut rows = [RowAt::NONE; N];
                for (at, row) in rows.iter_mut().enumerate() {
                    if after::<N>(k, at) < left[i] {
                        let (phases, table) = layers[at].axes[axis];
                        let (from, len) = (from[axis][at][i] as usize, phases.len);
                        *row = RowAt { table, from, len, column: first[axis][at][i] - lo[axis] };
                    }
                }
                S::weave(sheets.simd, rows, wide[axis], &mut self.across[axis]);
            }
            let [columns, lines] = [0, 1].map(|axis| &self.across[axis][..wide[axis]]);
            let at = lo[1] as usize * STRIDE + lo[0] as usize;
            let payload = S::payload(light.each_ref().map(|c| c[j]));
            S::splat_deep(sheets.simd, sheets.records, at, (columns, lines), payload, &deep);
            sheets.touch(k, lo.map(|p| p as usize), wide);
        }
        some as u64
    }
}

const _: () = assert!(EDGE == PART as usize && WINDOW <= EDGE);
