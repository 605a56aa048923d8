//! ClusterService: the two streams of a worker's link.

use super::Responses;
use crate::Handle;
use crate::link::{BrickOrder, Caller, WorkerLink, serve_link};
use slabcast_common::link::BRICK_BATCHES_IN_FLIGHT;
use slabcast_common::message::{ToMaster, ToWorker};
use slabcast_proto::cluster_v1::cluster_service_server::ClusterService;
use slabcast_proto::cluster_v1::{BricksRequest, BricksResponse, ControlRequest, ControlResponse};
use slabcast_proto::convert::{self, BrickBatches, Down};
use slabcast_proto::status::Reason;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::{mpsc, oneshot};
use tokio_stream::wrappers::{ReceiverStream, UnboundedReceiverStream};
use tonic::{Request, Response, Status, Streaming};
use tracing::debug;

/// Time that a worker may take from connecting to its hello, and from its welcome to its second
/// connection.
const HELLO: Duration = Duration::from_secs(10);

/// Brick orders of links whose second connection is not there yet, by session.
type Sessions = Arc<Mutex<BTreeMap<u64, Waiting>>>;

struct Waiting {
    orders: mpsc::UnboundedReceiver<BrickOrder>,
    /// Dropped when the Bricks stream ends; the Control stream watches its other end.
    alive: oneshot::Sender<()>,
}

fn locked(sessions: &Sessions) -> MutexGuard<'_, BTreeMap<u64, Waiting>> {
    sessions.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The service.
pub(super) struct Cluster {
    handle: Handle,
    sessions: Sessions,
}

impl Cluster {
    pub(super) fn new(handle: Handle) -> Self {
        Cluster { handle, sessions: Sessions::default() }
    }
}

fn out_of_order(message: &str) -> Status {
    Reason::OutOfOrder.status(message, &[])
}

fn too_late(message: &str) -> Status {
    Reason::TooLate.status(message, &[])
}

/// A session that nobody can guess; not zero.
fn new_session() -> Result<u64, Status> {
    match getrandom::u64() {
        Ok(random) => Ok(random.max(1)),
        Err(e) => Err(Status::internal(format!("the system has no random numbers: {e}"))),
    }
}

#[tonic::async_trait]
impl ClusterService for Cluster {
    type ControlStream = Responses<ControlResponse>;
    type BricksStream = Responses<BricksResponse>;

    async fn control(
        &self,
        request: Request<Streaming<ControlRequest>>,
    ) -> Result<Response<Self::ControlStream>, Status> {
        let [remote, local] = [request.remote_addr(), request.local_addr()];
        let caller = Caller {
            address: remote.map(|a| a.to_string()).unwrap_or_default(),
            // A caller from the address that it calls runs on the same machine.
            is_local: remote.zip(local).is_some_and(|(remote, local)| remote.ip() == local.ip()),
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
        request: Request<Streaming<BricksRequest>>,
    ) -> Result<Response<Self::BricksStream>, Status> {
        let mut inbound = request.into_inner();
        let (out, outbound) = mpsc::channel(BRICK_BATCHES_IN_FLIGHT);
        let sessions = self.sessions.clone();
        tokio::spawn(async move {
            let Waiting { orders, alive } = match open_bricks(&mut inbound, &sessions).await {
                Ok(waiting) => waiting,
                Err(status) => {
                    let _ = out.send(Err(status)).await;
                    return;
                }
            };
            // Nothing more comes up; the end of that stream is the worker's.
            let up = async { while let Ok(Some(_)) = inbound.message().await {} };
            tokio::select! { () = send_bricks(orders, &out) => {}, () = up => {} }
            drop(alive);
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(outbound))))
    }
}

/// Reads the first message of a Bricks stream, and takes its session's orders.
async fn open_bricks(
    inbound: &mut Streaming<BricksRequest>,
    sessions: &Sessions,
) -> Result<Waiting, Status> {
    let first = tokio::time::timeout(HELLO, inbound.message()).await;
    let message = first
        .map_err(|_| too_late("no BricksOpen in 10 s"))??
        .ok_or_else(|| out_of_order("BricksOpen must come first"))?;
    let session = convert::bricks_open_from_wire(message)?;
    locked(sessions).remove(&session).ok_or_else(|| {
        Reason::SessionUnknown.status("the session is over or unknown; say hello again", &[])
    })
}

/// Sends what is ordered, a message at a time: as many encoded bricks are in memory as the channel
/// and one message hold, however long the order is.
async fn send_bricks(
    mut orders: mpsc::UnboundedReceiver<BrickOrder>,
    out: &mpsc::Sender<Result<BricksResponse, Status>>,
) {
    while let Some(order) = orders.recv().await {
        match order {
            BrickOrder::Send { set, store, bricks } => {
                let encoded = bricks.iter().filter_map(|id| store.encoded(*id));
                for message in BrickBatches::new(&set, encoded) {
                    if out.send(Ok(message)).await.is_err() {
                        return;
                    }
                }
            }
            BrickOrder::Drop { set, bricks } => {
                let message = ToWorker::DropBricks { set, bricks };
                let Down::Bricks(messages) = convert::to_worker_to_wire(&message, 0) else {
                    unreachable!("DropBricks goes on the Bricks stream")
                };
                for message in messages {
                    if out.send(Ok(message)).await.is_err() {
                        return;
                    }
                }
            }
        }
    }
}

/// Serves one worker's Control stream from its hello to its end.
async fn control(
    handle: Handle,
    sessions: Sessions,
    caller: &Caller,
    mut inbound: Streaming<ControlRequest>,
    out: &mpsc::UnboundedSender<Result<ControlResponse, Status>>,
) -> Result<(), Status> {
    let first = tokio::time::timeout(HELLO, inbound.message()).await;
    let first = first
        .map_err(|_| too_late("no Hello in 10 s"))??
        .ok_or_else(|| out_of_order("Hello must come first"))?;
    let ToMaster::Hello(hello) = convert::from_worker_from_wire(first)? else {
        return Err(out_of_order("Hello must come first"));
    };

    let (control_tx, mut control_rx) = mpsc::unbounded_channel::<ToWorker>();
    let (orders_tx, orders) = mpsc::unbounded_channel();
    let (alive, mut bricks_ended) = oneshot::channel();
    let session = new_session()?;
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
            if replies.send(convert::from_worker_from_wire(message)?).await.is_err() {
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
        _ = &mut bricks_ended => {
            Err(Reason::BricksEnded.status("the Bricks stream ended; say hello again", &[]))
        }
        () = second_connection => Err(too_late("no Bricks stream in 10 s")),
    };
    locked(&sessions).remove(&session);
    outcome
}
