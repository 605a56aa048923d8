//! Row records with AVX-512: a line of the cache is a register.

use super::wide::{Pixels, Wide, compiled};
use super::{Ends, FOUR, Folded, Tiers, Weights};
use crate::kernels::pixel_records::sheet_offsets::{Apart, Each, Layers};
use crate::kernels::pixel_records::{Line, MOST, Recorded, Splat, Table};
use crate::kernels::{Accumulate, Tap};
use std::arch::x86_64::*;

/// Sums of 16 bits, of four channels.
pub(super) struct Shorts;

/// Sums of 32 bits, of `C` channels.
pub(super) struct Longs<const C: usize>;

compiled!("avx512f,avx512vl,avx512dq,avx512bw,popcnt,bmi2");

/// Returns which of the weights from `chunk` times `of` on belong to a footprint of `len` columns
/// that begins at `shift`.
#[inline(always)]
fn present(len: usize, shift: usize, chunk: usize, of: usize) -> u64 {
    let len_mask = (1u64 << len) - 1;
    if chunk == 0 {
        len_mask << shift
    } else {
        (u128::from(len_mask) << shift >> (chunk * of)) as u64
    }
}

impl Wide<i16> for Shorts {
    type Register = __m512i;
    type Sums = __m512i;
    type Down = __m512i;
    const OF_LINE: usize = 1;
    const CHUNK: usize = 4;
    const BY_SHEET: bool = false;

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn payload(payload: &u64) -> __m512i {
        _mm512_set1_epi64(*payload as i64)
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn section(payload: __m512i, wz: i16) -> __m512i {
        _mm512_mulhrs_epi16(payload, _mm512_set1_epi16(wz))
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn spread<const GROUPS: usize>(
        table: &Table<'_, i16>,
        from: usize,
        shift: usize,
        chunk: usize,
    ) -> [__m512i; GROUPS] {
        const COLUMNS: usize = 32;
        let row = table.row(from);
        let present = present(table.len, shift, chunk, COLUMNS) as u32;
        let from = row.as_ptr().wrapping_sub(shift).wrapping_add(chunk * COLUMNS);
        // SAFETY: present are those of the row, and no others are read.
        let w = unsafe { _mm512_maskz_loadu_epi16(present, from) };
        let each = _mm512_set_epi16(
            7, 7, 7, 7, 6, 6, 6, 6, 5, 5, 5, 5, 4, 4, 4, 4, 3, 3, 3, 3, 2, 2, 2, 2, 1, 1, 1, 1, 0,
            0, 0, 0,
        );
        let mut spread = [w; GROUPS];
        for (g, spread) in spread.iter_mut().enumerate() {
            let which = _mm512_add_epi16(each, _mm512_set1_epi16(8 * g as i16));
            *spread = _mm512_permutexvar_epi16(which, w);
        }
        spread
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn add<const GROUPS: usize>(
        lines: *mut Line,
        at: usize,
        section: __m512i,
        w: &[__m512i; GROUPS],
    ) {
        for (g, w) in w.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            unsafe {
                let at: *mut __m512i = lines.add(at + g).cast();
                let sums = _mm512_load_si512(at);
                let sums = _mm512_adds_epi16(sums, _mm512_mulhrs_epi16(section, *w));
                _mm512_store_si512(at, sums);
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn weight(w: i16) -> __m512i {
        _mm512_set1_epi16(w)
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn down(
        lines: *const Line,
        at: usize,
        a_tier: usize,
        weights: &[__m512i; FOUR],
    ) -> __m512i {
        let mut sums = _mm512_setzero_si512();
        for (i, w) in weights.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            let row = unsafe { _mm512_load_si512(lines.add(at + i * a_tier).cast()) };
            sums = _mm512_adds_epi16(sums, _mm512_mulhrs_epi16(row, *w));
        }
        sums
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn down_all(lines: *const Line, at: usize, a_tier: usize, weights: &[i16]) -> __m512i {
        let mut sums = _mm512_setzero_si512();
        for (i, w) in weights.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            let row = unsafe { _mm512_load_si512(lines.add(at + i * a_tier).cast()) };
            sums = _mm512_adds_epi16(sums, _mm512_mulhrs_epi16(row, _mm512_set1_epi16(*w)));
        }
        sums
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn filled(sums: __m512i) -> u32 {
        // Extinction comes first.
        _mm512_test_epi64_mask(sums, _mm512_set1_epi64(0xffff)).into()
    }
}

impl<S, const C: usize> Wide<S> for Longs<C>
where
    S: Recorded<Payload = [f32; C], Depth = f32, Pixel = [i32; C]> + Accumulate<Weight = Tap>,
{
    type Register = __m512;
    type Sums = __m512i;
    type Down = __m512;
    const OF_LINE: usize = 1;
    const CHUNK: usize = C;
    const BY_SHEET: bool = false;

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn payload(payload: &[f32; C]) -> __m512 {
        let four: [f32; 4] = std::array::from_fn(|i| payload[i % C]);
        // SAFETY: four floats are 16 bytes.
        _mm512_broadcast_f32x4(unsafe { _mm_loadu_ps(four.as_ptr()) })
    }

    /// Not negative.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn section(payload: __m512, wz: f32) -> __m512 {
        _mm512_max_ps(_mm512_mul_ps(payload, _mm512_set1_ps(wz)), _mm512_setzero_ps())
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn spread<const GROUPS: usize>(
        table: &Table<'_, Tap>,
        from: usize,
        shift: usize,
        chunk: usize,
    ) -> [__m512; GROUPS] {
        const COLUMNS: usize = 16;
        let row = table.row(from);
        let present = present(table.len, shift, chunk, COLUMNS) as u16;
        let from = row.as_ptr().wrapping_sub(shift).wrapping_add(chunk * COLUMNS);
        // SAFETY: present are those of the row, and no others are read.
        let w = unsafe { _mm512_maskz_loadu_ps(present, from.cast()) };
        let lanes = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        let each =
            if C == 4 { _mm512_srli_epi32::<2>(lanes) } else { _mm512_srli_epi32::<1>(lanes) };
        let mut spread = [w; GROUPS];
        for (g, spread) in spread.iter_mut().enumerate() {
            let which = _mm512_add_epi32(each, _mm512_set1_epi32((16 / C * g) as i32));
            *spread = _mm512_permutexvar_ps(which, w);
        }
        spread
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn add<const GROUPS: usize>(
        lines: *mut Line,
        at: usize,
        section: __m512,
        w: &[__m512; GROUPS],
    ) {
        for (g, w) in w.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            unsafe {
                let at: *mut __m512i = lines.add(at + g).cast();
                let add = _mm512_cvtps_epi32(_mm512_mul_ps(section, *w));
                _mm512_store_si512(at, _mm512_add_epi32(_mm512_load_si512(at), add));
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn weight(w: Tap) -> __m512 {
        _mm512_set1_ps(w.0)
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn down(
        lines: *const Line,
        at: usize,
        a_tier: usize,
        weights: &[__m512; FOUR],
    ) -> __m512i {
        let mut sums = _mm512_setzero_ps();
        for (i, w) in weights.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            let row = unsafe { _mm512_load_si512(lines.add(at + i * a_tier).cast()) };
            sums = _mm512_add_ps(sums, _mm512_mul_ps(_mm512_cvtepi32_ps(row), *w));
        }
        _mm512_cvtps_epi32(_mm512_min_ps(sums, _mm512_set1_ps(crate::kernels::LARGEST)))
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn down_all(lines: *const Line, at: usize, a_tier: usize, weights: &[Tap]) -> __m512i {
        let mut sums = _mm512_setzero_ps();
        for (i, w) in weights.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            let row = unsafe { _mm512_load_si512(lines.add(at + i * a_tier).cast()) };
            let row = _mm512_mul_ps(_mm512_cvtepi32_ps(row), _mm512_set1_ps(w.0));
            sums = _mm512_add_ps(sums, row);
        }
        _mm512_cvtps_epi32(_mm512_min_ps(sums, _mm512_set1_ps(crate::kernels::LARGEST)))
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,bmi2")]
    #[inline]
    unsafe fn filled(sums: __m512i) -> u32 {
        const { assert!(C == 2 || C == 4) };
        // Extinction comes first.
        let words = if C == 2 { 0x5555 } else { 0x1111 };
        _pext_u32(_mm512_mask_test_epi32_mask(words, sums, sums).into(), words.into())
    }
}

/// A bit for each eight bytes of pixels that have so many words.
#[target_feature(enable = "bmi2")]
#[inline]
fn halves(words: usize, pixels: u32) -> u8 {
    if words == 2 { pixels as u8 } else { (_pdep_u32(pixels, 0x55) * 3) as u8 }
}

impl Pixels for __m512i {
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,bmi2")]
    #[inline]
    unsafe fn exchange(self, words: usize, to: *mut u32, which: u32) -> __m512i {
        // SAFETY: the caller's.
        unsafe {
            let old = _mm512_maskz_loadu_epi64(halves(words, which), to.cast());
            _mm512_storeu_si512(to.cast(), self);
            old
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,bmi2")]
    #[inline]
    unsafe fn store_beside(self, words: usize, to: *mut u32, which: u32) {
        let some = _mm512_maskz_compress_epi64(halves(words, which), self);
        // SAFETY: the caller's.
        unsafe { _mm512_storeu_si512(to.cast(), some) };
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,bmi2")]
    #[inline]
    unsafe fn store_places(
        words: usize,
        which: u32,
        fours: *const [u32; 4],
        opacities: *mut f32,
        at: u32,
        places: *mut u32,
    ) {
        let eight = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
        let from = _mm256_add_epi32(_mm256_set1_epi32(at as i32), eight);
        let from = _mm256_maskz_compress_epi32(which as u8, from);
        // SAFETY: the caller's: eight or four of each.
        unsafe {
            let first = _mm512_loadu_si512(fours.cast());
            if words == 2 {
                let of = _mm512_setr_epi32(0, 4, 8, 12, 16, 20, 24, 28, 0, 0, 0, 0, 0, 0, 0, 0);
                let second = _mm512_loadu_si512(fours.add(4).cast());
                let all = _mm512_castsi512_si256(_mm512_permutex2var_epi32(first, of, second));
                let some = _mm256_maskz_compress_epi32(which as u8, all);
                _mm256_storeu_si256(opacities.cast(), some);
                _mm256_storeu_si256(places.cast(), from);
            } else {
                let some = _mm512_maskz_compress_epi32(_pdep_u32(which, 0x1111) as u16, first);
                _mm_storeu_si128(opacities.cast(), _mm512_castsi512_si128(some));
                _mm_storeu_si128(places.cast(), _mm256_castsi256_si128(from));
            }
        }
    }
}
