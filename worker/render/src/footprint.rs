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

use crate::splat::Tap;
use glam::DVec3;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projection, SUBPIXEL_BITS, SUBPIXELS, View};
use std::sync::OnceLock;

/// One axis of the kernel. Lengths in vox.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Profile {
    std: f64,
    radius: f64,
    /// What weights are multiplied by before they become 16-bit fixed point.
    spread: f64,
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
        Profile { std, radius, spread: 1.0, edge, norm: bell - 2.0 * radius * edge }
    }

    /// The same for a lattice whose steps are `spread` vox along this axis: weights in fixed point
    /// are then those per step, below one for every lattice.
    #[must_use]
    pub fn with_spread(self, spread: f64) -> Self {
        Profile { spread, ..self }
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
    /// The same over the thickness, in steps of the lattice, as [`fixed`] point.
    fixed: Vec<i16>,
    stride: usize,
}

/// A weight from 0 to 1 in 16-bit fixed point: 2^-15 a unit, rounded to nearest.
fn fixed(w: f64) -> i16 {
    libm::floor(w * 32768.0 + 0.5).clamp(0.0, 32767.0) as i16
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
        let mut fixed_weights = vec![0; weights.len()];
        for p in 0..phases as usize {
            let at = p as f64 / f64::from(phases);
            for s in 0..count[p] as usize {
                let lo = (f64::from(first[p]) + s as f64 - at) * thickness;
                let w = profile.integral_to(lo + thickness) - profile.integral_to(lo);
                weights[p * stride + s] = w as f32;
                fixed_weights[p * stride + s] = fixed(w * profile.spread / thickness);
            }
        }
        let shift = phases.trailing_zeros();
        Sections { phases, shift, first, count, weights, fixed: fixed_weights, stride }
    }

    /// First sheet of a voxel at depth `z` (in phases) and its weights in the sheets from there.
    #[inline]
    pub fn of(&self, z: i32) -> (i32, &[f32]) {
        let p = (z & (self.phases - 1)) as usize;
        let first = (z >> self.shift) + self.first[p];
        let row = p * self.stride;
        (first, &self.weights[row..row + self.count[p] as usize])
    }

    /// [`Sections::of`] with weights over the thickness, in steps of the lattice, in units of 2^-15.
    #[inline]
    pub fn of_fixed(&self, z: i32) -> (i32, &[i16]) {
        let p = (z & (self.phases - 1)) as usize;
        let first = (z >> self.shift) + self.first[p];
        let row = p * self.stride;
        (first, &self.fixed[row..row + self.count[p] as usize])
    }

    /// First sheet of a voxel at depth `z` (in phases), and in how many it lies.
    #[inline(always)]
    pub fn span(&self, z: i32) -> (i32, u32) {
        let p = (z & (self.phases - 1)) as usize;
        ((z >> self.shift) + self.first[p], self.count[p])
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
    weights: Vec<Tap>,
    /// The same in steps of the lattice, as fixed point.
    fixed: Vec<i16>,
    stride: usize,
    /// Pixels that a footprint reaches at most from the one that holds its centre.
    reach: i32,
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

/// The one definition of a footprint weight, per vox: pixel `i` of a centre at phase `p`.
#[inline]
fn weight(profile: &Profile, scale: f64, p: i32, i: i64) -> f64 {
    let u = (i as f64 + 0.5 - f64::from(p) / f64::from(SUBPIXELS)) / scale;
    profile.at(u)
}

impl AxisTable {
    fn new(profile: &Profile, scale: f64) -> Self {
        let radius = profile.radius * scale;
        let spans: Vec<(i64, i64)> = (0..SUBPIXELS).map(|p| reach(p, radius)).collect();
        let first: Vec<i32> = spans.iter().map(|s| near(s.0)).collect();
        let count: Vec<u32> = spans.iter().map(|s| (s.1 - s.0 + 1).max(0) as u32).collect();
        let stride = count.iter().copied().max().unwrap_or(0) as usize;
        let mut weights = vec![Tap::default(); stride * SUBPIXELS as usize];
        let mut fixed_weights = vec![0; weights.len()];
        for p in 0..SUBPIXELS as usize {
            for t in 0..count[p] as usize {
                let w = weight(profile, scale, p as i32, spans[p].0 + t as i64);
                weights[p * stride + t] = Tap::new(w as f32);
                fixed_weights[p * stride + t] = fixed(w * profile.spread);
            }
        }
        let far = |s: &(i64, i64)| near((-s.0).max(s.1));
        let reach = spans.iter().map(far).max().unwrap_or(0);
        AxisTable { first, count, weights, fixed: fixed_weights, stride, reach }
    }
}

/// Most weights of one phase that are kept as a table. A larger footprint (a voxel over a
/// thousand pixels wide) is evaluated where it is drawn, and only inside the tile.
const TABLE_TAPS: f64 = 1024.0;
/// Most bytes of tables that a perspective view may take: sheets of 1/32 vox in a volume of 256
/// voxels a side. Beyond it weights are evaluated where they are drawn, which costs a voxel some 20
/// exponentials a section instead of a look-up: minutes a picture instead of seconds. Only tables of
/// sheets that are drawn are made.
const TABLE_BYTES: f64 = 256.0 * 1024.0 * 1024.0;

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
pub type Span<'a> = (i32, &'a [Tap]);

impl Footprints {
    /// The footprints of `view` for sheets in `range`; `spread` is the length of a lattice step
    /// along the eye's axes in vox ([`Profile::with_spread`]).
    pub fn new(view: &View, range: SheetRange, spread: DVec3) -> Self {
        let x = Profile::new(view.kernel_std.x, view.kernel_radius.x).with_spread(spread.x);
        let y = Profile::new(view.kernel_std.y, view.kernel_radius.y).with_spread(spread.y);
        let reach = view.kernel_radius.x.max(view.kernel_radius.y);
        let sheets = match view.projection {
            Projection::Ortho { .. } => 1,
            Projection::Persp { .. } => range.len() as usize,
        };
        let largest = (range.first..range.end).find_map(|k| view.scale_at(k)).unwrap_or(1.0);
        let taps = 2.0 * reach * largest + 2.0;
        // Two kinds of weights, along one axis or two.
        let axes = if x == y { 1.0 } else { 2.0 };
        let bytes = taps * f64::from(SUBPIXELS) * 6.0 * axes * sheets as f64;
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
    /// Pixels that it reaches at most from the one that holds its centre, where its weights are in
    /// a table; otherwise they are worked out where they are drawn.
    #[inline]
    pub fn reach(&self) -> Option<i32> {
        self.table.map(|t| t.along(0).reach.max(t.along(1).reach))
    }

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
    #[inline(always)]
    pub fn weights<'b>(
        &'b self,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<Tap>,
    ) -> Span<'b> {
        self.window(axis, pos, clip, buffer, |t| &t.weights, |w, _| Tap::new(w as f32))
    }

    /// [`Footprint::weights`] in steps of the lattice, in units of 2^-15.
    #[inline(always)]
    pub fn weights_fixed<'b>(
        &'b self,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<i16>,
    ) -> (i32, &'b [i16]) {
        self.window(axis, pos, clip, buffer, |t| &t.fixed, |w, spread| fixed(w * spread))
    }

    #[inline(always)]
    fn window<'b, W>(
        &'b self,
        axis: usize,
        pos: i64,
        (lo, hi): (i32, i32),
        buffer: &'b mut Vec<W>,
        column: impl Fn(&'b AxisTable) -> &'b [W],
        make: impl Fn(f64, f64) -> W,
    ) -> (i32, &'b [W]) {
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
                (from, &column(t)[row + (from - first) as usize..row + (to - first) as usize])
            }
            None => {
                let profile = self.profiles[axis];
                let at = |i| weight(profile, self.scale, p, i64::from(i) - base);
                buffer.clear();
                buffer.extend((from..to).map(|i| make(at(i), profile.spread)));
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
