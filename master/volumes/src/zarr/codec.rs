//! Codecs of chunks in Zarr versions 2 and 3, and the index of a shard.

use super::blosc;
use super::json::Json;
use crate::error::{OpenErrorKind, Problem};
use crate::samples::{Endian, Number, SKIP_MAX_BYTES};
use bzip2::read::MultiBzDecoder;
use flate2::read::{MultiGzDecoder, ZlibDecoder};
use ruzstd::decoding::StreamingDecoder;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};

/// A codec from bytes to bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Codec {
    Gzip,
    Zlib,
    Zstd,
    Blosc,
    /// lz4 of numcodecs: the decoded size, then a block.
    Lz4,
    /// A checksum of four bytes at the end.
    Crc32c,
    Bzip2,
    /// Python's LZMA in its default format, xz.
    Xz,
    /// Differences of neighbours, in the order of storage.
    Delta(Number, Endian),
    /// Byte shuffle of elements of this size: all first bytes, then all second ones, and so on.
    Shuffle(u64),
}

/// The codecs of a chunk. Decoding applies the last one first.
#[derive(Clone, Debug)]
pub(super) struct Codecs {
    pub(super) endian: Endian,
    /// In the order of encoding.
    list: Vec<Codec>,
    /// Axes of the array in the order of a chunk's storage, the slowest first; `None` is C order.
    order: Option<Vec<usize>>,
}

/// Layout of a shard, a file of inner chunks with an index.
#[derive(Clone, Debug)]
pub(super) struct Shard {
    /// Shape of an inner chunk.
    pub(super) inner: Vec<u64>,
    /// Layout of an inner chunk that is a shard itself.
    pub(super) nested: Option<Box<Shard>>,
    /// Whether the index is at the end of the file, not at its start.
    at_end: bool,
    /// Whether a checksum follows the index.
    checked: bool,
}

impl Codecs {
    /// Parses the codecs of version 3. If they are a shard, returns the codecs of its inner chunks,
    /// and its layout.
    pub(super) fn version_3(list: &Json, grid: &[u64]) -> Result<(Codecs, Option<Shard>), Problem> {
        let (mut codecs, mut shard) =
            (Codecs { endian: Endian::Little, list: Vec::new(), order: None }, None);
        for i in 0..list.len() {
            let codec = list.entry(i);
            let name = codec.required("name")?;
            let config = codec.get("configuration");
            let get = |key: &str| config.as_ref().and_then(|c| c.get(key));
            if let Some(id) = name.text()?.strip_prefix("numcodecs.") {
                let config = config.as_ref().unwrap_or(&codec);
                codecs.list.push(Codec::of_numcodecs(id, &name, config)?);
                continue;
            }
            match name.text()? {
                "bytes" | "endian" => match get("endian") {
                    None => {}
                    Some(e) if e.value == "little" => {}
                    Some(e) if e.value == "big" => codecs.endian = Endian::Big,
                    Some(e) => return Err(e.bad("little or big")),
                },
                "transpose" => {
                    let order =
                        get("order").ok_or_else(|| codec.bad("a transpose with an order"))?;
                    codecs.order = Some(permutation(&order, grid.len())?);
                }
                "gzip" => codecs.list.push(Codec::Gzip),
                "zstd" => codecs.list.push(Codec::Zstd),
                "blosc" => codecs.list.push(Codec::Blosc),
                "crc32c" => codecs.list.push(Codec::Crc32c),
                "sharding_indexed" if list.len() == 1 => {
                    let config = codec.required("configuration")?;
                    let inner = config.required("chunk_shape")?.sizes()?;
                    let (inside, nested) = Codecs::version_3(&config.required("codecs")?, &inner)?;
                    let nested = nested.map(Box::new);
                    if nested.as_ref().is_some_and(|shard| shard.nested.is_some()) {
                        return Err(name.bad("a shard of chunks, or of shards of chunks"));
                    }
                    shard = Some(Shard::from_config(&config, inner, nested)?);
                    codecs = inside;
                }
                "sharding_indexed" => return Err(name.bad("the only codec")),
                _ => {
                    return Err(
                        name.bad("bytes, transpose, gzip, zstd, blosc, crc32c or sharding_indexed")
                    );
                }
            }
        }
        // Differences are taken before the bytes have an order, and along the array's own axes.
        if codecs.list.iter().any(|c| matches!(c, Codec::Delta(..))) && codecs.order.is_some() {
            return Err(list.bad("without a transpose beside the delta"));
        }
        for codec in &mut codecs.list {
            if let Codec::Delta(_, endian) = codec {
                *endian = codecs.endian;
            }
        }
        Ok((codecs, shard))
    }

    /// Parses filters, compressor and order of version 2.
    pub(super) fn version_2(meta: &Json, endian: Endian, rank: usize) -> Result<Codecs, Problem> {
        let mut list = Vec::new();
        if let Some(filters) = meta.get("filters") {
            for i in 0..filters.len() {
                let (filter, id) = (filters.entry(i), filters.entry(i).required("id")?);
                match Codec::of_numcodecs(id.text()?, &id, &filter)? {
                    codec @ (Codec::Delta(..) | Codec::Shuffle(_)) => list.push(codec),
                    _ => return Err(id.bad("delta or shuffle")),
                }
            }
        }
        let order = match meta.get("order") {
            None => None,
            Some(o) if o.value == "C" => None,
            Some(o) if o.value == "F" => Some((0..rank).rev().collect()),
            Some(o) => return Err(o.bad("C or F")),
        };
        if let Some(compressor) = meta.get("compressor") {
            let id = compressor.required("id")?;
            list.push(Codec::of_numcodecs(id.text()?, &id, &compressor)?);
        }
        Ok(Codecs { endian, list, order })
    }

    /// Returns the stride, in samples of a chunk, along each axis of the array.
    pub(super) fn strides(&self, shape: &[u64]) -> Vec<usize> {
        let mut strides = vec![1; shape.len()];
        let mut step = 1;
        for k in (0..shape.len()).rev() {
            let axis = self.order.as_ref().map_or(k, |order| order[k]);
            strides[axis] = step;
            step *= shape[axis] as usize;
        }
        strides
    }

    /// Reads a chunk of `len` bytes and decodes it; it must become `bytes` bytes.
    pub(super) fn decode(
        &self,
        from: &mut dyn Read,
        len: u64,
        bytes: usize,
    ) -> Result<Vec<u8>, Problem> {
        Codecs::check_len(len, bytes)?;
        let mut data = Vec::with_capacity(len as usize + 1);
        from.take(len).read_to_end(&mut data).map_err(|e| Problem::io("file", &e))?;
        self.decode_bytes(data, bytes)
    }

    /// Checks the length of an encoded chunk against the length of its samples, before it is read:
    /// no encoding makes data much larger.
    pub(super) fn check_len(len: u64, bytes: usize) -> Result<(), Problem> {
        match len > 2 * bytes as u64 + 4096 {
            true => Err(damaged(format!("has {len} bytes for {bytes} of samples"))),
            false => Ok(()),
        }
    }

    /// Decodes a chunk, which must become `bytes` bytes.
    pub(super) fn decode_bytes(&self, mut data: Vec<u8>, bytes: usize) -> Result<Vec<u8>, Problem> {
        let most = 2 * bytes as u64 + 4096;
        for (i, codec) in self.list.iter().enumerate().rev() {
            // Between two codecs the data may still be compressed.
            let before = &self.list[..i];
            let sums = before.iter().filter(|c| **c == Codec::Crc32c).count();
            let want = if before.iter().all(|c| c.keeps_size()) {
                bytes + 4 * sums
            } else {
                most as usize
            };
            data = codec.decode(data, want)?;
        }
        match data.len() == bytes {
            true => Ok(data),
            false => Err(damaged(format!("has {} bytes of samples, not {bytes}", data.len()))),
        }
    }
}

fn damaged(what: String) -> Problem {
    Problem::new(OpenErrorKind::Damaged, "data", what, "get the array again")
}

impl Codec {
    /// Returns the codec that numcodecs calls `id`, with its settings. `name` is where it stands.
    fn of_numcodecs(id: &str, name: &Json, config: &Json) -> Result<Codec, Problem> {
        Ok(match id {
            "gzip" => Codec::Gzip,
            "zlib" => Codec::Zlib,
            "zstd" => Codec::Zstd,
            "blosc" => Codec::Blosc,
            "lz4" => Codec::Lz4,
            "bz2" => Codec::Bzip2,
            "lzma" => match config.get("format") {
                Some(format) if format.value != 1 => return Err(format.bad("1, that of xz")),
                _ => Codec::Xz,
            },
            "shuffle" => match config.get("elementsize").and_then(|n| n.value.as_u64()) {
                Some(size @ 1..=16) => Codec::Shuffle(size),
                None => Codec::Shuffle(4),
                Some(_) => return Err(config.bad("a shuffle of 1 to 16 bytes")),
            },
            "delta" => {
                let kind = config.required("dtype")?;
                let text = kind.text()?;
                let same = config.get("astype").is_none_or(|t| t.value == kind.value);
                let number = text.get(1..).and_then(Number::from_numpy);
                let number = number.filter(|_| same);
                let bad = || kind.bad("of a number type, and `astype` the same");
                let big = text.starts_with('>');
                let endian = if big { Endian::Big } else { Endian::Little };
                Codec::Delta(number.ok_or_else(bad)?, endian)
            }
            _ => {
                return Err(
                    name.bad("blosc, zstd, gzip, zlib, lz4, bz2 or lzma; filters delta or shuffle")
                );
            }
        })
    }

    /// Returns whether the codec keeps the length of a chunk, except for a checksum.
    fn keeps_size(self) -> bool {
        matches!(self, Codec::Crc32c | Codec::Delta(..) | Codec::Shuffle(_))
    }

    /// Decodes data to at most `most` bytes.
    fn decode(self, mut data: Vec<u8>, most: usize) -> Result<Vec<u8>, Problem> {
        let bad = |e: &dyn std::fmt::Display| {
            let text: String = e.to_string().chars().take(100).collect();
            damaged(format!("can't be unpacked ({text})"))
        };
        match self {
            Codec::Gzip => read_all(MultiGzDecoder::new(&data[..]), most),
            Codec::Zlib => read_all(ZlibDecoder::new(&data[..]), most),
            Codec::Zstd => zstd(&data, most),
            Codec::Blosc => blosc::decode(&data, most),
            Codec::Bzip2 => read_all(MultiBzDecoder::new(&data[..]), most),
            Codec::Xz => read_all(crate::unpack::xz(&data[..]), most),
            Codec::Delta(number, endian) => match sum_up(&mut data, number, endian) {
                true => Ok(data),
                false => Err(bad(&"it ends inside a number")),
            },
            Codec::Shuffle(size) => {
                let (size, count) = (size as usize, data.len() / size as usize);
                if !data.len().is_multiple_of(size) {
                    return Err(bad(&"it ends inside a number"));
                }
                Ok((0..data.len()).map(|i| data[i % size * count + i / size]).collect())
            }
            Codec::Lz4 => {
                let (head, block) =
                    data.split_first_chunk().ok_or_else(|| bad(&"it is cut off"))?;
                let size = u32::from_le_bytes(*head) as usize;
                if size > most {
                    return Err(damaged(format!("says that it becomes {size} bytes")));
                }
                let mut out = vec![0; size];
                let n = lz4_flex::block::decompress_into(block, &mut out).map_err(|e| bad(&e))?;
                out.truncate(n);
                Ok(out)
            }
            Codec::Crc32c => {
                let Some(end) = data.len().checked_sub(4) else {
                    return Err(bad(&"its checksum is cut off"));
                };
                if crc32c::crc32c(&data[..end]).to_le_bytes() != data[end..] {
                    return Err(damaged("does not have its checksum".into()));
                }
                data.truncate(end);
                Ok(data)
            }
        }
    }
}

/// Replaces each difference by the sum of all up to it. Returns false if the data end within a
/// number.
fn sum_up(data: &mut [u8], number: Number, endian: Endian) -> bool {
    macro_rules! sum {
        ($t:ty, $add:expr) => {{
            let mut sum = <$t>::default();
            for word in data.chunks_exact_mut(size_of::<$t>()) {
                let bytes = (&*word).try_into().expect("a word");
                let (add, big): (fn($t, $t) -> $t, bool) = ($add, endian == Endian::Big);
                let x = if big { <$t>::from_be_bytes(bytes) } else { <$t>::from_le_bytes(bytes) };
                sum = add(sum, x);
                word.copy_from_slice(&if big { sum.to_be_bytes() } else { sum.to_le_bytes() });
            }
        }};
    }
    match number {
        Number::U8 => sum!(u8, u8::wrapping_add),
        Number::I8 => sum!(i8, i8::wrapping_add),
        Number::U16 => sum!(u16, u16::wrapping_add),
        Number::I16 => sum!(i16, i16::wrapping_add),
        Number::U32 => sum!(u32, u32::wrapping_add),
        Number::I32 => sum!(i32, i32::wrapping_add),
        Number::U64 => sum!(u64, u64::wrapping_add),
        Number::I64 => sum!(i64, i64::wrapping_add),
        Number::F32 => sum!(f32, |a, b| a + b),
        Number::F64 => sum!(f64, |a, b| a + b),
    }
    (data.len() as u64).is_multiple_of(number.bytes())
}

/// Reads a reader to its end; fails after `most` bytes.
fn read_all(from: impl Read, most: usize) -> Result<Vec<u8>, Problem> {
    // Chunks are small enough to reserve at once; pages that stay empty are never touched.
    let mut out = Vec::with_capacity(most + 1);
    let read = from.take(most as u64 + 1).read_to_end(&mut out);
    read.map_err(|e| {
        let text: String = e.to_string().chars().take(100).collect();
        damaged(format!("can't be unpacked ({text})"))
    })?;
    match out.len() > most {
        true => Err(damaged(format!("goes on after {most} bytes"))),
        false => Ok(out),
    }
}

/// Decodes a zstd frame to at most `most` bytes. Checks the window and the content size that its
/// header declares first, since a header of six bytes can demand that memory (RFC 8878, 3.1.1.1).
pub(super) fn zstd(data: &[u8], most: usize) -> Result<Vec<u8>, Problem> {
    let cut = || damaged("has no whole zstd header".into());
    if data.get(..4) != Some(&[0x28, 0xb5, 0x2f, 0xfd]) {
        return Err(damaged("does not begin as zstd".into()));
    }
    let descriptor = *data.get(4).ok_or_else(cut)?;
    // A single segment has no window of its own: it is the content.
    let single = descriptor & 0x20 != 0;
    let start = 5 + usize::from(!single) + [0, 1, 2, 4][usize::from(descriptor & 3)];
    let field = match descriptor >> 6 {
        0 => usize::from(single),
        flag => 1 << flag,
    };
    let bytes = data.get(start..start + field).ok_or_else(cut)?;
    let content = bytes.iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
    let content = content.saturating_add(if field == 2 { 256 } else { 0 });
    if content > most as u64 {
        return Err(damaged(format!("says that it becomes {content} bytes, more than {most}")));
    }
    let window = if single {
        content
    } else {
        let byte = *data.get(5).ok_or_else(cut)?;
        let base = 1u64 << (10 + (byte >> 3));
        base + base / 8 * u64::from(byte & 7)
    };
    // Encoders use windows of up to 8 MiB even for small contents.
    if window > (most as u64).max(SKIP_MAX_BYTES) {
        return Err(damaged(format!("asks for a window of {window} bytes")));
    }
    let decoder = StreamingDecoder::new(data).map_err(|e| {
        let text: String = e.to_string().chars().take(100).collect();
        damaged(format!("can't be unpacked ({text})"))
    })?;
    read_all(decoder, most)
}

/// Parses the axes of a transpose, each once.
fn permutation(order: &Json, rank: usize) -> Result<Vec<usize>, Problem> {
    let list = order.sizes()?;
    let mut seen = vec![false; rank];
    for &a in &list {
        match seen.get_mut(a as usize) {
            Some(s) if !*s => *s = true,
            _ => return Err(order.bad("each axis once")),
        }
    }
    match list.len() == rank {
        true => Ok(list.into_iter().map(|a| a as usize).collect()),
        false => Err(order.bad("each axis once")),
    }
}

impl Shard {
    /// Returns the shape of the innermost chunks, which hold samples.
    pub(super) fn innermost(&self) -> &[u64] {
        self.nested.as_ref().map_or(&self.inner, |shard| shard.innermost())
    }

    fn from_config(
        config: &Json,
        inner: Vec<u64>,
        nested: Option<Box<Shard>>,
    ) -> Result<Shard, Problem> {
        let at_end = match config.get("index_location") {
            None => true,
            Some(l) if l.value == "end" => true,
            Some(l) if l.value == "start" => false,
            Some(l) => return Err(l.bad("start or end")),
        };
        let codecs = config.required("index_codecs")?;
        let mut checked = false;
        for i in 0..codecs.len() {
            let codec = codecs.entry(i);
            match codec.required("name")?.text()? {
                "bytes" => {
                    let endian = codec.get("configuration").and_then(|c| c.get("endian"));
                    if let Some(e) = endian.filter(|e| e.value != "little") {
                        return Err(e.bad("little"));
                    }
                }
                "crc32c" => checked = true,
                _ => return Err(codec.bad("bytes and crc32c")),
            }
        }
        Ok(Shard { inner, nested, at_end, checked })
    }

    /// Reads the index of a shard of `len` bytes from `at` on: offset from there and size, in
    /// bytes, of each inner chunk.
    pub(super) fn index(
        &self,
        file: &mut File,
        (at, len): (u64, u64),
        grid: &[u64],
    ) -> Result<Vec<(u64, u64)>, Problem> {
        let (start, bytes) = self.index_place(len, grid)?;
        let io = |e: std::io::Error| Problem::io("index", &e);
        let start = at + start;
        file.seek(SeekFrom::Start(start)).map_err(io)?;
        let mut data = Vec::new();
        file.take(bytes).read_to_end(&mut data).map_err(io)?;
        if data.len() as u64 != bytes {
            return Err(damaged("changed while it was read".into()));
        }
        self.parse_index(data)
    }

    /// Returns the first byte and the size of the index of a shard of `len` bytes.
    pub(super) fn index_place(&self, len: u64, grid: &[u64]) -> Result<(u64, u64), Problem> {
        let counts = grid.iter().zip(&self.inner).map(|(g, i)| g / i);
        let count = counts.into_iter().try_fold(1u64, u64::checked_mul);
        let bytes = count.and_then(|n| n.checked_mul(16)?.checked_add(4 * u64::from(self.checked)));
        let Some(bytes) = bytes.filter(|b| *b <= len) else {
            return Err(damaged(format!("has {len} bytes, less than its index takes")));
        };
        Ok((if self.at_end { len - bytes } else { 0 }, bytes))
    }

    /// Parses an index: offset and size, in bytes, of each inner chunk.
    pub(super) fn parse_index(&self, mut data: Vec<u8>) -> Result<Vec<(u64, u64)>, Problem> {
        if self.checked {
            data = Codec::Crc32c.decode(data, usize::MAX)?;
        }
        let word = |b: &[u8]| u64::from_le_bytes(b.try_into().expect("eight bytes"));
        Ok(data.chunks_exact(16).map(|e| (word(&e[..8]), word(&e[8..]))).collect())
    }
}
