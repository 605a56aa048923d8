//! Contents that a job needs in its bricks: which voxels, and whether normals and gradients.
//!
//! Bricks are kept from job to job and from worker to worker, so a set of them has a key that says
//! what is in it. A set serves every job that needs no more.

use crate::path::{CropBox, ViewPath};
use crate::tween::Tween;
use glam::DVec3;
use sha2::{Digest, Sha256};
use slabcast_common::block_set::BlockSet;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::quality::{Classify, InvalidField, Keep, Kernel, Quality};
use slabcast_common::transfer::{Classifier, Support, TransferFunction};
use slabcast_common::value_bins::ValueBins;
use slabcast_common::volume::{Digest32, VolumeInfo};
use std::sync::Arc;

/// Index steps around a visible voxel whose voxels are stored where values are classified after
/// reconstruction. A kernel reaches two steps; measured in docs/design/sharp.md.
const HALO: u32 = 2;

/// Data that the bricks of a job must hold: visible voxels, and normals or gradients where the
/// transfer function uses them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BrickNeeds {
    /// Sample codes that are visible, so whose voxels are stored.
    pub support: Support,
    /// Whether each voxel needs its normal.
    pub normals: bool,
    /// Whether each voxel needs its gradient magnitude.
    pub gradients: bool,
    /// Voxels within this many index steps of a visible one, along each axis, are stored too: what
    /// a kernel that reconstructs values near the visible ones takes in.
    pub halo: u32,
    /// Whether bricks hold coefficients of an interpolating cubic B-spline, as 32-bit floats, in
    /// place of values.
    pub coefficients: bool,
    /// Box outside of which no voxel is stored; `None` for the whole volume.
    pub crop: Option<CropBox>,
    /// Blocks outside of which no brick is stored, since no frame shows them; `None` for the whole
    /// volume.
    pub window: Option<Arc<BlockSet>>,
}

impl BrickNeeds {
    /// Returns what one transfer function sees of the whole volume.
    pub fn for_transfer(tf: &TransferFunction, info: &VolumeInfo, quality: &Quality) -> BrickNeeds {
        let classifier = Classifier::new(tf, info, quality.compositing);
        match quality.for_volume(&info.summary).classify {
            Classify::Before => BrickNeeds {
                support: classifier.support(),
                normals: tf.shading.on,
                gradients: !tf.gradient_opacity.is_empty(),
                halo: 0,
                coefficients: false,
                crop: None,
                window: None,
            },
            Classify::After => BrickNeeds {
                support: ValueBins::of(&info.summary)
                    .rounded(&classifier.support().filled(&info.summary), &info.summary),
                normals: false,
                gradients: false,
                halo: HALO,
                coefficients: quality.kernel == Kernel::Interpolating,
                crop: None,
                window: None,
            },
        }
    }

    /// Returns the brick needs of a path: its cropping box, and the union over the transfer
    /// functions of its frames (from `tween` if there is one, else `tf`).
    ///
    /// # Errors
    /// If the box holds nothing.
    pub fn for_path(
        path: &ViewPath,
        tf: &TransferFunction,
        tween: Option<&Tween>,
        info: &VolumeInfo,
        quality: &Quality,
    ) -> Result<BrickNeeds, InvalidField> {
        let crop = path.crop.as_ref().map(|c| c.resolve(&info.lattice)).transpose()?;
        let all: Vec<&TransferFunction> = match tween {
            Some(tween) => tween.key_functions().collect(),
            None => vec![tf],
        };
        let all = all.into_iter().map(|tf| BrickNeeds::for_transfer(tf, info, quality));
        let union = all.reduce(|a, b| BrickNeeds {
            support: a.support.union(&b.support),
            normals: a.normals || b.normals,
            gradients: a.gradients || b.gradients,
            halo: a.halo.max(b.halo),
            coefficients: a.coefficients || b.coefficients,
            crop: None,
            window: None,
        });
        Ok(BrickNeeds { crop, ..union.unwrap_or_default() })
    }

    /// Returns the needs together with data kept although nothing needs them.
    #[must_use]
    pub fn with_kept(mut self, keep: Keep) -> BrickNeeds {
        if keep.empty {
            let all = (f64::NEG_INFINITY, f64::INFINITY);
            self.support = Support { intervals: vec![all], nan: true };
        }
        self.normals |= keep.normals;
        self.gradients |= keep.gradients;
        self
    }

    /// Returns the needs of a level of detail whose box has its centre at `centre`, a world vector
    /// from that of level 0, to which cropping boxes are relative.
    #[must_use]
    pub fn at_centre(mut self, centre: DVec3) -> BrickNeeds {
        self.crop = self.crop.map(|crop| CropBox { lo: crop.lo - centre, hi: crop.hi - centre });
        self
    }

    /// Returns whether voxels that nothing shows are in the bricks.
    pub fn keeps_invisible(&self) -> bool {
        self.support.nan && self.support.intervals.contains(&(f64::NEG_INFINITY, f64::INFINITY))
    }

    /// Returns whether bricks made for these needs serve a job with needs `other`. The box must be
    /// the same: voxels outside of a smaller one would be drawn. With a halo the voxels must be the
    /// same, too: those beyond it have weights that change the last bits of a field.
    pub fn covers(&self, other: &BrickNeeds) -> bool {
        if self.halo > 0 || other.halo > 0 {
            return self == other;
        }
        self.support.covers(&other.support)
            && (self.normals || !other.normals)
            && (self.gradients || !other.gradients)
            && self.crop == other.crop
            && self.window == other.window
    }

    /// Returns the key of the brick set of the volume with digest `volume`.
    pub fn set_key(&self, volume: Digest32) -> BrickSetKey {
        let mut h = Sha256::new();
        h.update(b"slabcast bricks 1");
        h.update(volume.0);
        h.update([u8::from(self.support.nan), u8::from(self.normals)]);
        for (a, b) in &self.support.intervals {
            h.update(a.to_le_bytes());
            h.update(b.to_le_bytes());
        }
        if self.gradients {
            h.update(b"gradients");
        }
        if self.halo > 0 {
            h.update(b"halo");
            h.update(self.halo.to_le_bytes());
        }
        if self.coefficients {
            h.update(b"coefficients");
        }
        if let Some(crop) = &self.crop {
            h.update(b"crop");
            for x in crop.lo.to_array().into_iter().chain(crop.hi.to_array()) {
                h.update(x.to_le_bytes());
            }
        }
        if let Some(window) = &self.window {
            h.update(b"window");
            window.words().iter().for_each(|word| h.update(word.to_le_bytes()));
        }
        BrickSetKey(Digest32(h.finalize().into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::path::Crop;
    use slabcast_common::volume::Lattice;

    #[test]
    fn brick_sets_cover_needs_that_ask_for_no_more() {
        let wanted = |lo: f64, normals, crop: Option<&str>| BrickNeeds {
            support: Support { intervals: vec![(lo, 255.0)], nan: false },
            normals,
            gradients: false,
            halo: 0,
            coefficients: false,
            window: None,
            crop: crop.map(|c| {
                let lattice = Lattice::from_spacing([9; 3], [1.0; 3]);
                c.parse::<Crop>().unwrap().resolve(&lattice).unwrap()
            }),
        };
        let all = wanted(10.0, true, None);
        assert!(all.covers(&wanted(20.0, false, None)) && all.covers(&all));
        assert!(!all.covers(&wanted(5.0, false, None)));
        assert!(!wanted(10.0, false, None).covers(&all), "normals are missing");
        let edges = BrickNeeds { gradients: true, ..all.clone() };
        assert!(edges.covers(&all) && !all.covers(&edges), "gradients are missing");
        let half = wanted(10.0, true, Some("50%:,:,:"));
        assert!(half.covers(&wanted(12.0, true, Some("50%:,:,:"))));
        assert!(!all.covers(&half) && !half.covers(&all), "a box is part of what is drawn");
        let keys = [&all, &half, &edges, &wanted(10.0, false, None), &wanted(11.0, true, None)]
            .map(|w| w.set_key(Digest32::default()));
        for i in 0..keys.len() {
            assert!(!keys[..i].contains(&keys[i]));
        }
    }
}
