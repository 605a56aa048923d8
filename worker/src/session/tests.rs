use super::*;
use slabcast_common::brick::{Brick, BrickInfo, BrickSetKey};
use slabcast_common::ids::{BrickId, Epoch, WorkerId};
use slabcast_common::image::{
    Background, PixelEncoding, PixelFormat, SparseTile, TilePixels, TileState,
};
use slabcast_common::message::SceneSpec;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::View;
use slabcast_common::volume::{Digest32, Samples, Volume};
use slabcast_scene::path::{Orientation, Turntable, ViewPath};
use slabcast_scene::presets;

const FRAME: FrameId = FrameId(5);
/// A frame of the same view whose regions are finished.
const FINISHED: FrameId = FrameId(9);
const FINISH: PixelEncoding =
    PixelEncoding { format: PixelFormat::Rgb8, background: Background::Colour([1.0, 0.5, 0.0]) };
const SET: BrickSetKey = BrickSetKey(Digest32([7; 32]));

/// The master's end of a link, and a worker behind it.
struct World {
    control: mpsc::UnboundedSender<ToWorker>,
    bricks: mpsc::Sender<Bricks>,
    replies: mpsc::Receiver<ToMaster>,
    stop: watch::Sender<bool>,
    ended: tokio::task::JoinHandle<std::io::Result<Ended>>,
    /// Scene and view that the worker was told of.
    known: Option<(SceneSpec, View)>,
}

/// Two full bricks beside each other.
fn brick(id: u32) -> Arc<Brick> {
    let values = Samples::U8(vec![200; 512]);
    Arc::new(Brick::new(BrickId(id), (0..512).collect(), values, None))
}

impl World {
    /// A worker that was let in and knows a frame of 32x32 pixels.
    async fn new() -> World {
        let (control, control_rx) = mpsc::unbounded_channel();
        let (bricks, bricks_rx) = mpsc::channel(8);
        let (replies_tx, replies) = mpsc::channel(64);
        let (stop, stopped) = watch::channel(false);
        let ended = tokio::spawn(async move {
            let config = Config {
                name: "w".into(),
                threads: 1,
                memory_budget_bytes: 1 << 20,
                simd: Simd::plain(),
                rehearsal: None,
                machine: String::new(),
            };
            let link = Link { control: control_rx, replies: replies_tx, bricks: bricks_rx };
            run(&config, link, &mut BrickCache::default(), stopped).await
        });
        let mut world = World { control, bricks, replies, stop, ended, known: None };
        assert!(matches!(world.hear().await, ToMaster::Hello(_)), "the hello comes first");

        let volume = Volume::from_fn_u8("pair", [16, 8, 8], |_, _, _| 200);
        assert_eq!(BrickGrid::new(volume.lattice.dims).len(), 2);
        let quality = Quality { sums: Sums::I32, ..Quality::before() };
        let mut transfer = presets::by_name("peer-opaque", &volume.summary).unwrap();
        transfer.shading.on = false;
        let path = ViewPath::from_turntable([32, 32], Turntable::default());
        let orientation = Orientation::new(None, None).unwrap();
        let camera = path.camera(0, &volume.lattice, orientation).unwrap();
        let view = View::new(&volume.lattice, &camera, [32, 32], &quality).unwrap();
        let id = SceneId(3);
        let volume = volume.info(Digest32::default());
        let spec = SceneSpec { id, volume, transfer, quality, crop: None, bricks: SET };
        let (worker, heartbeat_ms) = (WorkerId(1), 60_000);
        let protocol_version = slabcast_common::PROTOCOL_VERSION;
        world.say(ToWorker::Welcome { worker, heartbeat_ms, protocol_version });
        world.known = Some((spec.clone(), view));
        world.say(ToWorker::Scene(Arc::new(spec)));
        for (frame, finish) in [(FRAME, None), (FINISHED, Some(FINISH))] {
            world.say(ToWorker::Frame { frame, scene: id, view, finish, plain: false, client: 0 });
        }
        world
    }

    fn say(&self, message: ToWorker) {
        self.control.send(message).expect("the worker listens");
    }

    async fn hear(&mut self) -> ToMaster {
        let heard = tokio::time::timeout(Duration::from_secs(20), self.replies.recv()).await;
        heard.expect("an answer in time").expect("the worker is there")
    }

    async fn send(&mut self, id: u32) {
        let batch = BrickBatch { set: SET, bricks: vec![brick(id)], broken: vec![] };
        self.bricks.send(Bricks::Batch(batch)).await.expect("the worker listens");
        let heard = self.hear().await;
        assert_eq!(heard, ToMaster::BricksReceived { set: SET, bricks: 1 });
    }

    fn lease(&self, task: u64, bricks: &[u32]) {
        self.lease_of(FRAME, task, bricks);
    }

    fn lease_of(&self, frame: FrameId, task: u64, bricks: &[u32]) {
        self.say(ToWorker::Lease(Box::new(Lease {
            task: TaskId(task),
            epoch: Epoch(0),
            frame,
            tile: Rect::new(0, 0, 32, 32),
            slab: SheetRange::new(-20, 20),
            bricks: bricks.iter().map(|&id| BrickId(id)).collect(),
            state: TileState { a: vec![0.0; 32 * 32], last: None },
        })));
    }

    /// The directory of both bricks.
    fn directory(&self) {
        let grid = BrickGrid { dims: [2, 1, 1] };
        let info = |id| {
            let b = brick(id);
            let bytes = b.encoded_len() as u32;
            BrickInfo { id: b.id, tight: b.tight_box(&grid), voxels: 512, bytes }
        };
        let bricks = [info(0), info(1)].into();
        self.say(ToWorker::Directory { set: SET, grid, first: 0, total: 2, bricks });
    }

    fn region(&self, task: u64, tile: Rect) {
        self.region_of(FRAME, task, tile);
    }

    fn region_of(&self, frame: FrameId, task: u64, tile: Rect) {
        let (task, epoch) = (TaskId(task), Epoch(0));
        let (estimate, begun) = (false, None);
        self.say(ToWorker::Region(RegionLease { task, epoch, frame, tile, estimate, begun }));
    }

    async fn result(&mut self) -> Box<TileResult> {
        match self.hear().await {
            ToMaster::Result(result) => result,
            other => panic!("a result, not {other:?}"),
        }
    }

    /// Waits until the worker has handled all that was said before.
    async fn settle(&mut self) {
        self.say(ToWorker::Ping { nonce: 77 });
        let heard = self.hear().await;
        assert!(matches!(heard, ToMaster::Pong { nonce: 77, .. }), "not yet: {heard:?}");
    }
}

fn sums(result: &TileResult) -> &TilePixels {
    match &result.pixels {
        Pixels::Sums(sums) => sums,
        Pixels::Finished(_) => panic!("sums"),
    }
}

#[tokio::test]
async fn slab_lease_waits_for_its_last_brick() {
    let mut world = World::new().await;
    world.lease(1, &[0, 1]);
    world.settle().await;
    world.send(1).await;
    world.settle().await;
    world.send(0).await;
    let ToMaster::Result(result) = world.hear().await else { panic!("a result") };
    assert_eq!((result.task, result.pixels.len()), (TaskId(1), 32 * 32));
    assert!(sums(&result).a.iter().any(|&a| a > 0.9), "both bricks were drawn");
    assert!(result.times.ready_us >= result.times.received_us);
}

/// Control and bricks have no order: a lease that was written after "forget 0" may come
/// before it. Its brick 0 is the one that is sent again.
#[tokio::test]
async fn brick_dropped_under_a_waiting_lease_is_waited_for_again() {
    let mut world = World::new().await;
    world.send(0).await;
    world.lease(1, &[0, 1]);
    world.settle().await;
    let drop = ToWorker::DropBricks { set: SET, bricks: vec![BrickId(0)] };
    world.bricks.send(Bricks::Message(drop)).await.unwrap();
    world.send(1).await;
    world.settle().await;
    world.send(0).await;
    assert!(matches!(world.hear().await, ToMaster::Result(_)));
}

/// Returns the bricks that regions request, once there are so many.
async fn requested(world: &mut World, bricks: usize) -> Vec<u32> {
    let mut asked = Vec::new();
    while asked.len() < bricks {
        let ToMaster::BricksWanted { set, bricks } = world.hear().await else {
            panic!("a request")
        };
        assert_eq!(set, SET);
        asked.extend(bricks.iter().map(|b| b.0));
    }
    asked
}

#[tokio::test]
async fn stalled_regions_request_each_brick_once_and_go_on_when_it_comes() {
    let mut world = World::new().await;
    world.directory();
    // Both halves of the picture lie under both bricks.
    world.region(1, Rect::new(0, 0, 32, 16));
    world.region(2, Rect::new(0, 16, 32, 32));
    let mut asked = requested(&mut world, 2).await;
    asked.sort_unstable();
    assert_eq!(asked, [0, 1]);
    world.settle().await;
    world.send(1).await;
    world.settle().await;
    world.send(0).await;
    let results = [world.result().await, world.result().await];
    for (result, task) in results.iter().zip([1, 2]) {
        assert_eq!((result.task, result.pixels.len()), (TaskId(task), 512));
        assert!(sums(result).a.iter().any(|&a| a > 0.9) && sums(result).last.is_none());
        let cost = result.region.as_ref().expect("of a region");
        assert_eq!(cost.touched, [0, 1]);
        if task == 1 {
            assert_eq!(cost.stalls, 1);
            assert!(cost.parked_us > 0);
        } else {
            // It may have been begun when all its bricks had come.
            assert!(cost.stalls <= 1, "{} stalls", cost.stalls);
            assert!(cost.stalls == 1 || cost.parked_us == 0, "{} us", cost.parked_us);
        }
    }
    // Bricks that are here are not requested, and no region stalls.
    world.region(3, Rect::new(0, 0, 32, 32));
    let result = world.result().await;
    assert_eq!(result.region.as_ref().map(|c| (c.stalls, c.parked_us)), Some((0, 0)));
    let halves = results.iter().flat_map(|r| sums(r).a.clone());
    assert!(halves.eq(sums(&result).a.iter().copied()), "stopping changes no byte");
}

/// Without culling, a region needs all bricks that overlap it: they are requested in one message.
#[tokio::test]
async fn prefetch_requests_bricks_before_their_region_is_begun() {
    let mut world = World::new().await;
    world.directory();
    let frame = FrameId(9);
    let (known, view) = world.known.clone().expect("a scene");
    let quality = Quality { cull: false, ..known.quality };
    let spec = SceneSpec { id: SceneId(4), quality, ..known };
    let (scene, finish) = (spec.id, None);
    world.say(ToWorker::Scene(Arc::new(spec)));
    world.say(ToWorker::Frame { frame, scene, view, finish, plain: false, client: 0 });
    world.send(1).await;
    let tile = Rect::new(0, 0, 32, 32);
    world.region_of(frame, 1, tile);
    assert_eq!(requested(&mut world, 1).await, [0]);
    world.settle().await;
    world.send(0).await;
    let result = world.result().await;
    assert_eq!(result.region.map(|cost| cost.touched), Some(vec![0, 1]));
    let drop = ToWorker::DropBricks { set: SET, bricks: vec![BrickId(0), BrickId(1)] };
    world.bricks.send(Bricks::Message(drop)).await.unwrap();
    world.settle().await;
    world.region_of(frame, 2, tile);
    let ToMaster::BricksWanted { bricks, .. } = world.hear().await else { panic!("a request") };
    assert_eq!(bricks, [BrickId(0), BrickId(1)]);
    world.send(1).await;
    world.send(0).await;
    let result = world.result().await;
    assert_eq!(result.region.map(|cost| cost.touched), Some(vec![0, 1]));
}

/// Seen from the side, one brick begins eight sheets behind the other. In a scene's first frame
/// each is requested when drawing comes to it; later, as the thread has waited for bricks, both
/// together.
#[tokio::test]
async fn lookahead_grows_while_render_threads_wait_for_bricks() {
    let mut world = World::new().await;
    world.directory();
    let (known, _) = world.known.clone().expect("a scene");
    let volume = Volume::from_fn_u8("pair", [16, 8, 8], |_, _, _| 200);
    let mut transfer = presets::by_name("peer-semi", &volume.summary).unwrap();
    transfer.shading.on = false;
    let spec = SceneSpec { id: SceneId(4), transfer, ..known };
    let turntable = Turntable { start: 90.0, ..Turntable::default() };
    let orientation = Orientation::new(None, None).unwrap();
    let path = ViewPath::from_turntable([32, 32], turntable);
    let camera = path.camera(0, &volume.lattice, orientation).unwrap();
    let view = View::new(&volume.lattice, &camera, [32, 32], &spec.quality).unwrap();
    let (scene, finish) = (spec.id, None);
    world.say(ToWorker::Scene(Arc::new(spec)));
    for frame in [FrameId(9), FrameId(10)] {
        world.say(ToWorker::Frame { frame, scene, view, finish, plain: false, client: 0 });
    }
    let bricks_of = |heard| match heard {
        ToMaster::BricksWanted { bricks, .. } => bricks.iter().map(|b| b.0).collect::<Vec<_>>(),
        other => panic!("a request, not {other:?}"),
    };
    let scene_began = Instant::now();
    world.region_of(FrameId(9), 1, Rect::new(0, 0, 32, 16));
    for _ in 0..2 {
        let asked = bricks_of(world.hear().await);
        assert_eq!(asked.len(), 1, "one after the other");
        world.send(asked[0]).await;
    }
    assert_eq!(world.result().await.region.map(|cost| cost.stalls), Some(2));
    // No bricks are expected for another tile, and it waits longer than a fiftieth of the time.
    for tile in [Rect::new(0, 16, 16, 32), Rect::new(16, 16, 32, 32)] {
        let drop = ToWorker::DropBricks { set: SET, bricks: vec![BrickId(0), BrickId(1)] };
        world.bricks.send(Bricks::Message(drop)).await.unwrap();
        world.settle().await;
        world.region_of(FrameId(10), 2, tile);
        let asked = bricks_of(world.hear().await);
        // Its thread is idle for more than a fiftieth of the time since the scene began.
        let stalled = Instant::now();
        // A busy machine may let it wait for some slices before it is idle.
        while stalled.elapsed() < Duration::from_millis(100)
            || stalled.elapsed() * 5 < scene_began.elapsed()
        {
            world.settle().await;
        }
        for brick in &asked {
            world.send(*brick).await;
        }
        if asked.len() == 1 {
            let more = bricks_of(world.hear().await);
            world.send(more[0]).await;
        }
        let stalls = world.result().await.region.map(|cost| cost.stalls);
        let first = tile.x0 == 0;
        assert_eq!((asked.len(), stalls), if first { (1, Some(2)) } else { (2, Some(1)) });
    }
}

#[tokio::test]
async fn region_is_finished_on_the_worker_if_its_frame_asks_and_a_slab_never() {
    let mut world = World::new().await;
    world.directory();
    let tile = Rect::new(0, 0, 32, 32);
    world.region(1, tile);
    requested(&mut world, 2).await;
    world.send(0).await;
    world.send(1).await;
    let raw = world.result().await;
    world.region_of(FINISHED, 2, tile);
    let finished = world.result().await;
    let want = SparseTile::encode(sums(&raw), [32, 32], &FINISH);
    assert!(!want.data.is_empty());
    assert_eq!(finished.pixels, Pixels::Finished(want));
    world.lease_of(FINISHED, 3, &[0, 1]);
    let slab = world.result().await;
    assert_eq!(sums(&slab).a, sums(&raw).a);
}

#[tokio::test]
async fn work_stealing_piece_of_a_region_resumes_with_the_same_pixels() {
    let mut world = World::new().await;
    world.directory();
    let tile = Rect::new(0, 0, 32, 32);
    world.region(1, tile);
    requested(&mut world, 2).await;
    let split = |task, epoch| {
        let (frame, task, epoch) = (FRAME, TaskId(task), Epoch(epoch));
        ToWorker::SplitRegion { frame, task, epoch, share: 500 }
    };
    // It gives nothing away for a task, or a state of it, that it does not have.
    world.say(split(1, 1));
    world.say(split(2, 0));
    world.settle().await;
    // Though it stands still.
    world.say(split(1, 0));
    let ToMaster::RegionSplit(piece) = world.hear().await else { panic!("a piece") };
    assert_eq!((piece.task, piece.epoch), (TaskId(1), Epoch(0)));
    assert_eq!(piece.kept.union(&piece.given), tile);
    assert_eq!((piece.kept.area(), piece.given.area()), (512, 512));
    assert_eq!(piece.begun.pixels.a.len(), 512);
    world.send(0).await;
    world.send(1).await;
    let kept = world.result().await;
    assert_eq!((kept.task, kept.pixels.len()), (TaskId(1), 512));
    world.say(split(1, 0));
    world.settle().await;
    let lease = |task, tile, begun| {
        let (task, epoch, frame, estimate) = (TaskId(task), Epoch(0), FRAME, false);
        ToWorker::Region(RegionLease { task, epoch, frame, tile, estimate, begun })
    };
    world.say(lease(2, piece.given, Some(Arc::new(piece.begun.clone()))));
    let given = world.result().await;
    world.say(lease(3, tile, None));
    let whole = world.result().await;
    for (part, rect) in [(kept, piece.kept), (given, piece.given)] {
        assert_eq!(*sums(&part), sums(&whole).crop(tile, rect), "as if it had never moved");
    }
    // A state that the tile can't have is refused.
    world.say(lease(4, tile, Some(Arc::new(piece.begun.clone()))));
    let ToMaster::Failed { reason, .. } = world.hear().await else { panic!("refused") };
    assert!(reason.contains("tile's size"), "{reason}");
}

#[tokio::test]
async fn stalled_region_ends_with_its_frame() {
    let mut world = World::new().await;
    world.directory();
    world.region(1, Rect::new(0, 0, 32, 32));
    requested(&mut world, 2).await;
    world.say(ToWorker::EndFrame { frame: FRAME });
    world.send(0).await;
    world.send(1).await;
    world.settle().await;
    world.stop.send(true).unwrap();
    assert!(matches!(world.hear().await, ToMaster::Goodbye { .. }));
    assert_eq!(world.ended.await.unwrap().unwrap(), Ended::Stopped, "nothing is waited for");
}

#[tokio::test]
async fn draining_worker_finishes_its_stalled_regions() {
    let mut world = World::new().await;
    world.directory();
    world.region(1, Rect::new(0, 0, 32, 32));
    requested(&mut world, 2).await;
    world.stop.send(true).unwrap();
    assert!(matches!(world.hear().await, ToMaster::Goodbye { .. }));
    world.region(2, Rect::new(0, 0, 32, 32));
    assert!(matches!(world.hear().await, ToMaster::Failed { task: TaskId(2), .. }));
    world.send(0).await;
    world.send(1).await;
    assert_eq!(world.result().await.task, TaskId(1));
    assert_eq!(world.ended.await.unwrap().unwrap(), Ended::Stopped);
}

#[tokio::test]
async fn dropped_brick_of_a_stalled_region_is_requested_again() {
    let mut world = World::new().await;
    world.directory();
    world.region(1, Rect::new(0, 0, 32, 32));
    requested(&mut world, 2).await;
    world.send(0).await;
    let drop = ToWorker::DropBricks { set: SET, bricks: vec![BrickId(0)] };
    world.bricks.send(Bricks::Message(drop)).await.unwrap();
    world.send(1).await;
    assert_eq!(requested(&mut world, 1).await, [0]);
    world.send(0).await;
    let result = world.result().await;
    assert_eq!(result.region.map(|c| (c.touched, c.stalls)), Some((vec![0, 1], 2)));
}

#[tokio::test]
async fn region_leases_that_make_no_sense_are_refused() {
    let mut world = World::new().await;
    let refused = |message| match message {
        ToMaster::Failed { reason, .. } => reason,
        other => panic!("not refused: {other:?}"),
    };
    world.region(1, Rect::new(0, 0, 32, 32));
    assert!(refused(world.hear().await).contains("directory"));
    let set = SET;
    let (grid, bricks) = (BrickGrid { dims: [1, 2, 1] }, Vec::new().into());
    world.say(ToWorker::Directory { set, grid, first: 0, total: 0, bricks });
    world.region(1, Rect::new(0, 0, 32, 32));
    assert!(refused(world.hear().await).contains("directory"), "of another volume");
    world.directory();
    world.region(2, Rect::new(0, 0, 33, 32));
    assert!(refused(world.hear().await).contains("inside the picture"));
    world.region(3, Rect::new(4, 4, 4, 9));
    assert!(refused(world.hear().await).contains("inside the picture"));
    world.say(ToWorker::EndFrame { frame: FRAME });
    world.region(4, Rect::new(0, 0, 32, 32));
    assert!(refused(world.hear().await).contains("never announced"));
}

#[tokio::test]
async fn slab_leases_that_make_no_sense_are_refused() {
    let mut world = World::new().await;
    world.lease(1, &[0, 1]);
    world.say(ToWorker::EndFrame { frame: FRAME });
    world.lease(2, &[0]);
    let ToMaster::Failed { task, reason, .. } = world.hear().await else { panic!("refused") };
    assert!(task == TaskId(2) && reason.contains("never announced"), "{reason}");
    // The first was dropped with its frame: its bricks wake nobody.
    world.send(0).await;
    world.send(1).await;
    world.settle().await;
}

#[tokio::test]
async fn worker_that_is_told_to_stop_says_that_it_leaves_and_ends() {
    let mut world = World::new().await;
    world.lease(1, &[0]);
    world.settle().await;
    world.stop.send(true).unwrap();
    assert!(matches!(world.hear().await, ToMaster::Goodbye { .. }));
    assert_eq!(world.ended.await.unwrap().unwrap(), Ended::Stopped);
}

#[tokio::test(start_paused = true)]
async fn master_that_is_silent_for_three_heartbeats_is_given_up() {
    let world = World::new().await;
    let World { control: _control, bricks: _bricks, replies: _replies, stop: _stop, ended, .. } =
        world;
    let Ended::Lost(reason) = ended.await.unwrap().unwrap() else { panic!("lost") };
    assert!(reason.contains("silent"), "{reason}");
}

/// Announces frames of client 1, each of more sheets than the one before, until the region of one
/// takes long. Returns that frame, its tile and the region's result.
async fn long_region(world: &mut World) -> (FrameId, Rect, Box<TileResult>) {
    world.directory();
    world.send(0).await;
    world.send(1).await;
    let (known, _) = world.known.clone().expect("a scene");
    let size = [64, 64];
    let tile = Rect::from_size(size);
    for n in 2..=6 {
        let thickness = 0.5f64.powi(n);
        let quality = Quality { cull: false, eps: 0.0, thickness, ..known.quality };
        let path = ViewPath::from_turntable(size, Turntable::default());
        let orientation = Orientation::new(None, None).unwrap();
        let camera = path.camera(0, &known.volume.lattice, orientation).unwrap();
        let view = View::new(&known.volume.lattice, &camera, size, &quality).unwrap();
        let spec = SceneSpec { id: SceneId(100 + n as u64), quality, ..known.clone() };
        let (frame, scene, finish) = (FrameId(100 + n as u64), spec.id, None);
        world.say(ToWorker::Scene(Arc::new(spec)));
        world.say(ToWorker::Frame { frame, scene, view, finish, plain: false, client: 1 });
        world.region_of(frame, 1, tile);
        let result = world.result().await;
        if result.times.end_us - result.times.start_us > 150_000 || n == 6 {
            return (frame, tile, result);
        }
    }
    unreachable!("the last one returns");
}

/// Clients take turns: one's region gives way at a sheet, and goes on from there.
#[tokio::test]
async fn region_of_a_client_is_drawn_beside_a_long_one_of_another_with_the_same_pixels() {
    let mut world = World::new().await;
    let (long, tile, alone) = long_region(&mut world).await;
    let alone_us = alone.times.end_us - alone.times.start_us;
    assert!(alone_us > 60_000, "it has to last several turns: {alone_us} us");

    let began = Instant::now();
    world.region_of(long, 2, tile);
    world.settle().await;
    let mut before = 0;
    let beside = loop {
        // Regions of another client's frame.
        world.region_of(FRAME, 10 + before, Rect::new(0, 0, 32, 32));
        let result = world.result().await;
        if result.task == TaskId(2) {
            break result;
        }
        before += 1;
    };
    let took = began.elapsed();
    assert!(before >= 2, "{before} regions were drawn meanwhile, in {took:?}");
    assert_eq!(sums(&beside), sums(&alone), "as if it had never given way");
    assert_eq!(beside.region.map(|c| c.touched), alone.region.map(|c| c.touched));
}

#[tokio::test]
async fn region_that_is_being_drawn_ends_with_its_frame() {
    let mut world = World::new().await;
    let (long, tile, alone) = long_region(&mut world).await;
    let alone_us = alone.times.end_us - alone.times.start_us;

    world.region_of(long, 2, tile);
    world.settle().await;
    // Nobody else is there to whom it would give way.
    world.say(ToWorker::EndFrame { frame: long });
    let ended = Instant::now();
    world.stop.send(true).unwrap();
    assert!(matches!(world.hear().await, ToMaster::Goodbye { .. }));
    assert_eq!(world.ended.await.unwrap().unwrap(), Ended::Stopped);
    let took = ended.elapsed();
    assert!(took.as_micros() < u128::from(alone_us) / 4, "{took:?}; alone {alone_us} us");
}
