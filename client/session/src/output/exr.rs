//! OpenEXR: linear premultiplied RGBA in 32-bit floats, before any background.
//!
//! A frame's hash is of these numbers, and compositing programs expect them: EXR's colours are
//! linear and premultiplied by definition. The writer is our own: single-part scanlines in blocks
//! of 16 lines, ZIP, are 100 lines over the zlib that is here already. The `exr` crate would bring
//! a reader that aborts on some broken files, half floats, tiles and eight more crates for them.

use super::Frame;
use slabcast_common::image::PixelFormat;
use std::io::{Error, Result, Write};

const MAGIC: [u8; 8] = [0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0];
/// Lines of a block under ZIP compression.
const BLOCK: usize = 16;
/// The attribute that holds the provenance.
const ATTRIBUTE: &str = "slabcast";
/// Largest header that is searched for it.
const MAX_HEADER: usize = 16 << 20;
/// CIE x and y of red, green, blue and white: those of BT.709, as sRGB has them.
const CHROMATICITIES: [f32; 8] = [0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290];

/// Encodes a frame of floats as an EXR with its provenance.
///
/// # Errors
/// `out` can't be written.
pub fn encode(frame: &Frame, provenance: &str, out: &mut impl Write) -> Result<()> {
    if frame.format != PixelFormat::Rgba32F {
        return Err(Error::other("an EXR takes floats"));
    }
    let [w, h] = frame.size.map(|n| n as usize);
    let mut head = MAGIC.to_vec();
    let mut attribute = |name: &str, kind: &str, value: &[u8]| {
        for text in [name, kind] {
            head.extend_from_slice(text.as_bytes());
            head.push(0);
        }
        head.extend_from_slice(&(value.len() as i32).to_le_bytes());
        head.extend_from_slice(value);
    };
    let floats = |x: &[f32]| x.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    // Channels stand in the order of their names: type 2 (float), not perceptual, no subsampling.
    let mut channels = Vec::new();
    for name in *b"ABGR" {
        channels.extend_from_slice(&[name, 0, 2, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]);
    }
    channels.push(0);
    let corner = [0, 0, frame.size[0] as i32 - 1, frame.size[1] as i32 - 1];
    let window: Vec<u8> = corner.iter().flat_map(|n| n.to_le_bytes()).collect();
    attribute("channels", "chlist", &channels);
    attribute("chromaticities", "chromaticities", &floats(&CHROMATICITIES));
    attribute("compression", "compression", &[3]);
    attribute("dataWindow", "box2i", &window);
    attribute("displayWindow", "box2i", &window);
    attribute("lineOrder", "lineOrder", &[0]);
    attribute("pixelAspectRatio", "float", &floats(&[1.0]));
    attribute("screenWindowCenter", "v2f", &floats(&[0.0; 2]));
    attribute("screenWindowWidth", "float", &floats(&[1.0]));
    attribute("software", "string", crate::software::SOFTWARE.as_bytes());
    if !provenance.is_empty() {
        attribute(ATTRIBUTE, "string", provenance.as_bytes());
    }
    head.push(0);

    let mut blocks = Vec::new();
    for (n, lines) in frame.bytes.chunks(BLOCK * w * 16).enumerate() {
        // Line by line, and in a line channel by channel.
        let mut planes = Vec::with_capacity(lines.len());
        for line in lines.chunks_exact(w * 16) {
            for channel in [3, 2, 1, 0] {
                planes.extend(line.chunks_exact(16).flat_map(|p| &p[channel * 4..][..4]));
            }
        }
        let packed = pack(&planes)?;
        // A block that compression does not shrink is stored as it is.
        blocks.push((n * BLOCK, if packed.len() < planes.len() { packed } else { planes }));
    }
    debug_assert_eq!(blocks.len(), h.div_ceil(BLOCK));
    out.write_all(&head)?;
    let mut at = (head.len() + 8 * blocks.len()) as u64;
    for (_, block) in &blocks {
        out.write_all(&at.to_le_bytes())?;
        at += 8 + block.len() as u64;
    }
    for (y, block) in &blocks {
        out.write_all(&(*y as i32).to_le_bytes())?;
        out.write_all(&(block.len() as i32).to_le_bytes())?;
        out.write_all(block)?;
    }
    Ok(())
}

/// EXR's ZIP: bytes at even places, then those at odd ones; differences; zlib.
fn pack(bytes: &[u8]) -> Result<Vec<u8>> {
    let parted: Vec<u8> =
        bytes.iter().step_by(2).chain(bytes.iter().skip(1).step_by(2)).copied().collect();
    let mut before = 0u8;
    let differences: Vec<u8> = parted
        .iter()
        .enumerate()
        .map(|(i, &b)| {
            let d = if i == 0 { b } else { b.wrapping_sub(before).wrapping_add(128) };
            before = b;
            d
        })
        .collect();
    let mut zlib = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    zlib.write_all(&differences)?;
    zlib.finish()
}

/// Returns the provenance in an EXR, if it has one.
///
/// # Errors
/// The file is damaged; the text says where.
pub(crate) fn provenance(bytes: &[u8]) -> std::result::Result<Option<String>, String> {
    let cut = || "its header ends early".to_string();
    let mut rest = bytes[..bytes.len().min(MAX_HEADER)].get(8..).ok_or_else(cut)?;
    if bytes[..4] != MAGIC[..4] {
        return Err("is no OpenEXR file".into());
    }
    loop {
        let mut text = || {
            let long = rest.iter().position(|&b| b == 0).ok_or_else(cut)?;
            let text = &rest[..long];
            rest = &rest[long + 1..];
            Ok::<_, String>(text)
        };
        let name = text()?;
        if name.is_empty() {
            return Ok(None);
        }
        text()?;
        let (long, after) = rest.split_first_chunk::<4>().ok_or_else(cut)?;
        let long = usize::try_from(i32::from_le_bytes(*long)).map_err(|_| cut())?;
        let (value, after) = after.split_at_checked(long).ok_or_else(cut)?;
        if name == ATTRIBUTE.as_bytes() {
            return Ok(Some(String::from_utf8_lossy(value).into_owned()));
        }
        rest = after;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::tests::frame;
    use std::io::Read;

    /// Undoes [`pack`].
    fn unpack(packed: &[u8], long: usize) -> Vec<u8> {
        if packed.len() == long {
            return packed.to_vec();
        }
        let mut d = Vec::new();
        flate2::read::ZlibDecoder::new(packed).read_to_end(&mut d).unwrap();
        for i in 1..d.len() {
            d[i] = d[i].wrapping_add(d[i - 1]).wrapping_sub(128);
        }
        let half = d.len().div_ceil(2);
        (0..d.len()).map(|i| if i % 2 == 0 { d[i / 2] } else { d[half + i / 2] }).collect()
    }

    #[test]
    fn floats_come_back_bit_by_bit() {
        for [w, h] in [[1u32, 1], [5, 16], [7, 35]] {
            let n = (w * h) as usize;
            let pixels: Vec<f32> = (0..n * 4).map(|i| libm::sinf(i as f32 * 0.37).abs()).collect();
            let bytes: Vec<u8> = pixels.iter().flat_map(|x| x.to_le_bytes()).collect();
            let mut f = frame(0, PixelFormat::Rgba32F, &bytes);
            f.size = [w, h];
            let mut exr = Vec::new();
            encode(&f, "{\"a\":1}", &mut exr).unwrap();
            assert_eq!(provenance(&exr).unwrap().as_deref(), Some("{\"a\":1}"));
            for cut in 0..300 {
                let _ = provenance(&exr[..cut]);
            }
            // The table of blocks stands right before the first of them.
            let blocks = (h as usize).div_ceil(BLOCK);
            let number = |at: usize, n: usize| {
                exr[at..at + n].iter().rev().fold(0u64, |x, &b| x << 8 | u64::from(b)) as usize
            };
            let table = (0..exr.len() - 8)
                .find(|&at| number(at, 8) == at + 8 * blocks && exr[at - 1] == 0)
                .unwrap();
            let mut back = vec![0.0f32; n * 4];
            for b in 0..blocks {
                let at = number(table + 8 * b, 8);
                let (y, long) = (number(at, 4), number(at + 4, 4));
                let lines = BLOCK.min(h as usize - y);
                let all = unpack(&exr[at + 8..][..long], lines * w as usize * 16);
                for (i, v) in all.chunks_exact(4).enumerate() {
                    let (line, i) = (i / (w as usize * 4), i % (w as usize * 4));
                    let (c, x) = (3 - i / w as usize, i % w as usize);
                    back[((y + line) * w as usize + x) * 4 + c] =
                        f32::from_le_bytes(v.try_into().unwrap());
                }
            }
            assert_eq!(back, pixels);
        }
    }
}
