//! Slab leases that wait for their bricks.

use crate::cache::BrickCache;
use crate::pool::FrameSlot;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{BrickId, FrameId, TaskId};
use slabcast_common::message::Lease;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

/// A lease with its frame, some of whose bricks may not be here.
pub(super) struct WaitingLease {
    pub(super) lease: Box<Lease>,
    pub(super) frame: Arc<FrameSlot>,
    pub(super) received: Instant,
    /// Number of its bricks that are not here.
    missing: usize,
}

/// The leases that wait.
#[derive(Default)]
pub(super) struct WaitingLeases {
    leases: BTreeMap<TaskId, WaitingLease>,
    /// Tasks that wait for each brick.
    by_brick: BTreeMap<(BrickSetKey, BrickId), Vec<TaskId>>,
}

impl WaitingLeases {
    /// Adds a lease. Returns it if its bricks are all in `cache`.
    pub(super) fn add(
        &mut self,
        lease: Box<Lease>,
        frame: Arc<FrameSlot>,
        received: Instant,
        cache: &BrickCache,
    ) -> Option<WaitingLease> {
        let set = frame.scene.spec.bricks;
        let mut missing = 0;
        for id in &lease.bricks {
            if cache.get(set, *id).is_none() {
                self.by_brick.entry((set, *id)).or_default().push(lease.task);
                missing += 1;
            }
        }
        let waiting = WaitingLease { lease, frame, received, missing };
        if missing == 0 {
            return Some(waiting);
        }
        self.leases.insert(waiting.lease.task, waiting);
        None
    }

    /// Notes that a brick has come. Returns the leases whose last brick it was.
    pub(super) fn brick_arrived(&mut self, set: BrickSetKey, id: BrickId) -> Vec<WaitingLease> {
        let mut ready = Vec::new();
        for task in self.by_brick.remove(&(set, id)).unwrap_or_default() {
            let Some(waiting) = self.leases.get_mut(&task) else { continue };
            waiting.missing -= 1;
            if waiting.missing == 0 {
                ready.extend(self.leases.remove(&task));
            }
        }
        ready
    }

    /// Notes that bricks were dropped: leases that need them wait for them again.
    pub(super) fn bricks_dropped(&mut self, set: BrickSetKey, bricks: &[BrickId]) {
        for (task, waiting) in &mut self.leases {
            if waiting.frame.scene.spec.bricks != set {
                continue;
            }
            let needs = |id: &&BrickId| waiting.lease.bricks.binary_search(id).is_ok();
            for id in bricks.iter().filter(needs) {
                let tasks = self.by_brick.entry((set, *id)).or_default();
                if !tasks.contains(task) {
                    tasks.push(*task);
                    waiting.missing += 1;
                }
            }
        }
    }

    /// Removes the leases of a frame that has ended.
    pub(super) fn end_frame(&mut self, frame: FrameId) {
        self.leases.retain(|_, w| w.lease.frame != frame);
    }

    /// Whether no lease waits.
    pub(super) fn is_empty(&self) -> bool {
        self.leases.is_empty()
    }

    /// Removes all leases.
    pub(super) fn clear(&mut self) {
        self.leases.clear();
    }
}
