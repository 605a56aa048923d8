//! The task queue of one phase (a slab, or all regions of a frame): largest task first, and leases
//! with attempt epochs.
//!
//! A task may be out on several leases: its worker was lost, is late, or leaves. Each lease has its
//! own epoch. The first result with a live epoch counts and ends all others; later ones are counted
//! and dropped (docs/design/cluster.md section 3, Leases).
//!
//! **Which task kills workers?** A lost worker tells nothing. Its first leases, as many as it has
//! threads, were probably running, and each of them is a suspect. With several threads an innocent
//! neighbour is blamed along with the culprit, and if both went on together they would be condemned
//! together. So a suspect is never lent to a worker that has another, and when a worker is lost
//! with a suspect on it, only those blamed most before are blamed again.
//!
//! **When is a task given up?** Never while a worker is linked that has not failed at it. Workers
//! are told apart by what they are over all their links ([`WorkerIdentity`]), so that one that
//! comes back after each crash counts once. Between tries of a task there are pauses, each twice as
//! long as the one before: whatever makes workers fail may pass, and a better worker may come. Only
//! when every linked worker has failed at a task, and it was tried often enough, its frame fails
//! ([`TaskQueue::hopeless`]).

use crate::policy::macrotile::Macrotile;
use crate::state::audits::{Audit, Drawn, Verdict as AuditEnd};
use crate::{Config, Micros, WorkerIdentity};
use slabcast_common::ids::{Epoch, TaskId, WorkerId};
use slabcast_common::message::Checkpoint;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Limit: pause before the third try of a task, in microseconds. The second try follows at once:
/// most losses have nothing to do with a task. Later pauses are twice as long each, up to the
/// longest.
const FIRST_PAUSE_US: Micros = 100_000;
const LONGEST_PAUSE_US: Micros = 2_000_000;

/// Limit: time in microseconds for which a task that workers failed at waits for the workers that
/// are likeliest to draw it. Then any worker may try, lest it waits for one that hangs.
const CHOOSY_US: Micros = 5_000_000;

/// A live lease: its result would count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Lease {
    pub(crate) worker: WorkerId,
    pub(crate) epoch: Epoch,
    pub(crate) sent: Micros,
    /// When another worker gets the task too; `None` once that happened.
    deadline: Option<Micros>,
}

/// End of a task.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum End {
    /// No result yet.
    Open,
    /// Rendered.
    Done { worker: Arc<str>, render_us: Micros },
}

/// A worker that failed at a task.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Failure {
    pub(crate) who: Arc<WorkerIdentity>,
    /// Number of failures.
    pub(crate) times: u32,
    /// Reason the worker gave when it refused the task last; `None` if its link was lost instead.
    pub(crate) said: Option<String>,
}

/// One tile to render.
#[derive(Clone, Debug)]
pub(crate) struct Task {
    pub(crate) tile: Macrotile,
    pub(crate) end: End,
    leases: Vec<Lease>,
    attempts: u32,
    /// Key in the queue's order while the task waits.
    queued: Option<i64>,
    /// Workers that were lost with it or refused it, each once.
    pub(crate) failures: Vec<Failure>,
    /// Number of times that a worker was lost while it was probably running the task.
    blamed: u32,
    /// While it waits after a failure: until when only the likeliest workers may try it.
    choosy_until: Option<Micros>,
    /// Results that wait to be compared; `None`: the first one counts.
    audit: Option<Audit>,
    /// State in which another worker gave the piece away; `None`: it starts from nothing.
    pub(crate) begun: Option<Arc<Checkpoint>>,
}

impl Task {
    fn new(tile: Macrotile, order: i64) -> Task {
        Task {
            tile,
            end: End::Open,
            leases: Vec::new(),
            attempts: 0,
            queued: Some(order),
            failures: Vec::new(),
            blamed: 0,
            choosy_until: None,
            audit: None,
            begun: None,
        }
    }

    /// Whether a speculative copy may be made: one worker has it, none was lost with it.
    pub(crate) fn may_speculate(&self) -> bool {
        self.leases.len() == 1 && self.queued.is_none() && self.failures.is_empty()
    }

    /// Whether any worker was lent it.
    pub(crate) fn was_leased(&self) -> bool {
        self.attempts > 0
    }

    fn is_suspect(&self) -> bool {
        self.blamed > 0
    }

    /// Whether a worker's lease of the task is before its deadline; `None` if the worker has no
    /// lease of the task.
    pub(crate) fn expects(&self, worker: WorkerId) -> Option<bool> {
        self.leases.iter().find(|l| l.worker == worker).map(|l| l.deadline.is_some())
    }

    /// Whether two workers draw it.
    pub(crate) fn is_audited(&self) -> bool {
        self.audit.is_some()
    }

    pub(crate) fn audit(&self) -> Option<&Audit> {
        self.audit.as_ref()
    }

    /// Returns the number of times that workers failed at the task.
    pub(crate) fn tries(&self) -> u32 {
        self.failures.iter().fold(0, |sum, f| sum.saturating_add(f.times))
    }

    /// Returns whether a worker failed at the task, on this link or an earlier one.
    pub(crate) fn was_failed_by(&self, who: &WorkerIdentity) -> bool {
        self.failures.iter().any(|f| *f.who == *who)
    }

    /// Whether only the likeliest of the workers may try it now.
    pub(crate) fn is_choosy(&self) -> bool {
        self.choosy_until.is_some()
    }

    fn add_failure(&mut self, who: &Arc<WorkerIdentity>, said: Option<String>) {
        match self.failures.iter_mut().find(|f| f.who == *who) {
            Some(failure) => {
                failure.times = failure.times.saturating_add(1);
                failure.said = said.or(failure.said.take());
            }
            None => self.failures.push(Failure { who: who.clone(), times: 1, said }),
        }
    }
}

/// Whether a result counts.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The result counts: index of its task, and the lease that it answers.
    Counts(u32, Lease),
    /// The result is late or a duplicate.
    Dead,
}

/// The tasks of one phase.
#[derive(Debug)]
pub(crate) struct TaskQueue {
    first: TaskId,
    pub(crate) tasks: Vec<Task>,
    /// Indices of waiting tasks, in the order in which they are lent.
    waiting: BTreeMap<i64, u32>,
    /// Key of the next task that is put in front of all.
    front: i64,
    deadlines: BTreeSet<(Micros, u32, Epoch)>,
    /// Tasks that are not lent before a time, after failures.
    paused: BTreeSet<(Micros, u32)>,
    /// Open tasks that workers failed at.
    troubled: BTreeSet<u32>,
    /// Open tasks with results that wait to be compared.
    held: BTreeSet<u32>,
    open: u32,
    /// Leases beyond the first of a task.
    pub(crate) retries: u64,
}

impl TaskQueue {
    /// Makes a queue of tiles in this order; their ids count up from `first`.
    pub(crate) fn new(first: TaskId, tiles: &[Macrotile]) -> Self {
        let task = |(&tile, order): (&Macrotile, i64)| Task::new(tile, order);
        TaskQueue {
            first,
            tasks: tiles.iter().zip(0..).map(task).collect(),
            waiting: (0..).zip(0..tiles.len() as u32).collect(),
            front: -1,
            deadlines: BTreeSet::new(),
            open: tiles.len() as u32,
            paused: BTreeSet::new(),
            troubled: BTreeSet::new(),
            held: BTreeSet::new(),
            retries: 0,
        }
    }

    /// Returns the number of tasks without an end.
    pub(crate) fn open(&self) -> u32 {
        self.open
    }

    /// Returns the number of tasks.
    pub(crate) fn all(&self) -> u32 {
        self.tasks.len() as u32
    }

    /// Queues a piece of a tile in front of all. Returns its index. The caller reserves its id.
    pub(crate) fn add_piece(&mut self, piece: Macrotile, begun: Arc<Checkpoint>) -> u32 {
        let place = self.tasks.len() as u32;
        let mut task = Task::new(piece, self.front);
        task.begun = Some(begun);
        self.waiting.insert(self.front, place);
        self.front -= 1;
        self.open += 1;
        self.tasks.push(task);
        place
    }

    /// Whether this is the task's only lease and no other worker is to get the task. False for
    /// tasks that were refused or lost a worker.
    pub(crate) fn is_only_lease(&self, place: u32, worker: WorkerId, epoch: Epoch) -> bool {
        let task = &self.tasks[place as usize];
        task.may_speculate()
            && !task.is_audited()
            && task.leases.iter().all(|l| l.worker == worker && l.epoch == epoch)
    }

    /// Ends a lease without a result, through no fault of its worker.
    pub(crate) fn release(&mut self, place: u32, worker: WorkerId, epoch: Epoch) {
        self.end_lease(place, worker, epoch);
        if self.tasks[place as usize].leases.is_empty() {
            self.requeue(place);
        }
    }

    /// Returns the number of waiting tasks.
    pub(crate) fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Returns the indices of waiting tasks, in order.
    pub(crate) fn all_waiting(&self) -> impl Iterator<Item = u32> {
        self.waiting.values().copied()
    }

    /// Whether any of these tasks waits.
    pub(crate) fn any_waiting(&self, places: &[u32]) -> bool {
        places.iter().any(|&place| self.tasks[place as usize].queued.is_some())
    }

    /// Returns the id of the task at an index.
    pub(crate) fn id(&self, place: u32) -> TaskId {
        TaskId(self.first.0 + u64::from(place))
    }

    /// Returns the index of a task id; `None` if it is not of this queue.
    pub(crate) fn place(&self, id: TaskId) -> Option<u32> {
        let place = id.0.checked_sub(self.first.0)?;
        (place < self.tasks.len() as u64).then_some(place as u32)
    }

    /// Returns the first waiting task with `among` and `suits` that a worker may have. `mine`:
    /// tasks it has leases of. `may_try`: whether it may try a task that workers failed at.
    pub(crate) fn next_for(
        &self,
        mine: impl Fn() -> Vec<u32>,
        among: impl Fn(u32) -> bool,
        may_try: impl Fn(&Task) -> bool,
        suits: impl Fn(u32) -> bool,
    ) -> Option<u32> {
        let fits = self.fits(mine, may_try);
        self.waiting.values().copied().find(|&place| among(place) && fits(place) && suits(place))
    }

    /// Returns a test for whether a worker may have a task: not one it has, not one that it may not
    /// try, and no second suspect.
    fn fits(
        &self,
        mine: impl Fn() -> Vec<u32>,
        may_try: impl Fn(&Task) -> bool,
    ) -> impl Fn(u32) -> bool {
        move |place| {
            let task = &self.tasks[place as usize];
            // Nobody has it, was lost with it or refused it.
            if !task.was_leased() {
                return true;
            }
            let mine = mine();
            let has_suspect = mine.iter().any(|&p| self.tasks[p as usize].is_suspect());
            let has_it = mine.contains(&place);
            let two_suspects = has_suspect && task.is_suspect();
            let is_plain = task.failures.is_empty() && task.audit.is_none();
            !(has_it || two_suspects) && (is_plain || may_try(task))
        }
    }

    /// Returns the first of the waiting tasks among `places` that the worker may have. Faster than
    /// [`Self::next_for`] for a worker with a list of its own.
    pub(crate) fn next_among(
        &self,
        mine: impl Fn() -> Vec<u32>,
        places: &[u32],
        may_try: impl Fn(&Task) -> bool,
    ) -> Option<u32> {
        let fits = self.fits(mine, may_try);
        let waits = |&place: &u32| Some((self.tasks[place as usize].queued?, place));
        let may = places.iter().filter_map(waits).filter(|&(_, place)| fits(place));
        may.min().map(|(_, place)| place)
    }

    /// Lends a waiting task.
    pub(crate) fn lease(
        &mut self,
        place: u32,
        worker: WorkerId,
        now: Micros,
        config: &Config,
    ) -> Epoch {
        let task = &mut self.tasks[place as usize];
        let order = task.queued.take().expect("only a waiting task is lent");
        task.choosy_until = None;
        self.waiting.remove(&order);
        self.add_lease(place, worker, now, config)
    }

    /// Lends a task to a second worker while a first one has it: a speculative copy.
    pub(crate) fn lease_again(
        &mut self,
        place: u32,
        worker: WorkerId,
        now: Micros,
        config: &Config,
    ) -> Epoch {
        self.add_lease(place, worker, now, config)
    }

    fn add_lease(&mut self, place: u32, worker: WorkerId, now: Micros, config: &Config) -> Epoch {
        let task = &mut self.tasks[place as usize];
        let epoch = Epoch(task.attempts);
        self.retries += u64::from(task.attempts > 0);
        let patience = config.lease.saturating_mul(1 << task.attempts.min(20));
        let deadline = now.saturating_add(patience);
        task.attempts += 1;
        task.leases.push(Lease { worker, epoch, sent: now, deadline: Some(deadline) });
        self.deadlines.insert((deadline, place, epoch));
        epoch
    }

    /// Judges a result from `worker`. Changes nothing.
    pub(crate) fn judge(&self, id: TaskId, epoch: Epoch, worker: WorkerId) -> Verdict {
        let Some(place) = self.place(id) else { return Verdict::Dead };
        let leases = &self.tasks[place as usize].leases;
        match leases.iter().find(|l| l.epoch == epoch && l.worker == worker) {
            Some(&lease) => Verdict::Counts(place, lease),
            None => Verdict::Dead,
        }
    }

    /// Ends a task and all its leases.
    pub(crate) fn finish(&mut self, place: u32, end: End) {
        let task = &mut self.tasks[place as usize];
        assert!(task.end == End::Open, "a task ends once");
        task.end = end;
        self.open -= 1;
        for leases in task.leases.drain(..) {
            if let Some(deadline) = leases.deadline {
                self.deadlines.remove(&(deadline, place, leases.epoch));
            }
        }
        if let Some(order) = task.queued.take() {
            self.waiting.remove(&order);
        }
        self.held.remove(&place);
        if self.troubled.remove(&place) {
            self.paused.retain(|(_, paused)| *paused != place);
        }
    }

    /// Ends one lease without a result.
    fn end_lease(&mut self, place: u32, worker: WorkerId, epoch: Epoch) {
        let task = &mut self.tasks[place as usize];
        let Some(at) = task.leases.iter().position(|l| l.worker == worker && l.epoch == epoch)
        else {
            return;
        };
        if let Some(deadline) = task.leases.remove(at).deadline {
            self.deadlines.remove(&(deadline, place, epoch));
        }
    }

    /// Puts a task in front of all, unless it waits already.
    fn requeue(&mut self, place: u32) {
        let task = &mut self.tasks[place as usize];
        if task.end == End::Open && task.queued.is_none() {
            task.queued = Some(self.front);
            self.waiting.insert(self.front, place);
            self.front -= 1;
        }
    }

    /// Takes back the leases of a lost worker, given in the order in which it got them. The first
    /// `running` of them are blamed.
    pub(crate) fn lose(
        &mut self,
        worker: WorkerId,
        who: &Arc<WorkerIdentity>,
        leases: &[(u32, Epoch)],
        running: usize,
        now: Micros,
    ) {
        let mut head: Vec<u32> = leases.iter().take(running).map(|l| l.0).collect();
        head.retain(|&p| self.tasks[p as usize].end == End::Open);
        let most = head.iter().map(|&p| self.tasks[p as usize].blamed).max().unwrap_or(0);
        for &place in &head {
            let task = &mut self.tasks[place as usize];
            if task.blamed == most {
                task.blamed = task.blamed.saturating_add(1);
                task.add_failure(who, None);
                self.troubled.insert(place);
            }
        }
        self.take_back(worker, leases, now);
    }

    /// Takes back a task that a worker refused, for `reason`.
    pub(crate) fn fail(
        &mut self,
        place: u32,
        epoch: Epoch,
        worker: WorkerId,
        who: &Arc<WorkerIdentity>,
        reason: String,
        now: Micros,
    ) {
        self.tasks[place as usize].add_failure(who, Some(reason));
        self.troubled.insert(place);
        self.take_back(worker, &[(place, epoch)], now);
    }

    /// Ends leases and puts their tasks in front in their old order; those that workers failed at
    /// more than once only after a pause. A task with another live lease goes on with that one.
    fn take_back(&mut self, worker: WorkerId, leases: &[(u32, Epoch)], now: Micros) {
        for &(place, epoch) in leases.iter().rev() {
            self.end_lease(place, worker, epoch);
            let task = &mut self.tasks[place as usize];
            if task.end != End::Open || !task.leases.is_empty() || task.queued.is_some() {
                continue;
            }
            let tries = task.tries();
            if tries > 0 {
                let doubled = FIRST_PAUSE_US << tries.saturating_sub(2).min(20);
                let pause = if tries == 1 { 0 } else { doubled.min(LONGEST_PAUSE_US) };
                task.choosy_until = Some(now.saturating_add(pause).saturating_add(CHOOSY_US));
                if pause > 0 {
                    self.paused.insert((now.saturating_add(pause), place));
                    continue;
                }
            }
            self.requeue(place);
        }
    }

    /// Queues tasks whose pause is over, and lets any worker try those that have waited for the
    /// likeliest for long.
    pub(crate) fn end_pauses(&mut self, now: Micros) {
        while let Some(&(until, place)) = self.paused.first()
            && until <= now
        {
            self.paused.pop_first();
            self.requeue(place);
        }
        for place in &self.troubled {
            let task = &mut self.tasks[*place as usize];
            task.choosy_until = task.choosy_until.filter(|until| now < *until);
        }
    }

    /// Has a task audited.
    pub(crate) fn audit(&mut self, place: u32) {
        self.tasks[place as usize].audit = Some(Audit::default());
    }

    /// Removes the votes of a worker that drew false pixels from all tasks.
    pub(crate) fn forget_votes(&mut self, who: &WorkerIdentity) {
        let tasks = &mut self.tasks;
        self.held.retain(|p| tasks[*p as usize].audit.as_mut().is_some_and(|a| a.forget(who)));
    }

    /// Takes a result of a task. One that is not audited, or whose audit it ends, is done with the
    /// verdict; else it waits for another worker.
    pub(crate) fn vote(&mut self, place: u32, drawn: Drawn, now: Micros) -> Option<AuditEnd> {
        let task = &mut self.tasks[place as usize];
        let Some(audit) = &mut task.audit else {
            let (agreed, liars) = (Vec::new(), Vec::new());
            return Some(AuditEnd { truth: drawn, agreed, liars });
        };
        let (worker, epoch) = (drawn.worker, drawn.epoch);
        let end = audit.add(drawn, now);
        if end.is_none() {
            self.held.insert(place);
            self.release(place, worker, epoch);
        }
        end
    }

    /// Returns the open tasks whose results wait to be compared.
    pub(crate) fn held(&self) -> impl Iterator<Item = u32> {
        self.held.iter().copied()
    }

    /// Takes the only result of a task that nobody can compare.
    pub(crate) fn take_sole_vote(&mut self, place: u32) -> Option<Drawn> {
        self.tasks[place as usize].audit.as_mut()?.take_sole()
    }

    /// Returns the open tasks that workers failed at and nobody has now.
    pub(crate) fn troubled(&self) -> impl Iterator<Item = u32> {
        let is_free = |place: &u32| self.tasks[*place as usize].leases.is_empty();
        self.troubled.iter().copied().filter(is_free)
    }

    /// Whether a task is given up: every one of the linked workers failed at it, and it was tried
    /// at least twice as often as the rule asks for workers, or four times as often by fewer.
    /// False while no worker is linked.
    pub(crate) fn hopeless<'a>(
        &self,
        place: u32,
        mut linked: impl Iterator<Item = &'a WorkerIdentity>,
        config: &Config,
    ) -> bool {
        let task = &self.tasks[place as usize];
        let (workers, limit) = (task.failures.len(), config.poison_after.max(1));
        let factor = if workers >= limit as usize { 2 } else { 4 };
        let Some(first) = linked.next() else { return false };
        task.tries() >= limit.saturating_mul(factor)
            && task.was_failed_by(first)
            && linked.all(|who| task.was_failed_by(who))
    }

    /// Requeues tasks that a leaving worker has not begun; its leases stay live.
    pub(crate) fn share_queued(&mut self, places: &[u32]) {
        for &place in places.iter().rev() {
            self.requeue(place);
        }
    }

    /// Requeues tasks of a worker that says nothing, for others; its leases stay live. Not those
    /// that workers failed at: they would take two at once.
    pub(crate) fn share_unless_troubled(&mut self, places: &[u32]) {
        for &place in places.iter().rev() {
            if self.tasks[place as usize].may_speculate() {
                self.requeue(place);
            }
        }
    }

    /// Takes tasks out of the queue again whose worker is heard again and that nobody else was
    /// lent.
    pub(crate) fn unshare(&mut self, worker: WorkerId, places: &[u32]) {
        for &place in places {
            let task = &mut self.tasks[place as usize];
            // One that is overdue still goes to another.
            let has_time = |l: &Lease| l.worker == worker && l.deadline.is_some();
            if task.leases.len() == 1 && task.leases.iter().all(has_time) {
                let order = task.queued.take();
                order.map(|order| self.waiting.remove(&order));
            }
        }
    }

    /// Requeues tasks whose lease is past its deadline, for another worker.
    pub(crate) fn requeue_overdue(&mut self, now: Micros) {
        while let Some(&(deadline, place, epoch)) = self.deadlines.first()
            && deadline <= now
        {
            self.deadlines.pop_first();
            let task = &mut self.tasks[place as usize];
            for leases in task.leases.iter_mut().filter(|l| l.epoch == epoch) {
                leases.deadline = None;
            }
            self.requeue(place);
        }
    }

    /// Returns the next time at which a lease ends, a pause is over or any worker may try a task.
    pub(crate) fn next_deadline(&self) -> Option<Micros> {
        let choosy = self.troubled.iter().filter_map(|p| self.tasks[*p as usize].choosy_until);
        let held = self.held.iter().filter_map(|p| self.tasks[*p as usize].audit()?.deadline());
        let first = [self.deadlines.first().map(|d| d.0), self.paused.first().map(|p| p.0)];
        first.into_iter().flatten().chain(choosy).chain(held).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::occlusion::Rect;

    fn queue(n: u64) -> TaskQueue {
        let tiles: Vec<_> =
            (0..n).map(|i| Macrotile { rect: Rect::new(0, 0, 16, 16), est: 100 - i }).collect();
        TaskQueue::new(TaskId(10), &tiles)
    }

    fn next(q: &TaskQueue, mine: &[u32]) -> Option<u32> {
        q.next_for(|| mine.to_vec(), |_| true, |_| true, |_| true)
    }

    fn who(name: &str) -> Arc<WorkerIdentity> {
        Arc::new(WorkerIdentity { host: "here".into(), name: name.into() })
    }

    /// Loses a worker at a time, with leases of which it ran so many.
    fn lose(q: &mut TaskQueue, w: u64, leases: &[(u32, Epoch)], running: usize, now: Micros) {
        q.lose(WorkerId(w), &who(&format!("w{w}")), leases, running, now);
    }

    fn take(q: &mut TaskQueue, w: u64, mine: &[u32], now: Micros) -> (u32, Epoch) {
        let place = next(q, mine).expect("something waits");
        (place, q.lease(place, WorkerId(w), now, &Config::default()))
    }

    fn done() -> End {
        End::Done { worker: "".into(), render_us: 1 }
    }

    #[test]
    fn queue_lends_returned_tasks_first_then_the_largest() {
        let mut q = queue(4);
        assert_eq!(take(&mut q, 1, &[], 0), (0, Epoch(0)));
        assert_eq!(take(&mut q, 1, &[0], 0), (1, Epoch(0)));
        assert_eq!(take(&mut q, 2, &[], 0), (2, Epoch(0)));
        lose(&mut q, 1, &[(0, Epoch(0)), (1, Epoch(0))], 1, 0);
        assert_eq!(q.tasks[0].tries(), 1);
        assert_eq!(q.tasks[1].tries(), 0, "it was not running yet");
        assert_eq!(take(&mut q, 3, &[], 0), (0, Epoch(1)));
        assert_eq!(take(&mut q, 3, &[0], 0), (1, Epoch(1)));
        assert_eq!(take(&mut q, 3, &[0, 1], 0), (3, Epoch(0)));
        assert_eq!(q.retries, 2);
        assert_eq!(q.judge(TaskId(10), Epoch(0), WorkerId(1)), Verdict::Dead);
        assert_eq!(q.judge(TaskId(10), Epoch(1), WorkerId(2)), Verdict::Dead, "not its lease");
        assert!(matches!(q.judge(TaskId(10), Epoch(1), WorkerId(3)), Verdict::Counts(0, _)));
        assert_eq!(q.judge(TaskId(9), Epoch(0), WorkerId(3)), Verdict::Dead);
        assert_eq!(q.judge(TaskId(14), Epoch(0), WorkerId(3)), Verdict::Dead);
    }

    #[test]
    fn next_among_agrees_with_a_search_of_all_waiting_tasks() {
        let c = Config::default();
        let mut q = queue(6);
        let same = |q: &TaskQueue, own: &[u32], mine: &[u32]| {
            let mine = || mine.to_vec();
            let all = q.next_for(mine, |p| own.contains(&p), |_| true, |_| true);
            assert_eq!(q.next_among(mine, own, |_| true), all);
            assert_eq!(q.any_waiting(own), own.iter().any(|p| q.all_waiting().any(|w| w == *p)));
            all
        };
        assert_eq!(same(&q, &[5, 2, 4], &[]), Some(2), "the first in the queue, not in the list");
        q.lease(2, WorkerId(1), 0, &c);
        q.lease(5, WorkerId(2), 0, &c);
        assert_eq!(same(&q, &[5, 2, 4], &[2]), Some(4));
        assert_eq!(same(&q, &[5, 2], &[2]), None);
        // Tasks that come back are ahead of all others, the last one first.
        lose(&mut q, 2, &[(5, Epoch(0))], 0, 0);
        q.share_queued(&[2]);
        assert_eq!(q.all_waiting().collect::<Vec<_>>(), [2, 5, 0, 1, 3, 4]);
        assert_eq!(same(&q, &[4, 2, 5], &[2]), Some(5), "it has the first");
        q.finish(2, done());
        assert_eq!((q.waiting(), same(&q, &[2], &[])), (5, None));
    }

    #[test]
    fn lease_expires_and_stays_live_until_one_of_two_wins() {
        let c = Config::default();
        let mut q = queue(1);
        take(&mut q, 1, &[], 0);
        assert_eq!(q.next_deadline(), Some(c.lease));
        q.requeue_overdue(c.lease);
        assert_eq!(next(&q, &[0]), None, "another worker, not the same");
        assert_eq!(take(&mut q, 2, &[], c.lease), (0, Epoch(1)));
        assert_eq!(q.next_deadline(), Some(c.lease + 2 * c.lease), "doubled");
        assert!(matches!(q.judge(TaskId(10), Epoch(0), WorkerId(1)), Verdict::Counts(..)));
        q.finish(0, done());
        assert_eq!(q.judge(TaskId(10), Epoch(1), WorkerId(2)), Verdict::Dead);
        assert_eq!((q.open(), q.next_deadline()), (0, None));
    }

    #[test]
    fn leaving_worker_shares_tasks_it_has_not_begun() {
        let mut q = queue(4);
        for mine in [&[][..], &[0], &[0, 1]] {
            take(&mut q, 1, mine, 0);
        }
        q.share_queued(&[1, 2]);
        assert_eq!(take(&mut q, 2, &[], 0), (1, Epoch(1)));
        assert!(matches!(q.judge(TaskId(11), Epoch(0), WorkerId(1)), Verdict::Counts(1, _)));
        // It had begun it after all.
        q.finish(2, done());
        assert_eq!(take(&mut q, 2, &[1], 0), (3, Epoch(0)));
    }

    #[test]
    fn pauses_between_tries_of_a_task_grow() {
        let mut q = queue(1);
        let (mut now, mut pauses) = (0, Vec::new());
        for w in 1..=8 {
            let lease = take(&mut q, w, &[], now);
            lose(&mut q, w, &[lease], 1, now);
            let lost = now;
            while next(&q, &[]).is_none() {
                now = q.next_deadline().expect("the end of its pause");
                q.end_pauses(now);
            }
            pauses.push((now - lost) / 1000);
        }
        assert_eq!(pauses, [0, 100, 200, 400, 800, 1600, 2000, 2000]);
    }

    #[test]
    fn one_worker_that_crashes_again_and_again_is_one_witness() {
        let c = Config::default();
        let mut q = queue(1);
        let (crashes, fresh) = (who("crashes"), who("fresh"));
        for link in 1..=12 {
            let both = || [&*crashes, &*fresh].into_iter();
            assert!(!q.hopeless(0, [&*crashes].into_iter(), &c), "after {} tries", link - 1);
            q.end_pauses(1000 * LONGEST_PAUSE_US);
            let (place, epoch) = take(&mut q, link, &[], 0);
            q.lose(WorkerId(link), &crashes, &[(place, epoch)], 1, 0);
            assert!(!q.hopeless(0, both(), &c), "a fresh worker has not tried");
            assert!(!q.hopeless(0, std::iter::empty(), &c), "nobody is there to try");
        }
        assert_eq!(q.tasks[0].failures.len(), 1);
        assert!(q.hopeless(0, [&*crashes].into_iter(), &c));
    }

    #[test]
    fn task_is_hopeless_once_all_linked_workers_failed_at_it_twice() {
        let c = Config::default();
        let mut q = queue(1);
        let names = ["a", "b", "c"].map(who);
        for round in 0..2 {
            for (name, w) in names.iter().zip(1..) {
                assert!(!q.hopeless(0, names.iter().map(|n| &**n), &c), "round {round}");
                q.end_pauses(1000 * LONGEST_PAUSE_US);
                let (place, epoch) = take(&mut q, w, &[], 0);
                q.fail(place, epoch, WorkerId(w), name, "no".into(), 0);
            }
        }
        assert!(q.hopeless(0, names.iter().map(|n| &**n), &c));
        assert!(!q.hopeless(0, [&*who("d")].into_iter(), &c), "it may do better");
        assert_eq!(q.troubled().collect::<Vec<_>>(), [0]);
        q.finish(0, done());
        assert_eq!((q.troubled().count(), q.next_deadline()), (0, None));
    }

    #[test]
    fn poison_blame_spares_the_neighbour_of_a_deadly_task() {
        // Workers of two threads; task 0 kills whoever runs it, tasks 1 and up are harmless.
        let mut q = queue(6);
        for w in 1..=6 {
            q.end_pauses(1000 * LONGEST_PAUSE_US);
            let a = take(&mut q, w, &[], 0);
            let b = take(&mut q, w, &[a.0], 0);
            assert_eq!(a.0, 0);
            assert!(!(q.tasks[a.0 as usize].is_suspect() && q.tasks[b.0 as usize].is_suspect()));
            lose(&mut q, w, &[a, b], 2, 0);
        }
        assert_eq!(q.tasks[0].tries(), 6);
        assert!(q.tasks[1..].iter().all(|t| t.tries() <= 1));
    }
}
