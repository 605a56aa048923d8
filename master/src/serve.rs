//! gRPC: the services of `slabcast.v1` over TCP, with health and reflection.
//!
//! The accept loop is ours, since tonic's leaves a silent peer connected for ever: a
//! connection has a few seconds to say its HTTP/2 preface, there is a limit on how many there
//! are, and each has TCP_NODELAY (without it a task costs 40 ms).

use crate::Handle;
use crate::SubmitError;
use crate::jobs::{JobState, JobView, WatchItem};
use crate::link::{BrickOrder, Caller, WorkerLink, serve_link};
use slabcast_common::ids::JobId;
use slabcast_common::link::BRICK_BATCHES_IN_FLIGHT;
use slabcast_common::message::{ToMaster, ToWorker};
use slabcast_proto::convert::{self, Down};
use slabcast_proto::model::{self, JobNotice};
use slabcast_proto::{FILE_DESCRIPTOR_SET, MAX_CONTROL_MESSAGE, MAX_RENDER_MESSAGE, v1};
use std::collections::BTreeMap;
use std::hash::{BuildHasher, Hasher};
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot, watch};
use tokio_stream::wrappers::{ReceiverStream, UnboundedReceiverStream};
use tonic::transport::server::{Connected, TcpConnectInfo};
use tonic::{Request, Response, Status, Streaming};
use tracing::{debug, info, warn};

/// Connections at a time. One worker takes two; 16 KiB each when idle.
const MAX_CONNECTIONS: usize = 4096;
/// Watchers at a time; each holds up to four chunks of 1 MiB.
const MAX_WATCHERS: usize = 256;
/// How long a connection may take to say its HTTP/2 preface (24 bytes).
const PREFACE: Duration = Duration::from_secs(3);
/// How long a worker may take from connecting to its hello, and from welcome to its second
/// connection.
const HELLO: Duration = Duration::from_secs(10);
/// How long streams may take to end when the master does.
const GOODBYE: Duration = Duration::from_secs(2);

/// Serves `handle` on `listener` until `stop` turns true.
///
/// # Errors
/// If the reflection service can't be built or the server fails.
pub async fn serve(
    handle: Handle,
    listener: TcpListener,
    stop: watch::Receiver<bool>,
) -> std::io::Result<()> {
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<v1::render_server::RenderServer<RenderService>>().await;
    health.set_serving::<v1::cluster_server::ClusterServer<ClusterService>>().await;
    let reflection = tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .build_v1()
        .map_err(std::io::Error::other)?;
    let render =
        RenderService { handle: handle.clone(), watchers: Arc::new(Semaphore::new(MAX_WATCHERS)) };
    let cluster = ClusterService { handle, sessions: Arc::default() };
    let (accepted, incoming) = mpsc::channel::<std::io::Result<Connection>>(16);
    let accepting = tokio::spawn(accept(listener, accepted));
    let stopped = wait_for(stop.clone());
    let server = tonic::transport::Server::builder()
        .initial_stream_window_size(1 << 20)
        .initial_connection_window_size(4 << 20)
        .max_frame_size(64 * 1024)
        .max_concurrent_streams(32)
        .http2_max_header_list_size(16 * 1024)
        .http2_keepalive_interval(Some(Duration::from_secs(10)))
        .http2_keepalive_timeout(Some(Duration::from_secs(5)))
        .add_service(health_service)
        .add_service(reflection)
        .add_service(
            v1::render_server::RenderServer::new(render)
                .max_decoding_message_size(MAX_RENDER_MESSAGE)
                .max_encoding_message_size(MAX_RENDER_MESSAGE),
        )
        .add_service(
            v1::cluster_server::ClusterServer::new(cluster)
                .max_decoding_message_size(MAX_CONTROL_MESSAGE)
                .max_encoding_message_size(MAX_CONTROL_MESSAGE),
        )
        .serve_with_incoming_shutdown(ReceiverStream::new(incoming), stopped);
    let overdue = async {
        wait_for(stop).await;
        tokio::time::sleep(GOODBYE).await;
    };
    let outcome = tokio::select! {
        outcome = server => outcome.map_err(std::io::Error::other),
        () = overdue => Ok(()),
    };
    accepting.abort();
    outcome
}

async fn wait_for(mut stop: watch::Receiver<bool>) {
    // A sender that is gone means stop as well.
    let _ = stop.wait_for(|s| *s).await;
}

// ---------------------------------------------------------------------------------------------
// Connections

/// A connection that counts against the limit while it lives.
struct Connection {
    io: TcpStream,
    _place: OwnedSemaphorePermit,
}

impl Connected for Connection {
    type ConnectInfo = TcpConnectInfo;
    fn connect_info(&self) -> TcpConnectInfo {
        self.io.connect_info()
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.io).poll_read(cx, buf)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &[u8],
    ) -> Poll<std::io::Result<usize>> {
        Pin::new(&mut self.io).poll_write(cx, buf)
    }
    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[std::io::IoSlice<'_>],
    ) -> Poll<std::io::Result<usize>> {
        Pin::new(&mut self.io).poll_write_vectored(cx, bufs)
    }
    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }
    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.io).poll_flush(cx)
    }
    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.io).poll_shutdown(cx)
    }
}

async fn accept(listener: TcpListener, accepted: mpsc::Sender<std::io::Result<Connection>>) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let (io, from) = match listener.accept().await {
            Ok(pair) => pair,
            Err(e) => {
                // Out of descriptors, or a peer that was gone at once: both pass.
                warn!(error = %e, "accept failed");
                tokio::time::sleep(Duration::from_millis(50)).await;
                continue;
            }
        };
        let Ok(place) = places.clone().try_acquire_owned() else {
            warn!(%from, limit = MAX_CONNECTIONS, "too many connections, one is turned away");
            continue;
        };
        if let Err(e) = io.set_nodelay(true) {
            debug!(%from, error = %e, "connection lost at once");
            continue;
        }
        let accepted = accepted.clone();
        tokio::spawn(async move {
            match tokio::time::timeout(PREFACE, preface(&io)).await {
                Ok(true) => {
                    let _ = accepted.send(Ok(Connection { io, _place: place })).await;
                }
                Ok(false) => debug!(%from, "connection closed before its preface"),
                Err(_) => debug!(%from, "connection dropped: no preface in time"),
            }
        });
    }
}

/// Waits until the 24 bytes of the HTTP/2 preface can be read; false if the peer is gone.
async fn preface(io: &TcpStream) -> bool {
    let mut bytes = [0; 24];
    loop {
        match io.peek(&mut bytes).await {
            Ok(24) => return true,
            Ok(0) | Err(_) => return false,
            // Readable, but not whole: `peek` would return at once again.
            Ok(_) => tokio::time::sleep(Duration::from_millis(20)).await,
        }
    }
}

// ---------------------------------------------------------------------------------------------
// Cluster

/// Brick orders of links whose second connection is not there yet, by session.
type Sessions = Arc<Mutex<BTreeMap<u64, Waiting>>>;

struct Waiting {
    orders: mpsc::UnboundedReceiver<BrickOrder>,
    /// Dropped when the Bricks stream ends; its other end watches.
    alive: oneshot::Sender<()>,
}

fn locked(sessions: &Sessions) -> std::sync::MutexGuard<'_, BTreeMap<u64, Waiting>> {
    sessions.lock().unwrap_or_else(|broken| broken.into_inner())
}

struct ClusterService {
    handle: Handle,
    sessions: Sessions,
}

type Out<T> = Pin<Box<dyn tokio_stream::Stream<Item = Result<T, Status>> + Send>>;

/// A number that a stranger can't guess: a keyed hash with the system's randomness.
fn unguessable() -> u64 {
    let mut h = std::hash::RandomState::new().build_hasher();
    h.write_u64(0);
    h.finish().max(1)
}

#[tonic::async_trait]
impl v1::cluster_server::Cluster for ClusterService {
    type ControlStream = Out<v1::ToWorker>;
    type BricksStream = Out<v1::BricksDown>;

    async fn control(
        &self,
        request: Request<Streaming<v1::FromWorker>>,
    ) -> Result<Response<Self::ControlStream>, Status> {
        let [from, to] = [request.remote_addr(), request.local_addr()];
        let caller = Caller {
            address: from.map(|a| a.to_string()).unwrap_or_default(),
            // Whoever has the address that it calls is the machine that is called.
            is_local: from.zip(to).is_some_and(|(from, to)| from.ip() == to.ip()),
        };
        let inbound = request.into_inner();
        // Unbounded for the same reason as `WorkerLink::control`, which it carries on.
        let (out, outbound) = mpsc::unbounded_channel();
        let (handle, sessions) = (self.handle.clone(), self.sessions.clone());
        tokio::spawn(async move {
            if let Err(status) = control(handle, sessions, &caller, inbound, &out).await {
                debug!(address = caller.address, status = status.message(), "control ended");
                let _ = out.send(Err(status));
            }
        });
        Ok(Response::new(Box::pin(UnboundedReceiverStream::new(outbound))))
    }

    async fn bricks(
        &self,
        request: Request<Streaming<v1::BricksUp>>,
    ) -> Result<Response<Self::BricksStream>, Status> {
        let mut inbound = request.into_inner();
        let (out, outbound) = mpsc::channel(BRICK_BATCHES_IN_FLIGHT);
        let sessions = self.sessions.clone();
        tokio::spawn(async move {
            let opened = async {
                let first = tokio::time::timeout(HELLO, inbound.message()).await;
                let message = first
                    .map_err(|_| Status::failed_precondition("no BricksOpen in time"))??
                    .ok_or_else(|| Status::failed_precondition("BricksOpen must come first"))?;
                let session = convert::bricks_open_from_wire(message)
                    .map_err(|e| Status::invalid_argument(e.to_string()))?;
                locked(&sessions).remove(&session).ok_or_else(|| {
                    Status::failed_precondition("the session is over or unknown; say hello again")
                })
            };
            let Waiting { mut orders, alive } = match opened.await {
                Ok(waiting) => waiting,
                Err(status) => {
                    let _ = out.send(Err(status)).await;
                    return;
                }
            };
            let pump = async {
                while let Some(order) = orders.recv().await {
                    for message in brick_messages(order) {
                        if out.send(Ok(message)).await.is_err() {
                            return;
                        }
                    }
                }
            };
            // Nothing more comes up; the stream's end is the worker's.
            let up = async { while let Ok(Some(_)) = inbound.message().await {} };
            tokio::select! { () = pump => {}, () = up => {} }
            drop(alive);
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(outbound))))
    }
}

fn brick_messages(order: BrickOrder) -> Vec<v1::BricksDown> {
    match order {
        BrickOrder::Send { set, store, bricks } => {
            let encoded = bricks.iter().filter_map(|id| store.encoded(*id));
            convert::brick_batches_to_wire(&set, encoded)
        }
        BrickOrder::Drop { set, bricks } => {
            match convert::to_worker_to_wire(&ToWorker::DropBricks { set, bricks }, 0) {
                Down::Bricks(messages) => messages,
                Down::Control(_) | Down::Parts(_) => Vec::new(),
            }
        }
    }
}

/// One worker's Control stream, from its hello to its end.
async fn control(
    handle: Handle,
    sessions: Sessions,
    caller: &Caller,
    mut inbound: Streaming<v1::FromWorker>,
    out: &mpsc::UnboundedSender<Result<v1::ToWorker, Status>>,
) -> Result<(), Status> {
    let read = |message| {
        convert::from_worker_from_wire(message).map_err(|e| Status::invalid_argument(e.to_string()))
    };
    let first = tokio::time::timeout(HELLO, inbound.message()).await;
    let first = first
        .map_err(|_| Status::failed_precondition("no Hello in time"))??
        .ok_or_else(|| Status::failed_precondition("Hello must come first"))?;
    let ToMaster::Hello(hello) = read(first)? else {
        return Err(Status::failed_precondition("Hello must come first"));
    };

    let (control_tx, mut control_rx) = mpsc::unbounded_channel::<ToWorker>();
    let (orders_tx, orders) = mpsc::unbounded_channel();
    let (alive, mut bricks_ended) = oneshot::channel();
    let session = unguessable();
    locked(&sessions).insert(session, Waiting { orders, alive });
    let link = WorkerLink { control: control_tx, bricks: orders_tx };
    let (replies, mut reply_rx) = mpsc::channel(64);
    let caller = caller.clone();
    // A task of its own: it outlives whatever ends below, and then tells the driver.
    tokio::spawn(async move { serve_link(handle, hello, caller, link, &mut reply_rx).await });
    let down = async {
        while let Some(message) = control_rx.recv().await {
            match convert::to_worker_to_wire(&message, session) {
                Down::Control(message) => drop(out.send(Ok(message))),
                Down::Parts(messages) => messages.into_iter().for_each(|m| drop(out.send(Ok(m)))),
                // The driver sends these with the bricks.
                Down::Bricks(_) => {}
            }
        }
    };
    let up = async {
        while let Some(message) = inbound.message().await? {
            if replies.send(read(message)?).await.is_err() {
                break;
            }
        }
        Ok::<(), Status>(())
    };
    let second_connection = async {
        tokio::time::sleep(HELLO).await;
        if !locked(&sessions).contains_key(&session) {
            std::future::pending::<()>().await;
        }
    };
    let outcome = tokio::select! {
        // All that the driver said has left by now, a refusal too.
        () = down => Ok(()),
        outcome = up => outcome,
        _ = &mut bricks_ended => Err(Status::unavailable("the Bricks stream ended")),
        () = second_connection => Err(Status::failed_precondition("no Bricks stream in time")),
    };
    locked(&sessions).remove(&session);
    outcome
}

// ---------------------------------------------------------------------------------------------
// Render

struct RenderService {
    handle: Handle,
    watchers: Arc<Semaphore>,
}

fn job_id(text: &str) -> Result<JobId, Status> {
    text.strip_prefix("job-")
        .and_then(|n| n.parse().ok())
        .map(JobId)
        .ok_or_else(|| no_such_job(text))
}

fn no_such_job(text: &str) -> Status {
    Status::not_found(format!("no job `{text}`; ListJobs names those that are known"))
}

fn state(state: &JobState) -> (model::JobState, String) {
    match state {
        JobState::Queued => (model::JobState::Queued, String::new()),
        JobState::Preparing => (model::JobState::Queued, "making bricks".into()),
        JobState::WaitingForWorkers => (
            model::JobState::WaitingForWorkers,
            "no worker is there; start one with `slabcast worker --master HOST:PORT`".into(),
        ),
        JobState::Running => (model::JobState::Running, String::new()),
        JobState::Done => (model::JobState::Done, String::new()),
        JobState::Failed(reason) => (model::JobState::Failed, reason.clone()),
        JobState::Cancelled => (model::JobState::Cancelled, String::new()),
    }
}

/// A notice about a job.
pub fn notice(job: &JobView) -> JobNotice {
    let (state, mut message) = state(&job.state);
    if state == model::JobState::Running && job.tiles.1 > 0 {
        message = format!(
            "frame {}: slab {} of {}, {} of {} tiles",
            job.frames_done,
            job.slab.0 + 1,
            job.slab.1,
            job.tiles.0,
            job.tiles.1
        );
    }
    JobNotice {
        state,
        frames_done: job.frames_done,
        frames_total: job.frames_total,
        workers: job.workers,
        message,
    }
}

fn job(view: &JobView) -> v1::Job {
    let (state, message) = state(&view.state);
    convert::job_to_wire(&model::Job {
        job_id: view.id.to_string(),
        client_key: view.client_key.clone(),
        state,
        message,
        frames_done: view.frames_done,
        frames_total: view.frames_total,
        size: view.size,
        format: view.format,
        submitted_unix_ms: view.submitted_unix_ms,
        finished_unix_ms: view.finished_unix_ms,
    })
}

#[tonic::async_trait]
impl v1::render_server::Render for RenderService {
    type WatchFramesStream = Out<v1::FrameChunk>;

    async fn submit_path(
        &self,
        request: Request<v1::PathRequest>,
    ) -> Result<Response<v1::SubmitReply>, Status> {
        let request = convert::path_request_from_wire(request.into_inner())
            .map_err(|e| Status::invalid_argument(e.to_string()))?;
        match self.handle.submit(request).await {
            Ok(id) => Ok(Response::new(v1::SubmitReply { job_id: id.to_string() })),
            Err(SubmitError::Refused(refused)) => {
                Err(Status::invalid_argument(refused.to_string()))
            }
            Err(SubmitError::KeyTaken) => Err(Status::already_exists(
                "client_key: belongs to another request; choose a fresh key",
            )),
            Err(SubmitError::Full) => Err(Status::resource_exhausted(
                "the master has as many jobs as it takes; wait, or cancel one",
            )),
            Err(SubmitError::Gone) => Err(Status::unavailable("the master ends")),
            Err(e @ SubmitError::Panicked(_)) => Err(Status::internal(e.to_string())),
        }
    }

    async fn watch_frames(
        &self,
        request: Request<v1::WatchRequest>,
    ) -> Result<Response<Self::WatchFramesStream>, Status> {
        let v1::WatchRequest { job_id: name, from_frame } = request.into_inner();
        let id = job_id(&name)?;
        let view = self.handle.job(id).ok_or_else(|| no_such_job(&name))?;
        if from_frame > view.frames_total {
            return Err(Status::out_of_range(format!(
                "from_frame: {from_frame}, the job has {} frames; ask for a smaller one",
                view.frames_total
            )));
        }
        let place = self.watchers.clone().try_acquire_owned().map_err(|_| {
            Status::resource_exhausted("the master has as many watchers as it takes; wait")
        })?;
        let mut watch = self.handle.watch(id, from_frame).ok_or_else(|| no_such_job(&name))?;
        let (out, outbound) = mpsc::channel(4);
        tokio::spawn(async move {
            let _place = place;
            let mut next = from_frame;
            let mut last = view.clone();
            // A stream begins with a notice, so that the caller knows that it is heard.
            if out.send(Ok(convert::notice_to_wire(&notice(&view)))).await.is_err() {
                return;
            }
            loop {
                let item = tokio::select! {
                    item = watch.next() => item,
                    () = out.closed() => return,
                };
                let chunks = match item {
                    None => break,
                    Some(WatchItem::Notice(view)) => {
                        last = view.clone();
                        vec![convert::notice_to_wire(&notice(&view))]
                    }
                    Some(WatchItem::Frame(f)) => {
                        next = f.number + 1;
                        convert::frame_to_wire(
                            f.number,
                            f.size,
                            f.format,
                            &f.bytes,
                            &f.stats_json,
                            f.trace_json.as_deref().unwrap_or(""),
                        )
                    }
                };
                for chunk in chunks {
                    if out.send(Ok(chunk)).await.is_err() {
                        return;
                    }
                }
            }
            if last.state == JobState::Done && next < last.frames_total {
                let gone = Status::failed_precondition(format!(
                    "frame {next} is no longer kept; submit the path anew"
                ));
                let _ = out.send(Err(gone)).await;
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(outbound))))
    }

    async fn get_job(
        &self,
        request: Request<v1::GetJobRequest>,
    ) -> Result<Response<v1::Job>, Status> {
        let name = request.into_inner().job_id;
        let view = self.handle.job(job_id(&name)?).ok_or_else(|| no_such_job(&name))?;
        Ok(Response::new(job(&view)))
    }

    async fn list_jobs(
        &self,
        request: Request<v1::ListJobsRequest>,
    ) -> Result<Response<v1::ListJobsReply>, Status> {
        let limit = match request.into_inner().limit {
            0 => usize::MAX,
            n => n as usize,
        };
        let jobs = self.handle.jobs().iter().rev().take(limit).map(job).collect();
        Ok(Response::new(v1::ListJobsReply { jobs }))
    }

    async fn cancel_job(
        &self,
        request: Request<v1::CancelJobRequest>,
    ) -> Result<Response<v1::Job>, Status> {
        let name = request.into_inner().job_id;
        let id = job_id(&name)?;
        if self.handle.cancel(id).await {
            info!(job = %id, "cancelled by a client");
        }
        let view = self.handle.job(id).ok_or_else(|| no_such_job(&name))?;
        Ok(Response::new(job(&view)))
    }

    async fn describe_volume(
        &self,
        _: Request<v1::DescribeVolumeRequest>,
    ) -> Result<Response<v1::VolumeDescription>, Status> {
        let v = self.handle.volume();
        Ok(Response::new(convert::volume_to_wire(&model::VolumeDescription {
            name: v.name.clone(),
            file_type: v.file_type.clone(),
            anatomical: v.anatomical,
            info: v.info.clone(),
            orientation: v.orientation,
            pixels_version: slabcast_common::PIXELS_VERSION,
            protocol_version: slabcast_common::PROTOCOL_VERSION,
            now_unix_ms: crate::handle::unix_ms(),
        })))
    }

    async fn list_workers(
        &self,
        _: Request<v1::ListWorkersRequest>,
    ) -> Result<Response<v1::ListWorkersReply>, Status> {
        let workers = self.handle.workers().await;
        let workers = workers.iter().map(convert::worker_to_wire).collect();
        Ok(Response::new(v1::ListWorkersReply { workers }))
    }
}
