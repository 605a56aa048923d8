//! Which frame is begun next, and which brick set is cut.
//!
//! Frames take memory from their beginning until a watcher has them. Two rules bound it, whatever
//! jobs are open and whoever watches:
//!
//! 1. Frames in the making, and those that a watcher has in hand, take at most the budget of
//!    flights ([`Shares::flights`]). One alone may take more: else it could never be drawn.
//! 2. Frames that no watcher waits for are drawn ahead until the untaken ones fill half of the
//!    budget of frames. One alone may take more.
//!
//! So a frame that a watcher waits for needs no memory that untaken frames hold, and goes on
//! however many of those there are. A large frame could still wait for ever while small ones slip
//! past it; one that has waited for [`HOLDS_BACK`] lets no other frame begin before it.

use super::{Driver, Event, Flight};
use crate::hooks::Stage;
use crate::jobs::active::Candidate;
use crate::memory::{Shares, brick_set_bytes, making_bytes};
use crate::panics::{Panicked, caught};
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{FrameId, JobId};
use slabcast_common::link::FRAMES_IN_FLIGHT;
use slabcast_schedule::{Clock, Event as Happened, FrameJob, Micros};
use slabcast_volumes::BrickStore;
use std::sync::Arc;
use tracing::{info, warn};

/// Microseconds after which a frame that a watcher waits for, and that finds no memory, holds back
/// all others. A frame of 1024x1024 takes 0.1 s.
const HOLDS_BACK: Micros = 1_000_000;

/// Microseconds after which the driver looks again while something waits for memory that time alone
/// sets free.
const LOOKS_AGAIN: Micros = 200_000;

/// Memory of frames, as the rules at the head of the file see it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Room {
    /// Bytes of frames in the making.
    making: u64,
    /// Bytes that those which nobody waits for will have when they are finished.
    ahead: u64,
    /// Bytes of finished frames that nobody has taken.
    untaken: u64,
    /// Bytes of frames that watchers hold.
    in_hand: u64,
}

impl Room {
    /// Whether a frame that takes `making` bytes while it is made, and `finished` bytes then, may
    /// begin.
    fn has(&self, shares: &Shares, wanted: bool, making: u64, finished: u64) -> bool {
        let flies = self.making + self.in_hand + making <= shares.flights
            || (self.making == 0 && self.in_hand <= shares.flights / 2);
        let untaken = self.untaken + self.ahead;
        let ahead = untaken + finished <= shares.frames / 2 || untaken == 0;
        flies && (wanted || ahead)
    }
}

/// A frame that waits for memory, and since when.
pub(super) type Blocked = (JobId, u64, Micros);

impl Driver {
    /// Gives the scheduler frames while there is room for them.
    pub(super) fn feed(&mut self) {
        self.look_again_at = None;
        while self.flights.len() < FRAMES_IN_FLIGHT {
            let Some(candidate) = self.pick() else { break };
            if !self.begin(candidate) {
                break;
            }
        }
        self.cut_next();
    }

    fn candidates(&self) -> Vec<Candidate> {
        let flights = &self.flights;
        let is_in_flight =
            |job, number| flights.values().any(|f| f.job == job && f.number == number);
        self.active.candidates(&self.jobs.lock(), is_in_flight)
    }

    fn room(&self) -> Room {
        let table = self.jobs.lock();
        Room {
            making: self.flights.values().map(|f| f.making_bytes).sum(),
            ahead: self.flights.values().filter(|f| !f.wanted).map(|f| f.finished_bytes).sum(),
            untaken: table.untaken_bytes() as u64,
            in_hand: table.in_hand_bytes() as u64,
        }
    }

    /// Returns the memory of a frame in bytes, while it is rendered and when it is finished.
    fn bytes_of(&self, candidate: &Candidate) -> (u64, u64) {
        let Some(job) = self.active.get(candidate.job) else { return (0, 0) };
        let [w, h] = job.request.path.size.map(u64::from);
        (making_bytes(&job.request), w * h * job.request.format.bytes() as u64)
    }

    /// Whether there is room for a frame.
    fn has_room(&self, room: &Room, candidate: &Candidate) -> bool {
        let (making, finished) = self.bytes_of(candidate);
        room.has(&self.shares, candidate.wanted, making, finished)
    }

    /// The frame that begins next.
    fn pick(&mut self) -> Option<Candidate> {
        let now = self.clock.now();
        let room = self.room();
        let mut first_blocked = None;
        let mut picked = None;
        for candidate in self.candidates() {
            let Some(job) = self.active.get(candidate.job) else { continue };
            if self.brick_sets.get(job.scene.bricks).is_none() {
                continue;
            }
            if self.has_room(&room, &candidate) {
                picked = Some(candidate);
                break;
            }
            if candidate.wanted && first_blocked.is_none() {
                first_blocked = Some((candidate.job, candidate.number));
            }
        }
        self.blocked = first_blocked.map(|(job, number)| match self.blocked {
            Some(before @ (j, n, _)) if (j, n) == (job, number) => before,
            _ => (job, number, now),
        });
        let Some((_, _, since)) = self.blocked else { return picked };
        self.look_again_at = Some(now + LOOKS_AGAIN);
        picked.filter(|_| now < since + HOLDS_BACK)
    }

    /// Fails a frame whose camera has no meaning.
    fn no_view(&mut self, id: JobId, number: u64, reason: &str) {
        warn!(job = %id, frame = number, reason, "frame failed: its camera has no meaning");
        if self.jobs.lock().fail_frame(id, number, reason.to_string()) {
            self.retire();
        }
        self.jobs.ring();
        self.refresh_states();
    }

    /// Begins a frame, or fails it. Returns false if neither can be done now.
    fn begin(&mut self, candidate: Candidate) -> bool {
        let Candidate { job: id, number, wanted } = candidate;
        let (making_bytes, finished_bytes) = self.bytes_of(&candidate);
        let Some(job) = self.active.get_mut(id) else { return false };
        let view = match job.views.view(number, &self.served.info) {
            Ok(view) => view,
            Err(e) => {
                self.no_view(id, number, &e.to_string());
                return true;
            }
        };
        let Some(store) = self.brick_sets.get(job.scene.bricks).cloned() else { return false };
        // All before a frame that is drawn ahead have ended or are in flight.
        if number == job.next || (!wanted && number > job.next) {
            job.next = number + 1;
        }
        let Some(job) = self.active.begun(id, making_bytes) else { return false };
        self.jobs.lock().begins(id, number);
        // Frames that were taken make place for this one.
        let making: u64 = self.flights.values().map(|f| f.making_bytes).sum();
        let kept = self.shares.frames.saturating_sub(making + making_bytes);
        self.jobs.lock().evict(kept as usize, None);
        self.last_frame_id += 1;
        let frame = FrameId(self.last_frame_id);
        let frame_span = tracing::info_span!("frame", job = %id, number, id = %frame);
        let scene = job.scene_of(number, frame);
        let flight = Flight {
            job: id,
            number,
            scene: scene.clone(),
            view,
            store: store.clone(),
            wanted,
            making_bytes,
            finished_bytes,
            frame_span,
            slab_span: None,
            assembly: None,
        };
        self.flights.insert(frame, flight);
        let own_scene = job.tween.is_some().then_some(scene.id);
        let queued = FrameJob {
            frame,
            number,
            scene,
            bricks: store.infos().clone(),
            view,
            work: job.request.work,
            finish: (!job.request.want_hash).then(|| job.request.encoding()),
        };
        self.brick_sets.used(store.key());
        self.scheduler.handle(&self.clock, Happened::FrameQueued(Box::new(queued)));
        if let Some(scene) = own_scene {
            // It ends with its frame.
            self.scheduler.handle(&self.clock, Happened::SceneEnded { scene });
        }
        true
    }

    /// Has the brick set cut that the first job lacks whose frame could begin. A set that a job
    /// needs makes place for it only if no job before it has its own: else sets would be cut and
    /// dropped while others draw.
    fn cut_next(&mut self) {
        if self.brick_sets.is_cutting() {
            return;
        }
        let room = self.room();
        let able = self.candidates().into_iter().filter(|c| self.has_room(&room, c));
        let mut comes_first = true;
        let lacking = able.filter_map(|c| self.active.get(c.job)).find(|job| {
            let lacks = self.brick_sets.get(job.scene.bricks).is_none();
            comes_first &= lacks;
            lacks
        });
        let Some(job) = lacking else { return };
        let (key, needs, now) = (job.scene.bricks, job.bricks.clone(), self.clock.now());
        let flights = &self.flights;
        let in_flight = |key| flights.values().any(|f| f.store.key() == key);
        let table = self.jobs.lock();
        let is_needed = |key| self.active.open_need(&table, key);
        let stays = |key| in_flight(key) || (!comes_first && is_needed(key));
        let bytes = brick_set_bytes(&self.volume, &needs);
        let begins = self.brick_sets.begin_cut(key, bytes, now, stays, is_needed);
        drop(table);
        if !begins && comes_first {
            self.look_again_at.get_or_insert(now + LOOKS_AGAIN);
        }
        if !begins {
            return;
        }
        let (volume, digest) = (self.volume.clone(), self.served.info.digest);
        let (inbox, hooks) = (self.inbox.clone(), self.hooks.clone());
        let cut = move || {
            let store = caught("cutting bricks", || {
                hooks.reach(Stage::CutBricks);
                Arc::new(BrickStore::build(&volume, digest, &needs))
            });
            let _ = inbox.blocking_send(Event::BricksCut { set: key, store });
        };
        let thread = std::thread::Builder::new().name("slabcast-bricks".into());
        if let Err(e) = thread.spawn(cut) {
            self.no_bricks(key, &format!("no thread to cut bricks: {e}"));
        }
    }

    pub(super) fn bricks_cut(
        &mut self,
        set: BrickSetKey,
        store: Result<Arc<BrickStore>, Panicked>,
    ) {
        match store {
            Ok(store) => {
                let (bricks, bytes) = (store.infos().len(), store.bytes());
                info!(set = %set.0, bricks, bytes, "bricks cut");
                self.brick_sets.cut(store, self.clock.now());
                self.refresh_states();
            }
            Err(panicked) => self.no_bricks(set, &panicked.to_string()),
        }
    }

    /// Fails the jobs whose set can't be cut.
    fn no_bricks(&mut self, set: BrickSetKey, reason: &str) {
        self.brick_sets.cut_failed();
        let hit = |id: &JobId| self.active.get(*id).is_some_and(|job| job.scene.bricks == set);
        let jobs: Vec<JobId> = self.active.ids().filter(hit).collect();
        for job in jobs {
            self.fail_job(job, reason.to_string());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHARES: Shares =
        Shares { frames: 100, flights: 100, largest_frame: None, bricks: 0, requests: 0 };

    #[test]
    fn frame_that_is_waited_for_needs_no_memory_of_untaken_frames() {
        let full = Room { untaken: 1000, ..Room::default() };
        assert!(full.has(&SHARES, true, 30, 10) && !full.has(&SHARES, false, 30, 10));
        let half = Room { untaken: 30, ahead: 10, ..Room::default() };
        assert!(half.has(&SHARES, false, 30, 10) && !half.has(&SHARES, false, 30, 11));
    }

    #[test]
    fn frames_in_the_making_share_one_budget_and_one_alone_may_be_larger() {
        let one = Room { making: 60, ..Room::default() };
        assert!(one.has(&SHARES, true, 40, 1) && !one.has(&SHARES, true, 41, 1));
        let none = Room::default();
        assert!(none.has(&SHARES, true, 1 << 40, 1) && none.has(&SHARES, false, 1 << 40, 1 << 40));
        let held = Room { in_hand: 51, ..Room::default() };
        assert!(!held.has(&SHARES, true, 1 << 40, 1), "what watchers hold counts");
    }
}
