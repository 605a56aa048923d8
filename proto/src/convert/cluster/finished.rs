//! Finished pixels of a tile, compressed where that saves bytes.
//!
//! A block of 16x16 pixels with nothing but background is left out (`common::leaves`). The others
//! are colours of a picture, of which LZ4 finds a third to two thirds to repeat something before:
//! background within blocks, flat parts, alpha. It is tried on every tile that leaves the master's
//! machine; a tile that does not get smaller is sent uncompressed.

use super::shared::{format_from_wire, format_to_wire};
use super::wire;
use crate::convert::{MAX_TILE_PIXELS, WireError};
use lz4_flex::block;
use slabcast_common::image::SparseTile;

/// Compression of finished pixels on their way to the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compression {
    /// No compression: the link has room, and compressing takes longer than it saves.
    None,
    /// By LZ4, where that makes them fewer bytes.
    Lz4,
}

pub(super) fn to_wire(leaves: &SparseTile, compression: Compression) -> wire::FinishedPixels {
    let packed = (compression == Compression::Lz4).then(|| block::compress(&leaves.data));
    let packed = packed.filter(|packed| packed.len() < leaves.data.len());
    let written = match packed {
        Some(_) => wire::Compression::Lz4,
        None => wire::Compression::Unspecified,
    };
    wire::FinishedPixels {
        width: leaves.size[0],
        height: leaves.size[1],
        format: format_to_wire(leaves.format),
        blocks: leaves.mask.clone().into(),
        data: packed.unwrap_or_else(|| leaves.data.clone()).into(),
        compression: written as i32,
        max_opacity: leaves.max_alpha,
    }
}

pub(super) fn from_wire(pixels: wire::FinishedPixels) -> Result<SparseTile, WireError> {
    let wire::FinishedPixels { width, height, format, blocks, data, compression, max_opacity } =
        pixels;
    let n = u64::from(width) * u64::from(height);
    if n == 0 || n > MAX_TILE_PIXELS as u64 {
        let problem = format!("{width}x{height} pixels; give 1 to {MAX_TILE_PIXELS}");
        return Err(WireError::value("width, height", problem));
    }
    let size = [width, height];
    let format = format_from_wire("format", format)?;
    let mask_len = SparseTile::mask_len(size);
    if blocks.len() != mask_len {
        return Err(WireError::length("blocks", blocks.len(), mask_len));
    }
    // At most 16 bytes a pixel, whatever the compressed bytes say.
    let len = SparseTile::data_len(size, format, &blocks);
    let data = match wire::Compression::try_from(compression) {
        Ok(wire::Compression::Lz4) => decompress(&data, len)?,
        Ok(wire::Compression::Unspecified | wire::Compression::None) if data.len() == len => {
            data.to_vec()
        }
        Ok(_) => return Err(WireError::length("data", data.len(), len)),
        Err(_) => return Err(WireError::unknown("compression", compression)),
    };
    let leaves = SparseTile { size, format, mask: blocks.to_vec(), data, max_alpha: max_opacity };
    match leaves.check() {
        Ok(()) => Ok(leaves),
        Err(problem) => Err(WireError::value("blocks", problem)),
    }
}

/// An LZ4 block of exactly `len` bytes.
fn decompress(data: &[u8], len: usize) -> Result<Vec<u8>, WireError> {
    if data.len() >= len {
        return Err(WireError::value("compression", "makes data larger"));
    }
    let mut all = vec![0; len];
    match block::decompress_into(data, &mut all) {
        Ok(n) if n == len => Ok(all),
        Ok(n) => Err(WireError::length("data", n, len)),
        Err(_) => Err(WireError::value("data", "is no LZ4 block of its pixels")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::image::PixelFormat;

    fn is_lz4(message: &wire::FinishedPixels) -> bool {
        message.compression() == wire::Compression::Lz4
    }

    /// All blocks of a tile of 40x20, of bytes that repeat after `period`.
    fn tile(format: PixelFormat, period: usize) -> SparseTile {
        let mut leaves = SparseTile::blank([40, 20], format);
        leaves.mask = vec![0b11_1111];
        let mut x = 1u32;
        let mut noise = || {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (x >> 24) as u8
        };
        let pattern: Vec<u8> = (0..period).map(|_| noise()).collect();
        let len = SparseTile::data_len(leaves.size, format, &leaves.mask);
        leaves.data = pattern.into_iter().cycle().take(len).collect();
        leaves.max_alpha = 0.5;
        leaves
    }

    #[test]
    fn finished_tile_is_compressed_where_that_is_smaller() {
        for format in
            [PixelFormat::Rgb8, PixelFormat::Rgba8, PixelFormat::Rgba16, PixelFormat::Rgba32F]
        {
            for (period, packs) in [(1, true), (100, true), (1 << 20, false)] {
                let tile = tile(format, period);
                let message = to_wire(&tile, Compression::Lz4);
                assert_eq!(is_lz4(&message), packs);
                assert!(message.data.len() <= tile.data.len());
                assert_eq!(from_wire(message), Ok(tile.clone()));
                let plain = to_wire(&tile, Compression::None);
                assert!(!is_lz4(&plain) && plain.data == tile.data);
                assert_eq!(from_wire(plain), Ok(tile));
            }
            let blank = SparseTile::blank([256, 256], format);
            let message = to_wire(&blank, Compression::Lz4);
            assert!(message.data.is_empty() && !is_lz4(&message));
            assert_eq!(from_wire(message), Ok(blank));
        }
    }

    #[test]
    fn finished_tile_of_wrong_size_is_refused_before_memory_is_taken() {
        let broken = |change: fn(&mut wire::FinishedPixels)| {
            let mut message = to_wire(&tile(PixelFormat::Rgb8, 100), Compression::Lz4);
            assert!(is_lz4(&message));
            change(&mut message);
            from_wire(message).unwrap_err().field().to_owned()
        };
        assert_eq!(broken(|m| m.width = 0), "width, height");
        assert_eq!(broken(|m| (m.width, m.height) = (u32::MAX, u32::MAX)), "width, height");
        assert_eq!(broken(|m| (m.width, m.height) = (1 << 16, 2)), "width, height");
        assert_eq!(broken(|m| m.width = 200), "blocks");
        assert_eq!(broken(|m| m.format = 0), "format");
        assert_eq!(broken(|m| m.format = 99), "format");
        assert_eq!(broken(|m| m.blocks = vec![0b111_1111].into()), "blocks");
        assert_eq!(broken(|m| m.blocks = vec![1].into()), "data");
        assert_eq!(broken(|m| m.blocks = vec![0].into()), "compression");
        assert_eq!(broken(|m| m.compression = 1), "data");
        assert_eq!(broken(|m| m.data = m.data.slice(1..)), "data");
        assert_eq!(broken(|m| m.data = vec![0; 5000].into()), "compression");
        assert_eq!(broken(|m| m.compression = 0), "data");
        assert_eq!(broken(|m| m.compression = 3), "compression");
        assert_eq!(broken(|m| m.max_opacity = f32::INFINITY), "blocks");
    }
}
