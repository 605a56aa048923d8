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
//! Under the `region` schedule it is one slab through all depths of which the master knows nothing but
//! where something may be seen: `region` cuts it and shares it out, workers cull it and ask for bricks.
//! Leases, results, stragglers and the lost are the same, and so is the code. Several such frames may
//! be in the making at a time; what a worker has of the others comes as a [`Turn`].
//!
//! A frame waits, with nothing lost, while there is no worker. It refuses to know who is silent
//! (`roster`), which copy of a result counts (`queue`) and where bricks are (`residency`).

use crate::borders;
use crate::critical::Piece;
use crate::crowd::Crowd;
use crate::ledger::{Ledger, Rendered, ms, place_in_time};
use crate::macrotile::{self, Cut, LEAF, LEVELS};
use crate::queue::{End, PARTS, Queue, Verdict};
use crate::region::{Crew, Regions};
use crate::residency::{Errand, Flight};
use crate::{Action, Clock, Cluster, FrameJob, Micros, Span, spans};
use handover::Family;
use slabcast_common::brick::BrickGrid;
use slabcast_common::ids::{BrickId, Epoch, TaskId, WorkerId};
use slabcast_common::image::{FrameState, TilePixels};
use slabcast_common::leaves::{Finish, Leaves};
use slabcast_common::message::{Lease, Pixels, RegionCost, RegionLease, TileResult, ToWorker};
use slabcast_common::occlusion::{Rect, ShutMap};
use slabcast_common::quality::Schedule;
use slabcast_common::slab::SheetRange;
use slabcast_common::stats::{BrickStats, PoisonedTile, SlabStats, TileStats};
use slabcast_common::view::Projected;
use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

mod handover;
mod late;

/// Whether a pixel with accumulated opacity `a` is shut for good.
///
/// The renderer makes the same test after each sheet, in the same f32 arithmetic; a master that
/// shut a pixel the renderer holds open would change bytes.
#[inline]
pub fn is_shut(a: f32, eps: f64) -> bool {
    eps > 0.0 && (1.0f32 - a) < eps as f32
}

/// A lease that a worker has and has not answered; perhaps dead.
#[derive(Debug)]
struct Lent {
    task: TaskId,
    epoch: Epoch,
    sent: Micros,
    /// Places of its bricks.
    bricks: Vec<u32>,
}

/// A worker is lent so much ahead of its own, in microseconds a thread: what is known to be short leaves
/// together, and none waits for a lease between two. Others can't take what is lent, so what takes long is
/// lent when it is needed. Of mri256 at 512x512 a simulated frame of 2, 4 and 15 workers takes 24.3, 13.4
/// and 5.3 ms at 1.5 ms, and 23.2, 13.0 and 5.1 at this; threads wait less often, and fewer tiles move.
const HORIZON: f64 = 4_000.0;

/// The same at the end of a frame that is alone, which is there when the last worker is done: what waits here others can
/// draw. mri256 `peer-semi` at 1536x1536 takes 43.6, 21.7 and 12.3 ms a frame on 15, 32 and 64 workers at four times as much, and
/// 43.1, 21.5 and 12.1 at this (`plan`, one in flight).
const HORIZON_ALONE: f64 = 1_000.0;

/// Who draws by itself is lent so many times as much, and as many more leases: nobody else could take them, and where it
/// has few tiles that lack bricks it has others meanwhile. One worker takes 13.25 ms for a frame of mri256 at 512x512 without, and
/// 12.75 with this (`plan`, one in flight, no limit; 14.1 and 12.8 at 1 Gbit/s).
const SOLE: u64 = 4;

/// While a worker has so much of that left, and a lease beyond those that its threads draw, it is lent no more: each
/// lending wakes it, which takes as long as a tenth of a small tile, and three tiles in one message are as
/// quickly there as one. At half the horizon a message takes what is drawn in 2 ms, and a latency of one would
/// not leave a thread dry.
const REFILL: f64 = 0.5;

/// Leases that a thread has at most, however short they are: a stranger's clock says how short.
const MOST_AHEAD: u64 = 8;

/// What a thread is lent ahead at most: in microseconds, and in leases.
#[derive(Clone, Copy)]
pub(crate) struct Ahead {
    us: f64,
    /// Of a frame that is alone.
    alone_us: f64,
    leases: u64,
}

impl Ahead {
    pub(crate) fn of(roster: &crate::Roster) -> Ahead {
        let sole = roster.staying().nth(1).is_none();
        let times = if sole { SOLE } else { 1 };
        let us = times as f64 * HORIZON;
        let alone_us = if sole { us } else { HORIZON_ALONE };
        Ahead { us, alone_us, leases: times * MOST_AHEAD }
    }

    /// Of how much that is left a worker of so many threads is lent no more ([`REFILL`]).
    pub(crate) fn refill(self, threads: u64) -> f64 {
        REFILL * self.us * threads as f64
    }
}

/// The slab that is being rendered.
#[derive(Debug)]
struct Slab {
    sheets: SheetRange,
    began: Micros,
    cut: Cut,
    queue: Queue,
    /// Places of the needed bricks, ascending, and their rectangles.
    needed: Vec<u32>,
    rects: Vec<Rect>,
    /// Needed bricks in the order in which the queue's tiles come to them.
    order: Vec<u32>,
    /// Whose its tiles are, under the `region` schedule.
    regions: Option<Regions>,
    /// Workers that the slab's bricks were queued for.
    served: BTreeSet<WorkerId>,
    /// [`Roster::changes`](crate::roster::Roster::changes) up to which it was looked at.
    changes: Option<u64>,
    /// Whether some of its owners took no leases then.
    orphaned: bool,
    /// End of each render thread's last task; not of regions, which have no barrier.
    dry: BTreeMap<(WorkerId, u32), Micros>,
    /// Tiles that counted.
    pieces: Vec<Piece>,
    /// Names that its tasks may have.
    names: u64,
    /// Regions of which their worker was asked for a piece, by their places.
    handing: BTreeMap<u32, (WorkerId, Micros)>,
    /// The tile that each piece is of which was given away, and such tiles whose tasks are not all drawn.
    roots: BTreeMap<u32, u32>,
    families: BTreeMap<u32, Family>,
}

impl Slab {
    fn bricks_of(&self, place: u32) -> Vec<u32> {
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
    beside: Option<u32>,
    /// Whether no other was in the making or waited when it began.
    alone: bool,
    projected: Vec<Option<Projected>>,
    slabs: Vec<SheetRange>,
    at: usize,
    state: FrameState,
    shut: ShutMap,
    slab: Option<Slab>,
    /// When its last slab ended.
    ended: Option<Micros>,
    first_task: TaskId,
    /// Workers that were sent the frame's view.
    told: BTreeSet<WorkerId>,
    lent: Crowd<Vec<Lent>>,
    /// When each worker answered last.
    answered: Crowd<Micros>,
    pace: Pace,
    /// When the next task outlives its estimate, while a thread is idle.
    outlived: Option<Micros>,
    /// When the next region may be taken from an owner that is silent, while a thread is idle.
    forborne: Option<Micros>,
    /// When a region that takes longer than it was to is late enough to be cut, while a thread is idle.
    pieces_at: Option<Micros>,
    /// Parts of tiles that were cut late, and who is to have them: what they were drawn from goes along.
    gained: Vec<(WorkerId, u32)>,
    needed_ever: Vec<bool>,
    /// Bricks among them, and their voxels.
    needed: (u64, u64),
    /// Voxels of all bricks.
    relevant: u64,
    any_result: bool,
    last_reason: String,
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

/// What the other frames in the making mean to one.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Turn {
    /// No frame comes after it whose tasks could keep idle threads busy at its end.
    pub(crate) last: bool,
    /// Threads may take what is another worker's.
    pub(crate) others: bool,
    /// Only this worker's threads can have come free since the frame was asked last.
    pub(crate) only: Option<WorkerId>,
}

/// Whether a frame is rendered under the `region` schedule. `auto` is that, always: where nothing hides
/// anything it needs as many bricks as the other and has no barriers.
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
            borders::slabs(view, &projected, &|i| job.bricks[i].voxels, &job.work)
        };
        cluster.residency.open(job.scene.bricks, &job.bricks, by_region);
        let mut ledger = Ledger::new(began);
        for (id, worker) in cluster.roster.iter() {
            ledger.enrol(id, worker, began);
        }
        let mut frame = Frame {
            slabs,
            at: 0,
            state: FrameState::new(view.size),
            // Regions shut their pixels at the workers.
            shut: ShutMap::open(Rect::of_size(if by_region { [0; 2] } else { view.size })),
            slab: None,
            ended: None,
            first_task: TaskId(cluster.next_task),
            told: BTreeSet::new(),
            lent: Crowd::default(),
            answered: Crowd::default(),
            pace: Pace::default(),
            outlived: None,
            forborne: None,
            pieces_at: None,
            gained: Vec::new(),
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
    pub(crate) fn step(&mut self, cluster: &mut Cluster, turn: Turn, clock: &dyn Clock) -> Step {
        loop {
            match &self.slab {
                Some(slab) if slab.queue.open() > 0 => {
                    self.dispatch(cluster, turn, clock.now());
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
        let (cut, regions) = Regions::cut(
            &self.job,
            (self.beside, self.alone),
            (cluster.traffic.rate(), cluster.traffic.binds_alone()),
            &cluster.roster,
            &mut cluster.memory,
        );
        self.put_on(cluster, began, cut, (Vec::new(), Vec::new()), Some(regions));
        self.ledger.cull_us += clock.now().saturating_sub(began);
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
        cluster.residency.round(&needed);
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
        let queue = Queue::new(TaskId(cluster.next_task), &cut.tiles);
        // Of such that may be cut, in parts and then in pieces.
        let names = if self.alone { 2 * PARTS as u64 } else { 1 };
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
            families: BTreeMap::new(),
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
        let tile = |(task, place): (&crate::queue::Task, u32)| {
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
            for (id, worker) in cluster.roster.staying() {
                let mut busy = 0;
                for (_, end) in slab.dry.range((id, 0)..=(id, u32::MAX)) {
                    busy += 1;
                    waited += now.saturating_sub((*end).max(slab.began));
                }
                let idle = u64::from(worker.threads).saturating_sub(busy);
                waited += idle * now.saturating_sub(slab.began.max(worker.since));
            }
        }
        self.ledger.phase(&slab.pieces, slab.began);
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

    /// Lends tasks to free threads, and sends bricks.
    ///
    /// First every thread gets a task, round robin. Then tasks are lent ahead, so that a thread
    /// need not wait for a round trip between two (TRANSPORT.md: two in flight a thread hide
    /// the latency of 64x64 tiles), but not the last ones, as many as there are threads: those
    /// go one by one to whoever runs dry, since a task that waits behind another on one worker
    /// can't be taken by an idle one. Where another frame comes after, nothing is held back.
    ///
    /// Of regions a worker gets its own, at the end of the last frame as much as [`HORIZON`] says; those
    /// of others only when it is their turn, and then only threads that are dry.
    fn dispatch(&mut self, cluster: &mut Cluster, turn: Turn, now: Micros) {
        let by_region = self.by_region();
        let mut leases = match (by_region, turn.others) {
            (false, _) => self.choose(cluster, turn, now),
            (true, false) => self.choose_own(cluster, turn, now),
            (true, true) => self.choose_others(cluster, turn, now),
        };
        let pieces = match by_region && turn.others && turn.last {
            true => self.find_pieces(cluster, now),
            false => {
                self.pieces_at = None;
                Vec::new()
            }
        };
        // Nobody's estimate is outlived before the time that was found last.
        let known = by_region && turn.only.is_some() && self.outlived.is_some_and(|at| now < at);
        let may_double = (!by_region || turn.others) && !known && cluster.roster.any_dry();
        if !known {
            self.outlived = None;
        }
        while may_double && let Some((place, id)) = self.next_outlived(cluster, now) {
            let slab = self.slab.as_mut().expect("as before");
            let epoch = slab.queue.lend_again(place, id, now, &cluster.config);
            let lent = lend(cluster, slab, place, id, epoch, now);
            self.lent.or_default(id).push(lent);
            leases.push((id, place));
        }
        let slab = self.slab.as_mut().expect("as before");

        let changes = cluster.roster.changes();
        let mut newcomers = Vec::new();
        if slab.changes.replace(changes) != Some(changes) {
            let staying = cluster.roster.staying().map(|(id, _)| id);
            newcomers.extend(staying.filter(|id| !slab.served.contains(id)));
            let orphaning = slab.regions.as_ref().map(|r| r.orphaning(&cluster.roster));
            slab.orphaned = orphaning.is_some_and(|gone| !gone.is_empty());
        }
        for &id in &newcomers {
            slab.served.insert(id);
            if !cluster.residency.is_lazy(id) {
                cluster.residency.want(id, slab.order.iter().copied());
            }
        }
        let set = self.job.scene.bricks;
        if let Some(regions) = &slab.regions {
            // What a tile was drawn from goes with it.
            for &(id, place) in leases.iter().chain(&self.gained) {
                let tile = slab.cut.tiles[place as usize].rect;
                let Some(bricks) = cluster.memory.moving(regions, (place, &tile), id) else {
                    continue;
                };
                // Of a part whose whole tile was drawn then, what lies over the part; of a piece, what lies behind
                // what is drawn of it.
                let (part, job) = (regions.is_told(place), &self.job);
                let begun = slab.queue.tasks[place as usize].begun.as_ref();
                let from = begun.and_then(|begun| begun.sheets.iter().flatten().min());
                let over = |&i: &u32| {
                    let seen = job.view.project(&job.bricks[i as usize].tight);
                    let behind = |p: &Projected| from.is_none_or(|from| p.sheets.end > *from);
                    seen.is_some_and(|p| !p.rect.intersect(&tile).is_empty() && behind(&p))
                };
                let bricks = bricks.iter().copied().filter(|i| !part || over(i));
                cluster.residency.owe(id, set, bricks);
            }
        }
        let gained = std::mem::take(&mut self.gained);
        let moved = leases.iter().chain(&gained).map(|l| l.0);
        let to_flush: BTreeSet<_> = newcomers.into_iter().chain(moved).collect();
        // Of regions leases go first, lest they wait behind others' bricks: a region asks for what it lacks, and 64
        // workers that begin a frame are sent up to 19 MB.
        if !by_region {
            for &id in &to_flush {
                carry(cluster, Some(&mut self.ledger), id, now);
            }
        }
        // Each worker's leases of this round, in the order in which it got them.
        let mut count = BTreeMap::new();
        for (id, _) in &leases {
            *count.entry(*id).or_insert(0usize) += 1;
        }
        for (id, place) in leases {
            let left = count.get_mut(&id).expect("counted above");
            let lent = &self.lent[id];
            let lent = &lent[lent.len() - *left];
            *left -= 1;
            if self.told.insert(id) {
                let scene = &self.job.scene;
                let worker = cluster.roster.get_mut(id).expect("it was just lent a task");
                if worker.scenes.insert(scene.id) {
                    cluster.send(id, ToWorker::Scene(scene.clone()));
                }
                let view = self.job.view;
                let (frame, scene) = (self.job.frame, scene.id);
                let finish = finish_of(&self.job);
                let message = ToWorker::Frame { frame, scene, view, finish };
                cluster.send(id, message);
            }
            let tile = slab.cut.tiles[place as usize].rect;
            if slab.regions.is_some() {
                let worker = cluster.roster.get_mut(id).expect("it was just lent a task");
                if worker.lacks_directory(set) {
                    let (grid, bricks) = (self.job.scene.volume.lattice.dims, &self.job.bricks);
                    let message = ToWorker::Directory {
                        set,
                        grid: BrickGrid::of(grid),
                        first: 0,
                        total: bricks.len() as u32,
                        bricks: bricks.clone(),
                    };
                    cluster.send(id, message);
                }
                let (task, epoch, frame) = (lent.task, lent.epoch, self.job.frame);
                let estimate = self.job.work.estimate;
                let begun = slab.queue.tasks[place as usize].begun.clone();
                let lease = RegionLease { task, epoch, frame, tile, estimate, begun };
                cluster.send(id, ToWorker::Region(lease));
                continue;
            }
            let name = |&i: &u32| -> BrickId { self.job.bricks[i as usize].id };
            let lease = Lease {
                task: lent.task,
                epoch: lent.epoch,
                frame: self.job.frame,
                tile,
                slab: slab.sheets,
                bricks: lent.bricks.iter().map(name).collect(),
                state: self.state.tile(tile),
            };
            cluster.send(id, ToWorker::Lease(Box::new(lease)));
        }
        if by_region {
            for id in to_flush {
                carry(cluster, Some(&mut self.ledger), id, now);
            }
        }
        self.ask_for_pieces(cluster, pieces);
    }

    /// A waiting task for one worker goes to it.
    fn give(&mut self, cluster: &mut Cluster, place: u32, id: WorkerId, now: Micros) {
        let slab = self.slab.as_mut().expect("a slab that is dispatched has begun");
        let epoch = slab.queue.lease(place, id, now, &cluster.config);
        let lent = lend(cluster, slab, place, id, epoch, now);
        self.lent.or_default(id).push(lent);
        if let Some(regions) = &mut slab.regions {
            regions.moves(place, id);
        }
    }

    /// The first waiting task among some that a worker may have, if it suits it.
    fn next(
        &self,
        cluster: &Cluster,
        id: WorkerId,
        among: impl Fn(u32) -> bool,
        suits: impl Fn(u32) -> bool,
    ) -> Option<u32> {
        let slab = self.slab.as_ref()?;
        let lent = self.lent.get(id).into_iter().flatten();
        let mine: Vec<u32> = lent.filter_map(|l| slab.queue.place(l.task)).collect();
        slab.queue.next_for(id, &mine, among, |task| could_have(cluster, task, id), suits)
    }

    /// The same among those that are its own.
    fn next_own(&self, cluster: &Cluster, id: WorkerId, own: &[u32]) -> Option<u32> {
        let slab = self.slab.as_ref()?;
        let lent = self.lent.get(id).into_iter().flatten();
        let mine: Vec<u32> = lent.filter_map(|l| slab.queue.place(l.task)).collect();
        slab.queue.next_among(id, &mine, own, |task| could_have(cluster, task, id))
    }

    /// Lends tasks of a slab.
    fn choose(&mut self, cluster: &mut Cluster, turn: Turn, now: Micros) -> Vec<(WorkerId, u32)> {
        let ahead = u64::from(cluster.config.queue_ahead.max(1));
        let all_threads = cluster.roster.threads();
        let mut leases = Vec::new();
        let mut refused = BTreeSet::new();
        while let Some(waiting) = self.waiting() {
            let takers = || cluster.roster.staying().filter(|(id, _)| !refused.contains(id));
            let dry = takers()
                .filter(|(_, w)| w.leases < u64::from(w.threads))
                .min_by_key(|(_, w)| w.leases);
            let next = dry.or_else(|| {
                // a/b < c/d as a d < c b.
                takers()
                    .filter(|_| !turn.last || waiting > all_threads)
                    .filter(|(_, w)| w.leases < u64::from(w.threads).saturating_mul(ahead))
                    .reduce(|a, b| {
                        let (x, y) = (u128::from(a.1.leases), u128::from(b.1.leases));
                        let less = y * u128::from(a.1.threads) < x * u128::from(b.1.threads);
                        if less { b } else { a }
                    })
            });
            let Some((id, _)) = next else { break };
            // A worker short of memory may have any of the first few that fit.
            let tries = Cell::new(0);
            let slab = self.slab.as_ref().expect("something waits in it");
            let suits = |place| {
                if self.leases(id) == 0 || !cluster.residency.is_lazy(id) {
                    return true;
                }
                tries.set(tries.get() + 1);
                tries.get() <= 16 && cluster.residency.fits(id, &slab.bricks_of(place))
            };
            match self.next(cluster, id, |_| true, suits) {
                Some(place) => {
                    self.give(cluster, place, id, now);
                    leases.push((id, place));
                }
                None => {
                    refused.insert(id);
                }
            }
        }
        leases
    }

    /// How many tasks wait; `None`: none.
    fn waiting(&self) -> Option<u64> {
        let waiting = self.slab.as_ref().map_or(0, |slab| slab.queue.waiting());
        (waiting > 0).then_some(waiting as u64)
    }

    /// How long what a worker was lent of this frame takes it, as far as that is known: infinitely long, where
    /// it is not.
    pub(crate) fn lent_us(&self, id: WorkerId) -> f64 {
        let Some(Slab { queue, regions: Some(regions), .. }) = &self.slab else { return 0.0 };
        let lent = self.lent.get(id).into_iter().flatten();
        let places = lent.filter_map(|l| queue.place(l.task));
        places.map(|place| regions.took(place).unwrap_or(f64::INFINITY)).sum()
    }

    /// Lends each worker tasks that are its own, or whose owner is gone.
    ///
    /// A worker's leases of one event leave together, so all that it is to have ahead goes at once.
    fn choose_own(
        &mut self,
        cluster: &mut Cluster,
        turn: Turn,
        now: Micros,
    ) -> Vec<(WorkerId, u32)> {
        let ahead = u64::from(cluster.config.queue_ahead.max(1));
        let most = Ahead::of(&cluster.roster);
        let mut leases = Vec::new();
        let Some(Slab { queue, regions: Some(regions), changes, orphaned, .. }) = &self.slab else {
            return leases;
        };
        let sated = &cluster.sated;
        let room = |id: WorkerId, w: &crate::roster::Worker| {
            w.leases < u64::from(w.threads).saturating_mul(ahead.max(most.leases))
                && sated.binary_search(&id).is_err()
        };
        if queue.waiting() == 0 {
            return leases;
        }
        let orphaning = match turn.only {
            // They have nothing to wait for: all that was theirs was lent, or waits for room.
            Some(_) if *changes == Some(cluster.roster.changes()) && !*orphaned => Vec::new(),
            _ => regions.orphaning(&cluster.roster),
        };
        let all_threads = cluster.roster.threads();
        let (mut takers, orphans): (Vec<(WorkerId, u64)>, bool) = match turn.only {
            // Most of the frames in the making have nothing for it.
            Some(id) if orphaning.is_empty() && !queue.any_waits(regions.owned(id)) => {
                (Vec::new(), false)
            }
            Some(id) if orphaning.is_empty() => {
                let worker = cluster.roster.get(id).filter(|w| w.draws() && room(id, w));
                (worker.map(|w| (id, u64::from(w.threads))).into_iter().collect(), false)
            }
            _ => {
                let has_some = |id: WorkerId| queue.any_waits(regions.owned(id));
                let orphans = orphaning.iter().any(|id| has_some(*id));
                let takers = cluster
                    .roster
                    .staying()
                    .filter(|(id, w)| room(*id, w) && (orphans || has_some(*id)))
                    .map(|(id, w)| (id, u64::from(w.threads)))
                    .collect();
                (takers, orphans)
            }
        };
        // All threads have something before any has more.
        for first in [true, false] {
            let mut at = 0;
            while let Some(&(id, threads)) = takers.get(at) {
                at += 1;
                let mut us = self.lent_us(id);
                while let Some(waiting) = self.waiting() {
                    let load = cluster.roster.get(id).map_or(u64::MAX, |w| w.leases);
                    let many = threads.saturating_mul(ahead);
                    let us_ahead = if self.alone && turn.last { most.alone_us } else { most.us };
                    let short = us < us_ahead * threads as f64;
                    let may = if first {
                        load < threads
                    } else if !turn.last || waiting > all_threads {
                        load < many || short && load < threads.saturating_mul(most.leases)
                    } else {
                        short && load < threads.saturating_mul(most.leases)
                    };
                    if !may {
                        break;
                    }
                    let Some(Slab { regions: Some(regions), .. }) = &self.slab else { break };
                    let next = if orphans {
                        let own = |place| {
                            let owner = regions.owner(place);
                            owner == id || orphaning.contains(&owner)
                        };
                        self.next(cluster, id, own, |_| true)
                    } else {
                        self.next_own(cluster, id, regions.owned(id))
                    };
                    let Some(place) = next else { break };
                    if self.alone && turn.last {
                        let have = self.split_late(cluster, (place, id), now);
                        let staying = cluster.roster.staying().filter(|(id, _)| have.contains(id));
                        let new = staying.filter(|(id, _)| takers.iter().all(|t| t.0 != *id));
                        let new: Vec<_> = new.map(|(id, w)| (id, u64::from(w.threads))).collect();
                        takers.extend(new);
                        if !have.is_empty() {
                            continue;
                        }
                    }
                    let Some(Slab { regions: Some(regions), .. }) = &self.slab else { break };
                    us += regions.took(place).unwrap_or(f64::INFINITY);
                    self.give(cluster, place, id, now);
                    leases.push((id, place));
                }
            }
        }
        leases
    }

    /// Lends threads that have nothing to do what others own.
    fn choose_others(
        &mut self,
        cluster: &mut Cluster,
        turn: Turn,
        now: Micros,
    ) -> Vec<(WorkerId, u32)> {
        let mut leases = Vec::new();
        // Owners that are heard are forborne longer, and nobody shorter: the time that was found last is
        // looked at when it has come.
        let known = turn.only.is_some() && self.forborne.is_some_and(|at| now < at);
        if !known {
            self.forborne = None;
        }
        if !cluster.roster.any_dry() {
            return leases;
        }
        let mut refused = BTreeSet::new();
        let mut left = None;
        while self.waiting().is_some() {
            let dry = cluster.roster.staying().filter(|(id, _)| !refused.contains(id));
            let dry = dry.filter(|(id, w)| w.is_dry() && turn.only.is_none_or(|only| only == *id));
            let Some((id, _)) = dry.min_by_key(|(_, w)| w.leases) else { break };
            let Some(slab) = &self.slab else { break };
            let Some(regions) = &slab.regions else { break };
            // What workers have left to do when the others look for more.
            let left = left.get_or_insert_with(|| {
                let tasks = slab.queue.tasks.iter().zip(0..);
                let open = tasks.filter(|(t, _)| t.end == End::Open).map(|(_, place)| place);
                regions.left(open, &cluster.roster)
            });
            let suits = |place| {
                let task = &slab.queue.tasks[place as usize];
                task.was_lent()
                    || task.begun.is_some()
                    || regions.is_worth_taking(place, id, left, &cluster.memory)
                    || self.until(slab, regions, place) <= now
            };
            match self.next(cluster, id, |_| true, suits) {
                Some(place) => {
                    self.give(cluster, place, id, now);
                    leases.push((id, place));
                }
                None => {
                    refused.insert(id);
                }
            }
        }
        if !known
            && !refused.is_empty()
            && let Some(slab) = &self.slab
            && let Some(regions) = &slab.regions
        {
            let waiting = slab.queue.all_waiting();
            let until = waiting.map(|place| self.until(slab, regions, place)).min();
            self.forborne = until.filter(|at| *at > now);
        }
        leases
    }

    /// Until when an owner keeps a task from those who have nothing to do.
    fn until(&self, slab: &Slab, regions: &Regions, place: u32) -> Micros {
        let (owner, us) = regions.forbearance(place);
        let heard = self.answered.get(owner).copied().unwrap_or(0).max(slab.began);
        heard.saturating_add(us)
    }

    /// A task that outlived its estimate, and a worker with a free thread for it.
    ///
    /// One slow worker holds up a slab: at a tenth of the speed, its first tile lasts as long
    /// as all the others' work. So when threads run dry, what takes more than twice the time
    /// that tasks of its workload take is run twice, and so is what waits behind it on the
    /// same worker. Its own lease stays live: whichever is first counts. The price is at most
    /// one task for each idle thread. Suspects are left out, lest they take two workers at once.
    fn next_outlived(&mut self, cluster: &Cluster, now: Micros) -> Option<(u32, WorkerId)> {
        let slab = self.slab.as_ref()?;
        let idle: Vec<(WorkerId, u64)> = cluster
            .roster
            .staying()
            .filter(|(_, w)| w.leases < u64::from(w.threads))
            .map(|(id, w)| (id, w.leases))
            .collect();
        // Some of them wait for pieces.
        let pieces = slab.waits_for_pieces(now);
        if idle.len() <= pieces.len() {
            self.outlived = pieces.into_iter().min();
            return None;
        }
        let pace = self.pace.measure()?;
        let mut late: Vec<(Micros, u32)> = Vec::new();
        for (id, lent) in self.lent.iter() {
            let Some(worker) = cluster.roster.get(id) else { continue };
            let threads = worker.threads as usize;
            let answered = self.answered.get(id).copied().unwrap_or(0);
            let mut heads_late = 0;
            for (i, lent) in lent.iter().enumerate() {
                let open = |&p: &u32| slab.queue.tasks[p as usize].end == End::Open;
                let place = slab.queue.place(lent.task).filter(open);
                let at = match place {
                    _ if i >= threads => heads_late,
                    // It does dead work.
                    None => now,
                    Some(place) => {
                        let est = slab.cut.tiles[place as usize].est;
                        let at = lent.sent.max(answered).saturating_add(pace.patience(est));
                        at.max(slab.waits_for_piece(place))
                    }
                };
                heads_late = at.max(heads_late);
                if let Some(place) = place.filter(|&p| slab.queue.tasks[p as usize].may_double()) {
                    late.push((at, place));
                }
            }
        }
        late.sort_unstable();
        for (at, place) in late {
            let has_it = |id: WorkerId| {
                let lent = self.lent.get(id).into_iter().flatten();
                lent.into_iter().any(|l| l.task == slab.queue.id(place))
            };
            let fits = |id: WorkerId, load: u64| {
                load == 0
                    || !cluster.residency.is_lazy(id)
                    || cluster.residency.fits(id, &slab.bricks_of(place))
            };
            let takers = idle.iter().filter(|(id, load)| !has_it(*id) && fits(*id, *load));
            let Some(&(id, _)) = takers.min_by_key(|(_, load)| *load) else { continue };
            if at > now {
                self.outlived = Some(at);
                return None;
            }
            return Some((place, id));
        }
        None
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
        cluster.roster.ends(worker, 1);
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
            Pixels::Finished(leaves) => self.state.lay_finished(tile, leaves),
            Pixels::Sums(sums) if slab.regions.is_some() => self.state.lay(tile, sums),
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
                self.state.put(tile, &sums);
            }
        }
        self.any_result = true;
        self.ledger.came(result.bytes);
        self.ledger.composite_us += clock.now().saturating_sub(now);

        let who = cluster.roster.get(worker).expect("a worker whose result came is known");
        let r = place_in_time(who, &result.times, lease.sent, now);
        let lasted = now.saturating_sub(lease.sent.max(before));
        self.pace.note(slab.cut.tiles[place as usize].est, r.end - r.start, lasted);
        self.ledger.rendered(worker, &r, &result.counters);
        let thread = result.times.thread.min(who.threads - 1);
        if slab.regions.is_none() {
            let dry = slab.dry.entry((worker, thread)).or_insert(r.end);
            *dry = r.end.max(*dry);
        }
        let Rendered { start, end, .. } = r;
        slab.pieces.push(Piece {
            corner: [tile.x0, tile.y0],
            edge: slab.cut.edge_of(&tile),
            thread: (worker, thread),
            lacked: result.times.ready_us.saturating_sub(result.times.received_us),
            start,
            end,
            came: now,
        });
        let mut drawn_from = lent.map_or(0, |l| l.bricks.len());
        if let Some(cost) = cost {
            drawn_from = cost.touched.len();
            for &i in &cost.touched {
                note_needed(&mut self.needed_ever, &mut self.needed, &self.job, i as usize);
            }
            self.ledger.stalled(worker, cost);
            cluster.residency.touched(self.job.scene.bricks, &cost.touched);
        }
        slab.handing.remove(&place);
        let touched = cost.map_or(&[][..], |cost| &cost.touched[..]);
        let family = slab.drawn(place, end - start, touched);
        if let Some(regions) = &slab.regions {
            let mut learn = |place, tile: &Rect, owner, us, touched: &[u32]| {
                cluster.memory.learn(regions, (place, tile), owner, us, touched);
            };
            match &family {
                Ok(None) => {}
                Ok(Some((root, family))) => {
                    let (us, touched) = family.cost();
                    learn(*root, &family.tile, family.owner, us, touched);
                }
                Err(()) if cost.is_some() => {
                    learn(place, &tile, worker, end - start, touched);
                }
                Err(()) => {}
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

    fn progress(&self, cluster: &mut Cluster) {
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
    fn give_up(&mut self, places: Vec<u32>) {
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
            self.ledger.enrol(id, worker, now);
        }
    }

    /// Leases of this slab that a worker has, in the order in which it got them, and how many
    /// of them it is probably running.
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
            slab.queue.pass_on(&not_begun);
        }
    }

    /// A worker is gone. `blame` says whether a task may have killed it; as many as it had `threads`
    /// for were probably running. The caller has not taken its bricks off the books yet.
    pub(crate) fn lost(
        &mut self,
        cluster: &mut Cluster,
        id: WorkerId,
        worker: &crate::roster::Worker,
        (blame, threads): (bool, u32),
        now: Micros,
    ) {
        // A frame that is done and waits for one before it is over.
        let now = self.ended.unwrap_or(now);
        let (leases, running) = self.probably(id, threads);
        self.lent.remove(id);
        self.told.remove(&id);
        if let Some(flight) = cluster.residency.flight(id) {
            self.ledger.landed(id, flight, now);
        }
        self.ledger.leave(id, now);
        if let Some(slab) = &mut self.slab {
            slab.handing.retain(|_, (asked, _)| *asked != id);
            let running = if blame { running } else { 0 };
            let given_up = slab.queue.lose(id, &worker.name, &leases, running, &cluster.config);
            self.give_up(given_up);
        }
    }

    /// Bricks to a worker were under way until now.
    pub(crate) fn landed(&mut self, id: WorkerId, flight: Flight, now: Micros) {
        self.ledger.landed(id, flight, now);
    }

    /// Time went on.
    pub(crate) fn tick(&mut self, now: Micros) {
        if let Some(slab) = &mut self.slab {
            slab.queue.overdue(now);
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
                cluster.roster.ends(id, lent.len() as u64);
                busy.insert(id);
            }
            for lent in lent.iter().filter(|l| !l.bricks.is_empty()) {
                cluster.residency.unpin(id, &lent.bricks);
            }
        }
        cluster.residency.rest();
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
        for (id, flight) in cluster.residency.cut_flights(now) {
            if flight.since < now {
                self.ledger.landed(id, flight, now);
            }
        }
        for (id, _) in cluster.roster.iter() {
            self.ledger.holds(id, cluster.residency.held_of(id, self.job.scene.bricks));
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
    let mut grounded = cluster.residency.flight(id).is_none();
    let errands = cluster.residency.flush(id, now, &mut || roster.ping(id, now));
    for errand in errands {
        match errand {
            Errand::Drop { set, bricks, nonce } => {
                cluster.send(id, ToWorker::DropBricks { set, bricks });
                cluster.send(id, ToWorker::Ping { nonce });
            }
            Errand::Send { set, bricks, bytes, over_budget } => {
                cluster.traffic.leave(bytes, std::mem::take(&mut grounded), now);
                if let Some(ledger) = &mut ledger {
                    ledger.sent(id, bricks.len() as u64, bytes);
                }
                cluster.totals.over_budget += u64::from(over_budget);
                cluster.out.push_back(Action::SendBricks { worker: id, set, bricks });
            }
        }
    }
}

/// Whether somebody else than this worker could draw a task.
fn could_have(cluster: &Cluster, task: &crate::queue::Task, id: WorkerId) -> bool {
    let refused_it = |id| task.failed.iter().any(|(w, ..)| *w == id);
    cluster.roster.staying().any(|(other, _)| other != id && !refused_it(other))
}

/// Puts a lease on the books of workers and bricks.
fn lend(
    cluster: &mut Cluster,
    slab: &Slab,
    place: u32,
    id: WorkerId,
    epoch: Epoch,
    now: Micros,
) -> Lent {
    cluster.roster.lends(id);
    let bricks = slab.bricks_of(place);
    if !bricks.is_empty() {
        cluster.residency.pin(id, &bricks);
        cluster.residency.want(id, bricks.iter().copied());
    }
    Lent { task: slab.queue.id(place), epoch, sent: now, bricks }
}

/// How long tasks take, by the last ones of the frame.
#[derive(Debug, Default)]
struct Pace {
    /// Workload, render time, and time beside it, of each.
    last: VecDeque<(u64, Micros, Micros)>,
}

impl Pace {
    /// Medians of 64 move slowly enough to pass over a slow worker's share and quickly enough
    /// to follow the slabs.
    const LAST: usize = 64;
    /// With fewer, one slow task is the median.
    const LEAST: usize = 4;
    /// A task is never late before: the scheduling of two busy machines.
    const FLOOR: Micros = 5_000;

    fn note(&mut self, est: u64, render_us: Micros, lasted: Micros) {
        self.last.push_back((est.max(1), render_us, lasted.saturating_sub(render_us)));
        if self.last.len() > Self::LAST {
            self.last.pop_front();
        }
    }

    /// What these tasks say about the next: medians of render time for a workload of 2^20, and
    /// of the time beside it.
    fn measure(&self) -> Option<Measured> {
        if self.last.len() < Self::LEAST {
            return None;
        }
        let median = |of: &dyn Fn(&(u64, Micros, Micros)) -> u128| {
            let mut all: Vec<u128> = self.last.iter().map(of).collect();
            let mid = all.len() / 2;
            *all.select_nth_unstable(mid).1
        };
        let render = median(&|t| (u128::from(t.1) << 20) / u128::from(t.0));
        Some(Measured { render, beside: median(&|t| u128::from(t.2)) })
    }
}

/// How long a task takes.
#[derive(Clone, Copy, Debug)]
struct Measured {
    render: u128,
    beside: u128,
}

impl Measured {
    /// How long one of this workload is drawn.
    fn expects(&self, est: u64) -> Micros {
        ((self.render * u128::from(est.max(1))) >> 20).min(u128::from(Micros::MAX)) as Micros
    }

    /// After what time a task of this workload has outlived its estimate.
    fn patience(&self, est: u64) -> Micros {
        let expected = u128::from(self.expects(est)) + self.beside;
        Pace::FLOOR.saturating_add((2 * expected).min(u128::from(Micros::MAX)) as Micros)
    }
}

/// Whether what a stranger says of a region can be counted.
fn check_cost(cost: Option<&RegionCost>, tile: Rect, bricks: usize) -> Result<(), String> {
    let sampled =
        cost.map_or(0, |c| c.sampled.each().map(|s| s.pixels).into_iter().max().unwrap_or(0));
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
fn finish_of(job: &FrameJob) -> Option<Finish> {
    job.finish.filter(|_| goes_by_region(job))
}

/// Whether a stranger's finished pixels are those of a tile.
fn check_leaves(tile: Rect, leaves: &Leaves, finish: Option<Finish>) -> Result<(), String> {
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
fn check(tile: Rect, pixels: &TilePixels, finish: Option<Finish>) -> Result<(), String> {
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
        let mut roster = crate::roster::Roster::default();
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
