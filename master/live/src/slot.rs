//! The slot of a session: which pass is drawn next, and when. Pure; time comes in.
//!
//! A slot holds one pair, the latest view and scene. There is no queue: a newer pair replaces it.
//!
//! - At most two passes are in flight: drawn or delivered, and not acknowledged.
//! - A moving pass that was begun ends, though its pair may be old by then: under steady input each
//!   would be superseded, and nothing would ever be seen. A still is dropped as soon as it is old.
//! - A still begins when the pair is at rest, or [`REST`] after it moved last.
//! - A pair at rest that comes again and again (a key held down) is shown as if it moved, once stills
//!   were dropped for [`STARVED`].

use std::collections::VecDeque;

/// Microseconds on a clock that never goes back.
pub(crate) type Micros = u64;

/// Microseconds after the last moving input at which the still begins. At half, a still begins
/// between two movements of a slow hand and is dropped; other viewers wait for 167 ms.
const REST: Micros = 80_000;

/// Microseconds without a picture after which stills that are dropped one after another give way to a
/// moving pass.
const STARVED: Micros = 100_000;

/// Passes in flight: one is painted, one is on its way.
const IN_FLIGHT: usize = 2;

/// Numbers of a view and a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Pair {
    pub(crate) seq: u32,
    pub(crate) scene: u32,
}

/// Kind of a pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pass {
    /// Quickly drawn, lossy.
    Moving,
    /// Exact.
    Still,
}

impl Pass {
    /// The word of the protocol.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Pass::Moving => "moving",
            Pass::Still => "still",
        }
    }
}

/// Next step of a slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Begin to draw a pass.
    Begin(Pair, Pass),
    /// Drop the pass that is being drawn.
    Drop,
    /// Wait for an event, or until this time.
    Wait(Option<Micros>),
}

/// See the head of the file.
#[derive(Debug, Default)]
pub(crate) struct Slot {
    latest: Option<Pair>,
    is_moving: bool,
    changed_at: Micros,
    drawing: Option<(Pair, Pass)>,
    /// Passes that were delivered and not acknowledged.
    unpainted: VecDeque<(Pair, Pass)>,
    /// The last pass that was delivered.
    delivered: Option<(Pair, Pass)>,
    /// A pair that can't be drawn.
    failed: Option<Pair>,
    /// Time of the first dropped still since a pass was last delivered.
    dropped_since: Option<Micros>,
}

impl Slot {
    /// Takes a newer pair. `is_moving`: a hand is on it.
    pub(crate) fn change(&mut self, pair: Pair, is_moving: bool, now: Micros) {
        self.latest = Some(pair);
        self.is_moving = is_moving;
        self.changed_at = now;
    }

    /// Forgets everything but what is in flight: another volume was opened.
    pub(crate) fn clear(&mut self) {
        let (drawing, unpainted) = (self.drawing, std::mem::take(&mut self.unpainted));
        *self = Slot { drawing, unpainted, ..Slot::default() };
    }

    /// Returns what to do now. `is_slow`: a still takes so long that a moving pass should come first.
    pub(crate) fn step(&self, is_slow: bool, now: Micros) -> Step {
        let Some(latest) = self.latest else {
            return if self.drawing.is_some() { Step::Drop } else { Step::Wait(None) };
        };
        if let Some((pair, pass)) = self.drawing {
            let is_old = pair != latest;
            return if is_old && pass == Pass::Still { Step::Drop } else { Step::Wait(None) };
        }
        if self.failed == Some(latest)
            || self.delivered == Some((latest, Pass::Still))
            || self.unpainted.len() >= IN_FLIGHT
        {
            return Step::Wait(None);
        }
        let is_shown = self.delivered == Some((latest, Pass::Moving));
        let is_starved = self.dropped_since.is_some_and(|since| now >= since + STARVED);
        if !is_shown && (self.is_moving || is_slow || is_starved) {
            return Step::Begin(latest, Pass::Moving);
        }
        let rests_at = self.changed_at + REST;
        if self.is_moving && now < rests_at {
            return Step::Wait(Some(rests_at));
        }
        Step::Begin(latest, Pass::Still)
    }

    /// Notes that a pass is being drawn.
    pub(crate) fn begun(&mut self, pair: Pair, pass: Pass) {
        self.drawing = Some((pair, pass));
    }

    /// Notes that the pass that was being drawn was dropped.
    pub(crate) fn dropped(&mut self, now: Micros) {
        self.drawing = None;
        self.dropped_since.get_or_insert(now);
    }

    /// Notes that the pass that was being drawn was delivered.
    pub(crate) fn delivered(&mut self) {
        if let Some(pass) = self.drawing.take() {
            self.unpainted.push_back(pass);
            self.delivered = Some(pass);
            self.dropped_since = None;
        }
    }

    /// Notes that the pass that was being drawn can't be. Its pair is not tried again.
    pub(crate) fn failed(&mut self) {
        self.failed = self.drawing.take().map(|(pair, _)| pair);
    }

    /// Notes that a pass was painted; whoever paints one has painted or dropped those before it.
    /// Returns false if no such pass is in flight.
    pub(crate) fn painted(&mut self, pair: Pair, pass: Pass) -> bool {
        let found = self.unpainted.iter().position(|p| *p == (pair, pass));
        found.map(|i| self.unpainted.drain(..=i)).is_some()
    }

    /// Notes that a still which was delivered never left, or not whole.
    pub(crate) fn withdrawn(&mut self, pair: Pair) {
        self.unpainted.retain(|pass| *pass != (pair, Pass::Still));
    }

    /// Whether there is nothing left to draw of the latest pair.
    pub(crate) fn is_at_rest(&self) -> bool {
        self.drawing.is_none()
            && self.latest.is_none_or(|latest| {
                self.delivered == Some((latest, Pass::Still)) || self.failed == Some(latest)
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Micros = 1000;

    fn pair(seq: u32) -> Pair {
        Pair { seq, scene: 1 }
    }

    /// Draws what the slot asks for at `now`, and returns it.
    fn draw(slot: &mut Slot, now: Micros) -> Option<(Pair, Pass)> {
        let Step::Begin(pair, pass) = slot.step(false, now) else { return None };
        slot.begun(pair, pass);
        slot.delivered();
        Some((pair, pass))
    }

    #[test]
    fn latest_view_wins_and_no_view_is_queued() {
        let mut slot = Slot::default();
        assert_eq!(slot.step(false, 0), Step::Wait(None));
        slot.change(pair(1), true, 0);
        assert_eq!(slot.step(false, 0), Step::Begin(pair(1), Pass::Moving));
        slot.begun(pair(1), Pass::Moving);
        for seq in 2..=60 {
            slot.change(pair(seq), true, u64::from(seq) * MS);
            // What was begun ends: else nothing would be seen while a hand moves.
            assert_eq!(slot.step(false, u64::from(seq) * MS), Step::Wait(None));
        }
        slot.delivered();
        assert_eq!(slot.step(false, 61 * MS), Step::Begin(pair(60), Pass::Moving));
    }

    #[test]
    fn still_begins_at_rest_or_80_ms_after_the_last_movement() {
        let mut slot = Slot::default();
        slot.change(pair(1), true, 0);
        assert_eq!(draw(&mut slot, 10 * MS), Some((pair(1), Pass::Moving)));
        assert_eq!(slot.step(false, 10 * MS), Step::Wait(Some(80 * MS)));
        assert_eq!(slot.step(false, 80 * MS), Step::Begin(pair(1), Pass::Still));
        slot.change(pair(2), false, 81 * MS);
        assert_eq!(draw(&mut slot, 81 * MS), Some((pair(2), Pass::Still)));
        assert!(slot.is_at_rest());
    }

    #[test]
    fn still_is_dropped_for_a_newer_pair() {
        let mut slot = Slot::default();
        slot.change(pair(1), false, 0);
        slot.begun(pair(1), Pass::Still);
        assert_eq!(slot.step(false, MS), Step::Wait(None));
        slot.change(pair(2), true, 2 * MS);
        assert_eq!(slot.step(false, 2 * MS), Step::Drop);
        slot.dropped(2 * MS);
        assert_eq!(slot.step(false, 2 * MS), Step::Begin(pair(2), Pass::Moving));
    }

    #[test]
    fn two_passes_are_in_flight_and_the_last_still_always_comes() {
        let mut slot = Slot::default();
        let mut now = 0;
        let mut drawn = Vec::new();
        for seq in 1..=20 {
            now += 16 * MS;
            slot.change(pair(seq), true, now);
            drawn.extend(draw(&mut slot, now));
        }
        assert_eq!(
            drawn,
            [(pair(1), Pass::Moving), (pair(2), Pass::Moving)],
            "nobody acknowledged"
        );
        // The link was slow for ten seconds.
        now += 10_000 * MS;
        assert_eq!(slot.step(false, now), Step::Wait(None));
        assert!(slot.painted(pair(1), Pass::Moving));
        assert!(!slot.painted(pair(1), Pass::Moving), "twice is once");
        assert_eq!(draw(&mut slot, now), Some((pair(20), Pass::Moving)));
        assert_eq!(draw(&mut slot, now), None);
        assert!(slot.painted(pair(20), Pass::Moving), "it stands for the one before it, too");
        assert_eq!(draw(&mut slot, now), Some((pair(20), Pass::Still)));
        assert!(slot.is_at_rest());
    }

    #[test]
    fn key_that_is_held_down_is_shown_though_each_view_is_at_rest() {
        let mut slot = Slot::default();
        let mut now = 0;
        let mut moving = 0;
        for seq in 1..=40 {
            // A still takes 50 ms, and each 30 ms comes another.
            now += 30 * MS;
            slot.change(pair(seq), false, now);
            if slot.step(false, now) == Step::Drop {
                slot.dropped(now);
            }
            if let Step::Begin(pair, pass) = slot.step(false, now) {
                slot.begun(pair, pass);
                if pass == Pass::Moving {
                    moving += 1;
                    slot.delivered();
                    slot.painted(pair, pass);
                }
            }
        }
        assert!(moving >= 5, "{moving} pictures in 1.2 s");
    }

    #[test]
    fn slow_stills_are_shown_quickly_first() {
        let mut slot = Slot::default();
        slot.change(pair(1), false, 0);
        assert_eq!(slot.step(true, 0), Step::Begin(pair(1), Pass::Moving));
        slot.begun(pair(1), Pass::Moving);
        slot.delivered();
        assert_eq!(slot.step(true, MS), Step::Begin(pair(1), Pass::Still));
    }

    #[test]
    fn pair_that_can_not_be_drawn_is_not_tried_again() {
        let mut slot = Slot::default();
        slot.change(pair(1), false, 0);
        slot.begun(pair(1), Pass::Still);
        slot.failed();
        assert_eq!(slot.step(false, MS), Step::Wait(None));
        slot.change(pair(2), false, 2 * MS);
        assert_eq!(slot.step(false, 2 * MS), Step::Begin(pair(2), Pass::Still));
    }
}
