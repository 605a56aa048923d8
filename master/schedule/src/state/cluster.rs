//! State that all frames share.

use crate::policy::active_set::ActiveSet;
use crate::policy::cost_history::CostHistory;
use crate::policy::link_use::LinkUse;
use crate::state::audits::{Lie, is_in_share};
use crate::state::reputation::Reputations;
use crate::state::residency::Residency;
use crate::state::workers::{Roster, Worker};
use crate::{Action, Config, Micros, Totals};
use slabcast_common::ids::WorkerId;
use slabcast_common::message::ToWorker;
use std::collections::VecDeque;

/// Workers, bricks and observations: all state but the frames.
#[derive(Debug)]
pub(crate) struct Cluster {
    pub(crate) config: Config,
    pub(crate) roster: Roster,
    pub(crate) reputations: Reputations,
    /// Workers that the last result showed to be liars.
    pub(crate) lies: Vec<Lie>,
    pub(crate) residency: Residency,
    pub(crate) history: CostHistory,
    pub(crate) link_use: LinkUse,
    pub(crate) active_set: ActiveSet,
    /// Actions that the driver has not taken.
    pub(crate) out: VecDeque<Action>,
    pub(crate) next_task: u64,
    pub(crate) totals: Totals,
    /// Indices of bricks of the last result that were not used lately.
    pub(crate) newly_used: Vec<u32>,
    /// Workers that are lent no more of their own tasks for now, ascending by id.
    pub(crate) saturated: Vec<WorkerId>,
}

impl Cluster {
    /// Queues a message to a worker, and before it which frames are over.
    pub(crate) fn send(&mut self, worker: WorkerId, message: ToWorker) {
        let over = self.roster.get_mut(worker).map(|w| std::mem::take(&mut w.over));
        for frame in over.into_iter().flatten() {
            self.out.push_back(Action::Send { worker, message: ToWorker::EndFrame { frame } });
        }
        self.out.push_back(Action::Send { worker, message });
    }

    /// Activates all workers: a task needs one that has not failed at it.
    pub(crate) fn activate_all(&mut self) {
        self.active_set.activate_all();
        self.roster.activate(usize::MAX);
    }

    /// Whether a task that a worker is lent is to be audited: the worker is not trusted, and there
    /// is another to compare with.
    pub(crate) fn audits(&self, id: WorkerId, task: u64) -> bool {
        let Some(worker) = self.roster.get(id).filter(|w| !w.is_trusted) else { return false };
        let Config { audit_ppm, audit_first, audit_seed, .. } = self.config;
        let is_chosen =
            worker.reputation.agreed < audit_first || is_in_share(audit_seed, task, audit_ppm);
        let is_other = |w: &Worker| !w.leaving && !w.is_stuck && w.identity != worker.identity;
        is_chosen && self.roster.iter().any(|(_, w)| is_other(w))
    }

    /// Counts a failure of a worker.
    pub(crate) fn strike(&mut self, id: WorkerId) {
        if let Some(worker) = self.roster.get_mut(id) {
            worker.reputation.strike();
        }
    }

    /// Has a worker that failed again and again pause.
    pub(crate) fn pause(&mut self, worker: WorkerId, now: Micros) {
        let Some(reputation) = self.roster.get(worker).map(|w| w.reputation) else { return };
        let (failures, pause_us) = (reputation.strikes, reputation.pause_us());
        if pause_us > 0 {
            self.roster.pause(worker, now.saturating_add(pause_us));
            self.out.push_back(Action::Paused { worker, failures, pause_us });
        }
    }

    /// Tells workers which frames are over, if no other message will.
    pub(crate) fn send_ended_frames(&mut self) {
        let waits = self.roster.iter().filter(|(_, w)| !w.over.is_empty());
        for id in waits.map(|(id, _)| id).collect::<Vec<_>>() {
            let over = self.roster.get_mut(id).and_then(|w| w.over.pop());
            if let Some(frame) = over {
                self.send(id, ToWorker::EndFrame { frame });
            }
        }
    }
}
