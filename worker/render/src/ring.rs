//! The open sheets of a tile part: the one before k, k itself, and as many behind as a voxel has
//! sections.
//!
//! Two ways to keep them. [`Planes`] holds sheet after sheet, for sums of any kind and any number
//! of sheets. [`Records`] holds the sums of eight sheets of a pixel beside each other, 64 bytes in
//! all, for 16-bit sums: where a voxel's sections share one footprint (orthographic views), they
//! are all added at once, two AVX2 operations a pixel instead of five walks over five planes.

use crate::footprint::Sections;
use crate::sheet::{LANES, Row, Sum};
use crate::splat::{Accumulate, Pixels, Record, Simd, load_records, splat, splat_record, whole};
use slabcast_common::image::RawSums;

/// Pixels of a part's row, and rows of a part.
pub(crate) const PART: usize = 64;
/// Edge of the blocks by which a sheet's touched pixels are known.
pub(crate) const BLOCK: usize = LANES;

/// A voxel's footprint, inside the part: first column and weights, first row and weights.
pub(crate) type Window<'a, W> = ((usize, &'a [W]), (usize, &'a [W]));

/// Which blocks a window touches, one bit each.
#[inline(always)]
fn blocks<W>(((x0, wx), (y0, wy)): Window<'_, W>) -> u64 {
    let (bx0, bx1) = (x0 / BLOCK, (x0 + wx.len() - 1) / BLOCK);
    let row = (u64::MAX >> (63 - (bx1 - bx0))) << bx0;
    (y0 / BLOCK..=(y0 + wy.len() - 1) / BLOCK).fold(0, |all, by| all | row << (8 * by))
}

/// The pixel that each row of block `b` begins with.
#[inline(always)]
fn block_rows(b: usize) -> impl Iterator<Item = usize> {
    let at = (b / 8 * BLOCK) * PART + b % 8 * BLOCK;
    (0..BLOCK).map(move |y| at + y * PART)
}

/// Touched blocks of each slot of a ring.
#[derive(Debug, Default)]
struct Touched {
    masks: Vec<u64>,
    slots: i32,
}

impl Touched {
    #[inline(always)]
    fn slot(&self, k: i32) -> usize {
        k.rem_euclid(self.slots) as usize
    }
}

/// Open sheets. Sheets are named by their number; a part's pixels by `row * PART + column`.
pub(crate) trait Ring {
    /// What sheets add.
    type Sum: Accumulate;

    /// Empties all sheets and makes room for `slots`.
    fn reset(&mut self, slots: usize, simd: Simd);
    /// Puts sums of a sheet that was left open by the slab before.
    fn put(&mut self, k: i32, pixel: usize, sums: RawSums);
    /// Sums as they travel.
    fn raw(&self, k: i32, pixel: usize) -> RawSums;
    /// Blocks that something was added to.
    fn touched(&self, k: i32) -> u64;
    /// Empties the touched blocks of sheet `k`.
    fn clear(&mut self, k: i32);
    /// Adds one section of a voxel to sheet `k`.
    fn add(
        &mut self,
        k: i32,
        window: Window<'_, <Self::Sum as Accumulate>::Weight>,
        section: [<Self::Sum as Accumulate>::Section; 4],
    );
    /// Adds a voxel's sections in `sheets` where all share one footprint. `z`: its depth.
    fn add_all(
        &mut self,
        sections: &Sections,
        z: i32,
        sheets: std::ops::Range<i32>,
        window: Window<'_, <Self::Sum as Accumulate>::Weight>,
        payload: &[f32; 4],
    );
    /// The sums of [`LANES`] pixels from `pixel` in sheets k-1, k and k+1.
    fn load(&self, k: i32, pixel: usize, row: &mut Row);
}

/// Sheet after sheet.
#[derive(Default)]
pub(crate) struct Planes<S> {
    sheets: Vec<Vec<[S; 4]>>,
    touched: Touched,
}

impl<S: Accumulate> Ring for Planes<S> {
    type Sum = S;

    fn reset(&mut self, slots: usize, _: Simd) {
        if self.sheets.len() < slots {
            self.sheets.resize_with(slots, || vec![[S::default(); 4]; PART * PART]);
            self.touched.masks.resize(slots, 0);
        }
        self.touched.slots = self.sheets.len() as i32;
        for k in 0..self.touched.slots {
            self.clear(k);
        }
        self.touched.slots = slots as i32;
    }

    fn put(&mut self, k: i32, pixel: usize, sums: RawSums) {
        let slot = self.touched.slot(k);
        self.sheets[slot][pixel] = sums.map(S::from_bits);
        self.touched.masks[slot] = u64::MAX;
    }

    fn raw(&self, k: i32, pixel: usize) -> RawSums {
        self.sheets[self.touched.slot(k)][pixel].map(S::bits)
    }

    #[inline(always)]
    fn touched(&self, k: i32) -> u64 {
        self.touched.masks[self.touched.slot(k)]
    }

    #[inline(always)]
    fn clear(&mut self, k: i32) {
        let slot = self.touched.slot(k);
        let mut mask = std::mem::take(&mut self.touched.masks[slot]);
        while mask != 0 {
            for row in block_rows(mask.trailing_zeros() as usize) {
                self.sheets[slot][row..row + BLOCK].fill([S::default(); 4]);
            }
            mask &= mask - 1;
        }
    }

    #[inline(always)]
    fn add(&mut self, k: i32, window: Window<'_, S::Weight>, section: [S::Section; 4]) {
        let slot = self.touched.slot(k);
        let sheet: &mut Pixels<S> = &mut self.sheets[slot];
        splat(sheet, PART, window.0, window.1, section);
        self.touched.masks[slot] |= blocks(window);
    }

    #[inline(always)]
    fn add_all(
        &mut self,
        sections: &Sections,
        z: i32,
        sheets: std::ops::Range<i32>,
        window: Window<'_, S::Weight>,
        payload: &[f32; 4],
    ) {
        let first = sections.first(z);
        for k in sheets {
            self.add(k, window, S::section(sections, z, (k - first) as usize, payload));
        }
    }

    #[inline(always)]
    fn load(&self, k: i32, pixel: usize, row: &mut Row) {
        let lanes = |to: &mut [[f32; LANES]; 4], k: i32| {
            let from = &self.sheets[self.touched.slot(k)][pixel..pixel + LANES];
            for (i, sums) in from.iter().enumerate() {
                for c in 0..4 {
                    to[c][i] = sums[c].value();
                }
            }
        };
        lanes(&mut row.before, k - 1);
        lanes(&mut row.here, k);
        lanes(&mut row.behind, k + 1);
    }
}

/// Eight sheets of a pixel beside each other.
pub(crate) struct Records {
    pixels: Vec<Record>,
    touched: [u64; SLOTS],
    simd: Simd,
}

/// Sheets of a record.
pub(crate) const SLOTS: usize = 8;

impl Default for Records {
    fn default() -> Self {
        Records { pixels: Vec::new(), touched: [0; SLOTS], simd: Simd::plain() }
    }
}

#[inline(always)]
fn slot(k: i32) -> usize {
    k as usize % SLOTS
}

impl Ring for Records {
    type Sum = i16;

    fn reset(&mut self, slots: usize, simd: Simd) {
        assert!(slots <= SLOTS, "{slots} sheets are open at once, records hold {SLOTS}");
        self.simd = simd;
        self.pixels.resize(PART * PART, Record::default());
        for k in 0..SLOTS {
            self.clear(k as i32);
        }
    }

    fn put(&mut self, k: i32, pixel: usize, sums: RawSums) {
        self.pixels[pixel].0[slot(k)] = sums.map(i16::from_bits);
        self.touched[slot(k)] = u64::MAX;
    }

    fn raw(&self, k: i32, pixel: usize) -> RawSums {
        self.pixels[pixel].0[slot(k)].map(i16::bits)
    }

    #[inline(always)]
    fn touched(&self, k: i32) -> u64 {
        self.touched[slot(k)]
    }

    #[inline(always)]
    fn clear(&mut self, k: i32) {
        let slot = slot(k);
        let mut mask = std::mem::take(&mut self.touched[slot]);
        while mask != 0 {
            for row in block_rows(mask.trailing_zeros() as usize) {
                for record in &mut self.pixels[row..row + BLOCK] {
                    record.0[slot] = [0; 4];
                }
            }
            mask &= mask - 1;
        }
    }

    #[inline(always)]
    fn add(&mut self, k: i32, window: Window<'_, i16>, section: [i16; 4]) {
        let sheet = slot(k);
        for (j, &wy) in window.1.1.iter().enumerate() {
            let row = (window.1.0 + j) * PART + window.0.0;
            let rows = section.map(|c| i16::row(c, wy));
            for (record, &wx) in self.pixels[row..row + window.0.1.len()].iter_mut().zip(window.0.1)
            {
                let sums = &mut record.0[sheet];
                for c in 0..4 {
                    sums[c] = sums[c].plus(rows[c], wx);
                }
            }
        }
        self.touched[slot(k)] |= blocks(window);
    }

    #[inline(always)]
    fn add_all(
        &mut self,
        sections: &Sections,
        z: i32,
        sheets: std::ops::Range<i32>,
        window: Window<'_, i16>,
        payload: &[f32; 4],
    ) {
        let (first, weights) = sections.of_fixed(z);
        let payload = payload.map(whole);
        let touched = blocks(window);
        let mut wz = [0; SLOTS];
        for k in sheets {
            wz[slot(k)] = weights[(k - first) as usize];
            self.touched[slot(k)] |= touched;
        }
        splat_record(self.simd, &mut self.pixels, PART, window.0, window.1, payload, wz);
    }

    #[inline(always)]
    fn load(&self, k: i32, pixel: usize, row: &mut Row) {
        let from = &self.pixels[pixel..pixel + LANES];
        load_records(self.simd, from, slot(k - 1), &mut row.before);
        load_records(self.simd, from, slot(k), &mut row.here);
        load_records(self.simd, from, slot(k + 1), &mut row.behind);
    }
}
