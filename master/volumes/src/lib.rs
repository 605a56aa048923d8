//! Files in, bricks out.
//!
//! [`open`] reads a file into a [`Volume`] (or makes one by formula), and [`BrickStore::build`]
//! cuts a volume into the bricks that a transfer function can see (paper section 4.2). Each
//! brick is encoded once, and every worker is sent the same bytes.
//!
//! Files are strangers: no size in a header is believed before the bytes were seen, nothing
//! outside the header's folder is read, and every refusal is one line that names the file, the
//! field and the remedy (PROMISES R13 to R15; the mutants in `fuzz.rs` keep it so).
//!
//! This crate refuses to know the network, tasks, views and colours. The clock is not here
//! either; threads are, since cutting bricks is work for all cores.
//!
//! Read: NRRD attached and detached, raw and gzip; NIfTI-1 and -2, plain and gzip. Out of scope
//! so far: MetaImage, VTI, DICOM, headerless raw, ASCII and bzip2 NRRD, NIfTI pairs, colours,
//! time series, and volumes that are larger than memory.

mod error;
pub mod formula;
#[cfg(test)]
mod fuzz;
mod nifti;
mod nrrd;
mod samples;
mod sketch;
mod source;
mod store;

pub use error::{OpenError, OpenErrorKind, Problem};
pub use sketch::histogram_sketch;
pub use store::BrickStore;

use slabcast_common::volume::Volume;
use source::Source;
use std::io::Read;
use std::path::Path;

/// What this version reads, for remedies.
const READS: &str = "give an NRRD (.nrrd, .nhdr) or NIfTI (.nii, .nii.gz) file";

/// Opens a volume: a file, told by its content rather than its name, or `formula:NAME[:SIZE]`.
pub fn open(path: &Path) -> Result<Volume, OpenError> {
    let shown = path.to_string_lossy();
    let volume = match shown.strip_prefix(formula::PREFIX) {
        Some(_) => formula::open(&shown),
        None => open_file(path),
    };
    volume.map_err(|problem| OpenError { file: shown.into_owned(), problem })
}

fn open_file(path: &Path) -> Result<Volume, Problem> {
    let source = Source::open(path, "file")?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let folder = path.parent().unwrap_or(Path::new("."));
    read(source, folder, &name)
}

/// Reads a volume from a source, by content.
fn read(mut source: Source, folder: &Path, name: &str) -> Result<Volume, Problem> {
    let head = source.head()?;
    if head.is_empty() {
        return Err(Problem::new(OpenErrorKind::NotAVolume, "content", "is empty", READS));
    }
    if head.starts_with(nrrd::MAGIC) {
        return nrrd::read(source, folder, name);
    }
    if head.starts_with(&[0x1f, 0x8b]) {
        let mut start = Vec::new();
        // An early end or damage inside the first bytes is the reader's to report.
        let _ = flate2::read::MultiGzDecoder::new(head).take(4).read_to_end(&mut start);
        if nifti::sniff(&start) {
            return nifti::read(source, true, name);
        }
        if start.starts_with(nrrd::MAGIC) {
            return Err(Problem::unsupported(
                "content",
                "is an NRRD file inside gzip",
                "unpack it with gunzip (`encoding: gzip` inside an NRRD is read)",
            ));
        }
        return Err(Problem::new(
            OpenErrorKind::NotAVolume,
            "content",
            "is gzip, but not NIfTI",
            READS,
        ));
    }
    if nifti::sniff(head) {
        return nifti::read(source, false, name);
    }
    Err(Problem::new(OpenErrorKind::NotAVolume, "content", describe(head, name), READS))
}

/// What a file that we can't read seems to be.
fn describe(head: &[u8], name: &str) -> String {
    let is = |magic: &[u8]| head.starts_with(magic);
    let ends = |e: &str| name.to_ascii_lowercase().ends_with(e);
    let what = if is(b"\x89PNG") || is(b"\xff\xd8\xff") || is(b"GIF8") || is(b"BM") {
        "is a picture, not a volume"
    } else if head.get(128..132) == Some(b"DICM") || ends(".dcm") {
        "is DICOM, which this version does not read"
    } else if is(b"ObjectType") || is(b"NDims") || ends(".mhd") || ends(".mha") {
        "is MetaImage, which this version does not read"
    } else if is(b"<?xml") || is(b"<VTKFile") || is(b"# vtk") || ends(".vti") {
        "is VTK or XML, which this version does not read"
    } else if is(b"II*\0") || is(b"MM\0*") {
        "is TIFF, which this version does not read"
    } else if is(b"\x89HDF") {
        "is HDF5, which this version does not read"
    } else if is(b"BZh") || is(b"PK\x03\x04") || is(b"\x28\xb5\x2f\xfd") || is(b"\xfd7zXZ") {
        "is packed; unpack it first"
    } else if ends(".raw") {
        "is raw numbers without a header: write a .nhdr file beside it that names it"
    } else if ends(".nrrd") || ends(".nhdr") {
        "does not begin with `NRRD`, so it is damaged or something else"
    } else if ends(".nii") || ends(".nii.gz") {
        "does not begin with a NIfTI header, so it is damaged or something else"
    } else if head.iter().take(512).all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace()) {
        "is text, not a volume"
    } else {
        "is no volume that we know"
    };
    what.to_string()
}
