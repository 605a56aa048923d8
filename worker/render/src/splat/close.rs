//! Rows of a closing sheet in registers.
//!
//! What is done is [`Rule::close_row`], operation by operation, for sums in whole numbers under the
//! linear rule; everything else is closed there. A row is one chain of some sixty operations that wait
//! for each other, so two rows are closed at once.

#[cfg(target_arch = "x86_64")]
use super::Level;
use super::Simd;
use crate::sheet::{Row, Rule, Sum};
#[cfg(target_arch = "x86_64")]
use slabcast_common::quality::Compositing;

/// [`Rule::close_row`] for some rows.
#[inline(always)]
pub(crate) fn close_rows<S: Sum, const ROWS: usize>(
    simd: Simd,
    rule: &Rule,
    rows: &mut [Row; ROWS],
    live: [u32; ROWS],
) -> [u32; ROWS] {
    match simd.0 {
        // SAFETY: the value proves that the instructions are there.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 if S::WHOLE && rule.compositing == Compositing::Linear => unsafe {
            avx512::close::<S, ROWS>(rule, rows, live)
        },
        _ => {
            let mut shut = [0; ROWS];
            for ((shut, row), live) in shut.iter_mut().zip(rows).zip(live) {
                *shut = rule.close_row::<S>(row, live);
            }
            shut
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use crate::sheet::{FAINTEST, LANES, ONE, Row, Rule, Sum};
    use crate::splat::LARGEST;
    use slabcast_common::math::{LN2, MAGIC, PHI, SWITCH, TAYLOR};
    use std::arch::x86_64::*;

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn load(lanes: &[f32; LANES]) -> __m512 {
        // SAFETY: sixteen floats are 64 bytes.
        unsafe { _mm512_loadu_ps(lanes.as_ptr()) }
    }

    /// A polynomial in `x`, highest power first.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn polynomial<const N: usize>(coefficients: &[f32; N], x: __m512) -> __m512 {
        let mut p = _mm512_set1_ps(coefficients[0]);
        for c in &coefficients[1..] {
            p = _mm512_add_ps(_mm512_mul_ps(p, x), _mm512_set1_ps(*c));
        }
        p
    }

    /// `slabcast_common::math::opacity`.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn opacity(tau: __m512) -> __m512 {
        let magic = _mm512_set1_ps(MAGIC);
        let x = _mm512_sub_ps(_mm512_set1_ps(-0.0), tau);
        let x = _mm512_max_ps(x, _mm512_set1_ps(-87.0));
        let log2_e = _mm512_set1_ps(std::f32::consts::LOG2_E);
        let shifted = _mm512_add_ps(_mm512_mul_ps(x, log2_e), magic);
        let n = _mm512_sub_ps(shifted, magic);
        let r = _mm512_sub_ps(x, _mm512_mul_ps(n, _mm512_set1_ps(LN2[0])));
        let r = _mm512_sub_ps(r, _mm512_mul_ps(n, _mm512_set1_ps(LN2[1])));
        let q = _mm512_mul_ps(polynomial(&TAYLOR, r), r);
        let exponent = _mm512_sub_epi32(_mm512_castps_si512(shifted), _mm512_castps_si512(magic));
        let exponent = _mm512_add_epi32(exponent, _mm512_set1_epi32(127));
        let s = _mm512_castsi512_ps(_mm512_slli_epi32::<23>(exponent));
        _mm512_sub_ps(_mm512_sub_ps(_mm512_set1_ps(1.0), s), _mm512_mul_ps(s, q))
    }

    /// What sixteen pixels have before their colours are looked at.
    #[derive(Clone, Copy)]
    struct Pixels {
        per_raw: __m512,
        /// Opacity of the sheet.
        opacity: __m512,
        /// Of the change of colour through it.
        weight: __m512,
        before: __m512,
        per_before: __m512,
        behind: __m512,
        /// What of the light comes through from the sheet on.
        light: __m512,
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(super) fn close<S: Sum, const ROWS: usize>(
        rule: &Rule,
        rows: &mut [Row; ROWS],
        live: [u32; ROWS],
    ) -> [u32; ROWS] {
        let zero = _mm512_setzero_ps();
        let one = _mm512_set1_ps(1.0);
        let mut pixels = [Pixels {
            per_raw: zero,
            opacity: zero,
            weight: zero,
            before: zero,
            per_before: zero,
            behind: zero,
            light: zero,
        }; ROWS];
        let mut taus = [zero; ROWS];
        let mut raws = [zero; ROWS];
        for r in 0..ROWS {
            let here = load(&rows[r].here[0]);
            let filled = _mm512_cmp_ps_mask::<_CMP_GE_OQ>(here, _mm512_set1_ps(FAINTEST));
            raws[r] = _mm512_mask_blend_ps(filled, one, here);
            let tau = _mm512_mul_ps(raws[r], _mm512_set1_ps(rule.unit));
            taus[r] = _mm512_maskz_mul_ps(filled, tau, load(&rows[r].secant));
            pixels[r].per_raw = _mm512_div_ps(one, raws[r]);
        }
        for r in 0..ROWS {
            pixels[r].opacity = opacity(taus[r]);
        }
        for r in 0..ROWS {
            let Pixels { per_raw, opacity, .. } = pixels[r];
            let tau = taus[r];
            let small = _mm512_mul_ps(_mm512_mul_ps(polynomial(&PHI, tau), tau), tau);
            let per_tau = _mm512_mul_ps(per_raw, _mm512_set1_ps(rule.per_unit));
            let per_tau = _mm512_mul_ps(per_tau, load(&rows[r].cosine));
            let half = _mm512_mul_ps(opacity, _mm512_set1_ps(0.5));
            let large = _mm512_add_ps(_mm512_mul_ps(opacity, per_tau), half);
            let large = _mm512_sub_ps(large, one);
            let is_small = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(tau, _mm512_set1_ps(SWITCH));
            let is_there = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(tau, zero);
            let weight = _mm512_mask_blend_ps(is_small, large, small);
            pixels[r].weight = _mm512_maskz_mov_ps(is_there, weight);
        }
        for r in 0..ROWS {
            let (tl, tn, h) = (load(&rows[r].before[0]), load(&rows[r].behind[0]), raws[r]);
            let tl_2 = _mm512_mul_ps(tl, tl);
            let h_2 = _mm512_mul_ps(_mm512_set1_ps(4e-4), _mm512_mul_ps(h, h));
            let squares = _mm512_add_ps(tl_2, h_2);
            let sum = _mm512_add_ps(tn, _mm512_mul_ps(_mm512_set1_ps(0.05), h));
            let some = _mm512_max_ps(tl, one);
            let both = _mm512_mul_ps(squares, sum);
            let per_all = _mm512_div_ps(one, _mm512_mul_ps(some, both));
            let gain = _mm512_mul_ps(_mm512_set1_ps(rule.gain_before), tl_2);
            let share = _mm512_mul_ps(_mm512_mul_ps(some, sum), per_all);
            pixels[r].before = _mm512_mul_ps(gain, share);
            pixels[r].per_before = _mm512_mul_ps(both, per_all);
            let share = _mm512_mul_ps(_mm512_mul_ps(some, squares), per_all);
            pixels[r].behind = _mm512_mul_ps(_mm512_set1_ps(rule.gain_behind), share);
        }
        let mut shut = [0; ROWS];
        for r in 0..ROWS {
            let a = load(&rows[r].a);
            let light = _mm512_maskz_sub_ps(live[r] as u16, one, a);
            let a = _mm512_add_ps(a, _mm512_mul_ps(light, pixels[r].opacity));
            pixels[r].light = light;
            let left = _mm512_sub_ps(one, a);
            let is_shut = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(left, _mm512_set1_ps(rule.eps));
            shut[r] = u32::from(is_shut) & live[r];
            // SAFETY: sixteen floats are 64 bytes.
            unsafe { _mm512_storeu_ps(rows[r].a.as_mut_ptr(), a) };
        }
        for ch in 0..if S::GREY { 1 } else { 3 } {
            for r in 0..ROWS {
                let p = &pixels[r];
                let (el, en) = (load(&rows[r].before[ch + 1]), load(&rows[r].behind[ch + 1]));
                let tn = load(&rows[r].behind[0]);
                let c = _mm512_mul_ps(load(&rows[r].here[ch + 1]), p.per_raw);
                let ahead = _mm512_sub_ps(en, _mm512_mul_ps(c, tn));
                let back = _mm512_sub_ps(c, _mm512_mul_ps(el, p.per_before));
                let change = _mm512_mul_ps(p.before, back);
                let change = _mm512_add_ps(change, _mm512_mul_ps(p.behind, ahead));
                let most = _mm512_max_ps(_mm512_min_ps(c, _mm512_sub_ps(one, c)), zero);
                let most = _mm512_mul_ps(_mm512_set1_ps(2.0), most);
                let change = _mm512_min_ps(change, most);
                let change = _mm512_max_ps(change, _mm512_sub_ps(zero, most));
                let of_sheet = _mm512_mul_ps(c, p.opacity);
                let of_sheet = _mm512_add_ps(of_sheet, _mm512_mul_ps(change, p.weight));
                let light = _mm512_mul_ps(p.light, of_sheet);
                let light = _mm512_mul_ps(light, _mm512_set1_ps(ONE));
                let light = _mm512_add_ps(light, _mm512_set1_ps(0.5));
                let light = _mm512_min_ps(_mm512_max_ps(light, zero), _mm512_set1_ps(LARGEST));
                let light = _mm512_cvttps_epi32(light);
                // SAFETY: sixteen numbers are 64 bytes.
                unsafe { _mm512_storeu_si512(rows[r].light[ch].as_mut_ptr().cast(), light) };
            }
        }
        if S::GREY {
            for row in rows {
                row.light = [row.light[0]; 3];
            }
        }
        shut
    }
}
