//! Encodings between a file's bytes and its samples: packed, or written as text. Each is a reader
//! over a reader, so that nothing is ever held whole, and each says how much it can become at most
//! ([`Supply`]).

use crate::error::{OpenErrorKind, Problem, quoted};
use crate::samples::{Number, Supply};
use bzip2::bufread::MultiBzDecoder;
use flate2::bufread::{MultiGzDecoder, ZlibDecoder};
use std::io::{BufRead, Read};

/// How samples are encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Encoding {
    Raw,
    Gzip,
    Bzip2,
    /// Decimal numbers, whitespace between them.
    Ascii,
    /// Two digits a byte.
    Hex,
    /// A zlib stream or a gzip one: MetaImage writers make either.
    Deflate,
}

impl Encoding {
    /// A reader of bytes out of `inner`, which has `bytes` bytes left. Text becomes numbers in
    /// little-endian order whatever the header says ([`Encoding::has_order`]).
    pub(crate) fn open<'a>(
        self,
        mut inner: Box<dyn BufRead + Send + 'a>,
        bytes: u64,
        number: Number,
    ) -> std::io::Result<(Box<dyn Read + Send + 'a>, Supply)> {
        let encoded = |name, ratio| Supply::Encoded { name, bytes, ratio };
        Ok(match self {
            Encoding::Raw => (Box::new(inner), Supply::Plain { have: bytes }),
            Encoding::Gzip => {
                (Box::new(MultiGzDecoder::new(inner)), Supply::deflate("gzip", bytes))
            }
            Encoding::Deflate if inner.fill_buf()?.starts_with(&[0x1f, 0x8b]) => {
                (Box::new(MultiGzDecoder::new(inner)), Supply::deflate("gzip", bytes))
            }
            Encoding::Deflate => {
                (Box::new(ZlibDecoder::new(inner)), Supply::deflate("zlib", bytes))
            }
            // A block of 900,000 bytes holds runs of 259 as five bytes, and may then pack to 40.
            Encoding::Bzip2 => (Box::new(MultiBzDecoder::new(inner)), encoded("bzip2", 1 << 21)),
            // A digit and a space, at least; the last space may be missing, hence not a half.
            Encoding::Ascii => (
                Box::new(Text { inner, number, word: Vec::new(), out: [0; 8], at: 8, seen: 0 }),
                encoded("text", number.bytes()),
            ),
            Encoding::Hex => (Box::new(Hex { inner }), encoded("hexadecimal digits", 1)),
        })
    }

    /// Whether the file's byte order counts.
    pub(crate) fn has_order(self) -> bool {
        self != Encoding::Ascii
    }
}

/// A problem that travels through [`Read`].
pub(crate) fn wrapped(problem: Problem) -> std::io::Error {
    std::io::Error::new(std::io::ErrorKind::InvalidData, problem)
}

fn damaged(what: String, remedy: &str) -> std::io::Error {
    wrapped(Problem::new(OpenErrorKind::Damaged, "data", what, remedy))
}

/// Decimal numbers as bytes.
struct Text<'a> {
    inner: Box<dyn BufRead + Send + 'a>,
    number: Number,
    word: Vec<u8>,
    /// The number that is handed out, at the end of the eight bytes.
    out: [u8; 8],
    at: usize,
    /// Numbers before it, for messages.
    seen: u64,
}

/// Longest number: `-1.7976931348623157e+308` has 24 characters; some programs print 40 digits.
const WORD_MAX: usize = 64;

impl Text<'_> {
    /// The next word, or none at the end.
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
                // teem and ITK also put commas between numbers.
                if !b.is_ascii_whitespace() && b != b',' {
                    self.word.push(b);
                    if self.word.len() > WORD_MAX {
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

    fn number(&mut self) -> std::io::Result<()> {
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
        self.at = 8 - size;
        self.seen += 1;
        read.ok_or_else(|| {
            damaged(
                format!(
                    "number {} is {}, which is no {}",
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
            if self.at == 8 {
                if !self.next_word()? {
                    break;
                }
                self.number()?;
            }
            let n = (8 - self.at).min(buf.len() - done);
            buf[done..done + n].copy_from_slice(&self.out[self.at..self.at + n]);
            self.at += n;
            done += n;
        }
        Ok(done)
    }
}

/// Pairs of hexadecimal digits as bytes.
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
                            format!("{shown} is no hexadecimal digit"),
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

/// Groups of four base64 characters as bytes, up to the first that has padding. Whitespace
/// between characters is skipped; any other character ends it, unread.
pub(crate) struct Base64<R> {
    pub(crate) inner: R,
    group: [u8; 3],
    at: usize,
    have: usize,
    ended: bool,
}

impl<R: BufRead> Base64<R> {
    pub(crate) fn new(inner: R) -> Self {
        Base64 { inner, group: [0; 3], at: 0, have: 0, ended: false }
    }

    /// Reads the next group; none at the end.
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
        (self.at, self.have) = (0, 3 - padding);
        self.ended = padding > 0;
        Ok(true)
    }

    /// Makes ready for what follows another padding: VTK encodes a header and its data apart.
    pub(crate) fn restart(&mut self) {
        (self.at, self.have, self.ended) = (0, 0, false);
    }
}

impl<R: BufRead> Read for Base64<R> {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        let mut done = 0;
        while done < buf.len() {
            if self.at == self.have && (self.ended || !self.next_group()?) {
                break;
            }
            let n = (self.have - self.at).min(buf.len() - done);
            buf[done..done + n].copy_from_slice(&self.group[self.at..self.at + n]);
            self.at += n;
            done += n;
        }
        Ok(done)
    }
}
