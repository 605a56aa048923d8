//! Pixel records: the sums of several sheets of a pixel side by side, so that a voxel adds all its
//! sections at once.
//!
//! A record has N sheets, four or eight: as many as a voxel has sections, which for sheets of a vox
//! are four. Four sheets of 16-bit sums are 32 bytes: one operation of AVX2, and one of AVX-512 for
//! two pixels (`short`); 32-bit sums take twice that (`long`). NEON's registers have sixteen
//! bytes, and all kinds of sums share their loops there (`neon`). Every loop is written plainly
//! here; the loops in lanes must equal it.

/// Calls a function for windows of `wide` columns, at most sixteen, or of a few more.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! by_window {
    ($wide:expr, $side_by_side:ident[$($of:ident),*], $at:expr) => {
        by_window!($wide, $side_by_side[$($of),*][], $at)
    };
    ($wide:expr, $side_by_side:ident[$($of:ident),*][$($alike:literal)?], $at:expr) => {
        match $wide {
            0..=6 => $side_by_side::<6, $($of),*, $($alike)?>($at),
            7 => $side_by_side::<7, $($of),*, $($alike)?>($at),
            8 => $side_by_side::<8, $($of),*, $($alike)?>($at),
            9 => $side_by_side::<9, $($of),*, $($alike)?>($at),
            10 => $side_by_side::<10, $($of),*, $($alike)?>($at),
            11 | 12 => $side_by_side::<12, $($of),*, $($alike)?>($at),
            13 | 14 => $side_by_side::<14, $($of),*, $($alike)?>($at),
            _ => $side_by_side::<16, $($of),*, $($alike)?>($at),
        }
    };
}

/// Calls a function by the width of its windows where columns may be alike: windows are then as
/// wide as footprints.
#[cfg(target_arch = "aarch64")]
macro_rules! by_window_alike {
    ($wide:expr, $side_by_side:ident[$($of:ident),*], $at:expr) => {
        match ($wide, $at.2.alike) {
            (_, false) => by_window!($wide, $side_by_side[$($of),*][false], $at),
            (0..=4, true) => $side_by_side::<4, $($of),*, true>($at),
            (5, true) => $side_by_side::<5, $($of),*, true>($at),
            (6, true) => $side_by_side::<6, $($of),*, true>($at),
            (7 | 8, true) => $side_by_side::<8, $($of),*, true>($at),
            (9 | 10, true) => $side_by_side::<10, $($of),*, true>($at),
            (11 | 12, true) => $side_by_side::<12, $($of),*, true>($at),
            (_, true) => $side_by_side::<16, $($of),*, true>($at),
        }
    };
}

/// Calls a function for footprints as wide as common ones are, so that a row's loop is of known
/// length, or does what is for others.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! by_width {
    ($wide:expr, $all:ident[$($of:ident),*], $at:expr, $others:expr) => {
        match $wide {
            4 => $all::<4, $($of),*>($at),
            5 => $all::<5, $($of),*>($at),
            6 => $all::<6, $($of),*>($at),
            7 => $all::<7, $($of),*>($at),
            8 => $all::<8, $($of),*>($at),
            9 => $all::<9, $($of),*>($at),
            13 => $all::<13, $($of),*>($at),
            14 => $all::<14, $($of),*>($at),
            _ => $others,
        }
    };
}

mod long;
#[cfg(target_arch = "aarch64")]
mod neon;
pub mod shear;
pub mod sheet_offsets;
mod short;

use self::sheet_offsets::{Apart, Layers, Woven};
use super::{Accumulate, Grey, Level, Section, Simd, Tap, section_fixed, whole};
use crate::kernels::composite::Sum;
use crate::primitives::footprint::{Footprint, Sections};
pub use crate::primitives::sizes::MOST;
use slabcast_common::image::RawSums;

/// Records from a row of a part to the next: two more than a part has columns. Rows of 64 records
/// would lie 2048 or 4096 bytes apart, where a footprint's rows fall into few sets of the cache and
/// loads wait for stores of the row before, which they are mistaken for. Even, so that two records
/// that begin at an even column never lie across two lines of the cache.
pub const STRIDE: usize = 66;

/// The sums of N sheets at one pixel: extinction and three colours each, or extinction and grey.
pub type Record<S, const N: usize> = [<S as Recorded>::Pixel; N];

/// Memory of records: 64 bytes, one line of the cache.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Line([u8; 64]);

impl Line {
    /// A line whose bytes are all zero: sums of nothing.
    pub const ZERO: Line = Line([0; 64]);
}

// SAFETY: 64 bytes and no padding, zero among their values.
unsafe impl bytemuck::Zeroable for Line {}
// SAFETY: as above; any bytes will do.
unsafe impl bytemuck::Pod for Line {}

/// Table of weights along one axis, one row after another, each of `len` weights.
#[derive(Clone, Copy, Debug)]
pub struct Table<'a, W> {
    /// Weights of all rows; a row may begin at any index.
    pub weights: &'a [W],
    /// Number of weights of one row.
    pub len: usize,
}

impl<'a, W> Table<'a, W> {
    /// The weights from `from`.
    #[inline(always)]
    pub(crate) fn row(&self, from: usize) -> &'a [W] {
        &self.weights[from..from + self.len]
    }
}

/// Weight tables of a view: across, down and in depth.
#[derive(Clone, Copy)]
pub struct Tables<'a, S: Recorded> {
    /// Tables of the weights across and down the picture.
    pub across: [Table<'a, S::Weight>; 2],
    /// Table of the weights in depth, a row for each depth phase.
    pub deep: Table<'a, S::Depth>,
}

/// A voxel whose footprint, moved if need be, lies inside the part: sixteen bytes, packed as they
/// are so that many are made on lanes.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(16))]
pub struct Splat {
    /// Places of the voxel, packed. Bits 0 to 7 are its footprint's first column, bits 8 to 15 the
    /// first row. The bits above name the part's pixel nearest to its centre: 64 times the row, and
    /// the column.
    pub place: u32,
    /// Indices at which the weights across (low 16 bits) and down (high 16 bits) begin. Of a voxel
    /// whose sections have places of their own, its position in subpixels instead, x low and y
    /// high.
    pub rows: u32,
    /// Depth of the voxel in phases from its sheet's front (low 16 bits), and its normal code (high
    /// 16 bits).
    pub deep: u32,
    /// Sample code of the voxel, as bits.
    pub sample: u32,
}

/// A voxel's weights across, down and in depth.
type Weights<'a, S> = (
    &'a [<S as Accumulate>::Weight],
    &'a [<S as Accumulate>::Weight],
    &'a [<S as Recorded>::Depth],
);

impl Splat {
    /// First column and row.
    #[inline(always)]
    pub(crate) fn first(&self) -> [usize; 2] {
        [(self.place & 0xff) as usize, (self.place >> 8 & 0xff) as usize]
    }

    /// The pixel of the part that is nearest to its centre.
    #[inline(always)]
    pub(crate) fn cell(&self) -> u32 {
        self.place >> 16
    }

    /// Returns the voxel's normal code.
    #[inline(always)]
    pub(crate) fn normal(&self) -> u16 {
        (self.deep >> 16) as u16
    }

    /// Returns the voxel's own position, in subpixels from the part's corner: less than 2^15 of
    /// them.
    #[inline(always)]
    pub(crate) fn aside_of(&self) -> [i32; 2] {
        [i32::from(self.rows as i16), self.rows as i32 >> 16]
    }

    /// Returns the voxel's depth in phases from its sheet's front.
    #[inline(always)]
    pub(crate) fn phase(&self) -> u32 {
        self.deep & 0xffff
    }

    /// Record of its first row and column.
    #[inline(always)]
    pub(crate) fn at(&self) -> usize {
        let [x, y] = self.first();
        y * STRIDE + x
    }

    /// Returns the voxel's weights across, down and in depth.
    #[inline(always)]
    pub(crate) fn weights<'a, S: Recorded>(&self, tables: &Tables<'a, S>) -> Weights<'a, S> {
        let [x, y] = &tables.across;
        let z = self.phase() as usize * tables.deep.len;
        let rows = [self.rows & 0xffff, self.rows >> 16].map(|row| row as usize);
        (x.row(rows[0]), y.row(rows[1]), tables.deep.row(z))
    }
}

/// Weights by slot, one for each sheet that a record holds.
pub type BySlot<W, const N: usize> = [W; N];

/// Weights by column and slot, and by row and slot.
pub(crate) type Across<'a, W, const N: usize> = (&'a [BySlot<W, N>], &'a [BySlot<W, N>]);

/// One footprint's weights among others in a table, and the column that its first weight belongs
/// to.
#[derive(Clone, Copy, Debug)]
pub struct RowAt<'a, W> {
    /// Table that holds the weights.
    pub table: &'a [W],
    /// Index in the table at which the weights begin.
    pub from: usize,
    /// Number of weights.
    pub len: usize,
    /// Column (or row) of the first weight, in pixels from where the window begins; may be
    /// negative.
    pub column: i32,
}

impl<'a, W> RowAt<'a, W> {
    /// A row without a weight.
    pub const NONE: Self = RowAt { table: &[], from: 0, len: 0, column: 0 };

    /// Returns a row without a weight beside a table. A load of no lanes takes a machine hundreds
    /// of cycles where the address is invalid.
    #[inline(always)]
    pub(crate) fn none_of(table: &'a [W]) -> Self {
        RowAt { table, ..RowAt::NONE }
    }

    /// Returns which of the first 16 columns the row has a weight for, a bit each, and where the
    /// weight of the first column would be.
    #[inline(always)]
    fn columns(&self) -> (u16, *const W) {
        let row = self.row();
        let column = i64::from(self.column);
        let bits_below = |column: i64| (1u32 << column.clamp(0, 16)) - 1;
        let present = bits_below(column + row.len() as i64) & !bits_below(column);
        (present as u16, row.as_ptr().wrapping_offset(-(self.column as isize)))
    }

    /// Returns the row's weights.
    #[inline(always)]
    pub fn row(&self) -> &'a [W] {
        &self.table[self.from..self.from + self.len]
    }
}

/// A kind of sums that pixel records are made of: its types, and how voxels are added.
pub trait Recorded: Accumulate {
    /// Sums of one sheet at a pixel.
    type Pixel: bytemuck::Pod + Default + PartialEq + std::fmt::Debug;
    /// A weight in depth.
    type Depth: Copy + Default;
    /// Extinction and colours of a voxel.
    type Payload: Copy + Default;
    /// Whether sections that lie aside of each other are added in lanes.
    const SLANTED: bool = false;
    /// Windows begin at a column that is a multiple of it, and have as many: records of `N` sheets
    /// that may share a register.
    fn step<const N: usize>() -> i32 {
        1
    }
    /// The weights of a footprint with tables across an axis.
    fn across<'a>(footprint: &Footprint<'a>, axis: usize) -> Option<&'a [Self::Weight]>;
    /// The weights in depth, [`Sections::most`] a phase.
    fn deep(sections: &Sections) -> &[Self::Depth];
    /// A payload of extinction and colours in raw units.
    fn payload(light: [f32; 4]) -> Self::Payload;
    /// `payload * wz`.
    fn cut(payload: Self::Payload, wz: Self::Depth) -> [Self::Section; 4];
    /// Adds `row * wx`.
    fn add(to: &mut Self::Pixel, row: &[Self::Section; 4], wx: Self::Weight);
    /// Bits of extinction and three colours.
    fn raw(pixel: &Self::Pixel) -> RawSums;
    /// From those.
    fn from_raw(raw: RawSums) -> Self::Pixel;

    /// Adds `voxels` with `payloads`, which all begin at the sheet that `slot` holds: the section
    /// of each in a sheet is `payload * z`, a row `section * y`, what is added to a pixel `row *
    /// x`.
    ///
    /// # Panics
    /// If a footprint leaves the records, or if there are not as many payloads as voxels.
    fn splat_all<const N: usize>(
        simd: Simd,
        records: &mut [Record<Self, N>],
        voxels: (&[Splat], &[Self::Payload]),
        slot: usize,
        tables: &Tables<'_, Self>,
    );

    /// Puts weights of N rows, one a slot, beside each other: the `j`th of a row belongs to column
    /// `j` plus that of its first, wherever that is one of the first `wide`; elsewhere in those
    /// there are zeros. What the columns behind are then is not said.
    ///
    /// # Panics
    /// If there are not as many columns.
    #[inline(always)]
    fn weave<const N: usize>(
        simd: Simd,
        rows: [RowAt<'_, Self::Weight>; N],
        wide: usize,
        to: &mut [BySlot<Self::Weight, N>],
    ) {
        let _ = simd;
        weave(rows, wide, to);
    }

    /// Adds a voxel whose sections have footprints of their own: weights by column, row and slot,
    /// zero in slots that it does not reach.
    ///
    /// # Panics
    /// If a footprint leaves the records.
    #[inline(always)]
    fn splat_deep<const N: usize>(
        simd: Simd,
        records: &mut [Record<Self, N>],
        at: usize,
        across: Across<'_, Self::Weight, N>,
        payload: Self::Payload,
        z: &BySlot<Self::Depth, N>,
    ) {
        let _ = simd;
        splat_deep::<Self, N>(records, at, across, payload, z);
    }

    /// Adds voxels with `payloads` whose sections have footprints of their own, in `woven` if need
    /// be.
    ///
    /// # Panics
    /// If there are not as many payloads as voxels are kept, or if a window leaves the part.
    #[inline(always)]
    fn splat_apart<const N: usize>(
        simd: Simd,
        records: &mut [Record<Self, N>],
        voxels: (&Apart, &[Self::Payload]),
        layers: &Layers<'_, Self, N>,
        woven: &mut Woven<Self::Weight, N>,
    ) {
        sheet_offsets::splat_apart(simd, records, voxels, layers, woven);
    }
}

/// Implements the members that all sums of four channels share.
macro_rules! four_sums {
    () => {
        type Pixel = [Self; 4];

        #[inline(always)]
        fn add(to: &mut [Self; 4], row: &[Self::Section; 4], wx: Self::Weight) {
            for c in 0..4 {
                to[c] = to[c].plus(row[c], wx);
            }
        }

        #[inline(always)]
        fn raw(pixel: &[Self; 4]) -> RawSums {
            pixel.map(Self::bits)
        }

        #[inline(always)]
        fn from_raw(raw: RawSums) -> [Self; 4] {
            raw.map(Self::from_bits)
        }
    };
}

/// 64 bits: extinction in the lowest 16.
impl Recorded for i16 {
    four_sums!();
    const SLANTED: bool = true;
    type Depth = i16;
    type Payload = u64;

    fn step<const N: usize>() -> i32 {
        if N == 4 { 2 } else { 1 }
    }

    fn across<'a>(footprint: &Footprint<'a>, axis: usize) -> Option<&'a [i16]> {
        footprint.all_fixed(axis)
    }

    fn deep(sections: &Sections) -> &[i16] {
        sections.all_fixed()
    }

    #[inline(always)]
    fn payload(light: [f32; 4]) -> u64 {
        let wide = |c: f32| u64::from(whole(c) as u16);
        wide(light[0]) | wide(light[1]) << 16 | wide(light[2]) << 32 | wide(light[3]) << 48
    }

    #[inline(always)]
    fn cut(payload: u64, wz: i16) -> [i16; 4] {
        section_fixed([0, 16, 32, 48].map(|bits| (payload >> bits) as i16), wz)
    }

    #[inline(always)]
    fn splat_all<const N: usize>(
        simd: Simd,
        records: &mut [Record<i16, N>],
        voxels: (&[Splat], &[u64]),
        slot: usize,
        tables: &Tables<'_, i16>,
    ) {
        assert_eq!(voxels.0.len(), voxels.1.len(), "a payload a voxel");
        at_level!(
            simd,
            (records, voxels, slot, tables),
            splat_plain::<i16, N>,
            short::avx2::splat_all::<N>,
            short::avx512::splat_all::<N>,
            neon::splat_all::<i16, N>
        );
    }

    #[inline(always)]
    fn weave<const N: usize>(
        simd: Simd,
        rows: [RowAt<'_, i16>; N],
        wide: usize,
        to: &mut [BySlot<i16, N>],
    ) {
        at_level!(
            simd,
            (rows, wide, to),
            weave,
            short::avx2::weave,
            short::avx512::weave,
            neon::weave::<i16, N>
        );
    }

    #[inline(always)]
    fn splat_deep<const N: usize>(
        simd: Simd,
        records: &mut [Record<i16, N>],
        at: usize,
        across: Across<'_, i16, N>,
        payload: u64,
        z: &BySlot<i16, N>,
    ) {
        at_level!(
            simd,
            (records, at, across, payload, z),
            splat_deep::<i16, N>,
            short::avx2::splat_deep::<N>,
            short::avx512::splat_deep::<N>,
            neon::splat_deep::<i16, N>
        );
    }

    #[inline(always)]
    fn splat_apart<const N: usize>(
        simd: Simd,
        records: &mut [Record<i16, N>],
        voxels: (&Apart, &[u64]),
        layers: &Layers<'_, i16, N>,
        woven: &mut Woven<i16, N>,
    ) {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                short::avx512::splat_apart(simd, records, voxels, layers, woven);
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe {
                short::avx2::splat_apart(simd, records, voxels, layers, woven);
            },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Level::Neon => unsafe {
                neon::splat_apart(simd, records, voxels, layers, woven);
            },
            Level::Plain => sheet_offsets::splat_apart(simd, records, voxels, layers, woven),
        }
    }
}

impl Recorded for i32 {
    four_sums!();
    const SLANTED: bool = true;
    type Depth = f32;
    type Payload = [f32; 4];

    fn across<'a>(footprint: &Footprint<'a>, axis: usize) -> Option<&'a [Tap]> {
        footprint.all(axis)
    }

    fn deep(sections: &Sections) -> &[f32] {
        sections.all()
    }

    #[inline(always)]
    fn payload(light: [f32; 4]) -> [f32; 4] {
        light
    }

    #[inline(always)]
    fn cut(payload: [f32; 4], wz: f32) -> [super::Section; 4] {
        payload.map(|p| super::Section::new(p * wz))
    }

    #[inline(always)]
    fn splat_all<const N: usize>(
        simd: Simd,
        records: &mut [Record<i32, N>],
        voxels: (&[Splat], &[[f32; 4]]),
        slot: usize,
        tables: &Tables<'_, i32>,
    ) {
        assert_eq!(voxels.0.len(), voxels.1.len(), "a payload a voxel");
        at_level!(
            simd,
            (records, voxels, slot, tables),
            splat_plain::<i32, N>,
            long::avx2::splat_all::<4, N>,
            long::avx512::splat_all::<4, N>,
            neon::splat_all::<i32, N>
        );
    }

    #[inline(always)]
    fn splat_apart<const N: usize>(
        simd: Simd,
        records: &mut [Record<i32, N>],
        voxels: (&Apart, &[[f32; 4]]),
        layers: &Layers<'_, i32, N>,
        woven: &mut Woven<Tap, N>,
    ) {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe {
                long::avx512::splat_apart(simd, records, voxels, layers, woven);
            },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe {
                long::avx2::splat_apart(simd, records, voxels, layers, woven);
            },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Level::Neon => unsafe {
                neon::splat_apart(simd, records, voxels, layers, woven);
            },
            Level::Plain => sheet_offsets::splat_apart(simd, records, voxels, layers, woven),
        }
    }

    #[inline(always)]
    fn weave<const N: usize>(
        simd: Simd,
        rows: [RowAt<'_, Tap>; N],
        wide: usize,
        to: &mut [BySlot<Tap, N>],
    ) {
        at_level!(
            simd,
            (rows, wide, to),
            weave,
            long::avx2::weave,
            long::avx512::weave,
            neon::weave::<i32, N>
        );
    }

    #[inline(always)]
    fn splat_deep<const N: usize>(
        simd: Simd,
        records: &mut [Record<i32, N>],
        at: usize,
        across: Across<'_, Tap, N>,
        payload: [f32; 4],
        z: &BySlot<f32, N>,
    ) {
        at_level!(
            simd,
            (records, at, across, payload, z),
            splat_deep::<i32, N>,
            long::avx2::splat_deep::<N>,
            long::avx512::splat_deep::<N>,
            neon::splat_deep::<i32, N>
        );
    }
}

/// Extinction and grey: half the memory, and half the work.
impl Recorded for Grey {
    type Pixel = [i32; 2];
    type Depth = f32;
    type Payload = [f32; 2];

    fn across<'a>(footprint: &Footprint<'a>, axis: usize) -> Option<&'a [Tap]> {
        i32::across(footprint, axis)
    }

    fn deep(sections: &Sections) -> &[f32] {
        sections.all()
    }

    #[inline(always)]
    fn payload([sigma, grey, ..]: [f32; 4]) -> [f32; 2] {
        [sigma, grey]
    }

    #[inline(always)]
    fn cut([sigma, grey]: [f32; 2], wz: f32) -> [Section; 4] {
        i32::cut([sigma, grey, grey, grey], wz)
    }

    #[inline(always)]
    fn add(to: &mut [i32; 2], row: &[Section; 4], wx: Tap) {
        for c in 0..2 {
            to[c] = to[c].plus(row[c], wx);
        }
    }

    #[inline(always)]
    fn raw([sigma, grey]: &[i32; 2]) -> RawSums {
        [*sigma, *grey, *grey, *grey].map(i32::bits)
    }

    #[inline(always)]
    fn from_raw([sigma, grey, ..]: RawSums) -> [i32; 2] {
        [sigma, grey].map(i32::from_bits)
    }

    #[inline(always)]
    fn splat_all<const N: usize>(
        simd: Simd,
        records: &mut [Record<Grey, N>],
        voxels: (&[Splat], &[[f32; 2]]),
        slot: usize,
        tables: &Tables<'_, Grey>,
    ) {
        assert_eq!(voxels.0.len(), voxels.1.len(), "a payload a voxel");
        let Tables { across, deep } = *tables;
        let tables = &Tables::<i32> { across, deep };
        at_level!(
            simd,
            (records, voxels, slot, tables),
            splat_grey,
            long::avx2::splat_all::<2, N>,
            long::avx512::splat_all::<2, N>,
            neon::splat_grey::<N>
        );
    }
}

/// [`splat_plain`] with the tables of the sums that grey ones are bit for bit.
fn splat_grey<const N: usize>(
    records: &mut [Record<Grey, N>],
    voxels: (&[Splat], &[[f32; 2]]),
    slot: usize,
    tables: &Tables<'_, i32>,
) {
    let Tables { across, deep } = *tables;
    splat_plain::<Grey, N>(records, voxels, slot, &Tables { across, deep });
}

/// [`Recorded::splat_all`] plainly.
fn splat_plain<S: Recorded, const N: usize>(
    records: &mut [Record<S, N>],
    (voxels, payloads): (&[Splat], &[S::Payload]),
    slot: usize,
    tables: &Tables<'_, S>,
) {
    for (v, payload) in voxels.iter().zip(payloads) {
        let weights = v.weights(tables);
        splat::<S, N>(records, v.at(), weights, *payload, slot);
    }
}

/// Adds one voxel to the records from `at`, plainly; its first weight in depth belongs to `slot`.
pub(crate) fn splat<S: Recorded, const N: usize>(
    records: &mut [Record<S, N>],
    at: usize,
    (x, y, z): Weights<'_, S>,
    payload: S::Payload,
    slot: usize,
) {
    for (i, &wz) in z.iter().enumerate() {
        let section = S::cut(payload, wz);
        let slot = (slot + i) % N;
        for (j, &wy) in y.iter().enumerate() {
            let row = section.map(|c| S::row(c, wy));
            let from = at + j * STRIDE;
            for (record, &wx) in records[from..from + x.len()].iter_mut().zip(x) {
                S::add(&mut record[slot], &row, wx);
            }
        }
    }
}

/// [`Recorded::weave`] plainly.
#[inline(always)]
fn weave<W: Copy + Default, const N: usize>(
    rows: [RowAt<'_, W>; N],
    wide: usize,
    to: &mut [BySlot<W, N>],
) {
    let to = &mut to[..wide];
    to.fill([W::default(); N]);
    for (slot, at) in rows.into_iter().enumerate() {
        let (row, column) = (at.row(), at.column);
        let begin = column.clamp(0, to.len() as i32) as usize;
        let skip = (-column).clamp(0, row.len() as i32) as usize;
        for (to, w) in to[begin..].iter_mut().zip(&row[skip..]) {
            to[slot] = *w;
        }
    }
}

/// [`Recorded::splat_deep`] plainly.
#[inline(always)]
fn splat_deep<S: Recorded, const N: usize>(
    records: &mut [Record<S, N>],
    at: usize,
    (x, y): Across<'_, S::Weight, N>,
    payload: S::Payload,
    z: &BySlot<S::Depth, N>,
) {
    let sections = z.map(|wz| S::cut(payload, wz));
    for (j, wy) in y.iter().enumerate() {
        let from = at + j * STRIDE;
        for (record, wx) in records[from..from + x.len()].iter_mut().zip(x) {
            for slot in 0..N {
                let row = sections[slot].map(|c| S::row(c, wy[slot]));
                S::add(&mut record[slot], &row, wx[slot]);
            }
        }
    }
}
