//! Jobs: view paths that clients submitted, their frames, and those who wait for them.
//!
//! The table is shared: the driver puts frames in, watchers take them out. A watcher is a
//! cursor, so it may come late, twice, or again after its connection broke. Frames that nobody
//! has taken yet are never dropped; instead the driver stops rendering ahead when they fill the
//! budget. Frames that were taken are kept while there is room and rendered again when somebody
//! asks for one that is gone: a frame is a pure function of its job.

use bytes::Bytes;
use slabcast_common::ids::JobId;
use slabcast_common::image::PixelFormat;
use slabcast_common::message::PathRequest;
use slabcast_common::stats::FrameStats;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;
use tokio::sync::watch::{self, error::RecvError};
use tokio::time::Instant;

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
    bell: watch::Sender<u64>,
    tiles: watch::Sender<u64>,
}

impl Jobs {
    /// A table whose first job has the number after `next`.
    pub(crate) fn starting_at(next: u64) -> Self {
        let table = Table { next, ..Table::default() };
        Jobs { table: Mutex::new(table), bell: watch::channel(0).0, tiles: watch::channel(0).0 }
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
    pub(crate) fn listen(&self) -> (watch::Receiver<u64>, watch::Receiver<u64>) {
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

/// What a watcher gets next.
#[derive(Clone, Debug)]
pub enum WatchItem {
    /// Something about the job changed (also before the first frame).
    Notice(JobView),
    /// The next frame, in order.
    Frame(Arc<FinishedFrame>),
}

/// How often a watcher hears of tiles. A frame of 64 tiles may take 20 ms: a notice each woke a thread
/// some 3000 times a second, and was 3 % of a processor.
pub(crate) const NEWS: Duration = Duration::from_millis(40);

/// What a notice tells: state, frames done, tiles, slab, workers.
pub(crate) type Told = (JobState, u64, (u32, u32), (u32, u32), u32);

/// A cursor over a job's frames.
pub struct Watch {
    pub(crate) jobs: Arc<Jobs>,
    pub(crate) job: JobId,
    pub(crate) next: u64,
    pub(crate) bells: (watch::Receiver<u64>, watch::Receiver<u64>),
    pub(crate) last_notice: Option<Told>,
    /// Until when it does not listen to tiles.
    pub(crate) quiet: Option<Instant>,
    pub(crate) taken: tokio::sync::mpsc::Sender<crate::driver::Event>,
    pub(crate) over: bool,
}

impl Watch {
    /// The next notice or frame; `None` after the last frame, or after the notice that says
    /// that there will be none.
    pub async fn next(&mut self) -> Option<WatchItem> {
        loop {
            if self.over {
                return None;
            }
            let poke = {
                // Seen before the table is read, so that no ring is missed.
                self.bells.0.borrow_and_update();
                let quiet = self.quiet.is_some_and(|until| Instant::now() < until);
                if !quiet {
                    self.bells.1.borrow_and_update();
                }
                let mut table = self.jobs.lock();
                let Some(job) = table.jobs.get_mut(&self.job) else {
                    self.over = true;
                    return None;
                };
                if let Some(frame) = job.frames.get(&self.next).cloned() {
                    job.taken.insert(self.next);
                    job.wanted_again.remove(&self.next);
                    self.next += 1;
                    drop(table);
                    // The driver may render ahead again. If it is busy it will see for itself.
                    let _ = self.taken.try_send(crate::driver::Event::FrameTaken);
                    return Some(WatchItem::Frame(frame));
                }
                let v = &job.view;
                let now = (v.state.clone(), v.frames_done, v.tiles, v.slab, v.workers);
                if self.next >= v.frames_total
                    || matches!(v.state, JobState::Failed(_) | JobState::Cancelled)
                    || job.retired
                {
                    self.over = true;
                    return Some(WatchItem::Notice(v.clone()));
                }
                let news = |last: &Told| {
                    let (was, is) = ((&last.0, last.1, last.4), (&now.0, now.1, now.4));
                    was != is || !quiet && (last.2, last.3) != (now.2, now.3)
                };
                if self.last_notice.as_ref().is_none_or(news) {
                    self.last_notice = Some(now);
                    self.quiet = Some(Instant::now() + NEWS);
                    return Some(WatchItem::Notice(v.clone()));
                }
                // Done once and gone since: ask for it again.
                job.ever_done.contains(&self.next) && job.wanted_again.insert(self.next)
            };
            if poke && self.taken.send(crate::driver::Event::FrameTaken).await.is_err() {
                self.over = true;
                return None;
            }
            if self.rung().await.is_err() {
                self.over = true;
                return None;
            }
        }
    }

    /// Waits until there may be something new.
    async fn rung(&mut self) -> Result<(), RecvError> {
        let (bell, tiles) = &mut self.bells;
        let quiet = self.quiet;
        let tile = async {
            if let Some(until) = quiet {
                tokio::time::sleep_until(until).await;
            }
            tiles.changed().await
        };
        tokio::select! {
            rung = bell.changed() => rung,
            rung = tile => rung,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::image::Background;
    use slabcast_common::message::TransferChoice;
    use slabcast_common::path::{Turntable, ViewPath};
    use slabcast_common::quality::{Quality, Work};

    fn frame(number: u64, bytes: usize) -> Arc<FinishedFrame> {
        let stats = FrameStats {
            v: 1,
            frame: number,
            schedule: slabcast_common::quality::Schedule::Slab,
            view_sha256: String::new(),
            pixels_sha256: String::new(),
            pixels_version: 1,
            ms: Default::default(),
            workers: vec![],
            voxels: Default::default(),
            bricks: Default::default(),
            result_bytes: None,
            slabs: vec![],
            quality: Quality::default(),
            left_out: vec![],
            error: Default::default(),
            retries: 0,
            handed_over: 0,
            dropped_results: 0,
            poisoned: vec![],
            critical_path: None,
            rehearsed: false,
        };
        Arc::new(FinishedFrame {
            number,
            size: [1, 1],
            format: PixelFormat::Rgb8,
            bytes: vec![0; bytes].into(),
            stats,
            stats_json: String::new(),
            trace_json: None,
        })
    }

    /// A table with one job of four frames, of which `done` are there with ten bytes each.
    fn table(state: JobState, done: &[u64]) -> Jobs {
        let jobs = Jobs::starting_at(0);
        let id = JobId(1);
        let request = PathRequest {
            client_key: "k".into(),
            path: ViewPath::turn([1, 1], Turntable::default()),
            transfer: TransferChoice::Name("auto".into()),
            quality: Quality::default(),
            work: Work::default(),
            format: PixelFormat::Rgb8,
            background: Background::Transparent,
            want_trace: false,
            want_hash: true,
        };
        let view = JobView {
            id,
            client_key: "k".into(),
            state,
            frames_done: done.len() as u64,
            frames_total: 4,
            tiles: (0, 0),
            slab: (0, 0),
            workers: 1,
            size: [1, 1],
            format: PixelFormat::Rgb8,
            submitted_unix_ms: 0,
            finished_unix_ms: 0,
        };
        let job = Job {
            view,
            request: Arc::new(request),
            frames: done.iter().map(|&n| (n, frame(n, 10))).collect(),
            ever_done: done.iter().copied().collect(),
            taken: BTreeSet::new(),
            wanted_again: BTreeSet::new(),
            retired: false,
        };
        jobs.lock().jobs.insert(id, job);
        jobs
    }

    fn watch(
        jobs: &Arc<Jobs>,
        from: u64,
    ) -> (Watch, tokio::sync::mpsc::Receiver<crate::driver::Event>) {
        let (taken, events) = tokio::sync::mpsc::channel(8);
        let watch = Watch {
            jobs: jobs.clone(),
            job: JobId(1),
            next: from,
            bells: jobs.listen(),
            last_notice: None,
            quiet: None,
            taken,
            over: false,
        };
        (watch, events)
    }

    #[test]
    fn frames_that_nobody_took_are_never_dropped_while_the_job_runs() {
        let jobs = table(JobState::Running, &[0, 1, 2]);
        let mut table = jobs.lock();
        table.jobs.get_mut(&JobId(1)).unwrap().taken.insert(0);
        assert_eq!(table.bytes(), (20, 30));
        table.evict(5, (JobId(1), 2));
        let left: Vec<u64> = table.jobs[&JobId(1)].frames.keys().copied().collect();
        assert_eq!(left, [1, 2], "only what was taken goes");
        table.jobs.get_mut(&JobId(1)).unwrap().view.state = JobState::Done;
        table.evict(10, (JobId(1), 2));
        assert_eq!(table.jobs[&JobId(1)].frames.len(), 1, "of a job that is over others go too");
    }

    #[test]
    fn a_frame_larger_than_the_budget_waits_for_its_watcher() {
        let jobs = table(JobState::Done, &[2, 3]);
        let mut table = jobs.lock();
        let left = |t: &Table| t.jobs[&JobId(1)].frames.keys().copied().collect::<Vec<_>>();
        table.evict(5, (JobId(1), 3));
        assert_eq!(left(&table), [3], "the one that came just now stays");
        table.jobs.get_mut(&JobId(1)).unwrap().frames.insert(0, frame(0, 10));
        table.evict(5, (JobId(1), 0));
        assert_eq!(left(&table), [0], "until the next one comes");
    }

    #[tokio::test]
    async fn a_watcher_gets_frames_in_order_and_then_the_final_word() {
        let jobs = Arc::new(table(JobState::Running, &[1, 0]));
        let (mut watch, _events) = watch(&jobs, 0);
        for want in [0, 1] {
            let Some(WatchItem::Frame(f)) = watch.next().await else { panic!("frame {want}") };
            assert_eq!(f.number, want);
        }
        assert!(matches!(watch.next().await, Some(WatchItem::Notice(_))), "frame 2 is not done");
        {
            let mut table = jobs.lock();
            let job = table.jobs.get_mut(&JobId(1)).unwrap();
            job.frames.extend([(2, frame(2, 1)), (3, frame(3, 1))]);
            job.view.state = JobState::Done;
        }
        jobs.ring();
        assert!(matches!(watch.next().await, Some(WatchItem::Frame(_))));
        assert!(matches!(watch.next().await, Some(WatchItem::Frame(_))));
        let Some(WatchItem::Notice(last)) = watch.next().await else { panic!("a last word") };
        assert_eq!(last.state, JobState::Done);
        assert!(watch.next().await.is_none());
    }

    #[tokio::test]
    async fn a_frame_that_is_gone_is_asked_for_again() {
        let jobs = Arc::new(table(JobState::Done, &[1]));
        jobs.lock().jobs.get_mut(&JobId(1)).unwrap().ever_done.insert(0);
        let (mut watch, mut events) = watch(&jobs, 0);
        assert!(matches!(watch.next().await, Some(WatchItem::Notice(_))));
        let waiting = tokio::spawn(async move { watch.next().await });
        assert!(events.recv().await.is_some(), "the driver is woken");
        assert!(jobs.lock().jobs[&JobId(1)].wanted_again.contains(&0));
        jobs.lock().jobs.get_mut(&JobId(1)).unwrap().frames.insert(0, frame(0, 1));
        jobs.ring();
        let Some(WatchItem::Frame(f)) = waiting.await.unwrap() else { panic!("frame 0") };
        assert_eq!(f.number, 0);
    }

    #[tokio::test(start_paused = true)]
    async fn of_tiles_a_watcher_hears_now_and_then_and_of_the_last_one() {
        let jobs = Arc::new(table(JobState::Running, &[0]));
        let (mut watch, _events) = watch(&jobs, 1);
        assert!(matches!(watch.next().await, Some(WatchItem::Notice(_))));
        let drawn = jobs.clone();
        let drawing = tokio::spawn(async move {
            for tile in 1..=1000 {
                tokio::time::sleep(Duration::from_millis(1)).await;
                drawn.lock().jobs.get_mut(&JobId(1)).unwrap().view.tiles = (tile, 1000);
                drawn.ring_tile();
            }
            // A frame waits for nobody.
            drawn.lock().jobs.get_mut(&JobId(1)).unwrap().frames.insert(1, frame(1, 1));
            drawn.ring();
        });
        let began = Instant::now();
        let (mut notices, mut last) = (0, 0);
        while let Some(WatchItem::Notice(view)) = watch.next().await {
            (notices, last) = (notices + 1, view.tiles.0);
        }
        assert!((20..=26).contains(&notices), "{notices} notices of 1000 tiles in a second");
        assert!(last >= 950, "the last was of tile {last}");
        assert_eq!(began.elapsed(), Duration::from_secs(1), "the frame came at once");
        drawing.await.unwrap();
        // A tile after which nothing happens is told of.
        jobs.lock().jobs.get_mut(&JobId(1)).unwrap().view.tiles = (1, 64);
        jobs.ring_tile();
        let Some(WatchItem::Notice(view)) = watch.next().await else { panic!("a notice") };
        assert_eq!(view.tiles, (1, 64));
    }

    #[tokio::test]
    async fn a_watcher_of_a_cancelled_job_is_told_and_let_go() {
        let jobs = Arc::new(table(JobState::Cancelled, &[]));
        let (mut watch, _events) = watch(&jobs, 0);
        let Some(WatchItem::Notice(last)) = watch.next().await else { panic!("told") };
        assert_eq!(last.state, JobState::Cancelled);
        assert!(watch.next().await.is_none());
    }
}
