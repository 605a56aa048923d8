//! The chart of a plan: efficiency by number of workers, and below it the bounding resource.

use super::predict::{Bound, Row};
use crate::chart::{Anchor, Box2, Draw, Mark, Sheet, Theme, width};
use plotters::prelude::DrawingBackend;

type Failed = Box<dyn std::error::Error + Send + Sync>;

const WIDE: u32 = 1000;
/// The plot area between the axes, in pixels.
const PLOT_AREA: Box2 = Box2 { x0: 84.0, y0: 84.0, x1: 806.0, y1: 440.0 };
/// Position of the first strip of bounding resources, and the distance between strips, in pixels.
const STRIPS: (f64, f64) = (500.0, 26.0);
/// Half the height of a strip, and its overhang beyond the first and last cluster, in pixels.
const HALF: f64 = 8.0;
/// Bounding resources and the indices of their colours.
const BOUNDS: [(Bound, usize); 4] =
    [(Bound::Cores, 2), (Bound::Straggler, 4), (Bound::Link, 3), (Bound::Master, 6)];

/// Returns the drawn value of a row.
type Figure = fn(&Row) -> Option<f64>;

/// Lines drawn for a schedule: name, value, mark, and colour index for the first and second
/// schedule.
const FIGURES: [(&str, Figure, Mark, [usize; 2]); 2] = [
    ("latency", |r| Some(r.latency_efficiency), Mark::Dot, [0, 1]),
    ("throughput", |r| r.throughput.map(|t| t.1), Mark::Square, [5, 4]),
];

/// The efficiencies of some clusters under some schedules (two at most), by number of workers.
pub(super) struct Chart<'a> {
    pub(super) title: &'a str,
    pub(super) note: &'a str,
    pub(super) schedules: &'a [(&'a str, &'a [Row])],
}

impl Chart<'_> {
    fn rows(&self) -> impl Iterator<Item = &Row> {
        self.schedules.iter().flat_map(|s| s.1)
    }

    /// Returns the axis of workers, for at least two.
    fn axis(&self) -> Axis {
        Axis { most: self.rows().map(|r| r.workers).max().unwrap_or(1).max(2) }
    }
}

/// The logarithmic axis of workers.
struct Axis {
    most: u32,
}

impl Axis {
    /// Returns the x position of a number of workers.
    fn x(&self, workers: u32) -> f64 {
        let doublings = |n: u32| libm::log2(f64::from(n.max(1)));
        PLOT_AREA.x0 + (PLOT_AREA.x1 - PLOT_AREA.x0) * doublings(workers) / doublings(self.most)
    }

    /// Returns the ticks: powers of two, and the most workers if there is room.
    fn ticks(&self) -> Vec<u32> {
        let most = self.most;
        let mut ticks: Vec<u32> = (0..32).map(|i| 1 << i).take_while(|n| *n <= most).collect();
        let last = ticks.last().copied().unwrap_or(1);
        if self.x(most) - self.x(last) > width(&format!("{last}{most}"), 12.0) {
            ticks.push(most);
        }
        ticks
    }

    /// Returns the bounding resources along the axis with start and end of each. A cluster reaches
    /// halfway to its neighbours.
    fn strip(&self, rows: &[Row]) -> Vec<(Bound, f64, f64)> {
        let mut strip: Vec<(Bound, f64, f64)> = Vec::new();
        for (i, row) in rows.iter().enumerate() {
            let own = self.x(row.workers);
            let edge = |other: Option<&Row>, end: f64| {
                other.map_or(end, |o| (own + self.x(o.workers)) / 2.0)
            };
            let start = edge(i.checked_sub(1).and_then(|i| rows.get(i)), own - HALF);
            let end = edge(rows.get(i + 1), own + HALF);
            match strip.last_mut() {
                Some((bound, _, last_end)) if *bound == row.bound.0 => *last_end = end,
                _ => strip.push((row.bound.0, start, end)),
            }
        }
        strip
    }
}

impl Draw for Chart<'_> {
    fn size(&self) -> (u32, u32) {
        (WIDE, (STRIPS.0 + STRIPS.1 * self.schedules.len() as f64) as u32 + 12)
    }

    fn draw<DB: DrawingBackend>(&self, on: &Sheet<'_, DB>, theme: &Theme) -> Result<(), Failed>
    where
        DB::ErrorType: 'static,
    {
        on.text(self.title, (22.0, 32.0), 18.0, Anchor::Left, theme.ink)?;
        on.text(self.note, (22.0, 54.0), 12.0, Anchor::Left, theme.faint)?;
        let axis = self.axis();
        let values = self.rows().flat_map(|r| FIGURES.iter().filter_map(|f| f.1(r)));
        // Frames that arrive a little early have an efficiency above 1.
        let ceiling = values.fold(1.0, f64::max);
        let y = |e: f64| PLOT_AREA.y1 - (PLOT_AREA.y1 - PLOT_AREA.y0) * e / ceiling;
        for tenth in (0..=10).step_by(2) {
            let at = y(f64::from(tenth) / 10.0);
            on.line(&[(PLOT_AREA.x0, at), (PLOT_AREA.x1, at)], 1.0, theme.grid)?;
            let word = format!("{} %", tenth * 10);
            on.text(&word, (PLOT_AREA.x0 - 12.0, at + 4.0), 12.0, Anchor::Right, theme.ink)?;
        }
        for n in axis.ticks() {
            let at = axis.x(n);
            on.line(&[(at, PLOT_AREA.y0), (at, PLOT_AREA.y1)], 1.0, theme.grid)?;
            on.text(&n.to_string(), (at, PLOT_AREA.y1 + 20.0), 12.0, Anchor::Middle, theme.ink)?;
        }
        on.axes(&PLOT_AREA, theme.ink)?;
        let middle = ((PLOT_AREA.x0 + PLOT_AREA.x1) / 2.0, (PLOT_AREA.y0 + PLOT_AREA.y1) / 2.0);
        on.text("workers", (middle.0, PLOT_AREA.y1 + 38.0), 13.0, Anchor::Middle, theme.ink)?;
        on.upwards("of what so many cores could do", (22.0, middle.1), 13.0, theme.ink)?;

        let legend = PLOT_AREA.x1 + 30.0;
        let mut down = PLOT_AREA.y0 + 8.0;
        for (i, (schedule, rows)) in self.schedules.iter().enumerate() {
            for (name, value, mark, colours) in FIGURES {
                let colour = theme.colours[colours[i % 2]];
                let points: Vec<(f64, f64)> =
                    rows.iter().filter_map(|r| Some((axis.x(r.workers), y(value(r)?)))).collect();
                if points.is_empty() {
                    continue;
                }
                on.line(&points, 2.0, colour)?;
                for at in &points {
                    on.mark(mark, *at, 3.6, colour)?;
                }
                on.mark(mark, (legend, down), 5.0, colour)?;
                let word = format!("{schedule}, {name}");
                on.text(&word, (legend + 14.0, down + 4.0), 12.0, Anchor::Left, theme.ink)?;
                down += 22.0;
            }
        }
        down += 14.0;
        on.text("bound by", (legend - 6.0, down + 4.0), 12.0, Anchor::Left, theme.faint)?;
        for (bound, colour) in BOUNDS {
            if self.rows().any(|r| r.bound.0 == bound) {
                down += 22.0;
                on.bar(&Box2::about((legend, down), 6.0), theme.colours[colour])?;
                let at = (legend + 14.0, down + 4.0);
                on.text(bound.name(), at, 12.0, Anchor::Left, theme.ink)?;
            }
        }
        for (i, (schedule, rows)) in self.schedules.iter().enumerate() {
            let at = STRIPS.0 + STRIPS.1 * i as f64;
            on.text(schedule, (PLOT_AREA.x0 - 14.0, at + 4.0), 12.0, Anchor::Right, theme.ink)?;
            for (bound, x0, x1) in axis.strip(rows) {
                let colour = BOUNDS.iter().find(|b| b.0 == bound).map_or(0, |b| b.1);
                let own = Box2 { x0, y0: at - HALF, x1, y1: at + HALF };
                on.bar(&own, theme.colours[colour])?;
                if width(bound.name(), 11.0) + 6.0 < x1 - x0 {
                    let middle = ((x0 + x1) / 2.0, at + 4.0);
                    on.text(bound.name(), middle, 11.0, Anchor::Middle, theme.ground)?;
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::{DARK, LIGHT, pixels, svg};

    fn row(workers: u32, bound: Bound) -> Row {
        Row {
            workers,
            first_ms: 9.0,
            frame_ms: 5.0,
            latency_efficiency: 1.0 / f64::from(workers),
            throughput: None,
            bytes: [0.0; 3],
            leases: 0.0,
            bound: (bound, 0.5),
            parts: [0.0; 4],
            master_ms: [0.0; 3],
            messages: [0.0; 3],
            steady: None,
        }
    }

    #[test]
    fn strip_of_bounds_has_no_gaps_and_labels_that_fit() {
        // Link and master bind by turns, as they do where large clusters have nearly equal times.
        let bound = |n: u32| {
            if n < 20 { Bound::Cores } else { [Bound::Link, Bound::Master][(n % 2) as usize] }
        };
        let rows: Vec<Row> = (1..=64).map(|n| row(n, bound(n))).collect();
        let schedules = [("region", &rows[..])];
        let chart = Chart { title: "t", note: "", schedules: &schedules };
        let strip = chart.axis().strip(&rows);
        assert_eq!(strip.len(), 46, "cores, and then each by itself");
        assert!(strip.windows(2).all(|w| w[0].2 == w[1].1 && w[0].1 < w[0].2), "{strip:?}");
        assert!(
            strip[0].1 < PLOT_AREA.x0 && strip[45].2 > PLOT_AREA.x1,
            "ends stand about their points"
        );
        let drawn = svg(&chart, &LIGHT).unwrap();
        // In the strip and in the legend, or in the legend alone.
        let said = |name: &str| drawn.lines().filter(|l| l.trim() == name).count();
        assert_eq!(["cores", "link", "master", "straggler"].map(said), [2, 1, 1, 0], "{drawn}");
    }

    #[test]
    fn legend_has_only_drawn_lines_and_one_cluster_makes_a_chart() {
        let rows = [row(3, Bound::Cores)];
        let schedules = [("region", &rows[..]), ("slab, 3 slabs", &rows[..])];
        let chart = Chart { title: "t", note: "", schedules: &schedules };
        let drawn = svg(&chart, &DARK).unwrap();
        assert!(
            drawn.contains("slab, 3 slabs, latency") && !drawn.contains("throughput"),
            "{drawn}"
        );
        assert_eq!(chart.axis().ticks(), [1, 2, 3]);
        assert!(!pixels(&chart, &LIGHT).unwrap().rgb.is_empty());
        let none = Chart { schedules: &[], ..chart };
        assert!(svg(&none, &LIGHT).is_ok());
    }
}
