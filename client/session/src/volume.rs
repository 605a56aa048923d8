//! Opening volumes: what a person can say of a file that it does not say itself, and the sentence
//! for each way in which that fails.

use crate::fail::Fail;
use crate::parse;
use crate::progress;
use slabcast_common::volume::Volume;
use slabcast_volumes::{Hints, Opened, RawHints};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// What the help of every command says of its volume.
pub(crate) const VOLUME: &str = "Volume file, folder with a stack or series, or formula:NAME";

/// What the file does not say of itself.
#[derive(clap::Args, Clone, Debug, Default, PartialEq)]
pub(crate) struct InputArgs {
    /// Samples of raw numbers along x, y, z, such as 256x256x128 [default: as in the file's name]
    #[arg(long, value_name = "AxBxC", value_parser = parse::dims, help_heading = HEADING)]
    dims: Option<[u64; 3]>,
    /// Type of raw numbers: uint8, int16, float32 and so on [default: as in the file's name]
    #[arg(long = "type", value_name = "TYPE", value_parser = parse::number_type,
          help_heading = HEADING)]
    kind: Option<String>,
    /// Byte order of raw numbers: little or big [default: little]
    #[arg(long, value_name = "ORDER", value_parser = parse::byte_order, help_heading = HEADING)]
    byte_order: Option<bool>,
    /// Distances of samples of raw numbers or TIFF pictures, such as 0.5x0.5x1.25 [default: 1x1x1]
    #[arg(long, value_name = "AxBxC", value_parser = parse::spacing, help_heading = HEADING)]
    spacing: Option<[f64; 3]>,
    /// Bytes before the first of raw numbers [default: 0]
    #[arg(long, value_name = "BYTES", allow_negative_numbers = true, help_heading = HEADING)]
    skip: Option<u64>,
    /// Which DICOM series of a folder: its number, description or UID [default: the only one]
    #[arg(long, value_name = "NAME", help_heading = HEADING)]
    series: Option<String>,
    /// Which level of an OME-Zarr pyramid, 0 the finest [default: the finest that fits]
    #[arg(long, value_name = "N", allow_negative_numbers = true, help_heading = HEADING)]
    level: Option<u32>,
    /// Most bytes of samples that a Zarr level may have [default: a quarter of the free memory]
    #[arg(long, value_name = "BYTES", value_parser = parse::memory, help_heading = HEADING)]
    max_bytes: Option<u64>,
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
            dicom_reader: dicom_reader(),
            level: self.level,
            max_bytes: self.max_bytes,
        }
    }

    /// Whether nothing was said.
    pub(crate) fn is_empty(&self) -> bool {
        *self == InputArgs::default()
    }

    /// Opens a file, a folder or a `formula:` volume.
    pub(crate) fn open(&self, path: &Path) -> Result<Volume, Fail> {
        let opened = open_with(path, &self.hints())?;
        opened.notes.iter().for_each(|note| progress::note(note));
        Ok(opened.volume)
    }
}

/// This program as it parses DICOM for another of its processes ([`DicomArgs`]). Where the system
/// doesn't say which file we are, a thread has to do.
fn dicom_reader() -> Option<Vec<OsString>> {
    let program = std::env::current_exe().ok()?;
    Some(vec![program.into(), "read-dicom".into()])
}

/// Parses a folder of DICOM for another process of ours, within limits: series and samples to stdout.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast read-dicom slices/")]
pub(crate) struct DicomArgs {
    /// Folder of the slices
    folder: PathBuf,
    /// Which series
    #[arg(long)]
    series: Option<String>,
    /// A slice of the series
    #[arg(long)]
    file: Option<PathBuf>,
}

/// Runs the hidden command: series and samples to stdout.
#[cfg(feature = "dicom")]
pub(crate) fn read_dicom(args: &DicomArgs) -> Result<(), Fail> {
    let mut out = std::io::BufWriter::with_capacity(1 << 16, std::io::stdout().lock());
    let DicomArgs { folder, series, file } = args;
    slabcast_volumes::dicom::serve(folder, series.as_deref(), file.as_deref(), &mut out)
        .map_err(|e| Fail::failed(e.to_string()))
}

#[cfg(not(feature = "dicom"))]
pub(crate) fn read_dicom(args: &DicomArgs) -> Result<(), Fail> {
    let DicomArgs { folder, .. } = args;
    Err(Fail::failed(format!("{}: this build does not read DICOM", folder.display())))
}

/// Opens a file, a folder or a `formula:` volume of which nothing else is known.
pub(crate) fn open(path: &Path) -> Result<Volume, Fail> {
    InputArgs::default().open(path)
}

/// A volume of ../shared/data and how it stands with this axis up; nothing, which is said, where it is not here.
#[cfg(test)]
pub(crate) fn of_the_data(
    file: &str,
    up: &str,
) -> Option<(Volume, slabcast_common::path::Orientation)> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data").join(file);
    if !file.exists() {
        println!("skipped: {} is not here", file.display());
        return None;
    }
    let up = up.parse().expect("an axis");
    let orientation = slabcast_common::path::Orientation::new(Some(up), None).expect("axes");
    Some((open(&file).expect("a volume"), orientation))
}

fn open_with(path: &Path, hints: &Hints) -> Result<Opened, Fail> {
    slabcast_volumes::open_with(path, hints).map_err(|e| Fail::failed(e.to_string()))
}
