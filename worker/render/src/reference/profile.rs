//! The kernel along one axis, written down anew.

/// One axis of the kernel: `(exp(-u^2 / 2 std^2) - edge) / norm` inside the radius.
#[derive(Clone, Copy, Debug)]
pub(super) struct Profile {
    std: f64,
    pub(super) radius: f64,
    /// `1 / 2 std^2`.
    steep: f64,
    edge: f64,
    per_norm: f64,
}

impl Profile {
    pub(super) fn new(std: f64, radius: f64) -> Profile {
        let steep = 0.5 / (std * std);
        let edge = libm::exp(-radius * radius * steep);
        let bell = std * (2.0 * std::f64::consts::PI).sqrt() * libm::erf(radius * steep.sqrt());
        Profile { std, radius, steep, edge, per_norm: 1.0 / (bell - 2.0 * radius * edge) }
    }

    #[inline]
    pub(super) fn at(&self, u: f64) -> f64 {
        if u.abs() < self.radius {
            (libm::exp(-u * u * self.steep) - self.edge) * self.per_norm
        } else {
            0.0
        }
    }

    /// The integral from the left edge to `u`.
    pub(super) fn integral_to(&self, u: f64) -> f64 {
        let u = u.clamp(-self.radius, self.radius);
        let (root, r) = (self.steep.sqrt(), self.radius);
        let bell = self.std
            * (std::f64::consts::PI / 2.0).sqrt()
            * (libm::erf(u * root) + libm::erf(r * root));
        (bell - self.edge * (u + r)) * self.per_norm
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
