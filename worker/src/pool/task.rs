//! What render threads take, and what they give back.

use super::slots::FrameSlot;
use crate::brick_table::Shelf;
use slabcast_common::brick::{Brick, BrickSetKey};
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Counters, HandedOver, Lease, Pixels, RegionLease, Sampling};
use slabcast_render::region::{BrickSupply, Region};
use slabcast_trace::RegionProgress;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// A task whose bricks are all here.
pub(crate) struct Ready {
    pub(crate) lease: Box<Lease>,
    pub(crate) frame: Arc<FrameSlot>,
    pub(crate) bricks: Vec<Arc<Brick>>,
    pub(crate) received: Instant,
    pub(crate) ready: Instant,
}

/// What became of it.
pub(crate) struct Rendered {
    pub(crate) lease: Box<Lease>,
    pub(crate) received: Instant,
    pub(crate) ready: Instant,
    pub(crate) start: Instant,
    pub(crate) end: Instant,
    pub(crate) thread: u32,
    /// `None` when its frame was over before it began.
    pub(crate) outcome: Option<Result<(TilePixels, Counters), String>>,
}

/// How much of what is left of a region is to be given away, in thousandths; 0: none.
#[derive(Default)]
pub(crate) struct Wish(AtomicU32);

impl Wish {
    pub(crate) fn give(&self, share: u32) {
        self.0.store(share.clamp(1, 1000), Ordering::Relaxed);
    }

    pub(crate) fn is_there(&self) -> bool {
        self.0.load(Ordering::Relaxed) > 0
    }

    pub(super) fn take(&self) -> Option<f64> {
        let share = self.0.swap(0, Ordering::Relaxed);
        (share > 0).then(|| f64::from(share) / 1000.0)
    }
}

/// A shelf, of which a region takes bricks as long as it need not give any of its tile away.
pub(super) struct Watched<'a>(pub(super) &'a Shelf, pub(super) &'a Wish);

impl BrickSupply for Watched<'_> {
    fn get(&self, place: u32) -> Option<Arc<Brick>> {
        self.0.get(place)
    }

    fn has(&self, place: u32) -> bool {
        self.0.has(place)
    }

    fn stops(&self) -> bool {
        self.1.is_there()
    }
}

/// A region on its way.
pub(crate) struct Going {
    pub(crate) lease: RegionLease,
    pub(crate) frame: Arc<FrameSlot>,
    pub(crate) shelf: Arc<Shelf>,
    pub(crate) wish: Arc<Wish>,
    pub(crate) received: Instant,
    /// When it stood still last.
    pub(crate) parked_at: Option<Instant>,
    pub(crate) parked: Duration,
    pub(crate) stalls: u32,
    /// How many sheets it looks ahead since a thread took it.
    pub(crate) ahead: u32,
    /// Time of its drawing so far.
    pub(crate) drawn: Duration,
    /// What is drawn so far; `None` before it began.
    pub(super) region: Option<Region>,
    /// The same of a rehearsal.
    pub(crate) course: Option<RegionProgress>,
    /// Whether what it will need was looked for.
    pub(super) looked: bool,
}

impl Going {
    pub(crate) fn new(
        lease: RegionLease,
        frame: Arc<FrameSlot>,
        shelf: Arc<Shelf>,
        received: Instant,
    ) -> Going {
        let (wish, parked_at, parked, stalls, ahead) = Default::default();
        let (drawn, region, course, looked) = Default::default();
        Going {
            lease,
            frame,
            shelf,
            wish,
            received,
            parked_at,
            parked,
            stalls,
            ahead,
            drawn,
            region,
            course,
            looked,
        }
    }

    /// Whether no thread has come to it.
    pub(super) fn begins(&self) -> bool {
        self.region.is_none() && self.course.is_none()
    }
}

/// A region that was drawn to its end.
pub(crate) struct Drawn {
    pub(crate) pixels: Pixels,
    pub(crate) counters: Counters,
    /// Places in the directory of the bricks that it touched, ascending.
    pub(crate) touched: Vec<u32>,
    /// How far some of its pixels are off, where that was asked for.
    pub(crate) sampled: Sampling,
}

/// Where a region came to.
pub(crate) enum Came {
    /// Its frame was over.
    Over,
    /// To its end.
    Done(Box<Drawn>),
    /// To a sheet at which it lacks bricks; whether that is farther than before.
    Lacks(Vec<u32>, bool),
    /// Nowhere.
    Failed(String),
}

/// What became of a region.
pub(crate) struct Gone {
    pub(crate) going: Box<Going>,
    pub(crate) end: Instant,
    pub(crate) thread: u32,
    pub(crate) came: Came,
}

/// What threads take.
pub(crate) enum Task {
    Slab(Ready),
    Region(Box<Going>),
}

/// What they give back.
pub(crate) enum Outcome {
    Slab(Rendered),
    Region(Gone),
    /// A piece of a region that goes on.
    Handed(Box<HandedOver>),
    /// What regions that nobody has begun will need, by frames before: places on a shelf.
    Expected(BrickSetKey, Arc<Shelf>, Vec<u32>),
}
