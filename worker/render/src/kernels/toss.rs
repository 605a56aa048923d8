//! The bucket toss (paper, section 3): which voxels of a brick may show in a part, with all that
//! drawing them takes.
//!
//! Voxels are positioned (in orthographic views by an addition), tested against the part's sheets
//! and one bit of its mask, and those that are left are packed. With AVX-512 that is done for
//! sixteen local indices at a time, present or not, in orthographic views with AVX2 for eight and
//! with NEON for four, and voxels that can't show never leave the registers; elsewhere in loops
//! over plain arrays, one a step, and the kept ones are packed in lanes.

#[cfg(target_arch = "x86_64")]
mod eight;
#[cfg(target_arch = "x86_64")]
mod sixteen;
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod wide;

use super::pixel_records::Splat;
use super::row_records::Shape;
use super::{Level, Simd};
use crate::primitives::footprint::{Phases, Sections};
use crate::primitives::positions::{FlatCorner, Places};
use crate::primitives::sizes::PART;
use crate::visibility::open_mask::OpenMask;
use slabcast_common::brick::{BRICK_VOXELS, Brick};
use slabcast_common::shade::NO_NORMAL;
use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS, View, round_i32};
use slabcast_common::volume::Samples;

/// Positions of a brick's voxels: x and y in subpixels from the part's corner, depth in phases.
pub trait Placing {
    /// Whether kept voxels carry their positions. If not, they carry their local indices.
    const KEPT: bool;
    /// Writes the positions of the voxels with these local indices (0 to 511) to `at`: x, y, depth.
    fn all(&self, index: &[u16], at: &mut [[i32; 512]; 3]);
}

/// A brick in an orthographic view: integer positions from the part's corner and a sheet's front.
pub struct FlatBrick<'a> {
    /// Integer positions of voxels in the view.
    pub places: &'a Places,
    /// Origin of the brick's positions, by [`Places::from`].
    pub from: FlatCorner,
}

/// A brick in a perspective view, each voxel at a depth of its own.
pub struct DeepBrick<'a> {
    /// Camera of the frame.
    pub view: &'a View,
    /// Offsets of the brick's 512 voxels from `corner` in eye space, by axis, in vox.
    pub offsets: &'a [[f64; 512]; 3],
    /// Eye coordinates of the brick's first voxel, in vox.
    pub corner: [f64; 3],
    /// Subpixels a vox at a distance of one vox from the eye.
    pub per_depth: f64,
    /// Distance from eye to target, in vox.
    pub distance: f64,
    /// The middle of the picture, in subpixels from the part's corner.
    pub middle: [f64; 2],
}

/// Places are tests, not pixels: far ones may be anything that is far.
const FAR: f64 = 1e6;

impl Placing for FlatBrick<'_> {
    const KEPT: bool = true;

    #[inline(always)]
    fn all(&self, index: &[u16], at: &mut [[i32; 512]; 3]) {
        self.places.all(self.from, index, at);
    }
}

impl Placing for DeepBrick<'_> {
    const KEPT: bool = false;

    #[inline(always)]
    fn all(&self, index: &[u16], at: &mut [[i32; 512]; 3]) {
        let [to_x, to_y, to_z] = at;
        for (i, &local) in index.iter().enumerate() {
            let [x, y, z] = self.eye(local);
            let scale = self.per_depth / (z + self.distance);
            to_x[i] = round_i32((x * scale + self.middle[0]).clamp(-FAR, FAR));
            to_y[i] = round_i32((y * scale + self.middle[1]).clamp(-FAR, FAR));
            to_z[i] = self.view.depth_in_phases(z);
        }
    }
}

impl DeepBrick<'_> {
    /// Eye coordinates of a voxel of the brick.
    #[inline(always)]
    pub fn eye(&self, local: u16) -> [f64; 3] {
        let [x, y, z] = self.offsets;
        let local = usize::from(local) % 512;
        [self.corner[0] + x[local], self.corner[1] + y[local], self.corner[2] + z[local]]
    }
}

/// Test that the voxels of a brick must pass.
pub struct Sieve<'a, P> {
    /// Positions of the voxels.
    pub places: P,
    /// Open pixels of the part.
    pub open: &'a OpenMask,
    /// Whether voxels around which nothing is open are left out.
    pub cull: bool,
    /// Sections of the kernel by depth phase.
    pub sections: &'a Sections,
    /// The first sheet of the slab and the one behind its last, counted from where depths are.
    pub sheets: [i32; 2],
}

/// Numbers of a brick's voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sifted {
    /// Voxels that may touch the part in the slab's sheets.
    pub reached: usize,
    /// Voxels of these that were kept.
    pub kept: usize,
}

/// Scratch memory of a toss: up to 512 voxels of a brick, one array a property.
pub struct Tossing {
    /// Positions x, y in subpixels from the part's corner, and depths in phases.
    at: [[i32; 512]; 3],
    /// Numbers of the voxels' first sheets.
    first: [i32; 512],
    /// Whether a voxel may touch the part or an open pixel ([`OpenMask::near_all`]).
    fate: [u32; 512],
    cells: [u32; 512],
    samples: [u32; 512],
    normals: [u32; 512],
    locals: [u32; 512],
    /// First pixels of footprints, and where weights begin.
    windows: [[u32; 512]; 4],
    /// Kept voxels, packed for their buckets.
    ready: [Splat; 512],
}

impl Default for Tossing {
    fn default() -> Self {
        Tossing {
            at: [[0; 512]; 3],
            first: [0; 512],
            fate: [0; 512],
            cells: [0; 512],
            samples: [0; 512],
            normals: [0; 512],
            locals: [0; 512],
            windows: [[0; 512]; 4],
            ready: [Splat::default(); 512],
        }
    }
}

/// A voxel that was kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kept {
    /// Number of the voxel's first sheet.
    pub first: i32,
    /// Index of the voxel in its brick, 0 to 511.
    pub local: u16,
    /// Index of the part's pixel nearest to the voxel's centre, row by row.
    pub cell: u16,
    pub(crate) normal: u16,
    pub(crate) sample: u32,
}

/// Layout of the kept voxels of an orthographic view.
#[derive(Clone, Copy)]
pub enum Packing<'a> {
    /// With a window of the part and where weights across and down lie.
    Window(&'a [Phases; 2]),
    /// With their places.
    Aside,
    /// With their tier and a [place](Shape::place) in it, and where weights across lie.
    Tier(&'a Phases, Shape, &'a TierOf),
}

/// Map from a voxel's position down the part to its tier: `(y - base) * per`, in units of
/// 2^-[`TIER_BITS`] tiers, rounded to nearest.
#[derive(Clone, Copy, Debug)]
pub struct TierOf {
    /// Position of tier 0, in subpixels from the part's first row.
    pub base: i32,
    /// Tiers a subpixel, in units of 2^-20.
    pub per: i32,
}

/// Tiers lie 192 subpixels apart and more ([`crate::primitives::lattice_rows`]), and voxels less
/// than 2^15 from the part's first row: so products stay below 2^28, and a thousandth of a tier is
/// told apart.
pub const TIER_BITS: u32 = 20;

impl TierOf {
    #[inline(always)]
    fn at(self, y: i32, rows: usize) -> u32 {
        let tier = ((y - self.base) * self.per + (1 << (TIER_BITS - 1))) >> TIER_BITS;
        tier.clamp(0, rows as i32 - 1) as u32
    }
}

impl Tossing {
    /// The first `kept` voxels of a flat view, with their first sheets.
    #[inline(always)]
    pub fn ready(&self, kept: usize) -> impl Iterator<Item = (&i32, &Splat)> {
        self.first[..kept].iter().zip(&self.ready[..kept])
    }

    /// The first `kept` voxels in perspective.
    #[inline(always)]
    pub fn kept(&self, kept: usize) -> impl Iterator<Item = Kept> {
        (0..kept).map(|i| Kept {
            first: self.first[i],
            local: self.locals[i] as u16,
            cell: self.cells[i] as u16,
            normal: self.normals[i] as u16,
            sample: self.samples[i],
        })
    }
}

/// Has the memory of a brick that is sifted next come nearer: samples and normals of most bricks
/// were last looked at a frame ago.
#[inline(always)]
pub fn prefetch(brick: &Brick) {
    let Brick { values, normals, .. } = brick;
    match values {
        Samples::U8(v) => prefetch_all(v),
        Samples::U16(v) => prefetch_all(v),
        Samples::F32(v) => prefetch_all(v),
    }
    if let Some(normals) = normals {
        prefetch_all(normals);
    }
}

#[inline(always)]
fn prefetch_all<T>(items: &[T]) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let at: *const i8 = items.as_ptr().cast();
        for line in (0..size_of_val(items)).step_by(64) {
            // SAFETY: baseline instructions, which never fault.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(at.wrapping_add(line)) };
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = items;
}

/// Whether rows from `begin` to the one before `end` have any bit of `columns`.
#[inline(always)]
pub fn any_in_rows(simd: Simd, rows: &[u64; 64], [begin, end]: [usize; 2], columns: u64) -> bool {
    match simd.0 {
        // SAFETY: the value proves that the instructions are there.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { sixteen::any_in_rows(rows, [begin, end], columns) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { eight::any_in_rows(rows, [begin, end], columns) },
        _ => rows[begin..end].iter().fold(0, |all, row| all | row) & columns != 0,
    }
}

impl<P: Placing> Sieve<'_, P> {
    /// Puts place or local index, first sheet, cell, sample and normal of those that are kept
    /// beside each other.
    #[inline(always)]
    fn sift_plain(&self, simd: Simd, brick: &Brick, tossing: &mut Tossing) -> Sifted {
        let Tossing { at, first, fate, cells, samples, normals, locals, .. } = tossing;
        let n = brick.len().min(BRICK_VOXELS);
        self.places.all(&brick.index[..n], at);
        let [x, y, z] = at;
        self.open.near_all(&x[..n], &y[..n], cells, fate);
        let [begin, end] = self.sheets;
        for i in 0..n {
            let (sheet, count) = self.sections.span(z[i]);
            first[i] = sheet;
            let here = u32::from(sheet < end) & u32::from(sheet + count as i32 > begin);
            fate[i] *= here;
        }
        let reached = fate[..n].iter().map(|&fate| usize::from(fate != 0)).sum();
        let wanted = if self.cull { 3 } else { 1 };
        brick.values.write_bits(samples);
        match &brick.normals {
            Some(of) => normals.iter_mut().zip(of).for_each(|(to, &of)| *to = of.into()),
            None => normals[..n].fill(NO_NORMAL.into()),
        }
        if !P::KEPT {
            locals.iter_mut().zip(&brick.index).for_each(|(to, &of)| *to = of.into());
        }
        let kept = keep(simd, tossing, n, wanted, P::KEPT);
        Sifted { reached, kept }
    }
}

/// Puts those of the first `n` whose fate is `wanted` or more beside each other, with places or
/// with local indices; says how many there are.
#[inline(always)]
fn keep(simd: Simd, tossing: &mut Tossing, n: usize, wanted: u32, places: bool) -> usize {
    let n = n.min(BRICK_VOXELS);
    match simd.0 {
        // SAFETY: the value proves that the instructions are there.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 if !places => unsafe { wide::keep_eight(tossing, n, wanted) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon if !places => unsafe { wide::keep_four(tossing, n, wanted) },
        _ => {
            let Tossing { at, first, fate, cells, samples, normals, locals, .. } = tossing;
            let [x, y, z] = at;
            // From the front on, nothing is overwritten that is still to be moved.
            let mut kept = 0;
            for i in 0..n {
                if places {
                    (x[kept], y[kept], z[kept]) = (x[i], y[i], z[i]);
                } else {
                    locals[kept] = locals[i];
                }
                first[kept] = first[i];
                (cells[kept], samples[kept], normals[kept]) = (cells[i], samples[i], normals[i]);
                kept += usize::from(fate[i] >= wanted);
            }
            kept
        }
    }
}

impl Sieve<'_, DeepBrick<'_>> {
    /// Sifts the voxels of `brick` into `tossing`.
    #[inline(always)]
    pub fn sift(&self, simd: Simd, brick: &Brick, tossing: &mut Tossing) -> Sifted {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { wide::avx512::sift(self, brick, tossing) },
            // Four divisions at a time are too few to place voxels that are not there, too; NEON
            // has two.
            _ => self.sift_plain(simd, brick, tossing),
        }
    }
}

impl Sieve<'_, FlatBrick<'_>> {
    /// Sifts the voxels of `brick` into `tossing`.
    #[inline(always)]
    fn sift(&self, simd: Simd, brick: &Brick, tossing: &mut Tossing) -> Sifted {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { wide::avx512::sift(self, brick, tossing) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { wide::avx2::sift(self, brick, tossing) },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Level::Neon => unsafe { wide::neon::sift(self, brick, tossing) },
            Level::Plain => self.sift_plain(simd, brick, tossing),
        }
    }

    /// Sifts the voxels of `brick`, and packs those that are kept.
    #[inline(always)]
    pub fn sift_ready(
        &self,
        simd: Simd,
        brick: &Brick,
        packing: Packing<'_>,
        tossing: &mut Tossing,
    ) -> Sifted {
        let sifted = self.sift(simd, brick, tossing);
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                wide::avx512::make_ready(self.sections, packing, sifted.kept, tossing);
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe {
                wide::avx2::make_ready(self.sections, packing, sifted.kept, tossing);
            },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Level::Neon => unsafe {
                wide::neon::make_ready(self.sections, packing, sifted.kept, tossing);
            },
            Level::Plain => make_ready(self.sections, packing, sifted.kept, tossing),
        }
        sifted
    }
}

/// Packs the first `kept`.
#[inline(always)]
fn make_ready(sections: &Sections, packing: Packing<'_>, kept: usize, tossing: &mut Tossing) {
    let Tossing { at: [x, y, z], cells, samples, normals, windows, ready, .. } = tossing;
    let [x0, from_x, y0, from_y] = windows;
    match packing {
        Packing::Window(across) => {
            move_inside(&across[0], &x[..kept], x0, from_x);
            move_inside(&across[1], &y[..kept], y0, from_y);
        }
        Packing::Aside => {
            for i in 0..kept {
                (x0[i], y0[i]) = (0, 0);
                (from_x[i], from_y[i]) = (x[i] as u32 & 0xffff, y[i] as u32);
            }
        }
        Packing::Tier(phases, shape, tier) => {
            for i in 0..kept {
                x0[i] = shape.place(phases.first_at(x[i]));
                from_x[i] = phases.begin((x[i] & (SUBPIXELS - 1)) as usize) as u32;
                (y0[i], from_y[i]) = (tier.at(y[i], shape.rows), 0);
            }
        }
    }
    let phases = sections.phases();
    for (j, ready) in ready[..kept].iter_mut().enumerate() {
        ready.place = x0[j] | y0[j] << 8 | cells[j] << 16;
        ready.rows = from_x[j] | from_y[j] << 16;
        ready.deep = (z[j] & (phases - 1)) as u32 | normals[j] << 16;
        ready.sample = samples[j];
    }
}

/// First pixels of the footprints of some voxels along an axis, moved inside the part, and where
/// their weights then begin: below 2^16, since rows of a padded table are at most three times 63
/// long.
#[inline(always)]
fn move_inside(phases: &Phases, at: &[i32], inside: &mut [u32; 512], from: &mut [u32; 512]) {
    let len = phases.len as i32;
    for ((&at, inside), from) in at.iter().zip(inside).zip(from) {
        let (pixel, phase) = (at >> SUBPIXEL_BITS, at & (SUBPIXELS - 1));
        let first = pixel + phases.first(phase);
        let moved = first.clamp(0, PART - len);
        *inside = moved as u32;
        // Moved farther than a footprint is long, it reads zeros only.
        let begin = phases.begin(phase as usize) as i32;
        *from = (begin + (moved - first).clamp(-len, len)) as u32;
    }
}
