//! Speculative copies: a task whose worker says nothing for too long is lent to an idle worker too,
//! and the first result counts.
//!
//! One silent worker holds up a frame. So when threads run idle, a task without an answer after
//! more than twice the time that tasks of its workload take is rendered twice, and so is what waits
//! behind it on the same worker. Its own lease stays live. The price is at most one task for each
//! idle thread. Suspects are left out, lest they take two workers at once.

use super::lend::may_try;
use crate::Micros;
use crate::state::cluster::Cluster;
use crate::state::frame::FrameCore;
use crate::state::task_queue::End;
use slabcast_common::ids::WorkerId;
use std::cell::Cell;
use std::collections::VecDeque;

/// Tuning (us): silence that is never held against a worker: the scheduling of two busy machines.
const SILENCE_US: Micros = 5_000;

/// Tuning (ratio): a task is silent once it takes so many times its expected time.
const SILENCE_RATIO: f64 = 2.0;

/// Limit: tasks that the median of times is taken of. Medians of 64 pass over a slow worker's share
/// and follow the slabs; with fewer than 4 one slow task is the median.
const PACE_TASKS: usize = 64;
const PACE_MIN_TASKS: usize = 4;

/// Returns how long to wait for an answer that is expected after so many microseconds.
pub(crate) fn patience_us(expected_us: f64) -> Micros {
    SILENCE_US.saturating_add((SILENCE_RATIO * expected_us) as Micros)
}

/// Durations of the last tasks of a frame.
#[derive(Debug, Default)]
pub(crate) struct Pace {
    last: VecDeque<TaskTime>,
    /// Their medians, once asked for.
    medians: Cell<Option<TaskTime>>,
}

/// Time of a task.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TaskTime {
    /// Rendering time of a workload of 2^20, in microseconds.
    render_us: u128,
    /// Time beside rendering, in microseconds.
    beside_us: u128,
}

impl Pace {
    /// Notes a task of workload `est` that was rendered in `render_us` and answered after
    /// `lasted_us`.
    pub(crate) fn note(&mut self, est: u64, render_us: Micros, lasted_us: Micros) {
        let beside_us = u128::from(lasted_us.saturating_sub(render_us));
        let render_us = (u128::from(render_us) << 20) / u128::from(est.max(1));
        self.last.push_back(TaskTime { render_us, beside_us });
        self.medians.set(None);
        if self.last.len() > PACE_TASKS {
            self.last.pop_front();
        }
    }

    /// Returns the medians of the last tasks; `None` while they are too few.
    pub(crate) fn median(&self) -> Option<TaskTime> {
        if self.last.len() < PACE_MIN_TASKS {
            return None;
        }
        if self.medians.get().is_none() {
            let median = |value: &dyn Fn(&TaskTime) -> u128| {
                let mut all: Vec<u128> = self.last.iter().map(value).collect();
                let mid = all.len() / 2;
                *all.select_nth_unstable(mid).1
            };
            let (render_us, beside_us) = (median(&|t| t.render_us), median(&|t| t.beside_us));
            self.medians.set(Some(TaskTime { render_us, beside_us }));
        }
        self.medians.get()
    }
}

impl TaskTime {
    /// Returns the rendering time of a workload in microseconds.
    pub(crate) fn render_us(&self, est: u64) -> Micros {
        let us = (self.render_us * u128::from(est.max(1))) >> 20;
        us.min(u128::from(Micros::MAX)) as Micros
    }

    /// Returns how long to wait for a task of a workload.
    fn patience_us(&self, est: u64) -> Micros {
        patience_us(self.render_us(est) as f64 + self.beside_us as f64)
    }
}

/// Outcome of the search for silent tasks.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Silent {
    /// A silent task, and the worker for its copy.
    pub(crate) copy: Option<(u32, WorkerId)>,
    /// When to search again, if none is silent yet.
    pub(crate) at: Option<Micros>,
}

impl FrameCore {
    /// Finds a silent task and an idle worker for its copy.
    ///
    /// `asked_until`: for a task that its worker was asked to split, until when to wait for that.
    /// `fits`: whether a worker short of memory has room for a task's bricks.
    pub(crate) fn find_silent(
        &self,
        cluster: &Cluster,
        asked_until: impl Fn(u32) -> Micros,
        questions: &[Micros],
        fits: impl Fn(WorkerId, u32) -> bool,
        now: Micros,
    ) -> Silent {
        let idle: Vec<(WorkerId, u64)> = cluster
            .roster
            .active()
            .filter(|(_, w)| w.has_idle_thread())
            .map(|(id, w)| (id, w.leases))
            .collect();
        // Some of them wait for pieces.
        if idle.len() <= questions.len() {
            return Silent { copy: None, at: questions.iter().copied().min() };
        }
        let Some(pace) = self.pace.median() else { return Silent::default() };
        let table = &self.table;
        let queue = &table.queue;
        let mut silent: Vec<(Micros, u32)> = Vec::new();
        for (id, lent) in table.all_lent() {
            let Some(worker) = cluster.roster.get(id) else { continue };
            let threads = worker.threads as usize;
            let mut running_until = 0;
            for (i, lent) in lent.iter().enumerate() {
                let is_open = |&p: &u32| queue.tasks[p as usize].end == End::Open;
                let place = queue.place(lent.task).filter(is_open);
                let until = match place {
                    _ if i >= threads => running_until,
                    // Its result is no longer wanted.
                    None => now,
                    Some(place) => {
                        let est = table.cut.tiles[place as usize].est;
                        let started = table.started(id, lent.sent);
                        let until = started.saturating_add(pace.patience_us(est));
                        until.max(asked_until(place))
                    }
                };
                running_until = until.max(running_until);
                let may = |&p: &u32| queue.tasks[p as usize].may_speculate();
                if let Some(place) = place.filter(may) {
                    silent.push((until, place));
                }
            }
        }
        silent.sort_unstable();
        for (until, place) in silent {
            let task = queue.id(place);
            let has_it = |id: WorkerId| table.lent(id).iter().any(|l| l.task == task);
            let may = |id: WorkerId, load: u64| load == 0 || fits(id, place);
            // Who has voted on an audited task has no second vote.
            let may_vote = |id: WorkerId| may_try(cluster, &queue.tasks[place as usize], id);
            let takers =
                idle.iter().filter(|(id, load)| !has_it(*id) && may(*id, *load) && may_vote(*id));
            let Some(&(id, _)) = takers.min_by_key(|(_, load)| *load) else { continue };
            return match until > now {
                true => Silent { copy: None, at: Some(until) },
                false => Silent { copy: Some((place, id)), at: None },
            };
        }
        Silent::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speculative_copy_waits_for_twice_the_median_time() {
        let mut pace = Pace::default();
        for us in [900, 1000, 1000] {
            pace.note(1 << 20, us, us);
        }
        assert!(pace.median().is_none(), "three tasks are too few");
        pace.note(1 << 20, 90_000, 90_000);
        let median = pace.median().expect("four");
        assert_eq!(median.patience_us(1 << 20), SILENCE_US + 2000);
        assert_eq!(median.patience_us(1 << 19), SILENCE_US + 1000);
    }
}
