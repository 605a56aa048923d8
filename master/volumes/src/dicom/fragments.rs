//! The fragments of packed pixels: items after a table of offsets, up to a delimiter.

use crate::error::Problem;
use std::io::Read;

/// Returns the bytes of all fragments of one picture, at most `most`.
pub(super) fn read(rest: &mut dyn Read, most: u64) -> Result<Vec<u8>, Problem> {
    let bad = |what: &str| Problem::malformed("PixelData", what, "get the file again");
    let io = |_| bad("is truncated inside its fragments");
    let mut head = [0; 8];
    let mut fragment = Vec::new();
    // The first item is a table of offsets, skipped; the picture may span several fragments.
    let mut items = 0;
    loop {
        rest.read_exact(&mut head).map_err(io)?;
        let len = u32::from_le_bytes([head[4], head[5], head[6], head[7]]);
        match (head[..4] == [0xfe, 0xff, 0x00, 0xe0], head[..4] == [0xfe, 0xff, 0xdd, 0xe0]) {
            (true, _) if fragment.len() as u64 + u64::from(len) > most => {
                return Err(bad("has fragments that are too long for the picture"));
            }
            (true, _) => {
                let before = fragment.len();
                let target = if items == 0 { &mut Vec::new() } else { &mut fragment };
                rest.take(len.into()).read_to_end(target).map_err(io)?;
                let came = if items == 0 { target.len() } else { fragment.len() - before };
                if came != len as usize {
                    return Err(bad("is truncated inside its fragments"));
                }
                items += 1;
            }
            (_, true) => return Ok(fragment),
            _ => return Err(bad("has something else than fragments")),
        }
    }
}
