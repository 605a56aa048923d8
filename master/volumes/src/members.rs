//! Decoder of gzip, bzip2 and zlib files: one stream after another, and what may follow the last.
//!
//! Tapes, flash tools and block devices fill a file up to a whole block. Such padding is ignored,
//! with a note, as gzip, Python and ITK do. Anything else after a stream is refused: it may be a
//! part of the volume that was damaged.

use crate::error::{OpenErrorKind, Problem, quoted};
use crate::source::Notes;
use crate::unpack::wrapped;
use bzip2::bufread::BzDecoder;
use flate2::bufread::{GzDecoder, ZlibDecoder};
use std::io::{BufRead, Error, ErrorKind, Read};

/// Most bytes of padding that are read; at 1 GiB/s they take 0.06 s.
const PADDING_SEEN_BYTES: u64 = 64 << 20;

/// Compression of a file. All but zlib allow several streams one after another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Packing {
    Gzip,
    Bzip2,
    Zlib,
}

impl Packing {
    fn name(self) -> &'static str {
        match self {
            Packing::Gzip => "gzip",
            Packing::Bzip2 => "bzip2",
            Packing::Zlib => "zlib",
        }
    }

    /// Returns the first byte of a stream that may follow another.
    fn first_byte(self) -> Option<u8> {
        match self {
            Packing::Gzip => Some(0x1f),
            Packing::Bzip2 => Some(b'B'),
            Packing::Zlib => None,
        }
    }
}

enum Decoder<R: BufRead> {
    Gzip(GzDecoder<R>),
    Bzip2(BzDecoder<R>),
    Zlib(ZlibDecoder<R>),
}

impl<R: BufRead> Decoder<R> {
    fn new(packing: Packing, inner: R) -> Self {
        match packing {
            Packing::Gzip => Decoder::Gzip(GzDecoder::new(inner)),
            Packing::Bzip2 => Decoder::Bzip2(BzDecoder::new(inner)),
            Packing::Zlib => Decoder::Zlib(ZlibDecoder::new(inner)),
        }
    }

    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        match self {
            Decoder::Gzip(d) => d.read(buf),
            Decoder::Bzip2(d) => d.read(buf),
            Decoder::Zlib(d) => d.read(buf),
        }
    }

    fn into_inner(self) -> R {
        match self {
            Decoder::Gzip(d) => d.into_inner(),
            Decoder::Bzip2(d) => d.into_inner(),
            Decoder::Zlib(d) => d.into_inner(),
        }
    }
}

/// Reads the decoded bytes of all streams of a file.
pub(crate) struct Members<R: BufRead> {
    packing: Packing,
    /// `None` after the end.
    decoder: Option<Decoder<R>>,
    /// Whether the current stream is not the first and has returned no bytes yet.
    fresh: bool,
    notes: Notes,
}

impl<R: BufRead> Members<R> {
    /// Decodes `inner`. Adds a note on ignored padding to `notes`.
    pub(crate) fn new(packing: Packing, inner: R, notes: Notes) -> Self {
        Members { packing, decoder: Some(Decoder::new(packing, inner)), fresh: false, notes }
    }

    fn surplus(&self, shown: &str) -> Error {
        let name = self.packing.name();
        wrapped(Problem::new(
            OpenErrorKind::Damaged,
            "data",
            format!(
                "the {name} stream is whole, but {shown} follows that is neither {name} nor padding"
            ),
            format!("get the file again, or unpack it with {name} -dc and pack it again"),
        ))
    }

    /// Begins the next stream; `None` at the end of the file or of its padding.
    fn following(&mut self, mut inner: R) -> std::io::Result<Option<Decoder<R>>> {
        let first = match inner.fill_buf()?.first() {
            None => return Ok(None),
            Some(&first) => first,
        };
        if Some(first) == self.packing.first_byte() {
            self.fresh = true;
            return Ok(Some(Decoder::new(self.packing, inner)));
        }
        let blank = |b: u8| b.is_ascii_whitespace() || b == 0x1a;
        let padding = |b: u8| b == first || blank(first) && blank(b);
        if !(matches!(first, 0 | 0xff) || blank(first)) {
            // zlib is used inside files of other formats, which may go on.
            if self.packing == Packing::Zlib {
                return Ok(None);
            }
            let head: String = String::from_utf8_lossy(inner.fill_buf()?).chars().take(8).collect();
            return Err(self.surplus(&quoted(&head)));
        }
        let mut seen = 0;
        loop {
            let chunk = inner.fill_buf()?;
            if chunk.is_empty() || seen >= PADDING_SEEN_BYTES {
                break;
            }
            if !chunk.iter().all(|&b| padding(b)) {
                if self.packing == Packing::Zlib {
                    return Ok(None);
                }
                return Err(self.surplus("something after padding"));
            }
            let n = chunk.len();
            inner.consume(n);
            seen += n as u64;
        }
        let (name, more) =
            (self.packing.name(), if seen >= PADDING_SEEN_BYTES { " or more" } else { "" });
        self.notes
            .add(format!("{seen}{more} bytes of padding after the {name} stream were ignored"));
        Ok(None)
    }
}

impl<R: BufRead> Read for Members<R> {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        while let Some(decoder) = &mut self.decoder
            && !buf.is_empty()
        {
            match decoder.read(buf) {
                Ok(0) => {
                    let inner = self.decoder.take().expect("taken above").into_inner();
                    self.decoder = self.following(inner)?;
                }
                Ok(n) => {
                    self.fresh = false;
                    return Ok(n);
                }
                Err(e) if self.fresh && e.kind() != ErrorKind::Interrupted => {
                    return Err(self.surplus("a second stream that is damaged or something"));
                }
                Err(e) => return Err(e),
            }
        }
        Ok(0)
    }
}

#[cfg(test)]
mod tests;
