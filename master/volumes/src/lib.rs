//! Reads volume files and cuts volumes into bricks.
//!
//! [`open`] reads a file into a [`Volume`] or computes one from a formula. [`BrickStore::build`]
//! cuts a volume into the bricks that a transfer function can see (paper section 4.2). Each brick
//! is encoded once, and every worker is sent those bytes.
//!
//! ```
//! use slabcast_common::quality::Quality;
//! use slabcast_scene::{brick_needs::BrickNeeds, presets};
//! use slabcast_volumes::{BrickStore, open};
//!
//! let volume = open("formula:spheres:32".as_ref()).expect("a formula of this name");
//! let digest = volume.digest();
//! let transfer = presets::by_name("peer-opaque", &volume.summary).expect("a preset");
//! let needs = BrickNeeds::for_transfer(&transfer, &volume.info(digest), &Quality::default());
//! let store = BrickStore::build(&volume, digest, &needs);
//! let first = store.infos()[0];
//! assert_eq!(store.encoded(first.id).expect("its bytes").len(), first.bytes as usize);
//! ```
//!
//! Formats read (docs/reference/files.md lists the variants of each):
//!
//! - NRRD: `.nrrd`, and `.nhdr` with its data files
//! - MetaImage: `.mha`, and `.mhd` with its data files
//! - NIfTI-1 and NIfTI-2 in one file: `.nii`, `.nii.gz`; pairs of NIfTI and ANALYZE 7.5: `.hdr` with `.img`
//! - FreeSurfer: `.mgh`, `.mgz`
//! - MRC and CCP4 maps: `.mrc`, `.map`, `.ccp4`, `.rec`, `.st`
//! - NumPy: `.npy`, and one array of an `.npz`
//! - VTK image data in XML: `.vti`; legacy VTK structured points: `.vtk`
//! - HDF5: one dataset (`.h5`, `.hdf5`), Imaris (`.ims`), MINC 2 (`.mnc`), NetCDF-4 (`.nc`) and VTKHDF
//!   (`.vtkhdf`; feature `hdf5`)
//! - TIFF: the pages of one file (`.tif`, `.tiff`), or a folder of single pages
//! - PNG, JPEG: a folder of pictures
//! - raw numbers (`.raw`), with size and type from flags or from the file's name
//! - DICOM series, one folder of slices (`.dcm`, `.ima`; feature `dicom`)
//! - Zarr arrays of versions 2 and 3, and OME-Zarr pyramids (feature `zarr`)
//! - volumes by formula: `formula:NAME`
//!
//! [`write`](mod@write) writes NRRD and NIfTI-1. [`blocks`] reads and writes volumes larger than
//! memory. Not read: time series.
//!
//! Input files are not trusted. A size in a header takes no memory before the bytes were seen;
//! nothing outside the header's folder is read; every refusal is one line that names the file, the
//! field and the remedy (docs/design/promises.md R13 to R15; the mutants in `fuzz.rs` test it).
//!
//! This crate has no network, no clock, and knows neither tasks, views nor colours. It does use
//! threads, since cutting bricks is work for all cores.

pub mod auto_level;
pub mod blocks;
mod colours;
#[cfg(any(feature = "dicom", feature = "hdf5"))]
mod confined;
mod data;
#[cfg(feature = "dicom")]
pub mod dicom;
mod error;
mod folder;
mod format;
pub mod formula;
pub mod framing;
#[cfg(test)]
mod fuzz;
#[cfg(feature = "hdf5")]
pub mod hdf5;
mod limit;
mod members;
mod metaimage;
mod mgh;
mod mrc;
mod nifti;
mod npy;
mod nrrd;
mod numbers;
#[cfg(test)]
mod phantom;
mod pick;
mod pictures;
mod plain;
mod prefilter;
mod raw;
mod reads;
mod samples;
mod sketch;
mod source;
pub mod store;
mod stream;
mod tiff_stack;
mod units;
mod unpack;
mod unread;
mod vti;
mod vtk;
mod wide;
pub mod write;
#[cfg(feature = "zarr")]
mod zarr;

pub use error::{OpenError, OpenErrorKind, Problem};
pub use numbers::{Beside, FileNumbers};
pub use pick::Pick;
pub use raw::RawHints;
pub use reads::{DETACHED_HEADERS, FORMATS, Flag, ReadFormat, endings, takers};
pub use sketch::histogram_sketch;
pub use store::BrickStore;

use format::Format;
use limit::ByteCap;
use slabcast_common::volume::Volume;
use source::{Folder, Inside, Source};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Hints for opening a volume: what its files do not say, and limits. All are optional.
#[derive(Clone, Debug, Default)]
pub struct Hints {
    /// Size, type and spacing of files without a header; the spacing also serves TIFF stacks.
    pub raw: RawHints,
    /// The DICOM series to read where a folder holds several: its number, description, name or UID.
    pub series: Option<String>,
    /// Program and first arguments of the process that parses DICOM by calling `dicom::serve`.
    /// `None` parses in a thread of this process, without limits on memory and time.
    pub dicom_reader: Option<Vec<std::ffi::OsString>>,
    /// Program and first arguments of the process that parses HDF5 by calling `hdf5::serve`. `None`
    /// parses in a thread of this process, without limits on memory and time.
    pub hdf5_reader: Option<Vec<std::ffi::OsString>>,
    /// The array to read where a file holds several (`.npz`, `.vti`, `.vtk`, HDF5), by its name or path.
    pub dataset: Option<String>,
    /// Level of a Zarr pyramid, 0 the finest. `None` takes the finest that fits `max_bytes`, or a
    /// quarter of the free memory.
    pub level: Option<u32>,
    /// Most bytes that the samples may have, in the file's type. `None` allows 1 GiB or 64 times
    /// the file's bytes, whichever is more, within three quarters of the free memory.
    pub max_bytes: Option<u64>,
    /// Which volume of a file with several; the first by default.
    pub pick: Pick,
    /// Side results of reading, filled by the reader. Each opening needs a fresh default.
    pub beside: Beside,
}

impl Hints {
    fn cap(&self) -> ByteCap {
        ByteCap { asked: self.max_bytes, beside: self.beside.clone() }
    }
}

/// A volume and the reader's notes on how it was read.
#[derive(Clone, Debug)]
pub struct Opened {
    /// Volume that was read from the file.
    pub volume: Volume,
    /// Choices that the reader made, one sentence each, to show to the user.
    pub notes: Vec<String>,
}

/// Opens a volume: a file or folder, or `formula:NAME[:SIZE]` (see [`formula`]). The content of a
/// file decides its format, not its name.
///
/// # Errors
/// The file can't be read, is not a volume, is malformed, truncated or damaged, has an unsupported
/// format, points outside its folder, or exceeds a limit or the memory. The error's
/// [`kind`](Problem::kind) distinguishes these.
pub fn open(path: &Path) -> Result<Volume, OpenError> {
    open_with(path, &Hints::default()).map(|opened| opened.volume)
}

/// Opens a volume with hints; returns the reader's notes with it. Without hints it is the volume
/// that [`open`] returns.
///
/// # Errors
/// The volume can't be opened ([`open`]), or hints contradict the file: a type or spacing for a
/// file with a header, an unknown series or level, sizes that do not match the file's length.
pub fn open_with(path: &Path, hints: &Hints) -> Result<Opened, OpenError> {
    open_beside(path, &Hints { beside: Beside::new(false), ..hints.clone() })
}

/// Opens a volume that will be written in another format. Also returns the file's own numbers if
/// the volume's codes round them (integers of 32 and 64 bits, float64). These take up to 8 bytes a
/// sample beside the volume.
///
/// # Errors
/// The volume can't be opened, or hints contradict the file ([`open_with`]).
pub fn open_numbers(
    path: &Path,
    hints: &Hints,
) -> Result<(Opened, Option<FileNumbers>), OpenError> {
    let hints = Hints { beside: Beside::new(true), ..hints.clone() };
    let opened = open_beside(path, &hints)?;
    Ok((opened, hints.beside.take_numbers()))
}

fn open_beside(path: &Path, hints: &Hints) -> Result<Opened, OpenError> {
    let shown = path.to_string_lossy();
    let opened = match shown.strip_prefix(formula::PREFIX) {
        Some(_) => {
            hints.check_flags(reads::FORMULA).and_then(|()| formula::open(&shown)).map(Opened::from)
        }
        None => open_file(path, hints)
            .or_else(|refusal| colours::instead(refusal, path, hints, &open_file)),
    };
    let mut opened = opened.map_err(|problem| OpenError { file: shown.into_owned(), problem })?;
    opened.notes.extend(hints.beside.take_notes());
    opened.notes.extend(flat_note(&opened.volume));
    Ok(opened)
}

/// Returns the note on a volume of one slice, which is a 2-D picture; `None` for any other.
fn flat_note(volume: &Volume) -> Option<String> {
    let dims = volume.lattice.dims;
    let thick: Vec<u32> = dims.into_iter().filter(|n| *n > 1).collect();
    match thick[..] {
        [width, height] => Some(format!(
            "it is one slice, a 2-D picture of {width} x {height}, and drawn flat; for a volume {}",
            error::FLAT_REMEDY
        )),
        _ => None,
    }
}

impl From<Volume> for Opened {
    fn from(volume: Volume) -> Self {
        Opened { volume, notes: Vec::new() }
    }
}

fn open_file(path: &Path, hints: &Hints) -> Result<Opened, Problem> {
    if path.is_dir() {
        return folder::open(path, hints);
    }
    #[cfg_attr(
        not(any(feature = "dicom", feature = "hdf5")),
        expect(unused_mut, reason = "only the checks for DICOM and HDF5 read the head")
    )]
    let mut source = Source { cap: hints.cap(), ..Source::open(path, "file")? };
    #[cfg(feature = "dicom")]
    if dicom::sniff(source.head()?) && hints.raw.dims.is_none() {
        return folder::open_series_of(path, hints);
    }
    #[cfg(feature = "hdf5")]
    if hdf5::sniff(source.head()?) && hints.raw.dims.is_none() {
        return hdf5::open(path, hints);
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let folder = path.parent().unwrap_or(Path::new("."));
    let notes = source.notes.clone();
    let error = match read_noted(source, folder, &name, hints) {
        Ok(mut opened) => {
            opened.notes.extend(notes.take());
            return Ok(opened);
        }
        Err(e) => e,
    };
    // A data file with a header beside it is opened through the header.
    if error.kind == OpenErrorKind::NotAVolume
        && let Some(header) = header_beside(path)
    {
        let source = Source { cap: hints.cap(), ..Source::open(&header, "file")? };
        let notes = source.notes.clone();
        let header_name = header.file_name().unwrap_or_default().to_string_lossy();
        let volume = read(source, folder, &header_name, hints).map_err(|mut p| {
            p.field = format!("its header {}: {}", error::quoted(&header_name), p.field);
            p
        })?;
        let note = format!("{name} is raw data; its header {header_name} beside it was read");
        let notes = std::iter::once(note).chain(notes.take()).collect();
        return Ok(Opened { volume, notes });
    }
    Err(error)
}

/// Returns the header beside a data file: the header of a pair, or one of the same stem that names
/// the data file.
fn header_beside(path: &Path) -> Option<PathBuf> {
    let name = path.file_name()?.to_str()?;
    let folder = Folder::open(path.parent()?, "file").ok()?;
    let pair = nifti::pair::header_names(name).into_iter().find_map(|header| {
        let Ok(Inside::File(..)) = folder.find(Path::new(&header)) else { return None };
        let mut source = Source::open(&path.with_file_name(&header), "file").ok()?;
        let head = source.head().ok()?;
        let start = if head.starts_with(GZIP) { unpacked(head) } else { head.to_vec() };
        nifti::pair::sniff(&start).then(|| path.with_file_name(header))
    });
    if pair.is_some() {
        return pair;
    }
    let stem = name.split('.').next().filter(|stem| !stem.is_empty())?;
    ["mhd", "nhdr"].iter().find_map(|end| {
        let header = path.with_file_name(format!("{stem}.{end}"));
        // A link out of the folder may be anything.
        let Ok(Inside::File(..)) = folder.find(Path::new(header.file_name()?)) else { return None };
        let mut source = Source::open(&header, "file").ok()?;
        let head = source.head().ok()?;
        let names = head.windows(name.len()).any(|w| w == name.as_bytes());
        (header != path && names).then_some(header)
    })
}

/// Reads a volume with its reader's notes. TIFF alone has some.
fn read_noted(
    mut source: Source,
    folder: &Path,
    name: &str,
    hints: &Hints,
) -> Result<Opened, Problem> {
    if tiff_stack::sniff(source.head()?) && hints.raw.dims.is_none() {
        hints.check_flags(reads::TIFF)?;
        source.pick = hints.pick;
        return tiff_stack::read(source, name, &hints.raw);
    }
    read(source, folder, name, hints).map(Opened::from)
}

/// Reads a volume; its first bytes decide the format. `folder` is where detached data may lie.
fn read(mut source: Source, folder: &Path, name: &str, hints: &Hints) -> Result<Volume, Problem> {
    source.pick = hints.pick;
    let head = source.head()?;
    if head.is_empty() {
        return Err(Problem::new(
            OpenErrorKind::NotAVolume,
            "content",
            "is empty",
            reads::remedy(),
        ));
    }
    // With --dims the file is raw numbers, whatever its content looks like.
    if hints.raw.dims.is_some() {
        let gzip = head.starts_with(GZIP);
        hints.check_flags(reads::RAW)?;
        hints.pick.choose(&[], "content")?;
        return raw::read(source, gzip, name, &hints.raw);
    }
    let gzip = head.starts_with(GZIP);
    if let Some(format) = Format::of(&if gzip { unpacked(head) } else { head.to_vec() }, gzip) {
        return format.read(source, gzip, folder, name, hints);
    }
    if head.starts_with(nrrd::MAGIC) {
        hints.check_flags(reads::NRRD)?;
        return nrrd::read(source, folder, name);
    }
    if gzip {
        let start = unpacked(head);
        if nifti::sniff(&start) {
            hints.check_flags(reads::NIFTI)?;
            return nifti::read(source, true, name);
        }
        if start.starts_with(nrrd::MAGIC) {
            return Err(Problem::unsupported(
                "content",
                "is an NRRD file inside gzip",
                "unpack it with gunzip (`encoding: gzip` inside an NRRD is read)",
            ));
        }
        if raw::is_described(name, &hints.raw) {
            hints.check_flags(reads::RAW)?;
            return raw::read(source, true, name, &hints.raw);
        }
        return Err(unread::problem(&start, true, name).unwrap_or_else(|| {
            let what = "is gzip, but not around a volume that we know";
            Problem::new(OpenErrorKind::NotAVolume, "content", what, reads::remedy())
        }));
    }
    if nifti::sniff(head) {
        hints.check_flags(reads::NIFTI)?;
        return nifti::read(source, false, name);
    }
    if metaimage::sniff(head) {
        hints.check_flags(reads::METAIMAGE)?;
        return metaimage::read(source, folder, name);
    }
    if vti::sniff(head) {
        hints.check_flags(reads::VTI)?;
        return vti::read(source, name, hints.dataset.as_deref());
    }
    if tiff_stack::sniff(head) {
        hints.check_flags(reads::TIFF)?;
        return tiff_stack::read(source, name, &hints.raw).map(|opened| opened.volume);
    }
    let described = raw::is_described(name, &hints.raw);
    if !described && let Some(problem) = unread::problem(head, false, name) {
        return Err(problem);
    }
    if described || is_raw(name) {
        hints.check_flags(reads::RAW)?;
        return raw::read(source, false, name, &hints.raw);
    }
    Err(Problem::new(OpenErrorKind::NotAVolume, "content", describe(head, name), reads::remedy()))
}

/// Decompresses the first bytes of a gzip file that begins with `head`.
fn unpacked(head: &[u8]) -> Vec<u8> {
    let mut start = Vec::new();
    // The reader reports an early end or damage.
    let _ = flate2::read::MultiGzDecoder::new(head).take(START_BYTES).read_to_end(&mut start);
    start
}

/// Bytes that tell a format: a header of MRC has 1024.
const START_BYTES: u64 = 2048;

/// First bytes of a gzip stream.
const GZIP: &[u8] = &[0x1f, 0x8b];

/// Returns whether a file name has an ending used for raw numbers.
fn is_raw(name: &str) -> bool {
    let name = name.to_ascii_lowercase();
    [".raw", ".zraw", ".img", ".dat", ".bin"].iter().any(|end| name.ends_with(end))
}

/// Describes a file of no readable format, by its first bytes and its name.
fn describe(head: &[u8], name: &str) -> String {
    let ends = |e: &str| name.to_ascii_lowercase().ends_with(e);
    let what = if head.get(128..132) == Some(b"DICM") || ends(".dcm") {
        "is DICOM, which this build does not read (feature `dicom`)"
    } else if head.starts_with(b"\x89HDF") {
        "is HDF5, which this build does not read (feature `hdf5`)"
    } else if ends(".mhd") || ends(".mha") {
        "does not begin with a MetaImage header, so it is damaged or something else"
    } else if head.starts_with(b"<?xml") || ends(".vti") {
        "is XML, but not of VTK"
    } else if ends(".nrrd") || ends(".nhdr") {
        "does not begin with `NRRD`, so it is damaged or something else"
    } else if ends(".nii") || ends(".nii.gz") {
        "does not begin with a NIfTI header, so it is damaged or something else"
    } else if head.iter().take(512).all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace()) {
        "is text, not a volume"
    } else {
        "is not a volume that we know"
    };
    what.to_string()
}
