//! Several pictures side by side in one, each with its name.

use super::Frame;
use super::contact::layout;
use crate::figure::{Board, Marker, Place, text_size};
use slabcast_common::image::PixelFormat;

/// Frames as they come, all of one size and format.
pub struct Grid {
    /// Pictures beside each other; `None` for as many as make it about as wide as high.
    columns: Option<usize>,
    /// Colour of cells without a picture, sRGB.
    behind: [u8; 3],
    /// Pictures and their names.
    frames: Vec<(Frame, String)>,
    /// Provenance of the grid as JSON: that of its first frame.
    provenance: String,
}

impl Grid {
    /// Returns an empty grid with so many pictures beside each other, on a background in sRGB.
    pub fn new(columns: Option<usize>, behind: [u8; 3]) -> Grid {
        Grid { columns, behind, frames: Vec::new(), provenance: String::new() }
    }

    /// Takes a picture of 8 bits.
    pub fn add(&mut self, frame: Frame, name: &str) {
        self.frames.push((frame, name.into()));
    }

    /// Takes what made the whole; empty text is none.
    pub(super) fn made(&mut self, provenance: String) {
        if !provenance.is_empty() {
            self.provenance = provenance;
        }
    }

    /// Returns the grid, with the marks of the whole, and what made it.
    ///
    /// # Panics
    /// There is no picture.
    pub fn draw(&mut self, marker: Option<&Marker>) -> (Frame, String) {
        self.frames.sort_by_key(|(frame, _)| frame.number);
        let Frame { number, size, format, .. } = self.frames[0].0;
        let columns = self.columns.unwrap_or_else(|| layout(self.frames.len(), size).0);
        let rows = self.frames.len().div_ceil(columns);
        let wide = if format == PixelFormat::Rgba8 { 4 } else { 3 };
        let [w, h] = size.map(|n| n as usize);
        let cells = [w * columns, h * rows];
        let em = text_size(size);
        let room = marker.map_or([0.0; 2], |m| m.room(cells.map(|n| n as f64), em));
        let whole = [cells[0] + room[0] as usize, cells[1] + room[1] as usize];
        let [r, g, b] = self.behind;
        let pixel = if wide == 4 { vec![0; 4] } else { vec![r, g, b] };
        let mut bytes = pixel.repeat(whole[0] * whole[1]);
        for (i, (frame, _)) in self.frames.iter().enumerate() {
            let (x, y) = (i % columns * w, i / columns * h);
            for (row, line) in frame.bytes.chunks_exact(w * wide).enumerate() {
                bytes[((y + row) * whole[0] + x) * wide..][..w * wide].copy_from_slice(line);
            }
        }
        let behind = if wide == 4 { [255; 3] } else { self.behind };
        let whole = whole.map(|n| n as u32);
        let mut board = Board::new(whole, format, bytes, behind).with_text_of(size);
        for (i, (_, name)) in self.frames.iter().enumerate() {
            let (x, y) = ((i % columns * w) as f64, (i / columns * h) as f64);
            let cell = [x, y, x + w as f64, y + h as f64];
            board.name(cell, name, Place::TopLeft);
        }
        if let Some(marker) = marker {
            marker.draw_whole(&mut board, cells.map(|n| n as f64));
        }
        let size = whole;
        let frame = Frame { number, size, format, bytes: board.into_bytes().into() };
        (frame, std::mem::take(&mut self.provenance))
    }
}
