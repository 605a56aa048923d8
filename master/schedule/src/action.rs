//! Actions: the scheduler's outputs, which its driver carries out; and views of its state.

use crate::{Micros, Spans, WorkerIdentity};
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{BrickId, FrameId, WorkerId};
use slabcast_common::image::{FrameState, SparseTile};
use slabcast_common::message::ToWorker;
use slabcast_common::occlusion::Rect;
use slabcast_common::stats::{FrameStats, PoisonedTile};

/// An output of the scheduler for its driver to carry out, from
/// [`Scheduler::next_action`](crate::Scheduler::next_action).
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "a view in a message; there is one action at a time")]
pub enum Action {
    /// Send a control message. For each worker a scene precedes its first frame, and a frame
    /// precedes its first lease.
    Send {
        /// The recipient.
        worker: WorkerId,
        /// The message.
        message: ToWorker,
    },
    /// Send bricks, in this order. The worker holds none of them.
    SendBricks {
        /// The recipient.
        worker: WorkerId,
        /// Their set.
        set: BrickSetKey,
        /// Ids of the bricks.
        bricks: Vec<BrickId>,
    },
    /// Close a worker's link. The scheduler has forgotten the worker.
    Drop {
        /// The worker.
        worker: WorkerId,
        /// Reason, for logs.
        reason: String,
    },
    /// Report progress to watchers.
    Progress {
        /// The frame.
        frame: FrameId,
        /// Tiles of the slab that are rendered or given up.
        done: u32,
        /// Tiles of the slab.
        total: u32,
        /// Index of the slab.
        slab: u32,
        /// Slabs of the frame.
        slabs: u32,
    },
    /// Finished tiles may be laid into the picture while others are rendered.
    Finished {
        /// The frame.
        frame: FrameId,
        /// Tile rectangles in pixels, with their finished pixels.
        tiles: Vec<(Rect, SparseTile)>,
    },
    /// A frame is complete.
    FrameDone {
        /// The frame.
        frame: FrameId,
        /// The picture, without the tiles that left in [`Action::Finished`].
        state: Box<FrameState>,
        /// The frame's statistics. The driver fills in both hashes, `left_out` and `error`.
        stats: Box<FrameStats>,
        /// Timeline of the frame, ordered by end times.
        spans: Spans,
    },
    /// A frame can't be rendered: a tile of it was given up.
    FrameFailed {
        /// The frame.
        frame: FrameId,
        /// Reason, for users: which tile, and what became of each worker that tried it.
        reason: String,
        /// The tile.
        tile: PoisonedTile,
    },
    /// A worker drew other pixels than two others, or than one that is trusted. The scheduler has
    /// forgotten it: close its link and let it in no more.
    ShutOut {
        /// The worker's last id.
        worker: WorkerId,
        /// Host and name of the worker, which stay the same when it dials again.
        identity: WorkerIdentity,
        /// The frame.
        frame: FrameId,
        /// The tile, in pixels.
        tile: Rect,
    },
    /// A frame has tiles of a worker that was shut out, which nobody has compared. The scheduler has
    /// forgotten the frame: queue it again, under a new id.
    FrameTainted {
        /// The frame.
        frame: FrameId,
    },
    /// A worker failed again and again: it is lent nothing for a while.
    Paused {
        /// The worker.
        worker: WorkerId,
        /// Failures that were not made up for by results.
        failures: u32,
        /// Duration of the pause in microseconds.
        pause_us: Micros,
    },
}

/// An interval in a frame's timeline, on the master's clock.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Span {
    /// Label of the interval, for people.
    pub name: String,
    /// Kind of the interval: `frame`, `slab`, `tile` or `bricks`.
    pub category: &'static str,
    /// Name of the worker that the interval belongs to; `None` for the master.
    pub worker: Option<String>,
    /// Index of the worker's render thread, from 0.
    pub thread: u32,
    /// Start of the interval, in microseconds on the master's clock.
    pub start: Micros,
    /// End of the interval, in microseconds on the master's clock.
    pub end: Micros,
    /// Further attributes to show, each a name and its value.
    pub args: Vec<(&'static str, String)>,
}

/// A worker as `ListWorkers` shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorkerView {
    /// Id that the master gave the worker.
    pub id: WorkerId,
    /// Name of the worker, for people.
    pub name: String,
    /// Number of the worker's render threads.
    pub threads: u32,
    /// Number of bricks the worker holds, over all sets.
    pub bricks_held: u64,
    /// Encoded bytes of the bricks the worker holds, over all sets.
    pub bytes_held: u64,
    /// Number of the worker's render threads that have a lease.
    pub busy: u32,
    /// Number of leases that the worker has not answered yet.
    pub leases: u32,
    /// When the worker joined, in microseconds on the master's clock.
    pub since: Micros,
    /// Whether the worker drains and takes no more leases.
    pub leaving: bool,
    /// Whether the worker is outside the active set: the others finish frames as fast without it.
    pub in_reserve: bool,
    /// Smallest round trip of the most recent pings, in microseconds; `None` before the first pong.
    pub round_trip: Option<Micros>,
}

/// Counters of mishaps over the scheduler's lifetime.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Totals {
    /// Results that were dropped as late or duplicate, those of ended frames included.
    pub dropped_results: u64,
    /// Brick transfers beyond a worker's memory budget, for a lease that exceeds it by itself.
    pub over_budget: u64,
    /// Number of workers that were lost, fell silent or were dropped.
    pub lost_workers: u64,
}
