//! Jobs that still have frames to render, or whose frames may be asked for again.

use super::submit::Views;
use super::{DrawnTile, Table};
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{FrameId, JobId, SceneId};
use slabcast_common::message::{LIVE_CLIENT, SceneSpec};
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::request::PathRequest;
use slabcast_scene::tween::Tween;
use std::collections::{BTreeMap, VecDeque};
use std::net::IpAddr;
use std::sync::Arc;
use tokio::sync::mpsc;

/// Finished jobs that can be watched again from the start without being submitted anew.
const RENDERABLE_WHEN_DONE: usize = 4;

/// Frames of a job after which it first comes behind others. At half, a preview of a turn loses its
/// place before it is done; at twice this, one frame waits for 32 of each job before it.
const FIRST_TURN: u64 = 16;

/// A job with all that its frames are rendered from.
pub(crate) struct ActiveJob {
    pub(crate) request: Arc<PathRequest>,
    /// The scene of all frames; of a tween, all but the transfer function.
    pub(crate) scene: Arc<SceneSpec>,
    pub(crate) tween: Option<Tween>,
    /// Voxels and data in the job's brick set: those that the job needs, or more.
    pub(crate) bricks: BrickNeeds,
    pub(crate) views: Views,
    /// The next frame that was never rendered, or one before it.
    pub(crate) next: u64,
    /// Number of frames that were begun, repeated ones included.
    pub(crate) begun: u64,
    /// Receiver of tiles before their frame is done; `None` for jobs of clients.
    pub(crate) tiles: Option<mpsc::Sender<DrawnTile>>,
}

/// A frame that may be begun next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Candidate {
    pub(crate) job: JobId,
    pub(crate) number: u64,
    /// Whether a watcher waits for it; else it is drawn ahead.
    pub(crate) wanted: bool,
}

/// Bit of the ids of scenes of a tween's single frames, beside the frame's id. Ids of jobs' scenes
/// lack it.
const SINGLE_FRAME: u64 = 1 << 63;

impl ActiveJob {
    /// The turn that the job is in: the first of [`FIRST_TURN`] frames, each as long as all before
    /// it. Jobs in earlier turns come first, so that one frame need not wait for 100,000; and since
    /// turns grow, jobs that need brick sets of their own seldom take turns.
    fn turn(&self) -> u32 {
        (self.begun / FIRST_TURN + 1).ilog2()
    }

    /// The scene of frame `number`, which the scheduler knows as `frame`. Each frame of a tween is
    /// a scene of its own on the same bricks.
    pub(crate) fn scene_of(&self, number: u64, frame: FrameId) -> Arc<SceneSpec> {
        let Some(tween) = &self.tween else { return self.scene.clone() };
        let position = (self.request.path.first_frame() as u64 + number) as f64;
        let scene = tween.scene_at(&self.scene, self.request.quality.sums, position);
        Arc::new(SceneSpec { id: SceneId(frame.0 | SINGLE_FRAME), ..scene })
    }
}

/// The active jobs, in the order in which they came.
#[derive(Default)]
pub(crate) struct ActiveJobs {
    by_id: BTreeMap<JobId, ActiveJob>,
    order: VecDeque<JobId>,
    /// Addresses and live sessions with jobs. A new address starts with the least work of all
    /// others: it is served at once, and can't claim the time before it came.
    peers: BTreeMap<Submitter, Peer>,
    peer_of: BTreeMap<JobId, Submitter>,
    last_client: u64,
}

/// Whom a job is drawn for. Different ones share all threads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Submitter {
    /// A live session of this number: one frame at a time, which a person waits for.
    Live(u64),
    /// An address; `None`: this process.
    Batch(Option<IpAddr>),
}

impl Submitter {
    /// Returns the address that limits count by; `None` for this process, live sessions included.
    pub(crate) fn peer(self) -> Option<IpAddr> {
        match self {
            Submitter::Live(_) => None,
            Submitter::Batch(peer) => peer,
        }
    }

    /// Returns whether this is a live session.
    pub(crate) fn is_live(self) -> bool {
        matches!(self, Submitter::Live(_))
    }
}

/// An address with jobs.
#[derive(Clone, Copy, Debug)]
struct Peer {
    /// Number of the address for scheduler and workers (`FrameJob::client`).
    client: u64,
    /// Thread time of the address's frames in microseconds: measured for frames that ended, guessed
    /// from their size for frames in flight.
    work_us: u64,
}

/// Returns the guessed thread time of a frame in flight, in microseconds: 1 ms, and 1 us for each
/// KiB of memory that it takes while it is rendered.
fn guessed_us(making_bytes: u64) -> u64 {
    1000 + making_bytes / 1024
}

impl ActiveJobs {
    pub(crate) fn insert(&mut self, id: JobId, job: ActiveJob, peer: Submitter) {
        let least = self.peers.values().map(|peer| peer.work_us).min().unwrap_or(0);
        self.peers.entry(peer).or_insert_with(|| {
            self.last_client += 1;
            let class = if peer.is_live() { LIVE_CLIENT } else { 0 };
            Peer { client: self.last_client | class, work_us: least }
        });
        self.peer_of.insert(id, peer);
        self.by_id.insert(id, job);
        self.order.push_back(id);
    }

    pub(crate) fn get(&self, id: JobId) -> Option<&ActiveJob> {
        self.by_id.get(&id)
    }

    pub(crate) fn get_mut(&mut self, id: JobId) -> Option<&mut ActiveJob> {
        self.by_id.get_mut(&id)
    }

    pub(crate) fn remove(&mut self, id: JobId) -> Option<ActiveJob> {
        self.order.retain(|other| *other != id);
        if let Some(peer) = self.peer_of.remove(&id)
            && !self.peer_of.values().any(|other| *other == peer)
        {
            self.peers.remove(&peer);
        }
        self.by_id.remove(&id)
    }

    pub(crate) fn contains(&self, id: JobId) -> bool {
        self.by_id.contains_key(&id)
    }

    /// Records that a frame of a job began, which takes `making_bytes` while it is rendered.
    pub(crate) fn begun(&mut self, id: JobId, making_bytes: u64) {
        if let Some(job) = self.by_id.get_mut(&id) {
            job.begun += 1;
        }
        let peer = self.peer_of.get(&id).and_then(|peer| self.peers.get_mut(peer));
        if let Some(peer) = peer {
            peer.work_us += guessed_us(making_bytes);
        }
    }

    /// Records that a frame ended, failed or was cancelled: replaces the guess for `making_bytes`
    /// by its thread time `took_us`, in microseconds.
    pub(crate) fn ended(&mut self, id: JobId, making_bytes: u64, took_us: u64) {
        let peer = self.peer_of.get(&id).and_then(|peer| self.peers.get_mut(peer));
        if let Some(peer) = peer {
            let guessed = guessed_us(making_bytes);
            peer.work_us = peer.work_us.saturating_sub(guessed).saturating_add(took_us.max(1000));
        }
    }

    /// Returns the number of the client (address) that submitted a job; 0 if the job is unknown.
    pub(crate) fn client_of(&self, id: JobId) -> u64 {
        self.peer_of.get(&id).and_then(|peer| self.peers.get(peer)).map_or(0, |peer| peer.client)
    }

    /// Ids, oldest first.
    pub(crate) fn ids(&self) -> impl Iterator<Item = JobId> {
        self.order.iter().copied()
    }

    /// Whether a job that is not over draws from the bricks of this set.
    pub(crate) fn open_need(&self, table: &Table, bricks: BrickSetKey) -> bool {
        let is_open = |id: &JobId| table.get(*id).is_some_and(|job| !job.view.state.is_over());
        self.by_id.iter().any(|(id, job)| job.scene.bricks == bricks && is_open(id))
    }

    /// The frame that each job would begin next: one that a watcher waits for, or else the next
    /// that was never rendered. Jobs of the address that took least time come first, and among its
    /// jobs those in earlier turns. Within a turn, frames that are waited for come first, and older
    /// jobs. Frames of live sessions come before all others. `is_in_flight` tells of frames that are being rendered.
    pub(crate) fn candidates(
        &self,
        table: &Table,
        is_in_flight: impl Fn(JobId, u64) -> bool,
    ) -> Vec<Candidate> {
        let next = |id: JobId, active: &ActiveJob| {
            let (job, total) = (table.get(id)?, active.views.len());
            if let Some(number) = job.missing().find(|&n| n < total && !is_in_flight(id, n)) {
                return Some(Candidate { job: id, number, wanted: true });
            }
            let is_new = |n: &u64| !job.has_ended(*n) && !is_in_flight(id, *n);
            let retried = job.retried.iter().copied().find(|&n| !is_in_flight(id, n));
            let number = retried.or_else(|| (active.next..total).find(is_new))?;
            Some(Candidate { job: id, number, wanted: false })
        };
        let jobs = self.order.iter().filter_map(|&id| {
            let active = self.by_id.get(&id)?;
            let peer = self.peer_of.get(&id).and_then(|peer| self.peers.get(peer));
            let work = peer.map(|peer| peer.work_us);
            let is_batch = !self.peer_of.get(&id).is_some_and(|peer| peer.is_live());
            Some(((is_batch, work, active.turn()), next(id, active)?))
        });
        let mut candidates: Vec<_> = jobs.collect();
        candidates.sort_by_key(|(turn, candidate): &(_, Candidate)| (*turn, !candidate.wanted));
        candidates.into_iter().map(|(_, candidate)| candidate).collect()
    }

    /// Jobs that are over and whose frames are no longer rendered again: all but the last
    /// [`RENDERABLE_WHEN_DONE`].
    pub(crate) fn retired(&self, table: &Table) -> Vec<JobId> {
        let is_over = |id: &JobId| table.get(*id).is_none_or(|job| job.view.state.is_over());
        let mut over: Vec<JobId> = self.ids().filter(is_over).collect();
        over.truncate(over.len().saturating_sub(RENDERABLE_WHEN_DONE));
        over
    }
}
