//! Where frames come from: a job's updates, of a cluster in this process or behind a network.

use crate::fail::Fail;
use crate::output::Frame;
use crate::progress::Step;
use crate::remote;
use slabcast_common::ids::JobId;
use slabcast_common::stats::FrameStats;
use std::time::Duration;
use tokio::sync::mpsc;

/// How long cancelling may take before the command ends without the master's word.
const CANCEL: Duration = Duration::from_secs(2);

/// News of the job.
pub(crate) enum Update {
    /// Where it stands.
    Step(Step),
    /// A frame, its statistics, those as JSON, and its trace.
    Frame {
        frame: Frame,
        /// Where a master made the frame.
        stats: Option<Box<FrameStats>>,
        stats_json: String,
        trace_json: String,
    },
    /// It ended with all frames delivered.
    Done,
}

/// Where updates come from, and how to cancel. One message of room: frames wait at the master,
/// not here.
pub(crate) struct Source {
    pub(crate) updates: mpsc::Receiver<Result<Update, Fail>>,
    pub(crate) cancel: Cancel,
}

/// How a job is cancelled.
pub(crate) enum Cancel {
    /// Nobody waits for it.
    None,
    Embedded(slabcast_master::Handle, JobId),
    Remote(remote::Cancel),
}

impl Cancel {
    /// Cancels, in bounded time, whether the master hears it or not.
    pub(crate) async fn now(self) {
        let cancelled = async {
            match self {
                Cancel::None => {}
                Cancel::Embedded(handle, job) => {
                    handle.cancel(job).await;
                }
                Cancel::Remote(cancel) => cancel.now().await,
            }
        };
        let _ = tokio::time::timeout(CANCEL, cancelled).await;
    }
}
