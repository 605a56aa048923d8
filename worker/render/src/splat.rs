//! The innermost loop: a section of a voxel is added to a sheet.
//!
//! The loop is written once, plainly, over pixels of four sums; it is compiled for the
//! machine's baseline and again for AVX2 and AVX-512, and chosen at run time. There is no
//! fused multiply-add in it and compilers may not invent one, so all give the same bytes.
//!
//! This module is the wall: the only place with `unsafe`. It holds two things: the call of a
//! function compiled for instructions that were seen on this machine, and the conversion of a
//! float to an integer without the range check that would double the loop's cost.
#![expect(unsafe_code, reason = "the one wall: run-time dispatch and unchecked conversion")]

use crate::sheet::Sum;

/// Pixels of one open sheet of a tile part.
pub type Pixels<S> = [[S; 4]];

/// How contributions are added.
pub trait Accumulate: Sum {
    /// `self` and a contribution, which is not negative. Integers round to nearest; what would
    /// leave them is held at their end (`Frame::raw_scale` leaves room, so nothing does).
    fn plus(self, contribution: f32) -> Self;
}

/// The largest f32 below 2^31.
const LARGEST: f32 = 2_147_483_520.0;

impl Accumulate for i32 {
    #[inline(always)]
    fn plus(self, contribution: f32) -> Self {
        // Written as selects so that NaN too ends inside the range.
        let c = contribution + 0.5;
        let c = if c < LARGEST { c } else { LARGEST };
        let c = if c > 0.0 { c } else { 0.0 };
        // SAFETY: c is in [0, LARGEST], which fits i32.
        self.wrapping_add(unsafe { c.to_int_unchecked::<i32>() })
    }
}

impl Accumulate for f32 {
    #[inline(always)]
    fn plus(self, contribution: f32) -> Self {
        self + contribution
    }
}

/// An instruction set that was seen on this machine. Holding the value is the proof.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Simd(Level);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Level {
    Plain,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Simd {
    /// The widest that this machine has.
    pub fn detect() -> Self {
        *Self::all().last().expect("plain is always there")
    }

    /// The baseline.
    pub fn plain() -> Self {
        Simd(Level::Plain)
    }

    /// All that this machine has, plain first.
    pub fn all() -> Vec<Self> {
        #[allow(unused_mut, reason = "grows on x86-64 only")]
        let mut all = vec![Simd(Level::Plain)];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") {
                all.push(Simd(Level::Avx2));
            }
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512bw")
            {
                all.push(Simd(Level::Avx512));
            }
        }
        all
    }

    /// For people.
    pub fn name(self) -> &'static str {
        match self.0 {
            Level::Plain => "plain",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => "avx512",
        }
    }
}

/// Adds one section: `((payload * w_z) * w_y) * w_x`, in this order everywhere, to the pixels
/// of rows `y0..` and columns `x0..` of a sheet with `stride` pixels a row. `section` is
/// `payload * w_z`.
///
/// # Panics
/// If the footprint leaves the sheet.
#[inline]
pub fn splat<S: Accumulate>(
    simd: Simd,
    sheet: &mut Pixels<S>,
    stride: usize,
    x: (usize, &[f32]),
    y: (usize, &[f32]),
    section: [f32; 4],
) {
    match simd.0 {
        Level::Plain => rows(sheet, stride, x, y, section),
        // SAFETY: the value proves that the instructions are there (`Simd::all`).
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { rows_avx2(sheet, stride, x, y, section) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { rows_avx512(sheet, stride, x, y, section) },
    }
}

#[inline(always)]
fn rows<S: Accumulate>(
    sheet: &mut Pixels<S>,
    stride: usize,
    (x0, wx): (usize, &[f32]),
    (y0, wy): (usize, &[f32]),
    section: [f32; 4],
) {
    for (j, &w) in wy.iter().enumerate() {
        let row = (y0 + j) * stride + x0;
        let p = section.map(|c| c * w);
        for (pixel, &w) in sheet[row..row + wx.len()].iter_mut().zip(wx) {
            for c in 0..4 {
                pixel[c] = pixel[c].plus(p[c] * w);
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn rows_avx2<S: Accumulate>(
    sheet: &mut Pixels<S>,
    stride: usize,
    x: (usize, &[f32]),
    y: (usize, &[f32]),
    section: [f32; 4],
) {
    rows(sheet, stride, x, y, section);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
fn rows_avx512<S: Accumulate>(
    sheet: &mut Pixels<S>,
    stride: usize,
    x: (usize, &[f32]),
    y: (usize, &[f32]),
    section: [f32; 4],
) {
    rows(sheet, stride, x, y, section);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_instruction_set_gives_the_same_bytes() {
        for n in 0..40usize {
            let wx: Vec<f32> = (0..n).map(|i| 1.0 / (1.7 + i as f32)).collect();
            let wy: Vec<f32> = (0..7).map(|i| 0.9 / (1.0 + i as f32)).collect();
            let section = [1.9e8, 1.1e8, 7.7, 0.3];
            let run = |simd| {
                let mut ints = vec![[5i32; 4]; 64 * 9];
                let mut floats = vec![[0.1f32; 4]; 64 * 9];
                splat(simd, &mut ints, 64, (3, &wx), (1, &wy), section);
                splat(simd, &mut floats, 64, (3, &wx), (1, &wy), section);
                (ints, floats)
            };
            let want = run(Simd::plain());
            for simd in Simd::all() {
                assert!(run(simd) == want, "{} differs at width {n}", simd.name());
            }
        }
    }

    #[test]
    fn integers_round_to_nearest() {
        let mut sheet = vec![[0i32; 4]; 1];
        splat(Simd::plain(), &mut sheet, 1, (0, &[1.0]), (0, &[1.0]), [2.4, 2.6, 0.49, 0.0]);
        assert_eq!(sheet[0], [2, 3, 0, 0]);
    }

    #[test]
    fn nothing_leaves_the_integers() {
        let mut sheet = vec![[0i32; 4]; 1];
        let wild = [3e9, f32::NAN, f32::INFINITY, -5.0];
        splat(Simd::detect(), &mut sheet, 1, (0, &[1.0]), (0, &[1.0]), wild);
        assert_eq!(sheet[0], [2_147_483_520, 2_147_483_520, 2_147_483_520, 0]);
    }
}
