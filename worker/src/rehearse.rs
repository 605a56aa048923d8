//! A worker that holds tiles instead of drawing them.
//!
//! Everything else is real: link, hello, bricks, leases, results of the right size. So processes on
//! one machine rehearse a cluster of many: a core draws one tile at a time, but any number of
//! threads can wait. What a tile takes is in a [`Trace`]; its pixels are those of
//! [`slabcast_common::trace::filled`], which shut what the real ones would have shut. Only a master
//! that was started for it lets such a worker in, and it marks its pictures.
//!
//! **Time is held on the threads' own account.** The system wakes a sleeping thread some 60 us too
//! late; over a thousand tiles that is a frame. So a thread's next tile begins when the one before
//! should have ended, or when it came, and only a result is late, never the work behind it.

use crate::pool::{Drawn, FrameSlot, Going, Ready, locked};
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Counters, Pixels, Sampling};
use slabcast_common::slab::SheetRange;
use slabcast_common::trace::{Trace, filled, filled_through, finished_through, view_sha256};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What tiles take, ready to be looked up.
pub struct Rehearsal {
    trace: Trace,
    /// For each frame and slab its shut pixels.
    shut: Vec<Vec<Arc<Vec<bool>>>>,
}

impl std::fmt::Debug for Rehearsal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Rehearsal of {} frames of {}", self.trace.frames.len(), self.trace.about.volume)
    }
}

impl Rehearsal {
    /// Makes a trace ready: a byte for each pixel of each slab of each frame.
    pub fn new(trace: Trace) -> Self {
        let size = trace.about.size;
        let slabs = |f: &slabcast_common::trace::FrameTrace| {
            f.slabs.iter().map(|s| Arc::new(s.shut(size))).collect()
        };
        Rehearsal { shut: trace.frames.iter().map(slabs).collect(), trace }
    }

    /// The place of a frame in the trace.
    fn find(&self, frame: &FrameSlot) -> Option<usize> {
        let name = view_sha256(&frame.scene.spec, &frame.view).to_string();
        self.trace.frames.iter().position(|f| f.view == name)
    }

    /// When a thread that is free from `free` on begins and ends a task, and its pixels; an error if
    /// the trace does not know it.
    pub(crate) fn task(&self, task: &Ready, free: Instant) -> Result<(Held, TilePixels), String> {
        let Ready { lease, frame, .. } = task;
        let unknown = || {
            format!(
                "the trace that is rehearsed has no tile ({},{}) to ({},{}) of sheets {} to {} of \
                 this view",
                lease.tile.x0,
                lease.tile.y0,
                lease.tile.x1,
                lease.tile.y1,
                lease.slab.first,
                lease.slab.end
            )
        };
        let at = *frame.rehearsed.get_or_init(|| self.find(frame));
        let at = at.ok_or_else(unknown)?;
        let traced = &self.trace.frames[at];
        let size = self.trace.about.size;
        let SheetRange { first, end } = lease.slab;
        let slab = traced.slabs.iter().position(|s| s.first == first && s.end == end);
        let slab = slab.ok_or_else(unknown)?;
        let tile = traced.slabs[slab].tile(&lease.tile, size).ok_or_else(unknown)?;
        let start = free.max(task.ready);
        // The first task of a frame makes its tables; others wait for them.
        let setup = Duration::from_nanos(traced.setup_ns);
        let made = *frame.made.get_or_init(|| start + setup);
        let end = made.max(start) + Duration::from_nanos(tile.ns);
        let pixels = filled(&lease.tile, &self.shut[at][slab], size, tile.result_bytes);
        Ok((Held { start, end }, pixels))
    }

    /// The same of a region that a thread has come to at `start`: which bricks it lacks, or when it
    /// ends and what comes of it. All of them are lacked at once, where drawing finds one after the
    /// other.
    pub(crate) fn region(&self, going: &Going, start: Instant) -> Result<Through, String> {
        let Going { lease, frame, shelf, .. } = going;
        let tile = lease.tile;
        let unknown = || {
            format!(
                "the trace that is rehearsed has no tile ({},{}) to ({},{}) through all depths of \
                 this view",
                tile.x0, tile.y0, tile.x1, tile.y1
            )
        };
        let at = *frame.rehearsed.get_or_init(|| self.find(frame));
        let traced = &self.trace.frames[at.ok_or_else(unknown)?];
        let known = traced.region(&tile, self.trace.about.size).ok_or_else(unknown)?;
        let bricks = shelf.bricks().len() as u32;
        if known.touched.last().is_some_and(|&last| last >= bricks) {
            return Err(unknown());
        }
        let lacks: Vec<u32> =
            known.touched.iter().copied().filter(|&place| !shelf.holds(place)).collect();
        if !lacks.is_empty() {
            return Ok(Through::Lacks(lacks));
        }
        let setup = Duration::from_nanos(traced.setup_ns + traced.outlook_ns);
        let made = *frame.made.get_or_init(|| start + setup);
        let mut opened = locked(&frame.held);
        let fresh = known.opened.iter().filter(|b| opened.insert(**b)).count();
        drop(opened);
        let opening = traced.block_ns.saturating_mul(fresh as u64);
        let took = Duration::from_nanos(known.ns.saturating_add(opening));
        let held = Held { start, end: made.max(start) + took };
        let pixels = match &frame.finish {
            Some(finish) => Pixels::Finished(finished_through(&tile, known.result_bytes, finish)),
            None => Pixels::Sums(filled_through(&tile, known.result_bytes)),
        };
        let (counters, sampled) = (Counters::default(), Sampling::default());
        let drawn = Drawn { pixels, counters, touched: known.into_owned().touched, sampled };
        Ok(Through::Held { held, took, drawn: Box::new(drawn) })
    }
}

/// Where a region came to that is held.
pub(crate) enum Through {
    Lacks(Vec<u32>),
    Held { held: Held, took: Duration, drawn: Box<Drawn> },
}

/// When a task is held.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Held {
    pub(crate) start: Instant,
    pub(crate) end: Instant,
}

impl Held {
    /// Waits for its end. Counts no voxels: nobody drew any.
    pub(crate) fn wait(&self) -> Counters {
        std::thread::sleep(self.end.saturating_duration_since(Instant::now()));
        Counters::default()
    }
}
