//! Sheets in f64: what a view's thickness alone does to a pixel.
//!
//! Rays, voxels and kernel are those of the limit, but cut into sheets and closed by the rule, with
//! nothing shut. Two things can be switched: how a section is placed, and whether positions are
//! rounded as the splatter rounds them. So the error of thickness, of placement and of rounded
//! positions can each be seen without the others.

use super::Reference;
use super::walk::{Near, Ray, Walk};
use slabcast_common::quality::Compositing;
use slabcast_common::view::{Projection, SUBPIXELS};

/// Depth at which the footprint of a section is placed in a perspective view. In orthographic views
/// all are the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SectionPlacement {
    /// The sheet's mid-plane: the model (docs/design/model.md), and what is drawn.
    #[default]
    MidPlane,
    /// The depth of the section's centroid.
    Centroid,
    /// Half-way between the two. With L the profile across the ray and g the one along it, as
    /// functions of depth, the mid-plane makes a voxel's optical depth `d^2/24 int L'' g` too
    /// large and the centroid as much too small. What is half-way has it to the fourth order,
    /// but each sheet's only to the third: `d^3/24 (L' g)'` moves from sheet to sheet.
    Between,
    /// Nowhere: the kernel is integrated along the slanted ray between the two planes.
    Exact,
}

impl SectionPlacement {
    /// At which depth that is.
    fn at(self, middle: f64, centroid: f64) -> f64 {
        match self {
            SectionPlacement::MidPlane | SectionPlacement::Exact => middle,
            SectionPlacement::Centroid => centroid,
            SectionPlacement::Between => 0.5 * (middle + centroid),
        }
    }
}

/// Options for a reference picture that is drawn sheet by sheet ([`Reference::by_sheets`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SheetOptions {
    /// Depth at which footprints of sections are placed.
    pub section: SectionPlacement,
    /// Whether positions are rounded to subpixels and depth phases, as in a rendered picture.
    pub rounded: bool,
}

/// One sheet at one pixel, in f64.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReferenceSheet {
    /// Number of the sheet, which lies between `k` and `k + 1` thicknesses behind the target.
    pub k: i64,
    /// Optical depth along the ray (the sum of opacities, for the paper's compositing).
    pub tau: f64,
    /// Mean linear RGB, weighted by extinction.
    pub colour: [f64; 3],
    /// Linear premultiplied RGBA of this sheet and all in front of it.
    pub so_far: [f64; 4],
}

/// Length of a piece of a section that four Gauss nodes integrate. Between its ends the kernel
/// is smooth; at half a vox the rule errs by 1e-9 of the weight (deviation .6), at one by 1e-6.
const PIECE: f64 = 0.5;

/// The rule's 2 %, squared: below that share of a sheet, the sheet before hardly counts
/// (docs/design/numerics.md section 1.2). Written out again, since the reference shares no code
/// with the kernels.
const FAINT_BEFORE: f64 = 4e-4;

/// The rule's share of a sheet beside the one behind, which fades thin neighbours
/// (docs/design/numerics.md section 1.2).
const FADE_BEHIND: f64 = 0.05;

impl Reference {
    /// Returns pixel (x, y), linear premultiplied RGBA, of sheets of the view's thickness
    /// composited by the quality's rule in f64, with nothing rounded and nothing shut.
    pub fn at_same_thickness(&self, x: u32, y: u32) -> [f64; 4] {
        self.by_sheets(x, y, SheetOptions::default())
    }

    /// Returns pixel (x, y) as [`Reference::at_same_thickness`] does, with the sheets made as `how`
    /// says.
    pub fn by_sheets(&self, x: u32, y: u32, how: SheetOptions) -> [f64; 4] {
        self.stack(x, y, how).map_or([0.0; 4], |stack| stack.composite(self.compositing))
    }

    /// Returns pixel (x, y) as [`Reference::by_sheets`] does, for the linear and for the constant
    /// colour rule at once: both composite the same sums, and summing takes the time. The scene's
    /// compositing must be one of the two.
    pub fn by_sheets_linear_and_constant(
        &self,
        x: u32,
        y: u32,
        how: SheetOptions,
    ) -> [[f64; 4]; 2] {
        self.stack(x, y, how).map_or([[0.0; 4]; 2], |stack| {
            [Compositing::Linear, Compositing::Constant].map(|rule| stack.composite(rule))
        })
    }

    /// Returns the sheets of [`Reference::by_sheets`] at pixel (x, y), front to back; the last may
    /// be empty. An empty list means that the ray meets no voxel.
    pub fn sheet_by_sheet(&self, x: u32, y: u32, how: SheetOptions) -> Vec<ReferenceSheet> {
        let Some(stack) = self.stack(x, y, how) else { return Vec::new() };
        let mut out = Vec::with_capacity(stack.sheets.len());
        stack.walk(self.compositing, |i, sums, so_far| {
            let mean = |c: usize| if sums[0] > 0.0 { sums[c] / sums[0] } else { 0.0 };
            out.push(ReferenceSheet {
                k: stack.base + i as i64,
                tau: sums[0] * stack.secant,
                colour: [mean(1), mean(2), mean(3)],
                so_far,
            });
        });
        out
    }

    /// The sums of all sheets on a pixel's ray; `None` where it meets no voxel.
    fn stack(&self, x: u32, y: u32, how: SheetOptions) -> Option<Stack> {
        // The profiles across are evaluated here, where positions are known.
        let ray = Ray { parallel: false, ..self.ray(x, y) };
        let d = self.view.thickness;
        let gz = &self.kernel[2];
        let phase = d / f64::from(self.view.depth_phases());
        // A section may lie half a sheet beyond the kernel's reach from the mid-plane where
        // its footprint is.
        let mut walk = Walk::new(self, &ray, &self.sheet_looks, gz.radius + d);
        walk.reach(f64::INFINITY);
        if how.rounded {
            for v in &mut walk.voxels {
                v.z = libm::rint(v.z / phase) * phase;
            }
        }
        let first = |v: &Near| libm::floor((v.z - gz.radius) / d) as i64;
        let end = |v: &Near| libm::ceil((v.z + gz.radius) / d) as i64;
        let base = walk.voxels.iter().map(first).min()?;
        let stop = walk.voxels.iter().map(end).max()?;
        // One more in front and behind: empty neighbours for the rule.
        let n = (stop - base) as usize + 2;
        let mut sheets = vec![[0.0; 4]; n];
        let mut peeks = sheets.clone();
        // A ray along z meets all sections of a voxel at the same place, unless the kernel leans.
        let straight = ray.slope == [0.0; 2];
        let leans = ray.lean != [0.0; 2];
        for v in &walk.voxels {
            let f = first(v);
            let across = if straight { self.across(&ray, [x, y], v, [0.0; 2], how) } else { 1.0 };
            let mut up_to = gz.integral_to(f as f64 * d - v.z);
            for k in f..end(v) {
                let (from, to) = (k as f64 * d, (k + 1) as f64 * d);
                let in_front = std::mem::replace(&mut up_to, gz.integral_to(to - v.z));
                let along = up_to - in_front;
                let weight = if straight {
                    if (from + to) * 0.5 < ray.start { 0.0 } else { along * across }
                } else if how.section == SectionPlacement::Exact {
                    self.along_the_ray(&ray, v, [from.max(v.enter), to.min(v.leave)], |z| z)
                } else if leans {
                    self.leaning(&ray, [x, y], v, [from, to], along, how)
                } else {
                    self.placed(&ray, [x, y], v, from, along, how)
                };
                let at = (k - base) as usize;
                for c in 0..4 {
                    sheets[at][c] += v.payload[c] * weight;
                    if k > f {
                        peeks[at][c] += v.payload[c] * weight;
                    }
                }
            }
        }
        Some(Stack { base, sheets, peeks, y: d / self.view.kernel_std.z, secant: ray.secant })
    }

    /// A section of weight `along` from depth `from` on, with its footprint where `how` says.
    fn placed(
        &self,
        ray: &Ray,
        pixel: [u32; 2],
        v: &Near,
        from: f64,
        along: f64,
        how: SheetOptions,
    ) -> f64 {
        let d = self.view.thickness;
        let middle = from + 0.5 * d;
        if middle < ray.start || along <= 0.0 {
            return 0.0;
        }
        let centroid = v.z + self.kernel[2].moment(from - v.z, d) / along;
        along * self.across(ray, pixel, v, [how.section.at(middle, centroid); 2], how)
    }

    /// The section between two depths of a kernel that leans: where it lies follows from the eye's
    /// rays as [`Reference::placed`] says, and for the lean exactly.
    fn leaning(
        &self,
        ray: &Ray,
        pixel: [u32; 2],
        v: &Near,
        [from, to]: [f64; 2],
        along: f64,
        how: SheetOptions,
    ) -> f64 {
        let middle = 0.5 * (from + to);
        if middle < ray.start || along <= 0.0 {
            return 0.0;
        }
        let centroid = v.z + self.kernel[2].moment(from - v.z, to - from) / along;
        let at = how.section.at(middle, centroid);
        let mut moved = *v;
        if how.rounded {
            let off =
                |axis: usize, how: SheetOptions| self.off(ray, pixel, v, axis, [at, centroid], how);
            let exact = SheetOptions { rounded: false, ..how };
            moved.x += off(0, how) - off(0, exact);
            moved.y += off(1, how) - off(1, exact);
        }
        self.along_the_ray(ray, &moved, [from, to], |_| at)
    }

    /// The profiles across the ray where it passes a depth: first for the eye's slope, then for the
    /// lean's.
    fn across(&self, ray: &Ray, pixel: [u32; 2], v: &Near, at: [f64; 2], how: SheetOptions) -> f64 {
        let [x, y] = [0, 1].map(|axis| self.off(ray, pixel, v, axis, at, how));
        self.kernel[0].at(x) * self.kernel[1].at(y)
    }

    /// From a voxel to the ray along an axis, there.
    fn off(
        &self,
        ray: &Ray,
        pixel: [u32; 2],
        v: &Near,
        axis: usize,
        [at, leaning]: [f64; 2],
        how: SheetOptions,
    ) -> f64 {
        let offset = [v.x, v.y][axis];
        let exact = if ray.lean[axis] == 0.0 {
            offset + ray.slope[axis] * at
        } else {
            offset + (ray.slope[axis] - ray.lean[axis]) * at + ray.lean[axis] * leaning
        };
        if !how.rounded {
            return exact;
        }
        let scale = match self.view.projection {
            Projection::Ortho { scale } => scale,
            Projection::Persp { focal, distance } => focal / (distance + at),
        };
        // From the footprint's centre, in pixels of the picture, to the pixel's.
        let here = f64::from(pixel[axis]) + 0.5;
        let centre = (here - exact * scale) * f64::from(SUBPIXELS);
        (here - libm::rint(centre) / f64::from(SUBPIXELS)) / scale
    }

    /// The kernel's integral along the ray between two depths, per unit of depth; at depth z the
    /// eye's ray is where it passes `seen_at(z)`.
    fn along_the_ray(
        &self,
        ray: &Ray,
        v: &Near,
        [from, to]: [f64; 2],
        seen_at: impl Fn(f64) -> f64,
    ) -> f64 {
        let [gx, gy, gz] = &self.kernel;
        let from = from.max(v.z - gz.radius);
        let to = to.min(v.z + gz.radius);
        if from >= to {
            return 0.0;
        }
        let pieces = libm::ceil((to - from) / PIECE);
        let h = (to - from) / pieces;
        let mut sum = 0.0;
        for piece in 0..pieces as u32 {
            for (node, weight) in self.rule.nodes.iter().zip(self.rule.weights) {
                let z = from + (f64::from(piece) + node) * h;
                let seen = seen_at(z) - z;
                let [x, y] = [0, 1].map(|a| ray.slope[a] * z + (ray.slope[a] - ray.lean[a]) * seen);
                sum += weight * h * gz.at(z - v.z) * gx.at(v.x + x) * gy.at(v.y + y);
            }
        }
        sum
    }
}

/// A pixel's sheets, first to last.
struct Stack {
    /// Index of the first.
    base: i64,
    sheets: Vec<[f64; 4]>,
    /// Sums without the voxels that begin in the sheet, which the sheet in front peeks at.
    peeks: Vec<[f64; 4]>,
    /// Thickness over the kernel's standard deviation.
    y: f64,
    secant: f64,
}

impl Stack {
    fn composite(&self, rule: Compositing) -> [f64; 4] {
        let mut pixel = [0.0; 4];
        self.walk(rule, |_, _, so_far| pixel = so_far);
        pixel
    }

    /// Closes sheet after sheet and shows each: its number from the first, its sums, and the
    /// pixel so far.
    fn walk(&self, rule: Compositing, mut show: impl FnMut(usize, [f64; 4], [f64; 4])) {
        let mut pixel = [0.0; 4];
        let mut before = [0.0; 4];
        for k in 0..self.sheets.len() - 1 {
            let here = self.sheets[k];
            let closed = close(rule, self.y, before, here, self.peeks[k + 1], self.secant);
            let open = 1.0 - pixel[3];
            for c in 0..4 {
                pixel[c] += open * closed[c];
            }
            before = here;
            show(k, here, pixel);
        }
    }
}

/// Light and opacity of one sheet (docs/design/numerics.md, section 1.2, the paper's section 3), in
/// f64.
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
            1.0 / (1.0 + FAINT_BEFORE / ratio / ratio)
        } else {
            ratio * ratio / (ratio * ratio + FAINT_BEFORE)
        };
        let phi = if tau < 0.02 {
            let series = -1.0 / 80.0 + tau * (1.0 / 360.0 - tau / 2016.0);
            tau * tau * (-1.0 / 12.0 + tau * (1.0 / 24.0 + tau * series))
        } else {
            a / tau + a * 0.5 - 1.0
        };
        (left * share, right / (behind[0] + FADE_BEHIND * here[0]), phi)
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
