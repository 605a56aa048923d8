//! The innermost loops: sections of voxels are added to sheets, and sheets are composited.
//!
//! Loops are written once, plainly; they are compiled for the machine's baseline and on x86-64
//! again for AVX2 and AVX-512, and chosen at run time ([`Simd`]). On 64-bit ARM NEON is in the
//! baseline; what compilers do not make of the plain loops is written for it. No fused multiply-add
//! is used and compilers may not invent one, so all give the same bytes.
//!
//! This room is the wall: the only one with `unsafe`. It holds two things: calls of functions
//! compiled for instructions that were detected on this machine, and conversions of floats to
//! integers without the range check that would double the loop's cost.
#![expect(unsafe_code, reason = "the one wall: run-time dispatch, unchecked conversion, lanes")]

/// Functions that are compiled for some features.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! with {
    ($features:literal $(
        fn $name:ident ($($arg:ident: $ty:ty),*) $(-> $out:ty)? $body:block
    )*) => {$(
        #[target_feature(enable = $features)]
        #[inline]
        unsafe fn $name ($($arg: $ty),*) $(-> $out)? $body
    )*};
}

pub mod composite;
pub mod field;
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod lanes;
pub mod lut;
pub mod pixel_records;
pub mod toss;
pub mod touched;

use crate::kernels::composite::Sum;
pub use crate::primitives::Tap;
use crate::primitives::footprint::{Footprint, Sections};

/// Pixels of one open sheet of a tile part.
pub type Pixels<S> = [[S; 4]];

/// A weight across the view axis, as sums of one kind want it.
pub trait Weight: Copy + Default + PartialEq + std::fmt::Debug {
    /// Weights along `axis`: see [`Footprint::weights`].
    fn of<'b>(
        footprint: &'b Footprint<'_>,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<Self>,
    ) -> (i32, &'b [Self]);
}

impl Weight for Tap {
    #[inline(always)]
    fn of<'b>(
        footprint: &'b Footprint<'_>,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<Tap>,
    ) -> (i32, &'b [Tap]) {
        footprint.weights(axis, pos, clip, buffer)
    }
}

impl Weight for i16 {
    #[inline(always)]
    fn of<'b>(
        footprint: &'b Footprint<'_>,
        axis: usize,
        pos: i64,
        clip: (i32, i32),
        buffer: &'b mut Vec<i16>,
    ) -> (i32, &'b [i16]) {
        footprint.weights_fixed(axis, pos, clip, buffer)
    }
}

/// Arithmetic of contributions: a section is `payload * w_z`, a row is `section * w_y`, and a pixel
/// gets `row * w_x`. Each kind of sums has its own rounding.
pub trait Accumulate: Sum {
    /// A weight across the view axis.
    type Weight: Weight;
    /// One channel of a section or a row.
    type Section: Copy;

    /// First sheet of a voxel at depth `z` (in phases), and its section in the `i`th from there.
    fn section(sections: &Sections, z: i32, i: usize, payload: &[f32; 4]) -> [Self::Section; 4];
    /// `section * wy`.
    fn row(section: Self::Section, wy: Self::Weight) -> Self::Section;
    /// `self + row * wx`.
    #[must_use]
    fn plus(self, row: Self::Section, wx: Self::Weight) -> Self;
}

/// One channel of a section of 32-bit sums, in raw units, or such a channel times weights. Neither
/// negative nor NaN.
#[derive(Clone, Copy, Debug, Default)]
pub struct Section(f32);

impl Section {
    /// Makes a channel of a section; negative numbers and NaN become zero.
    #[inline(always)]
    pub fn new(section: f32) -> Self {
        // A select, so that NaN too ends inside.
        Section(if section > 0.0 { section } else { 0.0 })
    }
}

/// Largest f32 below 2^31, a number of raw units: the largest sum that becomes an i32.
pub const LARGEST: f32 = 2_147_483_520.0;

/// Returns the whole number nearest to `x`, which is not negative, ties to even. What is larger
/// than an i32, or NaN, becomes [`LARGEST`]. One instruction on lanes, where nothing is larger.
#[inline(always)]
pub fn nearest(x: f32) -> i32 {
    let x = if x < LARGEST { x } else { LARGEST };
    // From here up f32s are whole, and a sum with it has no bits left for halves.
    const WHOLE: f32 = 8_388_608.0;
    let rounded = (x + WHOLE) - WHOLE;
    let rounded = if x < WHOLE { rounded } else { x };
    // SAFETY: it is 0 to LARGEST.
    unsafe { rounded.to_int_unchecked::<i32>() }
}

/// Returns the whole number nearest to `x`, ties to even. What is not an i32 becomes the nearest
/// that is, and NaN zero.
#[inline(always)]
pub fn nearest_signed(x: f32) -> i32 {
    let x = if x < LARGEST { x } else { LARGEST };
    let x = if x > -LARGEST { x } else { -LARGEST };
    // From here up f32s are whole, and a sum with it has no bits left for halves.
    const WHOLE: f32 = 8_388_608.0;
    let whole = WHOLE.copysign(x);
    let rounded = (x + whole) - whole;
    let rounded = if x.abs() < WHOLE { rounded } else { x };
    // SAFETY: it is -LARGEST to LARGEST; both selects give a bound for NaN.
    unsafe { rounded.to_int_unchecked::<i32>() }
}

/// 32-bit fixed point: one rounding, to nearest and of two to the even one, when a contribution is
/// added. What would leave the integers is held at their end (`Frame::raw_scale` leaves room, so
/// nothing does).
impl Accumulate for i32 {
    type Weight = Tap;
    type Section = Section;

    #[inline(always)]
    fn section(sections: &Sections, z: i32, i: usize, payload: &[f32; 4]) -> [Section; 4] {
        let wz = sections.of(z).1[i];
        payload.map(|p| Section::new(p * wz))
    }

    #[inline(always)]
    fn row(section: Section, wy: Tap) -> Section {
        Section(section.0 * wy.0)
    }

    #[inline(always)]
    fn plus(self, row: Section, wx: Tap) -> Self {
        // A section is not negative (`section`), nor is a weight (`Tap`), so their product is 0 to
        // infinity, or NaN for infinity times 0.
        self.wrapping_add(nearest(row.0 * wx.0))
    }
}

/// Floats, in one order.
impl Accumulate for f32 {
    type Weight = Tap;
    type Section = f32;

    #[inline(always)]
    fn section(sections: &Sections, z: i32, i: usize, payload: &[f32; 4]) -> [f32; 4] {
        let wz = sections.of(z).1[i];
        payload.map(|p| p * wz)
    }

    #[inline(always)]
    fn row(section: f32, wy: Tap) -> f32 {
        section * wy.0
    }

    #[inline(always)]
    fn plus(self, row: f32, wx: Tap) -> Self {
        self + row * wx.0
    }
}

/// Returns the product of two numbers in units of 2^-15, rounded to nearest: one instruction on
/// lanes.
#[inline(always)]
pub fn times(a: i16, b: i16) -> i16 {
    ((i32::from(a) * i32::from(b) + 0x4000) >> 15) as i16
}

/// 16-bit fixed point: payload, section and row are each rounded to nearest. Sums that would leave
/// the integers stay at their end; terms are not negative, so that too has no order.
impl Accumulate for i16 {
    type Weight = i16;
    type Section = i16;

    #[inline(always)]
    fn section(sections: &Sections, z: i32, i: usize, payload: &[f32; 4]) -> [i16; 4] {
        let wz = sections.of_fixed(z).1[i];
        section_fixed(payload.map(whole), wz)
    }

    #[inline(always)]
    fn row(section: i16, wy: i16) -> i16 {
        times(section, wy)
    }

    #[inline(always)]
    fn plus(self, row: i16, wx: i16) -> Self {
        self.saturating_add(times(row, wx))
    }
}

/// Returns the section of a 16-bit payload: each channel times the weight in depth `wz`, which is
/// in units of 2^-15.
#[inline(always)]
pub fn section_fixed(payload: [i16; 4], wz: i16) -> [i16; 4] {
    payload.map(|p| times(p, wz))
}

/// Returns a payload of 16-bit sums: `payload` rounded to nearest, 0 to 32767.
#[inline(always)]
pub fn whole(payload: f32) -> i16 {
    let bounded = bounded(payload + 0.5, 32767.0);
    // SAFETY: it is 0 to 32767.
    unsafe { bounded.to_int_unchecked::<i32>() as i16 }
}

/// `x` from 0 to `most`, 0 if it is not a number: two selects.
#[inline(always)]
fn bounded(x: f32, most: f32) -> f32 {
    let x = if x > 0.0 { x } else { 0.0 };
    if x < most { x } else { most }
}

/// Rounds `x` down to a whole number, 0 to 2^31; negative numbers and NaN become 0.
#[inline(always)]
pub fn truncate(x: f32) -> u32 {
    let bounded = bounded(x, LARGEST);
    // SAFETY: it is 0 to the largest f32 below 2^31.
    unsafe { bounded.to_int_unchecked::<i32>() as u32 }
}

/// An instruction set that was seen on this machine. Holding the value is the proof.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Simd(Level);

/// Instruction sets that kernels are written for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    Plain,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "aarch64")]
    Neon,
}

impl Simd {
    /// Returns the widest instruction set that this machine has.
    pub fn detect() -> Self {
        *Self::all().last().expect("plain is always there")
    }

    /// Returns the instruction set of the build's target, which every machine has.
    pub fn plain() -> Self {
        Simd(Level::Plain)
    }

    /// Returns all instruction sets that this machine has and this build was compiled for, the
    /// plain one first. Debug builds made on a machine with AVX-512 have no AVX2 (`build.rs`).
    pub fn all() -> Vec<Self> {
        #[allow(unused_mut, reason = "grows on x86-64 and 64-bit ARM only")]
        let mut all = vec![Simd(Level::Plain)];
        // Part of the baseline, but for machines without an operating system.
        #[cfg(target_arch = "aarch64")]
        if std::arch::is_aarch64_feature_detected!("neon") {
            all.push(Simd(Level::Neon));
        }
        #[cfg(target_arch = "x86_64")]
        {
            // Every CPU with AVX2 has these; a CPU that reports otherwise is not used.
            let counts_bits = is_x86_feature_detected!("popcnt")
                && is_x86_feature_detected!("lzcnt")
                && is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2");
            if cfg!(all_levels) && is_x86_feature_detected!("avx2") && counts_bits {
                all.push(Simd(Level::Avx2));
            }
            if counts_bits
                && is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512bw")
            {
                all.push(Simd(Level::Avx512));
            }
        }
        all
    }

    /// Returns the name of the instruction set for people, `avx2` for example.
    pub fn name(self) -> &'static str {
        match self.0 {
            Level::Plain => "plain",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => "avx512",
            #[cfg(target_arch = "aarch64")]
            Level::Neon => "neon",
        }
    }
}

/// Returns how many of a loop's items to work out for `n` that are needed: `n` rounded up to whole
/// registers of 16, at most `MOST`. Items that do not fill a register are worked out one by one,
/// which may take as long as all the rest. Compilers know the limit.
#[inline(always)]
pub fn whole_registers<const MOST: usize>(n: usize) -> usize {
    const { assert!(MOST.is_multiple_of(16)) };
    n.next_multiple_of(16).min(MOST)
}

/// Work that is compiled for every instruction set. Whatever it calls must be `inline(always)` to
/// be compiled with it.
pub trait Work {
    /// Result of the work.
    type Out;
    /// Does it. Which instruction set it is compiled for is known where it is: what is for others
    /// is left out.
    fn run(self, simd: Simd) -> Self::Out;
}

impl Simd {
    /// Runs `work` with this instruction set. Choosing once a tile part is free; once a section
    /// costs a call.
    #[inline]
    pub fn run<W: Work>(self, work: W) -> W::Out {
        match self.0 {
            // SAFETY: the value proves that the instructions are there (`Simd::all`).
            #[cfg(all(target_arch = "x86_64", all_levels))]
            Level::Avx2 => unsafe { run_avx2(work) },
            #[cfg(all(target_arch = "x86_64", not(all_levels)))]
            Level::Avx2 => unreachable!("`Simd::all` leaves it out"),
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { run_avx512(work) },
            // NEON is in the baseline of 64-bit ARM.
            #[cfg(target_arch = "aarch64")]
            Level::Neon => run_neon(work),
            Level::Plain => run_plain(work),
        }
    }
}

// None is compiled with its callers, of which some have much code.

#[inline(never)]
fn run_plain<W: Work>(work: W) -> W::Out {
    work.run(Simd(Level::Plain))
}

#[cfg(target_arch = "aarch64")]
#[inline(never)]
fn run_neon<W: Work>(work: W) -> W::Out {
    work.run(Simd(Level::Neon))
}

#[cfg(all(target_arch = "x86_64", all_levels))]
#[inline(never)]
#[target_feature(enable = "avx2,popcnt,lzcnt,bmi1,bmi2")]
fn run_avx2<W: Work>(work: W) -> W::Out {
    work.run(Simd(Level::Avx2))
}

#[cfg(target_arch = "x86_64")]
#[inline(never)]
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,popcnt,lzcnt,bmi1,bmi2")]
fn run_avx512<W: Work>(work: W) -> W::Out {
    work.run(Simd(Level::Avx512))
}

/// Four rows of sixteen columns, column by column: four columns a register.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
#[inline]
fn by_column(rows: [std::arch::x86_64::__m512i; 4]) -> [std::arch::x86_64::__m512i; 4] {
    use std::arch::x86_64::*;
    // Columns 0 4 8 12, 1 5 9 13 and so on, one a quarter; then in order.
    let [a, b, c, d] = lanes::Sixteen::turned(rows);
    let ab = [_mm512_shuffle_i32x4::<0x44>(a, b), _mm512_shuffle_i32x4::<0xee>(a, b)];
    let cd = [_mm512_shuffle_i32x4::<0x44>(c, d), _mm512_shuffle_i32x4::<0xee>(c, d)];
    [
        _mm512_shuffle_i32x4::<0x88>(ab[0], cd[0]),
        _mm512_shuffle_i32x4::<0xdd>(ab[0], cd[0]),
        _mm512_shuffle_i32x4::<0x88>(ab[1], cd[1]),
        _mm512_shuffle_i32x4::<0xdd>(ab[1], cd[1]),
    ]
}

/// Adds one section to the pixels of rows `y0..` and columns `x0..` of a sheet with `stride` pixels
/// a row: `((payload * w_z) * w_y) * w_x`, in this order everywhere.
///
/// # Panics
/// If the footprint leaves the sheet.
#[inline(always)]
pub fn splat<S: Accumulate>(
    sheet: &mut Pixels<S>,
    stride: usize,
    (x0, wx): (usize, &[S::Weight]),
    (y0, wy): (usize, &[S::Weight]),
    section: [S::Section; 4],
) {
    for (j, &w) in wy.iter().enumerate() {
        let row = (y0 + j) * stride + x0;
        let p = section.map(|c| S::row(c, w));
        for (pixel, &w) in sheet[row..row + wx.len()].iter_mut().zip(wx) {
            for c in 0..4 {
                pixel[c] = pixel[c].plus(p[c], w);
            }
        }
    }
}
