//! HTTP/1.1 connections of browsers: checks, routes and headers.
//!
//! Addresses are relative, and proxies put the page under any prefix, so a path counts from its last
//! `/v1/`, or from its last `/` for files of the page.

use crate::assets;
use crate::files::Files;
use crate::http;
use crate::problem::Problem;
use crate::session;
use crate::shared::{LiveConfig, Shared};
use crate::write_limit::WriteLimit;
use axum::body::{Body, to_bytes};
use axum::extract::FromRequestParts;
use axum::extract::ws::WebSocketUpgrade;
use axum::http::{HeaderMap, HeaderValue, Method, Request, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use serde_json::Value;
use slabcast_master::Handle;
use slabcast_master::serve::{PageConnection, counted_as};
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tracing::debug;

/// Time for the head of a request, also while a connection has none.
const HEAD: Duration = Duration::from_secs(10);

/// Time for the body of a request.
const BODY: Duration = Duration::from_secs(60);

/// Connections of browsers at a time. A page has a socket and up to six others.
const CONNECTIONS: usize = 512;

/// Connections of one address at a time, enough for some twenty pages. A connection that reads nothing
/// keeps its place, so no address may take all.
const CONNECTIONS_OF_PEER: usize = 128;

/// Time after which a connection whose client takes no byte of an answer is given up.
const STUCK: Duration = Duration::from_secs(60);

/// Bytes of a request's head.
const HEAD_BYTES: usize = 32 << 10;

/// Time that connections may take to end when the master does.
const GOODBYE: Duration = Duration::from_secs(2);

/// Bytes of the longest message that is read at all: of one that is too long the session tells, and only
/// of one that was read can it.
const SOCKET_BYTES: usize = 2 << 20;

/// Bytes that are read from a socket at a time. Each session holds so many; messages of a hand that
/// moves have 200, and longer ones come in pieces.
const READ_BYTES: usize = 4 << 10;

/// An answer, or a refusal.
pub(crate) type Answer = Result<Response, Problem>;

/// Serves the page of `handle` on connections that [`slabcast_master::serve::serve_with_pages`]
/// passes on, until `stop` turns true. `files` writes pictures and movies that people keep.
pub async fn serve(
    handle: Handle,
    config: LiveConfig,
    files: Arc<dyn Files>,
    mut connections: mpsc::Receiver<PageConnection>,
    mut stop: watch::Receiver<bool>,
) {
    let shared = Arc::new(Shared::new(handle, config, files, stop.clone()));
    tokio::spawn(session::prepare(shared.clone()));
    let mut of_peers: BTreeMap<IpAddr, usize> = BTreeMap::new();
    let mut open = JoinSet::new();
    loop {
        let connection = tokio::select! {
            connection = connections.recv() => connection,
            Some(ended) = open.join_next() => {
                // A connection that panicked keeps its place; none does.
                if let Ok(peer) = ended
                    && let Some(own) = of_peers.get_mut(&peer)
                {
                    *own -= 1;
                    of_peers.retain(|_, own| *own > 0);
                }
                continue;
            }
            () = stopped(&mut stop) => break,
        };
        let Some(connection) = connection else { break };
        let peer = counted_as(connection.peer().ip());
        let own = of_peers.entry(peer).or_default();
        if open.len() >= CONNECTIONS || *own >= CONNECTIONS_OF_PEER {
            debug!(from = %connection.peer(), "page's connection turned away: too many");
            continue;
        }
        *own += 1;
        let (shared, stop) = (shared.clone(), stop.clone());
        open.spawn(async move {
            talk(shared, connection, stop).await;
            peer
        });
    }
    let ended = async { while open.join_next().await.is_some() {} };
    let _ = tokio::time::timeout(GOODBYE, ended).await;
    // Sessions say goodbye.
    let _ = tokio::time::timeout(GOODBYE, shared.sessions.all_free()).await;
}

/// Answers the requests of one connection.
async fn talk(shared: Arc<Shared>, connection: PageConnection, mut stop: watch::Receiver<bool>) {
    let caller = Caller { peer: connection.peer(), local: connection.local().ok() };
    let service = service_fn(move |request: Request<Incoming>| {
        let shared = shared.clone();
        async move { Ok::<_, Infallible>(answer(shared, caller, request.map(Body::new)).await) }
    });
    let talking = hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD)
        .max_buf_size(HEAD_BYTES.max(64 << 10))
        .serve_connection(TokioIo::new(WriteLimit::new(connection, STUCK)), service)
        .with_upgrades();
    let mut talking = std::pin::pin!(talking);
    let ended = tokio::select! {
        ended = talking.as_mut() => ended,
        () = stopped(&mut stop) => {
            talking.as_mut().graceful_shutdown();
            talking.await
        }
    };
    if let Err(e) = ended {
        debug!(from = %caller.peer, error = %e, "page's connection ended");
    }
}

/// Waits until the master ends.
pub(crate) async fn stopped(stop: &mut watch::Receiver<bool>) {
    // A sender that is gone means stop as well.
    let _ = stop.wait_for(|stop| *stop).await;
}

/// Addresses of a request: the caller's, and the one of this machine that it called.
#[derive(Clone, Copy)]
pub(crate) struct Caller {
    pub(crate) peer: SocketAddr,
    local: Option<SocketAddr>,
}

/// First words of calls.
const CALLS: [&str; 6] = ["live", "picture", "movie", "jobs", "states", "uploads"];

/// Returns the part of a path that counts: behind its last `/v1/` (`true`), or its last part.
fn route(path: &str) -> (bool, &str) {
    if let Some((_, call)) = path.rsplit_once("/v1/")
        && call.split('/').next().is_some_and(|word| CALLS.contains(&word))
    {
        return (true, call);
    }
    (false, path.rsplit('/').next().unwrap_or_default())
}

async fn answer(shared: Arc<Shared>, caller: Caller, request: Request<Body>) -> Response {
    let host = header_of(request.headers(), &header::HOST).to_owned();
    let answered = checked(&shared, caller, &host, request).await;
    let mut response = answered.unwrap_or_else(|problem| {
        let mut response = json_answer(problem.status(), &problem.body());
        if let Some(ms) = problem.retry_ms {
            let seconds = HeaderValue::from(u64::from(ms).div_ceil(1000));
            response.headers_mut().insert(header::RETRY_AFTER, seconds);
        }
        response
    });
    set_headers(response.headers_mut(), &host);
    response
}

fn header_of<'a>(headers: &'a HeaderMap, name: &header::HeaderName) -> &'a str {
    headers.get(name).and_then(|value| value.to_str().ok()).unwrap_or_default()
}

/// Sets what every answer has (docs/reference/live.md; master/page/README.md).
fn set_headers(headers: &mut HeaderMap, host: &str) {
    // A `Host` that is no host has been refused; here it must not break out of the policy.
    let is_plain = host.bytes().all(|b| b.is_ascii_alphanumeric() || b".-:[]".contains(&b));
    let host = if is_plain && !host.is_empty() { host } else { "localhost" };
    let policy = format!(
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src \
         'self' ws://{host} wss://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
    );
    if let Ok(policy) = HeaderValue::from_str(&policy) {
        headers.insert(header::CONTENT_SECURITY_POLICY, policy);
    }
    let fixed = [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
        (header::HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ];
    for (name, value) in fixed {
        headers.insert(name, HeaderValue::from_static(value));
    }
    if !headers.contains_key(header::CACHE_CONTROL) {
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    }
}

/// Checks who calls, and answers.
async fn checked(
    shared: &Arc<Shared>,
    caller: Caller,
    host: &str,
    request: Request<Body>,
) -> Answer {
    let guard = &shared.guard;
    if !guard.knows_host(host, caller.local) {
        return Err(Problem::new(
            "not_allowed",
            format!(
                "this master is not known as `{}`; call it by its address, or start it with \
                 --allowed-host",
                host.chars().filter(|c| !c.is_control()).take(100).collect::<String>()
            ),
        ));
    }
    let origin = request.headers().get(header::ORIGIN).map(|v| v.to_str().unwrap_or("null"));
    if origin.is_some_and(|origin| !guard.knows_origin(origin, host)) {
        return Err(Problem::new(
            "not_allowed",
            "pages of other sites may not call this master; open its own page, or start it with \
             --allowed-host",
        ));
    }
    let (is_call, path) = route(request.uri().path());
    let path = path.to_owned();
    if !is_call {
        if *request.method() != Method::GET && *request.method() != Method::HEAD {
            return Err(Problem::new("not_found", "there is no such call; GET is all there is"));
        }
        let asset = assets::named(&path);
        let missing = || Problem::new("not_found", format!("the page has no file `{path}`"));
        return asset.map(|asset| asset.answer(request.headers())).ok_or_else(missing);
    }
    if path == "live" && *request.method() == Method::GET {
        return upgrade(shared.clone(), caller, request).await;
    }
    let bearer = header_of(request.headers(), &header::AUTHORIZATION).strip_prefix("Bearer ");
    if !guard.knows_token(bearer) {
        let why = "the token is missing or unknown; open the address that the master printed";
        return Err(Problem::new("unauthorized", why));
    }
    http::call(shared, caller, &path, request).await
}

/// Turns a request into a live session.
async fn upgrade(shared: Arc<Shared>, caller: Caller, request: Request<Body>) -> Answer {
    let (mut parts, _) = request.into_parts();
    let upgrade = match WebSocketUpgrade::from_request_parts(&mut parts, &()).await {
        Ok(upgrade) => upgrade,
        Err(refused) => return Ok(refused.into_response()),
    };
    let upgrade = upgrade
        .max_message_size(SOCKET_BYTES)
        .max_frame_size(SOCKET_BYTES)
        .read_buffer_size(READ_BYTES)
        .write_buffer_size(0)
        .max_write_buffer_size(8 << 20);
    let peer = Some(caller.peer.ip());
    Ok(upgrade.on_upgrade(move |socket| session::run(shared, socket, peer)))
}

/// Reads a body of at most `most` bytes.
///
/// # Errors
/// It is longer, comes too slowly or breaks off.
pub(crate) async fn body_of(request: Request<Body>, most: usize) -> Result<Bytes, Problem> {
    let too_large = || {
        let text = format!("the body is longer than {} KiB; send less", most.div_ceil(1024));
        Problem::new("too_large", text)
    };
    let told = header_of(request.headers(), &header::CONTENT_LENGTH).parse::<u64>();
    if told.is_ok_and(|told| told > most as u64) {
        return Err(too_large());
    }
    let read = tokio::time::timeout(BODY, to_bytes(request.into_body(), most)).await;
    let late =
        |_| Problem::new("invalid_field", "the body did not come whole in time; send it again");
    read.map_err(late)?.map_err(|e| {
        let is_long =
            std::error::Error::source(&e).is_some_and(|s| s.to_string().contains("length limit"));
        if is_long {
            too_large()
        } else {
            Problem::new("invalid_field", format!("the body broke off: {e}"))
        }
    })
}

/// Makes an answer of JSON.
pub(crate) fn json_answer(status: StatusCode, value: &Value) -> Response {
    let mut response = Response::new(Body::from(value.to_string()));
    *response.status_mut() = status;
    let kind = HeaderValue::from_static("application/json");
    response.headers_mut().insert(header::CONTENT_TYPE, kind);
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_count_from_any_prefix() {
        assert_eq!(route("/"), (false, ""));
        assert_eq!(route("/node/host/7433/"), (false, ""));
        assert_eq!(route("/user/v1/proxy/app.js"), (false, "app.js"));
        assert_eq!(route("/a/b/main.css"), (false, "main.css"));
        assert_eq!(route("/v1/live"), (true, "live"));
        assert_eq!(route("/node/7/v1/states/abc"), (true, "states/abc"));
    }
}
