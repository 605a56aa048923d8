//! The thread that owns the scheduler.
//!
//! Everything that happens (a worker's message, a client's request, a finished picture, a
//! deadline) reaches it as an event in one bounded queue. It hands what concerns the schedule to
//! the pure state machine and carries out the machine's actions. It never waits for a worker, a
//! disk or a client: links are channels; requests are checked, bricks cut and frames finished on
//! threads of their own, whose panics come back as events. It has a runtime of its own (one
//! thread) for its queue and its timer alone, so that culling a large volume delays no stream.

mod actions;
mod feed;
mod jobs;

use crate::admission::{AttachError, WorkerTable};
use crate::brick_sets::BrickSets;
use crate::finish::Assembly;
use crate::finishers::Finishers;
use crate::hooks::Hooks;
use crate::jobs::active::{ActiveJobs, Submitter};
use crate::jobs::submit::{Plan, SubmitError};
use crate::jobs::{FinishedFrame, JobState, Jobs};
use crate::library::Library;
use crate::link::{Caller, WorkerLink};
use crate::memory::Shares;
use crate::record::RecordedScheduler;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{BrickId, FrameId, JobId, WorkerId};
use slabcast_common::message::{Hello, SceneSpec, TOLD_TO_STOP, ToMaster, ToWorker};
use slabcast_common::view::View;
use slabcast_proto::model::Worker;
use slabcast_schedule::{Clock, Event as Happened, Micros};
use slabcast_volumes::BrickStore;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, mpsc, oneshot};
use tracing::{info, warn};

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
    /// A worker said something, in one of the places that it has in the queue.
    Said { worker: WorkerId, message: ToMaster, _place: OwnedSemaphorePermit },
    /// A worker's link ended. `is_damage`: the line was at fault.
    Detached { worker: WorkerId, reason: String, is_damage: bool },
    /// A client's request was checked.
    Submit {
        plan: Box<Plan>,
        submitter: Submitter,
        reply: oneshot::Sender<Result<Admitted, SubmitError>>,
    },
    /// A brick set was cut.
    BricksCut { set: BrickSetKey, store: Result<Arc<BrickStore>, String> },
    /// Bricks that were ordered for a worker can't be read.
    BricksLost { worker: WorkerId, set: BrickSetKey, bricks: Vec<BrickId>, reason: String },
    /// A watcher took a frame, so that there may be room for another, or waits for one.
    FrameTaken,
    /// A frame was finished.
    Finished { job: JobId, flight: FrameId, frame: FinishedFrame },
    /// A finisher panicked over a frame.
    FinishFailed { frame: FrameId, reason: String },
    /// A client cancels a job.
    Cancel { job: JobId, reply: oneshot::Sender<bool> },
    /// Nobody wants a job's frames any more, nor to hear of it.
    Forget { job: JobId },
    /// Somebody asks for the workers.
    Workers { reply: oneshot::Sender<Vec<Worker>> },
    /// The master ends.
    Shutdown,
}

/// A job that was taken.
pub(crate) struct Admitted {
    pub(crate) job: JobId,
    /// Guard of a live session's job; dropping it ends the job. `None` for jobs of clients.
    pub(crate) guard: Option<Forgets>,
}

/// Has the driver forget a job when it is dropped.
pub(crate) struct Forgets {
    job: JobId,
    inbox: mpsc::Sender<Event>,
}

impl Drop for Forgets {
    fn drop(&mut self) {
        let event = Event::Forget { job: self.job };
        let Err(mpsc::error::TrySendError::Full(event)) = self.inbox.try_send(event) else {
            return;
        };
        // The driver is busy; it is told as soon as it has room.
        let inbox = self.inbox.clone();
        if let Ok(runtime) = tokio::runtime::Handle::try_current() {
            runtime.spawn(async move {
                let _ = inbox.send(event).await;
            });
        }
    }
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
    view: View,
    /// The brick set that it is drawn from.
    store: Arc<BrickStore>,
    /// Whether a watcher waited for it when it began.
    wanted: bool,
    /// Number of the client (address) that submitted the job.
    client: u64,
    /// Whether the frame is made in the reserve for addresses without another frame in flight.
    in_reserve: bool,
    /// Whether the frame is drawn by the `slab` schedule.
    is_slab: bool,
    /// Bytes that it takes while it is made, and when it is finished.
    making_bytes: u64,
    finished_bytes: u64,
    /// Thread time of the frame in microseconds; `None` until it is drawn.
    took_us: Option<Micros>,
    /// Spans of the log that its lines belong to.
    frame_span: tracing::Span,
    slab_span: Option<(u32, tracing::Span)>,
    /// Picture of the tiles that came finished while others are drawn.
    assembly: Option<Arc<Assembly>>,
}

/// See the head of the file.
pub(crate) struct Driver {
    library: Arc<Library>,
    shares: Shares,
    clock: RealClock,
    rehearse: bool,
    /// A frame that waits for memory.
    blocked: Option<feed::Blocked>,
    /// Last refusal of a tile by each worker: the job, and the text for its clients.
    refusals: BTreeMap<WorkerId, (JobId, String)>,
    /// When to look for frames that may begin although nothing happens.
    look_again_at: Option<Micros>,
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
        library: Arc<Library>,
        shares: Shares,
        rehearse: bool,
        scheduler: RecordedScheduler,
        workers: WorkerTable,
        jobs: Arc<Jobs>,
        (inbox, finishers): (mpsc::Sender<Event>, Finishers),
        hooks: Hooks,
    ) -> Driver {
        Driver {
            library,
            shares,
            clock: RealClock(Instant::now()),
            rehearse,
            blocked: None,
            refusals: BTreeMap::new(),
            look_again_at: None,
            logged_reserve: 0,
            scheduler,
            workers,
            last_frame_id: 0,
            jobs,
            active: ActiveJobs::default(),
            brick_sets: BrickSets::new(shares.bricks),
            flights: BTreeMap::new(),
            inbox,
            finishers,
            hooks,
        }
    }

    /// Handles events until the master is told to end.
    pub(crate) async fn run(mut self, mut events: mpsc::Receiver<Event>) {
        loop {
            let deadline =
                self.scheduler.next_deadline().into_iter().chain(self.look_again_at).min();
            let until = deadline.map(|d| self.clock.0 + Duration::from_micros(d));
            let event = match until {
                None => events.recv().await,
                Some(until) => tokio::select! {
                    biased;
                    event = events.recv() => event,
                    () = tokio::time::sleep_until(until.into()) => {
                        let now = self.clock.now();
                        if self.scheduler.next_deadline().is_some_and(|d| d <= now) {
                            self.scheduler.handle(&self.clock, Happened::Tick);
                            self.act();
                        }
                        if self.look_again_at.is_some_and(|at| at <= now) {
                            self.feed();
                            self.act();
                        }
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
            // Orders for bricks leave before a set may make place for another.
            self.act();
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
            Event::Said { worker, message, _place } => self.said(worker, message),
            Event::Detached { worker, reason, is_damage } => {
                self.refusals.remove(&worker);
                if self.workers.is_staying(worker) {
                    self.workers.note_error(worker, &format!("its link ended: {reason}"));
                }
                if let Some(is_leaving) = self.workers.remove(worker) {
                    if is_leaving {
                        info!(%worker, "worker left");
                    } else {
                        warn!(%worker, reason, is_damage, "worker lost");
                    }
                    if is_damage {
                        // The scheduler suspects no tile of a worker that leaves.
                        self.scheduler.handle(&self.clock, Happened::WorkerLeaving { worker });
                    }
                    self.scheduler.handle(&self.clock, Happened::WorkerLost { worker, reason });
                    self.refresh_states();
                }
            }
            Event::Submit { plan, submitter, reply } => {
                let admitted = self.submit(*plan, submitter).map(|job| {
                    let inbox = self.inbox.clone();
                    let guard = submitter.is_live().then(|| Forgets { job, inbox });
                    Admitted { job, guard }
                });
                // Of a client that is gone a live job is forgotten.
                let _ = reply.send(admitted);
            }
            Event::BricksCut { set, store } => self.bricks_cut(set, store),
            Event::BricksLost { worker, set, bricks, reason } => {
                self.bricks_lost(worker, set, bricks, &reason);
            }
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
            Event::Forget { job } => {
                if self.active.contains(job) {
                    self.end_job(job, JobState::Cancelled);
                }
                self.jobs.lock().forget(job);
            }
            Event::Workers { reply } => {
                let seen = self.scheduler.workers().into_iter();
                let _ = reply.send(seen.filter_map(|w| self.workers.view(w)).collect());
            }
            Event::Shutdown => {}
        }
    }

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
        self.workers.rename(worker, &name);
        info!(
            %worker, name, threads = hello.threads, simd = hello.simd,
            held_bricks = hello.held.iter().map(|h| h.1.len()).sum::<usize>(), "worker joined"
        );
        if !admitted.is_trusted && self.workers.len() == 1 {
            info!(%worker, "no other worker is here to compare its pixels with: no audits");
        }
        self.scheduler.handle(
            &self.clock,
            Happened::WorkerJoined {
                worker,
                name,
                identity: admitted.identity,
                is_trusted: admitted.is_trusted,
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
                self.workers.note_error(worker, &reason);
                self.workers.remove(worker);
                warn!(%worker, reason, "worker dropped");
                self.scheduler.handle(&self.clock, Happened::WorkerLost { worker, reason });
                self.refresh_states();
                return;
            }
            ToMaster::Result(result) => Happened::Result { worker, result },
            ToMaster::Failed { task, epoch, reason } => {
                warn!(%worker, %task, reason, "task failed");
                self.workers.note_error(worker, &format!("a tile failed: {reason}"));
                self.note_refusal(worker, (task, epoch), &reason);
                Happened::Failed { worker, task, epoch, reason }
            }
            ToMaster::RegionSplit(piece) => Happened::HandedOver { worker, piece },
            ToMaster::BricksReceived { set, bricks } => Happened::BricksIn { worker, set, bricks },
            ToMaster::BricksBroken { set, bricks } => {
                warn!(%worker, bricks = bricks.len(), "bricks damaged in transit, sending them again");
                let damaged = format!("{} bricks came damaged, and are sent again", bricks.len());
                self.workers.note_error(worker, &damaged);
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
                if reason == TOLD_TO_STOP {
                    info!(%worker, reason, "worker is leaving");
                } else {
                    warn!(%worker, reason, "worker is leaving");
                }
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
}

#[cfg(test)]
mod tests;
