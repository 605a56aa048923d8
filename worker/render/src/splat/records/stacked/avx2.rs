//! Stacked sections in AVX2's registers.

use super::voxel::{At, Lookup, Voxel};
use crate::splat::Tap;
use crate::splat::records::apart::BATCH;
use crate::splat::records::long::avx2::PARTS as LONG_PARTS;
use crate::splat::records::short::avx2::{PARTS, add, times, turns};
use crate::splat::records::{MOST, STRIDE};
use std::arch::x86_64::*;

/// Rows that are looked up at once.
const BLOCK: usize = 4;

/// All bits of eight numbers, and none of eight more.
static PRESENT: [i32; 2 * MOST] = {
    let mut present = [0; 2 * MOST];
    let mut i = 0;
    while i < MOST {
        present[i] = -1;
        i += 1;
    }
    present
};

/// Eight weights in depth, of which `deep` are, and zeros.
#[target_feature(enable = "avx2")]
#[inline]
fn eight_deep(deep: &[i16]) -> __m128i {
    let mut eight = [0; MOST];
    for (to, &w) in eight.iter_mut().zip(deep) {
        *to = w;
    }
    // SAFETY: eight weights are 16 bytes.
    unsafe { _mm_loadu_si128(eight.as_ptr().cast()) }
}

#[target_feature(enable = "avx2")]
pub(in super::super) fn shorts<const N: usize>(at: At<'_, i16, N>) {
    by_columns!(short[N], at);
}

#[target_feature(enable = "avx2")]
#[inline]
fn short<const WIDE: usize, const N: usize>(
    (records, (apart, payloads), layers, stacked): At<'_, i16, N>,
) {
    let turns = turns::<N>(layers.slot);
    // SAFETY: these are the instructions.
    let lookup = unsafe { Lookup::new(layers, stacked) };
    let weights = lookup.down.as_ptr();
    // Of the weights of two slots by turns, which bytes lanes take of the first row: those of their slot.
    let first = _mm256_setr_epi8(
        0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3, 0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3,
        2, 3,
    );
    for (&i, &payload) in apart.kept[..payloads.len()].iter().zip(payloads) {
        // SAFETY: as above.
        let voxel = unsafe { lookup.voxel::<WIDE>(apart, i as usize % BATCH) };
        let Voxel { at: [x, y], high, deep, across, begins } = voxel;
        let z = _mm256_broadcastsi128_si256(eight_deep(deep));
        let payload = [_mm256_set1_epi64x(payload as i64); PARTS];
        let sections = times::<N>(&payload, &turns.map(|turn| _mm256_shuffle_epi8(z, turn)));
        let mut wx = [_mm256_setzero_si256(); WIDE];
        for (wx, &w) in wx.iter_mut().zip(across) {
            *wx = _mm256_set1_epi16(w);
        }
        for block in (0..high).step_by(BLOCK) {
            // SAFETY: weights of all rows can be read from each begin.
            let four = |slot: usize| unsafe {
                _mm_loadl_epi64(weights.add(begins[slot] as usize + block).cast())
            };
            let mut fours = [_mm256_setzero_si256(); PARTS];
            for (part, to) in fours.iter_mut().enumerate() {
                let two = |slot| _mm_unpacklo_epi16(four(slot), four(slot + 1));
                *to = _mm256_set_m128i(two(4 * part + 2), two(4 * part));
            }
            let mut from = first;
            let rows = records[(y + block) * STRIDE + x..].chunks_mut(STRIDE);
            for row in rows.take((high - block).min(BLOCK)) {
                let row = row.first_chunk_mut::<WIDE>().expect("a window inside the part");
                let wy = [0, 1].map(|part| _mm256_shuffle_epi8(fours[part], from));
                from = _mm256_add_epi8(from, _mm256_set1_epi8(4));
                let of_row = times::<N>(&sections, &wy);
                for c in 0..WIDE {
                    add(&mut row[c], &of_row, &[wx[c]; PARTS]);
                }
            }
        }
    }
}

#[target_feature(enable = "avx2")]
pub(in super::super) fn longs<const N: usize>(at: At<'_, i32, N>) {
    by_columns!(long[N], at);
}

#[target_feature(enable = "avx2")]
#[inline]
fn long<const WIDE: usize, const N: usize>(
    (records, (apart, payloads), layers, stacked): At<'_, i32, N>,
) {
    const { assert!(LONG_PARTS == MOST / 2) };
    let zero = _mm256_setzero_ps();
    // SAFETY: these are the instructions.
    let lookup = unsafe { Lookup::new(layers, stacked) };
    let weights: *const Tap = lookup.down.as_ptr();
    for (&i, payload) in apart.kept[..payloads.len()].iter().zip(payloads) {
        // SAFETY: as above.
        let voxel = unsafe { lookup.voxel::<WIDE>(apart, i as usize % BATCH) };
        let Voxel { at: [x, y], high, deep, across, begins } = voxel;
        let present = PRESENT[MOST - deep.len().min(MOST)..].as_ptr();
        // SAFETY: lanes that are not there are not read; four floats are 16 bytes, and eight numbers 32.
        let (z, payload) = unsafe {
            let z = _mm256_maskload_ps(deep.as_ptr(), _mm256_loadu_si256(present.cast()));
            (z, _mm256_broadcast_ps(&_mm_loadu_ps(payload.as_ptr())))
        };
        let z = _mm256_permutevar8x32_ps(z, lookup.turn);
        let mut sections = [zero; LONG_PARTS];
        for (part, section) in sections.iter_mut().enumerate() {
            let two = _mm256_set1_epi32(2 * part as i32);
            let slots = _mm256_add_epi32(two, _mm256_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1));
            // Negative sections there are none.
            let wz = _mm256_permutevar8x32_ps(z, slots);
            *section = _mm256_max_ps(_mm256_mul_ps(payload, wz), zero);
        }
        let mut wx = [zero; WIDE];
        for (wx, w) in wx.iter_mut().zip(across) {
            *wx = _mm256_set1_ps(w.get());
        }
        for block in (0..high).step_by(BLOCK) {
            // SAFETY: weights of all rows can be read from each begin; a tap is a float.
            let four = |slot: usize| unsafe {
                _mm_loadu_ps(weights.add(begins[slot] as usize + block).cast())
            };
            let mut twos = [zero; LONG_PARTS];
            for (part, two) in twos.iter_mut().enumerate() {
                *two = _mm256_set_m128(four(2 * part + 1), four(2 * part));
            }
            let mut from = _mm256_setzero_si256();
            let rows = records[(y + block) * STRIDE + x..].chunks_mut(STRIDE);
            for row in rows.take((high - block).min(BLOCK)) {
                let row = row.first_chunk_mut::<WIDE>().expect("a window inside the part");
                let mut of_row = sections;
                for (of_row, two) in of_row.iter_mut().zip(twos) {
                    *of_row = _mm256_mul_ps(*of_row, _mm256_permutevar_ps(two, from));
                }
                from = _mm256_add_epi32(from, _mm256_set1_epi32(1));
                for c in 0..WIDE {
                    let at: *mut __m256i = row[c].as_mut_ptr().cast();
                    for (part, of_row) in of_row.iter().enumerate() {
                        let add = _mm256_cvtps_epi32(_mm256_mul_ps(*of_row, wx[c]));
                        // SAFETY: eight sums of two slots are 32 bytes, and borrowed for us alone.
                        unsafe {
                            let at = at.add(part);
                            _mm256_storeu_si256(at, _mm256_add_epi32(_mm256_loadu_si256(at), add));
                        }
                    }
                }
            }
        }
    }
}
