//! A master and its workers inside this process.
//!
//! Master and workers exchange the messages of a network through channels; the scheduler can't tell
//! (docs/design/cluster.md section 2). Bricks are shared, not copied.

use crate::fail::Fail;
use crate::machine::cores;
use crate::output::Frame;
use crate::progress::Step;
use crate::request::RenderRequest;
use crate::source::{Cancel, Source, Update};
use slabcast_common::protocol::MAX_THREADS;
use slabcast_common::volume::Volume;
use slabcast_master::SubmitError;
use slabcast_master::jobs::{JobState, WatchItem};
use slabcast_master::memory::available;
use slabcast_master::record::Recorder;
use slabcast_master::{Handle, Library, Master, MasterConfig, ServedVolume, link};
use slabcast_render::Simd;
use slabcast_scene::path::Orientation;
use slabcast_scene::request::PathRequest;
use slabcast_volumes::blocks::{BlockSource, MemorySource};
use slabcast_worker::{BrickCache, Config, Ended, Link};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;

/// Time for workers to leave. They finish their current tile, some 50 ms at most; what takes longer
/// ends with the process.
const LEAVE: Duration = Duration::from_secs(2);

/// Brick budget of a worker that shares the master's bricks: none of its own is used.
pub const SHARED: u64 = 1 << 40;

/// Silence after which a worker of this process would be lost, in microseconds: a day. A thread
/// that dies ends its link; silence only says that the process was stopped for a while (Ctrl-Z, a
/// debugger) or got no processor. With a cluster's three seconds a run of 30 frames failed after
/// `kill -STOP`, six seconds and `kill -CONT`.
const SILENCE: u64 = 86_400_000_000;

/// Number and size of the workers in this process.
#[derive(Clone, Copy, Debug)]
pub struct WorkerGroup {
    /// Number of workers in this process.
    pub workers: u32,
    /// Number of render threads of each worker.
    pub threads: u32,
}

impl WorkerGroup {
    /// Returns `workers` workers of `threads` threads each, or of their share of this machine's
    /// cores.
    ///
    /// # Errors
    /// More than 4096 threads in all.
    pub fn new(workers: u32, threads: Option<u32>) -> Result<Self, Fail> {
        let threads = threads.unwrap_or_else(|| (cores() / workers).max(1));
        if workers.saturating_mul(threads) > MAX_THREADS {
            return Err(Fail::usage(format!(
                "--workers, --threads: {workers} x {threads} threads; give {MAX_THREADS} in all at most"
            )));
        }
        Ok(WorkerGroup { workers, threads })
    }
}

impl std::fmt::Display for WorkerGroup {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let s = |n: u32| if n == 1 { "" } else { "s" };
        let (w, t) = (self.workers, self.threads);
        write!(f, "{w} worker{} of {t} thread{}", s(w), s(t))
    }
}

/// A master and its workers in this process.
pub struct Cluster {
    master: Master,
    stop: watch::Sender<bool>,
    workers: JoinSet<Result<Ended, std::io::Error>>,
}

impl Cluster {
    /// Starts a master of `volume` and the workers of `group`. Must be called inside a tokio
    /// runtime.
    ///
    /// # Errors
    /// The system gives no threads.
    pub fn start(
        volume: impl Into<Arc<Volume>>,
        orientation: Orientation,
        crew: WorkerGroup,
        record: Option<Recorder>,
    ) -> Result<Cluster, Fail> {
        Cluster::of(Arc::new(MemorySource::of(volume)), orientation, crew, record)
    }

    /// Starts a master of a volume that is read in boxes, like [`Cluster::start`].
    ///
    /// # Errors
    /// The system gives no threads.
    pub fn of(
        source: Arc<dyn BlockSource>,
        orientation: Orientation,
        crew: WorkerGroup,
        record: Option<Recorder>,
    ) -> Result<Cluster, Fail> {
        // Workers share the master's bricks of a volume in memory. Of a file both drop what exceeds
        // their memory.
        let brick_bytes = match source.whole(0) {
            Some(_) => SHARED,
            None => available().map_or(SHARED, |free| free / 4 / u64::from(crew.workers.max(1))),
        };
        Cluster::with_library(Library::of_source(source, orientation), crew, brick_bytes, record)
    }

    /// Starts a master of `library`, and workers which hold `brick_bytes` of bricks each beyond those
    /// that they share with it.
    ///
    /// # Errors
    /// The system gives no threads.
    pub fn with_library(
        library: Library,
        crew: WorkerGroup,
        brick_bytes: u64,
        record: Option<Recorder>,
    ) -> Result<Cluster, Fail> {
        let mut config = MasterConfig::of(library);
        config.schedule.silence = SILENCE;
        config.schedule.unresponsive_after = 0;
        config.record = record;
        let master = start_master(config)?;
        let (stop, stopped) = watch::channel(false);
        let mut workers = JoinSet::new();
        for n in 1..=crew.workers {
            let end = link::embedded(master.handle());
            let link = Link { control: end.control, replies: end.replies, bricks: end.bricks };
            let config = Config {
                name: format!("embedded-{n}"),
                threads: crew.threads,
                memory_budget_bytes: brick_bytes,
                simd: Simd::detect(),
                rehearsal: None,
                machine: String::new(),
            };
            let stop = stopped.clone();
            workers.spawn(async move {
                slabcast_worker::run(&config, link, &mut BrickCache::default(), stop).await
            });
        }
        Ok(Cluster { master, stop, workers })
    }

    /// Returns a handle to the master.
    pub fn handle(&self) -> Handle {
        self.master.handle()
    }

    /// Returns the description of the master's volume.
    pub fn volume(&self) -> Arc<ServedVolume> {
        let served = self.master.handle().library().default_volume();
        served.expect("a cluster in this process has the volume that it was started with")
    }

    /// Waits for a worker to end without having been told to, which should not happen, and
    /// returns why.
    pub async fn trouble(&mut self) -> Fail {
        let why = match self.workers.join_next().await {
            None => return std::future::pending().await,
            Some(Ok(Ok(Ended::Refused(reason)))) => reason,
            Some(Ok(Ok(Ended::Lost(reason) | Ended::MasterLeft(reason)))) => reason,
            Some(Ok(Ok(Ended::Stopped))) => "it stopped".into(),
            Some(Ok(Err(e))) => e.to_string(),
            Some(Err(e)) => e.to_string(),
        };
        Fail::failed(format!("a worker of this process ended: {why}"))
    }

    /// Shuts down the master, which says goodbye to its workers, and waits for them at most
    /// two seconds.
    pub async fn end(mut self) {
        let leave = async {
            self.master.shutdown().await;
            while self.workers.join_next().await.is_some() {}
        };
        let _ = tokio::time::timeout(LEAVE, leave).await;
        let _ = self.stop.send(true);
    }
}

/// Starts a master in this process, without workers.
///
/// # Errors
/// The system gives no threads.
pub fn start_master(config: MasterConfig) -> Result<Master, Fail> {
    Master::start(config).map_err(|e| {
        Fail::failed(format!("starting the master's threads failed: {}", crate::fail::reason(&e)))
    })
}

/// Submits a path to a master of this process and returns its updates.
///
/// # Errors
/// The master refuses the request; the error names the flag or the file.
pub async fn submit(
    handle: &Handle,
    request: &RenderRequest,
    message: PathRequest,
) -> Result<Source, Fail> {
    let job = handle.submit(message).await.map_err(|e| match e {
        SubmitError::Refused(refused) => request.blame(&refused),
        other => Fail::failed(format!("the master of this process takes no job: {other:?}")),
    })?;
    let Some(mut watch) = handle.watch(job, 0) else {
        return Err(Fail::failed(format!("{job} was forgotten by the master of this process")));
    };
    let framing = handle.job(job).and_then(|job| job.framing);
    let (to, updates) = mpsc::channel(1);
    let total = request.path.frames() as u64;
    tokio::spawn(async move {
        let mut taken = 0;
        loop {
            let update = match watch.next().await {
                Some(WatchItem::Frame(f)) => {
                    taken += 1;
                    Ok(Update::Frame {
                        frame: Frame {
                            number: f.number,
                            size: f.size,
                            format: f.format,
                            bytes: f.bytes.clone(),
                        },
                        stats: Some(Box::new(f.stats.clone())),
                        stats_json: f.stats_json.clone(),
                        trace_json: f.trace_json.clone().unwrap_or_default(),
                    })
                }
                Some(WatchItem::Failed { number, reason }) => {
                    taken += 1;
                    Ok(Update::FrameFailed { number, reason: reason.to_string() })
                }
                Some(WatchItem::Notice(view)) => match view.state {
                    JobState::Failed(reason) => Err(Fail::failed(reason)),
                    JobState::Cancelled => Err(Fail::failed("the job was cancelled")),
                    state => Ok(Update::Step(Step {
                        waiting: String::new(),
                        detail: match state {
                            JobState::Preparing => "cutting the volume into bricks".into(),
                            JobState::WaitingForWorkers => "workers are starting".into(),
                            _ => String::new(),
                        },
                        frames: view.frames_done,
                        tiles: view.tiles,
                        slab: view.slab,
                    })),
                },
                None if taken == total => Ok(Update::Done),
                None => Err(Fail::failed("the job ended before its last frame")),
            };
            let over = matches!(update, Ok(Update::Done) | Err(_));
            if to.send(update).await.is_err() || over {
                return;
            }
        }
    });
    let handle = handle.clone();
    let cancel = Cancel::new(async move {
        handle.cancel(job).await;
    });
    Ok(Source { updates, cancel, framing })
}
