//! Converts a file's numbers, of any type and byte order, to [`Samples`].
//!
//! The codes of each type:
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
//! A 32-bit integer with a wide range loses its low bits (f32 has 24), as in every renderer that
//! samples floats. One value far beyond all others (-3e38) stands for none and becomes NaN. The
//! shift by the minimum keeps the span. A note says so, or the numbers are kept beside the codes
//! ([`crate::numbers`]).

use crate::error::{OpenErrorKind, Problem};
use crate::limit::ByteCap;
use crate::wide;
use slabcast_common::brick::{BrickGrid, MAX_BRICKS};
use slabcast_common::volume::{Samples, ValueMap};
use std::io::Read;
use std::panic::AssertUnwindSafe;
use std::sync::mpsc;

/// Most samples along an axis. A header that asks for more is likelier wrong than large: with
/// [`SAMPLES_MAX`] the other two axes would average below 2048.
pub(crate) const DIM_MAX: u64 = 16384;
/// Most samples of a volume: 4096^3, as many as [`MAX_BRICKS`] bricks hold.
pub(crate) const SAMPLES_MAX: u64 = 1 << 36;
/// Most bytes that are inflated only to be skipped (NIfTI extensions, a byte skip inside gzip).
/// Dense deflate decodes 240 MB/s (`examples/load` on 64 MiB of noise in 4 bits: 0.27 s), so this
/// is 0.07 s of the 0.1 s that docs/design/promises.md R13 allows for refusing a file.
pub(crate) const SKIP_MAX_BYTES: u64 = 16 << 20;
/// Bytes decoded at a time: a multiple of every type's size that fits the second-level cache.
const CHUNK_BYTES: usize = 128 << 10;
/// Chunks that the decompressing thread may be ahead: half a megabyte.
const CHUNKS_AHEAD: usize = 4;
/// Least size of samples that are decompressed in a thread of their own: 9 ms at 240 MB/s.
const THREAD_MIN_BYTES: u64 = 2 << 20;

/// Type of a sample in a file.
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
    /// Returns the type that NumPy calls `name` (`u1`, `i2`, `f8`), as in .npy files and Zarr 2.
    pub(crate) fn from_numpy(name: &str) -> Option<Number> {
        Some(match name {
            "u1" => Number::U8,
            "i1" => Number::I8,
            "u2" => Number::U16,
            "i2" => Number::I16,
            "u4" => Number::U32,
            "i4" => Number::I32,
            "u8" => Number::U64,
            "i8" => Number::I64,
            "f4" => Number::F32,
            "f8" => Number::F64,
            _ => return None,
        })
    }

    /// Returns the size of a number in bytes.
    pub(crate) fn bytes(self) -> u64 {
        match self {
            Number::U8 | Number::I8 => 1,
            Number::U16 | Number::I16 => 2,
            Number::U32 | Number::I32 | Number::F32 => 4,
            Number::U64 | Number::I64 | Number::F64 => 8,
        }
    }

    /// Integer types, the smaller first, unsigned before signed.
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

    /// Returns the smallest and largest value of an integer type; `None` for floats.
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

    /// Returns the type of this name.
    pub(crate) fn named(name: &str) -> Option<Number> {
        let floats = [Number::F32, Number::F64];
        Number::INTEGERS.into_iter().chain(floats).find(|n| n.name() == name)
    }

    /// Returns the type's name, such as `uint8`.
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

/// Byte order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Endian {
    Little,
    Big,
}

/// Number of bytes of samples that a reader can have, known before it is read.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Supply {
    /// Uncompressed samples.
    Plain {
        /// Bytes of the file from the first sample on.
        have: u64,
    },
    /// Compressed samples, or samples written as text.
    Encoded {
        /// Name of the encoding.
        name: &'static str,
        /// Most bytes of the file that hold samples.
        bytes: u64,
        /// Most bytes of samples per byte of the file.
        ratio: u64,
    },
}

impl Supply {
    /// Returns the supply of a deflate stream in gzip or zlib. A match of 258 bytes takes at least
    /// two bits, so a false size is refused before anything is inflated.
    pub(crate) fn deflate(name: &'static str, bytes: u64) -> Supply {
        Supply::Encoded { name, bytes, ratio: 1032 }
    }
}

/// Sizes, type and byte order of the samples, with sizes within the limits.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layout {
    pub(crate) dims: [u32; 3],
    pub(crate) number: Number,
    pub(crate) endian: Endian,
}

impl Layout {
    /// Checks the sizes against the limits. `field` is the file's name for them.
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

    /// Returns the size of the uncompressed samples, in bytes.
    pub(crate) fn bytes(&self) -> u64 {
        self.count() as u64 * self.number.bytes()
    }
}

/// Reads the samples, if `cap` allows their size. Takes memory only for bytes that are known to
/// exist. Reads compressed data one byte past the declared size, to find surplus data and wrong
/// checksums.
pub(crate) fn read(
    reader: &mut (dyn Read + Send),
    supply: Supply,
    layout: &Layout,
    cap: ByteCap,
) -> Result<(Samples, ValueMap), Problem> {
    let need = layout.bytes();
    match supply {
        Supply::Plain { have } if have < need => return Err(truncated(need, have)),
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
    let (Supply::Plain { have: stored } | Supply::Encoded { bytes: stored, .. }) = supply;
    let streamed = cap.beside.stream().cloned();
    if streamed.is_none() {
        cap.check(need, stored, "size")?;
    }
    let bytes = ByteReader { reader, supply, need, received: 0 };
    let mut data = NumberReader { bytes, size: layout.number.bytes() as usize };
    if let Some(stream) = streamed {
        if let Some(mut sender) = stream.begin(layout)? {
            data.for_each_chunk(|bytes| sender.send(bytes))?;
        }
        return Ok((Samples::U8(Vec::new()), ValueMap::IDENTITY));
    }
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
    // Flipping the top bit of a signed number adds half its range.
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
                let first = out.len();
                words!(u16)(bytes, out);
                out[first..].iter_mut().for_each(|x| *x ^= 0x8000);
            })?;
            (Samples::U16(v), shifted(-32768.0))
        }
        Number::F32 => wide::without_fillers(data.collect(words!(f32))?, &cap.beside)?,
        Number::U32 => wide::compact_integers(data.collect_pieces(words!(u32))?, &cap.beside)?,
        Number::I32 => wide::compact_integers(data.collect_pieces(words!(i32))?, &cap.beside)?,
        Number::U64 => wide::compact_integers(data.collect_pieces(words!(u64))?, &cap.beside)?,
        Number::I64 => wide::compact_integers(data.collect_pieces(words!(i64))?, &cap.beside)?,
        Number::F64 => wide::compact_doubles(data.collect_pieces(words!(f64))?, &cap.beside)?,
    })
}

/// Decodes numbers of one size.
struct NumberReader<'a> {
    bytes: ByteReader<'a>,
    /// Bytes of a number.
    size: usize,
}

impl NumberReader<'_> {
    /// Returns all numbers in one list.
    fn collect<T>(&mut self, decode: impl Fn(&[u8], &mut Vec<T>)) -> Result<Vec<T>, Problem> {
        let count = (self.bytes.need / self.size as u64) as usize;
        let mut out = Vec::new();
        if matches!(self.bytes.supply, Supply::Plain { .. }) {
            reserve(&mut out, count)?;
        }
        let size = self.size;
        self.for_each_chunk(|bytes| {
            let numbers = bytes.len() / size;
            if out.capacity() - out.len() < numbers {
                // At most twice the numbers received, and no more than declared.
                let room = (2 * (out.len() + numbers)).min(count) - out.len();
                reserve(&mut out, room)?;
            }
            decode(bytes, &mut out);
            Ok(())
        })?;
        Ok(out)
    }

    /// Returns all numbers in pieces, which [`wide`] frees one by one.
    fn collect_pieces<T>(
        &mut self,
        decode: impl Fn(&[u8], &mut Vec<T>),
    ) -> Result<Vec<Vec<T>>, Problem> {
        let mut pieces: Vec<Vec<T>> = Vec::new();
        let (size, mut left) = (self.size, (self.bytes.need / self.size as u64) as usize);
        self.for_each_chunk(|bytes| {
            let numbers = bytes.len() / size;
            let full = |p: &Vec<T>| p.len() * size >= wide::PIECE_BYTES;
            if pieces.last().is_none_or(full) {
                pieces.push(Vec::new());
            }
            let piece = pieces.last_mut().expect("pushed above");
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

    /// Calls `take` with all bytes, in chunks that end between numbers. A thread of its own
    /// decompresses large data, up to [`CHUNKS_AHEAD`] chunks ahead.
    fn for_each_chunk(
        &mut self,
        mut take: impl FnMut(&[u8]) -> Result<(), Problem>,
    ) -> Result<(), Problem> {
        let bytes = &mut self.bytes;
        if matches!(bytes.supply, Supply::Plain { .. }) || bytes.need < THREAD_MIN_BYTES {
            let mut chunk = Vec::new();
            while bytes.next(&mut chunk)? {
                take(&chunk)?;
            }
            return Ok(());
        }
        std::thread::scope(|scope| {
            let (filled, chunks) = mpsc::sync_channel(CHUNKS_AHEAD);
            let (used, spare) = mpsc::channel::<Vec<u8>>();
            let decompress = move || {
                loop {
                    let mut chunk = spare.try_recv().unwrap_or_default();
                    // A panic becomes an error of the file; the scope would propagate it to the
                    // caller.
                    let next = AssertUnwindSafe(|| bytes.next(&mut chunk));
                    let next = std::panic::catch_unwind(next)
                        .unwrap_or_else(|panic| Err(Problem::panicked("data", &*panic)))
                        .map(|more| more.then_some(chunk));
                    let last = !matches!(next, Ok(Some(_)));
                    // The receiver is gone after an error of its own.
                    if filled.send(next).is_err() || last {
                        return;
                    }
                }
            };
            let builder = std::thread::Builder::new().name("slabcast-unpack".into());
            builder.spawn_scoped(scope, decompress).map_err(|e| Problem::io("data", &e))?;
            while let Ok(next) = chunks.recv() {
                let Some(chunk) = next? else { break };
                take(&chunk)?;
                let _ = used.send(chunk);
            }
            Ok(())
        })
    }
}

/// Reads exactly the bytes that the layout needs, in chunks.
struct ByteReader<'a> {
    reader: &'a mut (dyn Read + Send),
    supply: Supply,
    need: u64,
    /// Bytes read so far.
    received: u64,
}

impl ByteReader<'_> {
    /// Reads the next bytes into `chunk`; false after the last, whose end is checked.
    fn next(&mut self, chunk: &mut Vec<u8>) -> Result<bool, Problem> {
        if self.received == self.need {
            if matches!(self.supply, Supply::Encoded { .. }) {
                self.check_end()?;
            }
            return Ok(false);
        }
        chunk.resize((CHUNK_BYTES as u64).min(self.need - self.received) as usize, 0);
        self.fill(chunk)?;
        self.received += chunk.len() as u64;
        Ok(true)
    }

    /// Fills `chunk`, or fails with the bytes that are missing.
    fn fill(&mut self, chunk: &mut [u8]) -> Result<(), Problem> {
        let (received, mut filled) = (self.received, 0);
        while filled < chunk.len() {
            match self.reader.read(&mut chunk[filled..]) {
                Ok(0) => return Err(truncated(self.need, received + filled as u64)),
                Ok(n) => filled += n,
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
                Err(e) => return Err(self.read_problem(&e, received + filled as u64)),
            }
        }
        Ok(())
    }

    /// Tries to read one byte past the declared size: there must be none. On the way a compressed
    /// stream verifies its checksum.
    fn check_end(&mut self) -> Result<(), Problem> {
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
                Err(e) => return Err(self.read_problem(&e, self.need)),
            }
        }
    }

    fn read_problem(&self, e: &std::io::Error, have: u64) -> Problem {
        // Our own readers wrap a problem in the error; pass it on unchanged.
        if let Some(problem) = e.get_ref().and_then(|inner| inner.downcast_ref::<Problem>()) {
            return problem.clone();
        }
        match (self.supply, e.kind()) {
            (Supply::Encoded { name, .. }, std::io::ErrorKind::UnexpectedEof)
                if have == self.need =>
            {
                Problem::new(
                    OpenErrorKind::Damaged,
                    "data",
                    format!(
                        "truncated: all {have} bytes of samples are there, but the {name} stream \
                         ends before its checksum, so nothing shows that they are right"
                    ),
                    "get the whole file, or unpack what is there and pack it again",
                )
            }
            (Supply::Encoded { .. }, std::io::ErrorKind::UnexpectedEof) => {
                truncated(self.need, have)
            }
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

/// Returns the error for data of `have` bytes where `need` are declared.
pub(crate) fn truncated(need: u64, have: u64) -> Problem {
    Problem::new(
        OpenErrorKind::Damaged,
        "data",
        format!("truncated: {need} bytes are needed and {have} are there"),
        "get the whole file, or correct the sizes, the type or the skip",
    )
}

/// Reserves room for `more` items, or fails where there is no memory.
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
