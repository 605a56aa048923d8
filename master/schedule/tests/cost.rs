//! Time that planning takes the master: `cargo test --release -p slabcast-schedule --test cost --
//! --nocapture --include-ignored` prints it. A slab's planning is on the critical path of every
//! frame (nothing is rendered meanwhile), so it has to stay far below a slab's rendering.

use slabcast_common::brick::{BRICK_EDGE, BrickGrid, BrickInfo, BrickSetKey, TightBox};
use slabcast_common::ids::{BrickId, FrameId, SceneId, WorkerId};
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Pixels, SceneSpec, TaskTimes, TileResult, ToWorker};
use slabcast_common::quality::{Quality, Schedule, Work};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_scene::presets;
use slabcast_schedule::{Action, Clock, Config, Event, FrameJob, Micros, Scheduler};
use std::sync::Arc;
use std::time::Instant;

struct Wall(Instant);

impl Clock for Wall {
    fn now(&self) -> Micros {
        self.0.elapsed().as_micros() as Micros
    }
}

fn slab() -> Work {
    Work { schedule: Schedule::Slab, ..Work::default() }
}

/// A frame of `edge` pixels over a cube of `n` bricks each way, on `workers` workers that answer
/// at once. Prints milliseconds a slab and lease.
fn cost(n: u32, edge: u32, height: f64, workers: u64, work: Work) -> f64 {
    let dims = [n * BRICK_EDGE; 3];
    let small = Volume::from_fn_u8("cost", [4; 3], |i, _, _| i as u8);
    let mut info = small.info(Digest32([1; 32]));
    info.lattice.dims = dims;
    let transfer = presets::by_name("grey", &info.summary).expect("a known name");
    let quality = Quality::before();
    let camera = Camera {
        to_eye: [0.3, 0.5, 1.0].into(),
        up: [0.0, 1.0, 0.0].into(),
        target: [0.0; 3].into(),
        projection: CameraProjection::Ortho { height: height * f64::from(dims[0]) },
    };
    let view = View::new(&info.lattice, &camera, [edge, edge], &quality).expect("drawable");
    let grid = BrickGrid::new(dims);
    let bricks: Arc<[BrickInfo]> = (0..grid.len() as u32)
        .map(|id| {
            let lo = grid.corner(BrickId(id));
            let tight = TightBox { lo, hi: lo.map(|x| x + BRICK_EDGE - 1) };
            BrickInfo { id: BrickId(id), tight, voxels: 512, bytes: 1547 }
        })
        .collect();
    let set = BrickSetKey(Digest32([2; 32]));
    let scene = Arc::new(SceneSpec {
        id: SceneId(1),
        volume: info,
        transfer,
        quality,
        crop: None,
        bricks: set,
    });
    let count = bricks.len();
    let job = FrameJob {
        frame: FrameId(1),
        number: 0,
        scene,
        bricks,
        view,
        work,
        finish: None,
        client: 0,
    };

    let clock = Wall(Instant::now());
    let mut s = Scheduler::new(Config::default());
    for id in 1..=workers {
        let joined = Event::WorkerJoined {
            worker: WorkerId(id),
            name: format!("w{id}"),
            identity: Default::default(),
            is_trusted: true,
            threads: 4,
            is_local: false,
            memory_budget_bytes: u64::MAX,
            held: Vec::new(),
        };
        s.handle(&clock, joined);
    }
    s.handle(&clock, Event::FrameQueued(Box::new(job)));
    let mut leases = 0u32;
    let stats = 'frame: loop {
        let mut events = Vec::new();
        while let Some(action) = s.next_action() {
            match action {
                Action::Send { worker, message: ToWorker::Lease(l) } => {
                    leases += 1;
                    let n = l.tile.area();
                    let pixels =
                        TilePixels { a: vec![0.5; n], colour: vec![[1; 3]; n], last: None };
                    let times = TaskTimes::default();
                    let counters = Default::default();
                    let (task, epoch) = (l.task, l.epoch);
                    let (pixels, bytes, region) = (Pixels::Sums(pixels), None, None);
                    let result = TileResult { task, epoch, pixels, bytes, counters, times, region };
                    events.push(Event::Result { worker, result: Box::new(result) });
                }
                Action::SendBricks { worker, set, bricks } => {
                    let bricks = bricks.len() as u32;
                    events.push(Event::BricksIn { worker, set, bricks });
                }
                Action::FrameDone { stats, .. } => break 'frame stats,
                _ => {}
            }
        }
        events.into_iter().for_each(|e| s.handle(&clock, e));
    };
    let slab_ms = stats.ms.cull / stats.slabs.len() as f64;
    let lease_us = (stats.ms.total - stats.ms.cull) * 1e3 / f64::from(leases);
    println!(
        "{count} bricks, {edge}x{edge}, {workers} workers, {leases} leases: cull and quadtree \
         {slab_ms:.2} ms a slab; all else {lease_us:.0} us a lease, fake results included"
    );
    slab_ms
}

#[test]
fn planning_a_slab_of_15000_bricks_takes_milliseconds() {
    let best = (0..3).map(|_| cost(25, 512, 1.7, 4, slab())).fold(f64::MAX, f64::min);
    // 20 times what it takes on an idle machine; a quadratic mistake takes more.
    assert!(best < 40.0, "{best} ms");
}

#[test]
fn many_workers_and_tiles_take_no_more_than_their_number() {
    cost(25, 512, 1.7, 100, Work { tile: Some(16), ..slab() });
    // Each brick covers a large part of the picture: 4,096 tiles of thousands of bricks.
    cost(12, 1024, 0.05, 4, Work { tile: Some(16), slabs: 2, ..slab() });
}

#[test]
#[ignore = "takes 4 GiB: a frame's state is 48 bytes a pixel"]
fn the_largest_picture_works() {
    cost(25, 8192, 1.7, 4, slab());
}
