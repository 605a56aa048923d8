//! The kernel's profile, its sections in depth and its footprints on the screen.
//!
//! The kernel is a product of three 1-D profiles along the eye's axes (docs/design/model.md), in
//! lattices that are not cubic along axes that [lean](slabcast_common::kernel): a Gaussian of
//! standard deviation s, cut at radius R, with its edge value subtracted and its integral
//! normalised to one:
//!
//! ```text
//! g(u) = (exp(-u^2 / 2 s^2) - exp(-R^2 / 2 s^2)) / Z,   |u| < R
//! ```
//!
//! or a B-spline of the lattice's steps, the cubic one or the tent, which add up to one wherever
//! along a lattice's axis one looks.
//!
//! A voxel's *section* in a sheet is the integral of g between the sheet's planes (the paper's
//! array of footprints, section 3); its footprint on the screen is g(x) g(y) at pixel centres.
//! Positions come in phases (1/256 pixel, 1/256 sheet or finer), so both are tables, filled in
//! f64 and kept in f32.

use crate::primitives::Tap;
use crate::primitives::field_taps::FieldTaps;
use crate::primitives::profile_table::ProfileTable;
use crate::primitives::sections::fixed;
pub use crate::primitives::sections::{SLIVER, Sections};
use glam::DVec3;
pub use slabcast_common::kernel::{Lean, Profile};
use slabcast_common::quality::Kernel;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projection, SUBPIXEL_BITS, SUBPIXELS, View};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Offsets of sections and rows of a kernel that leans ([`slabcast_common::kernel`]).
#[derive(Debug)]
pub struct Leaning {
    /// Distance of each section from its voxel along x and y, in vox, in the order of the weights
    /// of [`Sections::all`].
    aside: [Vec<f64>; 2],
    /// Offsets in subpixels, in orthographic views.
    subpixels: [Vec<i32>; 2],
    /// Slope of the kernel's rows, vox per vox in units of 2^-16 ([`Lean::row_fixed`]).
    row: i64,
    /// The farthest that any section lies aside.
    most: [f64; 2],
}

impl Leaning {
    /// For sheets of the thickness of `view`, cut by `sections`, of a kernel with profile `deep`
    /// along the depth; `scale`: pixels a vox at most.
    /// Fields have planes, other scenes have sections.
    pub(crate) fn new(view: &View, deep: &Profile, sections: &Sections, scale: f64) -> Leaning {
        let (lean, thickness) = (&view.kernel_lean, view.thickness);
        // Two spacings that differ in their last digits move rows and sections by less than the
        // rounding of positions. That counts as no lean.
        let shows = |vox: f64| vox * scale * f64::from(SUBPIXELS) >= 1.0;
        let row = if shows(lean.row.abs() * view.kernel_radius.y) { lean.row_fixed() } else { 0 };
        let slopes =
            lean.depth.map(|slope| if shows(slope.abs() * deep.radius) { slope } else { 0.0 });
        let (aside, subpixels) = ([vec![], vec![]], [vec![], vec![]]);
        let mut leaning = Leaning { aside, subpixels, row, most: [0.0; 2] };
        let mut behind = vec![0.0; sections.stride];
        for p in 0..sections.phases {
            let at = f64::from(p) / f64::from(sections.phases);
            let first = (f64::from(sections.first(p)) - at) * thickness;
            if sections.field.is_empty() {
                deep.places(first, thickness, &mut behind);
            } else {
                for (plane, behind) in behind.iter_mut().enumerate() {
                    *behind = first + (plane as f64 + 0.5) * thickness;
                }
            }
            for (axis, slope) in slopes.into_iter().enumerate() {
                for behind in &behind {
                    let aside = slope * behind;
                    leaning.aside[axis].push(aside);
                    let subpixels = libm::floor(aside * scale * f64::from(SUBPIXELS) + 0.5);
                    leaning.subpixels[axis].push(subpixels as i32);
                    leaning.most[axis] = leaning.most[axis].max(aside.abs());
                }
            }
        }
        leaning
    }

    /// Whether anything lies aside at all.
    pub(crate) fn shows(&self) -> bool {
        self.row != 0 || self.most != [0.0; 2]
    }

    /// Distance of sections beside their voxels along an axis, in vox: [`Sections::most`] a phase.
    #[inline(always)]
    pub(crate) fn aside(&self, axis: usize) -> &[f64] {
        &self.aside[axis]
    }

    /// Distance of sections beside their voxels along an axis, in subpixels; parallel views only.
    /// [`Sections::most`] a phase.
    #[inline(always)]
    pub(crate) fn subpixels(&self, axis: usize) -> &[i32] {
        &self.subpixels[axis]
    }

    /// Pixels at most along x and y that a section or an outermost row lies beside its voxel, for
    /// footprints of a `reach` along each; `scale`: pixels a vox at most.
    pub(crate) fn pixels(&self, scale: f64, [_, reach]: [i32; 2]) -> [f64; 2] {
        let row = self.row as f64 / 65536.0;
        let [x, y] = self.most.map(|vox| vox * scale);
        [x + row.abs() * f64::from(reach + 1), y]
    }

    /// Returns the distance that the middle of a row moves along x for each row, in units of 2^-16.
    #[inline(always)]
    pub(crate) fn row(&self) -> i64 {
        self.row
    }
}

/// Footprint weights along one screen axis for one scale, by subpixel phase.
#[derive(Clone, Debug)]
struct AxisTable {
    first: First,
    count: Vec<u32>,
    weights: Vec<Tap>,
    /// Weights in lattice steps, as fixed point.
    fixed: Vec<i16>,
    /// Weights of the four channels of a field, along x and along y; empty for other scenes.
    field: [FieldTaps; 2],
    /// Weights of a phase at most.
    stride: usize,
    /// Zeros before and after those of each phase.
    margin: usize,
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
    profile.at(distance(scale, p, i))
}

/// Distance in vox of the middle of pixel `i` from a centre at phase `p`.
#[inline]
fn distance(scale: f64, p: i32, i: i64) -> f64 {
    (i as f64 + 0.5 - f64::from(p) / f64::from(SUBPIXELS)) / scale
}

/// First pixel of a footprint, relative to the one that holds the centre: as the centre goes
/// through that, it goes one farther at most.
#[derive(Clone, Copy, Debug)]
struct First {
    /// First pixel of the first phases, relative to the pixel that holds the centre.
    near: i32,
    /// The phase from which it is one more.
    more_from: i32,
}

impl First {
    #[inline(always)]
    fn of(self, p: i32) -> i32 {
        self.near + i32::from(p >= self.more_from)
    }
}

/// Layout of a weight table along one axis: where the weights of each phase begin.
#[derive(Clone, Copy, Debug)]
pub struct Phases {
    first: First,
    /// Largest number of pixels that a footprint has along the axis.
    pub len: usize,
    /// Zeros before and after the weights of each.
    margin: usize,
}

impl Phases {
    /// First pixel of phase `p`, relative to the one that holds the centre.
    #[inline(always)]
    pub(crate) fn first(&self, p: i32) -> i32 {
        self.first.of(p)
    }

    /// The phase from which on the first pixel is one farther.
    #[inline(always)]
    pub(crate) fn more_from(&self) -> i32 {
        self.first.more_from
    }

    /// Returns the index in the table at which the weights of phase `p` begin.
    #[inline(always)]
    pub fn begin(&self, p: usize) -> usize {
        p * (self.len + 2 * self.margin) + self.margin
    }
}

impl AxisTable {
    /// Weights of `profile` at `scale`; `padded` puts as many zeros before and behind those of each
    /// phase.
    fn new(profile: &Profile, scale: f64, padded: bool, field: bool) -> Self {
        let radius = profile.radius * scale;
        let spans: Vec<(i64, i64)> = (0..SUBPIXELS).map(|p| reach(p, radius)).collect();
        let firsts: Vec<i32> = spans.iter().map(|s| near(s.0)).collect();
        let more_from = firsts.partition_point(|first| *first == firsts[0]) as i32;
        let first = First { near: firsts[0], more_from };
        debug_assert!((0..SUBPIXELS).zip(&firsts).all(|(p, want)| first.of(p) == *want));
        let count: Vec<u32> = spans.iter().map(|s| (s.1 - s.0 + 1).max(0) as u32).collect();
        let stride = count.iter().copied().max().unwrap_or(0) as usize;
        let margin = if padded { stride } else { 0 };
        let far = |s: &(i64, i64)| near((-s.0).max(s.1));
        let reach = spans.iter().map(far).max().unwrap_or(0);
        let n = (stride + 2 * margin) * SUBPIXELS as usize;
        let (weights, fixed_weights) = (vec![Tap::default(); n], vec![0; n]);
        let taps = || if field { FieldTaps::zeros(n) } else { FieldTaps::default() };
        let mut table = AxisTable {
            first,
            count,
            weights,
            fixed: fixed_weights,
            field: [taps(), taps()],
            stride,
            margin,
            reach,
        };
        for p in 0..SUBPIXELS as usize {
            let begin = table.phases().begin(p);
            for t in 0..table.count[p] as usize {
                let w = weight(profile, scale, p as i32, spans[p].0 + t as i64);
                let u = distance(scale, p as i32, spans[p].0 + t as i64);
                for (axis, taps) in table.field.iter_mut().enumerate().filter(|_| field) {
                    taps.put(begin + t, axis, profile, u);
                }
                table.weights[begin + t] = Tap::new(w as f32);
                table.fixed[begin + t] = fixed(w * profile.spread);
            }
        }
        table
    }

    #[inline(always)]
    fn phases(&self) -> Phases {
        Phases { first: self.first, len: self.stride, margin: self.margin }
    }
}

/// Most weights of one phase that are kept as a table. A larger footprint (a voxel over a
/// thousand pixels wide) is evaluated where it is drawn, and only inside the tile.
const TABLE_TAPS: f64 = 1024.0;
/// Most bytes of tables that a perspective view may take: sheets of 1/32 vox in a volume of 256
/// voxels a side. Beyond it weights are evaluated where they are drawn, which costs a voxel some 20
/// exponentials a section instead of a look-up: minutes a picture instead of seconds. Only tables
/// of sheets that are drawn are made.
const TABLE_BYTES: f64 = 256.0 * 1024.0 * 1024.0;

/// Tables of one scale, x and y. Where the profiles are the same (cubic lattices) there is one.
#[derive(Debug)]
struct Tables {
    x: AxisTable,
    y: Option<AxisTable>,
}

impl Tables {
    fn new(x: &Profile, y: &Profile, scale: f64, padded: bool, field: bool) -> Self {
        let along = |profile| AxisTable::new(profile, scale, padded, field);
        Tables { x: along(x), y: (x != y).then(|| along(y)) }
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
    tables: Vec<OnceLock<Arc<Tables>>>,
    first: i32,
    view: View,
    shelf: Arc<Shelf>,
    /// Whether tables have the weights of a field's four channels.
    field: bool,
}

/// Tables that all frames of one scene share. A scene has one kernel: along a turn a sheet's scale
/// is the same in all frames, and so is the kernel's depth in a cubic lattice.
#[derive(Debug, Default)]
pub struct Shelf {
    tables: Mutex<BTreeMap<Key, Arc<Tables>>>,
    /// Sections by profile, thickness and phases, kept from frame to frame.
    pub sections: Mutex<BTreeMap<Deep, Arc<Sections>>>,
    profiles: Mutex<BTreeMap<Cut, Arc<ProfileTable>>>,
}

/// A deviation and a radius, as bits, and whether the kernel is whole.
type Cut = ([u64; 2], bool);

/// A profile and a thickness, as bits, phases of a sheet, and whether slivers are given away.
type Deep = ([u64; 4], i32, bool);

/// Two profiles and a scale, as bits, whether weights have zeros around them, and whether there are
/// those of fields.
type Key = ([u64; 7], bool, bool);

/// Tables that a shelf keeps: some 1000 are 14 MB at two pixels a vox. A turn of a volume of 256
/// voxels a side has 450. A shelf that is full is cleared: what frames use they hold themselves.
const SHELF: usize = 1024;

/// Footprints are as wide as scales rounded to this many bits say, so that those of frames from one
/// distance are the same whatever the last bits are. It is a 2^17th of a footprint's width.
const SCALE_BITS: u32 = 16;

/// `scale` rounded to [`SCALE_BITS`].
fn rounded(scale: f64) -> f64 {
    let drop = 52 - SCALE_BITS;
    f64::from_bits((scale.to_bits() + (1 << (drop - 1))) >> drop << drop)
}

impl Shelf {
    fn get(&self, [x, y]: [&Profile; 2], scale: f64, padded: bool, field: bool) -> Arc<Tables> {
        let profile = |p: &Profile| [p.std, p.radius, p.spread].map(f64::to_bits);
        let ([a, b, c], [d, e, f]) = (profile(x), profile(y));
        let key = ([a, b, c, d, e, f, scale.to_bits()], padded, field);
        shelved(&self.tables, SHELF, key, || Tables::new(x, y, scale, padded, field))
    }

    /// Returns [`Sections::new`] from the shelf, made once: it takes 80 us, which is a twentieth of
    /// what a worker of fifteen draws of a frame of mri256.
    pub fn sections(
        &self,
        profile: &Profile,
        thickness: f64,
        phases: i32,
        merged: bool,
    ) -> Arc<Sections> {
        let bits = [profile.std, profile.radius, profile.spread, thickness].map(f64::to_bits);
        let key = (bits, phases, merged);
        shelved(&self.sections, SECTIONS, key, || Sections::new(profile, thickness, phases, merged))
    }

    /// Returns [`Sections::planes`] from the shelf.
    pub fn planes(&self, profile: &Profile, thickness: f64, phases: i32) -> Arc<Sections> {
        let bits = [profile.std, profile.radius, profile.spread, thickness].map(f64::to_bits);
        // No sections have so few phases.
        let key = (bits, -phases, false);
        shelved(&self.sections, SECTIONS, key, || Sections::planes(profile, thickness, phases))
    }

    /// A profile of this deviation and radius, or the whole of what it is cut from, as
    /// [`crate::judge::error_probe::model`] has it.
    pub(crate) fn profile(
        &self,
        (std, radius, whole): (f64, f64, bool),
        make: impl FnOnce() -> ProfileTable,
    ) -> Arc<ProfileTable> {
        shelved(&self.profiles, SECTIONS, ([std, radius].map(f64::to_bits), whole), make)
    }
}

/// Returns the shelf's entry under `key`, or else makes it. A shelf of `most` entries is cleared.
fn shelved<K: Ord, V>(
    shelf: &Mutex<BTreeMap<K, Arc<V>>>,
    most: usize,
    key: K,
    make: impl FnOnce() -> V,
) -> Arc<V> {
    let shelf = || shelf.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(found) = shelf().get(&key) {
        return found.clone();
    }
    // Not under the lock: it takes a tenth of a millisecond, and threads want others.
    let made = Arc::new(make());
    let mut shelf = shelf();
    if shelf.len() >= most {
        shelf.clear();
    }
    shelf.entry(key).or_insert(made).clone()
}

/// Number of sections, and of profiles, that a shelf keeps, of some 8 KB each. A view of a lattice
/// that is not cubic has its own, and none of them is asked for again.
pub const SECTIONS: usize = 64;

/// Weights along one axis, inside a clip: the first pixel and one weight a pixel.
pub type Span<'a> = (i32, &'a [Tap]);

impl Footprints {
    /// Prepares the footprints of `view` with `kernel` for sheets in `range`; `spread` is the
    /// length of a lattice step along the eye's axes in vox ([`Profile::with_spread`]). Tables are
    /// taken from `shelf`.
    pub fn new(
        view: &View,
        kernel: Kernel,
        range: SheetRange,
        spread: DVec3,
        shelf: Arc<Shelf>,
        field: bool,
    ) -> Self {
        let (std, radius) = (view.kernel_std, view.kernel_radius);
        let x = Profile::new(kernel, std.x, radius.x).with_spread(spread.x);
        let y = Profile::new(kernel, std.y, radius.y).with_spread(spread.y);
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
        let first = range.first;
        Footprints { x, y, tables, first, view: *view, shelf, field }
    }

    /// Returns the footprint of voxels in sheet `k`; `None` where the near plane clips the sheet.
    #[inline]
    pub fn at(&self, k: i32) -> Option<Footprint<'_>> {
        let scale = self.view.scale_at(k)?;
        // If one table serves all sheets, windows are moved to lie inside a part.
        let (slot, padded) = match self.view.projection {
            Projection::Ortho { .. } => (self.tables.first(), true),
            Projection::Persp { .. } => (self.tables.get((k - self.first) as usize), false),
        };
        let wide = rounded(scale);
        let make = || self.shelf.get([&self.x, &self.y], wide, padded, self.field);
        let table = slot.map(|t| &**t.get_or_init(make));
        Some(Footprint { scale, wide, table, profiles: [&self.x, &self.y] })
    }
}

/// Footprint of the voxels of one sheet: weights by position between pixels, along x and y.
#[derive(Clone, Copy, Debug)]
pub struct Footprint<'a> {
    /// Pixels a vox in the sheet, from which positions follow.
    pub scale: f64,
    /// Scale rounded to a table's, which decides the footprint's width.
    wide: f64,
    table: Option<&'a Tables>,
    profiles: [&'a Profile; 2],
}

impl<'a> Footprint<'a> {
    /// Returns the number of pixels along x and y between the one that holds a voxel's centre and
    /// the edge of its footprint; `None` where weights are in no table and are worked out as they
    /// are drawn.
    #[inline]
    pub fn reach(&self) -> Option<[i32; 2]> {
        self.table.map(|t| [t.along(0).reach, t.along(1).reach])
    }

    /// Returns the pixels `[first, end)` along `axis` (0: x, 1: y) that a footprint covers at
    /// screen position `pos`, in 1/256 pixel.
    #[inline]
    pub fn extent(&self, axis: usize, pos: i64) -> (i32, i32) {
        let (base, p) = split(pos);
        match self.table {
            Some(t) => {
                let t = t.along(axis);
                let first = near(base) + t.first.of(p);
                (first, first + t.count[p as usize] as i32)
            }
            None => {
                let (a, b) = reach(p, self.profiles[axis].radius * self.wide);
                (near(base + a), near(base + (b + 1).max(a)))
            }
        }
    }

    /// Returns the unitless weights of a footprint along `axis` (0: x, 1: y) at screen position
    /// `pos` (1/256 pixel), clipped to pixels `[lo, hi)`. `buffer` is used where there is no table.
    #[inline(always)]
    pub fn weights<'b>(
        &'b self,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<Tap>,
    ) -> Span<'b> {
        let row = |t: &'b AxisTable, p: usize| &t.weights[t.phases().begin(p)..][..t.stride];
        self.window(axis, pos, clip, buffer, row, |w, _| Tap::new(w as f32))
    }

    /// Returns [`Footprint::weights`] in fixed point: in steps of the lattice, in units of 2^-15.
    #[inline(always)]
    pub fn weights_fixed<'b>(
        &'b self,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<i16>,
    ) -> (i32, &'b [i16]) {
        let row = |t: &'b AxisTable, p: usize| &t.fixed[t.phases().begin(p)..][..t.stride];
        self.window(axis, pos, clip, buffer, row, |w, spread| fixed(w * spread))
    }

    /// Returns the weights of the four channels of a field along `axis` as [`Footprint::weights`]
    /// does.
    #[inline(always)]
    pub(crate) fn field_weights<'b>(
        &'b self,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<[f32; 4]>,
    ) -> (i32, &'b [[f32; 4]]) {
        let row =
            |t: &'b AxisTable, p: usize| &t.field[axis].floats()[t.phases().begin(p)..][..t.stride];
        self.field_window(axis, pos, clip, buffer, row, FieldTaps::float_tap)
    }

    /// Returns [`Footprint::field_weights`] in fixed point: in steps of the lattice, in units of
    /// 2^-15.
    #[inline(always)]
    pub(crate) fn field_weights_fixed<'b>(
        &'b self,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<[i16; 4]>,
    ) -> (i32, &'b [[i16; 4]]) {
        let row =
            |t: &'b AxisTable, p: usize| &t.field[axis].fixed()[t.phases().begin(p)..][..t.stride];
        self.field_window(axis, pos, clip, buffer, row, FieldTaps::fixed_tap)
    }

    /// Weights of a field's channels along `axis` where they are in a table.
    pub(crate) fn field(&self, axis: usize) -> Option<&'a FieldTaps> {
        self.table.map(|t| &t.along(axis).field[axis])
    }

    /// All weights along `axis`, where they are in a table; orthographic ones padded, so that a
    /// window that is moved to lie inside a part reads zeros outside.
    pub(crate) fn all(&self, axis: usize) -> Option<&'a [Tap]> {
        self.table.map(|t| &t.along(axis).weights[..])
    }

    /// [`Footprint::all`] in steps of the lattice, in units of 2^-15.
    pub(crate) fn all_fixed(&self, axis: usize) -> Option<&'a [i16]> {
        self.table.map(|t| &t.along(axis).fixed[..])
    }

    /// Returns the layout of the weight table along `axis` (0: x, 1: y); `None` where there is no
    /// table.
    pub fn phases(&self, axis: usize) -> Option<Phases> {
        self.table.map(|t| t.along(axis).phases())
    }

    #[inline(always)]
    fn field_window<'b, W>(
        &'b self,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<W>,
        row: impl Fn(&'b AxisTable, usize) -> &'b [W],
        make: impl Fn(usize, &Profile, f64) -> W,
    ) -> (i32, &'b [W]) {
        let (_, p) = split(pos);
        let at = |profile: &Profile, i| make(axis, profile, distance(self.wide, p, i));
        self.window_of(axis, pos, clip, buffer, row, at)
    }

    #[inline(always)]
    fn window<'b, W>(
        &'b self,
        axis: usize,
        pos: i64,
        (lo, hi): (i32, i32),
        buffer: &'b mut Vec<W>,
        row: impl Fn(&'b AxisTable, usize) -> &'b [W],
        make: impl Fn(f64, f64) -> W,
    ) -> (i32, &'b [W]) {
        let (_, p) = split(pos);
        let at = |profile: &Profile, i| make(weight(profile, self.wide, p, i), profile.spread);
        self.window_of(axis, pos, (lo, hi), buffer, row, at)
    }

    /// Weights along one axis from a table's row, or made by `make` from the profile and the pixel,
    /// which counts from the one that holds the centre.
    #[inline(always)]
    fn window_of<'b, W>(
        &'b self,
        axis: usize,
        pos: i64,
        (lo, hi): (i32, i32),
        buffer: &'b mut Vec<W>,
        row: impl Fn(&'b AxisTable, usize) -> &'b [W],
        make: impl Fn(&Profile, i64) -> W,
    ) -> (i32, &'b [W]) {
        let (first, end) = self.extent(axis, pos);
        let (from, to) = (first.max(lo), end.min(hi));
        if from >= to {
            return (lo, &[]);
        }
        let (base, p) = split(pos);
        match self.table {
            Some(t) => {
                let row = row(t.along(axis), p as usize);
                (from, &row[(from - first) as usize..(to - first) as usize])
            }
            None => {
                let profile = self.profiles[axis];
                buffer.clear();
                buffer.extend((from..to).map(|i| make(profile, i64::from(i) - base)));
                (from, &buffer[..])
            }
        }
    }
}
