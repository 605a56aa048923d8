//! Replays a worker's progress through a recorded region: the sheets it reaches, and where it
//! stalls for lack of bricks.
//!
//! A worker draws the parts of a tile one after another. Each part stops before the first sheet
//! that lacks a brick; the worker then sets the tile aside until the bricks it asked for have come
//! (`render::region`). A trace says when drawing came to each brick. So virtual workers and
//! rehearsing ones stall at the same sheets as real ones and ask for the same bricks.
//!
//! Times are nanoseconds of one core. This module refuses to know who holds which bricks and what
//! time it is.

use crate::{FrameTrace, RegionTile};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::{enclosing_square, parts};
use slabcast_common::view::Projected;

/// Pixels by which the footprints of a tile reach beyond it, both sides together. Tiles of 32
/// pixels take 1.24 times as long as those of 64 (mri256 `peer-semi` at 1024x1024).
const BORDER_PIXELS: f64 = 8.2;

/// Bound of the rounding error of summed times, in nanoseconds.
const ROUNDING_NS: f64 = 0.5;

/// Returns the rectangle and the sheets of the brick at a place of its set's list; `None` if the
/// frame does not see it.
pub type ProjectBrick<'a> = &'a dyn Fn(u32) -> Option<Projected>;

/// Returns whether the worker holds the brick at a place of its set's list.
pub type HasBrick<'a> = &'a dyn Fn(u32) -> bool;

/// A brick that a part is drawn from.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Need {
    /// Nanoseconds of the part's drawing before it.
    after_ns: f64,
    /// Place of the brick in the set's list.
    place: u32,
}

/// Progress of one part of a tile.
#[derive(Clone, Debug, PartialEq)]
struct Part {
    rect: Rect,
    total_ns: f64,
    done_ns: f64,
    /// In the order in which drawing comes to them.
    needs: Vec<Need>,
}

impl Part {
    fn next_missing(&self, has: HasBrick<'_>) -> Option<&Need> {
        let past = self.needs.partition_point(|n| n.after_ns < self.done_ns);
        self.needs[past..].iter().find(|n| !has(n.place))
    }

    /// The time into the part at which it stops.
    fn stops_at_ns(&self, has: HasBrick<'_>) -> f64 {
        self.next_missing(has).map_or(self.total_ns, |n| n.after_ns)
    }

    fn left_ns(&self) -> f64 {
        self.total_ns - self.done_ns
    }

    /// The part's share of a piece of the tile, `None` if it has none. A pixel of the piece takes
    /// `slowdown` times as long.
    fn within(&self, piece: &Rect, slowdown: f64, project: ProjectBrick<'_>) -> Option<Part> {
        let rect = self.rect.intersect(piece);
        if rect.is_empty() {
            return None;
        }
        let share = if rect == self.rect {
            slowdown
        } else {
            slowdown * rect.area() as f64 / self.rect.area() as f64
        };
        let overlaps = |n: &&Need| {
            let projected = || project(n.place);
            rect == self.rect || projected().is_some_and(|p| !p.rect.intersect(&rect).is_empty())
        };
        let needs = self.needs.iter().filter(overlaps);
        let needs = needs.map(|n| Need { after_ns: share * n.after_ns, ..*n }).collect();
        let (total_ns, done_ns) = (share * self.total_ns, share * self.done_ns);
        Some(Part { rect, total_ns, done_ns, needs })
    }
}

/// Progress of one recorded tile through all its sheets.
///
/// 1. Make one with [`RegionProgress::new`].
/// 2. When a thread takes the tile, call [`RegionProgress::resume`].
/// 3. It draws for [`RegionProgress::runs_ns`]; [`RegionProgress::advance`] follows. Bricks that
///    arrive meanwhile let it run longer.
/// 4. At the end it [is done](RegionProgress::is_done) or asks for
///    [`RegionProgress::missing`] bricks.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionProgress {
    parts: Vec<Part>,
    /// Index of the part that is drawn now.
    current: usize,
}

/// Returns how many times longer a pixel of a piece takes than one of the tile, since the piece is
/// drawn with a border of its own.
fn border_slowdown(piece: &Rect, tile: &Rect) -> f64 {
    let with_border =
        |r: &Rect| (r.width() as f64 + BORDER_PIXELS) * (r.height() as f64 + BORDER_PIXELS);
    with_border(piece) / piece.area() as f64 * tile.area() as f64 / with_border(tile)
}

fn recorded_part(rect: Rect, tile: &RegionTile) -> Part {
    let total_ns = tile.ns as f64;
    let mut needs: Vec<Need> = (tile.touched.iter().enumerate())
        .map(|(i, &place)| {
            let fraction = f64::from(tile.needed.get(i).copied().unwrap_or(0)) / 1000.0;
            // Before the end: a part that is done has come to all its bricks.
            let after_ns = (fraction * total_ns).clamp(0.0, (total_ns - 1.0).max(0.0));
            Need { after_ns, place }
        })
        .collect();
    needs.sort_by(|a, b| a.after_ns.total_cmp(&b.after_ns).then(a.place.cmp(&b.place)));
    Part { rect, total_ns, done_ns: 0.0, needs }
}

/// The first sheet of a brick. A brick that the frame does not see comes before all others.
fn first_sheet(project: ProjectBrick<'_>, place: u32) -> i32 {
    project(place).map_or(i32::MIN, |p| p.sheets.first)
}

impl RegionProgress {
    /// Returns a tile of a picture of `size` pixels before its first sheet; `None` if the trace
    /// knows nothing of it.
    ///
    /// A tile that was not recorded takes its share of the recorded squares of the picture in which
    /// its parts lie.
    pub fn new(
        traced: &FrameTrace,
        tile: &Rect,
        size: [u32; 2],
        project: ProjectBrick<'_>,
    ) -> Option<RegionProgress> {
        let whole = traced.region(tile, size);
        let part = |rect: Rect| {
            if let Some(known) = traced.region(&rect, size) {
                return Some(recorded_part(rect, &known));
            }
            let square = enclosing_square(&rect, size);
            let known = traced.region(&square, size)?;
            recorded_part(square, &known).within(&rect, border_slowdown(&rect, &square), project)
        };
        let known: Option<Vec<Part>> = parts(*tile).map(part).collect();
        let mut parts = match (known, &whole) {
            (Some(parts), _) => parts,
            // Only tiles of this edge were recorded: nobody knows when each brick is needed.
            (None, Some(whole)) => vec![recorded_part(*tile, whole)],
            (None, None) => return None,
        };
        if let (Some(whole), [_, _, ..]) = (&whole, &parts[..]) {
            let sum_ns: f64 = parts.iter().map(|p| p.total_ns).sum();
            let scale = if sum_ns > 0.0 { whole.ns as f64 / sum_ns } else { 0.0 };
            for p in &mut parts {
                p.total_ns *= scale;
                p.needs.iter_mut().for_each(|n| n.after_ns *= scale);
            }
        }
        Some(RegionProgress { parts, current: 0 })
    }

    /// Goes back to the first part: a thread that takes the tile again goes on with parts that
    /// stopped.
    pub fn resume(&mut self) {
        self.current = 0;
    }

    /// Returns for how many nanoseconds drawing goes on from here with the bricks that the worker
    /// `has`.
    pub fn runs_ns(&self, has: HasBrick<'_>) -> f64 {
        self.parts[self.current..].iter().map(|p| p.stops_at_ns(has) - p.done_ns).sum()
    }

    /// Draws for `ns` nanoseconds, or as far as the bricks that the worker `has` allow.
    pub fn advance(&mut self, ns: f64, has: HasBrick<'_>) {
        let mut ns = ns;
        while let Some(p) = self.parts.get_mut(self.current) {
            let stop = p.stops_at_ns(has);
            if ns + ROUNDING_NS < stop - p.done_ns {
                p.done_ns += ns;
                return;
            }
            ns = (ns - (stop - p.done_ns)).max(0.0);
            p.done_ns = stop;
            if ns <= 0.0 {
                // The brick it stops for may come before the next part is begun.
                return;
            }
            self.current += 1;
        }
    }

    /// Returns whether all parts of the tile are drawn.
    pub fn is_done(&self) -> bool {
        self.parts.iter().all(|p| p.done_ns >= p.total_ns)
    }

    /// Returns the places of the bricks that stalled parts lack, up to `ahead_sheets` beyond the
    /// sheet at which each part stopped. Each place is listed once.
    pub fn missing(
        &self,
        has: HasBrick<'_>,
        ahead_sheets: u32,
        project: ProjectBrick<'_>,
    ) -> Vec<u32> {
        let mut missing = Vec::new();
        let sheet = |n: &Need| first_sheet(project, n.place);
        for p in self.parts.iter().filter(|p| p.done_ns < p.total_ns) {
            let Some(first) = p.next_missing(has).filter(|n| n.after_ns <= p.done_ns) else {
                continue;
            };
            let until = sheet(first).saturating_add_unsigned(ahead_sheets);
            for n in p.needs.iter().filter(|n| n.after_ns >= p.done_ns && !has(n.place)) {
                if sheet(n) <= until && !missing.contains(&n.place) {
                    missing.push(n.place);
                }
            }
        }
        missing
    }

    /// Returns the nanoseconds that the whole tile takes.
    pub fn total_ns(&self) -> f64 {
        self.parts.iter().map(|p| p.total_ns).sum()
    }

    /// Returns the nanoseconds of drawing that are left of the tile.
    pub fn left_ns(&self) -> f64 {
        self.parts.iter().map(Part::left_ns).sum()
    }

    /// Returns the nanoseconds that are left in a rectangle.
    pub fn left_in_ns(&self, rect: &Rect) -> f64 {
        let share = |p: &Part| {
            let both = p.rect.intersect(rect);
            let area = if both.is_empty() { 0 } else { both.area() };
            p.left_ns() * area as f64 / p.rect.area() as f64
        };
        self.parts.iter().map(share).sum()
    }

    /// Returns the progress of a rectangle inside `tile`, which this is the progress of.
    pub fn piece(&self, tile: &Rect, piece: &Rect, project: ProjectBrick<'_>) -> RegionProgress {
        let slowdown = border_slowdown(piece, tile);
        let current = self.parts.get(self.current).map(|p| p.rect);
        let within = |p: &Part| p.within(piece, slowdown, project);
        let parts: Vec<Part> = self.parts.iter().filter_map(within).collect();
        let current = current.map_or(parts.len(), |now| {
            let is_later = |p: &Part| (p.rect.y0, p.rect.x0) >= (now.y0, now.x0);
            parts.iter().position(is_later).unwrap_or(parts.len())
        });
        RegionProgress { parts, current }
    }

    /// Returns, for each part of `tile`, which this is the progress of, the sheet before which it
    /// stands; `None` for a part that is done.
    pub fn next_sheets(&self, tile: Rect, project: ProjectBrick<'_>) -> Vec<Option<i32>> {
        let next_sheet = |rect: Rect| {
            let p = self.parts.iter().find(|p| !p.rect.intersect(&rect).is_empty())?;
            let next = p.needs.iter().find(|n| n.after_ns >= p.done_ns).or(p.needs.last());
            (p.done_ns < p.total_ns).then(|| next.map_or(0, |n| first_sheet(project, n.place)))
        };
        parts(tile).map(next_sheet).collect()
    }

    /// Returns the places of the bricks that drawing has not come to, ascending.
    pub fn upcoming(&self) -> Vec<u32> {
        let upcoming = |p: &Part| {
            let done_ns = p.done_ns;
            let later = p.needs.iter().filter(move |n| n.after_ns >= done_ns);
            later.map(|n| n.place).collect::<Vec<_>>()
        };
        let mut places: Vec<u32> = self.parts.iter().flat_map(upcoming).collect();
        places.sort_unstable();
        places.dedup();
        places
    }
}

#[cfg(test)]
mod tests;
