//! The kernel along one axis, written down anew.

use std::sync::Arc;

/// Nodes of the table for each standard deviation. Cubics between them miss the formula by at
/// most 2e-11 of the peak and 1e-7 of what is there (a test keeps it), a thousandth of what
/// the tolerance of the integration lets through; half as many miss by 16 times as much. At this
/// many, three axes take 26 KB and stay in the first cache. With exponentials in their place
/// `slabcast error` took a quarter longer (mri256, peer-semi, perspective; processor seconds).
const NODES_PER_STD: f64 = 160.0;

/// One axis of the kernel: `(exp(-u^2 / 2 std^2) - edge) / norm` inside the radius.
#[derive(Clone, Debug)]
pub(super) struct Profile {
    std: f64,
    pub(super) radius: f64,
    /// `1 / 2 std^2`.
    steep: f64,
    edge: f64,
    per_norm: f64,
    /// Half the integral of the Gaussian inside the radius, without edge and norm.
    half_bell: f64,
    /// The profile from the middle to the radius, with its slope times the step.
    table: Arc<[[f64; 2]]>,
    per_step: f64,
}

impl Profile {
    pub(super) fn new(std: f64, radius: f64) -> Profile {
        let steep = 0.5 / (std * std);
        let edge = libm::exp(-radius * radius * steep);
        let bell = std * (2.0 * std::f64::consts::PI).sqrt() * libm::erf(radius * steep.sqrt());
        Profile::with(std, radius, edge, 1.0 / (bell - 2.0 * radius * edge))
    }

    fn with(std: f64, radius: f64, edge: f64, per_norm: f64) -> Profile {
        let steep = 0.5 / (std * std);
        let steps = libm::ceil(radius / std * NODES_PER_STD).clamp(1.0, 1e5);
        let h = radius / steps;
        let node = |i: usize| {
            let u = i as f64 * h;
            let bell = libm::exp(-u * u * steep);
            [(bell - edge) * per_norm, -2.0 * u * steep * bell * per_norm * h]
        };
        let half_bell =
            std * (std::f64::consts::PI / 2.0).sqrt() * libm::erf(radius * steep.sqrt());
        let table = (0..=steps as usize).map(node).collect();
        Profile { std, radius, steep, edge, per_norm, half_bell, table, per_step: 1.0 / h }
    }

    /// The whole Gaussian: out to where all that is beyond, times `most`, is below 1e-9.
    pub(super) fn untruncated(&self, most: f64) -> Profile {
        let tail = |radius: f64| libm::erfc(radius * self.steep.sqrt()) * most.max(1.0);
        let mut radius = self.radius;
        while tail(radius) >= 1e-9 {
            radius += 0.01 * self.std;
        }
        let bell = self.std * (2.0 * std::f64::consts::PI).sqrt();
        Profile::with(self.std, radius, 0.0, 1.0 / bell)
    }

    #[inline]
    pub(super) fn at(&self, u: f64) -> f64 {
        let u = u.abs();
        if u >= self.radius {
            return 0.0;
        }
        let s = u * self.per_step;
        let i = s as usize;
        let t = s - i as f64;
        // Rounding may take the last place inside to the last node.
        let (Some([a, da]), Some([b, db])) = (self.table.get(i), self.table.get(i + 1)) else {
            return 0.0;
        };
        // Hermite's cubic.
        let (c, d) = (b - a - da, db + da - 2.0 * (b - a));
        a + t * (da + t * (c + (t - 1.0) * d))
    }

    /// The integral from the left edge to `u`.
    pub(super) fn integral_to(&self, u: f64) -> f64 {
        if u <= -self.radius {
            return 0.0;
        }
        let u = u.min(self.radius);
        let root = self.steep.sqrt();
        let bell =
            self.std * (std::f64::consts::PI / 2.0).sqrt() * libm::erf(u * root) + self.half_bell;
        (bell - self.edge * (u + self.radius)) * self.per_norm
    }

    /// The integral of `u` times the profile from `u` to `u + d`.
    pub(super) fn moment(&self, u: f64, d: f64) -> f64 {
        let up_to = |u: f64| {
            let u = u.clamp(-self.radius, self.radius);
            -libm::exp(-u * u * self.steep) / (2.0 * self.steep) - self.edge * u * u * 0.5
        };
        (up_to(u + d) - up_to(u)) * self.per_norm
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_the_formula() {
        for (std, radius) in [(0.6, 2.0), (0.5, 2.0), (0.7, 2.0), (0.3, 1.0), (1.9, 6.1)] {
            for p in [Profile::new(std, radius), Profile::new(std, radius).untruncated(11.0)] {
                let peak = p.at(0.0);
                let (mut off, mut share) = (0.0f64, 0.0f64);
                for i in 0..100_000 {
                    let u = p.radius * (f64::from(i) + 0.37) / 1e5;
                    let want = (libm::exp(-u * u * p.steep) - p.edge) * p.per_norm;
                    off = off.max((p.at(u) - want).abs() / peak);
                    share = share.max((p.at(u) - want).abs() / want);
                    assert_eq!(p.at(u), p.at(-u));
                }
                println!("std {std}, radius {}: {off:e} of the peak, {share:e}", p.radius);
                assert!(off < 2e-11 && share < 1e-7, "std {std}: {off:e} {share:e}");
                assert_eq!([p.at(p.radius), p.at(p.radius * 2.0)], [0.0; 2]);
            }
        }
    }

    #[test]
    fn the_whole_gaussian_leaves_nothing_out() {
        let p = Profile::new(0.6, 2.0).untruncated(11.0);
        assert!((3.6..4.5).contains(&p.radius), "{}", p.radius);
        assert!((p.integral_to(p.radius) - 1.0).abs() < 1e-10);
        let stiff = Profile::new(0.6, 2.0).untruncated(1e9);
        assert!(stiff.radius > p.radius + 1.0);
        assert!(libm::erfc(stiff.radius / (0.6 * 2f64.sqrt())) * 1e9 < 1e-9);
    }
}
