//! YUV4MPEG2, the plain video that goes into a pipe: `slabcast render ... -o - | ffmpeg -i - ...`.
//!
//! 8 bits, 4:4:4, BT.709 in limited range, from the same sRGB bytes as the PNGs: from
//! R', G', B' in 0 to 1
//!
//! ```text
//! Y' = 0.2126 R' + 0.7152 G' + 0.0722 B'
//! y  = 16 + 219 Y'
//! cb = 128 + 224 (B' - Y') / 1.8556
//! cr = 128 + 224 (R' - Y') / 1.5748
//! ```
//!
//! each rounded to nearest. 4:4:4, because what is thrown away here nobody gets back, and one
//! option of the encoder (`-pix_fmt yuv420p`) throws it away as well; BT.709, because sRGB has its
//! primaries and players assume it for anything large. The format has no field for the matrix, so
//! whoever encodes says it ([`super::ffmpeg`], docs/how-to/movie-for-a-slide.md). Limited range is what encoders take 8-bit
//! video for; the header says it, too.

use super::Frame;
use slabcast_common::image::PixelFormat;
use std::io::{Error, Result};

/// Bits behind the point.
const SHIFT: u32 = 20;

/// The rows of the matrix, scaled to bytes in and bytes out.
fn row(scale: f64, weights: [f64; 3]) -> [i64; 3] {
    let mut row = weights.map(|w| (w * scale / 255.0 * f64::from(1 << SHIFT)).round() as i64);
    // Greys have no colour, exactly.
    let sum = (weights.iter().sum::<f64>() * scale / 255.0 * f64::from(1 << SHIFT)).round() as i64;
    row[1] += sum - row.iter().sum::<i64>();
    row
}

/// Red, green and blue to y, cb and cr.
struct Matrix([[i64; 3]; 3]);

impl Matrix {
    fn bt709() -> Self {
        let y = [0.2126, 0.7152, 0.0722];
        let less = |c: usize| std::array::from_fn(|i| f64::from(u8::from(i == c)) - y[i]);
        Matrix([row(219.0, y), row(224.0 / 1.8556, less(2)), row(224.0 / 1.5748, less(0))])
    }

    fn of(&self, rgb: &[u8]) -> [u8; 3] {
        std::array::from_fn(|i| {
            let sum: i64 = (0..3).map(|c| self.0[i][c] * i64::from(rgb[c])).sum();
            let offset = if i == 0 { 16 } else { 128 };
            (((sum + (1 << (SHIFT - 1))) >> SHIFT) + offset) as u8
        })
    }
}

/// The line before the first frame.
pub(super) fn head([w, h]: [u32; 2], fps: u16) -> Vec<u8> {
    format!("YUV4MPEG2 W{w} H{h} F{fps}:1 Ip A1:1 C444 XYSCSS=444 XCOLORRANGE=LIMITED\n").into()
}

/// The bytes of a frame.
pub(super) fn frame(frame: &Frame) -> Result<Vec<u8>> {
    if frame.format != PixelFormat::Rgb8 {
        return Err(Error::other("a Y4M takes 8-bit RGB"));
    }
    let matrix = Matrix::bt709();
    let n = frame.bytes.len() / 3;
    let mut out = b"FRAME\n".to_vec();
    let start = out.len();
    out.resize(start + 3 * n, 0);
    let (y, chroma) = out[start..].split_at_mut(n);
    let (cb, cr) = chroma.split_at_mut(n);
    for (i, rgb) in frame.bytes.chunks_exact(3).enumerate() {
        [y[i], cb[i], cr[i]] = matrix.of(rgb);
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_those_of_bt_709_in_limited_range() {
        let m = Matrix::bt709();
        for (rgb, want) in [
            ([0, 0, 0], [16, 128, 128]),
            ([255, 255, 255], [235, 128, 128]),
            ([255, 0, 0], [63, 102, 240]),
            ([0, 255, 0], [173, 42, 26]),
            ([0, 0, 255], [32, 240, 118]),
        ] {
            assert_eq!(m.of(&rgb), want, "{rgb:?}");
        }
        for g in 0..=255u8 {
            assert_eq!(m.of(&[g; 3])[1..], [128, 128], "a grey has no colour");
        }
        for i in 0..50_000u32 {
            let rgb = [i % 256, i / 7 % 256, i / 31 % 256].map(|x| x as u8);
            let [r, g, b] = rgb.map(|x| f64::from(x) / 255.0);
            let y = 0.2126 * r + 0.7152 * g + 0.0722 * b;
            let want = [
                16.0 + 219.0 * y,
                128.0 + 224.0 * (b - y) / 1.8556,
                128.0 + 224.0 * (r - y) / 1.5748,
            ];
            for (got, want) in m.of(&rgb).into_iter().zip(want) {
                assert!((f64::from(got) - want).abs() < 0.501, "{rgb:?}: {got}, {want}");
            }
        }
    }

    #[test]
    fn planes_follow_each_other() {
        let f = crate::output::tests::frame(0, PixelFormat::Rgb8, &[0, 0, 0, 255, 255, 255]);
        assert_eq!(frame(&f).unwrap(), b"FRAME\n\x10\xeb\x80\x80\x80\x80");
        assert!(head([2, 1], 12).starts_with(b"YUV4MPEG2 W2 H1 F12:1 "));
    }
}
