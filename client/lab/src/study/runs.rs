//! Figures 4, 5 and 7: frames on more and more nodes, real as far as there are cores, simulated
//! beyond; their times, and what was sent.

use super::nodes::later;
use super::paper::{self, NODES, SLABS};
use super::simulate::{Ask, Bed, Pace};
use serde::Serialize;
use slabcast_common::quality::Schedule;
use slabcast_common::stats::FrameStats;
use slabcast_session::fail::Fail;

/// Where a figure comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Origin {
    /// Run here, on cores.
    Measured,
    /// By the scheduler against virtual nodes.
    Predicted,
}

/// A frame of a run.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Frame {
    pub(super) ms: f64,
    /// Time during which bricks were on their way to some node.
    pub(super) broadcast_ms: f64,
    /// Voxels of the bricks that the frame needs.
    pub(super) needed: u64,
    /// Bytes of bricks that one node was sent, the most of any.
    pub(super) sent: u64,
    /// Bytes of bricks that all nodes were sent.
    pub(super) sent_to_all: u64,
}

impl Frame {
    fn of(stats: &FrameStats) -> Frame {
        let sent = stats.workers.iter().map(|w| w.bytes_sent);
        Frame {
            ms: stats.ms.total,
            broadcast_ms: stats.ms.distribute,
            needed: stats.bricks.needed_voxels,
            sent: sent.clone().max().unwrap_or(0),
            sent_to_all: sent.sum(),
        }
    }
}

/// A path on one cluster.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Run {
    pub(super) origin: Origin,
    pub(super) pace: Pace,
    pub(super) schedule: &'static str,
    /// Of the slab schedule.
    pub(super) slabs: Option<u32>,
    /// The master among them.
    pub(super) nodes: u32,
    /// Mean of the frames but the first, in ms.
    pub(super) frame_ms: f64,
    /// One node's time for a frame over that; what the paper calls speed-up.
    pub(super) speed_up: f64,
    /// Speed-up over the number of nodes.
    pub(super) ratio: f64,
    pub(super) frames: Vec<Frame>,
}

impl Run {
    fn new(
        (origin, pace): (Origin, Pace),
        (schedule, slabs): (Schedule, u32),
        workers: u32,
        alone_ms: f64,
        frames: Vec<Frame>,
    ) -> Run {
        let counted = later(&frames);
        let frame_ms = counted.iter().map(|f| f.ms).sum::<f64>() / counted.len().max(1) as f64;
        let (nodes, speed_up) = (workers + 1, alone_ms / frame_ms.max(1e-9));
        let slab = schedule == Schedule::Slab;
        Run {
            origin,
            pace,
            schedule: if slab { "slab" } else { "region" },
            slabs: slab.then_some(slabs),
            nodes,
            frame_ms,
            speed_up,
            ratio: speed_up / f64::from(nodes),
            frames,
        }
    }

    /// Whether it is one of these.
    pub(super) fn is(&self, origin: Origin, pace: Pace, slabs: Option<u32>) -> bool {
        (self.origin, self.pace, self.slabs) == (origin, pace, slabs)
    }

    /// What it is, without its nodes.
    pub(super) fn kind(&self) -> String {
        match self.slabs {
            Some(n) => format!("{n} slabs"),
            None => "regions".into(),
        }
    }
}

/// Simulated runs on a bed, on the paper's numbers of nodes and those that were run for real.
pub(super) fn simulated(
    bed: &Bed,
    schedule: Schedule,
    live: &[u32],
    threads: usize,
) -> Result<Vec<Run>, Fail> {
    let slabs = bed.trace.about.slabs;
    let mut workers: Vec<u32> = NODES.iter().map(|n| n - 1).chain(live.iter().copied()).collect();
    workers.sort_unstable();
    workers.dedup();
    let paces = [Pace::Here, Pace::Paper];
    let asks: Vec<Ask> = paces
        .iter()
        .flat_map(|&pace| workers.iter().map(move |&w| Ask::of(schedule, w, pace)))
        .collect();
    let told = bed.run_all(&asks, threads)?;
    let run = |(ask, told): (&Ask, Vec<super::simulate::Told>)| {
        let frames = told.iter().map(|t| Frame::of(&t.0)).collect();
        let origin = (Origin::Predicted, ask.pace);
        Run::new(origin, (schedule, slabs), ask.workers, bed.alone_ms(ask.pace), frames)
    };
    Ok(asks.iter().zip(told).map(run).collect())
}

/// A real run.
pub(super) fn measured(slabs: u32, workers: u32, alone_ms: f64, frames: &[FrameStats]) -> Run {
    let frames = frames.iter().map(Frame::of).collect();
    Run::new((Origin::Measured, Pace::Here), (Schedule::Slab, slabs), workers, alone_ms, frames)
}

/// Figure 4 in numbers, of one number of slabs. Means are over the frames but the first.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Data {
    pub(super) slabs: u32,
    /// Needed voxels over all relevant ones, least and most of a frame.
    pub(super) needed: [f64; 2],
    /// The same in MB as the paper stores them, 16 bytes a voxel.
    pub(super) needed_paper_mb: [f64; 2],
    /// Sent to a node, in KB as slabcast encodes them: the first frame, and later ones.
    pub(super) first_kb: f64,
    pub(super) later_kb: f64,
    /// Of later frames: over all bricks' bytes, and that over the needed part.
    pub(super) later_of_all: f64,
    pub(super) later_of_needed: f64,
    /// Milliseconds during which bricks are on their way in later frames, by number of nodes.
    pub(super) broadcast_ms: Vec<(u32, f64)>,
}

/// Figure 4's numbers, at the paper's pace. `relevant` voxels take `bytes` when all are sent.
pub(super) fn data(runs: &[Run], relevant: u64, bytes: u64) -> Vec<Data> {
    let of = |slabs: u32| {
        let here = |r: &&Run| r.is(Origin::Predicted, Pace::Paper, Some(slabs));
        // What is needed and sent to each is the same whatever their number.
        let run = runs.iter().filter(here).find(|r| r.nodes == NODES[1])?;
        let share = |f: &Frame| f.needed as f64 / relevant.max(1) as f64;
        let least = run.frames.iter().map(share).fold(f64::INFINITY, f64::min);
        let most = run.frames.iter().map(share).fold(0.0, f64::max);
        let counted = later(&run.frames);
        let n = counted.len().max(1) as f64;
        let later_bytes = counted.iter().map(|f| f.sent as f64).sum::<f64>() / n;
        let needed = counted.iter().map(share).sum::<f64>() / n;
        let mb = |share: f64| share * (relevant * paper::VOXEL_BYTES) as f64 / 1e6;
        let later_of_all = later_bytes / bytes.max(1) as f64;
        let broadcast = |r: &Run| {
            let counted = later(&r.frames);
            let sum: f64 = counted.iter().map(|f| f.broadcast_ms).sum();
            (r.nodes, sum / counted.len().max(1) as f64)
        };
        let of_paper = |r: &&Run| here(r) && NODES.contains(&r.nodes);
        Some(Data {
            slabs,
            needed: [least, most],
            needed_paper_mb: [mb(least), mb(most)],
            first_kb: run.frames.first().map_or(0.0, |f| f.sent as f64 / 1e3),
            later_kb: later_bytes / 1e3,
            later_of_all,
            later_of_needed: later_of_all / needed.max(1e-9),
            broadcast_ms: runs.iter().filter(of_paper).map(broadcast).collect(),
        })
    };
    SLABS.into_iter().filter_map(of).collect()
}
