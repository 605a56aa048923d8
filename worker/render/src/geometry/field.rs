//! Parts of a field in pixel records: a voxel adds its value to a record of N planes, each a value
//! and three derivatives, at every pixel of its footprint ([`crate::kernels::field`]).
//!
//! In orthographic views of cubic lattices ([`RenderField`]) all planes of a voxel share one
//! footprint, and positions are integers, as in [`crate::geometry::ortho`], which tosses. In
//! perspective, and where planes of a kernel that leans lie beside each other
//! ([`RenderFieldApart`]), each plane has a footprint of its own; weights are interleaved by column,
//! row and plane over the window that holds them all. Views whose rows lean, and kernels that meet
//! more planes than a record holds, are drawn by [`crate::geometry::general`].

use crate::geometry::open_sheets::{Due, EDGE, Queues, Sheets, Stage, Store, slot, walk};
use crate::geometry::ortho::{self, BATCH, Batch};
use crate::kernels::field::{FieldSum, Four, planes_of, splat_records, splat_woven, weighted};
use crate::kernels::pixel_records::{MOST, STRIDE, Splat};
use crate::kernels::toss::Tossing;
use crate::kernels::{Simd, Work};
use crate::part::{Io, Part, Pixels};
use crate::primitives::footprint::Phases;
use crate::scene::{Flat, Frame, Placed};
use crate::visibility::open_mask::OpenMask;
use slabcast_common::message::Counters;
use slabcast_common::occlusion::Rect;

/// Work that draws one part of a field in records of `N` planes.
pub struct RenderField<'a, S: FieldSum, const N: usize> {
    pub(crate) part: Part<'a>,
    pub(crate) view: &'a Flat,
    pub(crate) store: &'a mut Store<S>,
    pub(crate) waiting: &'a mut ortho::Waiting,
    pub(crate) pixels: &'a mut Pixels,
    pub(crate) io: Io<'a>,
}

/// Weights of one axis.
struct Along<'a, S: FieldSum> {
    taps: &'a [Four<S>],
    len: usize,
}

impl<'a, S: FieldSum> Along<'a, S> {
    #[inline(always)]
    fn row(&self, from: usize) -> &'a [Four<S>] {
        &self.taps[from..from + self.len]
    }
}

struct FieldStage<'a, S: FieldSum> {
    part: &'a Part<'a>,
    simd: Simd,
    flat: &'a Flat,
    phases: [Phases; 2],
    across: [Along<'a, S>; 2],
    deep: Along<'a, S>,
    tossing: &'a mut Tossing,
    batch: &'a mut Batch,
}

impl<S: FieldSum, const N: usize> Work for RenderField<'_, S, N> {
    type Out = ();
    #[inline(always)]
    fn run(self, simd: Simd) {
        let RenderField { part, view: flat, store, waiting, pixels, io } = self;
        let footprint = part.frame.footprints.at(0).expect("a flat view's sheets are all drawn");
        let phases = [0, 1].map(|a| footprint.phases(a).expect("a flat view has tables"));
        let across = [0, 1].map(|a| {
            let taps = footprint.field(a).expect("a flat view has tables");
            Along { taps: S::taps(taps), len: phases[a].len }
        });
        let sections = &part.frame.sections;
        let deep = Along { taps: S::taps(sections.field()), len: sections.most() };
        let ortho::Waiting { queues, tossing, batch } = waiting;
        let stage =
            FieldStage::<S> { part: &part, simd, flat, phases, across, deep, tossing, batch };
        let sheets = Sheets::<S, N>::new(simd, store, sections.most());
        walk(&part, stage, sheets, queues, pixels, io);
    }
}

impl<S: FieldSum, const N: usize> Stage<S, N> for FieldStage<'_, S> {
    type Voxel = Splat;

    #[inline(always)]
    fn reach(&self) -> [i32; 2] {
        self.flat.reach
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
        ortho::toss(self.part, self.simd, self.flat, &self.phases, self.tossing, asked);
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
        let rule = self.part.frame.field.as_ref().expect("a field's frame");
        let cull = self.part.frame.scene.quality.cull;
        let mut corners = [0; EDGE];
        for some in due.chunks(BATCH) {
            let Batch { voxels, gone, .. } = &mut *self.batch;
            // One loop over both kinds: what draws them is a lot of code, which must be compiled
            // where it is called.
            let n = some.keep(k, |n, v, of| {
                (voxels[n], gone[n]) = (*v, of as u32);
                !cull | open.is_near(v.cell())
            });
            counters.culled += (some.len() - n) as u64;
            for (v, &gone) in voxels[..n].iter().zip(&gone[..n]) {
                let payload = S::payload_of(rule.payload(v.sample));
                if S::is_nothing(payload) {
                    continue;
                }
                counters.splatted += 1;
                let [x, y] = v.first();
                corners[y % EDGE] |= 1 << x;
                let deep = self.deep.row(v.phase() as usize * self.deep.len);
                let mut planes = [[S::Term::default(); 4]; N];
                let first = slot::<N>(k) + N - gone as usize % N;
                for (i, &wz) in deep.iter().enumerate().skip(gone as usize) {
                    planes[(first + i) % N] = weighted::<S>([payload; 4], wz);
                }
                let [x, y] = [v.rows & 0xffff, v.rows >> 16];
                let across = (self.across[0].row(x as usize), self.across[1].row(y as usize));
                splat_records::<S, N>(sheets.simd, sheets.records, v.at(), across, &planes);
            }
        }
        sheets.touch_all(k, &corners, [0, 1].map(|a| self.across[a].len));
    }
}

/// Work that draws one part of a field whose planes have footprints of their own.
pub struct RenderFieldApart<'a, S: FieldSum, const N: usize> {
    pub(crate) part: Part<'a>,
    pub(crate) store: &'a mut Store<S>,
    pub(crate) queues: &'a mut Queues<Apart>,
    pub(crate) pixels: &'a mut Pixels,
    pub(crate) io: Io<'a>,
}

/// Returns whether parts of `frame` may be drawn with a footprint for each plane.
pub(crate) fn accepts_apart(frame: &Frame) -> bool {
    let skewed = frame.leaning.as_ref().is_some_and(|leaning| leaning.row() != 0);
    !skewed && frame.sections.most() <= MOST
}

/// A voxel waiting in the bucket of its first plane.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Apart {
    placed: Placed,
    /// Contribution to a sum for a weight of one, in raw units.
    payload: f32,
}

struct ApartStage<'a> {
    part: &'a Part<'a>,
}

impl<S: FieldSum, const N: usize> Work for RenderFieldApart<'_, S, N> {
    type Out = ();
    #[inline(always)]
    fn run(self, simd: Simd) {
        let RenderFieldApart { part, store, queues, pixels, io } = self;
        let sheets = Sheets::<S, N>::new(simd, store, part.frame.sections.most());
        walk(&part, ApartStage { part: &part }, sheets, queues, pixels, io);
    }
}

/// Weights of a voxel's planes along one axis, where they are inside the part.
struct Windows<'a, S: FieldSum, const N: usize> {
    /// First pixel and weights of each plane, by slot.
    planes: [(i32, &'a [Four<S>]); N],
    /// Pixels of all planes.
    first: i32,
    end: i32,
}

impl<'a, S: FieldSum, const N: usize> Windows<'a, S, N> {
    const NONE: Self = Windows { planes: [(0, &[]); N], first: i32::MAX, end: i32::MIN };

    #[inline(always)]
    fn put(&mut self, slot: usize, (first, taps): (i32, &'a [Four<S>])) {
        self.planes[slot] = (first, taps);
        if !taps.is_empty() {
            self.first = self.first.min(first);
            self.end = self.end.max(first + taps.len() as i32);
        }
    }

    /// Puts the weights beside each other, pixel by pixel and slot by slot.
    #[inline(always)]
    fn weave<'b>(&self, to: &'b mut [[Four<S>; N]; EDGE]) -> &'b [[Four<S>; N]] {
        let to = &mut to[..(self.end - self.first) as usize];
        to.fill([[S::Term::default(); 4]; N]);
        for (slot, (first, taps)) in self.planes.iter().enumerate().filter(|p| !p.1.1.is_empty()) {
            let from = (first - self.first) as usize;
            for (to, tap) in to[from..from + taps.len()].iter_mut().zip(*taps) {
                to[slot] = *tap;
            }
        }
        to
    }
}

impl<S: FieldSum, const N: usize> Stage<S, N> for ApartStage<'_> {
    type Voxel = Apart;

    #[inline(always)]
    fn reach(&self) -> [i32; 2] {
        [0; 2]
    }

    #[inline(always)]
    fn toss(
        &mut self,
        which: usize,
        open: &OpenMask,
        queues: &mut Queues<Apart>,
        counters: &mut Counters,
    ) {
        let Part { frame, slab, .. } = self.part;
        let Some((brick, corner)) = self.part.open_brick(which, open, counters) else { return };
        let rule = frame.field.as_ref().expect("a field's frame");
        for (i, &local) in brick.index.iter().enumerate() {
            let placed = frame.place(corner, local);
            let (first, count) = frame.sections.span(placed.z);
            let payload = frame.field_payload(rule, brick, i);
            if first >= slab.end || first + count as i32 <= slab.first || payload == 0.0 {
                continue;
            }
            counters.tossed += 1;
            let voxel = Apart { placed, payload };
            if first < slab.first {
                queues.carried.push((voxel, first));
            } else {
                queues.buckets[(first - slab.first) as usize].push(&voxel);
            }
        }
    }

    #[inline(always)]
    fn splat(
        &mut self,
        due: &Due<'_, Apart>,
        k: i32,
        sheets: &mut Sheets<'_, S, N>,
        open: &OpenMask,
        counters: &mut Counters,
    ) {
        let Part { frame, rect, .. } = self.part;
        let cull = frame.scene.quality.cull;
        let footprints: [_; N] = std::array::from_fn(|i| frame.footprints.at(k + i as i32));
        let (mut bx, mut by) = ([const { Vec::new() }; N], [const { Vec::new() }; N]);
        let [mut wx, mut wy] = [[[[S::Term::default(); 4]; N]; EDGE]; 2];
        let mut some = [(Apart::default(), 0); BATCH];
        for chunk in due.chunks(BATCH) {
            let n = chunk.keep(k, |n, v, gone| {
                some[n] = (*v, gone);
                true
            });
            for (v, gone) in &some[..n] {
                let payload = S::payload_of(v.payload);
                let planes = planes_of::<S>(&frame.sections, v.placed.z);
                let mut sections = [[S::Term::default(); 4]; N];
                let [mut x, mut y] = [Windows::<S, N>::NONE; 2];
                let planes = planes.iter().skip(*gone as usize);
                let buffers = bx.iter_mut().zip(&mut by);
                for (i, ((wz, footprint), (bx, by))) in
                    planes.zip(&footprints).zip(buffers).enumerate()
                {
                    let Some(footprint) = footprint else { continue };
                    let sheet = k + i as i32;
                    let slot = slot::<N>(sheet);
                    let at = frame.screen(&v.placed, sheet, footprint);
                    x.put(slot, S::window(footprint, 0, at[0], (rect.x0, rect.x1), bx));
                    y.put(slot, S::window(footprint, 1, at[1], (rect.y0, rect.y1), by));
                    sections[slot] = weighted::<S>([payload; 4], *wz);
                }
                if x.first >= x.end || y.first >= y.end || S::is_nothing(payload) {
                    continue;
                }
                let seen = Rect::new(x.first, y.first, x.end, y.end);
                if cull && !open.any(&seen) {
                    counters.culled += 1;
                    continue;
                }
                counters.splatted += 1;
                let (wx, wy) = (x.weave(&mut wx), y.weave(&mut wy));
                let [x, y] = [(x.first - rect.x0) as usize, (y.first - rect.y0) as usize];
                sheets.touch(k, x..x + wx.len(), y..y + wy.len());
                splat_woven::<S, N>(
                    sheets.simd,
                    sheets.records,
                    y * STRIDE + x,
                    (wx, wy),
                    &sections,
                );
            }
        }
    }
}
