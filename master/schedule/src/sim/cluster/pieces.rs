//! Pieces of regions that virtual workers give away (`frame::handover`): what a trace of whole tiles says of them.

use super::{Coming, Nanos, Running, SMALL, Task, World};
use crate::Event;
use slabcast_common::ids::{Epoch, FrameId, TaskId, WorkerId};
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Begun, HandedOver};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::{PART, cut, parts};
use slabcast_common::trace::{FrameTrace, RegionTile, Trace};
use std::borrow::Cow;

/// A piece of a region that was given away: what it takes yet, and which bricks it needs.
pub(super) struct Piece {
    ns: u64,
    pub(super) touched: Vec<u32>,
}

/// How far a tile's footprints reach beyond it on both sides together, in pixels: tiles of 32 pixels take 1.24 times what
/// those of 64 do (mri256 `peer-semi` at 1024x1024).
const BORDER: f64 = 8.2;

/// Bytes of a piece's state: an opacity, three colours and four sums a pixel.
pub(super) fn state_bytes(pixels: &TilePixels) -> u64 {
    // Of one that nothing was drawn into there are none.
    let words = if pixels.last.is_some() { 32 } else { 0 };
    SMALL + words * pixels.a.len() as u64
}

fn corners(r: &Rect) -> [i32; 4] {
    [r.x0, r.y0, r.x1, r.y1]
}

/// The square of the picture that a part of a tile lies in.
fn square_of(part: &Rect, size: [u32; 2]) -> Rect {
    let at = |x: i32| x.div_euclid(PART) * PART;
    let (x0, y0) = (at(part.x0), at(part.y0));
    Rect::new(x0, y0, x0 + PART, y0 + PART).intersect(&Rect::of_size(size))
}

/// How many times longer a piece takes than its share of a tile: it is drawn with a border of its own.
fn more(piece: &Rect, tile: &Rect) -> f64 {
    let border = |r: &Rect| (r.width() as f64 + BORDER) * (r.height() as f64 + BORDER);
    border(piece) / piece.area() as f64 * tile.area() as f64 / border(tile)
}

/// What a part of a tile takes, as far as that is known.
fn takes_of(traced: &FrameTrace, part: &Rect, size: [u32; 2]) -> f64 {
    let whole = square_of(part, size);
    let ns = |r: &Rect| traced.region(r, size).map(|t| t.ns as f64);
    let share = part.area() as f64 / whole.area() as f64;
    ns(part).or_else(|| Some(share * ns(&whole)?)).unwrap_or(part.area() as f64).max(1.0)
}

/// A part of a tile that is being drawn: what it takes in all, and what is left of that.
struct PartLeft {
    rect: Rect,
    ns: f64,
    left: f64,
}

impl PartLeft {
    /// What is left of it in a piece of the tile.
    fn within(&self, piece: &Rect) -> f64 {
        let both = self.rect.intersect(piece);
        let area = if both.is_empty() { 0 } else { both.area() };
        self.left * area as f64 / self.rect.area() as f64
    }
}

/// The parts of a tile of which so much is left in all: they are drawn one after the other.
fn left_of(traced: &FrameTrace, tile: &Rect, size: [u32; 2], left: f64) -> Vec<PartLeft> {
    let takes: Vec<_> = parts(*tile).map(|p| (p, takes_of(traced, &p, size))).collect();
    let mut gone = (1.0 - left) * takes.iter().map(|t| t.1).sum::<f64>();
    let part = |(rect, ns): (Rect, f64)| {
        let here = gone.clamp(0.0, ns);
        gone -= here;
        PartLeft { rect, ns, left: ns - here }
    };
    takes.into_iter().map(part).collect()
}

impl<'a> World<'a> {
    /// A piece that was given away, or what is left of one of which pieces were, and what it takes.
    pub(super) fn piece_of(&self, frame: FrameId, tile: &Rect) -> Option<(u64, &Piece)> {
        let of_frame = (frame, [i32::MIN; 4])..=(frame, [i32::MAX; 4]);
        let around = self.pieces.range(of_frame).filter_map(|((_, [x0, y0, x1, y1]), piece)| {
            let whole = Rect::new(*x0, *y0, *x1, *y1);
            (whole.union(tile) == whole).then_some((whole, piece))
        });
        let (whole, piece) = around.min_by_key(|(whole, _)| whole.area())?;
        let share = tile.area() as f64 / whole.area() as f64 * more(tile, &whole);
        Some(((piece.ns as f64 * share) as u64, piece))
    }

    /// What a region takes from its first sheet on. Of one of which pieces were given away, what its parts say.
    pub(super) fn whole_region(&self, tile: Rect, frame: usize) -> Option<Cow<'a, RegionTile>> {
        let trace: &'a Trace = self.trace;
        let (traced, size) = (&trace.frames[frame], trace.about.size);
        if let Some(region) = traced.region(&tile, size) {
            return Some(region);
        }
        let job = &self.jobs[frame];
        let over = |place: &u32| {
            let seen = job.view.project(&job.bricks[*place as usize].tight);
            seen.is_some_and(|p| !p.rect.intersect(&tile).is_empty())
        };
        let mut all = RegionTile { x: tile.x0 as u32, y: tile.y0 as u32, ..RegionTile::default() };
        for part in parts(tile) {
            let square = square_of(&part, size);
            let whole = traced.region(&square, size)?;
            all.ns += (takes_of(traced, &part, size) * more(&part, &square)) as u64;
            all.touched.extend(whole.touched.iter().copied().filter(over));
            all.opened.extend_from_slice(&whole.opened);
        }
        all.result_bytes = 3 * tile.area() as u32;
        for list in [&mut all.touched, &mut all.opened] {
            list.sort_unstable();
            list.dedup();
        }
        Some(Cow::Owned(all))
    }

    /// A worker cuts what is left of a region in two, as `render::region` does: by parts that it has not come to, and by
    /// sheets of the one that it is at.
    pub(super) fn hand_over(&mut self, id: WorkerId, name: (TaskId, Epoch), share: f64, at: Nanos) {
        let size = self.trace.about.size;
        let w = self.workers.get_mut(&id).expect("a worker stays");
        let drawn = |r: &Option<Running<'_>>| r.as_ref().is_some_and(|r| r.lease.name() == name);
        let Some(thread) = w.running.iter().position(drawn) else {
            self.hand_over_whole(id, name, share, at);
            return;
        };
        let Some(r) = &mut w.running[thread] else { return };
        let Task::Region(lease) = &mut r.lease else { return };
        let frame = lease.frame;
        let traced = &self.trace.frames[frame.0 as usize - 1];
        let begun = r.start + r.tables + r.blocks;
        let to_go = r.end.saturating_sub(at.max(begun)) as f64;
        let all = r.end.saturating_sub(begun).max(1) as f64;
        let left = left_of(traced, &lease.tile, size, to_go / all);
        let of = |piece: &Rect| left.iter().map(|part| part.within(piece)).sum::<f64>();
        let Some((kept, given)) = cut(lease.tile, share, of) else { return };
        let [here, there] = [kept, given]
            .map(|piece| to_go * of(&piece) / of(&lease.tile).max(1.0) * more(&piece, &lease.tile));
        // Its bricks, front to back, but for those that are drawn.
        let job = &self.jobs[frame.0 as usize - 1];
        let mut deep: Vec<(i32, u32)> = Vec::new();
        for &place in &r.region.touched {
            let seen = job.view.project(&job.bricks[place as usize].tight);
            if let Some(p) = seen.filter(|p| !p.rect.intersect(&given).is_empty()) {
                deep.push((p.sheets.end, place));
            }
        }
        deep.sort_unstable();
        let of_part = |part: Rect| left.iter().find(|l| !l.rect.intersect(&part).is_empty());
        let gone = |part| of_part(part).map_or(1.0, |l| 1.0 - l.left / l.ns);
        let gone = parts(given).map(gone).fold(1.0, f64::min);
        let past = ((gone * deep.len() as f64) as usize).min(deep.len());
        let sheet = deep.get(past).map_or(0, |d| d.0 - 1);
        let mut touched: Vec<u32> = deep[past..].iter().map(|d| d.1).collect();
        touched.sort_unstable();
        let n = given.area();
        let pixels =
            TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: Some(vec![[0; 4]; n]) };
        let on = |part| of_part(part).is_some_and(|l| l.left > 0.0).then_some(sheet);
        let begun = Begun { sheets: parts(given).map(on).collect(), pixels };
        r.result_bytes = r.result_bytes * kept.area() as u64 / lease.tile.area() as u64;
        lease.tile = kept;
        let outcome = &mut self.outcome.frames[frame.0 as usize - 1];
        outcome.render -= r.end - r.start;
        r.end = at + here as Nanos;
        outcome.render += r.end - r.start;
        r.pixels = r.end;
        self.order += 1;
        r.ends = self.order;
        let (end, ends) = (r.end, r.ends);
        self.later(end, Coming::TaskEnd(id, thread, ends));
        let ns = (there / self.cluster.stretch) as u64;
        self.give(id, (frame, name), (kept, given), (begun, Piece { ns, touched }), at);
    }

    /// The same of a region that lies there, or stands still before its first sheet.
    fn hand_over_whole(&mut self, id: WorkerId, name: (TaskId, Epoch), share: f64, at: Nanos) {
        let size = self.trace.about.size;
        let waits = |(l, _): &(Task, Nanos)| l.name() == name;
        let Some(i) = self.workers[&id].leases.iter().position(waits) else { return };
        let Task::Region(lease) = &self.workers[&id].leases[i].0 else { return };
        if lease.begun.is_some() {
            return;
        }
        let (frame, tile) = (lease.frame, lease.tile);
        let traced = &self.trace.frames[frame.0 as usize - 1];
        let of = |piece: &Rect| parts(*piece).map(|p| takes_of(traced, &p, size)).sum::<f64>();
        let Some((kept, given)) = cut(tile, share, of) else { return };
        let Some(whole) = self.whole_region(given, frame.0 as usize - 1) else { return };
        let piece = Piece { ns: whole.ns, touched: whole.touched.clone() };
        let n = given.area();
        let pixels = TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: None };
        let job = &self.jobs[frame.0 as usize - 1];
        let seen = |&p: &u32| job.view.project(&job.bricks[p as usize].tight);
        let first = piece.touched.iter().filter_map(seen).map(|p| p.sheets.first).min();
        let sheets = parts(given).map(|_| Some(first.unwrap_or(0))).collect();
        let w = self.workers.get_mut(&id).expect("a worker stays");
        if let Task::Region(lease) = &mut w.leases[i].0 {
            lease.tile = kept;
        }
        self.give(id, (frame, name), (kept, given), (Begun { sheets, pixels }, piece), at);
    }

    fn give(
        &mut self,
        id: WorkerId,
        (frame, (task, epoch)): (FrameId, (TaskId, Epoch)),
        (kept, given): (Rect, Rect),
        (begun, piece): (Begun, Piece),
        at: Nanos,
    ) {
        self.outcome.frames[frame.0 as usize - 1].handed_over += 1;
        self.pieces.insert((frame, corners(&given)), piece);
        let bytes = state_bytes(&begun.pixels);
        let piece = Box::new(HandedOver { task, epoch, kept, given, begun });
        self.up(id, Event::HandedOver { worker: id, piece }, bytes, at);
    }
}
