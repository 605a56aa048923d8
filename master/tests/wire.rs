//! RenderService and ClusterService over a socket, as a client in any language meets them.

use slabcast_common::message::{Hello, ToMaster, ToWorker};
use slabcast_common::protocol::{PROTOCOL_VERSIONS, ProtocolVersions};
use slabcast_common::volume::Volume;
use slabcast_common::{PIXELS_VERSION, SELF_TEST_SHA256};
use slabcast_master::{Master, MasterConfig, PeerLimits, serve};
use slabcast_proto::cluster_v1::cluster_service_client::ClusterServiceClient;
use slabcast_proto::cluster_v1::{ControlRequest, control_response};
use slabcast_proto::convert;
use slabcast_proto::render_v1::render_service_client::RenderServiceClient;
use slabcast_proto::render_v1::{
    self as wire, Fit, GetJobRequest, JobState, ListJobsRequest, ListWorkersRequest,
    SubmitPathRequest, Turntable, ViewPath, WatchFramesRequest, view_path::Cameras,
};
use slabcast_proto::sealed;
use slabcast_proto::status::{Details, Reason};
use slabcast_scene::path::Orientation;
use std::net::SocketAddr;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio_stream::StreamExt;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status};

/// A master without workers that serves a socket while it lives.
struct Served {
    _master: Master,
    stop: watch::Sender<bool>,
    channel: Channel,
    address: SocketAddr,
}

impl Drop for Served {
    fn drop(&mut self) {
        self.stop.send_replace(true);
    }
}

async fn served() -> Served {
    served_with(PeerLimits::default()).await
}

async fn served_with(peer_limits: PeerLimits) -> Served {
    let volume = Volume::from_fn_u8("cube", [16; 3], |i, j, k| (i + j + k) as u8);
    let orientation = Orientation::new(None, None).expect("the defaults");
    let mut config = MasterConfig::new(volume, orientation);
    config.peer_limits = peer_limits;
    let master = Master::start(config).expect("threads");
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let (stop, stopped) = watch::channel(false);
    tokio::spawn(serve::serve(master.handle(), listener, stopped));
    let endpoint = Endpoint::from_shared(format!("http://{address}")).unwrap();
    let channel = endpoint.connect().await.unwrap();
    Served { _master: master, stop, channel, address }
}

fn request(key: &str, turntable: Turntable) -> SubmitPathRequest {
    SubmitPathRequest {
        client_key: key.into(),
        path: Some(ViewPath {
            width: 32,
            height: 32,
            cameras: Some(Cameras::Turntable(turntable)),
            ..ViewPath::default()
        }),
        ..SubmitPathRequest::default()
    }
}

fn assert_status(status: &Status, code: Code, reason: Reason) -> Details {
    let details = Details::from_status(status);
    assert_eq!((status.code(), details.reason), (code, Some(reason)), "{status:?}");
    details
}

#[tokio::test]
async fn error_details_name_reason_field_and_metadata() {
    let served = served().await;
    let mut render = RenderServiceClient::new(served.channel.clone());
    let ask = GetJobRequest { job_id: "job-7".into() };
    let status = render.get_job(ask).await.unwrap_err();
    let details = assert_status(&status, Code::NotFound, Reason::JobNotFound);
    assert_eq!(details.metadata["job_id"], "job-7");

    // Refused at the door, and by a check behind it: both name the field by its path.
    let frames = request("a", Turntable { frames: Some(0), ..Turntable::default() });
    let status = render.submit_path(frames).await.unwrap_err();
    let details = assert_status(&status, Code::InvalidArgument, Reason::InvalidField);
    assert_eq!(details.field.unwrap().0, "path.turntable.frames");
    let elevation = request("a", Turntable { elevation: Some(91.0), ..Turntable::default() });
    let status = render.submit_path(elevation).await.unwrap_err();
    let details = assert_status(&status, Code::InvalidArgument, Reason::InvalidField);
    assert_eq!(details.field.unwrap().0, "path.turntable.elevation");

    let good = request("a", Turntable { frames: Some(3), ..Turntable::default() });
    let job_id = render.submit_path(good.clone()).await.unwrap().into_inner().job_id;
    let again = render.submit_path(good).await.unwrap().into_inner().job_id;
    assert_eq!(again, job_id, "the same key and request give the same job");
    let other = request("a", Turntable { frames: Some(4), ..Turntable::default() });
    let status = render.submit_path(other).await.unwrap_err();
    assert_status(&status, Code::AlreadyExists, Reason::ClientKeyTaken);

    let ask = WatchFramesRequest { job_id, from_frame: 4 };
    let status = render.watch_frames(ask).await.unwrap_err();
    let details = assert_status(&status, Code::OutOfRange, Reason::FrameBeyondEnd);
    assert_eq!(details.number("frames_total"), Some(3));
}

/// The numbers that a master found make the same picture when they are given.
#[tokio::test]
async fn framing_is_told_once_it_is_asked_for() {
    let served = served().await;
    let mut render = RenderServiceClient::new(served.channel.clone());
    let mut ask = request("a", Turntable { frames: Some(1), ..Turntable::default() });
    let plain = render.submit_path(ask.clone()).await.unwrap().into_inner();
    assert_eq!(plain.framing, None);
    ask.client_key = "b".into();
    ask.path.as_mut().unwrap().fit = Fit::Visible.into();
    let told = render.submit_path(ask.clone()).await.unwrap().into_inner();
    let framing = told.framing.expect("it was asked for");
    assert!((1.0..40.0).contains(&framing.height) && framing.target.is_some(), "{framing:?}");
    // A repeated key is a repeated request and gets the first answer.
    let again = render.submit_path(ask.clone()).await.unwrap().into_inner();
    assert_eq!((again.job_id, again.framing), (told.job_id, Some(framing)));
    ask.client_key = "c".into();
    let Some(Cameras::Turntable(t)) = &mut ask.path.as_mut().unwrap().cameras else { panic!() };
    (t.target, t.height) = (framing.target, Some(framing.height));
    assert_eq!(render.submit_path(ask).await.unwrap().into_inner().framing, None);
}

#[tokio::test]
async fn jobs_are_listed_in_pages_newest_first() {
    let served = served().await;
    let mut render = RenderServiceClient::new(served.channel.clone());
    let mut submitted = Vec::new();
    for key in ["a", "b", "c", "d", "e"] {
        let request = request(key, Turntable::default());
        submitted.push(render.submit_path(request).await.unwrap().into_inner().job_id);
    }
    let (mut listed, mut pages, mut page_token) = (Vec::new(), 0, String::new());
    loop {
        let ask = ListJobsRequest { page_size: 2, page_token };
        let page = render.list_jobs(ask).await.unwrap().into_inner();
        assert!(page.jobs.len() <= 2);
        for job in page.jobs {
            let waiting = [JobState::Queued, JobState::Preparing, JobState::WaitingForWorkers];
            assert!(waiting.contains(&job.state()), "{job:?}");
            assert!(job.submit_time.is_some() && job.finish_time.is_none());
            listed.push(job.job_id);
        }
        pages += 1;
        page_token = page.next_page_token;
        if page_token.is_empty() {
            break;
        }
    }
    submitted.reverse();
    assert_eq!((listed, pages), (submitted, 3));

    let ask = ListJobsRequest { page_size: 2, page_token: "x".into() };
    let status = render.list_jobs(ask).await.unwrap_err();
    let details = assert_status(&status, Code::InvalidArgument, Reason::InvalidField);
    assert_eq!(details.field.unwrap().0, "page_token");
    let workers = render.list_workers(ListWorkersRequest::default()).await.unwrap().into_inner();
    assert!(workers.workers.is_empty() && workers.next_page_token.is_empty());
}

fn hello(protocol_versions: ProtocolVersions) -> Hello {
    Hello {
        protocol_versions,
        pixels_version: PIXELS_VERSION,
        name: "stub".into(),
        threads: 1,
        memory_budget_bytes: 1 << 20,
        simd: "plain".into(),
        self_test_sha256: SELF_TEST_SHA256.into(),
        held: vec![],
        rehearses: false,
        machine: String::new(),
    }
}

/// The master's first answer to a hello, and whether the stream ends with it.
async fn answer(served: &Served, hello: Hello) -> (ToWorker, bool) {
    let first = convert::from_worker_to_wire(&ToMaster::Hello(hello));
    let stream = tokio_stream::once(first).chain(tokio_stream::pending());
    let mut cluster = ClusterServiceClient::new(served.channel.clone());
    let mut answers = cluster.control(stream).await.unwrap().into_inner();
    let answer = answers.message().await.unwrap().unwrap();
    // A refusal alone comes without a seal.
    let answer = match &answer.message {
        Some(control_response::Message::Sealed(_)) => {
            let (_, opener) = sealed::ends(tokio_stream::empty::<ControlRequest>());
            opener.open(answer).expect("it is whole").expect("it is the first")
        }
        _ => answer,
    };
    let (answer, _) = convert::to_worker_from_wire(answer).unwrap();
    let refused = matches!(answer, ToWorker::Refused { .. });
    (answer, refused && answers.message().await.unwrap().is_none())
}

#[tokio::test]
async fn protocol_version_is_the_newest_that_both_speak_or_the_refusal_names_both() {
    let served = served().await;
    let ProtocolVersions { oldest, newest } = PROTOCOL_VERSIONS;
    // Rolling upgrade: a worker of the next version that still speaks the master's.
    for worker in [PROTOCOL_VERSIONS, ProtocolVersions { oldest: newest, newest: newest + 1 }] {
        let (welcome, _) = answer(&served, hello(worker)).await;
        let ToWorker::Welcome { protocol_version, .. } = welcome else { panic!("{welcome:?}") };
        assert_eq!(protocol_version, newest);
    }
    for (first, last) in [(oldest - 1, oldest - 1), (newest + 1, newest + 2)] {
        let worker = ProtocolVersions { oldest: first, newest: last };
        let (refused, ends) = answer(&served, hello(worker)).await;
        let ToWorker::Refused { reason } = refused else { panic!("{refused:?}") };
        assert!(ends, "the master ends the link");
        let (theirs, ours) =
            (format!("protocol {worker},"), format!("master {PROTOCOL_VERSIONS};"));
        assert!(reason.contains(&theirs) && reason.contains(&ours), "{reason}");
    }
}

#[tokio::test]
async fn reflection_v1_and_v1alpha_list_both_services() {
    macro_rules! services {
        ($pb:ident, $channel:expr) => {{
            use tonic_reflection::pb::$pb::server_reflection_client::ServerReflectionClient;
            use tonic_reflection::pb::$pb::{
                ServerReflectionRequest, server_reflection_request::MessageRequest,
                server_reflection_response::MessageResponse,
            };
            let message_request = Some(MessageRequest::ListServices(String::new()));
            let ask = ServerReflectionRequest { host: String::new(), message_request };
            let mut client = ServerReflectionClient::new($channel);
            let answers = client.server_reflection_info(tokio_stream::once(ask)).await;
            let answer = answers.unwrap().into_inner().message().await.unwrap().unwrap();
            match answer.message_response {
                Some(MessageResponse::ListServicesResponse(list)) => {
                    list.service.into_iter().map(|s| s.name).collect::<Vec<_>>()
                }
                other => panic!("no list of services: {other:?}"),
            }
        }};
    }
    let served = served().await;
    for names in [services!(v1, served.channel.clone()), services!(v1alpha, served.channel.clone())]
    {
        for service in ["slabcast.render.v1.RenderService", "slabcast.cluster.v1.ClusterService"] {
            assert!(names.iter().any(|name| name == service), "{service} in {names:?}");
        }
    }
}

#[tokio::test]
async fn address_that_has_its_share_of_jobs_and_watchers_is_told_the_figures() {
    let limits = PeerLimits { jobs: 2, watchers: 1, ..PeerLimits::default() };
    let served = served_with(limits).await;
    let mut render = RenderServiceClient::new(served.channel.clone());
    let mut jobs = Vec::new();
    for key in ["a", "b"] {
        let job = render.submit_path(request(key, Turntable::default())).await.unwrap();
        jobs.push(job.into_inner().job_id);
    }
    let status = render.submit_path(request("c", Turntable::default())).await.unwrap_err();
    assert_status(&status, Code::ResourceExhausted, Reason::TooManyJobs);
    assert!(status.message().starts_with("2 jobs from your address"), "{status:?}");
    let again = render.submit_path(request("a", Turntable::default())).await.unwrap();
    assert_eq!(again.into_inner().job_id, jobs[0], "the same request takes no new place");

    let ask = |job: &str| WatchFramesRequest { job_id: job.into(), ..Default::default() };
    let watching = render.watch_frames(ask(&jobs[0])).await.unwrap();
    let status = render.watch_frames(ask(&jobs[1])).await.unwrap_err();
    assert_status(&status, Code::ResourceExhausted, Reason::TooManyWatchers);
    assert!(status.message().starts_with("1 watchers from your address"), "{status:?}");
    drop(watching);
    while render.watch_frames(ask(&jobs[1])).await.is_err() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Whether the master closes a connection that sends these bytes and no more, some a time.
async fn is_closed(address: SocketAddr, pieces: &[&[u8]]) -> bool {
    let mut peer = TcpStream::connect(address).await.unwrap();
    for piece in pieces {
        if peer.write_all(piece).await.is_err() {
            return true;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let mut rest = Vec::new();
    // An error is an end, too: bytes of ours were not read.
    tokio::time::timeout(Duration::from_secs(20), peer.read_to_end(&mut rest)).await.is_ok()
}

#[tokio::test]
async fn connection_without_a_whole_request_is_closed_and_one_of_use_stays() {
    let patience = Duration::from_millis(300);
    let served = served_with(PeerLimits { patience, ..PeerLimits::default() }).await;
    let mut render = RenderServiceClient::new(served.channel.clone());
    let job = render.submit_path(request("a", Turntable::default())).await.unwrap().into_inner();
    let ask = WatchFramesRequest { job_id: job.job_id, ..Default::default() };
    let mut watching = render.watch_frames(ask).await.unwrap().into_inner();
    assert!(watching.message().await.unwrap().is_some(), "a notice");
    const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";
    // HEADERS of 1000 bytes, of which a byte comes at a time.
    let headers: &[u8] = b"\0\x03\xe8\x01\x04\0\0\0\x01";
    let trickle: Vec<&[u8]> = [PREFACE, headers].into_iter().chain([&b"\x82"[..]; 60]).collect();
    let (idle, slow) =
        tokio::join!(is_closed(served.address, &[PREFACE]), is_closed(served.address, &trickle));
    assert!(idle && slow);

    // A request whose body never ends.
    use tonic_reflection::pb::v1::{
        ServerReflectionRequest, server_reflection_client::ServerReflectionClient,
    };
    let endless = tokio_stream::pending::<ServerReflectionRequest>();
    let mut client = ServerReflectionClient::new(served.channel.clone());
    let mut answers = client.server_reflection_info(endless).await.unwrap().into_inner();
    let ended = tokio::time::timeout(Duration::from_secs(20), answers.message()).await;
    assert!(!matches!(ended.expect("it ends"), Ok(Some(_))));

    let next = tokio::time::timeout(patience, watching.message()).await;
    assert!(!matches!(next, Ok(Err(_) | Ok(None))), "the watcher has its connection: {next:?}");
    render.list_jobs(ListJobsRequest::default()).await.unwrap();
}

#[tokio::test]
async fn message_that_can_not_be_decoded_is_the_callers_mistake() {
    let served = served().await;
    let mut grpc = tonic::client::Grpc::new(served.channel.clone());
    grpc.ready().await.unwrap();
    let codec = tonic_prost::ProstCodec::<ListJobsRequest, wire::GetJobResponse>::default();
    let path = "/slabcast.render.v1.RenderService/GetJob".parse().unwrap();
    // A number where GetJob has text.
    let ask = ListJobsRequest { page_size: 5, ..Default::default() };
    let status = grpc.unary(tonic::Request::new(ask), path, codec).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument, "{status:?}");
}

/// An honest client that drops 64 calls at a time keeps its connection, and what else is on it.
#[tokio::test]
async fn cancelled_calls_cost_no_other_call_of_their_connection() {
    let served = served().await;
    let mut render = RenderServiceClient::new(served.channel.clone());
    let job = render.submit_path(request("a", Turntable::default())).await.unwrap().into_inner();
    let ask = WatchFramesRequest { job_id: job.job_id, ..Default::default() };
    let mut watching = render.watch_frames(ask).await.unwrap().into_inner();
    assert!(watching.message().await.unwrap().is_some(), "a notice");
    for round in 0..30 {
        let calls: Vec<_> = (0..64)
            .map(|_| {
                let mut render = render.clone();
                tokio::spawn(
                    async move { render.list_workers(ListWorkersRequest::default()).await },
                )
            })
            .collect();
        if round % 2 == 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        calls.iter().for_each(|call| call.abort());
    }
    render.list_jobs(ListJobsRequest::default()).await.unwrap();
    let next = tokio::time::timeout(Duration::from_millis(100), watching.message()).await;
    assert!(!matches!(next, Ok(Err(_) | Ok(None))), "{next:?}");
}

/// A peer that opens streams and resets them as fast as it can loses its connection.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn flood_of_resets_closes_its_connection() {
    let served = served().await;
    let mut peer = TcpStream::connect(served.address).await.unwrap();
    peer.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0").await.unwrap();
    let path = b"/slabcast.render.v1.RenderService/DescribeVolume";
    // POST, http and the path: indexed and literal fields of HPACK.
    let mut block = vec![0x83, 0x86, 0x04, path.len() as u8];
    block.extend_from_slice(path);
    let frame = |kind: u8, flags: u8, stream: u32, body: &[u8]| {
        let mut frame = (body.len() as u32).to_be_bytes()[1..].to_vec();
        frame.extend([kind, flags]);
        frame.extend(stream.to_be_bytes());
        frame.extend(body);
        frame
    };
    let mut stream = 1;
    let flooding = async {
        loop {
            let mut batch = Vec::new();
            for _ in 0..1000 {
                batch.extend(frame(1, 4, stream, &block));
                batch.extend(frame(3, 0, stream, &8u32.to_be_bytes()));
                stream += 2;
            }
            if peer.write_all(&batch).await.is_err() {
                return;
            }
        }
    };
    tokio::time::timeout(Duration::from_secs(30), flooding).await.expect("it is closed");
    let mut render = RenderServiceClient::new(served.channel.clone());
    render.list_jobs(ListJobsRequest::default()).await.unwrap();
}
