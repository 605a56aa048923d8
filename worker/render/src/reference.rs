//! The judge of error: what a pixel would be with no approximation at all.
//!
//! The picture in the limit (DESIGN.md section 1) is an integral along a ray,
//!
//! ```text
//! I = int sigma(s) C(s) exp(-int sigma) ds,     alpha = 1 - exp(-int sigma)
//! ```
//!
//! with sigma and sigma C the sums of the voxels' kernels at s. The splatter gets there by
//! sheets, tables, rounded positions and integers. What judges it must not lean on any of these,
//! else both could be wrong together. So this is a *gather*: for one pixel it walks along the true
//! ray, collects the voxels whose kernels the ray meets, and integrates by step halving in f64.
//! It shares with the splatter what the model is (the numbers of a [`View`], looks, light, voxels)
//! and writes everything else down anew: the profile, projection, neighbour search, quadrature.
//!
//! Two pixels can be asked for. [`Reference::pixel`] is the limit. [`Reference::at_same_thickness`]
//! is what sheets of the view's thickness would give in f64 with nothing shut: between it and a
//! rendered pixel lie cut-off, quantisation and rounding, between it and the limit the thickness.
//!
//! The price: 4096 pixels of mri256 at 512x512 take from half a second (opaque) to about ten
//! (translucent, in perspective) on two cores. So one takes a [`stratified`] sample of a picture
//! and lets [`ErrorFigures`] say how far off it is. Nothing is shared between pixels; callers
//! split them among their threads.
//!
//! On lattices that are not cubic the true kernel is an ellipsoid and the view carries the
//! product of its marginals along the eye's axes. That product is what is integrated here too:
//! this judge does not see that departure.

use glam::{DMat3, DVec3};
use slabcast_common::brick::{BRICK, Brick, BrickGrid, local};
use slabcast_common::image::{Background, Picture, PixelFormat};
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::Compositing;
use slabcast_common::shade::{NO_NORMAL, Shader};
use slabcast_common::transfer::Classifier;
use slabcast_common::view::{NEAR, Projection, View};
use std::sync::Arc;

/// Where halving ends: two levels agree to this on a panel, as a share of the opacity so far.
/// Against a tolerance of 1e-11 pixels are then off by at most 7e-5/255 (mri256 with peer-opaque
/// and peer-semi, 400 to 1024 pixels, both projections); ten times as much makes 3e-4/255 for two
/// thirds of the kernel values, a tenth makes 4e-5/255 for twice as many.
const TOLERANCE: f64 = 1e-7;
/// Length of a panel before it is halved, in standard deviations of the kernel along the axis
/// that the ray crosses fastest. Where kernels end the field has kinks, and two levels may agree
/// over one by chance: twice as long, the error triples for as many kernel values; half as long,
/// it is a quarter for 1.7 times the values (peer-semi, at a tolerance of 1e-6).
const PANEL: f64 = 0.8;
/// Most halvings of a panel: 2^-40 of a vox lies below the last bit of a depth of 10^4 vox.
const HALVINGS: u32 = 40;
/// Optical depth behind which nothing is seen: a transmittance of 1e-12.
const DEEP: f64 = 27.631_021_115_928_547;

/// One scene in one view, ready to be asked for pixels from any number of threads.
#[derive(Debug)]
pub struct Reference {
    view: View,
    grid: BrickGrid,
    /// Extinctions, whatever the quality's compositing: the limit knows no other.
    looks: Classifier,
    /// What the sheets of the quality's compositing add.
    sheet_looks: Classifier,
    compositing: Compositing,
    shader: Option<Shader>,
    kernel: [Profile; 3],
    index_from_eye: DMat3,
    /// In ascending id, each with its tight box in eye space.
    bricks: Vec<(Arc<Brick>, EyeBox)>,
    /// Eye offsets of the 512 voxels of a brick.
    offsets: Vec<DVec3>,
    rule: Gauss,
    tolerance: f64,
}

#[derive(Clone, Copy, Debug)]
struct EyeBox {
    lo: DVec3,
    hi: DVec3,
}

impl Reference {
    /// Makes `view` of the scene ready; `bricks` are all bricks of the scene, in any order.
    pub fn new(spec: &SceneSpec, view: View, bricks: &[Arc<Brick>]) -> Reference {
        let grid = BrickGrid::of(spec.volume.lattice.dims);
        let m = view.eye_from_index;
        let mut bricks: Vec<_> = bricks
            .iter()
            .map(|brick| {
                let tight = brick.tight(&grid);
                let lo = DVec3::from_array(tight.lo.map(f64::from));
                let hi = DVec3::from_array(tight.hi.map(f64::from));
                let (centre, half) = (view.eye_origin + m * ((lo + hi) * 0.5), (hi - lo) * 0.5);
                let reach =
                    m.x_axis.abs() * half.x + m.y_axis.abs() * half.y + m.z_axis.abs() * half.z;
                // What two ways to compute a position may differ by.
                let reach = reach + DVec3::splat(1e-9 * (1.0 + centre.abs().max_element()));
                (brick.clone(), EyeBox { lo: centre - reach, hi: centre + reach })
            })
            .collect();
        bricks.sort_by_key(|(brick, _)| brick.id);
        let (std, radius) = (view.kernel_std, view.kernel_radius);
        let classifier = |c| Classifier::new(&spec.transfer, &spec.volume, c);
        Reference {
            view,
            grid,
            looks: classifier(Compositing::Linear),
            sheet_looks: classifier(spec.quality.compositing),
            compositing: spec.quality.compositing,
            shader: spec.transfer.shading.on.then(|| Shader::new(&spec.transfer.shading)),
            kernel: [
                Profile::new(std.x, radius.x),
                Profile::new(std.y, radius.y),
                Profile::new(std.z, radius.z),
            ],
            index_from_eye: m.inverse(),
            bricks,
            offsets: (0..512).map(|i| m * DVec3::from_array(local(i).map(f64::from))).collect(),
            rule: Gauss::new(),
            tolerance: TOLERANCE,
        }
    }

    /// The same with another tolerance on a panel: to see whether the integration itself is
    /// exact enough.
    #[must_use]
    pub fn with_tolerance(self, tolerance: f64) -> Reference {
        Reference { tolerance, ..self }
    }

    /// The limit at pixel (x, y): linear premultiplied RGBA.
    pub fn pixel(&self, x: u32, y: u32) -> [f64; 4] {
        let ray = self.ray(x, y);
        let mut walk = Walk::new(self, &ray, &self.looks, self.kernel[2].radius);
        let mut sum = Light::default();
        let mut panel = Vec::new();
        let mut z = f64::NEG_INFINITY;
        while sum.depth < DEEP {
            // On to the next voxel, or panel on panel while there are any.
            let Some(start) = walk.next_depth(z) else { break };
            let end = start + ray.step;
            walk.reach(end);
            panel.clear();
            panel.extend(walk.voxels.iter().filter(|v| v.enter < end && v.leave > start));
            if !panel.is_empty() {
                let field = Field { kernel: &self.kernel, ray: &ray, voxels: &panel };
                let whole = self.rule.panel(&field, start, ray.step);
                self.halve(&field, start, ray.step, &whole, HALVINGS, &mut sum);
            }
            z = end;
        }
        let [r, g, b] = sum.light;
        [r, g, b, -libm::expm1(-sum.depth)]
    }

    /// [`Reference::pixel`] for each of `pixels`.
    pub fn pixels(&self, pixels: &[[u32; 2]]) -> Vec<[f64; 4]> {
        pixels.iter().map(|&[x, y]| self.pixel(x, y)).collect()
    }

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

    /// Takes the panel at `z` by halves until two levels agree.
    fn halve(&self, f: &Field, z: f64, h: f64, whole: &Panel, left: u32, sum: &mut Light) {
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

    fn ray(&self, x: u32, y: u32) -> Ray {
        let [w, h] = self.view.size.map(f64::from);
        let (px, py) = (f64::from(x) + 0.5 - w * 0.5, f64::from(y) + 0.5 - h * 0.5);
        let std = self.view.kernel_std;
        match self.view.projection {
            Projection::Ortho { scale } => Ray {
                at: [px / scale, py / scale],
                slope: [0.0; 2],
                start: f64::NEG_INFINITY,
                secant: 1.0,
                parallel: true,
                step: PANEL * std.z,
            },
            Projection::Persp { focal, distance } => {
                let (u, v) = (px / focal, py / focal);
                let step = std.z.min(std.x / u.abs()).min(std.y / v.abs());
                Ray {
                    at: [u * distance, v * distance],
                    slope: [u, v],
                    start: (NEAR - 1.0) * distance,
                    secant: (1.0 + u * u + v * v).sqrt(),
                    parallel: false,
                    step: PANEL * step,
                }
            }
        }
    }
}

/// The larger of two errors; what is not a number is the worst.
fn worse(a: f64, b: f64) -> f64 {
    let b = b.abs();
    if b <= a {
        a
    } else if b.is_nan() {
        f64::INFINITY
    } else {
        b
    }
}

/// A pixel's ray by depth z: `(at + slope z, z)` in eye space.
#[derive(Clone, Copy, Debug)]
struct Ray {
    at: [f64; 2],
    slope: [f64; 2],
    /// The near plane.
    start: f64,
    /// Length of the ray between two planes one apart.
    secant: f64,
    parallel: bool,
    /// Panels to begin with.
    step: f64,
}

/// One axis of the kernel: `(exp(-u^2 / 2 std^2) - edge) / norm` inside the radius.
#[derive(Clone, Copy, Debug)]
struct Profile {
    std: f64,
    radius: f64,
    /// `1 / 2 std^2`.
    steep: f64,
    edge: f64,
    per_norm: f64,
}

impl Profile {
    fn new(std: f64, radius: f64) -> Profile {
        let steep = 0.5 / (std * std);
        let edge = libm::exp(-radius * radius * steep);
        let bell = std * (2.0 * std::f64::consts::PI).sqrt() * libm::erf(radius * steep.sqrt());
        Profile { std, radius, steep, edge, per_norm: 1.0 / (bell - 2.0 * radius * edge) }
    }

    #[inline]
    fn at(&self, u: f64) -> f64 {
        if u.abs() < self.radius {
            (libm::exp(-u * u * self.steep) - self.edge) * self.per_norm
        } else {
            0.0
        }
    }

    /// The integral from the left edge to `u`.
    fn integral_to(&self, u: f64) -> f64 {
        let u = u.clamp(-self.radius, self.radius);
        let (root, r) = (self.steep.sqrt(), self.radius);
        let bell = self.std
            * (std::f64::consts::PI / 2.0).sqrt()
            * (libm::erf(u * root) + libm::erf(r * root));
        (bell - self.edge * (u + r)) * self.per_norm
    }
}

/// A voxel whose kernel the ray meets.
#[derive(Clone, Copy, Debug)]
struct Near {
    /// Depths between which the ray is inside its support.
    enter: f64,
    leave: f64,
    /// From the voxel to where the ray passes the plane z = 0.
    x: f64,
    y: f64,
    /// Its depth.
    z: f64,
    /// Extinction times the cell, and that times the three colours. For parallel rays times the
    /// profiles across, which are the same all along.
    payload: [f64; 4],
}

/// Finds the voxels along a ray, layer of bricks after layer, no farther than it must.
struct Walk<'a> {
    of: &'a Reference,
    ray: &'a Ray,
    looks: &'a Classifier,
    /// How far along z a voxel is of use.
    reach_z: f64,
    /// The index axis along which the ray crosses most voxels.
    axis: usize,
    /// Index position of the ray: `index + step z`.
    index: DVec3,
    step: DVec3,
    /// The kernel's reach along the index axes.
    reach: DVec3,
    /// Layers of bricks still to come, and from which end.
    layers: std::ops::Range<u32>,
    forward: bool,
    /// Voxels of the layers so far.
    voxels: Vec<Near>,
}

impl<'a> Walk<'a> {
    fn new(of: &'a Reference, ray: &'a Ray, looks: &'a Classifier, reach_z: f64) -> Walk<'a> {
        let m = of.index_from_eye;
        let step = m * DVec3::new(ray.slope[0], ray.slope[1], 1.0);
        let index = m * (DVec3::new(ray.at[0], ray.at[1], 0.0) - of.view.eye_origin);
        let [rx, ry, _] = of.kernel.map(|k| k.radius);
        let reach = m.x_axis.abs() * rx
            + m.y_axis.abs() * ry
            + m.z_axis.abs() * reach_z
            + DVec3::splat(1e-6);
        let s = step.abs();
        let axis = if s.x >= s.y && s.x >= s.z {
            0
        } else if s.y >= s.z {
            1
        } else {
            2
        };
        Walk {
            of,
            ray,
            looks,
            reach_z,
            axis,
            index,
            step,
            reach,
            layers: 0..of.grid.dims[axis],
            forward: step[axis] > 0.0,
            voxels: Vec::new(),
        }
    }

    /// Depths between which the next layer can be of use.
    fn next_layer(&self) -> Option<(u32, f64, f64)> {
        let layer =
            if self.forward { self.layers.start } else { self.layers.end.checked_sub(1)? };
        if self.layers.is_empty() {
            return None;
        }
        let a = self.axis;
        let lo = f64::from(layer * BRICK) - self.reach[a];
        let hi = f64::from(layer * BRICK + BRICK - 1) + self.reach[a];
        let (p, q) = ((lo - self.index[a]) / self.step[a], (hi - self.index[a]) / self.step[a]);
        Some((layer, p.min(q), p.max(q)))
    }

    /// Takes in every voxel of use before depth `z`.
    fn reach(&mut self, z: f64) {
        while let Some((layer, from, to)) = self.next_layer() {
            if from >= z {
                break;
            }
            if self.forward {
                self.layers.start += 1;
            } else {
                self.layers.end -= 1;
            }
            let from = from.max(self.ray.start);
            if from < to {
                self.take_layer(layer, from, to);
            }
        }
    }

    /// Where the next voxel is of use at or behind `z`; forgets those that end before it.
    fn next_depth(&mut self, z: f64) -> Option<f64> {
        self.voxels.retain(|v| v.leave > z);
        loop {
            let first = self.voxels.iter().map(|v| v.enter).fold(f64::INFINITY, f64::min);
            let first = first.max(z);
            match self.next_layer() {
                Some((_, from, _)) if from < first => {
                    // It may hold an earlier one.
                    let next = f64::max(from, z) + 1.0;
                    self.reach(next);
                    self.voxels.retain(|v| v.leave > z);
                }
                _ => return (first < f64::INFINITY).then_some(first),
            }
        }
    }

    /// Takes in a layer of bricks that is of use between two depths.
    fn take_layer(&mut self, layer: u32, from: f64, to: f64) {
        let mut first = [layer; 3];
        let mut last = [layer; 3];
        for a in 0..3 {
            if a == self.axis {
                continue;
            }
            let (p, q) = (self.index[a] + self.step[a] * from, self.index[a] + self.step[a] * to);
            let lo = libm::floor((p.min(q) - self.reach[a]) / f64::from(BRICK));
            let hi = libm::floor((p.max(q) + self.reach[a]) / f64::from(BRICK));
            let end = f64::from(self.of.grid.dims[a] - 1);
            if hi < 0.0 || lo > end {
                return;
            }
            (first[a], last[a]) = (lo.max(0.0) as u32, hi.min(end) as u32);
        }
        for bz in first[2]..=last[2] {
            for by in first[1]..=last[1] {
                let id = self.of.grid.id([first[0], by, bz]);
                let end = self.of.grid.id([last[0], by, bz]);
                let at = self.of.bricks.partition_point(|(b, _)| b.id < id);
                let row = self.of.bricks[at..].iter().take_while(|(b, _)| b.id <= end);
                for (brick, eye_box) in row {
                    self.take_brick(brick, eye_box);
                }
            }
        }
    }

    /// Depths between which the ray is inside a box grown by the support.
    #[inline]
    fn inside(&self, lo: DVec3, hi: DVec3) -> Option<(f64, f64)> {
        let mut from = (lo.z - self.reach_z).max(self.ray.start);
        let mut to = hi.z + self.reach_z;
        for (a, (lo, hi)) in [(lo.x, hi.x), (lo.y, hi.y)].into_iter().enumerate() {
            let r = self.of.kernel[a].radius;
            let (lo, hi) = (lo - r - self.ray.at[a], hi + r - self.ray.at[a]);
            let slope = self.ray.slope[a];
            if slope == 0.0 {
                if lo >= 0.0 || hi <= 0.0 {
                    return None;
                }
            } else {
                let (p, q) = (lo / slope, hi / slope);
                from = from.max(p.min(q));
                to = to.min(p.max(q));
            }
        }
        (from < to).then_some((from, to))
    }

    fn take_brick(&mut self, brick: &Brick, eye_box: &EyeBox) {
        if self.inside(eye_box.lo, eye_box.hi).is_none() {
            return;
        }
        let view = &self.of.view;
        let corner = self.of.grid.corner(brick.id);
        let corner =
            view.eye_origin + view.eye_from_index * DVec3::from_array(corner.map(f64::from));
        for (i, &local) in brick.index.iter().enumerate() {
            let eye = corner + self.of.offsets[local as usize];
            let Some((enter, leave)) = self.inside(eye, eye) else { continue };
            let look = self.looks.look(&brick.values, i);
            if look.sigma <= 0.0 {
                continue;
            }
            let rgb = match &self.of.shader {
                None => look.rgb,
                Some(shader) => {
                    let normal = brick.normals.as_ref().map_or(NO_NORMAL, |n| n[i]);
                    shader.shade(look.rgb, normal, view.to_eye(eye))
                }
            };
            let (x, y) = (self.ray.at[0] - eye.x, self.ray.at[1] - eye.y);
            let mut sigma = f64::from(look.sigma) * view.cell;
            if self.ray.parallel {
                sigma *= self.of.kernel[0].at(x) * self.of.kernel[1].at(y);
            }
            let [r, g, b] = rgb.map(|c| sigma * f64::from(c));
            self.voxels.push(Near { enter, leave, x, y, z: eye.z, payload: [sigma, r, g, b] });
        }
    }
}

/// The kernel sums along a ray, from the voxels of use on a panel.
struct Field<'a> {
    kernel: &'a [Profile; 3],
    ray: &'a Ray,
    voxels: &'a [Near],
}

impl Field<'_> {
    /// Extinction and emission per unit of z.
    #[inline]
    fn at(&self, z: f64) -> [f64; 4] {
        let mut sum = [0.0; 4];
        let [gx, gy, gz] = self.kernel;
        for v in self.voxels {
            if z <= v.enter || z >= v.leave {
                continue;
            }
            let mut w = gz.at(z - v.z);
            if !self.ray.parallel {
                w *= gx.at(v.x + self.ray.slope[0] * z) * gy.at(v.y + self.ray.slope[1] * z);
            }
            for c in 0..4 {
                sum[c] += v.payload[c] * w;
            }
        }
        sum.map(|s| s * self.ray.secant)
    }
}

/// A stretch of the ray by itself: optical depth, and light of the three colours and of colour
/// one (which should be the opacity) as its front end sees it.
#[derive(Clone, Copy, Debug)]
struct Panel {
    depth: f64,
    light: [f64; 4],
}

/// What a ray has gathered.
#[derive(Clone, Copy, Debug, Default)]
struct Light {
    depth: f64,
    light: [f64; 3],
}

impl Light {
    fn add(&mut self, p: &Panel) {
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
struct Gauss {
    nodes: [f64; 4],
    weights: [f64; 4],
    /// The integral up to node i of the polynomial that is one at node j and zero at the others.
    up_to: [[f64; 4]; 4],
}

impl Gauss {
    fn new() -> Gauss {
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

    fn panel(&self, field: &Field, z: f64, h: f64) -> Panel {
        let at = self.nodes.map(|n| field.at(z + n * h));
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

/// `count` pixels of a picture, one at random in each of as many cells of about equal size; all
/// pixels where there are no more. The same for the same seed; ascending by rows of cells.
pub fn stratified(size: [u32; 2], count: usize, seed: u64) -> Vec<[u32; 2]> {
    let [w, h] = size.map(|n| n as usize);
    if w == 0 || h == 0 || count == 0 {
        return Vec::new();
    }
    if count >= w * h {
        return (0..w * h).map(|i| [(i % w) as u32, (i / w) as u32]).collect();
    }
    let mut state = seed;
    let mut draw = |n: usize| {
        // SplitMix64.
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((u128::from(z ^ (z >> 31)) * n as u128) >> 64) as usize
    };
    // Rows of cells about as high as the cells are wide; never more cells in a row than pixels.
    let even = (count as f64 * h as f64 / w as f64).sqrt() + 0.5;
    let rows = (even as usize).clamp(count.div_ceil(w), h.min(count));
    let mut out = Vec::with_capacity(count);
    for row in 0..rows {
        let (y0, y1) = (row * h / rows, (row + 1) * h / rows);
        let cells = (row + 1) * count / rows - row * count / rows;
        for cell in 0..cells {
            let (x0, x1) = (cell * w / cells, (cell + 1) * w / cells);
            out.push([(x0 + draw(x1 - x0)) as u32, (y0 + draw(y1 - y0)) as u32]);
        }
    }
    out
}

/// How far a picture is from what it should be (CONTRACTS.md, Colour and error): linear
/// premultiplied RGBA in units of 1/255, over the pixels where either has alpha above zero.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ErrorFigures {
    /// Root of the mean square over all four channels.
    pub rmse: f64,
    /// Largest over all four channels; infinite if a number is not finite.
    pub max: f64,
    /// Share of the pixels off by more than 1 in a channel.
    pub share_above_1: f64,
    /// Root of the mean square over RGB of the 8-bit sRGB pictures, in their steps.
    pub rmse_srgb8: f64,
    /// Pixels that count.
    pub n_pixels: usize,
}

impl ErrorFigures {
    /// Compares pixels of a picture, linear premultiplied RGBA, with what they should be, one
    /// by one. `background` is what lies behind the 8-bit pictures.
    ///
    /// # Panics
    /// If there are not as many of the one as of the other.
    pub fn compare(got: &[[f32; 4]], want: &[[f64; 4]], background: Background) -> ErrorFigures {
        assert_eq!(got.len(), want.len(), "each pixel needs one to be compared with");
        let mut figures = ErrorFigures::default();
        let (mut squares, mut above) = (0.0, 0usize);
        let (mut left, mut right) = (Vec::new(), Vec::new());
        for (got, want) in got.iter().zip(want) {
            let blank = |a: f64| a <= 0.0;
            if blank(f64::from(got[3])) && blank(want[3]) {
                continue;
            }
            left.push(*got);
            right.push(want.map(|x| x as f32));
            let mut worst = 0.0;
            for c in 0..4 {
                let off = worse(0.0, (f64::from(got[c]) - want[c]) * 255.0);
                squares += off * off;
                worst = f64::max(worst, off);
            }
            figures.max = figures.max.max(worst);
            above += usize::from(worst > 1.0);
        }
        figures.n_pixels = left.len();
        if figures.n_pixels == 0 {
            return figures;
        }
        let n = figures.n_pixels as f64;
        figures.rmse = (squares / (4.0 * n)).sqrt();
        figures.share_above_1 = above as f64 / n;
        let bytes = |pixels: Vec<[f32; 4]>| {
            Picture { size: [pixels.len() as u32, 1], pixels }.encode(PixelFormat::Rgb8, background)
        };
        let steps = bytes(left).iter().zip(bytes(right)).fold(0.0, |sum, (&a, b)| {
            let off = f64::from(a) - f64::from(b);
            sum + off * off
        });
        figures.rmse_srgb8 = (steps / (3.0 * n)).sqrt();
        figures
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_nodes_integrate_the_seventh_power_and_reach_their_nodes() {
        let g = Gauss::new();
        for power in 0..8 {
            let got: f64 = (0..4).map(|i| g.weights[i] * g.nodes[i].powi(power)).sum();
            assert!((got - 1.0 / f64::from(power + 1)).abs() < 1e-15, "power {power}: {got}");
        }
        for i in 0..4 {
            for power in 0..4 {
                let got: f64 = (0..4).map(|j| g.up_to[i][j] * g.nodes[j].powi(power)).sum();
                let want = g.nodes[i].powi(power + 1) / f64::from(power + 1);
                assert!((got - want).abs() < 1e-15, "node {i}, power {power}: {got}");
            }
        }
    }

    #[test]
    fn a_sample_has_one_pixel_a_cell_and_depends_on_its_seed_alone() {
        for (size, count) in
            [([512, 512], 4096), ([640, 480], 4096), ([7, 900], 100), ([900, 7], 100), ([5, 3], 14)]
        {
            let sample = stratified(size, count, 7);
            assert_eq!(sample.len(), count, "{size:?}");
            assert!(sample.iter().all(|p| p[0] < size[0] && p[1] < size[1]));
            let mut once = sample.clone();
            once.sort_unstable();
            once.dedup();
            assert_eq!(once.len(), count, "{size:?}: a pixel twice");
            assert_eq!(sample, stratified(size, count, 7));
            assert_ne!(sample, stratified(size, count, 8));
        }
        let even = stratified([512, 512], 4096, 1);
        for (i, p) in even.iter().enumerate() {
            assert_eq!([p[0] / 8, p[1] / 8], [i as u32 % 64, i as u32 / 64]);
        }
        assert_eq!(stratified([4, 2], 100, 1).len(), 8);
        assert!(stratified([4, 2], 0, 1).is_empty());
    }

    #[test]
    fn figures_are_those_of_the_contract() {
        let black = Background::Colour([0.0; 3]);
        let got = [[0.0f32; 4], [0.5, 0.5, 0.5, 1.0], [0.0; 4], [1.0, 1.0, 1.0, 1.0]];
        let mut want = got.map(|p| p.map(f64::from));
        assert_eq!(
            ErrorFigures::compare(&got, &want, black),
            ErrorFigures { n_pixels: 2, ..ErrorFigures::default() },
            "blank pixels do not count"
        );
        want[1][0] += 2.0 / 255.0;
        want[2][3] = 0.5 / 255.0;
        let f = ErrorFigures::compare(&got, &want, black);
        assert_eq!(f.n_pixels, 3);
        assert!((f.max - 2.0).abs() < 1e-12 && (f.share_above_1 - 1.0 / 3.0).abs() < 1e-12);
        assert!((f.rmse - (4.25f64 / 12.0).sqrt()).abs() < 1e-12, "{}", f.rmse);
        // Linear 0.5 is level 187.5, rounded to 188; 2/255 more is 189.
        assert!((f.rmse_srgb8 - (1.0f64 / 9.0).sqrt()).abs() < 1e-12, "{}", f.rmse_srgb8);
        let spoiled = [[f32::NAN, 0.0, 0.0, 1.0]];
        let f = ErrorFigures::compare(&spoiled, &[[0.0, 0.0, 0.0, 1.0]], black);
        assert_eq!((f.max, f.share_above_1), (f64::INFINITY, 1.0));
    }
}
