//! Tests a prediction with real processes: a master and workers on this machine, which exchange the
//! messages of a cluster but hold each tile for its measured time instead of drawing it.
//!
//! This compares what the scheduler, gRPC and the system do with these tiles. All processes share
//! the cores of this machine, and so they do in the simulation. Where messages alone fill the
//! cores, the rehearsal no longer stands for a cluster; the table shows that as `busy`.

use super::measure::FINISH;
use super::predict::{self, Question};
use slabcast_client::{Client, Update};
use slabcast_common::ids::FrameId;
use slabcast_common::image::{FrameState, PixelEncoding};
use slabcast_common::stats::FrameStats;
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_schedule::{FrameJob, Spans};
use slabcast_session::fail::Fail;
use slabcast_session::progress::Progress;
use slabcast_session::request::{AxisArgs, RenderRequest};
use slabcast_session::{machine, remote, runtime};
use slabcast_sim::{Costs, Link, Observer, Outcome};
use slabcast_trace::Trace;
use std::collections::VecDeque;
use std::ffi::OsStr;
use std::fmt::Write as _;
use std::io::{BufRead, BufReader};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Longest time until all workers have joined.
const JOIN_TIMEOUT: Duration = Duration::from_secs(60);
/// Longest time of a rehearsal.
const PLAY_TIMEOUT: Duration = Duration::from_secs(240);
/// Least number of frames, by repeating the path: one frame of 10 ms measures nothing.
const LEAST_FRAMES: usize = 60;

/// Result of one rehearsal, measured and predicted.
#[derive(Clone, Debug)]
pub(super) struct Rehearsed {
    pub(super) workers: u32,
    /// Measured mean time of the frames but the first, in ms.
    pub(super) frame_ms: f64,
    /// Predicted mean time of the frames but the first, in ms.
    pub(super) predicted_ms: f64,
    /// Measured interval between frames, in ms.
    pub(super) each_ms: f64,
    /// Predicted interval between frames, in ms.
    pub(super) predicted_each_ms: f64,
    /// Processor time of the master a frame, in ms; `None` if the system does not tell it.
    pub(super) master_ms: Option<f64>,
    /// Predicted processor time of the master a frame, in ms.
    pub(super) predicted_master_ms: f64,
    /// Processor time of all workers a frame, in ms.
    pub(super) workers_ms: Option<f64>,
    /// Predicted processor time of all workers a frame, in ms.
    pub(super) predicted_workers_ms: f64,
    /// Utilisation of the machine's cores by master and workers, from 0 to 1.
    pub(super) busy: Option<f64>,
}

/// The network between master and workers of a rehearsal.
#[derive(Clone, Copy, Debug)]
pub(super) struct Network<'a> {
    /// Address at which the master listens.
    pub(super) listen: IpAddr,
    /// Command that starts the workers, separated by white space.
    pub(super) worker_launcher: Option<&'a str>,
    /// Link that the prediction assumes.
    pub(super) link: Link,
}

impl Network<'_> {
    /// The loopback interface of this machine, without a limit.
    pub(super) const LOOPBACK: Network<'static> = Network {
        listen: IpAddr::V4(Ipv4Addr::LOCALHOST),
        worker_launcher: None,
        link: Link::UNLIMITED,
    };
}

/// A child process, killed on drop.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Process {
    /// Starts this program with `args`, by the command `launcher` if there is one.
    fn start(launcher: Option<&str>, args: &[String]) -> Result<Process, Fail> {
        let program = std::env::current_exe()
            .map_err(|e| Fail::failed(format!("finding this program failed: {e}")))?;
        let words = launcher.unwrap_or_default().split_whitespace().map(OsStr::new);
        let mut words = words.chain([program.as_os_str()]);
        let mut command = Command::new(words.next().unwrap_or_default());
        command.args(words);
        command.args(args).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
        for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("SLABCAST_")) {
            command.env_remove(name);
        }
        let child = command.spawn();
        child.map(Process).map_err(|e| {
            let launcher = launcher.map(|words| format!("{words} ")).unwrap_or_default();
            Fail::failed(format!("starting `{launcher}slabcast {}` failed: {e}", args.join(" ")))
        })
    }

    /// Returns the processor time of all its threads so far.
    fn cpu(&self) -> Option<Duration> {
        let tasks = std::fs::read_dir(format!("/proc/{}/task", self.0.id())).ok()?;
        let mut ns = 0u64;
        for task in tasks.flatten() {
            let text = std::fs::read_to_string(task.path().join("schedstat")).ok()?;
            ns += text.split(' ').next()?.parse::<u64>().ok()?;
        }
        Some(Duration::from_nanos(ns))
    }
}

/// Everything that the rehearsals of a command share.
pub(super) struct Rehearsals<'a> {
    pub(super) volume: &'a Path,
    /// File of the trace, for the workers to read.
    pub(super) file: &'a Path,
    pub(super) trace: &'a Trace,
    pub(super) jobs: &'a [FrameJob],
    pub(super) request: &'a RenderRequest,
    pub(super) axes: &'a AxisArgs,
    pub(super) threads: u32,
    pub(super) costs: Costs,
    pub(super) network: Network<'a>,
}

impl Rehearsals<'_> {
    /// Rehearses with each number of workers and predicts the same.
    pub(super) fn run(
        &self,
        workers: &[u32],
        progress: &mut Progress,
    ) -> Result<Vec<Rehearsed>, Fail> {
        let runtime = runtime::start()?;
        let rehearsed = workers.iter().map(|&n| {
            progress.phase(&format!("rehearsing with {n} workers"));
            self.compare(n, &runtime.block_on(self.rehearse(n))?)
        });
        let result = rehearsed.collect::<Result<_, Fail>>();
        runtime::end(runtime);
        result
    }

    async fn rehearse(&self, n: u32) -> Result<Played, Fail> {
        let Network { listen, worker_launcher, .. } = self.network;
        let listen_socket = SocketAddr::new(listen, 0).to_string();
        let mut args: Vec<String> = [
            "master",
            "--listen",
            &listen_socket,
            "--rehearse",
            "--log-level",
            "error",
            "--volume",
        ]
        .map(String::from)
        .into();
        args.push(self.volume.display().to_string());
        if !listen.is_loopback() {
            // The user named the address and knows who can reach it.
            args.push("--insecure".into());
        }
        for (flag, axis) in [("--up", self.axes.up), ("--front", self.axes.front)] {
            args.extend(axis.map(|axis| format!("{flag}={axis}")));
        }
        let mut master = Process::start(None, &args)?;
        let out = master.0.stdout.take().ok_or_else(|| Fail::failed("the master has no stdout"))?;
        let mut line = String::new();
        let read = BufReader::new(out).read_line(&mut line);
        let address = line.trim().strip_prefix("listening on ").map(String::from);
        let (Ok(_), Some(address)) = (read, address) else {
            return Err(Fail::failed(format!(
                "the master of the rehearsal did not start at {listen}; try `slabcast {}`",
                args.join(" ")
            )));
        };
        let file = self.file.display().to_string();
        let mut workers = (1..=n)
            .map(|i| {
                let (threads, name) = (self.threads.to_string(), format!("rehearsal-{i}"));
                let args = [
                    "worker",
                    "--master",
                    &address,
                    "--threads",
                    &threads,
                    "--name",
                    &name,
                    "--rehearse",
                    &file,
                    "--log-level",
                    "error",
                ];
                Process::start(worker_launcher, &args.map(String::from))
            })
            .collect::<Result<Vec<_>, _>>()?;
        let client = remote::connect(&address).await?;
        let joining = Instant::now();
        while client.workers().await.map_err(|e| remote::client_failure(&e))?.len() < n as usize {
            for worker in &mut workers {
                if let Ok(Some(status)) = worker.0.try_wait() {
                    let started = worker_launcher
                        .map(|words| format!(" that `{words}` started"))
                        .unwrap_or_default();
                    return Err(Fail::failed(format!(
                        "a worker of the rehearsal{started} has ended ({status}); try `slabcast worker \
                         --master {address} --rehearse {file}` there"
                    )));
                }
            }
            if joining.elapsed() > JOIN_TIMEOUT {
                return Err(Fail::failed(format!(
                    "not all of {n} workers joined within a minute; try fewer"
                )));
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let served = remote::describe(&client, &VolumeChoice::Default).await?;
        let paths = LEAST_FRAMES.div_ceil(self.jobs.len().max(1));
        let requests: Vec<PathRequest> = (0..paths)
            .map(|_| {
                // The request of a plain `render`.
                let PixelEncoding { format, background } = FINISH;
                let mut request = self.request.clone();
                (request.hashed, request.background) = (false, background);
                request.to_message(&served.info, format, false)
            })
            .collect();
        let played =
            tokio::time::timeout(PLAY_TIMEOUT, play(&client, &requests, &master, &workers)).await;
        played.map_err(|_| {
            Fail::failed("the rehearsal took more than 4 minutes; give fewer frames")
        })?
    }

    /// Simulates the rehearsal on this machine. Returns the outcome and the mean time of the frames
    /// but the first by the scheduler's statistics, in ms.
    fn predict(&self, workers: u32) -> Result<(Outcome, f64), Fail> {
        let cores = Some(machine::cores());
        let cluster_size = (workers, self.threads);
        let (costs, _) = predict::measure_decisions(
            self.jobs,
            self.trace,
            cluster_size,
            self.costs,
            predict::IN_FLIGHT,
        )?;
        let question = Question {
            threads: self.threads,
            link: self.network.link,
            cores,
            stretch: 1.0,
            mixed: false,
        };
        let cluster = question.cluster(workers, costs, predict::IN_FLIGHT);
        // The path is repeated as in the rehearsal.
        let frames = self.jobs.len();
        let all = frames * LEAST_FRAMES.div_ceil(frames.max(1));
        let again = |i: usize| FrameJob {
            frame: FrameId(i as u64 + 1),
            number: i as u64,
            ..self.jobs[i % frames].clone()
        };
        let jobs: Vec<FrameJob> = (0..all).map(again).collect();
        let traced = (0..all).map(|i| self.trace.frames[i % frames].clone()).collect();
        let trace = Trace { frames: traced, ..self.trace.clone() };
        let mut totals = Totals::default();
        let outcome = predict::simulate_observed(&jobs, &trace, &cluster, &mut totals)?;
        Ok((outcome, mean(&totals.0)))
    }

    /// Puts the measured figures of a rehearsal beside the predicted ones.
    fn compare(&self, workers: u32, played: &Played) -> Result<Rehearsed, Fail> {
        let cores = machine::cores();
        let (predicted, predicted_ms) = self.predict(workers)?;
        // The first frame is left out on both sides.
        let frames = played.totals.len().saturating_sub(1).max(1) as f64;
        let [master, others] = predicted.later_work();
        let ms = |ns: u64| ns as f64 / 1e6 / frames;
        let cpu = |d: Option<Duration>| d.map(|d| d.as_secs_f64() * 1e3 / frames);
        let (master_ms, workers_ms) = (cpu(played.master), cpu(played.workers));
        let whole = played.took.as_secs_f64() * 1e3 / frames * f64::from(cores);
        let busy = master_ms.zip(workers_ms).map(|(m, w)| (m + w) / whole);
        Ok(Rehearsed {
            workers,
            frame_ms: mean(&played.totals),
            predicted_ms,
            each_ms: played.each_ms,
            predicted_each_ms: predicted.interval_ms(),
            master_ms,
            predicted_master_ms: ms(master),
            workers_ms,
            predicted_workers_ms: ms(others),
            busy,
        })
    }
}

/// Returns the mean of all values but the first.
fn mean(totals: &[f64]) -> f64 {
    let later = &totals[usize::from(totals.len() > 1)..];
    later.iter().sum::<f64>() / later.len().max(1) as f64
}

/// Observer that collects the total time of each frame, in ms.
#[derive(Default)]
struct Totals(Vec<f64>);

impl Observer for Totals {
    fn frame_done(&mut self, _: FrameId, _: Box<FrameState>, stats: FrameStats, _: Spans) {
        self.0.push(stats.ms.total);
    }
}

/// Measurements of one rehearsal.
struct Played {
    /// Total time of each frame by its statistics, in ms.
    totals: Vec<f64>,
    each_ms: f64,
    took: Duration,
    master: Option<Duration>,
    workers: Option<Duration>,
}

/// Submits the paths and measures frames and processes.
async fn play(
    client: &Client,
    requests: &[PathRequest],
    master: &Process,
    workers: &[Process],
) -> Result<Played, Fail> {
    let of_workers =
        || workers.iter().map(Process::cpu).try_fold(Duration::ZERO, |sum, d| Some(sum + d?));
    // The other jobs follow once the bricks are made, since each job that finds none makes them.
    let mut jobs = VecDeque::new();
    let mut rest = requests.iter();
    if let Some(first) = rest.next() {
        jobs.push_back(client.submit(first).await.map_err(|e| remote::client_failure(&e))?);
    }
    let (mut totals, mut came) = (Vec::new(), Vec::new());
    let (mut began, mut before) = (Instant::now(), (master.cpu(), of_workers()));
    while let Some(job) = jobs.pop_front() {
        let mut stream = client.watch(&job, 0).await.map_err(|e| remote::client_failure(&e))?;
        while let Some(update) = stream.next().await.map_err(|e| remote::client_failure(&e))? {
            let Update::Frame(frame) = update else { continue };
            came.push(Instant::now());
            if came.len() == 1 {
                // Measuring starts here: before the first frame the volume is cut into bricks, and
                // all of them are sent.
                for message in rest.by_ref() {
                    jobs.push_back(
                        client.submit(message).await.map_err(|e| remote::client_failure(&e))?,
                    );
                }
                (began, before) = (Instant::now(), (master.cpu(), of_workers()));
            }
            let stats: FrameStats = serde_json::from_str(&frame.stats_json)
                .map_err(|e| Fail::failed(format!("a frame's statistics can't be read: {e}")))?;
            if !stats.rehearsed {
                return Err(Fail::failed("the master drew instead of rehearsing"));
            }
            totals.push(stats.ms.total);
        }
    }
    let after = (master.cpu(), of_workers());
    let spent = |a: Option<Duration>, b: Option<Duration>| Some(a?.saturating_sub(b?));
    let each = match came[..] {
        [first, .., last] => (last - first).as_secs_f64() * 1e3 / (came.len() - 1) as f64,
        _ => began.elapsed().as_secs_f64() * 1e3,
    };
    Ok(Played {
        totals,
        each_ms: each,
        took: began.elapsed(),
        master: spent(after.0, before.0),
        workers: spent(after.1, before.1),
    })
}

/// Returns the comparison as a table.
pub(super) fn table(schedule: &str, listen: Option<IpAddr>, rows: &[Rehearsed]) -> String {
    let over =
        listen.map_or_else(|| "loopback".into(), |address| format!("over the link of {address}"));
    let mut text = format!(
        "\n{schedule} schedule, rehearsed on this machine ({over}, {} cores for all), measured \
         beside predicted:\n\n\
         {:>7} {:>9} {:>9} {:>6} {:>9} {:>9} {:>6} {:>13} {:>13} {:>6}\n",
        machine::cores(),
        "workers",
        "ms",
        "pred.",
        "off",
        "each ms",
        "pred.",
        "off",
        "master CPU ms",
        "workers' CPU",
        "busy"
    );
    let number = |x: Option<f64>, y: f64| match x {
        Some(x) => format!("{x:.1} ({y:.1})"),
        None => format!("? ({y:.1})"),
    };
    for r in rows {
        let off = |measured: f64, predicted: f64| (predicted / measured - 1.0) * 100.0;
        let _ = writeln!(
            text,
            "{:>7} {:>9.2} {:>9.2} {:>+4.0} % {:>9.2} {:>9.2} {:>+4.0} % {:>13} {:>13} {:>6}",
            r.workers,
            r.frame_ms,
            r.predicted_ms,
            off(r.frame_ms, r.predicted_ms),
            r.each_ms,
            r.predicted_each_ms,
            off(r.each_ms, r.predicted_each_ms),
            number(r.master_ms, r.predicted_master_ms),
            number(r.workers_ms, r.predicted_workers_ms),
            r.busy.map_or("?".into(), |b| format!("{:.0} %", b * 100.0)),
        );
    }
    text += "\nCPU: a frame, predicted in brackets. busy: of all cores. Above some 80 % the machine \
             rehearses itself\nrather than a cluster.\n";
    text
}

/// Returns the comparison as JSON objects.
pub(super) fn json(schedule: &str, rows: &[Rehearsed]) -> Vec<serde_json::Value> {
    let row = |r: &Rehearsed| {
        serde_json::json!({
            "schedule": schedule, "workers": r.workers, "frame_ms": r.frame_ms, "predicted_ms": r.predicted_ms,
            "each_ms": r.each_ms, "predicted_each_ms": r.predicted_each_ms,
            "master_cpu_ms": r.master_ms, "predicted_master_cpu_ms": r.predicted_master_ms,
            "workers_cpu_ms": r.workers_ms, "predicted_workers_cpu_ms": r.predicted_workers_ms,
            "busy": r.busy, "cores": machine::cores(),
        })
    };
    rows.iter().map(row).collect()
}
