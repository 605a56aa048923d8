//! A frame in the making.

use super::encode::{Encoder, PixelEncoding};
use super::picture::{Encoded, Picture, hash};
use super::sparse::{FrameAssembler, SparseTile};
use super::tile::{RawSums, TilePixels, TileState, draw};
use crate::occlusion::Rect;
use crate::volume::Digest32;
use sha2::{Digest, Sha256};

/// A frame while its tiles are rendered: slab after slab ([`FrameState::add_slab_tile`]), or each tile at once, as
/// sums ([`FrameState::place_sums`]) or finished ([`FrameState::place_encoded`]).
#[derive(Clone, Debug)]
pub struct FrameState {
    size: [u32; 2],
    /// Tiles that one task made whole, in the order in which they came; nothing was put where they are.
    laid: Vec<(Rect, TilePixels)>,
    /// Tiles that came finished, likewise. A frame that has some has no others.
    done: Vec<(Rect, SparseTile)>,
    /// Whether some of them were taken out ([`FrameState::take_encoded`]), and the largest opacity of all that came.
    taken: bool,
    done_most: f32,
    /// Of all pixels; none before something was put.
    a: Vec<f32>,
    colour: Vec<[u32; 3]>,
    /// Sums of the last sheet of the slab before this one; no pixels while all are zero, which they
    /// stay where one task goes through all sheets.
    last: Vec<RawSums>,
    /// Sums of the last sheet of this slab, as its tiles come in; likewise.
    next: Vec<RawSums>,
}

impl FrameState {
    /// What a pixel takes at most: A, three colours, and two sheets' sums.
    pub const BYTES_A_PIXEL: u64 = 4 + 12 + 2 * 16;

    /// Nothing drawn yet.
    pub fn new(size: [u32; 2]) -> Self {
        let (laid, done, taken, done_most, a, colour, last, next) = Default::default();
        FrameState { size, laid, done, taken, done_most, a, colour, last, next }
    }

    fn pixels(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }

    /// Width and height in pixels.
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// A of every pixel as the slabs that were put left it, row-major.
    pub fn opacities(&self) -> impl ExactSizeIterator<Item = f32> {
        (0..self.pixels()).map(|i| self.a.get(i).copied().unwrap_or(0.0))
    }

    /// The largest opacity of any pixel.
    pub fn max_alpha(&self) -> f32 {
        let laid = self.laid.iter().flat_map(|(_, tile)| &tile.a);
        self.a.iter().chain(laid).fold(self.done_most, |most, &a| a.max(most))
    }

    fn rows(&self, r: Rect) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
        let w = self.size[0] as usize;
        (r.y0..r.y1).map(move |y| {
            let row = y as usize * w;
            row + r.x0 as usize..row + r.x1 as usize
        })
    }

    /// What a task on `tile` starts from.
    pub fn tile_state(&self, tile: Rect) -> TileState {
        let mut a = Vec::with_capacity(tile.area());
        if self.a.is_empty() {
            a.resize(tile.area(), 0.0);
        } else {
            for row in self.rows(tile) {
                a.extend_from_slice(&self.a[row]);
            }
        }
        let mut last = Vec::new();
        if !self.last.is_empty() {
            last.reserve_exact(tile.area());
            for row in self.rows(tile) {
                last.extend_from_slice(&self.last[row]);
            }
        }
        let blank = last.iter().all(|s| *s == [0; 4]);
        TileState { a, last: (!blank).then_some(last) }
    }

    /// Takes in a task's result.
    ///
    /// # Panics
    /// If the planes do not have the tile's size; whoever talks to strangers checks before.
    pub fn add_slab_tile(&mut self, tile: Rect, pixels: &TilePixels) {
        let n = tile.area();
        assert!(pixels.a.len() == n && pixels.colour.len() == n, "planes of the tile's size");
        let w = tile.width();
        if self.a.is_empty() {
            self.a = vec![0.0; self.pixels()];
            self.colour = vec![[0; 3]; self.pixels()];
        }
        if pixels.last.is_some() && self.next.is_empty() {
            self.next = vec![[0; 4]; self.a.len()];
        }
        for (i, row) in self.rows(tile).enumerate() {
            let from = i * w..(i + 1) * w;
            self.a[row.clone()].copy_from_slice(&pixels.a[from.clone()]);
            for (to, c) in self.colour[row.clone()].iter_mut().zip(&pixels.colour[from.clone()]) {
                for ch in 0..3 {
                    to[ch] = to[ch].wrapping_add(c[ch]);
                }
            }
            if let Some(last) = &pixels.last {
                self.next[row].copy_from_slice(&last[from]);
            }
        }
    }

    /// Takes in a tile that one task drew through all sheets. Nothing is copied: its pixels are read
    /// when the picture is.
    ///
    /// # Panics
    /// As [`FrameState::add_slab_tile`], and if the tile leaves the picture.
    pub fn place_sums(&mut self, tile: Rect, pixels: TilePixels) {
        let n = tile.area();
        assert!(pixels.a.len() == n && pixels.colour.len() == n, "planes of the tile's size");
        assert!(tile.intersect(&Rect::from_size(self.size)) == tile, "inside the picture");
        self.laid.push((tile, pixels));
    }

    /// Takes in a tile that came finished.
    ///
    /// # Panics
    /// If its parts do not fit each other ([`SparseTile::check`]) or the tile, or if the tile leaves the
    /// picture.
    pub fn place_encoded(&mut self, tile: Rect, leaves: SparseTile) {
        let [w, h] = leaves.size.map(|n| n as usize);
        assert!([w, h] == [tile.width(), tile.height()], "leaves of the tile's size");
        assert_eq!(leaves.check(), Ok(()));
        assert!(tile.intersect(&Rect::from_size(self.size)) == tile, "inside the picture");
        self.done_most = self.done_most.max(leaves.max_alpha);
        self.done.push((tile, leaves));
    }

    /// Tiles that came finished and were not taken.
    pub fn encoded_tiles(&self) -> &[(Rect, SparseTile)] {
        &self.done
    }

    /// Takes them, for whoever lays them into the picture while others are drawn. The last ones stay for
    /// [`FrameState::encode_onto`].
    pub fn take_encoded(&mut self) -> Vec<(Rect, SparseTile)> {
        self.taken = true;
        std::mem::take(&mut self.done)
    }

    /// Ends a slab: what came in as last sums is what the next slab starts from. A pixel that
    /// no task touched had an empty last sheet.
    pub fn end_slab(&mut self) {
        std::mem::swap(&mut self.last, &mut self.next);
        self.next.fill([0; 4]);
    }

    /// The finished picture.
    ///
    /// # Panics
    /// If tiles came finished: sums can't be had from them.
    pub fn to_picture(&self) -> Picture {
        assert!(self.done.is_empty() && !self.taken, "tiles as sums");
        let mut pixels = Vec::with_capacity(self.pixels());
        self.each_row(|row| pixels.extend_from_slice(row));
        Picture { size: self.size, pixels }
    }

    /// The finished picture's bytes, and its hash if it is to be `hashed`, without a picture in between.
    ///
    /// # Panics
    /// If tiles came finished and it is to be hashed or some were taken, or some came in another format or as sums.
    pub fn encode(&self, finish: &PixelEncoding, hashed: bool) -> Encoded {
        assert!(!self.taken, "all tiles are here");
        if !self.done.is_empty() {
            assert!(!hashed, "the hash is of the linear picture");
            return self.encode_onto(FrameAssembler::new(self.size, finish));
        }
        let mut encoding = Encoding::new(self.pixels(), finish, hashed);
        self.each_row(|row| encoding.put(row));
        encoding.end()
    }

    /// The finished picture's bytes, where all tiles came finished and those that were taken are laid.
    ///
    /// # Panics
    /// If some came as sums, and as [`FrameAssembler::place`].
    pub fn encode_onto(&self, mut begun: FrameAssembler) -> Encoded {
        assert!(self.laid.is_empty() && self.a.is_empty(), "all tiles came finished");
        begun.place(&self.done);
        Encoded { sha256: None, bytes: begun.into_bytes() }
    }

    /// Makes the picture row by row, from the top.
    fn each_row(&self, mut take: impl FnMut(&[[f32; 4]])) {
        let width = self.size[0] as usize;
        let mut row = vec![[0.0; 4]; width];
        // By their first rows; those that have begun and not ended.
        let mut coming: Vec<&(Rect, TilePixels)> = self.laid.iter().collect();
        coming.sort_by_key(|(tile, _)| std::cmp::Reverse(tile.y0));
        let mut here: Vec<&(Rect, TilePixels)> = Vec::new();
        for y in 0..self.size[1] as usize {
            if self.a.is_empty() {
                row.fill([0.0; 4]);
            } else {
                let of = y * width..(y + 1) * width;
                draw(&mut row, &self.a[of.clone()], &self.colour[of]);
            }
            here.retain(|(tile, _)| y < tile.y1 as usize);
            while let Some(tile) = coming.pop_if(|(tile, _)| tile.y0 as usize <= y) {
                here.push(tile);
            }
            for (tile, pixels) in &here {
                let from = (y - tile.y0 as usize) * tile.width();
                let of = from..from + tile.width();
                let to = &mut row[tile.x0 as usize..tile.x1 as usize];
                draw(to, &pixels.a[of.clone()], &pixels.colour[of]);
            }
            take(&row);
        }
    }
}

/// A picture that is encoded, and perhaps hashed, as its pixels come.
struct Encoding {
    hash: Option<Sha256>,
    encoder: Encoder,
    bytes: Vec<u8>,
}

impl Encoding {
    fn new(pixels: usize, finish: &PixelEncoding, hashed: bool) -> Encoding {
        let bytes = Vec::with_capacity(pixels * finish.format.bytes());
        let encoder = Encoder::new(finish.format, finish.background);
        Encoding { hash: hashed.then(Sha256::new), encoder, bytes }
    }

    fn put(&mut self, pixels: &[[f32; 4]]) {
        if let Some(h) = &mut self.hash {
            hash(h, pixels);
        }
        self.encoder.put(pixels, &mut self.bytes);
    }

    fn end(self) -> Encoded {
        let sha256 = self.hash.map(|h| Digest32(h.finalize().into()));
        Encoded { sha256, bytes: self.bytes }
    }
}

#[cfg(test)]
mod tests {
    use super::super::encode::{Background, PixelFormat};
    use super::super::tile::COLOUR_UNIT;
    use super::*;

    #[test]
    fn a_frame_is_encoded_as_its_picture_is() {
        // Two portions and some, of every kind of pixel.
        let size = [90, 13];
        let mut f = FrameState::new(size);
        let (tile, mut x) = (Rect::new(7, 2, 83, 13), 7u32);
        let mut next = || {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            x >> 4
        };
        let n = tile.area();
        let a: Vec<f32> = (0..n).map(|i| [0.0, 1.0, next() as f32 * COLOUR_UNIT][i % 3]).collect();
        let colour = a.iter().map(|a| [0; 3].map(|_: u32| (next() as f32 * a) as u32)).collect();
        let pixels = TilePixels { a, colour, last: None };
        f.add_slab_tile(tile, &pixels);
        let picture = f.to_picture();
        let mut laid = FrameState::new(size);
        laid.place_sums(tile, pixels.clone());
        assert_eq!(laid.to_picture(), picture);
        for format in
            [PixelFormat::Rgb8, PixelFormat::Rgba8, PixelFormat::Rgba16, PixelFormat::Rgba32F]
        {
            for background in [Background::Transparent, Background::Colour([0.2, 0.5, 1.0])] {
                let finish = PixelEncoding { format, background };
                let encoded = f.encode(&finish, true);
                assert_eq!(encoded, laid.encode(&finish, true));
                assert_eq!(encoded.sha256, Some(picture.sha256()));
                assert_eq!(encoded.bytes, picture.encode(format, background));
                assert_eq!(encoded.bytes.len(), picture.pixels.len() * format.bytes());
            }
        }
    }

    #[test]
    fn tiles_lie_where_they_belong_in_whatever_order_they_come() {
        let size = [7, 5];
        // Edges of 3: whole tiles and cut ones, and one that never came.
        let tiles: Vec<Rect> = [(0, 0), (3, 0), (6, 0), (0, 3), (6, 3)]
            .map(|(x, y)| Rect::new(x, y, (x + 3).min(7), (y + 3).min(5)))
            .into();
        let mark = |x: i32, y: i32| (1 + x + 7 * y) as f32;
        let pixels = |t: &Rect| TilePixels {
            a: (t.y0..t.y1).flat_map(|y| (t.x0..t.x1).map(move |x| mark(x, y))).collect(),
            colour: vec![[1 << 28; 3]; t.area()],
            last: None,
        };
        for order in [[0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [2, 4, 0, 3, 1]] {
            let mut f = FrameState::new(size);
            order.iter().for_each(|&i| f.place_sums(tiles[i], pixels(&tiles[i])));
            let picture = f.to_picture();
            for (i, p) in picture.pixels.iter().enumerate() {
                let (x, y) = (i as i32 % 7, i as i32 / 7);
                let missing = (3..6).contains(&x) && y >= 3;
                let want = if missing { [0.0; 4] } else { [1.0, 1.0, 1.0, mark(x, y)] };
                assert_eq!(*p, want, "{x},{y}");
            }
        }
    }

    #[test]
    fn a_pixel_no_task_touched_has_no_last_sheet() {
        let mut f = FrameState::new([4, 2]);
        let tile = Rect::new(0, 0, 2, 2);
        let pixels = TilePixels {
            a: vec![0.5; 4],
            colour: vec![[1 << 27; 3]; 4],
            last: Some(vec![[7; 4]; 4]),
        };
        f.add_slab_tile(tile, &pixels);
        f.end_slab();
        assert_eq!(f.tile_state(tile).last, Some(vec![[7; 4]; 4]));
        f.end_slab();
        assert_eq!(f.tile_state(tile).last, None);
        assert_eq!(f.tile_state(tile).a, vec![0.5; 4]);
        f.add_slab_tile(tile, &pixels);
        assert_eq!(f.to_picture().pixels[0], [1.0, 1.0, 1.0, 0.5]);
        assert_eq!(f.to_picture().pixels[3], [0.0; 4]);
    }
}
