//! `slabcast lab check convergence`: how fast pictures converge with thinner sheets, and what
//! limits it.
//!
//! The model says: with one colour in a sheet the error falls with the square of the thickness,
//! with the linear rule with up to its fourth power, and the paper's additive opacity with its
//! first, to another picture. Here each is rendered at one thickness after another, nothing shut,
//! and compared with the reference at a sample of pixels. Beside it stand the same sheets in f64,
//! where thickness is the only error; what lies between the two is rounding, and is told apart
//! into positions, f32 arithmetic and integer sums, each by switching the others off.
//!
//! Scenes that are classified after reconstruction have one rule; 32-bit and 16-bit sums are
//! compared with the limit of that order ([`field`]).

mod field;
mod sweep;

use super::case::number;
use super::scenes::SCENES;
use crate::plot;
use slabcast_common::quality::{Classify, Quality, Work};
use slabcast_common::transfer::TransferFunction;
use slabcast_scene::path::{Orientation, ProjectionKind, Turntable, ViewPath};
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::{self, Progress};
use slabcast_session::request::{RenderRequest, SceneArgs, ThreadArgs};
use slabcast_session::volume;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;
use sweep::{Deviation, Sweep, SweepScene};

/// Says how fast pictures come to the limit as sheets become thinner, and what stops them.
///
/// Without VOLUME: the scenes by formula. Errors are RMSE in 1/255 over a sample of pixels, from
/// thick sheets to thin ones; `order` is the power of the thickness with which the error fell
/// from the line before. Nothing is shut. A turn is seen in both projections, whatever
/// --projection says. With `--classify before` the compositing rules are compared and roundings
/// told apart.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast lab check convergence
  slabcast lab check convergence brain.nii.gz --tf brain --azimuth 30 --size 256x256
  slabcast lab check convergence brain.nii.gz --plot plots/ --json")]
pub(crate) struct ConvergenceArgs {
    /// NRRD (.nrrd, .nhdr) or NIfTI (.nii, .nii.gz) files, or formula:NAME
    volumes: Vec<PathBuf>,
    #[command(flatten)]
    scene: SceneArgs,
    /// Pixels to compare; all of them if there are no more
    #[arg(long, value_name = "N", default_value = "512",
          value_parser = clap::value_parser!(u32).range(1..=1 << 26))]
    pixels: u32,
    /// Seed of the sample of pixels
    #[arg(long, value_name = "N", default_value = "1")]
    seed: u64,
    /// The thinnest sheets are 1/N vox thick, N a power of two
    #[arg(long, value_name = "N", default_value = "32",
          value_parser = clap::value_parser!(u32).range(1..=64))]
    thinnest: u32,
    /// In perspective, also with sections placed otherwise than drawn, in f64
    #[arg(long)]
    placement: bool,
    /// Write a figure for each scene into this folder, as SVG
    #[arg(long, value_name = "DIR")]
    plot: Option<PathBuf>,
    #[command(flatten)]
    threads: ThreadArgs,
    /// One line of JSON a scene and projection
    #[arg(long)]
    json: bool,
}

/// Pictures of the scenes by formula: 3 to 4 pixels a voxel.
const FORMULA_SIZE: [u32; 2] = [96, 96];

/// Runs the command.
pub(crate) fn run(args: &ConvergenceArgs) -> Result<(), Fail> {
    if !args.thinnest.is_power_of_two() {
        return Err(Fail::usage(format!(
            "--thinnest: {} is not a power of two; give 1, 2, 4, 8, 16, 32 or 64",
            args.thinnest
        )));
    }
    let request = args.scene.request(Work::default())?;
    let orientation = args.scene.view.axes.orientation()?;
    let threads = args.threads.count();
    let thicknesses: Vec<f64> =
        (0..=args.thinnest.ilog2() + 1).map(|i| 2.0 / f64::from(1u32 << i)).collect();
    if let Some(folder) = &args.plot {
        std::fs::create_dir_all(folder).map_err(|e| Fail::io(folder, "creating", &e))?;
    }
    let began = Instant::now();
    let mut progress = Progress::new(args.json).counting("sweep");
    let scenes = subjects(args, &request, orientation)?;
    progress.frames(scenes.iter().map(|s| s.1.len() as u64).sum(), "sweeps");
    let mut done = 0;
    for (subject, paths) in scenes {
        let subject = subject()?;
        let mut sweeps = Vec::new();
        for (name, path) in &paths {
            let camera = path.camera(0, &subject.info.lattice, orientation);
            let camera = camera.map_err(|e| request.blame(&e))?;
            if subject.quality.classify == Classify::After {
                let (of, thicknesses) = (&subject, &thicknesses[..]);
                let swept = field::sweep(of, name, &camera, thicknesses, threads, &mut progress)?;
                let shown = if args.json { swept.json() } else { swept.text() };
                progress.suspend(|| say(&shown))?;
                done += 1;
                progress.step(progress::Step { frames: done, ..Default::default() });
                continue;
            }
            let placed = args.placement && *name == "persp";
            let swept = sweep::sweep(
                &subject,
                name,
                &camera,
                &thicknesses,
                placed,
                threads,
                &mut progress,
            )?;
            let shown = if args.json { json(&swept) } else { text(&swept) };
            progress.suspend(|| say(&shown))?;
            sweeps.push(swept);
            done += 1;
            progress.step(progress::Step { frames: done, ..Default::default() });
        }
        if let Some(folder) = args.plot.as_ref().filter(|_| !sweeps.is_empty()) {
            let file = folder.join(format!("{}.svg", subject.name));
            draw(&sweeps, &file)?;
        }
    }
    progress.end();
    if args.json {
        return Ok(());
    }
    say(&format!("{done} sweeps; {}\n", progress::time(began.elapsed())))
}

type Views = Vec<(&'static str, ViewPath)>;
type OutputFolder<'a> = Box<dyn Fn() -> Result<SweepScene, Fail> + 'a>;

/// Returns the scenes to sweep, each made when needed, with its views.
fn subjects<'a>(
    args: &'a ConvergenceArgs,
    request: &'a RenderRequest,
    orientation: Orientation,
) -> Result<Vec<(OutputFolder<'a>, Views)>, Fail> {
    let both = |path: &ViewPath| -> Views {
        let turned = |projection| {
            let turntable = path.turntable.map(|t| Turntable { projection, ..t });
            ViewPath { turntable, ..path.clone() }
        };
        if path.turntable.is_none() {
            return vec![("as given", path.clone())];
        }
        vec![("ortho", turned(ProjectionKind::Ortho)), ("persp", turned(ProjectionKind::Persp))]
    };
    let subject = move |name: String, file: &Path, transfer: Option<&str>, size, quality| {
        let volume = volume::open(file)?;
        let info = volume.info(volume.digest());
        let transfer = match transfer {
            Some(json) => TransferFunction::from_json(json)
                .map_err(|e| Fail::failed(format!("{name}: {e}")))?,
            None => {
                request.clone().fit(&info, orientation, volume.anatomical)?;
                request.transfer.function(&info).map_err(|e| request.blame(&e))?
            }
        };
        let pixels = args.pixels as usize;
        let quality = Quality::for_volume(quality, &info.summary);
        Ok(SweepScene { name, volume, info, transfer, quality, size, pixels, seed: args.seed })
    };
    if args.volumes.is_empty() {
        // An oblique view, so that nothing falls on a sheet boundary by chance.
        let turn = Turntable { start: 25.0, elevation: 20.0, frames: 1, ..Turntable::default() };
        let views = both(&ViewPath::from_turntable(FORMULA_SIZE, turn));
        return Ok(SCENES
            .iter()
            .map(|scene| {
                let make = move || {
                    let file = Path::new(scene.volume);
                    let (name, tf) = (scene.name.to_string(), Some(scene.transfer));
                    subject(name, file, tf, FORMULA_SIZE, request.quality)
                };
                (Box::new(make) as OutputFolder, views.clone())
            })
            .collect());
    }
    Ok(args
        .volumes
        .iter()
        .map(|file| {
            let make =
                move || subject(file_stem(file), file, None, request.path.size, request.quality);
            (Box::new(make) as OutputFolder, both(&request.path))
        })
        .collect())
}

/// Returns a volume's name without its folder and ending, fit for a file.
fn file_stem(file: &Path) -> String {
    let shown = file.file_name().unwrap_or(file.as_os_str()).to_string_lossy();
    let shown = shown.strip_prefix("formula:").unwrap_or(&shown);
    let stem = shown.split('.').next().unwrap_or(shown);
    stem.chars().map(|c| if c.is_alphanumeric() || c == '_' { c } else { '-' }).collect()
}

/// Formats the power of the thickness with which an error fell over a halving.
fn order(before: Option<f64>, here: f64) -> String {
    match before {
        Some(b) if b > 0.0 && here > 0.0 => format!("{:.1}", libm::log2(b / here)),
        _ => String::new(),
    }
}

/// `1/8` for 0.125.
fn fraction(thickness: f64) -> String {
    if thickness >= 1.0 { format!("{thickness}") } else { format!("1/{}", 1.0 / thickness) }
}

fn text(s: &Sweep) -> String {
    let mut out = String::new();
    let _ = writeln!(
        out,
        "{}, {}: {} pixels that are not blank; RMSE in 1/255",
        s.name, s.projection, s.pixels
    );
    let _ = writeln!(
        out,
        "  vox | linear  order     max |  in f64  order | positions    f32  integers | constant  \
         order | paper's  order   off"
    );
    let mut before: Option<&sweep::ThicknessFigures> = None;
    for r in &s.figures {
        let fell = |of: fn(&sweep::ThicknessFigures) -> Deviation| {
            order(before.map(|b| of(b).rmse), of(r).rmse)
        };
        let _ = writeln!(
            out,
            "{:>5} | {:>7} {:>5} {:>7} | {:>7} {:>5} | {:>9} {:>7} {:>8} | {:>8} {:>6} | {:>7} \
             {:>5} {:>7}",
            fraction(r.thickness),
            number(r.linear.rmse),
            fell(|r| r.linear),
            number(r.linear.max),
            number(r.linear_f64.rmse),
            fell(|r| r.linear_f64),
            number(r.positions.rmse),
            number(r.floats.rmse),
            if s.integers { number(r.integers.rmse) } else { "-".into() },
            number(r.constant.rmse),
            fell(|r| r.constant),
            number(r.paper.rmse),
            fell(|r| r.paper),
            number(r.paper_limit.rmse),
        );
        before = Some(r);
    }
    let _ = writeln!(
        out,
        "  the paper's form goes to a limit that is {} off (max {})",
        number(s.elsewhere.rmse),
        number(s.elsewhere.max)
    );
    match s.floor() {
        Some(f) => {
            let _ = writeln!(
                out,
                "  floor: from {} vox on roundings ({}) are more than what thickness does; most of \
                 them: {}",
                fraction(f.thickness),
                number(f.rmse),
                f.name
            );
        }
        None => out.push_str("  no floor: thickness is the largest error all the way\n"),
    }
    if s.figures.iter().any(|r| r.placed.is_some()) {
        out.push_str("  linear in f64 by placement of sections:\n");
        out.push_str("  vox | mid-plane order | centroid order | half-way order | along the ray\n");
        let mut before: Option<&sweep::ThicknessFigures> = None;
        for r in &s.figures {
            let Some([centroid, between, exact]) = r.placed else { continue };
            let fell = |i: usize| {
                let now = [centroid, between, exact][i];
                order(before.and_then(|b| b.placed).map(|p| p[i].rmse), now.rmse)
            };
            let _ = writeln!(
                out,
                "{:>5} | {:>9} {:>5} | {:>8} {:>5} | {:>8} {:>5} | {:>7} {:>5}",
                fraction(r.thickness),
                number(r.linear_f64.rmse),
                order(before.map(|b| b.linear_f64.rmse), r.linear_f64.rmse),
                number(centroid.rmse),
                fell(0),
                number(between.rmse),
                fell(1),
                number(exact.rmse),
                fell(2),
            );
            before = Some(r);
        }
    }
    out.push('\n');
    out
}

fn json(s: &Sweep) -> String {
    let off = |o: Deviation| serde_json::json!({"rmse": o.rmse, "max": o.max});
    let figures: Vec<_> = s
        .figures
        .iter()
        .map(|r| {
            let placed = r.placed.map(|[c, b, e]| {
                serde_json::json!({"centroid": off(c), "between": off(b), "exact": off(e)})
            });
            serde_json::json!({
                "thickness": r.thickness,
                "linear": off(r.linear), "constant": off(r.constant),
                "paper": off(r.paper), "paper_against_limit": off(r.paper_limit),
                "linear_f64": off(r.linear_f64), "constant_f64": off(r.constant_f64),
                "paper_f64": off(r.paper_f64), "positions": off(r.positions),
                "f32": off(r.floats), "integers": s.integers.then(|| off(r.integers)),
                "placed": placed,
            })
        })
        .collect();
    let floor = s
        .floor()
        .map(|f| serde_json::json!({"thickness": f.thickness, "rmse": f.rmse, "name": f.name}));
    let line = serde_json::json!({
        "scene": s.name, "projection": s.projection, "pixels": s.pixels,
        "papers_limit": off(s.elsewhere), "floor": floor, "rungs": figures,
    });
    format!("{line}\n")
}

/// Error against thickness, a panel for each projection.
fn draw(sweeps: &[Sweep], file: &Path) -> Result<(), Fail> {
    let Some(first) = sweeps.first() else { return Ok(()) };
    let panels = sweeps
        .iter()
        .map(|s| {
            let line = |of: fn(&sweep::ThicknessFigures) -> Deviation| {
                s.figures.iter().map(|r| (r.thickness, of(r).rmse)).collect::<Vec<_>>()
            };
            plot::Panel {
                title: match s.projection {
                    "ortho" => "parallel rays".into(),
                    "persp" => "perspective".into(),
                    other => other.into(),
                },
                series: vec![
                    plot::Series::dots("paper's, to its own limit", line(|r| r.paper)),
                    plot::Series::dots("constant", line(|r| r.constant)),
                    plot::Series::dots("linear", line(|r| r.linear)),
                    plot::Series::dashes("linear, sheets in f64", line(|r| r.linear_f64)),
                ],
                slopes: vec![2, 4],
            }
        })
        .collect();
    let figure = plot::LogLog {
        title: format!("{}: error against thickness of sheets", first.name),
        x: "thickness, vox".into(),
        y: "RMSE, 1/255".into(),
        panels,
    };
    let svg = figure.svg().map_err(|e| Fail::failed(format!("drawing the figure failed: {e}")))?;
    std::fs::write(file, svg).map_err(|e| Fail::io(file, "writing", &e))
}
