//! The cropping box: outside of it nothing is computed, stored or sent.
//!
//! Ends lie along the world's axes, in world units or as shares of the volume's box. A sample
//! belongs to the picture if its centre is inside, ends included. Voxels that are cut away still
//! count for the gradients at the cut, which are those of the data.

use glam::DVec3;
use serde::{Deserialize, Serialize};
pub use slabcast_common::crop::CropBox;
use slabcast_common::quality::InvalidField;
use slabcast_common::volume::Lattice;

/// Unit of the numbers of a [`Crop`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CropUnit {
    /// World coordinates (mm).
    #[default]
    World,
    /// 0 and 1 are the ends of the volume's box along that world axis.
    Unit,
}

/// A cropping box. A missing end does not crop.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Crop {
    /// Unit of the ends: world units, or shares of the volume's box.
    pub unit: CropUnit,
    /// Lower and upper end along the world's x axis, in `unit`; `None` does not crop.
    pub x: [Option<f64>; 2],
    /// Lower and upper end along the world's y axis, in `unit`; `None` does not crop.
    pub y: [Option<f64>; 2],
    /// Lower and upper end along the world's z axis, in `unit`; `None` does not crop.
    pub z: [Option<f64>; 2],
}

impl Crop {
    /// Checks the ends of the box as far as that needs no lattice.
    ///
    /// # Errors
    /// Names the axis whose ends are not finite or not ascending.
    pub fn check(&self) -> Result<(), InvalidField> {
        for (name, [from, to]) in [("x", self.x), ("y", self.y), ("z", self.z)] {
            let refuse = |problem: &str| Err(InvalidField::new(format!("crop.{name}"), problem));
            if [from, to].iter().flatten().any(|x| !x.is_finite()) {
                return refuse("must be finite numbers; leave an end out that does not crop");
            }
            if let (Some(from), Some(to)) = (from, to)
                && from >= to
            {
                return refuse(&format!("goes from {from} to {to}; the first must be smaller"));
            }
        }
        Ok(())
    }

    /// Returns the box for a volume on `lattice`.
    ///
    /// # Errors
    /// If an end is not valid ([`Crop::check`]), or no sample can lie inside.
    pub fn resolve(&self, lattice: &Lattice) -> Result<CropBox, InvalidField> {
        self.check()?;
        // Relative to the centre, as everything is: a far-away origin changes no bit.
        let half = (0..3).fold(DVec3::ZERO, |sum, a| {
            sum + lattice.steps[a].abs() * (f64::from(lattice.dims[a]) / 2.0)
        });
        let centre = lattice.centre();
        let mut ends = [DVec3::ZERO; 2];
        for (a, [from, to]) in [self.x, self.y, self.z].into_iter().enumerate() {
            let place = |end: Option<f64>, whole: f64| match (end, self.unit) {
                (None, _) => whole,
                (Some(x), CropUnit::World) => x - centre[a],
                (Some(t), CropUnit::Unit) => (2.0 * t - 1.0) * half[a],
            };
            ends[0][a] = place(from, f64::NEG_INFINITY);
            ends[1][a] = place(to, f64::INFINITY);
            if ends[0][a] > half[a] || ends[1][a] < -half[a] {
                return Err(InvalidField::new(
                    format!("crop.{}", ["x", "y", "z"][a]),
                    format!(
                        "lies outside of the volume, which goes from {} to {} there",
                        centre[a] - half[a],
                        centre[a] + half[a]
                    ),
                ));
            }
        }
        Ok(CropBox { lo: ends[0], hi: ends[1] })
    }
}

impl std::str::FromStr for Crop {
    type Err = String;

    /// Reads `-40:40,:,0:90`, or in shares `0%:50%,:,:`.
    fn from_str(text: &str) -> Result<Crop, String> {
        let bad = || {
            format!(
                "`{text}` is not a box; give FROM:TO for x, y and z, as in -40:40,:,0: (mm) or \
                 50%:,:,:90% (shares); an empty end does not crop"
            )
        };
        let axes: Vec<&str> = text.split(',').collect();
        let [x, y, z] = axes[..] else { return Err(bad()) };
        let (mut numbers, mut shares) = (0, 0);
        let mut end = |text: &str| -> Result<Option<f64>, String> {
            let text = text.trim();
            if text.is_empty() {
                return Ok(None);
            }
            numbers += 1;
            let (digits, scale) = match text.strip_suffix('%') {
                Some(digits) => {
                    shares += 1;
                    (digits, 0.01)
                }
                None => (text, 1.0),
            };
            let x: f64 = digits.trim().parse().map_err(|_| bad())?;
            Ok(Some(x * scale))
        };
        let mut axis = |text: &str| -> Result<[Option<f64>; 2], String> {
            let (from, to) = text.split_once(':').ok_or_else(bad)?;
            Ok([end(from)?, end(to)?])
        };
        let (x, y, z) = (axis(x)?, axis(y)?, axis(z)?);
        if shares != 0 && shares != numbers {
            return Err(format!(
                "`{text}` mixes mm and shares; give % for all numbers or for none"
            ));
        }
        let unit = if shares > 0 { CropUnit::Unit } else { CropUnit::World };
        let crop = Crop { unit, x, y, z };
        crop.check().map_err(|e| e.problem)?;
        Ok(crop)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crop_box_contains_samples_between_its_ends() {
        // Centre of the samples at (10 + 1.5, 0 + 3, 0 + 1): a box of cells from 9.5 to 13.5.
        let mut l = Lattice::from_spacing([4, 4, 3], [1.0, 2.0, 1.0]);
        l.origin.x = 10.0;
        let inside = |text: &str| {
            let b = text.parse::<Crop>().unwrap().resolve(&l).unwrap();
            let all = (0..48u32).map(|i| [i % 4, i / 4 % 4, i / 16]);
            all.filter(|&at| b.contains(&l, at)).count()
        };
        assert_eq!(inside(":,:,:"), 48);
        assert_eq!(inside("11:12,:,:"), 2 * 12, "ends are inside");
        assert_eq!(inside("11.1:,:,:"), 2 * 12);
        assert_eq!(inside("50%:,:,:"), 2 * 12);
        assert_eq!(inside(":,0:3,:"), 2 * 12);
        assert_eq!(inside(":,:,0%:33%"), 16);
        assert!("14:,:,:".parse::<Crop>().unwrap().resolve(&l).unwrap_err().field == "crop.x");
    }

    #[test]
    fn crop_errors_say_how_to_write_a_box() {
        for (text, says) in [
            ("1:2,3:4", "FROM:TO"),
            ("a:b,:,:", "FROM:TO"),
            ("5:1,:,:", "smaller"),
            ("10%:20,:,:", "mixes"),
            ("nan:,:,:", "finite"),
            ("1,2,3", "FROM:TO"),
        ] {
            let e = text.parse::<Crop>().unwrap_err();
            assert!(e.contains(says), "{text}: {e}");
        }
    }

    #[test]
    fn crop_box_does_not_depend_on_the_origin() {
        let l = Lattice::from_spacing([9; 3], [1.0; 3]);
        let far = Lattice { origin: DVec3::splat(1e7), ..l };
        let crop = Crop { unit: CropUnit::Unit, x: [Some(0.25), None], ..Crop::default() };
        assert_eq!(crop.resolve(&l).unwrap(), crop.resolve(&far).unwrap());
    }
}
