//! The master: its driver, which hands events to the scheduler and carries actions out, and what it
//! does with finished pictures.

use super::links::{FRAME_BYTES, state_bytes};
use super::{BrickOrder, Occurrence, SMALL_BYTES, VirtualCluster};
use crate::Nanos;
use crate::model::TileModel;
use crate::outcome::{Observer, Unpredictable};
use slabcast_common::ids::FrameId;
use slabcast_common::message::{Lease, ToWorker};
use slabcast_schedule::{Action, Clock, Event};
use std::collections::BTreeSet;

/// Work on a picture whose tiles are all there. It takes milliseconds, and work that takes
/// microseconds does not wait for all of it: systems take turns, and a stream sends pieces.
#[derive(Clone, Copy)]
pub(super) enum Chore {
    /// A finisher hashes and encodes it.
    Finish(FrameId),
    /// A stream sends it to the client.
    Send(FrameId),
    /// The client receives it, where all is on one machine.
    Receive,
}

/// Nanoseconds of a chore that are done in one go: three pieces of 64 KiB to send or to receive. It
/// is short beside a tile, and a picture of 1024x1024 takes some hundred such turns to simulate.
const TURN_NS: f64 = 50_000.0;

/// Frames, slabs and leases that the actions of one event begin.
#[derive(Default)]
struct Begun {
    frames: u64,
    slabs: u64,
    leases: u64,
    lease_pixels: u64,
}

impl<M: TileModel, O: Observer> VirtualCluster<M, O> {
    /// Work of the driver, which looks at its inbox again when that is done. Returns when it is.
    fn driver_works(&mut self, ns: f64) -> Nanos {
        let now = self.now_ns();
        let done = self.driver.run(now, ns);
        let done = self.machine.as_mut().map_or(done, |m| m.run(now, ns).max(done));
        self.driver_busy = true;
        self.later(done, Occurrence::DriverFree);
        done
    }

    /// The driver handles everything that lies before it, then carries the actions out.
    pub(super) fn drive(&mut self) {
        if self.driver_busy || self.inbox.is_empty() {
            return;
        }
        let now = self.now_ns();
        let costs = self.master.costs;
        if !std::mem::replace(&mut self.driver_awake, true) {
            // Events that come while it wakes are handled along with the one that woke it.
            self.driver_works(costs.driver_wake_ns);
            return;
        }
        let mut cost = 0.0;
        let mut actions = Vec::new();
        let mut heard = BTreeSet::new();
        for event in std::mem::take(&mut self.inbox) {
            cost += costs.driver_message_ns;
            if let Event::Result { worker, .. } = &event {
                heard.insert(*worker);
            }
            let from = actions.len();
            cost += self.handle(event, &mut actions);
            let done = now + cost as Nanos;
            for action in &actions[from..] {
                if let Action::FrameDone { frame, .. } = action {
                    self.outcome_of(*frame).done = done;
                }
            }
        }
        let is_message = |a: &&Action| matches!(a, Action::Send { .. } | Action::SendBricks { .. });
        cost += costs.driver_message_ns * actions.iter().filter(is_message).count() as f64;
        let done = self.driver_works(cost);
        for action in &actions {
            let (worker, task, epoch) = match action {
                Action::Send { worker, message: ToWorker::Lease(l) } => (*worker, l.task, l.epoch),
                Action::Send { worker, message: ToWorker::Region(l) } => (*worker, l.task, l.epoch),
                _ => continue,
            };
            self.decided.insert((worker, task, epoch), now);
            heard.remove(&worker);
        }
        for id in heard {
            let idle = self.workers.get_mut(&id).map_or(&mut [][..], |w| &mut w.idle);
            idle.iter_mut().for_each(|i| i.heard = i.heard.or(Some(done)));
        }
        let mut written = BTreeSet::new();
        for action in actions {
            let first = match &action {
                Action::Send { worker, .. } => written.insert(*worker),
                _ => false,
            };
            self.carry_out(action, done, first);
        }
    }

    /// Hands an event to the scheduler and takes its actions. Returns what that costs, in
    /// nanoseconds.
    fn handle(&mut self, event: Event, actions: &mut Vec<Action>) -> f64 {
        let costs = self.master.costs;
        let result_pixels = match &event {
            Event::Result { result, .. } => Some(result.pixels.len()),
            _ => None,
        };
        let prefetches = matches!(event, Event::Tick) && self.scheduler.prefetch_is_due();
        let mut cost = match result_pixels {
            Some(pixels) => costs.result.ns(pixels as f64),
            None if prefetches => costs.prefetch_ns,
            None => costs.event_ns,
        };
        self.observer.event(self.now(), &event);
        let before = self.observer.processor_ns();
        self.scheduler.handle(&self.clock, event);
        let from = actions.len();
        while let Some(action) = self.scheduler.next_action() {
            actions.push(action);
        }
        let after = self.observer.processor_ns();
        for action in &actions[from..] {
            self.observer.action(self.clock.now(), action);
        }
        let begun = self.begun_by(&actions[from..]);
        let job = self.current_frame.map(|f| self.frames[&f].job.clone());
        let bricks = job.as_ref().map_or(0, |j| j.bricks.len());
        let [wide, high] = job.as_ref().map_or([0; 2], |j| j.view.size);
        let pixels = f64::from(wide) * f64::from(high);
        // The event that begins a frame or a slab also gives its first leases.
        let is_first = begun.frames > 0 && self.frames_begun == 0;
        self.frames_begun += begun.frames;
        cost += if is_first {
            costs.first_brick_ns * bricks as f64
        } else if begun.frames > 0 {
            costs.frame_brick_ns * bricks as f64
        } else if begun.slabs > 0 {
            costs.slab_brick_ns * bricks as f64 + costs.slab_pixel_ns * pixels
        } else {
            costs.lease.fixed_ns * begun.leases as f64
                + costs.lease.per_unit_ns * begun.lease_pixels as f64
        };
        if let (Some(before), Some(after)) = (before, after) {
            let (ns, bricks, times) = (after - before, bricks as u64, &mut self.decisions);
            if is_first {
                times.first_frame.add(bricks, ns);
            } else if begun.frames > 0 {
                times.frames.add(bricks, ns);
            } else if begun.slabs > 0 {
                times.slabs.add(bricks, ns);
                times.slab_pixels += pixels as u64;
            } else if let Some(pixels) = result_pixels {
                times.results.add(pixels as u64, ns);
                times.result_count += 1;
                times.lease_count += begun.leases;
                times.lease_pixels += begun.lease_pixels;
            } else if prefetches {
                times.prefetches.add(1, ns);
            } else {
                times.others.add(1, ns);
            }
        }
        cost
    }

    /// Notes what the actions of one event begin, and which frame comes next.
    fn begun_by(&mut self, actions: &[Action]) -> Begun {
        let mut begun = Begun::default();
        for action in actions {
            match action {
                Action::Send { message: ToWorker::Lease(lease), .. } => {
                    begun.leases += 1;
                    begun.lease_pixels += lease.tile.area() as u64;
                    let before = self.last_slab.replace((lease.frame, lease.slab.first));
                    if before != self.last_slab {
                        begun.slabs += 1;
                        begun.frames += u64::from(before.is_none_or(|b| b.0 != lease.frame));
                    }
                }
                Action::Send { message: ToWorker::Region(lease), .. } => {
                    begun.leases += 1;
                    // Several frames may be in the making: each begins once.
                    if self.begun.insert(lease.frame) {
                        begun.slabs += 1;
                        begun.frames += 1;
                    }
                }
                Action::FrameDone { frame, .. } => {
                    // Before the next is begun, which the same event may do.
                    let mut later = self.frames.range(*frame..).skip(1);
                    self.current_frame = Some(later.next().map_or(*frame, |(f, _)| *f));
                }
                _ => {}
            }
        }
        begun
    }

    /// Bytes of a slab's lease on the wire.
    pub(super) fn slab_lease_bytes(&self, lease: &Lease) -> u64 {
        let facts = self.model.slab_facts(&self.frames[&lease.frame].job, lease);
        facts.map_or(SMALL_BYTES, |f| f.lease_bytes)
    }

    fn carry_out(&mut self, action: Action, when: Nanos, first: bool) {
        match action {
            Action::Send { worker, message: ToWorker::DropBricks { set, bricks } } => {
                if let Some(w) = self.workers.get_mut(&worker) {
                    w.brick_orders.push_back((set, BrickOrder::Drop(bricks), SMALL_BYTES));
                    self.send_bricks(worker, when);
                }
            }
            Action::Send { worker, message } => {
                let bytes = match &message {
                    ToWorker::Lease(lease) => {
                        self.outcome_of(lease.frame).leases += 1;
                        self.slab_lease_bytes(lease)
                    }
                    ToWorker::Region(lease) => {
                        self.outcome_of(lease.frame).leases += 1;
                        SMALL_BYTES + lease.begun.as_ref().map_or(0, |b| state_bytes(&b.pixels))
                    }
                    // Twelve bytes a brick and some more.
                    ToWorker::Directory { bricks, .. } => SMALL_BYTES + 13 * bricks.len() as u64,
                    ToWorker::Frame { .. } | ToWorker::Scene(_) => FRAME_BYTES,
                    _ => SMALL_BYTES,
                };
                self.down(worker, message, bytes, when, first);
            }
            Action::SendBricks { worker, set, bricks } => {
                self.order_bricks(worker, set, bricks, when);
            }
            Action::Finished { tiles, .. } => {
                if self.machine.is_none() {
                    let pixels = tiles.iter().map(|(tile, _)| tile.area()).sum::<usize>();
                    let ns = self.master.costs.finish_pixel_ns * pixels as f64;
                    let wake_ns = self.master.costs.master.wake_ns;
                    self.master_works(|c| &mut c.finishers, when, ns, wake_ns);
                }
            }
            Action::FrameDone { frame, state, stats, spans } => {
                let job = self.job(frame);
                self.model.end_frame(&job);
                // The scheduler goes on with the next frame at once, where there is one.
                let done = self.outcome_of(frame).done;
                let next = self.frames.range(frame..).nth(1).map(|(next, _)| *next);
                if let Some(next) = next.filter(|next| !self.path.contains(next)) {
                    self.outcome_of(next).began = done;
                }
                let costs = &self.master.costs;
                let shared = self.machine.is_some();
                let pixel_ns = if shared { costs.mark_pixel_ns } else { costs.finish_pixel_ns };
                // Tiles that arrived finished are encoded already; only the others are left.
                let left = state.encoded_tiles().iter().map(|(tile, _)| tile.area()).sum::<usize>();
                let pixels = match job.finish {
                    Some(_) if !shared => left as f64,
                    _ => self.pixels(frame),
                };
                let wake_ns = costs.master.wake_ns;
                self.observer.frame_done(frame, state, *stats, spans);
                self.do_some(when, Chore::Finish(frame), pixel_ns * pixels, wake_ns);
            }
            Action::FrameFailed { frame, reason, .. } => {
                let number = self.frames[&frame].job.number as usize;
                self.failed.get_or_insert(Unpredictable::Failed { frame: number, reason });
                self.frames_in_hand = self.frames_in_hand.saturating_sub(1);
            }
            Action::Drop { worker, .. } => {
                self.dropped.insert(worker);
            }
            Action::ShutOut { worker, .. } => {
                self.dropped.insert(worker);
            }
            Action::FrameTainted { .. } => {
                self.frames_in_hand = self.frames_in_hand.saturating_sub(1);
            }
            Action::Progress { .. } | Action::Paused { .. } => {}
        }
    }

    /// Pixels of a frame's picture.
    fn pixels(&self, frame: FrameId) -> f64 {
        let [wide, high] = self.frames[&frame].job.view.size;
        f64::from(wide) * f64::from(high)
    }

    /// Does some of a chore of which so many nanoseconds are left. No chore reserves time that is
    /// still to come: work is done in the order in which it comes.
    fn do_some(&mut self, when: Nanos, chore: Chore, left_ns: f64, wake_ns: f64) {
        // A finisher does one picture after the other; only where it shares its core other work
        // comes between.
        let whole = matches!(chore, Chore::Finish(_)) && self.machine.is_none();
        let ns = if whole { left_ns } else { left_ns.min(TURN_NS) };
        let done = match chore {
            Chore::Finish(_) => self.master_works(|c| &mut c.finishers, when, ns, wake_ns),
            Chore::Send(_) => self.master_works(|c| &mut c.streams, when, ns, wake_ns),
            Chore::Receive => self.machine.as_mut().map_or(when, |machine| machine.run(when, ns)),
        };
        self.later(done, Occurrence::Chore(chore, left_ns - ns));
    }

    /// Goes on with a chore, or with the one that comes after it.
    pub(super) fn continue_chore(&mut self, chore: Chore, left_ns: f64) {
        let now = self.now_ns();
        if left_ns > 0.0 {
            self.do_some(now, chore, left_ns, 0.0);
            return;
        }
        let costs = self.master.costs;
        match chore {
            Chore::Finish(frame) => {
                let ns = costs.deliver_pixel_ns * self.pixels(frame);
                self.do_some(now, Chore::Send(frame), ns, costs.master.wake_ns);
                self.outcome_of(frame).delivered = now;
                self.count_delivery();
                self.frames_in_hand = self.frames_in_hand.saturating_sub(1);
                self.feed();
                self.drive();
            }
            Chore::Send(frame) if self.machine.is_some() => {
                let ns = costs.client_pixel_ns * self.pixels(frame);
                self.do_some(now, Chore::Receive, ns, 0.0);
            }
            Chore::Send(_) | Chore::Receive => {}
        }
    }
}
