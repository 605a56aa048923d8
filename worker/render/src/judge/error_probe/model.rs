//! Error of the model itself and of rounded positions, at a few of a tile's pixels.
//!
//! Eight pixels of each block that [`estimate`](crate::judge::error_probe) draws again are worked
//! out point by point along their rays, as the limit is, but coarsely: the field of kernels is
//! taken at steps of 1.2 of the kernel's deviation, which a sum of Gaussians does not feel, and
//! light is constant between. Beside the field as it is defined stand three that differ by one
//! thing each:
//!
//! - *positions*: voxels where sheets have them, rounded to a part of a pixel and of a sheet;
//! - *truncation*: the whole Gaussian, neither cut nor lowered by its edge;
//! - *ripple*: the field divided by the field of an endless lattice of ones. The divisor is
//!   periodic: one plus a wave for each vector of the lattice's dual, as high as the kernel's
//!   Fourier transform there (Poisson's formula). The nearest vectors are enough.
//!
//! The errors are the differences of these three pictures from the first one, up to the coarseness
//! of the steps, which all of them share.

use crate::primitives::footprint::Profile;
use crate::primitives::profile_table::ProfileTable;
use crate::scene::Frame;
use glam::DVec3;
use slabcast_common::brick::Brick;
use slabcast_common::message::ErrorsBySource;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Compositing, Kernel};
use slabcast_common::view::{NEAR, Projection, SUBPIXELS, View};
use std::cell::Cell;
use std::sync::Arc;

/// Steps along a ray, in deviations of the kernel.
const STEP: f64 = 1.2;

/// Deviations after which what is left of a Gaussian is left out: 3e-5 of its integral. Voxels are
/// looked at within this reach, so it is what they take; at 5.8 twice the time.
const WHOLE: f64 = 4.2;

/// Waves below this height are left out: a thousandth of a step of eight bits in all.
const LOWEST: f64 = 1e-6;

/// Fields: as defined, rounded, whole. The levelled one is made of the first.
const FIELDS: usize = 3;

/// A wave of the lattice: `2 height cos(2 pi turns . index)`.
struct Wave {
    /// Turns a step of each index axis.
    turns: DVec3,
    height: f64,
}

/// A frame's tables.
pub(crate) struct Model {
    cut: [Arc<ProfileTable>; 3],
    whole: [Arc<ProfileTable>; 3],
    waves: Vec<Wave>,
    /// Reach of the whole Gaussian along the eye's axes, in vox.
    reach: DVec3,
    step: f64,
}

/// A voxel near a block's rays, upright as these ([`slabcast_common::kernel::Lean::upright`]).
#[derive(Clone)]
struct Near {
    eye: DVec3,
    /// Position in eye coordinates.
    seen: DVec3,
    /// Position rounded as sheets have it; in perspective, where each sheet rounds otherwise, in
    /// depth alone.
    rounded: DVec3,
    /// Index of the brick and of the voxel in it.
    voxel: (u32, u32),
    /// Extinction per vox and that times the colours, for kernels that integrate to one: known of
    /// those that a ray came to.
    payload: Cell<Option<[f32; 4]>>,
    /// Steps that it reaches, from one on to the one behind the last.
    steps: [usize; 2],
    /// Offset of the voxel's weights in depth, once they are known.
    deep: Cell<Option<usize>>,
}

impl Near {
    fn payload(&self, frame: &Frame, bricks: &[Arc<Brick>]) -> [f32; 4] {
        self.payload.get().unwrap_or_else(|| {
            let (brick, i) = self.voxel;
            let unit = 1.0 / frame.raw_scale;
            let payload = frame.payload(&bricks[brick as usize], i as usize, self.seen);
            let payload = payload.map(|p| p * unit);
            self.payload.set(Some(payload));
            payload
        })
    }
}

/// Voxels near a block, front to back, and the steps along its rays, which are the same for all of
/// them.
struct Column {
    near: Vec<Near>,
    start: f64,
    step: f64,
    /// Farther than rounding moves any of them across.
    rounding: f64,
    /// Weights in depth of those voxels that a ray came to, of the steps of each.
    deep: Vec<[f32; FIELDS]>,
    /// Sums along the ray at hand.
    field: Vec<[[f32; 4]; FIELDS]>,
}

impl Column {
    /// The middle of a step.
    fn at(&self, j: usize) -> f64 {
        self.start + (j as f64 + 0.5) * self.step
    }
}

/// A ray: `(at + slope z, z)`, upright.
struct Ray {
    at: [f64; 2],
    slope: [f64; 2],
    near: f64,
    secant: f64,
}

/// Light on its way.
#[derive(Clone, Copy)]
struct Light {
    through: f64,
    colour: [f64; 3],
}

impl Light {
    const NEW: Light = Light { through: 1.0, colour: [0.0; 3] };

    /// Passes a step of `length` with these sums per vox.
    fn pass(&mut self, [sigma, rest @ ..]: [f32; 4], length: f64) {
        if sigma <= 0.0 {
            return;
        }
        let left = libm::exp(-f64::from(sigma) * length);
        let light = self.through * (1.0 - left) / f64::from(sigma);
        for (c, e) in self.colour.iter_mut().zip(rest) {
            *c += light * f64::from(e);
        }
        self.through *= left;
    }

    fn off(&self, other: &Light) -> f64 {
        let opacity = self.through - other.through;
        let colour = self.colour.iter().zip(other.colour).map(|(a, b)| (a - b) * (a - b));
        opacity * opacity + colour.sum::<f64>()
    }
}

impl Model {
    /// The tables of `frame`; `None` where opacities are added up, whose limit is another.
    pub(crate) fn of(frame: &Frame) -> Option<Model> {
        let (view, q) = (&frame.view, &frame.scene.quality);
        if q.compositing == Compositing::Paper || frame.is_field() {
            return None;
        }
        let (std, radius) = (view.kernel_std.to_array(), view.kernel_radius.to_array());
        let profile: [Profile; 3] =
            std::array::from_fn(|a| Profile::new(q.kernel, std[a], radius[a]));
        let shelf = frame.scene.shelf();
        let of = |a: usize, whole, reach, at: &dyn Fn(f64) -> f64| {
            shelf.profile((std[a], radius[a], whole), || ProfileTable::new(reach, at))
        };
        let cut = std::array::from_fn(|a| of(a, false, radius[a], &|u| profile[a].at(u)));
        let gaussian = q.kernel == Kernel::Gaussian;
        let reach = if gaussian { std.map(|s| s * WHOLE) } else { radius };
        let whole = std::array::from_fn(|a| {
            let norm = 1.0 / (std[a] * (2.0 * std::f64::consts::PI).sqrt());
            let bell = |u: f64| norm * libm::exp(-0.5 * u * u / (std[a] * std[a]));
            of(a, true, reach[a], &|u| if gaussian { bell(u) } else { profile[a].at(u) })
        });
        let waves = waves(view, &profile, radius);
        Some(Model { cut, whole, waves, reach: reach.into(), step: STEP * view.kernel_std.z })
    }

    /// Looks at eight pixels of `block`.
    pub(crate) fn sample(
        &self,
        frame: &Frame,
        block: Rect,
        bricks: &[Arc<Brick>],
        samples: &mut ErrorsBySource,
    ) {
        let Some(mut column) = self.near(frame, block, bricks) else { return };
        for (x, y) in [(0, 3), (1, 6), (2, 1), (3, 4), (4, 7), (5, 2), (6, 5), (7, 0)] {
            let ray = ray(&frame.view, block.x0 + x, block.y0 + y);
            let seen = self.follow((frame, bricks), &ray, &mut column);
            let Some([as_is, rounded, whole, level]) = seen else { continue };
            let there = |other: &Light| as_is.through < 1.0 || other.through < 1.0;
            samples.positions.add_pixel(there(&rounded), rounded.off(&as_is));
            samples.truncation.add_pixel(there(&whole), whole.off(&as_is));
            samples.ripple.add_pixel(there(&level), level.off(&as_is));
        }
    }

    /// The voxels whose whole kernel may reach a ray of the block; `None`: there are none.
    fn near(&self, frame: &Frame, block: Rect, bricks: &[Arc<Brick>]) -> Option<Column> {
        let view = &frame.view;
        let middle = ray(view, (block.x0 + block.x1) / 2, (block.y0 + block.y1) / 2);
        let lean = &view.kernel_lean;
        let half = f64::from((block.x1 - block.x0).max(block.y1 - block.y0)) * 0.5 + 1.0;
        let half = half * (1.0 + lean.row.abs());
        let per_vox = |z: f64| match view.projection {
            Projection::Ortho { scale } => scale,
            Projection::Persp { focal, distance } => focal / (z + distance).max(NEAR * distance),
        };
        let phases = f64::from(view.depth_phases());
        let mut near = Vec::new();
        for (which, brick) in bricks.iter().enumerate() {
            let corner = frame.corner(brick.id);
            // A sphere about the brick's middle, before its voxels.
            let centre = lean.upright(view.offset_in_eye([7; 3]) * 0.5);
            let (at, wide) = (
                lean.upright(corner.eye) + centre,
                centre.length().max(longest(view)) + self.reach.length(),
            );
            let nearest = (at.z - wide).max(middle.near);
            let slack = wide + half / per_vox(nearest);
            let off =
                |eye: DVec3, a: usize| (eye[a] - middle.at[a] - middle.slope[a] * eye.z).abs();
            let slanted = |a: usize| 1.0 + middle.slope[a].abs();
            if (0..2).any(|a| off(at, a) > slack * slanted(a)) {
                continue;
            }
            for (i, &local) in brick.index.iter().enumerate() {
                let placed = frame.place(&corner, local);
                let (seen, eye) = (placed.eye, lean.upright(placed.eye));
                let wide = half / per_vox((eye.z - self.reach.z).max(middle.near));
                let slope = |a: usize| middle.slope[a].abs() * self.reach.z;
                if (0..2).any(|a| off(eye, a) > self.reach[a] + wide + slope(a)) {
                    continue;
                }
                let mut rounded = seen;
                rounded.z = f64::from(placed.z) / phases * view.thickness;
                if let Projection::Ortho { scale } = view.projection {
                    let screen = view.screen(seen.x, seen.y, scale);
                    for a in 0..2 {
                        let pixels =
                            screen[a] as f64 / f64::from(SUBPIXELS) - f64::from(view.size[a]) * 0.5;
                        rounded[a] = pixels / scale;
                    }
                }
                let rounded = lean.upright(rounded);
                let voxel = (which as u32, i as u32);
                let (payload, steps, deep) = (Cell::new(None), [0; 2], Cell::new(None));
                near.push(Near { eye, seen, rounded, voxel, payload, steps, deep });
            }
        }
        // Numbers and places are sorted, not voxels, of which each is as long as two lines of a
        // cache.
        let mut order: Vec<(f64, u32)> = near.iter().map(|v| v.eye.z).zip(0..).collect();
        order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut near: Vec<Near> =
            order.into_iter().map(|(_, i)| near[i as usize].clone()).collect();
        let start = (near.first()?.eye.z - self.reach.z).max(middle.near);
        let farthest = near.last()?.eye.z + self.reach.z;
        let depth = farthest - start;
        // A step of an endless volume is never met: positions are at most 2^30 phases apart.
        let steps = (depth / self.step).ceil().clamp(1.0, 1e7) as usize;
        for v in &mut near {
            let at = |z: f64| (z - start) / self.step - 0.5;
            let first = at(v.eye.z - self.reach.z).ceil().max(0.0) as usize;
            // Below zero it is none.
            let end = (at(v.eye.z + self.reach.z).floor() + 1.0) as usize;
            v.steps = [first.min(steps), end.clamp(first.min(steps), steps)];
        }
        let rounding = 2.0 / (f64::from(SUBPIXELS) * per_vox(farthest));
        let (step, deep, field) = (self.step, Vec::new(), Vec::new());
        Some(Column { near, start, step, rounding, deep, field })
    }

    /// The four pictures of a ray; `None` if no voxel reaches it.
    fn follow(
        &self,
        (frame, bricks): (&Frame, &[Arc<Brick>]),
        ray: &Ray,
        column: &mut Column,
    ) -> Option<[Light; 4]> {
        let parallel = ray.slope == [0.0; 2];
        let mut field = std::mem::take(&mut column.field);
        let mut deep = std::mem::take(&mut column.deep);
        field.clear();
        let (mut lights, mut waves) =
            ([Light::NEW; 4], Along::new(&self.waves, &frame.view, ray, column.start, self.step));
        let mut passed = 0;
        let mut met = false;
        let mut pass =
            |upto: usize, field: &mut Vec<[[f32; 4]; FIELDS]>, lights: &mut [Light; 4]| {
                let length = self.step * ray.secant;
                while passed < upto {
                    let here = field.get(passed).copied().unwrap_or_default();
                    let level = waves.next();
                    for (light, sums) in lights.iter_mut().zip(here) {
                        light.pass(sums, length);
                    }
                    lights[3].pass(here[0].map(|s| s * level), length);
                    passed += 1;
                }
            };
        for v in &column.near {
            let [first, end] = v.steps;
            pass(first, &mut field, &mut lights);
            if lights.iter().all(|l| l.through < frame.scene.quality.eps / 16.0) {
                break;
            }
            let across =
                |z: f64, place: &DVec3| [0, 1].map(|a| ray.at[a] + ray.slope[a] * z - place[a]);
            let slack =
                |a: usize| self.reach[a] + ray.slope[a].abs() * self.reach.z + column.rounding;
            let middle = across(v.eye.z, &v.eye);
            if first == end || (0..2).any(|a| middle[a].abs() > slack(a)) {
                continue;
            }
            let of = |tables: &[Arc<ProfileTable>; 3], [x, y]: [f64; 2]| {
                tables[0].at(x) * tables[1].at(y)
            };
            let mut weights = [0.0; FIELDS];
            if parallel {
                let (x, rounded) = (across(0.0, &v.eye), across(0.0, &v.rounded));
                weights = [of(&self.cut, x), of(&self.cut, rounded), of(&self.whole, x)];
                if weights == [0.0; FIELDS] {
                    continue;
                }
            }
            let payload = v.payload(frame, bricks);
            if field.len() < end {
                field.resize(end, Default::default());
            }
            let from = v.deep.get().unwrap_or_else(|| {
                let from = deep.len();
                v.deep.set(Some(from));
                deep.extend((first..end).map(|j| {
                    let (off, rounded) = (column.at(j) - v.eye.z, column.at(j) - v.rounded.z);
                    let [cut, whole] = [&self.cut[2], &self.whole[2]];
                    [cut.at(off), cut.at(rounded), whole.at(off)]
                }));
                from
            });
            for (j, (here, deep)) in field[first..end].iter_mut().zip(&deep[from..]).enumerate() {
                if !parallel {
                    let z = column.at(first + j);
                    let x = across(z, &v.eye);
                    let mut rounded = x;
                    let sheet = libm::floor(z / frame.view.thickness) as i32;
                    if let Some(scale) = frame.view.scale_at(sheet) {
                        let off = [0, 1].map(|a| {
                            let there = frame.view.screen_coordinate(a, v.seen[a], scale) as f64
                                / f64::from(SUBPIXELS);
                            let exact = v.seen[a] * scale + f64::from(frame.view.size[a]) * 0.5;
                            (there - exact) / scale
                        });
                        rounded[0] -= off[0] - frame.view.kernel_lean.row * off[1];
                        rounded[1] -= off[1];
                    }
                    weights = [of(&self.cut, x), of(&self.cut, rounded), of(&self.whole, x)];
                }
                for ((here, weight), deep) in here.iter_mut().zip(weights).zip(deep) {
                    let w = weight * deep;
                    met |= w > 0.0;
                    for (here, payload) in here.iter_mut().zip(payload) {
                        *here += payload * w;
                    }
                }
            }
        }
        pass(field.len(), &mut field, &mut lights);
        (column.field, column.deep) = (field, deep);
        met.then_some(lights)
    }
}

/// The longest way from a brick's middle to one of its corners' voxels.
fn longest(view: &View) -> f64 {
    let m = view.kernel_lean.upright_steps(&view.eye_from_index);
    3.5 * (m.x_axis.length() + m.y_axis.length() + m.z_axis.length())
}

fn ray(view: &View, x: i32, y: i32) -> Ray {
    let px = f64::from(x) + 0.5 - f64::from(view.size[0]) * 0.5;
    let py = f64::from(y) + 0.5 - f64::from(view.size[1]) * 0.5;
    let (at, [u, v], near) = match view.projection {
        Projection::Ortho { scale } => ([px / scale, py / scale], [0.0; 2], f64::NEG_INFINITY),
        Projection::Persp { focal, distance } => {
            let (u, v) = (px / focal, py / focal);
            ([u * distance, v * distance], [u, v], (NEAR - 1.0) * distance)
        }
    };
    let upright = |x: f64, y: f64, z: f64| {
        let p = view.kernel_lean.upright(DVec3::new(x, y, z));
        [p.x, p.y]
    };
    Ray {
        at: upright(at[0], at[1], 0.0),
        slope: upright(u, v, 1.0),
        near,
        secant: (1.0 + u * u + v * v).sqrt(),
    }
}

/// The waves of the lattice that are high enough to matter, of each pair one.
fn waves(view: &View, profile: &[Profile; 3], radius: [f64; 3]) -> Vec<Wave> {
    let dual = view.kernel_lean.upright_steps(&view.eye_from_index).inverse().transpose();
    // The transform of an even profile, by the midpoint rule: it ends in nothing, or nearly.
    const N: usize = 256;
    let nodes: [[(f64, f64); N]; 3] = std::array::from_fn(|a| {
        let h = radius[a] / N as f64;
        std::array::from_fn(|i| {
            let u = (i as f64 + 0.5) * h;
            (u, profile[a].at(u))
        })
    });
    let transform = |a: usize, f: f64| {
        let at = |(u, g): &(f64, f64)| g * libm::cos(2.0 * std::f64::consts::PI * f * u);
        2.0 * radius[a] / N as f64 * nodes[a].iter().map(at).sum::<f64>()
    };
    let mut waves = Vec::new();
    for k in -2..=2 {
        for j in -2..=2 {
            for i in -2..=2 {
                // One of each pair of opposite waves: its first component that is not zero is
                // positive.
                if [k, j, i].into_iter().find(|&n| n != 0).is_none_or(|n| n < 0) {
                    continue;
                }
                let turns = DVec3::new(f64::from(i), f64::from(j), f64::from(k));
                let f = dual * turns;
                let height = transform(0, f.x) * transform(1, f.y) * transform(2, f.z);
                if height.abs() > LOWEST {
                    waves.push(Wave { turns, height });
                }
            }
        }
    }
    waves
}

/// The waves along a ray, step by step: each turns by the same angle.
struct Along(Vec<[[f64; 2]; 2]>);

impl Along {
    fn new(waves: &[Wave], view: &View, ray: &Ray, start: f64, step: f64) -> Along {
        let index_from_eye = view.kernel_lean.upright_steps(&view.eye_from_index).inverse();
        let way = index_from_eye * DVec3::new(ray.slope[0], ray.slope[1], 1.0);
        let z = start + 0.5 * step;
        let at = DVec3::new(ray.at[0] + ray.slope[0] * z, ray.at[1] + ray.slope[1] * z, z);
        let index = index_from_eye * (at - view.kernel_lean.upright(view.eye_origin));
        let turn = |wave: &Wave| {
            let [from, by] = [wave.turns.dot(index), wave.turns.dot(way) * step]
                .map(|turns| libm::sincos(2.0 * std::f64::consts::PI * turns.fract()));
            [[2.0 * wave.height * from.1, 2.0 * wave.height * from.0], [by.1, by.0]]
        };
        Along(waves.iter().map(turn).collect())
    }

    /// One over the sum over the endless lattice, here; goes a step on.
    fn next(&mut self) -> f32 {
        let mut sum = 1.0;
        for [now, by] in &mut self.0 {
            sum += now[0];
            *now = [now[0] * by[0] - now[1] * by[1], now[0] * by[1] + now[1] * by[0]];
        }
        (1.0 / sum) as f32
    }
}
