//! Voxels whose sections are stacked: they have the same columns, and lie above each other in the picture.
//!
//! So it is where the odd axis of a lattice stands upright, as CT is looked at. How far a section lies from its voxel
//! hangs on the phase of the voxel's depth alone ([`Leaning`](crate::footprint::Leaning)). Thus where the rows of its
//! sections lie, and what they weigh, is found when the voxel is added, of all eight in a register; nothing is kept by
//! voxel and sheet, as it is of sections that lie anywhere ([`super::apart`]). That is written for AVX-512; elsewhere
//! these are voxels like any others.

use super::Recorded;
use super::apart::LINE;
use crate::footprint::Phases;
#[cfg(target_arch = "x86_64")]
use crate::splat::Level;
use crate::splat::Simd;

/// Rows that all sections of a voxel have together, at most, and zeros that tables have around a phase's weights, at
/// least. A lattice of slices twice as thick as its pixels, seen at two pixels a voxel from 30 degrees above, has some 20.
pub(crate) const ROWS: usize = 32;

/// Columns at most: weights of them are looked at as one register.
pub(crate) const COLUMNS: usize = LINE;

/// Where the rows of stacked sections lie.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stacked<'a> {
    /// [`Leaning::subpixels`](crate::footprint::Leaning::subpixels) down the picture.
    pub(crate) subpixels: &'a [i32],
    /// Where weights down lie.
    pub(crate) down: Phases,
}

/// Whether these are added in lanes, so that where they lie in each sheet need not be known.
#[inline(always)]
pub(crate) fn in_lanes<S: Recorded>(simd: Simd) -> bool {
    #[cfg(target_arch = "x86_64")]
    let are_there = simd.0 == Level::Avx512;
    #[cfg(not(target_arch = "x86_64"))]
    let are_there = {
        let _ = simd;
        false
    };
    are_there && S::STACKED
}

#[cfg(target_arch = "x86_64")]
pub(super) mod avx512 {
    use super::{COLUMNS, ROWS, Stacked};
    use crate::splat::Tap;
    use crate::splat::records::apart::lines::inside;
    use crate::splat::records::apart::{Apart, BATCH, Layers};
    use crate::splat::records::short::avx512::{add_row, load, words};
    use crate::splat::records::{MOST, Record, Recorded, STRIDE};
    use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS};
    use std::arch::x86_64::*;

    /// Rows that are looked up at once.
    const BLOCK: usize = 8;

    /// What is added, where and by which weights.
    type At<'a, S, const N: usize> = (
        &'a mut [Record<S, N>],
        (&'a Apart, &'a [<S as Recorded>::Payload]),
        &'a Layers<'a, S, N>,
        Stacked<'a>,
    );

    /// Calls a function for footprints of `wide` columns, or of a few more.
    macro_rules! by_columns {
        ($stacked:ident[$n:ident], $at:expr) => {
            match $at.2.across[0][$at.2.slot].len {
                0..=4 => $stacked::<4, $n>($at),
                5 => $stacked::<5, $n>($at),
                6 => $stacked::<6, $n>($at),
                7 | 8 => $stacked::<8, $n>($at),
                9 | 10 => $stacked::<10, $n>($at),
                11 | 12 => $stacked::<12, $n>($at),
                _ => $stacked::<16, $n>($at),
            }
        };
    }

    /// The table down, in which every phase's weights have [`ROWS`] zeros before and behind them.
    fn weights_down<'a, S: Recorded, const N: usize>(
        layers: &Layers<'a, S, N>,
        Stacked { down, .. }: &Stacked<'_>,
    ) -> &'a [S::Weight] {
        assert_eq!(N, MOST, "records of eight sheets");
        let weights = layers.across[1][layers.slot].weights;
        assert!(down.begin(0) >= ROWS && layers.across[0][layers.slot].len <= COLUMNS);
        assert!(weights.len() >= down.begin(SUBPIXELS as usize - 1) + down.len + ROWS);
        weights
    }

    /// Where in [that table](weights_down) the weights of a voxel begin for a window's rows from `lo` on, by slot;
    /// `place`: where it is itself; `deep`: where its sections begin in the table of what they are aside. [`ROWS`]
    /// weights can be read from each, and what is none of the section's is zero.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn begins(
        Stacked { subpixels, down }: &Stacked<'_>,
        (place, deep, lo): (i32, u32, i32),
        turn: __m256i,
    ) -> [u32; MOST] {
        let all = |n: i32| _mm256_set1_epi32(n);
        let aside: &[i32; MOST] =
            subpixels[deep as usize..].first_chunk().expect("a voxel's sheets");
        // SAFETY: eight numbers are 32 bytes.
        let aside = unsafe { _mm256_loadu_si256(aside.as_ptr().cast()) };
        let places = _mm256_add_epi32(all(place), aside);
        let phase = _mm256_and_si256(places, all(SUBPIXELS - 1));
        let pixel = _mm256_srai_epi32::<{ SUBPIXEL_BITS as i32 }>(places);
        let first = _mm256_add_epi32(pixel, all(down.first(0)));
        let more = _mm256_cmpge_epi32_mask(phase, all(down.more_from()));
        let first = _mm256_mask_add_epi32(first, more, first, all(1));
        // A section that is none of the window's may be as far off as zeros reach.
        let row = _mm256_sub_epi32(first, all(lo));
        let row = _mm256_max_epi32(row, all(-(down.len as i32)));
        let row = _mm256_min_epi32(row, all(ROWS as i32));
        let begin = _mm256_mullo_epi32(phase, all((down.begin(1) - down.begin(0)) as i32));
        let begin = _mm256_add_epi32(begin, all(down.begin(0) as i32));
        let begin = _mm256_permutexvar_epi32(turn, _mm256_sub_epi32(begin, row));
        let mut begins = [0; MOST];
        // SAFETY: as above.
        unsafe { _mm256_storeu_si256(begins.as_mut_ptr().cast(), begin) };
        begins
    }

    /// Which sheet behind the first a slot has, by slot.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn turn(slot: usize) -> __m256i {
        let slots = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
        let after = _mm256_sub_epi32(slots, _mm256_set1_epi32(slot as i32));
        _mm256_and_si256(after, _mm256_set1_epi32(MOST as i32 - 1))
    }

    /// Which of a window's first columns a footprint has that begins in column `column`, a bit each.
    #[inline(always)]
    fn present(len: usize, column: i32) -> u32 {
        let bits = ((1u64 << len) - 1) << COLUMNS;
        (bits << (column + COLUMNS as i32).clamp(0, 2 * COLUMNS as i32) >> (2 * COLUMNS)) as u32
    }

    /// A voxel that is added.
    struct Voxel<'a, S: Recorded> {
        /// First column and row, and how many rows.
        at: [usize; 2],
        high: usize,
        /// Weights in depth, from its first sheet on.
        deep: &'a [S::Depth],
        /// Which of the columns from the first on it has, a bit each, and where the first one's weight would lie.
        across: (u32, *const S::Weight),
        /// [`begins`].
        begins: [u32; MOST],
    }

    /// Voxel `i`, in a window of `WIDE` columns, a function for each width, so that it is compiled into the one that calls it;
    /// `turn`: see [`turn`].
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn voxel<'a, S: Recorded, const WIDE: usize, const N: usize>(
        apart: &Apart,
        i: usize,
        layers: &Layers<'a, S, N>,
        (stacked, turn): (&Stacked<'_>, __m256i),
    ) -> Voxel<'a, S> {
        let ([x, y], [_, high]) = apart.window(i, 1);
        debug_assert!(high <= ROWS, "what a frame's voxels have at most");
        let x = inside(x, WIDE);
        let deep = &layers.deep.weights[apart.deep[i] as usize..][..apart.left[i] as usize];
        let (slot, table) = (layers.slot, &layers.across[0][layers.slot]);
        let column = apart.first[0][slot][i] - x as i32;
        // What is present lies in the row.
        let row = table.row(apart.from[0][slot][i] as usize).as_ptr();
        let across = (present(table.len, column), row.wrapping_offset(-(column as isize)));
        let begins = begins(stacked, (apart.at[1][i], apart.deep[i], y as i32), turn);
        Voxel { at: [x, y], high: high.min(ROWS), deep, across, begins }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(in super::super) fn shorts<const N: usize>(at: At<'_, i16, N>) {
        by_columns!(short[N], at);
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn short<const WIDE: usize, const N: usize>(
        (records, (apart, payloads), layers, stacked): At<'_, i16, N>,
    ) {
        let slot = layers.slot;
        let turn_deep = words(|lane| (lane / 4 + 2 * MOST - slot) % MOST);
        let turn = turn(slot);
        let weights = weights_down(layers, &stacked).as_ptr();
        // Which of eight rows' weights, four slots a register, lanes take in the first: that of their slot.
        let first = words(|lane| lane / 4 * BLOCK);
        for (&i, &payload) in apart.kept[..payloads.len()].iter().zip(payloads) {
            let i = i as usize % BATCH;
            let Voxel { at: [x, y], high, deep, across: (present, from), begins } =
                voxel::<_, WIDE, N>(apart, i, layers, (&stacked, turn));
            let section = _mm512_set1_epi64(payload as i64);
            let wz = _mm512_permutexvar_epi16(turn_deep, load(deep));
            let section = _mm512_mulhrs_epi16(section, wz);
            // SAFETY: lanes that are not present are not read, and those that are lie in the table.
            let line = unsafe { _mm512_maskz_loadu_epi16(present, from) };
            let mut wx = [_mm512_setzero_si512(); WIDE];
            for (c, wx) in wx.iter_mut().enumerate() {
                *wx = _mm512_permutexvar_epi16(_mm512_set1_epi16(c as i16), line);
            }
            for block in (0..high).step_by(BLOCK) {
                // SAFETY: weights of all rows can be read from each begin.
                let eight = |slot: usize| unsafe {
                    _mm_loadu_si128(weights.add(begins[slot] as usize + block).cast())
                };
                let mut fours = [_mm512_setzero_si512(); 2];
                for (half, four) in fours.iter_mut().enumerate() {
                    let two = |slot| {
                        let low = _mm256_castsi128_si256(eight(slot));
                        _mm256_inserti128_si256::<1>(low, eight(slot + 1))
                    };
                    let low = _mm512_castsi256_si512(two(4 * half));
                    *four = _mm512_inserti64x4::<1>(low, two(4 * half + 2));
                }
                let ([low, behind], mut from) = (fours, first);
                let rows = records[(y + block) * STRIDE + x..].chunks_mut(STRIDE);
                for row in rows.take((high - block).min(BLOCK)) {
                    let wy = _mm512_permutex2var_epi16(low, from, behind);
                    from = _mm512_add_epi16(from, _mm512_set1_epi16(1));
                    add_row(row, _mm512_mulhrs_epi16(section, wy), &wx);
                }
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(in super::super) fn longs<const N: usize>(at: At<'_, i32, N>) {
        by_columns!(long[N], at);
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn long<const WIDE: usize, const N: usize>(
        (records, (apart, payloads), layers, stacked): At<'_, i32, N>,
    ) {
        let (slot, zero) = (layers.slot, _mm512_setzero_ps());
        let turn = turn(slot);
        let weights: *const Tap = weights_down(layers, &stacked).as_ptr();
        let lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        // Which of four slots a lane belongs to, and of eight rows' weights, two slots a register, the first row's.
        let of_four = _mm512_srli_epi32::<2>(lane);
        let first = _mm512_slli_epi32::<3>(of_four);
        for (&i, payload) in apart.kept[..payloads.len()].iter().zip(payloads) {
            let i = i as usize % BATCH;
            let Voxel { at: [x, y], high, deep, across: (present, from), begins } =
                voxel::<_, WIDE, N>(apart, i, layers, (&stacked, turn));
            let some = ((1u32 << deep.len().min(MOST)) - 1) as u8;
            // SAFETY: lanes that are not there are not read, and those that are lie in the tables; a tap is a float, and
            // four floats are 16 bytes.
            let (z, line, payload) = unsafe {
                let z = _mm256_maskz_loadu_ps(some, deep.as_ptr());
                let line = _mm512_maskz_loadu_ps(present as u16, from.cast());
                (z, line, _mm512_broadcast_f32x4(_mm_loadu_ps(payload.as_ptr())))
            };
            let z = _mm512_castps256_ps512(_mm256_permutexvar_ps(turn, z));
            let mut sections = [zero; 2];
            for (half, section) in sections.iter_mut().enumerate() {
                let slots = _mm512_add_epi32(of_four, _mm512_set1_epi32(4 * half as i32));
                // Negative sections there are none.
                let wz = _mm512_permutexvar_ps(slots, z);
                *section = _mm512_max_ps(_mm512_mul_ps(payload, wz), zero);
            }
            let mut wx = [zero; WIDE];
            for (c, wx) in wx.iter_mut().enumerate() {
                *wx = _mm512_permutexvar_ps(_mm512_set1_epi32(c as i32), line);
            }
            for block in (0..high).step_by(BLOCK) {
                // SAFETY: weights of all rows can be read from each begin; a tap is a float.
                let eight = |slot: usize| unsafe {
                    _mm256_loadu_ps(weights.add(begins[slot] as usize + block).cast())
                };
                let mut twos = [zero; 4];
                for (two, to) in twos.iter_mut().enumerate() {
                    let low = _mm512_castps256_ps512(eight(2 * two));
                    *to = _mm512_insertf32x8::<1>(low, eight(2 * two + 1));
                }
                let mut from = first;
                let rows = records[(y + block) * STRIDE + x..].chunks_mut(STRIDE);
                for row in rows.take((high - block).min(BLOCK)) {
                    let row = row.first_chunk_mut::<WIDE>().expect("a window inside the part");
                    let mut of_row = sections;
                    for (half, of_row) in of_row.iter_mut().enumerate() {
                        let wy = _mm512_permutex2var_ps(twos[2 * half], from, twos[2 * half + 1]);
                        *of_row = _mm512_mul_ps(*of_row, wy);
                    }
                    from = _mm512_add_epi32(from, _mm512_set1_epi32(1));
                    for c in 0..WIDE {
                        let at: *mut __m512i = row[c].as_mut_ptr().cast();
                        for (half, of_row) in of_row.iter().enumerate() {
                            let add = _mm512_cvtps_epi32(_mm512_mul_ps(*of_row, wx[c]));
                            // SAFETY: sixteen sums of four slots are 64 bytes, and borrowed for us alone.
                            unsafe {
                                let at = at.add(half);
                                _mm512_storeu_si512(
                                    at,
                                    _mm512_add_epi32(_mm512_loadu_si512(at), add),
                                );
                            }
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::batch::Axes;
    use crate::scene::{Frame, Scene};
    use crate::selftest;
    use crate::splat::records::apart::{Apart, BATCH, Woven};
    use crate::splat::records::{MOST, Record, STRIDE};
    use crate::stack::EDGE;
    use glam::DVec3;
    use proptest::prelude::*;
    use slabcast_common::quality::{Quality, Sums};
    use slabcast_common::view::{Camera, CameraProjection, SUBPIXELS, View};
    use slabcast_common::volume::{Lattice, Volume};
    use std::sync::Arc;

    /// A view of a lattice whose upright axis is `odd` times as coarse as the others, from above.
    fn frame(sums: Sums, odd: f64, up: f64, height: f64) -> Frame {
        let dims = [20, 16, 24];
        let mut volume = Volume::from_fn_u8("any", dims, |i, j, k| (i + 3 * j + 7 * k) as u8);
        volume.lattice = Lattice::from_spacing(dims, [1.0, 1.0, odd]);
        let quality = Quality { sums, ..Quality::default() };
        let projection = CameraProjection::Ortho { height };
        let to_eye = DVec3::new(0.4, 1.0, up);
        let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection };
        let view = View::new(&volume.lattice, &camera, [100, 90], &quality).expect("a view");
        Frame::new(Arc::new(Scene::new(&selftest::spec(&volume, quality))), view)
    }

    /// A voxel: where it is, the phase of its depth, and how many of its sheets it has left.
    type Somewhere = ([i32; 2], u32, usize);

    /// Whether voxels were added in lanes: then as sections that lie anywhere are.
    fn as_any_others<S: Recorded>(
        frame: &Frame,
        voxels: &[Somewhere],
        slot: usize,
    ) -> Result<bool, TestCaseError> {
        let footprint = frame.footprints.at(0).expect("a parallel view");
        let mut axes = Axes::<S, MOST>::new(frame, 0, &footprint);
        axes.layers.slot = slot;
        let leaning = frame.leaning.as_ref().expect("a kernel that leans");
        let phases = axes.phases.each_ref().map(|phases| phases[0]);
        let Some(stacked) = leaning.stacked(phases) else { return Ok(false) };
        let most = frame.sections.most();
        let (mut apart, mut payloads) = (Apart::default(), vec![]);
        for (i, &(at, phase, left)) in voxels.iter().enumerate() {
            let left = 1 + left % most;
            (apart.left[i], apart.deep[i]) =
                (left as i32, phase * most as u32 + (most - left) as u32);
            let aside = |sheet| stacked.subpixels[apart.deep[i] as usize + sheet];
            for (axis, phases) in phases.iter().enumerate() {
                apart.at[axis][i] = at[axis];
                let (mut lo, mut hi) = (i32::MAX, i32::MIN);
                for sheet in 0..left {
                    let at = at[axis] + if axis == 1 { aside(sheet) } else { 0 };
                    let (which, first) = ((slot + sheet) % MOST, phases.first_at(at));
                    let begin = phases.begin((at & (SUBPIXELS - 1)) as usize);
                    (apart.first[axis][which][i], apart.from[axis][which][i]) =
                        (first, begin as u32);
                    (lo, hi) = (lo.min(first), hi.max(first + phases.len as i32));
                }
                prop_assert!(axis == 0 || hi - lo <= ROWS as i32, "{} rows", hi - lo);
                (apart.lo[axis][i], apart.hi[axis][i]) = (lo.max(0), hi.min(EDGE as i32));
            }
            if (0..2).all(|axis| apart.lo[axis][i] < apart.hi[axis][i]) {
                apart.kept[payloads.len()] = i as u32;
                payloads.push(S::payload([31_000.0 - i as f32, 17_003.4, 77.7, i as f32]));
            }
        }
        let mut run = |simd, stacked| {
            axes.layers.stacked = stacked;
            let mut records: Vec<Record<S, MOST>> =
                vec![[S::from_raw([11; 4]); MOST]; STRIDE * EDGE];
            let voxels = (&apart, &payloads[..]);
            S::splat_apart(simd, &mut records, voxels, &axes.layers, &mut Woven::default());
            records
        };
        let want = run(Simd::plain(), None);
        for simd in Simd::all().into_iter().filter(|&simd| in_lanes::<S>(simd)) {
            prop_assert!(run(simd, Some(stacked)) == want, "{}", simd.name());
        }
        Ok(true)
    }

    #[test]
    fn sections_are_stacked_where_the_odd_axis_stands_upright_and_footprints_are_small() {
        let is_stacked = |height, odd, up| {
            as_any_others::<i16>(&frame(Sums::I16, odd, up, height), &[], 0)
                .expect("nothing to compare")
        };
        assert!(is_stacked(60.0, 1.3, 0.5) && is_stacked(60.0, 2.5, -0.7));
        assert!(!is_stacked(12.0, 2.5, 0.5));
    }

    proptest! {
        #[test]
        fn they_are_added_as_any_others(
            voxels in prop::collection::vec(
                (prop::array::uniform2(-2000..18_500i32), 0..256u32, 0..MOST), 0..BATCH),
            slot in 0..MOST, odd in 1.1..3.0f64, up in 0.1..1.5f64, below in any::<bool>(),
            height in 30.0..90.0f64,
        ) {
            let up = if below { -up } else { up };
            as_any_others::<i16>(&frame(Sums::I16, odd, up, height), &voxels, slot)?;
            as_any_others::<i32>(&frame(Sums::I32, odd, up, height), &voxels, slot)?;
        }
    }
}
