//! Limits that every call of either service passes.
//!
//! - A request comes whole within the patience of [`PeerLimits`], and all that are on their way together take at most
//!   [`ARRIVING_BYTES`]; streams of workers are exempt, as they never end.
//! - A connection has at most [`BESIDE`] streams of health and reflection.
//! - What can't be decoded is the caller's mistake, not ours: INVALID_ARGUMENT.
//! - A refusal is one line in the log, with the address.

use super::connections::{Peer, Stay};
use super::peers::{PeerLimits, Rarely};
use http_body::Body as HttpBody;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::time::Sleep;
use tonic::body::Body;
use tonic::codegen::http::{HeaderValue, Request, Response};
use tonic::codegen::{Bytes, Service, StdError};
use tonic::{Code, Status};

/// Bytes of all requests that are on their way: sixteen of the longest.
const ARRIVING_BYTES: usize = 64 << 20;

/// Streams of health and reflection on one connection. A prober has one, a browser of services a
/// few.
const BESIDE: usize = 4;

/// State that all connections share.
pub(super) struct Shared {
    patience: Duration,
    arriving: AtomicUsize,
    refusals: Rarely,
}

impl Shared {
    pub(super) fn new(limits: &PeerLimits) -> Shared {
        let (arriving, refusals) = Default::default();
        Shared { patience: limits.patience, arriving, refusals }
    }
}

/// Makes gates; a layer for tonic's server.
#[derive(Clone)]
pub(super) struct Gates(pub(super) Arc<Shared>);

impl<S> tower_layer::Layer<S> for Gates {
    type Service = Gate<S>;
    fn layer(&self, inner: S) -> Gate<S> {
        Gate { inner, shared: self.0.clone() }
    }
}

/// See the head of the file.
#[derive(Clone)]
pub(super) struct Gate<S> {
    inner: S,
    shared: Arc<Shared>,
}

impl<S> Service<Request<Body>> for Gate<S>
where
    S: Service<Request<Body>, Response = Response<Body>> + Send + 'static,
    S::Future: Send + 'static,
    S::Error: Into<StdError> + Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Response<Body>, S::Error>> + Send>>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(cx)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        let peer = request.extensions().get::<Peer>().cloned();
        let path = request.uri().path().to_string();
        let is_ours = path.starts_with("/slabcast.");
        let is_worker = path.starts_with("/slabcast.cluster.");
        if let Some(peer) = &peer {
            // tonic's requests read the peer's address from this extension.
            request.extensions_mut().insert(peer.tcp.clone());
        }
        let ip = peer.as_ref().and_then(|peer| peer.ip());
        let shared = self.shared.clone();
        let stay = peer.as_ref().map(|peer| peer.state.begin(!is_ours));
        if stay.as_ref().is_some_and(|stay| stay.beside > BESIDE) {
            let status = Status::resource_exhausted(format!(
                "{BESIDE} streams of health and reflection are open on this connection; end one"
            ));
            refused(&shared, ip, &path, status.code(), status.message());
            return Box::pin(async move { Ok(status.into_http()) });
        }
        if !is_worker {
            request = request.map(|body| {
                Body::new(Arriving {
                    inner: body,
                    late: Box::pin(tokio::time::sleep(shared.patience)),
                    taken: 0,
                    is_whole: false,
                    shared: shared.clone(),
                })
            });
        }
        let answer = self.inner.call(request);
        Box::pin(async move {
            let mut response = answer.await?;
            let told = Status::from_header_map(response.headers());
            match told.filter(|status| status.code() != Code::Ok) {
                Some(status) => {
                    let code = if is_garbled(&status) {
                        response
                            .headers_mut()
                            .insert(Status::GRPC_STATUS, HeaderValue::from_static("3"));
                        Code::InvalidArgument
                    } else {
                        status.code()
                    };
                    refused(&shared, ip, &path, code, status.message());
                }
                None if is_ours && !is_worker => peer.iter().for_each(|peer| peer.state.is_known()),
                None => {}
            }
            Ok(response.map(|body| Body::new(Leaving { inner: body, _stay: stay })))
        })
    }
}

/// Whether a request could not be decoded.
fn is_garbled(status: &Status) -> bool {
    status.code() == Code::Internal
        && status.message().starts_with("failed to decode Protobuf message")
}

fn refused(shared: &Shared, peer: Option<IpAddr>, path: &str, code: Code, why: &str) {
    // Asking for a job that is gone, or watching past the end, is no refusal.
    if matches!(code, Code::NotFound | Code::OutOfRange | Code::Unavailable | Code::Cancelled) {
        return;
    }
    let call = path.rsplit('/').next().unwrap_or_default();
    let why = format!("{call}: {code:?}: {why}").replace(char::is_control, " ");
    let why: String = why.chars().take(300).collect();
    shared.refusals.warn(peer, "request refused", &why);
}

/// A request on its way.
struct Arriving {
    inner: Body,
    late: Pin<Box<Sleep>>,
    /// Bytes that were counted.
    taken: usize,
    is_whole: bool,
    shared: Arc<Shared>,
}

impl HttpBody for Arriving {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        match Pin::new(&mut self.inner).poll_frame(cx) {
            Poll::Ready(Some(Ok(frame))) => {
                let n = frame.data_ref().map_or(0, Bytes::len);
                self.taken += n;
                if self.shared.arriving.fetch_add(n, Ordering::Relaxed) + n > ARRIVING_BYTES {
                    let status = Status::resource_exhausted(format!(
                        "requests on their way take {} MiB, as much as this master takes; call \
                         again later",
                        ARRIVING_BYTES >> 20
                    ));
                    return Poll::Ready(Some(Err(status)));
                }
                Poll::Ready(Some(Ok(frame)))
            }
            Poll::Ready(other) => {
                self.is_whole = true;
                Poll::Ready(other)
            }
            Poll::Pending if !self.is_whole => self.late.as_mut().poll(cx).map(|()| {
                let why =
                    format!("the request was not whole in {:?}; call again", self.shared.patience);
                Some(Err(Status::deadline_exceeded(why)))
            }),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl Drop for Arriving {
    fn drop(&mut self) {
        self.shared.arriving.fetch_sub(self.taken, Ordering::Relaxed);
    }
}

/// A response on its way, which keeps its connection.
struct Leaving {
    inner: Body,
    _stay: Option<Stay>,
}

impl HttpBody for Leaving {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        Pin::new(&mut self.inner).poll_frame(cx)
    }

    fn is_end_stream(&self) -> bool {
        self.inner.is_end_stream()
    }

    fn size_hint(&self) -> http_body::SizeHint {
        self.inner.size_hint()
    }
}
