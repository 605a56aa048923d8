//! Size of the tiles of a frame (`region` schedule): the one for which the cost model predicts the
//! earliest end, and the tiles that are split.
//!
//! Rendering takes no longer in tiles of 64 pixels than in larger ones, and a quarter longer in
//! smaller ones (`cost_history::SPLIT_TIME_RATIO`). Each tile costs its thread and the master a
//! message. So few large tiles are cheap, and many small ones leave no thread waiting.

use super::cost_history::{SPLIT_TIME_RATIO, ViewHistory, WHOLE_PX};
use super::cost_model::{CostModel, SWITCH_GAIN_RATIO, unknown_unit_us};
use super::macrotile::{Cut, Macrotile, Through};
use super::makespan::choose_splits;
use slabcast_common::occlusion::Rect;

/// Limit: tile edges that are considered, in pixels.
const EDGES_PX: [u32; 4] = [32, 64, 128, 256];

/// Tuning (pixels): largest tiles of workers on other machines. Where each of few tiles lacks
/// bricks, nothing is rendered until some arrive: one worker at 1 Gbit/s reaches 88 % of its speed
/// in tiles of 128 pixels (mri256 at 1024x1024) and 77 % in tiles of 256.
const MAX_REMOTE_TILE_PX: u32 = 128;

/// What is known before a frame is cut.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CutContext<'a> {
    pub(crate) costs: CostModel,
    pub(crate) history: &'a ViewHistory,
    /// Threads that render the frame.
    pub(crate) threads: usize,
    /// Tiles for each thread where bricks bind: a thread whose tile lacks bricks has others then.
    pub(crate) tiles_per_thread: f64,
    /// No other frame is in flight.
    pub(crate) sole: bool,
    /// Most threads are on the master's host.
    pub(crate) is_local: bool,
    /// Bricks are what such frames wait for: then all tiles have one size, since a worker that
    /// renders other tiles than before lacks bricks.
    pub(crate) bricks_bind: bool,
}

impl CutContext<'_> {
    /// Returns the rendering time of each tile in microseconds, by history or by estimate.
    pub(crate) fn times_us(&self, tiles: &[Macrotile]) -> Vec<f64> {
        let known: Vec<_> =
            tiles.iter().map(|t| self.history.cost(&t.rect).map(|c| c.us)).collect();
        let unit = unit_us(tiles, &known);
        tiles.iter().zip(known).map(|(t, us)| us.unwrap_or(t.est as f64 * unit)).collect()
    }

    /// Returns the rendering time of a unit of estimated workload.
    pub(crate) fn unit_us(&self, tiles: &[Macrotile]) -> f64 {
        let known: Vec<_> =
            tiles.iter().map(|t| self.history.cost(&t.rect).map(|c| c.us)).collect();
        unit_us(tiles, &known)
    }

    /// Whether more than half of these tiles were rendered before.
    fn knows_most_of(&self, tiles: &[Macrotile]) -> bool {
        let known = tiles.iter().filter(|t| self.history.cost(&t.rect).is_some()).count();
        2 * known > tiles.len()
    }

    /// Cuts a frame. `forced`: the tile edge that a user asked for.
    pub(crate) fn cut(&self, through: &Through, forced: Option<u32>) -> Cut {
        if let Some(edge) = forced {
            return through.cut(edge);
        }
        let whole = through.cut(WHOLE_PX);
        let knows_most = self.knows_most_of(&whole.tiles);
        let edge = match self.history.last_edge {
            // The first frame is being rendered.
            Some(edge) if !knows_most => edge,
            _ => self.choose_edge(through),
        };
        if !self.sole || self.bricks_bind || edge != WHOLE_PX || !knows_most {
            return through.cut(edge);
        }
        let fine = through.cut(WHOLE_PX / 2);
        let times = self.times_us(&whole.tiles);
        let parts = |i: usize| -> Vec<f64> {
            let tile = &whole.tiles[i];
            let parts = quarters(&tile.rect).into_iter().flatten();
            let share = |part: Rect| SPLIT_TIME_RATIO * times[i] * part.area() as f64;
            let time = |part: Rect| match self.history.cost(&part) {
                Some(cost) => cost.us,
                None => share(part) / tile.rect.area() as f64,
            };
            parts.filter(|part| fine.first_in(part).is_some()).map(time).collect()
        };
        let split = choose_splits(&self.costs, &times, parts, self.threads);
        through.mixed(&whole, &fine, &split)
    }

    /// Returns the edge in pixels for which the frame is predicted to end first.
    fn choose_edge(&self, through: &Through) -> u32 {
        let largest = match self.is_local {
            true => u32::MAX,
            // What the first frame is cut into the next ones go on with, and nothing is known yet.
            false if self.threads > 1 && self.history.is_empty() => WHOLE_PX,
            false => MAX_REMOTE_TILE_PX,
        };
        // Sole frames split single tiles instead.
        let finest = if self.sole && !self.bricks_bind { WHOLE_PX } else { EDGES_PX[0] };
        let least_tiles =
            if self.bricks_bind { self.tiles_per_thread * self.threads as f64 } else { 0.0 };
        let is_fine = |e: u32| e == finest || through.count(e) as f64 > least_tiles;
        let mut best: Option<(f64, u32)> = None;
        let mut last = None;
        let edges = EDGES_PX.into_iter().filter(|e| (finest..=largest).contains(e) && is_fine(*e));
        for edge in edges {
            let cut = through.cut(edge);
            let times = self.times_us(&cut.tiles);
            let end = if self.sole {
                self.costs.predict_end_us(&times, self.threads)
            } else {
                self.costs.predict_period_us(&times, self.threads)
            };
            if self.history.last_edge == Some(edge) {
                last = Some(end);
            }
            // Of equal ones the coarser: fewer messages.
            if best.is_none_or(|(least, _)| end <= least) {
                best = Some((end, edge));
            }
        }
        let (least, edge) = best.unwrap_or((0.0, WHOLE_PX));
        match (self.history.last_edge, last) {
            // Tiles of another size belong to other workers, which lack their bricks.
            (Some(kept), Some(last)) if least >= (1.0 - SWITCH_GAIN_RATIO) * last => kept,
            _ => edge,
        }
    }
}

/// Returns the rendering time of a unit of estimated workload, the mean of tiles with known times.
fn unit_us(tiles: &[Macrotile], known_us: &[Option<f64>]) -> f64 {
    let known = tiles.iter().zip(known_us).filter_map(|(t, us)| Some((t.est as f64, (*us)?)));
    let (units, us) = known.fold((0.0, 0.0), |(a, b), (units, us)| (a + units, b + us));
    if units > 0.0 && us > 0.0 { us / units } else { unknown_unit_us() }
}

/// Returns the parts of half of [`WHOLE_PX`] that a tile is split into; fewer at the border.
fn quarters(tile: &Rect) -> [Option<Rect>; 4] {
    let half = WHOLE_PX as i32 / 2;
    [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(x, y)| {
        let (x0, y0) = (tile.x0 + x * half, tile.y0 + y * half);
        let part = Rect::new(x0, y0, x0 + half, y0 + half).intersect(tile);
        Some(part).filter(|r| !r.is_empty())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::cost_history::CostHistory;
    use crate::policy::cost_model::TEST_COSTS;
    use slabcast_common::brick::BrickSetKey;
    use slabcast_common::ids::WorkerId;
    use slabcast_common::volume::Digest32;

    /// As a head lies in a picture: 24 tiles of 128 pixels, 56 of 64.
    fn edge(threads: usize, sole: bool, is_local: bool) -> u32 {
        let through = Through::new([512, 512], &[Rect::new(90, 40, 430, 480)]);
        let mut history = CostHistory::default();
        let history = history.view_mut((BrickSetKey(Digest32([0; 32])), [512, 512], None));
        let costs = TEST_COSTS;
        let bricks_bind = false;
        let tiles_per_thread = 2.5;
        let context =
            CutContext { costs, history, threads, tiles_per_thread, sole, is_local, bricks_bind };
        context.cut(&through, None).edge
    }

    #[test]
    fn tile_size_shrinks_with_threads_and_is_capped_for_remote_workers() {
        let remote = [1, 8, 64].map(|threads| edge(threads, false, false));
        assert!(
            remote[0] == MAX_REMOTE_TILE_PX && remote.is_sorted_by(|a, b| a >= b),
            "{remote:?}"
        );
        assert_eq!(edge(1, false, true), 256, "no brick is on its way on the master's host");
    }

    #[test]
    fn tile_size_of_a_sole_frame_leaves_no_worker_waiting() {
        assert_eq!(edge(1, true, false), MAX_REMOTE_TILE_PX);
        assert_eq!(edge(16, true, false), WHOLE_PX);
    }

    #[test]
    fn tile_size_stays_unless_another_wins_clearly() {
        let picture = |n: i32| {
            let tile = |i: i32| {
                Rect::new(64 * (i % 8), 64 * (i / 8), 64 * (i % 8) + 64, 64 * (i / 8) + 64)
            };
            Through::new([512, 512], &(0..n).map(tile).collect::<Vec<_>>())
        };
        let mut history = CostHistory::default();
        let key = (BrickSetKey(Digest32([0; 32])), [512, 512], None);
        for last in [32, 64] {
            history.view_mut(key).last_edge = Some(last);
            let history = history.view(key).expect("just made");
            let (costs, threads) = (TEST_COSTS, 21);
            let context = CutContext {
                costs,
                history,
                threads,
                tiles_per_thread: 2.5,
                sole: false,
                is_local: false,
                bricks_bind: false,
            };
            // 64 tiles of 64 pixels for 21 threads: 12.2 of four frames each.
            let chosen = context.cut(&picture(64), None).edge;
            assert!(chosen == last || chosen == 64, "{last}: {chosen}");
        }
        let _ = WorkerId(0);
    }
}
