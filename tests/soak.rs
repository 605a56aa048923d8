//! An hour under load: jobs by the thousand on a cluster of real processes whose workers are
//! killed, stopped, sent away and brought back, and whose clients cancel, drop their watches and
//! come late. No picture may be false, no job may end with an error, and what master and worker
//! take may not grow after the first tenth.
//!
//! It runs at night (`tests/nightly.sh soak`). By hand, with three minutes for a rehearsal:
//!
//! ```sh
//! SLABCAST_SOAK_MINUTES=3 cargo test -p slabcast --test soak -- --ignored --nocapture
//! ```
//!
//! `SLABCAST_PROGRAM` names another build of the program, `SLABCAST_SOAK_SEED` another schedule,
//! `SLABCAST_SOAK_DIR` the folder for table and logs.
#![cfg(target_os = "linux")]

#[path = "support/processes.rs"]
mod processes;
#[path = "support/usage.rs"]
mod usage;

use processes::{Process, SLABCAST};
use sha2::{Digest, Sha256};
use slabcast_client::{Client, ClientError, FrameStream, JobState, ReceivedFrame, Update};
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Quality, Schedule, Work};
use slabcast_common::stats::FrameStats;
use slabcast_master::jobs::{MAX_JOBS, WatchItem};
use slabcast_scene::path::{Orientation, Turntable, ViewPath};
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::transfer::TransferChoice;
use slabcast_session::embedded::{Cluster, WorkerGroup};
use std::collections::{BTreeMap, VecDeque};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use usage::{Sample, Usage, growth, slope};

const VOLUME: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../samples/mni152_t1.nii.gz");

/// Clients that submit one job after the other. A frame that waits for a stopped worker takes
/// seconds; so many clients begin their jobs in time all the same.
const CLIENTS: u64 = 8;

/// Time between two jobs of one client: 20,571 jobs in an hour.
const PERIOD: Duration = Duration::from_millis(1400);

/// Workers of one thread. The first is stopped now and then, but lives from beginning to end.
const WORKERS: u64 = 4;

/// Longest time that a job may take, or a process to end. A lease lasts 60 s.
const PATIENT: Duration = Duration::from_secs(120);

/// Time between two rows of the table.
const SAMPLE: Duration = Duration::from_secs(10);

/// Samples of ten minutes, below which growth is not judged: caches and pools of memory fill for as
/// long: 15 MiB of a worker within five minutes, and 3 MiB of another in the fifty-four minutes
/// after its sixth.
const ENOUGH: usize = 60;

/// Memory may grow by this part and by so much. A master keeps the frames of its last jobs, and
/// which those are differs by some MiB.
const GROWTH_PART: f64 = 0.05;
const GROWTH_MIB: f64 = 8.0;

/// Descriptors and threads may grow by so many. Each worker and each client has one or two, and
/// they come and go.
const GROWTH_COUNT: f64 = 4.0;

/// A job without a key, and what is true of its frames.
struct Scene {
    request: PathRequest,
    frames: Vec<Truth>,
}

struct Truth {
    bytes: [u8; 32],
    /// Hash of the linear picture, as statistics have it.
    pixels: String,
}

/// Jobs of each schedule, order of classification, format and size, without their truths.
fn requests() -> Vec<PathRequest> {
    let (region, slab) = (Schedule::Region, Schedule::Slab);
    let (rgb, rgba, float) = (PixelFormat::Rgb8, PixelFormat::Rgba8, PixelFormat::Rgba32F);
    let scene = |transfer: &str, after, schedule, format, edge, frames, want_hash| {
        let turn = Turntable {
            start: f64::from(edge),
            step: 7.0,
            frames,
            elevation: 10.0,
            ..Turntable::default()
        };
        PathRequest {
            client_key: String::new(),
            volume: VolumeChoice::Default,
            level: LevelChoice::default(),
            path: ViewPath::from_turntable([edge, edge * 3 / 4], turn),
            transfer: TransferChoice::Name(transfer.into()),
            quality: if after { Quality::default() } else { Quality::before() },
            work: Work { schedule, tile: (edge == 128).then_some(32), ..Work::default() },
            format,
            background: Background::Transparent,
            want_trace: false,
            want_hash,
        }
    };
    vec![
        scene("auto", true, region, rgba, 64, 1, true),
        scene("auto", true, region, rgba, 96, 2, false),
        scene("auto", true, slab, float, 80, 1, true),
        scene("auto", true, region, rgb, 128, 3, false),
        scene("brain", true, region, rgba, 100, 1, true),
        scene("brain", true, slab, rgba, 72, 3, false),
        scene("skin", false, region, float, 64, 2, true),
        scene("skin", false, slab, rgba, 128, 1, true),
        scene("peer-opaque", false, region, rgb, 90, 3, true),
        scene("peer-opaque", false, region, rgba, 128, 2, false),
    ]
}

/// Draws each scene with one worker inside this process, by the other schedule and with hashes.
async fn truths() -> Vec<Scene> {
    let volume = slabcast_volumes::open(VOLUME.as_ref()).expect("the sample");
    let orientation = Orientation::new(None, None).expect("the defaults");
    let crew = WorkerGroup::new(1, Some(1)).expect("one worker");
    let cluster = Cluster::start(volume, orientation, crew, None).expect("threads");
    let handle = cluster.handle();
    let mut scenes = Vec::new();
    for (n, request) in requests().into_iter().enumerate() {
        let mut other = request.clone();
        other.client_key = format!("truth {n}");
        other.want_hash = true;
        other.work = Work {
            schedule: match request.work.schedule {
                Schedule::Slab => Schedule::Region,
                _ => Schedule::Slab,
            },
            ..Work::default()
        };
        let job = handle.submit(other).await.expect("a good request");
        let mut watch = handle.watch(job, 0).expect("it was just submitted");
        let mut frames = Vec::new();
        while let Some(item) = watch.next().await {
            if let WatchItem::Frame(frame) = item {
                frames.push(Truth {
                    bytes: Sha256::digest(&frame.bytes).into(),
                    pixels: frame.stats.pixels_sha256.clone(),
                });
            }
        }
        assert_eq!(frames.len(), request.path.frames(), "{:?}", handle.job(job).map(|j| j.state));
        scenes.push(Scene { request, frames });
    }
    cluster.end().await;
    scenes
}

/// Counts of jobs, frames, kills, stops and errors so far.
#[derive(Default)]
struct Tally {
    counts: BTreeMap<&'static str, u64>,
    /// Seconds of each job that was watched to its end.
    job_secs: Vec<f64>,
    failures: u64,
}

/// The cluster, and what all who act on it share.
struct World {
    program: PathBuf,
    dir: PathBuf,
    address: String,
    seed: u64,
    begin: Instant,
    end: Instant,
    scenes: Vec<Scene>,
    tally: Mutex<Tally>,
    /// Processes that live, by name.
    living: Mutex<BTreeMap<String, u32>>,
}

impl World {
    fn count(&self, what: &'static str) {
        *self.tally.lock().expect("no panic").counts.entry(what).or_default() += 1;
    }

    /// Counts something that may not happen, and says it.
    fn fail(&self, kind: &'static str, what: &str) {
        let at = self.begin.elapsed().as_secs_f64();
        println!("{at:8.1} s  {kind}: {what}");
        let mut tally = self.tally.lock().expect("no panic");
        tally.failures += 1;
        *tally.counts.entry(kind).or_default() += 1;
    }

    fn counted(&self, what: &str) -> u64 {
        self.tally.lock().expect("no panic").counts.get(what).copied().unwrap_or(0)
    }

    fn has_time(&self) -> bool {
        Instant::now() < self.end
    }

    /// Sleeps as long, but not past the end.
    fn pause(&self, time: Duration) {
        std::thread::sleep(time.min(self.end.saturating_duration_since(Instant::now())));
    }
}

/// A time between two numbers of milliseconds.
fn between(rng: &mut fastrand::Rng, least: u64, most: u64) -> Duration {
    Duration::from_millis(rng.u64(least..=most))
}

/// Starts a process whose log is added to a file, and returns it with the first line that it
/// prints, if that is wanted.
fn start(program: &Path, log: &Path, args: &[&str], wants_line: bool) -> (Process, String) {
    let log = std::fs::OpenOptions::new().create(true).append(true).open(log).expect("a log");
    let mut command = processes::command(program, Path::new("."), args);
    command.stderr(log).stdout(if wants_line { Stdio::piped() } else { Stdio::null() });
    let mut process = Process(command.spawn().expect("it starts"));
    let mut line = String::new();
    if let Some(out) = process.0.stdout.take() {
        BufReader::new(out).read_line(&mut line).expect("a line");
    }
    (process, line.trim().to_owned())
}

// ---------------------------------------------------------------------------------------------
// Workers

/// Keeps a worker, and harms it from time to time. Returns the one that lives at the end.
fn keep_worker(world: &World, number: u64) -> Process {
    let mut rng = fastrand::Rng::with_seed(world.seed << 8 | number);
    let name = format!("worker-{number}");
    let log = world.dir.join("workers.log");
    loop {
        let args = ["worker", "--master", &world.address, "--name", &name, "--threads", "1"];
        let args = [&args[..], &["--memory", "64MiB"]].concat();
        let (mut worker, _) = start(&world.program, &log, &args, false);
        world.count("joins");
        world.living.lock().expect("no panic").insert(name.clone(), worker.0.id());
        loop {
            world.pause(between(&mut rng, 3_000, 15_000));
            if !world.has_time() {
                return worker;
            }
            let ended = worker.0.try_wait().expect("a child of this test");
            if let Some(status) = ended {
                world.fail("worker ended", &format!("{name}: {status}"));
                break;
            }
            match rng.u64(0..if number == 0 { 4 } else { 10 }) {
                0..4 => {
                    world.count("stops");
                    worker.signal("-STOP");
                    world.pause(between(&mut rng, 1_000, 6_000));
                    worker.signal("-CONT");
                }
                4..7 => {
                    world.count("kills");
                    worker.signal("-KILL");
                    break;
                }
                // A stopped worker still holds its leases when it is killed.
                7 => {
                    world.count("kills");
                    worker.signal("-STOP");
                    world.pause(between(&mut rng, 100, 2_000));
                    worker.signal("-KILL");
                    break;
                }
                _ => {
                    world.count("leaves");
                    worker.signal("-TERM");
                    let code = worker.exit_within(PATIENT);
                    if code != Some(0) {
                        world.fail("worker ended", &format!("{name}: {code:?} on SIGTERM"));
                    }
                    break;
                }
            }
        }
        world.living.lock().expect("no panic").remove(&name);
        drop(worker);
        world.pause(between(&mut rng, 200, 4_000));
    }
}

// ---------------------------------------------------------------------------------------------
// Clients

/// A job as its submitter knows it.
struct Submitted<'a> {
    id: String,
    scene: &'a Scene,
    since: Instant,
}

/// Name of an error for the tally.
fn kind(error: &ClientError) -> &'static str {
    match error {
        ClientError::Connect { .. } => "error: Connect",
        ClientError::Lost { .. } => "error: Lost",
        ClientError::GaveUp { .. } => "error: GaveUp",
        ClientError::InvalidField { .. } => "error: InvalidField",
        ClientError::NotFound { .. } => "error: NotFound",
        ClientError::FrameNotKept { .. } => "error: FrameNotKept",
        ClientError::Full { .. } => "error: Full",
        ClientError::JobFailed { .. } => "error: JobFailed",
        ClientError::JobCancelled { .. } => "error: JobCancelled",
        ClientError::Protocol { .. } => "error: Protocol",
        _ => "error: Status",
    }
}

/// Submits jobs until the end, one each [`PERIOD`].
async fn run_client(world: Arc<World>, number: u64) {
    let mut rng = fastrand::Rng::with_seed(world.seed << 8 | 128 | number);
    let first = tokio::time::Instant::from_std(world.begin)
        + PERIOD.mul_f64(number as f64 / CLIENTS as f64);
    let mut ticks = tokio::time::interval_at(first, PERIOD);
    let (mut dropped, mut jobs) = (VecDeque::new(), 0);
    while world.has_time() {
        // Some jobs on each connection; then another one is made.
        let client = match Client::connect(&world.address).await {
            Ok(client) => client,
            Err(e) => {
                world.fail(kind(&e), &e.to_string());
                ticks.tick().await;
                continue;
            }
        };
        for _ in 0..rng.u32(5..40) {
            ticks.tick().await;
            if !world.has_time() {
                break;
            }
            jobs += 1;
            let key = format!("soak {number} {jobs}");
            let story = run_job(&world, &client, &mut rng, key.clone(), &mut dropped);
            match tokio::time::timeout(PATIENT, story).await {
                Ok(Ok(())) => {}
                Ok(Err(e)) => world.fail(kind(&e), &format!("{key}: {e}")),
                Err(_) => world.fail("error: hung", &format!("{key}: not over in {PATIENT:?}")),
            }
            look_after(&world, &client, &mut dropped, Duration::from_secs(20)).await;
        }
    }
    // Jobs that were left alone at the end.
    if let Ok(client) = Client::connect(&world.address).await {
        tokio::time::sleep(Duration::from_secs(5)).await;
        look_after(&world, &client, &mut dropped, Duration::ZERO).await;
    }
}

/// Submits a job and does with it what the dice say.
async fn run_job<'a>(
    world: &'a World,
    client: &Client,
    rng: &mut fastrand::Rng,
    client_key: String,
    dropped: &mut VecDeque<Submitted<'a>>,
) -> Result<(), ClientError> {
    let scene = &world.scenes[rng.usize(..world.scenes.len())];
    let request = PathRequest { client_key, ..scene.request.clone() };
    let id = client.submit(&request).await?;
    let job = Submitted { id, scene, since: Instant::now() };
    world.count("jobs");
    match rng.u32(..100) {
        0..6 => cancel(world, client, &job, 0).await,
        6..12 => cancel(world, client, &job, 1).await,
        12..20 => {
            // Dropping a watch cancels nothing: somebody looks after the job later.
            world.count("dropped watches");
            let mut frames = client.watch(&job.id, 0).await?;
            frames.next().await?;
            dropped.push_back(job);
            Ok(())
        }
        20..25 => {
            // A repeated request is the first one's job, which may have any number of watchers.
            let again = client.submit(&request).await?;
            if again != job.id {
                world.fail("error: second job", &format!("{} and {again}", job.id));
            }
            let other = Client::connect(&world.address).await?;
            let watches = (client.watch(&job.id, 0).await?, other.watch(&again, 0).await?);
            let both = (take(world, &job, watches.0, 0), take(world, &job, watches.1, 0));
            let (one, two) = tokio::join!(both.0, both.1);
            world.count("second watches");
            one.and(two)
        }
        25..30 => {
            // Comes late, when frames may have been drawn already.
            let late = scene.frames.len() / 2;
            tokio::time::sleep(between(rng, 10, 500)).await;
            take(world, &job, client.watch(&job.id, late as u64).await?, late).await
        }
        30..33 => {
            client.jobs(100).await?;
            client.workers().await?;
            client.volume(&VolumeChoice::Default).await?;
            take(world, &job, client.watch(&job.id, 0).await?, 0).await
        }
        _ => {
            take(world, &job, client.watch(&job.id, 0).await?, 0).await?;
            let secs = job.since.elapsed().as_secs_f64();
            world.tally.lock().expect("no panic").job_secs.push(secs);
            Ok(())
        }
    }
}

/// Takes all frames of a job from number `next` on, and compares them.
async fn take(
    world: &World,
    job: &Submitted<'_>,
    mut frames: FrameStream,
    mut next: usize,
) -> Result<(), ClientError> {
    while let Some(update) = frames.next().await? {
        match update {
            Update::Frame(frame) => {
                compare(world, job, &frame);
                next += 1;
            }
            Update::FrameFailed { number, reason } => {
                let what = format!("{}, frame {number}: {reason}", job.id);
                world.fail("error: FrameFailed", &what);
            }
            Update::Notice(_) => {}
        }
    }
    if next != job.scene.frames.len() {
        let got = format!("{}: ended before frame {next}", job.id);
        world.fail("error: frames missing", &got);
    }
    Ok(())
}

/// Cancels a job after so many frames, or when it has ended before. Reads what comes after that.
async fn cancel(
    world: &World,
    client: &Client,
    job: &Submitted<'_>,
    after: u64,
) -> Result<(), ClientError> {
    let mut frames = client.watch(&job.id, 0).await?;
    let mut is_cancelled = false;
    loop {
        if !is_cancelled && frames.next_frame() >= after {
            let state = client.cancel(&job.id).await?.state;
            is_cancelled = true;
            match state {
                JobState::Cancelled => world.count("cancels"),
                JobState::Done => world.count("cancels of done jobs"),
                _ => world.fail("error: not cancelled", &format!("{} is {state}", job.id)),
            }
        }
        match frames.next().await {
            Ok(Some(Update::Frame(frame))) => compare(world, job, &frame),
            Ok(Some(_)) => {}
            Ok(None) => return Ok(()),
            Err(ClientError::JobCancelled { .. }) if is_cancelled => return Ok(()),
            Err(e) => return Err(e),
        }
    }
}

/// Asks for the states of jobs that were dropped so long ago: they must be done.
async fn look_after(
    world: &World,
    client: &Client,
    dropped: &mut VecDeque<Submitted<'_>>,
    age: Duration,
) {
    while dropped.front().is_some_and(|job| job.since.elapsed() > age) {
        let Some(job) = dropped.pop_front() else { return };
        let so_long = job.since.elapsed();
        match client.job(&job.id).await {
            Ok(now) if now.state == JobState::Done => world.count("dropped and done"),
            Ok(now) if now.state.is_final() || so_long > PATIENT => {
                let what = format!("{} is {} after {so_long:?}", job.id, now.state);
                world.fail("error: dropped job", &what);
            }
            Ok(_) if age.is_zero() => world.count("dropped and not done at the end"),
            Ok(_) => return dropped.push_front(job),
            Err(e) => world.fail(kind(&e), &e.to_string()),
        }
    }
}

fn compare(world: &World, job: &Submitted<'_>, frame: &ReceivedFrame) {
    world.count("frames");
    let FrameStats { pixels_sha256, poisoned, .. } = &frame.stats;
    let truth = job.scene.frames.get(frame.number as usize);
    let is_true = truth.is_some_and(|truth| {
        <[u8; 32]>::from(Sha256::digest(&frame.bytes)) == truth.bytes
            && (!job.scene.request.want_hash || *pixels_sha256 == truth.pixels)
    });
    if !is_true || !poisoned.is_empty() {
        let (id, number, request) = (&job.id, frame.number, &job.scene.request);
        let what = format!("{id}, frame {number}, tiles given up {poisoned:?}, of {request:?}");
        world.fail("false pictures", &what);
    }
}

// ---------------------------------------------------------------------------------------------
// The hour

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "an hour; tests/nightly.sh soak"]
async fn an_hour_of_joins_kills_stops_and_cancels_has_no_false_picture_no_error_and_no_growth() {
    let set = |name: &str| std::env::var(name).ok();
    let number = |name, default| set(name).map_or(default, |n| n.parse().expect("a number"));
    let minutes: f64 = number("SLABCAST_SOAK_MINUTES", 60.0);
    let seed = number("SLABCAST_SOAK_SEED", 1.0) as u64;
    let program = PathBuf::from(set("SLABCAST_PROGRAM").unwrap_or_else(|| SLABCAST.into()));
    let dir =
        set("SLABCAST_SOAK_DIR").map_or_else(|| env!("CARGO_TARGET_TMPDIR").into(), PathBuf::from);
    for log in ["master.log", "workers.log"] {
        let _ = std::fs::remove_file(dir.join(log));
    }
    println!("seed {seed}, {}, table and logs in {}", program.display(), dir.display());

    let scenes = truths().await;
    let args = ["master", "--listen", "127.0.0.1:0", "--volume", VOLUME];
    let (master, line) = start(&program, &dir.join("master.log"), &args, true);
    let address = line.strip_prefix("listening on ").expect(&line).to_owned();
    let begin = Instant::now();
    let time = Duration::from_secs_f64(60.0 * minutes);
    let world = Arc::new(World {
        program,
        address,
        seed,
        begin,
        end: begin + time,
        scenes,
        tally: Mutex::default(),
        living: Mutex::new([("master".to_owned(), master.0.id())].into()),
        dir,
    });

    let keep = |number| {
        let world = world.clone();
        tokio::task::spawn_blocking(move || keep_worker(&world, number))
    };
    let workers: Vec<_> = (0..WORKERS).map(keep).collect();
    let clients: Vec<_> =
        (0..CLIENTS).map(|n| tokio::spawn(run_client(world.clone(), n))).collect();
    let sampling = {
        let world = world.clone();
        tokio::task::spawn_blocking(move || sample(&world))
    };
    let mut alive = Vec::new();
    for worker in workers {
        alive.push(worker.await.expect("it does not panic"));
    }
    for client in clients {
        client.await.expect("it does not panic");
    }
    let (usage, settled) = sampling.await.expect("it does not panic");
    let took = begin.elapsed();
    for (name, mut process) in alive.into_iter().map(|w| ("worker", w)).chain([("master", master)])
    {
        process.signal("-TERM");
        let code = process.exit_within(PATIENT);
        if code != Some(0) {
            world.fail("ended", &format!("{name}: {code:?} on SIGTERM"));
        }
    }
    report(&world, &usage, settled, took);
    let failures = world.tally.lock().expect("no panic").failures;
    assert_eq!(failures, 0, "seed {seed}: see the lines above");
}

/// Fills the table until the end. Returns it with the time from which on nothing may grow: after a
/// tenth, and when as many jobs came as a master remembers.
fn sample(world: &World) -> (Usage, Duration) {
    let mut usage = Usage::new(&world.dir.join("soak.csv"), world.begin);
    let (mut settled, mut said) = (None, 0);
    while world.has_time() {
        world.pause(SAMPLE);
        let (jobs, at) = (world.counted("jobs"), world.begin.elapsed());
        let is_settled = at >= (world.end - world.begin) / 10 && jobs >= MAX_JOBS as u64;
        settled = settled.or(is_settled.then_some(at));
        usage.take(&world.living.lock().expect("no panic"), jobs);
        if at.as_secs() / 60 > said {
            said = at.as_secs() / 60;
            if let Some(s) = usage.of("master").last() {
                println!("{said:4} min  {jobs} jobs, master {:.1} MiB", s.rss_mib);
            }
        }
    }
    (usage, settled.unwrap_or(world.end - world.begin))
}

/// Prints the figures, and fails what grows.
fn report(world: &World, usage: &Usage, settled: Duration, took: Duration) {
    let log = |name: &str| std::fs::read(world.dir.join(name)).unwrap_or_default();
    for name in ["master.log", "workers.log"] {
        let text = String::from_utf8_lossy(&log(name)).into_owned();
        let lines = |word: &str| text.lines().filter(|line| line.contains(word)).count();
        let [warnings, errors, panics] = [" WARN", "ERROR", "panicked"].map(lines);
        println!("{name}: {} lines, {warnings} warnings, {errors} errors", lines(""));
        if panics > 0 {
            world.fail("panics", name);
        }
    }
    for name in ["master", "worker-0"] {
        let all = usage.of(name);
        let [first, .., last] = all else { continue };
        let rest: Vec<Sample> = all.iter().copied().filter(|s| s.at >= settled).collect();
        let part = |part: f64| {
            let at = first.at + (last.at - first.at).mul_f64(part);
            all.iter().find(|s| s.at >= at).map_or(0.0, |s| s.rss_mib)
        };
        let [tenth, half, whole] = [0.1, 0.5, 1.0].map(part);
        println!(
            "{name}: {tenth:.1} MiB at 10 %, {half:.1} at 50 %, {whole:.1} at the end, {:.1} at \
             most; {:+.2} MiB an hour over the last {:.1} min",
            last.most_mib,
            slope(&rest, |s| s.rss_mib),
            (last.at.saturating_sub(settled)).as_secs_f64() / 60.0,
        );
        let range = |figure: fn(&Sample) -> f64| {
            let of = || rest.iter().map(figure);
            format!("{} to {}", of().fold(f64::MAX, f64::min), of().fold(0.0, f64::max))
        };
        println!(
            "{name}: {} descriptors, {} threads",
            range(|s| s.descriptors),
            range(|s| s.threads)
        );
        if rest.len() < ENOUGH {
            println!("{name}: too short to tell whether it grows");
            continue;
        }
        let grown = growth(&rest, |s| s.rss_mib);
        if grown > GROWTH_PART * rest[0].rss_mib + GROWTH_MIB {
            world.fail("growth", &format!("{name}: memory by {grown:.1} MiB"));
        }
        for (what, figure) in
            [("descriptors", (|s| s.descriptors) as fn(&Sample) -> f64), ("threads", |s| s.threads)]
        {
            let grown = growth(&rest, figure);
            if grown > GROWTH_COUNT {
                world.fail("growth", &format!("{name}: {grown:.1} {what}"));
            }
        }
    }
    let mut tally = world.tally.lock().expect("no panic");
    tally.job_secs.sort_by(f64::total_cmp);
    let secs = |part: f64| {
        let n = tally.job_secs.len();
        tally.job_secs.get(((n as f64 * part) as usize).min(n.saturating_sub(1))).copied()
    };
    let [median, most, slowest] = [0.5, 0.99, 1.0].map(|part| secs(part).unwrap_or(f64::NAN));
    println!("jobs took {median:.2} s at the median, {most:.2} s at 99 %, {slowest:.1} s at most");
    let n = |what: &str| tally.counts.get(what).copied().unwrap_or(0);
    for (what, count) in &tally.counts {
        println!("{count:8} {what}");
    }
    println!(
        "soak: {} jobs, {} frames, {} false, {} failures in {:.1} min; {} joins, {} kills, {} \
         stops, {} leaves, {} cancels",
        n("jobs"),
        n("frames"),
        n("false pictures"),
        tally.failures,
        took.as_secs_f64() / 60.0,
        n("joins"),
        n("kills"),
        n("stops"),
        n("leaves"),
        n("cancels"),
    );
}
