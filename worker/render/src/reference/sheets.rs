//! The same sheets as the splatter's, in f64: what is left when nothing is rounded and nothing
//! shut.

use super::Reference;
use super::walk::{Near, Walk};
use slabcast_common::quality::Compositing;

impl Reference {
    /// What sheets of the view's thickness, in the quality's compositing, give at pixel (x, y)
    /// in f64 with nothing rounded and nothing shut.
    pub fn at_same_thickness(&self, x: u32, y: u32) -> [f64; 4] {
        let ray = self.ray(x, y);
        let d = self.view.thickness;
        let [gx, gy, gz] = &self.kernel;
        // A section may lie half a sheet beyond the kernel's reach from the mid-plane where
        // its footprint is.
        let mut walk = Walk::new(self, &ray, &self.sheet_looks, gz.radius + d);
        walk.reach(f64::INFINITY);
        let first = |v: &Near| libm::floor((v.z - gz.radius) / d) as i64;
        let end = |v: &Near| libm::ceil((v.z + gz.radius) / d) as i64;
        let Some(base) = walk.voxels.iter().map(first).min() else { return [0.0; 4] };
        let stop = walk.voxels.iter().map(end).max().unwrap_or(base);
        // One more in front and behind: empty neighbours for the rule.
        let n = (stop - base) as usize + 2;
        let mut sheets = vec![[0.0; 4]; n];
        // The same without the voxels that begin in the sheet: what the one in front peeks at.
        let mut peeks = sheets.clone();
        for v in &walk.voxels {
            let f = first(v);
            for k in f..end(v) {
                let middle = (k as f64 + 0.5) * d;
                if middle < ray.start {
                    continue;
                }
                let lateral = if ray.parallel {
                    1.0
                } else {
                    gx.at(v.x + ray.slope[0] * middle) * gy.at(v.y + ray.slope[1] * middle)
                };
                let from = k as f64 * d - v.z;
                let weight = lateral * (gz.integral_to(from + d) - gz.integral_to(from));
                let at = (k - base) as usize;
                for c in 0..4 {
                    sheets[at][c] += v.payload[c] * weight;
                    if k > f {
                        peeks[at][c] += v.payload[c] * weight;
                    }
                }
            }
        }
        let y = d / self.view.kernel_std.z;
        let mut pixel = [0.0; 4];
        let mut before = [0.0; 4];
        for k in 0..n - 1 {
            let closed = close(self.compositing, y, before, sheets[k], peeks[k + 1], ray.secant);
            let open = 1.0 - pixel[3];
            for c in 0..4 {
                pixel[c] += open * closed[c];
            }
            before = sheets[k];
        }
        pixel
    }
}

/// Light and opacity of one sheet (NUMERICS.md section 1.2, the paper's section 3), in f64.
/// `y`: thickness over the kernel's standard deviation along z.
fn close(
    compositing: Compositing,
    y: f64,
    before: [f64; 4],
    here: [f64; 4],
    behind: [f64; 4],
    secant: f64,
) -> [f64; 4] {
    let tau = here[0] * secant;
    if tau <= 0.0 {
        return [0.0; 4];
    }
    let a = match compositing {
        Compositing::Paper => tau.min(1.0),
        Compositing::Linear | Compositing::Constant => -libm::expm1(-tau),
    };
    let colour = |sums: [f64; 4], c: usize| if sums[0] > 0.0 { sums[c] / sums[0] } else { 0.0 };
    let (wl, wr, phi) = if compositing == Compositing::Linear {
        let (left, right) = ((0.5 + 0.2 * y).min(2.0), (0.5 - 0.07 * y).max(0.25));
        let ratio = before[0] / here[0];
        // Through the larger of the two, since ratios may be infinite.
        let share = if ratio > 1.0 {
            1.0 / (1.0 + 4e-4 / ratio / ratio)
        } else {
            ratio * ratio / (ratio * ratio + 4e-4)
        };
        let phi = if tau < 0.02 {
            let series = -1.0 / 80.0 + tau * (1.0 / 360.0 - tau / 2016.0);
            tau * tau * (-1.0 / 12.0 + tau * (1.0 / 24.0 + tau * series))
        } else {
            a / tau + a * 0.5 - 1.0
        };
        (left * share, right / (behind[0] + 0.05 * here[0]), phi)
    } else {
        (0.0, 0.0, 0.0)
    };
    let mut out = [0.0, 0.0, 0.0, a];
    for ch in 0..3 {
        let c = colour(here, ch + 1);
        let change = wl * (c - colour(before, ch + 1)) + wr * (behind[ch + 1] - c * behind[0]);
        let most = 2.0 * c.min(1.0 - c).max(0.0);
        out[ch] = c * a + change.clamp(-most, most) * phi;
    }
    out
}
