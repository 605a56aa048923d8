//! DICOM's RLE: one fragment a picture, in it a run-length coded segment for each byte of a
//! pixel, the highest first.

use crate::error::Problem;
use std::io::Read;

/// Longest fragment, in bytes of the picture that it becomes: PackBits adds a byte to 128 at
/// worst; some encoders pad.
fn longest(bytes: usize) -> u64 {
    2 * bytes as u64 + 4096
}

/// Unpacks a picture of `pixels` pixels of `size` bytes, little-endian.
pub(super) fn unpack(rest: &mut dyn Read, pixels: usize, size: usize) -> Result<Vec<u8>, Problem> {
    let bad = |what: &str| Problem::malformed("PixelData", what, "get the file again");
    let io = |_| bad("is truncated inside its RLE fragments");
    let mut head = [0; 8];
    let mut fragment = Vec::new();
    // The first item is a table of offsets; a picture may be cut into several fragments.
    let mut items = 0;
    loop {
        rest.read_exact(&mut head).map_err(io)?;
        let len = u32::from_le_bytes([head[4], head[5], head[6], head[7]]);
        match (head[..4] == [0xfe, 0xff, 0x00, 0xe0], head[..4] == [0xfe, 0xff, 0xdd, 0xe0]) {
            (true, _) if fragment.len() as u64 + u64::from(len) > longest(pixels * size) => {
                return Err(bad("has RLE fragments that are too long for the picture"));
            }
            (true, _) => {
                let before = fragment.len();
                let into = if items == 0 { &mut Vec::new() } else { &mut fragment };
                rest.take(len.into()).read_to_end(into).map_err(io)?;
                let came = if items == 0 { into.len() } else { fragment.len() - before };
                if came != len as usize {
                    return Err(bad("is truncated inside its RLE fragments"));
                }
                items += 1;
            }
            (_, true) => break,
            _ => return Err(bad("has something else than fragments")),
        }
    }
    let word = |at: usize| {
        let bytes = fragment.get(at..at + 4)?.try_into().ok()?;
        Some(u32::from_le_bytes(bytes) as usize)
    };
    if word(0) != Some(size) || fragment.len() < 64 {
        return Err(bad("has another number of RLE segments than bytes in a pixel"));
    }
    // Two bytes become 128 at most: what is not there takes no memory.
    if pixels * size > 64 * fragment.len() {
        return Err(bad("has RLE fragments that are too short for the picture"));
    }
    let mut out = vec![0; pixels * size];
    for segment in 0..size {
        let from = word(4 + 4 * segment).unwrap_or(0);
        let to =
            if segment + 1 < size { word(8 + 4 * segment).unwrap_or(0) } else { fragment.len() };
        let packed = fragment.get(from..to).filter(|_| from >= 64);
        let packed = packed.ok_or_else(|| bad("has RLE segments outside of its fragment"))?;
        // The first segment holds the highest bytes.
        let places = out.iter_mut().skip(size - 1 - segment).step_by(size);
        if !packbits(packed, places) {
            return Err(bad("has an RLE segment that ends early"));
        }
    }
    Ok(out)
}

/// Fills all places; false where the packed bytes end before.
fn packbits<'a>(packed: &[u8], places: impl Iterator<Item = &'a mut u8>) -> bool {
    let mut bytes = packed.iter();
    // What is left of a run: as many bytes as they stand, or one byte so many times.
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
    fn runs_and_literals_are_told_apart() {
        let mut out = [0u8; 9];
        assert!(packbits(&[2, 1, 2, 3, 128, 253, 7, 1, 8, 9], out.iter_mut()));
        assert_eq!(out, [1, 2, 3, 7, 7, 7, 7, 8, 9]);
        assert!(!packbits(&[2, 1, 2], out.iter_mut()));
        assert!(!packbits(&[], out.iter_mut()));
    }
}
