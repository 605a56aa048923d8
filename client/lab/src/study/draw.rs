//! Draws the charts of the study: lines and points over two axes, and stacked bars.
//!
//! Measured points are filled marks without a line, predictions are lines, the numbers of the paper
//! are diamonds in the colour of the text, so that they differ without colour, too.

use crate::chart::{Anchor, Box2, Draw, LogAxis, Mark, Sheet, Theme, tick, width};
use plotters::prelude::DrawingBackend;
use plotters::style::RGBColor;

type Failed = Box<dyn std::error::Error + Send + Sync>;

/// Width and height of a chart of lines, in pixels.
const SIZE: (u32, u32) = (900, 500);
/// The plot area between the axes, in pixels.
const PLOT_AREA: Box2 = Box2 { x0: 78.0, y0: 78.0, x1: 650.0, y1: 436.0 };

/// Scale of an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Steps {
    /// Linear, from 0.
    Even,
    /// Logarithmic.
    Powers,
}

/// Style of a series.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Look {
    /// A line with small dots, and the index of its colour.
    Line(usize),
    /// A dashed line with small dots, and the index of its colour.
    Dashes(usize),
    /// Marks without a line, and the index of their colour.
    Marks(Mark, usize),
    /// Numbers of the paper.
    Paper,
    /// A thin line to compare with.
    Guide,
}

/// One series of a chart.
#[derive(Clone, Debug)]
pub(super) struct Series {
    pub(super) name: String,
    pub(super) look: Look,
    pub(super) points: Vec<(f64, f64)>,
}

/// A chart of lines and points.
#[derive(Clone, Debug)]
pub(super) struct Plot {
    pub(super) title: String,
    pub(super) about: String,
    pub(super) x: (String, Steps),
    pub(super) y: (String, Steps),
    /// Positions of the ticks; `None` to choose them.
    pub(super) x_ticks: Option<Vec<f64>>,
    pub(super) series: Vec<Series>,
}

/// Maps the values of an axis to positions from 0 to 1.
enum Axis {
    Even { to: f64, ticks: Vec<f64> },
    Powers(LogAxis),
}

impl Axis {
    fn new(steps: Steps, values: impl Iterator<Item = f64> + Clone, ticks: Option<&[f64]>) -> Axis {
        if steps == Steps::Powers {
            return Axis::Powers(LogAxis::over(values));
        }
        let most = values.filter(|v| v.is_finite()).fold(0.0, f64::max).max(1e-9) * 1.04;
        let rough = most / 6.0;
        let power = libm::pow(10.0, libm::floor(libm::log10(rough)));
        let step = [1.0, 2.0, 2.5, 5.0, 10.0].map(|s| s * power);
        let step = step.into_iter().find(|s| *s >= rough).unwrap_or(10.0 * power);
        let found = || (0..).map(|i| f64::from(i) * step).take_while(|t| *t <= most).collect();
        Axis::Even { to: most, ticks: ticks.map_or_else(found, <[f64]>::to_vec) }
    }

    fn position(&self, value: f64) -> f64 {
        match self {
            Axis::Even { to, .. } => (value / to).clamp(0.0, 1.0),
            Axis::Powers(axis) => axis.position(value),
        }
    }

    fn ticks(&self) -> &[f64] {
        match self {
            Axis::Even { ticks, .. } => ticks,
            Axis::Powers(axis) => &axis.ticks,
        }
    }
}

/// Formats a number for an axis.
fn number(x: f64) -> String {
    if x == 0.0 || (x.fract().abs() < 1e-9 && x.abs() < 1e5) {
        return format!("{x:.0}");
    }
    if (0.1..1e5).contains(&x) {
        let text = format!("{x:.2}");
        return text.trim_end_matches('0').to_string();
    }
    tick(x)
}

fn heading<DB: DrawingBackend>(
    on: &Sheet<'_, DB>,
    theme: &Theme,
    title: &str,
    about: &str,
) -> Result<(), Failed>
where
    DB::ErrorType: 'static,
{
    on.text(&short(title, 18.0, 860.0), (22.0, 32.0), 18.0, Anchor::Left, theme.ink)?;
    on.text(&short(about, 12.0, 860.0), (22.0, 54.0), 12.0, Anchor::Left, theme.faint)
}

/// Cuts a text to fit a width in pixels.
fn short(text: &str, size: f64, wide: f64) -> String {
    if width(text, size) <= wide {
        return text.to_string();
    }
    let mut cut: String = text.to_string();
    while !cut.is_empty() && width(&format!("{cut}..."), size) > wide {
        cut.pop();
    }
    cut + "..."
}

fn dashes<DB: DrawingBackend>(
    on: &Sheet<'_, DB>,
    points: &[(f64, f64)],
    wide: f64,
    colour: RGBColor,
) -> Result<(), Failed>
where
    DB::ErrorType: 'static,
{
    const ON: f64 = 7.0;
    const OFF: f64 = 5.0;
    let mut far = 0.0;
    for pair in points.windows(2) {
        let (a, b) = (pair[0], pair[1]);
        let long = libm::hypot(b.0 - a.0, b.1 - a.1);
        let at = |s: f64| {
            let t = if long > 0.0 { s / long } else { 0.0 };
            (a.0 + (b.0 - a.0) * t, a.1 + (b.1 - a.1) * t)
        };
        let mut s = 0.0;
        while s < long {
            let phase = far % (ON + OFF);
            let left = if phase < ON { ON - phase } else { ON + OFF - phase };
            let end = (s + left).min(long);
            if phase < ON {
                on.line(&[at(s), at(end)], wide, colour)?;
            }
            far += (end - s).max(1e-6);
            s = end.max(s + 1e-6);
        }
    }
    Ok(())
}

impl Look {
    fn draw<DB: DrawingBackend>(
        self,
        on: &Sheet<'_, DB>,
        theme: &Theme,
        points: &[(f64, f64)],
    ) -> Result<(), Failed>
    where
        DB::ErrorType: 'static,
    {
        match self {
            Look::Line(c) | Look::Dashes(c) => {
                let colour = theme.colours[c % 8];
                match self {
                    Look::Line(_) => on.line(points, 2.0, colour)?,
                    _ => dashes(on, points, 2.0, colour)?,
                }
                points.iter().try_for_each(|p| on.mark(Mark::Dot, *p, 2.6, colour))
            }
            Look::Marks(mark, c) => {
                points.iter().try_for_each(|p| on.mark(mark, *p, 5.0, theme.colours[c % 8]))
            }
            Look::Paper => points.iter().try_for_each(|p| {
                on.mark(Mark::Diamond, *p, 7.5, theme.ground)?;
                on.mark(Mark::Diamond, *p, 6.0, theme.ink)
            }),
            Look::Guide => on.line(points, 1.2, theme.faint),
        }
    }
}

impl Draw for Plot {
    fn size(&self) -> (u32, u32) {
        SIZE
    }

    fn draw<DB: DrawingBackend>(&self, on: &Sheet<'_, DB>, theme: &Theme) -> Result<(), Failed>
    where
        DB::ErrorType: 'static,
    {
        heading(on, theme, &self.title, &self.about)?;
        let points = || self.series.iter().flat_map(|s| s.points.iter().copied());
        let x = Axis::new(self.x.1, points().map(|p| p.0), self.x_ticks.as_deref());
        let y = Axis::new(self.y.1, points().map(|p| p.1), None);
        let px = |v: f64| PLOT_AREA.x0 + x.position(v) * (PLOT_AREA.x1 - PLOT_AREA.x0);
        let py = |v: f64| PLOT_AREA.y1 - y.position(v) * (PLOT_AREA.y1 - PLOT_AREA.y0);
        for &t in x.ticks() {
            on.line(&[(px(t), PLOT_AREA.y0), (px(t), PLOT_AREA.y1)], 1.0, theme.grid)?;
            on.text(&number(t), (px(t), PLOT_AREA.y1 + 18.0), 12.0, Anchor::Middle, theme.ink)?;
        }
        for &t in y.ticks() {
            on.line(&[(PLOT_AREA.x0, py(t)), (PLOT_AREA.x1, py(t))], 1.0, theme.grid)?;
            on.text(&number(t), (PLOT_AREA.x0 - 8.0, py(t) + 4.0), 12.0, Anchor::Right, theme.ink)?;
        }
        on.axes(&PLOT_AREA, theme.ink)?;
        let middle = ((PLOT_AREA.x0 + PLOT_AREA.x1) / 2.0, (PLOT_AREA.y0 + PLOT_AREA.y1) / 2.0);
        on.text(&self.x.0, (middle.0, PLOT_AREA.y1 + 44.0), 13.0, Anchor::Middle, theme.ink)?;
        on.upwards(&self.y.0, (20.0, middle.1), 13.0, theme.ink)?;
        let (left, mut top) = (PLOT_AREA.x1 + 22.0, PLOT_AREA.y0 + 8.0);
        for s in &self.series {
            let at: Vec<(f64, f64)> = s.points.iter().map(|p| (px(p.0), py(p.1))).collect();
            s.look.draw(on, theme, &at)?;
            let key: &[(f64, f64)] = match s.look {
                Look::Marks(..) | Look::Paper => &[(11.0, 0.0)],
                Look::Line(_) | Look::Dashes(_) | Look::Guide => &[(0.0, 0.0), (22.0, 0.0)],
            };
            let key: Vec<(f64, f64)> = key.iter().map(|k| (left + k.0, top + k.1)).collect();
            s.look.draw(on, theme, &key)?;
            let name = short(&s.name, 12.0, f64::from(SIZE.0) - left - 40.0);
            on.text(&name, (left + 32.0, top + 4.0), 12.0, Anchor::Left, theme.ink)?;
            top += 22.0;
        }
        Ok(())
    }
}

/// A chart of stacked bars, in named groups.
#[derive(Clone, Debug)]
pub(super) struct Bars {
    pub(super) title: String,
    pub(super) about: String,
    pub(super) x: String,
    /// Name and colour index of each piece, in their order.
    pub(super) pieces: Vec<(String, usize)>,
    pub(super) groups: Vec<(String, Vec<Vec<f64>>)>,
}

/// Height of a bar with the space below it, in pixels.
const BAR_HEIGHT: f64 = 17.0;
/// Height of the name of a group, in pixels.
const NAME_HEIGHT: f64 = 30.0;

impl Draw for Bars {
    fn size(&self) -> (u32, u32) {
        let bars: usize = self.groups.iter().map(|g| g.1.len()).sum();
        let high = 92.0 + NAME_HEIGHT * self.groups.len() as f64 + BAR_HEIGHT * bars as f64 + 62.0;
        (SIZE.0, high as u32)
    }

    fn draw<DB: DrawingBackend>(&self, on: &Sheet<'_, DB>, theme: &Theme) -> Result<(), Failed>
    where
        DB::ErrorType: 'static,
    {
        heading(on, theme, &self.title, &self.about)?;
        let (left, right, top) = (60.0, 860.0, 92.0);
        let bottom = f64::from(self.size().1) - 58.0;
        let mut key = left;
        for (name, colour) in &self.pieces {
            let own = Box2 { x0: key, y0: top - 20.0, x1: key + 12.0, y1: top - 8.0 };
            on.bar(&own, theme.colours[colour % 8])?;
            on.text(name, (key + 17.0, top - 10.0), 12.0, Anchor::Left, theme.ink)?;
            key += 17.0 + width(name, 12.0) + 20.0;
        }
        let sums = self.groups.iter().flat_map(|g| &g.1).map(|bar| bar.iter().sum::<f64>());
        let axis = Axis::new(Steps::Even, sums.collect::<Vec<_>>().into_iter(), None);
        let px = |v: f64| left + axis.position(v) * (right - left);
        for &t in axis.ticks() {
            on.line(&[(px(t), top), (px(t), bottom)], 1.0, theme.grid)?;
            on.text(&number(t), (px(t), bottom + 18.0), 12.0, Anchor::Middle, theme.ink)?;
        }
        let mut y = top;
        for (name, bars) in &self.groups {
            on.text(name, (left + 8.0, y + 20.0), 12.5, Anchor::Left, theme.ink)?;
            y += NAME_HEIGHT;
            for (n, bar) in bars.iter().enumerate() {
                let row = (y + 1.5, y + BAR_HEIGHT - 2.5);
                on.text(
                    &(n + 1).to_string(),
                    (left - 8.0, row.1 - 2.0),
                    11.0,
                    Anchor::Right,
                    theme.faint,
                )?;
                let mut sum = 0.0;
                for (piece, (_, colour)) in bar.iter().zip(&self.pieces) {
                    let own = Box2 { x0: px(sum), y0: row.0, x1: px(sum + piece), y1: row.1 };
                    sum += piece;
                    if own.x1 - own.x0 > 0.2 {
                        on.bar(&own, theme.colours[colour % 8])?;
                    }
                }
                y += BAR_HEIGHT;
            }
        }
        on.line(&[(left, top), (left, bottom), (right, bottom)], 1.2, theme.ink)?;
        let middle = (left + right) / 2.0;
        on.text(&self.x, (middle, bottom + 44.0), 13.0, Anchor::Middle, theme.ink)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::{DARK, LIGHT, pixels, svg};

    #[test]
    fn numbers_are_short() {
        let said: Vec<String> = [0.0, 0.5, 2.0, 2.5, 1200.0, 0.001].map(number).into();
        assert_eq!(said, ["0", "0.5", "2", "2.5", "1200", "0.001"]);
    }

    #[test]
    fn charts_come_out_on_both_grounds_also_with_nothing_in_them() {
        let mut plot = Plot {
            title: "a <title> & more".into(),
            about: "x".repeat(400),
            x: ("nodes".into(), Steps::Even),
            y: ("ms".into(), Steps::Powers),
            x_ticks: Some(vec![3.0, 16.0]),
            series: vec![Series {
                name: "a rather long name that does not fit beside the chart".into(),
                look: Look::Dashes(1),
                points: vec![(3.0, 1.0), (16.0, 10.0), (16.0, 10.0)],
            }],
        };
        let text = svg(&plot, &LIGHT).unwrap();
        assert!(text.contains("&lt;title&gt;") && !text.contains("<title"), "{text}");
        plot.series.clear();
        assert!(!pixels(&plot, &DARK).unwrap().rgb.is_empty());
        let bars = Bars {
            title: "t".into(),
            about: String::new(),
            x: "s".into(),
            pieces: vec![("one".into(), 0), ("two".into(), 7)],
            groups: vec![("g".into(), vec![vec![1.0, 0.5], vec![0.0, 0.0]])],
        };
        assert!(svg(&bars, &DARK).is_ok());
    }
}
