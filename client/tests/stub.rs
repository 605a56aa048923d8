//! The client against a master made of a script, over real sockets.

use bytes::Bytes;
use slabcast_client::{Client, ClientError, FrameStream, JobState, ReceivedFrame, Update};
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Quality, Work};
use slabcast_common::stats::{FrameMs, FrameStats};
use slabcast_proto::model::{Job, JobNotice};
use slabcast_proto::render_v1::render_service_server::{RenderService, RenderServiceServer};
use slabcast_proto::status::Reason;
use slabcast_proto::{convert, render_v1 as wire};
use slabcast_scene::path::{Turntable, ViewPath};
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::transfer::TransferChoice;
use std::collections::HashMap;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio_stream::wrappers::TcpListenerStream;
use tokio_stream::{Stream, StreamExt};
use tonic::{Request, Response, Status};

type Chunks = Vec<Result<wire::WatchFramesResponse, Status>>;

/// A master that answers by a script: what each watch, by its first frame, sends, and whether it
/// ends then or stays silent.
#[derive(Clone, Default)]
struct Script {
    watches: Arc<Mutex<HashMap<u64, (Chunks, bool)>>>,
    watched_from: Arc<Mutex<Vec<u64>>>,
    keys: Arc<Mutex<Vec<String>>>,
}

#[tonic::async_trait]
impl RenderService for Script {
    type WatchFramesStream =
        Pin<Box<dyn Stream<Item = Result<wire::WatchFramesResponse, Status>> + Send>>;

    async fn submit_path(
        &self,
        request: Request<wire::SubmitPathRequest>,
    ) -> Result<Response<wire::SubmitPathResponse>, Status> {
        let request = convert::submit_from_wire(request.into_inner())?;
        let mut keys = self.keys.lock().unwrap();
        let number = keys.iter().position(|k| *k == request.client_key).unwrap_or_else(|| {
            keys.push(request.client_key);
            keys.len() - 1
        });
        Ok(Response::new(wire::SubmitPathResponse {
            job_id: format!("job-{number}"),
            framing: None,
        }))
    }

    async fn watch_frames(
        &self,
        request: Request<wire::WatchFramesRequest>,
    ) -> Result<Response<Self::WatchFramesStream>, Status> {
        let from = request.into_inner().from_frame;
        self.watched_from.lock().unwrap().push(from);
        let Some((chunks, ends)) = self.watches.lock().unwrap().get(&from).cloned() else {
            return Err(match from {
                7 => Reason::FrameNotKept.status("gone", &[("first_kept_frame", "9".into())]),
                _ => Reason::JobNotFound.status("job-9 is not known", &[]),
            });
        };
        let chunks = tokio_stream::iter(chunks);
        Ok(Response::new(match ends {
            true => Box::pin(chunks),
            false => Box::pin(chunks.chain(tokio_stream::pending())),
        }))
    }

    async fn get_job(
        &self,
        r: Request<wire::GetJobRequest>,
    ) -> Result<Response<wire::GetJobResponse>, Status> {
        let job = convert::job_to_wire(&job(&r.into_inner().job_id, JobState::Running));
        Ok(Response::new(wire::GetJobResponse { job: Some(job) }))
    }

    async fn list_jobs(
        &self,
        r: Request<wire::ListJobsRequest>,
    ) -> Result<Response<wire::ListJobsResponse>, Status> {
        // 2500 jobs, in pages of at most 1000.
        let r = r.into_inner();
        let page = convert::page_from_wire(r.page_size, &r.page_token)?;
        let end = page.after.unwrap_or(2500);
        let begin = end.saturating_sub(page.size as u64);
        let jobs = (begin..end).rev().map(|i| job(&format!("job-{i}"), JobState::Done));
        let jobs = jobs.map(|j| convert::job_to_wire(&j)).collect();
        let next_page_token = if begin > 0 { convert::page_token(begin) } else { String::new() };
        Ok(Response::new(wire::ListJobsResponse { jobs, next_page_token }))
    }

    async fn cancel_job(
        &self,
        r: Request<wire::CancelJobRequest>,
    ) -> Result<Response<wire::CancelJobResponse>, Status> {
        let job = convert::job_to_wire(&job(&r.into_inner().job_id, JobState::Cancelled));
        Ok(Response::new(wire::CancelJobResponse { job: Some(job) }))
    }

    async fn describe_volume(
        &self,
        _: Request<wire::DescribeVolumeRequest>,
    ) -> Result<Response<wire::DescribeVolumeResponse>, Status> {
        Ok(Response::new(wire::DescribeVolumeResponse::default()))
    }

    async fn list_volumes(
        &self,
        _: Request<wire::ListVolumesRequest>,
    ) -> Result<Response<wire::ListVolumesResponse>, Status> {
        Ok(Response::new(wire::ListVolumesResponse::default()))
    }

    async fn put_volume(
        &self,
        _: Request<wire::PutVolumeRequest>,
    ) -> Result<Response<wire::PutVolumeResponse>, Status> {
        Err(Reason::UploadsRefused.status("this master takes no volumes", &[]))
    }

    async fn remove_volume(
        &self,
        _: Request<wire::RemoveVolumeRequest>,
    ) -> Result<Response<wire::RemoveVolumeResponse>, Status> {
        Err(Reason::VolumeNotFound.status("no volume `a` here", &[]))
    }

    async fn list_workers(
        &self,
        _: Request<wire::ListWorkersRequest>,
    ) -> Result<Response<wire::ListWorkersResponse>, Status> {
        let delay = Duration::from_millis(1500);
        Err(Reason::TooManyWatchers.retry("64 watchers\nare enough", delay))
    }
}

fn job(id: &str, state: JobState) -> Job {
    Job {
        job_id: id.into(),
        client_key: "k".into(),
        state,
        message: String::new(),
        frames_done: 0,
        frames_failed: 0,
        frames_total: 1,
        size: [4, 4],
        format: PixelFormat::Rgb8,
        submitted_unix_ms: 1,
        finished_unix_ms: 0,
        volume: None,
    }
}

fn notice(
    state: JobState,
    frames_total: u64,
    message: &str,
) -> Result<wire::WatchFramesResponse, Status> {
    let message = message.into();
    Ok(convert::notice_to_wire(&JobNotice {
        state,
        frames_done: 0,
        frames_failed: 0,
        frames_total,
        render_threads: 1,
        message,
    }))
}

fn stats(frame: u64) -> FrameStats {
    FrameStats {
        level: None,
        v: 1,
        frame,
        schedule: slabcast_common::quality::Schedule::Region,
        view_sha256: String::new(),
        pixels_sha256: String::new(),
        pixels_version: 1,
        ms: FrameMs { total: 0.1 + 0.2, ..FrameMs::default() },
        workers: vec![],
        voxels: Default::default(),
        bricks: Default::default(),
        result_bytes: None,
        slabs: vec![],
        quality: Quality::before(),
        left_out: vec![],
        error: Default::default(),
        retries: 0,
        handed_over: 0,
        dropped_results: 0,
        poisoned: vec![],
        critical_path: None,
        rehearsed: false,
    }
}

fn pixels(frame: u64, size: [u32; 2]) -> Bytes {
    let n = size[0] as usize * size[1] as usize * 4;
    (0..n).map(|i| (i as u64 * 31 + frame) as u8).collect::<Vec<_>>().into()
}

fn chunks(frame: u64, size: [u32; 2], trace: &str) -> Chunks {
    let stats = stats(frame);
    let bytes = pixels(frame, size);
    let chunks = convert::frame_to_wire(frame, size, PixelFormat::Rgba8, &bytes, &stats, trace);
    chunks.into_iter().map(Ok).collect()
}

async fn serve(script: &Script) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let server = tonic::transport::Server::builder()
        .add_service(RenderServiceServer::new(script.clone()))
        .serve_with_incoming(TcpListenerStream::new(listener));
    tokio::spawn(server);
    address
}

/// Forwards to a master until it is cut; then its connections break, and new ones are taken or
/// not.
struct Wire {
    address: SocketAddr,
    cut: watch::Sender<u32>,
    shut: watch::Sender<bool>,
}

async fn wire_to(master: SocketAddr) -> Wire {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let (cut, cuts) = watch::channel(0);
    let (shut, mut shuts) = watch::channel(false);
    tokio::spawn(async move {
        loop {
            let (mut near, _) = tokio::select! {
                accepted = listener.accept() => accepted.unwrap(),
                _ = shuts.wait_for(|shut| *shut) => return,
            };
            let mut cuts = cuts.clone();
            cuts.mark_unchanged();
            tokio::spawn(async move {
                let mut far = TcpStream::connect(master).await.unwrap();
                tokio::select! {
                    _ = tokio::io::copy_bidirectional(&mut near, &mut far) => {}
                    _ = cuts.changed() => {}
                }
            });
        }
    });
    Wire { address, cut, shut }
}

async fn frame(frames: &mut FrameStream) -> ReceivedFrame {
    loop {
        match frames.next().await.unwrap() {
            Some(Update::Frame(frame)) => return *frame,
            Some(Update::Notice(_) | Update::FrameFailed { .. }) => {}
            None => panic!("the job ended"),
        }
    }
}

fn request(key: &str) -> PathRequest {
    PathRequest {
        client_key: key.into(),
        volume: VolumeChoice::Default,
        level: LevelChoice::default(),
        path: ViewPath::from_turntable([64, 64], Turntable::default()),
        transfer: TransferChoice::Name("auto".into()),
        quality: Quality::before(),
        work: Work::default(),
        format: PixelFormat::Rgba8,
        background: Background::Transparent,
        want_trace: false,
        want_hash: true,
    }
}

#[tokio::test]
async fn frame_in_many_chunks_is_assembled_with_its_statistics() {
    let script = Script::default();
    let size = [1000, 900];
    let mut all = vec![notice(JobState::Running, 2, "")];
    all.extend(chunks(0, size, "[{\"name\":\"render\"}]"));
    assert_eq!(all.len(), 1 + 14, "3.6 MB take 14 messages of 256 KiB");
    all.insert(3, notice(JobState::WaitingForWorkers, 2, "waiting for workers"));
    all.extend(chunks(1, [3, 1], ""));
    all.push(notice(JobState::Done, 2, ""));
    script.watches.lock().unwrap().insert(0, (all, true));
    let client = Client::connect(&serve(&script).await.to_string()).await.unwrap();
    let mut frames = client.watch("job-0", 0).await.unwrap();

    let mut notices = Vec::new();
    let first = loop {
        match frames.next().await.unwrap().unwrap() {
            Update::Notice(notice) => notices.push(notice.state),
            Update::Frame(frame) => break frame,
            Update::FrameFailed { .. } => panic!("no frame failed"),
        }
    };
    assert_eq!(notices, [JobState::Running, JobState::WaitingForWorkers], "also within a frame");
    assert_eq!((first.number, first.size, first.format), (0, size, PixelFormat::Rgba8));
    assert!(first.bytes == pixels(0, size));
    assert_eq!(first.stats, stats(0));
    assert_eq!(serde_json::from_str::<FrameStats>(&first.stats_json).unwrap(), stats(0));
    assert_eq!(first.trace_json.as_deref(), Some("[{\"name\":\"render\"}]"));
    let second = frame(&mut frames).await;
    assert_eq!((second.number, second.trace_json), (1, None));
    assert!(
        matches!(frames.next().await, Ok(Some(Update::Notice(n))) if n.state == JobState::Done)
    );
    assert_eq!(frames.next().await, Ok(None));
    assert_eq!(frames.next().await, Ok(None), "and so it stays");
}

#[tokio::test]
async fn follow_reconnects_and_continues_at_the_first_incomplete_frame() {
    let script = Script::default();
    let size = [1000, 900];
    let mut broken = vec![notice(JobState::Running, 3, "")];
    broken.extend(chunks(0, size, ""));
    broken.extend(chunks(1, size, "").into_iter().take(2));
    broken.push(notice(JobState::Running, 3, "half of frame 1 is there"));
    let mut rest = vec![notice(JobState::Done, 3, "")];
    rest.extend(chunks(1, size, "").into_iter().chain(chunks(2, size, "")));
    let mut watches = HashMap::from([(0, (broken, false)), (1, (rest, true))]);
    std::mem::swap(&mut *script.watches.lock().unwrap(), &mut watches);
    let wire = wire_to(serve(&script).await).await;
    let client = Client::connect(&format!("http://{}/", wire.address)).await.unwrap();

    let mut frames = client.follow("job-0", 0, Duration::from_secs(30)).await.unwrap();
    assert_eq!(frame(&mut frames).await.number, 0);
    let half = frames.next().await.unwrap();
    assert!(matches!(half, Some(Update::Notice(n)) if n.message.starts_with("half")));
    wire.cut.send_modify(|n| *n += 1);
    for number in 1..3 {
        let whole = frame(&mut frames).await;
        assert_eq!(whole.number, number);
        assert!(whole.bytes == pixels(number, size), "frame {number} has its own bytes only");
    }
    assert_eq!(frames.next().await, Ok(None), "a job that was done when it was watched ends, too");
    assert_eq!(*script.watched_from.lock().unwrap(), [0, 1]);
    // Calls that are not streams find the connection again, too.
    wire.cut.send_modify(|n| *n += 1);
    assert_eq!(client.job("job-0").await.unwrap().state, JobState::Running);
}

#[tokio::test]
async fn watch_does_not_reconnect_and_names_the_master() {
    let script = Script::default();
    let broken = vec![notice(JobState::Running, 3, "")];
    script.watches.lock().unwrap().insert(0, (broken, false));
    let wire = wire_to(serve(&script).await).await;
    let client = Client::connect(&wire.address.to_string()).await.unwrap();
    let mut frames = client.watch("job-0", 0).await.unwrap();
    assert!(matches!(frames.next().await, Ok(Some(Update::Notice(_)))));
    wire.cut.send_modify(|n| *n += 1);
    let e = frames.next().await.unwrap_err();
    assert!(matches!(e, ClientError::Lost { .. }), "{e}");
    assert!(e.to_string().contains(&wire.address.to_string()), "{e}");
}

/// A stream within a connection that lives: what a proxy does that loses one stream of many.
#[tokio::test]
async fn follow_begins_a_watch_anew_that_is_silent_for_half_a_minute() {
    let script = Script::default();
    let mut silent = vec![notice(JobState::Running, 1, "")];
    silent.extend(chunks(0, [1000, 900], "").into_iter().take(2));
    script.watches.lock().unwrap().insert(0, (silent, false));
    let client = Client::connect(&serve(&script).await.to_string()).await.unwrap();
    let mut frames = client.follow("job-0", 0, Duration::from_secs(60)).await.unwrap();
    assert!(matches!(frames.next().await, Ok(Some(Update::Notice(_)))));
    let early = tokio::time::timeout(Duration::from_millis(200), frames.next()).await;
    assert!(early.is_err(), "the frame is not whole, and its watch not late");
    let mut whole = vec![notice(JobState::Done, 1, "")];
    whole.extend(chunks(0, [1000, 900], ""));
    script.watches.lock().unwrap().insert(0, (whole, true));
    tokio::time::pause();
    tokio::time::advance(Duration::from_secs(30)).await;
    tokio::time::resume();
    let whole = frame(&mut frames).await;
    assert!(whole.bytes == pixels(0, [1000, 900]));
    assert_eq!(*script.watched_from.lock().unwrap(), [0, 0]);
}

#[tokio::test]
async fn follow_gives_up_after_its_patience() {
    let script = Script::default();
    let mut broken = vec![notice(JobState::Running, 3, "")];
    broken.extend(chunks(0, [3, 3], ""));
    script.watches.lock().unwrap().insert(0, (broken, false));
    let wire = wire_to(serve(&script).await).await;
    let client = Client::connect(&wire.address.to_string()).await.unwrap();
    let mut frames = client.follow("job-0", 0, Duration::from_millis(500)).await.unwrap();
    assert_eq!(frame(&mut frames).await.number, 0);
    wire.shut.send_replace(true);
    wire.shut.closed().await;
    wire.cut.send_modify(|n| *n += 1);
    let began = std::time::Instant::now();
    let e = frames.next().await.unwrap_err();
    assert!(matches!(e, ClientError::GaveUp { next_frame: 1, .. }), "{e}");
    assert!(e.to_string().contains("from frame 1"), "{e}");
    assert!(began.elapsed() < Duration::from_secs(20));
}

#[tokio::test]
async fn follow_reconnects_when_a_stream_ends_early() {
    let script = Script::default();
    let mut short = vec![notice(JobState::Running, 2, "")];
    short.extend(chunks(0, [3, 3], ""));
    let mut busy = vec![notice(JobState::Running, 2, "")];
    busy.push(Err(Status::unavailable("the master restarts")));
    script.watches.lock().unwrap().insert(0, (short, true));
    script.watches.lock().unwrap().insert(1, (busy, true));
    let client = Client::connect(&serve(&script).await.to_string()).await.unwrap();
    let mut frames = client.follow("job-0", 0, Duration::from_secs(30)).await.unwrap();
    assert_eq!(frame(&mut frames).await.number, 0);
    assert!(matches!(frames.next().await, Ok(Some(Update::Notice(_)))));
    let mut rest = chunks(1, [3, 3], "");
    rest.push(notice(JobState::Done, 2, ""));
    script.watches.lock().unwrap().insert(1, (rest, true));
    assert_eq!(frame(&mut frames).await.number, 1);
    let mut watched = script.watched_from.lock().unwrap().clone();
    watched.dedup();
    assert_eq!(watched, [0, 1]);
}

#[tokio::test]
async fn failed_or_cancelled_job_ends_its_stream_with_an_error() {
    let script = Script::default();
    let mut failed = vec![notice(JobState::Running, 2, "")];
    failed.extend(chunks(0, [3, 3], ""));
    failed.push(notice(JobState::Failed, 2, "the volume changed:\nopen it again"));
    let cancelled = vec![notice(JobState::Cancelled, 2, "")];
    let mut watches = HashMap::from([(0, (failed, true)), (1, (cancelled, true))]);
    std::mem::swap(&mut *script.watches.lock().unwrap(), &mut watches);
    let client = Client::connect(&serve(&script).await.to_string()).await.unwrap();

    let mut frames = client.follow("job-0", 0, Duration::from_secs(30)).await.unwrap();
    let end = loop {
        match frames.next().await {
            Ok(Some(_)) => {}
            end => break end,
        }
    };
    let e = end.unwrap_err();
    assert_eq!(e.to_string(), "job-0 failed: the volume changed: open it again");
    let mut frames = client.watch("job-0", 1).await.unwrap();
    assert!(matches!(frames.next().await, Ok(Some(Update::Notice(_)))));
    assert!(matches!(frames.next().await, Err(ClientError::JobCancelled { .. })));
}

#[tokio::test]
async fn frame_that_failed_is_told_in_its_place_and_the_others_come() {
    let script = Script::default();
    let mut all = vec![notice(JobState::Running, 3, "")];
    all.extend(chunks(0, [3, 3], ""));
    all.push(Ok(convert::frame_failed_to_wire(1, "a refused it:\nout of memory")));
    all.extend(chunks(2, [3, 3], ""));
    all.push(notice(JobState::Failed, 3, "1 of 3 frames failed"));
    *script.watches.lock().unwrap() = HashMap::from([(0, (all, true))]);
    let client = Client::connect(&serve(&script).await.to_string()).await.unwrap();
    let mut frames = client.watch("job-0", 0).await.unwrap();
    let mut told = Vec::new();
    let end = loop {
        match frames.next().await {
            Ok(Some(Update::Frame(frame))) => told.push((frame.number, String::new())),
            Ok(Some(Update::FrameFailed { number, reason })) => told.push((number, reason)),
            Ok(Some(Update::Notice(_))) => {}
            end => break end,
        }
    };
    let reason = "a refused it: out of memory";
    assert_eq!(told, [(0, String::new()), (1, reason.into()), (2, String::new())]);
    assert!(matches!(end, Err(ClientError::JobFailed { .. })), "{end:?}");
    assert_eq!(frames.next_frame(), 3);
}

#[tokio::test]
async fn status_details_become_typed_errors_with_a_remedy() {
    let client = Client::connect(&serve(&Script::default()).await.to_string()).await.unwrap();
    let e = client.watch("job-9", 0).await.unwrap_err();
    assert!(matches!(e, ClientError::NotFound { .. }), "{e}");
    let e = client.follow("job-9", 0, Duration::from_secs(60)).await.unwrap_err();
    assert!(matches!(e, ClientError::NotFound { .. }), "no patience with what will not pass: {e}");
    let bad = PathRequest {
        path: ViewPath::from_turntable([0, 64], Turntable::default()),
        ..request("a")
    };
    let e = client.submit(&bad).await.unwrap_err();
    assert_eq!(e.to_string(), "refused: path.width: 0 pixels; give 1 to 8192");
    let (field, problem) = ("path.width".into(), "0 pixels; give 1 to 8192".into());
    assert_eq!(e, ClientError::InvalidField { field, problem });
    let path = ViewPath::from_turntable([64, 64], Turntable { frames: 0, ..Turntable::default() });
    let e = client.submit(&PathRequest { path, ..request("a") }).await.unwrap_err();
    assert!(
        matches!(&e, ClientError::InvalidField { field, .. } if field == "path.turntable.frames"),
        "refused by this side: {e}"
    );
    let e = client.watch("job-0", 7).await.unwrap_err();
    assert!(matches!(e, ClientError::FrameNotKept { first_kept_frame: Some(9), .. }), "{e}");
    let e = client.workers().await.unwrap_err();
    assert_eq!(e.retry_after(), Some(Duration::from_millis(1500)));
    assert_eq!(
        e.to_string(),
        "64 watchers are enough (ResourceExhausted): the master is full; try later, or cancel a job"
    );
    let e = client.volume(&VolumeChoice::Default).await.unwrap_err();
    assert!(matches!(e, ClientError::Protocol { .. }), "{e}");
}

#[tokio::test]
async fn request_too_long_is_refused_before_it_is_sent() {
    let client = Client::connect(&serve(&Script::default()).await.to_string()).await.unwrap();
    let view = slabcast_scene::path::PathView {
        eye: [1.0; 3],
        target: [0.0; 3],
        up: [0.0, 0.0, 1.0],
        projection: Default::default(),
        height: None,
        fov: None,
    };
    let views = vec![view; 100_000];
    let path = ViewPath::from_views([64, 64], views);
    let e = client.submit(&PathRequest { path, ..request("a") }).await.unwrap_err();
    assert!(matches!(e, ClientError::TooLong { .. }), "{e}");
}

#[tokio::test]
async fn same_client_key_gives_the_same_job_and_lists_are_paged() {
    let script = Script::default();
    let client = Client::connect(&serve(&script).await.to_string()).await.unwrap();
    let submitted = tokio::spawn({
        let client = client.clone();
        async move { client.submit(&request("a")).await }
    });
    assert_eq!(submitted.await.unwrap().unwrap(), "job-0");
    assert_eq!(client.submit(&request("b")).await.unwrap(), "job-1");
    assert_eq!(client.submit(&request("a")).await.unwrap(), "job-0");
    let jobs = client.jobs(2345).await.unwrap();
    assert_eq!((jobs.len(), jobs[2344].job_id.as_str()), (2345, "job-155"), "over three pages");
    assert_eq!(client.jobs(9999).await.unwrap().len(), 2500);
    assert_eq!(client.cancel("job-1").await.unwrap().state, JobState::Cancelled);
}

#[tokio::test]
async fn chunks_that_do_not_fit_together_are_refused() {
    let [a, b] = [0, 1].map(|f| chunks(f, [1000, 900], ""));
    let cases: [(&str, Chunks, &str); 4] = [
        ("a gap", vec![a[0].clone(), a[2].clone()], "goes on at byte"),
        ("another frame", vec![b[0].clone()], "frame 1 came instead of 0"),
        ("mixed frames", vec![a[0].clone(), b[1].clone()], "frame 1 came instead of 0"),
        ("too short", vec![Ok(last_at_once(a[0].clone().unwrap()))], "bytes instead of 3600000"),
    ];
    for (name, chunks, problem) in cases {
        let script = Script::default();
        script.watches.lock().unwrap().insert(0, (chunks, true));
        let client = Client::connect(&serve(&script).await.to_string()).await.unwrap();
        let mut frames = client.follow("job-0", 0, Duration::from_secs(30)).await.unwrap();
        let e = frames.next().await.unwrap_err().to_string();
        assert!(e.contains(problem), "{name}: {e}");
    }
}

fn last_at_once(mut chunk: wire::WatchFramesResponse) -> wire::WatchFramesResponse {
    if let Some(wire::watch_frames_response::Message::Chunk(p)) = &mut chunk.message {
        p.last = true;
    }
    chunk
}

#[tokio::test]
async fn connection_refused_names_the_address() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    drop(listener);
    let e = Client::connect(&address).await.unwrap_err().to_string();
    assert!(e.starts_with(&format!("no master at {address} (")), "{e}");
    assert!(e.contains("refused") && e.contains("slabcast master"), "{e}");
}

/// A web server, say: it takes the connection and speaks something else.
#[tokio::test]
async fn server_that_is_no_master_is_an_error_and_no_panic() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    tokio::spawn(async move {
        while let Ok((mut stream, _)) = listener.accept().await {
            let _ = stream.read(&mut [0; 100]).await;
            let _ = stream.write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n").await;
        }
    });
    let e = Client::connect(&address).await.unwrap_err();
    assert!(matches!(e, ClientError::NotAMaster { .. }), "{e}");
    let wanted = format!("no slabcast master at {address} (it speaks no gRPC");
    assert!(e.to_string().starts_with(&wanted), "{e}");
}

#[tokio::test]
async fn port_that_says_nothing_is_no_master_after_5_s() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let began = std::time::Instant::now();
    let e = Client::connect(&address).await.unwrap_err();
    assert!(e.to_string().contains("it says nothing for 5 s"), "{e}");
    assert!(began.elapsed() < Duration::from_secs(20));
}

#[tokio::test]
async fn other_grpc_service_is_no_master() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let routes = tonic::service::Routes::default().prepare();
    let server = tonic::transport::Server::builder()
        .add_routes(routes)
        .serve_with_incoming(TcpListenerStream::new(listener));
    tokio::spawn(server);
    let e = Client::connect(&address).await.unwrap_err();
    assert!(matches!(e, ClientError::NotAMaster { .. }), "{e}");
}
