//! Size of the tiles of a frame (`region` schedule): the one for which the cost model predicts the
//! earliest end, and the tiles that are split.
//!
//! Rendering takes no longer in tiles of 64 pixels than in larger ones, and a quarter longer in
//! smaller ones (`cost_history::SPLIT_TIME_RATIO`). Each tile costs its thread and the master a
//! message. So few large tiles are cheap, and many small ones leave no thread waiting.

use super::cost_history::{SPLIT_TIME_RATIO, TileCost, ViewHistory, WHOLE_PX, edge_time_ratio};
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

/// Facts by which a frame is cut into tiles.
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
    /// Looks up what is known of the tiles of a cut.
    fn price(&self, cut: Cut) -> PricedCut {
        let costs: Vec<_> = cut.tiles.iter().map(|t| self.history.cost(&t.rect)).collect();
        let unit_us = unit_us(&cut.tiles, &costs);
        PricedCut { cut, costs, unit_us }
    }

    /// Cuts a frame. `forced`: the tile edge that a user asked for.
    pub(crate) fn cut(&self, through: &Through, forced: Option<u32>) -> PricedCut {
        let priced = |edge: u32| self.price(through.cut(edge));
        if let Some(edge) = forced {
            return priced(edge);
        }
        let known = self.history.known_leaves(through.leaves());
        let knows_most = 2 * known.rendered > known.all;
        let whole = match self.history.last_edge {
            // The first frame is being rendered.
            Some(edge) if !knows_most => priced(edge),
            _ => self.choose_edge(through, known.us),
        };
        if !self.sole || self.bricks_bind || whole.cut.edge != WHOLE_PX || !knows_most {
            return whole;
        }
        let us = whole.us();
        let parts = |i: usize| -> Vec<f64> {
            let tile = &whole.cut.tiles[i].rect;
            let share = |part: &Rect| part.area() as f64 / tile.area() as f64;
            let guess = |part: &Rect| SPLIT_TIME_RATIO * us[i] * share(part);
            let time = |part: &Rect| self.history.us(part).unwrap_or_else(|| guess(part));
            through.quarters(tile, WHOLE_PX / 2).map(|part| time(&part.rect)).collect()
        };
        let split = choose_splits(&self.costs, &us, parts, self.threads);
        if !split.contains(&true) {
            return whole;
        }
        self.price(through.mixed(whole.cut, &split))
    }

    /// Returns the tiles of the size for which the frame is predicted to end first. `known_us`:
    /// time of all leaves that were rendered before, in microseconds.
    fn choose_edge(&self, through: &Through, known_us: f64) -> PricedCut {
        let largest = match self.is_local {
            true => u32::MAX,
            // The first frame has no history, and the next frames keep its tiles.
            false if self.threads > 1 && self.history.is_empty() => WHOLE_PX,
            false => MAX_REMOTE_TILE_PX,
        };
        // Sole frames split single tiles instead.
        let finest = if self.sole && !self.bricks_bind { WHOLE_PX } else { EDGES_PX[0] };
        let least_tiles =
            if self.bricks_bind { self.tiles_per_thread * self.threads as f64 } else { 0.0 };
        let is_fine = |e: u32| e == finest || through.count(e) as f64 > least_tiles;
        let may = |edge: u32| (finest..=largest).contains(&edge) && is_fine(edge);
        // Tiles of another size belong to other workers, which lack their bricks. So the size stays
        // unless another ends clearly earlier.
        let last = self.history.last_edge.filter(|edge| may(*edge));
        let mut best = last.map(|edge| {
            let kept = self.price(through.cut(edge));
            ((1.0 - SWITCH_GAIN_RATIO) * self.end_us(&kept), kept)
        });
        for edge in EDGES_PX.into_iter().filter(|edge| may(*edge) && last != Some(*edge)) {
            // Most sizes can't end early enough, and need not be looked at closer.
            let work_us = edge_time_ratio(edge) * known_us;
            let soonest = self.costs.soonest_us(work_us, through.count(edge), self.threads);
            if best.as_ref().is_some_and(|(least, _)| soonest > *least) {
                continue;
            }
            let cut = self.price(through.cut(edge));
            let end = self.end_us(&cut);
            let is_better = |(least, kept): &(f64, PricedCut)| {
                // Among equal cuts the coarser one wins: it has fewer messages.
                end < *least || end <= *least && last != Some(kept.cut.edge)
            };
            if best.as_ref().is_none_or(is_better) {
                best = Some((end, cut));
            }
        }
        best.map_or_else(|| self.price(through.cut(WHOLE_PX)), |(_, cut)| cut)
    }

    /// Predicts the end of a sole frame, or the period of overlapping ones, in microseconds.
    fn end_us(&self, cut: &PricedCut) -> f64 {
        match self.sole {
            true => self.costs.predict_end_us(&cut.us(), self.threads),
            false => self.costs.predict_period_us(&cut.us(), self.threads),
        }
    }
}

/// Tiles with what is known of them.
pub(crate) struct PricedCut {
    pub(crate) cut: Cut,
    /// Rendering time and owner of each tile in earlier frames; `None`: never rendered.
    pub(crate) costs: Vec<Option<TileCost>>,
    /// Rendering time of a unit of estimated workload in microseconds.
    pub(crate) unit_us: f64,
}

impl PricedCut {
    /// Returns the rendering time of each tile in microseconds, by history or by estimate.
    fn us(&self) -> Vec<f64> {
        let us = |(tile, cost): (&Macrotile, &Option<TileCost>)| {
            cost.map_or(tile.est as f64 * self.unit_us, |cost| cost.us)
        };
        self.cut.tiles.iter().zip(&self.costs).map(us).collect()
    }

    /// Turns estimates into predicted times, in the units of those that are guessed, and sorts the
    /// tiles by them, longest first.
    pub(crate) fn sort_by_time(&mut self) {
        let us = self.us();
        let tiles = self.cut.tiles.iter().zip(us).zip(&self.costs);
        let mut tiles: Vec<(Macrotile, Option<TileCost>)> = tiles
            .map(|((tile, us), cost)| {
                let est = ((us / self.unit_us) as u64).max(1);
                (Macrotile { est, ..*tile }, *cost)
            })
            .collect();
        tiles.sort_by_key(|(tile, _)| std::cmp::Reverse(tile.est));
        (self.cut.tiles, self.costs) = tiles.into_iter().unzip();
    }
}

/// Returns the rendering time of a unit of estimated workload, the mean of tiles with known times.
fn unit_us(tiles: &[Macrotile], costs: &[Option<TileCost>]) -> f64 {
    let known = tiles.iter().zip(costs).filter_map(|(t, cost)| Some((t.est as f64, (*cost)?.us)));
    let (units, us) = known.fold((0.0, 0.0), |(a, b), (units, us)| (a + units, b + us));
    if units > 0.0 && us > 0.0 { us / units } else { unknown_unit_us() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::cost_history::CostHistory;
    use crate::policy::cost_model::TEST_COSTS;
    use slabcast_common::brick::BrickSetKey;
    use slabcast_common::ids::WorkerId;
    use slabcast_common::volume::Digest32;

    /// Returns the edge of tiles for a picture of a head: 24 tiles of 128 pixels, 56 of 64.
    fn edge(threads: usize, sole: bool, is_local: bool) -> u32 {
        let through = Through::new([512, 512], &[Rect::new(90, 40, 430, 480)]);
        let mut history = CostHistory::default();
        let history = history.view_mut((BrickSetKey(Digest32([0; 32])), [512, 512], None));
        let costs = TEST_COSTS;
        let bricks_bind = false;
        let tiles_per_thread = 2.5;
        let context =
            CutContext { costs, history, threads, tiles_per_thread, sole, is_local, bricks_bind };
        context.cut(&through, None).cut.edge
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
            let chosen = context.cut(&picture(64), None).cut.edge;
            assert!(chosen == last || chosen == 64, "{last}: {chosen}");
        }
        let _ = WorkerId(0);
    }
}
