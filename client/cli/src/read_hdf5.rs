//! The hidden `slabcast read-hdf5`: parses HDF5 for another process of this program, within limits.

use slabcast_session::fail::Fail;
use slabcast_session::parse;
use slabcast_session::volume::PickArgs;
use std::path::PathBuf;

/// Parses a file of HDF5 for another process of ours, within limits: volume and samples to stdout.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast read-hdf5 cells.ims")]
pub(crate) struct Hdf5Args {
    /// The file
    file: PathBuf,
    /// Path of the dataset
    #[arg(long)]
    dataset: Option<String>,
    /// Distances of samples along x, y and z
    #[arg(long, value_parser = parse::spacing)]
    spacing: Option<[f64; 3]>,
    #[command(flatten)]
    pick: PickArgs,
}

/// Runs the hidden command: volume and samples to stdout.
#[cfg(feature = "hdf5")]
pub(crate) fn run(args: &Hdf5Args) -> Result<(), Fail> {
    let mut out = std::io::BufWriter::with_capacity(1 << 16, std::io::stdout().lock());
    let Hdf5Args { file, dataset, spacing, pick } = args.clone();
    let choice = slabcast_volumes::hdf5::Choice { dataset, pick: pick.pick(), spacing };
    slabcast_volumes::hdf5::serve(&file, &choice, &mut out).map_err(|e| Fail::failed(e.to_string()))
}

#[cfg(not(feature = "hdf5"))]
pub(crate) fn run(args: &Hdf5Args) -> Result<(), Fail> {
    let Hdf5Args { file, dataset: _, spacing: _, pick: _ } = args;
    Err(Fail::failed(format!("{}: this build does not read HDF5", file.display())))
}
