//! Row records: a voxel is added along x alone, and pixels are made of rows when a sheet closes
//! ([`crate::primitives::lattice_rows`]).
//!
//! A *tier* is the row of sums of one lattice row in one open sheet. Tiers lie slot by slot. Each
//! begins and ends with a margin of as many columns as a footprint has, which nobody reads, so that
//! no footprint need be cut. A register adds at multiples of its own length alone, since a store
//! that a neighbour has just made can then be forwarded to the load; weights are shifted to where a
//! footprint begins in its first register.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "x86_64")]
mod wide;

use super::Level;
use super::pixel_records::sheet_offsets::{Apart, BATCH, Each, Layers};
use super::pixel_records::{Line, MOST, Recorded, STRIDE, Splat, Table};
use super::touched::Places;
use super::{Accumulate, Grey, Simd, Weight};
use crate::kernels::composite::LANES;
use crate::primitives::sizes::PART;
use crate::primitives::sizes::{LATTICE_ROWS as ROWS, REACHING};

/// Layout of the memory that the tiers of a part take.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shape {
    /// Tiers of a sheet.
    pub(crate) rows: usize,
    /// Lines of the cache of a tier.
    wide: usize,
    /// Columns of a tier before the part's first.
    pub margin: usize,
    /// Pixels of a line.
    line: usize,
    /// Columns of a footprint at most.
    len: usize,
}

/// Pixels of a line of the cache.
const fn a_line<S: Recorded>() -> usize {
    size_of::<Line>() / size_of::<S::Pixel>()
}

/// Returns how many groups of `columns` columns a footprint of `len` may reach: it may begin in the
/// last column of the first.
#[inline(always)]
fn groups(len: usize, columns: usize) -> usize {
    (len + columns - 1).div_ceil(columns)
}

impl Shape {
    /// Computes the layout for `rows` tiers a sheet and footprints of at most `len` columns.
    pub fn new<S: Recorded>(rows: usize, len: usize) -> Shape {
        assert!(rows <= ROWS && len < 64, "{rows} tiers for footprints of {len}");
        let margin = len.next_multiple_of(8);
        let groups = groups(len, a_line::<S>());
        // Whole chunks of weights are added: of sixteen columns, or of four lines where there are
        // more.
        let sixteen = 16 / a_line::<S>();
        let spare = groups.next_multiple_of(if groups > 4 { 4 } else { sixteen });
        let wide = (margin + PART as usize) / a_line::<S>() + spare;
        Shape { rows, wide, margin, line: a_line::<S>(), len }
    }

    /// Returns the number of cache lines that the tiers of `sheets` sheets take.
    pub fn lines(&self, sheets: usize) -> usize {
        sheets * self.rows * self.wide
    }

    /// Returns the index in a tier of a footprint's first pixel, which is in column `first` of the
    /// part and may lie outside.
    #[inline(always)]
    pub fn place(&self, first: i32) -> u32 {
        (first + self.margin as i32).clamp(0, self.margin as i32 + PART) as u32
    }

    /// Returns the index among the pixels of all tiers of a sheet of a footprint's first pixel,
    /// which is in column `first` of the part and in tier number `tier`.
    #[inline(always)]
    pub fn place_in(&self, tier: u32, first: i32) -> u32 {
        tier * (self.wide * self.line) as u32 + self.place(first)
    }

    /// Columns of the part that a footprint of `len` columns has from a [place](Shape::place) on.
    #[inline(always)]
    pub(crate) fn columns(&self, place: u32, len: usize) -> u64 {
        let (all, first) = ((1u64 << len) - 1, place as i32 - self.margin as i32);
        if first < 0 { all >> -first } else { all.checked_shl(first as u32).unwrap_or(0) }
    }
}

/// The open sheets of a part, tier by tier.
pub struct Tiers<'a, S: Recorded, const N: usize> {
    lines: &'a mut [Line],
    shape: Shape,
    kind: std::marker::PhantomData<S>,
}

/// Weight tables of voxels in a level view: across the picture and in depth.
#[derive(Clone, Copy)]
pub struct Weights<'a, S: Recorded> {
    /// Table of the weights across the picture.
    pub across: Table<'a, S::Weight>,
    /// Table of the weights in depth, a row for each depth phase.
    pub deep: Table<'a, S::Depth>,
}

/// Number of pixel rows of a part.
pub const EDGE: usize = PART as usize;

/// Tiers that reach each row of pixels in a sheet, and their weights there.
pub struct ByRow<W> {
    /// The first of them, and how many there are: four at least.
    reach: [[u8; 2]; EDGE],
    weights: [[W; REACHING]; EDGE],
    /// One more than the last of any row.
    end: usize,
}

impl<W: Weight> Default for ByRow<W> {
    fn default() -> Self {
        ByRow { reach: [[0; 2]; EDGE], weights: [[W::default(); REACHING]; EDGE], end: 0 }
    }
}

/// Least number of tiers that reach a row of pixels, some with no weight: as many as do if a kernel
/// reaches two steps of the lattice to either side.
pub const FOUR: usize = 4;

impl<W: Weight> ByRow<W> {
    /// Sets the tiers that reach row `y`: `n` from number `begin` on, each with the weight that
    /// `weight` returns. Leading and trailing tiers without weight are left out, down to four.
    #[inline(always)]
    pub fn set(&mut self, y: usize, [begin, n]: [usize; 2], weight: impl Fn(usize) -> W) {
        let (mut from, mut to) = (0, n.min(REACHING));
        let row = &mut self.weights[y % EDGE];
        for (i, w) in row[..to].iter_mut().enumerate() {
            *w = weight(begin + i);
        }
        while to - from > FOUR && row[to - 1] == W::default() {
            to -= 1;
        }
        while to - from > FOUR && row[from] == W::default() {
            from += 1;
        }
        row.copy_within(from..to, 0);
        self.end = self.end.max(begin + to);
        self.reach[y % EDGE] = [begin + from, to - from].map(|tier| tier as u8);
    }

    /// The first of the tiers that reach row `y`, and what they weigh.
    #[inline(always)]
    fn row(&self, y: usize) -> (usize, &[W]) {
        let [begin, n] = self.reach[y % EDGE].map(usize::from);
        (begin, &self.weights[y % EDGE][..n.min(REACHING)])
    }
}

/// A sheet that closes, with the sums of the one before.
pub struct Ends<'a, S: Recorded> {
    /// Pixels that are open and that something was added to, one bit each by row.
    pub open: &'a [u64; EDGE],
    /// Slots of the closing sheet and of the one behind.
    pub slots: [usize; 2],
    /// Tiers that reach each pixel row, in the closing sheet and in the one behind.
    pub by_row: [&'a ByRow<S::Weight>; 2],
    /// Sums of the sheet before, in rows of [`STRIDE`] pixels; replaced by the sums of the closing
    /// one.
    pub before: &'a mut [S::Pixel],
    /// Pixels, one bit each by row, at which `before` is valid; elsewhere it counts as zero.
    pub was: &'a mut [u64; EDGE],
    /// Opacity (f32 bits) and three colours (fixed point) of each pixel of the part, as in
    /// `crate::tile::Pixels`.
    pub pixels: &'a [[u32; 4]],
}

/// Pixels that close together, one beside the other: their places, sums and opacities.
pub struct Folded<S: Recorded> {
    /// Places of the pixels in the part.
    pub places: Places,
    /// Sums of each pixel in three sheets: the one before, the closing one and the one behind.
    pub sheets: Box<[[S::Pixel; MOST_CLOSING]; 3]>,
    /// Opacity of each pixel in front of the closing sheet, 0 to 1.
    pub opacities: Box<[f32; MOST_CLOSING]>,
}

/// Pixels that are closed together, or up to a row more: these are what a first cache holds, and of
/// the lanes behind the last one few are spent.
const ENOUGH: usize = 512;

/// Room for pixels that are closed together, with a row more and the lanes that are stored at once
/// behind the last.
const MOST_CLOSING: usize = ENOUGH + EDGE + LANES;

impl<S: Recorded> Default for Folded<S> {
    fn default() -> Self {
        let sheets = boxed([S::Pixel::default(); MOST_CLOSING]);
        Folded { places: Places::default(), sheets, opacities: boxed(0.0) }
    }
}

/// Returns `N` copies of `one` on the heap.
fn boxed<T: Copy, const N: usize>(one: T) -> Box<[T; N]> {
    vec![one; N].into_boxed_slice().try_into().unwrap_or_else(|_| unreachable!("as many"))
}

impl<S: Recorded> Folded<S> {
    /// Returns the places of the pixels, row by row.
    #[inline(always)]
    pub(crate) fn places(&self) -> &Places {
        &self.places
    }

    /// Sums and opacities of those from the `i`th on, as many as are closed at once.
    #[inline(always)]
    pub(crate) fn sums(&self, i: usize) -> ([&[S::Pixel; LANES]; 3], &[f32; LANES]) {
        let room = "room behind the last";
        let sheets = self.sheets.each_ref().map(|sums| sums[i..].first_chunk().expect(room));
        (sheets, self.opacities[i..].first_chunk().expect(room))
    }
}

impl<'a, S: Recorded, const N: usize> Tiers<'a, S, N> {
    /// Takes `lines` as memory for tiers of `shape`; it must be zero but for the tiers' margins.
    ///
    /// # Panics
    /// If there are not as many lines.
    pub fn new(lines: &'a mut [Line], shape: Shape) -> Self {
        let lines = &mut lines[..shape.lines(N)];
        Tiers { lines, shape, kind: std::marker::PhantomData }
    }

    #[inline(always)]
    pub(crate) fn shape(&self) -> Shape {
        self.shape
    }

    /// The line that a tier's first column in the part is in.
    #[inline(always)]
    pub(crate) fn begin(&self, slot: usize, row: usize) -> u32 {
        let Shape { rows, wide, margin, .. } = self.shape;
        ((slot * rows + row) * wide + margin / a_line::<S>()) as u32
    }

    /// The part's pixels of a tier that begins there.
    #[inline(always)]
    fn pixels(&self, begin: u32) -> &[S::Pixel; PART as usize] {
        let lines = &self.lines[begin as usize..];
        bytemuck::cast_slice(lines).first_chunk().expect("a tier is longer than a part is wide")
    }

    /// Whether nothing was added in the part, in any tier.
    pub(crate) fn are_empty(&self) -> bool {
        let all = (0..N).flat_map(|slot| (0..self.shape.rows).map(move |row| (slot, row)));
        let mut pixels = all.flat_map(|(slot, row)| self.pixels(self.begin(slot, row)));
        pixels.all(|pixel| *pixel == S::Pixel::default())
    }

    /// Returns the sums of tier `row` in the sheet of `slot`, margins included.
    #[inline(always)]
    pub fn tier_mut(&mut self, slot: usize, row: usize) -> &mut [S::Pixel] {
        let Shape { rows, wide, .. } = self.shape;
        bytemuck::cast_slice_mut(&mut self.lines[(slot * rows + row) * wide..][..wide])
    }

    /// Adds a section to a tier, plainly.
    #[inline(always)]
    pub(crate) fn add(
        &mut self,
        (slot, row): (usize, usize),
        (place, wx): (usize, &[S::Weight]),
        section: &[S::Section; 4],
    ) {
        let tier = self.tier_mut(slot, row);
        for (pixel, &w) in tier[place..place + wx.len()].iter_mut().zip(wx) {
            S::add(pixel, section, w);
        }
    }

    /// Empties the lines of a tier that have any of the columns.
    #[inline(always)]
    pub(crate) fn empty(&mut self, slot: usize, row: usize, columns: u64) {
        let begin = self.begin(slot, row) as usize;
        let lines = &mut self.lines[begin..begin + PART as usize / a_line::<S>()];
        let mut left = firsts::<S>(columns);
        while left != 0 {
            lines[left.trailing_zeros() as usize / a_line::<S>()] = Line::ZERO;
            left &= left - 1;
        }
    }
}

/// The first column of each line of a tier that has any of `columns`.
#[inline(always)]
fn firsts<S: Recorded>(columns: u64) -> u64 {
    firsts_of(columns, a_line::<S>())
}

/// The first of each `n` columns, two, four or eight, that have any of `columns`.
#[inline(always)]
fn firsts_of(columns: u64, n: usize) -> u64 {
    let pairs = columns | columns >> 1;
    let fours = pairs | pairs >> 2;
    match n {
        2 => pairs & 0x5555_5555_5555_5555,
        4 => fours & 0x1111_1111_1111_1111,
        _ => (fours | fours >> 4) & 0x0101_0101_0101_0101,
    }
}

/// A kind of sums whose tiers are added to and folded in lanes.
pub trait Tiered: Recorded {
    /// Adds `voxels` with `payloads`, which begin at the sheet that `slot` holds, to the tiers that
    /// their rows name.
    fn add_flat<const N: usize>(
        simd: Simd,
        tiers: &mut Tiers<'_, Self, N>,
        voxels: (&[Splat], &[Self::Payload]),
        slot: usize,
        weights: &Weights<'_, Self>,
    );

    /// Adds voxels whose sections have [places](Shape::place_in) of their own, by slot.
    fn add_apart<const N: usize>(
        simd: Simd,
        tiers: &mut Tiers<'_, Self, N>,
        voxels: (&Apart, &[Self::Payload]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, Self, N>,
    );

    /// Makes the sums that a sheet and the one behind have in pixels of the tiers above them: in
    /// those that are open and have any extinction in the sheet, in rows from `rows` on, until
    /// there are `ENOUGH`. Says where to go on.
    ///
    /// # Panics
    /// If there are fewer sums or pixels than a part has.
    fn fold<const N: usize>(
        simd: Simd,
        tiers: &Tiers<'_, Self, N>,
        ends: Ends<'_, Self>,
        rows: usize,
        to: &mut Folded<Self>,
    ) -> usize;
}

/// [`Tiered::fold`] plainly, of sums whose channels are `T`s.
#[inline(always)]
fn fold<S, T, const C: usize, const N: usize>(
    tiers: &Tiers<'_, S, N>,
    Ends { open, slots, by_row, before, was, pixels }: Ends<'_, S>,
    rows: usize,
    to: &mut Folded<S>,
) -> usize
where
    S: Recorded<Pixel = [T; C]>,
    T: Accumulate<Weight = S::Weight> + Copy + Default,
{
    let (mut y, mut n) = (rows, 0);
    while y < EDGE && n < ENOUGH {
        let (open, was) = (&open[y], &mut was[y]);
        let (mut left, had) = (*open, std::mem::take(was));
        while left != 0 {
            let x = left.trailing_zeros() as usize;
            left &= left - 1;
            let mut sheets = [[T::default(); C]; 2];
            for (sums, (slot, by_row)) in sheets.iter_mut().zip(slots.into_iter().zip(by_row)) {
                let (first, weights) = by_row.row(y);
                let begin = tiers.begin(slot, first);
                let mut rows = [[(T::default(), S::Weight::default()); REACHING]; C];
                for (row, &wy) in weights.iter().enumerate() {
                    let pixel = tiers.pixels(begin + (row * tiers.shape.wide) as u32)[x];
                    for (rows, sum) in rows.iter_mut().zip(pixel) {
                        rows[row] = (sum, wy);
                    }
                }
                for (sum, rows) in sums.iter_mut().zip(&rows) {
                    *sum = T::down(rows[..weights.len()].iter().copied());
                }
            }
            // Extinction comes first.
            if S::raw(&sheets[0])[0] == 0 {
                continue;
            }
            let (at, [here, behind]) = (y * STRIDE + x, sheets);
            let old = std::mem::replace(&mut before[at], here);
            let old = if had >> x & 1 == 1 { old } else { [T::default(); C] };
            for (to, sums) in to.sheets.iter_mut().zip([old, here, behind]) {
                to[n] = sums;
            }
            to.opacities[n] = f32::from_bits(pixels[at][0]);
            // SAFETY: it is a place of the part.
            unsafe { to.places.room()[n] = at as u32 };
            n += 1;
            *was |= 1 << x;
        }
        y += 1;
    }
    to.places.set_len(n);
    y
}

/// [`Tiered::add_flat`] plainly.
#[inline(always)]
fn add_flat<S: Recorded, const N: usize>(
    tiers: &mut Tiers<'_, S, N>,
    (voxels, payloads): (&[Splat], &[S::Payload]),
    slot: usize,
    Weights { across, deep }: &Weights<'_, S>,
) {
    for (v, &payload) in voxels.iter().zip(payloads) {
        let [place, row] = v.first();
        let wx = across.row((v.rows & 0xffff) as usize);
        for (i, &wz) in deep.row(v.phase() as usize * deep.len).iter().enumerate() {
            tiers.add(((slot + i) % N, row), (place, wx), &S::cut(payload, wz));
        }
    }
}

/// [`Tiered::add_apart`] plainly.
#[inline(always)]
fn add_apart<S: Recorded, const N: usize>(
    tiers: &mut Tiers<'_, S, N>,
    (apart, payloads): (&Apart, &[S::Payload]),
    places: &[Each<u32>; MOST],
    layers: &Layers<'_, S, N>,
) {
    for (&i, &payload) in apart.kept.iter().zip(payloads) {
        let i = i as usize % BATCH;
        for slot in 0..N {
            let sheet = layers.after(slot);
            if sheet >= apart.left[i] {
                continue;
            }
            let wz = layers.deep.weights[apart.deep[i] as usize + sheet as usize];
            let wx = layers.across[0][slot].row(apart.from[0][slot][i] as usize);
            let a_tier = tiers.shape.wide * tiers.shape.line;
            let [row, place] =
                [places[slot][i] as usize / a_tier, places[slot][i] as usize % a_tier];
            tiers.add((slot, row), (place, wx), &S::cut(payload, wz));
        }
    }
}

/// Sums of `$c` channels that are `$channel`s; `$wide` is what their registers are.
macro_rules! tiered {
    ($sums:ty, [$channel:ty; $c:literal], $wide:ident $(<$n:literal>)?) => {
        impl Tiered for $sums {
            #[inline(always)]
            fn add_flat<const N: usize>(
                simd: Simd,
                tiers: &mut Tiers<'_, Self, N>,
                voxels: (&[Splat], &[Self::Payload]),
                slot: usize,
                weights: &Weights<'_, Self>,
            ) {
                assert_eq!(voxels.0.len(), voxels.1.len(), "a payload a voxel");
                at_level!(
                    simd,
                    (tiers, voxels, slot, weights),
                    add_flat::<Self, N>,
                    avx2::add_flat::<avx2::$wide $(<$n>)?, Self, N>,
                    avx512::add_flat::<avx512::$wide $(<$n>)?, Self, N>,
                    add_flat::<Self, N>
                );
            }

            #[inline(always)]
            fn add_apart<const N: usize>(
                simd: Simd,
                tiers: &mut Tiers<'_, Self, N>,
                voxels: (&Apart, &[Self::Payload]),
                places: &[Each<u32>; MOST],
                layers: &Layers<'_, Self, N>,
            ) {
                at_level!(
                    simd,
                    (tiers, voxels, places, layers),
                    add_apart::<Self, N>,
                    avx2::add_apart::<avx2::$wide $(<$n>)?, Self, N>,
                    avx512::add_apart::<avx512::$wide $(<$n>)?, Self, N>,
                    add_apart::<Self, N>
                );
            }

            #[inline(always)]
            fn fold<const N: usize>(
                simd: Simd,
                tiers: &Tiers<'_, Self, N>,
                ends: Ends<'_, Self>,
                rows: usize,
                to: &mut Folded<Self>,
            ) -> usize {
                at_level!(
                    simd,
                    (tiers, ends, rows, to),
                    fold::<Self, $channel, $c, N>,
                    avx2::fold::<avx2::$wide $(<$n>)?, Self, N>,
                    avx512::fold::<avx512::$wide $(<$n>)?, Self, N>,
                    fold::<Self, $channel, $c, N>
                )
            }
        }
    };
}

tiered!(i16, [i16; 4], Shorts);
tiered!(i32, [i32; 4], Longs<4>);
tiered!(Grey, [i32; 2], Longs<2>);
