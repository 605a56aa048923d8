//! Sifting: which voxels of a brick are wanted in a part, and all that drawing those takes.
//!
//! A flat view's voxels are placed by an addition, tested against the part's sheets and one bit of
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
use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS};
use slabcast_common::volume::Samples;

/// What is asked of the voxels of a brick.
pub(crate) struct Sieve<'a> {
    pub(crate) places: &'a Places,
    /// [What](Places::from) the places of the brick are counted from: the part's corner and the front of
    /// some sheet.
    pub(crate) from: FlatCorner,
    pub(crate) open: &'a OpenMask,
    /// Whether voxels around which nothing is open are left out.
    pub(crate) cull: bool,
    pub(crate) sections: &'a Sections,
    /// The first sheet of the slab and the one behind its last, counted from that sheet.
    pub(crate) sheets: [i32; 2],
    /// Where weights across and down lie.
    pub(crate) phases: [Phases; 2],
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
            windows: [[0; 512]; 4],
            ready: [Splat::default(); 512],
        }
    }
}

impl Tossing {
    /// The first `kept` voxels, with their first sheets.
    #[inline(always)]
    pub(crate) fn kept(&self, kept: usize) -> impl Iterator<Item = (&i32, &Splat)> {
        self.first[..kept].iter().zip(&self.ready[..kept])
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

impl Sieve<'_> {
    /// Sifts the voxels of `brick` into `tossing`.
    #[inline(always)]
    pub(crate) fn sift(&self, simd: Simd, brick: &Brick, tossing: &mut Tossing) -> Sifted {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { avx512::sift(self, brick, tossing) },
            _ => {
                let sifted = self.sift_plain(brick, tossing);
                self.make_ready(sifted.kept, tossing);
                sifted
            }
        }
    }

    /// Puts place, first sheet, cell, sample and normal of those that are kept beside each other.
    #[inline(always)]
    fn sift_plain(&self, brick: &Brick, tossing: &mut Tossing) -> Sifted {
        let Tossing { at, first, fate, cells, samples, normals, .. } = tossing;
        let n = brick.len().min(BRICK_VOXELS);
        self.places.all(self.from, &brick.index, at);
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
            (x[kept], y[kept], z[kept], first[kept]) = (x[i], y[i], z[i], first[i]);
            (cells[kept], samples[kept], normals[kept]) = (cells[i], samples[i], normals[i]);
            kept += usize::from(fate[i] >= wanted);
        }
        Sifted { reached, kept }
    }

    /// Packs the first `kept`.
    #[inline(always)]
    fn make_ready(&self, kept: usize, tossing: &mut Tossing) {
        let Tossing { at: [x, y, z], cells, samples, normals, windows, ready, .. } = tossing;
        let [x0, from_x, y0, from_y] = windows;
        move_inside(&self.phases[0], &x[..kept], x0, from_x);
        move_inside(&self.phases[1], &y[..kept], y0, from_y);
        let phases = self.sections.phases();
        for (j, ready) in ready[..kept].iter_mut().enumerate() {
            ready.place = x0[j] | y0[j] << 8 | cells[j] << 16;
            ready.rows = from_x[j] | from_y[j] << 16;
            ready.deep = (z[j] & (phases - 1)) as u32 | normals[j] << 16;
            ready.sample = samples[j];
        }
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
    use super::{Sieve, Sifted, Tossing};
    use crate::footprint::Phases;
    use crate::place::FINER_BITS;
    use crate::splat::by_column;
    use crate::tile::PART;
    use slabcast_common::brick::Brick;
    use slabcast_common::shade::NO_NORMAL;
    use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS};
    use slabcast_common::volume::Samples;
    use std::arch::x86_64::*;

    /// [`Sieve::sift_plain`].
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,popcnt")]
    pub(super) fn sift(sieve: &Sieve<'_>, brick: &Brick, tossing: &mut Tossing) -> Sifted {
        let sifted = match &brick.values {
            Samples::U8(v) => voxels(sieve, brick, v, tossing),
            Samples::U16(v) => voxels(sieve, brick, v, tossing),
            Samples::F32(v) => voxels(sieve, brick, v, tossing),
        };
        make_ready(sieve, sifted.kept, tossing);
        sifted
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

    /// [`Sieve::make_ready`].
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn make_ready(sieve: &Sieve<'_>, kept: usize, tossing: &mut Tossing) {
        let Tossing { at: [x, y, z], cells, samples, normals, ready, .. } = tossing;
        let phase = _mm512_set1_epi32(sieve.sections.phases() - 1);
        for i in (0..kept).step_by(16) {
            let ready = ready[i..].first_chunk_mut::<16>().expect("sixteen of 512");
            let at = |items: *const u32| {
                // SAFETY: the chunk above shows that sixteen of 512 begin here.
                unsafe { _mm512_loadu_si512(items.add(i).cast()) }
            };
            let (x0, from_x) = move_inside(&sieve.phases[0], at(x.as_ptr().cast()));
            let (y0, from_y) = move_inside(&sieve.phases[1], at(y.as_ptr().cast()));
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
    fn voxels<T: Wide>(
        sieve: &Sieve<'_>,
        brick: &Brick,
        values: &[T],
        tossing: &mut Tossing,
    ) -> Sifted {
        let Sieve { places, from, open, cull, sections, sheets, .. } = sieve;
        let Tossing { at: [x_to, y_to, z_to], first: first_to, cells: cells_to, .. } = tossing;
        let Tossing { samples: samples_to, normals: normals_to, .. } = tossing;
        let [x, y, z] = *from;
        let from = [_mm512_set1_epi64(x), _mm512_set1_epi64(y), _mm512_set1_epi64(z)];
        // Bits 24 to 55 of sixteen sums, the lower halves of what is left of them.
        let lower = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
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
                let mut at = [zero; 3];
                for (axis, at) in at.iter_mut().enumerate() {
                    let offsets = places.offsets()[axis][local..].first_chunk::<16>();
                    let offsets: *const i64 = offsets.expect("sixteen of a brick").as_ptr();
                    // SAFETY: sixteen offsets are 128 bytes.
                    let (low, high) = unsafe {
                        (
                            _mm512_loadu_si512(offsets.cast()),
                            _mm512_loadu_si512(offsets.add(8).cast()),
                        )
                    };
                    let low = _mm512_srli_epi64::<FINER_BITS>(_mm512_add_epi64(from[axis], low));
                    let high = _mm512_srli_epi64::<FINER_BITS>(_mm512_add_epi64(from[axis], high));
                    *at = _mm512_permutex2var_epi32(low, lower, high);
                }
                let [x, y, z] = at;
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
                put(x_to.as_mut_ptr().cast(), x);
                put(y_to.as_mut_ptr().cast(), y);
                put(z_to.as_mut_ptr().cast(), z);
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
    use slabcast_common::view::{Camera, CameraProjection, View};
    use slabcast_common::volume::Volume;
    use std::sync::Arc;

    /// A picture of 64x64 of 16x16x16 voxels, seen from anywhere in parallel.
    fn frame(to_eye: DVec3, height: f64, thickness: f64) -> Frame {
        let volume = Volume::from_fn_u8("any", [16; 3], |i, j, k| (i + 3 * j + 7 * k) as u8);
        let quality = Quality { thickness, ..Quality::default() };
        let spec = selftest::spec(&volume, quality);
        let projection = CameraProjection::Ortho { height };
        let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection };
        let view = View::new(&volume.lattice, &camera, [64; 2], &quality).expect("a view");
        Frame::new(Arc::new(Scene::new(&spec)), view)
    }

    proptest! {
        #[test]
        fn every_instruction_set_sifts_the_same(
            eye in prop::array::uniform3(0.1..1.0f64), height in 6.0..60.0f64,
            thickness in prop::sample::select(vec![0.5, 1.0, 2.0]),
            which in 0..8u32, share in 0.0..1.0f64, seed in any::<u64>(),
            kind in 0..3u8, shaded in any::<bool>(), cull in any::<bool>(),
            open in prop::collection::vec((0..64usize, 0..64u32), 0..40),
            begin in -16..16i32, count in 0..24i32,
        ) {
            let frame = frame(DVec3::from_array(eye), height, thickness);
            let Some(flat) = &frame.flat else { return Ok(()) };
            let hash = |i: u16| (seed ^ u64::from(i)).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
            let there = |i: &u16| (hash(*i) as f64) < share * 4_294_967_296.0;
            let index: Vec<u16> = (0..512).filter(there).collect();
            let values = match kind {
                0 => Samples::U8(index.iter().map(|&i| hash(i) as u8).collect()),
                1 => Samples::U16(index.iter().map(|&i| hash(i) as u16).collect()),
                _ => Samples::F32(index.iter().map(|&i| hash(i) as f32).collect()),
            };
            let normals = shaded.then(|| index.iter().map(|&i| hash(i + 600) as u16).collect());
            let brick = Brick::new(BrickId(which), index, values, normals);
            let mut mask = OpenMask::shut(Rect::new(0, 0, 64, 64));
            open.iter().for_each(|&(y, x)| mask.open_row(y, 1 << x));
            mask.grow(flat.reach);
            let footprint = frame.footprints.at(0).expect("sheets that are all drawn");
            let sieve = Sieve {
                places: &flat.places,
                from: Places::from(frame.corner(brick.id).flat, [0; 3]),
                open: &mask,
                cull,
                sections: &frame.sections,
                sheets: [begin, begin + count],
                phases: [0, 1].map(|axis| footprint.phases(axis).expect("a table")),
            };
            let sift = |simd| {
                let mut tossing = Tossing::default();
                let sifted = sieve.sift(simd, &brick, &mut tossing);
                let voxel = |(first, v): (&i32, &Splat)| (*first, v.place, v.rows, v.deep, v.sample);
                (sifted, tossing.kept(sifted.kept).map(voxel).collect::<Vec<_>>())
            };
            let want = sift(Simd::plain());
            prop_assert!(want.0.kept <= want.0.reached && want.0.reached <= brick.len());
            for simd in Simd::all() {
                prop_assert_eq!(&sift(simd), &want, "{}", simd.name());
            }
        }
    }
}
