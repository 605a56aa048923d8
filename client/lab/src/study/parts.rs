//! The tables of a study's page, each with the numbers of the paper.

use super::Study;
use super::paper::{self, NODES};
use super::runs::{Origin, Run};
use super::simulate::Pace;
use super::verdict::{Holds, percent};
use maud::{Markup, html};

fn word(holds: Holds) -> Markup {
    let class = match holds {
        Holds::Yes => "yes",
        Holds::Partly => "partly",
        Holds::No => "no",
        Holds::Unjudged => "faint",
    };
    html! { span class=(class) { (holds.word()) } }
}

/// Returns the verdicts on the paper's sentences.
pub(super) fn sentences(study: &Study) -> Markup {
    html! {
        div.wide {
            table.sentences {
                caption { "Judged by rules that are the same for every volume; the paper's numbers are of the head." }
                thead { tr { th { "" } th { "Where" } th { "Paper" } th { "Here" } th { "Rule for \"holds\"" } } }
                tbody {
                    @for v in &study.verdicts {
                        tr {
                            td { (word(v.holds)) } td { (v.place) } td data-is="Paper: " { (v.paper) }
                            td data-is="Here: " { (v.here) } td.faint data-is="Rule: " { (v.rule) }
                        }
                    }
                }
            }
        }
    }
}

/// Returns Table 1.
pub(super) fn table_1(study: &Study) -> Markup {
    html! {
        div.wide {
            table {
                caption { "15 rendering nodes, three slabs, mean of the views but the first; seconds at the paper's pace." }
                thead {
                    tr {
                        th { "Macrotiles, pixels" } th { "Origin" } th.n { "Summed rendering" }
                        th.n { "Longest wait" } th.n { "A node" } th.n { "View" } th.n { "Drawn here, ms" }
                    }
                }
                tbody {
                    @for (t, p) in study.table_1.iter().zip(&study.table_1_of_the_paper) {
                        tr {
                            td { (t.edge) } td { "predicted" } td.n { (s(t.summed_s)) } td.n { (s(t.max_wait_s)) }
                            td.n { (s(t.a_node_s)) } td.n { (s(t.frame_s)) } td.n { (ms(t.drawn_here_ms)) }
                        }
                        tr.paper {
                            td { (p.edge) } td { "paper" } @for text in p.printed { td.n { (text) } }
                            td.n { "" } td.n { "" }
                        }
                    }
                }
            }
        }
        p.faint {
            "64/32: each node's first macrotile of a slab has 64 pixels, those left in the queue are cut in \
             quarters. \"A node\" is the sum over 15 and the longest wait, which is what the paper's third \
             line comes to (16.6 / 15 + 0.28 = 1.39). Rendering includes the tables that each node makes \
             for a view."
        }
    }
}

/// Returns the numbers of Figure 1.
pub(super) fn order(study: &Study) -> Markup {
    html! {
        @if let Some(o) = &study.figure_1 {
            p {
                "Rank correlation (Spearman; 1 is the same order) of the estimate and the measured time: "
                (r(o.estimate)) " in this view, " (r(o.estimate_open)) " over the macrotiles that are not \
                wholly covered, " (r(o.estimate_all_views)) " over all views. The time of the same \
                macrotile in the view before, by which slabcast's regions are estimated: "
                (r(o.learned_all_views)) ". Paper: 38 macrotiles, of which the first 16 are wholly covered; \
                it gives no correlation."
            }
        }
    }
}

/// Returns the numbers of Figure 3.
pub(super) fn shares(study: &Study) -> Markup {
    html! {
        div.wide {
            table {
                caption { "Parts of all rendering nodes' time, mean of the views but the first." }
                thead { tr { th { "Nodes" } th { "Origin" } th.n { "Rendering" } th.n { "Messages, bricks" } th.n { "Waiting" } } }
                tbody {
                    @for b in &study.figure_3 {
                        tr {
                            td { (b.nodes) } td { "predicted" }
                            @for part in b.shares { td.n { (percent(part)) } }
                        }
                    }
                    tr.paper { td { "16" } td { "paper" } td.n { "" } td.n { "about 5 %" } td.n { "15 % to 20 %" } }
                    tr.paper { td { "5" } td { "paper" } td.n { "over 90 %" } td.n { "about 5 %" } td.n { "" } }
                }
            }
        }
    }
}

/// Returns the numbers of Figure 4.
pub(super) fn data(study: &Study) -> Markup {
    html! {
        div.wide {
            table {
                caption { "Of views but the first, where not said otherwise; KB as slabcast encodes bricks." }
                thead {
                    tr {
                        th { "Slabs" } th { "Origin" } th.n { "Needed of all voxels" } th.n { "At 16 bytes, MB" }
                        th.n { "First view, KB a node" } th.n { "Later" } th.n { "Of the needed" } th.n { "Of all" }
                    }
                }
                tbody {
                    @for d in &study.figure_4 {
                        tr {
                            td { (d.slabs) } td { "predicted" }
                            td.n { (percent(d.needed[0])) " to " (percent(d.needed[1])) }
                            td.n { (s(d.needed_paper_mb[0])) " to " (s(d.needed_paper_mb[1])) }
                            td.n { (format!("{:.0}", d.first_kb)) } td.n { (format!("{:.0}", d.later_kb)) }
                            td.n { (percent(d.later_of_needed)) } td.n { (percent(d.later_of_all)) }
                        }
                    }
                    tr.paper {
                        td { "3, 5" } td { "paper" } td.n { "15 % to 18 %" } td.n { "12 to 14" } td.n { "" }
                        td.n { "400 to 600" } td.n { "about 6 %" } td.n { "about 1 %" }
                    }
                }
            }
        }
    }
}

/// Returns the numbers of Figure 7, and the real runs.
pub(super) fn speed(study: &Study) -> Markup {
    let kinds = [
        ("3 slabs", Some(3), Pace::Paper),
        ("5 slabs", Some(5), Pace::Paper),
        ("regions", None, Pace::Paper),
        ("3 slabs", Some(3), Pace::Here),
        ("5 slabs", Some(5), Pace::Here),
        ("regions", None, Pace::Here),
    ];
    let at = |slabs: Option<u32>, pace: Pace, nodes: u32| {
        let of = |r: &&Run| r.is(Origin::Predicted, pace, slabs) && r.nodes == nodes;
        study.runs.iter().find(of)
    };
    let cell = |r: Option<&Run>| {
        r.map_or(String::new(), |r| format!("{:.1} ({})", r.speed_up, percent(r.ratio)))
    };
    html! {
        div.wide {
            table {
                caption { "Times as fast as one node, and that over the number of nodes." }
                thead {
                    tr { th { "" } th { "Origin" } @for n in NODES { th.n { (n) " nodes" } } }
                }
                tbody {
                    @for (name, slabs, pace) in kinds {
                        tr {
                            td { (name) @if pace == Pace::Here { ", this pace" } }
                            td { "predicted" }
                            @for n in NODES { td.n { (cell(at(slabs, pace, n))) } }
                        }
                    }
                    tr.paper {
                        td { "head, 3 slabs" } td { "paper" } td.n { "2.5" } td.n { "4.4" } td.n { "" } td.n { "" }
                        td.n { "about 67 %" }
                    }
                    tr.paper {
                        td { "skull, 3 slabs" } td { "paper" } td.n { "" } td.n { "" } td.n { "" } td.n { "" }
                        td.n { "around 63 %" }
                    }
                }
            }
        }
        (live(study))
    }
}

fn live(study: &Study) -> Markup {
    let runs: Vec<&Run> = study.runs.iter().filter(|r| r.origin == Origin::Measured).collect();
    let beside = |run: &Run| {
        let of = |r: &&Run| r.is(Origin::Predicted, Pace::Here, run.slabs) && r.nodes == run.nodes;
        study.runs.iter().find(of).map(|r| ms(r.frame_ms)).unwrap_or_default()
    };
    html! {
        @if !runs.is_empty() {
            div.wide {
                table {
                    caption {
                        "Real runs in one process on " (study.machine.cores) " cores, the master's own work \
                         among theirs, bricks shared; beside them the same cluster simulated, with a machine \
                         and links for each node. ms a view."
                    }
                    thead { tr { th { "Rendering nodes" } th { "" } th.n { "Measured" } th.n { "Predicted" } th.n { "Speed-up, measured" } } }
                    tbody {
                        @for r in runs {
                            tr {
                                td { (r.nodes - 1) } td { (r.kind()) } td.n { (ms(r.frame_ms)) }
                                td.n { (beside(r)) } td.n { (s(r.speed_up)) }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Returns the effects of section 5.1: bricks, kernels, picture sizes, culling.
pub(super) fn effects(study: &Study) -> Markup {
    let e = &study.effects;
    html! {
        @if !e.bricks.is_empty() {
            div.wide {
                table {
                    caption { "Bricks of other sizes, counted in the middle view in three slabs; slabcast draws bricks of 8." }
                    thead {
                        tr {
                            th.n { "Edge, voxels" } th.n { "Bricks" } th.n { "Needed" } th.n { "Voxels in them" }
                            th.n { "MB at 16 bytes" } th.n { "Looked at, 64 pixels" } th.n { "32 pixels" }
                        }
                    }
                    tbody {
                        @for b in &e.bricks {
                            tr {
                                td.n { (b.edge) } td.n { (b.boxes) } td.n { (b.needed) }
                                td.n { (percent(b.needed_voxels)) } td.n { (s(b.needed_paper_mb)) }
                                td.n { (s(b.looked_at)) } td.n { (s(b.looked_at_32)) }
                            }
                        }
                    }
                }
            }
            p.faint {
                "Looked at: how often a voxel of a needed brick comes up, since its brick lies over several \
                 macrotiles or slabs. Larger bricks: less to manage, more to send and to look at."
            }
        }
        @let settings: Vec<_> = e.radii.iter().chain(&e.sizes).collect();
        @if !settings.is_empty() {
            div.wide {
                table {
                    caption { "Radius of the kernel in lattice steps, and size of the picture: drawn here; parts and speed-up on 15 rendering nodes in macrotiles of 64 pixels, predicted." }
                    thead {
                        tr {
                            th { "" } th.n { "Alone, ms" } th.n { "64 pixels, ms" } th.n { "32 pixels, ms" }
                            th.n { "Rendering" } th.n { "Messages" } th.n { "Waiting" } th.n { "Speed-up" }
                        }
                    }
                    tbody {
                        @for x in settings {
                            tr {
                                td { (x.name) } td.n { (ms(x.alone_ms)) } td.n { (ms(x.tiles_ms[0])) }
                                td.n { (ms(x.tiles_ms[1])) }
                                @for part in x.shares { td.n { (percent(part)) } }
                                td.n { (s(x.speed_up)) }
                            }
                        }
                    }
                }
            }
        }
        @if let Some(c) = &e.culling {
            p {
                "Culling on one core, measured: " (ms(c.with_ms)) " ms with, " (ms(c.without_ms)) " ms without. \
                Paper: " (paper::ALONE_S) " and " (paper::ALONE_UNCULLED_S) " s for the head."
            }
        }
    }
}

/// Formats a time in ms.
pub(super) fn ms(x: f64) -> String {
    if x < 10.0 { format!("{x:.2}") } else { format!("{x:.1}") }
}

fn s(x: f64) -> String {
    format!("{x:.2}")
}

fn r(x: f64) -> String {
    format!("{x:.2}")
}
