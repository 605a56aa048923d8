//! Prices in microseconds, and the one prediction of when a frame ends under a given cut and
//! assignment. Every decision about a frame asks here: tile size, splits, moves between workers,
//! number of active workers, lending ahead, work stealing.
//!
//! Three inputs are measured: tile times (`cost_history`), the link's rate (`link_use`) and the
//! round trip (`state::workers`). The constants are what messages take on the machines that were
//! measured.

use crate::policy::link_use::LinkUse;
use crate::state::workers::Roster;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Tuning (us): thread time of a tile beyond rendering: a result, a lease, waking. At nothing or at
/// 100, sole frames of mri256 change by their noise.
const TILE_THREAD_US: f64 = 40.0;

/// Tuning (us): [`TILE_THREAD_US`] of a worker on the master's host, where the master's part of
/// each message takes the same cores. Two processes of a thread each on two cores take 12.9 ms a
/// frame of mri256 in tiles of 256 pixels, and 15.1 in tiles of 64.
const LOCAL_TILE_THREAD_US: f64 = 150.0;

/// Tuning (us): time of the master for a tile, which takes one result after the other. At nothing,
/// mri256 `peer-semi` on 64 workers loses 5 % to tiles that are too small.
const TILE_MASTER_US: f64 = 10.0;

/// Tuning (us): price of moving a brick to another worker, beside its time on the link: the
/// master's and the worker's handling, spread over the frames that profit.
const BRICK_US: f64 = 3.0;

/// Tuning (ratio): a change of plan has to save this part of a frame, since predictions are no
/// better.
pub(crate) const WORTHWHILE_RATIO: f64 = 0.01;

/// Tuning (ratio): a change that has every worker sent bricks anew (tile size, active workers) has
/// to save this part of a frame.
pub(crate) const SWITCH_GAIN_RATIO: f64 = 0.1;

/// Prices for one frame.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct CostModel {
    /// Thread time of a tile beyond rendering.
    pub(crate) tile_us: f64,
    /// Time of an encoded byte on the link; 0 while its rate is unknown.
    pub(crate) byte_us: f64,
    /// A message to a worker and its answer.
    pub(crate) round_trip_us: f64,
}

impl CostModel {
    /// Prices by what is measured so far.
    pub(crate) fn new(link_use: &LinkUse, roster: &Roster) -> CostModel {
        CostModel {
            tile_us: if roster.is_mostly_local() { LOCAL_TILE_THREAD_US } else { TILE_THREAD_US },
            byte_us: link_use.rate().map_or(0.0, f64::recip),
            round_trip_us: roster.round_trip_us(),
        }
    }

    /// Price of moving a brick of so many bytes to another worker.
    pub(crate) fn brick_us(&self, bytes: f64) -> f64 {
        BRICK_US + self.byte_us * bytes
    }

    /// Rendering time that is lent to a thread in one go: so much that its messages take no more
    /// than [`WORTHWHILE_RATIO`] of it, and that it lasts for a round trip.
    pub(crate) fn lend_ahead_us(&self) -> f64 {
        TILE_THREAD_US / WORTHWHILE_RATIO + self.round_trip_us
    }

    /// Predicts when a frame ends whose tiles take so many microseconds each, if each thread that
    /// is free takes the longest tile left (LPT rule). No tile takes what is predicted, so half a
    /// tile is added.
    pub(crate) fn predict_end_us(&self, tiles_us: &[f64], threads: usize) -> f64 {
        let mut items: Vec<u64> = tiles_us.iter().map(|us| self.item(*us)).collect();
        let mean = tiles_us.iter().sum::<f64>() / tiles_us.len().max(1) as f64;
        let half_a_tile = if threads > 1 { 0.5 * mean } else { 0.0 };
        predict_end(&mut items, threads) + half_a_tile
    }

    /// Predicts the time from one frame's end to the next's while several overlap. Owners stay from
    /// frame to frame, so it is the makespan of one frame, or the master's time.
    pub(crate) fn predict_period_us(&self, tiles_us: &[f64], threads: usize) -> f64 {
        let mut items: Vec<u64> = tiles_us.iter().map(|us| self.item(*us)).collect();
        let master_us = self.master_us(items.len());
        (predict_end(&mut items, threads) - master_us).max(master_us)
    }

    /// Returns a time in microseconds before which neither a frame nor its period ends, for so many
    /// tiles that take `work_us` together: threads that never wait, or the master's time.
    pub(crate) fn soonest_us(&self, work_us: f64, tiles: usize, threads: usize) -> f64 {
        let shared = (work_us + self.tile_us * tiles as f64) / threads.max(1) as f64;
        shared.max(self.master_us(tiles))
    }

    /// Time that so many tiles take the master.
    pub(crate) fn master_us(&self, tiles: usize) -> f64 {
        TILE_MASTER_US * tiles as f64
    }

    /// Returns the time that a thread spends on a tile of `us` microseconds, in sixteenths of a
    /// microsecond: integers sort in a third of the time.
    pub(crate) fn item(&self, us: f64) -> u64 {
        (16.0 * (us + self.tile_us)) as u64
    }
}

/// Microseconds that a unit of estimated workload (a covered pixel) takes, while nothing is known:
/// its messages are a tenth of what a tile of 64x64 pixels takes.
pub(crate) fn unknown_unit_us() -> f64 {
    TILE_THREAD_US / SWITCH_GAIN_RATIO / (64.0 * 64.0)
}

/// Shortest tile in microseconds whose time tells of its worker and not of its messages.
pub(crate) fn shortest_telling_tile_us() -> f64 {
    TILE_THREAD_US / SWITCH_GAIN_RATIO
}

/// Predicts the end of a frame in microseconds, for tiles as [`CostModel::item`] has them: when the
/// last thread is done if each that is free takes the longest tile left, and the master's time for
/// all tiles.
pub(crate) fn predict_end(items: &mut [u64], threads: usize) -> f64 {
    items.sort_unstable();
    let mut free: BinaryHeap<Reverse<u64>> = (0..threads).map(|_| Reverse(0)).collect();
    let mut last = 0;
    for item in items.iter().rev() {
        let Some(mut first) = free.peek_mut() else { break };
        first.0 += item;
        last = last.max(first.0);
    }
    last as f64 / 16.0 + TILE_MASTER_US * items.len() as f64
}

#[cfg(test)]
pub(crate) const TEST_COSTS: CostModel =
    CostModel { tile_us: TILE_THREAD_US, byte_us: 0.0, round_trip_us: 0.0 };

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn predict_end_is_the_makespan_of_the_longest_first_rule() {
        let end = TEST_COSTS.predict_end_us(&[5000.0, 3000.0, 3000.0, 1000.0], 2);
        // 5000 + 1000 and 3000 + 3000, half a tile, the price of two tiles each and of four at the
        // master.
        let price = 2.0 * TILE_THREAD_US + 4.0 * TILE_MASTER_US;
        assert!((end - (6000.0 + 1500.0 + price)).abs() < 1.0, "{end}");
        assert!(TEST_COSTS.predict_end_us(&[], 2) < 1e-9);
    }

    #[test]
    fn predict_period_counts_a_tile_too_many_or_the_masters_time() {
        let period = |tiles: usize, threads| {
            let tiles = vec![64_000.0 / tiles as f64; tiles];
            TEST_COSTS.predict_period_us(&tiles, threads)
        };
        assert!(period(32, 16) < period(33, 16), "one thread has a tile more");
        assert!(
            (period(640, 1000) - 640.0 * TILE_MASTER_US).abs() < 1.0,
            "the master's time binds"
        );
    }
}
