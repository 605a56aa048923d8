//! The lease table of a frame: the tasks of its current phase, and which worker was lent which.

use crate::policy::macrotile::Cut;
use crate::state::task_queue::TaskQueue;
use crate::state::worker_map::WorkerMap;
use crate::{Config, Micros};
use slabcast_common::ids::{Epoch, TaskId, WorkerId};
use slabcast_common::occlusion::Rect;

/// A lease that a worker has not answered; perhaps of an earlier phase.
#[derive(Debug)]
pub(crate) struct Lent {
    pub(crate) task: TaskId,
    pub(crate) epoch: Epoch,
    pub(crate) sent: Micros,
    /// Indices of the bricks it pins (`slab` schedule).
    pub(crate) bricks: Vec<u32>,
}

/// Tasks and leases of a frame.
#[derive(Debug)]
pub(crate) struct LeaseTable {
    /// Tasks of the current phase; empty before the first.
    pub(crate) queue: TaskQueue,
    /// Their tiles, at the same indices.
    pub(crate) cut: Cut,
    /// Task ids reserved for pieces of tiles that are split while rendered.
    pub(crate) spare_ids: u64,
    lent: WorkerMap<Vec<Lent>>,
    /// When each worker answered a lease last.
    answered: WorkerMap<Micros>,
}

impl LeaseTable {
    /// A table without tasks.
    pub(crate) fn new() -> Self {
        LeaseTable {
            queue: TaskQueue::new(TaskId(0), &[]),
            cut: Cut::default(),
            spare_ids: 0,
            lent: WorkerMap::default(),
            answered: WorkerMap::default(),
        }
    }

    /// Begins a phase with the tasks of a cut.
    pub(crate) fn begin(&mut self, first: TaskId, cut: Cut, spare_ids: u64) {
        self.queue = TaskQueue::new(first, &cut.tiles);
        self.cut = cut;
        self.spare_ids = spare_ids;
    }

    /// Returns the tile of the task at an index.
    pub(crate) fn tile(&self, place: u32) -> Rect {
        self.cut.tiles[place as usize].rect
    }

    /// Enters a lease of a waiting task, or a speculative copy.
    pub(crate) fn lend(
        &mut self,
        place: u32,
        worker: WorkerId,
        bricks: Vec<u32>,
        is_copy: bool,
        now: Micros,
        config: &Config,
    ) {
        let epoch = match is_copy {
            false => self.queue.lease(place, worker, now, config),
            true => self.queue.lease_again(place, worker, now, config),
        };
        let lent = Lent { task: self.queue.id(place), epoch, sent: now, bricks };
        self.lent.or_default(worker).push(lent);
    }

    /// Returns the leases of a worker, oldest first.
    pub(crate) fn lent(&self, id: WorkerId) -> &[Lent] {
        self.lent.get(id).map_or(&[], Vec::as_slice)
    }

    /// Returns all leases by worker.
    pub(crate) fn all_lent(&self) -> impl Iterator<Item = (WorkerId, &[Lent])> {
        self.lent.iter().map(|(id, lent)| (id, lent.as_slice()))
    }

    /// Returns the indices of a worker's leases that are of the current phase, oldest first.
    pub(crate) fn places(&self, id: WorkerId) -> impl Iterator<Item = u32> {
        self.lent(id).iter().filter_map(|l| self.queue.place(l.task))
    }

    /// Whether a worker has this lease.
    pub(crate) fn has_lent(&self, worker: WorkerId, task: TaskId, epoch: Epoch) -> bool {
        self.lent(worker).iter().any(|l| l.task == task && l.epoch == epoch)
    }

    /// Takes a lease back; `None` if the worker has none such.
    pub(crate) fn take(&mut self, worker: WorkerId, task: TaskId, epoch: Epoch) -> Option<Lent> {
        let lent = self.lent.get_mut(worker)?;
        let index = lent.iter().position(|l| l.task == task && l.epoch == epoch)?;
        Some(lent.remove(index))
    }

    /// Takes all leases of a worker back.
    pub(crate) fn remove(&mut self, worker: WorkerId) {
        self.lent.remove(worker);
    }

    /// Takes all leases back.
    pub(crate) fn take_all(&mut self) -> WorkerMap<Vec<Lent>> {
        std::mem::take(&mut self.lent)
    }

    /// Notes that a worker answered a lease, and returns when it did before.
    pub(crate) fn note_answer(&mut self, worker: WorkerId, now: Micros) -> Micros {
        self.answered.insert(worker, now).unwrap_or(0)
    }

    /// Returns when a worker answered a lease last; 0 if it never did.
    pub(crate) fn answered(&self, worker: WorkerId) -> Micros {
        self.answered.get(worker).copied().unwrap_or(0)
    }

    /// Returns when a thread can have begun with a lease: once it was sent, and the one before was
    /// answered.
    pub(crate) fn started(&self, worker: WorkerId, sent: Micros) -> Micros {
        sent.max(self.answered(worker))
    }
}
