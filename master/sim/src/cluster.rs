//! The virtual cluster: master, links and workers.

use super::pipe::{Cores, Pipe, through};
use super::{
    Cluster, Costs, FrameOutcome, Nanos, Outcome, Spent, Stopwatch, Took, Unknown, micros,
};
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{BrickId, Epoch, FrameId, TaskId, WorkerId};
use slabcast_common::image::{SparseTile, TilePixels};
use slabcast_common::link::{FINISHER_THREADS, stream_threads};
use slabcast_common::lookahead::Lookahead;
use slabcast_common::message::{
    Counters, Lease, Pixels, RegionCost, RegionLease, TaskTimes, TileResult, ToWorker,
};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::{PART_EDGE, parts};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::Projected;
use slabcast_schedule::{Action, Clock, Config, Event, FrameJob, Micros, Scheduler};
use slabcast_trace::{RegionProgress, RegionTile, Trace};
use std::borrow::Cow;
use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

mod pieces;

use pieces::state_bytes;

/// Bytes of a message that carries nothing large: head, ids, framing.
const SMALL: u64 = 64;
/// Bytes of a view, and of all other messages of a frame and worker.
const FRAME: u64 = 600;
/// Bytes of a batch of bricks, as over TCP.
const BATCH: u64 = 64 << 10;
/// Batches under way to one worker.
const BATCHES: usize = 2;

struct VirtualClock(Cell<Nanos>);

impl Clock for VirtualClock {
    fn now(&self) -> Micros {
        micros(self.0.get())
    }
}

/// What reaches somebody at a time.
#[expect(clippy::large_enum_variant, reason = "a frame's view, once a frame and worker")]
enum Coming {
    /// A message is at the master's end of the link: so many bytes, of which unpacking takes so many nanoseconds.
    AtMaster(WorkerId, Event, u64, f64),
    /// It is decoded and lies before the driver.
    Inbox(Event),
    /// The driver is free again.
    Free,
    /// A message is at a worker.
    AtWorker(WorkerId, ToWorker),
    /// A batch of bricks is at a worker.
    Batch(WorkerId, BrickSetKey, Vec<BrickId>, u64),
    /// A lease is decoded.
    Lease(WorkerId, Task),
    /// A tile has had its time, as long as that stayed as it was then.
    TaskEnd(WorkerId, usize, u64),
    /// Some of what is done with a picture is done, and so many nanoseconds of it are left.
    Chore(Chore, f64),
}

/// What is done with a picture whose tiles are there. It takes milliseconds, and what takes microseconds does not wait
/// for all of it: systems take turns, and a stream sends pieces.
#[derive(Clone, Copy)]
enum Chore {
    /// To hash and encode it.
    Finish(FrameId),
    /// To send it to the client.
    Send(FrameId),
    /// To receive it there, where all is on one machine.
    Receive,
}

/// How long of a chore is done in one go, in ns: three pieces of 64 KiB to send or to receive (TRANSPORT.md, answer 1). It is
/// short beside a tile, and a picture of 1024x1024 takes some hundred such turns of the simulation.
const TURN: f64 = 50_000.0;

/// What a worker was lent.
enum Task {
    Slab(Box<Lease>),
    Region(RegionLease),
}

impl Task {
    fn frame(&self) -> FrameId {
        match self {
            Task::Slab(l) => l.frame,
            Task::Region(l) => l.frame,
        }
    }

    fn name(&self) -> (TaskId, Epoch) {
        match self {
            Task::Slab(l) => (l.task, l.epoch),
            Task::Region(l) => (l.task, l.epoch),
        }
    }

    fn tile(&self) -> Rect {
        match self {
            Task::Slab(l) => l.tile,
            Task::Region(l) => l.tile,
        }
    }

    /// Its sheets; a region has all.
    fn sheets(&self) -> SheetRange {
        match self {
            Task::Slab(l) => l.slab,
            Task::Region(_) => SheetRange::new(i32::MIN, i32::MAX),
        }
    }
}

/// What a trace says of a task.
struct Known<'a> {
    /// Of a task of a slab; a region's time is its course's.
    ns: u64,
    lease_bytes: u64,
    /// Of finished pixels, packed and as they are. Sums weigh the first.
    result_bytes: [u64; 2],
    /// Of a region: with the places of the bricks that it is drawn from, and blocks whose bricks it looks at.
    region: Cow<'a, RegionTile>,
}

/// Whether the brick at a place is here; those that a set does not have are.
fn has(present: &[bool]) -> impl Fn(u32) -> bool {
    |place| present.get(place as usize) != Some(&false)
}

/// A thread that has nothing to draw.
#[derive(Clone, Copy, Default)]
struct Idle {
    since: Nanos,
    /// When the master was done with what it heard of its worker after that, and lent it nothing.
    heard: Option<Nanos>,
}

/// What a worker was lent, and how far that is.
struct Lent<'a> {
    task: Task,
    known: Known<'a>,
    /// Of a region.
    course: Option<RegionProgress>,
    received: Nanos,
    /// The order in which threads take what is there.
    order: u64,
    /// Whether what it will need was asked for, as far as frames before tell.
    expected: bool,
    /// How many sheets it looks ahead since it was taken.
    ahead: u32,
    /// Whether any has taken it.
    begun: bool,
    /// Since when it stands still, how often it did, and how long in all.
    stands: Option<Nanos>,
    stalls: u32,
    stood: Nanos,
    /// Places of the bricks that it waits for.
    waits: BTreeSet<u32>,
    /// How long it was drawn.
    drawn: Nanos,
    /// When its pixels are there at the earliest.
    pixels: Nanos,
}

struct Running<'a> {
    lent: Lent<'a>,
    start: Nanos,
    /// What of its time is not the tile itself: tables, and blocks.
    tables: Nanos,
    blocks: Nanos,
    /// Up to when its course was followed.
    followed: Nanos,
    /// What messages took of its core.
    stolen: Nanos,
    /// But for messages meanwhile.
    end: Nanos,
    /// Which end of it is the right one.
    ends: u64,
}

impl Running<'_> {
    /// It came as far as that.
    fn follow(&mut self, present: &[bool], now: Nanos, stretch: f64) {
        if let Some(course) = &mut self.lent.course {
            let went = now.saturating_sub(self.followed);
            course.advance(went as f64 / stretch, &has(present));
            self.followed += went;
        }
    }
}

struct Worker<'a> {
    down: Pipe,
    up: Pipe,
    /// Whether its results go as they are.
    plain: bool,
    /// What receives and sends.
    io: Cores,
    /// When what came last is read, what went last is written, and what the master heard last read.
    read: Nanos,
    wrote: Nanos,
    heard: Nanos,
    /// What that took of a core that a render thread had.
    stolen: Nanos,
    /// Whether it has a brick, by its place in the jobs' list of its set.
    present: BTreeMap<BrickSetKey, Vec<bool>>,
    leases: Vec<Lent<'a>>,
    /// Bricks that regions asked for.
    asked: BTreeSet<(BrickSetKey, BrickId)>,
    /// Parts of pictures that it drew: it knows how deep they are.
    drawn: BTreeSet<(BrickSetKey, i32, i32)>,
    /// How far its regions look ahead, and the first frame that it drew of each set.
    look: Lookahead,
    first: BTreeMap<BrickSetKey, FrameId>,
    running: Vec<Option<Running<'a>>>,
    idle: Vec<Idle>,
    /// When its tables of a frame are made.
    tables: BTreeMap<FrameId, Nanos>,
    /// Blocks of bricks that its tiles of a frame opened.
    opened: BTreeMap<FrameId, BTreeSet<u32>>,
    batches: VecDeque<(BrickSetKey, Vec<BrickId>, u64)>,
    under_way: usize,
}

struct World<'a> {
    cluster: &'a Cluster,
    trace: &'a Trace,
    jobs: &'a [FrameJob],
    clock: VirtualClock,
    scheduler: Scheduler,
    coming: BTreeMap<(Nanos, u64), Coming>,
    order: u64,
    workers: BTreeMap<WorkerId, Worker<'a>>,
    down: Pipe,
    up: Pipe,
    inbox: Vec<Event>,
    driver_busy: bool,
    driver_awake: bool,
    driver: Cores,
    streams: Cores,
    finisher: Cores,
    /// Where everything runs on one machine.
    machine: Option<Cores>,
    /// Shut pixels behind each slab of frames in hand.
    shut: BTreeMap<(usize, i32), Vec<bool>>,
    queued: usize,
    in_hand: u32,
    /// The frame at hand, and the slab that was begun last.
    at: usize,
    last_slab: Option<(FrameId, i32)>,
    /// Frames of which a region was lent.
    begun: BTreeSet<FrameId>,
    /// Frames that were begun under either schedule.
    frames_begun: u64,
    outcome: Outcome,
    /// When the first frame was delivered: from then on time is accounted for.
    watched: Option<Nanos>,
    closed: bool,
    /// Pieces by the corners of their tiles.
    pieces: BTreeMap<(FrameId, [i32; 4]), RegionProgress>,
    /// When the driver lent what has not begun yet.
    decided: BTreeMap<(WorkerId, TaskId, Epoch), Nanos>,
    finished: usize,
    worker_work: Nanos,
}

/// Runs a path's frames, one after another, on a cluster. `jobs` are the frames of the trace in its
/// order, with frame ids from 1 and numbers from 0. `watch` measures the scheduler itself.
///
/// # Errors
/// [`Unknown`]: the scheduler wants what the trace does not know.
///
/// # Panics
/// If frame ids are others.
pub fn run(
    jobs: &[FrameJob],
    trace: &Trace,
    cluster: &Cluster,
    watch: &mut dyn Stopwatch,
) -> Result<(Outcome, Took), Unknown> {
    if jobs.len() != trace.frames.len() {
        return Err(Unknown::Frames { have: trace.frames.len(), need: jobs.len() });
    }
    for (i, job) in jobs.iter().enumerate() {
        assert_eq!((job.frame.0, job.number), (i as u64 + 1, i as u64), "frames in order");
    }
    let bandwidth = cluster.link.bytes_per_s;
    let mut w = World {
        cluster,
        trace,
        jobs,
        clock: VirtualClock(Cell::new(1_000_000)),
        scheduler: Scheduler::new(Config { mixed: cluster.mixed, ..Config::default() }),
        coming: BTreeMap::new(),
        order: 0,
        workers: BTreeMap::new(),
        down: Pipe::new(bandwidth),
        up: Pipe::new(bandwidth),
        inbox: Vec::new(),
        driver_busy: false,
        driver_awake: false,
        driver: Cores::new(1),
        streams: Cores::new(stream_threads(cluster.cores.unwrap_or(u32::MAX)) as u32),
        finisher: Cores::new(FINISHER_THREADS as u32),
        machine: cluster.cores.map(Cores::new),
        shut: BTreeMap::new(),
        queued: 0,
        in_hand: 0,
        at: 0,
        last_slab: None,
        begun: BTreeSet::new(),
        frames_begun: 0,
        outcome: Outcome {
            frames: vec![FrameOutcome::default(); jobs.len()],
            ..Outcome::default()
        },
        watched: None,
        closed: false,
        pieces: BTreeMap::new(),
        decided: BTreeMap::new(),
        finished: 0,
        worker_work: 0,
    };
    let mut took = Took::default();
    let present: BTreeMap<BrickSetKey, Vec<bool>> =
        jobs.iter().map(|j| (j.scene.bricks, vec![false; j.bricks.len()])).collect();
    for id in 1..=u64::from(cluster.workers) {
        let worker = Worker {
            down: Pipe::new(bandwidth),
            up: Pipe::new(bandwidth),
            plain: false,
            io: Cores::new(1),
            read: 0,
            wrote: 0,
            heard: 0,
            stolen: 0,
            present: present.clone(),
            leases: Vec::new(),
            asked: BTreeSet::new(),
            drawn: BTreeSet::new(),
            look: Lookahead::default(),
            first: BTreeMap::new(),
            running: (0..cluster.threads).map(|_| None).collect(),
            idle: vec![Idle::default(); cluster.threads as usize],
            tables: BTreeMap::new(),
            opened: BTreeMap::new(),
            batches: VecDeque::new(),
            under_way: 0,
        };
        w.workers.insert(WorkerId(id), worker);
        w.inbox.push(Event::WorkerJoined {
            worker: WorkerId(id),
            name: format!("w{id}"),
            threads: cluster.threads,
            is_local: false,
            memory_budget_bytes: u64::MAX,
            held: Vec::new(),
        });
    }
    w.feed();
    w.drive(&mut took, watch)?;
    while w.finished < jobs.len() {
        let next = w.coming.first_key_value().map(|(k, _)| k.0);
        let due = w.scheduler.next_deadline().map(|d| d * 1000);
        match (next, due) {
            (Some(t), Some(d)) if d < t && !w.driver_busy => {
                w.clock.0.set(d.max(w.now()));
                w.inbox.push(Event::Tick);
                w.drive(&mut took, watch)?;
            }
            (Some(_), _) => {
                let ((t, _), what) = w.coming.pop_first().expect("just seen");
                w.clock.0.set(t.max(w.now()));
                w.happen(what, &mut took, watch)?;
            }
            (None, Some(d)) => {
                w.clock.0.set(d.max(w.now()));
                w.inbox.push(Event::Tick);
                w.drive(&mut took, watch)?;
            }
            (None, None) => unreachable!("workers are pinged as long as they are there"),
        }
    }
    w.close();
    w.outcome.driver = w.driver.work;
    w.outcome.streams = w.streams.work;
    w.outcome.finisher = w.finisher.work;
    w.outcome.workers = w.worker_work;
    Ok((w.outcome, took))
}

impl<'a> World<'a> {
    fn now(&self) -> Nanos {
        self.clock.0.get()
    }

    fn later(&mut self, when: Nanos, what: Coming) {
        self.order += 1;
        self.coming.insert((when.max(self.now()), self.order), what);
    }

    /// A stretch of a render thread's time is over.
    fn spend(&mut self, from: Nanos, to: Nanos, what: fn(&mut Spent) -> &mut Nanos) {
        let Some(watched) = self.watched.filter(|_| !self.closed) else { return };
        *what(&mut self.outcome.spent) += to.saturating_sub(from.max(watched));
    }

    /// A thread was idle until now, and what it begins was `decided` upon then; bricks have been lacking since
    /// `lacking`. `None`: the path ends.
    fn was_idle(&mut self, idle: Idle, decided: Option<Nanos>, lacking: Option<Nanos>, now: Nanos) {
        let Idle { since, heard } = idle;
        let stood = lacking.unwrap_or(now).clamp(since, now);
        self.spend(stood, now, |s| &mut s.bricks);
        let decided = decided.unwrap_or(now).clamp(since, stood);
        let heard = heard.unwrap_or(decided).clamp(since, decided);
        let ends = self.begun.len() == self.jobs.len();
        self.spend(since, heard, |s| &mut s.way);
        if ends {
            self.spend(heard, decided, |s| &mut s.tail);
        } else {
            self.spend(heard, decided, |s| &mut s.dry);
        }
        self.spend(decided, stood, |s| &mut s.way);
    }

    /// Time is no longer accounted for.
    fn close(&mut self) {
        let now = self.now();
        if self.closed {
            return;
        }
        let ids: Vec<WorkerId> = self.workers.keys().copied().collect();
        for id in ids {
            for thread in 0..self.cluster.threads as usize {
                let w = &self.workers[&id];
                match &w.running[thread] {
                    // What nobody waits for.
                    Some(r) => self.spend(r.start, now, |s| &mut s.tiles),
                    None => self.was_idle(w.idle[thread], None, None, now),
                }
            }
        }
        self.closed = true;
        let work = [self.driver.work, self.streams.work];
        self.outcome.steady = std::array::from_fn(|i| work[i] - self.outcome.first[i]);
    }

    /// Gives the scheduler frames while there is room for them.
    fn feed(&mut self) {
        while self.in_hand < self.cluster.in_flight.max(1) && self.queued < self.jobs.len() {
            self.inbox.push(Event::FrameQueued(Box::new(self.jobs[self.queued].clone())));
            if self.in_hand == 0 {
                self.outcome.frames[self.queued].began = self.now();
            }
            self.queued += 1;
            self.in_hand += 1;
        }
    }

    /// Work of a thread of the master.
    fn master(&mut self, which: fn(&mut Self) -> &mut Cores, at: Nanos, ns: f64) -> Nanos {
        self.awake(which, at, (ns, self.cluster.costs.master.woken))
    }

    /// Work of a thread of the master, which takes so long to wake if it slept.
    fn awake(
        &mut self,
        which: fn(&mut Self) -> &mut Cores,
        at: Nanos,
        (ns, woken): (f64, f64),
    ) -> Nanos {
        let (alone, took) = which(self).take(at, ns, woken);
        self.machine.as_mut().map_or(alone, |m| m.run(at, took).max(alone))
    }

    /// Pixels of a frame's picture.
    fn pixels(&self, frame: FrameId) -> f64 {
        let [wide, high] = self.jobs[frame.0 as usize - 1].view.size;
        f64::from(wide) * f64::from(high)
    }

    /// Does some of a chore of which so many nanoseconds are left. Nobody has time that is still to come set aside for
    /// him: whatever comes first is done first.
    fn do_some(&mut self, at: Nanos, chore: Chore, left: f64, woken: f64) {
        // A thread finishes one picture after the other; only where it has no core for itself others come between.
        let whole = matches!(chore, Chore::Finish(_)) && self.machine.is_none();
        let ns = if whole { left } else { left.min(TURN) };
        let done = match chore {
            Chore::Finish(_) => self.awake(|w| &mut w.finisher, at, (ns, woken)),
            Chore::Send(_) => self.awake(|w| &mut w.streams, at, (ns, woken)),
            Chore::Receive => self.machine.as_mut().map_or(at, |machine| machine.run(at, ns)),
        };
        self.later(done, Coming::Chore(chore, left - ns));
    }

    /// Goes on with a chore, or with what comes after it.
    fn go_on(
        &mut self,
        chore: Chore,
        left: f64,
        took: &mut Took,
        watch: &mut dyn Stopwatch,
    ) -> Result<(), Unknown> {
        let now = self.now();
        if left > 0.0 {
            self.do_some(now, chore, left, 0.0);
            return Ok(());
        }
        let [out, client] = self.cluster.costs.deliver;
        match chore {
            Chore::Finish(frame) => {
                let ns = out * self.pixels(frame);
                self.do_some(now, Chore::Send(frame), ns, self.cluster.costs.master.woken);
                self.finished(frame, took, watch)?;
            }
            Chore::Send(frame) if self.machine.is_some() => {
                self.do_some(now, Chore::Receive, client * self.pixels(frame), 0.0);
            }
            Chore::Send(_) | Chore::Receive => {}
        }
        Ok(())
    }

    /// A frame is hashed and encoded.
    fn finished(
        &mut self,
        frame: FrameId,
        took: &mut Took,
        watch: &mut dyn Stopwatch,
    ) -> Result<(), Unknown> {
        let now = self.now();
        self.outcome.frames[frame.0 as usize - 1].delivered = now;
        self.finished += 1;
        if self.finished == 1 {
            self.watched = Some(now);
            let (driver, streams) = (self.driver.work, self.streams.work);
            self.outcome.first = [driver, streams, self.finisher.work, self.worker_work];
        }
        // Frames may end in another order; those before are delivered all the same.
        let steady = Outcome::steady(self.jobs.len(), self.cluster.in_flight);
        if self.finished == steady + 1 {
            self.close();
        }
        self.in_hand -= 1;
        self.feed();
        self.drive(took, watch)
    }

    /// Work of the driver, which looks at what lies before it when that is done: when it is.
    fn driver_works(&mut self, at: Nanos, ns: f64) -> Nanos {
        let alone = self.driver.run(at, ns);
        let end = self.machine.as_mut().map_or(alone, |m| m.run(at, ns).max(alone));
        self.driver_busy = true;
        self.later(end, Coming::Free);
        end
    }

    /// Work of a worker beside rendering.
    fn worker(&mut self, id: WorkerId, at: Nanos, ns: f64) -> Nanos {
        let w = self.workers.get_mut(&id).expect("a worker that works is there");
        let (alone, ns) = w.io.take(at, ns, self.cluster.costs.worker.woken);
        self.worker_work += ns as Nanos;
        match &mut self.machine {
            Some(machine) => machine.run(at, ns).max(alone),
            None => {
                if w.running.iter().any(Option::is_some) {
                    w.stolen += ns as Nanos;
                }
                alone
            }
        }
    }

    /// A worker's message goes up. What is there before the one before is written goes along with it.
    fn up(&mut self, id: WorkerId, event: Event, bytes: u64, at: Nanos) {
        self.up_packed(id, event, (bytes, 0), at);
    }

    /// The same of so many bytes that so many were packed into; none, if they go as they are.
    fn up_packed(&mut self, id: WorkerId, event: Event, (bytes, of): (u64, u64), at: Nanos) {
        let Costs { worker: toll, pack, unpack, .. } = &self.cluster.costs;
        let call = if at <= self.workers[&id].wrote { 0.0 } else { toll.call };
        let ns = call + toll.send.0 + toll.send.1 * bytes as f64 + pack * of as f64;
        let at = self.worker(id, at, ns);
        let w = self.workers.get_mut(&id).expect("a worker that speaks is there");
        w.wrote = at;
        let there = through(&mut w.up, &mut self.up, at, bytes);
        self.outcome.frames[self.at].up += bytes;
        self.outcome.frames[self.at].messages_up += 1;
        let coming = Coming::AtMaster(id, event, bytes, unpack * of as f64);
        self.later(there + self.cluster.link.latency_ns, coming);
    }

    /// The master's message goes down, when the driver is done with it. Of those that leave together to
    /// one worker only the first pays the call.
    fn down(&mut self, id: WorkerId, message: ToWorker, bytes: u64, at: Nanos, first: bool) {
        let toll = &self.cluster.costs.master;
        let call = if first { toll.call } else { 0.0 };
        let ns = call + toll.send.0 + toll.send.1 * bytes as f64;
        let at = self.master(|w| &mut w.streams, at, ns);
        let Some(w) = self.workers.get_mut(&id) else { return };
        let there = through(&mut self.down, &mut w.down, at, bytes);
        self.outcome.frames[self.at].down += bytes;
        self.outcome.frames[self.at].messages_down += 1;
        self.outcome.frames[self.at].writes_down += u64::from(first);
        self.later(there + self.cluster.link.latency_ns, Coming::AtWorker(id, message));
    }

    /// A worker has read a message.
    fn read(&mut self, id: WorkerId, bytes: u64) -> Nanos {
        let (now, toll) = (self.now(), &self.cluster.costs.worker);
        let call = if now <= self.workers[&id].read { 0.0 } else { toll.call };
        let at = self.worker(id, now, call + toll.receive.0 + toll.receive.1 * bytes as f64);
        self.workers.get_mut(&id).expect("a worker stays").read = at;
        at
    }

    /// Batches of bricks go while there is room on the way.
    fn batches(&mut self, id: WorkerId, at: Nanos) {
        loop {
            let w = self.workers.get_mut(&id).expect("a worker that gets bricks is there");
            if w.under_way == BATCHES {
                return;
            }
            let Some((set, bricks, bytes)) = w.batches.pop_front() else { return };
            w.under_way += 1;
            let toll = &self.cluster.costs.master;
            let ns = toll.call + toll.bricks.0 + toll.bricks.1 * bytes as f64;
            let at = self.master(|w| &mut w.streams, at, ns);
            let w = self.workers.get_mut(&id).expect("as before");
            let there = through(&mut self.down, &mut w.down, at, bytes);
            self.outcome.frames[self.at].bricks += bytes;
            let when = there + self.cluster.link.latency_ns;
            self.later(when, Coming::Batch(id, set, bricks, bytes));
        }
    }

    fn happen(
        &mut self,
        what: Coming,
        took: &mut Took,
        watch: &mut dyn Stopwatch,
    ) -> Result<(), Unknown> {
        let now = self.now();
        match what {
            Coming::AtMaster(id, event, bytes, unpacking) => {
                let toll = &self.cluster.costs.master;
                let call = if now <= self.workers[&id].heard { 0.0 } else { toll.call };
                let ns = call + toll.receive.0 + toll.receive.1 * bytes as f64 + unpacking;
                let at = self.master(|w| &mut w.streams, now, ns);
                // A stream keeps its order, whichever thread reads it.
                let heard = &mut self.workers.get_mut(&id).expect("a worker stays").heard;
                let at = at.max(*heard);
                *heard = at;
                self.later(at, Coming::Inbox(event));
            }
            Coming::Inbox(event) => {
                self.inbox.push(event);
                self.drive(took, watch)?;
            }
            Coming::Free => {
                self.driver_busy = false;
                self.driver_awake = !self.inbox.is_empty();
                self.drive(took, watch)?;
            }
            Coming::AtWorker(id, message) => self.told(id, message)?,
            Coming::Batch(id, set, bricks, bytes) => {
                let toll = &self.cluster.costs.worker;
                let ns = toll.call + toll.bricks.0 + toll.bricks.1 * bytes as f64;
                let at = self.worker(id, now, ns);
                let w = self.workers.get_mut(&id).expect("a worker stays");
                w.under_way -= 1;
                let count = bricks.len() as u32;
                for &b in &bricks {
                    w.asked.remove(&(set, b));
                }
                self.have(id, set, &bricks, true);
                self.batches(id, now);
                self.up(id, Event::BricksIn { worker: id, set, bricks: count }, SMALL, at);
                self.begin(id, None)?;
            }
            Coming::Lease(id, lease) => {
                self.lent(id, lease)?;
                self.begin(id, None)?;
            }
            Coming::TaskEnd(id, thread, ends) => {
                let w = self.workers.get_mut(&id).expect("a worker stays");
                if w.running[thread].as_ref().is_none_or(|r| r.ends != ends) {
                    return Ok(());
                }
                let stolen = std::mem::take(&mut w.stolen);
                if stolen > 0 {
                    if let Some(r) = &mut w.running[thread] {
                        (r.followed, r.end) = (r.followed + stolen, now + stolen);
                        r.stolen += stolen;
                    }
                    self.spend(now, now + stolen, |s| &mut s.messages);
                    self.later(now + stolen, Coming::TaskEnd(id, thread, ends));
                    return Ok(());
                }
                let ended = self.stop(id, thread);
                self.begin(id, Some(thread))?;
                // What sending it takes is taken from what the thread draws next.
                if let Some(lent) = ended {
                    self.end_task(id, thread, lent);
                }
            }
            Coming::Chore(chore, left) => self.go_on(chore, left, took, watch)?,
        }
        Ok(())
    }

    fn told(&mut self, id: WorkerId, message: ToWorker) -> Result<(), Unknown> {
        match message {
            ToWorker::Lease(lease) => {
                let task = Task::Slab(lease);
                let bytes = self.known(&task)?.lease_bytes;
                let at = self.read(id, bytes);
                self.later(at, Coming::Lease(id, task));
            }
            ToWorker::Region(lease) => {
                let bytes = SMALL + lease.begun.as_ref().map_or(0, |b| state_bytes(&b.pixels));
                let at = self.read(id, bytes);
                self.later(at, Coming::Lease(id, Task::Region(lease)));
            }
            ToWorker::SplitRegion { task, epoch, share, .. } => {
                let at = self.read(id, SMALL);
                self.hand_over(id, (task, epoch), f64::from(share) / 1000.0, at);
                self.begin(id, None)?;
            }
            ToWorker::EndFrame { frame } => {
                self.read(id, SMALL);
                let w = self.workers.get_mut(&id).expect("a worker stays");
                w.leases.retain(|l| l.task.frame() != frame);
                w.tables.remove(&frame);
                w.opened.remove(&frame);
            }
            ToWorker::Ping { nonce } => {
                let at = self.read(id, SMALL);
                let pong = Event::Pong { worker: id, nonce, clock_us: micros(at) };
                self.up(id, pong, SMALL, at);
            }
            ToWorker::DropBricks { set, bricks } => {
                self.have(id, set, &bricks, false);
            }
            ToWorker::Frame { plain, .. } => {
                self.read(id, FRAME);
                self.workers.get_mut(&id).expect("a worker stays").plain = plain;
            }
            _ => {
                self.read(id, FRAME);
            }
        }
        Ok(())
    }

    /// What is known of a task.
    fn known(&self, task: &Task) -> Result<Known<'a>, Unknown> {
        let frame = task.frame().0 as usize - 1;
        let trace: &'a Trace = self.trace;
        let (size, traced) = (trace.about.size, &trace.frames[frame]);
        let known = match task {
            Task::Slab(l) => {
                let slab = traced.slab(l.slab);
                slab.and_then(|s| s.tile(&l.tile, size)).map(|t| Known {
                    ns: t.ns,
                    lease_bytes: t.lease_bytes.into(),
                    result_bytes: [t.result_bytes.into(); 2],
                    region: Cow::Owned(RegionTile::default()),
                })
            }
            Task::Region(l) if l.begun.is_some() => {
                self.piece_of(l.frame, &l.tile).map(|piece| Known {
                    ns: 0,
                    lease_bytes: SMALL,
                    result_bytes: [SMALL + 3 * l.tile.area() as u64; 2],
                    region: Cow::Owned(RegionTile {
                        touched: piece.upcoming(),
                        ..RegionTile::default()
                    }),
                })
            }
            Task::Region(l) => self.whole_region(l.tile, frame).map(|region| {
                // A bit or so for each touched brick, and the cost's other figures.
                let beside = 20 + region.touched.len() as u64;
                let result_bytes =
                    [false, true].map(|plain| u64::from(region.wire_bytes(plain)) + beside);
                Known { ns: region.ns, lease_bytes: SMALL, result_bytes, region }
            }),
        };
        known.ok_or_else(|| {
            let SheetRange { first, end } = task.sheets();
            Unknown::Tile { frame, tile: task.tile(), first, end }
        })
    }

    /// A worker has these bricks from now on, or has them no longer.
    fn have(&mut self, id: WorkerId, set: BrickSetKey, bricks: &[BrickId], there: bool) {
        let Some(job) = self.jobs.iter().find(|j| j.scene.bricks == set) else { return };
        let (stretch, now) = (self.cluster.stretch, self.now());
        let w = self.workers.get_mut(&id).expect("a worker stays");
        // As far as they came without these.
        let regions = w.running.iter_mut().flatten();
        let of_set =
            |task: &Task, jobs: &[FrameJob]| jobs[task.frame().0 as usize - 1].scene.bricks == set;
        let mut running: Vec<&mut Running<'_>> =
            regions.filter(|r| of_set(&r.lent.task, self.jobs)).collect();
        let present = w.present.get_mut(&set).expect("a set of a job");
        running.iter_mut().for_each(|r| r.follow(present, now, stretch));
        for brick in bricks {
            if let Ok(place) = job.bricks.binary_search_by_key(brick, |b| b.id) {
                present[place] = there;
                if there {
                    let waiting = w.leases.iter_mut().filter(|l| of_set(&l.task, self.jobs));
                    for lent in waiting {
                        lent.waits.remove(&(place as u32));
                    }
                }
            }
        }
        let threads = 0..self.cluster.threads as usize;
        threads.for_each(|thread| self.goes_until(id, thread));
    }

    /// A region that is drawn goes so far with the bricks that are here now.
    fn goes_until(&mut self, id: WorkerId, thread: usize) {
        self.order += 1;
        let (ends, stretch) = (self.order, self.cluster.stretch);
        let w = self.workers.get_mut(&id).expect("a worker stays");
        let Some(r) = &mut w.running[thread] else { return };
        let Some(course) = &r.lent.course else { return };
        let set = self.jobs[r.lent.task.frame().0 as usize - 1].scene.bricks;
        let goes = course.runs_ns(&has(&w.present[&set]));
        let end = r.followed + (goes * stretch).round() as Nanos;
        if end != r.end {
            (r.end, r.ends) = (end, ends);
            self.later(end, Coming::TaskEnd(id, thread, ends));
        }
    }

    /// What a frame sees of a brick.
    fn sees(&self, frame: FrameId) -> impl Fn(u32) -> Option<Projected> + use<'a> {
        let jobs: &'a [FrameJob] = self.jobs;
        let job = &jobs[frame.0 as usize - 1];
        |place| job.view.project(&job.bricks.get(place as usize)?.tight)
    }

    /// A worker is lent a task.
    fn lent(&mut self, id: WorkerId, task: Task) -> Result<(), Unknown> {
        let known = self.known(&task)?;
        let frame = task.frame();
        let course = match &task {
            Task::Slab(_) => None,
            Task::Region(l) if l.begun.is_some() => self.piece_of(frame, &l.tile),
            Task::Region(l) => {
                let traced = &self.trace.frames[frame.0 as usize - 1];
                RegionProgress::new(traced, &l.tile, self.trace.about.size, &self.sees(frame))
            }
        };
        self.order += 1;
        let lent = Lent {
            task,
            known,
            course,
            received: self.now(),
            order: self.order,
            expected: false,
            ahead: 0,
            begun: false,
            stands: None,
            stalls: 0,
            stood: 0,
            waits: BTreeSet::new(),
            drawn: 0,
            pixels: 0,
        };
        self.workers.get_mut(&id).expect("a worker stays").leases.push(lent);
        Ok(())
    }

    /// What a thread takes next: of the oldest frame, what goes on before what begins, as `worker::pool`. A region that
    /// stands before its first sheet asks for what it lacks there, and the next one is looked at.
    fn take(&mut self, id: WorkerId) -> Option<Lent<'a>> {
        let now = self.now();
        self.expect(id);
        loop {
            let w = &self.workers[&id];
            let set_of = |task: &Task| self.jobs[task.frame().0 as usize - 1].scene.bricks;
            let is_there = |l: &Lent<'_>| match &l.task {
                Task::Slab(lease) => {
                    let all = &self.jobs[lease.frame.0 as usize - 1].bricks;
                    let place = |b: &BrickId| all.binary_search_by_key(b, |b| b.id).ok();
                    let present = &w.present[&set_of(&l.task)];
                    lease.bricks.iter().all(|b| place(b).is_some_and(|i| present[i]))
                }
                Task::Region(_) => l.waits.is_empty(),
            };
            let there = (0..w.leases.len()).filter(|&i| is_there(&w.leases[i]));
            let at = there.min_by_key(|&i| {
                let l = &w.leases[i];
                (l.task.frame(), !l.begun && l.stalls == 0, l.order)
            })?;
            let set = set_of(&w.leases[at].task);
            let w = self.workers.get_mut(&id).expect("a worker stays");
            let mut lent = w.leases.remove(at);
            let frame = lent.task.frame();
            let first = *w.first.entry(set).or_insert(frame) == frame;
            lent.ahead = w.look.sheets(now, self.cluster.threads, lent.stalls, first);
            if let Some(course) = &mut lent.course {
                course.resume();
                let present = &w.present[&set];
                if !course.is_done() && course.runs_ns(&has(present)) <= 0.0 {
                    self.park(id, lent);
                    continue;
                }
            }
            if let Some(since) = lent.stands.take() {
                lent.stood += now - since;
            }
            return Some(lent);
        }
    }

    /// A thread asks for what regions will need that nobody has begun, as far as those of frames before tell, which were
    /// drawn here (`worker::pool`).
    fn expect(&mut self, id: WorkerId) {
        let w = self.workers.get_mut(&id).expect("a worker stays");
        let mut wishes: BTreeMap<BrickSetKey, Vec<BrickId>> = BTreeMap::new();
        for lent in w.leases.iter_mut().filter(|l| !l.expected) {
            lent.expected = true;
            let Task::Region(lease) = &lent.task else { continue };
            let job = &self.jobs[lease.frame.0 as usize - 1];
            let set = job.scene.bricks;
            if !parts(lease.tile)
                .all(|p| w.drawn.contains(&(set, p.x0 / PART_EDGE, p.y0 / PART_EDGE)))
            {
                continue;
            }
            let here = has(&w.present[&set]);
            let lacks = lent.known.region.expected.iter().filter(|place| !here(**place));
            let ids = lacks.filter_map(|place| Some(job.bricks.get(*place as usize)?.id));
            let asked = &mut w.asked;
            wishes.entry(set).or_default().extend(ids.filter(|id| asked.insert((set, *id))));
        }
        wishes.into_iter().for_each(|(set, bricks)| self.wish(id, set, bricks));
    }

    /// A worker asks for bricks, if there are any to ask for.
    fn wish(&mut self, id: WorkerId, set: BrickSetKey, bricks: Vec<BrickId>) {
        if !bricks.is_empty() {
            let bytes = SMALL + 2 * bricks.len() as u64;
            self.up(id, Event::BricksWanted { worker: id, set, bricks }, bytes, self.now());
        }
    }

    /// A region asks for what it lacks, and stands still.
    fn park(&mut self, id: WorkerId, mut lent: Lent<'a>) {
        let now = self.now();
        let job = &self.jobs[lent.task.frame().0 as usize - 1];
        let set = job.scene.bricks;
        let sees = self.sees(lent.task.frame());
        let w = self.workers.get_mut(&id).expect("a worker stays");
        let lacks = match &lent.course {
            Some(course) => course.missing(&has(&w.present[&set]), lent.ahead, &sees),
            None => Vec::new(),
        };
        let ids = lacks.iter().map(|&place| job.bricks[place as usize].id);
        let bricks: Vec<BrickId> = ids.filter(|b| w.asked.insert((set, *b))).collect();
        lent.stalls += 1;
        lent.stands = lent.stands.or(Some(now));
        lent.waits.extend(lacks);
        self.order += 1;
        lent.order = self.order;
        w.leases.push(lent);
        self.wish(id, set, bricks);
    }

    /// Free threads begin leases whose bricks are there. One of them is `awake`: it has just ended another.
    fn begin(&mut self, id: WorkerId, mut awake: Option<usize>) -> Result<(), Unknown> {
        let woken = self.cluster.costs.worker.woken;
        loop {
            let w = self.workers.get_mut(&id).expect("a worker stays");
            let free = awake.or_else(|| w.running.iter().position(Option::is_none));
            let Some(thread) = free else { return Ok(()) };
            let lacking = w.leases.iter().filter_map(|l| l.stands).min();
            let Some(mut lent) = self.take(id) else { return Ok(()) };
            let mut now = self.now();
            let (task, epoch) = lent.task.name();
            let idle = self.workers[&id].idle[thread];
            let decided = self.decided.remove(&(id, task, epoch));
            if awake.take().is_none() {
                let at = now + woken as Nanos;
                now = self.machine.as_mut().map_or(at, |m| m.run(now, woken));
                self.worker_work += woken as Nanos;
                self.was_idle(idle, decided, lacking, self.now());
                let came = self.now();
                let waited = came - lacking.unwrap_or(came).clamp(idle.since, came);
                self.workers.get_mut(&id).expect("a worker stays").look.add_idle_ns(waited);
                self.spend(self.now(), now, |s| &mut s.way);
            }
            let frame = lent.task.frame();
            let traced = &self.trace.frames[frame.0 as usize - 1];
            let mut setup = traced.setup_ns;
            if matches!(lent.task, Task::Region(_)) {
                setup += traced.outlook_ns;
            }
            let stretch = self.cluster.stretch;
            let w = self.workers.get_mut(&id).expect("a worker stays");
            let mut blocks = 0;
            if !lent.begun {
                // Its threads share what they looked at.
                let known_of = w.opened.entry(frame).or_default();
                let opened = &lent.known.region.opened;
                let fresh = opened.iter().filter(|b| known_of.insert(**b)).count();
                blocks = (traced.block_ns.saturating_mul(fresh as u64) as f64 * stretch) as Nanos;
            }
            // The first tile of a frame makes its tables; others wait for them.
            let made = *w.tables.entry(frame).or_insert(now + (setup as f64 * stretch) as Nanos);
            let tables = made.saturating_sub(now);
            let begins = !std::mem::replace(&mut lent.begun, true);
            let from = now + tables + blocks;
            let set = self.jobs[frame.0 as usize - 1].scene.bricks;
            let ns = match &lent.course {
                Some(course) => course.runs_ns(&has(&w.present[&set])),
                None => lent.known.ns as f64,
            };
            let end = from + (ns * stretch).round() as Nanos;
            if begins && let Some(machine) = &mut self.machine {
                let (fixed, pixel) = self.cluster.costs.hold;
                let ns = fixed + pixel * lent.task.tile().area() as f64;
                self.worker_work += ns as Nanos;
                lent.pixels = machine.run(now, ns);
            }
            self.order += 1;
            let ends = self.order;
            let running =
                Running { lent, start: now, tables, blocks, followed: from, stolen: 0, end, ends };
            w.running[thread] = Some(running);
            self.later(end, Coming::TaskEnd(id, thread, ends));
        }
    }

    /// A thread is at a task's end, or where it lacks bricks. What has ended.
    fn stop(&mut self, id: WorkerId, thread: usize) -> Option<Lent<'a>> {
        let now = self.now();
        let w = self.workers.get_mut(&id).expect("a worker stays");
        let r = w.running[thread].take().expect("a task that ends has begun");
        w.idle[thread] = Idle { since: now, heard: None };
        let (tables, blocks) = (r.start + r.tables, r.start + r.tables + r.blocks);
        self.spend(r.start, tables, |s| &mut s.tables);
        self.spend(tables, blocks, |s| &mut s.blocks);
        let drawn = now - r.stolen;
        self.spend(blocks, drawn, |s| &mut s.tiles);
        let mut lent = r.lent;
        lent.drawn += now - r.start;
        let frame = lent.task.frame();
        self.outcome.frames[frame.0 as usize - 1].render += drawn - r.start;
        if let Some(course) = &mut lent.course {
            let set = self.jobs[frame.0 as usize - 1].scene.bricks;
            let present = &self.workers[&id].present[&set];
            course.advance(f64::INFINITY, &has(present));
            if !course.is_done() {
                self.park(id, lent);
                return None;
            }
        }
        if let Task::Region(lease) = &lent.task {
            let set = self.jobs[frame.0 as usize - 1].scene.bricks;
            let w = self.workers.get_mut(&id).expect("a worker stays");
            w.drawn.extend(parts(lease.tile).map(|p| (set, p.x0 / PART_EDGE, p.y0 / PART_EDGE)));
        }
        Some(lent)
    }

    fn end_task(&mut self, id: WorkerId, thread: usize, lent: Lent<'a>) {
        let now = self.now();
        let (tile, frame) = (lent.task.tile(), lent.task.frame().0 as usize - 1);
        let size = self.trace.about.size;
        let mut a = Vec::with_capacity(tile.area());
        let mut region = None;
        let Known { result_bytes, region: traced, .. } = lent.known;
        match &lent.task {
            Task::Slab(l) => {
                let shut = self.shut.entry((frame, l.slab.first)).or_insert_with(|| {
                    self.trace.frames[frame].slab(l.slab).map_or_else(Vec::new, |s| s.shut(size))
                });
                for y in tile.y0..tile.y1 {
                    let row = y as usize * size[0] as usize;
                    let row = &shut[row + tile.x0 as usize..row + tile.x1 as usize];
                    a.extend(row.iter().map(|&s| f32::from(u8::from(s))));
                }
            }
            Task::Region(_) => {
                if self.jobs[frame].finish.is_none() {
                    a.resize(tile.area(), 0.0);
                }
                region = Some(RegionCost {
                    touched: traced.into_owned().touched,
                    stalls: lent.stalls,
                    parked_us: micros(lent.stood),
                    ..RegionCost::default()
                });
            }
        }
        let (task, epoch) = lent.task.name();
        // Bytes that it weighs, and how many are packed into them.
        let [packed, plain] = result_bytes;
        let mut weight = (packed, 0);
        let pixels = match (&lent.task, self.jobs[frame].finish) {
            (Task::Region(_), Some(finish)) => {
                weight = if self.workers[&id].plain { (plain, 0) } else { (packed, plain) };
                let size = [tile.width() as u32, tile.height() as u32];
                Pixels::Finished(SparseTile::blank(size, finish.format))
            }
            _ => Pixels::Sums(TilePixels { a, colour: vec![[0; 3]; tile.area()], last: None }),
        };
        let late = self.machine.as_ref().map_or(0, |_| self.cluster.costs.late as Nanos);
        let result = Box::new(TileResult {
            task,
            epoch,
            pixels,
            counters: Counters::default(),
            times: TaskTimes {
                received_us: micros(lent.received),
                ready_us: micros(lent.received + lent.stood),
                start_us: micros(now - lent.drawn),
                end_us: micros(now),
                thread: thread as u32,
            },
            region,
            bytes: Some(weight.0.min(u64::from(u32::MAX)) as u32),
        });
        let event = Event::Result { worker: id, result };
        self.up_packed(id, event, weight, lent.pixels.max(now + late));
    }

    /// The driver: everything that lies before it, then the wishes.
    fn drive(&mut self, took: &mut Took, watch: &mut dyn Stopwatch) -> Result<(), Unknown> {
        if self.driver_busy || self.inbox.is_empty() {
            return Ok(());
        }
        let now = self.now();
        let costs = self.cluster.costs;
        if !std::mem::replace(&mut self.driver_awake, true) {
            // What comes while it wakes is handled along with what woke it.
            self.driver_works(now, costs.driver_woken);
            return Ok(());
        }
        let mut cost = 0.0;
        let mut actions = Vec::new();
        let mut heard = BTreeSet::new();
        for event in std::mem::take(&mut self.inbox) {
            cost += costs.driver_message;
            let result = match &event {
                Event::Result { result, .. } => Some(result.pixels.len()),
                _ => None,
            };
            let ahead = matches!(event, Event::Tick) && self.scheduler.prefetch_is_due();
            cost += match result {
                Some(pixels) => costs.result + costs.result_pixel * pixels as f64,
                None if ahead => costs.ahead,
                None => costs.event,
            };
            if let Event::Result { worker, .. } = &event {
                heard.insert(*worker);
            }
            let before = watch.read();
            self.scheduler.handle(&self.clock, event);
            let from = actions.len();
            while let Some(action) = self.scheduler.next_action() {
                actions.push(action);
            }
            let after = watch.read();
            let (mut frames, mut slabs) = (0, 0);
            let (mut leases, mut lease_pixels) = (0, 0);
            for action in &actions[from..] {
                match action {
                    Action::Send { message: ToWorker::Lease(lease), .. } => {
                        leases += 1;
                        lease_pixels += lease.tile.area() as u64;
                        let before = self.last_slab.replace((lease.frame, lease.slab.first));
                        if before != self.last_slab {
                            slabs += 1;
                            frames += u64::from(before.is_none_or(|b| b.0 != lease.frame));
                        }
                    }
                    Action::Send { message: ToWorker::Region(lease), .. } => {
                        leases += 1;
                        // Several frames may be in the making: each begins once.
                        if self.begun.insert(lease.frame) {
                            slabs += 1;
                            frames += 1;
                        }
                    }
                    Action::FrameDone { frame, .. } => {
                        // Before the next is begun, which the same event may do.
                        self.outcome.frames[frame.0 as usize - 1].done = now + cost as Nanos;
                        self.at = (frame.0 as usize).min(self.jobs.len() - 1);
                    }
                    _ => {}
                }
            }
            let job = &self.jobs[self.at];
            let bricks = job.bricks.len() as f64;
            let pixels = job.view.size[0] as f64 * job.view.size[1] as f64;
            // What begins a frame or a slab gives its first leases, too.
            let first = frames > 0 && self.frames_begun == 0;
            self.frames_begun += frames;
            cost += if first {
                costs.first_brick * bricks
            } else if frames > 0 {
                costs.frame_brick * bricks
            } else if slabs > 0 {
                costs.slab_brick * bricks + costs.slab_pixel * pixels
            } else {
                costs.lease * leases as f64 + costs.lease_pixel * lease_pixels as f64
            };
            if let (Some(before), Some(after)) = (before, after) {
                let ns = after - before;
                if frames > 0 {
                    let took = if first { &mut took.first } else { &mut took.frames };
                    took.0 += job.bricks.len() as u64;
                    took.1 += ns;
                } else if slabs > 0 {
                    took.slabs.0 += job.bricks.len() as u64;
                    took.slabs.1 += ns;
                    took.slab_pixels += pixels as u64;
                } else if let Some(pixels) = result {
                    took.results.0 += pixels as u64;
                    took.results.1 += ns;
                    took.result_count += 1;
                    took.lease_count += leases;
                    took.lease_pixels += lease_pixels;
                } else {
                    let took = if ahead { &mut took.ahead } else { &mut took.others };
                    took.0 += 1;
                    took.1 += ns;
                }
            }
        }
        let sent = |a: &&Action| matches!(a, Action::Send { .. } | Action::SendBricks { .. });
        cost += costs.driver_message * actions.iter().filter(sent).count() as f64;
        let end = self.driver_works(now, cost);
        let mut written = BTreeSet::new();
        for action in &actions {
            let lent = match action {
                Action::Send { worker, message: ToWorker::Lease(l) } => (*worker, l.task, l.epoch),
                Action::Send { worker, message: ToWorker::Region(l) } => (*worker, l.task, l.epoch),
                _ => continue,
            };
            self.decided.insert(lent, now);
            heard.remove(&lent.0);
        }
        for id in heard {
            let idle = self.workers.get_mut(&id).map_or(&mut [][..], |w| &mut w.idle);
            idle.iter_mut().for_each(|i| i.heard = i.heard.or(Some(end)));
        }
        for action in actions {
            let first = match &action {
                Action::Send { worker, .. } => written.insert(*worker),
                _ => false,
            };
            self.carry_out(action, end, first, watch)?;
        }
        Ok(())
    }

    fn carry_out(
        &mut self,
        action: Action,
        at: Nanos,
        first: bool,
        watch: &mut dyn Stopwatch,
    ) -> Result<(), Unknown> {
        match action {
            Action::Send { worker, message } => {
                let bytes = match &message {
                    ToWorker::Lease(lease) => {
                        self.outcome.frames[lease.frame.0 as usize - 1].leases += 1;
                        let tile = self.trace.frames[lease.frame.0 as usize - 1]
                            .slab(lease.slab)
                            .and_then(|s| s.tile(&lease.tile, self.trace.about.size));
                        tile.map_or(SMALL, |t| t.lease_bytes.into())
                    }
                    ToWorker::Region(lease) => {
                        self.outcome.frames[lease.frame.0 as usize - 1].leases += 1;
                        SMALL + lease.begun.as_ref().map_or(0, |b| state_bytes(&b.pixels))
                    }
                    // Twelve bytes a brick and some more.
                    ToWorker::Directory { bricks, .. } => SMALL + 13 * bricks.len() as u64,
                    ToWorker::Frame { .. } | ToWorker::Scene(_) => FRAME,
                    _ => SMALL,
                };
                self.down(worker, message, bytes, at, first);
            }
            Action::SendBricks { worker, set, bricks } => {
                let job = self.jobs.iter().find(|j| j.scene.bricks == set);
                let infos = job.map_or(&[][..], |j| &j.bricks[..]);
                let w = self.workers.get_mut(&worker).expect("a worker stays");
                let (mut batch, mut bytes) = (Vec::new(), 0u64);
                for id in bricks {
                    let at = infos.binary_search_by_key(&id, |b| b.id);
                    bytes += at.map_or(0, |i| u64::from(infos[i].bytes));
                    batch.push(id);
                    if bytes >= BATCH {
                        w.batches.push_back((set, std::mem::take(&mut batch), bytes));
                        bytes = 0;
                    }
                }
                if !batch.is_empty() {
                    w.batches.push_back((set, batch, bytes));
                }
                self.batches(worker, at);
            }
            Action::Finished { tiles, .. } => {
                if self.machine.is_none() {
                    let pixels = tiles.iter().map(|(tile, _)| tile.area()).sum::<usize>();
                    let ns = self.cluster.costs.finish_pixel * pixels as f64;
                    self.master(|w| &mut w.finisher, at, ns);
                }
            }
            Action::FrameDone { frame, state, stats, spans } => {
                watch.done(*stats, spans);
                let i = frame.0 as usize - 1;
                self.shut.retain(|(f, _), _| *f != i);
                // The scheduler goes on with the next at once, where there is one.
                if i + 1 < self.queued {
                    self.outcome.frames[i + 1].began = self.outcome.frames[i].done;
                }
                let Costs { finish_pixel, mark_pixel, .. } = self.cluster.costs;
                let ns = if self.machine.is_some() { mark_pixel } else { finish_pixel };
                // Of tiles that came finished only the last ones are left.
                let left = state.encoded_tiles().iter().map(|(tile, _)| tile.area()).sum::<usize>();
                let pixels = match self.jobs[i].finish {
                    Some(_) if self.machine.is_none() => left as f64,
                    _ => self.pixels(frame),
                };
                let (ns, woken) = (ns * pixels, self.cluster.costs.master.woken);
                self.do_some(at, Chore::Finish(frame), ns, woken);
            }
            Action::FrameFailed { frame, reason } => {
                return Err(Unknown::Failed { frame: frame.0 as usize - 1, reason });
            }
            Action::Drop { .. } | Action::Progress { .. } => {}
        }
        Ok(())
    }
}
