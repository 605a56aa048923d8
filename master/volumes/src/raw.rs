//! Raw numbers without a header: size and type from flags or from the file's name, as in
//! `head_256x256x256_uint8.raw`, and a right guess where they don't fit.

use crate::data::{self, Form, Skip};
use crate::error::{OpenErrorKind, Problem};
use crate::samples::{Endian, Layout, Number};
use crate::source::Source;
use crate::unpack::Encoding;
use slabcast_common::volume::{Lattice, Volume};

/// What somebody says of raw numbers, or of pictures in a stack; what is `None` is taken from the
/// file's name, or from the default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RawHints {
    /// Samples along x, y, z (x fastest).
    pub dims: Option<[u64; 3]>,
    /// The type's name, such as `uint8`; parsed by [`RawHints::with_type`].
    pub(crate) number: Option<Number>,
    /// Bytes come highest first.
    pub big_endian: Option<bool>,
    /// Distances of the samples; 1 by default.
    pub spacing: Option<[f64; 3]>,
    /// Bytes before the first sample; 0 by default.
    pub skip: Option<u64>,
}

impl RawHints {
    /// Hints of everything but the type.
    pub fn new(
        dims: Option<[u64; 3]>,
        big_endian: Option<bool>,
        spacing: Option<[f64; 3]>,
        skip: Option<u64>,
    ) -> RawHints {
        RawHints { dims, number: None, big_endian, spacing, skip }
    }

    /// Types by name, for help and remedies.
    pub const TYPES: &str =
        "uint8, int8, uint16, int16, uint32, int32, uint64, int64, float32, float64";

    /// These hints with the type of that name; `None` where there is no such type.
    pub fn with_type(mut self, name: &str) -> Option<RawHints> {
        self.set_type(name).then_some(self)
    }

    fn set_type(&mut self, name: &str) -> bool {
        self.number = number(&name.to_ascii_lowercase());
        self.number.is_some()
    }

    /// Whether nothing was said.
    pub fn is_empty(&self) -> bool {
        *self == RawHints::default()
    }

    /// What a file's name says, where the flags say nothing.
    fn or_name(mut self, name: &str) -> RawHints {
        let stem = name.to_ascii_lowercase();
        // Letters stick to digits in sizes and types; everything else parts words.
        for word in stem.split(|c: char| !c.is_ascii_alphanumeric()) {
            let sizes: Vec<&str> = word.split('x').collect();
            if let [a, b, c] = sizes[..]
                && let (Ok(a), Ok(b), Ok(c)) = (a.parse(), b.parse(), c.parse())
            {
                self.dims = self.dims.or(Some([a, b, c]));
                continue;
            }
            match word {
                "le" | "little" => self.big_endian = self.big_endian.or(Some(false)),
                "be" | "big" => self.big_endian = self.big_endian.or(Some(true)),
                _ => {}
            }
            for (end, big) in [("", None), ("le", Some(false)), ("be", Some(true))] {
                if let Some(n) = word.strip_suffix(end).and_then(number) {
                    self.number = self.number.or(Some(n));
                    self.big_endian = self.big_endian.or(big);
                }
            }
        }
        self
    }
}

fn number(name: &str) -> Option<Number> {
    Some(match name {
        "uint8" | "u8" | "uchar" | "byte" => Number::U8,
        "int8" | "i8" | "char" => Number::I8,
        "uint16" | "u16" | "ushort" => Number::U16,
        "int16" | "i16" | "short" => Number::I16,
        "uint32" | "u32" | "uint" => Number::U32,
        "int32" | "i32" | "int" => Number::I32,
        "uint64" | "u64" => Number::U64,
        "int64" | "i64" => Number::I64,
        "float32" | "f32" | "float" => Number::F32,
        "float64" | "f64" | "double" => Number::F64,
        _ => return None,
    })
}

/// Whether a name or flags say enough to read the file as raw numbers.
pub(crate) fn is_described(name: &str, hints: &RawHints) -> bool {
    hints.or_name(name).dims.is_some()
}

/// Reads raw numbers from a source at its beginning; `gzip` says that they are packed.
pub(crate) fn read(
    source: Source,
    gzip: bool,
    name: &str,
    hints: &RawHints,
) -> Result<Volume, Problem> {
    let told = hints.or_name(name);
    let len = source.len;
    let Some(dims) = told.dims else { return Err(unknown(len)) };
    let Some(number) = told.number else {
        return Err(Problem::malformed(
            "--type",
            match hints.dims {
                Some(dims) => {
                    format!("is missing, and the file's name has none, for {}", shown(dims))
                }
                None => format!("the file's name says {}, but no type", shown(dims)),
            },
            match (gzip, types_that_fit(len, dims)) {
                (false, Some(types)) => format!("give {types}, which would fit the {len} bytes"),
                _ => format!("give one of {}", RawHints::TYPES),
            },
        ));
    };
    let endian = if told.big_endian == Some(true) { Endian::Big } else { Endian::Little };
    let layout = Layout::new(dims, number, endian, "--dims")?;
    let skip = told.skip.unwrap_or(0);
    let need = layout.bytes();
    // A packed file's size is known when it was unpacked; the reader tells.
    if !gzip && len.checked_sub(skip) != Some(need) {
        return Err(misfit(len, skip, dims, number));
    }
    let lattice = Lattice::from_spacing(layout.dims, told.spacing.unwrap_or([1.0; 3]));
    lattice.check().map_err(|e| Problem::malformed("--spacing", e, "give three lengths"))?;
    let form = Form {
        encoding: if gzip { Encoding::Gzip } else { Encoding::Raw },
        line_skip: 0,
        byte_skip: Skip::Bytes(skip),
        skip_field: "--skip",
    };
    let (samples, map) = data::read(source, len, &form, &layout)?;
    Ok(Volume::new(name, number.name(), false, lattice, samples, map))
}

fn shown([x, y, z]: [u64; 3]) -> String {
    format!("{x}x{y}x{z}")
}

fn product(dims: [u64; 3]) -> Option<u64> {
    dims.iter().try_fold(1u64, |n, &d| n.checked_mul(d)).filter(|n| *n > 0)
}

/// The types of which `dims` make `len` bytes, as flags.
fn types_that_fit(len: u64, dims: [u64; 3]) -> Option<&'static str> {
    match len.checked_div(product(dims)?)? * product(dims)? == len {
        true => match len / product(dims)? {
            1 => Some("--type uint8 (or int8)"),
            2 => Some("--type uint16 (or int16)"),
            4 => Some("--type float32 (or uint32, int32)"),
            8 => Some("--type float64 (or uint64, int64)"),
            _ => None,
        },
        false => None,
    }
}

/// The file's size is not what flags or name say: what would fit it.
fn misfit(len: u64, skip: u64, dims: [u64; 3], number: Number) -> Problem {
    let need = product(dims).unwrap_or(u64::MAX).saturating_mul(number.bytes());
    let left = len.saturating_sub(skip);
    let after = if skip > 0 { format!(" after {skip} skipped ones") } else { String::new() };
    let what =
        format!("holds {left} bytes{after}, and {} of {} take {need}", shown(dims), number.name());
    let [x, y, z] = dims;
    // In the order in which mistakes are made: the type, the slices, a header.
    let remedy = if let Some(types) = types_that_fit(left, dims) {
        format!("{types} would fit")
    } else if let Some(slice) = product([x, y, number.bytes()])
        && left.is_multiple_of(slice)
        && (1..=16384).contains(&(left / slice))
        && left / slice != z
    {
        format!("--dims {} would fit", shown([x, y, left / slice]))
    } else if left > need && left - need <= 1 << 16 {
        format!("--skip {} would fit, if the first {} bytes are a header", len - need, len - need)
    } else if let Some(n) = cube(left, number.bytes()) {
        format!("--dims {} would fit", shown([n; 3]))
    } else {
        "give --dims, --type and --skip as the file has them".into()
    };
    Problem::new(OpenErrorKind::Malformed, "size", what, remedy)
}

/// Nothing says how large it is.
fn unknown(len: u64) -> Problem {
    let guess = [(1, "uint8"), (2, "uint16"), (4, "float32")]
        .into_iter()
        .find_map(|(bytes, name)| Some((cube(len, bytes)?, name)));
    let example = match guess {
        Some((n, kind)) => {
            format!("--dims {} --type {kind} would fit its {len} bytes", shown([n; 3]))
        }
        None => format!("such as --dims 256x256x128 --type uint8; it has {len} bytes"),
    };
    Problem::new(
        OpenErrorKind::NotAVolume,
        "size",
        "is raw numbers without a header, and its name does not say how many",
        format!("give --dims and --type: {example}"),
    )
}

/// The `n` of n x n x n samples of `bytes` that make `len`.
fn cube(len: u64, bytes: u64) -> Option<u64> {
    let n = libm::cbrt((len / bytes) as f64).round() as u64;
    (n > 1 && n.checked_pow(3)?.checked_mul(bytes)? == len).then_some(n)
}

#[cfg(test)]
mod tests;
