//! Clusters in this process, embedded or over TCP, and the hashes of their frames.

use sha2::{Digest, Sha256};
use slabcast_client::Client;
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Quality, Work};
use slabcast_common::transfer::TransferFunction;
use slabcast_common::volume::{Digest32, Volume};
use slabcast_master::SubmitError;
use slabcast_master::jobs::{FinishedFrame, JobState, WatchItem};
use slabcast_master::{Handle, Master, MasterConfig};
use slabcast_render::Simd;
use slabcast_scene::path::{Orientation, ViewPath};
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::transfer::TransferChoice;
use slabcast_session::embedded::{Cluster, WorkerGroup, start_master};
use slabcast_session::fail::Fail;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinSet;

/// Time limit for workers to join; each draws its self-test first.
const JOIN: Duration = Duration::from_secs(30);

/// Returns the request for a path's pictures as floats, which are hashed and judged.
pub(super) fn request(
    path: ViewPath,
    transfer: &TransferFunction,
    quality: Quality,
    work: Work,
) -> PathRequest {
    PathRequest {
        client_key: slabcast_session::request::client_key(),
        volume: VolumeChoice::Default,
        level: LevelChoice::default(),
        path,
        transfer: TransferChoice::Function(Box::new(transfer.clone())),
        quality,
        work,
        format: PixelFormat::Rgba32F,
        background: Background::Transparent,
        want_trace: false,
        want_hash: true,
    }
}

/// The link between master and workers in this process.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Link {
    /// Channels; bricks are shared in memory.
    Embedded,
    /// gRPC over loopback.
    Tcp,
    /// gRPC over loopback to workers that may hold 32 KiB of bricks: some twenty, fewer than any
    /// view needs.
    TcpShort,
}

impl std::fmt::Display for Link {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Link::Embedded => "embedded",
            Link::Tcp => "tcp",
            Link::TcpShort => "tcp, 32 KiB",
        })
    }
}

/// A cluster over any link.
pub(crate) enum TestCluster {
    Embedded(Cluster),
    Tcp(Box<TcpCluster>),
}

/// A master and workers in this process that speak gRPC over loopback.
pub(crate) struct TcpCluster {
    master: Master,
    client: Client,
    stop: watch::Sender<bool>,
    tasks: JoinSet<Result<(), String>>,
}

impl TestCluster {
    /// Starts a cluster for `volume` and waits until its workers have joined.
    pub(crate) async fn start(
        volume: &Volume,
        link: Link,
        crew: WorkerGroup,
    ) -> Result<TestCluster, Fail> {
        let orientation = Orientation::new(None, None).map_err(|e| Fail::flag(&e))?;
        let volume = volume.clone();
        let memory = match link {
            Link::Embedded => None,
            Link::Tcp => Some(1 << 30),
            Link::TcpShort => Some(32 << 10),
        };
        let (cluster, handle) = if let Some(memory) = memory {
            let tcp =
                TcpCluster::start(MasterConfig::new(volume, orientation), crew, memory).await?;
            let handle = tcp.master.handle();
            (TestCluster::Tcp(Box::new(tcp)), handle)
        } else {
            let cluster = Cluster::start(volume, orientation, crew, None)?;
            let handle = cluster.handle();
            (TestCluster::Embedded(cluster), handle)
        };
        joined(&handle, crew.workers).await?;
        Ok(cluster)
    }

    /// Renders `request` and returns the hash of each frame's bytes.
    pub(crate) async fn hashes(&mut self, request: PathRequest) -> Result<Vec<String>, Fail> {
        match self {
            TestCluster::Embedded(cluster) => {
                tokio::select! {
                    hashes = embedded_hashes(cluster.handle(), request) => hashes,
                    trouble = cluster.trouble() => Err(trouble),
                }
            }
            TestCluster::Tcp(tcp) => tcp.hashes(request).await,
        }
    }

    /// Stops workers and master.
    pub(crate) async fn end(self) {
        match self {
            TestCluster::Embedded(cluster) => cluster.end().await,
            TestCluster::Tcp(tcp) => tcp.end().await,
        }
    }
}

/// Returns the hash of a frame's floats.
///
/// # Errors
/// If the frame's statistics name another hash.
fn hash(number: u64, bytes: &[u8], said: &str) -> Result<String, Fail> {
    let hash = Digest32(Sha256::digest(bytes).into()).to_string();
    if hash == said {
        return Ok(hash);
    }
    Err(Fail::failed(format!("frame {number} hashes to {hash}, but its statistics say {said}")))
}

pub(super) async fn embedded_hashes(
    handle: Handle,
    request: PathRequest,
) -> Result<Vec<String>, Fail> {
    embedded_frames(handle, request, |f| hash(f.number, &f.bytes, &f.stats.pixels_sha256)).await
}

/// Renders `request` by a master in this process and returns `of` each frame.
pub(crate) async fn embedded_frames<T>(
    handle: Handle,
    request: PathRequest,
    mut of: impl FnMut(&FinishedFrame) -> Result<T, Fail>,
) -> Result<Vec<T>, Fail> {
    let job = handle.submit(request).await.map_err(|e| match e {
        SubmitError::Refused(e) => Fail::failed(e.to_string()),
        other => Fail::failed(format!("the master takes no job: {other:?}")),
    })?;
    let mut watch =
        handle.watch(job, 0).ok_or_else(|| Fail::failed(format!("{job} was forgotten")))?;
    let mut frames = Vec::new();
    while let Some(item) = watch.next().await {
        match item {
            WatchItem::Frame(f) => frames.push(of(&f)?),
            WatchItem::Failed { number, reason } => {
                return Err(Fail::failed(format!("frame {number} failed: {reason}")));
            }
            WatchItem::Notice(view) => {
                if let JobState::Failed(reason) = view.state {
                    return Err(Fail::failed(reason));
                }
            }
        }
    }
    Ok(frames)
}

/// Waits until `workers` workers have joined.
pub(crate) async fn joined(handle: &Handle, workers: u32) -> Result<(), Fail> {
    let all = async {
        while handle.workers().await.len() < workers as usize {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(JOIN, all).await.map_err(|_| {
        Fail::failed(format!("{workers} workers did not join in {} s", JOIN.as_secs()))
    })
}

impl TcpCluster {
    async fn start(
        config: MasterConfig,
        crew: WorkerGroup,
        memory: u64,
    ) -> Result<TcpCluster, Fail> {
        let io = |e: std::io::Error| Fail::failed(format!("listening on 127.0.0.1 failed: {e}"));
        let listener = TcpListener::bind("127.0.0.1:0").await.map_err(io)?;
        let address = listener.local_addr().map_err(io)?.to_string();
        let master = start_master(config)?;
        let (stop, stopped) = watch::channel(false);
        let mut tasks = JoinSet::new();
        let serve = slabcast_master::serve::serve(master.handle(), listener, stopped.clone());
        tasks.spawn(async move { serve.await.map_err(|e| e.to_string()) });
        for n in 1..=crew.workers {
            let config = slabcast_worker::Config {
                name: format!("tcp-{n}"),
                threads: crew.threads,
                memory_budget_bytes: memory,
                simd: Simd::detect(),
                rehearsal: None,
                machine: String::new(),
            };
            let run = slabcast_worker::dial::run(config, address.clone(), stopped.clone());
            tasks.spawn(async move { run.await.map(drop).map_err(|e| e.to_string()) });
        }
        let client = Client::connect(&address)
            .await
            .map_err(|e| slabcast_session::remote::client_failure(&e))?;
        Ok(TcpCluster { master, client, stop, tasks })
    }

    async fn hashes(&mut self, request: PathRequest) -> Result<Vec<String>, Fail> {
        let fail = |e| slabcast_session::remote::client_failure(&e);
        let job = self.client.submit(&request).await.map_err(fail)?;
        let mut frames = self.client.watch(&job, 0).await.map_err(fail)?;
        let mut hashes = Vec::new();
        while let Some(update) = frames.next().await.map_err(fail)? {
            if let slabcast_client::Update::Frame(f) = update {
                hashes.push(hash(f.number, &f.bytes, &f.stats.pixels_sha256)?);
            }
        }
        Ok(hashes)
    }

    async fn end(mut self) {
        drop(self.client);
        let _ = self.stop.send(true);
        // Workers first: a master that leaves before them would be dialled again.
        let ended = async {
            while self.tasks.join_next().await.is_some() {}
            self.master.shutdown().await;
        };
        let _ = tokio::time::timeout(Duration::from_secs(5), ended).await;
    }
}
