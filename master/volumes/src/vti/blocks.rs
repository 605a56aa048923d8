//! Readers of zlib blocks, each of known compressed and decoded size, and of text up to the next
//! tag.

use crate::error::{OpenErrorKind, Problem};
use crate::unpack::wrapped;
use flate2::read::ZlibDecoder;
use std::io::{BufRead, Read, Take};

/// Position in the data: between two blocks, inside one, or after an error.
enum State {
    Between(Box<dyn Read + Send>),
    Inside(ZlibDecoder<Take<Box<dyn Read + Send>>>),
    Done,
}

/// Decodes zlib blocks one after another.
pub(super) struct Blocks {
    state: State,
    /// Compressed size of each block, in bytes.
    packed: Vec<u64>,
    /// Decoded bytes of each block but the last.
    size: u64,
    /// Decoded bytes of the last block; 0 if it is whole.
    last: u64,
    /// Index of the current or next block.
    block: usize,
    /// Decoded bytes of the current block still to come.
    left: u64,
}

impl Blocks {
    pub(super) fn new(inner: Box<dyn Read + Send>, packed: Vec<u64>, size: u64, last: u64) -> Self {
        Blocks { state: State::Between(inner), packed, size, last, block: 0, left: 0 }
    }

    fn damaged(&self, what: &str) -> std::io::Error {
        wrapped(Problem::new(
            OpenErrorKind::Damaged,
            format!("block {} of {}", self.block + 1, self.packed.len()),
            what,
            "get the file again",
        ))
    }
}

impl Read for Blocks {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        if buf.is_empty() {
            return Ok(0);
        }
        loop {
            match std::mem::replace(&mut self.state, State::Done) {
                State::Done => return Ok(0),
                State::Between(inner) => {
                    let Some(&packed) = self.packed.get(self.block) else { return Ok(0) };
                    let last = self.block + 1 == self.packed.len() && self.last > 0;
                    self.left = if last { self.last } else { self.size };
                    self.state = State::Inside(ZlibDecoder::new(inner.take(packed)));
                }
                State::Inside(mut decoder) if self.left > 0 => {
                    let want = (buf.len() as u64).min(self.left) as usize;
                    let n = match decoder.read(&mut buf[..want]) {
                        Ok(0) => return Err(self.damaged("ends before its size")),
                        Ok(n) => n,
                        Err(e) if e.get_ref().is_some_and(|inner| inner.is::<Problem>()) => {
                            return Err(e);
                        }
                        Err(_) => return Err(self.damaged("is damaged")),
                    };
                    self.left -= n as u64;
                    self.state = State::Inside(decoder);
                    return Ok(n);
                }
                State::Inside(mut decoder) => {
                    // Reading to the end verifies the checksum.
                    match decoder.read(&mut [0]) {
                        Ok(0) => {}
                        Ok(_) => return Err(self.damaged("goes on after its size")),
                        Err(_) => return Err(self.damaged("is damaged")),
                    }
                    let mut rest = decoder.into_inner();
                    std::io::copy(&mut rest, &mut std::io::sink())?;
                    self.state = State::Between(rest.into_inner());
                    self.block += 1;
                }
            }
        }
    }
}

/// Reads text up to the next `<`.
pub(super) struct UntilTag<R> {
    pub(super) inner: R,
}

impl<R: BufRead> BufRead for UntilTag<R> {
    fn fill_buf(&mut self) -> std::io::Result<&[u8]> {
        let chunk = self.inner.fill_buf()?;
        let end = chunk.iter().position(|b| *b == b'<').unwrap_or(chunk.len());
        Ok(&chunk[..end])
    }

    fn consume(&mut self, n: usize) {
        self.inner.consume(n);
    }
}

impl<R: BufRead> Read for UntilTag<R> {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        let chunk = self.fill_buf()?;
        let n = chunk.len().min(buf.len());
        buf[..n].copy_from_slice(&chunk[..n]);
        self.consume(n);
        Ok(n)
    }
}
