//! Runs the measurements of a study, in an order in which the finished parts stand alone after
//! Ctrl-C.

use super::paper::{self, NODES};
use super::simulate::{MeasuredPath, Pace};
use super::{
    Effects, Machine, Study, StudyArgs, effects, live, nodes, order, runs, verdict, write,
};
use crate::plan::measure::{self, MeasureArgs};
use crate::plan::{GOODPUT, pinged};
use slabcast_common::quality::{Borders, Kernel, Quality, Schedule, Work};
use slabcast_common::view::MAX_EDGE;
use slabcast_session::fail::Fail;
use slabcast_session::machine;
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::progress::{self, Progress, Step};
use slabcast_session::request::{OpenedVolume, RenderRequest};
use slabcast_session::signals;
use slabcast_sim::Link;
use slabcast_trace::Pings;

/// Number of frames for each radius or picture size.
const EFFECT_FRAMES: usize = 3;
/// Number of views with `--quick`.
const QUICK_VIEWS: usize = 6;
/// Ratio of macrotiles to rendering nodes: the middle of the paper's 2 to 3 (4.3).
const TILES_A_NODE: f64 = 2.5;

/// Returns the work of the slab schedule in `slabs` slabs of equal thickness, as in the paper.
fn work(slabs: u32) -> Work {
    Work {
        slabs,
        tiles_per_worker: TILES_A_NODE,
        schedule: Schedule::Slab,
        borders: Borders::Equal,
        ..Work::default()
    }
}

/// A study in progress.
pub(super) struct Bench<'a> {
    args: &'a StudyArgs,
    request: RenderRequest,
    opened: OpenedVolume,
    link: Link,
    repeats: u32,
    views: usize,
    /// Processor time of messages here; `None` if it could not be measured.
    pings: Option<Pings>,
    /// Numbers of rendering nodes that are run for real.
    live: Vec<u32>,
    progress: Progress,
    done: usize,
}

impl Bench<'_> {
    /// Opens the volume and refuses requests that can't be drawn.
    pub(super) fn open(args: &StudyArgs) -> Result<Bench<'_>, Fail> {
        let mut request = args.of.request_before(work(paper::SLABS[0]))?;
        if args.quick && request.path.frames() > QUICK_VIEWS {
            let first = request.path.first_frame() as u32;
            request.path.range = Some([first, first + QUICK_VIEWS as u32 - 1]);
        }
        let mut progress = Progress::new(false).counting("view");
        progress.phase(&format!("reading {}", args.of.volume.display()));
        let opened = args.of.open(&mut request)?;
        progress.phase("measuring what messages take");
        let pings = pinged();
        let cores = machine::cores();
        let views = request.path.frames();
        // 2, 4, 8, 12 and 15 rendering nodes, and one.
        let live = std::iter::once(1).chain(NODES.map(|n| n - 1)).filter(|n| *n <= cores).collect();
        Ok(Bench {
            args,
            request,
            opened,
            link: Link {
                bytes_per_s: args.link.0.map(|bits| bits / 8.0 * GOODPUT),
                latency_ns: args.latency,
            },
            repeats: if args.quick { 1 } else { args.repeats },
            views,
            pings,
            live,
            progress,
            done: 0,
        })
    }

    fn scenes(&self, request: &RenderRequest) -> Result<PathScenes, Fail> {
        PathScenes::new(&self.opened.volume, &self.opened.info, request, self.opened.orientation)
    }

    /// Draws and times the tiles of some views, for simulation.
    fn measure_path(
        &mut self,
        scenes: &PathScenes,
        request: &RenderRequest,
        views: usize,
        schedules: &[Schedule],
        repeats: u32,
    ) -> Result<MeasuredPath, Fail> {
        let most = NODES.iter().map(|n| n - 1).chain(self.live.iter().copied());
        let wanted = most.chain([paper::FIGURE_1_WORKERS]);
        let path = MeasureArgs {
            scenes,
            frames: views,
            work: request.work,
            wanted: wanted.map(|n| (TILES_A_NODE * f64::from(n)).ceil() as u64).collect(),
            edges: vec![32, 64],
            slab: true,
            region: schedules.contains(&Schedule::Region),
            repeats,
            pings: self.pings,
            names: (self.opened.volume.name.clone(), request.transfer.name()),
        };
        let jobs = measure::jobs(scenes, views, request.work)?;
        let trace = measure::measure(&path, (&mut self.progress, self.done))?;
        self.done += views;
        MeasuredPath::new(jobs, trace, self.link, schedules, NODES[4] - 1)
    }

    /// Runs the study; after Ctrl-C returns the finished parts.
    pub(super) fn study(mut self) -> Result<Study, Fail> {
        let threads = machine::cores() as usize;
        let mut request = self.request.clone();
        self.progress.phase("cutting the volume into bricks");
        let scenes = self.scenes(&request)?;
        let settings = self.settings();
        let of_effects: usize = settings.iter().map(|_| EFFECT_FRAMES.min(self.views)).sum();
        let of_live = self.live.len() * 2 * self.request.path.frames();
        let total = 2 * self.views + of_live + of_effects;
        self.progress.frames(total as u64, &format!("drawing the tiles of {total} views"));

        let schedules = [Schedule::Slab, Schedule::Region];
        let views = self.views;
        let measured_path =
            self.measure_path(&scenes, &request, views, &schedules, self.repeats)?;
        let mut study = self.empty(&scenes, &measured_path);
        if measured_path.trace.frames.len() < 2.min(views) {
            self.progress.end();
            return Err(Fail::failed("stopped before two views were drawn; nothing is written"));
        }
        if measured_path.trace.frames.iter().flat_map(|f| &f.slabs).all(|s| s.levels.is_empty()) {
            self.progress.end();
            return Err(Fail::failed(
                "no view shows anything: there is nothing to time; give another --tf or --crop \
                 (`slabcast info VOLUME` has the range of values)",
            ));
        }
        let stopped = measured_path.trace.frames.len() < views;
        study.views = measured_path.trace.frames.len();
        study.figure_1 = order::find(&measured_path)?;
        study.table_1 = nodes::table_1(&measured_path)?;
        study.figure_3 = nodes::breakdowns(&measured_path)?;
        study.runs = runs::simulated(&measured_path, Schedule::Slab, &self.live, threads)?;
        study.runs.extend(runs::simulated(&measured_path, Schedule::Region, &self.live, threads)?);
        study.effects.bricks = effects::bricks(&scenes, &measured_path);

        let alone = measured_path.alone_ms(Pace::Here);
        if !(stopped || signals::stop_requested()) {
            let works = paper::SLABS.map(work);
            for workers in self.live.clone() {
                self.progress.step(Step {
                    frames: self.done as u64,
                    detail: format!("{workers} workers of this machine"),
                    ..Step::default()
                });
                let reports = live::run(&self.opened, &self.request, workers, &works)?;
                for (slabs, frames) in paper::SLABS.into_iter().zip(&reports) {
                    study.runs.push(runs::measured(slabs, workers, alone, frames));
                }
                self.done += 2 * self.request.path.frames();
                if signals::stop_requested() {
                    break;
                }
            }
        }
        if !(stopped || signals::stop_requested()) {
            request.work = work(paper::SLABS[1]);
            let five =
                self.measure_path(&scenes, &request, views, &[Schedule::Slab], self.repeats)?;
            if five.trace.frames.len() == views {
                study.runs.extend(runs::simulated(&five, Schedule::Slab, &self.live, threads)?);
            }
            study.effects.culling = Some(effects::culling(&scenes, views)?);
        }
        drop(scenes);
        let stretch = measured_path.stretch(Pace::Paper);
        for (name, request) in settings {
            if stopped || signals::stop_requested() {
                break;
            }
            let scenes = self.scenes(&request)?;
            let n = EFFECT_FRAMES.min(views);
            let measured_path = self.measure_path(&scenes, &request, n, &[Schedule::Slab], 1)?;
            if measured_path.trace.frames.len() == n {
                let is_radius = name.starts_with("radius");
                let setting = effects::Setting::new(name, &measured_path, stretch)?;
                let effects = &mut study.effects;
                if is_radius { effects.radii.push(setting) } else { effects.sizes.push(setting) }
            }
        }
        self.progress.end();
        if stopped || signals::stop_requested() {
            progress::note("stopped: the finished parts are written");
            study.left_out.push("Stopped before the end: later parts are missing.".into());
        } else {
            study.complete = true;
        }
        study.figure_4 = runs::data(&study.runs, study.voxels, study.bytes);
        study.verdicts = verdict::verdicts(&study);
        Ok(study)
    }

    /// Returns name and request of each radius and picture size, varied one at a time.
    fn settings(&self) -> Vec<(String, RenderRequest)> {
        let mut all = Vec::new();
        let base = &self.request;
        if base.quality.kernel == Kernel::Gaussian {
            for radius in [1.0, 1.5, 2.0] {
                let quality = Quality { radius, ..base.quality };
                if quality.check().is_ok() {
                    let mut request = base.clone();
                    request.quality = quality;
                    all.push((format!("radius {radius}"), request));
                }
            }
        }
        // The paper's 512, 1024 and 2048 for the default size.
        let times: &[u32] = if self.args.quick { &[1, 2] } else { &[1, 2, 4] };
        for n in times {
            let [w, h] = base.path.size.map(|x| x * n);
            if w.max(h) <= MAX_EDGE {
                let mut request = base.clone();
                request.path.size = [w, h];
                all.push((format!("{w}x{h}"), request));
            }
        }
        all
    }

    /// Returns a study without results.
    fn empty(&self, scenes: &PathScenes, measured_path: &MeasuredPath) -> Study {
        let mut left_out = vec![
            "Bricks of 4 and 16 voxels are counted, not drawn: slabcast's bricks are 8. The paper has \
             no numbers for them either."
                .to_string(),
        ];
        if self.request.quality.kernel != Kernel::Gaussian {
            left_out.push("The kernel has one radius: only --kernel gaussian has several.".into());
        }
        if self.args.quick {
            left_out.push(
                "--quick: six views at most, each tile drawn once, not four times the size.".into(),
            );
        }
        let q = &self.request.quality;
        let [std, radius] = q.kernel_shape();
        Study {
            version: 1,
            slabcast: env!("CARGO_PKG_VERSION"),
            pixels_version: slabcast_common::PIXELS_VERSION,
            command: write::command(),
            volume: self.opened.volume.name.clone(),
            digest: self.opened.info.digest.to_string(),
            tf: self.request.transfer.name(),
            size: self.request.path.size,
            views: self.views,
            kernel: format!(
                "{}, {std:.2} wide, cut at {radius}",
                crate::autotune::setting::lower(&q.kernel)
            ),
            machine: Machine {
                cpu: slabcast_session::machine::cpu(),
                cores: machine::cores() as usize,
                simd: slabcast_render::Simd::detect().name(),
            },
            link: self.args.link.to_string(),
            latency_us: self.args.latency as f64 / 1e3,
            repeats: self.repeats,
            voxels: scenes.bricks.iter().map(|b| b.len() as u64).sum(),
            bytes: scenes.bricks.iter().map(|b| b.encoded_len() as u64).sum(),
            alone_ms: measured_path.alone_ms(Pace::Here),
            stretch: measured_path.stretch(Pace::Paper),
            complete: false,
            left_out,
            verdicts: Vec::new(),
            table_1: Vec::new(),
            table_1_of_the_paper: paper::TABLE_1,
            figure_1: None,
            figure_3: Vec::new(),
            figure_4: Vec::new(),
            runs: Vec::new(),
            effects: Effects::default(),
        }
    }
}
