//! The table's budget and counters, and what watchers see.

use super::watcher::{TILE_NEWS, Watch, WatchItem};
use super::*;
use crate::driver::Event;
use slabcast_common::image::Background;
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Quality, Work};
use slabcast_scene::path::{Turntable, ViewPath};
use slabcast_scene::request::VolumeChoice;
use slabcast_scene::transfer::TransferChoice;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::time::Instant;

const JOB: JobId = JobId(1);

fn frame(number: u64, bytes: usize) -> FinishedFrame {
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
        quality: Quality::before(),
        left_out: vec![],
        error: Default::default(),
        level: None,
        retries: 0,
        handed_over: 0,
        dropped_results: 0,
        poisoned: vec![],
        critical_path: None,
        rehearsed: false,
    };
    FinishedFrame {
        number,
        size: [1, 1],
        format: PixelFormat::Rgb8,
        bytes: vec![0; bytes].into(),
        stats,
        stats_json: String::new(),
        trace_json: None,
    }
}

/// A job of `frames` frames that is running.
fn job(id: JobId, frames: u64) -> Job {
    let client_key = format!("key {id}");
    let request = PathRequest {
        client_key: client_key.clone(),
        volume: VolumeChoice::Default,
        level: LevelChoice::default(),
        path: ViewPath::from_turntable([1, 1], Turntable::default()),
        transfer: TransferChoice::Name("auto".into()),
        quality: Quality::before(),
        work: Work::default(),
        format: PixelFormat::Rgb8,
        background: Background::Transparent,
        want_trace: false,
        want_hash: true,
    };
    let view = JobView {
        id,
        client_key,
        state: JobState::Running,
        frames_done: 0,
        frames_failed: 0,
        frames_total: frames,
        tiles: (0, 0),
        slab: (0, 0),
        trouble: None,
        workers: 1,
        size: [1, 1],
        format: PixelFormat::Rgb8,
        framing: None,
        volume: Digest32::default(),
        submitted_unix_ms: 0,
        finished_unix_ms: 0,
    };
    Job::new(view, Arc::new(request), 100)
}

/// A table with one running job of four frames, of which `done` are kept with ten bytes each.
fn table(done: &[u64]) -> Arc<Jobs> {
    let jobs = Jobs::new(0, 1 << 20);
    let mut table = jobs.lock();
    table.insert(job(JOB, 4));
    for &number in done {
        table.put(JOB, frame(number, 10));
    }
    drop(table);
    Arc::new(jobs)
}

fn watch(jobs: &Arc<Jobs>, first: u64) -> (Watch, mpsc::Receiver<Event>) {
    let (driver, events) = mpsc::channel(8);
    (Watch::new(jobs.clone(), JOB, first, driver), events)
}

fn kept(table: &Table) -> Vec<u64> {
    table.jobs[&JOB].frames.keys().copied().collect()
}

#[test]
fn untaken_frames_are_never_dropped_while_their_job_runs() {
    let jobs = table(&[0, 1, 2]);
    let mut table = jobs.lock();
    assert!(table.look_at(JOB, 0).is_some());
    assert_eq!((table.untaken_bytes(), table.bytes), (20, 30));
    table.evict(5, Some((JOB, 2)));
    assert_eq!(kept(&table), [1, 2], "only the taken frame goes");
    table.set_state(JOB, JobState::Failed("for this test".into()));
    assert_eq!(table.untaken_bytes(), 0);
    table.evict(10, Some((JOB, 2)));
    assert_eq!(kept(&table), [2], "of a job that is over others go too");
}

#[test]
fn frame_larger_than_the_budget_waits_for_its_watcher() {
    let jobs = table(&[0, 1, 2, 3]);
    let mut table = jobs.lock();
    assert_eq!(table.jobs[&JOB].view.state, JobState::Done);
    table.evict(5, Some((JOB, 3)));
    assert_eq!(kept(&table), [3], "the one that came just now stays");
    table.put(JOB, frame(0, 10));
    table.evict(5, Some((JOB, 0)));
    assert_eq!(kept(&table), [0], "until the next one comes");
}

#[test]
fn last_frame_and_done_state_come_in_one_step() {
    let jobs = table(&[0, 1, 2]);
    let mut table = jobs.lock();
    assert!(table.put(JOB, frame(3, 10)));
    let view = &table.jobs[&JOB].view;
    assert!(view.state == JobState::Done && view.frames_done == 4 && view.finished_unix_ms > 0);
    assert!(!table.put(JOB, frame(3, 10)), "a frame that is rendered again ends nothing");
}

/// The counters against sums over all frames, after every step of seeded campaigns.
#[test]
fn counted_bytes_are_the_sums_over_all_frames() {
    for seed in 1..=50u64 {
        let mut x = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let mut below = |n: u64| {
            x ^= x << 13;
            x ^= x >> 7;
            x ^= x << 17;
            (x >> 11) % n
        };
        let mut table = Table { most_held_bytes: usize::MAX, ..Table::default() };
        for step in 0..400 {
            let id = JobId(1 + below(4));
            let number = below(6);
            match below(8) {
                0 if table.get(id).is_none() => table.insert(job(id, 6)),
                1..4 => drop(table.put(id, frame(number, below(30) as usize))),
                4 | 5 => drop(table.look_at(id, number)),
                6 => table.evict(below(200) as usize, Some((id, number))),
                _ if below(20) == 0 => table.set_state(id, JobState::Cancelled),
                _ => {}
            }
            let (mut all, mut untaken) = (0, 0);
            for job in table.jobs.values() {
                let mut of_job = (0, 0);
                for kept in job.frames.values() {
                    all += kept.frame.bytes.len();
                    if !kept.taken {
                        of_job = (of_job.0 + 1, of_job.1 + kept.frame.bytes.len());
                    }
                }
                assert_eq!(job.untaken, of_job, "seed {seed}, step {step}");
                untaken += if job.view.state.is_over() { 0 } else { of_job.1 };
            }
            let counted = (table.bytes, table.untaken_bytes);
            assert_eq!(counted, (all, untaken), "seed {seed}, step {step}");
        }
    }
}

#[test]
fn oldest_finished_jobs_are_forgotten_beyond_the_limit() {
    let mut table = Table { most_held_bytes: usize::MAX, ..Table::default() };
    for id in 1..=MAX_JOBS as u64 + 2 {
        table.insert(job(JobId(id), 1));
        // The first one never ends.
        if id > 1 {
            table.put(JobId(id), frame(0, 3));
        }
    }
    assert!(table.get(JobId(1)).is_some(), "a job in progress stays");
    assert!(table.get(JobId(2)).is_none() && table.get(JobId(3)).is_none());
    assert!(table.by_key("key job-2").is_none() && table.by_key("key job-4").is_some());
    assert_eq!(table.bytes, 3 * (MAX_JOBS - 1));
}

#[tokio::test]
async fn watcher_gets_frames_in_order_and_then_the_final_state() {
    let jobs = table(&[1, 0]);
    let (mut watch, _events) = watch(&jobs, 0);
    for want in [0, 1] {
        let Some(WatchItem::Frame(f)) = watch.next().await else { panic!("frame {want}") };
        assert_eq!(f.number, want);
    }
    assert!(matches!(watch.next().await, Some(WatchItem::Notice(_))), "frame 2 is not done");
    {
        let mut table = jobs.lock();
        table.put(JOB, frame(2, 1));
        table.put(JOB, frame(3, 1));
    }
    jobs.ring();
    assert!(matches!(watch.next().await, Some(WatchItem::Frame(_))));
    assert!(matches!(watch.next().await, Some(WatchItem::Frame(_))));
    let Some(WatchItem::Notice(last)) = watch.next().await else { panic!("a last notice") };
    assert_eq!(last.state, JobState::Done);
    assert!(watch.next().await.is_none());
}

/// Frames of a job are drawn side by side: the last one may be done first.
#[tokio::test]
async fn watcher_that_came_late_ends_with_its_job_and_not_with_its_last_frame() {
    let jobs = table(&[2, 3]);
    let (mut watch, _events) = watch(&jobs, 3);
    assert!(matches!(watch.next().await, Some(WatchItem::Frame(frame)) if frame.number == 3));
    let running = watch.next().await;
    assert!(matches!(running, Some(WatchItem::Notice(view)) if view.state == JobState::Running));
    for number in [0, 1] {
        jobs.lock().put(JOB, frame(number, 10));
    }
    jobs.ring();
    let last = watch.next().await;
    assert!(matches!(last, Some(WatchItem::Notice(view)) if view.state == JobState::Done));
    assert!(watch.next().await.is_none());
}

#[tokio::test]
async fn dropped_frame_is_asked_for_again() {
    let jobs = table(&[0, 1, 2, 3]);
    {
        let mut table = jobs.lock();
        table.look_at(JOB, 0);
        table.evict(35, Some((JOB, 3)));
        assert_eq!(kept(&table), [1, 2, 3]);
    }
    let (mut watch, mut events) = watch(&jobs, 0);
    assert!(matches!(watch.next().await, Some(WatchItem::Notice(_))));
    let waiting = tokio::spawn(async move { watch.next().await });
    assert!(events.recv().await.is_some(), "the driver is woken");
    assert_eq!(jobs.lock().jobs[&JOB].missing().collect::<Vec<_>>(), [0]);
    jobs.lock().put(JOB, frame(0, 1));
    jobs.ring();
    let Some(WatchItem::Frame(f)) = waiting.await.unwrap() else { panic!("frame 0") };
    assert_eq!(f.number, 0);
}

#[tokio::test(start_paused = true)]
async fn notices_of_tiles_are_rate_limited_and_the_last_one_comes() {
    let jobs = table(&[0]);
    let (mut watch, _events) = watch(&jobs, 1);
    assert!(matches!(watch.next().await, Some(WatchItem::Notice(_))));
    let drawn = jobs.clone();
    let drawing = tokio::spawn(async move {
        for tile in 1..=1000 {
            tokio::time::sleep(Duration::from_millis(1)).await;
            drawn.lock().update(JOB, |view| view.tiles = (tile, 1000));
            drawn.ring_tile();
        }
        // A frame waits for no quiet time.
        drawn.lock().put(JOB, frame(1, 1));
        drawn.ring();
    });
    let began = Instant::now();
    let (mut notices, mut last) = (0, 0);
    while let Some(WatchItem::Notice(view)) = watch.next().await {
        (notices, last) = (notices + 1, view.tiles.0);
    }
    let most = 1000 / TILE_NEWS.as_millis() as usize + 1;
    assert!((most - 6..=most).contains(&notices), "{notices} notices of 1000 tiles in a second");
    assert!(last >= 950, "the last was of tile {last}");
    assert_eq!(began.elapsed(), Duration::from_secs(1), "the frame came at once");
    drawing.await.unwrap();
    // A tile after which nothing happens is told of.
    jobs.lock().update(JOB, |view| view.tiles = (1, 64));
    jobs.ring_tile();
    let Some(WatchItem::Notice(view)) = watch.next().await else { panic!("a notice") };
    assert_eq!(view.tiles, (1, 64));
}

/// A reader that stalls keeps its frame for a while, and others get theirs.
#[tokio::test(start_paused = true)]
async fn frame_in_hand_stays_for_a_while_and_is_rendered_again_after() {
    let jobs = table(&[0, 1]);
    let (mut watch, mut events) = watch(&jobs, 0);
    assert!(matches!(watch.next().await, Some(WatchItem::Frame(_))));
    {
        let mut table = jobs.lock();
        assert_eq!(table.in_hand_bytes(), 10);
        table.evict(0, None);
        assert_eq!(kept(&table), [0, 1], "one is in hand, the other untaken");
    }
    tokio::time::advance(IN_HAND).await;
    {
        let mut table = jobs.lock();
        assert_eq!(table.in_hand_bytes(), 0);
        table.evict(0, None);
        assert_eq!(kept(&table), [1]);
    }
    events.recv().await.expect("it told that it took a frame");
    let reading = tokio::spawn(async move { watch.again(0).await.map(|f| f.number) });
    assert!(events.recv().await.is_some(), "the driver is woken");
    assert_eq!(jobs.lock().jobs[&JOB].missing().collect::<Vec<_>>(), [0]);
    jobs.lock().put(JOB, frame(0, 10));
    jobs.ring();
    assert_eq!(reading.await.unwrap(), Some(0));
    assert_eq!(jobs.lock().jobs[&JOB].missing().count(), 0, "it waits no more");
}

#[tokio::test]
async fn frame_that_a_watcher_waits_for_is_missing_until_the_watcher_leaves() {
    let jobs = table(&[]);
    let (mut watch, mut events) = watch(&jobs, 3);
    assert!(matches!(watch.next().await, Some(WatchItem::Notice(_))));
    let waiting = tokio::spawn(async move { watch.next().await.is_some() });
    events.recv().await.expect("the driver is woken");
    assert_eq!(jobs.lock().jobs[&JOB].missing().collect::<Vec<_>>(), [3]);
    waiting.abort();
    assert!(waiting.await.is_err());
    assert_eq!(jobs.lock().jobs[&JOB].missing().count(), 0);
}

#[test]
fn requests_of_jobs_in_progress_and_of_remembered_ones_are_bounded_in_bytes() {
    let mut table = Table { most_held_bytes: 1000, ..Table::default() };
    for id in 1..=30 {
        assert!(table.has_place(100, None).is_ok(), "job {id}");
        table.insert(job(JobId(id), 1));
        table.set_state(JobId(id), JobState::Cancelled);
        assert!(table.jobs.len() <= 10 && table.held_bytes <= 1000);
    }
    for id in 31..=40 {
        table.has_place(100, None).expect("ten fit");
        table.insert(job(JobId(id), 1));
    }
    let Err(SubmitError::Full(why)) = table.has_place(100, None) else { panic!("it is full") };
    assert!(why.contains("10 jobs in progress take 1 MiB"), "{why}");
    assert_eq!((table.jobs.len(), table.held_bytes), (10, 1000));
}

#[test]
fn requests_that_are_being_checked_take_places() {
    let jobs = Arc::new(Jobs::new(0, 1000));
    let first = jobs.reserve(900, None, 9).expect("it is empty");
    assert!(matches!(jobs.reserve(200, None, 9), Err(SubmitError::Full(_))));
    let _second = jobs.reserve(100, None, 9).expect("it fits");
    drop(first);
    jobs.reserve(900, None, 9).expect("the first place is free again");
}

#[test]
fn one_address_has_half_of_the_memory_for_requests() {
    let jobs = Arc::new(Jobs::new(0, 64 << 20));
    let [greedy, other] = [[192, 0, 2, 1], [192, 0, 2, 2]].map(|ip| Some(IpAddr::from(ip)));
    let held: Vec<_> = (0..4)
        .map(|i| jobs.reserve(8 << 20, greedy, 99).unwrap_or_else(|e| panic!("job {i}: {e}")))
        .collect();
    let Err(SubmitError::Full(why)) = jobs.reserve(1 << 20, greedy, 99) else { panic!("half") };
    assert_eq!(
        why,
        "the requests of the 4 jobs in progress from your address take 32 MiB, this one 1 MiB, and \
         one address may have 32 MiB of the 64 MiB that the master has for requests; wait, cancel \
         one, or submit the path in parts"
    );
    let _own = jobs.reserve(24 << 20, None, 99).expect("this process has no such share");
    let _others = jobs.reserve(8 << 20, other, 99).expect("half is left for others");
    assert!(matches!(jobs.reserve(1 << 20, other, 99), Err(SubmitError::Full(_))), "64 MiB");
    drop(held);
    // The last check counts the bytes of the request itself.
    let mut table = jobs.lock();
    let mut big = job(JobId(1), 1);
    (big.submitter, big.held_bytes) = (Submitter::Batch(greedy), 32 << 20);
    table.insert(big);
    assert!(table.has_place(1, greedy).is_err() && table.has_place(1, other).is_ok());
}

#[tokio::test]
async fn watcher_of_a_cancelled_job_is_told_and_ends() {
    let jobs = table(&[]);
    jobs.lock().set_state(JOB, JobState::Cancelled);
    let (mut watch, _events) = watch(&jobs, 0);
    let Some(WatchItem::Notice(last)) = watch.next().await else { panic!("told") };
    assert_eq!(last.state, JobState::Cancelled);
    assert!(watch.next().await.is_none());
}
