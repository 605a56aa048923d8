//! Tasks and their results: leases, regions, work stealing.

use super::bricks::{ascending_from_wire, brick_ids_to_wire};
use super::finished::{self, Compression};
use super::{plane, required, wire};
use crate::convert::{MAX_BRICK_LIST, MAX_TILE_PIXELS, WireError};
use slabcast_common::ids::{BrickId, Epoch, FrameId, TaskId};
use slabcast_common::image::{RawSums, TilePixels, TileState};
use slabcast_common::message::{
    Checkpoint, Counters, ErrorsBySource, Lease, Pixels, RegionCost, RegionLease, RegionSplit,
    SampledError, TaskTimes, TileResult,
};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::parts;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::MAX_EDGE;
use std::sync::Arc;

// ---------------------------------------------------------------------------------------------
// Tiles and planes

fn rect_to_wire(rect: Rect) -> wire::Rect {
    assert!(rect.x0 >= 0 && rect.y0 >= 0, "tiles lie inside the picture");
    wire::Rect {
        x: rect.x0 as u32,
        y: rect.y0 as u32,
        width: rect.width() as u32,
        height: rect.height() as u32,
    }
}

/// A tile that lies inside some picture.
fn rect_from_wire(field: &str, rect: Option<wire::Rect>) -> Result<Rect, WireError> {
    let wire::Rect { x, y, width, height } = required(field, rect)?;
    let wrong = |name, problem| Err(WireError::value(name, problem).within(field));
    for (corner, length, start, n) in [("x", "width", x, width), ("y", "height", y, height)] {
        if start >= MAX_EDGE {
            return wrong(corner, format!("{start}; pictures have {MAX_EDGE} pixels"));
        }
        if n == 0 || n > MAX_EDGE - start {
            return wrong(length, format!("{n}; give 1 to {}", MAX_EDGE - start));
        }
    }
    let n = width as usize * height as usize;
    if n > MAX_TILE_PIXELS {
        return Err(WireError::too_long(field, n, MAX_TILE_PIXELS));
    }
    let (x0, y0) = (x as i32, y as i32);
    Ok(Rect::new(x0, y0, x0 + width as i32, y0 + height as i32))
}

fn opacity_to_wire(a: &[f32]) -> wire::Plane {
    plane::to_wire(a.len(), |i| [a[i].to_bits()])
}

fn opacity_from_wire(a: Option<wire::Plane>, n: usize) -> Result<Vec<f32>, WireError> {
    // A plane whose every field is zero is an empty message, and a writer may leave it out.
    plane::from_wire(a.unwrap_or_default(), n, |[w]: [u32; 1]| f32::from_bits(w))
        .map_err(|e| e.within("opacity"))
}

fn colour_from_wire(colour: Option<wire::Plane>, n: usize) -> Result<Vec<[u32; 3]>, WireError> {
    plane::from_wire(colour.unwrap_or_default(), n, |p: [u32; 3]| p).map_err(|e| e.within("colour"))
}

fn last_to_wire(last: &Option<Vec<RawSums>>, n: usize) -> Option<wire::Plane> {
    last.as_ref().map(|sums| {
        assert_eq!(sums.len(), n, "raw sums have their tile's size");
        plane::to_wire(n, |i| sums[i])
    })
}

fn last_from_wire(last: Option<wire::Plane>, n: usize) -> Result<Option<Vec<RawSums>>, WireError> {
    last.map(|sums| plane::from_wire(sums, n, |p: RawSums| p).map_err(|e| e.within("last_sheet")))
        .transpose()
}

// ---------------------------------------------------------------------------------------------
// Leases and regions

pub(super) fn lease_to_wire(lease: &Lease) -> wire::Lease {
    let n = lease.tile.area();
    assert_eq!(lease.state.a.len(), n, "opacities have their tile's size");
    wire::Lease {
        task: lease.task.0,
        epoch: lease.epoch.0,
        frame: lease.frame.0,
        tile: Some(rect_to_wire(lease.tile)),
        first_sheet: lease.slab.first,
        end_sheet: lease.slab.end,
        bricks: Some(brick_ids_to_wire(&lease.bricks)),
        opacity: Some(opacity_to_wire(&lease.state.a)),
        last_sheet: last_to_wire(&lease.state.last, n),
    }
}

pub(super) fn lease_from_wire(lease: wire::Lease) -> Result<Lease, WireError> {
    let tile = rect_from_wire("tile", lease.tile)?;
    let n = tile.area();
    if lease.first_sheet >= lease.end_sheet {
        return Err(WireError::value("end_sheet", "is not behind first_sheet"));
    }
    Ok(Lease {
        task: TaskId(lease.task),
        epoch: Epoch(lease.epoch),
        frame: FrameId(lease.frame),
        tile,
        slab: SheetRange::new(lease.first_sheet, lease.end_sheet),
        bricks: ascending_from_wire("bricks", lease.bricks)?,
        state: TileState {
            a: opacity_from_wire(lease.opacity, n)?,
            last: last_from_wire(lease.last_sheet, n)?,
        },
    })
}

pub(super) fn region_to_wire(lease: &RegionLease) -> wire::Region {
    wire::Region {
        task: lease.task.0,
        epoch: lease.epoch.0,
        frame: lease.frame.0,
        tile: Some(rect_to_wire(lease.tile)),
        estimate_error: lease.estimate,
        checkpoint: lease.begun.as_ref().map(|begun| checkpoint_to_wire(begun)),
    }
}

pub(super) fn region_from_wire(lease: wire::Region) -> Result<RegionLease, WireError> {
    let tile = rect_from_wire("tile", lease.tile)?;
    let begun = lease.checkpoint.map(|checkpoint| checkpoint_from_wire(checkpoint, tile));
    Ok(RegionLease {
        task: TaskId(lease.task),
        epoch: Epoch(lease.epoch),
        frame: FrameId(lease.frame),
        tile,
        estimate: lease.estimate_error,
        begun: begun.transpose()?.map(Arc::new),
    })
}

// ---------------------------------------------------------------------------------------------
// Work stealing

fn checkpoint_to_wire(begun: &Checkpoint) -> wire::Checkpoint {
    let (p, n) = (&begun.pixels, begun.pixels.a.len());
    assert_eq!(p.colour.len(), n, "colour has its tile's size");
    let part = |&next_sheet: &Option<i32>| wire::PartCheckpoint { next_sheet };
    wire::Checkpoint {
        parts: begun.sheets.iter().map(part).collect(),
        opacity: Some(opacity_to_wire(&p.a)),
        colour: Some(plane::to_wire(n, |i| p.colour[i])),
        last_sheet: last_to_wire(&p.last, n),
    }
}

/// The state of `tile`; errors name fields from `checkpoint` on.
fn checkpoint_from_wire(checkpoint: wire::Checkpoint, tile: Rect) -> Result<Checkpoint, WireError> {
    let read = || {
        let (n, of_tile) = (tile.area(), parts(tile).count());
        if checkpoint.parts.len() != of_tile {
            return Err(WireError::length("parts", checkpoint.parts.len(), of_tile));
        }
        let colour = colour_from_wire(checkpoint.colour, n)?;
        let a = opacity_from_wire(checkpoint.opacity, n)?;
        let last = last_from_wire(checkpoint.last_sheet, n)?;
        let sheets = checkpoint.parts.iter().map(|part| part.next_sheet).collect();
        Ok(Checkpoint { sheets, pixels: TilePixels { a, colour, last } })
    };
    read().map_err(|e: WireError| e.within("checkpoint"))
}

pub(super) fn split_to_wire(split: &RegionSplit) -> wire::RegionSplit {
    wire::RegionSplit {
        task: split.task.0,
        epoch: split.epoch.0,
        kept: Some(rect_to_wire(split.kept)),
        given: Some(rect_to_wire(split.given)),
        checkpoint: Some(checkpoint_to_wire(&split.begun)),
    }
}

pub(super) fn split_from_wire(split: wire::RegionSplit) -> Result<RegionSplit, WireError> {
    let kept = rect_from_wire("kept", split.kept)?;
    let given = rect_from_wire("given", split.given)?;
    Ok(RegionSplit {
        task: TaskId(split.task),
        epoch: Epoch(split.epoch),
        kept,
        given,
        begun: checkpoint_from_wire(required("checkpoint", split.checkpoint)?, given)?,
    })
}

// ---------------------------------------------------------------------------------------------
// Results

pub(super) fn result_to_wire(result: &TileResult, compression: Compression) -> wire::TileResult {
    let (c, t) = (&result.counters, &result.times);
    let n = result.pixels.len();
    let mut message = wire::TileResult {
        task: result.task.0,
        epoch: result.epoch.0,
        pixels: n as u32,
        tossed: c.tossed,
        splatted: c.splatted,
        culled: c.culled,
        received_us: t.received_us,
        ready_us: t.ready_us,
        start_us: t.start_us,
        end_us: t.end_us,
        thread: t.thread,
        region: result.region.as_ref().map(region_cost_to_wire),
        ..wire::TileResult::default()
    };
    match &result.pixels {
        Pixels::Sums(p) => {
            assert_eq!(p.colour.len(), n, "colour has its tile's size");
            message.opacity = Some(opacity_to_wire(&p.a));
            message.colour = Some(plane::to_wire(n, |i| p.colour[i]));
            message.last_sheet = last_to_wire(&p.last, n);
        }
        Pixels::Finished(tile) => message.finished = Some(finished::to_wire(tile, compression)),
    }
    message
}

/// A result whose message has `bytes` bytes.
pub(super) fn result_from_wire(
    result: wire::TileResult,
    bytes: u32,
) -> Result<TileResult, WireError> {
    let n = result.pixels as usize;
    if n == 0 || n > MAX_TILE_PIXELS {
        return Err(WireError::value("pixels", format!("{n}; give 1 to {MAX_TILE_PIXELS}")));
    }
    let pixels = match result.finished {
        Some(finished) => {
            let leaves = finished::from_wire(finished).map_err(|e| e.within("finished"))?;
            if leaves.pixels() != n {
                return Err(WireError::length("pixels", n, leaves.pixels()));
            }
            Pixels::Finished(leaves)
        }
        None => Pixels::Sums(TilePixels {
            a: opacity_from_wire(result.opacity, n)?,
            colour: colour_from_wire(result.colour, n)?,
            last: last_from_wire(result.last_sheet, n)?,
        }),
    };
    Ok(TileResult {
        task: TaskId(result.task),
        epoch: Epoch(result.epoch),
        pixels,
        bytes: Some(bytes),
        counters: Counters {
            tossed: result.tossed,
            splatted: result.splatted,
            culled: result.culled,
        },
        times: TaskTimes {
            received_us: result.received_us,
            ready_us: result.ready_us,
            start_us: result.start_us,
            end_us: result.end_us,
            thread: result.thread,
        },
        region: result
            .region
            .map(|cost| region_cost_from_wire(cost).map_err(|e| e.within("region")))
            .transpose()?,
    })
}

fn region_cost_to_wire(cost: &RegionCost) -> wire::RegionCost {
    // Figures, not pixels: those beyond what fits are left out.
    let touched: Vec<BrickId> =
        cost.touched.iter().take(MAX_BRICK_LIST).map(|&place| BrickId(place)).collect();
    wire::RegionCost {
        touched: Some(brick_ids_to_wire(&touched)),
        stalls: cost.stalls,
        parked_us: cost.parked_us,
        idle_us: cost.idle_us,
        thickness: sampled_to_wire(cost.sampled.thickness),
        positions: sampled_to_wire(cost.sampled.positions),
        truncation: sampled_to_wire(cost.sampled.truncation),
        ripple: sampled_to_wire(cost.sampled.ripple),
    }
}

/// `None` where no pixel was sampled.
fn sampled_to_wire(s: SampledError) -> Option<wire::SampledError> {
    (s != SampledError::default())
        .then_some(wire::SampledError { pixels: s.pixels, squares: s.squares })
}

fn region_cost_from_wire(cost: wire::RegionCost) -> Result<RegionCost, WireError> {
    let touched = ascending_from_wire("touched", cost.touched)?;
    let touched = touched.into_iter().map(|id| id.0).collect();
    let wire::RegionCost { stalls, parked_us, idle_us, .. } = cost;
    let each = [cost.thickness, cost.positions, cost.truncation, cost.ripple];
    let sampled = ErrorsBySource::from_array(each.map(|s| {
        s.map_or_else(SampledError::default, |s| SampledError {
            pixels: s.pixels,
            squares: s.squares,
        })
    }));
    Ok(RegionCost { touched, stalls, parked_us, idle_us, sampled })
}

/// Checks that a result has its lease's size. A message alone can't tell; whoever knows the lease
/// MUST call this before the planes are put into a frame. Costs nothing.
///
/// # Errors
/// [`WireError`] names both sizes.
pub fn check_result(tile: Rect, result: &TileResult) -> Result<(), WireError> {
    let have = result.pixels.len();
    if have != tile.area() {
        return Err(WireError::length("result.pixels", have, tile.area()));
    }
    Ok(())
}
