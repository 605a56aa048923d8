//! What happens at a pixel when a sheet closes.
//!
//! In optical depth t a sheet's light is the integral of C(t) exp(-t): extinction itself drops
//! out. c = E / tau is the exact mean of C and tau is exact, so A is exact for any thickness;
//! only the slope of C inside the sheet is missing. The rule NL estimates it from the sheets
//! before and behind, the latter *half filled*: what voxels that begin no later than this sheet
//! have put into the next one (the peek). That is as accurate as the finished sheet, needs no
//! latency, and is the same for every tile, order and culling, since "begins no later" is a
//! matter of the absolute sheet grid (NUMERICS.md section 1.2).

use slabcast_common::math::{opacity, phi};
use slabcast_common::quality::Compositing;

/// A sum of a sheet: integers, whose sum has no order, or floats, added in one order.
pub trait Sum: Copy + Default + PartialEq {
    /// The sum as a number.
    fn value(self) -> f32;
    /// Its bits.
    fn bits(self) -> u32;
    /// From bits.
    fn from_bits(bits: u32) -> Self;
}

impl Sum for i32 {
    #[inline(always)]
    fn value(self) -> f32 {
        self as f32
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        self as u32
    }
    #[inline(always)]
    fn from_bits(bits: u32) -> Self {
        bits as i32
    }
}

impl Sum for i16 {
    #[inline(always)]
    fn value(self) -> f32 {
        f32::from(self)
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        self as u32
    }
    #[inline(always)]
    fn from_bits(bits: u32) -> Self {
        bits as i16
    }
}

impl Sum for f32 {
    #[inline(always)]
    fn value(self) -> f32 {
        self
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        self.to_bits()
    }
    #[inline(always)]
    fn from_bits(bits: u32) -> Self {
        f32::from_bits(bits)
    }
}

/// Below this a float sum is taken for nothing: colours over denormal sums lose their digits
/// (E / tau of a denormal is off by half).
const FAINTEST: f32 = 1e-30;

/// The arithmetic of a closing sheet, with the constants of one view.
#[derive(Clone, Copy, Debug)]
pub struct Rule {
    compositing: Compositing,
    /// Optical depth of one raw unit.
    unit: f32,
    /// Weight of the sheet before and of the one behind.
    gain_before: f32,
    gain_behind: f32,
    eps: f32,
}

impl Rule {
    /// `unit`: optical depth of a raw unit; `y`: sheet thickness over the kernel's standard
    /// deviation along the view axis; `eps`: transmittance below which a pixel is shut.
    pub fn new(compositing: Compositing, unit: f32, y: f64, eps: f32) -> Self {
        // Fitted on five volumes; their sum tends to 1 with y, which restores fourth order.
        let gain_before = 0.5 + 0.20 * y;
        let gain_behind = (0.5 - 0.07 * y).max(0.25);
        Rule {
            compositing,
            unit,
            // Sheets far thicker than the kernel have no slope to speak of; the clamp below
            // holds the rest.
            gain_before: gain_before.min(2.0) as f32,
            gain_behind: gain_behind as f32,
            eps,
        }
    }

    /// Whether a pixel with opacity `a` is shut for good.
    #[inline(always)]
    pub fn is_shut(&self, a: f32) -> bool {
        1.0 - a < self.eps
    }

    /// Optical depth of a raw sum along a ray (the sum of opacities, for the paper's compositing).
    #[inline(always)]
    pub fn optical_depth(&self, raw: f32, secant: f32) -> f32 {
        raw * self.unit * secant
    }

    /// Closes a sheet at one pixel: `before`, `here` and `behind` are the raw sums of sheets
    /// k-1, k and (half filled) k+1; `secant` the ray's length in the sheet over its thickness.
    /// Adds to the opacity `a` and to the fixed-point colour.
    #[inline(always)]
    pub fn close<S: Sum>(
        &self,
        before: [S; 4],
        here: [S; 4],
        behind: [S; 4],
        secant: f32,
        a: &mut f32,
        colour: &mut [u32; 3],
    ) {
        let raw = here[0].value();
        if raw < FAINTEST {
            return;
        }
        let tau = self.optical_depth(raw, secant);
        let (sheet_a, weight) = match self.compositing {
            Compositing::Paper => (tau.min(1.0), 0.0),
            Compositing::Constant => (opacity(tau), 0.0),
            Compositing::Linear => {
                let o = opacity(tau);
                (o, if tau > 0.0 { phi(tau, o) } else { 0.0 })
            }
        };
        let transmittance = 1.0 - *a;
        let per_raw = 1.0 / raw;
        if weight == 0.0 {
            for ch in 0..3 {
                let c = here[ch + 1].value() * per_raw;
                add_colour(&mut colour[ch], transmittance * (c * sheet_a));
            }
        } else {
            let (tl, tn) = (before[0].value(), behind[0].value());
            // Ratios before squares: sums reach 1e15.
            let ml = 1.0 / tl.max(raw);
            let (ql, qh) = (tl * ml, raw * ml);
            // The sheet before counts unless it is below 2 % of this one.
            let wl = self.gain_before * (ql * ql) / (ql * ql + 4e-4 * (qh * qh));
            let per_tl = if tl > FAINTEST { 1.0 / tl } else { 0.0 };
            // A thin, noisy sheet behind fades out.
            let mn = 1.0 / tn.max(raw);
            let (rn, rh) = (tn * mn, raw * mn);
            let wr = self.gain_behind / (rn + 0.05 * rh);
            for ch in 0..3 {
                let c = here[ch + 1].value() * per_raw;
                let cl = before[ch + 1].value() * per_tl;
                let en = behind[ch + 1].value() * mn;
                let change = wl * (c - cl) + wr * (en - c * rn);
                // The colour stays between 0 and 1 through the sheet, so 0 <= C <= A.
                let most = 2.0 * c.min(1.0 - c).max(0.0);
                let change = change.min(most).max(-most);
                add_colour(&mut colour[ch], transmittance * (c * sheet_a + change * weight));
            }
        }
        *a += transmittance * sheet_a;
    }
}

/// Sums and state of up to [`LANES`] pixels beside each other, channel by channel: what
/// [`Rule::close_row`] works on. Lanes are pixels.
#[derive(Clone)]
pub struct Row {
    /// Raw sums of sheet k-1: extinction and three colours.
    pub before: [[f32; LANES]; 4],
    /// Of sheet k.
    pub here: [[f32; LANES]; 4],
    /// Of sheet k+1 as it stands.
    pub behind: [[f32; LANES]; 4],
    /// Length of the rays in the sheet over its thickness.
    pub secant: [f32; LANES],
    /// Opacity before, and after.
    pub a: [f32; LANES],
    /// What the sheet adds to the fixed-point colour.
    pub light: [[u32; LANES]; 3],
}

/// Pixels of a [`Row`]: a block's row. More would be filled with pixels that nothing touched.
pub const LANES: usize = 8;

impl Default for Row {
    fn default() -> Self {
        Row {
            before: [[0.0; LANES]; 4],
            here: [[0.0; LANES]; 4],
            behind: [[0.0; LANES]; 4],
            secant: [1.0; LANES],
            a: [0.0; LANES],
            light: [[0; LANES]; 3],
        }
    }
}

impl Rule {
    /// [`Rule::close`] for pixels beside each other, without a branch a pixel: the same
    /// operations in the same order, so the same bytes.
    #[inline(always)]
    pub fn close_row(&self, row: &mut Row) {
        match self.compositing {
            Compositing::Linear => self.close_lanes::<true, false>(row),
            Compositing::Constant => self.close_lanes::<false, false>(row),
            Compositing::Paper => self.close_lanes::<false, true>(row),
        }
    }

    #[inline(always)]
    fn close_lanes<const LINEAR: bool, const PAPER: bool>(&self, row: &mut Row) {
        const ONE: f32 = (1u32 << 28) as f32;
        for i in 0..LANES {
            let filled = row.here[0][i] >= FAINTEST;
            let raw = if filled { row.here[0][i] } else { 1.0 };
            let tau = raw * self.unit * row.secant[i];
            let tau = if filled { tau } else { 0.0 };
            let sheet_a = if PAPER { tau.min(1.0) } else { opacity(tau) };
            let transmittance = 1.0 - row.a[i];
            let per_raw = 1.0 / raw;
            if LINEAR {
                let weight = phi(tau, sheet_a);
                let weight = if tau > 0.0 { weight } else { 0.0 };
                let (tl, tn) = (row.before[0][i], row.behind[0][i]);
                let ml = 1.0 / tl.max(raw);
                let (ql, qh) = (tl * ml, raw * ml);
                let wl = self.gain_before * (ql * ql) / (ql * ql + 4e-4 * (qh * qh));
                let seen = tl > FAINTEST;
                let per_tl = 1.0 / if seen { tl } else { 1.0 };
                let per_tl = if seen { per_tl } else { 0.0 };
                let mn = 1.0 / tn.max(raw);
                let (rn, rh) = (tn * mn, raw * mn);
                let wr = self.gain_behind / (rn + 0.05 * rh);
                for ch in 0..3 {
                    let c = row.here[ch + 1][i] * per_raw;
                    let cl = row.before[ch + 1][i] * per_tl;
                    let en = row.behind[ch + 1][i] * mn;
                    let change = wl * (c - cl) + wr * (en - c * rn);
                    let most = 2.0 * c.min(1.0 - c).max(0.0);
                    let change = change.min(most).max(-most);
                    let light = transmittance * (c * sheet_a + change * weight);
                    row.light[ch][i] = (light * ONE + 0.5).max(0.0) as i32 as u32;
                }
            } else {
                for ch in 0..3 {
                    let c = row.here[ch + 1][i] * per_raw;
                    let light = transmittance * (c * sheet_a);
                    row.light[ch][i] = (light * ONE + 0.5).max(0.0) as i32 as u32;
                }
            }
            row.a[i] += transmittance * sheet_a;
        }
    }
}

/// One rounding a sheet: colour of any cut into slabs adds up to the same integers.
#[inline(always)]
fn add_colour(to: &mut u32, light: f32) {
    const ONE: f32 = (1u32 << 28) as f32;
    // Not negative but for the last bits of f32; `as` takes those to zero.
    *to = to.wrapping_add((light * ONE + 0.5) as u32);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Rows against the plain arithmetic, bit by bit: empty, faint, thick and huge sheets.
        #[test]
        fn a_row_closes_as_its_pixels_do(
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
                let was = row.clone();
                rule.close_row(&mut row);
                for i in 0..LANES {
                    let of = |p: &[[f32; LANES]; 4]| p.map(|ch| ch[i]);
                    let (mut a, mut colour) = (was.a[i], [0u32; 3]);
                    let (b, h, n) = (of(&was.before), of(&was.here), of(&was.behind));
                    rule.close(b, h, n, was.secant[i], &mut a, &mut colour);
                    prop_assert_eq!(row.a[i].to_bits(), a.to_bits());
                    prop_assert_eq!(row.light.map(|l| l[i]), colour, "{:?} {:?} {:?}", b, h, n);
                }
            }
        }
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
        fn colour_stays_between_nothing_and_opacity(
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
    fn a_constant_colour_comes_back_exactly() {
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
    fn linear_beats_constant_on_a_ramp_of_colour() {
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
    fn the_papers_sum_is_clamped() {
        let (a, c) =
            stack(Compositing::Paper, 1.0, &[[0.5, 0.25, 0.0, 0.5], [3.0, 3.0, 0.0, 0.0]], 0.0);
        assert_eq!(a, 1.0);
        assert!((c[0] - (0.25 + 0.5)).abs() < 1e-8 && (c[2] - 0.5).abs() < 1e-8);
    }

    #[test]
    fn faint_layers_by_the_ten_thousand_keep_their_digits() {
        let sheets = vec![[1e-6f32, 5e-7, 0.0, 1e-6]; 10_000];
        let (a, c) = stack(Compositing::Linear, 1.0, &sheets, 0.0);
        let want = -libm::expm1(-0.01);
        assert!((f64::from(a) - want).abs() / want < 1e-5, "{a} against {want}");
        // Colour has a unit of 2^-28: 10^4 roundings of half a unit at most.
        assert!((c[0] - want / 2.0).abs() < 1e4 * 0.5 / f64::from(1u32 << 28) + 1e-7);
    }
}
