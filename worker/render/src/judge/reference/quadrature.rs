//! Integration along a ray: panels of four nodes, halved until two levels agree.

use super::Reference;
use super::figures::worse;
use super::profile::Profile;
use super::walk::{Near, Ray};

/// Most halvings of a panel: 2^-40 of a vox lies below the last bit of a depth of 10^4 vox.
pub(super) const HALVINGS: u32 = 40;
/// Optical depth behind which nothing is seen: a transmittance of 1e-12.
pub(super) const DEEP: f64 = 27.631_021_115_928_547;

impl Reference {
    /// Takes the panel at `z` by halves until two levels agree.
    pub(super) fn halve(
        &self,
        f: &Field,
        z: f64,
        h: f64,
        whole: &Panel,
        left: u32,
        sum: &mut Light,
    ) {
        let half = h * 0.5;
        let parts = [self.rule.panel(f, z, half), self.rule.panel(f, z + half, half)];
        let open = libm::exp(-sum.depth);
        let behind = libm::exp(-parts[0].depth);
        let mut off = 0.0f64;
        for c in 0..4 {
            let joined = parts[0].light[c] + behind * parts[1].light[c];
            off = worse(off, joined - whole.light[c]);
        }
        // A front thinner than the nodes are apart goes unseen by both levels. But light of
        // colour one must come out as the opacity, and then it does not.
        let joined = parts[0].light[3] + behind * parts[1].light[3];
        let depth = parts[0].depth + parts[1].depth;
        off = worse(off, joined + libm::expm1(-depth));
        off = worse(off, libm::exp(-whole.depth) - libm::exp(-depth));
        let opacity = -libm::expm1(-(sum.depth + depth));
        if open * off <= self.tolerance * opacity || left == 0 {
            for part in &parts {
                sum.add(part);
            }
            return;
        }
        for (i, part) in parts.iter().enumerate() {
            if sum.depth < DEEP {
                self.halve(f, z + half * i as f64, half, part, left - 1, sum);
            }
        }
    }
}

/// The kernel sums along a ray, from the voxels of use on a panel.
pub(super) struct Field<'a> {
    pub(super) kernel: &'a [Profile; 3],
    pub(super) ray: &'a Ray,
    pub(super) voxels: &'a [Near],
    /// Every place of the lattice, endlessly, each with a payload of one: what the sums are
    /// divided by where ripple is left out.
    pub(super) lattice: Option<&'a [Near]>,
}

impl Field<'_> {
    /// Extinction and emission per unit of z.
    #[inline]
    pub(super) fn at(&self, z: f64) -> [f64; 4] {
        let mut sum = [0.0; 4];
        for v in self.voxels {
            let w = self.weight(v, z);
            for c in 0..4 {
                sum[c] += v.payload[c] * w;
            }
        }
        let mut scale = self.ray.secant;
        if let Some(lattice) = self.lattice {
            let all: f64 = lattice.iter().map(|v| v.payload[0] * self.weight(v, z)).sum();
            // Narrow kernels leave gaps, where there is nothing to divide.
            scale = if all > 0.0 { scale / all } else { 0.0 };
        }
        sum.map(|s| s * scale)
    }

    #[inline]
    fn weight(&self, v: &Near, z: f64) -> f64 {
        if z <= v.enter || z >= v.leave {
            return 0.0;
        }
        let [gx, gy, gz] = self.kernel;
        let along = gz.at(z - v.z);
        if self.ray.parallel {
            return along;
        }
        along * (gx.at(v.x + self.ray.slope[0] * z) * gy.at(v.y + self.ray.slope[1] * z))
    }
}

/// A stretch of the ray by itself: optical depth, and light of the three colours and of colour
/// one (which should be the opacity) as its front end sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Panel {
    pub(super) depth: f64,
    pub(super) light: [f64; 4],
}

/// Optical depth and light that a ray has gathered.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Light {
    pub(super) depth: f64,
    pub(super) light: [f64; 3],
}

impl Light {
    pub(super) fn add(&mut self, p: &Panel) {
        // Light of colour one is known exactly; what the quadrature misses of it, it misses of
        // the others in proportion. So a constant colour is exact however steep the field.
        if p.light[3] > 0.0 {
            let scale = libm::exp(-self.depth) * -libm::expm1(-p.depth) / p.light[3];
            for c in 0..3 {
                self.light[c] += p.light[c] * scale;
            }
        }
        self.depth += p.depth;
    }
}

/// Gauss-Legendre collocation with four nodes: order 8 for the optical depth, and for light as
/// well, since light and depth are integrated as one system.
#[derive(Clone, Copy, Debug)]
pub struct Gauss {
    /// Nodes of the rule on the unit interval, 0 to 1.
    pub nodes: [f64; 4],
    /// Weights of the rule on the unit interval; they add up to 1.
    pub weights: [f64; 4],
    /// The integral up to node i of the polynomial that is one at node j and zero at the others.
    pub up_to: [[f64; 4]; 4],
}

impl Gauss {
    /// Computes nodes, weights and partial integrals of the rule with four nodes.
    pub fn four_nodes() -> Gauss {
        let inner = (3.0 / 7.0 - 2.0 / 7.0 * 1.2f64.sqrt()).sqrt();
        let outer = (3.0 / 7.0 + 2.0 / 7.0 * 1.2f64.sqrt()).sqrt();
        let nodes = [-outer, -inner, inner, outer].map(|x| (x + 1.0) * 0.5);
        let integral = |j: usize, to: f64| {
            // Coefficients of the polynomial, lowest first.
            let mut p = [1.0, 0.0, 0.0, 0.0];
            for i in (0..4).filter(|&i| i != j) {
                for k in (0..4).rev() {
                    let lower = if k > 0 { p[k - 1] } else { 0.0 };
                    p[k] = (lower - nodes[i] * p[k]) / (nodes[j] - nodes[i]);
                }
            }
            p.iter().enumerate().rev().fold(0.0, |sum, (k, c)| (sum + c / (k as f64 + 1.0)) * to)
        };
        Gauss {
            nodes,
            weights: std::array::from_fn(|j| integral(j, 1.0)),
            up_to: std::array::from_fn(|i| std::array::from_fn(|j| integral(j, nodes[i]))),
        }
    }

    pub(super) fn panel(&self, field: &Field, z: f64, h: f64) -> Panel {
        self.sum(&self.nodes.map(|n| field.at(z + n * h)), h)
    }

    /// A panel of length `h` from extinction and emission at its nodes.
    pub(super) fn sum(&self, at: &[[f64; 4]; 4], h: f64) -> Panel {
        let mut p = Panel { depth: 0.0, light: [0.0; 4] };
        for i in 0..4 {
            let before: f64 = (0..4).map(|j| self.up_to[i][j] * at[j][0]).sum::<f64>() * h;
            let seen = libm::exp(-before.max(0.0)) * self.weights[i] * h;
            p.depth += at[i][0] * self.weights[i] * h;
            p.light[3] += at[i][0] * seen;
            for c in 0..3 {
                p.light[c] += at[i][c + 1] * seen;
            }
        }
        p
    }
}
