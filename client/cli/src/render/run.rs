//! One run: takes updates from whoever renders, writes frames, and says how it ended.

use super::debug_views::{self, DebugView};
use super::frame_check::FrameCheck;
use super::trace::TraceFile;
use slabcast_common::level::{LevelChoice, LevelStats};
use slabcast_common::view::CameraProjection;
use slabcast_common::volume::VolumeInfo;
use slabcast_scene::path::{Orientation, ViewPath};
use slabcast_scene::presets;
use slabcast_scene::request::PathRequest;
use slabcast_session::fail::{Fail, say};
use slabcast_session::figure::Marker;
use slabcast_session::output::provenance::RunProvenance;
use slabcast_session::output::{DiskWait, Frame, Lines, Output, Writer};
use slabcast_session::progress::{self, Progress, Step};
use slabcast_session::request::RenderRequest;
use slabcast_session::signals;
use slabcast_session::source::{Source, Update};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Time for frames that are being written once the run has failed or was stopped: ten times what
/// the largest picture takes on a slow disk.
const LAST: Duration = Duration::from_secs(20);

/// State of one run, whoever renders its frames.
pub(super) struct Run {
    pub(super) request: RenderRequest,
    /// Whether the up axis was given or needs no note.
    pub(super) stands: bool,
    pub(super) output: Output,
    pub(super) show: Option<DebugView>,
    pub(super) patience: Arc<DiskWait>,
    /// Notes for stderr once the request has been accepted.
    pub(super) notes: Vec<String>,
    pub(super) stats: Lines,
    pub(super) trace: Lines,
    pub(super) record: Option<PathBuf>,
    pub(super) progress: Progress,
    pub(super) began: Instant,
    /// Whether the run ends with a line that names the pictures.
    pub(super) tell: bool,
}

/// Fields of view from which on people lose sight of where the eye is: at 60 degrees it is 0.87
/// times the picture's height away from the target.
const WIDE: f64 = 60.0;

/// Says where the eye is if a wide field of view takes it near to the volume or into it.
fn where_the_eye_is(path: &ViewPath, info: &VolumeInfo, o: Orientation) -> Option<String> {
    let lattice = &info.lattice;
    let camera = path.camera(0, lattice, o).ok()?;
    let CameraProjection::Persp { fov, distance } = camera.projection else { return None };
    let eye = camera.target + camera.to_eye.normalize() * distance;
    let index = lattice.world_from_index().inverse() * eye + lattice.centre_index();
    let inside = (0..3).all(|a| (-0.5..f64::from(lattice.dims[a]) - 0.5).contains(&index[a]));
    let unit = if info.summary.anatomical { " mm" } else { "" };
    let place = format!("--fov {fov}: the eye is {distance:.3}{unit} from the target");
    if inside {
        Some(format!(
            "{place}, inside the volume: nothing behind it is drawn; give a smaller --fov or a larger \
             --height to stand back"
        ))
    } else {
        (fov > WIDE).then(|| format!("{place}; what is near it looks large"))
    }
}

/// Says which level `--level auto` became.
fn drawn_level(level: &LevelStats) -> String {
    let LevelStats { level, samples, finest_samples, .. } = level;
    if *level == 0 {
        return "--level auto: all detail is drawn, since samples cover a pixel or more".into();
    }
    let share = *finest_samples as f64 / (*samples).max(1) as f64;
    format!(
        "--level auto: level {level} is drawn, 1 of {share:.0} samples; `slabcast lab error --level \
         {level}` says what it costs"
    )
}

impl Run {
    /// Returns a run that prints nothing at its end.
    pub(super) fn bare(request: RenderRequest, output: Output, quiet: bool) -> Run {
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

    pub(super) fn request(&mut self, info: &VolumeInfo) -> PathRequest {
        let format = self.output.takes(self.request.magnify, self.request.background);
        self.request.to_message(info, format, self.trace.wanted())
    }

    /// All that can be refused is; the folder is there.
    pub(super) fn ready(
        &mut self,
        info: &VolumeInfo,
        orientation: Orientation,
        anatomical: bool,
    ) -> Result<RunProvenance, Fail> {
        // From here on there may be files to clean up.
        signals::listen();
        self.request.fit(info, orientation, anatomical)?;
        let as_what = (self.output.format, self.output.fps());
        let figure = &self.output.figure;
        let recipe = RunProvenance::new(&self.request, info, orientation, as_what, figure)?;
        // Errors of marks are reported before any work.
        self.marker(recipe.path().clone(), info, orientation)?;
        self.output.make()?;
        if self.tell
            && let Some(name) = self.request.transfer.preset()
            && let Some(why) = presets::caveat(name, &info.summary)
        {
            self.notes.push(format!("--tf {name}: {why}"));
        }
        self.notes.iter().for_each(|n| progress::note(n));
        Ok(recipe)
    }

    /// The marks over the pictures of a path whose numbers are known.
    fn marker(
        &self,
        path: ViewPath,
        info: &VolumeInfo,
        orientation: Orientation,
    ) -> Result<Option<Marker>, Fail> {
        let Run { request, output, .. } = self;
        Marker::new(&output.figure, request, path, info, orientation, output.is_grid())
    }

    /// Takes frames until the last one is on disk, Ctrl-C, or trouble.
    pub(super) async fn go(
        self,
        mut source: Source,
        what: &str,
        (info, orientation): (&VolumeInfo, Orientation),
        recipe: &RunProvenance,
    ) -> Result<(), Fail> {
        let recipe = &recipe.clone().framed(source.framing.as_ref());
        let marker = self.marker(recipe.path().clone(), info, orientation)?;
        if self.tell
            && self.request.path_file.is_none()
            && let Some(note) = where_the_eye_is(recipe.path(), info, orientation)
        {
            progress::note(&note);
        }
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
        let mut writer = Writer::new(output.clone(), total, marker, patience.clone())?;
        let mut trace = TraceFile::new(trace);
        let mut check = FrameCheck::default();
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
                            check.look(&frame, &facts, info, &request);
                            if let Some(level) = facts.level.filter(|_| begins && tell)
                                && request.level == LevelChoice::Auto
                            {
                                progress::note(&drawn_level(&level));
                            }
                            stats.put(&format!("{stats_json}\n"))?;
                            trace.put(&trace_json)?;
                            progress.step(step.clone());
                            if show == Some(DebugView::Owner) {
                                writer.put(debug_views::owner(&frame, &facts), None);
                                continue;
                            }
                            let made = if output.is_whole() {
                                begins.then(|| recipe.movie(&facts))
                            } else {
                                output.has_provenance().then(|| recipe.frame(&facts))
                            };
                            writer.put(frame, made);
                        }
                        Some(Ok(Update::FrameFailed { number, reason })) => {
                            step.frames = step.frames.max(number + 1);
                            let number = number + request.path.first_frame() as u64;
                            progress::warn(&format!("frame {number} failed: {reason}"));
                            check.failed(number);
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
        // The frame that is being encoded is kept, since it is complete in a moment. But the reader
        // of a pipe may have stopped, so there is a limit.
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
        check.warn();
        let failures = check.verdict();
        if failures.is_err() {
            let kept =
                if written.is_empty() { "nothing was kept".into() } else { format!("kept {kept}") };
            progress::note(&kept);
            return failures;
        }
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
        Ok(())
    }
}
