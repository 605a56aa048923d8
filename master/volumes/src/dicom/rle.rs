//! Decoder of DICOM's RLE: a run-length coded segment for each byte of a pixel, the highest first.

use crate::error::Problem;
use std::io::Read;

/// Returns the most bytes of fragments for a picture of `bytes` bytes. PackBits adds at worst one
/// byte to 128, and some encoders pad.
fn fragments_max_bytes(bytes: usize) -> u64 {
    2 * bytes as u64 + 4096
}

/// Decodes a picture of `pixels` pixels of `size` bytes each, to little-endian numbers.
pub(super) fn unpack(rest: &mut dyn Read, pixels: usize, size: usize) -> Result<Vec<u8>, Problem> {
    let bad = |what: &str| Problem::malformed("PixelData", what, "get the file again");
    let fragment = super::fragments::read(rest, fragments_max_bytes(pixels * size))?;
    let word = |offset: usize| {
        let bytes = fragment.get(offset..offset + 4)?.try_into().ok()?;
        Some(u32::from_le_bytes(bytes) as usize)
    };
    if word(0) != Some(size) || fragment.len() < 64 {
        return Err(bad("has another number of RLE segments than bytes in a pixel"));
    }
    // Two bytes decode to at most 128, so a short fragment takes no memory for a large picture.
    if pixels * size > 64 * fragment.len() {
        return Err(bad("has RLE fragments that are too short for the picture"));
    }
    let mut out = vec![0; pixels * size];
    for segment in 0..size {
        let start = word(4 + 4 * segment).unwrap_or(0);
        let end =
            if segment + 1 < size { word(8 + 4 * segment).unwrap_or(0) } else { fragment.len() };
        let packed = fragment.get(start..end).filter(|_| start >= 64);
        let packed = packed.ok_or_else(|| bad("has RLE segments outside of its fragment"))?;
        // The first segment holds the highest bytes.
        let places = out.iter_mut().skip(size - 1 - segment).step_by(size);
        if !packbits(packed, places) {
            return Err(bad("has an RLE segment that ends early"));
        }
    }
    Ok(out)
}

/// Decodes PackBits into all places; false if the packed bytes end before.
fn packbits<'a>(packed: &[u8], places: impl Iterator<Item = &'a mut u8>) -> bool {
    let mut bytes = packed.iter();
    // The rest of the current run: literal bytes to copy, or how often to repeat a byte.
    let (mut literal, mut repeat) = (0u32, (0u32, 0u8));
    for place in places {
        while literal == 0 && repeat.0 == 0 {
            let Some(&n) = bytes.next() else { return false };
            match n {
                0..=127 => literal = u32::from(n) + 1,
                128 => {}
                129..=255 => {
                    let Some(&byte) = bytes.next() else { return false };
                    repeat = (257 - u32::from(n), byte);
                }
            }
        }
        if literal > 0 {
            let Some(&byte) = bytes.next() else { return false };
            *place = byte;
            literal -= 1;
        } else {
            *place = repeat.1;
            repeat.0 -= 1;
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rle_decodes_runs_and_literals() {
        let mut out = [0u8; 9];
        assert!(packbits(&[2, 1, 2, 3, 128, 253, 7, 1, 8, 9], out.iter_mut()));
        assert_eq!(out, [1, 2, 3, 7, 7, 7, 7, 8, 9]);
        assert!(!packbits(&[2, 1, 2], out.iter_mut()));
        assert!(!packbits(&[], out.iter_mut()));
    }
}
