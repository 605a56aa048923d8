//! Decoders between a file's bytes and its samples: compression, and numbers written as text. Each
//! is a reader over a reader, so that no file is held whole, and each bounds its output
//! ([`Supply`]).

use crate::error::{OpenErrorKind, Problem, quoted};
use crate::members::{Members, Packing};
use crate::samples::{Number, Supply};
use crate::source::Notes;
use std::io::{BufRead, Read};

/// Encoding of samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Encoding {
    Raw,
    Gzip,
    Bzip2,
    /// Decimal numbers separated by whitespace or commas.
    Ascii,
    /// Two hexadecimal digits for each byte.
    Hex,
    /// zlib or gzip; MetaImage writers produce either.
    Deflate,
}

impl Encoding {
    /// Returns a reader that decodes `inner`, which has `bytes` bytes left. Numbers in text come
    /// out little-endian whatever the header says ([`Encoding::has_order`]).
    pub(crate) fn open<'a>(
        self,
        mut inner: Box<dyn BufRead + Send + 'a>,
        bytes: u64,
        number: Number,
        notes: &Notes,
    ) -> std::io::Result<(Box<dyn Read + Send + 'a>, Supply)> {
        let encoded = |name, ratio| Supply::Encoded { name, bytes, ratio };
        let members = |packing, inner| Box::new(Members::new(packing, inner, notes.clone()));
        Ok(match self {
            Encoding::Raw => (Box::new(inner), Supply::Plain { have: bytes }),
            Encoding::Gzip => (members(Packing::Gzip, inner), Supply::deflate("gzip", bytes)),
            Encoding::Deflate if inner.fill_buf()?.starts_with(&[0x1f, 0x8b]) => {
                (members(Packing::Gzip, inner), Supply::deflate("gzip", bytes))
            }
            Encoding::Deflate => (members(Packing::Zlib, inner), Supply::deflate("zlib", bytes)),
            // Runs of 259 bytes become five, and a block of 900,000 of those compresses to 40.
            Encoding::Bzip2 => (members(Packing::Bzip2, inner), encoded("bzip2", 1 << 21)),
            // A number takes at least a digit and a space; the last space may be missing.
            Encoding::Ascii => (
                Box::new(Text { inner, number, word: Vec::new(), out: [0; 8], next: 8, seen: 0 }),
                encoded("text", number.bytes()),
            ),
            Encoding::Hex => (Box::new(Hex { inner }), encoded("hexadecimal digits", 1)),
        })
    }

    /// Returns whether the byte order of the header applies.
    pub(crate) fn has_order(self) -> bool {
        self != Encoding::Ascii
    }
}

/// Reader of one xz stream.
pub(crate) type Xz<R> = lzma_rust2::XzReader<R>;

/// Most bytes that a byte of xz stands for: a match of 273 bytes takes at least some ten decisions
/// of 1/45 bit each.
pub(crate) const XZ_RATIO: u64 = 1 << 14;
/// Most memory of an xz decoder: the dictionary of `xz -9`, 64 MiB, and 2 MiB beside it. It grows
/// with what is decoded.
const XZ_MEMORY_KIB: u32 = 66 << 10;

/// Returns a reader that decodes one xz stream.
pub(crate) fn xz<R: Read>(inner: R) -> Xz<R> {
    lzma_rust2::XzReader::new_mem_limit(inner, false, XZ_MEMORY_KIB)
}

/// Copies bytes of `piece` from `consumed` on into `buf`, as many as fit. Returns their number, by
/// which `consumed` grows.
pub(crate) fn copy_on(piece: &[u8], consumed: &mut usize, buf: &mut [u8]) -> usize {
    let n = (piece.len() - *consumed).min(buf.len());
    buf[..n].copy_from_slice(&piece[*consumed..*consumed + n]);
    *consumed += n;
    n
}

/// Wraps a problem in an I/O error, so that it passes through [`Read`].
pub(crate) fn wrapped(problem: Problem) -> std::io::Error {
    std::io::Error::new(std::io::ErrorKind::InvalidData, problem)
}

fn damaged(what: String, remedy: &str) -> std::io::Error {
    wrapped(Problem::new(OpenErrorKind::Damaged, "data", what, remedy))
}

/// Decodes decimal numbers to little-endian bytes.
struct Text<'a> {
    inner: Box<dyn BufRead + Send + 'a>,
    number: Number,
    word: Vec<u8>,
    /// The current number, at the end of the eight bytes.
    out: [u8; 8],
    /// Index in `out` of the next byte to hand out.
    next: usize,
    /// Numbers decoded so far, for error messages.
    seen: u64,
}

/// Longest number in characters: `-1.7976931348623157e+308` has 24, and some programs print 40
/// digits.
const WORD_MAX_BYTES: usize = 64;

impl Text<'_> {
    /// Reads the next word; false at the end.
    fn next_word(&mut self) -> std::io::Result<bool> {
        self.word.clear();
        loop {
            let chunk = self.inner.fill_buf()?;
            if chunk.is_empty() {
                return Ok(!self.word.is_empty());
            }
            let mut used = 0;
            let mut whole = false;
            for &b in chunk {
                used += 1;
                // teem and ITK also accept commas.
                if !b.is_ascii_whitespace() && b != b',' {
                    self.word.push(b);
                    if self.word.len() > WORD_MAX_BYTES {
                        whole = true;
                        break;
                    }
                } else if !self.word.is_empty() {
                    whole = true;
                    break;
                }
            }
            self.inner.consume(used);
            if whole {
                return Ok(true);
            }
        }
    }

    /// Decodes the word to the bytes of a number.
    fn decode_word(&mut self) -> std::io::Result<()> {
        let size = self.number.bytes() as usize;
        let text = std::str::from_utf8(&self.word).unwrap_or("?");
        macro_rules! le {
            ($t:ty) => {
                text.parse::<$t>().ok().map(|x| {
                    let bytes = x.to_le_bytes();
                    self.out[8 - bytes.len()..].copy_from_slice(&bytes);
                })
            };
        }
        let read = match self.number {
            Number::U8 => le!(u8),
            Number::I8 => le!(i8),
            Number::U16 => le!(u16),
            Number::I16 => le!(i16),
            Number::U32 => le!(u32),
            Number::I32 => le!(i32),
            Number::U64 => le!(u64),
            Number::I64 => le!(i64),
            Number::F32 => le!(f32),
            Number::F64 => le!(f64),
        };
        self.next = 8 - size;
        self.seen += 1;
        read.ok_or_else(|| {
            damaged(
                format!(
                    "number {} is {}, which is not a value of {}",
                    self.seen,
                    quoted(&String::from_utf8_lossy(&self.word)),
                    self.number.name()
                ),
                "correct it, or the type",
            )
        })
    }
}

impl Read for Text<'_> {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        let mut done = 0;
        while done < buf.len() {
            if self.next == 8 {
                if !self.next_word()? {
                    break;
                }
                self.decode_word()?;
            }
            let n = (8 - self.next).min(buf.len() - done);
            buf[done..done + n].copy_from_slice(&self.out[self.next..self.next + n]);
            self.next += n;
            done += n;
        }
        Ok(done)
    }
}

/// Decodes pairs of hexadecimal digits to bytes.
struct Hex<'a> {
    inner: Box<dyn BufRead + Send + 'a>,
}

impl Read for Hex<'_> {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        let mut done = 0;
        let mut first: Option<u8> = None;
        while done < buf.len() || first.is_some() {
            let chunk = self.inner.fill_buf()?;
            if chunk.is_empty() {
                if first.is_some() {
                    return Err(damaged(
                        "a byte has one hexadecimal digit".into(),
                        "get the whole file",
                    ));
                }
                break;
            }
            let mut used = 0;
            for &b in chunk {
                if done == buf.len() {
                    break;
                }
                used += 1;
                let digit = match b {
                    b'0'..=b'9' => b - b'0',
                    b'a'..=b'f' => b - b'a' + 10,
                    b'A'..=b'F' => b - b'A' + 10,
                    b if b.is_ascii_whitespace() => continue,
                    b => {
                        let shown = quoted(&String::from_utf8_lossy(&[b]));
                        return Err(damaged(
                            format!("{shown} is not a hexadecimal digit"),
                            "correct the data, or the encoding",
                        ));
                    }
                };
                match first.take() {
                    None => first = Some(digit),
                    Some(high) => {
                        buf[done] = high << 4 | digit;
                        done += 1;
                    }
                }
            }
            self.inner.consume(used);
        }
        Ok(done)
    }
}

/// Decodes base64 up to the first group with padding. Skips whitespace; any other character ends
/// the data and is not consumed.
pub(crate) struct Base64<R> {
    pub(crate) inner: R,
    /// The current group, decoded to at most three bytes.
    group: [u8; 3],
    /// Index in `group` of the next byte to hand out.
    next: usize,
    /// Bytes in `group`.
    have: usize,
    /// Whether a group had padding.
    ended: bool,
}

impl<R: BufRead> Base64<R> {
    pub(crate) fn new(inner: R) -> Self {
        Base64 { inner, group: [0; 3], next: 0, have: 0, ended: false }
    }

    /// Reads the next group; false at the end.
    fn next_group(&mut self) -> std::io::Result<bool> {
        let (mut bits, mut digits, mut padding) = (0u32, 0, 0);
        while digits + padding < 4 {
            let chunk = self.inner.fill_buf()?;
            let mut used = 0;
            let mut stop = chunk.is_empty();
            for &b in chunk {
                if digits + padding == 4 {
                    break;
                }
                let digit = match b {
                    b'A'..=b'Z' => b - b'A',
                    b'a'..=b'z' => b - b'a' + 26,
                    b'0'..=b'9' => b - b'0' + 52,
                    b'+' => 62,
                    b'/' => 63,
                    b'=' => {
                        padding += 1;
                        used += 1;
                        continue;
                    }
                    b if b.is_ascii_whitespace() => {
                        used += 1;
                        continue;
                    }
                    _ => {
                        stop = true;
                        break;
                    }
                };
                used += 1;
                if padding > 0 {
                    return Err(damaged(
                        "base64 goes on after its padding".into(),
                        "get the file again",
                    ));
                }
                bits = bits << 6 | u32::from(digit);
                digits += 1;
            }
            self.inner.consume(used);
            if stop {
                if digits + padding == 0 {
                    return Ok(false);
                }
                if digits + padding < 4 {
                    return Err(damaged(
                        "base64 ends inside a group of four".into(),
                        "get the whole file",
                    ));
                }
            }
        }
        if padding > 2 {
            return Err(damaged(
                "base64 has a group of padding alone".into(),
                "get the file again",
            ));
        }
        bits <<= 6 * padding;
        self.group = [(bits >> 16) as u8, (bits >> 8) as u8, bits as u8];
        (self.next, self.have) = (0, 3 - padding);
        self.ended = padding > 0;
        Ok(true)
    }

    /// Continues after padding: VTK encodes a header and its data separately.
    pub(crate) fn restart(&mut self) {
        (self.next, self.have, self.ended) = (0, 0, false);
    }
}

impl<R: BufRead> Read for Base64<R> {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        let mut done = 0;
        while done < buf.len() {
            if self.next == self.have && (self.ended || !self.next_group()?) {
                break;
            }
            let n = (self.have - self.next).min(buf.len() - done);
            buf[done..done + n].copy_from_slice(&self.group[self.next..self.next + n]);
            self.next += n;
            done += n;
        }
        Ok(done)
    }
}
