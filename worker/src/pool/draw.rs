//! Drawing one task on one render thread.

use super::task::{Came, Drawn, Going, Gone, Ready, Rendered, Watched};
use slabcast_common::leaves::Leaves;
use slabcast_common::message::{HandedOver, Pixels, Sampling};
use slabcast_render::Simd;
use slabcast_render::region::{BrickSupply, FinishedRegion, Region};
use slabcast_render::tile::{self, Scratch};
use std::panic::AssertUnwindSafe;
use std::sync::atomic::Ordering;
use std::time::Instant;

/// What `work` gives, or in words how the renderer failed; its memory is not used again then.
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
            .unwrap_or("a panic without words");
        format!("the renderer failed: {text}")
    })
}

pub(super) fn render(thread: u32, simd: Simd, task: Ready, scratch: &mut Scratch) -> Rendered {
    let Ready { lease, frame, bricks, received, ready } = task;
    let span = tracing::debug_span!(
        "tile", frame = %lease.frame, task = %lease.task, x = lease.tile.x0, y = lease.tile.y0,
        slab = lease.slab.first
    );
    let _in = span.enter();
    let start = Instant::now();
    let (tile, slab, state) = (lease.tile, lease.slab, &lease.state);
    let outcome = (!frame.over.load(Ordering::Relaxed)).then(|| {
        caught(scratch, |scratch| {
            tile::render(frame.get(), simd, tile, slab, &bricks, state, scratch)
        })
    });
    let end = Instant::now();
    tracing::debug!(ms = (end - start).as_secs_f64() * 1e3, "rendered");
    Rendered { lease, received, ready, start, end, thread, outcome }
}

pub(super) fn advance(
    thread: u32,
    simd: Simd,
    mut going: Box<Going>,
    scratch: &mut Scratch,
    give: &dyn Fn(HandedOver),
) -> Gone {
    let span = tracing::debug_span!(
        "region", frame = %going.lease.frame, task = %going.lease.task, x = going.lease.tile.x0,
        y = going.lease.tile.y0
    );
    let _in = span.enter();
    let came = if going.frame.over.load(Ordering::Relaxed) {
        Came::Over
    } else {
        caught(scratch, |scratch| go(simd, &mut going, scratch, give)).unwrap_or_else(Came::Failed)
    };
    Gone { going, end: Instant::now(), thread, came }
}

fn go(simd: Simd, going: &mut Going, scratch: &mut Scratch, give: &dyn Fn(HandedOver)) -> Came {
    let Going { lease, frame: slot, shelf, wish, drawn, region, ahead, .. } = going;
    let frame = slot.get();
    let outlook = slot.outlook(shelf.directory());
    let start = Instant::now();
    let before = region.as_ref().and_then(Region::depth);
    let on = match region {
        Some(on) => on,
        None => region.insert(match &lease.begun {
            None => Region::new(outlook, lease.tile),
            Some(begun) => match Region::resume(outlook, lease.tile, begun) {
                Ok(on) => on,
                Err(why) => return Came::Failed(format!("what was begun of its tile: {why}")),
            },
        }),
    };
    let supply = Watched(shelf, wish);
    let lacks = loop {
        let lacks = on.advance(frame, simd, outlook, &supply, *ahead, scratch);
        let Some(share) = wish.take().filter(|_| on.depth().is_some()) else { break lacks };
        let eps = frame.scene.quality.eps;
        if let Some((kept, given, begun)) = on.split_off(outlook, eps, share) {
            let (task, epoch) = (lease.task, lease.epoch);
            lease.tile = kept;
            give(HandedOver { task, epoch, kept, given, begun });
        }
    };
    *drawn += start.elapsed();
    tracing::debug!(ms = start.elapsed().as_secs_f64() * 1e3, lacks = lacks.len(), "drawn");
    if !lacks.is_empty() {
        let farther = on.depth() != before;
        return Came::Lacks(lacks, farther);
    }
    match region.take() {
        Some(region) => {
            let begun = Instant::now();
            let done = region.finish();
            done.record_depths(slot.depths());
            let FinishedRegion { pixels, counters, touched, .. } = done;
            let size = [lease.tile.width() as u32, lease.tile.height() as u32];
            let pixels = match &slot.finish {
                Some(finish) => Pixels::Finished(Leaves::of(&pixels, size, finish)),
                None => Pixels::Sums(pixels),
            };
            *drawn += begun.elapsed();
            let mut sampled = Sampling::default();
            // Of what another began, its bricks are not here.
            if lease.estimate && lease.begun.is_none() {
                let bricks = touched.iter().map(|&place| shelf.get(place));
                // One that was forgotten since is not sent again for this.
                let bricks: Option<Vec<_>> = bricks.collect();
                if let Some(bricks) = bricks {
                    sampled = slot.probe().sample(frame, simd, lease.tile, &bricks, scratch);
                }
            }
            Came::Done(Box::new(Drawn { pixels, counters, touched, sampled }))
        }
        None => Came::Over,
    }
}
