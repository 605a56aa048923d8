//! Finished pixels of a tile, packed where that saves bytes.
//!
//! A leaf with nothing but background is not here at all (`common::leaves`). The others are colours of a
//! picture, of which lz4 finds a third to two thirds to be the same as something before: background
//! within leaves, flat parts, alpha. It is tried on every tile that leaves the master's machine, and what
//! does not get smaller goes as it is. docs/scaling.md has what it takes and saves.

use super::render::{format_from_wire, format_to_wire};
use super::{MAX_TILE_PIXELS, WireError};
use crate::v1;
use lz4_flex::block;
use slabcast_common::leaves::Leaves;

pub(super) fn to_wire(leaves: &Leaves, packs: bool) -> v1::FinishedPixels {
    let packed = packs.then(|| block::compress(&leaves.data));
    let packed = packed.filter(|packed| packed.len() < leaves.data.len());
    let lz4 = packed.is_some();
    v1::FinishedPixels {
        width: leaves.size[0],
        height: leaves.size[1],
        format: format_to_wire(leaves.format),
        leaves: leaves.mask.clone().into(),
        data: packed.unwrap_or_else(|| leaves.data.clone()).into(),
        lz4,
        alpha_most: leaves.alpha_most,
    }
}

pub(super) fn from_wire(pixels: v1::FinishedPixels) -> Result<Leaves, WireError> {
    let v1::FinishedPixels { width, height, format, leaves, data, lz4, alpha_most } = pixels;
    let n = u64::from(width) * u64::from(height);
    if n == 0 || n > MAX_TILE_PIXELS as u64 {
        let problem = format!("{width}x{height} pixels; give 1 to {MAX_TILE_PIXELS}");
        return Err(WireError::value("width, height", problem));
    }
    let size = [width, height];
    let format = format_from_wire("format", format)?;
    let mask_len = Leaves::mask_len(size);
    if leaves.len() != mask_len {
        return Err(WireError::length("leaves", leaves.len(), mask_len));
    }
    // At most 16 bytes a pixel, whatever the packed bytes say.
    let len = Leaves::data_len(size, format, &leaves);
    let data = if lz4 {
        if data.len() >= len {
            return Err(WireError::value("lz4", "is larger than what it packs"));
        }
        let mut all = vec![0; len];
        match block::decompress_into(&data, &mut all) {
            Ok(n) if n == len => all,
            Ok(n) => return Err(WireError::length("data", n, len)),
            Err(_) => return Err(WireError::value("data", "is no lz4 block of its leaves' bytes")),
        }
    } else if data.len() == len {
        data.to_vec()
    } else {
        return Err(WireError::length("data", data.len(), len));
    };
    let leaves = Leaves { size, format, mask: leaves.to_vec(), data, alpha_most };
    match leaves.check() {
        Ok(()) => Ok(leaves),
        Err(problem) => Err(WireError::value("leaves", problem)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::image::PixelFormat;

    /// All leaves of a tile of 40x20, of bytes that repeat after `period`.
    fn tile(format: PixelFormat, period: usize) -> Leaves {
        let mut leaves = Leaves::blank([40, 20], format);
        leaves.mask = vec![0b11_1111];
        let mut x = 1u32;
        let mut noise = || {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (x >> 24) as u8
        };
        let pattern: Vec<u8> = (0..period).map(|_| noise()).collect();
        let len = Leaves::data_len(leaves.size, format, &leaves.mask);
        leaves.data = pattern.into_iter().cycle().take(len).collect();
        leaves.alpha_most = 0.5;
        leaves
    }

    #[test]
    fn tiles_come_back_packed_where_that_is_smaller() {
        for format in
            [PixelFormat::Rgb8, PixelFormat::Rgba8, PixelFormat::Rgba16, PixelFormat::Rgba32F]
        {
            for (period, packs) in [(1, true), (100, true), (1 << 20, false)] {
                let tile = tile(format, period);
                let message = to_wire(&tile, true);
                assert_eq!(message.lz4, packs);
                assert!(message.data.len() <= tile.data.len());
                assert_eq!(from_wire(message), Ok(tile.clone()));
                let plain = to_wire(&tile, false);
                assert!(!plain.lz4 && plain.data == tile.data);
                assert_eq!(from_wire(plain), Ok(tile));
            }
            let blank = Leaves::blank([256, 256], format);
            let message = to_wire(&blank, true);
            assert!(message.data.is_empty() && !message.lz4);
            assert_eq!(from_wire(message), Ok(blank));
        }
    }

    #[test]
    fn sizes_are_refused_before_memory_is_taken() {
        let broken = |change: fn(&mut v1::FinishedPixels)| {
            let mut message = to_wire(&tile(PixelFormat::Rgb8, 100), true);
            assert!(message.lz4);
            change(&mut message);
            from_wire(message).unwrap_err().field().to_owned()
        };
        assert_eq!(broken(|m| m.width = 0), "width, height");
        assert_eq!(broken(|m| (m.width, m.height) = (u32::MAX, u32::MAX)), "width, height");
        assert_eq!(broken(|m| (m.width, m.height) = (1 << 16, 2)), "width, height");
        assert_eq!(broken(|m| m.width = 200), "leaves");
        assert_eq!(broken(|m| m.format = 0), "format");
        assert_eq!(broken(|m| m.format = 99), "format");
        assert_eq!(broken(|m| m.leaves = vec![0b111_1111].into()), "leaves");
        assert_eq!(broken(|m| m.leaves = vec![1].into()), "data");
        assert_eq!(broken(|m| m.leaves = vec![0].into()), "lz4");
        assert_eq!(broken(|m| m.lz4 = false), "data");
        assert_eq!(broken(|m| m.data = m.data.slice(1..)), "data");
        assert_eq!(broken(|m| m.data = vec![0; 5000].into()), "lz4");
        assert_eq!(broken(|m| m.alpha_most = f32::INFINITY), "leaves");
    }
}
