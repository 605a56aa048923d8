//! Tasks of render threads, and their reports.

use super::queue::Turn;
use super::slots::FrameSlot;
use crate::brick_table::BrickTable;
use slabcast_common::brick::{Brick, BrickSetKey};
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Counters, ErrorsBySource, Lease, Pixels, RegionLease, RegionSplit};
use slabcast_render::region::{BrickSupply, Region};
use slabcast_trace::RegionProgress;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// A tile of one slab whose bricks are all here (`slab` schedule).
pub(crate) struct SlabTask {
    pub(crate) lease: Box<Lease>,
    pub(crate) frame: Arc<FrameSlot>,
    pub(crate) bricks: Vec<Arc<Brick>>,
    pub(crate) received: Instant,
    pub(crate) ready: Instant,
}

/// The end of a [`SlabTask`].
pub(crate) struct SlabReport {
    pub(crate) lease: Box<Lease>,
    pub(crate) received: Instant,
    pub(crate) ready: Instant,
    pub(crate) start: Instant,
    pub(crate) end: Instant,
    pub(crate) thread: u32,
    /// `None` if its frame had ended before it began.
    pub(crate) outcome: Option<Result<(TilePixels, Counters), String>>,
}

/// The master's request that a region gives part of its work away (work stealing): the share of
/// what is left of it, in thousandths; 0 if nothing is asked for.
#[derive(Default)]
pub(crate) struct SplitRequest(AtomicU32);

impl SplitRequest {
    pub(crate) fn ask_for(&self, share: u32) {
        self.0.store(share.clamp(1, 1000), Ordering::Relaxed);
    }

    pub(crate) fn is_pending(&self) -> bool {
        self.0.load(Ordering::Relaxed) > 0
    }

    /// Takes the request: the share, from 0 to 1.
    pub(super) fn take(&self) -> Option<f64> {
        let share = self.0.swap(0, Ordering::Relaxed);
        (share > 0).then(|| f64::from(share) / 1000.0)
    }
}

/// The bricks of a table, until the region that draws from it is to be split, its frame has ended, or
/// another client's turn has come.
pub(super) struct StoppableSupply<'a> {
    pub(super) table: &'a BrickTable,
    pub(super) split: &'a SplitRequest,
    pub(super) has_ended: &'a AtomicBool,
    pub(super) turn: &'a Turn<'a>,
}

impl BrickSupply for StoppableSupply<'_> {
    fn get(&self, place: u32) -> Option<Arc<Brick>> {
        self.table.get(place)
    }

    fn has(&self, place: u32) -> bool {
        self.table.has(place)
    }

    fn stops(&self) -> bool {
        self.split.is_pending() || self.has_ended.load(Ordering::Relaxed) || self.turn.is_over()
    }
}

/// A region from its lease to its result (`region` schedule). It goes to a render thread and comes
/// back as often as it stalls.
pub(crate) struct RegionTask {
    pub(crate) lease: RegionLease,
    pub(crate) frame: Arc<FrameSlot>,
    pub(crate) table: Arc<BrickTable>,
    pub(crate) split: Arc<SplitRequest>,
    pub(crate) received: Instant,
    /// When it stalled last, while it is stalled.
    pub(crate) stalled_at: Option<Instant>,
    /// Time that it was stalled so far.
    pub(crate) stalled: Duration,
    /// Number of times that it stalled.
    pub(crate) stalls: u32,
    /// Sheets that it looks ahead, as of when a thread took it.
    pub(crate) ahead: u32,
    /// Time that threads drew it so far.
    pub(crate) drawn: Duration,
    /// The pixels so far; `None` before it began.
    pub(super) region: Option<Region>,
    /// The progress of a rehearsed region; `None` before it began.
    pub(crate) course: Option<RegionProgress>,
    /// Whether the bricks that it will need were asked for in advance.
    pub(super) was_prefetched: bool,
}

impl RegionTask {
    pub(crate) fn new(
        lease: RegionLease,
        frame: Arc<FrameSlot>,
        table: Arc<BrickTable>,
        received: Instant,
    ) -> RegionTask {
        let (split, stalled_at, stalled, stalls, ahead) = Default::default();
        let (drawn, region, course, was_prefetched) = Default::default();
        RegionTask {
            lease,
            frame,
            table,
            split,
            received,
            stalled_at,
            stalled,
            stalls,
            ahead,
            drawn,
            region,
            course,
            was_prefetched,
        }
    }

    /// Whether no thread has begun it.
    pub(super) fn is_new(&self) -> bool {
        self.region.is_none() && self.course.is_none()
    }
}

/// A region that was drawn to its end.
pub(crate) struct DrawnRegion {
    pub(crate) pixels: Pixels,
    pub(crate) counters: Counters,
    /// Places in the directory of the bricks that it touched, ascending.
    pub(crate) touched: Vec<u32>,
    /// Measured errors of some of its pixels, if the lease asked for them.
    pub(crate) sampled: ErrorsBySource,
}

/// The state in which a thread leaves a region.
pub(crate) enum Progress {
    /// The frame had ended.
    FrameEnded,
    /// Drawn up to a sheet and paused there, since another client's turn came. It is in the queue again.
    GaveWay,
    /// To its end.
    Done(Box<DrawnRegion>),
    /// To a sheet at which it lacks bricks.
    Stalled {
        /// Places of the bricks in the directory.
        missing: Vec<u32>,
        /// Whether the sheet lies deeper than the one at which it stalled before.
        is_deeper: bool,
    },
    /// Nowhere, for this reason.
    Failed(String),
}

/// A thread's report on a region.
pub(crate) struct RegionReport {
    pub(crate) task: Box<RegionTask>,
    pub(crate) end: Instant,
    pub(crate) thread: u32,
    pub(crate) progress: Progress,
}

/// A task for a render thread.
pub(crate) enum Task {
    Slab(SlabTask),
    Region(Box<RegionTask>),
}

impl Task {
    /// Returns the number of the client that asked for the task's frame.
    pub(super) fn client(&self) -> u64 {
        match self {
            Task::Slab(task) => task.frame.client,
            Task::Region(task) => task.frame.client,
        }
    }
}

/// A report of a render thread.
pub(crate) enum Report {
    Slab(SlabReport),
    Region(RegionReport),
    /// A piece split off a region that goes on.
    Piece(Box<RegionSplit>),
    /// Places of bricks in a table that regions in the queue will need, judged by earlier frames.
    Prefetch(BrickSetKey, Arc<BrickTable>, Vec<u32>),
}
