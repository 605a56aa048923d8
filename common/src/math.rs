//! Elementary functions with one result on every machine.
//!
//! `f32::exp` asks the platform's maths library, which differs between machines in the last
//! bit. The functions here use additions and multiplications alone, in one written order,
//! without contraction; they are branch-free but for one select, so that compilers can run them
//! on lanes. Formulas: Cody-Waite reduction and the Taylor series of degree 7 on
//! `|r| <= ln 2 / 2`, whose remainder (5e-9) is below half an ulp of f32.

/// 1.5 * 2^23: adding it to an f32 below 2^22 rounds to the nearest integer, ties to even, and
/// leaves that integer in the low bits.
const ROUND_F32: f32 = 12_582_912.0;
/// ln 2 in two parts. The first has 15 trailing zero bits, so its products with small integers are
/// exact (Cody and Waite).
const LN2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
/// Taylor coefficients of `(exp(x) - 1) / x`, highest power first; unitless.
const TAYLOR: [f32; 7] = [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0];
/// Taylor coefficients of `phi(tau) / tau^2` (see [`phi`]) in powers of tau, highest power first;
/// unitless.
pub const PHI: [f32; 5] = [-1.0 / 2016.0, 1.0 / 360.0, -1.0 / 80.0, 1.0 / 24.0, -1.0 / 12.0];

/// Evaluates a polynomial by Horner's rule, highest power first.
#[inline(always)]
fn polynomial<const N: usize>(coefficients: &[f32; N], x: f32) -> f32 {
    let mut p = coefficients[0];
    for c in &coefficients[1..] {
        p = p * x + c;
    }
    p
}

/// Returns `exp(x)` as `s * (1 + q)` with a power of two s and a small q, for `x <= 0`, clamped
/// below at -87 (where f32 results would be denormal). For `x` near 0, s is 1 and q keeps all its
/// digits.
#[inline(always)]
fn exp_parts(x: f32) -> (f32, f32) {
    let x = if x > -87.0 { x } else { -87.0 };
    // Adding it rounds to the nearest integer, ties to even, and leaves that integer in the low
    // bits: no conversion instruction, the same on every machine.
    let shifted = x * std::f32::consts::LOG2_E + ROUND_F32;
    let n = shifted - ROUND_F32;
    let r = (x - n * LN2[0]) - n * LN2[1];
    let p = polynomial(&TAYLOR, r);
    let exponent = (shifted.to_bits() as i32).wrapping_sub(ROUND_F32.to_bits() as i32);
    (f32::from_bits(((exponent + 127) as u32) << 23), p * r)
}

/// Returns `exp(x)`, 0 to 1, for `x <= 0`; x is clamped below at -87. Relative error at most 2 ulp.
#[inline(always)]
pub fn exp_neg(x: f32) -> f32 {
    let (s, q) = exp_parts(x);
    (q + 1.0) * s
}

/// Returns the opacity of a sheet of optical depth `tau >= 0`: `1 - exp(-tau)`, with full relative
/// accuracy down to the smallest `tau` (docs/design/numerics.md section 2).
#[inline(always)]
pub fn opacity(tau: f32) -> f32 {
    let (s, q) = exp_parts(-tau);
    // The first difference is exact, and nothing where tau is small: then -q is all there is.
    (1.0 - s) - s * q
}

/// Optical depth below which the series of [`phi`] replaces its closed form.
pub const PHI_SERIES_BELOW: f32 = 0.25;

/// Returns the weight of a colour's change through a sheet: `phi = a / tau + a / 2 - 1`
/// (docs/design/numerics.md section 1.1). `a` must be `opacity(tau)` and `per_tau` 1 / tau to some
/// digits; `tau > 0`.
#[inline(always)]
pub fn phi(tau: f32, per_tau: f32, a: f32) -> f32 {
    let (small, large) = phi_both(tau, per_tau, a);
    if tau < PHI_SERIES_BELOW { small } else { large }
}

/// Returns both forms of [`phi`]: the series for depths below [`PHI_SERIES_BELOW`], and the closed
/// form for others. SIMD code computes both and then selects.
#[inline(always)]
pub fn phi_both(tau: f32, per_tau: f32, a: f32) -> (f32, f32) {
    // The closed form loses all digits below tau = 1e-3; the series takes over where both are
    // good to 1e-7 absolute.
    let small = polynomial(&PHI, tau) * tau * tau;
    (small, a * per_tau + a * 0.5 - 1.0)
}

/// Converts one sRGB component in `[0, 1]` to linear light (IEC 61966-2-1).
pub fn linear_from_srgb(s: f64) -> f64 {
    if s <= 0.04045 { s / 12.92 } else { libm::pow((s + 0.055) / 1.055, 2.4) }
}

/// Converts one component of linear light in `[0, 1]` to sRGB (IEC 61966-2-1).
pub fn srgb_from_linear(l: f64) -> f64 {
    if l <= 0.003_130_8 { l * 12.92 } else { 1.055 * libm::pow(l, 1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_within_two_ulp_of_f64() {
        let mut x = -86.9f32;
        while x <= 0.0 {
            let want = libm::exp(x as f64);
            let rel = ((exp_neg(x) as f64 - want) / want).abs();
            assert!(rel < 2.4e-7, "exp({x}): relative error {rel:e}");
            x += 0.000_97;
        }
        assert_eq!(exp_neg(0.0), 1.0);
        assert!(exp_neg(f32::NEG_INFINITY) < 1e-37);
    }

    #[test]
    fn opacity_keeps_digits_of_faint_sheets() {
        for e in -40..6 {
            for m in [1.0, 1.7, 3.1, 5.0, 9.9] {
                let tau = (m * libm::pow(10.0, e as f64)) as f32;
                let want = -libm::expm1(-(tau as f64));
                let rel = ((opacity(tau) as f64 - want) / want).abs();
                assert!(rel < 4e-7, "opacity({tau:e}): relative error {rel:e}");
            }
        }
        assert_eq!(opacity(0.0), 0.0);
        assert_eq!(opacity(1e9), 1.0);
    }

    #[test]
    fn phi_has_no_cancellation_at_the_switch() {
        let mut tau = 1e-6f32;
        while tau < 1e4 {
            let t = tau as f64;
            let a = -libm::expm1(-t);
            // The exact value, in f64, by series where the closed form would cancel there too.
            let want = if t < 1e-3 {
                t * t * (-1.0 / 12.0 + t * (1.0 / 24.0 - t / 80.0))
            } else {
                a / t + a / 2.0 - 1.0
            };
            let got = phi(tau, 1.0 / tau, opacity(tau)) as f64;
            assert!((got - want).abs() < 3e-7, "phi({tau:e}) = {got}, want {want}");
            tau *= 1.07;
        }
    }

    #[test]
    fn srgb_round_trip() {
        for i in 0..=255 {
            let s = i as f64 / 255.0;
            assert!((srgb_from_linear(linear_from_srgb(s)) - s).abs() < 1e-6);
        }
    }
}
