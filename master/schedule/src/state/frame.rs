//! One frame. Under the paper's schedule: slab after slab, with a barrier (section 4.5).
//!
//! ```text
//! queued -> [slab 0] -> [slab 1] -> ... -> done
//!             | cull bricks, cut into macrotiles, sort        (begin_slab)
//!             | lend tasks, broadcast bricks                  (dispatch)
//!             | take in results, lend the next                (result)
//!             | no task open: occlusion map updated           (end_slab)
//! ```
//!
//! Under the `region` schedule it is one slab through all depths of which the master knows nothing
//! but where something may be seen: `region` cuts it and shares it out, workers cull it and ask for
//! bricks. Leases, results, stragglers and the lost are the same, and so is the code. Several such
//! frames may be in the making at a time; what a worker has of the others comes as a
//! [`StepContext`].
//!
//! `lend` says who gets which task and when, `late` cuts a tile that would be done last as it is
//! lent, `handover` one that is being drawn, and `pace` knows how long tasks take.
//!
//! A frame waits, with nothing lost, while there is no worker. It refuses to know who is silent
//! (`roster`), which copy of a result counts (`queue`) and where bricks are (`residency`).

use crate::account::critical_path::RenderedTile;
use crate::account::ledger::{Ledger, Rendered, ms, place_in_time};
use crate::account::spans;
use crate::policy::macrotile::{self, Cut, LEAF, LEVELS};
use crate::policy::prefetch::TileOwnerGrid;
use crate::policy::region::{Crew, Regions};
use crate::policy::slab_borders;
use crate::state::cluster::Cluster;
use crate::state::residency::{ResidencyAction, Transfer};
use crate::state::task_queue::{End, NAMES_PER_TILE, TaskQueue, Verdict};
use crate::state::worker_map::WorkerMap;
use crate::{Action, Clock, FrameJob, Micros, Span};
use slabcast_common::ids::{Epoch, TaskId, WorkerId};
use slabcast_common::image::{FrameState, PixelEncoding, SparseTile, TilePixels};
use slabcast_common::message::{Pixels, RegionCost, TileResult, ToWorker};
use slabcast_common::occlusion::{Rect, ShutMap};
use slabcast_common::quality::Schedule;
use slabcast_common::slab::SheetRange;
use slabcast_common::stats::{BrickStats, PoisonedTile, SlabStats, TileStats};
use slabcast_common::view::Projected;
use std::collections::{BTreeMap, BTreeSet};

use crate::dispatch::pace::Pace;
use crate::dispatch::steal::{Drawn, SplitGroup};

/// Whether a pixel with accumulated opacity `a` is shut for good.
///
/// The renderer makes the same test after each sheet, in the same f32 arithmetic; a master that
/// shut a pixel the renderer holds open would change bytes.
#[inline]
pub fn is_shut(a: f32, eps: f64) -> bool {
    eps > 0.0 && (1.0f32 - a) < eps as f32
}

/// Finished tiles that leave for the picture together: what is left when the last one has come is
/// laid in 20 us at most, where all of a picture of 1536x1536 take 0.6 ms (docs/scaling.md). Each
/// time a finisher is woken, so that it is not each tile.
const LAID_TOGETHER: usize = 16;

/// A lease that a worker has and has not answered; perhaps dead.
#[derive(Debug)]
pub(crate) struct Lent {
    pub(crate) task: TaskId,
    pub(crate) epoch: Epoch,
    pub(crate) sent: Micros,
    /// Places of its bricks.
    pub(crate) bricks: Vec<u32>,
}

/// The slab that is being rendered.
#[derive(Debug)]
pub(crate) struct Slab {
    pub(crate) sheets: SheetRange,
    pub(crate) began: Micros,
    pub(crate) cut: Cut,
    pub(crate) queue: TaskQueue,
    /// Places of the needed bricks, ascending, and their rectangles.
    pub(crate) needed: Vec<u32>,
    pub(crate) rects: Vec<Rect>,
    /// Needed bricks in the order in which the queue's tiles come to them.
    pub(crate) order: Vec<u32>,
    /// Whose its tiles are, under the `region` schedule.
    pub(crate) regions: Option<Regions>,
    /// Workers that the slab's bricks were queued for.
    pub(crate) served: BTreeSet<WorkerId>,
    /// [`Roster::changes`](crate::state::workers::Roster::changes) up to which it was looked at.
    pub(crate) changes: Option<u64>,
    /// Whether some of its owners took no leases then.
    pub(crate) orphaned: bool,
    /// End of each render thread's last task; not of regions, which have no barrier.
    pub(crate) dry: BTreeMap<(WorkerId, u32), Micros>,
    /// Tiles that counted.
    pub(crate) pieces: Vec<RenderedTile>,
    /// Names that its tasks may have.
    pub(crate) names: u64,
    /// Regions of which their worker was asked for a piece, by their places.
    pub(crate) handing: BTreeMap<u32, (WorkerId, Micros)>,
    /// The tile that each piece is of which was given away, and such tiles whose tasks are not all
    /// drawn.
    pub(crate) roots: BTreeMap<u32, u32>,
    pub(crate) split_groups: BTreeMap<u32, SplitGroup>,
}

impl Slab {
    pub(crate) fn bricks_of(&self, place: u32) -> Vec<u32> {
        let tile = self.cut.tiles[place as usize].rect;
        let over = |r: &Rect| !r.intersect(&tile).is_empty();
        let needed = self.needed.iter().zip(&self.rects);
        needed.filter(|(_, r)| over(r)).map(|(&i, _)| i).collect()
    }
}

/// A frame in the making.
#[derive(Debug)]
pub(crate) struct Frame {
    pub(crate) job: Box<FrameJob>,
    /// Which crew draws it, if not everybody has to.
    pub(crate) beside: Option<u32>,
    /// Whether no other was in the making or waited when it began.
    pub(crate) alone: bool,
    pub(crate) projected: Vec<Option<Projected>>,
    pub(crate) slabs: Vec<SheetRange>,
    pub(crate) at: usize,
    pub(crate) state: FrameState,
    pub(crate) shut: ShutMap,
    pub(crate) slab: Option<Slab>,
    /// When its last slab ended.
    pub(crate) ended: Option<Micros>,
    pub(crate) first_task: TaskId,
    /// Workers that were sent the frame's view.
    pub(crate) told: BTreeSet<WorkerId>,
    pub(crate) lent: WorkerMap<Vec<Lent>>,
    /// When each worker answered last.
    pub(crate) answered: WorkerMap<Micros>,
    pub(crate) pace: Pace,
    /// When the next task outlives its estimate, while a thread is idle.
    pub(crate) outlived: Option<Micros>,
    /// When the next region may be taken from an owner that is silent, while a thread is idle.
    pub(crate) forborne: Option<Micros>,
    /// When a region that takes longer than it was to is late enough to be cut, while a thread is
    /// idle.
    pub(crate) pieces_at: Option<Micros>,
    /// Parts of tiles that were cut late, and who is to have them: what they were drawn from goes
    /// along.
    pub(crate) gained: Vec<(WorkerId, u32)>,
    /// Whose tiles lie where; of regions that several draw.
    pub(crate) outlook: Option<TileOwnerGrid>,
    /// Where each block of bricks lies, until bricks are sent ahead.
    pub(crate) outlines: Option<Vec<Rect>>,
    pub(crate) needed_ever: Vec<bool>,
    /// Bricks among them, and their voxels.
    pub(crate) needed: (u64, u64),
    /// Voxels of all bricks.
    pub(crate) relevant: u64,
    pub(crate) any_result: bool,
    pub(crate) last_reason: String,
    pub(crate) ledger: Ledger,
}

/// Where a frame stands.
pub(crate) enum Step {
    /// It waits for events.
    Waits,
    /// Its last slab ended.
    Done,
    /// It can't be rendered.
    Failed(String),
}

/// What a step of one frame may do, given the other frames in transfer.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct StepContext {
    /// No later frame is in transfer or queued whose tasks could keep idle threads busy.
    pub(crate) is_last_frame: bool,
    /// Idle threads may take tasks that another worker owns.
    pub(crate) may_steal: bool,
    /// The only worker whose threads can have become free since the frame's last step; `None`: any.
    pub(crate) freed_worker: Option<WorkerId>,
}

/// Whether a frame is rendered under the `region` schedule. `auto` is that, always: where nothing
/// hides anything it needs as many bricks as the other and has no barriers.
pub(crate) fn goes_by_region(job: &FrameJob) -> bool {
    job.work.schedule != Schedule::Slab
}

impl Frame {
    pub(crate) fn start(
        job: Box<FrameJob>,
        (beside, alone): (Option<u32>, bool),
        cluster: &mut Cluster,
        clock: &dyn Clock,
    ) -> Self {
        let began = clock.now();
        let (view, by_region) = (&job.view, goes_by_region(&job));
        let mut projected = Vec::new();
        let slabs = if by_region {
            // Workers know its depths.
            vec![SheetRange::default()]
        } else {
            projected.extend(job.bricks.iter().map(|b| view.project(&b.tight)));
            slab_borders::slab_ranges(view, &projected, &|i| job.bricks[i].voxels, &job.work)
        };
        cluster.residency.open(job.scene.bricks, &job.bricks, by_region);
        let mut ledger = Ledger::new(began);
        for (id, worker) in cluster.roster.iter() {
            ledger.open_account(id, worker, began);
        }
        let mut frame = Frame {
            slabs,
            at: 0,
            state: FrameState::new(view.size),
            // Regions shut their pixels at the workers.
            shut: ShutMap::open(Rect::from_size(if by_region { [0; 2] } else { view.size })),
            slab: None,
            ended: None,
            first_task: TaskId(cluster.next_task),
            told: BTreeSet::new(),
            lent: WorkerMap::default(),
            answered: WorkerMap::default(),
            pace: Pace::default(),
            outlived: None,
            forborne: None,
            pieces_at: None,
            gained: Vec::new(),
            outlook: None,
            outlines: None,
            needed_ever: vec![false; job.bricks.len()],
            needed: (0, 0),
            relevant: cluster.residency.voxels(job.scene.bricks),
            any_result: false,
            last_reason: String::new(),
            ledger,
            projected,
            job,
            beside,
            alone,
        };
        frame.ledger.cull_us += clock.now().saturating_sub(began);
        frame
    }

    /// Goes as far as it can.
    pub(crate) fn step(
        &mut self,
        cluster: &mut Cluster,
        context: StepContext,
        clock: &dyn Clock,
    ) -> Step {
        loop {
            match &self.slab {
                Some(slab) if slab.queue.open() > 0 => {
                    self.dispatch(cluster, context, clock.now());
                    return Step::Waits;
                }
                Some(slab) => {
                    let tried = !slab.queue.tasks.is_empty();
                    self.end_slab(cluster, clock.now());
                    if tried && !self.any_result {
                        return Step::Failed(std::mem::take(&mut self.last_reason));
                    }
                }
                None if self.at == self.slabs.len() => return Step::Done,
                // The level of the quadtree depends on how many there are.
                None if cluster.roster.threads() == 0 => return Step::Waits,
                None if self.by_region() => self.begin_regions(cluster, clock),
                None => self.begin_slab(cluster, clock),
            }
        }
    }

    /// Whether its last slab ended.
    pub(crate) fn is_done(&self) -> bool {
        self.slab.is_none() && self.at == self.slabs.len()
    }

    /// Whether no other was in the making or waited when it began.
    pub(crate) fn is_alone(&self) -> bool {
        self.alone
    }

    /// Whether it can go beside other frames of its set.
    pub(crate) fn by_region(&self) -> bool {
        goes_by_region(&self.job)
    }

    /// Who draws it.
    pub(crate) fn crew(&self) -> Option<Crew> {
        self.slab.as_ref()?.regions.as_ref().map(Regions::crew)
    }

    /// Cuts the whole depth into regions.
    fn begin_regions(&mut self, cluster: &mut Cluster, clock: &dyn Clock) {
        let began = clock.now();
        let (cut, regions, outlines) = Regions::cut(
            &self.job,
            (self.beside, self.alone),
            (cluster.link_use.rate(), cluster.link_use.binds_alone()),
            &cluster.roster,
            &mut cluster.history,
        );
        // Who draws alone has drawn all that was drawn.
        let several = cluster.roster.active().nth(1).is_some();
        let ahead = several && cluster.link_use.has_room(self.alone);
        let owner = |place| regions.owner(place);
        self.outlook = ahead.then(|| TileOwnerGrid::new(self.job.view.size, &cut, owner));
        self.outlines = ahead.then_some(outlines);
        self.put_on(cluster, began, cut, (Vec::new(), Vec::new()), Some(regions));
        self.ledger.cull_us += clock.now().saturating_sub(began);
    }

    /// Whether bricks may still be sent ahead ([`Self::foresee`]).
    pub(crate) fn foresees(&self) -> bool {
        self.outlines.is_some()
    }

    /// Sends what was drawn from lately to those over whose tiles it lies now. Nobody waits for it:
    /// it comes after the frame's first leases.
    pub(crate) fn foresee(&mut self, cluster: &mut Cluster, now: Micros) {
        let set = self.job.scene.bricks;
        let outlines = self.outlines.take().filter(|_| self.slab.is_some());
        let (Some(outlines), Some(outlook)) = (outlines, &self.outlook) else { return };
        let presence = cluster.residency.presence(set, self.alone);
        let (Some(presence), Some(blocks)) = (presence, cluster.history.blocks_of(set)) else {
            return;
        };
        let lacked = outlook.lacked(&presence, (blocks, &outlines), outline(&self.job));
        for id in cluster.residency.queue_prefetch(set, lacked) {
            carry(cluster, Some(&mut self.ledger), id, now);
        }
    }

    /// What was drawn from for the first time for long goes to those over whose tiles of this frame
    /// it lies, when they are told something anyway.
    pub(crate) fn foresee_fresh(&self, cluster: &mut Cluster, fresh: &[u32]) {
        let set = self.job.scene.bricks;
        let Some(outlook) = self.outlook.as_ref().filter(|_| self.slab.is_some()) else { return };
        let Some(presence) = cluster.residency.presence(set, self.alone) else { return };
        let lacked = outlook.lacked_among(&presence, fresh, outline(&self.job));
        cluster.residency.queue_prefetch(set, lacked);
    }

    /// Culls bricks, cuts the slab into macrotiles and sorts them.
    fn begin_slab(&mut self, cluster: &mut Cluster, clock: &dyn Clock) {
        let began = clock.now();
        let sheets = self.slabs[self.at];
        let cull = self.job.scene.quality.cull;
        let (mut needed, mut rects) = (Vec::new(), Vec::new());
        for (i, projected) in self.projected.iter().enumerate() {
            let Some(p) = projected.filter(|p| p.sheets.overlaps(sheets)) else { continue };
            if cull && self.shut.all_shut(&p.rect) {
                self.ledger.counters.culled += u64::from(self.job.bricks[i].voxels);
                continue;
            }
            note_needed(&mut self.needed_ever, &mut self.needed, &self.job, i);
            needed.push(i as u32);
            rects.push(p.rect);
        }
        let work = &self.job.work;
        let wanted = (work.tiles_per_worker * cluster.roster.threads() as f64).ceil() as u64;
        // A slab without bricks has no best level; the coarsest tells it shortest.
        let forced = work.tile.or(needed.is_empty().then_some(LEAF << (LEVELS - 1)));
        let size = self.job.view.size;
        let cut = if cluster.config.mixed {
            let whole = cluster.roster.threads() as usize;
            macrotile::cut_mixed(size, &rects, &self.shut, cull, (wanted, forced), whole)
        } else {
            macrotile::cut(size, &rects, &self.shut, cull, wanted, forced)
        };
        cluster.residency.begin_slab(&needed);
        self.put_on(cluster, began, cut, (needed, rects), None);
        self.ledger.cull_us += clock.now().saturating_sub(began);
    }

    /// Queues a cut's tiles. With the bricks that they need, and their rectangles.
    fn put_on(
        &mut self,
        cluster: &mut Cluster,
        began: Micros,
        cut: Cut,
        (needed, rects): (Vec<u32>, Vec<Rect>),
        regions: Option<Regions>,
    ) {
        let mut order: Vec<(u32, u32)> =
            needed.iter().zip(&rects).filter_map(|(&i, r)| Some((cut.first_in(r)?, i))).collect();
        order.sort_unstable();
        let queue = TaskQueue::new(TaskId(cluster.next_task), &cut.tiles);
        // Of such that may be cut, in parts and then in pieces.
        let names = if self.alone { 2 * NAMES_PER_TILE as u64 } else { 1 };
        let names = names * cut.tiles.len() as u64;
        cluster.next_task += names;
        self.slab = Some(Slab {
            sheets: self.slabs[self.at],
            began,
            cut,
            queue,
            needed,
            rects,
            order: order.into_iter().map(|(_, i)| i).collect(),
            regions,
            served: BTreeSet::new(),
            changes: None,
            orphaned: false,
            dry: BTreeMap::new(),
            pieces: Vec::new(),
            names,
            handing: BTreeMap::new(),
            roots: BTreeMap::new(),
            split_groups: BTreeMap::new(),
        });
    }

    /// The barrier: the picture moves on to the next slab.
    fn end_slab(&mut self, cluster: &Cluster, now: Micros) {
        let slab = self.slab.take().expect("a slab that ends has begun");
        if slab.regions.is_none() {
            self.state.end_slab();
            self.shut.refresh();
        }
        // What was given away of a tile is told as the tile's.
        let whole = slab.whole_tiles();
        let tile = |(task, place): (&crate::state::task_queue::Task, u32)| {
            let (worker, us) = match &task.end {
                End::Done { worker, render_us } => (worker.to_string(), *render_us),
                End::Open | End::Poisoned | End::Cut => (String::new(), 0),
            };
            let (rect, est, more) =
                whole.get(&place).copied().unwrap_or((task.tile.rect, task.tile.est, 0));
            TileStats {
                x: rect.x0 as u32,
                y: rect.y0 as u32,
                size: slab.cut.edge_of(&rect),
                est,
                ms: ms(us + more),
                worker,
            }
        };
        let mut waited = 0;
        // Regions have no barrier: threads go on with the next frame.
        if !slab.queue.tasks.is_empty() && slab.regions.is_none() {
            for (id, worker) in cluster.roster.active() {
                let mut busy = 0;
                for (_, end) in slab.dry.range((id, 0)..=(id, u32::MAX)) {
                    busy += 1;
                    waited += now.saturating_sub((*end).max(slab.began));
                }
                let idle = u64::from(worker.threads).saturating_sub(busy);
                waited += idle * now.saturating_sub(slab.began.max(worker.since));
            }
        }
        self.ledger.end_phase(&slab.pieces, slab.began);
        self.ledger.retries += slab.queue.retries;
        let tasks = slab.queue.tasks.iter().zip(0..);
        let told = tasks.filter(|(t, at)| t.end != End::Cut && !slab.is_told_elsewhere(*at));
        let mut tiles: Vec<TileStats> = told.map(tile).collect();
        // Parts that were cut late stand behind all others.
        tiles.sort_by_key(|t| std::cmp::Reverse(t.est));
        self.ledger.slabs.push(SlabStats {
            tiles,
            empty: slab.cut.empty,
            shut: slab.cut.shut,
            barrier_wait_ms: ms(waited),
        });
        self.ledger.spans.push(Span {
            name: format!("slab {}", self.at),
            category: "slab",
            worker: None,
            thread: 0,
            start: slab.began,
            end: now,
            args: vec![
                ("tiles", slab.queue.all().to_string()),
                ("edge", slab.cut.edge.to_string()),
                ("bricks", slab.needed.len().to_string()),
            ],
        });
        self.at += 1;
        if self.at == self.slabs.len() {
            self.ended = Some(now);
        }
    }

    /// Takes back a lease that its worker answered. `None`: it has no such lease.
    fn take_answered(
        &mut self,
        cluster: &mut Cluster,
        worker: WorkerId,
        task: TaskId,
        epoch: Epoch,
    ) -> Option<Lent> {
        let lent = self.lent.get_mut(worker)?;
        let at = lent.iter().position(|l| l.task == task && l.epoch == epoch)?;
        let lent = lent.remove(at);
        if !lent.bricks.is_empty() {
            cluster.residency.unpin(worker, &lent.bricks);
        }
        cluster.roster.end_leases(worker, 1);
        Some(lent)
    }

    /// Whether a worker has this lease of it, or had.
    pub(crate) fn has_lent(&self, worker: WorkerId, task: TaskId, epoch: Epoch) -> bool {
        let lent = self.lent.get(worker).into_iter().flatten();
        lent.into_iter().any(|l| l.task == task && l.epoch == epoch)
    }

    /// A result came. An error is the worker's lie. When its tile was rendered, if it counts.
    pub(crate) fn result(
        &mut self,
        cluster: &mut Cluster,
        worker: WorkerId,
        result: TileResult,
        clock: &dyn Clock,
    ) -> Result<Option<(Micros, Micros)>, String> {
        let now = clock.now();
        let before = self.answered.insert(worker, now).unwrap_or(0);
        let lent = self.take_answered(cluster, worker, result.task, result.epoch);
        let verdict = match &self.slab {
            Some(slab) if lent.is_some() => slab.queue.judge(result.task, result.epoch, worker),
            _ => Verdict::Dead,
        };
        let Verdict::Counts(place, lease) = verdict else {
            cluster.totals.dropped_results += 1;
            if result.task >= self.first_task {
                self.ledger.dropped_results += 1;
            }
            return Ok(None);
        };
        let slab = self.slab.as_mut().expect("a lease that counts is of this slab");
        let tile = slab.cut.tiles[place as usize].rect;
        let cost = slab.regions.as_ref().and(result.region.as_ref());
        let bricks = self.job.bricks.len();
        let finish = finish_of(&self.job);
        let checked = match &result.pixels {
            Pixels::Sums(sums) => check(tile, sums, finish),
            Pixels::Finished(leaves) => check_leaves(tile, leaves, finish),
        };
        if let Err(lie) = checked.and_then(|()| check_cost(cost, tile, bricks)) {
            // Its other leases go back when it is dropped; this one it has just answered.
            let given_up =
                slab.queue.lose(worker, "", &[(place, result.epoch)], 0, &cluster.config);
            self.give_up(given_up);
            return Err(lie);
        }

        match result.pixels {
            Pixels::Finished(leaves) => {
                self.state.place_encoded(tile, leaves);
                if self.state.encoded_tiles().len() >= LAID_TOGETHER {
                    let (frame, tiles) = (self.job.frame, self.state.take_encoded());
                    cluster.out.push_back(Action::Finished { frame, tiles });
                }
            }
            Pixels::Sums(sums) if slab.regions.is_some() => self.state.place_sums(tile, sums),
            Pixels::Sums(sums) => {
                let width = self.job.view.size[0] as usize;
                let eps = self.job.scene.quality.eps;
                let rows = sums.a.chunks(tile.width()).zip(tile.y0..);
                for (row, y) in rows.filter(|_| eps > 0.0) {
                    for (&a, x) in row.iter().zip(tile.x0..) {
                        if is_shut(a, eps) {
                            self.shut.shut(y as usize * width + x as usize);
                        }
                    }
                }
                self.state.add_slab_tile(tile, &sums);
            }
        }
        self.any_result = true;
        self.ledger.add_result_bytes(result.bytes);
        self.ledger.composite_us += clock.now().saturating_sub(now);

        let who = cluster.roster.get(worker).expect("a worker whose result came is known");
        let r = place_in_time(who, &result.times, lease.sent, now);
        let lasted = now.saturating_sub(lease.sent.max(before));
        self.pace.note(slab.cut.tiles[place as usize].est, r.end - r.start, lasted);
        self.ledger.add_rendering(worker, &r, &result.counters);
        let thread = result.times.thread.min(who.threads - 1);
        if slab.regions.is_none() {
            let dry = slab.dry.entry((worker, thread)).or_insert(r.end);
            *dry = r.end.max(*dry);
        }
        let Rendered { start, end, .. } = r;
        slab.pieces.push(RenderedTile {
            corner: [tile.x0, tile.y0],
            edge: slab.cut.edge_of(&tile),
            thread: (worker, thread),
            lacked_bricks_us: result.times.ready_us.saturating_sub(result.times.received_us),
            start,
            end,
            arrived: now,
        });
        let mut drawn_from = lent.map_or(0, |l| l.bricks.len());
        if let Some(cost) = cost {
            drawn_from = cost.touched.len();
            for &i in &cost.touched {
                note_needed(&mut self.needed_ever, &mut self.needed, &self.job, i as usize);
            }
            self.ledger.add_region_cost(worker, cost);
            let set = self.job.scene.bricks;
            cluster.residency.mark_used(set, &cost.touched, &mut cluster.fresh);
        }
        slab.handing.remove(&place);
        let touched = cost.map_or(&[][..], |cost| &cost.touched[..]);
        let drawn = slab.drawn(place, end - start, touched);
        if let Some(regions) = &slab.regions {
            let mut learn = |place, tile: &Rect, owner, us, touched: &[u32]| {
                cluster.history.learn(regions, (place, tile), owner, us, touched);
            };
            match &drawn {
                Drawn::Whole(root, group) => {
                    let (us, touched) = group.cost();
                    learn(*root, &group.tile, group.owner, us, touched);
                }
                Drawn::Itself if cost.is_some() => {
                    learn(place, &tile, worker, end - start, touched);
                }
                Drawn::Itself | Drawn::InPart => {}
            }
        }
        self.ledger.spans.tile(spans::Tile {
            corner: [tile.x0, tile.y0],
            worker: who.name.clone(),
            thread,
            start,
            end,
            slab: self.at,
            edge: slab.cut.edge_of(&tile),
            est: slab.cut.tiles[place as usize].est,
            bricks: drawn_from,
            attempt: result.epoch.0,
        });
        slab.queue.finish(place, End::Done { worker: who.name.clone(), render_us: end - start });
        self.progress(cluster);
        Ok(Some((start, end)))
    }

    pub(crate) fn progress(&self, cluster: &mut Cluster) {
        let Some(slab) = &self.slab else { return };
        let total = slab.queue.all();
        cluster.out.push_back(Action::Progress {
            frame: self.job.frame,
            done: total - slab.queue.open(),
            total,
            slab: self.at as u32,
            slabs: self.slabs.len() as u32,
        });
    }

    /// A worker can't do a task.
    pub(crate) fn failed(
        &mut self,
        cluster: &mut Cluster,
        worker: WorkerId,
        task: TaskId,
        epoch: Epoch,
        reason: String,
    ) {
        if self.take_answered(cluster, worker, task, epoch).is_none() {
            return;
        }
        let Some(slab) = &mut self.slab else { return };
        let Verdict::Counts(place, _) = slab.queue.judge(task, epoch, worker) else { return };
        let name = cluster.roster.get(worker).map_or("", |w| &w.name);
        slab.handing.remove(&place);
        let given_up = slab.queue.fail(place, epoch, worker, name, reason, &cluster.config);
        self.give_up(given_up);
        self.progress(cluster);
    }

    /// These tasks are given up: their pixels stay as the slabs before left them.
    pub(crate) fn give_up(&mut self, places: Vec<u32>) {
        for place in places {
            let slab = self.slab.as_mut().expect("a task that is given up is of this slab");
            slab.queue.finish(place, End::Poisoned);
            let task = &slab.queue.tasks[place as usize];
            let rect = task.tile.rect;
            let mut workers: Vec<String> = task.blamed.iter().map(|(_, n)| n.clone()).collect();
            workers.extend(task.failed.iter().map(|(_, n, _)| n.clone()));
            let mut reasons: Vec<String> = Vec::new();
            if !task.blamed.is_empty() {
                reasons.push(format!("{} workers were lost with it", task.blamed.len()));
            }
            reasons.extend(task.failed.iter().map(|(_, n, reason)| format!("{n}: {reason}")));
            let reason = reasons.join("; ");
            self.ledger.poisoned.push(PoisonedTile {
                slab: self.at as u32,
                x: rect.x0 as u32,
                y: rect.y0 as u32,
                size: slab.cut.edge_of(&rect),
                workers: workers.clone(),
            });
            self.ledger.spans.push(Span {
                name: format!("{},{} given up", rect.x0, rect.y0),
                category: "tile",
                worker: None,
                thread: 0,
                start: slab.began,
                end: slab.began,
                args: vec![("workers", workers.join(", ")), ("reason", reason.clone())],
            });
            self.last_reason = format!(
                "no tile could be rendered; tile {},{} of slab {}: {reason}",
                rect.x0, rect.y0, self.at,
            );
        }
    }

    /// A worker came.
    pub(crate) fn joined(&mut self, cluster: &Cluster, id: WorkerId, now: Micros) {
        if let Some(worker) = cluster.roster.get(id) {
            self.ledger.open_account(id, worker, now);
        }
    }

    /// Leases of this slab that a worker has, in the order in which it got them, and how many of
    /// them it is probably running.
    fn probably(&self, id: WorkerId, threads: u32) -> (Vec<(u32, Epoch)>, usize) {
        let Some(slab) = &self.slab else { return (Vec::new(), 0) };
        let mut running = 0;
        let mut leases = Vec::new();
        for (i, lent) in self.lent.get(id).into_iter().flatten().enumerate() {
            if let Some(place) = slab.queue.place(lent.task) {
                leases.push((place, lent.epoch));
                running += usize::from(i < threads as usize);
            }
        }
        (leases, running)
    }

    /// A worker leaves when it has done what it has begun.
    pub(crate) fn leaving(&mut self, id: WorkerId, threads: u32) {
        let (leases, running) = self.probably(id, threads);
        if let Some(slab) = &mut self.slab {
            let not_begun: Vec<_> = leases[running..].iter().map(|l| l.0).collect();
            slab.queue.share_queued(&not_begun);
        }
    }

    /// A worker is gone. `blame` says whether a task may have killed it; as many as it had
    /// `threads` for were probably running. The caller has not taken its bricks off the books yet.
    pub(crate) fn lost(
        &mut self,
        cluster: &mut Cluster,
        id: WorkerId,
        worker: &crate::state::workers::Worker,
        (blame, threads): (bool, u32),
        now: Micros,
    ) {
        // A frame that is done and waits for one before it is over.
        let now = self.ended.unwrap_or(now);
        let (leases, running) = self.probably(id, threads);
        self.lent.remove(id);
        self.told.remove(&id);
        if let Some(transfer) = cluster.residency.transfer(id) {
            self.ledger.transfer_ended(id, transfer, now);
        }
        self.ledger.close_account(id, now);
        if let Some(slab) = &mut self.slab {
            slab.handing.retain(|_, (asked, _)| *asked != id);
            let running = if blame { running } else { 0 };
            let given_up = slab.queue.lose(id, &worker.name, &leases, running, &cluster.config);
            self.give_up(given_up);
        }
    }

    /// Bricks to a worker were under way until now.
    pub(crate) fn landed(&mut self, id: WorkerId, transfer: Transfer, now: Micros) {
        self.ledger.transfer_ended(id, transfer, now);
    }

    /// Time went on.
    pub(crate) fn tick(&mut self, now: Micros) {
        if let Some(slab) = &mut self.slab {
            slab.queue.requeue_overdue(now);
        }
    }

    /// The next lease deadline.
    pub(crate) fn next_deadline(&self) -> Option<Micros> {
        // A frame that is done and waits for one before it has none.
        let slab = self.slab.as_ref()?;
        let waits = [self.outlived, self.forborne, self.pieces_at].into_iter().flatten();
        slab.queue.next_deadline().into_iter().chain(waits).min()
    }

    /// Leases that a worker has.
    pub(crate) fn leases(&self, id: WorkerId) -> u32 {
        self.lent.get(id).map_or(0, |l| l.len() as u32)
    }

    /// The frame is over, in whatever way: workers forget it.
    pub(crate) fn end(&mut self, cluster: &mut Cluster) {
        let mut busy = BTreeSet::new();
        for (id, lent) in std::mem::take(&mut self.lent) {
            if cluster.roster.get(id).is_some() && !lent.is_empty() {
                cluster.roster.end_leases(id, lent.len() as u64);
                busy.insert(id);
            }
            for lent in lent.iter().filter(|l| !l.bricks.is_empty()) {
                cluster.residency.unpin(id, &lent.bricks);
            }
        }
        cluster.residency.clear_wanted();
        let frame = self.job.frame;
        for id in std::mem::take(&mut self.told) {
            if busy.contains(&id) {
                cluster.send(id, ToWorker::EndFrame { frame });
            } else if let Some(w) = cluster.roster.get_mut(id) {
                // Nothing hangs on it: it need not be woken for this.
                w.over.push(frame);
            }
        }
    }

    /// The finished picture with what it cost.
    pub(crate) fn finish(mut self, cluster: &mut Cluster, now: Micros) -> Action {
        let now = self.ended.unwrap_or(now);
        for (id, transfer) in cluster.residency.split_transfers(now) {
            if transfer.since < now {
                self.ledger.transfer_ended(id, transfer, now);
            }
        }
        for (id, _) in cluster.roster.iter() {
            self.ledger.set_held(id, cluster.residency.held_of_set(id, self.job.scene.bricks));
        }
        let mut bricks =
            BrickStats { relevant: self.job.bricks.len() as u64, ..BrickStats::default() };
        (bricks.needed, bricks.needed_voxels) = self.needed;
        let relevant = self.relevant;
        let quality = self.job.scene.quality;
        let schedule = if self.by_region() { Schedule::Region } else { Schedule::Slab };
        let (stats, spans) =
            self.ledger.close(self.job.number, schedule, quality, relevant, bricks, now);
        let frame = self.job.frame;
        Action::FrameDone { frame, state: Box::new(self.state), stats: Box::new(stats), spans }
    }
}

/// Sends a worker what it is to be sent, and tells it what to drop.
pub(crate) fn carry(
    cluster: &mut Cluster,
    mut ledger: Option<&mut Ledger>,
    id: WorkerId,
    now: Micros,
) {
    let roster = &mut cluster.roster;
    let mut grounded = cluster.residency.transfer(id).is_none();
    let actions = cluster.residency.flush(id, now, &mut || roster.ping(id, now));
    for action in actions {
        match action {
            ResidencyAction::Drop { set, bricks, nonce } => {
                cluster.send(id, ToWorker::DropBricks { set, bricks });
                cluster.send(id, ToWorker::Ping { nonce });
            }
            ResidencyAction::Send { set, bricks, bytes, over_budget } => {
                cluster.link_use.leave(bytes, std::mem::take(&mut grounded), now);
                if let Some(ledger) = &mut ledger {
                    ledger.bricks_sent(id, bricks.len() as u64, bytes);
                }
                cluster.totals.over_budget += u64::from(over_budget);
                cluster.out.push_back(Action::SendBricks { worker: id, set, bricks });
            }
        }
    }
}

/// Where each brick lies in a frame's picture.
fn outline(job: &FrameJob) -> impl Fn(u32) -> Option<Rect> {
    |place| job.view.project_rect(&job.bricks[place as usize].tight)
}

/// Whether what a stranger says of a region can be counted.
fn check_cost(cost: Option<&RegionCost>, tile: Rect, bricks: usize) -> Result<(), String> {
    let sampled =
        cost.map_or(0, |c| c.sampled.to_array().map(|s| s.pixels).into_iter().max().unwrap_or(0));
    if sampled as usize > tile.area() {
        let (n, area) = (sampled, tile.area());
        return Err(format!("a result sampled {n} pixels of a tile of {area}"));
    }
    let beyond = cost.and_then(|c| c.touched.iter().max()).filter(|&&i| i as usize >= bricks);
    match beyond {
        Some(i) => Err(format!("a result touched brick {i} of {bricks}")),
        None => Ok(()),
    }
}

/// A brick of a frame is needed: once each is counted.
fn note_needed(ever: &mut [bool], needed: &mut (u64, u64), job: &FrameJob, place: usize) {
    if !std::mem::replace(&mut ever[place], true) {
        *needed = (needed.0 + 1, needed.1 + u64::from(job.bricks[place].voxels));
    }
}

/// What the results of a frame's tasks are finished to.
pub(crate) fn finish_of(job: &FrameJob) -> Option<PixelEncoding> {
    job.finish.filter(|_| goes_by_region(job))
}

/// Whether a stranger's finished pixels are those of a tile.
fn check_leaves(
    tile: Rect,
    leaves: &SparseTile,
    finish: Option<PixelEncoding>,
) -> Result<(), String> {
    let Some(finish) = finish else {
        return Err("a result is finished where sums were asked for".into());
    };
    if leaves.format != finish.format {
        return Err(format!("a result in {:?}, its frame in {:?}", leaves.format, finish.format));
    }
    let [w, h] = leaves.size;
    if [w as usize, h as usize] != [tile.width(), tile.height()] {
        return Err(format!(
            "a result of {w}x{h} pixels, its tile has {}x{}",
            tile.width(),
            tile.height()
        ));
    }
    // In one sentence, whatever it is: a record says no more either.
    leaves.check().map_err(|_| "a result's leaves do not fit each other".into())
}

/// Whether a stranger's pixels are those of a tile.
pub(crate) fn check(
    tile: Rect,
    pixels: &TilePixels,
    finish: Option<PixelEncoding>,
) -> Result<(), String> {
    if finish.is_some() {
        return Err("a result has sums where finished pixels were asked for".into());
    }
    let n = tile.area();
    let plane = |name: &str, len: usize| {
        if len == n {
            Ok(())
        } else {
            Err(format!("a result's {name} plane has {len} pixels, its tile {n}"))
        }
    };
    plane("a", pixels.a.len())?;
    plane("colour", pixels.colour.len())?;
    if let Some(last) = &pixels.last {
        plane("last", last.len())?;
    }
    if !pixels.a.iter().all(|a| a.is_finite()) {
        return Err("a result's a plane has a number that is not finite".into());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_is_shut_below_eps_and_not_at_it() {
        let eps = 1.0 / 512.0;
        assert!(!is_shut(511.0 / 512.0, eps), "transmittance is eps");
        assert!(is_shut((511.0f32 / 512.0).next_up(), eps));
        assert!(!is_shut(1.0, 0.0) && !is_shut(2.0, 0.0), "0 shuts nothing");
        assert!(!is_shut(f32::NAN, eps));
    }

    #[test]
    fn results_of_a_mad_clock_stay_between_lease_and_arrival() {
        let mut roster = crate::state::workers::Roster::default();
        roster.join(WorkerId(1), "mad".into(), (1, false), 0);
        let worker = roster.get(WorkerId(1)).expect("it joined");
        for (start_us, end_us) in [(0, u64::MAX), (u64::MAX, 0), (5, 6), (7, 7)] {
            let times = slabcast_common::message::TaskTimes {
                received_us: u64::MAX / 2,
                ready_us: 0,
                start_us,
                end_us,
                thread: 9,
            };
            let r = place_in_time(worker, &times, 100, 300);
            assert!(100 <= r.start && r.start <= r.end && r.end <= 300, "{r:?}");
            assert!(r.p2p_us <= 200);
        }
    }
}
