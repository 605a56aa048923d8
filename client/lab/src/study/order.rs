//! Figure 1: are macrotiles that are estimated to be large the ones that take long?
//!
//! Takes the first slab of three, in macrotiles of 64 pixels. The estimate is the scheduler's own
//! (open pixels under bricks, section 4.3). Tiles are timed here, one at a time. The order in which
//! they end is that of a simulated cluster of nine rendering nodes. For comparison, the correlation
//! with the time of the same tile in the view before, by which the `region` schedule estimates.

use super::paper;
use super::simulate::{FrameReport, MeasuredPath, Pace, SimulatedCluster};
use crate::statistics::spearman;
use serde::Serialize;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Schedule;
use slabcast_session::fail::Fail;

/// Edge of the macrotiles in pixels.
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
    /// Time on one core here, in ms.
    pub(super) ms: f64,
    /// Time in the view before, in ms; `None` if it was not drawn there.
    pub(super) before_ms: Option<f64>,
    /// Place in the simulated order of ending, from 1.
    pub(super) ended: usize,
}

impl Tile {
    /// Returns whether bricks cover the whole tile.
    pub(super) fn is_covered(&self) -> bool {
        self.estimate >= u64::from(EDGE * EDGE)
    }
}

/// Data of Figure 1.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Order {
    /// Index of the view.
    pub(super) view: usize,
    pub(super) workers: u32,
    pub(super) tiles: Vec<Tile>,
    /// Number of tiles that bricks cover wholly.
    pub(super) covered: usize,
    /// Rank correlation (Spearman) of place and order of ending, in this view.
    pub(super) ended: f64,
    /// Rank correlation of estimate and time over the tiles of this view.
    pub(super) estimate: f64,
    /// Rank correlation of estimate and time over tiles that are not wholly covered.
    pub(super) estimate_open: f64,
    /// Rank correlation of estimate and time, mean over all views.
    pub(super) estimate_all_views: f64,
    /// Rank correlation of the times in a view and the view before, mean over all but the first.
    pub(super) learned_all_views: f64,
}

/// Returns the tiles of the first slab of a frame, in the order of the queue.
fn tiles(measured_path: &MeasuredPath, reports: &[FrameReport], frame: usize) -> Vec<Tile> {
    let size = measured_path.trace.about.size;
    let ms = |frame: usize, x: u32, y: u32| {
        let slab = measured_path.trace.frames.get(frame)?.slabs.first()?;
        let (x, y, edge) = (x as i32, y as i32, EDGE as i32);
        let rect = Rect::new(x, y, x + edge, y + edge).intersect(&Rect::from_size(size));
        slab.tile(&rect, size).map(|t| t.ns as f64 / 1e6)
    };
    let (stats, spans) = &reports[frame];
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

/// Simulates and correlates; `None` if the middle view has fewer than three tiles.
pub(super) fn find(measured_path: &MeasuredPath) -> Result<Option<Order>, Fail> {
    let workers = paper::FIGURE_1_WORKERS;
    let cluster = SimulatedCluster {
        tile: Some(EDGE),
        ..SimulatedCluster::new(Schedule::Slab, workers, Pace::Paper)
    };
    let reports = measured_path.run(&cluster)?;
    let each: Vec<Vec<Tile>> =
        (0..reports.len()).map(|i| tiles(measured_path, &reports, i)).collect();
    let correlation = |tiles: &[Tile]| {
        spearman(&tiles.iter().map(|t| (t.estimate as f64, t.ms)).collect::<Vec<_>>())
    };
    let mean = |all: Vec<f64>| {
        let n = all.len().max(1) as f64;
        all.iter().sum::<f64>() / n
    };
    let view = reports.len() / 2;
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
        estimate: correlation(&tiles).unwrap_or(0.0),
        estimate_open: correlation(&open).unwrap_or(0.0),
        estimate_all_views: mean(each.iter().filter_map(|t| correlation(t)).collect()),
        learned_all_views: mean(each.iter().skip(1).filter_map(learned).collect()),
        tiles,
    }))
}
