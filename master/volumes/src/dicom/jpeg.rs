//! Decoder of JPEG inside DICOM: lossless of 2 to 16 bits, and pictures of 8 bits with loss.

use crate::error::{OpenErrorKind, Problem};
use crate::pictures::jpeg::{Frame, decode, is_whole};

/// Returns the most bytes of fragments for a picture of `bytes` bytes: a lossless code takes at most
/// 32 bits a pixel, and there are tables.
pub(super) fn fragments_max_bytes(bytes: usize) -> u64 {
    4 * bytes as u64 + (64 << 10)
}

fn damaged(what: impl Into<String>) -> Problem {
    Problem::new(OpenErrorKind::Damaged, "PixelData", what, "get the file again")
}

/// Decodes a picture of `columns` x `rows` pixels, to little-endian numbers of `size` bytes each.
pub(super) fn unpack(
    fragment: &[u8],
    (columns, rows): (u16, u16),
    size: usize,
) -> Result<Vec<u8>, Problem> {
    let in_pixels = |mut p: Problem| {
        p.field = "PixelData".into();
        p
    };
    let frame = Frame::find(fragment).map_err(in_pixels)?;
    if (frame.width, frame.height) != (columns, rows) {
        return Err(damaged(format!(
            "is a JPEG of {} x {} pixels, where Columns and Rows say {columns} x {rows}",
            frame.width, frame.height
        )));
    }
    let wide = frame.precision > 8;
    let lossless = frame.process == 3;
    if frame.components != 1 || !(2..=16).contains(&frame.precision) || wide && !lossless {
        return Err(Problem::unsupported(
            "PixelData",
            format!(
                "is JPEG of {} bits, {} colours and process {}, which is not read",
                frame.precision, frame.components, frame.process
            ),
            "convert it, for instance with dcm2niix, or gdcmconv --raw",
        ));
    }
    if wide && size < 2 {
        return Err(damaged(format!(
            "is a JPEG of {} bits, where BitsAllocated says {}",
            frame.precision,
            8 * size
        )));
    }
    let count = usize::from(columns) * usize::from(rows);
    // A pixel takes a bit of a lossless picture; of others, a block takes six bits at least.
    let ratio = if lossless { 8 } else { 128 };
    if count > ratio * fragment.len() {
        return Err(damaged("has a JPEG that is too short for the picture"));
    }
    let pixels = match lossless {
        true if !is_whole(fragment) => return Err(damaged("has a JPEG without its end")),
        true => jpeg_decoder::Decoder::new(fragment).decode().map_err(|e| {
            let text: String = e.to_string().chars().take(120).collect();
            damaged(format!("has a JPEG that is damaged ({text})"))
        })?,
        false => decode(fragment).map_err(in_pixels)?.0,
    };
    let stored = if wide { 2 } else { 1 };
    if pixels.len() != count * stored {
        return Err(damaged("has a JPEG that ends early"));
    }
    let mut out = vec![0; count * size];
    for (to, from) in out.chunks_exact_mut(size).zip(pixels.chunks_exact(stored)) {
        match stored {
            // In the machine's byte order.
            2 => to[..2].copy_from_slice(&u16::from_ne_bytes([from[0], from[1]]).to_le_bytes()),
            _ => to[0] = from[0],
        }
    }
    Ok(out)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::pictures::tests::{end_scan, jpeg};

    /// Encodes a picture without loss (process 14, each difference with a code of five bits).
    pub(crate) fn lossless(pixels: &[u16], columns: u16, precision: u8, predictor: u8) -> Vec<u8> {
        let (width, rows) = (usize::from(columns), pixels.len() / usize::from(columns));
        let mut out = vec![0xff, 0xd8, 0xff, 0xc3, 0, 11, precision, (rows >> 8) as u8, rows as u8];
        out.extend(columns.to_be_bytes());
        out.extend([1, 1, 0x11, 0]);
        out.extend([0xff, 0xc4, 0, 36, 0, 0, 0, 0, 0, 17, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        out.extend(0..17);
        out.extend([0xff, 0xda, 0, 8, 1, 1, 0, predictor, 0, 0]);
        let at = |x: usize, y: usize| i32::from(pixels[y * width + x]);
        let mut bits = String::new();
        for y in 0..rows {
            for x in 0..width {
                let guess = match (x, y) {
                    (0, 0) => 1 << (precision - 1),
                    (_, 0) => at(x - 1, 0),
                    (0, _) => at(0, y - 1),
                    _ => {
                        let (a, b, c) = (at(x - 1, y), at(x, y - 1), at(x - 1, y - 1));
                        match predictor {
                            1 => a,
                            2 => b,
                            3 => c,
                            4 => a + b - c,
                            5 => a + ((b - c) >> 1),
                            6 => b + ((a - c) >> 1),
                            _ => (a + b) >> 1,
                        }
                    }
                };
                // Differences are modulo 65536.
                let difference = i32::from((at(x, y) - guess) as i16);
                let size = 32 - difference.unsigned_abs().leading_zeros() as usize;
                bits.push_str(&format!("{size:05b}"));
                if (1..16).contains(&size) {
                    let value =
                        if difference < 0 { difference + (1 << size) - 1 } else { difference };
                    bits.push_str(&format!("{value:0size$b}"));
                }
            }
        }
        end_scan(&mut out, bits);
        out
    }

    #[test]
    fn lossless_jpeg_gives_every_bit_with_every_predictor() {
        for precision in [8u8, 12, 16] {
            let pixels: Vec<u16> =
                (0..60u32).map(|i| (i * i * 977 % (1 << precision)) as u16).collect();
            for predictor in 1..=7 {
                let file = lossless(&pixels, 10, precision, predictor);
                let out = unpack(&file, (10, 6), 2).unwrap();
                let want: Vec<u8> = pixels.iter().flat_map(|p| p.to_le_bytes()).collect();
                assert_eq!(out, want, "{precision} bits, predictor {predictor}");
            }
        }
        assert_eq!(unpack(&lossless(&[7, 200, 3], 3, 8, 1), (3, 1), 1).unwrap(), [7, 200, 3]);
    }

    #[test]
    fn jpeg_with_loss_is_read_with_8_bits() {
        let out = unpack(&jpeg(false), (16, 8), 2).unwrap();
        assert_eq!((out[0], out[1], out[16], out[17]), (50, 0, 200, 0));
        assert_eq!(unpack(&jpeg(false), (16, 8), 1).unwrap()[127], 200);
    }

    #[test]
    fn jpeg_errors_say_what_is_wrong() {
        let good = lossless(&[1, 2, 3, 4, 5, 6], 3, 12, 1);
        for (file, size, say) in [
            (good.clone(), (3, 3), "is a JPEG of 3 x 2 pixels, where Columns and Rows say 3 x 3"),
            (good[..good.len() - 2].to_vec(), (3, 2), "has a JPEG without its end"),
            (jpeg(true), (16, 8), "3 colours"),
            (vec![0xff, 0xd8], (3, 2), "no frame"),
        ] {
            let e = unpack(&file, size, 2).unwrap_err().to_string();
            assert!(e.starts_with("PixelData: ") && e.contains(say), "{e}");
        }
        let e = unpack(&good, (3, 2), 1).unwrap_err().to_string();
        assert!(e.contains("is a JPEG of 12 bits, where BitsAllocated says 8"), "{e}");
    }
}
