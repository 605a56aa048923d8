//! Pixels for results of tiles that nobody drew. A rehearsal sends them so that messages have the
//! recorded size; they look like noise, and the master marks the picture.

use slabcast_common::image::{LEAF_EDGE, PixelEncoding, SparseTile, TilePixels};
use slabcast_common::occlusion::Rect;

/// Returns pixels of a slab's tile: shut where `shut` says so, and filled until the result takes
/// about `bytes` on the wire. `shut` is row-major over a picture of `size` pixels.
///
/// # Panics
/// If `shut` does not cover the tile.
pub fn placeholder_slab(rect: &Rect, shut: &[bool], size: [u32; 2], bytes: u32) -> TilePixels {
    let n = rect.area();
    let mut pixels = TilePixels { a: Vec::with_capacity(n), colour: vec![[0; 3]; n], last: None };
    for y in rect.y0..rect.y1 {
        let row = y as usize * size[0] as usize;
        for x in rect.x0..rect.x1 {
            pixels.a.push(if shut[row + x as usize] { 1.0 } else { 0.0 });
        }
    }
    let closed = pixels.a.iter().filter(|a| **a > 0.0).count();
    // Planes leave out pixels that are zero, at a bit a pixel: 4, 12 and 16 bytes for those that
    // are not. Colour and sums go together, which is what a slab in the middle does.
    let left = (bytes as usize).saturating_sub(60 + 3 * n.div_ceil(8) + 4 * closed);
    let touched = (left / 28).min(n);
    // Open pixels with some opacity come first, so that all three planes have the same pixels.
    let extra = left.saturating_sub(28 * touched);
    let open = pixels.a.iter_mut().filter(|a| **a == 0.0);
    for a in open.take(extra / 4) {
        *a = 0.25;
    }
    let mut last = vec![[0; 4]; if touched > 0 { n } else { 0 }];
    for i in 0..touched {
        let word = (i as u32).wrapping_mul(0x9e37_79b9) | 1;
        pixels.colour[i] = [word & 0xffff | 1; 3];
        last[i] = [word; 4];
    }
    pixels.last = (touched > 0).then_some(last);
    pixels
}

/// Returns pixels of a tile through all sheets, as sums that take about `bytes` on the wire.
pub fn placeholder_sums(rect: &Rect, bytes: u32) -> TilePixels {
    let n = rect.area();
    let mut pixels = TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: None };
    // Two planes of 4 and 12 bytes a pixel, and a bit for each pixel of both.
    let left = (bytes as usize).saturating_sub(60 + 2 * n.div_ceil(8));
    for i in 0..(left / 16).min(n) {
        let word = (i as u32).wrapping_mul(0x9e37_79b9) & 0xffff | 1;
        pixels.a[i] = 0.25 + word as f32 * 1e-6;
        pixels.colour[i] = [word; 3];
    }
    pixels
}

/// Returns pixels of a tile through all sheets, finished, that take about `bytes` on the wire.
///
/// Leaves are filled one after another. Their bytes have no pattern, so that nothing packs them;
/// the rest of the last leaf is zeros, which pack to nearly nothing.
pub fn placeholder_finished(rect: &Rect, bytes: u32, finish: &PixelEncoding) -> SparseTile {
    let size = [rect.width() as u32, rect.height() as u32];
    let mut leaves = SparseTile::blank(size, finish.format);
    let left = (bytes as usize).saturating_sub(70 + leaves.mask.len());
    let columns = (size[0] as usize).div_ceil(LEAF_EDGE);
    for i in 0..columns * (size[1] as usize).div_ceil(LEAF_EDGE) {
        if SparseTile::data_len(size, finish.format, &leaves.mask) >= left {
            break;
        }
        leaves.mask[i / 8] |= 1 << (i % 8);
    }
    let mut x = 0x9e37_79b9_7f4a_7c15u64;
    let noise = std::iter::repeat_with(|| {
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        (x >> 32) as u8
    });
    leaves.data.extend(noise.take(left));
    leaves.data.resize(SparseTile::data_len(size, finish.format, &leaves.mask), 0);
    leaves.max_alpha = if left > 0 { 0.25 } else { 0.0 };
    leaves
}
