//! A prediction put to the test: a master and workers as processes of this machine, which speak as
//! they would in a cluster and hold each tile for its time instead of drawing it.
//!
//! What is compared is what the scheduler, gRPC and the system do with these tiles. All processes
//! share this machine's cores, and the simulation is told so; where messages alone fill them, the
//! rehearsal is no cluster any more, and the table says that too.

use super::measure::FINISH;
use super::predict::{self, Question};
use slabcast_client::{Client, Update};
use slabcast_common::ids::FrameId;
use slabcast_common::image::{FrameState, PixelEncoding};
use slabcast_common::stats::FrameStats;
use slabcast_scene::request::PathRequest;
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

/// How long workers may take to come.
const COME: Duration = Duration::from_secs(60);
/// How long a path may take.
const PLAY: Duration = Duration::from_secs(240);
/// So many frames are played at least, one path after another: a frame of 10 ms measures nothing.
const FRAMES: usize = 60;

/// What a rehearsal was.
#[derive(Clone, Debug)]
pub(super) struct Rehearsed {
    pub(super) workers: u32,
    /// Measured: mean of the frames but the first, in ms.
    pub(super) frame_ms: f64,
    /// Predicted for this machine.
    pub(super) predicted_ms: f64,
    /// Measured: from one frame's coming to the next, in ms.
    pub(super) each_ms: f64,
    pub(super) predicted_each_ms: f64,
    /// Processor time of the master a frame, in ms; `None` where the system does not say.
    pub(super) master_ms: Option<f64>,
    pub(super) predicted_master_ms: f64,
    /// Of all workers.
    pub(super) workers_ms: Option<f64>,
    pub(super) predicted_workers_ms: f64,
    /// Which part of the machine's cores all of them had.
    pub(super) busy: Option<f64>,
}

/// What a rehearsal's messages go over.
#[derive(Clone, Copy, Debug)]
pub(super) struct Over<'a> {
    /// Where its master listens.
    pub(super) at: IpAddr,
    /// What its workers are started by, in words.
    pub(super) by: Option<&'a str>,
    /// What lies between: what is predicted is of this.
    pub(super) link: Link,
}

impl Over<'_> {
    /// This machine's own, which has no limit.
    pub(super) const LOOPBACK: Over<'static> =
        Over { at: IpAddr::V4(Ipv4Addr::LOCALHOST), by: None, link: Link::UNLIMITED };
}

/// A process that ends with this value.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Process {
    /// Starts this program, by way of other words if there are some.
    fn start(by: Option<&str>, args: &[String]) -> Result<Process, Fail> {
        let program = std::env::current_exe()
            .map_err(|e| Fail::failed(format!("finding this program failed: {e}")))?;
        let words = by.unwrap_or_default().split_whitespace().map(OsStr::new);
        let mut words = words.chain([program.as_os_str()]);
        let mut command = Command::new(words.next().unwrap_or_default());
        command.args(words);
        command.args(args).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
        for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("SLABCAST_")) {
            command.env_remove(name);
        }
        let child = command.spawn();
        child.map(Process).map_err(|e| {
            let by = by.map(|by| format!("{by} ")).unwrap_or_default();
            Fail::failed(format!("starting `{by}slabcast {}` failed: {e}", args.join(" ")))
        })
    }

    /// Processor time of all its threads so far.
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

/// What all rehearsals of a command share.
pub(super) struct PathScenes<'a> {
    pub(super) volume: &'a Path,
    /// The trace's file, and what is in it.
    pub(super) file: &'a Path,
    pub(super) trace: &'a Trace,
    pub(super) jobs: &'a [FrameJob],
    pub(super) request: &'a RenderRequest,
    pub(super) axes: &'a AxisArgs,
    pub(super) threads: u32,
    pub(super) costs: Costs,
    pub(super) over: Over<'a>,
}

impl PathScenes<'_> {
    /// Rehearses with each number of workers.
    pub(super) fn run(
        &self,
        workers: &[u32],
        progress: &mut Progress,
    ) -> Result<Vec<Rehearsed>, Fail> {
        let runtime = runtime::start()?;
        let rehearsed = workers.iter().map(|&n| {
            progress.phase(&format!("rehearsing with {n} workers"));
            self.beside(n, &runtime.block_on(self.one(n))?)
        });
        let result = rehearsed.collect::<Result<_, Fail>>();
        runtime::end(runtime);
        result
    }

    async fn one(&self, n: u32) -> Result<Played, Fail> {
        let Over { at, by, .. } = self.over;
        let listen = SocketAddr::new(at, 0).to_string();
        let mut args: Vec<String> =
            ["master", "--listen", &listen, "--rehearse", "--log-level", "error", "--volume"]
                .map(String::from)
                .into();
        args.push(self.volume.display().to_string());
        if !at.is_loopback() {
            // Who names an address knows who reaches it.
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
                "the master of the rehearsal did not start at {at}; try `slabcast {}`",
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
                Process::start(by, &args.map(String::from))
            })
            .collect::<Result<Vec<_>, _>>()?;
        let client = remote::connect(&address).await?;
        let come = Instant::now();
        while client.workers().await.map_err(|e| remote::client_failure(&e))?.len() < n as usize {
            for worker in &mut workers {
                if let Ok(Some(status)) = worker.0.try_wait() {
                    let by = by.map(|by| format!(" that `{by}` started")).unwrap_or_default();
                    return Err(Fail::failed(format!(
                        "a worker of the rehearsal{by} has ended ({status}); try `slabcast worker \
                         --master {address} --rehearse {file}` there"
                    )));
                }
            }
            if come.elapsed() > COME {
                return Err(Fail::failed(format!("not all of {n} workers came within a minute")));
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let served = remote::describe(&client).await?;
        let paths = FRAMES.div_ceil(self.jobs.len().max(1));
        let requests: Vec<PathRequest> = (0..paths)
            .map(|_| {
                // As a plain `render` asks.
                let PixelEncoding { format, background } = FINISH;
                let mut request = self.request.clone();
                (request.hashed, request.background) = (false, background);
                request.to_message(&served.info, format, false)
            })
            .collect();
        let played = tokio::time::timeout(PLAY, play(&client, &requests, &master, &workers)).await;
        played.map_err(|_| Fail::failed("the rehearsal took more than 4 minutes"))?
    }

    /// What is predicted for this machine, and what the scheduler says there that a later frame takes, in ms.
    fn predict(&self, workers: u32) -> Result<(Outcome, f64), Fail> {
        let cores = Some(machine::cores());
        let of = (workers, self.threads);
        let (costs, _) =
            predict::decided(self.jobs, self.trace, of, self.costs, predict::IN_FLIGHT)?;
        let question = Question {
            threads: self.threads,
            link: self.over.link,
            cores,
            stretch: 1.0,
            mixed: false,
        };
        let cluster = question.cluster(workers, costs, predict::IN_FLIGHT);
        // The path again and again, as it is played.
        let frames = self.jobs.len();
        let all = frames * FRAMES.div_ceil(frames.max(1));
        let again = |i: usize| FrameJob {
            frame: FrameId(i as u64 + 1),
            number: i as u64,
            ..self.jobs[i % frames].clone()
        };
        let jobs: Vec<FrameJob> = (0..all).map(again).collect();
        let traced = (0..all).map(|i| self.trace.frames[i % frames].clone()).collect();
        let trace = Trace { frames: traced, ..self.trace.clone() };
        let mut heard = Totals::default();
        let outcome = predict::watched(&jobs, &trace, &cluster, &mut heard)?;
        Ok((outcome, mean(&heard.0)))
    }

    /// What was measured, beside what is predicted.
    fn beside(&self, workers: u32, played: &Played) -> Result<Rehearsed, Fail> {
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

/// Mean of all but the first.
fn mean(totals: &[f64]) -> f64 {
    let later = &totals[usize::from(totals.len() > 1)..];
    later.iter().sum::<f64>() / later.len().max(1) as f64
}

/// What frames take, as their statistics say, in ms.
#[derive(Default)]
struct Totals(Vec<f64>);

impl Observer for Totals {
    fn frame_done(&mut self, _: FrameId, _: Box<FrameState>, stats: FrameStats, _: Spans) {
        self.0.push(stats.ms.total);
    }
}

/// What was seen of a path.
struct Played {
    /// What frames took, as their statistics say, in ms.
    totals: Vec<f64>,
    each_ms: f64,
    took: Duration,
    master: Option<Duration>,
    workers: Option<Duration>,
}

/// Has paths played, and looks at frames and processes.
async fn play(
    client: &Client,
    requests: &[PathRequest],
    master: &Process,
    workers: &[Process],
) -> Result<Played, Fail> {
    let of_workers =
        || workers.iter().map(Process::cpu).try_fold(Duration::ZERO, |sum, d| Some(sum + d?));
    // The others when the bricks are made: each job that finds none makes them.
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
                // Before the first frame the volume is cut into bricks and all of them are sent: from
                // here on it counts.
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

/// The comparison, for people.
pub(super) fn table(schedule: &str, at: Option<IpAddr>, rows: &[Rehearsed]) -> String {
    let over = at.map_or_else(|| "loopback".into(), |at| format!("over the link of {at}"));
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

/// The same for programs.
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
