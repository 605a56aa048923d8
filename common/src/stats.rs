//! Statistics of a frame: one line of JSON (docs/design/contracts.md, Statistics). Figures that
//! nobody measured are `null`, never zero.

use crate::level::LevelStats;
use crate::quality::{Quality, Schedule};
use serde::{Deserialize, Serialize};

/// Milliseconds of a frame by cause, as the master saw it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameMs {
    /// Milliseconds from the frame's start to its last pixel.
    pub total: f64,
    /// Milliseconds that the master spent on projecting and culling bricks, quadtrees and queues.
    pub cull: f64,
    /// Milliseconds during which bricks were on their way to at least one worker.
    pub distribute: f64,
    /// Milliseconds of rendering, summed over the render threads of all workers.
    pub render: f64,
    /// Milliseconds that the master spent on taking results into the picture.
    pub composite: f64,
    /// Milliseconds of waiting at slab barriers, summed over the render threads of all workers.
    pub wait: f64,
    /// Milliseconds during which bricks were on their way while some worker rendered.
    #[serde(default)]
    pub overlap: f64,
    /// Milliseconds of render threads that had nothing to draw while a region lacked bricks, summed
    /// over all workers.
    #[serde(default)]
    pub stall: f64,
}

/// One worker's part in a frame. Times are in milliseconds.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WorkerStats {
    /// Name of the worker, for people.
    pub id: String,
    /// Milliseconds of rendering, summed over the worker's render threads.
    pub render_ms: f64,
    /// Milliseconds during which bricks were on their way to the worker.
    pub distribute_ms: f64,
    /// Milliseconds that leases and results of the worker were on their way or in queues.
    pub p2p_ms: f64,
    /// Milliseconds of the worker's render threads without a task, of this frame or another, while
    /// the frame lasted.
    pub wait_ms: f64,
    /// Number of times that a region stalled on this worker for lack of bricks.
    #[serde(default)]
    pub stalls: u64,
    /// Milliseconds that regions were stalled, summed; render threads drew others meanwhile if
    /// there were any.
    #[serde(default)]
    pub parked_ms: f64,
    /// Milliseconds of the worker's render threads with nothing to draw while some region was
    /// stalled.
    #[serde(default)]
    pub stall_ms: f64,
    /// Number of bricks of this scene's set that the worker holds at the frame's end.
    pub bricks_held: u64,
    /// Encoded bytes of the bricks that the worker holds at the frame's end.
    pub bytes_held: u64,
    /// Number of bricks sent to the worker for this frame.
    pub bricks_sent: u64,
    /// Encoded bytes of the bricks sent to the worker for this frame.
    pub bytes_sent: u64,
}

/// Numbers of voxels by what happened to them. A candidate is a relevant voxel of a brick that a
/// task must consider. One voxel is a candidate of each task (and of each of its cache-sized parts)
/// that its brick's footprint overlaps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct VoxelStats {
    /// Number of relevant voxels of the volume under the held support.
    pub relevant: u64,
    /// Number of candidates that were transformed and put into a sheet's bucket.
    pub tossed: u64,
    /// Number of candidates that were drawn.
    pub splatted: u64,
    /// Candidates dropped because all they could touch was shut: with their brick at the master or
    /// the worker, or alone. For a block of bricks that a part of the picture never looked into,
    /// the part counts the share of the block's rectangle that it has.
    pub culled: u64,
}

/// Numbers of bricks by what happened to them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct BrickStats {
    /// Number of the volume's bricks that have a relevant voxel.
    pub relevant: u64,
    /// Bricks that the view touches and the front slabs do not hide; under the `region` schedule,
    /// bricks that were drawn from.
    pub needed: u64,
    /// Number of relevant voxels in the needed bricks.
    #[serde(default)]
    pub needed_voxels: u64,
}

/// Statistics of one macrotile of one slab.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TileStats {
    /// Left column of the macrotile, in pixels of the picture.
    pub x: u32,
    /// Top row of the macrotile, in pixels of the picture.
    pub y: u32,
    /// Edge of the macrotile in pixels, before the picture clips it.
    pub size: u32,
    /// Estimated workload: open pixels under brick boxes (paper section 4.3). Under the `region`
    /// schedule, for a tile drawn in an earlier frame, its time then in the same unit.
    pub est: u64,
    /// Milliseconds that the macrotile took to render.
    pub ms: f64,
    /// Name of the worker that rendered the macrotile.
    pub worker: String,
}

/// Statistics of one slab of a frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SlabStats {
    /// Macrotiles in the order of the queue.
    pub tiles: Vec<TileStats>,
    /// Quadtree tiles of the chosen level without a brick.
    pub empty: u64,
    /// Quadtree tiles of the chosen level whose pixels were all shut.
    pub shut: u64,
    /// Time of render threads between their last task and the slab's end, summed, in milliseconds.
    pub barrier_wait_ms: f64,
}

/// Data that the scene did not need.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    /// Name of the data that were left out, for example `normals`.
    pub name: String,
    /// Milliseconds that were saved; `null` where nobody measured them.
    pub saved_ms: Option<f64>,
    /// Bytes that were saved; `null` where nobody counted them.
    pub saved_bytes: Option<u64>,
}

/// An error bound that holds on every pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Bound {
    /// The bound in 1/255; `null` where none is known.
    pub bound: Option<f64>,
}

/// An error bound that holds on every pixel, and an estimate of the error itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BoundAndEstimate {
    /// The bound in 1/255; `null` where none is known.
    pub bound: Option<f64>,
    /// RMSE over the sampled pixels in 1/255; `null` where none was sampled.
    #[serde(default)]
    pub estimate: Option<f64>,
}

/// An estimate of an error, which single pixels may exceed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// The estimate in 1/255; `null` where none was made.
    pub estimate: Option<f64>,
}

/// Ratio of the error of the thickness to the change under sheets of half the thickness: 1 / (1 -
/// 2^-p) at the order p = 3. At about one vox the error falls more steeply than in the limit
/// (docs/measurements/accuracy.md); at p = 2 the estimate would be a sixth larger.
pub const THICKNESS_EXTRAPOLATION: f64 = 8.0 / 7.0;

/// Errors of a frame by source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorStats {
    /// Error of pixels that are shut before they are opaque: at most eps times the brightest
    /// colour.
    pub cutoff: Bound,
    /// Rounding of contributions to the integers of the sums. Slivers of kernels that fall into
    /// another sheet are not counted.
    pub quantisation: Bound,
    /// Error of rounded positions and of f32 arithmetic.
    pub rounding: BoundAndEstimate,
    /// The part of f32 rounding that grows with the number of sheets: opacity stands still where a
    /// sheet adds less than half its last bit.
    #[serde(default)]
    pub accumulation: Bound,
    /// Error of kernel tails that are cut off at the support radius.
    pub truncation: BoundAndEstimate,
    /// Error of sheets that have a thickness, against the limit of thin ones.
    pub thickness: Estimate,
    /// Error of the kernel's ripple on a constant field.
    pub ripple: Estimate,
}

/// Statistics of one frame: one line of JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameStats {
    /// Version of the statistics format; 1 is the only one.
    pub v: u32,
    /// Number of the frame in its path, from 0.
    pub frame: u64,
    /// Schedule under which the frame was rendered.
    #[serde(default = "slab")]
    pub schedule: Schedule,
    /// SHA-256 of the view and everything else that decides the pixels, in hexadecimal.
    pub view_sha256: String,
    /// SHA-256 of the linear pixels, in hexadecimal. Empty where the job did not ask for it: tiles
    /// then come encoded, and the master never has the linear picture.
    pub pixels_sha256: String,
    /// Version of the pixels, `PIXELS_VERSION`, which the master and all workers share.
    pub pixels_version: u32,
    /// Milliseconds of the frame, by cause.
    pub ms: FrameMs,
    /// Each worker's part in the frame, sorted by name.
    pub workers: Vec<WorkerStats>,
    /// Numbers of voxels that were tossed, drawn and culled.
    pub voxels: VoxelStats,
    /// Numbers of bricks that the frame had and needed.
    pub bricks: BrickStats,
    /// Bytes of the results that counted, as messages; `null` where none crossed a network.
    #[serde(default)]
    pub result_bytes: Option<u64>,
    /// Slabs, front to back. A frame of the `region` schedule has one, through all sheets; its
    /// tiles are the regions.
    pub slabs: Vec<SlabStats>,
    /// Quality of the picture, with the number type of sums that was used.
    pub quality: Quality,
    /// Data that the scene did not need, so that nobody computed or sent them.
    pub left_out: Vec<LeftOut>,
    /// Errors of the picture, by source.
    pub error: ErrorStats,
    /// Level of detail that was drawn; `null` where the master did not say.
    #[serde(default)]
    pub level: Option<LevelStats>,
    /// Number of leases given out again because their worker was lost or late.
    #[serde(default)]
    pub retries: u64,
    /// Tiles split while drawn, a piece of which went to an idle worker (work stealing).
    #[serde(default)]
    pub handed_over: u64,
    /// Number of results that came too late or twice and were dropped.
    #[serde(default)]
    pub dropped_results: u64,
    /// Tiles that are missing. Masters of today leave it empty: a frame of which a tile can't be
    /// drawn fails.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub poisoned: Vec<PoisonedTile>,
    /// Reason for the frame's length, one sentence for people.
    #[serde(default)]
    pub critical_path: Option<String>,
    /// Whether workers only waited for recorded times; there is no picture then.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub rehearsed: bool,
}

/// A macrotile that no worker could draw.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PoisonedTile {
    /// Number of the slab, front to back, from 0.
    pub slab: u32,
    /// Left column of the macrotile, in pixels of the picture.
    pub x: u32,
    /// Top row of the macrotile, in pixels of the picture.
    pub y: u32,
    /// Edge of the macrotile in pixels, before the picture clips it.
    pub size: u32,
    /// Names of the workers that were lost with the macrotile.
    pub workers: Vec<String>,
}

/// Returns the schedule of statistics that don't name one: early versions had no other.
fn slab() -> Schedule {
    Schedule::Slab
}
