//! The limit where values are reconstructed first and classified then
//! ([`Classify::After`](slabcast_common::quality::Classify::After)).
//!
//! At a point x the field is the mean of the voxels' codes v, weighted by their kernels w,
//!
//! ```text
//! f(x) = sum w_i(x) v_i / sum w_i(x)
//! ```
//!
//! so that a constant comes back constant, up to the faces of the volume. The transfer function
//! says what f means there, extinction sigma and colour, and light falls on the colour by the
//! gradient of f, which is the exact derivative of the quotient. A pixel is then
//!
//! ```text
//! I = int sigma C exp(-int sigma) ds,     alpha = 1 - exp(-int sigma)
//! ```
//!
//! along the true ray, s in vox. Nothing is drawn outside the box of voxels, index coordinates from
//! -0.5 to n - 0.5, outside the cropping box, nor in front of the near plane.
//!
//! The rules are plain, so the work is in finding what a ray could miss. A transfer function may
//! jump, or be a spike that f passes within a hundredth of a vox. So a grid of blocks says where f
//! could be visible at all ([`blocks`]), and where the transfer function bends is known
//! ([`looks`]): a panel is halved for as long as f may pass a bend on it whose look no node has
//! seen.
//!
//! *Light.* With e the direction to the eye and g the gradient (eye axes, codes per vox), the
//! normal is that of `side g + e range / 1020`, per vox of level 0, where `side` is the sign of
//! g.e. So a surface is lit from both sides, and tissue too flat to have a side faces the eye
//! instead of sparkling. The formula is ambient, Lambert and Blinn-Phong.
//!
//! Voxels that are NaN are left out of both sums, and so are those that no brick holds. Infinities
//! count as the nearest finite code. Where no kernel reaches there is nothing.
//!
//! *Opacity by gradient.* Extinction is multiplied by the factor of `gradient_opacity` at the
//! gradient's magnitude. Halving a panel finds the points of that function; it may miss a jump
//! between two points at one magnitude.
//!
//! All voxels are kept in one array of 4 bytes each (codes are of 8 or 16 bits or f32, so
//! f32 has them exactly), 64 MiB for 256^3: too much for the largest volumes.
//!
//! The price, in seconds on one core for 1000 pixels of 512x512 of a volume of 256^3: 0.5 (mri256,
//! opaque skin, orthographic), 0.7 (aneurism, vessels, perspective), 13 (mri256, lit and
//! translucent all over, perspective). Before, 0.5 to make the array and the blocks.

mod blocks;
mod looks;
mod sums;

use super::profile::Profile;
use super::quadrature::{DEEP, Gauss, HALVINGS, Light, Panel};
use super::upright;
use blocks::Blocks;
use glam::{DMat3, DVec3};
use looks::{Emission, Lamp, Looks, emission};
use slabcast_common::brick::{Brick, BrickGrid, local_position};
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::Kernel;
use slabcast_common::view::{NEAR, Projection, View};
use std::sync::Arc;
use sums::{Line, Near};

/// Tolerance of halving: two levels must agree to this on a panel, as a share of the opacity so
/// far. Against 1e-8 pixels are then off by 1e-4 to 5e-4/255 (RMSE; at most 0.005), 200 pixels of
/// mri256 and aneurism. Ten times as much makes 1e-3/255 more (at most 0.008) for half the time;
/// 1e-8 takes 3 to 7 times as long.
const TOLERANCE: f64 = 1e-6;

/// Opacity so far, as a share of what a vox of the largest extinction has (at most 1 - 1/e), below
/// which the tolerance falls no further. Without it the first faint tissue of a ray is halved
/// without end, for a share of nearly nothing.
const FAINT: f64 = 1e-3;

/// A panel is halved for as long as it may hide this much opacity, as a share of the opacity so
/// far, in a bend of the transfer function that no node has seen. Nodes need to see no more than
/// the flank of a spike for two levels to disagree, so this may be coarser than the tolerance.
/// Spikes of 0.002 vox are found by it (a test has them).
const UNSEEN: f64 = 2e-4;

/// Two levels agree on a jump by chance where it lies between the middle nodes of both. Those are
/// 0.07 of a panel apart, so they may both be wrong by half of that.
const JUMP: f64 = 0.035;

/// Length of a panel before it is halved, in lattice steps along the kernel's axis that the ray
/// crosses fastest. About that of the other reference; others were not measured.
const PANEL: f64 = 0.5;

/// One view of a scene in f64 whose values are classified after reconstruction: the reference for
/// rendered pixels of that order. Any number of threads may ask for pixels.
#[derive(Debug)]
pub struct FieldReference {
    view: View,
    /// Voxels by i, then j, then k; NaN where there is none.
    codes: Vec<f32>,
    dims: [u32; 3],
    kernel: Profile,
    /// From eye coordinates less the origin to the kernel's own: upright, in lattice steps, where
    /// all three profiles are one.
    own_from_eye: DMat3,
    /// Steps of the lattice in the kernel's own coordinates (columns), and back.
    own_from_index: DMat3,
    index_from_own: DMat3,
    /// Farthest index distance, along each axis, at which a voxel's kernel reaches a point.
    reach: DVec3,
    looks: Looks,
    lamp: Option<Lamp>,
    /// Pairs of faces of the cropping box: a world axis by the eye's axes, and its ends in vox.
    crop: Vec<(DVec3, [f64; 2])>,
    blocks: Blocks,
    rule: Gauss,
    tolerance: f64,
}

impl FieldReference {
    /// Prepares `view` of the scene that `spec` describes; `bricks` hold all voxels of the volume,
    /// visible or not, in any order. Voxels that none of them holds are left out as if they were
    /// NaN.
    pub fn new(spec: &SceneSpec, view: View, bricks: &[Arc<Brick>]) -> FieldReference {
        let dims = spec.volume.lattice.dims;
        let looks = Looks::new(spec);
        let [std, radius] = spec.quality.kernel_shape();
        let (spread, lean) = upright::of(&view, std);
        let per_spread = DMat3::from_diagonal(DVec3::from_array(spread).recip());
        let own_from_eye = per_spread * upright::steps(&DMat3::IDENTITY, lean);
        let own_from_index = own_from_eye * view.eye_from_index;
        let index_from_own = own_from_index.inverse();
        let m = index_from_own;
        let reach =
            (m.x_axis.abs() + m.y_axis.abs() + m.z_axis.abs()) * radius + DVec3::splat(1e-6);
        let lattice = &spec.volume.lattice;
        let corner = lattice.world_from_index() * lattice.centre_index();
        let crop = spec.crop.iter().flat_map(|crop| {
            [0, 1, 2].map(|axis| {
                // Eye coordinates turned into world axes, counted from sample (0, 0, 0).
                let along = view.eye_from_world.col(axis);
                let ends = [crop.lo[axis], crop.hi[axis]];
                let zero = along.dot(view.eye_origin);
                (along, ends.map(|end| (end + corner[axis]) / lattice.vox() + zero))
            })
        });
        let crop = crop.collect();
        let range = looks.max_code - looks.min_code;
        // Coefficients overshoot.
        let beyond = if spec.quality.kernel == Kernel::Interpolating { range } else { 0.0 };
        let codes = dense(dims, bricks, [looks.min_code - beyond, looks.max_code + beyond]);
        let blocks = Blocks::new(dims, &codes, reach, |lo, hi| looks.visible(lo, hi));
        FieldReference {
            view,
            codes,
            dims,
            kernel: Profile::new(spec.quality.kernel, std, radius),
            own_from_eye,
            own_from_index,
            index_from_own,
            reach,
            lamp: Lamp::new(
                &spec.transfer.shading,
                &view,
                (looks.max_code - looks.min_code) * spec.volume.coarseness(),
            ),
            looks,
            crop,
            blocks,
            rule: Gauss::four_nodes(),
            tolerance: TOLERANCE,
        }
    }

    /// Returns this reference with another tolerance of the integration, per panel and relative to
    /// the opacity so far (1e-6 by default): to see whether the integration itself is exact enough.
    #[must_use]
    pub fn with_tolerance(self, tolerance: f64) -> FieldReference {
        FieldReference { tolerance, ..self }
    }

    /// Returns the field at a point in eye coordinates (vox), as a code that need not be whole; NaN
    /// where no kernel reaches. It goes on outside the volume's box, where nothing is drawn.
    pub fn value_at(&self, eye: DVec3) -> f64 {
        let (line, mut near) = (self.through(eye), Vec::new());
        self.gather(&line, 0.0, 0.0, &mut near);
        self.value(&near, &line, 0.0)
    }

    /// Returns the field on the ray of pixel (x, y), counted from the top left, at depth `z` (vox
    /// behind the target), as a code.
    pub fn value_on_ray(&self, [x, y]: [u32; 2], z: f64) -> f64 {
        let (at, slope, _) = self.ray(x, y);
        self.value_at(at + slope * z)
    }

    /// Returns the gradient of [`FieldReference::value_at`] along the eye's axes, in codes per vox;
    /// NaN where no kernel reaches.
    pub fn gradient_at(&self, eye: DVec3) -> DVec3 {
        let (line, mut near) = (self.through(eye), Vec::new());
        self.gather(&line, 0.0, 0.0, &mut near);
        self.with_gradient(&near, &line, 0.0).1
    }

    /// Returns the limit at pixel (x, y), counted from the top left: linear premultiplied RGBA.
    pub fn pixel(&self, x: u32, y: u32) -> [f64; 4] {
        let (at, slope, start) = self.ray(x, y);
        let line = self.line(at, slope);
        let secant = slope.length();
        let to_eye = slope / -secant;
        let longest = PANEL / line.slope.abs().max_element();
        let mut sum = Light::default();
        let mut near = Vec::new();
        let cut = self.cropped(at, slope);
        self.blocks.along(line.index, line.step, start, |from, to| {
            let (from, to) = (from.max(cut[0]), to.min(cut[1]));
            if from >= to {
                return true;
            }
            let panels = libm::ceil((to - from) / longest).max(1.0);
            let h = (to - from) / panels;
            for i in 0..panels as u32 {
                let z = from + h * f64::from(i);
                self.gather(&line, z, z + h, &mut near);
                let (lo, hi) =
                    near.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| {
                        (lo.min(v.code), hi.max(v.code))
                    });
                if lo <= hi && self.looks.visible(lo, hi) {
                    let of = Stretch { near: &near, line: &line, to_eye, secant };
                    let whole = self.part(&of, z, h);
                    self.halve(&of, z, h, &whole, HALVINGS, &mut sum);
                }
                if sum.depth > DEEP {
                    return false;
                }
            }
            true
        });
        let [r, g, b] = sum.light;
        [r, g, b, -libm::expm1(-sum.depth)]
    }

    /// Returns the limit ([`FieldReference::pixel`]) at each of `pixels`.
    pub fn pixels(&self, pixels: &[[u32; 2]]) -> Vec<[f64; 4]> {
        pixels.iter().map(|&[x, y]| self.pixel(x, y)).collect()
    }

    /// The ray of pixel (x, y): where it is at depth 0, by how much it moves per unit of depth, and
    /// the depth at which it begins.
    fn ray(&self, x: u32, y: u32) -> (DVec3, DVec3, f64) {
        let [w, h] = self.view.size.map(f64::from);
        let (px, py) = (f64::from(x) + 0.5 - w * 0.5, f64::from(y) + 0.5 - h * 0.5);
        match self.view.projection {
            Projection::Ortho { scale } => {
                (DVec3::new(px / scale, py / scale, 0.0), DVec3::Z, f64::NEG_INFINITY)
            }
            Projection::Persp { focal, distance } => {
                let (u, v) = (px / focal, py / focal);
                let at = DVec3::new(u * distance, v * distance, 0.0);
                (at, DVec3::new(u, v, 1.0), (NEAR - 1.0) * distance)
            }
        }
    }

    /// Depths between which a ray is inside the cropping box.
    fn cropped(&self, at: DVec3, slope: DVec3) -> [f64; 2] {
        let whole = [f64::NEG_INFINITY, f64::INFINITY];
        self.crop.iter().fold(whole, |[from, to], (along, [lo, hi])| {
            let (q, rise) = (along.dot(at), along.dot(slope));
            if rise == 0.0 {
                let inside = (*lo..=*hi).contains(&q);
                return if inside { [from, to] } else { [from, f64::NEG_INFINITY] };
            }
            let (a, b) = ((lo - q) / rise, (hi - q) / rise);
            [from.max(a.min(b)), to.min(a.max(b))]
        })
    }

    /// A line along depth through a point.
    fn through(&self, eye: DVec3) -> Line {
        self.line(eye, DVec3::Z)
    }

    fn node(&self, of: &Stretch, z: f64) -> Node {
        let (f, gradient) = match self.lamp.is_some() || self.looks.is_modulated() {
            true => self.with_gradient(of.near, of.line, z),
            false => (self.value(of.near, of.line, z), DVec3::ZERO),
        };
        let look = self.looks.at(f);
        let [sigma, rgb @ ..] = look;
        let sigma = sigma * self.looks.gradient_factor(gradient);
        let [r, g, b] = match &self.lamp {
            Some(lamp) if sigma > 0.0 => lamp.light(rgb, gradient, of.to_eye),
            _ => rgb,
        };
        let sigma = sigma * of.secant;
        Node { f, unlit: emission(look), sums: [sigma, sigma * r, sigma * g, sigma * b] }
    }

    fn part(&self, of: &Stretch, z: f64, h: f64) -> Part {
        let nodes = self.rule.nodes.map(|n| self.node(of, z + n * h));
        Part { panel: self.rule.sum(&nodes.map(|node| node.sums), h), nodes }
    }

    /// Takes the panel at `z` by halves until two levels agree and no bend of the transfer function
    /// can hide between their nodes.
    fn halve(&self, of: &Stretch, z: f64, h: f64, whole: &Part, left: u32, sum: &mut Light) {
        let half = h * 0.5;
        let parts = [self.part(of, z, half), self.part(of, z + half, half)];
        let open = libm::exp(-sum.depth);
        let [front, back] = [&parts[0].panel, &parts[1].panel];
        let behind = libm::exp(-front.depth);
        let depth = front.depth + back.depth;
        // Light of colour one is the opacity, and how far off it is says more than two levels.
        let mut off = (front.light[3] + behind * back.light[3] + libm::expm1(-depth)).abs();
        off = off.max((libm::exp(-whole.panel.depth) - libm::exp(-depth)).abs());
        for c in 0..4 {
            let joined = front.light[c] + behind * back.light[c];
            off = off.max((joined - whole.panel.light[c]).abs());
        }
        let [unseen, jump] = self.hidden(&parts, h * of.secant);
        off = off.max(jump * JUMP);
        // While nearly nothing is visible, a share of it would be less than any picture needs.
        let opacity = -libm::expm1(-(sum.depth + depth));
        let one_vox = -libm::expm1(-self.looks.sigma_max.min(1.0));
        let agree = open * off <= self.tolerance * opacity.max(FAINT * one_vox)
            && open * unseen <= UNSEEN * opacity.max(one_vox);
        if agree || left == 0 {
            for part in &parts {
                sum.add(&part.panel);
            }
            return;
        }
        for (i, part) in parts.iter().enumerate() {
            if sum.depth < DEEP {
                self.halve(of, z + half * i as f64, half, part, left - 1, sum);
            }
        }
    }

    /// Returns bounds on the opacity or light that a panel of `length` vox can hide because f
    /// passes a bend of the transfer function: by a look that no node has, and by a jump.
    fn hidden(&self, parts: &[Part; 2], length: f64) -> [f64; 2] {
        let (n, nodes) = (8, [&parts[0].nodes, &parts[1].nodes]);
        let node = |i: usize| &nodes[i / 4][i % 4];
        let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
        let (mut least, mut most) = ([f64::INFINITY; 4], [f64::NEG_INFINITY; 4]);
        let mut bent = 0.0f64;
        for i in 0..n {
            let Node { f, unlit, .. } = *node(i);
            if f.is_nan() {
                continue;
            }
            for c in 0..4 {
                (least[c], most[c]) = (least[c].min(unlit[c]), most[c].max(unlit[c]));
            }
            (lo, hi) = (lo.min(f), hi.max(f));
            if i > 0 && i + 1 < n {
                let place = |i: usize| (self.rule.nodes[i % 4] + (i / 4) as f64) * 0.5;
                let t = (place(i) - place(i - 1)) / (place(i + 1) - place(i - 1));
                let chord = node(i - 1).f * (1.0 - t) + node(i + 1).f * t;
                bent = bent.max((f - chord).abs());
            }
        }
        // From the outer nodes to the ends it is a quarter of the way between the outer two.
        for (end, next) in [(0, 1), (n - 1, n - 2)] {
            let end = node(end).f * 1.27 - node(next).f * 0.27;
            (lo, hi) = (lo.min(end), hi.max(end));
        }
        let Some(bends) = self.looks.bends(lo - bent, hi + bent) else { return [0.0; 2] };
        let unseen = |c: usize| (bends.most[c] - most[c]).max(least[c] - bends.least[c]);
        let unseen = (0..4).map(unseen).fold(0.0, f64::max);
        [unseen, bends.jump].map(|e| (e * length).min(1.0))
    }
}

/// A stretch of a ray with the voxels whose kernels it meets.
struct Stretch<'a> {
    near: &'a [Near],
    line: &'a Line,
    to_eye: DVec3,
    secant: f64,
}

/// Field and light at a node of a panel.
#[derive(Clone, Copy, Debug)]
struct Node {
    /// The field.
    f: f64,
    /// Without light, which knows no bends of the transfer function.
    unlit: Emission,
    /// Extinction and emission per unit of z, lit.
    sums: [f64; 4],
}

/// A panel with its nodes.
struct Part {
    panel: Panel,
    nodes: [Node; 4],
}

/// All voxels in one array, with infinities as the nearest of the finite codes at the `ends`.
fn dense(dims: [u32; 3], bricks: &[Arc<Brick>], ends: [f64; 2]) -> Vec<f32> {
    let [nx, ny, nz] = dims.map(|n| n as usize);
    let grid = BrickGrid::new(dims);
    let mut codes = vec![f32::NAN; nx * ny * nz];
    for brick in bricks {
        let corner = grid.corner(brick.id);
        for (n, &local) in brick.index.iter().enumerate() {
            let p = local_position(local);
            let [i, j, k] = [0, 1, 2].map(|a| (corner[a] + p[a]) as usize);
            let code = brick.values.code(n);
            codes[(k * ny + j) * nx + i] =
                if code.is_nan() { f32::NAN } else { code.clamp(ends[0], ends[1]) as f32 };
        }
    }
    codes
}
