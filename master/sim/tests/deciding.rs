//! Time of the scheduler's own decisions, measured by hand: many workers draw a ball.
//!
//! `slabcast lab plan` measures the same on a path that was drawn; here nothing has to be.

use slabcast_common::brick::{BRICK_EDGE, BrickGrid, BrickInfo, BrickSetKey, TightBox};
use slabcast_common::ids::{BrickId, FrameId, SceneId};
use slabcast_common::image::{Background, PixelEncoding, PixelFormat};
use slabcast_common::message::SceneSpec;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Quality, Schedule, Work};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_scene::presets;
use slabcast_schedule::{FrameJob, macrotile};
use slabcast_sim::{self as sim, Cluster, Costs, LinearCost, Link, MessageCosts, Nanos, Observer};
use slabcast_trace::{
    About, FrameTrace, Packing, RegionLevel, RegionTile, Trace, VERSION, view_sha256,
};
use std::sync::Arc;
use std::time::Instant;

const SIZE: [u32; 2] = [1024; 2];
const DIMS: [u32; 3] = [256; 3];

/// Frames of a turn about a ball, of which tiles are drawn from the bricks at its front.
fn ball(frames: usize) -> (Vec<FrameJob>, Trace) {
    let info = Volume::from_fn_u8("v", DIMS, |i, _, _| i as u8).info(Digest32([1; 32]));
    let transfer = presets::by_name("grey", &info.summary).expect("a known name");
    let quality = Quality::before();
    let grid = BrickGrid::new(DIMS);
    let from_centre = |id: u32| -> [f64; 3] {
        grid.corner(BrickId(id)).map(|x| f64::from(x) + f64::from(BRICK_EDGE) / 2.0 - 128.0)
    };
    let bricks: Arc<[BrickInfo]> = (0..grid.len() as u32)
        .filter(|&id| from_centre(id).iter().map(|x| x * x).sum::<f64>() < 110.0 * 110.0)
        .map(|id| {
            let lo = grid.corner(BrickId(id));
            let tight = TightBox { lo, hi: lo.map(|x| x + BRICK_EDGE - 1) };
            BrickInfo { id: BrickId(id), tight, voxels: 512, bytes: 1_200 }
        })
        .collect();
    let set = BrickSetKey(Digest32([2; 32]));
    let scene =
        SceneSpec { id: SceneId(1), volume: info, transfer, quality, crop: None, bricks: set };
    let scene = Arc::new(scene);
    let finish =
        PixelEncoding { format: PixelFormat::Rgb8, background: Background::Colour([0.0; 3]) };
    let mut jobs = Vec::new();
    let mut traced = Vec::new();
    for i in 0..frames {
        let angle = (5.0 * i as f64).to_radians();
        let to_eye = [angle.sin(), 0.0, angle.cos()];
        let camera = Camera {
            to_eye: to_eye.into(),
            up: [0.0, 1.0, 0.0].into(),
            target: [0.0; 3].into(),
            projection: CameraProjection::Ortho { height: 256.0 },
        };
        let view = View::new(&scene.volume.lattice, &camera, SIZE, &quality).expect("drawable");
        let job = FrameJob {
            frame: FrameId(i as u64 + 1),
            number: i as u64,
            scene: scene.clone(),
            bricks: bricks.clone(),
            view,
            work: Work { schedule: Schedule::Region, ..Work::default() },
            finish: Some(finish),
            client: 0,
        };
        let projected: Vec<_> = bricks.iter().map(|b| view.project(&b.tight)).collect();
        let rects: Vec<Rect> = projected.iter().flatten().map(|p| p.rect).collect();
        let seen = |id: u32| {
            let at = from_centre(id);
            let far = at.iter().map(|x| x * x).sum::<f64>();
            let front = at.iter().zip(to_eye).map(|(a, b)| a * b).sum::<f64>();
            far > 94.0 * 94.0 && front > 0.0
        };
        let shell: Vec<(u32, Rect)> = (0u32..)
            .zip(&projected)
            .filter(|(place, _)| seen(bricks[*place as usize].id.0))
            .filter_map(|(place, p)| Some((place, p.as_ref()?.rect)))
            .collect();
        let regions = [32, 64, 128, 256].map(|edge| {
            let cut = macrotile::cut_through(SIZE, &rects, (0, 0), Some(edge));
            let tile = |t: &macrotile::Macrotile| {
                let over = shell.iter().filter(|(_, r)| !r.intersect(&t.rect).is_empty());
                let touched: Vec<u32> = over.map(|(place, _)| *place).collect();
                let ns = 20_000 + 100 * t.rect.area() as u64 + 500 * touched.len() as u64;
                let (x, y) = (t.rect.x0 as u32, t.rect.y0 as u32);
                let result_bytes = t.rect.area() as u32;
                RegionTile { x, y, ns, result_bytes, touched, ..RegionTile::default() }
            };
            let mut tiles: Vec<RegionTile> = cut.tiles.iter().map(tile).collect();
            tiles.sort_by_key(|t| (t.y, t.x));
            RegionLevel { edge, tiles }
        });
        let alone = regions[1].tiles.iter().map(|t| t.ns).sum();
        traced.push(FrameTrace {
            outlook_ns: 30_000,
            block_ns: 0,
            regions: regions.into(),
            view: view_sha256(&job.scene, &job.view).to_string(),
            setup_ns: 5_000,
            alone_ns: alone,
            alone_edge: 64,
            slabs: Vec::new(),
        });
        jobs.push(job);
    }
    let about = About {
        volume: "ball".into(),
        transfer: "grey".into(),
        simd: "none".into(),
        pixels_version: slabcast_common::PIXELS_VERSION,
        program: "0".into(),
        size: SIZE,
        slabs: 3,
        repeats: 1,
        pings: None,
        packing: Packing::default(),
    };
    (jobs, Trace { version: VERSION, about, frames: traced })
}

struct Wall(Instant);

impl Observer for Wall {
    fn processor_ns(&mut self) -> Option<Nanos> {
        Some(self.0.elapsed().as_nanos() as Nanos)
    }
}

/// About what `slabcast lab plan` measures.
fn costs() -> Costs {
    let each = |per_unit_ns| LinearCost { fixed_ns: 800.0, per_unit_ns };
    let messages = |wake_ns| MessageCosts {
        wake_ns,
        call_ns: 3_000.0,
        send: each(0.4),
        receive: each(0.4),
        bricks: each(0.3),
    };
    Costs {
        first_brick_ns: 80.0,
        frame_brick_ns: 20.0,
        prefetch_ns: 100_000.0,
        result: LinearCost { fixed_ns: 3_000.0, per_unit_ns: 0.0 },
        event_ns: 1_500.0,
        driver_wake_ns: 10_000.0,
        driver_message_ns: 800.0,
        master: messages(16_000.0),
        worker: messages(28_000.0),
        finish_pixel_ns: 0.3,
        ..Costs::default()
    }
}

#[test]
#[ignore = "measures; cargo test --release -p slabcast-sim --test deciding -- --ignored --nocapture"]
fn what_deciding_takes() {
    const FRAMES: usize = 48;
    let (jobs, trace) = ball(FRAMES);
    println!("{} bricks; the least of 5 runs", jobs[0].bricks.len());
    for (workers, in_flight) in [(1, 4), (8, 4), (15, 1), (15, 4), (64, 1), (64, 4)] {
        let cluster = Cluster {
            workers,
            threads: 1,
            link: Link { bytes_per_s: None, latency_ns: 50_000 },
            costs: costs(),
            shared_cores: None,
            frames_in_flight: in_flight,
            stretch: 1.0,
            mixed: false,
        };
        let run = || {
            let (out, took) =
                sim::run(&jobs, &trace, &cluster, &mut Wall(Instant::now())).expect("it runs");
            let begun = took.first_frame.ns + took.frames.ns;
            let all = begun + took.results.ns + took.prefetches.ns + took.others.ns;
            (all, took, out.steady_interval_ms(in_flight))
        };
        let runs: Vec<_> = (0..5).map(|_| run()).collect();
        let (all, took, ms) = runs.into_iter().min_by_key(|r| r.0).expect("five");
        let each = |n: u64, ns: u64| ns as f64 / 1e3 / n.max(1) as f64;
        println!(
            "{workers:>3} workers, {in_flight} in flight: {:>5.0} us a frame: begun {:>4.0} us, looked ahead {:>3.0} us; \
             {:>4.0} results of {:>5.2} us; {:>4.0} other events of {:.2} us; a frame every {ms:.2} ms",
            each(FRAMES as u64, all),
            each(FRAMES as u64 - 1, took.frames.ns),
            each(FRAMES as u64, took.prefetches.ns),
            took.result_count as f64 / FRAMES as f64,
            each(took.result_count, took.results.ns),
            took.others.count as f64 / FRAMES as f64,
            each(took.others.count, took.others.ns),
        );
    }
}
