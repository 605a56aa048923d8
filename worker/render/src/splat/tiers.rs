//! Rows of storeys: a voxel is added along x alone, and pixels are made of rows when a sheet closes
//! ([`crate::storeys`]).
//!
//! A *tier* is the row of one storey in one open sheet. Tiers lie slot by slot; each begins with a margin of as
//! many columns as a footprint has, and ends with one, so that no footprint need be cut: what lies there nobody
//! reads. A register adds at a multiple of its own length alone, since what a neighbour has just written there
//! is then read back as it was written; weights are moved to where a footprint begins in its first register.

#[cfg(target_arch = "x86_64")]
use super::Level;
use super::records::apart::{Apart, BATCH, Each, Layers};
use super::records::{Line, MOST, Record, Recorded, Splat, Table};
use super::{Accumulate, Grey, Simd, Tap};
use crate::sheet::LANES;
use crate::storeys::{REACHING, ROWS};
use crate::tile::PART;

/// Which memory the tiers of a part take.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Shape {
    /// Tiers of a sheet.
    pub(crate) rows: usize,
    /// Lines of the cache of a tier.
    wide: usize,
    /// Columns before a part's first.
    pub(crate) margin: usize,
    /// Pixels of a line.
    line: usize,
    /// Columns of a footprint at most.
    len: usize,
}

/// Pixels of a line of the cache.
const fn a_line<S: Recorded>() -> usize {
    size_of::<Line>() / size_of::<S::Pixel>()
}

/// How many groups of so many columns a footprint of `len` may reach: it may begin in the last column of the first.
#[inline(always)]
fn groups(len: usize, columns: usize) -> usize {
    (len + columns - 1).div_ceil(columns)
}

impl Shape {
    /// For footprints of at most `len` columns and so many tiers.
    pub(crate) fn new<S: Recorded>(rows: usize, len: usize) -> Shape {
        assert!(rows <= ROWS && len < 64, "{rows} tiers for footprints of {len}");
        let margin = len.next_multiple_of(8);
        let groups = groups(len, a_line::<S>());
        // Whole chunks of weights are added: of sixteen columns, or of four lines where there are more.
        let sixteen = 16 / a_line::<S>();
        let spare = groups.next_multiple_of(if groups > 4 { 4 } else { sixteen });
        let wide = (margin + PART as usize) / a_line::<S>() + spare;
        Shape { rows, wide, margin, line: a_line::<S>(), len }
    }

    /// Lines of tiers for `sheets`.
    pub(crate) fn lines(&self, sheets: usize) -> usize {
        sheets * self.rows * self.wide
    }

    /// The place of a footprint's first pixel, which is at `first` in the part: it may lie outside.
    #[inline(always)]
    pub(crate) fn place(&self, first: i32) -> u32 {
        (first + self.margin as i32).clamp(0, self.margin as i32 + PART) as u32
    }

    /// The same among the pixels of all tiers of a sheet.
    #[inline(always)]
    pub(crate) fn place_in(&self, tier: u32, first: i32) -> u32 {
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
pub(crate) struct Tiers<'a, S: Recorded, const N: usize> {
    lines: &'a mut [Line],
    shape: Shape,
    kind: std::marker::PhantomData<S>,
}

/// Weights across and in depth.
#[derive(Clone, Copy)]
pub(crate) struct Weights<'a, S: Recorded> {
    pub(crate) across: Table<'a, S::Weight>,
    pub(crate) deep: Table<'a, S::Depth>,
}

/// Tiers that reach some row of pixels in a sheet, beside each other: the line that the first one's first column in
/// the part [is in](Tiers::begin), and what each weighs.
pub(crate) type Above<'a, W> = (u32, &'a [W]);

/// Sums of pixels that close, of their sheet and of the one behind, beside each other.
pub(crate) struct Folded<S: Recorded> {
    records: Box<[Record<S, 2>]>,
    n: usize,
}

/// What is stored at once, more than is there at most.
const SPARE: usize = 8;

impl<S: Recorded> Default for Folded<S> {
    fn default() -> Self {
        let n = (PART * PART) as usize + LANES + SPARE;
        Folded { records: vec![Record::<S, 2>::default(); n].into(), n: 0 }
    }
}

impl<S: Recorded> Folded<S> {
    /// Forgets all.
    #[inline(always)]
    pub(crate) fn clear(&mut self) {
        self.n = 0;
    }

    /// Those from the `i`th on, as many as are closed at once.
    #[inline(always)]
    pub(crate) fn from(&self, i: usize) -> &[Record<S, 2>; LANES] {
        self.records[i..].first_chunk().expect("room behind the last")
    }
}

impl<'a, S: Recorded, const N: usize> Tiers<'a, S, N> {
    /// In memory that is all zero, but for margins of tiers of this shape.
    ///
    /// # Panics
    /// If there are not as many lines.
    pub(crate) fn new(lines: &'a mut [Line], shape: Shape) -> Self {
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

    #[inline(always)]
    fn tier_mut(&mut self, slot: usize, row: usize) -> &mut [S::Pixel] {
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

/// Sums whose tiers are added to and folded in lanes.
pub(crate) trait Tiered: Recorded {
    /// Adds `voxels` with `payloads`, which begin at the sheet that `slot` holds, to the tiers that their
    /// [rows](Splat::first) name.
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

    /// Puts the sums that two sheets have in a row of pixels, by the tiers above them, behind those of `to`: of
    /// pixels that `open` has bits for and the first sheet has any extinction in. Says which these are.
    fn fold<const N: usize>(
        simd: Simd,
        tiers: &Tiers<'_, Self, N>,
        above: [Above<'_, Self::Weight>; 2],
        spread: f32,
        open: u64,
        to: &mut Folded<Self>,
    ) -> u64;
}

/// [`Tiered::fold`] plainly; `down`: [`Accumulate::down`] of each channel.
#[inline(always)]
fn fold<S: Recorded<Pixel = [T; C]>, T: Copy + Default, const C: usize, const N: usize>(
    tiers: &Tiers<'_, S, N>,
    above: [Above<'_, S::Weight>; 2],
    open: u64,
    to: &mut Folded<S>,
    down: impl Fn(&[(T, S::Weight)]) -> T,
) -> u64 {
    let (mut left, mut filled) = (open, 0);
    while left != 0 {
        let x = left.trailing_zeros() as usize;
        left &= left - 1;
        let mut record = [[T::default(); C]; 2];
        for (sums, (begin, weights)) in record.iter_mut().zip(above) {
            let mut rows = [[(T::default(), S::Weight::default()); REACHING]; C];
            for (row, &wy) in weights.iter().enumerate().take(REACHING) {
                let pixel = tiers.pixels(begin + (row * tiers.shape.wide) as u32)[x];
                for (rows, sum) in rows.iter_mut().zip(pixel) {
                    rows[row] = (sum, wy);
                }
            }
            for (sum, rows) in sums.iter_mut().zip(&rows) {
                *sum = down(&rows[..weights.len().min(REACHING)]);
            }
        }
        // Extinction comes first.
        if S::raw(&record[0])[0] != 0 {
            to.records[to.n] = record;
            to.n += 1;
            filled |= 1 << x;
        }
    }
    filled
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

impl Tiered for i16 {
    #[inline(always)]
    fn add_flat<const N: usize>(
        simd: Simd,
        tiers: &mut Tiers<'_, i16, N>,
        voxels: (&[Splat], &[u64]),
        slot: usize,
        weights: &Weights<'_, i16>,
    ) {
        assert_eq!(voxels.0.len(), voxels.1.len(), "a payload a voxel");
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { avx512::add_flat_shorts(tiers, voxels, slot, weights) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { avx2::add_flat_shorts(tiers, voxels, slot, weights) },
            _ => add_flat(tiers, voxels, slot, weights),
        }
    }

    #[inline(always)]
    fn add_apart<const N: usize>(
        simd: Simd,
        tiers: &mut Tiers<'_, i16, N>,
        voxels: (&Apart, &[u64]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, i16, N>,
    ) {
        match simd.0 {
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { avx512::add_apart_shorts(tiers, voxels, places, layers) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { avx2::add_apart_shorts(tiers, voxels, places, layers) },
            _ => add_apart(tiers, voxels, places, layers),
        }
    }

    #[inline(always)]
    fn fold<const N: usize>(
        simd: Simd,
        tiers: &Tiers<'_, i16, N>,
        above: [Above<'_, i16>; 2],
        spread: f32,
        open: u64,
        to: &mut Folded<i16>,
    ) -> u64 {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { avx512::fold_shorts(tiers, above, open, to) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { avx2::fold_shorts(tiers, above, open, to) },
            _ => fold(tiers, above, open, to, |rows| i16::down(rows.iter().copied(), spread)),
        }
    }
}

impl Tiered for i32 {
    #[inline(always)]
    fn add_flat<const N: usize>(
        simd: Simd,
        tiers: &mut Tiers<'_, i32, N>,
        voxels: (&[Splat], &[[f32; 4]]),
        slot: usize,
        weights: &Weights<'_, i32>,
    ) {
        assert_eq!(voxels.0.len(), voxels.1.len(), "a payload a voxel");
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                avx512::add_flat_longs::<i32, 4, N>(tiers, voxels, slot, weights);
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe {
                avx2::add_flat_longs::<i32, 4, N>(tiers, voxels, slot, weights);
            },
            _ => add_flat(tiers, voxels, slot, weights),
        }
    }

    #[inline(always)]
    fn add_apart<const N: usize>(
        simd: Simd,
        tiers: &mut Tiers<'_, i32, N>,
        voxels: (&Apart, &[[f32; 4]]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, i32, N>,
    ) {
        match simd.0 {
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { avx512::add_apart_longs(tiers, voxels, places, layers) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { avx2::add_apart_longs(tiers, voxels, places, layers) },
            _ => add_apart(tiers, voxels, places, layers),
        }
    }

    #[inline(always)]
    fn fold<const N: usize>(
        simd: Simd,
        tiers: &Tiers<'_, i32, N>,
        above: [Above<'_, Tap>; 2],
        spread: f32,
        open: u64,
        to: &mut Folded<i32>,
    ) -> u64 {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                avx512::fold_longs::<i32, 4, N>(tiers, above, spread, open, to)
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { avx2::fold_longs::<i32, 4, N>(tiers, above, spread, open, to) },
            _ => fold(tiers, above, open, to, |rows| i32::down(rows.iter().copied(), spread)),
        }
    }
}

impl Tiered for Grey {
    #[inline(always)]
    fn add_flat<const N: usize>(
        simd: Simd,
        tiers: &mut Tiers<'_, Grey, N>,
        voxels: (&[Splat], &[[f32; 2]]),
        slot: usize,
        weights: &Weights<'_, Grey>,
    ) {
        assert_eq!(voxels.0.len(), voxels.1.len(), "a payload a voxel");
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                avx512::add_flat_longs::<Grey, 2, N>(tiers, voxels, slot, weights);
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe {
                avx2::add_flat_longs::<Grey, 2, N>(tiers, voxels, slot, weights);
            },
            _ => add_flat(tiers, voxels, slot, weights),
        }
    }

    #[inline(always)]
    fn add_apart<const N: usize>(
        _: Simd,
        tiers: &mut Tiers<'_, Grey, N>,
        voxels: (&Apart, &[[f32; 2]]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, Grey, N>,
    ) {
        add_apart(tiers, voxels, places, layers);
    }

    #[inline(always)]
    fn fold<const N: usize>(
        simd: Simd,
        tiers: &Tiers<'_, Grey, N>,
        above: [Above<'_, Tap>; 2],
        spread: f32,
        open: u64,
        to: &mut Folded<Grey>,
    ) -> u64 {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                avx512::fold_longs::<Grey, 2, N>(tiers, above, spread, open, to)
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe {
                avx2::fold_longs::<Grey, 2, N>(tiers, above, spread, open, to)
            },
            _ => fold(tiers, above, open, to, |rows| i32::down(rows.iter().copied(), spread)),
        }
    }
}

/// Calls a function for as many groups a chunk, and says how many chunks there are.
#[cfg(target_arch = "x86_64")]
macro_rules! by_groups {
    ($groups:expr, $most:literal, $add:ident[$($of:ident),*]($($arg:expr),*)) => {
        match $groups {
            1 => $add::<1, $($of),*>($($arg),*, 1),
            2 => $add::<2, $($of),*>($($arg),*, 1),
            3 if $most >= 3 => $add::<3, $($of),*>($($arg),*, 1),
            4 if $most >= 4 => $add::<4, $($of),*>($($arg),*, 1),
            n => $add::<$most, $($of),*>($($arg),*, n.div_ceil($most)),
        }
    };
}

/// The lines of tiers, all of which are there from the part's first column to its last.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn lines_of<S: Recorded, const N: usize>(
    tiers: &Tiers<'_, S, N>,
    above: &[Above<'_, S::Weight>; 2],
) -> *const Line {
    let there = tiers.lines.len() - PART as usize / a_line::<S>();
    let last = |(begin, weights): &Above<'_, S::Weight>| {
        *begin as usize + weights.len().saturating_sub(1) * tiers.shape.wide
    };
    assert!(last(&above[0]).max(last(&above[1])) <= there, "a tier is longer than a part is wide");
    tiers.lines.as_ptr()
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::*;
    use std::arch::x86_64::*;

    /// Columns of a chunk of weights of 16 bits, and of 32.
    const SHORTS: usize = 16;
    const LONGS: usize = 8;

    macro_rules! bits_of {
        ($number:ty) => {{
            let mut bits = [0; 3 * REACH];
            let mut i = REACH;
            while i < 2 * REACH {
                bits[i] = !(0 as $number);
                i += 1;
            }
            bits
        }};
    }

    /// Longer than a footprint, where it begins in a register, and a register beyond that.
    const REACH: usize = 96;

    /// No bits, then all, then none.
    static SHORT_BITS: [i16; 3 * REACH] = bits_of!(i16);
    static LONG_BITS: [i32; 3 * REACH] = bits_of!(i32);

    /// Of lanes from the `i`th on: bits of those from `shift` to where a footprint of `len` columns ends, as the bits that
    /// both of these have.
    #[inline(always)]
    fn window<T>(bits: &[T; 3 * REACH], shift: usize, len: usize, i: usize) -> [&[T; 16]; 2] {
        [REACH - shift + i, 2 * REACH - shift - len + i]
            .map(|from| bits[from..].first_chunk().expect("a footprint is shorter than 64"))
    }

    /// A register's worth of the weights from `from` less `shift` on, and what lies around them in the table.
    #[inline(always)]
    fn around<T: Copy + Default, const LEN: usize>(
        table: &[T],
        from: usize,
        shift: usize,
        chunk: usize,
    ) -> [T; LEN] {
        let begin = (from + chunk * LEN).wrapping_sub(shift);
        match table.get(begin..begin.wrapping_add(LEN)) {
            Some(all) => *all.first_chunk().expect("as long"),
            // At the table's ends.
            None => std::array::from_fn(|i| {
                table.get(begin.wrapping_add(i)).copied().unwrap_or_default()
            }),
        }
    }

    /// Sixteen-bit weights of groups of four columns, each for four channels.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn spread_shorts<const GROUPS: usize>(
        Table { weights: table, len }: &Table<'_, i16>,
        from: usize,
        shift: usize,
        chunk: usize,
    ) -> [__m256i; GROUPS] {
        const { assert!(GROUPS <= 4) };
        let around: [i16; SHORTS] = around(table, from, shift, chunk);
        let [begun, left] = window(&SHORT_BITS, shift, *len, chunk * SHORTS);
        let eight = |half: usize| {
            // SAFETY: eight weights of sixteen are 16 bytes.
            let load = |of: &[i16; 16]| unsafe { _mm_loadu_si128(of[8 * half..].as_ptr().cast()) };
            let there = _mm_and_si128(load(begun), load(left));
            _mm256_broadcastsi128_si256(_mm_and_si128(load(&around), there))
        };
        let halves = [eight(0), if GROUPS > 2 { eight(1) } else { _mm256_setzero_si256() }];
        let turns = [
            _mm256_setr_epi8(
                0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3, 4, 5, 4, 5, 4, 5, 4, 5, 6, 7, 6, 7,
                6, 7, 6, 7,
            ),
            _mm256_setr_epi8(
                8, 9, 8, 9, 8, 9, 8, 9, 10, 11, 10, 11, 10, 11, 10, 11, 12, 13, 12, 13, 12, 13, 12,
                13, 14, 15, 14, 15, 14, 15, 14, 15,
            ),
        ];
        let mut spread = [_mm256_setzero_si256(); GROUPS];
        for (g, spread) in spread.iter_mut().enumerate() {
            *spread = _mm256_shuffle_epi8(halves[g / 2], turns[g % 2]);
        }
        spread
    }

    /// Adds `section * w` to the registers from `at` on.
    ///
    /// # Safety
    /// There are as many.
    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn add_shorts<const GROUPS: usize>(
        at: *mut __m256i,
        section: __m256i,
        w: &[__m256i; GROUPS],
    ) {
        for (g, w) in w.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            unsafe {
                let sums = _mm256_load_si256(at.add(g));
                let sums = _mm256_adds_epi16(sums, _mm256_mulhrs_epi16(section, *w));
                _mm256_store_si256(at.add(g), sums);
            }
        }
    }

    /// Columns of a register.
    const fn columns<S: Recorded>() -> usize {
        a_line::<S>() / 2
    }

    /// Registers of a tier and of a sheet.
    ///
    /// # Panics
    /// If not all sheets have memory.
    #[inline(always)]
    fn registers<S: Recorded, const N: usize>(tiers: &Tiers<'_, S, N>) -> [usize; 2] {
        let Shape { rows, wide, .. } = tiers.shape;
        assert!(tiers.lines.len() >= N * rows * wide, "tiers of all sheets");
        [2 * wide, 2 * rows * wide]
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn add_flat_shorts<const N: usize>(
        tiers: &mut Tiers<'_, i16, N>,
        voxels: (&[Splat], &[u64]),
        slot: usize,
        weights: &Weights<'_, i16>,
    ) {
        let groups = groups(tiers.shape.len, columns::<i16>());
        by_groups!(groups, 4, flat_shorts[N](tiers, voxels, slot, weights));
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn flat_shorts<const GROUPS: usize, const N: usize>(
        tiers: &mut Tiers<'_, i16, N>,
        (voxels, payloads): (&[Splat], &[u64]),
        slot: usize,
        Weights { across, deep }: &Weights<'_, i16>,
        chunks: usize,
    ) {
        let [a_tier, sheet] = registers(tiers);
        let offsets: [usize; N] = std::array::from_fn(|i| (slot + i) % N * sheet);
        let first: *mut __m256i = tiers.lines.as_mut_ptr().cast();
        for (v, &payload) in voxels.iter().zip(payloads) {
            let [place, row] = v.first();
            let (at, shift) = (row * a_tier + place / 4, place % 4);
            assert!(at + chunks * GROUPS <= sheet, "a footprint inside its tier");
            let from = (v.rows & 0xffff) as usize;
            let wz = deep.row(v.phase() as usize * deep.len);
            let payload = _mm256_set1_epi64x(payload as i64);
            for chunk in 0..chunks {
                let w = spread_shorts::<GROUPS>(across, from, shift, chunk);
                let at = at + chunk * GROUPS;
                let add = |(offset, wz): (&usize, &i16)| {
                    let section = _mm256_mulhrs_epi16(payload, _mm256_set1_epi16(*wz));
                    // SAFETY: of the slot's, as shown above.
                    unsafe { add_shorts(first.add(offset + at), section, &w) };
                };
                match wz.first_chunk::<N>() {
                    // A loop of known length.
                    Some(wz) => offsets.iter().zip(wz).for_each(add),
                    None => offsets.iter().zip(wz).for_each(add),
                }
            }
        }
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn add_apart_shorts<const N: usize>(
        tiers: &mut Tiers<'_, i16, N>,
        voxels: (&Apart, &[u64]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, i16, N>,
    ) {
        let groups = groups(tiers.shape.len, columns::<i16>());
        by_groups!(groups, 4, apart_shorts[N](tiers, voxels, places, layers));
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn apart_shorts<const GROUPS: usize, const N: usize>(
        tiers: &mut Tiers<'_, i16, N>,
        (apart, payloads): (&Apart, &[u64]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, i16, N>,
        chunks: usize,
    ) {
        let [_, sheet] = registers(tiers);
        for slot in 0..N {
            let across = &layers.across[0][slot];
            let after = layers.after(slot);
            let first: *mut __m256i = tiers.lines.as_mut_ptr().cast();
            for (&i, &payload) in apart.kept.iter().zip(payloads) {
                let i = i as usize % BATCH;
                if after >= apart.left[i] {
                    continue;
                }
                let place = places[slot][i] as usize;
                let (at, shift) = (place / 4, place % 4);
                assert!(at + chunks * GROUPS <= sheet, "a footprint inside its tier");
                let wz = layers.deep.weights[apart.deep[i] as usize + after as usize];
                let section = _mm256_set1_epi64x(payload as i64);
                let section = _mm256_mulhrs_epi16(section, _mm256_set1_epi16(wz));
                let from = apart.from[0][slot][i] as usize;
                for chunk in 0..chunks {
                    let w = spread_shorts::<GROUPS>(across, from, shift, chunk);
                    // SAFETY: of the slot's, as shown above.
                    unsafe {
                        add_shorts(first.add(slot * sheet + at + chunk * GROUPS), section, &w);
                    }
                }
            }
        }
    }

    /// Weights of groups of 8 / C columns, each for C channels.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn spread_longs<const GROUPS: usize, const C: usize>(
        Table { weights: table, len }: &Table<'_, Tap>,
        from: usize,
        shift: usize,
        chunk: usize,
    ) -> [__m256; GROUPS] {
        let around: [Tap; LONGS] = around(table, from, shift, chunk);
        let bits = window(&LONG_BITS, shift, *len, chunk * LONGS);
        // SAFETY: eight weights are 32 bytes, and so are eight numbers.
        let w = unsafe {
            let [begun, left] = bits.map(|bits| _mm256_loadu_ps(bits.as_ptr().cast()));
            _mm256_and_ps(_mm256_loadu_ps(around.as_ptr().cast()), _mm256_and_ps(begun, left))
        };
        let lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
        let each =
            if C == 4 { _mm256_srli_epi32::<2>(lanes) } else { _mm256_srli_epi32::<1>(lanes) };
        let mut spread = [w; GROUPS];
        for (g, spread) in spread.iter_mut().enumerate() {
            let which = _mm256_add_epi32(each, _mm256_set1_epi32((8 / C * g) as i32));
            *spread = _mm256_permutevar8x32_ps(w, which);
        }
        spread
    }

    /// Adds `section * w` to the registers from `at` on.
    ///
    /// # Safety
    /// There are as many.
    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn add_longs<const GROUPS: usize>(
        at: *mut __m256i,
        section: __m256,
        w: &[__m256; GROUPS],
    ) {
        for (g, w) in w.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            unsafe {
                let add = _mm256_cvtps_epi32(_mm256_mul_ps(section, *w));
                _mm256_store_si256(at.add(g), _mm256_add_epi32(_mm256_load_si256(at.add(g)), add));
            }
        }
    }

    /// A payload of C channels, over and over.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn payload<const C: usize>(payload: &[f32; C]) -> __m256 {
        let four: [f32; 4] = std::array::from_fn(|i| payload[i % C]);
        // SAFETY: four floats are 16 bytes.
        let four = unsafe { _mm_loadu_ps(four.as_ptr()) };
        _mm256_set_m128(four, four)
    }

    /// A payload times a weight in depth; not negative.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn section(payload: __m256, wz: f32) -> __m256 {
        _mm256_max_ps(_mm256_mul_ps(payload, _mm256_set1_ps(wz)), _mm256_setzero_ps())
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn add_flat_longs<S, const C: usize, const N: usize>(
        tiers: &mut Tiers<'_, S, N>,
        voxels: (&[Splat], &[[f32; C]]),
        slot: usize,
        weights: &Weights<'_, S>,
    ) where
        S: Recorded<Depth = f32> + Accumulate<Weight = Tap>,
    {
        let groups = groups(tiers.shape.len, columns::<S>());
        if C == 4 {
            by_groups!(groups, 4, flat_longs[S, C, N](tiers, voxels, slot, weights));
        } else {
            by_groups!(groups, 2, flat_longs[S, C, N](tiers, voxels, slot, weights));
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn flat_longs<const GROUPS: usize, S, const C: usize, const N: usize>(
        tiers: &mut Tiers<'_, S, N>,
        (voxels, payloads): (&[Splat], &[[f32; C]]),
        slot: usize,
        Weights { across, deep }: &Weights<'_, S>,
        chunks: usize,
    ) where
        S: Recorded<Depth = f32> + Accumulate<Weight = Tap>,
    {
        let [a_tier, sheet] = registers(tiers);
        let columns = columns::<S>();
        let offsets: [usize; N] = std::array::from_fn(|i| (slot + i) % N * sheet);
        let first: *mut __m256i = tiers.lines.as_mut_ptr().cast();
        for (v, of) in voxels.iter().zip(payloads) {
            let [place, row] = v.first();
            let (at, shift) = (row * a_tier + place / columns, place % columns);
            assert!(at + chunks * GROUPS <= sheet, "a footprint inside its tier");
            let from = (v.rows & 0xffff) as usize;
            let wz = deep.row(v.phase() as usize * deep.len);
            let payload = payload(of);
            for chunk in 0..chunks {
                let w = spread_longs::<GROUPS, C>(across, from, shift, chunk);
                let at = at + chunk * GROUPS;
                let add = |(offset, wz): (&usize, &f32)| {
                    // SAFETY: of the slot's, as shown above.
                    unsafe { add_longs(first.add(offset + at), section(payload, *wz), &w) };
                };
                match wz.first_chunk::<N>() {
                    // A loop of known length.
                    Some(wz) => offsets.iter().zip(wz).for_each(add),
                    None => offsets.iter().zip(wz).for_each(add),
                }
            }
        }
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn add_apart_longs<const N: usize>(
        tiers: &mut Tiers<'_, i32, N>,
        voxels: (&Apart, &[[f32; 4]]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, i32, N>,
    ) {
        let groups = groups(tiers.shape.len, columns::<i32>());
        by_groups!(groups, 4, apart_longs[N](tiers, voxels, places, layers));
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn apart_longs<const GROUPS: usize, const N: usize>(
        tiers: &mut Tiers<'_, i32, N>,
        (apart, payloads): (&Apart, &[[f32; 4]]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, i32, N>,
        chunks: usize,
    ) {
        let [_, sheet] = registers(tiers);
        for slot in 0..N {
            let across = &layers.across[0][slot];
            let after = layers.after(slot);
            let first: *mut __m256i = tiers.lines.as_mut_ptr().cast();
            for (&i, of) in apart.kept.iter().zip(payloads) {
                let i = i as usize % BATCH;
                if after >= apart.left[i] {
                    continue;
                }
                let place = places[slot][i] as usize;
                let (at, shift) = (place / 2, place % 2);
                assert!(at + chunks * GROUPS <= sheet, "a footprint inside its tier");
                let wz = layers.deep.weights[apart.deep[i] as usize + after as usize];
                let section = section(payload(of), wz);
                let from = apart.from[0][slot][i] as usize;
                for chunk in 0..chunks {
                    let w = spread_longs::<GROUPS, 4>(across, from, shift, chunk);
                    // SAFETY: of the slot's, as shown above.
                    unsafe {
                        add_longs(first.add(slot * sheet + at + chunk * GROUPS), section, &w);
                    }
                }
            }
        }
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn fold_longs<S, const C: usize, const N: usize>(
        tiers: &Tiers<'_, S, N>,
        above: [Above<'_, Tap>; 2],
        spread: f32,
        open: u64,
        to: &mut Folded<S>,
    ) -> u64
    where
        S: Recorded<Pixel = [i32; C]> + Accumulate<Weight = Tap>,
    {
        const { assert!(C == 2 || C == 4) };
        let (first, a_tier) = (lines_of(tiers, &above).cast::<__m256i>(), 2 * tiers.shape.wide);
        let [(_, here), (_, behind)] = above;
        let four = here.first_chunk::<4>().zip(behind.first_chunk::<4>());
        let four = four.filter(|_| here.len().max(behind.len()) == 4).map(|(here, behind)| {
            let all = |weights: &[Tap; 4]| weights.map(|w| _mm256_set1_ps(w.0 * spread));
            [all(here), all(behind)]
        });
        let (most, zero) = (_mm256_set1_ps(crate::splat::LARGEST), _mm256_setzero_si256());
        let (mut filled, mut n) = (0, to.n);
        let room = &mut to.records[..n + open.count_ones() as usize + SPARE];
        let room: *mut [S::Pixel; 2] = room.as_mut_ptr();
        let mut left = firsts_of(open, columns::<S>());
        while left != 0 {
            let x = left.trailing_zeros() as usize;
            left &= left - 1;
            let mut whole = [zero; 2];
            for sheet in 0..2 {
                let (begin, weights) = above[sheet];
                let mut at = 2 * begin as usize + x / columns::<S>();
                let mut sums = _mm256_setzero_ps();
                let mut add = |wy: __m256| {
                    // SAFETY: a tier that is there has so many registers.
                    let row = unsafe { _mm256_load_si256(first.add(at)) };
                    at += a_tier;
                    sums = _mm256_add_ps(sums, _mm256_mul_ps(_mm256_cvtepi32_ps(row), wy));
                };
                match &four {
                    // A loop of known length.
                    Some(four) => four[sheet].iter().for_each(|&wy| add(wy)),
                    None => weights.iter().for_each(|wy| add(_mm256_set1_ps(wy.0 * spread))),
                }
                whole[sheet] = _mm256_cvtps_epi32(_mm256_min_ps(sums, most));
            }
            let nothing = _mm256_cmpeq_epi32(whole[0], zero);
            let nothing = _mm256_movemask_ps(_mm256_castsi256_ps(nothing)) as u32;
            let [here, behind] = whole;
            // SAFETY: no more are kept than there are open pixels, and two or four are stored where the next one goes.
            unsafe {
                if C == 4 {
                    let some = (open >> x) as u32 & (!nothing & 1 | (!nothing >> 4 & 1) << 1);
                    _mm256_storeu_si256(
                        room.add(n).cast(),
                        _mm256_permute2x128_si256::<0x20>(here, behind),
                    );
                    n += (some & 1) as usize;
                    _mm256_storeu_si256(
                        room.add(n).cast(),
                        _mm256_permute2x128_si256::<0x31>(here, behind),
                    );
                    n += (some >> 1) as usize;
                    filled |= u64::from(some) << x;
                } else {
                    // Extinctions are every other number.
                    let there = !nothing & 0x55;
                    let there = (there | there >> 1) & 0x33;
                    let some = (open >> x) as u32 & (there | there >> 2) & 0xf;
                    n = store_fours(room.cast(), n, [here, behind], some);
                    filled |= u64::from(some) << x;
                }
            }
        }
        to.n = n;
        filled
    }

    /// Stores those of four records of 16 bytes that `some` has bits for from the `n`th on, the first half of each from
    /// a register, the second half from another. Says how many there are then.
    ///
    /// # Safety
    /// There is room for four.
    #[target_feature(enable = "avx2")]
    #[inline]
    unsafe fn store_fours(
        room: *mut __m128i,
        n: usize,
        [here, behind]: [__m256i; 2],
        some: u32,
    ) -> usize {
        let even = _mm256_unpacklo_epi64(here, behind);
        let odd = _mm256_unpackhi_epi64(here, behind);
        let [b0, b1, b2, b3] = [0, 1, 2, 3].map(|i| (some >> i & 1) as usize);
        let n = [n, n + b0, n + b0 + b1, n + b0 + b1 + b2, n + b0 + b1 + b2 + b3];
        // SAFETY: the caller's.
        unsafe {
            _mm_storeu_si128(room.add(n[0]), _mm256_castsi256_si128(even));
            _mm_storeu_si128(room.add(n[1]), _mm256_castsi256_si128(odd));
            _mm_storeu_si128(room.add(n[2]), _mm256_extracti128_si256::<1>(even));
            _mm_storeu_si128(room.add(n[3]), _mm256_extracti128_si256::<1>(odd));
        }
        n[4]
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn fold_shorts<const N: usize>(
        tiers: &Tiers<'_, i16, N>,
        above: [Above<'_, i16>; 2],
        open: u64,
        to: &mut Folded<i16>,
    ) -> u64 {
        let (first, a_tier) = (lines_of(tiers, &above).cast::<__m256i>(), 2 * tiers.shape.wide);
        let [(_, here), (_, behind)] = above;
        let four = here.first_chunk::<4>().zip(behind.first_chunk::<4>());
        let four = four.filter(|_| here.len().max(behind.len()) == 4).map(|(here, behind)| {
            let all = |weights: &[i16; 4]| weights.map(|w| _mm256_set1_epi16(w));
            [all(here), all(behind)]
        });
        let zero = _mm256_setzero_si256();
        let (mut filled, mut n) = (0, to.n);
        let room = &mut to.records[..n + open.count_ones() as usize + SPARE];
        let room: *mut __m128i = room.as_mut_ptr().cast();
        let mut left = firsts_of(open, 4);
        while left != 0 {
            let x = left.trailing_zeros() as usize;
            left &= left - 1;
            let mut sums = [zero; 2];
            for sheet in 0..2 {
                let (begin, weights) = above[sheet];
                let mut at = 2 * begin as usize + x / 4;
                let mut add = |wy: __m256i| {
                    // SAFETY: four pixels of 64 in a tier that is there are a register.
                    let row = unsafe { _mm256_load_si256(first.add(at)) };
                    at += a_tier;
                    sums[sheet] = _mm256_adds_epi16(sums[sheet], _mm256_mulhrs_epi16(row, wy));
                };
                match &four {
                    // A loop of known length.
                    Some(four) => four[sheet].iter().for_each(|&wy| add(wy)),
                    None => weights.iter().for_each(|&wy| add(_mm256_set1_epi16(wy))),
                }
            }
            // A sign for each pixel without extinction, which comes first.
            let nothing = _mm256_slli_epi64::<48>(_mm256_cmpeq_epi16(sums[0], zero));
            let nothing = _mm256_movemask_pd(_mm256_castsi256_pd(nothing)) as u32;
            let some = (open >> x) as u32 & !nothing & 0xf;
            // SAFETY: no more are kept than there are open pixels, and four are stored where the next one goes.
            n = unsafe { store_fours(room, n, sums, some) };
            filled |= u64::from(some) << x;
        }
        to.n = n;
        filled
    }
}

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use super::*;
    use std::arch::x86_64::*;

    /// Columns of a chunk of weights of 16 bits, and of 32.
    const SHORTS: usize = 32;
    const LONGS: usize = 16;

    /// Which of the weights from `chunk` times `of` on are those of a footprint of `len` columns that begins at
    /// `shift`.
    #[inline(always)]
    fn present(len_mask: u64, shift: usize, chunk: usize, of: usize) -> u64 {
        if chunk == 0 {
            len_mask << shift
        } else {
            (u128::from(len_mask) << shift >> (chunk * of)) as u64
        }
    }

    /// Sixteen-bit weights of four groups of eight columns, each for four channels.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn spread_shorts<const GROUPS: usize>(
        row: &[i16],
        len_mask: u64,
        shift: usize,
        chunk: usize,
    ) -> [__m512i; GROUPS] {
        let present = present(len_mask, shift, chunk, SHORTS) as u32;
        let from = row.as_ptr().wrapping_sub(shift).wrapping_add(chunk * SHORTS);
        // SAFETY: present are those of the row, and no others are read.
        let w = unsafe { _mm512_maskz_loadu_epi16(present, from) };
        let each = _mm512_set_epi16(
            7, 7, 7, 7, 6, 6, 6, 6, 5, 5, 5, 5, 4, 4, 4, 4, 3, 3, 3, 3, 2, 2, 2, 2, 1, 1, 1, 1, 0,
            0, 0, 0,
        );
        let mut spread = [w; GROUPS];
        for (g, spread) in spread.iter_mut().enumerate() {
            let which = _mm512_add_epi16(each, _mm512_set1_epi16(8 * g as i16));
            *spread = _mm512_permutexvar_epi16(which, w);
        }
        spread
    }

    /// Adds `section * w` to the lines from `at` on.
    ///
    /// # Safety
    /// There are as many lines.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn add_shorts<const GROUPS: usize>(
        at: *mut Line,
        section: __m512i,
        w: &[__m512i; GROUPS],
    ) {
        for (g, w) in w.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            unsafe {
                let at: *mut __m512i = at.add(g).cast();
                let sums = _mm512_load_si512(at);
                let sums = _mm512_adds_epi16(sums, _mm512_mulhrs_epi16(section, *w));
                _mm512_store_si512(at, sums);
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(super) fn add_flat_shorts<const N: usize>(
        tiers: &mut Tiers<'_, i16, N>,
        voxels: (&[Splat], &[u64]),
        slot: usize,
        weights: &Weights<'_, i16>,
    ) {
        by_groups!(
            groups(tiers.shape.len, a_line::<i16>()),
            4,
            flat_shorts[N](tiers, voxels, slot, weights)
        );
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn flat_shorts<const GROUPS: usize, const N: usize>(
        tiers: &mut Tiers<'_, i16, N>,
        (voxels, payloads): (&[Splat], &[u64]),
        slot: usize,
        Weights { across, deep }: &Weights<'_, i16>,
        chunks: usize,
    ) {
        let Shape { rows, wide, .. } = tiers.shape;
        let len_mask = (1u64 << across.len) - 1;
        assert!(tiers.lines.len() >= N * rows * wide, "tiers of all sheets");
        let sheet = rows * wide;
        let offsets: [usize; N] = std::array::from_fn(|i| (slot + i) % N * sheet);
        let first: *mut Line = tiers.lines.as_mut_ptr();
        for (v, &payload) in voxels.iter().zip(payloads) {
            let [place, row] = v.first();
            let (line, shift) = (row * wide + place / 8, place % 8);
            assert!(line + chunks * GROUPS <= sheet, "a footprint inside its tier");
            let wx = across.row((v.rows & 0xffff) as usize);
            let wz = deep.row(v.phase() as usize * deep.len);
            let payload = _mm512_set1_epi64(payload as i64);
            for chunk in 0..chunks {
                let w = spread_shorts::<GROUPS>(wx, len_mask, shift, chunk);
                let line = line + chunk * GROUPS;
                let add = |(offset, wz): (&usize, &i16)| {
                    let section = _mm512_mulhrs_epi16(payload, _mm512_set1_epi16(*wz));
                    // SAFETY: of the slot's lines, as shown above.
                    unsafe { add_shorts(first.add(offset + line), section, &w) };
                };
                match wz.first_chunk::<N>() {
                    // A loop of known length.
                    Some(wz) => offsets.iter().zip(wz).for_each(add),
                    None => offsets.iter().zip(wz).for_each(add),
                }
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(super) fn add_apart_shorts<const N: usize>(
        tiers: &mut Tiers<'_, i16, N>,
        voxels: (&Apart, &[u64]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, i16, N>,
    ) {
        by_groups!(
            groups(tiers.shape.len, a_line::<i16>()),
            4,
            apart_shorts[N](tiers, voxels, places, layers)
        );
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn apart_shorts<const GROUPS: usize, const N: usize>(
        tiers: &mut Tiers<'_, i16, N>,
        (apart, payloads): (&Apart, &[u64]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, i16, N>,
        chunks: usize,
    ) {
        let shape = tiers.shape;
        let sheet = shape.rows * shape.wide;
        assert!(tiers.lines.len() >= N * sheet, "tiers of all sheets");
        let first: *mut Line = tiers.lines.as_mut_ptr();
        for (&i, &payload) in apart.kept.iter().zip(payloads) {
            let i = i as usize % BATCH;
            let payload = _mm512_set1_epi64(payload as i64);
            for slot in 0..N {
                let after = layers.after(slot);
                if after >= apart.left[i] {
                    continue;
                }
                let wz = layers.deep.weights[apart.deep[i] as usize + after as usize];
                let section = _mm512_mulhrs_epi16(payload, _mm512_set1_epi16(wz));
                let across = &layers.across[0][slot];
                let wx = across.row(apart.from[0][slot][i] as usize);
                let place = places[slot][i] as usize;
                let (line, shift) = (place / 8, place % 8);
                assert!(line + chunks * GROUPS <= sheet, "a footprint inside its tier");
                let len_mask = (1u64 << across.len) - 1;
                for chunk in 0..chunks {
                    let w = spread_shorts::<GROUPS>(wx, len_mask, shift, chunk);
                    // SAFETY: of the slot's lines, as shown above.
                    unsafe {
                        add_shorts(first.add(slot * sheet + line + chunk * GROUPS), section, &w)
                    };
                }
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,popcnt")]
    pub(super) fn fold_shorts<const N: usize>(
        tiers: &Tiers<'_, i16, N>,
        above: [Above<'_, i16>; 2],
        open: u64,
        to: &mut Folded<i16>,
    ) -> u64 {
        let (lines, wide) = (lines_of(tiers, &above), tiers.shape.wide);
        let order = [
            _mm512_setr_epi64(0, 8, 1, 9, 2, 10, 3, 11),
            _mm512_setr_epi64(4, 12, 5, 13, 6, 14, 7, 15),
        ];
        let extinction = _mm512_set1_epi64(0xffff);
        let mut filled = 0;
        let [(_, here), (_, behind)] = above;
        let four = here.first_chunk::<4>().zip(behind.first_chunk::<4>());
        let four = four.filter(|_| here.len().max(behind.len()) == 4).map(|(here, behind)| {
            let all = |weights: &[i16; 4]| weights.map(|w| _mm512_set1_epi16(w));
            [all(here), all(behind)]
        });
        let mut left = firsts::<i16>(open);
        while left != 0 {
            let eight = left.trailing_zeros() as usize / 8;
            left &= left - 1;
            let here = (open >> (8 * eight)) as u8;
            let mut sums = [_mm512_setzero_si512(); 2];
            for sheet in 0..2 {
                let (begin, weights) = above[sheet];
                let mut line = begin as usize + eight;
                let mut add = |wy: __m512i| {
                    // SAFETY: eight pixels of 64 in a tier that is there are a line.
                    let row = unsafe { _mm512_load_si512(lines.add(line).cast()) };
                    line += wide;
                    let row = _mm512_mulhrs_epi16(row, wy);
                    sums[sheet] = _mm512_adds_epi16(sums[sheet], row);
                };
                match &four {
                    // A loop of known length.
                    Some(four) => four[sheet].iter().for_each(|&wy| add(wy)),
                    None => weights.iter().for_each(|&wy| add(_mm512_set1_epi16(wy))),
                }
            }
            let some = _mm512_mask_test_epi64_mask(here, sums[0], extinction);
            let sums = [
                _mm512_maskz_compress_epi64(some, sums[0]),
                _mm512_maskz_compress_epi64(some, sums[1]),
            ];
            let room = to.records[to.n..].first_chunk_mut::<8>().expect("room for eight");
            let at: *mut __m512i = room.as_mut_ptr().cast();
            for (i, order) in order.iter().enumerate() {
                // SAFETY: eight records of 16 bytes are two registers.
                unsafe {
                    let both = _mm512_permutex2var_epi64(sums[0], *order, sums[1]);
                    _mm512_storeu_si512(at.add(i), both);
                }
            }
            to.n += some.count_ones() as usize;
            filled |= u64::from(some) << (8 * eight);
        }
        filled
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,popcnt,bmi2")]
    pub(super) fn fold_longs<S, const C: usize, const N: usize>(
        tiers: &Tiers<'_, S, N>,
        above: [Above<'_, Tap>; 2],
        spread: f32,
        open: u64,
        to: &mut Folded<S>,
    ) -> u64
    where
        S: Recorded<Pixel = [i32; C]> + Accumulate<Weight = Tap>,
    {
        const { assert!(C == 2 || C == 4) };
        let (lines, wide) = (lines_of(tiers, &above), tiers.shape.wide);
        let order = if C == 2 {
            [
                _mm512_setr_epi64(0, 8, 1, 9, 2, 10, 3, 11),
                _mm512_setr_epi64(4, 12, 5, 13, 6, 14, 7, 15),
            ]
        } else {
            [
                _mm512_setr_epi64(0, 1, 8, 9, 2, 3, 10, 11),
                _mm512_setr_epi64(4, 5, 12, 13, 6, 7, 14, 15),
            ]
        };
        // The pixels of a line, and its words that are extinctions.
        let (pixels, words) = (16 / C, if C == 2 { 0x5555 } else { 0x1111 });
        let mut filled = 0;
        let [(_, here), (_, behind)] = above;
        let four = here.first_chunk::<4>().zip(behind.first_chunk::<4>());
        let four = four.filter(|_| here.len().max(behind.len()) == 4).map(|(here, behind)| {
            let all = |weights: &[Tap; 4]| weights.map(|w| _mm512_set1_ps(w.0 * spread));
            [all(here), all(behind)]
        });
        let most = _mm512_set1_ps(crate::splat::LARGEST);
        let mut left = firsts::<S>(open);
        while left != 0 {
            let group = left.trailing_zeros() as usize / pixels;
            left &= left - 1;
            let here = open >> (pixels * group) & ((1 << pixels) - 1);
            let mut whole = [_mm512_setzero_si512(); 2];
            for sheet in 0..2 {
                let (begin, weights) = above[sheet];
                let mut sums = _mm512_setzero_ps();
                let mut line = begin as usize + group;
                let mut add = |wy: __m512| {
                    // SAFETY: a tier that is there has so many lines.
                    let row = unsafe { _mm512_load_si512(lines.add(line).cast()) };
                    line += wide;
                    let row = _mm512_mul_ps(_mm512_cvtepi32_ps(row), wy);
                    sums = _mm512_add_ps(sums, row);
                };
                match &four {
                    // A loop of known length.
                    Some(four) => four[sheet].iter().for_each(|&wy| add(wy)),
                    None => weights.iter().for_each(|wy| add(_mm512_set1_ps(wy.0 * spread))),
                }
                whole[sheet] = _mm512_cvtps_epi32(_mm512_min_ps(sums, most));
            }
            // A bit for each pixel's extinction, then one for each pixel, and one for each half of it.
            let some = _mm512_mask_test_epi32_mask(words, whole[0], whole[0]);
            let some = _pext_u32(some.into(), words.into()) & here as u32;
            let halves = if C == 2 { some } else { _pdep_u32(some, 0x55) * 3 };
            let whole = [
                _mm512_maskz_compress_epi64(halves as u8, whole[0]),
                _mm512_maskz_compress_epi64(halves as u8, whole[1]),
            ];
            let room = to.records[to.n..].first_chunk_mut::<8>().expect("room for eight");
            let at: *mut __m512i = room.as_mut_ptr().cast();
            for (i, order) in order.iter().enumerate() {
                // SAFETY: eight records are two registers and more.
                unsafe {
                    let both = _mm512_permutex2var_epi64(whole[0], *order, whole[1]);
                    _mm512_storeu_si512(at.add(i), both);
                }
            }
            to.n += some.count_ones() as usize;
            filled |= u64::from(some) << (pixels * group);
        }
        filled
    }

    /// Weights of groups of 16 / C columns, each for C channels.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn spread_longs<const GROUPS: usize, const C: usize>(
        row: &[Tap],
        len_mask: u64,
        shift: usize,
        chunk: usize,
    ) -> [__m512; GROUPS] {
        let present = present(len_mask, shift, chunk, LONGS) as u16;
        let from = row.as_ptr().wrapping_sub(shift).wrapping_add(chunk * LONGS);
        // SAFETY: present are those of the row, and no others are read.
        let w = unsafe { _mm512_maskz_loadu_ps(present, from.cast()) };
        let lanes = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        let each =
            if C == 4 { _mm512_srli_epi32::<2>(lanes) } else { _mm512_srli_epi32::<1>(lanes) };
        let mut spread = [w; GROUPS];
        for (g, spread) in spread.iter_mut().enumerate() {
            let which = _mm512_add_epi32(each, _mm512_set1_epi32((16 / C * g) as i32));
            *spread = _mm512_permutexvar_ps(which, w);
        }
        spread
    }

    /// Adds `section * w` to the lines from `at` on.
    ///
    /// # Safety
    /// There are as many lines.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    unsafe fn add_longs<const GROUPS: usize>(at: *mut Line, section: __m512, w: &[__m512; GROUPS]) {
        for (g, w) in w.iter().enumerate() {
            // SAFETY: the caller's; lines are aligned.
            unsafe {
                let at: *mut __m512i = at.add(g).cast();
                let add = _mm512_cvtps_epi32(_mm512_mul_ps(section, *w));
                _mm512_store_si512(at, _mm512_add_epi32(_mm512_load_si512(at), add));
            }
        }
    }

    /// A payload of C channels, over and over.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn payload<const C: usize>(payload: &[f32; C]) -> __m512 {
        let four: [f32; 4] = std::array::from_fn(|i| payload[i % C]);
        // SAFETY: four floats are 16 bytes.
        _mm512_broadcast_f32x4(unsafe { _mm_loadu_ps(four.as_ptr()) })
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(super) fn add_flat_longs<S, const C: usize, const N: usize>(
        tiers: &mut Tiers<'_, S, N>,
        voxels: (&[Splat], &[[f32; C]]),
        slot: usize,
        weights: &Weights<'_, S>,
    ) where
        S: Recorded<Depth = f32> + Accumulate<Weight = Tap>,
    {
        if C == 4 {
            by_groups!(groups(tiers.shape.len, a_line::<S>()), 4, flat_longs[S, C, N](tiers, voxels, slot, weights));
        } else {
            by_groups!(groups(tiers.shape.len, a_line::<S>()), 2, flat_longs[S, C, N](tiers, voxels, slot, weights));
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn flat_longs<const GROUPS: usize, S, const C: usize, const N: usize>(
        tiers: &mut Tiers<'_, S, N>,
        (voxels, payloads): (&[Splat], &[[f32; C]]),
        slot: usize,
        Weights { across, deep }: &Weights<'_, S>,
        chunks: usize,
    ) where
        S: Recorded<Depth = f32> + Accumulate<Weight = Tap>,
    {
        const { assert!(C == 2 || C == 4) };
        let Shape { rows, wide, .. } = tiers.shape;
        let len_mask = (1u64 << across.len) - 1;
        let sheet = rows * wide;
        let offsets: [usize; N] = std::array::from_fn(|i| (slot + i) % N * sheet);
        assert!(tiers.lines.len() >= N * sheet, "tiers of all sheets");
        let first: *mut Line = tiers.lines.as_mut_ptr();
        for (v, of) in voxels.iter().zip(payloads) {
            let [place, row] = v.first();
            let (line, shift) = (row * wide + place / (16 / C), place % (16 / C));
            assert!(line + chunks * GROUPS <= sheet, "a footprint inside its tier");
            let wx = across.row((v.rows & 0xffff) as usize);
            let wz = deep.row(v.phase() as usize * deep.len);
            let payload = payload(of);
            for chunk in 0..chunks {
                let w = spread_longs::<GROUPS, C>(wx, len_mask, shift, chunk);
                let line = line + chunk * GROUPS;
                let add = |(offset, wz): (&usize, &f32)| {
                    let section = _mm512_mul_ps(payload, _mm512_set1_ps(*wz));
                    // Negative sections there are none.
                    let section = _mm512_max_ps(section, _mm512_setzero_ps());
                    // SAFETY: of the slot's lines, as shown above.
                    unsafe { add_longs(first.add(offset + line), section, &w) };
                };
                match wz.first_chunk::<N>() {
                    Some(wz) => offsets.iter().zip(wz).for_each(add),
                    None => offsets.iter().zip(wz).for_each(add),
                }
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(super) fn add_apart_longs<const N: usize>(
        tiers: &mut Tiers<'_, i32, N>,
        voxels: (&Apart, &[[f32; 4]]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, i32, N>,
    ) {
        by_groups!(
            groups(tiers.shape.len, a_line::<i32>()),
            4,
            apart_longs[N](tiers, voxels, places, layers)
        );
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn apart_longs<const GROUPS: usize, const N: usize>(
        tiers: &mut Tiers<'_, i32, N>,
        (apart, payloads): (&Apart, &[[f32; 4]]),
        places: &[Each<u32>; MOST],
        layers: &Layers<'_, i32, N>,
        chunks: usize,
    ) {
        let shape = tiers.shape;
        let sheet = shape.rows * shape.wide;
        assert!(tiers.lines.len() >= N * sheet, "tiers of all sheets");
        let first: *mut Line = tiers.lines.as_mut_ptr();
        for (&i, of) in apart.kept.iter().zip(payloads) {
            let i = i as usize % BATCH;
            let payload = payload(of);
            for slot in 0..N {
                let after = layers.after(slot);
                if after >= apart.left[i] {
                    continue;
                }
                let wz = layers.deep.weights[apart.deep[i] as usize + after as usize];
                let section = _mm512_mul_ps(payload, _mm512_set1_ps(wz));
                let section = _mm512_max_ps(section, _mm512_setzero_ps());
                let across = &layers.across[0][slot];
                let wx = across.row(apart.from[0][slot][i] as usize);
                let place = places[slot][i] as usize;
                let (line, shift) = (place / 4, place % 4);
                assert!(line + chunks * GROUPS <= sheet, "a footprint inside its tier");
                let len_mask = (1u64 << across.len) - 1;
                for chunk in 0..chunks {
                    let w = spread_longs::<GROUPS, 4>(wx, len_mask, shift, chunk);
                    // SAFETY: of the slot's lines, as shown above.
                    unsafe {
                        add_longs(first.add(slot * sheet + line + chunk * GROUPS), section, &w)
                    };
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Numbers that look random.
    fn numbers(seed: u32) -> impl FnMut(u32) -> u32 {
        let mut state = u64::from(seed) | 1 << 40;
        move |below| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(99);
            ((state >> 32) as u32) % below
        }
    }

    /// Voxels added flat and apart, and some rows folded, by every instruction set as by the plain loops.
    fn everywhere<S: Tiered, const N: usize>(
        (len, rows, reaching): (usize, usize, usize),
        seed: u32,
        weight: impl Fn(u32) -> S::Weight,
        deep: impl Fn(u32) -> S::Depth,
    ) -> Result<(), TestCaseError> {
        let mut next = numbers(seed);
        let shape = Shape::new::<S>(rows, len);
        let phases = 5;
        let table: Vec<S::Weight> = (0..phases * len).map(|_| weight(next(1000))).collect();
        let across = Table { weights: &table[..], len };
        let depths: Vec<S::Depth> = (0..3 * N).map(|_| deep(next(1000))).collect();
        let weights = Weights { across, deep: Table { weights: &depths[..], len: N } };
        let payloads: Vec<S::Payload> = (0..40)
            .map(|_| S::payload([next(9000), next(9000), next(9000), next(9000)].map(|x| x as f32)))
            .collect();
        let mut place = || {
            let first = next(64 + 2 * len as u32) as i32 - 2 * len as i32;
            (first, shape.place(first), next(rows as u32), next(phases as u32) * len as u32)
        };
        let voxels: Vec<Splat> = (0..40)
            .map(|_| {
                let (_, place, row, from) = place();
                Splat { place: place | row << 8, rows: from, deep: from % 3, sample: 0 }
            })
            .collect();
        let (mut apart, mut places) = (Apart::default(), [[0; BATCH]; MOST]);
        for i in 0..40 {
            apart.kept[i] = i as u32;
            apart.left[i] = 1 + (i % N) as i32;
            for slot in 0..N {
                let (first, _, row, from) = place();
                (apart.first[0][slot][i], apart.from[0][slot][i]) = (first, from);
                places[slot][i] = shape.place_in(row, first);
            }
        }
        let layers =
            Layers { across: [[across; N]; 2], deep: weights.deep, slot: 1 % N, alike: false };
        let (begin, open) =
            (next((rows - reaching) as u32) as usize, u64::from(next(1 << 31)) << 9 | 1);
        let wy: Vec<S::Weight> = (0..reaching).map(|_| weight(next(1000))).collect();
        let run = |simd| {
            let mut lines = vec![Line::ZERO; shape.lines(N)];
            let mut tiers = Tiers::<S, N>::new(&mut lines, shape);
            S::add_flat(simd, &mut tiers, (&voxels, &payloads), 2 % N, &weights);
            S::add_apart(simd, &mut tiers, (&apart, &payloads), &places, &layers);
            let mut folded = Folded::default();
            let mut all = Vec::new();
            for open in [open, !open, u64::MAX, 0] {
                let above = [0, 1].map(|slot| (tiers.begin(slot, begin), &wy[..]));
                all.push(S::fold(simd, &tiers, above, 1.25, open, &mut folded));
                assert_eq!(
                    all.iter().map(|filled| filled.count_ones()).sum::<u32>(),
                    folded.n as u32
                );
            }
            let margin = shape.margin;
            let seen: Vec<Vec<S::Pixel>> = (0..N * rows)
                .map(|i| {
                    tiers.tier_mut(i / rows, i % rows)[margin..margin + PART as usize].to_vec()
                })
                .collect();
            (seen, all, folded.records[..folded.n].to_vec())
        };
        let want = run(Simd::plain());
        let nothing = S::Pixel::default();
        prop_assert!(want.0.iter().flatten().any(|sums| *sums != nothing) && want.1[3] == 0);
        for simd in Simd::all() {
            prop_assert!(run(simd) == want, "{}", simd.name());
        }
        Ok(())
    }

    proptest! {
        #[test]
        fn every_instruction_set_adds_to_tiers_and_folds_them_as_the_plain_loops_do(
            len in prop::sample::select(vec![1, 3, 4, 5, 7, 8, 9, 13, 14, 17, 25, 26, 41, 63]),
            rows in 24..60usize, reaching in 1..9usize, seed in any::<u32>(),
        ) {
            let shape = (len, rows, reaching);
            let short = |x| x as i16 * 20;
            everywhere::<i16, 4>(shape, seed, short, short)?;
            everywhere::<i16, 8>(shape, seed, short, short)?;
            let (tap, deep) = (|x| Tap::new(x as f32 * 1e-3), |x| x as f32 * 1e-3);
            everywhere::<i32, 4>(shape, seed, tap, deep)?;
            everywhere::<i32, 8>(shape, seed, tap, deep)?;
            everywhere::<Grey, 4>(shape, seed, tap, deep)?;
            everywhere::<Grey, 8>(shape, seed, tap, deep)?;
        }
    }
}
