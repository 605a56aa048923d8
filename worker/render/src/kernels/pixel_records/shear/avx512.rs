//! Sections that lie aside of each other in AVX-512's registers.

use super::voxel::{At, Begins, Lookup, Voxel};
use crate::kernels::Tap;
use crate::kernels::pixel_records::sheet_offsets::BATCH;
use crate::kernels::pixel_records::short::avx512::{add, load, words};
use crate::kernels::pixel_records::{MOST, STRIDE};
use std::arch::x86_64::*;

/// Rows or columns that are looked up at once.
const BLOCK: usize = 8;

/// [`BLOCK`] weights of each slot from the `behind`th after its begin on: four slots a register.
///
/// # Safety
/// For machines with AVX-512. So many can be read.
#[inline(always)]
unsafe fn fours(weights: &[i16], begins: &Begins, behind: usize) -> [__m512i; 2] {
    // SAFETY: the caller's.
    unsafe {
        let of = |slot: usize| {
            _mm_loadu_si128(weights.as_ptr().add(begins[slot] as usize + behind).cast())
        };
        let two =
            |slot| _mm256_inserti128_si256::<1>(_mm256_castsi128_si256(of(slot)), of(slot + 1));
        let four = |slot| {
            let low = _mm512_castsi256_si512(two(slot));
            _mm512_inserti64x4::<1>(low, two(slot + 2))
        };
        [four(0), four(4)]
    }
}

/// Loads eight float weights of each slot, from `behind` after the slot's first: two slots a
/// register.
///
/// # Safety
/// As there.
#[inline(always)]
unsafe fn twos(weights: &[Tap], begins: &Begins, behind: usize) -> [__m512; 4] {
    // SAFETY: the caller's; a tap is a float.
    unsafe {
        let of = |slot: usize| {
            _mm256_loadu_ps(weights.as_ptr().add(begins[slot] as usize + behind).cast())
        };
        let two = |slot| _mm512_insertf32x8::<1>(_mm512_castps256_ps512(of(slot)), of(slot + 1));
        [two(0), two(2), two(4), two(6)]
    }
}

#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
pub(in super::super) fn shorts<const N: usize>(at: At<'_, i16, N>) {
    by_columns!(short[N], at);
}

#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
#[inline]
fn short<const SKEWED: bool, const WIDE: usize, const N: usize>(
    (records, (apart, payloads), layers, slant): At<'_, i16, N>,
) {
    let slot = layers.slot;
    let turn_deep = words(|lane| (lane / 4 + 2 * MOST - slot) % MOST);
    // SAFETY: AVX2 there is where AVX-512 is.
    let lookup = unsafe { Lookup::new(layers, slant) };
    // Which of eight weights, four slots a register, lanes take of the first row or column: that of
    // their slot.
    let first = words(|lane| lane / 4 * BLOCK);
    let next = |from| _mm512_add_epi16(from, _mm512_set1_epi16(1));
    for (&i, &payload) in apart.kept[..payloads.len()].iter().zip(payloads) {
        let i = i as usize % BATCH;
        // SAFETY: as above.
        let Voxel { y, high, deep, begins } = unsafe { lookup.voxel(apart, i) };
        let section = _mm512_set1_epi64(payload as i64);
        let wz = _mm512_permutexvar_epi16(turn_deep, load(deep));
        let section = _mm512_mulhrs_epi16(section, wz);
        let (mut x, mut wx) = (0, [_mm512_setzero_si512(); WIDE]);
        let mut rows = None;
        if SKEWED {
            // SAFETY: as above.
            rows = Some(unsafe { lookup.rows(apart, i, y) });
        } else {
            let (column, across) = lookup.columns::<WIDE>(apart, i);
            // SAFETY: sixteen weights are 32 bytes.
            let line = unsafe { _mm256_loadu_si256(across.as_ptr().cast()) };
            let line = _mm512_castsi256_si512(line);
            for (c, wx) in wx.iter_mut().enumerate() {
                *wx = _mm512_permutexvar_epi16(_mm512_set1_epi16(c as i16), line);
            }
            x = column;
        }
        for block in (0..high).step_by(BLOCK) {
            // SAFETY: weights of all rows can be read from each begin.
            let [low, behind] = unsafe { fours(lookup.down, &begins, block) };
            let mut from = first;
            for row in
                records[(y + block) * STRIDE..].chunks_mut(STRIDE).take((high - block).min(BLOCK))
            {
                let wy = _mm512_permutex2var_epi16(low, from, behind);
                from = next(from);
                let of_row = _mm512_mulhrs_epi16(section, wy);
                if let Some(rows) = &mut rows {
                    // SAFETY: as above, and of all columns.
                    unsafe {
                        let (column, begins) = rows.next::<WIDE>();
                        for block in (0..WIDE).step_by(BLOCK) {
                            let ([low, behind], mut from) =
                                (fours(lookup.across, &begins, block), first);
                            for wx in &mut wx[block..WIDE.min(block + BLOCK)] {
                                *wx = _mm512_permutex2var_epi16(low, from, behind);
                                from = next(from);
                            }
                        }
                        x = column;
                    }
                }
                let row = row[x..].first_chunk_mut::<WIDE>().expect("a window inside the part");
                let at: *mut __m512i = row.as_mut_ptr().cast();
                for (c, &wx) in wx.iter().enumerate() {
                    // SAFETY: so many registers are the records of `row`, borrowed for us alone.
                    unsafe { add(at.add(c), of_row, wx) };
                }
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
fn long<const SKEWED: bool, const WIDE: usize, const N: usize>(
    (records, (apart, payloads), layers, slant): At<'_, i32, N>,
) {
    let zero = _mm512_setzero_ps();
    // SAFETY: AVX2 there is where AVX-512 is.
    let lookup = unsafe { Lookup::new(layers, slant) };
    let lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    // Which of four slots a lane belongs to, and of eight weights, two slots a register, those of
    // the first row or column.
    let of_four = _mm512_srli_epi32::<2>(lane);
    let first = _mm512_slli_epi32::<3>(of_four);
    let next = |from| _mm512_add_epi32(from, _mm512_set1_epi32(1));
    for (&i, payload) in apart.kept[..payloads.len()].iter().zip(payloads) {
        let i = i as usize % BATCH;
        // SAFETY: as above.
        let Voxel { y, high, deep, begins } = unsafe { lookup.voxel(apart, i) };
        let some = ((1u32 << deep.len().min(MOST)) - 1) as u8;
        // SAFETY: lanes that are not there are not read; four floats are 16 bytes.
        let (z, payload) = unsafe {
            let z = _mm256_maskz_loadu_ps(some, deep.as_ptr());
            (z, _mm512_broadcast_f32x4(_mm_loadu_ps(payload.as_ptr())))
        };
        let z = _mm512_castps256_ps512(_mm256_permutexvar_ps(lookup.turn, z));
        let mut sections = [zero; 2];
        for (half, section) in sections.iter_mut().enumerate() {
            let slots = _mm512_add_epi32(of_four, _mm512_set1_epi32(4 * half as i32));
            // Negative sections there are none.
            let wz = _mm512_permutexvar_ps(slots, z);
            *section = _mm512_max_ps(_mm512_mul_ps(payload, wz), zero);
        }
        let (mut x, mut wx) = (0, [[zero; 2]; WIDE]);
        let mut rows = None;
        if SKEWED {
            // SAFETY: as above.
            rows = Some(unsafe { lookup.rows(apart, i, y) });
        } else {
            let (column, across) = lookup.columns::<WIDE>(apart, i);
            // SAFETY: a tap is a float, and sixteen are 64 bytes.
            let line = unsafe { _mm512_loadu_ps(across.as_ptr().cast()) };
            for (c, wx) in wx.iter_mut().enumerate() {
                *wx = [_mm512_permutexvar_ps(_mm512_set1_epi32(c as i32), line); 2];
            }
            x = column;
        }
        for block in (0..high).step_by(BLOCK) {
            // SAFETY: weights of all rows can be read from each begin.
            let (of_rows, mut from) = (unsafe { twos(lookup.down, &begins, block) }, first);
            for row in
                records[(y + block) * STRIDE..].chunks_mut(STRIDE).take((high - block).min(BLOCK))
            {
                let mut of_row = sections;
                for (half, of_row) in of_row.iter_mut().enumerate() {
                    let wy = _mm512_permutex2var_ps(of_rows[2 * half], from, of_rows[2 * half + 1]);
                    *of_row = _mm512_mul_ps(*of_row, wy);
                }
                from = next(from);
                if let Some(rows) = &mut rows {
                    // SAFETY: as above, and of all columns.
                    unsafe {
                        let (column, begins) = rows.next::<WIDE>();
                        for block in (0..WIDE).step_by(BLOCK) {
                            let (two, mut from) = (twos(lookup.across, &begins, block), first);
                            for wx in &mut wx[block..WIDE.min(block + BLOCK)] {
                                for (half, wx) in wx.iter_mut().enumerate() {
                                    let [low, behind] = [two[2 * half], two[2 * half + 1]];
                                    *wx = _mm512_permutex2var_ps(low, from, behind);
                                }
                                from = next(from);
                            }
                        }
                        x = column;
                    }
                }
                let row = row[x..].first_chunk_mut::<WIDE>().expect("a window inside the part");
                for c in 0..WIDE {
                    let at: *mut __m512i = row[c].as_mut_ptr().cast();
                    for (half, of_row) in of_row.iter().enumerate() {
                        let add = _mm512_cvtps_epi32(_mm512_mul_ps(
                            *of_row,
                            wx[c][if SKEWED { half } else { 0 }],
                        ));
                        // SAFETY: sixteen sums of four slots are 64 bytes, and borrowed for us
                        // alone.
                        unsafe {
                            let at = at.add(half);
                            _mm512_storeu_si512(at, _mm512_add_epi32(_mm512_loadu_si512(at), add));
                        }
                    }
                }
            }
        }
    }
}
