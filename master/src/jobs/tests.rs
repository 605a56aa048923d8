use super::watch::{Watch, WatchItem};
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
