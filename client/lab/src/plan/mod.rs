//! `slabcast lab plan`: predicts the frame times of a cluster that does not exist yet.
//!
//! Measured and predicted figures are kept apart in the output. `measure` draws every tile of the
//! path here, on one core, and sizes its messages. `predict` runs the scheduler itself with these
//! tiles against virtual workers and links (`slabcast_sim`). `costs` has the processor time of
//! messages, from the `pings` measured here. `chart` draws the prediction. `rehearse` tests it with
//! real processes on this machine.

mod chart;
pub(crate) mod clock;
mod costs;
pub(crate) mod measure;
mod pings;
pub(crate) mod predict;
mod rehearse;

use crate::chart::{LIGHT, save};
use predict::{IN_FLIGHT, LEAST_STEADY_FRAMES, LOSSES, Question, Row};
use rehearse::Network;
use slabcast_common::quality::{Schedule, Work};
use slabcast_schedule::FrameJob;
use slabcast_session::fail::{Fail, say};
use slabcast_session::output::{OutputFolder, probe, write_atomic};
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::progress::{self, Progress, warn};
use slabcast_session::request::{OpenedVolume, RenderRequest, VolumeSceneArgs, WorkArgs};
use slabcast_session::{machine, parse, signals};
use slabcast_sim::{Link, one_core_ms};
use slabcast_trace::{MAX_BYTES, Pings, Trace};
use std::fmt::Write as _;
use std::io::{Read, Write};
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Share of a link's nominal rate that is left for payload after the headers of Ethernet, IP, TCP
/// and HTTP/2. 118 MB/s were measured on an emulated link of 1 Gbit/s (docs/design/transport.md,
/// answer 7).
pub(crate) const GOODPUT: f64 = 0.94;

/// Predicts frame times of a cluster before it is there.
///
/// Also predicts its efficiency and the bytes it sends.
///
/// First the tiles of the path are drawn and timed here, on one core. Then the scheduler itself
/// runs with these times against virtual workers and links. The table separates measured from
/// predicted.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast lab plan brain.nii.gz --workers 1..64 --link 1gbit
  slabcast lab plan ct.nrrd --tf bone --size 1024x1024 --workers 8,16,32 --link 10gbit --threads 16 -o plan/
  slabcast lab plan ct.nrrd --tf bone --trace ct.trace --workers 40 --link 1gbit --latency 500us
  slabcast lab plan ct.nrrd --tf bone --trace ct.trace --rehearse 2,8,15

The first command with --trace FILE measures and writes FILE; later ones read it, and only predict.")]
pub struct PlanArgs {
    #[command(flatten)]
    of: VolumeSceneArgs,
    #[command(flatten)]
    work: WorkArgs,
    /// Numbers of workers: a list or ranges, such as 1..64 or 1,2,4,8
    #[arg(long, value_name = "LIST", default_value = "1,2,4,8,16,32,64",
          value_parser = parse::workers, help_heading = "Cluster")]
    workers: parse::Workers,
    /// Render threads of each worker, one core each
    #[arg(long, value_name = "N", default_value = "1", help_heading = "Cluster",
          value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: u32,
    /// Link of every machine, master included: 1gbit, 10gbit, 100mbit or unlimited
    #[arg(long, value_name = "RATE", default_value = "1gbit", value_parser = parse::link,
          help_heading = "Cluster")]
    link: parse::Rate,
    /// One-way latency between machines
    #[arg(long, value_name = "TIME", default_value = "50us", value_parser = parse::latency,
          help_heading = "Cluster")]
    latency: u64,
    /// Times each tile is drawn; the shortest time counts
    #[arg(long, value_name = "N", default_value = "3", hide_short_help = true, help_heading = "Measuring",
          value_parser = clap::value_parser!(u32).range(1..=100))]
    repeats: u32,
    /// Use the message costs of a known machine instead of measuring them
    #[arg(long, hide = true)]
    no_pings: bool,
    /// Trace of measured tiles; read if the file exists, else written
    #[arg(long, value_name = "FILE", help_heading = "Measuring")]
    trace: Option<PathBuf>,
    /// Compare with real processes: starts a master and this many workers here, which hold each
    /// tile for its measured time (needs --trace)
    #[arg(long, value_name = "LIST", value_parser = parse::workers, requires = "trace",
          help_heading = "Measuring")]
    rehearse: Option<parse::Workers>,
    /// Address at which the rehearsal's master listens, open to anyone who reaches it: one that
    /// workers reach over a link of --link's rate, such as docs/measurements/scripts/shaped.sh
    /// makes [default: 127.0.0.1, unlimited]
    #[arg(
        long,
        value_name = "ADDRESS",
        requires = "rehearse",
        hide_short_help = true,
        help_heading = "Measuring"
    )]
    rehearse_at: Option<IpAddr>,
    /// Command that starts the rehearsal's workers, such as `ip netns exec far`; this program and
    /// its arguments are appended
    #[arg(
        long,
        value_name = "COMMAND",
        requires = "rehearse_at",
        hide_short_help = true,
        help_heading = "Measuring"
    )]
    rehearse_by: Option<String>,
    /// Folder for plan.svg, plan.png, plan.json and plan.csv
    #[arg(short = 'o', long = "output", value_name = "DIR", help_heading = "Output")]
    output: Option<PathBuf>,
    /// As JSON
    #[arg(long, help_heading = "Output")]
    json: bool,
    /// No progress
    #[arg(short, long, help_heading = "Output")]
    quiet: bool,
}

/// Runs `slabcast lab plan`: measures or reads the tiles, and prints the prediction as a table or
/// as JSON; with `--output` also writes chart and tables.
///
/// # Errors
/// The arguments or the volume are refused, the trace is of another path, a rehearsal fails, or a
/// file can't be read or written.
pub fn run(args: &PlanArgs) -> Result<(), Fail> {
    let work = args.work.work()?;
    // With `auto`, both schedules are shown.
    let schedules = match work.schedule {
        Schedule::Auto => vec![Schedule::Region, Schedule::Slab],
        one => vec![one],
    };
    let mut request = args.of.request(work)?;
    let workers = &args.workers.0;
    let most = workers.iter().copied().max().unwrap_or(1);
    if u64::from(most) * u64::from(args.threads) > 65536 {
        return Err(Fail::usage(format!(
            "--workers, --threads: {most} x {} threads; give 65536 in all at most",
            args.threads
        )));
    }
    if let Some(parse::Workers(list)) = &args.rehearse {
        if list.iter().any(|n| n * args.threads > 512) {
            return Err(Fail::usage(
                "--rehearse, --threads: give 512 threads in all at most; each is one of this \
                 machine's",
            ));
        }
        if !args.of.input_is_empty() {
            return Err(Fail::usage(
                "--rehearse: its master reads the volume without --dims, --type and the like; \
                 `slabcast convert` it first",
            ));
        }
    }
    let mut progress = Progress::new(args.quiet);
    // Checked before minutes of measuring; the folder is removed again if it stays empty.
    let _made = args.output.as_deref().map(OutputFolder::new).transpose()?;
    if let Some(file) = args.trace.as_deref().filter(|file| !file.exists()) {
        probe(file)?;
    }
    let OpenedVolume { volume, info, orientation } = args.of.open(&mut request)?;
    progress.phase("cutting the volume into bricks");
    let names = (volume.name.clone(), request.transfer.name().to_string());
    let scenes = PathScenes::new(&volume, &info, &request, orientation)?;
    drop(volume);
    let frames = request.path.frames();
    let jobs = measure::jobs(&scenes, frames, work)?;
    let more = args.rehearse.iter().flat_map(|list| &list.0);
    let wanted = workers.iter().chain(more).map(|n| {
        let threads = f64::from(*n) * f64::from(args.threads);
        (work.tiles_per_worker * threads).ceil() as u64
    });
    let measured = match &args.trace {
        Some(file) if file.exists() => {
            let trace = read_trace(file)?;
            measure::fits(&trace, &jobs)
                .map_err(|e| Fail::failed(format!("{}: {e}", file.display())))?;
            Measured { trace, now: false }
        }
        file => {
            let began = Instant::now();
            let pings = if args.no_pings {
                None
            } else {
                progress.phase("measuring what messages take");
                pinged()
            };
            let pinging = began.elapsed();
            progress.frames(frames as u64, &format!("drawing the tiles of {frames} frames"));
            let measure_args = measure::MeasureArgs {
                scenes: &scenes,
                frames,
                work,
                wanted: wanted.collect(),
                edges: Vec::new(),
                slab: schedules.contains(&Schedule::Slab),
                region: schedules.contains(&Schedule::Region),
                repeats: args.repeats,
                pings,
                names,
            };
            let began = Instant::now();
            let mut trace = measure::measure(&measure_args, (&mut progress, 0))?;
            // Pinging again some time later evens out disturbances; useless at once or after a
            // failure.
            let later = began.elapsed() > pinging;
            if let Some(before) = pings.filter(|_| later && !signals::stop_requested()) {
                progress.phase("measuring what messages take");
                trace.about.pings =
                    pings::measure().map_or(pings, |now| Some(pings::least(before, now)));
            }
            if let Some(file) = file {
                write_atomic(file, |out| out.write_all(trace.to_json().as_bytes()))?;
            }
            Measured { trace, now: true }
        }
    };
    progress.end();
    let held = held(&scenes);
    drop(scenes);
    let link = Link {
        bytes_per_s: args.link.0.map(|bits| bits / 8.0 * GOODPUT),
        latency_ns: args.latency,
    };
    let question =
        Question { threads: args.threads, link, cores: None, stretch: 1.0, mixed: false };
    let threads = machine::cores() as usize;
    let mut predicted = Vec::new();
    for schedule in schedules {
        let work = |job: &FrameJob| Work { schedule, ..job.work };
        let jobs: Vec<FrameJob> =
            jobs.iter().map(|job| FrameJob { work: work(job), ..job.clone() }).collect();
        let trace = &measured.trace;
        let costs = costs::messages(trace, schedule);
        let rehearsed = match (&args.rehearse, &args.trace) {
            (Some(list), Some(file)) => {
                let mut request: RenderRequest = request.clone();
                request.work.schedule = schedule;
                let rehearsals = rehearse::Rehearsals {
                    volume: &args.of.volume,
                    file,
                    trace,
                    jobs: &jobs,
                    request: &request,
                    axes: &args.of.scene.view.axes,
                    threads: args.threads,
                    costs,
                    network: match args.rehearse_at {
                        Some(listen) => {
                            Network { listen, worker_launcher: args.rehearse_by.as_deref(), link }
                        }
                        None => Network::LOOPBACK,
                    },
                };
                let mut progress = Progress::new(args.quiet);
                let rehearsed = rehearsals.run(&list.0, &mut progress);
                progress.end();
                rehearsed?
            }
            _ => Vec::new(),
        };
        let rows = predict::rows(&jobs, trace, workers, &question, costs, threads)?;
        let orders = match schedule {
            // At most 8 workers: their tiles are of 64 pixels, as in the paper.
            Schedule::Region => predict::orders(&jobs, trace, most.min(8))?,
            Schedule::Slab | Schedule::Auto => None,
        };
        predicted.push(Predicted { schedule, rows, rehearsed, orders });
    }
    let output = PlanOutput { args, frames, held, measured: &measured, predicted: &predicted };
    if let Some(dir) = &args.output {
        output.write(dir)?;
    }
    say(&if args.json { format!("{}\n", output.json()) } else { output.table() })
}

/// Says which level is drawn, and what a worker that needs all of it is sent and holds.
fn held(scenes: &PathScenes) -> String {
    let volume = scenes.spec(0).volume;
    let [x, y, z] = volume.lattice.dims;
    let bytes: u64 = scenes.bricks.iter().map(|brick| brick.encoded_len() as u64).sum();
    let level = volume.level;
    format!("level {level}: {x} x {y} x {z} samples, {} of bricks", progress::bytes(bytes))
}

/// Measures the processor time of messages here; warns and returns `None` if that fails.
pub(crate) fn pinged() -> Option<Pings> {
    let measured = pings::measure();
    measured
        .inspect_err(|why| {
            warn(&format!(
                "message costs can't be measured here ({why}); using those of a known machine"
            ))
        })
        .ok()
}

/// Reads a trace of measured tiles from a JSON file, as `--trace` writes it.
///
/// # Errors
/// The file can't be read, is larger than any trace, or is no valid trace of this version.
pub fn read_trace(file: &Path) -> Result<Trace, Fail> {
    let mut bytes = Vec::new();
    std::fs::File::open(file)
        .and_then(|f| f.take(MAX_BYTES + 1).read_to_end(&mut bytes))
        .map_err(|e| Fail::io(file, "reading", &e))?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(Fail::failed(format!(
            "{}: is larger than a trace; give a file that --trace wrote",
            file.display()
        )));
    }
    Trace::from_json(&bytes).map_err(|e| Fail::failed(format!("{}: {e}", file.display())))
}

/// The measured half: tiles and how they were obtained.
struct Measured {
    trace: Trace,
    /// True if this command measured them, false if it read them from a file.
    now: bool,
}

/// Predictions for one schedule.
struct Predicted {
    schedule: Schedule,
    rows: Vec<Row>,
    rehearsed: Vec<rehearse::Rehearsed>,
    /// Rank correlation of estimated and measured tile times: by bricks, by earlier views.
    orders: Option<[f64; 2]>,
}

impl Predicted {
    fn name(&self) -> &'static str {
        match self.schedule {
            Schedule::Slab => "slab",
            Schedule::Region | Schedule::Auto => "region",
        }
    }
}

/// Returns a line about the processor time of messages.
fn pings_line(pings: Option<&Pings>) -> String {
    let Some(Pings { alone_ns, company_ns }) = pings else {
        return "messages: not measured here; those of an EPYC of 2.45 GHz".into();
    };
    let us = |ns: &[u64; 3]| ns.map(|ns| format!("{:.1}", ns as f64 / 1e3)).join(", ");
    format!(
        "a ping and its pong cost the master's driver, its streams and the worker {} us with one \
         worker, {} with {}",
        us(alone_ns),
        us(company_ns),
        pings::COMPANY
    )
}

/// Returns a table of where the render threads' time goes; empty if the path is too short.
fn losses_table(name: &str, rows: &[Row]) -> String {
    let steady_rows: Vec<_> = rows.iter().filter_map(|r| Some((r, r.steady.as_ref()?))).collect();
    if steady_rows.is_empty() {
        return String::new();
    }
    let mut text = format!("\n{name} schedule, four in flight: % of the render threads' time\n");
    let _ = write!(text, "{:>7} {:>8}", "workers", "alone");
    for (name, _) in LOSSES {
        let _ = write!(text, " {name:>8}");
    }
    let _ = writeln!(text, " | {:>6} {:>7} {:>8}", "driver", "streams", "decides");
    for (r, steady) in steady_rows {
        let alone = r.throughput.map_or(0.0, |t| t.1);
        let _ = write!(text, "{:>7} {:>8.1}", r.workers, 100.0 * alone);
        for part in steady.lost {
            let _ = write!(text, " {:>8.1}", 100.0 * part);
        }
        let [driver, streams] = steady.busy.map(|part| 100.0 * part);
        let decides = steady.deciding_ms;
        let _ = writeln!(text, " | {driver:>6.1} {streams:>7.1} {decides:>5.2} ms");
    }
    text
}

/// The prediction, ready to be printed and written.
struct PlanOutput<'a> {
    args: &'a PlanArgs,
    frames: usize,
    /// Level that is drawn, and the bricks of it.
    held: String,
    measured: &'a Measured,
    predicted: &'a [Predicted],
}

impl PlanOutput<'_> {
    fn tiles(&self) -> usize {
        let frames = &self.measured.trace.frames;
        let slabs = frames.iter().flat_map(|f| &f.slabs).flat_map(|s| &s.levels);
        let regions = frames.iter().flat_map(|f| &f.regions).map(|l| l.tiles.len());
        slabs.map(|l| l.tiles.len()).chain(regions).sum()
    }

    fn title(&self) -> String {
        let about = &self.measured.trace.about;
        let [w, h] = about.size;
        format!("{} {}, {} frames of {w}x{h}", about.volume, about.transfer, self.frames)
    }

    fn cluster(&self) -> String {
        let s = if self.args.threads == 1 { "" } else { "s" };
        format!(
            "workers of {} thread{s}, links of {}, {} us one way",
            self.args.threads,
            self.args.link,
            self.args.latency as f64 / 1e3
        )
    }

    fn table(&self) -> String {
        let trace = &self.measured.trace;
        let edge = trace.frames.last().map_or(64, |f| f.alone_edge);
        let when = if self.measured.now { "measured here" } else { "measured before (--trace)" };
        let mut text = format!(
            "{}; {}\n{}\n{when}: {} tiles, each {} times; alone, one core takes {:.2} ms a frame (tiles \
             of {edge} pixels)\n{}\npredicted from that, by the scheduler itself against virtual \
             workers and links:\n",
            self.title(),
            self.cluster(),
            self.held,
            self.tiles(),
            trace.about.repeats,
            one_core_ms(trace),
            pings_line(trace.about.pings.as_ref()),
        );
        for p in self.predicted {
            let slabs = match p.schedule {
                Schedule::Slab => format!(", {} slabs", trace.about.slabs),
                Schedule::Region | Schedule::Auto => String::new(),
            };
            let _ = writeln!(
                text,
                "\n{} schedule{slabs}\n{:>7} {:>9} {:>9} {:>6} {:>9} {:>6} {:>9} {:>9}  bound by",
                p.name(),
                "workers",
                "first ms",
                "ms",
                "eff.",
                "frames/s",
                "eff.",
                "KB",
                "brick KB"
            );
            for r in &p.rows {
                let throughput = r.throughput.map_or_else(
                    || format!("{:>9} {:>6}", "-", "-"),
                    |(frames, part)| format!("{frames:>9.1} {:>4.0} %", part * 100.0),
                );
                let _ = writeln!(
                    text,
                    "{:>7} {:>9.1} {:>9.2} {:>4.0} % {throughput} {:>9.0} {:>9.1}  {} {:.0} %",
                    r.workers,
                    r.first_ms,
                    r.frame_ms,
                    r.latency_efficiency * 100.0,
                    (r.bytes[0] + r.bytes[1]) / 1e3,
                    r.bytes[2] / 1e3,
                    r.bound.0.name(),
                    r.bound.1 * 100.0,
                );
            }
        }
        if self.predicted.iter().flat_map(|p| &p.rows).any(|r| r.throughput.is_none()) {
            let least = LEAST_STEADY_FRAMES + IN_FLIGHT as usize;
            let _ = writeln!(
                text,
                "\nframes/s: can't be told of {} frames; give --frames {least} or more",
                self.frames
            );
        }
        let losses: String =
            self.predicted.iter().map(|p| losses_table(p.name(), &p.rows)).collect();
        if !losses.is_empty() {
            text += &losses;
            text += "\nalone: eff. of frames/s. drawing: what tiles take beyond one core's share. tables: \
                     made by each worker for\na frame. messages: read and written. bricks: tiles lack \
                     some. on way: results and leases travel. dry: the\nmaster has nothing to lend. \
                     end: of the path. driver, streams: how busy the master's threads are, in %.\n\
                     decides: how long the driver decides for a frame but the first, measured here.\n";
        }
        for [plain, learned] in self.predicted.iter().filter_map(|p| p.orders) {
            let _ = writeln!(
                text,
                "\nOrder of tiles by estimate and by measured time (Spearman, 1 is the same): {plain:.2} by \
                 pixels under bricks, {learned:.2} by what\nthe views before took."
            );
        }
        text += "\nfirst ms: with all bricks. ms: a later frame, one in flight. frames/s: four in \
                 flight. eff.: against\none core's time alone over all render threads. KB, brick \
                 KB: a later frame's leases and results, and\nbricks. bound by: where most of a \
                 frame's time goes: cores (rendering, spread evenly), straggler\n(waiting for the \
                 last tile), link, or master (decisions and messages).\n";
        for p in self.predicted.iter().filter(|p| !p.rehearsed.is_empty()) {
            text += &rehearse::table(p.name(), self.args.rehearse_at, &p.rehearsed);
        }
        text
    }

    fn json(&self) -> serde_json::Value {
        let trace = &self.measured.trace;
        let rows = self.predicted.iter().flat_map(|p| p.rows.iter().map(move |r| (p.name(), r)));
        let rows: Vec<_> = rows
            .map(|(schedule, r)| {
                let ms = |i: usize| r.parts[i];
                serde_json::json!({
                    "schedule": schedule, "workers": r.workers, "first_ms": r.first_ms, "frame_ms": r.frame_ms,
                    "latency_efficiency": r.latency_efficiency,
                    "frames_per_s": r.throughput.map(|t| t.0),
                    "throughput_efficiency": r.throughput.map(|t| t.1),
                    "bytes_down": r.bytes[0], "bytes_up": r.bytes[1], "brick_bytes": r.bytes[2],
                    "leases": r.leases,
                    "render_threads": r.steady.as_ref().map(|s| {
                        let parts = LOSSES.iter().zip(s.lost);
                        let named = parts.map(|((_, name), part)| (name.to_string(), part.into()));
                        named.collect::<serde_json::Map<_, _>>()
                    }),
                    "master_busy": r.steady.as_ref().map(|s| {
                        serde_json::json!({ "driver": s.busy[0], "streams": s.busy[1] })
                    }),
                    "deciding_ms": r.steady.as_ref().map(|s| s.deciding_ms),
                    "messages": { "down": r.messages[0], "writes": r.messages[1], "up": r.messages[2] },
                    "bound_by": r.bound.0.name(), "bound_part": r.bound.1,
                    "parts_ms": { "cores": ms(0), "straggler": ms(1), "link": ms(2),
                                  "master": ms(3) },
                    "master_ms": { "driver": r.master_ms[0], "streams": r.master_ms[1],
                                   "finisher": r.master_ms[2] },
                })
            })
            .collect();
        let rehearsed = self.predicted.iter().flat_map(|p| rehearse::json(p.name(), &p.rehearsed));
        serde_json::json!({
            "version": 1,
            "measured": {
                "volume": trace.about.volume, "transfer": trace.about.transfer,
                "size": trace.about.size, "frames": trace.frames.len(), "tiles": self.tiles(),
                "repeats": trace.about.repeats, "simd": trace.about.simd,
                "slabs": trace.about.slabs, "alone_ms": one_core_ms(trace),
                "pings": trace.about.pings,
            },
            "cluster": {
                "threads": self.args.threads, "link": self.args.link.to_string(),
                "latency_us": self.args.latency as f64 / 1e3,
            },
            "predicted": rows,
            "rank_correlation": self.predicted.iter().find_map(|p| p.orders).map(|[plain, learned]| {
                serde_json::json!({ "plain": plain, "learned": learned })
            }),
            "rehearsed": rehearsed.collect::<Vec<_>>(),
        })
    }

    fn csv(&self) -> String {
        let mut text = "schedule,workers,first_ms,frame_ms,latency_efficiency,frames_per_s,\
                        throughput_efficiency,bytes_down,bytes_up,brick_bytes,bound_by,cores_ms,\
                        straggler_ms,link_ms,master_ms\n"
            .to_string();
        let rows = self.predicted.iter().flat_map(|p| p.rows.iter().map(move |r| (p.name(), r)));
        let number = |n: Option<f64>| n.map_or_else(String::new, |n| n.to_string());
        for (schedule, r) in rows {
            let _ = writeln!(
                text,
                "{schedule},{},{},{},{},{},{},{},{},{},{},{},{},{},{}",
                r.workers,
                r.first_ms,
                r.frame_ms,
                r.latency_efficiency,
                number(r.throughput.map(|t| t.0)),
                number(r.throughput.map(|t| t.1)),
                r.bytes[0],
                r.bytes[1],
                r.bytes[2],
                r.bound.0.name(),
                r.parts[0],
                r.parts[1],
                r.parts[2],
                r.parts[3],
            );
        }
        text
    }

    fn write(&self, dir: &Path) -> Result<(), Fail> {
        let title = format!("{}: predicted efficiency", self.title());
        let schedules: Vec<_> = self.predicted.iter().map(|p| (p.name(), &p.rows[..])).collect();
        let chart = chart::Chart { title: &title, note: &self.cluster(), schedules: &schedules };
        save(&chart, &LIGHT, (dir, "plan"))?;
        let text = |name: &str, text: String| {
            write_atomic(&dir.join(name), |out| out.write_all(text.as_bytes()))
        };
        text("plan.json", format!("{:#}\n", self.json()))?;
        text("plan.csv", self.csv())
    }
}
