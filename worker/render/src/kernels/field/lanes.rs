//! Splatting of a voxel of a field in registers of x86.

use crate::kernels::field::FieldSum;
use crate::kernels::pixel_records::{Record, STRIDE};
use std::arch::x86_64::*;

/// Registers of a record of eight planes, at most: 32-bit sums in AVX2.
const MOST_PARTS: usize = 8;

/// A register of terms. No function may be called on a machine without its instructions.
trait Terms {
    /// Number type of a term.
    type Term;
    /// Number type of a sum.
    type Sum;
    type Register: Copy;
    /// Terms in a register.
    const LANES: usize;

    unsafe fn zero() -> Self::Register;
    unsafe fn load(from: *const Self::Term) -> Self::Register;
    /// Loads four terms and repeats them across the register.
    unsafe fn four(from: *const Self::Term) -> Self::Register;
    unsafe fn times(a: Self::Register, b: Self::Register) -> Self::Register;
    /// Adds terms to as many sums.
    unsafe fn add(to: *mut Self::Sum, terms: Self::Register);
}

/// Terms of 16-bit sums in AVX2.
struct Shorts256;
/// Terms of 16-bit sums in AVX-512.
struct Shorts512;
/// Terms of 32-bit sums in AVX2.
struct Longs256;
/// Terms of 32-bit sums in AVX-512.
struct Longs512;

impl Terms for Shorts256 {
    type Term = i16;
    type Sum = i16;
    type Register = __m256i;
    const LANES: usize = 16;

    with! { "avx2"
        fn zero() -> __m256i { _mm256_setzero_si256() }
        fn load(from: *const i16) -> __m256i {
            // SAFETY: the caller has sixteen numbers there.
            unsafe { _mm256_loadu_si256(from.cast()) }
        }
        fn four(from: *const i16) -> __m256i {
            // SAFETY: the caller has four numbers there.
            _mm256_set1_epi64x(unsafe { from.cast::<i64>().read_unaligned() })
        }
        fn times(a: __m256i, b: __m256i) -> __m256i { _mm256_mulhrs_epi16(a, b) }
        fn add(to: *mut i16, terms: __m256i) {
            // SAFETY: the caller has sixteen sums there.
            unsafe {
                let sums = _mm256_loadu_si256(to.cast());
                _mm256_storeu_si256(to.cast(), _mm256_add_epi16(sums, terms));
            }
        }
    }
}

impl Terms for Shorts512 {
    type Term = i16;
    type Sum = i16;
    type Register = __m512i;
    const LANES: usize = 32;

    with! { "avx512f,avx512vl,avx512dq,avx512bw"
        fn zero() -> __m512i { _mm512_setzero_si512() }
        fn load(from: *const i16) -> __m512i {
            // SAFETY: the caller has 32 numbers there.
            unsafe { _mm512_loadu_si512(from.cast()) }
        }
        fn four(from: *const i16) -> __m512i {
            // SAFETY: the caller has four numbers there.
            _mm512_set1_epi64(unsafe { from.cast::<i64>().read_unaligned() })
        }
        fn times(a: __m512i, b: __m512i) -> __m512i { _mm512_mulhrs_epi16(a, b) }
        fn add(to: *mut i16, terms: __m512i) {
            // SAFETY: the caller has 32 sums there.
            unsafe {
                let sums = _mm512_loadu_si512(to.cast());
                _mm512_storeu_si512(to.cast(), _mm512_add_epi16(sums, terms));
            }
        }
    }
}

impl Terms for Longs256 {
    type Term = f32;
    type Sum = i32;
    type Register = __m256;
    const LANES: usize = 8;

    with! { "avx2"
        fn zero() -> __m256 { _mm256_setzero_ps() }
        fn load(from: *const f32) -> __m256 {
            // SAFETY: the caller has eight numbers there.
            unsafe { _mm256_loadu_ps(from) }
        }
        fn four(from: *const f32) -> __m256 {
            // SAFETY: the caller has four numbers there.
            let four = unsafe { _mm_loadu_ps(from) };
            _mm256_set_m128(four, four)
        }
        fn times(a: __m256, b: __m256) -> __m256 { _mm256_mul_ps(a, b) }
        fn add(to: *mut i32, terms: __m256) {
            // SAFETY: the caller has eight sums there.
            unsafe {
                let sums = _mm256_loadu_si256(to.cast());
                _mm256_storeu_si256(to.cast(), _mm256_add_epi32(sums, _mm256_cvtps_epi32(terms)));
            }
        }
    }
}

impl Terms for Longs512 {
    type Term = f32;
    type Sum = i32;
    type Register = __m512;
    const LANES: usize = 16;

    with! { "avx512f,avx512vl,avx512dq,avx512bw"
        fn zero() -> __m512 { _mm512_setzero_ps() }
        fn load(from: *const f32) -> __m512 {
            // SAFETY: the caller has sixteen numbers there.
            unsafe { _mm512_loadu_ps(from) }
        }
        fn four(from: *const f32) -> __m512 {
            // SAFETY: the caller has four numbers there.
            _mm512_broadcast_f32x4(unsafe { _mm_loadu_ps(from) })
        }
        fn times(a: __m512, b: __m512) -> __m512 { _mm512_mul_ps(a, b) }
        fn add(to: *mut i32, terms: __m512) {
            // SAFETY: the caller has sixteen sums there.
            unsafe {
                let sums = _mm512_loadu_si512(to.cast());
                _mm512_storeu_si512(to.cast(), _mm512_add_epi32(sums, _mm512_cvtps_epi32(terms)));
            }
        }
    }
}

/// Adds a voxel's planes to the records from `at` on: weights by column and by row, four each, or,
/// if `WOVEN`, four for each slot.
///
/// # Panics
/// If the footprint leaves the records.
///
/// # Safety
/// The instructions are there; `R` has `4 N` sums.
#[inline(always)]
unsafe fn splat<P: Terms, R, const N: usize, const WOVEN: bool>(
    records: &mut [R],
    at: usize,
    (wx, wy): (&[P::Term], &[P::Term]),
    planes: &[[P::Term; 4]; N],
) {
    const { assert!((4 * N).is_multiple_of(P::LANES) && 4 * N / P::LANES <= MOST_PARTS) };
    const { assert!(size_of::<R>() == 4 * N * size_of::<P::Sum>()) };
    let parts = 4 * N / P::LANES;
    let step = if WOVEN { 4 * N } else { 4 };
    let [wide, high] = [wx.len() / step, wy.len() / step];
    let last = at + high.saturating_sub(1) * STRIDE + wide;
    assert!(last <= records.len(), "a footprint in the records");
    // SAFETY: the caller's. `planes` has 4 N terms, each column and row `step` weights, and all
    // records up to `last` are there.
    unsafe {
        let (mut all, mut row) = ([P::zero(); MOST_PARTS], [P::zero(); MOST_PARTS]);
        for p in 0..parts {
            all[p] = P::load(planes.as_ptr().cast::<P::Term>().add(p * P::LANES));
        }
        for y in 0..high {
            let wy = wy.as_ptr().add(y * step);
            for p in 0..parts {
                let wy = if WOVEN { P::load(wy.add(p * P::LANES)) } else { P::four(wy) };
                row[p] = P::times(all[p], wy);
            }
            let to = records.as_mut_ptr().add(at + y * STRIDE).cast::<P::Sum>();
            for x in 0..wide {
                let (wx, to) = (wx.as_ptr().add(x * step), to.add(x * 4 * N));
                for p in 0..parts {
                    let wx = if WOVEN { P::load(wx.add(p * P::LANES)) } else { P::four(wx) };
                    P::add(to.add(p * P::LANES), P::times(row[p], wx));
                }
            }
        }
    }
}

/// Defines [`splat`] compiled for an instruction set.
macro_rules! compiled {
    ($($name:ident: $terms:ident, $sum:ty, $term:ty, $features:literal;)*) => {$(
        #[target_feature(enable = $features)]
        pub(super) fn $name<const N: usize, const WOVEN: bool>(
            records: &mut [Record<$sum, N>],
            at: usize,
            weights: (&[$term], &[$term]),
            planes: &[[$term; 4]; N],
        )
        where
            $sum: FieldSum,
        {
            // SAFETY: this function is compiled for these instructions; a record has N planes of
            // four sums.
            unsafe { splat::<$terms, _, N, WOVEN>(records, at, weights, planes) }
        }
    )*};
}

compiled! {
    shorts256: Shorts256, i16, i16, "avx2";
    longs256: Longs256, i32, f32, "avx2";
    longs512: Longs512, i32, f32, "avx512f,avx512vl,avx512dq,avx512bw";
}

/// [`splat`] of eight planes in 16-bit sums: a register each pixel.
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
pub(super) fn shorts512<const N: usize, const WOVEN: bool>(
    records: &mut [Record<i16, N>],
    at: usize,
    weights: (&[i16], &[i16]),
    planes: &[[i16; 4]; N],
) {
    // A record of four planes fills half a register.
    let Ok(planes) = planes[..].try_into() else {
        return shorts256::<N, WOVEN>(records, at, weights, planes);
    };
    let records: &mut [Record<i16, 8>] = bytemuck::cast_slice_mut(records);
    // SAFETY: this function is compiled for these instructions; a record has eight planes of four
    // sums.
    unsafe { splat::<Shorts512, _, 8, WOVEN>(records, at, weights, planes) }
}
