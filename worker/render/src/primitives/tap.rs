//! A footprint weight that is known not to be negative.

/// A weight across the view axis, not negative. Holding the value is the proof, which the unchecked
/// conversion below leans on.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(transparent)]
pub struct Tap(pub(crate) f32);

impl Tap {
    /// Makes a weight of `w`; negative numbers and NaN become zero.
    #[inline]
    pub fn new(w: f32) -> Self {
        Tap(if w > 0.0 { w } else { 0.0 })
    }

    /// Returns the weight as a number, unitless and not negative.
    #[inline(always)]
    pub fn get(self) -> f32 {
        self.0
    }
}
