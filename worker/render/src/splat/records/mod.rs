//! Sums of eight sheets of a pixel beside each other: a voxel adds all its sections at once.
//!
//! For flat views (orthographic, footprints in a table), where a voxel's sections share one
//! footprint. A record of 16-bit sums is 64 bytes: one AVX-512 operation a pixel or two of AVX2
//! ([`short`]); one of 32-bit sums twice that ([`long`]). Every loop is written plainly here; what
//! is written in lanes there must equal it.

mod long;
mod short;

use super::{Accumulate, Level, Simd, Tap, section_fixed, whole};
use crate::footprint::{Footprint, Sections};
use crate::sheet::{LANES, Row};

/// Sheets of a record.
pub(crate) const SLOTS: usize = 8;

/// Records from a row of a part to the next: one more than a part has columns. Rows of 64 records
/// would lie 4096 bytes apart, where a footprint's rows fall into one set of the cache and loads
/// wait for stores of the row before, which they are mistaken for.
pub(crate) const STRIDE: usize = 65;

/// The sums of eight sheets at one pixel: extinction and three colours each.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub(crate) struct Record<S>(pub(crate) [[S; 4]; SLOTS]);

/// Weights along one axis: wherever a row begins, `len` of them are one's.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Table<'a, W> {
    pub(crate) weights: &'a [W],
    pub(crate) len: usize,
}

impl<'a, W> Table<'a, W> {
    /// The weights from `from`.
    #[inline(always)]
    pub(crate) fn row(&self, from: usize) -> &'a [W] {
        &self.weights[from..from + self.len]
    }
}

/// The tables of a view.
#[derive(Clone, Copy)]
pub(crate) struct Tables<'a, S: Recorded> {
    /// Across and down.
    pub(crate) across: [Table<'a, S::Weight>; 2],
    /// In depth.
    pub(crate) deep: Table<'a, S::Depth>,
}

/// A voxel whose footprint, moved if need be, lies inside the part.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(16))]
pub(crate) struct Splat {
    /// First column and row of its footprint, and the pixel of the part that is nearest to its
    /// centre: 64 times the row, and the column.
    pub(crate) first: [u8; 2],
    pub(crate) cell: u16,
    /// Where its weights across begin.
    pub(crate) rows: [u16; 2],
    /// Depth in phases from its sheet's front.
    pub(crate) z: u16,
    pub(crate) normal: u16,
    /// Its sample's bits.
    pub(crate) sample: u32,
}

/// A voxel's weights across, down and in depth.
type Weights<'a, S> = (
    &'a [<S as Accumulate>::Weight],
    &'a [<S as Accumulate>::Weight],
    &'a [<S as Recorded>::Depth],
);

impl Splat {
    /// Record of its first row and column.
    #[inline(always)]
    pub(crate) fn at(&self) -> usize {
        usize::from(self.first[1]) * STRIDE + usize::from(self.first[0])
    }

    /// Its weights.
    #[inline(always)]
    pub(crate) fn weights<'a, S: Recorded>(&self, tables: &Tables<'a, S>) -> Weights<'a, S> {
        let [x, y] = &tables.across;
        let z = usize::from(self.z) * tables.deep.len;
        (x.row(usize::from(self.rows[0])), y.row(usize::from(self.rows[1])), tables.deep.row(z))
    }
}

/// Eight pixels of a row in the part.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Strip {
    /// First record.
    pub(crate) record: usize,
    /// First pixel, where rows have no pixel more than columns.
    pub(crate) pixel: usize,
}

/// Pixels of a strip.
pub(crate) const STRIP: usize = 8;

/// A weight for each slot.
pub(crate) type BySlot<W> = [W; SLOTS];

/// Weights by column and slot, and by row and slot.
pub(crate) type Across<'a, W> = (&'a [BySlot<W>], &'a [BySlot<W>]);

/// Calls the one of three functions that belongs to the level of `simd`.
macro_rules! at_level {
    ($simd:expr, $args:tt, $plain:path, $avx2:path, $avx512:path) => {
        match $simd.0 {
            Level::Plain => $plain $args,
            // SAFETY: the value proves that the instructions are there; AVX-512 has AVX2 in it.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { $avx2 $args },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { $avx512 $args },
        }
    };
}

/// Sums that records are made of.
pub(crate) trait Recorded: Accumulate {
    /// A weight in depth.
    type Depth: Copy + Default;
    /// Extinction and colours of a voxel.
    type Payload: Copy + Default;

    /// The weights of a footprint with tables across an axis.
    fn across<'a>(footprint: &Footprint<'a>, axis: usize) -> Option<&'a [Self::Weight]>;
    /// The weights in depth, [`Sections::most`] a phase.
    fn deep(sections: &Sections) -> &[Self::Depth];
    /// A payload of extinction and colours in raw units.
    fn payload(light: [f32; 4]) -> Self::Payload;
    /// `payload * wz`.
    fn cut(payload: Self::Payload, wz: Self::Depth) -> [Self::Section; 4];

    /// Adds `voxels` with `payloads`, which all begin at the sheet that `slot` holds: the section of
    /// each in a sheet is `payload * z`, a row `section * y`, what is added to a pixel `row * x`.
    ///
    /// # Panics
    /// If a footprint leaves the records, or if there are not as many payloads as voxels.
    fn splat_all(
        simd: Simd,
        records: &mut [Record<Self>],
        voxels: (&[Splat], &[Self::Payload]),
        slot: usize,
        tables: &Tables<'_, Self>,
    );

    /// Adds a voxel whose sections have footprints of their own: weights by column, row and slot,
    /// zero in slots that it does not reach.
    ///
    /// # Panics
    /// If a footprint leaves the records.
    #[inline(always)]
    fn splat_deep(
        simd: Simd,
        records: &mut [Record<Self>],
        at: usize,
        across: Across<'_, Self::Weight>,
        payload: Self::Payload,
        z: &BySlot<Self::Depth>,
    ) {
        let _ = simd;
        splat_deep(records, at, across, payload, z);
    }

    /// Takes the sums of sheet k, which `slot` holds, of two strips for a row that is to be closed:
    /// those of the sheet before (out of `before`), of the sheet itself, and of the one behind, and
    /// the opacity so far, `a`. Leaves those of sheet k in `before` and nothing in the slot.
    ///
    /// # Panics
    /// If a strip leaves the part.
    fn take(
        simd: Simd,
        sums: (&mut [Record<Self>], &mut [[Self; 4]]),
        a: &[f32],
        strips: [Strip; 2],
        slot: usize,
        row: &mut Row,
    );
}

/// 64 bits: extinction in the lowest 16.
impl Recorded for i16 {
    type Depth = i16;
    type Payload = u64;

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
    fn splat_all(
        simd: Simd,
        records: &mut [Record<i16>],
        voxels: (&[Splat], &[u64]),
        slot: usize,
        tables: &Tables<'_, i16>,
    ) {
        assert_eq!(voxels.0.len(), voxels.1.len(), "a payload a voxel");
        at_level!(
            simd,
            (records, voxels, slot, tables),
            splat_plain,
            short::avx2::splat_all,
            short::avx512::splat_all
        );
    }

    #[inline(always)]
    fn splat_deep(
        simd: Simd,
        records: &mut [Record<i16>],
        at: usize,
        across: Across<'_, i16>,
        payload: u64,
        z: &BySlot<i16>,
    ) {
        at_level!(
            simd,
            (records, at, across, payload, z),
            splat_deep,
            short::avx2::splat_deep,
            short::avx512::splat_deep
        );
    }

    #[inline(always)]
    fn take(
        simd: Simd,
        sums: (&mut [Record<i16>], &mut [[i16; 4]]),
        a: &[f32],
        strips: [Strip; 2],
        slot: usize,
        row: &mut Row,
    ) {
        at_level!(
            simd,
            (sums, a, strips, slot, row),
            take_plain,
            short::avx2::take,
            short::avx512::take
        );
    }
}

impl Recorded for i32 {
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
    fn splat_all(
        simd: Simd,
        records: &mut [Record<i32>],
        voxels: (&[Splat], &[[f32; 4]]),
        slot: usize,
        tables: &Tables<'_, i32>,
    ) {
        assert_eq!(voxels.0.len(), voxels.1.len(), "a payload a voxel");
        at_level!(
            simd,
            (records, voxels, slot, tables),
            splat_plain,
            long::avx2::splat_all,
            long::avx512::splat_all
        );
    }

    #[inline(always)]
    fn take(
        simd: Simd,
        sums: (&mut [Record<i32>], &mut [[i32; 4]]),
        a: &[f32],
        strips: [Strip; 2],
        slot: usize,
        row: &mut Row,
    ) {
        at_level!(
            simd,
            (sums, a, strips, slot, row),
            take_plain,
            long::avx2::take,
            long::avx2::take
        );
    }
}

/// [`Recorded::splat_all`] plainly.
fn splat_plain<S: Recorded>(
    records: &mut [Record<S>],
    (voxels, payloads): (&[Splat], &[S::Payload]),
    slot: usize,
    tables: &Tables<'_, S>,
) {
    for (v, payload) in voxels.iter().zip(payloads) {
        let weights = v.weights(tables);
        splat(records, v.at(), weights, *payload, slot);
    }
}

/// Adds one voxel to the records from `at`, plainly; its first weight in depth belongs to `slot`.
pub(crate) fn splat<S: Recorded>(
    records: &mut [Record<S>],
    at: usize,
    (x, y, z): Weights<'_, S>,
    payload: S::Payload,
    slot: usize,
) {
    for (i, &wz) in z.iter().enumerate() {
        let section = S::cut(payload, wz);
        let slot = (slot + i) % SLOTS;
        for (j, &wy) in y.iter().enumerate() {
            let row = section.map(|c| S::row(c, wy));
            let from = at + j * STRIDE;
            for (record, &wx) in records[from..from + x.len()].iter_mut().zip(x) {
                for c in 0..4 {
                    record.0[slot][c] = record.0[slot][c].plus(row[c], wx);
                }
            }
        }
    }
}

/// [`Recorded::splat_deep`] plainly.
#[inline(always)]
fn splat_deep<S: Recorded>(
    records: &mut [Record<S>],
    at: usize,
    (x, y): Across<'_, S::Weight>,
    payload: S::Payload,
    z: &BySlot<S::Depth>,
) {
    let sections = z.map(|wz| S::cut(payload, wz));
    for (j, wy) in y.iter().enumerate() {
        let from = at + j * STRIDE;
        for (record, wx) in records[from..from + x.len()].iter_mut().zip(x) {
            for slot in 0..SLOTS {
                for c in 0..4 {
                    let row = S::row(sections[slot][c], wy[slot]);
                    record.0[slot][c] = record.0[slot][c].plus(row, wx[slot]);
                }
            }
        }
    }
}

/// [`Recorded::take`] plainly.
fn take_plain<S: Recorded>(
    (records, before): (&mut [Record<S>], &mut [[S; 4]]),
    a: &[f32],
    strips: [Strip; 2],
    slot: usize,
    row: &mut Row,
) {
    const { assert!(LANES == 2 * STRIP) };
    // A strip may stand there twice, where there is none to pair it with.
    let was = strips.map(|s| std::array::from_fn::<_, STRIP, _>(|i| before[s.pixel + i]));
    let here = strips.map(|s| std::array::from_fn::<_, STRIP, _>(|i| records[s.record + i].0));
    for (half, strip) in strips.iter().enumerate() {
        for i in 0..STRIP {
            let sheets = [was[half][i], here[half][i][slot], here[half][i][(slot + 1) % SLOTS]];
            let to = [&mut row.before, &mut row.here, &mut row.behind];
            for (to, sums) in to.into_iter().zip(sheets) {
                for c in 0..4 {
                    to[c][half * STRIP + i] = sums[c].value();
                }
            }
            row.a[half * STRIP + i] = a[strip.pixel + i];
            before[strip.pixel + i] = here[half][i][slot];
            records[strip.record + i].0[slot] = [S::default(); 4];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Nine voxels with odd weights, by every instruction set.
    fn splat_everywhere<S: Recorded + std::fmt::Debug>(
        across: usize,
        deep: usize,
        w: [&[S::Weight]; 2],
        z: &[S::Depth],
    ) {
        let high = 1 + across % 7;
        let tables: Tables<'_, S> = Tables {
            across: [Table { weights: w[0], len: across }, Table { weights: w[1], len: high }],
            deep: Table { weights: z, len: deep },
        };
        let voxels: Vec<Splat> = (0..9u16)
            .map(|i| Splat {
                first: [3 + i as u8, i as u8],
                rows: [i % 4, i / 2 % 4],
                z: i / 3 % 4,
                ..Splat::default()
            })
            .collect();
        let light = |i: usize| [31_000.0 - 700.0 * i as f32, 17_003.4, 77.7, i as f32];
        let payloads: Vec<S::Payload> = (0..9).map(|i| S::payload(light(i))).collect();
        let run = |simd| {
            let mut records = vec![Record([[S::from_bits(11); 4]; SLOTS]); STRIDE * 24];
            S::splat_all(simd, &mut records, (&voxels, &payloads), deep * 3 % SLOTS, &tables);
            records
        };
        let want = run(Simd::plain());
        assert!(want.iter().any(|r| r.0 != [[S::from_bits(11); 4]; SLOTS]));
        for simd in Simd::all() {
            assert!(run(simd) == want, "{} differs at {across}, {deep}", simd.name());
        }
    }

    #[test]
    fn every_instruction_set_adds_what_the_plain_loop_adds() {
        let fixed = |n: usize| (0..n).map(|i| (i * 7919 % 23_000) as i16).collect::<Vec<_>>();
        for across in 1..20 {
            for deep in 1..=SLOTS {
                let [x, y, z] = [across, 1 + across % 7, deep].map(|n| fixed(4 * n));
                splat_everywhere::<i16>(across, deep, [&x, &y], &z);
                let real = |w: &[i16]| w.iter().map(|&w| f32::from(w) * 7.1e-5).collect::<Vec<_>>();
                let taps = |w: &[i16]| real(w).into_iter().map(Tap::new).collect::<Vec<_>>();
                splat_everywhere::<i32>(across, deep, [&taps(&x), &taps(&y)], &real(&z));
            }
        }
    }

    #[test]
    fn sections_with_footprints_of_their_own_are_added_as_the_plain_loop_adds_them() {
        let by_slot = |i: usize| -> BySlot<i16> {
            std::array::from_fn(|slot| ((i * 7919 + slot * 3001) % 23_000) as i16)
        };
        for (columns, rows) in [(1, 1), (5, 3), (8, 8), (9, 7), (17, 12)] {
            let x: Vec<_> = (0..columns).map(by_slot).collect();
            let y: Vec<_> = (0..rows).map(|i| by_slot(i + 5)).collect();
            let payload = i16::payload([31_000.0, 17_003.4, 77.7, 3.0]);
            let run = |simd| {
                let mut records = vec![Record([[11; 4]; SLOTS]); STRIDE * 24];
                i16::splat_deep(simd, &mut records, 7, (&x, &y), payload, &by_slot(3));
                records
            };
            let want = run(Simd::plain());
            assert!(want[7].0 != [[11; 4]; SLOTS]);
            for simd in Simd::all() {
                assert!(run(simd) == want, "{} differs at {columns}x{rows}", simd.name());
            }
        }
    }

    /// Two strips, taken by every instruction set.
    fn take_everywhere<S: Recorded>(
        strips: [usize; 2],
        slot: usize,
        mut next: impl FnMut() -> S,
    ) -> Result<(), TestCaseError> {
        let mut sums = || [(); 4].map(|()| next());
        let records: Vec<Record<S>> =
            (0..48).map(|_| Record([(); SLOTS].map(|()| sums()))).collect();
        let before: Vec<[S; 4]> = (0..48).map(|_| sums()).collect();
        let opacity: Vec<f32> = (0..48).map(|i| i as f32).collect();
        let [a, b] = strips;
        let strips = strips.map(|at| Strip { record: at, pixel: at });
        let run = |simd| {
            let (mut records, mut before) = (records.clone(), before.clone());
            let mut row = Row::default();
            S::take(simd, (&mut records, &mut before), &opacity, strips, slot, &mut row);
            (records, before, row.before, row.here, row.behind, row.a)
        };
        let want = run(Simd::plain());
        prop_assert_eq!(want.3[1][0], records[a].0[slot][1].value());
        prop_assert_eq!(want.4[2][9], records[b + 1].0[(slot + 1) % SLOTS][2].value());
        prop_assert_eq!(want.2[3][7], before[a + 7][3].value());
        prop_assert_eq!(want.5[10], (b + 2) as f32);
        for simd in Simd::all() {
            prop_assert!(run(simd) == want, "{}", simd.name());
        }
        Ok(())
    }

    proptest! {
        #[test]
        fn strips_are_taken_as_the_plain_loop_takes_them(
            seed in any::<u32>(), slot in 0..SLOTS, a in 0..40usize, b in 0..40usize,
        ) {
            let mut state = u64::from(seed) | 1 << 40;
            let mut next = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(99);
                (state >> 32) as i32
            };
            // Apart, or the same strip twice.
            prop_assume!(a == b || a.abs_diff(b) >= STRIP);
            take_everywhere::<i16>([a, b], slot, || next() as i16)?;
            take_everywhere::<i32>([a, b], slot, &mut next)?;
        }
    }
}
