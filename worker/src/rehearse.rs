//! A worker that holds tiles instead of drawing them.
//!
//! Everything else is real: link, hello, bricks, leases, results of the right size. So processes on
//! one machine rehearse a cluster of many: a core draws one tile at a time, but any number of
//! threads can wait. What a tile takes is in a [`Trace`]; its pixels are those of
//! [`slabcast_trace::filled`], which shut what the real ones would have shut. Only a master
//! that was started for it lets such a worker in, and it marks its pictures.
//!
//! **Time is held on the threads' own account.** The system wakes a sleeping thread some 60 us too
//! late; over a thousand tiles that is a frame. So a thread's next tile begins when the one before
//! should have ended, or when it came, and only a result is late, never the work behind it.

use crate::brick_table::Shelf;
use crate::pool::{Came, Drawn, FrameSlot, Going, Ready, locked};
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Counters, Pixels, Sampling};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::parts;
use slabcast_common::slab::SheetRange;
use slabcast_render::region::BrickSupply;
use slabcast_trace::{Course, Trace, filled, filled_through, finished_through, view_sha256};
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
        let slabs = |f: &slabcast_trace::FrameTrace| {
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

    /// What a region will need by the frame before it, if that was held here: places of bricks that are not here.
    pub(crate) fn expected(&self, frame: &FrameSlot, shelf: &Shelf, tile: Rect) -> Vec<u32> {
        let at = *frame.rehearsed.get_or_init(|| self.find(frame));
        let known = at.and_then(|at| self.trace.frames[at].region(&tile, self.trace.about.size));
        let held = locked(&frame.scene.parts);
        let (Some(known), true) = (known, parts(tile).all(|p| held.contains(&[p.x0, p.y0]))) else {
            return Vec::new();
        };
        let there = |place: &u32| (*place as usize) < shelf.bricks().len() && !shelf.has(*place);
        known.expected.iter().copied().filter(there).collect()
    }

    /// Holds a region from where it stands, from `start` on: where it comes to, and when. As one that is drawn, it goes as
    /// far as bricks are here, those among them that come meanwhile.
    pub(crate) fn region(
        &self,
        going: &mut Going,
        start: Instant,
    ) -> Result<(Came, Instant), String> {
        let tile = going.lease.tile;
        let (frame, shelf, size) = (&going.frame, &going.shelf, self.trace.about.size);
        let unknown = || {
            format!(
                "the trace that is rehearsed has no tile ({},{}) to ({},{}) through all depths of \
                 this view",
                tile.x0, tile.y0, tile.x1, tile.y1
            )
        };
        let at = *frame.rehearsed.get_or_init(|| self.find(frame));
        let traced = &self.trace.frames[at.ok_or_else(unknown)?];
        let known = traced.region(&tile, size).ok_or_else(unknown)?;
        let bricks = shelf.bricks();
        if known.touched.last().is_some_and(|&last| last as usize >= bricks.len()) {
            return Err(unknown());
        }
        let sees = |place: u32| frame.view.project(&bricks.get(place as usize)?.tight);
        let course = match &mut going.course {
            Some(course) => course,
            course => {
                let of = Course::of(traced, &tile, size, &sees);
                course.insert(of.ok_or_else(unknown)?)
            }
        };
        // A tile's parts may name bricks that it does not.
        let has = |place: u32| place as usize >= bricks.len() || shelf.has(place);
        course.take();
        if course.goes(&has) <= 0.0 && !course.is_over() {
            return Ok((Came::Lacks(course.lacks(&has, going.ahead, &sees), true), start));
        }
        let setup = Duration::from_nanos(traced.setup_ns + traced.outlook_ns);
        let mut end = (*frame.made.get_or_init(|| start + setup)).max(start);
        let begun = end;
        if going.drawn.is_zero() {
            let mut opened = locked(&frame.held);
            let fresh = known.opened.iter().filter(|b| opened.insert(**b)).count();
            end += Duration::from_nanos(traced.block_ns.saturating_mul(fresh as u64));
        }
        // Made while the tile is held, and not when that is over.
        let pixels = match &frame.finish {
            Some(finish) => {
                Pixels::Finished(finished_through(&tile, known.bytes(frame.plain), finish))
            }
            None => Pixels::Sums(filled_through(&tile, known.result_bytes)),
        };
        loop {
            let ns = course.goes(&has);
            if ns <= 0.0 {
                break;
            }
            end += Duration::from_nanos(ns.round() as u64);
            Held { start, end }.wait();
            course.go(ns, &has);
        }
        going.drawn += end - begun;
        if !course.is_over() {
            return Ok((Came::Lacks(course.lacks(&has, going.ahead, &sees), true), end));
        }
        locked(&frame.scene.parts).extend(parts(tile).map(|p| [p.x0, p.y0]));
        let (counters, sampled) = (Counters::default(), Sampling::default());
        let drawn = Drawn { pixels, counters, touched: known.into_owned().touched, sampled };
        Ok((Came::Done(Box::new(drawn)), end))
    }
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
