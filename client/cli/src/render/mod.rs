//! `slabcast render`: a view path to PNGs, by this process alone or by a cluster.
//!
//! Both ways are one loop over [`Update`]s; only where these come from differs ([`Source`]).

mod debug_views;
mod frame_check;
#[cfg(test)]
mod master_cost;
mod quality;
mod run;
mod trace;

use crate::at_master::{self, VolumeWords, is_here};
use debug_views::DebugView;
use quality::{choose_here, choose_there};
use run::Run;
use slabcast_client::{Client, VolumeDescription};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_scene::path::{MAX_FRAMES, Orientation};
use slabcast_session::embedded::{self, Cluster, WorkerGroup};
use slabcast_session::fail::Fail;
use slabcast_session::output::{DiskWait, Format, Lines, Output, OutputArgs};
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::progress::Progress;
use slabcast_session::record::{self, Recording};
use slabcast_session::request::{RenderRequest, SceneArgs, UsualTurn, WorkArgs};
use slabcast_session::source::{Cancel, Source, Update};
use slabcast_session::{remote, runtime, signals, volume};
use slabcast_volumes::blocks::{BlockSource, MemorySource};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::mpsc;

/// Heading of the flags of a view path.
const VIEW_PATH: &str = "View path (a turn about the volume, unless --path)";
/// Frames of a turn where nothing says how many: 10 degrees apart in a folder, and a video of 6 s.
const TURN_FRAMES: u32 = 36;
const VIDEO_FRAMES: u32 = 180;

const SHORT_EXAMPLES: &str = "\
Examples, and the flags of raw files, kernels, sums, slabs and tiles: slabcast help render";

const EXAMPLES: &str = "\
Without --master, a master and workers are started inside this process; with it, a cluster renders. Both
give the same bytes. VOLUME is then a file, which is put on the master unless it has it, or the name of
a volume there (`slabcast volumes`).

Examples:
  A full turn about a head, 36 frames in slabcast-out/:
      slabcast render brain.nii.gz
  One picture from the front, large, on white:
      slabcast render brain.nii.gz --azimuth 0 --size 2048x2048 --background white -o front.png
  All six sides in one picture, with names, a scale bar, and 300 dots an inch:
      slabcast render brain.nii.gz --view all --scale-bar --dpi 300 -o sides.png
  A movie of ten seconds in perspective, bones only (needs ffmpeg):
      slabcast render ct.nrrd --tf bone --seconds 10 --projection persp -o turn.mp4
  Where each pixel was shut, how much work it was, how far off it may be:
      slabcast render brain.nii.gz --azimuth 0 --show depth
  On a cluster (see `slabcast master --help`):
      slabcast render knee.nrrd --master node1:7433 --tf vessels -o out/

To try it without a file, give a volume by formula: formula:spheres, formula:marker, formula:blob.
A path file looks like this:
  {\"version\":1,\"size\":[512,512],\"turntable\":{\"start\":0,\"step\":10,\"frames\":36}}
  {\"version\":1,\"size\":[512,512],\"views\":[{\"eye\":[0,400,0],\"target\":[0,0,0],\"up\":[0,0,1],
   \"projection\":\"persp\",\"fov\":30}]}";

/// Renders a view path of a volume to pictures.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = SHORT_EXAMPLES, after_long_help = EXAMPLES)]
pub(crate) struct RenderArgs {
    #[arg(help = volume::VOLUME)]
    volume: Option<PathBuf>,
    #[command(flatten)]
    input: volume::InputArgs,
    /// Render on this master's cluster
    #[arg(long, value_name = "HOST:PORT", value_parser = slabcast_session::parse::master)]
    master: Option<String>,
    #[command(flatten)]
    scene: SceneArgs,
    #[command(flatten)]
    work: WorkArgs,
    /// Workers inside this process [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=64),
          help_heading = "Work (never changes a pixel)")]
    workers: Option<u32>,
    /// Render threads of each worker [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024),
          help_heading = "Work (never changes a pixel)")]
    threads: Option<u32>,
    #[command(flatten)]
    output: OutputArgs,
    /// Fit --tf to this volume instead, for pictures to be compared
    #[arg(long, value_name = "VOLUME", help_heading = "Picture", hide_short_help = true)]
    like: Option<PathBuf>,
    /// Degrees of a turn, from its first frame on [default: 360]
    #[arg(long, value_name = "DEG", value_parser = slabcast_session::parse::number,
          allow_negative_numbers = true, help_heading = VIEW_PATH,
          conflicts_with_all = ["step", "azimuth", "view", "path"])]
    turn: Option<f64>,
    /// Length of a turn in seconds, at --fps
    #[arg(long, value_name = "S", value_parser = slabcast_session::parse::positive,
          allow_negative_numbers = true, help_heading = VIEW_PATH,
          conflicts_with_all = ["frames", "azimuth", "view", "path"])]
    seconds: Option<f64>,
    /// Draw how pictures come about: depth, owner, work, ...
    ///
    /// depth: where pixels were shut; owner: which worker drew which tile; work; sheets; error: an
    /// estimate. Each has a legend.
    #[arg(
        long,
        value_name = "WHAT",
        hide_possible_values = true,
        hide_short_help = true,
        value_enum,
        help_heading = "Output"
    )]
    show: Option<DebugView>,
    /// Statistics, one line of JSON a frame; - is stdout
    ///
    /// For their estimates of errors one pixel in 128 is drawn again in other ways: up to a quarter
    /// more time.
    #[arg(long, value_name = "FILE|-", help_heading = "Output")]
    stats: Option<PathBuf>,
    /// Statistics without the hash of the linear picture
    ///
    /// Tiles then cross a network as they do without --stats, finished, in a fifth of the bytes.
    #[arg(long, requires = "stats", help_heading = "Output", hide_short_help = true)]
    no_hash: bool,
    /// Time line of all workers for Perfetto or chrome://tracing
    #[arg(long, value_name = "FILE.json", help_heading = "Output", hide_short_help = true)]
    trace: Option<PathBuf>,
    /// Events and decisions of this process's scheduler, for `slabcast lab replay`
    #[arg(long, value_name = "FILE", help_heading = "Output", hide_short_help = true)]
    record: Option<PathBuf>,
    /// No progress, only warnings and the result
    #[arg(short, long, help_heading = "Output")]
    quiet: bool,
}

/// Runs the command.
pub(crate) fn run(args: &RenderArgs) -> Result<(), Fail> {
    let master = match (&args.volume, &args.master) {
        (_, Some(master)) => Some(master.clone()),
        (Some(_), None) => None,
        (None, None) => {
            return Err(Fail::usage(
                "VOLUME: nothing to render; give a file (or formula:spheres), or --master \
                 HOST:PORT; see `slabcast render --help`",
            ));
        }
    };
    if master.is_some() {
        if args.record.is_some() {
            return Err(Fail::usage(
                "--record: the scheduler of a cluster is its master's; give --record to `slabcast \
                 master`",
            ));
        }
        if !args.input.is_empty() && !args.volume.as_deref().is_some_and(is_here) {
            return Err(Fail::usage(
                "--dims, --type and the like say what is in a file, and with --master the master has \
                 read the volume; leave them out, or give a file as VOLUME",
            ));
        }
        for (given, flag) in [(args.workers, "workers"), (args.threads, "threads")] {
            if given.is_some() {
                return Err(Fail::usage(format!(
                    "--{flag}: workers of a cluster are started by `slabcast worker`; leave it out \
                     with --master"
                )));
            }
        }
    }
    let crew = WorkerGroup::new(args.workers.unwrap_or(1), args.threads)?;
    let mut request = args.scene.request_with_turn(args.work.work()?, usual_turn(args)?)?;
    request.level = args.input.level();
    let mut notes = Vec::new();
    if let Some(like) = &args.like {
        let other = volume::open(like)?.info(Digest32::default());
        let fitted = request.transfer.fitted_to(&other).map_err(|e| request.blame(&e))?;
        request.transfer = fitted;
        notes.push(format!(
            "--tf is fitted to {}; opacities are those of one of its samples' steps, {} long",
            like.display(),
            other.lattice.vox()
        ));
    }
    request.work.estimate = args.stats.is_some();
    request.hashed = args.stats.is_some() && !args.no_hash;
    if !request.target.is_empty() && args.show.is_some() {
        return Err(Fail::usage(format!(
            "{}, --show: shows how pictures of a given quality come about; leave one of the two out",
            request.target.flags()
        )));
    }
    let stem = args.show.map_or("frame", DebugView::stem);
    let inputs: Vec<&Path> =
        [&args.volume, &args.scene.view.path].into_iter().flatten().map(PathBuf::as_path).collect();
    let (output, stays) = Output::look(&args.output, stem, &request, &inputs)?;
    if output.on_stdout() && args.stats.as_deref() == Some(Path::new("-")) {
        return Err(Fail::usage("--stats: stdout has the frames; give a file"));
    }
    if let Some(show) = args.show {
        showable(show, args, &output, &request)?;
    }
    if let Some(path) = &args.record {
        record::check_path(path, &inputs)?;
    }
    let patience = Arc::new(DiskWait::default());
    let run = Run {
        stats: Lines::open(args.stats.as_deref(), "stats", &inputs, &patience)?,
        trace: Lines::open(args.trace.as_deref(), "trace", &inputs, &patience)?,
        record: args.record.clone(),
        progress: Progress::new(args.quiet),
        began: Instant::now(),
        stands: args.quiet
            || args.scene.view.path.is_some()
            || args.scene.view.axes.up.is_some()
            || args.scene.view.axes.front.is_some(),
        request,
        output,
        show: args.show,
        patience,
        notes: notes.into_iter().chain(stays).collect(),
        tell: true,
    };
    let runtime = if master.is_none() { runtime::start_embedded()? } else { runtime::start()? };
    let result = match (&args.volume, master) {
        (Some(file), None) => {
            let mut run = run;
            run.progress.phase(&format!("reading {}", file.display()));
            let opened = args.input.open_source(file)?;
            run.request.level = args.input.level_of(&*opened.source);
            let orientation = args.scene.view.axes.for_info(opened.info())?;
            let tried = if run.request.target.is_empty() {
                None
            } else {
                let volume = opened.whole("--error, --fps and --like")?;
                choose_here(&mut run, &volume, orientation, crew, &runtime, args.quiet)?
            };
            match args.show {
                None | Some(DebugView::Owner) => {
                    runtime.block_on(embedded(run, opened.source, orientation, crew, tried))
                }
                Some(show) => {
                    let volume = opened.whole("--show")?;
                    runtime.block_on(drawn(run, volume, orientation, show, crew))
                }
            }
        }
        (_, Some(master)) => {
            let mut run = run;
            run.progress.phase(&format!("dialling {master}"));
            let client = runtime.block_on(remote::connect(&master))?;
            let words = VolumeWords {
                volume: args.volume.as_deref(),
                input: &args.input,
                axes: &args.scene.view.axes,
                quiet: args.quiet,
            };
            let served = at_master::volume(&words, &client, &runtime, &mut run.progress)?;
            if !run.request.target.is_empty() {
                choose_there(&mut run, &client, &served, &master, &runtime, args.quiet)?;
            }
            runtime.block_on(cluster(run, client, served, &master))
        }
        (None, None) => unreachable!("settled above"),
    };
    runtime::end(runtime);
    result
}

/// The turn that is drawn where no flag says it: a full one in a folder, its first picture in a
/// file of one, and a smooth one in a video.
fn usual_turn(args: &RenderArgs) -> Result<UsualTurn, Fail> {
    let asked = args.output.asked()?;
    let usual = if args.output.is_one_picture()? && args.turn.or(args.seconds).is_none() {
        1
    } else if matches!(asked, Some(Format::Mp4 | Format::Webm)) {
        VIDEO_FRAMES
    } else {
        TURN_FRAMES
    };
    let frames = match args.seconds {
        None => usual,
        Some(seconds) => {
            let usual = asked.unwrap_or(Format::Y4m).usual_fps();
            let frames = (seconds * f64::from(args.output.fps.unwrap_or(usual))).round();
            if !(1.0..=MAX_FRAMES as f64).contains(&frames) {
                return Err(Fail::usage(format!(
                    "--seconds: {seconds} seconds are {frames} frames; give a time of 1 to {MAX_FRAMES}"
                )));
            }
            frames as u32
        }
    };
    let degrees = args.turn.unwrap_or(360.0);
    Ok(UsualTurn { frames, degrees, step: None })
}

/// Renders the request of a picture's provenance in this process. Prints nothing at the end.
pub(crate) fn again(
    request: RenderRequest,
    output: Output,
    volume: Volume,
    quiet: bool,
) -> Result<(), Fail> {
    let run = Run::bare(request, output, quiet);
    let orientation = Orientation::new(None, None).map_err(|e| Fail::flag(&e))?;
    let runtime = runtime::start_embedded()?;
    let result = runtime.block_on(embedded(
        run,
        Arc::new(MemorySource::of(volume)),
        orientation,
        WorkerGroup::new(1, None)?,
        None,
    ));
    runtime::end(runtime);
    result
}

async fn embedded(
    mut run: Run,
    source: Arc<dyn BlockSource>,
    orientation: Orientation,
    crew: WorkerGroup,
    tried: Option<Cluster>,
) -> Result<(), Fail> {
    let (name, anatomical) = (source.name().to_owned(), source.levels()[0].summary.anatomical);
    if !anatomical && !run.stands && !name.starts_with("formula:") {
        run.notes.push(format!(
            "{name} does not say what is up: {} is taken, with {} in front; see --up and --front",
            orientation.up, orientation.front
        ));
    }
    let (recorder, recording) = run.record.take().map(|p| record::start(&p)).transpose()?.unzip();
    let mut cluster = match tried {
        Some(cluster) => cluster,
        None => Cluster::of(source, orientation, crew, recorder)?,
    };
    let handle = cluster.handle();
    let info = cluster.volume().info.clone();
    let recipe = run.ready(&info, orientation, anatomical)?;
    let message = run.request(&info);
    let source = embedded::submit(&handle, &run.request, message).await?;
    let what = format!("{name} by {crew}");
    let result = tokio::select! {
        result = run.go(source, &what, (&info, orientation), &recipe) => result,
        trouble = cluster.trouble() => Err(trouble),
    };
    cluster.end().await;
    let recorded = recording.map_or(Ok(()), Recording::end);
    result.and(recorded)
}

/// Checks that `--show` fits the other flags.
fn showable(
    show: DebugView,
    args: &RenderArgs,
    output: &Output,
    request: &RenderRequest,
) -> Result<(), Fail> {
    if show == DebugView::Error {
        debug_views::can_estimate(&request.quality)?;
    }
    if matches!(output.format, Format::Png16 | Format::Exr) {
        return Err(Fail::usage("--format: what --show draws has 8 bits; give png, apng or y4m"));
    }
    if let Some(flag) = output.figure.flag() {
        return Err(Fail::usage(format!(
            "--{flag}: what --show draws has a legend of its own; leave one of the two out"
        )));
    }
    if show == DebugView::Owner {
        return Ok(());
    }
    for (given, flag) in [
        (args.master.is_some(), "master"),
        (args.stats.is_some(), "stats"),
        (args.trace.is_some(), "trace"),
        (args.record.is_some(), "record"),
    ] {
        if given {
            return Err(Fail::usage(format!(
                "--{flag}: --show {} is drawn by this process alone, without a master; leave one \
                 of the two out",
                show.stem()
            )));
        }
    }
    Ok(())
}

/// Draws debug views in this process, without a master.
async fn drawn(
    mut run: Run,
    volume: Arc<Volume>,
    orientation: Orientation,
    show: DebugView,
    crew: WorkerGroup,
) -> Result<(), Fail> {
    let info = volume.info(volume.digest());
    let recipe = run.ready(&info, orientation, volume.anatomical)?;
    let threads = (crew.workers * crew.threads) as usize;
    let stage = PathScenes::new(&volume, &info, &run.request, orientation)?;
    let framing = stage.framing;
    let what = format!("{}, showing {}", volume.name, show.stem());
    drop(volume);
    let (to, updates) = mpsc::channel(1);
    let frames = run.request.path.frames();
    tokio::task::spawn_blocking(move || {
        for i in 0..frames {
            let update = debug_views::draw(&stage, show, i, threads).map(|frame| {
                let (stats_json, trace_json) = (String::new(), String::new());
                Update::Frame { frame, stats: None, stats_json, trace_json }
            });
            let failed = update.is_err();
            // Nobody takes more after Ctrl-C.
            if to.blocking_send(update).is_err() || failed {
                return;
            }
        }
        let _ = to.blocking_send(Ok(Update::Done));
    });
    let source = Source { updates, cancel: Cancel::none(), framing };
    run.go(source, &what, (&info, orientation), &recipe).await
}

async fn cluster(
    mut run: Run,
    client: Client,
    served: VolumeDescription,
    master: &str,
) -> Result<(), Fail> {
    let recipe = run.ready(&served.info, served.orientation, served.anatomical)?;
    let message = run.request(&served.info);
    let source = tokio::select! {
        source = remote::submit(client, &run.request, message) => source?,
        code = signals::stopped() => return Err(Fail::silent(code)),
    };
    let what = format!("{} on the cluster of {master}", served.name);
    run.go(source, &what, (&served.info, served.orientation), &recipe).await
}
