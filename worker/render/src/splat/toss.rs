//! Sifting: which voxels of a brick are wanted in a part, and all that drawing those takes.
//!
//! Voxels are placed, in a flat view by an addition, tested against the part's sheets and one bit of
//! its mask, and those that are left put beside each other. With AVX-512 that is done for sixteen local
//! indices at a time, present or not, and what is not wanted never gets out of the registers;
//! elsewhere in loops over plain arrays, one for each step.

use super::records::Splat;
use super::{Level, Simd};
use crate::footprint::{Phases, Sections};
use crate::mask::OpenMask;
use crate::place::{FlatCorner, Places};
use crate::tile::PART;
use slabcast_common::brick::{BRICK_VOXELS, Brick};
use slabcast_common::shade::NO_NORMAL;
use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS, View, round_i32};
use slabcast_common::volume::Samples;

/// Where the voxels of a brick are: x and y in subpixels from the part's corner, depth in phases.
pub(crate) trait Placing {
    /// Whether what is kept are places; local indices, if not.
    const KEPT: bool;
    /// The places of voxels with these local indices.
    fn all(&self, index: &[u16], at: &mut [[i32; 512]; 3]);
    /// The same of sixteen from `local` on.
    ///
    /// # Safety
    /// For machines with AVX-512.
    #[cfg(target_arch = "x86_64")]
    unsafe fn sixteen(&self, local: usize) -> [std::arch::x86_64::__m512i; 3];
}

/// In a flat view, from the part's corner and the front of some sheet.
pub(crate) struct FlatBrick<'a> {
    pub(crate) places: &'a Places,
    /// [What](Places::from) the places of the brick are counted from.
    pub(crate) from: FlatCorner,
}

/// In perspective, at the voxels' own depths.
pub(crate) struct DeepBrick<'a> {
    pub(crate) view: &'a View,
    /// Eye offsets of a brick's voxels by axis, and its corner.
    pub(crate) offsets: &'a [[f64; 512]; 3],
    pub(crate) corner: [f64; 3],
    /// Subpixels a vox at depth 1, and the distance of depth 0.
    pub(crate) per_depth: f64,
    pub(crate) distance: f64,
    /// The middle of the picture, in subpixels from the part's corner.
    pub(crate) middle: [f64; 2],
}

/// Places are tests, not pixels: far ones may be anything that is far.
const FAR: f64 = 1e6;

impl Placing for FlatBrick<'_> {
    const KEPT: bool = true;

    #[inline(always)]
    fn all(&self, index: &[u16], at: &mut [[i32; 512]; 3]) {
        self.places.all(self.from, index, at);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn sixteen(&self, local: usize) -> [std::arch::x86_64::__m512i; 3] {
        avx512::flat(self, local)
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

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn sixteen(&self, local: usize) -> [std::arch::x86_64::__m512i; 3] {
        avx512::deep(self, local)
    }
}

impl DeepBrick<'_> {
    /// Eye coordinates of a voxel of the brick.
    #[inline(always)]
    pub(crate) fn eye(&self, local: u16) -> [f64; 3] {
        let [x, y, z] = self.offsets;
        let local = usize::from(local) % 512;
        [self.corner[0] + x[local], self.corner[1] + y[local], self.corner[2] + z[local]]
    }
}

/// What is asked of the voxels of a brick.
pub(crate) struct Sieve<'a, P> {
    pub(crate) places: P,
    pub(crate) open: &'a OpenMask,
    /// Whether voxels around which nothing is open are left out.
    pub(crate) cull: bool,
    pub(crate) sections: &'a Sections,
    /// The first sheet of the slab and the one behind its last, counted from where depths are.
    pub(crate) sheets: [i32; 2],
}

/// How many voxels of a brick
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Sifted {
    /// may touch the part in the slab's sheets,
    pub(crate) reached: usize,
    /// and were kept.
    pub(crate) kept: usize,
}

/// Voxels of a brick on their way to buckets.
pub(crate) struct Tossing {
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
pub(crate) struct Kept {
    /// Its first sheet.
    pub(crate) first: i32,
    pub(crate) local: u16,
    /// The pixel of the part that is nearest to its centre.
    pub(crate) cell: u16,
    pub(crate) normal: u16,
    pub(crate) sample: u32,
}

impl Tossing {
    /// The first `kept` voxels of a flat view, with their first sheets.
    #[inline(always)]
    pub(crate) fn ready(&self, kept: usize) -> impl Iterator<Item = (&i32, &Splat)> {
        self.first[..kept].iter().zip(&self.ready[..kept])
    }

    /// The first `kept` voxels in perspective.
    #[inline(always)]
    pub(crate) fn kept(&self, kept: usize) -> impl Iterator<Item = Kept> {
        (0..kept).map(|i| Kept {
            first: self.first[i],
            local: self.locals[i] as u16,
            cell: self.cells[i] as u16,
            normal: self.normals[i] as u16,
            sample: self.samples[i],
        })
    }
}

/// Has the memory of a brick that is sifted next come nearer: samples and normals of most bricks were
/// last looked at a frame ago.
#[inline(always)]
pub(crate) fn prefetch(brick: &Brick) {
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
pub(crate) fn any_in_rows(
    simd: Simd,
    rows: &[u64; 64],
    [begin, end]: [usize; 2],
    columns: u64,
) -> bool {
    match simd.0 {
        // SAFETY: the value proves that the instructions are there.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::any_in_rows(rows, [begin, end], columns) },
        _ => rows[begin..end].iter().fold(0, |all, row| all | row) & columns != 0,
    }
}

impl<P: Placing> Sieve<'_, P> {
    /// Sifts the voxels of `brick` into `tossing`.
    #[inline(always)]
    pub(crate) fn sift(&self, simd: Simd, brick: &Brick, tossing: &mut Tossing) -> Sifted {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { avx512::sift(self, brick, tossing) },
            _ => self.sift_plain(brick, tossing),
        }
    }

    /// Puts place or local index, first sheet, cell, sample and normal of those that are kept beside each
    /// other.
    #[inline(always)]
    fn sift_plain(&self, brick: &Brick, tossing: &mut Tossing) -> Sifted {
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
        brick.values.bits(samples);
        match &brick.normals {
            Some(of) => normals.iter_mut().zip(of).for_each(|(to, &of)| *to = of.into()),
            None => normals[..n].fill(NO_NORMAL.into()),
        }
        // From the front on, nothing is overwritten that is still to be moved.
        let mut kept = 0;
        for i in 0..n {
            if P::KEPT {
                (x[kept], y[kept], z[kept]) = (x[i], y[i], z[i]);
            } else {
                locals[kept] = brick.index[i].into();
            }
            first[kept] = first[i];
            (cells[kept], samples[kept], normals[kept]) = (cells[i], samples[i], normals[i]);
            kept += usize::from(fate[i] >= wanted);
        }
        Sifted { reached, kept }
    }
}

impl Sieve<'_, FlatBrick<'_>> {
    /// Sifts the voxels of `brick`, and packs those that are kept. `phases`: where weights across and down
    /// lie.
    #[inline(always)]
    pub(crate) fn sift_ready(
        &self,
        simd: Simd,
        brick: &Brick,
        phases: &[Phases; 2],
        tossing: &mut Tossing,
    ) -> Sifted {
        let sifted = self.sift(simd, brick, tossing);
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                avx512::make_ready(self.sections, phases, sifted.kept, tossing);
            },
            _ => make_ready(self.sections, phases, sifted.kept, tossing),
        }
        sifted
    }
}

/// Packs the first `kept`.
#[inline(always)]
fn make_ready(sections: &Sections, across: &[Phases; 2], kept: usize, tossing: &mut Tossing) {
    let Tossing { at: [x, y, z], cells, samples, normals, windows, ready, .. } = tossing;
    let [x0, from_x, y0, from_y] = windows;
    move_inside(&across[0], &x[..kept], x0, from_x);
    move_inside(&across[1], &y[..kept], y0, from_y);
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

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use super::{DeepBrick, FAR, FlatBrick, Placing, Sieve, Sifted, Tossing};
    use crate::footprint::{Phases, Sections};
    use crate::place::FINER_BITS;
    use crate::splat::by_column;
    use crate::tile::PART;
    use slabcast_common::brick::Brick;
    use slabcast_common::shade::NO_NORMAL;
    use slabcast_common::view::{MAGIC, SUBPIXEL_BITS, SUBPIXELS};
    use slabcast_common::volume::Samples;
    use std::arch::x86_64::*;

    /// [`Sieve::sift_plain`].
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,popcnt")]
    pub(super) fn sift<P: Placing>(
        sieve: &Sieve<'_, P>,
        brick: &Brick,
        tossing: &mut Tossing,
    ) -> Sifted {
        match &brick.values {
            Samples::U8(v) => voxels(sieve, brick, v, tossing),
            Samples::U16(v) => voxels(sieve, brick, v, tossing),
            Samples::F32(v) => voxels(sieve, brick, v, tossing),
        }
    }

    /// Sixteen numbers of a brick from the `local`th on.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn sixteen(of: &[i64; 512], local: usize) -> [__m512i; 2] {
        let at = of[local..].first_chunk::<16>().expect("sixteen of a brick").as_ptr();
        // SAFETY: sixteen numbers are 128 bytes.
        unsafe { [_mm512_loadu_si512(at.cast()), _mm512_loadu_si512(at.add(8).cast())] }
    }

    /// Places in a flat view.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(super) fn flat(places: &FlatBrick<'_>, local: usize) -> [__m512i; 3] {
        // Bits 24 to 55 of sixteen sums, the lower halves of what is left of them.
        let lower = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
        let mut at = [_mm512_setzero_si512(); 3];
        for (axis, at) in at.iter_mut().enumerate() {
            let from = _mm512_set1_epi64(places.from[axis]);
            let [low, high] = sixteen(&places.places.offsets()[axis], local);
            let low = _mm512_srli_epi64::<FINER_BITS>(_mm512_add_epi64(from, low));
            let high = _mm512_srli_epi64::<FINER_BITS>(_mm512_add_epi64(from, high));
            *at = _mm512_permutex2var_epi32(low, lower, high);
        }
        at
    }

    /// [`slabcast_common::view::round_i32`] of sixteen numbers.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn round(both: [__m512d; 2]) -> __m512i {
        let lower = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
        let magic = _mm512_set1_pd(MAGIC);
        let [low, high] = both;
        let low = _mm512_castpd_si512(_mm512_add_pd(low, magic));
        let high = _mm512_castpd_si512(_mm512_add_pd(high, magic));
        _mm512_permutex2var_epi32(low, lower, high)
    }

    /// Places in perspective.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(super) fn deep(places: &DeepBrick<'_>, local: usize) -> [__m512i; 3] {
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

    /// [`super::move_inside`] for sixteen voxels: first pixels, and where weights begin.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn move_inside(phases: &Phases, at: __m512i) -> (__m512i, __m512i) {
        let (near, more_from, len) = (phases.first(0), phases.more_from(), phases.len as i32);
        let phase = _mm512_and_si512(at, _mm512_set1_epi32(SUBPIXELS - 1));
        let first = _mm512_srai_epi32::<SUBPIXEL_BITS>(at);
        let first = _mm512_add_epi32(first, _mm512_set1_epi32(near));
        let more = _mm512_cmpge_epi32_mask(phase, _mm512_set1_epi32(more_from));
        let first = _mm512_mask_add_epi32(first, more, first, _mm512_set1_epi32(1));
        let moved = _mm512_max_epi32(first, _mm512_setzero_si512());
        let moved = _mm512_min_epi32(moved, _mm512_set1_epi32(PART - len));
        let by = _mm512_max_epi32(_mm512_sub_epi32(moved, first), _mm512_set1_epi32(-len));
        let by = _mm512_min_epi32(by, _mm512_set1_epi32(len));
        let (begin, stride) = (phases.begin(0) as i32, (phases.begin(1) - phases.begin(0)) as i32);
        let from = _mm512_mullo_epi32(phase, _mm512_set1_epi32(stride));
        let from = _mm512_add_epi32(from, _mm512_set1_epi32(begin));
        (moved, _mm512_add_epi32(from, by))
    }

    /// [`super::make_ready`].
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(super) fn make_ready(
        sections: &Sections,
        across: &[Phases; 2],
        kept: usize,
        tossing: &mut Tossing,
    ) {
        let Tossing { at: [x, y, z], cells, samples, normals, ready, .. } = tossing;
        let phase = _mm512_set1_epi32(sections.phases() - 1);
        for i in (0..kept).step_by(16) {
            let ready = ready[i..].first_chunk_mut::<16>().expect("sixteen of 512");
            let at = |items: *const u32| {
                // SAFETY: the chunk above shows that sixteen of 512 begin here.
                unsafe { _mm512_loadu_si512(items.add(i).cast()) }
            };
            let (x0, from_x) = move_inside(&across[0], at(x.as_ptr().cast()));
            let (y0, from_y) = move_inside(&across[1], at(y.as_ptr().cast()));
            let place = _mm512_or_si512(x0, _mm512_slli_epi32::<8>(y0));
            let place = _mm512_or_si512(place, _mm512_slli_epi32::<16>(at(cells.as_ptr())));
            let rows = _mm512_or_si512(from_x, _mm512_slli_epi32::<16>(from_y));
            let normal = _mm512_slli_epi32::<16>(at(normals.as_ptr()));
            let deep = _mm512_or_si512(_mm512_and_si512(at(z.as_ptr().cast()), phase), normal);
            let sample = at(samples.as_ptr());
            let fours = by_column([place, rows, deep, sample]);
            for (to, four) in ready.as_chunks_mut::<4>().0.iter_mut().zip(fours) {
                // SAFETY: four voxels are 64 bytes, each four numbers.
                unsafe { _mm512_storeu_si512(to.as_mut_ptr().cast(), four) };
            }
        }
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

    /// What samples and normals are, widened to 32 bits.
    trait Wide: Copy {
        /// # Safety
        /// Those of sixteen from `at` that `mask` marks may be read.
        unsafe fn load(mask: u16, at: *const Self) -> __m512i;
    }

    impl Wide for u8 {
        #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
        #[inline]
        unsafe fn load(mask: u16, at: *const u8) -> __m512i {
            // SAFETY: see above; others are not read.
            _mm512_cvtepu8_epi32(unsafe { _mm_maskz_loadu_epi8(mask, at.cast()) })
        }
    }

    impl Wide for u16 {
        #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
        #[inline]
        unsafe fn load(mask: u16, at: *const u16) -> __m512i {
            // SAFETY: see above; others are not read.
            _mm512_cvtepu16_epi32(unsafe { _mm256_maskz_loadu_epi16(mask, at.cast()) })
        }
    }

    impl Wide for f32 {
        #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
        #[inline]
        unsafe fn load(mask: u16, at: *const f32) -> __m512i {
            // SAFETY: see above; others are not read.
            unsafe { _mm512_maskz_loadu_epi32(mask, at.cast()) }
        }
    }

    /// Sixteen of `items` at the lanes of `present`, from the `rank`th on.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,popcnt")]
    #[inline]
    fn spread<T: Wide>(items: &[T], rank: usize, present: u16) -> __m512i {
        let items = &items[rank..];
        let count = (present.count_ones() as usize).min(items.len());
        // SAFETY: so many there are.
        let items = unsafe { T::load(((1u32 << count) - 1) as u16, items.as_ptr()) };
        _mm512_maskz_expand_epi32(present, items)
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,popcnt")]
    #[inline]
    fn voxels<T: Wide, P: Placing>(
        sieve: &Sieve<'_, P>,
        brick: &Brick,
        values: &[T],
        tossing: &mut Tossing,
    ) -> Sifted {
        let Sieve { places, open, cull, sections, sheets } = sieve;
        let Tossing { at: [x_to, y_to, z_to], first: first_to, cells: cells_to, .. } = tossing;
        let Tossing { samples: samples_to, normals: normals_to, locals: locals_to, .. } = tossing;
        let lanes = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        let (grown, reach) = open.grown();
        let span = _mm512_set1_epi32(64 + 2 * reach);
        let reach = _mm512_set1_epi32(reach);
        let (zero, last) = (_mm512_setzero_si512(), _mm512_set1_epi32(63));
        let (front, back, shift) = sections.reach();
        let (front, back) = (_mm512_set1_epi32(front), _mm512_set1_epi32(back));
        let shift = _mm_cvtsi32_si128(shift as i32);
        let (begin, end) = (_mm512_set1_epi32(sheets[0]), _mm512_set1_epi32(sheets[1]));
        let (mut rank, mut reached, mut kept) = (0, 0, 0);
        for (group, present) in brick.present().iter().enumerate() {
            for part in 0..4 {
                let present = (present >> (16 * part)) as u16;
                if present == 0 {
                    continue;
                }
                let here = rank;
                rank += present.count_ones() as usize;
                let local = 64 * group + 16 * part;
                // SAFETY: these are the instructions.
                let [x, y, z] = unsafe { places.sixteen(local) };
                // In the slab's sheets, and near enough to the part.
                let first = _mm512_sra_epi32(_mm512_sub_epi32(z, front), shift);
                let behind = _mm512_sra_epi32(_mm512_add_epi32(z, back), shift);
                let near = _mm512_mask_cmplt_epi32_mask(present, first, end);
                let near = _mm512_mask_cmpge_epi32_mask(near, behind, begin);
                let px = _mm512_srai_epi32::<SUBPIXEL_BITS>(x);
                let py = _mm512_srai_epi32::<SUBPIXEL_BITS>(y);
                let near = _mm512_mask_cmplt_epu32_mask(near, _mm512_add_epi32(px, reach), span);
                let near = _mm512_mask_cmplt_epu32_mask(near, _mm512_add_epi32(py, reach), span);
                if near == 0 {
                    continue;
                }
                reached += near.count_ones() as usize;
                let px = _mm512_min_epi32(_mm512_max_epi32(px, zero), last);
                let py = _mm512_min_epi32(_mm512_max_epi32(py, zero), last);
                let cell = _mm512_or_si512(_mm512_slli_epi32::<6>(py), px);
                let mut mark = near;
                if *cull {
                    // The mask in words of 32 bits.
                    let word = _mm512_srli_epi32::<5>(cell);
                    // SAFETY: a cell is below 64 times 64, so its word is one of the 128 of the mask.
                    let words = unsafe {
                        _mm512_mask_i32gather_epi32::<4>(zero, near, word, grown.as_ptr().cast())
                    };
                    let bit = _mm512_and_si512(px, _mm512_set1_epi32(31));
                    let bits = _mm512_sllv_epi32(_mm512_set1_epi32(1), bit);
                    mark = _mm512_mask_test_epi32_mask(near, words, bits);
                    if mark == 0 {
                        continue;
                    }
                }
                let sample = spread(values, here, present);
                let normal = match &brick.normals {
                    Some(normals) => spread(normals, here, present),
                    None => _mm512_set1_epi32(NO_NORMAL.into()),
                };
                let put = |to: *mut u32, from: __m512i| {
                    // SAFETY: no more are kept than were gone through, so sixteen from there on are among
                    // the array's 512.
                    unsafe {
                        _mm512_storeu_si512(
                            to.add(kept).cast(),
                            _mm512_maskz_compress_epi32(mark, from),
                        );
                    }
                };
                if P::KEPT {
                    put(x_to.as_mut_ptr().cast(), x);
                    put(y_to.as_mut_ptr().cast(), y);
                    put(z_to.as_mut_ptr().cast(), z);
                } else {
                    let local = _mm512_add_epi32(lanes, _mm512_set1_epi32(local as i32));
                    put(locals_to.as_mut_ptr(), local);
                }
                put(first_to.as_mut_ptr().cast(), first);
                put(cells_to.as_mut_ptr(), cell);
                put(samples_to.as_mut_ptr(), sample);
                put(normals_to.as_mut_ptr(), normal);
                kept += mark.count_ones() as usize;
            }
        }
        Sifted { reached, kept }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Frame, Scene};
    use crate::selftest;
    use glam::DVec3;
    use proptest::prelude::*;
    use slabcast_common::ids::BrickId;
    use slabcast_common::occlusion::Rect;
    use slabcast_common::quality::Quality;
    use slabcast_common::view::{Camera, CameraProjection, Projection};
    use slabcast_common::volume::Volume;
    use std::sync::Arc;

    /// A picture of 64x64 of 16x16x16 voxels, seen from anywhere.
    fn frame(to_eye: DVec3, projection: CameraProjection, thickness: f64) -> Frame {
        let volume = Volume::from_fn_u8("any", [16; 3], |i, j, k| (i + 3 * j + 7 * k) as u8);
        let quality = Quality { thickness, ..Quality::default() };
        let spec = selftest::spec(&volume, quality);
        let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection };
        let view = View::new(&volume.lattice, &camera, [64; 2], &quality).expect("a view");
        Frame::new(Arc::new(Scene::new(&spec)), view)
    }

    /// A brick with some share of its voxels, chosen by `seed`, of one kind of samples.
    fn brick(which: u32, share: f64, seed: u64, kind: u8, shaded: bool) -> Brick {
        let hash = |i: u16| (seed ^ u64::from(i)).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
        let there = |i: &u16| (hash(*i) as f64) < share * 4_294_967_296.0;
        let index: Vec<u16> = (0..512).filter(there).collect();
        let values = match kind {
            0 => Samples::U8(index.iter().map(|&i| hash(i) as u8).collect()),
            1 => Samples::U16(index.iter().map(|&i| hash(i) as u16).collect()),
            _ => Samples::F32(index.iter().map(|&i| hash(i) as f32).collect()),
        };
        let normals = shaded.then(|| index.iter().map(|&i| hash(i + 600) as u16).collect());
        Brick::new(BrickId(which), index, values, normals)
    }

    proptest! {
        #[test]
        fn every_instruction_set_sifts_the_same(
            eye in prop::array::uniform3(0.1..1.0f64), height in 6.0..60.0f64,
            thickness in prop::sample::select(vec![0.5, 1.0, 2.0]),
            which in 0..8u32, share in 0.0..1.0f64, seed in any::<u64>(),
            kind in 0..3u8, shaded in any::<bool>(), cull in any::<bool>(),
            open in prop::collection::vec((0..64usize, 0..64u32), 0..40),
            begin in -16..16i32, count in 0..24i32, reach in 0..9i32,
        ) {
            let flat = CameraProjection::Ortho { height };
            let frame = frame(DVec3::from_array(eye), flat, thickness);
            let Some(flat) = &frame.flat else { return Ok(()) };
            let brick = brick(which, share, seed, kind, shaded);
            let mut mask = OpenMask::shut(Rect::new(0, 0, 64, 64));
            open.iter().for_each(|&(y, x)| mask.open_row(y, 1 << x));
            mask.grow(flat.reach);
            let footprint = frame.footprints.at(0).expect("sheets that are all drawn");
            let from = Places::from(frame.corner(brick.id).flat, [0; 3]);
            let sieve = Sieve {
                places: FlatBrick { places: &flat.places, from },
                open: &mask,
                cull,
                sections: &frame.sections,
                sheets: [begin, begin + count],
            };
            let phases = [0, 1].map(|axis| footprint.phases(axis).expect("a table"));
            let sift = |simd| {
                let mut tossing = Tossing::default();
                let sifted = sieve.sift_ready(simd, &brick, &phases, &mut tossing);
                let voxel = |(first, v): (&i32, &Splat)| (*first, v.place, v.rows, v.deep, v.sample);
                (sifted, tossing.ready(sifted.kept).map(voxel).collect::<Vec<_>>())
            };
            let want = sift(Simd::plain());
            prop_assert!(want.0.kept <= want.0.reached && want.0.reached <= brick.len());
            for simd in Simd::all() {
                prop_assert_eq!(&sift(simd), &want, "{}", simd.name());
            }
            // The same brick in perspective.
            let (fov, distance) = (30.0, 30.0 + height);
            let deep = CameraProjection::Persp { fov, distance };
            let frame = self::frame(DVec3::from_array(eye), deep, thickness);
            let Projection::Persp { focal, distance } = frame.view.projection else {
                unreachable!("a perspective view");
            };
            mask.grow(reach);
            let sieve = Sieve {
                places: DeepBrick {
                    view: &frame.view,
                    offsets: frame.offsets(),
                    corner: frame.corner(brick.id).eye.to_array(),
                    per_depth: focal * f64::from(SUBPIXELS),
                    distance,
                    middle: [32.0 * f64::from(SUBPIXELS); 2],
                },
                open: &mask,
                cull,
                sections: &frame.sections,
                sheets: [begin, begin + count],
            };
            let sift = |simd| {
                let mut tossing = Tossing::default();
                let sifted = sieve.sift(simd, &brick, &mut tossing);
                (sifted, tossing.kept(sifted.kept).collect::<Vec<_>>())
            };
            let want = sift(Simd::plain());
            for kept in &want.1 {
                let eye = DVec3::from_array(sieve.places.eye(kept.local));
                let depth = frame.view.depth_in_phases(eye.z);
                prop_assert_eq!(kept.first, frame.sections.first(depth));
                let scale = focal / (eye.z + distance);
                let [x, y] = [eye.x, eye.y].map(|v| (v * scale + 32.0).clamp(0.0, 63.9));
                let cell = [i32::from(kept.cell & 63), i32::from(kept.cell >> 6)];
                // A position is rounded to a subpixel, which may be the next pixel's first.
                let apart = [x, y].into_iter().zip(cell).map(|(at, c)| at - f64::from(c));
                prop_assert!(apart.into_iter().all(|d| (-0.01..1.01).contains(&d)));
            }
            for simd in Simd::all() {
                prop_assert_eq!(&sift(simd), &want, "{}", simd.name());
            }
        }

        #[test]
        fn rows_are_looked_through_as_one_by_one(
            set in prop::collection::vec((0..64usize, 0..64u32), 0..20),
            begin in 0..=64usize, end in 0..=64usize, columns in any::<u64>(), shift in 0..64u32,
        ) {
            let mut rows = [0; 64];
            set.iter().for_each(|&(y, x)| rows[y] |= 1u64 << x);
            let (begin, end) = (begin.min(end), end.max(begin));
            let columns = columns >> shift;
            let want = rows[begin..end].iter().any(|row| row & columns != 0);
            for simd in Simd::all() {
                prop_assert_eq!(any_in_rows(simd, &rows, [begin, end], columns), want);
            }
        }
    }
}
