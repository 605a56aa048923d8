//! The cropping box of a scene: nothing is drawn outside of it.

use crate::volume::Lattice;
use glam::DVec3;

/// A cropping box of one lattice. Ends are relative to the centre of the volume, in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CropBox {
    /// Lower ends along the world's axes, in world units from the volume's centre; -inf where
    /// nothing is cropped.
    pub lo: DVec3,
    /// Upper ends along the world's axes, in world units from the volume's centre; inf where
    /// nothing is cropped.
    pub hi: DVec3,
}

impl CropBox {
    /// Returns the box with every end moved outwards by `steps` steps of `lattice`.
    #[must_use]
    pub fn grown(&self, lattice: &Lattice, steps: f64) -> CropBox {
        let by = lattice.steps.iter().fold(DVec3::ZERO, |by, step| by + step.abs()) * steps;
        CropBox { lo: self.lo - by, hi: self.hi + by }
    }

    /// Returns whether the sample at index position `at` is inside, ends included.
    #[inline]
    pub fn contains(&self, lattice: &Lattice, at: [u32; 3]) -> bool {
        let from_centre = DVec3::from_array(at.map(f64::from)) - lattice.centre_index();
        let p = lattice.world_from_index() * from_centre;
        p.cmpge(self.lo).all() && p.cmple(self.hi).all()
    }
}
