//! What the Render service says about jobs, workers and frames, as values.
//!
//! Master and client share these; they are not in `common` because no pixel and no schedule
//! depends on them. Meanings are those of `render.proto`.

use bytes::Bytes;
use slabcast_common::ids::WorkerId;
use slabcast_common::image::PixelFormat;
use slabcast_common::path::Orientation;
use slabcast_common::volume::VolumeInfo;

/// What becomes of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum JobState {
    /// Others come first.
    Queued,
    /// It would run, but no worker is there.
    WaitingForWorkers,
    /// Its frames are being rendered.
    Running,
    /// All frames are finished.
    Done,
    /// It can't be finished.
    Failed,
    /// Somebody cancelled it.
    Cancelled,
}

impl JobState {
    /// Whether nothing more will happen to it.
    pub fn is_final(self) -> bool {
        matches!(self, JobState::Done | JobState::Failed | JobState::Cancelled)
    }
}

impl std::fmt::Display for JobState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            JobState::Queued => "queued",
            JobState::WaitingForWorkers => "waiting for workers",
            JobState::Running => "running",
            JobState::Done => "done",
            JobState::Failed => "failed",
            JobState::Cancelled => "cancelled",
        })
    }
}

/// News of a job, between its frames.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JobNotice {
    /// Its state.
    pub state: JobState,
    /// Frames that are finished.
    pub frames_done: u64,
    /// Frames of the path.
    pub frames_total: u64,
    /// Workers that are there.
    pub workers: u32,
    /// For people: why it waits or failed, and what to do. May be empty.
    pub message: String,
}

/// A job as the master knows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Job {
    /// Its name.
    pub job_id: String,
    /// The submitter's name for it.
    pub client_key: String,
    /// Its state.
    pub state: JobState,
    /// Why it waits or failed, and what to do. May be empty.
    pub message: String,
    /// Frames that are finished.
    pub frames_done: u64,
    /// Frames of the path.
    pub frames_total: u64,
    /// Width and height of its frames in pixels.
    pub size: [u32; 2],
    /// Format of its frames.
    pub format: PixelFormat,
    /// When it was submitted, in milliseconds since 1970 UTC.
    pub submitted_unix_ms: i64,
    /// When it reached a final state, likewise; 0 before.
    pub finished_unix_ms: i64,
}

/// The volume that a master serves.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeDescription {
    /// What it is called.
    pub name: String,
    /// The sample type in the file, for people.
    pub file_type: String,
    /// Whether the file says where right, anterior and superior are.
    pub anatomical: bool,
    /// Lattice, values and digest.
    pub info: VolumeInfo,
    /// Up and front unless a path says otherwise.
    pub orientation: Orientation,
    /// `PIXELS_VERSION` of the master.
    pub pixels_version: u32,
    /// `PROTOCOL_VERSION` of the master.
    pub protocol_version: u32,
    /// The master's clock, milliseconds since 1970; 0 where it does not say.
    pub now_unix_ms: i64,
}

/// A worker as the master knows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Worker {
    /// Its number.
    pub id: WorkerId,
    /// Its name for people.
    pub name: String,
    /// Where it called from; empty for one inside the master's process.
    pub address: String,
    /// Render threads.
    pub threads: u32,
    /// Instruction set of its splat loops.
    pub simd: String,
    /// Bytes of bricks that it may hold.
    pub memory_budget_bytes: u64,
    /// Bytes of bricks that it holds.
    pub held_bytes: u64,
    /// Bricks that it holds.
    pub held_bricks: u64,
    /// Tasks that are lent to it now.
    pub tasks_lent: u32,
    /// Tasks that it has finished since it came.
    pub tasks_done: u64,
    /// Milliseconds since the master last heard of it.
    pub silent_ms: u64,
    /// Milliseconds since it came.
    pub here_ms: u64,
    /// It is lent nothing for now: the others draw as many frames without it.
    pub in_reserve: bool,
}

/// A piece of a frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PixelsChunk {
    /// Which frame of the path.
    pub frame: u64,
    /// Width and height in pixels, 1 to 8192 each.
    pub size: [u32; 2],
    /// Format of the pixels.
    pub format: PixelFormat,
    /// Where `data` belongs in the frame's bytes.
    pub offset: u64,
    /// Pixels; `offset + data.len()` is not beyond the frame's end.
    pub data: Bytes,
    /// Whether the frame is whole with this chunk.
    pub last: bool,
    /// A piece of the frame's statistics.
    pub stats_json: String,
    /// A piece of the frame's trace.
    pub trace_json: String,
}

/// One message of a watch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum FrameChunk {
    /// A piece of a frame.
    Pixels(PixelsChunk),
    /// News of the job.
    Notice(JobNotice),
}
