//! Pixel records: the sums of several sheets of a pixel side by side, so that a voxel adds all its
//! sections at once.
//!
//! A record has N sheets, at least as many as a voxel has sections, which for sheets of a vox are
//! four. Four sheets of 16-bit sums are 32 bytes, one register of AVX2; 32-bit sums take twice
//! that. Compilers do not make vector instructions of the plain loop: with AVX-512 it took eight
//! times as long as the loops in `wide`, which must equal it.

use super::{Accumulate, Level, Simd, Tap, section_fixed, whole};
use crate::primitives::footprint::{Footprint, Sections};
pub use crate::primitives::sizes::MOST;

/// Records from a row of a part to the next: two more than a part has columns. Rows of 64 records
/// would lie 2048 or 4096 bytes apart, where a footprint's rows fall into few sets of the cache and
/// loads wait for stores of the row before, which they are mistaken for.
pub const STRIDE: usize = 66;

/// Sums of N sheets at one pixel: extinction and three colours each, or a field's channels.
pub type Record<S, const N: usize> = [[S; 4]; N];

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
    fn row(&self, from: usize) -> &'a [W] {
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
    /// Indices at which the weights across (low 16 bits) and down (high 16 bits) begin.
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
    fn weights<'a, S: Recorded>(&self, tables: &Tables<'a, S>) -> Weights<'a, S> {
        let [x, y] = &tables.across;
        let z = self.phase() as usize * tables.deep.len;
        let rows = [self.rows & 0xffff, self.rows >> 16].map(|row| row as usize);
        (x.row(rows[0]), y.row(rows[1]), tables.deep.row(z))
    }
}

/// A kind of sums that pixel records are made of: whole numbers.
pub trait Recorded: Accumulate + bytemuck::Pod {
    /// A weight in depth.
    type Depth: Copy + Default;
    /// One channel of a payload.
    type Payload: Copy + Default;
    /// The weights of a footprint with tables across an axis.
    fn across<'a>(footprint: &Footprint<'a>, axis: usize) -> Option<&'a [Self::Weight]>;
    /// The weights in depth, [`Sections::most`] a phase.
    fn deep(sections: &Sections) -> &[Self::Depth];
    /// A payload of extinction and colours in raw units.
    fn payload(light: [f32; 4]) -> [Self::Payload; 4];
    /// `payload * wz`.
    fn cut(payload: [Self::Payload; 4], wz: Self::Depth) -> [Self::Section; 4];
    /// Adds `((payload * z) * y) * x` to the records of a footprint's rows: weights across, down,
    /// and in depth by slot.
    ///
    /// # Panics
    /// If the footprint leaves the records.
    fn add<const N: usize>(
        simd: Simd,
        records: &mut [Record<Self, N>],
        weights: Across<'_, Self, N>,
        payload: [Self::Payload; 4],
    );
}

/// Weights of a footprint across and down, and in depth by slot.
type Across<'a, S, const N: usize> = (
    &'a [<S as Accumulate>::Weight],
    &'a [<S as Accumulate>::Weight],
    &'a [<S as Recorded>::Depth; N],
);

impl Recorded for i16 {
    type Depth = i16;
    type Payload = i16;

    fn across<'a>(footprint: &Footprint<'a>, axis: usize) -> Option<&'a [i16]> {
        footprint.all_fixed(axis)
    }

    fn deep(sections: &Sections) -> &[i16] {
        sections.all_fixed()
    }

    #[inline(always)]
    fn payload(light: [f32; 4]) -> [i16; 4] {
        let [a, r, g, b] = light;
        [whole(a), whole(r), whole(g), whole(b)]
    }

    #[inline(always)]
    fn cut(payload: [i16; 4], wz: i16) -> [i16; 4] {
        section_fixed(payload, wz)
    }

    #[inline(always)]
    fn add<const N: usize>(
        simd: Simd,
        records: &mut [Record<Self, N>],
        weights: Across<'_, Self, N>,
        payload: [Self::Payload; 4],
    ) {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there (`Simd::all`); AVX-512
            // includes AVX2.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 | Level::Avx512 => unsafe { wide::shorts(records, weights, payload) },
            _ => add(records, weights, payload),
        }
    }
}

impl Recorded for i32 {
    type Depth = f32;
    type Payload = f32;

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
    fn cut([a, r, g, b]: [f32; 4], wz: f32) -> [super::Section; 4] {
        let section = super::Section::new;
        [section(a * wz), section(r * wz), section(g * wz), section(b * wz)]
    }

    #[inline(always)]
    fn add<const N: usize>(
        simd: Simd,
        records: &mut [Record<Self, N>],
        weights: Across<'_, Self, N>,
        payload: [Self::Payload; 4],
    ) {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there (`Simd::all`).
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { wide::wide_longs(records, weights, payload) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { wide::longs(records, weights, payload) },
            _ => add(records, weights, payload),
        }
    }
}

/// Adds `voxel` with a payload to the records of a part. It begins at the sheet that `slot` holds;
/// `gone` of its sheets lie before that. The section in a sheet is `payload * z`, a row `section *
/// y`, what is added to a pixel `row * x`.
///
/// # Panics
/// If the footprint leaves the records.
#[inline(always)]
pub fn splat<S: Recorded, const N: usize>(
    simd: Simd,
    records: &mut [Record<S, N>],
    (voxel, payload, gone): (&Splat, [S::Payload; 4], usize),
    slot: usize,
    tables: &Tables<'_, S>,
) {
    let (x, y, z) = voxel.weights(tables);
    let mut by_slot = [S::Depth::default(); N];
    for (i, &wz) in z.iter().enumerate().skip(gone) {
        by_slot[(slot + i - gone) % N] = wz;
    }
    S::add(simd, &mut records[voxel.at()..], (x, y, &by_slot), payload);
}

/// [`Recorded::add`] plainly.
#[inline(always)]
fn add<S: Recorded, const N: usize>(
    records: &mut [Record<S, N>],
    (x, y, z): Across<'_, S, N>,
    payload: [S::Payload; 4],
) {
    for (slot, &wz) in z.iter().enumerate() {
        let section = S::cut(payload, wz);
        for (row, &wy) in records.chunks_mut(STRIDE).zip(y) {
            for (record, &wx) in row[..x.len()].iter_mut().zip(x) {
                for c in 0..4 {
                    record[slot][c] = record[slot][c].plus(S::row(section[c], wy), wx);
                }
            }
        }
    }
}

/// Additions in registers, which compilers do not make of the plain loops.
#[cfg(target_arch = "x86_64")]
mod wide {
    use super::{Across, MOST, Record, Recorded, STRIDE};
    use crate::kernels::Tap;
    use std::arch::x86_64::*;

    /// Terms of some sheets in a register. No function may be called on a machine that lacks its
    /// instructions.
    pub(super) trait Register {
        type Sum: Recorded;
        type Terms: Copy;
        /// Sheets of a register.
        const SHEETS: usize;
        /// `payload * wz` with the weights of as many sheets from `wz` on.
        unsafe fn sections(
            payload: *const [<Self::Sum as Recorded>::Payload; 4],
            wz: *const <Self::Sum as Recorded>::Depth,
        ) -> Self::Terms;
        unsafe fn all(weight: <Self::Sum as super::Accumulate>::Weight) -> Self::Terms;
        unsafe fn times(a: Self::Terms, b: Self::Terms) -> Self::Terms;
        unsafe fn add(sums: *mut [Self::Sum; 4], terms: Self::Terms);
    }

    pub(super) struct Shorts;
    impl Register for Shorts {
        type Sum = i16;
        type Terms = __m256i;
        const SHEETS: usize = 4;
        with! { "avx2"
            fn sections(payload: *const [i16; 4], wz: *const i16) -> __m256i {
                // Bytes of each weight for its sheet's four channels.
                let each = _mm256_setr_epi8(
                    0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3,
                    4, 5, 4, 5, 4, 5, 4, 5, 6, 7, 6, 7, 6, 7, 6, 7,
                );
                // SAFETY: the caller has four channels and four weights there, 8 bytes each.
                let (payload, wz) =
                    unsafe { (_mm_loadl_epi64(payload.cast()), _mm_loadl_epi64(wz.cast())) };
                let wz = _mm256_shuffle_epi8(_mm256_broadcastsi128_si256(wz), each);
                _mm256_mulhrs_epi16(_mm256_broadcastq_epi64(payload), wz)
            }
            fn all(weight: i16) -> __m256i { _mm256_set1_epi16(weight) }
            fn times(a: __m256i, b: __m256i) -> __m256i { _mm256_mulhrs_epi16(a, b) }
            fn add(sums: *mut [i16; 4], terms: __m256i) {
                // SAFETY: the caller has four sheets there, 32 bytes, for itself alone.
                unsafe {
                    let new = _mm256_adds_epi16(_mm256_loadu_si256(sums.cast()), terms);
                    _mm256_storeu_si256(sums.cast(), new);
                }
            }
        }
    }

    pub(super) struct Longs;
    impl Register for Longs {
        type Sum = i32;
        type Terms = __m256;
        const SHEETS: usize = 2;
        with! { "avx2"
            fn sections(payload: *const [f32; 4], wz: *const f32) -> __m256 {
                // SAFETY: the caller has four channels and two weights there.
                let (payload, wz) =
                    unsafe { (_mm_loadu_ps(payload.cast()), _mm256_set_m128(_mm_set1_ps(*wz.add(1)), _mm_set1_ps(*wz))) };
                // No section is negative or NaN, as in `Section::new`.
                _mm256_max_ps(_mm256_mul_ps(_mm256_set_m128(payload, payload), wz), _mm256_setzero_ps())
            }
            fn all(weight: Tap) -> __m256 { _mm256_set1_ps(weight.get()) }
            fn times(a: __m256, b: __m256) -> __m256 { _mm256_mul_ps(a, b) }
            fn add(sums: *mut [i32; 4], terms: __m256) {
                // SAFETY: the caller has two sheets there, 32 bytes, for itself alone.
                unsafe {
                    let old = _mm256_loadu_si256(sums.cast());
                    let new = _mm256_add_epi32(old, _mm256_cvtps_epi32(terms));
                    _mm256_storeu_si256(sums.cast(), new);
                }
            }
        }
    }

    pub(super) struct WideLongs;
    impl Register for WideLongs {
        type Sum = i32;
        type Terms = __m512;
        const SHEETS: usize = 4;
        with! { "avx512f,avx512vl,avx512dq,avx512bw"
            fn sections(payload: *const [f32; 4], wz: *const f32) -> __m512 {
                let each = _mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
                // SAFETY: the caller has four channels and four weights there, 16 bytes each.
                let (payload, wz) = unsafe { (_mm_loadu_ps(payload.cast()), _mm_loadu_ps(wz)) };
                let wz = _mm512_permutexvar_ps(each, _mm512_castps128_ps512(wz));
                // No section is negative or NaN, as in `Section::new`.
                _mm512_max_ps(_mm512_mul_ps(_mm512_broadcast_f32x4(payload), wz), _mm512_setzero_ps())
            }
            fn all(weight: Tap) -> __m512 { _mm512_set1_ps(weight.get()) }
            fn times(a: __m512, b: __m512) -> __m512 { _mm512_mul_ps(a, b) }
            fn add(sums: *mut [i32; 4], terms: __m512) {
                // SAFETY: the caller has four sheets there, 64 bytes, for itself alone.
                unsafe {
                    let old = _mm512_loadu_si512(sums.cast());
                    let new = _mm512_add_epi32(old, _mm512_cvtps_epi32(terms));
                    _mm512_storeu_si512(sums.cast(), new);
                }
            }
        }
    }

    /// Compiles [`Recorded::add`] for some registers.
    macro_rules! compiled {
        ($name:ident, $features:literal, $register:ty, $sum:ty) => {
            #[target_feature(enable = $features)]
            #[inline]
            pub(super) fn $name<const N: usize>(
                records: &mut [Record<$sum, N>],
                weights: Across<'_, $sum, N>,
                payload: [<$sum as Recorded>::Payload; 4],
            ) {
                // SAFETY: this function is compiled for the instructions that the registers need.
                unsafe {
                    match weights.0.len() {
                        4 => add::<$register, 4, N>(records, weights, payload),
                        5 => add::<$register, 5, N>(records, weights, payload),
                        6 => add::<$register, 6, N>(records, weights, payload),
                        7 => add::<$register, 7, N>(records, weights, payload),
                        8 => add::<$register, 8, N>(records, weights, payload),
                        9 => add::<$register, 9, N>(records, weights, payload),
                        _ => add::<$register, 0, N>(records, weights, payload),
                    }
                }
            }
        };
    }

    compiled!(shorts, "avx2", Shorts, i16);
    compiled!(longs, "avx2", Longs, i32);
    compiled!(wide_longs, "avx512f,avx512vl,avx512dq,avx512bw", WideLongs, i32);

    /// Footprints of `WIDE` columns, whose weights stay in registers, or of any number where that
    /// is 0.
    ///
    /// # Safety
    /// The caller is compiled for the instructions of `R`.
    #[inline(always)]
    unsafe fn add<R: Register, const WIDE: usize, const N: usize>(
        records: &mut [Record<R::Sum, N>],
        (x, y, z): Across<'_, R::Sum, N>,
        payload: [<R::Sum as Recorded>::Payload; 4],
    ) {
        const { assert!(N.is_multiple_of(R::SHEETS) && N <= MOST && R::SHEETS >= 2) };
        let wide = if WIDE == 0 { x.len() } else { WIDE };
        let x = &x[..wide];
        // SAFETY: the instructions are the caller's. Pointers are into arrays of N sheets or N
        // weights, of which each register takes as many as it holds.
        unsafe {
            let mut sections = [R::sections(&raw const payload, z.as_ptr()); MOST / 2];
            for part in 1..N / R::SHEETS {
                let z = z.as_ptr().add(part * R::SHEETS);
                sections[part] = R::sections(&raw const payload, z);
            }
            let mut across = [sections[0]; WIDE];
            for column in 0..WIDE {
                across[column] = R::all(x[column]);
            }
            for (row, &wy) in records.chunks_mut(STRIDE).zip(y) {
                let mut of_row = sections;
                for part in 0..N / R::SHEETS {
                    of_row[part] = R::times(sections[part], R::all(wy));
                }
                let row = &mut row[..wide];
                for column in 0..wide {
                    let wx = if WIDE == 0 { R::all(x[column]) } else { across[column] };
                    let at = row[column].as_mut_ptr();
                    for part in 0..N / R::SHEETS {
                        R::add(at.add(part * R::SHEETS), R::times(of_row[part], wx));
                    }
                }
            }
        }
    }
}
