//! PNGs: 8 and 16 bits of sRGB, still or moving, with what made them inside.
//!
//! A moving one (APNG) is put together here from stills, because the `png` crate must be told the
//! number of frames first and holds the caller to it: a run that is stopped half-way has fewer,
//! and what is done is kept. Any viewer that knows no APNG shows its first frame.

use super::{Frame, Inside};
use crate::software::{SOFTWARE, io_error};
use slabcast_common::image::PixelFormat;
use std::io::{Error, Result, Write};

/// Keyword of the text chunk that holds the provenance.
pub const KEYWORD: &str = "slabcast";
/// Longer provenances (a transfer function of many points) are compressed.
const PLAIN: usize = 2048;

/// Encodes a frame as a PNG, with its provenance as text unless that is empty.
///
/// # Errors
/// `out` can't be written.
pub fn encode(frame: &Frame, inside: &Inside<'_>, out: &mut impl Write) -> Result<()> {
    let Inside { provenance, dpi } = *inside;
    let mut png = png::Encoder::new(out, frame.size[0], frame.size[1]);
    let (colour, depth, bytes) = match frame.format {
        PixelFormat::Rgb8 => (png::ColorType::Rgb, png::BitDepth::Eight, None),
        PixelFormat::Rgba8 => (png::ColorType::Rgba, png::BitDepth::Eight, None),
        PixelFormat::Rgba16 => {
            // Big endian here; and no alpha where all is opaque.
            let opaque = frame.bytes.chunks_exact(8).all(|p| p[6..] == [255; 2]);
            let (colour, keep) =
                if opaque { (png::ColorType::Rgb, 6) } else { (png::ColorType::Rgba, 8) };
            let pixels = frame.bytes.chunks_exact(8);
            let swap = |p: &[u8]| p[..keep].chunks_exact(2).flat_map(|c| [c[1], c[0]]).collect();
            let bytes: Vec<u8> = pixels.flat_map(|p| -> Vec<u8> { swap(p) }).collect();
            (colour, png::BitDepth::Sixteen, Some(bytes))
        }
        PixelFormat::Rgba32F => return Err(Error::other("floats in a PNG")),
    };
    png.set_color(colour);
    png.set_depth(depth);
    png.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    // Fast: 0.9 ms for a rendered 512x512 picture of 236 kB, 160 ms for 8192x8192. The next
    // better one (Balanced) takes 23 ms and 2.7 s, for files a fifth to a third smaller: longer
    // than rendering on a good machine.
    png.set_compression(png::Compression::Fast);
    if let Some(dpi) = dpi {
        // The chunk counts pixels a metre.
        let per_metre = (f64::from(dpi) / 0.0254).round() as u32;
        let [xppu, yppu] = [per_metre; 2];
        png.set_pixel_dims(Some(png::PixelDimensions { xppu, yppu, unit: png::Unit::Meter }));
    }
    png.add_text_chunk("Software".into(), SOFTWARE.into()).map_err(io_error)?;
    match provenance.len() {
        0 => Ok(()),
        1..PLAIN => png.add_itxt_chunk(KEYWORD.into(), provenance.into()),
        _ => png.add_ztxt_chunk(KEYWORD.into(), provenance.into()),
    }
    .map_err(io_error)?;
    let mut png = png.write_header().map_err(io_error)?;
    png.write_image_data(bytes.as_deref().unwrap_or(&frame.bytes)).map_err(io_error)?;
    png.finish().map_err(io_error)
}

/// Returns the provenance in a PNG, if it has one.
///
/// # Errors
/// The file is damaged; the text says where.
pub(crate) fn provenance(bytes: &[u8]) -> std::result::Result<Option<String>, String> {
    let reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info();
    let reader = reader.map_err(|e| e.to_string())?;
    let info = reader.info();
    if let Some(t) = info.utf8_text.iter().find(|t| t.keyword == KEYWORD) {
        return t.get_text().map(Some).map_err(|e| e.to_string());
    }
    let packed = info.compressed_latin1_text.iter().find(|t| t.keyword == KEYWORD);
    packed.map(|t| t.get_text()).transpose().map_err(|e| e.to_string())
}

/// Offset in bytes of the number of frames in the file that [`Moving`] writes: after the signature,
/// IHDR, and the head of `acTL`.
const COUNT_AT: usize = 8 + 25 + 8;

/// A moving PNG in the making.
#[derive(Debug)]
pub(super) struct Moving {
    fps: u16,
    frames: u32,
    /// Number of the next `fcTL` or `fdAT`.
    sequence: u32,
}

impl Moving {
    pub(super) fn new(fps: u16) -> Self {
        Moving { fps, frames: 0, sequence: 0 }
    }

    /// The bytes that a frame adds; the first brings the head.
    pub(super) fn frame(&mut self, frame: &Frame, inside: &Inside<'_>) -> Result<Vec<u8>> {
        let first = self.frames == 0;
        let mut still = Vec::new();
        let later = Inside { provenance: "", ..*inside };
        encode(frame, if first { inside } else { &later }, &mut still)?;
        let mut out = Vec::with_capacity(still.len() + 64);
        if first {
            out.extend_from_slice(&still[..8]);
        }
        let mut shown = false;
        for (name, data) in chunks(&still) {
            match (name, first) {
                (b"IHDR", true) => {
                    chunk(&mut out, name, &[data]);
                    // Counted at the end; 0: for ever.
                    chunk(&mut out, b"acTL", &[&[0; 8]]);
                }
                (b"IDAT", _) => {
                    if !shown {
                        self.control(frame.size, &mut out);
                        shown = true;
                    }
                    if first {
                        chunk(&mut out, name, &[data]);
                    } else {
                        let sequence = self.next().to_be_bytes();
                        chunk(&mut out, b"fdAT", &[&sequence, data]);
                    }
                }
                (b"IEND", _) | (_, false) => {}
                (_, true) => chunk(&mut out, name, &[data]),
            }
        }
        self.frames += 1;
        Ok(out)
    }

    /// The last bytes, and what replaces those at an earlier place.
    pub(super) fn end(&self) -> (Vec<u8>, (u64, Vec<u8>)) {
        let mut tail = Vec::new();
        chunk(&mut tail, b"IEND", &[]);
        let mut actl = Vec::new();
        chunk(&mut actl, b"acTL", &[&self.frames.to_be_bytes(), &[0; 4]]);
        (tail, (COUNT_AT as u64, actl.split_off(8)))
    }

    fn next(&mut self) -> u32 {
        self.sequence += 1;
        self.sequence - 1
    }

    /// `fcTL`: where the frame lies and how long it is shown.
    fn control(&mut self, size: [u32; 2], out: &mut Vec<u8>) {
        let sequence = self.next().to_be_bytes();
        let [w, h] = size.map(u32::to_be_bytes);
        // No offset; 1 / fps; nothing disposed of, everything replaced.
        let rest = [&[0; 8][..], &1u16.to_be_bytes(), &self.fps.to_be_bytes(), &[0, 0]].concat();
        chunk(out, b"fcTL", &[&sequence, &w, &h, &rest]);
    }
}

/// The chunks of a PNG that was just written: names and data.
fn chunks(png: &[u8]) -> impl Iterator<Item = (&[u8; 4], &[u8])> {
    let mut rest = &png[8..];
    std::iter::from_fn(move || {
        let (long, after) = rest.split_first_chunk::<4>()?;
        let (name, after) = after.split_first_chunk::<4>()?;
        let (data, after) = after.split_at_checked(u32::from_be_bytes(*long) as usize)?;
        // Behind its checksum.
        rest = after.get(4..)?;
        Some((name, data))
    })
}

fn chunk(out: &mut Vec<u8>, name: &[u8; 4], data: &[&[u8]]) {
    let long: usize = data.iter().map(|d| d.len()).sum();
    out.extend_from_slice(&(long as u32).to_be_bytes());
    let mut crc = flate2::Crc::new();
    for part in std::iter::once(&name[..]).chain(data.iter().copied()) {
        crc.update(part);
        out.extend_from_slice(part);
    }
    out.extend_from_slice(&crc.sum().to_be_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::tests::frame;

    #[test]
    fn a_png_holds_the_pixels_and_what_made_them() {
        for (format, bytes, want) in [
            (PixelFormat::Rgb8, vec![1, 2, 3, 4, 5, 6], vec![1, 2, 3, 4, 5, 6]),
            (
                PixelFormat::Rgba16,
                vec![1, 2, 3, 4, 5, 6, 255, 255, 7, 8, 9, 10, 11, 12, 255, 255],
                vec![2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11],
            ),
            (
                PixelFormat::Rgba16,
                vec![1, 2, 3, 4, 5, 6, 0, 128, 7, 8, 9, 10, 11, 12, 255, 255],
                vec![2, 1, 4, 3, 6, 5, 128, 0, 8, 7, 10, 9, 12, 11, 255, 255],
            ),
        ] {
            for long in [10, 5000] {
                let said = format!("{{\"x\":\"{}\"}}", "y".repeat(long));
                let mut png = Vec::new();
                let inside = Inside { provenance: &said, dpi: Some(300) };
                encode(&frame(0, format, &bytes), &inside, &mut png).unwrap();
                assert_eq!(provenance(&png).unwrap().as_deref(), Some(&*said));
                let mut reader = png::Decoder::new(std::io::Cursor::new(&png)).read_info().unwrap();
                let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
                reader.next_frame(&mut pixels).unwrap();
                assert_eq!(pixels, want);
                assert!(reader.info().srgb.is_some());
                assert_eq!(reader.info().pixel_dims.map(|d| d.xppu), Some(11811));
            }
        }
    }

    #[test]
    fn a_moving_png_is_read_frame_by_frame_however_many_there_are() {
        for count in [1u8, 3] {
            let mut moving = Moving::new(12);
            let mut all = Vec::new();
            for n in 0..count {
                let bytes = [n; 6];
                let inside = Inside { provenance: "{}", dpi: None };
                let piece = moving.frame(&frame(n.into(), PixelFormat::Rgb8, &bytes), &inside);
                all.extend(piece.unwrap());
            }
            let (tail, (at, patch)) = moving.end();
            all.extend(tail);
            all[at as usize..][..patch.len()].copy_from_slice(&patch);
            let mut reader = png::Decoder::new(std::io::Cursor::new(&all)).read_info().unwrap();
            assert_eq!(reader.info().animation_control().unwrap().num_frames, u32::from(count));
            for n in 0..count {
                let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
                reader.next_frame(&mut pixels).unwrap();
                assert_eq!(pixels, [n; 6]);
                let control = reader.info().frame_control().unwrap();
                assert_eq!((control.delay_num, control.delay_den), (1, 12));
            }
            assert_eq!(provenance(&all).unwrap().as_deref(), Some("{}"));
        }
    }
}
