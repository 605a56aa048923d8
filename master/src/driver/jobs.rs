//! Jobs: from a checked request to their end.

use super::Driver;
use crate::jobs::JobState;
use crate::jobs::active::Submitter;
use crate::jobs::submit::{Plan, SubmitError};
use slabcast_common::ids::{FrameId, JobId};
use slabcast_schedule::Event as Happened;
use tracing::{info, warn};

impl Driver {
    pub(super) fn submit(
        &mut self,
        plan: Plan,
        submitter: Submitter,
    ) -> Result<JobId, SubmitError> {
        let mut table = self.jobs.lock();
        // Another request may have come under this key while this one was checked.
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
        let peer = submitter.peer();
        table.has_place(plan.held_bytes(), peer)?;
        let id = table.next_id();
        let mut entry = plan.entry(id);
        entry.submitter = submitter;
        if !submitter.is_live() {
            info!(
                job = %id, peer = peer.map(|ip| ip.to_string()),
                frames = entry.view.frames_total, sums = ?plan.quality().sums, "job submitted"
            );
        }
        table.insert(entry);
        drop(table);
        self.activate(id, plan, submitter, 0);
        Ok(id)
    }

    /// Draws the failed frames of a job again, and no others.
    fn retry(&mut self, id: JobId, plan: Plan) {
        let frames = self.jobs.lock().reopen(id);
        info!(job = %id, frames, "failed frames are drawn again");
        if self.active.contains(id) {
            self.refresh_states();
        } else {
            let submitter = self.jobs.lock().get(id).map(|job| job.submitter);
            self.activate(id, plan, submitter.unwrap_or(Submitter::Batch(None)), u64::MAX);
        }
        self.jobs.ring();
    }

    /// Makes a job active: its frames from number `next` on are drawn, and those that are wanted
    /// again.
    fn activate(&mut self, id: JobId, plan: Plan, submitter: Submitter, next: u64) {
        let bricks = match self.brick_sets.covering(plan.volume(), &plan.wanted) {
            Some(store) => store.needs().clone(),
            None => plan.wanted.clone(),
        };
        let mut job = plan.activate(id, bricks);
        job.next = next.min(job.views.len());
        self.active.insert(id, job, submitter);
        self.refresh_states();
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
            self.land(frame);
            self.scheduler.handle(&self.clock, Happened::CancelFrame { frame });
        }
        // In this order: a watcher ends at what it finds of a job that is retired.
        self.jobs.lock().set_state(id, state);
        self.deactivate(id);
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
            let state = if self.brick_sets.get(active.scene.bricks).is_none() {
                JobState::Preparing
            } else if workers == 0 {
                JobState::WaitingForWorkers
            } else if active.begun > 0 {
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
