//! Finished pixels of a tile without the leaves that show nothing but the background.
//!
//! Sums take 16 bytes a pixel, a finished pixel in 8-bit sRGB takes 3, and clients get finished
//! pixels alone. So where nobody asks for the hash of the linear picture, workers encode their
//! tiles themselves. They use the master's own code ([`Encoder`]), pixel by pixel, so the bytes are
//! the same. A leaf of 16x16 pixels whose every byte is that of a pixel without a volume is left
//! out, whatever its sums are: what is put back in its place is the same.

use super::encode::{Encoder, PixelEncoding, PixelFormat};
use super::tile::{LEAF_EDGE, TilePixels};
use crate::occlusion::Rect;

/// Encoded pixels of a tile, without its blank leaves.
#[derive(Clone, Debug, PartialEq)]
pub struct SparseTile {
    /// Width and height of the tile in pixels.
    pub size: [u32; 2],
    /// Format of the tile's encoded pixels.
    pub format: PixelFormat,
    /// One bit for each leaf, row-major: whether the leaf is present. Leaf i is bit i % 8 of byte i
    /// / 8. The tile cuts leaves at its right and bottom edge.
    pub mask: Vec<u8>,
    /// Pixels of the present leaves, one leaf after the other, row-major in each.
    pub data: Vec<u8>,
    /// Largest opacity of any pixel of the tile, 0 to 1.
    pub max_alpha: f32,
}

/// Why the parts of a [`SparseTile`] don't fit each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SparseTileError {
    /// The mask has not one bit for each leaf of the tile.
    #[error("a mask that is not of its tile")]
    MaskLength,
    /// The mask marks a leaf outside of the tile.
    #[error("a leaf beyond its tile")]
    LeafBeyondTile,
    /// The data have not the bytes of the marked leaves.
    #[error("more or fewer bytes than its leaves have")]
    DataLength,
    /// The largest opacity is infinite or NaN.
    #[error("an opacity that is not finite")]
    Opacity,
}

impl From<SparseTileError> for String {
    fn from(error: SparseTileError) -> String {
        error.to_string()
    }
}

/// Returns the leaves of a tile of `size` pixels in order, each as its columns and its rows.
fn leaves(size: [u32; 2]) -> impl Iterator<Item = [std::ops::Range<usize>; 2]> {
    let [w, h] = size.map(|n| n as usize);
    let cut = |at: usize, end: usize| at..(at + LEAF_EDGE).min(end);
    (0..h)
        .step_by(LEAF_EDGE)
        .flat_map(move |y| (0..w).step_by(LEAF_EDGE).map(move |x| [cut(x, w), cut(y, h)]))
}

/// Returns the largest opacity, or 0. Eight maxima at once, since a single chain would wait for
/// each comparison.
fn most(a: &[f32]) -> f32 {
    let (eights, rest) = a.as_chunks::<8>();
    let mut most = [0.0f32; 8];
    for eight in eights {
        for (most, a) in most.iter_mut().zip(eight) {
            *most = if *a > *most { *a } else { *most };
        }
    }
    most.iter().chain(rest).fold(0.0, |most, &a| a.max(most))
}

fn there(mask: &[u8], leaf: usize) -> bool {
    mask.get(leaf / 8).is_some_and(|byte| byte >> (leaf % 8) & 1 == 1)
}

impl SparseTile {
    /// Encodes a tile of `size` pixels (width, height) that went through all sheets.
    ///
    /// # Panics
    /// If the planes don't have the tile's size.
    pub fn encode(pixels: &TilePixels, size: [u32; 2], finish: &PixelEncoding) -> SparseTile {
        let width = size[0] as usize;
        let n = width * size[1] as usize;
        assert!(pixels.a.len() == n && pixels.colour.len() == n, "planes of the tile's size");
        let encoder = Encoder::new(finish.format, finish.background);
        let blank = finish.blank().repeat(LEAF_EDGE * LEAF_EDGE);
        let mut mask = vec![0; SparseTile::mask_len(size)];
        let mut data = Vec::new();
        for (i, [xs, ys]) in leaves(size).enumerate() {
            let row = |y: usize| {
                let row = y * width + xs.start..y * width + xs.end;
                (&pixels.a[row.clone()], &pixels.colour[row])
            };
            let from = data.len();
            encoder.put_sums(ys.map(row), &mut data);
            if data[from..] == blank[..data.len() - from] {
                data.truncate(from);
            } else {
                mask[i / 8] |= 1 << (i % 8);
            }
        }
        SparseTile { size, format: finish.format, mask, data, max_alpha: most(&pixels.a) }
    }

    /// Returns a tile without a leaf: all of it shows the background.
    pub fn blank(size: [u32; 2], format: PixelFormat) -> SparseTile {
        let mask = vec![0; SparseTile::mask_len(size)];
        SparseTile { size, format, mask, data: Vec::new(), max_alpha: 0.0 }
    }

    /// Returns the bytes of the mask of a tile of `size` pixels.
    pub fn mask_len(size: [u32; 2]) -> usize {
        let [columns, rows] = size.map(|n| (n as usize).div_ceil(LEAF_EDGE));
        (columns * rows).div_ceil(8)
    }

    /// Returns the bytes of the pixels of the leaves in `mask`; at most those of the whole tile.
    pub fn data_len(size: [u32; 2], format: PixelFormat, mask: &[u8]) -> usize {
        let leaves = leaves(size).enumerate().filter(|(i, _)| there(mask, *i));
        format.bytes() * leaves.map(|(_, [xs, ys])| xs.len() * ys.len()).sum::<usize>()
    }

    /// Returns the number of pixels of the tile.
    pub fn pixels(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }

    /// Checks that the parts fit each other.
    ///
    /// # Errors
    /// Names the part that does not fit.
    pub fn check(&self) -> Result<(), SparseTileError> {
        let leaves = leaves(self.size).count();
        if self.mask.len() != SparseTile::mask_len(self.size) {
            return Err(SparseTileError::MaskLength);
        }
        if (leaves..8 * self.mask.len()).any(|i| there(&self.mask, i)) {
            return Err(SparseTileError::LeafBeyondTile);
        }
        if self.data.len() != SparseTile::data_len(self.size, self.format, &self.mask) {
            return Err(SparseTileError::DataLength);
        }
        if !self.max_alpha.is_finite() {
            return Err(SparseTileError::Opacity);
        }
        Ok(())
    }

    /// Writes the present leaves into the rows of a picture of `width` pixels; `tile` says where.
    ///
    /// # Panics
    /// If the parts don't fit each other, or the tile leaves the picture.
    fn write(&self, tile: Rect, width: usize, picture: &mut [u8]) {
        let bytes = self.format.bytes();
        let mut data = &self.data[..];
        for (_, [xs, ys]) in leaves(self.size).enumerate().filter(|(i, _)| there(&self.mask, *i)) {
            for y in ys {
                let (row, rest) = data.split_at(xs.len() * bytes);
                let at = (tile.y0 as usize + y) * width + tile.x0 as usize + xs.start;
                picture[at * bytes..at * bytes + row.len()].copy_from_slice(row);
                data = rest;
            }
        }
    }
}

/// A picture that encoded tiles are placed into. Where none was placed it shows the background.
#[derive(Clone, Debug)]
pub struct FrameAssembler {
    format: PixelFormat,
    width: usize,
    picture: Vec<u8>,
}

impl FrameAssembler {
    /// Returns a picture of `size` (width, height) that shows nothing but the background.
    pub fn new(size: [u32; 2], finish: &PixelEncoding) -> FrameAssembler {
        let [width, height] = size.map(|n| n as usize);
        let blank = finish.blank();
        let picture = if blank.iter().all(|b| *b == blank[0]) {
            vec![blank[0]; width * height * blank.len()]
        } else {
            blank.repeat(width * height)
        };
        FrameAssembler { format: finish.format, width, picture }
    }

    /// Places tiles at their rectangles in the picture.
    ///
    /// # Panics
    /// If a tile has another format, its parts don't fit each other, or it leaves the picture.
    pub fn place(&mut self, tiles: &[(Rect, SparseTile)]) {
        for (tile, leaves) in tiles {
            assert!(leaves.format == self.format, "a frame has one format");
            leaves.write(*tile, self.width, &mut self.picture);
        }
    }

    /// Returns the picture's bytes, row-major from the top left.
    pub fn into_bytes(self) -> Vec<u8> {
        self.picture
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::{Background, COLOUR_UNIT, FrameState};

    const FORMATS: [PixelFormat; 4] =
        [PixelFormat::Rgb8, PixelFormat::Rgba8, PixelFormat::Rgba16, PixelFormat::Rgba32F];

    /// Pixels of every kind, some leaves without any; the last pixels of a leaf are almost nothing.
    fn pixels(tile: Rect, seed: u32) -> TilePixels {
        let mut x = seed;
        let mut next = move || {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            x >> 4
        };
        let (mut a, mut colour) = (Vec::new(), Vec::new());
        for y in 0..tile.height() {
            for x in 0..tile.width() {
                let there = match (x / LEAF_EDGE + y / LEAF_EDGE) % 4 {
                    0 => 0.0,
                    1 => 1.0,
                    2 => [0.0, 1.0, next() as f32 * COLOUR_UNIT][(x + y) % 3],
                    // Rounds to the background in 8 bits.
                    _ => 1e-7,
                };
                a.push(there);
                colour.push([0; 3].map(|_: u32| (next() as f32 * there) as u32));
            }
        }
        TilePixels { a, colour, last: None }
    }

    #[test]
    fn tiles_encoded_by_workers_make_the_bytes_of_the_masters_picture() {
        let size = [90, 61];
        let tiles = [
            Rect::new(0, 0, 64, 32),
            Rect::new(64, 0, 90, 32),
            Rect::new(0, 32, 64, 61),
            // One that never came: (64, 32) to (90, 61); and one that lies over it in part.
            Rect::new(70, 40, 75, 59),
        ];
        for format in FORMATS {
            for background in [
                Background::Transparent,
                Background::Colour([0.0; 3]),
                Background::Colour([0.2, 0.5, 1.0]),
            ] {
                let finish = PixelEncoding { format, background };
                let (mut sums, mut done) = (FrameState::new(size), FrameState::new(size));
                let (mut left_out, mut all) = (0, 0);
                for (tile, seed) in tiles.into_iter().zip(1..) {
                    let pixels = pixels(tile, seed);
                    let size = [tile.width() as u32, tile.height() as u32];
                    let leaves = SparseTile::encode(&pixels, size, &finish);
                    assert_eq!(leaves.check(), Ok(()));
                    assert_eq!(leaves.pixels(), tile.area());
                    left_out += tile.area() - leaves.data.len() / format.bytes();
                    all += tile.area();
                    sums.place_sums(tile, pixels);
                    done.place_encoded(tile, leaves);
                }
                assert!(left_out > all / 8 && left_out < all, "{left_out} of {all} pixels");
                let want = sums.encode(&finish, true);
                assert_eq!(want.bytes, sums.to_picture().encode(format, background));
                assert_eq!(want.sha256, Some(sums.to_picture().sha256()));
                let plain = sums.encode(&finish, false);
                assert_eq!((plain.bytes, plain.sha256), (want.bytes.clone(), None));
                let composed = done.encode(&finish, false);
                assert_eq!((composed.bytes, composed.sha256), (want.bytes, None));
                assert_eq!(done.max_alpha(), sums.max_alpha());
            }
        }
    }

    #[test]
    fn a_frame_without_tiles_is_background() {
        let finish = PixelEncoding {
            format: PixelFormat::Rgb8,
            background: Background::Colour([1.0, 0.5, 0.0]),
        };
        let state = FrameState::new([33, 5]);
        assert_eq!(state.encode(&finish, false).bytes, state.encode(&finish, true).bytes);
        let mut laid = FrameState::new([33, 5]);
        let tile = Rect::new(0, 0, 33, 5);
        laid.place_encoded(tile, SparseTile::blank([33, 5], PixelFormat::Rgb8));
        assert_eq!(laid.encode(&finish, false).bytes, state.encode(&finish, true).bytes);
    }

    #[test]
    fn sparse_tile_check_names_the_part_that_does_not_fit() {
        let tile = Rect::new(0, 0, 40, 20);
        let finish =
            PixelEncoding { format: PixelFormat::Rgba8, background: Background::Transparent };
        let good = SparseTile::encode(&pixels(tile, 3), [40, 20], &finish);
        assert_eq!(good.mask.len(), 1, "six leaves");
        let broken = |change: fn(&mut SparseTile)| {
            let mut leaves = good.clone();
            change(&mut leaves);
            leaves.check().unwrap_err()
        };
        assert_eq!(broken(|l| l.mask.push(0)), SparseTileError::MaskLength);
        assert_eq!(broken(|l| l.mask[0] |= 1 << 6), SparseTileError::LeafBeyondTile);
        assert_eq!(broken(|l| l.data.truncate(1)), SparseTileError::DataLength);
        assert_eq!(broken(|l| l.mask[0] ^= 1), SparseTileError::DataLength);
        assert_eq!(broken(|l| l.max_alpha = f32::NAN), SparseTileError::Opacity);
        assert_eq!(broken(|l| l.format = PixelFormat::Rgb8), SparseTileError::DataLength);
    }
}
