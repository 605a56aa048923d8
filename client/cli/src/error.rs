//! `slabcast error`: how far a picture is from the truth, and why.
//!
//! The truth is the reference (a gather in f64 along true rays, which shares nothing with the
//! splatter) at a stratified sample of pixels. Sources are found by switching the others off:
//! each row below compares two pictures that differ in that source alone.

use crate::fail::{Fail, say};
use crate::local::{self, Cut};
use crate::progress::{self, Progress};
use crate::request::{Asked, PictureArgs, QualityArgs, ViewArgs, lattice_notice};
use crate::volume;
use slabcast_common::ids::SceneId;
use slabcast_common::image::Picture;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Quality, Sums, Work};
use slabcast_common::transfer::Classifier;
use slabcast_common::view::View;
use slabcast_render::reference::{ErrorFigures, Reference, stratified};
use slabcast_render::{Frame, Scene};
use slabcast_volumes::BrickStore;
use std::fmt::Write;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Says how far a picture is from the truth, in 1/255, and what the error is made of.
///
/// The first view of the path is rendered and compared, at a stratified sample of pixels, with a
/// reference that integrates along true rays in double precision. Errors are of linear
/// premultiplied RGBA over the pixels where either is not blank.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast error brain.nii.gz
  slabcast error brain.nii.gz --tf peer-semi --thickness 0.5 --azimuth 30
  slabcast error brain.nii.gz --compositing paper --pixels 16384 --json")]
pub(crate) struct ErrorArgs {
    /// NRRD (.nrrd, .nhdr) or NIfTI (.nii, .nii.gz) file, or formula:NAME
    volume: PathBuf,
    #[command(flatten)]
    view: ViewArgs,
    #[command(flatten)]
    picture: PictureArgs,
    #[command(flatten)]
    quality: QualityArgs,
    /// Pixels to compare; all of them if there are no more
    #[arg(long, value_name = "N", default_value = "4096",
          value_parser = clap::value_parser!(u32).range(1..=1 << 26))]
    pixels: u32,
    /// Which sample of pixels
    #[arg(long, value_name = "N", default_value = "1")]
    seed: u64,
    /// Threads [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// One comparison.
struct Row {
    name: &'static str,
    what: &'static str,
    figures: ErrorFigures,
}

/// Runs the command.
pub(crate) fn run(args: &ErrorArgs) -> Result<(), Fail> {
    let asked = Asked::new(&args.view, &args.picture, &args.quality, Work::default())?;
    let orientation = args.view.axes.orientation()?;
    let threads = args.threads.map_or_else(
        || std::thread::available_parallelism().map_or(1, |n| n.get()),
        |n| n as usize,
    );
    let volume = volume::open(&args.volume)?;
    let info = volume.info(volume.digest());
    asked.fit(&info, orientation)?;
    if let Some(notice) = lattice_notice(&info) {
        progress::note(&notice);
    }
    let transfer = asked.transfer.function(&info).map_err(|e| asked.blame(&e))?;
    let camera = asked.path.camera(0, &info.lattice, orientation).map_err(|e| asked.blame(&e))?;
    let size = asked.path.size;
    let view =
        View::new(&info.lattice, &camera, size, &asked.quality).map_err(|e| asked.blame(&e))?;
    let classifier = Classifier::new(&transfer, &info, asked.quality.compositing);
    let sums = classifier.sums(asked.quality.sums).map_err(|e| asked.blame(&e))?;
    let (support, normals) = (classifier.support(), transfer.shading.on);
    let store = BrickStore::build(&volume, info.digest, &support, normals);
    let bricks: Vec<_> = store.infos().iter().filter_map(|i| store.brick(i.id).cloned()).collect();
    let spec = SceneSpec {
        id: SceneId(0),
        volume: info,
        transfer,
        quality: Quality { sums, ..asked.quality },
        bricks: store.key(),
    };

    let mut progress = Progress::new(false).of("pixel");
    let began = Instant::now();
    let draw = |quality: Quality| {
        let spec = SceneSpec { quality, ..spec.clone() };
        let began = Instant::now();
        let picture = local::picture(
            &Frame::new(Arc::new(Scene::new(&spec)), view),
            &bricks,
            Cut::on(threads),
        );
        (picture, began.elapsed())
    };
    let (asked_for, drawn) = draw(spec.quality);
    let open = Quality { eps: 0.0, ..spec.quality };
    let (never_shut, _) = draw(open);
    let (floats, _) = draw(Quality { sums: Sums::F32, ..open });

    let sample = stratified(size, args.pixels as usize, args.seed);
    progress.frames(sample.len() as u64, &format!("{} pixels of the reference", sample.len()));
    let reference = Reference::new(&spec, view, &bricks);
    let judged = Instant::now();
    let truth = local::judge(&sample, threads, &mut progress, |[x, y]| {
        (reference.pixel(x, y), reference.at_same_thickness(x, y))
    });
    let judged = judged.elapsed();
    progress.end();

    let (limit, sheets): (Vec<_>, Vec<_>) = truth.into_iter().unzip();
    let at = |p: &Picture| -> Vec<[f32; 4]> {
        sample.iter().map(|[x, y]| p.pixels[(y * size[0] + x) as usize]).collect()
    };
    let compare =
        |got: &[[f32; 4]], want: &[[f64; 4]]| ErrorFigures::compare(got, want, asked.background);
    let narrow =
        |p: &[[f64; 4]]| -> Vec<[f32; 4]> { p.iter().map(|c| c.map(|x| x as f32)).collect() };
    let widen = |p: &[[f32; 4]]| -> Vec<[f64; 4]> { p.iter().map(|c| c.map(f64::from)).collect() };
    let (got, opened, floated) = (at(&asked_for), at(&never_shut), at(&floats));
    let rows = [
        Row { name: "limit", what: "against the limit: all of it", figures: compare(&got, &limit) },
        Row {
            name: "same_thickness",
            what: "against the same sheets in f64, nothing shut",
            figures: compare(&got, &sheets),
        },
        Row {
            name: "thickness",
            what: "of which: sheets of finite thickness",
            figures: compare(&narrow(&sheets), &limit),
        },
        Row {
            name: "cutoff",
            what: "pixels shut before they are opaque",
            figures: compare(&got, &widen(&opened)),
        },
        Row {
            name: "quantisation",
            what: "sums of integers",
            figures: compare(&opened, &widen(&floated)),
        },
        Row { name: "rounding", what: "positions and f32", figures: compare(&floated, &sheets) },
    ];
    if args.json {
        return say(&format!("{}\n", json(&rows, drawn, judged, sample.len())));
    }
    say(&text(&rows, drawn, judged, began.elapsed(), asked_for.pixels.len()))
}

fn text(
    rows: &[Row; 6],
    drawn: Duration,
    judged: Duration,
    total: Duration,
    pixels: usize,
) -> String {
    let compared = rows[0].figures.n_pixels;
    let mut out = String::from("in 1/255           RMSE      max   off by > 1   8-bit RMSE\n");
    for r in rows {
        let f = &r.figures;
        let _ = writeln!(
            out,
            "{:<14} {:>8} {:>8}   {:>9.3} %   {:>10}   {}",
            r.name.replace('_', " "),
            number(f.rmse),
            number(f.max),
            f.share_above_1 * 100.0,
            number(f.rmse_srgb8),
            r.what
        );
    }
    let parts: f64 = rows[2..].iter().map(|r| r.figures.rmse * r.figures.rmse).sum();
    let _ = writeln!(
        out,
        "sources together: {} (root of the sum of squares), measured {}",
        number(parts.sqrt()),
        number(rows[0].figures.rmse)
    );
    let _ = writeln!(
        out,
        "{compared} pixels that are not blank, of {pixels}; drawn in {}, judged in {}, {} in all",
        progress::time(drawn),
        progress::time(judged),
        progress::time(total)
    );
    out
}

/// Three digits, wherever they begin.
fn number(x: f64) -> String {
    if x == 0.0 {
        "0".into()
    } else if x < 1e-3 {
        format!("{x:.1e}")
    } else if x < 1.0 {
        format!("{x:.4}")
    } else {
        format!("{x:.3}")
    }
}

fn json(rows: &[Row; 6], drawn: Duration, judged: Duration, sampled: usize) -> String {
    let mut out = serde_json::Map::new();
    for r in rows {
        let f = &r.figures;
        let figures = serde_json::json!({
            "rmse": f.rmse, "max": f.max, "share_above_1": f.share_above_1,
            "rmse_srgb8": f.rmse_srgb8, "pixels": f.n_pixels
        });
        out.insert(r.name.into(), figures);
    }
    out.insert("sampled".into(), sampled.into());
    out.insert("draw_ms".into(), (drawn.as_secs_f64() * 1e3).into());
    out.insert("judge_ms".into(), (judged.as_secs_f64() * 1e3).into());
    serde_json::Value::Object(out).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_three_digits() {
        let text = [0.0, 4.2e-5, 0.0123, 0.5, 12.3456].map(number);
        assert_eq!(text, ["0", "4.2e-5", "0.0123", "0.5000", "12.346"]);
    }
}
