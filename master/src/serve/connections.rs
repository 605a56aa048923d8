//! The accept loop, and connections that count against a limit.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tonic::transport::server::{Connected, TcpConnectInfo};
use tracing::{debug, warn};

/// Connections at a time. One worker takes two; 16 KiB each when idle.
const MAX_CONNECTIONS: usize = 4096;

/// Time that a connection may take to send its HTTP/2 preface (24 bytes).
const PREFACE: Duration = Duration::from_secs(3);

/// A connection that counts against the limit while it lives.
pub(super) struct Connection {
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

/// Accepts connections for ever and passes on those that sent their preface in time.
pub(super) async fn accept(
    listener: TcpListener,
    accepted: mpsc::Sender<std::io::Result<Connection>>,
) {
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
