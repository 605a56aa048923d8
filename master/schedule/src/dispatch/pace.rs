//! How long tasks take, by those that came last: what outlives its estimate is run twice.

use crate::Micros;
use std::cell::Cell;
use std::collections::VecDeque;

/// How long tasks take, by the last ones of the frame.
#[derive(Debug, Default)]
pub(crate) struct Pace {
    /// Render time for a workload of 2^20, and time beside it, of each.
    last: VecDeque<Measured>,
    /// Their medians, once somebody has asked.
    medians: Cell<Option<Measured>>,
}

impl Pace {
    /// Medians of 64 move slowly enough to pass over a slow worker's share and quickly enough to
    /// follow the slabs.
    const LAST: usize = 64;
    /// With fewer, one slow task is the median.
    const LEAST: usize = 4;
    /// A task is never late before: the scheduling of two busy machines.
    const FLOOR: Micros = 5_000;

    pub(crate) fn note(&mut self, est: u64, render_us: Micros, lasted: Micros) {
        let render = (u128::from(render_us) << 20) / u128::from(est.max(1));
        let beside = u128::from(lasted.saturating_sub(render_us));
        self.last.push_back(Measured { render, beside });
        self.medians.set(None);
        if self.last.len() > Self::LAST {
            self.last.pop_front();
        }
    }

    /// What these tasks say about the next: medians of render time for a workload of 2^20, and of
    /// the time beside it.
    pub(crate) fn measure(&self) -> Option<Measured> {
        if self.last.len() < Self::LEAST {
            return None;
        }
        if self.medians.get().is_none() {
            let median = |of: &dyn Fn(&Measured) -> u128| {
                let mut all: Vec<u128> = self.last.iter().map(of).collect();
                let mid = all.len() / 2;
                *all.select_nth_unstable(mid).1
            };
            let (render, beside) = (median(&|m| m.render), median(&|m| m.beside));
            self.medians.set(Some(Measured { render, beside }));
        }
        self.medians.get()
    }
}

/// How long a task takes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Measured {
    render: u128,
    beside: u128,
}

impl Measured {
    /// How long one of this workload is drawn.
    pub(crate) fn expects(&self, est: u64) -> Micros {
        ((self.render * u128::from(est.max(1))) >> 20).min(u128::from(Micros::MAX)) as Micros
    }

    /// After what time a task of this workload has outlived its estimate.
    pub(crate) fn patience(&self, est: u64) -> Micros {
        let expected = u128::from(self.expects(est)) + self.beside;
        Pace::FLOOR.saturating_add((2 * expected).min(u128::from(Micros::MAX)) as Micros)
    }
}
