//! Starting a master, and the handle by which links, services and embedding programs speak to it.

use crate::admission::{AttachError, Audits, WorkerTable};
use crate::driver::{Admitted, Driver, Event, Forgets};
use crate::finishers::Finishers;
use crate::hooks::{Hooks, Stage};
use crate::jobs::active::Submitter;
use crate::jobs::submit::{Plan, SubmitError, check_key};
use crate::jobs::{DrawnTile, FinishedFrame, JobState, JobView, Jobs, Watch, WatchItem};
use crate::library::{Library, Viewer, VolumeError};
use crate::link::{Caller, WorkerLink};
use crate::memory::Shares;
use crate::panics::caught;
use crate::record::{RecordedScheduler, Recorder};
use crate::serve::{PeerLimits, counted_as};
use slabcast_common::ids::{JobId, WorkerId};
use slabcast_common::message::{Hello, ToMaster};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_proto::model::Worker;
use slabcast_scene::path::Orientation;
use slabcast_scene::request::PathRequest;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, SystemTime};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};

/// Requests that are checked at a time: with two, one whose bricks are looked through for its
/// framing does not hold up a short one.
const PLANS_AT_ONCE: usize = 2;

/// Events that wait for the driver before whoever sends one has to wait.
const INBOX: usize = 1024;

/// Most calls at a time that look at folders or write a piece of an upload. They don't wait for
/// files that are being read.
const LOOKS_AT_ONCE: usize = 4;

/// Settings of a master: its volumes, memory, scheduler and record.
pub struct MasterConfig {
    /// The volumes that the master serves.
    pub library: Library,
    /// Bytes that the master may hold, by what takes them.
    pub shares: Shares,
    /// Caps of jobs, watchers and connections of one client address.
    pub peer_limits: PeerLimits,
    /// Whether clients of other machines are told the names of volumes.
    pub show_names: bool,
    /// Settings of the scheduler that the master drives.
    pub schedule: slabcast_schedule::Config,
    /// Recorder of the scheduler's events and decisions ([`crate::record::start`]).
    pub record: Option<Recorder>,
    /// Share of the tiles of workers over TCP which another worker draws too, to compare, in
    /// millionths, once each has agreed with others some times; 0: never. `None`: 1 %, of workers
    /// on other machines.
    pub audit_ppm: Option<u32>,
    /// Time for which a worker is not let in after it drew other pixels than others.
    pub shut_out: Duration,
    /// Whether to let in only workers that rehearse, and mark the pictures.
    pub rehearse: bool,
    /// Name of this machine, by which its workers are told from others'; empty if unknown.
    pub machine: String,
    pub(crate) hooks: Hooks,
}

impl MasterConfig {
    /// Returns the defaults for a master of one volume: the memory of a master that serves its own
    /// process, no record, no rehearsal.
    pub fn new(volume: impl Into<Arc<Volume>>, orientation: Orientation) -> Self {
        MasterConfig::of(Library::of(volume, orientation))
    }

    /// Returns the defaults, as [`MasterConfig::new`], for a master of these volumes.
    pub fn of(library: Library) -> Self {
        MasterConfig {
            library,
            shares: Shares::default(),
            peer_limits: PeerLimits::default(),
            show_names: false,
            schedule: slabcast_schedule::Config::default(),
            record: None,
            audit_ppm: None,
            shut_out: Duration::from_secs(3600),
            rehearse: false,
            machine: String::new(),
            hooks: Hooks::default(),
        }
    }
}

/// A running master. Dropped without [`Master::shutdown`], its driver goes on until the last
/// [`Handle`] is gone.
pub struct Master {
    handle: Handle,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Master {
    /// Starts a master's driver and finishers.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(config: MasterConfig) -> std::io::Result<Master> {
        let library = Arc::new(config.library);
        let (inbox, events) = mpsc::channel(INBOX);
        // Ids are never used again, not even by the next master at this address: a client that
        // takes up its watch must not see another's job. The clock may be set back, so chance
        // decides: 31 bits, above room for four million jobs. Numbers stay below 2^53, which every
        // language's JSON has exactly.
        let run = getrandom::u32().map_err(std::io::Error::other)? >> 1;
        let jobs = Arc::new(Jobs::new(u64::from(run) << 22, config.shares.requests));
        let finishers = Finishers::start(&inbox, &config.hooks)?;
        let handle = Handle {
            inbox: inbox.clone(),
            jobs: jobs.clone(),
            library: library.clone(),
            planning: Arc::new(Semaphore::new(PLANS_AT_ONCE)),
            looks: Arc::new(Semaphore::new(LOOKS_AT_ONCE)),
            shares: config.shares,
            peer_limits: config.peer_limits,
            show_names: config.show_names,
            hooks: config.hooks.clone(),
        };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build()?;
        // A worker gives its master up after three heartbeats, as the master gives up a worker
        // after `silence`.
        let heartbeat_ms = (config.schedule.silence / 3000).min(u32::MAX.into()) as u32;
        let audits = Audits {
            everybody: config.audit_ppm.is_some(),
            nobody: config.audit_ppm == Some(0),
            shut_out: config.shut_out,
        };
        let workers = WorkerTable::new(config.rehearse, config.machine, heartbeat_ms, audits);
        let mut schedule = config.schedule;
        schedule.audit_ppm = config.audit_ppm.unwrap_or(schedule.audit_ppm);
        schedule.audit_seed = getrandom::u64().map_err(std::io::Error::other)?;
        let scheduler = RecordedScheduler::new(schedule, config.record);
        let driver = Driver::new(
            library,
            config.shares,
            config.rehearse,
            scheduler,
            workers,
            jobs,
            (inbox, finishers),
            config.hooks,
        );
        let thread = std::thread::Builder::new()
            .name("slabcast-master".into())
            .spawn(move || runtime.block_on(driver.run(events)))?;
        Ok(Master { handle, thread: Some(thread) })
    }

    /// Returns a handle to the master.
    pub fn handle(&self) -> Handle {
        self.handle.clone()
    }

    /// Tells workers to leave, ends the driver and waits for it. Jobs in progress fail.
    pub async fn shutdown(mut self) {
        let _ = self.handle.inbox.send(Event::Shutdown).await;
        if let Some(thread) = self.thread.take() {
            let _ = tokio::task::spawn_blocking(move || thread.join()).await;
        }
    }
}

/// A handle to a running master; cheap to clone.
#[derive(Clone)]
pub struct Handle {
    inbox: mpsc::Sender<Event>,
    jobs: Arc<Jobs>,
    library: Arc<Library>,
    planning: Arc<Semaphore>,
    looks: Arc<Semaphore>,
    shares: Shares,
    peer_limits: PeerLimits,
    show_names: bool,
    hooks: Hooks,
}

impl Handle {
    /// Returns the volumes of the master.
    pub fn library(&self) -> &Arc<Library> {
        &self.library
    }

    /// Returns who calls from `peer`, as the library knows callers.
    pub fn viewer(&self, peer: Option<IpAddr>) -> Viewer {
        Viewer::at(peer, self.show_names)
    }

    /// Runs what may read a volume's file, on a blocking thread; at most `PLANS_AT_ONCE` run at a
    /// time. `None` if the master is gone.
    pub async fn reading<T: Send + 'static>(
        &self,
        run: impl FnOnce(&Library) -> T + Send + 'static,
    ) -> Option<T> {
        self.with_library(&self.planning, run).await
    }

    /// Runs a call that looks at folders or writes a piece of an upload on a blocking thread; at
    /// most `LOOKS_AT_ONCE` run at a time. `None` if the master has ended.
    pub async fn looking<T: Send + 'static>(
        &self,
        run: impl FnOnce(&Library) -> T + Send + 'static,
    ) -> Option<T> {
        self.with_library(&self.looks, run).await
    }

    async fn with_library<T: Send + 'static>(
        &self,
        places: &Arc<Semaphore>,
        run: impl FnOnce(&Library) -> T + Send + 'static,
    ) -> Option<T> {
        let place = places.clone().acquire_owned().await.ok()?;
        let library = self.library.clone();
        let done = tokio::task::spawn_blocking(move || {
            let _place = place;
            run(&library)
        });
        done.await.ok()
    }

    /// Returns whether a job in progress draws the volume with this digest.
    pub fn is_drawn(&self, volume: Digest32) -> bool {
        let table = self.jobs.lock();
        table.jobs().any(|job| job.view.volume == volume && !job.view.state.is_over())
    }

    /// Returns what one address may have at a time.
    pub(crate) fn peer_limits(&self) -> PeerLimits {
        self.peer_limits
    }

    /// Submits a view path and returns its job. A request that was submitted before under its
    /// `client_key` gives the job of that time; if frames of it failed they are drawn again, and
    /// no others. Must be called inside a tokio runtime: the
    /// request is checked on one of its blocking threads.
    ///
    /// # Errors
    /// [`SubmitError::Refused`] names a field that can't be used; the others say why the master
    /// takes no such job now.
    pub async fn submit(&self, request: PathRequest) -> Result<JobId, SubmitError> {
        self.submit_from(request, None).await
    }

    /// Submits a view path for a client that calls from `peer`; otherwise equal to
    /// [`Handle::submit`].
    ///
    /// # Errors
    /// [`SubmitError::Refused`] names a field that can't be used; the others say why the master
    /// takes no such job now.
    pub async fn submit_from(
        &self,
        request: PathRequest,
        peer: Option<IpAddr>,
    ) -> Result<JobId, SubmitError> {
        let submitter = Submitter::Batch(peer.map(counted_as));
        let admitted = self.submit_for(request, submitter, self.viewer(peer), None).await?;
        Ok(admitted.job)
    }

    /// Submits a path of one frame for the live session with the unique number `session`. `viewer` decides
    /// which volumes the path may name. Lists of jobs leave such jobs out. Dropping the returned value
    /// ends the job. `tiles` receives tiles in batches while the frame is drawn; tiles for which the
    /// channel has no room are left out.
    ///
    /// # Errors
    /// The field of the request that can't be used, the limit that is exceeded, or the master has ended.
    pub async fn draw(
        &self,
        request: PathRequest,
        session: u64,
        viewer: Viewer,
        tiles: Option<mpsc::Sender<DrawnTile>>,
    ) -> Result<Drawing, SubmitError> {
        let Admitted { job, guard } =
            self.submit_for(request, Submitter::Live(session), viewer, tiles).await?;
        let watch = Watch::new(self.jobs.clone(), job, 0, self.inbox.clone());
        Ok(Drawing { watch, _guard: guard })
    }

    async fn submit_for(
        &self,
        request: PathRequest,
        submitter: Submitter,
        viewer: Viewer,
        tiles: Option<mpsc::Sender<DrawnTile>>,
    ) -> Result<Admitted, SubmitError> {
        let peer = submitter.peer();
        check_key(&request.client_key)?;
        if let Some(job) = self.jobs.lock().by_key(&request.client_key) {
            if *job.request != request {
                return Err(SubmitError::KeyTaken);
            }
            if !job.may_retry() {
                return Ok(Admitted { job: job.view.id, guard: None });
            }
        }
        // Whom the driver would turn away costs no check.
        let _checking = self.jobs.reserve(request.held_bytes(), peer, self.peer_limits.jobs)?;
        let (shares, hooks) = (self.shares, self.hooks.clone());
        let planned = self.reading(move |library| {
            caught("checking the request", || {
                hooks.reach(Stage::Plan);
                let open = library.open(&request.volume, viewer)?;
                let plan = Plan::new(request, &open, |level| library.level(&open, level), &shares);
                if let Err(SubmitError::Volume(VolumeError::NotReadable(_))) = &plan {
                    library.close(open.served.info.digest);
                }
                plan
            })
        });
        let plan = planned.await.ok_or(SubmitError::Gone)?;
        let mut plan = Box::new(plan.map_err(|e| SubmitError::Panicked(e.to_string()))??);
        plan.tiles = tiles;
        let (reply, answer) = oneshot::channel();
        if self.inbox.send(Event::Submit { plan, submitter, reply }).await.is_err() {
            return Err(SubmitError::Gone);
        }
        answer.await.map_err(|_| SubmitError::Gone)?
    }

    /// Returns a watcher of a job that starts with frame `first`; `None` if there is no such job.
    pub fn watch(&self, job: JobId, first: u64) -> Option<Watch> {
        self.jobs.lock().get(job)?;
        Some(Watch::new(self.jobs.clone(), job, first, self.inbox.clone()))
    }

    /// Returns one job, if it is remembered.
    pub fn job(&self, job: JobId) -> Option<JobView> {
        self.jobs.lock().get(job).map(|job| job.view.clone())
    }

    /// Returns the first frame of a job, from `frame` on, whose pixels are kept.
    pub fn first_kept_frame(&self, job: JobId, frame: u64) -> Option<u64> {
        self.jobs.lock().get(job)?.first_kept(frame)
    }

    /// Returns the first frame of a job that is kept, without taking it.
    pub fn kept_frame(&self, job: JobId) -> Option<Arc<FinishedFrame>> {
        self.jobs.lock().get(job)?.kept_frame()
    }

    /// Returns all jobs that are remembered but for those of live sessions, oldest first.
    pub fn jobs(&self) -> Vec<JobView> {
        let table = self.jobs.lock();
        table.jobs().filter(|job| !job.submitter.is_live()).map(|job| job.view.clone()).collect()
    }

    /// Cancels a job. Returns false if there is none or its frames are no longer rendered.
    pub async fn cancel(&self, job: JobId) -> bool {
        let (reply, answer) = oneshot::channel();
        self.inbox.send(Event::Cancel { job, reply }).await.is_ok() && answer.await.unwrap_or(false)
    }

    /// Returns the workers that are linked; none when the master is gone.
    pub async fn workers(&self) -> Vec<Worker> {
        let (reply, answer) = oneshot::channel();
        if self.inbox.send(Event::Workers { reply }).await.is_err() {
            return Vec::new();
        }
        answer.await.unwrap_or_default()
    }

    /// Lets a worker in and returns its id. The driver then sends to it over `link`, first a
    /// welcome.
    ///
    /// # Errors
    /// [`AttachError`] says what of the hello does not fit, in words for the worker's operator.
    pub async fn attach(
        &self,
        hello: Hello,
        caller: Caller,
        link: WorkerLink,
    ) -> Result<WorkerId, AttachError> {
        let (reply, answer) = oneshot::channel();
        let event = Event::Attach { hello, caller, link, reply };
        self.inbox.send(event).await.map_err(|_| AttachError::ShuttingDown)?;
        answer.await.map_err(|_| AttachError::ShuttingDown)?
    }

    /// The hooks of this crate's tests.
    pub(crate) fn hooks(&self) -> &Hooks {
        &self.hooks
    }

    /// Passes a worker's message to the driver, which gives its place back once it has handled it.
    /// Returns false when the master is gone.
    pub(crate) async fn worker_said(
        &self,
        worker: WorkerId,
        message: ToMaster,
        place: OwnedSemaphorePermit,
    ) -> bool {
        self.inbox.send(Event::Said { worker, message, _place: place }).await.is_ok()
    }

    /// Tells the driver that a worker's link has ended, and why. `is_damage`: the line was at
    /// fault, so that no tile is suspected of it.
    pub async fn detach(&self, worker: WorkerId, reason: String, is_damage: bool) {
        let _ = self.inbox.send(Event::Detached { worker, reason, is_damage }).await;
    }
}

/// A picture that is being drawn for a live session, from [`Handle::draw`]. Dropped, it is drawn no
/// further.
pub struct Drawing {
    // Dropped first: the watcher tells the table that it holds no frame.
    watch: Watch,
    _guard: Option<Forgets>,
}

impl Drawing {
    /// Waits for the picture.
    ///
    /// # Errors
    /// It can't be drawn, for a reason in words.
    pub async fn finished(&mut self) -> Result<Arc<FinishedFrame>, String> {
        loop {
            match self.watch.next().await {
                Some(WatchItem::Frame(frame)) => return Ok(frame),
                Some(WatchItem::Failed { reason, .. }) => return Err(reason.to_string()),
                Some(WatchItem::Notice(view)) => match view.state {
                    JobState::Failed(reason) => return Err(reason),
                    JobState::Cancelled => return Err("it was cancelled".into()),
                    _ => {}
                },
                None => return Err("the master ended".into()),
            }
        }
    }
}

/// Returns wall time in milliseconds since 1970 UTC, for people: nothing is decided by it.
pub(crate) fn unix_ms() -> i64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since.map_or(0, |d| d.as_millis() as i64)
}
