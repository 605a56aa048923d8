//! The queue of render threads.

use super::slots::{FrameSlot, locked};
use super::task::{RegionTask, Task};
use crate::brick_table::BrickTable;
use slabcast_common::ids::FrameId;
use slabcast_common::lookahead::Lookahead;
use slabcast_common::occlusion::Rect;
use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Order of tasks: older frames first; in a frame, regions that go on before new tasks; then first
/// come, first served.
type Priority = (FrameId, bool, u64);

#[derive(Default)]
struct State {
    tasks: BTreeMap<Priority, Task>,
    last_number: u64,
    /// Regions in the queue whose bricks were not asked for in advance.
    unprefetched: usize,
    is_closed: bool,
    /// Threads without a task.
    idle_threads: u32,
    /// Whether regions are stalled.
    are_stalled: bool,
    /// Time up to which `idle` is counted.
    counted_until: Option<Instant>,
    /// Time of all threads without a task while regions were stalled, since it was asked for last.
    idle: Duration,
    /// Number of render threads.
    threads: u32,
    /// When the first region was taken.
    began: Option<Instant>,
    lookahead: Lookahead,
}

impl State {
    /// Counts the time that threads were idle while regions were stalled.
    fn count_idle(&mut self) {
        let now = Instant::now();
        if let Some(since) = self.counted_until.replace(now)
            && self.are_stalled
        {
            let idle = (now - since) * self.idle_threads;
            self.idle += idle;
            self.lookahead.add_idle_ns(idle.as_nanos() as u64);
        }
    }

    /// Number of sheets that a region looks ahead which a thread takes now.
    fn ahead(&mut self, task: &RegionTask) -> u32 {
        let now_ns = self.began.get_or_insert_with(Instant::now).elapsed().as_nanos() as u64;
        let frame = task.lease.frame;
        let is_first = *task.frame.scene.first.get_or_init(|| frame) == frame;
        self.lookahead.sheets(now_ns, self.threads, task.stalls, is_first)
    }
}

/// A region whose bricks are to be asked for in advance.
pub(super) struct Prefetch {
    pub(super) frame: Arc<FrameSlot>,
    pub(super) table: Arc<BrickTable>,
    pub(super) tile: Rect,
}

#[derive(Default)]
pub(super) struct Queue {
    state: Mutex<State>,
    bell: Condvar,
}

impl Queue {
    /// A queue for so many threads.
    pub(super) fn new(threads: u32) -> Queue {
        let state = State { threads, ..State::default() };
        Queue { state: Mutex::new(state), bell: Condvar::new() }
    }

    pub(super) fn push(&self, task: Task) {
        let (frame, is_new) = match &task {
            Task::Slab(task) => (task.lease.frame, true),
            Task::Region(task) => (task.lease.frame, task.is_new()),
        };
        let mut state = locked(&self.state);
        let must_prefetch = matches!(&task, Task::Region(task) if !task.was_prefetched);
        state.unprefetched += usize::from(must_prefetch);
        state.last_number += 1;
        let priority = (frame, is_new, state.last_number);
        state.tasks.insert(priority, task);
        drop(state);
        self.bell.notify_one();
    }

    /// Waits for a task. Returns it with the regions that came into the queue since the last call;
    /// `None` once the queue is closed.
    pub(super) fn pop(&self) -> Option<(Task, Vec<Prefetch>)> {
        let mut state = locked(&self.state);
        loop {
            if state.is_closed {
                return None;
            }
            let mut prefetches = Vec::new();
            if state.unprefetched > 0 {
                state.unprefetched = 0;
                for task in state.tasks.values_mut() {
                    let Task::Region(task) = task else { continue };
                    let is_done = std::mem::replace(&mut task.was_prefetched, true);
                    if !is_done && task.lease.begun.is_none() {
                        let (frame, table) = (task.frame.clone(), task.table.clone());
                        prefetches.push(Prefetch { frame, table, tile: task.lease.tile });
                    }
                }
            }
            if let Some((_, mut task)) = state.tasks.pop_first() {
                if let Task::Region(task) = &mut task {
                    task.ahead = state.ahead(task);
                }
                return Some((task, prefetches));
            }
            state.count_idle();
            state.idle_threads += 1;
            state = self.bell.wait(state).unwrap_or_else(PoisonError::into_inner);
            state.count_idle();
            state.idle_threads -= 1;
        }
    }

    /// Drops all tasks and lets threads end.
    pub(super) fn close(&self) {
        let mut state = locked(&self.state);
        state.is_closed = true;
        state.tasks.clear();
        drop(state);
        self.bell.notify_all();
    }

    pub(super) fn set_stalled(&self, are_stalled: bool) {
        let mut state = locked(&self.state);
        if state.are_stalled != are_stalled {
            state.count_idle();
            state.are_stalled = are_stalled;
        }
    }

    pub(super) fn take_idle(&self) -> Duration {
        let mut state = locked(&self.state);
        state.count_idle();
        std::mem::take(&mut state.idle)
    }
}
