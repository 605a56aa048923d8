//! Figure 3 and Table 1: where the time of each rendering node goes, and what smaller macrotiles do
//! to it. From the spans that a master would write down of a simulated frame.

use super::paper::{self, NODES};
use super::simulate::{Ask, Bed, Pace, Told};
use serde::Serialize;
use slabcast_common::quality::Schedule;
use slabcast_schedule::Span;
use slabcast_session::fail::Fail;
use std::collections::BTreeMap;

/// What one node did in a frame, in ms: the paper's four states (5.1).
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(super) struct Node {
    /// Rendering, slab by slab.
    pub(super) render: Vec<f64>,
    /// No tile, and bricks on their way to it.
    pub(super) broadcast: f64,
    /// No tile, none on the way but leases and results, and one more to come in this slab.
    pub(super) messages: f64,
    /// No tile any more until the slab ends, or the master at work between slabs.
    pub(super) wait: f64,
}

impl Node {
    fn total(&self) -> f64 {
        self.render.iter().sum::<f64>() + self.broadcast + self.messages + self.wait
    }
}

/// Figure 3, of one number of nodes.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Breakdown {
    pub(super) nodes: u32,
    /// Number of the view.
    pub(super) view: usize,
    pub(super) total_ms: f64,
    /// Edge of the macrotiles, slab by slab.
    pub(super) edges: Vec<u32>,
    pub(super) each: Vec<Node>,
    /// Parts of all nodes' time, mean over all views but the first: rendering, messages and bricks,
    /// waiting.
    pub(super) shares: [f64; 3],
}

/// Microseconds of `of` that lie in `within`, pieces of `of` being apart.
fn overlap(of: &[(u64, u64)], within: (u64, u64)) -> u64 {
    of.iter().map(|&(a, b)| b.min(within.1).saturating_sub(a.max(within.0))).sum()
}

/// Time joined where it overlaps.
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

/// Each node's part of a frame, by its name.
pub(super) fn nodes((stats, spans): &Told) -> Vec<Node> {
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
            // Between tiles; who has none in this slab waits from its beginning.
            let (mut at, mut bricks) = (slab.0, 0);
            for &(start, end) in &tiles {
                bricks += overlap(&flights, (at, start));
                at = end;
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

/// The parts of all nodes' time over some frames.
pub(super) fn shares(told: &[Told]) -> [f64; 3] {
    let mut sums = [0.0; 3];
    for node in told.iter().flat_map(nodes) {
        sums[0] += node.render.iter().sum::<f64>();
        sums[1] += node.broadcast + node.messages;
        sums[2] += node.wait;
    }
    let all: f64 = sums.iter().sum();
    sums.map(|s| s / all.max(1e-9))
}

/// The longest that a node waits in a frame, in ms.
pub(super) fn longest_wait(told: &Told) -> f64 {
    nodes(told).iter().map(|n| n.wait).fold(0.0, f64::max)
}

/// What comes after the first frame, which also brings the bricks; the only one if there is one.
pub(super) fn later<T>(frames: &[T]) -> &[T] {
    &frames[usize::from(frames.len() > 1)..]
}

/// Figure 3: the middle view with 16 nodes and with 5.
pub(super) fn breakdowns(bed: &Bed) -> Result<Vec<Breakdown>, Fail> {
    [NODES[4], NODES[1]]
        .into_iter()
        .map(|nodes_all| {
            let told = bed.run(&Ask::of(Schedule::Slab, nodes_all - 1, Pace::Paper))?;
            let view = told.len() / 2;
            let (stats, _) = &told[view];
            let edge =
                |s: &slabcast_common::stats::SlabStats| s.tiles.first().map_or(0, |t| t.size);
            Ok(Breakdown {
                nodes: nodes_all,
                view,
                total_ms: stats.ms.total,
                edges: stats.slabs.iter().map(edge).collect(),
                each: nodes(&told[view]),
                shares: shares(later(&told)),
            })
        })
        .collect()
}

/// A column of Table 1: means over all views but the first.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Tiles {
    pub(super) edge: &'static str,
    /// Sum of all tiles as they were drawn here, in ms.
    pub(super) drawn_here_ms: f64,
    /// Sum of rendering over the nodes, at the paper's pace, in seconds.
    pub(super) summed_s: f64,
    /// The longest that a node waits.
    pub(super) max_wait_s: f64,
    /// Sum over nodes, and the longest wait: what the paper's third line comes to.
    pub(super) a_node_s: f64,
    /// A frame.
    pub(super) frame_s: f64,
    pub(super) tiles: f64,
}

/// Table 1: 15 rendering nodes, three slabs, tiles of 64 pixels, of 64 and then 32, of 32.
pub(super) fn table_1(bed: &Bed) -> Result<Vec<Tiles>, Fail> {
    let workers = NODES[4] - 1;
    let cuts = [(Some(64), false), (Some(64), true), (Some(32), false)];
    let columns = paper::TABLE_1.iter().zip(cuts);
    columns
        .map(|(of, (tile, mixed))| {
            let ask = Ask { tile, mixed, ..Ask::of(Schedule::Slab, workers, Pace::Paper) };
            let told = bed.run(&ask)?;
            let told = later(&told);
            let n = told.len().max(1) as f64;
            let mean = |of: &dyn Fn(&Told) -> f64| told.iter().map(of).sum::<f64>() / n;
            let summed =
                |t: &Told| nodes(t).iter().map(|n| n.render.iter().sum::<f64>()).sum::<f64>() / 1e3;
            let summed_s = mean(&summed);
            let max_wait_s = mean(&|t| longest_wait(t) / 1e3);
            Ok(Tiles {
                edge: of.edge,
                drawn_here_ms: summed_s * 1e3 / bed.stretch(Pace::Paper),
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
    fn time_is_shared_out_between_the_four_states() {
        assert_eq!(overlap(&[(0, 4), (6, 9)], (3, 8)), 3);
        assert_eq!(joined(vec![(5, 9), (0, 2), (1, 3)]), [(0, 3), (5, 9)]);
        assert_eq!(later(&[1, 2, 3]), [2, 3]);
        assert_eq!(later(&[1]), [1]);
    }
}
