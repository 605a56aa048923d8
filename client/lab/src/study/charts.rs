//! The charts of a study, each with a sentence that explains it.

use super::Study;
use super::draw::{Bars, Look, Plot, Series, Steps};
use super::paper::{self, NODES, SLABS};
use super::runs::{Frame, Origin, Run};
use super::simulate::Pace;
use crate::chart::{self, Mark, Pixels, Theme};

/// A chart of lines or of bars.
pub(super) enum Picture {
    Plot(Plot),
    Bars(Bars),
}

/// A chart with the stem of its file name and an explanation.
pub(super) struct Chart {
    pub(super) stem: &'static str,
    pub(super) says: String,
    picture: Picture,
}

impl Chart {
    /// Draws the chart as SVG.
    pub(super) fn svg(&self, theme: &Theme) -> Result<String, String> {
        match &self.picture {
            Picture::Plot(plot) => chart::svg(plot, theme),
            Picture::Bars(bars) => chart::svg(bars, theme),
        }
    }

    /// Draws the chart as pixels.
    pub(super) fn pixels(&self, theme: &Theme) -> Result<Pixels, String> {
        match &self.picture {
            Picture::Plot(plot) => chart::pixels(plot, theme),
            Picture::Bars(bars) => chart::pixels(bars, theme),
        }
    }
}

/// Returns all charts that the study has results for, in the paper's order.
pub(super) fn charts(study: &Study) -> Vec<Chart> {
    let mut all = Vec::new();
    order(study, &mut all);
    breakdown(study, &mut all);
    data(study, &mut all);
    times(study, &mut all);
    speed(study, &mut all);
    all
}

fn about(study: &Study, more: &str) -> String {
    let [w, h] = study.size;
    format!("{}, {}, {w}x{h}; {more}", study.volume, study.tf)
}

fn even(label: &str) -> (String, Steps) {
    (label.into(), Steps::Even)
}

fn powers(label: &str) -> (String, Steps) {
    (label.into(), Steps::Powers)
}

fn line(name: impl Into<String>, look: Look, points: Vec<(f64, f64)>) -> Series {
    Series { name: name.into(), look, points }
}

fn order(study: &Study, all: &mut Vec<Chart>) {
    let Some(o) = &study.figure_1 else { return };
    let n = o.tiles.len() as f64;
    let at = |of: &dyn Fn(&super::order::Tile) -> f64| -> Vec<(f64, f64)> {
        o.tiles.iter().map(|t| (t.place as f64, of(t))).collect()
    };
    all.push(Chart {
        stem: "figure1a",
        says: format!(
            "Figure 1a: of the {} macrotiles of the first slab, those that the scheduler took for large \
             end in about that order where points follow the line (rank correlation {:.2}).",
            o.tiles.len(),
            o.ended
        ),
        picture: Picture::Plot(Plot {
            title: "Figure 1a: order of the queue and order of ending".into(),
            about: about(study, &format!("view {}, {} rendering nodes", o.view, o.workers)),
            x: even("place by estimated workload"),
            y: even("place by end"),
            x_ticks: None,
            series: vec![
                line("predicted", Look::Marks(Mark::Dot, 0), at(&|t| t.ended as f64)),
                line("as estimated", Look::Guide, vec![(1.0, 1.0), (n, n)]),
            ],
        }),
    });
    let tiles = |covered: bool| -> Vec<(f64, f64)> {
        let of = o.tiles.iter().filter(|t| t.is_covered() == covered);
        of.map(|t| (t.place as f64, t.ms)).collect()
    };
    all.push(Chart {
        stem: "figure1b",
        says: format!(
            "Figure 1b: what these macrotiles took to draw here, in the order of the queue; the first \
             {} are wholly covered by bricks, and the estimate cannot tell them apart.",
            o.covered
        ),
        picture: Picture::Plot(Plot {
            title: "Figure 1b: estimated order and time to draw".into(),
            about: about(study, &format!("view {}, each tile alone on one core", o.view)),
            x: even("place by estimated workload"),
            y: even("ms, measured here"),
            x_ticks: None,
            series: vec![
                line("wholly covered, measured", Look::Marks(Mark::Square, 1), tiles(true)),
                line("the others, measured", Look::Marks(Mark::Dot, 0), tiles(false)),
            ],
        }),
    });
}

fn breakdown(study: &Study, all: &mut Vec<Chart>) {
    let Some(first) = study.figure_3.first() else { return };
    let slabs = first.each.iter().map(|n| n.render.len()).max().unwrap_or(0);
    let mut pieces: Vec<(String, usize)> =
        (0..slabs).map(|n| (format!("rendering slab {}", n + 1), n)).collect();
    pieces.extend([("broadcast".into(), 3), ("messages".into(), 4), ("waiting".into(), 7)]);
    let groups = study.figure_3.iter().map(|b| {
        let bars = b.each.iter().map(|n| {
            let mut bar = n.render.clone();
            bar.resize(slabs, 0.0);
            bar.extend([n.broadcast, n.messages, n.wait]);
            bar.iter().map(|ms| ms / 1e3).collect()
        });
        let edges: Vec<String> = b.edges.iter().map(u32::to_string).collect();
        let name = format!("{} nodes, macrotiles of {} pixels", b.nodes, edges.join(", "));
        (name, bars.collect())
    });
    all.push(Chart {
        stem: "figure3",
        says: "Figure 3: where the time of each rendering node goes in one view; what is not coloured \
               as rendering is lost."
            .into(),
        picture: Picture::Bars(Bars {
            title: "Figure 3: a view's time on each rendering node".into(),
            about: about(study, "three slabs, predicted, at the paper's pace"),
            x: "seconds".into(),
            pieces,
            groups: groups.collect(),
        }),
    });
}

/// Returns the runs of one kind by number of nodes.
fn runs_of_kind(study: &Study, origin: Origin, pace: Pace, slabs: Option<u32>) -> Vec<&Run> {
    let mut runs: Vec<&Run> = study.runs.iter().filter(|r| r.is(origin, pace, slabs)).collect();
    runs.sort_by_key(|r| r.nodes);
    runs
}

fn by_view(run: &Run, value: impl Fn(&Frame) -> f64) -> Vec<(f64, f64)> {
    run.frames.iter().enumerate().map(|(i, f)| (i as f64, value(f))).collect()
}

fn data(study: &Study, all: &mut Vec<Chart>) {
    let run = |slabs: u32| {
        let runs = runs_of_kind(study, Origin::Predicted, Pace::Paper, Some(slabs));
        runs.into_iter().find(|r| r.nodes == NODES[1])
    };
    let a_voxel = study.bytes as f64 / study.voxels.max(1) as f64;
    let mut series = Vec::new();
    for (i, slabs) in SLABS.into_iter().enumerate() {
        let Some(run) = run(slabs) else { continue };
        let needed = by_view(run, |f| f.needed as f64 * a_voxel / 1e6);
        series.push(line(format!("needed, {slabs} slabs"), Look::Line(i), needed));
    }
    for (i, slabs) in SLABS.into_iter().enumerate() {
        let Some(run) = run(slabs) else { continue };
        let sent = by_view(run, |f| f.sent as f64 / 1e6).into_iter().filter(|p| p.1 > 0.0);
        series.push(line(format!("sent, {slabs} slabs"), Look::Dashes(i), sent.collect()));
    }
    if !series.is_empty() {
        all.push(Chart {
            stem: "figure4a",
            says: "Figure 4a: the data that each view needs, and what is sent to a node for it: after \
                   the first view, only what it lacks."
                .into(),
            picture: Picture::Plot(Plot {
                title: "Figure 4a: data of a view, and sent for it to each node".into(),
                about: about(
                    study,
                    &format!("all bricks: {:.1} MB as slabcast encodes them", study.bytes as f64 / 1e6),
                ),
                x: even("view"),
                y: powers("MB"),
                x_ticks: None,
                series,
            }),
        });
    }
    for (slabs, stem, letter) in [(SLABS[0], "figure4b", "b"), (SLABS[1], "figure4c", "c")] {
        let runs = runs_of_kind(study, Origin::Predicted, Pace::Paper, Some(slabs));
        let runs = runs.into_iter().filter(|r| NODES.contains(&r.nodes)).enumerate();
        let one = |(i, r): (usize, &Run)| {
            let points = by_view(r, |f| f.broadcast_ms).into_iter().filter(|p| p.1 > 0.0);
            line(format!("{} nodes", r.nodes), Look::Line(i), points.collect())
        };
        let series: Vec<Series> = runs.map(one).collect();
        if series.is_empty() {
            continue;
        }
        all.push(Chart {
            stem,
            says: format!(
                "Figure 4{letter}: how long bricks are on their way for each view in {slabs} slabs; \
                 each node has a stream of its own here, so more nodes take longer."
            ),
            picture: Picture::Plot(Plot {
                title: format!("Figure 4{letter}: time bricks are on their way, {slabs} slabs"),
                about: about(study, &format!("predicted, links of {}", study.link)),
                x: even("view"),
                y: powers("ms"),
                x_ticks: None,
                series,
            }),
        });
    }
}

fn times(study: &Study, all: &mut Vec<Chart>) {
    for (slabs, stem, letter) in [(SLABS[0], "figure5a", "a"), (SLABS[1], "figure5b", "b")] {
        let runs = runs_of_kind(study, Origin::Predicted, Pace::Paper, Some(slabs));
        let runs = runs.into_iter().filter(|r| NODES.contains(&r.nodes)).enumerate();
        let one = |(i, r): (usize, &Run)| {
            line(format!("{} nodes", r.nodes), Look::Line(i), by_view(r, |f| f.ms / 1e3))
        };
        let mut series: Vec<Series> = runs.map(one).collect();
        if series.is_empty() {
            continue;
        }
        if slabs == SLABS[0] {
            let name = "paper, head: 16 nodes";
            let last = study.views.saturating_sub(1) as f64;
            let points = vec![(0.0, paper::NODES_16_S), (last, paper::NODES_16_S)];
            series.push(line(name, Look::Guide, points));
        }
        all.push(Chart {
            stem,
            says: format!(
                "Figure 5{letter}: time of each view in {slabs} slabs on 3 to 16 nodes, at the paper's \
                 pace."
            ),
            picture: Picture::Plot(Plot {
                title: format!("Figure 5{letter}: time of a view, {slabs} slabs"),
                about: about(study, "predicted, at the paper's pace: 17 s on one node"),
                x: even("view"),
                y: powers("seconds"),
                x_ticks: None,
                series,
            }),
        });
    }
}

fn speed(study: &Study, all: &mut Vec<Chart>) {
    let most = f64::from(NODES[4]);
    let kinds: [(&str, Origin, Pace, Option<u32>, Look); 6] = [
        ("3 slabs, paper's pace", Origin::Predicted, Pace::Paper, Some(3), Look::Line(0)),
        ("5 slabs, paper's pace", Origin::Predicted, Pace::Paper, Some(5), Look::Line(1)),
        ("regions, paper's pace", Origin::Predicted, Pace::Paper, None, Look::Line(2)),
        ("3 slabs, this pace", Origin::Predicted, Pace::Here, Some(3), Look::Dashes(0)),
        ("regions, this pace", Origin::Predicted, Pace::Here, None, Look::Dashes(2)),
        ("3 slabs, measured", Origin::Measured, Pace::Here, Some(3), Look::Marks(Mark::Square, 3)),
    ];
    let series = |value: &dyn Fn(&Run) -> f64| -> Vec<Series> {
        let of = kinds.iter().map(|(name, origin, pace, slabs, look)| {
            let runs = runs_of_kind(study, *origin, *pace, *slabs);
            line(*name, *look, runs.iter().map(|r| (f64::from(r.nodes), value(r))).collect())
        });
        of.filter(|s| !s.points.is_empty()).collect()
    };
    let ticks = Some(NODES.map(f64::from).to_vec());
    let note = "one node's time is 1; the master counts as a node";
    let mut a = series(&|r| r.speed_up);
    if a.is_empty() {
        return;
    }
    a.insert(0, line("as many times as nodes", Look::Guide, vec![(0.0, 0.0), (most, most)]));
    let [(_, head), (_, skull)] = paper::RATIOS_16;
    let mut numbers: Vec<(f64, f64)> =
        paper::SPEED_UPS.iter().map(|(n, s)| (f64::from(*n), *s)).collect();
    let mut ratios: Vec<(f64, f64)> = numbers.iter().map(|(n, s)| (*n, s / n)).collect();
    numbers.push((most, head * most));
    ratios.push((most, head));
    a.push(line("paper, head", Look::Paper, numbers));
    a.push(line("paper, skull", Look::Marks(Mark::Triangle, 4), vec![(most, skull * most)]));
    all.push(Chart {
        stem: "figure7a",
        says:
            "Figure 7a: how many times faster than one node; regions are slabcast's own schedule, \
               which has no barriers."
                .into(),
        picture: Picture::Plot(Plot {
            title: "Figure 7a: speed-up over nodes".into(),
            about: about(study, note),
            x: even("nodes"),
            y: even("times as fast as one node"),
            x_ticks: ticks.clone(),
            series: a,
        }),
    });
    let mut b = series(&|r| r.ratio);
    b.push(line("paper, head", Look::Paper, ratios));
    b.push(line("paper, skull", Look::Marks(Mark::Triangle, 4), vec![(most, skull)]));
    all.push(Chart {
        stem: "figure7b",
        says: "Figure 7b: the same over the number of nodes; 1 would be no loss, and the master alone \
               costs a third of three nodes."
            .into(),
        picture: Picture::Plot(Plot {
            title: "Figure 7b: speed-up over the number of nodes".into(),
            about: about(study, note),
            x: even("nodes"),
            y: even("speed-up / nodes"),
            x_ticks: ticks,
            series: b,
        }),
    });
}
