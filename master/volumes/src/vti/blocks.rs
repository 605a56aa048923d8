//! Readers of compressed blocks, whose compressed and decoded sizes are known, and of text up to
//! the next tag.

use crate::error::{OpenErrorKind, Problem};
use crate::samples::Supply;
use crate::unpack::{self, wrapped};
use flate2::read::ZlibDecoder;
use std::io::{BufRead, Cursor, Read, Take};

/// Compression of the blocks of an array.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Compressor {
    Zlib,
    /// Bare lz4 blocks, whose decoded sizes the header has.
    Lz4,
    /// VTK's LZMA: each block is a whole xz file.
    Xz,
}

impl Compressor {
    /// Returns the limit on decoded bytes that `bytes` bytes of blocks can become.
    pub(super) fn supply(self, bytes: u64) -> Supply {
        match self {
            Compressor::Zlib => Supply::deflate("zlib", bytes),
            Compressor::Lz4 => Supply::Encoded { name: "lz4", bytes, ratio: LZ4_RATIO },
            Compressor::Xz => Supply::Encoded { name: "xz", bytes, ratio: unpack::XZ_RATIO },
        }
    }
}

/// Most decoded bytes for one byte of lz4: each byte adds at most 255 to a match's length.
const LZ4_RATIO: u64 = 255;
/// Most bytes of an lz4 block, which is decoded whole; VTK's own have 32 KiB.
const LZ4_MAX_BYTES: u64 = 16 << 20;

/// Position in the data: between two blocks, inside one, or after an error.
enum State {
    Between(Box<dyn Read + Send>),
    Inside(Block),
    Done,
}

/// An open block.
enum Block {
    Zlib(ZlibDecoder<Take<Box<dyn Read + Send>>>),
    /// A block that was decoded whole, and the data after it.
    Lz4(Cursor<Vec<u8>>, Box<dyn Read + Send>),
    Xz(Box<unpack::Xz<Take<Box<dyn Read + Send>>>>),
}

impl Block {
    /// Returns the data after the block.
    fn into_rest(self) -> std::io::Result<Box<dyn Read + Send>> {
        let mut rest = match self {
            Block::Zlib(decoder) => decoder.into_inner(),
            Block::Lz4(_, rest) => return Ok(rest),
            Block::Xz(decoder) => decoder.into_inner(),
        };
        std::io::copy(&mut rest, &mut std::io::sink())?;
        Ok(rest.into_inner())
    }
}

impl Read for Block {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        match self {
            Block::Zlib(decoder) => decoder.read(buf),
            Block::Lz4(bytes, _) => bytes.read(buf),
            Block::Xz(decoder) => decoder.read(buf),
        }
    }
}

/// Decodes blocks one after another.
pub(super) struct Blocks {
    compressor: Compressor,
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
    /// Decodes blocks of these compressed sizes. All become `size` bytes, but the last `last`, if
    /// that is not 0.
    pub(super) fn new(
        compressor: Compressor,
        inner: Box<dyn Read + Send>,
        packed: Vec<u64>,
        [size, last]: [u64; 2],
    ) -> Self {
        let state = State::Between(inner);
        Blocks { compressor, state, packed, size, last, block: 0, left: 0 }
    }

    fn damaged(&self, what: &str) -> std::io::Error {
        wrapped(Problem::new(
            OpenErrorKind::Damaged,
            format!("block {} of {}", self.block + 1, self.packed.len()),
            what,
            "get the file again",
        ))
    }

    /// Opens a block of `packed` bytes, which becomes `self.left`.
    fn open(&self, inner: Box<dyn Read + Send>, packed: u64) -> std::io::Result<Block> {
        let mut body = inner.take(packed);
        Ok(match self.compressor {
            Compressor::Zlib => Block::Zlib(ZlibDecoder::new(body)),
            Compressor::Xz => Block::Xz(Box::new(unpack::xz(body))),
            Compressor::Lz4 => {
                // Memory is taken only for a size that this many packed bytes can decode to.
                let most = LZ4_MAX_BYTES.min(LZ4_RATIO * packed.min(LZ4_MAX_BYTES));
                if self.left > most || packed > LZ4_MAX_BYTES {
                    return Err(self.damaged("says a size that it can't have"));
                }
                let mut bytes = Vec::new();
                body.read_to_end(&mut bytes)?;
                if bytes.len() as u64 != packed {
                    return Err(self.damaged("is cut off"));
                }
                let mut out = vec![0; self.left as usize];
                match lz4_flex::block::decompress_into(&bytes, &mut out) {
                    Ok(n) if n as u64 == self.left => {}
                    _ => return Err(self.damaged("is damaged")),
                }
                Block::Lz4(Cursor::new(out), body.into_inner())
            }
        })
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
                    self.state = State::Inside(self.open(inner, packed)?);
                }
                State::Inside(mut block) if self.left > 0 => {
                    let want = (buf.len() as u64).min(self.left) as usize;
                    let n = match block.read(&mut buf[..want]) {
                        Ok(0) => return Err(self.damaged("ends before its size")),
                        Ok(n) => n,
                        Err(e) if e.get_ref().is_some_and(|inner| inner.is::<Problem>()) => {
                            return Err(e);
                        }
                        Err(_) => return Err(self.damaged("is damaged")),
                    };
                    self.left -= n as u64;
                    self.state = State::Inside(block);
                    return Ok(n);
                }
                State::Inside(mut block) => {
                    // Reading to the end verifies the checksum.
                    match block.read(&mut [0]) {
                        Ok(0) => {}
                        Ok(_) => return Err(self.damaged("goes on after its size")),
                        Err(_) => return Err(self.damaged("is damaged")),
                    }
                    self.state = State::Between(block.into_rest()?);
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
