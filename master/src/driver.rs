//! The thread that owns the scheduler.
//!
//! Everything that happens (a worker's message, a client's request, a finished picture, a
//! deadline) reaches it as an event in one bounded queue. It hands what concerns the schedule to
//! the pure state machine and carries out the machine's actions. It never waits for a worker, a
//! disk or a client: links are channels; requests are checked, bricks cut and frames finished on
//! threads of their own, whose panics come back as events. It has a runtime of its own (one
//! thread) for its queue and its timer alone, so that culling a large volume delays no stream.

use crate::admission::{AttachError, WorkerTable};
use crate::brick_sets::BrickSets;
use crate::finish::{Assembly, FrameSums};
use crate::finishers::{FinishTask, Finishers};
use crate::handle::ServedVolume;
use crate::hooks::{Hooks, Stage};
use crate::jobs::active::ActiveJobs;
use crate::jobs::submit::{Plan, SubmitError};
use crate::jobs::{FinishedFrame, JobState, Jobs};
use crate::link::{BrickOrder, Caller, WorkerLink};
use crate::memory;
use crate::panics::{Panicked, caught};
use crate::record::RecordedScheduler;
use slabcast_common::ids::{FrameId, JobId, WorkerId};
use slabcast_common::image::{FrameState, SparseTile};
use slabcast_common::link::FRAMES_IN_FLIGHT;
use slabcast_common::message::{Hello, SceneSpec, ToMaster, ToWorker};
use slabcast_common::occlusion::Rect;
use slabcast_common::stats::FrameStats;
use slabcast_common::volume::Volume;
use slabcast_proto::model::Worker;
use slabcast_schedule::{Action, Clock, Event as Happened, FrameJob, Micros, Spans};
use slabcast_volumes::BrickStore;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot};
use tracing::{debug, info, warn};

/// Jobs that are in progress or can be watched again; each holds its views (300 bytes a frame).
const MAX_OPEN_JOBS: usize = 200;

/// Everything that can happen to the master.
#[expect(clippy::large_enum_variant, reason = "a finished frame is moved once; the queue is short")]
pub(crate) enum Event {
    /// A worker asks to be let in.
    Attach {
        hello: Hello,
        caller: Caller,
        link: WorkerLink,
        reply: oneshot::Sender<Result<WorkerId, AttachError>>,
    },
    /// A worker said something.
    Said { worker: WorkerId, message: ToMaster },
    /// A worker's link ended.
    Detached { worker: WorkerId, reason: String },
    /// A client's request was checked.
    Submit { plan: Box<Plan>, reply: oneshot::Sender<Result<JobId, SubmitError>> },
    /// A job's bricks were cut.
    BricksCut { job: JobId, store: Result<Arc<BrickStore>, Panicked> },
    /// A watcher took a frame, so that there may be room for another.
    FrameTaken,
    /// A frame was finished.
    Finished { job: JobId, flight: FrameId, frame: FinishedFrame },
    /// A finisher panicked over a frame.
    FinishFailed { frame: FrameId, reason: String },
    /// A client cancels a job.
    Cancel { job: JobId, reply: oneshot::Sender<bool> },
    /// Somebody asks for the workers.
    Workers { reply: oneshot::Sender<Vec<Worker>> },
    /// The master ends.
    Shutdown,
}

struct RealClock(Instant);

impl Clock for RealClock {
    fn now(&self) -> Micros {
        self.0.elapsed().as_micros() as Micros
    }
}

/// A frame that the scheduler or a finisher has.
struct Flight {
    job: JobId,
    number: u64,
    scene: Arc<SceneSpec>,
    /// Spans of the log that its lines belong to.
    frame_span: tracing::Span,
    slab_span: Option<(u32, tracing::Span)>,
    /// Picture of the tiles that came finished while others are drawn.
    assembly: Option<Arc<Assembly>>,
}

/// See the head of the file.
pub(crate) struct Driver {
    volume: Arc<Volume>,
    served: Arc<ServedVolume>,
    frame_budget_bytes: usize,
    clock: RealClock,
    rehearse: bool,
    /// Workers in reserve when the log told of it last.
    logged_reserve: usize,
    scheduler: RecordedScheduler,
    workers: WorkerTable,
    last_frame_id: u64,
    jobs: Arc<Jobs>,
    active: ActiveJobs,
    brick_sets: BrickSets,
    flights: BTreeMap<FrameId, Flight>,
    inbox: mpsc::Sender<Event>,
    finishers: Finishers,
    hooks: Hooks,
}

impl Driver {
    pub(crate) fn new(
        (volume, served): (Arc<Volume>, Arc<ServedVolume>),
        frame_budget_bytes: usize,
        rehearse: bool,
        scheduler: RecordedScheduler,
        workers: WorkerTable,
        jobs: Arc<Jobs>,
        (inbox, finishers): (mpsc::Sender<Event>, Finishers),
        hooks: Hooks,
    ) -> Driver {
        Driver {
            volume,
            served,
            frame_budget_bytes,
            clock: RealClock(Instant::now()),
            rehearse,
            logged_reserve: 0,
            scheduler,
            workers,
            last_frame_id: 0,
            jobs,
            active: ActiveJobs::default(),
            brick_sets: BrickSets::default(),
            flights: BTreeMap::new(),
            inbox,
            finishers,
            hooks,
        }
    }

    /// Handles events until the master is told to end.
    pub(crate) async fn run(mut self, mut events: mpsc::Receiver<Event>) {
        loop {
            let deadline = self.scheduler.next_deadline();
            let until = deadline.map(|d| self.clock.0 + Duration::from_micros(d));
            let event = match until {
                None => events.recv().await,
                Some(until) => tokio::select! {
                    biased;
                    event = events.recv() => event,
                    () = tokio::time::sleep_until(until.into()) => {
                        self.scheduler.handle(&self.clock, Happened::Tick);
                        self.act();
                        continue;
                    }
                },
            };
            let Some(event) = event else { break };
            if matches!(event, Event::Shutdown) {
                break;
            }
            self.handle(event);
            // First everything that waits, then the actions, so that leases that belong together
            // leave together. Events that come meanwhile wait for the next round: with many
            // workers there is always another one, and leases must not wait until there is none.
            for _ in 0..events.len() {
                let Ok(event) = events.try_recv() else { break };
                if matches!(event, Event::Shutdown) {
                    self.leave();
                    return;
                }
                self.handle(event);
            }
            self.feed();
            self.act();
        }
        self.leave();
    }

    /// Tells workers and watchers that the master ends.
    fn leave(&mut self) {
        for link in self.workers.links() {
            let reason = "the master ends".to_string();
            let _ = link.control.send(ToWorker::MasterEnding { reason });
        }
        let ids: Vec<JobId> = self.active.ids().collect();
        for id in ids {
            self.end_job(id, JobState::Failed("the master ended".into()));
        }
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Attach { hello, caller, link, reply } => {
                let _ = reply.send(self.attach(hello, caller, link));
            }
            Event::Said { worker, message } => self.said(worker, message),
            Event::Detached { worker, reason } => {
                if let Some(is_leaving) = self.workers.remove(worker) {
                    if is_leaving {
                        info!(%worker, "worker left");
                    } else {
                        warn!(%worker, reason, "worker lost");
                    }
                    self.scheduler.handle(&self.clock, Happened::WorkerLost { worker, reason });
                    self.refresh_states();
                }
            }
            Event::Submit { plan, reply } => {
                let _ = reply.send(self.submit(*plan));
            }
            Event::BricksCut { job, store } => self.bricks_cut(job, store),
            Event::FrameTaken => {}
            Event::Finished { job, flight, frame } => self.finished(job, flight, frame),
            Event::FinishFailed { frame, reason } => self.fail_frame(frame, &reason),
            Event::Cancel { job, reply } => {
                let is_active = self.active.contains(job);
                if is_active {
                    info!(%job, "job cancelled");
                    self.end_job(job, JobState::Cancelled);
                }
                let _ = reply.send(is_active);
            }
            Event::Workers { reply } => {
                let seen = self.scheduler.workers().into_iter();
                let _ = reply.send(seen.filter_map(|w| self.workers.view(w)).collect());
            }
            Event::Shutdown => {}
        }
    }

    // -----------------------------------------------------------------------------------------
    // Workers

    fn attach(
        &mut self,
        hello: Hello,
        caller: Caller,
        link: WorkerLink,
    ) -> Result<WorkerId, AttachError> {
        let admitted = self.workers.admit(&hello, caller, link).inspect_err(|reason| {
            warn!(worker = hello.name, %reason, "worker refused");
        })?;
        let worker = admitted.worker;
        let is_taken = self.scheduler.workers().iter().any(|w| w.name == hello.name);
        let name = if is_taken { format!("{}#{}", hello.name, worker.0) } else { hello.name };
        info!(
            %worker, name, threads = hello.threads, simd = hello.simd,
            held_bricks = hello.held.iter().map(|h| h.1.len()).sum::<usize>(), "worker joined"
        );
        self.scheduler.handle(
            &self.clock,
            Happened::WorkerJoined {
                worker,
                name,
                threads: hello.threads,
                is_local: admitted.is_local,
                memory_budget_bytes: hello.memory_budget_bytes,
                held: hello.held,
            },
        );
        self.refresh_states();
        Ok(worker)
    }

    fn said(&mut self, worker: WorkerId, message: ToMaster) {
        if !self.workers.heard(worker, &message) {
            return;
        }
        let happened = match message {
            ToMaster::Hello(_) => {
                let reason = "the worker said hello twice".to_string();
                self.workers.remove(worker);
                warn!(%worker, reason, "worker dropped");
                self.scheduler.handle(&self.clock, Happened::WorkerLost { worker, reason });
                self.refresh_states();
                return;
            }
            ToMaster::Result(result) => Happened::Result { worker, result },
            ToMaster::Failed { task, epoch, reason } => {
                warn!(%worker, %task, reason, "task failed");
                Happened::Failed { worker, task, epoch, reason }
            }
            ToMaster::RegionSplit(piece) => Happened::HandedOver { worker, piece },
            ToMaster::BricksReceived { set, bricks } => Happened::BricksIn { worker, set, bricks },
            ToMaster::BricksBroken { set, bricks } => {
                warn!(%worker, bricks = bricks.len(), "bricks damaged in transit, sending them again");
                Happened::BricksBroken { worker, set, bricks }
            }
            ToMaster::BricksWanted { set, bricks } => {
                Happened::BricksWanted { worker, set, bricks }
            }
            ToMaster::BricksEvicted { set, bricks } => {
                Happened::BricksForgotten { worker, set, bricks }
            }
            ToMaster::Pong { nonce, clock_us } => Happened::Pong { worker, nonce, clock_us },
            ToMaster::Goodbye { reason } => {
                info!(%worker, reason, "worker is leaving");
                Happened::WorkerLeaving { worker }
            }
        };
        self.scheduler.handle(&self.clock, happened);
    }

    /// Logs how many workers are active, when that has changed.
    fn log_reserve(&mut self) {
        let in_reserve = self.scheduler.in_reserve();
        if std::mem::replace(&mut self.logged_reserve, in_reserve) == in_reserve {
            return;
        }
        let active = self.workers.len().saturating_sub(in_reserve);
        if in_reserve > 0 {
            info!(active, in_reserve, "holding workers in reserve: more would not shorten frames");
        } else {
            info!(active, "no worker is held in reserve");
        }
    }

    // -----------------------------------------------------------------------------------------
    // Jobs

    fn submit(&mut self, plan: Plan) -> Result<JobId, SubmitError> {
        // Another request may have come under this key while this one was checked.
        if let Some(job) = self.jobs.lock().by_key(&plan.request.client_key) {
            let is_same = *job.request == *plan.request;
            return if is_same { Ok(job.view.id) } else { Err(SubmitError::KeyTaken) };
        }
        if self.active.len() >= MAX_OPEN_JOBS {
            return Err(SubmitError::Full);
        }
        let store = self.brick_sets.covering(&plan.wanted).cloned();
        if let Some(store) = &store {
            self.brick_sets.keep(store, |key| self.active.needs(key));
        }
        let mut table = self.jobs.lock();
        let id = table.next_id();
        let entry = plan.entry(id);
        info!(job = %id, frames = entry.view.frames_total, sums = ?plan.quality().sums, "job submitted");
        table.insert(entry);
        drop(table);

        let bricks = match &store {
            Some(store) => store.key(),
            None => plan.wanted.set_key(self.served.info.digest),
        };
        let must_cut = store.is_none();
        let job = plan.activate(id, self.served.info.clone(), bricks, store);
        let wanted = must_cut.then(|| job.wanted.clone());
        self.active.insert(id, job);
        if let Some(wanted) = wanted {
            let (volume, digest) = (self.volume.clone(), self.served.info.digest);
            let (inbox, hooks) = (self.inbox.clone(), self.hooks.clone());
            let cut = move || {
                let store = caught("cutting bricks", || {
                    hooks.reach(Stage::CutBricks);
                    Arc::new(BrickStore::build(&volume, digest, &wanted))
                });
                let _ = inbox.blocking_send(Event::BricksCut { job: id, store });
            };
            let thread = std::thread::Builder::new().name("slabcast-bricks".into());
            if let Err(e) = thread.spawn(cut) {
                self.fail_job(id, format!("no thread to cut bricks: {e}"));
                return Ok(id);
            }
        }
        self.refresh_states();
        Ok(id)
    }

    fn bricks_cut(&mut self, id: JobId, store: Result<Arc<BrickStore>, Panicked>) {
        match store {
            Ok(store) => {
                let (bricks, bytes) = (store.infos().len(), store.bytes());
                info!(job = %id, bricks, bytes, "bricks cut");
                self.brick_sets.keep(&store, |key| self.active.needs(key));
                if let Some(job) = self.active.get_mut(id) {
                    job.store = Some(store);
                }
                self.refresh_states();
            }
            Err(panicked) => self.fail_job(id, panicked.to_string()),
        }
    }

    /// Gives the scheduler frames while there is room for them.
    fn feed(&mut self) {
        self.active.share_bricks(&self.brick_sets);
        while self.flights.len() < FRAMES_IN_FLIGHT {
            let flights = &self.flights;
            let is_in_flight =
                |job, number| flights.values().any(|f| f.job == job && f.number == number);
            let next = {
                let table = self.jobs.lock();
                self.active.next_frame(&table, self.frame_budget_bytes, is_in_flight)
            };
            let Some((id, number)) = next else { return };
            let Some(job) = self.active.get_mut(id) else { return };
            let Some(store) = &job.store else { return };
            let beside = memory::beside_others(job.request.path.size, job.request.format);
            if !beside && !self.flights.is_empty() {
                return;
            }
            if number == job.next {
                job.next += 1;
            }
            self.jobs.lock().rendering_again(id, number);
            self.last_frame_id += 1;
            let frame = FrameId(self.last_frame_id);
            let frame_span = tracing::info_span!("frame", job = %id, number, id = %frame);
            let scene = job.scene_of(number, frame);
            let (slab_span, assembly) = (None, None);
            let flight =
                Flight { job: id, number, scene: scene.clone(), frame_span, slab_span, assembly };
            self.flights.insert(frame, flight);
            let own_scene = job.tween.is_some().then_some(scene.id);
            let queued = FrameJob {
                frame,
                number,
                scene,
                bricks: store.infos().clone(),
                view: job.views[number as usize],
                work: job.request.work,
                finish: (!job.request.want_hash).then(|| job.request.encoding()),
            };
            self.scheduler.handle(&self.clock, Happened::FrameQueued(Box::new(queued)));
            if let Some(scene) = own_scene {
                // It ends with its frame.
                self.scheduler.handle(&self.clock, Happened::SceneEnded { scene });
            }
        }
    }

    /// Forgets how to render the oldest jobs that are done: their last frames stay in the table.
    fn retire(&mut self) {
        let retired = self.active.retired(&self.jobs.lock());
        for id in retired {
            self.deactivate(id);
        }
    }

    fn deactivate(&mut self, id: JobId) {
        self.jobs.lock().retire(id);
        if let Some(job) = self.active.remove(id) {
            let scene = job.scene.id;
            self.scheduler.handle(&self.clock, Happened::SceneEnded { scene });
        }
    }

    /// Ends a job that is not finished.
    fn end_job(&mut self, id: JobId, state: JobState) {
        let frames: Vec<FrameId> =
            self.flights.iter().filter(|(_, f)| f.job == id).map(|(frame, _)| *frame).collect();
        for frame in frames {
            self.flights.remove(&frame);
            self.scheduler.handle(&self.clock, Happened::CancelFrame { frame });
        }
        self.deactivate(id);
        self.jobs.lock().set_state(id, state);
        self.jobs.ring();
        self.refresh_states();
    }

    fn fail_job(&mut self, job: JobId, reason: String) {
        warn!(%job, reason, "job failed");
        self.end_job(job, JobState::Failed(reason));
    }

    /// Fails the job of a frame. Does nothing if its job has ended already.
    fn fail_frame(&mut self, frame: FrameId, reason: &str) {
        if let Some(flight) = self.flights.get(&frame) {
            let (job, number) = (flight.job, flight.number);
            self.fail_job(job, format!("frame {number}: {reason}"));
        }
    }

    /// Updates the state of every job in progress.
    fn refresh_states(&mut self) {
        let workers = self.workers.len() as u32;
        let mut has_changed = false;
        let mut table = self.jobs.lock();
        for id in self.active.ids() {
            let (Some(active), Some(job)) = (self.active.get(id), table.get(id)) else { continue };
            if job.view.state.is_over() {
                continue;
            }
            let state = if active.store.is_none() {
                JobState::Preparing
            } else if workers == 0 {
                JobState::WaitingForWorkers
            } else if active.next > 0 {
                JobState::Running
            } else {
                JobState::Queued
            };
            has_changed |= job.view.state != state || job.view.workers != workers;
            table.set_state(id, state);
            table.update(id, |view| view.workers = workers);
        }
        drop(table);
        if has_changed {
            self.jobs.ring();
        }
    }

    // -----------------------------------------------------------------------------------------
    // The scheduler's actions

    fn act(&mut self) {
        while let Some(action) = self.scheduler.next_action() {
            match action {
                Action::Send { worker, message } => {
                    // A closed link says so itself, by its detach.
                    let Some(link) = self.workers.link(worker) else { continue };
                    if let ToWorker::DropBricks { set, bricks } = message {
                        let _ = link.bricks.send(BrickOrder::Drop { set, bricks });
                    } else {
                        let _ = link.control.send(message);
                    }
                }
                Action::SendBricks { worker, set, bricks } => {
                    let store = self.brick_sets.get(set).or_else(|| self.active.store(set));
                    if let (Some(link), Some(store)) = (self.workers.link(worker), store) {
                        debug!(%worker, bricks = bricks.len(), "bricks sent");
                        let store = store.clone();
                        let _ = link.bricks.send(BrickOrder::Send { set, store, bricks });
                    }
                }
                Action::Drop { worker, reason } => {
                    if self.workers.remove(worker).is_some() {
                        warn!(%worker, reason, "worker dropped");
                    }
                    self.refresh_states();
                }
                Action::Progress { frame, done, total, slab, slabs } => {
                    self.progress(frame, (done, total), (slab, slabs));
                }
                Action::Finished { frame, tiles } => self.compose(frame, tiles),
                Action::FrameDone { frame, state, stats, spans } => {
                    self.finish(frame, state, stats, spans);
                }
                Action::FrameFailed { frame, reason } => self.fail_frame(frame, &reason),
            }
        }
    }

    fn progress(&mut self, frame: FrameId, tiles: (u32, u32), slab: (u32, u32)) {
        let Some(flight) = self.flights.get_mut(&frame) else { return };
        if flight.slab_span.as_ref().is_none_or(|(s, _)| *s != slab.0) {
            let span = tracing::info_span!(parent: &flight.frame_span, "slab", slab = slab.0);
            flight.slab_span = Some((slab.0, span));
        }
        if let Some((_, span)) = &flight.slab_span {
            span.in_scope(|| debug!(done = tiles.0, total = tiles.1, "tiles"));
        }
        self.jobs.lock().update(flight.job, |view| {
            view.tiles = tiles;
            view.slab = slab;
        });
        self.jobs.ring_tile();
    }

    /// Has finished tiles composed into their frame's picture while others are drawn.
    fn compose(&mut self, frame: FrameId, tiles: Vec<(Rect, SparseTile)>) {
        // A rehearsed frame has no pixels.
        let Some(flight) = self.flights.get_mut(&frame).filter(|_| !self.rehearse) else { return };
        let Some(job) = self.active.get(flight.job) else { return };
        let assembly = flight.assembly.get_or_insert_with(|| {
            let size = job.views[flight.number as usize].size;
            Arc::new(Assembly::new(size, job.request.encoding()))
        });
        assembly.add(tiles);
        let task = FinishTask::Compose(frame, assembly.clone());
        self.push(frame, task);
    }

    /// Hands a rendered frame to a finisher.
    fn finish(
        &mut self,
        frame: FrameId,
        state: Box<FrameState>,
        stats: Box<FrameStats>,
        spans: Spans,
    ) {
        let Some(flight) = self.flights.get(&frame) else { return };
        let Some(job) = self.active.get(flight.job) else {
            self.flights.remove(&frame);
            return;
        };
        let sums = Box::new(FrameSums {
            job: flight.job,
            frame,
            request: job.request.clone(),
            scene: flight.scene.clone(),
            crop: job.wanted.crop,
            view: job.views[flight.number as usize],
            state,
            assembly: flight.assembly.clone(),
            stats,
            spans,
            store: job.store.clone(),
            rehearsed: self.rehearse,
        });
        self.push(frame, FinishTask::Finish(sums));
    }

    fn push(&mut self, frame: FrameId, task: FinishTask) {
        if let Err(ended) = self.finishers.push(task) {
            self.fail_frame(frame, &ended.to_string());
        }
    }

    fn finished(&mut self, id: JobId, flight: FrameId, frame: FinishedFrame) {
        // A frame of a job that has ended meanwhile is nobody's.
        let Some(flight) = self.flights.remove(&flight) else { return };
        flight.frame_span.in_scope(|| {
            let FrameStats { ms, pixels_sha256, .. } = &frame.stats;
            info!(ms = ms.total, pixels_sha256, "frame done");
        });
        self.log_reserve();
        let number = frame.number;
        let mut table = self.jobs.lock();
        let is_done = table.put(id, frame);
        table.evict(self.frame_budget_bytes, (id, number));
        drop(table);
        if is_done {
            info!(job = %id, "job done");
            self.retire();
        }
        self.jobs.ring();
        self.refresh_states();
    }
}

#[cfg(test)]
mod tests;
