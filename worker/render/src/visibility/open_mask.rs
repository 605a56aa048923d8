//! The occlusion map of a tile part (paper, section 3): one bit a pixel, set while the pixel is
//! open.
//!
//! A part has at most 64 columns, so a row is a word and "is anything open under this footprint?"
//! is an AND of some eight words. A summed-area table needs four reads but has to be made anew
//! over the whole part whenever a pixel is shut, which is nearly every sheet. Where all footprints
//! are of one size, a mask grown by their reach answers a coarser question in one bit: may anything
//! be open around this centre? Most voxels need no more.

use slabcast_common::occlusion::Rect;
use slabcast_common::view::SUBPIXEL_BITS;

/// Open pixels of a part of at most 64x64 pixels.
#[derive(Clone, Debug)]
pub struct OpenMask {
    rect: Rect,
    rows: [u64; 64],
    /// Pixels with an open pixel at most `reach` columns and rows away.
    grown: [u64; 64],
    reach: [i32; 2],
}

/// Returns the shifts, in pixels, that grow one set bit to a run of `n`: at each step the run is
/// ORed with itself moved by the shift.
#[inline(always)]
pub fn doubling(n: usize) -> impl Iterator<Item = usize> {
    let mut done = 1;
    std::iter::from_fn(move || {
        let step = done.min(n - done);
        done += step;
        (step > 0).then_some(step)
    })
}

/// Largest number of pixels by which a mask is grown: beyond it every footprint covers most of a
/// part anyway.
pub const REACH_MOST: i32 = 31;

impl OpenMask {
    /// Makes a mask with every pixel of `rect` shut.
    ///
    /// # Panics
    /// If `rect` has more than 64 columns or rows.
    pub fn shut(rect: Rect) -> Self {
        assert!(rect.width() <= 64 && rect.height() <= 64, "a part is at most 64x64");
        OpenMask { rect, rows: [0; 64], grown: [0; 64], reach: [0; 2] }
    }

    /// Opens the pixels of row `y` whose bits are set.
    #[inline(always)]
    pub fn open_row(&mut self, y: usize, bits: u64) {
        self.rows[y & 63] |= bits;
    }

    /// Shuts the pixels of row `y` whose bits are set.
    #[inline(always)]
    pub fn close(&mut self, y: usize, bits: u64) {
        self.rows[y & 63] &= !bits;
    }

    /// The open pixels, a word a row.
    #[inline(always)]
    pub(crate) fn rows(&self) -> &[u64; 64] {
        &self.rows
    }

    /// Open pixels of row `y`.
    #[inline(always)]
    pub(crate) fn row(&self, y: usize) -> u64 {
        self.rows[y & 63]
    }

    /// Grows the mask by `reach` columns and rows, each at most [`REACH_MOST`]. Must be called
    /// again after pixels were shut.
    #[inline(always)]
    pub fn grow(&mut self, reach: [i32; 2]) {
        self.reach = reach.map(|reach| reach.min(REACH_MOST));
        self.grown = self.rows;
        // To both sides at once: a pixel and `reach` pixels on either side.
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

    /// Computes for each centre (`x`, `y`, in subpixels from the part's corner) the nearest pixel
    /// of the part, and whether a footprint of the mask's reach may touch the part (1) and an open
    /// pixel of it (3).
    #[inline(always)]
    pub fn near_all(&self, x: &[i32], y: &[i32], cells: &mut [u32], fate: &mut [u32]) {
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

    /// The grown mask and its reach, which [`OpenMask::near_all`] reads.
    #[inline(always)]
    pub(crate) fn grown(&self) -> (&[u64; 64], [i32; 2]) {
        (&self.grown, self.reach)
    }

    /// Returns whether a pixel may be open near `cell`, a pixel that [`OpenMask::near_all`]
    /// returned.
    #[inline(always)]
    pub fn is_near(&self, cell: u32) -> bool {
        self.grown[(cell >> 6 & 63) as usize] >> (cell & 63) & 1 == 1
    }

    /// Number of open pixels.
    pub(crate) fn count(&self) -> usize {
        self.rows.iter().map(|r| r.count_ones() as usize).sum()
    }

    /// Returns whether any pixel of `rect` (picture coordinates) is open.
    #[inline(always)]
    pub fn any(&self, rect: &Rect) -> bool {
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
