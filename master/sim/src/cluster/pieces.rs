//! Pieces of regions that virtual workers give away (`frame::handover`): what a trace of whole tiles says of them.

use super::{Lent, Nanos, SMALL, Task, World};
use slabcast_common::ids::{Epoch, FrameId, TaskId, WorkerId};
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Checkpoint, RegionSplit};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::{enclosing_square, parts, split_tile};
use slabcast_schedule::{Event, FrameJob};
use slabcast_trace::{RegionProgress, RegionTile, Trace};
use std::borrow::Cow;

/// Bytes of a piece's state: an opacity, three colours and four sums a pixel.
pub(super) fn state_bytes(pixels: &TilePixels) -> u64 {
    // Of one that nothing was drawn into there are none.
    let words = if pixels.last.is_some() { 32 } else { 0 };
    SMALL + words * pixels.a.len() as u64
}

fn corners(r: &Rect) -> [i32; 4] {
    [r.x0, r.y0, r.x1, r.y1]
}

impl<'a> World<'a> {
    /// A piece that was given away, or what is left of one of which pieces were.
    pub(super) fn piece_of(&self, frame: FrameId, tile: &Rect) -> Option<RegionProgress> {
        let of_frame = (frame, [i32::MIN; 4])..=(frame, [i32::MAX; 4]);
        let around = self.pieces.range(of_frame).filter_map(|((_, [x0, y0, x1, y1]), piece)| {
            let whole = Rect::new(*x0, *y0, *x1, *y1);
            (whole.union(tile) == whole).then_some((whole, piece))
        });
        let (whole, piece) = around.min_by_key(|(whole, _)| whole.area())?;
        Some(piece.piece(&whole, tile, &self.sees(frame)))
    }

    /// What is known of a region from its first sheet on. Of one of which pieces were given away, what its parts say.
    pub(super) fn whole_region(&self, tile: Rect, frame: usize) -> Option<Cow<'a, RegionTile>> {
        let trace: &'a Trace = self.trace;
        let (traced, size) = (&trace.frames[frame], trace.about.size);
        if let Some(region) = traced.region(&tile, size) {
            return Some(region);
        }
        let sees = self.sees(FrameId(frame as u64 + 1));
        let over = |p: &u32| sees(*p).is_some_and(|p| !p.rect.intersect(&tile).is_empty());
        let mut all = RegionTile { x: tile.x0 as u32, y: tile.y0 as u32, ..RegionTile::default() };
        for part in parts(tile) {
            let whole = traced.region(&enclosing_square(&part, size), size)?;
            all.touched.extend(whole.touched.iter().copied().filter(over));
            all.opened.extend_from_slice(&whole.opened);
            all.expected.extend(whole.expected.iter().copied().filter(over));
        }
        all.result_bytes = 3 * tile.area() as u32;
        all.plain_bytes = all.result_bytes;
        for list in [&mut all.touched, &mut all.opened, &mut all.expected] {
            list.sort_unstable();
            list.dedup();
        }
        Some(Cow::Owned(all))
    }

    /// A worker cuts what is left of a region in two, as `render::region` does: by parts that it has not come to, and by
    /// sheets of the one that it is at.
    pub(super) fn hand_over(&mut self, id: WorkerId, name: (TaskId, Epoch), share: f64, at: Nanos) {
        let stretch = self.cluster.stretch;
        let w = self.workers.get_mut(&id).expect("a worker stays");
        let of = |l: &Lent<'_>| l.task.name() == name;
        let thread = w.running.iter().position(|r| r.as_ref().is_some_and(|r| of(&r.lent)));
        let lent = match thread {
            Some(thread) => {
                let Some(r) = &mut w.running[thread] else { return };
                let set = self.jobs[r.lent.task.frame().0 as usize - 1].scene.bricks;
                r.follow(&w.present[&set], at, stretch);
                &mut r.lent
            }
            None => match w.leases.iter_mut().find(|l| of(l)) {
                Some(lent) => lent,
                None => return,
            },
        };
        let (Task::Region(lease), Some(course)) = (&mut lent.task, &mut lent.course) else {
            return;
        };
        // What is nowhere near its first sheet yet is given away once.
        if lease.begun.is_some() && thread.is_none() {
            return;
        }
        let (frame, tile) = (lease.frame, lease.tile);
        let Some((kept, given)) = split_tile(tile, share, |piece| course.left_in_ns(piece)) else {
            return;
        };
        let job: &'a FrameJob = {
            let jobs: &'a [FrameJob] = self.jobs;
            &jobs[frame.0 as usize - 1]
        };
        let sees = |place: u32| job.view.project(&job.bricks.get(place as usize)?.tight);
        let piece = course.piece(&tile, &given, &sees);
        *course = course.piece(&tile, &kept, &sees);
        lease.tile = kept;
        let known = &mut lent.known;
        let part = |bytes| bytes * kept.area() as u64 / tile.area() as u64;
        known.result_bytes = known.result_bytes.map(part);
        // What it still waits for, it may no longer need.
        let still = course.upcoming();
        lent.waits.retain(|place| still.binary_search(place).is_ok());
        let n = given.area();
        let (all, left) = (piece.total_ns(), piece.left_ns());
        // Of one that nothing was drawn into there are no sums.
        let last = (left < all).then(|| vec![[0; 4]; n]);
        let pixels = TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last };
        let begun = Checkpoint { sheets: piece.next_sheets(given, &sees), pixels };
        if let Some(thread) = thread {
            self.goes_until(id, thread);
        }
        let (task, epoch) = name;
        self.outcome.frames[frame.0 as usize - 1].handed_over += 1;
        self.pieces.insert((frame, corners(&given)), piece);
        let bytes = state_bytes(&begun.pixels);
        let piece = Box::new(RegionSplit { task, epoch, kept, given, begun });
        self.up(id, Event::HandedOver { worker: id, piece }, bytes, at);
    }
}
