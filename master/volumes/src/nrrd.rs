//! Reader of NRRD, attached (`.nrrd`) and detached (`.nhdr` with one data file or a list of them).
//!
//! Specification: teem.sourceforge.net/nrrd/format.html. A header is lines of `field: value`,
//! `key:=value` and `# comment` up to an empty line. The reader collects the fields first and
//! interprets them afterwards, so that their order does not matter. This accepts every file that
//! the specification allows and some that it doesn't (fields before `dimension`).
//!
//! All encodings but `zrl` are read (`unpack`).

use crate::colours;
use crate::data::{self, HeaderLines, Skip, Storage};
use crate::error::{Problem, quoted};
use crate::pick::{Axis, Kind, Part, Pick};
use crate::samples::{Endian, Layout, Number};
use crate::source::Source;
use crate::unpack::Encoding;
use glam::DVec3;
use slabcast_common::volume::{Lattice, Volume};
use std::collections::BTreeMap;
use std::path::Path;

/// First bytes of an NRRD file, before its version.
pub(crate) const MAGIC: &[u8] = b"NRRD";

/// Most axes, as in teem (`NRRD_DIM_MAX`).
const AXES_MAX: usize = 16;

const RESAVE: &str = "save it again with `encoding: gzip` or `encoding: raw`";

/// Reads a volume from the start of a source. `folder` is the header's folder, where detached data
/// must lie.
pub(crate) fn read(mut source: Source, folder: &Path, name: &str) -> Result<Volume, Problem> {
    let (fields, header_bytes) = Fields::read(&mut source)?;
    let header = Header::from_fields(&fields, source.pick)?;
    header.notes.iter().for_each(|note| source.notes.add(note));
    let part = header.part.as_ref();
    let samples = match &header.data_files {
        None => {
            let len = source.len.saturating_sub(header_bytes);
            data::read(source, len, &header.storage, &header.layout, part)
        }
        Some(files) => {
            let files = (&files[..], "data file");
            data::read_files(
                folder,
                files,
                (source.cap, &source.notes),
                &header.storage,
                (&header.layout, part),
            )
        }
    };
    let (samples, map) = samples?;
    let file_type = header.layout.number.name();
    Ok(crate::stream::volume(name, file_type, header.anatomical, header.lattice, samples, map))
}

/// The header's fields: line number and value by name.
struct Fields {
    lines: BTreeMap<String, (usize, String)>,
    /// Names of data files after `data file: LIST`.
    list: Vec<String>,
}

impl Fields {
    /// Reads the lines of a header and returns their bytes with the fields.
    fn read(source: &mut Source) -> Result<(Fields, u64), Problem> {
        let mut fields = BTreeMap::new();
        let mut list = Vec::new();
        let mut in_list = false;
        let mut header = HeaderLines::new(source, "end it with an empty line");
        // An empty line ends the header; so does the end of a detached one.
        while let Some((number, text)) = header.next()?.filter(|(n, t)| *n == 1 || !t.is_empty()) {
            let text = text.as_str();
            if number == 1 {
                check_magic(text)?;
                continue;
            }
            if in_list {
                list.push(text.trim().to_string());
                continue;
            }
            if text.starts_with('#') {
                continue;
            }
            let Some((name, value)) = text.split_once(':') else {
                return Err(Problem::malformed(
                    format!("line {number}"),
                    format!("{} is neither `field: value` nor `key:=value`", quoted(text)),
                    "correct or remove the line, or put the missing empty line before the data",
                ));
            };
            if value.starts_with('=') {
                continue;
            }
            let name = canonical_field(&name.trim().to_ascii_lowercase());
            if let Some((before, _)) = fields.get(&name) {
                return Err(Problem::malformed(
                    format!("line {number}"),
                    format!("{} was given in line {before} already", quoted(&name)),
                    "remove one of them",
                ));
            }
            // File names follow up to the end of the header.
            in_list = name == "data file" && value.split_ascii_whitespace().next() == Some("LIST");
            fields.insert(name, (number, value.trim().to_string()));
        }
        Ok((Fields { lines: fields, list }, header.consumed_bytes()))
    }

    fn get(&self, name: &str) -> Option<&str> {
        self.lines.get(name).map(|(_, v)| v.as_str())
    }

    fn required(&self, name: &str, example: &str) -> Result<&str, Problem> {
        self.get(name).ok_or_else(|| {
            Problem::malformed(
                name,
                "is missing",
                format!("add a line such as `{name}: {example}`"),
            )
        })
    }

    /// Returns the field's name with its line, for error messages.
    fn with_line(&self, name: &str) -> String {
        match self.lines.get(name) {
            Some((line, _)) => format!("{name} (line {line})"),
            None => name.to_string(),
        }
    }

    fn malformed(&self, name: &str, why: &str, remedy: &str) -> Problem {
        let value = self.get(name).unwrap_or_default();
        Problem::malformed(self.with_line(name), format!("{} {why}", quoted(value)), remedy)
    }

    /// Returns the words of a field, one for each axis; `None` if the field is absent.
    fn per_axis(&self, name: &str, axes: usize) -> Result<Option<Vec<&str>>, Problem> {
        let Some(value) = self.get(name) else { return Ok(None) };
        let words: Vec<&str> = value.split_ascii_whitespace().collect();
        if words.len() != axes {
            return Err(self.malformed(
                name,
                &format!("has {} entries for {axes} axes", words.len()),
                "give one for each axis",
            ));
        }
        Ok(Some(words))
    }
}

fn check_magic(line: &str) -> Result<(), Problem> {
    match line.strip_prefix("NRRD000").map(|v| v.trim_end().parse::<u32>()) {
        Some(Ok(1..=5)) => Ok(()),
        _ => Err(Problem::unsupported(
            "line 1",
            format!("{} is not NRRD0001 to NRRD0005", quoted(line)),
            "save it again as NRRD0005 or earlier",
        )),
    }
}

/// Returns the usual spelling of a field's name; some fields have two.
fn canonical_field(name: &str) -> String {
    match name {
        "datafile" => "data file",
        "lineskip" => "line skip",
        "byteskip" => "byte skip",
        "axismins" => "axis mins",
        "axismaxs" => "axis maxs",
        "centerings" => "centers",
        name => name,
    }
    .to_string()
}

/// An interpreted header.
struct Header {
    layout: Layout,
    /// Part of the samples that is read; `None` for all.
    part: Option<Part>,
    notes: Vec<String>,
    lattice: Lattice,
    anatomical: bool,
    storage: Storage,
    data_files: Option<Vec<String>>,
}

impl Header {
    fn from_fields(fields: &Fields, pick: Pick) -> Result<Header, Problem> {
        let number = number_type(fields)?;
        let encoding = encoding(fields)?;
        let endian = endian(fields, number, encoding)?;
        let axes = Axes::from_fields(fields, number, pick)?;
        let layout = Layout::new(axes.sizes, number, endian, &fields.with_line("sizes"))?;
        let (lattice, anatomical) = lattice(fields, &axes, layout.dims)?;
        let skip = |name: &str| match fields.get(name) {
            None => Ok(0),
            Some(text) => text.parse::<i64>().map_err(|_| {
                fields.malformed(name, "is not a whole number", "give the number to skip")
            }),
        };
        let line_skip = u64::try_from(skip("line skip")?)
            .map_err(|_| fields.malformed("line skip", "is negative", "give 0 or more"))?;
        let byte_skip =
            match skip("byte skip")? {
                -1 => Skip::FromEnd,
                n => Skip::Bytes(u64::try_from(n).map_err(|_| {
                    fields.malformed("byte skip", "is below -1", "give -1, 0 or more")
                })?),
            };
        let data_files = data_files(fields, &axes)?;
        let storage = Storage { encoding, line_skip, byte_skip, skip_field: "byte skip" };
        let part = axes.part(number, fields)?;
        let notes = axes.notes;
        Ok(Header { layout, part, notes, lattice, anatomical, storage, data_files })
    }
}

fn number_type(fields: &Fields) -> Result<Number, Problem> {
    Ok(match fields.required("type", "uint8")?.to_ascii_lowercase().as_str() {
        "signed char" | "int8" | "int8_t" => Number::I8,
        "uchar" | "unsigned char" | "uint8" | "uint8_t" => Number::U8,
        "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => {
            Number::I16
        }
        "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => Number::U16,
        "int" | "signed int" | "int32" | "int32_t" => Number::I32,
        "uint" | "unsigned int" | "uint32" | "uint32_t" => Number::U32,
        "longlong"
        | "long long"
        | "long long int"
        | "signed long long"
        | "signed long long int"
        | "int64"
        | "int64_t" => Number::I64,
        "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => {
            Number::U64
        }
        "float" => Number::F32,
        "double" => Number::F64,
        "block" => {
            return Err(Problem::unsupported(
                fields.with_line("type"),
                "`block` samples are not numbers",
                "save it as an integer or float type",
            ));
        }
        _ => {
            return Err(fields.malformed(
                "type",
                "is not a type of the NRRD format",
                "give one such as uint8, int16, uint16, float or double",
            ));
        }
    })
}

fn encoding(fields: &Fields) -> Result<Encoding, Problem> {
    Ok(match fields.required("encoding", "gzip")?.to_ascii_lowercase().as_str() {
        "raw" => Encoding::Raw,
        "gz" | "gzip" => Encoding::Gzip,
        "bz2" | "bzip2" => Encoding::Bzip2,
        "txt" | "text" | "ascii" => Encoding::Ascii,
        "hex" => Encoding::Hex,
        // Only teem writes this run-length encoding.
        "zrl" => {
            return Err(Problem::unsupported(
                fields.with_line("encoding"),
                "zrl is not read",
                RESAVE,
            ));
        }
        _ => {
            return Err(fields.malformed(
                "encoding",
                "is not an encoding of the NRRD format",
                RESAVE,
            ));
        }
    })
}

fn endian(fields: &Fields, number: Number, encoding: Encoding) -> Result<Endian, Problem> {
    match fields.get("endian").map(str::to_ascii_lowercase).as_deref() {
        Some("little") => Ok(Endian::Little),
        Some("big") => Ok(Endian::Big),
        None if number.bytes() == 1 || !encoding.has_order() => Ok(Endian::Little),
        None => Err(Problem::malformed(
            "endian",
            format!("is missing, and {} has {} bytes", number.name(), number.bytes()),
            "add the line `endian: little` (or `big`, as the data are)",
        )),
        Some(_) => Err(fields.malformed("endian", "is neither", "give `little` or `big`")),
    }
}

/// Returns the data files of a detached header: one name, `LIST [dim]` with a name on each
/// following line, or `name%03d.raw min max step [dim]`.
fn data_files(fields: &Fields, axes: &Axes) -> Result<Option<Vec<String>>, Problem> {
    let Some(value) = fields.get("data file") else { return Ok(None) };
    let words: Vec<&str> = value.split_ascii_whitespace().collect();
    let bad = |why: &str, remedy: &str| Err(fields.malformed("data file", why, remedy));
    let (names, dim) = match words[..] {
        [] => return bad("is empty", "name the data file"),
        ["LIST"] => (fields.list.clone(), None),
        ["LIST", dim] => (fields.list.clone(), Some(dim)),
        [pattern, min, max, step, ref rest @ ..]
            if rest.len() < 2
                && pattern.contains('%')
                && [min, max, step].iter().all(|w| w.parse::<i64>().is_ok()) =>
        {
            let n = |w: &str| w.parse().expect("the guard parsed it");
            match data::numbered_names(pattern, n(min), n(max), n(step)) {
                Some(names) => (names, rest.first().copied()),
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
    // Each file holds the first `dim` axes; by default all but the last.
    let dim = match dim.map(str::parse::<usize>) {
        None => axes.all.len() - 1,
        Some(Ok(dim)) if (1..=axes.all.len()).contains(&dim) => dim,
        Some(_) => return bad("ends in no number of axes", "give the axes that a file holds"),
    };
    // With dim = all axes, each file holds an equal part of the last axis.
    let whole = dim == axes.all.len();
    let want = axes.all[dim..].iter().try_fold(1u64, |n, &size| n.checked_mul(size));
    if names.is_empty() || !whole && want != Some(names.len() as u64) {
        let want = want.filter(|_| !whole).map_or("some".into(), |n| n.to_string());
        return Err(Problem::malformed(
            fields.with_line("data file"),
            format!("names {} files where the sizes want {want}", names.len()),
            "correct the list, or the sizes",
        ));
    }
    Ok(Some(names))
}

/// The axes of the file, and the three that become the volume's.
struct Axes {
    /// Number of axes of the file.
    count: usize,
    /// Indices of the three kept axes, ascending.
    kept: [usize; 3],
    /// Sizes of the kept axes.
    sizes: [u64; 3],
    /// Sizes of all axes of the file.
    all: Vec<u64>,
    /// Index along each axis that is not kept.
    at: Vec<Option<u64>>,
    /// Notes on volumes that are not read.
    notes: Vec<String>,
}

impl Axes {
    fn from_fields(fields: &Fields, number: Number, pick: Pick) -> Result<Axes, Problem> {
        let dimension = fields.required("dimension", "3")?;
        let count = match dimension.parse::<usize>() {
            Ok(n @ 1..=AXES_MAX) => n,
            _ => {
                return Err(fields.malformed("dimension", "is not 1 to 16", "a volume has 3"));
            }
        };
        fields.required("sizes", "256 256 256")?;
        let sizes = fields.per_axis("sizes", count)?.unwrap_or_default();
        let sizes: Vec<u64> =
            sizes.iter().map(|w| w.parse()).collect::<Result<_, _>>().map_err(|_| {
                fields.malformed("sizes", "has something else than whole numbers", "correct it")
            })?;
        let list = sizes.iter().map(u64::to_string).collect::<Vec<_>>().join(" x ");
        if count < 3 {
            return Err(match sizes[..] {
                [width, height] => Problem::flat(fields.with_line("dimension"), width, height),
                _ => Problem::unsupported(
                    fields.with_line("dimension"),
                    format!("{list} samples are a row of one axis, not a volume"),
                    "save a volume of three axes",
                ),
            });
        }
        let directions = match fields.get("space directions") {
            Some(_) => vectors(fields, "space directions", None)?,
            None => Vec::new(),
        };
        let kinds: Vec<&str> =
            fields.get("kinds").unwrap_or_default().split_ascii_whitespace().collect();
        let outside_space = |a: usize| {
            // An axis along the fourth dimension of a space is one of time.
            let flat =
                |d: &Option<Direction>| d.as_ref().is_none_or(|d| d.xyz == DVec3::ZERO && d.more);
            directions.get(a).is_some_and(flat)
                || !matches!(
                    kinds.get(a).map(|k| k.to_ascii_lowercase()).as_deref(),
                    None | Some("domain" | "space" | "???" | "none")
                )
        };
        let no_space = |axis: usize| {
            let direction = directions.get(axis);
            let (field, is) = match (kinds.get(axis), direction) {
                (_, Some(None)) => ("space directions", "`none`".to_string()),
                (_, Some(Some(d))) if d.more => {
                    ("space directions", "along the fourth dimension".to_string())
                }
                (kind, _) => ("kinds", quoted(kind.unwrap_or(&"none"))),
            };
            let size = sizes[axis];
            let left: Vec<String> =
                (0..count).filter(|&a| !outside_space(a)).map(|a| sizes[a].to_string()).collect();
            let flat = match &left[..] {
                [width, height] => format!("; the rest is a 2-D picture of {width} x {height}"),
                _ => String::new(),
            };
            let which = match ["the first axis", "the second axis", "the third axis"].get(axis) {
                Some(which) => which.to_string(),
                None => format!("axis {}", axis + 1),
            };
            Problem::unsupported(
                fields.with_line(field),
                format!(
                    "{which} of {list} is no axis of space: {is}, {size} sample{}{flat}",
                    if size == 1 { "" } else { "s" }
                ),
                match field {
                    "kinds" => {
                        "save one of its components or times as a volume of three axes, or call it \
                         `domain` if it is one of space"
                    }
                    _ => "save one of its components or times as a volume of three axes",
                },
            )
        };
        // Describes an axis that does not lie in space.
        let other = |axis: usize| {
            let size = sizes[axis];
            let kind = kinds.get(axis).map(|k| k.to_ascii_lowercase()).unwrap_or_default();
            let time = directions.get(axis).is_some_and(|d| d.as_ref().is_some_and(|d| d.more));
            match kind.as_str() {
                "time" => Axis::new(Kind::Time, "times", size),
                _ if time => Axis::new(Kind::Time, "times", size),
                // A list before the axes of space belongs to each voxel; after them it lists
                // volumes.
                "list" if axis > 0 => Axis::new(Kind::Other, "volumes (a list)", size),
                "" | "none" | "???" | "domain" | "space" if axis > 0 => {
                    Axis::new(Kind::Other, format!("along axis {}", axis + 1), size)
                }
                kind => {
                    let name = match kinds.get(axis) {
                        Some(given) if !matches!(kind, "none" | "???" | "domain" | "space") => {
                            format!("components ({given})")
                        }
                        _ => "numbers".into(),
                    };
                    // Slicer calls colours `vector`.
                    let colours = colours::may_be_colours(size, number)
                        && !matches!(kind, "hsv-color" | "xyz-color");
                    Axis::of_voxel(name, size, colours)
                }
            }
        };
        let in_space: Vec<usize> = (0..count).filter(|&a| !outside_space(a)).collect();
        if let (0..3, Some(axis)) = (in_space.len(), (0..count).find(|&a| outside_space(a))) {
            return Err(no_space(axis));
        }
        let mut kept = in_space;
        while kept.len() > 3 {
            // If more than three axes may lie in space, axes of one sample are dropped, the last
            // first.
            let single = kept.iter().rposition(|a| sizes[*a] == 1);
            // Then only the flag can tell which axis lists volumes or channels.
            let asked = match pick {
                Pick { volume: Some(_), .. } => Some(kept.len() - 1),
                Pick { channel: Some(_), .. } => Some(0),
                _ => None,
            };
            let Some(index) = single.or(asked) else {
                return Err(Problem::unsupported(
                    fields.with_line("dimension"),
                    format!(
                        "{list} has {} axes of more than one sample, and nothing says which are of \
                         space",
                        kept.len()
                    ),
                    "take a volume along the last with --volume 0, a number along the first with \
                     --channel 0, or add `kinds`",
                ));
            };
            kept.remove(index);
        }
        let kept = <[usize; 3]>::try_from(kept).expect("three of three or more axes are left");
        let dropped: Vec<usize> = (0..count).filter(|a| !kept.contains(a)).collect();
        let more: Vec<Axis> = dropped.iter().map(|&a| other(a)).collect();
        let field =
            dropped.first().map_or("sizes", |_| if kinds.is_empty() { "sizes" } else { "kinds" });
        let (picked, notes) = pick.choose(&more, &fields.with_line(field))?;
        let mut at = vec![None; count];
        for (axis, index) in dropped.into_iter().zip(picked) {
            at[axis] = Some(index);
        }
        Ok(Axes { count, kept, sizes: kept.map(|a| sizes[a]), all: sizes, at, notes })
    }

    /// Returns the part of the samples that is read; `None` for all.
    fn part(&self, number: Number, fields: &Fields) -> Result<Option<Part>, Problem> {
        let several = self.at.iter().zip(&self.all).any(|(at, size)| at.is_some() && *size > 1);
        if !several {
            return Ok(None);
        }
        match Part::new(&self.all, self.at.clone(), number.bytes()) {
            Some(part) => Ok(Some(part)),
            None => {
                Err(fields.malformed("sizes", "has more samples than can be", "correct the sizes"))
            }
        }
    }
}

/// Returns the lattice in RAS+, and whether its axes are anatomical.
fn lattice(fields: &Fields, axes: &Axes, dims: [u32; 3]) -> Result<(Lattice, bool), Problem> {
    let space = space(fields)?;
    let mut lattice = if fields.get("space directions").is_some() {
        lattice_from_directions(fields, axes, dims)?
    } else {
        let spacings = numbers(fields, "spacings", axes)?;
        let ranges = Ranges::from_fields(fields, axes)?;
        let (mut spacing, mut first) = ([1.0; 3], DVec3::ZERO);
        for a in 0..3 {
            spacing[a] = spacings[a].or(ranges.step(a, dims[a])).unwrap_or(1.0);
            first[a] = ranges.first(a, spacing[a]).unwrap_or(0.0);
        }
        let mut lattice = Lattice { origin: first, ..Lattice::from_spacing(dims, spacing) };
        if let (Some(origin), Some(_)) = (origin(fields)?, space) {
            lattice.origin = origin;
        }
        lattice
    };
    // A space without directions does not say where the index axes point.
    let directed = fields.get("space directions").is_some();
    let space = space.filter(|_| directed);
    let (signs, anatomical) = space.map_or((DVec3::ONE, false), |s| (s.signs, s.anatomical));
    let scale = unit_mm(fields);
    // Adding zero turns -0.0 into 0.0, which the volume's digest would distinguish.
    lattice.steps = lattice.steps.map(|s| s * signs * scale + DVec3::ZERO);
    lattice.origin = lattice.origin * signs * scale + DVec3::ZERO;
    lattice.check().map_err(|e| {
        let field = if directed { "space directions" } else { "spacings" };
        Problem::malformed(fields.with_line(field), e, "correct the axes")
    })?;
    Ok((lattice, anatomical))
}

/// Returns a field's numbers along the three kept axes; `None` for NaN, the format's "unknown".
fn numbers(fields: &Fields, name: &str, axes: &Axes) -> Result<[Option<f64>; 3], Problem> {
    let mut found = [None; 3];
    let Some(words) = fields.per_axis(name, axes.count)? else { return Ok(found) };
    for (to, &axis) in found.iter_mut().zip(&axes.kept) {
        let x: f64 = words[axis]
            .parse()
            .map_err(|_| fields.malformed(name, "has something else than numbers", "correct it"))?;
        *to = (!x.is_nan()).then_some(x);
    }
    Ok(found)
}

/// Ends of the kept axes (`axis mins`, `axis maxs`), which some files have in place of a spacing.
struct Ranges {
    mins: [Option<f64>; 3],
    maxs: [Option<f64>; 3],
    /// Whether the ends are the outer faces of cells with samples in their middles. Otherwise the
    /// first and the last sample lie at the ends.
    cells: [bool; 3],
}

impl Ranges {
    fn from_fields(fields: &Fields, axes: &Axes) -> Result<Ranges, Problem> {
        let centers = fields.per_axis("centers", axes.count)?;
        // Without `centers`, teem takes cells.
        let node = |axis: usize| centers.as_ref().is_some_and(|c| c[axis] == "node");
        Ok(Ranges {
            mins: numbers(fields, "axis mins", axes)?,
            maxs: numbers(fields, "axis maxs", axes)?,
            cells: axes.kept.map(|axis| !node(axis)),
        })
    }

    /// Returns the distance between neighbours of `n` samples along an axis, if the file gives both
    /// ends.
    fn step(&self, a: usize, n: u32) -> Option<f64> {
        let steps = f64::from(if self.cells[a] { n } else { n - 1 });
        let step = (self.maxs[a]? - self.mins[a]?) / steps;
        (step.is_finite() && step != 0.0).then_some(step)
    }

    /// Returns the position of the first sample along an axis, if the file gives it.
    fn first(&self, a: usize, step: f64) -> Option<f64> {
        let first = self.mins[a]? + if self.cells[a] { step / 2.0 } else { 0.0 };
        first.is_finite().then_some(first)
    }
}

fn lattice_from_directions(
    fields: &Fields,
    axes: &Axes,
    dims: [u32; 3],
) -> Result<Lattice, Problem> {
    let all = vectors(fields, "space directions", Some(axes.count))?;
    let mut steps = [DVec3::ZERO; 3];
    for (a, &axis) in axes.kept.iter().enumerate() {
        let direction = all[axis].filter(|d| !d.more).ok_or_else(|| {
            fields.malformed(
                "space directions",
                &format!("does not say where axis {} runs in three dimensions", axis + 1),
                "save a volume with three axes in space",
            )
        })?;
        steps[a] = direction.xyz;
    }
    Ok(Lattice { dims, steps, origin: origin(fields)?.unwrap_or(DVec3::ZERO) })
}

fn origin(fields: &Fields) -> Result<Option<DVec3>, Problem> {
    if fields.get("space origin").is_none() {
        return Ok(None);
    }
    Ok(vectors(fields, "space origin", Some(1))?[0].map(|v| v.xyz))
}

/// A vector of a space of three dimensions or more.
#[derive(Clone, Copy)]
struct Direction {
    xyz: DVec3,
    /// Whether the vector has a component along a dimension after the third.
    more: bool,
}

/// Parses vectors such as `(1,0,0) none (0,0,1)`; `count` is how many there must be. In a space of
/// four dimensions they have four numbers.
fn vectors(
    fields: &Fields,
    name: &str,
    count: Option<usize>,
) -> Result<Vec<Option<Direction>>, Problem> {
    let dimensions = match fields.get("space dimension").map(str::parse) {
        Some(Ok(n @ 3..=AXES_MAX)) => n,
        _ => 3 + usize::from(fields.get("space").is_some_and(has_time)),
    };
    let bad = || fields.malformed(name, "is not made of vectors (x,y,z)", "correct the vectors");
    let mut rest = fields.get(name).unwrap_or_default().trim_start();
    let mut found = Vec::new();
    while !rest.is_empty() {
        if let Some(after) = rest.strip_prefix("none") {
            found.push(None);
            rest = after.trim_start();
            continue;
        }
        let (inside, after) =
            rest.strip_prefix('(').and_then(|r| r.split_once(')')).ok_or_else(bad)?;
        let numbers: Vec<f64> = inside
            .split(',')
            .map(|w| w.trim().parse::<f64>())
            .collect::<Result<_, _>>()
            .map_err(|_| bad())?;
        let (&[x, y, z], more) = numbers.split_first_chunk::<3>().ok_or_else(bad)?;
        if numbers.len() != dimensions {
            return Err(bad());
        }
        let more = more.iter().any(|x| *x != 0.0);
        found.push(Some(Direction { xyz: DVec3::new(x, y, z), more }));
        rest = after.trim_start();
    }
    if count.is_some_and(|n| n != found.len()) {
        return Err(fields.malformed(
            name,
            &format!("has {} vectors", found.len()),
            "give one for each axis (`space origin`: one)",
        ));
    }
    Ok(found)
}

/// A space of the format: the signs of its axes in RAS+, and whether they are anatomical.
#[derive(Clone, Copy)]
struct Space {
    signs: DVec3,
    anatomical: bool,
}

fn space(fields: &Fields) -> Result<Option<Space>, Problem> {
    let anatomical = |x, y, z| Some(Space { signs: DVec3::new(x, y, z), anatomical: true });
    let Some(name) = fields.get("space") else {
        return match fields.get("space dimension") {
            None => Ok(None),
            // In a space of four dimensions, a volume at one time needs three.
            Some("3" | "4") => Ok(Some(Space { signs: DVec3::ONE, anatomical: false })),
            Some(_) => {
                Err(fields.malformed("space dimension", "is not 3", "save it in a space of three"))
            }
        };
    };
    let lower = name.to_ascii_lowercase();
    let three = match lower.as_str() {
        "rast" | "last" | "lpst" => &lower[..3],
        name => name.strip_suffix("-time").unwrap_or(name),
    };
    Ok(match three {
        "right-anterior-superior" | "ras" => anatomical(1.0, 1.0, 1.0),
        "left-anterior-superior" | "las" => anatomical(-1.0, 1.0, 1.0),
        "left-posterior-superior" | "lps" => anatomical(-1.0, -1.0, 1.0),
        "scanner-xyz" | "3d-right-handed" => Some(Space { signs: DVec3::ONE, anatomical: false }),
        // The world is right-handed: without the sign it would be drawn mirrored.
        "3d-left-handed" => Some(Space { signs: DVec3::new(1.0, 1.0, -1.0), anatomical: false }),
        _ => {
            return Err(fields.malformed(
                "space",
                "is not a space of the NRRD format",
                "give one such as left-posterior-superior",
            ));
        }
    })
}

/// Returns whether a space has a fourth dimension, time.
fn has_time(space: &str) -> bool {
    let lower = space.to_ascii_lowercase();
    lower.ends_with("-time") || matches!(lower.as_str(), "rast" | "last" | "lpst")
}

/// Returns the millimetres of one unit of length; 1 unless all axes have the same known unit.
fn unit_mm(fields: &Fields) -> f64 {
    let units = fields.get("space units").or_else(|| fields.get("units")).unwrap_or_default();
    let mut units = units.split_ascii_whitespace().map(|u| match u.trim_matches('"') {
        "m" => Some(1000.0),
        "cm" => Some(10.0),
        "um" | "\u{b5}m" | "\u{3bc}m" | "microns" | "micron" => Some(1e-3),
        "nm" => Some(1e-6),
        "mm" => Some(1.0),
        _ => None,
    });
    match units.next().flatten() {
        Some(mm) if units.all(|u| u == Some(mm)) => mm,
        _ => 1.0,
    }
}

#[cfg(test)]
mod tests;
