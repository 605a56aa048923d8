//! Compositing of a field: what the ray between two planes adds to a pixel.
//!
//! A plane holds the field's value and its derivatives along the eye's axes. Between two planes the
//! value is the cubic with both values and both derivatives along the ray (Hermite), the gradient is
//! linear. The segment is cut into sub-steps; the transfer function is integrated over each as if
//! the value were linear in it (pre-integration: K. Engel et al., 2001), light falls on its middle.
//! docs/design/sharp.md has the alternatives and what each costs.

use super::{LANES, Row, fixed_light, select};
use crate::kernels::{Simd, lut, truncate};
use glam::{DMat3, DVec3};
use slabcast_common::kernel::Profile;
use slabcast_common::math::opacity;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::shade::Shader;
use slabcast_common::transfer::{Classifier, OpticalSample};
use slabcast_common::view::{Projection, View};
use slabcast_common::volume::{SampleKind, ValueSummary};

/// Cells of the tables over the visible values.
const CELLS: usize = 4096;

/// Cells that a sub-step's values must span for the integral tables to be used. Within fewer the
/// transfer function is taken where the middle is; differences of f32 integrals would lose digits.
const FEW_CELLS: f32 = 16.0;

/// Sub-steps of a segment at most.
const MOST_STEPS: f32 = 8.0;

/// Terms of the number of sub-steps m, `m^2 >= a (K0 + K1 (1 - c) + K2 r)` for the light `a` that a
/// segment can add, the cosine `c` between its gradients, and the range `r` of its values in 1/255
/// of all values. On twelve scenes no more than 0.054/255 is lost against m = 8.
const STEPS: [f32; 3] = [100.0, 8000.0, 2.0];

/// The gradient per vox, as a share of the range of all values, that a surface must have for its
/// normal to be its own: below it the normal turns towards the eye. Without it rounding noise
/// would light flat tissue.
pub const FLAT_GRADIENT: f64 = 1.0 / 1020.0;

/// Weight of the kernel inside the volume below which a value is not divided by it.
const LEAST_WEIGHT: f32 = 0.25;

/// Steps of the table of a kernel's weight near a face, for each lattice step.
const FACE_STEPS: usize = 32;

/// Values of a scene: how codes become sums, and what values look like.
#[derive(Debug)]
pub struct FieldScene {
    /// Code of which a sheet holds nothing: the smallest code of the volume, or the largest.
    background: f64,
    /// Smallest and largest code.
    range: [f64; 2],
    /// Codes of the first and the last cell's ends.
    hull: [f64; 2],
    /// Cells between which values are visible: a visible end of the hull has no end.
    visible: [f32; 2],
    kind: SampleKind,
    /// Extinction per vox and linear colour by cell end.
    looks: Box<[OpticalSample; CELLS + 1]>,
    /// Integrals of extinction, and of extinction times colour, up to each cell's end, in cells.
    integrals: Box<[OpticalSample; CELLS + 1]>,
    /// Largest extinction per vox up to each cell's end.
    most: Box<[f32; CELLS + 1]>,
}

impl FieldScene {
    /// Prepares the values of the scene that `spec` describes.
    pub fn new(spec: &SceneSpec, classifier: &Classifier) -> FieldScene {
        let summary = &spec.volume.summary;
        let support = classifier.support();
        let background = match support.filled(summary).intervals.first() {
            Some((lo, _)) if *lo == f64::NEG_INFINITY => summary.max_code,
            _ => summary.min_code,
        };
        let hull = hull(classifier, summary);
        let code = |cell: usize| hull[0] + (hull[1] - hull[0]) * (cell as f64 / CELLS as f64);
        let looks: Vec<[f64; 4]> = (0..=CELLS).map(|c| classifier.optics_at(code(c))).collect();
        let ends = [0, CELLS].map(|cell| looks[cell][0] > 0.0);
        let visible = [
            if ends[0] { f32::NEG_INFINITY } else { 0.0 },
            if ends[1] { f32::INFINITY } else { CELLS as f32 },
        ];
        let mut integrals = vec![[0.0f64; 4]];
        for pair in looks.windows(2) {
            let mut sum = *integrals.last().expect("the first is there");
            let [a, b] = [pair[0][0], pair[1][0]];
            sum[0] += 0.5 * (a + b);
            for c in 1..4 {
                // Simpson's rule of the product of two linear functions is exact.
                let middle = (a + b) * (pair[0][c] + pair[1][c]);
                sum[c] += (a * pair[0][c] + middle + b * pair[1][c]) / 6.0;
            }
            integrals.push(sum);
        }
        let mut most = 0.0f64;
        let sample = |[sigma, rgb @ ..]: [f64; 4]| OpticalSample {
            sigma: sigma as f32,
            rgb: rgb.map(|c| c as f32),
        };
        FieldScene {
            background,
            range: [summary.min_code, summary.max_code],
            hull,
            visible,
            kind: summary.kind,
            most: table(looks.iter().map(|look| {
                most = most.max(look[0]);
                most as f32
            })),
            looks: table(looks.iter().copied().map(sample)),
            integrals: table(integrals.into_iter().map(sample)),
        }
    }

    /// Codes from the smallest to the largest.
    fn span(&self) -> f64 {
        (self.range[1] - self.range[0]).max(f64::MIN_POSITIVE)
    }
}

/// A table of all cells' ends.
fn table<T: Copy>(entries: impl Iterator<Item = T>) -> Box<[T; CELLS + 1]> {
    let all: Box<[T]> = entries.collect();
    all.try_into().unwrap_or_else(|_| unreachable!("an entry for each end of a cell"))
}

/// Smallest and largest code between which a value may be visible.
fn hull(classifier: &Classifier, summary: &ValueSummary) -> [f64; 2] {
    let support = classifier.support();
    let (lo, hi) = match (support.intervals.first(), support.intervals.last()) {
        (Some(&(lo, _)), Some(&(_, hi))) => (lo, hi),
        _ => (summary.min_code, summary.max_code),
    };
    // The transfer function is linear between codes: of whole codes it begins to show within one.
    let beside = if summary.kind == SampleKind::F32 { 0.0 } else { 1.0 };
    let clamp = |code: f64| code.clamp(summary.min_code, summary.max_code);
    let [lo, hi] = [clamp(lo - beside), clamp(hi + beside)];
    if hi > lo { [lo, hi] } else { [lo, lo + 1.0] }
}

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

/// How the planes of a field become light, with the constants of one view.
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
    /// Where the weight is one, in lattice steps from a face.
    whole: f32,
    projection: Projection,
    size: [f32; 2],
    /// Unit direction to the light in eye axes; `None` for a head light.
    light: Option<[f32; 3]>,
    eps: f32,
}

/// One pixel's ray by depth z: `(at + slope z, z)`, in eye coordinates.
#[derive(Clone, Copy, Default)]
struct Rays {
    at: [[f32; LANES]; 2],
    slope: [[f32; LANES]; 2],
}

/// The field at one plane in lanes: value in cells, gradient in cells per vox by the eye's axes.
#[derive(Clone, Copy)]
struct Plane {
    value: [f32; LANES],
    gradient: [[f32; LANES]; 3],
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
        let light = shader.and_then(Shader::light_direction).map(|d| {
            let d = view.eye_from_world * DVec3::new(d.x.into(), d.y.into(), d.z.into());
            d.to_array().map(|x| x as f32)
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
            light,
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

    /// The rays of the pixels at columns and rows of the picture.
    #[inline(always)]
    fn rays(&self, pixels: &[[i32; 2]; LANES]) -> Rays {
        let mut rays = Rays::default();
        for axis in 0..2 {
            for i in 0..LANES {
                let p = pixels[i][axis] as f32 + 0.5 - self.size[axis] * 0.5;
                match self.projection {
                    Projection::Ortho { scale } => rays.at[axis][i] = p / scale as f32,
                    Projection::Persp { focal, distance } => {
                        let slope = p / focal as f32;
                        rays.slope[axis][i] = slope;
                        rays.at[axis][i] = slope * distance as f32;
                    }
                }
            }
        }
        rays
    }

    /// A plane's raw sums as the field.
    #[inline(always)]
    fn plane(&self, sums: &[[f32; LANES]; 4]) -> Plane {
        let mut plane = Plane { value: [0.0; LANES], gradient: [[0.0; LANES]; 3] };
        for i in 0..LANES {
            plane.value[i] = self.cell[0] + sums[0][i] * self.cell[1];
        }
        for axis in 0..3 {
            let [x, y, z] = [self.slopes[0][axis], self.slopes[1][axis], self.slopes[2][axis]];
            for i in 0..LANES {
                plane.gradient[axis][i] = sums[1][i] * x + sums[2][i] * y + sums[3][i] * z;
            }
        }
        plane
    }

    /// Divides a plane by the kernel's weight inside the volume, near its faces. Returns a bit for
    /// each lane that lies outside.
    #[inline(always)]
    fn level(&self, plane: &mut Plane, rays: &Rays, z: f32) -> u32 {
        let mut outside = 0;
        for faces in &self.faces {
            let [x, y, d] = faces.along;
            let mut q = [0.0; LANES];
            let mut near = false;
            for i in 0..LANES {
                let ex = rays.at[0][i] + rays.slope[0][i] * z;
                let ey = rays.at[1][i] + rays.slope[1][i] * z;
                q[i] = x * ex + y * ey + d * z + faces.from;
                near |= q[i] - faces.lo < self.whole;
                near |= faces.hi - q[i] < self.whole;
            }
            if !near {
                continue;
            }
            for i in 0..LANES {
                outside |= u32::from((q[i] < faces.lo) | (q[i] > faces.hi)) << i;
                let [lo, lo_slope] = self.beside_face(q[i] - faces.lo);
                let [hi, hi_slope] = self.beside_face(faces.hi - q[i]);
                let weight = (lo * hi).max(LEAST_WEIGHT);
                let slope = (lo_slope * hi - lo * hi_slope) / weight;
                let value = (plane.value[i] - self.cell[0]) / weight;
                plane.value[i] = self.cell[0] + value;
                for (axis, along) in faces.along.into_iter().enumerate() {
                    let gradient = &mut plane.gradient[axis][i];
                    *gradient = *gradient / weight - value * slope * along;
                }
            }
        }
        outside
    }

    /// Weight of the kernel on the inner side of a face at this distance from it, and its slope.
    #[inline(always)]
    fn beside_face(&self, distance: f32) -> [f32; 2] {
        let at = distance.clamp(0.0, self.whole) * FACE_STEPS as f32;
        let i = (at as usize).min(self.face.len() - 2);
        let t = at - i as f32;
        let [a, b] = [self.face[i], self.face[i + 1]];
        [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t]
    }

    /// Cuts the segment from `z` on, of one thickness, at the volume's faces: shares of it.
    #[inline(always)]
    fn clip(&self, rays: &Rays, z: f32) -> [[f32; LANES]; 2] {
        let [mut from, mut to] = [[0.0f32; LANES], [1.0f32; LANES]];
        for faces in &self.faces {
            let [x, y, d] = faces.along;
            for i in 0..LANES {
                let ex = rays.at[0][i] + rays.slope[0][i] * z;
                let ey = rays.at[1][i] + rays.slope[1][i] * z;
                let q = x * ex + y * ey + d * z + faces.from;
                let step = (x * rays.slope[0][i] + y * rays.slope[1][i] + d) * self.thickness;
                let step = select(step.abs() < 1e-12, 1e-12, step);
                let (a, b) = ((faces.lo - q) / step, (faces.hi - q) / step);
                let (enter, leave) = (select(a < b, a, b), select(a < b, b, a));
                from[i] = select(enter > from[i], enter, from[i]);
                to[i] = select(leave < to[i], leave, to[i]);
            }
        }
        [from, to]
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
        (scene, shader): (&FieldScene, Option<&Shader>),
        row: &mut Row,
        (pixels, k): (&[[i32; 2]; LANES], i32),
        live: u32,
    ) -> u32 {
        row.light = [[0; LANES]; 3];
        let h = self.thickness;
        let z = (k as f32 - 0.5) * h;
        let [mut first, mut last] = [self.plane(&row.before), self.plane(&row.here)];
        let rays = self.rays(pixels);
        let outside =
            self.level(&mut first, &rays, z) | self.level(&mut last, &rays, z + h) << LANES;
        // Bezier's points: the cubic lies between the smallest and the largest.
        let [mut m0, mut m1, mut low, mut high] = [[0.0f32; LANES]; 4];
        let mut visible = 0;
        for i in 0..LANES {
            let ([x0, y0, z0], [x1, y1, z1]) = (&first.gradient, &last.gradient);
            let (sx, sy) = (rays.slope[0][i], rays.slope[1][i]);
            m0[i] = h * (x0[i] * sx + y0[i] * sy + z0[i]);
            m1[i] = h * (x1[i] * sx + y1[i] * sy + z1[i]);
        }
        if outside != 0 {
            // Beyond a face the value goes on straight: few samples reach there.
            for i in 0..LANES {
                let [front, back] = [outside >> i & 1, outside >> (LANES + i) & 1];
                if (front, back) == (1, 0) {
                    first.value[i] = last.value[i] - m1[i];
                    m0[i] = m1[i];
                } else if (front, back) == (0, 1) {
                    last.value[i] = first.value[i] + m0[i];
                    m1[i] = m0[i];
                } else {
                    continue;
                }
                for axis in 0..3 {
                    let from = if front == 1 { &last } else { &first }.gradient[axis][i];
                    let to = if front == 1 { &mut first } else { &mut last };
                    to.gradient[axis][i] = from;
                }
            }
        }
        for i in 0..LANES {
            let (a, b) = (first.value[i], last.value[i]);
            let (p, q) = (a + m0[i] * (1.0 / 3.0), b - m1[i] * (1.0 / 3.0));
            let (l, m) = (select(a < b, a, b), select(p < q, p, q));
            low[i] = select(l < m, l, m);
            let (l, m) = (select(a < b, b, a), select(p < q, q, p));
            high[i] = select(l < m, m, l);
            let meets = (high[i] > scene.visible[0]) & (low[i] < scene.visible[1]);
            let meets = meets & (row.here[0][i] > 0.0);
            visible |= u32::from(meets) << i;
        }
        visible &= live;
        if visible == 0 {
            return 0;
        }
        let [from, to] = self.clip(&rays, z);
        let (ends, _) = cells(&high);
        let mut top = [0.0f32; LANES];
        for i in 0..LANES {
            top[i] = scene.most[ends[i] as usize % CELLS + 1];
        }
        let mut steps = [0.0f32; LANES];
        let mut most = 0.0f32;
        for i in 0..LANES {
            let share = (1.0 - row.a[i]) * select(h * top[i] < 1.0, h * top[i], 1.0);
            let ([x0, y0, z0], [x1, y1, z1]) = (&first.gradient, &last.gradient);
            let flat = self.flat * self.flat;
            let square0 = x0[i] * x0[i] + y0[i] * y0[i] + z0[i] * z0[i] + flat;
            let square1 = x1[i] * x1[i] + y1[i] * y1[i] + z1[i] * z1[i] + flat;
            let both = x0[i] * x1[i] + y0[i] * y1[i] + z0[i] * z1[i] + flat;
            let cosine = both / (square0 * square1).sqrt();
            let range = (high[i] - low[i]) * self.range_per_cell;
            let square = share * (STEPS[0] + STEPS[1] * (1.0 - cosine) + STEPS[2] * range);
            let m = select(square > 1.0, 2.0, 1.0);
            let m = select(square > 4.0, 4.0, m);
            let m = select(square > 16.0, MOST_STEPS, m);
            let inside = (visible >> i & 1 == 1) & (to[i] > from[i]);
            steps[i] = select(inside, m, 0.0);
            most = if steps[i] > most { steps[i] } else { most };
        }
        let mut light = [[0.0f32; LANES]; 3];
        let mut value = [0.0f32; LANES];
        let mut step = [0.0f32; LANES];
        for i in 0..LANES {
            step[i] = (to[i] - from[i]) / steps[i].max(1.0);
            value[i] = hermite([first.value[i], last.value[i]], [m0[i], m1[i]], from[i]);
        }
        let mut integral = None;
        for j in 0..most as u32 {
            let [mut middle, mut next, mut active] = [[0.0f32; LANES]; 3];
            for i in 0..LANES {
                active[i] = select((j as f32) < steps[i], 1.0, 0.0);
                let begin = from[i] + j as f32 * step[i];
                middle[i] = begin + 0.5 * step[i];
                next[i] = hermite([first.value[i], last.value[i]], [m0[i], m1[i]], begin + step[i]);
            }
            let looks = scene.between(simd, [&value, &next], &mut integral);
            value = next;
            let terms = shader.map(|shader| self.terms(shader, [&first, &last], &middle, &rays));
            let mut seen = [0.0f32; LANES];
            for i in 0..LANES {
                let tau = looks[0][i] * h * step[i] * row.secant[i] * active[i];
                seen[i] = (1.0 - row.a[i]) * opacity(tau);
                row.a[i] += seen[i];
            }
            for c in 0..3 {
                for i in 0..LANES {
                    let base = looks[c + 1][i];
                    let lit = match &terms {
                        Some([lambert, gloss]) => base * lambert[i] + gloss[i],
                        None => base,
                    };
                    let lit = select(lit > 0.0, lit, 0.0);
                    light[c][i] += seen[i] * select(lit < 1.0, lit, 1.0);
                }
            }
        }
        let mut shut = 0;
        for i in 0..LANES {
            for c in 0..3 {
                row.light[c][i] = fixed_light(light[c][i]);
            }
            shut |= u32::from(1.0 - row.a[i] < self.eps) << i;
        }
        shut & live
    }

    /// Factors of base colours and what is added, at shares `t` of a segment.
    #[inline(always)]
    fn terms(
        &self,
        shader: &Shader,
        [first, last]: [&Plane; 2],
        t: &[f32; LANES],
        rays: &Rays,
    ) -> [[f32; LANES]; 2] {
        let [mut lambert, mut gloss] = [[0.0f32; LANES]; 2];
        let ([x0, y0, z0], [x1, y1, z1]) = (&first.gradient, &last.gradient);
        let [mut nx, mut ny, mut nz] = [[0.0f32; LANES]; 3];
        let [mut ex, mut ey, mut ez] = [[0.0f32; LANES]; 3];
        for i in 0..LANES {
            let gx = x0[i] + (x1[i] - x0[i]) * t[i];
            let gy = y0[i] + (y1[i] - y0[i]) * t[i];
            let gz = z0[i] + (z1[i] - z0[i]) * t[i];
            // To the eye, against the ray.
            let (sx, sy) = (rays.slope[0][i], rays.slope[1][i]);
            let per_length = -1.0 / (sx * sx + sy * sy + 1.0).sqrt();
            (ex[i], ey[i], ez[i]) = (sx * per_length, sy * per_length, per_length);
            let facing = gx * ex[i] + gy * ey[i] + gz * ez[i];
            let side = select(facing < 0.0, -1.0, 1.0);
            let x = gx * side + self.flat * ex[i];
            let y = gy * side + self.flat * ey[i];
            let z = gz * side + self.flat * ez[i];
            let per_length = 1.0 / (x * x + y * y + z * z).sqrt();
            (nx[i], ny[i], nz[i]) = (x * per_length, y * per_length, z * per_length);
        }
        match self.light {
            None => {
                for i in 0..LANES {
                    lambert[i] = nx[i] * ex[i] + ny[i] * ey[i] + nz[i] * ez[i];
                }
                gloss = lambert;
            }
            Some([lx, ly, lz]) => {
                for i in 0..LANES {
                    let (hx, hy, hz) = (lx + ex[i], ly + ey[i], lz + ez[i]);
                    let square = hx * hx + hy * hy + hz * hz;
                    let some = square > 1e-12;
                    let per_half = select(some, 1.0 / select(some, square, 1.0).sqrt(), 0.0);
                    lambert[i] = nx[i] * lx + ny[i] * ly + nz[i] * lz;
                    gloss[i] = (nx[i] * hx + ny[i] * hy + nz[i] * hz) * per_half;
                }
            }
        }
        shader.terms(&mut lambert, &mut gloss, LANES);
        [lambert, gloss]
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

/// The cubic with two `values` and two `slopes` (over the whole segment) at share `t`.
#[inline(always)]
fn hermite([a, b]: [f32; 2], [da, db]: [f32; 2], t: f32) -> f32 {
    let rise = b - a;
    let (c, d) = (3.0 * rise - 2.0 * da - db, da + db - 2.0 * rise);
    a + t * (da + t * (c + t * d))
}

impl FieldScene {
    /// Mean extinction per vox, and the mean colour by extinction, of values that go from one cell
    /// to another. `integral` is that up to `from`, if it is known; that up to `to` afterwards.
    #[inline(always)]
    fn between(
        &self,
        simd: Simd,
        [from, to]: [&[f32; LANES]; 2],
        integral: &mut Option<[[f32; LANES]; 4]>,
    ) -> [[f32; LANES]; 4] {
        let mut middle = [0.0f32; LANES];
        let (mut any_far, mut all_far) = (false, true);
        for i in 0..LANES {
            middle[i] = 0.5 * (from[i] + to[i]);
            let far = (to[i] - from[i]).abs() >= FEW_CELLS;
            any_far |= far;
            all_far &= far;
        }
        if !any_far {
            *integral = None;
            return at(simd, &self.looks, &middle);
        }
        let p = match integral {
            Some(integral) => *integral,
            None => at(simd, &self.integrals, from),
        };
        let q = at(simd, &self.integrals, to);
        *integral = Some(q);
        let mut per_sum = [0.0f32; LANES];
        let mut means = [0.0f32; LANES];
        let mut every = all_far;
        for i in 0..LANES {
            let rise = to[i] - from[i];
            let far = rise.abs() >= FEW_CELLS;
            let sum = q[0][i] - p[0][i];
            let some = far & (sum.abs() > 1e-6);
            every &= some;
            per_sum[i] = select(some, 1.0 / select(some, sum, 1.0), 0.0);
            let mean = sum / select(far, rise, 1.0);
            means[i] = select(mean > 0.0, mean, 0.0);
        }
        // Where all go far nobody looks at middles.
        let mut out = match every {
            true => [[0.0f32; LANES]; 4],
            false => at(simd, &self.looks, &middle),
        };
        for i in 0..LANES {
            let far = (to[i] - from[i]).abs() >= FEW_CELLS;
            out[0][i] = select(far, means[i], out[0][i]);
        }
        for c in 1..4 {
            for i in 0..LANES {
                let mean = (q[c][i] - p[c][i]) * per_sum[i];
                out[c][i] = select(per_sum[i] != 0.0, mean, out[c][i]);
            }
        }
        out
    }
}

/// The cells that hold values, the first or the last of those outside, and where in them.
#[inline(always)]
fn cells(x: &[f32; LANES]) -> ([u32; LANES], [f32; LANES]) {
    let (mut cells, mut shares) = ([0; LANES], [0.0; LANES]);
    for i in 0..LANES {
        let x = select(x[i] > 0.0, x[i], 0.0);
        let x = select(x < CELLS as f32, x, CELLS as f32);
        let whole = truncate(x);
        cells[i] = if whole < CELLS as u32 { whole } else { CELLS as u32 - 1 };
        shares[i] = x - cells[i] as f32;
    }
    (cells, shares)
}

/// A table between its entries, channel by channel.
#[inline(always)]
fn at(simd: Simd, table: &[OpticalSample; CELLS + 1], x: &[f32; LANES]) -> [[f32; LANES]; 4] {
    let (mut cells, shares) = cells(x);
    let [mut low, mut high] = [[[0.0f32; LANES]; 4]; 2];
    lut::take(simd, table, &cells, &mut low);
    cells.iter_mut().for_each(|cell| *cell += 1);
    lut::take(simd, table, &cells, &mut high);
    for c in 0..4 {
        for i in 0..LANES {
            low[c][i] += (high[c][i] - low[c][i]) * shares[i];
        }
    }
    low
}
