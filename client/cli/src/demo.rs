//! `slabcast demo`: pictures without a file, and what to type next.

use crate::render::{self, RenderArgs};
use clap::{Args, FromArgMatches};
use slabcast_session::fail::{Fail, say};
use std::ffi::OsString;
use std::path::PathBuf;

/// Renders a volume by formula; needs no file.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast demo
  slabcast demo -o somewhere/")]
pub(crate) struct DemoArgs {
    /// Folder for the pictures
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// No progress, only warnings and the result
    #[arg(short, long)]
    quiet: bool,
}

/// Balls beside and inside each other, in a shell cut open.
const VOLUME: &str = "formula:spheres:128";
/// Flags of `render` for the demo.
const FLAGS: [&str; 6] = ["--frames", "12", "--elevation", "25", "--size", "400x400"];

/// Runs the command.
pub(crate) fn run(args: &DemoArgs) -> Result<(), Fail> {
    let own = PathBuf::from("slabcast-demo/");
    let folder = args.output.as_ref().unwrap_or(&own);
    let mut line: Vec<OsString> = vec!["render".into(), VOLUME.into(), "-o".into(), folder.into()];
    line.extend(FLAGS.map(OsString::from));
    // Its own folder is the demo's to write again; another may hold something else.
    if args.output.is_none() {
        line.push("--force".into());
    }
    if args.quiet {
        line.push("--quiet".into());
    }
    let command = RenderArgs::augment_args(clap::Command::new("render"));
    let matches = command.try_get_matches_from(line).map_err(|e| Fail::failed(e.to_string()))?;
    let render = RenderArgs::from_arg_matches(&matches).map_err(|e| Fail::failed(e.to_string()))?;
    render::run(&render)?;
    let flags = FLAGS.join(" ");
    say(&format!(
        "\nThat was: slabcast render {VOLUME} {flags}\n\
         Next:     slabcast render FILE              any volume, like brain.nii.gz\n\
         \x20         slabcast info FILE                what is in it\n\
         \x20         slabcast render --help            views, colours, formats\n"
    ))
}
