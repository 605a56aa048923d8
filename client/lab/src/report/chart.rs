//! The chart of a report: error against frame time, one mark a setting, the front as a line.

use super::sweep::Group;
use super::{Line, Report};
use crate::chart::{self, Anchor, Box2, Draw, LogAxis, Mark, Sheet, Theme, tick};
use plotters::prelude::DrawingBackend;

const SIZE: (u32, u32) = (1080, 700);
/// The plot area between the axes, in pixels.
const PLOT_AREA: Box2 = Box2 { x0: 78.0, y0: 76.0, x1: 876.0, y1: 634.0 };

/// Label, mark and colour index of each knob, in the order of the legend.
const KINDS: [(Group, &str, Mark, usize); 8] = [
    (Group::Thickness, "thickness", Mark::Dot, 0),
    (Group::Eps, "eps", Mark::Triangle, 1),
    (Group::Sums, "sums", Mark::Square, 2),
    (Group::Size, "size, magnified", Mark::Dot, 3),
    (Group::Kernel, "kernel", Mark::Triangle, 4),
    (Group::Compositing, "compositing", Mark::Square, 5),
    (Group::Shading, "no light", Mark::Cross, 6),
    (Group::Combinations, "combinations", Mark::Dot, 7),
];

/// Chart of error against time.
pub(super) struct Chart<'a>(pub(super) &'a Report);

impl Chart<'_> {
    fn lines(&self) -> impl Iterator<Item = &Line> {
        self.0.settings.iter().filter(|l| l.group != Group::Work)
    }
}

impl Draw for Chart<'_> {
    fn size(&self) -> (u32, u32) {
        SIZE
    }

    fn draw<DB: DrawingBackend>(
        &self,
        on: &Sheet<'_, DB>,
        theme: &Theme,
    ) -> Result<(), Box<dyn std::error::Error + Send + Sync>>
    where
        DB::ErrorType: 'static,
    {
        let report = self.0;
        let [w, h] = report.size;
        let threads = report.machine.threads;
        let title = format!("{}, {}: error against run time", report.volume, report.tf);
        on.text(&title, (22.0, 32.0), 18.0, Anchor::Left, theme.ink)?;
        let about = format!(
            "{w}x{h}, {threads} thread{} of {} ({}); {} pixels of {} view{} judged by the \
             reference{}",
            if threads == 1 { "" } else { "s" },
            report.machine.cpu,
            report.machine.simd,
            report.pixels,
            report.judged_views.len(),
            if report.judged_views.len() == 1 { "" } else { "s" },
            if report.complete { "" } else { "; STOPPED EARLY" }
        );
        on.text(&about, (22.0, 54.0), 12.0, Anchor::Left, theme.faint)?;

        let x = LogAxis::over(self.lines().map(|l| l.ms.all.median));
        let y = LogAxis::over(self.lines().map(|l| l.error.rmse));
        let position = |l: &Line| {
            let (tx, ty) = (x.position(l.ms.all.median), y.position(l.error.rmse));
            (
                PLOT_AREA.x0 + tx * (PLOT_AREA.x1 - PLOT_AREA.x0),
                PLOT_AREA.y1 - ty * (PLOT_AREA.y1 - PLOT_AREA.y0),
            )
        };
        for &t in &x.ticks {
            let px = PLOT_AREA.x0 + x.position(t) * (PLOT_AREA.x1 - PLOT_AREA.x0);
            on.line(&[(px, PLOT_AREA.y0), (px, PLOT_AREA.y1)], 1.0, theme.grid)?;
            on.text(&tick(t), (px, PLOT_AREA.y1 + 18.0), 12.0, Anchor::Middle, theme.ink)?;
        }
        for &t in &y.ticks {
            let py = PLOT_AREA.y1 - y.position(t) * (PLOT_AREA.y1 - PLOT_AREA.y0);
            on.line(&[(PLOT_AREA.x0, py), (PLOT_AREA.x1, py)], 1.0, theme.grid)?;
            on.text(&tick(t), (PLOT_AREA.x0 - 8.0, py + 4.0), 12.0, Anchor::Right, theme.ink)?;
        }
        on.axes(&PLOT_AREA, theme.ink)?;
        let middle = ((PLOT_AREA.x0 + PLOT_AREA.x1) / 2.0, (PLOT_AREA.y0 + PLOT_AREA.y1) / 2.0);
        on.text(
            "ms a frame (median), less is better",
            (middle.0, PLOT_AREA.y1 + 44.0),
            13.0,
            Anchor::Middle,
            theme.ink,
        )?;
        let down = "RMSE against the limit in 1/255, less is better";
        on.upwards(down, (22.0, middle.1), 13.0, theme.ink)?;

        let front = report.front();
        for pair in front.windows(2) {
            on.line(&[position(pair[0]), position(pair[1])], 2.0, theme.ink)?;
        }
        let mut taken: Vec<Box2> = self.lines().map(|l| Box2::about(position(l), 4.5)).collect();
        for l in self.lines() {
            let Some((_, _, mark, colour)) = KINDS.iter().find(|k| k.0 == l.group) else {
                continue;
            };
            on.mark(*mark, position(l), if l.front { 5.0 } else { 3.6 }, theme.colours[*colour])?;
        }
        // Labels avoid the front's line, too.
        for pair in front.windows(2) {
            let (a, b) = (position(pair[0]), position(pair[1]));
            let n = (libm::hypot(b.0 - a.0, b.1 - a.1) / 6.0).ceil().max(1.0) as usize;
            for i in 0..=n {
                let t = i as f64 / n as f64;
                taken.push(Box2::about((a.0 + (b.0 - a.0) * t, a.1 + (b.1 - a.1) * t), 3.0));
            }
        }
        if let Some(knee) = front.iter().find(|l| l.knee) {
            on.ring(position(knee), 10.0, theme.ink)?;
            taken.push(Box2::about(position(knee), 11.0));
        }
        if let Some(l) = report.default() {
            on.mark(Mark::Diamond, position(l), 7.5, theme.ground)?;
            on.mark(Mark::Diamond, position(l), 6.0, theme.ink)?;
            taken.push(Box2::about(position(l), 8.0));
        }
        // The most important settings are labelled first; the table has those without room.
        let mut named: Vec<(&Line, String)> = Vec::new();
        if let Some(l) = report.default() {
            named.push((l, "as asked".into()));
        }
        for l in front.iter().filter(|l| l.knee) {
            named.push((l, format!("knee: {}", l.name)));
        }
        for l in front.iter().filter(|l| !l.knee && !l.default) {
            named.push((l, l.name.clone()));
        }
        for l in self.lines().filter(|l| !l.front && !l.default) {
            // Combinations would crowd out the labels of single knobs.
            if l.group != Group::Combinations {
                named.push((l, l.name.clone()));
            }
        }
        for (l, name) in named {
            let size = if l.front || l.default { 11.5 } else { 10.0 };
            let colour = if l.front || l.default { theme.ink } else { theme.faint };
            if let Some((place, own)) = chart::place(&name, size, position(l), &PLOT_AREA, &taken) {
                // A line ties a distant label to its point.
                let end = (place.0.max(own.x0).min(own.x1), (own.y0 + own.y1) / 2.0);
                let near = (end.0.max(position(l).0.min(own.x1)), end.1);
                let far = libm::hypot(near.0 - position(l).0, near.1 - position(l).1);
                if far > 22.0 {
                    on.line(&[position(l), near], 0.8, theme.faint)?;
                }
                on.text(&name, place, size, Anchor::Left, colour)?;
                taken.push(own);
            }
        }
        legend(self, on, theme)
    }
}

fn legend<DB: DrawingBackend>(
    chart: &Chart<'_>,
    on: &Sheet<'_, DB>,
    theme: &Theme,
) -> Result<(), Box<dyn std::error::Error + Send + Sync>>
where
    DB::ErrorType: 'static,
{
    let (x, mut y) = (PLOT_AREA.x1 + 26.0, PLOT_AREA.y0 + 12.0);
    let word =
        |text: &str, y: f64| on.text(text, (x + 24.0, y + 4.0), 12.0, Anchor::Left, theme.ink);
    on.mark(Mark::Diamond, (x + 8.0, y), 6.0, theme.ink)?;
    word("as asked", y)?;
    y += 24.0;
    on.line(&[(x - 2.0, y), (x + 18.0, y)], 2.0, theme.ink)?;
    word("front: none beats it", y)?;
    y += 24.0;
    on.ring((x + 8.0, y), 7.0, theme.ink)?;
    word("knee", y)?;
    y += 34.0;
    for (group, name, mark, colour) in KINDS {
        if chart.lines().any(|l| l.group == group) {
            on.mark(mark, (x + 8.0, y), 5.0, theme.colours[colour])?;
            word(name, y)?;
            y += 22.0;
        }
    }
    Ok(())
}
