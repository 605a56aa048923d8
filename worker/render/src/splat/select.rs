//! Which of many are wanted.

use super::{Level, Simd};

/// Puts the numbers of those of `fates` that are at least `wanted` into `kept`, in order; returns how
/// many. What is behind them in `kept` may be anything then.
///
/// # Panics
/// If `kept` is not 16 longer than `fates`: lanes are written whole.
#[inline(always)]
pub(crate) fn select(simd: Simd, fates: &[u32], wanted: u32, kept: &mut [u32]) -> usize {
    assert!(kept.len() >= fates.len() + 16, "room for one register more");
    match simd.0 {
        // SAFETY: the value proves that the instructions are there.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { select_avx512(fates, wanted, kept) },
        _ => select_plain(fates, wanted, kept),
    }
}

#[inline(always)]
fn select_plain(fates: &[u32], wanted: u32, kept: &mut [u32]) -> usize {
    let mut some = 0;
    for (i, fate) in fates.iter().enumerate() {
        kept[some] = i as u32;
        some += usize::from(*fate >= wanted);
    }
    some
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
#[inline]
fn select_avx512(fates: &[u32], wanted: u32, kept: &mut [u32]) -> usize {
    use std::arch::x86_64::*;
    let wanted = _mm512_set1_epi32(wanted as i32);
    let mut numbers = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
    let mut some = 0;
    for fates in fates.chunks(16) {
        let present = ((1u32 << fates.len()) - 1) as u16;
        // SAFETY: lanes that are not present are not read.
        let fates = unsafe { _mm512_maskz_loadu_epi32(present, fates.as_ptr().cast()) };
        let yes = _mm512_mask_cmpge_epu32_mask(present, fates, wanted);
        let to = kept[some..].first_chunk_mut::<16>().expect("room for one register more");
        // SAFETY: sixteen numbers are 64 bytes.
        unsafe {
            _mm512_storeu_si512(to.as_mut_ptr().cast(), _mm512_maskz_compress_epi32(yes, numbers));
        }
        some += yes.count_ones() as usize;
        numbers = _mm512_add_epi32(numbers, _mm512_set1_epi32(16));
    }
    some
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_instruction_set_selects_the_same(
            fates in prop::collection::vec(0..4u32, 0..200), wanted in 1..5u32,
        ) {
            for simd in Simd::all() {
                let mut kept = vec![9; fates.len() + 16];
                let some = select(simd, &fates, wanted, &mut kept);
                let want: Vec<u32> =
                    (0..fates.len() as u32).filter(|&i| fates[i as usize] >= wanted).collect();
                prop_assert_eq!(&kept[..some], &want[..], "{}", simd.name());
            }
        }
    }
}
