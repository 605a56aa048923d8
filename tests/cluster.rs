//! A cluster of real processes on localhost: master, workers, client.
//!
//! The story of each test: build a small cluster, let it render, do something to it, compare
//! pixels with a run inside one process. A worker that is to die is first stopped (SIGSTOP), so
//! that what it holds it holds when it is killed; the master's own word says that it held a
//! tile. Waiting is asking the master until it answers so, with a deadline.

#[path = "support/processes.rs"]
mod processes;

use processes::{Process, SLABCAST};
use slabcast_client::Client;
use slabcast_common::stats::FrameStats;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

const VOLUME: &str = "formula:spheres:64";
/// Thin sheets and a large picture: each tile takes long enough to be caught in the act.
const VIEWS: [&str; 10] = [
    "--size",
    "300x280",
    "--frames",
    "4",
    "--elevation",
    "15",
    "--thickness",
    "0.125",
    "--tf",
    "auto",
];

fn master() -> (Process, String) {
    processes::master(Path::new("."), VOLUME, &[])
}

/// Starts a master of `volume` at an address that was free a moment ago.
fn master_at(address: &str, volume: &str) -> Process {
    let child = Command::new(SLABCAST)
        .args(["master", "--volume", volume, "--listen", address])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the master starts");
    Process(child)
}

fn worker(master: &str, name: &str) -> Process {
    processes::worker(Path::new("."), master, name, &["--threads", "1", "--memory", "48MiB"])
}

fn stats(file: &Path) -> Vec<FrameStats> {
    let text = std::fs::read_to_string(file).expect("statistics were written");
    text.lines().map(|l| serde_json::from_str(l).expect("a line of statistics")).collect()
}

fn hashes(stats: &[FrameStats]) -> Vec<String> {
    stats.iter().map(|f| f.pixels_sha256.clone()).collect()
}

fn run(command: &mut Command) -> Output {
    let out = command.output().expect("slabcast runs");
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    out
}

/// Renders [`VIEWS`] inside one process, under the paper's schedule. Returns the frames' hashes.
fn embedded(dir: &Path) -> Vec<String> {
    let file = dir.join("embedded.jsonl");
    run(Command::new(SLABCAST)
        .args(["render", VOLUME, "--workers", "1", "--threads", "1", "--schedule", "slab"])
        .args(VIEWS)
        .arg("-o")
        .arg(dir.join("embedded"))
        .arg("--stats")
        .arg(&file));
    hashes(&stats(&file))
}

/// Starts a client that renders [`VIEWS`] on a master. Returns it with its file of statistics.
fn render(dir: &Path, master: &str, name: &str, schedule: &str) -> (Process, PathBuf) {
    let file = dir.join(format!("{name}.jsonl"));
    let child = Command::new(SLABCAST)
        .args(["render", "--master", master, "--schedule", schedule])
        .args(VIEWS)
        .arg("-o")
        .arg(dir.join(name))
        .arg("--stats")
        .arg(&file)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the client starts");
    (Process(child), file)
}

/// Asks until there is an answer; each question is a round trip to the master.
async fn until<T>(what: &str, mut look: impl AsyncFnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + Duration::from_secs(60);
    loop {
        if let Some(seen) = look().await {
            return seen;
        }
        assert!(Instant::now() < deadline, "never seen: {what}");
        tokio::task::yield_now().await;
    }
}

async fn until_workers(client: &Client, count: usize) {
    until("the workers", async || {
        (client.workers().await.expect("the master answers").len() == count).then_some(())
    })
    .await;
}

/// Tiles that the master says a worker holds.
async fn lent(client: &Client, name: &str) -> Option<u32> {
    let workers = client.workers().await.expect("the master answers");
    workers.iter().find(|w| w.name == name).map(|w| w.tasks_lent)
}

#[tokio::test]
async fn worker_killed_with_leased_slab_tiles_costs_no_pixel() {
    killed_with_a_tile("slab").await;
}

#[tokio::test]
async fn worker_killed_with_leased_regions_costs_no_pixel() {
    killed_with_a_tile("region").await;
}

async fn killed_with_a_tile(schedule: &str) {
    let dir = tempfile::tempdir().unwrap();
    let want = embedded(dir.path());
    let (_master, address) = master();
    let client = Client::connect(&address).await.unwrap();
    let (_a, victim, _c) =
        (worker(&address, "a"), worker(&address, "victim"), worker(&address, "c"));
    until_workers(&client, 3).await;

    let (mut rendering, file) = render(dir.path(), &address, "out", schedule);
    until("a tile lent to the victim", async || lent(&client, "victim").await.filter(|&n| n > 0))
        .await;
    victim.signal("-STOP");
    // It can't answer any more. When the master has heard nothing from it for a while, all that was
    // on its way has arrived.
    let held = until("the victim's tiles", async || {
        let workers = client.workers().await.expect("the master answers");
        let victim = workers.into_iter().find(|w| w.name == "victim")?;
        (victim.silent >= Duration::from_millis(50) && victim.tasks_lent > 0)
            .then_some(victim.tasks_lent)
    })
    .await;
    assert!(held > 0, "the victim is killed while tiles are leased to it");
    victim.signal("-KILL");
    assert_eq!(rendering.exit_within(Duration::from_secs(120)), Some(0));

    let frames = stats(&file);
    assert_eq!(hashes(&frames), want, "the same pixels as in one process");
    let retries: u64 = frames.iter().map(|f| f.retries).sum();
    assert!(retries >= 1, "its {held} tiles were handed out again");
    until("the victim gone", async || lent(&client, "victim").await.is_none().then_some(())).await;
    for i in 0..4 {
        assert!(dir.path().join(format!("out/frame_{i:04}.png")).is_file());
    }
}

/// Single frames on more threads than there are tiles to share out evenly: after the first frames
/// have taught the master what tiles cost, it splits some before they are drawn.
#[tokio::test]
async fn split_tiles_of_a_sole_frame_cost_no_pixel() {
    let dir = tempfile::tempdir().expect("a folder");
    let views = ["--size", "300x280", "--frames", "1", "--thickness", "0.125", "--tf", "auto"];
    let render = |name: &str, how: &[&str]| {
        let file = dir.path().join(format!("{name}.jsonl"));
        run(Command::new(SLABCAST)
            .arg("render")
            .args(how)
            .args(views)
            .arg("-o")
            .arg(dir.path().join(name))
            .arg("--stats")
            .arg(&file));
        stats(&file).remove(0)
    };
    let one = ["--workers", "1", "--threads", "1", "--schedule", "slab"];
    let want = render("embedded", &[&[VOLUME], &one[..]].concat()).pixels_sha256;
    let (_master, address) = master();
    let _workers = ["a", "b", "c"]
        .map(|name| processes::worker(Path::new("."), &address, name, &["--threads", "5"]));
    let client = Client::connect(&address).await.unwrap();
    until_workers(&client, 3).await;
    let mut cut = false;
    for i in 0..5 {
        let frame = render(&i.to_string(), &["--master", &address, "--schedule", "region"]);
        assert_eq!(frame.pixels_sha256, want, "frame {i}");
        let has = |size| frame.slabs[0].tiles.iter().any(|t| t.size == size);
        cut |= has(64) && has(32);
    }
    assert!(cut, "no frame had tiles of two sizes");
}

/// One tile holds nearly all of the picture: a worker without one steals a piece of it while it is
/// drawn.
#[tokio::test]
async fn work_stealing_while_a_tile_is_drawn_costs_no_pixel() {
    let dir = tempfile::tempdir().expect("a folder");
    // Larger tiles than of 64 pixels are split beforehand, not stolen from.
    let views = ["--size", "62x60", "--frames", "1", "--thickness", "0.015625", "--tile", "64"];
    let render = |name: &str, how: &[&str]| {
        let out = dir.path().join(name);
        run(Command::new(SLABCAST).arg("render").args(how).args(views).arg("-o").arg(&out));
        std::fs::read(out.join("frame_0000.png")).expect("a picture")
    };
    let one = ["--workers", "1", "--threads", "1", "--schedule", "slab"];
    let want = render("embedded", &[&[VOLUME], &one[..]].concat());
    let (_master, address) = master();
    let client = Client::connect(&address).await.unwrap();
    let _workers = ["a", "b"].map(|name| worker(&address, name));
    until_workers(&client, 2).await;
    let mut pieces = 0;
    for i in 0..4 {
        let file = dir.path().join(format!("{i}.jsonl"));
        let file = file.to_str().expect("a name");
        // With sums on the wire, and with finished pixels.
        let how = [&["--master", &address, "--stats", file][..], &["--no-hash"][..i % 2]].concat();
        assert!(render(&i.to_string(), &how) == want, "frame {i}");
        pieces += stats(file.as_ref())[0].handed_over;
    }
    assert!(pieces > 0);
}

/// Workers on the master's machine share its processors, so that the frames of a path have few,
/// large tiles.
#[tokio::test]
async fn workers_on_the_masters_machine_get_large_tiles_of_the_same_pixels() {
    let dir = tempfile::tempdir().expect("a folder");
    let want = embedded(dir.path());
    let (_master, address) = master();
    let client = Client::connect(&address).await.expect("the master answers");
    let _workers = ["a", "b"].map(|name| worker(&address, name));
    until_workers(&client, 2).await;
    let (mut rendering, file) = render(dir.path(), &address, "out", "region");
    assert_eq!(rendering.exit_within(Duration::from_secs(120)), Some(0));
    let frames = stats(&file);
    assert_eq!(hashes(&frames), want);
    // The first frame may be begun before the master knows of the others, and a busy machine makes
    // tiles slow that then are divided. Workers elsewhere get no such tile in any frame.
    let edge = |frame: &FrameStats| frame.slabs[0].tiles.iter().map(|t| t.size).min();
    let edges: Vec<_> = frames[1..].iter().map(edge).collect();
    let large = edges.iter().filter(|&&edge| edge >= Some(128)).count();
    assert!(large > 0, "smallest tiles of the frames: {edges:?}");
}

#[tokio::test]
async fn job_waits_for_workers_and_goes_on_with_late_joiners() {
    let dir = tempfile::tempdir().unwrap();
    let want = embedded(dir.path());
    let (_master, address) = master();
    let client = Client::connect(&address).await.unwrap();
    let (mut rendering, file) = render(dir.path(), &address, "out", "auto");
    let job = until("a job that waits for workers", async || {
        let jobs = client.jobs(1).await.unwrap();
        jobs.into_iter().find(|j| j.state == slabcast_proto::model::JobState::WaitingForWorkers)
    })
    .await;
    assert!(job.message.contains("slabcast worker"), "says what to do: {}", job.message);

    let first = worker(&address, "first");
    until("a tile lent", async || lent(&client, "first").await.filter(|&n| n > 0)).await;
    // One comes and one goes, politely, while a frame is rendered.
    let _second = worker(&address, "second");
    until_workers(&client, 2).await;
    first.signal("-TERM");
    let mut first = first;
    assert_eq!(first.exit_within(Duration::from_secs(10)), Some(0), "a clean goodbye");
    assert_eq!(rendering.exit_within(Duration::from_secs(120)), Some(0));
    assert_eq!(hashes(&stats(&file)), want);
}

#[tokio::test]
async fn workers_reconnect_after_a_master_restart() {
    let (first, address) = master();
    let _worker = worker(&address, "patient");
    let client = Client::connect(&address).await.unwrap();
    until("the worker", async || lent(&client, "patient").await).await;
    first.signal("-TERM");
    let mut first = first;
    assert_eq!(first.exit_within(Duration::from_secs(10)), Some(0), "a clean goodbye");
    let _again = master_at(&address, VOLUME);
    let client = until("the master", async || Client::connect(&address).await.ok()).await;
    until("the worker again", async || {
        client.workers().await.ok()?.iter().find(|w| w.name == "patient").map(|_| ())
    })
    .await;
}

/// The client submits its job anew to a master that was restarted, and must not mix two volumes.
#[tokio::test]
async fn master_that_comes_back_with_another_volume_ends_the_job_with_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let (first, address) = master();
    let client = Client::connect(&address).await.unwrap();
    let (mut rendering, _) = render(dir.path(), &address, "out", "auto");
    until("the job", async || client.jobs(1).await.ok()?.pop()).await;
    first.signal("-KILL");
    drop(first);
    let _other = master_at(&address, "formula:spheres:32");
    assert_eq!(rendering.exit_within(Duration::from_secs(60)), Some(1));
    let mut said = String::new();
    rendering.0.stderr.take().expect("piped").read_to_string(&mut said).expect("text");
    assert!(said.contains("has another volume now"), "{said}");
}

/// A worker of another version is told both versions and does not dial again.
#[tokio::test]
async fn worker_of_another_version_is_refused_with_both_versions() {
    use slabcast_common::message::{Hello, ToMaster, ToWorker};
    use slabcast_proto::{
        cluster_v1::cluster_service_client::ClusterServiceClient as ClusterClient, convert,
    };
    let (_master, address) = master();
    use slabcast_common::protocol::{PROTOCOL_VERSIONS, ProtocolVersions};
    let hello = |protocol_version: u32, pixels_version: u32, hash: &str| Hello {
        protocol_versions: ProtocolVersions { oldest: protocol_version, newest: protocol_version },
        pixels_version,
        name: "stranger".into(),
        threads: 1,
        memory_budget_bytes: 1 << 20,
        simd: "plain".into(),
        self_test_sha256: hash.into(),
        held: vec![],
        rehearses: false,
        machine: String::new(),
    };
    use slabcast_common::{PIXELS_VERSION, PROTOCOL_VERSION, SELF_TEST_SHA256};
    let good = SELF_TEST_SHA256;
    let wrong = "0".repeat(64);
    let [this, expects] =
        [format!("this master {PROTOCOL_VERSIONS}"), format!("expects {PIXELS_VERSION}")];
    for (hello, both) in [
        (hello(99, PIXELS_VERSION, good), ["99", &this]),
        (hello(PROTOCOL_VERSION, 99, good), ["99", &expects]),
        (hello(PROTOCOL_VERSION, PIXELS_VERSION, &wrong), ["self-test tile", "differs"]),
    ] {
        let mut client = ClusterClient::connect(format!("http://{address}")).await.unwrap();
        let first = convert::from_worker_to_wire(&ToMaster::Hello(hello));
        let stream =
            tokio_stream::StreamExt::chain(tokio_stream::once(first), tokio_stream::pending());
        let mut answers = client.control(stream).await.unwrap().into_inner();
        let answer = answers.message().await.unwrap().expect("an answer");
        let (ToWorker::Refused { reason }, None) = convert::to_worker_from_wire(answer).unwrap()
        else {
            panic!("let in")
        };
        assert!(both.iter().all(|b| reason.contains(b)), "names both: {reason}");
        assert!(!reason.contains(good), "a stranger learns what to say: {reason}");
        assert!(answers.message().await.unwrap().is_none(), "and the link ends");
    }
}

/// A worker from the master's address whose machine has another name is at the end of a tunnel, and
/// packs its results.
#[tokio::test]
async fn worker_on_the_masters_machine_sends_results_unpacked() {
    use slabcast_common::message::{Hello, ToMaster, ToWorker};
    use slabcast_common::{PIXELS_VERSION, SELF_TEST_SHA256};
    use slabcast_proto::{
        cluster_v1::ControlRequest,
        cluster_v1::cluster_service_client::ClusterServiceClient as ClusterClient, convert, sealed,
    };
    let named = Path::new("/proc/sys/kernel/random/boot_id").exists();
    for (machine, here) in [("", true), ("another", !named)] {
        let ((_master, address), dir) = (master(), tempfile::tempdir().unwrap());
        let hello = Hello {
            protocol_versions: slabcast_common::protocol::PROTOCOL_VERSIONS,
            pixels_version: PIXELS_VERSION,
            name: "stub".into(),
            threads: 1,
            memory_budget_bytes: 1 << 20,
            simd: "plain".into(),
            self_test_sha256: SELF_TEST_SHA256.into(),
            held: vec![],
            rehearses: false,
            machine: machine.into(),
        };
        let mut client = ClusterClient::connect(format!("http://{address}")).await.unwrap();
        let first = convert::from_worker_to_wire(&ToMaster::Hello(hello));
        let stream =
            tokio_stream::StreamExt::chain(tokio_stream::once(first), tokio_stream::pending());
        let mut answers = client.control(stream).await.unwrap().into_inner();
        let (_, opener) = sealed::ends(tokio_stream::empty::<ControlRequest>());
        let answer = answers.message().await.unwrap().expect("an answer");
        let answer = opener.open(answer).unwrap().expect("it is whole");
        let (welcome, _) = convert::to_worker_from_wire(answer).unwrap();
        assert!(matches!(welcome, ToWorker::Welcome { .. }), "not let in: {welcome:?}");
        let _client = render(dir.path(), &address, "told", "region");
        let told = loop {
            let message = answers.message().await.unwrap().expect("a frame");
            let message = opener.open(message).unwrap().expect("it is whole");
            if let (ToWorker::Frame { plain, .. }, _) =
                convert::to_worker_from_wire(message).unwrap()
            {
                break plain;
            }
        };
        assert_eq!(told, here, "{machine}");
    }
}

/// Services that any gRPC client relies on, and round trips without delayed acknowledgements.
#[tokio::test]
async fn health_and_reflection_answer_and_round_trips_are_quick() {
    use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
    let (_master, address) = master();
    let channel = tonic::transport::Endpoint::from_shared(format!("http://{address}"))
        .unwrap()
        .connect()
        .await
        .unwrap();
    let mut health = HealthClient::new(channel.clone());
    for service in ["slabcast.render.v1.RenderService", "slabcast.cluster.v1.ClusterService"] {
        let request = HealthCheckRequest { service: service.into() };
        let status = health.check(request).await.unwrap().into_inner().status;
        assert_eq!(status, 1, "{service} serves");
    }
    use tonic_reflection::pb::v1::ServerReflectionRequest;
    use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
    use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
    use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;
    let ask = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let mut answers = ServerReflectionClient::new(channel)
        .server_reflection_info(tokio_stream::once(ask))
        .await
        .unwrap()
        .into_inner();
    let answer = answers.message().await.unwrap().unwrap().message_response;
    let Some(MessageResponse::ListServicesResponse(list)) = answer else { panic!("a list") };
    let names: Vec<_> = list.service.iter().map(|s| s.name.as_str()).collect();
    assert!(
        names.contains(&"slabcast.render.v1.RenderService")
            && names.contains(&"slabcast.cluster.v1.ClusterService")
    );

    // Without TCP_NODELAY a round trip takes 40 ms; the best of many is far below.
    let client = Client::connect(&address).await.unwrap();
    let mut best = Duration::MAX;
    for _ in 0..30 {
        let before = Instant::now();
        client.jobs(1).await.unwrap();
        best = best.min(before.elapsed());
    }
    assert!(best < Duration::from_millis(20), "best round trip {best:?}");
}

/// A peer that says nothing, or half a preface, does not keep its connection.
#[tokio::test]
async fn silent_connection_is_closed() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let (_master, address) = master();
    for words in [&b""[..], b"PRI * HTTP"] {
        let mut io = tokio::net::TcpStream::connect(&address).await.unwrap();
        io.write_all(words).await.unwrap();
        let mut rest = Vec::new();
        let closed = tokio::time::timeout(Duration::from_secs(10), io.read_to_end(&mut rest)).await;
        assert!(closed.is_ok(), "still open after 10 s ({} bytes said)", words.len());
    }
}
