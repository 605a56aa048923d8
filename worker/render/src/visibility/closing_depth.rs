//! The depth at which each cell of a picture was shut: what a frame teaches the next one about
//! bricks.
//!
//! A region finds out while it is drawn which bricks are hidden, and asks for the others when it
//! reaches them; each time it stalls for as long as they are on their way. The next frame of a path
//! looks much alike. So each cell of 8x8 pixels keeps the sheet at which it was shut, and a region
//! of the next frame prefetches the bricks that begin well in front of that. A wrong guess costs
//! bricks that are not needed, or one more stall.
//!
//! Some slack keeps wrong guesses few. mri256 `peer-opaque`, 18 views 5 degrees apart, one worker:
//! without prefetch 25.3 % of its bricks were held at the end, and regions stalled ten times a
//! later frame. With a prefetch of all that begins before a cell's last pixel was shut it would be
//! 34.5 % and half a stall: most of these bricks are at the surface itself, where depths a few
//! sheets off say nothing.
//!
//! Depths know no views: those of a picture seen from elsewhere are as good as they are.

use crate::visibility::open_mask::OpenMask;
use slabcast_common::occlusion::Rect;
use slabcast_common::region::PART_EDGE;
use std::sync::atomic::{AtomicI32, Ordering};

/// Edge of a cell in pixels. A brick of a head of 256 voxels is some 20 pixels wide in a picture of
/// 512. With cells of 16, one open pixel at an outline would prefetch all that lies behind 256
/// pixels.
pub(crate) const CELL: i32 = 8;

/// Cells across a part.
const ROW: usize = (PART_EDGE / CELL) as usize;

/// Number of sheets from one look at a part's shut cells to the next.
pub const LOOKS: i32 = 8;

/// A cell with fewer open pixels counts as shut.
const LEAST: u8 = 8;

/// Sheets that a brick must begin in front of the sheet at which its pixels were shut to be
/// prefetched: two bricks where sheets are a voxel thick. With 4, 8 and 12 that worker held 31, 29
/// and 28 % of the bricks.
const SLACK: i32 = 16;

/// Pixels at a brick's border that do not count, since footprints hardly reach there. At zero 0.7 %
/// more bricks are held.
const BORDER: i32 = 3;

/// Population count of each byte.
#[inline(always)]
fn bits_of_bytes(x: u64) -> u64 {
    const A: u64 = 0x5555_5555_5555_5555;
    const B: u64 = 0x3333_3333_3333_3333;
    const C: u64 = 0x0f0f_0f0f_0f0f_0f0f;
    let x = x - (x >> 1 & A);
    let x = (x & B) + (x >> 2 & B);
    (x + (x >> 4)) & C
}

/// The sheets at which a part's cells were found shut; `i32::MAX` where they are open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cells(pub [i32; ROW * ROW]);

impl Default for Cells {
    fn default() -> Self {
        Cells([i32::MAX; ROW * ROW])
    }
}

impl Cells {
    /// Notes as shut at sheet `k` the cells with hardly any of the pixels of `open`, which are open
    /// in front of it.
    pub fn look(&mut self, k: i32, open: &OpenMask) {
        for (rows, cells) in open.rows().chunks(CELL as usize).zip(self.0.chunks_mut(ROW)) {
            // At most 64 in a byte.
            let open: u64 = rows.iter().map(|row| bits_of_bytes(*row)).sum();
            for (cell, open) in cells.iter_mut().zip(open.to_le_bytes()) {
                *cell = if open < LEAST { k.min(*cell) } else { *cell };
            }
        }
    }

    /// Notes as shut at sheet `k` the cells that are still open.
    pub fn shut(&mut self, k: i32) {
        self.0.iter_mut().for_each(|cell| *cell = k.min(*cell));
    }
}

/// For each cell of 8x8 pixels of a picture, the sheet at which it was shut in the last frame that
/// was drawn there. Threads write and read cells concurrently; no cell depends on another, and none
/// needs to be right.
#[derive(Debug)]
pub struct ClosingDepths {
    columns: usize,
    rows: usize,
    /// Row-major; `i32::MIN` where nothing was drawn.
    cells: Vec<AtomicI32>,
}

impl ClosingDepths {
    /// Makes the cells of a picture of `size` pixels (width, height), of which nothing is known.
    pub fn new(size: [u32; 2]) -> ClosingDepths {
        let [columns, rows] = size.map(|n| n.div_ceil(CELL as u32) as usize);
        let cells = (0..columns * rows).map(|_| AtomicI32::new(i32::MIN)).collect();
        ClosingDepths { columns, rows, cells }
    }

    /// The cells that a rectangle overlaps.
    fn under(&self, r: &Rect) -> impl Iterator<Item = &AtomicI32> {
        let cell = |at: i32, most: usize| ((at.max(0) / CELL) as usize).min(most);
        let (x0, x1) = (cell(r.x0, self.columns), cell(r.x1 + CELL - 1, self.columns));
        let (y0, y1) = (cell(r.y0, self.rows), cell(r.y1 + CELL - 1, self.rows));
        (y0..y1.max(y0)).flat_map(move |y| &self.cells[y * self.columns..][x0..x1.max(x0)])
    }

    /// Records the cells of `part`, whose upper left corner must be a cell's.
    pub fn note(&self, part: &Rect, cells: &Cells) {
        let wide = part.width().div_ceil(CELL as usize);
        let of_part = cells.0.chunks(ROW).flat_map(|row| &row[..wide.min(ROW)]);
        self.under(part).zip(of_part).for_each(|(to, depth)| to.store(*depth, Ordering::Relaxed));
    }

    /// Returns whether a brick over rectangle `r` that begins at sheet `first` will probably be
    /// needed.
    pub fn expects(&self, r: &Rect, first: i32) -> bool {
        let r = match r.width().min(r.height()) as i32 > 2 * BORDER {
            true => Rect::new(r.x0 + BORDER, r.y0 + BORDER, r.x1 - BORDER, r.y1 - BORDER),
            false => *r,
        };
        first.saturating_add(SLACK) <= self.deepest(&r)
    }

    /// Returns the deepest sheet at which anything in rectangle `r` was open; `i32::MIN` where
    /// nothing was drawn.
    pub fn deepest(&self, r: &Rect) -> i32 {
        self.under(r).map(|cell| cell.load(Ordering::Relaxed)).max().unwrap_or(i32::MIN)
    }
}
