//! Opens the volume of a command: the flags for facts that a file does not hold itself, the folder
//! for facts found by earlier runs, and an error message for each way in which opening fails.

use crate::fail::Fail;
use crate::parse;
use crate::progress::{self, Progress};
use slabcast_common::level::LevelChoice;
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_volumes::blocks::{BlockSource, MemorySource};
use slabcast_volumes::{FileNumbers, Hints, OpenError, OpenErrorKind, Opened, Pick, RawHints};
use std::ffi::OsString;
use std::path::Path;
#[cfg(feature = "zarr")]
use std::path::PathBuf;
use std::sync::Arc;

/// Help text of every command's volume argument.
pub const VOLUME: &str = "Volume file, folder with a stack or series, or formula:NAME";

/// Flags that say what a file doesn't say itself.
#[derive(clap::Args, Clone, Debug, Default, PartialEq)]
pub struct InputArgs {
    /// Samples of raw numbers along x, y, z, such as 256x256x128 [default: as in the file's name]
    #[arg(long, value_name = "AxBxC", value_parser = parse::dims, help_heading = HEADING,
          hide_short_help = true)]
    dims: Option<[u64; 3]>,
    /// Type of raw numbers: uint8, int16, float32 and so on [default: as in the file's name]
    #[arg(long = "type", value_name = "TYPE", value_parser = parse::number_type,
          help_heading = HEADING,
          hide_short_help = true)]
    kind: Option<String>,
    /// Byte order of raw numbers: little or big [default: little]
    #[arg(long, value_name = "ORDER", value_parser = parse::byte_order, help_heading = HEADING,
          hide_short_help = true)]
    byte_order: Option<bool>,
    /// Distances of samples of raw numbers, pictures, NumPy arrays or HDF5, such as 0.5x0.5x1.25
    /// [default: 1x1x1]
    #[arg(long, value_name = "AxBxC", value_parser = parse::spacing, help_heading = HEADING,
          hide_short_help = true)]
    spacing: Option<[f64; 3]>,
    /// Bytes before the first of raw numbers [default: 0]
    #[arg(long, value_name = "BYTES", allow_negative_numbers = true, help_heading = HEADING,
          hide_short_help = true)]
    skip: Option<u64>,
    /// Which DICOM series of a folder: its number, description or UID [default: the only one]
    #[arg(long, value_name = "NAME", help_heading = HEADING,
          hide_short_help = true)]
    series: Option<String>,
    /// Which array of a file of several (.npz, .vti, .vtk, .h5, .hdf5, .ims): its name [default: the
    /// only one, the first, or the largest]
    #[arg(long, value_name = "NAME", help_heading = HEADING,
          hide_short_help = true)]
    dataset: Option<String>,
    /// Level of detail: auto, or 0 (all) and up, each half as fine [default: 0]
    ///
    /// auto draws at the level at which a sample covers about a pixel in the nearest view, which is
    /// faster and looks alike. Of an OME-Zarr picture level N of the file is read, by default the
    /// finest that fits into memory.
    #[arg(long, value_name = "auto|N", value_parser = parse::level, allow_negative_numbers = true,
          help_heading = HEADING, hide_short_help = true)]
    level: Option<LevelChoice>,
    /// Most bytes that the samples may take [default: 1 GiB or 64 times the file, in free memory]
    #[arg(long, value_name = "BYTES", value_parser = parse::memory, help_heading = HEADING,
          hide_short_help = true)]
    max_bytes: Option<u64>,
    #[command(flatten)]
    pick: PickArgs,
}

/// Flags that take one volume of a file with several.
#[derive(clap::Args, Clone, Debug, Default, PartialEq)]
pub struct PickArgs {
    /// Which volume of a file with several, 0 the first, in the file's order [default: 0]
    #[arg(long = "volume", id = "nth_volume", value_name = "N", allow_negative_numbers = true,
          conflicts_with_all = ["nth_time", "nth_channel"], help_heading = HEADING,
          hide_short_help = true)]
    volume: Option<u64>,
    /// Which time or echo, 0 the first [default: 0]
    #[arg(long = "time", id = "nth_time", value_name = "N", allow_negative_numbers = true,
          help_heading = HEADING,
          hide_short_help = true)]
    time: Option<u64>,
    /// Which channel, colour or component, 0 the first [default: 0 of channels]
    #[arg(long = "channel", id = "nth_channel", value_name = "N", allow_negative_numbers = true,
          help_heading = HEADING,
          hide_short_help = true)]
    channel: Option<u64>,
}

impl PickArgs {
    /// Returns what the flags ask for.
    pub fn pick(&self) -> Pick {
        Pick { volume: self.volume, time: self.time, channel: self.channel }
    }
}

const HEADING: &str = "Input (what the file does not say itself)";

impl InputArgs {
    fn hints(&self) -> Hints {
        let raw = RawHints::new(self.dims, self.byte_order, self.spacing, self.skip);
        let raw = match &self.kind {
            Some(kind) => raw.with_type(kind).expect("parse::number_type lets only types through"),
            None => raw,
        };
        Hints {
            raw,
            series: self.series.clone(),
            dataset: self.dataset.clone(),
            dicom_reader: reader("read-dicom"),
            hdf5_reader: reader("read-hdf5"),
            level: match self.level {
                Some(LevelChoice::At(level)) => Some(level),
                Some(LevelChoice::Auto) | None => None,
            },
            max_bytes: self.max_bytes,
            pick: self.pick.pick(),
            ..Hints::default()
        }
    }

    /// Returns whether no flag says what is in a file. A level of detail does not.
    pub fn is_empty(&self) -> bool {
        InputArgs { level: None, ..self.clone() } == InputArgs::default()
    }

    /// Returns the level of detail to draw.
    pub fn level(&self) -> LevelChoice {
        self.level.unwrap_or_default()
    }

    /// Returns the level of detail to draw of a source. Without `--level` it is level 0 for a
    /// volume in memory or of less than 1 GiB, and `auto` for others.
    pub fn level_of(&self, source: &dyn BlockSource) -> LevelChoice {
        let finest = &source.levels()[0];
        let bytes = finest.lattice.len() as u64 * finest.summary.kind.bytes() as u64;
        let is_large = source.whole(0).is_none() && bytes > AUTO_FROM_BYTES;
        self.level.unwrap_or(if is_large { LevelChoice::Auto } else { LevelChoice::default() })
    }

    /// Opens a file, a folder or a `formula:` volume and prints notes about it.
    ///
    /// # Errors
    /// The volume can't be read; the error names file and remedy.
    pub fn open(&self, path: &Path) -> Result<Volume, Fail> {
        let opened = open_with(path, &self.hints())?;
        opened.notes.iter().for_each(|note| progress::note(note));
        Ok(opened.volume)
    }

    /// Opens a file, a folder or a `formula:` volume as a source of boxes. A large pyramid stays in
    /// its file; other volumes are read into memory. Prints notes, and the progress of the first
    /// pass over all samples.
    ///
    /// # Errors
    /// The volume can't be read; the error names file and remedy.
    pub fn open_source(&self, path: &Path) -> Result<OpenedSource, Fail> {
        let mut bar = None;
        let mut told = |there: u64, total: u64| {
            let bar = bar.get_or_insert_with(|| Progress::new(false).counting("MiB"));
            bar.bytes_done(there, total, &format!("reading {}", path.display()));
        };
        let opened = source(path, &self.hints(), Packed::Converted, &mut told);
        if let Some(bar) = bar {
            bar.end();
        }
        let (opened, notes) = opened.map_err(|e| Fail::failed(e.to_string()))?;
        notes.iter().for_each(|note| progress::note(note));
        Ok(opened)
    }

    /// Opens a file, a folder or a `formula:` volume to write it in another format. Returns the
    /// file's own numbers, too, where the volume's codes round them.
    ///
    /// # Errors
    /// The volume can't be read; the error names file and remedy.
    pub fn open_numbers(&self, path: &Path) -> Result<(Volume, Option<FileNumbers>), Fail> {
        let opened = slabcast_volumes::open_numbers(path, &self.hints());
        let (opened, numbers) = opened.map_err(|e| Fail::failed(e.to_string()))?;
        opened.notes.iter().for_each(|note| progress::note(note));
        Ok((opened.volume, numbers))
    }
}

impl InputArgs {
    /// Reads a file or folder whose samples take at most `most_bytes`, or at most `--max-bytes` if
    /// that is less. Returns the volume with the reader's notes.
    ///
    /// # Errors
    /// The volume can't be read.
    pub fn read(
        &self,
        path: &Path,
        most_bytes: u64,
    ) -> Result<(OpenedSource, Vec<String>), OpenError> {
        let mut hints = self.hints();
        hints.max_bytes = Some(hints.max_bytes.map_or(most_bytes, |asked| asked.min(most_bytes)));
        source(path, &hints, Packed::Refused, &mut |_, _| ())
    }
}

#[cfg(feature = "zarr")]
impl InputArgs {
    /// Writes a volume as OME-Zarr with all levels into the folder `to`. With `replace`, a Zarr
    /// folder at `to` is removed once the new one is complete. `on_progress` is called with the
    /// bytes done and the bytes in all.
    ///
    /// # Errors
    /// The volume can't be read, the folder can't be written, or `on_progress` returned an error.
    pub fn convert(
        &self,
        from: &Path,
        to: &Path,
        replace: bool,
        on_progress: &mut slabcast_volumes::blocks::ome_zarr::OnProgress<'_>,
    ) -> Result<(), Fail> {
        use slabcast_volumes::blocks::ome_zarr::convert;
        let converted = convert(from, to, &self.hints(), replace, on_progress);
        let converted = converted.map_err(|e| Fail::failed(e.to_string()))?;
        converted.notes.iter().for_each(|note| progress::note(note));
        Ok(())
    }
}

/// Bytes of samples from which a volume is drawn at level `auto` by default: level 0 would read
/// gigabytes.
const AUTO_FROM_BYTES: u64 = 1 << 30;

/// A volume that was opened to be served.
#[derive(Clone)]
pub struct OpenedSource {
    /// Source of its samples.
    pub source: Arc<dyn BlockSource>,
    /// The volume, if it is in memory.
    pub volume: Option<Arc<Volume>>,
}

impl OpenedSource {
    /// Returns the description of the finest level.
    pub fn info(&self) -> &VolumeInfo {
        &self.source.levels()[0]
    }

    /// Returns the volume for a command that needs all samples in memory. `flags` are the flags
    /// that need them, for the error message.
    ///
    /// # Errors
    /// The volume is not in memory: its file is read block by block.
    pub fn whole(&self, flags: &str) -> Result<Arc<Volume>, Fail> {
        self.volume.clone().ok_or_else(|| {
            let name = self.source.name();
            Fail::usage(format!(
                "{flags}: {name} is too large to be in memory as a whole; leave {flags} out, or give one \
                 of its coarser levels with --level and --max-bytes"
            ))
        })
    }
}

/// Opens a volume: by blocks if it is a large pyramid or does not fit into memory, else in memory.
/// Returns it with the reader's notes. `packed` says whether a packed file that does not fit is
/// converted. `on_progress` is called with the bytes surveyed and the bytes in all.
fn source(
    path: &Path,
    hints: &Hints,
    packed: Packed,
    on_progress: &mut dyn FnMut(u64, u64),
) -> Result<(OpenedSource, Vec<String>), OpenError> {
    if is_large(path, hints) {
        return by_blocks(path, hints, packed, on_progress);
    }
    match slabcast_volumes::open_with(path, hints) {
        Ok(opened) => {
            let volume = Arc::new(opened.volume);
            let source = Arc::new(MemorySource::of(volume.clone()));
            Ok((OpenedSource { source, volume: Some(volume) }, opened.notes))
        }
        Err(e) if e.problem.kind == OpenErrorKind::TooLarge => {
            let by_blocks = by_blocks(path, hints, packed, on_progress);
            // A disk that is too small for the picture is the reason that helps.
            by_blocks.map_err(|other| if other.problem.field == "cache" { other } else { e })
        }
        Err(e) => Err(e),
    }
}

#[cfg(feature = "zarr")]
use slabcast_volumes::blocks::{Packed, is_large, open_source};

/// Treatment of packed files that don't fit, of a program that reads none by blocks.
#[cfg(not(feature = "zarr"))]
#[derive(Clone, Copy)]
enum Packed {
    Refused,
    Converted,
}

#[cfg(feature = "zarr")]
fn by_blocks(
    path: &Path,
    hints: &Hints,
    packed: Packed,
    on_progress: &mut dyn FnMut(u64, u64),
) -> Result<(OpenedSource, Vec<String>), OpenError> {
    let mut notes = Vec::new();
    let mut told = |done, total| {
        on_progress(done, total);
        Ok(())
    };
    let cache = cache_folder();
    let opened = open_source(path, hints, cache.as_deref(), packed, &mut notes, &mut told);
    Ok((OpenedSource { source: opened?, volume: None }, notes))
}

#[cfg(not(feature = "zarr"))]
fn is_large(_path: &Path, _hints: &Hints) -> bool {
    false
}

#[cfg(not(feature = "zarr"))]
fn by_blocks(
    path: &Path,
    hints: &Hints,
    _packed: Packed,
    _on_progress: &mut dyn FnMut(u64, u64),
) -> Result<(OpenedSource, Vec<String>), OpenError> {
    let opened = slabcast_volumes::open_with(path, hints)?;
    let source = Arc::new(MemorySource::of(opened.volume));
    Ok((OpenedSource { source, volume: None }, opened.notes))
}

/// Returns the folder that keeps digests and block summaries of large volumes: `SLABCAST_CACHE`,
/// else `CACHE_DIRECTORY` (set by systemd), else `slabcast` in the user's cache folder. `None` for
/// a user without a home: then each run surveys the volume again.
#[cfg(feature = "zarr")]
fn cache_folder() -> Option<PathBuf> {
    let variable = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let home = || variable("HOME").map(|home| home.join(".cache"));
    let users = || variable("XDG_CACHE_HOME").or_else(home).map(|cache| cache.join("slabcast"));
    variable("SLABCAST_CACHE").or_else(|| variable("CACHE_DIRECTORY")).or_else(users)
}

/// Returns the command line of the child process that parses a format by a hidden command (such as
/// `slabcast read-dicom`). `None` if the system does not tell the path of this program: then a thread
/// parses.
fn reader(command: &str) -> Option<Vec<OsString>> {
    let program = std::env::current_exe().ok()?;
    Some(vec![program.into(), command.into()])
}

/// Opens a file, a folder or a `formula:` volume without any flags.
///
/// # Errors
/// The volume can't be read; the error names file and remedy.
pub fn open(path: &Path) -> Result<Volume, Fail> {
    InputArgs::default().open(path)
}

fn open_with(path: &Path, hints: &Hints) -> Result<Opened, Fail> {
    slabcast_volumes::open_with(path, hints).map_err(|e| Fail::failed(e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;
    use slabcast_volumes::{Flag, takers};

    #[derive(clap::Parser)]
    struct Program {
        #[command(flatten)]
        _input: InputArgs,
    }

    #[test]
    fn help_names_the_formats_that_take_a_flag() {
        let help = Program::command().render_long_help().to_string();
        let help = help.split_whitespace().collect::<Vec<_>>().join(" ");
        let takers = takers(Flag::Dataset);
        assert!(help.contains(&takers), "{takers} is not in {help}");
        assert!(help.contains("--series <NAME> Which DICOM series"), "{help}");
    }
}
