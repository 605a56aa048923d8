//! Checks of what workers say about a task, before the scheduler believes it.
//!
//! Each check returns what is wrong, in one line; the worker that said it is dropped with it.

use slabcast_common::image::{PixelEncoding, SparseTile, TilePixels};
use slabcast_common::message::RegionCost;
use slabcast_common::occlusion::Rect;

/// Checks a peer's figures of a region.
pub(crate) fn check_cost(
    cost: Option<&RegionCost>,
    tile: Rect,
    bricks: usize,
) -> Result<(), String> {
    let Some(cost) = cost else { return Ok(()) };
    let sampled = cost.sampled.to_array().map(|s| s.pixels).into_iter().max().unwrap_or(0);
    if sampled as usize > tile.area() {
        let area = tile.area();
        return Err(format!("a result sampled {sampled} pixels of a tile of {area}"));
    }
    match cost.touched.iter().max().filter(|&&i| i as usize >= bricks) {
        Some(i) => Err(format!("a result touched brick {i} of {bricks}")),
        None => Ok(()),
    }
}

/// Checks that a peer's finished pixels are those of a tile.
pub(crate) fn check_leaves(
    tile: Rect,
    leaves: &SparseTile,
    finish: Option<PixelEncoding>,
) -> Result<(), String> {
    let Some(finish) = finish else {
        return Err("a result is finished where sums were asked for".into());
    };
    if leaves.format != finish.format {
        return Err(format!("a result in {:?}, its frame in {:?}", leaves.format, finish.format));
    }
    let [w, h] = leaves.size;
    if [w as usize, h as usize] != [tile.width(), tile.height()] {
        return Err(format!(
            "a result of {w}x{h} pixels, its tile has {}x{}",
            tile.width(),
            tile.height()
        ));
    }
    // In one sentence, whatever it is: a record says no more either.
    leaves.check().map_err(|_| "a result's leaves do not fit each other".into())
}

/// Checks that a peer's sums are those of a tile.
pub(crate) fn check_sums(
    tile: Rect,
    pixels: &TilePixels,
    finish: Option<PixelEncoding>,
) -> Result<(), String> {
    if finish.is_some() {
        return Err("a result has sums where finished pixels were asked for".into());
    }
    let n = tile.area();
    let plane = |name: &str, len: usize| {
        if len == n {
            Ok(())
        } else {
            Err(format!("a result's {name} plane has {len} pixels, its tile {n}"))
        }
    };
    plane("a", pixels.a.len())?;
    plane("colour", pixels.colour.len())?;
    if let Some(last) = &pixels.last {
        plane("last", last.len())?;
    }
    if !pixels.a.iter().all(|a| a.is_finite()) {
        return Err("a result's a plane has a number that is not finite".into());
    }
    Ok(())
}
