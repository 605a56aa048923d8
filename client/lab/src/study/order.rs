//! Figure 1: are macrotiles that are estimated to be large the ones that take long?
//!
//! Of the first slab of three, in macrotiles of 64 pixels. The estimate is the scheduler's own (open
//! pixels under bricks, section 4.3); times are of tiles that were drawn here, one at a time; the
//! order in which they end is that of a simulated cluster of nine rendering nodes. Beside it, how
//! well the time of the same tile in the view before tells, which is what the `region` schedule
//! estimates by.

use super::paper;
use super::simulate::{Ask, Bed, Pace, Told};
use crate::statistics::spearman;
use serde::Serialize;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Schedule;
use slabcast_session::fail::Fail;

const EDGE: u32 = 64;

/// One macrotile of the first slab.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Tile {
    pub(super) x: u32,
    pub(super) y: u32,
    /// Place in the queue, from 1.
    pub(super) place: usize,
    /// Open pixels under bricks.
    pub(super) estimate: u64,
    /// Drawn here, on one core.
    pub(super) ms: f64,
    /// The same in the view before, where it was drawn.
    pub(super) before_ms: Option<f64>,
    /// Place in the order in which tiles ended, from 1: simulated.
    pub(super) ended: usize,
}

impl Tile {
    /// Whether bricks lie over all of it.
    pub(super) fn is_covered(&self) -> bool {
        self.estimate >= u64::from(EDGE * EDGE)
    }
}

/// Figure 1.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Order {
    /// Number of the view.
    pub(super) view: usize,
    pub(super) workers: u32,
    pub(super) tiles: Vec<Tile>,
    /// Tiles that bricks cover wholly.
    pub(super) covered: usize,
    /// Rank correlation (Spearman) of place and order of ending, in this view.
    pub(super) ended: f64,
    /// Of estimate and time: this view's tiles, those that are not wholly covered, and the mean over
    /// all views.
    pub(super) estimate: f64,
    pub(super) estimate_open: f64,
    pub(super) estimate_all_views: f64,
    /// Of the time in the view before and the time, mean over all views but the first.
    pub(super) learned_all_views: f64,
}

/// The first slab's tiles of a frame, in the order of the queue.
fn tiles(bed: &Bed, told: &[Told], frame: usize) -> Vec<Tile> {
    let size = bed.trace.about.size;
    let ms = |frame: usize, x: u32, y: u32| {
        let slab = bed.trace.frames.get(frame)?.slabs.first()?;
        let (x, y, edge) = (x as i32, y as i32, EDGE as i32);
        let rect = Rect::new(x, y, x + edge, y + edge).intersect(&Rect::from_size(size));
        slab.tile(&rect, size).map(|t| t.ns as f64 / 1e6)
    };
    let (stats, spans) = &told[frame];
    let Some(slab) = stats.slabs.first() else { return Vec::new() };
    let end = |x: u32, y: u32| {
        let name = format!("{x},{y}");
        let first = |s: &&slabcast_schedule::Span| {
            s.category == "tile" && s.name == name && s.args.contains(&("slab", "0".into()))
        };
        spans.iter().find(first).map(|s| s.end)
    };
    let mut ends: Vec<(u64, usize)> = Vec::new();
    let mut tiles: Vec<Tile> = Vec::new();
    for (i, t) in slab.tiles.iter().enumerate() {
        let Some(took) = ms(frame, t.x, t.y) else { continue };
        ends.push((end(t.x, t.y).unwrap_or(u64::MAX), tiles.len()));
        let before_ms = frame.checked_sub(1).and_then(|before| ms(before, t.x, t.y));
        let (place, ended) = (i + 1, 0);
        tiles.push(Tile { x: t.x, y: t.y, place, estimate: t.est, ms: took, before_ms, ended });
    }
    ends.sort_unstable();
    for (n, (_, i)) in ends.iter().enumerate() {
        tiles[*i].ended = n + 1;
    }
    tiles
}

/// Finds it out; `None` where no view has three tiles.
pub(super) fn find(bed: &Bed) -> Result<Option<Order>, Fail> {
    let workers = paper::FIGURE_1_WORKERS;
    let ask = Ask { tile: Some(EDGE), ..Ask::of(Schedule::Slab, workers, Pace::Paper) };
    let told = bed.run(&ask)?;
    let each: Vec<Vec<Tile>> = (0..told.len()).map(|i| tiles(bed, &told, i)).collect();
    let of = |tiles: &[Tile]| {
        spearman(&tiles.iter().map(|t| (t.estimate as f64, t.ms)).collect::<Vec<_>>())
    };
    let mean = |all: Vec<f64>| {
        let n = all.len().max(1) as f64;
        all.iter().sum::<f64>() / n
    };
    let view = told.len() / 2;
    let Some(tiles) = each.get(view).filter(|t| t.len() >= 3).cloned() else { return Ok(None) };
    let open: Vec<Tile> = tiles.iter().filter(|t| !t.is_covered()).copied().collect();
    let ended: Vec<(f64, f64)> = tiles.iter().map(|t| (t.place as f64, t.ended as f64)).collect();
    let learned = |tiles: &Vec<Tile>| {
        let known = tiles.iter().filter_map(|t| Some((t.before_ms?, t.ms)));
        spearman(&known.collect::<Vec<_>>())
    };
    Ok(Some(Order {
        view,
        workers,
        covered: tiles.len() - open.len(),
        ended: spearman(&ended).unwrap_or(0.0),
        estimate: of(&tiles).unwrap_or(0.0),
        estimate_open: of(&open).unwrap_or(0.0),
        estimate_all_views: mean(each.iter().filter_map(|t| of(t)).collect()),
        learned_all_views: mean(each.iter().skip(1).filter_map(learned).collect()),
        tiles,
    }))
}
