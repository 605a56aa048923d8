//! Planes of a tile, exact to the bit and without what is blank.
//!
//! In which form should a tile's opacity, colour and sums cross? Uncompressed they take 32 bytes a
//! pixel, 2 MiB a full tile. A general compressor would find the blank pixels too, at some 20 us
//! for 16 KiB (docs/design/transport.md section 6). Here the data is known: a pixel that no voxel
//! touched is zero in all its words, and in many tiles that is most of them. One bit a pixel says
//! so, at the cost of a copy: a 64x64 result takes 35 us to write and 10 us to read when every
//! pixel is there (131 KB), 20 and 15 us with 3 in 8 (51 KB), 7 and 2 us when blank (15 bytes);
//! release build, 2 vCPU EPYC, a loop over `from_worker_to_wire` and `from_worker_from_wire`.
//! "Zero" is of bits: -0.0 is a value like any other and crosses as such.

use super::wire;
use crate::convert::WireError;
use bytes::Bytes;

/// Writes `n` pixels of `W` words.
pub(super) fn to_wire<const W: usize>(n: usize, words: impl Fn(usize) -> [u32; W]) -> wire::Plane {
    let blank = if n > 0 { words(0)[0] } else { 0 };
    if (0..n).all(|i| words(i) == [blank; W]) {
        return wire::Plane { blank, ..wire::Plane::default() };
    }
    let mut mask = vec![0u8; n.div_ceil(8)];
    let mut there = 0;
    for i in 0..n {
        if words(i) != [0; W] {
            mask[i / 8] |= 1 << (i % 8);
            there += 1;
        }
    }
    let whole = (n - there) * 4 * W <= mask.len();
    let mut values = Vec::with_capacity(if whole { n } else { there } * 4 * W);
    for i in 0..n {
        let pixel = words(i);
        if whole || pixel != [0; W] {
            for word in pixel {
                values.extend_from_slice(&word.to_le_bytes());
            }
        }
    }
    let mask = if whole { Bytes::new() } else { mask.into() };
    wire::Plane { blank: 0, mask, values: values.into() }
}

/// Reads `n` pixels (a number that was checked) of `W` words.
pub(super) fn from_wire<const W: usize, T: Clone>(
    plane: wire::Plane,
    n: usize,
    pixel: impl Fn([u32; W]) -> T,
) -> Result<Vec<T>, WireError> {
    let wire::Plane { blank, mask, values } = plane;
    let blank = [blank; W];
    let values_of = |bytes: &[u8]| {
        pixel(std::array::from_fn(|w| {
            u32::from_le_bytes(bytes[4 * w..4 * w + 4].try_into().expect("four bytes"))
        }))
    };
    let fit = |pixels: usize| match values.len() == pixels * 4 * W {
        true => Ok(()),
        false => Err(WireError::length("values", values.len(), pixels * 4 * W)),
    };
    if mask.is_empty() {
        if values.is_empty() {
            return Ok(vec![pixel(blank); n]);
        }
        fit(n)?;
        return Ok(values.chunks_exact(4 * W).map(values_of).collect());
    }
    if mask.len() != n.div_ceil(8) {
        return Err(WireError::length("mask", mask.len(), n.div_ceil(8)));
    }
    if !n.is_multiple_of(8) && mask[n / 8] >> (n % 8) != 0 {
        return Err(WireError::value("mask", "has bits beyond the last pixel"));
    }
    fit(mask.iter().map(|b| b.count_ones() as usize).sum())?;
    let mut there = values.chunks_exact(4 * W);
    let pixels = (0..n).map(|i| match mask[i / 8] >> (i % 8) & 1 {
        0 => pixel(blank),
        _ => values_of(there.next().expect("as many values as bits, checked above")),
    });
    Ok(pixels.collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost::Message;

    fn there_and_back<const W: usize>(pixels: &[[u32; W]]) -> usize {
        let plane = to_wire(pixels.len(), |i| pixels[i]);
        let bytes = plane.encode_to_vec();
        let back = wire::Plane::decode(&bytes[..]).unwrap();
        let back = from_wire(back, pixels.len(), |p: [u32; W]| p).unwrap();
        assert_eq!(back, pixels);
        bytes.len()
    }

    #[test]
    fn plane_of_every_length_and_filling_comes_back() {
        for n in 1..70usize {
            for filling in 0..=4usize {
                let pixels: Vec<[u32; 3]> = (0..n)
                    .map(|i| if i % 4 < filling { [0, i as u32 + 1, u32::MAX] } else { [0; 3] })
                    .collect();
                there_and_back(&pixels);
            }
        }
    }

    #[test]
    fn blank_plane_takes_no_bytes_and_a_sparse_one_few() {
        assert!(there_and_back(&[[0u32; 4]; 4096]) == 0);
        assert!(there_and_back(&[[0.75f32.to_bits(); 1]; 4096]) == 5);
        assert!(there_and_back(&[[(-0.0f32).to_bits(); 1]; 4096]) == 5);
        let mut sparse = [[0u32; 4]; 4096];
        sparse[9] = [1, 2, 3, 4];
        assert!(there_and_back(&sparse) < 4096 / 8 + 16 + 10);
        let dense: Vec<[u32; 4]> = (1..=4096).map(|i| [i; 4]).collect();
        assert!(there_and_back(&dense) <= 4096 * 16 + 8, "a mask that saves nothing is left out");
    }

    #[test]
    fn planes_of_another_size_are_refused() {
        let read = |mask: &'static [u8], values: &'static [u8]| {
            let plane = wire::Plane { blank: 0, mask: mask.into(), values: values.into() };
            from_wire(plane, 10, |[w]: [u32; 1]| w).map_err(|e| e.field().to_owned())
        };
        assert!(read(&[], &[0; 40]).is_ok());
        assert_eq!(read(&[], &[0; 36]), Err("values".into()));
        assert_eq!(read(&[1], &[0; 4]), Err("mask".into()));
        assert_eq!(read(&[1, 4], &[0; 8]), Err("mask".into()), "a bit beyond the last pixel");
        assert_eq!(read(&[1, 1], &[0; 4]), Err("values".into()), "two bits, one value");
        assert!(read(&[1, 1], &[0; 8]).is_ok());
    }
}
