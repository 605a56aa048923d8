//! Events: the closed list of the scheduler's inputs.

use slabcast_common::brick::{BrickInfo, BrickSetKey};
use slabcast_common::ids::{BrickId, Epoch, FrameId, SceneId, TaskId, WorkerId};
use slabcast_common::image::PixelEncoding;
use slabcast_common::message::{RegionSplit, SceneSpec, TileResult};
use slabcast_common::quality::Work;
use slabcast_common::view::View;
use std::sync::Arc;

/// One frame for the scheduler to have rendered.
#[derive(Clone, Debug)]
pub struct FrameJob {
    /// The frame's id. Ids are never reused.
    pub frame: FrameId,
    /// Index of the frame in its view path.
    pub number: u64,
    /// Volume, transfer function and quality of the frame.
    pub scene: Arc<SceneSpec>,
    /// All bricks of the set `scene.bricks`, ascending by id.
    pub bricks: Arc<[BrickInfo]>,
    /// Camera and picture size in pixels.
    pub view: View,
    /// Schedule, number of slabs and tile size of the frame.
    pub work: Work,
    /// Format to which workers finish the pixels of regions. `None`: results are sums of light and
    /// opacity. Results of the `slab` schedule always are.
    pub finish: Option<PixelEncoding>,
    /// Number of the client that asked for the frame. Frames of one client complete in order; frames
    /// of different clients are drawn at the same time and share all threads.
    pub client: u64,
}

/// Host and name of a worker. Ids are new with each link; links with the same host and name belong to
/// the same worker.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct WorkerIdentity {
    /// The machine that it runs on, or the address that it calls from, without port.
    pub host: String,
    /// The name that it gives itself.
    pub name: String,
}

impl std::fmt::Display for WorkerIdentity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.host, self.name)
    }
}

/// An input of the scheduler, given to [`Scheduler::handle`](crate::Scheduler::handle).
#[derive(Clone, Debug)]
pub enum Event {
    /// A worker sent a valid hello and was welcomed.
    WorkerJoined {
        /// The worker's id. Ids are never reused.
        worker: WorkerId,
        /// Display name.
        name: String,
        /// Host and name of the worker. If a worker of the same host and name is linked already, the
        /// new one counts as another worker on that host.
        identity: WorkerIdentity,
        /// Number of render threads.
        threads: u32,
        /// Whether its pixels are believed without audits.
        is_trusted: bool,
        /// Whether it runs on the master's host. Message handling then competes with its render
        /// threads, and its results cross no link.
        is_local: bool,
        /// Bytes of bricks the worker may hold, by encoded size.
        memory_budget_bytes: u64,
        /// Bricks the worker kept from an earlier connection.
        held: Vec<(BrickSetKey, Vec<BrickId>)>,
    },
    /// A message without an event of its own came from a worker.
    WorkerHeard {
        /// Worker that sent the message.
        worker: WorkerId,
    },
    /// A worker's link closed.
    WorkerLost {
        /// The lost worker.
        worker: WorkerId,
        /// Reason, for logs.
        reason: String,
    },
    /// A worker drains: it finishes the tasks it has begun, takes no new ones and then closes.
    WorkerLeaving {
        /// The leaving worker.
        worker: WorkerId,
    },
    /// A frame is requested. Frames of one client ([`FrameJob::client`]) complete in the order in
    /// which they are queued. The `slab` schedule renders one frame at a time; the `region` schedule
    /// overlaps a client's frames of one brick set, and frames of several clients whatever their
    /// sets.
    FrameQueued(Box<FrameJob>),
    /// A frame is no longer wanted. Produces no answer.
    CancelFrame {
        /// The cancelled frame.
        frame: FrameId,
    },
    /// No further frame of a scene will be queued. Workers forget the scene once its queued frames
    /// are done; its bricks stay cached.
    SceneEnded {
        /// The ended scene.
        scene: SceneId,
    },
    /// A worker finished a task.
    Result {
        /// The worker that rendered it.
        worker: WorkerId,
        /// Pixels, timings and counters.
        result: Box<TileResult>,
    },
    /// A worker can't do a task.
    Failed {
        /// The worker that refused it.
        worker: WorkerId,
        /// The refused task.
        task: TaskId,
        /// The attempt that was refused.
        epoch: Epoch,
        /// Reason, for logs and statistics.
        reason: String,
    },
    /// A worker gave away a piece of a region it is rendering, in answer to
    /// [`ToWorker::SplitRegion`](slabcast_common::message::ToWorker::SplitRegion).
    HandedOver {
        /// The worker that gave it away.
        worker: WorkerId,
        /// The piece, with its state so far.
        piece: Box<RegionSplit>,
    },
    /// Bricks arrived intact. Bricks of a set arrive in the order in which they were sent, so a
    /// count is enough. Damaged bricks are not counted.
    BricksIn {
        /// The worker that received them.
        worker: WorkerId,
        /// Their set.
        set: BrickSetKey,
        /// Number of bricks.
        bricks: u32,
    },
    /// Bricks arrived damaged. The scheduler sends them again.
    BricksBroken {
        /// The worker that received them.
        worker: WorkerId,
        /// Their set.
        set: BrickSetKey,
        /// Ids of the damaged bricks.
        bricks: Vec<BrickId>,
    },
    /// A worker's regions need bricks that it does not hold.
    BricksWanted {
        /// The worker that asks.
        worker: WorkerId,
        /// Their set.
        set: BrickSetKey,
        /// Ids, most urgent first.
        bricks: Vec<BrickId>,
    },
    /// A worker evicted bricks to make room.
    BricksForgotten {
        /// The worker that evicted them.
        worker: WorkerId,
        /// Their set.
        set: BrickSetKey,
        /// Ids of the evicted bricks.
        bricks: Vec<BrickId>,
    },
    /// A worker answered a ping.
    Pong {
        /// The worker that answered.
        worker: WorkerId,
        /// Nonce of the ping.
        nonce: u64,
        /// The worker's clock when it answered, in microseconds.
        clock_us: u64,
    },
    /// Time passed. Due at [`Scheduler::next_deadline`](crate::Scheduler::next_deadline).
    Tick,
}
