//! Tiles that cost what a [`Trace`] recorded. Their pixels are blank.

use crate::Unpredictable;
use crate::cluster::SMALL_BYTES;
use crate::model::{FrameSetup, Region, Split, TaskFacts, TaskOutput, TileModel, blank_sums};
use slabcast_common::brick::BrickInfo;
use slabcast_common::ids::FrameId;
use slabcast_common::image::SparseTile;
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Checkpoint, Counters, Lease, Pixels, RegionLease};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::{enclosing_square, parts, split_tile};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projected, View};
use slabcast_schedule::FrameJob;
use slabcast_trace::{HasBrick, RegionProgress, RegionTile, Trace};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::Arc;

/// The model of a recorded path. Frame `number` of a job is the frame of that index in the trace.
pub(crate) struct TracedTiles<'a> {
    trace: &'a Trace,
    /// Shut pixels behind the slabs of frames in hand, by frame and first sheet.
    shut: BTreeMap<(u64, i32), Vec<bool>>,
    /// Progress of pieces that were handed over, by the corners of their tiles.
    pieces: BTreeMap<(FrameId, [i32; 4]), RegionProgress>,
}

/// Progress of a region of a recorded frame.
pub(crate) struct TracedRegion {
    progress: RegionProgress,
    bricks: Arc<[BrickInfo]>,
    view: View,
    /// Places of the bricks that it is drawn from.
    touched: Vec<u32>,
}

fn project(view: &View, bricks: &[BrickInfo], place: u32) -> Option<Projected> {
    view.project(&bricks.get(place as usize)?.tight)
}

impl Region for TracedRegion {
    fn resume(&mut self) {
        self.progress.resume();
    }

    fn runs_ns(&mut self, has: HasBrick<'_>) -> f64 {
        self.progress.runs_ns(has)
    }

    fn advance(&mut self, ns: f64, has: HasBrick<'_>) {
        self.progress.advance(ns, has);
    }

    fn is_done(&self) -> bool {
        self.progress.is_done()
    }

    fn missing(&mut self, has: HasBrick<'_>, ahead_sheets: u32) -> Vec<u32> {
        let project = |place| project(&self.view, &self.bricks, place);
        self.progress.missing(has, ahead_sheets, &project)
    }

    fn upcoming(&self) -> Vec<u32> {
        self.progress.upcoming()
    }
}

fn corners(r: &Rect) -> [i32; 4] {
    [r.x0, r.y0, r.x1, r.y1]
}

impl<'a> TracedTiles<'a> {
    pub(crate) fn new(trace: &'a Trace) -> Self {
        TracedTiles { trace, shut: BTreeMap::new(), pieces: BTreeMap::new() }
    }

    /// Progress of a piece that was handed over, or of a part of one.
    fn piece(&self, job: &FrameJob, tile: &Rect) -> Option<RegionProgress> {
        let of_frame = (job.frame, [i32::MIN; 4])..=(job.frame, [i32::MAX; 4]);
        let around = self.pieces.range(of_frame).filter_map(|((_, [x0, y0, x1, y1]), piece)| {
            let whole = Rect::new(*x0, *y0, *x1, *y1);
            (whole.union(tile) == whole).then_some((whole, piece))
        });
        let (whole, piece) = around.min_by_key(|(whole, _)| whole.area())?;
        Some(piece.piece(&whole, tile, &|place| project(&job.view, &job.bricks, place)))
    }

    /// Looks up the record of a whole region. A tile that was not recorded, since pieces of it were
    /// handed over, takes it from the squares in which its parts lie.
    fn region(&self, job: &FrameJob, tile: Rect) -> Option<Cow<'a, RegionTile>> {
        let trace: &'a Trace = self.trace;
        let (traced, size) = (&trace.frames[job.number as usize], trace.about.size);
        if let Some(region) = traced.region(&tile, size) {
            return Some(region);
        }
        let overlaps = |place: &u32| {
            let projected = project(&job.view, &job.bricks, *place);
            projected.is_some_and(|p| !p.rect.intersect(&tile).is_empty())
        };
        let mut all = RegionTile { x: tile.x0 as u32, y: tile.y0 as u32, ..RegionTile::default() };
        for part in parts(tile) {
            let whole = traced.region(&enclosing_square(&part, size), size)?;
            all.touched.extend(whole.touched.iter().copied().filter(overlaps));
            all.opened.extend_from_slice(&whole.opened);
            all.expected.extend(whole.expected.iter().copied().filter(overlaps));
        }
        all.result_bytes = 3 * tile.area() as u32;
        all.plain_bytes = all.result_bytes;
        for list in [&mut all.touched, &mut all.opened, &mut all.expected] {
            list.sort_unstable();
            list.dedup();
        }
        Some(Cow::Owned(all))
    }

    fn unknown(job: &FrameJob, tile: Rect, sheets: SheetRange) -> Unpredictable {
        let SheetRange { first, end } = sheets;
        Unpredictable::Tile { frame: job.number as usize, tile, first, end }
    }
}

impl TileModel for TracedTiles<'_> {
    type Region = TracedRegion;

    fn setup(&self, job: &FrameJob) -> FrameSetup {
        let traced = &self.trace.frames[job.number as usize];
        FrameSetup {
            tables_ns: traced.setup_ns,
            directory_ns: traced.outlook_ns,
            block_ns: traced.block_ns,
        }
    }

    fn slab_facts(&self, job: &FrameJob, lease: &Lease) -> Result<TaskFacts, Unpredictable> {
        let slab = self.trace.frames[job.number as usize].slab(lease.slab);
        let tile = slab.and_then(|s| s.tile(&lease.tile, self.trace.about.size));
        let tile = tile.ok_or_else(|| Self::unknown(job, lease.tile, lease.slab))?;
        Ok(TaskFacts {
            ns: tile.ns as f64,
            lease_bytes: tile.lease_bytes.into(),
            packed_bytes: tile.result_bytes.into(),
            plain_bytes: tile.result_bytes.into(),
            ..TaskFacts::default()
        })
    }

    fn draw_slab(&mut self, job: &FrameJob, lease: &Lease) -> TaskOutput {
        let (tile, size) = (lease.tile, self.trace.about.size);
        let traced = &self.trace.frames[job.number as usize];
        let shut = self
            .shut
            .entry((job.number, lease.slab.first))
            .or_insert_with(|| traced.slab(lease.slab).map_or_else(Vec::new, |s| s.shut(size)));
        let mut a = Vec::with_capacity(tile.area());
        for y in tile.y0..tile.y1 {
            let row = y as usize * size[0] as usize;
            let row = &shut[row + tile.x0 as usize..row + tile.x1 as usize];
            a.extend(row.iter().map(|&s| f32::from(u8::from(s))));
        }
        let pixels = TilePixels { a, ..blank_sums(tile) };
        let (counters, touched) = (Counters::default(), Vec::new());
        TaskOutput { pixels: Pixels::Sums(pixels), counters, touched }
    }

    fn begin_region(
        &mut self,
        job: &FrameJob,
        lease: &RegionLease,
    ) -> Result<(TaskFacts, TracedRegion), Unpredictable> {
        let tile = lease.tile;
        let unknown = || Self::unknown(job, tile, SheetRange::new(i32::MIN, i32::MAX));
        let (facts, progress, touched) = if lease.begun.is_some() {
            let progress = self.piece(job, &tile).ok_or_else(unknown)?;
            let result_bytes = SMALL_BYTES + 3 * tile.area() as u64;
            let facts = TaskFacts {
                lease_bytes: SMALL_BYTES,
                packed_bytes: result_bytes,
                plain_bytes: result_bytes,
                ..TaskFacts::default()
            };
            let touched = progress.upcoming();
            (facts, progress, touched)
        } else {
            let region = self.region(job, tile).ok_or_else(unknown)?;
            let traced = &self.trace.frames[job.number as usize];
            let project = |place| project(&job.view, &job.bricks, place);
            let progress = RegionProgress::new(traced, &tile, self.trace.about.size, &project);
            // A bit or so for each touched brick, and the cost's other figures.
            let beside = 20 + region.touched.len() as u64;
            let region = region.into_owned();
            let facts = TaskFacts {
                lease_bytes: SMALL_BYTES,
                packed_bytes: u64::from(region.result_bytes) + beside,
                plain_bytes: u64::from(region.plain_bytes) + beside,
                blocks: region.opened,
                prefetch: region.expected,
                ..TaskFacts::default()
            };
            (facts, progress.ok_or_else(unknown)?, region.touched)
        };
        let (bricks, view) = (job.bricks.clone(), job.view);
        Ok((facts, TracedRegion { progress, bricks, view, touched }))
    }

    fn split(
        &mut self,
        job: &FrameJob,
        region: &mut TracedRegion,
        tile: Rect,
        share: f64,
        _: HasBrick<'_>,
    ) -> Option<Split> {
        let progress = &mut region.progress;
        let (kept, given) = split_tile(tile, share, |piece| progress.left_in_ns(piece))?;
        let project = |place| project(&job.view, &job.bricks, place);
        let piece = progress.piece(&tile, &given, &project);
        *progress = progress.piece(&tile, &kept, &project);
        // A piece that nothing was drawn into has no sums of a last sheet.
        let is_begun = piece.left_ns() < piece.total_ns();
        let last = is_begun.then(|| vec![[0; 4]; given.area()]);
        let pixels = TilePixels { last, ..blank_sums(given) };
        let begun = Checkpoint { sheets: piece.next_sheets(given, &project), pixels };
        self.pieces.insert((job.frame, corners(&given)), piece);
        Some(Split { kept, given, begun })
    }

    fn finish_region(
        &mut self,
        job: &FrameJob,
        lease: &RegionLease,
        region: TracedRegion,
    ) -> TaskOutput {
        let tile = lease.tile;
        let pixels = match job.finish {
            Some(finish) => {
                let size = [tile.width() as u32, tile.height() as u32];
                Pixels::Finished(SparseTile::blank(size, finish.format))
            }
            None => Pixels::Sums(blank_sums(tile)),
        };
        TaskOutput { pixels, counters: Counters::default(), touched: region.touched }
    }

    fn end_frame(&mut self, job: &FrameJob) {
        self.shut.retain(|(number, _), _| *number != job.number);
    }
}
