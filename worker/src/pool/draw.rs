//! Drawing one task on one render thread.

use super::queue::Turn;
use super::task::{
    DrawnRegion, Progress, RegionReport, RegionTask, SlabReport, SlabTask, StoppableSupply,
};
use slabcast_common::image::SparseTile;
use slabcast_common::message::{ErrorsBySource, Pixels, RegionSplit};
use slabcast_render::Simd;
use slabcast_render::region::{BrickSupply, FinishedRegion, Region};
use slabcast_render::tile::{self, Scratch};
use std::panic::AssertUnwindSafe;
use std::sync::atomic::Ordering;
use std::time::Instant;

/// Runs `work`. A panic of the renderer comes back as its message, and the scratch memory is made
/// anew.
pub(super) fn caught<T>(
    scratch: &mut Scratch,
    work: impl FnOnce(&mut Scratch) -> T,
) -> Result<T, String> {
    std::panic::catch_unwind(AssertUnwindSafe(|| work(scratch))).map_err(|panic| {
        *scratch = Scratch::default();
        let text = panic
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| panic.downcast_ref::<&str>().copied())
            .unwrap_or("a panic without a message");
        format!("the renderer failed: {text}")
    })
}

/// Draws a tile of one slab.
pub(super) fn draw_slab(
    thread: u32,
    simd: Simd,
    task: SlabTask,
    scratch: &mut Scratch,
) -> SlabReport {
    let SlabTask { lease, frame, bricks, received, ready } = task;
    let span = tracing::debug_span!(
        "tile", frame = %lease.frame, task = %lease.task, x = lease.tile.x0, y = lease.tile.y0,
        slab = lease.slab.first
    );
    let _in = span.enter();
    let start = Instant::now();
    let (tile, slab, state) = (lease.tile, lease.slab, &lease.state);
    let outcome = (!frame.has_ended.load(Ordering::Relaxed)).then(|| {
        caught(scratch, |scratch| {
            tile::render(frame.get(), simd, tile, slab, &bricks, state, scratch)
        })
    });
    let end = Instant::now();
    tracing::debug!(ms = (end - start).as_secs_f64() * 1e3, "tile drawn");
    SlabReport { lease, received, ready, start, end, thread, outcome }
}

/// Draws a region until it ends, lacks bricks, or its client's turn ends. Calls `give` with each piece
/// that is split off.
pub(super) fn draw_region(
    thread: u32,
    simd: Simd,
    mut task: Box<RegionTask>,
    scratch: &mut Scratch,
    turn: &Turn<'_>,
    give: &dyn Fn(RegionSplit),
) -> RegionReport {
    let span = tracing::debug_span!(
        "region", frame = %task.lease.frame, task = %task.lease.task, x = task.lease.tile.x0,
        y = task.lease.tile.y0
    );
    let _in = span.enter();
    let progress = if task.frame.has_ended.load(Ordering::Relaxed) {
        Progress::FrameEnded
    } else {
        caught(scratch, |scratch| advance(simd, &mut task, scratch, turn, give))
            .unwrap_or_else(Progress::Failed)
    };
    RegionReport { task, end: Instant::now(), thread, progress }
}

fn advance(
    simd: Simd,
    task: &mut RegionTask,
    scratch: &mut Scratch,
    turn: &Turn<'_>,
    give: &dyn Fn(RegionSplit),
) -> Progress {
    let RegionTask { lease, frame: slot, table, split, drawn, region, ahead, .. } = task;
    let frame = slot.get();
    let visible = slot.visible_bricks(table.directory());
    let start = Instant::now();
    let depth_before = region.as_ref().and_then(Region::depth);
    let current = match region {
        Some(region) => region,
        None => region.insert(match &lease.begun {
            None => Region::new(visible, lease.tile),
            Some(begun) => match Region::resume(visible, lease.tile, begun) {
                Ok(region) => region,
                Err(why) => {
                    return Progress::Failed(format!("the state to resume its tile from: {why}"));
                }
            },
        }),
    };
    let supply = StoppableSupply { table, split, has_ended: &slot.has_ended, turn };
    let missing = loop {
        let missing = current.advance(frame, simd, visible, &supply, *ahead, scratch);
        let Some(share) = split.take().filter(|_| current.depth().is_some()) else {
            break missing;
        };
        let eps = frame.scene.quality.eps;
        if let Some((kept, given, begun)) = current.split_off(visible, eps, share) {
            let (task, epoch) = (lease.task, lease.epoch);
            lease.tile = kept;
            give(RegionSplit { task, epoch, kept, given, begun });
        }
    };
    *drawn += start.elapsed();
    let ms = start.elapsed().as_secs_f64() * 1e3;
    tracing::debug!(ms, missing = missing.len(), "region drawn");
    if !missing.is_empty() {
        let is_deeper = current.depth() != depth_before;
        return Progress::Stalled { missing, is_deeper };
    }
    if slot.has_ended.load(Ordering::Relaxed) {
        return Progress::FrameEnded;
    }
    if current.depth().is_some() {
        return Progress::GaveWay;
    }
    let Some(region) = region.take() else { return Progress::FrameEnded };
    let finishing = Instant::now();
    let finished = region.finish();
    finished.record_depths(slot.depths());
    let FinishedRegion { pixels, counters, touched, .. } = finished;
    let size = [lease.tile.width() as u32, lease.tile.height() as u32];
    let pixels = match &slot.finish {
        Some(finish) => Pixels::Finished(SparseTile::encode(&pixels, size, finish)),
        None => Pixels::Sums(pixels),
    };
    *drawn += finishing.elapsed();
    let mut sampled = ErrorsBySource::default();
    // The bricks of sheets that another worker drew are not here.
    if lease.estimate && lease.begun.is_none() {
        let bricks = touched.iter().map(|&place| table.get(place));
        // A brick that was dropped since is not sent again for this.
        let bricks: Option<Vec<_>> = bricks.collect();
        if let Some(bricks) = bricks {
            sampled = slot.probe().sample(frame, simd, lease.tile, &bricks, scratch);
        }
    }
    Progress::Done(Box::new(DrawnRegion { pixels, counters, touched, sampled }))
}
