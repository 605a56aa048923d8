//! Charts as SVG and as PNG, on a light and on a dark ground.
//!
//! Drawn by plotters: its SVG writer, and its bitmap writer, whose letters are our own
//! ([`slabcast_session::letters`]). One drawing function serves both; [`Sheet`] hides the writer
//! and the size of a pixel. Text is measured in the same font, so that labels never overlap.

use plotters::coord::Shift;
use plotters::prelude::*;
use slabcast_session::fail::Fail;
use slabcast_session::letters::{self, Way};
use slabcast_session::output::write_atomic;
use std::io::Write;
use std::path::Path;

/// Font families for SVG viewers; the first is that of the PNGs.
pub(crate) const FAMILY: &str = "DejaVu Sans, Verdana, sans-serif";

/// Pixels of the PNG for one of the SVG along each edge. At 1, charts look coarse on screens.
const PNG_SCALE: u32 = 2;

/// Pixels drawn for one of the PNG along each edge. Smooths lines, which plotters draws jagged.
const SMOOTH: u32 = 2;

type Failed = Box<dyn std::error::Error + Send + Sync>;

/// Colours for a light or dark background.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Theme {
    pub(crate) ground: RGBColor,
    pub(crate) ink: RGBColor,
    pub(crate) faint: RGBColor,
    pub(crate) grid: RGBColor,
    /// Colours of up to eight series: those of Okabe and Ito, which most colour-blind readers can
    /// tell apart, darkened or lightened for the background.
    pub(crate) colours: [RGBColor; 8],
}

/// Colours for a light background.
pub(crate) const LIGHT: Theme = Theme {
    ground: RGBColor(253, 253, 250),
    ink: RGBColor(32, 34, 38),
    faint: RGBColor(110, 112, 118),
    grid: RGBColor(226, 226, 220),
    colours: [
        RGBColor(0, 105, 168),
        RGBColor(205, 88, 0),
        RGBColor(0, 135, 98),
        RGBColor(180, 80, 140),
        RGBColor(150, 118, 0),
        RGBColor(45, 150, 200),
        RGBColor(120, 60, 40),
        RGBColor(120, 122, 128),
    ],
};

/// Colours for a dark background.
pub(crate) const DARK: Theme = Theme {
    ground: RGBColor(24, 26, 30),
    ink: RGBColor(236, 236, 232),
    faint: RGBColor(160, 162, 168),
    grid: RGBColor(52, 55, 62),
    colours: [
        RGBColor(86, 180, 233),
        RGBColor(240, 150, 60),
        RGBColor(60, 200, 155),
        RGBColor(222, 140, 190),
        RGBColor(235, 215, 80),
        RGBColor(130, 160, 255),
        RGBColor(205, 150, 125),
        RGBColor(170, 172, 178),
    ],
};

/// A chart that can be drawn by any writer, in units of one SVG pixel.
pub(crate) trait Draw {
    /// Returns width and height in pixels.
    fn size(&self) -> (u32, u32);

    /// Draws the chart.
    fn draw<DB: DrawingBackend>(&self, on: &Sheet<'_, DB>, theme: &Theme) -> Result<(), Failed>
    where
        DB::ErrorType: 'static;
}

/// The area that a chart is drawn on.
pub(crate) struct Sheet<'a, DB: DrawingBackend> {
    area: &'a DrawingArea<DB, Shift>,
    scale: f64,
    /// Whether text is drawn letter by letter, since the writer has no letters.
    letters: bool,
}

/// Size of text in ems, for one of plotters, which gives SVG viewers this much.
const EM: f64 = 1.0 / 1.24;

/// Height of the middle of small letters above the base line, as a share of the font size.
const MIDDLE: f64 = 0.22;

/// The part of a text that is at its position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Anchor {
    Left,
    Middle,
    Right,
}

/// Shape of a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mark {
    Dot,
    Square,
    Triangle,
    Diamond,
    Cross,
}

impl<DB: DrawingBackend> Sheet<'_, DB>
where
    DB::ErrorType: 'static,
{
    /// Converts a position to pixels of the writer.
    fn pixel(&self, (x, y): (f64, f64)) -> (i32, i32) {
        ((x * self.scale).round() as i32, (y * self.scale).round() as i32)
    }

    /// Converts a length to pixels of the writer, at least one.
    fn pixels_long(&self, x: f64) -> u32 {
        (x * self.scale).round().max(1.0) as u32
    }

    /// Draws a line through points, `wide` pixels wide.
    pub(crate) fn line(
        &self,
        points: &[(f64, f64)],
        wide: f64,
        colour: RGBColor,
    ) -> Result<(), Failed> {
        let points: Vec<_> = points.iter().map(|&p| self.pixel(p)).collect();
        self.area.draw(&PathElement::new(points, colour.stroke_width(self.pixels_long(wide))))?;
        Ok(())
    }

    /// Draws a mark of radius `r` around a point.
    pub(crate) fn mark(
        &self,
        mark: Mark,
        (x, y): (f64, f64),
        r: f64,
        colour: RGBColor,
    ) -> Result<(), Failed> {
        let poly = |points: &[(f64, f64)]| {
            let points = points.iter().map(|p| self.pixel((x + p.0 * r, y + p.1 * r)));
            Polygon::new(points.collect::<Vec<_>>(), colour.filled())
        };
        match mark {
            Mark::Dot => {
                self.area.draw(&Circle::new(
                    self.pixel((x, y)),
                    self.pixels_long(r),
                    colour.filled(),
                ))?;
            }
            Mark::Square => {
                let q = 0.86;
                self.area.draw(&poly(&[(-q, -q), (q, -q), (q, q), (-q, q)]))?;
            }
            Mark::Triangle => self.area.draw(&poly(&[(0.0, -1.1), (1.0, 0.75), (-1.0, 0.75)]))?,
            Mark::Diamond => {
                self.area.draw(&poly(&[(0.0, -1.2), (1.2, 0.0), (0.0, 1.2), (-1.2, 0.0)]))?;
            }
            Mark::Cross => {
                for (a, b) in [(1.0, 1.0), (1.0, -1.0)] {
                    let ends = [(x - a * r, y - b * r), (x + a * r, y + b * r)];
                    self.line(&ends, r * 0.55, colour)?;
                }
            }
        }
        Ok(())
    }

    /// Draws a filled rectangle.
    pub(crate) fn bar(&self, own: &Box2, colour: RGBColor) -> Result<(), Failed> {
        let ends = [self.pixel((own.x0, own.y0)), self.pixel((own.x1, own.y1))];
        self.area.draw(&Rectangle::new(ends, colour.filled()))?;
        Ok(())
    }

    /// Draws a ring of radius `r` around a point.
    pub(crate) fn ring(&self, at: (f64, f64), r: f64, colour: RGBColor) -> Result<(), Failed> {
        let turn = |i: i32| {
            let (s, c) = libm::sincos(f64::from(i) * std::f64::consts::TAU / 48.0);
            (at.0 + c * r, at.1 + s * r)
        };
        self.line(&(0..=48).map(turn).collect::<Vec<_>>(), 1.8, colour)
    }

    /// Draws the left and the lower edge of the area of a plot.
    pub(crate) fn axes(&self, plot: &Box2, ink: RGBColor) -> Result<(), Failed> {
        self.line(&[(plot.x0, plot.y0), (plot.x0, plot.y1), (plot.x1, plot.y1)], 1.2, ink)
    }

    /// Draws a line of text with its base line at `y`.
    pub(crate) fn text(
        &self,
        text: &str,
        (x, y): (f64, f64),
        size: f64,
        anchor: Anchor,
        colour: RGBColor,
    ) -> Result<(), Failed> {
        let wide = letters::width(text, size * EM);
        let left = match anchor {
            Anchor::Left => x,
            Anchor::Middle => x - wide / 2.0,
            Anchor::Right => x - wide,
        };
        if self.letters {
            return self.draw_letters(text, (left, y), size, Way::Right, colour);
        }
        // plotters knows the base line by an offset of its own.
        let style = (FAMILY, size * self.scale).into_font().color(&colour);
        let style = style.pos(plotters::style::text_anchor::Pos::new(
            plotters::style::text_anchor::HPos::Left,
            plotters::style::text_anchor::VPos::Bottom,
        ));
        self.area.draw(&Text::new(
            text.to_owned(),
            self.pixel((left, y + size * MIDDLE)),
            style,
        ))?;
        Ok(())
    }

    /// Draws a line of text upwards, its middle at a position.
    pub(crate) fn upwards(
        &self,
        text: &str,
        (x, y): (f64, f64),
        size: f64,
        colour: RGBColor,
    ) -> Result<(), Failed> {
        if self.letters {
            let start = (x + size * MIDDLE, y + letters::width(text, size * EM) / 2.0);
            return self.draw_letters(text, start, size, Way::Up, colour);
        }
        let font = (FAMILY, size * self.scale).into_font().transform(FontTransform::Rotate270);
        let style = font.color(&colour).pos(plotters::style::text_anchor::Pos::new(
            plotters::style::text_anchor::HPos::Center,
            plotters::style::text_anchor::VPos::Center,
        ));
        self.area.draw(&Text::new(text.to_owned(), self.pixel((x, y)), style))?;
        Ok(())
    }

    /// Draws a line of text letter by letter, its base line from a position.
    fn draw_letters(
        &self,
        text: &str,
        (x, y): (f64, f64),
        size: f64,
        way: Way,
        colour: RGBColor,
    ) -> Result<(), Failed> {
        let start = (x * self.scale, y * self.scale);
        letters::draw(text, size * EM * self.scale, start, way, |at, covered| {
            self.area.draw_pixel(at, &colour.mix(covered))
        })?;
        Ok(())
    }
}

/// Returns the room for a text along a line, in pixels. A quarter wider than it is in our font, as
/// some of the fonts are that an SVG viewer may put in its place.
pub(crate) fn width(text: &str, size: f64) -> f64 {
    letters::width(text, size)
}

/// A rectangle in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Box2 {
    pub(crate) x0: f64,
    pub(crate) y0: f64,
    pub(crate) x1: f64,
    pub(crate) y1: f64,
}

impl Box2 {
    /// Returns the square of half-width `r` around a point.
    pub(crate) fn about((x, y): (f64, f64), r: f64) -> Box2 {
        Box2 { x0: x - r, y0: y - r, x1: x + r, y1: y + r }
    }

    pub(crate) fn overlaps(&self, o: &Box2) -> bool {
        self.x0 < o.x1 && o.x0 < self.x1 && self.y0 < o.y1 && o.y0 < self.y1
    }

    pub(crate) fn inside(&self, o: &Box2) -> bool {
        self.x0 >= o.x0 && self.x1 <= o.x1 && self.y0 >= o.y0 && self.y1 <= o.y1
    }
}

/// Returns a position for the label of a point that stays in `room` and covers nothing in `taken`:
/// the left end of its base line, and its box. Near positions are tried first.
pub(crate) fn place(
    text: &str,
    size: f64,
    point: (f64, f64),
    room: &Box2,
    taken: &[Box2],
) -> Option<((f64, f64), Box2)> {
    let wide = width(text, size);
    for far in [9.0, 16.0, 26.0, 38.0, 52.0, 70.0] {
        for (dx, dy) in [
            (1.0, -0.5),
            (1.0, 0.5),
            (-1.0, 0.5),
            (-1.0, -0.5),
            (0.0, -1.0),
            (0.0, 1.0),
            (0.7, -1.0),
            (0.7, 1.0),
            (-0.7, 1.0),
            (-0.7, -1.0),
        ] {
            let (x, y) = (point.0 + dx * far, point.1 + dy * far);
            let left = match dx {
                d if d > 0.0 => x,
                d if d < 0.0 => x - wide,
                _ => x - wide / 2.0,
            };
            let base = y + size * 0.35;
            let own = Box2 {
                x0: left - 2.0,
                y0: base - size * 0.85,
                x1: left + wide + 2.0,
                y1: base + size * 0.3,
            };
            if own.inside(room) && !taken.iter().any(|t| t.overlaps(&own)) {
                return Some(((left, base), own));
            }
        }
    }
    None
}

/// Draws a chart as SVG.
///
/// # Errors
/// plotters fails, which is not expected in memory.
pub(crate) fn svg(chart: &impl Draw, theme: &Theme) -> Result<String, String> {
    let mut svg = String::new();
    let mut draw = || -> Result<(), Failed> {
        let area = SVGBackend::with_string(&mut svg, chart.size()).into_drawing_area();
        area.fill(&theme.ground)?;
        chart.draw(&Sheet { area: &area, scale: 1.0, letters: false }, theme)?;
        area.present()?;
        Ok(())
    };
    draw().map_err(|e| e.to_string())?;
    Ok(svg)
}

/// Draws a chart as pixels, twice the size of the SVG along each edge.
///
/// # Errors
/// plotters fails, which is not expected in memory.
pub(crate) fn pixels(chart: &impl Draw, theme: &Theme) -> Result<Pixels, String> {
    let (w, h) = chart.size();
    let scale = PNG_SCALE * SMOOTH;
    let (wide, high) = (w * scale, h * scale);
    let mut bytes = vec![0; wide as usize * high as usize * 3];
    let mut draw = || -> Result<(), Failed> {
        let area = BitMapBackend::with_buffer(&mut bytes, (wide, high)).into_drawing_area();
        area.fill(&theme.ground)?;
        chart.draw(&Sheet { area: &area, scale: f64::from(scale), letters: true }, theme)?;
        area.present()?;
        Ok(())
    };
    draw().map_err(|e| e.to_string())?;
    let size = [w * PNG_SCALE, h * PNG_SCALE];
    let (row, n) = (wide as usize * 3, SMOOTH as usize);
    let mut rgb = Vec::with_capacity(size[0] as usize * size[1] as usize * 3);
    // By sums of whole rows, to be fast enough in tests without optimisation, too.
    let mut sums = vec![0u16; size[0] as usize * 3];
    let whole = (n * n) as u16;
    for rows in bytes.chunks_exact(row * n) {
        sums.fill(whole / 2);
        for row in rows.chunks_exact(row) {
            for (sum, dots) in sums.chunks_exact_mut(3).zip(row.chunks_exact(3 * n)) {
                let mut i = 0;
                while i < 3 * n {
                    sum[0] += u16::from(dots[i]);
                    sum[1] += u16::from(dots[i + 1]);
                    sum[2] += u16::from(dots[i + 2]);
                    i += 3;
                }
            }
        }
        rgb.extend(sums.iter().map(|sum| (sum / whole) as u8));
    }
    Ok(Pixels { size, rgb })
}

/// A picture of 8-bit sRGB.
pub(crate) struct Pixels {
    pub(crate) size: [u32; 2],
    pub(crate) rgb: Vec<u8>,
}

/// Writes pixels as PNG.
pub(crate) fn write_png(image: &Pixels, out: &mut impl std::io::Write) -> std::io::Result<()> {
    let mut png = png::Encoder::new(out, image.size[0], image.size[1]);
    png.set_color(png::ColorType::Rgb);
    png.set_depth(png::BitDepth::Eight);
    png.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    let io_error = slabcast_session::software::io_error;
    png.add_text_chunk("Software".into(), slabcast_session::software::SOFTWARE.into())
        .map_err(io_error)?;
    let mut png = png.write_header().map_err(io_error)?;
    png.write_image_data(&image.rgb).map_err(io_error)?;
    png.finish().map_err(io_error)
}

/// Writes a chart as `stem`.svg and `stem`.png into a folder.
pub(crate) fn save(
    chart: &impl Draw,
    theme: &Theme,
    (dir, stem): (&Path, &str),
) -> Result<(), Fail> {
    let drawn = |e: String| Fail::failed(format!("the chart can't be drawn: {e}"));
    let svg = svg(chart, theme).map_err(drawn)?;
    write_atomic(&dir.join(format!("{stem}.svg")), |f| f.write_all(svg.as_bytes()))?;
    let pixels = pixels(chart, theme).map_err(drawn)?;
    write_atomic(&dir.join(format!("{stem}.png")), |f| write_png(&pixels, f))
}

/// A logarithmic axis with its ticks.
#[derive(Clone, Debug)]
pub(crate) struct LogAxis {
    from: f64,
    to: f64,
    pub(crate) ticks: Vec<f64>,
}

impl LogAxis {
    /// Returns an axis over all values above zero, with ticks at 1, 2 and 5 of each power of ten
    /// (at 1 alone, if these are too many).
    pub(crate) fn over(values: impl Iterator<Item = f64>) -> LogAxis {
        let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
        for v in values.filter(|v| v.is_finite() && *v > 0.0) {
            (lo, hi) = (lo.min(v), hi.max(v));
        }
        if lo > hi {
            (lo, hi) = (0.1, 10.0);
        }
        // Even a single value gets an axis.
        let (from, to) = (libm::log10(lo), libm::log10(hi));
        let room = (0.06 * (to - from)).max(0.08);
        let (from, to) = (from - room, to + room);
        let (first, last) = (from.floor() as i32, to.ceil() as i32);
        let among = |steps: &[f64]| -> Vec<f64> {
            (first..=last)
                .flat_map(|p| steps.iter().map(move |s| s * libm::pow(10.0, f64::from(p))))
                .filter(|t| (from..=to).contains(&libm::log10(*t)))
                .collect()
        };
        let mut ticks = match to - from {
            wide if wide > 3.2 => among(&[1.0]),
            wide if wide > 0.8 => among(&[1.0, 2.0, 5.0]),
            _ => among(&[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]),
        };
        if ticks.is_empty() {
            ticks.push(libm::pow(10.0, (from + to) / 2.0));
        }
        LogAxis { from, to, ticks }
    }

    /// Returns the position of a value from 0 to 1; values up to zero are at the lower end.
    pub(crate) fn position(&self, value: f64) -> f64 {
        let log = if value > 0.0 { libm::log10(value) } else { self.from };
        ((log - self.from) / (self.to - self.from)).clamp(0.0, 1.0)
    }
}

/// Formats a number for a tick: `0.02`, `5`, `1000`, `1e-5`.
pub(crate) fn tick(x: f64) -> String {
    if !(1e-3..1e5).contains(&x) {
        return format!("{x:.0e}");
    }
    let digits = (-libm::log10(x).floor()).max(0.0) as usize;
    format!("{x:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Sample;

    impl Draw for Sample {
        fn size(&self) -> (u32, u32) {
            (120, 60)
        }

        fn draw<DB: DrawingBackend>(&self, on: &Sheet<'_, DB>, theme: &Theme) -> Result<(), Failed>
        where
            DB::ErrorType: 'static,
        {
            on.text("Hello", (10.0, 30.0), 14.0, Anchor::Left, theme.ink)?;
            on.upwards("up", (100.0, 30.0), 12.0, theme.ink)?;
            on.mark(Mark::Diamond, (80.0, 30.0), 5.0, theme.colours[0])?;
            on.ring((80.0, 30.0), 9.0, theme.ink)
        }
    }

    #[test]
    fn charts_are_drawn_as_svg_and_png_on_both_backgrounds() {
        for theme in [&LIGHT, &DARK] {
            let svg = svg(&Sample, theme).unwrap();
            assert!(svg.contains("Hello") && svg.contains("DejaVu Sans"), "{svg}");
            let image = pixels(&Sample, theme).unwrap();
            assert_eq!(image.size, [240, 120]);
            let at = |x: u32, y: u32| {
                let i = (y * 240 + x) as usize * 3;
                [image.rgb[i], image.rgb[i + 1], image.rgb[i + 2]]
            };
            let ground = theme.ground;
            let inked = |x: std::ops::Range<u32>, y: std::ops::Range<u32>| {
                y.flat_map(|y| x.clone().map(move |x| (x, y)))
                    .filter(|&(x, y)| at(x, y) != [ground.0, ground.1, ground.2])
                    .count()
            };
            // The word between its margins, above its base line, and nothing left of it.
            let wide = width("Hello", 14.0) * 2.0;
            assert!(inked(20..20 + wide as u32, 36..60) > 150);
            assert!(inked(0..18, 0..80) == 0 && inked(24 + wide as u32..120, 30..62) == 0);
            let middle = at(160, 60);
            let colour = theme.colours[0];
            assert_eq!(middle, [colour.0, colour.1, colour.2]);
        }
    }

    #[test]
    fn labels_do_not_overlap() {
        let room = Box2 { x0: 0.0, y0: 0.0, x1: 300.0, y1: 100.0 };
        let points = [(100.0, 50.0), (104.0, 52.0), (108.0, 50.0), (290.0, 50.0)];
        let mut taken: Vec<Box2> = points.iter().map(|&p| Box2::about(p, 4.0)).collect();
        for p in points {
            let (_, own) = place("thickness 2", 11.0, p, &room, &taken).expect("there is room");
            assert!(own.inside(&room) && !taken.iter().any(|t| t.overlaps(&own)));
            taken.push(own);
        }
        assert!(place("x", 11.0, points[0], &room, &[room]).is_none());
    }

    #[test]
    fn log_axis_holds_all_values_and_has_round_ticks() {
        let axis = LogAxis::over([0.0, 3.0, 40.0, f64::NAN].into_iter());
        assert_eq!(axis.ticks, [5.0, 10.0, 20.0]);
        assert!(axis.position(3.0) > 0.0 && axis.position(40.0) < 1.0 && axis.position(0.0) == 0.0);
        assert!(axis.position(10.0) > axis.position(5.0));
        assert!(!LogAxis::over(std::iter::once(7.0)).ticks.is_empty());
        assert_eq!([0.02, 0.5, 5.0, 1000.0, 1e-5].map(tick), ["0.02", "0.5", "5", "1000", "1e-5"]);
    }
}
