//! Transfer functions: from values to colour and opacity (docs/design/contracts.md, Transfer
//! functions).

use crate::brick::Brick;
use crate::gradient::decode_magnitude;
use crate::math::linear_from_srgb;
use crate::quality::{Classify, Compositing, InvalidField, Quality, Sums, json_error};
use crate::shade::Shading;
use crate::volume::{Lattice, Palette, SampleKind, Samples, ValueSummary, VolumeInfo};
use serde::{Deserialize, Serialize};

/// Cap of the extinction per vox: 16 ln 2, an alpha of `1 - 2^-16` (docs/design/model.md section
/// 1). It is part of the definition of the picture: silhouettes grow with the logarithm of sigma,
/// so there is no limit to converge to. At 6.9 the worst alpha is 26/255 off, at 20 it is 34/255
/// off the other way (docs/design/numerics.md section 2). At coarser levels of detail it holds per
/// vox of the level: what is opaque stays so, and sums keep their range.
pub const SIGMA_MAX: f64 = 16.0 * std::f64::consts::LN_2;

/// Cap, per vox, of extinctions given per world unit. Beyond it f32 sums of squares overflow.
pub const EXTINCTION_MAX: f64 = 1e9;

/// Most points of a transfer function: a 16-bit volume has no more values.
pub const MAX_POINTS: usize = 65536;

/// Meaning of the x of a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Domain {
    /// The file's values.
    Value,
    /// 0 is the volume's smallest value, 1 its largest.
    Unit,
}

/// Meaning of the numbers of a colour.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ColorSpace {
    /// sRGB, as on screen and in ParaView.
    #[default]
    Srgb,
    /// Linear light.
    Linear,
}

/// Unit of the opacities of a transfer function.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OpacityUnit {
    /// Alpha of one vox of travel, 0 to 1. At a coarser level of detail: of one vox of level 0.
    #[default]
    AlphaPerVox,
    /// Extinction per world unit, not negative.
    Extinction,
}

/// Colour and opacity of NaN samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NanColour {
    /// Red, green and blue of NaN samples, 0 to 1, in the transfer function's colour space.
    pub color: [f64; 3],
    /// Opacity of NaN samples, in the transfer function's opacity unit.
    pub opacity: f64,
}

/// A transfer function (docs/design/contracts.md, Transfer functions). Points ascend in x; values
/// are linear between points and clamped outside; two points at one x make a step (the later one
/// holds at x).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransferFunction {
    /// Version of the transfer function format; 1 is the only one.
    pub version: u32,
    /// Meaning of the points' x: values of the file, or shares of their range.
    pub domain: Domain,
    /// Colour points `[x, r, g, b]`, ascending in x; r, g, b are 0 to 1.
    pub colors: Vec<[f64; 4]>,
    /// Opacity points `[x, opacity]`, ascending in x.
    pub opacities: Vec<[f64; 2]>,
    /// Meaning of the colours' numbers: sRGB or linear light.
    #[serde(default)]
    pub color_space: ColorSpace,
    /// Unit of the opacities: alpha per vox, or extinction per world unit.
    #[serde(default)]
    pub opacity_unit: OpacityUnit,
    /// Colour and opacity of samples that are NaN.
    #[serde(default)]
    pub nan: NanColour,
    /// Points `[gradient magnitude, factor]` that opacities are multiplied by. Magnitudes are the
    /// change of value over one vox as a share of the range; over file values, per world unit.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub gradient_opacity: Vec<[f64; 2]>,
    /// Light on the voxels.
    #[serde(default)]
    pub shading: Shading,
}

impl TransferFunction {
    /// Reads and checks the JSON of docs/design/contracts.md.
    ///
    /// # Errors
    /// If the text is not such JSON, or as [`TransferFunction::check`].
    pub fn from_json(text: &str) -> Result<Self, InvalidField> {
        let tf: TransferFunction =
            serde_json::from_str(text).map_err(|e| json_error("transfer function", &e))?;
        tf.check()?;
        Ok(tf)
    }

    /// Returns the transfer function as JSON (docs/design/contracts.md).
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("numbers and strings can be written")
    }

    /// Checks every number of the transfer function, and that its points ascend.
    ///
    /// # Errors
    /// Names the field that is out of range or unsorted.
    pub fn check(&self) -> Result<(), InvalidField> {
        let refuse = |field: String, problem: &str| Err(InvalidField::new(field, problem));
        if self.version != 1 {
            return refuse("version".into(), "this program knows version 1; set it to 1");
        }
        if self.colors.is_empty() {
            return refuse("colors".into(), "no point; give at least one [x, r, g, b]");
        }
        if self.opacities.is_empty() {
            return refuse("opacities".into(), "no point; give at least one [x, a]");
        }
        if self.colors.len() > MAX_POINTS || self.opacities.len() > MAX_POINTS {
            return refuse("colors, opacities".into(), "more than 65536 points; give fewer");
        }
        let unit = |x: f64| (0.0..=1.0).contains(&x);
        for (i, c) in self.colors.iter().enumerate() {
            if !c[0].is_finite() || !c[1..].iter().all(|&x| unit(x)) {
                return refuse(format!("colors[{i}]"), "x must be finite and r, g, b in 0 to 1");
            }
            if i > 0 && c[0] < self.colors[i - 1][0] {
                return refuse(
                    format!("colors[{i}]"),
                    "x is smaller than the one before; sort them",
                );
            }
        }
        let opacity_ok = |a: f64| match self.opacity_unit {
            OpacityUnit::AlphaPerVox => unit(a),
            OpacityUnit::Extinction => (0.0..=1e300).contains(&a),
        };
        let opacity_range = match self.opacity_unit {
            OpacityUnit::AlphaPerVox => "x must be finite and alpha in 0 to 1",
            OpacityUnit::Extinction => "x must be finite and extinction not negative",
        };
        for (i, o) in self.opacities.iter().enumerate() {
            if !o[0].is_finite() || !opacity_ok(o[1]) {
                return refuse(format!("opacities[{i}]"), opacity_range);
            }
            if i > 0 && o[0] < self.opacities[i - 1][0] {
                return refuse(
                    format!("opacities[{i}]"),
                    "x is smaller than the one before; sort them",
                );
            }
        }
        if self.gradient_opacity.len() > MAX_POINTS {
            return refuse("gradient_opacity".into(), "more than 65536 points; give fewer");
        }
        for (i, g) in self.gradient_opacity.iter().enumerate() {
            if !(g[0].is_finite() && g[0] >= 0.0 && unit(g[1])) {
                return refuse(
                    format!("gradient_opacity[{i}]"),
                    "magnitude must be finite and not negative, factor in 0 to 1",
                );
            }
            if i > 0 && g[0] < self.gradient_opacity[i - 1][0] {
                return refuse(
                    format!("gradient_opacity[{i}]"),
                    "magnitude is smaller than the one before; sort them",
                );
            }
        }
        if !opacity_ok(self.nan.opacity) || !self.nan.color.iter().all(|&x| unit(x)) {
            return refuse("nan".into(), "color must be in 0 to 1 and opacity in its unit's range");
        }
        let s = &self.shading;
        if ![s.ambient, s.diffuse, s.specular].iter().all(|&x| (0.0..=10.0).contains(&x)) {
            return refuse("shading".into(), "ambient, diffuse and specular must be 0 to 10");
        }
        if !(0.0..=10_000.0).contains(&s.power) {
            return refuse("shading.power".into(), "must be 0 to 10000");
        }
        if let crate::shade::Light::Direction(d) = s.light {
            let len2: f64 = d.iter().map(|x| x * x).sum();
            if !(1e-30..=1e30).contains(&len2) {
                return refuse("shading.light".into(), "direction must be finite and not zero");
            }
        }
        Ok(())
    }
}

/// Optical properties of a voxel: extinction and colour.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct OpticalSample {
    /// Extinction per vox of travel, capped; for [`Compositing::Paper`] alpha per vox.
    pub sigma: f32,
    /// Linear red, green and blue, 0 to 1.
    pub rgb: [f32; 3],
}

/// Converts opacity numbers of a transfer function to what voxels add to sheets.
#[derive(Clone, Copy, Debug)]
struct OpacityRule {
    unit: OpacityUnit,
    /// Length of one vox of the level that is drawn, in world units.
    vox: f64,
    /// Length of one vox of the drawn level, in vox of level 0. [`OpacityUnit::AlphaPerVox`] is per
    /// vox of level 0.
    coarseness: f64,
    compositing: Compositing,
}

impl OpacityRule {
    fn new(tf: &TransferFunction, info: &VolumeInfo, compositing: Compositing) -> OpacityRule {
        OpacityRule {
            unit: tf.opacity_unit,
            vox: info.lattice.vox(),
            coarseness: info.coarseness(),
            compositing,
        }
    }

    /// Returns the extinction per vox of the level that is drawn, capped.
    fn sigma(&self, a: f64) -> f64 {
        match self.unit {
            OpacityUnit::AlphaPerVox if a >= 1.0 => SIGMA_MAX,
            OpacityUnit::AlphaPerVox => (-libm::log1p(-a) * self.coarseness).min(SIGMA_MAX),
            OpacityUnit::Extinction => (a * self.vox).min(EXTINCTION_MAX),
        }
    }

    /// Returns what sheets add: the extinction, or the paper's alpha.
    fn payload(&self, a: f64) -> f64 {
        match self.compositing {
            Compositing::Paper => -libm::expm1(-self.sigma(a)),
            _ => self.sigma(a),
        }
    }
}

/// A transfer function made ready for one volume: a lookup table over codes where they are few.
#[derive(Clone, Debug)]
pub struct Classifier {
    /// Optical samples by code (256, or 65536 of 16 bits or a palette); empty for float volumes.
    table: Vec<OpticalSample>,
    /// `[x, r, g, b]`, linear light.
    colors: Vec<[f64; 4]>,
    opacities: Vec<[f64; 2]>,
    rule: OpacityRule,
    nan: OpticalSample,
    domain: Domain,
    summary: ValueSummary,
    payload_max: f64,
    uncapped: bool,
    /// Factor of the opacity by code of the gradient magnitude; empty if unmodulated.
    factors: Vec<f64>,
    /// Points of the opacity by gradient; empty if unmodulated.
    gradient_points: Vec<[f64; 2]>,
    /// Gradient in the points' unit of a change by the whole range of values per vox.
    gradient_per_share: f64,
}

/// Returns the value at `x` of the piecewise linear function through `points`, of which there is at
/// least one. The first number of a point is its x.
pub fn interpolate<const N: usize>(points: &[[f64; N]], x: f64) -> [f64; N] {
    // The number of points at or left of x. Where two points have one x, the later one holds.
    let after = points.partition_point(|p| p[0] <= x);
    if after == 0 {
        return points[0];
    }
    let a = points[after - 1];
    let Some(b) = points.get(after) else { return a };
    // Halves, since b - a may overflow for values near the end of f64.
    let t = (x * 0.5 - a[0] * 0.5) / (b[0] * 0.5 - a[0] * 0.5);
    std::array::from_fn(|i| a[i] * (1.0 - t) + b[i] * t)
}

/// Returns the opacity of NaN, or 0 if the volume has no NaN.
fn nan_opacity(tf: &TransferFunction, info: &VolumeInfo) -> f64 {
    if info.summary.nan > 0 { tf.nan.opacity } else { 0.0 }
}

fn largest_opacity(tf: &TransferFunction, info: &VolumeInfo) -> f64 {
    tf.opacities.iter().map(|o| o[1]).fold(nan_opacity(tf, info), f64::max)
}

impl Classifier {
    /// Returns the largest payload (extinction per vox, or the paper's alpha) that `tf` gives a
    /// voxel of a volume: [`Classifier::payload_max`] without making a table. `tf` must have passed
    /// its check.
    pub fn largest_payload(
        tf: &TransferFunction,
        info: &VolumeInfo,
        compositing: Compositing,
    ) -> f64 {
        let rule = OpacityRule::new(tf, info, compositing);
        rule.payload(largest_opacity(tf, info))
    }

    /// Makes `tf`, which passed its check, ready for a volume.
    pub fn new(tf: &TransferFunction, info: &VolumeInfo, compositing: Compositing) -> Self {
        let summary = info.summary.clone();
        let rule = OpacityRule::new(tf, info, compositing);
        let decode = |c: f64| match tf.color_space {
            ColorSpace::Srgb => linear_from_srgb(c),
            ColorSpace::Linear => c,
        };
        let largest = largest_opacity(tf, info);
        let codes = match summary.code_kind() {
            SampleKind::U8 => 256,
            SampleKind::U16 => 65536,
            SampleKind::F32 => 0,
        };
        let mut c = Classifier {
            table: Vec::new(),
            colors: tf
                .colors
                .iter()
                .map(|c| [c[0], decode(c[1]), decode(c[2]), decode(c[3])])
                .collect(),
            opacities: tf.opacities.clone(),
            rule,
            nan: OpticalSample {
                sigma: rule.payload(nan_opacity(tf, info)) as f32,
                rgb: tf.nan.color.map(|c| decode(c) as f32),
            },
            domain: tf.domain,
            summary: summary.clone(),
            payload_max: rule.payload(largest),
            uncapped: rule.sigma(largest) > SIGMA_MAX && compositing != Compositing::Paper,
            gradient_points: Vec::new(),
            gradient_per_share: 1.0,
            factors: Vec::new(),
        };
        if !tf.gradient_opacity.is_empty() {
            let (lo, hi) = info.summary.range();
            let per_share = match tf.domain {
                Domain::Unit => 1.0 / info.coarseness(),
                Domain::Value => (hi - lo) / info.lattice.vox(),
            };
            c.gradient_points.clone_from(&tf.gradient_opacity);
            c.gradient_per_share = per_share;
            c.factors = (0..=255).map(|code| c.gradient_factor(decode_magnitude(code))).collect();
        }
        c.table = match summary.palette.clone() {
            Some(palette) => c.looks_of(&palette, codes),
            None => (0..codes).map(|code| c.evaluate(code as f64)).collect(),
        };
        c
    }

    /// Returns the optical samples of codes 0 to `codes` - 1 of a palette: opacity by the colour's
    /// value, colour by the palette. Codes beyond the palette are invisible.
    fn looks_of(&self, palette: &Palette, codes: usize) -> Vec<OpticalSample> {
        let linear: Vec<f32> =
            (0..=255).map(|c| linear_from_srgb(f64::from(c) / 255.0) as f32).collect();
        let sigmas: Vec<f32> = (0..=255).map(|v| self.evaluate(f64::from(v)).sigma).collect();
        let look = |&colour: &[u8; 4]| OpticalSample {
            sigma: sigmas[usize::from(palette.value().of(colour))],
            rgb: std::array::from_fn(|c| linear[usize::from(colour[c])]),
        };
        let mut looks: Vec<OpticalSample> = palette.colours().iter().map(look).collect();
        looks.resize(codes, OpticalSample::default());
        looks
    }

    /// Converts a code that bricks hold to a code of the volume's samples: a place in the palette
    /// to the value of its colour, any other code to itself.
    #[inline]
    fn value_code(&self, code: f64) -> f64 {
        match &self.summary.palette {
            Some(palette) => f64::from(palette.value_of(code as u16)),
            None => code,
        }
    }

    /// Returns the x of the transfer function at a finite code.
    fn x_of(&self, code: f64) -> f64 {
        match self.domain {
            Domain::Value => self.summary.map.value(code),
            Domain::Unit => {
                let (lo, hi) = (self.summary.min_code, self.summary.max_code);
                let t = if hi > lo { (code - lo) / (hi - lo) } else { 0.0 };
                if self.summary.map.scale < 0.0 { 1.0 - t } else { t }
            }
        }
    }

    fn evaluate(&self, code: f64) -> OpticalSample {
        if code.is_nan() {
            return self.nan;
        }
        // Infinities are drawn as the nearest finite value.
        let x = self.x_of(code.clamp(self.summary.min_code, self.summary.max_code));
        let [_, a] = interpolate(&self.opacities, x);
        let [_, r, g, b] = interpolate(&self.colors, x);
        OpticalSample { sigma: self.rule.payload(a) as f32, rgb: [r as f32, g as f32, b as f32] }
    }

    /// Returns extinction per vox and linear colour `[sigma, r, g, b]` at a reconstructed value,
    /// given as a code that need not be whole. Codes are clamped to the volume's smallest and
    /// largest; NaN gives zeros.
    pub fn optics_at(&self, code: f64) -> [f64; 4] {
        if code.is_nan() {
            return [0.0; 4];
        }
        let x = self.x_of(code.clamp(self.summary.min_code, self.summary.max_code));
        let [_, a] = interpolate(&self.opacities, x);
        let [_, r, g, b] = interpolate(&self.colors, x);
        [self.rule.payload(a), r, g, b]
    }

    /// Returns the optical sample of sample `i` of `samples`, which are of this volume. Ignores
    /// gradients.
    ///
    /// # Panics
    /// If there is no sample `i`.
    #[inline]
    pub fn classify(&self, samples: &Samples, i: usize) -> OpticalSample {
        match samples {
            Samples::U8(v) => self.table[v[i] as usize],
            Samples::U16(v) => self.table[v[i] as usize],
            Samples::F32(v) => self.evaluate(v[i] as f64),
        }
    }

    /// Returns the optical sample of voxel `i` of a brick of this volume, modulated by its
    /// gradient.
    ///
    /// # Panics
    /// If there is no voxel `i`.
    #[inline]
    pub fn classify_voxel(&self, brick: &Brick, i: usize) -> OpticalSample {
        let look = self.classify(&brick.values, i);
        if self.factors.is_empty() { look } else { self.modulated(look, brick, i) }
    }

    fn modulated(&self, look: OpticalSample, brick: &Brick, i: usize) -> OpticalSample {
        let code = self.value_code(brick.values.code(i));
        // NaN and invisible voxels stay as they are.
        if code.is_nan() || look.sigma == 0.0 {
            return look;
        }
        let x = self.x_of(code.clamp(self.summary.min_code, self.summary.max_code));
        let [_, a] = interpolate(&self.opacities, x);
        let magnitude = brick.gradients.as_ref().map_or(0, |g| g[i]);
        let factor = self.factors[usize::from(magnitude)];
        OpticalSample { sigma: self.rule.payload(a * factor) as f32, ..look }
    }

    /// Returns the factor of opacities where the value changes by `share` of its range per vox; 1
    /// if the transfer function does not depend on gradients.
    pub fn gradient_factor(&self, share: f64) -> f64 {
        match &self.gradient_points[..] {
            [] => 1.0,
            points => interpolate(points, share * self.gradient_per_share)[1],
        }
    }

    /// Returns the steepest gradient that the transfer function has a point for, as a share of the
    /// values' range per vox; `None` if it does not depend on gradients.
    pub fn steepest_gradient(&self) -> Option<f64> {
        let last = self.gradient_points.last()?[0] / self.gradient_per_share;
        Some(if last.is_finite() { last } else { 0.0 })
    }

    /// Returns whether gradients modulate opacities. A code alone does not determine the optical
    /// sample then.
    pub fn is_modulated(&self) -> bool {
        !self.factors.is_empty()
    }

    /// Returns [`Classifier::classify`] of a sample's bits ([`Samples::write_bits`]).
    #[inline]
    pub fn classify_bits(&self, bits: u32) -> OpticalSample {
        if self.table.is_empty() {
            return self.evaluate(f64::from(f32::from_bits(bits)));
        }
        self.table[bits as usize]
    }

    /// Returns the optical samples by code of an 8-bit (256) or 16-bit (65536) volume; empty for
    /// floats.
    pub fn table(&self) -> &[OpticalSample] {
        &self.table
    }

    /// Returns the largest extinction per vox (or alpha, for the paper's compositing) of any value.
    pub fn payload_max(&self) -> f64 {
        self.payload_max
    }

    /// Returns whether an extinction beyond [`SIGMA_MAX`] occurs; sums must be f32 then.
    pub fn is_uncapped(&self) -> bool {
        self.uncapped
    }

    /// Estimates the largest error in 1/255 of a picture whose sheets of `thickness` vox add 16-bit
    /// integers, where rays travel `depth` vox through the volume. For a largest extinction s and a
    /// faintest occurring one f, per vox, it is
    ///
    /// ```text
    /// s (0.25 sqrt(thickness) + 0.006 min(depth, 1 / f))
    /// ```
    ///
    /// (docs/design/numerics.md section 3; fitted to real volumes, not a bound.) Faint samples are
    /// rounded most, and the same way sheet after sheet, until little is seen of what is behind.
    pub fn i16_error_estimate(&self, thickness: f64, depth: f64) -> f64 {
        let seen = self.faintest().map_or(depth, |f| depth.min(1.0 / f));
        self.payload_max * (0.25 * thickness.sqrt() + 0.006 * seen)
    }

    /// Returns the smallest extinction above zero, per vox, that occurs in the volume; `None` where
    /// table and histogram do not tell it.
    fn faintest(&self) -> Option<f64> {
        if self.table.is_empty() || self.is_modulated() {
            return None;
        }
        let occurs = |code: usize| {
            let code = self.value_code(code as f64);
            let range = self.summary.min_code..=self.summary.max_code;
            range.contains(&code) && self.summary.histogram[self.summary.bin(code)] > 0
        };
        let seen = self.table.iter().enumerate().filter(|(code, l)| l.sigma > 0.0 && occurs(*code));
        seen.map(|(_, l)| f64::from(l.sigma)).min_by(f64::total_cmp)
    }

    /// Chooses the number type of the sums from `quality` and the volume's `lattice`.
    ///
    /// An explicit request is kept. `Auto` gives floats where extinctions are not capped; 16-bit
    /// integers where they have room ([`Quality::fits_i16`]) and their [estimated
    /// error](Classifier::i16_error_estimate) is at most twice what the cut-off may cost (1/255 at
    /// the default eps of 1/512, and never more than three); else 32-bit integers. Sheets thinner
    /// than a vox are meant to be nearer to the limit: their allowance is multiplied by the square
    /// of their thickness.
    ///
    /// # Errors
    /// If integers are requested that can't hold the extinction.
    pub fn choose_sums(&self, quality: &Quality, lattice: &Lattice) -> Result<Sums, InvalidField> {
        let d = quality.thickness;
        let enough = (2.0 * 255.0 * quality.eps).min(3.0) * (d * d).min(1.0);
        let depth = lattice.diagonal() / lattice.vox();
        if quality.classify == Classify::After {
            // Sums hold values: 16 bits round them by some 1/4000 of all codes.
            let support = self.support();
            let visible = match (support.intervals.first(), support.intervals.last()) {
                (Some(first), Some(last)) => last.1.min(self.summary.max_code) - first.0,
                _ => f64::INFINITY,
            };
            let narrow = visible * 16.0 < self.summary.max_code - self.summary.min_code;
            return Ok(match quality.sums {
                Sums::Auto if quality.fits_i16() && !narrow => Sums::I16,
                Sums::Auto => Sums::I32,
                sums => sums,
            });
        }
        match quality.sums {
            Sums::Auto if self.uncapped => Ok(Sums::F32),
            Sums::Auto if quality.fits_i16() && self.i16_error_estimate(d, depth) <= enough => {
                Ok(Sums::I16)
            }
            Sums::Auto => Ok(Sums::I32),
            Sums::I32 | Sums::I16 if self.uncapped => Err(InvalidField::new(
                "sums",
                "this transfer function's extinction needs `f32`; use it or `auto`",
            )),
            sums => Ok(sums),
        }
    }

    /// Returns which codes are relevant (extinction above zero).
    pub fn support(&self) -> Support {
        let mut intervals: Vec<(f64, f64)> = Vec::new();
        let nan = self.nan.sigma > 0.0;
        if !self.table.is_empty() {
            for (code, look) in self.table.iter().enumerate() {
                if look.sigma > 0.0 {
                    let c = code as f64;
                    match intervals.last_mut() {
                        Some((_, hi)) if *hi == c - 1.0 => *hi = c,
                        _ => intervals.push((c, c)),
                    }
                }
            }
            return Support { intervals, nan };
        }
        // Floats: closed intervals of x between and outside the points, mapped back to codes.
        // They may hold an end at which the extinction is zero; such voxels add nothing.
        let (lo, hi) = (self.summary.min_code, self.summary.max_code);
        let code_of = |x: f64| match self.domain {
            Domain::Value => (x - self.summary.map.offset) / self.summary.map.scale,
            Domain::Unit if self.summary.map.scale < 0.0 => hi - x * (hi - lo),
            Domain::Unit => lo + x * (hi - lo),
        };
        let p = &self.opacities;
        let mut add = |a: f64, b: f64| {
            let (a, b) = (code_of(a), code_of(b));
            // Outward by an f32 step, so that rounding never loses a voxel.
            let (a, b) = (a.min(b), a.max(b));
            let grow = |x: f64| x.abs() * 1e-6 + f64::from(f32::MIN_POSITIVE);
            intervals.push(((a - grow(a)).max(lo), (b + grow(b)).min(hi)));
        };
        if p[0][1] > 0.0 {
            add(-1e308, p[0][0]);
        }
        for w in p.windows(2) {
            if w[0][1] > 0.0 || w[1][1] > 0.0 {
                add(w[0][0], w[1][0]);
            }
        }
        if p[p.len() - 1][1] > 0.0 {
            add(p[p.len() - 1][0], 1e308);
        }
        intervals.retain(|(a, b)| a <= b);
        intervals.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut merged: Vec<(f64, f64)> = Vec::new();
        for (a, b) in intervals {
            match merged.last_mut() {
                Some((_, hi)) if a <= *hi => *hi = hi.max(b),
                _ => merged.push((a, b)),
            }
        }
        Support { intervals: merged, nan }
    }
}

/// The codes that a transfer function makes visible, which decide which voxels are stored.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Support {
    /// Closed intervals of codes, ascending and disjoint.
    pub intervals: Vec<(f64, f64)>,
    /// Whether NaN samples are visible.
    pub nan: bool,
}

impl Support {
    /// Returns whether a code is relevant. Infinities count as the nearest finite code.
    #[inline]
    pub fn contains(&self, code: f64) -> bool {
        if code.is_nan() {
            return self.nan;
        }
        if code.is_infinite() {
            let end = if code > 0.0 { self.intervals.last() } else { self.intervals.first() };
            return end.is_some();
        }
        self.intervals.iter().any(|&(a, b)| a <= code && code <= b)
    }

    /// Returns the codes that must be stored where values are classified after reconstruction: from
    /// the smallest visible code up, or from the largest down, whichever holds fewer of the samples
    /// that `summary` counts. Codes between two visible ones are in it: without them the field
    /// would fade to the smallest code through the lower one and draw a surface that is not
    /// there. NaN is never in it.
    #[must_use]
    pub fn filled(&self, summary: &ValueSummary) -> Support {
        let (Some(&(lo, _)), Some(&(_, hi))) = (self.intervals.first(), self.intervals.last())
        else {
            return Support::default();
        };
        let (first, last) =
            (summary.bin(lo.max(summary.min_code)), summary.bin(hi.min(summary.max_code)));
        let below: u64 = summary.histogram[..first].iter().sum();
        let above: u64 = summary.histogram[last + 1..].iter().sum();
        let interval = if above > below { (f64::NEG_INFINITY, hi) } else { (lo, f64::INFINITY) };
        Support { intervals: vec![interval], nan: false }
    }

    /// Returns whether every code of `other` is relevant here too.
    pub fn covers(&self, other: &Support) -> bool {
        (self.nan || !other.nan)
            && other
                .intervals
                .iter()
                .all(|o| self.intervals.iter().any(|s| s.0 <= o.0 && o.1 <= s.1))
    }

    /// Returns the codes that are relevant in either support.
    #[must_use]
    pub fn union(&self, other: &Support) -> Support {
        let mut all: Vec<(f64, f64)> =
            self.intervals.iter().chain(&other.intervals).copied().collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut intervals: Vec<(f64, f64)> = Vec::new();
        for (a, b) in all {
            match intervals.last_mut() {
                Some((_, hi)) if a <= *hi => *hi = hi.max(b),
                _ => intervals.push((a, b)),
            }
        }
        Support { intervals, nan: self.nan || other.nan }
    }
}

#[cfg(test)]
mod tests;
