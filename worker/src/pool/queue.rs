//! The queue of render threads.

use super::slots::{FrameSlot, locked};
use super::task::{RegionTask, Task};
use crate::brick_table::BrickTable;
use slabcast_common::ids::FrameId;
use slabcast_common::lookahead::Lookahead;
use slabcast_common::occlusion::Rect;
use std::cell::Cell;
use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Order of a client's tasks: older frames first; in a frame, regions that go on before new tasks;
/// then first come, first served.
type Priority = (FrameId, bool, u64);

/// Tuning (us): time slice: a region draws for so long before it gives way to a client that waits. At 5 ms a region of a
/// frame of 1024x1024 takes 3 % longer beside another; at 100 ms a frame of 16 tiles takes 1.6 s
/// beside one whose tiles take minutes.
const SLICE: Duration = Duration::from_millis(20);

/// Limit: clients without tasks whose time is remembered.
const CLIENTS_KEPT: usize = 64;

/// Tasks and thread time of one client.
#[derive(Default)]
struct Client {
    tasks: BTreeMap<Priority, Task>,
    spent: Duration,
    /// Number of threads that draw a task of the client.
    running: u32,
}

impl Client {
    fn is_here(&self) -> bool {
        self.running > 0 || !self.tasks.is_empty()
    }

    /// Returns the client's thread time, with one slice for each thread that draws a task of it now.
    fn charged(&self) -> Duration {
        self.spent + SLICE * self.running
    }
}

#[derive(Default)]
struct State {
    /// Clients by number. A new client starts with the least time of all others: it is served at once,
    /// and can't claim the time before it came.
    clients: BTreeMap<u64, Client>,
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
    /// Enters a client that is about to get tasks.
    fn enter(&mut self, client: u64) {
        if self.clients.get(&client).is_some_and(Client::is_here) {
            return;
        }
        let here = self.clients.iter().filter(|(id, s)| **id != client && s.is_here());
        let Some(least) = here.map(|(_, s)| s.charged()).min() else {
            // No other client has tasks, so the time of all starts at zero.
            self.clients.clear();
            self.clients.insert(client, Client::default());
            return;
        };
        self.clients.retain(|id, s| *id == client || s.is_here() || s.spent > least);
        if self.clients.len() >= CLIENTS_KEPT {
            self.clients.retain(|id, s| *id == client || s.is_here());
        }
        let entry = self.clients.entry(client).or_default();
        entry.spent = entry.spent.max(least);
    }

    /// Takes the next task: of the client with the least time; between equals, of the older frame.
    fn take(&mut self) -> Option<Task> {
        let waiting = self.clients.values_mut().filter(|s| !s.tasks.is_empty());
        let next = waiting.min_by_key(|s| (s.charged(), s.tasks.keys().next().copied()))?;
        let (_, task) = next.tasks.pop_first()?;
        next.running += 1;
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
        let client = task.client();
        let mut state = locked(&self.state);
        let must_prefetch = matches!(&task, Task::Region(task) if !task.was_prefetched);
        state.unprefetched += usize::from(must_prefetch);
        state.last_number += 1;
        let priority = (frame, is_new, state.last_number);
        state.enter(client);
        state.clients.entry(client).or_default().tasks.insert(priority, task);
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
                for task in state.clients.values_mut().flat_map(|s| s.tasks.values_mut()) {
                    let Task::Region(task) = task else { continue };
                    let is_done = std::mem::replace(&mut task.was_prefetched, true);
                    if !is_done && task.lease.begun.is_none() {
                        let (frame, table) = (task.frame.clone(), task.table.clone());
                        prefetches.push(Prefetch { frame, table, tile: task.lease.tile });
                    }
                }
            }
            if let Some(mut task) = state.take() {
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
        drop(state);
        self.bell.notify_all();
    }

    /// Charges a client with `time` of a thread that draws a region. Returns whether a client with less
    /// time waits, so that the region has to give way.
    fn must_yield(&self, client: u64, time: Duration) -> bool {
        let mut state = locked(&self.state);
        let Some(own) = state.clients.get_mut(&client) else { return false };
        own.spent += time;
        let spent = own.spent;
        let mut others =
            state.clients.iter().filter(|(id, s)| **id != client && !s.tasks.is_empty());
        others.any(|(_, s)| s.charged() < spent)
    }

    /// Charges a client with the last `time` of a thread that ended or paused a task.
    fn ran(&self, client: u64, time: Duration) {
        if let Some(client) = locked(&self.state).clients.get_mut(&client) {
            client.spent += time;
            client.running = client.running.saturating_sub(1);
        }
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
    /// locks the queue once a slice.
    pub(super) fn is_over(&self) -> bool {
        let now = Instant::now();
        let time = now - self.charged_until.get();
        if !self.is_over.get() && time >= SLICE {
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
