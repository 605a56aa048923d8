//! Links on which bits flip, links that swallow bricks, and a worker that says too much: pixels
//! stay true, nothing hangs, and nobody else waits.
//!
//! A proxy stands between a master and its worker, and between the master and a client. The
//! campaign of a hundred thousand flips in each direction runs at night (`tests/nightly.sh flips`).

#[path = "support/proxy.rs"]
mod proxy;

use proxy::{Noise, Place, Proxy, Swallows};
use sha2::{Digest, Sha256};
use slabcast_client::{Client, ClientError, PATIENCE, Update, VolumeHeader};
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::message::{Hello, ToMaster, ToWorker};
use slabcast_common::protocol::PROTOCOL_VERSIONS;
use slabcast_common::quality::{Quality, Schedule, Work};
use slabcast_master::jobs::WatchItem;
use slabcast_master::library::{UploadConfig, Viewer};
use slabcast_master::{Handle, Library, LibraryConfig, Master, MasterConfig};
use slabcast_proto::cluster_v1::BricksResponse;
use slabcast_proto::cluster_v1::cluster_service_client::ClusterServiceClient;
use slabcast_proto::{convert, sealed};
use slabcast_render::Simd;
use slabcast_scene::path::{Orientation, Turntable, ViewPath};
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::transfer::TransferChoice;
use slabcast_worker::{BrickCache, Config, Link};
use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;

/// Longest time that a job may take on a noisy link. Without flips it takes a tenth of a second; a
/// lease lasts a minute.
const PATIENT: Duration = Duration::from_secs(40);

/// A master that listens, and what stops it.
struct World {
    master: Master,
    address: String,
    stop: watch::Sender<bool>,
    jobs: u32,
}

impl World {
    async fn new() -> World {
        World::of("formula:spheres:40").await
    }

    async fn of(formula: &str) -> World {
        let volume = slabcast_volumes::open(formula.as_ref()).expect("a formula");
        let orientation = Orientation::new(None, None).expect("the defaults");
        let master = Master::start(MasterConfig::new(volume, orientation)).expect("a master");
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("it has one").to_string();
        let (stop, stopped) = watch::channel(false);
        tokio::spawn(slabcast_master::serve::serve(master.handle(), listener, stopped));
        World { master, address, stop, jobs: 0 }
    }

    /// Three frames in another schedule and with another transfer function than the job before, so
    /// that scenes, directories, bricks, leases of both kinds and results cross the link.
    fn request(&mut self) -> PathRequest {
        self.jobs += 1;
        let name = ["auto", "peer-opaque", "grey"][self.jobs as usize / 2 % 3];
        let schedule = [Schedule::Region, Schedule::Slab][self.jobs as usize % 2];
        let turn = Turntable { frames: 3, elevation: 20.0, ..Turntable::default() };
        PathRequest {
            client_key: format!("job {}", self.jobs),
            volume: VolumeChoice::Default,
            level: LevelChoice::default(),
            path: ViewPath::from_turntable([150, 110], turn),
            transfer: TransferChoice::Name(name.into()),
            quality: Quality::before(),
            work: Work { schedule, tile: Some(32), ..Work::default() },
            format: PixelFormat::Rgba32F,
            background: Background::Transparent,
            want_trace: false,
            want_hash: true,
        }
    }

    /// Hashes of a job's frames as the master assembled them.
    async fn run(&self, request: PathRequest) -> Vec<String> {
        let handle: Handle = self.master.handle();
        let job = handle.submit(request).await.expect("a good request");
        let mut watch = handle.watch(job, 0).expect("it was just submitted");
        let mut hashes = Vec::new();
        while let Some(item) = watch.next().await {
            if let WatchItem::Frame(frame) = item {
                assert!(frame.stats.poisoned.is_empty(), "{:?}", frame.stats.poisoned);
                hashes.push(frame.stats.pixels_sha256.clone());
            }
        }
        assert_eq!(hashes.len(), 3, "{:?}", handle.job(job).map(|j| j.state));
        hashes
    }

    fn dial(&self, name: &str, address: &str) {
        let (name, address, stopped) = (name.into(), address.into(), self.stop.subscribe());
        let config = Config {
            name,
            threads: 1,
            memory_budget_bytes: 64 << 20,
            simd: Simd::detect(),
            rehearsal: None,
            machine: String::new(),
        };
        tokio::spawn(slabcast_worker::dial::run(config, address, stopped));
    }
}

/// The frames of the jobs to come, from a master whose worker has no link at all.
async fn truths() -> Vec<Vec<String>> {
    let mut quiet = World::new().await;
    let end = slabcast_master::link::embedded(quiet.master.handle());
    let link = Link { control: end.control, replies: end.replies, bricks: end.bricks };
    let stopped = quiet.stop.subscribe();
    tokio::spawn(async move {
        let config = Config {
            name: "embedded".into(),
            threads: 1,
            memory_budget_bytes: 64 << 20,
            simd: Simd::detect(),
            rehearsal: None,
            machine: String::new(),
        };
        slabcast_worker::run(&config, link, &mut BrickCache::default(), stopped).await
    });
    let mut truths = Vec::new();
    for _ in 0..6 {
        let request = quiet.request();
        truths.push(quiet.run(request).await);
    }
    truths
}

const NONE: Swallows = |_| false;

/// Runs jobs over a noisy link until all flips were made. Returns the flips up and down, and the
/// links that it took.
async fn campaign(seed: u64, flips: u64, one_in: u64, place: Place) -> [u64; 3] {
    let truths = truths().await;
    let mut world = World::new().await;
    let noise = [1, 2].map(|n| Noise::new(seed + n, one_in, flips, place));
    let [up, down] = noise.clone();
    let proxy = Proxy::start(world.address.clone(), (up, down), NONE).await;
    world.dial("noisy", &proxy.address);
    let (begin, mut damaged, mut slowest) = (Instant::now(), 0, Duration::ZERO);
    while noise.iter().any(|n| n.left.load(Relaxed) > 0) {
        let (request, before) = (world.request(), Instant::now());
        let want = &truths[(world.jobs as usize - 1) % 6];
        let got = tokio::time::timeout(PATIENT, world.run(request)).await;
        let flips = noise.each_ref().map(|n| n.flips.load(Relaxed));
        let got = got.unwrap_or_else(|_| panic!("seed {seed}: hung after {flips:?} flips"));
        assert_eq!(&got, want, "seed {seed}: false pixels after {flips:?} flips");
        slowest = slowest.max(before.elapsed());
        let workers = world.master.handle().workers().await;
        damaged = damaged.max(workers.iter().map(|w| w.damaged_messages).sum());
    }
    let [up, down] = noise.each_ref().map(|n| n.flips.load(Relaxed));
    let links = proxy.connections.load(Relaxed) as u64 / 2;
    if links == 1 {
        assert!(damaged >= flips, "seed {seed}: the master counts {damaged}");
    }
    println!(
        "{up} flips up and {down} down in {} jobs of 3 frames: 0 false, 0 hung; slowest job \
         {slowest:.1?}, {links} links, {:.1?} in all",
        world.jobs,
        begin.elapsed(),
    );
    world.stop.send_replace(true);
    [up, down, links]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn flipped_bits_on_a_workers_link_change_no_pixel_and_hang_no_frame() {
    let [up, down, _] = campaign(1, 200, 6, Place::Messages).await;
    assert_eq!((up, down), (200, 200));
}

/// Flips in the lengths of messages, too: those end a link.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn flipped_bits_in_lengths_of_messages_end_links_and_no_frame() {
    let [up, down, links] = campaign(2, 2, 60, Place::Lengths).await;
    assert_eq!((up, down), (2, 2));
    assert!(links > 1, "and are not taken for messages");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "minutes; tests/nightly.sh flips"]
async fn a_hundred_thousand_flips_each_way_change_no_pixel_and_hang_no_frame() {
    let flips = std::env::var("SLABCAST_FLIPS").map_or(100_000, |n| n.parse().expect("a number"));
    let [up, down, _] = campaign(3, flips, 4, Place::Messages).await;
    assert_eq!((up, down), (flips, flips));
}

/// The Bricks connection is the second of each link. What large packets do in a router that drops
/// them: pings go on and bricks do not come.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn link_whose_bricks_are_swallowed_ends_and_the_next_one_draws_the_frame() {
    let first: Swallows = |connection| connection == 1;
    let (took, links) = swallowed(first, false).await;
    assert_eq!(links, 2);
    assert!(took < PATIENT);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn idle_worker_draws_the_tiles_of_one_whose_bricks_are_always_swallowed() {
    let all: Swallows = |connection| connection % 2 == 1;
    let (took, _) = swallowed(all, true).await;
    assert!(took < PATIENT);
}

/// Runs a job on a worker behind a proxy that swallows bricks, beside an honest one or alone.
/// Returns how long it took, and the links of the worker. A lease lasts 60 s.
async fn swallowed(swallows: Swallows, beside_another: bool) -> (Duration, usize) {
    let truths = truths().await;
    let mut world = World::new().await;
    let noise = (Noise::none(), Noise::none());
    let proxy = Proxy::start(world.address.clone(), noise, swallows).await;
    world.dial("stalled", &proxy.address);
    if beside_another {
        world.dial("quiet", &world.address);
    }
    let workers = 1 + usize::from(beside_another);
    while world.master.handle().workers().await.len() < workers {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let (request, before) = (world.request(), Instant::now());
    let got = tokio::time::timeout(PATIENT, world.run(request)).await.expect("no frame hangs");
    assert_eq!(got, truths[0]);
    world.stop.send_replace(true);
    (before.elapsed(), proxy.connections.load(Relaxed).div_ceil(2))
}

/// GetJob calls beside each job of [`watched`]. A job alone makes two requests, so few of the flips
/// towards the master would hit one.
const ASKED: usize = 20;

/// Submits and watches jobs through a proxy that flips bits of what a client and its master send to
/// each other.
async fn watched(seed: u64, flips: u64, one_in: u64) {
    let truths = truths().await;
    let mut world = World::new().await;
    let noise = [1, 2].map(|n| Noise::new(seed + n, one_in, flips, Place::Messages));
    let [up, down] = noise.clone();
    let proxy = Proxy::start(world.address.clone(), (up, down), NONE).await;
    world.dial("quiet", &world.address);
    let begin = Instant::now();
    let mut damaged = 0;
    // The call that the client waits for, to be named if it hangs.
    let doing = RefCell::new(String::new());
    let did = |what: String| *doing.borrow_mut() = format!("{what} at {:.1?}", begin.elapsed());
    while noise.iter().any(|n| n.left.load(Relaxed) > 0) {
        let request = world.request();
        let want = truths[(world.jobs as usize - 1) % 6].clone();
        let got = tokio::time::timeout(PATIENT, async {
            did("began to connect".into());
            let client = Client::connect(&proxy.address).await.expect("it listens");
            did("connected".into());
            let job = client.submit(&request).await.expect("a good request");
            for n in 0..ASKED {
                did(format!("made {n} calls of GetJob"));
                let asked = client.job(&job).await.expect("it was just submitted");
                assert_eq!((&asked.job_id, &asked.client_key), (&job, &request.client_key));
            }
            let mut frames = client.follow(&job, 0, PATIENCE).await.expect("it is there");
            let mut got = Vec::new();
            while let Some(update) = frames.next().await.expect("a frame in the end") {
                did(format!("frame {}, {:?}", frames.next_frame(), frames.damaged_messages()));
                if let Update::Frame(frame) = update {
                    let hash: String =
                        Sha256::digest(&frame.bytes).iter().map(|b| format!("{b:02x}")).collect();
                    assert_eq!(hash, frame.stats.pixels_sha256, "seed {seed}");
                    got.push(hash);
                }
            }
            damaged += frames.damaged_messages();
            got
        });
        let Ok(got) = got.await else {
            let handle = world.master.handle();
            let flips = noise.each_ref().map(|n| n.flips.load(Relaxed));
            let workers = handle.workers().await;
            panic!(
                "seed {seed}: job {} hangs at {:.1?} after {flips:?} flips and {damaged} damaged \
                 messages of watches; the client: {}; {:?}, {:?}",
                world.jobs,
                begin.elapsed(),
                doing.borrow(),
                handle.jobs().last(),
                workers,
            );
        };
        assert_eq!(got, want, "seed {seed}");
    }
    let [up, down] = noise.each_ref().map(|n| n.flips.load(Relaxed));
    println!(
        "{up} flips up and {down} down between a client and its master in {} jobs of 3 frames: 0 \
         false, 0 hung; {damaged} messages of watches asked for again, {:.1?}",
        world.jobs,
        begin.elapsed()
    );
    assert!(damaged > 0);
    world.stop.send_replace(true);
}

/// A stream that is dropped with data on its way gives its share of the connection's window back: a
/// connection that leaked some at each would stand still after a few megabytes.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn frames_that_come_damaged_again_and_again_leave_their_connection_whole() {
    let truths = truths().await;
    let mut world = World::new().await;
    let down = Noise::new(6, 3, u64::MAX, Place::Messages);
    let proxy = Proxy::start(world.address.clone(), (Noise::none(), down.clone()), NONE).await;
    world.dial("quiet", &world.address);
    let client = Client::connect(&proxy.address).await.expect("it listens");
    let job = client.submit(&world.request()).await.expect("a good request");
    let mut damaged = 0;
    while damaged < 300 {
        let got = tokio::time::timeout(PATIENT, async {
            let mut frames = client.follow(&job, 0, PATIENCE).await.expect("it is there");
            let mut got = Vec::new();
            while let Some(update) = frames.next().await.expect("a frame in the end") {
                if let Update::Frame(frame) = update {
                    got.push(frame.stats.pixels_sha256);
                }
            }
            damaged += frames.damaged_messages();
            got
        });
        let got = got.await.unwrap_or_else(|_| panic!("stands still after {damaged} messages"));
        assert_eq!(got, truths[0]);
    }
    assert_eq!(proxy.connections.load(Relaxed), 1);
    world.stop.send_replace(true);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn flipped_bits_between_a_client_and_its_master_change_no_picture() {
    watched(4, 60, 6).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "minutes; tests/nightly.sh flips"]
async fn a_hundred_thousand_flips_each_way_change_no_picture_of_a_client() {
    let flips = std::env::var("SLABCAST_FLIPS").map_or(100_000, |n| n.parse().expect("a number"));
    watched(5, flips, 3).await;
}

/// A volume of 2 MiB crosses a line that damages a third of all frames.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn volume_that_is_put_over_a_noisy_line_arrives_whole() {
    let dir = tempfile::tempdir().expect("a folder");
    let axes = Orientation::new(None, None).expect("the defaults");
    let uploads = UploadConfig { folder: dir.path().into(), quota_bytes: 1 << 30 };
    let library = Library::new(LibraryConfig {
        given: None,
        folder: None,
        uploads: Some(uploads),
        memory_bytes: 1 << 30,
        read: Arc::new(|_, _| unreachable!("it has no folder")),
    });
    let config = MasterConfig::of(library.expect("a library"));
    let master = Master::start(config).expect("a master");
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("it has one").to_string();
    let (stop, stopped) = watch::channel(false);
    tokio::spawn(slabcast_master::serve::serve(master.handle(), listener, stopped));
    let noise = [8, 9].map(|seed| Noise::new(seed, 3, u64::MAX, Place::Messages));
    let [up, down] = noise.clone();
    let proxy = Proxy::start(address, (up, down), NONE).await;
    let volume = slabcast_volumes::open("formula:spheres:128".as_ref()).expect("a formula");
    let header = VolumeHeader {
        name: "noisy".into(),
        file_type: volume.file_type.clone(),
        info: volume.info(volume.digest()),
        orientation: axes,
    };
    let put = tokio::time::timeout(PATIENT, async {
        let client = Client::connect(&proxy.address).await.expect("it listens");
        client.put_volume(&header, &volume.samples, |_| {}).await.expect("there in the end");
    });
    put.await.expect("no hang");
    assert!(noise[0].flips.load(Relaxed) > 5, "{:?}", noise[0]);
    let choice = VolumeChoice::Digest(volume.digest());
    let open = master.handle().library().open(&choice, Viewer::own()).expect("it is there");
    let arrived = open.source.whole(open.level).expect("it is in memory");
    assert_eq!(arrived.samples, volume.samples);
    stop.send_replace(true);
}

/// A client that closes its watches and drops its calls, many at a time, loses no other stream of
/// its connection. HTTP/2 servers close connections on which too many streams are reset.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_thousand_watches_closed_and_calls_dropped_64_at_a_time_end_no_other_watch() {
    let mut world = World::new().await;
    let client = Client::connect(&world.address).await.expect("it listens");
    // No worker: the job waits, and so does its watch.
    let job = client.submit(&world.request()).await.expect("a good request");
    let mut other = client.watch(&job, 0).await.expect("it was just submitted");
    assert!(matches!(other.next().await, Ok(Some(Update::Notice(_)))));
    let mut dropped = 0;
    for _ in 0..32 {
        // A connection takes 31 calls at a time beside the first watch; 64 are made.
        let closing = (0..64).map(|_| {
            let (client, job) = (client.clone(), job.clone());
            tokio::spawn(async move {
                // A master that is slow to see watches close has no place for more.
                while let Err(e) = client.watch(&job, 0).await.map(drop) {
                    assert!(matches!(e, ClientError::Full { .. }), "{e}");
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
            })
        });
        for closed in closing.collect::<Vec<_>>() {
            closed.await.expect("no error");
        }
        let calls = (0..64).map(|_| {
            let (client, job) = (client.clone(), job.clone());
            tokio::spawn(async move { client.job(&job).await.map(drop) })
        });
        let calls: Vec<_> = calls.collect();
        tokio::time::sleep(Duration::from_millis(1)).await;
        for call in calls {
            call.abort();
            dropped += u32::from(call.await.is_err());
        }
    }
    assert!(dropped > 500, "many calls are dropped before their answer: {dropped}");
    world.dial("quiet", &world.address);
    let mut frames = 0;
    while let Some(update) = other.next().await.expect("the first watch goes on") {
        frames += u32::from(matches!(update, Update::Frame(_)));
    }
    assert_eq!(frames, 3);
    world.stop.send_replace(true);
}

/// A worker that draws nothing and asks for all bricks of the set again and again, by lawful
/// messages, without reading one. Returns the bricks that it named until `stop`.
async fn flood(address: String, mut stop: watch::Receiver<bool>) -> u64 {
    let hello = Hello {
        protocol_versions: PROTOCOL_VERSIONS,
        pixels_version: slabcast_common::PIXELS_VERSION,
        name: "flood".into(),
        threads: 1,
        memory_budget_bytes: 1 << 40,
        simd: "plain".into(),
        self_test_sha256: slabcast_common::SELF_TEST_SHA256.into(),
        held: vec![],
        rehearses: false,
        machine: "elsewhere".into(),
    };
    let connect = || ClusterServiceClient::connect(format!("http://{address}"));
    let (say, said) = tokio::sync::mpsc::channel::<ToMaster>(8);
    let messages = ReceiverStream::new(said).map(|m| convert::from_worker_to_wire(&m));
    let (sealed_out, opener) = sealed::ends(messages);
    let hello = tokio_stream::once(convert::from_worker_to_wire(&ToMaster::Hello(hello)));
    let mut control = connect().await.unwrap();
    let mut inbound = control.control(hello.chain(sealed_out)).await.unwrap().into_inner();
    let mut unread = None;
    let (mut flooding, named) = (None, Arc::new(AtomicU64::new(0)));
    loop {
        let message = tokio::select! {
            message = inbound.message() => message,
            _ = stop.changed() => break,
        };
        let Ok(Some(message)) = message else { break };
        let Some(message) = opener.open(message).unwrap() else { continue };
        match convert::to_worker_from_wire(message).unwrap() {
            (_, Some(session)) => {
                let open = tokio_stream::once(convert::bricks_open_to_wire(session));
                let (open, _) =
                    sealed::ends::<_, BricksResponse>(open.chain(tokio_stream::pending()));
                unread = Some(connect().await.unwrap().bricks(open).await.unwrap());
            }
            (ToWorker::Ping { nonce }, _) => {
                let _ = say.try_send(ToMaster::Pong { nonce, clock_us: nonce });
            }
            (ToWorker::Directory { set, bricks, .. }, _) if flooding.is_none() => {
                let bricks: Vec<_> = bricks.iter().map(|b| b.id).collect();
                let (say, named) = (say.clone(), named.clone());
                flooding = Some(tokio::spawn(async move {
                    loop {
                        let bricks = bricks.clone();
                        named.fetch_add(2 * bricks.len() as u64, Relaxed);
                        let wanted = ToMaster::BricksWanted { set, bricks: bricks.clone() };
                        let evicted = ToMaster::BricksEvicted { set, bricks };
                        if say.send(wanted).await.is_err() || say.send(evicted).await.is_err() {
                            return;
                        }
                    }
                }));
            }
            _ => {}
        }
    }
    drop(unread);
    if let Some(flooding) = flooding {
        flooding.abort();
    }
    named.load(Relaxed)
}

/// Half of what `ListWorkers` took, in some calls one after the other.
async fn median_answer(handle: &Handle) -> Duration {
    let mut took = Vec::new();
    for _ in 0..41 {
        let before = Instant::now();
        handle.workers().await;
        took.push(before.elapsed());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    took.sort_unstable();
    took[took.len() / 2]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn worker_that_asks_for_all_bricks_again_and_again_makes_nobody_else_wait() {
    let (mut world, begin) = (World::of("formula:spheres:200").await, Instant::now());
    let handle = world.master.handle();
    world.dial("honest", &world.address);
    let (stop, stopped) = watch::channel(false);
    let flooding = tokio::spawn(flood(world.address.clone(), stopped));
    while handle.workers().await.len() < 2 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let idle = median_answer(&handle).await;
    // By regions, of which each worker gets the directory.
    world.jobs = 1;
    let (request, before) = (world.request(), Instant::now());
    tokio::time::timeout(PATIENT, world.run(request)).await.expect("no frame hangs");
    let first = before.elapsed();
    let beside = median_answer(&handle).await;
    world.jobs = 7;
    let (request, before) = (world.request(), Instant::now());
    tokio::time::timeout(PATIENT, world.run(request)).await.expect("no frame hangs");
    let second = before.elapsed();
    stop.send_replace(true);
    let named = flooding.await.unwrap();
    println!(
        "ListWorkers takes {idle:.1?} idle and {beside:.1?} beside a flood that named {named} \
         bricks; jobs of 3 frames took {first:.1?} and {second:.1?}"
    );
    // The account of a new link, what fills it, and what may be on its way unread: a byte a brick.
    let trickle = (1 << 17) as f64 * (begin.elapsed().as_secs_f64() + 1.0);
    let most = (1 << 18) + trickle as u64 + sealed::WINDOW_BYTES as u64 + (1 << 17);
    assert!(named > 1 << 18, "it says more than it may: {named}");
    assert!(named < most, "it is read slowly then: {named} of {most}");
    assert!(beside < idle + Duration::from_millis(150), "{beside:?}, {idle:?} when idle");
    world.stop.send_replace(true);
}
