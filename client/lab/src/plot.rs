//! Log-log figures of errors, as SVG.
//!
//! Drawn by the SVG writer of plotters. The viewer may use another font than the text was measured
//! in ([`crate::chart`]), so the layout does not depend on it: ticks are few, the legend has its
//! own place below the panels, and slopes are named where their lines end.
//!
//! The background is opaque and light, so that a figure looks the same on a light and a dark page.

use crate::chart::FAMILY;
use plotters::coord::Shift;
use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, Ranged, ValueFormatter};
use plotters::prelude::*;

/// Size of a panel in pixels. Two panels are as wide as a page of text; at half that, ticks touch.
const PANEL: (u32, u32) = (430, 330);
/// Height of the title in pixels.
const TITLE: u32 = 34;
/// Height of the legend in pixels.
const LEGEND: u32 = 34;

const GROUND: RGBColor = RGBColor(252, 252, 248);
const INK: RGBColor = RGBColor(40, 40, 40);
const FAINT: RGBColor = RGBColor(222, 222, 216);
const GUIDE: RGBColor = RGBColor(150, 150, 146);
/// Margin around the points, in powers of the axis.
const MARGIN: f64 = 0.3;
/// Height of the guides, in powers of ten.
const FAN: f64 = 1.0;

/// Colours of Okabe and Ito, which most colour-blind readers can tell apart; shapes serve the rest.
const COLOURS: [RGBColor; 4] =
    [RGBColor(213, 94, 0), RGBColor(0, 114, 178), RGBColor(0, 140, 100), RGBColor(110, 60, 130)];

/// A line of a panel.
pub(crate) struct Series {
    name: String,
    points: Vec<(f64, f64)>,
    dashed: bool,
}

impl Series {
    /// Points joined by a line.
    pub(crate) fn dots(name: &str, points: Vec<(f64, f64)>) -> Series {
        Series { name: name.into(), points, dashed: false }
    }

    /// A dashed line without points.
    pub(crate) fn dashes(name: &str, points: Vec<(f64, f64)>) -> Series {
        Series { name: name.into(), points, dashed: true }
    }
}

/// One diagram of a figure. All panels have the same series, in the same order.
pub(crate) struct Panel {
    pub(crate) title: String,
    pub(crate) series: Vec<Series>,
    /// Powers to draw as grey lines.
    pub(crate) slopes: Vec<i32>,
}

/// Panels side by side on the same axes: x by powers of two, y by powers of ten.
pub(crate) struct LogLog {
    pub(crate) title: String,
    pub(crate) x: String,
    pub(crate) y: String,
    pub(crate) panels: Vec<Panel>,
}

/// A logarithmic axis with a tick at each integer power.
#[derive(Clone)]
struct Powers {
    from: f64,
    to: f64,
    name: fn(i32) -> String,
}

impl Ranged for Powers {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, (lo, hi): (i32, i32)) -> i32 {
        let t = (value - self.from) / (self.to - self.from);
        lo + (t * f64::from(hi - lo)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, _: Hint) -> Vec<f64> {
        (self.from.ceil() as i32..=self.to.floor() as i32).map(f64::from).collect()
    }

    fn range(&self) -> std::ops::Range<f64> {
        self.from..self.to
    }
}

impl ValueFormatter<f64> for Powers {
    fn format_ext(&self, value: &f64) -> String {
        (self.name)(value.round() as i32)
    }
}

/// Formats a power of two: `1/8`, `1`, `2`.
fn power_of_two(power: i32) -> String {
    if power < 0 { format!("1/{}", 1u64 << -power) } else { (1u64 << power).to_string() }
}

/// Formats a power of ten: `1e-3`, `0.1`, `10`.
fn power_of_ten(power: i32) -> String {
    match power {
        -2..=3 => format!("{}", libm::pow(10.0, f64::from(power))),
        _ => format!("1e{power}"),
    }
}

type Failed = Box<dyn std::error::Error>;

impl LogLog {
    /// Draws the figure as SVG.
    ///
    /// # Errors
    /// plotters fails, which is not expected in memory.
    pub(crate) fn svg(&self) -> Result<String, String> {
        let mut svg = String::new();
        self.draw(&mut svg).map_err(|e| e.to_string())?;
        Ok(svg)
    }

    fn draw(&self, svg: &mut String) -> Result<(), Failed> {
        let n = self.panels.len().max(1) as u32;
        let size = (PANEL.0 * n, TITLE + PANEL.1 + LEGEND);
        let root = SVGBackend::with_string(svg, size).into_drawing_area();
        root.fill(&GROUND)?;
        let (top, rest) = root.split_vertically(TITLE);
        let (middle, bottom) = rest.split_vertically(PANEL.1);
        let font = (FAMILY, 17).into_font().color(&INK);
        top.draw(&Text::new(self.title.clone(), (16, 10), font))?;
        let (x, y) = self.ranges();
        for (area, panel) in middle.split_evenly((1, n as usize)).iter().zip(&self.panels) {
            self.panel(area, panel, x, y)?;
        }
        if let Some(panel) = self.panels.first() {
            legend(&bottom, &panel.series)?;
        }
        root.present()?;
        Ok(())
    }

    /// Returns the point where the guides meet: below all points at the largest x, since errors
    /// grow to the right and leave that corner free.
    fn fan(&self, x: [f64; 2], y: [f64; 2]) -> (f64, f64) {
        let right = x[1] - MARGIN;
        let least = self
            .points()
            .filter(|p| p.1 > 0.0 && (libm::log2(p.0) - right).abs() < 0.1)
            .fold(y[1], |least, p| least.min(libm::log10(p.1)));
        (right, least - 1.0)
    }

    fn points(&self) -> impl Iterator<Item = (f64, f64)> + '_ {
        self.panels.iter().flat_map(|p| &p.series).flat_map(|s| &s.points).copied()
    }

    /// Returns the ranges of the logarithms of x and y.
    fn ranges(&self) -> ([f64; 2], [f64; 2]) {
        let over = |values: &mut dyn Iterator<Item = f64>| {
            let r = values
                .filter(|v| v.is_finite())
                .fold([f64::INFINITY, f64::NEG_INFINITY], |r, v| [r[0].min(v), r[1].max(v)]);
            if r[0] < r[1] { r } else { [-1.0, 1.0] }
        };
        let x = over(&mut self.points().map(|p| libm::log2(p.0)));
        let y = over(&mut self.points().map(|p| libm::log10(p.1)));
        let x = [x[0] - MARGIN, x[1] + MARGIN];
        let low = self.fan(x, y).1 - FAN - 0.3;
        (x, [(y[0] - MARGIN).min(low), y[1] + MARGIN])
    }

    fn panel(
        &self,
        area: &DrawingArea<SVGBackend<'_>, Shift>,
        panel: &Panel,
        x: [f64; 2],
        y: [f64; 2],
    ) -> Result<(), Failed> {
        let style = |size: i32, colour: &RGBColor| (FAMILY, size).into_font().color(colour);
        let mut chart = ChartBuilder::on(area)
            .caption(&panel.title, style(14, &INK))
            .margin_right(14)
            .margin_left(6)
            .x_label_area_size(44)
            .y_label_area_size(58)
            .build_cartesian_2d(
                Powers { from: x[0], to: x[1], name: power_of_two },
                Powers { from: y[0], to: y[1], name: power_of_ten },
            )?;
        chart
            .configure_mesh()
            .bold_line_style(FAINT)
            .light_line_style(TRANSPARENT)
            .axis_style(INK)
            .label_style(style(12, &INK))
            .axis_desc_style(style(13, &INK))
            .x_desc(&self.x)
            .y_desc(&self.y)
            .draw()?;
        let fan = self.fan(x, y);
        for &slope in &panel.slopes {
            let rise = f64::from(slope) * std::f64::consts::LOG10_2;
            let end = ((fan.0 - FAN / rise).max(x[0]), 0.0);
            let end = (end.0, fan.1 - (fan.0 - end.0) * rise);
            let line = PathElement::new(vec![end, fan], GUIDE.stroke_width(1));
            chart.draw_series(std::iter::once(line))?;
            // Under its lower end.
            let at = (end.0 + 0.05, end.1 - (y[1] - y[0]) * 0.01);
            let name = Text::new(format!("order {slope}"), at, style(11, &GUIDE));
            chart.draw_series(std::iter::once(name))?;
        }
        for (i, series) in panel.series.iter().enumerate() {
            let colour = COLOURS[i % COLOURS.len()];
            let points: Vec<(f64, f64)> = series
                .points
                .iter()
                .filter(|p| p.0 > 0.0 && p.1 > 0.0)
                .map(|p| (libm::log2(p.0), libm::log10(p.1)))
                .collect();
            if series.dashed {
                let line = DashedLineSeries::new(points, 5, 4, colour.stroke_width(2));
                chart.draw_series(line)?;
                continue;
            }
            chart.draw_series(LineSeries::new(points.iter().copied(), colour.stroke_width(2)))?;
            for p in points {
                let at = EmptyElement::at(p);
                match i % 3 {
                    0 => {
                        chart.draw_series([at + TriangleMarker::new((0, 0), 5, colour.filled())])?
                    }
                    1 => chart
                        .draw_series([at + Rectangle::new([(-4, -4), (5, 5)], colour.filled())])?,
                    _ => chart.draw_series([at + Circle::new((0, 0), 4, colour.filled())])?,
                };
            }
        }
        Ok(())
    }
}

/// Draws a row with sample and name of each series.
fn legend(area: &DrawingArea<SVGBackend<'_>, Shift>, series: &[Series]) -> Result<(), Failed> {
    let (width, _) = area.dim_in_pixel();
    let mut x = 24;
    // Half the height of small type a letter is on the safe side.
    let wide = |s: &Series| 56 + 7 * s.name.chars().count() as i32;
    let spare = width as i32 - 24 - series.iter().map(wide).sum::<i32>();
    let gap = (spare / series.len().max(1) as i32).clamp(0, 24);
    for (i, s) in series.iter().enumerate() {
        let colour = COLOURS[i % COLOURS.len()];
        let y = 15;
        if s.dashed {
            for from in [0, 9, 18] {
                let dash = vec![(x + from, y), (x + from + 5, y)];
                area.draw(&PathElement::new(dash, colour.stroke_width(2)))?;
            }
        } else {
            area.draw(&PathElement::new(vec![(x, y), (x + 24, y)], colour.stroke_width(2)))?;
            match i % 3 {
                0 => area.draw(&TriangleMarker::new((x + 12, y), 5, colour.filled()))?,
                1 => {
                    area.draw(&Rectangle::new([(x + 8, y - 4), (x + 17, y + 5)], colour.filled()))?
                }
                _ => area.draw(&Circle::new((x + 12, y), 4, colour.filled()))?,
            }
        }
        let font = (FAMILY, 13).into_font().color(&INK);
        area.draw(&Text::new(s.name.clone(), (x + 30, y - 6), font))?;
        x += wide(s) + gap;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figure_names_its_lines_and_survives_zeros() {
        let points = vec![(2.0, 1.0), (1.0, 0.25), (0.5, 0.0)];
        let figure = LogLog {
            title: "wall".into(),
            x: "thickness".into(),
            y: "error".into(),
            panels: vec![Panel {
                title: "parallel".into(),
                series: vec![
                    Series::dots("constant", points.clone()),
                    Series::dashes("in f64", points),
                ],
                slopes: vec![2],
            }],
        };
        let svg = figure.svg().unwrap();
        for text in ["wall", "parallel", "constant", "in f64", "order 2", "thickness", "error"] {
            assert!(svg.contains(text), "{text}");
        }
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
        let empty = LogLog { panels: vec![], ..figure };
        assert!(empty.svg().unwrap().contains("wall"));
    }

    #[test]
    fn ticks_are_powers() {
        assert_eq!([-5, -1, 0, 1].map(power_of_two), ["1/32", "1/2", "1", "2"]);
        assert_eq!([-3, -2, 0, 2].map(power_of_ten), ["1e-3", "0.01", "1", "100"]);
    }
}
