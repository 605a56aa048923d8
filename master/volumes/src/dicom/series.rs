//! Groups the files of a folder into series, sorts the slices of one, places them and writes its
//! samples.

use super::elements::{File, Packing, Pixels, Tag};
use super::gaps::{millimetres, missing_after, missing_note};
use super::{fragments, frames, jpeg, jpeg_ls, jpeg2000, rle};
use crate::confined::wire::Preface;
use crate::error::{OpenErrorKind, Problem, quoted};
use crate::pick::{Axis, Kind, Pick};
use crate::samples::{DIM_MAX, Endian, Layout, Number};
use crate::source::Source;
use glam::DVec3;
use slabcast_common::volume::Lattice;
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// One picture of a series, without its pixels. Lengths in mm, positions in LPS.
struct Slice {
    path: PathBuf,
    format: PixelFormat,
    /// Slope and intercept from stored numbers to values.
    rescale: [f64; 2],
    /// Middle of the first pixel, and the steps to the next column and to the next row.
    place: Option<(DVec3, [DVec3; 2])>,
    /// Distances of columns, rows and slices, for files without a position.
    spacing: [f64; 3],
    /// InstanceNumber, the order of slices without a position.
    instance: f64,
    /// Whether the file gives no distance of slices, or one in words.
    thickness_note: Option<String>,
    /// Bytes of uncompressed pixels; `None` where they are packed.
    native_bytes: Option<u64>,
    /// Place of the pixels in a file of several frames.
    frame: Option<frames::Frame>,
    /// Whether the stored numbers are indices of a palette.
    palette: bool,
}

/// Size and number format of a picture. All slices of a series have one size; each may have a
/// format of its own.
#[derive(Clone, Copy, Debug, PartialEq)]
struct PixelFormat {
    columns: u16,
    rows: u16,
    /// Bits a pixel in the file: 8, 16 or 32.
    allocated: u16,
    /// Bits that hold the value.
    stored: u16,
    /// Index of the value's highest bit.
    high: u16,
    signed: bool,
}

/// A series with its slices and the names that people use for it.
struct Series {
    uid: String,
    number: String,
    description: String,
    modality: String,
    slices: Vec<Slice>,
}

impl Series {
    fn name(&self) -> String {
        let words = [&self.modality, &self.number, &self.description];
        let words: Vec<&str> = words.iter().map(|w| w.as_str()).filter(|w| !w.is_empty()).collect();
        if words.is_empty() { self.uid.clone() } else { words.join(" ") }
    }

    fn is_called(&self, name: &str) -> bool {
        let whole = self.name();
        let called = [&self.uid, &self.number, &self.description, &whole];
        // A long name is shown cut, and may be given as it is shown.
        called.iter().any(|n| *n == name) || quoted(&whole) == format!("`{name}`")
    }
}

/// Longest UID of the standard; what is longer is shown cut.
const UID_MAX_CHARS: usize = 64;

/// Returns what `--series` takes for each series and for no other: `None` where its name does, else
/// its UID, with `/1`, `/2` and so on where several share that too.
fn handles(all: &[Series]) -> Vec<Option<String>> {
    let uid = |s: &Series| match s.uid.is_empty() {
        true => s.name(),
        false => s.uid.chars().filter(|c| !c.is_control()).take(UID_MAX_CHARS).collect::<String>(),
    };
    let handle = |(i, s): (usize, &Series)| {
        if all.iter().filter(|t| quoted(&t.name()) == quoted(&s.name())).count() < 2 {
            return None;
        }
        let uid_of = uid(s);
        let same = |t: &&Series| uid(t) == uid_of;
        Some(match all.iter().filter(same).count() {
            0 | 1 => uid_of,
            _ => format!("{uid_of}/{}", all[..=i].iter().filter(same).count()),
        })
    };
    all.iter().enumerate().map(handle).collect()
}

/// The series to read.
pub(crate) struct SeriesChoice<'a> {
    /// Number, description, name or UID of the wanted series.
    pub(crate) series: Option<&'a str>,
    /// A slice of it.
    pub(crate) file: Option<&'a Path>,
    /// Choice among the times or echoes of the series.
    pub(crate) pick: Pick,
}

/// Writes the chosen series of these files: a preface with these notes and more, then samples in
/// little-endian order.
pub(super) fn write(
    files: &[PathBuf],
    choice: &SeriesChoice<'_>,
    mut notes: Vec<String>,
    out: &mut dyn Write,
) -> Result<(), Problem> {
    let (all, left_out, unread) = gather(files)?;
    let total = all.len();
    // The file that was given, or no picture but such.
    let given = unread.iter().find(|(path, _)| choice.file == Some(&**path));
    if let Some((_, problem)) = given.or(unread.first().filter(|_| total == 0)) {
        return Err(problem.clone());
    }
    let mut series = choose(all, choice)?;
    let name = series.name();
    if total > 1 {
        notes.push(format!("series {} of {total} was read", quoted(&name)));
    }
    if left_out > 0 {
        notes.push(format!("{left_out} DICOM files without a picture were left out"));
    }
    if let Some((_, first)) = unread.first() {
        let (n, were) = (unread.len(), if unread.len() == 1 { " was" } else { "s were" });
        notes.push(format!("{n} DICOM file{were} left out: {first}"));
    }
    let (preface, missing) = arrange(&mut series, &choice.pick, &mut notes)?;
    let read = |slice: &Slice| pixels(slice, preface.number).map_err(|p| in_file(&slice.path, p));
    // After the first byte a problem can't be told in full, and most are those of all slices.
    let mut first = Some(read(&series.slices[0])?);
    preface.write(out).map_err(|e| Problem::io("pipe", &e))?;
    let empty = match missing.is_empty() {
        true => Vec::new(),
        false => {
            let [columns, rows, _] = preface.lattice.dims.map(|n| n as usize);
            f32::NAN.to_le_bytes().repeat(columns * rows)
        }
    };
    for (i, slice) in series.slices.iter().enumerate() {
        let bytes = first.take().map_or_else(|| read(slice), Ok)?;
        out.write_all(&bytes).map_err(|e| Problem::io("pipe", &e))?;
        for _ in 0..missing.get(i).copied().unwrap_or(0) {
            out.write_all(&empty).map_err(|e| Problem::io("pipe", &e))?;
        }
    }
    out.flush().map_err(|e| Problem::io("pipe", &e))
}

/// Adds the file's name to the field of a problem.
fn in_file(path: &Path, mut p: Problem) -> Problem {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    p.field = format!("{} {}", quoted(&name), p.field);
    p
}

/// Files that are left out, each with its problem.
type LeftOut = Vec<(PathBuf, Problem)>;

/// Reads the headers of all files. Returns the series, the number of files without a picture, and
/// the problems of files that are damaged or of a kind that is not read.
fn gather(files: &[PathBuf]) -> Result<(Vec<Series>, usize, LeftOut), Problem> {
    let mut all: BTreeMap<(String, u16, u16, String), Series> = BTreeMap::new();
    let (mut left_out, mut unread) = (0, Vec::new());
    for path in files {
        let source = Source::open(path, "file").map_err(|p| in_file(path, p))?;
        let mut file = match File::open(source) {
            Ok(file) => file,
            // DICOMDIR, reports and other files without pixels.
            Err(p) if p.kind == OpenErrorKind::NotAVolume => {
                left_out += 1;
                continue;
            }
            Err(p) => {
                unread.push((path.clone(), in_file(path, p)));
                continue;
            }
        };
        let slices = match slices(path, &mut file) {
            Ok(slices) => slices,
            Err(p) => {
                unread.push((path.clone(), in_file(path, p)));
                continue;
            }
        };
        let get = |tag: Tag| file.text(tag).unwrap_or_default();
        for slice in slices {
            // A localizer has pictures in several orientations under one UID.
            let orientation = slice.place.map(|(_, [r, c])| {
                let n = r.normalize_or_zero().cross(c.normalize_or_zero());
                format!("{:.2} {:.2} {:.2}", n.x + 0.0, n.y + 0.0, n.z + 0.0)
            });
            let uid = get((0x0020, 0x000e));
            let key = (
                uid.clone(),
                slice.format.columns,
                slice.format.rows,
                orientation.unwrap_or_default(),
            );
            let series = all.entry(key).or_insert_with(|| Series {
                uid,
                number: get((0x0020, 0x0011)),
                description: get((0x0008, 0x103e)),
                modality: get((0x0008, 0x0060)),
                slices: Vec::new(),
            });
            series.slices.push(slice);
        }
    }
    Ok((all.into_values().collect(), left_out, unread))
}

/// Returns the slices of a file: one, or one for each frame.
fn slices(path: &Path, file: &mut File) -> Result<Vec<Slice>, Problem> {
    let frames = frames::frames(file)?;
    if frames.is_empty() {
        return Ok(vec![Slice::from_file(path, file)?]);
    }
    let slice = |frame: frames::Frame| {
        file.select(&frame);
        let slice = Slice::from_file(path, file)?;
        Ok(Slice { native_bytes: None, frame: Some(frame), ..slice })
    };
    frames.into_iter().map(slice).collect()
}

/// Picks the chosen series, or fails with a list of all.
fn choose(mut all: Vec<Series>, choice: &SeriesChoice<'_>) -> Result<Series, Problem> {
    // By size, so that the error lists localizers last.
    all.sort_by_key(|s| std::cmp::Reverse(s.slices.len()));
    let handles = handles(&all);
    let list = |which: &[usize]| {
        let name = |&i: &usize| {
            let s = &all[i];
            let (name, n) = (s.name(), s.slices.len());
            // Some scanners give all series the same name.
            let uid = handles[i].as_ref().map(|uid| format!(", UID `{uid}`")).unwrap_or_default();
            format!("{} ({n} slice{}{uid})", quoted(&name), if n == 1 { "" } else { "s" })
        };
        let mut names: Vec<String> = which.iter().take(12).map(name).collect();
        if which.len() > 12 {
            names.push(format!("and {} more", which.len() - 12));
        }
        names.join(", ")
    };
    if all.is_empty() {
        return Err(Problem::new(
            OpenErrorKind::NotAVolume,
            "folder",
            "holds DICOM files, but no picture",
            "give the folder of a series",
        ));
    }
    if let Some(file) = choice.file {
        let holds = |s: &Series| s.slices.iter().any(|slice| slice.path == file);
        if let Some(found) = all.iter().position(holds) {
            return Ok(all.swap_remove(found));
        }
    }
    let every: Vec<usize> = (0..all.len()).collect();
    match choice.series {
        None if all.len() < 2 => Ok(all.swap_remove(0)),
        None => Err(Problem::malformed(
            "--series",
            format!("the folder holds {} series: {}", all.len(), list(&every)),
            "name one of them, its number or its UID",
        )),
        Some(name) => {
            let by = |is: &dyn Fn(usize) -> bool| -> Vec<usize> {
                every.iter().copied().filter(|&i| is(i)).collect()
            };
            // Exactly as listed; else a name; else the beginning of a UID, as far as it is unique.
            let begins = name.trim_end_matches("...").trim_end_matches('\u{2026}');
            let mut called = by(&|i| handles[i].as_deref() == Some(name));
            if called.is_empty() {
                called = by(&|i| all[i].is_called(name));
            }
            if called.is_empty() && begins.contains('.') {
                called = by(&|i| all[i].uid.starts_with(begins));
            }
            match called[..] {
                [one] => Ok(all.swap_remove(one)),
                [] => Err(Problem::malformed(
                    "--series",
                    format!("there is no {} among {}", quoted(name), list(&every)),
                    "name one of them, its number or its UID",
                )),
                _ => Err(Problem::malformed(
                    "--series",
                    format!(
                        "{} series are called {}: {}",
                        called.len(),
                        quoted(name),
                        list(&called)
                    ),
                    "give the whole name, or what is listed as UID",
                )),
            }
        }
    }
}

impl Slice {
    fn from_file(path: &Path, file: &File) -> Result<Slice, Problem> {
        let need = |tag: Tag| {
            file.short(tag).ok_or_else(|| {
                Problem::malformed(super::elements::name(tag), "is missing", "get the file again")
            })
        };
        let refuse = |field: &str, what: String, remedy: &str| {
            Err(Problem::unsupported(field, what, remedy))
        };
        // `01`, `+1` and an empty count are one frame, and so is 0, which some programs write.
        let frames = file.text((0x0028, 0x0008));
        if frames.is_some_and(|n| !matches!(n.parse::<f64>(), Ok(n) if n == 0.0 || n == 1.0)) {
            return refuse(
                "NumberOfFrames",
                "is above 1, and the file does not say where its frames lie".into(),
                "convert it, for instance with dcm2niix",
            );
        }
        let samples = file.short((0x0028, 0x0002)).unwrap_or(1);
        if samples != 1 {
            let photometric = file.text((0x0028, 0x0004)).unwrap_or_default();
            return refuse(
                "SamplesPerPixel",
                format!("is {samples}: a picture in colours ({})", quoted(&photometric)),
                "leave it out, or save it in shades of grey",
            );
        }
        let has = |tag: Tag, word: &str| file.text(tag).is_some_and(|t| t.contains(word));
        if has((0x0008, 0x0008), "MOSAIC") {
            return refuse(
                "ImageType",
                "is MOSAIC: all slices of a time lie side by side in one picture (Siemens)".into(),
                "convert the series with dcm2niix",
            );
        }
        if file.text((0x0028, 0x3000)).is_some() {
            return refuse(
                "ModalityLUTSequence",
                "gives the values by a table, which is not read".into(),
                "apply it, for instance with pydicom's apply_modality_lut, and save the result",
            );
        }
        let palette = has((0x0028, 0x0004), "PALETTE");
        let allocated = need((0x0028, 0x0100))?;
        let stored = file.short((0x0028, 0x0101)).unwrap_or(allocated);
        let high = file.short((0x0028, 0x0102)).unwrap_or(stored.saturating_sub(1));
        let format = PixelFormat {
            columns: need((0x0028, 0x0011))?,
            rows: need((0x0028, 0x0010))?,
            allocated,
            stored,
            high,
            signed: file.short((0x0028, 0x0103)) == Some(1),
        };
        if !matches!(allocated, 8 | 16 | 32) {
            return refuse("BitsAllocated", format!("{allocated} are not read"), "convert it");
        }
        if stored == 0 || stored > allocated || high >= allocated || high + 1 < stored {
            return Err(Problem::malformed(
                "BitsStored",
                format!("{stored} bits up to bit {high} do not fit into {allocated}"),
                "get the file again",
            ));
        }
        let sizes = [format.columns.into(), format.rows.into(), 1];
        Layout::new(sizes, Number::U8, Endian::Little, "Rows, Columns")?;
        let [between_rows, between_columns] = match file.numbers::<2>((0x0028, 0x0030))? {
            Some(spacing) => spacing,
            None => file.numbers::<2>((0x0018, 0x1164))?.unwrap_or([1.0; 2]),
        };
        let positive = |x: f64| if x > 0.0 { x } else { 1.0 };
        // Positions may give the step, so a malformed spacing or thickness is not refused here.
        let mut thickness_note = None;
        let mut thick = None;
        for tag in [(0x0018, 0x0088), (0x0018, 0x0050)] {
            let Some(text) = file.text(tag).filter(|_| thick.is_none()) else { continue };
            thick = leading_number(&text).map(f64::abs).filter(|x| *x > 0.0);
            if text.trim().parse::<f64>().is_err() {
                let (field, text) = (super::elements::name(tag), quoted(&text));
                thickness_note = Some(match thick {
                    Some(mm) => format!("{field} is {text}, and {mm} mm was taken"),
                    None => format!("{field} is {text}, which is no length"),
                });
            }
        }
        if thick.is_none() {
            let why = thickness_note.map_or("no distance of slices is given".into(), |n| n);
            thickness_note = Some(format!("{why}; 1 mm was assumed"));
        }
        let spacing =
            [positive(between_columns), positive(between_rows), positive(thick.unwrap_or(1.0))];
        let position = file.numbers::<3>((0x0020, 0x0032))?;
        let directions = file.numbers::<6>((0x0020, 0x0037))?;
        let place = position.zip(directions).map(|(p, d)| {
            // The first direction runs along a row, from column to column.
            let row = DVec3::new(d[0], d[1], d[2]) * spacing[0];
            let column = DVec3::new(d[3], d[4], d[5]) * spacing[1];
            (DVec3::from_array(p), [row, column])
        });
        // A dose has its grid's scale in place of a slope.
        let slope = match file.numbers::<1>((0x0028, 0x1053))? {
            None => file.numbers::<1>((0x3004, 0x000e))?,
            slope => slope,
        };
        let [slope] = slope.unwrap_or([1.0]);
        let [intercept] = file.numbers::<1>((0x0028, 0x1052))?.unwrap_or([0.0]);
        let rescale = if slope == 0.0 { [1.0, 0.0] } else { [slope, intercept] };
        let instance = file.numbers::<1>((0x0020, 0x0013)).ok().flatten().map_or(0.0, |[n]| n);
        let native_bytes = match file.pixels {
            Pixels::Native { bytes, .. } => Some(bytes),
            Pixels::Packed(_) => None,
        };
        Ok(Slice {
            path: path.into(),
            format,
            rescale,
            place,
            spacing,
            instance,
            thickness_note,
            native_bytes,
            frame: None,
            palette,
        })
    }

    /// Returns the bytes that the pixels need.
    fn need_bytes(&self) -> u64 {
        let f = self.format;
        u64::from(f.columns) * u64::from(f.rows) * u64::from(f.allocated / 8)
    }

    /// Returns how many bytes of padding follow the pixels; an odd number of bytes always has one,
    /// which does not count.
    fn padding_bytes(&self) -> Result<u64, Problem> {
        let need = self.need_bytes();
        let Some(have) = self.native_bytes else { return Ok(0) };
        let remedy = match have {
            have if have < need => "get the whole file",
            // Another picture, or wider numbers than the header says.
            have if have >= 2 * need && have > 4 => {
                "correct Rows, Columns, BitsAllocated or NumberOfFrames, or convert the series"
            }
            _ => return Ok((have - need).saturating_sub(need % 2)),
        };
        Err(Problem::new(
            OpenErrorKind::Damaged,
            "PixelData",
            format!("has {have} bytes, where Rows and Columns want {need}"),
            remedy,
        ))
    }
}

/// Returns the number that a text begins with, such as 5 of `5 mm`; a comma may be its point.
fn leading_number(text: &str) -> Option<f64> {
    let text = text.trim_start().replace(',', ".");
    let ends = text.char_indices().map(|(i, c)| i + c.len_utf8());
    let longest = ends.rev().find_map(|end| text[..end].parse::<f64>().ok());
    longest.filter(|x| x.is_finite())
}

/// Sorts the slices, checks that they agree, and returns the preface with their lattice, and how
/// many slices are missing after each; nothing if none is.
fn arrange(
    series: &mut Series,
    pick: &Pick,
    notes: &mut Vec<String>,
) -> Result<(Preface, Vec<u32>), Problem> {
    let name = series.name();
    let mut count = series.slices.len();
    let slices = &mut series.slices;
    let first = &slices[0];
    let format = first.format;
    let n = slices.len() as u64;
    if n > DIM_MAX {
        return Err(Problem::new(
            OpenErrorKind::TooLarge,
            "series",
            format!("{n} slices are more than {DIM_MAX}"),
            "leave some out",
        ));
    }
    let mut padded = Vec::new();
    for slice in slices.iter() {
        match slice.padding_bytes() {
            Ok(0) => {}
            Ok(bytes) => padded.push(bytes),
            Err(problem) => return Err(in_file(&slice.path, problem)),
        }
    }
    if let Some(most) = padded.iter().max() {
        notes.push(format!(
            "{} of {n} slices have up to {most} bytes of padding after their pixels, which were \
             ignored",
            padded.len()
        ));
    }
    if slices.iter().any(|s| s.palette) {
        notes.push("its colours come from a palette; the stored indices were read".into());
    }
    if slices.iter().any(|s| s.format != format) {
        notes.push(format!(
            "the slices of {} differ in BitsAllocated, BitsStored, HighBit or PixelRepresentation; \
             each was read by its own",
            quoted(&name)
        ));
    }
    let placed = slices.iter().all(|s| s.place.is_some());
    let mut missing = Vec::new();
    let lattice = if placed {
        let (_, [row, column]) = first.place.expect("all have one");
        let normal = row.cross(column).normalize_or_zero();
        let along = |s: &Slice| s.place.map_or(0.0, |(p, _)| p.dot(normal));
        slices
            .sort_by(|a, b| along(a).total_cmp(&along(b)).then(a.instance.total_cmp(&b.instance)));
        pick_one_time(slices, &along, pick, notes)?;
        count = slices.len();
        let gaps: Vec<f64> = slices.windows(2).map(|w| along(&w[1]) - along(&w[0])).collect();
        let (least, most) =
            gaps.iter().fold((f64::INFINITY, 0.0f64), |(a, b), g| (a.min(*g), b.max(*g)));
        missing = missing_after(&gaps);
        if !missing.is_empty() {
            notes.push(missing_note(&name, &gaps, &missing, along(&slices[0])));
            count += missing.iter().sum::<u32>() as usize;
        } else if most > 1.05 * least {
            notes.push(format!(
                "the slices of {} are {} to {} mm apart, and are drawn as if they were even; some \
                 may be missing",
                quoted(&name),
                millimetres(least),
                millimetres(most)
            ));
        }
        let origin = slices[0].place.expect("all have one").0;
        let step = match slices[..] {
            [ref a, .., ref b] => {
                let ends = [a, b].map(|s| s.place.expect("all have one").0);
                (ends[1] - ends[0]) / (count as f64 - 1.0)
            }
            _ => {
                notes.extend(slices[0].thickness_note.clone());
                normal * slices[0].spacing[2]
            }
        };
        // LPS to RAS. Adding zero turns -0.0 into 0.0.
        let ras = |v: DVec3| v * DVec3::new(-1.0, -1.0, 1.0) + DVec3::ZERO;
        let dims = [u32::from(format.columns), u32::from(format.rows), count as u32];
        Lattice { dims, steps: [ras(row), ras(column), ras(step)], origin: ras(origin) }
    } else {
        slices.sort_by(|a, b| a.instance.total_cmp(&b.instance).then(a.path.cmp(&b.path)));
        notes.push(format!(
            "the slices of {} do not say where they lie; they are in the order of their numbers",
            quoted(&name)
        ));
        notes.extend(slices[0].thickness_note.clone());
        pick.choose(&[], "slices")?;
        let dims = [u32::from(format.columns), u32::from(format.rows), count as u32];
        Lattice::from_spacing(dims, slices[0].spacing)
    };
    lattice
        .check()
        .map_err(|e| Problem::malformed("ImageOrientationPatient", e, "get the series again"))?;
    // One rescale for all slices goes into the value map; several turn all samples into floats.
    let rescale = slices[0].rescale;
    let several = slices.iter().any(|s| s.rescale != rescale);
    // Only floats can say that there is no value.
    let float = several || !missing.is_empty();
    if several {
        notes.push(
            "each slice has a slope and an intercept of its own; its values became float32".into(),
        );
    }
    let number = if float { Number::F32 } else { common_number(slices.iter().map(|s| s.format)) };
    let preface = Preface {
        name,
        number,
        lattice,
        anatomical: placed,
        rescale: if float { [1.0, 0.0] } else { rescale },
        float,
        notes: std::mem::take(notes),
    };
    Ok((preface, missing))
}

/// Leaves one slice at each place of sorted slices, where all places have as many: the picked time
/// or echo, in the order of instance numbers. `along` is a slice's place along their normal.
fn pick_one_time(
    slices: &mut Vec<Slice>,
    along: &impl Fn(&Slice) -> f64,
    pick: &Pick,
    notes: &mut Vec<String>,
) -> Result<(), Problem> {
    const FIELD: &str = "ImagePositionPatient";
    let gaps = slices.windows(2).map(|w| along(&w[1]) - along(&w[0]));
    let most = gaps.fold(0.0f64, f64::max);
    let mut places: Vec<Vec<Slice>> = Vec::new();
    for slice in slices.drain(..) {
        match places.last_mut() {
            Some(place) if along(&slice) - along(&place[0]) <= 1e-4 * most => place.push(slice),
            _ => places.push(vec![slice]),
        }
    }
    let sizes = places.iter().map(Vec::len);
    let (least, most) = (sizes.clone().min().unwrap_or(1), sizes.max().unwrap_or(1));
    if least != most {
        return Err(Problem::unsupported(
            FIELD,
            format!(
                "is the same for up to {most} slices, and for {least} elsewhere: times or echoes \
                 that are not whole"
            ),
            "give a folder with one of them, or convert the series, for instance with dcm2niix",
        ));
    }
    let times = Axis::new(Kind::Time, "times or echoes", most as u64);
    let (at, said) = pick.choose(&[times], FIELD)?;
    notes.extend(said);
    for mut place in places {
        place.sort_by(|a, b| a.instance.total_cmp(&b.instance).then(a.path.cmp(&b.path)));
        slices.push(place.swap_remove(at[0] as usize));
    }
    Ok(())
}

/// Returns the type that holds the stored values of all formats.
fn common_number(formats: impl Iterator<Item = PixelFormat> + Clone) -> Number {
    let signed = formats.clone().any(|f| f.signed);
    // Beside signed numbers an unsigned one needs a bit more than it has.
    let bits = |f: PixelFormat| if signed && !f.signed { f.stored + 1 } else { f.allocated };
    match (formats.map(bits).max().unwrap_or(32), signed) {
        (..=8, false) => Number::U8,
        (..=8, true) => Number::I8,
        (..=16, false) => Number::U16,
        (..=16, true) => Number::I16,
        (_, false) => Number::U32,
        (..=32, true) => Number::I32,
        (_, true) => Number::I64,
    }
}

/// Returns the samples of a slice as little-endian numbers: as stored, or rescaled if they are f32.
fn pixels(slice: &Slice, number: Number) -> Result<Vec<u8>, Problem> {
    let source = Source::open(&slice.path, "file")?;
    let len = source.len;
    if let Some(frame) = &slice.frame {
        return pixels_of(slice, File::of_frame(source, frame)?, len, number);
    }
    let file = File::open(source)?;
    if Slice::from_file(&slice.path, &file)?.format != slice.format {
        return Err(Problem::malformed("file", "changed while it was read", "try again"));
    }
    pixels_of(slice, file, len, number)
}

/// Returns the samples of a file, for the mutants of `fuzz.rs`.
#[cfg(test)]
pub(crate) fn one_slice(source: Source) -> Result<Vec<u8>, Problem> {
    let len = source.len;
    let mut file = File::open(source)?;
    let slice = slices(Path::new("slice"), &mut file)?.swap_remove(0);
    pixels_of(&slice, file, len, Number::F32)
}

/// Returns the samples of an open file of `len` bytes, like [`pixels`].
fn pixels_of(slice: &Slice, mut file: File, len: u64, number: Number) -> Result<Vec<u8>, Problem> {
    let format = slice.format;
    let size = usize::from(format.allocated / 8);
    let count = usize::from(format.columns) * usize::from(format.rows);
    let bytes = match file.pixels {
        Pixels::Packed(Packing::Rle) => rle::unpack(&mut *file.rest, count, size)?,
        Pixels::Packed(packing) => {
            let most = jpeg::fragments_max_bytes(count * size);
            let fragment = fragments::read(&mut *file.rest, most)?;
            let sizes = (format.columns, format.rows);
            match packing {
                Packing::JpegLs => jpeg_ls::unpack(&fragment, sizes, size)?,
                Packing::Jpeg2000 => jpeg2000::unpack(fragment, sizes, size, format.signed)?,
                _ => jpeg::unpack(&fragment, sizes, size)?,
            }
        }
        Pixels::Native { bytes: have, words } => {
            let need = (count * size) as u64;
            slice.padding_bytes()?;
            if need / 1032 > len {
                return Err(crate::samples::truncated(need, len));
            }
            // Bytes in words of 16 bits come in pairs, the last with padding.
            let turned = size == 1 && words && file.endian == Endian::Big;
            let stored = if turned { have.min(need + need % 2) } else { need };
            let mut bytes = Vec::new();
            file.rest
                .take(stored)
                .read_to_end(&mut bytes)
                .map_err(|e| Problem::io("PixelData", &e))?;
            if bytes.len() as u64 != stored {
                return Err(crate::samples::truncated(stored, bytes.len() as u64));
            }
            if turned {
                bytes.chunks_exact_mut(2).for_each(<[u8]>::reverse);
                bytes.truncate(need as usize);
            } else if file.endian == Endian::Big {
                bytes.chunks_exact_mut(size).for_each(<[u8]>::reverse);
            }
            bytes
        }
    };
    let whole = format.stored == format.allocated && format.high + 1 == format.allocated;
    if whole && number == common_number(std::iter::once(format)) {
        return Ok(bytes);
    }
    // Bits outside the stored ones may hold anything, such as old overlays.
    let lift = 32 - u32::from(format.high) - 1;
    let drop = 32 - u32::from(format.stored);
    let value = |word: &[u8]| -> i64 {
        let mut wide = [0; 4];
        wide[..size].copy_from_slice(word);
        let raised = u32::from_le_bytes(wide) << lift;
        match format.signed {
            true => (raised as i32 >> drop).into(),
            false => (raised >> drop).into(),
        }
    };
    let [slope, intercept] = slice.rescale;
    let words = bytes.chunks_exact(size).map(value);
    let bytes = number.bytes() as usize;
    Ok(match number == Number::F32 {
        true => words.flat_map(|v| ((v as f64 * slope + intercept) as f32).to_le_bytes()).collect(),
        false => words.flat_map(|v| v.to_le_bytes().into_iter().take(bytes)).collect(),
    })
}
