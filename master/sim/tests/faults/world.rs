//! A virtual cluster on a virtual clock. Links delay, keep their order, stall and break;
//! workers render with `fake`, hang, lie and die. Whatever the scheduler does wrong on the way
//! ends the test with the seed in its message.

use crate::fake;
use crate::rng::Rng;
use slabcast_common::brick::{BrickGrid, BrickInfo, BrickSetKey};
use slabcast_common::ids::{BrickId, Epoch, FrameId, SceneId, TaskId, WorkerId};
use slabcast_common::image::{FrameAssembler, Picture, SparseTile, TilePixels, TileState};
use slabcast_common::message::{
    Checkpoint, Counters, DIRECTORIES_KEPT, Lease, Pixels, RegionCost, RegionLease, RegionSplit,
    TaskTimes, TileResult, ToWorker,
};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Schedule;
use slabcast_common::region::{parts, split_tile};
use slabcast_common::slab::SheetRange;
use slabcast_common::stats::FrameStats;
use slabcast_common::view::Projected;
use slabcast_schedule::{Action, Clock, Config, Event, FrameJob, Micros, Scheduler, Span, is_shut};
use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

pub(crate) struct VirtualClock(pub Cell<Micros>);

impl Clock for VirtualClock {
    fn now(&self) -> Micros {
        self.0.get()
    }
}

/// How a virtual worker is.
#[derive(Clone, Debug)]
pub(crate) struct Nature {
    pub(crate) threads: u32,
    pub(crate) is_local: bool,
    /// Microseconds a pixel-sheet.
    pub(crate) us_per_pixel_sheet: f64,
    pub(crate) budget: u64,
    pub(crate) latency: (Micros, Micros),
    /// Microseconds a brick on the wire.
    pub(crate) us_per_brick: Micros,
    pub(crate) clock_ahead: u64,
    /// One result in so many comes twice; 0: never. And so on.
    pub(crate) twice_in: u64,
    pub(crate) lie_in: u64,
    pub(crate) fail_in: u64,
    pub(crate) broken_in: u64,
    /// Tiles at this position, in any slab, kill it when it begins them.
    pub(crate) deadly: Option<[i32; 2]>,
    /// Threads that begin a tile at this position never end it.
    pub(crate) hangs_at: Option<[i32; 2]>,
    /// Nothing scripted happens to it.
    pub(crate) immune: bool,
}

impl Default for Nature {
    fn default() -> Self {
        Nature {
            threads: 1,
            is_local: false,
            us_per_pixel_sheet: 0.5,
            budget: u64::MAX,
            latency: (100, 100),
            us_per_brick: 50,
            clock_ahead: 1_000_000,
            twice_in: 0,
            lie_in: 0,
            fail_in: 0,
            broken_in: 0,
            deadly: None,
            hangs_at: None,
            immune: false,
        }
    }
}

/// What reaches somebody at a time.
#[derive(Debug)]
enum Coming {
    ToWorker(WorkerId, Box<ToWorker>),
    Bricks(WorkerId, BrickSetKey, Vec<BrickId>),
    ToMaster(Event),
    TaskEnd(WorkerId, usize),
    Scripted(Script),
}

/// What a test lets happen.
#[derive(Clone, Debug)]
pub(crate) enum Script {
    Join(Nature),
    Kill(WorkerId),
    /// Nothing passes to or from it for so long; then all that was held back comes.
    Stall(WorkerId, Micros),
    Leave(WorkerId),
    Slow(WorkerId, f64),
    Queue(Box<FrameJob>),
    Cancel(FrameId),
    EndScene(SceneId),
    /// A dead worker's process comes back with the bricks it had.
    Rejoin(Nature, Vec<(BrickSetKey, Vec<BrickId>)>),
}

/// What a worker was lent.
#[derive(Clone, Debug)]
enum Loan {
    Slab(Box<Lease>),
    Region(RegionLease, Box<Going>),
}

impl Loan {
    fn task(&self) -> (TaskId, Epoch) {
        match self {
            Loan::Slab(l) => (l.task, l.epoch),
            Loan::Region(l, _) => (l.task, l.epoch),
        }
    }

    fn frame(&self) -> FrameId {
        match self {
            Loan::Slab(l) => l.frame,
            Loan::Region(l, _) => l.frame,
        }
    }

    fn tile(&self) -> Rect {
        match self {
            Loan::Slab(l) => l.tile,
            Loan::Region(l, _) => l.tile,
        }
    }

    /// What has to be there before it can go on.
    fn bricks(&self) -> Vec<BrickId> {
        match self {
            Loan::Slab(l) => l.bricks.clone(),
            Loan::Region(_, going) => going.lacks.iter().copied().collect(),
        }
    }
}

/// How far a region has come: what the real worker does in `render::region` and `parking`, plainly.
#[derive(Clone, Debug, Default)]
struct Going {
    /// Pixels after the sheets before `at`; nothing before it began.
    drawn: Option<(i32, TilePixels)>,
    /// The same when it was begun last.
    before: Option<(i32, TilePixels)>,
    touched: BTreeSet<BrickId>,
    lacks: BTreeSet<BrickId>,
    keeps: BTreeSet<BrickId>,
    us: Micros,
    stalls: u32,
    parked_at: Micros,
    parked_us: Micros,
}

#[derive(Debug)]
struct Running {
    loan: Loan,
    received: Micros,
    ready: Micros,
    start: Micros,
}

#[derive(Debug)]
struct Worker {
    nature: Nature,
    leaving: bool,
    stalled_until: Micros,
    /// Earliest arrival on each of its links, so that they keep order.
    down: Micros,
    up: Micros,
    bricks_down: Micros,
    present: BTreeSet<(BrickSetKey, BrickId)>,
    leases: Vec<(Loan, Micros)>,
    directories: Vec<BrickSetKey>,
    running: Vec<Option<Running>>,
    // What the master did, as the checks see it.
    sent: BTreeSet<(BrickSetKey, BrickId)>,
    scenes: BTreeSet<SceneId>,
    frames: BTreeSet<FrameId>,
    outstanding: BTreeMap<(TaskId, Epoch), (FrameId, Vec<BrickId>)>,
    ever_over_lease: u64,
}

struct Known {
    job: Box<FrameJob>,
    projections: Arc<BTreeMap<BrickId, Projected>>,
    sizes: Arc<BTreeMap<BrickId, BrickInfo>>,
}

pub(crate) struct Done {
    /// Of a frame of sums.
    pub(crate) picture: Option<Picture>,
    /// Of one whose workers may finish it.
    pub(crate) bytes: Option<Vec<u8>>,
    pub(crate) stats: FrameStats,
    pub(crate) spans: Vec<Span>,
    pub(crate) at: Micros,
}

pub(crate) struct World {
    pub(crate) seed: u64,
    pub(crate) rng: Rng,
    pub(crate) clock: VirtualClock,
    pub(crate) scheduler: Scheduler,
    coming: BTreeMap<(Micros, u64), Coming>,
    order: u64,
    workers: BTreeMap<WorkerId, Worker>,
    /// Links that the master closed; what still comes is handed in all the same now and then.
    dropped: BTreeSet<WorkerId>,
    next_worker: u64,
    jobs: BTreeMap<FrameId, Known>,
    cancelled: BTreeSet<FrameId>,
    /// Of frames whose tiles come finished, as far as they have come.
    pictures: BTreeMap<FrameId, FrameAssembler>,
    pub(crate) done: BTreeMap<FrameId, Done>,
    pub(crate) failed: BTreeMap<FrameId, String>,
    pub(crate) drops: Vec<(WorkerId, String)>,
    pub(crate) leases_given: u64,
    /// Bricks that workers of regions asked for.
    pub(crate) bricks_asked: u64,
    pub(crate) handed_over: u64,
    /// Hash of all actions: two runs of a seed are one.
    pub(crate) log: u64,
}

impl World {
    pub(crate) fn new(seed: u64, config: Config) -> Self {
        World {
            seed,
            rng: Rng::new(seed),
            clock: VirtualClock(Cell::new(1_000)),
            scheduler: Scheduler::new(config),
            coming: BTreeMap::new(),
            order: 0,
            workers: BTreeMap::new(),
            dropped: BTreeSet::new(),
            next_worker: 1,
            jobs: BTreeMap::new(),
            cancelled: BTreeSet::new(),
            pictures: BTreeMap::new(),
            done: BTreeMap::new(),
            failed: BTreeMap::new(),
            drops: Vec::new(),
            leases_given: 0,
            bricks_asked: 0,
            handed_over: 0,
            log: 0,
        }
    }

    pub(crate) fn now(&self) -> Micros {
        self.clock.now()
    }

    fn at(&mut self, when: Micros, what: Coming) {
        self.order += 1;
        self.coming.insert((when.max(self.now()), self.order), what);
    }

    pub(crate) fn script(&mut self, when: Micros, what: Script) {
        self.at(when, Coming::Scripted(what));
    }

    pub(crate) fn join(&mut self, nature: Nature) -> WorkerId {
        self.join_with(nature, Vec::new())
    }

    fn join_with(&mut self, nature: Nature, held: Vec<(BrickSetKey, Vec<BrickId>)>) -> WorkerId {
        let id = WorkerId(self.next_worker);
        self.next_worker += 1;
        let present: BTreeSet<_> =
            held.iter().flat_map(|(k, ids)| ids.iter().map(|&b| (*k, b))).collect();
        let worker = Worker {
            leaving: false,
            stalled_until: 0,
            down: 0,
            up: 0,
            bricks_down: 0,
            sent: present.clone(),
            present,
            leases: Vec::new(),
            directories: Vec::new(),
            running: (0..nature.threads).map(|_| None).collect(),
            scenes: BTreeSet::new(),
            frames: BTreeSet::new(),
            outstanding: BTreeMap::new(),
            ever_over_lease: 0,
            nature: nature.clone(),
        };
        self.workers.insert(id, worker);
        self.hand_in(Event::WorkerJoined {
            worker: id,
            name: format!("host-{}", id.0),
            threads: nature.threads,
            is_local: nature.is_local,
            memory_budget_bytes: nature.budget,
            held,
        });
        id
    }

    pub(crate) fn queue(&mut self, job: Box<FrameJob>) {
        let known = Known {
            projections: Arc::new(fake::projections(&job)),
            sizes: Arc::new(job.bricks.iter().map(|b| (b.id, *b)).collect()),
            job: job.clone(),
        };
        self.jobs.insert(job.frame, known);
        self.hand_in(Event::FrameQueued(job));
    }

    /// What a worker holds, to be taken along to its next life.
    pub(crate) fn holdings(&self, id: WorkerId) -> Vec<(BrickSetKey, Vec<BrickId>)> {
        let mut by_set: BTreeMap<_, Vec<_>> = BTreeMap::new();
        for &(k, b) in self.workers.get(&id).iter().flat_map(|w| &w.present) {
            by_set.entry(k).or_default().push(b);
        }
        by_set.into_iter().collect()
    }

    fn hand_in(&mut self, event: Event) {
        if let Event::Result { worker, result } = &event
            && let Some(w) = self.workers.get_mut(worker)
        {
            w.outstanding.remove(&(result.task, result.epoch));
        }
        if let Event::Failed { worker, task, epoch, .. } = &event
            && let Some(w) = self.workers.get_mut(worker)
        {
            w.outstanding.remove(&(*task, *epoch));
        }
        if let Event::BricksForgotten { worker, set, bricks } = &event
            && let Some(w) = self.workers.get_mut(worker)
        {
            for &b in bricks {
                w.sent.remove(&(*set, b));
            }
        }
        if let Event::BricksBroken { worker, set, bricks } = &event
            && let Some(w) = self.workers.get_mut(worker)
        {
            for &b in bricks {
                // Unless the count of the good ones came first and the broken one was taken for
                // one of them and dropped.
                w.sent.remove(&(*set, b));
            }
        }
        self.scheduler.handle(&self.clock, event);
        while let Some(action) = self.scheduler.next_action() {
            self.carry_out(action);
        }
    }

    fn note(&mut self, what: &str, a: u64, b: u64) {
        for x in what.bytes().map(u64::from).chain([a, b, self.now()]) {
            self.log = (self.log ^ x).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }

    /// Sends something to a worker after its link's delay.
    fn down(&mut self, id: WorkerId, message: ToWorker) {
        let Some(w) = self.workers.get_mut(&id) else { return };
        let delay = self.rng.between(w.nature.latency.0, w.nature.latency.1);
        w.down = w.down.max(self.clock.now() + delay).max(w.stalled_until);
        let when = w.down;
        self.at(when, Coming::ToWorker(id, Box::new(message)));
    }

    /// Sends something to the master.
    fn up(&mut self, id: WorkerId, event: Event) {
        let Some(w) = self.workers.get_mut(&id) else { return };
        let delay = self.rng.between(w.nature.latency.0, w.nature.latency.1);
        w.up = w.up.max(self.clock.now() + delay).max(w.stalled_until);
        let when = w.up;
        self.at(when, Coming::ToMaster(event));
    }

    /// Does what the scheduler wants, and looks whether it may want that.
    fn carry_out(&mut self, action: Action) {
        let seed = self.seed;
        match action {
            Action::Send { worker: id, message } => {
                self.note("send", id.0, 0);
                assert!(!self.dropped.contains(&id), "seed {seed}: message to dropped {id}");
                let Some(w) = self.workers.get_mut(&id) else { return };
                match &message {
                    ToWorker::Scene(scene) => {
                        assert!(w.scenes.insert(scene.id), "seed {seed}: scene twice to {id}");
                    }
                    ToWorker::Frame { frame, scene, finish, plain, .. } => {
                        assert!(*plain || !w.nature.is_local, "seed {seed}: nothing to pack for");
                        let job = &self.jobs[frame].job;
                        let regions = job.work.schedule != Schedule::Slab;
                        assert_eq!(*finish, job.finish.filter(|_| regions), "seed {seed}");
                        assert!(w.scenes.contains(scene), "seed {seed}: frame before its scene");
                        assert!(w.frames.insert(*frame), "seed {seed}: frame twice to {id}");
                    }
                    ToWorker::Lease(lease) => {
                        assert!(!w.leaving, "seed {seed}: lease to {id}, which leaves");
                        assert!(w.frames.contains(&lease.frame), "seed {seed}: lease before frame");
                        assert!(!lease.bricks.is_empty(), "seed {seed}: a lease without bricks");
                        assert!(lease.bricks.windows(2).all(|p| p[0] < p[1]), "seed {seed}");
                        assert_eq!(lease.state.a.len(), lease.tile.area(), "seed {seed}");
                        let set = self.jobs[&lease.frame].job.scene.bricks;
                        for &b in &lease.bricks {
                            // With memory to spare it is there or under way; else it may wait
                            // for a drop, and must come later.
                            assert!(
                                w.nature.budget < u64::MAX || w.sent.contains(&(set, b)),
                                "seed {seed}: lease of {} on {b}, which was not sent to {id}",
                                lease.task,
                            );
                        }
                        let key = (lease.task, lease.epoch);
                        let what = (lease.frame, lease.bricks.clone());
                        assert!(w.outstanding.insert(key, what).is_none(), "seed {seed}: twice");
                        assert!(
                            w.outstanding.keys().filter(|k| k.0 == lease.task).count() == 1,
                            "seed {seed}: {} twice to {id}",
                            lease.task,
                        );
                        let sizes = &self.jobs[&lease.frame].sizes;
                        let bytes = lease.bricks.iter().map(|b| u64::from(sizes[b].bytes)).sum();
                        w.ever_over_lease = w.ever_over_lease.max(bytes);
                        self.leases_given += 1;
                    }
                    ToWorker::Directory { set, grid, first, total, bricks } => {
                        let known = self.jobs.values().find(|j| j.job.scene.bricks == *set);
                        let known = &known.expect("a set of some job").job;
                        assert_eq!((*first, *total as usize), (0, bricks.len()), "seed {seed}");
                        assert_eq!(*bricks, known.bricks, "seed {seed}");
                        let dims = known.scene.volume.lattice.dims;
                        assert_eq!(*grid, BrickGrid::new(dims), "seed {seed}");
                        assert!(!w.directories.contains(set), "seed {seed}: directory twice");
                        w.directories.push(*set);
                        if w.directories.len() > DIRECTORIES_KEPT {
                            w.directories.remove(0);
                        }
                    }
                    ToWorker::Region(lease) => {
                        assert!(!w.leaving, "seed {seed}: region to {id}, which leaves");
                        assert!(w.frames.contains(&lease.frame), "seed {seed}: before its frame");
                        let set = self.jobs[&lease.frame].job.scene.bricks;
                        assert!(w.directories.contains(&set), "seed {seed}: before its directory");
                        let key = (lease.task, lease.epoch);
                        let what = (lease.frame, Vec::new());
                        assert!(w.outstanding.insert(key, what).is_none(), "seed {seed}: twice");
                        let same = w.outstanding.keys().filter(|k| k.0 == lease.task).count();
                        assert_eq!(same, 1, "seed {seed}: {} twice to {id}", lease.task);
                        self.leases_given += 1;
                    }
                    ToWorker::SplitRegion { frame, task, epoch, share } => {
                        assert!(w.frames.contains(frame), "seed {seed}: a piece before its frame");
                        let there = w.outstanding.contains_key(&(*task, *epoch));
                        assert!(there, "seed {seed}: {id} is asked for a piece of nothing");
                        assert!((1..1000).contains(share), "seed {seed}: {share} of 1000");
                    }
                    ToWorker::EndFrame { frame } => {
                        assert!(w.frames.remove(frame), "seed {seed}: end of a frame not begun");
                        w.outstanding.retain(|_, (f, _)| f != frame);
                    }
                    ToWorker::EndScene { scene } => {
                        assert!(w.scenes.remove(scene), "seed {seed}: end of a scene not sent");
                    }
                    ToWorker::DropBricks { set, bricks } => {
                        for &b in bricks {
                            assert!(
                                w.sent.remove(&(*set, b)),
                                "seed {seed}: drop of {b}, not sent"
                            );
                            let set_of = |f: &FrameId| self.jobs[f].job.scene.bricks;
                            let needed = w
                                .outstanding
                                .values()
                                .any(|(f, ids)| set_of(f) == *set && ids.binary_search(&b).is_ok());
                            assert!(!needed, "seed {seed}: {b} dropped under a lease of {id}");
                        }
                    }
                    ToWorker::Ping { .. } => {}
                    other => panic!("seed {seed}: {other:?} is the driver's to send"),
                }
                self.down(id, message);
            }
            Action::SendBricks { worker: id, set, bricks } => {
                self.note("bricks", id.0, bricks.len() as u64);
                let Some(w) = self.workers.get_mut(&id) else { return };
                assert!(!bricks.is_empty(), "seed {seed}: an empty batch");
                for &b in &bricks {
                    assert!(w.sent.insert((set, b)), "seed {seed}: {b} sent to {id} again");
                }
                let mut rest = &bricks[..];
                while !rest.is_empty() {
                    let n = (self.rng.between(1, 16) as usize).min(rest.len());
                    let (now, later) = rest.split_at(n);
                    rest = later;
                    let w = self.workers.get_mut(&id).expect("seen above");
                    let start = w.bricks_down.max(self.clock.now()).max(w.stalled_until);
                    w.bricks_down = start + w.nature.us_per_brick * n as u64;
                    let when = w.bricks_down;
                    self.at(when, Coming::Bricks(id, set, now.to_vec()));
                }
            }
            Action::Drop { worker, reason } => {
                self.note("drop", worker.0, 0);
                self.dropped.insert(worker);
                self.drops.push((worker, reason));
            }
            Action::Progress { frame, done, total, slab, slabs } => {
                assert!(done <= total && slab < slabs, "seed {seed}: progress of {frame}");
            }
            Action::Finished { frame, tiles } => {
                let job = &self.jobs[&frame].job;
                let finish = job.finish.expect("its tiles come finished");
                let begun = || FrameAssembler::new(job.view.size, &finish);
                self.pictures.entry(frame).or_insert_with(begun).place(&tiles);
            }
            Action::FrameDone { frame, state, stats, spans } => {
                self.note("done", frame.0, 0);
                assert!(!self.cancelled.contains(&frame), "seed {seed}: {frame} was cancelled");
                let finish = self.jobs[&frame].job.finish;
                let begun = self.pictures.remove(&frame);
                let bytes = finish.map(|finish| match begun {
                    Some(begun) => state.encode_onto(begun).bytes,
                    None => state.encode(&finish, false).bytes,
                });
                let picture = finish.is_none().then(|| state.to_picture());
                let (at, stats) = (self.now(), *stats);
                let before = self
                    .done
                    .insert(frame, Done { picture, bytes, stats, spans: spans.to_vec(), at });
                assert!(before.is_none(), "seed {seed}: {frame} done twice");
                let first = *self.jobs.keys().find(|f| !self.is_over(**f)).unwrap_or(&frame);
                assert!(first >= frame, "seed {seed}: {frame} before {first}");
            }
            Action::FrameFailed { frame, reason } => {
                self.note("failed", frame.0, 0);
                self.failed.insert(frame, reason);
            }
        }
    }

    fn is_over(&self, frame: FrameId) -> bool {
        self.done.contains_key(&frame)
            || self.failed.contains_key(&frame)
            || self.cancelled.contains(&frame)
    }

    pub(crate) fn kill(&mut self, id: WorkerId) {
        if self.workers.remove(&id).is_some() && !self.dropped.contains(&id) {
            self.hand_in(Event::WorkerLost { worker: id, reason: "killed".into() });
        }
    }

    fn follow(&mut self, script: Script) {
        let whom = match &script {
            Script::Kill(id) | Script::Stall(id, _) | Script::Leave(id) | Script::Slow(id, _) => {
                self.workers.get(id)
            }
            _ => None,
        };
        if whom.is_some_and(|w| w.nature.immune) {
            return;
        }
        match script {
            Script::Join(nature) => {
                self.join(nature);
            }
            Script::Rejoin(nature, held) => {
                self.join_with(nature, held);
            }
            Script::Kill(id) => self.kill(id),
            Script::Stall(id, time) => {
                let until = self.now() + time;
                if let Some(w) = self.workers.get_mut(&id) {
                    w.stalled_until = until;
                }
                // What is on its way is held back too.
                let held: Vec<_> = self
                    .coming
                    .iter()
                    .filter(|((when, _), c)| *when < until && c.is_of(id))
                    .map(|(k, _)| *k)
                    .collect();
                for key in held {
                    let what = self.coming.remove(&key).expect("just seen");
                    self.coming.insert((until, key.1), what);
                }
                if let Some(w) = self.workers.get_mut(&id) {
                    w.up = w.up.max(until);
                    w.down = w.down.max(until);
                    w.bricks_down = w.bricks_down.max(until);
                }
            }
            Script::Leave(id) => {
                if let Some(w) = self.workers.get_mut(&id) {
                    w.leaving = true;
                    w.leases.clear();
                    self.hand_in(Event::WorkerLeaving { worker: id });
                    self.maybe_gone(id);
                }
            }
            Script::Slow(id, factor) => {
                if let Some(w) = self.workers.get_mut(&id) {
                    w.nature.us_per_pixel_sheet *= factor;
                }
            }
            Script::Queue(job) => self.queue(job),
            Script::Cancel(frame) => {
                if !self.is_over(frame) && self.jobs.contains_key(&frame) {
                    self.cancelled.insert(frame);
                    self.hand_in(Event::CancelFrame { frame });
                }
            }
            Script::EndScene(scene) => self.hand_in(Event::SceneEnded { scene }),
        }
    }

    /// A worker that leaves closes its link when its threads are done.
    fn maybe_gone(&mut self, id: WorkerId) {
        let Some(w) = self.workers.get(&id) else { return };
        if w.leaving && w.running.iter().all(|r| r.is_none()) {
            // After its last result.
            let when = w.up + 1;
            self.at(when, Coming::Scripted(Script::Kill(id)));
        }
    }

    fn deliver(&mut self, coming: Coming) {
        let seed = self.seed;
        match coming {
            Coming::ToMaster(event) => {
                let from = sender(&event);
                if self.dropped.contains(&from) && self.rng.once_in(2) {
                    return;
                }
                if self.workers.contains_key(&from) || self.rng.once_in(2) {
                    self.hand_in(event);
                }
            }
            Coming::ToWorker(id, message) => {
                let Some(w) = self.workers.get_mut(&id) else { return };
                match *message {
                    ToWorker::Lease(lease) if !w.leaving => {
                        let now = self.clock.now();
                        w.leases.push((Loan::Slab(lease), now));
                        self.begin(id);
                    }
                    ToWorker::Region(lease) if !w.leaving => {
                        let now = self.clock.now();
                        let drawn = lease.begun.as_ref().map(|begun| {
                            let at = begun.sheets[0].expect("no part of a piece is done");
                            assert_eq!(begun.sheets, vec![Some(at); parts(lease.tile).count()]);
                            assert_eq!(begun.pixels.a.len(), lease.tile.area(), "seed {seed}");
                            (at, begun.pixels.clone())
                        });
                        let going = Box::new(Going { drawn, ..Going::default() });
                        w.leases.push((Loan::Region(lease, going), now));
                        self.begin(id);
                    }
                    ToWorker::SplitRegion { task, epoch, share, .. } => {
                        self.hand_over(id, (task, epoch), f64::from(share) / 1000.0);
                    }
                    ToWorker::EndFrame { frame } => w.leases.retain(|(l, _)| l.frame() != frame),
                    ToWorker::DropBricks { set, bricks } => {
                        for b in bricks {
                            let was = w.present.remove(&(set, b));
                            // It may have forgotten it while the message came.
                            let was = was || w.nature.broken_in > 0 || !w.directories.is_empty();
                            assert!(was, "seed {seed}: {id} is to drop {b}, which it has not");
                        }
                    }
                    ToWorker::Ping { nonce } => {
                        let clock_us = self.clock.now() + w.nature.clock_ahead;
                        self.up(id, Event::Pong { worker: id, nonce, clock_us });
                    }
                    _ => {}
                }
            }
            Coming::Bricks(id, set, bricks) => {
                let Some(w) = self.workers.get_mut(&id) else { return };
                let mut broken = Vec::new();
                let mut good = 0;
                for b in bricks {
                    if w.nature.broken_in > 0 && self.rng.once_in(w.nature.broken_in) {
                        broken.push(b);
                    } else {
                        good += 1;
                        let new = w.present.insert((set, b));
                        assert!(new, "seed {seed}: {b} comes to {id}, which has it");
                    }
                }
                self.check_budget(id);
                let report = Event::BricksBroken { worker: id, set, bricks: broken.clone() };
                let count = Event::BricksIn { worker: id, set, bricks: good };
                let broken_first = self.rng.once_in(2);
                if !broken.is_empty() && broken_first {
                    self.up(id, report.clone());
                }
                if good > 0 {
                    self.up(id, count);
                }
                if !broken.is_empty() && !broken_first {
                    self.up(id, report);
                }
                self.begin(id);
            }
            Coming::TaskEnd(id, thread) => self.end_task(id, thread),
            Coming::Scripted(script) => self.follow(script),
        }
    }

    fn check_budget(&self, id: WorkerId) {
        let w = &self.workers[&id];
        // Who draws regions makes room itself (`slabcast-worker`'s tests look at that).
        if w.nature.budget == u64::MAX || !w.directories.is_empty() {
            return;
        }
        let size = |(set, b): &(BrickSetKey, BrickId)| {
            let job = self.jobs.values().find(|j| j.job.scene.bricks == *set);
            job.map_or(0, |j| u64::from(j.sizes[b].bytes))
        };
        let bytes: u64 = w.present.iter().map(size).sum();
        let allowed = w.nature.budget.max(w.ever_over_lease);
        assert!(
            bytes <= allowed,
            "seed {}: {id} has {bytes} bytes of bricks, its budget is {}",
            self.seed,
            w.nature.budget,
        );
    }

    /// Free threads begin leases whose bricks are there.
    fn begin(&mut self, id: WorkerId) {
        loop {
            let now = self.clock.now();
            let Some(w) = self.workers.get_mut(&id) else { return };
            let Some(thread) = w.running.iter().position(|r| r.is_none()) else { return };
            let ready = w.leases.iter().position(|(l, _)| {
                let set = self.jobs[&l.frame()].job.scene.bricks;
                l.bricks().iter().all(|&b| w.present.contains(&(set, b)))
            });
            let Some(i) = ready else { return };
            let (mut loan, received) = w.leases.remove(i);
            let corner = Some([loan.tile().x0, loan.tile().y0]);
            let (deadly, hangs) = (w.nature.deadly == corner, w.nature.hangs_at == corner);
            let area = loan.tile().area() as f64;
            let sheets = match &mut loan {
                Loan::Slab(l) => l.slab.len(),
                Loan::Region(l, going) => {
                    if going.parked_at > 0 {
                        going.parked_us += now - going.parked_at;
                    }
                    going.before = going.drawn.clone();
                    going.advance_to(&self.jobs[&l.frame], l.tile, &w.present, i32::MAX)
                }
            };
            let time = (area * f64::from(sheets) * w.nature.us_per_pixel_sheet) as Micros + 50;
            w.running[thread] = Some(Running { loan, received, ready: now, start: now });
            if deadly {
                self.at(now + time / 2, Coming::Scripted(Script::Kill(id)));
            } else if !hangs {
                let jitter = self.rng.below(time / 4 + 1);
                self.at(now + time + jitter, Coming::TaskEnd(id, thread));
            }
        }
    }

    /// A worker gives away a piece of a region that it draws, that lies there or that stands still.
    fn hand_over(&mut self, id: WorkerId, name: (TaskId, Epoch), share: f64) {
        let now = self.clock.now();
        let Some(w) = self.workers.get_mut(&id) else { return };
        let lies = w.nature.lie_in > 0 && self.rng.once_in(w.nature.lie_in);
        let running = w.running.iter_mut().flatten().map(|r| (&mut r.loan, Some(r.start)));
        let waiting = w.leases.iter_mut().map(|(loan, _)| (loan, None));
        let of = |(loan, _): &(&mut Loan, Option<Micros>)| loan.task() == name;
        let Some((Loan::Region(lease, going), since)) = running.chain(waiting).find(of) else {
            return;
        };
        let known = &self.jobs[&lease.frame];
        let tile = lease.tile;
        let Some((kept, given)) = split_tile(tile, share, |r| r.area() as f64) else { return };
        if let Some(since) = since {
            // As far as it has come by now, of what it was to draw from where it was begun last.
            let until = going.drawn.as_ref().map_or(0, |d| d.0);
            going.drawn = going.before.take();
            let from = going.drawn.as_ref().map_or_else(|| known.first(tile), |d| d.0);
            let whole = f64::from(until - from) * tile.area() as f64 * w.nature.us_per_pixel_sheet;
            let part = ((now - since) as f64 / (whole + 50.0)).min(1.0);
            let at = from + (part * f64::from(until - from)) as i32;
            going.advance_to(known, tile, &w.present, at);
        }
        let at = going.drawn.as_ref().map_or_else(|| known.first(tile), |d| d.0);
        let blank = || TilePixels {
            a: vec![0.0; tile.area()],
            colour: vec![[0; 3]; tile.area()],
            last: None,
        };
        let whole = going.drawn.as_ref().map_or_else(blank, |d| d.1.clone());
        let sheets = parts(given).map(|_| Some(at)).collect();
        let begun = Checkpoint { sheets, pixels: whole.crop(tile, given) };
        going.drawn = going.drawn.is_some().then(|| (at, whole.crop(tile, kept)));
        lease.tile = kept;
        if since.is_some() {
            going.before = going.drawn.clone();
            going.advance_to(known, kept, &w.present, i32::MAX);
        }
        let (task, epoch) = name;
        let mut piece = Box::new(RegionSplit { task, epoch, kept, given, begun });
        if lies {
            match self.rng.below(5) {
                0 => piece.begun.pixels.a.truncate(3),
                1 => piece.begun.pixels.a[0] = f32::INFINITY,
                2 => piece.begun.sheets.push(None),
                3 => piece.kept = piece.given,
                _ => piece.given.x0 += 1,
            }
        }
        self.handed_over += 1;
        self.up(id, Event::HandedOver { worker: id, piece });
    }

    fn end_task(&mut self, id: WorkerId, thread: usize) {
        let now = self.clock.now();
        let Some(w) = self.workers.get_mut(&id) else { return };
        let mut r = w.running[thread].take().expect("a task that ends has begun");
        let nature = w.nature.clone();
        let is_over = !w.frames.contains(&r.loan.frame());
        let job = &self.jobs[&r.loan.frame()];
        let mut cost = None;
        let mut start = r.start;
        let mut pixels = match &mut r.loan {
            Loan::Slab(l) => {
                let quality = &job.job.scene.quality;
                fake::render(&job.projections, quality, l.tile, l.slab, &l.bricks, &l.state)
            }
            Loan::Region(_, going) => {
                going.us += now - r.start;
                if !going.lacks.is_empty() {
                    if !is_over {
                        self.park(id, r);
                    }
                    self.maybe_gone(id);
                    self.begin(id);
                    return;
                }
                start = now.saturating_sub(going.us);
                let place = |b: &BrickId| {
                    let at = job.job.bricks.binary_search_by_key(b, |b| b.id);
                    at.expect("a brick of the set") as u32
                };
                let mut touched: Vec<u32> = going.touched.iter().map(place).collect();
                if nature.lie_in > 0 && self.rng.once_in(4 * nature.lie_in) {
                    touched.push(job.job.bricks.len() as u32);
                }
                let (stalls, parked_us) = (going.stalls, going.parked_us);
                cost = Some(RegionCost { touched, stalls, parked_us, ..RegionCost::default() });
                let (_, pixels) = going.drawn.take().expect("it was drawn to its end");
                TilePixels { last: None, ..pixels }
            }
        };
        if nature.lie_in > 0 && self.rng.once_in(nature.lie_in) {
            match self.rng.below(4) {
                0 => pixels.a.truncate(3),
                1 => pixels.colour.push([1; 3]),
                2 => pixels.last = Some(vec![[1; 4]; 2]),
                _ => pixels.a[0] = f32::NAN,
            }
        }
        let regions = matches!(r.loan, Loan::Region(..));
        let pixels = match job.job.finish.filter(|_| regions) {
            // A lie about sums stays one.
            Some(finish) if pixels.a.len() == pixels.colour.len() && pixels.last.is_none() => {
                let tile = r.loan.tile();
                let size = [tile.width() as u32, tile.height() as u32];
                let mut leaves = SparseTile::encode(&pixels, size, &finish);
                if pixels.a[0].is_nan() {
                    leaves.max_alpha = f32::NAN;
                }
                Pixels::Finished(leaves)
            }
            _ => Pixels::Sums(pixels),
        };
        let clock = |t: Micros| t + nature.clock_ahead;
        let n = r.loan.tile().area() as u64;
        let (task, epoch) = r.loan.task();
        let result = Box::new(TileResult {
            task,
            epoch,
            pixels,
            bytes: Some(n as u32),
            counters: Counters { tossed: 2 * n, splatted: n, culled: 0 },
            times: TaskTimes {
                received_us: clock(r.received),
                ready_us: clock(r.ready),
                start_us: clock(start),
                end_us: clock(now),
                thread: thread as u32,
            },
            region: cost,
        });
        if nature.fail_in > 0 && self.rng.once_in(nature.fail_in) {
            let reason = "no reason".to_string();
            self.up(id, Event::Failed { worker: id, task, epoch, reason });
        } else {
            if nature.twice_in > 0 && self.rng.once_in(nature.twice_in) {
                self.up(id, Event::Result { worker: id, result: result.clone() });
            }
            self.up(id, Event::Result { worker: id, result });
        }
        self.maybe_gone(id);
        self.begin(id);
    }

    /// A region stands still: it makes room and asks for what it lacks.
    fn park(&mut self, id: WorkerId, mut r: Running) {
        let now = self.clock.now();
        let Some(w) = self.workers.get_mut(&id) else { return };
        let Loan::Region(lease, going) = &mut r.loan else { panic!("a slab's tile is not parked") };
        let job = &self.jobs[&lease.frame];
        let set = job.job.scene.bricks;
        going.parked_at = now;
        going.stalls += 1;
        // What others wait for already is not asked for again.
        let waited: BTreeSet<BrickId> = w
            .leases
            .iter()
            .filter_map(|(l, _)| match l {
                Loan::Region(other, g) if self.jobs[&other.frame].job.scene.bricks == set => {
                    Some(g.lacks.iter().copied())
                }
                _ => None,
            })
            .flatten()
            .collect();
        let absent = |b: &&BrickId| !w.present.contains(&(set, **b)) && !waited.contains(b);
        let asked: Vec<BrickId> = going.lacks.iter().filter(absent).copied().collect();
        let mut forgotten = Vec::new();
        if w.nature.budget < u64::MAX {
            let size = |(k, b): &(BrickSetKey, BrickId)| {
                let job = self.jobs.values().find(|j| j.job.scene.bricks == *k);
                job.map_or(0, |j| u64::from(j.sizes[b].bytes))
            };
            let kept = |b: &(BrickSetKey, BrickId)| {
                let keeps = |l: &Loan| matches!(l, Loan::Region(_, g) if g.keeps.contains(&b.1));
                let running = w.running.iter().flatten().any(|r| keeps(&r.loan));
                b.0 == set && (going.keeps.contains(&b.1) || running)
                    || w.leases.iter().any(|(l, _)| keeps(l))
            };
            let on_their_way: u64 = w.sent.difference(&w.present).map(size).sum::<u64>();
            let new: u64 = asked.iter().map(|&b| size(&(set, b))).sum();
            let mut bytes = w.present.iter().map(size).sum::<u64>() + on_their_way + new;
            for b in w.present.clone() {
                if bytes <= w.nature.budget {
                    break;
                }
                if !kept(&b) {
                    bytes -= size(&b);
                    w.present.remove(&b);
                    forgotten.push(b);
                }
            }
        }
        w.leases.push((r.loan, r.received));
        for (k, b) in forgotten {
            self.up(id, Event::BricksForgotten { worker: id, set: k, bricks: vec![b] });
        }
        if !asked.is_empty() {
            self.bricks_asked += asked.len() as u64;
            self.up(id, Event::BricksWanted { worker: id, set, bricks: asked });
        }
    }

    /// Lets time run until `until` says so. Panics when nothing happens any more.
    pub(crate) fn run_until(&mut self, mut until: impl FnMut(&World) -> bool) {
        for _ in 0..2_000_000 {
            if until(self) {
                return;
            }
            let due = self.scheduler.next_deadline();
            let next = self.coming.first_key_value().map(|(k, _)| k.0);
            match (next, due) {
                (Some(t), Some(d)) if d <= t => self.tick(d),
                (Some(_), _) => {
                    let ((t, _), what) = self.coming.pop_first().expect("just seen");
                    self.clock.0.set(t.max(self.now()));
                    self.deliver(what);
                }
                (None, Some(d)) => self.tick(d),
                (None, None) => break,
            }
        }
        let over = self.jobs.keys().filter(|f| self.is_over(**f)).count();
        panic!(
            "seed {}: stuck at {} us: {over} of {} frames over, workers {:#?}",
            self.seed,
            self.now(),
            self.jobs.len(),
            self.scheduler.workers(),
        );
    }

    fn tick(&mut self, when: Micros) {
        self.clock.0.set(when.max(self.now()));
        self.hand_in(Event::Tick);
    }

    pub(crate) fn run_for(&mut self, time: Micros) {
        let end = self.now() + time;
        // Something must happen at the end.
        self.script(end, Script::Cancel(FrameId(u64::MAX)));
        self.run_until(|w| w.now() >= end);
    }

    /// Runs until no scripted thing is left and all frames are over, and looks at what is left.
    pub(crate) fn finish(&mut self) {
        self.run_until(|w| {
            w.scheduler.is_idle()
                && !w.coming.values().any(|c| matches!(c, Coming::Scripted(s) if s.matters()))
        });
        let seed = self.seed;
        for frame in self.jobs.keys() {
            assert!(self.is_over(*frame), "seed {seed}: {frame} has no end");
        }
        for (id, w) in self.workers.iter().filter(|(id, _)| !self.dropped.contains(id)) {
            assert!(w.frames.is_empty(), "seed {seed}: {id} still has {:?}", w.frames);
        }
        for w in self.scheduler.workers() {
            assert_eq!((w.leases, w.busy), (0, 0), "seed {seed}: leases of {} left", w.id);
        }
        for (frame, done) in &self.done {
            let want = fake::serial(&self.jobs[frame].job);
            if let Some(picture) = done.picture.as_ref().filter(|picture| **picture != want) {
                let bad = picture.pixels.iter().zip(&want.pixels).filter(|(a, b)| a != b);
                panic!("seed {seed}: {frame} differs in {} pixels", bad.count());
            }
            let finish = self.jobs[frame].job.finish;
            let bytes = finish.map(|finish| want.encode(finish.format, finish.background));
            assert!(done.bytes == bytes, "seed {seed}: {frame} has other bytes");
            self.check_stats(*frame, done);
        }
    }

    fn check_stats(&self, frame: FrameId, done: &Done) {
        let (seed, s, job) = (self.seed, &done.stats, &self.jobs[&frame].job);
        let [w, h] = job.view.size;
        let mut area = 0;
        for slab in &s.slabs {
            let sorted = slab.tiles.windows(2).all(|p| p[0].est >= p[1].est);
            assert!(sorted, "seed {seed}: the queue of {frame} is not sorted");
            for t in slab.tiles.iter().filter(|t| !t.worker.is_empty()) {
                area += u64::from((w - t.x).min(t.size)) * u64::from((h - t.y).min(t.size));
            }
        }
        assert_eq!(s.voxels.splatted, area, "seed {seed}: {frame} counts each tile once");
        assert_eq!(s.voxels.tossed, 2 * area, "seed {seed}");
        assert!(s.bricks.needed <= s.bricks.relevant, "seed {seed}");
        assert!(s.bricks.needed_voxels <= s.voxels.relevant, "seed {seed}");
        let m = &s.ms;
        assert!(m.overlap <= m.distribute + 1e-6, "seed {seed}: {m:?}");
        assert!(m.distribute <= m.total + 1e-6, "seed {seed}: {m:?}");
        let render: f64 = s.workers.iter().map(|w| w.render_ms).sum();
        let tiles: f64 = s.slabs.iter().flat_map(|s| &s.tiles).map(|t| t.ms).sum();
        assert!((render - m.render).abs() < 1e-6 && (tiles - render).abs() < 1e-6, "seed {seed}");
        for w in &s.workers {
            assert!(w.distribute_ms <= m.distribute + 1e-6, "seed {seed}: {w:?}");
            assert!(w.wait_ms >= 0.0 && w.p2p_ms >= 0.0, "seed {seed}: {w:?}");
            assert!((w.bricks_sent > 0) == (w.bytes_sent > 0), "seed {seed}: {w:?}");
        }
        for span in &done.spans {
            assert!(span.start <= span.end && span.end <= done.at, "seed {seed}: {span:?}");
        }
    }
}

impl Known {
    /// The first sheet of a tile.
    fn first(&self, tile: Rect) -> i32 {
        let over = self.projections.values().filter(|p| !p.rect.intersect(&tile).is_empty());
        over.fold(SheetRange::default(), |all, p| all.union(p.sheets)).first
    }
}

impl Going {
    /// Draws sheet after sheet with what is there, as far as nothing is lacked that may touch an open
    /// pixel, and to sheet `until` at most. How many sheets that are.
    fn advance_to(
        &mut self,
        job: &Known,
        tile: Rect,
        present: &BTreeSet<(BrickSetKey, BrickId)>,
        until: i32,
    ) -> u32 {
        let (set, quality) = (job.job.scene.bricks, &job.job.scene.quality);
        let over: Vec<(BrickId, Projected)> = job
            .projections
            .iter()
            .filter(|(_, p)| !p.rect.intersect(&tile).is_empty())
            .map(|(id, p)| (*id, *p))
            .collect();
        let sheets = over.iter().fold(SheetRange::default(), |all, (_, p)| all.union(p.sheets));
        let n = tile.area();
        let (mut k, mut pixels) = self.drawn.take().unwrap_or_else(|| {
            let blank = TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: None };
            (sheets.first, blank)
        });
        let from = k;
        self.lacks.clear();
        while k < sheets.end.min(until) && self.lacks.is_empty() {
            let visible = |p: &Projected| {
                let r = p.rect.intersect(&tile);
                let mut any = !quality.cull;
                for y in r.y0..r.y1 {
                    for x in r.x0..r.x1 {
                        let i = (y - tile.y0) as usize * tile.width() + (x - tile.x0) as usize;
                        any |= !is_shut(pixels.a[i], quality.eps);
                    }
                }
                any
            };
            let lacks = |&(id, p): &(BrickId, Projected), until: i32| {
                let begun = p.sheets.first <= until && p.sheets.end > k;
                begun && !present.contains(&(set, id)) && visible(&p)
            };
            if over.iter().any(|b| lacks(b, k)) {
                let ahead = over.iter().filter(|b| lacks(b, k + 3)).map(|b| b.0);
                self.lacks.extend(ahead);
                break;
            }
            let drawn: Vec<BrickId> = over
                .iter()
                .filter(|(id, p)| {
                    p.sheets.first <= k && present.contains(&(set, *id)) && visible(p)
                })
                .map(|b| b.0)
                .collect();
            let one = SheetRange::new(k, k + 1);
            let state = TileState { a: pixels.a.clone(), last: pixels.last.take() };
            let more = fake::render(&job.projections, quality, tile, one, &drawn, &state);
            for (sum, add) in pixels.colour.iter_mut().zip(&more.colour) {
                for c in 0..3 {
                    sum[c] = sum[c].wrapping_add(add[c]);
                }
            }
            (pixels.a, pixels.last) = (more.a, more.last);
            self.touched.extend(drawn);
            k += 1;
        }
        if k > from {
            self.keeps.clear();
        }
        self.keeps.extend(self.lacks.iter().copied());
        self.drawn = Some((k, pixels));
        k.abs_diff(from)
    }
}

impl Script {
    fn matters(&self) -> bool {
        !matches!(self, Script::Kill(_) | Script::Cancel(FrameId(u64::MAX)))
    }
}

fn sender(event: &Event) -> WorkerId {
    match event {
        Event::Result { worker, .. }
        | Event::HandedOver { worker, .. }
        | Event::Failed { worker, .. }
        | Event::BricksIn { worker, .. }
        | Event::BricksBroken { worker, .. }
        | Event::BricksWanted { worker, .. }
        | Event::BricksForgotten { worker, .. }
        | Event::Pong { worker, .. } => *worker,
        other => panic!("{other:?} is no worker's message"),
    }
}

impl Coming {
    fn is_of(&self, id: WorkerId) -> bool {
        match self {
            Coming::ToWorker(w, _) | Coming::Bricks(w, ..) => *w == id,
            Coming::ToMaster(event) => sender(event) == id,
            Coming::TaskEnd(..) | Coming::Scripted(_) => false,
        }
    }
}
