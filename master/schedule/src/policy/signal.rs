//! Smoothing and switching of noisy signals.

/// Tuning (ratio): weight of a new value in a moving average. Of four frames in flight two may end
/// at once.
pub(crate) const NEW_VALUE_WEIGHT: f64 = 0.25;

/// A moving average of a ratio, in which each value weighs as much as its denominator.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct MovingRatio {
    numerator: f64,
    denominator: f64,
}

impl MovingRatio {
    /// Takes the next value, `part` of `whole`.
    pub(crate) fn add(&mut self, part: f64, whole: f64) {
        self.numerator = (1.0 - NEW_VALUE_WEIGHT) * self.numerator + part;
        self.denominator = (1.0 - NEW_VALUE_WEIGHT) * self.denominator + whole;
    }

    /// Returns the ratio; `None` before the first value.
    pub(crate) fn value(&self) -> Option<f64> {
        (self.denominator > 0.0).then(|| self.numerator / self.denominator)
    }
}

/// Turns on above one threshold and off below a lower one, and keeps each state for a while.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Hysteresis {
    /// Turns on above this.
    on: f64,
    /// Turns off below this; at most `on`.
    off: f64,
    /// Updates for which a new state is kept whatever the signal.
    hold: u32,
    is_on: bool,
    /// Updates for which the state is still kept.
    held: u32,
}

impl Hysteresis {
    /// A switch that is off, or on if `is_on`, and free to change.
    pub(crate) const fn new(on: f64, off: f64, hold: u32, is_on: bool) -> Self {
        Hysteresis { on, off, hold, is_on, held: 0 }
    }

    /// Takes the next value of the signal and returns the state.
    pub(crate) fn update(&mut self, signal: f64) -> bool {
        self.held = self.held.saturating_sub(1);
        let is_on = if self.is_on { signal >= self.off } else { signal > self.on };
        if is_on != self.is_on && self.held == 0 {
            (self.is_on, self.held) = (is_on, self.hold);
        }
        self.is_on
    }

    /// Returns the state.
    pub(crate) fn is_on(&self) -> bool {
        self.is_on
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hysteresis_ignores_signals_between_its_thresholds() {
        let mut switch = Hysteresis::new(0.6, 0.3, 0, false);
        let states = [0.5, 0.7, 0.5, 0.31, 0.29, 0.5].map(|x| switch.update(x));
        assert_eq!(states, [false, true, true, true, false, false]);
    }

    #[test]
    fn hysteresis_holds_a_new_state() {
        let mut switch = Hysteresis::new(0.5, 0.5, 3, false);
        let states = [0.9, 0.1, 0.1, 0.1, 0.9].map(|x| switch.update(x));
        assert_eq!(states, [true, true, true, false, false]);
    }
}
