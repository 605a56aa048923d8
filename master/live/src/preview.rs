//! Size and level of moving passes: as fine as fits into [`BUDGET_MS`]. Pure.
//!
//! Settings stand on a ladder from all detail down. What a rung takes is what it took last, or follows
//! from its neighbours. A rung finer than the present one is tried only after [`GOOD_IN_A_ROW`] passes
//! that came in time, so that pictures do not flicker between two sharpnesses; a coarser one at once.

/// Milliseconds in which a moving pass should be drawn: two frames of a screen.
const BUDGET_MS: f64 = 33.0;

/// Milliseconds from which on a still is shown quickly first, in a moving pass.
pub(crate) const SLOW_MS: f64 = 150.0;

/// Predicted time of a rung over that of the next finer one, until it is measured: 0.2 to 0.6 on mri256
/// and CTs.
const RATIO: f64 = 0.45;

/// If no rung fits the budget, a rung is taken whose time is at most this multiple of the quickest one's.
const HARDLY: f64 = 1.3;

/// Passes in time after which a finer rung is tried.
const GOOD_IN_A_ROW: u32 = 8;

/// Passes that were late after which a coarser rung is taken.
const LATE_IN_A_ROW: u32 = 2;

/// Most rungs by which a slow link makes passes coarser than the time of drawing asks for.
const MOST_PENALTY: usize = 2;

/// Level and size of a pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Setting {
    /// Levels coarser than all detail.
    pub(crate) level: u32,
    /// The picture's edge is divided by this.
    pub(crate) divisor: u32,
}

/// All detail first.
pub(crate) const RUNGS: [Setting; 6] = [
    Setting { level: 0, divisor: 1 },
    Setting { level: 1, divisor: 1 },
    Setting { level: 1, divisor: 2 },
    Setting { level: 2, divisor: 2 },
    Setting { level: 2, divisor: 4 },
    Setting { level: 3, divisor: 4 },
];

/// See the head of the file.
#[derive(Debug, Default)]
pub(crate) struct Preview {
    /// Milliseconds that each rung took, smoothed; `None` if nobody measured it.
    took_ms: [Option<f64>; RUNGS.len()],
    rung: usize,
    good: u32,
    late: u32,
    penalty: usize,
}

impl Preview {
    /// Forgets what rungs took, but for a first guess: another scene may take another time.
    pub(crate) fn scene_changed(&mut self) {
        let rung = self.rung;
        for (i, took) in self.took_ms.iter_mut().enumerate() {
            if i != rung && i != 0 {
                *took = None;
            }
        }
        self.good = 0;
    }

    /// Returns the milliseconds that a rung should take; `None` if nothing was measured yet.
    fn predicted(&self, rung: usize) -> Option<f64> {
        if let Some(took) = self.took_ms[rung] {
            return Some(took);
        }
        let known = (0..RUNGS.len()).filter(|&i| self.took_ms[i].is_some());
        let nearest = known.min_by_key(|&i| i.abs_diff(rung))?;
        let steps = rung as i32 - nearest as i32;
        self.took_ms[nearest].map(|took| took * RATIO.powi(steps))
    }

    /// Returns the finest rung that takes hardly longer than the quickest: where none fits, being coarse
    /// must gain something.
    fn quickest(&self) -> usize {
        let most = HARDLY * self.best_ms();
        let is_quick = |rung: &usize| self.predicted(*rung).is_some_and(|ms| ms <= most);
        (0..RUNGS.len()).find(is_quick).unwrap_or(RUNGS.len() - 1)
    }

    /// Returns the least milliseconds that any rung should take; infinity if nothing was measured.
    fn best_ms(&self) -> f64 {
        (0..RUNGS.len()).filter_map(|rung| self.predicted(rung)).fold(f64::INFINITY, f64::min)
    }

    /// Returns the setting of the next moving pass, and its number on the ladder.
    pub(crate) fn choose(&mut self) -> (usize, Setting) {
        let fits = |rung: &usize| self.predicted(*rung).is_none_or(|ms| ms <= BUDGET_MS);
        let finest = (0..RUNGS.len()).find(fits).unwrap_or_else(|| self.quickest());
        let mut wanted = (finest + self.penalty).min(RUNGS.len() - 1);
        // What nobody measured is tried once: guesses from a rung that has its own overhead are too high.
        let is_slow = self.predicted(finest).is_some_and(|ms| ms > BUDGET_MS);
        if is_slow && self.good >= GOOD_IN_A_ROW && wanted > 0 && self.took_ms[wanted - 1].is_none()
        {
            wanted -= 1;
        }
        if wanted > self.rung || self.good >= GOOD_IN_A_ROW || self.took_ms[self.rung].is_none() {
            self.good = 0;
            self.rung = wanted;
        }
        (self.rung, RUNGS[self.rung])
    }

    /// Notes the milliseconds from the beginning of a pass on rung `rung` to its last pixel.
    pub(crate) fn drawn(&mut self, rung: usize, ms: f64) {
        let took = &mut self.took_ms[rung];
        *took = Some(took.map_or(ms, |before| 0.5 * (before + ms)));
        if rung == self.rung {
            let most = BUDGET_MS.max(HARDLY * self.best_ms());
            self.good = if ms <= most { self.good + 1 } else { 0 };
        }
    }

    /// Notes that a moving pass was painted `late_ms` after it was sent, and `frame_ms` after the one
    /// before it was.
    pub(crate) fn painted(&mut self, late_ms: f64, frame_ms: f64) {
        if late_ms > 1.5 * frame_ms.max(BUDGET_MS) {
            self.late += 1;
            self.good = 0;
            if self.late >= LATE_IN_A_ROW {
                self.late = 0;
                self.penalty = (self.penalty + 1).min(MOST_PENALTY);
            }
        } else {
            self.late = 0;
            if self.good >= GOOD_IN_A_ROW {
                self.penalty = self.penalty.saturating_sub(1);
            }
        }
    }

    /// Whether a still takes so long that it should be shown quickly first.
    pub(crate) fn is_slow(&self) -> bool {
        self.took_ms[0].is_some_and(|ms| ms > SLOW_MS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quick_scenes_move_in_all_detail() {
        let mut preview = Preview::default();
        preview.drawn(0, 14.0);
        for _ in 0..20 {
            let (rung, setting) = preview.choose();
            assert_eq!((rung, setting.divisor), (0, 1));
            preview.drawn(rung, 16.0);
        }
    }

    #[test]
    fn slow_scenes_move_as_finely_as_fits_and_do_not_flicker() {
        // Milliseconds of peer-semi of mri256 at 512x512.
        let takes = [162.0, 100.0, 30.0, 12.0, 9.6, 5.0];
        let mut preview = Preview::default();
        preview.drawn(0, takes[0]);
        assert!(preview.is_slow());
        let mut rungs = Vec::new();
        for _ in 0..60 {
            let (rung, _) = preview.choose();
            rungs.push(rung);
            preview.drawn(rung, takes[rung]);
        }
        let settled = rungs[rungs.len() - 1];
        assert!(takes[settled] <= BUDGET_MS && takes[settled - 1] > BUDGET_MS, "{rungs:?}");
        let changes = rungs.windows(2).filter(|pair| pair[0] != pair[1]).count();
        assert!(changes <= 4, "{rungs:?}");
    }

    #[test]
    fn where_nothing_fits_coarse_passes_must_gain_something() {
        let takes = [400.0, 200.0, 90.0, 50.0, 45.0, 44.0];
        let mut preview = Preview::default();
        let mut last = 0;
        for _ in 0..90 {
            (last, _) = preview.choose();
            preview.drawn(last, takes[last]);
        }
        assert_eq!(last, 3, "50 ms are hardly more than 44");
    }

    #[test]
    fn slow_links_make_passes_coarser_and_good_ones_finer_again() {
        let mut preview = Preview::default();
        preview.drawn(0, 10.0);
        preview.choose();
        for _ in 0..4 {
            preview.painted(400.0, 33.0);
        }
        let (coarse, _) = preview.choose();
        assert!(coarse >= 1);
        for _ in 0..40 {
            let (rung, _) = preview.choose();
            preview.drawn(rung, 5.0);
            preview.painted(10.0, 33.0);
        }
        assert_eq!(preview.choose().0, 0, "quality comes back");
    }
}
