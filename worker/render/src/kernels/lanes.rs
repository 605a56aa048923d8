//! SIMD lanes: 32-bit numbers in a register, as many as an instruction set has.
//!
//! Operations that compilers do not make of plain loops, such as compressing the wanted lanes, are
//! written once for any number of lanes, in functions that are inlined into one that is compiled
//! for the instruction set. Functions here need that set, and check nothing.

#[cfg(target_arch = "aarch64")]
mod neon;
#[cfg(target_arch = "x86_64")]
mod x86;

#[cfg(target_arch = "aarch64")]
pub(super) use neon::Four;
#[cfg(target_arch = "x86_64")]
pub(super) use x86::{Eight, Sixteen};

/// An instruction set's lanes. No function may be called on a machine that lacks its instructions.
pub(crate) trait Lanes {
    /// Number of lanes.
    const LANES: usize;
    /// A whole number each.
    type Ints: Copy;
    /// A yes or no each.
    type Marks: Copy;

    unsafe fn set(n: i32) -> Self::Ints;
    /// `n`, `n + 1` and so on.
    unsafe fn from(n: i32) -> Self::Ints;
    unsafe fn load(at: *const u32) -> Self::Ints;
    unsafe fn store(to: *mut u32, a: Self::Ints);
    unsafe fn plus(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    unsafe fn minus(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    unsafe fn times(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    unsafe fn and(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    /// The bits of `b` that `a` does not have.
    unsafe fn without(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    unsafe fn or(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    unsafe fn min(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    unsafe fn max(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    /// `a << bits`.
    unsafe fn up(a: Self::Ints, bits: u32) -> Self::Ints;
    /// `a >> bits`, of numbers with a sign.
    unsafe fn down(a: Self::Ints, bits: u32) -> Self::Ints;
    /// `a << b`.
    unsafe fn up_each(a: Self::Ints, b: Self::Ints) -> Self::Ints;
    /// `a < b`.
    unsafe fn less(a: Self::Ints, b: Self::Ints) -> Self::Marks;
    /// `a <= b`, of numbers without a sign.
    unsafe fn at_most(a: Self::Ints, b: Self::Ints) -> Self::Marks;
    unsafe fn both(a: Self::Marks, b: Self::Marks) -> Self::Marks;
    /// A bit a lane.
    unsafe fn bits(marks: Self::Marks) -> u32;
    unsafe fn marks(bits: u32) -> Self::Marks;
    /// `a`, and 1 more where it is marked.
    unsafe fn one_more(marks: Self::Marks, a: Self::Ints) -> Self::Ints;
    /// The `at`th numbers of `table`, in lanes that are marked; of others no more than the table's
    /// first is read.
    unsafe fn look_up(marks: Self::Marks, table: *const u32, at: Self::Ints) -> Self::Ints;
    /// Returns the numbers whose lanes are set in `bits`, side by side from the first lane on.
    unsafe fn beside(bits: u32, a: Self::Ints) -> Self::Ints;
    /// The first ones in the lanes of `bits`.
    unsafe fn spread(bits: u32, a: Self::Ints) -> Self::Ints;
    /// The first ones of `items`, as many as there are lanes or items; what other lanes hold is not
    /// said.
    unsafe fn bytes(items: &[u8]) -> Self::Ints;
    /// See [`Lanes::bytes`].
    unsafe fn shorts(items: &[u16]) -> Self::Ints;
    /// See [`Lanes::bytes`].
    unsafe fn floats(items: &[f32]) -> Self::Ints;
    /// Lane by lane, four numbers of each.
    unsafe fn store_fours(to: *mut u32, fours: [Self::Ints; 4]);
    /// Four numbers from each of as many places as there are lanes: the first of all places, the
    /// second, and so on. The `i`th begins at the `at[i] * stride`th number behind `from`.
    unsafe fn fours(from: *const u32, stride: usize, at: *const u32) -> [Self::Ints; 4];
    /// [`Lanes::fours`] of two numbers, which are all that each place has.
    unsafe fn pairs(from: *const u32, at: *const u32) -> [Self::Ints; 2];
    /// Reads two numbers each of places that follow each other, from `from` on.
    unsafe fn pairs_on(from: *const u32) -> [Self::Ints; 2];
    /// Reads two numbers each behind two `from`s: four in all.
    unsafe fn twos(from: [*const u32; 2], stride: usize, at: *const u32) -> [Self::Ints; 4];
    /// Whole numbers as floats.
    unsafe fn store_floats(to: *mut f32, a: Self::Ints);
    /// Bits `from` to `from + 31` of the sums of `n` and what lies from `at` on.
    unsafe fn bits_of_sums(n: i64, at: *const i64, from: u32) -> Self::Ints;
}

/// Lanes that hold floats, too. Comparisons are false where a number is none.
#[cfg(target_arch = "x86_64")]
pub(crate) trait Floats: Lanes {
    /// A float each.
    type Floats: Copy;

    unsafe fn all(x: f32) -> Self::Floats;
    unsafe fn load_floats(at: *const f32) -> Self::Floats;
    unsafe fn put_floats(to: *mut f32, a: Self::Floats);
    unsafe fn add(a: Self::Floats, b: Self::Floats) -> Self::Floats;
    unsafe fn sub(a: Self::Floats, b: Self::Floats) -> Self::Floats;
    unsafe fn mul(a: Self::Floats, b: Self::Floats) -> Self::Floats;
    unsafe fn div(a: Self::Floats, b: Self::Floats) -> Self::Floats;
    unsafe fn sqrt(a: Self::Floats) -> Self::Floats;
    /// `a` if it is less, else `b`.
    unsafe fn least(a: Self::Floats, b: Self::Floats) -> Self::Floats;
    /// `a` if it is more, else `b`.
    unsafe fn most(a: Self::Floats, b: Self::Floats) -> Self::Floats;
    /// `a < b`.
    unsafe fn below(a: Self::Floats, b: Self::Floats) -> Self::Marks;
    /// `a >= b`.
    unsafe fn from_on(a: Self::Floats, b: Self::Floats) -> Self::Marks;
    unsafe fn select(marks: Self::Marks, yes: Self::Floats, no: Self::Floats) -> Self::Floats;
    /// `a` where it is marked, else 0.
    unsafe fn only(marks: Self::Marks, a: Self::Floats) -> Self::Floats;
    /// The bits of each.
    unsafe fn to_bits(a: Self::Floats) -> Self::Ints;
    unsafe fn from_bits(a: Self::Ints) -> Self::Floats;
    unsafe fn to_floats(a: Self::Ints) -> Self::Floats;
    /// Whole numbers, towards zero, of what is below 2^31.
    unsafe fn truncated(a: Self::Floats) -> Self::Ints;
}

/// For each byte, in the `i`th of eight bytes, which bit is the `i`th that is set.
pub(super) const BESIDE: [u64; 256] = {
    let mut all = [0; 256];
    let mut bits = 0;
    while bits < 256 {
        let (mut bit, mut count) = (0, 0);
        while bit < 8 {
            if bits >> bit & 1 == 1 {
                all[bits] |= bit << (8 * count);
                count += 1;
            }
            bit += 1;
        }
        bits += 1;
    }
    all
};

/// For each byte, in the `i`th of eight bytes, how many bits are set below the `i`th.
const SPREAD: [u64; 256] = {
    let mut all = [0; 256];
    let mut bits = 0;
    while bits < 256 {
        let (mut bit, mut count) = (0, 0);
        while bit < 8 {
            all[bits] |= count << (8 * bit);
            count += (bits >> bit & 1) as u64;
            bit += 1;
        }
        bits += 1;
    }
    all
};

/// The first ones of `items`, zeros where there are fewer.
#[inline(always)]
fn first<T: Copy + Default, const N: usize>(items: &[T]) -> [T; N] {
    match items.first_chunk() {
        Some(first) => *first,
        None => {
            let mut first = [T::default(); N];
            first[..items.len()].copy_from_slice(items);
            first
        }
    }
}
