//! Jobs: view paths that clients submitted, their frames, and those who wait for them.
//!
//! The table is shared: the driver puts frames in, watchers take them out. A watcher is a
//! cursor, so it may come late, twice, or again after its connection broke. Frames that nobody
//! has taken yet are never dropped; instead the driver stops rendering ahead when they fill the
//! budget. Frames that were taken are kept while there is room and rendered again when somebody
//! asks for one that is gone: a frame is a pure function of its job.

#[cfg(test)]
mod tests;
mod watch;

pub use watch::{Watch, WatchItem};

use bytes::Bytes;
use slabcast_common::ids::JobId;
use slabcast_common::image::PixelFormat;
use slabcast_common::message::PathRequest;
use slabcast_common::stats::FrameStats;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard};


/// Most jobs that are remembered; the oldest ended ones are forgotten beyond it.
pub const MAX_JOBS: usize = 1000;

/// What a job is doing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum JobState {
    /// Other jobs come first.
    Queued,
    /// Its bricks are being made.
    Preparing,
    /// There is no worker.
    WaitingForWorkers,
    /// Frames are being rendered.
    Running,
    /// All frames are done.
    Done,
    /// It can't go on; says why.
    Failed(String),
    /// A client cancelled it.
    Cancelled,
}

impl JobState {
    /// Whether nothing more will happen by itself.
    pub fn is_over(&self) -> bool {
        matches!(self, JobState::Done | JobState::Failed(_) | JobState::Cancelled)
    }
}

/// A job as others see it.
#[derive(Clone, Debug)]
pub struct JobView {
    /// Its name.
    pub id: JobId,
    /// The client's name for it.
    pub client_key: String,
    /// What it is doing.
    pub state: JobState,
    /// Frames done.
    pub frames_done: u64,
    /// Frames in all.
    pub frames_total: u64,
    /// Macrotiles done and there in the slab at hand.
    pub tiles: (u32, u32),
    /// Slab at hand and slabs of the frame at hand.
    pub slab: (u32, u32),
    /// Render threads of the workers that are there.
    pub workers: u32,
    /// Picture size.
    pub size: [u32; 2],
    /// Pixel format.
    pub format: PixelFormat,
    /// When it was submitted, in milliseconds since 1970 UTC.
    pub submitted_unix_ms: i64,
    /// When it ended, likewise; 0 before.
    pub finished_unix_ms: i64,
}

/// A frame, ready to leave.
#[derive(Debug)]
pub struct FinishedFrame {
    /// Its number in the path.
    pub number: u64,
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Of `bytes`.
    pub format: PixelFormat,
    /// The pixels.
    pub bytes: Bytes,
    /// Statistics, hashes included.
    pub stats: FrameStats,
    /// The same as one line of JSON.
    pub stats_json: String,
    /// Spans as Chrome trace events (a JSON array), where the client asked for them.
    pub trace_json: Option<String>,
}

pub(crate) struct Job {
    pub(crate) view: JobView,
    pub(crate) request: Arc<PathRequest>,
    pub(crate) frames: BTreeMap<u64, Arc<FinishedFrame>>,
    /// Frames done at least once.
    pub(crate) ever_done: BTreeSet<u64>,
    /// Frames that a watcher has taken.
    pub(crate) taken: BTreeSet<u64>,
    /// Frames asked for that are done but gone.
    pub(crate) wanted_again: BTreeSet<u64>,
    /// Whether how to render it is forgotten: a frame that is gone stays gone.
    pub(crate) retired: bool,
}

#[derive(Default)]
pub(crate) struct Table {
    pub(crate) jobs: BTreeMap<JobId, Job>,
    pub(crate) by_key: BTreeMap<String, JobId>,
    pub(crate) next: u64,
}

/// The table, and two bells: one rings at each tile, the other when anything else changes.
pub(crate) struct Jobs {
    table: Mutex<Table>,
    bell: tokio::sync::watch::Sender<u64>,
    tiles: tokio::sync::watch::Sender<u64>,
}

impl Jobs {
    /// A table whose first job has the number after `next`.
    pub(crate) fn starting_at(next: u64) -> Self {
        let table = Table { next, ..Table::default() };
        Jobs { table: Mutex::new(table), bell: tokio::sync::watch::channel(0).0, tiles: tokio::sync::watch::channel(0).0 }
    }

    /// The table. Held for moments only, never across an await.
    pub(crate) fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(|broken| broken.into_inner())
    }

    /// Wakes the watchers.
    pub(crate) fn ring(&self) {
        self.bell.send_modify(|n| *n += 1);
    }

    /// A tile was done: watchers look when they next have time for such news ([`NEWS`]).
    pub(crate) fn ring_tile(&self) {
        self.tiles.send_modify(|n| *n += 1);
    }

    /// Both bells.
    pub(crate) fn listen(&self) -> (tokio::sync::watch::Receiver<u64>, tokio::sync::watch::Receiver<u64>) {
        (self.bell.subscribe(), self.tiles.subscribe())
    }
}

impl Table {
    /// Bytes of finished frames that wait for somebody to take them, and of all.
    pub(crate) fn bytes(&self) -> (usize, usize) {
        let (mut waiting, mut all) = (0, 0);
        for job in self.jobs.values() {
            for (n, f) in &job.frames {
                all += f.bytes.len();
                if !job.taken.contains(n) && !job.view.state.is_over() {
                    waiting += f.bytes.len();
                }
            }
        }
        (waiting, all)
    }

    /// Drops frames until `budget` holds, oldest jobs and lowest numbers first: those that were
    /// taken, then those of jobs that are over. A frame of a job in progress that nobody has
    /// taken stays; so does `newest`, which came just now, until the next one comes. Else one that
    /// is larger than the budget would be dropped before its watcher sees it, asked for again,
    /// rendered again and dropped again, for ever.
    pub(crate) fn evict(&mut self, budget: usize, newest: (JobId, u64)) {
        let (_, mut all) = self.bytes();
        for over_too in [false, true] {
            for (id, job) in &mut self.jobs {
                let may_go = |n: &u64| {
                    (*id, *n) != newest
                        && (job.taken.contains(n) || (over_too && job.view.state.is_over()))
                };
                let gone: Vec<u64> = job.frames.keys().copied().filter(may_go).collect();
                for n in gone {
                    if all <= budget {
                        return;
                    }
                    if let Some(f) = job.frames.remove(&n) {
                        all -= f.bytes.len();
                    }
                }
            }
        }
    }

    /// Forgets the oldest ended jobs beyond [`MAX_JOBS`].
    pub(crate) fn forget(&mut self) {
        while self.jobs.len() > MAX_JOBS {
            let Some(id) =
                self.jobs.iter().find(|(_, j)| j.view.state.is_over()).map(|(id, _)| *id)
            else {
                return;
            };
            if let Some(job) = self.jobs.remove(&id) {
                self.by_key.remove(&job.view.client_key);
            }
        }
    }
}
