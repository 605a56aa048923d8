//! Efficiency over workers, as SVG and PNG from one list of strokes.

use super::predict::Row;
use crate::canvas::Canvas;
use std::fmt::Write;

const SIZE: [usize; 2] = [860, 460];
/// Left, top, right and bottom of the diagram.
const BOX: [f64; 4] = [70.0, 56.0, 840.0, 400.0];
const GROUND: [u8; 3] = [252, 252, 248];
const INK: [u8; 3] = [40, 40, 40];
const FAINT: [u8; 3] = [222, 222, 216];
/// Okabe and Ito's colours, which most colour-blind readers tell apart.
const COLOURS: [[u8; 3]; 4] = [[213, 94, 0], [0, 114, 178], [0, 140, 100], [110, 60, 130]];
/// What binds is told by the shape of a point's middle: its letter, below the axis.
const LETTER: usize = 6;

/// What is drawn of a row.
type Figure = fn(&Row) -> Option<f64>;

/// A line, a dot or a word.
enum Stroke {
    Line([f64; 2], [f64; 2], [u8; 3], f64),
    Dot([f64; 2], [u8; 3]),
    Text([f64; 2], String, [u8; 3], usize),
}

/// What is drawn.
pub(super) struct Chart {
    strokes: Vec<Stroke>,
}

impl Chart {
    /// The efficiencies of some clusters under some schedules (two at most), by number of workers.
    pub(super) fn new(title: &str, note: &str, schedules: &[(&str, &[Row])]) -> Chart {
        let mut c = Chart { strokes: Vec::new() };
        let [left, top, right, bottom] = BOX;
        c.text([16.0, 14.0], title, INK, 2);
        c.text([16.0, 36.0], note, INK, 1);
        let all = || schedules.iter().flat_map(|s| s.1);
        let most = all().map(|r| r.workers).max().unwrap_or(1).max(2);
        // Even steps for each doubling.
        let x =
            |n: u32| left + (right - left) * libm::log2(f64::from(n)) / libm::log2(f64::from(most));
        let through: Figure = |r| r.throughput.map(|t| t.1);
        let top_value = all().flat_map(|r| [Some(r.latency_efficiency), through(r)]).flatten();
        let ceiling = top_value.fold(1.0, f64::max);
        let y = |e: f64| bottom - (bottom - top) * e / ceiling;
        for tenth in (0..=10).step_by(2) {
            let at = y(f64::from(tenth) / 10.0);
            c.line([left, at], [right, at], FAINT, 1.0);
            c.text([left - 44.0, at - 4.0], &format!("{:>3} %", tenth * 10), INK, 1);
        }
        let mut n = 1;
        while n <= most {
            c.line([x(n), top], [x(n), bottom], FAINT, 1.0);
            let word = n.to_string();
            c.text([x(n) - 3.0 * word.len() as f64, bottom + 8.0], &word, INK, 1);
            n *= 2;
        }
        c.text([right - 44.0, bottom + 48.0], "workers", INK, 1);
        let of: [(&str, Figure); 2] =
            [("latency", |r| Some(r.latency_efficiency)), ("throughput", through)];
        for (i, (schedule, rows)) in schedules.iter().enumerate() {
            let mut before = None;
            for r in rows.iter() {
                // Where another resource begins to bind, its name stands below.
                let kind = r.bound.0;
                if before.replace(kind) != Some(kind) {
                    let at = x(r.workers).min(right - (LETTER * kind.name().len()) as f64);
                    let below = bottom + 22.0 + 11.0 * i as f64;
                    c.text([at, below], kind.name(), COLOURS[2 * i % 4], 1);
                }
            }
            for (j, (name, value)) in of.iter().enumerate() {
                let colour = COLOURS[(2 * i + j) % 4];
                let points: Vec<[f64; 2]> =
                    rows.iter().filter_map(|r| Some([x(r.workers), y(value(r)?)])).collect();
                for w in points.windows(2) {
                    c.line(w[0], w[1], colour, 2.0);
                }
                points.iter().for_each(|p| c.strokes.push(Stroke::Dot(*p, colour)));
                let at = [left + 10.0 + 160.0 * (2 * i + j) as f64, bottom + 48.0];
                c.strokes.push(Stroke::Dot([at[0] - 6.0, at[1] + 3.0], colour));
                c.text(at, &format!("{schedule}, {name}"), colour, 1);
            }
        }
        c
    }

    fn line(&mut self, a: [f64; 2], b: [f64; 2], colour: [u8; 3], width: f64) {
        self.strokes.push(Stroke::Line(a, b, colour, width));
    }

    fn text(&mut self, at: [f64; 2], text: &str, colour: [u8; 3], dot: usize) {
        self.strokes.push(Stroke::Text(at, text.into(), colour, dot));
    }

    pub(super) fn svg(&self) -> String {
        let [w, h] = SIZE;
        let hex = |c: &[u8; 3]| format!("#{:02x}{:02x}{:02x}", c[0], c[1], c[2]);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w}\" height=\"{h}\" viewBox=\"0 0 \
             {w} {h}\" font-family=\"sans-serif\">\n<rect width=\"{w}\" height=\"{h}\" \
             fill=\"{}\"/>\n",
            hex(&GROUND)
        );
        for stroke in &self.strokes {
            let _ = match stroke {
                Stroke::Line(a, b, colour, width) => writeln!(
                    svg,
                    "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"{}\" \
                     stroke-width=\"{width}\"/>",
                    a[0],
                    a[1],
                    b[0],
                    b[1],
                    hex(colour)
                ),
                Stroke::Dot(at, colour) => writeln!(
                    svg,
                    "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3.5\" fill=\"{}\"/>",
                    at[0],
                    at[1],
                    hex(colour)
                ),
                Stroke::Text(at, text, colour, dot) => writeln!(
                    svg,
                    "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"{}\" fill=\"{}\">{}</text>",
                    at[0],
                    at[1] + 8.0 * *dot as f64,
                    if *dot > 1 { 17 } else { 12 },
                    hex(colour),
                    text.replace('&', "&amp;").replace('<', "&lt;")
                ),
            };
        }
        svg + "</svg>\n"
    }

    pub(super) fn canvas(&self) -> Canvas {
        let mut canvas = Canvas::new(SIZE);
        canvas.fill([0, 0], SIZE, GROUND);
        let put = |canvas: &mut Canvas, at: [f64; 2], size: usize, colour| {
            let half = size as f64 / 2.0;
            let corner = at.map(|x| (x - half).round().max(0.0) as usize);
            canvas.fill(corner, [size; 2], colour);
        };
        for stroke in &self.strokes {
            match stroke {
                Stroke::Line(a, b, colour, width) => {
                    let steps = (b[0] - a[0]).abs().max((b[1] - a[1]).abs()).ceil().max(1.0);
                    for i in 0..=steps as usize {
                        let t = i as f64 / steps;
                        let at = [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t];
                        put(&mut canvas, at, *width as usize, *colour);
                    }
                }
                Stroke::Dot(at, colour) => put(&mut canvas, *at, 7, *colour),
                Stroke::Text(at, text, colour, dot) => {
                    canvas.text(at.map(|x| x.max(0.0) as usize), *dot, text, *colour);
                }
            }
        }
        canvas
    }
}
