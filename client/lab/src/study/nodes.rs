//! Figure 3 and Table 1: how each rendering node spends its time, and the effect of smaller
//! macrotiles, from the time spans of simulated frames.

use super::paper::{self, NODES};
use super::simulate::{FrameReport, MeasuredPath, Pace, SimulatedCluster};
use serde::Serialize;
use slabcast_common::quality::Schedule;
use slabcast_schedule::Span;
use slabcast_session::fail::Fail;
use std::collections::BTreeMap;

/// Time of one node in a frame in the paper's four states (section 5.1), in ms.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(super) struct Node {
    /// Rendering, slab by slab.
    pub(super) render: Vec<f64>,
    /// Without a tile, while bricks are in transit to the node.
    pub(super) broadcast: f64,
    /// Without a tile, while leases or results are in transit and a tile follows in this slab.
    pub(super) messages: f64,
    /// Without any tile until the slab ends, or while the master works between slabs.
    pub(super) wait: f64,
}

impl Node {
    fn total(&self) -> f64 {
        self.render.iter().sum::<f64>() + self.broadcast + self.messages + self.wait
    }
}

/// Data of Figure 3 for one number of nodes.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Breakdown {
    pub(super) nodes: u32,
    /// Index of the view.
    pub(super) view: usize,
    pub(super) total_ms: f64,
    /// Edge of the macrotiles in pixels, slab by slab.
    pub(super) edges: Vec<u32>,
    pub(super) each: Vec<Node>,
    /// Shares of the nodes' time over all views but the first: rendering, messages and bricks,
    /// waiting.
    pub(super) shares: [f64; 3],
}

/// Returns the us of disjoint `intervals` that lie in `within`.
fn overlap(intervals: &[(u64, u64)], within: (u64, u64)) -> u64 {
    intervals.iter().map(|&(a, b)| b.min(within.1).saturating_sub(a.max(within.0))).sum()
}

/// Merges overlapping intervals and sorts them.
fn joined(mut all: Vec<(u64, u64)>) -> Vec<(u64, u64)> {
    all.sort_unstable();
    let mut out: Vec<(u64, u64)> = Vec::new();
    for (a, b) in all {
        match out.last_mut() {
            Some(last) if a <= last.1 => last.1 = last.1.max(b),
            _ => out.push((a, b)),
        }
    }
    out
}

/// Returns the time of each node in a frame, in the order of the workers.
pub(super) fn nodes((stats, spans): &FrameReport) -> Vec<Node> {
    let ms = |us: u64| us as f64 / 1e3;
    let of = |category: &str| {
        let category = category.to_owned();
        spans.iter().filter(move |s| s.category == category)
    };
    let slabs: Vec<(u64, u64)> = of("slab").map(|s| (s.start, s.end)).collect();
    let frame = of("frame").next().map_or(0, |s: &Span| s.end - s.start);
    let mut tiles: BTreeMap<(&str, usize), Vec<(u64, u64)>> = BTreeMap::new();
    for s in of("tile") {
        let slab = s.args.iter().find(|a| a.0 == "slab").and_then(|a| a.1.parse().ok());
        let (Some(name), Some(slab)) = (s.worker.as_deref(), slab) else { continue };
        tiles.entry((name, slab)).or_default().push((s.start, s.end));
    }
    let each = stats.workers.iter().map(|worker| {
        let name = worker.id.as_str();
        let flights = of("bricks").filter(|s| s.worker.as_deref() == Some(name));
        let flights = joined(flights.map(|s| (s.start, s.end)).collect());
        let mut node = Node::default();
        for (n, &slab) in slabs.iter().enumerate() {
            let tiles = joined(tiles.remove(&(name, n)).unwrap_or_default());
            let drawn = overlap(&tiles, slab);
            node.render.push(ms(drawn));
            let last = tiles.last().map_or(slab.0, |t| t.1);
            // Gaps between tiles. A node without tiles in this slab waits from its beginning.
            let (mut gap_start, mut bricks) = (slab.0, 0);
            for &(start, end) in &tiles {
                bricks += overlap(&flights, (gap_start, start));
                gap_start = end;
            }
            let idle = (last - slab.0).saturating_sub(drawn);
            node.broadcast += ms(bricks.min(idle));
            node.messages += ms(idle - bricks.min(idle));
            let bricks = overlap(&flights, (last, slab.1));
            node.broadcast += ms(bricks);
            node.wait += ms((slab.1 - last).saturating_sub(bricks));
        }
        node.wait += (ms(frame) - node.total()).max(0.0);
        node
    });
    each.collect()
}

/// Returns the shares of the nodes' time over some frames, as in [`Breakdown::shares`].
pub(super) fn shares(reports: &[FrameReport]) -> [f64; 3] {
    let mut sums = [0.0; 3];
    for node in reports.iter().flat_map(nodes) {
        sums[0] += node.render.iter().sum::<f64>();
        sums[1] += node.broadcast + node.messages;
        sums[2] += node.wait;
    }
    let all: f64 = sums.iter().sum();
    sums.map(|s| s / all.max(1e-9))
}

/// Returns the longest wait of a node in a frame, in ms.
pub(super) fn longest_wait(reports: &FrameReport) -> f64 {
    nodes(reports).iter().map(|n| n.wait).fold(0.0, f64::max)
}

/// Returns all frames but the first, during which the bricks are sent; a single frame as it is.
pub(super) fn later<T>(frames: &[T]) -> &[T] {
    &frames[usize::from(frames.len() > 1)..]
}

/// Simulates Figure 3: the middle view with 16 nodes and with 5.
pub(super) fn breakdowns(measured_path: &MeasuredPath) -> Result<Vec<Breakdown>, Fail> {
    [NODES[4], NODES[1]]
        .into_iter()
        .map(|nodes_all| {
            let reports = measured_path.run(&SimulatedCluster::new(
                Schedule::Slab,
                nodes_all - 1,
                Pace::Paper,
            ))?;
            let view = reports.len() / 2;
            let (stats, _) = &reports[view];
            let edge =
                |s: &slabcast_common::stats::SlabStats| s.tiles.first().map_or(0, |t| t.size);
            Ok(Breakdown {
                nodes: nodes_all,
                view,
                total_ms: stats.ms.total,
                edges: stats.slabs.iter().map(edge).collect(),
                each: nodes(&reports[view]),
                shares: shares(later(&reports)),
            })
        })
        .collect()
}

/// A column of Table 1: means over all views but the first.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Tiles {
    pub(super) edge: &'static str,
    /// Sum of all tile times measured here, in ms.
    pub(super) drawn_here_ms: f64,
    /// Sum of rendering over the nodes at the paper's pace, in s.
    pub(super) summed_s: f64,
    /// Longest wait of a node, in s.
    pub(super) max_wait_s: f64,
    /// `summed_s` over the number of nodes plus `max_wait_s`, in s: the paper's third line.
    pub(super) a_node_s: f64,
    /// Time of a frame, in s.
    pub(super) frame_s: f64,
    pub(super) tiles: f64,
}

/// Simulates Table 1: 15 rendering nodes, three slabs, tiles of 64 pixels, of 64 and then 32, of
/// 32.
pub(super) fn table_1(measured_path: &MeasuredPath) -> Result<Vec<Tiles>, Fail> {
    let workers = NODES[4] - 1;
    let cuts = [(Some(64), false), (Some(64), true), (Some(32), false)];
    let columns = paper::TABLE_1.iter().zip(cuts);
    columns
        .map(|(column, (tile, mixed))| {
            let cluster = SimulatedCluster {
                tile,
                mixed,
                ..SimulatedCluster::new(Schedule::Slab, workers, Pace::Paper)
            };
            let reports = measured_path.run(&cluster)?;
            let reports = later(&reports);
            let n = reports.len().max(1) as f64;
            let mean =
                |value: &dyn Fn(&FrameReport) -> f64| reports.iter().map(value).sum::<f64>() / n;
            let summed = |t: &FrameReport| {
                nodes(t).iter().map(|n| n.render.iter().sum::<f64>()).sum::<f64>() / 1e3
            };
            let summed_s = mean(&summed);
            let max_wait_s = mean(&|t| longest_wait(t) / 1e3);
            Ok(Tiles {
                edge: column.edge,
                drawn_here_ms: summed_s * 1e3 / measured_path.stretch(Pace::Paper),
                summed_s,
                max_wait_s,
                a_node_s: summed_s / f64::from(workers) + max_wait_s,
                frame_s: mean(&|t| t.0.ms.total / 1e3),
                tiles: mean(&|t| t.0.slabs.iter().map(|s| s.tiles.len()).sum::<usize>() as f64),
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overlap_and_joined_of_time_intervals() {
        assert_eq!(overlap(&[(0, 4), (6, 9)], (3, 8)), 3);
        assert_eq!(joined(vec![(5, 9), (0, 2), (1, 3)]), [(0, 3), (5, 9)]);
        assert_eq!(later(&[1, 2, 3]), [2, 3]);
        assert_eq!(later(&[1]), [1]);
    }
}
