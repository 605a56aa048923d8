//! Reader of raw numbers without a header. Size and type come from flags or from the file's name,
//! as in `head_256x256x256_uint8.raw`. Where they do not match the file's length, the error
//! suggests flags that would.

use crate::data::{self, Skip, Storage};
use crate::error::{OpenErrorKind, Problem};
use crate::samples::{Endian, Layout, Number};
use crate::source::Source;
use crate::unpack::Encoding;
use slabcast_common::volume::{Lattice, Volume};

/// Layout of a file of raw numbers, as the user gives it. A `None` is taken from the file's name,
/// else from the default. Of a TIFF stack only `spacing` is used.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RawHints {
    /// Number of samples along x, y and z; x is fastest in the file.
    pub dims: Option<[u64; 3]>,
    /// Type of a sample, set by [`RawHints::with_type`].
    pub(crate) number: Option<Number>,
    /// Whether the highest byte of a number comes first; little-endian by default.
    pub big_endian: Option<bool>,
    /// Distances between samples along x, y and z, in world units (mm); 1 by default.
    pub spacing: Option<[f64; 3]>,
    /// Bytes of the file before the first sample; 0 by default.
    pub skip: Option<u64>,
}

impl RawHints {
    /// Returns hints without a type, which [`RawHints::with_type`] adds. Units are the fields'.
    pub fn new(
        dims: Option<[u64; 3]>,
        big_endian: Option<bool>,
        spacing: Option<[f64; 3]>,
        skip: Option<u64>,
    ) -> RawHints {
        RawHints { dims, number: None, big_endian, spacing, skip }
    }

    /// Names of all sample types, separated by commas, for help and error texts.
    pub const TYPES: &str =
        "uint8, int8, uint16, int16, uint32, int32, uint64, int64, float32, float64";

    /// Returns the hints with the sample type called `name`, such as `uint8` or `float`, in any
    /// case; `None` if there is no such type.
    pub fn with_type(mut self, name: &str) -> Option<RawHints> {
        self.set_type(name).then_some(self)
    }

    fn set_type(&mut self, name: &str) -> bool {
        self.number = number_type(&name.to_ascii_lowercase());
        self.number.is_some()
    }

    /// Returns whether no hint is set.
    pub fn is_empty(&self) -> bool {
        *self == RawHints::default()
    }

    /// Fills in from a file's name what the flags leave open. A type with digits (`uint16`) goes
    /// before one that is an ordinary word (`short`), and the later word before the earlier. A byte
    /// order alone counts only after the size or a type with digits: files are called `big_one`.
    fn or_from_name(mut self, name: &str) -> RawHints {
        let stem = name.to_ascii_lowercase();
        let (mut dims, mut digits, mut word_type, mut order) = (None, None, None, None);
        // Sizes and types are runs of letters and digits; everything else separates words.
        for word in stem.split(|c: char| !c.is_ascii_alphanumeric()) {
            let sizes: Vec<&str> = word.split('x').collect();
            if let [a, b, c] = sizes[..]
                && let (Ok(a), Ok(b), Ok(c)) = (a.parse(), b.parse(), c.parse())
            {
                dims = dims.or(Some([a, b, c]));
                continue;
            }
            let placed = dims.is_some() || digits.is_some();
            match word {
                "le" | "little" if placed => order = order.or(Some(false)),
                "be" | "big" if placed => order = order.or(Some(true)),
                _ => {}
            }
            for (suffix, big) in [("", None), ("le", Some(false)), ("be", Some(true))] {
                let Some(n) = word.strip_suffix(suffix).and_then(number_type) else { continue };
                if word.contains(|c: char| c.is_ascii_digit()) {
                    digits = digits.or(Some(n));
                    order = big.or(order);
                } else {
                    word_type = Some(n);
                    order = order.or(big);
                }
            }
        }
        self.dims = self.dims.or(dims);
        self.number = self.number.or(digits).or(word_type);
        self.big_endian = self.big_endian.or(order);
        self
    }
}

fn number_type(name: &str) -> Option<Number> {
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

/// Returns whether the file's name or the hints give a size.
pub(crate) fn is_described(name: &str, hints: &RawHints) -> bool {
    hints.or_from_name(name).dims.is_some()
}

/// Reads raw numbers from the start of a source. `gzip` says that the file is compressed.
pub(crate) fn read(
    source: Source,
    gzip: bool,
    name: &str,
    hints: &RawHints,
) -> Result<Volume, Problem> {
    let known = hints.or_from_name(name);
    let len = source.len;
    let Some(dims) = known.dims else { return Err(unknown_size(len)) };
    let Some(number) = known.number else {
        return Err(Problem::malformed(
            "--type",
            match hints.dims {
                Some(dims) => {
                    format!("is missing, and the file's name has none, for {}", format_dims(dims))
                }
                None => format!("the file's name says {}, but no type", format_dims(dims)),
            },
            match (gzip, types_that_fit(len, dims)) {
                (false, Some(types)) => format!("give {types}, which would fit the {len} bytes"),
                _ => format!("give one of {}", RawHints::TYPES),
            },
        ));
    };
    let endian = if known.big_endian == Some(true) { Endian::Big } else { Endian::Little };
    let layout = Layout::new(dims, number, endian, "--dims")?;
    let skip = known.skip.unwrap_or(0);
    let need = layout.bytes();
    // The size of compressed data is known only after decompression; the reader checks it then.
    if !gzip && len.checked_sub(skip) != Some(need) {
        return Err(wrong_size(len, skip, dims, number));
    }
    let lattice = Lattice::from_spacing(layout.dims, known.spacing.unwrap_or([1.0; 3]));
    lattice.check().map_err(|e| Problem::malformed("--spacing", e, "give three lengths"))?;
    // Facts from the file's name are guesses, so a note tells them.
    if hints.dims.is_none() || hints.number.is_none() {
        let order = match (number.bytes(), endian) {
            (1, _) => "",
            (_, Endian::Little) => ", little-endian",
            (_, Endian::Big) => ", big-endian",
        };
        source.notes.add(format!(
            "raw numbers: {} of {}{order} were taken, by the file's name",
            format_dims(dims),
            number.name()
        ));
    }
    let storage = Storage {
        encoding: if gzip { Encoding::Gzip } else { Encoding::Raw },
        line_skip: 0,
        byte_skip: Skip::Bytes(skip),
        skip_field: "--skip",
    };
    let (samples, map) = data::read(source, len, &storage, &layout, None)?;
    Ok(crate::stream::volume(name, number.name(), false, lattice, samples, map))
}

fn format_dims([x, y, z]: [u64; 3]) -> String {
    format!("{x}x{y}x{z}")
}

fn product(dims: [u64; 3]) -> Option<u64> {
    dims.iter().try_fold(1u64, |n, &d| n.checked_mul(d)).filter(|n| *n > 0)
}

/// Returns the types with which `dims` samples fill `len` bytes, as flags.
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

/// Returns the error for a file of the wrong length, with flags that would fit it.
fn wrong_size(len: u64, skip: u64, dims: [u64; 3], number: Number) -> Problem {
    let need = product(dims).unwrap_or(u64::MAX).saturating_mul(number.bytes());
    let left = len.saturating_sub(skip);
    let after = if skip > 0 { format!(" after {skip} skipped ones") } else { String::new() };
    let what = format!(
        "holds {left} bytes{after}, and {} of {} take {need}",
        format_dims(dims),
        number.name()
    );
    let [x, y, z] = dims;
    // The likeliest mistakes first: the type, the number of slices, a header.
    let remedy = if let Some(types) = types_that_fit(left, dims) {
        format!("{types} would fit")
    } else if let Some(slice) = product([x, y, number.bytes()])
        && left.is_multiple_of(slice)
        && (1..=16384).contains(&(left / slice))
        && left / slice != z
    {
        format!("--dims {} would fit", format_dims([x, y, left / slice]))
    } else if left > need && left - need <= 1 << 16 {
        format!("--skip {} would fit, if the first {} bytes are a header", len - need, len - need)
    } else if let Some(n) = cube(left, number.bytes()) {
        format!("--dims {} would fit", format_dims([n; 3]))
    } else {
        "give --dims, --type and --skip as the file has them".into()
    };
    Problem::new(OpenErrorKind::Malformed, "size", what, remedy)
}

/// Returns the error for a file of unknown_size size, with a cube that would fit.
fn unknown_size(len: u64) -> Problem {
    let guess = [(1, "uint8"), (2, "uint16"), (4, "float32")]
        .into_iter()
        .find_map(|(bytes, name)| Some((cube(len, bytes)?, name)));
    let example = match guess {
        Some((n, kind)) => {
            format!("--dims {} --type {kind} would fit its {len} bytes", format_dims([n; 3]))
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

/// Returns `n` where n x n x n samples of `bytes` bytes fill `len` bytes.
fn cube(len: u64, bytes: u64) -> Option<u64> {
    let n = libm::cbrt((len / bytes) as f64).round() as u64;
    (n > 1 && n.checked_pow(3)?.checked_mul(bytes)? == len).then_some(n)
}

#[cfg(test)]
mod tests;
