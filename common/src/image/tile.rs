//! Pixels of one tile while its frame is drawn: what a task starts from and what it adds.

use crate::occlusion::Rect;

/// Unit of fixed-point premultiplied colour: 2^-28 of full intensity.
pub const COLOUR_UNIT: f32 = 1.0 / (1u32 << 28) as f32;

/// Edge of a leaf in pixels: the smallest macrotile, and the unit in which finished tiles are
/// sparse. With 8 pixels, four times as many leaves are tested to save rims of empty ones, which
/// compress to almost nothing anyway.
pub const LEAF_EDGE: usize = 16;

/// Raw sums of one sheet at one pixel: extinction and three extinction-weighted colours, as bits of
/// i32, or of f32 in scenes with f32 sums.
pub type RawSums = [u32; 4];

/// Pixels that a slab task starts from, as the slabs in front left them.
#[derive(Clone, Debug, PartialEq)]
pub struct TileState {
    /// Accumulated opacity A of each pixel, 0 to 1, row-major in the tile.
    pub a: Vec<f32>,
    /// Raw sums of the last sheet in front of the slab; `None` if all are zero.
    pub last: Option<Vec<RawSums>>,
}

/// Pixels of a finished task: its slab image as a continuation (opacity, colour added, last sheet's
/// sums), row-major in the tile.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TilePixels {
    /// Accumulated opacity A behind the slab, row-major in the tile.
    pub a: Vec<f32>,
    /// Premultiplied linear colour (RGB) that the slab adds, in units of [`COLOUR_UNIT`], row-major
    /// in the tile.
    pub colour: Vec<[u32; 3]>,
    /// Raw sums of the slab's last sheet; `None` if all are zero.
    pub last: Option<Vec<RawSums>>,
}

/// Returns linear premultiplied RGBA.
#[inline(always)]
pub(crate) fn finished(a: f32, colour: [u32; 3]) -> [f32; 4] {
    let [r, g, b] = colour;
    [r as f32 * COLOUR_UNIT, g as f32 * COLOUR_UNIT, b as f32 * COLOUR_UNIT, a]
}

impl TilePixels {
    /// Returns the pixels of `piece`, a rectangle inside `tile`; `self` has the pixels of `tile`.
    ///
    /// # Panics
    /// If the piece is not inside the tile.
    pub fn crop(&self, tile: Rect, piece: Rect) -> TilePixels {
        fn rows<T: Copy>(plane: &[T], tile: Rect, piece: Rect) -> Vec<T> {
            let from = (piece.x0 - tile.x0) as usize;
            let rows = plane.chunks(tile.width()).skip((piece.y0 - tile.y0) as usize);
            let rows = rows.take(piece.height()).map(|row| &row[from..from + piece.width()]);
            rows.flatten().copied().collect()
        }
        assert_eq!(tile.union(&piece), tile, "a piece lies in its tile");
        TilePixels {
            a: rows(&self.a, tile, piece),
            colour: rows(&self.colour, tile, piece),
            last: self.last.as_ref().map(|last| rows(last, tile, piece)),
        }
    }

    /// Writes the pixels into a picture of `size` (width, height): row-major linear premultiplied
    /// RGBA. `tile` says where; one slab made the pixels.
    ///
    /// # Panics
    /// If the tile leaves the picture.
    pub fn write(&self, tile: Rect, size: [u32; 2], pixels: &mut [[f32; 4]]) {
        for (y, (a, colour)) in
            self.a.chunks(tile.width()).zip(self.colour.chunks(tile.width())).enumerate()
        {
            let row = (tile.y0 as usize + y) * size[0] as usize + tile.x0 as usize;
            draw(&mut pixels[row..row + a.len()], a, colour);
        }
    }
}

/// Writes a run of pixels as linear premultiplied RGBA.
pub(super) fn draw(row: &mut [[f32; 4]], a: &[f32], colour: &[[u32; 3]]) {
    for ((to, &a), &colour) in row.iter_mut().zip(a).zip(colour) {
        *to = finished(a, colour);
    }
}
