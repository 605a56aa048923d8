//! Compositing of rows of pixels in registers.
//!
//! The operations are those of [`Rule::close_row`], one by one, for whole-number sums under the
//! linear rule; everything else is composited there. A row is one chain of some sixty operations
//! that wait for each other, so two rows are composited at once.

#[cfg(target_arch = "x86_64")]
use crate::kernels::Level;
use crate::kernels::composite::{Row, Rule, Sum};
use crate::kernels::{Simd, Work};
#[cfg(target_arch = "x86_64")]
use slabcast_common::quality::Compositing;
use std::marker::PhantomData;

/// Closes a sheet in several rows at once, each as [`Rule::close_row`] does. `live` has a bit for
/// each open pixel of each row; returned are the bits of pixels that are shut now.
#[inline(always)]
pub fn close_rows<S: Sum, const ROWS: usize>(
    simd: Simd,
    rule: &Rule,
    rows: &mut [Row; ROWS],
    live: [u32; ROWS],
) -> [u32; ROWS] {
    match simd.0 {
        // SAFETY: the value proves that the instructions are there.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 if S::WHOLE && rule.compositing == Compositing::Linear => unsafe {
            wide::avx512::<S, ROWS>(rule, rows, live)
        },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 if S::WHOLE && rule.compositing == Compositing::Linear => unsafe {
            wide::avx2::<S, ROWS>(rule, rows, live)
        },
        _ => simd.run(CloseRows { rule, rows, live, sums: PhantomData::<S> }),
    }
}

/// [`Rule::close_row`] for some rows, compiled by itself and not with all that calls it.
struct CloseRows<'a, S, const ROWS: usize> {
    rule: &'a Rule,
    rows: &'a mut [Row; ROWS],
    live: [u32; ROWS],
    sums: PhantomData<S>,
}

impl<S: Sum, const ROWS: usize> Work for CloseRows<'_, S, ROWS> {
    type Out = [u32; ROWS];
    #[inline(always)]
    fn run(self, _: Simd) -> [u32; ROWS] {
        let mut shut = [0; ROWS];
        for ((shut, row), live) in shut.iter_mut().zip(self.rows).zip(self.live) {
            *shut = self.rule.close_row::<S>(row, live);
        }
        shut
    }
}

#[cfg(target_arch = "x86_64")]
mod wide {
    use crate::kernels::LARGEST;
    use crate::kernels::composite::{
        FADE_BEHIND, FAINT_BEFORE, FAINTEST, LANES, ONE, Row, Rule, Sum,
    };
    use crate::kernels::lanes::{Eight, Floats, Sixteen};
    use slabcast_common::math::{LN2, PHI, PHI_SERIES_BELOW, ROUND_F32, TAYLOR};
    use std::slice::from_mut;

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(super) fn avx512<S: Sum, const ROWS: usize>(
        rule: &Rule,
        rows: &mut [Row; ROWS],
        live: [u32; ROWS],
    ) -> [u32; ROWS] {
        // SAFETY: these are the instructions.
        unsafe { close::<Sixteen, S, ROWS>(rule, rows, live) }
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn avx2<S: Sum, const ROWS: usize>(
        rule: &Rule,
        rows: &mut [Row; ROWS],
        live: [u32; ROWS],
    ) -> [u32; ROWS] {
        let mut shut = [0; ROWS];
        for ((row, live), shut) in rows.iter_mut().zip(live).zip(&mut shut) {
            // SAFETY: these are the instructions.
            let halves = unsafe { close::<Eight, S, 2>(rule, from_mut(row), [live, live >> 8]) };
            *shut = halves[0] | halves[1] << 8;
        }
        shut
    }

    /// A polynomial in `x`, highest power first.
    #[inline(always)]
    unsafe fn polynomial<L: Floats, const N: usize>(
        coefficients: &[f32; N],
        x: L::Floats,
    ) -> L::Floats {
        // SAFETY: the caller has these instructions.
        unsafe {
            let mut p = L::all(coefficients[0]);
            for c in &coefficients[1..] {
                p = L::add(L::mul(p, x), L::all(*c));
            }
            p
        }
    }

    /// `slabcast_common::math::opacity`.
    #[inline(always)]
    unsafe fn opacity<L: Floats>(tau: L::Floats) -> L::Floats {
        // SAFETY: the caller has these instructions.
        unsafe {
            let magic = L::all(ROUND_F32);
            let x = L::most(L::sub(L::all(-0.0), tau), L::all(-87.0));
            let shifted = L::add(L::mul(x, L::all(std::f32::consts::LOG2_E)), magic);
            let n = L::sub(shifted, magic);
            let r = L::sub(x, L::mul(n, L::all(LN2[0])));
            let r = L::sub(r, L::mul(n, L::all(LN2[1])));
            let q = L::mul(polynomial::<L, 7>(&TAYLOR, r), r);
            let exponent = L::minus(L::to_bits(shifted), L::to_bits(magic));
            let s = L::from_bits(L::up(L::plus(exponent, L::set(127)), 23));
            L::sub(L::sub(L::all(1.0), s), L::mul(s, q))
        }
    }

    /// State of some pixels before their colours are looked at.
    #[derive(Clone, Copy)]
    struct Pixels<F> {
        raw: F,
        per_raw: F,
        tau: F,
        /// Opacity of the sheet.
        opacity: F,
        /// Of the change of colour through it.
        weight: F,
        before: F,
        per_before: F,
        behind: F,
        /// Share of light that comes through from the sheet on.
        light: F,
    }

    /// Closes the lanes of some rows, a register after the other; says which of each one's are shut
    /// now.
    ///
    /// # Safety
    /// The instructions are there.
    #[inline(always)]
    unsafe fn close<L: Floats, S: Sum, const REGISTERS: usize>(
        rule: &Rule,
        rows: &mut [Row],
        live: [u32; REGISTERS],
    ) -> [u32; REGISTERS] {
        const { assert!(LANES.is_multiple_of(L::LANES)) };
        assert_eq!(rows.len() * LANES, REGISTERS * L::LANES, "lanes of all rows");
        // Which row has a register's lanes, and from where on.
        let at = |r: usize| (r * L::LANES / LANES, r * L::LANES % LANES);
        // SAFETY: the caller's; each row has so many lanes.
        unsafe {
            let load = |lanes: &[f32; LANES], from: usize| L::load_floats(lanes.as_ptr().add(from));
            let (zero, one) = (L::all(0.0), L::all(1.0));
            let mut pixels = [Pixels {
                raw: zero,
                per_raw: zero,
                tau: zero,
                opacity: zero,
                weight: zero,
                before: zero,
                per_before: zero,
                behind: zero,
                light: zero,
            }; REGISTERS];
            for (r, p) in pixels.iter_mut().enumerate() {
                let (row, from) = at(r);
                let row = &rows[row];
                let here = load(&row.here[0], from);
                let filled = L::from_on(here, L::all(FAINTEST));
                p.raw = L::select(filled, here, one);
                let tau = L::mul(p.raw, L::all(rule.unit));
                p.tau = L::only(filled, L::mul(tau, load(&row.secant, from)));
                p.per_raw = L::div(one, p.raw);
            }
            for p in &mut pixels {
                p.opacity = opacity::<L>(p.tau);
            }
            for (r, p) in pixels.iter_mut().enumerate() {
                let (row, from) = at(r);
                let tau = p.tau;
                let small = L::mul(L::mul(polynomial::<L, 5>(&PHI, tau), tau), tau);
                let per_tau = L::mul(p.per_raw, L::all(rule.per_unit));
                let per_tau = L::mul(per_tau, load(&rows[row].cosine, from));
                let half = L::mul(p.opacity, L::all(0.5));
                let large = L::sub(L::add(L::mul(p.opacity, per_tau), half), one);
                let weight = L::select(L::below(tau, L::all(PHI_SERIES_BELOW)), small, large);
                p.weight = L::only(L::below(zero, tau), weight);
            }
            for (r, p) in pixels.iter_mut().enumerate() {
                let (row, from) = at(r);
                let row = &rows[row];
                let (tl, tn) = (load(&row.before[0], from), load(&row.behind[0], from));
                let tl_2 = L::mul(tl, tl);
                let h_2 = L::mul(L::all(FAINT_BEFORE), L::mul(p.raw, p.raw));
                let squares = L::add(tl_2, h_2);
                let sum = L::add(tn, L::mul(L::all(FADE_BEHIND), p.raw));
                let some = L::most(tl, one);
                let both = L::mul(squares, sum);
                let per_all = L::div(one, L::mul(some, both));
                let gain = L::mul(L::all(rule.gain_before), tl_2);
                p.before = L::mul(gain, L::mul(L::mul(some, sum), per_all));
                p.per_before = L::mul(both, per_all);
                let share = L::mul(L::mul(some, squares), per_all);
                p.behind = L::mul(L::all(rule.gain_behind), share);
            }
            let mut shut = [0; REGISTERS];
            for (r, p) in pixels.iter_mut().enumerate() {
                let (row, from) = at(r);
                let here = live[r] & ((1 << L::LANES) - 1);
                let a = load(&rows[row].a, from);
                p.light = L::only(L::marks(here), L::sub(one, a));
                let a = L::add(a, L::mul(p.light, p.opacity));
                shut[r] = L::bits(L::below(L::sub(one, a), L::all(rule.eps))) & here;
                L::put_floats(rows[row].a.as_mut_ptr().add(from), a);
            }
            for ch in 0..if S::GREY { 1 } else { 3 } {
                for (r, p) in pixels.iter().enumerate() {
                    let (row, from) = at(r);
                    let row = &mut rows[row];
                    let el = load(&row.before[ch + 1], from);
                    let en = load(&row.behind[ch + 1], from);
                    let tn = load(&row.behind[0], from);
                    let c = L::mul(load(&row.here[ch + 1], from), p.per_raw);
                    let ahead = L::sub(en, L::mul(c, tn));
                    let back = L::sub(c, L::mul(el, p.per_before));
                    let change = L::add(L::mul(p.before, back), L::mul(p.behind, ahead));
                    let most = L::most(L::least(c, L::sub(one, c)), zero);
                    let most = L::mul(L::all(2.0), most);
                    let change = L::most(L::least(change, most), L::sub(zero, most));
                    let of_sheet = L::add(L::mul(c, p.opacity), L::mul(change, p.weight));
                    let light = L::mul(L::mul(p.light, of_sheet), L::all(ONE));
                    let light = L::add(light, L::all(0.5));
                    let light = L::least(L::most(light, zero), L::all(LARGEST));
                    L::store(row.light[ch].as_mut_ptr().add(from), L::truncated(light));
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
}
