//! Writes a study as files and as text.

use super::charts::{Chart, charts};
use super::paper;
use super::runs::Origin;
use super::simulate::Pace;
use super::tables::tables;
use super::verdict::Holds;
use super::{Study, StudyArgs, page};
use crate::chart::{self, DARK, LIGHT};
use slabcast_session::direct::map_parallel;
use slabcast_session::fail::Fail;
use slabcast_session::output::write_atomic;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

const PAGE: &str = "index.html";
const JSON: &str = "study.json";

/// Refuses to overwrite an earlier study without `--force`, before anything is measured.
pub(super) fn check(args: &StudyArgs) -> Result<(), Fail> {
    let out = &args.out;
    match [PAGE, JSON].into_iter().find(|f| out.join(f).exists()) {
        Some(file) if !args.force => Err(Fail::usage(format!(
            "-o {}: {file} is there already; give --force to replace it, or another folder",
            out.display()
        ))),
        _ => Ok(()),
    }
}

/// Returns the command line as it was typed, quoted for a shell.
pub(super) fn command() -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_=./:,%+@".contains(c);
    let word = |w: std::ffi::OsString| {
        let w = w.to_string_lossy().into_owned();
        if !w.is_empty() && w.chars().all(plain) {
            w
        } else {
            format!("'{}'", w.replace('\'', "'\\''"))
        }
    };
    let words = std::env::args_os().skip(1).map(word);
    std::iter::once("slabcast".to_string()).chain(words).collect::<Vec<_>>().join(" ")
}

/// Writes all files, the page last.
pub(super) fn files(out: &Path, study: &Study) -> Result<(), Fail> {
    let text =
        |name: &str, text: &str| write_atomic(&out.join(name), |f| f.write_all(text.as_bytes()));
    let drawn = |e: String| Fail::failed(format!("a chart can't be drawn: {e}"));
    text(JSON, &json(study))?;
    for (name, table) in tables(study) {
        text(&format!("{name}.csv"), &table.csv())?;
    }
    let charts = charts(study);
    let one = |chart: &Chart, theme, end: &str| {
        let svg = chart.svg(theme).map_err(drawn)?;
        text(&format!("{}{end}.svg", chart.stem), &svg)?;
        let pixels = chart.pixels(theme).map_err(drawn)?;
        let png = out.join(format!("{}{end}.png", chart.stem));
        write_atomic(&png, |f| chart::write_png(&pixels, f))?;
        Ok::<String, Fail>(svg)
    };
    let both = |i: usize, _: &mut ()| {
        Ok::<_, Fail>([one(&charts[i], &LIGHT, "")?, one(&charts[i], &DARK, "-dark")?])
    };
    let svgs = map_parallel(charts.len(), study.machine.cores, both);
    let svgs = svgs.into_iter().collect::<Result<Vec<_>, Fail>>()?;
    let all: Vec<(Chart, [String; 2])> = charts.into_iter().zip(svgs).collect();
    text(PAGE, &page::page(study, &all))
}

/// Returns the study as JSON.
pub(super) fn json(study: &Study) -> String {
    serde_json::to_string_pretty(study).unwrap_or_default() + "\n"
}

/// Returns a summary: Table 1, speed-ups, verdicts, and the path of the page.
pub(super) fn text(study: &Study, out: &Path) -> String {
    let [w, h] = study.size;
    let mut text = format!(
        "{}, {}, {} views of {w}x{h}; one core here takes {:.1} ms a view, the paper's 17 s are {:.0} \
         times that\n\n",
        study.volume, study.tf, study.views, study.alone_ms, study.stretch
    );
    let _ = writeln!(
        text,
        "Table 1: 15 rendering nodes, 3 slabs, seconds at the paper's pace (predicted | paper)\n{:>7} \
         {:>17} {:>15} {:>15}",
        "pixels", "summed rendering", "longest wait", "a node"
    );
    for (t, p) in study.table_1.iter().zip(&study.table_1_of_the_paper) {
        let _ = writeln!(
            text,
            "{:>7} {:>8.2} | {:>6} {:>6.2} | {:>6} {:>6.2} | {:>6}",
            t.edge, t.summed_s, p.printed[0], t.max_wait_s, p.printed[1], t.a_node_s, p.printed[2]
        );
    }
    let _ = writeln!(
        text,
        "\nSpeed-up over one node (3 slabs, 5 slabs, regions: predicted at the paper's pace)"
    );
    for nodes in paper::NODES {
        let of = |slabs: Option<u32>| {
            let of =
                |r: &&super::Run| r.is(Origin::Predicted, Pace::Paper, slabs) && r.nodes == nodes;
            study.runs.iter().find(of).map_or("-".into(), |r| format!("{:.2}", r.speed_up))
        };
        let _ = writeln!(
            text,
            "{nodes:>7} nodes {:>8} {:>8} {:>8}",
            of(Some(3)),
            of(Some(5)),
            of(None)
        );
    }
    for r in study.runs.iter().filter(|r| r.origin == Origin::Measured) {
        let _ = writeln!(
            text,
            "{:>7} nodes measured here, {}: {:.1} ms a view, {:.2} times",
            r.nodes,
            r.kind(),
            r.frame_ms,
            r.speed_up
        );
    }
    text += "\nThe paper's sentences\n";
    for v in &study.verdicts {
        let _ =
            writeln!(text, "{:>13}  {}: {}\n{:15}{}", v.holds.word(), v.place, v.paper, "", v.here);
    }
    let held = |h: Holds| study.verdicts.iter().filter(|v| v.holds == h).count();
    let _ = writeln!(
        text,
        "\n{} hold, {} partly, {} do not. All of it: {}",
        held(Holds::Yes),
        held(Holds::Partly),
        held(Holds::No),
        out.join(PAGE).display()
    );
    text
}
