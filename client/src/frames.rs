//! Receives a job's frames: assembles them from chunks, and continues after a break.

use crate::error::one_line;
use crate::{ANSWER, Client, ClientError, JobNotice, JobState};
use slabcast_common::image::PixelFormat;
use slabcast_common::stats::FrameStats;
use slabcast_proto::convert::{self, StatisticsParts};
use slabcast_proto::model::{FrameChunk, FrameFailure, WatchMessage};
use slabcast_proto::render_v1 as wire;
use std::time::Duration;
use tokio::time::Instant;
use tonic::{Code, Status, Streaming};

/// Time to wait for a master that is away, unless the caller says otherwise: a restart takes
/// seconds, reading a large volume again up to a minute.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// First wait before a connection is made again; it doubles up to [`LONGEST_WAIT`].
const FIRST_WAIT: Duration = Duration::from_millis(100);
const LONGEST_WAIT: Duration = Duration::from_secs(2);

/// A stream that lived this long was healthy: when it breaks, patience starts anew. Shorter,
/// and a master that dies of each watch would be called for ever.
const HEALTHY: Duration = Duration::from_secs(10);

/// Bytes that are allocated for a frame on the word of its first chunk. A frame of 8192x8192 floats
/// has 1 GiB; memory for the rest is allocated as it arrives.
const PREALLOCATED_BYTES: usize = 64 << 20;

/// Bytes of the longest trace of one frame.
const MAX_TRACE_BYTES: usize = 256 << 20;

/// Damaged messages without a whole frame after which the connection counts as broken. A line that
/// damages half of all frames damages so many in a row once in a million.
const MOST_DAMAGED: u32 = 20;

/// Longest silence of a watch before the client begins it anew. Masters repeat their latest notice
/// every 10 s, and a chunk of 1 MiB takes 30 s at 280 kb/s.
const STALLED: Duration = Duration::from_secs(30);

/// Whether a stream ended since a message was damaged: DATA_LOSS, or INTERNAL from a message that
/// can't be decoded. A master's own INTERNAL ends the next stream as well, until patience is used
/// up.
fn is_damage(status: &Status) -> bool {
    matches!(status.code(), Code::DataLoss | Code::Internal)
}

/// An event of a job: news, or a frame.
#[derive(Clone, Debug, PartialEq)]
pub enum Update {
    /// News of the job.
    Notice(JobNotice),
    /// A whole frame.
    Frame(Box<ReceivedFrame>),
    /// A frame that could not be drawn. Frames after it come all the same.
    FrameFailed {
        /// Number of the frame in its job, from 0.
        number: u64,
        /// Why, for people; one line.
        reason: String,
    },
}

/// A whole frame as a client received it: pixels and statistics.
#[derive(Clone, Debug, PartialEq)]
pub struct ReceivedFrame {
    /// Number of the frame in its job, from 0.
    pub number: u64,
    /// Width and height of the frame in pixels.
    pub size: [u32; 2],
    /// Format of the pixels in `bytes`.
    pub format: PixelFormat,
    /// Pixels, row-major from the top left, without padding.
    pub bytes: Vec<u8>,
    /// Statistics of the frame's rendering.
    pub stats: FrameStats,
    /// Statistics as one line of JSON, version 1 (docs: statistics).
    pub stats_json: String,
    /// Spans for a trace, if the request wanted them.
    pub trace_json: Option<String>,
}

/// The frames of a job, in order. Dropping it cancels nothing.
#[derive(Debug)]
pub struct FrameStream {
    client: Client,
    job: String,
    /// The first frame that is not whole.
    next: u64,
    stream: Option<Open>,
    partial: Option<Partial>,
    /// Messages that arrived damaged, in all and since the last whole frame.
    damaged_messages: u64,
    damaged_in_a_row: u32,
    /// The latest notice.
    latest: Option<JobNotice>,
    /// Whether the master ended the stream with all that was to come.
    over: bool,
    /// Time that the master may stay away; `None`: a break is an error.
    patience: Option<Duration>,
    outage: Option<Outage>,
}

#[derive(Debug)]
struct Open {
    chunks: Streaming<wire::WatchFramesResponse>,
    since: Instant,
    /// Time at which the wait for the next message began; `None` if none is waited for. A field, since
    /// [`FrameStream::next`] may be dropped and called again.
    waiting_since: Option<Instant>,
}

/// A time without a master.
#[derive(Debug)]
struct Outage {
    since: Instant,
    wait: Duration,
}

impl FrameStream {
    pub(crate) async fn open(
        client: Client,
        job: String,
        from_frame: u64,
        patience: Option<Duration>,
    ) -> Result<FrameStream, ClientError> {
        let mut frames = FrameStream {
            client,
            job,
            next: from_frame,
            stream: None,
            partial: None,
            damaged_messages: 0,
            damaged_in_a_row: 0,
            latest: None,
            over: false,
            patience,
            outage: None,
        };
        while frames.stream.is_none() {
            if let Err(e) = frames.reopen().await {
                frames.wait_out(e).await?;
            }
        }
        Ok(frames)
    }

    /// Returns the id of the job whose frames these are.
    pub fn job(&self) -> &str {
        &self.job
    }

    /// Returns the number of the first frame that has not come whole: where to continue after an
    /// error.
    pub fn next_frame(&self) -> u64 {
        self.next
    }

    /// Returns the next notice, whole frame or failure of a frame; `None` after the last frame of a
    /// job that is done.
    ///
    /// May be dropped before it is ready (in a `select!`) without losing anything.
    ///
    /// # Errors
    /// [`ClientError::JobFailed`] and [`ClientError::JobCancelled`] after the last frame of such a
    /// job, also where some of its frames failed and all others came; [`ClientError::Lost`] or [`ClientError::GaveUp`] if the connection breaks, by
    /// [`Client::watch`] or [`Client::follow`]; [`ClientError::FrameNotKept`] if the master no
    /// longer keeps the next frame; [`ClientError::Protocol`] if the chunks of a frame do not fit
    /// together.
    pub async fn next(&mut self) -> Result<Option<Update>, ClientError> {
        loop {
            if self.over {
                let job = self.job.clone();
                return match &self.latest {
                    Some(JobNotice { state: JobState::Failed, message, .. }) => {
                        Err(ClientError::JobFailed { job, reason: one_line(message) })
                    }
                    Some(JobNotice { state: JobState::Cancelled, .. }) => {
                        Err(ClientError::JobCancelled { job })
                    }
                    _ => Ok(None),
                };
            }
            match self.step().await {
                Ok(Some(update)) => return Ok(Some(update)),
                Ok(None) => {}
                Err(e) => self.wait_out(e).await?,
            }
        }
    }

    /// Reads one message; returns an update if that completes one.
    async fn step(&mut self) -> Result<Option<Update>, ClientError> {
        let Some(open) = &mut self.stream else {
            self.reopen().await?;
            return Ok(None);
        };
        let since = *open.waiting_since.get_or_insert_with(Instant::now);
        let Ok(message) = tokio::time::timeout_at(since + STALLED, open.chunks.message()).await
        else {
            let cause = format!("no message of the watch in {} s", STALLED.as_secs());
            return Err(self.lost(cause));
        };
        open.waiting_since = None;
        let chunk = match message {
            Ok(Some(chunk)) => chunk,
            Ok(None) if self.has_all() => {
                self.over = true;
                return Ok(None);
            }
            Ok(None) => {
                return Err(self.lost("the stream ended before the job did".into()));
            }
            Err(status) if is_damage(&status) => return self.damaged(status.message()),
            Err(status) => return Err(ClientError::from_status(self.client.address(), &status)),
        };
        match convert::watch_from_wire(chunk).map_err(|e| self.client.protocol_error(&e))? {
            WatchMessage::Notice(notice) => {
                self.latest = Some(notice.clone());
                Ok(Some(Update::Notice(notice)))
            }
            WatchMessage::Failed(FrameFailure { frame, reason }) => {
                if frame != self.next || self.partial.is_some() {
                    let problem = format!("frame {frame} failed instead of {}", self.next);
                    return Err(self.client.protocol_error(&problem));
                }
                self.next += 1;
                self.outage = None;
                let reason = one_line(&reason);
                Ok(Some(Update::FrameFailed { number: frame, reason }))
            }
            WatchMessage::Chunk(chunk) => {
                let frame =
                    self.add(chunk).map_err(|problem| self.client.protocol_error(&problem))?;
                Ok(frame.map(|f| Update::Frame(Box::new(f))))
            }
        }
    }

    /// Drops the stream and what came of the frame, since a message was damaged on its way: the next
    /// step watches again from that frame.
    ///
    /// # Errors
    /// [`ClientError::Lost`] if that happened [`MOST_DAMAGED`] times without a whole frame.
    fn damaged(&mut self, cause: &str) -> Result<Option<Update>, ClientError> {
        self.damaged_messages += 1;
        self.damaged_in_a_row += 1;
        self.stream = None;
        self.partial = None;
        if self.damaged_in_a_row < MOST_DAMAGED {
            return Ok(None);
        }
        self.damaged_in_a_row = 0;
        let cause = format!("frame {} is damaged on its way: {}", self.next, one_line(cause));
        Err(self.lost(cause))
    }

    /// Returns the error of a connection that broke for `cause`.
    fn lost(&self, cause: String) -> ClientError {
        ClientError::Lost { address: self.client.address().to_owned(), cause, retry_after: None }
    }

    /// Returns how many messages arrived damaged and were asked for again.
    pub fn damaged_messages(&self) -> u64 {
        self.damaged_messages
    }

    /// Whether nothing is missing of a stream that ends here.
    fn has_all(&self) -> bool {
        self.partial.is_none()
            && self.latest.as_ref().is_some_and(|notice| match notice.state {
                JobState::Done => self.next >= notice.frames_total,
                // All frames came to an end, and some failed.
                JobState::Failed if notice.frames_failed > 0 => self.next >= notice.frames_total,
                state => state.is_final(),
            })
    }

    /// Watches from the first frame that is not whole. Leaves no stream if the request was damaged on
    /// its way.
    async fn reopen(&mut self) -> Result<(), ClientError> {
        self.partial = None;
        let (job_id, from_frame) = (self.job.clone(), self.next);
        let request = wire::WatchFramesRequest { job_id, from_frame };
        let mut render = self.client.render.clone();
        // Not the call's own deadline: that would end the stream, too.
        let stream = match tokio::time::timeout(ANSWER, render.watch_frames(request)).await {
            Ok(Ok(stream)) => stream.into_inner(),
            // The request arrived damaged: no reason to wait, and no stream yet.
            Ok(Err(status)) if status.code() == Code::DataLoss => {
                return self.damaged(status.message()).map(drop);
            }
            Ok(Err(status)) => {
                return Err(ClientError::from_status(self.client.address(), &status));
            }
            Err(_) => return Err(self.lost(format!("no answer in {} s", ANSWER.as_secs()))),
        };
        self.stream = Some(Open { chunks: stream, since: Instant::now(), waiting_since: None });
        Ok(())
    }

    /// Waits after an error until it is time to call again.
    ///
    /// # Errors
    /// The error itself if it will not pass, or [`ClientError::GaveUp`] if patience is used up.
    async fn wait_out(&mut self, error: ClientError) -> Result<(), ClientError> {
        let lived = self.stream.take().map(|open| open.since.elapsed());
        self.partial = None;
        let Some(patience) = self.patience.filter(|_| error.is_passing()) else {
            return Err(error);
        };
        if lived.is_some_and(|lived| lived >= HEALTHY) {
            self.outage = None;
        }
        let now = Instant::now();
        let outage = self.outage.get_or_insert(Outage { since: now, wait: FIRST_WAIT });
        // A master that asks for more is waited for longer, within reason.
        let wait = outage.wait.max(error.retry_after().unwrap_or_default()).min(LONGEST_WAIT);
        outage.wait = (2 * wait).min(LONGEST_WAIT);
        let after = now - outage.since;
        if after + wait > patience {
            return Err(ClientError::GaveUp {
                address: self.client.address().to_owned(),
                after,
                last: match error {
                    ClientError::Lost { cause, .. } | ClientError::Connect { cause, .. } => cause,
                    other => other.to_string(),
                },
                next_frame: self.next,
            });
        }
        tokio::time::sleep(wait).await;
        Ok(())
    }

    /// Adds a chunk; returns the frame if that completes it.
    fn add(&mut self, chunk: FrameChunk) -> Result<Option<ReceivedFrame>, String> {
        if chunk.frame != self.next {
            return Err(format!("frame {} came instead of {}", chunk.frame, self.next));
        }
        let partial = self.partial.get_or_insert_with(|| Partial::new(&chunk));
        let last = chunk.last;
        partial.add(chunk)?;
        if !last {
            return Ok(None);
        }
        let whole = self.partial.take().expect("a chunk was added to it").finish(self.next)?;
        self.next += 1;
        self.damaged_in_a_row = 0;
        self.outage = None;
        Ok(Some(whole))
    }
}

/// A frame of which chunks are missing.
#[derive(Debug)]
struct Partial {
    size: [u32; 2],
    format: PixelFormat,
    /// Bytes of the whole frame.
    whole: usize,
    bytes: Vec<u8>,
    statistics: StatisticsParts,
    trace_json: String,
}

impl Partial {
    fn new(first: &FrameChunk) -> Self {
        let whole = first.size[0] as usize * first.size[1] as usize * first.format.bytes();
        Partial {
            size: first.size,
            format: first.format,
            whole,
            bytes: Vec::with_capacity(whole.min(PREALLOCATED_BYTES)),
            statistics: StatisticsParts::default(),
            trace_json: String::new(),
        }
    }

    fn add(&mut self, chunk: FrameChunk) -> Result<(), String> {
        if (chunk.size, chunk.format) != (self.size, self.format) {
            return Err(format!("frame {} changes its size or format", chunk.frame));
        }
        if chunk.offset != self.bytes.len() as u64 {
            return Err(format!(
                "frame {} goes on at byte {} instead of {}",
                chunk.frame,
                chunk.offset,
                self.bytes.len()
            ));
        }
        self.bytes.extend_from_slice(&chunk.data);
        if let Some(part) = chunk.statistics {
            let added = self.statistics.add(part);
            added.map_err(|e| format!("frame {}: {e}", chunk.frame))?;
        }
        if self.trace_json.len() + chunk.trace_json.len() > MAX_TRACE_BYTES {
            return Err(format!("frame {} has too long a trace", chunk.frame));
        }
        self.trace_json.push_str(&chunk.trace_json);
        Ok(())
    }

    fn finish(self, number: u64) -> Result<ReceivedFrame, String> {
        if self.bytes.len() != self.whole {
            return Err(format!(
                "frame {number} has {} bytes instead of {}",
                self.bytes.len(),
                self.whole
            ));
        }
        let stats = self.statistics.finish().map_err(|e| format!("frame {number}: {e}"))?;
        Ok(ReceivedFrame {
            number,
            size: self.size,
            format: self.format,
            bytes: self.bytes,
            stats_json: serde_json::to_string(&stats).map_err(|e| e.to_string())?,
            stats,
            trace_json: Some(self.trace_json).filter(|t| !t.is_empty()),
        })
    }
}
