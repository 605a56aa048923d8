//! Compositing of a field: what the ray between two planes adds to a pixel.
//!
//! A plane holds the field's value and its derivatives along the eye's axes. Between two planes the
//! value is the cubic with both values and both derivatives along the ray (Hermite), the gradient is
//! linear. The segment is cut into sub-steps; the transfer function is integrated over each as if
//! the value were linear in it (pre-integration: K. Engel et al., 2001), light falls on its middle.
//! docs/design/sharp.md has the alternatives and what each costs.
//!
//! [`FieldRule::close_pixel`] is the plain version. [`lanes`] does the same operations in the same
//! order on registers of x86, so that both give the same bytes.

#[cfg(target_arch = "x86_64")]
mod lanes;
mod tables;

pub use tables::FieldScene;

use super::{LANES, Row, fixed_light};
#[cfg(target_arch = "x86_64")]
use crate::kernels::Level;
use crate::kernels::Simd;
use glam::{DMat3, DVec3, Vec3};
use slabcast_common::kernel::Profile;
use slabcast_common::math::opacity;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::shade::{Lamp, Shader};
use slabcast_common::view::{Projection, View};
use slabcast_common::volume::SampleKind;
use tables::CELLS;

/// Terms of the number of sub-steps m, `m^2 >= a (K0 + K1 (1 - c) + K2 r)` for the light `a` that a
/// segment can add, the cosine `c` between its gradients, and the range `r` of its values in 1/255
/// of all values. On twelve scenes no more than 0.054/255 is lost against m = 8, which is the most.
const STEPS: [f32; 3] = [100.0, 8000.0, 2.0];

/// The gradient per vox, as a share of the range of all values, that a surface must have for its
/// normal to be its own: below it the normal turns towards the eye. Without it rounding noise
/// would light flat tissue.
pub const FLAT_GRADIENT: f64 = 1.0 / 1020.0;

/// Weight of the kernel inside the volume below which a value is not divided by it.
const LEAST_WEIGHT: f32 = 0.25;

/// Steps of the table of a kernel's weight near a face, for each lattice step.
const FACE_STEPS: usize = 32;

/// Two parallel planes between which the field is drawn: the faces of the volume along an index
/// axis.
#[derive(Clone, Copy, Debug)]
struct Faces {
    /// Coordinate along the axis: `along . eye + from`, in lattice steps.
    along: [f32; 3],
    from: f32,
    /// Coordinates of the faces.
    lo: f32,
    hi: f32,
}

/// Compositing rule for the planes of a field, with the constants of one view.
#[derive(Debug)]
pub struct FieldRule {
    /// Raw units of a sum for one code; times the lattice's cell and over the factors of the
    /// weights, for payloads.
    scale: f32,
    background: f32,
    smallest: f32,
    largest: f32,
    kind: SampleKind,
    /// Cell of the background, and cells for one raw unit of the value.
    cell: [f32; 2],
    /// Derivatives along the eye's axes in cells per vox, from raw derivatives (columns).
    slopes: [[f32; 3]; 3],
    /// Flat gradient, in cells per vox.
    flat: f32,
    /// Range of a segment's values in 1/255 of all values, for one cell.
    range_per_cell: f32,
    thickness: f32,
    faces: [Faces; 3],
    /// Weight of a kernel on one side of a face by distance, and its slope per lattice step.
    face: Box<[[f32; 2]]>,
    /// Distance from a face beyond which the weight is one, in lattice steps.
    whole: f32,
    projection: Projection,
    size: [f32; 2],
    /// The light in eye axes; `None` for a head light.
    lamp: Option<Lamp>,
    eps: f32,
}

/// A pixel's ray by depth z: `(at + slope z, z)`, in eye coordinates.
struct Ray {
    at: [f32; 2],
    slope: [f32; 2],
    /// Unit direction to the eye.
    to_eye: [f32; 3],
}

/// The field at one plane: value in cells, gradient in cells per vox by the eye's axes.
#[derive(Clone, Copy)]
struct Plane {
    value: f32,
    gradient: [f32; 3],
}

/// A ray between two planes: a cubic with both values, and both slopes over the whole segment.
struct Segment {
    planes: [Plane; 2],
    slopes: [f32; 2],
}

impl Segment {
    /// Smallest and largest of the cubic's Bezier points, between which its values lie.
    fn bounds(&self) -> [f32; 2] {
        let Segment { planes: [first, last], slopes: [m0, m1] } = self;
        let points = [first.value + m0 * (1.0 / 3.0), last.value - m1 * (1.0 / 3.0), last.value];
        points.iter().fold([first.value; 2], |[low, high], &p| [low.min(p), high.max(p)])
    }
}

impl FieldRule {
    /// Makes the rule for `view` of a scene. `spread` is the length of a lattice step along the
    /// eye's axes in vox, `shader` the light.
    pub fn new(
        scene: &FieldScene,
        shader: Option<&Shader>,
        quality: &Quality,
        view: &View,
        spread: DVec3,
        dims: [u32; 3],
    ) -> FieldRule {
        let cells = CELLS as f64 / (scene.hull[1] - scene.hull[0]);
        let sign = if scene.background > scene.range[0] { -1.0 } else { 1.0 };
        // Raw units of a sum for one code: 2^15 and 2^30 with some room for the kernel's ripple.
        let short = quality.sums == Sums::I16;
        let (units, steps) = match short {
            true => (30_600.0 / scene.span(), spread),
            false => (1e9 / scene.span(), DVec3::ONE),
        };
        let per_raw = sign * cells / units;
        let lean = view.kernel_lean;
        let [lx, ly] = lean.depth;
        // Columns: what a derivative along an axis of the sheared kernel is along the eye's axes.
        let upright = DMat3::from_cols(
            DVec3::new(1.0, -lean.row, lean.row * ly - lx),
            DVec3::new(0.0, 1.0, -ly),
            DVec3::Z,
        );
        let slopes = [0, 1, 2].map(|axis| {
            let column = upright.col(axis) * (per_raw / steps[axis]);
            column.to_array().map(|x| x as f32)
        });
        let index_from_eye = view.eye_from_index.inverse();
        let faces = [0, 1, 2].map(|axis| {
            let along = index_from_eye.row(axis);
            Faces {
                along: along.to_array().map(|x| x as f32),
                from: -along.dot(view.eye_origin) as f32,
                lo: -0.5,
                hi: (f64::from(dims[axis]) - 0.5) as f32,
            }
        });
        let [std, radius] = quality.kernel_shape();
        let profile = Profile::new(quality.kernel, std, radius);
        // The outermost samples lie half a step behind the face.
        let whole = radius + 0.5;
        let last = libm::ceil(whole * FACE_STEPS as f64) as usize;
        let face = (0..=last + 1).map(|i| inside(&profile, i as f64 / FACE_STEPS as f64 - 0.5));
        let lamp = shader.and_then(Shader::lamp).map(|Lamp { to_light: d, fill }| {
            let d = view.eye_from_world * DVec3::new(d.x.into(), d.y.into(), d.z.into());
            Lamp { to_light: Vec3::new(d.x as f32, d.y as f32, d.z as f32), fill }
        });
        let payload = if short { spread.x * spread.y * spread.z } else { 1.0 };
        FieldRule {
            scale: (units * view.cell / payload) as f32,
            background: scene.background as f32,
            smallest: scene.range[0] as f32,
            largest: scene.range[1] as f32,
            kind: scene.kind,
            cell: [((scene.background - scene.hull[0]) * cells) as f32, per_raw as f32],
            slopes,
            flat: (FLAT_GRADIENT * scene.span() * cells) as f32,
            range_per_cell: (255.0 / (cells * scene.span())) as f32,
            thickness: view.thickness as f32,
            faces,
            face: face.collect(),
            whole: whole as f32,
            projection: view.projection,
            size: view.size.map(|n| n as f32),
            lamp,
            eps: quality.eps as f32,
        }
    }

    /// Returns this rule without a cut-off: no pixel is ever shut.
    pub(crate) fn never_shut(&self) -> FieldRule {
        FieldRule { face: self.face.clone(), eps: 0.0, ..*self }
    }

    /// Returns what a voxel adds to a sum for each unit of weight, from its sample's bits: 0 for
    /// the background and for NaN.
    #[inline(always)]
    pub fn payload(&self, bits: u32) -> f32 {
        let code = match self.kind {
            SampleKind::U8 | SampleKind::U16 => bits as f32,
            SampleKind::F32 => {
                let code = f32::from_bits(bits);
                let code = if code.is_nan() { self.background } else { code };
                code.clamp(self.smallest, self.largest)
            }
        };
        (code - self.background).abs() * self.scale
    }

    /// The ray of the pixel at a column and a row of the picture.
    #[inline(always)]
    fn ray(&self, pixel: [i32; 2]) -> Ray {
        let mut ray = Ray { at: [0.0; 2], slope: [0.0; 2], to_eye: [0.0; 3] };
        for axis in 0..2 {
            let p = pixel[axis] as f32 + 0.5 - self.size[axis] * 0.5;
            match self.projection {
                Projection::Ortho { scale } => ray.at[axis] = p / scale as f32,
                Projection::Persp { focal, distance } => {
                    ray.slope[axis] = p / focal as f32;
                    ray.at[axis] = ray.slope[axis] * distance as f32;
                }
            }
        }
        let [sx, sy] = ray.slope;
        let per_length = -1.0 / (sx * sx + sy * sy + 1.0).sqrt();
        ray.to_eye = [sx * per_length, sy * per_length, per_length];
        ray
    }

    /// A plane's raw sums as the field. The value is counted from the background.
    #[inline(always)]
    fn plane(&self, [value, x, y, z]: [f32; 4]) -> Plane {
        let mut plane = Plane { value: value * self.cell[1], gradient: [0.0; 3] };
        for axis in 0..3 {
            let [from_x, from_y, from_z] = [0, 1, 2].map(|column| self.slopes[column][axis]);
            plane.gradient[axis] = x * from_x + y * from_y + z * from_z;
        }
        plane
    }

    /// Index coordinates of a ray at depth `z`.
    #[inline(always)]
    fn index(&self, ray: &Ray, z: f32) -> [f32; 3] {
        let [ex, ey] = [0, 1].map(|axis| ray.at[axis] + ray.slope[axis] * z);
        self.faces.map(|faces| {
            let [x, y, d] = faces.along;
            x * ex + y * ey + d * z + faces.from
        })
    }

    /// Divides the plane at index coordinates `q` by the kernel's weight inside the volume, near
    /// its faces. Returns whether the plane lies outside there.
    fn level(&self, plane: &mut Plane, q: [f32; 3]) -> bool {
        let mut outside = false;
        for (faces, q) in self.faces.iter().zip(q) {
            outside |= (q < faces.lo) | (q > faces.hi);
            let [lo, lo_slope] = self.beside_face(q - faces.lo);
            let [hi, hi_slope] = self.beside_face(faces.hi - q);
            let weight = (lo * hi).max(LEAST_WEIGHT);
            let slope = (lo_slope * hi - lo * hi_slope) / weight;
            plane.value /= weight;
            for (gradient, along) in plane.gradient.iter_mut().zip(faces.along) {
                *gradient = *gradient / weight - plane.value * slope * along;
            }
        }
        outside
    }

    /// Weight of the kernel on the inner side of a face at this distance from it, and its slope.
    fn beside_face(&self, distance: f32) -> [f32; 2] {
        let at = distance.clamp(0.0, self.whole) * FACE_STEPS as f32;
        let i = (at as usize).min(self.face.len() - 2);
        let t = at - i as f32;
        let [a, b] = [self.face[i], self.face[i + 1]];
        [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t]
    }

    /// Makes the segment from depth `z` on end at the volume's faces, where it is near them: levels
    /// its planes, and continues the field straight to a plane that lies outside, where few samples
    /// reach. Returns the part of the segment that is inside, in shares of it.
    fn end_at_faces(&self, segment: &mut Segment, ray: &Ray, z: f32) -> [f32; 2] {
        let [front, back] = [z, z + self.thickness].map(|z| self.index(ray, z));
        let near = |q: [f32; 3]| {
            let mut faces = self.faces.iter().zip(q);
            faces.any(|(f, q)| (q - f.lo < self.whole) | (f.hi - q < self.whole))
        };
        if !near(front) & !near(back) {
            return [0.0, 1.0];
        }
        let Segment { planes: [first, last], slopes } = segment;
        let outside = [self.level(first, front), self.level(last, back)];
        *slopes = [self.along(ray, first), self.along(ray, last)];
        match outside {
            [true, false] => {
                first.value = last.value - slopes[1];
                (first.gradient, slopes[0]) = (last.gradient, slopes[1]);
            }
            [false, true] => {
                last.value = first.value + slopes[0];
                (last.gradient, slopes[1]) = (first.gradient, slopes[0]);
            }
            _ => {}
        }
        self.clip(ray, front)
    }

    /// Cuts the segment that begins at index coordinates `q` at the volume's faces: shares of it.
    fn clip(&self, ray: &Ray, q: [f32; 3]) -> [f32; 2] {
        let [mut from, mut to] = [0.0f32, 1.0f32];
        for (faces, q) in self.faces.iter().zip(q) {
            let [x, y, d] = faces.along;
            let step = (x * ray.slope[0] + y * ray.slope[1] + d) * self.thickness;
            let step = if step.abs() < 1e-12 { 1e-12 } else { step };
            let (a, b) = ((faces.lo - q) / step, (faces.hi - q) / step);
            from = from.max(a.min(b));
            to = to.min(a.max(b));
        }
        [from, to]
    }

    /// Returns the change of a plane's value along a ray over one thickness.
    #[inline(always)]
    fn along(&self, ray: &Ray, plane: &Plane) -> f32 {
        let [x, y, z] = plane.gradient;
        self.thickness * (x * ray.slope[0] + y * ray.slope[1] + z)
    }

    /// Adds to each pixel of `row` what its ray meets between plane k - 1 (`before`) and plane `k`
    /// (`here`). `pixels` are their columns and rows in the picture; `live` has a bit for each that
    /// is open. Others keep their opacity and get no light. Returns those that are shut now.
    ///
    /// A pixel whose plane `k` has no value gets nothing: what is touched does not matter.
    #[inline(always)]
    pub fn close_row(
        &self,
        simd: Simd,
        looks: (&FieldScene, Option<&Shader>),
        row: &mut Row,
        at: (&[[i32; 2]; LANES], i32),
        live: u32,
    ) -> u32 {
        row.light = [[0; LANES]; 3];
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { lanes::avx512(self, looks, row, at, live) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { lanes::avx2(self, looks, row, at, live) },
            _ => {
                let mut shut = 0;
                for i in (0..LANES).filter(|i| live >> i & 1 == 1) {
                    self.close_pixel(looks, (row, i), (at.0[i], at.1));
                    shut |= u32::from(1.0 - row.a[i] < self.eps) << i;
                }
                shut
            }
        }
    }

    /// Does for lane `i` of a row what [`FieldRule::close_row`] does for all.
    fn close_pixel(
        &self,
        (scene, shader): (&FieldScene, Option<&Shader>),
        (row, i): (&mut Row, usize),
        (pixel, k): ([i32; 2], i32),
    ) {
        if row.here[0][i] <= 0.0 {
            return;
        }
        let h = self.thickness;
        let z = (k as f32 - 0.5) * h;
        let ray = self.ray(pixel);
        let planes = [&row.before, &row.here].map(|sums| self.plane(sums.map(|sums| sums[i])));
        let slopes = [self.along(&ray, &planes[0]), self.along(&ray, &planes[1])];
        let mut segment = Segment { planes, slopes };
        let [from, to] = self.end_at_faces(&mut segment, &ray, z);
        for plane in &mut segment.planes {
            plane.value += self.cell[0];
        }
        let Segment { planes: [first, last], slopes: [m0, m1] } = &segment;
        let [low, high] = segment.bounds();
        if (high <= scene.visible[0]) | (low >= scene.visible[1]) | (to <= from) {
            return;
        }
        // How many sub-steps: by the light, and by how far value and gradient change.
        let most = h * scene.most[scene.cell(high).0 + 1];
        let share = (1.0 - row.a[i]) * if most < 1.0 { most } else { 1.0 };
        let flat = self.flat * self.flat;
        let dot = |a: &Plane, b: &Plane| {
            let ([ax, ay, az], [bx, by, bz]) = (a.gradient, b.gradient);
            ax * bx + ay * by + az * bz + flat
        };
        let cosine = dot(first, last) / (dot(first, first) * dot(last, last)).sqrt();
        let range = (high - low) * self.range_per_cell;
        let square = share * (STEPS[0] + STEPS[1] * (1.0 - cosine) + STEPS[2] * range);
        let steps = match square {
            _ if square > 16.0 => 8.0,
            _ if square > 4.0 => 4.0,
            _ if square > 1.0 => 2.0,
            _ => 1.0,
        };
        let step = (to - from) / steps;
        let value = |t: f32| {
            let rise = last.value - first.value;
            let (c, d) = (3.0 * rise - 2.0 * m0 - m1, m0 + m1 - 2.0 * rise);
            first.value + t * (m0 + t * (c + t * d))
        };
        let mut light = [0.0f32; 3];
        let mut here = value(from);
        for j in 0..steps as u32 {
            let begin = from + j as f32 * step;
            let next = value(begin + step);
            let looks = scene.between(here, next);
            here = next;
            let terms = shader.map(|s| self.terms(s, [first, last], begin + 0.5 * step, &ray));
            let tau = looks[0] * h * step * row.secant[i];
            let seen = (1.0 - row.a[i]) * opacity(tau);
            row.a[i] += seen;
            for c in 0..3 {
                let lit = match terms {
                    Some([lambert, gloss]) => looks[c + 1] * lambert + gloss,
                    None => looks[c + 1],
                };
                let lit = if lit > 0.0 { lit } else { 0.0 };
                light[c] += seen * if lit < 1.0 { lit } else { 1.0 };
            }
        }
        for c in 0..3 {
            row.light[c][i] = fixed_light(light[c]);
        }
    }

    /// The factor of base colours and what is added, at share `t` of a segment.
    fn terms(&self, shader: &Shader, [first, last]: [&Plane; 2], t: f32, ray: &Ray) -> [f32; 2] {
        let [ex, ey, ez] = ray.to_eye;
        let [gx, gy, gz] = [0, 1, 2].map(|axis| {
            let (from, to) = (first.gradient[axis], last.gradient[axis]);
            from + (to - from) * t
        });
        let side = if gx * ex + gy * ey + gz * ez < 0.0 { -1.0 } else { 1.0 };
        let x = gx * side + self.flat * ex;
        let y = gy * side + self.flat * ey;
        let z = gz * side + self.flat * ez;
        let per_length = 1.0 / (x * x + y * y + z * z).sqrt();
        let (nx, ny, nz) = (x * per_length, y * per_length, z * per_length);
        let n_eye = nx * ex + ny * ey + nz * ez;
        let [mut lambert, mut gloss] = [[n_eye]; 2];
        if let Some(lamp) = self.lamp {
            let [lx, ly, lz] = lamp.to_light.to_array();
            let (hx, hy, hz) = (lx + ex, ly + ey, lz + ez);
            let square = hx * hx + hy * hy + hz * hz;
            let per_half = if square > 1e-12 { 1.0 / square.sqrt() } else { 0.0 };
            lambert = [lamp.lambert(nx * lx + ny * ly + nz * lz, n_eye)];
            gloss = [(nx * hx + ny * hy + nz * hz) * per_half];
        }
        shader.terms(&mut lambert, &mut gloss, 1);
        [lambert[0], gloss[0]]
    }
}

/// Share of the kernel's sum over an endless row of samples that the samples from 0 on have, at a
/// distance `u` of lattice steps from sample 0 towards the others, and its slope per step.
fn inside(profile: &Profile, u: f64) -> [f32; 2] {
    let reach = libm::ceil(profile.radius) as i32 + 1;
    let (mut some, mut all) = ([0.0; 2], [0.0; 2]);
    let middle = libm::floor(u) as i32;
    for n in middle - reach..=middle + 1 + reach {
        let (weight, slope) = (profile.at(u - f64::from(n)), profile.slope_at(u - f64::from(n)));
        all = [all[0] + weight, all[1] + slope];
        if n >= 0 {
            some = [some[0] + weight, some[1] + slope];
        }
    }
    let share = some[0] / all[0];
    [share as f32, ((some[1] - share * all[1]) / all[0]) as f32]
}
