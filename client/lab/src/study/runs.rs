//! Figures 4, 5 and 7: times and bytes of frames by number of nodes, measured as far as this
//! machine has cores and simulated beyond.

use super::nodes::later;
use super::paper::{self, NODES, SLABS};
use super::simulate::{MeasuredPath, Pace, SimulatedCluster};
use serde::Serialize;
use slabcast_common::quality::Schedule;
use slabcast_common::stats::FrameStats;
use slabcast_session::fail::Fail;

/// Origin of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Origin {
    /// Run on cores of this machine.
    Measured,
    /// Simulated by the scheduler on virtual nodes.
    Predicted,
}

/// A frame of a run.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Frame {
    pub(super) ms: f64,
    /// Time during which bricks were in transit to some node, in ms.
    pub(super) broadcast_ms: f64,
    /// Number of voxels of the bricks that the frame needs.
    pub(super) needed: u64,
    /// Most bytes of bricks sent to one node.
    pub(super) sent: u64,
    /// Bytes of bricks sent to all nodes.
    pub(super) sent_to_all: u64,
}

impl Frame {
    fn from_stats(stats: &FrameStats) -> Frame {
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
    /// Number of slabs; `None` for the region schedule.
    pub(super) slabs: Option<u32>,
    /// Number of nodes, the master included.
    pub(super) nodes: u32,
    /// Mean of the frames but the first, in ms.
    pub(super) frame_ms: f64,
    /// Time of a frame on one node over `frame_ms`, as in the paper.
    pub(super) speed_up: f64,
    /// Speed-up divided by the number of nodes.
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

    /// Returns whether the run has this origin, pace and number of slabs.
    pub(super) fn is(&self, origin: Origin, pace: Pace, slabs: Option<u32>) -> bool {
        (self.origin, self.pace, self.slabs) == (origin, pace, slabs)
    }

    /// Returns the division of work: `3 slabs` or `regions`.
    pub(super) fn kind(&self) -> String {
        match self.slabs {
            Some(n) => format!("{n} slabs"),
            None => "regions".into(),
        }
    }
}

/// Simulates runs with the paper's numbers of nodes and those that are run for real.
pub(super) fn simulated(
    measured_path: &MeasuredPath,
    schedule: Schedule,
    live: &[u32],
    threads: usize,
) -> Result<Vec<Run>, Fail> {
    let slabs = measured_path.trace.about.slabs;
    let mut workers: Vec<u32> = NODES.iter().map(|n| n - 1).chain(live.iter().copied()).collect();
    workers.sort_unstable();
    workers.dedup();
    let paces = [Pace::Here, Pace::Paper];
    let clusters: Vec<SimulatedCluster> = paces
        .iter()
        .flat_map(|&pace| workers.iter().map(move |&w| SimulatedCluster::new(schedule, w, pace)))
        .collect();
    let reports = measured_path.run_all(&clusters, threads)?;
    let run = |(cluster, reports): (&SimulatedCluster, Vec<super::simulate::FrameReport>)| {
        let frames = reports.iter().map(|t| Frame::from_stats(&t.0)).collect();
        let origin = (Origin::Predicted, cluster.pace);
        Run::new(
            origin,
            (schedule, slabs),
            cluster.workers,
            measured_path.alone_ms(cluster.pace),
            frames,
        )
    };
    Ok(clusters.iter().zip(reports).map(run).collect())
}

/// Returns a real run from the statistics of its frames.
pub(super) fn measured(slabs: u32, workers: u32, alone_ms: f64, frames: &[FrameStats]) -> Run {
    let frames = frames.iter().map(Frame::from_stats).collect();
    Run::new((Origin::Measured, Pace::Here), (Schedule::Slab, slabs), workers, alone_ms, frames)
}

/// Data of Figure 4 for one number of slabs. Means are over the frames but the first.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Data {
    pub(super) slabs: u32,
    /// Least and largest share of the relevant voxels that a frame needs.
    pub(super) needed: [f64; 2],
    /// Size of the needed voxels in MB at the paper's 16 bytes each, least and largest.
    pub(super) needed_paper_mb: [f64; 2],
    /// Bricks sent to a node for the first frame, in KB.
    pub(super) first_kb: f64,
    /// Bricks sent to a node for a later frame, in KB.
    pub(super) later_kb: f64,
    /// Bytes sent for a later frame over the bytes of all bricks.
    pub(super) later_of_all: f64,
    /// `later_of_all` over the needed share.
    pub(super) later_of_needed: f64,
    /// Number of nodes, and ms during which bricks are in transit in later frames.
    pub(super) broadcast_ms: Vec<(u32, f64)>,
}

/// Returns Figure 4 at the paper's pace. All `relevant` voxels have `bytes` bytes when sent.
pub(super) fn data(runs: &[Run], relevant: u64, bytes: u64) -> Vec<Data> {
    let data_of_slabs = |slabs: u32| {
        let here = |r: &&Run| r.is(Origin::Predicted, Pace::Paper, Some(slabs));
        // Needed and sent data do not depend on the number of nodes.
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
    SLABS.into_iter().filter_map(data_of_slabs).collect()
}
