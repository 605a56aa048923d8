//! The predicted half: runs the scheduler against virtual clusters.

use super::clock::cpu_ns;
use super::costs;
use crate::statistics::spearman;
use slabcast_common::ids::FrameId;
use slabcast_common::image::FrameState;
use slabcast_common::link::{FRAMES_IN_FLIGHT, stream_threads};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Schedule;
use slabcast_common::stats::FrameStats;
use slabcast_schedule::{FrameJob, Spans};
use slabcast_session::direct::map_parallel;
use slabcast_session::fail::Fail;
use slabcast_sim::{
    self as sim, Cluster, Costs, DecisionTimes, LinearCost, Link, NoObserver, Observer, Outcome,
    Tally,
};
use slabcast_trace::Trace;

/// The resource that bounds a frame's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Bound {
    /// Rendering, spread evenly over the threads.
    Cores,
    /// Waiting for the worker with the last tile.
    Straggler,
    /// Bandwidth and latency of the links.
    Link,
    /// Decisions and messages of the master.
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

/// Prediction for one number of workers.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    pub(crate) workers: u32,
    /// Time of the first frame, which includes sending all bricks, in ms.
    pub(crate) first_ms: f64,
    /// Mean time of a later frame with one in flight, in ms.
    pub(crate) frame_ms: f64,
    /// Best time of one core divided by the number of render threads and by `frame_ms`.
    pub(crate) latency_efficiency: f64,
    /// Frames a second with [`IN_FLIGHT`] frames in flight, and their efficiency; `None` if fewer
    /// than [`LEAST_STEADY_FRAMES`] frames are steady.
    pub(crate) throughput: Option<(f64, f64)>,
    /// Bytes of a later frame: to workers, to the master, bricks.
    pub(crate) bytes: [f64; 3],
    /// Mean number of leases of a later frame.
    pub(crate) leases: f64,
    /// The resource that takes most of a frame's time, and its share from 0 to 1.
    pub(crate) bound: (Bound, f64),
    /// Time of a frame by resource, in ms: cores, straggler, link, master.
    pub(crate) parts: [f64; 4],
    /// Processor time of the master a later frame, in ms: driver, streams, finisher.
    pub(crate) master_ms: [f64; 3],
    /// Messages of a later frame: from the master, its writes (several may share one), to the
    /// master.
    pub(crate) messages: [f64; 3],
    /// Use of the threads while frames are steady; `None` where `throughput` is.
    pub(crate) steady: Option<Steady>,
}

/// Use of the threads with several frames in flight, as shares of the time from 0 to 1.
#[derive(Clone, Debug)]
pub(crate) struct Steady {
    /// Shares of the render threads' time that are lost, in the order of [`LOSSES`].
    pub(crate) lost: [f64; LOSSES.len()],
    /// Utilisation of the driver, and of each stream thread.
    pub(crate) busy: [f64; 2],
    /// Processor time of the scheduler's decisions for a frame, in ms.
    pub(crate) deciding_ms: f64,
}

/// Losses of the render threads against one core alone: name in tables, name in JSON.
pub(crate) const LOSSES: [(&str, &str); 7] = [
    ("drawing", "drawing"),
    ("tables", "tables"),
    ("messages", "messages"),
    ("bricks", "bricks"),
    ("on way", "on_the_way"),
    ("dry", "nothing_to_lend"),
    ("end", "end_of_path"),
];

/// Frames that a master has in flight.
pub(crate) const IN_FLIGHT: u32 = FRAMES_IN_FLIGHT as u32;

/// Least number of steady frames that throughput is measured over: three times those in flight.
/// With fewer, chance decides: two of six frames came with an efficiency of 211 % on a disturbed
/// machine, five of nine with 154 % on seven workers and 83 % on eight.
pub(crate) const LEAST_STEADY_FRAMES: usize = 3 * IN_FLIGHT as usize;

/// The cluster to predict, apart from its number of workers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Question {
    /// Render threads of each worker.
    pub(crate) threads: u32,
    pub(crate) link: Link,
    /// Cores that all processes share; `None` for one core a thread.
    pub(crate) cores: Option<u32>,
    /// Factor on all tile times.
    pub(crate) stretch: f64,
    /// Whether tiles after each worker's first are cut in quarters.
    pub(crate) mixed: bool,
}

impl Question {
    /// Returns the virtual cluster of `workers` workers.
    pub(crate) fn cluster(&self, workers: u32, costs: Costs, in_flight: u32) -> Cluster {
        let &Question { threads, link, cores, stretch, mixed } = self;
        Cluster {
            workers,
            threads,
            link,
            costs,
            shared_cores: cores,
            frames_in_flight: in_flight,
            stretch,
            mixed,
        }
    }
}

/// Simulates the jobs on a virtual cluster.
pub(crate) fn simulate(
    jobs: &[FrameJob],
    trace: &Trace,
    cluster: &Cluster,
) -> Result<Outcome, Fail> {
    simulate_observed(jobs, trace, cluster, &mut NoObserver)
}

/// Simulates the jobs on a virtual cluster and reports each frame to `observer`.
pub(crate) fn simulate_observed(
    jobs: &[FrameJob],
    trace: &Trace,
    cluster: &Cluster,
    observer: &mut dyn Observer,
) -> Result<Outcome, Fail> {
    let ran = sim::run(jobs, trace, cluster, observer);
    ran.map(|r| r.0).map_err(|e| Fail::failed(e.to_string()))
}

/// Predicts each number of workers, on `threads` threads of this machine. `messages` holds the
/// costs of messages; those of decisions are measured for each number.
pub(crate) fn rows(
    jobs: &[FrameJob],
    trace: &Trace,
    workers: &[u32],
    question: &Question,
    messages: Costs,
    threads: usize,
) -> Result<Vec<Row>, Fail> {
    let rows = map_parallel(workers.len(), threads, |i, _: &mut ()| {
        let cluster = (workers[i], question.threads);
        let (one, _) = measure_decisions(jobs, trace, cluster, messages, 1)?;
        let several = measure_decisions(jobs, trace, cluster, messages, IN_FLIGHT)?;
        row(jobs, trace, workers[i], question, one, several)
    });
    rows.into_iter().collect()
}

fn row(
    jobs: &[FrameJob],
    trace: &Trace,
    workers: u32,
    question: &Question,
    costs: Costs,
    (several, deciding_ms): (Costs, f64),
) -> Result<Row, Fail> {
    let run = |link: Link, costs: Costs, in_flight: u32| {
        let question = Question { link, ..*question };
        simulate(jobs, trace, &question.cluster(workers, costs, in_flight))
    };
    let alone = sim::one_core_ms(trace) * question.stretch;
    let steady_alone_ms = sim::one_core_steady_ms(trace, IN_FLIGHT) * question.stretch;
    let threads = f64::from(workers * question.threads);
    let latency = run(question.link, costs, 1)?;
    let throughput = run(question.link, several, IN_FLIGHT)?;
    // The cost of a resource is the time that a frame saves when the resource is unlimited.
    let no_link = run(Link::UNLIMITED, costs, 1)?;
    let free = Costs { worker: costs.worker, ..Costs::default() };
    let no_link_or_master = run(Link::UNLIMITED, free, 1)?;
    let frame_ms = latency.frame_ms();
    let cores = no_link_or_master.mean(|f| f.render) / 1e6 / threads;
    let parts = [
        cores,
        (no_link_or_master.frame_ms() - cores).max(0.0),
        (frame_ms - no_link.frame_ms()).max(0.0),
        (no_link.frame_ms() - no_link_or_master.frame_ms()).max(0.0),
    ];
    let all: f64 = parts.iter().sum();
    let kinds = [Bound::Cores, Bound::Straggler, Bound::Link, Bound::Master];
    let most = (0..4).max_by(|&a, &b| parts[a].total_cmp(&parts[b])).unwrap_or(0);
    let frames = jobs.len() as f64;
    let each_ms = throughput.steady_interval_ms(IN_FLIGHT);
    let spent = throughput.thread_time;
    let enough_frames = Outcome::steady_frames(jobs.len(), IN_FLIGHT) >= LEAST_STEADY_FRAMES;
    let throughput_efficiency = steady_alone_ms / threads / each_ms;
    let steady = (enough_frames && spent.total() > 0).then(|| {
        let all_spent = spent.total() as f64;
        let part = |ns: u64| ns as f64 / all_spent;
        let drawing = part(spent.tiles + spent.tables + spent.blocks);
        let window = all_spent / threads;
        let [driver, streams] = [0, 1].map(|i| throughput.steady_work[i] as f64 / window);
        Steady {
            lost: [
                drawing - part(spent.tables) - throughput_efficiency,
                part(spent.tables),
                part(spent.messages),
                part(spent.bricks),
                part(spent.round_trip),
                part(spent.no_work),
                part(spent.path_end),
            ],
            busy: [driver, streams / stream_threads(u32::MAX) as f64],
            deciding_ms,
        }
    });
    Ok(Row {
        workers,
        first_ms: latency.first_ms(),
        frame_ms,
        latency_efficiency: alone / threads / frame_ms,
        throughput: enough_frames.then_some((1e3 / each_ms, throughput_efficiency)),
        bytes: [latency.mean(|f| f.down), latency.mean(|f| f.up), latency.mean(|f| f.bricks)],
        leases: latency.mean(|f| f.leases),
        bound: (kinds[most], parts[most] / all),
        parts,
        master_ms: {
            let later = |work: fn(&sim::Work) -> u64| {
                let ns = work(&latency.work) - work(&latency.first_work);
                ns as f64 / 1e6 / (frames - 1.0).max(1.0)
            };
            [later(|w| w.driver), later(|w| w.streams), later(|w| w.finishers)]
        },
        messages: [
            latency.mean(|f| f.messages_down),
            latency.mean(|f| f.writes_down),
            latency.mean(|f| f.messages_up),
        ],
        steady,
    })
}

/// Returns Spearman's rank correlation of estimated and measured tile times under the `region`
/// schedule on `workers` workers, as the mean over all views but the first. The first value is for
/// estimates by pixels under blocks of bricks, all that is known of a first view (the paper's
/// Figure 1); the second for estimates by earlier views. `None` if no view has three tiles.
pub(crate) fn orders(
    jobs: &[FrameJob],
    trace: &Trace,
    workers: u32,
) -> Result<Option<[f64; 2]>, Fail> {
    let question =
        Question { threads: 1, link: Link::UNLIMITED, cores: None, stretch: 1.0, mixed: false };
    let cluster = question.cluster(workers, Costs::default(), 1);
    let stats_of = |jobs: &[FrameJob], trace: &Trace| -> Result<Vec<FrameStats>, Fail> {
        let mut collected = StatsCollector::default();
        simulate_observed(jobs, trace, &cluster, &mut collected)?;
        Ok(collected.0)
    };
    let correlation = |stats: &FrameStats, i: usize| {
        let tiles = stats.slabs.first().map_or(&[][..], |slab| &slab.tiles[..]);
        let pairs = tiles.iter().filter_map(|t| {
            let [x, y, edge] = [t.x, t.y, t.size].map(|n| n as i32);
            let rect =
                Rect::new(x, y, x + edge, y + edge).intersect(&Rect::from_size(jobs[i].view.size));
            let known = trace.frames[i].region(&rect, trace.about.size)?;
            Some((t.est as f64, known.ns as f64))
        });
        spearman(&pairs.collect::<Vec<_>>())
    };
    let learned = stats_of(jobs, trace)?;
    let (mut sum, mut views) = ([0.0; 2], 0);
    for i in 1..jobs.len() {
        // Simulated alone, the view is a first one.
        let job = FrameJob { frame: FrameId(1), number: 0, ..jobs[i].clone() };
        let one = Trace { frames: vec![trace.frames[i].clone()], ..trace.clone() };
        let plain = stats_of(&[job], &one)?;
        let view_correlation = |stats: Option<&FrameStats>| stats.and_then(|s| correlation(s, i));
        if let (Some(plain), Some(learned)) =
            (view_correlation(plain.first()), view_correlation(learned.get(i)))
        {
            sum = [sum[0] + plain, sum[1] + learned];
            views += 1;
        }
    }
    Ok((views > 0).then(|| sum.map(|s| s / f64::from(views))))
}

/// Observer that collects the statistics of each frame.
#[derive(Default)]
struct StatsCollector(Vec<FrameStats>);

impl Observer for StatsCollector {
    fn frame_done(&mut self, _: FrameId, _: Box<FrameState>, stats: FrameStats, _: Spans) {
        self.0.push(stats);
    }
}

/// Observer that lends the simulation the processor clock of this thread.
struct CpuClock;

impl Observer for CpuClock {
    fn processor_ns(&mut self) -> Option<u64> {
        Some(cpu_ns())
    }
}

/// Returns the ns that reading the processor clock takes: a system call, which no master makes.
fn clock_read_ns() -> f64 {
    let once = || {
        let began = cpu_ns();
        cpu_ns() - began
    };
    (0..99).map(|_| once()).min().unwrap_or(0) as f64
}

/// Measures the costs of messages and decisions on this machine.
pub(crate) fn measured_costs(
    jobs: &[FrameJob],
    trace: &Trace,
    cluster: (u32, u32),
) -> Result<Costs, Fail> {
    let schedule = jobs.first().map_or(Schedule::Auto, |job| job.work.schedule);
    Ok(measure_decisions(jobs, trace, cluster, costs::messages(trace, schedule), 1)?.0)
}

/// Measures the costs of decisions on this machine: times the scheduler over the path on a virtual
/// cluster of (workers, threads of each). Returns the costs with those of `messages`, and the ms of
/// decisions for a frame but the first.
pub(crate) fn measure_decisions(
    jobs: &[FrameJob],
    trace: &Trace,
    (workers, threads): (u32, u32),
    messages: Costs,
    in_flight: u32,
) -> Result<(Costs, f64), Fail> {
    let question =
        Question { threads, link: Link::UNLIMITED, cores: None, stretch: 1.0, mixed: false };
    let mut clock = CpuClock;
    let cluster = question.cluster(workers, messages, in_flight);
    let (_, took) =
        sim::run(jobs, trace, &cluster, &mut clock).map_err(|e| Fail::failed(e.to_string()))?;
    let DecisionTimes { first_frame, frames, slabs, results, prefetches, others, .. } = took;
    let result_count = took.result_count;
    // Subtracted, since decisions take about a microsecond.
    let read_ns = clock_read_ns();
    let each = |tally: Tally| (tally.each_ns() - read_ns).max(0.0);
    // The scheduler adds the pixels of sums but keeps finished tiles as they arrive.
    let finished =
        jobs.first().is_some_and(|j| j.work.schedule != Schedule::Slab && j.finish.is_some());
    let (fixed_ns, per_unit_ns) = match finished {
        true => (each(Tally { count: result_count, ns: results.ns }), 0.0),
        false => (0.0, results.each_ns()),
    };
    // The first frame sorts the bricks into blocks.
    let begun = jobs.len().saturating_sub(1) as f64;
    let many = (result_count + prefetches.count + others.count) as f64 + jobs.len() as f64;
    let beside = (slabs.ns + results.ns + prefetches.ns + others.ns) as f64 - read_ns * many;
    let a_frame = frames.ns as f64 / begun.max(1.0) + beside.max(0.0) / jobs.len() as f64;
    let costs = Costs {
        first_brick_ns: first_frame.each_ns(),
        frame_brick_ns: frames.each_ns(),
        slab_brick_ns: slabs.each_ns(),
        // A result and the lease that follows it are one decision.
        result: LinearCost { fixed_ns, per_unit_ns },
        prefetch_ns: each(prefetches),
        event_ns: each(others),
        ..messages
    };
    Ok((costs, a_frame / 1e6))
}
