//! Pictures in the making and finished ones.
//!
//! A slab image is a continuation, not a picture of its own (DESIGN.md section 1): a task gets
//! its tile's A and the last sheet's raw sums and goes on; its colour is fixed point and is
//! added to what stood there. So any cut into slabs and tiles gives the same integers.

use crate::math::{linear_from_srgb, srgb_from_linear};
use crate::occlusion::Rect;
use crate::volume::Digest32;
use sha2::{Digest, Sha256};

/// Unit of fixed-point premultiplied colour.
pub const COLOUR_UNIT: f32 = 1.0 / (1u32 << 28) as f32;

/// Raw sums of one sheet at one pixel: extinction and the three sigma-weighted colours, as
/// bits (of i32, or of f32 when the scene's sums are f32).
pub type RawSums = [u32; 4];

/// What a task starts from: its tile's pixels as the slabs before left them.
#[derive(Clone, Debug, PartialEq)]
pub struct TileState {
    /// A, accumulated opacity, row-major in the tile.
    pub a: Vec<f32>,
    /// Raw sums of the last sheet before the slab; `None` when they are all zero.
    pub last: Option<Vec<RawSums>>,
}

/// What a task gives back.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TilePixels {
    /// A after the slab, row-major in the tile.
    pub a: Vec<f32>,
    /// Premultiplied colour that the slab adds, in units of [`COLOUR_UNIT`].
    pub colour: Vec<[u32; 3]>,
    /// Raw sums of the slab's last sheet; `None` when they are all zero.
    pub last: Option<Vec<RawSums>>,
}

/// A finished pixel: linear premultiplied RGBA.
#[inline(always)]
fn finished(a: f32, colour: [u32; 3]) -> [f32; 4] {
    let [r, g, b] = colour.map(|c| c as f32 * COLOUR_UNIT);
    [r, g, b, a]
}

impl TilePixels {
    /// Writes the pixels of `tile`, which one slab made, into the rows of a picture of `size`.
    ///
    /// # Panics
    /// If the tile leaves the picture.
    pub fn write(&self, tile: Rect, size: [u32; 2], pixels: &mut [[f32; 4]]) {
        for (y, (a, colour)) in
            self.a.chunks(tile.width()).zip(self.colour.chunks(tile.width())).enumerate()
        {
            let row = (tile.y0 as usize + y) * size[0] as usize + tile.x0 as usize;
            for ((to, &a), &colour) in pixels[row..row + a.len()].iter_mut().zip(a).zip(colour) {
                *to = finished(a, colour);
            }
        }
    }
}

/// A frame while its slabs are rendered.
#[derive(Clone, Debug)]
pub struct FrameState {
    size: [u32; 2],
    a: Vec<f32>,
    colour: Vec<[u32; 3]>,
    /// Sums of the last sheet of the slab before this one.
    last: Vec<RawSums>,
    /// Sums of the last sheet of this slab, as its tiles come in.
    next: Vec<RawSums>,
}

impl FrameState {
    /// What a pixel takes: A, three colours, and two sheets' sums.
    pub const BYTES_A_PIXEL: u64 = 4 + 12 + 2 * 16;

    /// Nothing drawn yet.
    pub fn new(size: [u32; 2]) -> Self {
        let n = size[0] as usize * size[1] as usize;
        FrameState {
            size,
            a: vec![0.0; n],
            colour: vec![[0; 3]; n],
            last: vec![[0; 4]; n],
            next: vec![[0; 4]; n],
        }
    }

    /// Width and height in pixels.
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// A of every pixel, row-major.
    pub fn a(&self) -> &[f32] {
        &self.a
    }

    fn rows(&self, r: Rect) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
        let w = self.size[0] as usize;
        (r.y0..r.y1).map(move |y| {
            let row = y as usize * w;
            row + r.x0 as usize..row + r.x1 as usize
        })
    }

    /// What a task on `tile` starts from.
    pub fn tile(&self, tile: Rect) -> TileState {
        let mut a = Vec::with_capacity(tile.area());
        let mut last = Vec::with_capacity(tile.area());
        for row in self.rows(tile) {
            a.extend_from_slice(&self.a[row.clone()]);
            last.extend_from_slice(&self.last[row]);
        }
        let blank = last.iter().all(|s| *s == [0; 4]);
        TileState { a, last: (!blank).then_some(last) }
    }

    /// Takes in a task's result.
    ///
    /// # Panics
    /// If the planes do not have the tile's size; whoever talks to strangers checks before.
    pub fn put(&mut self, tile: Rect, pixels: &TilePixels) {
        let n = tile.area();
        assert!(pixels.a.len() == n && pixels.colour.len() == n, "planes of the tile's size");
        let w = tile.width();
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

    /// Ends a slab: what came in as last sums is what the next slab starts from. A pixel that
    /// no task touched had an empty last sheet.
    pub fn end_slab(&mut self) {
        std::mem::swap(&mut self.last, &mut self.next);
        self.next.fill([0; 4]);
    }

    /// The finished picture.
    pub fn finish(&self) -> Picture {
        let pixels = self.a.iter().zip(&self.colour).map(|(&a, &c)| finished(a, c)).collect();
        Picture { size: self.size, pixels }
    }
}

/// A finished picture: linear premultiplied RGBA, row-major from the top left, before any
/// background.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Linear premultiplied RGBA.
    pub pixels: Vec<[f32; 4]>,
}

/// What lies behind the volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Background {
    /// Nothing: the picture has straight alpha.
    Transparent,
    /// A colour, sRGB numbers in `[0, 1]`.
    Colour([f64; 3]),
}

/// How pixels leave the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelFormat {
    /// 8-bit sRGB over the background.
    Rgb8,
    /// 8-bit sRGB, straight alpha (opaque over a background).
    Rgba8,
    /// 16-bit sRGB, straight alpha, little endian.
    Rgba16,
    /// Linear premultiplied floats, little endian, without background.
    Rgba32F,
}

impl PixelFormat {
    /// Bytes a pixel.
    pub fn bytes(self) -> usize {
        match self {
            PixelFormat::Rgb8 => 3,
            PixelFormat::Rgba8 => 4,
            PixelFormat::Rgba16 => 8,
            PixelFormat::Rgba32F => 16,
        }
    }
}

impl Picture {
    /// The hash of CONTRACTS.md: over row-major linear premultiplied RGBA f32, little endian.
    pub fn sha256(&self) -> Digest32 {
        let mut h = Sha256::new();
        for chunk in self.pixels.chunks(4096) {
            let bytes: Vec<u8> = chunk.iter().flatten().flat_map(|x| x.to_le_bytes()).collect();
            h.update(bytes);
        }
        Digest32(h.finalize().into())
    }

    /// The pixels in `format`.
    pub fn encode(&self, format: PixelFormat, background: Background) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.pixels.len() * format.bytes());
        if format == PixelFormat::Rgba32F {
            out.extend(self.pixels.iter().flatten().flat_map(|x| x.to_le_bytes()));
            return out;
        }
        let srgb = Srgb8::new();
        let behind = match background {
            Background::Colour(bg) => Some(bg.map(linear_from_srgb)),
            Background::Transparent => None,
        };
        for p in &self.pixels {
            // f64 from here on: these are the last roundings of the picture.
            let [r, g, b, a] = p.map(f64::from);
            let (c, alpha) = match behind {
                Some(bg) => {
                    let over = |c: f64, b: f64| (c + (1.0 - a) * b).clamp(0.0, 1.0);
                    ([over(r, bg[0]), over(g, bg[1]), over(b, bg[2])], 1.0)
                }
                None if a > 0.0 => ([r, g, b].map(|c| (c / a).clamp(0.0, 1.0)), a),
                None => ([0.0; 3], 0.0),
            };
            match format {
                PixelFormat::Rgb8 => out.extend(c.map(|c| srgb.encode(c))),
                PixelFormat::Rgba8 => {
                    out.extend(c.map(|c| srgb.encode(c)));
                    out.push((alpha * 255.0 + 0.5) as u8);
                }
                PixelFormat::Rgba16 => {
                    let to16 = |x: f64| ((x * 65535.0 + 0.5) as u16).to_le_bytes();
                    out.extend(c.iter().flat_map(|&c| to16(srgb_from_linear(c))));
                    out.extend(to16(alpha));
                }
                PixelFormat::Rgba32F => unreachable!("returned above"),
            }
        }
        out
    }
}

/// Linear to 8-bit sRGB by thresholds: what rounding the formula gives, without its power.
struct Srgb8 {
    /// Linear value from which level `i + 1` is the nearest.
    thresholds: [f64; 255],
    /// A level at or below the right one for each 1/1024 of linear light.
    start: [u8; 1025],
}

impl Srgb8 {
    fn new() -> Self {
        let thresholds = std::array::from_fn(|i| linear_from_srgb((i as f64 + 0.5) / 255.0));
        let start =
            std::array::from_fn(|i| thresholds.partition_point(|&t| t <= i as f64 / 1024.0) as u8);
        Srgb8 { thresholds, start }
    }

    fn encode(&self, linear: f64) -> u8 {
        let mut level = self.start[(linear * 1024.0) as usize] as usize;
        while level < 255 && self.thresholds[level] <= linear {
            level += 1;
        }
        level as u8
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thresholds_give_what_the_formula_rounds_to() {
        let s = Srgb8::new();
        for i in 0..=100_000 {
            let l = i as f64 / 100_000.0;
            let want = (srgb_from_linear(l) * 255.0 + 0.5).floor() as u8;
            assert_eq!(s.encode(l), want, "{l}");
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
        f.put(tile, &pixels);
        f.end_slab();
        assert_eq!(f.tile(tile).last, Some(vec![[7; 4]; 4]));
        f.end_slab();
        assert_eq!(f.tile(tile).last, None);
        assert_eq!(f.tile(tile).a, vec![0.5; 4]);
        f.put(tile, &pixels);
        assert_eq!(f.finish().pixels[0], [1.0, 1.0, 1.0, 0.5]);
        assert_eq!(f.finish().pixels[3], [0.0; 4]);
    }

    #[test]
    fn encodings_composite_over_the_background() {
        let p = Picture { size: [2, 1], pixels: vec![[0.25, 0.0, 0.0, 0.5], [0.0; 4]] };
        assert_eq!(p.encode(PixelFormat::Rgba8, Background::Transparent)[..4], [188, 0, 0, 128]);
        let over = p.encode(PixelFormat::Rgb8, Background::Colour([1.0, 1.0, 1.0]));
        assert_eq!(over, [225, 188, 188, 255, 255, 255]);
        assert_eq!(p.encode(PixelFormat::Rgba32F, Background::Transparent).len(), 32);
        assert_eq!(p.encode(PixelFormat::Rgba16, Background::Transparent).len(), 16);
    }
}
