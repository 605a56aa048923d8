//! The predicted half: the scheduler against clusters that are not there.

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
    /// Frames a second, as many in flight as a master has, and the same efficiency; nothing where fewer than
    /// [`STEADILY`] come steadily.
    pub(crate) throughput: Option<(f64, f64)>,
    /// Bytes of a later frame: down, up, bricks.
    pub(crate) bytes: [f64; 3],
    /// Leases of a later frame.
    pub(crate) leases: f64,
    /// The resource that a frame's time goes into before all, and which part.
    pub(crate) bound: (Bound, f64),
    /// All parts: cores, straggler, link, master, in ms.
    pub(crate) parts: [f64; 4],
    /// Work of the master a later frame, in ms: driver, streams, finisher.
    pub(crate) master_ms: [f64; 3],
    /// Messages of a later frame: from the master, how often some of those left together, to the master.
    pub(crate) messages: [f64; 3],
    /// What threads did while frames were delivered steadily; nothing where that can't be told, either.
    pub(crate) steady: Option<Steady>,
}

/// Of the time with several frames in flight
#[derive(Clone, Debug)]
pub(crate) struct Steady {
    /// what render threads lose, by the parts that [`LOSSES`] names,
    pub(crate) lost: [f64; LOSSES.len()],
    /// and how much the driver is busy, and each of the streams;
    pub(crate) busy: [f64; 2],
    /// and how long the scheduler decides for a frame, by the processor's clock.
    pub(crate) deciding_ms: f64,
}

/// What render threads' time goes into beside what drawing takes one core alone, by a word for tables and
/// one for JSON.
pub(crate) const LOSSES: [(&str, &str); 7] = [
    ("drawing", "drawing"),
    ("tables", "tables"),
    ("messages", "messages"),
    ("bricks", "bricks"),
    ("on way", "on_the_way"),
    ("dry", "nothing_to_lend"),
    ("end", "end_of_path"),
];

/// Frames that a master has in hand.
pub(crate) const IN_FLIGHT: u32 = FRAMES_IN_FLIGHT as u32;

/// Frames that have to come steadily for throughput to be told by them, three times as many as are in flight. Of fewer chance
/// says which came early: two of six came with 211 % of what all cores can do on a machine that something disturbed,
/// five of nine with 154 % on seven workers and 83 on eight.
pub(crate) const STEADILY: usize = 3 * IN_FLIGHT as usize;

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

pub(crate) fn simulate(
    jobs: &[FrameJob],
    trace: &Trace,
    cluster: &Cluster,
) -> Result<Outcome, Fail> {
    watched(jobs, trace, cluster, &mut NoObserver)
}

/// The same while somebody looks on.
pub(crate) fn watched(
    jobs: &[FrameJob],
    trace: &Trace,
    cluster: &Cluster,
    watch: &mut dyn Observer,
) -> Result<Outcome, Fail> {
    let ran = sim::run(jobs, trace, cluster, watch);
    ran.map(|r| r.0).map_err(|e| Fail::failed(e.to_string()))
}

/// Predicts every number of workers, on `threads` threads of this machine. `messages` are what messages
/// cost; what deciding costs is measured for each number.
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
        let (one, _) = decided(jobs, trace, cluster, messages, 1)?;
        let several = decided(jobs, trace, cluster, messages, IN_FLIGHT)?;
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
    let steadily = sim::one_core_steady_ms(trace, IN_FLIGHT) * question.stretch;
    let threads = f64::from(workers * question.threads);
    let latency = run(question.link, costs, 1)?;
    let throughput = run(question.link, several, IN_FLIGHT)?;
    // What a resource costs is what a frame is shorter by where there is plenty of it.
    let no_link = run(Link::UNLIMITED, costs, 1)?;
    let free = Costs { worker: costs.worker, ..Costs::default() };
    let neither = run(Link::UNLIMITED, free, 1)?;
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
    let each_ms = throughput.steady_interval_ms(IN_FLIGHT);
    let spent = throughput.thread_time;
    let told = Outcome::steady_frames(jobs.len(), IN_FLIGHT) >= STEADILY;
    let throughput_efficiency = steadily / threads / each_ms;
    let steady = (told && spent.total() > 0).then(|| {
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
        throughput: told.then_some((1e3 / each_ms, throughput_efficiency)),
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

/// How well tiles' estimates tell the order of their times under the `region` schedule, on so many workers:
/// Spearman's rank correlation, mean of the views but the first. First of pixels under blocks of bricks,
/// which is all that is known of a first view (the paper's Figure 1); then of what the views before
/// taught. `None` where no view has three tiles.
pub(crate) fn orders(
    jobs: &[FrameJob],
    trace: &Trace,
    workers: u32,
) -> Result<Option<[f64; 2]>, Fail> {
    let question =
        Question { threads: 1, link: Link::UNLIMITED, cores: None, stretch: 1.0, mixed: false };
    let cluster = question.cluster(workers, Costs::default(), 1);
    let told = |jobs: &[FrameJob], trace: &Trace| -> Result<Vec<FrameStats>, Fail> {
        let mut heard = Heard::default();
        watched(jobs, trace, &cluster, &mut heard)?;
        Ok(heard.0)
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
    let learned = told(jobs, trace)?;
    let (mut sum, mut views) = ([0.0; 2], 0);
    for i in 1..jobs.len() {
        // By itself it is a first view.
        let job = FrameJob { frame: FrameId(1), number: 0, ..jobs[i].clone() };
        let one = Trace { frames: vec![trace.frames[i].clone()], ..trace.clone() };
        let plain = told(&[job], &one)?;
        let of = |stats: Option<&FrameStats>| stats.and_then(|s| correlation(s, i));
        if let (Some(plain), Some(learned)) = (of(plain.first()), of(learned.get(i))) {
            sum = [sum[0] + plain, sum[1] + learned];
            views += 1;
        }
    }
    Ok((views > 0).then(|| sum.map(|s| s / f64::from(views))))
}

#[derive(Default)]
struct Heard(Vec<FrameStats>);

impl Observer for Heard {
    fn frame_done(&mut self, _: FrameId, _: Box<FrameState>, stats: FrameStats, _: Spans) {
        self.0.push(stats);
    }
}

struct Cpu;

impl Observer for Cpu {
    fn processor_ns(&mut self) -> Option<u64> {
        Some(cpu_ns())
    }
}

/// What it takes to read that clock, in nanoseconds: a call of the system, which no master makes.
fn reading() -> f64 {
    let once = || {
        let began = cpu_ns();
        cpu_ns() - began
    };
    (0..99).map(|_| once()).min().unwrap_or(0) as f64
}

/// What messages and deciding cost on this machine.
pub(crate) fn measured_costs(
    jobs: &[FrameJob],
    trace: &Trace,
    cluster: (u32, u32),
) -> Result<Costs, Fail> {
    let schedule = jobs.first().map_or(Schedule::Auto, |job| job.work.schedule);
    Ok(decided(jobs, trace, cluster, costs::messages(trace, schedule), 1)?.0)
}

/// What deciding costs on this machine: the scheduler runs the path once on so many workers of so many
/// threads (whose tiles are in the trace), with so many frames in flight, and is timed. And how long it takes for a frame
/// but the first, in ms.
pub(crate) fn decided(
    jobs: &[FrameJob],
    trace: &Trace,
    (workers, threads): (u32, u32),
    messages: Costs,
    in_flight: u32,
) -> Result<(Costs, f64), Fail> {
    let question =
        Question { threads, link: Link::UNLIMITED, cores: None, stretch: 1.0, mixed: false };
    let mut watch = Cpu;
    let cluster = question.cluster(workers, messages, in_flight);
    let (_, took) =
        sim::run(jobs, trace, &cluster, &mut watch).map_err(|e| Fail::failed(e.to_string()))?;
    let DecisionTimes { first_frame, frames, slabs, results, prefetches, others, .. } = took;
    let result_count = took.result_count;
    // Reading the clock takes part of what is of the order of a microsecond.
    let reading = reading();
    let each = |tally: Tally| (tally.each_ns() - reading).max(0.0);
    // Sums go by their pixels, which the scheduler keeps; it keeps finished tiles as they come.
    let finished =
        jobs.first().is_some_and(|j| j.work.schedule != Schedule::Slab && j.finish.is_some());
    let (fixed_ns, per_unit_ns) = match finished {
        true => (each(Tally { count: result_count, ns: results.ns }), 0.0),
        false => (0.0, results.each_ns()),
    };
    // The first frame sorts the bricks into blocks.
    let begun = jobs.len().saturating_sub(1) as f64;
    let many = (result_count + prefetches.count + others.count) as f64 + jobs.len() as f64;
    let beside = (slabs.ns + results.ns + prefetches.ns + others.ns) as f64 - reading * many;
    let a_frame = frames.ns as f64 / begun.max(1.0) + beside.max(0.0) / jobs.len() as f64;
    let costs = Costs {
        first_brick_ns: first_frame.each_ns(),
        frame_brick_ns: frames.each_ns(),
        slab_brick_ns: slabs.each_ns(),
        // A result and the lease that follows it are handled in one go.
        result: LinearCost { fixed_ns, per_unit_ns },
        prefetch_ns: each(prefetches),
        event_ns: each(others),
        ..messages
    };
    Ok((costs, a_frame / 1e6))
}
