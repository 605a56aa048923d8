//! Reader of NumPy arrays: `.npy` of versions 1 to 3, and one array of an `.npz` archive.
//!
//! An array has no names for its axes and no spacing. The axis that is fastest in memory is taken
//! as x: the last one in C order, where pictures are stacked as z, y, x, and the first one in
//! Fortran order, in which nibabel keeps x, y, z. A note says which.

mod dict;

use crate::data;
use crate::error::{OpenErrorKind, Problem, quoted};
use crate::pick::{self, Axis, Part, Pick};
use crate::plain::{Halves, Plain};
use crate::raw::RawHints;
use crate::samples::{self, Endian, Layout, Number, Supply};
use crate::source::{Notes, Source};
use dict::Dict;
use slabcast_common::volume::{Lattice, Samples, ValueMap, Volume};
use std::io::Read;
use zip::{CompressionMethod, ZipArchive};

/// First bytes of an array.
pub(crate) const MAGIC: &[u8] = b"\x93NUMPY";
/// First bytes of a zip archive.
pub(crate) const ZIP: &[u8] = b"PK\x03\x04";

/// Longest header: NumPy itself reads 10,000 bytes unless told to trust the file.
const HEADER_MAX_BYTES: usize = 1 << 16;
/// Most files of an archive that are searched for arrays.
const MEMBERS_MAX: usize = 10_000;

/// Reads an array from the start of a source; `gzip` says that it is compressed.
pub(crate) fn read(
    source: Source,
    gzip: bool,
    name: &str,
    hints: &RawHints,
) -> Result<Volume, Problem> {
    let mut file = Plain::new(source, gzip);
    let notes = file.notes.clone();
    let array = Array::read(&mut |bytes| file.header(bytes))?;
    let layout = array.layout()?;
    let part = array.part(file.pick, &notes)?;
    let (samples, map, after) = match array.kind {
        Kind::Number(_) => file.samples(&layout, part.as_ref())?,
        Kind::Half => file.halves(&layout, array.endian, part.as_ref())?,
    };
    if after > 0 {
        notes.add(format!("{after} bytes after the array were not read"));
    }
    array.notes(hints).into_iter().for_each(|note| notes.add(note));
    volume(name, &array, layout, samples, map, hints)
}

/// Reads an array of a zip archive: the only one of numbers, or the one called `dataset`, with or
/// without `.npy`.
pub(crate) fn read_archive(
    source: Source,
    name: &str,
    hints: &RawHints,
    dataset: Option<&str>,
) -> Result<Volume, Problem> {
    let Source { reader, len, cap, pick, notes } = source;
    let mut archive = ZipArchive::new(reader).map_err(|e| zip_problem(&e))?;
    if archive.len() > MEMBERS_MAX {
        return Err(Problem::new(
            OpenErrorKind::TooLarge,
            "archive",
            format!("holds {} files, more than {MEMBERS_MAX}", archive.len()),
            "unpack it, and give one .npy file of it",
        ));
    }
    let names: Vec<String> = archive.file_names().flatten().map(|n| n.into_owned()).collect();
    let arrays: Vec<&str> = names.iter().filter_map(|n| n.strip_suffix(".npy")).collect();
    let list = |of: &[&str]| {
        let mut shown: Vec<String> = of.iter().take(6).map(|n| quoted(n)).collect();
        if of.len() > 6 {
            shown.push(format!("and {} more", of.len() - 6));
        }
        shown.join(", ")
    };
    let chosen = match (dataset, &arrays[..]) {
        (_, []) => return Err(no_array(&names)),
        (None, [one]) => *one,
        (None, several) => {
            return Err(Problem::malformed(
                "--dataset",
                format!("the archive holds {} arrays: {}", several.len(), list(several)),
                format!("name one of them, such as --dataset {}", several[0].escape_default()),
            ));
        }
        (Some(asked), all) => {
            let bare = asked.strip_suffix(".npy").unwrap_or(asked);
            *all.iter().find(|n| **n == bare).ok_or_else(|| {
                Problem::malformed(
                    "--dataset",
                    format!("there is no {} among {}", quoted(asked), list(all)),
                    "name one of them",
                )
            })?
        }
    };
    let mut member = archive.by_name(&format!("{chosen}.npy")).map_err(|e| zip_problem(&e))?;
    let stored = member.compressed_size().min(len);
    let plain = member.compression() == CompressionMethod::Stored;
    let mut consumed = 0;
    let array = Array::read(&mut |bytes| {
        consumed += bytes.len() as u64;
        member.read_exact(bytes).map_err(|e| {
            let cause = format!("is damaged ({e})");
            Problem::new(OpenErrorKind::Damaged, "header", cause, "get the file again")
        })
    })?;
    let layout = array.layout()?;
    let part = array.part(pick, &notes)?;
    let twice = if array.kind == Kind::Half { 2 } else { 1 };
    // A member without compression has a checksum, too, which the end of an encoded supply reads.
    let ratio = if plain { 1 } else { 1032 };
    let bytes = if plain { stored.saturating_sub(consumed) } else { stored };
    let supply = Supply::Encoded { name: "zip", bytes, ratio: ratio * twice };
    let (samples, map) = match (array.kind, &part) {
        (Kind::Number(_), None) => samples::read(&mut member, supply, &layout, cap)?,
        (Kind::Number(_), Some(part)) => data::read_part(member, supply, part, &layout, cap)?,
        (Kind::Half, None) => {
            let mut floats = Halves { inner: member, endian: array.endian };
            samples::read(&mut floats, supply, &layout, cap)?
        }
        (Kind::Half, Some(part)) => {
            let mut floats = Halves { inner: part.reader(member), endian: array.endian };
            samples::read(&mut floats, supply, &layout, cap)?
        }
    };
    if arrays.len() > 1 {
        notes.add(format!("array {} of {} was read", quoted(chosen), arrays.len()));
    }
    array.notes(hints).into_iter().for_each(|note| notes.add(note));
    volume(name, &array, layout, samples, map, hints)
}

/// Returns the error for an archive without arrays; `names` are the names of its files.
fn no_array(names: &[String]) -> Problem {
    let is_zarr = |n: &String| {
        [".zarray", ".zgroup", "zarr.json"].iter().any(|meta| n.rsplit('/').next() == Some(*meta))
    };
    let (what, remedy) = match names.iter().any(is_zarr) {
        true => ("is Zarr inside zip", "unpack it with unzip, and give its folder"),
        false => (
            "is a zip archive without NumPy arrays",
            "unpack it with unzip, and give the volume in it",
        ),
    };
    Problem::new(OpenErrorKind::NotAVolume, "content", what, remedy)
}

fn zip_problem(e: &zip::result::ZipError) -> Problem {
    let text: String = e.to_string().chars().take(120).collect();
    match e {
        zip::result::ZipError::UnsupportedArchive(_) => Problem::unsupported(
            "archive",
            format!("is not read ({text})"),
            "save it with numpy.savez or numpy.savez_compressed, without a password",
        ),
        _ => Problem::new(
            OpenErrorKind::Damaged,
            "archive",
            format!("is damaged ({text})"),
            "get the whole file",
        ),
    }
}

fn volume(
    name: &str,
    array: &Array,
    layout: Layout,
    samples: Samples,
    map: ValueMap,
    hints: &RawHints,
) -> Result<Volume, Problem> {
    let lattice = Lattice::from_spacing(layout.dims, hints.spacing.unwrap_or([1.0; 3]));
    lattice.check().map_err(|e| Problem::malformed("--spacing", e, "give three lengths"))?;
    let kind = match array.kind {
        Kind::Number(number) => number.name(),
        Kind::Half => "float16",
    };
    Ok(crate::stream::volume(name, kind, false, lattice, samples, map))
}

/// Type of an array's numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Number(Number),
    /// 16-bit floats.
    Half,
}

/// Header of an array: number type, byte order, order of axes and shape.
#[derive(Debug, PartialEq)]
struct Array {
    kind: Kind,
    endian: Endian,
    /// Sizes along x, y and z, the fastest first.
    dims: [u64; 3],
    /// Sizes of the slower axes, along which there are several volumes.
    more: Vec<u64>,
    fortran: bool,
}

impl Array {
    /// Reads the header with `fill`, which fills the next bytes.
    fn read(fill: &mut dyn FnMut(&mut [u8]) -> Result<(), Problem>) -> Result<Array, Problem> {
        let mut start = [0; 10];
        fill(&mut start)?;
        if !start.starts_with(MAGIC) {
            return Err(Problem::malformed(
                "magic",
                "is not that of a NumPy array",
                "save it again with numpy.save",
            ));
        }
        let len = match start[6] {
            1 => usize::from(u16::from_le_bytes([start[8], start[9]])),
            2 | 3 => {
                let mut high = [0; 2];
                fill(&mut high)?;
                u32::from_le_bytes([start[8], start[9], high[0], high[1]]) as usize
            }
            version => {
                return Err(Problem::unsupported(
                    "version",
                    format!("is {version}; versions 1 to 3 are read"),
                    "save it again with numpy.save",
                ));
            }
        };
        if len > HEADER_MAX_BYTES {
            return Err(Problem::malformed(
                "header",
                format!("takes {len} bytes, more than {HEADER_MAX_BYTES}"),
                "save it again with numpy.save, as an array of plain numbers",
            ));
        }
        let mut text = vec![0; len];
        fill(&mut text)?;
        Array::new(Dict::parse(&String::from_utf8_lossy(&text))?)
    }

    fn new(dict: Dict) -> Result<Array, Problem> {
        let (kind, endian) = number_of(&dict.descr)?;
        let sizes = dict.shape.iter().map(u64::to_string).collect::<Vec<_>>().join(", ");
        let mut shape = dict.shape;
        // An axis of one sample is none, as far as three are left.
        while shape.len() > 3
            && let Some(flat) = shape.iter().position(|&n| n == 1)
        {
            shape.remove(flat);
        }
        if !dict.fortran {
            shape.reverse();
        }
        let refused = |what: String, remedy: &str| Err(Problem::unsupported("shape", what, remedy));
        let Some((dims, more)) = shape.split_first_chunk::<3>() else {
            if let [width, height] = shape[..] {
                return Err(Problem::flat("shape", width, height));
            }
            return refused(
                format!("({sizes}) is not that of a volume, which has three axes"),
                "stack the pictures of a volume, for instance with numpy.stack",
            );
        };
        if !more.is_empty() && dims[0] <= 4 {
            return refused(
                format!("({sizes}) may have {} colours or components along an axis", dims[0]),
                "save one of them, for instance numpy.save('one.npy', a[..., 0])",
            );
        }
        Ok(Array { kind, endian, dims: *dims, more: more.to_vec(), fortran: dict.fortran })
    }

    /// Returns the layout of one volume; halves become floats.
    fn layout(&self) -> Result<Layout, Problem> {
        let (number, endian) = match self.kind {
            Kind::Number(number) => (number, self.endian),
            Kind::Half => (Number::F32, Endian::Little),
        };
        Layout::new(self.dims, number, endian, "shape")
    }

    /// Returns the part of the array that is the picked volume, if there are several.
    fn part(&self, pick: Pick, notes: &Notes) -> Result<Option<Part>, Problem> {
        let name = |i: usize| match (self.more.len(), self.fortran) {
            (1, _) => "volumes".to_string(),
            (_, true) => format!("along axis {}", 3 + i),
            (n, false) => format!("along axis {}", n - 1 - i),
        };
        let axes: Vec<Axis> = self
            .more
            .iter()
            .enumerate()
            .map(|(i, size)| Axis::new(pick::Kind::Other, name(i), *size))
            .collect();
        let (at, said) = pick.choose(&axes, "shape")?;
        said.into_iter().for_each(|note| notes.add(note));
        if axes.is_empty() {
            return Ok(None);
        }
        let sizes = [&self.dims[..], &self.more].concat();
        let at = [None; 3].into_iter().chain(at.into_iter().map(Some)).collect();
        let bytes = match self.kind {
            Kind::Number(number) => number.bytes(),
            Kind::Half => 2,
        };
        let Some(part) = Part::new(&sizes, at, bytes).filter(|_| !self.more.contains(&0)) else {
            return Err(Problem::malformed(
                "shape",
                "has no samples, or more than can be",
                "save it again with numpy.save",
            ));
        };
        Ok(Some(part))
    }

    /// Returns notes on what the array does not say.
    fn notes(&self, hints: &RawHints) -> Vec<String> {
        let axes = match self.fortran {
            true => "x, y, z (Fortran order, the first is fastest)",
            false => "z, y, x (C order, the last is fastest)",
        };
        let mut notes = vec![format!("the array's axes have no names; they were taken as {axes}")];
        if hints.spacing.is_none() {
            notes.push("NumPy keeps no spacing; 1 mm was taken (--spacing sets it)".into());
        }
        notes
    }
}

/// Returns the refusal of a type that is not a number, which `descr` names `name` after the byte
/// order.
fn unread_type(descr: &str, name: &str) -> Problem {
    let what = match name.chars().next() {
        Some('O') => "Python objects, which can run programs",
        Some('c') => "complex numbers",
        Some('U' | 'S' | 'a') => "text",
        Some('M' | 'm') => "times",
        Some('[') => "records of several fields",
        _ => "no type that is read",
    };
    Problem::unsupported(
        "descr",
        format!("{} is {what}", quoted(descr)),
        "save plain numbers, for instance numpy.save('one.npy', a.astype('float32'))",
    )
}

/// Returns type and byte order of a `descr` such as `<f4`.
fn number_of(descr: &str) -> Result<(Kind, Endian), Problem> {
    let (order, name) = match descr.split_at_checked(1) {
        Some((order @ ("<" | ">" | "|" | "="), name)) => (order, name),
        _ => ("=", descr),
    };
    let endian = match order {
        ">" => Endian::Big,
        "=" if cfg!(target_endian = "big") => Endian::Big,
        _ => Endian::Little,
    };
    let kind = match name {
        "b1" | "?" => Kind::Number(Number::U8),
        "f2" => Kind::Half,
        _ => Kind::Number(Number::from_numpy(name).ok_or_else(|| unread_type(descr, name))?),
    };
    Ok((kind, endian))
}

#[cfg(test)]
pub(crate) mod tests;
