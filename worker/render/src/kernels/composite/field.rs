//! Compositing of a field: what the ray between two planes adds to a pixel.
//!
//! A plane holds the field's value and its derivatives along the eye's axes. Between two planes the
//! value is the cubic with both values and both derivatives along the ray (Hermite), the gradient
//! is linear. The segment is cut into sub-steps; the transfer function is integrated over each as
//! if the value were linear in it (pre-integration: K. Engel et al., 2001), light falls on its
//! middle. docs/design/sharp.md has the alternatives and what each costs.
//!
//! `FieldRule::close_pixel` is the plain version. `lanes` does the same operations in the same
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
use slabcast_common::math::{ROUND_F32, opacity};
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::shade::{Lamp, Shader};
use slabcast_common::view::{Projection, View};
use slabcast_common::volume::SampleKind;
use std::sync::OnceLock;

/// Terms of the number of sub-steps m, `m^2 >= a (K0 + K1 (1 - c) + K2 r)` for the light `a` that a
/// segment can add, the cosine `c` between its gradients, and the range `r` of its values in 1/255
/// of all values. On twelve scenes no more than 0.054/255 is lost against m = 8, which is the most.
const STEPS: [f32; 3] = [100.0, 8000.0, 2.0];

/// The gradient per vox of level 0, as a share of the range of all values, that a surface must have
/// for its normal to be its own: below it the normal turns towards the eye. Without it rounding
/// noise would light flat tissue.
pub const FLAT_GRADIENT: f64 = 1.0 / 1020.0;

/// Amplitude times cycles per lattice step below which a wave of the sum of weights is left out.
/// Its slope is then at most a fiftieth of a code per step where values are 100 codes from the
/// background.
const FAINT_WAVE: f64 = 3e-5;

/// Most cycles per step, along each index axis, of a wave that is divided out. Seen from 30 degrees
/// aside, waves of (3, 2) and (4, 2) cycles have slopes of 0.2 and 0.1 codes per step where values
/// are 110 codes from the background: as much as [`FLAT_GRADIENT`] of an 8-bit volume.
const WAVE_CYCLES: i32 = 5;

/// Weight of the kernel inside the volume below which a value is not divided by it.
const LEAST_WEIGHT: f32 = 0.25;

/// Steps of the table of a kernel's weight near a face, for each lattice step. Even, so that half a
/// lattice step is whole.
const FACE_STEPS: usize = 16;

/// Two parallel planes between which the field is drawn: the faces of the volume along an index
/// axis, in lattice steps, or of the cropping box along a world axis, in world units.
#[derive(Clone, Copy, Debug)]
struct Faces {
    /// Coordinate along the axis: `along . eye + from`.
    along: [f32; 3],
    from: f32,
    /// Coordinates of the faces.
    lo: f32,
    hi: f32,
    /// Distance from a face below which a kernel reaches beyond it; 0 for a cropping box, whose
    /// voxels go on.
    reach: f32,
}

/// One wave of the sum of all voxels' weights, which is 1 on average and repeats from voxel to
/// voxel: `2 a cos(2 pi phase)`.
#[derive(Clone, Copy, Debug)]
struct Wave {
    /// The phase in cycles: `along . eye + from`.
    along: [f32; 3],
    from: f32,
    /// `2 a`, and minus `4 pi a along`: derivatives along the eye's axes have the sine.
    cosine: f32,
    sine: [f32; 3],
}

impl Wave {
    /// Waves of the sum of weights of the kernel with `profile` in coordinates `own_from_index` of
    /// the index, strongest first: by Poisson's formula a is the kernel's Fourier transform at the
    /// points of the reciprocal lattice.
    fn all(profile: &Profile, own_from_index: &DMat3, view: &View) -> Vec<Wave> {
        let frequencies = own_from_index.inverse().transpose();
        let index_from_eye = view.eye_from_index.inverse();
        let mut waves = Vec::new();
        let edge = 2 * WAVE_CYCLES + 1;
        let all = edge * edge * edge;
        for n in all / 2 + 1..all {
            // One of each pair of opposite points.
            let cycles = [n % edge, n / edge % edge, n / edge / edge];
            let cycles = DVec3::from_array(cycles.map(|c| f64::from(c - WAVE_CYCLES)));
            let frequency = frequencies * cycles;
            let transform: f64 =
                frequency.to_array().iter().map(|&f| profile.transform_at(f)).product();
            if 2.0 * transform.abs() * frequency.length() < FAINT_WAVE {
                continue;
            }
            let along = index_from_eye.transpose() * cycles;
            let sine = along * (-2.0 * std::f64::consts::TAU * transform);
            waves.push(Wave {
                along: along.to_array().map(|x| x as f32),
                from: -along.dot(view.eye_origin) as f32,
                cosine: (2.0 * transform) as f32,
                sine: sine.to_array().map(|x| x as f32),
            });
        }
        waves.sort_by(|a, b| b.cosine.abs().total_cmp(&a.cosine.abs()));
        waves
    }
}

/// `sin(2 pi t)` for t from -0.5 to 0.5, within 0.0012: a parabola and its square. Waves are a
/// hundredth of what they are divided out of.
#[inline(always)]
fn sine(t: f32) -> f32 {
    let p = t * (8.0 - 16.0 * t.abs());
    p * (0.775 + 0.225 * p.abs())
}

impl Faces {
    /// Coordinate of a ray at depth `z`.
    #[inline(always)]
    fn at(&self, ray: &Ray, z: f32) -> f32 {
        let [ex, ey] = [ray.at[0] + ray.slope[0] * z, ray.at[1] + ray.slope[1] * z];
        let [x, y, d] = self.along;
        x * ex + y * ey + d * z + self.from
    }

    /// Distance of coordinate `q` from the nearer face, negative outside.
    #[inline(always)]
    fn depth(&self, q: f32) -> f32 {
        (q - self.lo).min(self.hi - q)
    }
}

/// Compositing rule for the planes of a field, with the constants of one view.
#[derive(Debug)]
pub struct FieldRule {
    /// Raw units of a sum for one code; times the lattice's cell and over the factors of the
    /// weights, for payloads. Negative where the background is the largest code.
    scale: f32,
    /// Factor of codes before the background is taken away, which has it too ([`shrink`]).
    shrink: f32,
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
    /// Faces of the cropping box, along the axes that it crops.
    crop: Vec<Faces>,
    /// Weights near the faces of each axis, made when a pixel first needs them.
    weights: OnceLock<[Box<[[f32; 2]]>; 3]>,
    profile: Profile,
    /// Components along each index axis of unit steps along the kernel's three axes, in lattice
    /// steps.
    across: [[f64; 3]; 3],
    /// Waves of the sum of weights.
    waves: Vec<Wave>,
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
    ) -> FieldRule {
        let cells = scene.cells_per_code();
        let sign = if scene.background > scene.range[0] { -1.0 } else { 1.0 };
        // Raw units of a sum for one code: 2^15 and 2^30 with some room for the kernel's ripple.
        let short = quality.sums == Sums::I16;
        let (units, steps) = match short {
            true => (30_600.0 / scene.reach(), spread),
            false => (1e9 / scene.reach(), DVec3::ONE),
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
        let [std, radius] = quality.kernel_shape();
        let index_from_eye = view.eye_from_index.inverse();
        // Gradients of the kernel's own coordinates, in lattice steps.
        let own = [0, 1, 2].map(|axis| upright.col(axis) / spread[axis]);
        let per_own = DMat3::from_cols(own[0], own[1], own[2]).inverse();
        let across = [0, 1, 2].map(|axis| (per_own * index_from_eye.row(axis)).to_array());
        let profile = Profile::new(quality.kernel, std, radius);
        let own_from_index = per_own.inverse().transpose() * view.eye_from_index;
        let faces = [0, 1, 2].map(|axis| {
            let along = index_from_eye.row(axis);
            let reach: f64 = across[axis].iter().map(|step| step.abs()).sum();
            Faces {
                along: along.to_array().map(|x| x as f32),
                from: -along.dot(view.eye_origin) as f32,
                lo: -0.5,
                hi: (f64::from(scene.dims[axis]) - 0.5) as f32,
                // The outermost samples lie half a step behind the face.
                reach: (radius * reach + 0.5) as f32,
            }
        });
        let crop = scene.crop.iter().map(|crop| {
            let along = index_from_eye.transpose() * crop.along;
            Faces {
                along: along.to_array().map(|x| x as f32),
                from: (crop.from - along.dot(view.eye_origin)) as f32,
                lo: crop.ends[0] as f32,
                hi: crop.ends[1] as f32,
                reach: 0.0,
            }
        });
        let lamp = shader.and_then(Shader::lamp).map(|Lamp { to_light: d, fill }| {
            let d = view.eye_from_world * DVec3::new(d.x.into(), d.y.into(), d.z.into());
            Lamp { to_light: Vec3::new(d.x as f32, d.y as f32, d.z as f32), fill }
        });
        let payload = if short { spread.x * spread.y * spread.z } else { 1.0 };
        let shrink = shrink(scene);
        FieldRule {
            scale: (sign * units * view.cell / payload / shrink) as f32,
            shrink: shrink as f32,
            background: (scene.background * shrink) as f32,
            smallest: scene.ends[0] as f32,
            largest: scene.ends[1] as f32,
            kind: scene.kind,
            cell: [((scene.background - scene.hull[0]) * cells) as f32, per_raw as f32],
            slopes,
            flat: (FLAT_GRADIENT * scene.coarseness * scene.span * cells) as f32,
            range_per_cell: (255.0 / (cells * scene.span)) as f32,
            thickness: view.thickness as f32,
            faces,
            crop: crop.collect(),
            weights: OnceLock::new(),
            profile,
            across,
            waves: Wave::all(&profile, &own_from_index, view),
            projection: view.projection,
            size: view.size.map(|n| n as f32),
            lamp,
            eps: quality.eps as f32,
        }
    }

    /// Returns this rule without a cut-off: no pixel is ever shut.
    pub(crate) fn never_shut(&self) -> FieldRule {
        FieldRule {
            crop: self.crop.clone(),
            weights: OnceLock::new(),
            waves: self.waves.clone(),
            eps: 0.0,
            ..*self
        }
    }

    /// Returns what a voxel adds to a sum for each unit of weight, from its sample's bits: 0 for
    /// the background and for NaN. Only coefficients beyond the background give less than 0.
    #[inline(always)]
    pub fn payload(&self, bits: u32) -> f32 {
        let code = match self.kind {
            SampleKind::U8 | SampleKind::U16 => bits as f32,
            SampleKind::F32 => {
                let code = f32::from_bits(bits);
                if code.is_nan() {
                    return 0.0;
                }
                code.clamp(self.smallest, self.largest)
            }
        };
        (code * self.shrink - self.background) * self.scale
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

    /// Converts raw sums to value (cells above the background) and gradient (cells per vox).
    #[inline(always)]
    fn plane(&self, [value, x, y, z]: [f32; 4]) -> Plane {
        let mut plane = Plane { value: value * self.cell[1], gradient: [0.0; 3] };
        for axis in 0..3 {
            let [from_x, from_y, from_z] = [0, 1, 2].map(|column| self.slopes[column][axis]);
            plane.gradient[axis] = x * from_x + y * from_y + z * from_z;
        }
        plane
    }

    /// Divides a plane at depth `z` by the sum of all weights there, as if the volume had no end.
    #[inline(always)]
    fn smooth(&self, plane: &mut Plane, ray: &Ray, z: f32) {
        if self.waves.is_empty() {
            return;
        }
        let [ex, ey] = [ray.at[0] + ray.slope[0] * z, ray.at[1] + ray.slope[1] * z];
        let (mut weight, mut slope) = (1.0f32, [0.0f32; 3]);
        for wave in &self.waves {
            let [x, y, d] = wave.along;
            let phase = x * ex + y * ey + d * z + wave.from;
            let t = phase - ((phase + ROUND_F32) - ROUND_F32);
            let quarter = t + 0.25;
            let ahead = quarter - ((quarter + ROUND_F32) - ROUND_F32);
            weight += wave.cosine * sine(ahead);
            let sine = sine(t);
            for axis in 0..3 {
                slope[axis] += wave.sine[axis] * sine;
            }
        }
        let per_weight = 1.0 / weight;
        plane.value *= per_weight;
        for axis in 0..3 {
            plane.gradient[axis] = (plane.gradient[axis] - plane.value * slope[axis]) * per_weight;
        }
    }

    /// Divides a plane at depth `z` by the kernel's weight inside the volume, near its faces.
    /// Returns whether the plane lies outside there.
    fn level(&self, plane: &mut Plane, ray: &Ray, z: f32) -> bool {
        let tables = self.weights.get_or_init(|| {
            self.across.each_ref().map(|across| face_weights(&self.profile, across))
        });
        let mut outside = false;
        for (faces, table) in self.faces.iter().zip(tables) {
            let q = faces.at(ray, z);
            outside |= (q < faces.lo) | (q > faces.hi);
            let [lo, lo_slope] = beside_face(table, q - faces.lo);
            let [hi, hi_slope] = beside_face(table, faces.hi - q);
            // The weight beyond both faces is missing; this is exact however thin the volume is.
            let weight = (lo - (1.0 - hi)).max(LEAST_WEIGHT);
            let slope = (lo_slope - hi_slope) / weight;
            plane.value /= weight;
            for (gradient, along) in plane.gradient.iter_mut().zip(faces.along) {
                *gradient = *gradient / weight - plane.value * slope * along;
            }
        }
        outside
    }

    /// Makes the segment from depth `z` on end at the volume's faces, where it is near them: levels
    /// its planes, and continues the field straight to a plane that lies outside, where few samples
    /// reach. Returns the part of the segment that is inside, in shares of it.
    fn end_at_faces(&self, segment: &mut Segment, ray: &Ray, z: f32) -> [f32; 2] {
        let ends = [z, z + self.thickness];
        let near = |f: &Faces| ends.iter().any(|&z| f.depth(f.at(ray, z)) < f.reach);
        if !self.faces.iter().any(near) {
            return match self.crop.iter().any(near) {
                true => self.clip(ray, z),
                false => [0.0, 1.0],
            };
        }
        let Segment { planes: [first, last], slopes } = segment;
        let outside = [self.level(first, ray, ends[0]), self.level(last, ray, ends[1])];
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
        self.clip(ray, z)
    }

    /// Cuts the segment that begins at depth `z` at the faces of the volume and of the cropping
    /// box: shares of it.
    fn clip(&self, ray: &Ray, z: f32) -> [f32; 2] {
        let [mut from, mut to] = [0.0f32, 1.0f32];
        for faces in self.faces.iter().chain(&self.crop) {
            let q = faces.at(ray, z);
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

    /// Returns the field at plane `k` of a pixel with these raw sums: its value as a sample code,
    /// and the length of its gradient in codes per vox.
    pub(crate) fn field_at(
        &self,
        scene: &FieldScene,
        sums: [f32; 4],
        pixel: [usize; 2],
        k: i32,
    ) -> (f64, f64) {
        let mut plane = self.plane(sums);
        let ray = self.ray(pixel.map(|p| p as i32));
        let z = (k as f32 + 0.5) * self.thickness;
        self.smooth(&mut plane, &ray, z);
        self.level(&mut plane, &ray, z);
        let [x, y, z] = plane.gradient.map(f64::from);
        let slope = (x * x + y * y + z * z).sqrt();
        (scene.code(f64::from(plane.value + self.cell[0])), slope / scene.cells_per_code())
    }

    /// Returns how many codes above or below the background a raw sum stands for.
    pub(crate) fn codes(&self, scene: &FieldScene, raw: f32) -> f64 {
        f64::from(raw * self.cell[1]) / scene.cells_per_code()
    }

    /// Composites the segment in front of plane `k` at lane `i` of a row
    /// ([`FieldRule::close_row`]).
    fn close_pixel(
        &self,
        (scene, shader): (&FieldScene, Option<&Shader>),
        (row, i): (&mut Row, usize),
        (pixel, k): ([i32; 2], i32),
    ) {
        if row.here[0][i] == 0.0 {
            return;
        }
        let h = self.thickness;
        let z = (k as f32 - 0.5) * h;
        let ray = self.ray(pixel);
        let mut planes = [&row.before, &row.here].map(|sums| self.plane(sums.map(|sums| sums[i])));
        self.smooth(&mut planes[0], &ray, z);
        self.smooth(&mut planes[1], &ray, z + h);
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
        // The number of sub-steps follows from the light, and from the change of value and
        // gradient.
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
            let middle = begin + 0.5 * step;
            let gradient = [0, 1, 2].map(|axis| {
                let (from, to) = (first.gradient[axis], last.gradient[axis]);
                from + (to - from) * middle
            });
            let extinction = match &scene.shares {
                Some(shares) => {
                    let [x, y, z] = gradient;
                    looks[0] * shares.at((x * x + y * y + z * z).sqrt())
                }
                None => looks[0],
            };
            let terms = shader.map(|s| self.terms(s, gradient, &ray));
            let tau = extinction * h * step * row.secant[i];
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

    /// The factor of base colours and what is added, where the field has a gradient (eye axes).
    fn terms(&self, shader: &Shader, [gx, gy, gz]: [f32; 3], ray: &Ray) -> [f32; 2] {
        let [ex, ey, ez] = ray.to_eye;
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

/// A power of two by which codes are multiplied before the background is taken away, so that
/// neither overflows nor vanishes in 32 bits: 1 but for values beyond 2^60 or below 2^-60.
fn shrink(scene: &FieldScene) -> f64 {
    let [lo, hi] = scene.range.map(f64::abs);
    let power = libm::ilogb(lo.max(hi).max(scene.span));
    if (-60..60).contains(&power) { 1.0 } else { libm::ldexp(1.0, (-power).clamp(-126, 126)) }
}

/// Weight of the kernel on the inner side of a face at this distance from it, and its slope.
fn beside_face(table: &[[f32; 2]], distance: f32) -> [f32; 2] {
    let at = distance.max(0.0) * FACE_STEPS as f32;
    let i = (at as usize).min(table.len() - 2);
    let t = (at - i as f32).min(1.0);
    let [a, b] = [table[i], table[i + 1]];
    [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t]
}

/// Weights of a kernel inside the volume by the distance from a face, in steps of 1 /
/// [`FACE_STEPS`] from the face on, and their slopes per lattice step. `across` holds the
/// components along the face's normal of unit steps along the kernel's axes, in lattice steps.
///
/// Across a face the kernel has the profile that its three profiles, scaled by `across`, make when
/// they are convolved. The weight is that profile's sum over the planes of samples inside, as a
/// share of the sum over endless planes. The first lies half a step behind the face.
fn face_weights(profile: &Profile, across: &[f64; 3]) -> Box<[[f32; 2]]> {
    let steps = FACE_STEPS as i32;
    // By offset from the middle.
    let mut normal = vec![1.0];
    for scale in across.map(f64::abs) {
        let reach = libm::ceil(profile.radius * scale * f64::from(steps)) as i32;
        let along: Vec<f64> = (-reach..=reach)
            .map(|i| {
                if i == 0 {
                    profile.at(0.0)
                } else {
                    profile.at(f64::from(i) / f64::from(steps) / scale)
                }
            })
            .collect();
        let sum: f64 = along.iter().sum();
        let mut both = vec![0.0; normal.len() + along.len() - 1];
        for (i, a) in normal.iter().enumerate() {
            for (j, b) in along.iter().enumerate() {
                both[i + j] += a * b / sum;
            }
        }
        normal = both;
    }
    let half = normal.len() as i32 / 2;
    // Share at `i` steps from the outermost plane of samples.
    let share = |i: i32| {
        let planes = -(half + i.abs()) / steps - 1..=(half + i.abs()) / steps + 1;
        let (mut inside, mut all) = (0.0, 0.0);
        for plane in planes {
            let at = i - plane * steps + half;
            let weight = usize::try_from(at).ok().and_then(|at| normal.get(at)).unwrap_or(&0.0);
            all += weight;
            inside += if plane >= 0 { *weight } else { 0.0 };
        }
        inside / all
    };
    let first = -steps / 2;
    (first..=half + 2)
        .map(|i| {
            let slope = (share(i + 1) - share(i - 1)) * 0.5 * f64::from(steps);
            [share(i) as f32, slope as f32]
        })
        .collect()
}
