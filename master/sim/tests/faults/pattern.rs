//! Scenes without samples and a renderer without splats: a pure function of view, slab, bricks
//! and tile state, with the one property that the schedule relies on. A slab goes on from where
//! the last one stopped, and nothing is drawn where no brick is or where a pixel is shut.
//!
//! [`Patterns`] lets virtual workers draw them, at a microsecond a pixel and sheet.

use slabcast_common::brick::{BRICK_EDGE, BrickGrid, BrickInfo, BrickSetKey, TightBox};
use slabcast_common::ids::{BrickId, FrameId, SceneId};
use slabcast_common::image::{Background, FrameState, Picture, PixelFormat, TilePixels, TileState};
use slabcast_common::image::{PixelEncoding, SparseTile};
use slabcast_common::message::{Checkpoint, Counters, Lease, Pixels, RegionLease, SceneSpec};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Quality, Work};
use slabcast_common::region::{parts, split_tile};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Camera, CameraProjection, Projected, View};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_scene::presets;
use slabcast_schedule::{FrameJob, is_shut};
use slabcast_sim::{
    FrameSetup, Region, Rng, Split, TaskFacts, TaskOutput, TileModel, Unpredictable,
};
use slabcast_trace::HasBrick;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

pub(crate) fn key(n: u8) -> BrickSetKey {
    BrickSetKey(Digest32([n; 32]))
}

/// Bricks of a volume of `dims` in which about `fill` of 8 are relevant.
pub(crate) fn bricks(rng: &mut Rng, dims: [u32; 3], fill: u64) -> Arc<[BrickInfo]> {
    let grid = BrickGrid::new(dims);
    let mut bricks = Vec::new();
    for id in (0..grid.len() as u32).map(BrickId) {
        if rng.below(8) >= fill {
            continue;
        }
        let corner = grid.corner(id);
        let lo: [u32; 3] = std::array::from_fn(|a| corner[a] + rng.below(3) as u32);
        let hi = std::array::from_fn(|a| (corner[a] + BRICK_EDGE - 1).min(dims[a] - 1).max(lo[a]));
        let voxels = 1 + rng.below(512) as u16;
        let tight = TightBox { lo, hi };
        bricks.push(BrickInfo { id, tight, voxels, bytes: 11 + 3 * u32::from(voxels) });
    }
    bricks.into()
}

pub(crate) fn scene(id: u64, set: BrickSetKey, dims: [u32; 3], quality: Quality) -> Arc<SceneSpec> {
    let volume = Volume::from_fn_u8("fake", dims, |i, j, k| (i + j + k) as u8);
    let info = volume.info(Digest32([7; 32]));
    let transfer = presets::by_name("grey", &info.summary).expect("a known name");
    Arc::new(SceneSpec {
        id: SceneId(id),
        volume: info,
        transfer,
        quality,
        crop: None,
        bricks: set,
    })
}

pub(crate) fn view(rng: &mut Rng, scene: &SceneSpec, size: [u32; 2]) -> View {
    let turn = |rng: &mut Rng| rng.below(2001) as f64 / 1000.0 - 1.0;
    let lattice = &scene.volume.lattice;
    let extent = lattice.largest_extent();
    let projection = if rng.below(3) == 0 {
        CameraProjection::Persp { fov: 40.0, distance: extent * 1.4 }
    } else {
        CameraProjection::Ortho { height: extent * (0.6 + rng.below(100) as f64 / 100.0) }
    };
    let camera = Camera {
        to_eye: [turn(rng), turn(rng), 0.1 + turn(rng).abs()].into(),
        up: [0.1, 1.0, 0.2].into(),
        target: [0.0; 3].into(),
        projection,
    };
    View::new(lattice, &camera, size, &scene.quality).expect("a camera that can be drawn")
}

pub(crate) fn job(
    rng: &mut Rng,
    frame: u64,
    scene: &Arc<SceneSpec>,
    bricks: &Arc<[BrickInfo]>,
    size: [u32; 2],
    work: Work,
) -> Box<FrameJob> {
    let view = view(rng, scene, size);
    let (scene, bricks) = (scene.clone(), bricks.clone());
    let finish = [None, Some(PixelFormat::Rgb8), None, Some(PixelFormat::Rgba32F)]
        [(frame % 4) as usize]
        .map(|format| PixelEncoding { format, background: Background::Colour([0.1, 0.7, 0.4]) });
    Box::new(FrameJob {
        frame: FrameId(frame),
        number: frame,
        scene,
        bricks,
        view,
        work,
        finish,
        client: 0,
    })
}

/// Returns the rectangle and sheets of each brick of a job.
pub(crate) fn projections(job: &FrameJob) -> BTreeMap<BrickId, Projected> {
    job.bricks.iter().filter_map(|b| Some((b.id, job.view.project(&b.tight)?))).collect()
}

fn mix(mut x: u64) -> u64 {
    x ^= x >> 31;
    x = x.wrapping_mul(0x7fb5_d329_728e_a185);
    x ^= x >> 27;
    x = x.wrapping_mul(0x81da_def4_bc2d_d44d);
    x ^ (x >> 33)
}

/// Renders a tile of a slab.
pub(crate) fn render(
    projections: &BTreeMap<BrickId, Projected>,
    quality: &Quality,
    tile: Rect,
    slab: SheetRange,
    bricks: &[BrickId],
    state: &TileState,
) -> TilePixels {
    let n = tile.area();
    let mut a = state.a.clone();
    let mut colour = vec![[0u32; 3]; n];
    let mut last = state.last.clone().unwrap_or_else(|| vec![[0; 4]; n]);
    let mut sums = vec![0u32; n];
    for sheet in slab.first..slab.end {
        sums.fill(0);
        let one = SheetRange::new(sheet, sheet + 1);
        for id in bricks {
            let Some(p) = projections.get(id).filter(|p| p.sheets.overlaps(one)) else { continue };
            let r = p.rect.intersect(&tile);
            let h = mix(u64::from(id.0) << 20 | (sheet as u64 & 0xffff)) as u32 & 0xffff;
            for y in r.y0..r.y1 {
                let row = (y - tile.y0) as usize * tile.width();
                for x in r.x0..r.x1 {
                    sums[row + (x - tile.x0) as usize] += h;
                }
            }
        }
        for i in 0..n {
            let s = sums[i];
            if is_shut(a[i], quality.eps) {
                continue;
            }
            if s > 0 {
                let open = 1.0 - a[i];
                let bits = s ^ last[i][0].rotate_left(7);
                for (c, to) in colour[i].iter_mut().enumerate() {
                    *to = to.wrapping_add((bits >> (5 * c)) & 0xfff);
                    *to = to.wrapping_add((open * 4096.0) as u32);
                }
                a[i] += open * ((s % 251) as f32 / 512.0);
            }
            last[i] = [s, s / 3, 0, 0];
        }
    }
    let blank = last.iter().all(|l| *l == [0; 4]);
    TilePixels { a, colour, last: (!blank).then_some(last) }
}

/// The picture of a job, on one thread, plainly: the oracle.
pub(crate) fn serial(job: &FrameJob) -> Picture {
    let p = projections(job);
    let sheets = p.values().fold(SheetRange::default(), |all, p| all.union(p.sheets));
    let all: Vec<_> = job.bricks.iter().map(|b| b.id).collect();
    let whole = Rect::from_size(job.view.size);
    let mut state = FrameState::new(job.view.size);
    let pixels = render(&p, &job.scene.quality, whole, sheets, &all, &state.tile_state(whole));
    state.add_slab_tile(whole, &pixels);
    state.to_picture()
}

/// Nanoseconds to draw a pixel of a sheet.
const PIXEL_SHEET_NS: f64 = 1_000.0;

type Projections = BTreeMap<BrickId, Projected>;

/// A model whose tiles are drawn: by [`render`], sheet after sheet.
#[derive(Default)]
pub(crate) struct Patterns {
    projections: BTreeMap<FrameId, Arc<Projections>>,
}

/// A region that is drawn.
pub(crate) struct DrawnRegion {
    job: FrameJob,
    projections: Arc<Projections>,
    tile: Rect,
    /// Sheets of the bricks over the tile.
    sheets: SheetRange,
    /// The state where this run or piece began, and for how long it was drawn since.
    origin: (i32, TilePixels),
    done_ns: f64,
    /// The state as far as the bricks reach, and a brick that it stopped for.
    reached: (i32, TilePixels),
    stopped_for: Option<u32>,
    /// Bricks over the tile, with their places.
    over: Vec<(u32, BrickId, Projected)>,
    touched: BTreeSet<u32>,
}

impl Patterns {
    fn projections(&mut self, job: &FrameJob) -> Arc<Projections> {
        let new = || Arc::new(projections(job));
        self.projections.entry(job.frame).or_insert_with(new).clone()
    }
}

fn blank(tile: Rect) -> TilePixels {
    let n = tile.area();
    TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: None }
}

fn counters(tile: Rect) -> Counters {
    let n = tile.area() as u64;
    Counters { tossed: 2 * n, splatted: n, culled: 0 }
}

/// Bricks over a tile, with their places.
fn over(job: &FrameJob, projections: &Projections, tile: Rect) -> Vec<(u32, BrickId, Projected)> {
    let all = (0u32..).zip(job.bricks.iter());
    let over = all.filter_map(|(place, b)| {
        let p = projections.get(&b.id)?;
        (!p.rect.intersect(&tile).is_empty()).then_some((place, b.id, *p))
    });
    over.collect()
}

impl DrawnRegion {
    fn sheet_ns(&self) -> f64 {
        self.tile.area() as f64 * PIXEL_SHEET_NS
    }

    /// Whether a brick may change an open pixel.
    fn is_visible(&self, pixels: &TilePixels, p: &Projected) -> bool {
        let quality = &self.job.scene.quality;
        let r = p.rect.intersect(&self.tile);
        let mut rows = r.y0..r.y1;
        !quality.cull
            || rows.any(|y| {
                let row = (y - self.tile.y0) as usize * self.tile.width();
                let at = |x: i32| row + (x - self.tile.x0) as usize;
                (r.x0..r.x1).any(|x| !is_shut(pixels.a[at(x)], quality.eps))
            })
    }

    /// Places of the bricks that drawing lacks at a state, up to so many sheets ahead.
    fn lacks(&self, state: &(i32, TilePixels), ahead: i32, has: HasBrick<'_>) -> Vec<u32> {
        let (k, pixels) = state;
        let is_due = |p: &Projected| p.sheets.first <= k + ahead && p.sheets.end > *k;
        let over = self.over.iter().filter(|(place, _, p)| is_due(p) && !has(*place));
        over.filter(|(_, _, p)| self.is_visible(pixels, p)).map(|(place, ..)| *place).collect()
    }

    /// Draws from a state on, up to a sheet or to the first that lacks a brick.
    fn draw(
        &mut self,
        mut state: (i32, TilePixels),
        until: i32,
        has: HasBrick<'_>,
    ) -> (i32, TilePixels) {
        while state.0 < self.sheets.end.min(until) && self.lacks(&state, 0, has).is_empty() {
            let (k, mut pixels) = state;
            let drawn: Vec<(u32, BrickId)> = self
                .over
                .iter()
                .filter(|(place, _, p)| {
                    p.sheets.first <= k && has(*place) && self.is_visible(&pixels, p)
                })
                .map(|(place, id, _)| (*place, *id))
                .collect();
            let ids: Vec<BrickId> = drawn.iter().map(|d| d.1).collect();
            let before = TileState { a: pixels.a.clone(), last: pixels.last.take() };
            let (one, quality) = (SheetRange::new(k, k + 1), &self.job.scene.quality);
            let more = render(&self.projections, quality, self.tile, one, &ids, &before);
            for (sum, add) in pixels.colour.iter_mut().zip(&more.colour) {
                for c in 0..3 {
                    sum[c] = sum[c].wrapping_add(add[c]);
                }
            }
            (pixels.a, pixels.last) = (more.a, more.last);
            self.touched.extend(drawn.iter().map(|d| d.0));
            state = (k + 1, pixels);
        }
        state
    }

    fn total_ns(&self) -> f64 {
        f64::from(self.reached.0 - self.origin.0) * self.sheet_ns()
    }
}

impl Region for DrawnRegion {
    fn resume(&mut self) {
        if self.done_ns + 1.0 >= self.total_ns() {
            (self.origin, self.done_ns) = (self.reached.clone(), 0.0);
        }
    }

    fn runs_ns(&mut self, has: HasBrick<'_>) -> f64 {
        if self.stopped_for.is_none_or(has) && self.reached.0 < self.sheets.end {
            let reached = std::mem::take(&mut self.reached.1);
            self.reached = self.draw((self.reached.0, reached), i32::MAX, has);
            self.stopped_for = self.lacks(&self.reached, 0, has).first().copied();
        }
        (self.total_ns() - self.done_ns).max(0.0)
    }

    fn advance(&mut self, ns: f64, has: HasBrick<'_>) {
        let runs_ns = self.runs_ns(has);
        self.done_ns += ns.min(runs_ns);
    }

    fn is_done(&self) -> bool {
        self.reached.0 >= self.sheets.end && self.done_ns + 1.0 >= self.total_ns()
    }

    fn missing(&mut self, has: HasBrick<'_>, _: u32) -> Vec<u32> {
        if self.lacks(&self.reached, 0, has).is_empty() {
            return Vec::new();
        }
        self.lacks(&self.reached, 3, has)
    }

    fn upcoming(&self) -> Vec<u32> {
        let later = self.over.iter().filter(|(_, _, p)| p.sheets.end > self.origin.0);
        later.map(|(place, ..)| *place).collect()
    }
}

impl TileModel for Patterns {
    type Region = DrawnRegion;

    fn setup(&self, _: &FrameJob) -> FrameSetup {
        FrameSetup::default()
    }

    fn slab_facts(&self, _: &FrameJob, lease: &Lease) -> Result<TaskFacts, Unpredictable> {
        let area = lease.tile.area() as u64;
        let ns = (area * u64::from(lease.slab.len())) as f64 * PIXEL_SHEET_NS;
        Ok(TaskFacts { ns, lease_bytes: area, packed_bytes: area, ..TaskFacts::default() })
    }

    fn draw_slab(&mut self, job: &FrameJob, lease: &Lease) -> TaskOutput {
        let projections = self.projections(job);
        let (quality, tile) = (&job.scene.quality, lease.tile);
        let pixels = render(&projections, quality, tile, lease.slab, &lease.bricks, &lease.state);
        let (counters, touched) = (counters(tile), Vec::new());
        TaskOutput { pixels: Pixels::Sums(pixels), counters, touched }
    }

    fn begin_region(
        &mut self,
        job: &FrameJob,
        lease: &RegionLease,
    ) -> Result<(TaskFacts, DrawnRegion), Unpredictable> {
        let projections = self.projections(job);
        let tile = lease.tile;
        let here = projections.values().filter(|p| !p.rect.intersect(&tile).is_empty());
        let sheets = here.fold(SheetRange::default(), |all, p| all.union(p.sheets));
        let origin = match &lease.begun {
            None => (sheets.first, blank(tile)),
            Some(begun) => {
                let k = begun.sheets[0].expect("no part of a piece is done");
                assert_eq!(begun.sheets, vec![Some(k); parts(tile).count()]);
                assert_eq!(begun.pixels.a.len(), tile.area());
                (k, begun.pixels.clone())
            }
        };
        let (job, reached) = (job.clone(), origin.clone());
        let (done_ns, touched) = (0.0, BTreeSet::new());
        let (over, stopped_for) = (over(&job, &projections, tile), None);
        let region = DrawnRegion {
            job,
            projections,
            tile,
            sheets,
            origin,
            done_ns,
            reached,
            stopped_for,
            over,
            touched,
        };
        let bytes = tile.area() as u64;
        let facts =
            TaskFacts { packed_bytes: bytes, plain_bytes: 3 * bytes, ..TaskFacts::default() };
        Ok((facts, region))
    }

    fn split(
        &mut self,
        _: &FrameJob,
        region: &mut DrawnRegion,
        tile: Rect,
        share: f64,
        has: HasBrick<'_>,
    ) -> Option<Split> {
        let (kept, given) = split_tile(tile, share, |r| r.area() as f64)?;
        // The sheets that it is through by now are drawn again from where this run began.
        let through = (region.done_ns / region.sheet_ns()) as i32;
        let until = (region.origin.0 + through).min(region.reached.0).min(region.sheets.end - 1);
        let (k, pixels) = region.draw(region.origin.clone(), until, has);
        let sheets = parts(given).map(|_| Some(k)).collect();
        let begun = Checkpoint { sheets, pixels: pixels.crop(tile, given) };
        region.origin = (k, pixels.crop(tile, kept));
        region.reached = region.origin.clone();
        region.done_ns = 0.0;
        region.tile = kept;
        region.stopped_for = None;
        region.over = over(&region.job, &region.projections, kept);
        Some(Split { kept, given, begun })
    }

    fn finish_region(
        &mut self,
        job: &FrameJob,
        lease: &RegionLease,
        region: DrawnRegion,
    ) -> TaskOutput {
        let tile = lease.tile;
        let (_, pixels) = region.reached;
        let pixels = match job.finish {
            Some(finish) => {
                let size = [tile.width() as u32, tile.height() as u32];
                Pixels::Finished(SparseTile::encode(&pixels, size, &finish))
            }
            None => Pixels::Sums(TilePixels { last: None, ..pixels }),
        };
        let touched = region.touched.into_iter().collect();
        TaskOutput { pixels, counters: counters(tile), touched }
    }
}
