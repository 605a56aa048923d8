//! Jobs: from a checked request to frames for the scheduler.

use super::{Driver, Event, Flight};
use crate::hooks::Stage;
use crate::jobs::JobState;
use crate::jobs::submit::{Plan, SubmitError};
use crate::memory;
use crate::panics::{Panicked, caught};
use slabcast_common::ids::{FrameId, JobId};
use slabcast_common::link::FRAMES_IN_FLIGHT;
use slabcast_schedule::{Event as Happened, FrameJob};
use slabcast_volumes::BrickStore;
use std::sync::Arc;
use tracing::{info, warn};

/// Jobs that are in progress or can be watched again; each holds its views (300 bytes a frame).
const MAX_OPEN_JOBS: usize = 200;

impl Driver {
    pub(super) fn submit(&mut self, plan: Plan) -> Result<JobId, SubmitError> {
        // Another request may have come under this key while this one was checked.
        let table = self.jobs.lock();
        if let Some(job) = table.by_key(&plan.request.client_key) {
            if *job.request != *plan.request {
                return Err(SubmitError::KeyTaken);
            }
            let (id, may_retry) = (job.view.id, job.may_retry());
            drop(table);
            if may_retry {
                self.retry(id, plan);
            }
            return Ok(id);
        }
        drop(table);
        if self.active.len() >= MAX_OPEN_JOBS {
            return Err(SubmitError::Full);
        }
        let mut table = self.jobs.lock();
        let id = table.next_id();
        let entry = plan.entry(id);
        info!(job = %id, frames = entry.view.frames_total, sums = ?plan.quality().sums, "job submitted");
        table.insert(entry);
        drop(table);
        self.activate(id, plan, 0);
        Ok(id)
    }

    /// Draws the failed frames of a job again, and no others.
    fn retry(&mut self, id: JobId, plan: Plan) {
        let frames = self.jobs.lock().reopen(id);
        info!(job = %id, frames, "failed frames are drawn again");
        if self.active.contains(id) {
            self.refresh_states();
        } else {
            self.activate(id, plan, u64::MAX);
        }
        self.jobs.ring();
    }

    /// Makes a job active: its frames from number `next` on are drawn, and those that are wanted
    /// again.
    fn activate(&mut self, id: JobId, plan: Plan, next: u64) {
        let store = self.brick_sets.covering(&plan.wanted).cloned();
        if let Some(store) = &store {
            self.brick_sets.keep(store, |key| self.active.needs(key));
        }
        let bricks = match &store {
            Some(store) => store.key(),
            None => plan.wanted.set_key(self.served.info.digest),
        };
        let must_cut = store.is_none();
        let mut job = plan.activate(id, self.served.info.clone(), bricks, store);
        job.next = next.min(job.views.len() as u64);
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
                return;
            }
        }
        self.refresh_states();
    }

    pub(super) fn bricks_cut(&mut self, id: JobId, store: Result<Arc<BrickStore>, Panicked>) {
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
    pub(super) fn feed(&mut self) {
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
    pub(super) fn retire(&mut self) {
        let retired = self.active.retired(&self.jobs.lock());
        for id in retired {
            self.deactivate(id);
        }
    }

    pub(super) fn deactivate(&mut self, id: JobId) {
        self.jobs.lock().retire(id);
        if let Some(job) = self.active.remove(id) {
            let scene = job.scene.id;
            self.scheduler.handle(&self.clock, Happened::SceneEnded { scene });
        }
    }

    /// Ends a job that is not finished.
    pub(super) fn end_job(&mut self, id: JobId, state: JobState) {
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

    pub(super) fn fail_job(&mut self, job: JobId, reason: String) {
        warn!(%job, reason, "job failed");
        self.end_job(job, JobState::Failed(reason));
    }

    /// Fails the job of a frame that the master itself can't finish. Does nothing if its job has ended already.
    pub(super) fn fail_frame(&mut self, frame: FrameId, reason: &str) {
        if let Some(flight) = self.flights.get(&frame) {
            let (job, number) = (flight.job, flight.number);
            self.fail_job(job, format!("frame {number}: {reason}"));
        }
    }

    /// Updates the state of every job in progress.
    pub(super) fn refresh_states(&mut self) {
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
}
