//! The TCP link: two connections to the master, and the patience to come back.
//!
//! Control and bricks travel on connections of their own, so that a lease never queues behind
//! a megabyte of bricks (at 1 Gb/s that is 22 ms instead of 1.4). The streams are carried to
//! and from the same channels that an embedded link has; [`crate::session`] can't tell.

use crate::cache::BrickCache;
use crate::session::{self, Config, Ended, Link};
use slabcast_common::link::BRICK_BATCHES_IN_FLIGHT;
use slabcast_common::message::{ToMaster, ToWorker};
use slabcast_proto::cluster_v1::cluster_service_client::ClusterServiceClient;
use slabcast_proto::cluster_v1::control_response;
use slabcast_proto::convert::{self, Compression};
use slabcast_proto::sealed::{self, StreamError};
use slabcast_proto::{MAX_BRICKS_MESSAGE, MAX_CONTROL_MESSAGE};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status};
use tracing::{info, warn};

/// Time that a connection may take to be made.
const CONNECT: Duration = Duration::from_secs(5);

/// First wait before dialling again; it doubles up to [`LONGEST_WAIT`] (cluster.proto).
const FIRST_WAIT: Duration = Duration::from_millis(100);

/// Longest wait before dialling again. A link that lived longer was a good one: the wait after it
/// is the first again.
const LONGEST_WAIT: Duration = Duration::from_secs(5);

/// Why a worker can't dial at all.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DialError {
    /// The master's address can't be one.
    Address {
        /// The address as it was given.
        address: String,
        /// Problem, for people.
        problem: String,
    },
    /// The system gives no render threads.
    Threads(String),
}

impl std::fmt::Display for DialError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            DialError::Address { address, problem } => {
                write!(f, "master address `{address}`: {problem}; give HOST:PORT")
            }
            DialError::Threads(problem) => write!(f, "render threads: {problem}"),
        }
    }
}

impl std::error::Error for DialError {}

/// Serves the master at `master` (`host:port`) until `stop` turns true or the master refuses
/// this worker. A master that is not there, or ends, is dialled again for ever; bricks are
/// kept meanwhile.
///
/// # Errors
/// [`DialError`] if the address can't be one, or the system gives no threads.
pub async fn run(
    config: Config,
    master: String,
    stop: watch::Receiver<bool>,
) -> Result<Ended, DialError> {
    run_with(config, BrickCache::default(), master, stop).await
}

/// Serves the master at `master` (`host:port`) with the caller's brick cache, which may have a
/// limit of memory or bricks, until `stop` turns true or the master refuses this worker. An absent
/// master is dialled for ever.
///
/// # Errors
/// [`DialError`] if the address can't be one, or the system gives no threads.
pub async fn run_with(
    config: Config,
    mut cache: BrickCache,
    master: String,
    mut stop: watch::Receiver<bool>,
) -> Result<Ended, DialError> {
    let uri = if master.contains("://") { master.clone() } else { format!("http://{master}") };
    let endpoint = Endpoint::from_shared(uri)
        .map_err(|e| DialError::Address { address: master.clone(), problem: e.to_string() })?
        .connect_timeout(CONNECT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(Duration::from_secs(10))
        .keep_alive_timeout(Duration::from_secs(5));
    let mut wait = FIRST_WAIT;
    let mut told = false;
    loop {
        if *stop.borrow() {
            return Ok(Ended::Stopped);
        }
        let dialled = control_endpoint(&endpoint);
        let channel = tokio::select! {
            channel = dialled.connect() => channel,
            _ = stop.changed() => continue,
        };
        match channel {
            Ok(channel) => {
                let before = tokio::time::Instant::now();
                let ended = link(&config, &endpoint, channel, &mut cache, stop.clone()).await?;
                match ended {
                    Ended::Refused(_) | Ended::Stopped => return Ok(ended),
                    Ended::Lost(reason) if before.elapsed() > LONGEST_WAIT => {
                        warn!(master, reason, "link lost, dialling again");
                        told = false;
                    }
                    // The address may not be a master's; then every attempt ends this way.
                    Ended::Lost(reason) => {
                        if !std::mem::replace(&mut told, true) {
                            warn!(
                                master,
                                reason,
                                "link lost at once: is it a slabcast master? Dialling until it is"
                            );
                        }
                    }
                    Ended::MasterLeft(reason) => {
                        info!(master, reason, "waiting for the master");
                        told = false;
                    }
                }
                if before.elapsed() > LONGEST_WAIT {
                    wait = FIRST_WAIT;
                }
            }
            Err(e) => {
                if !told {
                    let error = causes(&e);
                    warn!(master, error, "no master there, dialling until there is one");
                    told = true;
                }
            }
        }
        // Less a random part: many workers that lost one master do not call at once.
        let nap = wait.mul_f64(1.0 - 0.5 * fastrand::f64());
        tokio::select! { () = tokio::time::sleep(nap) => {}, _ = stop.changed() => {} }
        wait = (wait * 2).min(LONGEST_WAIT);
    }
}

/// The endpoint of the Control stream.
fn control_endpoint(endpoint: &Endpoint) -> Endpoint {
    endpoint
        .clone()
        .initial_stream_window_size(1 << 20)
        .initial_connection_window_size(4 << 20)
        .max_frame_size(64 * 1024)
}

/// The endpoint of the Bricks stream, with small windows: bandwidth times round trip is in flight
/// on this connection, and more only queues in the network.
fn bricks_endpoint(endpoint: &Endpoint) -> Endpoint {
    endpoint
        .clone()
        .initial_stream_window_size(1 << 20)
        .initial_connection_window_size(1 << 20)
        .max_frame_size(64 * 1024)
}

/// Returns the text of an error and of all its sources: tonic's own is just "transport error".
fn causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(e) = next {
        text = format!("{text}: {e}");
        next = e.source();
    }
    text
}

/// Why a link's streams ended.
enum Broken {
    /// The connection broke, or the master ended a stream: dial again.
    Lost(String),
    /// The master does not serve workers like this one: dialling again would not help.
    Refused(String),
}

impl From<Status> for Broken {
    fn from(status: Status) -> Self {
        match status.code() {
            Code::Unimplemented => Broken::Refused(
                "the master does not speak slabcast.cluster.v1; it is of an older version of \
                 slabcast, or no slabcast master: run the same version on both"
                    .into(),
            ),
            Code::Unauthenticated | Code::PermissionDenied => {
                Broken::Refused(format!("the master wants credentials: {}", status.message()))
            }
            // A status that was made on this side has the cause as its source.
            _ => Broken::Lost(causes(&status)),
        }
    }
}

impl From<StreamError> for Broken {
    fn from(error: StreamError) -> Self {
        Broken::Lost(error.to_string())
    }
}

/// Logs that messages of a stream were damaged, once a link.
fn tell_of_damage(stream: &str, damaged: u64, told: &mut bool) {
    if damaged > 0 && !std::mem::replace(told, true) {
        warn!(stream, "a message to or from the master was damaged on its way and is sent again");
    }
}

/// Serves one link, from its hello to its end.
async fn link(
    config: &Config,
    endpoint: &Endpoint,
    channel: Channel,
    cache: &mut BrickCache,
    stop: watch::Receiver<bool>,
) -> Result<Ended, DialError> {
    let (replies, reply_rx) = mpsc::channel(64);
    // Unbounded, bounded by the leases that the master gives and its pings.
    let (control_tx, control) = mpsc::unbounded_channel();
    let (bricks_tx, bricks) = mpsc::channel(BRICK_BATCHES_IN_FLIGHT);
    let carry = carry(channel, bricks_endpoint(endpoint), reply_rx, control_tx, bricks_tx);
    let mut carrying = tokio::spawn(carry);
    let ended = session::run(config, Link { control, replies, bricks }, cache, stop).await;
    let ended = ended.map_err(|e| DialError::Threads(e.to_string()))?;
    // The session dropped its ends. Its last messages still leave; then the streams are over.
    let carried = match tokio::time::timeout(Duration::from_secs(1), &mut carrying).await {
        Ok(joined) => joined.unwrap_or_else(|e| Err(Broken::Lost(e.to_string()))),
        Err(_) => {
            carrying.abort();
            let _ = carrying.await;
            Ok(())
        }
    };
    Ok(match (ended, carried) {
        (Ended::Lost(_), Err(Broken::Lost(reason))) => Ended::Lost(reason),
        (Ended::Lost(_), Err(Broken::Refused(reason))) => Ended::Refused(reason),
        (ended, _) => ended,
    })
}

/// Carries both streams of a link until either ends; then neither is left, before anybody dials
/// again.
async fn carry(
    channel: Channel,
    bricks_endpoint: Endpoint,
    replies: mpsc::Receiver<ToMaster>,
    control: mpsc::UnboundedSender<ToWorker>,
    bricks: mpsc::Sender<convert::Bricks>,
) -> Result<(), Broken> {
    // Whether results are sent uncompressed, as the last frame asked.
    let uncompressed = Arc::new(AtomicBool::new(false));
    // Encoded on this runtime thread: handing a message to another thread and back takes some 25
    // us (docs/design/transport.md section 0), and the message of a 64x64 tile 35 us. Of the
    // largest tiles it takes 0.6 ms, during which a ping waits.
    let mut replies = replies;
    let Some(hello) = replies.recv().await else { return Ok(()) };
    // A master of any version must be able to read it.
    let hello = tokio_stream::once(convert::from_worker_to_wire(&hello));
    let messages = ReceiverStream::new(replies).map({
        let uncompressed = uncompressed.clone();
        move |message| {
            let compression = match uncompressed.load(Ordering::Relaxed) {
                true => Compression::None,
                false => Compression::Lz4,
            };
            convert::from_worker_to_wire_as(&message, compression)
        }
    });
    let (sealed, opener) = sealed::ends(messages);
    let outbound = hello.chain(sealed);
    let mut told = false;
    let mut client = ClusterServiceClient::new(channel)
        .max_decoding_message_size(MAX_CONTROL_MESSAGE)
        .max_encoding_message_size(MAX_CONTROL_MESSAGE);
    let mut inbound = client.control(outbound).await?.into_inner();
    let mut bricks_stream: Option<tokio::task::JoinHandle<Broken>> = None;
    let carried = loop {
        let bricks_ended = async {
            match &mut bricks_stream {
                Some(task) => task.await.unwrap_or_else(|e| Broken::Lost(e.to_string())),
                None => std::future::pending().await,
            }
        };
        let message = tokio::select! {
            message = inbound.message() => message,
            () = tokio::time::sleep(opener.patience()), if opener.is_waiting() => {
                match opener.ask_again() {
                    Ok(()) => continue,
                    Err(e) => break Err(e.into()),
                }
            }
            broken = bricks_ended => {
                bricks_stream = None;
                break Err(broken);
            }
        };
        let message = match message {
            Ok(Some(message)) => message,
            Ok(None) => break Ok(()),
            Err(status) => break Err(status.into()),
        };
        let message = match message.message {
            // A master of any version may send this, and only this, without a seal.
            Some(control_response::Message::Refused(_)) => message,
            _ => match opener.open(message) {
                Ok(Some(message)) => message,
                Ok(None) => {
                    tell_of_damage("control", opener.damaged(), &mut told);
                    continue;
                }
                Err(e) => break Err(e.into()),
            },
        };
        match convert::to_worker_from_wire(message) {
            Ok((message, session)) => {
                if let ToWorker::Frame { plain, .. } = message {
                    uncompressed.store(plain, Ordering::Relaxed);
                }
                if let Some(session) = session {
                    let (endpoint, to) = (bricks_endpoint.clone(), bricks.clone());
                    bricks_stream = Some(tokio::spawn(carry_bricks(endpoint, session, to)));
                }
                // A session that has ended has sent Goodbye, which would be lost if this stream
                // ended before it left: then the master ends the stream.
                let _ = control.send(message);
            }
            Err(e) => {
                break Err(Broken::Lost(format!("the master sent what can't be read: {e}")));
            }
        }
    };
    if let Some(task) = bricks_stream {
        task.abort();
        let _ = task.await;
    }
    carried
}

/// Carries the Bricks stream; returns why it ended.
async fn carry_bricks(
    endpoint: Endpoint,
    session: u64,
    to: mpsc::Sender<convert::Bricks>,
) -> Broken {
    let lost = |reason: String| Broken::Lost(format!("bricks: {reason}"));
    let channel = match endpoint.connect().await {
        Ok(channel) => channel,
        Err(e) => return lost(format!("no second connection: {}", causes(&e))),
    };
    let mut client =
        ClusterServiceClient::new(channel).max_decoding_message_size(2 * MAX_BRICKS_MESSAGE);
    let open = tokio_stream::once(convert::bricks_open_to_wire(session));
    let (sealed, opener) = sealed::ends(open.chain(tokio_stream::pending()));
    let mut told = false;
    let mut inbound = match client.bricks(sealed).await {
        Ok(response) => response.into_inner(),
        Err(status) => return lost(causes(&status)),
    };
    loop {
        let message = tokio::select! {
            message = inbound.message() => message,
            () = tokio::time::sleep(opener.patience()), if opener.is_waiting() => {
                match opener.ask_again() {
                    Ok(()) => continue,
                    Err(e) => return lost(e.to_string()),
                }
            }
        };
        let opened = match message {
            Ok(Some(message)) => match opener.open(message) {
                Ok(Some(message)) => Ok(Some(message)),
                Ok(None) => {
                    tell_of_damage("bricks", opener.damaged(), &mut told);
                    continue;
                }
                Err(e) => return lost(e.to_string()),
            },
            other => other,
        };
        match opened {
            Ok(Some(message)) => match convert::bricks_from_wire(message) {
                // A session that has ended needs none. This stream ends with Control, which still
                // carries its Goodbye.
                Ok(bricks) => drop(to.send(bricks).await),
                Err(e) => return lost(format!("the master sent what can't be read: {e}")),
            },
            Ok(None) => return lost("the master closed the stream".into()),
            Err(status) => return lost(causes(&status)),
        }
    }
}
