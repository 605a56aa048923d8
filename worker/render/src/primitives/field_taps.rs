//! Weights of the four channels of a reconstructed field: its value, and its derivatives along x, y
//! and z.
//!
//! The kernel is a product of three profiles, so each channel is a product of three weights: of the
//! profile g along two axes, or along all three for the value, and of its slope g' along the axis
//! of the derivative. Tables keep the four weights of one pixel or plane beside each other, so that
//! one multiplication of four lanes does for all channels.

use slabcast_common::kernel::Profile;

/// Weights of the four channels along one axis: floats (per vox, and per vox^2 for the derivative)
/// and fixed point (per lattice step and per step^2, in units of 2^-15).
#[derive(Clone, Debug, Default)]
pub struct FieldTaps {
    floats: Vec<[f32; 4]>,
    fixed: Vec<[i16; 4]>,
}

/// The weight of every channel along `axis`: `slope` for that axis' derivative, else `weight`.
fn four<W: Copy>(axis: usize, weight: W, slope: W) -> [W; 4] {
    let mut four = [weight; 4];
    four[1 + axis] = slope;
    four
}

/// A weight in units of 2^-15, rounded to nearest.
fn fixed(w: f64) -> i16 {
    libm::floor(w * 32768.0 + 0.5).clamp(-32767.0, 32767.0) as i16
}

impl FieldTaps {
    /// Returns `n` weights that are all zero.
    pub(crate) fn zeros(n: usize) -> Self {
        FieldTaps { floats: vec![[0.0; 4]; n], fixed: vec![[0; 4]; n] }
    }

    /// Returns whether there is no weight.
    pub(crate) fn is_empty(&self) -> bool {
        self.floats.is_empty()
    }

    /// Returns the weights along `axis` at distance `u` (vox) from a voxel, as floats.
    pub(crate) fn float_tap(axis: usize, profile: &Profile, u: f64) -> [f32; 4] {
        four(axis, profile.at(u) as f32, profile.slope_at(u) as f32)
    }

    /// Returns the weights along `axis` at distance `u` (vox) from a voxel, in fixed point.
    pub(crate) fn fixed_tap(axis: usize, profile: &Profile, u: f64) -> [i16; 4] {
        let step = profile.spread;
        four(axis, fixed(profile.at(u) * step), fixed(profile.slope_at(u) * step * step))
    }

    /// Sets the weights at index `i`.
    pub(crate) fn put(&mut self, i: usize, axis: usize, profile: &Profile, u: f64) {
        self.floats[i] = Self::float_tap(axis, profile, u);
        self.fixed[i] = Self::fixed_tap(axis, profile, u);
    }

    /// Appends weights.
    pub(crate) fn push(&mut self, axis: usize, profile: &Profile, u: f64) {
        self.floats.push(Self::float_tap(axis, profile, u));
        self.fixed.push(Self::fixed_tap(axis, profile, u));
    }

    /// Weights as floats.
    pub(crate) fn floats(&self) -> &[[f32; 4]] {
        &self.floats
    }

    /// Weights in fixed point.
    pub(crate) fn fixed(&self) -> &[[i16; 4]] {
        &self.fixed
    }
}
