//! The work of each pixel of a tile, counted while it is drawn and from its voxels.
//!
//! Sheets are counted where they close. Sections are not counted where they are added, in the
//! innermost loops: a pixel gets all sections of the voxels that cover it up to the sheet in which
//! it was shut, and that follows from their places and from that sheet alone. So voxels are walked
//! through once more, without their looks, and those behind shut pixels are passed over, first by
//! block and brick.
//!
//! [`crate::oracle::work_counters`] gets the same numbers as it draws plainly.

use crate::kernels::{Simd, Work};
use crate::part::brick_feed::BrickSupply;
pub use crate::primitives::work_counters::WorkCounters;
use crate::region;
use crate::scene::{Corner, Frame};
use crate::tile::Scratch;
use crate::visibility::VisibleBricks;
use slabcast_common::brick::Brick;
use slabcast_common::image::TilePixels;
use slabcast_common::occlusion::Rect;
use slabcast_common::region::{PART_EDGE, parts};
use slabcast_common::view::Projection;

/// Draws `tile` as [`region::draw`] does and returns the work of its pixels. Sections are counted
/// only if `sections` is set.
///
/// # Panics
/// If `supply` lacks a brick that the tile needs.
pub fn draw(
    frame: &Frame,
    visible: &VisibleBricks,
    supply: &dyn BrickSupply,
    simd: Simd,
    tile: Rect,
    sections: bool,
    scratch: &mut Scratch,
    out: &mut TilePixels,
) -> WorkCounters {
    let counters = WorkCounters::new([tile.width(), tile.height()]);
    scratch.count_work(Some(counters));
    region::draw(frame, visible, supply, simd, tile, scratch, out);
    let mut counters = scratch.count_work(None).expect("put there above");
    if sections {
        for part in parts(tile) {
            let ends = Ends::new(part, tile, &counters);
            simd.run(PartSections { frame, visible, supply, ends, tile, counters: &mut counters });
        }
    }
    counters
}

const EDGE: usize = PART_EDGE as usize;
/// Edge of a cell in pixels.
const CELL: usize = 8;
const CELLS: usize = EDGE / CELL;

/// The sheet before which each pixel of a part ends: the one behind that in which it was shut, or
/// none.
struct Ends {
    part: Rect,
    /// In rows of [`EDGE`].
    pixels: Vec<i32>,
    /// The farthest of each cell.
    cells: [[i32; CELLS]; CELLS],
}

impl Ends {
    fn new(part: Rect, tile: Rect, counters: &WorkCounters) -> Ends {
        let mut ends =
            Ends { part, pixels: vec![i32::MIN; EDGE * EDGE], cells: [[i32::MIN; CELLS]; CELLS] };
        for y in 0..part.height() {
            let row = (part.y0 - tile.y0) as usize + y;
            let row = row * tile.width() + (part.x0 - tile.x0) as usize;
            for x in 0..part.width() {
                let end = counters.shut_in[row + x].map_or(i32::MAX, |k| k + 1);
                ends.pixels[y * EDGE + x] = end;
                let cell = &mut ends.cells[y / CELL][x / CELL];
                *cell = end.max(*cell);
            }
        }
        ends
    }

    /// Returns whether any pixel of the part may be open in sheet `k`.
    fn any(&self, k: i32) -> bool {
        self.cells.iter().flatten().any(|end| *end > k)
    }

    /// Returns whether any pixel of `rect`, or one near it, is open in sheet `k`.
    #[inline(always)]
    fn may_show(&self, rect: &Rect, k: i32) -> bool {
        let rect = rect.intersect(&self.part);
        if rect.is_empty() {
            return false;
        }
        let cell = |p: i32, first: i32| (p - first) as usize / CELL;
        let columns = cell(rect.x0, self.part.x0)..=cell(rect.x1 - 1, self.part.x0);
        let mut rows = cell(rect.y0, self.part.y0)..=cell(rect.y1 - 1, self.part.y0);
        rows.any(|row| self.cells[row][columns.clone()].iter().any(|end| *end > k))
    }
}

/// Work that counts the sections of the pixels of one part.
struct PartSections<'a> {
    frame: &'a Frame,
    visible: &'a VisibleBricks,
    supply: &'a dyn BrickSupply,
    ends: Ends,
    tile: Rect,
    counters: &'a mut WorkCounters,
}

impl Work for PartSections<'_> {
    type Out = ();
    #[inline(always)]
    fn run(mut self, _: Simd) {
        let PartSections { frame, visible, supply, .. } = self;
        let part = self.ends.part;
        // All sections of a voxel lie before the same pixels.
        let one =
            matches!(frame.view.projection, Projection::Ortho { .. }) && frame.leaning.is_none();
        for &block in visible.over(part.x0, part.y0) {
            let projected = &visible.block(block).projected;
            if !self.ends.any(projected.sheets.first) {
                break;
            }
            if !self.ends.may_show(&projected.rect, projected.sheets.first) {
                continue;
            }
            for brick in visible.bricks(block) {
                let projected = &brick.projected;
                if self.ends.may_show(&projected.rect, projected.sheets.first) {
                    let brick = supply.get(brick.place).expect("a brick that was drawn");
                    self.count_brick(&brick, &frame.corner(brick.id), one);
                }
            }
        }
    }
}

impl PartSections<'_> {
    #[inline(always)]
    fn count_brick(&mut self, brick: &Brick, corner: &Corner, one: bool) {
        let frame = self.frame;
        for (i, &local) in brick.index.iter().enumerate() {
            let placed = frame.place(corner, local);
            let (first, count) = frame.sections.span(placed.z);
            // Every voxel of a field adds to it; others have to be seen.
            if !frame.is_field() && frame.extinction(brick, i) <= 0.0 {
                continue;
            }
            let end = first + count as i32;
            let step = if one { count as usize } else { 1 };
            for k in (first..end).step_by(step.max(1)) {
                let Some(footprint) = frame.footprints.at(k) else { continue };
                let at = frame.screen(&placed, k, &footprint);
                let (y0, y1) = footprint.extent(1, at[1]);
                let sheets = [k, k + step as i32];
                if one {
                    let (x0, x1) = footprint.extent(0, at[0]);
                    self.count(Rect::new(x0, y0, x1, y1), sheets);
                    continue;
                }
                // Rows of a kernel that leans lie beside each other.
                for y in y0.max(self.ends.part.y0)..y1.min(self.ends.part.y1) {
                    let (x0, x1) = footprint.extent(0, frame.along_row(at, y));
                    self.count(Rect::new(x0, y, x1, y + 1), sheets);
                }
            }
        }
    }

    /// Counts sections in `sheets`, from the first up to the second, at the pixels of `rect`.
    #[inline(always)]
    fn count(&mut self, rect: Rect, [first, end]: [i32; 2]) {
        let PartSections { ends, tile, counters, .. } = self;
        if !ends.may_show(&rect, first) {
            return;
        }
        let rect = rect.intersect(&ends.part);
        let (wide, width) = (rect.width(), tile.width());
        for y in rect.y0..rect.y1 {
            let from = (y - ends.part.y0) as usize * EDGE + (rect.x0 - ends.part.x0) as usize;
            let to = (y - tile.y0) as usize * width + (rect.x0 - tile.x0) as usize;
            let ends = &ends.pixels[from..from + wide];
            for (sections, last) in counters.sections[to..to + wide].iter_mut().zip(ends) {
                *sections += ((*last).clamp(first, end) - first) as u32;
            }
        }
    }
}
