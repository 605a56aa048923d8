//! Kernels of tossing that are faster with AVX-512 than the generic ones of [`super::wide`].

use super::wide::Placed;
use super::{DeepBrick, FAR};
use crate::kernels::lanes::Sixteen;
use slabcast_common::view::ROUND_F64;
use std::arch::x86_64::*;

impl Placed<Sixteen> for DeepBrick<'_> {
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn some(&self, local: usize) -> [__m512i; 3] {
        deep(self, local)
    }
}

/// [`slabcast_common::view::round_i32`] of sixteen numbers.
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
#[inline]
fn round(both: [__m512d; 2]) -> __m512i {
    let lower = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    let magic = _mm512_set1_pd(ROUND_F64);
    let [low, high] = both;
    let low = _mm512_castpd_si512(_mm512_add_pd(low, magic));
    let high = _mm512_castpd_si512(_mm512_add_pd(high, magic));
    _mm512_permutex2var_epi32(low, lower, high)
}

/// Places in perspective.
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
#[inline]
fn deep(places: &DeepBrick<'_>, local: usize) -> [__m512i; 3] {
    let mut eye = [[_mm512_setzero_pd(); 2]; 3];
    for (axis, eye) in eye.iter_mut().enumerate() {
        let at = places.offsets[axis][local..].first_chunk::<16>();
        let at = at.expect("sixteen of a brick").as_ptr();
        let corner = _mm512_set1_pd(places.corner[axis]);
        // SAFETY: sixteen numbers are 128 bytes.
        let both = unsafe { [_mm512_loadu_pd(at), _mm512_loadu_pd(at.add(8))] };
        *eye = [_mm512_add_pd(corner, both[0]), _mm512_add_pd(corner, both[1])];
    }
    let [x, y, z] = eye;
    let [mut across, mut down, mut deep] = [[_mm512_setzero_pd(); 2]; 3];
    for half in 0..2 {
        let depth = _mm512_add_pd(z[half], _mm512_set1_pd(places.distance));
        let scale = _mm512_div_pd(_mm512_set1_pd(places.per_depth), depth);
        for (to, (from, middle)) in
            [(&mut across, (x, places.middle[0])), (&mut down, (y, places.middle[1]))]
        {
            let at = _mm512_add_pd(_mm512_mul_pd(from[half], scale), _mm512_set1_pd(middle));
            let at = _mm512_max_pd(at, _mm512_set1_pd(-FAR));
            to[half] = _mm512_min_pd(at, _mm512_set1_pd(FAR));
        }
        // A division by one changes nothing and is slow.
        let thickness = places.view.thickness;
        deep[half] = z[half];
        if thickness != 1.0 {
            deep[half] = _mm512_div_pd(z[half], _mm512_set1_pd(thickness));
        }
        let phases = _mm512_set1_pd(f64::from(places.view.depth_phases()));
        deep[half] = _mm512_mul_pd(deep[half], phases);
    }
    [round(across), round(down), round(deep)]
}

/// [`super::any_in_rows`] with AVX-512.
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
#[inline]
pub(super) fn any_in_rows(rows: &[u64; 64], [begin, end]: [usize; 2], columns: u64) -> bool {
    let (rows, columns) = (&rows[begin..end], _mm512_set1_epi64(columns as i64));
    let mut any = 0;
    for rows in rows.chunks(8) {
        // SAFETY: lanes beyond the rows are not read.
        let rows =
            unsafe { _mm512_maskz_loadu_epi64(0xff >> (8 - rows.len()), rows.as_ptr().cast()) };
        any |= _mm512_test_epi64_mask(rows, columns);
    }
    any != 0
}
