//! The kernel's profile, its sections in depth and its footprints on the screen.
//!
//! The kernel is a product of three 1-D profiles along the eye's axes (DESIGN.md section 1):
//! a Gaussian of standard deviation s, cut at radius R, with its edge value subtracted and its
//! integral normalised to one:
//!
//! ```text
//! g(u) = (exp(-u^2 / 2 s^2) - exp(-R^2 / 2 s^2)) / Z,   |u| < R
//! ```
//!
//! A voxel's *section* in a sheet is the integral of g between the sheet's planes (the paper's
//! array of footprints, section 3); its footprint on the screen is g(x) g(y) at pixel centres.
//! Positions come in phases (1/256 pixel, 1/256 sheet or finer), so both are tables, filled in
//! f64 and kept in f32.

use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projection, SUBPIXEL_BITS, SUBPIXELS, View};
use std::sync::OnceLock;

/// One axis of the kernel. Lengths in vox.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Profile {
    std: f64,
    radius: f64,
    edge: f64,
    norm: f64,
}

impl Profile {
    /// Gaussian of `std`, cut at `radius`.
    pub fn new(std: f64, radius: f64) -> Self {
        let edge = libm::exp(-radius * radius / (2.0 * std * std));
        let bell = std
            * (2.0 * std::f64::consts::PI).sqrt()
            * libm::erf(radius / (std * std::f64::consts::SQRT_2));
        Profile { std, radius, edge, norm: bell - 2.0 * radius * edge }
    }

    /// g(u), per vox.
    pub fn at(&self, u: f64) -> f64 {
        if u.abs() >= self.radius {
            return 0.0;
        }
        (libm::exp(-u * u / (2.0 * self.std * self.std)) - self.edge) / self.norm
    }

    /// The integral of g from -radius to `u`: 0 to 1.
    pub fn integral_to(&self, u: f64) -> f64 {
        let u = u.clamp(-self.radius, self.radius);
        let root2 = std::f64::consts::SQRT_2;
        let bell = self.std
            * (std::f64::consts::PI / 2.0).sqrt()
            * (libm::erf(u / (self.std * root2)) + libm::erf(self.radius / (self.std * root2)));
        (bell - self.edge * (u + self.radius)) / self.norm
    }
}

/// Sections by depth phase: which sheets a voxel touches and how much of it lies in each.
#[derive(Clone, Debug)]
pub struct Sections {
    phases: i32,
    shift: u32,
    /// First sheet of each phase, relative to the sheet that holds the voxel's centre.
    first: Vec<i32>,
    /// Sections of each phase.
    count: Vec<u32>,
    /// Row of `stride` weights a phase.
    weights: Vec<f32>,
    stride: usize,
}

impl Sections {
    /// For sheets of `thickness` and a kernel profile along z, both in vox.
    pub fn new(profile: &Profile, thickness: f64, phases: i32) -> Self {
        let reach = profile.radius / thickness;
        let (mut first, mut count) = (Vec::new(), Vec::new());
        for p in 0..phases {
            let at = f64::from(p) / f64::from(phases);
            let f = libm::floor(at - reach) as i32;
            // A voxel that ends on a sheet's plane has nothing behind it.
            let l = libm::ceil(at + reach) as i32 - 1;
            first.push(f);
            count.push((l - f + 1) as u32);
        }
        let stride = count.iter().copied().max().unwrap_or(1) as usize;
        let mut weights = vec![0.0; stride * phases as usize];
        for p in 0..phases as usize {
            let at = p as f64 / f64::from(phases);
            for s in 0..count[p] as usize {
                let lo = (f64::from(first[p]) + s as f64 - at) * thickness;
                let w = profile.integral_to(lo + thickness) - profile.integral_to(lo);
                weights[p * stride + s] = w as f32;
            }
        }
        Sections { phases, shift: phases.trailing_zeros(), first, count, weights, stride }
    }

    /// First sheet of a voxel at depth `z` (in phases) and its weights in the sheets from there.
    #[inline]
    pub fn of(&self, z: i32) -> (i32, &[f32]) {
        let p = (z & (self.phases - 1)) as usize;
        let first = (z >> self.shift) + self.first[p];
        let row = p * self.stride;
        (first, &self.weights[row..row + self.count[p] as usize])
    }

    /// First sheet of a voxel at depth `z` (in phases).
    #[inline]
    pub fn first(&self, z: i32) -> i32 {
        (z >> self.shift) + self.first[(z & (self.phases - 1)) as usize]
    }

    /// Most sheets that one voxel touches.
    pub fn most(&self) -> usize {
        self.stride
    }
}

/// Footprint weights along one screen axis for one scale, by subpixel phase.
#[derive(Clone, Debug)]
struct AxisTable {
    /// First pixel of each phase, relative to the pixel that holds the centre.
    first: Vec<i32>,
    count: Vec<u32>,
    weights: Vec<f32>,
    stride: usize,
}

/// Pixels that a footprint covers along one axis: `[first, last]` for a centre at phase `p`.
fn reach(p: i32, radius_px: f64) -> (i64, i64) {
    let at = f64::from(p) / f64::from(SUBPIXELS);
    (libm::ceil(at - radius_px - 0.5) as i64, libm::floor(at + radius_px - 0.5) as i64)
}

/// The pixel that holds position `pos`, and its phase in there.
#[inline]
fn split(pos: i64) -> (i64, i32) {
    (pos >> SUBPIXEL_BITS, (pos & i64::from(SUBPIXELS - 1)) as i32)
}

/// A pixel as one that rectangles can name; those beyond are off every picture.
#[inline]
fn near(pixel: i64) -> i32 {
    pixel.clamp(-(1 << 30), 1 << 30) as i32
}

/// The one definition of a footprint weight: pixel `i` of a centre at phase `p`.
#[inline]
fn weight(profile: &Profile, scale: f64, p: i32, i: i64) -> f32 {
    let u = (i as f64 + 0.5 - f64::from(p) / f64::from(SUBPIXELS)) / scale;
    profile.at(u) as f32
}

impl AxisTable {
    fn new(profile: &Profile, scale: f64) -> Self {
        let radius = profile.radius * scale;
        let spans: Vec<(i64, i64)> = (0..SUBPIXELS).map(|p| reach(p, radius)).collect();
        let first: Vec<i32> = spans.iter().map(|s| near(s.0)).collect();
        let count: Vec<u32> = spans.iter().map(|s| (s.1 - s.0 + 1).max(0) as u32).collect();
        let stride = count.iter().copied().max().unwrap_or(0) as usize;
        let mut weights = vec![0.0; stride * SUBPIXELS as usize];
        for p in 0..SUBPIXELS as usize {
            for t in 0..count[p] as usize {
                weights[p * stride + t] = weight(profile, scale, p as i32, spans[p].0 + t as i64);
            }
        }
        AxisTable { first, count, weights, stride }
    }
}

/// Most weights of one phase that are kept as a table. A larger footprint (a voxel over a
/// thousand pixels wide) is evaluated where it is drawn, and only inside the tile.
const TABLE_TAPS: f64 = 1024.0;
/// Most bytes of tables that a perspective view may take; beyond it (thousands of thin sheets)
/// weights are evaluated where they are drawn, which costs a voxel some 20 exponentials a
/// section instead of a look-up.
const TABLE_BYTES: f64 = 64.0 * 1024.0 * 1024.0;

/// Tables of one scale, x and y. Where the profiles are the same (cubic lattices) there is one.
#[derive(Debug)]
struct Tables {
    x: AxisTable,
    y: Option<AxisTable>,
}

impl Tables {
    fn new(x: &Profile, y: &Profile, scale: f64) -> Self {
        Tables { x: AxisTable::new(x, scale), y: (x != y).then(|| AxisTable::new(y, scale)) }
    }

    #[inline]
    fn along(&self, axis: usize) -> &AxisTable {
        match (axis, &self.y) {
            (1, Some(y)) => y,
            _ => &self.x,
        }
    }
}

/// Footprints of a view: one scale for all sheets (orthographic) or one a sheet (perspective).
#[derive(Debug)]
pub struct Footprints {
    x: Profile,
    y: Profile,
    /// Tables of the sheets from `first`, made when first asked for; one for all sheets in an
    /// orthographic view; none where they would be too large.
    tables: Vec<OnceLock<Tables>>,
    first: i32,
    view: View,
}

/// Weights along one axis, inside a clip: the first pixel and one weight a pixel.
pub type Span<'a> = (i32, &'a [f32]);

impl Footprints {
    /// The footprints of `view` for sheets in `range`.
    pub fn new(view: &View, range: SheetRange) -> Self {
        let x = Profile::new(view.kernel_std.x, view.kernel_radius.x);
        let y = Profile::new(view.kernel_std.y, view.kernel_radius.y);
        let reach = view.kernel_radius.x.max(view.kernel_radius.y);
        let sheets = match view.projection {
            Projection::Ortho { .. } => 1,
            Projection::Persp { .. } => range.len() as usize,
        };
        let largest = (range.first..range.end).find_map(|k| view.scale_at(k)).unwrap_or(1.0);
        let taps = 2.0 * reach * largest + 2.0;
        let bytes = taps * f64::from(SUBPIXELS) * 8.0 * sheets as f64;
        let kept = taps <= TABLE_TAPS && bytes <= TABLE_BYTES;
        let tables = (0..if kept { sheets } else { 0 }).map(|_| OnceLock::new()).collect();
        Footprints { x, y, tables, first: range.first, view: *view }
    }

    /// The footprints of sheet `k`; `None` where the near plane clips it.
    #[inline]
    pub fn at(&self, k: i32) -> Option<Footprint<'_>> {
        let scale = self.view.scale_at(k)?;
        let slot = match self.view.projection {
            Projection::Ortho { .. } => self.tables.first(),
            Projection::Persp { .. } => self.tables.get((k - self.first) as usize),
        };
        let table = slot.map(|t| t.get_or_init(|| Tables::new(&self.x, &self.y, scale)));
        Some(Footprint { scale, table, profiles: [&self.x, &self.y] })
    }
}

/// The footprints of one sheet.
#[derive(Clone, Copy, Debug)]
pub struct Footprint<'a> {
    /// Pixels a vox.
    pub scale: f64,
    table: Option<&'a Tables>,
    profiles: [&'a Profile; 2],
}

impl Footprint<'_> {
    /// Pixels `[first, end)` along `axis` (0: x, 1: y) that a footprint at screen position
    /// `pos` (1/256 pixel) covers.
    #[inline]
    pub fn extent(&self, axis: usize, pos: i64) -> (i32, i32) {
        let (base, p) = split(pos);
        match self.table {
            Some(t) => {
                let t = t.along(axis);
                let first = near(base) + t.first[p as usize];
                (first, first + t.count[p as usize] as i32)
            }
            None => {
                let (a, b) = reach(p, self.profiles[axis].radius * self.scale);
                (near(base + a), near(base + (b + 1).max(a)))
            }
        }
    }

    /// Weights along `axis` for a footprint at `pos`, clipped to pixels `[lo, hi)`. `buffer`
    /// is used where there is no table.
    #[inline]
    pub fn weights<'b>(
        &'b self,
        axis: usize,
        pos: i64,
        (lo, hi): (i32, i32),
        buffer: &'b mut Vec<f32>,
    ) -> Span<'b> {
        let (first, end) = self.extent(axis, pos);
        let (from, to) = (first.max(lo), end.min(hi));
        if from >= to {
            return (lo, &[]);
        }
        let (base, p) = split(pos);
        match self.table {
            Some(t) => {
                let t = t.along(axis);
                let row = p as usize * t.stride;
                (from, &t.weights[row + (from - first) as usize..row + (to - first) as usize])
            }
            None => {
                let at = |i| weight(self.profiles[axis], self.scale, p, i64::from(i) - base);
                buffer.clear();
                buffer.extend((from..to).map(at));
                (from, &buffer[..])
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_profile_integrates_to_one_and_ends_at_zero() {
        for (std, radius) in [(0.6, 2.0), (0.5, 2.0), (0.7, 2.0), (0.4, 1.0), (1.0, 3.0)] {
            let p = Profile::new(std, radius);
            let n = 20_000;
            let h = 2.0 * radius / n as f64;
            let sum: f64 = (0..n).map(|i| p.at(-radius + (i as f64 + 0.5) * h) * h).sum();
            assert!((sum - 1.0).abs() < 1e-7, "std {std}: {sum}");
            assert!((p.integral_to(radius) - 1.0).abs() < 1e-12);
            assert!(p.integral_to(-radius).abs() < 1e-12);
            assert!((p.integral_to(0.0) - 0.5).abs() < 1e-12);
            assert!(p.at(radius - 1e-9) < 1e-6);
        }
    }

    #[test]
    fn sections_of_a_voxel_add_up_to_it() {
        for d in [1.0 / 64.0, 0.25, 1.0, 1.7, 5.0, 300.0] {
            let p = Profile::new(0.6, 2.0);
            let s = Sections::new(&p, d, 256);
            for z in [-5000, -257, -256, -1, 0, 1, 77, 255, 256, 9999] {
                let (first, w) = s.of(z);
                let sum: f32 = w.iter().sum();
                assert!((sum - 1.0).abs() < 2e-6, "d {d}, z {z}: {sum}");
                // Exactly the sheets that the support [z - R, z + R] meets.
                let at = f64::from(z) / 256.0;
                assert_eq!(first, (at - 2.0 / d).floor() as i32);
                assert_eq!(first + w.len() as i32, (at + 2.0 / d).ceil() as i32);
                assert_eq!(first, s.first(z));
                assert!(w.len() <= s.most());
            }
        }
    }

    /// The ripple of the default kernel on a constant field, worked out in NUMERICS.md
    /// section 4: at most 0.6 % in any direction; here along the lattice and on a diagonal.
    #[test]
    fn a_constant_field_comes_back_with_little_ripple() {
        let p = Profile::new(0.6, 2.0);
        let mut worst = 0.0f64;
        for i in 0..200 {
            let x = i as f64 / 200.0;
            let sum: f64 = (-4..=4).map(|k| p.at(x + k as f64)).sum();
            worst = worst.max((sum - 1.0).abs());
        }
        assert!(worst < 2e-3, "1-D ripple {worst}");
    }
}
