//! What all frames share: workers, bricks, history and the queue of actions.

use crate::policy::active_set::ActiveSet;
use crate::policy::link_use::LinkUse;
use crate::policy::region::CostHistory;
use crate::state::residency::Residency;
use crate::state::workers::Roster;
use crate::{Action, Config, Totals};
use slabcast_common::ids::WorkerId;
use slabcast_common::message::ToWorker;
use std::collections::VecDeque;

/// All but the frames.
#[derive(Debug)]
pub(crate) struct Cluster {
    pub(crate) config: Config,
    pub(crate) roster: Roster,
    pub(crate) residency: Residency,
    pub(crate) history: CostHistory,
    pub(crate) link_use: LinkUse,
    pub(crate) active_set: ActiveSet,
    pub(crate) out: VecDeque<Action>,
    pub(crate) next_task: u64,
    pub(crate) totals: Totals,
    /// Places of bricks of a result that were not drawn from lately.
    pub(crate) fresh: Vec<u32>,
    /// Workers that have enough for now, in their order: they are lent no more of their own.
    pub(crate) sated: Vec<WorkerId>,
}

impl Cluster {
    /// Tells a worker something, and before it which frames are over.
    pub(crate) fn send(&mut self, worker: WorkerId, message: ToWorker) {
        let over = self.roster.get_mut(worker).map(|w| std::mem::take(&mut w.over));
        for frame in over.into_iter().flatten() {
            self.out.push_back(Action::Send { worker, message: ToWorker::EndFrame { frame } });
        }
        self.out.push_back(Action::Send { worker, message });
    }

    /// Nothing is left that it could be told along with.
    pub(crate) fn tell_what_is_over(&mut self) {
        let told = self.roster.iter().filter(|(_, w)| !w.over.is_empty());
        for id in told.map(|(id, _)| id).collect::<Vec<_>>() {
            let over = self.roster.get_mut(id).and_then(|w| w.over.pop());
            if let Some(frame) = over {
                self.send(id, ToWorker::EndFrame { frame });
            }
        }
    }
}
