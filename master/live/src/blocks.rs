//! Bookkeeping of a still's blocks while it is drawn: which have all pixels, and which were sent. Pure.
//!
//! The protocol's tiles have edges on multiples of 16 pixels; the renderer's have edges anywhere. So a
//! block of 16x16 pixels is sent when all of its pixels have come.

use crate::tile::{BLOCK, Part, STILL_EDGE};
use slabcast_common::occlusion::Rect;

const EDGE: usize = BLOCK as usize;
/// Bytes of a pixel, RGB.
const DEPTH: usize = 3;

/// See the head of the file.
pub(crate) struct Blocks {
    size: [u32; 2],
    /// The picture, row by row; black where nothing came. Empty before the first tile.
    rgb: Vec<u8>,
    /// For each block, row by row from the top left: for each of its rows one bit a pixel that came.
    came: Vec<[u16; EDGE]>,
    sent: Vec<bool>,
    has_sent: bool,
    /// Blocks that are whole and were not sent.
    ready: usize,
    /// Whether other pixels came of a block that was sent.
    is_stale: bool,
}

impl Blocks {
    /// A picture of `size` (width, height) pixels of which nothing came.
    pub(crate) fn new(size: [u32; 2]) -> Blocks {
        let count = size.iter().map(|n| n.div_ceil(BLOCK) as usize).product();
        Blocks {
            size,
            rgb: Vec::new(),
            came: vec![[0; EDGE]; count],
            sent: vec![false; count],
            has_sent: false,
            ready: 0,
            is_stale: false,
        }
    }

    fn columns(&self) -> usize {
        self.size[0].div_ceil(BLOCK) as usize
    }

    /// Returns width and height of block (x, y); those at the right and lower border are smaller.
    fn extent(&self, [x, y]: [usize; 2]) -> [usize; 2] {
        let [w, h] = self.size.map(|n| n as usize);
        [(w - x * EDGE).min(EDGE), (h - y * EDGE).min(EDGE)]
    }

    fn is_whole(&self, [x, y]: [usize; 2]) -> bool {
        let [w, h] = self.extent([x, y]);
        let full = u16::MAX >> (EDGE - w);
        self.came[y * self.columns() + x][..h].iter().all(|row| *row == full)
    }

    /// Whether there are blocks to be sent.
    pub(crate) fn has_ready(&self) -> bool {
        self.ready > 0
    }

    /// Whether any block was sent.
    pub(crate) fn has_sent(&self) -> bool {
        self.has_sent
    }

    /// The picture as far as it came, in RGB.
    pub(crate) fn rgb(&self) -> &[u8] {
        &self.rgb
    }

    /// Adds the pixels of a tile, RGB row by row. One that is not of this picture is left out.
    pub(crate) fn add(&mut self, tile: Rect, rgb: &[u8]) {
        let inside = tile.intersect(&Rect::from_size(self.size)) == tile;
        if !inside || tile.area() == 0 || rgb.len() != tile.area() * DEPTH {
            return;
        }
        let width = self.size[0] as usize;
        if self.rgb.is_empty() {
            self.rgb = vec![0; width * self.size[1] as usize * DEPTH];
        }
        let [x0, y0, x1, y1] = [tile.x0, tile.y0, tile.x1, tile.y1].map(|n| n as usize);
        let columns = self.columns();
        for by in y0 / EDGE..y1.div_ceil(EDGE) {
            for bx in x0 / EDGE..x1.div_ceil(EDGE) {
                let was_whole = self.is_whole([bx, by]);
                let block = by * columns + bx;
                let (from, to) = (x0.max(bx * EDGE), x1.min((bx + 1) * EDGE));
                let bits = (u16::MAX >> (EDGE - (to - from))) << (from - bx * EDGE);
                for y in y0.max(by * EDGE)..y1.min((by + 1) * EDGE) {
                    let at = ((y - y0) * (x1 - x0) + from - x0) * DEPTH;
                    let new = &rgb[at..at + (to - from) * DEPTH];
                    let at = (y * width + from) * DEPTH;
                    let old = &mut self.rgb[at..at + new.len()];
                    self.is_stale |= self.sent[block] && old != new;
                    old.copy_from_slice(new);
                    self.came[block][y - by * EDGE] |= bits;
                }
                if !was_whole && self.is_whole([bx, by]) {
                    self.ready += 1;
                }
            }
        }
    }

    /// Returns the blocks that are whole and were not sent, merged, and notes them as sent.
    pub(crate) fn take(&mut self) -> Vec<Part> {
        if self.ready == 0 {
            return Vec::new();
        }
        let columns = self.columns();
        let is_ready = |i: usize| !self.sent[i] && self.is_whole([i % columns, i / columns]);
        let ready: Vec<bool> = (0..self.sent.len()).map(is_ready).collect();
        for (sent, ready) in self.sent.iter_mut().zip(&ready) {
            *sent |= ready;
        }
        (self.ready, self.has_sent) = (0, true);
        merged(self.size, ready)
    }

    /// Returns what is left to be sent of the finished picture `rgb`. `None`: what was sent is not in
    /// this picture, so that all of it has to be sent anew.
    pub(crate) fn rest(&self, rgb: &[u8]) -> Option<Vec<Part>> {
        if self.is_stale {
            return None;
        }
        let (columns, width) = (self.columns(), self.size[0] as usize);
        let is_true = |i: usize| {
            let [x, y] = [i % columns, i / columns];
            let [w, h] = self.extent([x, y]);
            (y * EDGE..y * EDGE + h).all(|row| {
                let at = (row * width + x * EDGE) * DEPTH;
                self.rgb[at..at + w * DEPTH] == rgb[at..at + w * DEPTH]
            })
        };
        let all_true = (0..self.sent.len()).all(|i| !self.sent[i] || is_true(i));
        all_true.then(|| merged(self.size, self.sent.iter().map(|sent| !sent).collect()))
    }
}

/// Merges the marked blocks of a picture into rectangles of at most [`STILL_EDGE`] pixels each way.
fn merged(size: [u32; 2], mut marked: Vec<bool>) -> Vec<Part> {
    let [columns, rows] = size.map(|n| n.div_ceil(BLOCK) as usize);
    let most = (STILL_EDGE / BLOCK) as usize;
    let mut parts = Vec::new();
    for i in 0..marked.len() {
        if !marked[i] {
            continue;
        }
        let (x, y) = (i % columns, i / columns);
        let run = |y: usize, most: usize| marked[y * columns + x..][..most].iter();
        let w = run(y, most.min(columns - x)).take_while(|marked| **marked).count();
        let is_full = |y: &usize| run(*y, w).all(|marked| *marked);
        let h = (y..rows.min(y + most)).take_while(is_full).count();
        for row in y..y + h {
            marked[row * columns + x..][..w].fill(false);
        }
        let [px, py, pw, ph] = [x, y, w, h].map(|n| n as u32 * BLOCK);
        parts.push(Part { x: px, y: py, w: pw.min(size[0] - px), h: ph.min(size[1] - py) });
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [u32; 2] = [300, 70];

    fn picture() -> Vec<u8> {
        (0..SIZE[0] * SIZE[1] * 3).map(|i| (i * 7 % 251) as u8).collect()
    }

    fn cut(rgb: &[u8], tile: Rect) -> Vec<u8> {
        let row = |y: i32| {
            let at = (y as usize * SIZE[0] as usize + tile.x0 as usize) * 3;
            rgb[at..at + tile.width() * 3].to_vec()
        };
        (tile.y0..tile.y1).flat_map(row).collect()
    }

    /// Counts how often each pixel of the picture is in `parts`, and checks their edges.
    fn counts(parts: &[Part]) -> Vec<u32> {
        let mut counts = vec![0; (SIZE[0] * SIZE[1]) as usize];
        for Part { x, y, w, h } in parts {
            let is_edge = |at: u32, end: u32| at.is_multiple_of(BLOCK) || at == end;
            assert!(is_edge(*x, 0) && is_edge(*y, 0));
            assert!(is_edge(x + w, SIZE[0]) && is_edge(y + h, SIZE[1]));
            assert!((1..=STILL_EDGE).contains(w) && (1..=STILL_EDGE).contains(h));
            for y in *y..y + h {
                for x in *x..x + w {
                    counts[(y * SIZE[0] + x) as usize] += 1;
                }
            }
        }
        counts
    }

    #[test]
    fn block_is_sent_once_all_of_its_pixels_came_and_the_rest_at_the_end() {
        let rgb = picture();
        let mut blocks = Blocks::new(SIZE);
        let add = |blocks: &mut Blocks, x0, y0, x1, y1| {
            let tile = Rect::new(x0, y0, x1, y1);
            blocks.add(tile, &cut(&rgb, tile));
        };
        add(&mut blocks, 0, 0, 40, 20);
        assert!(blocks.has_ready() && !blocks.has_sent());
        let first = blocks.take();
        assert_eq!(first, [Part { x: 0, y: 0, w: 32, h: 16 }]);
        assert!(blocks.take().is_empty() && !blocks.has_ready());
        // It ends the two blocks below, and begins others.
        add(&mut blocks, 0, 20, 40, 33);
        let second = blocks.take();
        assert_eq!(second, [Part { x: 0, y: 16, w: 32, h: 16 }]);
        // The right and lower border cut blocks.
        add(&mut blocks, 288, 66, 300, 70);
        assert!(blocks.take().is_empty());
        add(&mut blocks, 280, 50, 300, 66);
        let third = blocks.take();
        assert_eq!(third, [Part { x: 288, y: 64, w: 12, h: 6 }]);
        // Again, and the same: nothing is to be sent anew.
        add(&mut blocks, 0, 0, 40, 20);
        assert!(blocks.take().is_empty() && blocks.has_sent());
        let rest = blocks.rest(&rgb).expect("what was sent is true");
        let all = [first, second, third, rest].concat();
        assert!(counts(&all).iter().all(|n| *n == 1), "each pixel once");
    }

    #[test]
    fn picture_whose_sent_pixels_changed_is_sent_anew() {
        let rgb = picture();
        let tile = Rect::new(16, 16, 48, 32);
        let good = cut(&rgb, tile);
        let mut other = good.clone();
        other[5] ^= 1;
        // Before it is sent, a tile may be replaced.
        let mut blocks = Blocks::new(SIZE);
        blocks.add(tile, &other);
        blocks.add(tile, &good);
        assert_eq!(blocks.take(), [Part { x: 16, y: 16, w: 32, h: 16 }]);
        assert!(blocks.rest(&rgb).is_some());
        // Afterwards it may not, though it is true in the end.
        blocks.add(tile, &other);
        blocks.add(tile, &good);
        assert!(blocks.rest(&rgb).is_none());
        // Nor is it by the finished picture.
        let mut blocks = Blocks::new(SIZE);
        blocks.add(tile, &other);
        blocks.take();
        assert!(blocks.rest(&rgb).is_none());
    }

    #[test]
    fn whole_picture_is_merged_into_few_parts_and_foreign_tiles_are_left_out() {
        let mut blocks = Blocks::new(SIZE);
        blocks.add(Rect::new(290, 0, 306, 16), &[0; 16 * 16 * 3]);
        blocks.add(Rect::new(0, 0, 16, 16), &[0; 5]);
        assert!(!blocks.has_ready() && blocks.rgb().is_empty());
        let rest = blocks.rest(&picture()).expect("nothing was sent");
        assert_eq!(rest, [Part { x: 0, y: 0, w: 256, h: 70 }, Part { x: 256, y: 0, w: 44, h: 70 }]);
    }
}
