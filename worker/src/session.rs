//! Where a worker's messages, bricks and results meet.
//!
//! One task on the runtime; it decides and never computes. A lease waits here until its last
//! brick is there and then goes to the render threads; so the first tiles render while bricks
//! of the others are still on their way. A region goes to them at once, and comes back when it lacks
//! bricks: `parking` says what is asked for.

use crate::cache::BrickCache;
use crate::pool::{
    Came, FrameSlot, Going, Gone, Outcome, Pool, Ready, Rendered, SceneSlot, Task, Wish,
};
use crate::rehearse::Rehearsal;
use crate::stalls::{Parking, Say, Who};
use slabcast_common::PIXELS_VERSION;
use slabcast_common::brick::{BrickGrid, BrickSetKey};
use slabcast_common::ids::{BrickId, Epoch, FrameId, SceneId, TaskId};
use slabcast_common::message::{
    BrickBatch, Hello, Lease, Pixels, RegionCost, RegionLease, TaskTimes, TileResult, ToMaster,
    ToWorker,
};
use slabcast_common::occlusion::Rect;
use slabcast_common::protocol::PROTOCOL_VERSIONS;
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
        protocol_versions: PROTOCOL_VERSIONS,
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
                Some(ToWorker::Welcome { protocol_version, .. })
                    if !PROTOCOL_VERSIONS.contains(protocol_version) =>
                {
                    return Ok(Ended::Refused(format!(
                        "the master chose protocol {protocol_version}, this worker speaks \
                         {PROTOCOL_VERSIONS}; run the same version of slabcast on both"
                    )));
                }
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
            ToWorker::Welcome { worker, heartbeat_ms, protocol_version } => {
                info!(%worker, protocol_version, "admitted by the master");
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
mod tests;
