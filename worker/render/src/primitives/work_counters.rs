//! Work counts of the pixels of a picture.

use slabcast_common::occlusion::Rect;

/// Work counts of every pixel of a picture or tile, row-major, top row first.
#[derive(Clone, Debug, PartialEq)]
pub struct WorkCounters {
    pub(crate) width: usize,
    /// Number of the sheet after which each pixel was shut; `None` where it stayed open.
    pub shut_in: Vec<Option<i32>>,
    /// Number of sheets that held something at the pixel, up to the one in which it was shut.
    pub sheets: Vec<u32>,
    /// Number of voxel sections added at the pixel, up to the sheet in which it was shut.
    pub sections: Vec<u32>,
    /// Number of the first sheet that held something at any pixel.
    pub first: Option<i32>,
}

impl WorkCounters {
    /// Returns the counts of `width` times `height` pixels on which nothing was drawn.
    pub fn new([width, height]: [usize; 2]) -> WorkCounters {
        let n = width * height;
        WorkCounters {
            width,
            shut_in: vec![None; n],
            sheets: vec![0; n],
            sections: vec![0; n],
            first: None,
        }
    }

    /// Copies counts of the pixels `from` of `other` to those from `at` on.
    pub(crate) fn copy(&mut self, at: usize, other: &WorkCounters, from: std::ops::Range<usize>) {
        let to = at..at + from.len();
        self.shut_in[to.clone()].copy_from_slice(&other.shut_in[from.clone()]);
        self.sheets[to.clone()].copy_from_slice(&other.sheets[from.clone()]);
        self.sections[to].copy_from_slice(&other.sections[from]);
        self.first = [self.first, other.first].into_iter().flatten().min();
    }

    /// Puts the counts of a tile's pixels in their place.
    ///
    /// # Panics
    /// If `part` does not have the tile's size, or the tile lies outside.
    pub fn put(&mut self, tile: Rect, part: &WorkCounters) {
        for y in 0..tile.height() {
            let at = (tile.y0 as usize + y) * self.width + tile.x0 as usize;
            self.copy(at, part, y * part.width..(y + 1) * part.width);
        }
    }

    /// Counts a section that was added to the pixels of `rect`.
    pub(crate) fn add_section(&mut self, rect: Rect) {
        for y in rect.y0 as usize..rect.y1 as usize {
            for i in y * self.width + rect.x0 as usize..y * self.width + rect.x1 as usize {
                self.sections[i] += u32::from(self.shut_in[i].is_none());
            }
        }
    }

    /// Counts sheet `k`, which held something at pixel `i`, as composited there.
    pub(crate) fn add_sheet(&mut self, i: usize, k: i32, shut: bool) {
        self.sheets[i] += 1;
        self.first = Some(self.first.map_or(k, |first| first.min(k)));
        if shut {
            self.shut_in[i] = Some(k);
        }
    }
}
