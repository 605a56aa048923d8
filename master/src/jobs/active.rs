//! Jobs that still have frames to render, or whose frames may be asked for again.

use super::Table;
use crate::brick_sets::BrickSets;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{FrameId, JobId, SceneId};
use slabcast_common::message::SceneSpec;
use slabcast_common::view::View;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::request::PathRequest;
use slabcast_scene::tween::Tween;
use slabcast_volumes::BrickStore;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Finished jobs that can be watched again from the start without being submitted anew.
const RENDERABLE_WHEN_DONE: usize = 4;

/// A job with all that its frames are rendered from.
pub(crate) struct ActiveJob {
    pub(crate) request: Arc<PathRequest>,
    /// The scene of all frames; of a tween, all but the transfer function.
    pub(crate) scene: Arc<SceneSpec>,
    pub(crate) tween: Option<Tween>,
    pub(crate) wanted: BrickNeeds,
    /// One view a frame.
    pub(crate) views: Vec<View>,
    /// Bricks of the job, once they are cut.
    pub(crate) store: Option<Arc<BrickStore>>,
    /// The next frame that was never rendered.
    pub(crate) next: u64,
}

/// Bit of the ids of scenes of a tween's single frames, beside the frame's id. Ids of jobs' scenes
/// lack it.
const SINGLE_FRAME: u64 = 1 << 63;

impl ActiveJob {
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
}

impl ActiveJobs {
    pub(crate) fn insert(&mut self, id: JobId, job: ActiveJob) {
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
        self.by_id.remove(&id)
    }

    pub(crate) fn contains(&self, id: JobId) -> bool {
        self.by_id.contains_key(&id)
    }

    pub(crate) fn len(&self) -> usize {
        self.order.len()
    }

    /// Ids, oldest first.
    pub(crate) fn ids(&self) -> impl Iterator<Item = JobId> {
        self.order.iter().copied()
    }

    /// Whether a job draws from the bricks of this set.
    pub(crate) fn needs(&self, bricks: BrickSetKey) -> bool {
        self.by_id.values().any(|job| job.scene.bricks == bricks)
    }

    /// The bricks of this set, if a job holds them.
    pub(crate) fn store(&self, key: BrickSetKey) -> Option<&Arc<BrickStore>> {
        self.by_id.values().find_map(|job| job.store.as_ref().filter(|s| s.key() == key))
    }

    /// Gives jobs without bricks those that were cut for another job meanwhile.
    pub(crate) fn share_bricks(&mut self, sets: &BrickSets) {
        for job in self.by_id.values_mut().filter(|job| job.store.is_none()) {
            let set = sets.get(job.scene.bricks);
            job.store = set.filter(|s| s.needs().covers(&job.wanted)).cloned();
        }
    }

    /// The next frame to render: the oldest job's, unless its untaken frames fill the budget.
    /// `is_in_flight` tells of frames that are being rendered.
    pub(crate) fn next_frame(
        &self,
        table: &Table,
        budget_bytes: usize,
        is_in_flight: impl Fn(JobId, u64) -> bool,
    ) -> Option<(JobId, u64)> {
        let has_room = table.untaken_bytes() < budget_bytes;
        for id in &self.order {
            let (Some(active), Some(job)) = (self.by_id.get(id), table.get(*id)) else { continue };
            if active.store.is_none() {
                continue;
            }
            let again = job.wanted_again.iter().copied().find(|n| !is_in_flight(*id, *n));
            if let Some(number) = again {
                return Some((*id, number));
            }
            let retried = job.retried.iter().copied().find(|n| !is_in_flight(*id, *n));
            if let Some(number) = retried.filter(|_| has_room || !job.has_untaken()) {
                return Some((*id, number));
            }
            if active.next < active.views.len() as u64 && (has_room || !job.has_untaken()) {
                return Some((*id, active.next));
            }
        }
        None
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
