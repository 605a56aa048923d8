//! `slabcast render`: a view path to PNGs, by this process alone or by a cluster.
//!
//! Both ways are one loop over [`Update`]s; only where these come from differs ([`Source`]).

mod debug_views;
#[cfg(test)]
mod master_cost;

use debug_views::DebugView;
use slabcast_client::{Client, VolumeDescription};
use slabcast_common::stats::FrameStats;
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_lab::autotune::choose::{choose, trial};
use slabcast_lab::autotune::cluster_bed::{ClusterBed, ClusterRun, Connection};
use slabcast_lab::autotune::local_bed::{Clock, LocalBed};
use slabcast_scene::path::Orientation;
use slabcast_scene::request::PathRequest;
use slabcast_session::direct::Cut;
use slabcast_session::embedded::{self, Cluster, WorkerGroup};
use slabcast_session::fail::{Fail, say};
use slabcast_session::output::provenance::RunProvenance;
use slabcast_session::output::{DiskWait, Format, Frame, Lines, Output, OutputArgs, Writer};
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::progress::{self, Progress, Step};
use slabcast_session::record::{self, Recording};
use slabcast_session::request::{RenderRequest, SceneArgs, WorkArgs};
use slabcast_session::source::{Cancel, Source, Update};
use slabcast_session::{remote, runtime, signals, volume};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::runtime::Runtime;
use tokio::sync::mpsc;

/// Time for frames that are being written once the run has failed or was stopped: ten times what
/// the largest picture takes on a slow disk.
const LAST: Duration = Duration::from_secs(20);

const SHORT_EXAMPLES: &str = "\
Examples, and the flags of raw files, kernels, sums, slabs and tiles: slabcast help render";

const EXAMPLES: &str = "\
With VOLUME, a master and workers are started inside this process; with --master, a cluster
renders the volume that its master serves. Both give the same bytes.

Examples:
  A turn about a head, 18 frames in slabcast-out/:
      slabcast render brain.nii.gz
  One picture from the front, large, on white:
      slabcast render brain.nii.gz --azimuth 0 --size 2048x2048 --background white -o front/
  A full turn in perspective, bones only:
      slabcast render ct.nrrd --tf bone --frames 72 --projection persp -o turn/
  Where each pixel was shut, how much work it was, how far off it may be:
      slabcast render brain.nii.gz --azimuth 0 --show depth
  Video, to be encoded by another program:
      slabcast render brain.nii.gz --frames 72 -o - | ffmpeg -i - -pix_fmt yuv420p \\
          -colorspace bt709 -color_primaries bt709 -color_trc iec61966-2-1 turn.mp4
  On a cluster (see `slabcast master --help`):
      slabcast render --master node1:7433 --tf vessels -o out/

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
    /// Draw how pictures come about: depth, owner, work, ...
    ///
    /// depth: where pixels were shut; owner: which worker drew which tile; work; sheets; error: an
    /// estimate. Each has a legend.
    #[arg(
        long,
        value_name = "WHAT",
        hide_possible_values = true,
        value_enum,
        help_heading = "Output"
    )]
    show: Option<DebugView>,
    /// Statistics, one line of JSON a frame; - is stdout
    ///
    /// For their estimates of errors one pixel in 128 is drawn again in other ways: up to a quarter more
    /// time.
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

/// State of one run, whoever renders its frames.
struct Run {
    request: RenderRequest,
    /// Whether the up axis was given or needs no note.
    stands: bool,
    output: Output,
    show: Option<DebugView>,
    patience: Arc<DiskWait>,
    /// Notes for stderr once the request has been accepted.
    notes: Vec<String>,
    stats: Lines,
    trace: Lines,
    record: Option<PathBuf>,
    progress: Progress,
    began: Instant,
    /// Whether the run ends with a line that names the pictures.
    tell: bool,
}

/// Runs the command.
pub(crate) fn run(args: &RenderArgs) -> Result<(), Fail> {
    let master = match (&args.volume, &args.master) {
        (Some(_), Some(_)) => {
            return Err(Fail::usage(
                "VOLUME, --master: a master renders the volume that it serves; leave one of the two \
                 out",
            ));
        }
        (Some(_), None) => None,
        (None, Some(master)) => Some(master.clone()),
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
        if !args.input.is_empty() {
            return Err(Fail::usage(
                "--dims, --type and the like say what is in a file, and with --master the master \
                 has read it; leave them out",
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
    let mut request = args.scene.request_with_target(args.work.work()?)?;
    request.work.estimate = args.stats.is_some();
    request.hashed = args.stats.is_some() && !args.no_hash;
    if !request.target.is_empty() && args.show.is_some() {
        return Err(Fail::usage(format!(
            "{}, --show: shows how pictures of a given quality come about; leave one of the two out",
            request.target.flags()
        )));
    }
    let frames = request.frames();
    let stem = args.show.map_or("frame", DebugView::stem);
    let inputs: Vec<&Path> =
        [&args.volume, &args.scene.view.path].into_iter().flatten().map(PathBuf::as_path).collect();
    let (output, stays) = Output::look(&args.output, stem, frames, request.background, &inputs)?;
    if output.on_stdout() && args.stats.as_deref() == Some(Path::new("-")) {
        return Err(Fail::usage("--stats: stdout has the frames; give a file"));
    }
    if let Some(show) = args.show {
        showable(show, args, output.format, &request)?;
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
        notes: stays.into_iter().collect(),
        tell: true,
    };
    let runtime =
        if args.volume.is_some() { runtime::start_embedded()? } else { runtime::start()? };
    let result = match (&args.volume, master) {
        (Some(file), _) => {
            let mut run = run;
            run.progress.phase(&format!("reading {}", file.display()));
            let volume = Arc::new(args.input.open(file)?);
            let orientation = args.scene.view.axes.for_volume(&volume)?;
            let tried = if run.request.target.is_empty() {
                None
            } else {
                aim_here(&mut run, &volume, orientation, crew, &runtime, args.quiet)?
            };
            match args.show {
                None | Some(DebugView::Owner) => {
                    runtime.block_on(embedded(run, volume, orientation, crew, tried))
                }
                Some(show) => runtime.block_on(drawn(run, volume, orientation, show, crew)),
            }
        }
        (None, Some(master)) => {
            let mut run = run;
            run.progress.phase(&format!("dialling {master}"));
            let client = runtime.block_on(remote::connect(&master))?;
            let served = runtime.block_on(remote::describe(&client))?;
            if !run.request.target.is_empty() {
                aim_there(&mut run, &client, &served, &master, &runtime, args.quiet)?;
            }
            runtime.block_on(cluster(run, client, served, &master))
        }
        (None, None) => unreachable!("settled above"),
    };
    runtime::end(runtime);
    result
}

/// Chooses the quality for a target: errors by the reference, times by a cluster of this process. The
/// cluster then renders, since it has the bricks.
fn aim_here(
    run: &mut Run,
    volume: &Arc<Volume>,
    orientation: Orientation,
    crew: WorkerGroup,
    runtime: &Runtime,
    quiet: bool,
) -> Result<Option<Cluster>, Fail> {
    let info = volume.info(volume.digest());
    run.request.fit(&info, orientation, volume.anatomical)?;
    let (target, threads) = (run.request.target, (crew.workers * crew.threads) as usize);
    let trial = trial(volume, &info, &run.request, orientation, threads)?;
    if target.budget.is_none() {
        let clock = Clock::Plain(Cut { tile: 64, ..Cut::on(threads) });
        choose(&mut LocalBed::new(trial, clock), &target, quiet)?.settle(&mut run.request);
        return Ok(None);
    }
    let cluster =
        runtime.block_on(async { Cluster::start(volume.clone(), orientation, crew, None) })?;
    let (handle, request) = (cluster.handle(), run.request.clone());
    let wire = Connection::Embedded(&handle);
    let through = ClusterRun { runtime, wire, info, request, crew: crew.to_string() };
    match choose(&mut LocalBed::new(trial, Clock::Cluster(Box::new(through))), &target, quiet) {
        // A record begins with the first worker.
        Ok(chosen) if run.record.is_none() => {
            chosen.settle(&mut run.request);
            Ok(Some(cluster))
        }
        chosen => {
            runtime.block_on(cluster.end());
            chosen?.settle(&mut run.request);
            Ok(None)
        }
    }
}

/// Chooses the quality by the cluster's own pictures, where only the master has the volume.
fn aim_there(
    run: &mut Run,
    client: &Client,
    served: &VolumeDescription,
    master: &str,
    runtime: &Runtime,
    quiet: bool,
) -> Result<(), Fail> {
    let info = served.info.clone();
    run.request.fit(&info, served.orientation, served.anatomical)?;
    let (target, request) = (run.request.target, run.request.clone());
    let crew = format!("the cluster of {master}");
    let through = ClusterRun { runtime, wire: Connection::Remote(client), info, request, crew };
    choose(&mut ClusterBed::new(through), &target, quiet)?.settle(&mut run.request);
    Ok(())
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
        Arc::new(volume),
        orientation,
        WorkerGroup::new(1, None)?,
        None,
    ));
    runtime::end(runtime);
    result
}

async fn embedded(
    mut run: Run,
    volume: Arc<Volume>,
    orientation: Orientation,
    crew: WorkerGroup,
    tried: Option<Cluster>,
) -> Result<(), Fail> {
    let name = volume.name.clone();
    if !volume.anatomical && !run.stands && !name.starts_with("formula:") {
        run.notes.push(format!(
            "{name} does not say what is up: {} is taken, with {} in front; see --up and --front",
            orientation.up, orientation.front
        ));
    }
    let anatomical = volume.anatomical;
    let (recorder, recording) = run.record.take().map(|p| record::start(&p)).transpose()?.unzip();
    let mut cluster = match tried {
        Some(cluster) => cluster,
        None => Cluster::start(volume, orientation, crew, recorder)?,
    };
    let handle = cluster.handle();
    let info = handle.volume().info.clone();
    let recipe = run.ready(&info, orientation, anatomical)?;
    let message = run.request(&info);
    let source = embedded::submit(&handle, &run.request, message).await?;
    let what = format!("{name} by {crew}");
    let result = tokio::select! {
        result = run.go(source, &what, &info, &recipe) => result,
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
    format: Format,
    request: &RenderRequest,
) -> Result<(), Fail> {
    if show == DebugView::Error {
        debug_views::can_estimate(&request.quality)?;
    }
    if matches!(format, Format::Png16 | Format::Exr) {
        return Err(Fail::usage("--format: what --show draws has 8 bits; give png, apng or y4m"));
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
    run.go(Source { updates, cancel: Cancel::none() }, &what, &info, &recipe).await
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
    run.go(source, &what, &served.info, &recipe).await
}

impl Run {
    /// Returns a run that prints nothing at its end.
    fn bare(request: RenderRequest, output: Output, quiet: bool) -> Run {
        Run {
            request,
            stands: true,
            output,
            show: None,
            patience: Arc::default(),
            notes: Vec::new(),
            stats: Lines::None,
            trace: Lines::None,
            record: None,
            progress: Progress::new(quiet),
            began: Instant::now(),
            tell: false,
        }
    }

    fn request(&mut self, info: &VolumeInfo) -> PathRequest {
        let format = self.output.takes(self.request.magnify, self.request.background);
        self.request.to_message(info, format, self.trace.wanted())
    }

    /// All that can be refused is; the folder is there.
    fn ready(
        &mut self,
        info: &VolumeInfo,
        orientation: Orientation,
        anatomical: bool,
    ) -> Result<RunProvenance, Fail> {
        // From here on there may be files to clean up.
        signals::listen();
        self.request.fit(info, orientation, anatomical)?;
        let as_what = (self.output.format, self.output.fps());
        let recipe = RunProvenance::new(&self.request, info, orientation, as_what)?;
        self.output.make()?;
        self.notes.iter().for_each(|n| progress::note(n));
        Ok(recipe)
    }

    /// Takes frames until the last one is on disk, Ctrl-C, or trouble.
    async fn go(
        self,
        mut source: Source,
        what: &str,
        info: &VolumeInfo,
        recipe: &RunProvenance,
    ) -> Result<(), Fail> {
        let Run {
            request,
            output,
            show,
            patience,
            mut stats,
            trace,
            mut progress,
            began,
            tell,
            ..
        } = self;
        let total = request.path.frames() as u64;
        let [w, h] = request.size();
        let s = if total == 1 { "" } else { "s" };
        progress.frames(total, &format!("rendering {total} frame{s} of {w}x{h} of {what}"));
        let output = Arc::new(output);
        let mut writer = Writer::new(output.clone(), total, patience.clone())?;
        let mut trace = Trace::new(trace);
        let mut look = Look::default();
        let (mut first, mut last) = (None, Instant::now());
        let mut step = Step::default();
        let ended: Result<(), Fail> = async {
            loop {
                tokio::select! {
                    biased;
                    code = signals::stopped() => return Err(Fail::silent(code)),
                    written = writer.next_written() => { written?; }
                    update = source.updates.recv(), if writer.has_room() => match update {
                        Some(Ok(Update::Step(news))) => {
                            // Frames that the master has done but that are not here yet count.
                            step = Step { frames: news.frames.max(step.frames), ..news };
                            progress.step(step.clone());
                        }
                        Some(Ok(Update::Frame { frame, stats: facts, stats_json, trace_json })) => {
                            let begins = frame.number == 0;
                            step.frames = step.frames.max(frame.number + 1);
                            // People count frames of the whole path.
                            let number = frame.number + request.path.first_frame() as u64;
                            let frame = Frame { number, ..frame };
                            last = Instant::now();
                            first.get_or_insert(last);
                            step = Step { frames: step.frames, ..Step::default() };
                            let Some(facts) = facts else {
                                progress.step(step.clone());
                                writer.put(frame, None);
                                continue;
                            };
                            look.at(&frame, &facts, info, &request);
                            stats.put(&format!("{stats_json}\n"))?;
                            trace.put(&trace_json)?;
                            progress.step(step.clone());
                            if show == Some(DebugView::Owner) {
                                writer.put(debug_views::owner(&frame, &facts), None);
                                continue;
                            }
                            let made = match output.format {
                                Format::Apng if begins => Some(recipe.movie(&facts)),
                                Format::Apng | Format::Y4m => None,
                                Format::Png | Format::Png16 | Format::Exr => {
                                    Some(recipe.frame(&facts))
                                }
                            };
                            writer.put(frame, made);
                        }
                        Some(Ok(Update::Done)) => return Ok(()),
                        Some(Err(e)) => return Err(e),
                        None => return Err(Fail::failed("the job's updates ended early")),
                    },
                }
            }
        }
        .await;
        if ended.is_err() {
            patience.give_up();
            source.cancel.now().await;
        }
        // What is being encoded is whole in a moment: it is kept. Who reads a pipe may have
        // stopped, though.
        let patient = if ended.is_err() { LAST } else { Duration::MAX };
        let drained = match tokio::time::timeout(patient, writer.end()).await {
            Ok(drained) => drained,
            Err(_) => Ok(()),
        };
        let ended = ended.and(drained);
        progress.end();
        let on_stdout = stats.on_stdout() || output.on_stdout();
        let written = writer.written().to_vec();
        if !written.is_empty() {
            stats.keep()?;
            trace.keep()?;
        }
        let kept = format!("{} of {total} frame{s} in {}", written.len(), output.shown(&written));
        if let Err(fail) = ended {
            if fail.line().is_none() {
                let kept = if written.is_empty() {
                    "nothing was kept".into()
                } else {
                    format!("kept {kept}")
                };
                progress::say_on_stderr(&format!("stopped: {kept}"));
            } else if !written.is_empty() {
                progress::note(&format!("kept {kept}"));
            }
            return Err(fail);
        }
        look.warn();
        let mut line = format!(
            "{total} frame{s} in {}, {}",
            output.shown(&written),
            progress::time(began.elapsed())
        );
        if let Some(first) = first
            && total > 1
        {
            let each = (last - first).as_secs_f64() * 1e3 / (total - 1) as f64;
            line += &format!(
                ": the first after {}, then {each:.0} ms each",
                progress::time(first - began)
            );
        }
        if !tell {
            // Whoever asked says it.
        } else if on_stdout {
            progress::say_on_stderr(&line);
        } else {
            say(&format!("{line}\n"))?;
        }
        look.verdict()
    }
}

/// Frames' time lines, put into one file.
struct Trace {
    lines: Lines,
    any: bool,
}

impl Trace {
    fn new(lines: Lines) -> Self {
        Trace { lines, any: false }
    }

    /// Adds a frame's events (a JSON array).
    fn put(&mut self, array: &str) -> Result<(), Fail> {
        let events = array.trim().trim_start_matches('[').trim_end_matches(']').trim();
        if !self.lines.wanted() || events.is_empty() {
            return Ok(());
        }
        let before =
            if self.any { ",\n" } else { "{\"displayTimeUnit\":\"ms\",\"traceEvents\":[\n" };
        self.any = true;
        self.lines.put(before)?;
        self.lines.put(events)
    }

    fn keep(mut self) -> Result<(), Fail> {
        if self.lines.wanted() {
            let begin = if self.any { "" } else { "{\"displayTimeUnit\":\"ms\",\"traceEvents\":[" };
            self.lines.put(&format!("{begin}\n]}}\n"))?;
        }
        self.lines.keep()
    }
}

/// Watches for blank frames, so that a note can give the reason.
#[derive(Default)]
struct Look {
    blank: Vec<u64>,
    why: Option<String>,
    incomplete: Vec<u64>,
    rehearsed: bool,
}

impl Look {
    fn at(
        &mut self,
        frame: &Frame,
        facts: &FrameStats,
        info: &VolumeInfo,
        request: &RenderRequest,
    ) {
        self.rehearsed |= facts.rehearsed;
        if !facts.poisoned.is_empty() {
            self.incomplete.push(frame.number);
        }
        let pixel = frame.format.bytes();
        // Each pixel is the one before it.
        let all_same = frame.bytes.len() < pixel
            || frame.bytes[pixel..] == frame.bytes[..frame.bytes.len() - pixel];
        let (lo, hi) = info.summary.range();
        let tf = request.transfer.name();
        let why = if facts.voxels.relevant == 0 && lo == hi {
            format!("every value of the volume is {lo}, and `--tf {tf}` leaves that invisible")
        } else if facts.voxels.relevant == 0 && request.path.crop.is_some() {
            format!("no voxel in the cropping box is visible under `--tf {tf}`; widen --crop")
        } else if facts.voxels.relevant == 0 {
            format!(
                "no voxel is visible under `--tf {tf}` (values go from {lo} to {hi}); try another \
                 --tf, `slabcast info` shows what each would draw"
            )
        } else if !all_same {
            return;
        } else if facts.voxels.splatted == 0 {
            "the volume lies outside the view, or between its pixels; check eye, target and height, or ask for a larger --size".into()
        } else if request.background == slabcast_common::image::Background::Transparent
            || frame.bytes[..pixel.div_ceil(4) * 3].iter().all(|&b| b == 0)
        {
            format!("what is in view is too faint to see; raise the opacities of `--tf {tf}`")
        } else {
            // Filled by one colour, or hidden by a background of its own colour: no mistake of
            // ours to guess.
            return;
        };
        self.blank.push(frame.number);
        self.why.get_or_insert(why);
    }

    fn warn(&self) {
        if self.rehearsed {
            progress::warn(
                "the master rehearses: nothing was drawn, and the pictures are stripes; render on a \
                 master without --rehearse",
            );
        }
        if let Some(why) = &self.why {
            let which = match &self.blank[..] {
                [one] => format!("frame {one} is"),
                many => format!("{} frames are", many.len()),
            };
            progress::warn(&format!("{which} blank: {why}"));
        }
    }

    fn verdict(&self) -> Result<(), Fail> {
        match &self.incomplete[..] {
            [] => Ok(()),
            some => Err(Fail::failed(format!(
                "frame {} has tiles that were given up after three workers were lost with them \
                 (--stats lists them as `poisoned`); see the workers' logs, then render again with \
                 --force",
                some.iter().map(u64::to_string).collect::<Vec<_>>().join(", ")
            ))),
        }
    }
}
