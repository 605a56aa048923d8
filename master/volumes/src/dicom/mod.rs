//! Reader of DICOM series: a folder of slices, sorted by position, becomes one volume.
//!
//! Files are not trusted, so a process of its own parses them ([`serve`]). It confines itself to
//! reading their folder (`confine`), is killed when it takes too long (`watch`), and sends the series
//! and its samples through a pipe. The caller names the program
//! ([`crate::Hints::dicom_reader`]); without one a thread parses them, unconfined.

mod confine;
mod elements;
mod fragments;
mod frames;
mod gaps;
mod jpeg;
mod jpeg2000;
mod jpeg_ls;
mod rle;
mod series;
mod watch;
mod wire;

pub(crate) use elements::sniff;
#[cfg(test)]
pub(crate) use frames::tests::enhanced;
#[cfg(test)]
pub(crate) use jpeg_ls::tests::{encoded_pictures, one_jpeg_ls};
#[cfg(test)]
pub(crate) use jpeg2000::tests::{ENCODED as JPEG_2000, one_jpeg_2000};
#[cfg(test)]
pub(crate) use series::one_slice;

use crate::error::{OpenErrorKind, Problem};
use crate::limit::ByteCap;
use crate::pick::Pick;
use crate::samples::{self, Endian, Layout, Supply};
use crate::{Hints, Opened};
use confine::{CPU_SECS, MEMORY_BYTES};
use series::SeriesChoice;
use slabcast_common::volume::{ValueMap, Volume};
use std::io::{BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;
use watch::Watched;
use wire::Preface;

/// Bytes of files that the parsing process must get through in a second, by the wall clock: slow for
/// a network disk, and more than a process that only waits.
const BYTES_A_SECOND: u64 = 4 << 20;

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
    let stored = files.iter().filter_map(|f| f.metadata().ok()).map(|m| m.len()).sum();
    let bytes = (stored, hints.cap());
    let Some(program) = &hints.dicom_reader else {
        let (receiver, mut sender) = std::io::pipe().map_err(|e| Problem::io("pipe", &e))?;
        return std::thread::scope(|scope| {
            scope.spawn(move || {
                // The receiver reports a panic, since the pipe then ends before the series.
                let _ = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                    // A receiver that is gone has failed on its own.
                    let choice = SeriesChoice { series, file, pick: hints.pick };
                    let _ = write_series(files, &choice, Vec::new(), &mut sender);
                }));
            });
            read_series(receiver, bytes).unwrap_or_else(|| Err(reader_failed("it panicked")))
        });
    };
    let [name, args @ ..] = &program[..] else { return Err(reader_failed("it has no name")) };
    let mut command = Command::new(name);
    command.args(args).arg(folder);
    if let Some(series) = series {
        command.arg("--series").arg(series);
    }
    if let Some(file) = file {
        command.arg("--file").arg(file);
    }
    let Pick { volume, time, channel } = hints.pick;
    for (flag, index) in [("--volume", volume), ("--time", time), ("--channel", channel)] {
        if let Some(index) = index {
            command.arg(flag).arg(index.to_string());
        }
    }
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let (mut child, stdout, stderr) = Watched::start(&mut command, wall_limit(stored))
        .map_err(|e| reader_failed(&format!("it could not be started: {e}")))?;
    let result = match read_series(stdout, bytes) {
        // Samples that end early, or nothing at all: the exit status says more.
        Some(Err(problem)) if problem.kind == OpenErrorKind::Damaged => Some(problem),
        Some(result) => return result,
        None => None,
    };
    // The process has ended, or ends now that the pipe is closed.
    let mut message = String::new();
    let _ = stderr.take(STDERR_MAX_BYTES).read_to_string(&mut message);
    match (result, child.end()) {
        (Some(problem), Ok(status)) if status.success() => Err(problem),
        (_, Ok(_)) if child.is_late() => {
            Err(reader_failed(&format!("it took more than {} s", wall_limit(stored).as_secs())))
        }
        (_, Ok(status)) => Err(reader_failed(&format!("{status} {}", message.trim()))),
        (_, Err(e)) => Err(reader_failed(&e.to_string())),
    }
}

/// Returns how long files of `bytes` bytes may take, by the wall clock.
fn wall_limit(bytes: u64) -> Duration {
    Duration::from_secs(CPU_SECS + bytes / BYTES_A_SECOND)
}

/// Most bytes taken of the parsing process's error message.
const STDERR_MAX_BYTES: u64 = 300;

/// Returns the error for a parsing process that failed; `how` it ended.
fn reader_failed(how: &str) -> Problem {
    Problem::new(
        OpenErrorKind::TooLarge,
        "DICOM",
        format!(
            "the process that parses it, with {} MiB and {CPU_SECS} s at most, ended before it was \
             done ({how})",
            MEMORY_BYTES >> 20
        ),
        "convert the series, for instance with dcm2niix",
    )
}

/// Reads a series from the pipe, of files of so many bytes together and within a limit; `None` if
/// nothing valid came.
fn read_series(pipe: impl Read + Send, bytes: (u64, ByteCap)) -> Option<Result<Opened, Problem>> {
    let mut pipe = BufReader::with_capacity(128 << 10, pipe);
    let preface = match Preface::read(&mut pipe)? {
        Ok(preface) => preface,
        Err(problem) => return Some(Err(problem)),
    };
    Some(read_volume(preface, &mut pipe, bytes))
}

/// Reads the samples after a preface and makes the volume.
fn read_volume(
    preface: Preface,
    pipe: &mut (dyn Read + Send),
    (bytes, cap): (u64, ByteCap),
) -> Result<Opened, Problem> {
    let Preface { name, number, lattice, anatomical, rescale: [slope, intercept], notes, .. } =
        preface;
    let layout = Layout::new(lattice.dims.map(u64::from), number, Endian::Little, "slices")?;
    lattice.check().map_err(|e| Problem::malformed("slices", e, "get the series again"))?;
    let supply = Supply::Encoded { name: "DICOM", bytes, ratio: PACKED_RATIO };
    let beside = cap.beside.clone();
    if let Some(stream) = beside.stream() {
        return Err(stream.refuse());
    }
    let (samples, stored) = samples::read(pipe, supply, &layout, cap).map_err(|mut p| {
        p.field = "slices".into();
        p
    })?;
    beside.rescale(ValueMap { scale: slope, offset: intercept });
    let map = ValueMap { scale: slope * stored.scale, offset: slope * stored.offset + intercept };
    let volume = Volume::new(name, number.name(), anatomical, lattice, samples, map);
    let (lo, hi) = volume.summary.range();
    if !(lo.is_finite() && hi.is_finite() && map.scale.is_normal()) {
        return Err(Problem::malformed(
            "RescaleSlope",
            format!("{slope:?} takes the values out of the range of numbers"),
            "get the series again",
        ));
    }
    Ok(Opened { volume, notes })
}

/// Writes the chosen series, or the problem that prevents it.
fn write_series(
    files: &[PathBuf],
    choice: &SeriesChoice<'_>,
    notes: Vec<String>,
    out: &mut dyn Write,
) -> std::io::Result<()> {
    // After the first byte a problem can't be written any more; the reader sees an early end.
    let mut out = WriteTracker { out, started: false };
    match series::write(files, choice, notes, &mut out) {
        Err(problem) if !out.started => wire::write_problem(&problem, out.out),
        Err(problem) => Err(std::io::Error::other(problem)),
        Ok(()) => Ok(()),
    }
}

/// Remembers whether anything was written.
struct WriteTracker<'a> {
    out: &'a mut dyn Write,
    started: bool,
}

impl Write for WriteTracker<'_> {
    fn write(&mut self, buf: &[u8]) -> std::io::Result<usize> {
        self.started = true;
        self.out.write(buf)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.out.flush()
    }
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
    let notes = confine::confine(folder);
    match crate::folder::dicom_files(folder) {
        Ok(files) => write_series(&files, &SeriesChoice { series, file, pick }, notes, out),
        Err(problem) => wire::write_problem(&problem, out),
    }
}

#[cfg(test)]
pub(crate) mod tests;
