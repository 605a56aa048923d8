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

/// Slowness of each worker relative to the others: a moving average on a logarithmic scale.
#[derive(Debug, Default)]
pub(crate) struct WorkerRates {
    slowness: WorkerMap<f64>,
}

impl WorkerRates {
    /// Returns how many times longer than others a worker takes; 1 while nothing is known.
    pub(crate) fn slowness(&self, id: WorkerId) -> f64 {
        self.slowness.get(id).copied().unwrap_or(1.0)
    }

    /// Returns how many times longer `one` takes than `other`; 1 within the dead band.
    pub(crate) fn ratio(&self, one: WorkerId, other: WorkerId) -> f64 {
        believed_ratio(self.slowness(one) / self.slowness(other))
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

/// Returns a ratio of two workers' slowness as it is believed: 1 within the dead band.
pub(crate) fn believed_ratio(ratio: f64) -> f64 {
    if (1.0 / RATE_DEADBAND_RATIO..=RATE_DEADBAND_RATIO).contains(&ratio) { 1.0 } else { ratio }
}

/// The last rendering of a tile.
#[derive(Clone, Debug)]
struct Rendering {
    tile: Rect,
    owner: WorkerId,
    /// Indices of the bricks it was rendered from.
    bricks: Vec<u32>,
    /// Number of leaves that it is the last rendering of. At 0 its place is free.
    leaves: u32,
}

/// Rendering history of one leaf (16x16 pixels).
#[derive(Clone, Debug, Default)]
struct LeafCost {
    /// Rendering time in microseconds, as part of a tile of [`WHOLE_PX`] pixels or more.
    us: f64,
    /// Index in `ViewHistory::renderings` of the leaf's last rendering; `None`: never rendered.
    last: Option<u32>,
    /// Owner of the leaf's tile in the frame that was cut last, rendered or not. A worker that
    /// steals a tile does so once: in the next frame the tile goes back to where its neighbours
    /// are, lest borders, and with them bricks at two workers, become more and more.
    home: Option<WorkerId>,
}

/// Rendering time of a tile, however earlier frames were cut.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TileCost {
    /// Worker that rendered most of the tile.
    pub(crate) owner: WorkerId,
    /// Rendering time in microseconds.
    pub(crate) us: f64,
}

/// Rendering history of the leaves that a frame will render, summed.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct KnownLeaves {
    /// Number of leaves.
    pub(crate) all: usize,
    /// Number of leaves that were rendered before.
    pub(crate) rendered: usize,
    /// Rendering time of all in microseconds, as part of tiles of [`WHOLE_PX`] pixels or more.
    pub(crate) us: f64,
}

/// Leaves of the pictures of one kind.
#[derive(Clone, Debug)]
pub(crate) struct ViewHistory {
    key: HistoryKey,
    columns: usize,
    leaves: Vec<LeafCost>,
    /// Last renderings of all leaves, and the places among them that are free.
    renderings: Vec<Rendering>,
    free: Vec<u32>,
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
            renderings: Vec::new(),
            free: Vec::new(),
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

    /// Returns the rendering time of a tile in microseconds, however earlier frames were cut;
    /// `None`: no part of it was rendered.
    pub(crate) fn us(&self, tile: &Rect) -> Option<f64> {
        self.cost(tile).map(|cost| cost.us)
    }

    /// Returns what is known of those leaves, row by row, that are to be rendered.
    pub(crate) fn known_leaves(&self, to_render: impl Iterator<Item = bool>) -> KnownLeaves {
        let mut known = KnownLeaves::default();
        for (leaf, _) in self.leaves.iter().zip(to_render).filter(|(_, to_render)| *to_render) {
            known.all += 1;
            known.rendered += usize::from(leaf.last.is_some());
            known.us += leaf.us;
        }
        known
    }

    /// Returns what is known of a tile, however earlier frames were cut.
    pub(crate) fn cost(&self, tile: &Rect) -> Option<TileCost> {
        let (owner, us) = self.owner_and_leaves_us(tile)?;
        Some(TileCost { owner, us: us * time_ratio(tile) })
    }

    /// Returns the worker that rendered most of a tile, and the time of its leaves in microseconds.
    fn owner_and_leaves_us(&self, tile: &Rect) -> Option<(WorkerId, f64)> {
        let mut us = 0.0;
        /// Limit: workers that share a tile; others count for nobody, in the last place.
        const MOST: usize = 4;
        let mut owners = [(WorkerId(0), 0.0); MOST + 1];
        let (mut count, mut before, mut at) = (0, None, 0);
        for row in self.rows(tile) {
            for leaf in &self.leaves[row] {
                let Some(last) = leaf.last else { continue };
                us += leaf.us;
                // Neighbouring leaves mostly share a rendering.
                if before.replace(last) != Some(last) {
                    let owner = self.renderings[last as usize].owner;
                    let known = owners[..count].iter().position(|o| o.0 == owner);
                    at = known.unwrap_or(count);
                    if at == count && count < MOST {
                        owners[at] = (owner, 0.0);
                        count += 1;
                    }
                }
                // Leaves that take no time count too.
                owners[at].1 += leaf.us + 1e-9;
            }
        }
        let most = owners[..count].iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
        Some((most.0, us))
    }

    /// Returns the number of bricks that come along with a tile to another worker.
    pub(crate) fn bricks(&self, tile: &Rect) -> usize {
        let renderings = self.renderings(tile, |_| true);
        match renderings[..] {
            // Half of the bricks of a larger tile overlap this one.
            [one] if one.tile.area() > tile.area() => one.bricks.len() / 2,
            [one] => one.bricks.len(),
            _ => count_distinct(renderings.iter().map(|r| &r.bricks[..])),
        }
    }

    /// Returns the last renderings of a tile's leaves, each once, by workers for which `counts`
    /// says so.
    fn renderings(&self, tile: &Rect, counts: impl Fn(WorkerId) -> bool) -> Vec<&Rendering> {
        let mut found: Vec<&Rendering> = Vec::new();
        let mut before = None;
        for row in self.rows(tile) {
            for last in self.leaves[row].iter().filter_map(|leaf| leaf.last) {
                // Neighbouring leaves mostly share one.
                if before.replace(last) == Some(last) {
                    continue;
                }
                let rendering = &self.renderings[last as usize];
                let is_new = || !found.iter().any(|r| std::ptr::eq(*r, rendering));
                if counts(rendering.owner) && is_new() {
                    found.push(rendering);
                }
            }
        }
        found
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
        let lists = self.renderings(tile, |owner| owner != worker);
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
        let before = self.owner_and_leaves_us(tile);
        let ratio = time_ratio(tile);
        let us = match before.map(|(last, leaves_us)| (last, leaves_us * ratio)) {
            Some((last, last_us)) if last == owner => 0.5 * (last_us + us),
            Some(last) => {
                rates.compare((owner, us), last);
                us
            }
            None => us,
        };
        let us = us / ratio;
        let all = before.map_or(0.0, |(_, leaves_us)| leaves_us);
        let count = self.rows(tile).map(|row| row.len()).sum::<usize>() as f64;
        let new = self.add_rendering(tile, owner, bricks, count as u32);
        for row in self.rows(tile) {
            for leaf in &mut self.leaves[row] {
                leaf.us = if all > 0.0 { us * leaf.us / all } else { us / count };
                if let Some(old) = leaf.last.replace(new) {
                    let rendering = &mut self.renderings[old as usize];
                    rendering.leaves -= 1;
                    if rendering.leaves == 0 {
                        self.free.push(old);
                    }
                }
            }
        }
    }

    /// Adds a rendering of so many leaves, in a free place if there is one. Returns its index.
    fn add_rendering(&mut self, tile: &Rect, owner: WorkerId, bricks: &[u32], leaves: u32) -> u32 {
        let index = self.free.pop().unwrap_or_else(|| {
            let empty = Rendering { tile: *tile, owner, bricks: Vec::new(), leaves };
            self.renderings.push(empty);
            self.renderings.len() as u32 - 1
        });
        let rendering = &mut self.renderings[index as usize];
        (rendering.tile, rendering.owner, rendering.leaves) = (*tile, owner, leaves);
        rendering.bricks.clear();
        rendering.bricks.extend_from_slice(bricks);
        index
    }
}

/// Returns the number of distinct indices in some lists.
fn count_distinct<'a>(lists: impl Iterator<Item = &'a [u32]>) -> usize {
    // A bit for each index, since lists of neighbouring tiles share most of theirs.
    let mut seen: Vec<u64> = Vec::new();
    let mut count = 0;
    for &index in lists.flatten() {
        let (word, bit) = (index as usize / 64, 1 << (index % 64));
        if word >= seen.len() {
            seen.resize(word + 1, 0);
        }
        count += usize::from(seen[word] & bit == 0);
        seen[word] |= bit;
    }
    count
}

/// Returns how many times longer the pixels of a tile take than as part of a tile of [`WHOLE_PX`].
fn time_ratio(tile: &Rect) -> f64 {
    edge_time_ratio(tile.width().max(tile.height()) as u32)
}

/// Returns [`time_ratio`] of tiles of an edge in pixels.
pub(crate) fn edge_time_ratio(edge: u32) -> f64 {
    if edge <= WHOLE_PX / 2 { SPLIT_TIME_RATIO } else { 1.0 }
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
