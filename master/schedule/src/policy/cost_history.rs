//! Costs known from earlier frames of a picture: the rendering time, the owner and the bricks of
//! each leaf of 16x16 pixels, and how fast each worker is.
//!
//! Consecutive frames of a path are cut differently: a tile of 64 pixels in one is four of 32 in
//! the next, and pieces of either may be rendered elsewhere. So costs are kept by leaf, in the time
//! that the leaf takes as part of a tile of [`WHOLE_PX`] pixels or more, and any tile's cost is the
//! sum of its leaves. A tile that is rendered scales its leaves to its time and keeps their
//! proportions.
//!
//! One disturbed measurement moves nothing: a tile that its last owner renders again is believed
//! half. Where two workers rendered the same tile in consecutive frames, their times tell which of
//! them is slower ([`WorkerRates`]).

use crate::Micros;
use crate::policy::cost_model::shortest_telling_tile_us;
use crate::policy::macrotile::{Cut, LEAF};
use crate::policy::signal::NEW_VALUE_WEIGHT;
use crate::state::worker_map::WorkerMap;
use slabcast_common::blocks::{Block, Blocks};
use slabcast_common::brick::{BrickInfo, BrickSetKey};
use slabcast_common::ids::WorkerId;
use slabcast_common::occlusion::Rect;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Limit: edge in pixels of the tiles that are rendered in one part
/// (`slabcast_common::region::PART`). Smaller tiles of the same pixels take longer altogether.
pub(crate) const WHOLE_PX: u32 = 64;

/// Tuning (ratio): rendering time of the four quarters of a tile of [`WHOLE_PX`] pixels to that of
/// the tile. 1.17 to 1.30 are measured, 1.24 for mri256 `peer-semi` at 1024x1024.
pub(crate) const SPLIT_TIME_RATIO: f64 = 1.24;

/// Tuning (ratio): two workers count as equally fast up to this ratio of their rates. A tile takes
/// another time in each frame, and a core shared with another process is slower by half.
const RATE_DEADBAND_RATIO: f64 = 2.0;

/// Limit: one measurement, and the rate itself, differ from 1 by at most these factors.
const RATE_STEP_LIMIT: f64 = 10.0;
const RATE_LIMIT: f64 = 100.0;

/// Limit: blocks that stand for the bricks of a set, 60 us to project. Twice as many know the
/// outline better by half a leaf.
const MAX_BLOCKS: usize = 2048;

/// Limit: edge of the smallest block in voxels, four bricks, as a power of two.
const MIN_BLOCK_LOG2_VOX: u32 = 5;

/// Limit: histories kept, each of one brick set, picture size and lane.
const MAX_HISTORIES: usize = 3;

/// Identifies frames that learn from each other: a brick set, a picture size, and a lane of
/// workers.
pub(crate) type HistoryKey = (BrickSetKey, [u32; 2], Option<u32>);

/// How much slower each worker is than others: a moving average on a logarithmic scale.
#[derive(Debug, Default)]
pub(crate) struct WorkerRates {
    slowness: WorkerMap<f64>,
}

impl WorkerRates {
    fn slowness(&self, id: WorkerId) -> f64 {
        self.slowness.get(id).copied().unwrap_or(1.0)
    }

    /// Returns how many times longer `one` takes than `other`; 1 within the dead band.
    pub(crate) fn ratio(&self, one: WorkerId, other: WorkerId) -> f64 {
        let ratio = self.slowness(one) / self.slowness(other);
        if (1.0 / RATE_DEADBAND_RATIO..=RATE_DEADBAND_RATIO).contains(&ratio) { 1.0 } else { ratio }
    }

    /// Notes that one tile took `one` worker `one_us`, and `other` `other_us` in the frame before.
    fn compare(&mut self, (one, one_us): (WorkerId, f64), (other, other_us): (WorkerId, f64)) {
        if one_us.min(other_us) < shortest_telling_tile_us() {
            return;
        }
        let (a, b) = (self.slowness(one), self.slowness(other));
        let surprise = (one_us / other_us) / (a / b);
        let surprise = surprise.clamp(1.0 / RATE_STEP_LIMIT, RATE_STEP_LIMIT);
        // The fourth root: `NEW_VALUE_WEIGHT` as an exponent.
        const { assert!(NEW_VALUE_WEIGHT == 0.25) };
        let step = surprise.sqrt().sqrt();
        let limit = |x: f64| x.clamp(1.0 / RATE_LIMIT, RATE_LIMIT);
        self.slowness.insert(one, limit(a * step));
        self.slowness.insert(other, limit(b / step));
    }

    /// Forgets a worker that is gone.
    pub(crate) fn forget(&mut self, id: WorkerId) {
        self.slowness.remove(id);
    }
}

/// The last rendering of a tile.
#[derive(Debug)]
struct Rendering {
    tile: Rect,
    owner: WorkerId,
    /// Indices of the bricks it was rendered from.
    bricks: Box<[u32]>,
}

/// What is known of one leaf.
#[derive(Clone, Debug, Default)]
struct LeafCost {
    /// Rendering time in microseconds, as part of a tile of [`WHOLE_PX`] pixels or more.
    us: f64,
    last: Option<Arc<Rendering>>,
    /// Owner of the leaf's tile in the frame that was cut last, rendered or not. A worker that
    /// steals a tile does so once: in the next frame the tile goes back to where its neighbours
    /// are, lest borders, and with them bricks at two workers, become more and more.
    home: Option<WorkerId>,
}

/// What is known of a tile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TileCost {
    /// Worker that rendered most of it.
    pub(crate) owner: WorkerId,
    /// Rendering time in microseconds.
    pub(crate) us: f64,
    /// Number of bricks that come along with it to another worker.
    pub(crate) bricks: usize,
}

/// Leaves of the pictures of one kind.
#[derive(Clone, Debug)]
pub(crate) struct ViewHistory {
    key: HistoryKey,
    columns: usize,
    leaves: Vec<LeafCost>,
    /// Tile edge of the frame that was cut last, in pixels.
    pub(crate) last_edge: Option<u32>,
}

impl ViewHistory {
    fn new(key: HistoryKey) -> Self {
        let [columns, rows] = key.1.map(|n| n.div_ceil(LEAF) as usize);
        ViewHistory {
            key,
            columns,
            leaves: vec![LeafCost::default(); columns * rows],
            last_edge: None,
        }
    }

    /// Whether no tile was rendered.
    pub(crate) fn is_empty(&self) -> bool {
        self.leaves.iter().all(|leaf| leaf.last.is_none())
    }

    /// Returns the indices of the leaves that a tile overlaps, row by row.
    fn rows(&self, tile: &Rect) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
        let cell = |p: i32| p as usize / LEAF as usize;
        let (x0, x1) = (cell(tile.x0), cell(tile.x1 - 1) + 1);
        let columns = self.columns;
        (cell(tile.y0)..=cell(tile.y1 - 1)).map(move |y| y * columns + x0..y * columns + x1)
    }

    fn leaves_of(&self, tile: &Rect) -> impl Iterator<Item = &LeafCost> {
        self.rows(tile).flat_map(|row| &self.leaves[row])
    }

    /// Returns what is known of a tile, however earlier frames were cut.
    pub(crate) fn cost(&self, tile: &Rect) -> Option<TileCost> {
        let mut us = 0.0;
        // Few workers and renderings share a tile.
        let mut owners: [(WorkerId, f64); 4] = [(WorkerId(0), 0.0); 4];
        let mut count = 0;
        let mut renderings: Vec<&Arc<Rendering>> = Vec::new();
        for leaf in self.leaves_of(tile) {
            let Some(rendering) = &leaf.last else { continue };
            us += leaf.us;
            // Leaves that take no time count too.
            let weight = leaf.us + 1e-9;
            match owners[..count].iter().position(|o| o.0 == rendering.owner) {
                Some(i) => owners[i].1 += weight,
                None if count < owners.len() => {
                    owners[count] = (rendering.owner, weight);
                    count += 1;
                }
                None => {}
            }
            if !renderings.iter().any(|r| Arc::ptr_eq(r, rendering)) {
                renderings.push(rendering);
            }
        }
        let bricks = match renderings[..] {
            // Half of the bricks of a larger tile overlap this one.
            [one] if one.tile.area() > tile.area() => one.bricks.len() / 2,
            [one] => one.bricks.len(),
            _ => {
                let lists = renderings.iter().flat_map(|r| r.bricks.iter());
                lists.collect::<BTreeSet<_>>().len()
            }
        };
        let owner = owners[..count].iter().max_by(|a, b| a.1.total_cmp(&b.1))?.0;
        Some(TileCost { owner, us: us * time_ratio(tile), bricks })
    }

    /// Returns the owner of a tile in the frame that was cut last.
    pub(crate) fn home(&self, tile: &Rect) -> Option<WorkerId> {
        self.leaves_of(tile).find_map(|leaf| leaf.home)
    }

    /// Notes the owners of all tiles of a frame that was cut.
    pub(crate) fn set_homes(&mut self, cut: &Cut, owners: &[WorkerId]) {
        self.leaves.iter_mut().for_each(|leaf| leaf.home = None);
        for (tile, owner) in cut.tiles.iter().zip(owners) {
            for row in self.rows(&tile.rect) {
                self.leaves[row].iter_mut().for_each(|leaf| leaf.home = Some(*owner));
            }
        }
    }

    /// Returns the bricks that other workers rendered a tile from, as lists; `true`: the list is of
    /// a larger area, of which the tile is a part.
    pub(crate) fn bricks_elsewhere(&self, tile: &Rect, worker: WorkerId) -> Vec<(&[u32], bool)> {
        let mut lists: Vec<&Arc<Rendering>> = Vec::new();
        for rendering in self.leaves_of(tile).filter_map(|leaf| leaf.last.as_ref()) {
            if rendering.owner != worker && !lists.iter().any(|l| Arc::ptr_eq(l, rendering)) {
                lists.push(rendering);
            }
        }
        let is_part = |r: &Rendering| r.tile.union(tile) != *tile;
        lists.into_iter().map(|r| (&r.bricks[..], is_part(r))).collect()
    }

    /// Notes that a worker rendered a tile in `us` microseconds from these bricks.
    fn learn(
        &mut self,
        rates: &mut WorkerRates,
        tile: &Rect,
        owner: WorkerId,
        us: f64,
        bricks: &[u32],
    ) {
        let before = self.cost(tile);
        let us = match before {
            Some(last) if last.owner == owner => 0.5 * (last.us + us),
            Some(last) => {
                rates.compare((owner, us), (last.owner, last.us));
                us
            }
            None => us,
        };
        let us = us / time_ratio(tile);
        let all: f64 = self.leaves_of(tile).map(|leaf| leaf.us).sum();
        let count = self.leaves_of(tile).count() as f64;
        let rendering = Arc::new(Rendering { tile: *tile, owner, bricks: bricks.into() });
        for row in self.rows(tile) {
            for leaf in &mut self.leaves[row] {
                leaf.us = if all > 0.0 { us * leaf.us / all } else { us / count };
                leaf.last = Some(rendering.clone());
            }
        }
    }
}

/// Returns how many times longer the pixels of a tile take than as part of a tile of [`WHOLE_PX`].
fn time_ratio(tile: &Rect) -> f64 {
    let long = tile.width().max(tile.height()) as u32;
    if long <= WHOLE_PX / 2 { SPLIT_TIME_RATIO } else { 1.0 }
}

/// All that earlier frames teach.
#[derive(Debug, Default)]
pub(crate) struct CostHistory {
    blocks: Option<(BrickSetKey, Blocks)>,
    views: Vec<ViewHistory>,
    pub(crate) rates: WorkerRates,
}

impl CostHistory {
    /// Returns boxes around neighbouring bricks of a set, which together enclose all.
    pub(crate) fn make_blocks(&mut self, key: BrickSetKey, bricks: &[BrickInfo]) -> &[Block] {
        if self.blocks.as_ref().is_none_or(|(k, _)| *k != key) {
            self.blocks = Some((key, Blocks::new(bricks, MIN_BLOCK_LOG2_VOX, MAX_BLOCKS)));
        }
        self.blocks.as_ref().map_or(&[], |(_, blocks)| blocks.all())
    }

    /// Returns the blocks of a set, if its frames were the last to be cut.
    pub(crate) fn blocks(&self, key: BrickSetKey) -> Option<&Blocks> {
        self.blocks.as_ref().filter(|(k, _)| *k == key).map(|(_, blocks)| blocks)
    }

    /// Returns the history of frames of this kind; an empty one replaces the oldest if there is
    /// none.
    pub(crate) fn view_mut(&mut self, key: HistoryKey) -> &mut ViewHistory {
        let index = self.views.iter().position(|v| v.key == key).unwrap_or_else(|| {
            if self.views.len() == MAX_HISTORIES {
                self.views.remove(0);
            }
            // A lane begins with what all workers taught.
            let all = self.views.iter().find(|v| v.key == (key.0, key.1, None));
            let view = all.map(|all| ViewHistory { key, ..all.clone() });
            self.views.push(view.unwrap_or_else(|| ViewHistory::new(key)));
            self.views.len() - 1
        });
        &mut self.views[index]
    }

    /// Returns the history of frames of this kind.
    pub(crate) fn view(&self, key: HistoryKey) -> Option<&ViewHistory> {
        self.views.iter().find(|v| v.key == key)
    }

    /// Notes that a worker rendered a tile from these bricks.
    pub(crate) fn learn(
        &mut self,
        key: HistoryKey,
        tile: &Rect,
        owner: WorkerId,
        us: Micros,
        bricks: &[u32],
    ) {
        if let Some(view) = self.views.iter_mut().find(|v| v.key == key) {
            view.learn(&mut self.rates, tile, owner, us as f64, bricks);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::Digest32;

    const KEY: HistoryKey = (BrickSetKey(Digest32([0; 32])), [512, 512], None);

    fn history() -> CostHistory {
        let mut history = CostHistory::default();
        history.view_mut(KEY);
        history
    }

    #[test]
    fn cost_history_knows_a_tile_by_its_parts_and_parts_by_their_tile() {
        let mut history = history();
        let whole = Rect::new(64, 0, 128, 64);
        let part = |x, y| Rect::new(64 + 32 * x, 32 * y, 96 + 32 * x, 32 + 32 * y);
        let us = |h: &CostHistory, tile: &Rect| h.view(KEY).unwrap().cost(tile).unwrap().us;
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-6, "{a} for {b}");
        history.learn(KEY, &whole, WorkerId(1), 1000, &[1, 2]);
        near(us(&history, &whole), 1000.0);
        near(us(&history, &part(1, 1)), SPLIT_TIME_RATIO * 250.0);
        assert_eq!(history.view(KEY).unwrap().cost(&Rect::new(0, 0, 64, 64)), None);
        // Parts that another worker renders.
        for (x, y) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let time = if x == 0 { 200 } else { 600 };
            history.learn(KEY, &part(x, y), WorkerId(2), time, &[3]);
        }
        near(us(&history, &part(0, 0)), 200.0);
        near(us(&history, &whole), 1600.0 / SPLIT_TIME_RATIO);
        assert_eq!(history.view(KEY).unwrap().cost(&whole).unwrap().owner, WorkerId(2));
        // Whole again, its parts keep their proportions.
        history.learn(KEY, &whole, WorkerId(3), 4000, &[4]);
        near(us(&history, &part(1, 0)), SPLIT_TIME_RATIO * 1500.0);
    }

    #[test]
    fn cost_history_believes_half_of_a_measurement_of_the_same_worker() {
        let mut history = history();
        let tile = Rect::new(0, 0, 64, 64);
        history.learn(KEY, &tile, WorkerId(1), 1000, &[]);
        history.learn(KEY, &tile, WorkerId(1), 3000, &[]);
        assert!((history.view(KEY).unwrap().cost(&tile).unwrap().us - 2000.0).abs() < 1e-6);
    }

    #[test]
    fn cost_history_lists_bricks_that_another_worker_has() {
        let mut history = history();
        let tile = Rect::new(0, 0, 64, 64);
        history.learn(KEY, &tile, WorkerId(1), 1000, &[5, 6]);
        let view = history.view(KEY).unwrap();
        assert!(view.bricks_elsewhere(&tile, WorkerId(1)).is_empty());
        assert_eq!(view.bricks_elsewhere(&tile, WorkerId(2)), [(&[5, 6][..], false)]);
        let part = Rect::new(0, 0, 32, 32);
        assert_eq!(view.bricks_elsewhere(&part, WorkerId(2)), [(&[5, 6][..], true)]);
    }

    #[test]
    fn worker_rates_tell_a_slow_worker_by_tiles_that_two_rendered() {
        let mut rates = WorkerRates::default();
        for _ in 0..12 {
            rates.compare((WorkerId(1), 9000.0), (WorkerId(2), 900.0));
        }
        let ratio = rates.ratio(WorkerId(1), WorkerId(2));
        assert!((8.0..=10.1).contains(&ratio), "{ratio}");
        rates.compare((WorkerId(3), 5.0), (WorkerId(2), 900.0));
        assert!((rates.ratio(WorkerId(3), WorkerId(4)) - 1.0).abs() < 1e-9, "5 us say nothing");
        rates.forget(WorkerId(1));
        assert!((rates.ratio(WorkerId(1), WorkerId(4)) - 1.0).abs() < 1e-9);
    }
}
