//! Carrying out the scheduler's actions, up to finished frames.

use super::{Driver, Flight};
use crate::finish::{Assembly, FrameSums};
use crate::finishers::FinishTask;
use crate::jobs::{FinishedFrame, JobState};
use crate::link::{BrickOrder, Losses};
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{BrickId, Epoch, FrameId, JobId, TaskId, WorkerId};
use slabcast_common::image::{FrameState, SparseTile};
use slabcast_common::message::{ToWorker, is_live};
use slabcast_common::occlusion::Rect;
use slabcast_common::stats::{FrameStats, PoisonedTile};
use slabcast_schedule::{Action, Event as Happened, Micros, Spans, WorkerIdentity};
use std::sync::Arc;
use tracing::{debug, info, warn};

impl Driver {
    /// Tells the scheduler that bricks it had sent are not there: as if they had come and been
    /// forgotten.
    fn bricks_did_not_leave(&mut self, worker: WorkerId, set: BrickSetKey, bricks: Vec<BrickId>) {
        let came = Happened::BricksIn { worker, set, bricks: bricks.len() as u32 };
        self.scheduler.handle(&self.clock, came);
        let gone = Happened::BricksForgotten { worker, set, bricks };
        self.scheduler.handle(&self.clock, gone);
    }

    /// Fails the jobs of a set of which bricks can't be read any more.
    pub(super) fn bricks_lost(
        &mut self,
        worker: WorkerId,
        set: BrickSetKey,
        bricks: Vec<BrickId>,
        reason: &str,
    ) {
        warn!(%worker, set = %set.0, reason, "bricks can't be read");
        self.bricks_did_not_leave(worker, set, bricks);
        let mut jobs = self.active.ids().filter_map(|id| self.active.get(id));
        let volume = jobs.find(|job| job.scene.bricks == set).map(|job| job.scene.volume.digest);
        drop(jobs);
        if let Some(digest) = volume {
            self.library.close(digest);
        }
        self.brick_sets.forget(set);
        self.fail_jobs_of(set, reason);
    }

    pub(super) fn act(&mut self) {
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
                    let Some(link) = self.workers.link(worker) else { continue };
                    if let Some(store) = self.brick_sets.get(set).cloned() {
                        debug!(%worker, bricks = bricks.len(), "bricks sent");
                        let losses = Losses::new(self.inbox.clone(), worker, set);
                        let _ = link.bricks.send(BrickOrder::Send { set, store, bricks, losses });
                    } else {
                        // A worker asked for bricks of a frame that ended, and their set has made
                        // place for another: as if they had come and been forgotten.
                        self.bricks_did_not_leave(worker, set, bricks);
                    }
                }
                Action::Drop { worker, reason } => {
                    self.workers.note_error(worker, &format!("it was dropped: {reason}"));
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
                Action::FrameFailed { frame, reason, tile } => {
                    self.give_up_frame(frame, reason, &tile);
                }
                Action::ShutOut { worker, identity, frame, tile } => {
                    self.shut_out(worker, identity, frame, tile);
                }
                Action::FrameTainted { frame } => {
                    // It is drawn again as if it had been dropped.
                    let Some(Flight { job, number, .. }) = self.land(frame) else {
                        continue;
                    };
                    self.jobs.lock().draw_again(job, number);
                }
                Action::Paused { worker, failures, pause_us } => {
                    let Some(who) = self.workers.who(worker) else { continue };
                    warn!(
                        worker = who.name, identity = %who.identity, address = who.address,
                        failures, pause_ms = pause_us / 1000,
                        "worker fails again and again: it is lent nothing for a while"
                    );
                    self.tell_pause(worker, pause_us);
                }
            }
        }
    }

    /// Tells the clients of a job that a worker refused a tile of it.
    pub(super) fn note_refusal(&mut self, id: WorkerId, lease: (TaskId, Epoch), reason: &str) {
        let Some((frame, tile)) = self.scheduler.leased(id, lease.0, lease.1) else { return };
        let Some(Flight { job, number, .. }) = self.flights.get(&frame) else { return };
        let worker =
            self.workers.who(id).map_or_else(|| id.to_string(), |who| who.name.to_string());
        let refusal = format!(
            "waiting: worker {worker} refused tile {},{} of frame {number}: {}",
            tile.x0,
            tile.y0,
            reason.replace(char::is_control, " ")
        );
        let said = format!("{refusal}; it is tried again");
        let job = *job;
        self.refusals.insert(id, (job, refusal));
        self.jobs.lock().update(job, |view| view.trouble = Some(said));
        self.jobs.ring_tile();
    }

    /// Tells the clients of a job how long the worker pauses that refused a tile of it.
    fn tell_pause(&mut self, id: WorkerId, pause_us: Micros) {
        let Some((job, refusal)) = self.refusals.get(&id) else { return };
        let said = format!("{refusal}; it is asked again in {:.2} s", pause_us as f64 / 1e6);
        self.jobs.lock().update(*job, |view| view.trouble = Some(said));
    }

    pub(super) fn progress(&mut self, frame: FrameId, tiles: (u32, u32), slab: (u32, u32)) {
        let Some(flight) = self.flights.get_mut(&frame) else { return };
        if flight.slab_span.as_ref().is_none_or(|(s, _)| *s != slab.0) {
            let span = tracing::info_span!(parent: &flight.frame_span, "slab", slab = slab.0);
            flight.slab_span = Some((slab.0, span));
        }
        if let Some((_, span)) = &flight.slab_span {
            span.in_scope(|| debug!(done = tiles.0, total = tiles.1, "tiles"));
        }
        self.jobs.lock().update(flight.job, |view| {
            // A refusal is reported as progress, too.
            if tiles.0 > 0 && (tiles != view.tiles || slab != view.slab) {
                view.trouble = None;
            }
            view.tiles = tiles;
            view.slab = slab;
        });
        self.jobs.ring_tile();
    }

    /// Has finished tiles composed into their frame's picture while others are drawn.
    pub(super) fn compose(&mut self, frame: FrameId, tiles: Vec<(Rect, SparseTile)>) {
        // A rehearsed frame has no pixels.
        let Some(flight) = self.flights.get_mut(&frame).filter(|_| !self.rehearse) else { return };
        let Some(job) = self.active.get(flight.job) else { return };
        let assembly = flight.assembly.get_or_insert_with(|| {
            let (size, finish) = (flight.view.size, job.request.encoding());
            Arc::new(Assembly::new(size, finish, job.tiles.clone()))
        });
        assembly.add(tiles);
        let task = FinishTask::Compose(frame, assembly.clone());
        self.push(frame, task);
    }

    /// Hands a rendered frame to a finisher.
    pub(super) fn finish(
        &mut self,
        frame: FrameId,
        state: Box<FrameState>,
        stats: Box<FrameStats>,
        spans: Spans,
    ) {
        let Some(flight) = self.flights.get_mut(&frame) else { return };
        let ms: f64 = stats.workers.iter().map(|w| w.render_ms).sum();
        flight.took_us = Some((1e3 * ms) as u64);
        let Some(job) = self.active.get(flight.job) else {
            self.land(frame);
            return;
        };
        let sums = Box::new(FrameSums {
            job: flight.job,
            frame,
            request: job.request.clone(),
            scene: flight.scene.clone(),
            view: flight.view,
            state,
            assembly: flight.assembly.clone(),
            stats,
            spans,
            store: Some(flight.store.clone()),
            rehearsed: self.rehearse,
        });
        self.push(frame, FinishTask::Finish(sums));
    }

    pub(super) fn push(&mut self, frame: FrameId, task: FinishTask) {
        if let Err(ended) = self.finishers.push(task) {
            self.fail_frame(frame, &ended.to_string());
        }
    }

    /// Closes the link of a worker that drew false pixels, and shuts it out.
    fn shut_out(&mut self, id: WorkerId, identity: WorkerIdentity, frame: FrameId, tile: Rect) {
        let who = self.workers.who(id);
        let (worker, address) = who.map_or_else(
            || (identity.name.clone(), String::new()),
            |who| (who.name.to_string(), who.address.to_string()),
        );
        let (job, number) = self.flights.get(&frame).map(|f| (f.job, f.number)).unzip();
        let shown = identity.to_string();
        let shut_out = self.workers.shut_out(id, identity);
        warn!(
            worker,
            identity = shown,
            address,
            job = job.map(tracing::field::display),
            frame = number,
            tile = format!("{},{}", tile.x0, tile.y0),
            shut_out_secs = shut_out.as_secs(),
            "worker drew other pixels than others did: it is shut out, and frames with its tiles are \
             drawn again"
        );
        self.refresh_states();
    }

    /// Fails a frame of which no worker could draw a tile; its job goes on with the others.
    fn give_up_frame(&mut self, frame: FrameId, reason: String, tile: &PoisonedTile) {
        let Some(Flight { job, number, .. }) = self.land(frame) else { return };
        let PoisonedTile { slab, x, y, size, workers } = tile;
        warn!(
            %job, frame = number, slab, tile = format!("{x},{y}"), size,
            workers = workers.join(", "), reason, "frame failed: a tile of it was given up"
        );
        let is_over = self.jobs.lock().fail_frame(job, number, reason);
        if is_over {
            warn!(%job, "job is over, and frames of it failed");
            self.retire();
        }
        self.jobs.ring();
        self.refresh_states();
    }

    pub(super) fn finished(&mut self, id: JobId, flight: FrameId, frame: FinishedFrame) {
        // A frame of a job that has ended meanwhile is nobody's.
        let Some(flight) = self.land(flight) else { return };
        flight.frame_span.in_scope(|| {
            let FrameStats { ms, pixels_sha256, .. } = &frame.stats;
            // Sixty a second of a session.
            if is_live(flight.client) {
                debug!(ms = ms.total, "live frame done");
            } else {
                info!(ms = ms.total, pixels_sha256, "frame done");
            }
        });
        self.log_reserve();
        let number = frame.number;
        let mut table = self.jobs.lock();
        let is_over = table.put(id, frame);
        let state = table.get(id).map(|job| job.view.state.clone());
        table.evict(self.shares.frames as usize, Some((id, number)));
        drop(table);
        if is_over {
            match state {
                Some(JobState::Incomplete(_)) => {
                    warn!(job = %id, "job is over, and frames of it failed");
                }
                _ if is_live(flight.client) => {}
                _ => info!(job = %id, "job done"),
            }
            self.retire();
        }
        self.jobs.ring();
        self.refresh_states();
    }
}
