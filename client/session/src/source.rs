//! Sources of frames: the updates of a job, from a cluster in this process or over a network.

use crate::fail::Fail;
use crate::output::Frame;
use crate::progress::Step;
use slabcast_common::stats::FrameStats;
use slabcast_scene::path::Framing;
use std::future::Future;
use std::pin::Pin;
use std::time::Duration;
use tokio::sync::mpsc;

/// Time for cancelling before the command ends without the master's answer.
const CANCEL: Duration = Duration::from_secs(2);

/// News of a job from whoever renders it.
pub enum Update {
    /// The job's state.
    Step(Step),
    /// A frame, its statistics, those as JSON, and its trace.
    Frame {
        /// Pixels of the frame.
        frame: Frame,
        /// Statistics, if a master made the frame.
        stats: Option<Box<FrameStats>>,
        /// Statistics as one line of JSON.
        stats_json: String,
        /// Time line as JSON; empty unless asked for.
        trace_json: String,
    },
    /// A frame could not be drawn; others come after it.
    FrameFailed {
        /// Number of the frame in its job, from 0.
        number: u64,
        /// Why, for people; one line.
        reason: String,
    },
    /// The job ended with all frames delivered but those that failed.
    Done,
}

/// Updates of a job, and a way to cancel it. The channel holds one message: frames wait at the
/// master.
pub struct Source {
    /// Updates of the job, in order; the last is `Done` or an error.
    pub updates: mpsc::Receiver<Result<Update, Fail>>,
    /// Way to cancel the job at the master.
    pub cancel: Cancel,
    /// Target and height that the master gave the path, if it asked for them.
    pub framing: Option<Framing>,
}

/// Cancels one job, whoever renders it.
pub struct Cancel(Pin<Box<dyn Future<Output = ()> + Send>>);

impl Cancel {
    /// Wraps the future that tells the master; it runs only if [`Cancel::now`] is called.
    pub fn new(cancel: impl Future<Output = ()> + Send + 'static) -> Cancel {
        Cancel(Box::pin(cancel))
    }

    /// Returns a `Cancel` that does nothing, for frames that no job delivers.
    pub fn none() -> Cancel {
        Cancel::new(std::future::ready(()))
    }

    /// Tells the master, and waits at most two seconds for its answer.
    pub async fn now(self) {
        let _ = tokio::time::timeout(CANCEL, self.0).await;
    }
}
