//! Checks that the scheduler keeps its promises to workers, whatever happens to them.

use crate::outcome::Observer;
use slabcast_common::brick::{BrickGrid, BrickInfo, BrickSetKey};
use slabcast_common::ids::{BrickId, Epoch, FrameId, SceneId, TaskId, WorkerId};
use slabcast_common::message::{DIRECTORIES_KEPT, ToWorker};
use slabcast_common::quality::Schedule;
use slabcast_schedule::{Action, Event, FrameJob, Micros};
use std::collections::{BTreeMap, BTreeSet};

/// State of a worker by the messages that were exchanged: scenes, bricks and leases it was sent.
#[derive(Debug, Default)]
struct Account {
    memory_budget_bytes: u64,
    is_local: bool,
    leaving: bool,
    directories: Vec<BrickSetKey>,
    sent: BTreeSet<(BrickSetKey, BrickId)>,
    scenes: BTreeSet<SceneId>,
    frames: BTreeSet<FrameId>,
    /// Leases without an answer, with the bricks that they name.
    outstanding: BTreeMap<(TaskId, Epoch), (FrameId, Vec<BrickId>)>,
    /// Bytes of the bricks of its largest lease.
    largest_lease_bytes: u64,
}

struct AuditedJob {
    job: Box<FrameJob>,
    /// When it was done or failed, or was cancelled before that.
    is_over: bool,
    is_cancelled: bool,
}

/// An [`Observer`] that panics, with the seed, when the scheduler breaks a promise:
///
/// - a worker is sent a scene before its frames, a frame before its leases, a directory before its
///   regions, each once; nothing after it was dropped; no lease when it leaves;
/// - a task is lent to a worker once at a time; a lease names its bricks in order, and they were
///   sent unless memory is short;
/// - a brick is not sent twice, not dropped under a lease, and dropped only if it was sent;
/// - bricks under the `slab` schedule stay within the worker's memory budget;
/// - frames end once, those of a client in their order, and never after they were cancelled;
/// - progress is reported within bounds.
#[derive(Default)]
pub struct Audit {
    seed: u64,
    accounts: BTreeMap<WorkerId, Account>,
    jobs: BTreeMap<FrameId, AuditedJob>,
    dropped: BTreeSet<WorkerId>,
    /// Workers that the scheduler dropped, with its reasons.
    pub drops: Vec<(WorkerId, String)>,
    /// Frames that failed, with the scheduler's reasons.
    pub failed: BTreeMap<FrameId, String>,
    /// Workers that were shut out for false pixels.
    pub shut_out: Vec<WorkerId>,
    /// Frames that had tiles of such workers.
    pub tainted: Vec<FrameId>,
    /// Pauses of workers that failed again and again, in microseconds.
    pub pauses: Vec<(WorkerId, Micros)>,
    /// Number of leases that were given.
    pub leases_given: u64,
    /// Hash of all actions and their times: two runs of a seed have the same.
    pub log: u64,
}

impl Audit {
    /// Returns an audit of a cluster of this seed, which stands in its messages.
    pub fn new(seed: u64) -> Self {
        Audit { seed, ..Audit::default() }
    }

    /// Returns whether a frame is done, failed or cancelled.
    pub fn is_over(&self, frame: FrameId) -> bool {
        self.jobs.get(&frame).is_some_and(|j| j.is_over)
    }

    /// Returns the job of a frame that was queued.
    pub fn job(&self, frame: FrameId) -> Option<&FrameJob> {
        self.jobs.get(&frame).map(|j| &*j.job)
    }

    /// Checks that nothing is left of any frame.
    ///
    /// # Panics
    /// If a frame has no end, or a worker was not told of one.
    pub fn assert_all_ended(&self) {
        let seed = self.seed;
        for (frame, j) in &self.jobs {
            assert!(j.is_over, "seed {seed}: {frame} has no end");
        }
        for (id, account) in &self.accounts {
            let frames = &account.frames;
            assert!(frames.is_empty(), "seed {seed}: {id} still has {frames:?}");
        }
    }

    fn note(&mut self, what: &str, a: u64, b: u64, now: Micros) {
        for x in what.bytes().map(u64::from).chain([a, b, now]) {
            self.log = (self.log ^ x).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }

    fn bricks_of(&self, set: BrickSetKey) -> Option<&FrameJob> {
        self.jobs.values().map(|j| &*j.job).find(|j| j.scene.bricks == set)
    }

    fn sent_message(&mut self, id: WorkerId, message: &ToWorker) {
        let seed = self.seed;
        assert!(!self.dropped.contains(&id), "seed {seed}: message to dropped {id}");
        if let ToWorker::Directory { set, grid, first, total, bricks } = message {
            let known = self.bricks_of(*set).expect("a set of some job");
            assert_eq!((*first, *total as usize), (0, bricks.len()), "seed {seed}");
            assert!(bricks[..] == known.bricks[..], "seed {seed}: another directory");
            let dims = known.scene.volume.lattice.dims;
            assert_eq!(*grid, BrickGrid::new(dims), "seed {seed}");
        }
        let Some(w) = self.accounts.get_mut(&id) else { return };
        let set_of = |frame: &FrameId| self.jobs[frame].job.scene.bricks;
        match message {
            ToWorker::Scene(scene) => {
                assert!(w.scenes.insert(scene.id), "seed {seed}: scene twice to {id}");
            }
            ToWorker::Frame { frame, scene, finish, plain, .. } => {
                assert!(*plain || !w.is_local, "seed {seed}: nothing to pack for");
                let job = &self.jobs[frame].job;
                let is_region = job.work.schedule != Schedule::Slab;
                assert_eq!(*finish, job.finish.filter(|_| is_region), "seed {seed}");
                assert!(w.scenes.contains(scene), "seed {seed}: frame before its scene");
                assert!(w.frames.insert(*frame), "seed {seed}: frame twice to {id}");
            }
            ToWorker::Lease(lease) => {
                assert!(!w.leaving, "seed {seed}: lease to {id}, which leaves");
                assert!(w.frames.contains(&lease.frame), "seed {seed}: lease before frame");
                assert!(!lease.bricks.is_empty(), "seed {seed}: a lease without bricks");
                assert!(lease.bricks.windows(2).all(|p| p[0] < p[1]), "seed {seed}");
                assert_eq!(lease.state.a.len(), lease.tile.area(), "seed {seed}");
                let set = set_of(&lease.frame);
                let infos = &self.jobs[&lease.frame].job.bricks;
                let mut bytes = 0;
                for &b in &lease.bricks {
                    // With memory to spare it is there or under way; else it may wait for a drop,
                    // and must come later.
                    assert!(
                        w.memory_budget_bytes < u64::MAX || w.sent.contains(&(set, b)),
                        "seed {seed}: lease of {} on {b}, which was not sent to {id}",
                        lease.task,
                    );
                    bytes += brick_bytes(infos, b);
                }
                w.largest_lease_bytes = w.largest_lease_bytes.max(bytes);
                lend(seed, id, w, (lease.task, lease.epoch), (lease.frame, lease.bricks.clone()));
                self.leases_given += 1;
            }
            ToWorker::Directory { set, .. } => {
                assert!(!w.directories.contains(set), "seed {seed}: directory twice");
                w.directories.push(*set);
                if w.directories.len() > DIRECTORIES_KEPT {
                    w.directories.remove(0);
                }
            }
            ToWorker::Region(lease) => {
                assert!(!w.leaving, "seed {seed}: region to {id}, which leaves");
                assert!(w.frames.contains(&lease.frame), "seed {seed}: before its frame");
                let set = set_of(&lease.frame);
                assert!(w.directories.contains(&set), "seed {seed}: before its directory");
                lend(seed, id, w, (lease.task, lease.epoch), (lease.frame, Vec::new()));
                self.leases_given += 1;
            }
            ToWorker::SplitRegion { frame, task, epoch, share } => {
                assert!(w.frames.contains(frame), "seed {seed}: a piece before its frame");
                let is_lent = w.outstanding.contains_key(&(*task, *epoch));
                assert!(is_lent, "seed {seed}: {id} is asked for a piece of nothing");
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
                    assert!(w.sent.remove(&(*set, b)), "seed {seed}: drop of {b}, not sent");
                    let mut leases = w.outstanding.values();
                    let is_needed =
                        leases.any(|(f, ids)| set_of(f) == *set && ids.binary_search(&b).is_ok());
                    assert!(!is_needed, "seed {seed}: {b} dropped under a lease of {id}");
                }
            }
            ToWorker::Ping { .. } => {}
            other => panic!("seed {seed}: {other:?} is the driver's to send"),
        }
    }
}

fn brick_bytes(infos: &[BrickInfo], id: BrickId) -> u64 {
    infos.binary_search_by_key(&id, |b| b.id).map_or(0, |i| u64::from(infos[i].bytes))
}

fn lend(
    seed: u64,
    id: WorkerId,
    w: &mut Account,
    key: (TaskId, Epoch),
    what: (FrameId, Vec<BrickId>),
) {
    assert!(w.outstanding.insert(key, what).is_none(), "seed {seed}: twice");
    let same_task = w.outstanding.keys().filter(|k| k.0 == key.0).count();
    assert_eq!(same_task, 1, "seed {seed}: {} twice to {id}", key.0);
}

impl Observer for Audit {
    fn event(&mut self, _: Micros, event: &Event) {
        match event {
            Event::WorkerJoined { worker, is_local, memory_budget_bytes, held, .. } => {
                let sent = held.iter().flat_map(|(set, ids)| ids.iter().map(|&b| (*set, b)));
                let account = Account {
                    memory_budget_bytes: *memory_budget_bytes,
                    is_local: *is_local,
                    sent: sent.collect(),
                    ..Account::default()
                };
                self.accounts.insert(*worker, account);
            }
            Event::FrameQueued(job) => {
                let job = job.clone();
                let audited = AuditedJob { job, is_over: false, is_cancelled: false };
                self.jobs.insert(audited.job.frame, audited);
            }
            Event::CancelFrame { frame } => {
                if let Some(j) = self.jobs.get_mut(frame).filter(|j| !j.is_over) {
                    (j.is_over, j.is_cancelled) = (true, true);
                }
            }
            Event::WorkerLost { worker, .. } => {
                self.accounts.remove(worker);
            }
            Event::WorkerLeaving { worker } => {
                if let Some(w) = self.accounts.get_mut(worker) {
                    w.leaving = true;
                }
            }
            Event::Result { worker, result } => {
                if let Some(w) = self.accounts.get_mut(worker) {
                    w.outstanding.remove(&(result.task, result.epoch));
                }
            }
            Event::Failed { worker, task, epoch, .. } => {
                if let Some(w) = self.accounts.get_mut(worker) {
                    w.outstanding.remove(&(*task, *epoch));
                }
            }
            Event::BricksForgotten { worker, set, bricks }
            | Event::BricksBroken { worker, set, bricks } => {
                if let Some(w) = self.accounts.get_mut(worker) {
                    for &b in bricks {
                        // A broken one may have been taken for one of the good ones that were
                        // counted before, and dropped.
                        w.sent.remove(&(*set, b));
                    }
                }
            }
            _ => {}
        }
    }

    fn action(&mut self, now: Micros, action: &Action) {
        let seed = self.seed;
        match action {
            Action::Send { worker, message } => {
                self.note("send", worker.0, 0, now);
                self.sent_message(*worker, message);
            }
            Action::SendBricks { worker, set, bricks } => {
                self.note("bricks", worker.0, bricks.len() as u64, now);
                let Some(w) = self.accounts.get_mut(worker) else { return };
                assert!(!bricks.is_empty(), "seed {seed}: an empty batch");
                for &b in bricks {
                    assert!(w.sent.insert((*set, b)), "seed {seed}: {b} sent to {worker} again");
                }
            }
            Action::Drop { worker, reason } => {
                self.note("drop", worker.0, 0, now);
                self.accounts.remove(worker);
                self.dropped.insert(*worker);
                self.drops.push((*worker, reason.clone()));
            }
            Action::Progress { frame, done, total, slab, slabs } => {
                assert!(done <= total && slab < slabs, "seed {seed}: progress of {frame}");
            }
            Action::Finished { frame, .. } => {
                let finish = self.jobs[frame].job.finish;
                assert!(finish.is_some(), "seed {seed}: finished tiles of {frame}");
            }
            Action::FrameDone { frame, .. } => {
                self.note("done", frame.0, 0, now);
                let client = self.jobs[frame].job.client;
                let is_before = |j: &AuditedJob| j.job.client == client && !j.is_over;
                let first = self.jobs.iter().find(|(_, j)| is_before(j)).map(|(f, _)| *f);
                assert!(first.is_none_or(|f| f >= *frame), "seed {seed}: {frame} before {first:?}");
                let j = self.jobs.get_mut(frame).expect("a frame that was queued");
                assert!(!j.is_cancelled, "seed {seed}: {frame} was cancelled");
                assert!(!std::mem::replace(&mut j.is_over, true), "seed {seed}: {frame} twice");
            }
            Action::FrameFailed { frame, reason, .. } => {
                self.note("failed", frame.0, 0, now);
                self.jobs.get_mut(frame).expect("a frame that was queued").is_over = true;
                self.failed.insert(*frame, reason.clone());
            }
            Action::ShutOut { worker, frame, .. } => {
                self.note("shut out", worker.0, frame.0, now);
                self.accounts.remove(worker);
                self.dropped.insert(*worker);
                self.shut_out.push(*worker);
            }
            Action::FrameTainted { frame } => {
                self.note("tainted", frame.0, 0, now);
                let j = self.jobs.get_mut(frame).expect("a frame that was queued");
                assert!(!std::mem::replace(&mut j.is_over, true), "seed {seed}: {frame} twice");
                self.tainted.push(*frame);
            }
            Action::Paused { worker, pause_us, .. } => {
                self.note("paused", worker.0, *pause_us, now);
                self.pauses.push((*worker, *pause_us));
            }
        }
    }

    fn bricks_held(&mut self, worker: WorkerId, bytes: u64) {
        let Some(w) = self.accounts.get(&worker) else { return };
        // A worker that draws regions makes room itself.
        if w.memory_budget_bytes == u64::MAX || !w.directories.is_empty() {
            return;
        }
        let allowed = w.memory_budget_bytes.max(w.largest_lease_bytes);
        assert!(
            bytes <= allowed,
            "seed {}: {worker} has {bytes} bytes of bricks, its budget is {}",
            self.seed,
            w.memory_budget_bytes,
        );
    }
}
