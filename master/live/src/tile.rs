//! Encoder of tiles: header and encoded pixels of the protocol. Encoding takes milliseconds and runs on
//! threads of its own.

use crate::slot::{Pair, Pass};
use bytes::Bytes;
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use rayon::prelude::*;
use sha2::{Digest, Sha256};

/// Bytes of the header.
const HEADER: usize = 28;

/// Quality of moving passes. A sixth of the bytes of a lossless one; blocks do not show on a screen.
const MOVING_QUALITY: u8 = 80;

/// Quality of thumbnails.
const THUMB_QUALITY: u8 = 85;

/// Edge of a still's tiles, pixels: four of 512x512, each some 25 KiB.
pub(crate) const STILL_EDGE: u32 = 256;

/// Pixels of a moving pass above which it is encoded in stripes, on several threads.
const STRIPE_PIXELS: u32 = 512 * 256;

/// Tile edges are multiples of this many pixels, like blocks of JPEG with 4:2:0.
pub(crate) const BLOCK: u32 = 16;

const STILL: u16 = 1;
const FIRST: u16 = 2;
const THUMB: u16 = 4;

/// Encodings that a client takes beside PNG.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Codecs {
    pub(crate) jpeg: bool,
    pub(crate) webp: bool,
}

/// Encoded tiles of a pass.
pub(crate) struct Encoded {
    pub(crate) tiles: Vec<Bytes>,
    /// SHA-256 of a still's pixels as RGBA.
    pub(crate) sha256: Option<String>,
}

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Part {
    pub(crate) x: u32,
    pub(crate) y: u32,
    pub(crate) w: u32,
    pub(crate) h: u32,
}

/// Copies a part of RGB pixels of a picture `width` wide.
fn cut(rgb: &[u8], width: u32, part: Part) -> Vec<u8> {
    let (x, w) = (part.x as usize * 3, part.w as usize * 3);
    let row = width as usize * 3;
    let mut pixels = Vec::with_capacity(w * part.h as usize);
    for y in part.y..part.y + part.h {
        pixels.extend_from_slice(&rgb[y as usize * row + x..][..w]);
    }
    pixels
}

fn header(kind: u8, flags: u16, pair: Pair, part: Part, full: [u32; 2], bound: f32) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(HEADER);
    bytes.extend_from_slice(&[1, kind]);
    bytes.extend_from_slice(&flags.to_le_bytes());
    bytes.extend_from_slice(&pair.seq.to_le_bytes());
    // No larger than `live_edge`, which 16 bits hold.
    for n in [part.x, part.y, part.w, part.h, full[0], full[1]] {
        bytes.extend_from_slice(&(n as u16).to_le_bytes());
    }
    bytes.extend_from_slice(&pair.scene.to_le_bytes());
    bytes.extend_from_slice(&bound.to_le_bytes());
    bytes
}

/// Appends a JPEG of RGB pixels.
fn jpeg(rgb: &[u8], part: Part, quality: u8, out: &mut Vec<u8>) -> Result<u8, String> {
    let mut encoder = Encoder::new(out, quality);
    encoder.set_sampling_factor(SamplingFactor::F_2_2);
    let (w, h) = (part.w as u16, part.h as u16);
    encoder.encode(rgb, w, h, ColorType::Rgb).map_err(|e| format!("JPEG: {e}"))?;
    Ok(1)
}

/// Appends RGB pixels without loss.
fn lossless(rgb: &[u8], part: Part, webp: bool, out: &mut Vec<u8>) -> Result<u8, String> {
    if webp {
        let encoder = image_webp::WebPEncoder::new(&mut *out);
        let encoded = encoder.encode(rgb, part.w, part.h, image_webp::ColorType::Rgb8);
        return encoded.map(|()| 2).map_err(|e| format!("WebP: {e}"));
    }
    let mut encoder = png::Encoder::new(&mut *out, part.w, part.h);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let written = encoder.write_header().and_then(|mut png| {
        png.write_image_data(rgb)?;
        png.finish()
    });
    written.map(|()| 3).map_err(|e| format!("PNG: {e}"))
}

/// Encodes a picture of `size` pixels in RGB as the tiles of a pass.
///
/// # Errors
/// An encoder refuses the pixels, in words.
pub(crate) fn encode(
    rgb: &[u8],
    size: [u32; 2],
    (pair, pass): (Pair, Pass),
    codecs: Codecs,
    bound: f32,
) -> Result<Encoded, String> {
    let [w, h] = size;
    let is_still = pass == Pass::Still;
    let parts: Vec<Part> = if is_still {
        let rows = (0..h).step_by(STILL_EDGE as usize);
        let of_row = |y: u32| {
            let columns = (0..w).step_by(STILL_EDGE as usize);
            columns.map(move |x| Part { x, y, w: STILL_EDGE.min(w - x), h: STILL_EDGE.min(h - y) })
        };
        rows.flat_map(of_row).collect()
    } else {
        let rows = (STRIPE_PIXELS / w.max(1)).next_multiple_of(BLOCK).max(BLOCK);
        let rows = (0..h).step_by(rows as usize).map(|y| Part { x: 0, y, w, h: rows.min(h - y) });
        rows.collect()
    };
    let tiles = || encode_parts(rgb, size, (&parts, true), (pair, pass), codecs, bound);
    let (tiles, sha256) = rayon::join(tiles, || is_still.then(|| rgba_sha256(rgb)));
    Ok(Encoded { tiles: tiles?, sha256 })
}

/// Encodes the rectangles `parts` of the finished still `rgb` of `size` pixels. The other parts, the first
/// tile among them, were sent before.
///
/// # Errors
/// An encoder refuses the pixels, in words.
pub(crate) fn encode_rest(
    rgb: &[u8],
    size: [u32; 2],
    parts: &[Part],
    pair: Pair,
    codecs: Codecs,
) -> Result<Encoded, String> {
    let tiles = || encode_parts(rgb, size, (parts, false), (pair, Pass::Still), codecs, 0.0);
    let (tiles, sha256) = rayon::join(tiles, || rgba_sha256(rgb));
    Ok(Encoded { tiles: tiles?, sha256: Some(sha256) })
}

/// Encodes parts of a picture of `size` pixels in RGB as tiles of a pass. `has_first`: the pass begins
/// with them.
///
/// # Errors
/// An encoder refuses the pixels, in words.
pub(crate) fn encode_parts(
    rgb: &[u8],
    size: [u32; 2],
    (parts, has_first): (&[Part], bool),
    (pair, pass): (Pair, Pass),
    codecs: Codecs,
    bound: f32,
) -> Result<Vec<Bytes>, String> {
    let is_still = pass == Pass::Still;
    let flags = if is_still { STILL } else { 0 };
    let tiles = parts.par_iter().enumerate().map(|(i, part)| {
        let pixels = cut(rgb, size[0], *part);
        let flags = flags | if i == 0 && has_first { FIRST } else { 0 };
        let mut bytes = header(0, flags, pair, *part, size, bound);
        bytes[1] = if !is_still && codecs.jpeg {
            jpeg(&pixels, *part, MOVING_QUALITY, &mut bytes)?
        } else {
            lossless(&pixels, *part, codecs.webp, &mut bytes)?
        };
        Ok(Bytes::from(bytes))
    });
    tiles.collect()
}

/// Encodes thumbnail number `index` of the request `id`.
///
/// # Errors
/// An encoder refuses the pixels, in words.
pub(crate) fn thumb(
    rgb: &[u8],
    size: [u32; 2],
    (id, index): (u32, u32),
    codecs: Codecs,
) -> Result<Bytes, String> {
    let part = Part { x: 0, y: 0, w: size[0], h: size[1] };
    let place = Part { x: index, ..part };
    let mut bytes = header(0, THUMB, Pair { seq: id, scene: 0 }, place, size, f32::NAN);
    bytes[1] = if codecs.jpeg {
        jpeg(rgb, part, THUMB_QUALITY, &mut bytes)?
    } else {
        lossless(rgb, part, codecs.webp, &mut bytes)?
    };
    Ok(bytes.into())
}

/// Returns the SHA-256 of RGB pixels as RGBA with alpha 255, in hexadecimal.
pub(crate) fn rgba_sha256(rgb: &[u8]) -> String {
    let mut hash = Sha256::new();
    let mut row = [255u8; 4 * 256];
    for pixels in rgb.chunks(3 * 256) {
        let n = pixels.len() / 3;
        for (to, from) in row.chunks_exact_mut(4).zip(pixels.chunks_exact(3)) {
            to[..3].copy_from_slice(from);
        }
        hash.update(&row[..4 * n]);
    }
    hex(&hash.finalize())
}

/// Returns bytes as hexadecimal digits.
pub(crate) fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write;
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
        // Writing to a string does not fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture([w, h]: [u32; 2]) -> Vec<u8> {
        (0..w * h * 3).map(|i| (i * 7 % 251) as u8).collect()
    }

    fn u16_at(bytes: &[u8], at: usize) -> u32 {
        u32::from(u16::from_le_bytes([bytes[at], bytes[at + 1]]))
    }

    #[test]
    fn tiles_of_a_still_are_the_picture_without_loss() {
        let size = [300, 270];
        let rgb = picture(size);
        for webp in [false, true] {
            let codecs = Codecs { jpeg: true, webp };
            let pair = Pair { seq: 7, scene: 9 };
            let encoded = encode(&rgb, size, (pair, Pass::Still), codecs, 0.0).unwrap();
            let mut back = vec![0; rgb.len()];
            assert_eq!(encoded.tiles.len(), 4);
            for (i, tile) in encoded.tiles.iter().enumerate() {
                assert_eq!((tile[0], tile[1]), (1, if webp { 2 } else { 3 }));
                assert_eq!(u16_at(tile, 2), if i == 0 { 3 } else { 1 });
                assert_eq!((tile[4], tile[20]), (7, 9));
                let [x, y, w, h] = [8, 10, 12, 14].map(|at| u16_at(tile, at));
                assert_eq!([u16_at(tile, 16), u16_at(tile, 18)], size);
                let body = std::io::Cursor::new(tile[HEADER..].to_vec());
                let mut pixels = vec![0; (w * h * 3) as usize];
                if webp {
                    let mut decoder = image_webp::WebPDecoder::new(body).unwrap();
                    assert_eq!(decoder.dimensions(), (w, h));
                    decoder.read_image(&mut pixels).unwrap();
                } else {
                    let mut reader = png::Decoder::new(body).read_info().unwrap();
                    reader.next_frame(&mut pixels).unwrap();
                }
                for row in 0..h {
                    let to = (((y + row) * size[0] + x) * 3) as usize;
                    let from = (row * w * 3) as usize;
                    let n = (w * 3) as usize;
                    back[to..to + n].copy_from_slice(&pixels[from..from + n]);
                }
            }
            assert!(back == rgb, "webp {webp}");
        }
    }

    #[test]
    fn moving_passes_are_jpegs_in_stripes_on_block_borders() {
        let size = [1000, 700];
        let rgb = picture(size);
        let codecs = Codecs { jpeg: true, webp: true };
        let encoded =
            encode(&rgb, size, (Pair::default(), Pass::Moving), codecs, f32::NAN).unwrap();
        assert!(encoded.sha256.is_none() && encoded.tiles.len() > 1);
        let mut next = 0;
        for tile in &encoded.tiles {
            assert_eq!((tile[1], u16_at(tile, 8), u16_at(tile, 12)), (1, 0, 1000));
            assert_eq!(u16_at(tile, 10), next);
            assert_eq!(next % BLOCK, 0);
            assert_eq!(tile[HEADER..HEADER + 2], [0xff, 0xd8]);
            next += u16_at(tile, 14);
        }
        assert_eq!(next, 700);
    }

    #[test]
    fn hash_is_that_of_rgba() {
        let rgb: Vec<u8> = picture([300, 2]);
        let rgba: Vec<u8> = rgb.chunks(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect();
        assert_eq!(rgba_sha256(&rgb), hex(&Sha256::digest(&rgba)));
    }
}
