//! Jobs, workers and frames as RenderService tells of them.
//!
//! Master and client share these types; they are not in `common` because no pixel and no schedule
//! depends on them. Meanings are those of `render.proto`.

use crate::convert::StatisticsPart;
use bytes::Bytes;
use slabcast_common::ids::WorkerId;
use slabcast_common::image::PixelFormat;
use slabcast_common::volume::{Digest32, SampleKind, VolumeInfo};
use slabcast_scene::path::Orientation;
use std::time::Duration;

/// State of a job, from its queue to its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum JobState {
    /// Other jobs come first.
    Queued,
    /// Bricks of the job are being cut from the volume.
    Preparing,
    /// The job would run, but no worker is connected.
    WaitingForWorkers,
    /// Frames of the job are being rendered.
    Running,
    /// All frames are finished.
    Done,
    /// The job can't be finished, or is over with some frames failed.
    Failed,
    /// The job was cancelled.
    Cancelled,
}

impl JobState {
    /// Returns whether the job stays in this state for ever.
    pub fn is_final(self) -> bool {
        matches!(self, JobState::Done | JobState::Failed | JobState::Cancelled)
    }
}

impl std::fmt::Display for JobState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            JobState::Queued => "queued",
            JobState::Preparing => "preparing",
            JobState::WaitingForWorkers => "waiting for workers",
            JobState::Running => "running",
            JobState::Done => "done",
            JobState::Failed => "failed",
            JobState::Cancelled => "cancelled",
        })
    }
}

/// State of a job, sent between its frames.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JobNotice {
    /// State that the job is in now.
    pub state: JobState,
    /// Number of the job's frames that are finished.
    pub frames_done: u64,
    /// Number of the job's frames that failed.
    pub frames_failed: u64,
    /// Number of frames in the job's path.
    pub frames_total: u64,
    /// Render threads of the workers that are connected.
    pub render_threads: u32,
    /// For people: why the job waits or failed, and what to do. May be empty.
    pub message: String,
}

/// A job as the master knows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Job {
    /// Id of the job, for all calls (`job-7`).
    pub job_id: String,
    /// Name that the submitter gave the job.
    pub client_key: String,
    /// State that the job is in now.
    pub state: JobState,
    /// For people: why the job waits or failed, and what to do. May be empty.
    pub message: String,
    /// Number of the job's frames that are finished.
    pub frames_done: u64,
    /// Number of the job's frames that failed.
    pub frames_failed: u64,
    /// Number of frames in the job's path.
    pub frames_total: u64,
    /// Width and height of the job's frames in pixels.
    pub size: [u32; 2],
    /// Pixel format of the job's frames.
    pub format: PixelFormat,
    /// Time at which the job was submitted, in milliseconds since 1970 UTC.
    pub submitted_unix_ms: i64,
    /// Time at which the job reached a final state, in milliseconds since 1970 UTC; 0 before.
    pub finished_unix_ms: i64,
    /// Digest and name of the volume that it draws; `None` of a master that does not say.
    pub volume: Option<(Digest32, String)>,
}

/// A volume in a master's list.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeEntry {
    /// Name of the volume, as the caller may know it.
    pub name: String,
    /// Digest, numbers of samples and their type; `None` while the file was not read.
    pub read: Option<(Digest32, [u32; 3], SampleKind)>,
    /// Bytes of the samples, or of the file while it was not read; 0 of a folder.
    pub bytes: u64,
    /// Origin of the volume.
    pub origin: VolumeOrigin,
    /// Whether its samples are in memory.
    pub in_memory: bool,
    /// Why its file can't be read, if that was tried; empty otherwise.
    pub problem: String,
}

/// A page of a master's volumes, and what the master says of itself.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VolumeList {
    /// Volumes, by name.
    pub volumes: Vec<VolumeEntry>,
    /// Version of the pixels, `PIXELS_VERSION`, of the master's program.
    pub pixels_version: u32,
    /// The master's `PROTOCOL_VERSION`: the newest version of `slabcast.cluster.v1` it speaks.
    pub protocol_version: u32,
    /// The master's clock, in milliseconds since 1970 UTC; 0 if it does not say.
    pub now_unix_ms: i64,
}

/// Origin of a volume of a master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VolumeOrigin {
    /// The master was started with it.
    Given,
    /// A file of the master's folder of volumes.
    Folder,
    /// A client put it there.
    Upload,
}

/// A volume that a client puts on a master, without its samples.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeHeader {
    /// Name that it gets.
    pub name: String,
    /// The sample type in the file, for people.
    pub file_type: String,
    /// Lattice, values and digest. A master counts range and histogram itself.
    pub info: VolumeInfo,
    /// Axes that are up and front unless a path says otherwise.
    pub orientation: Orientation,
}

/// A part of an upload.
#[derive(Clone, Debug, PartialEq)]
pub enum UploadPart {
    /// Header of the volume that is uploaded.
    Begin(Box<VolumeHeader>),
    /// Bytes of its samples.
    Chunk {
        /// Digest of the volume.
        digest: Digest32,
        /// Offset of `data` among the bytes of the samples.
        offset: u64,
        /// The bytes, little-endian.
        data: Bytes,
    },
}

/// A volume of a master.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeDescription {
    /// Name of the volume's file, without folders.
    pub name: String,
    /// The sample type in the file, for people.
    pub file_type: String,
    /// Whether the file says where right, anterior and superior are.
    pub anatomical: bool,
    /// Lattice of the volume, summary of its values, and its digest.
    pub info: VolumeInfo,
    /// Axes that are up and front unless a path says otherwise.
    pub orientation: Orientation,
    /// Version of the pixels, `PIXELS_VERSION`, of the master's program.
    pub pixels_version: u32,
    /// The master's `PROTOCOL_VERSION`: the newest version of `slabcast.cluster.v1` it speaks.
    pub protocol_version: u32,
    /// The master's clock, in milliseconds since 1970 UTC; 0 if it does not say.
    pub now_unix_ms: i64,
}

/// A worker as the master knows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Worker {
    /// Id of the worker, never given to another.
    pub id: WorkerId,
    /// Name for people (host and process), which statistics use.
    pub name: String,
    /// Address that the worker called from; empty for a worker within the master's process.
    pub address: String,
    /// Number of the worker's render threads.
    pub threads: u32,
    /// Instruction set that the worker's renderer uses.
    pub simd: String,
    /// Bytes of bricks that the worker may hold.
    pub memory_budget_bytes: u64,
    /// Bytes of bricks that the worker holds.
    pub held_bytes: u64,
    /// Number of bricks that the worker holds.
    pub held_bricks: u64,
    /// Number of tasks that are lent to the worker now.
    pub tasks_lent: u32,
    /// Number of tasks that the worker has finished since it joined.
    pub tasks_done: u64,
    /// Time since the master last heard from the worker.
    pub silent: Duration,
    /// Time since the worker joined.
    pub connected: Duration,
    /// Whether the worker is lent nothing for now, since frames would not be finished sooner with
    /// it.
    pub in_reserve: bool,
    /// Number of messages that were damaged on their way to or from the worker since it joined, and
    /// were sent again.
    pub damaged_messages: u64,
    /// Smallest round trip of the master's most recent pings; `None` before the worker answered one.
    pub round_trip: Option<Duration>,
    /// Last failure of a worker with this name on this machine, former connections included.
    pub last_error: Option<WorkerError>,
}

/// A worker's failure: a failed task, a damaged message, a connection that ended without Goodbye, or a worker
/// that the master dropped.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorkerError {
    /// When the master noted it, in milliseconds since 1970 UTC.
    pub at_unix_ms: i64,
    /// For people: what failed, and why.
    pub reason: String,
}

/// A piece of a finished frame on its way to a client.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameChunk {
    /// Number of the frame in its job, from 0.
    pub frame: u64,
    /// Width and height in pixels, 1 to 8192 each.
    pub size: [u32; 2],
    /// Format of the frame's pixels.
    pub format: PixelFormat,
    /// Offset of `data` within the frame, in bytes.
    pub offset: u64,
    /// Pixels; `offset + data.len()` is not beyond the frame's end.
    pub data: Bytes,
    /// Whether the frame is complete with this chunk.
    pub last: bool,
    /// A part of the frame's statistics.
    pub statistics: Option<StatisticsPart>,
    /// A piece of the frame's trace, in JSON.
    pub trace_json: String,
}

/// A frame that could not be drawn.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameFailure {
    /// Number of the frame in its job, from 0.
    pub frame: u64,
    /// For people: which part of it failed, what the workers that tried it said, what to do.
    pub reason: String,
}

/// One message of `WatchFrames`: a piece of a frame, its failure, or news of the job.
#[derive(Clone, Debug, PartialEq)]
pub enum WatchMessage {
    /// A piece of a frame.
    Chunk(FrameChunk),
    /// News of the job.
    Notice(JobNotice),
    /// In place of a frame's chunks: it failed.
    Failed(FrameFailure),
}
