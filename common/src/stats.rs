//! Statistics of a frame: one line of JSON (CONTRACTS.md, Statistics). Figures that nobody
//! measured are `null`, never zero.

use crate::quality::{Quality, Schedule};
use serde::{Deserialize, Serialize};

/// Milliseconds of a frame by what they went into, as the master saw it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameMs {
    /// From the frame's start to its last pixel.
    pub total: f64,
    /// Projecting and culling bricks, quadtrees, queues.
    pub cull: f64,
    /// Time during which bricks were on their way to at least one worker.
    pub distribute: f64,
    /// Sum of the workers' render times.
    pub render: f64,
    /// Taking results into the picture.
    pub composite: f64,
    /// Sum of the workers' waiting at slab barriers, per render thread.
    pub wait: f64,
    /// Time during which bricks were on their way while some worker rendered.
    #[serde(default)]
    pub overlap: f64,
    /// Sum of the workers' `stall_ms`.
    #[serde(default)]
    pub stall: f64,
}

/// One worker's part in a frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WorkerStats {
    /// Its name.
    pub id: String,
    /// Time its render threads rendered.
    pub render_ms: f64,
    /// Time during which bricks were on their way to it.
    pub distribute_ms: f64,
    /// Leases and results on their way, and waiting in queues.
    pub p2p_ms: f64,
    /// Its render threads' time without a task while the frame lasted, of this frame or another.
    pub wait_ms: f64,
    /// How often a region stood still for want of bricks.
    #[serde(default)]
    pub stalls: u64,
    /// Regions' time standing still, summed; render threads drew others meanwhile if there were any.
    #[serde(default)]
    pub parked_ms: f64,
    /// Its render threads' time with nothing to draw while some region stood still.
    #[serde(default)]
    pub stall_ms: f64,
    /// Bricks it holds of this scene's set at the frame's end.
    pub bricks_held: u64,
    /// Their encoded bytes.
    pub bytes_held: u64,
    /// Bricks that crossed to it for this frame.
    pub bricks_sent: u64,
    /// Their encoded bytes.
    pub bytes_sent: u64,
}

/// What happened to voxels. A candidate is a relevant voxel of a brick that a task has to
/// consider; one voxel is a candidate of each task (and of each of its cache-sized parts) that
/// its brick's footprint overlaps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct VoxelStats {
    /// Relevant voxels of the volume under the held support.
    pub relevant: u64,
    /// Candidates that were transformed and put into a sheet's bucket.
    pub tossed: u64,
    /// Candidates that were drawn.
    pub splatted: u64,
    /// Candidates that were dropped because all they could touch was shut: with their brick at
    /// the master or the worker, or alone. Of a block of bricks that a part of the picture never looked
    /// into, the part counts as much as it has of the block's rectangle.
    pub culled: u64,
}

/// What happened to bricks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct BrickStats {
    /// Bricks with a relevant voxel.
    pub relevant: u64,
    /// Bricks that the view touches and the front slabs do not hide; under the `region` schedule,
    /// those that were drawn from.
    pub needed: u64,
    /// Relevant voxels in needed bricks.
    #[serde(default)]
    pub needed_voxels: u64,
}

/// One macrotile of one slab.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TileStats {
    /// Left column.
    pub x: u32,
    /// Top row.
    pub y: u32,
    /// Edge in pixels.
    pub size: u32,
    /// Estimated workload: open pixels under brick boxes (paper section 4.3). Under the `region`
    /// schedule, once the tile was drawn in a frame before, what it took then in these units.
    pub est: u64,
    /// Render time.
    pub ms: f64,
    /// Who rendered it.
    pub worker: String,
}

/// One slab.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SlabStats {
    /// Its macrotiles in the order of the queue.
    pub tiles: Vec<TileStats>,
    /// Quadtree tiles of the level without a brick.
    pub empty: u64,
    /// Quadtree tiles of the level that were shut.
    pub shut: u64,
    /// Render threads' time between running dry and the slab's end, summed.
    pub barrier_wait_ms: f64,
}

/// Something the scene did not need.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    /// Its name (`normals`).
    pub name: String,
    /// Time saved; `null` where it was not measured.
    pub saved_ms: Option<f64>,
    /// Bytes saved; `null` where they were not counted.
    pub saved_bytes: Option<u64>,
}

/// A bound that holds on every pixel, in 1/255; `null` where none is known.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Bound {
    /// In 1/255.
    pub bound: Option<f64>,
}

/// Both, in 1/255; each `null` where there is none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BoundAndEstimate {
    /// What holds on every pixel.
    pub bound: Option<f64>,
    /// RMSE over the pixels that were looked at.
    #[serde(default)]
    pub estimate: Option<f64>,
}

/// An estimate, in 1/255; `null` where none was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// In 1/255.
    pub estimate: Option<f64>,
}

/// The error itself by what sheets of half the thickness change: 1 / (1 - 2^-p) at the order p = 3.
/// About one vox the error falls so steeply, steeper than in the limit (docs/accuracy.md); at p = 2 the
/// estimate would be a sixth larger.
pub const THICKNESS_EXTRAPOLATION: f64 = 8.0 / 7.0;

/// Error by source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorStats {
    /// Pixels shut before they are opaque: at most eps times the brightest colour.
    pub cutoff: Bound,
    /// Rounding of contributions to the integers of the sums. What slivers of kernels take to another sheet
    /// is not in it.
    pub quantisation: Bound,
    /// Rounding of positions and of f32 arithmetic.
    pub rounding: BoundAndEstimate,
    /// Of f32 arithmetic the part that grows with the number of sheets: opacity stands still where
    /// a sheet adds less than half its last bit.
    #[serde(default)]
    pub accumulation: Bound,
    /// Kernel tails cut off.
    pub truncation: BoundAndEstimate,
    /// Sheets of finite thickness.
    pub thickness: Estimate,
    /// The kernel's ripple on a constant field.
    pub ripple: Estimate,
}

/// Statistics of one frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameStats {
    /// Format version, 1.
    pub v: u32,
    /// Frame number in its path.
    pub frame: u64,
    /// Which schedule it was rendered under.
    #[serde(default = "slab")]
    pub schedule: Schedule,
    /// Hash of the view and everything else that decides the pixels.
    pub view_sha256: String,
    /// Hash of the pixels.
    ///
    /// Empty where the job did not ask for it: tiles then came as finished pixels, and the master never
    /// has the linear picture.
    pub pixels_sha256: String,
    /// `PIXELS_VERSION` of the programs.
    pub pixels_version: u32,
    /// Times.
    pub ms: FrameMs,
    /// Workers, by name.
    pub workers: Vec<WorkerStats>,
    /// Voxels.
    pub voxels: VoxelStats,
    /// Bricks.
    pub bricks: BrickStats,
    /// Bytes of the results that counted, as messages; `null` where none crossed a network.
    #[serde(default)]
    pub result_bytes: Option<u64>,
    /// Slabs, front to back. A frame of the `region` schedule has one, through all depths; its tiles
    /// are the regions.
    pub slabs: Vec<SlabStats>,
    /// Quality, with the sums that were used.
    pub quality: Quality,
    /// What was left out.
    pub left_out: Vec<LeftOut>,
    /// Error by source.
    pub error: ErrorStats,
    /// Leases that were handed out again because their worker was lost or late.
    #[serde(default)]
    pub retries: u64,
    /// Tiles of which a worker that had nothing to do was given a piece while they were drawn.
    #[serde(default)]
    pub handed_over: u64,
    /// Results that came too late or twice and were dropped.
    #[serde(default)]
    pub dropped_results: u64,
    /// Tiles given up after three workers were lost with them: `slab`, tile.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub poisoned: Vec<PoisonedTile>,
    /// What the frame waited for, in one sentence for people.
    #[serde(default)]
    pub critical_path: Option<String>,
    /// Workers held tiles for recorded times; there is no picture.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub rehearsed: bool,
}

/// A macrotile that took three workers with it. Its pixels stay as the slabs before left them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PoisonedTile {
    /// Slab number, front to back.
    pub slab: u32,
    /// Left column.
    pub x: u32,
    /// Top row.
    pub y: u32,
    /// Edge in pixels.
    pub size: u32,
    /// The workers that were lost with it.
    pub workers: Vec<String>,
}

/// What every frame was rendered under before its statistics said so.
fn slab() -> Schedule {
    Schedule::Slab
}
