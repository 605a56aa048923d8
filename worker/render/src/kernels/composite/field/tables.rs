//! Tables of a field's transfer function: looks by value, and their integrals.

use crate::kernels::truncate;
use glam::DVec3;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::Kernel;
use slabcast_common::transfer::{Classifier, OpticalSample};
use slabcast_common::volume::{SampleKind, ValueSummary};

/// Cells of the tables over the visible values.
pub(super) const CELLS: usize = 4096;

/// Steps of the table of factors by gradient.
pub(super) const SHARES: usize = 1024;

/// Cells that a sub-step's values must span for the integral tables to be used. Within fewer the
/// transfer function is taken where the middle is; differences of f32 integrals would lose digits.
pub(super) const FEW_CELLS: f32 = 16.0;

/// Two parallel faces of the cropping box, perpendicular to a world axis.
#[derive(Debug)]
pub(super) struct CropFaces {
    /// World coordinate from the volume's centre, of index coordinates: `along . index + from`.
    pub(super) along: DVec3,
    pub(super) from: f64,
    /// Coordinates of the faces; infinite where nothing is cropped.
    pub(super) ends: [f64; 2],
}

/// Factors of the extinction by the gradient's magnitude.
#[derive(Debug)]
pub(super) struct GradientShares {
    /// Factors at equal distances from magnitude 0 on; all beyond have the last.
    pub(super) factors: Box<[f32; SHARES + 1]>,
    /// Entries for a change of value by one cell per vox.
    pub(super) per_slope: f32,
}

impl GradientShares {
    fn new(classifier: &Classifier, cells: f64) -> Option<GradientShares> {
        let steepest = classifier.steepest_gradient()?;
        let steepest = if steepest > 0.0 { steepest } else { 1.0 };
        let share = |i: usize| steepest * (i as f64 / SHARES as f64);
        let factors: Vec<f32> =
            (0..=SHARES).map(|i| classifier.gradient_factor(share(i)) as f32).collect();
        let factors = factors.try_into().unwrap_or_else(|_| unreachable!("an entry for each"));
        Some(GradientShares { factors, per_slope: (SHARES as f64 / (steepest * cells)) as f32 })
    }

    /// Factor where the value changes by `slope` cells per vox.
    pub(super) fn at(&self, slope: f32) -> f32 {
        let x = slope * self.per_slope;
        let x = if x < SHARES as f32 { x } else { SHARES as f32 };
        let i = (truncate(x) as usize).min(SHARES - 1);
        let [low, high] = [self.factors[i], self.factors[i + 1]];
        low + (high - low) * (x - i as f32)
    }
}

/// Distance of the background below the smallest code, as a share of all codes, if both the
/// smallest and the largest code are visible. It costs sums this share of their precision; a
/// constant volume needs more than nothing.
const BELOW: f64 = 1.0 / 64.0;

/// Values of a scene: how codes become sums, and what values look like.
#[derive(Debug)]
pub struct FieldScene {
    /// Code of an empty sheet: the volume's smallest code or its largest, whichever is invisible.
    /// If both are visible, it lies below the smallest.
    pub(super) background: f64,
    /// Samples along each index axis.
    pub(super) dims: [u32; 3],
    /// Length of a vox in vox of level 0.
    pub(super) coarseness: f64,
    /// The cropping box along the axes that it crops.
    pub(super) crop: Vec<CropFaces>,
    /// Smallest and largest code.
    pub(super) range: [f64; 2],
    /// Smallest and largest number that bricks hold: codes, or coefficients of an interpolating
    /// kernel, which are cut off at all codes' length beyond them.
    pub(super) ends: [f64; 2],
    /// Codes from the smallest to the largest; of a constant volume a length that is not zero.
    pub(super) span: f64,
    /// Codes of the first and the last cell's ends.
    pub(super) hull: [f64; 2],
    /// Cells between which values are visible: a visible end of the hull has no end.
    pub(super) visible: [f32; 2],
    /// Number type of what bricks hold.
    pub(super) kind: SampleKind,
    /// Extinction per vox and linear colour by cell end.
    pub(super) looks: Box<[OpticalSample; CELLS + 1]>,
    /// Integrals of extinction, and of extinction times colour, up to each cell's end, in cells.
    pub(super) integrals: Box<[OpticalSample; CELLS + 1]>,
    /// Factors of the extinction by gradient; `None` if it does not depend on it.
    pub(super) shares: Option<GradientShares>,
    /// Largest extinction per vox up to each cell's end, for a factor of 1.
    pub(super) most: Box<[f32; CELLS + 1]>,
}

impl FieldScene {
    /// Prepares the values of the scene that `spec` describes.
    pub fn new(spec: &SceneSpec, classifier: &Classifier) -> FieldScene {
        let summary = &spec.volume.summary;
        let coefficients = spec.quality.kernel == Kernel::Interpolating;
        let beyond = if coefficients { span(summary) } else { 0.0 };
        let ends = [summary.min_code - beyond, summary.max_code + beyond];
        let hull = hull(classifier, summary, ends);
        let support = classifier.support();
        let end = match support.filled(summary).intervals.first() {
            Some((lo, _)) if *lo == f64::NEG_INFINITY => summary.max_code,
            _ => summary.min_code,
        };
        // A sheet without a value gets nothing, so samples that equal the background must be
        // invisible.
        let background = match classifier.optics_at(end)[0] > 0.0 {
            true => summary.min_code - span(summary) * BELOW,
            false => end,
        };
        let code = |cell: usize| hull[0] + (hull[1] - hull[0]) * (cell as f64 / CELLS as f64);
        let looks: Vec<[f64; 4]> = (0..=CELLS).map(|c| classifier.optics_at(code(c))).collect();
        let shows = [0, CELLS].map(|cell| looks[cell][0] > 0.0);
        let visible = [
            if shows[0] { f32::NEG_INFINITY } else { 0.0 },
            if shows[1] { f32::INFINITY } else { CELLS as f32 },
        ];
        let mut integrals = vec![[0.0f64; 4]];
        for pair in looks.windows(2) {
            let mut sum = *integrals.last().expect("the first is there");
            let [a, b] = [pair[0][0], pair[1][0]];
            sum[0] += 0.5 * (a + b);
            for c in 1..4 {
                // Simpson's rule of the product of two linear functions is exact.
                let middle = (a + b) * (pair[0][c] + pair[1][c]);
                sum[c] += (a * pair[0][c] + middle + b * pair[1][c]) / 6.0;
            }
            integrals.push(sum);
        }
        let cells_of_range = span(summary) * CELLS as f64 / (hull[1] - hull[0]);
        let mut most = 0.0f64;
        let sample = |[sigma, rgb @ ..]: [f64; 4]| OpticalSample {
            sigma: sigma as f32,
            rgb: rgb.map(|c| c as f32),
        };
        let lattice = &spec.volume.lattice;
        let crop = spec.crop.iter().flat_map(|crop| {
            let world = lattice.world_from_index();
            (0..3).map(move |axis| CropFaces {
                along: world.row(axis),
                from: -world.row(axis).dot(lattice.centre_index()),
                ends: [crop.lo[axis], crop.hi[axis]],
            })
        });
        FieldScene {
            background,
            dims: lattice.dims,
            coarseness: spec.volume.coarseness(),
            crop: crop.filter(|f| f.ends.iter().any(|end| end.is_finite())).collect(),
            range: [summary.min_code, summary.max_code],
            span: span(summary),
            ends,
            hull,
            visible,
            kind: if coefficients { SampleKind::F32 } else { summary.kind },
            shares: GradientShares::new(classifier, cells_of_range),
            most: table(looks.iter().map(|look| {
                most = most.max(look[0]);
                most as f32
            })),
            looks: table(looks.iter().copied().map(sample)),
            integrals: table(integrals.into_iter().map(sample)),
        }
    }

    /// Cells of the tables for one code.
    pub(super) fn cells_per_code(&self) -> f64 {
        CELLS as f64 / (self.hull[1] - self.hull[0])
    }

    /// The sample code of a value in cells.
    pub(super) fn code(&self, value: f64) -> f64 {
        self.hull[0] + value / self.cells_per_code()
    }

    /// Largest difference of a number that bricks hold from the background.
    pub(super) fn reach(&self) -> f64 {
        let [lo, hi] = self.ends.map(|end| (end - self.background).abs());
        // All codes are one invisible one.
        if lo.max(hi) > 0.0 { lo.max(hi) } else { self.span }
    }
}

/// Codes from the smallest to the largest; of a constant volume a length that is not zero.
fn span(summary: &ValueSummary) -> f64 {
    let span = summary.max_code - summary.min_code;
    if span > 0.0 { span } else { summary.max_code.abs().max(1.0) }
}

/// A table of all cells' ends.
fn table<T: Copy>(entries: impl Iterator<Item = T>) -> Box<[T; CELLS + 1]> {
    let all: Box<[T]> = entries.collect();
    all.try_into().unwrap_or_else(|_| unreachable!("an entry for each end of a cell"))
}

/// Smallest and largest code between which a value may be visible, of those from end to end.
fn hull(classifier: &Classifier, summary: &ValueSummary, ends: [f64; 2]) -> [f64; 2] {
    let support = classifier.support();
    let (lo, hi) = match (support.intervals.first(), support.intervals.last()) {
        (Some(&(lo, _)), Some(&(_, hi))) => (lo, hi),
        _ => (summary.min_code, summary.max_code),
    };
    // The transfer function is linear between codes: of whole codes it begins to show within one.
    let beside = if summary.kind == SampleKind::F32 { 0.0 } else { 1.0 };
    let clamp = |code: f64| code.clamp(summary.min_code, summary.max_code);
    // Values beyond a visible end look like the end.
    let lo = if lo <= summary.min_code { ends[0] } else { clamp(lo - beside) };
    let hi = if hi >= summary.max_code { ends[1] } else { clamp(hi + beside) };
    if hi > lo { [lo, hi] } else { [lo, lo + span(summary)] }
}

impl FieldScene {
    /// The cell that holds a value, the first or the last for one outside, and where in it.
    pub(super) fn cell(&self, value: f32) -> (usize, f32) {
        let x = if value > 0.0 { value } else { 0.0 };
        let x = if x < CELLS as f32 { x } else { CELLS as f32 };
        let cell = (truncate(x) as usize).min(CELLS - 1);
        (cell, x - cell as f32)
    }

    /// A table between its entries.
    fn at(&self, table: &[OpticalSample; CELLS + 1], value: f32) -> [f32; 4] {
        let (cell, share) = self.cell(value);
        let [low, high] = [table[cell], table[cell + 1]].map(|s| {
            let [r, g, b] = s.rgb;
            [s.sigma, r, g, b]
        });
        [0, 1, 2, 3].map(|c| low[c] + (high[c] - low[c]) * share)
    }

    /// Mean extinction per vox, and the mean colour by extinction, of values that go from one cell
    /// to another.
    pub(super) fn between(&self, from: f32, to: f32) -> [f32; 4] {
        let rise = to - from;
        let looks = self.at(&self.looks, 0.5 * (from + to));
        if rise.abs() < FEW_CELLS {
            return looks;
        }
        let [p, q] = [from, to].map(|end| self.at(&self.integrals, end));
        let sum = q[0] - p[0];
        let mean = sum / rise;
        let mean = if mean > 0.0 { mean } else { 0.0 };
        if sum.abs() <= 1e-6 {
            return [mean, looks[1], looks[2], looks[3]];
        }
        let per_sum = 1.0 / sum;
        [mean, (q[1] - p[1]) * per_sum, (q[2] - p[2]) * per_sum, (q[3] - p[3]) * per_sum]
    }
}
