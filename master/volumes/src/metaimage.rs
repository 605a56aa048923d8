//! Reader of MetaImage, attached (`.mha`) and detached (`.mhd` with one data file or a list of
//! them).
//!
//! Documentation: itk.org/Wiki/MetaIO/Documentation. A header is lines of `Key = Value`, the last
//! of them `ElementDataFile`. Where the documentation is silent this follows ITK's reader, since
//! ITK writes nearly all such files: rows of `TransformMatrix` are the directions of the index
//! axes, space is LPS (also without a matrix), and `CenterOfRotation` is ignored.

use crate::colours;
use crate::data::{self, HeaderLines, Skip, Storage};
use crate::error::{Problem, quoted};
use crate::pick::{Axis, Kind, Part, Pick};
use crate::samples::{Endian, Layout, Number};
use crate::source::{Notes, Source};
use crate::unpack::Encoding;
use glam::DVec3;
use slabcast_common::volume::{Lattice, Volume};
use std::collections::BTreeMap;
use std::path::Path;

/// Key of the header's last line, in lower case.
const DATA_FILE: &str = "elementdatafile";

/// Returns whether the first bytes are a header: a known key and an equals sign, after
/// comments.
pub(crate) fn sniff(head: &[u8]) -> bool {
    let text = |line: &[u8]| !line.trim_ascii().is_empty() && !line.starts_with(b"#");
    let Some(line) = head.split(|b| *b == b'\n').find(|line| text(line)) else { return false };
    let Some(equals) = line.iter().position(|b| *b == b'=') else { return false };
    let key = String::from_utf8_lossy(&line[..equals]).trim().to_ascii_lowercase();
    matches!(
        key.as_str(),
        "objecttype"
            | "objectsubtype"
            | "ndims"
            | "comment"
            | "name"
            | "id"
            | "transformtype"
            | "binarydata"
            | "compresseddata"
            | "dimsize"
            | "elementtype"
            | "elementspacing"
    )
}

/// Reads a volume from the start of a source. `folder` is the header's folder, where detached data
/// must lie.
pub(crate) fn read(mut source: Source, folder: &Path, name: &str) -> Result<Volume, Problem> {
    let (fields, header_bytes) = Fields::read(&mut source)?;
    let (layout, sizes, part) = layout(&fields, source.pick, &source.notes)?;
    let (lattice, anatomical) = lattice(&fields, layout.dims, &source.notes)?;
    let storage = storage(&fields)?;
    let (samples, map) = match data_files(&fields, &sizes)? {
        None => {
            let len = source.len.saturating_sub(header_bytes);
            data::read(source, len, &storage, &layout, part.as_ref())?
        }
        Some(names) => {
            let names = (&names[..], "ElementDataFile");
            let layout = (&layout, part.as_ref());
            data::read_files(folder, names, (source.cap, &source.notes), &storage, layout)?
        }
    };
    Ok(crate::stream::volume(name, layout.number.name(), anatomical, lattice, samples, map))
}

/// The header's fields: line number, key and value by key in lower case.
struct Fields {
    lines: BTreeMap<String, (usize, String, String)>,
    /// Names of data files after `ElementDataFile = LIST`.
    list: Vec<String>,
}

impl Fields {
    /// Reads the lines of a header and returns their bytes with the fields.
    fn read(source: &mut Source) -> Result<(Fields, u64), Problem> {
        let mut lines = BTreeMap::new();
        let (mut list, mut in_list) = (Vec::new(), false);
        const END: &str = "end the header with `ElementDataFile = LOCAL` or the data file's name";
        let mut header = HeaderLines::new(source, END);
        loop {
            let Some((number, text)) = header.next()? else {
                if in_list {
                    break;
                }
                return Err(Problem::malformed("ElementDataFile", "is missing", END));
            };
            let text = text.trim();
            if text.is_empty() || !in_list && text.starts_with('#') {
                continue;
            }
            if in_list {
                list.push(text.to_string());
                continue;
            }
            let Some((key, value)) = text.split_once('=') else {
                return Err(Problem::malformed(
                    format!("line {number}"),
                    format!("{} is not `Key = Value`", quoted(text)),
                    "correct or remove the line",
                ));
            };
            let (key, value) = (key.trim(), value.trim().to_string());
            let lower = key.to_ascii_lowercase();
            let last = lower == DATA_FILE;
            in_list = last && value.split_ascii_whitespace().next() == Some("LIST");
            let again = lines.insert(lower, (number, key.to_string(), value.clone()));
            if let Some((before, ..)) = again.filter(|(.., other)| *other != value) {
                return Err(Problem::malformed(
                    format!("line {number}"),
                    format!("{} was given in line {before} with another value", quoted(key)),
                    "remove one of them",
                ));
            }
            if last && !in_list {
                break;
            }
        }
        Ok((Fields { lines, list }, header.consumed_bytes()))
    }

    /// Returns key and value of the first of `keys` that is present.
    fn get<'a>(&'a self, keys: &[&str]) -> Option<(&'a str, &'a str)> {
        let found = keys.iter().find_map(|k| self.lines.get(&k.to_ascii_lowercase()));
        found.map(|(_, key, value)| (key.as_str(), value.as_str()))
    }

    /// Returns an error about the value of `key`, which must be present.
    fn bad(&self, key: &str, why: &str, remedy: &str) -> Problem {
        let (line, key, value) = &self.lines[&key.to_ascii_lowercase()];
        Problem::malformed(
            format!("{key} (line {line})"),
            format!("{} {why}", quoted(value)),
            remedy,
        )
    }

    fn required(&self, key: &str, example: &str) -> Result<&str, Problem> {
        self.get(&[key]).map(|(_, value)| value).ok_or_else(|| {
            Problem::malformed(key, "is missing", format!("add a line such as `{key} = {example}`"))
        })
    }

    /// Parses `True` or `False`; `None` if no key is present.
    fn flag(&self, keys: &[&str]) -> Result<Option<bool>, Problem> {
        let Some((key, value)) = self.get(keys) else { return Ok(None) };
        match value.to_ascii_lowercase().as_str() {
            "true" | "1" | "t" | "yes" => Ok(Some(true)),
            "false" | "0" | "f" | "no" => Ok(Some(false)),
            _ => Err(self.bad(key, "is neither", "give True or False")),
        }
    }

    /// Parses `n` numbers; `None` if no key is present.
    fn numbers(&self, keys: &[&str], n: usize) -> Result<Option<Vec<f64>>, Problem> {
        let Some((key, value)) = self.get(keys) else { return Ok(None) };
        let numbers: Result<Vec<f64>, _> = value.split_ascii_whitespace().map(str::parse).collect();
        match numbers {
            Ok(numbers) if numbers.len() == n => Ok(Some(numbers)),
            _ => Err(self.bad(key, &format!("is not {n} numbers"), "correct it")),
        }
    }
}

/// Returns the layout of the volume that is read, the sizes of all axes of the file, and which part
/// of its samples is read, if not all.
fn layout(
    fields: &Fields,
    pick: Pick,
    notes: &Notes,
) -> Result<(Layout, Vec<u64>, Option<Part>), Problem> {
    if let Some((key, value)) = fields.get(&["ObjectType"])
        && !value.eq_ignore_ascii_case("image")
    {
        return Err(fields.bad(key, "is not an image", "give a MetaImage of ObjectType Image"));
    }
    let axes = axes(fields)?;
    let channels = match fields.get(&["ElementNumberOfChannels"]) {
        None => 1,
        Some((key, value)) => match value.parse() {
            Ok(n @ 1u64..) => n,
            _ => return Err(fields.bad(key, "is not a number of channels", "correct it")),
        },
    };
    let number = match fields.required("ElementType", "MET_SHORT")?.to_ascii_uppercase().as_str() {
        "MET_CHAR" => Number::I8,
        "MET_UCHAR" => Number::U8,
        "MET_SHORT" => Number::I16,
        "MET_USHORT" => Number::U16,
        // MetaIO's long has four bytes everywhere.
        "MET_INT" | "MET_LONG" => Number::I32,
        "MET_UINT" | "MET_ULONG" => Number::U32,
        "MET_LONG_LONG" => Number::I64,
        "MET_ULONG_LONG" => Number::U64,
        "MET_FLOAT" => Number::F32,
        "MET_DOUBLE" => Number::F64,
        _ => {
            return Err(fields.bad(
                "ElementType",
                "is not a type of one number",
                "give one such as MET_UCHAR, MET_SHORT, MET_USHORT or MET_FLOAT",
            ));
        }
    };
    let big = fields.flag(&["BinaryDataByteOrderMSB", "ElementByteOrderMSB"])?;
    // Without the field ITK assumes the machine's order, which is little-endian.
    let endian = if big == Some(true) { Endian::Big } else { Endian::Little };
    fields.required("DimSize", "256 256 256")?;
    let sizes: Vec<u64> = fields
        .required("DimSize", "")?
        .split_ascii_whitespace()
        .map(str::parse)
        .collect::<Result<_, _>>()
        .map_err(|_| fields.bad("DimSize", "is not whole numbers", "correct it"))?;
    if sizes.len() != axes {
        return Err(fields.bad("DimSize", &format!("is not {axes} whole numbers"), "correct it"));
    }
    let (dims, more) = sizes.split_first_chunk::<3>().expect("there are three axes or more");
    let layout = Layout::new(*dims, number, endian, "DimSize")?;
    let colours = colours::may_be_colours(channels, number);
    let mut others = vec![Axis::of_voxel("numbers", channels, colours)];
    let along = |(i, &n): (usize, &u64)| match more.len() {
        1 => Axis::new(Kind::Other, "volumes", n),
        _ => Axis::new(Kind::Other, format!("along axis {}", i + 4), n),
    };
    others.extend(more.iter().enumerate().map(along));
    if more.contains(&0) {
        return Err(fields.bad("DimSize", "has no samples", "every size must be 1 or more"));
    }
    let field = if channels > 1 { "ElementNumberOfChannels" } else { "DimSize" };
    let (at, said) = pick.choose(&others, field)?;
    said.into_iter().for_each(|note| notes.add(note));
    if others.iter().all(|axis| axis.size == 1) {
        return Ok((layout, sizes, None));
    }
    let mut at = at.into_iter().map(Some).collect::<Vec<_>>();
    at.splice(1..1, [None; 3]);
    let all: Vec<u64> = std::iter::once(channels).chain(sizes.iter().copied()).collect();
    match Part::new(&all, at, number.bytes()) {
        Some(part) => Ok((layout, sizes, Some(part))),
        None => Err(fields.bad("DimSize", "has more samples than can be", "correct it")),
    }
}

/// Returns the number of axes. Volumes lie along those after the third.
fn axes(fields: &Fields) -> Result<usize, Problem> {
    match fields.required("NDims", "3")?.parse() {
        Ok(axes @ 3..=16) => Ok(axes),
        Ok(2) => {
            let sizes = fields.required("DimSize", "256 256")?.split_ascii_whitespace();
            let sizes: Vec<u64> = sizes.filter_map(|w| w.parse().ok()).collect();
            Err(match sizes[..] {
                [width, height] => Problem::flat("NDims", width, height),
                _ => fields.bad("DimSize", "is not 2 whole numbers", "correct it"),
            })
        }
        _ => Err(fields.bad("NDims", "is not 3", "save one volume of it with three axes")),
    }
}

fn storage(fields: &Fields) -> Result<Storage, Problem> {
    let binary = fields.flag(&["BinaryData"])?.unwrap_or(true);
    let packed = fields.flag(&["CompressedData"])?.unwrap_or(false);
    let encoding = match (binary, packed) {
        (true, true) => Encoding::Deflate,
        (true, false) => Encoding::Raw,
        (false, false) => Encoding::Ascii,
        (false, true) => {
            return Err(fields.bad(
                "CompressedData",
                "goes with BinaryData = True alone",
                "save it as binary data",
            ));
        }
    };
    let byte_skip = match fields.get(&["HeaderSize"]) {
        None => Skip::Bytes(0),
        Some((_, "-1")) if encoding == Encoding::Raw => Skip::FromEnd,
        Some((key, value)) => Skip::Bytes(value.parse().map_err(|_| {
            fields.bad(key, "is not a number of bytes", "give -1 (raw data alone), 0 or more")
        })?),
    };
    Ok(Storage { encoding, line_skip: 0, byte_skip, skip_field: "HeaderSize" })
}

/// Returns the data files of `LOCAL` (`None`), one name, `LIST [axes]` with a name on each
/// following line, or `name%03d.raw min max step`. By default a file of a list holds all axes but the
/// last.
fn data_files(fields: &Fields, sizes: &[u64]) -> Result<Option<Vec<String>>, Problem> {
    let value = fields.required("ElementDataFile", "LOCAL")?;
    let bad = |why: &str, remedy: &str| Err(fields.bad(DATA_FILE, why, remedy));
    let words: Vec<&str> = value.split_ascii_whitespace().collect();
    let (names, axes) = match words[..] {
        [] => return bad("is empty", "give LOCAL or name the data file"),
        [word] if word.eq_ignore_ascii_case("local") => return Ok(None),
        ["LIST"] => (fields.list.clone(), sizes.len() - 1),
        ["LIST", axes] => match axes.trim_end_matches(['d', 'D']).parse() {
            Ok(axes) if (1..=sizes.len()).contains(&axes) => (fields.list.clone(), axes),
            _ => return bad("has no number of axes", "give LIST, or LIST 2"),
        },
        [pattern, ref range @ ..]
            if pattern.contains('%')
                && (1..=3).contains(&range.len())
                && range.iter().all(|w| w.parse::<i64>().is_ok()) =>
        {
            let n = |i: usize, default: i64| {
                range.get(i).map_or(default, |w| w.parse().unwrap_or(default))
            };
            // In MetaIO, min alone means one file for each slice.
            let slices = sizes[2..].iter().fold(1u64, |n, &size| n.saturating_mul(size));
            let slices = i64::try_from(slices).unwrap_or(i64::MAX);
            let max = n(1, n(0, 0).saturating_add(slices - 1));
            match data::numbered_names(pattern, n(0, 0), max, n(2, 1)) {
                Some(names) => (names, 2),
                None => {
                    return bad(
                        "numbers its files in a way that is not known",
                        "give one number as %d or %03d, and a step other than 0",
                    );
                }
            }
        }
        _ => return Ok(Some(vec![value.to_string()])),
    };
    let want = sizes[axes..].iter().fold(1u64, |n, &size| n.saturating_mul(size));
    if names.len() as u64 != want {
        return bad(
            &format!("names {} files where DimSize wants {want}", names.len()),
            "correct the list or DimSize",
        );
    }
    Ok(Some(names))
}

/// Returns the lattice in RAS+, and whether its axes are anatomical. Axes after the third are time
/// or channels, of one sample.
fn lattice(fields: &Fields, dims: [u32; 3], notes: &Notes) -> Result<(Lattice, bool), Problem> {
    let n = axes(fields)?;
    let three = |v: &[f64]| DVec3::new(v[0], v[1], v[2]);
    // ITK writes ElementSpacing; ElementSize, the size of a sample, serves where it is absent.
    let spacing = fields.numbers(&["ElementSpacing", "ElementSize"], n)?;
    let spacing = spacing.map_or(DVec3::ONE, |v| three(&v));
    const MATRIX: [&str; 3] = ["TransformMatrix", "Rotation", "Orientation"];
    let rows = fields.numbers(&MATRIX, n * n)?;
    let origin = fields.numbers(&["Offset", "Position", "Origin"], n)?;
    let origin = origin.map_or(DVec3::ZERO, |v| three(&v));
    // LPS to RAS. Adding zero turns -0.0 into 0.0, which the digest would distinguish.
    let ras = |v: DVec3| v * DVec3::new(-1.0, -1.0, 1.0) + DVec3::ZERO;
    let mut lattice = Lattice::from_spacing(dims, spacing.to_array());
    lattice.origin = ras(origin);
    let field = match &rows {
        Some(rows) => {
            for (a, row) in rows.chunks_exact(n).take(3).enumerate() {
                if row[3..].iter().any(|x| *x != 0.0) {
                    let (key, _) = fields.get(&MATRIX).expect("it was parsed above");
                    return Err(fields.bad(
                        key,
                        "leads out of the space of its first three axes",
                        "save one volume of it with three axes",
                    ));
                }
                lattice.steps[a] = ras(three(row) * spacing[a]);
            }
            "TransformMatrix"
        }
        None => {
            lattice.steps = lattice.steps.map(ras);
            notes.add(
                "the file has no TransformMatrix; its axes were taken to run to the left, to \
                 posterior and to superior (LPS), as ITK does",
            );
            "ElementSpacing"
        }
    };
    lattice.check().map_err(|e| Problem::malformed(field, e, "correct the axes"))?;
    Ok((lattice, true))
}

#[cfg(test)]
mod tests;
