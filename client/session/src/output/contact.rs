//! The contact sheet: all frames of a run, small, on one picture.

use super::Frame;
use crate::canvas::{Canvas, WHITE};
use slabcast_common::math::{linear_from_srgb, srgb_from_linear};
use slabcast_scene::path::ViewPath;
use std::ops::Range;
use std::sync::Arc;

/// Most frames on a sheet; of more, every second, third and so on.
const MOST: u64 = 100;
/// Widest sheet in pixels: what a large screen shows without scrolling.
const WIDEST: usize = 2048;
/// Between the pictures.
const GAP: usize = 6;

/// Size of labels in pixels, and the height of their lines.
const EM: f64 = 12.0;
const LINE: usize = 17;

/// Names of the frames of a path, by their number; those from sides of the body have some.
#[derive(Clone, Debug, Default)]
pub(crate) struct Names(Arc<Vec<Option<&'static str>>>);

impl Names {
    /// Returns the names of a path's sides; none if it has no sides.
    pub(crate) fn of(path: &ViewPath) -> Names {
        let last = path.first_frame() + path.frames();
        let names = (0..if path.has_sides() { last } else { 0 }).map(|n| path.side_name(n));
        Names(Arc::new(names.collect()))
    }

    /// Name of a frame.
    pub(crate) fn get(&self, number: u64) -> Option<&'static str> {
        self.0.get(number as usize).copied().flatten()
    }

    /// Returns whether every frame of the range has a name.
    pub(crate) fn all_of(&self, frames: &Range<u64>) -> bool {
        frames.clone().all(|n| self.get(n).is_some())
    }
}

/// Thumbnails as they come.
pub(crate) struct Contact {
    names: Names,
    frames: u64,
    /// Every how manyth frame is shown.
    every: u64,
    /// Columns, and a thumbnail's size; known with the first frame.
    layout: Option<(usize, [usize; 2])>,
    /// Frame numbers and pictures.
    pictures: Vec<(u64, Vec<u8>)>,
}

impl Contact {
    /// For so many frames.
    pub(crate) fn new(frames: u64, names: Names) -> Self {
        let every = frames.div_ceil(MOST).max(1);
        Contact { names, frames, every, layout: None, pictures: Vec::new() }
    }

    /// Takes a frame.
    pub(crate) fn add(&mut self, frame: &Frame) {
        if frame.number.is_multiple_of(self.every) {
            let shown = self.frames.div_ceil(self.every).max(1) as usize;
            let (_, size) = *self.layout.get_or_insert_with(|| layout(shown, frame.size));
            self.pictures.push((frame.number, shrink(&frame.rgb8(), frame.size, size)));
        }
    }

    /// The sheet.
    pub(crate) fn draw(&self) -> Canvas {
        let (columns, [w, h]) = self.layout.unwrap_or((1, [1, 1]));
        let rows = self.pictures.len().div_ceil(columns).max(1);
        let cell = [w + GAP, h + GAP + LINE];
        let mut canvas = Canvas::new([columns * cell[0] + GAP, rows * cell[1] + GAP]);
        for (i, (number, rgb)) in self.pictures.iter().enumerate() {
            let (row, column) = (i / columns, i % columns);
            let at = [GAP + column * cell[0], GAP + row * cell[1]];
            canvas.put(at, w, rgb);
            let label = self.names.get(*number).map_or_else(|| number.to_string(), String::from);
            canvas.label([at[0] as f64 + 1.0, (at[1] + h + LINE - 4) as f64], EM, &label, WHITE);
        }
        canvas
    }
}

/// Columns for `shown` frames of this size, and a thumbnail's size.
pub(super) fn layout(shown: usize, size: [u32; 2]) -> (usize, [usize; 2]) {
    let [w, h] = size.map(|n| n as usize);
    // About as wide as high, rather wider.
    let columns = (1..=shown).find(|c| c * w * 3 >= shown.div_ceil(*c) * h * 4).unwrap_or(shown);
    let room = (WIDEST / columns).saturating_sub(GAP).max(1);
    let width = w.min(room);
    (columns, [width, (h * width).div_ceil(w).max(1)])
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
    use slabcast_common::image::PixelFormat;

    #[test]
    fn a_small_picture_has_the_light_of_the_large_one() {
        // Black and white side by side: half the light, not half the number.
        let small = shrink(&[0, 0, 0, 255, 255, 255], [2, 1], [1, 1]);
        assert_eq!(small, [188; 3]);
        assert_eq!(shrink(&[9; 48], [4, 4], [3, 3]), [9; 27]);
    }

    #[test]
    fn sheets_stay_narrow_and_hold_what_they_can() {
        for (shown, size) in [(1, [8, 8]), (18, [512, 512]), (100, [64, 48]), (3, [8192, 1])] {
            let (columns, [w, h]) = layout(shown, size);
            assert!(columns * (w + GAP) <= WIDEST + GAP && h > 0, "{shown} of {size:?}");
        }
        assert_eq!(layout(18, [512, 512]).0, 6);
        let mut contact = Contact::new(250, Names::default());
        for n in 0..250 {
            contact.add(&frame(n, PixelFormat::Rgb8, &[7; 6]));
        }
        assert_eq!(contact.pictures.len(), 84);
        assert!(contact.draw().size[0] > 8 * GAP);
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
            assert_eq!(f.rgb8(), [255, 0, 0], "{format:?}");
        }
    }
}
