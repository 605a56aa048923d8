//! Kernels of tossing that are faster with AVX2 than what the compiler makes of the plain loop.

use std::arch::x86_64::*;

/// [`super::any_in_rows`] with AVX2.
#[target_feature(enable = "avx2")]
#[inline]
pub(super) fn any_in_rows(rows: &[u64; 64], [begin, end]: [usize; 2], columns: u64) -> bool {
    let rows = &rows[begin..end];
    let mut any = _mm256_setzero_si256();
    for rows in rows.chunks(8) {
        let n = _mm256_set1_epi64x(rows.len() as i64);
        let halves = [_mm256_setr_epi64x(0, 1, 2, 3), _mm256_setr_epi64x(4, 5, 6, 7)];
        for (i, lanes) in halves.into_iter().enumerate() {
            let there = _mm256_cmpgt_epi64(n, lanes);
            let at: *const i64 = rows.as_ptr().cast();
            // SAFETY: lanes beyond the rows are not read.
            let some = unsafe { _mm256_maskload_epi64(at.wrapping_add(4 * i), there) };
            any = _mm256_or_si256(any, some);
        }
    }
    let columns = _mm256_set1_epi64x(columns as i64);
    _mm256_testz_si256(any, columns) == 0
}
