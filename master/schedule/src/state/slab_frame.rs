//! A frame under the paper's schedule: slab after slab, with a barrier (section 4.5).

use crate::Micros;
use crate::policy::macrotile::{self, Cut, LEAF, LEVELS};
use crate::policy::slab_borders;
use crate::state::cluster::Cluster;
use crate::state::frame::{FrameCore, Stage, is_shut};
use slabcast_common::ids::WorkerId;
use slabcast_common::message::Pixels;
use slabcast_common::occlusion::{Rect, ShutMap};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::Projected;
use std::collections::{BTreeMap, BTreeSet};

/// State of a frame of the `slab` schedule.
#[derive(Debug)]
pub(crate) struct SlabFrame {
    pub(crate) core: FrameCore,
    /// Projection of each brick; `None` outside the picture.
    projected: Vec<Option<Projected>>,
    /// Sheets of each slab, front to back.
    slabs: Vec<SheetRange>,
    /// Index of the current slab.
    index: usize,
    shut: ShutMap,
    /// Indices of the bricks that the slab needs, ascending, and their rectangles.
    needed: Vec<u32>,
    rects: Vec<Rect>,
    /// Needed bricks in the order in which the queue's tiles come to them.
    pub(crate) brick_order: Vec<u32>,
    /// Workers that the slab's bricks were queued for.
    pub(crate) served: BTreeSet<WorkerId>,
    /// [`Roster::changes`](crate::state::workers::Roster::changes) when newcomers were looked for.
    pub(crate) changes: Option<u64>,
    /// End of each render thread's last task.
    idle_since: BTreeMap<(WorkerId, u32), Micros>,
}

impl SlabFrame {
    /// Cuts a frame into slabs.
    pub(crate) fn new(core: FrameCore) -> Self {
        let (job, view) = (&core.job, &core.job.view);
        let projected: Vec<_> = job.bricks.iter().map(|b| view.project(&b.tight)).collect();
        let voxels = |i: usize| job.bricks[i].voxels;
        let slabs = slab_borders::slab_ranges(view, &projected, &voxels, &job.work);
        let shut = ShutMap::open(Rect::from_size(view.size));
        let mut frame = SlabFrame {
            projected,
            slabs,
            index: 0,
            shut,
            needed: Vec::new(),
            rects: Vec::new(),
            brick_order: Vec::new(),
            served: BTreeSet::new(),
            changes: None,
            idle_since: BTreeMap::new(),
            core,
        };
        if frame.slabs.is_empty() {
            frame.core.stage = Stage::Done;
        }
        frame
    }

    /// Returns the index of the current slab, and the number of slabs.
    pub(crate) fn position(&self) -> (usize, usize) {
        (self.index, self.slabs.len())
    }

    /// Returns the sheets of the current slab.
    pub(crate) fn sheets(&self) -> SheetRange {
        self.slabs.get(self.index).copied().unwrap_or_default()
    }

    /// Returns the indices of the bricks that a task needs.
    pub(crate) fn bricks_of(&self, place: u32) -> Vec<u32> {
        let tile = self.core.table.tile(place);
        let overlaps = |r: &Rect| !r.intersect(&tile).is_empty();
        let needed = self.needed.iter().zip(&self.rects);
        needed.filter(|(_, r)| overlaps(r)).map(|(&i, _)| i).collect()
    }

    /// Culls bricks, cuts the slab into macrotiles and sorts them.
    pub(crate) fn begin_slab(&mut self, cluster: &mut Cluster, began: Micros) {
        let sheets = self.sheets();
        let core = &mut self.core;
        let cull = core.job.scene.quality.cull;
        let (mut needed, mut rects) = (Vec::new(), Vec::new());
        for (i, projected) in self.projected.iter().enumerate() {
            let Some(p) = projected.filter(|p| p.sheets.overlaps(sheets)) else { continue };
            if cull && self.shut.all_shut(&p.rect) {
                core.ledger.counters.culled += u64::from(core.job.bricks[i].voxels);
                continue;
            }
            core.brick_use.note(&core.job, i);
            needed.push(i as u32);
            rects.push(p.rect);
        }
        let cut = self.cut(cluster, &rects);
        cluster.residency.begin_slab(&needed);
        let with_tile = |(&i, r): (&u32, &Rect)| Some((cut.first_in(r)?, i));
        let mut order: Vec<(u32, u32)> = needed.iter().zip(&rects).filter_map(with_tile).collect();
        order.sort_unstable();
        self.brick_order = order.into_iter().map(|(_, i)| i).collect();
        (self.needed, self.rects) = (needed, rects);
        (self.served, self.changes, self.idle_since) = Default::default();
        self.core.begin_phase(cluster, began, cut, 0);
    }

    fn cut(&self, cluster: &Cluster, rects: &[Rect]) -> Cut {
        let job = &self.core.job;
        let cull = job.scene.quality.cull;
        let threads = cluster.roster.threads();
        let wanted = (job.work.tiles_per_worker * threads as f64).ceil() as u64;
        // A slab without bricks has no best level; the coarsest tells it shortest.
        let coarsest = LEAF << (LEVELS - 1);
        let forced = job.work.tile.or(rects.is_empty().then_some(coarsest));
        let size = job.view.size;
        if cluster.config.mixed {
            let whole = threads as usize;
            macrotile::cut_mixed(size, rects, &self.shut, cull, (wanted, forced), whole)
        } else {
            macrotile::cut(size, rects, &self.shut, cull, wanted, forced)
        }
    }

    /// Enters a result's pixels.
    pub(crate) fn rendered(
        &mut self,
        tile: Rect,
        pixels: Pixels,
        thread: (WorkerId, u32),
        end: Micros,
    ) {
        // Finished pixels are refused before: this frame asks for none.
        let Pixels::Sums(sums) = pixels else { return };
        let width = self.core.job.view.size[0] as usize;
        let eps = self.core.job.scene.quality.eps;
        let rows = sums.a.chunks(tile.width()).zip(tile.y0..);
        for (row, y) in rows.filter(|_| eps > 0.0) {
            for (&a, x) in row.iter().zip(tile.x0..) {
                if is_shut(a, eps) {
                    self.shut.shut(y as usize * width + x as usize);
                }
            }
        }
        self.core.picture.add_slab_tile(tile, &sums);
        let idle_since = self.idle_since.entry(thread).or_insert(end);
        *idle_since = end.max(*idle_since);
    }

    /// The barrier: the picture moves on to the next slab.
    pub(crate) fn end_slab(&mut self, cluster: &Cluster, now: Micros) {
        self.core.picture.end_slab();
        self.shut.refresh();
        let began = self.core.phase_began;
        let mut waited = 0;
        if !self.core.table.queue.tasks.is_empty() {
            for (id, worker) in cluster.roster.active() {
                let mut busy = 0;
                for (_, end) in self.idle_since.range((id, 0)..=(id, u32::MAX)) {
                    busy += 1;
                    waited += now.saturating_sub((*end).max(began));
                }
                let idle = u64::from(worker.threads).saturating_sub(busy);
                waited += idle * now.saturating_sub(began.max(worker.since));
            }
        }
        let (index, bricks) = (self.index, self.needed.len());
        self.core.end_phase(index, bricks, waited, &BTreeMap::new(), |_| false, now);
        self.index += 1;
        if self.index == self.slabs.len() {
            self.core.stage = Stage::Done;
            self.core.ended = Some(now);
        }
    }
}
