//! `slabcast info`: what is in a file, before anybody waits for a picture of it.

use crate::orient;
use glam::DVec3;
use slabcast_common::brick::{BRICK_VOXELS, BrickGrid};
use slabcast_common::quality::Compositing;
use slabcast_common::transfer::Classifier;
use slabcast_common::volume::{Digest32, Lattice, ValueSummary, Volume, VolumeInfo};
use slabcast_scene::path::Orientation;
use slabcast_scene::presets::{self, Levels};
use slabcast_session::fail::{Fail, say};
use slabcast_session::output::free_name;
use slabcast_session::progress::bytes;
use slabcast_session::request::AxisArgs;
use slabcast_session::volume;
use std::fmt::Write;
use std::path::PathBuf;

/// Shows what is in a volume file.
///
/// Size, orientation, values, and what each preset would draw.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast info brain.nii.gz
  slabcast info brain.nii.gz --json | jq .presets
  slabcast info head.raw --orient          which way is up? all 24 in orient.png")]
pub(crate) struct InfoArgs {
    #[arg(help = volume::VOLUME)]
    volume: PathBuf,
    #[command(flatten)]
    axes: AxisArgs,
    #[command(flatten)]
    input: volume::InputArgs,
    /// Draw all ways in which it may stand on one picture [default: orient.png]
    ///
    /// For files that do not say what is up: each of the 24 has the --up and --front that mean it.
    #[arg(long, value_name = "FILE.png", num_args = 0..=1, require_equals = true,
          default_missing_value = "", value_parser = orient_file)]
    orient: Option<PathBuf>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Parses the file of `--orient`; empty is the usual one.
fn orient_file(text: &str) -> Result<PathBuf, String> {
    if text.is_empty() { Ok(PathBuf::new()) } else { slabcast_session::parse::png(text) }
}

/// Share of the volume that a preset draws.
struct Share {
    name: &'static str,
    what: &'static str,
    voxels: u64,
    /// Bytes of its bricks on a worker, about.
    bytes: u64,
}

/// Runs the command.
pub(crate) fn run(args: &InfoArgs) -> Result<(), Fail> {
    args.axes.orientation()?;
    let volume = args.input.open(&args.volume)?;
    let orientation = args.axes.for_volume(&volume)?;
    // JSON alone has the digest; what `--orient` draws is nobody's but its own.
    let info = volume.info(if args.json { volume.digest() } else { Digest32::default() });
    if let Some(path) = &args.orient {
        if volume.anatomical {
            return Err(Fail::usage(
                "--orient: the file itself says what is up and in front; there is nothing to guess",
            ));
        }
        let own = path.as_os_str().is_empty();
        let path = &if own { free_name("orient.png".as_ref()) } else { path.clone() };
        if path.exists() {
            return Err(Fail::failed(format!(
                "{}: is there already; remove it, or give --orient=OTHER.png",
                path.display()
            )));
        }
        return orient::draw(&volume, &info, path);
    }
    let shares = shares(&volume, &info)?;
    let levels = levels(&args.volume);
    if args.json {
        let mut json = json(&volume, &info, orientation, &shares);
        if !levels.is_empty() {
            json["levels"] =
                levels.iter().map(|l| serde_json::json!({"dims": l.0, "spacing": l.1})).collect();
        }
        return say(&format!("{json:#}\n"));
    }
    let mut text = text(&volume, &info, orientation, &shares);
    for (i, (dims, spacing)) in levels.iter().enumerate() {
        let [nx, ny, nz] = dims;
        let name = if i == 0 { "levels" } else { "" };
        // Writing to a string does not fail.
        let _ = writeln!(
            text,
            "{name:<12} {i}: {nx} x {ny} x {nz}, spacing {}",
            triple(*spacing, " x ")
        );
    }
    say(&text)
}

/// Returns samples and spacing of each level of a file with a pyramid.
fn levels(path: &std::path::Path) -> Vec<([u64; 3], [f64; 3])> {
    #[cfg(feature = "zarr")]
    let levels = slabcast_volumes::blocks::ome_zarr::level_sizes(path);
    #[cfg(not(feature = "zarr"))]
    let levels = None;
    let _ = path;
    levels.unwrap_or_default()
}

/// Samples that are visible under each preset.
fn shares(volume: &Volume, info: &VolumeInfo) -> Result<Vec<Share>, Fail> {
    // Samples of few codes are counted once, for all presets.
    let counts = volume.codes().code_counts();
    presets::NAMES
        .iter()
        .map(|&(name, what)| {
            let tf = presets::by_name(name, &info.summary).map_err(|e| Fail::flag(&e))?;
            let c = Classifier::new(&tf, info, Compositing::Linear);
            let voxels = match (&counts, &volume.samples) {
                (Some(counts), _) => {
                    let visible = |(look, n): (&slabcast_common::transfer::OpticalSample, &u64)| {
                        if look.sigma > 0.0 { *n } else { 0 }
                    };
                    c.table().iter().zip(counts).map(visible).sum()
                }
                (None, samples) => (0..samples.len())
                    .filter(|&i| c.classify(samples, i).sigma > 0.0)
                    .count() as u64,
            };
            let each =
                2 + info.summary.code_kind().bytes() as u64 + if tf.shading.on { 2 } else { 0 };
            Ok(Share { name, what, voxels, bytes: voxels * each })
        })
        .collect()
}

/// The box of the volume's cells (N samples count as N spacings), in world units.
fn world_box(lattice: &Lattice) -> [DVec3; 2] {
    let half = lattice.steps.iter().zip(lattice.dims).map(|(s, n)| s.abs() * f64::from(n) / 2.0);
    let half = half.fold(DVec3::ZERO, |sum, h| sum + h);
    [lattice.centre() - half, lattice.centre() + half]
}

/// Returns the world axis nearest to an index axis, its sign, and whether both are parallel.
fn along(step: DVec3) -> (usize, bool, bool) {
    let a = step.abs();
    let axis = if a.x >= a.y && a.x >= a.z {
        0
    } else if a.y >= a.z {
        1
    } else {
        2
    };
    let straight = a[axis] >= step.length() * 0.999_999;
    (axis, step[axis] < 0.0, straight)
}

const ANATOMY: [[&str; 2]; 3] =
    [["left", "right"], ["posterior", "anterior"], ["inferior", "superior"]];

fn anatomy(axis: slabcast_scene::path::Axis) -> &'static str {
    ANATOMY[axis.index][usize::from(!axis.negative)]
}

fn number(x: f64) -> String {
    let size = x.abs();
    if x == 0.0 || (1e-3..1e7).contains(&size) {
        let s = format!("{x:.4}");
        s.trim_end_matches('0').trim_end_matches('.').to_string()
    } else {
        format!("{x:.4e}")
    }
}

fn triple(v: [f64; 3], between: &str) -> String {
    v.map(number).join(between)
}

/// A share in percent with two digits that mean something.
fn percent(part: u64, whole: u64) -> String {
    let p = 100.0 * part as f64 / whole.max(1) as f64;
    match p {
        _ if part == 0 => "none".into(),
        _ if p >= 9.95 => format!("{p:.0} %"),
        _ if p >= 0.995 => format!("{p:.1} %"),
        _ if p >= 0.01 => format!("{p:.2} %"),
        _ => "< 0.01 %".into(),
    }
}

/// Says what presets are fitted to.
fn fitted_to(s: &ValueSummary) -> String {
    let levels = Levels::from_summary(s);
    let mut text = match levels.water {
        Some(water) => format!("Hounsfield units, as of a CT (water is {})", number(water)),
        None => format!("histogram: {}", levels.content.what()),
    };
    if let Some(core) = s.core.as_ref().map(|_| s.core_range()) {
        let _ = write!(
            text,
            "; nearly all values are {} to {}, the rest left out",
            number(core.0),
            number(core.1)
        );
    }
    if !s.anatomical && levels.water.is_none() {
        text += "; not known to be a body, so auto is grey";
    }
    text
}

/// Bytes that a master and a worker hold beside samples and bricks, for pictures of 512x512: three
/// frames in flight, streams, tables. Measured on mri256, chris_t1, aneurism and lidc0314 with
/// 1 and 2 threads (VmHWM less samples and bricks): 55 to 65 MiB and 25 to 32 MiB. A master's
/// part grows with the picture, by 3.7 GiB at 8192x8192.
const MASTER_BASE: u64 = 60 << 20;
const WORKER_BASE: u64 = 30 << 20;

fn text(volume: &Volume, info: &VolumeInfo, o: Orientation, shares: &[Share]) -> String {
    let lattice = &info.lattice;
    let s = &info.summary;
    let [nx, ny, nz] = lattice.dims;
    let unit = if volume.anatomical { " mm" } else { "" };
    let [lo, hi] = world_box(lattice).map(|v| v.to_array());
    let mut out = String::new();
    let mut row = |name: &str, value: String| {
        // Writing to a string does not fail.
        let _ = writeln!(out, "{name:<12} {value}");
    };
    row("volume", volume.name.clone());
    row("samples", format!("{nx} x {ny} x {nz} {}", volume.file_type));
    row("spacing", format!("{}{unit}", triple(lattice.spacing(), " x ")));
    row("world box", format!("{} to {}{unit}", triple(lo, ", "), triple(hi, ", ")));
    for (name, step) in ["i", "j", "k"].iter().zip(lattice.steps) {
        let (axis, negative, straight) = along(step);
        let sign = if negative { '-' } else { '+' };
        let about = if straight { "" } else { "about " };
        let world = format!("{about}{sign}{}", ["x", "y", "z"][axis]);
        let [from, to] = ANATOMY[axis];
        let (from, to) = if negative { (to, from) } else { (from, to) };
        row(
            if *name == "i" { "index axes" } else { "" },
            if volume.anatomical {
                format!("{name} runs {world}, from {from} to {to}")
            } else {
                format!("{name} runs {world}")
            },
        );
    }
    row(
        "turntable",
        if volume.anatomical {
            format!("up {} ({}), front {} ({})", o.up, anatomy(o.up), o.front, anatomy(o.front))
        } else {
            format!(
                "up {}, front {}; the file does not say what is up: see --orient, --up and --front",
                o.up, o.front
            )
        },
    );
    let (lo, hi) = s.range();
    let mut values = match s.total() == s.nan + s.infinite {
        true => "none that is finite".to_string(),
        false => format!("{} to {}", number(lo), number(hi)),
    };
    // A shift alone is how signed numbers are stored: nothing to tell.
    if s.map.scale != 1.0 {
        let _ = write!(
            values,
            " (value = {} + {} x stored)",
            number(s.map.offset),
            number(s.map.scale)
        );
    }
    if let Some(palette) = &s.palette {
        let colours = palette.colours().len();
        row("colours", format!("{}, 8 bits; {colours} of them", palette.channels_name()));
        let _ = write!(values, ", the {} that opacity follows", palette.value().name());
    }
    row("values", values);
    if s.nan + s.infinite > 0 {
        row("", format!("{} NaN, {} infinite", s.nan, s.infinite));
    }
    row("air ends at", number(presets::air_end(s)));
    row("presets by", fitted_to(s));
    let sketch = slabcast_volumes::histogram_sketch(s, 60);
    for (i, line) in sketch.lines().enumerate() {
        row(if i == 0 { "histogram" } else { "" }, line.to_string());
    }
    let total = lattice.len() as u64;
    let _ = writeln!(out, "{:<12} {:>8}   {:>9}", "preset", "visible", "bricks");
    for share in shares {
        let _ = writeln!(
            out,
            "  {:<12} {:>6}   {:>9}   {}",
            share.name,
            percent(share.voxels, total),
            bytes(share.bytes),
            share.what
        );
    }
    let auto = shares.first().map_or(0, |s| s.bytes);
    let _ = writeln!(
        out,
        "{:<12} master about {}, each worker up to {} for --tf auto at 512x512",
        "memory",
        bytes(volume.memory_bytes() + auto + MASTER_BASE),
        bytes(auto + WORKER_BASE),
    );
    out
}

fn json(volume: &Volume, info: &VolumeInfo, o: Orientation, shares: &[Share]) -> serde_json::Value {
    let lattice = &info.lattice;
    let s = &info.summary;
    let (lo, hi) = s.range();
    let total = lattice.len() as u64;
    let grid = BrickGrid::new(lattice.dims);
    serde_json::json!({
        "version": 1,
        "name": volume.name,
        "file_type": volume.file_type,
        "stored_as": s.kind,
        "anatomical": volume.anatomical,
        "digest": info.digest.to_string(),
        "dims": lattice.dims,
        "spacing": lattice.spacing(),
        "steps": lattice.steps.map(|v| v.to_array()),
        "origin": lattice.origin.to_array(),
        "world_box": world_box(lattice).map(|v| v.to_array()),
        "isotropic": lattice.is_isotropic(),
        "index_axes": lattice.steps.map(|step| {
            let (axis, negative, _) = along(step);
            format!("{}{}", if negative { '-' } else { '+' }, ["x", "y", "z"][axis])
        }),
        "up": o.up,
        "front": o.front,
        "values": {
            "min": lo, "max": hi, "scale": s.map.scale, "offset": s.map.offset,
            "nan": s.nan, "infinite": s.infinite,
            "air_ends": presets::air_end(s),
            "histogram": s.histogram,
        },
        "colours": s.palette.as_ref().map(|palette| serde_json::json!({
            "channels": palette.channels_name(), "bits": 8, "count": palette.colours().len(),
            "opacity_by": palette.value().name(),
        })),
        "presets_by": presets_by(s),
        "bricks": { "edge": 8, "count": grid.len(), "voxels": BRICK_VOXELS },
        "presets": shares.iter().map(|p| serde_json::json!({
            "name": p.name, "for": p.what, "visible": p.voxels,
            "share": p.voxels as f64 / total as f64, "brick_bytes": p.bytes,
        })).collect::<Vec<_>>(),
        "memory_bytes": {
            "samples": volume.memory_bytes(),
            "bricks_auto": shares.first().map_or(0, |s| s.bytes),
        },
    })
}

/// Returns the summary of the values that presets are fitted to, as JSON.
fn presets_by(s: &ValueSummary) -> serde_json::Value {
    let levels = Levels::from_summary(s);
    let (from, to) = s.core_range();
    serde_json::json!({
        "rule": if levels.water.is_some() { "hounsfield" } else { "histogram" },
        "water": levels.water,
        "content": levels.content.name(),
        "body": s.anatomical || levels.water.is_some(),
        "range": [from, to],
        "outliers_left_out": s.core.is_some(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_keep_two_digits_that_mean_something() {
        let s = |part| percent(part, 1_000_000);
        assert_eq!(
            [s(0), s(1), s(1234), s(23_456), s(345_678), s(1_000_000)],
            ["none", "< 0.01 %", "0.12 %", "2.3 %", "35 %", "100 %"]
        );
    }

    #[test]
    fn the_worlds_box_counts_cells() {
        let l = Lattice::from_spacing([4, 2, 1], [1.0, 2.0, 3.0]);
        let [lo, hi] = world_box(&l);
        assert_eq!((lo, hi), (DVec3::new(-0.5, -1.0, -1.5), DVec3::new(3.5, 3.0, 1.5)));
    }

    #[test]
    fn axes_are_named_by_where_they_go() {
        assert_eq!(along(DVec3::new(0.0, -2.0, 0.0)), (1, true, true));
        assert_eq!(along(DVec3::new(0.1, 0.0, 2.0)), (2, false, false));
    }

    #[test]
    fn every_kind_of_volume_is_described() {
        for name in ["formula:wall:16", "formula:ramp:8", "formula:blob:8", "formula:one"] {
            let volume = volume::open(name.as_ref()).unwrap();
            let info = volume.info(volume.digest());
            let shares = shares(&volume, &info).unwrap();
            let o = Orientation::new(None, None).unwrap();
            assert!(text(&volume, &info, o, &shares).contains("presets by   histogram"), "{name}");
            let json = json(&volume, &info, o, &shares);
            assert_eq!(
                (&json["version"], &json["presets_by"]["rule"]),
                (&1.into(), &"histogram".into())
            );
        }
    }
}
