//! Calls over HTTP beside the socket: kept states.

use crate::problem::Problem;
use crate::server::{Answer, Caller, body_of, json_answer};
use crate::shared::Shared;
use crate::tile::hex;
use axum::body::Body;
use axum::http::{HeaderValue, Request, StatusCode, header};
use bytes::Bytes;
use serde_json::json;
use sha2::{Digest, Sha256};
use slabcast_scene::document::SceneDocument;
use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

/// Largest edge of a picture to keep, pixels.
pub(crate) const PICTURE_EDGE: u32 = 8192;
/// Most bytes of an upload.
pub(crate) const UPLOAD_BYTES: u64 = 4 << 30;
/// Most bytes of a piece of an upload.
pub(crate) const CHUNK_BYTES: usize = 4 << 20;
/// Most bytes of a scene document that is kept.
pub(crate) const STATE_BYTES: usize = 1 << 20;
/// Most frames of a movie.
pub(crate) const MOVIE_FRAMES: u32 = 100_000;
/// Bytes of all states that are kept; older ones go first.
const STATES_BYTES: usize = 32 << 20;

/// Returns the formats of movies that this master writes.
pub(crate) fn movies(_: &Shared) -> Vec<&'static str> {
    Vec::new()
}

/// Scene documents that are kept under short ids.
#[derive(Default)]
pub(crate) struct States(Mutex<VecDeque<(String, Bytes)>>);

impl States {
    /// Keeps a document and returns its id.
    fn keep(&self, document: Bytes) -> String {
        let mut id = hex(&Sha256::digest(&document));
        id.truncate(16);
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.retain(|(other, _)| *other != id);
        kept.push_back((id.clone(), document));
        while kept.iter().map(|(_, document)| document.len()).sum::<usize>() > STATES_BYTES {
            kept.pop_front();
        }
        id
    }

    fn get(&self, id: &str) -> Option<Bytes> {
        let kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.iter().find(|(other, _)| other == id).map(|(_, document)| document.clone())
    }
}

/// Answers a call.
///
/// # Errors
/// The call is refused.
pub(crate) async fn call(shared: &Shared, _: Caller, path: &str, request: Request<Body>) -> Answer {
    let parts: Vec<&str> = path.split('/').collect();
    match (request.method().as_str(), &parts[..]) {
        ("POST", ["states"]) => {
            let document = body_of(request, STATE_BYTES).await?;
            let text = std::str::from_utf8(&document)
                .map_err(|_| Problem::new("invalid_field", "the body is not text; send JSON"))?;
            SceneDocument::from_json(text).map_err(|e| Problem::field(&e))?;
            let id = shared.states.keep(document);
            Ok(json_answer(StatusCode::CREATED, &json!({"id": id})))
        }
        ("GET", ["states", id]) => {
            let gone = || Problem::new("not_found", format!("there is no state {id}"));
            let document = shared.states.get(id).ok_or_else(gone)?;
            let mut answer = axum::response::Response::new(Body::from(document));
            let kind = HeaderValue::from_static("application/json");
            answer.headers_mut().insert(header::CONTENT_TYPE, kind);
            Ok(answer)
        }
        _ => Err(Problem::new("not_found", "there is no such call; see docs/reference/live.md")),
    }
}
