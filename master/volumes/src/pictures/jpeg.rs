//! Decoder of a JPEG picture, which is decoded whole.

use super::{Channel, Shape, check_whole, push};
use crate::error::{OpenErrorKind, Problem};
use crate::samples::Number;
use crate::source::Source;
use std::io::Read;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// Most bytes of a file.
const FILE_MAX_BYTES: u64 = 48 << 20;

/// A picture whose header was read.
pub(super) struct Jpeg {
    bytes: Vec<u8>,
    pub(super) shape: Shape,
    /// Numbers of a pixel: 1, or 3 of colours.
    pub(super) channels: u64,
}

impl Jpeg {
    pub(super) fn open(source: Source) -> Result<Jpeg, Problem> {
        let len = source.len;
        if len > FILE_MAX_BYTES {
            return Err(Problem::new(
                OpenErrorKind::TooLarge,
                "picture",
                format!("has {len} bytes, more than {FILE_MAX_BYTES}"),
                "save it as PNG or TIFF",
            ));
        }
        let mut bytes = Vec::new();
        source
            .reader
            .take(FILE_MAX_BYTES)
            .read_to_end(&mut bytes)
            .map_err(|e| Problem::io("picture", &e))?;
        let header = Frame::of_picture(&bytes)?;
        let shape =
            Shape { width: header.width.into(), height: header.height.into(), number: Number::U8 };
        // One byte a colour, and coefficients of two bytes if it is progressive.
        let each = u64::from(header.components) * if header.process == 2 { 3 } else { 1 };
        check_whole(each * u64::from(header.width) * u64::from(header.height), len)?;
        let channels = if header.components == 1 { 1 } else { 3 };
        Ok(Jpeg { bytes, shape, channels })
    }

    /// Writes the samples of all rows: of one channel, or of all that are grey.
    pub(super) fn all(
        &mut self,
        channel: Option<Channel>,
        out: &mut Vec<u8>,
    ) -> Result<(), Problem> {
        let bytes = std::mem::take(&mut self.bytes);
        let (pixels, channels) = decode(&bytes)?;
        push(&pixels, (channels, 1), channel, out)?;
        Ok(())
    }
}

/// Decodes a picture of 8 bits, and returns its pixels and the numbers in each: one or three.
pub(crate) fn decode(bytes: &[u8]) -> Result<(Vec<u8>, usize), Problem> {
    let header = Frame::of_picture(bytes)?;
    // The decoder makes up what is missing.
    if !is_whole(bytes) {
        return Err(damaged("it has no end"));
    }
    let channels = if header.components == 1 { 1 } else { 3 };
    let colours = if channels == 1 { ColorSpace::Luma } else { ColorSpace::RGB };
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(header.width.into())
        .set_max_height(header.height.into())
        .jpeg_set_out_colorspace(colours);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    let pixels = decoder.decode().map_err(|e| damaged(&e.to_string()))?;
    let need = usize::from(header.width) * usize::from(header.height) * channels;
    match pixels.len() == need {
        true => Ok((pixels, channels)),
        false => Err(damaged("another size than its header says")),
    }
}

fn damaged(why: &str) -> Problem {
    let why: String = why.chars().take(120).collect();
    Problem::new(
        OpenErrorKind::Damaged,
        "picture",
        format!("is truncated or damaged ({why})"),
        "get the whole file",
    )
}

/// Returns whether a picture has its end (EOI) after its scans.
pub(crate) fn is_whole(bytes: &[u8]) -> bool {
    let mut at = 2;
    loop {
        match bytes.get(at..at + 2) {
            Some([0xff, 0xd9]) => return true,
            Some([0xff, 0xff]) => at += 1,
            Some([0xff, 0x01 | 0xd0..=0xd8]) => at += 2,
            Some([0xff, marker]) => {
                let Some(len) = bytes.get(at + 2..at + 4) else { return false };
                at += 2 + usize::from(u16::from_be_bytes([len[0], len[1]])).max(2);
                if *marker != 0xda {
                    continue;
                }
                // A byte of 0xff in a scan is followed by 0; between its parts there are restarts.
                let Some(scan) = bytes.get(at..) else { return false };
                let next = scan
                    .windows(2)
                    .position(|w| w[0] == 0xff && !matches!(w[1], 0 | 0xff | 0xd0..=0xd7));
                let Some(next) = next else { return false };
                at += next;
            }
            _ => return false,
        }
    }
}

/// Frame header of a JPEG (SOF, ITU-T T.81 section B.2.2).
#[derive(Debug, PartialEq)]
pub(crate) struct Frame {
    /// Number of the coding process: 0 baseline, 1 extended, 2 progressive, 3 lossless.
    pub(crate) process: u8,
    /// Bits of a number.
    pub(crate) precision: u8,
    pub(crate) width: u16,
    pub(crate) height: u16,
    pub(crate) components: u8,
}

impl Frame {
    /// Finds the first frame's header.
    pub(crate) fn find(bytes: &[u8]) -> Result<Frame, Problem> {
        let mut at = 2;
        loop {
            let marker = bytes.get(at..at + 4).ok_or_else(|| damaged("no frame"))?;
            if marker[0] != 0xff {
                return Err(damaged("something else than a marker"));
            }
            // Markers may begin with several bytes of 0xff, and some have no length.
            if matches!(marker[1], 0xff | 0x01 | 0xd0..=0xd8) {
                at += if marker[1] == 0xff { 1 } else { 2 };
                continue;
            }
            let frame =
                matches!(marker[1], 0xc0..=0xcf) && !matches!(marker[1], 0xc4 | 0xc8 | 0xcc);
            if !frame {
                at += 2 + usize::from(u16::from_be_bytes([marker[2], marker[3]])).max(2);
                continue;
            }
            let body = bytes.get(at + 4..at + 10).ok_or_else(|| damaged("no frame"))?;
            let pair = |i: usize| u16::from_be_bytes([body[i], body[i + 1]]);
            let (height, width) = (pair(1), pair(3));
            if width == 0 || height == 0 {
                return Err(damaged("a size of 0"));
            }
            let (precision, components) = (body[0], body[5]);
            return Ok(Frame { process: marker[1] - 0xc0, precision, width, height, components });
        }
    }

    /// Finds the header of a picture that [`decode`] takes: of 8 bits, Huffman-coded, with loss.
    fn of_picture(bytes: &[u8]) -> Result<Frame, Problem> {
        let frame = Frame::find(bytes)?;
        let Frame { process, precision, components, .. } = frame;
        match process <= 2 && precision == 8 && matches!(components, 1 | 3) {
            true => Ok(frame),
            false => Err(Problem::unsupported(
                "picture",
                format!(
                    "is JPEG of {precision} bits, {components} colours and process {process}, which \
                     is not read"
                ),
                "save it as PNG or TIFF",
            )),
        }
    }
}
