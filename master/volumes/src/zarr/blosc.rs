//! Decoder of Blosc 1 containers: blocks of lz4, zstd or zlib, with bytes or bits shuffled.

use super::codec::zstd;
use crate::error::{OpenErrorKind, Problem};
use flate2::read::ZlibDecoder;
use std::io::Read;

fn bad(what: impl Into<String>) -> Problem {
    Problem::new(OpenErrorKind::Damaged, "blosc", what, "get the array again")
}

/// Decodes a container to at most `most` bytes.
pub(crate) fn decode(data: &[u8], most: usize) -> Result<Vec<u8>, Problem> {
    let head: &[u8; 16] = data.first_chunk().ok_or_else(|| bad("is cut off"))?;
    let word = |i: usize| u32::from_le_bytes([head[i], head[i + 1], head[i + 2], head[i + 3]]);
    let (flags, type_size) = (head[2], usize::from(head[3]).max(1));
    let (bytes, block, packed) = (word(4) as usize, word(8) as usize, word(12) as usize);
    if bytes > most || packed > data.len() || block == 0 && bytes > 0 {
        return Err(bad(format!("says {bytes} bytes out of {packed}")));
    }
    let data = &data[..packed];
    if bytes == 0 {
        return Ok(Vec::new());
    }
    let mut out = Vec::with_capacity(bytes);
    // Stored bytes are neither compressed nor shuffled.
    if flags & 2 != 0 {
        out.extend(data.get(16..16 + bytes).ok_or_else(|| bad("is cut off"))?);
        return Ok(out);
    }
    let offset = |i: usize| -> Result<usize, Problem> {
        let bytes = data.get(i..i + 4).and_then(|b| b.try_into().ok());
        let n = bytes.map(i32::from_le_bytes).and_then(|n| usize::try_from(n).ok());
        n.ok_or_else(|| bad("is cut off"))
    };
    let block = block.min(bytes);
    let mut plain = vec![0; block];
    for (i, start) in (0..bytes).step_by(block).enumerate() {
        let size = block.min(bytes - start);
        let whole = size == block;
        // c-blosc compresses each byte of the type separately if a block is whole and long enough;
        // since 1.11 a flag says where it does not.
        let split = flags & 0x10 == 0 && type_size <= 16 && block / type_size >= 128 && whole;
        let parts = if split { type_size } else { 1 };
        let mut next = offset(16 + 4 * i)?;
        let plain = &mut plain[..size];
        if !size.is_multiple_of(parts) {
            return Err(bad("has blocks that are not even"));
        }
        for part in plain.chunks_exact_mut(size / parts) {
            let packed = offset(next)?;
            let bytes = data.get(next + 4..next + 4 + packed).ok_or_else(|| bad("is cut off"))?;
            next += 4 + packed;
            if packed == part.len() {
                part.copy_from_slice(bytes);
                continue;
            }
            unpack(flags >> 5, bytes, part)?;
        }
        let shuffled = type_size > 1 && flags & 1 != 0;
        match (shuffled, flags & 4 != 0) {
            (true, _) => unshuffle(plain, type_size, &mut out),
            (false, true) => unshuffle_bits(plain, type_size, &mut out),
            (false, false) => out.extend_from_slice(plain),
        }
    }
    Ok(out)
}

fn unpack(kind: u8, from: &[u8], to: &mut [u8]) -> Result<(), Problem> {
    let came = match kind {
        1 => lz4_flex::block::decompress_into(from, to)
            .map_err(|e| bad(format!("has a damaged lz4 block ({e})")))?,
        3 => {
            let mut z = ZlibDecoder::new(from);
            z.read_exact(to).map_err(|e| bad(format!("has a damaged zlib block ({e})")))?;
            to.len()
        }
        4 => {
            let plain = zstd(from, to.len())?;
            to[..plain.len()].copy_from_slice(&plain);
            plain.len()
        }
        _ => {
            return Err(Problem::unsupported(
                "blosc",
                "is packed with blosclz or snappy",
                "write the array again with lz4 or zstd",
            ));
        }
    };
    match came == to.len() {
        true => Ok(()),
        false => Err(bad("has a block that ends early")),
    }
}

/// Size of a block that is packed, in bytes; it fits the second-level cache.
const BLOCK_BYTES: usize = 256 << 10;

/// Packs numbers of `size` bytes with lz4, their bytes shuffled, as c-blosc reads them.
///
/// # Panics
/// If the numbers take 4 GiB or more, or are not whole.
pub(crate) fn encode(numbers: &[u8], size: usize) -> Vec<u8> {
    assert!(numbers.len().is_multiple_of(size) && numbers.len() < u32::MAX as usize);
    let shuffled = size > 1;
    let block = BLOCK_BYTES.min(numbers.len()).max(size);
    let starts = 16 + 4 * numbers.len().div_ceil(block);
    let mut out = vec![0; starts];
    let mut plain = Vec::new();
    for (i, part) in numbers.chunks(block).enumerate() {
        let part = match shuffled {
            true => {
                shuffle(part, size, &mut plain);
                &plain[..]
            }
            false => part,
        };
        let at = out.len();
        out[16 + 4 * i..20 + 4 * i].copy_from_slice(&(at as u32).to_le_bytes());
        let most = lz4_flex::block::get_maximum_output_size(part.len());
        out.resize(at + 4 + most, 0);
        let packed = lz4_flex::block::compress_into(part, &mut out[at + 4..]);
        let len = match packed {
            Ok(len) if len < part.len() => len,
            // A part that lz4 does not shrink is stored uncompressed.
            _ => {
                out[at + 4..at + 4 + part.len()].copy_from_slice(part);
                part.len()
            }
        };
        out[at..at + 4].copy_from_slice(&(len as u32).to_le_bytes());
        out.truncate(at + 4 + len);
    }
    // Whole blocks, packed by lz4.
    let mut flags = 0x10 | 1 << 5 | u8::from(shuffled);
    if out.len() >= 16 + numbers.len() {
        flags = 2 | u8::from(shuffled);
        out.truncate(16);
        out.extend_from_slice(numbers);
    }
    out[..4].copy_from_slice(&[2, 1, flags, size as u8]);
    for (i, n) in [numbers.len(), block, out.len()].into_iter().enumerate() {
        out[4 + 4 * i..8 + 4 * i].copy_from_slice(&(n as u32).to_le_bytes());
    }
    out
}

/// Shuffles bytes: the first byte of each number, then the second byte of each, and so on.
fn shuffle(numbers: &[u8], size: usize, out: &mut Vec<u8>) {
    fn of<const SIZE: usize>(numbers: &[u8], out: &mut [u8]) {
        for (byte, to) in out.chunks_exact_mut(numbers.len() / SIZE).enumerate() {
            let words = numbers.chunks_exact(SIZE);
            to.iter_mut().zip(words).for_each(|(to, word)| *to = word[byte]);
        }
    }
    out.resize(numbers.len(), 0);
    match size {
        2 => of::<2>(numbers, out),
        4 => of::<4>(numbers, out),
        8 => of::<8>(numbers, out),
        _ => unreachable!("numbers of one, two, four or eight bytes"),
    }
}

/// Undoes the byte shuffle of numbers of `size` bytes. Bytes beyond the last whole number are not
/// shuffled.
fn unshuffle(plain: &[u8], size: usize, out: &mut Vec<u8>) {
    let n = plain.len() / size;
    let (start, whole) = (out.len(), n * size);
    out.resize(start + whole, 0);
    let to = &mut out[start..];
    match size {
        2 => unshuffle_of::<2>(plain, to),
        4 => unshuffle_of::<4>(plain, to),
        8 => unshuffle_of::<8>(plain, to),
        _ => {
            for (byte, from) in plain.chunks_exact(n.max(1)).take(size).enumerate() {
                let to = to[byte..].iter_mut().step_by(size);
                to.zip(from).for_each(|(to, from)| *to = *from);
            }
        }
    }
    out.extend(&plain[whole..]);
}

/// [`unshuffle`] of numbers of `SIZE` bytes, written so that it is compiled to whole registers.
fn unshuffle_of<const SIZE: usize>(plain: &[u8], to: &mut [u8]) {
    let (to, _) = to.as_chunks_mut::<SIZE>();
    let n = to.len();
    let from: [&[u8]; SIZE] = std::array::from_fn(|byte| &plain[byte * n..][..n]);
    for (i, to) in to.iter_mut().enumerate() {
        *to = std::array::from_fn(|byte| from[byte][i]);
    }
}

/// Undoes the bit shuffle of a block. c-blosc 1 does not shuffle a block whose count of numbers is
/// not a multiple of eight (c-blosc issue 240). Bytes beyond the last number are not shuffled.
fn unshuffle_bits(plain: &[u8], size: usize, out: &mut Vec<u8>) {
    let n = plain.len() / size;
    if !n.is_multiple_of(8) {
        out.extend_from_slice(plain);
        return;
    }
    let start = out.len();
    out.resize(start + n * size, 0);
    let row = n / 8;
    for (eight, to) in out[start..].chunks_exact_mut(8 * size).enumerate() {
        for byte in 0..size {
            let bits = std::array::from_fn(|bit| plain[(byte * 8 + bit) * row + eight]);
            for (i, value) in transpose(u64::from_le_bytes(bits)).to_le_bytes().iter().enumerate() {
                to[i * size + byte] = *value;
            }
        }
    }
    out.extend(&plain[n * size..]);
}

/// Transposes 8 x 8 bits: bit i of byte j becomes bit j of byte i (Hacker's Delight, 7-3).
fn transpose(bits: u64) -> u64 {
    let swap = |x: u64, mask: u64, by: u32| {
        let t = (x ^ (x >> by)) & mask;
        x ^ t ^ (t << by)
    };
    let x = swap(bits, 0x00aa_00aa_00aa_00aa, 7);
    let x = swap(x, 0x0000_cccc_0000_cccc, 14);
    swap(x, 0x0000_0000_f0f0_f0f0, 28)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn container(flags: u8, size: u8, plain: usize, block: usize, blocks: &[Vec<u8>]) -> Vec<u8> {
        let mut out = vec![2, 1, flags, size];
        let starts = 16 + 4 * blocks.len();
        let total = starts + blocks.iter().map(Vec::len).sum::<usize>();
        for n in [plain, block, total] {
            out.extend((n as u32).to_le_bytes());
        }
        let mut at = starts;
        for b in blocks {
            out.extend((at as u32).to_le_bytes());
            at += b.len();
        }
        blocks.iter().for_each(|b| out.extend(b));
        out
    }

    fn part(bytes: &[u8]) -> Vec<u8> {
        [&(bytes.len() as u32).to_le_bytes()[..], bytes].concat()
    }

    #[test]
    fn blosc_decodes_blocks_splits_and_byte_shuffle() {
        let plain: Vec<u8> = (0..1024u32).map(|i| (i * i / 256) as u8).collect();
        let n = 512;
        let shuffled: Vec<u8> =
            (0..2).flat_map(|b| (0..n).map(move |i| 2 * i + b)).map(|i| plain[i]).collect();
        let pack = lz4_flex::block::compress;
        // Two bytes apart, each half packed for itself.
        let halves = [part(&pack(&shuffled[..n])), part(&pack(&shuffled[n..]))].concat();
        let split = container(1 | 1 << 5, 2, 1024, 1024, &[halves]);
        assert_eq!(decode(&split, 1024).unwrap(), plain);
        let whole = container(1 | 0x10 | 1 << 5, 2, 1024, 1024, &[part(&pack(&shuffled))]);
        assert_eq!(decode(&whole, 1024).unwrap(), plain);
        // Two blocks, the second shorter, one stored as it is.
        let blocks = [part(&pack(&plain[..600])), part(&plain[600..])];
        let two = container(0x10 | 1 << 5, 1, 1024, 600, &blocks);
        assert_eq!(decode(&two, 1024).unwrap(), plain);
        let stored = [&container(2, 2, 1024, 1024, &[])[..], &plain].concat();
        let mut stored = stored;
        stored[12..16].copy_from_slice(&(1040u32).to_le_bytes());
        assert_eq!(decode(&stored, 1024).unwrap(), plain);
        let z = ruzstd::encoding::compress_to_vec(
            &shuffled[..],
            ruzstd::encoding::CompressionLevel::Fastest,
        );
        let zstd = container(1 | 0x10 | 4 << 5, 2, 1024, 1024, &[part(&z)]);
        assert_eq!(decode(&zstd, 1024).unwrap(), plain);
        for (bytes, say) in [(&split[..60], "says 1024 bytes out of"), (&split[..10], "is cut off")]
        {
            assert!(decode(bytes, 1024).unwrap_err().to_string().contains(say));
        }
        assert!(decode(&split, 1023).is_err());
        let lz = container(0x10, 1, 1024, 1024, &[part(&[1, 2, 3])]);
        assert!(decode(&lz, 1024).unwrap_err().to_string().contains("blosclz"));
    }

    #[test]
    fn blosc_undoes_the_bit_shuffle_of_blocks_of_a_multiple_of_eight_numbers() {
        let plain: Vec<u8> = (0..33u8).map(|i| i.wrapping_mul(37)).collect();
        // 16 numbers of two bytes, and a byte left over.
        let mut bits = vec![0u8; 32];
        for row in 0..16 {
            for i in 0..16 {
                let bit = plain[2 * i + row / 8] >> (row % 8) & 1;
                bits[row * 2 + i / 8] |= bit << (i % 8);
            }
        }
        bits.extend(&plain[32..]);
        let mut out = Vec::new();
        unshuffle_bits(&bits, 2, &mut out);
        assert_eq!(out, plain);
        // 315 voxels of uint8, as zarr-python packs them: c-blosc left the block as it was.
        let plain: Vec<u8> = (0..315u32).map(|i| (i * 7 % 251) as u8).collect();
        let blosc = container(4 | 0x10 | 1 << 5, 1, 315, 315, &[part(&plain)]);
        assert_eq!(decode(&blosc, 315).unwrap(), plain);
        // A whole block of 16 numbers, and one of 9 that is left as it is.
        let shuffled = [0xff, 0xff].into_iter().chain([0; 14]).collect::<Vec<u8>>();
        let last: Vec<u8> = (1..10).collect();
        let blosc = container(4 | 0x10 | 1 << 5, 1, 25, 16, &[part(&shuffled), part(&last)]);
        assert_eq!(decode(&blosc, 25).unwrap(), [vec![1; 16], last].concat());
    }
}
