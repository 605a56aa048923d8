//! What the model itself and rounded positions cost, at a few of a tile's pixels.
//!
//! Eight pixels of each block that [`estimate`](crate::estimate) draws again are worked out point by point
//! along their rays, as the limit is, but coarsely: the field of kernels is taken at steps of 1.2 of the
//! kernel's deviation, which a sum of Gaussians does not feel, and light is constant between. Beside the
//! field as it is defined stand three that differ by one thing each:
//!
//! - *positions*: voxels where sheets have them, rounded to a part of a pixel and of a sheet;
//! - *truncation*: the whole Gaussian, neither cut nor lowered by its edge;
//! - *ripple*: the field divided by what an endless lattice of ones would be there. That is periodic: one
//!   and a wave for each vector of the lattice's dual, of which the nearest are enough. As high as the
//!   kernel's Fourier transform there, by which Poisson's formula has it.
//!
//! How far these pictures are from the first one are the errors, up to the coarseness of the steps, which
//! all of them share.

use crate::footprint::Profile;
use crate::scene::Frame;
use glam::DVec3;
use slabcast_common::brick::Brick;
use slabcast_common::message::Sampling;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Compositing, Kernel};
use slabcast_common::view::{NEAR, Projection, SUBPIXELS, View};
use std::sync::Arc;

/// Steps along a ray, in deviations of the kernel.
const STEP: f64 = 1.2;

/// Deviations after which what is left of a Gaussian is left out: 3e-5 of its integral. Voxels are looked at
/// within this reach, so it is what they take; at 5.8 twice the time.
const WHOLE: f64 = 4.2;

/// Nodes of a profile's table.
const NODES: usize = 2048;

/// Waves below this height are left out: a thousandth of a step of eight bits in all.
const LOWEST: f64 = 1e-6;

/// Fields: as defined, rounded, whole. The levelled one is made of the first.
const FIELDS: usize = 3;

/// A profile by its distance: nodes to its radius, lines between.
struct Table {
    nodes: Vec<f32>,
    per_step: f64,
}

impl Table {
    fn new(radius: f64, at: impl Fn(f64) -> f64) -> Table {
        let nodes = (0..=NODES).map(|i| at(radius * i as f64 / NODES as f64) as f32).collect();
        Table { nodes, per_step: NODES as f64 / radius }
    }

    #[inline]
    fn at(&self, u: f64) -> f32 {
        let s = u.abs() * self.per_step;
        if s >= NODES as f64 {
            return 0.0;
        }
        let i = s as usize;
        let t = (s - i as f64) as f32;
        let (a, b) = (self.nodes[i], self.nodes[i + 1]);
        a + (b - a) * t
    }
}

/// A wave of the lattice: `2 height cos(2 pi turns . index)`.
struct Wave {
    /// Turns a step of each index axis.
    turns: DVec3,
    height: f64,
}

/// A frame's tables.
pub(crate) struct Model {
    cut: [Table; 3],
    whole: [Table; 3],
    waves: Vec<Wave>,
    /// Reach of the whole Gaussian along the eye's axes, in vox.
    reach: DVec3,
    step: f64,
}

/// A voxel near a block's rays, upright as these ([`slabcast_common::kernel::Lean::upright`]).
struct Near {
    eye: DVec3,
    /// The same as the eye sees it.
    seen: DVec3,
    /// Where sheets have it (in perspective each sheet has it somewhere else: across as it is).
    rounded: DVec3,
    /// Extinction per vox and that times the colours, for kernels that integrate to one.
    payload: [f32; 4],
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
        if q.compositing == Compositing::Paper {
            return None;
        }
        let (std, radius) = (view.kernel_std.to_array(), view.kernel_radius.to_array());
        let profile: [Profile; 3] =
            std::array::from_fn(|a| Profile::new(q.kernel, std[a], radius[a]));
        let cut = std::array::from_fn(|a| Table::new(radius[a], |u| profile[a].at(u)));
        let gaussian = q.kernel == Kernel::Gaussian;
        let reach = if gaussian { std.map(|s| s * WHOLE) } else { radius };
        let whole = std::array::from_fn(|a| {
            let norm = 1.0 / (std[a] * (2.0 * std::f64::consts::PI).sqrt());
            let bell = |u: f64| norm * libm::exp(-0.5 * u * u / (std[a] * std[a]));
            Table::new(reach[a], |u| if gaussian { bell(u) } else { profile[a].at(u) })
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
        samples: &mut Sampling,
    ) {
        let near = self.near(frame, block, bricks);
        if near.is_empty() {
            return;
        }
        let mut field = Vec::new();
        for (x, y) in [(0, 3), (1, 6), (2, 1), (3, 4), (4, 7), (5, 2), (6, 5), (7, 0)] {
            let ray = ray(&frame.view, block.x0 + x, block.y0 + y);
            let Some([as_is, rounded, whole, level]) = self.follow(frame, &ray, &near, &mut field)
            else {
                continue;
            };
            let there = |other: &Light| as_is.through < 1.0 || other.through < 1.0;
            samples.positions.put(there(&rounded), rounded.off(&as_is));
            samples.truncation.put(there(&whole), whole.off(&as_is));
            samples.ripple.put(there(&level), level.off(&as_is));
        }
    }

    /// The voxels whose whole kernel may reach a ray of the block, front to back.
    fn near(&self, frame: &Frame, block: Rect, bricks: &[Arc<Brick>]) -> Vec<Near> {
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
        for brick in bricks {
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
                let payload = frame.payload(brick, i, seen);
                if payload[0] <= 0.0 {
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
                let unit = 1.0 / frame.raw_scale;
                let rounded = lean.upright(rounded);
                near.push(Near { eye, seen, rounded, payload: payload.map(|p| p * unit) });
            }
        }
        near.sort_unstable_by(|a, b| a.eye.z.total_cmp(&b.eye.z));
        near
    }

    /// The four pictures of a ray; `None` if no voxel reaches it.
    fn follow(
        &self,
        frame: &Frame,
        ray: &Ray,
        near: &[Near],
        field: &mut Vec<[[f32; 4]; FIELDS]>,
    ) -> Option<[Light; 4]> {
        let parallel = ray.slope == [0.0; 2];
        let start = (near[0].eye.z - self.reach.z).max(ray.near);
        let depth = near[near.len() - 1].eye.z + self.reach.z - start;
        // A step of an endless volume is never met: positions are at most 2^30 phases apart.
        let steps = (depth / self.step).ceil().clamp(1.0, 1e7) as usize;
        field.clear();
        let (mut lights, mut waves) =
            ([Light::NEW; 4], Along::new(&self.waves, &frame.view, ray, start, self.step));
        let at = |j: usize| start + (j as f64 + 0.5) * self.step;
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
        for v in near {
            let first =
                (((v.eye.z - self.reach.z - start) / self.step - 0.5).ceil()).max(0.0) as usize;
            if first >= steps {
                break;
            }
            pass(first, field, &mut lights);
            if lights.iter().all(|l| l.through < frame.scene.quality.eps / 16.0) {
                break;
            }
            let across =
                |z: f64, place: &DVec3| [0, 1].map(|a| ray.at[a] + ray.slope[a] * z - place[a]);
            let of = |tables: &[Table; 3], [x, y]: [f64; 2]| tables[0].at(x) * tables[1].at(y);
            let mut weights = [0.0; FIELDS];
            if parallel {
                let (x, rounded) = (across(0.0, &v.eye), across(0.0, &v.rounded));
                weights = [of(&self.cut, x), of(&self.cut, rounded), of(&self.whole, x)];
                if weights == [0.0; FIELDS] {
                    continue;
                }
            }
            let last = (((v.eye.z + self.reach.z - start) / self.step - 0.5).floor())
                .min((steps - 1) as f64);
            if last < first as f64 {
                continue;
            }
            let last = last as usize;
            if field.len() <= last {
                field.resize(last + 1, Default::default());
            }
            for (j, here) in field[first..=last].iter_mut().enumerate() {
                let z = at(first + j);
                if !parallel {
                    let x = across(z, &v.eye);
                    let mut rounded = x;
                    let sheet = libm::floor(z / frame.view.thickness) as i32;
                    if let Some(scale) = frame.view.scale_at(sheet) {
                        let off = [0, 1].map(|a| {
                            let there = frame.view.screen_along(a, v.seen[a], scale) as f64
                                / f64::from(SUBPIXELS);
                            let exact = v.seen[a] * scale + f64::from(frame.view.size[a]) * 0.5;
                            (there - exact) / scale
                        });
                        rounded[0] -= off[0] - frame.view.kernel_lean.row * off[1];
                        rounded[1] -= off[1];
                    }
                    weights = [of(&self.cut, x), of(&self.cut, rounded), of(&self.whole, x)];
                }
                let deep = [
                    self.cut[2].at(z - v.eye.z),
                    self.cut[2].at(z - v.rounded.z),
                    self.whole[2].at(z - v.eye.z),
                ];
                for f in 0..FIELDS {
                    let w = weights[f] * deep[f];
                    met |= w > 0.0;
                    for c in 0..4 {
                        here[f][c] += v.payload[c] * w;
                    }
                }
            }
        }
        pass(field.len(), field, &mut lights);
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
    let transform = |a: usize, f: f64| {
        const N: usize = 256;
        let h = radius[a] / N as f64;
        let at = |i: usize| {
            let u = (i as f64 + 0.5) * h;
            profile[a].at(u) * libm::cos(2.0 * std::f64::consts::PI * f * u)
        };
        2.0 * h * (0..N).map(at).sum::<f64>()
    };
    let mut waves = Vec::new();
    for k in -2..=2 {
        for j in -2..=2 {
            for i in -2..=2 {
                // Of a wave and the opposite one, the first that is not zero is positive.
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
