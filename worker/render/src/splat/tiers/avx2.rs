//! Tiers with AVX2: a line of the cache is two registers.

use super::wide::{Wide, compiled, lines_of};
use super::{Above, Folded, SPARE, Tiers, Weights, a_line, firsts_of};
use crate::splat::records::apart::{Apart, Each, Layers};
use crate::splat::records::{Line, MOST, Recorded, Splat, Table};
use crate::splat::{Accumulate, Tap};
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

/// Of lanes from the `i`th on: bits of those from `shift` to where a footprint of `len` columns ends, as the bits that
/// both of these have.
#[inline(always)]
fn window<T>(bits: &[T; 3 * REACH], shift: usize, len: usize, i: usize) -> [&[T; 16]; 2] {
    [REACH - shift + i, 2 * REACH - shift - len + i]
        .map(|from| bits[from..].first_chunk().expect("a footprint is shorter than 64"))
}

/// A register's worth of the weights from `from` less `shift` on, and what lies around them in the table.
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

/// Stores those of four records of 16 bytes that `some` has bits for from the `n`th on, the first half of each from
/// a register, the second half from another. Says how many there are then.
///
/// # Safety
/// There is room for four.
#[target_feature(enable = "avx2")]
#[inline]
unsafe fn store_fours(
    room: *mut __m128i,
    n: usize,
    [here, behind]: [__m256i; 2],
    some: u32,
) -> usize {
    let even = _mm256_unpacklo_epi64(here, behind);
    let odd = _mm256_unpackhi_epi64(here, behind);
    let [b0, b1, b2, b3] = [0, 1, 2, 3].map(|i| (some >> i & 1) as usize);
    let n = [n, n + b0, n + b0 + b1, n + b0 + b1 + b2, n + b0 + b1 + b2 + b3];
    // SAFETY: the caller's.
    unsafe {
        _mm_storeu_si128(room.add(n[0]), _mm256_castsi256_si128(even));
        _mm_storeu_si128(room.add(n[1]), _mm256_castsi256_si128(odd));
        _mm_storeu_si128(room.add(n[2]), _mm256_extracti128_si256::<1>(even));
        _mm_storeu_si128(room.add(n[3]), _mm256_extracti128_si256::<1>(odd));
    }
    n[4]
}

impl Wide<i16> for Shorts {
    type Register = __m256i;
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
    unsafe fn fold<const N: usize>(
        tiers: &Tiers<'_, i16, N>,
        above: [Above<'_, i16>; 2],
        _: f32,
        open: u64,
        to: &mut Folded<i16>,
    ) -> u64 {
        let (first, a_tier) = (lines_of(tiers, &above).cast::<__m256i>(), 2 * tiers.shape.wide);
        let [(_, here), (_, behind)] = above;
        let four = here.first_chunk::<4>().zip(behind.first_chunk::<4>());
        let four = four.filter(|_| here.len().max(behind.len()) == 4).map(|(here, behind)| {
            let all = |weights: &[i16; 4]| weights.map(|w| _mm256_set1_epi16(w));
            [all(here), all(behind)]
        });
        let zero = _mm256_setzero_si256();
        let (mut filled, mut n) = (0, to.n);
        let room = &mut to.records[..n + open.count_ones() as usize + SPARE];
        let room: *mut __m128i = room.as_mut_ptr().cast();
        let mut left = firsts_of(open, 4);
        while left != 0 {
            let x = left.trailing_zeros() as usize;
            left &= left - 1;
            let mut sums = [zero; 2];
            for sheet in 0..2 {
                let (begin, weights) = above[sheet];
                let mut at = 2 * begin as usize + x / 4;
                let mut add = |wy: __m256i| {
                    // SAFETY: four pixels of 64 in a tier that is there are a register.
                    let row = unsafe { _mm256_load_si256(first.add(at)) };
                    at += a_tier;
                    sums[sheet] = _mm256_adds_epi16(sums[sheet], _mm256_mulhrs_epi16(row, wy));
                };
                match &four {
                    // A loop of known length.
                    Some(four) => four[sheet].iter().for_each(|&wy| add(wy)),
                    None => weights.iter().for_each(|&wy| add(_mm256_set1_epi16(wy))),
                }
            }
            // A sign for each pixel without extinction, which comes first.
            let nothing = _mm256_slli_epi64::<48>(_mm256_cmpeq_epi16(sums[0], zero));
            let nothing = _mm256_movemask_pd(_mm256_castsi256_pd(nothing)) as u32;
            let some = (open >> x) as u32 & !nothing & 0xf;
            // SAFETY: no more are kept than there are open pixels, and four are stored where the next one goes.
            n = unsafe { store_fours(room, n, sums, some) };
            filled |= u64::from(some) << x;
        }
        to.n = n;
        filled
    }
}

impl<S, const C: usize> Wide<S> for Longs<C>
where
    S: Recorded<Payload = [f32; C], Depth = f32, Pixel = [i32; C]> + Accumulate<Weight = Tap>,
{
    type Register = __m256;
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
    unsafe fn fold<const N: usize>(
        tiers: &Tiers<'_, S, N>,
        above: [Above<'_, Tap>; 2],
        spread: f32,
        open: u64,
        to: &mut Folded<S>,
    ) -> u64 {
        const { assert!(C == 2 || C == 4) };
        let (first, a_tier) = (lines_of(tiers, &above).cast::<__m256i>(), 2 * tiers.shape.wide);
        let [(_, here), (_, behind)] = above;
        let four = here.first_chunk::<4>().zip(behind.first_chunk::<4>());
        let four = four.filter(|_| here.len().max(behind.len()) == 4).map(|(here, behind)| {
            let all = |weights: &[Tap; 4]| weights.map(|w| _mm256_set1_ps(w.0 * spread));
            [all(here), all(behind)]
        });
        let (most, zero) = (_mm256_set1_ps(crate::splat::LARGEST), _mm256_setzero_si256());
        let (mut filled, mut n) = (0, to.n);
        let room = &mut to.records[..n + open.count_ones() as usize + SPARE];
        let room: *mut [S::Pixel; 2] = room.as_mut_ptr();
        let mut left = firsts_of(open, a_line::<S>() / 2);
        while left != 0 {
            let x = left.trailing_zeros() as usize;
            left &= left - 1;
            let mut whole = [zero; 2];
            for sheet in 0..2 {
                let (begin, weights) = above[sheet];
                let mut at = 2 * begin as usize + x / (a_line::<S>() / 2);
                let mut sums = _mm256_setzero_ps();
                let mut add = |wy: __m256| {
                    // SAFETY: a tier that is there has so many registers.
                    let row = unsafe { _mm256_load_si256(first.add(at)) };
                    at += a_tier;
                    sums = _mm256_add_ps(sums, _mm256_mul_ps(_mm256_cvtepi32_ps(row), wy));
                };
                match &four {
                    // A loop of known length.
                    Some(four) => four[sheet].iter().for_each(|&wy| add(wy)),
                    None => weights.iter().for_each(|wy| add(_mm256_set1_ps(wy.0 * spread))),
                }
                whole[sheet] = _mm256_cvtps_epi32(_mm256_min_ps(sums, most));
            }
            let nothing = _mm256_cmpeq_epi32(whole[0], zero);
            let nothing = _mm256_movemask_ps(_mm256_castsi256_ps(nothing)) as u32;
            let [here, behind] = whole;
            // SAFETY: no more are kept than there are open pixels, and two or four are stored where the next one goes.
            unsafe {
                if C == 4 {
                    let some = (open >> x) as u32 & (!nothing & 1 | (!nothing >> 4 & 1) << 1);
                    _mm256_storeu_si256(
                        room.add(n).cast(),
                        _mm256_permute2x128_si256::<0x20>(here, behind),
                    );
                    n += (some & 1) as usize;
                    _mm256_storeu_si256(
                        room.add(n).cast(),
                        _mm256_permute2x128_si256::<0x31>(here, behind),
                    );
                    n += (some >> 1) as usize;
                    filled |= u64::from(some) << x;
                } else {
                    // Extinctions are every other number.
                    let there = !nothing & 0x55;
                    let there = (there | there >> 1) & 0x33;
                    let some = (open >> x) as u32 & (there | there >> 2) & 0xf;
                    n = store_fours(room.cast(), n, [here, behind], some);
                    filled |= u64::from(some) << x;
                }
            }
        }
        to.n = n;
        filled
    }
}
