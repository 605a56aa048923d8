//! The numbers of a dataset as the file's type message says them. The crate that parses keeps size, sign
//! and byte order alone: numbers of fewer bits, and floats that are not IEEE's, would come out wrong.

use super::{REMEDY, file};
use crate::error::{Problem, quoted};
use crate::plain::f32_of_half;
use crate::samples::Number;
use hdf5_reader::error::Result as ParserResult;
use hdf5_reader::{Dataset, Datatype, H5Type};

/// Type of a dataset's numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Stored {
    /// Type; float32 of float16.
    pub(super) number: Number,
    /// Whether the file has float16.
    pub(super) half: bool,
    pub(super) big_endian: bool,
}

/// Fields of IEEE's floats: bits, place and size of the exponent, size of the mantissa, bias.
const FLOATS: [(u32, [u8; 4], u32); 3] =
    [(2, [10, 5, 0, 10], 15), (4, [23, 8, 0, 23], 127), (8, [52, 11, 0, 52], 1023)];

impl Stored {
    /// Returns the type of a dataset's numbers, or an error that says what it holds instead.
    pub(super) fn of(dataset: &Dataset, path: &str) -> Result<Stored, Problem> {
        let raw = dataset.raw_datatype().map_err(|e| file::problem(&quoted(path), &e))?;
        Stored::parse(&raw)
            .map_err(|what| Problem::unsupported(quoted(path), format!("holds {what}"), REMEDY))
    }

    /// Parses a type message (HDF5 File Format Specification, IV.A.2.d).
    pub(super) fn parse(raw: &[u8]) -> Result<Stored, &'static str> {
        const SHORT: &str = "numbers whose type is damaged";
        let [class, flags, high_flags, _, size @ ..] = raw else { return Err(SHORT) };
        let size = u32::from_le_bytes(*size.first_chunk::<4>().ok_or(SHORT)?);
        let fields = &raw[8..];
        let short = |at: usize| fields.get(at..at + 2).map(|b| u16::from_le_bytes([b[0], b[1]]));
        let (offset, bits) = (short(0), short(2));
        let whole = offset == Some(0) && bits.map(u32::from) == size.checked_mul(8);
        let big_endian = flags & 1 != 0;
        match class & 15 {
            0 => {
                let number = match (size, flags & 8 != 0) {
                    (1, false) => Number::U8,
                    (1, true) => Number::I8,
                    (2, false) => Number::U16,
                    (2, true) => Number::I16,
                    (4, false) => Number::U32,
                    (4, true) => Number::I32,
                    (8, false) => Number::U64,
                    (8, true) => Number::I64,
                    _ => return Err("integers of an unusual size"),
                };
                if !whole {
                    return Err("integers that fill a part of their bytes");
                }
                Ok(Stored { number, half: false, big_endian })
            }
            1 => {
                let layout = fields.get(4..8).and_then(|b| b.first_chunk::<4>());
                let bias = fields.get(8..12).and_then(|b| b.first_chunk::<4>());
                let (Some(layout), Some(bias)) = (layout, bias) else { return Err(SHORT) };
                let is = (size, *layout, u32::from_le_bytes(*bias));
                // The leading bit of a mantissa is implied; the sign is the highest bit; no VAX order.
                let sign = u32::from(*high_flags) + 1 == size.saturating_mul(8);
                if !whole || !FLOATS.contains(&is) || flags & 0x70 != 0x20 || !sign {
                    return Err("floats that are not IEEE's (such as bfloat16)");
                }
                let number = if size == 8 { Number::F64 } else { Number::F32 };
                Ok(Stored { number, half: size == 2, big_endian })
            }
            // Names for integers, such as h5py's False and True; the type of these follows.
            8 => {
                let base = Stored::parse(fields)?;
                let is_bool = size == 1 && raw[1] == 2 && raw[2] == 0;
                match base.number.limits() {
                    Some(_) if base.number.bytes() != u64::from(size) => Err(SHORT),
                    Some(_) if is_bool => Ok(Stored { number: Number::U8, ..base }),
                    Some(_) => Ok(base),
                    None => Err("names that are no integers"),
                }
            }
            3 | 9 => Err("text or lists"),
            4 => Err("bits"),
            6 => Err("records of several numbers (complex numbers are such)"),
            7 => Err("references"),
            10 => Err("an array in each place"),
            _ => Err("no numbers"),
        }
    }

    /// Returns the bytes of a number in the file.
    pub(super) fn bytes(self) -> usize {
        if self.half { 2 } else { self.number.bytes() as usize }
    }

    /// Returns the value of a number's little-endian bytes. Integers of 64 bits may be rounded.
    pub(super) fn value(self, b: &[u8]) -> f64 {
        let mut wide = [0; 8];
        wide[..b.len().min(8)].copy_from_slice(&b[..b.len().min(8)]);
        let n = u64::from_le_bytes(wide);
        match self.number {
            Number::U8 | Number::U16 | Number::U32 | Number::U64 => n as f64,
            Number::I8 => (n as i8).into(),
            Number::I16 => (n as i16).into(),
            Number::I32 => (n as i32).into(),
            Number::I64 => n as i64 as f64,
            Number::F32 if self.half => f32_of_half(n as u16).into(),
            Number::F32 => f32::from_bits(n as u32).into(),
            Number::F64 => f64::from_bits(n),
        }
    }
}

/// A number's bytes as they are in the file.
#[derive(Clone)]
pub(super) struct Word<const N: usize>(pub(super) [u8; N]);

impl<const N: usize> H5Type for Word<N> {
    fn hdf5_type() -> Datatype {
        Datatype::Opaque { size: N as u32, tag: String::new() }
    }

    fn from_bytes(bytes: &[u8], _: &Datatype) -> ParserResult<Self> {
        match bytes.first_chunk::<N>() {
            Some(bytes) => Ok(Word(*bytes)),
            None => Err(hdf5_reader::error::Error::InvalidData("a number is cut off".into())),
        }
    }

    fn element_size(_: &Datatype) -> usize {
        N
    }

    fn decode_vec(raw: &[u8], _: &Datatype, count: usize) -> Option<ParserResult<Vec<Self>>> {
        let bytes = raw.get(..count.checked_mul(N)?)?;
        Some(Ok(bytes.as_chunks::<N>().0.iter().map(|b| Word(*b)).collect()))
    }
}
