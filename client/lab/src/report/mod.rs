//! `slabcast lab report`: error against run time, as a table, a chart and files for programs.
//!
//! `sweep` lists the settings to draw, [`crate::autotune`] measures them, `chart` draws the
//! results and `write` writes the files.

mod chart;
mod sweep;
mod write;

use crate::autotune::pareto::{self, Point};
use crate::autotune::setting::{Setting, lower};
use crate::autotune::trial::{Deviation, Effort, Judged, Timing, Trial, Truth};
use serde::Serialize;
use slabcast_common::quality::{Quality, Sums, Work};
use slabcast_session::direct::Cut;
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::{self, Progress};
use slabcast_session::request::{OpenedVolume, ThreadArgs, VolumeSceneArgs};
use slabcast_session::signals;
use std::path::PathBuf;
use std::time::Instant;
use sweep::{Group, Knob, SweepPoint};

/// Sweeps the quality settings of one scene for error against time.
///
/// Reports error and frame time of each setting, and marks the settings that no other beats.
///
/// Errors are measured at the middle view of the path (or --views of them), at a sample of pixels,
/// against the limit of the requested kernel, light and size. Times are from camera set to picture
/// in memory, over several views, on one thread and on all; other work on the machine lengthens
/// them. Ctrl-C ends the sweep and keeps the settings measured so far.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast lab report brain.nii.gz
  slabcast lab report head.nrrd --up=-y --tf peer-opaque -o report/
  slabcast lab report ct.nrrd --tf bone --size 1024x1024 --only thickness,eps,sums --seconds 0.3

Files: report.json (all of it), report.csv (a line a setting), report.svg, report-dark.svg,
report.png, report-dark.png (error down, time across).
No setting on the front is beaten in both error and time; beyond its knee more time buys little. `slabcast render --error` and `--budget` choose by the same measure.
JSON: {version, slabcast, pixels_version, volume, digest, tf, size, projection, views, judged_views,
pixels, machine: {cpu, cores, simd, threads}, complete, skipped, settings: [{name, group, knob, flags,
quality, shrink, shaded, sums, work: {tile, slabs, threads}, error: {rmse, max, most_999,
share_above_1, rmse_srgb8, pixels}, own_error, ms: {one: {median, min, max, frames}, all}, voxels:
{relevant, tossed, splatted, culled}, pixels, bytes, pixels_sha256, front, knee, default}]}. Errors in
1/255; own_error is against the limit of the setting's own model, null where that is the same; bytes:
of its bricks as sent; front and knee are by the time on all threads; skipped: settings with sheets
thinner than those at which the error stopped falling.")]
pub struct ReportArgs {
    #[command(flatten)]
    of: VolumeSceneArgs,
    /// Folder for the files; it is created
    #[arg(short, long, value_name = "DIR", default_value = "slabcast-report")]
    out: PathBuf,
    /// Replace the files of an earlier report
    #[arg(long)]
    force: bool,
    /// Pixels of each judged view to compare with the reference
    #[arg(long, value_name = "N", default_value = "4096",
          value_parser = clap::value_parser!(u32).range(16..=1 << 24))]
    pixels: u32,
    /// Views to judge, spread over the path; the worst counts
    #[arg(long, value_name = "N", default_value = "1",
          value_parser = clap::value_parser!(u32).range(1..=64))]
    views: u32,
    /// Seed of the sample of pixels
    #[arg(long, value_name = "N", default_value = "1")]
    seed: u64,
    /// Seconds of drawing for each time; three frames are timed at least
    #[arg(long, value_name = "S", default_value = "0.6", value_parser = slabcast_session::parse::positive)]
    seconds: f64,
    /// Settings to vary: thickness, eps, kernel, sums, compositing, shading, size, combinations and
    /// work [default: all]
    #[arg(long, value_name = "KNOB,...", value_delimiter = ',', value_enum)]
    only: Vec<Group>,
    #[command(flatten)]
    threads: ThreadArgs,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

/// Measured figures of one setting: a line of the report.
#[derive(Clone, Debug, Serialize)]
struct Line {
    name: String,
    group: Group,
    knob: String,
    flags: String,
    #[serde(flatten)]
    setting: Setting,
    /// Arithmetic of the sums, decided.
    sums: Sums,
    work: WorkUsed,
    error: Deviation,
    own_error: Option<Deviation>,
    ms: Times,
    voxels: Voxels,
    /// Number of pixels that are drawn.
    pixels: u64,
    /// Bytes of its bricks as sent.
    bytes: u64,
    pixels_sha256: String,
    front: bool,
    knee: bool,
    default: bool,
}

#[derive(Clone, Copy, Debug, Serialize)]
struct WorkUsed {
    tile: u32,
    slabs: u32,
    threads: usize,
}

#[derive(Clone, Copy, Debug, Serialize)]
struct Times {
    /// Times on one thread; `None` for a work setting on several threads.
    one: Option<Timing>,
    /// Times on all threads.
    all: Timing,
}

#[derive(Clone, Copy, Debug, Serialize)]
struct Voxels {
    relevant: u64,
    tossed: u64,
    splatted: u64,
    culled: u64,
}

#[derive(Clone, Debug, Serialize)]
struct Machine {
    cpu: String,
    cores: usize,
    simd: &'static str,
    threads: usize,
}

/// The report as it is written to report.json.
#[derive(Clone, Debug, Serialize)]
struct Report {
    version: u32,
    slabcast: &'static str,
    pixels_version: u32,
    volume: String,
    digest: String,
    tf: String,
    size: [u32; 2],
    views: usize,
    judged_views: Vec<usize>,
    /// Pixels compared in each judged view.
    pixels: usize,
    machine: Machine,
    /// False if the sweep was stopped early.
    complete: bool,
    /// Settings that were not drawn: the error had stopped falling at thicker sheets.
    skipped: Vec<String>,
    settings: Vec<Line>,
}

impl Report {
    /// Marks the settings on the Pareto front, and its knee.
    fn mark(&mut self) {
        // Work settings change no error: they would only repeat the default.
        let candidates: Vec<usize> =
            (0..self.settings.len()).filter(|&i| self.settings[i].group != Group::Work).collect();
        let points: Vec<Point> = candidates
            .iter()
            .map(|&i| &self.settings[i])
            .map(|l| Point { ms: l.ms.all.median, error: l.error.rmse })
            .collect();
        let front = pareto::front(&points);
        let knee = pareto::knee(&points, &front);
        for line in &mut self.settings {
            (line.front, line.knee) = (false, false);
        }
        for &i in &front {
            self.settings[candidates[i]].front = true;
        }
        if let Some(i) = knee {
            self.settings[candidates[i]].knee = true;
        }
    }

    /// Returns the settings on the front, from fast to slow.
    fn front(&self) -> Vec<&Line> {
        let mut front: Vec<&Line> = self.settings.iter().filter(|l| l.front).collect();
        front.sort_by(|a, b| a.ms.all.median.total_cmp(&b.ms.all.median));
        front
    }

    fn default(&self) -> Option<&Line> {
        self.settings.iter().find(|l| l.default)
    }
}

/// Runs `slabcast lab report`: writes its files and prints the table, or JSON with `--json`.
///
/// # Errors
/// The arguments or the volume are refused, the folder has a report already, or a file can't be
/// written.
pub fn run(args: &ReportArgs) -> Result<(), Fail> {
    let made = write::check(args)?;
    let args = args.clone();
    signals::run_to_end(move || {
        // Removes the folder on drop, if it is still empty.
        let _made = made;
        let report = measure(&args)?;
        write::files(&args.out, &report)?;
        if args.json {
            return say(&write::json(&report));
        }
        say(&write::text(&report, &args.out))
    })
}

fn measure(args: &ReportArgs) -> Result<Report, Fail> {
    let mut request = args.of.request(Work::default())?;
    let threads = args.threads.count();
    let mut progress = Progress::new(false).counting("setting");
    progress.phase(&format!("reading {}", args.of.volume.display()));
    let OpenedVolume { volume, info, orientation } = args.of.open(&mut request)?;
    let (name, digest) = (volume.name.clone(), info.digest.to_string());
    let mut trial = Trial::new(volume, info, &request, orientation, threads)?;
    let points = sweep::points(&trial, &args.only);

    let views = trial.views();
    let judged: Vec<usize> = spread(views, args.views as usize);
    let mut truths = Vec::new();
    let mut judging = Progress::new(false).counting("pixel");
    let all = args.pixels as usize * judged.len();
    judging.frames(all as u64, "the exact picture, by the reference");
    for (n, &view) in judged.iter().enumerate() {
        let counter = (&mut judging, n * args.pixels as usize);
        truths.push(trial.truth(view, args.pixels as usize, args.seed, counter)?);
        if signals::stop_requested() {
            break;
        }
    }
    judging.end();

    let mut report = Report {
        version: 1,
        slabcast: env!("CARGO_PKG_VERSION"),
        pixels_version: slabcast_common::PIXELS_VERSION,
        volume: name,
        digest,
        tf: request.transfer.name(),
        size: trial.size(),
        views,
        judged_views: judged,
        pixels: args.pixels as usize,
        machine: Machine {
            cpu: slabcast_session::machine::cpu(),
            cores: slabcast_session::machine::cores() as usize,
            simd: slabcast_render::Simd::detect().name(),
            threads,
        },
        complete: false,
        skipped: Vec::new(),
        settings: Vec::new(),
    };
    progress.frames(points.len() as u64, &format!("{} settings", points.len()));
    let began = Instant::now();
    for (n, point) in points.iter().enumerate() {
        if signals::stop_requested() {
            progress.end();
            progress::note(&format!("stopped after {n} of {} settings", points.len()));
            report.mark();
            return Ok(report);
        }
        if no_longer_pays(&report.settings, point) {
            report.skipped.push(point.setting.name(&trial.base));
        } else {
            report.settings.push(line(&mut trial, point, &truths, args)?);
        }
        progress.step(progress::Step {
            frames: n as u64 + 1,
            detail: point.setting.name(&trial.base),
            ..Default::default()
        });
    }
    progress.end();
    tracing::info!(seconds = began.elapsed().as_secs_f64(), "swept");
    report.complete = true;
    report.mark();
    Ok(report)
}

/// Returns up to `n` indices of `views` views, spread evenly and away from the ends.
fn spread(views: usize, n: usize) -> Vec<usize> {
    let n = n.min(views);
    let mut all: Vec<usize> = (0..n).map(|i| (2 * i + 1) * views / (2 * n)).collect();
    all.dedup();
    all
}

/// Returns whether thinner sheets no longer pay: two thicker variants of the setting are known, and
/// the error of the thinner one is no lower.
fn no_longer_pays(known: &[Line], point: &SweepPoint) -> bool {
    let thickness = point.setting.quality.thickness;
    let mut alike: Vec<(f64, f64)> = known
        .iter()
        .filter(|l| {
            let q = Quality { thickness, ..l.setting.quality };
            Setting { quality: q, ..l.setting } == point.setting
        })
        .map(|l| (l.setting.quality.thickness, l.error.rmse))
        .filter(|(d, _)| *d > thickness)
        .collect();
    alike.sort_by(|a, b| a.0.total_cmp(&b.0));
    matches!(&alike[..], [thin, thick, ..] if thin.1 >= thick.1 * (1.0 - pareto::WORTH))
}

fn line(
    trial: &mut Trial,
    point: &SweepPoint,
    truths: &[Truth],
    args: &ReportArgs,
) -> Result<Line, Fail> {
    let base = trial.base;
    let setting = &point.setting;
    let own = if setting.same_model(&base) {
        None
    } else {
        let limits = truths.iter().map(|t| trial.own_truth(setting, t));
        Some(limits.collect::<Result<Vec<_>, _>>()?)
    };
    let Judged { sums, deviation, own, counters, sha256 } =
        trial.judge(setting, truths, own.as_deref())?;
    let effort = |cut| Effort { cut, seconds: args.seconds };
    let all = trial.time(setting, effort(point.cut))?;
    let one = match point.cut.threads {
        1 => Some(all),
        _ if point.group == Group::Work => None,
        _ => Some(trial.time(setting, effort(Cut { threads: 1, ..point.cut }))?),
    };
    let (relevant, bytes) = trial.bricks(setting)?;
    let drawn = setting.drawn_size(trial.size()).unwrap_or(trial.size());
    let is_base = *setting == base;
    Ok(Line {
        name: match point.knob {
            Knob::Quality => setting.name(&base),
            Knob::Work(knob) => knob.to_string(),
        },
        group: point.group,
        knob: lower(&point.group),
        flags: setting.flags(&base, trial.size()),
        setting: *setting,
        sums,
        work: WorkUsed { tile: point.cut.tile, slabs: point.cut.slabs, threads: point.cut.threads },
        error: deviation,
        own_error: own,
        ms: Times { one, all },
        voxels: Voxels {
            relevant,
            tossed: counters.tossed,
            splatted: counters.splatted,
            culled: counters.culled,
        },
        pixels: drawn.map(u64::from).iter().product(),
        bytes,
        pixels_sha256: sha256,
        front: false,
        knee: false,
        default: is_base && point.group == Group::Default,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn judged_views_are_spread_over_the_path() {
        assert_eq!(spread(18, 1), [9]);
        assert_eq!(spread(18, 3), [3, 9, 15]);
        assert_eq!(spread(2, 5), [0, 1]);
        assert_eq!(spread(1, 1), [0]);
    }
}
