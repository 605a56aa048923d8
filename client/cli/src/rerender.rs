//! `slabcast rerender`: renders a picture again from its provenance and compares the files.

use crate::render;
use slabcast_session::fail::{Fail, say};
use slabcast_session::output::provenance::{self, Provenance};
use slabcast_session::output::{Output, OutputArgs, free_name};
use slabcast_session::{progress, volume};
use std::path::PathBuf;

/// Renders a picture again from the record inside it.
///
/// Then compares the two files. Pictures that slabcast writes (PNG of 8 or 16 bits, EXR, TIFF, JPEG,
/// moving PNG) say what made them: the volume's digest, transfer function, view, quality and version. With
/// the same volume the new file has the same bytes, on any machine.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast rerender slabcast-out/frame_0003.png brain.nii.gz
  slabcast rerender front.exr brain.nii.gz -o again.exr
  slabcast rerender front.png brain.nii.gz --show

What a picture says of itself is JSON: --show prints it. It names no person, file, machine or
time. Exit code 1: the volume is another one, or the bytes differ.")]
pub(crate) struct RerenderArgs {
    /// PNG, EXR, TIFF or JPEG that slabcast wrote
    picture: PathBuf,
    /// The volume that it shows
    #[arg(required_unless_present = "show")]
    volume: Option<PathBuf>,
    #[command(flatten)]
    input: volume::InputArgs,
    /// File for the new picture [default: again.png, then again-2.png, with the ending of PICTURE]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Replace a file that is there already
    #[arg(long)]
    force: bool,
    /// Only print what the picture says of itself
    #[arg(long, conflicts_with_all = ["output", "force"])]
    show: bool,
    /// No progress, only warnings and the result
    #[arg(short, long)]
    quiet: bool,
}

/// Runs the command.
pub(crate) fn run(args: &RerenderArgs) -> Result<(), Fail> {
    let before = provenance::read(&args.picture)?;
    let made = Provenance::read(&args.picture, &before)?;
    let Some(file) = args.volume.as_ref().filter(|_| !args.show) else {
        let json = serde_json::to_string_pretty(&made).map_err(|e| Fail::failed(e.to_string()))?;
        return say(&(json + "\n"));
    };
    let ending = args.picture.extension().unwrap_or_default();
    let own = PathBuf::from("again").with_extension(ending);
    let own = || if args.force { own.clone() } else { free_name(&own) };
    let target = args.output.clone().unwrap_or_else(own);
    let request = made.request();
    let output = OutputArgs {
        output: Some(target.clone()),
        format: Some(made.format),
        fps: made.fps,
        contact_sheet: None,
        force: args.force,
        figure: made.figure.clone(),
    };
    let inputs = [args.picture.as_path(), file.as_path()];
    let (output, _) = Output::look(&output, "frame", &request, &inputs)?;
    let volume = args.input.open(file)?;
    let digest = volume.digest().to_string();
    if digest != made.volume_sha256 {
        return Err(Fail::failed(format!(
            "{}: shows volume {}, but {} is volume {digest}; give the volume that it shows",
            args.picture.display(),
            made.volume_sha256,
            file.display()
        )));
    }
    render::again(request, output, volume, args.quiet)?;
    let after = provenance::read(&target)?;
    let (old, new) = (args.picture.display(), target.display());
    if before == after {
        return say(&format!("{new}: the same {} bytes as {old}\n", after.len()));
    }
    let again = Provenance::read(&target, &after)?;
    if again.same_pixels(&made) && made.slabcast != again.slabcast {
        progress::note(&format!(
            "{old} was written by slabcast {}, this is {}",
            made.slabcast, again.slabcast
        ));
    }
    Err(Fail::failed(if again.same_pixels(&made) {
        format!(
            "{new}: the same pixels as {old}, but other bytes around them; another program may \
                 have saved it since"
        )
    } else {
        format!("{new}: has other pixels than {old} says it has; please report this")
    }))
}
