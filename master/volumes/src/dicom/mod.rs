//! Reader of DICOM series: a folder of slices, sorted by position, becomes one volume.
//!
//! Files are not trusted, so a process of its own parses them ([`serve`]). It may take 512 MiB and
//! 120 s of processor time, may write no file, and sends the series and its samples through a pipe.
//! The caller names the program ([`crate::Hints::dicom_reader`]); without one a thread parses them,
//! unconfined.

mod elements;
mod rle;
mod series;
mod wire;

pub(crate) use elements::sniff;
#[cfg(test)]
pub(crate) use series::one_slice;

use crate::error::{OpenErrorKind, Problem};
use crate::limit::ByteCap;
use crate::samples::{self, Endian, Layout, Supply};
use crate::{Hints, Opened};
use series::SeriesChoice;
use slabcast_common::volume::{ValueMap, Volume};
use std::io::{BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use wire::Preface;

/// Memory limit of the parsing process. A slice of 16384 x 16384 pixels of 16 bits (512 MiB) is
/// refused; one of 8192 x 8192 passes, compressed or not.
const CHILD_MEMORY_BYTES: u64 = 512 << 20;

/// Processor time limit of the parsing process: 16384 slices of 512 x 512 take some 10 s.
const CHILD_CPU_SECS: u64 = 120;

/// Most bytes of samples per byte of a file: two bytes of RLE decode to at most 128.
const RLE_RATIO: u64 = 64;

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
                    let _ = write_series(files, &SeriesChoice { series, file }, &mut sender);
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
    let child = command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|e| reader_failed(&format!("it could not be started: {e}")))?;
    let mut child = KillOnDrop(child);
    let Some(receiver) = child.0.stdout.take() else { return Err(reader_failed("it has no pipe")) };
    let result = match read_series(receiver, bytes) {
        // Samples that end early, or nothing at all: the exit status says more.
        Some(Err(problem)) if problem.kind == OpenErrorKind::Damaged => Some(problem),
        Some(result) => return result,
        None => None,
    };
    // The process has ended, or ends now that the pipe is closed.
    let mut message = String::new();
    if let Some(stderr) = child.0.stderr.take() {
        let _ = stderr.take(STDERR_MAX_BYTES).read_to_string(&mut message);
    }
    match (result, child.0.wait()) {
        (Some(problem), Ok(status)) if status.success() => Err(problem),
        (_, Ok(status)) => Err(reader_failed(&format!("{status} {}", message.trim()))),
        (_, Err(e)) => Err(reader_failed(&e.to_string())),
    }
}

/// Most bytes taken of the parsing process's error message.
const STDERR_MAX_BYTES: u64 = 300;

/// A child process that is killed and reaped when dropped.
struct KillOnDrop(Child);

impl Drop for KillOnDrop {
    fn drop(&mut self) {
        // Both fail only if it has ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns the error for a parsing process that failed; `how` it ended.
fn reader_failed(how: &str) -> Problem {
    Problem::new(
        OpenErrorKind::TooLarge,
        "DICOM",
        format!(
            "the process that parses it, with {} MiB and {CHILD_CPU_SECS} s at most, ended \
             before it was done ({how})",
            CHILD_MEMORY_BYTES >> 20
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
    let supply = Supply::Encoded { name: "DICOM", bytes, ratio: RLE_RATIO };
    let (samples, stored) = samples::read(pipe, supply, &layout, cap).map_err(|mut p| {
        p.field = "slices".into();
        p
    })?;
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
    out: &mut dyn Write,
) -> std::io::Result<()> {
    // After the first byte a problem can't be written any more; the reader sees an early end.
    let mut out = WriteTracker { out, started: false };
    match series::write(files, choice, &mut out) {
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
/// is meant. First the process limits itself for good, where the system allows it: 512 MiB of
/// memory, 120 s of processor time, no file written.
///
/// # Errors
/// Reading fails after the first samples were written, or `out` can't be written. The process must
/// then print the error to stderr and exit with a failure.
pub fn serve(
    folder: &Path,
    series: Option<&str>,
    file: Option<&Path>,
    out: &mut dyn Write,
) -> std::io::Result<()> {
    confine();
    match crate::folder::dicom_files(folder) {
        Ok(files) => write_series(&files, &SeriesChoice { series, file }, out),
        Err(problem) => wire::write_problem(&problem, out),
    }
}

/// Limits memory and processor time of this process, and forbids it to write files. Where the
/// system refuses, only the parser's own limits apply.
#[cfg(unix)]
fn confine() {
    use rustix::process::{Resource, Rlimit, setrlimit};
    for (resource, most) in [
        (Resource::As, CHILD_MEMORY_BYTES),
        (Resource::Cpu, CHILD_CPU_SECS),
        (Resource::Fsize, 0),
        (Resource::Core, 0),
    ] {
        let _ = setrlimit(resource, Rlimit { current: Some(most), maximum: Some(most) });
    }
}

#[cfg(not(unix))]
fn confine() {}

#[cfg(test)]
pub(crate) mod tests;
