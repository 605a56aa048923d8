//! Messages between master and worker, as values.
//!
//! This is the seam of the system: a TCP link encodes these at `slabcast_proto::convert`, an
//! embedded link passes them as they are, and neither side can tell. Bricks travel beside
//! them on a path of their own ([`BrickBatch`]), so that control never queues behind data.

use crate::brick::{Brick, BrickGrid, BrickInfo, BrickSetKey};
use crate::crop::CropBox;
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

/// Everything that stays the same over a job's frames: volume, transfer function, quality, bricks.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneSpec {
    /// Name of the scene on every link of the master.
    pub id: SceneId,
    /// The volume's lattice and value summary, without its samples.
    pub volume: VolumeInfo,
    /// Transfer function in full (never a preset's name).
    pub transfer: TransferFunction,
    /// Quality; `sums` is decided (never [`Sums::Auto`](crate::quality::Sums::Auto)).
    pub quality: Quality,
    /// Box outside of which nothing is drawn; `None` for the whole volume.
    pub crop: Option<CropBox>,
    /// Key of the brick set from which the scene is drawn.
    pub bricks: BrickSetKey,
}

/// One macrotile of one slab, leased to one worker (paper section 4.3; `slab` schedule).
#[derive(Clone, Debug, PartialEq)]
pub struct Lease {
    /// Id of the leased task.
    pub task: TaskId,
    /// Attempt at the task; a result counts only while its epoch is live.
    pub epoch: Epoch,
    /// Frame of the task. The worker received its view before.
    pub frame: FrameId,
    /// The macrotile, in pixels of the picture.
    pub tile: Rect,
    /// Sheets of the slab that the task draws.
    pub slab: SheetRange,
    /// Bricks that the task needs, ascending. The worker holds each or has it under way; it starts
    /// when the last has arrived.
    pub bricks: Vec<BrickId>,
    /// Pixels of the tile as the slabs in front left them.
    pub state: TileState,
}

/// One tile through all sheets of its frame, leased to one worker (`region` schedule). The worker
/// requests the bricks that it turns out to need.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionLease {
    /// Id of the leased task.
    pub task: TaskId,
    /// Attempt at the task; a result counts only while its epoch is live.
    pub epoch: Epoch,
    /// Frame of the task. The worker received its view and the directory of its bricks before.
    pub frame: FrameId,
    /// The tile, in pixels of the picture.
    pub tile: Rect,
    /// Whether some pixels are also drawn in thinner sheets, to estimate the error of the
    /// thickness.
    pub estimate: bool,
    /// Progress that another worker made on the tile; `None` if the region starts from nothing.
    pub begun: Option<Arc<Checkpoint>>,
}

/// Progress of a partly drawn region, from which another worker resumes it.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Next sheet to draw, for each of the tile's parts in the order of [`parts`]; `None` for a
    /// part that is done.
    pub sheets: Vec<Option<i32>>,
    /// Pixels of the tile after all sheets in front of those.
    pub pixels: TilePixels,
}

impl Checkpoint {
    /// Returns the checkpoint of `piece`, a rectangle inside the checkpoint's `tile`.
    ///
    /// # Panics
    /// If the piece is not inside the tile.
    pub fn crop(&self, tile: Rect, piece: Rect) -> Checkpoint {
        let next_sheet = |part: Rect| {
            let mut all = parts(tile).zip(&self.sheets);
            all.find(|(whole, _)| !whole.intersect(&part).is_empty()).and_then(|(_, sheet)| *sheet)
        };
        Checkpoint {
            sheets: parts(piece).map(next_sheet).collect(),
            pixels: self.pixels.crop(tile, piece),
        }
    }
}

/// A region split by work stealing: its worker keeps one piece and gives the other away.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionSplit {
    /// The task whose lease was split.
    pub task: TaskId,
    /// Number of the attempt at the task whose lease was split.
    pub epoch: Epoch,
    /// Piece of the tile that the worker keeps, in pixels of the picture. The worker's result has
    /// exactly these pixels.
    pub kept: Rect,
    /// Piece of the tile that the worker gives away, in pixels of the picture: all but `kept`.
    pub given: Rect,
    /// State of the given piece at the sheet border where it was split: a worker goes on from here.
    pub begun: Checkpoint,
}

/// Directories that a worker keeps: as many as a master keeps brick sets, and one for a job that is
/// just ending. Master and worker both count the directories sent, so neither announces what it
/// dropped.
pub const DIRECTORIES_KEPT: usize = 4;

/// Bit of the numbers of clients that are live sessions: a person waits for their frames, so workers
/// draw their tiles before those of jobs. Numbers stay below 2^53, which JSON has exactly.
pub const LIVE_CLIENT: u64 = 1 << 52;

/// Returns whether the client of this number is a live session ([`LIVE_CLIENT`]).
pub fn is_live(client: u64) -> bool {
    client & LIVE_CLIENT != 0
}

/// Reason in the goodbye of a worker that ends as it was told to. Any other reason is a fault.
pub const TOLD_TO_STOP: &str = "told to stop";

/// A message from master to worker.
#[derive(Clone, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "a view is 400 bytes once a frame and worker")]
pub enum ToWorker {
    /// The hello was accepted. First message on every admitted link.
    Welcome {
        /// Name of the worker from now on.
        worker: WorkerId,
        /// Interval of the master's pings. Silence for three intervals means that the master is
        /// gone.
        heartbeat_ms: u32,
        /// Protocol version that both sides speak on this link.
        protocol_version: u32,
    },
    /// The hello was refused; the link ends.
    Refused {
        /// Why, and what to do, for people.
        reason: String,
    },
    /// A scene, sent before its first frame. May come twice with the same content.
    Scene(Arc<SceneSpec>),
    /// A frame's view, sent before the frame's first lease.
    Frame {
        /// The frame.
        frame: FrameId,
        /// The frame's scene, sent before.
        scene: SceneId,
        /// The frame's camera, ready for the scene's volume.
        view: View,
        /// Encoding of region results; `None` if they are raw sums. Results of slab leases are
        /// always sums.
        finish: Option<PixelEncoding>,
        /// Whether finished pixels travel uncompressed, because packing would take longer than it
        /// saves.
        plain: bool,
        /// Number of the client that asked for the frame. Workers divide the time of their threads
        /// evenly among the clients whose tasks they have.
        client: u64,
    },
    /// Part of a set's directory: bricks that exist, ascending by id. Parts come in order, before
    /// the set's first region. A worker keeps the [`DIRECTORIES_KEPT`] directories that came last.
    Directory {
        /// The set.
        set: BrickSetKey,
        /// How the set's volume is cut into bricks.
        grid: BrickGrid,
        /// Bricks of the directory in earlier parts.
        first: u32,
        /// Bricks of the whole directory.
        total: u32,
        /// Bricks of this part.
        bricks: Arc<[BrickInfo]>,
    },
    /// A task of the `slab` schedule.
    Lease(Box<Lease>),
    /// A task of the `region` schedule.
    Region(RegionLease),
    /// Asks for part of a running region, for an idle worker. The worker answers with
    /// [`ToMaster::RegionSplit`], or not at all if the region is done or can't be cut.
    SplitRegion {
        /// Frame of the region.
        frame: FrameId,
        /// The leased task.
        task: TaskId,
        /// Attempt at the task.
        epoch: Epoch,
        /// Share of the remaining work to give away, in thousandths.
        share: u32,
    },
    /// A frame is finished or cancelled: the worker drops its leases that have not begun.
    EndFrame {
        /// The frame.
        frame: FrameId,
    },
    /// A scene is over and may be forgotten. Its bricks stay.
    EndScene {
        /// The scene.
        scene: SceneId,
    },
    /// Evicts bricks to keep the memory budget. No lease in flight needs them.
    DropBricks {
        /// The set.
        set: BrickSetKey,
        /// Bricks to evict.
        bricks: Vec<BrickId>,
    },
    /// A heartbeat. The worker answers with [`ToMaster::Pong`] and the same nonce.
    Ping {
        /// Number chosen by the master.
        nonce: u64,
    },
    /// The master ends. The worker drops its tasks and the link, and dials again after a wait.
    MasterEnding {
        /// Reason, for people.
        reason: String,
    },
}

/// A worker's introduction, the first message on a link.
#[derive(Clone, Debug, PartialEq)]
pub struct Hello {
    /// Protocol versions that the worker speaks.
    pub protocol_versions: ProtocolVersions,
    /// [`PIXELS_VERSION`](crate::PIXELS_VERSION) of the worker's program.
    pub pixels_version: u32,
    /// Name of the worker for people: host and process.
    pub name: String,
    /// Number of the worker's render threads.
    pub threads: u32,
    /// Bytes of bricks that the worker may hold.
    pub memory_budget_bytes: u64,
    /// Instruction set of the worker's kernels, for people.
    pub simd: String,
    /// SHA-256 of the self-test tile, in hexadecimal.
    pub self_test_sha256: String,
    /// Bricks that the worker still holds from an earlier link, by set.
    pub held: Vec<(BrickSetKey, Vec<BrickId>)>,
    /// Whether the worker only waits for recorded times instead of drawing.
    pub rehearses: bool,
    /// Identity of the worker's machine; empty if unknown.
    pub machine: String,
}

/// Numbers of voxels by what a task did with them ([`VoxelStats`](crate::stats::VoxelStats) has
/// definitions).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Number of voxels put into a sheet's bucket.
    pub tossed: u64,
    /// Number of voxels drawn into sheets.
    pub splatted: u64,
    /// Number of voxels dropped as hidden, with their brick or alone.
    pub culled: u64,
}

impl std::ops::AddAssign for Counters {
    fn add_assign(&mut self, o: Counters) {
        self.tossed += o.tossed;
        self.splatted += o.splatted;
        self.culled += o.culled;
    }
}

/// Times of a task in microseconds on the worker's own clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TaskTimes {
    /// Time at which the lease arrived, in microseconds on the worker's clock.
    pub received_us: u64,
    /// Time at which the last brick that the task needed arrived, in microseconds on the worker's
    /// clock.
    pub ready_us: u64,
    /// Time at which rendering began, in microseconds on the worker's clock.
    pub start_us: u64,
    /// Time at which rendering ended, in microseconds on the worker's clock.
    pub end_us: u64,
    /// Index of the render thread that drew the task, from 0.
    pub thread: u32,
}

/// Cost of a region beside drawing: bricks, stalls, idle threads.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RegionCost {
    /// Bricks that the region was drawn from, as places in the directory, ascending.
    pub touched: Vec<u32>,
    /// How often the region stalled for lack of bricks.
    pub stalls: u32,
    /// Total time in microseconds that the region was stalled. Its thread may have drawn other
    /// regions meanwhile.
    pub parked_us: u64,
    /// Time in microseconds, summed over render threads, without anything to draw while some region
    /// was stalled; since the link's previous result.
    pub idle_us: u64,
    /// Errors of sampled pixels; zero unless the lease asked for an estimate.
    pub sampled: ErrorsBySource,
}

/// Errors of sampled pixels by source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ErrorsBySource {
    /// Change of the pixels under sheets of half the thickness.
    pub thickness: SampledError,
    /// Change of the pixels under positions that are exact and not rounded.
    pub positions: SampledError,
    /// Change of the pixels under a kernel whose tails are not cut off.
    pub truncation: SampledError,
    /// Change of the pixels under a kernel without ripple.
    pub ripple: SampledError,
}

impl ErrorsBySource {
    /// Returns the errors by thickness, positions, truncation and ripple, in this order.
    pub fn to_array(self) -> [SampledError; 4] {
        [self.thickness, self.positions, self.truncation, self.ripple]
    }

    /// Builds from the sources in the order of the fields.
    pub fn from_array(
        [thickness, positions, truncation, ripple]: [SampledError; 4],
    ) -> ErrorsBySource {
        ErrorsBySource { thickness, positions, truncation, ripple }
    }

    /// Adds the samples of another tile, source by source.
    pub fn add(&mut self, other: ErrorsBySource) {
        self.thickness.add(other.thickness);
        self.positions.add(other.positions);
        self.truncation.add(other.truncation);
        self.ripple.add(other.ripple);
    }
}

/// Sum of squared errors over sampled pixels. Integers, so that the order of summing doesn't
/// matter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SampledError {
    /// Number of sampled pixels that are not blank in both pictures.
    pub pixels: u32,
    /// Sum of squared differences over all four channels (linear premultiplied RGBA), in units of
    /// 2^-48.
    pub squares: u64,
}

impl SampledError {
    const UNIT: f64 = (1u64 << 48) as f64;

    /// Adds a pixel unless it is blank in both pictures (`visible` is false). `squares` is the sum
    /// of squared differences over the four channels, clamped to 0..=4.
    pub fn add_pixel(&mut self, visible: bool, squares: f64) {
        if visible {
            self.pixels += 1;
            self.squares += (squares.clamp(0.0, 4.0) * SampledError::UNIT) as u64;
        }
    }

    /// Adds the samples of another tile; sums saturate.
    pub fn add(&mut self, other: SampledError) {
        self.pixels = self.pixels.saturating_add(other.pixels);
        self.squares = self.squares.saturating_add(other.squares);
    }

    /// Returns the root of the mean square over pixels and channels in 1/255, or `None` without a
    /// pixel.
    pub fn rmse(&self) -> Option<f64> {
        let n = 4.0 * f64::from(self.pixels);
        (self.pixels > 0).then(|| (self.squares as f64 / SampledError::UNIT / n).sqrt() * 255.0)
    }
}

/// Pixels of a finished task: sums that the master encodes, or encoded pixels.
#[derive(Clone, Debug, PartialEq)]
pub enum Pixels {
    /// Opacity and fixed-point colour, which the master encodes.
    Sums(TilePixels),
    /// Encoded pixels, as they leave the master.
    Finished(SparseTile),
}

impl Pixels {
    /// Returns the number of pixels of the tile.
    pub fn len(&self) -> usize {
        match self {
            Pixels::Sums(sums) => sums.a.len(),
            Pixels::Finished(leaves) => leaves.pixels(),
        }
    }

    /// Returns whether the tile has no pixel.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Result that a worker sends for a finished task.
#[derive(Clone, Debug, PartialEq)]
pub struct TileResult {
    /// Id of the task that was leased.
    pub task: TaskId,
    /// Number of the attempt at the task; the result counts only while this epoch is live.
    pub epoch: Epoch,
    /// Pixels of the task's tile.
    pub pixels: Pixels,
    /// Size of the message in bytes; `None` if it crossed no network.
    pub bytes: Option<u32>,
    /// Numbers of voxels that the task tossed, drew and culled.
    pub counters: Counters,
    /// Times. For a region, `start_us` to `end_us` is drawing alone, without stalls.
    pub times: TaskTimes,
    /// Bricks and stalls of a region; `None` for a slab task.
    pub region: Option<RegionCost>,
}

/// A message from worker to master.
#[derive(Clone, Debug, PartialEq)]
pub enum ToMaster {
    /// First message on a link.
    Hello(Hello),
    /// A task is done.
    Result(Box<TileResult>),
    /// A task can't be done (a brick failed its checksum twice, or the lease makes no sense). The
    /// worker stays.
    Failed {
        /// The task.
        task: TaskId,
        /// Attempt at the task.
        epoch: Epoch,
        /// Why, for people.
        reason: String,
    },
    /// Part of a region is given away, as the master asked.
    RegionSplit(Box<RegionSplit>),
    /// Bricks arrived whole, and are held now.
    BricksReceived {
        /// Their set.
        set: BrickSetKey,
        /// Number of bricks since the last such message for this set.
        bricks: u32,
    },
    /// Bricks failed their checksum; the master sends them again.
    BricksBroken {
        /// The set.
        set: BrickSetKey,
        /// Bricks that failed.
        bricks: Vec<BrickId>,
    },
    /// Requests bricks that regions lack, in this order. A worker requests a brick once a link,
    /// unless it was evicted or broken meanwhile.
    BricksWanted {
        /// The set.
        set: BrickSetKey,
        /// Requested bricks.
        bricks: Vec<BrickId>,
    },
    /// Bricks were evicted to make room for others.
    BricksEvicted {
        /// Their set.
        set: BrickSetKey,
        /// Their ids.
        bricks: Vec<BrickId>,
    },
    /// Answer to [`ToWorker::Ping`].
    Pong {
        /// Nonce of the ping.
        nonce: u64,
        /// The worker's clock in microseconds.
        clock_us: u64,
    },
    /// The worker ends: it finishes the tasks it has begun, takes no more and closes the link.
    Goodbye {
        /// Reason, for people.
        reason: String,
    },
}

/// Bricks of one set on their way to one worker.
#[derive(Clone, Debug)]
pub struct BrickBatch {
    /// Brick set that the bricks belong to.
    pub set: BrickSetKey,
    /// Bricks that arrived whole, ready for use.
    pub bricks: Vec<Arc<Brick>>,
    /// Ids of bricks that failed their checksum.
    pub broken: Vec<BrickId>,
}
