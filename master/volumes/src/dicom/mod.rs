//! DICOM series: a folder of slices, sorted by where they lie, as one volume.
//!
//! Files from outside are parsed in a process of its own ([`serve`]), which may take 512 MiB and
//! 120 s of processor time, may write no file, and says the series and its samples through a pipe.
//! Whoever opens a volume names the program that does so
//! ([`crate::Hints::dicom_reader`]); a library without one has a thread instead.

mod elements;
mod rle;
mod series;
mod wire;

pub(crate) use elements::sniff;
#[cfg(test)]
pub(crate) use series::one_slice;

use crate::Opened;
use crate::error::{OpenErrorKind, Problem};
use crate::samples::{self, Endian, Layout, Supply};
use series::Wish;
use slabcast_common::volume::{ValueMap, Volume};
use std::ffi::OsString;
use std::io::{BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use wire::Preface;

/// Memory of the process that parses: a slice of 16384 x 16384 pixels of 16 bits is 512 MiB and
/// is refused; one of 8192 x 8192 passes, packed or not.
const CHILD_MEMORY_BYTES: u64 = 512 << 20;

/// Processor seconds of that process: 16384 slices of 512 x 512 take some 10.
const CHILD_CPU_SECS: u64 = 120;

/// Bytes that a byte of a file can at most become: two bytes of RLE are up to 128.
const RLE_RATIO: u64 = 64;

/// Opens the wished series of these files (all of them DICOM, of one folder).
pub(crate) fn open(
    files: &[PathBuf],
    folder: &Path,
    series: Option<&str>,
    file: Option<&Path>,
    reader: Option<&[OsString]>,
) -> Result<Opened, Problem> {
    let bytes = files.iter().filter_map(|f| f.metadata().ok()).map(|m| m.len()).sum();
    let Some(program) = reader else {
        let (from, mut to) = std::io::pipe().map_err(|e| Problem::io("pipe", &e))?;
        return std::thread::scope(|scope| {
            scope.spawn(move || {
                // Whoever receives tells of a panic: the pipe ends before the series does.
                let _ = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                    // A receiver that has gone away has its reasons.
                    let _ = told(files, &Wish { series, file }, &mut to);
                }));
            });
            received(from, bytes).unwrap_or_else(|| Err(ended("it panicked")))
        });
    };
    let [name, args @ ..] = program else { return Err(ended("it has no name")) };
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
        .map_err(|e| ended(&format!("it could not be started: {e}")))?;
    let mut child = Reaped(child);
    let Some(from) = child.0.stdout.take() else { return Err(ended("it has no pipe")) };
    let result = match received(from, bytes) {
        // Samples that end early, or nothing at all, are the process's end to tell.
        Some(Err(problem)) if problem.kind == OpenErrorKind::Damaged => Some(problem),
        Some(result) => return result,
        None => None,
    };
    // It has ended, or ends now that nobody listens; what it says last is a line.
    let mut last = String::new();
    if let Some(said) = child.0.stderr.take() {
        let _ = said.take(LAST_WORDS_BYTES).read_to_string(&mut last);
    }
    match (result, child.0.wait()) {
        (Some(problem), Ok(status)) if status.success() => Err(problem),
        (_, Ok(status)) => Err(ended(&format!("{status} {}", last.trim()))),
        (_, Err(e)) => Err(ended(&e.to_string())),
    }
}

/// As much as is taken of what a process says when it ends badly.
const LAST_WORDS_BYTES: u64 = 300;

/// A process that does not outlive the one who waits for it.
struct Reaped(Child);

impl Drop for Reaped {
    fn drop(&mut self) {
        // Both fail only where it has ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn ended(how: &str) -> Problem {
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

/// Reads what comes through the pipe; `None` where it says nothing, or nonsense.
fn received(from: impl Read + Send, bytes: u64) -> Option<Result<Opened, Problem>> {
    let mut from = BufReader::with_capacity(128 << 10, from);
    let preface = match Preface::read(&mut from)? {
        Ok(preface) => preface,
        Err(problem) => return Some(Err(problem)),
    };
    Some(volume(preface, &mut from, bytes))
}

fn volume(preface: Preface, from: &mut (dyn Read + Send), bytes: u64) -> Result<Opened, Problem> {
    let Preface { name, number, lattice, anatomical, rescale: [slope, intercept], notes, .. } =
        preface;
    let layout = Layout::new(lattice.dims.map(u64::from), number, Endian::Little, "slices")?;
    lattice.check().map_err(|e| Problem::malformed("slices", e, "get the series again"))?;
    let supply = Supply::Encoded { name: "DICOM", bytes, ratio: RLE_RATIO };
    let (samples, stored) = samples::read(from, supply, &layout).map_err(|mut p| {
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

/// Writes the series or why there is none.
fn told(files: &[PathBuf], wish: &Wish<'_>, out: &mut dyn Write) -> std::io::Result<()> {
    // Samples that were begun can't be taken back: whoever reads sees them end early.
    let mut begun = Begun { out, any: false };
    match series::write(files, wish, &mut begun) {
        Err(problem) if !begun.any => wire::write_problem(&problem, begun.out),
        Err(problem) => Err(std::io::Error::other(problem)),
        Ok(()) => Ok(()),
    }
}

struct Begun<'a> {
    out: &'a mut dyn Write,
    any: bool,
}

impl Write for Begun<'_> {
    fn write(&mut self, buf: &[u8]) -> std::io::Result<usize> {
        self.any = true;
        self.out.write(buf)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.out.flush()
    }
}

/// Parses a folder of DICOM files in the process started for it ([`crate::Hints::dicom_reader`]) and
/// writes one series, or the problem that prevents it, to `out`.
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
        Ok(files) => told(&files, &Wish { series, file }, out),
        Err(problem) => wire::write_problem(&problem, out),
    }
}

/// Bounds on memory and processor time, and no files to be written. Where the system has none
/// or refuses, the parser's own limits stand alone.
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
