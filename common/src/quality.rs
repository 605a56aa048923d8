//! Settings of a client for a picture ([`Quality`]) and for the work behind it ([`Work`], which
//! never changes a byte). Names are those of docs/design/contracts.md, in flags, JSON and the wire.

use crate::spelling::nearest;
use crate::volume::ValueSummary;
use serde::{Deserialize, Serialize};

/// Reconstruction kernel: the function that a voxel stands for (paper section 3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kernel {
    /// Gaussian with its edge value subtracted.
    Gaussian,
    /// Cubic B-spline: a constant field stays constant along the lattice's axes, and within 1 %
    /// from any side.
    Bspline,
    /// Cubic B-spline of coefficients instead of values: a field that passes through the samples,
    /// seen along the lattice's axes, and nearly so from any side (Unser, "Splines: a perfect fit",
    /// 1999). The sharpest; it overshoots beside edges. With [`Classify::After`] alone.
    Interpolating,
    /// Tent, the linear B-spline. Sharpest, and of a constant field from a slanted side up to 39 %
    /// ripple (docs/design/numerics.md section 4).
    Tent,
}

/// Order of classification (the transfer function) and reconstruction (the kernel).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Classify {
    /// Values are reconstructed, then classified and lit at each sample of a ray: sharp surfaces
    /// without rings (docs/design/sharp.md).
    #[default]
    After,
    /// Voxels are classified and lit, then blurred by the kernel, as in the paper (section 3).
    Before,
}

/// Rule by which the sheets of a pixel are composited.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Compositing {
    /// Extinction with the neighbour-linear colour rule (docs/design/numerics.md section 1.2).
    Linear,
    /// Extinction, one colour inside a sheet.
    Constant,
    /// The paper's additive opacity: alphas are summed in a sheet and clamped at one.
    Paper,
}

/// Way in which a voxel's section reaches its sheet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Splat {
    /// The section's footprint is added directly.
    Direct,
    /// A small spline is deposited and filtered when the sheet closes. Refused by this version.
    Deposit,
}

/// Number type in which sheets add.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sums {
    /// The master decides from transfer function and quality
    /// ([`Classifier::choose_sums`](crate::transfer::Classifier::choose_sums)).
    Auto,
    /// 16-bit fixed point.
    I16,
    /// 32-bit fixed point.
    I32,
    /// 32-bit floating point; voxels are added in ascending order.
    F32,
}

/// Quality of a picture. All fields but `cull` and `grey` change pixels; those two change only the
/// time that a picture takes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Quality {
    /// Thickness of a sheet in vox (the smallest spacing); 1/64 to 65536.
    pub thickness: f64,
    /// Termination threshold: a pixel whose transmittance `1 - A` is below it is shut. 0 shuts
    /// nothing; at most 0.5.
    pub eps: f64,
    /// Reconstruction kernel: the function that a voxel stands for.
    pub kernel: Kernel,
    /// Standard deviation of the Gaussian in lattice steps, 0.4 to 1; other kernels have one width.
    pub std: f64,
    /// Support radius of the Gaussian in lattice steps, 1 to 3; other kernels have one radius.
    pub radius: f64,
    /// Whether values are classified after or before the kernel reconstructs them. JSON of versions
    /// that only had the latter says nothing.
    #[serde(default = "before")]
    pub classify: Classify,
    /// Rule by which sheets become opacity: extinction as here, or the paper's.
    pub compositing: Compositing,
    /// Way in which the sections of a voxel reach their sheets.
    pub splat: Splat,
    /// Number type of the sums; `Auto` until the master has decided.
    pub sums: Sums,
    /// Whether bricks and voxels are tested against the occlusion map. Never changes a byte: pixels
    /// are shut either way.
    pub cull: bool,
}

fn before() -> Classify {
    Classify::Before
}

impl Default for Quality {
    /// Returns the default quality of pictures: classified after reconstruction with the cubic
    /// B-spline, planes of 2/3 vox (docs/design/sharp.md).
    fn default() -> Self {
        Quality {
            thickness: 2.0 / 3.0,
            kernel: Kernel::Bspline,
            classify: Classify::After,
            ..Quality::before()
        }
    }
}

/// A value that can't be used: the flag or field that carries it, and what to do.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {problem}")]
pub struct InvalidField {
    /// Flag or JSON field as the user wrote it (`thickness`, `views[3].eye`).
    pub field: String,
    /// Problem with the value and its remedy, one line for people.
    pub problem: String,
}

impl InvalidField {
    /// Returns the refusal of `field`, with its problem and remedy.
    pub fn new(field: impl Into<String>, problem: impl Into<String>) -> Self {
        InvalidField { field: field.into(), problem: problem.into() }
    }
}

/// Returns the refusal of a JSON text, whose name is `whole`. An unknown key names the nearest
/// known one: serde lists them all, among which the one that was meant is hard to find.
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

/// Checks that `x` lies in `lo..=hi`.
fn within(field: &str, x: f64, lo: f64, hi: f64) -> Result<(), InvalidField> {
    if x >= lo && x <= hi {
        Ok(())
    } else {
        Err(InvalidField::new(field, format!("{x} is out of range; give {lo} to {hi}")))
    }
}

impl Quality {
    /// Returns the default quality of the paper's order, classification before reconstruction: a
    /// Gaussian kernel, sheets of one vox.
    pub fn before() -> Quality {
        Quality {
            thickness: 1.0,
            eps: 1.0 / 512.0,
            kernel: Kernel::Gaussian,
            std: 0.6,
            radius: 2.0,
            classify: Classify::Before,
            compositing: Compositing::Linear,
            splat: Splat::Direct,
            sums: Sums::Auto,
            cull: true,
        }
    }

    /// Returns the default quality of an order of classification.
    pub fn of(classify: Classify) -> Quality {
        match classify {
            Classify::After => Quality::default(),
            Classify::Before => Quality::before(),
        }
    }

    /// Returns the quality in another order of classification: thickness and kernel that have the
    /// default of their order get that of the other.
    #[must_use]
    pub fn in_order(self, classify: Classify) -> Quality {
        if self.classify == classify {
            return self;
        }
        let (from, to) = (Quality::of(self.classify), Quality::of(classify));
        let thickness =
            if self.thickness == from.thickness { to.thickness } else { self.thickness };
        let kernel = if self.kernel == from.kernel { to.kernel } else { self.kernel };
        Quality { thickness, kernel, classify, ..self }
    }

    /// Returns the quality in which a volume is drawn: voxels with colours of their own are always
    /// classified before reconstruction, since no colour lies between two places of a palette.
    #[must_use]
    pub fn for_volume(self, summary: &ValueSummary) -> Quality {
        if summary.palette.is_some() { self.in_order(Classify::Before) } else { self }
    }

    /// Returns standard deviation and support radius of the kernel in lattice steps.
    pub fn kernel_shape(&self) -> [f64; 2] {
        match self.kernel {
            Kernel::Gaussian => [self.std, self.radius],
            Kernel::Bspline | Kernel::Interpolating => [(1.0f64 / 3.0).sqrt(), 2.0],
            Kernel::Tent => [(1.0f64 / 6.0).sqrt(), 1.0],
        }
    }

    /// Returns whether 16-bit sums have room for a sheet's ripple. They have none for a tent,
    /// coefficients that overshoot, a narrow or wide Gaussian, or the paper's opacities, which add
    /// up to more than one.
    pub fn fits_i16(&self) -> bool {
        let even = self.kernel != Kernel::Gaussian || (self.std >= 0.5 && self.radius <= 2.0);
        let narrow = matches!(self.kernel, Kernel::Tent | Kernel::Interpolating);
        self.compositing != Compositing::Paper && !narrow && even
    }

    /// Checks that every number of the quality is in its range.
    ///
    /// # Errors
    /// Names the first field that is out of range, has no meaning beside the kernel, or is not
    /// supported by this version.
    pub fn check(&self) -> Result<(), InvalidField> {
        // From vox/64 to thicker than any volume (docs/design/model.md section 6).
        within("thickness", self.thickness, 1.0 / 64.0, 65536.0)?;
        within("eps", self.eps, 0.0, 0.5)?;
        // Below .4 a lattice shows through as dots (ripple over 20 %), and the head-room of the
        // integer sums (a factor of 2) would be used up; above 1 the radius cuts the bell.
        within("std", self.std, 0.4, 1.0)?;
        within("radius", self.radius, 1.0, 3.0)?;
        if self.kernel != Kernel::Gaussian {
            let d = Quality::before();
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
        if self.classify == Classify::After {
            self.check_after()?;
        }
        if self.kernel == Kernel::Interpolating && self.classify == Classify::Before {
            return Err(InvalidField::new(
                "kernel",
                "`interpolating` reconstructs values; use it with `--classify after`, or `bspline`",
            ));
        }
        let rough = matches!(self.kernel, Kernel::Tent | Kernel::Interpolating);
        if rough && self.sums == Sums::I16 {
            return Err(InvalidField::new(
                "sums",
                "`i16` has no room for the ripple of the `tent` and `interpolating` kernels; use \
                 `i32` or `auto`",
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

impl Quality {
    /// Checks what classification after reconstruction asks of other fields.
    fn check_after(&self) -> Result<(), InvalidField> {
        if self.thickness > 1.0 {
            let problem = format!(
                "{} is too thick to reconstruct values from: with `--classify after` give at most \
                 1, or use `--classify before`",
                self.thickness
            );
            return Err(InvalidField::new("thickness", problem));
        }
        if self.compositing != Compositing::Linear {
            return Err(InvalidField::new(
                "compositing",
                "is a rule for voxels that are classified before they are splatted; use it with \
                 `--classify before`",
            ));
        }
        if self.sums == Sums::F32 {
            return Err(InvalidField::new(
                "sums",
                "`--classify after` adds whole numbers; use `i16`, `i32` or `auto`",
            ));
        }
        Ok(())
    }
}

/// Schedule that the master runs. The pixels are the same to the byte under each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// The master decides; today `region`.
    Auto,
    /// A task is one tile through all sheets (a region).
    Region,
    /// The paper's schedule: slab after slab, with a barrier between (section 4).
    Slab,
}

/// Rule for the ends of the slabs of the `slab` schedule. The pixels are the same to the byte under
/// each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Borders {
    /// Behind data that hide what follows.
    #[default]
    Data,
    /// All slabs are equally thick, as in the paper.
    Equal,
}

/// Data kept although the scene does not need them, to measure what leaving them out saves. Never
/// changes a byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Keep {
    /// Keep voxels that the transfer function makes invisible.
    pub empty: bool,
    /// Keep normals in an unshaded scene.
    pub normals: bool,
    /// Keep gradient magnitudes that modulate nothing.
    pub gradients: bool,
}

/// Schedule and division of the work of a job. Never changes a byte.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Work {
    /// Slabs a frame is cut into (`slab` schedule), 1 to 1000.
    pub slabs: u32,
    /// Wanted macrotiles per render *thread* (paper section 4.3: 2 to 3), 0.1 to 1000.
    pub tiles_per_worker: f64,
    /// Edge of all macrotiles in pixels (16, 32, 64, 128 or 256); `None` lets the quadtree choose.
    pub tile: Option<u32>,
    /// Schedule that the master runs: by region or by slab.
    pub schedule: Schedule,
    /// Data kept although the scene does not need them.
    pub keep: Keep,
    /// Rule for the ends of slabs, under the `slab` schedule.
    pub borders: Borders,
    /// Whether one pixel in 128 is also drawn in thinner sheets, for the statistics' estimate of
    /// the error of the thickness (`region` schedule).
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
    /// Checks that every number of the work is in its range.
    ///
    /// # Errors
    /// Names the first field that is out of range.
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
