//! The lattice that a volume's samples lie on, and its place in the world.

use glam::{DMat3, DVec3};

/// Lattice of a volume's samples: their number, spacing and place. World units are the file's (mm);
/// world axes are anatomical (RAS+) if the file has them (docs/design/contracts.md, World and
/// camera).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// Samples along the index axes i, j, k (i fastest).
    pub dims: [u32; 3],
    /// World vectors of one step along each index axis, in world units.
    pub steps: [DVec3; 3],
    /// World position of sample (0, 0, 0), in world units.
    pub origin: DVec3,
}

impl Lattice {
    /// Returns a lattice along the world axes, `spacing` world units a step, with its first sample
    /// at the world's origin.
    pub fn from_spacing(dims: [u32; 3], spacing: [f64; 3]) -> Self {
        Lattice {
            dims,
            steps: [
                DVec3::new(spacing[0], 0.0, 0.0),
                DVec3::new(0.0, spacing[1], 0.0),
                DVec3::new(0.0, 0.0, spacing[2]),
            ],
            origin: DVec3::ZERO,
        }
    }

    /// Returns the number of samples on the lattice.
    pub fn len(&self) -> usize {
        self.dims.iter().map(|&n| n as usize).product()
    }

    /// Returns whether the lattice has no sample.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the lengths of the steps along i, j, k in world units.
    pub fn spacing(&self) -> [f64; 3] {
        self.steps.map(|s| s.length())
    }

    /// Returns the length of one vox, the smallest spacing, in world units.
    pub fn vox(&self) -> f64 {
        let [a, b, c] = self.spacing();
        a.min(b).min(c)
    }

    /// Returns the matrix from index to world coordinates, without the translation by the origin.
    pub fn world_from_index(&self) -> DMat3 {
        DMat3::from_cols(self.steps[0], self.steps[1], self.steps[2])
    }

    /// Returns the matrix from index to world gradients, the argument of
    /// [`Volume::gradient`](super::Volume::gradient): the transposed inverse of `world_from_index`,
    /// scaled to vox so that no unit of length overflows it.
    ///
    /// Its numbers are rounded to f32. Gradients of integers are fractions of small numbers, and
    /// some lie just between two codes of a normal. In another unit of length the matrix has other
    /// last bits, and one gradient in 10^4 or so would flip to the next code (a test of volumes
    /// counts 44 in 5 10^5 without the rounding; two voxels make 1 % of a small picture differ).
    pub fn gradient_matrix(&self) -> DMat3 {
        let vox = self.vox();
        let m = DMat3::from_cols(self.steps[0] / vox, self.steps[1] / vox, self.steps[2] / vox);
        let m = m.inverse().transpose();
        DMat3::from_cols_array(&m.to_cols_array().map(|x| f64::from(x as f32)))
    }

    /// Returns the index coordinates of the centre of the volume's box.
    pub fn centre_index(&self) -> DVec3 {
        let [x, y, z] = self.dims.map(|n| (n as f64 - 1.0) / 2.0);
        DVec3::new(x, y, z)
    }

    /// Returns the world position of the centre of the volume's box.
    pub fn centre(&self) -> DVec3 {
        self.origin + self.world_from_index() * self.centre_index()
    }

    /// Returns the world vector from the centre of this lattice's box to the centre of the box of
    /// `other`, another level of the same volume.
    ///
    /// It is rounded to 1/65536 of a step, so that a far origin leaves no noise in it.
    pub fn to_centre_of(&self, other: &Lattice) -> DVec3 {
        let between = (other.origin - self.origin)
            + (other.world_from_index() * other.centre_index()
                - self.world_from_index() * self.centre_index());
        let steps = self.world_from_index().inverse() * between;
        self.world_from_index() * ((steps * 65536.0).round() / 65536.0)
    }

    /// Returns the largest extent of the box along an index axis, in world units. N samples count
    /// as N spacings.
    pub fn largest_extent(&self) -> f64 {
        let s = self.spacing();
        (0..3).map(|a| s[a] * self.dims[a] as f64).fold(0.0, f64::max)
    }

    /// Returns the length of the longest diagonal of the volume's box, in world units. N samples
    /// count as N spacings.
    pub fn diagonal(&self) -> f64 {
        let [a, b, c] = [0, 1, 2].map(|i| self.steps[i] * f64::from(self.dims[i]));
        [a + b + c, a + b - c, a - b + c, -a + b + c]
            .map(DVec3::length)
            .into_iter()
            .fold(0.0, f64::max)
    }

    /// Returns whether the lattice is cubic: equal spacings and right angles, to 1 part in 1000
    /// (files carry spacings rounded to some digits). The kernel of other lattices is an ellipsoid
    /// ([`crate::kernel`]).
    pub fn is_isotropic(&self) -> bool {
        let s = self.spacing();
        let vox = self.vox();
        let right = |a: DVec3, b: DVec3| a.dot(b).abs() <= 1e-3 * a.length() * b.length();
        s.iter().all(|&x| x <= vox * 1.001)
            && right(self.steps[0], self.steps[1])
            && right(self.steps[0], self.steps[2])
            && right(self.steps[1], self.steps[2])
    }

    /// Checks that the lattice can be drawn.
    ///
    /// # Errors
    /// If a dimension is zero, a number is not finite, a step has no length, two axes coincide, or
    /// spacings differ by more than a factor of 10^6.
    pub fn check(&self) -> Result<(), LatticeError> {
        let s = self.spacing();
        if self.dims.contains(&0) {
            return Err(LatticeError::ZeroDimension(self.dims));
        }
        if !self.steps.iter().all(|v| v.is_finite()) || !self.origin.is_finite() {
            return Err(LatticeError::NotFinite);
        }
        if s.iter().any(|x| x.is_infinite()) {
            return Err(LatticeError::HugeSpacing);
        }
        if s.iter().any(|&x| x <= 0.0 || !x.is_normal()) {
            return Err(LatticeError::ZeroSpacing(s));
        }
        let u = DMat3::from_cols(self.steps[0] / s[0], self.steps[1] / s[1], self.steps[2] / s[2]);
        if u.determinant().abs() < 1e-6 {
            return Err(LatticeError::Flat);
        }
        let ratio = s.iter().copied().fold(0.0, f64::max) / self.vox();
        if ratio > 1e6 {
            return Err(LatticeError::UnequalSpacings(ratio));
        }
        Ok(())
    }
}

/// Reason for which a lattice can't be drawn.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum LatticeError {
    /// An axis has no sample. Holds the dimensions.
    #[error("a dimension is zero ({0:?})")]
    ZeroDimension([u32; 3]),
    /// A step or the origin is infinite or NaN.
    #[error("spacing or origin is not finite")]
    NotFinite,
    /// A step has no length, or a denormal one. Holds the spacings in world units.
    #[error("a spacing is zero or too small ({0:?})")]
    ZeroSpacing([f64; 3]),
    /// A step is so long that its square is no number.
    #[error("a spacing is too large (above 1e154)")]
    HugeSpacing,
    /// Two index axes coincide.
    #[error("two index axes point the same way; the volume would be flat")]
    Flat,
    /// Spacings differ too much. Holds the ratio of the largest to the smallest.
    #[error("spacings differ by a factor of {0:.3e}; at most 1e6")]
    UnequalSpacings(f64),
}

impl From<LatticeError> for String {
    fn from(error: LatticeError) -> String {
        error.to_string()
    }
}
