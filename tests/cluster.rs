//! A cluster of real processes on localhost: master, workers, client.
//!
//! The story of each test: build a small cluster, let it render, do something to it, compare
//! pixels with a run inside one process. A worker that is to die is first stopped (SIGSTOP), so
//! that what it holds it holds when it is killed; the master's own word says that it held a
//! tile. Waiting is polling with a deadline, never a sleep that hopes.

use slabcast_client::Client;
use slabcast_common::stats::FrameStats;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

const SLABCAST: &str = env!("CARGO_BIN_EXE_slabcast");
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

/// A process that does not outlive its test.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Process {
    fn signal(&self, name: &str) {
        let status = Command::new("kill").args([name, &self.0.id().to_string()]).status();
        assert!(status.expect("kill is there").success());
    }

    fn exit_within(&mut self, limit: Duration) -> Option<i32> {
        let until = Instant::now() + limit;
        while Instant::now() < until {
            if let Some(status) = self.0.try_wait().expect("a child of ours") {
                return status.code();
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        panic!("still running after {limit:?}");
    }
}

fn master() -> (Process, String) {
    let mut child = Command::new(SLABCAST)
        .args(["master", "--volume", VOLUME, "--listen", "127.0.0.1:0"])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("the master starts");
    let mut line = String::new();
    let out = child.stdout.take().expect("piped");
    BufReader::new(out).read_line(&mut line).expect("a line");
    let address = line.trim().strip_prefix("listening on ").expect(&line).to_string();
    (Process(child), address)
}

fn worker(master: &str, name: &str) -> Process {
    let child = Command::new(SLABCAST)
        .args(["worker", "--master", master, "--name", name, "--threads", "1"])
        .args(["--memory", "16MiB"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the worker starts");
    Process(child)
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

/// The same views inside one process, under the paper's schedule.
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

async fn until<T>(what: &str, mut look: impl AsyncFnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + Duration::from_secs(60);
    loop {
        if let Some(seen) = look().await {
            return seen;
        }
        assert!(Instant::now() < deadline, "never seen: {what}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// How many tiles the master says that a worker holds.
async fn lent(client: &Client, name: &str) -> Option<u32> {
    let workers = client.workers().await.expect("the master answers");
    workers.iter().find(|w| w.name == name).map(|w| w.tasks_lent)
}

#[tokio::test]
async fn a_worker_killed_with_a_tile_in_its_hands_costs_no_pixel() {
    killed_with_a_tile("slab").await;
}

#[tokio::test]
async fn a_worker_killed_with_a_region_in_its_hands_costs_no_pixel() {
    killed_with_a_tile("region").await;
}

async fn killed_with_a_tile(schedule: &str) {
    let dir = tempfile::tempdir().unwrap();
    let want = embedded(dir.path());
    let (_master, address) = master();
    let client = Client::connect(&address).await.unwrap();
    let (_a, victim, _c) =
        (worker(&address, "a"), worker(&address, "victim"), worker(&address, "c"));
    until("three workers", async || (client.workers().await.unwrap().len() == 3).then_some(()))
        .await;

    let (mut rendering, file) = render(dir.path(), &address, "out", schedule);
    until("a tile lent to the victim", async || lent(&client, "victim").await.filter(|&n| n > 0))
        .await;
    victim.signal("-STOP");
    // It can't answer any more. What was on its way meanwhile has arrived when two looks in a
    // row say the same; a new lease may have come, too.
    let held = until("the victim's tiles", async || {
        let before = lent(&client, "victim").await;
        tokio::time::sleep(Duration::from_millis(50)).await;
        lent(&client, "victim").await.filter(|&n| n > 0 && Some(n) == before)
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

/// Frames one by one on more threads than there are tiles to share out evenly: what the first ones teach has
/// tiles cut into parts.
#[tokio::test]
async fn tiles_that_are_cut_for_a_frame_alone_cost_no_pixel() {
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
    let _workers = ["a", "b", "c"].map(|name| {
        let mut child = Command::new(SLABCAST);
        child.args(["worker", "--master", &address, "--name", name, "--threads", "5"]);
        let child = child.stdout(Stdio::null()).stderr(Stdio::null()).spawn();
        Process(child.expect("the worker starts"))
    });
    let client = Client::connect(&address).await.unwrap();
    until("three workers", async || (client.workers().await.unwrap().len() == 3).then_some(()))
        .await;
    let mut cut = false;
    for i in 0..5 {
        let frame = render(&i.to_string(), &["--master", &address, "--schedule", "region"]);
        assert_eq!(frame.pixels_sha256, want, "frame {i}");
        let has = |size| frame.slabs[0].tiles.iter().any(|t| t.size == size);
        cut |= has(64) && has(32);
    }
    assert!(cut, "no frame had tiles of two sizes");
}

/// One tile that holds nearly all of the picture: who has none of it is given a piece as it is drawn.
#[tokio::test]
async fn a_tile_that_is_handed_over_while_it_is_drawn_costs_no_pixel() {
    let dir = tempfile::tempdir().expect("a folder");
    let views = ["--size", "300x280", "--frames", "1", "--thickness", "0.125", "--tile", "256"];
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
    until("two workers", async || (client.workers().await.unwrap().len() == 2).then_some(())).await;
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

/// Workers that call from the master's machine share its processors, so that a path's frames have few, large tiles.
#[tokio::test]
async fn workers_of_the_masters_machine_draw_large_tiles_of_the_same_pixels() {
    let dir = tempfile::tempdir().expect("a folder");
    let want = embedded(dir.path());
    let (_master, address) = master();
    let client = Client::connect(&address).await.expect("the master answers");
    let _workers = ["a", "b"].map(|name| worker(&address, name));
    until("two workers", async || (client.workers().await.unwrap().len() == 2).then_some(())).await;
    let (mut rendering, file) = render(dir.path(), &address, "out", "region");
    assert_eq!(rendering.exit_within(Duration::from_secs(120)), Some(0));
    let frames = stats(&file);
    assert_eq!(hashes(&frames), want);
    // The first frame may be begun before the master knows of the others.
    for frame in &frames[1..] {
        let edges = frame.slabs[0].tiles.iter().map(|t| t.size);
        assert_eq!(edges.min(), Some(256), "frame {}", frame.frame);
    }
}

#[tokio::test]
async fn a_job_waits_for_workers_and_goes_on_with_those_that_come() {
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
    until("two workers", async || (client.workers().await.unwrap().len() == 2).then_some(())).await;
    first.signal("-TERM");
    let mut first = first;
    assert_eq!(first.exit_within(Duration::from_secs(10)), Some(0), "a clean goodbye");
    assert_eq!(rendering.exit_within(Duration::from_secs(120)), Some(0));
    assert_eq!(hashes(&stats(&file)), want);
}

#[tokio::test]
async fn a_master_that_comes_back_gets_its_workers_back() {
    let (first, address) = master();
    let _worker = worker(&address, "patient");
    let client = Client::connect(&address).await.unwrap();
    until("the worker", async || lent(&client, "patient").await).await;
    first.signal("-TERM");
    let mut first = first;
    assert_eq!(first.exit_within(Duration::from_secs(10)), Some(0), "a clean goodbye");
    let again = Command::new(SLABCAST)
        .args(["master", "--volume", VOLUME, "--listen", &address])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let _again = Process(again);
    let client = until("the master", async || Client::connect(&address).await.ok()).await;
    until("the worker again", async || {
        client.workers().await.ok()?.iter().find(|w| w.name == "patient").map(|_| ())
    })
    .await;
}

/// A worker of another version is told so, with both versions, and does not try again.
#[tokio::test]
async fn a_worker_of_another_protocol_is_refused_by_name() {
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
        (hello(PROTOCOL_VERSION, PIXELS_VERSION, &wrong), [&wrong[..], good]),
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
        assert!(answers.message().await.unwrap().is_none(), "and the link ends");
    }
}

/// One whose address may be one end of a tunnel, but whose machine has another name, packs them.
#[tokio::test]
async fn a_worker_of_the_masters_machine_is_told_to_send_results_as_they_are() {
    use slabcast_common::message::{Hello, ToMaster, ToWorker};
    use slabcast_common::{PIXELS_VERSION, SELF_TEST_SHA256};
    use slabcast_proto::{
        cluster_v1::cluster_service_client::ClusterServiceClient as ClusterClient, convert,
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
        let answer = answers.message().await.unwrap().expect("an answer");
        let (welcome, _) = convert::to_worker_from_wire(answer).unwrap();
        assert!(matches!(welcome, ToWorker::Welcome { .. }), "not let in: {welcome:?}");
        let _client = render(dir.path(), &address, "told", "region");
        let told = loop {
            let message = answers.message().await.unwrap().expect("a frame");
            if let (ToWorker::Frame { plain, .. }, _) =
                convert::to_worker_from_wire(message).unwrap()
            {
                break plain;
            }
        };
        assert_eq!(told, here, "{machine}");
    }
}

/// What any gRPC client relies on: health, reflection, quick round trips.
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

/// A peer that says nothing is not held for ever.
#[tokio::test]
async fn a_silent_connection_is_closed() {
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
