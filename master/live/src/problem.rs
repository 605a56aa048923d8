//! Refusals: what is wrong, in which field, and what to do, for the socket and for HTTP.

use axum::http::StatusCode;
use serde_json::{Value, json};
use slabcast_common::quality::InvalidField;
use slabcast_master::SubmitError;
use slabcast_master::library::VolumeError;

/// A refusal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Problem {
    /// A word of docs/reference/live.md.
    pub(crate) reason: &'static str,
    pub(crate) field: String,
    pub(crate) problem: String,
    pub(crate) remedy: String,
    pub(crate) retry_ms: Option<u32>,
}

impl Problem {
    /// Returns a refusal with its reason and one or two sentences: what is behind the first `; ` is
    /// the remedy.
    pub(crate) fn new(reason: &'static str, text: impl Into<String>) -> Problem {
        let text = text.into();
        let (problem, remedy) = match text.split_once("; ") {
            Some((problem, remedy)) => (sentence(problem), sentence(remedy)),
            None => (sentence(&text), String::new()),
        };
        Problem { reason, field: String::new(), problem, remedy, retry_ms: None }
    }

    /// Returns the refusal of a field.
    pub(crate) fn field(wrong: &InvalidField) -> Problem {
        let text = format!("{}: {}", wrong.field, wrong.problem);
        Problem { field: wrong.field.clone(), ..Problem::new("invalid_field", text) }
    }

    /// Returns the refusal of JSON that does not say what it should.
    pub(crate) fn json(e: &serde_json::Error) -> Problem {
        Problem::new("invalid_field", format!("the message can't be read: {e}"))
    }

    /// Returns the refusal of a master that ends.
    pub(crate) fn ending() -> Problem {
        Problem {
            retry_ms: Some(1000),
            ..Problem::new("master_ending", "the master is ending; call again in a second")
        }
    }

    /// Returns the refusal as a message of the socket, in answer to message `re` with number `id`.
    pub(crate) fn message(&self, re: &str, id: u64) -> Value {
        let mut message = self.body();
        message["type"] = "refused".into();
        message["re"] = re.into();
        message["id"] = id.into();
        message
    }

    /// Returns the refusal as the body of an answer.
    pub(crate) fn body(&self) -> Value {
        json!({
            "reason": self.reason, "field": self.field, "problem": self.problem,
            "remedy": self.remedy, "retry_ms": self.retry_ms,
        })
    }

    /// Returns the status of an answer.
    pub(crate) fn status(&self) -> StatusCode {
        match self.reason {
            "not_allowed" => StatusCode::FORBIDDEN,
            "unauthorized" => StatusCode::UNAUTHORIZED,
            "volume_not_found" | "job_not_found" | "not_found" | "frame_not_kept" => {
                StatusCode::NOT_FOUND
            }
            "volume_name_taken" | "volume_in_use" | "client_key_taken" => StatusCode::CONFLICT,
            "too_large" => StatusCode::PAYLOAD_TOO_LARGE,
            "volume_not_readable" => StatusCode::UNPROCESSABLE_ENTITY,
            "too_many_jobs" | "busy" => StatusCode::TOO_MANY_REQUESTS,
            "no_room_for_volume" => StatusCode::INSUFFICIENT_STORAGE,
            "uploads_refused" => StatusCode::FORBIDDEN,
            "master_ending" => StatusCode::SERVICE_UNAVAILABLE,
            "internal" => StatusCode::INTERNAL_SERVER_ERROR,
            _ => StatusCode::BAD_REQUEST,
        }
    }
}

/// Makes a sentence of words for a log: capital letter, full stop.
fn sentence(text: &str) -> String {
    let text = text.trim();
    let mut letters = text.chars();
    let Some(first) = letters.next() else { return String::new() };
    // A field's name keeps its letters.
    let is_field = text.split([' ', ',']).next().is_some_and(|word| word.ends_with(':'));
    let mut sentence: String = if is_field { first.into() } else { first.to_uppercase().collect() };
    sentence.push_str(letters.as_str());
    if !sentence.ends_with(['.', '!', '?']) {
        sentence.push('.');
    }
    sentence
}

impl From<VolumeError> for Problem {
    fn from(error: VolumeError) -> Problem {
        let reason = match &error {
            VolumeError::Choose(_) | VolumeError::Damaged(_) => "invalid_field",
            VolumeError::NotFound(_) => "volume_not_found",
            VolumeError::NotReadable(_) => "volume_not_readable",
            VolumeError::NoRoom(..) => "no_room_for_volume",
            VolumeError::NameTaken(_) => "volume_name_taken",
            VolumeError::InUse(_) => "volume_in_use",
            VolumeError::Refused(_) => "uploads_refused",
        };
        let retry_ms = matches!(error, VolumeError::NoRoom(_, true)).then_some(5000);
        Problem { retry_ms, ..Problem::new(reason, error.to_string()) }
    }
}

impl From<SubmitError> for Problem {
    fn from(error: SubmitError) -> Problem {
        match error {
            SubmitError::Refused(field) => Problem::field(&field),
            SubmitError::Volume(e) => e.into(),
            SubmitError::KeyTaken => Problem::new("client_key_taken", error.to_string()),
            SubmitError::Full(_) => {
                let full = Problem::new("too_many_jobs", error.to_string());
                Problem { retry_ms: Some(2000), ..full }
            }
            SubmitError::Gone => Problem::ending(),
            SubmitError::Panicked(_) => Problem::new("internal", error.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_are_sentences_with_a_remedy() {
        let wrong = InvalidField::new("size", "0x7 has no pixels; give at least 1x1");
        let problem = Problem::field(&wrong);
        assert_eq!(problem.problem, "size: 0x7 has no pixels.");
        assert_eq!(problem.remedy, "Give at least 1x1.");
        let message = problem.message("view", 7);
        assert_eq!((&message["re"], &message["id"]), (&"view".into(), &7.into()));
        assert_eq!(problem.status(), StatusCode::BAD_REQUEST);
    }
}
