//! Jobs: view paths that clients submitted, their frames, and their watchers.
//!
//! The table is shared: the driver puts frames in, watchers take them out. A watcher is a cursor,
//! so that it may come late, twice, or again after its connection broke. Frames that no watcher has
//! taken are never dropped; instead the driver stops rendering ahead when they fill the budget
//! (back-pressure). Frames that were taken are kept while there is room, and rendered again when a
//! watcher asks for one that was dropped: a frame is a pure function of its job.

pub(crate) mod active;
pub mod submit;
#[cfg(test)]
mod tests;
mod watcher;

pub use watcher::{Watch, WatchItem};

use crate::handle::unix_ms;
use bytes::Bytes;
use slabcast_common::ids::JobId;
use slabcast_common::image::PixelFormat;
use slabcast_common::stats::FrameStats;
use slabcast_scene::path::Framing;
use slabcast_scene::request::PathRequest;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::watch;

/// Most jobs that a master remembers. Beyond it, the oldest jobs that are over are forgotten.
pub const MAX_JOBS: usize = 1000;

/// Reasons of failed frames that a job keeps; later failures are told by the last of them.
const MAX_REASONS: usize = 100;

/// State of a job, from its queue to its end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum JobState {
    /// Other jobs come first.
    Queued,
    /// The volume is being cut into the job's bricks.
    Preparing,
    /// No worker is linked to the master.
    WaitingForWorkers,
    /// Frames are being rendered.
    Running,
    /// All frames are done.
    Done,
    /// Each frame is done or failed, and some failed, as this says. The same request under the
    /// same key draws those again.
    Incomplete(String),
    /// The job can't go on, for this reason.
    Failed(String),
    /// A client cancelled it.
    Cancelled,
}

impl JobState {
    /// Returns whether no frame of the job is drawn any more unless somebody asks for it.
    pub fn is_over(&self) -> bool {
        use JobState::*;
        matches!(self, Done | Incomplete(_) | Failed(_) | Cancelled)
    }
}

/// A job as clients see it.
#[derive(Clone, Debug)]
pub struct JobView {
    /// Id that the master gave the job.
    pub id: JobId,
    /// The key that the client chose for the request (`client_key`).
    pub client_key: String,
    /// State that the job is in now.
    pub state: JobState,
    /// Number of frames that were finished at least once.
    pub frames_done: u64,
    /// Number of frames that failed.
    pub frames_failed: u64,
    /// Number of frames of the path.
    pub frames_total: u64,
    /// Macrotiles of the current slab: done, and in all.
    pub tiles: (u32, u32),
    /// Current slab, counted from 0, and number of slabs of the current frame.
    pub slab: (u32, u32),
    /// Number of workers that are linked to the master.
    pub workers: u32,
    /// Width and height of the pictures, in pixels.
    pub size: [u32; 2],
    /// Format of the pixels that the job delivers.
    pub format: PixelFormat,
    /// Target and height that the path was given, if it asked for them.
    pub framing: Option<Framing>,
    /// Time of submission, in milliseconds since 1970 UTC.
    pub submitted_unix_ms: i64,
    /// Time at which the job ended, in milliseconds since 1970 UTC; 0 before.
    pub finished_unix_ms: i64,
}

/// A finished frame: its pixels and its statistics.
#[derive(Debug)]
pub struct FinishedFrame {
    /// Number of the frame in its job, from 0.
    pub number: u64,
    /// Width and height of the frame in pixels.
    pub size: [u32; 2],
    /// Format of the pixels in `bytes`.
    pub format: PixelFormat,
    /// Pixels, row by row from the top left.
    pub bytes: Bytes,
    /// Statistics of the frame, with its hashes.
    pub stats: FrameStats,
    /// Statistics of the frame as one line of JSON.
    pub stats_json: String,
    /// Spans as a JSON array of Chrome trace events, if the client asked for them.
    pub trace_json: Option<String>,
}

/// A job in the table.
pub(crate) struct Job {
    pub(crate) view: JobView,
    pub(crate) request: Arc<PathRequest>,
    /// Frames that are kept, by number.
    frames: BTreeMap<u64, Arc<FinishedFrame>>,
    /// Numbers of frames that were finished at least once.
    ever_done: BTreeSet<u64>,
    /// Numbers of frames that a watcher has taken since they were finished last.
    taken: BTreeSet<u64>,
    /// Number and bytes of the kept frames that are not in `taken`.
    untaken: (usize, usize),
    /// Numbers of frames that were dropped and are asked for again.
    pub(crate) wanted_again: BTreeSet<u64>,
    /// Frames that failed, and why.
    failed: BTreeMap<u64, Arc<str>>,
    /// Numbers of frames that failed and are to be drawn again.
    pub(crate) retried: BTreeSet<u64>,
    /// Whether frames that were dropped can't be rendered again.
    retired: bool,
}

impl Job {
    /// A job without frames.
    pub(crate) fn new(view: JobView, request: Arc<PathRequest>) -> Job {
        Job {
            view,
            request,
            frames: BTreeMap::new(),
            ever_done: BTreeSet::new(),
            taken: BTreeSet::new(),
            untaken: (0, 0),
            wanted_again: BTreeSet::new(),
            failed: BTreeMap::new(),
            retried: BTreeSet::new(),
            retired: false,
        }
    }

    /// Returns the first frame from `number` on whose pixels are kept.
    pub(crate) fn first_kept(&self, number: u64) -> Option<u64> {
        self.frames.range(number..).next().map(|(number, _)| *number)
    }

    /// Whether it is over and has failed frames that may be drawn again.
    pub(crate) fn may_retry(&self) -> bool {
        matches!(self.view.state, JobState::Incomplete(_)) && !self.failed.is_empty()
    }

    /// The end of the job, if all its frames have come to one.
    fn end(&self) -> Option<JobState> {
        let ended = self.ever_done.len() + self.failed.len();
        if (ended as u64) < self.view.frames_total || self.view.state.is_over() {
            return None;
        }
        let Some((number, reason)) = self.failed.first_key_value() else {
            return Some(JobState::Done);
        };
        let number = self.request.path.first_frame() as u64 + number;
        let (failed, total) = (self.failed.len(), self.view.frames_total);
        let said = format!("{failed} of {total} frames failed; frame {number}: {reason}");
        Some(JobState::Incomplete(said))
    }

    fn count(&mut self) {
        self.view.frames_done = self.ever_done.len() as u64;
        self.view.frames_failed = self.failed.len() as u64;
    }

    /// Whether it keeps a frame that nobody has taken.
    pub(crate) fn has_untaken(&self) -> bool {
        self.untaken.0 > 0
    }

    fn count_untaken(&mut self, bytes: usize) {
        self.untaken.0 += 1;
        self.untaken.1 += bytes;
    }

    fn discount_untaken(&mut self, bytes: usize) {
        self.untaken.0 -= 1;
        self.untaken.1 -= bytes;
    }
}

/// All jobs that are remembered.
///
/// The driver asks at every event whether there is room for another frame, so the bytes of frames
/// are counted as they come and go.
#[derive(Default)]
pub(crate) struct Table {
    jobs: BTreeMap<JobId, Job>,
    by_key: BTreeMap<String, JobId>,
    last_id: u64,
    /// Bytes of all frames that are kept.
    bytes: usize,
    /// Bytes of those that nobody has taken, of jobs that are not over.
    untaken_bytes: usize,
}

impl Table {
    pub(crate) fn get(&self, id: JobId) -> Option<&Job> {
        self.jobs.get(&id)
    }

    /// All jobs, oldest first.
    pub(crate) fn jobs(&self) -> impl Iterator<Item = &Job> {
        self.jobs.values()
    }

    /// The job of a client's key.
    pub(crate) fn by_key(&self, key: &str) -> Option<&Job> {
        self.jobs.get(self.by_key.get(key)?)
    }

    /// Changes what a job's view says, but not its state.
    pub(crate) fn update(&mut self, id: JobId, change: impl FnOnce(&mut JobView)) {
        if let Some(job) = self.jobs.get_mut(&id) {
            change(&mut job.view);
        }
    }

    /// Id for the next job.
    pub(crate) fn next_id(&mut self) -> JobId {
        self.last_id += 1;
        JobId(self.last_id)
    }

    /// Adds a job. Forgets the oldest jobs that are over beyond [`MAX_JOBS`].
    pub(crate) fn insert(&mut self, job: Job) {
        self.by_key.insert(job.view.client_key.clone(), job.view.id);
        self.jobs.insert(job.view.id, job);
        while self.jobs.len() > MAX_JOBS {
            let Some(id) =
                self.jobs.iter().find(|(_, j)| j.view.state.is_over()).map(|(id, _)| *id)
            else {
                return;
            };
            if let Some(job) = self.jobs.remove(&id) {
                self.by_key.remove(&job.view.client_key);
                self.bytes -= job.frames.values().map(|f| f.bytes.len()).sum::<usize>();
            }
        }
    }

    /// Sets the state of a job that is not over.
    pub(crate) fn set_state(&mut self, id: JobId, state: JobState) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        if job.view.state.is_over() {
            return;
        }
        if state.is_over() {
            job.view.finished_unix_ms = unix_ms();
            self.untaken_bytes -= job.untaken.1;
        }
        job.view.state = state;
    }

    /// Notes that dropped frames of a job can't be rendered again.
    pub(crate) fn retire(&mut self, id: JobId) {
        if let Some(job) = self.jobs.get_mut(&id) {
            job.retired = true;
        }
    }

    /// Puts a finished frame in. True if it was the last that its job lacked: the job is over
    /// then, in one step with its last frame, so that whoever sees that frame sees the state.
    pub(crate) fn put(&mut self, id: JobId, frame: FinishedFrame) -> bool {
        let Some(job) = self.jobs.get_mut(&id) else { return false };
        let (number, bytes) = (frame.number, frame.bytes.len());
        let is_open = !job.view.state.is_over();
        let was_taken = job.taken.remove(&number);
        if let Some(before) = job.frames.insert(number, Arc::new(frame)) {
            let before = before.bytes.len();
            self.bytes -= before;
            if !was_taken {
                job.discount_untaken(before);
                self.untaken_bytes -= if is_open { before } else { 0 };
            }
        }
        self.bytes += bytes;
        job.count_untaken(bytes);
        self.untaken_bytes += if is_open { bytes } else { 0 };
        job.ever_done.insert(number);
        job.failed.remove(&number);
        job.count();
        let end = job.end();
        let is_over = end.is_some();
        end.into_iter().for_each(|end| self.set_state(id, end));
        is_over
    }

    /// Notes that a frame can't be drawn, and why. True if it was the last that its job lacked:
    /// the job is over then.
    pub(crate) fn fail_frame(&mut self, id: JobId, number: u64, reason: String) -> bool {
        let Some(job) = self.jobs.get_mut(&id) else { return false };
        // A path of 100,000 frames that all fail for one reason holds it once.
        let last = job.failed.last_key_value().map(|(_, last)| last.clone());
        let reason = match last {
            Some(last) if job.failed.len() >= MAX_REASONS || *last == *reason => last,
            _ => reason.into(),
        };
        job.failed.insert(number, reason);
        // It may have been drawn, dropped and asked for again.
        job.ever_done.remove(&number);
        job.wanted_again.remove(&number);
        job.retried.remove(&number);
        job.count();
        let end = job.end();
        let is_over = end.is_some();
        end.into_iter().for_each(|end| self.set_state(id, end));
        is_over
    }

    /// Why a frame failed, if it did.
    fn failure(&self, id: JobId, number: u64) -> Option<Arc<str>> {
        self.jobs.get(&id)?.failed.get(&number).cloned()
    }

    /// Puts a job that is over back to work for the frames that failed. Returns how many.
    pub(crate) fn reopen(&mut self, id: JobId) -> usize {
        let Some(job) = self.jobs.get_mut(&id).filter(|job| job.may_retry()) else { return 0 };
        job.retried.extend(std::mem::take(&mut job.failed).into_keys());
        job.view.state = JobState::Queued;
        job.view.finished_unix_ms = 0;
        job.retired = false;
        job.count();
        self.untaken_bytes += job.untaken.1;
        job.retried.len()
    }

    /// Takes a frame for a watcher; the table keeps it.
    fn take(&mut self, id: JobId, number: u64) -> Option<Arc<FinishedFrame>> {
        let job = self.jobs.get_mut(&id)?;
        let frame = job.frames.get(&number)?.clone();
        if job.taken.insert(number) {
            job.discount_untaken(frame.bytes.len());
            if !job.view.state.is_over() {
                self.untaken_bytes -= frame.bytes.len();
            }
        }
        job.wanted_again.remove(&number);
        Some(frame)
    }

    /// Asks for a frame again if it was finished and dropped. True if that is new.
    fn want_again(&mut self, id: JobId, number: u64) -> bool {
        let Some(job) = self.jobs.get_mut(&id) else { return false };
        job.ever_done.contains(&number)
            && !job.frames.contains_key(&number)
            && job.wanted_again.insert(number)
    }

    /// Notes that a frame is being rendered again.
    pub(crate) fn rendering_again(&mut self, id: JobId, number: u64) {
        if let Some(job) = self.jobs.get_mut(&id) {
            job.wanted_again.remove(&number);
            job.retried.remove(&number);
        }
    }

    /// Bytes of frames that wait for a watcher, of jobs that are not over.
    pub(crate) fn untaken_bytes(&self) -> usize {
        self.untaken_bytes
    }

    /// Drops frames until `budget_bytes` holds, oldest jobs and lowest numbers first: those that
    /// were taken, then those of jobs that are over. A frame of a job in progress that nobody has
    /// taken stays; so does `newest`, which came just now, until the next one comes. Else a frame
    /// larger than the budget would be dropped before its watcher sees it, asked for again,
    /// rendered again and dropped again, for ever.
    pub(crate) fn evict(&mut self, budget_bytes: usize, newest: (JobId, u64)) {
        for over_too in [false, true] {
            for (id, job) in &mut self.jobs {
                if self.bytes <= budget_bytes {
                    return;
                }
                let is_over = job.view.state.is_over();
                let may_go = |n: &u64| {
                    (*id, *n) != newest && (job.taken.contains(n) || (over_too && is_over))
                };
                let droppable: Vec<u64> = job.frames.keys().copied().filter(may_go).collect();
                for number in droppable {
                    if self.bytes <= budget_bytes {
                        return;
                    }
                    let Some(frame) = job.frames.remove(&number) else { continue };
                    self.bytes -= frame.bytes.len();
                    if !job.taken.contains(&number) {
                        // The job is over, so the table does not count it.
                        job.discount_untaken(frame.bytes.len());
                    }
                }
            }
        }
    }
}

/// The table, and two bells: one rings at each tile, the other when anything else changes.
pub(crate) struct Jobs {
    table: Mutex<Table>,
    bell: watch::Sender<u64>,
    tile_bell: watch::Sender<u64>,
}

impl Jobs {
    /// A table whose first job has the id `last_id + 1`.
    pub(crate) fn starting_after(last_id: u64) -> Self {
        let table = Table { last_id, ..Table::default() };
        let [bell, tile_bell] = [(); 2].map(|()| watch::channel(0).0);
        Jobs { table: Mutex::new(table), bell, tile_bell }
    }

    /// Locks the table: for moments only, never across an await.
    pub(crate) fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Wakes the watchers.
    pub(crate) fn ring(&self) {
        self.bell.send_modify(|n| *n += 1);
    }

    /// Tells watchers of a tile. They look when they next have time for such news
    /// ([`watcher::TILE_NEWS`]).
    pub(crate) fn ring_tile(&self) {
        self.tile_bell.send_modify(|n| *n += 1);
    }

    /// Receivers of both bells.
    fn listen(&self) -> (watch::Receiver<u64>, watch::Receiver<u64>) {
        (self.bell.subscribe(), self.tile_bell.subscribe())
    }
}
