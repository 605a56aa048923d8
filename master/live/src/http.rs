//! Calls over HTTP beside the socket: pictures and movies to keep, states, results of jobs.

use crate::files::{MadeFile, Recipe};
use crate::picture::frame_of;
use crate::problem::Problem;
use crate::server::{Answer, Caller, body_of, json_answer};
use crate::shared::Shared;
use crate::tile::hex;
use crate::uploads;
use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, Request, StatusCode, header};
use axum::response::Response;
use bytes::Bytes;
use serde::Deserialize;
use serde_json::json;
use sha2::{Digest, Sha256};
use slabcast_common::ids::JobId;
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::InvalidField;
use slabcast_master::jobs::{JobState, WatchItem};
use slabcast_master::library::OpenVolume;
use slabcast_scene::document::SceneDocument;
use slabcast_scene::request::PathRequest;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio::sync::mpsc;
use tracing::{info, warn};

/// Largest edge of a picture to keep, pixels.
pub(crate) const PICTURE_EDGE: u32 = 8192;
/// Most bytes of an upload.
pub(crate) const UPLOAD_BYTES: u64 = 4 << 30;
/// Most bytes of a piece of an upload.
pub(crate) const CHUNK_BYTES: usize = 4 << 20;
/// Most bytes of a scene document that is kept.
pub(crate) const STATE_BYTES: usize = 1 << 20;
/// Most frames of a movie.
pub(crate) const MOVIE_FRAMES: u64 = 100_000;
/// Most bytes of a body of JSON.
const BODY_BYTES: usize = 4 << 20;
/// Bytes of all states that are kept; older ones go first.
const STATES_BYTES: usize = 32 << 20;
/// Movies that are kept; older ones go first.
const RESULTS: usize = 16;
/// Movies that are made at a time.
const MOVIES_AT_ONCE: usize = 4;
/// Bytes of a file that are read at a time.
const PIECE: usize = 256 << 10;

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Scene documents that are kept under short ids.
#[derive(Default)]
pub(crate) struct States(Mutex<VecDeque<(String, Bytes)>>);

impl States {
    /// Keeps a document and returns its id.
    fn keep(&self, document: Bytes) -> String {
        let mut id = hex(&Sha256::digest(&document));
        id.truncate(16);
        let mut kept = lock(&self.0);
        kept.retain(|(other, _)| *other != id);
        kept.push_back((id.clone(), document));
        while kept.iter().map(|(_, document)| document.len()).sum::<usize>() > STATES_BYTES {
            kept.pop_front();
        }
        id
    }

    fn get(&self, id: &str) -> Option<Bytes> {
        let kept = lock(&self.0);
        kept.iter().find(|(other, _)| other == id).map(|(_, document)| document.clone())
    }
}

/// Movies that were made, by job, and those that are being made.
#[derive(Default)]
pub(crate) struct Results(Mutex<Movies>);

#[derive(Default)]
struct Movies {
    made: VecDeque<(JobId, Arc<Made>)>,
    /// Jobs whose movie is being made, and its format.
    making: Vec<(JobId, String)>,
}

/// A movie on disk.
struct Made {
    file: MadeFile,
    format: String,
    bytes: u64,
}

impl Results {
    /// Returns a job's `format` and `result` as news tell them.
    pub(crate) fn told(&self, job: JobId) -> Option<(String, serde_json::Value)> {
        let movies = lock(&self.0);
        if let Some((_, made)) = movies.made.iter().find(|(of, _)| *of == job) {
            let Made { file, format, bytes } = &**made;
            let result = json!({"name": file.name, "format": format, "bytes": bytes});
            return Some((format.clone(), result));
        }
        let making = movies.making.iter().find(|(of, _)| *of == job);
        making.map(|(_, format)| (format.clone(), serde_json::Value::Null))
    }
}

#[derive(Deserialize)]
struct PictureAsk {
    #[serde(default)]
    format: Option<String>,
}

#[derive(Deserialize)]
struct MovieAsk {
    format: String,
    fps: u16,
}

fn invalid(field: &str, problem: impl Into<String>) -> Problem {
    Problem::field(&InvalidField::new(field, problem.into()))
}

/// Answers a call.
///
/// # Errors
/// The call is refused.
pub(crate) async fn call(
    shared: &Arc<Shared>,
    caller: Caller,
    path: &str,
    request: Request<Body>,
) -> Answer {
    let parts: Vec<&str> = path.split('/').collect();
    match (request.method().as_str(), &parts[..]) {
        ("POST", ["picture"]) => {
            let body = body_of(request, BODY_BYTES).await?;
            let PictureAsk { format } =
                serde_json::from_slice(&body).map_err(|e| Problem::json(&e))?;
            picture(shared, caller, &body, format.as_deref().unwrap_or("png")).await
        }
        ("GET", ["picture"]) => {
            let query = request.uri().query().unwrap_or_default().to_owned();
            kept_picture(shared, caller, &query).await
        }
        ("POST", ["movie"]) => {
            let body = body_of(request, BODY_BYTES).await?;
            movie(shared, caller, &body).await
        }
        ("GET", ["jobs", job, "result"]) => result(shared, job, request.headers()).await,
        ("POST", ["states"]) => {
            let document = body_of(request, STATE_BYTES).await?;
            read_document(&document)?;
            let id = shared.states.keep(document);
            Ok(json_answer(StatusCode::CREATED, &json!({"id": id})))
        }
        ("GET", ["states", id]) => {
            let document = state(shared, id)?;
            let mut answer = Response::new(Body::from(document));
            let kind = HeaderValue::from_static("application/json");
            answer.headers_mut().insert(header::CONTENT_TYPE, kind);
            Ok(answer)
        }
        (_, ["uploads", rest @ ..]) => uploads::call(shared, caller, rest, request).await,
        _ => Err(Problem::new("not_found", "there is no such call; see docs/reference/live.md")),
    }
}

fn state(shared: &Shared, id: &str) -> Result<Bytes, Problem> {
    let gone = || Problem::new("not_found", format!("there is no state {id}; send it again"));
    shared.states.get(id).ok_or_else(gone)
}

fn read_document(body: &[u8]) -> Result<SceneDocument, Problem> {
    let text = std::str::from_utf8(body)
        .map_err(|_| Problem::new("invalid_field", "the body is not text; send JSON"))?;
    let document = SceneDocument::from_json(text).map_err(|e| Problem::field(&e))?;
    if document.path.size.iter().any(|&n| n == 0 || n > PICTURE_EDGE) {
        let [w, h] = document.path.size;
        return Err(invalid("path.size", format!("{w}x{h}; give 1 to {PICTURE_EDGE} each")));
    }
    Ok(document)
}

/// A document whose volume is open, and the request that draws it.
struct Opened {
    open: OpenVolume,
    recipe: Recipe,
    request: PathRequest,
}

async fn open(
    shared: &Shared,
    caller: Caller,
    document: SceneDocument,
    format: &str,
    fps: Option<u16>,
) -> Result<Opened, Problem> {
    let Some(pixels) = shared.files.pixels(format, document.background) else {
        return Err(invalid("format", format!("`{format}` is not written here; give png")));
    };
    if !document.quality.is_usual() {
        return Err(invalid(
            "quality",
            "pictures by an error or a time are made by `slabcast render --error` or `--budget`; \
             leave it out",
        ));
    }
    let viewer = shared.handle.viewer(Some(caller.peer.ip()));
    let choice = document.volume.choice().map_err(|e| Problem::field(&e))?;
    let opened = shared.handle.reading(move |library| library.open(&choice, viewer));
    let open = opened.await.ok_or_else(Problem::ending)??;
    let info = open.served.info.clone();
    let request = document.request(shared.fresh_key(), &info, LevelChoice::default(), pixels);
    let recipe = Recipe {
        orientation: open.served.orientation,
        info,
        framing: None,
        format: format.to_owned(),
        fps,
        frames: document.path.frames() as u64,
        document,
    };
    Ok(Opened { open, recipe, request })
}

/// Draws a document's only frame and answers with its file.
async fn picture(shared: &Shared, caller: Caller, body: &[u8], format: &str) -> Answer {
    let document = read_document(body)?;
    if document.path.frames() != 1 {
        let text = format!("has {} frames; give one, or POST v1/movie", document.path.frames());
        return Err(invalid("path.frames", text));
    }
    let Ok(_place) = shared.pictures.try_acquire() else {
        let text = "other pictures are being made, as many as this master makes at a time; wait";
        return Err(Problem { retry_ms: Some(2000), ..Problem::new("busy", text) });
    };
    let Opened { open, mut recipe, request } = open(shared, caller, document, format, None).await?;
    let viewer = shared.handle.viewer(Some(caller.peer.ip()));
    if request.path.wants_framing() {
        let (of, transfer) = (request.clone(), request.transfer.clone());
        let framed = shared.handle.reading(move |_| {
            let tf = crate::volume::function(&transfer, &open.served.info)?;
            crate::volume::framed(&open, &of.path, &tf)
        });
        recipe.framing = framed.await.ok_or_else(Problem::ending)??;
    }
    let frame = frame_of(shared, &request, shared.fresh_id(), viewer).await?;
    let etag = format!("\"{}\"", frame.stats.view_sha256);
    let (to_file, frames) = mpsc::channel(1);
    let making = shared.files.make(recipe, frames);
    let _ = to_file.send(frame).await;
    drop(to_file);
    let made = making.await.map_err(|why| Problem::new("internal", why))?;
    let path = made.path.clone();
    let read = tokio::task::spawn_blocking(move || std::fs::read(path)).await;
    let bytes = read
        .map_err(|e| Problem::new("internal", e.to_string()))?
        .map_err(|e| Problem::new("internal", format!("reading the picture failed: {e}")))?;
    let mut answer = Response::new(Body::from(bytes));
    name_file(answer.headers_mut(), &made);
    if let Ok(etag) = HeaderValue::from_str(&etag) {
        answer.headers_mut().insert(header::ETAG, etag);
    }
    Ok(answer)
}

/// Sets type and name of a file.
fn name_file(headers: &mut HeaderMap, made: &MadeFile) {
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(made.kind));
    let name: String = made.name.chars().filter(|c| c.is_ascii_graphic() && *c != '"').collect();
    if let Ok(value) = HeaderValue::from_str(&format!("attachment; filename=\"{name}\"")) {
        headers.insert(header::CONTENT_DISPOSITION, value);
    }
}

/// Draws a kept state, at another width if one is asked for.
async fn kept_picture(shared: &Shared, caller: Caller, query: &str) -> Answer {
    let value =
        |name: &str| query.split('&').find_map(|pair| pair.strip_prefix(name)?.strip_prefix('='));
    let id = value("state").ok_or_else(|| invalid("state", "is missing; give a state's id"))?;
    let body = state(shared, id)?;
    let mut document: serde_json::Value =
        serde_json::from_slice(&body).map_err(|e| Problem::json(&e))?;
    if let Some(width) = value("w") {
        let width: u32 = width
            .parse()
            .ok()
            .filter(|w| (1..=PICTURE_EDGE).contains(w))
            .ok_or_else(|| invalid("w", format!("give 1 to {PICTURE_EDGE} pixels")))?;
        let [w, h] = read_document(&body)?.path.size.map(u64::from);
        let height = ((h * u64::from(width) + w / 2) / w).clamp(1, u64::from(PICTURE_EDGE));
        document["path"]["size"] = json!([width, height]);
    }
    let mut answer = picture(shared, caller, document.to_string().as_bytes(), "png").await?;
    answer.headers_mut().remove(header::CONTENT_DISPOSITION);
    let cache = HeaderValue::from_static("private, max-age=3600");
    answer.headers_mut().insert(header::CACHE_CONTROL, cache);
    Ok(answer)
}

/// Submits a movie's frames as a job, and has the file written as they come.
async fn movie(shared: &Arc<Shared>, caller: Caller, body: &[u8]) -> Answer {
    let MovieAsk { format, fps } = serde_json::from_slice(body).map_err(|e| Problem::json(&e))?;
    if !(1..=120).contains(&fps) {
        return Err(invalid("fps", format!("{fps}; give 1 to 120 frames a second")));
    }
    if !shared.files.movies().contains(&format.as_str()) {
        let text = format!("no {format} is made here; give {}", shared.files.movies().join(", "));
        return Err(invalid("format", text));
    }
    let document = read_document(body)?;
    let Opened { mut recipe, request, .. } =
        open(shared, caller, document, &format, Some(fps)).await?;
    let busy = lock(&shared.results.0).making.len();
    if busy >= MOVIES_AT_ONCE {
        let text = format!("{busy} movies are being made, as many as this master makes; wait");
        return Err(Problem { retry_ms: Some(5000), ..Problem::new("busy", text) });
    }
    let job = shared.handle.submit_from(request, Some(caller.peer.ip())).await?;
    recipe.framing = shared.handle.job(job).and_then(|view| view.framing);
    lock(&shared.results.0).making.push((job, format.clone()));
    let shared = shared.clone();
    tokio::spawn(async move {
        let made = make_movie(&shared, job, recipe).await;
        let mut movies = lock(&shared.results.0);
        movies.making.retain(|(of, _)| *of != job);
        match made {
            Ok(file) => {
                let bytes = std::fs::metadata(&file.path).map_or(0, |m| m.len());
                info!(%job, name = file.name, bytes, "movie made");
                movies.made.push_back((job, Arc::new(Made { file, format, bytes })));
                while movies.made.len() > RESULTS {
                    movies.made.pop_front();
                }
            }
            Err(why) => warn!(%job, why, "no movie"),
        }
    });
    Ok(json_answer(StatusCode::ACCEPTED, &json!({"job": job.to_string()})))
}

/// Writes the frames of a job into a file.
async fn make_movie(shared: &Shared, job: JobId, recipe: Recipe) -> Result<MadeFile, String> {
    let total = recipe.frames;
    let mut watch = shared.handle.watch(job, 0).ok_or("the job was forgotten")?;
    let (to_file, frames) = mpsc::channel(1);
    let making = tokio::spawn(shared.files.make(recipe, frames));
    let mut sent = 0;
    let fed: Result<(), String> = loop {
        match watch.next().await {
            Some(WatchItem::Frame(frame)) => {
                if to_file.send(frame).await.is_err() {
                    // The file can't be written: its maker says why.
                    break Ok(());
                }
                sent += 1;
                if sent == total {
                    break Ok(());
                }
            }
            Some(WatchItem::Failed { number, reason }) => {
                break Err(format!("frame {number} failed: {reason}"));
            }
            Some(WatchItem::Notice(view)) => match view.state {
                JobState::Failed(why) => break Err(why),
                JobState::Cancelled => break Err("the job was cancelled".into()),
                _ => {}
            },
            None => break Err("the job ended before its last frame".into()),
        }
    };
    if let Err(why) = fed {
        making.abort();
        shared.handle.cancel(job).await;
        return Err(why);
    }
    drop(to_file);
    match making.await {
        Ok(made) => made,
        Err(e) => Err(e.to_string()),
    }
}

/// Reads the range of a `Range` header of bytes; `None` if there is none that can be kept.
fn range_of(text: &str, length: u64) -> Option<(u64, u64)> {
    let (from, to) = text.strip_prefix("bytes=")?.split_once('-')?;
    let last = length.checked_sub(1)?;
    match (from.parse::<u64>(), to.parse::<u64>()) {
        (Ok(from), Ok(to)) if from <= to && from <= last => Some((from, to.min(last))),
        (Ok(from), Err(_)) if to.is_empty() && from <= last => Some((from, last)),
        (Err(_), Ok(n)) if from.is_empty() && n > 0 => Some((length.saturating_sub(n), last)),
        _ => None,
    }
}

/// Answers with a job's movie, or a part of it.
async fn result(shared: &Shared, job: &str, headers: &HeaderMap) -> Answer {
    let number = job.strip_prefix("job-").and_then(|n| n.parse().ok()).map(JobId);
    let found = number.and_then(|job| {
        let movies = lock(&shared.results.0);
        movies.made.iter().find(|(of, _)| *of == job).map(|(_, made)| made.clone())
    });
    let gone = || {
        Problem::new(
            "not_found",
            format!("job {job} has no movie or frames to take; make them again on the page"),
        )
    };
    let made = found.ok_or_else(gone)?;
    let failed = |e: std::io::Error| Problem::new("internal", format!("reading it failed: {e}"));
    let mut file = tokio::fs::File::open(&made.file.path).await.map_err(failed)?;
    let length = made.bytes;
    let asked = headers.get(header::RANGE).and_then(|value| value.to_str().ok());
    let range = match asked.map(|text| range_of(text, length)) {
        Some(None) => {
            let mut answer = Response::new(Body::empty());
            *answer.status_mut() = StatusCode::RANGE_NOT_SATISFIABLE;
            if let Ok(value) = HeaderValue::from_str(&format!("bytes */{length}")) {
                answer.headers_mut().insert(header::CONTENT_RANGE, value);
            }
            return Ok(answer);
        }
        Some(range) => range,
        None => None,
    };
    let (from, to) = range.unwrap_or((0, length.saturating_sub(1)));
    file.seek(std::io::SeekFrom::Start(from)).await.map_err(failed)?;
    let left = if length == 0 { 0 } else { to - from + 1 };
    let keep = made.clone();
    let pieces =
        futures_util::stream::try_unfold((file, left, keep), |(mut file, left, keep)| async move {
            if left == 0 {
                return Ok::<_, std::io::Error>(None);
            }
            let mut piece = vec![0; (PIECE as u64).min(left) as usize];
            let n = file.read(&mut piece).await?;
            if n == 0 {
                return Err(std::io::ErrorKind::UnexpectedEof.into());
            }
            piece.truncate(n);
            Ok(Some((Bytes::from(piece), (file, left - n as u64, keep))))
        });
    let mut answer = Response::new(Body::from_stream(pieces));
    let set = answer.headers_mut();
    name_file(set, &made.file);
    set.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    set.insert(header::CONTENT_LENGTH, HeaderValue::from(left));
    if range.is_some() {
        if let Ok(value) = HeaderValue::from_str(&format!("bytes {from}-{to}/{length}")) {
            set.insert(header::CONTENT_RANGE, value);
        }
        *answer.status_mut() = StatusCode::PARTIAL_CONTENT;
    }
    Ok(answer)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_lie_inside_the_file() {
        assert_eq!(range_of("bytes=0-9", 100), Some((0, 9)));
        assert_eq!(range_of("bytes=90-", 100), Some((90, 99)));
        assert_eq!(range_of("bytes=90-1000", 100), Some((90, 99)));
        assert_eq!(range_of("bytes=-10", 100), Some((90, 99)));
        for bad in ["bytes=100-", "bytes=9-3", "bytes=-0", "lines=1-2", "bytes=a-b", "bytes=-"] {
            assert_eq!(range_of(bad, 100), None, "{bad}");
        }
        assert_eq!(range_of("bytes=0-0", 0), None);
    }

    #[test]
    fn states_have_the_same_id_for_the_same_document_and_go_when_there_are_too_many() {
        let states = States::default();
        let id = states.keep(Bytes::from_static(b"one"));
        assert_eq!(states.keep(Bytes::from_static(b"one")), id);
        assert_eq!(states.get(&id).as_deref(), Some(&b"one"[..]));
        for n in 0..40u8 {
            states.keep(Bytes::from(vec![n; 1 << 20]));
        }
        assert_eq!(states.get(&id), None);
    }
}
