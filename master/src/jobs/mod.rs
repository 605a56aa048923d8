//! Jobs: view paths that clients submitted, their frames, and their watchers.
//!
//! The table is shared: the driver puts frames in, watchers take them out. A watcher is a cursor,
//! so that it may come late, twice, or again after its connection broke. Frames that no watcher has
//! taken are never dropped while their job runs; instead the driver stops rendering ahead when they
//! fill their half of the budget (back-pressure). The other half is for frames that a watcher waits
//! for, so that frames which nobody takes stop nobody. Frames that were taken are kept while there
//! is room, and rendered again when a watcher asks for one that was dropped: a frame is a pure
//! function of its job. So a watcher that reads slowly holds its frame for `IN_HAND` and no
//! longer.

pub(crate) mod active;
mod numbers;
pub mod submit;
#[cfg(test)]
mod tests;
mod watcher;
mod window;

pub use watcher::{Watch, WatchItem};

use crate::handle::unix_ms;
use crate::memory::mib;
use active::Submitter;
use bytes::Bytes;
use numbers::Numbers;
use slabcast_common::ids::JobId;
use slabcast_common::image::PixelFormat;
use slabcast_common::occlusion::Rect;
use slabcast_common::stats::FrameStats;
use slabcast_common::volume::Digest32;
use slabcast_scene::path::Framing;
use slabcast_scene::request::PathRequest;
use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use submit::SubmitError;
use tokio::sync::watch;
use tokio::time::Instant;

/// Most jobs that a master remembers. Beyond it, the oldest jobs that are over are forgotten.
pub const MAX_JOBS: usize = 1000;

/// Reasons of failed frames that a job keeps; later failures are told by the last of them.
const MAX_REASONS: usize = 100;
/// Most jobs in progress.
const MAX_OPEN_JOBS: usize = 200;
/// Divisor of the memory for requests: one address may have this part of it. Undivided, eight
/// flights of 10,000 eyes from one address turn everybody else away.
const PEER_SHARE_DIVISOR: usize = 2;

/// Time for which a frame that a watcher took is not dropped for others'. A frame of 256 MiB takes
/// 2 s over a gigabit. At half, such a watcher has it drawn twice; at twice this, a reader that
/// stalls keeps others waiting for as long.
pub(crate) const IN_HAND: Duration = Duration::from_secs(5);

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

    /// Whether frames of such a job are still rendered, or rendered again.
    pub(crate) fn may_render(&self) -> bool {
        !matches!(self, JobState::Failed(_) | JobState::Cancelled)
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
    /// Text of the last refusal of a tile; `None` if a tile was drawn since.
    pub trouble: Option<String>,
    /// Number of workers that are linked to the master.
    pub workers: u32,
    /// Width and height of the pictures, in pixels.
    pub size: [u32; 2],
    /// Format of the pixels that the job delivers.
    pub format: PixelFormat,
    /// Target and height that the path was given, if it asked for them.
    pub framing: Option<Framing>,
    /// Digest of the volume that it draws.
    pub volume: Digest32,
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

/// A tile of a frame whose other tiles are still drawn. It has the bytes of the finished frame, unless
/// the frame is drawn again because its worker was found to draw false pixels.
#[derive(Clone, Debug)]
pub struct DrawnTile {
    /// Rectangle of the tile in the frame, in pixels.
    pub place: Rect,
    /// Pixels in the job's format, row by row from the top left of the tile.
    pub bytes: Vec<u8>,
}

impl FinishedFrame {
    /// Bytes that the frame takes: pixels, statistics in both forms, spans.
    pub(crate) fn held_bytes(&self) -> usize {
        // Statistics take as structures some two times what they take as text.
        let trace = self.trace_json.as_ref().map_or(0, String::len);
        self.bytes.len() + 3 * self.stats_json.len() + trace
    }
}

/// A frame that the table keeps.
struct Kept {
    frame: Arc<FinishedFrame>,
    bytes: usize,
    /// Whether a watcher has taken it.
    taken: bool,
}

/// A job in the table.
pub(crate) struct Job {
    pub(crate) view: JobView,
    pub(crate) request: Arc<PathRequest>,
    /// Whom it is drawn for.
    pub(crate) submitter: Submitter,
    /// Frames that are kept, by number.
    frames: BTreeMap<u64, Kept>,
    /// Numbers of frames that were finished at least once.
    ever_done: Numbers,
    /// Number and bytes of the kept frames that no watcher has taken.
    untaken: (usize, usize),
    /// Frames that failed, and why.
    failed: BTreeMap<u64, Arc<str>>,
    /// Numbers of frames that failed and are to be drawn again.
    pub(crate) retried: BTreeSet<u64>,
    /// Numbers of frames that watchers wait for now, and how many do.
    waiting: BTreeMap<u64, u32>,
    /// Bytes that the request takes with all that was made of it.
    held_bytes: usize,
    /// Whether frames that were dropped can't be rendered again.
    retired: bool,
}

impl Job {
    /// A job without frames, whose request takes `held_bytes` with all that was made of it.
    pub(crate) fn new(view: JobView, request: Arc<PathRequest>, held_bytes: usize) -> Job {
        Job {
            view,
            request,
            submitter: Submitter::Batch(None),
            frames: BTreeMap::new(),
            ever_done: Numbers::default(),
            untaken: (0, 0),
            failed: BTreeMap::new(),
            retried: BTreeSet::new(),
            waiting: BTreeMap::new(),
            held_bytes,
            retired: false,
        }
    }

    /// The frames that watchers wait for and that are not there, lowest first.
    pub(crate) fn missing(&self) -> impl Iterator<Item = u64> {
        let is_there = |n: &u64| self.frames.contains_key(n) || self.failed.contains_key(n);
        self.waiting.keys().copied().filter(move |n| !is_there(n))
    }

    /// Whether a frame was finished at least once, or failed.
    pub(crate) fn has_ended(&self, number: u64) -> bool {
        self.ever_done.contains(number) || self.failed.contains_key(&number)
    }

    /// Returns the first frame from `number` on whose pixels are kept.
    pub(crate) fn first_kept(&self, number: u64) -> Option<u64> {
        self.frames.range(number..).next().map(|(number, _)| *number)
    }

    /// Returns the first frame that is kept.
    pub(crate) fn kept_frame(&self) -> Option<Arc<FinishedFrame>> {
        self.frames.values().next().map(|kept| kept.frame.clone())
    }

    /// Whether it is over and has failed frames that may be drawn again.
    pub(crate) fn may_retry(&self) -> bool {
        matches!(self.view.state, JobState::Incomplete(_)) && !self.failed.is_empty()
    }

    /// The end of the job, if all its frames have come to one.
    fn end(&self) -> Option<JobState> {
        let ended = self.ever_done.len() + self.failed.len() as u64;
        if ended < self.view.frames_total || self.view.state.is_over() {
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
        self.view.frames_done = self.ever_done.len();
        self.view.frames_failed = self.failed.len() as u64;
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
    /// Bytes of all jobs' requests, and how many there may be.
    held_bytes: usize,
    most_held_bytes: usize,
    /// Bytes of each request that is being checked, and its address.
    checking: Vec<(usize, Option<IpAddr>)>,
    /// Frames that watchers took and have not sent on: how many hold one, and until when it stays.
    in_hand: BTreeMap<(JobId, u64), (u32, Instant)>,
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

    /// Checks that there is a place for a job from `peer` whose request takes `bytes`.
    ///
    /// # Errors
    /// [`SubmitError::Full`] with the figures.
    pub(crate) fn has_place(&self, bytes: usize, peer: Option<IpAddr>) -> Result<(), SubmitError> {
        let open = self.jobs.values().filter(|job| !job.view.state.is_over());
        self.has_place_among(open.map(|job| (job.held_bytes, job.submitter.peer())), bytes, peer)
    }

    /// Checks that there is a place for a request of `bytes` from `peer` beside the requests `others`
    /// (bytes and address of each). Requests of this process (`None`) may take all of the memory.
    fn has_place_among(
        &self,
        others: impl Iterator<Item = (usize, Option<IpAddr>)>,
        bytes: usize,
        peer: Option<IpAddr>,
    ) -> Result<(), SubmitError> {
        let (mut all, mut own) = ((0, 0), (0, 0));
        for (held, of) in others {
            all = (all.0 + 1, all.1 + held);
            if of == peer {
                own = (own.0 + 1, own.1 + held);
            }
        }
        if all.0 >= MAX_OPEN_JOBS {
            return Err(SubmitError::Full(format!(
                "the master has {} jobs in progress, as many as it takes; wait, or cancel one",
                all.0
            )));
        }
        let most = self.most_held_bytes;
        let most_of_a_peer = most / PEER_SHARE_DIVISOR;
        if peer.is_some() && own.1 + bytes > most_of_a_peer {
            return Err(SubmitError::Full(format!(
                "the requests of the {} jobs in progress from your address take {}, this one {}, \
                 and one address may have {} of the {} that the master has for requests; wait, \
                 cancel one, or submit the path in parts",
                own.0,
                mib(own.1 as u64),
                mib(bytes as u64),
                mib(most_of_a_peer as u64),
                mib(most as u64)
            )));
        }
        if all.1 + bytes > most {
            return Err(SubmitError::Full(format!(
                "the requests of the {} jobs in progress take {}, this one {}, and the master has \
                 {} for them; wait, or submit the path in parts",
                all.0,
                mib(all.1 as u64),
                mib(bytes as u64),
                mib(most as u64)
            )));
        }
        Ok(())
    }

    /// Adds a job. Forgets the oldest jobs that are over beyond [`MAX_JOBS`] and beyond the bytes
    /// that requests may take.
    pub(crate) fn insert(&mut self, job: Job) {
        self.by_key.insert(job.view.client_key.clone(), job.view.id);
        self.held_bytes += job.held_bytes;
        self.jobs.insert(job.view.id, job);
        while self.jobs.len() > MAX_JOBS || self.held_bytes > self.most_held_bytes {
            let Some(id) =
                self.jobs.iter().find(|(_, j)| j.view.state.is_over()).map(|(id, _)| *id)
            else {
                return;
            };
            self.forget(id);
        }
    }

    /// Forgets a job that is over.
    pub(crate) fn forget(&mut self, id: JobId) {
        if let Some(job) = self.jobs.remove(&id) {
            self.by_key.remove(&job.view.client_key);
            self.bytes -= job.frames.values().map(|f| f.bytes).sum::<usize>();
            self.held_bytes -= job.held_bytes;
            self.in_hand.retain(|(of, _), _| *of != id);
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

    /// Notes that dropped frames of a job that is over can't be rendered again.
    pub(crate) fn retire(&mut self, id: JobId) {
        if let Some(job) = self.jobs.get_mut(&id) {
            // A watcher that looks now ends with this state as its last.
            debug_assert!(job.view.state.is_over(), "{id} is retired as {:?}", job.view.state);
            job.retired = true;
        }
    }

    /// Puts a finished frame in. True if it was the last that its job lacked: the job is over
    /// then, in one step with its last frame, so that whoever sees that frame sees the state.
    pub(crate) fn put(&mut self, id: JobId, frame: FinishedFrame) -> bool {
        let Some(job) = self.jobs.get_mut(&id) else { return false };
        let (number, bytes) = (frame.number, frame.held_bytes());
        let is_open = !job.view.state.is_over();
        let kept = Kept { frame: Arc::new(frame), bytes, taken: false };
        if let Some(before) = job.frames.insert(number, kept) {
            self.bytes -= before.bytes;
            if !before.taken {
                job.discount_untaken(before.bytes);
                self.untaken_bytes -= if is_open { before.bytes } else { 0 };
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
        job.ever_done.remove(number);
        job.retried.remove(&number);
        job.count();
        let end = job.end();
        let is_over = end.is_some();
        end.into_iter().for_each(|end| self.set_state(id, end));
        is_over
    }

    /// Notes that a frame that was being drawn is to be drawn again.
    pub(crate) fn draw_again(&mut self, id: JobId, number: u64) {
        if let Some(job) = self.jobs.get_mut(&id) {
            job.retried.insert(number);
        }
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

    /// Takes a frame for a watcher; the table keeps it, for [`IN_HAND`] at least unless the watcher
    /// puts it back before ([`Table::put_back`]).
    fn take(&mut self, id: JobId, number: u64) -> Option<Arc<FinishedFrame>> {
        let frame = self.look_at(id, number)?;
        let hand = self.in_hand.entry((id, number)).or_insert((0, Instant::now()));
        *hand = (hand.0 + 1, Instant::now() + IN_HAND);
        Some(frame)
    }

    /// Takes a frame without holding on to it.
    fn look_at(&mut self, id: JobId, number: u64) -> Option<Arc<FinishedFrame>> {
        let job = self.jobs.get_mut(&id)?;
        let kept = job.frames.get_mut(&number)?;
        let (frame, bytes) = (kept.frame.clone(), kept.bytes);
        if !std::mem::replace(&mut kept.taken, true) {
            job.discount_untaken(bytes);
            if !job.view.state.is_over() {
                self.untaken_bytes -= bytes;
            }
        }
        Some(frame)
    }

    /// Notes that a frame is being rendered.
    pub(crate) fn begins(&mut self, id: JobId, number: u64) {
        if let Some(job) = self.jobs.get_mut(&id) {
            job.retried.remove(&number);
        }
    }

    /// Notes that a watcher no longer needs a frame that it took.
    fn put_back(&mut self, id: JobId, number: u64) {
        if let Some(hand) = self.in_hand.get_mut(&(id, number)) {
            hand.0 -= 1;
            if hand.0 == 0 {
                self.in_hand.remove(&(id, number));
            }
        }
    }

    /// Notes that a watcher waits for a frame. True if the frame is not there, so that somebody has
    /// to be told.
    fn wait_for(&mut self, id: JobId, number: u64) -> bool {
        let Some(job) = self.jobs.get_mut(&id) else { return false };
        *job.waiting.entry(number).or_insert(0) += 1;
        !job.frames.contains_key(&number)
    }

    /// Notes that a watcher waits no longer for a frame.
    fn waits_no_more(&mut self, id: JobId, number: u64) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        if let Some(watchers) = job.waiting.get_mut(&number) {
            *watchers -= 1;
            if *watchers == 0 {
                job.waiting.remove(&number);
            }
        }
    }

    /// Bytes of frames that wait for a watcher, of jobs that are not over.
    pub(crate) fn untaken_bytes(&self) -> usize {
        self.untaken_bytes
    }

    /// Bytes of frames that watchers hold and that may not be dropped yet.
    pub(crate) fn in_hand_bytes(&self) -> usize {
        let now = Instant::now();
        let held = self.in_hand.iter().filter(|(_, (_, until))| *until > now);
        let kept = held.filter_map(|((id, n), _)| self.jobs.get(id)?.frames.get(n));
        kept.map(|kept| kept.bytes).sum()
    }

    /// Drops frames until `budget_bytes` holds, oldest jobs and lowest numbers first: those that
    /// were taken, then those of jobs that are over. A frame of a job in progress that nobody has
    /// taken stays, and so does one that a watcher has in hand or waits for. `newest`, which came
    /// just now, stays until the next one comes. Else a frame larger than the budget would be
    /// dropped before its watcher sees it, asked for again, rendered again and dropped again, for
    /// ever.
    pub(crate) fn evict(&mut self, budget_bytes: usize, newest: Option<(JobId, u64)>) {
        let now = Instant::now();
        for over_too in [false, true] {
            for (id, job) in &mut self.jobs {
                if self.bytes <= budget_bytes {
                    return;
                }
                let is_over = job.view.state.is_over();
                let in_hand = &self.in_hand;
                let may_go = |n: u64, kept: &Kept| {
                    Some((*id, n)) != newest
                        && !job.waiting.contains_key(&n)
                        && in_hand.get(&(*id, n)).is_none_or(|(_, until)| *until <= now)
                        && (kept.taken || (over_too && is_over))
                };
                let droppable: Vec<u64> =
                    job.frames.iter().filter(|(n, kept)| may_go(**n, kept)).map(|f| *f.0).collect();
                for number in droppable {
                    if self.bytes <= budget_bytes {
                        return;
                    }
                    let Some(kept) = job.frames.remove(&number) else { continue };
                    self.bytes -= kept.bytes;
                    if !kept.taken {
                        // The job is over, so the table does not count it.
                        job.discount_untaken(kept.bytes);
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
    /// A table whose first job has the id `last_id + 1`, and whose jobs' requests may take
    /// `most_held_bytes`.
    pub(crate) fn new(last_id: u64, most_held_bytes: usize) -> Self {
        let table = Table { last_id, most_held_bytes, ..Table::default() };
        let [bell, tile_bell] = [(); 2].map(|()| watch::channel(0).0);
        Jobs { table: Mutex::new(table), bell, tile_bell }
    }

    /// Locks the table: for moments only, never across an await.
    pub(crate) fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reserves a place for a request of `bytes` while it is checked: decoded requests would pile up
    /// before the check otherwise, 70 times as large as they came.
    ///
    /// # Errors
    /// [`SubmitError::Full`] with the figures.
    pub(crate) fn reserve(
        self: &Arc<Self>,
        bytes: usize,
        peer: Option<IpAddr>,
        most_of_a_peer: usize,
    ) -> Result<Checking, SubmitError> {
        let mut table = self.lock();
        let open = table.jobs.values().filter(|job| !job.view.state.is_over());
        let others: Vec<(usize, Option<IpAddr>)> = open
            .map(|job| (job.held_bytes, job.submitter.peer()))
            .chain(table.checking.iter().copied())
            .collect();
        let of_peer = others.iter().filter(|other| other.1 == peer).count();
        if peer.is_some() && of_peer >= most_of_a_peer {
            return Err(SubmitError::Full(format!(
                "{of_peer} jobs from your address are in progress, as many as one address may have \
                 (--peer-jobs of the master); wait, cancel one, or put several views into one path"
            )));
        }
        table.has_place_among(others.iter().copied(), bytes, peer)?;
        table.checking.push((bytes, peer));
        Ok(Checking { jobs: self.clone(), entry: (bytes, peer) })
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

/// A place of a request that is being checked, from [`Jobs::reserve`].
pub(crate) struct Checking {
    jobs: Arc<Jobs>,
    entry: (usize, Option<IpAddr>),
}

impl Drop for Checking {
    fn drop(&mut self) {
        let mut table = self.jobs.lock();
        if let Some(i) = table.checking.iter().position(|entry| *entry == self.entry) {
            table.checking.swap_remove(i);
        }
    }
}
