//! Jobs and workers, as clients list them.

use super::shared::{format_from_wire, format_to_wire};
use super::watch::{state_from_wire, state_to_wire};
use super::wire;
use crate::convert::numbers::size_from_wire;
use crate::convert::{
    MAX_NAME, WireError, digest_from_wire, name_from_wire, optional_name_from_wire,
    reason_from_wire, reason_to_wire,
};
use crate::model::{Job, Worker, WorkerError};
use bytes::Bytes;
use prost_types::{Duration as WireDuration, Timestamp};
use slabcast_common::ids::WorkerId;
use std::time::Duration;

/// Jobs or workers of a page where the caller does not say.
const PAGE: u32 = 100;

/// Most jobs or workers of a page: 1000 jobs take at most some 4 MB of messages for people, which
/// is what a response may have. Nearly all have none.
const MAX_PAGE: u32 = 1000;

const TOKEN: &str = "after-";

/// A page that a client asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Page {
    /// Largest number of entries that the page may have, 1 to 1000.
    pub size: usize,
    /// Number of the last entry of the page before; `None` for the first page.
    pub after: Option<u64>,
}

/// Reads the page that a list request asks for.
///
/// # Errors
/// [`WireError`] names `page_token` if [`page_token`] never gave it.
pub fn page_from_wire(page_size: u32, token: &str) -> Result<Page, WireError> {
    let size = if page_size == 0 { PAGE } else { page_size.min(MAX_PAGE) } as usize;
    if token.is_empty() {
        return Ok(Page { size, after: None });
    }
    let after = token.strip_prefix(TOKEN).and_then(|n| n.parse().ok());
    match after {
        Some(after) => Ok(Page { size, after: Some(after) }),
        None => Err(WireError::value("page_token", "is not one of this master; begin without")),
    }
}

/// Makes the token of the page after the entry with number `last`.
pub fn page_token(last: u64) -> String {
    format!("{TOKEN}{last}")
}

/// A time in milliseconds since 1970 UTC; 0 is none.
pub(super) fn time_to_wire(unix_ms: i64) -> Option<Timestamp> {
    (unix_ms != 0).then(|| Timestamp {
        seconds: unix_ms.div_euclid(1000),
        nanos: unix_ms.rem_euclid(1000) as i32 * 1_000_000,
    })
}

/// A time in milliseconds since 1970 UTC; 0 if there is none.
pub(super) fn time_from_wire(field: &str, time: Option<Timestamp>) -> Result<i64, WireError> {
    let Some(Timestamp { seconds, nanos }) = time else { return Ok(0) };
    let ms = seconds.checked_mul(1000).and_then(|ms| ms.checked_add(i64::from(nanos / 1_000_000)));
    match ms {
        Some(ms) if (0..1_000_000_000).contains(&nanos) => Ok(ms),
        _ => Err(WireError::value(field, "is not a time")),
    }
}

fn duration_to_wire(duration: Duration) -> Option<WireDuration> {
    Some(WireDuration {
        seconds: i64::try_from(duration.as_secs()).unwrap_or(i64::MAX),
        nanos: duration.subsec_nanos() as i32,
    })
}

fn duration_from_wire(field: &str, duration: Option<WireDuration>) -> Result<Duration, WireError> {
    let WireDuration { seconds, nanos } = duration.unwrap_or_default();
    match (u64::try_from(seconds), u32::try_from(nanos)) {
        (Ok(seconds), Ok(nanos)) if nanos < 1_000_000_000 => Ok(Duration::new(seconds, nanos)),
        _ => Err(WireError::value(field, "is not a duration of 0 or more")),
    }
}

/// Converts a job to the message that clients get.
pub fn job_to_wire(job: &Job) -> wire::Job {
    wire::Job {
        job_id: job.job_id.clone(),
        client_key: job.client_key.clone(),
        state: state_to_wire(job.state),
        message: reason_to_wire(&job.message),
        frames_done: job.frames_done,
        frames_failed: job.frames_failed,
        frames_total: job.frames_total,
        width: job.size[0],
        height: job.size[1],
        format: format_to_wire(job.format),
        submit_time: time_to_wire(job.submitted_unix_ms),
        finish_time: time_to_wire(job.finished_unix_ms),
        volume_digest: job
            .volume
            .as_ref()
            .map_or_else(Bytes::new, |(digest, _)| Bytes::copy_from_slice(&digest.0)),
        volume_name: job.volume.as_ref().map_or_else(String::new, |(_, name)| name.clone()),
    }
}

/// Converts a job from the message that clients get.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn job_from_wire(job: wire::Job) -> Result<Job, WireError> {
    Ok(Job {
        job_id: name_from_wire("job_id", job.job_id)?,
        client_key: name_from_wire("client_key", job.client_key)?,
        state: state_from_wire("state", job.state)?,
        message: reason_from_wire("message", job.message)?,
        frames_done: job.frames_done,
        frames_failed: job.frames_failed,
        frames_total: job.frames_total,
        size: size_from_wire(job.width, job.height)?,
        format: format_from_wire("format", job.format)?,
        submitted_unix_ms: time_from_wire("submit_time", job.submit_time)?,
        finished_unix_ms: time_from_wire("finish_time", job.finish_time)?,
        volume: match &job.volume_digest[..] {
            [] => None,
            digest => {
                let name = reason_from_wire("volume_name", job.volume_name)?;
                Some((digest_from_wire("volume_digest", digest)?, name))
            }
        },
    })
}

/// Converts a worker to the message that clients get.
pub fn worker_to_wire(worker: &Worker) -> wire::Worker {
    wire::Worker {
        worker_id: worker.id.to_string(),
        name: worker.name.clone(),
        address: worker.address.clone(),
        threads: worker.threads,
        simd: worker.simd.clone(),
        memory_budget_bytes: worker.memory_budget_bytes,
        held_bytes: worker.held_bytes,
        held_bricks: worker.held_bricks,
        tasks_lent: worker.tasks_lent,
        tasks_done: worker.tasks_done,
        silent_duration: duration_to_wire(worker.silent),
        connected_duration: duration_to_wire(worker.connected),
        in_reserve: worker.in_reserve,
        damaged_messages: worker.damaged_messages,
        round_trip_duration: worker.round_trip.and_then(duration_to_wire),
        last_error: worker.last_error.as_ref().map(|error| wire::WorkerError {
            time: time_to_wire(error.at_unix_ms),
            reason: reason_to_wire(&error.reason),
        }),
    }
}

fn error_from_wire(error: wire::WorkerError) -> Result<WorkerError, WireError> {
    Ok(WorkerError {
        at_unix_ms: time_from_wire("time", error.time)?,
        reason: reason_from_wire("reason", error.reason)?,
    })
}

/// Converts a worker from the message that clients get.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn worker_from_wire(worker: wire::Worker) -> Result<Worker, WireError> {
    let id = worker.worker_id.strip_prefix('w').and_then(|n| n.parse().ok());
    Ok(Worker {
        id: WorkerId(id.ok_or_else(|| WireError::value("worker_id", "is not the id of a worker"))?),
        name: name_from_wire("name", worker.name)?,
        address: optional_name_from_wire("address", worker.address)?,
        threads: worker.threads,
        simd: optional_name_from_wire("simd", worker.simd)?,
        memory_budget_bytes: worker.memory_budget_bytes,
        held_bytes: worker.held_bytes,
        held_bricks: worker.held_bricks,
        tasks_lent: worker.tasks_lent,
        tasks_done: worker.tasks_done,
        silent: duration_from_wire("silent_duration", worker.silent_duration)?,
        connected: duration_from_wire("connected_duration", worker.connected_duration)?,
        in_reserve: worker.in_reserve,
        damaged_messages: worker.damaged_messages,
        round_trip: worker
            .round_trip_duration
            .map(|duration| duration_from_wire("round_trip_duration", Some(duration)))
            .transpose()?,
        last_error: worker
            .last_error
            .map(error_from_wire)
            .transpose()
            .map_err(|e| e.within("last_error"))?,
    })
}

const _: () = assert!(MAX_NAME >= 64, "job ids, addresses and names of CPUs fit");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn page_tokens_come_back_and_strangers_are_refused() {
        assert_eq!(page_from_wire(0, ""), Ok(Page { size: 100, after: None }));
        assert_eq!(page_from_wire(9999, ""), Ok(Page { size: 1000, after: None }));
        let page = Page { size: 3, after: Some(u64::MAX) };
        assert_eq!(page_from_wire(3, &page_token(u64::MAX)), Ok(page));
        for token in ["after-", "after-x", "7", "after--1", "AFTER-7"] {
            assert_eq!(page_from_wire(3, token).unwrap_err().field(), "page_token");
        }
    }

    #[test]
    fn times_before_1970_and_out_of_range_are_read_or_refused() {
        for ms in [1, -1, -1000, 1_790_000_000_123] {
            assert_eq!(time_from_wire("t", time_to_wire(ms)), Ok(ms));
        }
        for (seconds, nanos) in [(0, -1), (0, 1_000_000_000), (i64::MAX, 0)] {
            assert!(time_from_wire("t", Some(Timestamp { seconds, nanos })).is_err());
        }
        let back = WireDuration { seconds: -1, nanos: 0 };
        assert!(duration_from_wire("d", Some(back)).is_err());
    }
}
