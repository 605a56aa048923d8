//! Files read from front to back: a header, the samples, and perhaps a footer; plain or inside gzip.

use crate::data;
use crate::error::{OpenErrorKind, Problem};
use crate::limit::ByteCap;
use crate::members::{Members, Packing};
use crate::pick::{Part, Pick};
use crate::samples::{self, Endian, Layout, SKIP_MAX_BYTES, Supply};
use crate::source::{self, Notes, Source};
use slabcast_common::volume::{Samples, ValueMap};
use std::io::{ErrorKind, Read};

/// A file that is read from front to back.
pub(crate) struct Plain {
    reader: Box<dyn Read + Send>,
    gzip: bool,
    /// Bytes of the file.
    len: u64,
    pub(crate) cap: ByteCap,
    /// Which volume to read, if there are several.
    pub(crate) pick: Pick,
    pub(crate) notes: Notes,
    /// Bytes read so far, after decompression.
    pub(crate) consumed: u64,
}

impl Plain {
    /// Reads a source from its start; `gzip` says that it is compressed.
    pub(crate) fn new(source: Source, gzip: bool) -> Plain {
        let Source { reader, len, cap, pick, notes } = source;
        let reader: Box<dyn Read + Send> = match gzip {
            true => Box::new(Members::new(Packing::Gzip, reader, notes.clone())),
            false => Box::new(reader),
        };
        Plain { reader, gzip, len, cap, pick, notes, consumed: 0 }
    }

    /// Reads the next bytes of the header.
    pub(crate) fn header(&mut self, bytes: &mut [u8]) -> Result<(), Problem> {
        self.reader.read_exact(bytes).map_err(|e| broken(&e))?;
        self.consumed += bytes.len() as u64;
        Ok(())
    }

    /// Skips bytes of the header. `field` is the file's name for their number.
    pub(crate) fn skip(&mut self, bytes: u64, field: &str) -> Result<(), Problem> {
        if bytes > SKIP_MAX_BYTES {
            return Err(Problem::unsupported(
                field,
                format!("{bytes} bytes before the samples are more than the {SKIP_MAX_BYTES} read"),
                "save it again without an extended header",
            ));
        }
        self.consumed += bytes;
        match source::skip_bytes(&mut *self.reader, bytes).map_err(|e| broken(&e))? {
            true => Ok(()),
            false => Err(broken(&ErrorKind::UnexpectedEof.into())),
        }
    }

    /// Reads the samples, or a part of them; what follows them is a footer and ignored. Returns the
    /// number of bytes that follow, where the file is not compressed.
    pub(crate) fn samples(
        self,
        layout: &Layout,
        part: Option<&Part>,
    ) -> Result<(Samples, ValueMap, u64), Problem> {
        let left = self.len.saturating_sub(self.consumed);
        let supply = match self.gzip {
            true => Supply::deflate("gzip", self.len),
            false => Supply::Plain { have: left },
        };
        if let Some(part) = part {
            let (samples, map) = data::read_part(self.reader, supply, part, layout, self.cap)?;
            let whole = if self.gzip { left } else { part.whole_bytes() };
            return Ok((samples, map, left.saturating_sub(whole)));
        }
        let mut body = Body { reader: self.reader, left: layout.bytes(), gzip: self.gzip };
        let (samples, map) = samples::read(&mut body, supply, layout, self.cap)?;
        Ok((samples, map, if self.gzip { 0 } else { left - layout.bytes() }))
    }

    /// Reads samples that are 16-bit floats, as the 32-bit ones of a little-endian layout; `part` has
    /// two bytes a number. Otherwise like [`Plain::samples`].
    pub(crate) fn halves(
        self,
        layout: &Layout,
        endian: Endian,
        part: Option<&Part>,
    ) -> Result<(Samples, ValueMap, u64), Problem> {
        let left = self.len.saturating_sub(self.consumed);
        let need = part.map_or(layout.bytes() / 2, Part::end);
        let supply = match self.gzip {
            true => Supply::deflate("gzip", 2 * self.len),
            false if left < need => return Err(samples::truncated(need, left)),
            false => Supply::Plain { have: 2 * left },
        };
        let whole = part.map_or(need, Part::whole_bytes);
        let after = if self.gzip { 0 } else { left.saturating_sub(whole) };
        let inner: Box<dyn Read + Send> = match part {
            Some(part) => Box::new(part.reader(self.reader)),
            None => Box::new(Body { reader: self.reader, left: need, gzip: self.gzip }),
        };
        let (samples, map) =
            samples::read(&mut Halves { inner, endian }, supply, layout, self.cap)?;
        Ok((samples, map, after))
    }
}

fn broken(e: &std::io::Error) -> Problem {
    if let Some(problem) = e.get_ref().and_then(|inner| inner.downcast_ref::<Problem>()) {
        return problem.clone();
    }
    let damaged =
        |what: String, remedy: &str| Problem::new(OpenErrorKind::Damaged, "header", what, remedy);
    match e.kind() {
        ErrorKind::UnexpectedEof => {
            damaged("truncated: the file ends before the samples".into(), "get the whole file")
        }
        ErrorKind::InvalidInput | ErrorKind::InvalidData => {
            damaged(format!("the gzip stream is damaged ({e})"), "get the file again")
        }
        _ => Problem::io("header", e),
    }
}

/// The samples of a file. At their end a compressed footer is read, for its checksum alone.
struct Body {
    reader: Box<dyn Read + Send>,
    /// Bytes of samples that are still to be read.
    left: u64,
    gzip: bool,
}

impl Read for Body {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        if self.left > 0 {
            let n = buf.len().min(usize::try_from(self.left).unwrap_or(usize::MAX));
            let n = self.reader.read(&mut buf[..n])?;
            self.left -= n as u64;
            return Ok(n);
        }
        if self.gzip {
            std::io::copy(&mut (&mut self.reader).take(SKIP_MAX_BYTES), &mut std::io::sink())?;
        }
        Ok(0)
    }
}

/// Turns 16-bit floats into little-endian 32-bit ones.
pub(crate) struct Halves<R> {
    pub(crate) inner: R,
    pub(crate) endian: Endian,
}

impl<R: Read> Read for Halves<R> {
    /// Asks for a multiple of four bytes, as [`samples::read`] does, or gives fewer than asked for.
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        let mut words = [0u8; 8192];
        let want = (buf.len() / 4 * 2).min(words.len());
        if want == 0 {
            // The byte past the end.
            return self.inner.read(buf);
        }
        let mut have = 0;
        while have < want {
            match self.inner.read(&mut words[have..want]) {
                Ok(0) => break,
                Ok(n) => have += n,
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(e),
            }
        }
        let floats = words[..have].chunks_exact(2).map(|w| {
            let word = [w[0], w[1]];
            f32_of_half(match self.endian {
                Endian::Little => u16::from_le_bytes(word),
                Endian::Big => u16::from_be_bytes(word),
            })
        });
        let mut done = 0;
        for (to, float) in buf.chunks_exact_mut(4).zip(floats) {
            to.copy_from_slice(&float.to_le_bytes());
            done += 4;
        }
        Ok(done)
    }
}

/// Returns the value of an IEEE 754 half; exact.
pub(crate) fn f32_of_half(half: u16) -> f32 {
    let sign = u32::from(half & 0x8000) << 16;
    let (exponent, fraction) = (u32::from(half >> 10 & 0x1f), u32::from(half & 0x3ff));
    match (exponent, fraction) {
        // Zero, and the numbers below 2^-14, in steps of 2^-24.
        (0, f) => {
            let value = f as f32 / 16_777_216.0;
            if sign == 0 { value } else { -value }
        }
        (31, f) => f32::from_bits(sign | 0x7f80_0000 | f << 13),
        (e, f) => f32::from_bits(sign | (e + 112) << 23 | f << 13),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_become_the_floats_of_their_values() {
        for (half, value) in [
            (0x3c00, 1.0f32),
            (0xc000, -2.0),
            (0x7bff, 65504.0),
            (0x0001, 5.960_464_5e-8),
            (0x8000, -0.0),
            (0x0400, 6.103_515_6e-5),
            (0x3555, 0.333_251_95),
            (0x7c00, f32::INFINITY),
        ] {
            assert_eq!(f32_of_half(half).to_bits(), value.to_bits(), "{half:#x}");
        }
        assert!(f32_of_half(0x7e00).is_nan());
    }
}
