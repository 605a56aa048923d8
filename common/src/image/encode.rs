//! Pixels to bytes: formats, background, and sRGB in 8 and 16 bits.

use super::tile::{LEAF_EDGE, finished};
use crate::math::{linear_from_srgb, srgb_from_linear};
use serde::{Deserialize, Serialize};
use std::sync::OnceLock;

/// Background that a finished picture is composited over.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// None: the picture keeps straight alpha.
    Transparent,
    /// An opaque colour, sRGB numbers in `[0, 1]`.
    Colour([f64; 3]),
}

/// Format of pixels that leave the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PixelFormat {
    /// 8-bit sRGB over the background.
    Rgb8,
    /// 8-bit sRGB, straight alpha (opaque over a background).
    Rgba8,
    /// 16-bit sRGB, straight alpha, little endian.
    Rgba16,
    /// Linear premultiplied floats, little endian, without background.
    Rgba32F,
}

impl PixelFormat {
    /// Returns the number of bytes that one pixel takes in this format.
    pub fn bytes(self) -> usize {
        match self {
            PixelFormat::Rgb8 => 3,
            PixelFormat::Rgba8 => 4,
            PixelFormat::Rgba16 => 8,
            PixelFormat::Rgba32F => 16,
        }
    }
}

/// Encoding of finished pixels: their format, and the background they are composited over.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PixelEncoding {
    /// Number type and layout of an encoded pixel.
    pub format: PixelFormat,
    /// Background that pixels are composited over before they are encoded.
    pub background: Background,
}

impl PixelEncoding {
    /// Returns the bytes of a pixel that shows nothing but the background.
    pub(super) fn blank(&self) -> Vec<u8> {
        let mut blank = Vec::new();
        Encoder::new(self.format, self.background).put(&[[0.0; 4]], &mut blank);
        blank
    }
}

/// Encodes linear premultiplied RGBA over a background.
pub(crate) struct Encoder {
    format: PixelFormat,
    /// Linear RGB of the background; `None` keeps alpha.
    background: Option<[f64; 3]>,
}

impl Encoder {
    pub(crate) fn new(format: PixelFormat, background: Background) -> Encoder {
        let background = match background {
            Background::Colour(colour) => Some(colour.map(linear_from_srgb)),
            Background::Transparent => None,
        };
        Encoder { format, background }
    }

    pub(crate) fn put(&self, pixels: &[[f32; 4]], out: &mut Vec<u8>) {
        let first = out.len();
        out.resize(first + pixels.len() * self.format.bytes(), 0);
        let out = &mut out[first..];
        match self.format {
            PixelFormat::Rgb8 => self.each(pixels, out, |srgb, [r, g, b, _]| {
                [srgb.encode(r), srgb.encode(g), srgb.encode(b)]
            }),
            PixelFormat::Rgba8 => self.each(pixels, out, |srgb, [r, g, b, a]| {
                [srgb.encode(r), srgb.encode(g), srgb.encode(b), (a * 255.0 + 0.5) as u8]
            }),
            PixelFormat::Rgba16 => self.each(pixels, out, |_, [r, g, b, a]| {
                let to16 = |x: f64| ((x * 65535.0 + 0.5) as u16).to_le_bytes();
                let light = |c: f64| to16(srgb_from_linear(c));
                let [[r0, r1], [g0, g1], [b0, b1]] = [light(r), light(g), light(b)];
                let [a0, a1] = to16(a);
                [r0, r1, g0, g1, b0, b1, a0, a1]
            }),
            PixelFormat::Rgba32F => {
                for (to, x) in out.chunks_exact_mut(4).zip(pixels.iter().flatten()) {
                    to.copy_from_slice(&x.to_le_bytes());
                }
            }
        }
    }

    /// Appends rows of fixed-point sums, encoded as [`Encoder::put`] encodes their floats.
    pub(crate) fn put_sums<'a>(
        &self,
        rows: impl Iterator<Item = (&'a [f32], &'a [[u32; 3]])>,
        out: &mut Vec<u8>,
    ) {
        let black = self.background == Some([0.0; 3]);
        match self.format {
            PixelFormat::Rgb8 if black => over_black(rows, out, |rgb| rgb),
            PixelFormat::Rgba8 if black => over_black(rows, out, |[r, g, b]| [r, g, b, u8::MAX]),
            _ => {
                let mut pixels = Vec::with_capacity(LEAF_EDGE * LEAF_EDGE);
                for (a, colour) in rows {
                    pixels.extend(a.iter().zip(colour).map(|(&a, &colour)| finished(a, colour)));
                }
                self.put(&pixels, out);
            }
        }
    }

    #[inline(always)]
    fn each<const N: usize>(
        &self,
        pixels: &[[f32; 4]],
        out: &mut [u8],
        bytes: impl Fn(&Srgb8, [f64; 4]) -> [u8; N],
    ) {
        let srgb = Srgb8::get();
        let blank = bytes(srgb, self.over([0.0; 4]));
        for (to, &p) in out.as_chunks_mut::<N>().0.iter_mut().zip(pixels) {
            *to = if p == [0.0; 4] { blank } else { bytes(srgb, self.over(p)) };
        }
    }

    /// Composites over the background; returns straight linear RGB and alpha.
    #[inline(always)]
    fn over(&self, p: [f32; 4]) -> [f64; 4] {
        // f64 from here on: these are the last roundings of the picture. Channels one by one, since
        // `map` of an array is a call in builds without link-time optimisation.
        let [r, g, b, a] = [f64::from(p[0]), f64::from(p[1]), f64::from(p[2]), f64::from(p[3])];
        match self.background {
            Some(bg) => {
                let over = |c: f64, b: f64| (c + (1.0 - a) * b).clamp(0.0, 1.0);
                [over(r, bg[0]), over(g, bg[1]), over(b, bg[2]), 1.0]
            }
            None if a > 0.0 => {
                let straight = |c: f64| (c / a).clamp(0.0, 1.0);
                [straight(r), straight(g), straight(b), a]
            }
            None => [0.0; 4],
        }
    }
}

/// Encodes rows of sums over black, which adds nothing: no float is needed.
fn over_black<'a, const N: usize>(
    rows: impl Iterator<Item = (&'a [f32], &'a [[u32; 3]])>,
    out: &mut Vec<u8>,
    bytes: impl Fn([u8; 3]) -> [u8; N],
) {
    let srgb = SumsSrgb8::get();
    for (_, colour) in rows {
        let first = out.len();
        out.resize(first + colour.len() * N, 0);
        let to = out[first..].as_chunks_mut::<N>().0;
        // All of many rows are empty, and that is seen four numbers at once.
        if colour.as_flattened().iter().fold(0, |any, sum| any | sum) == 0 {
            to.fill(bytes([0; 3]));
            continue;
        }
        for (to, &[r, g, b]) in to.iter_mut().zip(colour) {
            *to = bytes([srgb.encode(r), srgb.encode(g), srgb.encode(b)]);
        }
    }
}

/// Linear light to 8-bit sRGB by thresholds: rounds as the formula does, without its power.
struct Srgb8 {
    /// Linear value from which level `i + 1` is nearest; infinite for level 256.
    thresholds: [f64; 256],
    /// Level at the start of each part of linear light; at most one threshold lies in a part. Part
    /// i is what rounds to `i / PARTS`. Parts beyond one save a range check.
    start: [u8; 2 * Srgb8::PARTS],
}

impl Srgb8 {
    /// The curve's steepest slope is 12.92, at black: 0.81 levels a part.
    const PARTS: usize = 4096;

    fn get() -> &'static Srgb8 {
        static TABLE: OnceLock<Srgb8> = OnceLock::new();
        TABLE.get_or_init(|| {
            let light = |i: usize| match i {
                255 => f64::INFINITY,
                i => linear_from_srgb((i as f64 + 0.5) / 255.0),
            };
            let thresholds: [f64; 256] = std::array::from_fn(light);
            let start = std::array::from_fn(|i| {
                let from = (i as f64 - 0.5) / Srgb8::PARTS as f64;
                thresholds.partition_point(|&t| t <= from) as u8
            });
            Srgb8 { thresholds, start }
        })
    }

    /// `linear` in `[0, 1]`.
    #[inline(always)]
    fn encode(&self, linear: f64) -> u8 {
        // From here on the last bit of a number is a one: what is added to it is rounded to a whole
        // number, which are its last bits. That is quicker than a conversion, which looks at what
        // no number can hold.
        const WHOLE: f64 = (1u64 << 52) as f64;
        let part = (linear * Srgb8::PARTS as f64 + WHOLE).to_bits() as usize;
        let level = self.start[part % (2 * Srgb8::PARTS)];
        level + u8::from(self.thresholds[usize::from(level)] <= linear)
    }
}

/// [`Srgb8`] of sums in units of [`COLOUR_UNIT`](super::COLOUR_UNIT), without floats: rounding of
/// [`finished`] is in the thresholds. Through floats three channels share a register, which takes
/// twice as long as looking them up.
struct SumsSrgb8 {
    /// Least sum of level `i + 1`; `u32::MAX` for level 256.
    thresholds: [u32; 256],
    /// Level at the start of each part; at most one threshold lies in a part.
    start: [u8; SumsSrgb8::PARTS + 1],
}

impl SumsSrgb8 {
    const PARTS: usize = Srgb8::PARTS;
    /// Full intensity.
    const ONE: u32 = 1 << 28;

    fn get() -> &'static SumsSrgb8 {
        static TABLE: OnceLock<SumsSrgb8> = OnceLock::new();
        TABLE.get_or_init(|| {
            let start = std::array::from_fn(|i| {
                SumsSrgb8::level((i * (SumsSrgb8::ONE as usize / SumsSrgb8::PARTS)) as u32)
            });
            let threshold = |i: usize| {
                // No sum up to the first has that level, the second has.
                let (mut below, mut above) = (0, SumsSrgb8::ONE);
                while above - below > 1 {
                    let middle = below + (above - below) / 2;
                    let side = if usize::from(SumsSrgb8::level(middle)) > i {
                        &mut above
                    } else {
                        &mut below
                    };
                    *side = middle;
                }
                if i < 255 { above } else { u32::MAX }
            };
            SumsSrgb8 { thresholds: std::array::from_fn(threshold), start }
        })
    }

    /// Returns the level of a sum by way of floats.
    fn level(sum: u32) -> u8 {
        let [light, ..] = finished(1.0, [sum; 3]);
        Srgb8::get().encode(f64::from(light).clamp(0.0, 1.0))
    }

    #[inline(always)]
    fn encode(&self, sum: u32) -> u8 {
        let sum = sum.min(SumsSrgb8::ONE);
        let level = self.start[sum as usize / (SumsSrgb8::ONE as usize / SumsSrgb8::PARTS)];
        level + u8::from(self.thresholds[usize::from(level)] <= sum)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_encode_as_their_floats_do() {
        let s = SumsSrgb8::get();
        let near = |at: u32| [at.saturating_sub(1), at, at.saturating_add(1)];
        let parts = (0..=SumsSrgb8::PARTS as u32).map(|i| i << 16);
        let marks = s.thresholds.iter().copied().chain(parts).chain([SumsSrgb8::ONE, u32::MAX]);
        let even = (0..=1_000_000).map(|i| i * 270);
        for sum in marks.flat_map(near).chain(even) {
            assert_eq!(s.encode(sum), SumsSrgb8::level(sum), "{sum}");
        }
    }

    #[test]
    fn srgb_thresholds_round_as_the_formula_does() {
        let s = Srgb8::get();
        let even = (0..=100_000).map(|i| f64::from(i) / 100_000.0);
        let next = s.thresholds[..255].iter().flat_map(|t| [t.next_down(), *t, t.next_up()]);
        // The middles and the ends of the table's parts.
        let halves = 2 * Srgb8::PARTS;
        let parts = (0..=halves).map(|i| i as f64 / halves as f64);
        for l in parts.clone().chain(even) {
            let want = (srgb_from_linear(l) * 255.0 + 0.5).floor() as u8;
            assert_eq!(s.encode(l), want, "{l}");
        }
        for l in next.chain(parts) {
            assert_eq!(usize::from(s.encode(l)), s.thresholds.partition_point(|&t| t <= l), "{l}");
        }
    }
}
