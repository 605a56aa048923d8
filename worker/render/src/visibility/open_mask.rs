//! Which pixels of a tile part are open, one bit each: tests of rectangles in a few words.
//!
//! A part has at most 64 columns, so a row is a word and "is anything open under this footprint?"
//! is an AND of some eight words. A summed-area count needs four reads but has to be made anew
//! over the whole part whenever a pixel shuts, which is nearly every sheet. Where all footprints
//! are of one size, a mask grown by their reach answers a coarser question in one bit: may anything
//! be open around this centre? Most voxels need no more.

use slabcast_common::occlusion::Rect;
use slabcast_common::view::SUBPIXEL_BITS;

/// Open pixels of a part of at most 64x64 pixels.
#[derive(Clone, Debug)]
pub(crate) struct OpenMask {
    rect: Rect,
    rows: [u64; 64],
    /// Pixels with an open one at most so many columns and rows away.
    grown: [u64; 64],
    reach: [i32; 2],
}

/// By how much one pixel has to be moved, step by step together with all that it has become, to be `n`.
#[inline(always)]
pub(crate) fn doubling(n: usize) -> impl Iterator<Item = usize> {
    let mut done = 1;
    std::iter::from_fn(move || {
        let step = done.min(n - done);
        done += step;
        (step > 0).then_some(step)
    })
}

/// Farthest that a mask is grown: beyond it every footprint covers most of a part anyway.
pub(crate) const REACH_MOST: i32 = 31;

impl OpenMask {
    /// Every pixel of `rect` is shut.
    ///
    /// # Panics
    /// If `rect` has more than 64 columns or rows.
    pub(crate) fn shut(rect: Rect) -> Self {
        assert!(rect.width() <= 64 && rect.height() <= 64, "a part is at most 64x64");
        OpenMask { rect, rows: [0; 64], grown: [0; 64], reach: [0; 2] }
    }

    /// Opens the pixels of row `y` whose bits are set.
    #[inline(always)]
    pub(crate) fn open_row(&mut self, y: usize, bits: u64) {
        self.rows[y & 63] |= bits;
    }

    /// Shuts the pixels of row `y` whose bits are set.
    #[inline(always)]
    pub(crate) fn close(&mut self, y: usize, bits: u64) {
        self.rows[y & 63] &= !bits;
    }

    /// All rows of open pixels.
    #[inline(always)]
    pub(crate) fn rows(&self) -> &[u64; 64] {
        &self.rows
    }

    /// Open pixels of row `y`.
    #[inline(always)]
    pub(crate) fn row(&self, y: usize) -> u64 {
        self.rows[y & 63]
    }

    /// Grows the mask by so many columns and rows, each at most [`REACH_MOST`]: to be done again after pixels
    /// shut.
    #[inline(always)]
    pub(crate) fn grow(&mut self, reach: [i32; 2]) {
        self.reach = reach.map(|reach| reach.min(REACH_MOST));
        self.grown = self.rows;
        // To both sides at once: a pixel and so many on either side.
        let [columns, rows] = self.reach.map(|reach| doubling(reach as usize + 1));
        for step in columns {
            for row in &mut self.grown {
                *row |= *row << step | *row >> step;
            }
        }
        for step in rows {
            let was = self.grown;
            for y in step..64 {
                self.grown[y] |= was[y - step];
                self.grown[y - step] |= was[y];
            }
        }
    }

    /// The nearest pixels of the part to many centres in subpixels, and whether a footprint of the
    /// mask's reach around them may touch the part (1) or an open pixel of it, too (3).
    #[inline(always)]
    pub(crate) fn near_all(&self, x: &[i32], y: &[i32], cells: &mut [u32], fate: &mut [u32]) {
        let [wide, high] = self.reach.map(|reach| (64 + 2 * reach) as u32);
        let [across, down] = self.reach;
        for (((x, y), cell), fate) in x.iter().zip(y).zip(cells).zip(fate) {
            let (x, y) = (x >> SUBPIXEL_BITS, y >> SUBPIXEL_BITS);
            let inside = [(x + across, wide), (y + down, high)];
            let [inside_x, inside_y] = inside.map(|(p, span)| u32::from((p as u32) < span));
            let (cx, cy) = (x.clamp(0, 63), y.clamp(0, 63));
            *cell = (cy << 6 | cx) as u32;
            *fate = (inside_x & inside_y) * (1 + 2 * ((self.grown[cy as usize] >> cx) as u32 & 1));
        }
    }

    /// What [`OpenMask::near_all`] looks at: the grown mask and its reach.
    #[inline(always)]
    pub(crate) fn grown(&self) -> (&[u64; 64], [i32; 2]) {
        (&self.grown, self.reach)
    }

    /// Whether something may be open near the pixel of the part that [`OpenMask::near_all`] named.
    #[inline(always)]
    pub(crate) fn is_near(&self, cell: u32) -> bool {
        self.grown[(cell >> 6 & 63) as usize] >> (cell & 63) & 1 == 1
    }

    /// Number of open pixels.
    pub(crate) fn count(&self) -> usize {
        self.rows.iter().map(|r| r.count_ones() as usize).sum()
    }

    /// Whether any pixel of `rect` (picture coordinates) is open.
    #[inline(always)]
    pub(crate) fn any(&self, rect: &Rect) -> bool {
        let x0 = rect.x0.max(self.rect.x0) - self.rect.x0;
        let x1 = rect.x1.min(self.rect.x1) - self.rect.x0;
        let y0 = rect.y0.max(self.rect.y0) - self.rect.y0;
        let y1 = rect.y1.min(self.rect.y1) - self.rect.y0;
        if x0 >= x1 || y0 >= y1 {
            return false;
        }
        let columns = (u64::MAX >> (64 - (x1 - x0) as u32)) << x0;
        let mut any = 0;
        for row in &self.rows[y0 as usize..y1 as usize] {
            any |= row;
        }
        any & columns != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_rectangle_is_open_where_a_pixel_is(
            w in 1..=64i32, h in 1..=64i32, x in -9..9i32, y in -9..9i32,
            open in prop::collection::vec((0..64i32, 0..64i32), 0..6),
            rects in prop::collection::vec((-20..80i32, -20..80i32, -3..40i32, -3..40i32), 1..40),
        ) {
            let part = Rect::new(x, y, x + w, y + h);
            let mut mask = OpenMask::shut(part);
            let open: Vec<_> = open.into_iter().filter(|&(i, j)| i < w && j < h).collect();
            for &(i, j) in &open {
                mask.open_row(j as usize, 1 << i);
            }
            for (x0, y0, dx, dy) in rects {
                let r = Rect::new(x0, y0, x0 + dx, y0 + dy);
                // A rectangle around a centre is open only where the grown mask says it may be.
                let ([rx, ry], cx, cy) = ([dx, dy].map(|d| d.clamp(0, REACH_MOST)), x0, y0);
                mask.grow([rx, ry]);
                let around =
                    Rect::new(x + cx - rx, y + cy - ry, x + cx + rx + 1, y + cy + ry + 1);
                let (mut cell, mut fate) = ([0], [9]);
                mask.near_all(&[cx * 256 + 255], &[cy * 256], &mut cell, &mut fate);
                let near = fate[0] == 3;
                prop_assert!(near || !mask.any(&around), "{around:?} in {part:?}");
                let inside = (0..64).contains(&cx) && (0..64).contains(&cy);
                prop_assert!(!inside || near == mask.any(&around));
                prop_assert!(fate[0] == 0 || near == mask.is_near(cell[0]));
                let inside = |&(i, j): &(i32, i32)| {
                    let (i, j) = (i + x, j + y);
                    r.x0 <= i && i < r.x1 && r.y0 <= j && j < r.y1
                };
                prop_assert_eq!(mask.any(&r), open.iter().any(inside), "{:?} in {:?}", r, part);
            }
        }
    }
}
