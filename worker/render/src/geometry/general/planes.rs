//! The open sheets of a part as planes: sheet k, the one before, and as many behind as a voxel has
//! sections; for any kind of sums and any number of sheets.

use crate::kernels::composite::Row;
use crate::kernels::field::{FieldSum, Four, weighted};
use crate::kernels::{Accumulate, Pixels, splat};
use crate::primitives::sizes::LATTICE_ROWS as ROWS;
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

/// Rows of lattice rows in the open sheets of a level view's part
/// ([`crate::primitives::lattice_rows`]).
#[derive(Default)]
pub(crate) struct Lofts<S> {
    sheets: Vec<Loft<S>>,
}

/// Lattice rows of one sheet.
struct Loft<S> {
    /// The sheet, and the lattice row that row 0 stands for.
    k: i32,
    base: i32,
    rows: Vec<[S; 4]>,
    /// By row, columns that something was added to.
    touched: [u64; ROWS],
}

impl<S: Accumulate> Lofts<S> {
    /// Empties all and makes room for `slots`.
    pub(crate) fn reset(&mut self, slots: usize) {
        let empty = || Loft {
            k: i32::MIN,
            base: 0,
            rows: vec![[S::default(); 4]; ROWS * PART],
            touched: [0; ROWS],
        };
        self.sheets.resize_with(slots, empty);
        self.sheets.iter_mut().for_each(Loft::clear);
    }

    #[inline(always)]
    fn slot(&self, k: i32) -> usize {
        k.rem_euclid(self.sheets.len() as i32) as usize
    }

    /// Adds one section of a voxel of `lattice row` to sheet `k`, whose row 0 is that of `base`.
    #[inline(always)]
    pub(crate) fn add(
        &mut self,
        (k, base): (i32, i32),
        lattice_row: i32,
        (x0, wx): (usize, &[S::Weight]),
        section: [S::Section; 4],
    ) {
        let slot = self.slot(k);
        let loft = &mut self.sheets[slot];
        (loft.k, loft.base) = (k, base);
        let row = lattice_row - base;
        if !(0..ROWS as i32).contains(&row) {
            // It reaches none of the part's pixels.
            return;
        }
        let row = row as usize;
        for (sums, &w) in loft.rows[row * PART + x0..][..wx.len()].iter_mut().zip(wx) {
            for c in 0..4 {
                sums[c] = sums[c].plus(section[c], w);
            }
        }
        loft.touched[row] |= (u64::MAX >> (PART - wx.len())) << x0;
    }

    /// The columns of sheet `k` that any of these lattice rows were added to.
    #[inline(always)]
    pub(crate) fn touched<W>(&self, k: i32, lattice_rows: &[(i32, W)]) -> u64 {
        let loft = &self.sheets[self.slot(k)];
        if loft.k != k {
            return 0;
        }
        let row =
            |&(lattice_row, _): &(i32, W)| loft.touched.get((lattice_row - loft.base) as usize);
        lattice_rows.iter().filter_map(row).fold(0, |all, touched| all | touched)
    }

    /// Returns the weighted sum of these lattice rows in the [`BLOCK`] columns of sheet `k` from
    /// `x` on.
    #[inline(always)]
    pub(crate) fn down(
        &self,
        k: i32,
        x: usize,
        lattice_rows: &[(i32, S::Weight)],
    ) -> [[S; 4]; BLOCK] {
        let loft = &self.sheets[self.slot(k)];
        let mut ways = [[S::Way::default(); 4]; BLOCK];
        for &(lattice_row, wy) in lattice_rows {
            let row = (lattice_row - loft.base) as usize;
            let Some(row) = loft.rows.get(row * PART + x..).and_then(<[_]>::first_chunk) else {
                continue;
            };
            let row: &[[S; 4]; BLOCK] = row;
            for i in 0..BLOCK {
                for c in 0..4 {
                    ways[i][c] = S::on(ways[i][c], row[i][c], wy);
                }
            }
        }
        let mut sums = [[S::default(); 4]; BLOCK];
        for i in 0..BLOCK {
            for c in 0..4 {
                sums[i][c] = S::end(ways[i][c]);
            }
        }
        sums
    }

    /// Empties sheet `k`.
    #[inline(always)]
    pub(crate) fn clear(&mut self, k: i32) {
        let slot = self.slot(k);
        if self.sheets[slot].k == k {
            self.sheets[slot].clear();
        }
    }
}

impl<S: Accumulate> Loft<S> {
    fn clear(&mut self) {
        for (row, touched) in self.rows.chunks_mut(PART).zip(&mut self.touched) {
            if std::mem::take(touched) != 0 {
                row.fill([S::default(); 4]);
            }
        }
        self.k = i32::MIN;
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

    /// Puts sums of sheet `k` that came from lattice rows, from a block's first column on.
    #[inline(always)]
    pub(crate) fn set(&mut self, k: i32, [x, y]: [usize; 2], sums: &[[S; 4]; BLOCK]) {
        let slot = self.touched.slot(k);
        self.sheets[slot][y * PART + x..][..BLOCK].copy_from_slice(sums);
        self.touched.masks[slot] |= 1 << (y / BLOCK * 8 + x / BLOCK);
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
