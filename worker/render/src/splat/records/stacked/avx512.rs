//! Stacked sections in AVX-512's registers.

use super::voxel::{At, Lookup, Voxel};
use crate::splat::Tap;
use crate::splat::records::apart::BATCH;
use crate::splat::records::short::avx512::{add_row, load, words};
use crate::splat::records::{MOST, STRIDE};
use std::arch::x86_64::*;

/// Rows that are looked up at once.
const BLOCK: usize = 8;

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
    // SAFETY: AVX2 there is where AVX-512 is.
    let lookup = unsafe { Lookup::new(layers, stacked) };
    let weights = lookup.down.as_ptr();
    // Which of eight rows' weights, four slots a register, lanes take in the first: that of their slot.
    let first = words(|lane| lane / 4 * BLOCK);
    for (&i, &payload) in apart.kept[..payloads.len()].iter().zip(payloads) {
        // SAFETY: as above.
        let voxel = unsafe { lookup.voxel::<WIDE>(apart, i as usize % BATCH) };
        let Voxel { at: [x, y], high, deep, across, begins } = voxel;
        let section = _mm512_set1_epi64(payload as i64);
        let wz = _mm512_permutexvar_epi16(turn_deep, load(deep));
        let section = _mm512_mulhrs_epi16(section, wz);
        // SAFETY: sixteen weights are 32 bytes.
        let line = unsafe { _mm256_loadu_si256(across.as_ptr().cast()) };
        let line = _mm512_castsi256_si512(line);
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
    let zero = _mm512_setzero_ps();
    // SAFETY: AVX2 there is where AVX-512 is.
    let lookup = unsafe { Lookup::new(layers, stacked) };
    let weights: *const Tap = lookup.down.as_ptr();
    let lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    // Which of four slots a lane belongs to, and of eight rows' weights, two slots a register, the first row's.
    let of_four = _mm512_srli_epi32::<2>(lane);
    let first = _mm512_slli_epi32::<3>(of_four);
    for (&i, payload) in apart.kept[..payloads.len()].iter().zip(payloads) {
        // SAFETY: as above.
        let voxel = unsafe { lookup.voxel::<WIDE>(apart, i as usize % BATCH) };
        let Voxel { at: [x, y], high, deep, across, begins } = voxel;
        let some = ((1u32 << deep.len().min(MOST)) - 1) as u8;
        // SAFETY: lanes that are not there are not read; a tap is a float, sixteen are 64 bytes, and four 16.
        let (z, line, payload) = unsafe {
            let z = _mm256_maskz_loadu_ps(some, deep.as_ptr());
            let line = _mm512_loadu_ps(across.as_ptr().cast());
            (z, line, _mm512_broadcast_f32x4(_mm_loadu_ps(payload.as_ptr())))
        };
        let z = _mm512_castps256_ps512(_mm256_permutexvar_ps(lookup.turn, z));
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
                            _mm512_storeu_si512(at, _mm512_add_epi32(_mm512_loadu_si512(at), add));
                        }
                    }
                }
            }
        }
    }
}
