//! The kernel: its profile along one axis, and its shear where the lattice is not cubic.
//!
//! A profile is a Gaussian of standard deviation s, cut at radius R, with its edge value subtracted
//! and its integral normalised to one; or a B-spline of the lattice's steps, cubic or linear (the
//! tent) (docs/design/model.md section 1).
//!
//! A kernel is the product of three profiles along perpendicular axes in *index* space, the third
//! of which is the eye's depth. In a cubic lattice these are the eye's axes. In others the kernel
//! is an ellipsoid: with E the steps of the lattice as the eye sees them (columns), `E = T Q` for a
//! rotation Q and
//!
//! ```text
//!     [ Txx Txy Txz ]       z = Tzz c,
//! T = [     Tyy Tyz ],      y = Tyy b + (Tyz / Tzz) z,
//!     [         Tzz ]       x = Txx a + (Txz / Tzz) z + (Txy / Tyy) (y - (Tyz / Tzz) z)
//! ```
//!
//! for rotated index coordinates (a, b, c). The middle of a section moves across as sheets go back,
//! and that of a row as rows go down. These three slopes are a [`Lean`].

use crate::quality::Kernel;
use glam::{DMat3, DVec3};

/// Profile of the kernel along one axis. Lengths in vox.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Profile {
    /// Shape of the profile: Gaussian, linear or another kernel.
    pub kernel: Kernel,
    /// Standard deviation of the profile in vox.
    pub std: f64,
    /// Support radius in vox: the profile is zero beyond it.
    pub radius: f64,
    /// Length of a lattice step along this axis in vox: weights are multiplied by it before they
    /// become 16-bit fixed point.
    pub spread: f64,
    edge: f64,
    norm: f64,
}

impl Profile {
    /// Returns the profile of `kernel` with deviation `std` and `radius` in vox: those of
    /// `Quality::kernel_shape` times the length of a lattice step.
    pub fn new(kernel: Kernel, std: f64, radius: f64) -> Self {
        match kernel {
            Kernel::Gaussian => Profile::gaussian(std, radius),
            Kernel::Bspline | Kernel::Interpolating | Kernel::Tent => {
                Profile { kernel, std, radius, spread: 1.0, edge: 0.0, norm: 1.0 }
            }
        }
    }

    /// Returns a Gaussian of deviation `std`, cut at `radius` (vox).
    pub fn gaussian(std: f64, radius: f64) -> Self {
        let edge = libm::exp(-radius * radius / (2.0 * std * std));
        let bell = std
            * (2.0 * std::f64::consts::PI).sqrt()
            * libm::erf(radius / (std * std::f64::consts::SQRT_2));
        let norm = bell - 2.0 * radius * edge;
        Profile { kernel: Kernel::Gaussian, std, radius, spread: 1.0, edge, norm }
    }

    /// Returns the profile for a lattice whose steps are `spread` vox along this axis. Weights in
    /// fixed point are then per step, below one for every lattice.
    #[must_use]
    pub fn with_spread(self, spread: f64) -> Self {
        Profile { spread, ..self }
    }

    /// Returns the profile's value g(u) at distance `u` vox, per vox.
    pub fn at(&self, u: f64) -> f64 {
        if u.abs() >= self.radius {
            return 0.0;
        }
        match self.kernel {
            Kernel::Gaussian => {
                (libm::exp(-u * u / (2.0 * self.std * self.std)) - self.edge) / self.norm
            }
            Kernel::Bspline | Kernel::Interpolating => {
                let step = 0.5 * self.radius;
                let (t, rest) = (u.abs() / step, 2.0 - u.abs() / step);
                let near = 2.0 / 3.0 + t * t * (0.5 * t - 1.0);
                (if t < 1.0 { near } else { rest * rest * rest / 6.0 }) / step
            }
            Kernel::Tent => (1.0 - u.abs() / self.radius) / self.radius,
        }
    }

    /// Returns the derivative g'(u) at distance `u` vox, per vox^2. The tent's is that of its
    /// sides, and 0 in its middle.
    pub fn slope_at(&self, u: f64) -> f64 {
        if u.abs() >= self.radius || u == 0.0 {
            return 0.0;
        }
        match self.kernel {
            Kernel::Gaussian => {
                let square = self.std * self.std;
                -u / square * libm::exp(-u * u / (2.0 * square)) / self.norm
            }
            Kernel::Bspline | Kernel::Interpolating => {
                let step = 0.5 * self.radius;
                let (t, rest) = (u.abs() / step, 2.0 - u.abs() / step);
                let slope = if t < 1.0 { t * (1.5 * t - 2.0) } else { -0.5 * rest * rest };
                slope * u.signum() / (step * step)
            }
            Kernel::Tent => -u.signum() / (self.radius * self.radius),
        }
    }

    /// Returns the profile's Fourier transform, the integral of `g(u) cos(2 pi frequency u)`:
    /// 1 for frequency 0. `frequency` in cycles per vox.
    pub fn transform_at(&self, frequency: f64) -> f64 {
        let splines = match self.kernel {
            // The transform of a B-spline is a power of sinc.
            Kernel::Bspline | Kernel::Interpolating => Some((4, 0.5 * self.radius)),
            Kernel::Tent => Some((2, self.radius)),
            Kernel::Gaussian => None,
        };
        if let Some((power, step)) = splines {
            let x = std::f64::consts::PI * frequency * step;
            let sinc = if x.abs() < 1e-9 { 1.0 } else { libm::sin(x) / x };
            let square = sinc * sinc;
            return if power == 4 { square * square } else { square };
        }
        // Simpson's rule: off by less than 1e-5 up to 3 cycles.
        let (parts, half) = (64, self.radius);
        let sum: f64 = (0..=parts)
            .map(|i| {
                let u = half * f64::from(i) / f64::from(parts);
                let weight = if i == 0 || i == parts { 1.0 } else { f64::from(2 + 2 * (i % 2)) };
                weight * self.at(u) * libm::cos(std::f64::consts::TAU * frequency * u)
            })
            .sum();
        2.0 * sum * half / (3.0 * f64::from(parts))
    }

    /// Returns the integral of g from -radius to `u` vox: 0 to 1.
    pub fn integral_to(&self, u: f64) -> f64 {
        let u = u.clamp(-self.radius, self.radius);
        // Integral of a spline from its middle to `t` steps.
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
            Kernel::Bspline | Kernel::Interpolating => u / (0.5 * self.radius),
            Kernel::Tent => u / self.radius,
        };
        if steps < 0.0 { 0.5 - half(-steps) } else { 0.5 + half(steps) }
    }

    /// Returns the integral of `u g(u)` from the middle to `u`, in vox.
    fn moment_to(&self, u: f64) -> f64 {
        let u = u.abs().min(self.radius);
        match self.kernel {
            Kernel::Gaussian => {
                let square = self.std * self.std;
                let bell = -square * libm::expm1(-u * u / (2.0 * square));
                (bell - 0.5 * self.edge * u * u) / self.norm
            }
            Kernel::Bspline | Kernel::Interpolating => {
                let step = 0.5 * self.radius;
                let (t, rest) = (u / step, 2.0 - u / step);
                let (square, fourth) = (t * t, rest * rest * rest * rest);
                step * if t < 1.0 {
                    square * (1.0 / 3.0 + square * (0.1 * t - 0.25))
                } else {
                    7.0 / 30.0 + fourth * (rest / 30.0 - 1.0 / 12.0)
                }
            }
            Kernel::Tent => {
                let t = u / self.radius;
                self.radius * t * t * (0.5 - t / 3.0)
            }
        }
    }

    /// Returns the integral of `u^2 g(u)`, in vox^2.
    fn variance(&self) -> f64 {
        // By parts, `int u^2 g = 2 int (M(R) - M(u)) du` from the middle: smooth, and zero where it
        // ends.
        const N: u32 = 512;
        let h = self.radius / f64::from(N);
        let whole = self.moment_to(self.radius);
        let at = |i: u32| whole - self.moment_to((f64::from(i) + 0.5) * h);
        2.0 * h * (0..N).map(at).sum::<f64>()
    }

    /// Returns the distance behind its voxel at which the section between distances `from` and `to`
    /// (vox) is drawn where the kernel leans: the section's centroid.
    pub fn placed(&self, from: f64, to: f64) -> f64 {
        self.front(from).to(&self.front(to))
    }

    /// Computes [`Profile::placed`] of consecutive sections of `thickness` vox, the first from
    /// distance `from` on.
    pub fn places(&self, from: f64, thickness: f64, out: &mut [f64]) {
        let mut front = self.front(from);
        for (i, out) in out.iter_mut().enumerate() {
            let back = self.front(from + (i + 1) as f64 * thickness);
            *out = front.to(&back);
            front = back;
        }
    }

    /// Returns weight and moment in front of a plane at distance `u`.
    fn front(&self, u: f64) -> Front {
        let at = u.clamp(-self.radius, self.radius);
        Front { at, weight: self.integral_to(at), moment: self.moment_to(at) }
    }

    /// Returns the share of [the variance](Self::variance) that remains inside sections drawn at
    /// their centroids ([`Profile::placed`]) in sheets of `thickness`: nothing in thin sheets, all
    /// in sheets that hold a voxel whole.
    fn left_within(&self, thickness: f64) -> f64 {
        const PHASES: u32 = 16;
        // Sheets as far as the kernel reaches; of thick ones two.
        let reach = libm::ceil(self.radius / thickness).clamp(1.0, 1e4) as i32;
        let mut among = 0.0;
        for phase in 0..PHASES {
            let at = (f64::from(phase) + 0.5) / f64::from(PHASES);
            let plane = |k: i32| self.front((f64::from(k) + at) * thickness);
            let mut front = plane(-reach - 1);
            for k in -reach..=reach + 1 {
                let back = plane(k);
                let placed = front.to(&back);
                among += (back.weight - front.weight) * placed * placed / f64::from(PHASES);
                front = back;
            }
        }
        let variance = self.variance();
        (variance - among).max(0.0) / variance
    }
}

/// Weight and moment of a profile in front of a plane.
#[derive(Clone, Copy)]
struct Front {
    at: f64,
    weight: f64,
    moment: f64,
}

impl Front {
    /// Returns the centroid between this plane and one behind it.
    fn to(&self, back: &Front) -> f64 {
        let weight = back.weight - self.weight;
        // Less weight than this is invisible, and its moment is only cancellation.
        if weight < 1e-9 {
            return 0.5 * (self.at + back.at);
        }
        ((back.moment - self.moment) / weight).clamp(self.at, back.at)
    }
}

/// Shear of a kernel against the eye's axes. The head of this file has the formulas.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lean {
    /// Distance that the kernel's middle moves along x and y for each vox of depth.
    pub depth: [f64; 2],
    /// Distance that the middle of a row moves along x for each vox of y.
    pub row: f64,
}

impl Lean {
    /// No shear, as in cubic lattices.
    pub const NONE: Lean = Lean { depth: [0.0; 2], row: 0.0 };

    /// Returns the three slopes x over depth, y over depth and x over y, all unitless (vox per
    /// vox).
    pub fn to_array(&self) -> [f64; 3] {
        let [x, y] = self.depth;
        [x, y, self.row]
    }

    /// Returns the shear of three slopes in the order of [`Lean::to_array`].
    pub fn from_array([x, y, row]: [f64; 3]) -> Lean {
        Lean { depth: [x, y], row }
    }

    /// Returns whether the kernel is the product of three profiles along the eye's own axes.
    pub fn is_none(&self) -> bool {
        *self == Lean::NONE
    }

    /// Returns eye coordinates in which the kernel is not sheared. Depths stay.
    #[inline]
    pub fn upright(&self, v: DVec3) -> DVec3 {
        let y = v.y - self.depth[1] * v.z;
        DVec3::new(v.x - self.depth[0] * v.z - self.row * y, y, v.z)
    }

    /// Returns the steps of a lattice (columns) in coordinates in which the kernel is not sheared.
    pub fn upright_steps(&self, steps: &DMat3) -> DMat3 {
        let [i, j, k] = [steps.x_axis, steps.y_axis, steps.z_axis].map(|v| self.upright(v));
        DMat3::from_cols(i, j, k)
    }

    /// Returns the slopes x and y over depth (unitless, vox per vox) of a parallel ray, in
    /// coordinates in which the kernel is not sheared.
    pub fn ray_slopes(&self) -> [f64; 2] {
        let ray = self.upright(DVec3::Z);
        [ray.x, ray.y]
    }

    /// Returns how far a kernel whose profiles end at `radius` reaches along the eye's axes, in
    /// vox.
    #[inline]
    pub fn reach(&self, radius: DVec3) -> DVec3 {
        let [x, y] = self.depth.map(|slope| slope.abs() * radius.z);
        radius + DVec3::new(x + self.row.abs() * radius.y, y, 0.0)
    }

    /// Returns the slope [`Lean::row`] (vox per vox) in units of 2^-16, rounded.
    pub fn row_fixed(&self) -> i64 {
        // Lattices' steps differ by a factor of a million at most.
        libm::floor(self.row * 65536.0 + 0.5).clamp(-1e12, 1e12) as i64
    }

    /// Returns the offset along x of a row's middle from the footprint's, rounded, for a row `down`
    /// below the footprint's middle, in the same unit. `row` is [`Lean::row_fixed`].
    #[inline(always)]
    pub fn along_row(row: i64, down: i64) -> i64 {
        // Beyond 2^62 it is off every picture, one way or the other.
        const FAR: i64 = 1 << 62;
        (row.saturating_mul(down).clamp(-FAR, FAR) + (1 << 15)) >> 16
    }
}

/// Returns the kernel of a lattice whose steps the eye sees as the columns of `steps` (vox): the
/// length of a step along the axis of each profile (the diagonal of T, whose product is a cell's
/// volume), and the shear.
pub fn ellipsoid(steps: &DMat3) -> (DVec3, Lean) {
    let [x, y, z] = [0, 1, 2].map(|axis| steps.row(axis));
    let tzz = z.length();
    let along_z = z / tzz;
    let (txz, tyz) = (x.dot(along_z), y.dot(along_z));
    let y = y - along_z * tyz;
    let tyy = y.length();
    let txy = x.dot(y / tyy);
    let txx = steps.determinant().abs() / (tyy * tzz);
    // Angles that are right but for their last bits make no lean.
    let slope = |a: f64, b: f64| if a.abs() > 1e-9 * b { a / b } else { 0.0 };
    let lean = Lean { depth: [slope(txz, tzz), slope(tyz, tzz)], row: slope(txy, tyy) };
    (DVec3::new(txx, tyy, tzz), lean)
}

/// Returns spread and lean of the kernel's ellipsoid ([`ellipsoid`]) as they are drawn in sheets of
/// `thickness` vox by a kernel of deviation `std` and `radius` steps.
///
/// The depth of a section of a leaning kernel smears it across. It is drawn in one place instead,
/// and widened so that all sections together are as wide as the kernel. Against the integral of the
/// kernel between the sheet's planes, a scene of balls 2.2 times as wide along one axis is then off
/// by 0.026 of 1/255 at sheets of a vox. It would be off by 0.23 with sections half-way to the
/// sheet's middle, which need no more width, and by 0.60 with sections in the sheet's middle.
pub fn drawn_ellipsoid(
    steps: &DMat3,
    (kernel, std, radius): (Kernel, f64, f64),
    thickness: f64,
) -> (DVec3, Lean) {
    let (spread, lean) = ellipsoid(steps);
    let [bx, by] = lean.depth;
    if [bx, by] == [0.0; 2] {
        return (spread, lean);
    }
    let deep = Profile::new(kernel, std * spread.z, radius * spread.z);
    // In steps of the lattice.
    let left = deep.left_within(thickness) * spread.z * spread.z;
    let across = lean.row * spread.y;
    let yy = spread.y * spread.y + left * by * by;
    let xy = across * spread.y + left * bx * by;
    let xx = spread.x * spread.x + across * across + left * bx * bx;
    let y = yy.sqrt();
    let x = (xx - xy * xy / yy).max(0.0).sqrt().max(spread.x);
    (DVec3::new(x, y, spread.z), Lean { row: xy / yy, ..lean })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quality::Quality;
    use proptest::prelude::*;

    fn profiles() -> [Profile; 4] {
        let shape = |kernel| Quality { kernel, ..Quality::before() }.kernel_shape();
        let of = |kernel, step: f64| {
            let [std, radius] = shape(kernel);
            Profile::new(kernel, std * step, radius * step)
        };
        [
            of(Kernel::Gaussian, 1.0),
            of(Kernel::Gaussian, 1.7),
            of(Kernel::Bspline, 1.3),
            of(Kernel::Tent, 2.0),
        ]
    }

    #[test]
    fn moments_are_integrals() {
        for p in profiles() {
            let (mut moment, mut square) = (0.0, 0.0);
            let n = 40_000;
            let h = p.radius / f64::from(n);
            for i in 0..n {
                let u = (f64::from(i) + 0.5) * h;
                moment += u * p.at(u) * h;
                square += 2.0 * u * u * p.at(u) * h;
                assert!((p.moment_to(u + 0.5 * h) - moment).abs() < 1e-7, "{p:?} at {u}");
                assert_eq!(p.moment_to(u), p.moment_to(-u));
            }
            assert!((p.variance() - square).abs() < 1e-5 * square, "{p:?}: {square}");
        }
    }

    #[test]
    fn centroids_leave_the_variance_within_a_sheet() {
        for p in profiles() {
            let variance = p.variance();
            for thin in [0.1, 0.25, 0.5] {
                let d = thin * p.std;
                let left = p.left_within(d) * variance / (d * d / 12.0);
                assert!((left - 1.0).abs() < 0.05, "{p:?}, {thin}: {left}");
            }
            let thick = p.left_within(1e3 * p.std);
            assert!((thick - 1.0).abs() < 0.02, "{p:?}: {thick}");
            for (from, to) in [(-9.0, -8.0), (0.3, 0.7), (-0.2, 0.1), (p.radius - 1e-6, 50.0)] {
                let placed = p.placed(from, to);
                assert!(
                    from.max(-p.radius) <= placed && placed <= to.min(p.radius) || from == -9.0
                );
                assert!((placed + p.placed(-to, -from)).abs() < 1e-9, "{p:?} {from} {to}");
            }
        }
    }

    /// A lattice, perhaps oblique, somehow turned.
    fn steps() -> impl Strategy<Value = DMat3> {
        let turn = prop::array::uniform3(0.0..6.3f64);
        let skew = prop::array::uniform3(-0.4..0.4f64);
        (turn, prop::array::uniform3(1.0..4.0f64), skew).prop_map(|([a, b, c], [x, y, z], skew)| {
            let turn = DMat3::from_rotation_z(a) * DMat3::from_rotation_x(b);
            let lattice = DMat3::from_cols(
                DVec3::new(x, 0.0, 0.0),
                DVec3::new(skew[0] * y, y, 0.0),
                DVec3::new(skew[1] * z, skew[2] * z, z),
            );
            turn * DMat3::from_rotation_z(c) * lattice
        })
    }

    proptest! {
        #[test]
        fn a_leaning_kernel_is_a_ball_in_index_space(m in steps(), at in prop::array::uniform3(-2.0..2.0f64)) {
            let (spread, lean) = ellipsoid(&m);
            let eye = DVec3::from_array(at);
            let own = lean.upright(eye) / spread;
            let index = m.inverse() * eye;
            prop_assert!((own.length() - index.length()).abs() < 1e-9 * (1.0 + index.length()));
            prop_assert!((spread.element_product() - m.determinant().abs()).abs() < 1e-9);
            // All steps, upright, are a rotation times the spreads.
            let upright = lean.upright_steps(&m);
            for axis in 0..3 {
                prop_assert!((upright.row(axis).length() - spread[axis]).abs() < 1e-9);
            }
            // The box that holds it.
            let reach = lean.reach(spread * 2.0);
            if own.abs().max_element() <= 2.0 {
                prop_assert!((reach - eye.abs()).min_element() >= -1e-9);
            }
        }

        #[test]
        fn thin_sheets_draw_the_kernel_and_one_thick_sheet_its_projection(m in steps()) {
            let (spread, lean) = ellipsoid(&m);
            let shape = (Kernel::Gaussian, 0.6, 2.0);
            let (thin, thin_lean) = drawn_ellipsoid(&m, shape, 0.05);
            prop_assert!((thin - spread).abs().max_element() < 2e-3 * spread.max_element());
            prop_assert!((thin_lean.row - lean.row).abs() < 0.01 * (1.0 + lean.row.abs()));
            let (thick, _) = drawn_ellipsoid(&m, shape, 1e4);
            let whole = m.row(1).length();
            prop_assert!((thick.y / whole - 1.0).abs() < 0.01, "{} of {whole}", thick.y);
            prop_assert!(thick.min_element() >= spread.min_element() - 1e-9);
        }
    }

    #[test]
    fn cubic_lattices_do_not_lean() {
        let turn = DMat3::from_rotation_z(0.3) * DMat3::from_rotation_x(1.1);
        let (spread, lean) = ellipsoid(&(turn * 2.0));
        assert!((spread - DVec3::splat(2.0)).abs().max_element() < 1e-12);
        assert!(lean.is_none() && lean.row_fixed() == 0);
        assert_eq!(Lean::along_row(-65536, 77), -77);
        assert_eq!(Lean::along_row(3 << 15, 5), 8);
        assert_eq!(Lean::along_row(-(1 << 40), 1 << 50), -(1 << 46));
    }
}
