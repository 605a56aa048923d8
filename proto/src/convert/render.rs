//! Messages between client and master (`render.proto`).

use super::path::{axis_from_wire, path_from_wire, path_to_wire};
use super::scene::{
    enum_doors, info_from_wire, info_to_wire, quality_from_wire, quality_to_wire, size_from_wire,
};
use super::{
    MAX_NAME, WireError, cut, name_from_wire, optional_name_from_wire, reason_from_wire,
    reason_to_wire, required, transfer_from_wire,
};
use crate::model::{FrameChunk, Job, JobNotice, JobState, PixelsChunk, VolumeDescription, Worker};
use crate::{MAX_FRAME_CHUNK, v1};
use bytes::Bytes;
use slabcast_common::ids::WorkerId;
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::message::{PathRequest, TransferChoice};
use slabcast_common::path::Orientation;
use slabcast_common::quality::{Borders, Keep, Schedule, Work};

enum_doors!(schedule_to_wire, schedule_from_wire, Schedule, v1::Schedule, Some(Schedule::Auto),
    { Auto <=> Auto, Region <=> Region, Slab <=> Slab });
enum_doors!(wanted_format_to_wire, wanted_format_from_wire, PixelFormat, v1::PixelFormat,
    Some(PixelFormat::Rgba8),
    { Rgb8 <=> Rgb8, Rgba8 <=> Rgba8, Rgba16 <=> Rgba16, Rgba32F <=> Rgba32f });
enum_doors!(format_to_wire, format_from_wire, PixelFormat, v1::PixelFormat, None,
    { Rgb8 <=> Rgb8, Rgba8 <=> Rgba8, Rgba16 <=> Rgba16, Rgba32F <=> Rgba32f });
enum_doors!(state_to_wire, state_from_wire, JobState, v1::JobState, None,
    { Queued <=> Queued, WaitingForWorkers <=> WaitingForWorkers, Running <=> Running,
      Done <=> Done, Failed <=> Failed, Cancelled <=> Cancelled });

// ---------------------------------------------------------------------------------------------
// Asking

/// A request for a path.
pub fn path_request_to_wire(request: &PathRequest) -> v1::PathRequest {
    use v1::path_request::Transfer;
    v1::PathRequest {
        client_key: request.client_key.clone(),
        path: Some(path_to_wire(&request.path)),
        transfer: Some(match &request.transfer {
            TransferChoice::Name(name) => Transfer::TransferName(name.clone()),
            TransferChoice::Function(tf) => Transfer::TransferJson(tf.to_json()),
        }),
        quality: Some(quality_to_wire(&request.quality)),
        work: Some(v1::Work {
            slabs: Some(request.work.slabs),
            tiles_per_worker: Some(request.work.tiles_per_worker),
            tile: request.work.tile,
            schedule: schedule_to_wire(request.work.schedule),
            keep_empty: request.work.keep.empty,
            keep_normals: request.work.keep.normals,
            keep_gradients: request.work.keep.gradients,
            keep_colours: request.work.keep.colours,
            equal_slabs: request.work.borders == Borders::Equal,
            estimate: request.work.estimate,
        }),
        format: wanted_format_to_wire(request.format),
        background: Some(background_to_wire(request.background)),
        want_trace: request.want_trace,
        without_hash: !request.want_hash,
    }
}

/// A request for a path, or the field that is wrong. Whether its cameras can be drawn only the
/// volume's lattice can tell (`ViewPath::camera`, `View::new`).
pub fn path_request_from_wire(request: v1::PathRequest) -> Result<PathRequest, WireError> {
    use v1::path_request::Transfer;
    let transfer = match request.transfer {
        None => TransferChoice::Name("auto".into()),
        Some(Transfer::TransferName(name)) => {
            TransferChoice::Name(name_from_wire("transfer_name", name)?)
        }
        Some(Transfer::TransferJson(json)) => {
            TransferChoice::Function(Box::new(transfer_from_wire(&json)?))
        }
    };
    Ok(PathRequest {
        client_key: name_from_wire("client_key", request.client_key)?,
        path: path_from_wire(required("path", request.path)?).map_err(|e| e.within("path"))?,
        transfer,
        quality: quality_from_wire(request.quality.unwrap_or_default())
            .map_err(|e| e.within("quality"))?,
        work: work_from_wire(request.work.unwrap_or_default()).map_err(|e| e.within("work"))?,
        format: wanted_format_from_wire("format", request.format)?,
        background: background_from_wire(request.background.unwrap_or_default())?,
        want_trace: request.want_trace,
        want_hash: !request.without_hash,
    })
}

fn work_from_wire(work: v1::Work) -> Result<Work, WireError> {
    let d = Work::default();
    let work = Work {
        slabs: work.slabs.unwrap_or(d.slabs),
        tiles_per_worker: work.tiles_per_worker.unwrap_or(d.tiles_per_worker),
        tile: work.tile,
        schedule: schedule_from_wire("schedule", work.schedule)?,
        keep: Keep {
            empty: work.keep_empty,
            normals: work.keep_normals,
            gradients: work.keep_gradients,
            colours: work.keep_colours,
        },
        borders: if work.equal_slabs { Borders::Equal } else { Borders::Data },
        estimate: work.estimate,
    };
    work.check()?;
    Ok(work)
}

pub(super) fn background_to_wire(background: Background) -> v1::Background {
    use v1::background::Kind;
    let kind = match background {
        Background::Transparent => Kind::Transparent(v1::Transparent {}),
        Background::Colour([r, g, b]) => Kind::Colour(v1::Rgb { r, g, b }),
    };
    v1::Background { kind: Some(kind) }
}

pub(super) fn background_from_wire(background: v1::Background) -> Result<Background, WireError> {
    use v1::background::Kind;
    match background.kind {
        None => Ok(Background::Colour([0.0; 3])),
        Some(Kind::Transparent(v1::Transparent {})) => Ok(Background::Transparent),
        Some(Kind::Colour(v1::Rgb { r, g, b })) => {
            for (field, x) in [("r", r), ("g", g), ("b", b)] {
                if !(0.0..=1.0).contains(&x) {
                    return Err(WireError::value(
                        format!("background.colour.{field}"),
                        format!("{x}; give 0 to 1"),
                    ));
                }
            }
            Ok(Background::Colour([r, g, b]))
        }
    }
}

// ---------------------------------------------------------------------------------------------
// Watching

/// A finished frame as the messages of a watch, each of at most [`MAX_FRAME_CHUNK`] bytes.
/// `pixels` is passed on, not copied. Texts are one line of JSON each; `trace_json` is empty
/// where none was wanted.
pub fn frame_to_wire(
    frame: u64,
    size: [u32; 2],
    format: PixelFormat,
    pixels: &Bytes,
    stats_json: &str,
    trace_json: &str,
) -> Vec<v1::FrameChunk> {
    // Tags, lengths and numbers of a chunk take less than 100 bytes.
    const ROOM: usize = MAX_FRAME_CHUNK - 256;
    let empty_at = |offset: usize| v1::PixelsChunk {
        frame,
        width: size[0],
        height: size[1],
        format: format_to_wire(format),
        offset: offset as u64,
        ..v1::PixelsChunk::default()
    };
    let mut chunks: Vec<v1::PixelsChunk> = (0..pixels.len())
        .step_by(ROOM)
        .map(|from| {
            let data = pixels.slice(from..pixels.len().min(from + ROOM));
            v1::PixelsChunk { data, ..empty_at(from) }
        })
        .collect();
    let mut room = ROOM - chunks.last().map_or(ROOM, |c| c.data.len());
    for (mut text, is_stats) in [(stats_json, true), (trace_json, false)] {
        while !text.is_empty() {
            let (piece, rest) = text.split_at(cut(text, room).len());
            if piece.is_empty() {
                chunks.push(empty_at(pixels.len()));
                room = ROOM;
                continue;
            }
            let chunk = chunks.last_mut().expect("there is room, so there is a chunk");
            if is_stats {
                chunk.stats_json = piece.to_owned();
            } else {
                chunk.trace_json = piece.to_owned();
            }
            room -= piece.len();
            text = rest;
        }
    }
    if let Some(chunk) = chunks.last_mut() {
        chunk.last = true;
    }
    let message = |c| v1::FrameChunk { what: Some(v1::frame_chunk::What::Pixels(c)) };
    chunks.into_iter().map(message).collect()
}

/// News of a job as a message of a watch.
pub fn notice_to_wire(notice: &JobNotice) -> v1::FrameChunk {
    let notice = v1::JobNotice {
        state: state_to_wire(notice.state),
        frames_done: notice.frames_done,
        frames_total: notice.frames_total,
        workers: notice.workers,
        message: reason_to_wire(&notice.message),
    };
    v1::FrameChunk { what: Some(v1::frame_chunk::What::Notice(notice)) }
}

/// News of a job, or the field that is wrong.
pub fn notice_from_wire(notice: v1::JobNotice) -> Result<JobNotice, WireError> {
    Ok(JobNotice {
        state: state_from_wire("state", notice.state)?,
        frames_done: notice.frames_done,
        frames_total: notice.frames_total,
        workers: notice.workers,
        message: reason_from_wire("message", notice.message)?,
    })
}

/// One message of a watch, or the field that is wrong.
pub fn chunk_from_wire(chunk: v1::FrameChunk) -> Result<FrameChunk, WireError> {
    use v1::frame_chunk::What;
    match required("what", chunk.what)? {
        What::Pixels(chunk) => {
            pixels_from_wire(chunk).map(FrameChunk::Pixels).map_err(|e| e.within("pixels"))
        }
        What::Notice(notice) => {
            notice_from_wire(notice).map(FrameChunk::Notice).map_err(|e| e.within("notice"))
        }
    }
}

fn pixels_from_wire(chunk: v1::PixelsChunk) -> Result<PixelsChunk, WireError> {
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
    Ok(PixelsChunk {
        frame: chunk.frame,
        size,
        format,
        offset: chunk.offset,
        data: chunk.data,
        last: chunk.last,
        stats_json: chunk.stats_json,
        trace_json: chunk.trace_json,
    })
}

// ---------------------------------------------------------------------------------------------
// Looking around

/// A job.
pub fn job_to_wire(job: &Job) -> v1::Job {
    v1::Job {
        job_id: job.job_id.clone(),
        client_key: job.client_key.clone(),
        state: state_to_wire(job.state),
        message: reason_to_wire(&job.message),
        frames_done: job.frames_done,
        frames_total: job.frames_total,
        width: job.size[0],
        height: job.size[1],
        format: format_to_wire(job.format),
        submitted_unix_ms: job.submitted_unix_ms,
        finished_unix_ms: job.finished_unix_ms,
    }
}

/// A job, or the field that is wrong.
pub fn job_from_wire(job: v1::Job) -> Result<Job, WireError> {
    Ok(Job {
        job_id: name_from_wire("job_id", job.job_id)?,
        client_key: name_from_wire("client_key", job.client_key)?,
        state: state_from_wire("state", job.state)?,
        message: reason_from_wire("message", job.message)?,
        frames_done: job.frames_done,
        frames_total: job.frames_total,
        size: size_from_wire(job.width, job.height)?,
        format: format_from_wire("format", job.format)?,
        submitted_unix_ms: job.submitted_unix_ms,
        finished_unix_ms: job.finished_unix_ms,
    })
}

/// The volume of a master.
pub fn volume_to_wire(volume: &VolumeDescription) -> v1::VolumeDescription {
    v1::VolumeDescription {
        name: volume.name.clone(),
        file_type: volume.file_type.clone(),
        anatomical: volume.anatomical,
        info: Some(info_to_wire(&volume.info)),
        up: volume.orientation.up.to_string(),
        front: volume.orientation.front.to_string(),
        pixels_version: volume.pixels_version,
        protocol_version: volume.protocol_version,
        now_unix_ms: volume.now_unix_ms,
    }
}

/// The volume of a master, or the field that is wrong.
pub fn volume_from_wire(volume: v1::VolumeDescription) -> Result<VolumeDescription, WireError> {
    // A file's name may be anything that the master's file system allows.
    for (field, text) in [("name", &volume.name), ("file_type", &volume.file_type)] {
        if text.len() > super::MAX_REASON {
            return Err(WireError::too_long(field, text.len(), super::MAX_REASON));
        }
    }
    let (up, front) = (axis_from_wire("up", &volume.up)?, axis_from_wire("front", &volume.front)?);
    Ok(VolumeDescription {
        name: volume.name,
        file_type: volume.file_type,
        anatomical: volume.anatomical,
        info: info_from_wire(required("info", volume.info)?).map_err(|e| e.within("info"))?,
        orientation: Orientation::new(Some(up), Some(front))?,
        pixels_version: volume.pixels_version,
        protocol_version: volume.protocol_version,
        now_unix_ms: volume.now_unix_ms,
    })
}

/// A worker, for clients.
pub fn worker_to_wire(worker: &Worker) -> v1::Worker {
    v1::Worker {
        id: worker.id.0,
        name: worker.name.clone(),
        address: worker.address.clone(),
        threads: worker.threads,
        simd: worker.simd.clone(),
        memory_budget_bytes: worker.memory_budget_bytes,
        held_bytes: worker.held_bytes,
        held_bricks: worker.held_bricks,
        tasks_lent: worker.tasks_lent,
        tasks_done: worker.tasks_done,
        silent_ms: worker.silent_ms,
        here_ms: worker.here_ms,
        in_reserve: worker.in_reserve,
    }
}

/// A worker, or the field that is wrong.
pub fn worker_from_wire(worker: v1::Worker) -> Result<Worker, WireError> {
    Ok(Worker {
        id: WorkerId(worker.id),
        name: name_from_wire("name", worker.name)?,
        address: optional_name_from_wire("address", worker.address)?,
        threads: worker.threads,
        simd: optional_name_from_wire("simd", worker.simd)?,
        memory_budget_bytes: worker.memory_budget_bytes,
        held_bytes: worker.held_bytes,
        held_bricks: worker.held_bricks,
        tasks_lent: worker.tasks_lent,
        tasks_done: worker.tasks_done,
        silent_ms: worker.silent_ms,
        here_ms: worker.here_ms,
        in_reserve: worker.in_reserve,
    })
}

const _: () = assert!(MAX_NAME >= 64, "job ids, addresses and names of CPUs fit");
