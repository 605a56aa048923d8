//! The contact sheet: all frames of a run, small, on one picture.

use super::Frame;
use crate::canvas::{Canvas, LINE, WHITE};
use slabcast_common::image::{Background, Picture, PixelFormat};
use slabcast_common::math::{linear_from_srgb, srgb_from_linear};

/// Most frames on a sheet; of more, every second, third and so on.
const MOST: u64 = 100;
/// Widest sheet in pixels: what a large screen shows without scrolling.
const WIDEST: usize = 2048;
/// Between the pictures.
const GAP: usize = 6;

/// Thumbnails as they come.
pub(crate) struct Contact {
    columns: usize,
    /// Every how manyth frame is shown.
    every: u64,
    /// A thumbnail's size.
    size: [usize; 2],
    /// Frame numbers and pictures.
    pictures: Vec<(u64, Vec<u8>)>,
}

impl Contact {
    /// For `frames` frames of this size.
    pub(crate) fn new(frames: u64, size: [u32; 2]) -> Self {
        let every = frames.div_ceil(MOST).max(1);
        let shown = frames.div_ceil(every).max(1) as usize;
        let [w, h] = size.map(|n| n as usize);
        // About as wide as high, rather wider.
        let columns =
            (1..=shown).find(|c| c * w * 3 >= shown.div_ceil(*c) * h * 4).unwrap_or(shown);
        let room = (WIDEST / columns).saturating_sub(GAP).max(1);
        let width = w.min(room);
        let size = [width, (h * width).div_ceil(w).max(1)];
        Contact { columns, every, size, pictures: Vec::new() }
    }

    /// Takes a frame.
    pub(crate) fn add(&mut self, frame: &Frame) {
        if frame.number.is_multiple_of(self.every) {
            self.pictures.push((frame.number, shrink(&rgb8(frame), frame.size, self.size)));
        }
    }

    /// The sheet.
    pub(crate) fn draw(&self) -> Canvas {
        let [w, h] = self.size;
        let rows = self.pictures.len().div_ceil(self.columns).max(1);
        let cell = [w + GAP, h + GAP + LINE + 2];
        let mut canvas = Canvas::new([self.columns * cell[0] + GAP, rows * cell[1] + GAP]);
        for (i, (number, rgb)) in self.pictures.iter().enumerate() {
            let (row, column) = (i / self.columns, i % self.columns);
            let at = [GAP + column * cell[0], GAP + row * cell[1]];
            canvas.put(at, w, rgb);
            canvas.text([at[0], at[1] + h + 2], 1, &number.to_string(), WHITE);
        }
        canvas
    }
}

/// A frame of any format as 8-bit sRGB, over black where it is transparent.
fn rgb8(frame: &Frame) -> Vec<u8> {
    let over = |c: u8, a: u8| {
        let light = linear_from_srgb(f64::from(c) / 255.0) * f64::from(a) / 255.0;
        (srgb_from_linear(light) * 255.0 + 0.5) as u8
    };
    let b = &frame.bytes;
    match frame.format {
        PixelFormat::Rgb8 => b.to_vec(),
        PixelFormat::Rgba8 => {
            b.chunks_exact(4).flat_map(|p| [0, 1, 2].map(|c| over(p[c], p[3]))).collect()
        }
        // Little endian: the high bytes.
        PixelFormat::Rgba16 => {
            b.chunks_exact(8).flat_map(|p| [1, 3, 5].map(|c| over(p[c], p[7]))).collect()
        }
        PixelFormat::Rgba32F => {
            let float =
                |p: &[u8], c: usize| f32::from_le_bytes(std::array::from_fn(|i| p[c * 4 + i]));
            let pixels = b.chunks_exact(16).map(|p| std::array::from_fn(|c| float(p, c))).collect();
            let picture = Picture { size: frame.size, pixels };
            picture.encode(PixelFormat::Rgb8, Background::Colour([0.0; 3]))
        }
    }
}

/// A smaller picture: each pixel the mean light of those it covers.
fn shrink(rgb: &[u8], [w, h]: [u32; 2], to: [usize; 2]) -> Vec<u8> {
    let (w, h) = (w as usize, h as usize);
    if [w, h] == to {
        return rgb.to_vec();
    }
    let light: Vec<f64> = (0..256).map(|c| linear_from_srgb(f64::from(c) / 255.0)).collect();
    let mut out = Vec::with_capacity(to[0] * to[1] * 3);
    // Whole pixels: the first and the last that a small one touches.
    let span = |i: usize, n: usize, of: usize| (i * of / n, ((i + 1) * of).div_ceil(n));
    for y in 0..to[1] {
        let (y0, y1) = span(y, to[1], h);
        for x in 0..to[0] {
            let (x0, x1) = span(x, to[0], w);
            let mut sum = [0.0; 3];
            for row in y0..y1 {
                for p in rgb[(row * w + x0) * 3..(row * w + x1) * 3].chunks_exact(3) {
                    for c in 0..3 {
                        sum[c] += light[p[c] as usize];
                    }
                }
            }
            let n = ((y1 - y0) * (x1 - x0)) as f64;
            out.extend(sum.map(|s| (srgb_from_linear(s / n) * 255.0 + 0.5) as u8));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::tests::frame;

    #[test]
    fn a_small_picture_has_the_light_of_the_large_one() {
        // Black and white side by side: half the light, not half the number.
        let small = shrink(&[0, 0, 0, 255, 255, 255], [2, 1], [1, 1]);
        assert_eq!(small, [188; 3]);
        assert_eq!(shrink(&[9; 48], [4, 4], [3, 3]), [9; 27]);
    }

    #[test]
    fn sheets_stay_narrow_and_hold_what_they_can() {
        for (frames, size) in [(1, [8, 8]), (18, [512, 512]), (100_000, [64, 48]), (3, [8192, 1])] {
            let contact = Contact::new(frames, size);
            let canvas = contact.draw();
            assert!(canvas.size[0] <= WIDEST + GAP, "{frames}: {:?}", canvas.size);
        }
        assert_eq!(Contact::new(18, [512, 512]).columns, 6);
        let mut contact = Contact::new(250, [2, 1]);
        for n in 0..250 {
            contact.add(&frame(n, PixelFormat::Rgb8, &[7; 6]));
        }
        assert_eq!(contact.pictures.len(), 84);
    }

    #[test]
    fn every_format_has_a_thumbnail() {
        let floats: Vec<u8> =
            [1.0f32, 0.0, 0.0, 1.0].iter().flat_map(|x| x.to_le_bytes()).collect();
        for (format, bytes) in [
            (PixelFormat::Rgb8, vec![255, 0, 0]),
            (PixelFormat::Rgba8, vec![255, 0, 0, 255]),
            (PixelFormat::Rgba16, vec![255, 255, 0, 0, 0, 0, 255, 255]),
            (PixelFormat::Rgba32F, floats),
        ] {
            let mut f = frame(0, format, &bytes);
            f.size = [1, 1];
            assert_eq!(rgb8(&f), [255, 0, 0], "{format:?}");
        }
    }
}
