//! A worker that holds tiles for their recorded time instead of drawing them.
//!
//! Everything else is real: link, hello, bricks, leases, results of the right size. So processes on
//! one machine rehearse a cluster of many: a core draws one tile at a time, but any number of
//! threads can wait. Times come from a [`Trace`]; pixels are placeholders of the recorded size,
//! shut where the real ones were shut. Only a master that was started for rehearsals admits such a
//! worker, and it marks its pictures.
//!
//! **A late wake-up never delays the next tile.** The system wakes a sleeping thread some 60 us too
//! late; over a thousand tiles that is a frame. So a thread's next tile begins when the one before
//! should have ended, or when it arrived. Only the result is late.

use crate::brick_table::BrickTable;
use crate::pool::{DrawnRegion, FrameSlot, Progress, RegionTask, SlabTask, locked};
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Counters, ErrorsBySource, Pixels};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::parts;
use slabcast_common::slab::SheetRange;
use slabcast_render::region::BrickSupply;
use slabcast_trace::{
    FrameTrace, RegionProgress, Trace, placeholder_finished, placeholder_slab, placeholder_sums,
    view_sha256,
};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A trace, ready to be looked up by a worker's threads.
pub struct Rehearsal {
    trace: Trace,
    /// Shut pixels by frame and slab.
    shut: Vec<Vec<Arc<Vec<bool>>>>,
}

impl std::fmt::Debug for Rehearsal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Rehearsal of {} frames of {}", self.trace.frames.len(), self.trace.about.volume)
    }
}

impl Rehearsal {
    /// Prepares a trace. Takes a byte of memory for each pixel of each slab of each frame.
    pub fn new(trace: Trace) -> Self {
        let size = trace.about.size;
        let slabs = |f: &FrameTrace| f.slabs.iter().map(|s| Arc::new(s.shut(size))).collect();
        Rehearsal { shut: trace.frames.iter().map(slabs).collect(), trace }
    }

    /// The index of a frame in the trace, looked up once a frame.
    fn index(&self, frame: &FrameSlot) -> Option<usize> {
        *frame.rehearsed.get_or_init(|| {
            let name = view_sha256(&frame.scene.spec, &frame.view).to_string();
            self.trace.frames.iter().position(|f| f.view == name)
        })
    }

    /// Looks up when a thread that is free from `free` on begins and ends a slab's tile, and its
    /// pixels.
    ///
    /// # Errors
    /// A sentence if the trace has no such tile.
    pub(crate) fn task(
        &self,
        task: &SlabTask,
        free: Instant,
    ) -> Result<(Held, TilePixels), String> {
        let SlabTask { lease, frame, .. } = task;
        let SheetRange { first, end } = lease.slab;
        let unknown = || {
            let Rect { x0, y0, x1, y1 } = lease.tile;
            format!(
                "the trace that is rehearsed has no tile ({x0},{y0}) to ({x1},{y1}) of sheets \
                 {first} to {end} of this view"
            )
        };
        let index = self.index(frame).ok_or_else(unknown)?;
        let traced = &self.trace.frames[index];
        let size = self.trace.about.size;
        let slab = traced.slabs.iter().position(|s| s.first == first && s.end == end);
        let slab = slab.ok_or_else(unknown)?;
        let tile = traced.slabs[slab].tile(&lease.tile, size).ok_or_else(unknown)?;
        let start = free.max(task.ready);
        // The first task of a frame makes its tables; others wait for them.
        let setup = Duration::from_nanos(traced.setup_ns);
        let made = *frame.made.get_or_init(|| start + setup);
        let end = made.max(start) + Duration::from_nanos(tile.ns);
        let shut = &self.shut[index][slab];
        Ok((Held { start, end }, placeholder_slab(&lease.tile, shut, size, tile.result_bytes)))
    }

    /// Places of the bricks that a worker would prefetch for a region, if it held the region's
    /// parts in the frame before; bricks that are here are left out.
    pub(crate) fn expected(&self, frame: &FrameSlot, table: &BrickTable, tile: Rect) -> Vec<u32> {
        let index = self.index(frame);
        let known = index.and_then(|i| self.trace.frames[i].region(&tile, self.trace.about.size));
        let held = locked(&frame.scene.parts);
        let (Some(known), true) = (known, parts(tile).all(|p| held.contains(&[p.x0, p.y0]))) else {
            return Vec::new();
        };
        let lacks = |place: &u32| (*place as usize) < table.bricks().len() && !table.has(*place);
        known.expected.iter().copied().filter(lacks).collect()
    }

    /// Holds a region from `start` on until it is done or lacks bricks. Returns the result or the
    /// bricks, and when that was. Bricks that arrive meanwhile let it go on.
    ///
    /// # Errors
    /// A sentence if the trace has no such tile.
    pub(crate) fn region(
        &self,
        task: &mut RegionTask,
        start: Instant,
    ) -> Result<(Progress, Instant), String> {
        let tile = task.lease.tile;
        let (frame, table, size) = (&task.frame, &task.table, self.trace.about.size);
        let unknown = || {
            let Rect { x0, y0, x1, y1 } = tile;
            format!(
                "the trace that is rehearsed has no tile ({x0},{y0}) to ({x1},{y1}) through all \
                 depths of this view"
            )
        };
        let traced = &self.trace.frames[self.index(frame).ok_or_else(unknown)?];
        let known = traced.region(&tile, size).ok_or_else(unknown)?;
        let bricks = table.bricks();
        if known.touched.last().is_some_and(|&last| last as usize >= bricks.len()) {
            return Err(unknown());
        }
        let project = |place: u32| frame.view.project(&bricks.get(place as usize)?.tight);
        let progress = match &mut task.course {
            Some(progress) => progress,
            none => {
                let new = RegionProgress::new(traced, &tile, size, &project);
                none.insert(new.ok_or_else(unknown)?)
            }
        };
        // The parts of a tile may name bricks that the tile does not.
        let has = |place: u32| place as usize >= bricks.len() || table.has(place);
        progress.resume();
        if progress.runs_ns(&has) <= 0.0 && !progress.is_done() {
            let missing = progress.missing(&has, task.ahead, &project);
            return Ok((Progress::Stalled { missing, is_deeper: true }, start));
        }
        let setup = Duration::from_nanos(traced.setup_ns + traced.outlook_ns);
        let mut end = (*frame.made.get_or_init(|| start + setup)).max(start);
        let begun = end;
        if task.drawn.is_zero() {
            let mut opened = locked(&frame.held);
            let fresh = known.opened.iter().filter(|b| opened.insert(**b)).count();
            end += Duration::from_nanos(traced.block_ns.saturating_mul(fresh as u64));
        }
        // Made while the tile is held, not afterwards.
        let pixels = match &frame.finish {
            Some(finish) => {
                let bytes = known.wire_bytes(frame.plain);
                Pixels::Finished(placeholder_finished(&tile, bytes, finish))
            }
            None => Pixels::Sums(placeholder_sums(&tile, known.result_bytes)),
        };
        loop {
            let ns = progress.runs_ns(&has);
            if ns <= 0.0 {
                break;
            }
            end += Duration::from_nanos(ns.round() as u64);
            Held { start, end }.wait();
            progress.advance(ns, &has);
        }
        task.drawn += end - begun;
        if !progress.is_done() {
            let missing = progress.missing(&has, task.ahead, &project);
            return Ok((Progress::Stalled { missing, is_deeper: true }, end));
        }
        locked(&frame.scene.parts).extend(parts(tile).map(|p| [p.x0, p.y0]));
        let (counters, sampled) = (Counters::default(), ErrorsBySource::default());
        let drawn = DrawnRegion { pixels, counters, touched: known.into_owned().touched, sampled };
        Ok((Progress::Done(Box::new(drawn)), end))
    }
}

/// The time for which a thread holds a task.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Held {
    pub(crate) start: Instant,
    pub(crate) end: Instant,
}

impl Held {
    /// Sleeps until the end. Returns empty counters, since no voxel was drawn.
    pub(crate) fn wait(&self) -> Counters {
        std::thread::sleep(self.end.saturating_duration_since(Instant::now()));
        Counters::default()
    }
}
