//! Finished pictures: linear premultiplied RGBA, and their bytes.

use super::encode::{Background, Encoder, PixelFormat};
use crate::volume::Digest32;
use sha2::{Digest, Sha256};

/// A finished picture: linear premultiplied RGBA, row-major from the top left, before any
/// background.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Width and height of the picture in pixels.
    pub size: [u32; 2],
    /// Linear premultiplied RGBA, row-major from the top left.
    pub pixels: Vec<[f32; 4]>,
}

impl Picture {
    /// Returns the SHA-256 over row-major linear premultiplied RGBA f32, little endian
    /// (docs/design/contracts.md, Statistics).
    pub fn sha256(&self) -> Digest32 {
        let mut h = Sha256::new();
        hash(&mut h, &self.pixels);
        Digest32(h.finalize().into())
    }

    /// Returns the pixels in `format`, composited over `background`.
    pub fn encode(&self, format: PixelFormat, background: Background) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.pixels.len() * format.bytes());
        Encoder::new(format, background).put(&self.pixels, &mut out);
        out
    }
}

/// An encoded picture with its hash, as it leaves the master.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Encoded {
    /// Hash of the linear picture as [`Picture::sha256`] gives it; `None` if the job did not ask.
    pub sha256: Option<Digest32>,
    /// Bytes of the picture as [`Picture::encode`] gives them.
    pub bytes: Vec<u8>,
}

pub(super) fn hash(h: &mut Sha256, pixels: &[[f32; 4]]) {
    if cfg!(target_endian = "little") {
        h.update(bytemuck::cast_slice::<[f32; 4], u8>(pixels));
    } else {
        pixels.iter().flatten().for_each(|x| h.update(x.to_le_bytes()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn encodings_composite_over_the_background() {
        let p = Picture { size: [2, 1], pixels: vec![[0.25, 0.0, 0.0, 0.5], [0.0; 4]] };
        assert_eq!(p.encode(PixelFormat::Rgba8, Background::Transparent)[..4], [188, 0, 0, 128]);
        let over = p.encode(PixelFormat::Rgb8, Background::Colour([1.0, 1.0, 1.0]));
        assert_eq!(over, [225, 188, 188, 255, 255, 255]);
        assert_eq!(p.encode(PixelFormat::Rgba32F, Background::Transparent).len(), 32);
        assert_eq!(p.encode(PixelFormat::Rgba16, Background::Transparent).len(), 16);
    }
}
