//! Row records with AVX2: a line of the cache is two registers.

use super::wide::{Pixels, Wide, compiled};
use super::{Ends, FOUR, Folded, Tiers, Weights};
use crate::kernels::lanes::BESIDE;
use crate::kernels::pixel_records::sheet_offsets::{Apart, Each, Layers};
use crate::kernels::pixel_records::{Line, MOST, Recorded, Splat, Table};
use crate::kernels::{Accumulate, Tap};
use std::arch::x86_64::*;

/// Sums of 16 bits, of four channels.
pub(super) struct Shorts;

/// Sums of 32 bits, of `C` channels.
pub(super) struct Longs<const C: usize>;

compiled!("avx2");

/// Columns of a chunk of weights of 16 bits, and of 32.
const SHORTS: usize = 16;
const LONGS: usize = 8;

macro_rules! bits_of {
    ($number:ty) => {{
        let mut bits = [0; 3 * REACH];
        let mut i = REACH;
        while i < 2 * REACH {
            bits[i] = !(0 as $number);
            i += 1;
        }
        bits
    }};
}

/// Longer than a footprint, where it begins in a register, and a register beyond that.
const REACH: usize = 96;

/// No bits, then all, then none.
static SHORT_BITS: [i16; 3 * REACH] = bits_of!(i16);
static LONG_BITS: [i32; 3 * REACH] = bits_of!(i32);

/// Of lanes from the `i`th on: bits of those from `shift` to where a footprint of `len` columns
/// ends, as the bits that both of these have.
#[inline(always)]
fn window<T>(bits: &[T; 3 * REACH], shift: usize, len: usize, i: usize) -> [&[T; 16]; 2] {
    [REACH - shift + i, 2 * REACH - shift - len + i]
        .map(|from| bits[from..].first_chunk().expect("a footprint is shorter than 64"))
}

/// A register's worth of the weights from `from` less `shift` on, and what lies around them in the
/// table.
#[inline(always)]
fn around<T: Copy + Default, const LEN: usize>(
    table: &[T],
    from: usize,
    shift: usize,
    chunk: usize,
) -> [T; LEN] {
    let begin = (from + chunk * LEN).wrapping_sub(shift);
    match table.get(begin..begin.wrapping_add(LEN)) {
        Some(all) => *all.first_chunk().expect("as long"),
        // At the table's ends.
        None => {
            std::array::from_fn(|i| table.get(begin.wrapping_add(i)).copied().unwrap_or_default())
        }
    }
}

impl Wide<i16> for Shorts {
    type Register = __m256i;
    type Sums = __m256i;
    type Down = __m256i;
    const OF_LINE: usize = 2;
    const CHUNK: usize = 4;
    const BY_SHEET: bool = true;

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn payload(payload: &u64) -> __m256i {
        _mm256_set1_epi64x(*payload as i64)
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn section(payload: __m256i, wz: i16) -> __m256i {
        _mm256_mulhrs_epi16(payload, _mm256_set1_epi16(wz))
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn spread<const GROUPS: usize>(
        Table { weights: table, len }: &Table<'_, i16>,
        from: usize,
        shift: usize,
        chunk: usize,
    ) -> [__m256i; GROUPS] {
        const { assert!(GROUPS <= 4) };
        let around: [i16; SHORTS] = around(table, from, shift, chunk);
        let [begun, left] = window(&SHORT_BITS, shift, *len, chunk * SHORTS);
        let eight = |half: usize| {
            // SAFETY: eight weights of sixteen are 16 bytes.
            let load = |of: &[i16; 16]| unsafe { _mm_loadu_si128(of[8 * half..].as_ptr().cast()) };
            let there = _mm_and_si128(load(begun), load(left));
            _mm256_broadcastsi128_si256(_mm_and_si128(load(&around), there))
        };
        let halves = [eight(0), if GROUPS > 2 { eight(1) } else { _mm256_setzero_si256() }];
        let turns = [
            _mm256_setr_epi8(
                0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3, 4, 5, 4, 5, 4, 5, 4, 5, 6, 7, 6, 7,
                6, 7, 6, 7,
            ),
            _mm256_setr_epi8(
                8, 9, 8, 9, 8, 9, 8, 9, 10, 11, 10, 11, 10, 11, 10, 11, 12, 13, 12, 13, 12, 13, 12,
                13, 14, 15, 14, 15, 14, 15, 14, 15,
            ),
        ];
        let mut spread = [_mm256_setzero_si256(); GROUPS];
        for (g, spread) in spread.iter_mut().enumerate() {
            *spread = _mm256_shuffle_epi8(halves[g / 2], turns[g % 2]);
        }
        spread
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn add<const GROUPS: usize>(
        lines: *mut Line,
        at: usize,
        section: __m256i,
        w: &[__m256i; GROUPS],
    ) {
        for (g, w) in w.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            unsafe {
                let at = lines.cast::<__m256i>().add(at + g);
                let sums = _mm256_load_si256(at);
                let sums = _mm256_adds_epi16(sums, _mm256_mulhrs_epi16(section, *w));
                _mm256_store_si256(at, sums);
            }
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn weight(w: i16) -> __m256i {
        _mm256_set1_epi16(w)
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn down(
        lines: *const Line,
        at: usize,
        a_tier: usize,
        weights: &[__m256i; FOUR],
    ) -> __m256i {
        let mut sums = _mm256_setzero_si256();
        for (i, w) in weights.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            let row = unsafe { _mm256_load_si256(lines.cast::<__m256i>().add(at + i * a_tier)) };
            sums = _mm256_adds_epi16(sums, _mm256_mulhrs_epi16(row, *w));
        }
        sums
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn down_all(lines: *const Line, at: usize, a_tier: usize, weights: &[i16]) -> __m256i {
        let mut sums = _mm256_setzero_si256();
        for (i, w) in weights.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            let row = unsafe { _mm256_load_si256(lines.cast::<__m256i>().add(at + i * a_tier)) };
            sums = _mm256_adds_epi16(sums, _mm256_mulhrs_epi16(row, _mm256_set1_epi16(*w)));
        }
        sums
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn filled(sums: __m256i) -> u32 {
        // A sign for each pixel without extinction, which comes first.
        let nothing = _mm256_cmpeq_epi16(sums, _mm256_setzero_si256());
        let nothing = _mm256_castsi256_pd(_mm256_slli_epi64::<48>(nothing));
        !_mm256_movemask_pd(nothing) as u32
    }
}

impl<S, const C: usize> Wide<S> for Longs<C>
where
    S: Recorded<Payload = [f32; C], Depth = f32, Pixel = [i32; C]> + Accumulate<Weight = Tap>,
{
    type Register = __m256;
    type Sums = __m256i;
    type Down = __m256;
    const OF_LINE: usize = 2;
    const CHUNK: usize = C;
    const BY_SHEET: bool = true;

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn payload(payload: &[f32; C]) -> __m256 {
        let four: [f32; 4] = std::array::from_fn(|i| payload[i % C]);
        // SAFETY: four floats are 16 bytes.
        let four = unsafe { _mm_loadu_ps(four.as_ptr()) };
        _mm256_set_m128(four, four)
    }

    /// Not negative.
    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn section(payload: __m256, wz: f32) -> __m256 {
        _mm256_max_ps(_mm256_mul_ps(payload, _mm256_set1_ps(wz)), _mm256_setzero_ps())
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn spread<const GROUPS: usize>(
        Table { weights: table, len }: &Table<'_, Tap>,
        from: usize,
        shift: usize,
        chunk: usize,
    ) -> [__m256; GROUPS] {
        let around: [Tap; LONGS] = around(table, from, shift, chunk);
        let bits = window(&LONG_BITS, shift, *len, chunk * LONGS);
        // SAFETY: eight weights are 32 bytes, and so are eight numbers.
        let w = unsafe {
            let [begun, left] = bits.map(|bits| _mm256_loadu_ps(bits.as_ptr().cast()));
            _mm256_and_ps(_mm256_loadu_ps(around.as_ptr().cast()), _mm256_and_ps(begun, left))
        };
        let lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
        let each =
            if C == 4 { _mm256_srli_epi32::<2>(lanes) } else { _mm256_srli_epi32::<1>(lanes) };
        let mut spread = [w; GROUPS];
        for (g, spread) in spread.iter_mut().enumerate() {
            let which = _mm256_add_epi32(each, _mm256_set1_epi32((8 / C * g) as i32));
            *spread = _mm256_permutevar8x32_ps(w, which);
        }
        spread
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn add<const GROUPS: usize>(
        lines: *mut Line,
        at: usize,
        section: __m256,
        w: &[__m256; GROUPS],
    ) {
        for (g, w) in w.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            unsafe {
                let at = lines.cast::<__m256i>().add(at + g);
                let add = _mm256_cvtps_epi32(_mm256_mul_ps(section, *w));
                _mm256_store_si256(at, _mm256_add_epi32(_mm256_load_si256(at), add));
            }
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn weight(w: Tap) -> __m256 {
        _mm256_set1_ps(w.0)
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn down(
        lines: *const Line,
        at: usize,
        a_tier: usize,
        weights: &[__m256; FOUR],
    ) -> __m256i {
        let mut sums = _mm256_setzero_ps();
        for (i, w) in weights.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            let row = unsafe { _mm256_load_si256(lines.cast::<__m256i>().add(at + i * a_tier)) };
            sums = _mm256_add_ps(sums, _mm256_mul_ps(_mm256_cvtepi32_ps(row), *w));
        }
        _mm256_cvtps_epi32(_mm256_min_ps(sums, _mm256_set1_ps(crate::kernels::LARGEST)))
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn down_all(lines: *const Line, at: usize, a_tier: usize, weights: &[Tap]) -> __m256i {
        let mut sums = _mm256_setzero_ps();
        for (i, w) in weights.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            let row = unsafe { _mm256_load_si256(lines.cast::<__m256i>().add(at + i * a_tier)) };
            let row = _mm256_mul_ps(_mm256_cvtepi32_ps(row), _mm256_set1_ps(w.0));
            sums = _mm256_add_ps(sums, row);
        }
        _mm256_cvtps_epi32(_mm256_min_ps(sums, _mm256_set1_ps(crate::kernels::LARGEST)))
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn filled(sums: __m256i) -> u32 {
        const { assert!(C == 2 || C == 4) };
        let nothing = _mm256_cmpeq_epi32(sums, _mm256_setzero_si256());
        let some = !_mm256_movemask_ps(_mm256_castsi256_ps(nothing)) as u32;
        // Extinctions are every other number, or every fourth.
        if C == 2 {
            let pairs = some & 1 | (some >> 2 & 1) << 1;
            pairs | (some >> 4 & 1) << 2 | (some >> 6 & 1) << 3
        } else {
            some & 1 | (some >> 4 & 1) << 1
        }
    }
}

/// A bit for each word of pixels that have so many.
#[inline(always)]
fn words_of(words: usize, pixels: u32) -> u32 {
    // Four of two, or two of four.
    if words == 2 {
        let [first, last] = [pixels & 3, pixels >> 2 & 3];
        (first & 1 | (first >> 1) << 2 | (last & 1) << 4 | (last >> 1) << 6) * 3
    } else {
        (pixels & 1 | (pixels >> 1 & 1) << 4) * 15
    }
}

impl Pixels for __m256i {
    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn exchange(self, words: usize, to: *mut u32, which: u32) -> __m256i {
        let each = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
        let bits = _mm256_set1_epi32(words_of(words, which) as i32);
        let marks = _mm256_cmpeq_epi32(_mm256_and_si256(bits, each), each);
        // SAFETY: the caller's.
        unsafe {
            let old = _mm256_loadu_si256(to.cast());
            _mm256_storeu_si256(to.cast(), self);
            _mm256_and_si256(old, marks)
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn store_beside(self, words: usize, to: *mut u32, which: u32) {
        let order = BESIDE[words_of(words, which) as usize % 256] as i64;
        let order = _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(order));
        // SAFETY: the caller's.
        unsafe { _mm256_storeu_si256(to.cast(), _mm256_permutevar8x32_epi32(self, order)) };
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn store_places(
        words: usize,
        which: u32,
        fours: *const [u32; 4],
        opacities: *mut f32,
        at: u32,
        places: *mut u32,
    ) {
        let mut n = 0;
        for i in 0..8 / words {
            // SAFETY: the caller's.
            unsafe {
                *opacities.add(n) = f32::from_bits((*fours.add(i))[0]);
                *places.add(n) = at + i as u32;
            }
            n += (which >> i & 1) as usize;
        }
    }
}
