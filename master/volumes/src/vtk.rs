//! Reader of VTK's legacy files (`.vtk`) with the data set STRUCTURED_POINTS: lines of text,
//! between which arrays stand as text or as big-endian numbers.
//!
//! One array is drawn: the one asked for, else the first with one number a point or cell. Arrays
//! before it are skipped by their sizes; nothing after it is read.

use crate::error::{OpenErrorKind, Problem, quoted};
use crate::samples::{self, Endian, Layout, Number, Supply};
use crate::source::{self, Source};
use crate::unpack::Encoding;
use glam::DVec3;
use slabcast_common::volume::{Lattice, Samples, ValueMap, Volume};
use std::io::{BufRead, Read};

/// First bytes of a file.
const MAGIC: &[u8] = b"# vtk DataFile Version ";
const RESAVE: &str = "save it again as image data (.vti or .vtk) with VTK or ParaView";
/// Longest line.
const LINE_MAX_BYTES: u64 = 4096;
/// Most lines without an array.
const LINES_MAX: u32 = 100_000;

/// Returns whether the first bytes are a legacy VTK file of any data set.
pub(crate) fn sniff(start: &[u8]) -> bool {
    start.get(..MAGIC.len()).is_some_and(|m| m.eq_ignore_ascii_case(MAGIC))
}

/// Reads a volume from the start of a source; `dataset` names its array.
pub(crate) fn read(
    source: Source,
    gzip: bool,
    name: &str,
    dataset: Option<&str>,
) -> Result<Volume, Problem> {
    source.pick.choose(&[], "content")?;
    let Source { reader, len, cap, notes, .. } = source;
    let inner: Box<dyn BufRead + Send> = match gzip {
        true => {
            let members =
                crate::members::Members::new(crate::members::Packing::Gzip, reader, notes.clone());
            Box::new(std::io::BufReader::new(members))
        }
        false => Box::new(reader),
    };
    let mut file = Lines { inner, consumed: 0, lines: 0 };
    let mut head = || file.line()?.ok_or_else(|| missing("the header of four lines"));
    let (_, _, coding) = (head()?, head()?, head()?);
    let text = match coding.trim().to_ascii_uppercase().as_str() {
        "ASCII" => true,
        "BINARY" => false,
        _ => return Err(bad("line 3", format!("{} is not ASCII or BINARY", quoted(&coding)))),
    };
    let mut grid = Grid { spacing: [1.0; 3], ..Grid::default() };
    let mut seen: Vec<String> = Vec::new();
    let array = loop {
        let Some(line) = file.line()? else { break None };
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let Some(key) = words.first().map(|w| w.to_ascii_uppercase()) else { continue };
        match key.as_str() {
            "DATASET" => {
                let kind = words.get(1).copied().unwrap_or_default().to_ascii_uppercase();
                if kind != "STRUCTURED_POINTS" {
                    return Err(Problem::unsupported(
                        "DATASET",
                        format!("{} is no STRUCTURED_POINTS", quoted(&kind)),
                        "resample it to an image (ParaView: Resample To Image)",
                    ));
                }
            }
            "DIMENSIONS" => grid.dims = Some(numbers(&words, "DIMENSIONS")?),
            "SPACING" | "ASPECT_RATIO" => grid.spacing = numbers(&words, "SPACING")?,
            "ORIGIN" => grid.origin = numbers(&words, "ORIGIN")?,
            "POINT_DATA" | "CELL_DATA" => {
                let [count] = numbers(&words, &key)?;
                grid.section = Some((key == "CELL_DATA", count));
            }
            // Tables of colours are skipped.
            "LOOKUP_TABLE" => {
                let colours = words.get(2).and_then(|n| n.parse::<u64>().ok()).unwrap_or(0);
                file.skip(text, colours.saturating_mul(4), 1, len)?;
            }
            // Metadata are skipped up to an empty line.
            "METADATA" => while file.line()?.is_some_and(|line| !line.trim().is_empty()) {},
            "SCALARS" => {
                let array = Array::scalars(&words, &grid)?;
                // A line that names its table follows; it may be missing.
                if file.starts_with("LOOKUP_TABLE")? {
                    file.line()?;
                }
                if array.is_wanted(dataset) {
                    break Some(array);
                }
                seen.push(array.name.clone());
                file.skip_array(text, &array, len)?;
            }
            "FIELD" => {
                let count = words.get(2).and_then(|n| n.parse::<u32>().ok());
                let count = count.ok_or_else(|| bad("FIELD", "has no number of arrays"))?;
                let mut found = None;
                for _ in 0..count {
                    let line = loop {
                        let line = file.line()?.ok_or_else(|| missing("an array of FIELD"))?;
                        match line.trim() {
                            "" => {}
                            "METADATA" => {
                                while file.line()?.is_some_and(|line| !line.trim().is_empty()) {}
                            }
                            _ => break line,
                        }
                    };
                    let array = Array::field(&line, &grid)?;
                    if array.is_wanted(dataset) {
                        found = Some(array);
                        break;
                    }
                    seen.push(array.name.clone());
                    file.skip_array(text, &array, len)?;
                }
                if found.is_some() {
                    break found;
                }
            }
            "VECTORS" | "NORMALS" | "TENSORS" | "TEXTURE_COORDINATES" | "COLOR_SCALARS" => {
                let array = Array::other(&key, &words, text, &grid)?;
                if array.is_wanted(dataset) {
                    break Some(array);
                }
                seen.push(array.name.clone());
                file.skip_array(text, &array, len)?;
            }
            // Most likely the rest of an array with more numbers than its size says.
            _ => return Err(bad("line", format!("{} is no keyword", quoted(&line)))),
        }
    };
    let Some(array) = array else { return Err(not_found(dataset, &seen)) };
    let number = array.number.expect("a wanted array has a type");
    let (dims, origin) = grid.samples(array.cells)?;
    let layout = Layout::new(dims, number, Endian::Big, "DIMENSIONS")?;
    let mut lattice = Lattice::from_spacing(layout.dims, grid.spacing);
    lattice.origin = origin;
    lattice.check().map_err(|e| Problem::malformed("SPACING", e, RESAVE))?;
    if !seen.is_empty() {
        notes.add(format!("array {} was read", quoted(&array.name)));
    }
    let left = len.saturating_sub(file.consumed);
    let (samples, map) = match text {
        true => {
            let bytes = if gzip { len.saturating_mul(1032) } else { left };
            let (reader, supply) = Encoding::Ascii
                .open(file.inner, bytes, number, &notes)
                .map_err(|e| Problem::io("data", &e))?;
            let layout = Layout { endian: Endian::Little, ..layout };
            samples::read(&mut reader.take(layout.bytes()), supply, &layout, cap)?
        }
        false => {
            let supply = match gzip {
                true => Supply::deflate("gzip", len),
                false => Supply::Plain { have: left },
            };
            samples::read(&mut file.inner.take(layout.bytes()), supply, &layout, cap)?
        }
    };
    if array.shares
        && let Samples::F32(shares) = &samples
    {
        // Shares become bytes with VTK's rounding.
        let mut bytes = Vec::new();
        samples::reserve(&mut bytes, shares.len())?;
        bytes.extend(shares.iter().map(|x| (255.0 * x + 0.5) as u8));
        let samples = Samples::U8(bytes);
        return Ok(Volume::new(name, "uint8", false, lattice, samples, ValueMap::IDENTITY));
    }
    Ok(crate::stream::volume(name, number.name(), false, lattice, samples, map))
}

fn bad(field: &str, what: impl Into<String>) -> Problem {
    Problem::malformed(field, what, RESAVE)
}

fn missing(what: &str) -> Problem {
    Problem::new(OpenErrorKind::Damaged, what, "is missing", "get the whole file")
}

/// Returns the error for a file without the wanted array; `seen` are the names of its arrays.
fn not_found(dataset: Option<&str>, seen: &[String]) -> Problem {
    let list: Vec<String> = seen.iter().take(6).map(|n| quoted(n)).collect();
    match dataset {
        Some(asked) => Problem::malformed(
            "--dataset",
            format!(
                "there is no {} with one number a point or cell among {}",
                quoted(asked),
                if list.is_empty() { "no arrays".into() } else { list.join(", ") }
            ),
            "name one of them",
        ),
        None => Problem::unsupported(
            "SCALARS",
            "there are none with one number a point or cell",
            "save a volume with one component",
        ),
    }
}

/// Parses the words after the first as finite numbers.
fn numbers<T: std::str::FromStr, const N: usize>(
    words: &[&str],
    field: &str,
) -> Result<[T; N], Problem> {
    let parsed: Vec<T> = words[1..].iter().filter_map(|w| w.parse().ok()).collect();
    <[T; N]>::try_from(parsed)
        .map_err(|_| bad(field, format!("{} is not {N} numbers", quoted(&words[1..].join(" ")))))
}

/// The grid of points, and the kind of the data that follow.
#[derive(Default)]
struct Grid {
    /// Points along x, y and z.
    dims: Option<[u64; 3]>,
    spacing: [f64; 3],
    origin: [f64; 3],
    /// Whether the data belong to cells (else to points), and their number.
    section: Option<(bool, u64)>,
}

impl Grid {
    /// Returns the number of samples along each axis and the place of the first.
    fn samples(&self, cells: bool) -> Result<([u64; 3], DVec3), Problem> {
        let mut dims = self.dims.ok_or_else(|| bad("DIMENSIONS", "is missing"))?;
        let mut origin = DVec3::from_array(self.origin);
        for a in 0..3 {
            // A flat image has one layer of cells. A cell's value belongs to its middle.
            if cells && dims[a] > 1 {
                dims[a] -= 1;
                origin[a] += self.spacing[a] / 2.0;
            }
        }
        Ok((dims, origin + DVec3::ZERO))
    }
}

/// An array of the file.
struct Array {
    name: String,
    /// `None` for a type that is not drawn.
    number: Option<Number>,
    /// Bytes of a number.
    size: u64,
    components: u64,
    count: u64,
    cells: bool,
    /// Whether the numbers are bytes written as shares of 255, in text.
    shares: bool,
}

impl Array {
    fn new(
        (name, kind): (&str, &str),
        components: u64,
        grid: &Grid,
        tuples: Option<u64>,
    ) -> Result<Array, Problem> {
        let number = match kind.to_ascii_lowercase().as_str() {
            "unsigned_char" => Some(Number::U8),
            "char" | "signed_char" => Some(Number::I8),
            "unsigned_short" => Some(Number::U16),
            "short" => Some(Number::I16),
            "unsigned_int" => Some(Number::U32),
            // VTK writes its ids as int.
            "int" | "vtkidtype" => Some(Number::I32),
            "unsigned_long" | "unsigned_long_long" | "vtktypeuint64" => Some(Number::U64),
            "long" | "long_long" | "vtktypeint64" => Some(Number::I64),
            "float" => Some(Number::F32),
            "double" => Some(Number::F64),
            _ => None,
        };
        let name = decoded(name);
        let Some(number) = number else {
            return Err(Problem::unsupported(
                format!("array {}", quoted(&name)),
                format!("has the type {}, which is not read", quoted(kind)),
                "save it as a type such as unsigned_char or float",
            ));
        };
        let (cells, count) = match (grid.section, tuples) {
            (Some((cells, count)), None) => (cells, count),
            (Some((cells, _)), Some(tuples)) => (cells, tuples),
            // A field of the whole data set.
            (None, Some(tuples)) => (false, tuples),
            (None, None) => return Err(bad("POINT_DATA", "is missing before the array")),
        };
        // Data of the whole data set are not samples.
        let drawn = grid.section.is_some_and(|(cells, _)| {
            grid.samples(cells).is_ok_and(|(d, _)| {
                d.iter().try_fold(1u64, |n, x| n.checked_mul(*x)) == Some(count)
            })
        });
        if grid.section.is_some() && !drawn {
            return Err(bad(
                "POINT_DATA",
                format!("says {count} numbers, which are not those of DIMENSIONS"),
            ));
        }
        let size = number.bytes();
        Ok(Array {
            name,
            number: drawn.then_some(number),
            size,
            components,
            count,
            cells,
            shares: false,
        })
    }

    /// Parses the words of `SCALARS name type [components]`.
    fn scalars(words: &[&str], grid: &Grid) -> Result<Array, Problem> {
        let [_, name, kind, ..] = words else {
            return Err(bad("SCALARS", "has no name or no type"));
        };
        let components = match words.get(3) {
            Some(n) => n.parse().map_err(|_| bad("SCALARS", "has no number of components"))?,
            None => 1,
        };
        Array::new((name, kind), components, grid, None)
    }

    /// Parses a line of FIELD: `name components tuples type`.
    fn field(line: &str, grid: &Grid) -> Result<Array, Problem> {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        if let [name, components, tuples, kind] = words[..]
            && let (Ok(components), Ok(tuples)) = (components.parse(), tuples.parse())
        {
            return Array::new((name, kind), components, grid, Some(tuples));
        }
        Err(bad("FIELD", format!("{} is no array", quoted(line))))
    }

    /// Parses the words of a keyword whose array has several numbers a point.
    fn other(key: &str, words: &[&str], text: bool, grid: &Grid) -> Result<Array, Problem> {
        let third = || words.get(2).and_then(|n| n.parse().ok());
        let (components, kind) = match key {
            "TENSORS" => (Some(9), words.get(2)),
            "TEXTURE_COORDINATES" => (third(), words.get(3)),
            // Bytes, or floats in text.
            "COLOR_SCALARS" => (third(), Some(if text { &"float" } else { &"unsigned_char" })),
            _ => (Some(3), words.get(2)),
        };
        let (Some(name), Some(components), Some(kind)) = (words.get(1), components, kind) else {
            return Err(bad(key, "has no name, size or type"));
        };
        let mut array = Array::new((name, kind), components, grid, None)?;
        // VTK also writes one byte a point as COLOR_SCALARS.
        match key == "COLOR_SCALARS" && components == 1 {
            true => array.shares = text,
            false => array.number = None,
        }
        Ok(array)
    }

    fn is_wanted(&self, dataset: Option<&str>) -> bool {
        let named = dataset.is_none_or(|asked| asked == self.name);
        named && self.components == 1 && self.number.is_some()
    }
}

/// Decodes percent encoding in a name: VTK writes a blank as `%20`.
fn decoded(name: &str) -> String {
    let mut out = Vec::new();
    let mut rest = name.as_bytes();
    while let [first, tail @ ..] = rest {
        let code = (*first == b'%').then(|| tail.get(..2)).flatten();
        let code = code.and_then(|hex| u8::from_str_radix(std::str::from_utf8(hex).ok()?, 16).ok());
        match code {
            Some(byte) => (out.push(byte), rest = &tail[2..]).1,
            None => (out.push(*first), rest = tail).1,
        }
    }
    String::from_utf8_lossy(&out).into_owned()
}

/// Reader of a file's lines, and of the arrays between them.
struct Lines {
    inner: Box<dyn BufRead + Send>,
    consumed: u64,
    lines: u32,
}

impl Lines {
    /// Returns the next line without its end; `None` at the end of the file.
    fn line(&mut self) -> Result<Option<String>, Problem> {
        self.lines += 1;
        if self.lines > LINES_MAX {
            return Err(bad("header", format!("has more than {LINES_MAX} lines")));
        }
        let mut line = Vec::new();
        let mut limited = (&mut self.inner).take(LINE_MAX_BYTES);
        let n = limited.read_until(b'\n', &mut line).map_err(|e| damaged(&e))?;
        self.consumed += n as u64;
        if n as u64 == LINE_MAX_BYTES {
            return Err(bad("header", format!("has a line of more than {LINE_MAX_BYTES} bytes")));
        }
        let line = String::from_utf8_lossy(&line);
        Ok((n > 0).then(|| line.trim_end_matches(['\n', '\r']).to_string()))
    }

    /// Returns whether the next line starts with a word, without consuming it.
    fn starts_with(&mut self, word: &str) -> Result<bool, Problem> {
        let chunk = self.inner.fill_buf().map_err(|e| damaged(&e))?;
        Ok(chunk.get(..word.len()).is_some_and(|c| c.eq_ignore_ascii_case(word.as_bytes())))
    }

    fn skip_array(&mut self, text: bool, array: &Array, len: u64) -> Result<(), Problem> {
        self.skip(text, array.count.saturating_mul(array.components), array.size, len)
    }

    /// Skips `count` numbers of `size` bytes, or as many words of text, in a file of `len` bytes.
    fn skip(&mut self, text: bool, count: u64, size: u64, len: u64) -> Result<(), Problem> {
        // Each number of text takes a digit and a space.
        if count > len.saturating_mul(1032) {
            return Err(missing("the end of an array"));
        }
        if !text {
            let bytes = count.saturating_mul(size);
            self.consumed += bytes;
            return match source::skip_bytes(&mut *self.inner, bytes) {
                Ok(true) => Ok(()),
                Ok(false) => Err(missing("the end of an array")),
                Err(e) => Err(damaged(&e)),
            };
        }
        let (mut left, mut in_word) = (count, false);
        while left > 0 {
            let chunk = self.inner.fill_buf().map_err(|e| damaged(&e))?;
            if chunk.is_empty() {
                return match (left, in_word) {
                    (1, true) => Ok(()),
                    _ => Err(missing("the end of an array")),
                };
            }
            let mut used = 0;
            for b in chunk {
                used += 1;
                let blank = b.is_ascii_whitespace();
                left -= u64::from(blank && in_word);
                in_word = !blank;
                if left == 0 {
                    break;
                }
            }
            self.consumed += used as u64;
            self.inner.consume(used);
        }
        Ok(())
    }
}

fn damaged(e: &std::io::Error) -> Problem {
    if let Some(problem) = e.get_ref().and_then(|inner| inner.downcast_ref::<Problem>()) {
        return problem.clone();
    }
    Problem::new(
        OpenErrorKind::Damaged,
        "content",
        format!("can't be read ({e})"),
        "get the file again",
    )
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use std::path::Path;

    /// Returns a file of 4 x 3 x 2 points with the arrays `first` (vectors), `second` and `third`.
    pub(crate) fn vtk(text: bool, kind: &str, field: bool) -> Vec<u8> {
        let mut out = format!(
            "# vtk DataFile Version 3.0\na title\n{}\nDATASET STRUCTURED_POINTS\nDIMENSIONS 4 3 2\n\
             ORIGIN 1 2 3\nSPACING 0.5 1 2\nPOINT_DATA 24\n",
            if text { "ASCII" } else { "BINARY" }
        )
        .into_bytes();
        let put = |out: &mut Vec<u8>, kind: &str, numbers: &mut dyn Iterator<Item = u8>| {
            for n in numbers {
                match (text, kind) {
                    (true, _) => out.extend(format!("{n} ").bytes()),
                    (_, "unsigned_char" | "char") => out.push(n),
                    (_, "short" | "unsigned_short") => out.extend(u16::from(n).to_be_bytes()),
                    (_, "int" | "unsigned_int") => out.extend(u32::from(n).to_be_bytes()),
                    (_, "long" | "unsigned_long") => out.extend(u64::from(n).to_be_bytes()),
                    (_, "float") => out.extend(f32::from(n).to_be_bytes()),
                    _ => out.extend(f64::from(n).to_be_bytes()),
                }
            }
            out.push(b'\n');
        };
        match field {
            false => {
                out.extend(b"VECTORS first float\n");
                put(&mut out, "float", &mut (0..72));
                for (name, factor) in [("second", 1), ("third%20one", 2)] {
                    out.extend(format!("SCALARS {name} {kind}\nLOOKUP_TABLE default\n").bytes());
                    put(&mut out, kind, &mut (0..24).map(|i| i * factor));
                }
            }
            true => {
                out.extend(b"FIELD FieldData 3\nfirst 3 24 float\n");
                put(&mut out, "float", &mut (0..72));
                out.extend(b"METADATA\nINFORMATION 0\n\n");
                for (name, factor) in [("second", 1), ("third%20one", 2)] {
                    out.extend(format!("{name} 1 24 {kind}\n").bytes());
                    put(&mut out, kind, &mut (0..24).map(|i| i * factor));
                }
            }
        }
        out
    }

    fn open(bytes: Vec<u8>, dataset: Option<&str>) -> Result<(Volume, String), Problem> {
        let source = Source::from_bytes(bytes);
        let notes = source.notes.clone();
        let dataset = dataset.map(String::from);
        let hints = crate::Hints { dataset, ..crate::Hints::default() };
        let volume = crate::read(source, Path::new("."), "test.vtk", &hints)?;
        Ok((volume, notes.take().join("\n")))
    }

    fn values(v: &Volume) -> Vec<f64> {
        (0..v.samples.len()).map(|i| v.summary.map.value(v.samples.code(i))).collect()
    }

    #[test]
    fn legacy_vtk_opens_as_text_and_binary_with_scalars_and_fields() {
        let want: Vec<f64> = (0..24).map(f64::from).collect();
        for kind in [
            "unsigned_char",
            "char",
            "unsigned_short",
            "short",
            "unsigned_int",
            "int",
            "unsigned_long",
            "long",
            "float",
            "double",
        ] {
            for (text, field) in [(true, true), (true, false), (false, true), (false, false)] {
                let bytes = vtk(text, kind, field);
                let (v, notes) = open(bytes.clone(), None).unwrap();
                assert_eq!(values(&v), want, "{kind} text {text} field {field}");
                assert_eq!(v.lattice.spacing(), [0.5, 1.0, 2.0]);
                assert_eq!(v.lattice.origin, DVec3::new(1.0, 2.0, 3.0));
                assert!(notes.contains("array `second` was read"), "{notes}");
                let (third, _) = open(bytes.clone(), Some("third one")).unwrap();
                assert_eq!(values(&third)[23], 46.0);
                assert_eq!(open(crate::fuzz::gzip(&bytes), None).unwrap().0.digest(), v.digest());
            }
        }
    }

    #[test]
    fn legacy_vtk_of_one_byte_a_point_is_read_as_vtk_writes_it() {
        let head = |coding: &str| {
            format!(
                "# vtk DataFile Version 5.1\nt\n{coding}\nDATASET STRUCTURED_POINTS\nDIMENSIONS 2 2 \
                 1\nSPACING 1 1 1\nORIGIN 0 0 0\nPOINT_DATA 4\nCOLOR_SCALARS values 1\n"
            )
        };
        let binary = [head("BINARY").as_bytes(), &[0, 100, 200, 255, b'\n']].concat();
        let text = head("ASCII") + "0 0.392157 0.784314 1 \n";
        for bytes in [binary, text.into_bytes()] {
            let (v, _) = open(bytes, Some("values")).unwrap();
            assert_eq!(
                (&v.samples, v.file_type.as_str()),
                (&Samples::U8(vec![0, 100, 200, 255]), "uint8")
            );
        }
        let three = [head("BINARY").replace("values 1", "values 3").as_bytes(), &[9; 12]].concat();
        let e = open(three, None).unwrap_err().to_string();
        assert!(e.contains("there are none with one number a point"), "{e}");
    }

    #[test]
    fn legacy_vtk_cells_lie_between_the_points() {
        let bytes = b"# vtk DataFile Version 2.0\nt\nASCII\nDATASET STRUCTURED_POINTS\n\
            DIMENSIONS 3 3 1\nASPECT_RATIO 2 2 2\nORIGIN 0 0 0\nCELL_DATA 4\nSCALARS a short 1\n\
            LOOKUP_TABLE default\n5 6\n7 8\n";
        let (v, notes) = open(bytes.to_vec(), None).unwrap();
        assert_eq!((v.lattice.dims, notes.as_str()), ([2, 2, 1], ""));
        assert_eq!(v.lattice.origin, DVec3::new(1.0, 1.0, 0.0));
        assert_eq!(values(&v), [5.0, 6.0, 7.0, 8.0]);
    }

    #[test]
    fn legacy_vtk_errors_name_field_and_remedy() {
        let good = String::from_utf8(vtk(true, "short", false)).unwrap();
        for (from, to, say) in [
            ("STRUCTURED_POINTS", "POLYDATA", "DATASET: `POLYDATA` is no STRUCTURED_POINTS"),
            ("ASCII", "UTF8", "line 3: `UTF8` is not ASCII or BINARY"),
            ("DIMENSIONS 4 3 2", "DIMENSIONS 4 3", "DIMENSIONS: `4 3` is not 3 numbers"),
            (
                "POINT_DATA 24",
                "POINT_DATA 25",
                "says 25 numbers, which are not those of DIMENSIONS",
            ),
            ("second short", "second bit", "has the type `bit`, which is not read"),
            ("SPACING 0.5", "SPACING 0", "SPACING: a spacing is zero"),
            ("LOOKUP_TABLE default\n0 1 2", "LOOKUP_TABLE default\n0 x 2", "number 2 is `x`"),
        ] {
            let e = open(good.replace(from, to).into_bytes(), None).unwrap_err().to_string();
            assert!(e.contains(say), "{from}: {e}");
        }
        let e = open(good.clone().into_bytes(), Some("fourth")).unwrap_err().to_string();
        assert!(e.contains("there is no `fourth`") && e.contains("`second`, `third one`"), "{e}");
        let vectors = good.split("SCALARS").next().unwrap();
        let e = open(vectors.as_bytes().to_vec(), None).unwrap_err().to_string();
        assert!(e.contains("SCALARS: there are none with one number"), "{e}");
        let bytes = vtk(false, "short", false);
        let cut = bytes.len() - 60;
        let e = open(bytes[..cut].to_vec(), Some("third one")).unwrap_err().to_string();
        assert!(e.contains("truncated"), "{e}");
    }
}
