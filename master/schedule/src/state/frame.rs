//! One frame: what both schedules share, and the enum of the two.
//!
//! ```text
//! waiting -> [phase] -> ... -> done      slab: one phase a slab, with a barrier (section 4.5)
//!               | begin_phase            region: one phase through all depths
//!               | dispatch               leases, work stealing, speculative copies
//!               | result                 the first result of a task counts
//!               | end_phase              no task is open
//! ```
//!
//! Under the `region` schedule the master knows nothing of a frame's depths but where something may
//! be seen: workers cull and ask for bricks. Several such frames may be in flight at a time.
//!
//! A frame waits, with nothing lost, while there is no worker. It refuses to know which worker is
//! silent (`workers`), which copy of a result counts (`task_queue`) and where bricks are
//! (`residency`).

mod second;

use crate::account::critical_path::RenderedTile;
use crate::account::ledger::{Ledger, Rendered, ms, place_in_time};
use crate::account::spans;
use crate::dispatch::speculate::Pace;
use crate::policy::macrotile::Cut;
use crate::state::audits::{Drawn, Lie, Verdict as AuditEnd};
use crate::state::cluster::Cluster;
use crate::state::given_up::GivenUp;
use crate::state::leases::{LeaseTable, Lent};
use crate::state::region_frame::RegionFrame;
use crate::state::residency::Transfer;
use crate::state::result_checks::{check_cost, check_leaves, check_sums};
use crate::state::slab_frame::SlabFrame;
use crate::state::task_queue::{End, Task, Verdict};
use crate::state::workers::Worker;
use crate::{Action, Clock, FrameJob, Micros, Span, WorkerIdentity};
use slabcast_common::ids::{Epoch, TaskId, WorkerId};
use slabcast_common::image::{FrameState, PixelEncoding};
use slabcast_common::message::{Pixels, RegionSplit, TileResult, ToWorker};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Schedule;
use slabcast_common::stats::{BrickStats, SlabStats, TileStats};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Whether a pixel with accumulated opacity `a` is shut for good.
///
/// The renderer makes the same test after each sheet, in the same f32 arithmetic; a master that
/// shut a pixel the renderer holds open would change bytes.
#[inline]
pub fn is_shut(a: f32, eps: f64) -> bool {
    eps > 0.0 && (1.0f32 - a) < eps as f32
}

/// Stage of a frame's rendering.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stage {
    /// The next phase has not begun.
    Waiting,
    /// A phase is being rendered.
    Drawing,
    /// The last phase ended.
    Done,
}

/// Bricks that a frame needed, each counted once.
#[derive(Debug)]
pub(crate) struct BrickUse {
    is_needed: Vec<bool>,
    bricks: u64,
    voxels: u64,
}

impl BrickUse {
    fn new(bricks: usize) -> Self {
        BrickUse { is_needed: vec![false; bricks], bricks: 0, voxels: 0 }
    }

    /// Notes that the brick at an index is needed.
    pub(crate) fn note(&mut self, job: &FrameJob, index: usize) {
        if !std::mem::replace(&mut self.is_needed[index], true) {
            self.bricks += 1;
            self.voxels += u64::from(job.bricks[index].voxels);
        }
    }
}

/// State that a frame has under either schedule.
#[derive(Debug)]
pub(crate) struct FrameCore {
    pub(crate) job: Box<FrameJob>,
    /// Format of results; `None`: sums.
    pub(crate) finish: Option<PixelEncoding>,
    /// No other frame was in flight or queued when it began.
    pub(crate) sole: bool,
    pub(crate) stage: Stage,
    /// When the current phase began, and when the last one ended.
    pub(crate) phase_began: Micros,
    pub(crate) ended: Option<Micros>,
    pub(crate) picture: FrameState,
    pub(crate) table: LeaseTable,
    /// The frame's first task id.
    pub(crate) first_task: TaskId,
    /// Workers that were sent the frame's view.
    pub(crate) announced_to: BTreeSet<WorkerId>,
    pub(crate) pace: Pace,
    /// When the next task outlives its estimate, while a thread is idle.
    pub(crate) speculate_at: Option<Micros>,
    /// Tiles of the phase whose results were accepted.
    pub(crate) rendered: Vec<RenderedTile>,
    pub(crate) brick_use: BrickUse,
    /// Voxels of all bricks.
    relevant_voxels: u64,
    /// The first tile that was given up.
    given_up: Option<Box<GivenUp>>,
    /// Workers that are not trusted and drew tiles that nobody compared.
    unaudited: BTreeSet<Arc<WorkerIdentity>>,
    pub(crate) ledger: Ledger,
}

/// A frame in the making.
#[derive(Debug)]
pub(crate) enum Frame {
    /// Rendered slab after slab.
    Slab(Box<SlabFrame>),
    /// Rendered in regions through all depths.
    Region(Box<RegionFrame>),
}

/// Outcome of a step.
pub(crate) enum Step {
    /// The frame waits for events.
    Waits,
    /// The last phase ended.
    Done,
    /// The frame can't be rendered.
    Failed(Box<GivenUp>),
}

/// Freedom of one step of a frame, given the other frames in flight.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct StepContext {
    /// No later frame is in flight or queued whose tasks could keep idle threads busy.
    pub(crate) is_last_frame: bool,
    /// Idle threads may take tasks that another worker owns.
    pub(crate) may_steal: bool,
    /// The only worker whose threads can have become free since the frame's last step; `None`: any.
    pub(crate) freed_worker: Option<WorkerId>,
}

/// Whether a frame is rendered under the `region` schedule. `auto` always is: where nothing hides
/// anything it needs as many bricks as the other and has no barriers.
pub(crate) fn uses_regions(job: &FrameJob) -> bool {
    job.work.schedule != Schedule::Slab
}

/// Limit: finished tiles that are laid into the picture together. What is left when the last one
/// comes then takes 20 us at most, where all of a picture of 1536x1536 take 0.6 ms; a finisher is
/// woken for each batch.
pub(crate) const TILES_LAID_TOGETHER: usize = 16;

impl FrameCore {
    fn new(job: Box<FrameJob>, sole: bool, cluster: &Cluster, began: Micros) -> Self {
        let mut ledger = Ledger::new(began);
        for (id, worker) in cluster.roster.iter() {
            ledger.open_account(id, worker, began);
        }
        FrameCore {
            finish: job.finish.filter(|_| uses_regions(&job)),
            sole,
            stage: Stage::Waiting,
            phase_began: began,
            ended: None,
            picture: FrameState::new(job.view.size),
            table: LeaseTable::new(),
            first_task: TaskId(cluster.next_task),
            announced_to: BTreeSet::new(),
            pace: Pace::default(),
            speculate_at: None,
            rendered: Vec::new(),
            brick_use: BrickUse::new(job.bricks.len()),
            relevant_voxels: cluster.residency.voxels(job.scene.bricks),
            given_up: None,
            unaudited: BTreeSet::new(),
            ledger,
            job,
        }
    }

    /// Begins a phase with the tasks of a cut. `spare_ids`: task ids for pieces.
    pub(crate) fn begin_phase(
        &mut self,
        cluster: &mut Cluster,
        began: Micros,
        cut: Cut,
        spare_ids: u64,
    ) {
        let first = TaskId(cluster.next_task);
        cluster.next_task += cut.tiles.len() as u64 + spare_ids;
        self.table.begin(first, cut, spare_ids);
        self.phase_began = began;
        self.rendered.clear();
        self.stage = Stage::Drawing;
    }

    /// Ends a phase: enters its statistics. `wholes`: for tasks that pieces were stolen from, their
    /// whole tile, its estimate, and the rendering time of the pieces. `is_piece`: the task is part
    /// of such a whole.
    pub(crate) fn end_phase(
        &mut self,
        index: usize,
        bricks: usize,
        barrier_wait: Micros,
        wholes: &BTreeMap<u32, (Rect, u64, Micros)>,
        is_piece: impl Fn(u32) -> bool,
        now: Micros,
    ) {
        let table = &self.table;
        let tile = |(task, place): (&Task, u32)| {
            let (worker, us) = match &task.end {
                End::Done { worker, render_us } => (worker.to_string(), *render_us),
                End::Open => (String::new(), 0),
            };
            let own = (task.tile.rect, task.tile.est, 0);
            let (rect, est, more) = wholes.get(&place).copied().unwrap_or(own);
            TileStats {
                x: rect.x0 as u32,
                y: rect.y0 as u32,
                size: table.cut.edge_of(&rect),
                est,
                ms: ms(us + more),
                worker,
            }
        };
        let tasks = table.queue.tasks.iter().zip(0..).filter(|(_, place)| !is_piece(*place));
        let mut tiles: Vec<TileStats> = tasks.map(tile).collect();
        // Pieces stand behind all others.
        tiles.sort_by_key(|t| std::cmp::Reverse(t.est));
        self.ledger.end_phase(&self.rendered, self.phase_began);
        self.ledger.retries += table.queue.retries;
        self.ledger.slabs.push(SlabStats {
            tiles,
            empty: table.cut.empty,
            shut: table.cut.shut,
            barrier_wait_ms: ms(barrier_wait),
        });
        self.ledger.spans.push(Span {
            name: format!("slab {index}"),
            category: "slab",
            worker: None,
            thread: 0,
            start: self.phase_began,
            end: now,
            args: vec![
                ("tiles", table.queue.all().to_string()),
                ("edge", table.cut.edge.to_string()),
                ("bricks", bricks.to_string()),
            ],
        });
        self.stage = Stage::Waiting;
    }

    /// Takes back a lease that its worker answered; `None` if it has no such lease.
    fn take_answered(
        &mut self,
        cluster: &mut Cluster,
        worker: WorkerId,
        task: TaskId,
        epoch: Epoch,
    ) -> Option<Lent> {
        let lent = self.table.take(worker, task, epoch)?;
        if !lent.bricks.is_empty() {
            cluster.residency.unpin(worker, &lent.bricks);
        }
        cluster.roster.end_leases(worker, 1);
        Some(lent)
    }

    /// Whether a worker that is not trusted drew a tile that nobody compared, on any of its links.
    pub(crate) fn has_unaudited(&self, who: &WorkerIdentity) -> bool {
        self.unaudited.contains(who)
    }

    /// Returns the number of leases of a worker.
    pub(crate) fn leases(&self, id: WorkerId) -> u32 {
        self.table.lent(id).len() as u32
    }

    /// Returns the leases of the current phase that a worker has, oldest first, and how many of
    /// them it is probably running.
    fn running_leases(&self, id: WorkerId, threads: u32) -> (Vec<(u32, Epoch)>, usize) {
        let mut running = 0;
        let mut leases = Vec::new();
        for (i, lent) in self.table.lent(id).iter().enumerate() {
            if let Some(place) = self.table.queue.place(lent.task) {
                leases.push((place, lent.epoch));
                running += usize::from(i < threads as usize);
            }
        }
        (leases, running)
    }
}

impl Frame {
    /// Begins a frame. `lane`: the lane of workers that renders it, if not all do. `sole`: no other
    /// frame is in flight or queued. The brick set of `job` must be open in the residency.
    pub(crate) fn start(
        job: Box<FrameJob>,
        lane: Option<u32>,
        sole: bool,
        cluster: &mut Cluster,
        clock: &dyn Clock,
    ) -> Self {
        let began = clock.now();
        let by_region = uses_regions(&job);
        let core = FrameCore::new(job, sole, cluster, began);
        let mut frame = match by_region {
            true => Frame::Region(Box::new(RegionFrame::new(core, lane))),
            false => Frame::Slab(Box::new(SlabFrame::new(core))),
        };
        frame.core_mut().ledger.cull_us += clock.now().saturating_sub(began);
        frame
    }

    /// Returns the number of the client that asked for the frame ([`FrameJob::client`]).
    pub(crate) fn client(&self) -> u64 {
        self.core().job.client
    }

    pub(crate) fn core(&self) -> &FrameCore {
        match self {
            Frame::Slab(frame) => &frame.core,
            Frame::Region(frame) => &frame.core,
        }
    }

    pub(crate) fn core_mut(&mut self) -> &mut FrameCore {
        match self {
            Frame::Slab(frame) => &mut frame.core,
            Frame::Region(frame) => &mut frame.core,
        }
    }

    pub(crate) fn as_region(&self) -> Option<&RegionFrame> {
        match self {
            Frame::Slab(_) => None,
            Frame::Region(frame) => Some(frame),
        }
    }

    pub(crate) fn as_region_mut(&mut self) -> Option<&mut RegionFrame> {
        match self {
            Frame::Slab(_) => None,
            Frame::Region(frame) => Some(frame),
        }
    }

    /// Index of the current slab, and number of slabs.
    fn slab(&self) -> (usize, usize) {
        match self {
            Frame::Slab(frame) => frame.position(),
            Frame::Region(_) => (0, 1),
        }
    }

    /// Advances as far as possible.
    pub(crate) fn step(
        &mut self,
        cluster: &mut Cluster,
        context: StepContext,
        clock: &dyn Clock,
    ) -> Step {
        loop {
            let core = self.core();
            match core.stage {
                Stage::Done => return Step::Done,
                Stage::Drawing if core.given_up.is_some() => {
                    let given_up = self.core_mut().given_up.take();
                    return Step::Failed(given_up.expect("just seen"));
                }
                Stage::Drawing if core.table.queue.open() > 0 => {
                    match self {
                        Frame::Slab(frame) => frame.dispatch(cluster, context, clock.now()),
                        Frame::Region(frame) => frame.dispatch(cluster, context, clock.now()),
                    }
                    return Step::Waits;
                }
                Stage::Drawing => match self {
                    Frame::Slab(frame) => frame.end_slab(cluster, clock.now()),
                    Frame::Region(frame) => frame.end_regions(clock.now()),
                },
                // The cut of a frame depends on the number of threads, so it waits for workers.
                Stage::Waiting if cluster.roster.threads() == 0 => return Step::Waits,
                Stage::Waiting => {
                    let began = clock.now();
                    match self {
                        Frame::Slab(frame) => frame.begin_slab(cluster, began),
                        Frame::Region(frame) => frame.begin_regions(cluster, began),
                    }
                    self.core_mut().ledger.cull_us += clock.now().saturating_sub(began);
                }
            }
        }
    }

    /// Whether the last phase ended.
    pub(crate) fn is_done(&self) -> bool {
        self.core().stage == Stage::Done
    }

    /// Whether a worker has this lease of the frame.
    pub(crate) fn has_lent(&self, worker: WorkerId, task: TaskId, epoch: Epoch) -> bool {
        self.core().table.has_lent(worker, task, epoch)
    }

    /// Takes a result. Returns when its tile was rendered, if it counts.
    ///
    /// # Errors
    /// The worker's message is a lie; what is wrong with it.
    pub(crate) fn result(
        &mut self,
        cluster: &mut Cluster,
        worker: WorkerId,
        result: TileResult,
        clock: &dyn Clock,
    ) -> Result<Option<(Micros, Micros)>, String> {
        let now = clock.now();
        let by_region = self.as_region().is_some();
        let core = self.core_mut();
        let before = core.table.note_answer(worker, now);
        let lent = core.take_answered(cluster, worker, result.task, result.epoch);
        let verdict = match &lent {
            Some(_) => core.table.queue.judge(result.task, result.epoch, worker),
            None => Verdict::Dead,
        };
        let who = cluster.roster.get(worker);
        let (Verdict::Counts(place, lease), Some(who)) = (verdict, who) else {
            cluster.totals.dropped_results += 1;
            if result.task >= core.first_task {
                core.ledger.dropped_results += 1;
            }
            return Ok(None);
        };
        let tile = core.table.tile(place);
        let cost = result.region.as_ref().filter(|_| by_region);
        let checked = match &result.pixels {
            Pixels::Sums(sums) => check_sums(tile, sums, core.finish),
            Pixels::Finished(leaves) => check_leaves(tile, leaves, core.finish),
        };
        let bricks = core.job.bricks.len();
        if let Err(lie) = checked.and_then(|()| check_cost(cost, tile, bricks)) {
            // Its other leases go back when it is dropped; this one it has just answered.
            core.table.queue.release(place, worker, result.epoch);
            return Err(lie);
        }
        let rendered = place_in_time(who, &result.times, lease.sent, now);
        let Rendered { start, end, .. } = rendered;
        let est = core.table.cut.tiles[place as usize].est;
        let lasted = now.saturating_sub(lease.sent.max(before));
        core.pace.note(est, end - start, lasted);
        let drawn = Drawn {
            worker,
            who: who.identity.clone(),
            is_trusted: who.is_trusted,
            name: who.name.clone(),
            thread: result.times.thread.min(who.threads - 1),
            epoch: result.epoch,
            rendered,
            bricks_used: lent.map_or(0, |l| l.bricks.len()),
            result: Box::new(result),
        };
        cluster.roster.answered(worker, now);
        let is_audited = core.table.queue.tasks[place as usize].is_audited();
        let Some(AuditEnd { truth, agreed, liars }) = core.table.queue.vote(place, drawn, now)
        else {
            self.find_second(cluster, place);
            return Ok(None);
        };
        for id in agreed {
            if let Some(worker) = cluster.roster.get_mut(id) {
                worker.reputation.agree();
            }
        }
        let frame = core.job.frame;
        let lies = liars.into_iter().map(|(worker, who)| Lie { worker, who, frame, tile });
        cluster.lies.extend(lies);
        if !is_audited && !truth.is_trusted {
            core.unaudited.insert(truth.who.clone());
        }
        self.enter(cluster, place, truth, clock);
        Ok(Some((start, end)))
    }

    /// Enters the result of a task: its pixels, and its costs.
    fn enter(&mut self, cluster: &mut Cluster, place: u32, drawn: Drawn, clock: &dyn Clock) {
        let now = clock.now();
        let (slab, _) = self.slab();
        let by_region = self.as_region().is_some();
        let Drawn { worker, name, thread, epoch, rendered, mut bricks_used, result, .. } = drawn;
        let Rendered { start, end, .. } = rendered;
        let core = self.core_mut();
        let tile = core.table.tile(place);
        let cost = result.region.as_ref().filter(|_| by_region);
        let edge = core.table.cut.edge_of(&tile);
        let est = core.table.cut.tiles[place as usize].est;
        core.ledger.add_result_bytes(result.bytes);
        core.ledger.add_rendering(worker, &rendered, &result.counters);
        core.rendered.push(RenderedTile {
            corner: [tile.x0, tile.y0],
            edge,
            thread: (worker, thread),
            lacked_bricks_us: result.times.ready_us.saturating_sub(result.times.received_us),
            start,
            end,
            arrived: now,
        });
        if let Some(cost) = cost {
            bricks_used = cost.touched.len();
            for &i in &cost.touched {
                core.brick_use.note(&core.job, i as usize);
            }
            core.ledger.add_region_cost(worker, cost);
        }
        core.ledger.spans.tile(spans::Tile {
            corner: [tile.x0, tile.y0],
            worker: name.clone(),
            thread,
            start,
            end,
            slab,
            edge,
            est,
            bricks: bricks_used,
            attempt: epoch.0,
        });
        let TileResult { pixels, region, .. } = *result;
        match self {
            Frame::Slab(frame) => frame.rendered(tile, pixels, (worker, thread), end),
            Frame::Region(frame) => {
                frame.rendered(cluster, place, worker, end - start, pixels, region);
            }
        }
        let core = self.core_mut();
        core.ledger.composite_us += clock.now().saturating_sub(now);
        core.table.queue.finish(place, End::Done { worker: name, render_us: end - start });
        self.report_progress(cluster);
    }

    /// Queues a progress report.
    pub(crate) fn report_progress(&self, cluster: &mut Cluster) {
        let core = self.core();
        let total = core.table.queue.all();
        let (slab, slabs) = self.slab();
        cluster.out.push_back(Action::Progress {
            frame: core.job.frame,
            done: total - core.table.queue.open(),
            total,
            slab: slab as u32,
            slabs: slabs as u32,
        });
    }

    /// Takes back a task that a worker refused.
    pub(crate) fn failed(
        &mut self,
        cluster: &mut Cluster,
        worker: WorkerId,
        task: TaskId,
        epoch: Epoch,
        reason: String,
        now: Micros,
    ) {
        let core = self.core_mut();
        if core.take_answered(cluster, worker, task, epoch).is_none() {
            return;
        }
        let verdict = core.table.queue.judge(task, epoch, worker);
        let Verdict::Counts(place, _) = verdict else { return };
        let Some(who) = cluster.roster.get(worker).map(|w| &w.identity) else { return };
        core.table.queue.fail(place, epoch, worker, who, reason, now);
        if let Some(region) = self.as_region_mut() {
            region.splits.forget_question(place);
        }
        self.report_progress(cluster);
    }

    /// Takes a piece of a region that a worker gave away.
    ///
    /// # Errors
    /// The worker's message is a lie; what is wrong with it.
    pub(crate) fn handed_over(
        &mut self,
        cluster: &mut Cluster,
        worker: WorkerId,
        piece: RegionSplit,
        now: Micros,
    ) -> Result<(), String> {
        let core = self.core();
        if core.stage != Stage::Drawing {
            return Ok(());
        }
        let verdict = core.table.queue.judge(piece.task, piece.epoch, worker);
        let Verdict::Counts(place, lease) = verdict else { return Ok(()) };
        let Some(region) = self.as_region_mut() else {
            return Err("it gave away a piece of a tile that nobody asked for".into());
        };
        if region.take_piece(cluster, worker, place, lease, piece, now)? {
            self.report_progress(cluster);
        }
        Ok(())
    }

    /// Opens the account of a worker that joined.
    pub(crate) fn joined(&mut self, cluster: &Cluster, id: WorkerId, now: Micros) {
        if let Some(worker) = cluster.roster.get(id) {
            self.core_mut().ledger.open_account(id, worker, now);
        }
    }

    /// Shares the tasks that a leaving worker has not begun.
    pub(crate) fn leaving(&mut self, id: WorkerId, threads: u32) {
        let core = self.core_mut();
        let (leases, running) = core.running_leases(id, threads);
        let not_begun: Vec<_> = leases[running..].iter().map(|l| l.0).collect();
        core.table.queue.share_queued(&not_begun);
    }

    /// Lends the tasks of a worker that says nothing to others too. Its leases stay live.
    pub(crate) fn share_leases(&mut self, id: WorkerId) {
        let core = self.core_mut();
        let places: Vec<u32> = core.table.places(id).collect();
        core.table.queue.share_unless_troubled(&places);
    }

    /// Keeps the tasks of a worker that is heard again for it, where no other has begun them.
    pub(crate) fn take_leases_for_good(&mut self, id: WorkerId) {
        let core = self.core_mut();
        let places: Vec<u32> = core.table.places(id).collect();
        core.table.queue.unshare(id, &places);
    }

    /// Takes back the leases of a lost worker. `blame`: a task may have killed it. `threads`: as
    /// many leases were probably running. The caller has not removed its bricks from the books yet.
    pub(crate) fn lost(
        &mut self,
        cluster: &mut Cluster,
        id: WorkerId,
        worker: &Worker,
        blame: bool,
        threads: u32,
        now: Micros,
    ) {
        if let Some(region) = self.as_region_mut() {
            region.splits.forget_worker(id);
        }
        let core = self.core_mut();
        // A frame that is done waits for earlier ones to be done.
        let now = core.ended.unwrap_or(now);
        let (leases, running) = core.running_leases(id, threads);
        core.table.remove(id);
        core.announced_to.remove(&id);
        if let Some(transfer) = cluster.residency.transfer(id) {
            core.ledger.transfer_ended(id, transfer, now);
        }
        core.ledger.close_account(id, now);
        if core.stage == Stage::Drawing {
            let running = if blame { running } else { 0 };
            core.table.queue.lose(id, &worker.identity, &leases, running, now);
        }
    }

    /// Records a transfer of bricks that ended.
    pub(crate) fn transfer_ended(&mut self, id: WorkerId, transfer: Transfer, now: Micros) {
        self.core_mut().ledger.transfer_ended(id, transfer, now);
    }

    /// Requeues tasks whose leases expired or whose pause is over, and gives up those that no
    /// linked worker can draw.
    pub(crate) fn tick(&mut self, cluster: &mut Cluster, clock: &dyn Clock) {
        let now = clock.now();
        let (slab, _) = self.slab();
        let core = self.core_mut();
        let queue = &mut core.table.queue;
        queue.requeue_overdue(now);
        queue.end_pauses(now);
        if core.stage != Stage::Drawing {
            return;
        }
        self.take_uncompared(cluster, clock);
        let core = self.core_mut();
        let troubled: Vec<u32> = core.table.queue.troubled().collect();
        for place in troubled {
            let is_hopeless = {
                let linked = cluster.roster.iter().filter(|(_, w)| !w.leaving);
                let linked = linked.map(|(_, w)| &*w.identity);
                core.table.queue.hopeless(place, linked, &cluster.config)
            };
            if is_hopeless && core.given_up.is_none() {
                core.given_up = Some(Box::new(GivenUp::new(&core.table, place, slab)));
            }
            let task = &core.table.queue.tasks[place as usize];
            let is_fresh = |w: &Worker| !task.was_failed_by(&w.identity);
            if cluster.roster.in_reserve() > 0 && !cluster.roster.active().any(|(_, w)| is_fresh(w))
            {
                cluster.activate_all();
            }
        }
    }

    /// Returns the next time at which the frame has something to do; `None` once it is done.
    pub(crate) fn next_deadline(&self) -> Option<Micros> {
        let core = self.core();
        if core.stage != Stage::Drawing {
            return None;
        }
        let steal_at = self.as_region().and_then(|r| r.steal_at);
        let waits = [core.speculate_at, steal_at].into_iter().flatten();
        core.table.queue.next_deadline().into_iter().chain(waits).min()
    }

    /// Ends the frame, in whatever way: workers forget it.
    pub(crate) fn end(&mut self, cluster: &mut Cluster) {
        let core = self.core_mut();
        let mut busy = BTreeSet::new();
        for (id, lent) in core.table.take_all() {
            if cluster.roster.get(id).is_some() && !lent.is_empty() {
                cluster.roster.end_leases(id, lent.len() as u64);
                busy.insert(id);
            }
            for lent in lent.iter().filter(|l| !l.bricks.is_empty()) {
                cluster.residency.unpin(id, &lent.bricks);
            }
        }
        cluster.residency.clear_wanted();
        let frame = core.job.frame;
        for id in std::mem::take(&mut core.announced_to) {
            if busy.contains(&id) {
                cluster.send(id, ToWorker::EndFrame { frame });
            } else if let Some(w) = cluster.roster.get_mut(id) {
                // Nothing hangs on it: it need not be woken for this.
                w.over.push(frame);
            }
        }
    }

    /// Returns the finished picture with what it cost.
    pub(crate) fn finish(self, cluster: &mut Cluster, now: Micros) -> Action {
        let schedule = if self.as_region().is_some() { Schedule::Region } else { Schedule::Slab };
        let mut core = match self {
            Frame::Slab(frame) => frame.core,
            Frame::Region(frame) => frame.core,
        };
        let now = core.ended.unwrap_or(now);
        for (id, transfer) in cluster.residency.split_transfers(now) {
            if transfer.since < now {
                core.ledger.transfer_ended(id, transfer, now);
            }
        }
        for (id, _) in cluster.roster.iter() {
            let held = cluster.residency.held_of_set(id, core.job.scene.bricks);
            core.ledger.set_held(id, held);
        }
        let bricks = BrickStats {
            relevant: core.job.bricks.len() as u64,
            needed: core.brick_use.bricks,
            needed_voxels: core.brick_use.voxels,
        };
        let quality = core.job.scene.quality;
        let relevant = core.relevant_voxels;
        let (stats, spans) =
            core.ledger.close(core.job.number, schedule, quality, relevant, bricks, now);
        let (frame, state) = (core.job.frame, Box::new(core.picture));
        Action::FrameDone { frame, state, stats: Box::new(stats), spans }
    }
}

#[cfg(test)]
mod tests;
