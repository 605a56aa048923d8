//! The state machine itself: takes events in, advances frames, queues actions.

use crate::dispatch::lend::Ahead;
use crate::policy::active_set::ActiveSet;
use crate::policy::link_use::LinkUse;
use crate::policy::region::{self, CostHistory};
use crate::state::cluster::Cluster;
use crate::state::frame::{Frame, Step, StepContext, carry, goes_by_region};
use crate::state::residency::{self, Residency};
use crate::state::workers::{self, Roster};
use crate::{Action, Clock, Config, Event, FrameJob, Micros, Totals, WorkerView};
use slabcast_common::ids::{SceneId, WorkerId};
use slabcast_common::link::FRAMES_IN_FLIGHT;
use slabcast_common::message::ToWorker;
use std::collections::{BTreeSet, VecDeque};

/// Tuning (frames): frames in flight while bricks saturate the link ([`LinkUse::is_full`]). An idle
/// thread then waits for bricks, and more frames only make more workers request them. mri256 at
/// 512x512 and 1 Gbit/s reaches 17 to 21 % of linear speedup on 16 workers with four in flight and
/// 24 with two, on 32 workers 10 to 11 and 13.
const FRAMES_ON_A_FULL_LINK: usize = 2;

/// The state machine; see the head of the crate.
#[derive(Debug)]
pub struct Scheduler {
    cluster: Cluster,
    waiting: VecDeque<Box<FrameJob>>,
    /// Frames in the making, in their order.
    active: VecDeque<Frame>,
    /// Scenes to be forgotten when their frames are done.
    ended: BTreeSet<SceneId>,
}

impl Scheduler {
    /// No workers, no frames.
    pub fn new(config: Config) -> Self {
        Scheduler {
            cluster: Cluster {
                config,
                roster: Roster::default(),
                residency: Residency::default(),
                history: CostHistory::default(),
                link_use: LinkUse::default(),
                active_set: ActiveSet::default(),
                out: VecDeque::new(),
                next_task: 0,
                totals: Totals::default(),
                fresh: Vec::new(),
                sated: Vec::new(),
            },
            waiting: VecDeque::new(),
            active: VecDeque::new(),
            ended: BTreeSet::new(),
        }
    }

    /// Takes in what happened. Events of workers that are not known (any more) do nothing.
    pub fn handle(&mut self, clock: &dyn Clock, event: Event) {
        let now = clock.now();
        // Regions hang on leases and results alone, not on what bricks do meanwhile.
        let quiet = match &event {
            Event::WorkerHeard { .. } => true,
            Event::BricksIn { .. }
            | Event::BricksWanted { .. }
            | Event::BricksForgotten { .. }
            | Event::Pong { .. } => {
                !self.active.is_empty() && self.active.iter().all(Frame::by_region)
            }
            Event::Tick => self.prefetch_is_due(),
            _ => false,
        };
        let due = self.deadline().is_some_and(|due| due <= now);
        // Whom alone a result makes room at.
        let mut only = None;
        let cluster = &mut self.cluster;
        cluster.roster.watch(now, &cluster.config);
        match event {
            Event::WorkerJoined { worker, name, threads, is_local, memory_budget_bytes, held } => {
                cluster.residency.join(worker, memory_budget_bytes, held);
                cluster.roster.join(worker, name, (threads, is_local), now);
                for frame in &mut self.active {
                    frame.joined(cluster, worker, now);
                }
            }
            Event::WorkerHeard { worker } => cluster.roster.heard(worker, now),
            Event::WorkerLost { worker, .. } => self.lose(worker, true, now),
            Event::WorkerLeaving { worker } => {
                cluster.roster.heard(worker, now);
                if cluster.roster.leaves(worker) {
                    let mut threads = cluster.roster.get(worker).map_or(0, |w| w.threads);
                    for frame in &mut self.active {
                        frame.leaving(worker, threads);
                        threads = threads.saturating_sub(frame.leases(worker));
                    }
                }
            }
            Event::FrameQueued(job) => self.waiting.push_back(job),
            Event::CancelFrame { frame } => {
                self.waiting.retain(|job| job.frame != frame);
                if let Some(i) = self.active.iter().position(|f| f.job.frame == frame)
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
                // What comes from this machine crosses no link.
                if from.is_some_and(|w| !w.is_local) {
                    cluster.link_use.result(result.bytes.unwrap_or(0).into());
                }
                let known = from.is_some();
                let lent = |f: &Frame| f.has_lent(worker, result.task, result.epoch);
                let whose = self.active.iter().position(lent).unwrap_or(0);
                match self.active.get_mut(whose) {
                    Some(frame) if known => {
                        let outcome = frame.result(cluster, worker, *result, clock);
                        match outcome {
                            Err(reason) => self.drop_worker(worker, reason, false, now),
                            Ok(rendered) => {
                                only = (!due).then_some(worker);
                                if cluster.residency.is_lazy(worker) {
                                    carry(cluster, Some(&mut frame.ledger), worker, now);
                                }
                                self.rendered_elsewhere(whose, worker, rendered);
                                self.foresee_fresh(whose);
                                if self.calls_all_now(now) {
                                    only = None;
                                }
                            }
                        }
                    }
                    _ => cluster.totals.dropped_results += 1,
                }
            }
            Event::Failed { worker, task, epoch, reason } => {
                cluster.roster.heard(worker, now);
                let lent = |f: &&mut Frame| f.has_lent(worker, task, epoch);
                if let Some(frame) = self.active.iter_mut().find(lent) {
                    cluster.active_set.call_all();
                    cluster.roster.halve(0);
                    frame.failed(cluster, worker, task, epoch, reason);
                }
            }
            Event::HandedOver { worker, piece } => {
                cluster.roster.heard(worker, now);
                let lent = |f: &&mut Frame| f.has_lent(worker, piece.task, piece.epoch);
                if let Some(frame) = self.active.iter_mut().find(lent)
                    && let Err(reason) = frame.handed_over(cluster, worker, *piece, now)
                {
                    self.drop_worker(worker, reason, false, now);
                }
            }
            Event::BricksIn { worker, set, bricks } => {
                cluster.roster.heard(worker, now);
                let before = cluster.residency.held_of_set(worker, set).1;
                let landed = cluster.residency.arrived(worker, set, bricks);
                let bytes = cluster.residency.held_of_set(worker, set).1 - before;
                cluster.link_use.land(bytes, landed.is_some(), now);
                self.after_bricks(worker, landed, now);
            }
            Event::BricksBroken { worker, set, bricks } => {
                cluster.roster.heard(worker, now);
                if cluster.residency.was_sent(worker, set, &bricks) {
                    let landed = cluster.residency.broken(worker, set, &bricks);
                    cluster.link_use.land(0, landed.is_some(), now);
                    self.after_bricks(worker, landed, now);
                } else {
                    // Its name was spoilt, too: nobody knows which one it lacks. When it dials
                    // again it says which it holds.
                    let reason = "it named a broken brick that was not sent to it".to_string();
                    self.drop_worker(worker, reason, false, now);
                }
            }
            Event::BricksWanted { worker, set, bricks } => {
                cluster.roster.heard(worker, now);
                let places = cluster.residency.indices(set, &bricks);
                cluster.residency.request(worker, set, places);
                self.after_bricks(worker, None, now);
            }
            Event::BricksForgotten { worker, set, bricks } => {
                cluster.roster.heard(worker, now);
                cluster.residency.evicted(worker, set, &bricks);
                self.after_bricks(worker, None, now);
            }
            Event::Pong { worker, nonce, clock_us } => {
                cluster.roster.heard(worker, now);
                if cluster.roster.pong(worker, nonce, clock_us, now) {
                    cluster.residency.ponged(worker, nonce);
                    self.after_bricks(worker, None, now);
                }
            }
            Event::Tick => {
                if let Some(frame) = self.active.iter_mut().find(|f| f.foresees()) {
                    frame.foresee(cluster, now);
                }
            }
        }
        if !quiet || due {
            self.advance(only, clock);
        }
    }

    /// Bricks are on the account of the first frame in the making, whichever of several asked.
    fn after_bricks(&mut self, worker: WorkerId, landed: Option<residency::Transfer>, now: Micros) {
        if let (Some(frame), Some(transfer)) = (self.active.front_mut(), landed) {
            frame.landed(worker, transfer, now);
        }
        let ledger = self.active.front_mut().map(|f| &mut f.ledger);
        carry(&mut self.cluster, ledger, worker, now);
    }

    /// Whether those in reserve are called up for a first frame that takes long to draw.
    fn calls_all_now(&mut self, now: Micros) -> bool {
        let Cluster { roster, active_set, .. } = &mut self.cluster;
        // Asked after each result, and hardly ever in need of an answer.
        let asked = active_set.is_first() && roster.in_reserve() > 0;
        let Some(frame) = self.active.front().filter(|_| asked) else { return false };
        let calls = active_set.calls_all_now(frame.ledger.rendered_us(), roster.threads(), now);
        if calls {
            roster.halve(0);
        }
        calls
    }

    /// Bricks came out that nobody drew from lately: who draws beside will need them.
    fn foresee_fresh(&mut self, whose: usize) {
        let fresh = std::mem::take(&mut self.cluster.fresh);
        if fresh.is_empty() {
            return;
        }
        let set = self.active[whose].job.scene.bricks;
        for frame in &self.active {
            if frame.job.scene.bricks == set {
                frame.foresee_fresh(&mut self.cluster, &fresh);
            }
        }
        self.cluster.fresh = fresh;
        self.cluster.fresh.clear();
    }

    /// A worker drew for one frame while the others were in the making.
    fn rendered_elsewhere(
        &mut self,
        whose: usize,
        worker: WorkerId,
        rendered: Option<(Micros, Micros)>,
    ) {
        let Some(when) = rendered else { return };
        for (i, frame) in self.active.iter_mut().enumerate() {
            if i != whose && !frame.is_done() {
                frame.ledger.rendered_elsewhere(worker, when);
            }
        }
    }

    /// A worker is gone.
    fn lose(&mut self, id: WorkerId, blame: bool, now: Micros) {
        let Some(worker) = self.cluster.roster.remove(id) else { return };
        self.cluster.totals.lost_workers += 1;
        let mut threads = worker.threads;
        for frame in &mut self.active {
            let leases = frame.leases(id);
            let blame = (blame && !worker.leaving, threads);
            frame.lost(&mut self.cluster, id, &worker, blame, now);
            threads = threads.saturating_sub(leases);
        }
        if self.cluster.residency.transfer(id).is_some() {
            self.cluster.link_use.land(0, true, now);
        }
        self.cluster.residency.leave(id);
        self.cluster.history.forget(id);
    }

    fn drop_worker(&mut self, worker: WorkerId, reason: String, blame: bool, now: Micros) {
        self.lose(worker, blame, now);
        self.cluster.out.push_back(Action::Drop { worker, reason });
    }

    /// Does what is due, and goes as far as it can.
    fn advance(&mut self, only: Option<WorkerId>, clock: &dyn Clock) {
        let now = clock.now();
        for worker in self.cluster.roster.silent(now, &self.cluster.config) {
            let secs = self.cluster.config.silence as f64 / 1e6;
            self.drop_worker(worker, format!("silent for {secs} s"), true, now);
        }
        for (worker, nonce) in self.cluster.roster.beat(now, &self.cluster.config) {
            self.cluster.send(worker, ToWorker::Ping { nonce });
        }
        for frame in &mut self.active {
            frame.tick(now);
        }
        let mut only = only;
        while self.go_on(only, clock) {
            only = None;
        }
        if self.is_idle() {
            self.cluster.tell_what_is_over();
        }
        self.forget_scenes();
    }

    /// Lends what can be lent, each worker its own first, frame after frame; then, to threads that
    /// are still dry, what is others'. Whether a frame came to its end, so that there is more to
    /// do.
    ///
    /// After a result there is room at the worker that it came from, and `only` there: the others
    /// were asked before, and nothing has changed for them. (64 workers send 500 results a frame.)
    fn go_on(&mut self, only: Option<WorkerId>, clock: &dyn Clock) -> bool {
        let mut ended = false;
        let mut only = only;
        self.find_sated(only);
        let mut i = 0;
        loop {
            if i == self.active.len() {
                if !self.may_begin() {
                    break;
                }
                let Some(job) = self.waiting.pop_front() else { break };
                if self.active.is_empty() {
                    self.cluster.link_use.begin(clock.now());
                    self.cluster.active_set.begin(clock.now());
                }
                let alone = self.active.is_empty() && self.waiting.is_empty();
                let (set, by_region) = (job.scene.bricks, goes_by_region(&job));
                let beside = (self.beside(), alone);
                self.active.push_back(Frame::start(job, beside, &mut self.cluster, clock));
                let Cluster { roster, residency, active_set, .. } = &mut self.cluster;
                let workers = roster.iter().filter(|(_, w)| !w.leaving).count();
                let workers = (workers, residency.workers_to_hold(set));
                roster.halve(if by_region { active_set.halved(set, alone, workers) } else { 0 });
                // To it, all are new, and to the one before it is no longer the last.
                if only.take().is_some() {
                    self.find_sated(None);
                }
            }
            let context = StepContext { freed_worker: only, ..self.context(i, false) };
            match self.active[i].step(&mut self.cluster, context, clock) {
                Step::Waits | Step::Done => i += 1,
                Step::Failed(reason) => {
                    let mut failed = self.active.remove(i).expect("it was just stepped");
                    failed.end(&mut self.cluster);
                    let frame = failed.job.frame;
                    self.cluster.out.push_back(Action::FrameFailed { frame, reason });
                    ended = true;
                }
            }
        }
        for i in 0..self.active.len() {
            if self.active[i].by_region() && !self.active[i].is_done() {
                let context = StepContext { freed_worker: only, ..self.context(i, true) };
                self.active[i].step(&mut self.cluster, context, clock);
            }
        }
        while self.active.front().is_some_and(Frame::is_done) {
            let Some(mut done) = self.active.pop_front() else { break };
            done.end(&mut self.cluster);
            let (beside, now) = (!self.active.is_empty(), clock.now());
            self.cluster.link_use.done(beside, now);
            if done.by_region() && beside != done.is_alone() {
                let roster = &self.cluster.roster;
                let drawing = (roster.active().count(), roster.threads());
                let link_use = &self.cluster.link_use;
                let full = if beside { link_use.is_full() } else { link_use.is_full_alone() };
                self.cluster.active_set.done(
                    (!beside, full),
                    done.ledger.rendered_us(),
                    drawing,
                    now,
                );
            }
            let done = done.finish(&mut self.cluster, clock.now());
            self.cluster.out.push_back(done);
            ended = true;
        }
        ended
    }

    /// Which crew has the least frames in the making and may draw the next one; `None` where it is
    /// the only one, and where the link does not bear crews.
    fn beside(&self) -> Option<u32> {
        let frames = |i: &u32| {
            let crews = self.active.iter().filter_map(Frame::crew);
            crews.filter(|c| c.is_busy_as(*i)).count()
        };
        let alone = self.active.is_empty() && self.waiting.is_empty();
        let bears = self.cluster.link_use.bears_crews();
        (0..region::CREWS).min_by_key(frames).filter(|_| !alone && bears)
    }

    /// Who has enough to draw for a while ([`Ahead::refill`]), among all or of one worker.
    fn find_sated(&mut self, only: Option<WorkerId>) {
        let roster = &self.cluster.roster;
        let ahead = u64::from(self.cluster.config.queue_ahead.max(1));
        let most = Ahead::of(roster);
        let enough = |id: WorkerId, w: &workers::Worker| {
            let threads = u64::from(w.threads);
            let lent = || self.active.iter().map(|f| f.lent_us(id)).sum::<f64>();
            w.leases >= threads.saturating_mul(ahead.max(2)) && lent() >= most.refill(threads)
        };
        self.cluster.sated = match only {
            Some(id) => roster.get(id).filter(|w| enough(id, w)).map(|_| id).into_iter().collect(),
            None => roster.active().filter(|(id, w)| enough(*id, w)).map(|(id, _)| id).collect(),
        };
    }

    /// Whether the next frame may begin beside those in the making: both go by region and share
    /// their bricks, and some thread has nothing more to do.
    fn may_begin(&self) -> bool {
        if self.active.is_empty() {
            return true;
        }
        let full = self.cluster.link_use.is_full();
        let most = if full { FRAMES_ON_A_FULL_LINK } else { FRAMES_IN_FLIGHT };
        if self.active.len() >= most || !self.follows() {
            return false;
        }
        let ahead = u64::from(self.cluster.config.queue_ahead.max(1));
        self.cluster.roster.active().any(|(_, w)| w.leases < u64::from(w.threads) * ahead)
    }

    /// Whether the next frame in the queue goes by region on the bricks of those in the making.
    fn follows(&self) -> bool {
        let next = self.waiting.front().filter(|job| goes_by_region(job));
        let beside =
            |f: &Frame, job: &FrameJob| f.by_region() && f.job.scene.bricks == job.scene.bricks;
        next.is_some_and(|job| self.active.iter().all(|f| beside(f, job)))
    }

    /// What a step of the frame at index `i` may do.
    fn context(&self, i: usize, may_steal: bool) -> StepContext {
        let is_last_frame = i + 1 == self.active.len() && !self.follows();
        StepContext { may_steal, is_last_frame, freed_worker: None }
    }

    /// Ends scenes that have no frame left.
    fn forget_scenes(&mut self) {
        let used = |scene: SceneId| {
            let waiting = self.waiting.iter().map(|job| job.scene.id);
            waiting.chain(self.active.iter().map(|f| f.job.scene.id)).any(|s| s == scene)
        };
        let over: Vec<_> = self.ended.iter().copied().filter(|&s| !used(s)).collect();
        for scene in over {
            self.ended.remove(&scene);
            let ids: Vec<_> = self.cluster.roster.iter().map(|(id, _)| id).collect();
            for id in ids {
                let worker = self.cluster.roster.get_mut(id).expect("just listed");
                if worker.scenes.remove(&scene) {
                    self.cluster.send(id, ToWorker::EndScene { scene });
                }
            }
        }
    }

    /// The next thing to do, if any.
    pub fn next_action(&mut self) -> Option<Action> {
        self.cluster.out.pop_front()
    }

    /// When [`Event::Tick`] is due at the latest. 0: as soon as nothing else has happened.
    pub fn next_deadline(&self) -> Option<Micros> {
        if self.prefetch_is_due() { Some(0) } else { self.deadline() }
    }

    /// Whether a frame has bricks to send ahead.
    pub fn prefetch_is_due(&self) -> bool {
        self.active.iter().any(Frame::foresees)
    }

    /// When something is due.
    fn deadline(&self) -> Option<Micros> {
        let frame = self.active.iter().filter_map(Frame::next_deadline).min();
        let roster = self.cluster.roster.next_deadline();
        roster.into_iter().chain(frame).min()
    }

    /// The workers, by id.
    pub fn workers(&self) -> Vec<WorkerView> {
        let view = |(id, w): (WorkerId, &workers::Worker)| {
            let leases = self.active.iter().map(|f| f.leases(id)).sum::<u32>();
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
            }
        };
        self.cluster.roster.iter().map(view).collect()
    }

    /// How many workers are held in reserve ([`WorkerView::in_reserve`]).
    pub fn in_reserve(&self) -> usize {
        self.cluster.roster.in_reserve()
    }

    /// Counts over the scheduler's life.
    pub fn totals(&self) -> Totals {
        self.cluster.totals
    }

    /// Whether there is no frame to render.
    pub fn is_idle(&self) -> bool {
        self.active.is_empty() && self.waiting.is_empty()
    }

    /// Whether there is a worker, leaving or not.
    pub fn has_workers(&self) -> bool {
        !self.cluster.roster.is_empty()
    }
}
