//! Assignment of a frame's tiles to workers (`region` schedule).
//!
//! In the first frame each worker gets a band of rows: bricks at a border are sent to both sides,
//! and when a path turns about the upright axis, bricks stay in their rows. From then on a tile
//! stays with the owner of the frame before, which holds its bricks, unless the frame is predicted
//! to end earlier otherwise by more than its bricks cost ([`rebalance`]).

use super::cost_history::{TileCost, WorkerRates, believed_ratio};
use super::cost_model::SWITCH_GAIN_RATIO;
use super::macrotile::Macrotile;
use super::makespan::rebalance;
use crate::state::workers::Roster;
use slabcast_common::ids::WorkerId;

/// A tile to assign.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TileToAssign {
    /// Predicted rendering time in microseconds, by the worker that rendered it last.
    pub(crate) us: f64,
    /// Rendering time and owner of the same pixels in earlier frames; `None`: never rendered.
    pub(crate) cost: Option<TileCost>,
    /// Worker that owned the tile in the frame before.
    pub(crate) owner: Option<WorkerId>,
    /// Time to send the tile's bricks to another worker, in microseconds.
    pub(crate) price_us: f64,
}

/// The workers that draw a frame.
pub(crate) struct Group {
    ids: Vec<WorkerId>,
    threads: Vec<f64>,
}

impl Group {
    /// Makes a group of these workers, ascending by id, with the threads of each.
    pub(crate) fn new(members: impl Iterator<Item = (WorkerId, u64)>) -> Group {
        let (ids, threads) = members.map(|(id, threads)| (id, threads as f64)).unzip();
        Group { ids, threads }
    }

    /// Returns the number of threads.
    pub(crate) fn threads(&self) -> u64 {
        self.threads.iter().sum::<f64>() as u64
    }

    /// Whether there is more than one worker.
    pub(crate) fn has_several(&self) -> bool {
        self.ids.len() > 1
    }

    /// Returns the index of a worker. One in reserve is replaced by its neighbour.
    fn index_of(&self, id: WorkerId, roster: &Roster) -> Option<usize> {
        match self.ids.binary_search(&id) {
            Ok(index) => Some(index),
            Err(index) => roster.has_in_reserve(id).then(|| index.saturating_sub(1)),
        }
    }

    /// Assigns an owner to each tile.
    ///
    /// `tiles` and `places` are indexed alike; `places` has their rectangles and estimates.
    /// `slack`: part of the mean by which a worker may end late before tiles move; `None`: none
    /// moves.
    pub(crate) fn assign(
        &self,
        places: &[Macrotile],
        tiles: &[TileToAssign],
        rates: &WorkerRates,
        roster: &Roster,
        slack: Option<f64>,
    ) -> Vec<WorkerId> {
        if self.ids.is_empty() {
            return vec![WorkerId(0); tiles.len()];
        }
        let times = Times::new(self, tiles, rates);
        let cost = |i: usize, w: usize| times.us(i, w);
        let mut held: Vec<Option<usize>> =
            tiles.iter().map(|t| self.index_of(t.owner?, roster)).collect();
        // In the order of rows.
        let mut order: Vec<usize> = (0..tiles.len()).collect();
        order.sort_by_key(|&i| (places[i].rect.y0, places[i].rect.x0));
        if held.iter().all(Option::is_none) {
            self.assign_bands(&order, tiles, rates, &mut held);
        }
        let mut load = vec![0.0; self.ids.len()];
        let mut owners: Vec<usize> = held.iter().map(|w| w.unwrap_or(0)).collect();
        for (i, owner) in held.iter().enumerate() {
            if let Some(w) = owner {
                load[*w] += cost(i, *w);
            }
        }
        for &i in order.iter().filter(|&&i| held[i].is_none()) {
            let end = |w: &usize| load[*w] + cost(i, *w);
            let first = (0..load.len()).min_by(|a, b| end(a).total_cmp(&end(b)));
            owners[i] = first.unwrap_or(0);
            load[owners[i]] += cost(i, owners[i]);
        }
        if let Some(slack) = slack {
            let price = |i: usize, w: usize| {
                if held[i].is_none_or(|h| h == w) { 0.0 } else { tiles[i].price_us }
            };
            rebalance(&mut owners, self.ids.len(), slack, cost, price);
            // Moves and swaps of single tiles get stuck where tiles of two sizes mix. Then all are
            // dealt anew, the longest first.
            let takes = |i: usize, w: usize| cost(i, w) + price(i, w);
            let wanted_us = (1.0 - SWITCH_GAIN_RATIO) * self.end_us(&owners, takes);
            if times.soonest_us() < wanted_us {
                let mut dealt = self.deal(tiles, takes);
                rebalance(&mut dealt, self.ids.len(), slack, cost, price);
                if self.end_us(&dealt, takes) < wanted_us {
                    owners = dealt;
                }
            }
        }
        owners.into_iter().map(|w| self.ids[w]).collect()
    }

    /// Gives each tile, the longest first, to the worker that is done with it first.
    fn deal(&self, tiles: &[TileToAssign], takes: impl Fn(usize, usize) -> f64) -> Vec<usize> {
        let mut order: Vec<usize> = (0..tiles.len()).collect();
        order.sort_by(|&a, &b| tiles[b].us.total_cmp(&tiles[a].us));
        let mut load = vec![0.0; self.ids.len()];
        let mut owners = vec![0; tiles.len()];
        for i in order {
            let end = |w: &usize| load[*w] + takes(i, *w);
            let first = (0..load.len()).min_by(|a, b| end(a).total_cmp(&end(b))).unwrap_or(0);
            load[first] += takes(i, first);
            owners[i] = first;
        }
        owners
    }

    /// Returns when the last worker is done.
    fn end_us(&self, owners: &[usize], takes: impl Fn(usize, usize) -> f64) -> f64 {
        let mut load = vec![0.0; self.ids.len()];
        for (i, &w) in owners.iter().enumerate() {
            load[w] += takes(i, w);
        }
        load.into_iter().fold(0.0, f64::max)
    }

    /// Assigns bands of rows, as high as each worker is fast.
    fn assign_bands(
        &self,
        order: &[usize],
        tiles: &[TileToAssign],
        rates: &WorkerRates,
        owners: &mut [Option<usize>],
    ) {
        let speed = |w: usize| self.threads[w] / rates.ratio(self.ids[w], self.ids[0]);
        let all: f64 = (0..self.ids.len()).map(speed).sum();
        let work: f64 = tiles.iter().map(|t| t.us).sum();
        let (mut w, mut until, mut done) = (0, speed(0) / all * work, 0.0);
        for &i in order {
            let half = 0.5 * tiles[i].us;
            while done + half > until && w + 1 < self.ids.len() {
                w += 1;
                until += speed(w) / all * work;
            }
            done += 2.0 * half;
            owners[i] = Some(w);
        }
    }
}

/// Times that tiles take the workers of a group.
struct Times<'a> {
    tiles: &'a [TileToAssign],
    threads: &'a [f64],
    /// Slowness of each worker relative to the others, looked up once, since a search needs it
    /// thousands of times.
    slowness: Vec<f64>,
    last_slowness: Vec<Option<f64>>,
    /// No worker counts as slower than another.
    are_alike: bool,
}

impl<'a> Times<'a> {
    fn new(group: &'a Group, tiles: &'a [TileToAssign], rates: &WorkerRates) -> Times<'a> {
        let last = |t: &TileToAssign| t.cost.map(|c| rates.slowness(c.owner));
        let slowness: Vec<f64> = group.ids.iter().map(|id| rates.slowness(*id)).collect();
        let last_slowness: Vec<_> = tiles.iter().map(last).collect();
        let all = || slowness.iter().chain(last_slowness.iter().flatten()).copied();
        let (least, most) = (all().fold(f64::INFINITY, f64::min), all().fold(0.0, f64::max));
        let are_alike = believed_ratio(most / least) <= 1.0;
        Times { tiles, threads: &group.threads, slowness, last_slowness, are_alike }
    }

    /// Returns how many microseconds a worker is busy with a tile.
    fn us(&self, tile: usize, worker: usize) -> f64 {
        let us = self.tiles[tile].us / self.threads[worker];
        match self.last_slowness[tile].filter(|_| !self.are_alike) {
            Some(last) => us * believed_ratio(self.slowness[worker] / last),
            None => us,
        }
    }

    /// Returns a time in microseconds before which no assignment ends: all threads are as fast as
    /// the fastest and none waits, or the longest tile alone.
    fn soonest_us(&self) -> f64 {
        let fastest = self.slowness.iter().copied().fold(f64::INFINITY, f64::min);
        let threads: f64 = self.threads.iter().sum();
        let most = self.threads.iter().copied().fold(0.0, f64::max);
        let (mut all, mut longest) = (0.0, 0.0_f64);
        for (tile, last) in self.tiles.iter().zip(&self.last_slowness) {
            let us = tile.us * last.map_or(1.0, |last| believed_ratio(fastest / last));
            all += us;
            longest = longest.max(us);
        }
        (all / threads).max(longest / most)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::occlusion::Rect;

    fn places(n: i32) -> Vec<Macrotile> {
        let rect = |i| Rect::new(64 * i, 0, 64 * i + 64, 64);
        (0..n).map(|i| Macrotile { rect: rect(i), est: 4096 }).collect()
    }

    fn group(threads: &[u64]) -> Group {
        Group::new((1..).map(WorkerId).zip(threads.iter().copied()))
    }

    /// Assigns tiles that their owners rendered in so many microseconds each, at a price of bricks.
    fn assign(group: &Group, tiles: &[(Option<u64>, f64)], price_us: f64) -> Vec<u64> {
        let tile = |&(owner, us): &(Option<u64>, f64)| {
            let owner = owner.map(WorkerId);
            let cost = owner.map(|owner| TileCost { owner, us });
            TileToAssign { us, cost, owner, price_us }
        };
        let tiles: Vec<_> = tiles.iter().map(tile).collect();
        let rates = WorkerRates::default();
        let places = places(tiles.len() as i32);
        let owners = group.assign(&places, &tiles, &rates, &Roster::default(), Some(0.01));
        owners.into_iter().map(|id| id.0).collect()
    }

    fn shares(owners: &[u64]) -> Vec<usize> {
        (1..=3).map(|w| owners.iter().filter(|o| **o == w).count()).collect()
    }

    #[test]
    fn assign_gives_bands_by_threads_first_and_keeps_owners_later() {
        let group = group(&[1, 2, 3]);
        let owners = assign(&group, &[(None, 1000.0); 24], 0.0);
        assert_eq!(shares(&owners), [4, 8, 12]);
        assert!(owners.is_sorted(), "in bands");
        let again: Vec<_> = owners.iter().map(|o| (Some(*o), 1000.0)).collect();
        assert_eq!(assign(&group, &again, 0.0), owners);
    }

    #[test]
    fn assign_moves_a_tile_only_if_that_pays_for_its_bricks() {
        let group = group(&[1, 1]);
        // Seven tiles of 1 ms against five.
        let tiles: Vec<_> = (0..12).map(|i| (Some(if i < 7 { 1 } else { 2 }), 1000.0)).collect();
        let moved = |price| shares(&assign(&group, &tiles, price))[0];
        assert_eq!([moved(0.0), moved(500.0), moved(1200.0)], [6, 6, 7]);
    }

    #[test]
    fn assign_replaces_an_owner_that_is_gone_and_gives_newcomers_a_share() {
        let group = group(&[1, 1, 1]);
        let tiles: Vec<_> = (0..30).map(|i| (Some(if i < 20 { 1 } else { 9 }), 500.0)).collect();
        let counts = shares(&assign(&group, &tiles, 0.0));
        assert!(counts.iter().all(|n| (9..=11).contains(n)), "{counts:?}");
    }
}
