//! Where a worker's messages, bricks and results meet.
//!
//! One task on the runtime; it decides and never computes. A lease waits here until its last
//! brick is there and then goes to the render threads; so the first tiles render while bricks
//! of the others are still on their way. A region goes to them at once, and comes back when it lacks
//! bricks: `parking` says what is asked for.

use crate::cache::BrickCache;
use crate::parking::{Parking, Say, Who};
use crate::pool::{
    Came, FrameSlot, Going, Gone, Outcome, Pool, Ready, Rendered, SceneSlot, Task, Wish,
};
use crate::rehearse::Rehearsal;
use slabcast_common::brick::{BrickGrid, BrickSetKey};
use slabcast_common::ids::{BrickId, Epoch, FrameId, SceneId, TaskId};
use slabcast_common::message::{
    BrickBatch, Hello, Lease, Pixels, RegionCost, RegionLease, TaskTimes, TileResult, ToMaster,
    ToWorker,
};
use slabcast_common::occlusion::Rect;
use slabcast_common::{PIXELS_VERSION, PROTOCOL_VERSION};
use slabcast_proto::convert::{self, Bricks};
use slabcast_render::Simd;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, watch};
use tracing::{debug, info, warn};

/// How long a worker that is told to stop waits for the tasks it has begun.
const DRAIN: Duration = Duration::from_secs(8);

/// How long a master may take to answer the hello.
const UNTIL_WELCOME: Duration = Duration::from_secs(10);

/// What a worker is started with.
#[derive(Clone, Debug)]
pub struct Config {
    /// A name for people.
    pub name: String,
    /// Render threads, at least 1.
    pub threads: u32,
    /// Bytes of bricks that it may hold.
    pub memory_budget_bytes: u64,
    /// Instruction set.
    pub simd: Simd,
    /// Tiles are held for the times of this trace, and nothing is drawn.
    pub rehearsal: Option<Arc<Rehearsal>>,
    /// Which machine this is, for the master to tell whether it is its own; empty if unknown.
    pub machine: String,
}

/// A link to a master, over a network or not.
pub struct Link {
    /// From the master.
    pub control: mpsc::UnboundedReceiver<ToWorker>,
    /// To the master.
    pub replies: mpsc::Sender<ToMaster>,
    /// Bricks.
    pub bricks: mpsc::Receiver<Bricks>,
}

/// Why a link ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ended {
    /// The connection was lost; dial again.
    Lost(String),
    /// The master does not take this worker; dialling again would not help.
    Refused(String),
    /// The master ended; dial again later.
    MasterLeft(String),
    /// This worker was told to stop.
    Stopped,
}

/// The hello of a worker with `cache`. Draws the self-test tile (some milliseconds).
pub fn hello(config: &Config, cache: &BrickCache) -> Hello {
    Hello {
        protocol_version: PROTOCOL_VERSION,
        pixels_version: PIXELS_VERSION,
        name: config.name.clone(),
        threads: config.threads,
        memory_budget_bytes: config.memory_budget_bytes,
        simd: config.simd.name().into(),
        self_test_sha256: slabcast_render::selftest::run(config.simd).to_string(),
        held: cache.held(),
        rehearses: config.rehearsal.is_some(),
        machine: config.machine.clone(),
    }
}

/// Serves one master over `link`, from the hello to its end. `stop` turning true drains the
/// worker: it takes no more leases, finishes what it has begun and leaves.
pub async fn run(
    config: &Config,
    mut link: Link,
    cache: &mut BrickCache,
    mut stop: watch::Receiver<bool>,
) -> std::io::Result<Ended> {
    let (pool, mut results) = Pool::start(config.threads, config.simd, config.rehearsal.as_ref())?;
    let hello = {
        // The self-test draws: not on the runtime's thread.
        let (config, held) = (config.clone(), cache.held());
        let drawn = tokio::task::spawn_blocking(move || hello(&config, &BrickCache::default()));
        let mut hello = drawn.await.map_err(std::io::Error::other)?;
        hello.held = held;
        hello
    };
    if link.replies.send(ToMaster::Hello(hello)).await.is_err() {
        return Ok(Ended::Lost("the master closed the link before the hello".into()));
    }
    cache.forget_directories();
    let mut desk = Desk {
        pool,
        cache,
        parking: Parking::new(config.memory_budget_bytes),
        parked: BTreeMap::new(),
        wishes: BTreeMap::new(),
        scenes: BTreeMap::new(),
        frames: BTreeMap::new(),
        waiting: BTreeMap::new(),
        missing: BTreeMap::new(),
        in_pool: 0,
        epoch: Instant::now(),
        leaving: false,
        heard: tokio::time::Instant::now(),
        patience: UNTIL_WELCOME,
        replies: Vec::new(),
    };
    let mut drain_until: Option<tokio::time::Instant> = None;
    let mut bricks_open = true;
    loop {
        if desk.leaving && desk.in_pool == 0 && desk.parked.is_empty() {
            return Ok(Ended::Stopped);
        }
        let drained = async {
            match drain_until {
                Some(at) => tokio::time::sleep_until(at).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = tokio::time::sleep_until(desk.heard + desk.patience) => {
                return Ok(Ended::Lost("the master was silent for three heartbeats".into()));
            }
            message = link.control.recv() => match message {
                None => return Ok(Ended::Lost("the master closed the link".into())),
                Some(ToWorker::Refused { reason }) => return Ok(Ended::Refused(reason)),
                Some(ToWorker::Leave { reason }) => return Ok(Ended::MasterLeft(reason)),
                Some(message) => {
                    desk.heard = tokio::time::Instant::now();
                    desk.told(message);
                }
            },
            batch = link.bricks.recv(), if bricks_open => match batch {
                Some(Bricks::Batch(batch)) => desk.bricks_in(batch),
                Some(Bricks::Message(message)) => desk.told(message),
                None => bricks_open = false,
            },
            Some(outcome) = results.recv() => {
                desk.came_back(outcome);
                // What regions lack together is asked for together.
                while let Ok(outcome) = results.try_recv() {
                    desk.came_back(outcome);
                }
            }
            changed = stop.changed(), if !desk.leaving => {
                if changed.is_err() || *stop.borrow() {
                    info!("stopping: finishing what has begun");
                    desk.leave();
                    drain_until = Some(tokio::time::Instant::now() + DRAIN);
                }
            }
            () = drained => {
                warn!(tasks = desk.in_pool, "gave up waiting for tasks");
                return Ok(Ended::Stopped);
            }
        }
        desk.ask();
        for reply in desk.replies.drain(..) {
            if link.replies.send(reply).await.is_err() {
                return Ok(Ended::Lost("the master closed the link".into()));
            }
        }
    }
}

/// A lease whose bricks are not all here.
struct Waiting {
    lease: Box<Lease>,
    frame: Arc<FrameSlot>,
    missing: usize,
    received: Instant,
}

struct Desk<'a> {
    pool: Pool,
    cache: &'a mut BrickCache,
    parking: Parking,
    /// Regions that stand still.
    parked: BTreeMap<Who, Box<Going>>,
    /// Where each region that is not at its end is told to give some of its tile away.
    wishes: BTreeMap<Who, (Epoch, Arc<Wish>)>,
    scenes: BTreeMap<SceneId, Arc<SceneSlot>>,
    frames: BTreeMap<FrameId, Arc<FrameSlot>>,
    waiting: BTreeMap<TaskId, Waiting>,
    /// Who waits for a brick.
    missing: BTreeMap<(BrickSetKey, BrickId), Vec<TaskId>>,
    /// Tasks that render threads have or will take.
    in_pool: usize,
    /// Zero of this worker's clock.
    epoch: Instant,
    leaving: bool,
    /// When the master last said something.
    heard: tokio::time::Instant,
    /// How long it may be silent.
    patience: Duration,
    replies: Vec<ToMaster>,
}

impl Drop for Desk<'_> {
    /// Tasks of a link that is gone need not be rendered.
    fn drop(&mut self) {
        for slot in self.frames.values() {
            slot.over.store(true, Ordering::Relaxed);
        }
    }
}

impl Desk<'_> {
    fn told(&mut self, message: ToWorker) {
        match message {
            ToWorker::Welcome { worker, heartbeat_ms } => {
                info!(%worker, "let in");
                self.patience = Duration::from_millis(u64::from(heartbeat_ms) * 3);
            }
            ToWorker::Scene(spec) => {
                self.scenes.insert(spec.id, Arc::new(SceneSlot::new(spec)));
            }
            ToWorker::Frame { frame, scene, view, finish, plain } => {
                if let Some(scene) = self.scenes.get(&scene) {
                    // A view alone looks right; only with its volume can its depths be judged.
                    match convert::check_view(&scene.spec.volume.lattice, &view) {
                        Ok(()) => {
                            let slot = FrameSlot::new(scene.clone(), view, finish, plain);
                            self.frames.insert(frame, Arc::new(slot));
                        }
                        Err(e) => warn!(%frame, error = %e, "the master sent a view that is wrong"),
                    }
                }
            }
            ToWorker::Directory { set, grid, first, total, bricks } => {
                debug!(bricks = bricks.len(), first, total, "directory");
                if let Err(problem) = self.cache.directory(set, grid, (first, total), bricks) {
                    warn!(first, total, problem, "the master sent a directory that is wrong");
                }
            }
            ToWorker::Lease(lease) => self.lease(lease),
            ToWorker::Region(lease) => self.region(lease),
            ToWorker::HandOver { frame, task, epoch, share } => {
                let who = (frame, task);
                match self.wishes.get(&who) {
                    Some((of, wish)) if *of == epoch => wish.give(share),
                    _ => return,
                }
                // One that stands still does not wait for its bricks to do so.
                if let Some(going) = self.parked.remove(&who) {
                    self.go_on(going);
                    self.pool.parked(!self.parked.is_empty());
                }
            }
            ToWorker::EndFrame { frame } => {
                if let Some(slot) = self.frames.remove(&frame) {
                    slot.over.store(true, Ordering::Relaxed);
                }
                self.waiting.retain(|_, w| w.lease.frame != frame);
                for who in self.parking.end_frame(frame) {
                    self.parked.remove(&who);
                    self.wishes.remove(&who);
                }
                self.pool.parked(!self.parked.is_empty());
            }
            ToWorker::EndScene { scene } => {
                self.scenes.remove(&scene);
            }
            ToWorker::DropBricks { set, bricks } => {
                debug!(bricks = bricks.len(), "bricks dropped");
                self.cache.remove(set, &bricks);
                // A lease may have come before this message although it was written after it:
                // control and bricks have no order. Its bricks come again.
                self.wait_again(set, &bricks);
            }
            ToWorker::Ping { nonce } => {
                let clock_us = self.us(Instant::now());
                self.replies.push(ToMaster::Pong { nonce, clock_us });
            }
            ToWorker::Refused { .. } | ToWorker::Leave { .. } => {}
        }
    }

    fn lease(&mut self, lease: Box<Lease>) {
        let received = Instant::now();
        let fail = |reason: &str| ToMaster::Failed {
            task: lease.task,
            epoch: lease.epoch,
            reason: reason.into(),
        };
        if self.leaving {
            self.replies.push(fail("the worker is leaving"));
            return;
        }
        let Some(frame) = self.frames.get(&lease.frame).cloned() else {
            self.replies.push(fail("its frame was never announced"));
            return;
        };
        if lease.state.a.len() != lease.tile.area()
            || lease.state.last.as_ref().is_some_and(|l| l.len() != lease.tile.area())
        {
            self.replies.push(fail("its planes do not have the tile's size"));
            return;
        }
        let set = frame.scene.spec.bricks;
        let mut missing = 0;
        for id in &lease.bricks {
            if self.cache.get(set, *id).is_none() {
                self.missing.entry((set, *id)).or_default().push(lease.task);
                missing += 1;
            }
        }
        let waiting = Waiting { lease, frame, missing, received };
        if missing == 0 {
            self.start(waiting);
        } else {
            self.waiting.insert(waiting.lease.task, waiting);
        }
    }

    fn region(&mut self, lease: RegionLease) {
        let received = Instant::now();
        let refuse = |reason: &str| ToMaster::Failed {
            task: lease.task,
            epoch: lease.epoch,
            reason: reason.into(),
        };
        if self.leaving {
            self.replies.push(refuse("the worker is leaving"));
            return;
        }
        let Some(frame) = self.frames.get(&lease.frame).cloned() else {
            self.replies.push(refuse("its frame was never announced"));
            return;
        };
        let (tile, spec) = (lease.tile, &frame.scene.spec);
        let picture = Rect::of_size(frame.view.size);
        if tile.is_empty() || tile.intersect(&picture) != tile {
            self.replies.push(refuse("its tile is not inside the picture"));
            return;
        }
        let grid = BrickGrid::of(spec.volume.lattice.dims);
        let Some(shelf) = self.cache.shelf(spec.bricks).filter(|s| s.grid() == grid).cloned()
        else {
            self.replies.push(refuse("the directory of its bricks never came"));
            return;
        };
        let (who, epoch) = ((lease.frame, lease.task), lease.epoch);
        self.parking.enter(who, spec.bricks, shelf.clone());
        let going = Going::new(lease, frame, shelf, received);
        self.wishes.insert(who, (epoch, going.wish.clone()));
        self.go_on(Box::new(going));
    }

    fn go_on(&mut self, mut going: Box<Going>) {
        if let Some(at) = going.parked_at.take() {
            going.parked += at.elapsed();
        }
        self.in_pool += 1;
        self.pool.submit(Task::Region(going));
    }

    fn came_back(&mut self, outcome: Outcome) {
        match outcome {
            Outcome::Slab(done) => self.rendered(done),
            Outcome::Region(gone) => self.went(gone),
            Outcome::Handed(piece) => self.replies.push(ToMaster::HandedOver(piece)),
            Outcome::Expected(set, shelf, places) => {
                let bricks = self.parking.expect(set, &shelf, &places, self.cache);
                if !bricks.is_empty() {
                    self.replies.push(ToMaster::BricksWanted { set, bricks });
                }
            }
        }
    }

    /// Leases that wait have these bricks no longer.
    fn wait_again(&mut self, set: BrickSetKey, bricks: &[BrickId]) {
        for (task, w) in &mut self.waiting {
            let needs = |id: &&BrickId| w.lease.bricks.binary_search(id).is_ok();
            if w.frame.scene.spec.bricks == set {
                for id in bricks.iter().filter(needs) {
                    let waiters = self.missing.entry((set, *id)).or_default();
                    if !waiters.contains(task) {
                        waiters.push(*task);
                        w.missing += 1;
                    }
                }
            }
        }
    }

    /// A region came to its end, or stands still.
    fn went(&mut self, gone: Gone) {
        self.in_pool -= 1;
        let Gone { mut going, end, thread, came } = gone;
        let RegionLease { task, epoch, frame, .. } = going.lease;
        let who = (frame, task);
        let stands = matches!(came, Came::Lacks(..)) && self.frames.contains_key(&frame);
        if !stands {
            self.wishes.remove(&who);
        }
        match came {
            Came::Lacks(lacks, farther) if stands => {
                going.stalls += 1;
                if self.parking.park(who, &lacks, farther) || going.wish.is_there() {
                    self.go_on(going);
                } else {
                    going.parked_at = Some(Instant::now());
                    self.parked.insert(who, going);
                    self.pool.parked(true);
                }
            }
            Came::Over | Came::Lacks(..) => self.parking.leave(who, &[]),
            Came::Done(done) => {
                self.parking.leave(who, &done.touched);
                let times = TaskTimes {
                    received_us: self.us(going.received),
                    ready_us: self.us(going.received + going.parked),
                    start_us: self.us(end - going.drawn),
                    end_us: self.us(end),
                    thread,
                };
                let region = Some(RegionCost {
                    touched: done.touched,
                    stalls: going.stalls,
                    parked_us: going.parked.as_micros() as u64,
                    idle_us: self.pool.waited().as_micros() as u64,
                    sampled: done.sampled,
                });
                let (pixels, counters, bytes) = (done.pixels, done.counters, None);
                let result = TileResult { task, epoch, pixels, bytes, counters, times, region };
                self.replies.push(ToMaster::Result(Box::new(result)));
            }
            Came::Failed(reason) => {
                self.parking.leave(who, &[]);
                warn!(%task, reason, "region failed");
                self.replies.push(ToMaster::Failed { task, epoch, reason });
            }
        }
    }

    /// Asks for what regions lack, after making room.
    fn ask(&mut self) {
        for say in self.parking.ask(self.cache) {
            let reply = match say {
                Say::Forgotten(set, bricks) => {
                    debug!(bricks = bricks.len(), "bricks forgotten");
                    self.wait_again(set, &bricks);
                    ToMaster::BricksForgotten { set, bricks }
                }
                Say::Wanted(set, bricks) => ToMaster::BricksWanted { set, bricks },
            };
            self.replies.push(reply);
        }
    }

    fn start(&mut self, w: Waiting) {
        let set = w.frame.scene.spec.bricks;
        let bricks = w.lease.bricks.iter().filter_map(|id| self.cache.get(set, *id).cloned());
        let bricks: Vec<_> = bricks.collect();
        if bricks.len() != w.lease.bricks.len() {
            self.replies.push(ToMaster::Failed {
                task: w.lease.task,
                epoch: w.lease.epoch,
                reason: "bricks were dropped while it waited".into(),
            });
            return;
        }
        self.in_pool += 1;
        self.pool.submit(Task::Slab(Ready {
            lease: w.lease,
            frame: w.frame,
            bricks,
            received: w.received,
            ready: Instant::now(),
        }));
    }

    fn bricks_in(&mut self, batch: BrickBatch) {
        let set = batch.set;
        let (mut whole, mut on) = (0, Vec::new());
        for brick in batch.bricks {
            let id = brick.id;
            self.cache.put(set, brick);
            whole += 1;
            if let Some(shelf) = self.cache.shelf(set) {
                self.parking.came(set, shelf, id, &mut on);
            }
            for task in self.missing.remove(&(set, id)).unwrap_or_default() {
                let Some(w) = self.waiting.get_mut(&task) else { continue };
                w.missing -= 1;
                if w.missing == 0
                    && let Some(w) = self.waiting.remove(&task)
                {
                    self.start(w);
                }
            }
        }
        for who in on {
            if let Some(going) = self.parked.remove(&who) {
                self.go_on(going);
            }
        }
        self.pool.parked(!self.parked.is_empty());
        if whole > 0 {
            self.replies.push(ToMaster::BricksIn { set, bricks: whole });
        }
        if !batch.broken.is_empty() {
            warn!(bricks = batch.broken.len(), "bricks failed their checksum");
            self.replies.push(ToMaster::BricksBroken { set, bricks: batch.broken });
        }
    }

    fn rendered(&mut self, done: Rendered) {
        self.in_pool -= 1;
        let Some(outcome) = done.outcome else { return };
        let (task, epoch) = (done.lease.task, done.lease.epoch);
        self.replies.push(match outcome {
            Ok((pixels, counters)) => ToMaster::Result(Box::new(TileResult {
                task,
                epoch,
                pixels: Pixels::Sums(pixels),
                bytes: None,
                counters,
                times: TaskTimes {
                    received_us: self.us(done.received),
                    ready_us: self.us(done.ready),
                    start_us: self.us(done.start),
                    end_us: self.us(done.end),
                    thread: done.thread,
                },
                region: None,
            })),
            Err(reason) => {
                warn!(%task, reason, "task failed");
                ToMaster::Failed { task, epoch, reason }
            }
        });
    }

    /// Takes no more work. Tasks whose bricks are here are finished, and regions that have begun.
    fn leave(&mut self) {
        self.leaving = true;
        self.waiting.clear();
        self.replies.push(ToMaster::Leaving { reason: "told to stop".into() });
    }

    fn us(&self, at: Instant) -> u64 {
        at.saturating_duration_since(self.epoch).as_micros() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::brick::{Brick, BrickInfo};
    use slabcast_common::ids::{Epoch, WorkerId};
    use slabcast_common::image::{Background, PixelFormat, TilePixels, TileState};
    use slabcast_common::leaves::{Finish, Leaves};
    use slabcast_common::message::SceneSpec;
    use slabcast_common::occlusion::Rect;
    use slabcast_common::path::{Orientation, Turntable, ViewPath};
    use slabcast_common::presets;
    use slabcast_common::quality::{Quality, Sums};
    use slabcast_common::slab::SheetRange;
    use slabcast_common::view::View;
    use slabcast_common::volume::{Digest32, Samples, Volume};

    const FRAME: FrameId = FrameId(5);
    /// A frame of the same view whose regions are finished.
    const FINISHED: FrameId = FrameId(9);
    const FINISH: Finish =
        Finish { format: PixelFormat::Rgb8, background: Background::Colour([1.0, 0.5, 0.0]) };
    const SET: BrickSetKey = BrickSetKey(Digest32([7; 32]));

    /// A master's end of a link, and a worker behind it.
    struct World {
        control: mpsc::UnboundedSender<ToWorker>,
        bricks: mpsc::Sender<Bricks>,
        replies: mpsc::Receiver<ToMaster>,
        stop: watch::Sender<bool>,
        ended: tokio::task::JoinHandle<std::io::Result<Ended>>,
        /// What it was told of.
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
            assert_eq!(BrickGrid::of(volume.lattice.dims).len(), 2);
            let quality = Quality { sums: Sums::I32, ..Quality::default() };
            let mut transfer = presets::by_name("peer-opaque", &volume.summary).unwrap();
            transfer.shading.on = false;
            let path = ViewPath::turn([32, 32], Turntable::default());
            let orientation = Orientation::new(None, None).unwrap();
            let camera = path.camera(0, &volume.lattice, orientation).unwrap();
            let view = View::new(&volume.lattice, &camera, [32, 32], &quality).unwrap();
            let id = SceneId(3);
            let volume = volume.info(Digest32::default());
            let spec = SceneSpec { id, volume, transfer, quality, bricks: SET };
            let (worker, heartbeat_ms) = (WorkerId(1), 60_000);
            world.say(ToWorker::Welcome { worker, heartbeat_ms });
            world.known = Some((spec.clone(), view));
            world.say(ToWorker::Scene(Arc::new(spec)));
            for (frame, finish) in [(FRAME, None), (FINISHED, Some(FINISH))] {
                world.say(ToWorker::Frame { frame, scene: id, view, finish, plain: false });
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
            assert_eq!(heard, ToMaster::BricksIn { set: SET, bricks: 1 });
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
                BrickInfo { id: b.id, tight: b.tight(&grid), voxels: 512, bytes }
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

        /// All that was said before this has been handled when the pong comes.
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
    async fn a_lease_waits_for_its_last_brick() {
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
    async fn a_brick_that_is_dropped_under_a_waiting_lease_is_waited_for_again() {
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

    /// Wishes of regions until so many bricks were asked for.
    async fn wishes(world: &mut World, bricks: usize) -> Vec<u32> {
        let mut asked = Vec::new();
        while asked.len() < bricks {
            let ToMaster::BricksWanted { set, bricks } = world.hear().await else {
                panic!("a wish")
            };
            assert_eq!(set, SET);
            asked.extend(bricks.iter().map(|b| b.0));
        }
        asked
    }

    #[tokio::test]
    async fn regions_ask_for_each_brick_once_and_go_on_when_it_is_there() {
        let mut world = World::new().await;
        world.directory();
        // Both halves of the picture lie under both bricks.
        world.region(1, Rect::new(0, 0, 32, 16));
        world.region(2, Rect::new(0, 16, 32, 32));
        let mut asked = wishes(&mut world, 2).await;
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
            // The second may have been begun when all was here, or have stood still for less than a microsecond.
            assert!(cost.stalls > 0 && (cost.parked_us > 0 || task == 2) || cost.parked_us == 0);
            assert!(cost.stalls == 1 || task == 2 && cost.stalls == 0);
        }
        // What is here is not asked for, and nothing stands still.
        world.region(3, Rect::new(0, 0, 32, 32));
        let result = world.result().await;
        assert_eq!(result.region.as_ref().map(|c| (c.stalls, c.parked_us)), Some((0, 0)));
        let halves = results.iter().flat_map(|r| sums(r).a.clone());
        assert!(halves.eq(sums(&result).a.iter().copied()), "stopping changes no byte");
    }

    /// Where nothing is culled all that lies over a region is expected, and asked for in one message.
    #[tokio::test]
    async fn what_a_region_will_need_is_asked_for_before_it_is_begun() {
        let mut world = World::new().await;
        world.directory();
        let frame = FrameId(9);
        let (known, view) = world.known.clone().expect("a scene");
        let quality = Quality { cull: false, ..known.quality };
        let spec = SceneSpec { id: SceneId(4), quality, ..known };
        let (scene, finish) = (spec.id, None);
        world.say(ToWorker::Scene(Arc::new(spec)));
        world.say(ToWorker::Frame { frame, scene, view, finish, plain: false });
        world.send(1).await;
        let tile = Rect::new(0, 0, 32, 32);
        world.region_of(frame, 1, tile);
        assert_eq!(wishes(&mut world, 1).await, [0]);
        world.settle().await;
        world.send(0).await;
        let result = world.result().await;
        assert_eq!(result.region.map(|cost| cost.touched), Some(vec![0, 1]));
        let drop = ToWorker::DropBricks { set: SET, bricks: vec![BrickId(0), BrickId(1)] };
        world.bricks.send(Bricks::Message(drop)).await.unwrap();
        world.settle().await;
        world.region_of(frame, 2, tile);
        let ToMaster::BricksWanted { bricks, .. } = world.hear().await else { panic!("a wish") };
        assert_eq!(bricks, [BrickId(0), BrickId(1)]);
        world.send(1).await;
        world.send(0).await;
        let result = world.result().await;
        assert_eq!(result.region.map(|cost| cost.touched), Some(vec![0, 1]));
    }

    /// Seen from the side, one brick begins eight sheets behind the other. In a scene's first frame each is asked for when
    /// drawing comes to it; later, as the thread has waited for them, both together.
    #[tokio::test]
    async fn a_worker_that_waits_for_bricks_looks_past_the_first_that_it_lacks() {
        let mut world = World::new().await;
        world.directory();
        let (known, _) = world.known.clone().expect("a scene");
        let volume = Volume::from_fn_u8("pair", [16, 8, 8], |_, _, _| 200);
        let mut transfer = presets::by_name("peer-semi", &volume.summary).unwrap();
        transfer.shading.on = false;
        let spec = SceneSpec { id: SceneId(4), transfer, ..known };
        let turntable = Turntable { start: 90.0, ..Turntable::default() };
        let orientation = Orientation::new(None, None).unwrap();
        let path = ViewPath::turn([32, 32], turntable);
        let camera = path.camera(0, &volume.lattice, orientation).unwrap();
        let view = View::new(&volume.lattice, &camera, [32, 32], &spec.quality).unwrap();
        let (scene, finish) = (spec.id, None);
        world.say(ToWorker::Scene(Arc::new(spec)));
        for frame in [FrameId(9), FrameId(10)] {
            world.say(ToWorker::Frame { frame, scene, view, finish, plain: false });
        }
        let wish = |heard| match heard {
            ToMaster::BricksWanted { bricks, .. } => bricks.iter().map(|b| b.0).collect::<Vec<_>>(),
            other => panic!("a wish, not {other:?}"),
        };
        world.region_of(FrameId(9), 1, Rect::new(0, 0, 32, 16));
        for _ in 0..2 {
            let asked = wish(world.hear().await);
            assert_eq!(asked.len(), 1, "one after the other");
            world.send(asked[0]).await;
        }
        assert_eq!(world.result().await.region.map(|cost| cost.stalls), Some(2));
        // Of another tile nothing is expected, and it waits longer than a fiftieth of the time.
        for tile in [Rect::new(0, 16, 16, 32), Rect::new(16, 16, 32, 32)] {
            let drop = ToWorker::DropBricks { set: SET, bricks: vec![BrickId(0), BrickId(1)] };
            world.bricks.send(Bricks::Message(drop)).await.unwrap();
            world.settle().await;
            world.region_of(FrameId(10), 2, tile);
            let asked = wish(world.hear().await);
            tokio::time::sleep(Duration::from_millis(50)).await;
            for brick in &asked {
                world.send(*brick).await;
            }
            if asked.len() == 1 {
                let more = wish(world.hear().await);
                world.send(more[0]).await;
            }
            let stalls = world.result().await.region.map(|cost| cost.stalls);
            let first = tile.x0 == 0;
            assert_eq!((asked.len(), stalls), if first { (1, Some(2)) } else { (2, Some(1)) });
        }
    }

    #[tokio::test]
    async fn a_region_is_finished_where_its_frame_asks_for_it_and_a_slab_never() {
        let mut world = World::new().await;
        world.directory();
        let tile = Rect::new(0, 0, 32, 32);
        world.region(1, tile);
        wishes(&mut world, 2).await;
        world.send(0).await;
        world.send(1).await;
        let raw = world.result().await;
        world.region_of(FINISHED, 2, tile);
        let finished = world.result().await;
        let want = Leaves::of(sums(&raw), [32, 32], &FINISH);
        assert!(!want.data.is_empty());
        assert_eq!(finished.pixels, Pixels::Finished(want));
        world.lease_of(FINISHED, 3, &[0, 1]);
        let slab = world.result().await;
        assert_eq!(sums(&slab).a, sums(&raw).a);
    }

    #[tokio::test]
    async fn a_region_gives_a_piece_away_and_another_goes_on_from_there() {
        let mut world = World::new().await;
        world.directory();
        let tile = Rect::new(0, 0, 32, 32);
        world.region(1, tile);
        wishes(&mut world, 2).await;
        let hand_over = |task, epoch| {
            let (frame, task, epoch) = (FRAME, TaskId(task), Epoch(epoch));
            ToWorker::HandOver { frame, task, epoch, share: 500 }
        };
        // Of what it does not have, or not so, it gives nothing.
        world.say(hand_over(1, 1));
        world.say(hand_over(2, 0));
        world.settle().await;
        // Though it stands still.
        world.say(hand_over(1, 0));
        let ToMaster::HandedOver(piece) = world.hear().await else { panic!("a piece") };
        assert_eq!((piece.task, piece.epoch), (TaskId(1), Epoch(0)));
        assert_eq!(piece.kept.union(&piece.given), tile);
        assert_eq!((piece.kept.area(), piece.given.area()), (512, 512));
        assert_eq!(piece.begun.pixels.a.len(), 512);
        world.send(0).await;
        world.send(1).await;
        let kept = world.result().await;
        assert_eq!((kept.task, kept.pixels.len()), (TaskId(1), 512));
        world.say(hand_over(1, 0));
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
            assert_eq!(*sums(&part), sums(&whole).piece(tile, rect), "as if it had never moved");
        }
        // What can't have been begun so is refused.
        world.say(lease(4, tile, Some(Arc::new(piece.begun.clone()))));
        let ToMaster::Failed { reason, .. } = world.hear().await else { panic!("refused") };
        assert!(reason.contains("tile's size"), "{reason}");
    }

    #[tokio::test]
    async fn a_region_that_stands_still_ends_with_its_frame() {
        let mut world = World::new().await;
        world.directory();
        world.region(1, Rect::new(0, 0, 32, 32));
        wishes(&mut world, 2).await;
        world.say(ToWorker::EndFrame { frame: FRAME });
        world.send(0).await;
        world.send(1).await;
        world.settle().await;
        world.stop.send(true).unwrap();
        assert!(matches!(world.hear().await, ToMaster::Leaving { .. }));
        assert_eq!(world.ended.await.unwrap().unwrap(), Ended::Stopped, "nothing is waited for");
    }

    #[tokio::test]
    async fn a_worker_that_is_told_to_stop_finishes_regions_that_stand_still() {
        let mut world = World::new().await;
        world.directory();
        world.region(1, Rect::new(0, 0, 32, 32));
        wishes(&mut world, 2).await;
        world.stop.send(true).unwrap();
        assert!(matches!(world.hear().await, ToMaster::Leaving { .. }));
        world.region(2, Rect::new(0, 0, 32, 32));
        assert!(matches!(world.hear().await, ToMaster::Failed { task: TaskId(2), .. }));
        world.send(0).await;
        world.send(1).await;
        assert_eq!(world.result().await.task, TaskId(1));
        assert_eq!(world.ended.await.unwrap().unwrap(), Ended::Stopped);
    }

    #[tokio::test]
    async fn a_brick_that_a_region_stands_on_may_be_dropped_and_is_asked_for_again() {
        let mut world = World::new().await;
        world.directory();
        world.region(1, Rect::new(0, 0, 32, 32));
        wishes(&mut world, 2).await;
        world.send(0).await;
        let drop = ToWorker::DropBricks { set: SET, bricks: vec![BrickId(0)] };
        world.bricks.send(Bricks::Message(drop)).await.unwrap();
        world.send(1).await;
        assert_eq!(wishes(&mut world, 1).await, [0]);
        world.send(0).await;
        let result = world.result().await;
        assert_eq!(result.region.map(|c| (c.touched, c.stalls)), Some((vec![0, 1], 2)));
    }

    #[tokio::test]
    async fn regions_that_make_no_sense_are_answered_not_obeyed() {
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
    async fn leases_that_make_no_sense_are_answered_not_obeyed() {
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
    async fn a_worker_that_is_told_to_stop_says_goodbye_and_ends() {
        let mut world = World::new().await;
        world.lease(1, &[0]);
        world.settle().await;
        world.stop.send(true).unwrap();
        assert!(matches!(world.hear().await, ToMaster::Leaving { .. }));
        assert_eq!(world.ended.await.unwrap().unwrap(), Ended::Stopped);
    }

    #[tokio::test(start_paused = true)]
    async fn a_master_that_falls_silent_is_left() {
        let world = World::new().await;
        let World {
            control: _control, bricks: _bricks, replies: _replies, stop: _stop, ended, ..
        } = world;
        let Ended::Lost(reason) = ended.await.unwrap().unwrap() else { panic!("lost") };
        assert!(reason.contains("silent"), "{reason}");
    }
}
