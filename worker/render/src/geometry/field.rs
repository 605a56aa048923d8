//! Parts of a field in orthographic views of cubic lattices, in pixel records.
//!
//! All planes of a voxel share one footprint, and positions are integers, as in
//! [`crate::geometry::ortho`], which tosses. A voxel adds its value to a record of N planes, each a
//! value and three derivatives, at every pixel of its footprint ([`crate::kernels::field`]).

use crate::geometry::open_sheets::{Chunk, Due, EDGE, Queues, Sheets, Stage, Store, slot, walk};
use crate::geometry::ortho::{self, Packing};
use crate::kernels::field::{FieldSum, Four, splat_records, weighted};
use crate::kernels::pixel_records::{MOST, Splat};
use crate::kernels::toss::Tossing;
use crate::kernels::{Simd, Work};
use crate::part::{Io, Part, Pixels};
use crate::primitives::footprint::Phases;
use crate::scene::{Flat, Frame};
use crate::visibility::open_mask::OpenMask;
use slabcast_common::message::Counters;

/// Work that draws one part of a field in records of `N` planes.
pub struct RenderField<'a, S: FieldSum, const N: usize> {
    pub(crate) part: Part<'a>,
    pub(crate) view: &'a Flat,
    pub(crate) store: &'a mut Store<S>,
    pub(crate) waiting: &'a mut ortho::Waiting,
    pub(crate) pixels: &'a mut Pixels,
    pub(crate) io: Io<'a>,
}

/// Returns the integer positions of `frame` if its parts may be drawn here.
pub(crate) fn accepts(frame: &Frame) -> Option<&Flat> {
    ortho::accepts(frame).filter(|_| frame.is_field() && frame.sections.most() <= MOST)
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
        let ortho::Waiting { queues, tossing, .. } = waiting;
        let stage = FieldStage::<S> { part: &part, simd, flat, phases, across, deep, tossing };
        let sheets = Sheets::<S, N>::new(simd, store, sections.most());
        walk(&part, stage, sheets, queues, pixels, io);
    }
}

impl<S: FieldSum, const N: usize> Stage<Sheets<'_, S, N>> for FieldStage<'_, S> {
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
        let packing = Packing::Window(&self.phases);
        let asked = (which, open, queues, counters);
        ortho::toss(self.part, self.simd, self.flat, packing, self.tossing, asked);
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
        let mut splatted = 0;
        let mut add = |v: &Splat, gone: i32| {
            let payload = S::payload_of(rule.payload(v.sample));
            if S::is_nothing(payload) || cull && !open.is_near(v.cell()) {
                return;
            }
            splatted += 1;
            let [x, y] = v.first();
            corners[y % EDGE] |= 1 << x;
            let deep = self.deep.row(v.phase() as usize * self.deep.len);
            let mut planes = [[S::Term::default(); 4]; N];
            for (i, &wz) in deep.iter().enumerate().skip(gone as usize) {
                planes[(slot::<N>(k) + i - gone as usize) % N] = weighted::<S>([payload; 4], wz);
            }
            let [x, y] = [v.rows & 0xffff, v.rows >> 16];
            let across = (self.across[0].row(x as usize), self.across[1].row(y as usize));
            splat_records::<S, N>(sheets.records, v.at(), across, &planes);
        };
        let mut all = 0;
        for some in due.chunks(usize::MAX) {
            all += some.len() as u64;
            match some {
                Chunk::Here(some) => some.iter().for_each(|v| add(v, 0)),
                Chunk::Before(some) => some.iter().for_each(|(v, first)| add(v, k - first)),
            }
        }
        counters.splatted += splatted;
        counters.culled += all - splatted;
        sheets.touch_all(k, &corners, [0, 1].map(|a| self.across[a].len));
    }
}
