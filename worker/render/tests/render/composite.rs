use crate::support::simds;
use proptest::prelude::*;
use slabcast_common::quality::Compositing;
use slabcast_render::kernels::composite::*;
use slabcast_render::kernels::{Simd, Work};
use std::marker::PhantomData;

/// A row that closes, as work.
struct Close<'a, S> {
    rule: &'a Rule,
    row: &'a mut Row,
    live: u32,
    sums: PhantomData<S>,
}

impl<S: Sum> Work for Close<'_, S> {
    type Out = u32;
    #[inline(always)]
    fn run(self, _: Simd) -> u32 {
        self.rule.close_row::<S>(self.row, self.live)
    }
}

proptest! {
    /// Rows against the plain arithmetic, bit by bit: empty, faint, thick and huge sheets.
    #[test]
    fn composite_row_equals_composite_pixel_on_every_instruction_set(
        sheets in prop::collection::vec(
            prop::array::uniform3((-45.0..40.0f32, any::<bool>(), prop::array::uniform3(0.0..1.0f32))),
            LANES,
        ),
        a in prop::collection::vec(0.0..1.0f32, LANES),
        secant in prop::collection::vec(1.0..1.5f32, LANES),
        d in 0.02..4.0f64,
    ) {
        for compositing in [Compositing::Linear, Compositing::Constant, Compositing::Paper] {
            let rule = Rule::new(compositing, 0.75, d / 0.6, 1e-3);
            let mut row = Row::default();
            for i in 0..LANES {
                row.secant[i] = secant[i];
                row.cosine[i] = 1.0 / secant[i];
                row.a[i] = a[i];
                for (k, (e, full, c)) in sheets[i].iter().enumerate() {
                    let t = if *full { libm::expf(*e) } else { 0.0 };
                    let to = [&mut row.before, &mut row.here, &mut row.behind];
                    let sums = [t, t * c[0], t * c[1], t * c[2]];
                    for (ch, sum) in sums.into_iter().enumerate() {
                        to[k][ch][i] = sum;
                    }
                }
            }
            let live = 0xfffb;
            check::<f32>(&rule, &row, live, |t| t)?;
            // Whole numbers: the same sums in units, so that the faintest are nothing.
            for sheet in [&mut row.before, &mut row.here, &mut row.behind] {
                for sum in sheet.as_flattened_mut() {
                    *sum = (*sum * 1e3).min(2e9).round();
                }
            }
            check::<i32>(&rule, &row, live, |t| t as i32)?;
        }
    }
}

/// A row closed at once against its pixels one by one, bit by bit, and again on every instruction
/// set.
fn check<S: Sum>(
    rule: &Rule,
    row: &Row,
    live: u32,
    sum: impl Fn(f32) -> S,
) -> Result<(), TestCaseError> {
    let mut closed = row.clone();
    let shut = rule.close_row::<S>(&mut closed, live);
    for i in 0..LANES {
        let of = |p: &[[f32; LANES]; 4]| p.map(|ch| sum(ch[i]));
        let (mut a, mut colour) = (row.a[i], [0u32; 3]);
        let (b, h, n) = (of(&row.before), of(&row.here), of(&row.behind));
        if live >> i & 1 == 1 {
            rule.close(b, h, n, row.secant[i], &mut a, &mut colour);
            prop_assert_eq!(shut >> i & 1 == 1, rule.is_shut(a));
        }
        prop_assert_eq!(closed.a[i].to_bits(), a.to_bits());
        prop_assert_eq!(closed.light.map(|l| l[i]), colour);
    }
    for simd in simds() {
        let mut again = row.clone();
        let got = simd.run(Close { rule, row: &mut again, live, sums: PhantomData::<S> });
        prop_assert_eq!(got, shut, "{}", simd.name());
        prop_assert_eq!(again.a.map(f32::to_bits), closed.a.map(f32::to_bits));
        prop_assert_eq!(again.light, closed.light);
    }
    Ok(())
}

fn stack(compositing: Compositing, d: f64, sheets: &[[f32; 4]], eps: f32) -> (f32, [f64; 3]) {
    let rule = Rule::new(compositing, 1.0, d / 0.6, eps);
    let (mut a, mut colour) = (0.0, [0u32; 3]);
    let at = |k: isize| {
        if k < 0 { [0.0; 4] } else { sheets.get(k as usize).copied().unwrap_or([0.0; 4]) }
    };
    for k in 0..sheets.len() as isize {
        if rule.is_shut(a) {
            break;
        }
        rule.close(at(k - 1), at(k), at(k + 1), 1.0, &mut a, &mut colour);
    }
    (a, colour.map(|c| f64::from(c) / f64::from(1u32 << 28)))
}

proptest! {
    #[test]
    fn composited_colour_stays_between_zero_and_opacity(
        taus in prop::collection::vec((-20.0..12.0f32, 0.0..1.0f32, 0.0..1.0f32), 1..40),
        d in 0.1..4.0f64,
    ) {
        let sheets: Vec<[f32; 4]> = taus
            .iter()
            .map(|&(e, r, g)| {
                let t = libm::expf(e);
                [t, t * r, t * g, t]
            })
            .collect();
        let (a, c) = stack(Compositing::Linear, d, &sheets, 0.0);
        prop_assert!(a.is_finite() && (0.0..=1.0).contains(&a));
        for ch in c {
            prop_assert!(ch >= 0.0 && ch <= f64::from(a) + 1e-6, "{ch} over {a}");
        }
        // Opacity is the same for both rules, and is that of the summed depth.
        let (ac, _) = stack(Compositing::Constant, d, &sheets, 0.0);
        prop_assert_eq!(a, ac);
        let total: f64 = sheets.iter().map(|s| f64::from(s[0])).sum();
        prop_assert!((f64::from(a) + libm::expm1(-total)).abs() < 2e-6);
    }
}

#[test]
fn constant_colour_composites_exactly() {
    for tau in [1e-7f32, 1e-3, 0.3, 4.0, 500.0] {
        let sheets = vec![[tau, tau * 0.5, tau * 0.25, tau]; 30];
        let (a, c) = stack(Compositing::Linear, 1.0, &sheets, 0.0);
        assert!((c[0] - 0.5 * f64::from(a)).abs() < 3e-7, "tau {tau}: {} of {a}", c[0]);
        assert!((c[2] - f64::from(a)).abs() < 3e-7);
    }
}

/// A colour ramp through a homogeneous medium has a closed form: with sigma = s and
/// C(z) = z / L, the picture is (1 - exp(-s L)) / (s L) - exp(-s L).
#[test]
fn linear_colour_rule_beats_constant_on_a_colour_ramp() {
    let (l, s) = (10.0, 0.8);
    let exact = (1.0 - libm::exp(-s * l)) / (s * l) - libm::exp(-s * l);
    let error = |rule| {
        let n = 10;
        let sheets: Vec<[f32; 4]> = (0..n)
            .map(|k| {
                let t = (s * l / n as f64) as f32;
                let c = (k as f32 + 0.5) / n as f32;
                [t, t * c, t * c, t * c]
            })
            .collect();
        (stack(rule, 1.0, &sheets, 0.0).1[0] - exact).abs()
    };
    let (linear, constant) = (error(Compositing::Linear), error(Compositing::Constant));
    assert!(linear * 2.5 < constant, "linear {linear:e}, constant {constant:e}");
}

#[test]
fn paper_compositing_clamps_opacity_to_one() {
    let (a, c) =
        stack(Compositing::Paper, 1.0, &[[0.5, 0.25, 0.0, 0.5], [3.0, 3.0, 0.0, 0.0]], 0.0);
    assert_eq!(a, 1.0);
    assert!((c[0] - (0.25 + 0.5)).abs() < 1e-8 && (c[2] - 0.5).abs() < 1e-8);
}

#[test]
fn ten_thousand_faint_layers_keep_precision() {
    let sheets = vec![[1e-6f32, 5e-7, 0.0, 1e-6]; 10_000];
    let (a, c) = stack(Compositing::Linear, 1.0, &sheets, 0.0);
    let want = -libm::expm1(-0.01);
    assert!((f64::from(a) - want).abs() / want < 1e-5, "{a} against {want}");
    // Colour has a unit of 2^-28: 10^4 roundings of half a unit at most.
    assert!((c[0] - want / 2.0).abs() < 1e4 * 0.5 / f64::from(1u32 << 28) + 1e-7);
}
