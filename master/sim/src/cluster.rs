//! The virtual cluster: its clock, its queue of occurrences, and how it is driven.

mod bricks;
mod incidents;
mod links;
mod master;
mod thread_time;
mod threads;
mod worker;

pub use incidents::Incident;

use crate::config::{Master, WorkerProfile};
use crate::model::TileModel;
use crate::outcome::{
    DecisionTimes, FrameOutcome, Observer, Outcome, ThreadTime, Unpredictable, Work,
};
use crate::queues::{Cores, Pipe};
use crate::{Nanos, Rng};
use master::Chore;
use slabcast_common::brick::{BrickInfo, BrickSetKey};
use slabcast_common::ids::{BrickId, Epoch, FrameId, TaskId, WorkerId};
use slabcast_common::link::{FINISHER_THREADS, stream_threads};
use slabcast_common::message::ToWorker;
use slabcast_schedule::{Clock, Event, FrameJob, Micros, Scheduler, WorkerIdentity};
use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use worker::{Lent, Worker};

/// Bytes of a message that carries nothing large: head, ids, framing.
pub(crate) const SMALL_BYTES: u64 = 64;

/// Bricks that a worker holds, by set.
pub type HeldBricks = Vec<(BrickSetKey, Vec<BrickId>)>;

fn micros(ns: Nanos) -> Micros {
    ns / 1000
}

struct VirtualClock(Cell<Nanos>);

impl Clock for VirtualClock {
    fn now(&self) -> Micros {
        micros(self.0.get())
    }
}

/// Something that happens at a moment of virtual time.
enum Occurrence {
    /// A message of so many bytes has crossed the link to the master, where unpacking it takes so
    /// many nanoseconds.
    AtMaster { worker: WorkerId, event: Event, bytes: u64, unpack_ns: f64 },
    /// A message is decoded and lies before the driver.
    Inbox(Event),
    /// The driver is done with its work.
    DriverFree,
    /// A message has crossed the link to a worker.
    AtWorker(WorkerId, Box<ToWorker>),
    /// A message of the bricks stream, of so many bytes, has crossed the link to a worker.
    BricksAtWorker { worker: WorkerId, set: BrickSetKey, order: BrickOrder, bytes: u64 },
    /// A worker has decoded a lease.
    Lease(WorkerId, Lent),
    /// A run of a thread ends, unless the end was put off since.
    RunEnd { worker: WorkerId, thread: usize, version: u64 },
    /// Part of the work on a picture is done, and so many nanoseconds of it are left.
    Chore(Chore, f64),
    /// Something that the caller arranged.
    Incident(Box<Incident>),
}

/// A message of the bricks stream, which keeps its order.
#[derive(Clone, Debug)]
enum BrickOrder {
    Send(Vec<BrickId>),
    Drop(Vec<BrickId>),
}

/// A frame that was queued, or will be.
struct Frame {
    job: Arc<FrameJob>,
    outcome: FrameOutcome,
}

/// A master, its workers and their links, on a virtual clock.
///
/// 1. Make one with [`VirtualCluster::new`]; let workers [join](VirtualCluster::join).
/// 2. [Queue](VirtualCluster::queue) frames, and [schedule](VirtualCluster::schedule) incidents.
/// 3. Let time pass with [`VirtualCluster::run_until`]; look at the scheduler and the observer.
///
/// Two clusters of the same configuration, seed and calls behave the same.
pub struct VirtualCluster<M: TileModel, O: Observer> {
    master: Master,
    model: M,
    /// Watches; public so that tests read what it noted.
    pub observer: O,
    rng: Rng,
    seed: u64,
    clock: VirtualClock,
    scheduler: Scheduler,
    occurrences: BTreeMap<(Nanos, u64), Occurrence>,
    /// Occurrences of one moment happen in the order in which they were arranged.
    order: u64,
    workers: BTreeMap<WorkerId, Worker<M::Region>>,
    /// Workers whose links the master closed.
    dropped: BTreeSet<WorkerId>,
    next_worker: u64,
    /// Brick lists by set.
    sets: BTreeMap<BrickSetKey, Arc<[BrickInfo]>>,
    frames: BTreeMap<FrameId, Frame>,
    /// Frames of a path that wait until fewer are in hand.
    path: VecDeque<FrameId>,
    frames_in_hand: u32,
    /// The frame that traffic is counted for: the one after the last that was done.
    current_frame: Option<FrameId>,

    // The master's machine.
    down: Pipe,
    up: Pipe,
    inbox: Vec<Event>,
    driver_busy: bool,
    driver_awake: bool,
    driver: Cores,
    streams: Cores,
    finishers: Cores,
    /// The shared cores of a rehearsal, in which everything runs on one machine.
    machine: Option<Cores>,
    /// The frame and first sheet of the slab that was begun last.
    last_slab: Option<(FrameId, i32)>,
    /// Frames of which a region was lent.
    begun: BTreeSet<FrameId>,
    /// Frames that were begun under either schedule.
    frames_begun: u64,
    /// When the driver lent what has not begun yet.
    decided: BTreeMap<(WorkerId, TaskId, Epoch), Nanos>,

    // Results.
    worker_work: Nanos,
    first_work: Work,
    steady_work: [Nanos; 2],
    thread_time: ThreadTime,
    decisions: DecisionTimes,
    delivered: usize,
    /// From when threads' time is counted: when the first frame was delivered.
    counted_from: Option<Nanos>,
    counted: bool,
    bricks_wanted: u64,
    handed_over: u64,
    /// A tile that the model does not know ends the simulation.
    error: Option<Unpredictable>,
    /// The first frame that failed, which ends a prediction.
    failed: Option<Unpredictable>,
}

impl<M: TileModel, O: Observer> VirtualCluster<M, O> {
    /// Returns a cluster without workers or frames, a millisecond after its clock's zero. `seed`
    /// decides everything random.
    pub fn new(master: Master, model: M, observer: O, seed: u64) -> Self {
        let bytes_per_s = master.link.bytes_per_s;
        let streams = stream_threads(master.shared_cores.unwrap_or(u32::MAX)) as u32;
        VirtualCluster {
            model,
            observer,
            rng: Rng::new(seed),
            seed,
            clock: VirtualClock(Cell::new(1_000_000)),
            scheduler: Scheduler::new(master.scheduler),
            occurrences: BTreeMap::new(),
            order: 0,
            workers: BTreeMap::new(),
            dropped: BTreeSet::new(),
            next_worker: 1,
            sets: BTreeMap::new(),
            frames: BTreeMap::new(),
            path: VecDeque::new(),
            frames_in_hand: 0,
            current_frame: None,
            down: Pipe::new(bytes_per_s),
            up: Pipe::new(bytes_per_s),
            inbox: Vec::new(),
            driver_busy: false,
            driver_awake: false,
            driver: Cores::new(1),
            streams: Cores::new(streams),
            finishers: Cores::new(FINISHER_THREADS as u32),
            machine: master.shared_cores.map(Cores::new),
            last_slab: None,
            begun: BTreeSet::new(),
            frames_begun: 0,
            decided: BTreeMap::new(),
            worker_work: 0,
            first_work: Work::default(),
            steady_work: [0; 2],
            thread_time: ThreadTime::default(),
            decisions: DecisionTimes::default(),
            delivered: 0,
            counted_from: None,
            counted: false,
            bricks_wanted: 0,
            handed_over: 0,
            error: None,
            failed: None,
            master,
        }
    }

    /// Returns the time since the clock's zero, in microseconds.
    pub fn now(&self) -> Micros {
        self.clock.now()
    }

    /// Returns the scheduler, to be looked at.
    pub fn scheduler(&self) -> &Scheduler {
        &self.scheduler
    }

    /// Returns whether the scheduler has no frame and no event lies before it.
    pub fn is_idle(&self) -> bool {
        self.scheduler.is_idle() && self.inbox.is_empty() && self.path.is_empty()
    }

    /// Returns the number of bricks that workers asked for.
    pub fn bricks_wanted(&self) -> u64 {
        self.bricks_wanted
    }

    /// Returns the number of pieces that workers handed over.
    pub fn handed_over(&self) -> u64 {
        self.handed_over
    }

    /// Returns the jobs of all frames that were queued.
    pub fn jobs(&self) -> impl Iterator<Item = &FrameJob> {
        self.frames.values().map(|f| &*f.job)
    }

    /// Lets a worker join. Its hello is handled when time passes, or by [`VirtualCluster::settle`].
    pub fn join(&mut self, profile: WorkerProfile) -> WorkerId {
        self.join_with(profile, Vec::new())
    }

    /// Lets a worker join that holds bricks from an earlier link.
    pub fn join_with(&mut self, profile: WorkerProfile, held: HeldBricks) -> WorkerId {
        let id = WorkerId(self.next_worker);
        self.next_worker += 1;
        self.inbox.push(Event::WorkerJoined {
            worker: id,
            name: format!("w{}", id.0),
            identity: WorkerIdentity {
                host: profile.name.map_or_else(|| format!("host{}", id.0), str::to_string),
                name: profile.name.map_or_else(|| format!("w{}", id.0), str::to_string),
            },
            threads: profile.threads,
            is_trusted: profile.is_trusted,
            is_local: profile.is_local,
            memory_budget_bytes: profile.memory_budget_bytes,
            held: held.clone(),
        });
        let mut worker = Worker::new(profile, &self.sets);
        for (set, ids) in held {
            let Some(bricks) = self.sets.get(&set) else { continue };
            for id in ids {
                worker.hold(set, bricks, id);
            }
        }
        self.workers.insert(id, worker);
        id
    }

    /// Queues a frame. The scheduler learns of it when time passes, or by
    /// [`VirtualCluster::settle`].
    pub fn queue(&mut self, job: Box<FrameJob>) {
        self.register(&job);
        self.enter(job);
    }

    /// Queues the frames of a path, as many at a time as the master has in flight.
    pub fn queue_path(&mut self, jobs: &[FrameJob]) {
        for job in jobs {
            self.register(job);
            self.path.push_back(job.frame);
        }
        self.feed();
    }

    fn register(&mut self, job: &FrameJob) {
        let set = job.scene.bricks;
        if self.sets.insert(set, job.bricks.clone()).is_none() {
            self.workers.values_mut().for_each(|w| w.learn_set(set, job.bricks.len()));
        }
        let frame = Frame { job: Arc::new(job.clone()), outcome: FrameOutcome::default() };
        self.frames.insert(job.frame, frame);
        self.current_frame.get_or_insert(job.frame);
    }

    fn enter(&mut self, job: Box<FrameJob>) {
        if self.frames_in_hand == 0 {
            let now = self.now_ns();
            self.outcome_of(job.frame).began = now;
        }
        self.frames_in_hand += 1;
        self.inbox.push(Event::FrameQueued(job));
    }

    /// Gives the scheduler frames of the path while fewer are in hand than may be.
    fn feed(&mut self) {
        while self.frames_in_hand < self.master.frames_in_flight.max(1) {
            let Some(frame) = self.path.pop_front() else { return };
            let job = Box::new(FrameJob::clone(&self.frames[&frame].job));
            self.enter(job);
        }
    }

    /// Arranges an incident at a moment, in microseconds; at once if that has passed.
    pub fn schedule(&mut self, when: Micros, incident: Incident) {
        self.later(when.saturating_mul(1000), Occurrence::Incident(Box::new(incident)));
    }

    /// Handles everything that is due now, so that the scheduler has seen what was queued.
    pub fn settle(&mut self) {
        self.drive();
        while self.occurrences.first_key_value().is_some_and(|(k, _)| k.0 <= self.now_ns()) {
            self.step();
        }
    }

    /// Lets time pass until `until` says so, looking after each occurrence. Returns false if
    /// nothing will ever happen any more, or if 20 million occurrences did not suffice.
    pub fn run_until(&mut self, mut until: impl FnMut(&Self) -> bool) -> bool {
        self.settle();
        for _ in 0..20_000_000 {
            if until(self) {
                return true;
            }
            if self.error.is_some() || !self.step() {
                return false;
            }
        }
        false
    }

    /// Lets time pass until all frames are delivered.
    pub(crate) fn run_path(&mut self) -> Result<(), Unpredictable> {
        self.drive();
        while self.delivered < self.frames.len() {
            if let Some(error) = self.error.take().or(self.failed.take()) {
                return Err(error);
            }
            assert!(self.step(), "workers are pinged as long as they are there");
        }
        self.stop_counting();
        Ok(())
    }

    /// Returns what came of a path, and how long the scheduler decided.
    pub(crate) fn into_outcome(self) -> (Outcome, DecisionTimes) {
        let outcome = Outcome {
            frames: self.frames.values().map(|f| f.outcome).collect(),
            work: self.work(),
            first_work: self.first_work,
            steady_work: self.steady_work,
            thread_time: self.thread_time,
        };
        (outcome, self.decisions)
    }

    fn work(&self) -> Work {
        Work {
            driver: self.driver.work,
            streams: self.streams.work,
            finishers: self.finishers.work,
            workers: self.worker_work,
        }
    }

    fn now_ns(&self) -> Nanos {
        self.clock.0.get()
    }

    fn job(&self, frame: FrameId) -> Arc<FrameJob> {
        self.frames[&frame].job.clone()
    }

    fn outcome_of(&mut self, frame: FrameId) -> &mut FrameOutcome {
        &mut self.frames.get_mut(&frame).expect("a frame that was queued").outcome
    }

    /// The outcome that traffic is counted in, if a frame was queued.
    fn traffic(&mut self) -> Option<&mut FrameOutcome> {
        let frame = self.current_frame?;
        self.frames.get_mut(&frame).map(|f| &mut f.outcome)
    }

    fn later(&mut self, when: Nanos, what: Occurrence) {
        self.order += 1;
        self.occurrences.insert((when.max(self.now_ns()), self.order), what);
    }

    /// Lets the next thing happen. Returns false if there is none.
    fn step(&mut self) -> bool {
        let next = self.occurrences.first_key_value().map(|(k, _)| k.0);
        let due = self.scheduler.next_deadline().map(|d| d * 1000);
        match (next, due) {
            (Some(t), Some(d)) if d < t && !self.driver_busy => self.tick(d),
            (Some(_), _) => {
                let (key, what) = self.occurrences.pop_first().expect("just seen");
                self.clock.0.set(key.0.max(self.now_ns()));
                self.happen(key, what);
            }
            (None, Some(d)) => self.tick(d),
            (None, None) => return false,
        }
        true
    }

    fn tick(&mut self, when: Nanos) {
        self.clock.0.set(when.max(self.now_ns()));
        self.inbox.push(Event::Tick);
        self.drive();
    }

    fn happen(&mut self, key: (Nanos, u64), what: Occurrence) {
        if let Some(until) = self.held_back_until(&what) {
            self.occurrences.insert((until, key.1), what);
            return;
        }
        match what {
            Occurrence::AtMaster { worker, event, bytes, unpack_ns } => {
                self.arrive_at_master(worker, event, bytes, unpack_ns);
            }
            Occurrence::Inbox(event) => {
                self.inbox.push(event);
                self.drive();
            }
            Occurrence::DriverFree => {
                self.driver_busy = false;
                self.driver_awake = !self.inbox.is_empty();
                self.drive();
            }
            Occurrence::Chore(chore, left_ns) => self.continue_chore(chore, left_ns),
            Occurrence::Incident(incident) => self.follow(*incident),
            Occurrence::AtWorker(id, message) if self.workers.contains_key(&id) => {
                self.arrive_at_worker(id, *message);
            }
            Occurrence::BricksAtWorker { worker, set, order, bytes }
                if self.workers.contains_key(&worker) =>
            {
                self.bricks_arrive(worker, set, order, bytes);
            }
            Occurrence::Lease(id, lent) if self.workers.contains_key(&id) => {
                self.take_lease(id, lent);
                self.start_threads(id, None);
            }
            Occurrence::RunEnd { worker, thread, version }
                if self.workers.contains_key(&worker) =>
            {
                self.end_run(worker, thread, version);
            }
            // The worker is gone.
            _ => {}
        }
    }

    /// Until when a message is held back by a partition of its link.
    fn held_back_until(&self, what: &Occurrence) -> Option<Nanos> {
        let id = match what {
            Occurrence::AtMaster { worker, .. } | Occurrence::BricksAtWorker { worker, .. } => {
                worker
            }
            Occurrence::AtWorker(worker, _) => worker,
            _ => return None,
        };
        let until = self.workers.get(id)?.partitioned_until;
        (until > self.now_ns()).then_some(until)
    }
}
