//! A study as one self-contained page: no network, no script, no font.
//!
//! `maud` writes it and escapes every text, file names too. Charts are embedded as SVG, once for a
//! light and once for a dark background; the system of the reader chooses.

use super::Study;
use super::charts::Chart;
use super::parts::{self, ms};
use maud::{DOCTYPE, Markup, PreEscaped, html};

const STYLE: &str = "
:root { color-scheme: light dark; --ground: #fdfdfa; --ink: #202226; --faint: #5c5f66; --grid: #dcdcd4;
  --yes: #0a6b4d; --partly: #7a5c00; --no: #a83a00; --soft: #f1f1ea; }
@media (prefers-color-scheme: dark) { :root { --ground: #181a1e; --ink: #ecece8; --faint: #a6a8ae;
  --grid: #383b42; --yes: #5fd3a6; --partly: #ebd750; --no: #f0a060; --soft: #22252b; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 1.2rem 1rem 4rem; background: var(--ground);
  color: var(--ink); font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: .4rem 0; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 .4rem; border-top: 1px solid var(--grid); padding-top: 1.2rem; }
p, dl { max-width: 46rem; margin: .6rem 0; }
code { overflow-wrap: anywhere; background: var(--soft); padding: .1rem .3rem; border-radius: 3px; }
.faint { color: var(--faint); }
.wide { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: .92rem; }
caption { text-align: left; color: var(--faint); padding-bottom: .3rem; }
th, td { text-align: left; vertical-align: top; padding: .3rem .7rem .3rem 0;
  border-bottom: 1px solid var(--grid); }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.sentences td { min-width: 9rem; }
.yes { color: var(--yes); } .partly { color: var(--partly); } .no { color: var(--no); }
.yes, .partly, .no { font-weight: 600; white-space: nowrap; }
@media (max-width: 44rem) { .sentences thead { display: none; }
  .sentences tr { display: block; padding: .6rem 0; border-bottom: 1px solid var(--grid); }
  .sentences td { display: block; border: 0; padding: .1rem 0; }
  .sentences td[data-is]::before { content: attr(data-is); color: var(--faint); } }
tr.paper td { background: var(--soft); }
figure { margin: 1.2rem 0; }
figure svg { display: block; width: 100%; min-width: 36rem; height: auto; }
figcaption { max-width: 46rem; color: var(--faint); font-size: .95rem; margin-top: .4rem; }
.dark { display: none; }
@media (prefers-color-scheme: dark) { .dark { display: block; } .light { display: none; } }
dt { font-weight: 600; } dd { margin: 0 0 .5rem; }
";

/// Returns the whole page. Each chart has its SVG for a light and for a dark background.
pub(super) fn page(study: &Study, charts: &[(Chart, [String; 2])]) -> String {
    let [w, h] = study.size;
    let figure = |stem: &str| {
        let found = charts.iter().find(|c| c.0.stem == stem);
        html! { @if let Some((chart, svgs)) = found { (picture(chart, svgs)) } }
    };
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { "The paper's evaluation of " (study.volume) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { "The paper's evaluation, of " (study.volume) }
                p { code { (study.command) } }
                p {
                    (study.tf) ", " (study.views) " views of " (w) "x" (h) ", " (study.kernel)
                    ". slabcast " (study.slabcast) " on " (study.machine.cpu) ", " (study.machine.cores)
                    " cores (" (study.machine.simd) "). Simulated links of " (study.link) ", "
                    (study.latency_us) " us one way."
                }
                @if !study.complete { p.no { "Stopped early: parts are missing." } }
                (introduction(study))
                h2 { "What the paper says, and whether it holds here" }
                (parts::sentences(study))
                h2 { "Table 1: size of macrotiles" }
                (parts::table_1(study))
                h2 { "Figure 1: estimated and measured order" }
                (figure("figure1a")) (figure("figure1b"))
                (parts::order(study))
                h2 { "Figure 3: where a view's time goes" }
                (figure("figure3"))
                (parts::shares(study))
                h2 { "Figure 4: data and messages" }
                (figure("figure4a")) (figure("figure4b")) (figure("figure4c"))
                (parts::data(study))
                h2 { "Figure 5: time of each view" }
                (figure("figure5a")) (figure("figure5b"))
                p.faint {
                    "The paper has curves and no numbers, but for 1.5 s a view of the head on 16 nodes \
                     (section 1)."
                }
                h2 { "Figure 7: speed-up" }
                (figure("figure7a")) (figure("figure7b"))
                (parts::speed(study))
                h2 { "Section 5.1: bricks, kernels, pictures" }
                (parts::effects(study))
                h2 { "Words" }
                (words(study))
                @if !study.left_out.is_empty() {
                    h2 { "What is not here" }
                    ul { @for what in &study.left_out { li { (what) } } }
                }
            }
        }
    };
    page.into_string()
}

fn picture(chart: &Chart, [light, dark]: &[String; 2]) -> Markup {
    html! {
        figure {
            div.wide role="img" aria-label=(chart.says) tabindex="0" {
                div.light { (PreEscaped(light)) }
                div.dark { (PreEscaped(dark)) }
            }
            figcaption { (chart.says) }
        }
    }
}

fn introduction(study: &Study) -> Markup {
    html! {
        p {
            "The paper (Huang, Shareef, Crawfis, Sadayappan, Mueller: " i {
                "A Parallel Splatting Algorithm With Occlusion Culling"
            } ", 2000) rendered the UNC head on up to 16 Pentium II of 300 MHz. This page does its \
            evaluation again with another volume, its schedule (slab after slab, slabs of equal \
            thickness, broadcast of what is not hidden) and slabcast's renderer."
        }
        p {
            b { "Measured" } " is what was drawn or run on this machine. " b { "Predicted" }
            " is slabcast's own scheduler against virtual nodes and links, with the measured time of \
             every macrotile. " b { "Paper" } " is what the paper's text and table state; its curves \
             without numbers are not read off."
        }
        p {
            "One core here takes " (ms(study.alone_ms)) " ms for a view, the paper's node 17 s. " b {
                "At the paper's pace"
            } " all macrotiles take " (format!("{:.0}", study.stretch)) " times as long as they did \
            here, so that drawing and links are to each other about as they were; " b { "at this pace" }
            " they take what they took. What messages cost a processor stays that of today."
        }
    }
}

fn words(study: &Study) -> Markup {
    html! {
        dl {
            dt { "Node" } dd { "A machine. One is the master, which decides and sends; the others render." }
            dt { "Slab" } dd { "A part of the depth of a view. All nodes finish one before the next begins: the barrier." }
            dt { "Macrotile" } dd { "A square of the picture in one slab: what a node is given to render." }
            dt { "Brick" } dd { "A cube of 8x8x8 voxels, of which only those that can be seen are kept." }
            dt { "Broadcast" } dd { "Bricks on their way. The paper sends them to all nodes at once; slabcast sends each node what it lacks." }
            dt { "Wait" } dd { "A node has no macrotile and gets none any more in this slab, or the master prepares the next one." }
            dt { "Region" } dd { "A square of the picture through all depths: slabcast's own schedule, without slabs and barriers." }
            dt { "Speed-up" } dd { "The time of one core (" (ms(study.alone_ms)) " ms here, in the best of three cuts) over that of a cluster." }
        }
    }
}
