//! TIFFs: 8 bits of sRGB, packed by LZW with differences, with what made them as the description.
//!
//! LZW and not deflate, since programs of journals read it, also old ones.

use super::{Frame, Inside};
use crate::software::SOFTWARE;
use slabcast_common::image::PixelFormat;
use std::io::{Cursor, Error, Result, Write};
use tiff::TiffError;
use tiff::encoder::colortype::{ColorType, RGB8, RGBA8};
use tiff::encoder::{Compression, Predictor, Rational, TiffEncoder};
use tiff::tags::{ResolutionUnit, Tag};

/// Encodes a frame of 8 bits as a TIFF.
///
/// # Errors
/// `out` can't be written, or the frame has other pixels.
pub(super) fn encode(frame: &Frame, inside: &Inside<'_>, out: &mut impl Write) -> Result<()> {
    let alpha = match frame.format {
        PixelFormat::Rgb8 => false,
        PixelFormat::Rgba8 => true,
        _ => return Err(Error::other("a TIFF takes 8 bits")),
    };
    let mut bytes = Cursor::new(Vec::new());
    let written = if alpha {
        write::<RGBA8>(frame, inside, &mut bytes)
    } else {
        write::<RGB8>(frame, inside, &mut bytes)
    };
    written.map_err(|e| match e {
        TiffError::IoError(e) => e,
        other => Error::other(other),
    })?;
    out.write_all(bytes.get_ref())
}

fn write<C: ColorType<Inner = u8>>(
    frame: &Frame,
    inside: &Inside<'_>,
    out: &mut Cursor<Vec<u8>>,
) -> std::result::Result<(), TiffError> {
    let [w, h] = frame.size;
    let mut tiff = TiffEncoder::new(out)?
        .with_compression(Compression::Lzw)
        .with_predictor(Predictor::Horizontal);
    let mut image = tiff.new_image::<C>(w, h)?;
    if C::BITS_PER_SAMPLE.len() == 4 {
        // Alpha, and colours that aren't multiplied by it.
        image.encoder().write_tag(Tag::ExtraSamples, &[2u16][..])?;
    }
    if let Some(dpi) = inside.dpi {
        image.resolution(ResolutionUnit::Inch, Rational { n: dpi, d: 1 });
    }
    image.encoder().write_tag(Tag::Software, SOFTWARE)?;
    if !inside.provenance.is_empty() {
        image.encoder().write_tag(Tag::ImageDescription, ascii(inside.provenance).as_str())?;
    }
    image.write_data(&frame.bytes)
}

/// Escapes all characters of a JSON text that are not ASCII, since a TIFF's text has no others.
fn ascii(json: &str) -> String {
    let mut text = String::with_capacity(json.len());
    let mut units = [0; 2];
    for c in json.chars() {
        if c.is_ascii() {
            text.push(c);
        } else {
            text.extend(c.encode_utf16(&mut units).iter().map(|u| format!("\\u{u:04x}")));
        }
    }
    text
}

/// Returns the provenance in a TIFF, if it has one.
///
/// # Errors
/// The file is damaged; the text says where.
pub(super) fn provenance(bytes: &[u8]) -> std::result::Result<Option<String>, String> {
    let read = || {
        let mut tiff = tiff::decoder::Decoder::new(Cursor::new(bytes))?;
        let by = tiff.find_tag(Tag::Software)?.map(tiff::decoder::ifd::Value::into_string);
        if !by.transpose()?.is_some_and(|by| by.starts_with("slabcast")) {
            return Ok(None);
        }
        tiff.find_tag(Tag::ImageDescription)?.map(|v| v.into_string()).transpose()
    };
    read().map_err(|e: TiffError| e.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::tests::frame;
    use tiff::decoder::{Decoder, DecodingResult};

    #[test]
    fn a_tiff_holds_pixels_dpi_and_what_made_them() {
        for (format, bytes) in [
            (PixelFormat::Rgb8, vec![1, 2, 3, 4, 5, 6]),
            (PixelFormat::Rgba8, vec![1, 2, 3, 4, 5, 6, 7, 255]),
        ] {
            let mut out = Vec::new();
            let inside = Inside { provenance: "{\"caption\":\"\u{b5}m\"}", dpi: Some(300) };
            encode(&frame(0, format, &bytes), &inside, &mut out).unwrap();
            assert_eq!(provenance(&out).unwrap().unwrap(), "{\"caption\":\"\\u00b5m\"}");
            let mut read = Decoder::new(Cursor::new(&out)).unwrap();
            assert_eq!(read.dimensions().unwrap(), (2, 1));
            assert_eq!(read.get_tag_unsigned::<u16>(Tag::ResolutionUnit).unwrap(), 2);
            let DecodingResult::U8(pixels) = read.read_image().unwrap() else { panic!("8 bits") };
            assert_eq!(pixels, bytes);
        }
    }
}
