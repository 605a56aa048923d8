//! Pictures in closed form, and bounds of how far a rendered picture may be from them.
//!
//! The kernel turns a block of voxels whose appearance depends on their layer alone (a
//! [`LayerStack`]) into the field `Sx(x) Sy(y) sum_j sigma_j g(z - j)`, with S the sum of the
//! profile g over the block's lattice points. Along a parallel ray down z, Sx and Sy stay, and the
//! integral of g is a difference of error functions, or of truncated powers where g is a spline. So
//! optical depth between any two depths is a sum of those, edges and ripple included. A Gaussian of
//! voxels (a [`GaussianBlob`]) is a product of three sums along an axis, and, for the Gaussian
//! kernel, a product of convolutions from any other direction.
//!
//! A rendered picture differs from these by at most what [`Rounding`] adds up: each term is a bound
//! derived from the number of roundings, not from observed differences. The profile is written down
//! here anew, for the third time, so that neither footprints nor the reference are relied on.

use glam::DMat3;
use slabcast_common::quality::{Kernel, Quality};
use std::f64::consts::PI;
use std::ops::Range;

/// Largest relative error of one rounding to f32: half a unit in the last place, 2^-24.
const ULP: f64 = 1.0 / 16_777_216.0;

/// The kernel along one axis. Lengths in vox.
#[derive(Clone, Copy, Debug)]
pub struct Profile {
    std: f64,
    /// Support radius of the kernel in vox.
    #[doc(hidden)]
    pub radius: f64,
    norm: f64,
    /// Degree, where it is a B-spline of steps of one vox.
    degree: Option<i32>,
}

impl Profile {
    /// Makes a Gaussian of deviation `std` vox, cut at `radius` vox, with its edge value subtracted
    /// and its integral normalised to one.
    pub fn new(std: f64, radius: f64) -> Profile {
        let bare = Profile { std, radius, norm: 1.0, degree: None };
        Profile { norm: bare.unnormalised(radius), ..bare }
    }

    /// Makes the kernel of `quality` on a lattice of steps of one vox.
    pub fn from_quality(quality: &Quality) -> Profile {
        let [std, radius] = quality.kernel_shape();
        match quality.kernel {
            Kernel::Gaussian => Profile::new(std, radius),
            Kernel::Bspline | Kernel::Interpolating => {
                Profile { std, radius, norm: 1.0, degree: Some(3) }
            }
            Kernel::Tent => Profile { std, radius, norm: 1.0, degree: Some(1) },
        }
    }

    fn bell(&self, u: f64) -> f64 {
        libm::exp(-u * u / (2.0 * self.std * self.std))
    }

    /// A B-spline of `degree` as a difference of truncated powers, here of `power`: with `power`
    /// one more it is its integral, with one less its slope.
    fn spline(&self, u: f64, degree: i32, power: i32) -> f64 {
        let (mut binomial, mut sum) = (1.0, 0.0);
        for k in 0..=degree + 1 {
            let x = u + self.radius - f64::from(k);
            if x > 0.0 {
                sum += binomial * x.powi(power);
            }
            binomial *= -f64::from(degree + 1 - k) / f64::from(k + 1);
        }
        sum / (1..=power).map(f64::from).product::<f64>()
    }

    /// Returns the profile `u` vox from its centre, per vox.
    pub fn at(&self, u: f64) -> f64 {
        match self.degree {
            _ if u.abs() >= self.radius => 0.0,
            None => (self.bell(u) - self.bell(self.radius)) / self.norm,
            Some(degree) => self.spline(u, degree, degree),
        }
    }

    /// `|g'(u)|`.
    fn steepness(&self, u: f64) -> f64 {
        match self.degree {
            _ if u.abs() > self.radius => 0.0,
            None => u.abs() / (self.std * self.std) * self.bell(u) / self.norm,
            Some(degree) => self.spline(u, degree, degree - 1).abs(),
        }
    }

    fn unnormalised(&self, u: f64) -> f64 {
        let root = (2.0 * self.std * self.std).sqrt();
        let bell =
            (PI / 2.0).sqrt() * self.std * (libm::erf(u / root) + libm::erf(self.radius / root));
        bell - (u + self.radius) * self.bell(self.radius)
    }

    /// Returns the profile's integral up to `u` vox from its centre: 0 to 1.
    pub fn integral_to(&self, u: f64) -> f64 {
        let u = u.clamp(-self.radius, self.radius);
        match self.degree {
            None => self.unnormalised(u) / self.norm,
            Some(degree) => self.spline(u, degree, degree + 1),
        }
    }

    /// Lattice points whose kernels reach `u`, of those in `of`.
    fn near(&self, u: f64, of: &Range<i32>) -> Range<i32> {
        let first = libm::ceil(u - self.radius).max(f64::from(of.start)) as i32;
        let last = libm::floor(u + self.radius).min(f64::from(of.end) - 1.0) as i32;
        first..(last + 1).max(first)
    }

    /// Returns the sum at `u` vox of the profiles about the lattice points `of`, per vox.
    pub fn sum(&self, u: f64, of: &Range<i32>) -> f64 {
        self.near(u, of).map(|i| self.at(u - f64::from(i))).sum()
    }
}

/// The appearance of all voxels of one layer.
#[derive(Clone, Copy, Debug)]
pub struct Layer {
    /// Extinction of the layer's voxels, per vox.
    pub sigma: f64,
    /// Linear red, green and blue of the layer's voxels, 0 to 1.
    pub rgb: [f64; 3],
}

/// Layers of voxels one vox apart, seen along the layers' axis in an orthographic view.
#[derive(Clone, Debug)]
pub struct LayerStack {
    /// Kernel of every voxel, with one profile along all axes.
    pub profile: Profile,
    /// Lattice points of each layer along the picture's two axes.
    pub across: [Range<i32>; 2],
    /// Layers front to back; their middle lies in the target's plane.
    pub layers: Vec<Layer>,
}

impl LayerStack {
    /// Returns the unitless product of the kernel sums along x and y at index position (u, v).
    pub fn lateral(&self, [u, v]: [f64; 2]) -> f64 {
        self.profile.sum(u, &self.across[0]) * self.profile.sum(v, &self.across[1])
    }

    /// Returns the depth of layer number `j` in vox behind the target.
    pub fn z(&self, j: usize) -> f64 {
        j as f64 - (self.layers.len() as f64 - 1.0) / 2.0
    }

    /// Optical depth and that times colour between two depths, per unit of the sums across.
    fn between(&self, from: f64, to: f64) -> [f64; 4] {
        let mut sum = [0.0; 4];
        let reach = self.profile.radius + (self.layers.len() as f64 - 1.0) / 2.0;
        // Layers outside give nothing.
        let first = libm::ceil(from + reach - 2.0 * self.profile.radius).max(0.0) as usize;
        let last = libm::floor(to + reach).max(-1.0) + 1.0;
        for j in first..(last as usize).min(self.layers.len()) {
            let Layer { sigma, rgb } = self.layers[j];
            let z = self.z(j);
            let w = sigma * (self.profile.integral_to(to - z) - self.profile.integral_to(from - z));
            for (s, c) in sum.iter_mut().zip([1.0, rgb[0], rgb[1], rgb[2]]) {
                *s += w * c;
            }
        }
        sum
    }

    /// Returns the optical depth in front of depth `z` (vox behind the target) at index position
    /// `at`.
    pub fn optical_depth(&self, at: [f64; 2], z: f64) -> f64 {
        self.lateral(at) * self.between(-1e9, z)[0]
    }

    /// Returns the pixel that looks at index position `at`: linear premultiplied RGBA. Where layers
    /// differ in colour it is a sum over steps of 1/256 vox, each with its exact mean colour, whose
    /// error is at most [`LayerStack::thickness_bound`] for that thickness.
    pub fn pixel(&self, at: [f64; 2]) -> [f64; 4] {
        let lateral = self.lateral(at);
        let total = lateral * self.between(-1e9, 1e9)[0];
        let a = -libm::expm1(-total);
        let rgb = self.layers.iter().find(|l| l.sigma > 0.0).map_or([0.0; 3], |l| l.rgb);
        if self.layers.iter().all(|l| l.sigma <= 0.0 || l.rgb == rgb) {
            return [rgb[0] * a, rgb[1] * a, rgb[2] * a, a];
        }
        let mut out = [0.0, 0.0, 0.0, a];
        self.sheets(lateral, STEP, |seen, _, tau, mean| {
            for c in 0..3 {
                out[c] += seen * mean[c] * -libm::expm1(-tau);
            }
        });
        out
    }

    /// Sheets of thickness `d` at sums across of `lateral`: transmittance in front, number,
    /// optical depth and mean colour of each.
    fn sheets(&self, lateral: f64, d: f64, mut each: impl FnMut(f64, i64, f64, [f64; 3])) {
        let reach = self.profile.radius + self.layers.len() as f64 / 2.0;
        let (first, end) = (libm::floor(-reach / d) as i64, libm::ceil(reach / d) as i64);
        let mut before = 0.0;
        for k in first..end {
            let sums = self.between(k as f64 * d, (k + 1) as f64 * d);
            let tau = sums[0] * lateral;
            if tau > 0.0 {
                let mean = [1, 2, 3].map(|c| sums[c] / sums[0]);
                each(libm::exp(-before), k, tau, mean);
                before += tau;
            }
        }
    }

    /// Returns a bound of the error, in linear premultiplied units, of sheets of thickness `d` vox
    /// with one colour each, at index position `at`.
    ///
    /// In optical depth t a sheet's light is `int C exp(-t)`; with the mean c of C it is c a. As
    /// `C - c` has no mean, any constant may be taken from exp(-t): with half of what exp(-t) falls
    /// by, and `int |C - c| <= tau / 2` times what C spans, the difference is at most `span tau a /
    /// 4`. What C spans is read at 16 places a sheet; ratios of kernel sums have no finer
    /// structure.
    pub fn thickness_bound(&self, at: [f64; 2], d: f64) -> f64 {
        let mut bound = 0.0;
        self.sheets(self.lateral(at), d, |seen, k, tau, _| {
            let mut span = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
            for i in 0..=16 {
                let z = (k as f64 + f64::from(i) / 16.0) * d;
                let here = self.between(z - 1e-6, z + 1e-6);
                if here[0] > 0.0 {
                    for c in 0..3 {
                        let x = here[c + 1] / here[0];
                        span[c] = [span[c][0].min(x), span[c][1].max(x)];
                    }
                }
            }
            let widest = span.iter().map(|s| (s[1] - s[0]).max(0.0)).fold(0.0, f64::max);
            bound += seen * widest * tau * -libm::expm1(-tau) / 4.0;
        });
        bound
    }

    /// Returns bounds of the error of alpha and of each colour, in linear premultiplied units, that
    /// roundings make in the pixel at index position `at`.
    pub fn rounding_bound(&self, at: [f64; 2], how: &Rounding) -> [f64; 2] {
        let lateral = self.lateral(at);
        let thick: f64 = self.layers.iter().map(|l| l.sigma).sum();
        let near: Vec<Range<i32>> =
            (0..2).map(|a| self.profile.near(at[a], &self.across[a])).collect();
        let voxels = (near[0].len() * near[1].len()) as f64;
        // The largest change by a rounded position, from one voxel at each place.
        let steep = |a: usize| -> f64 {
            near[a].clone().map(|i| self.profile.steepness(at[a] - f64::from(i))).sum()
        };
        let sums = [0, 1].map(|a| self.profile.sum(at[a], &self.across[a]));
        // A twentieth more for the second order.
        let moved = 1.05 * how.shift * (steep(0) * sums[1] + sums[0] * steep(1));
        how.bound(lateral * thick, moved * thick, voxels, self.layers.len() as f64, self.profile)
    }
}

/// Steps of [`LayerStack::pixel`] where colours differ: at 1/256 vox what they add to the error
/// stays below 1e-3/255 for the scenes here; at 1/128 it is four times that.
pub const STEP: f64 = 1.0 / 256.0;

/// Rounding parameters of a picture, for bounds of its error.
#[derive(Clone, Copy, Debug)]
pub struct Rounding {
    /// Thickness of a sheet in vox.
    pub thickness: f64,
    /// Largest extinction per vox that integer sums were made for; `None` where sums are floats.
    pub integers: Option<f64>,
    /// Largest error of a position along an axis of the picture, in vox: half a subpixel, or zero
    /// where all voxels fall on subpixels.
    pub shift: f64,
}

impl Rounding {
    /// Bounds of alpha and of colour at optical depth `tau`, of which `moved` may come or go by
    /// rounded positions, made by `voxels` of each of `layers`.
    ///
    /// - A contribution is a product of three weights and a payload, each rounded once, with a
    ///   rounding a product, then scaled, converted and multiplied by unit and secant: 16
    ///   roundings with those of colour. Floats are added one by one: one more for each.
    /// - Integers are off by half a unit a contribution.
    /// - A sheet's opacity is good to 4 roundings (`common::math`), its addition to A costs two
    ///   more, and one of A itself.
    /// - Colour is rounded to 2^-28 a sheet, and the rule's slope carries what is off in the
    ///   mean colours of three sheets, at most half of it each.
    fn bound(&self, tau: f64, moved: f64, voxels: f64, layers: f64, profile: Profile) -> [f64; 2] {
        let d = self.thickness;
        let sections = 2.0 * profile.radius / d + 2.0;
        let sheets = (layers + 2.0 * profile.radius) / d + 2.0;
        let (share, absolute) = match self.integers {
            Some(largest) => {
                let unit = 1.05 * largest * d / f64::from(1u32 << 30);
                (16.0 * ULP, 0.5 * unit * voxels * layers * sections)
            }
            // Roundings of one sheet: only the layers that reach into it add.
            None => ((16.0 + voxels * (2.0 * profile.radius + d + 1.0)) * ULP, 0.0),
        };
        let a = -libm::expm1(-tau);
        let off = tau * share + absolute + moved;
        let by_depth = off * libm::exp(-(tau - off).max(0.0));
        let alpha = by_depth.min(1.0) + (6.0 + sheets) * ULP * a;
        // Emission and attenuation each feel a share of what is seen.
        let moved_share = if tau > 0.0 { (moved / tau).min(moved) } else { 0.0 };
        let colour = 2.0 * (share + moved_share.max(0.0)) * a
            + 2.0 * absolute * 3.0
            + (10.0 + sheets) * ULP * a
            + sheets / f64::from(1u32 << 29);
        [alpha, colour.max(alpha)]
    }
}

/// Voxels whose extinction is a Gaussian about the volume's centre.
#[derive(Clone, Copy, Debug)]
pub struct GaussianBlob {
    /// Kernel of every voxel, with one profile along all axes.
    pub profile: Profile,
    /// Extinction at the peak, per vox.
    pub peak: f64,
    /// Standard deviation of the blob in vox.
    pub std: f64,
    /// Number of voxels along each axis.
    pub voxels: u32,
}

impl GaussianBlob {
    /// Returns the blob's unitless profile (1 at the centre) `u` vox from the centre along one
    /// axis.
    #[doc(hidden)]
    pub fn density(&self, u: f64) -> f64 {
        libm::exp(-u * u / (2.0 * self.std * self.std))
    }

    /// Returns the positions of lattice points along one axis, in vox from the blob's centre.
    pub fn places(&self) -> impl Iterator<Item = f64> + use<> {
        let n = self.voxels;
        (0..n).map(move |i| f64::from(i) - (f64::from(n) - 1.0) / 2.0)
    }

    /// Returns the optical depth of a ray along an index axis that passes (x, y) vox from the
    /// centre: exact, with the kernel's ripple.
    pub fn depth_along_axis(&self, [x, y]: [f64; 2]) -> f64 {
        let sum = |u: f64| -> f64 {
            self.places().map(|i| self.density(i) * self.profile.at(u - i)).sum()
        };
        let deep: f64 = self.places().map(|i| self.density(i)).sum();
        self.peak * sum(x) * sum(y) * deep
    }

    /// Returns a bound of the change of [`GaussianBlob::depth_along_axis`] by positions that are
    /// off by up to `shift` vox along each axis.
    pub fn position_bound(&self, [x, y]: [f64; 2], shift: f64) -> f64 {
        let sum = |u: f64| -> f64 {
            self.places().map(|i| self.density(i) * self.profile.at(u - i)).sum()
        };
        let steep = |u: f64| -> f64 {
            self.places().map(|i| self.density(i) * self.profile.steepness(u - i)).sum()
        };
        let deep: f64 = self.places().map(|i| self.density(i)).sum();
        1.05 * shift * self.peak * (steep(x) * sum(y) + sum(x) * steep(y)) * deep
    }

    /// Returns the optical depth of a ray in any direction that passes (x, y) vox from the centre
    /// along the picture's axes: the Gaussian convolved with the kernel. The sum over voxels
    /// differs from it by at most [`GaussianBlob::aliasing_bound`].
    pub fn depth_from(&self, [x, y]: [f64; 2]) -> f64 {
        self.peak * (2.0 * PI).sqrt() * self.std * self.convolved(x) * self.convolved(y)
    }

    /// The Gaussian convolved with the profile: two Gaussians make one, cut by error functions.
    fn convolved(&self, x: f64) -> f64 {
        let (s, q, r) = (self.std, self.profile.std, self.profile.radius);
        let p = 1.0 / (1.0 / (s * s) + 1.0 / (q * q)).sqrt();
        let m = x * p * p / (s * s);
        let root = std::f64::consts::SQRT_2;
        let bells = libm::exp(-x * x / (2.0 * (s * s + q * q)))
            * p
            * (PI / 2.0).sqrt()
            * (libm::erf((r - m) / (root * p)) + libm::erf((r + m) / (root * p)));
        let edge = s
            * (PI / 2.0).sqrt()
            * (libm::erf((x + r) / (root * s)) - libm::erf((x - r) / (root * s)));
        (bells - self.profile.bell(r) * edge) / self.profile.norm
    }

    /// Returns a bound of what the lattice may add to [`GaussianBlob::depth_from`] at (x, y) vox,
    /// in a view whose eye coordinates are `eye_from_index` times index coordinates.
    ///
    /// By Poisson's formula a sum over voxels
    /// is a sum of integrals, one for each m of the dual lattice; that of m = 0 is the convolution.
    /// Along the ray the others are smaller by `exp(-2 pi^2 wide^2 (m.z)^2)`, across it by Fourier
    /// integrals of Gaussian times profile, which are added up here in size for m up to 6 along
    /// each axis. Farther ones see the kernel's edge alone, whose kinks make `c / w^2` at frequency
    /// w, `c = 2 g'(R) / 4 pi^2`. Those that count lie within t of the picture's plane, with
    /// `2 pi^2 wide^2 t^2 = 23`, so there are 2 t in a unit of its area, and near its axes, since
    /// the product of two waves is small elsewhere: in four strips of width `g(0)` from 6 on. This
    /// last part is an estimate by area, doubled.
    pub fn aliasing_bound(&self, [x, y]: [f64; 2], eye_from_index: &DMat3) -> f64 {
        let mut sum = 0.0;
        let axes = -6..=6i32;
        for (i, j, k) in axes.clone().flat_map(|i| {
            axes.clone().flat_map({
                let axes = axes.clone();
                move |j| axes.clone().map(move |k| (i, j, k))
            })
        }) {
            if (i, j, k) == (0, 0, 0) {
                continue;
            }
            let m = *eye_from_index * glam::DVec3::new(f64::from(i), f64::from(j), f64::from(k));
            let along = libm::exp(-2.0 * PI * PI * self.std * self.std * m.z * m.z);
            if along < 1e-9 {
                continue;
            }
            sum += along * self.wave(x, m.x) * self.wave(y, m.y);
        }
        let c = 2.0 * self.profile.steepness(self.profile.radius) / (4.0 * PI * PI);
        let t = (23.0f64 / 2.0).sqrt() / (PI * self.std);
        let far = 2.0 * (2.0 * t) * 4.0 * self.profile.at(0.0) * c / 6.0;
        self.peak * (2.0 * PI).sqrt() * self.std * (sum + far)
    }

    /// `|int f(x - u) g(u) exp(2 pi i w u) du|`, by the midpoint rule.
    fn wave(&self, x: f64, w: f64) -> f64 {
        const STEPS: i32 = 400;
        let h = 2.0 * self.profile.radius / f64::from(STEPS);
        let (mut re, mut im) = (0.0, 0.0);
        for i in 0..STEPS {
            let u = -self.profile.radius + (f64::from(i) + 0.5) * h;
            let f = self.density(x - u) * self.profile.at(u) * h;
            re += f * libm::cos(2.0 * PI * w * u);
            im += f * libm::sin(2.0 * PI * w * u);
        }
        (re * re + im * im).sqrt()
    }

    /// Returns bounds of the error of alpha and of each colour that roundings make at optical depth
    /// `tau`, `moved` of which may come or go by rounded positions.
    pub fn rounding_bound(&self, tau: f64, moved: f64, how: &Rounding) -> [f64; 2] {
        // Samples are floats themselves: one rounding more, which the 16 have room for.
        let reach = 2.0 * self.profile.radius + 1.0;
        how.bound(tau, moved, reach * reach, f64::from(self.voxels) * 1.8, self.profile)
    }
}
