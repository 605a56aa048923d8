//! A report as files and as text.

use super::chart::Chart;
use super::sweep::Group;
use super::{Line, Report, ReportArgs};
use crate::autotune::setting::{fraction, lower};
use crate::chart::{self, DARK, LIGHT};
use slabcast_session::fail::Fail;
use slabcast_session::output::{OutputFolder, write_atomic};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

const FILES: [&str; 6] =
    ["report.json", "report.csv", "report.svg", "report-dark.svg", "report.png", "report-dark.png"];

/// Refuses, before anything is measured, what could not be written.
/// The folder goes again if nothing comes into it.
pub(super) fn check(args: &ReportArgs) -> Result<OutputFolder, Fail> {
    let out = &args.out;
    let there = FILES.iter().map(|f| out.join(f)).find(|f| f.exists());
    if let (Some(file), false) = (there, args.force) {
        return Err(Fail::usage(format!(
            "-o {}: {} is there already; give --force to replace it, or another folder",
            out.display(),
            file.file_name().unwrap_or_default().to_string_lossy()
        )));
    }
    OutputFolder::new(out)
}

/// Writes all files.
pub(super) fn files(out: &Path, report: &Report) -> Result<(), Fail> {
    let text =
        |name: &str, text: &str| write_atomic(&out.join(name), |f| f.write_all(text.as_bytes()));
    text("report.json", &json(report))?;
    text("report.csv", &csv(report))?;
    for (name, theme) in [("report", &LIGHT), ("report-dark", &DARK)] {
        chart::save(&Chart(report), theme, (out, name))?;
    }
    Ok(())
}

/// Returns the report as JSON.
pub(super) fn json(report: &Report) -> String {
    serde_json::to_string_pretty(report).unwrap_or_default() + "\n"
}

const COLUMNS: &str = "name,group,thickness,eps,kernel,std,radius,compositing,sums,shaded,shrink,tile,\
slabs,threads,rmse,max,most_999,share_above_1,rmse_srgb8,own_rmse,ms_one,ms_one_min,ms_one_max,ms_all,\
ms_all_min,ms_all_max,tossed,splatted,culled,pixels,bytes,front,knee,default,pixels_sha256\n";

/// A line a setting. Names have commas and are quoted; nothing else has or needs it.
fn csv(report: &Report) -> String {
    let mut out = COLUMNS.to_string();
    for l in &report.settings {
        let q = &l.setting.quality;
        let own = l.own_error.map(|e| e.rmse.to_string()).unwrap_or_default();
        let one = l.ms.one.map_or([String::new(), String::new(), String::new()], |t| {
            [t.median, t.min, t.max].map(|ms| format!("{ms:.3}"))
        });
        let all = [l.ms.all.median, l.ms.all.min, l.ms.all.max].map(|ms| format!("{ms:.3}"));
        let e = &l.error;
        let _ = writeln!(
            out,
            "\"{}\",{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},\
             {},{},{},{},{},{},{}",
            l.name,
            lower(&l.group),
            q.thickness,
            q.eps,
            lower(&q.kernel),
            q.std,
            q.radius,
            lower(&q.compositing),
            lower(&l.sums),
            l.setting.shaded,
            l.setting.shrink,
            l.work.tile,
            l.work.slabs,
            l.work.threads,
            e.rmse,
            e.max,
            e.most_999,
            e.share_above_1,
            e.rmse_srgb8,
            own,
            one[0],
            one[1],
            one[2],
            all[0],
            all[1],
            all[2],
            l.voxels.tossed,
            l.voxels.splatted,
            l.voxels.culled,
            l.pixels,
            l.bytes,
            l.front,
            l.knee,
            l.default,
            l.pixels_sha256
        );
    }
    out
}

/// The front, what was asked for, and what work does: for people.
pub(super) fn text(report: &Report, out: &Path) -> String {
    let mut text = format!(
        "{}, {}, {}x{}: {} settings, {} pixels of view{} {} judged\n\n",
        report.volume,
        report.tf,
        report.size[0],
        report.size[1],
        report.settings.len(),
        report.pixels,
        if report.judged_views.len() == 1 { "" } else { "s" },
        report.judged_views.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")
    );
    let threads = report.machine.threads;
    let _ = writeln!(
        text,
        "{:>9} {:>9}  {:>9} {:>9} {:>9}  setting: the front, from fast to slow",
        "ms, 1 thr",
        format!("{threads} thr"),
        "RMSE",
        "99.9 %",
        "max"
    );
    let row = |l: &Line, mark: &str| {
        format!(
            "{:>9} {:>9}  {:>9} {:>9} {:>9}  {}{mark}\n",
            l.ms.one.map_or_else(|| "-".into(), |t| ms(t.median)),
            ms(l.ms.all.median),
            error(l.error.rmse),
            error(l.error.most_999),
            error(l.error.max),
            l.name
        )
    };
    for l in report.front() {
        let mark = match (l.knee, l.default) {
            (true, true) => "  <- the knee, and what was asked for",
            (true, false) => "  <- the knee",
            (false, true) => "  <- what was asked for",
            (false, false) => "",
        };
        text += &row(l, mark);
    }
    if let Some(l) = report.default().filter(|l| !l.front) {
        text += "beaten by it\n";
        text += &row(l, "");
    }
    let work: Vec<&Line> = report.settings.iter().filter(|l| l.group == Group::Work).collect();
    if let (Some(default), false) = (report.default(), work.is_empty()) {
        let same = work.iter().all(|l| l.pixels_sha256 == default.pixels_sha256);
        let each: Vec<String> =
            work.iter().map(|l| format!("{} {}", l.name, ms(l.ms.all.median))).collect();
        let _ = writeln!(
            text,
            "\nwork, in ms ({}): {}",
            if same { "all the same picture, to the bit" } else { "PICTURES DIFFER" },
            each.join("; ")
        );
    }
    if !report.skipped.is_empty() {
        let _ = writeln!(
            text,
            "\nnot drawn, since thinner sheets bought nothing any more: {}",
            report.skipped.join("; ")
        );
    }
    let knee = report.settings.iter().find(|l| l.knee);
    if let Some(l) = knee.filter(|l| !l.flags.is_empty()) {
        let _ = writeln!(text, "\nto draw at the knee: {}", l.flags);
    }
    let _ = writeln!(
        text,
        "\nErrors in 1/255 against the limit (eps {} as asked). Charts and tables: {}",
        fraction(report.default().map_or(0.0, |l| l.setting.quality.eps)),
        FILES.map(|f| out.join(f).display().to_string()).join(", ")
    );
    text
}

fn ms(x: f64) -> String {
    if x < 10.0 { format!("{x:.2}") } else { format!("{x:.1}") }
}

fn error(x: f64) -> String {
    if x < 0.01 { format!("{x:.5}") } else { format!("{x:.3}") }
}
