//! A worker's session with a master, from the hello to the end of the link.
//!
//! One task on the runtime; it decides and never computes. A slab lease waits here until its last
//! brick has come and then goes to the render threads, so that the first tiles are drawn while
//! bricks of the others are still on their way. A region goes to the threads at once and comes back
//! when it stalls for want of bricks: `stalls` decides which bricks are asked for.

mod waiting;

use crate::cache::BrickCache;
use crate::pool::{
    FrameSlot, Pool, Progress, RegionReport, RegionTask, Report, SceneSlot, SlabReport, SlabTask,
    SplitRequest, Task,
};
use crate::rehearse::Rehearsal;
use crate::stalls::{BrickRequest, RegionKey, Stalls};
use slabcast_common::PIXELS_VERSION;
use slabcast_common::brick::BrickGrid;
use slabcast_common::ids::{Epoch, FrameId, SceneId, TaskId};
use slabcast_common::message::{
    BrickBatch, Hello, Lease, Pixels, RegionCost, RegionLease, TOLD_TO_STOP, TaskTimes, TileResult,
    ToMaster, ToWorker,
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
use waiting::{WaitingLease, WaitingLeases};

/// Longest time that a worker which is told to stop waits for the tasks it has begun.
const DRAIN: Duration = Duration::from_secs(8);

/// Longest time that bricks which tasks wait for may stay away without a single brick coming. The
/// Bricks stream has a connection of its own, which may stall (a router that swallows large
/// packets) while pings go on. At half of it, a busy master's pause ends links; at double, a frame
/// waits as much longer. A link of less than 200 kb/s can't bring a batch in this time.
const BRICKS_OVERDUE: Duration = Duration::from_secs(3);

/// Number of looks for bricks in [`BRICKS_OVERDUE`]; after so many in vain, bricks are overdue. A
/// worker counts looks and not time, so that a process that was stopped does not blame its master.
const LOOKS: u32 = 12;

/// Longest time that a master may take to answer the hello.
const UNTIL_WELCOME: Duration = Duration::from_secs(10);

/// Settings of a worker: name, threads, memory, instruction set.
#[derive(Clone, Debug)]
pub struct Config {
    /// Name of the worker, for people.
    pub name: String,
    /// Number of render threads, at least 1.
    pub threads: u32,
    /// Encoded bytes of bricks that the worker may hold.
    pub memory_budget_bytes: u64,
    /// Instruction set that the renderer uses.
    pub simd: Simd,
    /// A trace to rehearse: tiles are held for the trace's times, and nothing is drawn.
    pub rehearsal: Option<Arc<Rehearsal>>,
    /// Name of this machine, by which the master tells whether it is its own; empty if unknown.
    pub machine: String,
}

/// The worker's end of a link to a master, over a network or inside a process.
pub struct Link {
    /// Control messages from the master. Unbounded; the leases that the master lends and its pings
    /// bound it.
    pub control: mpsc::UnboundedReceiver<ToWorker>,
    /// Messages to the master; the first is the hello.
    pub replies: mpsc::Sender<ToMaster>,
    /// Bricks from the master, and orders to forget some.
    pub bricks: mpsc::Receiver<Bricks>,
}

/// Reason why a worker's session with its master ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ended {
    /// The connection was lost, for this reason; dial again.
    Lost(String),
    /// The master does not let this worker in, for this reason; dialling again would not help.
    Refused(String),
    /// The master ended, for this reason; dial again later.
    MasterLeft(String),
    /// The worker was told to stop.
    Stopped,
}

/// Makes the hello of a worker that holds the bricks of `cache`. Draws the self-test tile, which
/// takes some milliseconds.
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

/// Serves one master over `link`, from the hello to its end, and returns why it ended. When `stop`
/// turns true the worker drains: it takes no more leases, finishes what it has begun, says that it
/// leaves and ends. Bricks stay in `cache` for the next session.
///
/// # Errors
/// If the system gives no render threads.
pub async fn run(
    config: &Config,
    mut link: Link,
    cache: &mut BrickCache,
    mut stop: watch::Receiver<bool>,
) -> std::io::Result<Ended> {
    let (pool, mut reports) = Pool::start(config.threads, config.simd, config.rehearsal.as_ref())?;
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
    let mut session = Session::new(pool, cache, config.memory_budget_bytes);
    let mut drain_until: Option<tokio::time::Instant> = None;
    let mut are_bricks_open = true;
    let mut looks = tokio::time::interval(BRICKS_OVERDUE / LOOKS);
    looks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut looks_without_bricks = 0;
    loop {
        if session.is_leaving && session.in_pool == 0 && session.stalled.is_empty() {
            return Ok(Ended::Stopped);
        }
        let drained = async {
            match drain_until {
                Some(until) => tokio::time::sleep_until(until).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = tokio::time::sleep_until(session.last_heard + session.patience) => {
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
                Some(ToWorker::MasterEnding { reason }) => return Ok(Ended::MasterLeft(reason)),
                Some(message) => {
                    session.last_heard = tokio::time::Instant::now();
                    session.on_message(message);
                }
            },
            batch = link.bricks.recv(), if are_bricks_open => {
                looks_without_bricks = 0;
                match batch {
                    Some(Bricks::Batch(batch)) => session.on_bricks(batch),
                    Some(Bricks::Message(message)) => session.on_message(message),
                    None => are_bricks_open = false,
                }
            }
            _ = looks.tick() => {
                looks_without_bricks += 1;
                if !session.waits_for_bricks() {
                    looks_without_bricks = 0;
                } else if looks_without_bricks > LOOKS && link.bricks.is_empty() {
                    let reason = format!(
                        "no brick came in {} s while tasks waited for some: the second connection \
                         is stalled",
                        BRICKS_OVERDUE.as_secs()
                    );
                    // Not the tasks are to blame, and the master need not wait for them.
                    let _ = link.replies.send(ToMaster::Goodbye { reason: reason.clone() }).await;
                    return Ok(Ended::Lost(reason));
                }
            }
            Some(report) = reports.recv() => {
                session.on_report(report);
                // Bricks that several regions lack are asked for in one message.
                while let Ok(report) = reports.try_recv() {
                    session.on_report(report);
                }
            }
            changed = stop.changed(), if !session.is_leaving => {
                if changed.is_err() || *stop.borrow() {
                    info!(tasks = session.in_pool, "stopping, finishing tasks first");
                    session.leave();
                    drain_until = Some(tokio::time::Instant::now() + DRAIN);
                }
            }
            () = drained => {
                warn!(tasks = session.in_pool, "tasks not finished in time, stopping all the same");
                return Ok(Ended::Stopped);
            }
        }
        session.request_bricks();
        for reply in session.replies.drain(..) {
            if link.replies.send(reply).await.is_err() {
                return Ok(Ended::Lost("the master closed the link".into()));
            }
        }
    }
}

struct Session<'a> {
    pool: Pool,
    cache: &'a mut BrickCache,
    stalls: Stalls,
    /// Regions that are stalled.
    stalled: BTreeMap<RegionKey, Box<RegionTask>>,
    /// Split requests of all regions that are not done.
    splits: BTreeMap<RegionKey, (Epoch, Arc<SplitRequest>)>,
    scenes: BTreeMap<SceneId, Arc<SceneSlot>>,
    frames: BTreeMap<FrameId, Arc<FrameSlot>>,
    waiting: WaitingLeases,
    /// Tasks that render threads have or will take.
    in_pool: usize,
    /// Zero of this worker's clock.
    epoch: Instant,
    is_leaving: bool,
    /// When the master last said something.
    last_heard: tokio::time::Instant,
    /// Longest time that the master may be silent.
    patience: Duration,
    replies: Vec<ToMaster>,
}

impl Drop for Session<'_> {
    /// Tasks of a link that is gone need not be drawn.
    fn drop(&mut self) {
        for slot in self.frames.values() {
            slot.has_ended.store(true, Ordering::Relaxed);
        }
    }
}

impl<'a> Session<'a> {
    fn new(pool: Pool, cache: &'a mut BrickCache, memory_budget_bytes: u64) -> Self {
        Session {
            pool,
            cache,
            stalls: Stalls::new(memory_budget_bytes),
            stalled: BTreeMap::new(),
            splits: BTreeMap::new(),
            scenes: BTreeMap::new(),
            frames: BTreeMap::new(),
            waiting: WaitingLeases::default(),
            in_pool: 0,
            epoch: Instant::now(),
            is_leaving: false,
            last_heard: tokio::time::Instant::now(),
            patience: UNTIL_WELCOME,
            replies: Vec::new(),
        }
    }

    /// Whether tasks wait for bricks that the master was asked for or announced.
    fn waits_for_bricks(&self) -> bool {
        !self.waiting.is_empty() || self.stalls.waits_for_bricks()
    }

    // -----------------------------------------------------------------------------------------
    // From the master

    fn on_message(&mut self, message: ToWorker) {
        match message {
            ToWorker::Welcome { worker, heartbeat_ms, protocol_version } => {
                info!(%worker, protocol_version, "admitted by the master");
                self.patience = Duration::from_millis(u64::from(heartbeat_ms) * 3);
            }
            ToWorker::Scene(spec) => {
                self.scenes.insert(spec.id, Arc::new(SceneSlot::new(spec)));
            }
            ToWorker::Frame { frame, scene, view, finish, plain, client } => {
                if let Some(scene) = self.scenes.get(&scene) {
                    // The depths of a view can be checked against its volume only.
                    match convert::check_view(&scene.spec.volume.lattice, &view) {
                        Ok(()) => {
                            let slot = FrameSlot::new(scene.clone(), view, finish, plain, client);
                            self.frames.insert(frame, Arc::new(slot));
                        }
                        Err(e) => warn!(%frame, error = %e, "ignoring a wrong view of the master"),
                    }
                }
            }
            ToWorker::Directory { set, grid, first, total, bricks } => {
                debug!(bricks = bricks.len(), first, total, "directory");
                if let Err(problem) = self.cache.directory(set, grid, (first, total), bricks) {
                    warn!(first, total, problem, "ignoring a wrong directory of the master");
                }
            }
            ToWorker::Lease(lease) => self.on_lease(lease),
            ToWorker::Region(lease) => self.on_region_lease(lease),
            ToWorker::SplitRegion { frame, task, epoch, share } => {
                let key = (frame, task);
                match self.splits.get(&key) {
                    Some((of, split)) if *of == epoch => split.ask_for(share),
                    _ => return,
                }
                // A stalled region is split without waiting for its bricks.
                if let Some(task) = self.stalled.remove(&key) {
                    self.resume(task);
                    self.tell_pool_of_stalls();
                }
            }
            ToWorker::EndFrame { frame } => {
                if let Some(slot) = self.frames.remove(&frame) {
                    slot.has_ended.store(true, Ordering::Relaxed);
                }
                self.waiting.end_frame(frame);
                for key in self.stalls.end_frame(frame) {
                    self.stalled.remove(&key);
                    self.splits.remove(&key);
                }
                self.tell_pool_of_stalls();
            }
            ToWorker::EndScene { scene } => {
                self.scenes.remove(&scene);
            }
            ToWorker::DropBricks { set, bricks } => {
                debug!(bricks = bricks.len(), "bricks dropped");
                self.cache.remove(set, &bricks);
                // A lease may have come before this message although it was written after it:
                // control and bricks have no order. Its bricks come again.
                self.waiting.bricks_dropped(set, &bricks);
            }
            ToWorker::Ping { nonce } => {
                let clock_us = self.us(Instant::now());
                self.replies.push(ToMaster::Pong { nonce, clock_us });
            }
            ToWorker::Refused { .. } | ToWorker::MasterEnding { .. } => {}
        }
    }

    /// The frame of a lease, or why the lease can't be taken.
    fn frame_of_lease(&self, frame: FrameId) -> Result<Arc<FrameSlot>, &'static str> {
        if self.is_leaving {
            return Err("the worker is leaving");
        }
        self.frames.get(&frame).cloned().ok_or("its frame was never announced")
    }

    fn refuse(&mut self, task: TaskId, epoch: Epoch, reason: &str) {
        self.replies.push(ToMaster::Failed { task, epoch, reason: reason.into() });
    }

    fn on_lease(&mut self, lease: Box<Lease>) {
        let received = Instant::now();
        let frame = match self.frame_of_lease(lease.frame) {
            Ok(frame) => frame,
            Err(reason) => return self.refuse(lease.task, lease.epoch, reason),
        };
        let area = lease.tile.area();
        if lease.state.a.len() != area
            || lease.state.last.as_ref().is_some_and(|last| last.len() != area)
        {
            let reason = "its planes do not have the tile's size";
            return self.refuse(lease.task, lease.epoch, reason);
        }
        if let Some(ready) = self.waiting.add(lease, frame, received, self.cache) {
            self.start(ready);
        }
    }

    fn on_region_lease(&mut self, lease: RegionLease) {
        let received = Instant::now();
        let frame = match self.frame_of_lease(lease.frame) {
            Ok(frame) => frame,
            Err(reason) => return self.refuse(lease.task, lease.epoch, reason),
        };
        let (tile, spec) = (lease.tile, &frame.scene.spec);
        let picture = Rect::from_size(frame.view.size);
        if tile.is_empty() || tile.intersect(&picture) != tile {
            let reason = "its tile is not inside the picture";
            return self.refuse(lease.task, lease.epoch, reason);
        }
        let grid = BrickGrid::new(spec.volume.lattice.dims);
        let Some(table) = self.cache.table(spec.bricks).filter(|t| t.grid() == grid).cloned()
        else {
            let reason = "the directory of its bricks never came";
            return self.refuse(lease.task, lease.epoch, reason);
        };
        let (key, epoch) = ((lease.frame, lease.task), lease.epoch);
        self.stalls.add(key, spec.bricks, table.clone());
        let task = RegionTask::new(lease, frame, table, received);
        self.splits.insert(key, (epoch, task.split.clone()));
        self.resume(Box::new(task));
    }

    fn on_bricks(&mut self, batch: BrickBatch) {
        let set = batch.set;
        let (mut arrived, mut unstalled) = (0, Vec::new());
        for brick in batch.bricks {
            let id = brick.id;
            self.cache.put(set, brick);
            arrived += 1;
            if let Some(table) = self.cache.table(set) {
                self.stalls.brick_arrived(set, table, id, &mut unstalled);
            } else {
                self.stalls.bricks_without_table();
            }
            for ready in self.waiting.brick_arrived(set, id) {
                self.start(ready);
            }
        }
        for key in unstalled {
            if let Some(task) = self.stalled.remove(&key) {
                self.resume(task);
            }
        }
        self.tell_pool_of_stalls();
        if arrived > 0 {
            self.replies.push(ToMaster::BricksReceived { set, bricks: arrived });
        }
        if !batch.broken.is_empty() {
            warn!(bricks = batch.broken.len(), "bricks damaged in transit, asking for them again");
            self.replies.push(ToMaster::BricksBroken { set, bricks: batch.broken });
        }
    }

    // -----------------------------------------------------------------------------------------
    // To and from render threads

    /// Queues a slab lease whose bricks have come.
    fn start(&mut self, ready: WaitingLease) {
        let WaitingLease { lease, frame, received, .. } = ready;
        let set = frame.scene.spec.bricks;
        let bricks = lease.bricks.iter().filter_map(|id| self.cache.get(set, *id).cloned());
        let bricks: Vec<_> = bricks.collect();
        if bricks.len() != lease.bricks.len() {
            let reason = "bricks were dropped while it waited";
            return self.refuse(lease.task, lease.epoch, reason);
        }
        self.in_pool += 1;
        let ready = Instant::now();
        self.pool.submit(Task::Slab(SlabTask { lease, frame, bricks, received, ready }));
    }

    /// Queues a region that begins or goes on.
    fn resume(&mut self, mut task: Box<RegionTask>) {
        if let Some(since) = task.stalled_at.take() {
            task.stalled += since.elapsed();
        }
        self.in_pool += 1;
        self.pool.submit(Task::Region(task));
    }

    fn tell_pool_of_stalls(&self) {
        self.pool.set_stalled(!self.stalled.is_empty());
    }

    fn on_report(&mut self, report: Report) {
        match report {
            Report::Slab(report) => self.on_slab_report(report),
            Report::Region(report) => self.on_region_report(report),
            Report::Piece(piece) => self.replies.push(ToMaster::RegionSplit(piece)),
            Report::Prefetch(set, table, places) => {
                let bricks = self.stalls.prefetch(set, &table, &places, self.cache);
                if !bricks.is_empty() {
                    self.replies.push(ToMaster::BricksWanted { set, bricks });
                }
            }
        }
    }

    fn on_slab_report(&mut self, report: SlabReport) {
        self.in_pool -= 1;
        let Some(outcome) = report.outcome else { return };
        let (task, epoch) = (report.lease.task, report.lease.epoch);
        self.replies.push(match outcome {
            Ok((pixels, counters)) => ToMaster::Result(Box::new(TileResult {
                task,
                epoch,
                pixels: Pixels::Sums(pixels),
                bytes: None,
                counters,
                times: TaskTimes {
                    received_us: self.us(report.received),
                    ready_us: self.us(report.ready),
                    start_us: self.us(report.start),
                    end_us: self.us(report.end),
                    thread: report.thread,
                },
                region: None,
            })),
            Err(reason) => {
                warn!(%task, reason, "tile failed");
                ToMaster::Failed { task, epoch, reason }
            }
        });
    }

    /// A region is done, stalled or failed.
    fn on_region_report(&mut self, report: RegionReport) {
        self.in_pool -= 1;
        let RegionReport { task: mut region, end, thread, progress } = report;
        let RegionLease { task, epoch, frame, .. } = region.lease;
        let key = (frame, task);
        let is_stalled =
            matches!(progress, Progress::Stalled { .. }) && self.frames.contains_key(&frame);
        if !is_stalled {
            self.splits.remove(&key);
        }
        match progress {
            Progress::Stalled { missing, is_deeper } if is_stalled => {
                region.stalls += 1;
                if self.stalls.stall(key, &missing, is_deeper) || region.split.is_pending() {
                    self.resume(region);
                } else {
                    region.stalled_at = Some(Instant::now());
                    self.stalled.insert(key, region);
                    self.tell_pool_of_stalls();
                }
            }
            // One that gave way is with the pool and comes with a later report.
            Progress::FrameEnded | Progress::Stalled { .. } | Progress::GaveWay => {
                self.stalls.remove(key, &[]);
            }
            Progress::Done(drawn) => {
                self.stalls.remove(key, &drawn.touched);
                let times = TaskTimes {
                    received_us: self.us(region.received),
                    ready_us: self.us(region.received + region.stalled),
                    start_us: self.us(end - region.drawn),
                    end_us: self.us(end),
                    thread,
                };
                let cost = RegionCost {
                    touched: drawn.touched,
                    stalls: region.stalls,
                    parked_us: region.stalled.as_micros() as u64,
                    idle_us: self.pool.take_idle().as_micros() as u64,
                    sampled: drawn.sampled,
                };
                self.replies.push(ToMaster::Result(Box::new(TileResult {
                    task,
                    epoch,
                    pixels: drawn.pixels,
                    bytes: None,
                    counters: drawn.counters,
                    times,
                    region: Some(cost),
                })));
            }
            Progress::Failed(reason) => {
                self.stalls.remove(key, &[]);
                warn!(%task, reason, "region failed");
                self.replies.push(ToMaster::Failed { task, epoch, reason });
            }
        }
    }

    // -----------------------------------------------------------------------------------------
    // To the master

    /// Asks for the bricks that stalled regions lack, after making room.
    fn request_bricks(&mut self) {
        if let Some(budget) = self.cache.budget() {
            self.stalls.set_budget(budget);
        }
        for request in self.stalls.requests(self.cache) {
            let reply = match request {
                BrickRequest::Forgotten(set, bricks) => {
                    debug!(bricks = bricks.len(), "bricks dropped for others");
                    self.waiting.bricks_dropped(set, &bricks);
                    ToMaster::BricksEvicted { set, bricks }
                }
                BrickRequest::Wanted(set, bricks) => ToMaster::BricksWanted { set, bricks },
            };
            self.replies.push(reply);
        }
    }

    /// Takes no more leases. Slab tiles whose bricks are here are finished, and regions that have
    /// begun.
    fn leave(&mut self) {
        self.is_leaving = true;
        self.waiting.clear();
        self.replies.push(ToMaster::Goodbye { reason: TOLD_TO_STOP.into() });
    }

    /// Microseconds on this worker's clock.
    fn us(&self, time: Instant) -> u64 {
        time.saturating_duration_since(self.epoch).as_micros() as u64
    }
}

#[cfg(test)]
mod tests;
