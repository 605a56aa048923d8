//! Along a true ray: where it runs and which voxels it meets.

use super::{EyeBox, Reference, upright};
use glam::DVec3;
use slabcast_common::brick::{BRICK_EDGE, Brick};
use slabcast_common::shade::NO_NORMAL;
use slabcast_common::transfer::Classifier;
use slabcast_common::view::{NEAR, Projection};

/// Length of a panel before it is halved, in standard deviations of the kernel along the axis
/// that the ray crosses fastest. Where kernels end the field has kinks, and two levels may agree
/// over one by chance: twice as long, the error triples for as many kernel values; half as long,
/// it is a quarter for 1.7 times the values (peer-semi, at a tolerance of 1e-6).
const PANEL: f64 = 0.8;

/// A pixel's ray by depth z: `(at + slope z, z)`, upright.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    pub(super) at: [f64; 2],
    pub(super) slope: [f64; 2],
    /// Part of the slope that is the kernel's shear and not the eye's.
    pub(super) lean: [f64; 2],
    /// The near plane.
    pub(super) start: f64,
    /// Length of the ray between two planes one apart.
    pub(super) secant: f64,
    pub(super) parallel: bool,
    /// Panels to begin with.
    pub(super) step: f64,
}

impl Ray {
    /// Depths between which the ray is inside a box grown by `reach` along the eye's axes.
    #[inline]
    pub(super) fn inside(&self, lo: DVec3, hi: DVec3, reach: [f64; 3]) -> Option<(f64, f64)> {
        let mut from = (lo.z - reach[2]).max(self.start);
        let mut to = hi.z + reach[2];
        for (a, (lo, hi)) in [(lo.x, hi.x), (lo.y, hi.y)].into_iter().enumerate() {
            let (lo, hi) = (lo - reach[a] - self.at[a], hi + reach[a] - self.at[a]);
            let slope = self.slope[a];
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
}

impl Reference {
    pub(super) fn ray(&self, x: u32, y: u32) -> Ray {
        let [w, h] = self.view.size.map(f64::from);
        let (px, py) = (f64::from(x) + 0.5 - w * 0.5, f64::from(y) + 0.5 - h * 0.5);
        let (at, [u, v], start) = match self.view.projection {
            Projection::Ortho { scale } => ([px / scale, py / scale], [0.0; 2], f64::NEG_INFINITY),
            Projection::Persp { focal, distance } => {
                let (u, v) = (px / focal, py / focal);
                ([u * distance, v * distance], [u, v], (NEAR - 1.0) * distance)
            }
        };
        let across = |x: f64, y: f64, z: f64| {
            let p = upright::point(DVec3::new(x, y, z), self.lean);
            [p.x, p.y]
        };
        let (slope, lean) = (across(u, v, 1.0), across(0.0, 0.0, 1.0));
        let std = self.std;
        let step = std.z.min(std.x / slope[0].abs()).min(std.y / slope[1].abs());
        Ray {
            at: across(at[0], at[1], 0.0),
            slope,
            lean,
            start,
            secant: (1.0 + u * u + v * v).sqrt(),
            parallel: slope == [0.0; 2],
            step: PANEL * step,
        }
    }
}

/// A voxel whose kernel the ray meets.
#[derive(Clone, Copy, Debug)]
pub struct Near {
    /// Depths between which the ray is inside its support.
    pub(super) enter: f64,
    pub(super) leave: f64,
    /// From the voxel to where the ray passes the plane z = 0.
    pub(super) x: f64,
    pub(super) y: f64,
    /// Depth of the voxel, in vox.
    pub(super) z: f64,
    /// Extinction times the cell, and that times the three colours. For parallel rays times the
    /// profiles across, which are the same all along.
    pub(super) payload: [f64; 4],
}

/// Finds the voxels along a ray, layer of bricks after layer, no farther than it must.
pub(super) struct Walk<'a> {
    of: &'a Reference,
    ray: &'a Ray,
    looks: &'a Classifier,
    /// Distance along each of the eye's axes within which a voxel contributes.
    of_use: [f64; 3],
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
    pub(super) voxels: Vec<Near>,
}

impl<'a> Walk<'a> {
    pub(super) fn new(
        of: &'a Reference,
        ray: &'a Ray,
        looks: &'a Classifier,
        reach_z: f64,
    ) -> Walk<'a> {
        let m = of.index_from_eye;
        let step = m * DVec3::new(ray.slope[0], ray.slope[1], 1.0);
        let index = m * (DVec3::new(ray.at[0], ray.at[1], 0.0) - of.origin);
        let [rx, ry, rz] = of.kernel.each_ref().map(|k| k.radius);
        // Sheets put sections elsewhere along the eye's ray, and not along the kernel's lean.
        let beside = |axis: usize| ray.lean[axis].abs() * (reach_z - rz);
        let (rx, ry) = (rx + beside(0), ry + beside(1));
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
            of_use: [rx, ry, reach_z],
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
    pub(super) fn next_layer(&self) -> Option<(u32, f64, f64)> {
        let layer =
            if self.forward { self.layers.start } else { self.layers.end.checked_sub(1)? };
        if self.layers.is_empty() {
            return None;
        }
        let a = self.axis;
        let lo = f64::from(layer * BRICK_EDGE) - self.reach[a];
        let hi = f64::from(layer * BRICK_EDGE + BRICK_EDGE - 1) + self.reach[a];
        let (p, q) = ((lo - self.index[a]) / self.step[a], (hi - self.index[a]) / self.step[a]);
        Some((layer, p.min(q), p.max(q)))
    }

    /// Takes in every voxel of use before depth `z`.
    pub(super) fn reach(&mut self, z: f64) {
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

    /// Returns the depth at or behind `z` from which the next voxel counts; forgets voxels that end
    /// before it.
    pub(super) fn next_depth(&mut self, z: f64) -> Option<f64> {
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
    pub(super) fn take_layer(&mut self, layer: u32, from: f64, to: f64) {
        let mut first = [layer; 3];
        let mut last = [layer; 3];
        for a in 0..3 {
            if a == self.axis {
                continue;
            }
            let (p, q) = (self.index[a] + self.step[a] * from, self.index[a] + self.step[a] * to);
            let lo = libm::floor((p.min(q) - self.reach[a]) / f64::from(BRICK_EDGE));
            let hi = libm::floor((p.max(q) + self.reach[a]) / f64::from(BRICK_EDGE));
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

    pub(super) fn take_brick(&mut self, brick: &Brick, eye_box: &EyeBox) {
        if self.ray.inside(eye_box.lo, eye_box.hi, self.of_use).is_none() {
            return;
        }
        let view = &self.of.view;
        let corner = self.of.grid.corner(brick.id);
        let corner = DVec3::from_array(corner.map(f64::from));
        let (seen, corner) = (
            view.eye_origin + view.eye_from_index * corner,
            self.of.origin + self.of.steps * corner,
        );
        for (i, &local) in brick.index.iter().enumerate() {
            let offset = self.of.offsets[local as usize];
            let eye = corner + offset;
            let Some((enter, leave)) = self.ray.inside(eye, eye, self.of_use) else { continue };
            let look = self.looks.classify_voxel(brick, i);
            if look.sigma <= 0.0 {
                continue;
            }
            let rgb = match &self.of.shader {
                None => look.rgb,
                Some(shader) => {
                    let normal = brick.normals.as_ref().map_or(NO_NORMAL, |n| n[i]);
                    shader.shade(
                        look.rgb,
                        normal,
                        view.direction_to_eye(seen + upright::seen(offset, self.of.lean)),
                    )
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
