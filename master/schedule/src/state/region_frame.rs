//! A frame under the `region` schedule: one phase through all depths, without a barrier
//! (docs/design/cluster.md section 3).
//!
//! A task is one tile through all sheets. The master culls nothing: workers do, and ask for the
//! bricks that they lack. What is left to decide is how large a tile is and which worker owns it:
//! by what the frames before took (`policy::cost_history`), with one cost model
//! (`policy::cost_model`).

use crate::dispatch::steal::Splits;
use crate::policy::assign::{Group, TileToAssign};
use crate::policy::cost_history::{HistoryKey, TileCost, WHOLE_PX};
use crate::policy::cost_model::{CostModel, SWITCH_GAIN_RATIO, WORTHWHILE_RATIO};
use crate::policy::macrotile::{Macrotile, Through};
use crate::policy::prefetch::TileOwnerGrid;
use crate::policy::tile_size::{CutContext, PricedCut};
use crate::state::brick_orders::send_bricks;
use crate::state::cluster::Cluster;
use crate::state::frame::{FrameCore, Stage, TILES_LAID_TOGETHER};
use crate::state::region_tiles::{Predicted, RegionTiles};
use crate::state::workers::{LANES, Roster};
use crate::{Action, FrameJob, Micros};
use slabcast_common::blocks::Block;
use slabcast_common::ids::WorkerId;
use slabcast_common::message::{Pixels, RegionCost, is_live};
use slabcast_common::occlusion::Rect;

/// Limit: batches in which the tiles of a live session's frame are laid into its picture, at least. A
/// person sees them come. One thread has some 12 tiles of a frame, which [`TILES_LAID_TOGETHER`] would not reach.
const LIVE_BATCHES: usize = 16;

/// Limit: task ids reserved for pieces of each tile of a sole frame.
const PIECES_PER_TILE: u64 = 9;

/// State of a frame of the `region` schedule.
#[derive(Debug)]
pub(crate) struct RegionFrame {
    pub(crate) core: FrameCore,
    /// The lane of workers that renders the frame; `None`: all do.
    pub(crate) lane: Option<u32>,
    pub(crate) key: HistoryKey,
    pub(crate) costs: CostModel,
    pub(crate) tiles: RegionTiles,
    /// Pieces that workers gave away.
    pub(crate) splits: Splits,
    /// Owners of the picture's cells; `None` where nothing is prefetched.
    owner_grid: Option<TileOwnerGrid>,
    /// Rectangle of each block of bricks, until bricks are prefetched.
    outlines: Option<Vec<Rect>>,
    /// When idle threads look again for tasks to steal.
    pub(crate) steal_at: Option<Micros>,
    /// [`Roster::changes`](crate::state::workers::Roster::changes) when owners were looked for, and
    /// whether some were missing.
    pub(crate) changes: Option<u64>,
    pub(crate) has_orphans: bool,
}

impl RegionFrame {
    /// A frame that is not cut yet.
    pub(crate) fn new(core: FrameCore, lane: Option<u32>) -> Self {
        RegionFrame {
            lane,
            key: (core.job.scene.bricks, core.job.view.size, lane),
            costs: CostModel::default(),
            tiles: RegionTiles::default(),
            splits: Splits::default(),
            owner_grid: None,
            outlines: None,
            steal_at: None,
            changes: None,
            has_orphans: false,
            core,
        }
    }

    /// Cuts the picture, and assigns an owner to each tile.
    pub(crate) fn begin_regions(&mut self, cluster: &mut Cluster, began: Micros) {
        let job = &self.core.job;
        let (set, size, sole) = (job.scene.bricks, job.view.size, self.core.sole);
        let blocks = cluster.history.make_blocks(set, &job.bricks);
        let outline = |b: &Block| job.view.project_rect(&b.tight).unwrap_or_default();
        let outlines: Vec<Rect> = blocks.iter().map(outline).collect();
        let rects: Vec<Rect> = outlines.iter().filter(|r| !r.is_empty()).copied().collect();
        let through = Through::new(size, &rects);

        let roster = &cluster.roster;
        self.lane = self.lane.filter(|_| pays_in_lanes(&through, roster));
        self.key.2 = self.lane;
        let group = Group::new(roster.lane(self.lane));
        let threads = group.threads();
        let costs = CostModel::new(&cluster.link_use, roster);
        let brick_us = costs.brick_us(cluster.residency.brick_bytes(set));
        cluster.history.view_mut(self.key);
        let history = cluster.history.view(self.key).expect("just made");
        let context = CutContext {
            costs,
            history,
            threads: threads as usize,
            tiles_per_thread: job.work.tiles_per_worker,
            sole,
            is_local: roster.is_mostly_local(),
            // No worker holds a brick in the first frame.
            bricks_bind: history.is_empty() || sole && cluster.link_use.bricks_bind(),
        };
        let mut priced = context.cut(&through, job.work.tile);
        priced.sort_by_time();
        let PricedCut { cut, costs: costs_known, unit_us: unit } = priced;
        // The first frame is cut into bands; while it is rendered others begin, and most of their
        // times are guesses.
        let known = costs_known.iter().flatten().count();
        let may_move = 2 * known >= cut.tiles.len() && group.has_several();
        let slack = if sole { WORTHWHILE_RATIO } else { SWITCH_GAIN_RATIO };
        let slack = may_move.then_some(slack);
        let is_there = |id: &WorkerId| roster.get(*id).is_some_and(|w| !w.leaving);
        let to_assign = |(tile, cost): (&Macrotile, &Option<TileCost>)| {
            let us = cost.map_or(tile.est as f64 * unit, |c| c.us);
            let home = || history.home(&tile.rect).filter(is_there);
            let last = cost.map(|c| c.owner);
            let bricks = if may_move { history.bricks(&tile.rect) } else { 0 };
            TileToAssign {
                us,
                cost: *cost,
                owner: if sole { last.or_else(home) } else { home().or(last) },
                price_us: brick_us * bricks as f64,
            }
        };
        let tiles: Vec<_> = cut.tiles.iter().zip(&costs_known).map(to_assign).collect();
        let owners = group.assign(&cut.tiles, &tiles, &cluster.history.rates, roster, slack);
        let predicted = |t: &TileToAssign| Some(Predicted { worker: t.cost?.owner, us: t.us });
        let predicted: Vec<_> = tiles.iter().map(predicted).collect();

        // One worker alone has rendered all that was rendered.
        let several = roster.active().nth(1).is_some();
        let prefetches = several && cluster.link_use.has_room(sole);
        let owner = |place: u32| owners[place as usize];
        self.owner_grid = prefetches.then(|| TileOwnerGrid::new(size, &cut, owner));
        self.outlines = prefetches.then_some(outlines);
        let view = cluster.history.view_mut(self.key);
        // A mixed cut is one of whole tiles.
        view.last_edge = Some(if sole { cut.edge.max(WHOLE_PX) } else { cut.edge });
        view.set_homes(&cut, &owners);
        self.costs = costs;
        self.tiles = RegionTiles::new(owners, predicted);
        let spare_ids = if sole { PIECES_PER_TILE * cut.tiles.len() as u64 } else { 0 };
        self.core.begin_phase(cluster, began, cut, spare_ids);
    }

    /// Whether bricks are still to be prefetched.
    pub(crate) fn has_prefetch(&self) -> bool {
        self.outlines.is_some()
    }

    /// Prefetches the bricks that were used lately and overlap another worker's tiles now. Due
    /// after the frame's first leases: nobody waits for it.
    pub(crate) fn prefetch(&mut self, cluster: &mut Cluster, now: Micros) {
        let job = &self.core.job;
        let set = job.scene.bricks;
        let is_drawing = self.core.stage == Stage::Drawing;
        let outlines = self.outlines.take().filter(|_| is_drawing);
        let (Some(outlines), Some(grid)) = (outlines, &self.owner_grid) else { return };
        let presence = cluster.residency.presence(set, self.core.sole);
        let (Some(presence), Some(blocks)) = (presence, cluster.history.blocks(set)) else {
            return;
        };
        let lacked = grid.lacked(&presence, (blocks, &outlines), brick_outline(job));
        for id in cluster.residency.queue_prefetch(set, lacked) {
            send_bricks(cluster, Some(&mut self.core.ledger), id, now);
        }
    }

    /// Queues newly used bricks for every worker whose tiles they overlap. They leave with the next
    /// message to that worker.
    pub(crate) fn prefetch_newly_used(&self, cluster: &mut Cluster, newly_used: &[u32]) {
        let job = &self.core.job;
        let set = job.scene.bricks;
        let is_drawing = self.core.stage == Stage::Drawing;
        let Some(grid) = self.owner_grid.as_ref().filter(|_| is_drawing) else { return };
        let Some(presence) = cluster.residency.presence(set, self.core.sole) else { return };
        let lacked = grid.lacked_among(&presence, newly_used, brick_outline(job));
        cluster.residency.queue_prefetch(set, lacked);
    }

    /// Enters a result: lays its pixels, and learns its time and bricks.
    pub(crate) fn rendered(
        &mut self,
        cluster: &mut Cluster,
        place: u32,
        worker: WorkerId,
        us: Micros,
        pixels: Pixels,
        cost: Option<RegionCost>,
    ) {
        let tile = self.core.table.tile(place);
        let together = if is_live(self.core.job.client) {
            let all = self.core.table.queue.tasks.len();
            (all / LIVE_BATCHES).clamp(1, TILES_LAID_TOGETHER)
        } else {
            TILES_LAID_TOGETHER
        };
        let picture = &mut self.core.picture;
        match pixels {
            Pixels::Finished(leaves) => {
                picture.place_encoded(tile, leaves);
                if picture.encoded_tiles().len() >= together {
                    let (frame, tiles) = (self.core.job.frame, picture.take_encoded());
                    cluster.out.push_back(Action::Finished { frame, tiles });
                }
            }
            Pixels::Sums(sums) => picture.place_sums(tile, sums),
        }
        self.splits.forget_question(place);
        let bricks = cost.as_ref().map_or(&[][..], |cost| &cost.touched[..]);
        cluster.residency.mark_used(self.core.job.scene.bricks, bricks, &mut cluster.newly_used);
        match self.splits.rendered(place, us, bricks) {
            Some(Some(group)) => {
                let (us, bricks) = group.cost();
                cluster.history.learn(self.key, &group.tile, group.owner, us, bricks);
            }
            // Other pieces of the tile have no result.
            Some(None) => {}
            None if cost.is_some() => {
                cluster.history.learn(self.key, &tile, worker, us, bricks);
            }
            None => {}
        }
    }

    /// Ends the only phase.
    pub(crate) fn end_regions(&mut self, now: Micros) {
        let queue = &self.core.table.queue;
        let wholes = self.splits.whole_tiles(queue);
        let pieces: Vec<bool> = (0..queue.tasks.len() as u32)
            .map(|place| self.splits.is_part_of_a_whole(queue, place))
            .collect();
        // Threads go on with the next frame: there is no barrier to wait at.
        self.core.end_phase(0, 0, 0, &wholes, |place| pieces[place as usize], now);
        self.core.stage = Stage::Done;
        self.core.ended = Some(now);
    }
}

/// Whether overlapping frames are better rendered by lanes of workers in turn.
///
/// Owners stay from frame to frame, and so do the threads that have a tile more than others: half a
/// tile too much in the mean. With half as many workers for each frame, and each with twice as many
/// tiles, that is half as much. Lanes cost a frame twice the time until it is complete, and bricks:
/// each lane holds what the view needs. Frames end in order, so a weak lane would hold up a strong
/// one.
fn pays_in_lanes(through: &Through, roster: &Roster) -> bool {
    let tiles_a_thread = through.count(WHOLE_PX) as f64 / roster.threads().max(1) as f64;
    let lanes = || (0..LANES).map(|lane| roster.lane(Some(lane)));
    let threads = || lanes().map(|lane| lane.map(|(_, threads)| threads).sum::<u64>());
    let (least, most) = (threads().min().unwrap_or(0), threads().max().unwrap_or(0));
    SWITCH_GAIN_RATIO * tiles_a_thread < 0.5
        && lanes().all(|lane| lane.count() > 1)
        && 5 * least >= 3 * most
}

/// Returns a function that gives the rectangle of a brick in a frame's picture.
fn brick_outline(job: &FrameJob) -> impl Fn(u32) -> Option<Rect> {
    |index| job.view.project_rect(&job.bricks[index as usize].tight)
}
