//! The queue of render threads.

use super::shares::{SLICE, Shares};
use super::slots::{FrameSlot, locked};
use super::task::{RegionTask, Task};
use crate::brick_table::BrickTable;
use slabcast_common::ids::FrameId;
use slabcast_common::lookahead::Lookahead;
use slabcast_common::message::is_live;
use slabcast_common::occlusion::Rect;
use std::cell::Cell;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Order of a client's tasks: older frames first; in a frame, regions that go on before new tasks;
/// then first come, first served.
type Priority = (FrameId, bool, u64);

#[derive(Default)]
struct State {
    /// Tasks that wait, by the number of their client.
    clients: BTreeMap<u64, BTreeMap<Priority, Task>>,
    /// Thread time of each client, which decides the next task.
    shares: Shares,
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
    /// Takes the next task: of the client whose turn it is; between equals, of the older frame.
    fn take(&mut self) -> Option<Task> {
        let clients = &self.clients;
        let oldest = |client| clients.get(&client).and_then(|tasks| tasks.keys().next().copied());
        let client = self.shares.take(oldest)?;
        let tasks = self.clients.get_mut(&client)?;
        let (_, task) = tasks.pop_first()?;
        if tasks.is_empty() {
            self.clients.remove(&client);
        }
        Some(task)
    }

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
    /// Whether a live client's task waits whose turn it is: regions of jobs then give way at once, and
    /// not after their slice.
    live_is_due: AtomicBool,
}

impl Queue {
    /// A queue for so many threads.
    pub(super) fn new(threads: u32) -> Queue {
        let state = State { threads, ..State::default() };
        Queue { state: Mutex::new(state), ..Queue::default() }
    }

    pub(super) fn push(&self, task: Task) {
        let (frame, is_new) = match &task {
            Task::Slab(task) => (task.lease.frame, true),
            Task::Region(task) => (task.lease.frame, task.is_new()),
        };
        let client = task.client();
        let mut state = locked(&self.state);
        let must_prefetch = matches!(&task, Task::Region(task) if !task.was_prefetched);
        state.unprefetched += usize::from(must_prefetch);
        state.last_number += 1;
        let priority = (frame, is_new, state.last_number);
        state.shares.push(client);
        state.clients.entry(client).or_default().insert(priority, task);
        self.live_is_due.store(state.shares.live_is_due(), Ordering::Relaxed);
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
                for task in state.clients.values_mut().flat_map(BTreeMap::values_mut) {
                    let Task::Region(task) = task else { continue };
                    let is_done = std::mem::replace(&mut task.was_prefetched, true);
                    if !is_done && task.lease.begun.is_none() {
                        let (frame, table) = (task.frame.clone(), task.table.clone());
                        prefetches.push(Prefetch { frame, table, tile: task.lease.tile });
                    }
                }
            }
            let taken = state.take();
            self.live_is_due.store(state.shares.live_is_due(), Ordering::Relaxed);
            if let Some(mut task) = taken {
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
        state.clients.clear();
        state.shares.clear();
        drop(state);
        self.bell.notify_all();
    }

    /// Charges a client with `time` of a thread that draws a region. Returns whether another client's
    /// turn has come, so that the region has to give way.
    fn must_yield(&self, client: u64, time: Duration) -> bool {
        let mut state = locked(&self.state);
        state.shares.charge(client, time);
        let must = state.shares.must_yield(client);
        self.live_is_due.store(state.shares.live_is_due(), Ordering::Relaxed);
        must
    }

    /// Charges a client with the last `time` of a thread that ended or paused a task.
    fn ran(&self, client: u64, time: Duration) {
        let mut state = locked(&self.state);
        state.shares.charge(client, time);
        state.shares.ended(client);
        self.live_is_due.store(state.shares.live_is_due(), Ordering::Relaxed);
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

/// Time slices of a thread that draws a region of one client.
pub(super) struct Turn<'a> {
    queue: &'a Queue,
    client: u64,
    /// Time up to which the client is charged.
    charged_until: Cell<Instant>,
    is_over: Cell<bool>,
}

impl<'a> Turn<'a> {
    pub(super) fn new(queue: &'a Queue, client: u64) -> Self {
        let (charged_until, is_over) = (Cell::new(Instant::now()), Cell::new(false));
        Turn { queue, client, charged_until, is_over }
    }

    /// Whether the region has to give way to another client. Called at each sheet: reads a clock, and
    /// locks the queue once a slice, or when a live client waits.
    pub(super) fn is_over(&self) -> bool {
        let now = Instant::now();
        let time = now - self.charged_until.get();
        let is_due = !is_live(self.client) && self.queue.live_is_due.load(Ordering::Relaxed);
        if !self.is_over.get() && (time >= SLICE || is_due) {
            self.charged_until.set(now);
            self.is_over.set(self.queue.must_yield(self.client, time));
        }
        self.is_over.get()
    }

    /// Ends the turn and charges the client.
    pub(super) fn end(self) {
        self.queue.ran(self.client, self.charged_until.get().elapsed());
    }
}
