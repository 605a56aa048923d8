//! Eight lanes of AVX2 and sixteen of AVX-512.

use super::{BESIDE, Floats, Lanes, SPREAD, first};
use crate::kernels::by_column;
use std::arch::x86_64::*;

/// Returns where the numbers of place `*at` begin.
///
/// # Safety
/// They are there.
#[inline(always)]
unsafe fn place(from: *const u32, stride: usize, at: *const u32) -> *const __m128i {
    // SAFETY: the caller's.
    unsafe { from.add(*at as usize * stride).cast() }
}

/// Two numbers from each of two.
///
/// # Safety
/// They are there.
#[inline(always)]
unsafe fn two_twos([a, b]: [*const u32; 2], stride: usize, at: *const u32) -> __m128i {
    // SAFETY: the caller's, and every machine has these instructions.
    unsafe {
        let (a, b) = (place(a, stride, at), place(b, stride, at));
        _mm_unpacklo_epi64(_mm_loadl_epi64(a), _mm_loadl_epi64(b))
    }
}

/// Two numbers from each of two places.
///
/// # Safety
/// They are there.
#[inline(always)]
unsafe fn two_twos_of(from: *const u32, at: [*const u32; 2]) -> __m128i {
    // SAFETY: the caller's, and every machine has these instructions.
    unsafe {
        let [a, b] = at.map(|at| place(from, 2, at));
        _mm_unpacklo_epi64(_mm_loadl_epi64(a), _mm_loadl_epi64(b))
    }
}

/// Eight lanes, with AVX2.
pub(crate) struct Eight;

impl Eight {
    /// Lanes of `a` in the order that a table says.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn ordered(order: u64, a: __m256i) -> __m256i {
        let order = _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(order as i64));
        _mm256_permutevar8x32_epi32(a, order)
    }

    /// Four by four in each half, turned over.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn turned(p: [__m256i; 4]) -> [__m256i; 4] {
        let low = [_mm256_unpacklo_epi32(p[0], p[1]), _mm256_unpacklo_epi32(p[2], p[3])];
        let high = [_mm256_unpackhi_epi32(p[0], p[1]), _mm256_unpackhi_epi32(p[2], p[3])];
        [
            _mm256_unpacklo_epi64(low[0], low[1]),
            _mm256_unpackhi_epi64(low[0], low[1]),
            _mm256_unpacklo_epi64(high[0], high[1]),
            _mm256_unpackhi_epi64(high[0], high[1]),
        ]
    }
}

impl Lanes for Eight {
    const LANES: usize = 8;
    type Ints = __m256i;
    /// All bits of a lane, or none.
    type Marks = __m256i;

    with! { "avx2"
        fn set(n: i32) -> __m256i { _mm256_set1_epi32(n) }
        fn from(n: i32) -> __m256i {
            _mm256_add_epi32(_mm256_set1_epi32(n), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7))
        }
        fn load(at: *const u32) -> __m256i {
            // SAFETY: the caller has eight numbers there.
            unsafe { _mm256_loadu_si256(at.cast()) }
        }
        fn store(to: *mut u32, a: __m256i) {
            // SAFETY: the caller has room for eight there.
            unsafe { _mm256_storeu_si256(to.cast(), a) }
        }
        fn plus(a: __m256i, b: __m256i) -> __m256i { _mm256_add_epi32(a, b) }
        fn minus(a: __m256i, b: __m256i) -> __m256i { _mm256_sub_epi32(a, b) }
        fn times(a: __m256i, b: __m256i) -> __m256i { _mm256_mullo_epi32(a, b) }
        fn and(a: __m256i, b: __m256i) -> __m256i { _mm256_and_si256(a, b) }
        fn without(a: __m256i, b: __m256i) -> __m256i { _mm256_andnot_si256(a, b) }
        fn or(a: __m256i, b: __m256i) -> __m256i { _mm256_or_si256(a, b) }
        fn min(a: __m256i, b: __m256i) -> __m256i { _mm256_min_epi32(a, b) }
        fn max(a: __m256i, b: __m256i) -> __m256i { _mm256_max_epi32(a, b) }
        fn up(a: __m256i, bits: u32) -> __m256i { _mm256_sll_epi32(a, _mm_cvtsi32_si128(bits as i32)) }
        fn down(a: __m256i, bits: u32) -> __m256i { _mm256_sra_epi32(a, _mm_cvtsi32_si128(bits as i32)) }
        fn up_each(a: __m256i, b: __m256i) -> __m256i { _mm256_sllv_epi32(a, b) }
        fn less(a: __m256i, b: __m256i) -> __m256i { _mm256_cmpgt_epi32(b, a) }
        fn at_most(a: __m256i, b: __m256i) -> __m256i {
            _mm256_cmpeq_epi32(_mm256_min_epu32(a, b), a)
        }
        fn both(a: __m256i, b: __m256i) -> __m256i { _mm256_and_si256(a, b) }
        fn bits(marks: __m256i) -> u32 { _mm256_movemask_ps(_mm256_castsi256_ps(marks)) as u32 }
        fn marks(bits: u32) -> __m256i {
            let each = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
            _mm256_cmpeq_epi32(_mm256_and_si256(_mm256_set1_epi32(bits as i32), each), each)
        }
        fn one_more(marks: __m256i, a: __m256i) -> __m256i { _mm256_sub_epi32(a, marks) }
        fn look_up(marks: __m256i, table: *const u32, at: __m256i) -> __m256i {
            let zero = _mm256_setzero_si256();
            // SAFETY: the caller says that the table has what is looked up.
            unsafe { _mm256_mask_i32gather_epi32::<4>(zero, table.cast(), at, marks) }
        }
        fn beside(bits: u32, a: __m256i) -> __m256i { Eight::ordered(BESIDE[bits as usize % 256], a) }
        fn spread(bits: u32, a: __m256i) -> __m256i { Eight::ordered(SPREAD[bits as usize % 256], a) }
        fn bytes(items: &[u8]) -> __m256i {
            _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(i64::from_le_bytes(first(items))))
        }
        fn shorts(items: &[u16]) -> __m256i {
            // SAFETY: eight numbers are 16 bytes.
            _mm256_cvtepu16_epi32(unsafe { _mm_loadu_si128(first::<_, 8>(items).as_ptr().cast()) })
        }
        fn floats(items: &[f32]) -> __m256i {
            // SAFETY: eight numbers are 32 bytes.
            unsafe { _mm256_loadu_si256(first::<_, 8>(items).as_ptr().cast()) }
        }
        fn store_fours(to: *mut u32, fours: [__m256i; 4]) {
            // Lanes 0 and 4, 1 and 5, and so on, one a half.
            let [a, b, c, d] = Eight::turned(fours);
            let ordered = [
                _mm256_permute2x128_si256::<0x20>(a, b),
                _mm256_permute2x128_si256::<0x20>(c, d),
                _mm256_permute2x128_si256::<0x31>(a, b),
                _mm256_permute2x128_si256::<0x31>(c, d),
            ];
            for (i, two) in ordered.into_iter().enumerate() {
                // SAFETY: the caller has room for four times eight numbers.
                unsafe { _mm256_storeu_si256(to.add(8 * i).cast(), two) };
            }
        }
        fn fours(from: *const u32, stride: usize, at: *const u32) -> [__m256i; 4] {
            let mut places = [_mm256_setzero_si256(); 4];
            for (i, places) in places.iter_mut().enumerate() {
                // SAFETY: the caller has four numbers at each place.
                *places = unsafe {
                    let low = _mm_loadu_si128(place(from, stride, at.add(i)));
                    let high = _mm_loadu_si128(place(from, stride, at.add(i + 4)));
                    _mm256_set_m128i(high, low)
                };
            }
            Eight::turned(places)
        }
        fn pairs(from: *const u32, at: *const u32) -> [__m256i; 2] {
            let mut places = [_mm256_setzero_ps(); 2];
            for (i, places) in places.iter_mut().enumerate() {
                // SAFETY: the caller has two numbers at each place.
                *places = unsafe {
                    let low = two_twos_of(from, [at.add(2 * i), at.add(2 * i + 1)]);
                    let high = two_twos_of(from, [at.add(2 * i + 4), at.add(2 * i + 5)]);
                    _mm256_castsi256_ps(_mm256_set_m128i(high, low))
                };
            }
            let [low, high] = places;
            [
                _mm256_castps_si256(_mm256_shuffle_ps::<0b10_00_10_00>(low, high)),
                _mm256_castps_si256(_mm256_shuffle_ps::<0b11_01_11_01>(low, high)),
            ]
        }
        fn pairs_on(from: *const u32) -> [__m256i; 2] {
            // SAFETY: the caller has twice eight numbers there.
            let [a, b] = unsafe { [_mm256_loadu_ps(from.cast()), _mm256_loadu_ps(from.add(8).cast())] };
            // Two of each, then in order.
            [_mm256_shuffle_ps::<0b10_00_10_00>(a, b), _mm256_shuffle_ps::<0b11_01_11_01>(a, b)]
                .map(|ints| _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_castps_si256(ints)))
        }
        fn twos(from: [*const u32; 2], stride: usize, at: *const u32) -> [__m256i; 4] {
            let [a, b] = from;
            let mut places = [_mm256_setzero_si256(); 4];
            for (i, places) in places.iter_mut().enumerate() {
                // SAFETY: the caller has two numbers at each place.
                *places = unsafe {
                    let low = two_twos([a, b], stride, at.add(i));
                    let high = two_twos([a, b], stride, at.add(i + 4));
                    _mm256_set_m128i(high, low)
                };
            }
            Eight::turned(places)
        }
        fn store_floats(to: *mut f32, a: __m256i) {
            // SAFETY: the caller has room for eight there.
            unsafe { _mm256_storeu_ps(to, _mm256_cvtepi32_ps(a)) }
        }
        fn bits_of_sums(n: i64, at: *const i64, from: u32) -> __m256i {
            let (n, from) = (_mm256_set1_epi64x(n), _mm_cvtsi32_si128(from as i32));
            // SAFETY: the caller has eight numbers there.
            let (low, high) = unsafe {
                (_mm256_loadu_si256(at.cast()), _mm256_loadu_si256(at.add(4).cast()))
            };
            let low = _mm256_srl_epi64(_mm256_add_epi64(n, low), from);
            let high = _mm256_srl_epi64(_mm256_add_epi64(n, high), from);
            // The lower halves.
            let (low, high) = (_mm256_castsi256_ps(low), _mm256_castsi256_ps(high));
            let both = _mm256_castps_si256(_mm256_shuffle_ps::<0b10_00_10_00>(low, high));
            _mm256_permute4x64_epi64::<0b11_01_10_00>(both)
        }
    }
}

impl Floats for Eight {
    type Floats = __m256;

    with! { "avx2"
        fn all(x: f32) -> __m256 { _mm256_set1_ps(x) }
        fn load_floats(at: *const f32) -> __m256 {
            // SAFETY: the caller has eight numbers there.
            unsafe { _mm256_loadu_ps(at) }
        }
        fn put_floats(to: *mut f32, a: __m256) {
            // SAFETY: the caller has room for eight there.
            unsafe { _mm256_storeu_ps(to, a) }
        }
        fn add(a: __m256, b: __m256) -> __m256 { _mm256_add_ps(a, b) }
        fn sub(a: __m256, b: __m256) -> __m256 { _mm256_sub_ps(a, b) }
        fn mul(a: __m256, b: __m256) -> __m256 { _mm256_mul_ps(a, b) }
        fn div(a: __m256, b: __m256) -> __m256 { _mm256_div_ps(a, b) }
        fn sqrt(a: __m256) -> __m256 { _mm256_sqrt_ps(a) }
        fn least(a: __m256, b: __m256) -> __m256 { _mm256_min_ps(a, b) }
        fn most(a: __m256, b: __m256) -> __m256 { _mm256_max_ps(a, b) }
        fn below(a: __m256, b: __m256) -> __m256i { _mm256_castps_si256(_mm256_cmp_ps::<_CMP_LT_OQ>(a, b)) }
        fn from_on(a: __m256, b: __m256) -> __m256i { _mm256_castps_si256(_mm256_cmp_ps::<_CMP_GE_OQ>(a, b)) }
        fn select(marks: __m256i, yes: __m256, no: __m256) -> __m256 {
            _mm256_blendv_ps(no, yes, _mm256_castsi256_ps(marks))
        }
        fn only(marks: __m256i, a: __m256) -> __m256 { _mm256_and_ps(_mm256_castsi256_ps(marks), a) }
        fn to_bits(a: __m256) -> __m256i { _mm256_castps_si256(a) }
        fn from_bits(a: __m256i) -> __m256 { _mm256_castsi256_ps(a) }
        fn to_floats(a: __m256i) -> __m256 { _mm256_cvtepi32_ps(a) }
        fn truncated(a: __m256) -> __m256i { _mm256_cvttps_epi32(a) }
    }
}

/// Sixteen lanes, with AVX-512.
pub(crate) struct Sixteen;

impl Sixteen {
    /// A bit for each of the first of sixteen that there are.
    #[inline(always)]
    fn there<T>(items: &[T]) -> u16 {
        ((1u32 << items.len().min(16)) - 1) as u16
    }

    /// A register of four quarters.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn quarters(a: __m128i, b: __m128i, c: __m128i, d: __m128i) -> __m512i {
        let low = _mm512_inserti32x4::<1>(_mm512_castsi128_si512(a), b);
        _mm512_inserti32x4::<3>(_mm512_inserti32x4::<2>(low, c), d)
    }

    /// Four by four in each quarter, turned over.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(crate) fn turned(p: [__m512i; 4]) -> [__m512i; 4] {
        let low = [_mm512_unpacklo_epi32(p[0], p[1]), _mm512_unpacklo_epi32(p[2], p[3])];
        let high = [_mm512_unpackhi_epi32(p[0], p[1]), _mm512_unpackhi_epi32(p[2], p[3])];
        [
            _mm512_unpacklo_epi64(low[0], low[1]),
            _mm512_unpackhi_epi64(low[0], low[1]),
            _mm512_unpacklo_epi64(high[0], high[1]),
            _mm512_unpackhi_epi64(high[0], high[1]),
        ]
    }
}

impl Lanes for Sixteen {
    const LANES: usize = 16;
    type Ints = __m512i;
    type Marks = __mmask16;

    with! { "avx512f,avx512vl,avx512dq,avx512bw"
        fn set(n: i32) -> __m512i { _mm512_set1_epi32(n) }
        fn from(n: i32) -> __m512i {
            let lanes = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
            _mm512_add_epi32(_mm512_set1_epi32(n), lanes)
        }
        fn load(at: *const u32) -> __m512i {
            // SAFETY: the caller has sixteen numbers there.
            unsafe { _mm512_loadu_si512(at.cast()) }
        }
        fn store(to: *mut u32, a: __m512i) {
            // SAFETY: the caller has room for sixteen there.
            unsafe { _mm512_storeu_si512(to.cast(), a) }
        }
        fn plus(a: __m512i, b: __m512i) -> __m512i { _mm512_add_epi32(a, b) }
        fn minus(a: __m512i, b: __m512i) -> __m512i { _mm512_sub_epi32(a, b) }
        fn times(a: __m512i, b: __m512i) -> __m512i { _mm512_mullo_epi32(a, b) }
        fn and(a: __m512i, b: __m512i) -> __m512i { _mm512_and_si512(a, b) }
        fn without(a: __m512i, b: __m512i) -> __m512i { _mm512_andnot_si512(a, b) }
        fn or(a: __m512i, b: __m512i) -> __m512i { _mm512_or_si512(a, b) }
        fn min(a: __m512i, b: __m512i) -> __m512i { _mm512_min_epi32(a, b) }
        fn max(a: __m512i, b: __m512i) -> __m512i { _mm512_max_epi32(a, b) }
        fn up(a: __m512i, bits: u32) -> __m512i { _mm512_sll_epi32(a, _mm_cvtsi32_si128(bits as i32)) }
        fn down(a: __m512i, bits: u32) -> __m512i { _mm512_sra_epi32(a, _mm_cvtsi32_si128(bits as i32)) }
        fn up_each(a: __m512i, b: __m512i) -> __m512i { _mm512_sllv_epi32(a, b) }
        fn less(a: __m512i, b: __m512i) -> __mmask16 { _mm512_cmplt_epi32_mask(a, b) }
        fn at_most(a: __m512i, b: __m512i) -> __mmask16 { _mm512_cmple_epu32_mask(a, b) }
        fn both(a: __mmask16, b: __mmask16) -> __mmask16 { a & b }
        fn bits(marks: __mmask16) -> u32 { marks.into() }
        fn marks(bits: u32) -> __mmask16 { bits as u16 }
        fn one_more(marks: __mmask16, a: __m512i) -> __m512i {
            _mm512_mask_add_epi32(a, marks, a, _mm512_set1_epi32(1))
        }
        fn look_up(marks: __mmask16, table: *const u32, at: __m512i) -> __m512i {
            let zero = _mm512_setzero_si512();
            // SAFETY: the caller says that the table has what is looked up.
            unsafe { _mm512_mask_i32gather_epi32::<4>(zero, marks, at, table.cast()) }
        }
        fn beside(bits: u32, a: __m512i) -> __m512i { _mm512_maskz_compress_epi32(bits as u16, a) }
        fn spread(bits: u32, a: __m512i) -> __m512i { _mm512_maskz_expand_epi32(bits as u16, a) }
        fn bytes(items: &[u8]) -> __m512i {
            // SAFETY: those that are not there are not read.
            let items = unsafe { _mm_maskz_loadu_epi8(Sixteen::there(items), items.as_ptr().cast()) };
            _mm512_cvtepu8_epi32(items)
        }
        fn shorts(items: &[u16]) -> __m512i {
            // SAFETY: as above.
            let items = unsafe { _mm256_maskz_loadu_epi16(Sixteen::there(items), items.as_ptr().cast()) };
            _mm512_cvtepu16_epi32(items)
        }
        fn floats(items: &[f32]) -> __m512i {
            // SAFETY: as above.
            unsafe { _mm512_maskz_loadu_epi32(Sixteen::there(items), items.as_ptr().cast()) }
        }
        fn store_fours(to: *mut u32, fours: [__m512i; 4]) {
            for (i, four) in by_column(fours).into_iter().enumerate() {
                // SAFETY: the caller has room for four times sixteen numbers.
                unsafe { _mm512_storeu_si512(to.add(16 * i).cast(), four) };
            }
        }
        fn fours(from: *const u32, stride: usize, at: *const u32) -> [__m512i; 4] {
            let mut places = [_mm512_setzero_si512(); 4];
            for (i, places) in places.iter_mut().enumerate() {
                // SAFETY: the caller has four numbers at each place.
                *places = unsafe {
                    let a = _mm_loadu_si128(place(from, stride, at.add(i)));
                    let b = _mm_loadu_si128(place(from, stride, at.add(i + 4)));
                    let c = _mm_loadu_si128(place(from, stride, at.add(i + 8)));
                    let d = _mm_loadu_si128(place(from, stride, at.add(i + 12)));
                    Sixteen::quarters(a, b, c, d)
                };
            }
            Sixteen::turned(places)
        }
        fn pairs(from: *const u32, at: *const u32) -> [__m512i; 2] {
            let mut places = [_mm512_setzero_ps(); 2];
            for (i, places) in places.iter_mut().enumerate() {
                // SAFETY: the caller has two numbers at each place.
                *places = unsafe {
                    let quarter = |q| two_twos_of(from, [at.add(2 * i + q), at.add(2 * i + q + 1)]);
                    let four = Sixteen::quarters(quarter(0), quarter(4), quarter(8), quarter(12));
                    _mm512_castsi512_ps(four)
                };
            }
            let [low, high] = places;
            [
                _mm512_castps_si512(_mm512_shuffle_ps::<0b10_00_10_00>(low, high)),
                _mm512_castps_si512(_mm512_shuffle_ps::<0b11_01_11_01>(low, high)),
            ]
        }
        fn pairs_on(from: *const u32) -> [__m512i; 2] {
            // SAFETY: the caller has twice sixteen numbers there.
            let [a, b] = unsafe {
                [_mm512_loadu_si512(from.cast()), _mm512_loadu_si512(from.add(16).cast())]
            };
            let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
            let odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
            [_mm512_permutex2var_epi32(a, even, b), _mm512_permutex2var_epi32(a, odd, b)]
        }
        fn twos(from: [*const u32; 2], stride: usize, at: *const u32) -> [__m512i; 4] {
            let [a, b] = from;
            let mut places = [_mm512_setzero_si512(); 4];
            for (i, places) in places.iter_mut().enumerate() {
                // SAFETY: the caller has two numbers at each place.
                *places = unsafe {
                    let first = two_twos([a, b], stride, at.add(i));
                    let second = two_twos([a, b], stride, at.add(i + 4));
                    let third = two_twos([a, b], stride, at.add(i + 8));
                    let fourth = two_twos([a, b], stride, at.add(i + 12));
                    Sixteen::quarters(first, second, third, fourth)
                };
            }
            Sixteen::turned(places)
        }
        fn store_floats(to: *mut f32, a: __m512i) {
            // SAFETY: the caller has room for sixteen there.
            unsafe { _mm512_storeu_ps(to, _mm512_cvtepi32_ps(a)) }
        }
        fn bits_of_sums(n: i64, at: *const i64, from: u32) -> __m512i {
            let (n, from) = (_mm512_set1_epi64(n), _mm_cvtsi32_si128(from as i32));
            // SAFETY: the caller has sixteen numbers there.
            let (low, high) = unsafe {
                (_mm512_loadu_si512(at.cast()), _mm512_loadu_si512(at.add(8).cast()))
            };
            let low = _mm512_srl_epi64(_mm512_add_epi64(n, low), from);
            let high = _mm512_srl_epi64(_mm512_add_epi64(n, high), from);
            // The lower halves.
            let lower = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
            _mm512_permutex2var_epi32(low, lower, high)
        }
    }
}

impl Floats for Sixteen {
    type Floats = __m512;

    with! { "avx512f,avx512vl,avx512dq,avx512bw"
        fn all(x: f32) -> __m512 { _mm512_set1_ps(x) }
        fn load_floats(at: *const f32) -> __m512 {
            // SAFETY: the caller has sixteen numbers there.
            unsafe { _mm512_loadu_ps(at) }
        }
        fn put_floats(to: *mut f32, a: __m512) {
            // SAFETY: the caller has room for sixteen there.
            unsafe { _mm512_storeu_ps(to, a) }
        }
        fn add(a: __m512, b: __m512) -> __m512 { _mm512_add_ps(a, b) }
        fn sub(a: __m512, b: __m512) -> __m512 { _mm512_sub_ps(a, b) }
        fn mul(a: __m512, b: __m512) -> __m512 { _mm512_mul_ps(a, b) }
        fn div(a: __m512, b: __m512) -> __m512 { _mm512_div_ps(a, b) }
        fn sqrt(a: __m512) -> __m512 { _mm512_sqrt_ps(a) }
        fn least(a: __m512, b: __m512) -> __m512 { _mm512_min_ps(a, b) }
        fn most(a: __m512, b: __m512) -> __m512 { _mm512_max_ps(a, b) }
        fn below(a: __m512, b: __m512) -> __mmask16 { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b) }
        fn from_on(a: __m512, b: __m512) -> __mmask16 { _mm512_cmp_ps_mask::<_CMP_GE_OQ>(a, b) }
        fn select(marks: __mmask16, yes: __m512, no: __m512) -> __m512 {
            _mm512_mask_blend_ps(marks, no, yes)
        }
        fn only(marks: __mmask16, a: __m512) -> __m512 { _mm512_maskz_mov_ps(marks, a) }
        fn to_bits(a: __m512) -> __m512i { _mm512_castps_si512(a) }
        fn from_bits(a: __m512i) -> __m512 { _mm512_castsi512_ps(a) }
        fn to_floats(a: __m512i) -> __m512 { _mm512_cvtepi32_ps(a) }
        fn truncated(a: __m512) -> __m512i { _mm512_cvttps_epi32(a) }
    }
}
