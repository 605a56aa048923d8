//! The bucket toss (paper, section 3): which voxels of a brick may show in a part, with all that
//! drawing them takes.
//!
//! Voxels are positioned (in orthographic views by an addition), tested against the part's sheets
//! and one bit of its mask, and those that are left are packed. With AVX-512 that is done for
//! sixteen local indices at a time, present or not, in orthographic views with AVX2 for eight and
//! with NEON for four, and voxels that can't show never leave the registers; elsewhere in loops
//! over plain arrays, one a step, and the kept ones are packed in lanes.

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

/// Where the voxels of a brick are: x and y in subpixels from the part's corner, depth in phases.
pub trait Placing {
    /// Whether what is kept are places; local indices, if not.
    const KEPT: bool;
    /// The places of voxels with these local indices.
    fn all(&self, index: &[u16], at: &mut [[i32; 512]; 3]);
}

/// In a flat view, from the part's corner and the front of some sheet.
pub struct FlatBrick<'a> {
    pub places: &'a Places,
    /// [What](Places::from) the places of the brick are counted from.
    pub from: FlatCorner,
}

/// In perspective, at the voxels' own depths.
pub struct DeepBrick<'a> {
    pub view: &'a View,
    /// Eye offsets of a brick's voxels by axis, and its corner.
    pub offsets: &'a [[f64; 512]; 3],
    pub corner: [f64; 3],
    /// Subpixels a vox at depth 1, and the distance of depth 0.
    pub per_depth: f64,
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

/// What is asked of the voxels of a brick.
pub struct Sieve<'a, P> {
    pub places: P,
    pub open: &'a OpenMask,
    /// Whether voxels around which nothing is open are left out.
    pub cull: bool,
    pub sections: &'a Sections,
    /// The first sheet of the slab and the one behind its last, counted from where depths are.
    pub sheets: [i32; 2],
}

/// How many voxels of a brick
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sifted {
    /// may touch the part in the slab's sheets,
    pub reached: usize,
    /// and were kept.
    pub kept: usize,
}

/// Voxels of a brick on their way to buckets.
pub struct Tossing {
    /// Positions and depths.
    at: [[i32; 512]; 3],
    /// First sheets.
    first: [i32; 512],
    /// Whether they may touch the part or an open pixel, and near which: [`OpenMask::near_all`].
    fate: [u32; 512],
    cells: [u32; 512],
    samples: [u32; 512],
    normals: [u32; 512],
    locals: [u32; 512],
    /// First pixels of footprints, and where weights begin.
    windows: [[u32; 512]; 4],
    /// Those that are kept, ready for their buckets.
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
    /// Its first sheet.
    pub first: i32,
    pub local: u16,
    /// The pixel of the part that is nearest to its centre.
    pub cell: u16,
    pub(crate) normal: u16,
    pub(crate) sample: u32,
}

/// How the voxels of a flat view that are kept are packed.
#[derive(Clone, Copy)]
pub enum Packing<'a> {
    /// With a window of the part and where weights across and down lie.
    Window(&'a [Phases; 2]),
    /// With their places.
    Aside,
    /// With their tier and a [place](Shape::place) in it, and where weights across lie.
    Tier(&'a Phases, Shape, &'a TierOf),
}

/// Which tier a voxel belongs to by where it lies down the part: `(y - base) * per`, in units of
/// [`TIER_BITS`], rounded to nearest.
#[derive(Clone, Copy, Debug)]
pub struct TierOf {
    pub base: i32,
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

#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod wide {
    use super::{FlatBrick, Packing, Placing, Shape, Sieve, Sifted, TIER_BITS, TierOf, Tossing};
    #[cfg(target_arch = "aarch64")]
    use crate::kernels::lanes::Four;
    use crate::kernels::lanes::Lanes;
    #[cfg(target_arch = "x86_64")]
    use crate::kernels::lanes::{Eight, Sixteen};
    use crate::primitives::footprint::{Phases, Sections};
    use crate::primitives::positions::FINER_BITS;
    use crate::primitives::sizes::PART;
    use slabcast_common::brick::Brick;
    use slabcast_common::shade::NO_NORMAL;
    use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS};
    use slabcast_common::volume::Samples;

    /// What is compiled for an instruction set: every function that these call is inlined into
    /// them.
    macro_rules! compiled {
        ($name:ident, $features:literal, $lanes:ty) => {
            pub(super) mod $name {
                use super::*;

                /// [`Sieve::sift_plain`].
                #[target_feature(enable = $features)]
                pub(in super::super) fn sift<P: Placed<$lanes>>(
                    sieve: &Sieve<'_, P>,
                    brick: &Brick,
                    tossing: &mut Tossing,
                ) -> Sifted {
                    // SAFETY: these are the instructions.
                    unsafe {
                        match &brick.values {
                            Samples::U8(v) => voxels::<$lanes, _, _>(sieve, brick, v, tossing),
                            Samples::U16(v) => voxels::<$lanes, _, _>(sieve, brick, v, tossing),
                            Samples::F32(v) => voxels::<$lanes, _, _>(sieve, brick, v, tossing),
                        }
                    }
                }

                /// [`super::super::make_ready`].
                #[target_feature(enable = $features)]
                pub(in super::super) fn make_ready(
                    sections: &Sections,
                    packing: Packing<'_>,
                    kept: usize,
                    tossing: &mut Tossing,
                ) {
                    // SAFETY: these are the instructions.
                    unsafe { super::make_ready::<$lanes>(sections, packing, kept, tossing) }
                }
            }
        };
    }

    #[cfg(target_arch = "aarch64")]
    compiled!(neon, "neon", Four);
    #[cfg(target_arch = "x86_64")]
    compiled!(avx2, "avx2,popcnt,lzcnt,bmi1,bmi2", Eight);
    #[cfg(target_arch = "x86_64")]
    compiled!(avx512, "avx512f,avx512vl,avx512dq,avx512bw,popcnt,lzcnt,bmi1,bmi2", Sixteen);

    /// [`super::keep`] with local indices; AVX-512 does that while it sifts.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,popcnt,lzcnt,bmi1,bmi2")]
    pub(super) fn keep_eight(tossing: &mut Tossing, n: usize, wanted: u32) -> usize {
        // SAFETY: these are the instructions.
        unsafe { keep::<Eight>(tossing, n, wanted) }
    }

    /// [`super::keep`] with local indices.
    #[cfg(target_arch = "aarch64")]
    #[target_feature(enable = "neon")]
    pub(super) fn keep_four(tossing: &mut Tossing, n: usize, wanted: u32) -> usize {
        // SAFETY: these are the instructions.
        unsafe { keep::<Four>(tossing, n, wanted) }
    }

    #[inline(always)]
    unsafe fn keep<L: Lanes>(tossing: &mut Tossing, n: usize, wanted: u32) -> usize {
        let Tossing { first, fate, cells, samples, normals, locals, .. } = tossing;
        let mut kept = 0;
        for from in (0..n.min(512)).step_by(L::LANES) {
            let there = (1u64 << (n - from).min(L::LANES)) as u32 - 1;
            // SAFETY: the caller's. Arrays have 512 numbers, a multiple of lanes; and as no more
            // are kept than were gone through, what is stored lies where these lanes lay or in
            // front.
            unsafe {
                let fate = L::load(fate.as_ptr().add(from));
                let mark = L::bits(L::less(L::set(wanted as i32 - 1), fate)) & there;
                let put = |of: *mut u32| {
                    let some = L::beside(mark, L::load(of.add(from)));
                    L::store(of.add(kept), some);
                };
                put(first.as_mut_ptr().cast());
                for of in [&mut *cells, samples, normals, locals] {
                    put(of.as_mut_ptr());
                }
                kept += mark.count_ones() as usize;
            }
        }
        kept
    }

    /// Places in lanes.
    pub(super) trait Placed<L: Lanes>: Placing {
        /// Those of voxels from `local` on.
        ///
        /// # Safety
        /// For machines with the instructions of `L`, as are all functions here.
        unsafe fn some(&self, local: usize) -> [L::Ints; 3];
    }

    impl<L: Lanes> Placed<L> for FlatBrick<'_> {
        #[inline(always)]
        unsafe fn some(&self, local: usize) -> [L::Ints; 3] {
            let [x, y, z] = self.places.offsets().each_ref();
            let at = [x, y, z].map(|of| of[local..local + L::LANES].as_ptr());
            let [x, y, z] = self.from;
            // SAFETY: so many there are.
            unsafe {
                [
                    L::bits_of_sums(x, at[0], FINER_BITS),
                    L::bits_of_sums(y, at[1], FINER_BITS),
                    L::bits_of_sums(z, at[2], FINER_BITS),
                ]
            }
        }
    }

    /// First pixels of footprints, and where weights begin.
    #[inline(always)]
    unsafe fn first<L: Lanes>(phases: &Phases, at: L::Ints) -> (L::Ints, L::Ints) {
        let (near, more_from) = (phases.first(0), phases.more_from());
        let (begin, stride) = (phases.begin(0) as i32, (phases.begin(1) - phases.begin(0)) as i32);
        // SAFETY: the caller's.
        unsafe {
            let phase = L::and(at, L::set(SUBPIXELS - 1));
            let first = L::plus(L::down(at, SUBPIXEL_BITS), L::set(near));
            let first = L::one_more(L::less(L::set(more_from - 1), phase), first);
            (first, L::plus(L::times(phase, L::set(stride)), L::set(begin)))
        }
    }

    /// [`super::move_inside`].
    #[inline(always)]
    unsafe fn move_inside<L: Lanes>(phases: &Phases, at: L::Ints) -> (L::Ints, L::Ints) {
        let len = phases.len as i32;
        // SAFETY: the caller's.
        unsafe {
            let (first, from) = first::<L>(phases, at);
            let moved = L::min(L::max(first, L::set(0)), L::set(PART - len));
            let by = L::min(L::max(L::minus(moved, first), L::set(-len)), L::set(len));
            (moved, L::plus(from, by))
        }
    }

    /// Places in tiers, and where weights begin.
    #[inline(always)]
    unsafe fn in_tier<L: Lanes>(phases: &Phases, shape: &Shape, at: L::Ints) -> (L::Ints, L::Ints) {
        let (none, last) = (shape.place(i32::MIN / 2), shape.place(i32::MAX / 2));
        // SAFETY: the caller's.
        unsafe {
            let (first, from) = first::<L>(phases, at);
            let place = L::plus(first, L::set(shape.margin as i32));
            (L::min(L::max(place, L::set(none as i32)), L::set(last as i32)), from)
        }
    }

    /// [`TierOf::at`].
    #[inline(always)]
    unsafe fn tier_at<L: Lanes>(tier: &TierOf, rows: usize, y: L::Ints) -> L::Ints {
        // SAFETY: the caller's.
        unsafe {
            let units = L::times(L::minus(y, L::set(tier.base)), L::set(tier.per));
            let at = L::down(L::plus(units, L::set(1 << (TIER_BITS - 1))), TIER_BITS);
            L::min(L::max(at, L::set(0)), L::set(rows as i32 - 1))
        }
    }

    #[inline(always)]
    unsafe fn make_ready<L: Lanes>(
        sections: &Sections,
        packing: Packing<'_>,
        kept: usize,
        tossing: &mut Tossing,
    ) {
        let Tossing { at: [x, y, z], cells, samples, normals, ready, .. } = tossing;
        for i in (0..kept).step_by(L::LANES) {
            // Of 512 each, as many begin here.
            let ready = &mut ready[i..i + L::LANES];
            // SAFETY: as the line above shows; a voxel that is ready is four numbers.
            unsafe {
                let (x, y) = (L::load(x.as_ptr().add(i).cast()), L::load(y.as_ptr().add(i).cast()));
                let [(x0, from_x), (y0, from_y)] = match packing {
                    Packing::Window([x_phases, y_phases]) => {
                        [move_inside::<L>(x_phases, x), move_inside::<L>(y_phases, y)]
                    }
                    Packing::Aside => [(L::set(0), L::and(x, L::set(0xffff))), (L::set(0), y)],
                    Packing::Tier(phases, shape, tier) => [
                        in_tier::<L>(phases, &shape, x),
                        (tier_at::<L>(tier, shape.rows, y), L::set(0)),
                    ],
                };
                let place = L::or(x0, L::up(y0, 8));
                let place = L::or(place, L::up(L::load(cells.as_ptr().add(i)), 16));
                let rows = L::or(from_x, L::up(from_y, 16));
                let z = L::load(z.as_ptr().add(i).cast());
                let normal = L::up(L::load(normals.as_ptr().add(i)), 16);
                let deep = L::or(L::and(z, L::set(sections.phases() - 1)), normal);
                let sample = L::load(samples.as_ptr().add(i));
                L::store_fours(ready.as_mut_ptr().cast(), [place, rows, deep, sample]);
            }
        }
    }

    /// What samples and normals are, widened to 32 bits.
    trait Wide: Sized {
        /// The first ones.
        unsafe fn load<L: Lanes>(items: &[Self]) -> L::Ints;
    }

    impl Wide for u8 {
        #[inline(always)]
        unsafe fn load<L: Lanes>(items: &[u8]) -> L::Ints {
            // SAFETY: the caller's.
            unsafe { L::bytes(items) }
        }
    }

    impl Wide for u16 {
        #[inline(always)]
        unsafe fn load<L: Lanes>(items: &[u16]) -> L::Ints {
            // SAFETY: the caller's.
            unsafe { L::shorts(items) }
        }
    }

    impl Wide for f32 {
        #[inline(always)]
        unsafe fn load<L: Lanes>(items: &[f32]) -> L::Ints {
            // SAFETY: the caller's.
            unsafe { L::floats(items) }
        }
    }

    #[inline(always)]
    unsafe fn voxels<L: Lanes, T: Wide, P: Placed<L>>(
        sieve: &Sieve<'_, P>,
        brick: &Brick,
        values: &[T],
        tossing: &mut Tossing,
    ) -> Sifted {
        let Sieve { places, open, cull, sections, sheets } = sieve;
        let Tossing { at: [x_to, y_to, z_to], first: first_to, cells: cells_to, .. } = tossing;
        let Tossing { samples: samples_to, normals: normals_to, locals: locals_to, .. } = tossing;
        let (grown, reach) = open.grown();
        let (front, back, shift) = sections.reach();
        let (mut rank, mut reached, mut kept) = (0, 0, 0);
        for (group, present) in brick.occupancy().iter().enumerate() {
            for part in 0..64 / L::LANES {
                let present = (present >> (L::LANES * part)) as u32 & ((1 << L::LANES) - 1);
                if present == 0 {
                    continue;
                }
                let here = rank;
                rank += present.count_ones() as usize;
                let local = 64 * group + L::LANES * part;
                // SAFETY: the caller's, and what is said below.
                let mark = unsafe {
                    let [x, y, z] = places.some(local);
                    // In the slab's sheets, and near enough to the part.
                    let first = L::down(L::minus(z, L::set(front)), shift);
                    let behind = L::down(L::plus(z, L::set(back)), shift);
                    let near = L::both(L::marks(present), L::less(first, L::set(sheets[1])));
                    let near = L::both(near, L::less(L::set(sheets[0] - 1), behind));
                    let [px, py] = [L::down(x, SUBPIXEL_BITS), L::down(y, SUBPIXEL_BITS)];
                    let [across, down] = reach.map(|reach| (L::set(reach), L::set(63 + 2 * reach)));
                    let near = L::both(near, L::at_most(L::plus(px, across.0), across.1));
                    let near = L::both(near, L::at_most(L::plus(py, down.0), down.1));
                    let mut mark = L::bits(near);
                    if mark == 0 {
                        continue;
                    }
                    reached += mark.count_ones() as usize;
                    let (zero, last) = (L::set(0), L::set(63));
                    let [px, py] = [L::min(L::max(px, zero), last), L::min(L::max(py, zero), last)];
                    let cell = L::or(L::up(py, 6), px);
                    if *cull {
                        // The mask in words of 32 bits; a cell is below 64 times 64, so its word is
                        // one of the mask's 128. The bit that is asked for goes where a sign is.
                        let words = L::look_up(near, grown.as_ptr().cast(), L::down(cell, 5));
                        let words = L::up_each(words, L::without(px, L::set(31)));
                        mark &= L::bits(L::less(words, zero));
                        if mark == 0 {
                            continue;
                        }
                    }
                    let sample = L::spread(present, T::load::<L>(&values[here..]));
                    let normal = match &brick.normals {
                        Some(normals) => L::spread(present, Wide::load::<L>(&normals[here..])),
                        None => L::set(NO_NORMAL.into()),
                    };
                    // No more are kept than were gone through, so as many lanes from there on are
                    // among an array's 512.
                    if P::KEPT {
                        L::store(x_to.as_mut_ptr().add(kept).cast(), L::beside(mark, x));
                        L::store(y_to.as_mut_ptr().add(kept).cast(), L::beside(mark, y));
                        L::store(z_to.as_mut_ptr().add(kept).cast(), L::beside(mark, z));
                    } else {
                        let local = L::beside(mark, L::from(local as i32));
                        L::store(locals_to.as_mut_ptr().add(kept), local);
                    }
                    L::store(first_to.as_mut_ptr().add(kept).cast(), L::beside(mark, first));
                    L::store(cells_to.as_mut_ptr().add(kept), L::beside(mark, cell));
                    L::store(samples_to.as_mut_ptr().add(kept), L::beside(mark, sample));
                    L::store(normals_to.as_mut_ptr().add(kept), L::beside(mark, normal));
                    mark
                };
                kept += mark.count_ones() as usize;
            }
        }
        Sifted { reached, kept }
    }
}

/// What eight lanes gain from.
#[cfg(target_arch = "x86_64")]
mod eight {
    use std::arch::x86_64::*;

    /// [`super::any_in_rows`].
    #[target_feature(enable = "avx2")]
    #[inline]
    pub(super) fn any_in_rows(rows: &[u64; 64], [begin, end]: [usize; 2], columns: u64) -> bool {
        let rows = &rows[begin..end];
        let mut any = _mm256_setzero_si256();
        for rows in rows.chunks(8) {
            let n = _mm256_set1_epi64x(rows.len() as i64);
            let halves = [_mm256_setr_epi64x(0, 1, 2, 3), _mm256_setr_epi64x(4, 5, 6, 7)];
            for (i, lanes) in halves.into_iter().enumerate() {
                let there = _mm256_cmpgt_epi64(n, lanes);
                let at: *const i64 = rows.as_ptr().cast();
                // SAFETY: lanes beyond the rows are not read.
                let some = unsafe { _mm256_maskload_epi64(at.wrapping_add(4 * i), there) };
                any = _mm256_or_si256(any, some);
            }
        }
        let columns = _mm256_set1_epi64x(columns as i64);
        _mm256_testz_si256(any, columns) == 0
    }
}

/// What only sixteen lanes gain from.
#[cfg(target_arch = "x86_64")]
mod sixteen {
    use super::wide::Placed;
    use super::{DeepBrick, FAR};
    use crate::kernels::lanes::Sixteen;
    use slabcast_common::view::ROUND_F64;
    use std::arch::x86_64::*;

    impl Placed<Sixteen> for DeepBrick<'_> {
        #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
        #[inline]
        unsafe fn some(&self, local: usize) -> [__m512i; 3] {
            deep(self, local)
        }
    }

    /// [`slabcast_common::view::round_i32`] of sixteen numbers.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn round(both: [__m512d; 2]) -> __m512i {
        let lower = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
        let magic = _mm512_set1_pd(ROUND_F64);
        let [low, high] = both;
        let low = _mm512_castpd_si512(_mm512_add_pd(low, magic));
        let high = _mm512_castpd_si512(_mm512_add_pd(high, magic));
        _mm512_permutex2var_epi32(low, lower, high)
    }

    /// Places in perspective.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn deep(places: &DeepBrick<'_>, local: usize) -> [__m512i; 3] {
        let mut eye = [[_mm512_setzero_pd(); 2]; 3];
        for (axis, eye) in eye.iter_mut().enumerate() {
            let at = places.offsets[axis][local..].first_chunk::<16>();
            let at = at.expect("sixteen of a brick").as_ptr();
            let corner = _mm512_set1_pd(places.corner[axis]);
            // SAFETY: sixteen numbers are 128 bytes.
            let both = unsafe { [_mm512_loadu_pd(at), _mm512_loadu_pd(at.add(8))] };
            *eye = [_mm512_add_pd(corner, both[0]), _mm512_add_pd(corner, both[1])];
        }
        let [x, y, z] = eye;
        let [mut across, mut down, mut deep] = [[_mm512_setzero_pd(); 2]; 3];
        for half in 0..2 {
            let depth = _mm512_add_pd(z[half], _mm512_set1_pd(places.distance));
            let scale = _mm512_div_pd(_mm512_set1_pd(places.per_depth), depth);
            for (to, (from, middle)) in
                [(&mut across, (x, places.middle[0])), (&mut down, (y, places.middle[1]))]
            {
                let at = _mm512_add_pd(_mm512_mul_pd(from[half], scale), _mm512_set1_pd(middle));
                let at = _mm512_max_pd(at, _mm512_set1_pd(-FAR));
                to[half] = _mm512_min_pd(at, _mm512_set1_pd(FAR));
            }
            // A division by one changes nothing and is slow.
            let thickness = places.view.thickness;
            deep[half] = z[half];
            if thickness != 1.0 {
                deep[half] = _mm512_div_pd(z[half], _mm512_set1_pd(thickness));
            }
            let phases = _mm512_set1_pd(f64::from(places.view.depth_phases()));
            deep[half] = _mm512_mul_pd(deep[half], phases);
        }
        [round(across), round(down), round(deep)]
    }

    /// [`super::any_in_rows`].
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(super) fn any_in_rows(rows: &[u64; 64], [begin, end]: [usize; 2], columns: u64) -> bool {
        let (rows, columns) = (&rows[begin..end], _mm512_set1_epi64(columns as i64));
        let mut any = 0;
        for rows in rows.chunks(8) {
            // SAFETY: lanes beyond the rows are not read.
            let rows =
                unsafe { _mm512_maskz_loadu_epi64(0xff >> (8 - rows.len()), rows.as_ptr().cast()) };
            any |= _mm512_test_epi64_mask(rows, columns);
        }
        any != 0
    }
}
