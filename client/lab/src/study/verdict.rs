//! Judges whether sentences of the paper hold in the study.
//!
//! Each sentence has a rule, the same for every volume, with a margin for other hardware and for a
//! scheduler that sends each node only the bricks it lacks. A sentence about numbers of the head
//! holds for another volume only by chance; it is judged all the same, and the page says which
//! volume it was. Where a sentence says only that something is more, 3 % count as no difference:
//! two times of one tile differ by as much.

use super::Study;
use super::nodes::Breakdown;
use super::paper::{self, NODES};
use super::runs::{Data, Origin, Run};
use super::simulate::Pace;
use serde::Serialize;

/// Whether a sentence holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Holds {
    Yes,
    Partly,
    No,
    /// A sentence about one kind of volume; the reader knows whether this is one.
    Unjudged,
}

impl Holds {
    /// Returns the verdict in words.
    pub(super) fn word(self) -> &'static str {
        match self {
            Holds::Yes => "holds",
            Holds::Partly => "partly",
            Holds::No => "does not hold",
            Holds::Unjudged => "not judged",
        }
    }

    /// Returns the verdict by two conditions: the sentence, and half of it.
    fn from_conditions(all: bool, half: bool) -> Holds {
        match (all, half) {
            (true, _) => Holds::Yes,
            (false, true) => Holds::Partly,
            (false, false) => Holds::No,
        }
    }
}

/// One sentence of the paper and its verdict.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Verdict {
    /// Section, table or figure of the paper.
    pub(super) place: &'static str,
    /// Statement in the paper's words or numbers.
    pub(super) paper: String,
    /// Result of this study.
    pub(super) here: String,
    /// Condition under which the sentence holds.
    pub(super) rule: &'static str,
    pub(super) holds: Holds,
}

/// Formats a share from 0 to 1 as per cent.
pub(super) fn percent(x: f64) -> String {
    if x < 0.0995 { format!("{:.1} %", x * 100.0) } else { format!("{:.0} %", x * 100.0) }
}

/// Returns whether `x` lies in a range; partly, up to a factor of 1.5 outside.
fn within(x: f64, [lo, hi]: [f64; 2]) -> Holds {
    Holds::from_conditions((lo..=hi).contains(&x), (lo / 1.5..=hi * 1.5).contains(&x))
}

/// Returns whether `this` exceeds `that` by 3 %; partly, if it is within 3 %.
fn more(this: f64, that: f64) -> Holds {
    Holds::from_conditions(this > 1.03 * that, this > that / 1.03)
}

/// Judges all sentences that the study has results for.
pub(super) fn verdicts(study: &Study) -> Vec<Verdict> {
    let mut all = Vec::new();
    order(study, &mut all);
    nodes(study, &mut all);
    tiles(study, &mut all);
    data(study, &mut all);
    speed(study, &mut all);
    effects(study, &mut all);
    all
}

fn order(study: &Study, all: &mut Vec<Verdict>) {
    let Some(o) = &study.figure_1 else { return };
    all.push(Verdict {
        place: "4.3, Figure 1a",
        paper:
            "estimated and measured order follow a 45 degree line from the 16th of 38 macrotiles \
                on"
            .into(),
        here: format!(
            "rank correlation {:.2} between place in the queue and order of ending, over {} \
             macrotiles",
            o.ended,
            o.tiles.len()
        ),
        rule: "correlation of at least 0.8; partly from 0.5",
        holds: Holds::from_conditions(o.ended >= 0.8, o.ended >= 0.5),
    });
    all.push(Verdict {
        place: "4.3, Figure 1b",
        paper: "macrotiles that are wholly covered by bricks take about the same time; the times of \
                the others are sorted as estimated"
            .into(),
        here: format!(
            "{} of {} are wholly covered; estimate and time correlate by {:.2} over the others, {:.2} \
             over all, {:.2} over all views (the time of the view before: {:.2})",
            o.covered,
            o.tiles.len(),
            o.estimate_open,
            o.estimate,
            o.estimate_all_views,
            o.learned_all_views
        ),
        rule: "correlation over the others of at least 0.8; partly from 0.5",
        holds: Holds::from_conditions(o.estimate_open >= 0.8, o.estimate_open >= 0.5),
    });
}

fn nodes(study: &Study, all: &mut Vec<Verdict>) {
    let breakdown = |n: u32| study.figure_3.iter().find(|b: &&Breakdown| b.nodes == n);
    let (Some(many), Some(few)) = (breakdown(NODES[4]), breakdown(NODES[1])) else { return };
    let most = many.shares[1].max(few.shares[1]);
    all.push(Verdict {
        place: "5.1, Figure 3",
        paper: "communication is about 5 % of the time, with 16 nodes and with 5".into(),
        here: format!("{} with 16, {} with 5", percent(many.shares[1]), percent(few.shares[1])),
        rule: "at most 7.5 % with both; partly to 15 %",
        holds: Holds::from_conditions(most <= 0.075, most <= 0.15),
    });
    all.push(Verdict {
        place: "5.1, Figure 3",
        paper: "waiting at barriers takes about 15 % to 20 % with 16 nodes".into(),
        here: percent(many.shares[2]),
        rule: "10 % to 25 %; partly by half as much again",
        holds: within(many.shares[2], [0.10, 0.25]),
    });
    all.push(Verdict {
        place: "5.1, Figure 3",
        paper: "with 5 nodes, rendering takes more than 90 %".into(),
        here: percent(few.shares[0]),
        rule: "at least 90 %; partly from 80 %",
        holds: Holds::from_conditions(few.shares[0] >= 0.9, few.shares[0] >= 0.8),
    });
}

fn tiles(study: &Study, all: &mut Vec<Verdict>) {
    let [large, mixed, small] = &study.table_1[..] else { return };
    let [p_large, p_mixed, p_small] = &paper::TABLE_1;
    let more = small.summed_s / large.summed_s;
    all.push(Verdict {
        place: "5.1, Table 1",
        paper: format!(
            "from 64 to 32 pixels, summed rendering almost doubles: {} to {} s (x {:.2})",
            p_large.summed_s,
            p_small.summed_s,
            p_small.summed_s / p_large.summed_s
        ),
        here: format!("{:.2} to {:.2} s (x {more:.2})", large.summed_s, small.summed_s),
        rule: "1.4 to 2.2 times; partly from 1.2",
        holds: Holds::from_conditions((1.4..=2.2).contains(&more), more >= 1.2),
    });
    let less = small.max_wait_s / large.max_wait_s.max(1e-9);
    all.push(Verdict {
        place: "5.1, Table 1",
        paper: format!(
            "and the longest wait is cut almost in half: {} to {} s (x {:.2})",
            p_large.max_wait_s,
            p_small.max_wait_s,
            p_small.max_wait_s / p_large.max_wait_s
        ),
        here: format!("{:.2} to {:.2} s (x {less:.2})", large.max_wait_s, small.max_wait_s),
        rule: "0.7 times at most; partly to 0.9",
        holds: Holds::from_conditions(less <= 0.7, less <= 0.9),
    });
    let worse = [large.frame_s, mixed.frame_s, small.frame_s];
    all.push(Verdict {
        place: "5.1, Table 1",
        paper: format!(
            "what is gained in waiting does not make up for it: {}, {} and {} s a node with 64, 64/32 \
             and 32 pixels",
            p_large.a_node_s, p_mixed.a_node_s, p_small.a_node_s
        ),
        here: format!("frames of {:.2}, {:.2} and {:.2} s", worse[0], worse[1], worse[2]),
        rule: "frames of 64 pixels are the fastest, of 32 the slowest; partly: the fastest",
        holds: Holds::from_conditions(
            worse[0] <= worse[1] && worse[1] <= worse[2],
            worse[0] <= worse[1] && worse[0] <= worse[2],
        ),
    });
}

fn data(study: &Study, all: &mut Vec<Verdict>) {
    let data = |n: u32| study.figure_4.iter().find(|d: &&Data| d.slabs == n);
    let Some(three) = data(3) else { return };
    let [least, most] = three.needed;
    all.push(Verdict {
        place: "5.2, Figure 4a",
        paper: "a view needs about 15 % to 18 % of the volume's data (12 to 14 MB)".into(),
        here: format!(
            "{} to {} in three slabs ({:.1} to {:.1} MB in the paper's 16 bytes a voxel)",
            percent(least),
            percent(most),
            three.needed_paper_mb[0],
            three.needed_paper_mb[1]
        ),
        rule: "most at most 27 %; partly to 50 %",
        holds: Holds::from_conditions(most <= 0.27, most <= 0.5),
    });
    all.push(Verdict {
        place: "5.2, Figure 4a",
        paper: "a new view changes about 6 % of that, 1 % of all data (400 to 600 KB)".into(),
        here: format!(
            "a node is sent {:.0} KB: {} of what is needed, {} of all",
            three.later_kb,
            percent(three.later_of_needed),
            percent(three.later_of_all)
        ),
        rule: "at most 9 % and 1.5 %; partly: one of the two",
        holds: Holds::from_conditions(
            three.later_of_needed <= 0.09 && three.later_of_all <= 0.015,
            three.later_of_needed <= 0.09 || three.later_of_all <= 0.015,
        ),
    });
    let spread = |d: &Data| {
        let ms = d.broadcast_ms.iter().map(|b| b.1);
        let (lo, hi) = (ms.clone().fold(f64::INFINITY, f64::min), ms.fold(0.0, f64::max));
        (lo, hi)
    };
    let (lo, hi) = spread(three);
    if lo > 0.0 && lo.is_finite() {
        all.push(Verdict {
            place: "5.2, Figure 4b",
            paper: "time to broadcast hardly grows with the number of nodes (a tree: log n)".into(),
            here: format!(
                "from {lo:.2} to {hi:.2} ms over 3 to 16 nodes: each is sent a stream of its own"
            ),
            rule: "at most twice from 3 to 16 nodes; partly to three times",
            holds: Holds::from_conditions(hi <= 2.0 * lo, hi <= 3.0 * lo),
        });
    }
    let Some(five) = data(5) else { return };
    all.push(Verdict {
        place: "5.2, Figure 4a",
        paper: "three slabs keep more data for a view than five".into(),
        here: format!("{} at most, against {}", percent(most), percent(five.needed[1])),
        rule: "more with three; partly: within 3 %",
        holds: more(most, five.needed[1]),
    });
    let (a, b) = (spread(three).1, spread(five).1);
    all.push(Verdict {
        place: "5.2, Figure 4c",
        paper: "broadcasts take a little longer with five slabs than with three".into(),
        here: format!("{b:.2} against {a:.2} ms with the most nodes"),
        rule: "longer with five; partly: within 3 %",
        holds: more(b, a),
    });
}

fn speed(study: &Study, all: &mut Vec<Verdict>) {
    let run = |slabs: u32, nodes: u32| {
        let of = |r: &&Run| r.is(Origin::Predicted, Pace::Paper, Some(slabs)) && r.nodes == nodes;
        study.runs.iter().find(of)
    };
    for (nodes, factor) in paper::SPEED_UPS {
        let Some(r) = run(3, nodes) else { continue };
        all.push(Verdict {
            place: "5.3, Figure 7a",
            paper: format!(
                "the head is {factor} times as fast on {nodes} nodes, {} of which render (caches \
                 help)",
                nodes - 1
            ),
            here: format!("{:.2} times", r.speed_up),
            rule: "at least as much; partly from three quarters",
            holds: Holds::from_conditions(r.speed_up >= factor, r.speed_up >= 0.75 * factor),
        });
    }
    if let Some(r) = run(3, NODES[4]) {
        let frame_s = r.frame_ms / 1e3;
        all.push(Verdict {
            place: "1",
            paper: format!(
                "all 16 nodes render the head in {} s a frame, one in {:.0} s",
                paper::NODES_16_S,
                paper::ALONE_S
            ),
            here: format!("{frame_s:.2} s, where one takes {:.0} s", paper::ALONE_S),
            rule: "at most 1.65 s; partly to 2.25 s",
            holds: Holds::from_conditions(frame_s <= 1.65, frame_s <= 2.25),
        });
        let [(_, head), (_, skull)] = paper::RATIOS_16;
        all.push(Verdict {
            place: "5.3, Figure 7b",
            paper: format!(
                "{} of 16 times with 16 nodes for the head, {} for the skull; poor for the vessels",
                percent(head),
                percent(skull)
            ),
            here: format!("{} ({:.1} times)", percent(r.ratio), r.speed_up),
            rule: "at least 60 %; partly from 45 %",
            holds: Holds::from_conditions(r.ratio >= 0.6, r.ratio >= 0.45),
        });
    }
    if let (Some(ten), Some(most)) = (run(3, NODES[2]), run(3, NODES[4])) {
        let gain = most.speed_up / ten.speed_up;
        all.push(Verdict {
            place: "5.3, Figure 7",
            paper: "vessels: reasonable below 10 nodes, poor beyond (no such limit for head and skull)"
                .into(),
            here: format!(
                "16 nodes are {gain:.2} times as fast as 9, of {:.2} that there are more rendering nodes; \
                 ratio {} and {}",
                15.0 / 8.0,
                percent(ten.ratio),
                percent(most.ratio)
            ),
            rule: "for you to tell: it is about vessels alone",
            holds: Holds::Unjudged,
        });
    }
    let (three, five) = (run(3, NODES[4]), run(5, NODES[4]));
    if let (Some(three), Some(five)) = (three, five) {
        all.push(Verdict {
            place: "5.3, Figure 5",
            paper: "three slabs are slightly faster than five: two barriers less".into(),
            here: format!(
                "{:.2} s with three, {:.2} s with five, on 16 nodes",
                three.frame_ms / 1e3,
                five.frame_ms / 1e3
            ),
            rule: "three are faster; partly: within 3 %",
            holds: more(five.frame_ms, three.frame_ms),
        });
    }
}

fn effects(study: &Study, all: &mut Vec<Verdict>) {
    let e = &study.effects;
    if let Some(c) = &e.culling {
        let factor = c.without_ms / c.with_ms.max(1e-9);
        let theirs = paper::ALONE_UNCULLED_S / paper::ALONE_S;
        all.push(Verdict {
            place: "1",
            paper: format!(
                "occlusion culling takes a frame of the head on one node from {:.0} to {:.0} s (x \
                 {theirs:.1})",
                paper::ALONE_UNCULLED_S,
                paper::ALONE_S
            ),
            here: format!("{:.1} to {:.1} ms (x {factor:.1})", c.without_ms, c.with_ms),
            rule: "5 times or more; partly from 2",
            holds: Holds::from_conditions(factor >= 5.0, factor >= 2.0),
        });
    }
    if let [small, .., large] = &e.radii[..] {
        all.push(Verdict {
            place: "5.1",
            paper: "smaller kernels reduce waiting".into(),
            here: format!(
                "of nodes' time, {} is waiting with {}, {} with {}",
                percent(small.shares[2]),
                small.name,
                percent(large.shares[2]),
                large.name
            ),
            rule: "less waiting with the smallest radius than with the largest; partly: within 3 %",
            holds: more(large.shares[2], small.shares[2]),
        });
    }
    if let [small, .., large] = &e.sizes[..] {
        let over = |s: &super::effects::Setting| s.tiles_ms[0] / s.alone_ms.max(1e-9);
        all.push(Verdict {
            place: "5.1",
            paper: "a larger picture makes larger splats, and the overhead grows".into(),
            here: format!(
                "macrotiles of 64 pixels take {:.2} times the frame alone at {}, {:.2} times at {}",
                over(small),
                small.name,
                over(large),
                large.name
            ),
            rule: "more overhead in the largest picture than in the smallest; partly: within 3 %",
            holds: more(over(large), over(small)),
        });
    }
}
