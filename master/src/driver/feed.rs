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
//!
//! Frames may take minutes, and no address is to wait for another's. So each may have one frame in
//! flight whatever others have ([`Driver::may_fly`]), and where the budget of flights is full or held
//! back, that one frame begins in a reserve beside it, a quarter as large.

use super::{Driver, Event, Flight};
use crate::hooks::Stage;
use crate::jobs::active::Candidate;
use crate::library::VolumeError;
use crate::memory::{Shares, brick_set_bytes, making_bytes};
use crate::panics::caught;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{FrameId, JobId};
use slabcast_common::link::{FRAMES_IN_FLIGHT, MOST_FRAMES_IN_FLIGHT, MOST_LIVE_FRAMES};
use slabcast_common::message::is_live;
use slabcast_common::quality::Schedule;
use slabcast_schedule::{Clock, Event as Happened, FrameJob, Micros};
use slabcast_volumes::BrickStore;
use std::sync::Arc;
use tracing::{info, warn};

/// Microseconds after which a frame that a watcher waits for, and that finds no memory, holds back
/// all others. A frame of 1024x1024 takes 0.1 s.
const HOLDS_BACK: Micros = 1_000_000;

/// The reserve is the budget of flights divided by this. With a sixteenth, a master of 2 GiB could not
/// take a frame of 2048x2048. It comes on top of the memory that the master may hold, so it
/// is no larger.
const RESERVE_DIVISOR: u64 = 4;

/// Microseconds after which the driver looks again while something waits for memory that time alone
/// sets free.
const LOOKS_AGAIN: Micros = 200_000;

/// Memory of frames, as the rules at the head of the file see it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Room {
    /// Bytes of frames in the making, but for those in the reserve.
    making: u64,
    /// Bytes of frames in the making that are in the reserve.
    reserved: u64,
    /// Bytes that those which nobody waits for will have when they are finished.
    ahead: u64,
    /// Bytes of finished frames that nobody has taken.
    untaken: u64,
    /// Bytes of frames that watchers hold.
    in_hand: u64,
}

/// Budgets that have room for a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Places {
    /// The budget of flights has room.
    main: bool,
    /// The reserve has room, and the address has no other frame in flight.
    reserve: bool,
}

impl Room {
    /// Returns the budgets that have room for a frame of `making` bytes while it is rendered and
    /// `finished` bytes afterwards. `wanted`: a watcher waits for the frame. `is_only`: its address has
    /// no other frame in flight.
    fn places(
        &self,
        shares: &Shares,
        (wanted, is_only): (bool, bool),
        making: u64,
        finished: u64,
    ) -> Places {
        let untaken = self.untaken + self.ahead;
        let ahead = untaken + finished <= shares.frames / 2 || untaken == 0;
        if !wanted && !ahead {
            return Places::default();
        }
        let main = self.making + self.in_hand + making <= shares.flights
            || (self.making == 0 && self.in_hand <= shares.flights / 2);
        let reserve = is_only && self.reserved + making <= shares.flights / RESERVE_DIVISOR;
        Places { main, reserve }
    }
}

/// A frame that waits for memory, and since when.
pub(super) type Blocked = (JobId, u64, Micros);

impl Driver {
    /// Gives the scheduler frames while there is room for them.
    pub(super) fn feed(&mut self) {
        self.look_again_at = None;
        self.make_way();
        while self.flights.len() < MOST_FRAMES_IN_FLIGHT + MOST_LIVE_FRAMES {
            let Some((candidate, in_reserve)) = self.pick() else { break };
            if !self.begin(candidate, in_reserve) {
                break;
            }
        }
        self.cut_next();
    }

    /// Removes a frame from those in flight and charges its client with the thread time it took.
    /// Returns `None` if the frame is not in flight.
    pub(super) fn land(&mut self, frame: FrameId) -> Option<Flight> {
        let flight = self.flights.remove(&frame)?;
        let took_us = flight.took_us.or_else(|| self.scheduler.rendered_us(frame)).unwrap_or(0);
        self.active.ended(flight.job, flight.making_bytes, took_us);
        Some(flight)
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
            making: self.making_bytes(false),
            reserved: self.making_bytes(true),
            ahead: self.flights.values().filter(|f| !f.wanted).map(|f| f.finished_bytes).sum(),
            untaken: table.untaken_bytes() as u64,
            in_hand: table.in_hand_bytes() as u64,
        }
    }

    /// Bytes of the frames in flight that are in the reserve, or of all others.
    fn making_bytes(&self, in_reserve: bool) -> u64 {
        let flights = self.flights.values().filter(|f| f.in_reserve == in_reserve);
        flights.map(|f| f.making_bytes).sum()
    }

    /// Returns the memory of a frame in bytes, while it is rendered and when it is finished.
    fn bytes_of(&self, candidate: &Candidate) -> (u64, u64) {
        let Some(job) = self.active.get(candidate.job) else { return (0, 0) };
        let [w, h] = job.request.path.size.map(u64::from);
        (making_bytes(&job.request), w * h * job.request.format.bytes() as u64)
    }

    /// Returns the budgets that have room for a candidate.
    fn places(&self, room: &Room, candidate: &Candidate) -> Places {
        let (making, finished) = self.bytes_of(candidate);
        let client = self.active.client_of(candidate.job);
        let is_only = self.flights.values().all(|f| f.client != client);
        room.places(&self.shares, (candidate.wanted, is_only), making, finished)
    }

    /// Whether a job of another address is in progress.
    fn others_are_open(&self, client: u64) -> bool {
        let table = self.jobs.lock();
        let is_open = |id: &JobId| table.get(*id).is_some_and(|job| !job.view.state.is_over());
        self.active.ids().any(|id| self.active.client_of(id) != client && is_open(&id))
    }

    /// Takes back frames of the `slab` schedule while another address has a job: no other frame can be
    /// drawn beside them. They are drawn again by `region` ([`Driver::begin`]), to the same pixels.
    fn make_way(&mut self) {
        let is_in_the_way = |f: &Flight| f.is_slab && self.others_are_open(f.client);
        let flights = self.flights.iter().filter(|(_, f)| is_in_the_way(f));
        let frames: Vec<FrameId> = flights.map(|(frame, _)| *frame).collect();
        for frame in frames {
            let Some(Flight { job, number, .. }) = self.land(frame) else { continue };
            info!(%job, frame = number, "drawn by regions, since others have jobs");
            self.scheduler.handle(&self.clock, Happened::CancelFrame { frame });
            self.jobs.lock().draw_again(job, number);
        }
    }

    /// Whether a frame may begin beside those in flight, so that no address keeps others waiting. An
    /// address without a frame in flight may begin one while fewer than [`MOST_FRAMES_IN_FLIGHT`] fly.
    /// Another needs fewer than [`FRAMES_IN_FLIGHT`], and all its frames must have one brick set.
    fn may_fly(&self, candidate: &Candidate) -> bool {
        let Some(job) = self.active.get(candidate.job) else { return false };
        let client = self.active.client_of(candidate.job);
        let mut own = self.flights.values().filter(|f| f.client == client).peekable();
        if own.peek().is_none() {
            // Sessions have at most one each, and what they wait for is drawn first.
            let of_jobs = self.flights.values().filter(|f| !is_live(f.client)).count();
            return is_live(client) || of_jobs < MOST_FRAMES_IN_FLIGHT;
        }
        self.flights.len() < FRAMES_IN_FLIGHT && own.all(|f| f.scene.bricks == job.scene.bricks)
    }

    /// Returns the frame to begin next, and whether it begins in the reserve.
    fn pick(&mut self) -> Option<(Candidate, bool)> {
        let now = self.clock.now();
        let room = self.room();
        let mut first_blocked = None;
        let (mut picked, mut spare) = (None, None);
        for candidate in self.candidates() {
            let Some(job) = self.active.get(candidate.job) else { continue };
            if self.brick_sets.get(job.scene.bricks).is_none() || !self.may_fly(&candidate) {
                continue;
            }
            let Places { main, reserve } = self.places(&room, &candidate);
            if reserve {
                spare.get_or_insert((candidate, true));
            }
            if main {
                picked = Some((candidate, false));
                break;
            }
            if candidate.wanted && !reserve && first_blocked.is_none() {
                first_blocked = Some((candidate.job, candidate.number));
            }
        }
        self.blocked = first_blocked.map(|(job, number)| match self.blocked {
            Some(before @ (j, n, _)) if (j, n) == (job, number) => before,
            _ => (job, number, now),
        });
        let Some((_, _, since)) = self.blocked else { return picked.or(spare) };
        self.look_again_at = Some(now + LOOKS_AGAIN);
        picked.filter(|_| now < since + HOLDS_BACK).or(spare)
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
    fn begin(&mut self, candidate: Candidate, in_reserve: bool) -> bool {
        let Candidate { job: id, number, wanted } = candidate;
        let (making_bytes, finished_bytes) = self.bytes_of(&candidate);
        let Some(job) = self.active.get_mut(id) else { return false };
        let view = match job.views.view(number, &job.scene.volume) {
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
        let is_first = job.begun == 0;
        self.active.begun(id, making_bytes);
        self.jobs.lock().begins(id, number);
        // Frames that were taken make place for this one.
        let making = self.making_bytes(false) + if in_reserve { 0 } else { making_bytes };
        let kept = self.shares.frames.saturating_sub(making);
        self.jobs.lock().evict(kept as usize, None);
        self.last_frame_id += 1;
        let client = self.active.client_of(id);
        let others_are_open = self.others_are_open(client);
        let Some(job) = self.active.get(id) else { return false };
        let is_slab = job.request.work.schedule == Schedule::Slab && !others_are_open;
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
            client,
            in_reserve,
            is_slab,
            making_bytes,
            finished_bytes,
            took_us: None,
            frame_span,
            slab_span: None,
            assembly: None,
        };
        self.flights.insert(frame, flight);
        let own_scene = job.tween.is_some().then_some(scene.id);
        let mut work = job.request.work;
        if work.schedule == Schedule::Slab && !is_slab {
            work.schedule = Schedule::Region;
        }
        let queued = FrameJob {
            frame,
            number,
            scene,
            bricks: store.infos().clone(),
            view,
            work,
            finish: (!job.request.want_hash).then(|| job.request.encoding()),
            client,
        };
        self.brick_sets.used(store.key());
        self.scheduler.handle(&self.clock, Happened::FrameQueued(Box::new(queued)));
        if let Some(scene) = own_scene {
            // It ends with its frame.
            self.scheduler.handle(&self.clock, Happened::SceneEnded { scene });
        }
        if is_first {
            // It is no longer queued.
            self.refresh_states();
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
        let able = self.candidates().into_iter();
        let able = able.filter(|c| self.may_fly(c) && self.places(&room, c) != Places::default());
        let mut comes_first = true;
        let lacking = able.filter_map(|c| self.active.get(c.job)).find(|job| {
            let lacks = self.brick_sets.get(job.scene.bricks).is_none();
            comes_first &= lacks;
            lacks
        });
        let Some(job) = lacking else { return };
        let (key, needs, now) = (job.scene.bricks, job.bricks.clone(), self.clock.now());
        let volume = &job.scene.volume;
        let flights = &self.flights;
        let in_flight = |key| flights.values().any(|f| f.store.key() == key);
        let table = self.jobs.lock();
        let is_needed = |key| self.active.open_need(&table, key);
        let stays = |key| in_flight(key) || (!comes_first && is_needed(key));
        let digest = volume.digest;
        let bytes = brick_set_bytes(volume, &needs).min(self.shares.bricks);
        let begins = self.brick_sets.begin_cut(key, bytes, now, stays, is_needed);
        drop(table);
        if !begins && comes_first {
            self.look_again_at.get_or_insert(now + LOOKS_AGAIN);
        }
        if !begins {
            return;
        }
        let before = self.brick_sets.latest_of(digest);
        let (library, shares) = (self.library.clone(), self.shares);
        let (inbox, hooks) = (self.inbox.clone(), self.hooks.clone());
        let cut = move || {
            let store = caught("cutting bricks", || {
                hooks.reach(Stage::CutBricks);
                // Its samples may have been dropped since the job was submitted.
                let open = library.open_level(digest)?;
                let kept = shares.bricks_kept(&open);
                let store =
                    BrickStore::cut(&open.source, open.level, &needs, before.as_deref(), kept);
                store.map(Arc::new).map_err(|e| VolumeError::NotReadable(e.to_string()))
            });
            let store = store
                .map_err(|panicked| panicked.to_string())
                .and_then(|store| store.map_err(|e: VolumeError| e.to_string()));
            let _ = inbox.blocking_send(Event::BricksCut { set: key, store });
        };
        let thread = std::thread::Builder::new().name("slabcast-bricks".into());
        if let Err(e) = thread.spawn(cut) {
            self.no_bricks(key, &format!("no thread to cut bricks: {e}"));
        }
    }

    pub(super) fn bricks_cut(&mut self, set: BrickSetKey, store: Result<Arc<BrickStore>, String>) {
        match store {
            Ok(store) => {
                let (bricks, bytes) = (store.infos().len(), store.bytes());
                info!(set = %set.0, bricks, bytes, "bricks cut");
                self.brick_sets.cut(store, self.clock.now());
                self.refresh_states();
            }
            Err(reason) => self.no_bricks(set, &reason),
        }
    }

    /// Fails the jobs whose set can't be cut.
    fn no_bricks(&mut self, set: BrickSetKey, reason: &str) {
        self.brick_sets.cut_failed();
        self.fail_jobs_of(set, reason);
    }

    /// Fails the jobs that draw from a set.
    pub(super) fn fail_jobs_of(&mut self, set: BrickSetKey, reason: &str) {
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

    /// Whether there is room in the budget for a frame of an address that has others in flight.
    fn has(room: &Room, wanted: bool, making: u64, finished: u64) -> bool {
        room.places(&SHARES, (wanted, false), making, finished).main
    }

    #[test]
    fn frame_that_is_waited_for_needs_no_memory_of_untaken_frames() {
        let full = Room { untaken: 1000, ..Room::default() };
        assert!(has(&full, true, 30, 10) && !has(&full, false, 30, 10));
        let half = Room { untaken: 30, ahead: 10, ..Room::default() };
        assert!(has(&half, false, 30, 10) && !has(&half, false, 30, 11));
    }

    #[test]
    fn frames_in_the_making_share_one_budget_and_one_alone_may_be_larger() {
        let one = Room { making: 60, ..Room::default() };
        assert!(has(&one, true, 40, 1) && !has(&one, true, 41, 1));
        let none = Room::default();
        assert!(has(&none, true, 1 << 40, 1) && has(&none, false, 1 << 40, 1 << 40));
        let held = Room { in_hand: 51, ..Room::default() };
        assert!(!has(&held, true, 1 << 40, 1), "what watchers hold counts");
    }

    #[test]
    fn address_without_a_frame_in_flight_has_a_reserve_beside_a_full_budget() {
        let full = Room { making: 1 << 40, in_hand: 1 << 40, ..Room::default() };
        let places = |room: &Room, wanted, is_only, making| {
            let Places { main, reserve } = room.places(&SHARES, (wanted, is_only), making, 1);
            (main, reserve)
        };
        assert_eq!(places(&full, true, true, 25), (false, true));
        assert_eq!(places(&full, true, false, 25), (false, false), "it has others");
        assert_eq!(places(&full, true, true, 26), (false, false), "it is larger");
        let used = Room { reserved: 20, ..full };
        assert_eq!(places(&used, true, true, 5), (false, true));
        assert_eq!(places(&used, true, true, 6), (false, false), "others use it");
        // What is in the reserve holds up no frame that is larger than the budget.
        let alone = Room { reserved: 20, ..Room::default() };
        assert_eq!(places(&alone, true, true, 1 << 40), (true, false));
    }
}
