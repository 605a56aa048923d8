//! Compositing: what a closing sheet adds to a pixel.
//!
//! In optical depth t a sheet's light is the integral of C(t) exp(-t): extinction itself drops
//! out. c = E / tau is the exact mean of C and tau is exact, so A is exact for any thickness;
//! only the slope of C inside the sheet is missing. The rule NL estimates it from the sheets
//! before and behind, the latter *half filled*: what voxels that begin no later than this sheet
//! have put into the next one (the peek). That is as accurate as the finished sheet, needs no
//! latency, and is the same for every tile, order and culling, since "begins no later" is a
//! matter of the absolute sheet grid (docs/design/numerics.md, section 1.2).

pub mod field;

use crate::kernels::truncate;
use slabcast_common::math::{PHI_SERIES_BELOW, opacity, phi, phi_both};
use slabcast_common::quality::Compositing;

/// A sum of a sheet: integers, whose sum has no order, or floats, added in one order.
pub trait Sum: Copy + Default + PartialEq {
    /// Whether sums are whole numbers below 2^31.
    const WHOLE: bool;
    /// The sum as a number.
    fn value(self) -> f32;
    /// Bits of the sum, as it travels.
    fn bits(self) -> u32;
    /// From bits.
    fn from_bits(bits: u32) -> Self;
}

impl Sum for i32 {
    const WHOLE: bool = true;
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
    const WHOLE: bool = true;
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
    const WHOLE: bool = false;
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

/// Weight of the squared sheet against the squared sheet before it in the neighbour-linear rule:
/// the sheet before counts unless it is below 2 % of this one (docs/design/numerics.md section
/// 1.2).
pub(crate) const FAINT_BEFORE: f32 = 4e-4;

/// Weight of the sheet beside the one behind it in the neighbour-linear rule: thin, noisy sheets
/// behind fade out (docs/design/numerics.md section 1.2).
pub(crate) const FADE_BEHIND: f32 = 0.05;

/// Below this a float sum is taken for nothing: colours over denormal sums lose their digits
/// (E / tau of a denormal is off by half).
pub(crate) const FAINTEST: f32 = 1e-30;

/// The arithmetic of a closing sheet, with the constants of one view.
#[derive(Clone, Copy, Debug)]
pub struct Rule {
    pub(crate) compositing: Compositing,
    /// Optical depth of one raw unit, and raw units of one of optical depth.
    pub(crate) unit: f32,
    pub(crate) per_unit: f32,
    /// Weight of the sheet before and of the one behind.
    pub(crate) gain_before: f32,
    pub(crate) gain_behind: f32,
    pub(crate) eps: f32,
}

impl Rule {
    /// Makes the rule for a view. `unit` is the optical depth of a raw unit, `y` the sheet
    /// thickness over the kernel's standard deviation along the view axis (unitless), `eps` the
    /// transmittance below which a pixel is shut.
    pub fn new(compositing: Compositing, unit: f32, y: f64, eps: f32) -> Self {
        // Fitted on five volumes; their sum tends to 1 with y, which restores fourth order.
        let gain_before = 0.5 + 0.20 * y;
        let gain_behind = (0.5 - 0.07 * y).max(0.25);
        Rule {
            compositing,
            unit,
            per_unit: 1.0 / unit,
            // Sheets far thicker than the kernel have no slope to speak of; the clamp below
            // holds the rest.
            gain_before: gain_before.min(2.0) as f32,
            gain_behind: gain_behind as f32,
            eps,
        }
    }

    /// Returns this rule without a cut-off: no pixel is ever shut.
    #[must_use]
    pub(crate) fn never_shut(self) -> Self {
        Rule { eps: 0.0, ..self }
    }

    /// Returns whether a pixel with opacity `a` (0 to 1) is shut for good.
    #[inline(always)]
    pub fn is_shut(&self, a: f32) -> bool {
        1.0 - a < self.eps
    }

    /// Returns the optical depth of a raw sum along a ray (the sum of opacities, for the paper's
    /// compositing). `secant` is the ray's length in a sheet over the sheet's thickness.
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
        let per_raw = 1.0 / raw;
        let per_tau = per_raw * self.per_unit * (1.0 / secant);
        let (sheet_a, weight) = match self.compositing {
            Compositing::Paper => (tau.min(1.0), 0.0),
            Compositing::Constant => (opacity(tau), 0.0),
            Compositing::Linear => {
                let o = opacity(tau);
                (o, if tau > 0.0 { phi(tau, per_tau, o) } else { 0.0 })
            }
        };
        let transmittance = 1.0 - *a;
        if weight == 0.0 {
            for ch in 0..3 {
                let c = here[ch + 1].value() * per_raw;
                colour[ch] = colour[ch].wrapping_add(fixed_light(transmittance * (c * sheet_a)));
            }
        } else {
            let (tl, tn) = (before[0].value(), behind[0].value());
            let slopes =
                if S::WHOLE { self.slopes_whole(tl, raw, tn) } else { self.slopes(tl, raw, tn) };
            for ch in 0..3 {
                let c = here[ch + 1].value() * per_raw;
                let (el, en) = (before[ch + 1].value(), behind[ch + 1].value());
                let light = c * sheet_a + slopes.change(c, el, tn, en) * weight;
                colour[ch] = colour[ch].wrapping_add(fixed_light(transmittance * light));
            }
        }
        *a += transmittance * sheet_a;
    }

    /// Returns the slopes of the colour through a sheet with sum `h`, between a sheet with sum `tl`
    /// before it and one with `tn` behind. Ratios are taken before squares, since sums reach 1e15.
    #[inline(always)]
    fn slopes(&self, tl: f32, h: f32, tn: f32) -> Slopes {
        let ml = 1.0 / tl.max(h);
        let (ql, qh) = (tl * ml, h * ml);
        // The sheet before counts unless it is below 2 % of this one.
        let before = self.gain_before * (ql * ql) / (ql * ql + FAINT_BEFORE * (qh * qh));
        let seen = tl > FAINTEST;
        let per_tl = 1.0 / if seen { tl } else { 1.0 };
        let per_tl = if seen { per_tl } else { 0.0 };
        // A thin, noisy sheet behind fades out.
        let unit = 1.0 / tn.max(h);
        let behind = self.gain_behind / (tn * unit + FADE_BEHIND * (h * unit));
        Slopes { before, per_tl, behind, unit }
    }

    /// [`Rule::slopes`] for whole numbers from 1 to 2^31 (the neighbours from 0): one division
    /// instead of five, since their products stay below 2e37 and above 2e-5.
    #[inline(always)]
    fn slopes_whole(&self, tl: f32, h: f32, tn: f32) -> Slopes {
        let squares = tl * tl + FAINT_BEFORE * (h * h);
        let sum = tn + FADE_BEHIND * h;
        let some = tl.max(1.0);
        let per_all = 1.0 / (some * (squares * sum));
        Slopes {
            before: self.gain_before * (tl * tl) * ((some * sum) * per_all),
            // Nothing over 1 is nothing, too.
            per_tl: (squares * sum) * per_all,
            behind: self.gain_behind * ((some * squares) * per_all),
            unit: 1.0,
        }
    }
}

/// Slopes of colour in a sheet, as [`Rule::slopes`] computes them.
struct Slopes {
    /// Weight of the sheet before, and what makes a colour of its sums.
    before: f32,
    per_tl: f32,
    /// Weight of the sheet behind, for its sums times `unit`.
    behind: f32,
    unit: f32,
}

impl Slopes {
    /// Change of one component through a sheet of colour `c`, whose neighbours sum to `el` and,
    /// for an optical depth of `tn`, to `en`.
    #[inline(always)]
    fn change(&self, c: f32, el: f32, tn: f32, en: f32) -> f32 {
        let ahead = en * self.unit - c * (tn * self.unit);
        let change = self.before * (c - el * self.per_tl) + self.behind * ahead;
        // The colour stays between 0 and 1 through the sheet, so 0 <= C <= A.
        let most = 2.0 * c.min(1.0 - c).max(0.0);
        change.min(most).max(-most)
    }
}

/// One in the fixed point of light.
pub(crate) const ONE: f32 = (1u32 << 28) as f32;

/// Light in fixed point. One rounding a sheet: colour of any cut into slabs adds up to the same
/// integers.
#[inline(always)]
fn fixed_light(light: f32) -> u32 {
    // Not negative but for the last bits of f32.
    truncate(light * ONE + 0.5)
}

/// `yes` if `which`, else `no`: both are worked out, and no branch is made of it.
#[inline(always)]
fn select(which: bool, yes: f32, no: f32) -> f32 {
    let mask = u32::from(which).wrapping_neg();
    f32::from_bits(yes.to_bits() & mask | no.to_bits() & !mask)
}

/// Sums and state of up to [`LANES`] pixels, channel by channel: what
/// [`Rule::close_row`] works on. Lanes are pixels.
#[derive(Clone)]
pub struct Row {
    /// Raw sums of sheet k-1 by channel (extinction, three colours times extinction) and lane.
    pub before: [[f32; LANES]; 4],
    /// Raw sums of sheet k, which closes, by channel and lane.
    pub here: [[f32; LANES]; 4],
    /// Raw sums of sheet k+1 as it stands, half filled, by channel and lane.
    pub behind: [[f32; LANES]; 4],
    /// Length of each ray in a sheet over the sheet's thickness; unitless, 1 or more.
    pub secant: [f32; LANES],
    /// Thickness of a sheet over the length of each ray in it; unitless, up to 1.
    pub cosine: [f32; LANES],
    /// Opacity of each pixel, 0 to 1: in front of the sheet before it closes, behind it afterwards.
    pub a: [f32; LANES],
    /// Light that the sheet adds to each pixel, by colour, in fixed point of 2^-28.
    pub light: [[u32; LANES]; 3],
}

/// Pixels of a [`Row`], which need not be neighbours: a register of AVX-512 or two of AVX2.
pub const LANES: usize = 16;

impl Default for Row {
    fn default() -> Self {
        Row {
            before: [[0.0; LANES]; 4],
            here: [[0.0; LANES]; 4],
            behind: [[0.0; LANES]; 4],
            secant: [1.0; LANES],
            cosine: [1.0; LANES],
            a: [0.0; LANES],
            light: [[0; LANES]; 3],
        }
    }
}

impl Rule {
    /// [`Rule::close`] of sums `S` for pixels beside each other, without a branch a pixel: the same
    /// operations in the same order, so the same bytes. `live` has a bit for each pixel that is
    /// open; others keep their opacity and get no light. Returns those that are shut now.
    #[inline(always)]
    pub fn close_row<S: Sum>(&self, row: &mut Row, live: u32) -> u32 {
        use Compositing::{Constant, Linear, Paper};
        match (self.compositing, S::WHOLE) {
            (Linear, true) => self.close_lanes::<true, true, false>(row, live),
            (Linear, false) => self.close_lanes::<true, false, false>(row, live),
            (Constant, _) => self.close_lanes::<false, true, false>(row, live),
            (Paper, _) => self.close_lanes::<false, true, true>(row, live),
        }
    }

    #[inline(always)]
    fn close_lanes<const LINEAR: bool, const WHOLE: bool, const PAPER: bool>(
        &self,
        row: &mut Row,
        live: u32,
    ) -> u32 {
        // Several short loops over plain arrays, with what they read of `self` beside them, and
        // selects by bits: of one long loop, of loads behind a condition or of branches compilers
        // make scalar code.
        let (unit, per_unit) = (self.unit, self.per_unit);
        let [mut taus, mut per_raws, mut raws, mut sheet] = [[0.0f32; LANES]; 4];
        for i in 0..LANES {
            let filled = row.here[0][i] >= FAINTEST;
            raws[i] = select(filled, row.here[0][i], 1.0);
            taus[i] = select(filled, raws[i] * unit * row.secant[i], 0.0);
            per_raws[i] = 1.0 / raws[i];
        }
        for i in 0..LANES {
            sheet[i] = if PAPER { taus[i].min(1.0) } else { opacity(taus[i]) };
        }
        let [mut weights, mut light] = [[0.0f32; LANES]; 2];
        for i in 0..LANES {
            let (small, large) =
                phi_both(taus[i], per_raws[i] * per_unit * row.cosine[i], sheet[i]);
            let weight = select(taus[i] < PHI_SERIES_BELOW, small, large);
            weights[i] = select(taus[i] > 0.0, weight, 0.0);
        }
        // An empty pixel has no colour, whatever its neighbours hold.
        let mut slopes = [[0.0f32; LANES]; 4];
        if LINEAR {
            for i in 0..LANES {
                let (tl, raw, tn) = (row.before[0][i], raws[i], row.behind[0][i]);
                let s =
                    if WHOLE { self.slopes_whole(tl, raw, tn) } else { self.slopes(tl, raw, tn) };
                (slopes[0][i], slopes[1][i]) = (s.before, s.per_tl);
                (slopes[2][i], slopes[3][i]) = (s.behind, s.unit);
            }
        }
        let mut a = row.a;
        for i in 0..LANES {
            light[i] = select(live >> i & 1 == 1, 1.0 - a[i], 0.0);
            a[i] += light[i] * sheet[i];
        }
        row.a = a;
        for ch in 0..3 {
            let [here, before, behind] =
                [&row.here, &row.before, &row.behind].map(|sums| &sums[ch + 1]);
            let out = &mut row.light[ch];
            for i in 0..LANES {
                let c = here[i] * per_raws[i];
                let mut of_sheet = c * sheet[i];
                if LINEAR {
                    let s = Slopes {
                        before: slopes[0][i],
                        per_tl: slopes[1][i],
                        behind: slopes[2][i],
                        unit: slopes[3][i],
                    };
                    let change = s.change(c, before[i], row.behind[0][i], behind[i]);
                    of_sheet += change * weights[i];
                }
                out[i] = fixed_light(light[i] * of_sheet);
            }
        }
        let mut shut = 0;
        for i in 0..LANES {
            shut |= u32::from(self.is_shut(a[i])) << i;
        }
        shut & live
    }
}
