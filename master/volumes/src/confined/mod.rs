//! Parsers that are not trusted with strangers' files run in a process of their own.
//!
//! The process confines itself to reading what it was given (`confine`), is killed when it takes too
//! long (`watch`), and sends a volume's description and its samples through a pipe (`wire`). The
//! caller names the program; without one a thread parses, unconfined.

mod confine;
mod watch;
pub(crate) mod wire;

use crate::Opened;
use crate::error::{OpenErrorKind, Problem};
use crate::limit::ByteCap;
use crate::pick::Pick;
use crate::samples::{self, Endian, Layout, Supply};
use confine::{CPU_SECS, MEMORY_BYTES};
use slabcast_common::volume::{ValueMap, Volume};
use std::ffi::OsString;
use std::io::{BufReader, Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;
use watch::Watched;
use wire::Preface;

/// Bytes of files that the parsing process must get through in a second, by the wall clock: slow for
/// a network disk, and more than a process that only waits.
const BYTES_A_SECOND: u64 = 4 << 20;

/// Most bytes taken of the parsing process's error message.
const STDERR_MAX_BYTES: u64 = 300;

/// A parser, and what it is given.
pub(crate) struct Parser<'a> {
    /// Name of the format.
    pub(crate) name: &'static str,
    /// Word for the samples in errors, such as `slices`.
    pub(crate) samples: &'static str,
    /// Field that states slope and intercept, as errors name it.
    pub(crate) rescale: &'static str,
    /// Remedy where the parser fails or the file is damaged.
    pub(crate) remedies: [&'static str; 2],
    /// Program and first arguments; `None` for a thread.
    pub(crate) program: Option<&'a [OsString]>,
    /// Further arguments.
    pub(crate) arguments: Vec<OsString>,
    /// Bytes of the files.
    pub(crate) stored: u64,
    /// Most bytes of samples per byte of the files.
    pub(crate) ratio: u64,
    pub(crate) cap: ByteCap,
}

/// Returns the arguments for a pick.
pub(crate) fn pick_arguments(pick: Pick) -> Vec<OsString> {
    let Pick { volume, time, channel } = pick;
    let flags = [("--volume", volume), ("--time", time), ("--channel", channel)];
    let given = flags.into_iter().filter_map(|(flag, index)| Some((flag, index?)));
    given.flat_map(|(flag, index)| [flag.into(), index.to_string().into()]).collect()
}

impl Parser<'_> {
    /// Runs the parser: its process, or `in_thread` where there is no program for it.
    pub(crate) fn run(
        &self,
        in_thread: impl FnOnce(&mut dyn Write) -> std::io::Result<()> + Send,
    ) -> Result<Opened, Problem> {
        let Some(program) = self.program else {
            let (receiver, mut sender) = std::io::pipe().map_err(|e| Problem::io("pipe", &e))?;
            return std::thread::scope(|scope| {
                scope.spawn(move || {
                    // The receiver reports a panic, since the pipe then ends before the volume; a
                    // receiver that is gone has failed on its own.
                    let parse = std::panic::AssertUnwindSafe(|| in_thread(&mut sender));
                    let _ = std::panic::catch_unwind(parse);
                });
                self.read(receiver).unwrap_or_else(|| Err(self.failed("it panicked")))
            });
        };
        let [name, args @ ..] = program else { return Err(self.failed("it has no name")) };
        let mut command = Command::new(name);
        command.args(args).args(&self.arguments);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let limit = Duration::from_secs(CPU_SECS + self.stored / BYTES_A_SECOND);
        let (mut child, stdout, stderr) = Watched::start(&mut command, limit)
            .map_err(|e| self.failed(&format!("it could not be started: {e}")))?;
        let result = match self.read(stdout) {
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
                Err(self.failed(&format!("it took more than {} s", limit.as_secs())))
            }
            (_, Ok(status)) => Err(self.failed(&format!("{status} {}", message.trim()))),
            (_, Err(e)) => Err(self.failed(&e.to_string())),
        }
    }

    /// Returns the error for a parsing process that failed; `how` it ended.
    fn failed(&self, how: &str) -> Problem {
        let how: String = how.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        Problem::new(
            OpenErrorKind::TooLarge,
            self.name,
            format!(
                "the process that parses it, with {} MiB and {CPU_SECS} s at most, ended before it \
                 was done ({how})",
                MEMORY_BYTES >> 20
            ),
            self.remedies[0],
        )
    }

    /// Reads a volume from the pipe; `None` if nothing valid came.
    fn read(&self, pipe: impl Read + Send) -> Option<Result<Opened, Problem>> {
        let mut pipe = BufReader::with_capacity(128 << 10, pipe);
        let preface = match Preface::read(&mut pipe)? {
            Ok(preface) => preface,
            Err(problem) => return Some(Err(problem)),
        };
        Some(self.read_volume(preface, &mut pipe))
    }

    /// Reads the samples after a preface and makes the volume.
    fn read_volume(
        &self,
        preface: Preface,
        pipe: &mut (dyn Read + Send),
    ) -> Result<Opened, Problem> {
        let Preface {
            name, number, lattice, anatomical, rescale: [slope, intercept], notes, ..
        } = preface;
        let layout =
            Layout::new(lattice.dims.map(u64::from), number, Endian::Little, self.samples)?;
        lattice.check().map_err(|e| Problem::malformed(self.samples, e, self.remedies[1]))?;
        let supply = Supply::Encoded { name: self.name, bytes: self.stored, ratio: self.ratio };
        let beside = self.cap.beside.clone();
        if let Some(stream) = beside.stream() {
            return Err(stream.refuse());
        }
        let read = samples::read(pipe, supply, &layout, self.cap.clone());
        let (samples, stored) = read.map_err(|mut p| {
            p.field = self.samples.into();
            p
        })?;
        beside.rescale(ValueMap { scale: slope, offset: intercept });
        let map =
            ValueMap { scale: slope * stored.scale, offset: slope * stored.offset + intercept };
        let volume = Volume::new(name, number.name(), anatomical, lattice, samples, map);
        let (lo, hi) = volume.summary.range();
        if !(lo.is_finite() && hi.is_finite() && map.scale.is_normal()) {
            return Err(Problem::malformed(
                self.rescale,
                format!("{slope:?} takes the values out of the range of numbers"),
                self.remedies[1],
            ));
        }
        Ok(Opened { volume, notes })
    }
}

/// Writes a volume with `write`, or the problem that prevents it.
pub(crate) fn write_or_problem(
    out: &mut dyn Write,
    write: impl FnOnce(&mut dyn Write) -> Result<(), Problem>,
) -> std::io::Result<()> {
    // After the first byte a problem can't be written any more; the reader sees an early end.
    let mut out = WriteTracker { out, started: false };
    match write(&mut out) {
        Err(problem) if !out.started => wire::write_problem(&problem, out.out),
        Err(problem) => Err(std::io::Error::other(problem)),
        Ok(()) => Ok(()),
    }
}

/// Confines this process for good, where the system allows it: 512 MiB of memory, 120 s of processor
/// time, nothing to read but the file or folder `path`, no network and no other process. Returns a
/// note on each thing that the system did not allow to take away.
pub(crate) fn confine(path: &Path, name: &str) -> Vec<String> {
    confine::confine(path)
        .iter()
        .map(|lack| format!("{name} is parsed in a process of its own, but {lack}"))
        .collect()
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
