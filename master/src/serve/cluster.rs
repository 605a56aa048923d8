//! ClusterService: the two streams of a worker's link.

use super::connections::{Peer, State};
use super::{GOODBYE, Responses};
use crate::Handle;
use crate::allowance::{self, Account};
use crate::link::{BrickOrder, Broken, Caller, Damaged, WorkerLink, bricks_of, serve_until};
use slabcast_common::link::BRICK_BATCHES_IN_FLIGHT;
use slabcast_common::message::{ToMaster, ToWorker};
use slabcast_proto::cluster_v1::cluster_service_server::ClusterService;
use slabcast_proto::cluster_v1::{
    BricksRequest, BricksResponse, ControlRequest, ControlResponse, bricks_response,
};
use slabcast_proto::convert::{self, BrickBatches, Down};
use slabcast_proto::sealed::{self, Incoming, Seals, StreamError};
use slabcast_proto::status::{Reason, invalid_field};
use slabcast_volumes::BrickStore;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot};
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Request, Response, Status, Streaming};
use tracing::{debug, warn};

/// Time that a worker may take from connecting to its hello, and from its welcome to its second
/// connection.
const HELLO: Duration = Duration::from_secs(10);

/// Messages of a Control stream that wait for the peer to read. What does not fit waits, not
/// encoded, in the driver's own channel ([`WorkerLink::control`]).
const CONTROL_MESSAGES: usize = 64;

/// Brick orders of links whose second connection is not there yet, by session.
type Sessions = Arc<Mutex<BTreeMap<u64, Waiting>>>;

struct Waiting {
    orders: mpsc::UnboundedReceiver<BrickOrder>,
    account: Arc<Mutex<Account>>,
    damaged: Damaged,
    /// Dropped when the Bricks stream ends; the Control stream watches its other end.
    alive: oneshot::Sender<()>,
}

fn locked<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
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
        let state = request.extensions().get::<Peer>().map(|peer| peer.state.clone());
        let [remote, local] = [request.remote_addr(), request.local_addr()];
        let caller = Caller {
            address: remote.map(|a| a.to_string()).unwrap_or_default(),
            // A caller from the address that it calls runs on the same machine.
            is_local: remote.zip(local).is_some_and(|(remote, local)| remote.ip() == local.ip()),
        };
        let inbound = request.into_inner();
        let (out, outbound) = mpsc::channel(CONTROL_MESSAGES);
        let (handle, sessions) = (self.handle.clone(), self.sessions.clone());
        tokio::spawn(async move {
            if let Err(status) = control(handle, sessions, (&caller, state), inbound, &out).await {
                debug!(address = caller.address, status = status.message(), "control ended");
                end(&out, status).await;
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(outbound))))
    }

    async fn bricks(
        &self,
        request: Request<Streaming<BricksRequest>>,
    ) -> Result<Response<Self::BricksStream>, Status> {
        let state = request.extensions().get::<Peer>().map(|peer| peer.state.clone());
        let mut inbound = request.into_inner();
        // Those that wait are in the channel to the seals, and one is here.
        let (out, outbound) = mpsc::channel(1);
        let sessions = self.sessions.clone();
        tokio::spawn(async move {
            let (messages, source) = mpsc::channel(BRICK_BATCHES_IN_FLIGHT);
            let (sealed, opener) = sealed::ends(ReceiverStream::new(source));
            let carried = async {
                let Waiting { orders, account, alive, damaged } =
                    open_bricks(&mut inbound, &opener, &sessions).await?;
                state.iter().for_each(|state| state.is_worker());
                // Nothing more comes up but acknowledgements; the end of that stream is the
                // worker's.
                let up = async {
                    loop {
                        let before = opener.damaged();
                        let next = next_message(&mut inbound, &opener).await;
                        damaged.add(opener.damaged() - before);
                        match next {
                            Ok(Some(_)) => {}
                            Ok(None) => return Ok(()),
                            Err(status) => return Err(status),
                        }
                    }
                };
                let ended = tokio::select! {
                    () = send_bricks(orders, &account, &messages) => Ok(()),
                    ended = up => ended,
                };
                drop(alive);
                ended
            };
            let ended = tokio::select! {
                ended = carried => ended,
                () = carry(sealed, &out) => Ok(()),
            };
            if let Err(status) = ended {
                end(&out, status).await;
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(outbound))))
    }
}

/// Sends what leaves a sealed stream until it ends, or the peer is gone.
async fn carry<M>(
    mut sealed: impl tokio_stream::Stream<Item = M> + Unpin,
    out: &mpsc::Sender<Result<M, Status>>,
) {
    while let Some(message) = sealed.next().await {
        if out.send(Ok(message)).await.is_err() {
            return;
        }
    }
}

/// Ends a stream with a status, unless the peer reads nothing: then it ends without.
async fn end<M>(out: &mpsc::Sender<Result<M, Status>>, status: Status) {
    let _ = tokio::time::timeout(GOODBYE, out.send(Err(status))).await;
}

/// Returns the next message of a sealed stream; `None` at its end.
///
/// # Errors
/// The status of a stream that broke, or DATA_LOSS if a message can't be had whole.
async fn next_message<M: Seals>(
    inbound: &mut Streaming<M>,
    opener: &Incoming<M>,
) -> Result<Option<M>, Status> {
    loop {
        let message = tokio::select! {
            message = inbound.message() => message?,
            () = tokio::time::sleep(opener.patience()), if opener.is_waiting() => {
                opener.ask_again().map_err(unsealed)?;
                continue;
            }
        };
        let Some(message) = message else { return Ok(None) };
        if let Some(opened) = opener.open(message).map_err(unsealed)? {
            return Ok(Some(opened));
        }
    }
}

fn unsealed(error: StreamError) -> Status {
    match error.is_damage() {
        true => Status::data_loss(error.to_string()),
        false => Status::invalid_argument(error.to_string()),
    }
}

/// Reads the first message of a Bricks stream, and takes its session's orders.
async fn open_bricks(
    inbound: &mut Streaming<BricksRequest>,
    opener: &Incoming<BricksRequest>,
    sessions: &Sessions,
) -> Result<Waiting, Status> {
    let first = tokio::time::timeout(HELLO, next_message(inbound, opener)).await;
    let message = first
        .map_err(|_| too_late("no BricksOpen in 10 s"))??
        .ok_or_else(|| out_of_order("BricksOpen must come first"))?;
    let session = convert::bricks_open_from_wire(message)?;
    locked(sessions).remove(&session).ok_or_else(|| {
        Reason::SessionUnknown.status("the session is over or unknown; say hello again", &[])
    })
}

/// Bricks of an order that are read together: a block has at most as many.
const READ_BRICKS: usize = 512;

/// Sends what is ordered, a message at a time. [`READ_BRICKS`] encoded bricks, and those in the
/// channel, are in memory beside the store's, however long the order is.
async fn send_bricks(
    mut orders: mpsc::UnboundedReceiver<BrickOrder>,
    account: &Mutex<Account>,
    out: &mpsc::Sender<BricksResponse>,
) {
    while let Some(order) = orders.recv().await {
        match order {
            BrickOrder::Send { set, store, bricks, losses } => {
                for (i, ids) in bricks.chunks(READ_BRICKS).enumerate() {
                    let encoded = match bricks_of(&store, ids, BrickStore::try_encoded).await {
                        Ok(encoded) => encoded,
                        Err(reason) => {
                            losses.report(&bricks[i * READ_BRICKS..], reason).await;
                            break;
                        }
                    };
                    for message in BrickBatches::new(&set, encoded) {
                        // A place first, so that nothing counts as sent to a worker that reads
                        // nothing.
                        let Ok(place) = out.reserve().await else { return };
                        if let Some(bricks_response::Message::Batch(batch)) = &message.message {
                            locked(account).sent_bricks(batch.bricks.len() as u64);
                        }
                        place.send(message);
                    }
                }
            }
            BrickOrder::Drop { set, bricks } => {
                let message = ToWorker::DropBricks { set, bricks };
                let Down::Bricks(messages) = convert::to_worker_to_wire(&message, 0) else {
                    unreachable!("DropBricks goes on the Bricks stream")
                };
                for message in messages {
                    if out.send(message).await.is_err() {
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
    (caller, state): (&Caller, Option<Arc<State>>),
    mut inbound: Streaming<ControlRequest>,
    out: &mpsc::Sender<Result<ControlResponse, Status>>,
) -> Result<(), Status> {
    let first = tokio::time::timeout(HELLO, inbound.message()).await;
    let first = first
        .map_err(|_| too_late("no Hello in 10 s"))??
        .ok_or_else(|| out_of_order("Hello must come first"))?;
    let ToMaster::Hello(hello) = convert::from_worker_from_wire(first)? else {
        return Err(out_of_order("Hello must come first"));
    };
    state.iter().for_each(|state| state.is_worker());

    let name = hello.name.clone();
    let (control_tx, mut control_rx) = mpsc::unbounded_channel::<ToWorker>();
    let (orders_tx, orders) = mpsc::unbounded_channel();
    let (alive, mut bricks_ended) = oneshot::channel();
    let session = new_session()?;
    let damaged = Damaged::of(hello.name.clone(), caller.address.clone());
    let account = Arc::new(Mutex::new(Account::new()));
    let waiting = Waiting { orders, account: account.clone(), alive, damaged: damaged.clone() };
    locked(&sessions).insert(session, waiting);
    let link = WorkerLink { control: control_tx, bricks: orders_tx, damaged: damaged.clone() };
    let (replies, mut reply_rx) = mpsc::channel(64);
    let (broken_tx, broken_rx) = oneshot::channel();
    let link_caller = caller.clone();
    // A task of its own: it outlives whatever ends below, and then tells the driver.
    tokio::spawn(async move {
        let broken = async {
            match broken_rx.await {
                Ok(broken) => broken,
                // The replies end with whatever is below, and tell.
                Err(_) => std::future::pending().await,
            }
        };
        serve_until(handle, hello, link_caller, link, &mut reply_rx, broken).await;
    });
    let (messages, source) = mpsc::channel(CONTROL_MESSAGES);
    let (sealed, opener) = sealed::ends(ReceiverStream::new(source));
    let down = async {
        while let Some(message) = control_rx.recv().await {
            locked(&account).sent(&message);
            let parts = match convert::to_worker_to_wire(&message, session) {
                Down::Control(refused) if matches!(message, ToWorker::Refused { .. }) => {
                    // A worker of any version must be able to read it.
                    let _ = out.send(Ok(refused)).await;
                    continue;
                }
                Down::Control(message) => vec![message],
                Down::Parts(messages) => messages,
                // The driver sends these with the bricks.
                Down::Bricks(_) => continue,
            };
            for message in parts {
                if messages.send(message).await.is_err() {
                    return;
                }
            }
        }
        // The last messages are still sent.
        drop(messages);
        std::future::pending::<()>().await;
    };
    let begun = Instant::now();
    let up = async {
        let mut told = false;
        loop {
            let before = opener.damaged();
            let next = next_message(&mut inbound, &opener).await;
            damaged.add(opener.damaged() - before);
            let Some(message) = next? else { return Ok::<(), Status>(()) };
            let message = convert::from_worker_from_wire(message)?;
            if !locked(&account).confirms(&message) {
                let problem = "says that more bricks came than were sent";
                return Err(invalid_field("bricks_received.bricks", problem));
            }
            for piece in allowance::pieces(message) {
                let wait = locked(&account).take(&piece, begun.elapsed());
                if !wait.is_zero() {
                    if !std::mem::replace(&mut told, true) {
                        let address = &caller.address;
                        warn!(
                            worker = name,
                            address,
                            "peer limited: it says more than was asked of it, and is read slowly"
                        );
                    }
                    tokio::time::sleep(wait).await;
                }
                if replies.send(piece).await.is_err() {
                    return Ok(());
                }
            }
        }
    };
    let second_connection = async {
        tokio::time::sleep(HELLO).await;
        if !locked(&sessions).contains_key(&session) {
            std::future::pending::<()>().await;
        }
    };
    let outcome = tokio::select! {
        () = down => Ok(()),
        // All that the driver said has left by now, a refusal too.
        () = carry(sealed, out) => Ok(()),
        outcome = up => outcome,
        _ = &mut bricks_ended => {
            Err(Reason::BricksEnded.status("the Bricks stream ended; say hello again", &[]))
        }
        () = second_connection => Err(too_late("no Bricks stream in 10 s")),
    };
    locked(&sessions).remove(&session);
    if let Err(status) = &outcome {
        let reason = format!("its streams broke: {}", status.message());
        let _ = broken_tx.send(Broken { reason, is_damage: is_damage(status) });
    }
    outcome
}

/// Whether a stream broke because bytes were changed on their way: no tile is to blame for that.
fn is_damage(status: &Status) -> bool {
    // Decoding and HTTP/2 fail with INTERNAL on this side; a peer that dies ends a stream
    // otherwise.
    matches!(status.code(), Code::DataLoss | Code::Internal)
}
