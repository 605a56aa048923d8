//! `slabcast tf`: transfer functions as files, for people who want to change one, and for ParaView.

use slabcast_common::transfer::TransferFunction;
use slabcast_common::volume::{Digest32, Volume};
use slabcast_common::volume::{Samples, ValueMap, ValueSummary, VolumeInfo};
use slabcast_scene::paraview;
use slabcast_scene::presets;
use slabcast_session::fail::{Fail, say};
use slabcast_session::output::write_atomic;
use slabcast_session::transfer::{NameOrFile, Transfer, TransferFlags, in_values};
use slabcast_session::volume::InputArgs;
use std::io::Write;
use std::path::PathBuf;

/// Writes a transfer function as JSON, to change by hand.
///
/// A preset or map fitted to a volume, or a file of ours or of ParaView's, with what flags change
/// of it.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast tf --list                                    presets and colour maps
  slabcast tf bone ct.nrrd > bone.json                  to change it by hand
  slabcast tf bone ct.nrrd --paraview -o bone-pv.json   for ParaView's colour map editor
  slabcast tf from-paraview.json > ours.json            and back; --tf takes either
  slabcast tf vessels ct.nrrd --colors plasma -o hot.json
  slabcast tf engine scan.raw --dims 256x256x128 --type uint8

In a file without a volume, 0 is the smallest and 1 the largest value. ParaView's files hold
colours, opacities and the colour of NaN; light and gradients stay with ours.")]
pub(crate) struct TfArgs {
    /// A preset, a colour map or a JSON file
    #[arg(required_unless_present = "list", value_parser = NameOrFile::TRANSFER,
          hide_possible_values = true)]
    tf: Option<String>,
    /// The volume that it is fitted to; its values are x then
    volume: Option<PathBuf>,
    #[command(flatten)]
    input: InputArgs,
    #[command(flatten)]
    flags: TransferFlags,
    /// For ParaView: a list of one colour map, with RGBPoints and Points
    #[arg(long)]
    paraview: bool,
    /// File to write [default: stdout]
    #[arg(short, long, value_name = "FILE.json")]
    output: Option<PathBuf>,
    /// Replace a file that is there already
    #[arg(long)]
    force: bool,
    /// Only list presets and colour maps
    #[arg(long, conflicts_with_all = ["tf", "volume", "paraview", "output"])]
    list: bool,
}

/// Runs the command.
pub(crate) fn run(args: &TfArgs) -> Result<(), Fail> {
    let Some(name) = args.tf.as_ref().filter(|_| !args.list) else { return say(&list()) };
    let transfer = Transfer::parse(name, &args.flags)?;
    if let Some(path) = &args.output
        && path.exists()
        && !args.force
    {
        return Err(Fail::failed(format!(
            "{}: is there already; add --force to replace it, or give another -o",
            path.display()
        )));
    }
    let info = match &args.volume {
        Some(file) => Some(args.input.open(file)?.info(Digest32::default())),
        None if !args.input.is_empty() => {
            return Err(Fail::usage(
                "VOLUME: flags say how to read it, but none is given; give the file, too",
            ));
        }
        None => None,
    };
    let refused = |e| Fail::failed(format!("{name}: {e}"));
    let tf = transfer.function(info.as_ref().unwrap_or(&any())).map_err(refused)?;
    let range = info.as_ref().map(|i| i.summary.range());
    let text = if args.paraview {
        paraview::to_json(&tf, &transfer.title(), range).map_err(refused)?
    } else {
        pretty(&info.as_ref().map_or_else(|| tf.clone(), |info| in_values(&tf, info)))
    };
    match &args.output {
        None => say(&text),
        Some(path) => write_atomic(path, |out| out.write_all(text.as_bytes())),
    }
}

/// A volume of which nothing is known: presets over 0 to 1.
fn any() -> VolumeInfo {
    let samples = Samples::U8((0..=255).collect());
    let summary = ValueSummary::from_samples(&samples, ValueMap::IDENTITY);
    let volume = Volume::from_fn_u8("any", [1; 3], |_, _, _| 0);
    VolumeInfo { summary, ..volume.info(Digest32::default()) }
}

/// A point a line.
fn pretty(tf: &TransferFunction) -> String {
    let value = serde_json::to_value(tf).expect("numbers and strings can be written");
    let serde_json::Value::Object(fields) = value else { unreachable!("a struct is an object") };
    let mut lines = Vec::new();
    // In the order of the README, which is that of the struct.
    for key in [
        "version",
        "domain",
        "colors",
        "opacities",
        "color_space",
        "opacity_unit",
        "nan",
        "gradient_opacity",
        "shading",
    ] {
        let Some(value) = fields.get(key) else { continue };
        let text = match value {
            serde_json::Value::Array(points) => {
                let points: Vec<String> = points.iter().map(|p| format!("    {p}")).collect();
                format!("[\n{}\n  ]", points.join(",\n"))
            }
            other => other.to_string(),
        };
        lines.push(format!("  \"{key}\": {text}"));
    }
    format!("{{\n{}\n}}\n", lines.join(",\n"))
}

fn list() -> String {
    let line = |(name, what): &(&str, &str)| format!("  {name:<13} {what}\n");
    let presets: String = presets::NAMES.iter().map(line).collect();
    let maps: String = presets::MAPS.iter().map(line).collect();
    format!(
        "presets, fitted to a volume's histogram or Hounsfield units:\n{presets}colour maps, as fog \
         with --tf, or as colours of another with --colors:\n{maps}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_again() {
        let summary = any().summary;
        for (name, _) in presets::NAMES.iter().chain(&presets::MAPS) {
            let tf = presets::by_name(name, &summary).unwrap();
            assert_eq!(TransferFunction::from_json(&pretty(&tf)).unwrap(), tf, "{name}");
        }
    }
}
