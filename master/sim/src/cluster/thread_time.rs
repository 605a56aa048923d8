//! Use of the render threads' time while frames are delivered steadily.

use super::VirtualCluster;
use super::worker::Idle;
use crate::Nanos;
use crate::model::TileModel;
use crate::outcome::{Observer, Outcome, ThreadTime};
use slabcast_common::ids::WorkerId;

impl<M: TileModel, O: Observer> VirtualCluster<M, O> {
    /// Counts a stretch of a render thread's time.
    pub(super) fn spend(
        &mut self,
        from: Nanos,
        to: Nanos,
        part: fn(&mut ThreadTime) -> &mut Nanos,
    ) {
        let Some(counted_from) = self.counted_from.filter(|_| !self.counted) else { return };
        *part(&mut self.thread_time) += to.saturating_sub(from.max(counted_from));
    }

    /// Counts the idle time of a thread until now. The task that it begins was `decided` upon then;
    /// bricks have been `lacking` since then. `None`: the path ends.
    pub(super) fn was_idle(
        &mut self,
        idle: Idle,
        decided: Option<Nanos>,
        lacking: Option<Nanos>,
        now: Nanos,
    ) {
        let Idle { since, heard } = idle;
        let stalled = lacking.unwrap_or(now).clamp(since, now);
        self.spend(stalled, now, |t| &mut t.bricks);
        let decided = decided.unwrap_or(now).clamp(since, stalled);
        let heard = heard.unwrap_or(decided).clamp(since, decided);
        let path_ends = self.begun.len() == self.frames.len();
        self.spend(since, heard, |t| &mut t.round_trip);
        if path_ends {
            self.spend(heard, decided, |t| &mut t.path_end);
        } else {
            self.spend(heard, decided, |t| &mut t.no_work);
        }
        self.spend(decided, stalled, |t| &mut t.round_trip);
    }

    /// A frame was delivered: counting begins with the first, and ends when frames are no longer
    /// delivered steadily.
    pub(super) fn count_delivery(&mut self) {
        self.delivered += 1;
        if self.delivered == 1 {
            self.counted_from = Some(self.now_ns());
            self.first_work = self.work();
        }
        let steady = Outcome::steady_frames(self.frames.len(), self.master.frames_in_flight);
        if self.delivered == steady + 1 {
            self.stop_counting();
        }
    }

    pub(super) fn stop_counting(&mut self) {
        if self.counted {
            return;
        }
        let now = self.now_ns();
        let ids: Vec<WorkerId> = self.workers.keys().copied().collect();
        for id in ids {
            for thread in 0..self.workers[&id].running.len() {
                let w = &self.workers[&id];
                match &w.running[thread] {
                    // Nobody waits for it.
                    Some(run) => {
                        let start = run.start;
                        self.spend(start, now, |t| &mut t.tiles);
                    }
                    None => {
                        let idle = w.idle[thread];
                        self.was_idle(idle, None, None, now);
                    }
                }
            }
        }
        self.counted = true;
        let work = self.work();
        self.steady_work =
            [work.driver - self.first_work.driver, work.streams - self.first_work.streams];
    }
}
