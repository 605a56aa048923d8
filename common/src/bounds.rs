//! Bounds on how far a picture can be from its own sheets in exact arithmetic: what the cut-off and
//! the integers cost, at most, on any pixel.
//!
//! Each is a bound, argued below, not an estimate. Bounds are in a frame's statistics, and
//! `slabcast lab check` holds pictures against them. All are in 1/255. `within` is the box of the
//! visible voxels.

use crate::brick::TightBox;
use crate::kernel::{Lean, Profile};
use crate::message::SceneSpec;
use crate::quality::{Compositing, Kernel, Quality, Sums};
use crate::transfer::Classifier;
use crate::view::{Projected, Projection, SUBPIXELS, View};
use glam::DVec3;
use std::f64::consts::PI;

/// Room that integer sums leave above a solid of the largest payload, as a factor. Ripple takes at
/// most 5 % for every kernel that `Quality::check` lets through but the narrowest, and the factor
/// of two up to 2^31 takes those. At half, single voxels of narrow kernels overflow; at double, one
/// bit of precision is given away.
const HEADROOM: f64 = 1.05;

/// Returns the raw units of a 32-bit sum for one unit of payload: 2^30 is a sheet of `thickness`
/// vox full of the largest payload (docs/design/numerics.md section 3).
pub fn i32_units_per_payload(payload_max: f64, thickness: f64) -> f32 {
    let solid = HEADROOM * payload_max * thickness;
    if solid > 0.0 { (f64::from(1u32 << 30) / solid) as f32 } else { 1.0 }
}

/// Returns the raw units of a 16-bit sum for one unit of payload: 32767 is a sheet of `thickness`
/// vox full of the largest payload.
pub fn i16_units_per_payload(payload_max: f64, thickness: f64) -> f64 {
    let solid = HEADROOM * payload_max * thickness;
    if solid > 0.0 { 32767.0 / solid } else { 1.0 }
}

/// Returns the bound of the cut-off in 1/255: a shut pixel transmits less than eps, and no colour
/// is brighter than one.
pub fn cutoff(quality: &Quality) -> f64 {
    quality.eps * 255.0
}

/// Returns a bound, in 1/255, of the rounding to integers.
///
/// Let a pixel see N sheets and a sheet gather the kernels of m voxels there. Each contribution
/// is rounded by half a raw unit, so a sheet's optical depth tau and each of its colour sums E
/// are off by at most delta = m/2 units. With T the transmittance in front of a sheet,
/// a = 1 - exp(-tau) and psi = a / tau <= 1:
///
/// - alpha is 1 - exp(-sum tau): off by at most N delta;
/// - colour is the sum of T E psi. Its slope in E is T psi; its slope in tau, with what the
///   sheets behind lose, is at most T psi too. So it is off by at most 2 N delta;
/// - the colour rule adds T D phi. D moves by at most (85 G + 48 H + 4) delta / tau when the
///   sums of this sheet and its neighbours do (G <= 2 and H <= 1/2 its gains; a sheet before of
///   2 % of this one, where its weight grows fastest, gives most of it), and |phi| <= tau a / 12.
///   As the T a of all sheets add up to alpha <= 1, the rule adds at most 17 delta *in all*;
/// - the paper's opacity is min(tau, 1): a sheet's light moves by at most 2 delta, and what is
///   behind it by delta: 3 N delta;
/// - colour itself is kept in units of 2^-28, rounded once a sheet: N 2^-29. This is what is
///   left of it where sheets add floats.
///
/// m: a voxel belongs to a cell, and cells of voxels in a box lie in the box grown by half a cell
/// at each face; so there are no more than the grown box has cells.
pub fn quantisation(scene: &SceneSpec, view: &View, within: &TightBox) -> f64 {
    let sheets = view.project(within).map_or(0.0, |p| f64::from(p.sheets.len()));
    let fixed_point = sheets * 0.5 / f64::from(1u32 << 28);
    let q = &scene.quality;
    if q.sums == Sums::F32 {
        return 255.0 * fixed_point;
    }
    let payload_max = Classifier::largest_payload(&scene.transfer, &scene.volume, q.compositing);
    let d = view.thickness;
    // Upright, where a kernel is a box, and a ray slanted if it leans.
    let m = view.kernel_lean.upright_steps(&view.eye_from_index);
    let cell = m.x_axis.abs() + m.y_axis.abs() + m.z_axis.abs();
    let [x, y] = view.kernel_lean.ray_slopes().map(|slope| slope.abs() * d);
    let r = view.kernel_radius * 2.0 + cell + DVec3::new(x, y, d);
    let met = r.x * r.y * r.z / m.determinant().abs();
    let unit = match q.sums {
        // Payload, section, row and contribution are each rounded by half a unit, and then times
        // weights below one; three weights by 2^-16, times a payload below 2^15: 3.5 units.
        Sums::I16 => 3.5 / i16_units_per_payload(payload_max, d),
        _ => 0.5 / f64::from(i32_units_per_payload(payload_max, d)),
    };
    let delta = met * unit * longest_secant(view);
    let times = match q.compositing {
        Compositing::Linear => 2.0 * sheets + 17.0,
        Compositing::Constant => 2.0 * sheets,
        Compositing::Paper => 3.0 * sheets,
    };
    255.0 * (times * delta + fixed_point)
}

/// Returns a bound, in 1/255, of what f32 opacity loses by being added up, sheet after sheet.
///
/// A += (1 - A) a is rounded by at most 2^-25 a sheet, half the last bit below one. An error of A
/// shrinks with every sheet that follows, so after N sheets it is at most N 2^-25. Colour adds
/// T a c with that T: the errors of T times a telescope to those of A once more, 2 N 2^-25 in all.
/// A million sheets make 15/255; a view of some hundred sheets 0.01.
pub fn accumulation(view: &View, within: &TightBox) -> f64 {
    let sheets = view.project(within).map_or(0.0, |p| f64::from(p.sheets.len()));
    255.0 * 2.0 * sheets / f64::from(1u32 << 25)
}

/// Bound on the difference, in 1/255 and on every pixel, between a picture and one with other
/// kernels than the drawn ones. See [`rounding`] and [`truncation`].
///
/// Let a change of the field take sigma to sigma' and sigma C to sigma' C' along a ray, T be what
/// is let through before it and R' the light that comes from behind after it. Then the pixel
/// changes by exactly
///
/// ```text
/// int T (d(sigma C) - R' d(sigma)) ds = sum over voxels of int T sigma_v (C_v - R') dg_v ds,
/// ```
///
/// and by at most `D = int T sum(sigma_v |dg_v|) ds`, as colours lie between zero and one; opacity,
/// too. On each axis `|dg| <= lambda g + sum of c_j g(x - s_j)`: a share of the kernel itself, and
/// shifted kernels where it ends. The product of the three axes is then a share `s` of g itself, of
/// which no more than the light that there is can be lost, `int T sigma ds <= 1`, and shifted
/// kernels of weight `w` in all. Of these T is taken for one, and their sum over a ray is `w` times
///
/// - at most the largest extinction times the way through the volume times [`ripple`];
/// - where shifts across the ray are whole pixels of a parallel view, no pixel is shut and the
///   kernel does not lean: at most the largest optical depth that any pixel has, which is -ln(1 -
///   alpha). Shifts along the ray move nothing then, and their cover is as heavy as what it covers.
struct Change<'a> {
    view: &'a View,
    /// The drawn kernel by axis, and how far beyond its radius the other one reaches.
    drawn: [Profile; 3],
    beyond: [f64; 3],
    /// Largest extinction per vox, and the longest way through the volume in vox.
    solid: f64,
    way: f64,
    /// The largest optical depth of any pixel, if it is known.
    deepest: Option<f64>,
}

/// Returns the largest sum over a lattice of ones: one and the kernel's ripple, which is below 0.6
/// % for Gaussians of 0.6 (docs/design/numerics.md section 4) and grows to either side. A tent's is
/// 39 %.
fn ripple(quality: &Quality) -> f64 {
    let [std, _] = quality.kernel_shape();
    let even = quality.kernel != Kernel::Tent && std >= 0.55;
    if even { HEADROOM } else { 1.6 }
}

impl Change<'_> {
    fn new<'a>(
        scene: &SceneSpec,
        view: &'a View,
        within: &TightBox,
        max_alpha: Option<f64>,
        beyond: [f64; 3],
    ) -> Change<'a> {
        let q = &scene.quality;
        let sheets = view.project(within).map_or(0, |p| p.sheets.len());
        let (std, radius) = (view.kernel_std.to_array(), view.kernel_radius.to_array());
        let payload = Classifier::largest_payload(&scene.transfer, &scene.volume, q.compositing);
        // Beyond the picture there is nothing: all that a voxel reaches is in it.
        let [w, h] = view.size.map(|n| n as i32);
        let inside = view
            .project(within)
            .is_some_and(|Projected { rect: r, .. }| r.x0 > 0 && r.y0 > 0 && r.x1 < w && r.y1 < h);
        let parallel = matches!(view.projection, Projection::Ortho { .. });
        let straight = parallel && view.kernel_lean.is_none();
        let open = max_alpha.filter(|&a| straight && inside && 1.0 - a > q.eps.max(1e-6));
        Change {
            view,
            drawn: std::array::from_fn(|a| Profile::new(q.kernel, std[a], radius[a])),
            beyond,
            solid: payload * ripple(q),
            way: f64::from(sheets) * view.thickness * longest_secant(view),
            deepest: open.map(|a| -libm::log1p(-a)),
        }
    }

    /// Returns the least bound over several shares. `change(axis, x)` is |dg| at a distance, which
    /// follows from the drawn kernel and `beyond` of that axis. `share` is how often light counts
    /// in the rule of colours, and `sheet` how often what a sheet changes beyond it.
    fn bound(&self, change: impl Fn(usize, f64) -> f64, share: f64, sheet: f64) -> f64 {
        let light = |[a, b, c]: [f64; 3]| a * b * c;
        let mut best = 1.0f64;
        // By the volume's extent, and by the pixels' optical depth.
        for by_pixels in [false, true] {
            let deep = if by_pixels {
                let Some(deepest) = self.deepest else { continue };
                deepest
            } else {
                self.solid * self.way
            };
            let cells = [0, 1, 2].map(|a| {
                let p = &self.drawn[a];
                let near = 0.5 * p.std;
                match self.view.projection {
                    Projection::Ortho { scale } if by_pixels && a < 2 => {
                        (near * scale).floor().max(1.0) / scale
                    }
                    _ => near,
                }
            });
            // Axes that are alike (two or three in cubic voxels) are computed once.
            let first = [0, 1, 2].map(|a: usize| {
                let of = |a: usize| (self.drawn[a], self.beyond[a], cells[a]);
                (0..a).find(|&b| of(a) == of(b)).unwrap_or(a)
            });
            let each = [0, 1, 2].map(|a| {
                let p = &self.drawn[a];
                let reach = p.radius + self.beyond[a];
                (first[a] == a).then(|| Axis::new(|x| change(a, x), p, reach, cells[a]))
            });
            for i in 0..14 {
                let lambda = 0.001 * f64::from(1u32 << i) * self.view.kernel_std.min_element();
                let lambdas = [0, 1, 2].map(|a| lambda / self.drawn[a].std);
                let each = [0, 1, 2].map(|a| each[a].as_ref().map(|axis| axis.cover(lambdas[a])));
                let covers = [0, 1, 2].map(|a| {
                    let (cover, mass) = each[first[a]].expect("the first of those that are alike");
                    [1.0 + lambdas[a], if by_pixels && a == 2 { mass } else { cover }]
                });
                let own = covers.map(|[own, _]| own);
                let s = light(own) - 1.0;
                let w = light(covers.map(|[own, cover]| own + cover)) - light(own);
                let sheets = self.solid * self.view.thickness;
                best = best.min(s * share + w * (deep + sheet * sheets));
            }
        }
        255.0 * best
    }
}

/// A change along one axis, sampled, for covers of any share.
struct Axis {
    /// For each place: the change, the kernel, and one over the shifted kernel of its cell.
    places: Vec<[f64; 3]>,
    /// Start of each cell; the first is the middle one's right half.
    cells: Vec<usize>,
    step: f64,
}

impl Axis {
    /// Samples a change covered by shifted kernels `p`, a `cell` apart, up to `reach`.
    fn new(change: impl Fn(f64) -> f64, p: &Profile, reach: f64, cell: f64) -> Axis {
        // Between the places the change moves by less than what `cover` adds. This is made for
        // every frame, in 0.03 ms an axis.
        const PLACES: usize = 1000;
        let step = reach / PLACES as f64;
        let (mut places, mut cells) = (Vec::with_capacity(PLACES + 1), vec![0]);
        for i in 0..=PLACES {
            let x = i as f64 * step;
            let here = libm::floor(x / cell + 0.5) as usize;
            if here >= cells.len() {
                cells.resize(here + 1, i);
            }
            places.push([change(x), p.at(x), 1.0 / p.at(x - here as f64 * cell)]);
        }
        Axis { places, cells, step }
    }

    /// Returns the weights and the integral of the shifted kernels that cover what `lambda` times
    /// the kernel leaves of the change, on both sides.
    fn cover(&self, lambda: f64) -> (f64, f64) {
        const BETWEEN: f64 = 1.02;
        let (mut sum, mut mass) = (0.0, 0.0);
        let ends = self.cells[1..].iter().copied().chain([self.places.len()]);
        for (cell, (&from, to)) in self.cells.iter().zip(ends).enumerate() {
            let mut worst = 0.0f64;
            for [change, own, per_shifted] in &self.places[from..to] {
                let excess = change - lambda * own;
                if excess > 0.0 {
                    worst = worst.max(excess * per_shifted);
                    mass += 2.0 * self.step * excess;
                }
            }
            sum += if cell == 0 { worst } else { 2.0 * worst };
        }
        (sum * BETWEEN, mass * BETWEEN)
    }
}

/// Returns a bound, in 1/255, of the error of rounded positions: half a subpixel across and half a
/// phase in depth. `max_alpha` is the picture's largest opacity, where it is known. `None` for the
/// paper's opacities, which add up to another picture.
///
/// By what is said at `Change`; sheets hold light as a field does that is constant in each. Where
/// colours have a slope, their sums and those of the sheets beside have a part in it: a share s of
/// all sums moves c and its neighbours by 2 s and the weights by 4 s, so the slope by at most
/// `(5 G + 6 H) s`, and light by |phi| / a of that, at most half and at most a twelfth of a sheet's
/// optical depth; what is beyond that share counts 17 times, once, as in [`quantisation`].
pub fn rounding(
    scene: &SceneSpec,
    view: &View,
    within: &TightBox,
    max_alpha: Option<f64>,
) -> Option<f64> {
    let q = &scene.quality;
    if q.compositing == Compositing::Paper {
        return None;
    }
    let Some(p) = view.project(within) else { return Some(0.0) };
    // The farthest sheet has the largest subpixels.
    let scale = view.scale_at(p.sheets.end).unwrap_or(f64::MIN_POSITIVE);
    let across = 0.5 / (f64::from(SUBPIXELS) * scale);
    // In perspective a footprint's width is rounded, too, to 16 bits.
    let width = match view.projection {
        Projection::Ortho { .. } => 0.0,
        Projection::Persp { .. } => 1.0 / 32768.0,
    };
    let deep = 0.5 * view.thickness / f64::from(view.depth_phases());
    // A section lies where its voxel's depth has it, and a row where its footprint does, rounded
    // once more.
    let Lean { depth: [lean_x, lean_y], row } = view.kernel_lean;
    let down = across + lean_y.abs() * deep;
    let along = across + lean_x.abs() * deep;
    let along = if row == 0.0 { along } else { along + across + row.abs() * down };
    let off = [along + width * view.kernel_radius[0], down + width * view.kernel_radius[1], deep];
    let change = Change::new(scene, view, within, max_alpha, off);
    let moved = |a: usize, x: f64| {
        let p = &change.drawn[a];
        let here = p.at(x);
        (p.at(x - off[a]) - here).abs().max((p.at(x + off[a]) - here).abs())
    };
    let y = view.thickness / view.kernel_std.z;
    let slope = 5.0 * (0.5 + 0.20 * y).min(2.0) + 6.0 * (0.5 - 0.07 * y).max(0.25);
    let fullest = change.solid * view.thickness * longest_secant(view);
    let (share, sheet) = match q.compositing {
        Compositing::Linear => (1.0 + slope * (fullest / 12.0).min(0.5), 17.0),
        _ => (1.0, 0.0),
    };
    Some(change.bound(moved, share, sheet))
}

/// Returns a bound, in 1/255, of the error by the kernel's cut, against a picture with whole
/// Gaussians, in the limit of thin sheets. Zero for splines, of which nothing is cut; `None` for
/// the paper's opacities.
///
/// By what is said at `Change`. The largest of all pictures' differences, 255, is what it comes to
/// wherever solid matter may lie just beyond a ray's reach all along it.
pub fn truncation(
    scene: &SceneSpec,
    view: &View,
    within: &TightBox,
    max_alpha: Option<f64>,
) -> Option<f64> {
    let q = &scene.quality;
    if q.compositing == Compositing::Paper {
        return None;
    }
    if q.kernel != Kernel::Gaussian {
        return Some(0.0);
    }
    // Beyond 6.5 deviations a Gaussian has 1e-10 of its integral.
    let beyond = [0, 1, 2].map(|a| (6.5 * view.kernel_std[a] - view.kernel_radius[a]).max(0.0));
    let change = Change::new(scene, view, within, max_alpha, beyond);
    let cut = |a: usize, x: f64| {
        let std = view.kernel_std[a];
        let bell = libm::exp(-0.5 * x * x / (std * std)) / (std * (2.0 * PI).sqrt());
        (bell - change.drawn[a].at(x)).abs()
    };
    Some(change.bound(cut, 1.0, 0.0))
}

/// Returns the longest way between two planes one apart of any pixel's ray.
fn longest_secant(view: &View) -> f64 {
    match view.projection {
        Projection::Ortho { .. } => 1.0,
        Projection::Persp { focal, .. } => {
            let [u, v] = view.size.map(|n| f64::from(n) * 0.5 / focal);
            (1.0 + u * u + v * v).sqrt()
        }
    }
}
