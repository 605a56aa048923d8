//! The TCP link: two connections to the master, and the patience to come back.
//!
//! Control and bricks travel on connections of their own, so that a lease never queues behind
//! a megabyte of bricks (at 1 Gb/s that is 22 ms instead of 1.4). The streams are carried to
//! and from the same channels that an embedded link has; [`crate::session`] can't tell.

use crate::cache::BrickCache;
use crate::session::{self, Config, Ended, Link};
use slabcast_common::link::BRICK_BATCHES_IN_FLIGHT;
use slabcast_common::message::ToWorker;
use slabcast_proto::convert;
use slabcast_proto::v1::cluster_client::ClusterClient;
use slabcast_proto::{MAX_BRICKS_MESSAGE, MAX_CONTROL_MESSAGE};
use std::hash::{BuildHasher, Hasher};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::{Channel, Endpoint};
use tracing::{info, warn};

/// How long a connection may take.
const CONNECT: Duration = Duration::from_secs(5);
/// First and longest wait before dialling again (cluster.proto).
const WAIT: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));
/// Serves the master at `master` (`host:port`) until `stop` turns true or the master refuses
/// this worker. A master that is not there, or leaves, is dialled again for ever; bricks are
/// kept meanwhile.
///
/// # Errors
/// A master address that can't be one, or a system that gives no threads.
pub async fn run(
    config: Config,
    master: String,
    mut stop: watch::Receiver<bool>,
) -> Result<Ended, String> {
    let uri = if master.contains("://") { master.clone() } else { format!("http://{master}") };
    let endpoint = Endpoint::from_shared(uri)
        .map_err(|e| format!("master address `{master}`: {e}; give HOST:PORT"))?
        .connect_timeout(CONNECT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(Duration::from_secs(10))
        .keep_alive_timeout(Duration::from_secs(5));
    let mut cache = BrickCache::default();
    let mut wait = WAIT.0;
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
                info!(master, bricks = cache.len(), "connected");
                told = false;
                let before = tokio::time::Instant::now();
                let ended = link(&config, &endpoint, channel, &mut cache, stop.clone()).await?;
                match ended {
                    Ended::Refused(_) | Ended::Stopped => return Ok(ended),
                    Ended::Lost(reason) => warn!(master, reason, "link lost, dialling again"),
                    Ended::MasterLeft(reason) => info!(master, reason, "waiting for the master"),
                }
                if before.elapsed() > WAIT.1 {
                    wait = WAIT.0;
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
        let nap = wait.mul_f64(1.0 - 0.5 * fraction());
        tokio::select! { () = tokio::time::sleep(nap) => {}, _ = stop.changed() => {} }
        wait = (wait * 2).min(WAIT.1);
    }
}

fn control_endpoint(endpoint: &Endpoint) -> Endpoint {
    endpoint
        .clone()
        .initial_stream_window_size(1 << 20)
        .initial_connection_window_size(4 << 20)
        .max_frame_size(64 * 1024)
}

/// Small windows: what is on its way on this connection is bandwidth times round trip, and
/// more than that only queues in the network.
fn bricks_endpoint(endpoint: &Endpoint) -> Endpoint {
    endpoint
        .clone()
        .initial_stream_window_size(1 << 20)
        .initial_connection_window_size(1 << 20)
        .max_frame_size(64 * 1024)
}

/// A number in [0, 1) that differs from worker to worker.
fn fraction() -> f64 {
    let mut h = std::hash::RandomState::new().build_hasher();
    h.write_u64(1);
    (h.finish() >> 11) as f64 / (1u64 << 53) as f64
}

/// An error with what lies behind it: tonic's own text is just "transport error".
fn causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(e) = next {
        text = format!("{text}: {e}");
        next = e.source();
    }
    text
}

/// One link, from hello to its end.
async fn link(
    config: &Config,
    endpoint: &Endpoint,
    channel: Channel,
    cache: &mut BrickCache,
    stop: watch::Receiver<bool>,
) -> Result<Ended, String> {
    let (replies, reply_rx) = mpsc::channel(64);
    // Unbounded, bounded by the leases that the master gives and its pings.
    let (control_tx, control) = mpsc::unbounded_channel();
    let (bricks_tx, bricks) = mpsc::channel(BRICK_BATCHES_IN_FLIGHT);
    // Whether results go as they are, by the frame that came last.
    let plain = Arc::new(AtomicBool::new(false));
    let as_is = plain.clone();
    let outbound = ReceiverStream::new(reply_rx).map(move |message| {
        convert::from_worker_to_wire_as(&message, !as_is.load(Ordering::Relaxed))
    });
    let bricks_endpoint = bricks_endpoint(endpoint);
    let mut carrying = tokio::spawn(async move {
        let mut client = ClusterClient::new(channel)
            .max_decoding_message_size(MAX_CONTROL_MESSAGE)
            .max_encoding_message_size(MAX_CONTROL_MESSAGE);
        let mut inbound = client.control(outbound).await.map_err(|e| causes(&e))?.into_inner();
        let mut bricks_stream: Option<tokio::task::JoinHandle<String>> = None;
        let carried = loop {
            let bricks_ended = async {
                match &mut bricks_stream {
                    Some(task) => task.await.unwrap_or_else(|e| e.to_string()),
                    None => std::future::pending().await,
                }
            };
            let message = tokio::select! {
                message = inbound.message() => message,
                reason = bricks_ended => {
                    bricks_stream = None;
                    break Err(reason);
                }
            };
            let message = match message {
                Ok(Some(message)) => message,
                Ok(None) => break Ok(()),
                Err(status) => break Err(status.message().to_string()),
            };
            match convert::to_worker_from_wire(message) {
                Ok((message, session)) => {
                    if let ToWorker::Frame { plain: told, .. } = message {
                        plain.store(told, Ordering::Relaxed);
                    }
                    if let Some(session) = session {
                        let (endpoint, to) = (bricks_endpoint.clone(), bricks_tx.clone());
                        bricks_stream = Some(tokio::spawn(carry_bricks(endpoint, session, to)));
                    }
                    // A desk that is gone has said good-bye, which is lost if the stream ends before it
                    // has left: then the master ends the stream.
                    let _ = control_tx.send(message);
                }
                Err(e) => break Err(format!("the master sent what can't be read: {e}")),
            }
        };
        // Both streams end together, before anybody dials again.
        if let Some(task) = bricks_stream {
            task.abort();
            let _ = task.await;
        }
        carried
    });
    let ended = session::run(config, Link { control, replies, bricks }, cache, stop).await;
    let ended = ended.map_err(|e| format!("render threads: {e}"))?;
    // The desk dropped its ends. What it said last still leaves; then the streams are over.
    let carried = match tokio::time::timeout(Duration::from_secs(1), &mut carrying).await {
        Ok(joined) => joined.unwrap_or_else(|e| Err(e.to_string())),
        Err(_) => {
            carrying.abort();
            let _ = carrying.await;
            Ok(())
        }
    };
    Ok(match (ended, carried) {
        (Ended::Lost(_), Err(reason)) => Ended::Lost(reason),
        (ended, _) => ended,
    })
}

/// Carries the Bricks stream; returns why it ended.
async fn carry_bricks(
    endpoint: Endpoint,
    session: u64,
    to: mpsc::Sender<convert::Bricks>,
) -> String {
    let channel = match endpoint.connect().await {
        Ok(channel) => channel,
        Err(e) => return format!("no second connection for bricks: {}", causes(&e)),
    };
    let mut client = ClusterClient::new(channel).max_decoding_message_size(2 * MAX_BRICKS_MESSAGE);
    let open = tokio_stream::once(convert::bricks_open_to_wire(session));
    let outbound = open.chain(tokio_stream::pending());
    let mut inbound = match client.bricks(outbound).await {
        Ok(response) => response.into_inner(),
        Err(status) => return format!("bricks: {}", status.message()),
    };
    loop {
        match inbound.message().await {
            Ok(Some(message)) => match convert::bricks_from_wire(message) {
                // A desk that is gone needs none. This stream ends with the other, which still carries its good-bye.
                Ok(bricks) => drop(to.send(bricks).await),
                Err(e) => return format!("the master sent bricks that can't be read: {e}"),
            },
            Ok(None) => return "the master closed the bricks stream".into(),
            Err(status) => return format!("bricks: {}", status.message()),
        }
    }
}
