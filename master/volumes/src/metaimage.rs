//! MetaImage, attached (`.mha`) and detached (`.mhd` over one data file, or a list of them).
//!
//! A header is lines of `Key = Value`; `ElementDataFile` is the last of them. The format is told
//! at itk.org/Wiki/MetaIO/Documentation; where that is silent we do what ITK's reader does, since
//! ITK writes nearly all such files: rows of `TransformMatrix` are the directions of the index
//! axes, space is LPS, and `CenterOfRotation` is not looked at.

use crate::data::{self, Form, HeaderLines, Skip};
use crate::error::{Problem, quoted};
use crate::samples::{Endian, Layout, Number};
use crate::source::Source;
use crate::unpack::Encoding;
use glam::DVec3;
use slabcast_common::volume::{Lattice, Volume};
use std::collections::BTreeMap;
use std::path::Path;

/// The key that ends the header, in small letters.
const DATA_FILE: &str = "elementdatafile";

/// Whether these first bytes are a header: a known key and an equals sign begin it.
pub(crate) fn sniff(head: &[u8]) -> bool {
    let line = head.split(|b| *b == b'\n').next().unwrap_or_default();
    let Some(at) = line.iter().position(|b| *b == b'=') else { return false };
    let key = String::from_utf8_lossy(&line[..at]).trim().to_ascii_lowercase();
    matches!(key.as_str(), "objecttype" | "ndims" | "comment" | "objectsubtype")
}

/// Reads a volume from a source at its beginning. `folder` is where a detached header lies.
pub(crate) fn read(mut source: Source, folder: &Path, name: &str) -> Result<Volume, Problem> {
    let (fields, header_bytes) = Fields::read(&mut source)?;
    let layout = layout(&fields)?;
    let (lattice, anatomical) = place(&fields, layout.dims)?;
    let form = form(&fields)?;
    let (samples, map) = match data_files(&fields, layout.dims)? {
        None => {
            let len = source.len.saturating_sub(header_bytes);
            data::read(source, len, &form, &layout)?
        }
        Some(names) => data::read_files(folder, &names, "ElementDataFile", &form, &layout)?,
    };
    Ok(Volume::new(name, layout.number.name(), anatomical, lattice, samples, map))
}

/// The fields as written: key in small letters to line number, key and value.
struct Fields {
    lines: BTreeMap<String, (usize, String, String)>,
    /// Names of data files, where `ElementDataFile = LIST` announced them.
    list: Vec<String>,
}

impl Fields {
    /// Reads the lines of a header; also says how many bytes they take.
    fn read(source: &mut Source) -> Result<(Fields, u64), Problem> {
        let mut lines = BTreeMap::new();
        let (mut list, mut in_list) = (Vec::new(), false);
        const END: &str = "end the header with `ElementDataFile = LOCAL` or the data file's name";
        let mut header = HeaderLines::of(source, END);
        loop {
            let Some((number, text)) = header.next()? else {
                if in_list {
                    break;
                }
                return Err(Problem::malformed("ElementDataFile", "is missing", END));
            };
            let text = text.trim();
            if text.is_empty() {
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
            let small = key.to_ascii_lowercase();
            let last = small == DATA_FILE;
            in_list = last && value.split_ascii_whitespace().next() == Some("LIST");
            if let Some((before, ..)) = lines.insert(small, (number, key.to_string(), value)) {
                return Err(Problem::malformed(
                    format!("line {number}"),
                    format!("{} was given in line {before} already", quoted(key)),
                    "remove one of them",
                ));
            }
            if last && !in_list {
                break;
            }
        }
        Ok((Fields { lines, list }, header.consumed()))
    }

    /// The value of the first of these keys that is there, and the key.
    fn get<'a>(&'a self, keys: &[&str]) -> Option<(&'a str, &'a str)> {
        let found = keys.iter().find_map(|k| self.lines.get(&k.to_ascii_lowercase()));
        found.map(|(_, key, value)| (key.as_str(), value.as_str()))
    }

    /// Refuses the value of `key`, which is there.
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

    /// `True` or `False`.
    fn flag(&self, keys: &[&str]) -> Result<Option<bool>, Problem> {
        let Some((key, value)) = self.get(keys) else { return Ok(None) };
        match value.to_ascii_lowercase().as_str() {
            "true" | "1" | "t" | "yes" => Ok(Some(true)),
            "false" | "0" | "f" | "no" => Ok(Some(false)),
            _ => Err(self.bad(key, "is neither", "give True or False")),
        }
    }

    /// `N` numbers.
    fn numbers<const N: usize>(&self, keys: &[&str]) -> Result<Option<[f64; N]>, Problem> {
        let Some((key, value)) = self.get(keys) else { return Ok(None) };
        let numbers: Result<Vec<f64>, _> = value.split_ascii_whitespace().map(str::parse).collect();
        match numbers.map(<[f64; N]>::try_from) {
            Ok(Ok(numbers)) => Ok(Some(numbers)),
            _ => Err(self.bad(key, &format!("is not {N} numbers"), "correct it")),
        }
    }
}

fn layout(fields: &Fields) -> Result<Layout, Problem> {
    if let Some((key, value)) = fields.get(&["ObjectType"])
        && !value.eq_ignore_ascii_case("image")
    {
        return Err(fields.bad(key, "is no image", "give a MetaImage of ObjectType Image"));
    }
    let axes = fields.required("NDims", "3")?;
    if axes.parse() != Ok(3u32) {
        return Err(fields.bad("NDims", "is not 3", "save one volume of it with three axes"));
    }
    if let Some((key, value)) = fields.get(&["ElementNumberOfChannels"])
        && value.parse() != Ok(1u32)
    {
        return Err(fields.bad(key, "is not 1: a voxel is no single number", "save one channel"));
    }
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
                "is no type of one number",
                "give one such as MET_UCHAR, MET_SHORT, MET_USHORT or MET_FLOAT",
            ));
        }
    };
    let big = fields.flag(&["BinaryDataByteOrderMSB", "ElementByteOrderMSB"])?;
    // ITK takes the machine's order where the file says none, and machines are little-endian.
    let endian = if big == Some(true) { Endian::Big } else { Endian::Little };
    fields.required("DimSize", "256 256 256")?;
    let sizes: Vec<u64> = fields
        .required("DimSize", "")?
        .split_ascii_whitespace()
        .map(str::parse)
        .collect::<Result<_, _>>()
        .map_err(|_| fields.bad("DimSize", "is not three whole numbers", "correct it"))?;
    let dims: [u64; 3] = sizes
        .try_into()
        .map_err(|_| fields.bad("DimSize", "is not three whole numbers", "correct it"))?;
    Layout::new(dims, number, endian, "DimSize")
}

fn form(fields: &Fields) -> Result<Form, Problem> {
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
            fields.bad(key, "is no number of bytes", "give -1 (raw data alone), 0 or more")
        })?),
    };
    Ok(Form { encoding, line_skip: 0, byte_skip, skip_field: "HeaderSize" })
}

/// `LOCAL`, one name, `LIST [axes]` with names in lines of their own, or `name%03d.raw min max
/// step`; lists have a file a slice.
fn data_files(fields: &Fields, dims: [u32; 3]) -> Result<Option<Vec<String>>, Problem> {
    let value = fields.required("ElementDataFile", "LOCAL")?;
    let bad = |why: &str, remedy: &str| Err(fields.bad(DATA_FILE, why, remedy));
    let words: Vec<&str> = value.split_ascii_whitespace().collect();
    let (names, axes) = match words[..] {
        [] => return bad("is empty", "give LOCAL or name the data file"),
        [word] if word.eq_ignore_ascii_case("local") => return Ok(None),
        ["LIST"] => (fields.list.clone(), 2),
        ["LIST", axes] => match axes.trim_end_matches(['d', 'D']).parse() {
            Ok(axes @ 1..=3) => (fields.list.clone(), axes),
            _ => return bad("has no number of axes", "give LIST, or LIST 2"),
        },
        [pattern, ref range @ ..]
            if pattern.contains('%')
                && (1..=3).contains(&range.len())
                && range.iter().all(|w| w.parse::<i64>().is_ok()) =>
        {
            let n = |at: usize, or: i64| range.get(at).map_or(or, |w| w.parse().unwrap_or(or));
            // MetaIO: min alone means as many files as there are slices.
            let max = n(1, n(0, 0).saturating_add(i64::from(dims[2]) - 1));
            match data::numbered(pattern, n(0, 0), max, n(2, 1)) {
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
    let want = dims[axes..].iter().map(|&n| u64::from(n)).product::<u64>();
    if names.len() as u64 != want {
        return bad(
            &format!("names {} files where DimSize wants {want}", names.len()),
            "correct the list or DimSize",
        );
    }
    Ok(Some(names))
}

/// Where the samples lie, and whether that is said in anatomical axes.
fn place(fields: &Fields, dims: [u32; 3]) -> Result<(Lattice, bool), Problem> {
    // ITK writes ElementSpacing; ElementSize is how large a sample is, and stands in for it.
    let spacing = fields.numbers::<3>(&["ElementSpacing", "ElementSize"])?.unwrap_or([1.0; 3]);
    let rows = fields.numbers::<9>(&["TransformMatrix", "Rotation", "Orientation"])?;
    let origin = fields.numbers::<3>(&["Offset", "Position", "Origin"])?.unwrap_or([0.0; 3]);
    let mut lattice = Lattice::from_spacing(dims, spacing);
    let Some(m) = rows else {
        // Spacings alone: the file does not say where its axes point.
        lattice.origin = DVec3::from_array(origin);
        lattice.check().map_err(|e| {
            Problem::malformed("ElementSpacing", e, "correct the spacing or the offset")
        })?;
        return Ok((lattice, false));
    };
    // LPS to RAS; `+ 0.0` makes of -0.0 a 0.0, so that a digest does not depend on it.
    let ras = |v: DVec3| v * DVec3::new(-1.0, -1.0, 1.0) + DVec3::ZERO;
    for a in 0..3 {
        lattice.steps[a] = ras(DVec3::new(m[3 * a], m[3 * a + 1], m[3 * a + 2]) * spacing[a]);
    }
    lattice.origin = ras(DVec3::from_array(origin));
    lattice.check().map_err(|e| Problem::malformed("TransformMatrix", e, "correct the axes"))?;
    Ok((lattice, true))
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::Samples;

    const HEAD: &str = "ObjectType = Image\nNDims = 3\nDimSize = 3 2 1\nElementType = MET_UCHAR\n";

    fn open(header: &str, data: &[u8]) -> Result<Volume, Problem> {
        let bytes = [header.as_bytes(), data].concat();
        crate::read(Source::memory(bytes), Path::new("."), "test.mha", &crate::Hints::default())
    }

    #[test]
    fn local_data_are_read_raw_packed_and_as_text() {
        let data = [1, 2, 3, 4, 5, 6];
        let want = Samples::U8(data.to_vec());
        let local = |more: &str| format!("{HEAD}{more}ElementDataFile = LOCAL\n");
        assert_eq!(open(&local(""), &data).unwrap().samples, want);
        let packed = local("CompressedData = True\nCompressedDataSize = 99\n");
        assert_eq!(open(&packed, &crate::fuzz::zlib(&data)).unwrap().samples, want);
        assert_eq!(open(&packed, &crate::fuzz::gzip(&data)).unwrap().samples, want);
        assert_eq!(open(&local("BinaryData = False\n"), b"1 2 3\n4 5 6\n").unwrap().samples, want);
        assert_eq!(
            open(&local("HeaderSize = 2\n"), b"xx\x01\x02\x03\x04\x05\x06").unwrap().samples,
            want
        );
        assert_eq!(
            open(&local("HeaderSize = -1\n"), b"xxx\x01\x02\x03\x04\x05\x06").unwrap().samples,
            want
        );
        let dos = local("").replace('\n', "\r\n");
        assert_eq!(open(&dos, &data).unwrap().samples, want);
    }

    #[test]
    fn rows_of_the_matrix_are_index_axes_in_lps() {
        let more = "TransformMatrix = 0 1 0 0 0 1 -1 0 0\nElementSpacing = 1 2 3\nOffset = 4 5 6\n";
        let v = open(&format!("{HEAD}{more}ElementDataFile = LOCAL\n"), &[0; 6]).unwrap();
        assert!(v.anatomical);
        assert_eq!(v.lattice.steps, [-DVec3::Y, DVec3::Z * 2.0, DVec3::X * 3.0]);
        assert_eq!(v.lattice.origin, DVec3::new(-4.0, -5.0, 6.0));
        let v = open(&format!("{HEAD}ElementSize = 1 2 3\nElementDataFile=LOCAL\n"), &[0; 6]);
        let v = v.unwrap();
        assert!(!v.anatomical, "spacings alone do not say where the axes point");
        assert_eq!(v.lattice.spacing(), [1.0, 2.0, 3.0]);
    }

    #[test]
    fn types_and_orders_are_as_named() {
        for (kind, name, bytes) in [
            ("MET_CHAR", "int8", 1),
            ("MET_USHORT", "uint16", 2),
            ("MET_LONG", "int32", 4),
            ("MET_ULONG_LONG", "uint64", 8),
            ("MET_FLOAT", "float32", 4),
            ("MET_DOUBLE", "float64", 8),
        ] {
            let head = HEAD.replace("MET_UCHAR", kind) + "ElementDataFile = LOCAL\n";
            assert_eq!(open(&head, &vec![0; 6 * bytes]).unwrap().file_type, name);
            let e = open(&head, &vec![0; 6 * bytes - 1]).unwrap_err().to_string();
            assert!(e.contains("bytes are needed and"), "{e}");
        }
        let head = HEAD.replace("MET_UCHAR", "MET_USHORT").replace("3 2 1", "1 1 1");
        let msb = format!("{head}BinaryDataByteOrderMSB = True\nElementDataFile = LOCAL\n");
        assert_eq!(open(&msb, &[1, 2]).unwrap().samples, Samples::U16(vec![258]));
    }

    #[test]
    fn what_is_not_read_is_refused_by_field_and_remedy() {
        let with =
            |from: &str, to: &str| format!("{HEAD}ElementDataFile = LOCAL\n").replace(from, to);
        for (header, say) in [
            (HEAD.to_string(), "line 5: `\\0\\0\\0\\0\\0\\0` is not `Key = Value`"),
            (with("Image", "Tube"), "ObjectType (line 1): `Tube` is no image"),
            (with("NDims = 3", "NDims = 4"), "NDims (line 2): `4` is not 3"),
            (with("DimSize = 3 2 1\n", ""), "DimSize: is missing"),
            (with("3 2 1", "3 2"), "`3 2` is not three whole numbers"),
            (with("3 2 1", "3 0 1"), "3 x 0 x 1 has no samples"),
            (with("3 2 1", "3 2 -1"), "is not three whole numbers"),
            (with("MET_UCHAR", "MET_STRING"), "ElementType (line 4): `MET_STRING` is no type"),
            (
                with("ElementDataFile", "CompressedData = Maybe\nElementDataFile"),
                "give True or False",
            ),
            (with("ElementDataFile", "ElementSpacing = 1 1\nElementDataFile"), "is not 3 numbers"),
            (
                with("ElementDataFile", "ElementSpacing = 1 1 0\nElementDataFile"),
                "ElementSpacing: a spacing is zero",
            ),
            (
                with("ElementDataFile", "TransformMatrix = 1 0 0 1 0 0 0 0 1\nElementDataFile"),
                "would be flat",
            ),
            (
                with("ElementDataFile", "ElementNumberOfChannels = 3\nElementDataFile"),
                "save one channel",
            ),
            (with("ElementDataFile", "NDims = 3\nElementDataFile"), "was given in line 2 already"),
            (with("ElementDataFile", "HeaderSize = x\nElementDataFile"), "is no number of bytes"),
            (with("LOCAL", "no.raw"), "ElementDataFile: `no.raw` is not there"),
            (with("LOCAL", "../x.raw"), "ElementDataFile"),
            (with("LOCAL", "LIST\na\nb"), "names 3 files where DimSize wants 1"),
            (with("LOCAL", "a%03d.raw 1 2 1"), "names 2 files where DimSize wants 1"),
            (with("LOCAL", "a%s.raw 1 2 1"), "in a way that is not known"),
            (
                with("ElementDataFile", "nonsense\nElementDataFile"),
                "`nonsense` is not `Key = Value`",
            ),
        ] {
            let e = open(&header, &[0; 6]).unwrap_err().to_string();
            assert!(e.contains(say), "want {say:?} in {e}");
        }
        let e = open(HEAD, b"").unwrap_err().to_string();
        assert!(e.contains("ElementDataFile: is missing; end the header with"), "{e}");
    }
}
