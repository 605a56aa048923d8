//! The kernel along one axis, written down anew.

use slabcast_common::quality::Kernel;
use std::sync::Arc;

/// Nodes of the table for each standard deviation. Cubics between them miss the formula by at
/// most 2e-11 of the peak and 1e-7 of what is there (a test keeps it), a thousandth of what
/// the tolerance of the integration lets through; half as many miss by 16 times as much. At this
/// many, three axes take 26 KB and stay in the first cache. With exponentials in their place
/// `slabcast lab error` took a quarter longer (mri256, peer-semi, perspective; processor seconds).
const NODES_PER_STD: f64 = 160.0;

/// Kernel along one axis, in f64, tabulated from its middle to its radius.
#[derive(Clone, Debug)]
pub struct Profile {
    /// Support radius in vox: the profile is zero beyond it.
    pub radius: f64,
    /// Formula of the profile, from which integrals come.
    pub form: Form,
    /// The profile from the middle to the radius, with its slope times the step.
    table: Arc<[[f64; 2]]>,
    per_step: f64,
}

/// Formula of a kernel's profile along one axis.
#[derive(Clone, Copy, Debug)]
pub enum Form {
    /// `(exp(-u^2 / 2 std^2) - edge) / norm` inside the radius.
    Gaussian(Gaussian),
    /// A spline: its pieces are cubics or lines, of which a table's cells hold one each.
    Pieces,
}

/// Constants of a truncated Gaussian profile, derived from its standard deviation.
#[derive(Clone, Copy, Debug)]
pub struct Gaussian {
    std: f64,
    /// Factor in the exponent, `1 / 2 std^2`, per vox squared.
    pub steep: f64,
    /// Unitless value of the bare Gaussian (1 at its middle) at the radius, which is subtracted.
    pub edge: f64,
    /// Reciprocal of the norm: one over the integral of the Gaussian less its edge, per vox.
    pub per_norm: f64,
    /// Half the integral of the Gaussian inside the radius, without edge and norm.
    half_bell: f64,
}

/// Nodes and weights of Gauss's rule of three nodes, on -1 to 1: exact for the fifth power, and a
/// spline times its argument is of the fourth.
const THREE: [(f64, f64); 3] =
    [(-0.774_596_669_241_483_4, 5.0 / 9.0), (0.0, 8.0 / 9.0), (0.774_596_669_241_483_4, 5.0 / 9.0)];

impl Profile {
    /// Tabulates the profile of `kernel`; `std` and `radius` are in vox.
    pub fn new(kernel: Kernel, std: f64, radius: f64) -> Profile {
        // Values and slopes of B-splines at their knots, in steps.
        match kernel {
            Kernel::Gaussian => Profile::gaussian(std, radius),
            Kernel::Bspline | Kernel::Interpolating => {
                Profile::pieces(radius, &[[2.0 / 3.0, 0.0], [1.0 / 6.0, -0.5], [0.0, 0.0]])
            }
            Kernel::Tent => Profile::pieces(radius, &[[1.0, -1.0], [0.0, -1.0]]),
        }
    }

    /// Hermite's cubics through values and slopes from the middle to `radius`.
    fn pieces(radius: f64, nodes: &[[f64; 2]]) -> Profile {
        let per_step = (nodes.len() - 1) as f64 / radius;
        let table = nodes.iter().map(|node| node.map(|x| x * per_step)).collect();
        Profile { radius, form: Form::Pieces, table, per_step }
    }

    /// Tabulates a Gaussian of deviation `std`, cut at `radius`, both in vox, with its edge value
    /// subtracted and its integral 1.
    pub fn gaussian(std: f64, radius: f64) -> Profile {
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
        let form = Form::Gaussian(Gaussian { std, steep, edge, per_norm, half_bell });
        Profile { radius, form, table, per_step: 1.0 / h }
    }

    /// Returns the whole Gaussian, out to where all that is beyond, times `most`, is below 1e-9.
    /// Splines stay as they are: nothing was cut.
    pub fn untruncated(&self, most: f64) -> Profile {
        let Form::Gaussian(g) = self.form else { return self.clone() };
        let tail = |radius: f64| libm::erfc(radius * g.steep.sqrt()) * most.max(1.0);
        let mut radius = self.radius;
        while tail(radius) >= 1e-9 {
            radius += 0.01 * g.std;
        }
        let bell = g.std * (2.0 * std::f64::consts::PI).sqrt();
        Profile::with(g.std, radius, 0.0, 1.0 / bell)
    }

    /// Returns the profile `u` vox from its middle, per vox.
    #[inline]
    pub fn at(&self, u: f64) -> f64 {
        let Some(([a, da], [b, db], t)) = self.cell(u.abs()) else { return 0.0 };
        // Hermite's cubic.
        let (c, d) = (b - a - da, db + da - 2.0 * (b - a));
        a + t * (da + t * (c + (t - 1.0) * d))
    }

    /// Returns the profile `u` vox from its middle, per vox, and its slope there, per vox squared:
    /// the derivative of what [`Profile::at`] returns. At a kink it is that of the side away from
    /// the middle.
    #[inline]
    pub fn with_slope(&self, u: f64) -> [f64; 2] {
        let Some(([a, da], [b, db], t)) = self.cell(u.abs()) else { return [0.0; 2] };
        let (c, d) = (b - a - da, db + da - 2.0 * (b - a));
        let slope = (da + t * (2.0 * c + (3.0 * t - 2.0) * d)) * self.per_step;
        [a + t * (da + t * (c + (t - 1.0) * d)), if u < 0.0 { -slope } else { slope }]
    }

    /// The nodes on both sides of `u`, which is not negative, and its share of the way between.
    #[inline]
    fn cell(&self, u: f64) -> Option<([f64; 2], [f64; 2], f64)> {
        if u >= self.radius {
            return None;
        }
        let s = u * self.per_step;
        let i = s as usize;
        // Rounding may take the last place inside to the last node.
        let (Some(&a), Some(&b)) = (self.table.get(i), self.table.get(i + 1)) else {
            return None;
        };
        Some((a, b, s - i as f64))
    }

    /// Returns the integral of the profile from its left edge to `u` vox from its middle, 0 to 1.
    pub fn integral_to(&self, u: f64) -> f64 {
        if u <= -self.radius {
            return 0.0;
        }
        let u = u.min(self.radius);
        match self.form {
            Form::Gaussian(g) => {
                let half = (std::f64::consts::PI / 2.0).sqrt();
                let bell = g.std * half * libm::erf(u * g.steep.sqrt()) + g.half_bell;
                (bell - g.edge * (u + self.radius)) * g.per_norm
            }
            Form::Pieces => self.by_pieces(-self.radius, u, |_| 1.0),
        }
    }

    /// Returns the integral of `u` times the profile from `u` to `u + d`, in vox.
    pub fn moment(&self, u: f64, d: f64) -> f64 {
        let [from, to] = [u, u + d].map(|u| u.clamp(-self.radius, self.radius));
        match self.form {
            Form::Gaussian(g) => {
                let up_to =
                    |u: f64| -libm::exp(-u * u * g.steep) / (2.0 * g.steep) - g.edge * u * u * 0.5;
                (up_to(to) - up_to(from)) * g.per_norm
            }
            Form::Pieces => self.by_pieces(from, to, |u| u),
        }
    }

    /// The integral of `times` times a spline, piece by piece.
    fn by_pieces(&self, from: f64, to: f64, times: impl Fn(f64) -> f64) -> f64 {
        let pieces = self.table.len() as i32 - 1;
        let knot = |i: i32| f64::from(i) / self.per_step;
        let mut sum = 0.0;
        for i in -pieces..pieces {
            let (a, b) = (knot(i).max(from), knot(i + 1).min(to));
            if a < b {
                let (middle, half) = (0.5 * (a + b), 0.5 * (b - a));
                let at = |x: f64| middle + half * x;
                sum += half
                    * THREE.map(|(x, w)| w * times(at(x)) * self.at(at(x))).iter().sum::<f64>();
            }
        }
        sum
    }
}
