//! Incidents, scripted or at random: deaths, partitions, lies.

use super::{HeldBricks, VirtualCluster};
use crate::config::WorkerProfile;
use crate::model::{TaskOutput, TileModel};
use crate::outcome::Observer;
use slabcast_common::ids::{FrameId, SceneId, WorkerId};
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Pixels, RegionSplit};
use slabcast_schedule::{Event, FrameJob, Micros};

/// An incident that is arranged with [`VirtualCluster::schedule`].
#[derive(Clone, Debug)]
pub enum Incident {
    /// A worker joins.
    Join(Box<WorkerProfile>),
    /// The process of a dead worker comes back with the bricks it held.
    Rejoin(Box<WorkerProfile>, HeldBricks),
    /// A worker dies, and its link closes.
    Kill(WorkerId),
    /// Nothing passes to or from a worker for so many microseconds; then all that was held back
    /// arrives.
    Partition(WorkerId, Micros),
    /// A worker leaves: it ends the tasks it has begun and closes its link.
    Leave(WorkerId),
    /// A worker's tasks take this many times as long from now on.
    Slow(WorkerId, f64),
    /// A frame is queued.
    Queue(Box<FrameJob>),
    /// A frame is cancelled.
    Cancel(FrameId),
    /// A scene has no more frames.
    EndScene(SceneId),
    /// Nothing happens, at a moment at which something has to.
    Nothing,
}

impl Incident {
    /// The worker that it befalls.
    fn victim(&self) -> Option<WorkerId> {
        match self {
            Incident::Kill(id)
            | Incident::Partition(id, _)
            | Incident::Leave(id)
            | Incident::Slow(id, _) => Some(*id),
            _ => None,
        }
    }
}

impl<M: TileModel, O: Observer> VirtualCluster<M, O> {
    /// Returns whether incidents are arranged that may bring work or workers.
    pub fn has_incidents(&self) -> bool {
        self.occurrences.values().any(|o| match o {
            super::Occurrence::Incident(i) => !matches!(**i, Incident::Kill(_) | Incident::Nothing),
            _ => false,
        })
    }

    /// Returns the bricks that a worker holds.
    pub fn held_bricks(&self, id: WorkerId) -> HeldBricks {
        let Some(w) = self.workers.get(&id) else { return Vec::new() };
        let held = w.present.iter().map(|(set, present)| {
            let here = self.sets[set].iter().zip(present).filter(|(_, here)| **here);
            (*set, here.map(|(b, _)| b.id).collect::<Vec<_>>())
        });
        held.filter(|(_, bricks)| !bricks.is_empty()).collect()
    }

    /// Kills a worker at once; nothing happens if it is not there.
    pub fn kill(&mut self, id: WorkerId) {
        if self.workers.remove(&id).is_some() && !self.dropped.contains(&id) {
            self.inbox.push(Event::WorkerLost { worker: id, reason: "killed".into() });
            self.settle();
        }
    }

    pub(super) fn follow(&mut self, incident: Incident) {
        let victim = incident.victim().and_then(|id| self.workers.get_mut(&id));
        if victim.as_ref().is_some_and(|w| w.profile.faults.immune) {
            return;
        }
        match incident {
            Incident::Join(profile) => {
                self.join(*profile);
            }
            Incident::Rejoin(profile, held) => {
                self.join_with(*profile, held);
            }
            Incident::Kill(id) => {
                if self.workers.remove(&id).is_some() && !self.dropped.contains(&id) {
                    self.inbox.push(Event::WorkerLost { worker: id, reason: "killed".into() });
                }
            }
            Incident::Partition(_, us) => {
                let until = self.clock.0.get() + us.saturating_mul(1000);
                if let Some(w) = victim {
                    w.partitioned_until = w.partitioned_until.max(until);
                }
            }
            Incident::Leave(id) => {
                if let Some(w) = victim {
                    w.leaving = true;
                    w.loans.clear();
                    self.inbox.push(Event::WorkerLeaving { worker: id });
                    self.close_if_done(id);
                }
            }
            Incident::Slow(id, factor) => {
                if let Some(w) = victim {
                    w.profile.time_factor *= factor;
                    self.slow_runs(id, factor);
                }
            }
            Incident::Queue(job) => self.queue(job),
            Incident::Cancel(frame) => {
                if self.frames.contains_key(&frame) {
                    self.inbox.push(Event::CancelFrame { frame });
                }
            }
            Incident::EndScene(scene) => self.inbox.push(Event::SceneEnded { scene }),
            Incident::Nothing => {}
        }
        self.drive();
    }

    /// Stretches the tasks that a worker's threads draw now by a factor, from now on.
    fn slow_runs(&mut self, id: WorkerId, factor: f64) {
        let now = self.now_ns();
        let w = self.workers.get_mut(&id).expect("it is there");
        for run in w.running.iter_mut().flatten() {
            run.follow(&w.present[&run.loan.set], now);
            run.stretch *= factor;
        }
        self.reschedule_runs(id);
    }

    /// A worker that leaves closes its link when its threads are done and its last message is
    /// there.
    pub(super) fn close_if_done(&mut self, id: WorkerId) {
        let Some(w) = self.workers.get(&id) else { return };
        if w.leaving && w.running.iter().all(Option::is_none) {
            let when = w.up_arrives.max(w.partitioned_until) + 1_000;
            self.later(when, super::Occurrence::Incident(Box::new(Incident::Kill(id))));
        }
    }

    /// Makes one result in `one_in` malformed; 0: none.
    pub(super) fn lie(&mut self, output: &mut TaskOutput, job: &FrameJob, one_in: u64) {
        if one_in == 0 {
            return;
        }
        if self.rng.one_in(4 * one_in) {
            output.touched.push(job.bricks.len() as u32);
        }
        if !self.rng.one_in(one_in) {
            return;
        }
        let lie = self.rng.below(4);
        if let Pixels::Finished(leaves) = &mut output.pixels {
            if lie == 3 {
                leaves.max_alpha = f32::NAN;
                return;
            }
            // Malformed sums instead.
            let n = leaves.pixels();
            let (a, colour) = (vec![0.0; n], vec![[0; 3]; n]);
            output.pixels = Pixels::Sums(TilePixels { a, colour, last: None });
        }
        if let Pixels::Sums(sums) = &mut output.pixels {
            match lie {
                0 => sums.a.truncate(3),
                1 => sums.colour.push([1; 3]),
                2 => sums.last = Some(vec![[1; 4]; 2]),
                _ => sums.a[0] = f32::NAN,
            }
        }
    }

    /// Makes a handed-over piece of a liar malformed now and then.
    pub(super) fn lie_about_piece(&mut self, id: WorkerId, piece: &mut RegionSplit) {
        let one_in = self.workers[&id].profile.faults.lie_one_in;
        if one_in == 0 || !self.rng.one_in(one_in) {
            return;
        }
        match self.rng.below(5) {
            0 => piece.begun.pixels.a.truncate(3),
            1 => piece.begun.pixels.a[0] = f32::INFINITY,
            2 => piece.begun.sheets.push(None),
            3 => piece.kept = piece.given,
            _ => piece.given.x0 += 1,
        }
    }
}
