//! The hidden `slabcast read-dicom`: parses DICOM for another process of this program, within
//! limits.

use slabcast_session::fail::Fail;
use slabcast_session::volume::PickArgs;
use std::path::PathBuf;

/// Parses a folder of DICOM for another process of ours, within limits: series and samples to
/// stdout.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast read-dicom slices/")]
pub(crate) struct DicomArgs {
    /// Folder of the slices
    folder: PathBuf,
    /// Series to read: its number, description or UID
    #[arg(long)]
    series: Option<String>,
    /// A slice of the series
    #[arg(long)]
    file: Option<PathBuf>,
    #[command(flatten)]
    pick: PickArgs,
}

/// Runs the hidden command: series and samples to stdout.
#[cfg(feature = "dicom")]
pub(crate) fn run(args: &DicomArgs) -> Result<(), Fail> {
    let mut out = std::io::BufWriter::with_capacity(1 << 16, std::io::stdout().lock());
    let DicomArgs { folder, series, file, pick } = args;
    let (series, file) = (series.as_deref(), file.as_deref());
    slabcast_volumes::dicom::serve(folder, series, file, pick.pick(), &mut out)
        .map_err(|e| Fail::failed(e.to_string()))
}

#[cfg(not(feature = "dicom"))]
pub(crate) fn run(args: &DicomArgs) -> Result<(), Fail> {
    let DicomArgs { folder, .. } = args;
    Err(Fail::failed(format!("{}: this build does not read DICOM", folder.display())))
}
