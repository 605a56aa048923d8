//! Size and level of moving passes: as fine as fits into [`BUDGET_MS`]. Pure.
//!
//! Settings stand on a ladder from all detail down. What a rung takes is what it took last, or follows
//! from the nearest rung that was measured. A rung finer than the present one is tried only after
//! [`GOOD_IN_A_ROW`] passes that came in time, so that pictures do not flicker between two sharpnesses;
//! a coarser one at once.

/// Milliseconds in which a moving pass should be drawn. From the hand to the screen it takes twice as long and
/// 15 ms more: the pass before it ends first, and the browser paints.
const BUDGET_MS: f64 = 25.0;

/// Milliseconds from which on a still is shown quickly first, in a moving pass.
pub(crate) const SLOW_MS: f64 = 150.0;

/// Thickness of the sheets of moving passes, vox: the most with which values can be reconstructed. It
/// saves a tenth to a fourth of the time, and adds an error of 0.5/255 where fewer pixels add 5.
const THICKNESS: f64 = 1.0;

/// Rung of a session's first picture, before any time was measured.
const FIRST_RUNG: usize = 3;

/// If no rung fits the budget, a rung is taken whose time is at most this multiple of the quickest one's.
const HARDLY: f64 = 1.3;

/// Passes in time after which a rung that was too slow is tried again, since the machine may have been
/// busy: some 4 s of a moving hand. Twice as many after each try.
const RETRY: u32 = 120;

/// Largest number of times that [`RETRY`] is doubled.
const MOST_DOUBLED: u32 = 5;

/// Passes in time after which a finer rung is tried.
const GOOD_IN_A_ROW: u32 = 8;

/// Passes that were late after which a coarser rung is taken.
const LATE_IN_A_ROW: u32 = 2;

/// Most rungs by which a slow link makes passes coarser than the time of drawing asks for.
const MOST_PENALTY: usize = 2;

/// Level, size and quality of a pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Setting {
    /// Levels coarser than all detail.
    pub(crate) level: u32,
    /// The picture's edge is divided by this.
    divisor: f64,
    /// Thickness of a sheet, vox; `None` for that of stills.
    pub(crate) thickness: Option<f64>,
    /// Typical drawing time relative to rung 0; predicts rungs that were not measured.
    share: f64,
}

impl Setting {
    const fn moving(level: u32, divisor: f64, share: f64) -> Setting {
        Setting { level, divisor, thickness: Some(THICKNESS), share }
    }

    /// Returns the pixels of a pass of a picture of `size` pixels.
    pub(crate) fn size(&self, size: [u32; 2]) -> [u32; 2] {
        size.map(|n| ((f64::from(n) / self.divisor).ceil() as u32).max(1))
    }
}

/// All detail first. Fewer pixels come before coarser levels, which lose what is thin: of a CT's bones
/// level 0 at a half of the edge is 13/255 off, level 1 is 49 (docs/measurements/live.md).
pub(crate) const RUNGS: [Setting; 8] = [
    Setting { level: 0, divisor: 1.0, thickness: None, share: 1.0 },
    Setting::moving(0, 1.5, 0.37),
    Setting::moving(0, 2.0, 0.23),
    Setting::moving(0, 3.0, 0.16),
    Setting::moving(1, 3.0, 0.09),
    Setting::moving(1, 4.0, 0.06),
    Setting::moving(1, 6.0, 0.035),
    Setting::moving(2, 6.0, 0.02),
];

/// See the head of the file.
#[derive(Debug)]
pub(crate) struct Preview {
    /// Milliseconds that each rung took, smoothed; `None` if nobody measured it.
    took_ms: [Option<f64>; RUNGS.len()],
    /// Whether a rung has one measurement only. First passes build tables and caches that later ones reuse.
    is_once: [bool; RUNGS.len()],
    /// Milliseconds that the last still took.
    still_ms: Option<f64>,
    /// How far pictures of each rung were off the still, as a share of full scale; `None` if no still
    /// of this scene was compared.
    off: [Option<f32>; RUNGS.len()],
    rung: usize,
    good: u32,
    /// Passes within the budget since the rung was entered.
    settled: u32,
    /// Number of retries of each rung in this scene.
    tries: [u32; RUNGS.len()],
    late: u32,
    penalty: usize,
}

impl Default for Preview {
    fn default() -> Self {
        let (took_ms, is_once, off, still_ms) = Default::default();
        let (good, settled, tries, late, penalty) = Default::default();
        let rung = FIRST_RUNG;
        Preview { took_ms, is_once, still_ms, off, rung, good, settled, tries, late, penalty }
    }
}

impl Preview {
    /// Forgets how far rungs were off, and what they took, but for a first guess: another scene may take
    /// another time. `is_edited`: it changes little by little under a hand, and times go on.
    pub(crate) fn scene_changed(&mut self, is_edited: bool) {
        self.off = Default::default();
        if is_edited {
            return;
        }
        let rung = self.rung;
        for (i, took) in self.took_ms.iter_mut().enumerate() {
            if i != rung && i != 0 {
                *took = None;
            }
        }
        (self.good, self.settled, self.tries) = Default::default();
    }

    /// Returns the milliseconds that a rung should take; `None` if nothing was measured yet.
    fn predicted(&self, rung: usize) -> Option<f64> {
        let took = self.took_ms[rung];
        if took.is_some() && !self.is_once[rung] {
            return took;
        }
        let known = (0..RUNGS.len()).filter(|&i| i != rung && self.took_ms[i].is_some());
        // Those that were measured more than once, and then the nearest.
        let of = known.min_by_key(|&i| (self.is_once[i], i.abs_diff(rung)));
        let guess = of.and_then(|i| {
            let is_better = took.is_none() || !self.is_once[i];
            let scaled = self.took_ms[i].map(|ms| ms * RUNGS[rung].share / RUNGS[i].share);
            scaled.filter(|_| is_better)
        });
        match (took, guess) {
            (Some(took), Some(guess)) => Some(took.min(guess)),
            (took, guess) => took.or(guess),
        }
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
        if self.took_ms.iter().all(Option::is_none) {
            return (self.rung, RUNGS[self.rung]);
        }
        let fits = |rung: &usize| self.predicted(*rung).is_none_or(|ms| ms <= BUDGET_MS);
        let finest = (0..RUNGS.len()).find(fits).unwrap_or_else(|| self.quickest());
        let mut wanted = (finest + self.penalty).min(RUNGS.len() - 1);
        // What nobody measured is tried once: guesses from a rung that has its own overhead are too high.
        let is_slow = self.predicted(finest).is_some_and(|ms| ms > BUDGET_MS);
        if is_slow && self.good >= GOOD_IN_A_ROW && wanted > 0 && self.took_ms[wanted - 1].is_none()
        {
            wanted -= 1;
        }
        if self.penalty == 0 && wanted == self.rung && self.rung > 0 {
            let finer = self.rung - 1;
            if self.settled >= RETRY << self.tries[finer].min(MOST_DOUBLED) {
                self.tries[finer] += 1;
                self.took_ms[finer] = None;
                (self.rung, self.good, self.settled) = (finer, 0, 0);
                return (self.rung, RUNGS[self.rung]);
            }
        }
        if wanted > self.rung || self.good >= GOOD_IN_A_ROW || self.took_ms[self.rung].is_none() {
            self.good = 0;
            if wanted != self.rung {
                self.settled = 0;
            }
            self.rung = wanted;
        }
        (self.rung, RUNGS[self.rung])
    }

    /// Notes the milliseconds from the beginning of a moving pass on rung `rung` to its last pixel.
    pub(crate) fn drawn(&mut self, rung: usize, ms: f64) {
        self.took(rung, ms);
        if rung != self.rung {
            return;
        }
        let most = BUDGET_MS.max(HARDLY * self.best_ms());
        if ms > most {
            self.good = 0;
            return;
        }
        self.good += 1;
        self.settled += 1;
    }

    /// Notes the milliseconds from the beginning of a still to its last pixel.
    pub(crate) fn still_drawn(&mut self, ms: f64) {
        self.took(0, ms);
        self.still_ms = Some(ms);
    }

    fn took(&mut self, rung: usize, ms: f64) {
        let before = self.took_ms[rung].filter(|_| !self.is_once[rung]);
        self.is_once[rung] = self.took_ms[rung].is_none();
        self.took_ms[rung] = Some(before.map_or(ms, |before| 0.5 * (before + ms)));
    }

    /// Notes that a picture of rung `rung` was `off` its still, as a share of full scale.
    pub(crate) fn compared(&mut self, rung: usize, off: f32) {
        self.off[rung] = Some(off);
    }

    /// Returns how far pictures of a rung are off their stills by the last that was compared, as a
    /// share of full scale; NaN if there is none.
    pub(crate) fn off(&self, rung: usize) -> f32 {
        self.off[rung].unwrap_or(f32::NAN)
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

    /// Whether a still takes so long that it should be shown quickly first, or may take so long.
    pub(crate) fn is_slow(&self) -> bool {
        self.still_ms.is_none_or(|ms| ms > SLOW_MS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quick_scenes_move_in_all_detail() {
        let mut preview = Preview::default();
        assert!(preview.is_slow(), "nobody knows");
        for _ in 0..20 {
            let (rung, _) = preview.choose();
            preview.drawn(rung, 14.0 * RUNGS[rung].share);
        }
        preview.still_drawn(14.0);
        assert!(!preview.is_slow());
        assert_eq!(preview.choose().0, 0);
    }

    #[test]
    fn first_picture_is_small() {
        let (rung, setting) = Preview::default().choose();
        assert_eq!((rung, setting.size([512, 400])), (FIRST_RUNG, [171, 134]));
        assert_eq!(RUNGS[0].size([512, 1]), [512, 1]);
        assert_eq!(RUNGS[7].size([512, 1]), [86, 1]);
    }

    #[test]
    fn slow_scenes_move_as_finely_as_fits_and_do_not_flicker() {
        // Milliseconds of peer-semi of mri256 at 512x512.
        let takes = [1074.0, 422.0, 239.0, 183.0, 66.0, 49.0, 28.0, 12.0];
        let mut preview = Preview::default();
        let mut rungs = Vec::new();
        for _ in 0..80 {
            let (rung, _) = preview.choose();
            rungs.push(rung);
            preview.drawn(rung, takes[rung]);
        }
        preview.still_drawn(takes[0]);
        assert!(preview.is_slow());
        let settled = rungs[rungs.len() - 1];
        assert!(takes[settled] <= BUDGET_MS && takes[settled - 1] > BUDGET_MS, "{rungs:?}");
        let changes = rungs.windows(2).filter(|pair| pair[0] != pair[1]).count();
        assert!(changes <= 4, "{rungs:?}");
    }

    #[test]
    fn where_nothing_fits_coarse_passes_must_gain_something() {
        let takes = [900.0, 400.0, 200.0, 90.0, 50.0, 45.0, 44.0, 44.0];
        let mut preview = Preview::default();
        let mut last = 0;
        for _ in 0..120 {
            (last, _) = preview.choose();
            preview.drawn(last, takes[last]);
        }
        assert_eq!(last, 4, "50 ms are hardly more than 44");
    }

    #[test]
    fn slow_links_make_passes_coarser_and_good_ones_finer_again() {
        let mut preview = Preview::default();
        preview.still_drawn(10.0);
        for _ in 0..20 {
            let (rung, _) = preview.choose();
            preview.drawn(rung, 5.0);
        }
        assert_eq!(preview.choose().0, 0);
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

    #[test]
    fn rung_that_was_slow_once_is_tried_again() {
        let mut preview = Preview::default();
        let (mut last, mut slow) = (0, 0);
        let mut rungs = Vec::new();
        for pass in 0..1000 {
            (last, _) = preview.choose();
            rungs.push(last);
            // Others use the machine for a while.
            let busy = if last == 2 && pass < 100 { 4.0 } else { 1.0 };
            slow += u32::from(busy > 1.0);
            preview.drawn(last, busy * 100.0 * RUNGS[last].share);
        }
        assert!(slow > 0);
        assert_eq!(last, 2, "23 ms fit, 37 don't");
        let tried = rungs[500..].iter().filter(|&&rung| rung == 1).count();
        assert!((1..=4).contains(&tried), "tried again, and rarely: {tried}");
    }

    #[test]
    fn first_pass_of_a_rung_counts_for_little() {
        // Bricks come with the first pass.
        let mut preview = Preview::default();
        preview.drawn(FIRST_RUNG, 200.0);
        preview.still_drawn(300.0);
        let mut last = 0;
        for _ in 0..40 {
            (last, _) = preview.choose();
            preview.drawn(last, 100.0 * RUNGS[last].share);
        }
        assert_eq!(last, 2, "23 ms fit");
    }

    #[test]
    fn edits_are_shown_as_finely_as_views() {
        let mut preview = Preview::default();
        let mut last = 0;
        for edit in 0..60 {
            preview.scene_changed(true);
            (last, _) = preview.choose();
            // All bricks are cut for the first.
            let ms = if edit == 0 { 300.0 } else { 100.0 * RUNGS[last].share };
            preview.drawn(last, ms);
        }
        assert_eq!(last, 2, "23 ms fit");
        preview.scene_changed(false);
        assert_eq!(preview.choose().0, 2);
    }

    #[test]
    fn how_far_pictures_are_off_holds_for_a_scene() {
        let mut preview = Preview::default();
        assert!(preview.off(3).is_nan());
        preview.compared(3, 0.02);
        assert!(preview.off(3) == 0.02 && preview.off(2).is_nan());
        preview.scene_changed(false);
        assert!(preview.off(3).is_nan());
    }
}
