//! Reputation: what is remembered of a worker over all its links.
//!
//! A worker that crashes comes back on a new link, with a new id. If nothing were remembered, one
//! worker in a crash loop would look like many unlucky ones. So failures are counted by
//! [`WorkerIdentity`], and a worker that failed again and again is lent nothing for a while after it
//! joins; each failure doubles the pause, each result takes one failure off.

use crate::state::workers::Worker;
use crate::{Micros, WorkerIdentity};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Limit: pause in microseconds of a worker that failed twice without a result between, and the
/// longest pause. One failure costs nothing: whole racks lose their power.
const FIRST_WORKER_PAUSE_US: Micros = 250_000;
const LONGEST_WORKER_PAUSE_US: Micros = 10_000_000;

/// Limit: workers that are remembered after they left, so that a peer that gives itself a new name
/// each time fills no memory. The one that was seen last longest ago is forgotten first.
const MAX_REMEMBERED: usize = 4096;

/// Failures, results and pauses of a worker, kept over its links.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Reputation {
    /// Failures, less results since.
    pub(crate) strikes: u32,
    /// Whether any result of it was accepted.
    pub(crate) has_drawn: bool,
    /// Number of audits in which the worker drew the same pixels as others.
    pub(crate) agreed: u32,
    seen: Micros,
}

impl Reputation {
    /// Counts a failure: the worker was lost while it drew, or refused a task.
    pub(crate) fn strike(&mut self) {
        self.strikes = self.strikes.saturating_add(1);
    }

    /// Counts an accepted result.
    pub(crate) fn add_result(&mut self) {
        self.strikes = self.strikes.saturating_sub(1);
        self.has_drawn = true;
    }

    /// Counts an audit in which it drew what others drew.
    pub(crate) fn agree(&mut self) {
        self.agreed = self.agreed.saturating_add(1);
        self.add_result();
    }

    /// Returns for how many microseconds the worker is lent nothing after a failure.
    pub(crate) fn pause_us(&self) -> Micros {
        match self.strikes {
            0 | 1 => 0,
            n => (FIRST_WORKER_PAUSE_US << (n - 2).min(20)).min(LONGEST_WORKER_PAUSE_US),
        }
    }
}

/// The reputations of workers that are not linked.
#[derive(Debug, Default)]
pub(crate) struct Reputations {
    absent: BTreeMap<Arc<WorkerIdentity>, Reputation>,
}

impl Reputations {
    /// Takes out what is remembered of a worker that joins.
    pub(crate) fn recall(&mut self, who: &WorkerIdentity) -> Reputation {
        self.absent.remove(who).unwrap_or_default()
    }

    /// Remembers a worker that is gone.
    pub(crate) fn remember(&mut self, worker: &Worker, now: Micros) {
        let reputation = Reputation { seen: now, ..worker.reputation };
        self.absent.insert(worker.identity.clone(), reputation);
        if self.absent.len() > MAX_REMEMBERED {
            let oldest = self.absent.iter().min_by_key(|(_, r)| r.seen).map(|(who, _)| who.clone());
            oldest.map(|who| self.absent.remove(&who));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_grow_with_failures_and_shrink_with_results() {
        let mut r = Reputation::default();
        let pauses: Vec<_> = (0..9)
            .map(|_| {
                r.strike();
                r.pause_us() / 1000
            })
            .collect();
        assert_eq!(pauses, [0, 250, 500, 1000, 2000, 4000, 8000, 10_000, 10_000]);
        (0..7).for_each(|_| r.add_result());
        assert_eq!(r.pause_us(), 250_000);
        (0..7).for_each(|_| r.add_result());
        assert_eq!((r.pause_us(), r.has_drawn), (0, true));
    }
}
