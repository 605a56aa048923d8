//! JPEGs: 8 bits of sRGB at quality 95 without chroma subsampling, with what made them in APP11
//! segments.

use super::{Frame, Inside};
use jpeg_encoder::{ColorType, Encoder, EncodingError, PixelDensity, SamplingFactor};
use slabcast_common::image::PixelFormat;
use std::io::{Error, Result, Write};

/// Quality of 1 to 100. At 85 the edge of a bone on black shows ringing at 200 %; 100 takes twice
/// the bytes of 95 for differences of one step.
const QUALITY: u8 = 95;
/// Number of the segments; APP11 is nobody's in pictures of cameras.
const SEGMENT: u8 = 11;
/// Beginning of each of them, followed by a part of the provenance.
const MARK: &[u8] = b"slabcast \0";
/// A segment's length has 16 bits.
const MOST: usize = 65_000;

/// Encodes a frame of 8 bits without alpha as a JPEG.
///
/// # Errors
/// `out` can't be written, or the frame has other pixels.
pub(super) fn encode(frame: &Frame, inside: &Inside<'_>, out: &mut impl Write) -> Result<()> {
    if frame.format != PixelFormat::Rgb8 {
        return Err(Error::other("a JPEG takes 8 bits without alpha"));
    }
    // No larger than MAX_EDGE, which 16 bits hold.
    let [w, h] = frame.size.map(|n| n as u16);
    let mut jpeg = Encoder::new(&mut *out, QUALITY);
    jpeg.set_sampling_factor(SamplingFactor::F_1_1);
    jpeg.set_optimized_huffman_tables(true);
    if let Some(dpi) = inside.dpi {
        let dpi = dpi.min(u16::MAX.into()) as u16;
        jpeg.set_density(PixelDensity::dpi(dpi));
    }
    let write = || {
        for part in inside.provenance.as_bytes().chunks(MOST) {
            jpeg.add_app_segment(SEGMENT, [MARK, part].concat())?;
        }
        jpeg.encode(&frame.bytes, w, h, ColorType::Rgb)
    };
    write().map_err(|e| match e {
        EncodingError::IoError(e) => e,
        other => Error::other(other),
    })
}

/// Returns the provenance in a JPEG, if it has one.
///
/// # Errors
/// The file is damaged; the text says where.
pub(super) fn provenance(bytes: &[u8]) -> std::result::Result<Option<String>, String> {
    let cut = || "its header ends early".to_string();
    let (mut rest, mut found) = (bytes.get(2..).ok_or_else(cut)?, Vec::new());
    loop {
        let [0xff, kind, high, low] = *rest.first_chunk::<4>().ok_or_else(cut)? else {
            return Err("a segment of its header is missing".into());
        };
        // The first scan, or the end: no more segments of ours.
        if matches!(kind, 0xda | 0xd9) {
            break;
        }
        let long = usize::from(u16::from_be_bytes([high, low])) + 2;
        let data = rest.get(4..long).ok_or_else(cut)?;
        if kind == 0xe0 + SEGMENT
            && let Some(part) = data.strip_prefix(MARK)
        {
            found.extend_from_slice(part);
        }
        rest = &rest[long..];
    }
    if found.is_empty() {
        return Ok(None);
    }
    String::from_utf8(found).map(Some).map_err(|_| "what made it is not text".into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::tests::frame;

    #[test]
    fn a_jpeg_says_what_made_it_however_long_that_is() {
        let picture = frame(0, PixelFormat::Rgb8, &[250, 2, 3, 4, 5, 6]);
        for long in [0, 10, 200_000] {
            let said = "\u{e9}".repeat(long);
            let mut jpeg = Vec::new();
            encode(&picture, &Inside { provenance: &said, dpi: Some(300) }, &mut jpeg).unwrap();
            assert!(jpeg.starts_with(b"\xff\xd8") && jpeg.ends_with(b"\xff\xd9"));
            assert_eq!(provenance(&jpeg).unwrap().unwrap_or_default(), said);
            // Unit and density of JFIF: dots an inch, 300.
            assert_eq!(jpeg[13..18], [1, 1, 44, 1, 44]);
            for end in 0..jpeg.len().min(60) {
                let _ = provenance(&jpeg[..end]);
            }
        }
    }
}
