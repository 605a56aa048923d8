//! Messages of WatchFrames: chunks of frames, failures of frames, and notices.

use super::shared::{format_from_wire, format_to_wire};
use super::statistics::{StatisticsPart, statistics_to_wire};
use super::{enum_conversions, wire};
use crate::MAX_FRAME_CHUNK;
use crate::convert::numbers::size_from_wire;
use crate::convert::{WireError, cut, reason_from_wire, reason_to_wire, required};
use crate::model::{FrameChunk, FrameFailure, JobNotice, JobState, WatchMessage};
use bytes::Bytes;
use prost::Message as _;
use slabcast_common::image::PixelFormat;
use slabcast_common::stats::FrameStats;

enum_conversions!(state_to_wire, state_from_wire, JobState, wire::JobState, None,
    { Queued <=> Queued, Preparing <=> Preparing, WaitingForWorkers <=> WaitingForWorkers,
      Running <=> Running, Done <=> Done, Failed <=> Failed, Cancelled <=> Cancelled });

/// Bytes of pixels, statistics or trace in a chunk. Tags, lengths and numbers beside them take
/// less than 100 bytes, and a checksum 6.
const ROOM: usize = MAX_FRAME_CHUNK - 256;

/// Cuts a finished frame into the messages of a watch, each of at most
/// [`MAX_FRAME_CHUNK`](crate::MAX_FRAME_CHUNK) bytes.
///
/// `pixels` is passed on, not copied. `trace_json` is one line of JSON, or empty where no trace was
/// wanted.
pub fn frame_to_wire(
    frame: u64,
    size: [u32; 2],
    format: PixelFormat,
    pixels: &Bytes,
    stats: &FrameStats,
    trace_json: &str,
) -> Vec<wire::WatchFramesResponse> {
    let empty_chunk = |offset: usize| wire::FrameChunk {
        frame,
        width: size[0],
        height: size[1],
        format: format_to_wire(format),
        offset: offset as u64,
        ..wire::FrameChunk::default()
    };
    let mut chunks: Vec<wire::FrameChunk> = (0..pixels.len())
        .step_by(ROOM)
        .map(|begin| {
            let data = pixels.slice(begin..pixels.len().min(begin + ROOM));
            wire::FrameChunk { data, ..empty_chunk(begin) }
        })
        .collect();
    let mut room = ROOM - chunks.last().map_or(ROOM, |c| c.data.len());
    for part in statistics_to_wire(stats, ROOM) {
        let bytes = part.encoded_len();
        if bytes > room || chunks.last().is_some_and(|chunk| chunk.statistics.is_some()) {
            chunks.push(empty_chunk(pixels.len()));
            room = ROOM;
        }
        room -= bytes.min(room);
        let chunk = chunks.last_mut().expect("there is room, so there is a chunk");
        chunk.statistics = Some(part);
    }
    let mut text = trace_json;
    while !text.is_empty() {
        let (piece, rest) = text.split_at(cut(text, room).len());
        if piece.is_empty() {
            chunks.push(empty_chunk(pixels.len()));
            room = ROOM;
            continue;
        }
        let chunk = chunks.last_mut().expect("there is room, so there is a chunk");
        chunk.trace_json = piece.to_owned();
        room -= piece.len();
        text = rest;
    }
    if let Some(chunk) = chunks.last_mut() {
        chunk.last = true;
    }
    let chunks = chunks.into_iter().map(wire::watch_frames_response::Message::Chunk);
    chunks.map(message).collect()
}

/// Writes news of a job as a message of a watch.
pub fn notice_to_wire(notice: &JobNotice) -> wire::WatchFramesResponse {
    message(wire::watch_frames_response::Message::Notice(wire::JobNotice {
        state: state_to_wire(notice.state),
        frames_done: notice.frames_done,
        frames_failed: notice.frames_failed,
        frames_total: notice.frames_total,
        render_threads: notice.render_threads,
        message: reason_to_wire(&notice.message),
    }))
}

/// Writes the failure of a frame as a message of a watch, in place of its chunks.
pub fn frame_failed_to_wire(frame: u64, reason: &str) -> wire::WatchFramesResponse {
    let reason = reason_to_wire(reason);
    message(wire::watch_frames_response::Message::Failed(wire::FrameFailed { frame, reason }))
}

fn message(message: wire::watch_frames_response::Message) -> wire::WatchFramesResponse {
    wire::WatchFramesResponse { message: Some(message) }
}

/// Converts one message of `WatchFrames`: a piece of a frame, its failure, or a notice.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn watch_from_wire(response: wire::WatchFramesResponse) -> Result<WatchMessage, WireError> {
    use wire::watch_frames_response::Message;
    match required("message", response.message)? {
        Message::Chunk(chunk) => {
            chunk_from_wire(chunk).map(WatchMessage::Chunk).map_err(|e| e.within("chunk"))
        }
        Message::Notice(notice) => {
            notice_from_wire(notice).map(WatchMessage::Notice).map_err(|e| e.within("notice"))
        }
        Message::Failed(wire::FrameFailed { frame, reason }) => {
            let reason = reason_from_wire("reason", reason).map_err(|e| e.within("failed"))?;
            Ok(WatchMessage::Failed(FrameFailure { frame, reason }))
        }
    }
}

fn notice_from_wire(notice: wire::JobNotice) -> Result<JobNotice, WireError> {
    Ok(JobNotice {
        state: state_from_wire("state", notice.state)?,
        frames_done: notice.frames_done,
        frames_failed: notice.frames_failed,
        frames_total: notice.frames_total,
        render_threads: notice.render_threads,
        message: reason_from_wire("message", notice.message)?,
    })
}

fn chunk_from_wire(chunk: wire::FrameChunk) -> Result<FrameChunk, WireError> {
    let size = size_from_wire(chunk.width, chunk.height)?;
    let format = format_from_wire("format", chunk.format)?;
    let whole = u64::from(size[0]) * u64::from(size[1]) * format.bytes() as u64;
    if chunk.offset > whole {
        return Err(WireError::value("offset", format!("{} of {whole} bytes", chunk.offset)));
    }
    let most = whole - chunk.offset;
    if chunk.data.len() as u64 > most {
        return Err(WireError::too_long("data", chunk.data.len(), most as usize));
    }
    Ok(FrameChunk {
        frame: chunk.frame,
        size,
        format,
        offset: chunk.offset,
        data: chunk.data,
        last: chunk.last,
        statistics: chunk.statistics.map(StatisticsPart::new),
        trace_json: chunk.trace_json,
    })
}
