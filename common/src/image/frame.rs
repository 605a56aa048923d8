//! A frame in the making.
//!
//! Tiles come in one of three ways: slab after slab ([`FrameState::add_slab_tile`]), whole as sums
//! ([`FrameState::place_sums`]), or whole and encoded ([`FrameState::place_encoded`]).

use super::encode::{Encoder, PixelEncoding};
use super::picture::{Encoded, Picture, hash};
use super::sparse::{FrameAssembler, SparseTile};
use super::tile::{RawSums, TilePixels, TileState, draw};
use crate::occlusion::Rect;
use crate::volume::Digest32;
use sha2::{Digest, Sha256};

/// A frame while its tiles are rendered.
#[derive(Clone, Debug)]
pub struct FrameState {
    size: [u32; 2],
    /// Tiles that one task drew through all sheets, as sums, in order of arrival. Nothing else was
    /// added at their pixels.
    sums_tiles: Vec<(Rect, TilePixels)>,
    /// Tiles that came encoded, in order of arrival. A frame with encoded tiles has no others.
    encoded: Vec<(Rect, SparseTile)>,
    /// Whether encoded tiles were taken out ([`FrameState::take_encoded`]).
    taken: bool,
    /// Largest opacity of all encoded tiles that came.
    encoded_max_alpha: f32,
    /// Opacity of all pixels; empty before the first slab tile.
    a: Vec<f32>,
    colour: Vec<[u32; 3]>,
    /// Raw sums of the last sheet of the slab before this one. Empty while all are zero, which they
    /// stay where one task goes through all sheets.
    last: Vec<RawSums>,
    /// Raw sums of the last sheet of this slab, as its tiles come in; empty while all are zero.
    next: Vec<RawSums>,
}

impl FrameState {
    /// Largest number of bytes that a pixel takes: opacity, three colours, and the sums of two
    /// sheets.
    pub const BYTES_A_PIXEL: u64 = 4 + 12 + 2 * 16;

    /// Returns an empty frame of `size` (width, height) pixels.
    pub fn new(size: [u32; 2]) -> Self {
        let (sums_tiles, encoded, taken, encoded_max_alpha) = Default::default();
        let (a, colour, last, next) = Default::default();
        FrameState { size, sums_tiles, encoded, taken, encoded_max_alpha, a, colour, last, next }
    }

    fn pixels(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }

    /// Returns width and height of the picture in pixels.
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// Returns the accumulated opacity of every pixel behind the slabs added so far, row-major.
    pub fn opacities(&self) -> impl ExactSizeIterator<Item = f32> {
        (0..self.pixels()).map(|i| self.a.get(i).copied().unwrap_or(0.0))
    }

    /// Returns the largest opacity of any pixel, 0 to 1.
    pub fn max_alpha(&self) -> f32 {
        let laid = self.sums_tiles.iter().flat_map(|(_, tile)| &tile.a);
        self.a.iter().chain(laid).fold(self.encoded_max_alpha, |most, &a| a.max(most))
    }

    /// Returns the index range of each row of a rectangle.
    fn rows(&self, r: Rect) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
        let w = self.size[0] as usize;
        (r.y0..r.y1).map(move |y| {
            let row = y as usize * w;
            row + r.x0 as usize..row + r.x1 as usize
        })
    }

    /// Returns what a slab task on `tile` starts from.
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

    /// Adds the result of a slab task on `tile`.
    ///
    /// # Panics
    /// If the planes don't have the tile's size; whoever reads from a network checks first.
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

    /// Adds a tile that one task drew through all sheets. Its pixels are not copied but read when
    /// the picture is made.
    ///
    /// # Panics
    /// If the planes don't have the tile's size, or the tile leaves the picture.
    pub fn place_sums(&mut self, tile: Rect, pixels: TilePixels) {
        let n = tile.area();
        assert!(pixels.a.len() == n && pixels.colour.len() == n, "planes of the tile's size");
        assert!(tile.intersect(&Rect::from_size(self.size)) == tile, "inside the picture");
        self.sums_tiles.push((tile, pixels));
    }

    /// Adds a tile whose pixels its worker encoded.
    ///
    /// # Panics
    /// If its parts don't fit each other ([`SparseTile::check`]) or the tile, or the tile leaves
    /// the picture.
    pub fn place_encoded(&mut self, tile: Rect, leaves: SparseTile) {
        let [w, h] = leaves.size.map(|n| n as usize);
        assert!([w, h] == [tile.width(), tile.height()], "leaves of the tile's size");
        assert_eq!(leaves.check(), Ok(()));
        assert!(tile.intersect(&Rect::from_size(self.size)) == tile, "inside the picture");
        self.encoded_max_alpha = self.encoded_max_alpha.max(leaves.max_alpha);
        self.encoded.push((tile, leaves));
    }

    /// Returns the encoded tiles that were not taken out.
    pub fn encoded_tiles(&self) -> &[(Rect, SparseTile)] {
        &self.encoded
    }

    /// Takes out the encoded tiles, so that they can be placed while others are still drawn. Tiles
    /// that come later stay for [`FrameState::encode_onto`].
    pub fn take_encoded(&mut self) -> Vec<(Rect, SparseTile)> {
        self.taken = true;
        std::mem::take(&mut self.encoded)
    }

    /// Ends a slab: the last sums that came in are where the next slab starts. A pixel that no task
    /// touched had an empty last sheet.
    pub fn end_slab(&mut self) {
        std::mem::swap(&mut self.last, &mut self.next);
        self.next.fill([0; 4]);
    }

    /// Returns the finished picture in linear light.
    ///
    /// # Panics
    /// If tiles came encoded: linear light can't be had from them.
    pub fn to_picture(&self) -> Picture {
        assert!(self.encoded.is_empty() && !self.taken, "tiles as sums");
        let mut pixels = Vec::with_capacity(self.pixels());
        self.each_row(|row| pixels.extend_from_slice(row));
        Picture { size: self.size, pixels }
    }

    /// Returns the finished picture's bytes, and its hash if `hashed`, without a picture in
    /// between.
    ///
    /// # Panics
    /// If tiles came encoded and `hashed` is set or some were taken out; or if some came in another
    /// format or as sums.
    pub fn encode(&self, finish: &PixelEncoding, hashed: bool) -> Encoded {
        assert!(!self.taken, "all tiles are here");
        if !self.encoded.is_empty() {
            assert!(!hashed, "the hash is of the linear picture");
            return self.encode_onto(FrameAssembler::new(self.size, finish));
        }
        let mut encoding = Encoding::new(self.pixels(), finish, hashed);
        self.each_row(|row| encoding.put(row));
        encoding.end()
    }

    /// Places the remaining encoded tiles into `assembler`, which has those that were taken out,
    /// and returns its bytes.
    ///
    /// # Panics
    /// If some tiles came as sums, and as [`FrameAssembler::place`].
    pub fn encode_onto(&self, mut assembler: FrameAssembler) -> Encoded {
        assert!(self.sums_tiles.is_empty() && self.a.is_empty(), "all tiles came finished");
        assembler.place(&self.encoded);
        Encoded { sha256: None, bytes: assembler.into_bytes() }
    }

    /// Makes the picture row by row from the top.
    fn each_row(&self, mut take: impl FnMut(&[[f32; 4]])) {
        let width = self.size[0] as usize;
        let mut row = vec![[0.0; 4]; width];
        // By their first rows; those that have begun and not ended.
        let mut coming: Vec<&(Rect, TilePixels)> = self.sums_tiles.iter().collect();
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

/// A picture that is encoded, and perhaps hashed, as its rows come.
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
    fn encode_gives_the_bytes_and_hash_of_the_picture() {
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
    fn tiles_are_placed_right_in_any_order_of_arrival() {
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
    fn pixels_without_a_task_start_the_next_slab_from_zero_sums() {
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
