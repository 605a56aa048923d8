//! gRPC: RenderService and ClusterService over TCP, with health and reflection.
//!
//! The accept loop is ours, since tonic's leaves a silent peer connected for ever: a
//! connection has a few seconds to say what it speaks and to send its first request, there is a limit
//! on how many there are and how many one address has, and each has TCP_NODELAY (without it a task
//! costs 40 ms). Every call passes a gate.

mod cluster;
mod connections;
mod gate;
mod peers;
mod render;
mod volumes;

pub use connections::PageConnection;
pub use peers::{PeerLimits, counted_as};
pub use render::notice;

use crate::Handle;
use cluster::Cluster;
use connections::{Connection, accept};
use gate::{Gates, Shared};
use render::Render;
use slabcast_proto::cluster_v1::cluster_service_server::ClusterServiceServer;
use slabcast_proto::render_v1::render_service_server::RenderServiceServer;
use slabcast_proto::{FILE_DESCRIPTOR_SET, MAX_CONTROL_MESSAGE, MAX_RENDER_MESSAGE};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

/// Time that streams may take to end when the master does.
const GOODBYE: Duration = Duration::from_secs(2);

/// A stream of responses.
type Responses<T> = Pin<Box<dyn tokio_stream::Stream<Item = Result<T, Status>> + Send>>;

/// Serves `handle` on `listener` until `stop` turns true.
///
/// # Errors
/// If the reflection service can't be built or the server fails.
pub async fn serve(
    handle: Handle,
    listener: TcpListener,
    stop: watch::Receiver<bool>,
) -> std::io::Result<()> {
    serve_with_pages(handle, listener, stop, None).await
}

/// Serves `handle` like [`serve`], and passes connections that do not speak HTTP/2 to `pages`;
/// without it they are closed.
///
/// # Errors
/// The reflection service can't be built, or the server fails.
pub async fn serve_with_pages(
    handle: Handle,
    listener: TcpListener,
    stop: watch::Receiver<bool>,
    pages: Option<mpsc::Sender<PageConnection>>,
) -> std::io::Result<()> {
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<RenderServiceServer<Render>>().await;
    health.set_serving::<ClusterServiceServer<Cluster>>().await;
    // Both versions: older tools ask for v1alpha alone.
    let reflection_v1 = reflection().build_v1().map_err(std::io::Error::other)?;
    let reflection_alpha = reflection().build_v1alpha().map_err(std::io::Error::other)?;
    let limits = handle.peer_limits();
    let render = RenderServiceServer::new(Render::new(handle.clone()))
        .max_decoding_message_size(MAX_RENDER_MESSAGE)
        .max_encoding_message_size(MAX_RENDER_MESSAGE);
    let cluster = ClusterServiceServer::new(Cluster::new(handle))
        .max_decoding_message_size(MAX_CONTROL_MESSAGE)
        .max_encoding_message_size(MAX_CONTROL_MESSAGE);
    let (accepted, incoming) = mpsc::channel::<std::io::Result<Connection>>(16);
    let accepting = tokio::spawn(accept(listener, accepted, pages, limits));
    let stopped = stopped(stop.clone());
    let server = tonic::transport::Server::builder()
        .initial_stream_window_size(1 << 20)
        .initial_connection_window_size(4 << 20)
        .max_frame_size(64 * 1024)
        .max_concurrent_streams(32)
        // Streams that a client opened and reset before they were looked at. With h2's 20 a client
        // that cancels 64 calls at a time lost its connection every 150 calls, with 128 every 500;
        // at 1024 four floods took 130 MiB. A flood of resets fills a socket with thousands and
        // still loses it.
        .http2_max_pending_accept_reset_streams(Some(256))
        .http2_max_header_list_size(16 * 1024)
        .http2_keepalive_interval(Some(Duration::from_secs(10)))
        .http2_keepalive_timeout(Some(Duration::from_secs(5)))
        .layer(Gates(Arc::new(Shared::new(&limits))))
        .add_service(health_service)
        .add_service(reflection_v1)
        .add_service(reflection_alpha)
        .add_service(render)
        .add_service(cluster)
        .serve_with_incoming_shutdown(ReceiverStream::new(incoming), stopped);
    let overdue = async {
        self::stopped(stop).await;
        tokio::time::sleep(GOODBYE).await;
    };
    let outcome = tokio::select! {
        outcome = server => outcome.map_err(std::io::Error::other),
        () = overdue => Ok(()),
    };
    accepting.abort();
    outcome
}

/// Describes our services, health, and the error details that statuses carry.
fn reflection() -> tonic_reflection::server::Builder<'static> {
    tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_types::pb::FILE_DESCRIPTOR_SET)
}

async fn stopped(mut stop: watch::Receiver<bool>) {
    // A sender that is gone means stop as well.
    let _ = stop.wait_for(|s| *s).await;
}
