//! From a file's numbers to [`Samples`]: every type and byte order, at a stranger's word.
//!
//! What is kept, and why:
//!
//! | file | codes | value of code c |
//! |---|---|---|
//! | uint8, uint16, float32 | as they are | c |
//! | int8, int16 | shifted to unsigned | c - 128, c - 32768 |
//! | other integers within 65536 of each other | u16 | c + min |
//! | other integers | f32 in 0..1 | min + c (max - min) |
//! | float64 that f32 holds well | f32 | c |
//! | other float64 | f32 in 0..1 | min + c (max - min) |
//!
//! A 32-bit integer with a wide range loses its low bits (f32 has 24); so does every renderer
//! that samples floats. What it must not lose is the span, hence the shift by the minimum.

use crate::error::{OpenErrorKind, Problem};
use crate::wide;
use slabcast_common::brick::{BrickGrid, MAX_BRICKS};
use slabcast_common::volume::{Samples, ValueMap};
use std::io::Read;
use std::panic::AssertUnwindSafe;
use std::sync::mpsc;

/// Largest size along one axis. A header that asks for more is far likelier wrong than large:
/// with [`SAMPLES_MAX`] the other two would average below 724.
pub(crate) const DIM_MAX: u64 = 16384;
/// Most samples: 2048^3, 8 GiB of 8-bit codes. Larger ones want bricks read on demand.
pub(crate) const SAMPLES_MAX: u64 = 1 << 33;
/// Most bytes that are inflated only to be dropped (NIfTI extensions, a byte skip inside gzip).
/// Dense deflate gives 240 MB/s (`examples/load` on 64 MiB of noise in 4 bits: 0.27 s), so this
/// is 0.07 s of the 0.1 s that docs/design/promises.md R13 allows a file that turns out bad.
pub(crate) const SKIP_MAX_BYTES: u64 = 16 << 20;
/// Bytes decoded at a time; a multiple of every type's size. Fits the second-level cache.
const CHUNK_BYTES: usize = 128 << 10;
/// Chunks that are unpacked ahead: half a megabyte.
const AHEAD: usize = 4;
/// From so many bytes on a thread is worth its start: at 240 MB/s they take 9 ms to unpack.
const AHEAD_FROM_BYTES: u64 = 2 << 20;

/// A number's type in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Number {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl Number {
    pub(crate) fn bytes(self) -> u64 {
        match self {
            Number::U8 | Number::I8 => 1,
            Number::U16 | Number::I16 => 2,
            Number::U32 | Number::I32 | Number::F32 => 4,
            Number::U64 | Number::I64 | Number::F64 => 8,
        }
    }

    /// Integers, the smaller first, unsigned before signed.
    pub(crate) const INTEGERS: [Number; 8] = [
        Number::U8,
        Number::I8,
        Number::U16,
        Number::I16,
        Number::U32,
        Number::I32,
        Number::U64,
        Number::I64,
    ];

    /// Smallest and largest value of an integer type.
    pub(crate) fn limits(self) -> Option<(f64, f64)> {
        Some(match self {
            Number::U8 => (0.0, u8::MAX.into()),
            Number::I8 => (i8::MIN.into(), i8::MAX.into()),
            Number::U16 => (0.0, u16::MAX.into()),
            Number::I16 => (i16::MIN.into(), i16::MAX.into()),
            Number::U32 => (0.0, u32::MAX.into()),
            Number::I32 => (i32::MIN.into(), i32::MAX.into()),
            Number::U64 => (0.0, u64::MAX as f64),
            Number::I64 => (i64::MIN as f64, i64::MAX as f64),
            Number::F32 | Number::F64 => return None,
        })
    }

    /// Its name for people.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Number::U8 => "uint8",
            Number::I8 => "int8",
            Number::U16 => "uint16",
            Number::I16 => "int16",
            Number::U32 => "uint32",
            Number::I32 => "int32",
            Number::U64 => "uint64",
            Number::I64 => "int64",
            Number::F32 => "float32",
            Number::F64 => "float64",
        }
    }
}

/// Which end of a number comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Endian {
    Little,
    Big,
}

/// What is behind a reader.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Supply {
    /// This many bytes are there.
    Plain {
        /// Bytes from the first sample on.
        have: u64,
    },
    /// Samples that come out of other bytes: packed, or written as text.
    Encoded {
        /// What the encoding is called.
        name: &'static str,
        /// Bytes of the file from its start on, at most.
        bytes: u64,
        /// Bytes that one of them can at most become.
        ratio: u64,
    },
}

impl Supply {
    /// A deflate stream, with the header of gzip or of zlib: a match of 258 bytes takes at least
    /// two bits. Lets a liar be refused before anything is inflated.
    pub(crate) fn deflate(name: &'static str, bytes: u64) -> Supply {
        Supply::Encoded { name, bytes, ratio: 1032 }
    }
}

/// What a header says of its samples; the sizes are checked.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layout {
    pub(crate) dims: [u32; 3],
    pub(crate) number: Number,
    pub(crate) endian: Endian,
}

impl Layout {
    /// Checks sizes against the limits. `field` names them in the file's words.
    pub(crate) fn new(
        dims: [u64; 3],
        number: Number,
        endian: Endian,
        field: &str,
    ) -> Result<Layout, Problem> {
        let shown = format!("{} x {} x {}", dims[0], dims[1], dims[2]);
        if dims.contains(&0) {
            return Err(Problem::malformed(
                field,
                format!("{shown} has no samples"),
                "every size must be 1 or more",
            ));
        }
        let too_large = |what: String, remedy: &str| {
            Err(Problem::new(OpenErrorKind::TooLarge, field, what, remedy))
        };
        if dims.iter().any(|&n| n > DIM_MAX) {
            return too_large(
                format!("{shown} is longer than {DIM_MAX} along an axis"),
                "crop or downsample it",
            );
        }
        // Three factors of at most 2^14 can't overflow.
        if dims.iter().product::<u64>() > SAMPLES_MAX {
            return too_large(
                format!("{shown} has more than {SAMPLES_MAX} samples"),
                "crop or downsample it",
            );
        }
        let dims = dims.map(|n| n as u32);
        if BrickGrid::new(dims).dims.iter().map(|&n| u64::from(n)).product::<u64>() > MAX_BRICKS {
            return too_large(
                format!("{shown} has more than {MAX_BRICKS} bricks"),
                "crop or downsample it",
            );
        }
        Ok(Layout { dims, number, endian })
    }

    fn count(&self) -> usize {
        self.dims.iter().map(|&n| n as usize).product()
    }

    /// Bytes of the samples in the file, uncompressed.
    pub(crate) fn bytes(&self) -> u64 {
        self.count() as u64 * self.number.bytes()
    }
}

/// Reads the samples. Takes memory only as far as bytes are known to be there; a gzip stream is
/// followed to its declared size and one byte more.
pub(crate) fn read(
    reader: &mut (dyn Read + Send),
    supply: Supply,
    layout: &Layout,
) -> Result<(Samples, ValueMap), Problem> {
    let need = layout.bytes();
    match supply {
        Supply::Plain { have } if have < need => return Err(short(need, have)),
        Supply::Encoded { name, bytes, ratio } if need / ratio > bytes => {
            return Err(Problem::new(
                OpenErrorKind::Damaged,
                "data",
                format!(
                    "truncated: {need} bytes are declared, and {bytes} bytes of {name} can't hold \
                     so many"
                ),
                "get the whole file, or correct the sizes",
            ));
        }
        _ => {}
    }
    let bytes = Bytes { reader, supply, need, before: 0 };
    let mut data = Data { bytes, size: layout.number.bytes() as usize };
    let big = layout.endian == Endian::Big;
    macro_rules! words {
        ($t:ty) => {
            |bytes: &[u8], out: &mut Vec<$t>| {
                let words = bytes.chunks_exact(size_of::<$t>());
                if big {
                    out.extend(words.map(|w| <$t>::from_be_bytes(w.try_into().expect("a word"))));
                } else {
                    out.extend(words.map(|w| <$t>::from_le_bytes(w.try_into().expect("a word"))));
                }
            }
        };
    }
    // Flipping the top bit adds half the range.
    let shifted = |offset| ValueMap { scale: 1.0, offset };
    Ok(match layout.number {
        Number::U8 => {
            let v = data.collect(|bytes, out| out.extend_from_slice(bytes))?;
            (Samples::U8(v), ValueMap::IDENTITY)
        }
        Number::I8 => {
            let v = data.collect(|bytes, out| out.extend(bytes.iter().map(|b| b ^ 0x80)))?;
            (Samples::U8(v), shifted(-128.0))
        }
        Number::U16 => (Samples::U16(data.collect(words!(u16))?), ValueMap::IDENTITY),
        Number::I16 => {
            let v = data.collect(|bytes, out| {
                let from = out.len();
                words!(u16)(bytes, out);
                out[from..].iter_mut().for_each(|x| *x ^= 0x8000);
            })?;
            (Samples::U16(v), shifted(-32768.0))
        }
        Number::F32 => (Samples::F32(data.collect(words!(f32))?), ValueMap::IDENTITY),
        Number::U32 => wide::narrow(data.pieces(words!(u32))?, i128::from)?,
        Number::I32 => wide::narrow(data.pieces(words!(i32))?, i128::from)?,
        Number::U64 => wide::narrow(data.pieces(words!(u64))?, i128::from)?,
        Number::I64 => wide::narrow(data.pieces(words!(i64))?, i128::from)?,
        Number::F64 => wide::single(data.pieces(words!(f64))?)?,
    })
}

struct Data<'a> {
    bytes: Bytes<'a>,
    /// Bytes of a number.
    size: usize,
}

impl Data<'_> {
    /// All numbers in one list.
    fn collect<T>(&mut self, decode: impl Fn(&[u8], &mut Vec<T>)) -> Result<Vec<T>, Problem> {
        let count = (self.bytes.need / self.size as u64) as usize;
        let mut out = Vec::new();
        if matches!(self.bytes.supply, Supply::Plain { .. }) {
            reserve(&mut out, count)?;
        }
        let size = self.size;
        self.each(|bytes| {
            let numbers = bytes.len() / size;
            if out.capacity() - out.len() < numbers {
                // Never more than twice of what has come, nor more than was declared.
                let room = (2 * (out.len() + numbers)).min(count) - out.len();
                reserve(&mut out, room)?;
            }
            decode(bytes, &mut out);
            Ok(())
        })?;
        Ok(out)
    }

    /// All numbers in pieces, which [`wide`] gives back one by one.
    fn pieces<T>(&mut self, decode: impl Fn(&[u8], &mut Vec<T>)) -> Result<Vec<Vec<T>>, Problem> {
        let mut pieces: Vec<Vec<T>> = Vec::new();
        let (size, mut left) = (self.size, (self.bytes.need / self.size as u64) as usize);
        self.each(|bytes| {
            let numbers = bytes.len() / size;
            let full = |p: &Vec<T>| p.len() * size >= wide::PIECE_BYTES;
            if pieces.last().is_none_or(full) {
                pieces.push(Vec::new());
            }
            let piece = pieces.last_mut().expect("one was put there");
            if piece.capacity() - piece.len() < numbers {
                let most = left.min(wide::PIECE_BYTES / size - piece.len());
                reserve(piece, (piece.len() + 2 * numbers).min(most).max(numbers))?;
            }
            decode(bytes, piece);
            left -= numbers;
            Ok(())
        })?;
        Ok(pieces)
    }

    /// All bytes, in chunks that end between numbers. A large packed file is unpacked by a thread
    /// of its own, some chunks ahead of whoever takes them.
    fn each(&mut self, mut take: impl FnMut(&[u8]) -> Result<(), Problem>) -> Result<(), Problem> {
        let bytes = &mut self.bytes;
        if matches!(bytes.supply, Supply::Plain { .. }) || bytes.need < AHEAD_FROM_BYTES {
            let mut chunk = Vec::new();
            while bytes.next(&mut chunk)? {
                take(&chunk)?;
            }
            return Ok(());
        }
        std::thread::scope(|scope| {
            let (filled, chunks) = mpsc::sync_channel(AHEAD);
            let (used, spare) = mpsc::channel::<Vec<u8>>();
            let ahead = move || {
                loop {
                    let mut chunk = spare.try_recv().unwrap_or_default();
                    // A panic comes out as a problem: the scope would pass it on to whoever opens
                    // the file.
                    let next = AssertUnwindSafe(|| bytes.next(&mut chunk));
                    let next = std::panic::catch_unwind(next)
                        .unwrap_or_else(|panic| Err(Problem::panicked("data", &*panic)))
                        .map(|more| more.then_some(chunk));
                    let last = !matches!(next, Ok(Some(_)));
                    // Nobody listens any more after a problem at the other end.
                    if filled.send(next).is_err() || last {
                        return;
                    }
                }
            };
            let named = std::thread::Builder::new().name("slabcast-unpack".into());
            named.spawn_scoped(scope, ahead).map_err(|e| Problem::io("data", &e))?;
            while let Ok(next) = chunks.recv() {
                let Some(chunk) = next? else { break };
                take(&chunk)?;
                let _ = used.send(chunk);
            }
            Ok(())
        })
    }
}

/// The bytes of all numbers, as they come.
struct Bytes<'a> {
    reader: &'a mut (dyn Read + Send),
    supply: Supply,
    need: u64,
    /// Bytes that came already.
    before: u64,
}

impl Bytes<'_> {
    /// The next bytes into `chunk`; false at the end, which is where it should be.
    fn next(&mut self, chunk: &mut Vec<u8>) -> Result<bool, Problem> {
        if self.before == self.need {
            if matches!(self.supply, Supply::Encoded { .. }) {
                self.end()?;
            }
            return Ok(false);
        }
        chunk.resize((CHUNK_BYTES as u64).min(self.need - self.before) as usize, 0);
        self.fill(chunk)?;
        self.before += chunk.len() as u64;
        Ok(true)
    }

    /// Fills `chunk` or says what is missing.
    fn fill(&mut self, chunk: &mut [u8]) -> Result<(), Problem> {
        let (before, mut at) = (self.before, 0);
        while at < chunk.len() {
            match self.reader.read(&mut chunk[at..]) {
                Ok(0) => return Err(short(self.need, before + at as u64)),
                Ok(n) => at += n,
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
                Err(e) => return Err(self.broken(&e, before + at as u64)),
            }
        }
        Ok(())
    }

    /// One byte past the declared size: none may come, and a packed stream checks its sum on the
    /// way.
    fn end(&mut self) -> Result<(), Problem> {
        loop {
            match self.reader.read(&mut [0]) {
                Ok(0) => return Ok(()),
                Ok(_) => {
                    return Err(Problem::new(
                        OpenErrorKind::Damaged,
                        "data",
                        format!("goes on after the {} bytes that are declared", self.need),
                        "correct the sizes or the type",
                    ));
                }
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
                Err(e) => return Err(self.broken(&e, self.need)),
            }
        }
    }

    fn broken(&self, e: &std::io::Error, have: u64) -> Problem {
        // What our own readers say travels inside the error as it is.
        if let Some(problem) = e.get_ref().and_then(|inner| inner.downcast_ref::<Problem>()) {
            return problem.clone();
        }
        match (self.supply, e.kind()) {
            (Supply::Encoded { .. }, std::io::ErrorKind::UnexpectedEof) => short(self.need, have),
            (Supply::Encoded { name, .. }, _) => Problem::new(
                OpenErrorKind::Damaged,
                "data",
                format!("the {name} stream is damaged after {have} of {} bytes ({e})", self.need),
                "get the file again",
            ),
            _ => Problem::io("data", e),
        }
    }
}

pub(crate) fn short(need: u64, have: u64) -> Problem {
    Problem::new(
        OpenErrorKind::Damaged,
        "data",
        format!("truncated: {need} bytes are needed and {have} are there"),
        "get the whole file, or correct the sizes, the type or the skip",
    )
}

pub(crate) fn reserve<T>(out: &mut Vec<T>, more: usize) -> Result<(), Problem> {
    out.try_reserve_exact(more).map_err(|_| {
        Problem::new(
            OpenErrorKind::TooLarge,
            "data",
            format!("no memory for {} bytes", more as u128 * size_of::<T>() as u128),
            "use a machine with more memory, or crop or downsample it",
        )
    })
}

#[cfg(test)]
mod tests;
