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
//! A cluster may also lose workers for reasons of its own (docs/design/promises.md R1 kills 7 of 8
//! in one frame): a tile that three of them happened to hold is innocent. A deadly tile is held by
//! every worker that is lost. So each loss that a tile has an alibi for asks for one more witness
//! against it, up to twice as many.

use crate::policy::macrotile::Macrotile;
use crate::{Config, Micros};
use slabcast_common::ids::{Epoch, TaskId, WorkerId};
use slabcast_common::message::Checkpoint;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A live lease: its result would count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Lease {
    pub(crate) worker: WorkerId,
    pub(crate) epoch: Epoch,
    pub(crate) sent: Micros,
    /// When another worker gets the task too; `None` once that happened.
    deadline: Option<Micros>,
}

/// How a task ended.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum End {
    /// No result yet.
    Open,
    /// Rendered.
    Done { worker: Arc<str>, render_us: Micros },
    /// Given up.
    Poisoned,
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
    /// Lost workers that were probably running it: id and name.
    pub(crate) blamed: Vec<(WorkerId, String)>,
    /// Workers that refused it: id, name and reason.
    pub(crate) failed: Vec<(WorkerId, String, String)>,
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
            blamed: Vec::new(),
            failed: Vec::new(),
            begun: None,
        }
    }

    /// Whether a speculative copy may be made: one worker has it, none was lost with it.
    pub(crate) fn may_speculate(&self) -> bool {
        self.leases.len() == 1
            && self.queued.is_none()
            && !self.is_suspect()
            && self.failed.is_empty()
    }

    /// Whether any worker was lent it.
    pub(crate) fn was_leased(&self) -> bool {
        self.attempts > 0
    }

    fn is_suspect(&self) -> bool {
        !self.blamed.is_empty()
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
    open: u32,
    /// Workers lost meanwhile that a task may have killed.
    losses: usize,
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
            losses: 0,
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
        task.may_speculate() && task.leases.iter().all(|l| l.worker == worker && l.epoch == epoch)
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

    /// Returns the first waiting task with `among` and `suits` that the worker may have. `mine`:
    /// tasks it has leases of. `others`: whether another worker could have the task.
    pub(crate) fn next_for(
        &self,
        worker: WorkerId,
        mine: impl Fn() -> Vec<u32>,
        among: impl Fn(u32) -> bool,
        others: impl Fn(&Task) -> bool,
        suits: impl Fn(u32) -> bool,
    ) -> Option<u32> {
        let fits = self.fits(worker, mine, others);
        self.waiting.values().copied().find(|&place| among(place) && fits(place) && suits(place))
    }

    /// Returns a test for whether a worker may have a task: not one it has, not one it refused
    /// unless nobody else could have it, and no second suspect.
    fn fits(
        &self,
        worker: WorkerId,
        mine: impl Fn() -> Vec<u32>,
        others: impl Fn(&Task) -> bool,
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
            let failed = task.failed.iter().any(|(w, ..)| *w == worker) && others(task);
            let two_suspects = has_suspect && task.is_suspect();
            !(has_it || failed || two_suspects)
        }
    }

    /// Returns the first of the waiting tasks among `places` that the worker may have. Faster than
    /// [`Self::next_for`] for a worker with a list of its own.
    pub(crate) fn next_among(
        &self,
        worker: WorkerId,
        mine: impl Fn() -> Vec<u32>,
        places: &[u32],
        others: impl Fn(&Task) -> bool,
    ) -> Option<u32> {
        let fits = self.fits(worker, mine, others);
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
    /// `running` of them are blamed. Returns the tasks that are given up for it.
    pub(crate) fn lose(
        &mut self,
        worker: WorkerId,
        name: &str,
        leases: &[(u32, Epoch)],
        running: usize,
        config: &Config,
    ) -> Vec<u32> {
        let mut head: Vec<u32> = leases.iter().take(running).map(|l| l.0).collect();
        head.retain(|&p| self.tasks[p as usize].end == End::Open);
        let most = head.iter().map(|&p| self.tasks[p as usize].blamed.len()).max().unwrap_or(0);
        self.losses += usize::from(!head.is_empty());
        for &place in &head {
            let task = &mut self.tasks[place as usize];
            if task.blamed.len() == most {
                task.blamed.push((worker, name.to_owned()));
            }
        }
        self.take_back(worker, leases, config)
    }

    /// Takes back a task that a worker refused. Returns it if it is given up.
    pub(crate) fn fail(
        &mut self,
        place: u32,
        epoch: Epoch,
        worker: WorkerId,
        name: &str,
        reason: String,
        config: &Config,
    ) -> Vec<u32> {
        self.tasks[place as usize].failed.push((worker, name.to_owned(), reason));
        self.take_back(worker, &[(place, epoch)], config)
    }

    /// Ends leases and puts their tasks in front in their old order. A task with another live lease
    /// goes on with that one; one without, that was blamed or refused often enough, is returned to
    /// be given up.
    fn take_back(
        &mut self,
        worker: WorkerId,
        leases: &[(u32, Epoch)],
        config: &Config,
    ) -> Vec<u32> {
        let mut given_up = Vec::new();
        for &(place, epoch) in leases.iter().rev() {
            self.end_lease(place, worker, epoch);
            let task = &self.tasks[place as usize];
            if task.end != End::Open || !task.leases.is_empty() {
                continue;
            }
            let limit = config.poison_after.max(1) as usize;
            let alibis = self.losses.saturating_sub(task.blamed.len()).min(limit);
            if task.blamed.len() >= limit + alibis || task.failed.len() >= limit {
                given_up.push(place);
            } else {
                self.requeue(place);
            }
        }
        given_up
    }

    /// Requeues tasks that a leaving worker has not begun; its leases stay live.
    pub(crate) fn share_queued(&mut self, places: &[u32]) {
        for &place in places.iter().rev() {
            self.requeue(place);
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

    /// Returns the next lease deadline.
    pub(crate) fn next_deadline(&self) -> Option<Micros> {
        self.deadlines.first().map(|d| d.0)
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

    fn next(q: &TaskQueue, w: u64, mine: &[u32]) -> Option<u32> {
        q.next_for(WorkerId(w), || mine.to_vec(), |_| true, |_| true, |_| true)
    }

    fn take(q: &mut TaskQueue, w: u64, mine: &[u32], now: Micros) -> (u32, Epoch) {
        let place = next(q, w, mine).expect("something waits");
        (place, q.lease(place, WorkerId(w), now, &Config::default()))
    }

    fn done() -> End {
        End::Done { worker: "".into(), render_us: 1 }
    }

    #[test]
    fn queue_lends_returned_tasks_first_then_the_largest() {
        let c = Config::default();
        let mut q = queue(4);
        assert_eq!(take(&mut q, 1, &[], 0), (0, Epoch(0)));
        assert_eq!(take(&mut q, 1, &[0], 0), (1, Epoch(0)));
        assert_eq!(take(&mut q, 2, &[], 0), (2, Epoch(0)));
        assert!(q.lose(WorkerId(1), "one", &[(0, Epoch(0)), (1, Epoch(0))], 1, &c).is_empty());
        assert_eq!(q.tasks[0].blamed.len(), 1);
        assert_eq!(q.tasks[1].blamed.len(), 0, "it was not running yet");
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
            let all = q.next_for(WorkerId(1), mine, |p| own.contains(&p), |_| true, |_| true);
            assert_eq!(q.next_among(WorkerId(1), mine, own, |_| true), all);
            assert_eq!(q.any_waiting(own), own.iter().any(|p| q.all_waiting().any(|w| w == *p)));
            all
        };
        assert_eq!(same(&q, &[5, 2, 4], &[]), Some(2), "the first in the queue, not in the list");
        q.lease(2, WorkerId(1), 0, &c);
        q.lease(5, WorkerId(2), 0, &c);
        assert_eq!(same(&q, &[5, 2, 4], &[2]), Some(4));
        assert_eq!(same(&q, &[5, 2], &[2]), None);
        // What comes back is before all others, the last one first.
        q.lose(WorkerId(2), "two", &[(5, Epoch(0))], 0, &c);
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
        assert_eq!(next(&q, 1, &[0]), None, "another worker, not the same");
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
    fn task_that_three_workers_die_with_is_given_up() {
        let c = Config::default();
        let mut q = queue(2);
        for w in 1..=3 {
            let lease = take(&mut q, w, &[], 0);
            assert_eq!(lease.0, 0);
            let given_up = q.lose(WorkerId(w), "x", &[lease], 4, &c);
            assert_eq!(given_up, if w == 3 { vec![0] } else { vec![] });
        }
    }

    #[test]
    fn poison_blame_spares_the_neighbour_of_a_deadly_task() {
        // Workers of two threads; task 0 kills whoever runs it, tasks 1 and up are harmless.
        let c = Config::default();
        let mut q = queue(6);
        let mut given_up = Vec::new();
        for w in 1..=3 {
            let a = take(&mut q, w, &[], 0);
            let b = take(&mut q, w, &[a.0], 0);
            assert_eq!(a.0, 0);
            assert!(!(q.tasks[a.0 as usize].is_suspect() && q.tasks[b.0 as usize].is_suspect()));
            given_up = q.lose(WorkerId(w), "x", &[a, b], 2, &c);
        }
        assert_eq!(given_up, [0]);
        assert!(q.tasks[1..].iter().all(|t| t.blamed.len() <= 1));
    }

    #[test]
    fn poison_needs_more_losses_where_workers_die_anyway() {
        let c = Config::default();
        let mut q = queue(3);
        // A loss that task 0 has nothing to do with: it is with worker 1 meanwhile.
        let mut held = take(&mut q, 1, &[], 0);
        let other = take(&mut q, 9, &[], 0);
        assert!(q.lose(WorkerId(9), "x", &[other], 1, &c).is_empty());
        q.lease(other.0, WorkerId(10), 0, &c);
        for w in 1..=4 {
            assert_eq!(held.0, 0);
            let given_up = q.lose(WorkerId(w), "x", &[held], 1, &c);
            // Three, and one for the other loss.
            assert_eq!(given_up, if w == 4 { vec![0] } else { vec![] });
            if w < 4 {
                held = take(&mut q, w + 1, &[], 0);
            }
        }
    }

    #[test]
    fn task_refused_three_times_is_given_up() {
        let c = Config::default();
        let mut q = queue(1);
        for w in [1, 1, 2] {
            assert_eq!(q.open(), 1);
            // Worker 1 gets it again only while there is nobody else.
            let alone = w == 1;
            assert_eq!(
                q.next_for(WorkerId(1), Vec::new, |_| true, |_| true, |_| true).is_none(),
                !q.tasks[0].failed.is_empty(),
            );
            let place = q.next_for(WorkerId(w), Vec::new, |_| true, |_| !alone, |_| true).unwrap();
            let epoch = q.lease(place, WorkerId(w), 0, &c);
            let given_up = q.fail(0, epoch, WorkerId(w), "x", "no".into(), &c);
            assert_eq!(given_up.len(), usize::from(w == 2));
        }
    }
}
