//! Tiers with AVX-512: a line of the cache is a register.

use super::wide::{Wide, compiled, lines_of};
use super::{Above, Folded, Tiers, Weights, firsts};
use crate::splat::records::apart::{Apart, Each, Layers};
use crate::splat::records::{Line, MOST, Recorded, Splat, Table};
use crate::splat::{Accumulate, Tap};
use std::arch::x86_64::*;

/// Sums of 16 bits, of four channels.
pub(super) struct Shorts;

/// Sums of 32 bits, of `C` channels.
pub(super) struct Longs<const C: usize>;

compiled!("avx512f,avx512vl,avx512dq,avx512bw,popcnt,bmi2");

/// Which of the weights from `chunk` times `of` on are those of a footprint of `len` columns that begins at
/// `shift`.
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

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,popcnt")]
    unsafe fn fold<const N: usize>(
        tiers: &Tiers<'_, i16, N>,
        above: [Above<'_, i16>; 2],
        _: f32,
        open: u64,
        to: &mut Folded<i16>,
    ) -> u64 {
        let (lines, wide) = (lines_of(tiers, &above), tiers.shape.wide);
        let order = [
            _mm512_setr_epi64(0, 8, 1, 9, 2, 10, 3, 11),
            _mm512_setr_epi64(4, 12, 5, 13, 6, 14, 7, 15),
        ];
        let extinction = _mm512_set1_epi64(0xffff);
        let mut filled = 0;
        let [(_, here), (_, behind)] = above;
        let four = here.first_chunk::<4>().zip(behind.first_chunk::<4>());
        let four = four.filter(|_| here.len().max(behind.len()) == 4).map(|(here, behind)| {
            let all = |weights: &[i16; 4]| weights.map(|w| _mm512_set1_epi16(w));
            [all(here), all(behind)]
        });
        let mut left = firsts::<i16>(open);
        while left != 0 {
            let eight = left.trailing_zeros() as usize / 8;
            left &= left - 1;
            let here = (open >> (8 * eight)) as u8;
            let mut sums = [_mm512_setzero_si512(); 2];
            for sheet in 0..2 {
                let (begin, weights) = above[sheet];
                let mut line = begin as usize + eight;
                let mut add = |wy: __m512i| {
                    // SAFETY: eight pixels of 64 in a tier that is there are a line.
                    let row = unsafe { _mm512_load_si512(lines.add(line).cast()) };
                    line += wide;
                    let row = _mm512_mulhrs_epi16(row, wy);
                    sums[sheet] = _mm512_adds_epi16(sums[sheet], row);
                };
                match &four {
                    // A loop of known length.
                    Some(four) => four[sheet].iter().for_each(|&wy| add(wy)),
                    None => weights.iter().for_each(|&wy| add(_mm512_set1_epi16(wy))),
                }
            }
            let some = _mm512_mask_test_epi64_mask(here, sums[0], extinction);
            let sums = [
                _mm512_maskz_compress_epi64(some, sums[0]),
                _mm512_maskz_compress_epi64(some, sums[1]),
            ];
            let room = to.records[to.n..].first_chunk_mut::<8>().expect("room for eight");
            let at: *mut __m512i = room.as_mut_ptr().cast();
            for (i, order) in order.iter().enumerate() {
                // SAFETY: eight records of 16 bytes are two registers.
                unsafe {
                    let both = _mm512_permutex2var_epi64(sums[0], *order, sums[1]);
                    _mm512_storeu_si512(at.add(i), both);
                }
            }
            to.n += some.count_ones() as usize;
            filled |= u64::from(some) << (8 * eight);
        }
        filled
    }
}

impl<S, const C: usize> Wide<S> for Longs<C>
where
    S: Recorded<Payload = [f32; C], Depth = f32, Pixel = [i32; C]> + Accumulate<Weight = Tap>,
{
    type Register = __m512;
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

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,popcnt,bmi2")]
    unsafe fn fold<const N: usize>(
        tiers: &Tiers<'_, S, N>,
        above: [Above<'_, Tap>; 2],
        spread: f32,
        open: u64,
        to: &mut Folded<S>,
    ) -> u64 {
        const { assert!(C == 2 || C == 4) };
        let (lines, wide) = (lines_of(tiers, &above), tiers.shape.wide);
        let order = if C == 2 {
            [
                _mm512_setr_epi64(0, 8, 1, 9, 2, 10, 3, 11),
                _mm512_setr_epi64(4, 12, 5, 13, 6, 14, 7, 15),
            ]
        } else {
            [
                _mm512_setr_epi64(0, 1, 8, 9, 2, 3, 10, 11),
                _mm512_setr_epi64(4, 5, 12, 13, 6, 7, 14, 15),
            ]
        };
        // The pixels of a line, and its words that are extinctions.
        let (pixels, words) = (16 / C, if C == 2 { 0x5555 } else { 0x1111 });
        let mut filled = 0;
        let [(_, here), (_, behind)] = above;
        let four = here.first_chunk::<4>().zip(behind.first_chunk::<4>());
        let four = four.filter(|_| here.len().max(behind.len()) == 4).map(|(here, behind)| {
            let all = |weights: &[Tap; 4]| weights.map(|w| _mm512_set1_ps(w.0 * spread));
            [all(here), all(behind)]
        });
        let most = _mm512_set1_ps(crate::splat::LARGEST);
        let mut left = firsts::<S>(open);
        while left != 0 {
            let group = left.trailing_zeros() as usize / pixels;
            left &= left - 1;
            let here = open >> (pixels * group) & ((1 << pixels) - 1);
            let mut whole = [_mm512_setzero_si512(); 2];
            for sheet in 0..2 {
                let (begin, weights) = above[sheet];
                let mut sums = _mm512_setzero_ps();
                let mut line = begin as usize + group;
                let mut add = |wy: __m512| {
                    // SAFETY: a tier that is there has so many lines.
                    let row = unsafe { _mm512_load_si512(lines.add(line).cast()) };
                    line += wide;
                    let row = _mm512_mul_ps(_mm512_cvtepi32_ps(row), wy);
                    sums = _mm512_add_ps(sums, row);
                };
                match &four {
                    // A loop of known length.
                    Some(four) => four[sheet].iter().for_each(|&wy| add(wy)),
                    None => weights.iter().for_each(|wy| add(_mm512_set1_ps(wy.0 * spread))),
                }
                whole[sheet] = _mm512_cvtps_epi32(_mm512_min_ps(sums, most));
            }
            // A bit for each pixel's extinction, then one for each pixel, and one for each half of it.
            let some = _mm512_mask_test_epi32_mask(words, whole[0], whole[0]);
            let some = _pext_u32(some.into(), words.into()) & here as u32;
            let halves = if C == 2 { some } else { _pdep_u32(some, 0x55) * 3 };
            let whole = [
                _mm512_maskz_compress_epi64(halves as u8, whole[0]),
                _mm512_maskz_compress_epi64(halves as u8, whole[1]),
            ];
            let room = to.records[to.n..].first_chunk_mut::<8>().expect("room for eight");
            let at: *mut __m512i = room.as_mut_ptr().cast();
            for (i, order) in order.iter().enumerate() {
                // SAFETY: eight records are two registers and more.
                unsafe {
                    let both = _mm512_permutex2var_epi64(whole[0], *order, whole[1]);
                    _mm512_storeu_si512(at.add(i), both);
                }
            }
            to.n += some.count_ones() as usize;
            filled |= u64::from(some) << (pixels * group);
        }
        filled
    }
}
