//! The predicted half: the scheduler against clusters that are not there.

use super::clock::cpu_ns;
use super::costs;
use crate::fail::Fail;
use crate::local::shared;
use slabcast_common::trace::Trace;
use slabcast_schedule::FrameJob;
use slabcast_schedule::sim::{self, Cluster, Costs, Link, Outcome, Stopwatch, Took, Unmeasured};

/// What a frame's time goes into.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Bound {
    /// Rendering, spread evenly.
    Cores,
    /// Waiting for whoever has the last tile.
    Straggler,
    /// Bandwidth and latency.
    Link,
    /// Decisions, and messages at the master.
    Master,
}

impl Bound {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Bound::Cores => "cores",
            Bound::Straggler => "straggler",
            Bound::Link => "link",
            Bound::Master => "master",
        }
    }
}

/// What is said of a cluster.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    pub(crate) workers: u32,
    /// The first frame, with all its bricks, in ms.
    pub(crate) first_ms: f64,
    /// A later frame, one in flight, in ms.
    pub(crate) frame_ms: f64,
    /// Against one worker's best time over the number of render threads.
    pub(crate) latency_efficiency: f64,
    /// Frames a second, as many in flight as a master has.
    pub(crate) frames_per_s: f64,
    pub(crate) throughput_efficiency: f64,
    /// Bytes of a later frame: down, up, bricks.
    pub(crate) bytes: [f64; 3],
    /// Leases of a later frame.
    pub(crate) leases: f64,
    /// The resource that a frame's time goes into before all, and which part.
    pub(crate) bound: (Bound, f64),
    /// All parts: cores, straggler, link, master, in ms.
    pub(crate) parts: [f64; 4],
    /// Work of the master a frame, in ms: driver, streams, finisher.
    pub(crate) master_ms: [f64; 3],
}

/// Frames that a master has in hand (`master::driver`).
pub(crate) const IN_FLIGHT: u32 = 3;

/// What is asked.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Question {
    pub(crate) threads: u32,
    pub(crate) link: Link,
    pub(crate) cores: Option<u32>,
    pub(crate) stretch: f64,
    pub(crate) mixed: bool,
}

impl Question {
    pub(crate) fn cluster(&self, workers: u32, costs: Costs, in_flight: u32) -> Cluster {
        let &Question { threads, link, cores, stretch, mixed } = self;
        Cluster { workers, threads, link, costs, cores, in_flight, stretch, mixed }
    }
}

pub(crate) fn simulate(
    jobs: &[FrameJob],
    trace: &Trace,
    cluster: &Cluster,
) -> Result<Outcome, Fail> {
    watched(jobs, trace, cluster, &mut Unmeasured)
}

/// The same while somebody looks on.
pub(crate) fn watched(
    jobs: &[FrameJob],
    trace: &Trace,
    cluster: &Cluster,
    watch: &mut dyn Stopwatch,
) -> Result<Outcome, Fail> {
    let ran = sim::run(jobs, trace, cluster, watch);
    ran.map(|r| r.0).map_err(|e| Fail::failed(e.to_string()))
}

/// Predicts every number of workers, on `threads` threads of this machine.
pub(crate) fn rows(
    jobs: &[FrameJob],
    trace: &Trace,
    workers: &[u32],
    question: &Question,
    costs: Costs,
    threads: usize,
) -> Result<Vec<Row>, Fail> {
    let rows = shared(workers.len(), threads, |i, _: &mut ()| {
        row(jobs, trace, workers[i], question, costs)
    });
    rows.into_iter().collect()
}

fn row(
    jobs: &[FrameJob],
    trace: &Trace,
    workers: u32,
    question: &Question,
    costs: Costs,
) -> Result<Row, Fail> {
    let run = |link: Link, costs: Costs, in_flight: u32| {
        let question = Question { link, ..*question };
        simulate(jobs, trace, &question.cluster(workers, costs, in_flight))
    };
    let alone = sim::alone_ms(trace) * question.stretch;
    let threads = f64::from(workers * question.threads);
    let latency = run(question.link, costs, 1)?;
    let throughput = run(question.link, costs, IN_FLIGHT)?;
    // What a resource costs is what a frame is shorter by where there is plenty of it.
    let no_link = run(Link::NONE, costs, 1)?;
    let free = Costs {
        worker_receive: costs.worker_receive,
        worker_send: costs.worker_send,
        worker_bricks: costs.worker_bricks,
        ..Costs::default()
    };
    let neither = run(Link::NONE, free, 1)?;
    let frame_ms = latency.frame_ms();
    let cores = neither.mean(|f| f.render) / 1e6 / threads;
    let parts = [
        cores,
        (neither.frame_ms() - cores).max(0.0),
        (frame_ms - no_link.frame_ms()).max(0.0),
        (no_link.frame_ms() - neither.frame_ms()).max(0.0),
    ];
    let all: f64 = parts.iter().sum();
    let kinds = [Bound::Cores, Bound::Straggler, Bound::Link, Bound::Master];
    let most = (0..4).max_by(|&a, &b| parts[a].total_cmp(&parts[b])).unwrap_or(0);
    let frames = jobs.len() as f64;
    let each_ms = throughput.each_ms();
    Ok(Row {
        workers,
        first_ms: latency.first_ms(),
        frame_ms,
        latency_efficiency: alone / threads / frame_ms,
        frames_per_s: 1e3 / each_ms,
        throughput_efficiency: alone / threads / each_ms,
        bytes: [latency.mean(|f| f.down), latency.mean(|f| f.up), latency.mean(|f| f.bricks)],
        leases: latency.mean(|f| f.leases),
        bound: (kinds[most], parts[most] / all),
        parts,
        master_ms: [latency.driver, latency.streams, latency.finisher]
            .map(|ns| ns as f64 / 1e6 / frames),
    })
}

struct Cpu;

impl Stopwatch for Cpu {
    fn read(&mut self) -> Option<u64> {
        Some(cpu_ns())
    }
}

/// What deciding costs on this machine: the scheduler runs the path once on `workers` (whose tiles are
/// in the trace), and is timed.
pub(crate) fn measured_costs(
    jobs: &[FrameJob],
    trace: &Trace,
    (workers, threads): (u32, u32),
) -> Result<Costs, Fail> {
    let messages = costs::messages(trace);
    let question = Question { threads, link: Link::NONE, cores: None, stretch: 1.0, mixed: false };
    let mut watch = Cpu;
    let cluster = question.cluster(workers, messages, 1);
    let (_, took) =
        sim::run(jobs, trace, &cluster, &mut watch).map_err(|e| Fail::failed(e.to_string()))?;
    let per = |(n, ns): (u64, u64)| if n == 0 { 0.0 } else { ns as f64 / n as f64 };
    let Took { frames, slabs, results, others, .. } = took;
    Ok(Costs {
        frame_brick: per(frames),
        slab_brick: per(slabs),
        // A result and the lease that follows it are handled in one go; both go by their pixels.
        result_pixel: per(results),
        event: per(others),
        ..messages
    })
}
