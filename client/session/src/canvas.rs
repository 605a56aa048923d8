//! A small drawing board for pictures about pictures: fills, pictures side by side, a scale of
//! colours, and words in a font of dots.

use crate::letters::{self, Way};
use crate::software::{SOFTWARE, io_error};
use slabcast_common::image::{Background, Picture, PixelFormat};
use std::io::Write;

/// Viridis at tenths, sRGB bytes (matplotlib, CC0): ascends evenly in lightness, also for
/// colour-blind readers.
pub const VIRIDIS: [[u8; 3]; 11] = [
    [68, 1, 84],
    [72, 36, 117],
    [65, 68, 135],
    [53, 95, 141],
    [42, 120, 142],
    [33, 145, 140],
    [34, 168, 132],
    [68, 191, 112],
    [122, 209, 81],
    [189, 223, 38],
    [253, 231, 37],
];
/// Background of a new board, sRGB bytes.
pub const PAPER: [u8; 3] = [24; 3];
/// Colour of text: white, as sRGB bytes.
pub const WHITE: [u8; 3] = [255; 3];
/// Height of a line of text, in dots.
pub const LINE: usize = 9;
const CELL: usize = 6;

/// Returns the colour of the viridis scale at `t`, clamped to 0 to 1, as sRGB bytes.
pub fn viridis(t: f64) -> [u8; 3] {
    let at = t.clamp(0.0, 1.0) * 10.0;
    let i = (at as usize).min(9);
    let t = at - i as f64;
    std::array::from_fn(|c| {
        let (a, b) = (f64::from(VIRIDIS[i][c]), f64::from(VIRIDIS[i + 1][c]));
        (a + (b - a) * t).round() as u8
    })
}

/// A drawing board of 8-bit sRGB pixels.
pub struct Canvas {
    /// Width and height of the board in pixels.
    pub size: [usize; 2],
    /// Three bytes a pixel, sRGB, row-major from the top left.
    pub bytes: Vec<u8>,
}

impl Canvas {
    /// Returns a board of `size` pixels filled with [`PAPER`].
    pub fn new(size: [usize; 2]) -> Canvas {
        Canvas { size, bytes: PAPER.repeat(size[0] * size[1]) }
    }

    /// Fills the rectangle of `w` by `h` pixels whose top left corner is `x`, `y`; parts
    /// outside are left out.
    pub fn fill(&mut self, [x, y]: [usize; 2], [w, h]: [usize; 2], colour: [u8; 3]) {
        for y in y..(y + h).min(self.size[1]) {
            for x in x..(x + w).min(self.size[0]) {
                let i = (y * self.size[0] + x) * 3;
                self.bytes[i..i + 3].copy_from_slice(&colour);
            }
        }
    }

    /// Copies rows of RGB bytes, `w` pixels each, with their top left corner at `x`, `y`.
    ///
    /// # Panics
    /// The rows don't fit on the board.
    pub fn put(&mut self, [x, y]: [usize; 2], w: usize, rgb: &[u8]) {
        for (j, row) in rgb.chunks_exact(w * 3).enumerate() {
            self.bytes[((y + j) * self.size[0] + x) * 3..][..w * 3].copy_from_slice(row);
        }
    }

    /// Draws a picture with its top left corner at `corner`, over black where it is
    /// transparent.
    ///
    /// # Panics
    /// The picture doesn't fit on the board.
    pub fn picture(&mut self, at: [usize; 2], picture: &Picture, background: Background) {
        let behind = match background {
            Background::Transparent => Background::Colour([0.0; 3]),
            colour => colour,
        };
        let bytes = picture.encode(PixelFormat::Rgb8, behind);
        self.put(at, picture.size[0] as usize, &bytes);
    }

    /// Writes a line of text with its top left corner at `x`, `y`; each dot is `dot` pixels
    /// wide. Characters that the font lacks stay blank.
    pub fn text(&mut self, [x, y]: [usize; 2], dot: usize, text: &str, colour: [u8; 3]) {
        for (n, c) in text.chars().enumerate() {
            let Some(glyph) = (c as usize).checked_sub(32).and_then(|i| FONT.get(i)) else {
                continue;
            };
            for (i, column) in glyph.iter().enumerate() {
                for j in (0..8).filter(|j| column >> j & 1 == 1) {
                    let at = [x + (n * CELL + i) * dot, y + j * dot];
                    self.fill(at, [dot; 2], colour);
                }
            }
        }
    }

    /// Writes a line of text in the program's font, `em` pixels large, on a base line that begins at
    /// `x`, `y`; parts outside are left out.
    pub fn label(&mut self, [x, y]: [f64; 2], em: f64, text: &str, colour: [u8; 3]) {
        let [w, h] = self.size.map(|n| n as i32);
        let drawn = letters::draw(text, em, (x, y), Way::Right, |(x, y), covered| {
            if (0..w).contains(&x) && (0..h).contains(&y) {
                let i = (y * w + x) as usize * 3;
                for (old, new) in self.bytes[i..i + 3].iter_mut().zip(colour) {
                    let mixed = f64::from(*old) * (1.0 - covered) + f64::from(new) * covered;
                    *old = (mixed + 0.5) as u8;
                }
            }
            Ok::<(), std::convert::Infallible>(())
        });
        drawn.unwrap_or_else(|never| match never {});
    }

    /// Encodes the board as a PNG with text chunks `about` (key and text).
    ///
    /// # Errors
    /// `out` can't be written.
    pub fn png(&self, out: &mut impl Write, about: &[(&str, String)]) -> std::io::Result<()> {
        let [w, h] = self.size.map(|n| n as u32);
        let mut png = png::Encoder::new(out, w, h);
        png.set_color(png::ColorType::Rgb);
        png.set_depth(png::BitDepth::Eight);
        png.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        png.set_compression(png::Compression::Balanced);
        png.add_text_chunk("Software".into(), SOFTWARE.into()).map_err(io_error)?;
        for (key, text) in about {
            png.add_text_chunk((*key).into(), text.clone()).map_err(io_error)?;
        }
        let mut png = png.write_header().map_err(io_error)?;
        png.write_image_data(&self.bytes).map_err(io_error)?;
        png.finish().map_err(io_error)
    }
}

/// Returns the width in pixels of a line of text whose dots are `dot` pixels wide.
pub fn width(text: &str, dot: usize) -> usize {
    (text.chars().count() * CELL).saturating_sub(1) * dot
}

/// Dots of the characters from space to tilde: five columns each, the lowest bit at the top.
#[rustfmt::skip]
const FONT: [[u8; 5]; 95] = [
    [0, 0, 0, 0, 0], [0, 0, 0x5f, 0, 0], [0, 7, 0, 7, 0], [0x14, 0x7f, 0x14, 0x7f, 0x14],
    [0x24, 0x2a, 0x7f, 0x2a, 0x12], [0x23, 0x13, 8, 0x64, 0x62], [0x36, 0x49, 0x55, 0x22, 0x50],
    [0, 5, 3, 0, 0], [0, 0x1c, 0x22, 0x41, 0], [0, 0x41, 0x22, 0x1c, 0],
    [8, 0x2a, 0x1c, 0x2a, 8], [8, 8, 0x3e, 8, 8], [0, 0x50, 0x30, 0, 0], [8, 8, 8, 8, 8],
    [0, 0x60, 0x60, 0, 0], [0x20, 0x10, 8, 4, 2],
    // 0 to 9
    [0x3e, 0x51, 0x49, 0x45, 0x3e], [0, 0x42, 0x7f, 0x40, 0], [0x42, 0x61, 0x51, 0x49, 0x46],
    [0x21, 0x41, 0x45, 0x4b, 0x31], [0x18, 0x14, 0x12, 0x7f, 0x10], [0x27, 0x45, 0x45, 0x45, 0x39],
    [0x3c, 0x4a, 0x49, 0x49, 0x30], [1, 0x71, 9, 5, 3], [0x36, 0x49, 0x49, 0x49, 0x36],
    [6, 0x49, 0x49, 0x29, 0x1e],
    // : to @
    [0, 0x36, 0x36, 0, 0], [0, 0x56, 0x36, 0, 0], [0, 8, 0x14, 0x22, 0x41],
    [0x14, 0x14, 0x14, 0x14, 0x14], [0x41, 0x22, 0x14, 8, 0], [2, 1, 0x51, 9, 6],
    [0x32, 0x49, 0x79, 0x41, 0x3e],
    // A to Z
    [0x7e, 0x11, 0x11, 0x11, 0x7e], [0x7f, 0x49, 0x49, 0x49, 0x36], [0x3e, 0x41, 0x41, 0x41, 0x22],
    [0x7f, 0x41, 0x41, 0x22, 0x1c], [0x7f, 0x49, 0x49, 0x49, 0x41], [0x7f, 9, 9, 1, 1],
    [0x3e, 0x41, 0x41, 0x51, 0x32], [0x7f, 8, 8, 8, 0x7f], [0, 0x41, 0x7f, 0x41, 0],
    [0x20, 0x40, 0x41, 0x3f, 1], [0x7f, 8, 0x14, 0x22, 0x41], [0x7f, 0x40, 0x40, 0x40, 0x40],
    [0x7f, 2, 4, 2, 0x7f], [0x7f, 4, 8, 0x10, 0x7f], [0x3e, 0x41, 0x41, 0x41, 0x3e],
    [0x7f, 9, 9, 9, 6], [0x3e, 0x41, 0x51, 0x21, 0x5e], [0x7f, 9, 0x19, 0x29, 0x46],
    [0x46, 0x49, 0x49, 0x49, 0x31], [1, 1, 0x7f, 1, 1], [0x3f, 0x40, 0x40, 0x40, 0x3f],
    [0x1f, 0x20, 0x40, 0x20, 0x1f], [0x7f, 0x20, 0x18, 0x20, 0x7f], [0x63, 0x14, 8, 0x14, 0x63],
    [3, 4, 0x78, 4, 3], [0x61, 0x51, 0x49, 0x45, 0x43],
    // [ to `
    [0, 0, 0x7f, 0x41, 0x41], [2, 4, 8, 0x10, 0x20], [0x41, 0x41, 0x7f, 0, 0], [4, 2, 1, 2, 4],
    [0x40, 0x40, 0x40, 0x40, 0x40], [0, 1, 2, 4, 0],
    // a to z
    [0x20, 0x54, 0x54, 0x54, 0x78], [0x7f, 0x48, 0x44, 0x44, 0x38], [0x38, 0x44, 0x44, 0x44, 0x20],
    [0x38, 0x44, 0x44, 0x48, 0x7f], [0x38, 0x54, 0x54, 0x54, 0x18], [8, 0x7e, 9, 1, 2],
    [0x18, 0xa4, 0xa4, 0xa4, 0x7c], [0x7f, 8, 4, 4, 0x78], [0, 0x44, 0x7d, 0x40, 0],
    [0x40, 0x80, 0x84, 0x7d, 0], [0x7f, 0x10, 0x28, 0x44, 0], [0, 0x41, 0x7f, 0x40, 0],
    [0x7c, 4, 0x18, 4, 0x78], [0x7c, 8, 4, 4, 0x78], [0x38, 0x44, 0x44, 0x44, 0x38],
    [0xfc, 0x24, 0x24, 0x24, 0x18], [0x18, 0x24, 0x24, 0x24, 0xfc], [0x7c, 8, 4, 4, 8],
    [0x48, 0x54, 0x54, 0x54, 0x20], [4, 0x3f, 0x44, 0x40, 0x20], [0x3c, 0x40, 0x40, 0x20, 0x7c],
    [0x1c, 0x20, 0x40, 0x20, 0x1c], [0x3c, 0x40, 0x30, 0x40, 0x3c], [0x44, 0x28, 0x10, 0x28, 0x44],
    [0x1c, 0xa0, 0xa0, 0xa0, 0x7c], [0x44, 0x64, 0x54, 0x4c, 0x44],
    // { to ~
    [0, 8, 0x36, 0x41, 0], [0, 0, 0x7f, 0, 0], [0, 0x41, 0x36, 8, 0], [8, 4, 8, 0x10, 8],
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_stays_inside_the_canvas_and_glyphs_differ() {
        let mut canvas = Canvas::new([12, 8]);
        canvas.text([9, 2], 3, "W~\u{e9}", WHITE);
        assert_eq!(canvas.bytes.len(), 12 * 8 * 3);
        assert!(canvas.bytes.contains(&255));
        let distinct: std::collections::BTreeSet<_> = FONT.iter().collect();
        assert_eq!(distinct.len(), FONT.len());
        assert_eq!((width("", 2), width("10", 2)), (0, 22));
    }
}
