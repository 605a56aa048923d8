//! What master and worker say to each other, as values.
//!
//! This is the seam of the system: a TCP link encodes these at `slabcast_proto::convert`, an
//! embedded link passes them as they are, and neither side can tell. Bricks travel beside
//! them on a path of their own ([`BrickBatch`]), so that control never queues behind data.

use crate::brick::{Brick, BrickGrid, BrickInfo, BrickSetKey};
use crate::ids::{BrickId, Epoch, FrameId, SceneId, TaskId, WorkerId};
use crate::image::{PixelEncoding, SparseTile, TilePixels, TileState};
use crate::occlusion::Rect;
use crate::protocol::ProtocolVersions;
use crate::quality::Quality;
use crate::region::parts;
use crate::slab::SheetRange;
use crate::transfer::TransferFunction;
use crate::view::View;
use crate::volume::VolumeInfo;
use std::sync::Arc;

/// What stays the same over a job.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneSpec {
    /// Its name.
    pub id: SceneId,
    /// The volume without its samples.
    pub volume: VolumeInfo,
    /// Transfer function.
    pub transfer: TransferFunction,
    /// Quality; `sums` is decided (never `Auto`).
    pub quality: Quality,
    /// Which bricks its tasks are drawn from.
    pub bricks: BrickSetKey,
}

/// One macrotile of one slab, lent to one worker.
#[derive(Clone, Debug, PartialEq)]
pub struct Lease {
    /// Which task.
    pub task: TaskId,
    /// Which attempt at it.
    pub epoch: Epoch,
    /// Of which frame; the worker was sent its view before.
    pub frame: FrameId,
    /// The macrotile, inside the picture.
    pub tile: Rect,
    /// The slab's sheets.
    pub slab: SheetRange,
    /// The bricks it needs, ascending. The worker holds each of them already or has it on the
    /// way; it starts when the last is there.
    pub bricks: Vec<BrickId>,
    /// The pixels as the slabs before left them.
    pub state: TileState,
}

/// One tile through all sheets of its frame, lent to one worker. The worker asks for the bricks that it turns out
/// to need.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionLease {
    /// Which task.
    pub task: TaskId,
    /// Which attempt at it.
    pub epoch: Epoch,
    /// Of which frame; the worker was sent its view and the directory of its bricks before.
    pub frame: FrameId,
    /// The tile, inside the picture.
    pub tile: Rect,
    /// Some of its pixels are drawn in thinner sheets, too.
    pub estimate: bool,
    /// What another worker has drawn of it; `None`: it starts from nothing.
    pub begun: Option<Arc<Checkpoint>>,
}

/// A region as somebody left it who gave it away.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// The next sheet to draw of each of its parts ([`crate::region::parts`]), in their order; `None`: it is at its end.
    pub sheets: Vec<Option<i32>>,
    /// Its pixels after the sheets before these.
    pub pixels: TilePixels,
}

impl Checkpoint {
    /// The same of a piece of its `tile`.
    ///
    /// # Panics
    /// If the piece is not inside the tile.
    pub fn crop(&self, tile: Rect, piece: Rect) -> Checkpoint {
        let of = |part: Rect| {
            let mut all = parts(tile).zip(&self.sheets);
            all.find(|(whole, _)| !whole.intersect(&part).is_empty()).and_then(|(_, at)| *at)
        };
        Checkpoint { sheets: parts(piece).map(of).collect(), pixels: self.pixels.crop(tile, piece) }
    }
}

/// What a worker gives away of a region that it draws.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionSplit {
    /// Its lease: which task.
    pub task: TaskId,
    /// And which attempt at it.
    pub epoch: Epoch,
    /// What it keeps of its tile: its result will have these pixels and no others.
    pub kept: Rect,
    /// What it gives away: the rest.
    pub given: Rect,
    /// How that stands.
    pub begun: Checkpoint,
}

/// Sets whose directories a worker keeps: as many as a master keeps brick sets, and one for a job that
/// is just ending. Master and worker count alike, by what was sent, so that neither has to say.
pub const DIRECTORIES_KEPT: usize = 4;

/// From master to worker.
#[derive(Clone, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "a view is 400 bytes once a frame and worker")]
pub enum ToWorker {
    /// The hello was good. Always the first message of a link that is let in.
    Welcome {
        /// The worker's name from now on.
        worker: WorkerId,
        /// How often the master pings; silence for three times as long means it is gone.
        heartbeat_ms: u32,
        /// Version of the protocol that both speak on this link.
        protocol_version: u32,
    },
    /// The hello was not good; the link ends. Says why and what to do.
    Refused {
        /// For people.
        reason: String,
    },
    /// A scene, before its first frame. May come twice with the same content.
    Scene(Arc<SceneSpec>),
    /// A frame's view, before its first lease.
    Frame {
        /// The frame.
        frame: FrameId,
        /// Its scene, sent before.
        scene: SceneId,
        /// Its view.
        view: View,
        /// What its regions are finished to; `None`: their results are sums. Those of leases are sums
        /// always.
        finish: Option<PixelEncoding>,
        /// Whether finished pixels go as they are: packing them takes longer than it saves.
        plain: bool,
    },
    /// Bricks that there are of a set, some of them or all: from the `first`, ascending by id. The
    /// parts of a directory come in order, and before the first region of the set. Those of the
    /// [`DIRECTORIES_KEPT`] sets that came last are kept.
    Directory {
        /// Of which set.
        set: BrickSetKey,
        /// How its volume is cut into bricks.
        grid: BrickGrid,
        /// How many came before.
        first: u32,
        /// How many there are in all.
        total: u32,
        /// These.
        bricks: Arc<[BrickInfo]>,
    },
    /// Work.
    Lease(Box<Lease>),
    /// Work through all depths.
    Region(RegionLease),
    /// Others have time: some of what is left of a region is to be given away ([`ToMaster::RegionSplit`]). Who has
    /// drawn it already, or can't cut it, does nothing.
    SplitRegion {
        /// Of which frame.
        frame: FrameId,
        /// The lease: which task.
        task: TaskId,
        /// And which attempt at it.
        epoch: Epoch,
        /// How much of what is left, in thousandths.
        share: u32,
    },
    /// A frame is over (finished or cancelled): leases of it that have not begun are dropped.
    EndFrame {
        /// The frame.
        frame: FrameId,
    },
    /// A scene is over and may be forgotten. Its bricks stay.
    EndScene {
        /// The scene.
        scene: SceneId,
    },
    /// Bricks to forget, so that the memory budget holds. No lease in flight needs them.
    DropBricks {
        /// Of which set.
        set: BrickSetKey,
        /// Which.
        bricks: Vec<BrickId>,
    },
    /// Are you there? Answered by `Pong` with the same nonce.
    Ping {
        /// Master's choice.
        nonce: u64,
    },
    /// The master ends. The worker drops its tasks and the link, and dials again after a wait.
    MasterEnding {
        /// Reason, for people.
        reason: String,
    },
}

/// Who a worker is.
#[derive(Clone, Debug, PartialEq)]
pub struct Hello {
    /// Versions of the protocol that the worker speaks.
    pub protocol_versions: ProtocolVersions,
    /// The worker's `PIXELS_VERSION`.
    pub pixels_version: u32,
    /// A name for people (host and process).
    pub name: String,
    /// Render threads.
    pub threads: u32,
    /// Bytes of bricks it may hold.
    pub memory_budget_bytes: u64,
    /// Instruction set of its splat loops, for people.
    pub simd: String,
    /// Hash of the self-test tile, in hexadecimal.
    pub self_test_sha256: String,
    /// Bricks it still holds from before.
    pub held: Vec<(BrickSetKey, Vec<BrickId>)>,
    /// It holds tiles for a recorded time instead of drawing them.
    pub rehearses: bool,
    /// Which machine it runs on; empty if unknown.
    pub machine: String,
}

/// What became of a task's voxels (see `stats::VoxelStats`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Put into a bucket.
    pub tossed: u64,
    /// Drawn.
    pub splatted: u64,
    /// Hidden, with their brick or alone.
    pub culled: u64,
}

impl std::ops::AddAssign for Counters {
    fn add_assign(&mut self, o: Counters) {
        self.tossed += o.tossed;
        self.splatted += o.splatted;
        self.culled += o.culled;
    }
}

/// When a task was handled, on the worker's own clock (microseconds).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TaskTimes {
    /// The lease came.
    pub received_us: u64,
    /// Its last brick was there.
    pub ready_us: u64,
    /// A render thread began.
    pub start_us: u64,
    /// It ended.
    pub end_us: u64,
    /// Which render thread.
    pub thread: u32,
}

/// What a region took beside its drawing.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RegionCost {
    /// The bricks that it drew from: places in the directory, ascending.
    pub touched: Vec<u32>,
    /// How often it stood still for want of bricks.
    pub stalls: u32,
    /// For how long (microseconds). Others may have been drawn meanwhile.
    pub parked_us: u64,
    /// For how long render threads had nothing to do since the last result of the link, while some
    pub idle_us: u64,
    /// How far some of its pixels are off, where that was asked for.
    pub sampled: ErrorsBySource,
}

/// How far pixels that were looked at are off, by source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ErrorsBySource {
    /// What sheets of half the thickness change.
    pub thickness: SampledError,
    /// What rounding of positions changes.
    pub positions: SampledError,
    /// What the kernel's cut changes.
    pub truncation: SampledError,
    /// What the kernel's ripple changes.
    pub ripple: SampledError,
}

impl ErrorsBySource {
    /// Each, in order.
    pub fn to_array(self) -> [SampledError; 4] {
        [self.thickness, self.positions, self.truncation, self.ripple]
    }

    /// From each, in order.
    pub fn from_array(
        [thickness, positions, truncation, ripple]: [SampledError; 4],
    ) -> ErrorsBySource {
        ErrorsBySource { thickness, positions, truncation, ripple }
    }

    /// Adds others'.
    pub fn add(&mut self, other: ErrorsBySource) {
        self.thickness.add(other.thickness);
        self.positions.add(other.positions);
        self.truncation.add(other.truncation);
        self.ripple.add(other.ripple);
    }
}

/// How far pixels are off. Integers, since their sum has no order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SampledError {
    /// Pixels that are not blank in both.
    pub pixels: u32,
    /// Sum of the squares of their differences, over all four channels, in units of 2^-48.
    pub squares: u64,
}

impl SampledError {
    const UNIT: f64 = (1u64 << 48) as f64;

    /// Counts a pixel, unless it is blank in both; squares of at most 4.
    pub fn put(&mut self, there: bool, squares: f64) {
        if there {
            self.pixels += 1;
            self.squares += (squares.clamp(0.0, 4.0) * SampledError::UNIT) as u64;
        }
    }

    /// Adds others'.
    pub fn add(&mut self, other: SampledError) {
        self.pixels = self.pixels.saturating_add(other.pixels);
        self.squares = self.squares.saturating_add(other.squares);
    }

    /// Root of the mean square over pixels and channels, in 1/255; `None` of no pixel.
    pub fn rmse(&self) -> Option<f64> {
        let n = 4.0 * f64::from(self.pixels);
        (self.pixels > 0).then(|| (self.squares as f64 / SampledError::UNIT / n).sqrt() * 255.0)
    }
}

/// What a task gave.
#[derive(Clone, Debug, PartialEq)]
pub enum Pixels {
    /// What it adds to the picture, which the master finishes.
    Sums(TilePixels),
    /// A piece of the picture as it leaves the master.
    Finished(SparseTile),
}

impl Pixels {
    /// How many there are.
    pub fn len(&self) -> usize {
        match self {
            Pixels::Sums(sums) => sums.a.len(),
            Pixels::Finished(leaves) => leaves.pixels(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A rendered task.
#[derive(Clone, Debug, PartialEq)]
pub struct TileResult {
    /// Which task.
    pub task: TaskId,
    /// Which attempt.
    pub epoch: Epoch,
    /// Its pixels.
    pub pixels: Pixels,
    /// Bytes of the message that it came in; `None` of one that crossed no network.
    pub bytes: Option<u32>,
    /// Its voxels.
    pub counters: Counters,
    /// Its times. Of a region, from `start_us` to `end_us` is drawing alone.
    pub times: TaskTimes,
    /// Of a region.
    pub region: Option<RegionCost>,
}

/// From worker to master.
#[derive(Clone, Debug, PartialEq)]
pub enum ToMaster {
    /// The first message of a link.
    Hello(Hello),
    /// A task is done.
    Result(Box<TileResult>),
    /// A task can't be done (a brick that fails its checksum twice, a lease that makes no
    /// sense). The worker stays.
    Failed {
        /// Which task.
        task: TaskId,
        /// Which attempt.
        epoch: Epoch,
        /// For people.
        reason: String,
    },
    /// A part of a region is given away, as the master asked for.
    RegionSplit(Box<RegionSplit>),
    /// Bricks arrived whole, and are held now.
    BricksReceived {
        /// Their set.
        set: BrickSetKey,
        /// Number of bricks since the last such message for this set.
        bricks: u32,
    },
    /// A brick failed its checksum; send it again.
    BricksBroken {
        /// Of which set.
        set: BrickSetKey,
        /// Which.
        bricks: Vec<BrickId>,
    },
    /// Regions lack bricks; send them, in this order. None is asked for twice on a link unless it was
    /// forgotten or broken meanwhile.
    BricksWanted {
        /// Of which set.
        set: BrickSetKey,
        /// Which.
        bricks: Vec<BrickId>,
    },
    /// Bricks were evicted to make room for others.
    BricksEvicted {
        /// Their set.
        set: BrickSetKey,
        /// Their ids.
        bricks: Vec<BrickId>,
    },
    /// Answer to `Ping`.
    Pong {
        /// The ping's.
        nonce: u64,
        /// The worker's clock.
        clock_us: u64,
    },
    /// The worker ends: it finishes the tasks it has begun, takes no more and closes the link.
    Goodbye {
        /// Reason, for people.
        reason: String,
    },
}

/// Some bricks of a set, as they go to one worker.
#[derive(Clone, Debug)]
pub struct BrickBatch {
    /// Of which set.
    pub set: BrickSetKey,
    /// The bricks.
    pub bricks: Vec<Arc<Brick>>,
    /// Bricks whose bytes were not whole.
    pub broken: Vec<BrickId>,
}
