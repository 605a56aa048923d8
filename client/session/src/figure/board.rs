//! Finished pixels with room for marks: text, bars and lines, each with a halo.
//!
//! One ink for the whole picture, white over dark backgrounds and black over light ones and none at
//! all; a halo of the other keeps it legible where the volume is as bright. Shapes are gathered as
//! coverage first, so that a halo never lies over a neighbour's ink.

use crate::letters::{self, Way};
use slabcast_common::image::PixelFormat;
use slabcast_common::math::linear_from_srgb;

/// Part of a picture's shorter edge that is the size of text: 15 pixels at 512, and 28 pixels or 7
/// points at 945 pixels of 8 cm.
const TEXT: f64 = 0.03;
/// Smallest text that can be read, in pixels.
const LEAST: f64 = 10.0;
/// Strength of the halo.
const HALO: f64 = 0.62;

/// Place of a text within an area.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// In the corner at the top left.
    TopLeft,
    /// At the middle of the top edge.
    Top,
    /// At the middle of the bottom edge.
    Bottom,
    /// At the middle of the left edge.
    Left,
    /// At the middle of the right edge.
    Right,
}

/// Returns the size of text on a picture, in pixels.
pub fn text_size(size: [u32; 2]) -> f64 {
    (TEXT * f64::from(size[0].min(size[1]))).max(LEAST)
}

/// Pixels of a finished picture, to be drawn over.
pub struct Board {
    size: [usize; 2],
    format: PixelFormat,
    bytes: Vec<u8>,
    /// Size of text in pixels.
    em: f64,
    /// sRGB of marks, and of their halos.
    ink: [f64; 3],
    halo: [f64; 3],
    /// Coverage of each pixel, 0 to 1, by annotations that have no halo yet.
    cover: Vec<f32>,
    /// Pixels of `cover` that aren't zero: left, top, right, bottom.
    dirty: [usize; 4],
}

impl Board {
    /// Returns a board over pixels of 8 or 16 bits; `behind` is the background in sRGB, for the
    /// choice of ink.
    pub fn new(size: [u32; 2], format: PixelFormat, bytes: Vec<u8>, behind: [u8; 3]) -> Board {
        let size = size.map(|n| n as usize);
        let light = |c: usize| linear_from_srgb(f64::from(behind[c]) / 255.0);
        let bright = 0.2126 * light(0) + 0.7152 * light(1) + 0.0722 * light(2) > 0.18;
        let (ink, halo) = if bright { ([0.0; 3], [1.0; 3]) } else { ([1.0; 3], [0.0; 3]) };
        let em = text_size(size.map(|n| n as u32));
        let cover = vec![0.0; size[0] * size[1]];
        let dirty = [usize::MAX, usize::MAX, 0, 0];
        Board { size, format, bytes, em, ink, halo, cover, dirty }
    }

    /// Returns the board with text for pictures of `size` side by side on it.
    #[must_use]
    pub fn with_text_of(self, size: [u32; 2]) -> Board {
        Board { em: text_size(size), ..self }
    }

    /// Returns the pixels.
    pub fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    /// Returns the size of text in pixels.
    pub(super) fn em(&self) -> f64 {
        self.em
    }

    /// Returns the width and height in pixels.
    pub(super) fn size(&self) -> [f64; 2] {
        self.size.map(|n| n as f64)
    }

    /// Covers a part of a pixel.
    fn add(&mut self, [x, y]: [i64; 2], covered: f64) {
        let [w, h] = self.size.map(|n| n as i64);
        if covered > 0.0 && (0..w).contains(&x) && (0..h).contains(&y) {
            let (x, y) = (x as usize, y as usize);
            let old = &mut self.cover[y * self.size[0] + x];
            *old = old.max(covered.min(1.0) as f32);
            let [left, top, right, bottom] = self.dirty;
            self.dirty = [left.min(x), top.min(y), right.max(x + 1), bottom.max(y + 1)];
        }
    }

    /// Covers a rectangle; edges between pixels are smooth.
    pub(super) fn fill(&mut self, [x0, y0, x1, y1]: [f64; 4], strength: f64) {
        let part = |at: i64, lo: f64, hi: f64| ((at + 1) as f64).min(hi) - (at as f64).max(lo);
        for y in y0.floor() as i64..y1.ceil() as i64 {
            for x in x0.floor() as i64..x1.ceil() as i64 {
                let covered = part(x, x0, x1).max(0.0) * part(y, y0, y1).max(0.0);
                self.add([x, y], covered * strength);
            }
        }
    }

    /// Covers a text whose base line begins at `x`, `y`.
    pub(super) fn text(&mut self, [x, y]: [f64; 2], em: f64, text: &str) {
        let drawn = letters::draw(text, em, (x, y), Way::Right, |(x, y), covered| {
            self.add([x.into(), y.into()], covered);
            Ok::<(), std::convert::Infallible>(())
        });
        drawn.unwrap_or_else(|never| match never {});
    }

    /// Covers a text within an area (left, top, right, bottom).
    pub(super) fn text_in(&mut self, area: [f64; 4], text: &str, place: Place) {
        let [x0, y0, x1, y1] = area;
        let (em, wide) = (self.em, letters::width(text, self.em));
        let gap = 0.7 * em;
        // Capitals are 0.73 em high.
        let (middle_x, middle_y) = ((x0 + x1 - wide) / 2.0, (y0 + y1 + 0.73 * em) / 2.0);
        let at = match place {
            Place::TopLeft => [x0 + gap, y0 + gap + 0.73 * em],
            Place::Top => [middle_x, y0 + gap + 0.73 * em],
            Place::Bottom => [middle_x, y1 - gap],
            Place::Left => [x0 + gap, middle_y],
            Place::Right => [x1 - gap - wide, middle_y],
        };
        self.text(at, em, text);
    }

    /// Puts a text into an area (left, top, right, bottom), cut off where it is too long.
    pub fn name(&mut self, area: [f64; 4], text: &str, place: Place) {
        let room = area[2] - area[0] - 1.4 * self.em;
        let fits = |text: &str| letters::width(text, self.em) <= room;
        let shorter = || text.char_indices().rev().map(|(i, _)| format!("{}\u{2026}", &text[..i]));
        let shown = if fits(text) { Some(text.into()) } else { shorter().find(|text| fits(text)) };
        let shown: String = shown.unwrap_or_default();
        self.text_in(area, &shown, place);
        self.ink();
    }

    /// Draws what was covered, over its halo.
    pub(super) fn ink(&mut self) {
        let [left, top, right, bottom] = self.dirty;
        if left >= right {
            return;
        }
        let reach = (self.em * 0.16).ceil() as usize;
        let x0 = left.saturating_sub(2 * reach);
        let y0 = top.saturating_sub(2 * reach);
        let x1 = (right + 2 * reach).min(self.size[0]);
        let y1 = (bottom + 2 * reach).min(self.size[1]);
        let (w, h) = (x1 - x0, y1 - y0);
        let row = |y: usize| (y0 + y) * self.size[0] + x0;
        let sharp: Vec<f32> = (0..h).flat_map(|y| self.cover[row(y)..][..w].to_vec()).collect();
        let mut soft = sharp.clone();
        for _ in 0..2 {
            blur(&mut soft, [w, h], reach);
        }
        for y in 0..h {
            for x in 0..w {
                let (sharp, soft) = (f64::from(sharp[y * w + x]), f64::from(soft[y * w + x]));
                let i = (y0 + y) * self.size[0] + x0 + x;
                self.mix(i, self.halo, HALO * (3.0 * soft).min(1.0));
                self.mix(i, self.ink, sharp);
                self.cover[i] = 0.0;
            }
        }
        self.dirty = [usize::MAX, usize::MAX, 0, 0];
    }

    /// Paints a rectangle of whole pixels, sRGB.
    pub(super) fn paint(&mut self, [x0, y0, x1, y1]: [f64; 4], colour: [f64; 3]) {
        let [w, h] = self.size();
        for y in y0.max(0.0) as usize..y1.clamp(0.0, h) as usize {
            for x in x0.max(0.0) as usize..x1.clamp(0.0, w) as usize {
                self.mix(y * self.size[0] + x, colour, 1.0);
            }
        }
    }

    /// Lays a colour over a pixel, as programs of layers do: in sRGB.
    fn mix(&mut self, i: usize, colour: [f64; 3], part: f64) {
        if part <= 0.0 {
            return;
        }
        let (channels, deep) = match self.format {
            PixelFormat::Rgb8 => (3, false),
            PixelFormat::Rgba8 => (4, false),
            PixelFormat::Rgba16 => (4, true),
            // Refused before any work.
            PixelFormat::Rgba32F => return,
        };
        let most = if deep { 65535.0 } else { 255.0 };
        let get = |b: &[u8], c: usize| {
            let code =
                if deep { u16::from_le_bytes([b[2 * c], b[2 * c + 1]]) } else { b[c].into() };
            f64::from(code) / most
        };
        let wide = channels * if deep { 2 } else { 1 };
        let pixel = &mut self.bytes[i * wide..][..wide];
        let below = if channels == 4 { get(pixel, 3) } else { 1.0 };
        let alpha = part + below * (1.0 - part);
        for c in 0..channels {
            let mixed = match c {
                3 => alpha,
                _ => (colour[c] * part + get(pixel, c) * below * (1.0 - part)) / alpha,
            };
            let code = (mixed * most + 0.5) as u16;
            if deep {
                pixel[2 * c..2 * c + 2].copy_from_slice(&code.to_le_bytes());
            } else {
                pixel[c] = code as u8;
            }
        }
    }
}

/// Means over squares of `2 reach + 1` pixels; outside is zero.
fn blur(values: &mut [f32], [w, h]: [usize; 2], reach: usize) {
    let mut line = Vec::new();
    let mut along = |start: usize, step: usize, n: usize| {
        line.clear();
        line.extend((0..n).map(|i| values[start + i * step]));
        let mut sum: f32 = line[..reach.min(n)].iter().sum();
        for i in 0..n {
            sum += line.get(i + reach).copied().unwrap_or(0.0);
            if i > reach {
                sum -= line[i - reach - 1];
            }
            values[start + i * step] = (sum / (2 * reach + 1) as f32).max(0.0);
        }
    };
    (0..h).for_each(|y| along(y * w, 1, w));
    (0..w).for_each(|x| along(x, w, h));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ink_contrasts_with_the_background_and_spares_the_rest() {
        for (behind, format, pixel) in [
            ([0; 3], PixelFormat::Rgb8, vec![10, 20, 30]),
            ([255; 3], PixelFormat::Rgb8, vec![250, 250, 250]),
            ([255; 3], PixelFormat::Rgba8, vec![0, 0, 0, 0]),
            ([0; 3], PixelFormat::Rgba16, vec![1, 2, 3, 4, 5, 6, 255, 255]),
        ] {
            let before = pixel.repeat(200 * 100);
            let mut board = Board::new([200, 100], format, before.clone(), behind);
            board.name([0.0, 0.0, 200.0, 100.0], "left", Place::TopLeft);
            let after = board.into_bytes();
            assert_eq!(after.len(), before.len());
            let changed = |i: usize| after[i..i + pixel.len()] != pixel[..];
            let pixels = (0..before.len()).step_by(pixel.len());
            let count = pixels.clone().filter(|&i| changed(i)).count();
            assert!((40..2000).contains(&count), "{format:?}: {count}");
            // The lower half is as it was.
            assert_eq!(after[after.len() / 2..], before[before.len() / 2..]);
            // High byte of the first channel, nearly the ink's.
            let high = if pixel.len() == 8 { 1 } else { 0 };
            let inked = |i: usize| match behind {
                [0, ..] => after[i + high] > 190,
                _ => after[i] < 60 && (pixel.len() == 3 || after[i + 3] > 190),
            };
            assert!(pixels.clone().any(inked), "{format:?} {behind:?}");
        }
    }

    #[test]
    fn marks_outside_are_left_out() {
        let mut board = Board::new([3, 2], PixelFormat::Rgb8, vec![0; 18], [0; 3]);
        board.fill([-5.0, -5.0, 50.0, 50.0], 1.0);
        board.text([-100.0, 900.0], 10.0, "out there");
        board.ink();
        board.paint([-1.0, -1.0, 2.0, 1.0], [1.0, 0.0, 0.0]);
        let bytes = board.into_bytes();
        assert_eq!(bytes[..9], [255, 0, 0, 255, 0, 0, 255, 255, 255]);
    }
}
