//! The measured half of a prediction: draws every tile that a schedule may ask for, on one core.
//!
//! Every tile of a level is drawn several times as a worker draws it, from the same bricks and the
//! same state. Its shortest processor time counts, since disturbances (a cold cache, the first
//! touch of a page) only ever lengthen it.
//!
//! A worker projects bricks once a frame: blocks of bricks when the frame begins, the bricks of a
//! block when a tile first needs them ([`slabcast_render::visibility`]). So the time of a tile is
//! measured with its blocks projected. The tile lists them, and the time of a block is measured
//! apart. The simulation charges each block of a frame once to a worker, with its first tile.
//!
//! A tile of one part is drawn once more to record when it needs each brick: a worker that lacks
//! the brick draws up to that point.

use super::clock::cpu_ns;
use prost::Message;
use slabcast_common::PIXELS_VERSION;
use slabcast_common::brick::Brick;
use slabcast_common::ids::{Epoch, FrameId, TaskId};
use slabcast_common::image::{
    Background, FrameState, PixelEncoding, PixelFormat, SparseTile, TilePixels,
};
use slabcast_common::message::{
    Counters, Lease, Pixels, TaskTimes, TileResult, ToMaster, ToWorker,
};
use slabcast_common::occlusion::{Rect, ShutMap};
use slabcast_common::quality::Work;
use slabcast_common::region::PART_EDGE;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::Projected;
use slabcast_proto::convert::{self, Compression, Down};
use slabcast_render::Frame;
use slabcast_render::Simd;
use slabcast_render::region::{self, BrickSupply, FinishedRegion, Region};
use slabcast_render::tile::{self, Scratch};
use slabcast_render::visibility::ClosingDepths;
use slabcast_render::visibility::VisibleBricks;
use slabcast_schedule::{FrameJob, is_shut, macrotile};
use slabcast_session::direct;
use slabcast_session::fail::Fail;
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::progress::{Progress, Step};
use slabcast_session::signals;
use slabcast_trace::{
    About, FrameTrace, Level, Packing, Pings, RegionLevel, RegionTile, SlabTrace, TileTrace, Trace,
    VERSION, view_sha256,
};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Arguments of [`measure`].
pub(crate) struct MeasureArgs<'a> {
    pub(crate) scenes: &'a PathScenes,
    /// Number of frames of the path.
    pub(crate) frames: usize,
    pub(crate) work: Work,
    /// Numbers of tiles that schedules will want, which decide the levels to draw.
    pub(crate) wanted: Vec<u64>,
    /// Edges in pixels that are drawn in any case.
    pub(crate) edges: Vec<u32>,
    /// Whether to draw the tiles of the slab schedule.
    pub(crate) slab: bool,
    /// Whether to draw the tiles of the region schedule.
    pub(crate) region: bool,
    /// Times each tile is drawn.
    pub(crate) repeats: u32,
    /// Processor time of messages here, if it could be measured.
    pub(crate) pings: Option<Pings>,
    /// Names of the volume and of the transfer function.
    pub(crate) names: (String, String),
}

/// Encoding of finished tiles in a plain `slabcast render`; others have about as many bytes.
pub(crate) const FINISH: PixelEncoding =
    PixelEncoding { format: PixelFormat::Rgb8, background: Background::Colour([0.0; 3]) };

/// Returns the frames of the path as jobs of the scheduler.
pub(crate) fn jobs(scenes: &PathScenes, frames: usize, work: Work) -> Result<Vec<FrameJob>, Fail> {
    let bricks = scenes.bricks.directory().bricks();
    let mut scene = Arc::new(scenes.spec(0));
    (0..frames)
        .map(|i| {
            let spec = scenes.spec(i);
            if spec != *scene {
                scene = Arc::new(spec);
            }
            let view = scenes.view(i, &scene.quality)?;
            let (frame, number) = (FrameId(i as u64 + 1), i as u64);
            let (scene, bricks) = (scene.clone(), bricks.clone());
            let (finish, client) = (Some(FINISH), 0);
            Ok(FrameJob { frame, number, scene, bricks, view, work, finish, client })
        })
        .collect()
}

/// Draws the tiles. Counts frames in `progress`, on from the `before` frames done. After Ctrl-C the
/// trace has fewer frames than requested.
pub(crate) fn measure(
    path: &MeasureArgs<'_>,
    (progress, before): (&mut Progress, usize),
) -> Result<Trace, Fail> {
    let jobs = jobs(path.scenes, path.frames, path.work)?;
    let depths = ClosingDepths::new(jobs[0].view.size);
    let packing = Packed::default();
    let mut bench = Bench { scratch: Scratch::default(), repeats: path.repeats, depths, packing };
    let mut frames = Vec::with_capacity(jobs.len());
    // Warms up, as a worker is after its first frame: footprints in the scene, memory allocated.
    bench.frame(path, 0, &jobs[0])?;
    bench.depths = ClosingDepths::new(jobs[0].view.size);
    for (i, job) in jobs.iter().enumerate() {
        if signals::stop_requested() {
            break;
        }
        frames.push(bench.frame(path, i, job)?);
        progress.step(Step { frames: (before + i) as u64 + 1, ..Step::default() });
    }
    let about = About {
        volume: path.names.0.clone(),
        transfer: path.names.1.clone(),
        simd: Simd::detect().name().into(),
        pixels_version: PIXELS_VERSION,
        program: env!("CARGO_PKG_VERSION").into(),
        size: jobs[0].view.size,
        slabs: path.work.slabs,
        repeats: path.repeats,
        pings: path.pings,
        packing: bench.packing.mean(),
    };
    Ok(Trace { version: VERSION, about, frames })
}

struct Bench {
    scratch: Scratch,
    repeats: u32,
    /// Closing depths of the frame before.
    depths: ClosingDepths,
    /// Compression of the tiles so far.
    packing: Packed,
}

/// Total bytes and times of compressing and decompressing finished pixels.
#[derive(Default)]
struct Packed {
    bytes: u64,
    pack_ns: u64,
    unpack_ns: u64,
}

impl Packed {
    fn mean(&self) -> Packing {
        let mean = |ns: u64| ns as f64 / self.bytes.max(1) as f64;
        Packing { pack_ns: mean(self.pack_ns), unpack_ns: mean(self.unpack_ns) }
    }

    /// Returns the bytes of a result message, compressed and plain, and adds the times of
    /// compression.
    fn weigh(&mut self, repeats: u32, leaves: SparseTile, counters: Counters) -> [u32; 2] {
        self.bytes += leaves.data.len() as u64;
        let result = result_message(Pixels::Finished(leaves), counters);
        let [packed, plain] = [true, false].map(|packs| {
            let compression = if packs { Compression::Lz4 } else { Compression::None };
            let to_wire = || convert::from_worker_to_wire_as(&result, compression);
            let (to_ns, message) = shortest(repeats, to_wire);
            let read = || drop(convert::from_worker_from_wire(message.clone()));
            (to_ns, shortest(repeats, read).0, message.encoded_len() as u32)
        });
        self.pack_ns += packed.0.saturating_sub(plain.0);
        self.unpack_ns += packed.1.saturating_sub(plain.1);
        [packed.2, plain.2]
    }
}

/// Returns the shortest processor time of some runs, in ns, and the result of the last.
fn shortest<T>(repeats: u32, mut run: impl FnMut() -> T) -> (u64, T) {
    let mut timed = || {
        let began = cpu_ns();
        let out = run();
        (cpu_ns() - began, out)
    };
    let (mut best, mut last) = timed();
    for _ in 1..repeats {
        let (ns, out) = timed();
        (best, last) = (best.min(ns), out);
    }
    (best, last)
}

/// Returns the shortest processor time of each tile, in ns, with all tiles drawn in turn. A tile's
/// data has then left the caches before it is drawn again, as in a worker; small tiles drawn again
/// at once would look cheaper than they are.
fn in_turn(repeats: u32, tiles: &[Rect], mut draw: impl FnMut(Rect)) -> Vec<u64> {
    let mut best = vec![u64::MAX; tiles.len()];
    for _ in 0..repeats.max(1) {
        for (best, tile) in best.iter_mut().zip(tiles) {
            let began = cpu_ns();
            draw(*tile);
            *best = (*best).min(cpu_ns() - began);
        }
    }
    best
}

impl Bench {
    fn frame(
        &mut self,
        path: &MeasureArgs<'_>,
        i: usize,
        job: &FrameJob,
    ) -> Result<FrameTrace, Fail> {
        let scene = path.scenes.scene(i);
        let (setup_ns, frame) = shortest(self.repeats, || Frame::new(scene.clone(), job.view));
        let looked = self.look(path, &frame);
        let (alone_edge, alone_ns) = self.alone(path, &frame, &looked);
        // This follows the schedule (`schedule::state::frame`).
        let projected: Vec<Option<Projected>> =
            job.bricks.iter().map(|b| job.view.project(&b.tight)).collect();
        let regions = self.regions(path, job, &frame, &projected);
        let size = job.view.size;
        let mut state = FrameState::new(size);
        let mut shut = ShutMap::open(Rect::from_size(size));
        let mut slabs = Vec::new();
        let voxels = |i: usize| job.bricks[i].voxels;
        let cuts = if path.slab {
            slabcast_schedule::slab_ranges(&job.view, &projected, &voxels, &path.work)
        } else {
            Vec::new()
        };
        for range in cuts {
            let drawn = self.slab(path, job, &frame, &projected, range, &state, &shut);
            let (levels, pixels) = drawn;
            for (rect, pixels) in &pixels {
                state.add_slab_tile(*rect, pixels);
            }
            state.end_slab();
            let eps = job.scene.quality.eps;
            let bits: Vec<bool> = state.opacities().map(|a| is_shut(a, eps)).collect();
            for (i, _) in bits.iter().enumerate().filter(|(_, s)| **s) {
                shut.shut(i);
            }
            shut.refresh();
            let runs = SlabTrace::runs(bits);
            slabs.push(SlabTrace { first: range.first, end: range.end, shut: runs, levels });
        }
        Ok(FrameTrace {
            view: view_sha256(&job.scene, &job.view).to_string(),
            setup_ns,
            alone_ns: setup_ns + looked.outlook_ns + alone_ns,
            alone_edge,
            slabs,
            outlook_ns: looked.outlook_ns,
            block_ns: looked.block_ns,
            regions,
        })
    }

    /// Draws all levels that may be wanted of a slab. The pixels are those of the first level.
    fn slab(
        &mut self,
        path: &MeasureArgs<'_>,
        job: &FrameJob,
        frame: &Frame,
        projected: &[Option<Projected>],
        range: SheetRange,
        state: &FrameState,
        shut: &ShutMap,
    ) -> (Vec<Level>, Vec<(Rect, TilePixels)>) {
        let cull = job.scene.quality.cull;
        // This follows the schedule (`schedule::state::frame`).
        let (mut needed, mut rects) = (Vec::new(), Vec::new());
        for (i, p) in projected.iter().enumerate() {
            let Some(p) = p.filter(|p| p.sheets.overlaps(range)) else { continue };
            if !(cull && shut.all_shut(&p.rect)) {
                needed.push(i);
                rects.push(p.rect);
            }
        }
        if needed.is_empty() {
            return (Vec::new(), Vec::new());
        }
        let size = job.view.size;
        let edges: BTreeSet<u32> = match path.work.tile {
            Some(edge) => [edge].into(),
            None => {
                let edge_for = |w: &u64| macrotile::cut(size, &rects, shut, cull, *w, None).edge;
                path.wanted.iter().map(edge_for).chain(path.edges.iter().copied()).collect()
            }
        };
        let (mut levels, mut first) = (Vec::new(), Vec::new());
        for &edge in edges.iter().rev() {
            let cut = macrotile::cut(size, &rects, shut, cull, 0, Some(edge));
            let mut tiles = Vec::with_capacity(cut.tiles.len());
            for t in &cut.tiles {
                let over = |r: &Rect| !r.intersect(&t.rect).is_empty();
                let places = needed.iter().zip(&rects).filter(|(_, r)| over(r));
                let bricks: Vec<Arc<Brick>> =
                    places.map(|(&i, _)| path.scenes.bricks[i].clone()).collect();
                let before = state.tile_state(t.rect);
                let (simd, scratch) = (Simd::detect(), &mut self.scratch);
                let (ns, (pixels, counters)) = shortest(self.repeats, || {
                    tile::render(frame, simd, t.rect, range, &bricks, &before, scratch)
                });
                let lease = Lease {
                    task: TaskId(tiles.len() as u64),
                    epoch: Epoch(0),
                    frame: job.frame,
                    tile: t.rect,
                    slab: range,
                    bricks: bricks.iter().map(|b| b.id).collect(),
                    state: before,
                };
                let lease_bytes = lease_bytes(lease);
                let (result_bytes, result) = result_bytes(Pixels::Sums(pixels), counters);
                let Pixels::Sums(pixels) = result else { unreachable!("given above") };
                let (x, y) = (t.rect.x0 as u32, t.rect.y0 as u32);
                tiles.push(TileTrace { x, y, ns, lease_bytes, result_bytes });
                if levels.is_empty() {
                    first.push((t.rect, pixels));
                }
            }
            tiles.sort_by_key(|t| (t.y, t.x));
            levels.push(Level { edge, tiles });
        }
        (levels, first)
    }

    /// Measures the projection of the directory, and of a block of it.
    fn look(&mut self, path: &MeasureArgs<'_>, frame: &Frame) -> ProjectionTimes {
        let directory = path.scenes.bricks.directory();
        let (outlook_ns, _) = shortest(self.repeats, || VisibleBricks::new(&frame.view, directory));
        let mut block_ns = u64::MAX;
        for _ in 0..self.repeats {
            let outlook = VisibleBricks::new(&frame.view, directory);
            let began = cpu_ns();
            let blocks = outlook.block_count();
            (0..blocks).for_each(|block| outlook.project_block(block));
            block_ns = block_ns.min((cpu_ns() - began) / u64::from(blocks.max(1)));
        }
        ProjectionTimes { outlook_ns, block_ns }
    }

    /// Draws the tiles of the region schedule, which reach through all depths.
    fn regions(
        &mut self,
        path: &MeasureArgs<'_>,
        job: &FrameJob,
        frame: &Frame,
        projected: &[Option<Projected>],
    ) -> Vec<RegionLevel> {
        if !path.region {
            return Vec::new();
        }
        let size = job.view.size;
        let bricks = &path.scenes.bricks;
        let rects: Vec<Rect> = projected.iter().flatten().map(|p| p.rect).collect();
        // The schedule uses blocks of bricks, whose outline is a little larger, so that it may
        // choose the level next to the one for bricks. Overlapping frames may each have half the
        // workers, and a sole frame has some tiles of 64 pixels cut in parts of 32.
        let mut edges: BTreeSet<u32> = match job.work.tile {
            // The parts of a large tile record when it needs its bricks.
            Some(edge) => [edge, edge.min(PART_EDGE as u32)].into(),
            None => [32, 64, 128, 256].into(),
        };
        for &wanted in path.wanted.iter().filter(|_| job.work.tile.is_none()) {
            for wanted in [wanted + wanted / 4, wanted / 2 + wanted / 8, wanted / 2 - wanted / 8] {
                let edge = macrotile::cut_through(size, &rects, (wanted, 1 << 40), None).edge;
                edges.insert(edge);
            }
        }
        let mut levels = Vec::new();
        let depths = ClosingDepths::new(size);
        for edge in edges {
            let cut = macrotile::cut_through(size, &rects, (0, 0), Some(edge));
            let simd = Simd::detect();
            let mut draw = |t: Rect, outlook: &VisibleBricks, supply: &dyn BrickSupply| {
                let mut region = Region::new(outlook, t);
                region.advance(frame, simd, outlook, supply, 0, &mut self.scratch);
                let done = region.finish();
                done.record_depths(&depths);
                let FinishedRegion { pixels, counters, touched, .. } = done;
                let size = [t.width() as u32, t.height() as u32];
                (SparseTile::encode(&pixels, size, &FINISH), counters, touched)
            };
            let mut tiles: Vec<RegionTile> = Vec::with_capacity(cut.tiles.len());
            for t in &cut.tiles {
                let outlook = VisibleBricks::new(&frame.view, bricks.directory());
                let (leaves, counters, touched) = draw(t.rect, &outlook, bricks);
                let [result_bytes, plain_bytes] =
                    self.packing.weigh(self.repeats, leaves, counters);
                let (x, y) = (t.rect.x0 as u32, t.rect.y0 as u32);
                let opened = outlook.projected_blocks().collect();
                // Comes after `opened`, since it may project more blocks.
                let expected =
                    region::expected_bricks(frame, &outlook, &Nothing, t.rect, &self.depths);
                let tile = RegionTile { x, y, touched, opened, expected, ..RegionTile::default() };
                tiles.push(RegionTile { result_bytes, plain_bytes, ..tile });
            }
            // All blocks are projected before timing, since their time is measured apart.
            let outlook = VisibleBricks::new(&frame.view, bricks.directory());
            let opened = tiles.iter().flat_map(|t| &t.opened);
            opened.for_each(|block| outlook.project_block(*block));
            let rects: Vec<Rect> = cut.tiles.iter().map(|t| t.rect).collect();
            let times = in_turn(self.repeats, &rects, |t| drop(draw(t, &outlook, bricks)));
            if edge <= PART_EDGE as u32 {
                for (tile, rect) in tiles.iter_mut().zip(&rects) {
                    let clocked = Clocked::new(bricks);
                    drop(draw(*rect, &outlook, &clocked));
                    tile.needed = clocked.needed(&tile.touched);
                }
            }
            tiles.iter_mut().zip(times).for_each(|(tile, ns)| tile.ns = ns);
            tiles.sort_by_key(|t| (t.y, t.x));
            levels.push(RegionLevel { edge, tiles });
        }
        self.depths = depths;
        levels
    }

    /// Returns edge and ns of the fastest tiles for one core, projection of blocks included.
    fn alone(
        &mut self,
        path: &MeasureArgs<'_>,
        frame: &Frame,
        looked: &ProjectionTimes,
    ) -> (u32, u64) {
        let bricks = &path.scenes.bricks;
        let whole = Rect::from_size(frame.view.size);
        let simd = Simd::detect();
        let repeats = self.repeats;
        let mut pixels = TilePixels::default();
        let mut time_ns = |edge: u32| {
            let outlook = VisibleBricks::new(&frame.view, bricks.directory());
            let tiles: Vec<Rect> =
                direct::tile_rects(whole, edge).filter(|tile| outlook.weight(tile) > 0).collect();
            let mut draw = |tile| {
                region::draw(frame, &outlook, bricks, simd, tile, &mut self.scratch, &mut pixels);
            };
            // The first run projects the blocks and does not count.
            tiles.iter().for_each(|tile| draw(*tile));
            let times = in_turn(repeats, &tiles, draw);
            times.iter().sum::<u64>() + outlook.projected_blocks().count() as u64 * looked.block_ns
        };
        let edges = [64, 128, 256].into_iter().filter(|e| *e as i32 <= whole.x1.max(whole.y1) * 2);
        let timed = edges.map(|edge| (edge, time_ns(edge)));
        timed.min_by_key(|t| t.1).unwrap_or((64, 0))
    }
}

/// A supply without bricks.
struct Nothing;

impl BrickSupply for Nothing {
    fn get(&self, _: u32) -> Option<Arc<Brick>> {
        None
    }
}

/// A supply that records when each brick was first requested.
struct Clocked<'a> {
    bricks: &'a dyn BrickSupply,
    began: Instant,
    came: RefCell<BTreeMap<u32, Duration>>,
}

impl<'a> Clocked<'a> {
    fn new(bricks: &'a dyn BrickSupply) -> Clocked<'a> {
        Clocked { bricks, began: Instant::now(), came: RefCell::default() }
    }

    /// Returns the time of the first request of each brick, in thousandths of the time until now.
    fn needed(&self, touched: &[u32]) -> Vec<u16> {
        let (all, came) = (self.began.elapsed().as_secs_f64().max(1e-9), self.came.borrow());
        let share = |place| came.get(place).map_or(0.0, Duration::as_secs_f64) / all;
        touched.iter().map(|place| (1000.0 * share(place)) as u16).collect()
    }
}

impl BrickSupply for Clocked<'_> {
    fn get(&self, place: u32) -> Option<Arc<Brick>> {
        self.came.borrow_mut().entry(place).or_insert_with(|| self.began.elapsed());
        self.bricks.get(place)
    }
}

/// Processor time of projecting bricks, in ns.
struct ProjectionTimes {
    /// Time for all blocks of the directory.
    outlook_ns: u64,
    /// Mean time for the bricks of one block.
    block_ns: u64,
}

/// Returns the bytes of a lease message.
fn lease_bytes(lease: Lease) -> u32 {
    match convert::to_worker_to_wire(&ToWorker::Lease(Box::new(lease)), 0) {
        Down::Control(message) => message.encoded_len() as u32,
        Down::Parts(_) | Down::Bricks(_) => unreachable!("a lease is sent on Control"),
    }
}

/// Returns a result message without the brick report of a region.
fn result_message(pixels: Pixels, counters: Counters) -> ToMaster {
    let (task, epoch) = (TaskId(1 << 12), Epoch(0));
    // Times after some hours: five bytes each on the wire.
    let us = 1 << 33;
    let times = TaskTimes { received_us: us, ready_us: us, start_us: us, end_us: us, thread: 0 };
    let (bytes, region) = (None, None);
    let result = TileResult { task, epoch, pixels, bytes, counters, times, region };
    ToMaster::Result(Box::new(result))
}

/// Returns the bytes of a result message, and its pixels.
fn result_bytes(pixels: Pixels, counters: Counters) -> (u32, Pixels) {
    let result = result_message(pixels, counters);
    let bytes = convert::from_worker_to_wire(&result).encoded_len();
    let ToMaster::Result(result) = result else { unreachable!("made above") };
    (bytes as u32, result.pixels)
}

/// Checks that a trace is of this path, frame by frame.
///
/// # Errors
/// The number of frames or one of the views differs.
pub(crate) fn fits(trace: &Trace, jobs: &[FrameJob]) -> Result<(), String> {
    if trace.frames.len() != jobs.len() {
        return Err(format!(
            "has {} frames, the path {}; measure it again",
            trace.frames.len(),
            jobs.len()
        ));
    }
    for (i, (frame, job)) in trace.frames.iter().zip(jobs).enumerate() {
        if frame.view != view_sha256(&job.scene, &job.view).to_string() {
            return Err(format!(
                "frame {i} was measured of another volume, view, transfer function or quality ({}, \
                 {}); give the flags that it was measured with, or another file",
                trace.about.volume, trace.about.transfer
            ));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::image::FrameAssembler;
    use slabcast_render::tile::ProjectedBrick;
    use slabcast_render::visibility::Directory;
    use slabcast_scene::path::{Turntable, ViewPath};
    use slabcast_session::direct::Cut;
    use slabcast_session::request::RenderRequest;

    /// Volume, axis that is up, and transfer function.
    type Named = (&'static str, &'static str, &'static str);

    const OPAQUE: [Named; 3] = [
        ("mri256.nrrd", "-y", "peer-opaque"),
        ("mouse_skull.nrrd", "+z", "peer-skull"),
        ("aneurism.nrrd", "+z", "peer-vessels"),
    ];

    /// Returns four views of 512x512, or `None` with a note if the volume is not here.
    fn staged((file, axis, tf): Named) -> Option<PathScenes> {
        let (volume, orientation) = slabcast_session::testing::data_volume(file, axis)?;
        let info = volume.info(volume.digest());
        let turn = Turntable { frames: 4, step: 22.5, ..Turntable::default() };
        let request = RenderRequest::for_preset(ViewPath::from_turntable([512, 512], turn), tf)
            .expect("a request");
        Some(PathScenes::new(&volume, &info, &request, orientation).expect("a scenes"))
    }

    /// Measures the bytes of a frame's results, and the time to write and read a tile.
    #[test]
    #[ignore = "measures; cargo test --release -p slabcast-lab what_a_tile -- --ignored --nocapture"]
    fn what_a_tile_weighs_and_takes_to_pack() {
        println!(
            "KB a frame: sums, finished, packed. us a tile: sums written, sums read, finished,"
        );
        println!("packed and written, noise written, read. ms a frame: composed");
        for scene in OPAQUE {
            let Some(scenes) = staged(scene) else { continue };
            let (mut bytes, mut ns, mut composed, mut tiles) = ([0; 3], [0; 6], 0, 0);
            for i in 0..4 {
                let frame = scenes.frame(i).expect("a frame");
                let picture = direct::draw(&frame, &scenes.bricks, Cut::on(2));
                let mut state = FrameState::new([512, 512]);
                for (rect, sums) in tiles_of(&picture.pixels) {
                    tiles += 1;
                    let (finishing, leaves) =
                        shortest(9, || SparseTile::encode(&sums, [64, 64], &FINISH));
                    let noise = SparseTile { data: noise(leaves.data.len()), ..leaves.clone() };
                    let (sums_ns, of_sums) = write(Pixels::Sums(sums));
                    let (packing, packed) = write(Pixels::Finished(leaves.clone()));
                    let (hopeless, _) = write(Pixels::Finished(noise));
                    let each =
                        [sums_ns, read(&of_sums), finishing, packing, hopeless, read(&packed)];
                    ns.iter_mut().zip(each).for_each(|(sum, one)| *sum += one);
                    let plain = leaves.data.len() + leaves.mask.len() + 40;
                    let each = [of_sums.len(), plain, packed.len()];
                    bytes.iter_mut().zip(each).for_each(|(sum, one)| *sum += one);
                    state.place_encoded(rect, leaves);
                }
                composed += shortest(9, || state.encode(&FINISH, false)).0;
            }
            println!(
                "{}, {} tiles: {:.0?}; {:.1?}; {:.2}",
                scene.2,
                tiles / 4,
                bytes.map(|b| b as f64 / 4e3),
                ns.map(|n| n as f64 / 1e3 / f64::from(tiles)),
                composed as f64 / 4e6
            );
        }
    }

    /// Measures assembling a frame after its last tile, with all tiles left or only the last 16.
    /// All tiles are full, and the memory of the frame is new.
    #[test]
    #[ignore = "measures; cargo test --release -p slabcast-lab what_is_left -- --ignored --nocapture"]
    fn what_is_left_at_the_last_tile() {
        let full = TilePixels {
            a: vec![0.5; 64 * 64],
            colour: (0..64 * 64).map(|i| [i * 7919 % (1 << 27); 3]).collect(),
            last: None,
        };
        let leaves = SparseTile::encode(&full, [64, 64], &FINISH);
        for n in [512, 1024, 1536, 2048] {
            let at = (0..n).step_by(64);
            let corners = at.clone().flat_map(|y| at.clone().map(move |x| (x, y)));
            let tiles: Vec<_> =
                corners.map(|(x, y)| (Rect::new(x, y, x + 64, y + 64), leaves.clone())).collect();
            let took = |before: usize| {
                let mut mosaic = FrameAssembler::new([n as u32; 2], &FINISH);
                mosaic.place(&tiles[..before]);
                let mut state = FrameState::new([n as u32; 2]);
                for (rect, leaves) in &tiles[before..] {
                    state.place_encoded(*rect, leaves.clone());
                }
                let began = cpu_ns();
                let bytes = state.encode_onto(mosaic).bytes;
                (cpu_ns() - began, bytes)
            };
            let least = |before| (0..15).map(|_| took(before).0).min().unwrap_or(0) as f64 / 1e6;
            assert!(took(0).1 == took(tiles.len() - 16).1, "the same picture");
            println!("{n}: {:.2} ms, {:.2} ms", least(0), least(tiles.len() - 16));
        }
    }

    /// Measures projecting bricks: all of a volume, those that a frame needs, and those that a
    /// worker of fifteen needs, which draws neighbouring tiles of it.
    #[test]
    #[ignore = "measures; cargo test --release -p slabcast-lab what_looking -- --ignored --nocapture"]
    fn what_looking_at_bricks_takes() {
        println!(
            "edge of blocks: blocks; us, bricks that are looked at: a worker of 15, the frame"
        );
        let [mri, others @ ..] = OPAQUE;
        for scene in [mri, (mri.0, mri.1, "peer-semi")].into_iter().chain(others) {
            let Some(scenes) = staged(scene) else { continue };
            let frame = scenes.frame(1).expect("a frame");
            let bricks = &scenes.bricks;
            let (ns, n) = shortest(9, || {
                let seen: Vec<ProjectedBrick> =
                    bricks.iter().filter_map(|b| ProjectedBrick::new(&frame, b)).collect();
                ProjectedBrick::front_to_back(&seen).len()
            });
            println!("{}, every brick: {:.0}, {n}", scene.2, ns as f64 / 1e3);
            for shift in 4..7 {
                let infos = bricks.directory().bricks().clone();
                let directory = Arc::new(Directory::with_blocks(infos, shift, usize::MAX));
                let all = VisibleBricks::new(&frame.view, &directory);
                let tiles = direct::tile_rects(Rect::from_size([512; 2]), 64);
                let tiles: Vec<Rect> = tiles.filter(|tile| all.weight(tile) > 0).collect();
                let (mut scratch, mut pixels) = Default::default();
                let mut look = |tiles: &[Rect]| {
                    let drawn = VisibleBricks::new(&frame.view, &directory);
                    for tile in tiles {
                        let simd = Simd::detect();
                        region::draw(
                            &frame,
                            &drawn,
                            bricks,
                            simd,
                            *tile,
                            &mut scratch,
                            &mut pixels,
                        );
                    }
                    let blocks: Vec<u32> = drawn.projected_blocks().collect();
                    let (ns, _) = shortest(9, || {
                        let outlook = VisibleBricks::new(&frame.view, &directory);
                        blocks.iter().for_each(|block| outlook.project_block(*block));
                    });
                    [ns as f64 / 1e3, drawn.projected_bricks() as f64]
                };
                let [whole_us, whole] = look(&tiles);
                let each: Vec<[f64; 2]> =
                    tiles.chunks(tiles.len().div_ceil(15)).map(&mut look).collect();
                let mean = |i: usize| each.iter().map(|e| e[i]).sum::<f64>() / each.len() as f64;
                println!(
                    "{}: {}; {:.0}, {:.0}; {whole_us:.0}, {whole:.0}",
                    1 << shift,
                    all.block_count(),
                    mean(0),
                    mean(1)
                );
            }
        }
    }

    /// Measures bytes, compression ratio and time of bricks with lz4, each by itself and in
    /// messages of some 64 KiB.
    #[test]
    #[ignore = "measures; cargo test --release -p slabcast-lab what_bricks -- --ignored --nocapture"]
    fn what_bricks_weigh_and_take_to_pack() {
        const MESSAGE: usize = 64 << 10;
        println!("bytes a voxel and a brick; of them packed, %, and us a brick to pack and unpack");
        for scene in OPAQUE {
            let Some(scenes) = staged(scene) else { continue };
            let encoded = |brick: &Arc<Brick>| {
                let mut bytes = Vec::new();
                brick.encode(&mut bytes);
                bytes
            };
            let bricks: Vec<Vec<u8>> = scenes.bricks.iter().map(encoded).collect();
            let voxels: u32 =
                scenes.bricks.directory().bricks().iter().map(|b| u32::from(b.voxels)).sum();
            let all: usize = bricks.iter().map(Vec::len).sum();
            let each = all / bricks.len();
            println!("{}: {:.2}, {each}", scene.2, all as f64 / f64::from(voxels));
            let messages: Vec<Vec<u8>> =
                bricks.chunks((MESSAGE / each).max(1)).map(<[Vec<u8>]>::concat).collect();
            for (name, pieces) in [("each", &bricks), ("messages", &messages)] {
                let pack = || pieces.iter().map(|p| lz4_flex::block::compress(p)).collect();
                let (packing, packed): (u64, Vec<Vec<u8>>) = shortest(3, pack);
                let (unpacking, ()) = shortest(3, || {
                    for (bytes, piece) in packed.iter().zip(pieces) {
                        let plain = lz4_flex::block::decompress(bytes, piece.len());
                        assert!(plain.is_ok_and(|plain| plain == *piece), "it comes back");
                    }
                });
                let of_all = packed.iter().map(Vec::len).sum::<usize>() as f64 / all as f64;
                let us = |ns: u64| ns as f64 / 1e3 / bricks.len() as f64;
                println!(
                    "  {name}: {:.1}; {:.2}, {:.2}",
                    100.0 * of_all,
                    us(packing),
                    us(unpacking)
                );
            }
        }
    }

    /// The tiles of a picture of 512x512 in which something is, as sums.
    fn tiles_of(picture: &[[f32; 4]]) -> Vec<(Rect, TilePixels)> {
        let corners = (0..512).step_by(64).flat_map(|y| (0..512).step_by(64).map(move |x| (x, y)));
        let tile = |(x, y): (i32, i32)| {
            let at = |i: usize| picture[(y as usize + i / 64) * 512 + x as usize + i % 64];
            let fixed = |c: f32| (c * (1u32 << 28) as f32) as u32;
            let a: Vec<f32> = (0..64 * 64).map(|i| at(i)[3]).collect();
            let colour = (0..64 * 64).map(|i| [0, 1, 2].map(|c| fixed(at(i)[c]))).collect();
            let there = a.iter().any(|a| *a > 0.0);
            there.then(|| (Rect::new(x, y, x + 64, y + 64), TilePixels { a, colour, last: None }))
        };
        corners.filter_map(tile).collect()
    }

    fn write(pixels: Pixels) -> (u64, Vec<u8>) {
        let (task, epoch, times) = (TaskId(1 << 12), Epoch(0), TaskTimes::default());
        let (bytes, counters, region) = (None, Counters::default(), None);
        let result = TileResult { task, epoch, pixels, bytes, counters, times, region };
        let result = ToMaster::Result(Box::new(result));
        shortest(9, || convert::from_worker_to_wire(&result).encode_to_vec())
    }

    fn read(bytes: &[u8]) -> u64 {
        let read = || {
            let message = slabcast_proto::cluster_v1::ControlRequest::decode(bytes);
            let message = message.expect("written above");
            convert::from_worker_from_wire(message).expect("written above")
        };
        shortest(9, read).0
    }

    /// Returns incompressible bytes.
    fn noise(n: usize) -> Vec<u8> {
        let mut x = 1u64;
        let next = || {
            x ^= x << 13;
            x ^= x >> 7;
            x ^= x << 17;
            (x >> 32) as u8
        };
        std::iter::repeat_with(next).take(n).collect()
    }
}
