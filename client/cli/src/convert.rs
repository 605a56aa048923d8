//! `slabcast convert`: a volume of any format as NRRD, NIfTI or OME-Zarr.

#[cfg(feature = "zarr")]
mod pyramid;

use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::{self, Progress};
use slabcast_session::{output, signals, volume};
use slabcast_volumes::write::{self, Format};
use std::path::{Path, PathBuf};

/// Writes a volume as NRRD, NIfTI or OME-Zarr.
///
/// Values, place and orientation stay. OME-Zarr has all levels of detail, each half as fine as the one
/// before, and is read piece by piece; most formats are converted slice by slice, whatever their size.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
The file is whole or not there. Numbers keep type and value, to the bit; where they have a slope that
the output can't hold, their values are written as float64, which a note says.

Examples:
  slabcast convert scan.mha scan.nii.gz
  slabcast convert head.raw head.nrrd --dims 256x256x128 --type uint8 --spacing 1x1x1.5
  slabcast convert slices/ slices.nrrd --encoding raw
  slabcast convert large.nrrd large.ome.zarr")]
pub(crate) struct ConvertArgs {
    #[arg(help = volume::VOLUME)]
    volume: PathBuf,
    /// File to write; its name says how: .nrrd, .nii, .nii.gz, or .ome.zarr or .zarr (a folder)
    #[arg(value_name = "OUT")]
    output: PathBuf,
    #[command(flatten)]
    input: volume::InputArgs,
    /// How samples are stored: raw or gzip [default: gzip for .nrrd and .nii.gz, raw for .nii; lz4 for
    /// .zarr]
    #[arg(long, value_name = "HOW", value_parser = ["raw", "gzip"])]
    encoding: Option<String>,
    /// Replace the file if it is there already
    #[arg(long)]
    force: bool,
    /// No progress, only warnings and the result
    #[arg(short, long)]
    quiet: bool,
}

/// Runs the command.
pub(crate) fn run(args: &ConvertArgs) -> Result<(), Fail> {
    let shown = args.output.display();
    let name = args.output.file_name().unwrap_or_default().to_string_lossy();
    #[cfg(feature = "zarr")]
    if name.to_ascii_lowercase().ends_with(".zarr") {
        return pyramid::run(args);
    }
    let Some(mut format) = Format::from_name(&name) else {
        return Err(Fail::usage(format!(
            "OUT: `{shown}` names no format that is written; end it with .nrrd, .nii, .nii.gz or \
             .ome.zarr"
        )));
    };
    if let Some(encoding) = &args.encoding {
        let gzip = encoding == "gzip";
        if format.with_gzip(gzip) != format && matches!(format, Format::Nifti { .. }) {
            return Err(Fail::usage(format!(
                "--encoding: {encoding} does not go with `{name}`; a packed NIfTI file ends in \
                 .nii.gz, any other in .nii"
            )));
        }
        format = format.with_gzip(gzip);
    }
    if args.output.is_dir() {
        return Err(Fail::failed(format!("{shown}: is a folder; give a file")));
    }
    if args.output.exists() {
        if let (Ok(a), Ok(b)) = (args.output.canonicalize(), args.volume.canonicalize())
            && a == b
        {
            return Err(Fail::usage(format!(
                "OUT: `{shown}` is the volume itself; give another file"
            )));
        }
        if !args.force {
            return Err(Fail::failed(format!(
                "{shown}: is there already; add --force to replace it, or give another name"
            )));
        }
    }
    // Better now than after a long read.
    output::probe(&args.output)?;
    let mut bar = Progress::new(args.quiet).counting("slice");
    bar.phase(&format!("reading {}", args.volume.display()));
    let (input, file) = (args.input.clone(), args.volume.clone());
    let (volume, numbers) = signals::run_unless_stopped(move || input.open_numbers(&file))?;
    if let Some(lost) = write::loss_warning(&volume, format) {
        progress::warn(&lost);
    }
    if let Some(note) = write::type_note(&volume, numbers.as_ref(), format) {
        progress::note(&note);
    }
    let (to, what) = (args.output.clone(), format!("writing {shown}"));
    let bytes = signals::run_to_end(move || {
        let write = |out: &mut dyn std::io::Write, went_on: &mut WentOn<'_>| {
            write::write(&volume, numbers.as_ref(), format, out, went_on)
        };
        write_to(&to, volume.lattice.dims, write, bar, &what)
    })?;
    if args.quiet {
        return Ok(());
    }
    say(&format!("{shown}: {}\n", progress::bytes(bytes)))
}

/// Hears how many samples are written.
type WentOn<'a> = dyn FnMut(u64) -> std::io::Result<()> + 'a;

/// Writes the file; gives its bytes.
fn write_to(
    path: &Path,
    dims: [u32; 3],
    write: impl Fn(&mut dyn std::io::Write, &mut WentOn<'_>) -> std::io::Result<()>,
    mut bar: Progress,
    what: &str,
) -> Result<u64, Fail> {
    let [nx, ny, nz] = dims.map(u64::from);
    bar.frames(nz, what);
    let mut went_on = |samples: u64| {
        bar.step(progress::Step { frames: samples / (nx * ny), ..Default::default() });
        match signals::stop_requested() {
            true => Err(std::io::Error::other("stopped")),
            false => Ok(()),
        }
    };
    output::write_atomic(path, |out| write(out, &mut went_on))?;
    bar.end();
    std::fs::metadata(path).map(|m| m.len()).map_err(|e| Fail::io(path, "looking at it", &e))
}
