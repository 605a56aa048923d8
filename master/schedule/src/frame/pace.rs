//! How long tasks take, by those that came last: what outlives its estimate is run twice.

use crate::Micros;
use std::collections::VecDeque;

/// How long tasks take, by the last ones of the frame.
#[derive(Debug, Default)]
pub(super) struct Pace {
    /// Workload, render time, and time beside it, of each.
    last: VecDeque<(u64, Micros, Micros)>,
}

impl Pace {
    /// Medians of 64 move slowly enough to pass over a slow worker's share and quickly enough
    /// to follow the slabs.
    const LAST: usize = 64;
    /// With fewer, one slow task is the median.
    const LEAST: usize = 4;
    /// A task is never late before: the scheduling of two busy machines.
    const FLOOR: Micros = 5_000;

    pub(super) fn note(&mut self, est: u64, render_us: Micros, lasted: Micros) {
        self.last.push_back((est.max(1), render_us, lasted.saturating_sub(render_us)));
        if self.last.len() > Self::LAST {
            self.last.pop_front();
        }
    }

    /// What these tasks say about the next: medians of render time for a workload of 2^20, and
    /// of the time beside it.
    pub(super) fn measure(&self) -> Option<Measured> {
        if self.last.len() < Self::LEAST {
            return None;
        }
        let median = |of: &dyn Fn(&(u64, Micros, Micros)) -> u128| {
            let mut all: Vec<u128> = self.last.iter().map(of).collect();
            let mid = all.len() / 2;
            *all.select_nth_unstable(mid).1
        };
        let render = median(&|t| (u128::from(t.1) << 20) / u128::from(t.0));
        Some(Measured { render, beside: median(&|t| u128::from(t.2)) })
    }
}

/// How long a task takes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Measured {
    render: u128,
    beside: u128,
}

impl Measured {
    /// How long one of this workload is drawn.
    pub(super) fn expects(&self, est: u64) -> Micros {
        ((self.render * u128::from(est.max(1))) >> 20).min(u128::from(Micros::MAX)) as Micros
    }

    /// After what time a task of this workload has outlived its estimate.
    pub(super) fn patience(&self, est: u64) -> Micros {
        let expected = u128::from(self.expects(est)) + self.beside;
        Pace::FLOOR.saturating_add((2 * expected).min(u128::from(Micros::MAX)) as Micros)
    }
}
