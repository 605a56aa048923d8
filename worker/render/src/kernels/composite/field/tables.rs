//! Tables of a field's transfer function: looks by value, and their integrals.

use crate::kernels::truncate;
use slabcast_common::message::SceneSpec;
use slabcast_common::transfer::{Classifier, OpticalSample};
use slabcast_common::volume::{SampleKind, ValueSummary};

/// Cells of the tables over the visible values.
pub(super) const CELLS: usize = 4096;

/// Cells that a sub-step's values must span for the integral tables to be used. Within fewer the
/// transfer function is taken where the middle is; differences of f32 integrals would lose digits.
pub(super) const FEW_CELLS: f32 = 16.0;

/// Values of a scene: how codes become sums, and what values look like.
#[derive(Debug)]
pub struct FieldScene {
    /// Code of which a sheet holds nothing: the smallest code of the volume, or the largest.
    pub(super) background: f64,
    /// Smallest and largest code.
    pub(super) range: [f64; 2],
    /// Codes of the first and the last cell's ends.
    pub(super) hull: [f64; 2],
    /// Cells between which values are visible: a visible end of the hull has no end.
    pub(super) visible: [f32; 2],
    pub(super) kind: SampleKind,
    /// Extinction per vox and linear colour by cell end.
    pub(super) looks: Box<[OpticalSample; CELLS + 1]>,
    /// Integrals of extinction, and of extinction times colour, up to each cell's end, in cells.
    pub(super) integrals: Box<[OpticalSample; CELLS + 1]>,
    /// Largest extinction per vox up to each cell's end.
    pub(super) most: Box<[f32; CELLS + 1]>,
}

impl FieldScene {
    /// Prepares the values of the scene that `spec` describes.
    pub fn new(spec: &SceneSpec, classifier: &Classifier) -> FieldScene {
        let summary = &spec.volume.summary;
        let support = classifier.support();
        let background = match support.filled(summary).intervals.first() {
            Some((lo, _)) if *lo == f64::NEG_INFINITY => summary.max_code,
            _ => summary.min_code,
        };
        let hull = hull(classifier, summary);
        let code = |cell: usize| hull[0] + (hull[1] - hull[0]) * (cell as f64 / CELLS as f64);
        let looks: Vec<[f64; 4]> = (0..=CELLS).map(|c| classifier.optics_at(code(c))).collect();
        let ends = [0, CELLS].map(|cell| looks[cell][0] > 0.0);
        let visible = [
            if ends[0] { f32::NEG_INFINITY } else { 0.0 },
            if ends[1] { f32::INFINITY } else { CELLS as f32 },
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
        let mut most = 0.0f64;
        let sample = |[sigma, rgb @ ..]: [f64; 4]| OpticalSample {
            sigma: sigma as f32,
            rgb: rgb.map(|c| c as f32),
        };
        FieldScene {
            background,
            range: [summary.min_code, summary.max_code],
            hull,
            visible,
            kind: summary.kind,
            most: table(looks.iter().map(|look| {
                most = most.max(look[0]);
                most as f32
            })),
            looks: table(looks.iter().copied().map(sample)),
            integrals: table(integrals.into_iter().map(sample)),
        }
    }

    /// Codes from the smallest to the largest.
    pub(super) fn span(&self) -> f64 {
        (self.range[1] - self.range[0]).max(f64::MIN_POSITIVE)
    }
}

/// A table of all cells' ends.
fn table<T: Copy>(entries: impl Iterator<Item = T>) -> Box<[T; CELLS + 1]> {
    let all: Box<[T]> = entries.collect();
    all.try_into().unwrap_or_else(|_| unreachable!("an entry for each end of a cell"))
}

/// Smallest and largest code between which a value may be visible.
fn hull(classifier: &Classifier, summary: &ValueSummary) -> [f64; 2] {
    let support = classifier.support();
    let (lo, hi) = match (support.intervals.first(), support.intervals.last()) {
        (Some(&(lo, _)), Some(&(_, hi))) => (lo, hi),
        _ => (summary.min_code, summary.max_code),
    };
    // The transfer function is linear between codes: of whole codes it begins to show within one.
    let beside = if summary.kind == SampleKind::F32 { 0.0 } else { 1.0 };
    let clamp = |code: f64| code.clamp(summary.min_code, summary.max_code);
    let [lo, hi] = [clamp(lo - beside), clamp(hi + beside)];
    if hi > lo { [lo, hi] } else { [lo, lo + 1.0] }
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
