//! Panics and long requests beside the driver: what fails is one job, and the driver goes on.

use super::*;
use crate::handle::{Handle, Master, MasterConfig};
use crate::hooks::Stage;
use crate::jobs::WatchItem;
use crate::library::Viewer;
use crate::memory::making_bytes;
use crate::panics::caught;
use slabcast_common::image::{Background, PixelFormat, SparseTile, TilePixels};
use slabcast_common::level::LevelChoice;
use slabcast_common::message::{Counters, Pixels, RegionCost, TaskTimes, TileResult};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Quality, Schedule, Work};
use slabcast_common::transfer::TransferFunction;
use slabcast_common::volume::Volume;
use slabcast_common::{PIXELS_VERSION, SELF_TEST_SHA256};
use slabcast_scene::path::{Orientation, Turntable, ViewPath};
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::transfer::TransferChoice;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Condvar, Mutex};

const SIZE: [u32; 2] = [64, 48];

fn master(hooks: Hooks, heartbeat: Micros) -> Master {
    master_with(hooks, heartbeat, Shares::default())
}

fn master_with(hooks: Hooks, heartbeat: Micros, shares: Shares) -> Master {
    let volume = Volume::from_fn_u8("v", [24; 3], |i, j, k| (i * 7 + j * 3 + k) as u8);
    let mut config = MasterConfig::new(volume, Orientation::new(None, None).expect("defaults"));
    config.hooks = hooks;
    config.schedule.heartbeat = heartbeat;
    config.shares = shares;
    Master::start(config).expect("a master")
}

fn request(key: &str, frames: u32, preset: &str) -> PathRequest {
    PathRequest {
        client_key: key.into(),
        volume: VolumeChoice::Default,
        level: LevelChoice::default(),
        path: ViewPath::from_turntable(SIZE, Turntable { frames, ..Turntable::default() }),
        transfer: TransferChoice::Name(preset.into()),
        quality: Quality::before(),
        work: Work::default(),
        format: PixelFormat::Rgb8,
        background: Background::Transparent,
        want_trace: false,
        want_hash: true,
    }
}

/// A worker that draws nothing: it answers each lease with clear pixels, and pings with pongs. It
/// asks for the first brick of each directory. Counts the pings in `pings`.
fn join(handle: &Handle, pings: Arc<AtomicUsize>) {
    join_unless(handle, pings, |_| false);
}

/// A worker as [`join`] has it, which refuses the tiles of frames that `refuses` says.
fn join_unless(
    handle: &Handle,
    pings: Arc<AtomicUsize>,
    refuses: impl Fn(FrameId) -> bool + Send + 'static,
) {
    join_that(handle, pings, move |frame| if refuses(frame) { Does::Refuses } else { Does::Draws });
}

/// Reaction of a test worker to a tile.
enum Does {
    Draws,
    Refuses,
    /// Never answers.
    NeverEnds,
}

/// Links a worker as [`join`] does. `does` gives its reaction to tiles of a frame.
fn join_that(
    handle: &Handle,
    pings: Arc<AtomicUsize>,
    does: impl Fn(FrameId) -> Does + Send + 'static,
) {
    let mut end = crate::link::embedded(handle.clone());
    tokio::spawn(async move {
        let hello = Hello {
            protocol_versions: slabcast_common::protocol::PROTOCOL_VERSIONS,
            pixels_version: PIXELS_VERSION,
            name: "clear".into(),
            threads: 1,
            memory_budget_bytes: 1 << 30,
            simd: "none".into(),
            self_test_sha256: SELF_TEST_SHA256.into(),
            held: vec![],
            rehearses: false,
            machine: String::new(),
        };
        let _ = end.replies.send(ToMaster::Hello(hello)).await;
        while let Some(message) = end.control.recv().await {
            let reply = match message {
                ToWorker::Region(lease) => {
                    match does(lease.frame) {
                        Does::Draws => {}
                        Does::NeverEnds => continue,
                        Does::Refuses => {
                            let (task, epoch) = (lease.task, lease.epoch);
                            let reason = "out of\n\x1b[31mmemory".into();
                            let _ =
                                end.replies.send(ToMaster::Failed { task, epoch, reason }).await;
                            continue;
                        }
                    }
                    let n = lease.tile.area();
                    let pixels =
                        TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: None };
                    ToMaster::Result(Box::new(TileResult {
                        task: lease.task,
                        epoch: lease.epoch,
                        pixels: Pixels::Sums(pixels),
                        bytes: None,
                        counters: Counters::default(),
                        times: TaskTimes::default(),
                        region: Some(RegionCost::default()),
                    }))
                }
                ToWorker::Directory { set, bricks, .. } => {
                    ToMaster::BricksWanted { set, bricks: vec![bricks[0].id] }
                }
                ToWorker::Ping { nonce } => {
                    pings.fetch_add(1, Ordering::Relaxed);
                    ToMaster::Pong { nonce, clock_us: 0 }
                }
                _ => continue,
            };
            if end.replies.send(reply).await.is_err() {
                return;
            }
        }
    });
}

/// Asks the master until it has so many workers.
async fn until_workers(handle: &Handle, count: usize) {
    while handle.workers().await.len() != count {
        tokio::task::yield_now().await;
    }
}

/// Watches a job to its end: its last state, and the number of its frames.
async fn watched(handle: &Handle, job: JobId) -> (JobState, usize) {
    let mut watch = handle.watch(job, 0).expect("a job that was just submitted");
    let mut frames = 0;
    while let Some(item) = watch.next().await {
        frames += usize::from(matches!(item, WatchItem::Frame(_)));
    }
    (handle.job(job).expect("it is remembered").state, frames)
}

/// Runs a job of three frames; its last state, and the number of its frames.
async fn run(handle: &Handle, key: &str, preset: &str) -> (JobState, usize) {
    let job = handle.submit(request(key, 3, preset)).await.expect("a good request");
    watched(handle, job).await
}

/// Hooks that panic as `stage` begins, the first `times` times.
fn panics_at(stage: Stage, times: usize) -> Hooks {
    let left = AtomicUsize::new(times);
    Hooks::new(move |reached| {
        let take = |n: usize| n.checked_sub(1);
        if reached == stage && left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take).is_ok()
        {
            panic!("injected into {stage:?}");
        }
    })
}

fn failed_with(state: &JobState, words: [&str; 2]) -> bool {
    matches!(state, JobState::Failed(reason) if words.iter().all(|w| reason.contains(w)))
}

#[tokio::test]
async fn panic_in_a_finisher_fails_the_job_and_the_master_goes_on() {
    // More panics than there are finishers: each of them must have gone on.
    const PANICS: usize = 5;
    let master = master(panics_at(Stage::Finish, PANICS), 1_000_000);
    let handle = master.handle();
    join(&handle, Arc::default());
    let (mut failed, mut done) = (0, 0);
    // Frames of one job are finished side by side, so a job may use up more than one panic.
    for i in 0..=PANICS {
        let (state, frames) = run(&handle, &i.to_string(), "grey").await;
        if state == JobState::Done {
            assert_eq!(frames, 3);
            done += 1;
        } else {
            let words = ["finishing the frame panicked", "injected into Finish"];
            assert!(failed_with(&state, words), "{state:?}");
            failed += 1;
        }
    }
    assert!((2..=PANICS).contains(&failed) && done > 0, "{failed} failed, {done} done");
    master.shutdown().await;
}

#[tokio::test]
async fn panic_while_bricks_are_cut_fails_the_job_and_the_master_goes_on() {
    let master = master(panics_at(Stage::CutBricks, 1), 1_000_000);
    let handle = master.handle();
    join(&handle, Arc::default());
    let (state, frames) = run(&handle, "1", "grey").await;
    assert!(failed_with(&state, ["cutting bricks panicked", "injected"]), "{state:?}");
    assert_eq!(frames, 0);
    assert_eq!(run(&handle, "2", "grey").await, (JobState::Done, 3));
    master.shutdown().await;
}

#[tokio::test]
async fn panic_while_a_request_is_checked_is_answered_and_the_master_goes_on() {
    let master = master(panics_at(Stage::Plan, 1), 1_000_000);
    let handle = master.handle();
    join(&handle, Arc::default());
    let error = handle.submit(request("1", 3, "grey")).await.expect_err("it panicked");
    let SubmitError::Panicked(what) = error else { panic!("{error:?}") };
    assert!(what.contains("checking the request panicked: injected"), "{what}");
    assert_eq!(run(&handle, "1", "grey").await, (JobState::Done, 3));
    master.shutdown().await;
}

/// A worker whose bricks can't be sent is detached: its tiles go to another.
#[tokio::test]
async fn panic_while_bricks_are_sent_detaches_the_worker_and_its_job_goes_on() {
    let master = master(panics_at(Stage::SendBricks, 1), 1_000_000);
    let handle = master.handle();
    for _ in 0..2 {
        join(&handle, Arc::default());
    }
    until_workers(&handle, 2).await;
    assert_eq!(run(&handle, "1", "grey").await, (JobState::Done, 3));
    until_workers(&handle, 1).await;
    assert_eq!(run(&handle, "2", "grey").await, (JobState::Done, 3));
    master.shutdown().await;
}

/// Tiles that a finisher took and lost are not to be missing from a picture.
#[test]
fn picture_whose_composing_panicked_is_not_finished() {
    let finish = slabcast_common::image::PixelEncoding {
        format: PixelFormat::Rgb8,
        background: Background::Transparent,
    };
    let assembly = Assembly::new([32, 32], finish, None);
    // A tile that says to have a leaf and lacks its bytes.
    let mut leaves = SparseTile::blank([32, 32], PixelFormat::Rgb8);
    leaves.mask[0] = 1;
    assembly.add(vec![(Rect::new(0, 0, 32, 32), leaves)]);
    let panicked = caught("composing tiles", || assembly.compose()).expect_err("it panics");
    assert_eq!(panicked.work, "composing tiles");
    caught("composing tiles", || assembly.compose()).expect_err("and ever after");
}

/// A listener that is slow misses tiles, and one that is gone harms nobody.
#[test]
fn listener_gets_the_tiles_for_which_it_has_room() {
    let finish = slabcast_common::image::PixelEncoding {
        format: PixelFormat::Rgb8,
        background: Background::Colour([1.0, 0.0, 0.0]),
    };
    let (listener, mut told) = tokio::sync::mpsc::channel(1);
    let assembly = Assembly::new([32, 16], finish, Some(listener));
    let (left, right) = (Rect::new(0, 0, 16, 16), Rect::new(16, 0, 32, 16));
    let blank = SparseTile::blank([16, 16], PixelFormat::Rgb8);
    let mut full = blank.clone();
    (full.mask[0], full.data) = (1, vec![7; 16 * 16 * 3]);
    assembly.add(vec![(right, full), (left, blank.clone())]);
    assembly.compose();
    let tile = told.try_recv().expect("there was room for one");
    assert_eq!((tile.place, tile.bytes), (right, vec![7; 16 * 16 * 3]));
    assert!(told.try_recv().is_err());
    assembly.add(vec![(left, blank.clone())]);
    assembly.compose();
    let tile = told.try_recv().expect("there is room again");
    assert_eq!((tile.place, tile.bytes), (left, [255, 0, 0].repeat(16 * 16)));
    drop(told);
    assembly.add(vec![(left, blank)]);
    assembly.compose();
}

/// A gate that holds a stage until it is opened, and tells when the stage has come to it.
#[derive(Clone, Default)]
struct Gate(Arc<(Mutex<bool>, Condvar)>);

impl Gate {
    fn open(&self) {
        *self.0.0.lock().expect("nobody panics here") = true;
        self.0.1.notify_all();
    }

    fn wait(&self) {
        let mut is_open = self.0.0.lock().expect("nobody panics here");
        while !*is_open {
            is_open = self.0.1.wait(is_open).expect("nobody panics here");
        }
    }
}

/// The check of a long path is held, and meanwhile the driver pings, answers and finishes another
/// job. Counted in events, not in time.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn submitting_a_long_path_delays_no_heartbeat() {
    const PINGS: usize = 20;
    let (gate, reached) = (Gate::default(), Arc::new(tokio::sync::Notify::new()));
    let (held, tells) = (gate.clone(), reached.clone());
    let first = AtomicUsize::new(0);
    let hooks = Hooks::new(move |stage| {
        if stage == Stage::Plan && first.fetch_add(1, Ordering::Relaxed) == 0 {
            tells.notify_one();
            held.wait();
        }
    });
    let master = master(hooks, 1000);
    let handle = master.handle();
    let pings = Arc::<AtomicUsize>::default();
    join(&handle, pings.clone());
    let submitting = {
        let handle = handle.clone();
        tokio::spawn(async move { handle.submit(request("long", 100_000, "grey")).await })
    };
    reached.notified().await;
    let before = pings.load(Ordering::Relaxed);
    let mut answers = 0;
    while pings.load(Ordering::Relaxed) < before + PINGS {
        answers += handle.workers().await.len();
    }
    assert!(answers > 0, "the driver answers meanwhile");
    assert_eq!(run(&handle, "short", "grey").await, (JobState::Done, 3));
    assert!(handle.jobs().iter().all(|job| job.client_key != "long"), "it is still checked");
    gate.open();
    let job = submitting.await.expect("no panic").expect("a good request");
    assert_eq!(handle.job(job).map(|job| job.frames_total), Some(100_000));
    assert!(handle.cancel(job).await);
    master.shutdown().await;
}

/// A frame that no worker can draw fails alone, and the same request draws it again, and no other.
#[tokio::test]
async fn frame_that_fails_is_told_in_its_place_and_drawn_again_alone() {
    let volume = Volume::from_fn_u8("v", [24; 3], |i, j, k| (i * 7 + j * 3 + k) as u8);
    let orientation = Orientation::new(None, None).expect("defaults");
    let mut config = MasterConfig::new(volume, orientation);
    config.schedule.poison_after = 1;
    let master = Master::start(config).expect("a master");
    let handle = master.handle();
    let (sick, lent) = (Arc::new(AtomicUsize::new(2)), Arc::new(Mutex::new(Vec::new())));
    let (is_sick, seen) = (sick.clone(), lent.clone());
    join_unless(&handle, Arc::default(), move |frame| {
        seen.lock().expect("no panic").push(frame.0);
        frame.0 == is_sick.load(Ordering::Relaxed) as u64
    });
    let job = handle.submit(request("a", 3, "grey")).await.expect("a good request");
    let watched = async |from| {
        let mut watch = handle.watch(job, from).expect("a job");
        let mut told = Vec::new();
        while let Some(item) = watch.next().await {
            match item {
                WatchItem::Frame(frame) => told.push((frame.number, String::new())),
                WatchItem::Failed { number, reason } => told.push((number, reason.to_string())),
                WatchItem::Notice(_) => {}
            }
        }
        told
    };
    let told = watched(0).await;
    assert_eq!(told.iter().map(|t| t.0).collect::<Vec<_>>(), [0, 1, 2]);
    assert!(told[0].1.is_empty() && told[2].1.is_empty());
    assert!(told[1].1.contains("clear refused it: out of  [31mmemory"), "{:?}", told[1]);
    let view = handle.job(job).expect("it is remembered");
    let JobState::Incomplete(reason) = &view.state else { panic!("{:?}", view.state) };
    assert!(reason.starts_with("1 of 3 frames failed; frame 1: no worker could"), "{reason}");
    assert_eq!((view.frames_done, view.frames_failed), (2, 1));
    assert!(view.finished_unix_ms > 0);

    sick.store(0, Ordering::Relaxed);
    lent.lock().expect("no panic").clear();
    assert_eq!(handle.submit(request("a", 3, "grey")).await, Ok(job), "the same job");
    assert_eq!(watched(0).await.iter().map(|t| t.0).collect::<Vec<_>>(), [0, 1, 2]);
    let view = handle.job(job).expect("it is remembered");
    assert_eq!((view.state, view.frames_done, view.frames_failed), (JobState::Done, 3, 0));
    let mut drawn = std::mem::take(&mut *lent.lock().expect("no panic"));
    drawn.dedup();
    assert_eq!(drawn, [4], "one frame was drawn, and no other");
    // Nothing is left to be drawn again.
    assert_eq!(handle.submit(request("a", 3, "grey")).await, Ok(job));
    assert!(lent.lock().expect("no panic").is_empty());
    master.shutdown().await;
}

/// Waits until the driver has pinged its worker `count` times: it did all that it could do.
async fn pass(pings: &AtomicUsize, count: usize) {
    let before = pings.load(Ordering::Relaxed);
    while pings.load(Ordering::Relaxed) < before + count {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

/// Hooks that count how often `stage` begins and hold it until the gate opens.
fn counted(stage: Stage) -> (Hooks, Gate, Arc<AtomicUsize>) {
    let (gate, count) = (Gate::default(), Arc::<AtomicUsize>::default());
    let (held, counts) = (gate.clone(), count.clone());
    let hooks = Hooks::new(move |reached| {
        if reached == stage {
            counts.fetch_add(1, Ordering::Relaxed);
            held.wait();
        }
    });
    (hooks, gate, count)
}

/// A path of 100,000 frames costs what its request costs.
#[tokio::test]
async fn job_takes_memory_for_its_request_and_not_for_its_frames() {
    let master = master(Hooks::default(), 1_000_000);
    let handle = master.handle();
    let open = handle.library().open(&VolumeChoice::Default, Viewer::own()).expect("it is there");
    let mut held = [0; 2];
    for (held, (key, frames)) in held.iter_mut().zip([("short", 1), ("long", 100_000)]) {
        let level = |_| unreachable!("level 0 is there");
        let plan = Plan::new(request(key, frames, "grey"), &open, level, &Shares::default());
        *held = plan.expect("a good request").held_bytes();
    }
    assert!(held[1] < 8192 && held[1].abs_diff(held[0]) < 16, "{held:?} bytes");
    master.shutdown().await;
}

/// Four jobs that nobody watches: their frames are made within one budget.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn frames_of_all_jobs_are_made_within_one_budget() {
    let (hooks, gate, finishing) = counted(Stage::Finish);
    let one = making_bytes(&request("", 1, "grey"));
    let shares = Shares { flights: one * 3 / 2, ..Shares::default() };
    let master = master_with(hooks, 1000, shares);
    let handle = master.handle();
    let pings = Arc::<AtomicUsize>::default();
    join(&handle, pings.clone());
    let mut jobs = Vec::new();
    for key in ["a", "b", "c", "d"] {
        jobs.push(handle.submit(request(key, 3, "grey")).await.expect("a good request"));
    }
    while finishing.load(Ordering::Relaxed) == 0 {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    pass(&pings, 20).await;
    assert_eq!(finishing.load(Ordering::Relaxed), 1, "a second one has no room");
    gate.open();
    for job in jobs {
        assert_eq!(watched(&handle, job).await, (JobState::Done, 3));
    }
    master.shutdown().await;
}

/// Frames that nobody takes fill their half of the budget, and a watcher gets its frames still.
#[tokio::test]
async fn frames_that_nobody_takes_stop_no_watcher() {
    let shares = Shares { frames: 100_000, ..Shares::default() };
    let master = master_with(Hooks::default(), 1000, shares);
    let handle = master.handle();
    let pings = Arc::<AtomicUsize>::default();
    join(&handle, pings.clone());
    let mut jobs = Vec::new();
    for key in ["a", "b", "c"] {
        jobs.push(handle.submit(request(key, 100, "grey")).await.expect("a good request"));
    }
    pass(&pings, 50).await;
    let done = || jobs.iter().filter_map(|job| handle.job(*job)).map(|job| job.frames_done).sum();
    let filled: u64 = done();
    assert!((1..=5).contains(&filled), "{filled} frames of 9 KB and their statistics");
    assert_eq!(run(&handle, "victim", "grey").await, (JobState::Done, 3));
    assert_eq!(done(), filled);
    // From the middle: the frames before are nobody's, and do not come first.
    let mut watch = handle.watch(jobs[1], 50).expect("it is there");
    let item = loop {
        if let WatchItem::Frame(frame) = watch.next().await.expect("a frame") {
            break frame.number;
        }
    };
    assert_eq!(item, 50);
    master.shutdown().await;
}

/// Eight transfer functions that need eight brick sets: they are cut one after another.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn brick_sets_are_cut_one_at_a_time_and_the_jobs_wait() {
    let (hooks, gate, cutting) = counted(Stage::CutBricks);
    let master = master(hooks, 1000);
    let handle = master.handle();
    let pings = Arc::<AtomicUsize>::default();
    join(&handle, pings.clone());
    let mut jobs = Vec::new();
    for i in 0..8 {
        let json = format!(
            r#"{{"version":1,"domain":"value","colors":[[0,1,1,1]],"opacities":[[{i},0],[{},0.5],[{},0]]}}"#,
            i + 1,
            120 + 3 * i
        );
        let tf = TransferFunction::from_json(&json).expect("a good function");
        let request = PathRequest {
            transfer: TransferChoice::Function(Box::new(tf)),
            ..request(&i.to_string(), 2, "grey")
        };
        jobs.push(handle.submit(request).await.expect("a good request"));
    }
    while cutting.load(Ordering::Relaxed) == 0 {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    pass(&pings, 20).await;
    assert_eq!(cutting.load(Ordering::Relaxed), 1);
    assert!(handle.jobs().iter().all(|job| job.state == JobState::Preparing));
    gate.open();
    for job in jobs {
        assert_eq!(watched(&handle, job).await, (JobState::Done, 2));
    }
    assert_eq!(cutting.load(Ordering::Relaxed), 8);
    master.shutdown().await;
}

/// A preview behind a path of 100,000 frames that is watched.
#[tokio::test]
async fn one_frame_does_not_wait_for_a_hundred_thousand() {
    let master = master(Hooks::default(), 1000);
    let handle = master.handle();
    let pings = Arc::<AtomicUsize>::default();
    join(&handle, pings.clone());
    let long = handle.submit(request("long", 100_000, "grey")).await.expect("a good request");
    let watching = {
        let handle = handle.clone();
        tokio::spawn(async move { watched(&handle, long).await })
    };
    while handle.job(long).is_none_or(|job| job.frames_done < 2 * 16) {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    let before = handle.job(long).expect("it is there").frames_done;
    assert_eq!(run(&handle, "preview", "grey").await, (JobState::Done, 3));
    let after = handle.job(long).expect("it is there").frames_done;
    // Those in flight, and as many as end while each of three frames is drawn beside them.
    assert!(after - before <= 100, "{} frames came before three", after - before);
    watching.abort();
    master.shutdown().await;
}

/// Four jobs of one address and one of another: each address has half of the work.
#[tokio::test]
async fn addresses_share_the_work_whatever_the_number_of_their_jobs() {
    let master = master(Hooks::default(), 1000);
    let handle = master.handle();
    join(&handle, Arc::default());
    let mut jobs = Vec::new();
    for (key, host) in [("a", 1), ("b", 1), ("c", 1), ("d", 1), ("e", 2)] {
        let peer = Some([10, 0, 0, host].into());
        let job = handle.submit_from(request(key, 100_000, "grey"), peer).await.expect("good");
        let watching = handle.clone();
        tokio::spawn(async move { watched(&watching, job).await });
        jobs.push(job);
    }
    let done = |job: &JobId| handle.job(*job).expect("it is there").frames_done;
    // From when all five are drawn: the first of them began alone.
    while done(&jobs[4]) == 0 {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    let before: Vec<u64> = jobs.iter().map(done).collect();
    while done(&jobs[4]) < 60 {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    let mut since = jobs.iter().zip(before).map(|(job, before)| done(job) - before);
    let one: u64 = since.by_ref().take(4).sum();
    let other = since.next().expect("five jobs");
    assert!(one.abs_diff(other) < 30, "{one} frames of four jobs, {other} of one");
    jobs.iter().for_each(|job| drop(handle.cancel(*job)));
    master.shutdown().await;
}

/// Waits until a job is running.
async fn running(handle: &Handle, job: JobId) {
    while handle.job(job).expect("it is there").state != JobState::Running {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

/// An address has the most frames in flight that it may have, and none of them ends.
#[tokio::test]
async fn frames_of_an_address_that_never_end_keep_no_other_address_waiting() {
    let master = master(Hooks::default(), 100_000);
    let handle = master.handle();
    join_that(&handle, Arc::default(), |frame| match frame.0 <= 4 {
        true => Does::NeverEnds,
        false => Does::Draws,
    });
    let greedy = Some([10, 0, 0, 1].into());
    let mut jobs = Vec::new();
    // More functions than brick sets are kept.
    for preset in ["grey", "fog", "peer-opaque", "peer-semi"] {
        let job = handle.submit_from(request(preset, 9, preset), greedy).await.expect("good");
        jobs.push(job);
    }
    let watching = handle.clone();
    let first = jobs[0];
    tokio::spawn(async move { watched(&watching, first).await });
    running(&handle, first).await;
    for (key, preset) in [("x", "grey"), ("y", "peer-opaque"), ("z", "auto")] {
        let other = Some([10, 0, 0, 2].into());
        let job = handle.submit_from(request(key, 3, preset), other).await.expect("good");
        let ended = tokio::time::timeout(Duration::from_secs(20), watched(&handle, job)).await;
        assert_eq!(ended.expect("in time"), (JobState::Done, 3), "{preset}");
    }
    assert_eq!(handle.job(first).expect("it is there").frames_done, 0);
    for job in jobs {
        assert!(handle.cancel(job).await);
    }
    master.shutdown().await;
}

/// The worker draws regions alone, so a frame of the `slab` schedule would never end, and no other frame
/// could begin.
#[tokio::test]
async fn frame_of_the_slab_schedule_makes_way_for_another_address_and_is_drawn_by_regions() {
    let master = master(Hooks::default(), 100_000);
    let handle = master.handle();
    join(&handle, Arc::default());
    let slab = PathRequest {
        work: Work { schedule: Schedule::Slab, ..Work::default() },
        ..request("slab", 3, "grey")
    };
    let first = handle.submit_from(slab, Some([10, 0, 0, 1].into())).await.expect("good");
    running(&handle, first).await;
    let other = Some([10, 0, 0, 2].into());
    let job = handle.submit_from(request("x", 100_000, "fog"), other).await.expect("good");
    let watching = handle.clone();
    tokio::spawn(async move { watched(&watching, job).await });
    // The first has its turn while the other is in progress.
    let ends = tokio::time::timeout(Duration::from_secs(20), watched(&handle, first)).await;
    assert_eq!(ends.expect("in time"), (JobState::Done, 3));
    assert!(handle.job(job).expect("it is there").frames_done > 0);
    assert!(handle.cancel(job).await);
    master.shutdown().await;
}

/// While its only worker refuses tiles, a job says that; once a tile is drawn it does not.
#[tokio::test]
async fn job_whose_worker_refuses_tiles_says_that_and_not_that_others_come_first() {
    let master = master(Hooks::default(), 100_000);
    let handle = master.handle();
    let is_sick = Arc::new(AtomicUsize::new(1));
    let sick = is_sick.clone();
    join_unless(&handle, Arc::default(), move |_| sick.load(Ordering::Relaxed) == 1);
    let job = handle.submit(request("a", 1, "grey")).await.expect("a good request");
    let said = || crate::serve::notice(&handle.job(job).expect("it is there"));
    while !said().message.contains("asked again") {
        assert_ne!(said().state, slabcast_proto::model::JobState::Failed);
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    let notice = said();
    assert_eq!(notice.state, slabcast_proto::model::JobState::Running);
    let begins = "waiting: worker clear refused tile ";
    assert!(notice.message.starts_with(begins), "{}", notice.message);
    let reason = " of frame 0: out of  [31mmemory; it is asked again in ";
    assert!(notice.message.contains(reason), "{}", notice.message);
    is_sick.store(0, Ordering::Relaxed);
    assert_eq!(watched(&handle, job).await, (JobState::Done, 1));
    assert!(!said().message.contains("refused"), "{}", said().message);
    let worker = &handle.workers().await[0];
    let error = worker.last_error.as_ref().expect("it failed tiles");
    assert_eq!(error.reason, "a tile failed: out of  [31mmemory");
    assert!(error.at_unix_ms > 0 && worker.round_trip.is_some(), "it answered pings");
    master.shutdown().await;
}

#[tokio::test]
async fn worker_that_comes_back_has_the_error_by_which_it_went() {
    let master = master(Hooks::default(), 1_000_000);
    let handle = master.handle();
    join(&handle, Arc::default());
    until_workers(&handle, 1).await;
    let first = handle.workers().await.remove(0);
    assert_eq!(first.last_error, None);
    handle.detach(first.id, "the cable was pulled".into(), true).await;
    until_workers(&handle, 0).await;
    join(&handle, Arc::default());
    until_workers(&handle, 1).await;
    let second = handle.workers().await.remove(0);
    assert_ne!(second.id, first.id);
    let error = second.last_error.expect("it was lost");
    assert_eq!(error.reason, "its link ended: the cable was pulled");
    master.shutdown().await;
}

#[tokio::test]
async fn name_of_the_file_is_told_to_this_machine_alone() {
    let master = master(Hooks::default(), 1_000_000);
    let handle = master.handle();
    let digest = handle.library().default_volume().expect("it is there").info.digest;
    let name = |ip: Option<&str>| {
        let viewer = handle.viewer(ip.map(|ip| ip.parse().expect("an address")));
        handle.library().name_of(digest, viewer)
    };
    assert_eq!([name(None), name(Some("127.0.0.1")), name(Some("::ffff:127.0.0.1"))], ["v"; 3]);
    let other = name(Some("10.0.0.1"));
    assert!(other.starts_with("sha256:") && other.len() == 19, "{other}");
    master.shutdown().await;
}
