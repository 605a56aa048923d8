//! The two kernel sums of the field along a line, and their derivatives.
//!
//! A kernel has coordinates of its own, in lattice steps, in which it is a product of three equal
//! profiles ([`upright`](super::super::upright)). Lines are straight there too.

use super::FieldReference;
use glam::DVec3;

/// A line by depth z, in the kernel's own coordinates and as index.
#[derive(Clone, Copy, Debug)]
pub(super) struct Line {
    /// Own coordinates at z = 0, and their change with z.
    at: DVec3,
    pub(super) slope: DVec3,
    /// Index coordinates at z = 0, and their change with z.
    pub(super) index: DVec3,
    pub(super) step: DVec3,
    /// Whether own coordinates change along the third axis alone.
    parallel: bool,
}

/// A voxel whose kernel a line meets.
#[derive(Clone, Copy, Debug)]
pub(super) struct Near {
    /// Own coordinates of the line at z = 0 less the voxel's.
    at: DVec3,
    pub(super) code: f64,
    /// Product of the two profiles across the line, and its two derivatives. Only parallel lines
    /// use it: it is constant along them.
    across: [f64; 3],
}

impl FieldReference {
    /// The line `at + slope z` in eye coordinates.
    pub(super) fn line(&self, at: DVec3, slope: DVec3) -> Line {
        let at = self.own_from_eye * (at - self.view.eye_origin);
        let slope = self.own_from_eye * slope;
        let m = self.index_from_own;
        let parallel = slope.x == 0.0 && slope.y == 0.0;
        Line { at, slope, index: m * at, step: m * slope, parallel }
    }

    /// Finds the voxels whose kernels a line meets between two depths. It may find some more.
    pub(super) fn gather(&self, line: &Line, from: f64, to: f64, out: &mut Vec<Near>) {
        out.clear();
        let ends = [from, to].map(|z| line.index + line.step * z);
        let (lo, hi) = (ends[0].min(ends[1]) - self.reach, ends[0].max(ends[1]) + self.reach);
        // Whole numbers between, cut at the lattice's ends.
        let range = |a: usize, lo: f64, hi: f64| {
            let n = f64::from(self.dims[a]);
            libm::ceil(lo).clamp(0.0, n) as usize..(libm::floor(hi) + 1.0).clamp(0.0, n) as usize
        };
        let [nx, ny] = [0, 1].map(|a| self.dims[a] as usize);
        let m = self.own_from_index;
        let radius = self.kernel.radius;
        let own = [from, to].map(|z| line.at + line.slope * z);
        let (near, far) = (own[0].min(own[1]) - radius, own[0].max(own[1]) + radius);
        for k in range(2, lo.z, hi.z) {
            for j in range(1, lo.y, hi.y) {
                let row = m.y_axis * j as f64 + m.z_axis * k as f64;
                // Each axis of the kernel leaves a piece of the row.
                let (mut first, mut last) = (lo.x, hi.x);
                for a in 0..3 {
                    let step = m.x_axis[a];
                    let (p, q) = (near[a] - row[a], far[a] - row[a]);
                    if step.abs() > 1e-9 {
                        first = first.max((p / step).min(q / step) - 1e-6);
                        last = last.min((p / step).max(q / step) + 1e-6);
                    }
                }
                let voxels = &self.codes[(k * ny + j) * nx..][..nx];
                for i in range(0, first, last) {
                    let code = f64::from(voxels[i]);
                    if code.is_nan() {
                        continue;
                    }
                    let at = line.at - (row + m.x_axis * i as f64);
                    let mut across = [0.0; 3];
                    if line.parallel {
                        let [[x, dx], [y, dy]] = [at.x, at.y].map(|u| self.kernel.with_slope(u));
                        across = [x * y, dx * y, x * dy];
                        if across[0] <= 0.0 {
                            continue;
                        }
                    }
                    out.push(Near { at, code, across });
                }
            }
        }
    }

    /// The field at depth `z` of a line; NaN where no kernel reaches.
    #[inline]
    pub(super) fn value(&self, near: &[Near], line: &Line, z: f64) -> f64 {
        let kernel = &self.kernel;
        // Differences to any of the codes, so that a constant comes back to the bit.
        let base = near.first().map_or(f64::NAN, |v| v.code);
        let (mut all, mut sum) = (0.0, 0.0);
        for v in near {
            let mut w = kernel.at(v.at.z + line.slope.z * z);
            if w <= 0.0 {
                continue;
            }
            w *= if line.parallel {
                v.across[0]
            } else {
                let (x, y) = (v.at.x + line.slope.x * z, v.at.y + line.slope.y * z);
                kernel.at(x) * kernel.at(y)
            };
            all += w;
            sum += w * (v.code - base);
        }
        if all > 0.0 { base + sum / all } else { f64::NAN }
    }

    /// Returns the field `f = sum w v / sum w` at depth `z` of a line, and its gradient in eye axes
    /// per vox. The derivative of f is `(sum w' v - f sum w') / sum w`.
    #[inline]
    pub(super) fn with_gradient(&self, near: &[Near], line: &Line, z: f64) -> (f64, DVec3) {
        let kernel = &self.kernel;
        let base = near.first().map_or(f64::NAN, |v| v.code);
        let (mut all, mut sum) = (0.0, 0.0);
        let (mut all_slopes, mut slopes) = (DVec3::ZERO, DVec3::ZERO);
        for v in near {
            let [w, dw] = kernel.with_slope(v.at.z + line.slope.z * z);
            if w <= 0.0 {
                continue;
            }
            let [xy, dx, dy] = if line.parallel {
                v.across
            } else {
                let [x, dx] = kernel.with_slope(v.at.x + line.slope.x * z);
                let [y, dy] = kernel.with_slope(v.at.y + line.slope.y * z);
                [x * y, dx * y, x * dy]
            };
            let (code, slope) = (v.code - base, DVec3::new(dx * w, dy * w, xy * dw));
            all += xy * w;
            sum += xy * w * code;
            all_slopes += slope;
            slopes += slope * code;
        }
        if all <= 0.0 {
            return (f64::NAN, DVec3::NAN);
        }
        let f = sum / all;
        // d/d eye = (d own / d eye)^T d/d own.
        (base + f, self.own_from_eye.transpose() * ((slopes - all_slopes * f) / all))
    }
}
