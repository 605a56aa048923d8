//! The thread that owns the scheduler.
//!
//! Everything that happens (a worker's message, a client's request, a finished picture, a
//! deadline) reaches it as an event in one bounded queue; it hands what concerns the
//! schedule to the pure state machine and carries out its wishes. It never waits for a worker,
//! a disk or a client: links are channels, bricks are built and frames finished on threads of
//! their own. It has a runtime of its own (one thread) for its queue and its timer alone, so
//! that culling a large volume delays no stream.

use crate::finish::{self, Chore, Laying};
use crate::jobs::{FinishedFrame, Job, JobState, JobView, Jobs, Watch};
use crate::link::{BrickOrder, Caller, WorkerLink};
use crate::memory;
use crate::record::{Recorder, Watched};
use slabcast_common::ids::{FrameId, JobId, SceneId, WorkerId};
use slabcast_common::leaves::Leaves;
use slabcast_common::link::{FINISHER_THREADS, FRAMES_IN_FLIGHT};
use slabcast_common::message::{Hello, PathRequest, SceneSpec, ToMaster, ToWorker, TransferChoice};
use slabcast_common::occlusion::Rect;
use slabcast_common::path::Orientation;
use slabcast_common::presets;
use slabcast_common::quality::{Quality, Refused};
use slabcast_common::stats::FrameStats;
use slabcast_common::transfer::{Classifier, TransferFunction};
use slabcast_common::tween::Tween;
use slabcast_common::view::View;
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_common::wanted::Wanted;
use slabcast_common::{PIXELS_VERSION, PROTOCOL_VERSION, SELF_TEST_SHA256};
use slabcast_proto::model::Worker;
use slabcast_schedule::{Action, Clock, Event as Happened, FrameJob, Micros};
use slabcast_volumes::BrickStore;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};
use tokio::sync::{mpsc, oneshot};
use tracing::{debug, info, warn};

/// Brick sets that are kept beside each other (a change of transfer function and back costs
/// nothing then); more would only fill the master's memory.
const BRICK_SETS: usize = 3;

/// Jobs that are in progress or can be watched again; each holds its views (300 bytes a frame).
const MAX_OPEN_JOBS: usize = 200;

/// What a master is started with.
pub struct MasterConfig {
    /// The volume it serves.
    pub volume: Arc<Volume>,
    /// Which of its axes are up and front.
    pub orientation: Orientation,
    /// Bytes of finished frames that are kept.
    pub frame_budget_bytes: usize,
    /// The scheduler's settings.
    pub schedule: slabcast_schedule::Config,
    /// Where what the scheduler is told and decides is written down ([`crate::record::start`]).
    pub record: Option<Recorder>,
    /// Only workers that rehearse are let in, and pictures are marked.
    pub rehearse: bool,
    /// Which machine this is, for workers that are on it to be told from others; empty if unknown.
    pub machine: String,
}

impl MasterConfig {
    /// The defaults for `volume`: 256 MiB of finished frames (64 frames of 1024x1024 RGBA8).
    pub fn new(volume: impl Into<Arc<Volume>>, orientation: Orientation) -> Self {
        MasterConfig {
            volume: volume.into(),
            orientation,
            frame_budget_bytes: 256 << 20,
            schedule: slabcast_schedule::Config::default(),
            record: None,
            rehearse: false,
            machine: String::new(),
        }
    }
}

/// What the master says of its volume.
#[derive(Clone, Debug)]
pub struct ServedVolume {
    /// Name (the file's, without folders).
    pub name: String,
    /// Type in the file.
    pub file_type: String,
    /// Whether world axes are anatomical.
    pub anatomical: bool,
    /// Lattice, range, histogram, digest.
    pub info: VolumeInfo,
    /// Up and front.
    pub orientation: Orientation,
}

/// Why a request was not taken.
#[derive(Debug)]
pub enum SubmitError {
    /// A field is wrong.
    Refused(Refused),
    /// The client's key belongs to another request.
    KeyTaken,
    /// The master has as many jobs in progress as it takes.
    Full,
    /// The master is shutting down.
    Gone,
}

pub(crate) enum Rejected {
    Field(Refused),
    KeyTaken,
    Full,
}

impl From<Refused> for Rejected {
    fn from(refused: Refused) -> Self {
        Rejected::Field(refused)
    }
}

impl From<Rejected> for SubmitError {
    fn from(rejected: Rejected) -> Self {
        match rejected {
            Rejected::Field(refused) => SubmitError::Refused(refused),
            Rejected::KeyTaken => SubmitError::KeyTaken,
            Rejected::Full => SubmitError::Full,
        }
    }
}

/// Everything that can happen to the master.
#[expect(clippy::large_enum_variant, reason = "a finished frame is moved once; the queue is short")]
pub(crate) enum Event {
    Attach {
        hello: Hello,
        caller: Caller,
        link: WorkerLink,
        reply: oneshot::Sender<Result<WorkerId, String>>,
    },
    Said {
        worker: WorkerId,
        message: ToMaster,
    },
    Detached {
        worker: WorkerId,
        reason: String,
    },
    Submit {
        request: Box<PathRequest>,
        reply: oneshot::Sender<Result<JobId, Rejected>>,
    },
    Prepared {
        job: JobId,
        store: Arc<BrickStore>,
    },
    FrameTaken,
    Finished {
        job: JobId,
        flight: FrameId,
        frame: FinishedFrame,
    },
    Cancel {
        job: JobId,
        reply: oneshot::Sender<bool>,
    },
    Workers {
        reply: oneshot::Sender<Vec<Worker>>,
    },
    Shutdown,
}

/// A running master.
pub struct Master {
    handle: Handle,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Master {
    /// Starts the driver.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(config: MasterConfig) -> std::io::Result<Master> {
        let digest = config.volume.digest();
        let served = Arc::new(ServedVolume {
            name: config.volume.name.clone(),
            file_type: config.volume.file_type.clone(),
            anatomical: config.volume.anatomical,
            info: config.volume.info(digest),
            orientation: config.orientation,
        });
        let (inbox, events) = mpsc::channel(1024);
        // Ids are never used again, not even by the next master at this address: a client that
        // takes up its watch must not see another's job.
        let jobs = Arc::new(Jobs::starting_at(unix_ms() as u64));
        let handle = Handle { inbox: inbox.clone(), jobs: jobs.clone(), served: served.clone() };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build()?;
        let (to_finisher, chores) = std::sync::mpsc::channel::<Chore>();
        let chores = Arc::new(Mutex::new(chores));
        for _ in 0..FINISHER_THREADS {
            let (chores, done) = (chores.clone(), inbox.clone());
            let next = move || chores.lock().unwrap_or_else(PoisonError::into_inner).recv();
            std::thread::Builder::new().name("slabcast-finish".into()).spawn(move || {
                while let Ok(chore) = next() {
                    let (flight, sums) = match chore {
                        Chore::Lay(laying) => {
                            laying.lay();
                            continue;
                        }
                        Chore::Finish(flight, sums) => (flight, sums),
                    };
                    let job = sums.job;
                    let frame = finish::finish(*sums);
                    if done.blocking_send(Event::Finished { job, flight, frame }).is_err() {
                        return;
                    }
                }
            })?;
        }
        let driver = Driver {
            volume: config.volume,
            served,
            budget: config.frame_budget_bytes,
            clock: RealClock(Instant::now()),
            silence: config.schedule.silence,
            rehearse: config.rehearse,
            machine: config.machine,
            in_reserve: 0,
            scheduler: Watched::new(config.schedule, config.record),
            links: BTreeMap::new(),
            next_worker: 1,
            next_frame: 1,
            jobs,
            running: BTreeMap::new(),
            order: VecDeque::new(),
            stores: Vec::new(),
            flights: BTreeMap::new(),
            inbox,
            finisher: to_finisher,
        };
        let thread = std::thread::Builder::new()
            .name("slabcast-master".into())
            .spawn(move || runtime.block_on(driver.run(events)))?;
        Ok(Master { handle, thread: Some(thread) })
    }

    /// A way to speak to it.
    pub fn handle(&self) -> Handle {
        self.handle.clone()
    }

    /// Tells workers to leave, ends the driver and waits for it.
    pub async fn shutdown(mut self) {
        let _ = self.handle.inbox.send(Event::Shutdown).await;
        if let Some(thread) = self.thread.take() {
            let _ = tokio::task::spawn_blocking(move || thread.join()).await;
        }
    }
}

/// A way to speak to a running master, for links, services and embedding programs.
#[derive(Clone)]
pub struct Handle {
    inbox: mpsc::Sender<Event>,
    jobs: Arc<Jobs>,
    served: Arc<ServedVolume>,
}

impl Handle {
    /// The volume that is served.
    pub fn volume(&self) -> &ServedVolume {
        &self.served
    }

    /// Submits a view path. The same `client_key` gives the same job.
    ///
    /// # Errors
    /// [`SubmitError::Refused`] names the field that can't be used.
    pub async fn submit(&self, request: PathRequest) -> Result<JobId, SubmitError> {
        let (reply, answer) = oneshot::channel();
        let request = Box::new(request);
        if self.inbox.send(Event::Submit { request, reply }).await.is_err() {
            return Err(SubmitError::Gone);
        }
        Ok(answer.await.map_err(|_| SubmitError::Gone)??)
    }

    /// Watches a job from frame `from`; `None` if there is no such job.
    pub fn watch(&self, job: JobId, from: u64) -> Option<Watch> {
        let bells = self.jobs.listen();
        self.jobs.lock().jobs.get(&job)?;
        Some(Watch {
            jobs: self.jobs.clone(),
            job,
            next: from,
            bells,
            last_notice: None,
            quiet: None,
            taken: self.inbox.clone(),
            over: false,
        })
    }

    /// One job.
    pub fn job(&self, job: JobId) -> Option<JobView> {
        self.jobs.lock().jobs.get(&job).map(|j| j.view.clone())
    }

    /// All jobs that are remembered, oldest first.
    pub fn jobs(&self) -> Vec<JobView> {
        self.jobs.lock().jobs.values().map(|j| j.view.clone()).collect()
    }

    /// Cancels a job; false if there is none or it is over.
    pub async fn cancel(&self, job: JobId) -> bool {
        let (reply, answer) = oneshot::channel();
        self.inbox.send(Event::Cancel { job, reply }).await.is_ok() && answer.await.unwrap_or(false)
    }

    /// The workers that are there.
    pub async fn workers(&self) -> Vec<Worker> {
        let (reply, answer) = oneshot::channel();
        if self.inbox.send(Event::Workers { reply }).await.is_err() {
            return Vec::new();
        }
        answer.await.unwrap_or_default()
    }

    /// Lets a worker in, or says why not.
    pub async fn attach(
        &self,
        hello: Hello,
        caller: Caller,
        link: WorkerLink,
    ) -> Result<WorkerId, String> {
        let gone = || "the master is shutting down; come back later".to_string();
        let (reply, answer) = oneshot::channel();
        self.inbox.send(Event::Attach { hello, caller, link, reply }).await.map_err(|_| gone())?;
        answer.await.map_err(|_| gone())?
    }

    /// Passes on what a worker said; false when the master is gone.
    pub async fn worker_said(&self, worker: WorkerId, message: ToMaster) -> bool {
        self.inbox.send(Event::Said { worker, message }).await.is_ok()
    }

    /// A worker's link ended.
    pub async fn detach(&self, worker: WorkerId, reason: String) {
        let _ = self.inbox.send(Event::Detached { worker, reason }).await;
    }
}

/// Wall time, for people: nothing is decided by it.
pub(crate) fn unix_ms() -> i64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since.map_or(0, |d| d.as_millis() as i64)
}

struct RealClock(Instant);

impl Clock for RealClock {
    fn now(&self) -> Micros {
        self.0.elapsed().as_micros() as Micros
    }
}

/// A job in progress.
struct Running {
    request: Arc<PathRequest>,
    /// Of all frames, or of those of a tween but for the transfer function.
    scene: Arc<SceneSpec>,
    tween: Option<Tween>,
    wanted: Wanted,
    views: Vec<View>,
    store: Option<Arc<BrickStore>>,
    /// The next frame that was never rendered.
    next: u64,
}

/// Scenes of single frames of a tween have the frame's number and this bit, jobs' scenes do not.
const ONE_FRAME: u64 = 1 << 63;

impl Running {
    /// What frame `number` is drawn with. Each frame of a tween is a scene of its own on the same
    /// bricks.
    fn scene_of(&self, number: u64, frame: FrameId) -> Arc<SceneSpec> {
        let Some(tween) = &self.tween else { return self.scene.clone() };
        let at = (self.request.path.first_frame() as u64 + number) as f64;
        let scene = tween.scene(&self.scene, self.request.quality.sums, at);
        Arc::new(SceneSpec { id: SceneId(frame.0 | ONE_FRAME), ..scene })
    }
}

/// A worker's link and what the scheduler need not know of it.
struct Attached {
    link: WorkerLink,
    address: String,
    simd: String,
    memory_budget_bytes: u64,
    tasks_done: u64,
    heard: Instant,
    since: Instant,
    leaving: bool,
}

/// A frame that the scheduler or the finisher has.
struct Flight {
    job: JobId,
    number: u64,
    scene: Arc<SceneSpec>,
    /// What is logged about it is logged inside these.
    frame_span: tracing::Span,
    slab_span: Option<(u32, tracing::Span)>,
    /// Where tiles are laid that come finished while others are drawn.
    laying: Option<Arc<Laying>>,
}

struct Driver {
    volume: Arc<Volume>,
    served: Arc<ServedVolume>,
    budget: usize,
    clock: RealClock,
    silence: Micros,
    rehearse: bool,
    machine: String,
    /// Workers in reserve when that was said last.
    in_reserve: usize,
    scheduler: Watched,
    links: BTreeMap<WorkerId, Attached>,
    next_worker: u64,
    next_frame: u64,
    jobs: Arc<Jobs>,
    running: BTreeMap<JobId, Running>,
    /// Jobs in the order in which they came.
    order: VecDeque<JobId>,
    /// Brick sets, the last used last.
    stores: Vec<Arc<BrickStore>>,
    flights: BTreeMap<FrameId, Flight>,
    inbox: mpsc::Sender<Event>,
    /// Bounded by [`FRAMES_IN_FLIGHT`].
    finisher: std::sync::mpsc::Sender<Chore>,
}

impl Driver {
    async fn run(mut self, mut events: mpsc::Receiver<Event>) {
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
            // Everything readable first, then the wishes: leases that belong together leave together.
            // What comes meanwhile waits for the next time: who has many workers is never without
            // an event for long, and leases must not wait until then.
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

    fn leave(&mut self) {
        for worker in self.links.values() {
            let reason = "the master ends".to_string();
            let _ = worker.link.control.send(ToWorker::Leave { reason });
        }
        for id in std::mem::take(&mut self.order) {
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
                if let Some(attached) = self.links.remove(&worker) {
                    if attached.leaving {
                        info!(%worker, "worker left");
                    } else {
                        warn!(%worker, reason, "worker lost");
                    }
                    self.scheduler.handle(&self.clock, Happened::WorkerLost { worker, reason });
                    self.refresh_states();
                }
            }
            Event::Submit { request, reply } => {
                let _ = reply.send(self.submit(*request));
            }
            Event::Prepared { job, store } => {
                info!(%job, bricks = store.infos().len(), bytes = store.bytes(), "bricks made");
                self.keep(&store);
                if let Some(r) = self.running.get_mut(&job) {
                    r.store = Some(store);
                }
                self.refresh_states();
            }
            Event::FrameTaken => {}
            Event::Finished { job, flight, frame } => self.finished(job, flight, frame),
            Event::Cancel { job, reply } => {
                let there = self.order.contains(&job);
                if there {
                    info!(%job, "cancelled");
                    self.order.retain(|id| *id != job);
                    self.end_job(job, JobState::Cancelled);
                }
                let _ = reply.send(there);
            }
            Event::Workers { reply } => {
                let _ = reply.send(self.workers());
            }
            Event::Shutdown => {}
        }
    }

    fn attach(
        &mut self,
        hello: Hello,
        caller: Caller,
        link: WorkerLink,
    ) -> Result<WorkerId, String> {
        let mut refuse = None;
        if hello.protocol_version != PROTOCOL_VERSION {
            refuse = Some(format!(
                "the worker speaks protocol {}, this master {PROTOCOL_VERSION}; run the same \
                 version of slabcast on both",
                hello.protocol_version
            ));
        } else if hello.pixels_version != PIXELS_VERSION {
            refuse = Some(format!(
                "the worker draws pixels of version {}, this master expects {PIXELS_VERSION}; run \
                 the same version of slabcast on both",
                hello.pixels_version
            ));
        } else if hello.self_test_sha256 != SELF_TEST_SHA256 {
            refuse = Some(format!(
                "the worker's self-test tile hashes to {}, it must be {SELF_TEST_SHA256}; its \
                 machine or build rounds differently, use an official build",
                hello.self_test_sha256.chars().take(64).collect::<String>()
            ));
        } else if hello.threads == 0 || hello.threads > 4096 {
            refuse = Some(format!("{} render threads; give 1 to 4096", hello.threads));
        } else if hello.rehearses != self.rehearse {
            refuse = Some(if hello.rehearses {
                "the worker rehearses: it holds tiles for a recorded time and draws nothing; start it \
                 without --rehearse, or rehearse with a master of its own (slabcast master --rehearse)"
                    .into()
            } else {
                "this master rehearses and marks its pictures; start the worker with --rehearse \
                 TRACE, or the master without"
                    .into()
            });
        }
        if let Some(reason) = refuse {
            warn!(worker = hello.name, reason, "worker refused");
            return Err(reason);
        }
        let worker = WorkerId(self.next_worker);
        self.next_worker += 1;
        let taken = self.scheduler.workers().iter().any(|w| w.name == hello.name);
        let name = if taken { format!("{}#{}", hello.name, worker.0) } else { hello.name.clone() };
        info!(
            %worker, name, threads = hello.threads, simd = hello.simd,
            held = hello.held.iter().map(|h| h.1.len()).sum::<usize>(), "worker joined"
        );
        // Workers give a master up after three of these, as it does them after its own silence.
        let heartbeat_ms = (self.silence / 3000).min(u32::MAX.into()) as u32;
        // A rehearsing one stands for another machine's.
        let is_local = caller.is_on(&hello.machine, &self.machine) && !hello.rehearses;
        let _ = link.control.send(ToWorker::Welcome { worker, heartbeat_ms });
        let now = Instant::now();
        let attached = Attached {
            link,
            address: caller.address,
            simd: hello.simd,
            memory_budget_bytes: hello.memory_budget_bytes,
            tasks_done: 0,
            heard: now,
            since: now,
            leaving: false,
        };
        self.links.insert(worker, attached);
        self.scheduler.handle(
            &self.clock,
            Happened::WorkerJoined {
                worker,
                name,
                threads: hello.threads,
                is_local,
                memory_budget_bytes: hello.memory_budget_bytes,
                held: hello.held,
            },
        );
        self.refresh_states();
        Ok(worker)
    }

    fn said(&mut self, worker: WorkerId, message: ToMaster) {
        let Some(attached) = self.links.get_mut(&worker) else { return };
        attached.heard = Instant::now();
        attached.tasks_done += u64::from(matches!(message, ToMaster::Result(_)));
        let clock = &self.clock;
        let happened = match message {
            ToMaster::Hello(_) => {
                self.drop_link(worker, "said hello twice");
                return;
            }
            ToMaster::Result(result) => Happened::Result { worker, result },
            ToMaster::Failed { task, epoch, reason } => {
                warn!(%worker, %task, reason, "task failed");
                Happened::Failed { worker, task, epoch, reason }
            }
            ToMaster::HandedOver(piece) => Happened::HandedOver { worker, piece },
            ToMaster::BricksIn { set, bricks } => Happened::BricksIn { worker, set, bricks },
            ToMaster::BricksBroken { set, bricks } => {
                warn!(%worker, bricks = bricks.len(), "bricks broken on the way, sent again");
                Happened::BricksBroken { worker, set, bricks }
            }
            ToMaster::BricksWanted { set, bricks } => {
                Happened::BricksWanted { worker, set, bricks }
            }
            ToMaster::BricksForgotten { set, bricks } => {
                Happened::BricksForgotten { worker, set, bricks }
            }
            ToMaster::Pong { nonce, clock_us } => Happened::Pong { worker, nonce, clock_us },
            ToMaster::Leaving { reason } => {
                info!(%worker, reason, "worker leaves");
                attached.leaving = true;
                Happened::WorkerLeaving { worker }
            }
        };
        self.scheduler.handle(clock, happened);
    }

    fn drop_link(&mut self, worker: WorkerId, reason: &str) {
        if self.links.remove(&worker).is_some() {
            warn!(%worker, reason, "worker dropped");
            let reason = reason.to_string();
            self.scheduler.handle(&self.clock, Happened::WorkerLost { worker, reason });
            self.refresh_states();
        }
    }

    /// Says how many workers draw where that has changed.
    fn tell_of_reserve(&mut self) {
        let in_reserve = self.scheduler.in_reserve();
        if std::mem::replace(&mut self.in_reserve, in_reserve) != in_reserve {
            let drawing = self.links.len().saturating_sub(in_reserve);
            info!(drawing, in_reserve, "who would make frames late is held in reserve");
        }
    }

    fn workers(&self) -> Vec<Worker> {
        let ms = |since: Instant| since.elapsed().as_millis() as u64;
        let view = |w: slabcast_schedule::WorkerView| {
            let a = self.links.get(&w.id)?;
            Some(Worker {
                id: w.id,
                name: w.name,
                address: a.address.clone(),
                threads: w.threads,
                simd: a.simd.clone(),
                memory_budget_bytes: a.memory_budget_bytes,
                held_bytes: w.bytes_held,
                held_bricks: w.bricks_held,
                tasks_lent: w.leases,
                tasks_done: a.tasks_done,
                silent_ms: ms(a.heard),
                here_ms: ms(a.since),
                in_reserve: w.in_reserve,
            })
        };
        self.scheduler.workers().into_iter().filter_map(view).collect()
    }

    fn submit(&mut self, request: PathRequest) -> Result<JobId, Rejected> {
        if request.client_key.is_empty() || request.client_key.len() > 200 {
            let problem = "give 1 to 200 bytes, new for each request";
            return Err(Refused::new("client_key", problem).into());
        }
        {
            let table = self.jobs.lock();
            if let Some(id) = table.by_key.get(&request.client_key) {
                return match table.jobs.get(id) {
                    Some(job) if *job.request == request => Ok(*id),
                    _ => Err(Rejected::KeyTaken),
                };
            }
        }
        if self.order.len() >= MAX_OPEN_JOBS {
            return Err(Rejected::Full);
        }
        let info = &self.served.info;
        request.quality.check()?;
        request.work.check()?;
        request.path.check()?;
        memory::check(request.path.size, request.format)?;
        let transfer: TransferFunction = match &request.transfer {
            TransferChoice::Name(name) => presets::by_name(name, &info.summary)?,
            TransferChoice::Function(tf) => {
                tf.check()?;
                (**tf).clone()
            }
        };
        let cameras = request.path.prepare(&info.lattice, self.served.orientation)?;
        let views = (0..request.path.frames())
            .map(|i| {
                View::new(&info.lattice, &cameras.camera(i)?, request.path.size, &request.quality)
            })
            .collect::<Result<Vec<View>, Refused>>()?;
        let compositing = request.quality.compositing;
        let tween = Tween::of(&request.path, &info.summary)?;
        let mut sums = request.quality.sums;
        for tf in tween.iter().flat_map(Tween::ends).chain([&transfer]) {
            let classifier = Classifier::new(tf, info, compositing);
            sums = classifier.sums(&request.quality, &info.lattice)?;
        }
        let quality = Quality { sums, ..request.quality };
        let wanted = Wanted::of_path(&request.path, &transfer, tween.as_ref(), info, compositing)?
            .keeping(request.work.keep);
        let held = self.stores.iter().find(|s| s.wanted().covers(&wanted));
        let (bricks, store) = match held {
            Some(store) => (store.key(), Some(store.clone())),
            None => (wanted.key(info.digest), None),
        };
        if let Some(store) = &store {
            self.keep(store);
        }

        let mut table = self.jobs.lock();
        table.next += 1;
        let id = JobId(table.next);
        let request = Arc::new(request);
        table.by_key.insert(request.client_key.clone(), id);
        table.jobs.insert(
            id,
            Job {
                view: JobView {
                    id,
                    client_key: request.client_key.clone(),
                    state: JobState::Queued,
                    frames_done: 0,
                    frames_total: views.len() as u64,
                    tiles: (0, 0),
                    slab: (0, 0),
                    workers: 0,
                    size: request.path.size,
                    format: request.format,
                    submitted_unix_ms: unix_ms(),
                    finished_unix_ms: 0,
                },
                request: request.clone(),
                frames: BTreeMap::new(),
                ever_done: Default::default(),
                taken: Default::default(),
                wanted_again: Default::default(),
                retired: false,
            },
        );
        table.forget();
        drop(table);
        info!(job = %id, frames = views.len(), sums = ?quality.sums, "job submitted");

        if store.is_none() {
            let (volume, digest, wanted) =
                (self.volume.clone(), self.served.info.digest, wanted.clone());
            let inbox = self.inbox.clone();
            let built =
                std::thread::Builder::new().name("slabcast-bricks".into()).spawn(move || {
                    let store = Arc::new(BrickStore::build(&volume, digest, &wanted));
                    let _ = inbox.blocking_send(Event::Prepared { job: id, store });
                });
            if let Err(e) = built {
                self.end_job(id, JobState::Failed(format!("no thread to make bricks: {e}")));
                return Ok(id);
            }
        }
        let scene = SceneSpec {
            id: SceneId(id.0),
            volume: self.served.info.clone(),
            transfer,
            quality,
            bricks,
        };
        self.running.insert(
            id,
            Running { request, scene: Arc::new(scene), tween, wanted, views, store, next: 0 },
        );
        self.order.push_back(id);
        self.refresh_states();
        Ok(id)
    }

    /// Keeps a brick set as the last used one; the first used ones go that no job needs.
    fn keep(&mut self, store: &Arc<BrickStore>) {
        let key = store.key();
        self.stores.retain(|s| s.key() != key);
        self.stores.push(store.clone());
        let mut i = 0;
        while self.stores.len() > BRICK_SETS && i < self.stores.len() - 1 {
            let key = self.stores[i].key();
            if self.running.values().any(|r| r.scene.bricks == key) {
                i += 1;
            } else {
                self.stores.remove(i);
            }
        }
    }

    /// Gives the scheduler frames while there is room for them.
    fn feed(&mut self) {
        // Jobs whose bricks were made for another job meanwhile take those.
        let stores = &self.stores;
        for r in self.running.values_mut().filter(|r| r.store.is_none()) {
            let fits =
                |s: &&Arc<BrickStore>| s.key() == r.scene.bricks && s.wanted().covers(&r.wanted);
            r.store = stores.iter().find(fits).cloned();
        }
        while self.flights.len() < FRAMES_IN_FLIGHT {
            let Some((job, number)) = self.pick() else { return };
            let Some(r) = self.running.get_mut(&job) else { return };
            let Some(store) = &r.store else { return };
            let beside = memory::beside_others(r.request.path.size, r.request.format);
            if !beside && !self.flights.is_empty() {
                return;
            }
            if number == r.next {
                r.next += 1;
            }
            self.jobs.lock().jobs.entry(job).and_modify(|j| {
                j.wanted_again.remove(&number);
            });
            let frame = FrameId(self.next_frame);
            self.next_frame += 1;
            let frame_span = tracing::info_span!("frame", %job, number, id = %frame);
            let scene = r.scene_of(number, frame);
            let (slab_span, laying) = (None, None);
            let flight =
                Flight { job, number, scene: scene.clone(), frame_span, slab_span, laying };
            self.flights.insert(frame, flight);
            let only_this = r.tween.is_some().then_some(scene.id);
            let queued = FrameJob {
                frame,
                number,
                scene,
                bricks: store.infos().clone(),
                view: r.views[number as usize],
                work: r.request.work,
                finish: (!r.request.want_hash).then(|| r.request.finish()),
            };
            self.scheduler.handle(&self.clock, Happened::FrameQueued(Box::new(queued)));
            if let Some(scene) = only_this {
                // It ends with its frame.
                self.scheduler.handle(&self.clock, Happened::SceneEnded { scene });
            }
        }
    }

    /// The next frame to render: the oldest job's, unless its frames pile up untaken.
    fn pick(&self) -> Option<(JobId, u64)> {
        let table = self.jobs.lock();
        let (waiting, _) = table.bytes();
        for id in &self.order {
            let (Some(r), Some(job)) = (self.running.get(id), table.jobs.get(id)) else { continue };
            if r.store.is_none() {
                continue;
            }
            let in_flight = |n: u64| self.flights.values().any(|f| f.job == *id && f.number == n);
            if let Some(n) = job.wanted_again.iter().copied().find(|n| !in_flight(*n)) {
                return Some((*id, n));
            }
            let untaken = job.frames.keys().any(|n| !job.taken.contains(n));
            if r.next < r.views.len() as u64 && (waiting < self.budget || !untaken) {
                return Some((*id, r.next));
            }
        }
        None
    }

    fn act(&mut self) {
        while let Some(action) = self.scheduler.next_action() {
            match action {
                Action::Send { worker, message } => {
                    // A closed link says so itself, by its detach.
                    let Some(Attached { link, .. }) = self.links.get(&worker) else { continue };
                    if let ToWorker::DropBricks { set, bricks } = message {
                        let _ = link.bricks.send(BrickOrder::Drop { set, bricks });
                    } else {
                        let _ = link.control.send(message);
                    }
                }
                Action::SendBricks { worker, set, bricks } => {
                    let store =
                        self.stores.iter().find(|s| s.key() == set).cloned().or_else(|| {
                            self.running
                                .values()
                                .find_map(|r| r.store.as_ref().filter(|s| s.key() == set).cloned())
                        });
                    if let (Some(to), Some(store)) = (self.links.get(&worker), store) {
                        debug!(%worker, bricks = bricks.len(), "bricks sent");
                        let _ = to.link.bricks.send(BrickOrder::Send { set, store, bricks });
                    }
                }
                Action::Drop { worker, reason } => {
                    if self.links.remove(&worker).is_some() {
                        warn!(%worker, reason, "worker dropped");
                    }
                    self.refresh_states();
                }
                Action::Progress { frame, done, total, slab, slabs } => {
                    if let Some(f) = self.flights.get_mut(&frame) {
                        if f.slab_span.as_ref().is_none_or(|(s, _)| *s != slab) {
                            let span = tracing::info_span!(parent: &f.frame_span, "slab", slab);
                            f.slab_span = Some((slab, span));
                        }
                        if let Some((_, span)) = &f.slab_span {
                            span.in_scope(|| debug!(done, total, "tiles"));
                        }
                        if let Some(job) = self.jobs.lock().jobs.get_mut(&f.job) {
                            job.view.tiles = (done, total);
                            job.view.slab = (slab, slabs);
                        }
                        self.jobs.ring_tile();
                    }
                }
                Action::Finished { frame, tiles } => self.lay(frame, tiles),
                Action::FrameDone { frame, state, stats, spans } => {
                    self.hand_to_finisher(frame, state, stats, spans);
                }
                Action::FrameFailed { frame, reason } => {
                    if let Some(f) = self.flights.remove(&frame) {
                        warn!(job = %f.job, frame = f.number, reason, "frame failed");
                        self.order.retain(|id| *id != f.job);
                        let reason = format!("frame {}: {reason}", f.number);
                        self.end_job(f.job, JobState::Failed(reason));
                    }
                }
            }
        }
    }

    /// Has finished tiles laid into their frame's picture while others are drawn.
    fn lay(&mut self, frame: FrameId, tiles: Vec<(Rect, Leaves)>) {
        // Nobody drew what is rehearsed.
        let Some(flight) = self.flights.get_mut(&frame).filter(|_| !self.rehearse) else { return };
        let Some(r) = self.running.get(&flight.job) else { return };
        let laying = flight.laying.get_or_insert_with(|| {
            let size = r.views[flight.number as usize].size;
            Arc::new(Laying::new(size, r.request.finish()))
        });
        laying.add(tiles);
        let _ = self.finisher.send(Chore::Lay(laying.clone()));
    }

    fn hand_to_finisher(
        &mut self,
        frame: FrameId,
        state: Box<slabcast_common::image::FrameState>,
        stats: Box<FrameStats>,
        spans: slabcast_schedule::Spans,
    ) {
        let Some(flight) = self.flights.get(&frame) else { return };
        let Some(r) = self.running.get(&flight.job) else {
            self.flights.remove(&frame);
            return;
        };
        let view = r.views[flight.number as usize];
        let laying = flight.laying.clone();
        let sums = Box::new(finish::FrameSums {
            job: flight.job,
            frame,
            request: r.request.clone(),
            scene: flight.scene.clone(),
            crop: r.wanted.crop,
            view,
            state,
            laying,
            stats,
            spans,
            store: r.store.clone(),
            rehearsed: self.rehearse,
        });
        // The finisher ends only with the driver.
        let _ = self.finisher.send(Chore::Finish(frame, sums));
    }

    fn finished(&mut self, job: JobId, flight: FrameId, frame: FinishedFrame) {
        let span = self.flights.remove(&flight).map_or(tracing::Span::none(), |f| f.frame_span);
        span.in_scope(|| {
            let FrameStats { ms, pixels_sha256, .. } = &frame.stats;
            info!(ms = ms.total, pixels_sha256, "frame done");
        });
        self.tell_of_reserve();
        let number = frame.number;
        let mut table = self.jobs.lock();
        let mut over = false;
        if let Some(j) = table.jobs.get_mut(&job) {
            j.ever_done.insert(frame.number);
            j.taken.remove(&frame.number);
            j.view.frames_done = j.ever_done.len() as u64;
            j.frames.insert(frame.number, Arc::new(frame));
            // In one go with the last frame: whoever sees that sees this. The job stays
            // runnable, so that frames that were dropped can be asked for again.
            over = j.view.frames_done == j.view.frames_total && !j.view.state.is_over();
            if over {
                j.view.state = JobState::Done;
                j.view.finished_unix_ms = unix_ms();
            }
        }
        table.evict(self.budget, (job, number));
        drop(table);
        if over {
            info!(%job, "job done");
            self.retire();
        }
        self.jobs.ring();
        self.refresh_states();
    }

    /// Forgets how to render the oldest finished jobs: their last frames stay in the table.
    fn retire(&mut self) {
        let over = |d: &Driver, id: &JobId| {
            d.jobs.lock().jobs.get(id).is_none_or(|j| j.view.state.is_over())
        };
        let ended: Vec<JobId> = self.order.iter().copied().filter(|id| over(self, id)).collect();
        // Four finished jobs can be watched again from the start without being submitted anew.
        for id in ended.iter().take(ended.len().saturating_sub(4)) {
            self.order.retain(|o| o != id);
            self.forget_running(*id);
        }
    }

    fn forget_running(&mut self, id: JobId) {
        if let Some(j) = self.jobs.lock().jobs.get_mut(&id) {
            j.retired = true;
        }
        if let Some(r) = self.running.remove(&id) {
            let scene = r.scene.id;
            self.scheduler.handle(&self.clock, Happened::SceneEnded { scene });
        }
    }

    /// Ends a job that is not finished.
    fn end_job(&mut self, id: JobId, state: JobState) {
        let frames: Vec<FrameId> =
            self.flights.iter().filter(|(_, f)| f.job == id).map(|(id, _)| *id).collect();
        for frame in frames {
            self.flights.remove(&frame);
            self.scheduler.handle(&self.clock, Happened::CancelFrame { frame });
        }
        self.forget_running(id);
        if let Some(j) = self.jobs.lock().jobs.get_mut(&id)
            && !j.view.state.is_over()
        {
            j.view.state = state;
            j.view.finished_unix_ms = unix_ms();
        }
        self.jobs.ring();
        self.refresh_states();
    }

    /// Says of every job in progress what it is doing.
    fn refresh_states(&mut self) {
        let workers = self.links.len() as u32;
        let mut changed = false;
        let mut table = self.jobs.lock();
        for id in &self.order {
            let (Some(r), Some(j)) = (self.running.get(id), table.jobs.get_mut(id)) else {
                continue;
            };
            if j.view.state.is_over() {
                continue;
            }
            let state = if r.store.is_none() {
                JobState::Preparing
            } else if workers == 0 {
                JobState::WaitingForWorkers
            } else if r.next > 0 {
                JobState::Running
            } else {
                JobState::Queued
            };
            changed |= j.view.state != state || j.view.workers != workers;
            j.view.state = state;
            j.view.workers = workers;
        }
        drop(table);
        if changed {
            self.jobs.ring();
        }
    }
}
