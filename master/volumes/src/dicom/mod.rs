//! Reader of DICOM series: a folder of slices, sorted by position, becomes one volume.
//!
//! Files are not trusted, so a process of its own parses them ([`serve`]). It confines itself to
//! reading their folder, and sends the series and its samples through a pipe (`confined`). The
//! caller names the program ([`crate::Hints::dicom_reader`]); without one a thread parses them,
//! unconfined.

mod elements;
mod fragments;
mod frames;
mod gaps;
mod jpeg;
mod jpeg2000;
mod jpeg_ls;
mod rle;
mod series;

pub(crate) use elements::sniff;
#[cfg(test)]
pub(crate) use frames::tests::enhanced;
#[cfg(test)]
pub(crate) use jpeg_ls::tests::{encoded_pictures, one_jpeg_ls};
#[cfg(test)]
pub(crate) use jpeg2000::tests::{ENCODED as JPEG_2000, one_jpeg_2000};
#[cfg(test)]
pub(crate) use series::one_slice;

use crate::confined::{self, Parser};
use crate::error::Problem;
use crate::pick::Pick;
use crate::{Hints, Opened};
use series::SeriesChoice;
use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Most bytes of samples per byte of a file: a row of 2048 numbers of 16 bits takes a bit in JPEG-LS, and
/// a file has a header.
const PACKED_RATIO: u64 = 8192;

/// Opens one series of these files, which are all DICOM and in `folder`. The hints name it, the
/// command that parses, and the limit; `file` is a slice of it.
pub(crate) fn open(
    files: &[PathBuf],
    folder: &Path,
    hints: &Hints,
    file: Option<&Path>,
) -> Result<Opened, Problem> {
    let series = hints.series.as_deref();
    let mut arguments: Vec<OsString> = vec![folder.into()];
    if let Some(series) = series {
        arguments.extend(["--series".into(), series.into()]);
    }
    if let Some(file) = file {
        arguments.extend(["--file".into(), file.into()]);
    }
    arguments.extend(confined::pick_arguments(hints.pick));
    let parser = Parser {
        name: "DICOM",
        samples: "slices",
        rescale: "RescaleSlope",
        remedies: ["convert the series, for instance with dcm2niix", "get the series again"],
        program: hints.dicom_reader.as_deref(),
        arguments,
        stored: files.iter().filter_map(|f| f.metadata().ok()).map(|m| m.len()).sum(),
        ratio: PACKED_RATIO,
        cap: hints.cap(),
    };
    parser.run(|out| {
        write_series(files, &SeriesChoice { series, file, pick: hints.pick }, Vec::new(), out)
    })
}

/// Writes the chosen series, or the problem that prevents it.
fn write_series(
    files: &[PathBuf],
    choice: &SeriesChoice<'_>,
    notes: Vec<String>,
    out: &mut dyn Write,
) -> std::io::Result<()> {
    confined::write_or_problem(out, |out| series::write(files, choice, notes, out))
}

/// Parses a folder of DICOM files in the process started for it ([`crate::Hints::dicom_reader`])
/// and writes one series, or the problem that prevents it, to `out`.
///
/// `series` names the series (its number, description, name or UID); `file` is a slice whose series
/// is meant, and `pick` one of its times. First the process confines itself for good, where the system allows it: 512 MiB of
/// memory, 120 s of processor time, the files of the folder to read, nothing to write but `out`, no
/// network and no other process. What the system did not allow goes with the series as a note.
///
/// # Errors
/// Reading fails after the first samples were written, or `out` can't be written. The process must
/// then print the error to stderr and exit with a failure.
pub fn serve(
    folder: &Path,
    series: Option<&str>,
    file: Option<&Path>,
    pick: Pick,
    out: &mut dyn Write,
) -> std::io::Result<()> {
    let notes = confined::confine(folder, "DICOM");
    match crate::folder::dicom_files(folder) {
        Ok(files) => write_series(&files, &SeriesChoice { series, file, pick }, notes, out),
        Err(problem) => confined::wire::write_problem(&problem, out),
    }
}

#[cfg(test)]
pub(crate) mod tests;
