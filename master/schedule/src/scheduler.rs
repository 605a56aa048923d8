//! The state machine itself: takes events in, advances frames, queues actions.

use crate::dispatch::lend::LendAhead;
use crate::policy::active_set::{ActiveSet, FrameCost};
use crate::policy::cost_history::CostHistory;
use crate::policy::cost_model::CostModel;
use crate::policy::link_use::{FrameLoad, LinkUse};
use crate::state::audits::Lie;
use crate::state::brick_orders::send_bricks;
use crate::state::cluster::Cluster;
use crate::state::frame::{Frame, Step, StepContext, uses_regions};
use crate::state::given_up::GivenUp;
use crate::state::region_frame::RegionFrame;
use crate::state::reputation::Reputations;
use crate::state::residency::{Residency, Transfer};
use crate::state::workers::{LANES, Newcomer, Roster, Worker};
use crate::{Action, Clock, Config, Event, FrameJob, Micros, Totals, WorkerIdentity, WorkerView};
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{Epoch, FrameId, SceneId, TaskId, WorkerId};
use slabcast_common::link::{FRAMES_IN_FLIGHT, MOST_FRAMES_IN_FLIGHT, MOST_LIVE_FRAMES};
use slabcast_common::message::{ToWorker, is_live};
use slabcast_common::occlusion::Rect;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Tuning (frames): frames in flight while bricks saturate the link ([`LinkUse::is_saturated`]). An
/// idle thread then waits for bricks, and more frames only make more workers request them. mri256
/// at 512x512 and 1 Gbit/s reaches 17 to 21 % of linear speedup on 16 workers with four in flight
/// and 24 with two, on 32 workers 10 to 11 and 13.
const FRAMES_ON_A_SATURATED_LINK: usize = 2;

/// Limit: liars that are remembered, so that each is shut out once.
const MAX_SHUT_OUT: usize = 1024;

/// Decides which brick and which tile goes to which worker, and when; see the head of the crate.
#[derive(Debug)]
pub struct Scheduler {
    cluster: Cluster,
    /// Frames that have not begun, in order.
    waiting: VecDeque<Box<FrameJob>>,
    /// Frames in flight, in order.
    active: VecDeque<Frame>,
    /// Scenes to be forgotten when their frames are done.
    ended: BTreeSet<SceneId>,
    /// Workers that were found to lie.
    shut_out: BTreeSet<WorkerId>,
    /// Whether frames of several clients were in flight when `dispatch_as` ran last.
    was_shared: bool,
}

impl Scheduler {
    /// Makes a scheduler without workers and frames.
    pub fn new(config: Config) -> Self {
        Scheduler {
            cluster: Cluster {
                config,
                roster: Roster::default(),
                reputations: Reputations::default(),
                lies: Vec::new(),
                residency: Residency::default(),
                history: CostHistory::default(),
                link_use: LinkUse::default(),
                active_set: ActiveSet::default(),
                out: VecDeque::new(),
                next_task: 0,
                totals: Totals::default(),
                newly_used: Vec::new(),
                saturated: Vec::new(),
            },
            waiting: VecDeque::new(),
            active: VecDeque::new(),
            ended: BTreeSet::new(),
            shut_out: BTreeSet::new(),
            was_shared: false,
        }
    }

    /// Takes in an event at `clock`'s time. Events of workers that are not known (any more) do
    /// nothing.
    pub fn handle(&mut self, clock: &dyn Clock, event: Event) {
        let now = clock.now();
        // Regions hang on leases and results alone, not on what bricks do meanwhile.
        let is_quiet = match &event {
            Event::WorkerHeard { .. } => true,
            Event::BricksIn { .. }
            | Event::BricksWanted { .. }
            | Event::BricksForgotten { .. }
            | Event::Pong { .. } => {
                !self.active.is_empty() && self.active.iter().all(|f| f.as_region().is_some())
            }
            Event::Tick => self.prefetch_is_due(),
            _ => false,
        };
        let is_due = self.deadline().is_some_and(|due| due <= now);
        let mut freed_worker = None;
        let cluster = &mut self.cluster;
        cluster.roster.watch(now, &cluster.config);
        match event {
            Event::WorkerJoined {
                worker,
                name,
                identity,
                threads,
                is_trusted,
                is_local,
                memory_budget_bytes,
                held,
            } => {
                cluster.residency.join(worker, memory_budget_bytes, held);
                let identity = cluster.roster.free_identity(identity);
                let reputation = cluster.reputations.recall(&identity);
                let newcomer =
                    Newcomer { name, identity, reputation, threads, is_local, is_trusted };
                cluster.roster.join(worker, newcomer, now);
                cluster.pause(worker, now);
                for frame in &mut self.active {
                    frame.joined(cluster, worker, now);
                }
            }
            Event::WorkerHeard { worker } => cluster.roster.heard(worker, now),
            Event::WorkerLost { worker, .. } => self.lose(worker, true, now),
            Event::WorkerLeaving { worker } => {
                cluster.roster.heard(worker, now);
                if cluster.roster.leaves(worker) {
                    let all = cluster.roster.get(worker).map_or(0, |w| w.threads);
                    let mut threads = BTreeMap::new();
                    for frame in &mut self.active {
                        let threads = threads.entry(frame.client()).or_insert(all);
                        frame.leaving(worker, *threads);
                        *threads = threads.saturating_sub(frame.core().leases(worker));
                    }
                }
            }
            Event::FrameQueued(job) => self.waiting.push_back(job),
            Event::CancelFrame { frame } => {
                self.waiting.retain(|job| job.frame != frame);
                if let Some(i) = self.active.iter().position(|f| f.core().job.frame == frame)
                    && let Some(mut cancelled) = self.active.remove(i)
                {
                    cancelled.end(&mut self.cluster);
                }
            }
            Event::SceneEnded { scene } => {
                self.ended.insert(scene);
            }
            Event::Result { worker, result } => {
                cluster.roster.heard(worker, now);
                let from = cluster.roster.get(worker);
                // Results of local workers cross no link.
                if from.is_some_and(|w| !w.is_local) {
                    cluster.link_use.result_arrived(result.bytes.unwrap_or(0).into());
                }
                let is_known = from.is_some();
                let has_lent = |f: &Frame| f.has_lent(worker, result.task, result.epoch);
                let index = self.active.iter().position(has_lent).unwrap_or(0);
                match self.active.get_mut(index) {
                    Some(frame) if is_known => {
                        match frame.result(cluster, worker, *result, clock) {
                            Err(reason) => self.drop_worker(worker, reason, false, now),
                            Ok(rendered) => {
                                let is_entered = rendered.is_some();
                                freed_worker = (!is_due && is_entered).then_some(worker);
                                let from = cluster.roster.get_mut(worker);
                                if let Some(from) = from.filter(|_| rendered.is_some()) {
                                    from.reputation.add_result();
                                }
                                if cluster.residency.is_lazy(worker) {
                                    let ledger = &mut frame.core_mut().ledger;
                                    send_bricks(cluster, Some(ledger), worker, now);
                                }
                                self.note_other_rendering(index, worker, rendered);
                                self.prefetch_newly_used(index);
                                if self.grow_first_frame() {
                                    freed_worker = None;
                                }
                            }
                        }
                    }
                    _ => cluster.totals.dropped_results += 1,
                }
                for lie in std::mem::take(&mut self.cluster.lies) {
                    freed_worker = None;
                    self.shut_out(lie, now);
                }
            }
            Event::Failed { worker, task, epoch, reason } => {
                cluster.roster.heard(worker, now);
                let has_lent = |f: &&mut Frame| f.has_lent(worker, task, epoch);
                if let Some(frame) = self.active.iter_mut().find(has_lent) {
                    cluster.activate_all();
                    frame.failed(cluster, worker, task, epoch, reason, now);
                    cluster.strike(worker);
                    cluster.pause(worker, now);
                }
            }
            Event::HandedOver { worker, piece } => {
                cluster.roster.heard(worker, now);
                let has_lent = |f: &&mut Frame| f.has_lent(worker, piece.task, piece.epoch);
                if let Some(frame) = self.active.iter_mut().find(has_lent)
                    && let Err(reason) = frame.handed_over(cluster, worker, *piece, now)
                {
                    self.drop_worker(worker, reason, false, now);
                }
            }
            Event::BricksIn { worker, set, bricks } => {
                cluster.roster.heard(worker, now);
                let before = cluster.residency.held_of_set(worker, set).1;
                let ended = cluster.residency.arrived(worker, set, bricks);
                let bytes = cluster.residency.held_of_set(worker, set).1 - before;
                cluster.link_use.bricks_arrived(bytes, ended.is_some(), now);
                self.after_bricks(worker, Some(set), ended, now);
            }
            Event::BricksBroken { worker, set, bricks } => {
                cluster.roster.heard(worker, now);
                if cluster.residency.was_sent(worker, set, &bricks) {
                    let ended = cluster.residency.broken(worker, set, &bricks);
                    cluster.link_use.bricks_arrived(0, ended.is_some(), now);
                    self.after_bricks(worker, Some(set), ended, now);
                } else {
                    // Its name is damaged too: nobody knows which brick it lacks. When it connects
                    // again it says which it holds.
                    let reason = "it named a broken brick that was not sent to it".to_string();
                    self.drop_worker(worker, reason, false, now);
                }
            }
            Event::BricksWanted { worker, set, bricks } => {
                cluster.roster.heard(worker, now);
                let indices = cluster.residency.indices(set, &bricks);
                cluster.residency.request(worker, set, indices);
                self.after_bricks(worker, Some(set), None, now);
            }
            Event::BricksForgotten { worker, set, bricks } => {
                cluster.roster.heard(worker, now);
                cluster.residency.evicted(worker, set, &bricks);
                self.after_bricks(worker, Some(set), None, now);
            }
            Event::Pong { worker, nonce, clock_us } => {
                cluster.roster.heard(worker, now);
                if cluster.roster.pong(worker, nonce, clock_us, now) {
                    cluster.residency.ponged(worker, nonce);
                    self.after_bricks(worker, None, None, now);
                }
            }
            Event::Tick => {
                let regions = self.active.iter_mut().filter_map(Frame::as_region_mut);
                if let Some(frame) = regions.into_iter().find(|f| f.has_prefetch()) {
                    frame.prefetch(cluster, now);
                }
            }
        }
        let woken = self.cluster.roster.take_woken();
        for &worker in &woken {
            self.active.iter_mut().for_each(|frame| frame.take_leases_for_good(worker));
        }
        if !is_quiet || is_due || !woken.is_empty() {
            let freed_worker = freed_worker.filter(|_| woken.is_empty());
            self.advance(freed_worker, clock);
        }
    }

    /// Sends bricks to a worker. The transfer counts for the first frame in flight that is drawn from
    /// `set`, or else for the first frame in flight.
    fn after_bricks(
        &mut self,
        worker: WorkerId,
        set: Option<BrickSetKey>,
        ended: Option<Transfer>,
        now: Micros,
    ) {
        let is_of = |f: &Frame| set.is_some_and(|set| f.core().job.scene.bricks == set);
        let payer = self.active.iter().position(is_of).unwrap_or(0);
        if let (Some(frame), Some(transfer)) = (self.active.get_mut(payer), ended) {
            frame.transfer_ended(worker, transfer, now);
        }
        let ledger = self.active.get_mut(payer).map(|f| &mut f.core_mut().ledger);
        send_bricks(&mut self.cluster, ledger, worker, now);
    }

    /// Prefetches bricks that a result of the frame at `index` used for the first time lately.
    fn prefetch_newly_used(&mut self, index: usize) {
        let newly_used = std::mem::take(&mut self.cluster.newly_used);
        if newly_used.is_empty() {
            return;
        }
        let set = self.active[index].core().job.scene.bricks;
        for frame in self.active.iter().filter_map(Frame::as_region) {
            if frame.core.job.scene.bricks == set {
                frame.prefetch_newly_used(&mut self.cluster, &newly_used);
            }
        }
        self.cluster.newly_used = newly_used;
        self.cluster.newly_used.clear();
    }

    /// Notes in the other frames' accounts that a worker rendered for the frame at `index`.
    fn note_other_rendering(
        &mut self,
        index: usize,
        worker: WorkerId,
        rendered: Option<(Micros, Micros)>,
    ) {
        let Some(when) = rendered else { return };
        for (i, frame) in self.active.iter_mut().enumerate() {
            if i != index && !frame.is_done() {
                frame.core_mut().ledger.rendered_elsewhere(worker, when);
            }
        }
    }

    /// Forgets a worker that is gone, but not what is held against it. `blame`: a task may have
    /// killed it; else it was dropped for what it said.
    fn lose(&mut self, id: WorkerId, blame: bool, now: Micros) {
        let Some(mut worker) = self.cluster.roster.remove(id) else { return };
        self.cluster.totals.lost_workers += 1;
        let mut was_drawing = false;
        // Its threads take turns with clients' tasks, so a task of any client may have killed it.
        let mut threads = BTreeMap::new();
        for frame in &mut self.active {
            let leases = frame.core().leases(id);
            let blame = blame && !worker.leaving;
            let threads = threads.entry(frame.client()).or_insert(worker.threads);
            frame.lost(&mut self.cluster, id, &worker, blame, *threads, now);
            *threads = threads.saturating_sub(leases);
            was_drawing |= blame && leases > 0;
        }
        if was_drawing || !blame {
            worker.reputation.strike();
        }
        self.cluster.reputations.remember(&worker, now);
        if self.cluster.residency.transfer(id).is_some() {
            self.cluster.link_use.bricks_arrived(0, true, now);
        }
        self.cluster.residency.leave(id);
        self.cluster.history.rates.forget(id);
    }

    /// Forgets a worker that drew false pixels, its votes on other tiles, and the frames that have
    /// tiles of it which nobody compared.
    fn shut_out(&mut self, lie: Lie, now: Micros) {
        let Lie { worker, who, frame, tile } = lie;
        // Other tiles of it may be compared after it is gone.
        if !self.shut_out.insert(worker) {
            return;
        }
        if self.shut_out.len() > MAX_SHUT_OUT {
            self.shut_out.pop_first();
        }
        self.active.iter_mut().for_each(|f| f.core_mut().table.queue.forget_votes(&who));
        let is_tainted = |f: &Frame| f.core().has_unaudited(&who);
        let tainted: Vec<usize> =
            (0..self.active.len()).rev().filter(|i| is_tainted(&self.active[*i])).collect();
        self.lose(worker, false, now);
        let identity = WorkerIdentity::clone(&who);
        self.cluster.out.push_back(Action::ShutOut { worker, identity, frame, tile });
        for i in tainted {
            let Some(mut frame) = self.active.remove(i) else { continue };
            frame.end(&mut self.cluster);
            let frame = frame.core().job.frame;
            self.cluster.out.push_back(Action::FrameTainted { frame });
        }
    }

    fn drop_worker(&mut self, worker: WorkerId, reason: String, blame: bool, now: Micros) {
        self.lose(worker, blame, now);
        self.cluster.out.push_back(Action::Drop { worker, reason });
    }

    /// Does what is due, and advances frames as far as possible.
    fn advance(&mut self, mut freed_worker: Option<WorkerId>, clock: &dyn Clock) {
        let now = clock.now();
        for worker in self.cluster.roster.silent(now, &self.cluster.config) {
            let secs = self.cluster.config.silence as f64 / 1e6;
            self.drop_worker(worker, format!("silent for {secs} s"), true, now);
        }
        for (worker, nonce) in self.cluster.roster.beat(now, &self.cluster.config) {
            self.cluster.send(worker, ToWorker::Ping { nonce });
        }
        let unresponsive = self.cluster.roster.mark_unresponsive(now, &self.cluster.config);
        for &worker in &unresponsive {
            self.active.iter_mut().for_each(|frame| frame.share_leases(worker));
        }
        if self.cluster.roster.end_pauses(now) || !unresponsive.is_empty() {
            freed_worker = None;
        }
        for frame in &mut self.active {
            frame.tick(&mut self.cluster, clock);
        }
        while self.step_frames(freed_worker, clock) {
            freed_worker = None;
        }
        if self.is_idle() {
            self.cluster.send_ended_frames();
        }
        self.forget_scenes();
    }

    /// Lends what can be lent: each worker its own tasks, frame after frame; then, to threads that
    /// are still idle, tasks of other workers. Returns whether a frame ended, so that there is more
    /// to do.
    ///
    /// After a result there is room at the worker that it came from, and only there: the others
    /// were asked before, and nothing has changed for them. (64 workers send 500 results a frame.)
    fn step_frames(&mut self, freed_worker: Option<WorkerId>, clock: &dyn Clock) -> bool {
        let mut ended = false;
        let mut freed_worker = freed_worker;
        let mut client = self.active.front().map_or(0, Frame::client);
        self.dispatch_as(client, freed_worker);
        let mut i = 0;
        loop {
            if i == self.active.len() {
                let Some(next) = self.next_to_begin() else { break };
                self.begin_frame(next, clock);
                // To the new frame all workers are new, and the one before is no longer the last.
                if freed_worker.take().is_some() {
                    self.dispatch_as(client, None);
                }
            }
            let of = self.active[i].client();
            if std::mem::replace(&mut client, of) != of {
                self.dispatch_as(client, freed_worker);
            }
            let context = StepContext { freed_worker, ..self.context(i, false) };
            match self.active[i].step(&mut self.cluster, context, clock) {
                Step::Waits | Step::Done => i += 1,
                Step::Failed(given_up) => {
                    if let Some(mut failed) = self.active.remove(i) {
                        failed.end(&mut self.cluster);
                        let frame = failed.core().job.frame;
                        let GivenUp { tile, reason } = *given_up;
                        self.cluster.out.push_back(Action::FrameFailed { frame, reason, tile });
                    }
                    ended = true;
                }
            }
        }
        for i in 0..self.active.len() {
            if self.active[i].as_region().is_some() && !self.active[i].is_done() {
                let of = self.active[i].client();
                if std::mem::replace(&mut client, of) != of {
                    self.dispatch_as(client, freed_worker);
                }
                let context = StepContext { freed_worker, ..self.context(i, true) };
                self.active[i].step(&mut self.cluster, context, clock);
            }
        }
        while let Some(i) = self.next_done() {
            let Some(mut done) = self.active.remove(i) else { break };
            done.end(&mut self.cluster);
            self.learn_from(&done, clock.now());
            let done = done.finish(&mut self.cluster, clock.now());
            self.cluster.out.push_back(done);
            ended = true;
        }
        ended
    }

    /// Returns the index of the first frame that is done and has no earlier frame of the same client
    /// in flight.
    fn next_done(&self) -> Option<usize> {
        let is_held_up = |i: usize| {
            let client = self.active[i].client();
            self.active.range(..i).any(|f| f.client() == client)
        };
        (0..self.active.len()).find(|&i| self.active[i].is_done() && !is_held_up(i))
    }

    /// Begins the frame at an index of the queue.
    fn begin_frame(&mut self, next: usize, clock: &dyn Clock) {
        let Some(job) = self.waiting.remove(next) else { return };
        let is_first = self.active.is_empty();
        if is_first {
            self.cluster.link_use.frame_begins(clock.now());
        }
        let sole = is_first && self.waiting.is_empty();
        let (set, by_region) = (job.scene.bricks, uses_regions(&job));
        let in_flight: BTreeSet<_> =
            self.active.iter().map(|f| f.core().job.scene.bricks).collect();
        let is_alone = in_flight.iter().all(|of| *of == set);
        let lane = self.lane(sole).filter(|_| is_alone);
        self.cluster.residency.open(set, &job.bricks, by_region, &in_flight);
        let frame = Frame::start(job, lane, sole, &mut self.cluster, clock);
        self.active.push_back(frame);
        let Cluster { roster, residency, active_set, .. } = &mut self.cluster;
        let available = roster.staying();
        let needed = residency.workers_to_hold(set);
        let chosen = match by_region && is_alone {
            true => active_set.workers(set, sole, available, needed),
            false => available,
        };
        roster.activate(chosen);
    }

    /// Learns from a frame that ended.
    fn learn_from(&mut self, done: &Frame, now: Micros) {
        let others = !self.active.is_empty();
        let load = self.cluster.link_use.frame_ended(!others, now);
        let sole = done.core().sole;
        // But for the first of a set, a frame that began alone and ends beside others tells of
        // neither kind.
        let is_odd = others == sole && !self.cluster.active_set.is_first();
        // Times mean little if other clients' frames used the threads meanwhile.
        let client = done.client();
        let is_shared = self.active.iter().any(|f| f.client() != client);
        if done.as_region().is_none() || is_odd || is_shared {
            return;
        }
        let cost = self.frame_cost(done, load);
        let available = self.cluster.roster.staying();
        self.cluster.active_set.frame_ended(cost, available);
    }

    /// Returns what a frame cost, or cost so far.
    fn frame_cost(&self, frame: &Frame, load: FrameLoad) -> FrameCost {
        let core = frame.core();
        let tiles = core.rendered.len();
        FrameCost {
            sole: core.sole,
            work_us: core.ledger.rendered_us() as f64,
            serial_us: load.bricks_us + CostModel::default().master_us(tiles),
            frame_us: load.frame_us,
            workers: self.cluster.roster.active().count(),
            threads: self.cluster.roster.threads(),
        }
    }

    /// Activates more workers for the first frame of a set, if rendering is what takes long.
    /// Returns whether it did.
    fn grow_first_frame(&mut self) -> bool {
        // Asked after each result, and hardly ever in need of an answer.
        if !self.cluster.active_set.is_first() || self.cluster.roster.in_reserve() == 0 {
            return false;
        }
        let Some(frame) = self.active.front().filter(|_| !self.is_shared()) else { return false };
        let bricks_us = self.cluster.link_use.bricks_us();
        let cost = self.frame_cost(frame, FrameLoad { frame_us: 0.0, bricks_us });
        let (set, sole) = (frame.core().job.scene.bricks, frame.core().sole);
        let Cluster { roster, active_set, residency, .. } = &mut self.cluster;
        let available = roster.staying();
        let grows = active_set.first_frame_goes_on(cost, available);
        if grows {
            let needed = residency.workers_to_hold(set);
            roster.activate(active_set.workers(set, sole, available, needed));
        }
        grows
    }

    /// Returns the lane of workers with the fewest frames in flight, where the link bears lanes;
    /// `None`: all workers render the frame.
    fn lane(&self, sole: bool) -> Option<u32> {
        let renders = |f: &RegionFrame, lane: u32| f.lane.is_none_or(|l| l == lane);
        let regions = || self.active.iter().filter_map(Frame::as_region);
        let frames = |lane: &u32| regions().filter(|f| renders(f, *lane)).count();
        let may = !sole && self.cluster.link_use.bears_lanes();
        (0..LANES).min_by_key(frames).filter(|_| may)
    }

    /// Whether frames of several clients are in flight.
    fn is_shared(&self) -> bool {
        let mut shares = self.active.iter().map(Frame::client);
        shares.next().is_some_and(|first| shares.any(|client| client != first))
    }

    /// Prepares to dispatch frames of one client: leases of other clients' frames don't count as load
    /// of a worker. Each client's frames are lent out as if they were alone, and workers divide the
    /// time of their threads among clients. Otherwise a client whose tiles take minutes would fill all
    /// workers.
    fn dispatch_as(&mut self, client: u64, freed_worker: Option<WorkerId>) {
        let is_shared = self.is_shared();
        if is_shared || std::mem::replace(&mut self.was_shared, is_shared) {
            let others: Vec<&Frame> = self.active.iter().filter(|f| f.client() != client).collect();
            for (id, worker) in self.cluster.roster.iter_mut() {
                let leases = others.iter().map(|f| u64::from(f.core().leases(id)));
                worker.others_leases = leases.sum();
            }
        }
        self.was_shared = is_shared;
        self.find_saturated(client, freed_worker);
    }

    /// Finds the workers that have enough work of a client for a while. Looks at the freed worker
    /// alone, or at all if there is none.
    fn find_saturated(&mut self, client: u64, freed_worker: Option<WorkerId>) {
        let cluster = &self.cluster;
        let roster = &cluster.roster;
        let queue_ahead = u64::from(cluster.config.queue_ahead.max(1));
        let costs = CostModel::new(&cluster.link_use, roster);
        let ahead = LendAhead::new(costs.lend_ahead_us(), roster);
        let is_enough = |id: WorkerId, w: &Worker| {
            let own = self.active.iter().filter(|f| f.client() == client);
            let regions = own.filter_map(Frame::as_region);
            ahead.is_enough(w, regions.map(|f| f.lent_us(id)).sum(), queue_ahead)
        };
        self.cluster.saturated = match freed_worker {
            Some(id) => {
                roster.get(id).filter(|w| is_enough(id, w)).map(|_| id).into_iter().collect()
            }
            None => roster.active().filter(|(id, w)| is_enough(*id, w)).map(|(id, _)| id).collect(),
        };
    }

    /// Returns the index of the next frame to begin; `None` if no frame may begin. Frames of one client
    /// begin in order. No frame overtakes one of the `slab` schedule, which needs all threads free.
    fn next_to_begin(&self) -> Option<usize> {
        let mut seen = BTreeSet::new();
        for (i, job) in self.waiting.iter().enumerate() {
            if !seen.insert(job.client) {
                continue;
            }
            if self.may_begin(job) {
                return Some(i);
            }
            if !uses_regions(job) {
                break;
            }
        }
        None
    }

    /// Whether a client's next frame may begin beside those in flight. All must be of the `region`
    /// schedule. If the client has frames in flight, they must have the same brick set, and some
    /// thread must be out of the client's work.
    fn may_begin(&self, job: &FrameJob) -> bool {
        if self.active.is_empty() {
            return true;
        }
        let own = self.active.iter().filter(|f| f.client() == job.client).count();
        let by_region = uses_regions(job) && self.active.iter().all(|f| f.as_region().is_some());
        if own == 0 || !by_region {
            let live = self.active.iter().filter(|f| is_live(f.client())).count();
            let room = match is_live(job.client) {
                true => live < MOST_LIVE_FRAMES,
                false => self.active.len() - live < MOST_FRAMES_IN_FLIGHT,
            };
            return by_region && room;
        }
        let is_saturated = self.cluster.link_use.is_saturated();
        let most = if is_saturated { FRAMES_ON_A_SATURATED_LINK } else { FRAMES_IN_FLIGHT };
        if own >= most || !self.overlaps_own(job) {
            return false;
        }
        let ahead = u64::from(self.cluster.config.queue_ahead.max(1));
        let others = |id| {
            let others = self.active.iter().filter(|f| f.client() != job.client);
            others.map(|f| u64::from(f.core().leases(id))).sum::<u64>()
        };
        let mut active = self.cluster.roster.active();
        active.any(|(id, w)| w.leases - others(id) < u64::from(w.threads) * ahead)
    }

    /// Whether a waiting frame can overlap its client's frames in flight: all are of the `region`
    /// schedule and have one brick set.
    fn overlaps_own(&self, job: &FrameJob) -> bool {
        let overlaps =
            |f: &Frame| f.as_region().is_some_and(|f| f.core.job.scene.bricks == job.scene.bricks);
        let mut own = self.active.iter().filter(|f| f.client() == job.client);
        uses_regions(job) && own.all(overlaps)
    }

    /// Returns what a step of the frame at an index may do.
    fn context(&self, i: usize, may_steal: bool) -> StepContext {
        let client = self.active[i].client();
        let is_last = !self.active.range(i + 1..).any(|f| f.client() == client);
        let next = self.waiting.iter().find(|job| job.client == client);
        let is_last_frame = is_last && !next.is_some_and(|job| self.overlaps_own(job));
        StepContext { may_steal, is_last_frame, freed_worker: None }
    }

    /// Ends scenes that have no frame left.
    fn forget_scenes(&mut self) {
        let is_used = |scene: SceneId| {
            let waiting = self.waiting.iter().map(|job| job.scene.id);
            waiting.chain(self.active.iter().map(|f| f.core().job.scene.id)).any(|s| s == scene)
        };
        let over: Vec<_> = self.ended.iter().copied().filter(|&s| !is_used(s)).collect();
        for scene in over {
            self.ended.remove(&scene);
            let ids: Vec<_> = self.cluster.roster.iter().map(|(id, _)| id).collect();
            for id in ids {
                let worker = self.cluster.roster.get_mut(id);
                if worker.is_some_and(|w| w.scenes.remove(&scene)) {
                    self.cluster.send(id, ToWorker::EndScene { scene });
                }
            }
        }
    }

    /// Returns the next action for the driver to carry out; `None` if there is none.
    pub fn next_action(&mut self) -> Option<Action> {
        self.cluster.out.pop_front()
    }

    /// Returns when [`Event::Tick`] is due at the latest. 0: as soon as nothing else has happened.
    pub fn next_deadline(&self) -> Option<Micros> {
        if self.prefetch_is_due() { Some(0) } else { self.deadline() }
    }

    /// Returns whether the next [`Event::Tick`] prefetches bricks of a frame.
    pub fn prefetch_is_due(&self) -> bool {
        self.active.iter().filter_map(Frame::as_region).any(|f| f.has_prefetch())
    }

    /// Returns the next time at which something is due.
    fn deadline(&self) -> Option<Micros> {
        let frame = self.active.iter().filter_map(Frame::next_deadline).min();
        let roster = self.cluster.roster.next_deadline();
        roster.into_iter().chain(frame).min()
    }

    /// Returns all workers on the roster, in order of their ids.
    pub fn workers(&self) -> Vec<WorkerView> {
        let view = |(id, w): (WorkerId, &Worker)| {
            let leases = self.active.iter().map(|f| f.core().leases(id)).sum::<u32>();
            let (bricks_held, bytes_held) = self.cluster.residency.held(id);
            WorkerView {
                id,
                name: w.name.to_string(),
                threads: w.threads,
                bricks_held,
                bytes_held,
                busy: leases.min(w.threads),
                leases,
                since: w.since,
                leaving: w.leaving,
                in_reserve: self.cluster.roster.has_in_reserve(id),
                round_trip: w.round_trip(),
            }
        };
        self.cluster.roster.iter().map(view).collect()
    }

    /// Returns the thread time of a frame in flight so far, in microseconds, from the results that
    /// arrived; `None` if the frame is not in flight.
    pub fn rendered_us(&self, frame: FrameId) -> Option<Micros> {
        let frame = self.active.iter().find(|f| f.core().job.frame == frame)?;
        Some(frame.core().ledger.rendered_us())
    }

    /// Returns the frame and the tile of a lease that a worker has.
    pub fn leased(&self, worker: WorkerId, task: TaskId, epoch: Epoch) -> Option<(FrameId, Rect)> {
        let frame = self.active.iter().find(|f| f.has_lent(worker, task, epoch))?.core();
        let place = frame.table.queue.place(task)?;
        Some((frame.job.frame, frame.table.tile(place)))
    }

    /// Returns the number of workers outside the active set ([`WorkerView::in_reserve`]).
    pub fn in_reserve(&self) -> usize {
        self.cluster.roster.in_reserve()
    }

    /// Returns the counters of mishaps over the scheduler's lifetime.
    pub fn totals(&self) -> Totals {
        self.cluster.totals
    }

    /// Whether no frame is queued or in flight.
    pub fn is_idle(&self) -> bool {
        self.active.is_empty() && self.waiting.is_empty()
    }

    /// Whether there is a worker, leaving or not.
    pub fn has_workers(&self) -> bool {
        !self.cluster.roster.is_empty()
    }
}
