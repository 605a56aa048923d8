//! What a client may ask of a picture (quality: part of the pixels) and of the work behind it
//! (work: never changes a byte). Names are those of CONTRACTS.md, in flags, JSON and proto.

use crate::spelling::nearest;
use serde::{Deserialize, Serialize};

/// Reconstruction kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kernel {
    /// Gaussian with its edge value subtracted.
    Gaussian,
    /// Cubic B-spline: a constant field stays constant along the lattice's axes, and within 1 %
    /// from any side.
    Bspline,
    /// Tent, the linear B-spline. Sharpest, and of a constant field from a slanted side up to 39 %
    /// ripple (NUMERICS.md section 4).
    Tent,
}

/// How the sheets of a pixel are composited.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Compositing {
    /// Extinction with the neighbour-linear colour rule (NUMERICS.md section 1.2).
    Linear,
    /// Extinction, one colour inside a sheet.
    Constant,
    /// The paper's additive opacity: alphas are summed in a sheet and clamped at one.
    Paper,
}

/// How a voxel's section reaches the sheet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Splat {
    /// The footprint itself.
    Direct,
    /// A small spline deposit, filtered when the sheet closes.
    Deposit,
}

/// What the sheets add in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sums {
    /// The master decides from transfer function and quality (`Classifier::choose_sums`).
    Auto,
    /// 16-bit fixed point.
    I16,
    /// 32-bit fixed point.
    I32,
    /// 32-bit floating point, voxels in ascending order.
    F32,
}

/// The quality of a picture. Every field changes pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Quality {
    /// Sheet thickness in vox.
    pub thickness: f64,
    /// A pixel whose transmittance `1 - A` is below it is shut; 0 shuts nothing.
    pub eps: f64,
    /// Reconstruction kernel.
    pub kernel: Kernel,
    /// Standard deviation of the Gaussian, in lattice steps; other kernels have their own.
    pub std: f64,
    /// Support radius of the Gaussian, in lattice steps; other kernels have their own.
    pub radius: f64,
    /// Compositing rule.
    pub compositing: Compositing,
    /// Splat.
    pub splat: Splat,
    /// Sums; `Auto` until the master has decided.
    pub sums: Sums,
    /// Whether bricks and voxels are tested against the occlusion map. Never changes a byte.
    pub cull: bool,
    /// Whether grey scenes are drawn in two channels where that can be. Never changes a byte.
    #[serde(skip_serializing_if = "is_true")]
    pub grey: bool,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde asks so")]
fn is_true(b: &bool) -> bool {
    *b
}

impl Default for Quality {
    fn default() -> Self {
        Quality {
            thickness: 1.0,
            eps: 1.0 / 512.0,
            kernel: Kernel::Gaussian,
            std: 0.6,
            radius: 2.0,
            compositing: Compositing::Linear,
            splat: Splat::Direct,
            sums: Sums::Auto,
            cull: true,
            grey: true,
        }
    }
}

/// A value that can't be used, with the flag (or field) that carries it and what to do.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {problem}")]
pub struct InvalidField {
    /// The flag or JSON field, as the user wrote it (`thickness`, `views[3].eye`).
    pub field: String,
    /// What is wrong with it and what to do.
    pub problem: String,
}

impl InvalidField {
    /// A refusal of `field`.
    pub fn new(field: impl Into<String>, problem: impl Into<String>) -> Self {
        InvalidField { field: field.into(), problem: problem.into() }
    }
}

/// The refusal of a JSON text. An unknown key names the nearest one that there is: serde lists all of
/// them, which is long, and the one that was meant is not easily found.
pub fn json_error(whole: &str, e: &serde_json::Error) -> InvalidField {
    let said = e.to_string();
    let quoted: Vec<&str> = said.split('`').skip(1).step_by(2).collect();
    let meant = match quoted[..] {
        [wrong, ref known @ ..] if said.starts_with("unknown ") => nearest(wrong, known),
        _ => None,
    };
    let meant = meant.map(|m| format!("; did you mean `{m}`?")).unwrap_or_default();
    InvalidField::new(whole, format!("not valid: {said}{meant}"))
}

fn within(field: &str, x: f64, lo: f64, hi: f64) -> Result<(), InvalidField> {
    if x >= lo && x <= hi {
        Ok(())
    } else {
        Err(InvalidField::new(field, format!("{x} is out of range; give {lo} to {hi}")))
    }
}

impl Quality {
    /// Standard deviation and support radius of the kernel, in lattice steps.
    pub fn kernel_shape(&self) -> [f64; 2] {
        match self.kernel {
            Kernel::Gaussian => [self.std, self.radius],
            Kernel::Bspline => [(1.0f64 / 3.0).sqrt(), 2.0],
            Kernel::Tent => [(1.0f64 / 6.0).sqrt(), 1.0],
        }
    }

    /// Whether 16-bit sums have room for a sheet's ripple: not that of a tent, of a Gaussian that is
    /// narrow or wide, or of opacities that add up to more than one.
    pub fn fits_i16(&self) -> bool {
        let even = self.kernel != Kernel::Gaussian || (self.std >= 0.5 && self.radius <= 2.0);
        self.compositing != Compositing::Paper && self.kernel != Kernel::Tent && even
    }

    /// Checks ranges and names what this version does not draw yet.
    pub fn check(&self) -> Result<(), InvalidField> {
        // From vox/64 to thicker than any volume (DESIGN.md section 5).
        within("thickness", self.thickness, 1.0 / 64.0, 65536.0)?;
        within("eps", self.eps, 0.0, 0.5)?;
        // Below .4 a lattice shows through as dots (ripple over 20 %), and the head-room of the
        // integer sums (a factor of 2) would be used up; above 1 the radius cuts the bell.
        within("std", self.std, 0.4, 1.0)?;
        within("radius", self.radius, 1.0, 3.0)?;
        if self.kernel != Kernel::Gaussian {
            let d = Quality::default();
            for (field, given) in [("std", self.std != d.std), ("radius", self.radius != d.radius)]
            {
                if given {
                    return Err(InvalidField::new(
                        field,
                        "is of the `gaussian` kernel; the others have one width. Leave it out, or \
                         use `gaussian`",
                    ));
                }
            }
        }
        if self.kernel == Kernel::Tent && self.sums == Sums::I16 {
            return Err(InvalidField::new(
                "sums",
                "`i16` has no room for the ripple of the `tent` kernel; use `i32` or `auto`",
            ));
        }
        if self.splat != Splat::Direct {
            return Err(InvalidField::new(
                "splat",
                "this version draws `direct` splats only, which were faster; use them",
            ));
        }
        Ok(())
    }
}

/// Which schedule the master runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// The master decides: `region`.
    Auto,
    /// One task is one region through all depths.
    Region,
    /// The paper's: slab after slab, with a barrier.
    Slab,
}

/// Where the slabs of the slab schedule end. Never changes a byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Borders {
    /// Where the data have been passed that hide what is behind.
    #[default]
    Data,
    /// All slabs are of one thickness, as in the paper.
    Equal,
}

/// What is kept although the scene does not need it: to see what leaving it out saves. Never changes
/// a byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Keep {
    /// Voxels that nothing shows.
    pub empty: bool,
    /// Normals that nothing shades.
    pub normals: bool,
    /// Gradient magnitudes that modulate nothing.
    pub gradients: bool,
    /// Three colours of a scene that is grey: [`Quality::grey`] is off then.
    pub colours: bool,
}

/// How the work is cut. Never changes a byte.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Work {
    /// Slabs a frame is cut into.
    pub slabs: u32,
    /// Wanted ratio of macrotiles to render threads (paper section 4.3: 2 to 3).
    pub tiles_per_worker: f64,
    /// Macrotile edge in pixels (16, 32, 64, 128 or 256), or `None` for the quadtree to choose.
    pub tile: Option<u32>,
    /// Schedule.
    pub schedule: Schedule,
    /// What is kept although nothing needs it.
    pub keep: Keep,
    /// Where slabs end.
    pub borders: Borders,
    /// One pixel in 128 is drawn in thinner sheets, too, for the statistics' estimate of what the
    /// thickness costs (`region` schedule).
    pub estimate: bool,
}

impl Default for Work {
    fn default() -> Self {
        Work {
            slabs: 3,
            tiles_per_worker: 2.5,
            tile: None,
            schedule: Schedule::Auto,
            keep: Keep::default(),
            borders: Borders::default(),
            estimate: false,
        }
    }
}

impl Work {
    /// Checks ranges.
    pub fn check(&self) -> Result<(), InvalidField> {
        if !(1..=1000).contains(&self.slabs) {
            return Err(InvalidField::new(
                "slabs",
                format!("{} slabs; give 1 to 1000", self.slabs),
            ));
        }
        within("tiles-per-worker", self.tiles_per_worker, 0.1, 1000.0)?;
        if let Some(tile) = self.tile
            && !(tile.is_power_of_two() && (16..=256).contains(&tile))
        {
            return Err(InvalidField::new(
                "tile",
                format!("{tile} is not a quadtree level; give 16, 32, 64, 128, 256 or auto"),
            ));
        }
        Ok(())
    }
}
