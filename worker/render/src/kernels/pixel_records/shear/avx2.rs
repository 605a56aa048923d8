//! Sections that lie aside of each other in AVX2's registers.

use super::Slant;
use super::voxel::{self, At, Begins, Lookup, Voxel};
use crate::kernels::Tap;
use crate::kernels::pixel_records::long::avx2::PARTS as LONG_PARTS;
use crate::kernels::pixel_records::sheet_offsets::{Apart, BATCH};
use crate::kernels::pixel_records::short::avx2::{PARTS, add, times, turns};
use crate::kernels::pixel_records::{MOST, STRIDE};
use std::arch::x86_64::*;

/// Rows or columns that are looked up at once.
const BLOCK: usize = 4;

/// All bits of 32 bytes, and none of 32 more.
static PRESENT: [u8; 64] = {
    let mut present = [0; 64];
    let mut i = 0;
    while i < 32 {
        present[i] = 0xff;
        i += 1;
    }
    present
};

/// All bits of the first of eight weights, as many as `deep` has: from where on a register holds
/// them.
#[inline(always)]
fn present<W>(deep: &[W]) -> *const u8 {
    const { assert!(size_of::<W>() * MOST <= 32) };
    PRESENT[32 - size_of::<W>() * deep.len().min(MOST)..].as_ptr()
}

/// The weights of `deep`, eight at most, and zeros; `behind`: what lies in the table from the first
/// of them on.
#[target_feature(enable = "avx2")]
#[inline]
fn eight_deep(deep: &[i16], behind: &[i16]) -> __m128i {
    if let Some(eight) = behind.first_chunk::<MOST>() {
        // SAFETY: eight weights are 16 bytes, and so many lie from what is present on.
        let (eight, present) = unsafe {
            let eight = _mm_loadu_si128(eight.as_ptr().cast());
            (eight, _mm_loadu_si128(present(deep).cast()))
        };
        return _mm_and_si128(eight, present);
    }
    // At the end of the table.
    let mut eight = [0; MOST];
    for (to, &w) in eight.iter_mut().zip(deep) {
        *to = w;
    }
    // SAFETY: eight weights are 16 bytes.
    unsafe { _mm_loadu_si128(eight.as_ptr().cast()) }
}

/// [`BLOCK`] weights of each slot from the `behind`th after its begin on: of four slots a register,
/// two and two by turns.
///
/// # Safety
/// For machines with AVX2. So many can be read.
#[inline(always)]
unsafe fn fours(weights: &[i16], begins: &Begins, behind: usize) -> [__m256i; PARTS] {
    // SAFETY: the caller's.
    unsafe {
        let of = |slot: usize| {
            _mm_loadl_epi64(weights.as_ptr().add(begins[slot] as usize + behind).cast())
        };
        let two = |slot| _mm_unpacklo_epi16(of(slot), of(slot + 1));
        // A loop, since closures of arrays are compiled for the baseline.
        let mut fours = [_mm256_setzero_si256(); PARTS];
        for (part, four) in fours.iter_mut().enumerate() {
            *four = _mm256_set_m128i(two(4 * part + 2), two(4 * part));
        }
        fours
    }
}

/// Loads four float weights of each slot, from `behind` after the slot's first: two slots a
/// register, one behind the other.
///
/// # Safety
/// As there.
#[inline(always)]
unsafe fn twos(weights: &[Tap], begins: &Begins, behind: usize) -> [__m256; LONG_PARTS] {
    // SAFETY: the caller's; a tap is a float.
    unsafe {
        let of =
            |slot: usize| _mm_loadu_ps(weights.as_ptr().add(begins[slot] as usize + behind).cast());
        let mut twos = [_mm256_setzero_ps(); LONG_PARTS];
        for (part, two) in twos.iter_mut().enumerate() {
            *two = _mm256_set_m128(of(2 * part + 1), of(2 * part));
        }
        twos
    }
}

/// Bytes of each register in the order that another says.
#[target_feature(enable = "avx2")]
#[inline]
fn taken(of: &[__m256i; PARTS], order: &[__m256i; PARTS]) -> [__m256i; PARTS] {
    let mut taken = [_mm256_setzero_si256(); PARTS];
    for i in 0..PARTS {
        taken[i] = _mm256_shuffle_epi8(of[i], order[i]);
    }
    taken
}

/// Finds the windows of the first `n` voxels, which are skewed.
#[target_feature(enable = "avx2")]
pub(super) fn windows(slant: &Slant<'_>, apart: &mut Apart, n: usize) {
    // SAFETY: these are the instructions.
    unsafe { voxel::windows(slant, apart, n) }
}

#[target_feature(enable = "avx2")]
pub(in super::super) fn shorts<const N: usize>(at: At<'_, i16, N>) {
    by_columns!(short[N], at);
}

#[target_feature(enable = "avx2")]
#[inline]
fn short<const SKEWED: bool, const WIDE: usize, const N: usize>(
    (records, (apart, payloads), layers, slant): At<'_, i16, N>,
) {
    let turns = turns::<N>(layers.slot);
    // SAFETY: these are the instructions.
    let lookup = unsafe { Lookup::new(layers, slant) };
    // Which bytes lanes take of the first row or column: those of their slot.
    let first = _mm256_setr_epi8(
        0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3, 0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3,
        2, 3,
    );
    let next = |from| _mm256_add_epi8(from, _mm256_set1_epi8(4));
    for (&i, &payload) in apart.kept[..payloads.len()].iter().zip(payloads) {
        let i = i as usize % BATCH;
        // SAFETY: as above.
        let Voxel { y, high, deep, begins } = unsafe { lookup.voxel(apart, i) };
        let z = _mm256_broadcastsi128_si256(eight_deep(deep, lookup.deep_from(apart, i)));
        let sections =
            times::<N>(&[_mm256_set1_epi64x(payload as i64); PARTS], &taken(&[z; PARTS], &turns));
        let (mut x, mut wx) = (0, [[_mm256_setzero_si256(); PARTS]; WIDE]);
        let mut rows = None;
        if SKEWED {
            // SAFETY: as above.
            rows = Some(unsafe { lookup.rows(apart, i, y) });
        } else {
            let (column, across) = lookup.columns::<WIDE>(apart, i);
            for (wx, &w) in wx.iter_mut().zip(across) {
                *wx = [_mm256_set1_epi16(w); PARTS];
            }
            x = column;
        }
        for block in (0..high).step_by(BLOCK) {
            // SAFETY: weights of all rows can be read from each begin.
            let (of_rows, mut from) = (unsafe { fours(lookup.down, &begins, block) }, first);
            for row in
                records[(y + block) * STRIDE..].chunks_mut(STRIDE).take((high - block).min(BLOCK))
            {
                let of_row = times::<N>(&sections, &taken(&of_rows, &[from; PARTS]));
                from = next(from);
                if let Some(rows) = &mut rows {
                    // SAFETY: as above, and of all columns.
                    unsafe {
                        let (column, begins) = rows.next::<WIDE>();
                        for block in (0..WIDE).step_by(BLOCK) {
                            let (four, mut from) = (fours(lookup.across, &begins, block), first);
                            for wx in &mut wx[block..WIDE.min(block + BLOCK)] {
                                *wx = taken(&four, &[from; PARTS]);
                                from = next(from);
                            }
                        }
                        x = column;
                    }
                }
                let row = row[x..].first_chunk_mut::<WIDE>().expect("a window inside the part");
                for (record, wx) in row.iter_mut().zip(&wx) {
                    add(record, &of_row, wx);
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
fn long<const SKEWED: bool, const WIDE: usize, const N: usize>(
    (records, (apart, payloads), layers, slant): At<'_, i32, N>,
) {
    let zero = _mm256_setzero_ps();
    // SAFETY: these are the instructions.
    let lookup = unsafe { Lookup::new(layers, slant) };
    let next = |from| _mm256_add_epi32(from, _mm256_set1_epi32(1));
    for (&i, payload) in apart.kept[..payloads.len()].iter().zip(payloads) {
        let i = i as usize % BATCH;
        // SAFETY: as above.
        let Voxel { y, high, deep, begins } = unsafe { lookup.voxel(apart, i) };
        // SAFETY: lanes that are not there are not read; four floats are 16 bytes, and eight
        // numbers 32.
        let (z, payload) = unsafe {
            let present = _mm256_loadu_si256(present(deep).cast());
            let z = _mm256_maskload_ps(deep.as_ptr(), present);
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
        let (mut x, mut wx) = (0, [[zero; LONG_PARTS]; WIDE]);
        let mut rows = None;
        if SKEWED {
            // SAFETY: as above.
            rows = Some(unsafe { lookup.rows(apart, i, y) });
        } else {
            let (column, across) = lookup.columns::<WIDE>(apart, i);
            for (wx, w) in wx.iter_mut().zip(across) {
                *wx = [_mm256_set1_ps(w.get()); LONG_PARTS];
            }
            x = column;
        }
        for block in (0..high).step_by(BLOCK) {
            // SAFETY: weights of all rows can be read from each begin.
            let of_rows = unsafe { twos(lookup.down, &begins, block) };
            let mut from = _mm256_setzero_si256();
            for row in
                records[(y + block) * STRIDE..].chunks_mut(STRIDE).take((high - block).min(BLOCK))
            {
                let mut of_row = sections;
                for (of_row, two) in of_row.iter_mut().zip(of_rows) {
                    *of_row = _mm256_mul_ps(*of_row, _mm256_permutevar_ps(two, from));
                }
                from = next(from);
                if let Some(rows) = &mut rows {
                    // SAFETY: as above, and of all columns.
                    unsafe {
                        let (column, begins) = rows.next::<WIDE>();
                        for block in (0..WIDE).step_by(BLOCK) {
                            let two = twos(lookup.across, &begins, block);
                            let mut from = _mm256_setzero_si256();
                            for wx in &mut wx[block..WIDE.min(block + BLOCK)] {
                                for (wx, two) in wx.iter_mut().zip(two) {
                                    *wx = _mm256_permutevar_ps(two, from);
                                }
                                from = next(from);
                            }
                        }
                        x = column;
                    }
                }
                let row = row[x..].first_chunk_mut::<WIDE>().expect("a window inside the part");
                for c in 0..WIDE {
                    let at: *mut __m256i = row[c].as_mut_ptr().cast();
                    for (part, of_row) in of_row.iter().enumerate() {
                        let add = _mm256_cvtps_epi32(_mm256_mul_ps(
                            *of_row,
                            wx[c][if SKEWED { part } else { 0 }],
                        ));
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
