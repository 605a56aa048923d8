//! Tile models, the costs of tiles and the contents of their results: the part of a simulation that
//! knows pictures.

use crate::Unpredictable;
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Checkpoint, Counters, Lease, Pixels, RegionLease};
use slabcast_common::occlusion::Rect;
use slabcast_schedule::FrameJob;
use slabcast_trace::HasBrick;

/// Size and bricks of one task, whoever draws it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TaskFacts {
    /// Nanoseconds to draw a slab's tile at unit speed. Regions have their progress instead.
    pub ns: f64,
    /// Bytes of the task's lease on the wire.
    pub lease_bytes: u64,
    /// Bytes of the task's result on the wire if finished pixels are packed. Sums weigh as much.
    pub packed_bytes: u64,
    /// Bytes of the task's result on the wire if finished pixels are not packed.
    pub plain_bytes: u64,
    /// Region: numbers of the brick blocks that a worker looks at, once a frame each.
    pub blocks: Vec<u32>,
    /// Region: places of the bricks that a worker prefetches if it drew this part of the picture
    /// before.
    pub prefetch: Vec<u32>,
}

/// Time that a worker takes for a frame besides drawing its tiles, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameSetup {
    /// Nanoseconds to make the tables of a frame, once a frame.
    pub tables_ns: u64,
    /// Nanoseconds to look at the directory's blocks of bricks, once a frame of the `region`
    /// schedule.
    pub directory_ns: u64,
    /// Nanoseconds to look at the bricks of one block, once a frame for each block.
    pub block_ns: u64,
}

/// Result of a finished task: pixels, voxel counts and bricks used.
#[derive(Clone, Debug)]
pub struct TaskOutput {
    /// Pixels of the task's tile.
    pub pixels: Pixels,
    /// Voxels that were tossed, splatted and culled.
    pub counters: Counters,
    /// Places in the brick list of the bricks that a region was drawn from, ascending; empty for a
    /// slab's tile.
    pub touched: Vec<u32>,
}

/// A region cut in two: the worker keeps one piece and hands the other over.
#[derive(Clone, Debug)]
pub struct Split {
    /// Pixels of the piece that its worker keeps.
    pub kept: Rect,
    /// Pixels of the piece that is handed over.
    pub given: Rect,
    /// State of the piece that is handed over.
    pub begun: Checkpoint,
}

/// Progress of a region through its sheets on one worker, at unit speed. The order of calls is that
/// of [`RegionProgress`](slabcast_trace::RegionProgress).
pub trait Region {
    /// A thread takes the region; parts that stalled are tried again.
    fn resume(&mut self);

    /// Returns for how many nanoseconds drawing goes on with the bricks that the worker `has`.
    fn runs_ns(&mut self, has: HasBrick<'_>) -> f64;

    /// Draws for `ns` nanoseconds, or as far as the bricks that the worker `has` allow.
    fn advance(&mut self, ns: f64, has: HasBrick<'_>);

    /// Returns whether all of it is drawn.
    fn is_done(&self) -> bool;

    /// Returns the places of the bricks it is stalled for, up to `ahead_sheets` beyond the sheet at
    /// which it stopped.
    fn missing(&mut self, has: HasBrick<'_>, ahead_sheets: u32) -> Vec<u32>;

    /// Returns the places of the bricks that drawing has not come to, ascending.
    fn upcoming(&self) -> Vec<u32>;
}

/// Costs of tiles and the contents of their results: all that a simulation knows about pictures.
pub trait TileModel {
    /// Progress of a region.
    type Region: Region;

    /// Returns the time that each worker takes once for a frame.
    fn setup(&self, job: &FrameJob) -> FrameSetup;

    /// Returns what a slab's tile costs.
    ///
    /// # Errors
    /// [`Unpredictable::Tile`] if the model does not know it.
    fn slab_facts(&self, job: &FrameJob, lease: &Lease) -> Result<TaskFacts, Unpredictable>;

    /// Returns what a slab's tile gives.
    fn draw_slab(&mut self, job: &FrameJob, lease: &Lease) -> TaskOutput;

    /// Returns what a region costs and its progress: none, or that of the piece in the lease.
    ///
    /// # Errors
    /// [`Unpredictable::Tile`] if the model does not know it.
    fn begin_region(
        &mut self,
        job: &FrameJob,
        lease: &RegionLease,
    ) -> Result<(TaskFacts, Self::Region), Unpredictable>;

    /// Cuts a region so that about `share` of what is left lies in the piece that is handed over;
    /// `region` becomes the piece that stays. `None`: it can't be cut.
    fn split(
        &mut self,
        job: &FrameJob,
        region: &mut Self::Region,
        tile: Rect,
        share: f64,
        has: HasBrick<'_>,
    ) -> Option<Split>;

    /// Returns what a region gives that is done.
    fn finish_region(
        &mut self,
        job: &FrameJob,
        lease: &RegionLease,
        region: Self::Region,
    ) -> TaskOutput;

    /// Forgets what it keeps of a frame that is over.
    fn end_frame(&mut self, job: &FrameJob) {
        let _ = job;
    }
}

/// Returns black pixels of a tile, as sums.
pub(crate) fn blank_sums(tile: Rect) -> TilePixels {
    let n = tile.area();
    TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: None }
}
