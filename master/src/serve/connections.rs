//! The accept loop, and connections that count against a limit.

use super::peers::{Counts, PeerLimits, Place, Rarely};
use std::io::ErrorKind;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::time::{Instant, Sleep};
use tonic::transport::server::{Connected, TcpConnectInfo};
use tracing::debug;

/// Connections at a time. One worker takes two; 16 KiB each when idle.
const MAX_CONNECTIONS: usize = 4096;

/// Places among them that are kept for workers: a connection beyond the others has the patience of
/// [`PeerLimits`] to be one.
const KEPT_FOR_WORKERS: usize = 256;

/// Time that a connection may take to say what it speaks: 24 bytes of HTTP/2, or one of another.
const PREFACE: Duration = Duration::from_secs(3);

/// Time for which a connection that has been of use may have no call.
const IDLE: Duration = Duration::from_secs(600);

/// Age, use and deadlines of a connection.
pub(super) struct State {
    since: Instant,
    patience: Duration,
    /// Whether it has one of the places that are kept for workers.
    is_provisional: bool,
    is_worker: AtomicBool,
    /// Whether a call of it was answered.
    is_known: AtomicBool,
    /// Streams that are open, and those of them that are not of our services.
    open: AtomicUsize,
    beside: AtomicUsize,
    /// When its last stream ended.
    idle_since: Mutex<Instant>,
}

impl State {
    fn new(is_provisional: bool, patience: Duration) -> State {
        let since = Instant::now();
        State {
            since,
            patience,
            is_provisional,
            is_worker: AtomicBool::new(false),
            is_known: AtomicBool::new(false),
            open: AtomicUsize::new(0),
            beside: AtomicUsize::new(0),
            idle_since: Mutex::new(since),
        }
    }

    /// Notes that a stream begins; it lasts as long as what is returned.
    pub(super) fn begin(self: &Arc<Self>, is_beside: bool) -> Stay {
        self.open.fetch_add(1, Ordering::Relaxed);
        let beside = if is_beside { self.beside.fetch_add(1, Ordering::Relaxed) + 1 } else { 0 };
        Stay { state: self.clone(), is_beside, beside }
    }

    /// Notes that a call was answered.
    pub(super) fn is_known(&self) {
        self.is_known.store(true, Ordering::Relaxed);
    }

    /// Notes that a worker calls.
    pub(super) fn is_worker(&self) {
        self.is_worker.store(true, Ordering::Relaxed);
        self.is_known();
    }

    /// When the connection ends unless something happens, and why.
    fn end(&self) -> Option<(Instant, &'static str)> {
        if self.is_provisional && !self.is_worker.load(Ordering::Relaxed) {
            return Some((self.since + self.patience, "the last places are kept for workers"));
        }
        if self.open.load(Ordering::Relaxed) > 0 {
            return None;
        }
        let idle_since = *self.idle_since.lock().unwrap_or_else(PoisonError::into_inner);
        if self.is_known.load(Ordering::Relaxed) {
            Some((idle_since + IDLE, "no call in 10 min"))
        } else {
            Some((idle_since + self.patience, "no whole request in time"))
        }
    }
}

/// A stream that is open.
pub(super) struct Stay {
    state: Arc<State>,
    is_beside: bool,
    /// Streams of other services on its connection, itself included; 0 if it is of ours.
    pub(super) beside: usize,
}

impl Drop for Stay {
    fn drop(&mut self) {
        let mut idle_since = self.state.idle_since.lock().unwrap_or_else(PoisonError::into_inner);
        *idle_since = Instant::now();
        self.state.open.fetch_sub(1, Ordering::Relaxed);
        self.state.beside.fetch_sub(usize::from(self.is_beside), Ordering::Relaxed);
    }
}

/// Client of a request: its connection, kept in the request's extensions.
#[derive(Clone)]
pub(super) struct Peer {
    pub(super) tcp: TcpConnectInfo,
    pub(super) state: Arc<State>,
}

impl Peer {
    /// The address of the caller.
    pub(super) fn ip(&self) -> Option<IpAddr> {
        self.tcp.remote_addr().map(|address| address.ip())
    }
}

/// A connection that counts against the limits while it lives, and ends when it is of no use.
pub(super) struct Connection {
    io: TcpStream,
    state: Arc<State>,
    alarm: Pin<Box<Sleep>>,
    _place: OwnedSemaphorePermit,
    _share: Place,
}

impl Connected for Connection {
    type ConnectInfo = Peer;
    fn connect_info(&self) -> Peer {
        Peer { tcp: self.io.connect_info(), state: self.state.clone() }
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<std::io::Result<()>> {
        let before = buf.filled().len();
        let read = Pin::new(&mut self.io).poll_read(cx, buf);
        let Some((end, why)) = self.state.end() else { return read };
        // Bytes that trickle make no request whole, so they put nothing off.
        if read.is_pending() || (buf.filled().len() > before && Instant::now() >= end) {
            if self.alarm.deadline() != end {
                self.alarm.as_mut().reset(end);
            }
            if self.alarm.as_mut().poll(cx).is_ready() {
                let from = self.io.peer_addr().map(|a| a.to_string()).unwrap_or_default();
                debug!(from, why, "connection closed");
                return Poll::Ready(Err(std::io::Error::new(ErrorKind::TimedOut, why)));
            }
        }
        read
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

/// A connection whose first bytes are no HTTP/2 preface, from [`super::serve_with_pages`]: a browser's,
/// which speaks HTTP/1.1. It counts against the limits of connections while it lives.
pub struct PageConnection {
    io: TcpStream,
    peer: SocketAddr,
    _place: OwnedSemaphorePermit,
    _share: Place,
}

impl PageConnection {
    /// Address of the caller.
    pub fn peer(&self) -> SocketAddr {
        self.peer
    }

    /// Address of this machine that was called.
    ///
    /// # Errors
    /// The connection is gone.
    pub fn local(&self) -> std::io::Result<SocketAddr> {
        self.io.local_addr()
    }
}

impl AsyncRead for PageConnection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.io).poll_read(cx, buf)
    }
}

impl AsyncWrite for PageConnection {
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

/// Accepts connections for ever and passes on those that said in time what they speak: HTTP/2 to
/// `accepted`, all else to `pages`.
pub(super) async fn accept(
    listener: TcpListener,
    accepted: mpsc::Sender<std::io::Result<Connection>>,
    pages: Option<mpsc::Sender<PageConnection>>,
    limits: PeerLimits,
) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let PeerLimits { connections: most_of_a_peer, patience, .. } = limits;
    let shares = Arc::<Counts>::default();
    let [failed, full, greedy] = [(); 3].map(|()| Rarely::default());
    loop {
        let (io, from) = match listener.accept().await {
            Ok(pair) => pair,
            Err(e) => {
                // Out of descriptors, or a peer that was gone at once: both pass.
                failed.warn(None, "accept failed", &e.to_string());
                tokio::time::sleep(Duration::from_millis(50)).await;
                continue;
            }
        };
        let Ok(place) = places.clone().try_acquire_owned() else {
            let why = format!("{MAX_CONNECTIONS} connections, as many as this master takes");
            full.warn(Some(from.ip()), "connection turned away", &why);
            continue;
        };
        let Some(share) = shares.take(from.ip(), most_of_a_peer) else {
            let why = format!(
                "{most_of_a_peer} connections from one address, as many as it may have; see \
                 --peer-connections"
            );
            greedy.warn(Some(from.ip()), "connection turned away", &why);
            continue;
        };
        if let Err(e) = io.set_nodelay(true) {
            debug!(%from, error = %e, "connection lost at once");
            continue;
        }
        let (accepted, pages) = (accepted.clone(), pages.clone());
        let is_provisional = places.available_permits() < KEPT_FOR_WORKERS;
        tokio::spawn(async move {
            match tokio::time::timeout(PREFACE, speaks(&io)).await {
                Ok(Some(Speaks::Http2)) => {
                    let connection = Connection {
                        io,
                        state: Arc::new(State::new(is_provisional, patience)),
                        alarm: Box::pin(tokio::time::sleep(patience)),
                        _place: place,
                        _share: share,
                    };
                    let _ = accepted.send(Ok(connection)).await;
                }
                Ok(Some(Speaks::Other)) => match pages {
                    // The last places are kept for workers.
                    Some(pages) if !is_provisional => {
                        let connection =
                            PageConnection { io, peer: from, _place: place, _share: share };
                        let _ = pages.send(connection).await;
                    }
                    _ => debug!(%from, "connection closed: it does not speak HTTP/2"),
                },
                Ok(None) => debug!(%from, "connection closed before its preface"),
                Err(_) => debug!(%from, "connection dropped: no preface in time"),
            }
        });
    }
}

/// First bytes of an HTTP/2 connection.
const PREFACE_BYTES: &[u8; 24] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Protocol of a connection, told by its first bytes.
enum Speaks {
    Http2,
    Other,
}

/// Waits until the first bytes say what a connection speaks; `None` if the peer is gone.
async fn speaks(io: &TcpStream) -> Option<Speaks> {
    let mut bytes = [0; 24];
    loop {
        match io.peek(&mut bytes).await {
            Ok(0) | Err(_) => return None,
            Ok(n) if bytes[..n] != PREFACE_BYTES[..n] => return Some(Speaks::Other),
            Ok(24) => return Some(Speaks::Http2),
            // Readable, but not whole: `peek` would return at once again.
            Ok(_) => tokio::time::sleep(Duration::from_millis(20)).await,
        }
    }
}
