//! The open sheets of a part as planes: sheet k, the one before, and as many behind as a voxel has
//! sections; for any kind of sums and any number of sheets.

use crate::kernels::composite::Row;
use crate::kernels::field::{FieldSum, Four, weighted};
use crate::kernels::{Accumulate, Pixels, splat};
use slabcast_common::image::RawSums;

/// Pixels of a part's row, and rows of a part.
pub(crate) const PART: usize = 64;
/// Edge of the blocks by which a sheet's touched pixels are known.
pub(crate) const BLOCK: usize = 8;

/// A voxel's footprint, inside the part: first column and weights, first row and weights.
pub(crate) type Window<'a, W> = ((usize, &'a [W]), (usize, &'a [W]));

/// Returns the blocks that a window touches, one bit each.
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
#[derive(Default)]
pub(crate) struct Planes<S> {
    sheets: Vec<Vec<[S; 4]>>,
    touched: Touched,
}

impl<S: Accumulate> Planes<S> {
    /// Empties all sheets and makes room for `slots`.
    pub(crate) fn reset(&mut self, slots: usize) {
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

    /// Puts sums of a sheet that was left open by the slab before.
    pub(crate) fn put(&mut self, k: i32, pixel: usize, sums: RawSums) {
        let slot = self.touched.slot(k);
        self.sheets[slot][pixel] = sums.map(S::from_bits);
        self.touched.masks[slot] = u64::MAX;
    }

    /// Sums as they travel.
    pub(crate) fn raw(&self, k: i32, pixel: usize) -> RawSums {
        self.sheets[self.touched.slot(k)][pixel].map(S::bits)
    }

    /// Blocks that something was added to.
    #[inline(always)]
    pub(crate) fn touched(&self, k: i32) -> u64 {
        self.touched.masks[self.touched.slot(k)]
    }

    /// Empties the touched blocks of sheet `k`.
    #[inline(always)]
    pub(crate) fn clear(&mut self, k: i32) {
        let slot = self.touched.slot(k);
        let mut mask = std::mem::take(&mut self.touched.masks[slot]);
        while mask != 0 {
            for row in block_rows(mask.trailing_zeros() as usize) {
                self.sheets[slot][row..row + BLOCK].fill([S::default(); 4]);
            }
            mask &= mask - 1;
        }
    }

    /// Adds one section of a voxel to sheet `k`.
    #[inline(always)]
    pub(crate) fn add(&mut self, k: i32, window: Window<'_, S::Weight>, section: [S::Section; 4]) {
        let slot = self.touched.slot(k);
        let sheet: &mut Pixels<S> = &mut self.sheets[slot];
        splat(sheet, PART, window.0, window.1, section);
        self.touched.masks[slot] |= blocks(window);
    }

    /// Adds a row of one plane of a field's voxel to sheet `k`, from column x and row y on.
    #[inline(always)]
    pub(crate) fn add_field_row(
        &mut self,
        k: i32,
        [x0, y]: [usize; 2],
        wx: &[Four<S>],
        row: Four<S>,
    ) where
        S: FieldSum,
    {
        let slot = self.touched.slot(k);
        let to = &mut self.sheets[slot][y * PART + x0..][..wx.len()];
        for (pixel, &wx) in to.iter_mut().zip(wx) {
            let term = weighted::<S>(row, wx);
            for c in 0..4 {
                pixel[c] = pixel[c].with(term[c]);
            }
        }
        let (bx0, bx1) = (x0 / BLOCK, (x0 + wx.len() - 1) / BLOCK);
        let touched = (u64::MAX >> (63 - (bx1 - bx0))) << bx0;
        self.touched.masks[slot] |= touched << (8 * (y / BLOCK));
    }

    /// The sums of [`BLOCK`] pixels from `pixel` in sheets k-1, k and k+1, to lanes from `lane`.
    #[inline(always)]
    pub(crate) fn load(&self, k: i32, pixel: usize, row: &mut Row, lane: usize) {
        let sheets = [&mut row.before, &mut row.here, &mut row.behind];
        for (k, to) in (k - 1..=k + 1).zip(sheets) {
            let from = &self.sheets[self.touched.slot(k)][pixel..pixel + BLOCK];
            for (i, sums) in from.iter().enumerate() {
                for c in 0..4 {
                    to[c][lane + i] = sums[c].value();
                }
            }
        }
    }
}
