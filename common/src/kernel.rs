//! The kernel's profile along one axis of the eye.
//!
//! A Gaussian of standard deviation s, cut at radius R, with its edge value subtracted and its integral
//! normalised to one, or a B-spline of the lattice's steps, the cubic one or the tent (DESIGN.md section
//! 1).

use crate::quality::Kernel;

/// One axis of the kernel. Lengths in vox.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Profile {
    /// Which.
    pub kernel: Kernel,
    /// Standard deviation.
    pub std: f64,
    /// Where it ends.
    pub radius: f64,
    /// What weights are multiplied by before they become 16-bit fixed point.
    pub spread: f64,
    edge: f64,
    norm: f64,
}

impl Profile {
    /// `kernel` of deviation `std` and `radius`, which are those of [`Quality::shape`] times the
    /// length of a step of the lattice.
    ///
    /// [`Quality::shape`]: crate::quality::Quality::shape
    pub fn new(kernel: Kernel, std: f64, radius: f64) -> Self {
        match kernel {
            Kernel::Gaussian => Profile::gaussian(std, radius),
            Kernel::Bspline | Kernel::Tent => {
                Profile { kernel, std, radius, spread: 1.0, edge: 0.0, norm: 1.0 }
            }
        }
    }

    /// Gaussian of `std`, cut at `radius`.
    pub fn gaussian(std: f64, radius: f64) -> Self {
        let edge = libm::exp(-radius * radius / (2.0 * std * std));
        let bell = std
            * (2.0 * std::f64::consts::PI).sqrt()
            * libm::erf(radius / (std * std::f64::consts::SQRT_2));
        let norm = bell - 2.0 * radius * edge;
        Profile { kernel: Kernel::Gaussian, std, radius, spread: 1.0, edge, norm }
    }

    /// The same for a lattice whose steps are `spread` vox along this axis: weights in fixed point
    /// are then those per step, below one for every lattice.
    #[must_use]
    pub fn with_spread(self, spread: f64) -> Self {
        Profile { spread, ..self }
    }

    /// g(u), per vox.
    pub fn at(&self, u: f64) -> f64 {
        if u.abs() >= self.radius {
            return 0.0;
        }
        match self.kernel {
            Kernel::Gaussian => {
                (libm::exp(-u * u / (2.0 * self.std * self.std)) - self.edge) / self.norm
            }
            Kernel::Bspline => {
                let step = 0.5 * self.radius;
                let (t, rest) = (u.abs() / step, 2.0 - u.abs() / step);
                let near = 2.0 / 3.0 + t * t * (0.5 * t - 1.0);
                (if t < 1.0 { near } else { rest * rest * rest / 6.0 }) / step
            }
            Kernel::Tent => (1.0 - u.abs() / self.radius) / self.radius,
        }
    }

    /// The integral of g from -radius to `u`: 0 to 1.
    pub fn integral_to(&self, u: f64) -> f64 {
        let u = u.clamp(-self.radius, self.radius);
        // What lies between the middle and `t` steps of a spline.
        let half = |t: f64| match self.kernel {
            Kernel::Tent => t * (1.0 - 0.5 * t),
            _ if t < 1.0 => t * (2.0 / 3.0 + t * t * (0.125 * t - 1.0 / 3.0)),
            _ => 0.5 - (2.0 - t) * (2.0 - t) * (2.0 - t) * (2.0 - t) / 24.0,
        };
        let steps = match self.kernel {
            Kernel::Gaussian => {
                let root2 = std::f64::consts::SQRT_2;
                let bell = self.std
                    * (std::f64::consts::PI / 2.0).sqrt()
                    * (libm::erf(u / (self.std * root2))
                        + libm::erf(self.radius / (self.std * root2)));
                return (bell - self.edge * (u + self.radius)) / self.norm;
            }
            Kernel::Bspline => u / (0.5 * self.radius),
            Kernel::Tent => u / self.radius,
        };
        if steps < 0.0 { 0.5 - half(-steps) } else { 0.5 + half(steps) }
    }
}
