//! Parts of orthographic views in which all sections of a voxel share one footprint, in
//! whole-number sums: the fastest path.
//!
//! Footprints are in a table, and positions are integers ([`crate::primitives::positions`]; such a
//! view is called *flat* here). A voxel is a handful of integers, which are worked out sixteen at a
//! time:
//!
//! 1. **Toss.** Positions are a corner and an offset; one bit of the mask says whether a footprint
//!    may touch an open pixel. Voxels that may show wait in the bucket of their first sheet with
//!    all that drawing them takes, so that the brick is not read again.
//! 2. **Splat.** The bit is tested once more, since pixels were shut meanwhile; sixteen voxels are
//!    lit at once; each is added with all its sections to the pixel records of its footprint
//!    ([`crate::kernels::pixel_records`]). A footprint that leaves the part is moved inside and
//!    reads zeros.
//! 3. **Close.** Open pixels that were touched are composited sixteen at a time.
//!
//! The bytes are those of [`crate::oracle::serial`], which does none of this.

use crate::geometry::open_sheets::{Chunk, Due, EDGE, Queues, Sheets, Stage, Store, slot, walk};
use crate::kernels::pixel_records::{Recorded, Splat, Table, Tables, splat};
use crate::kernels::toss::{Sieve, Sifted, Tossing, prefetch};
use crate::kernels::{Simd, Work, whole_registers};
use crate::part::{Io, Part, Pixels};
use crate::primitives::footprint::Phases;
use crate::primitives::positions::Places;
use crate::primitives::sizes::PART;
use crate::scene::{Flat, Frame};
use crate::visibility::open_mask::OpenMask;
use slabcast_common::message::Counters;
use slabcast_common::view::SUBPIXELS;

/// Memory for waiting voxels that a render thread keeps from part to part.
#[derive(Default)]
pub struct Waiting {
    pub(crate) queues: Queues<Splat>,
    pub(crate) tossing: Tossing,
    pub(crate) batch: Batch,
}

/// Voxels that are shaded and splatted together. A bucket of a part has some 50; at 16 loops are
/// too short for lanes, at 1024 this is more than a first cache.
pub const BATCH: usize = 128;

/// Voxels on their way from a bucket to the records.
pub struct Batch {
    pub(crate) voxels: [Splat; BATCH],
    /// Number of a voxel's sheets that lie before the slab, if it begins before it.
    pub(crate) gone: [u32; BATCH],
    samples: [u32; BATCH],
    normals: [u16; BATCH],
    light: [[f32; BATCH]; 4],
}

impl Default for Batch {
    fn default() -> Self {
        Batch {
            voxels: [Splat::default(); BATCH],
            gone: [0; BATCH],
            samples: [0; BATCH],
            normals: [0; BATCH],
            light: [[0.0; BATCH]; 4],
        }
    }
}

impl Batch {
    /// Takes over those of `some` voxels, which are due at sheet `k`, that are still wanted, and
    /// has light fall on them; says how many there are.
    #[inline(always)]
    fn light<S: Recorded>(
        &mut self,
        (simd, part, open): (Simd, &Part<'_>, &OpenMask),
        (some, k): (&Chunk<'_, Splat>, i32),
        counters: &mut Counters,
        payloads: &mut [[S::Payload; 4]; BATCH],
    ) -> usize {
        let cull = part.frame.scene.quality.cull;
        let Batch { voxels, gone, samples, normals, light } = self;
        let n = some.keep(k, |n, v, of| {
            (voxels[n], gone[n]) = (*v, of as u32);
            !cull | open.is_near(v.cell())
        });
        for (i, v) in voxels[..n].iter().enumerate() {
            (samples[i], normals[i]) = (v.sample, v.normal());
        }
        let normals = &normals[..whole_registers::<BATCH>(n)];
        part.frame.payloads(simd, &samples[..n], normals, light);
        let [sigma, r, g, b] = light;
        for (i, payload) in payloads[..n].iter_mut().enumerate() {
            *payload = S::payload([sigma[i], r[i], g[i], b[i]]);
        }
        counters.culled += (some.len() - n) as u64;
        counters.splatted += n as u64;
        n
    }
}

/// Work that draws one part of an orthographic view into pixel records; it is compiled once for
/// each instruction set.
pub struct RenderOrtho<'a, S: Recorded, const N: usize> {
    pub(crate) part: Part<'a>,
    pub(crate) view: &'a Flat,
    pub(crate) store: &'a mut Store<S>,
    pub(crate) waiting: &'a mut Waiting,
    pub(crate) pixels: &'a mut Pixels,
    pub(crate) io: Io<'a>,
}

/// Returns the integer positions of `frame` if its parts may be drawn here.
pub(crate) fn accepts(frame: &Frame) -> Option<&Flat> {
    let fits = |flat: &&Flat| flat.reach.iter().all(|reach| 2 * reach < PART);
    frame.flat.as_ref().filter(fits).filter(|_| frame.leaning.is_none())
}

impl<S: Recorded, const N: usize> Work for RenderOrtho<'_, S, N> {
    type Out = ();
    #[inline(always)]
    fn run(self, simd: Simd) {
        let RenderOrtho { part, view: flat, store, waiting, pixels, io } = self;
        let footprint = part.frame.footprints.at(0).expect("a flat view's sheets are all drawn");
        let axis = |axis| {
            let phases = footprint.phases(axis)?;
            Some((phases, Table { weights: S::across(&footprint, axis)?, len: phases.len }))
        };
        let [(phases_x, x), (phases_y, y)] =
            [0, 1].map(|a| axis(a).expect("a flat view's footprints have tables"));
        let sections = &part.frame.sections;
        let deep = Table { weights: S::deep(sections), len: sections.most() };
        let tables = Tables { across: [x, y], deep };
        let Waiting { queues, tossing, batch } = waiting;
        let phases = [phases_x, phases_y];
        let stage = FlatStage { part: &part, simd, flat, phases, tables, tossing, batch };
        let sheets = Sheets::<S, N>::new(simd, store, part.frame.sections.most());
        walk(&part, stage, sheets, queues, pixels, io);
    }
}

/// Arguments of a toss: a voxel's brick among the part's, the open pixels, the queues and the
/// counts.
pub(crate) type Asked<'a> = (usize, &'a OpenMask, &'a mut Queues<Splat>, &'a mut Counters);

/// [`Stage::toss`] for integer positions.
#[inline(always)]
pub(crate) fn toss(
    part: &Part<'_>,
    simd: Simd,
    flat: &Flat,
    across: &[Phases; 2],
    tossing: &mut Tossing,
    (which, open, queues, counters): Asked<'_>,
) {
    let Part { frame, rect, slab, .. } = part;
    let Some((brick, corner)) = part.open_brick(which, open, counters) else { return };
    if let Some(next) = part.peek(which + 1) {
        prefetch(next);
    }
    let base = part.first_sheet(which);
    let origin = [
        i64::from(rect.x0 * SUBPIXELS),
        i64::from(rect.y0 * SUBPIXELS),
        i64::from(base) * i64::from(frame.sections.phases()),
    ];
    let sieve = Sieve {
        places: &flat.places,
        from: Places::from(corner.flat, origin),
        open,
        cull: frame.scene.quality.cull,
        sections: &frame.sections,
        // From the sheet that depths are counted from.
        sheets: [slab.first, slab.end].map(|k| k - base),
    };
    let Sifted { reached, kept } = sieve.sift(simd, brick, across, tossing);
    counters.tossed += kept as u64;
    counters.culled += (reached - kept) as u64;
    for (first, voxel) in tossing.ready(kept) {
        let first = base + *first;
        if first < slab.first {
            queues.carried.push((*voxel, first));
        } else {
            queues.buckets[(first - slab.first) as usize].push(voxel);
        }
    }
}

struct FlatStage<'a, S: Recorded> {
    part: &'a Part<'a>,
    simd: Simd,
    flat: &'a Flat,
    /// Layouts of the weights across and down.
    phases: [Phases; 2],
    tables: Tables<'a, S>,
    tossing: &'a mut Tossing,
    batch: &'a mut Batch,
}

impl<S: Recorded, const N: usize> Stage<S, N> for FlatStage<'_, S> {
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
        toss(self.part, self.simd, self.flat, &self.phases, self.tossing, asked);
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
        let mut payloads = [[S::Payload::default(); 4]; BATCH];
        let mut corners = [0; EDGE];
        let slot = slot::<N>(k);
        for some in due.chunks(BATCH) {
            let asked = (self.simd, self.part, open);
            let n = self.batch.light::<S>(asked, (&some, k), counters, &mut payloads);
            let Batch { voxels, gone, .. } = &*self.batch;
            for ((v, &gone), &payload) in voxels[..n].iter().zip(gone).zip(&payloads) {
                let [x, y] = v.first();
                corners[y % EDGE] |= 1 << x;
                let voxel = (v, payload, gone as usize);
                splat::<S, N>(sheets.simd, sheets.records, voxel, slot, &self.tables);
            }
        }
        sheets.touch_all(k, &corners, self.tables.across.map(|t| t.len));
    }
}
