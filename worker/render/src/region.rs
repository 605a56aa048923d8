//! One region of a frame through all its sheets: what workers run under the `region` schedule.
//!
//! A worker knows every brick of the volume by the *directory* (tight boxes, some twenty bytes a
//! brick) and holds some of them. So it can tell by itself which bricks a region needs next, and
//! culling need not wait for slabs: a brick is asked for at the sheet at which it begins, and only
//! if it may touch a pixel that is open there. What hides it is then drawn already.
//!
//! ```text
//! VisibleBricks::new       the directory as a frame sees it: once a frame
//! Region::new        a tile before its first sheet
//! expected           what it will ask for, if the frame before tells: it can be asked for before the tile is begun
//! Region::advance    to the end, or to the first sheet that lacks a brick
//!   .. names the bricks that it lacks there and a little farther; others render meanwhile
//! Region::advance    from that sheet on
//! Region::split_off  where it stands: somebody else draws a piece of it from there
//! Region::resume      that one's, before he draws
//! Region::finish     pixels, counts, and which bricks it touched
//! ```
//!
//! **Why stopping changes no byte.** It is a cut between two slabs, made where it is needed: opacity
//! and the last sheet's raw sums are kept, colour adds up in integers, and voxels that straddle the
//! cut are tossed again ([`crate::tile`]). Where nothing is lacked there is no cut, and a region
//! costs what a tile of one slab costs.

use crate::kernels::Simd;
pub use crate::part::brick_feed::BrickSupply;
use crate::part::brick_feed::{Coming, Memory};
use crate::part::{Among, Io, Part};
use crate::scene::Frame;
use crate::tile::Scratch;
use crate::visibility::closing_depth::{Cells, ClosingDepths};
use crate::visibility::visible_bricks::{VisibleBrick, VisibleBricks};
use slabcast_common::image::{LEAF_EDGE, TilePixels};
use slabcast_common::message::{Checkpoint, Counters};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::{parts, split_tile};

/// What a part is drawn from.
#[derive(Clone, Copy)]
struct From<'a> {
    frame: &'a Frame,
    simd: Simd,
    outlook: &'a VisibleBricks,
    supply: &'a dyn BrickSupply,
    /// Sheets beyond one that lacks a brick that are looked at.
    ahead: u32,
}

/// How a part went.
struct Went {
    /// The sheet before which it stopped for what it lacks.
    stop: Option<i32>,
    lacks: Vec<u32>,
    cells: Cells,
}

/// Draws the sheets of a part of `tile` from `at` on, as far as bricks are here; `came` is told the places
/// of those that it took.
fn go_through(
    from: From<'_>,
    (tile, rect, at, cells): (Rect, Rect, i32, Cells),
    scratch: &mut Scratch,
    io: Io<'_>,
    mut came: impl FnMut(u32),
) -> Went {
    let From { frame, simd, outlook, supply, ahead } = from;
    let mut memory = std::mem::take(&mut scratch.coming);
    let Memory { waiting, taken } = &mut memory;
    let (seen, place) = ((frame, outlook, supply), (rect, at, ahead));
    let coming = Coming::new(seen, place, std::mem::take(waiting), taken);
    coming.cells.replace(cells);
    if let Some(nearest) = coming.nearest {
        let mut slab = coming.slab;
        if at == outlook.sheets().first {
            // Nothing is drawn yet, and nothing lies before the first brick.
            slab.first = nearest.max(at);
        }
        let among = Among::Coming(&coming);
        Part { frame, rect, tile, slab, among, inside: &[] }.draw(simd, scratch, io);
    }
    let mut cells = coming.cells.take();
    let (stop, last) = (coming.stop.get(), coming.last.get());
    if stop.is_none() && last + 1 < coming.slab.end {
        // It ended before its last sheet: nothing was open any more.
        cells.shut(last + 1);
    }
    let went = Went { stop, lacks: coming.lacks.take(), cells };
    *waiting = coming.waiting.into_inner();
    taken.iter().for_each(|t| came(t.place));
    taken.clear();
    scratch.coming = memory;
    went
}

/// Draws a tile whose bricks are all here through all sheets, into the pixels of another, whose memory
/// it takes over: once that and scratch have grown, nothing is allocated (`tests/allocations.rs`).
///
/// # Panics
/// If a brick is not here.
pub fn draw(
    frame: &Frame,
    outlook: &VisibleBricks,
    supply: &dyn BrickSupply,
    simd: Simd,
    tile: Rect,
    scratch: &mut Scratch,
    out: &mut TilePixels,
) -> Counters {
    out.a.clear();
    out.a.resize(tile.area(), 0.0);
    out.colour.clear();
    out.colour.resize(tile.area(), [0; 3]);
    out.last = None;
    let mut counted = Counters::default();
    let from = From { frame, simd, outlook, supply, ahead: 0 };
    for rect in parts(tile) {
        let at = (tile, rect, outlook.sheets().first, Cells::default());
        let went = go_through(from, at, scratch, (&mut *out, &mut counted), |_| ());
        assert!(went.stop.is_none(), "a brick is not here");
    }
    counted
}

/// A part of a region.
#[derive(Clone, Copy, Debug)]
struct Strand {
    rect: Rect,
    /// The next sheet to draw.
    at: i32,
    /// How deep it is open.
    cells: Cells,
}

/// A tile on its way through the sheets of a frame.
#[derive(Debug)]
pub struct Region {
    tile: Rect,
    /// Parts that have not come to an end.
    open: Vec<Strand>,
    pixels: TilePixels,
    counters: Counters,
    /// Places of bricks that were drawn, some of them twice.
    touched: Vec<u32>,
    /// How deep parts were open that are at their end.
    depths: Vec<(Rect, Cells)>,
}

/// A region that came to its end.
#[derive(Debug)]
pub struct FinishedRegion {
    /// Its pixels. Sums of a last sheet are not among them: nobody goes on from there.
    pub pixels: TilePixels,
    /// Its voxels.
    pub counters: Counters,
    /// Places in the directory of the bricks that it touched, ascending.
    pub touched: Vec<u32>,
    depths: Vec<(Rect, Cells)>,
}

impl FinishedRegion {
    /// Tells the next frame how deep it was open.
    pub fn record_depths(&self, depths: &ClosingDepths) {
        self.depths.iter().for_each(|(part, cells)| depths.note(part, cells));
    }
}

/// What a region that is not begun will ask for, if its frame is as deep as those of `depths`: places in the directory of
/// bricks that are not here, ascending. Nothing of what nobody knows about. Where nothing is culled, it is all that lies over it.
pub fn expected_bricks(
    frame: &Frame,
    outlook: &VisibleBricks,
    supply: &dyn BrickSupply,
    tile: Rect,
    depths: &ClosingDepths,
) -> Vec<u32> {
    let all = !frame.scene.quality.cull;
    let expects = |r: &Rect, first| !r.is_empty() && (all || depths.expects(r, first));
    let mut places = Vec::new();
    for part in parts(tile) {
        let deepest = if all { i32::MAX } else { depths.deepest(&part) };
        for &i in outlook.over(part.x0, part.y0) {
            let projected = &outlook.block(i).projected;
            if projected.sheets.first > deepest {
                break;
            }
            let rect = projected.rect.intersect(&part);
            if !expects(&rect, projected.sheets.first) {
                continue;
            }
            for &VisibleBrick { projected, place, .. } in outlook.bricks(i) {
                let rect = projected.rect.intersect(&part);
                if expects(&rect, projected.sheets.first) && !supply.has(place) {
                    places.push(place);
                }
            }
        }
    }
    places.sort_unstable();
    places.dedup();
    places
}

impl Region {
    /// `tile`, which lies inside the picture, before the first sheet.
    pub fn new(outlook: &VisibleBricks, tile: Rect) -> Region {
        let at = outlook.sheets().first;
        let cells = Cells::default();
        let open = parts(tile).map(|rect| Strand { rect, at, cells }).collect();
        let n = tile.area();
        let pixels = TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: None };
        let (counters, touched, depths) = Default::default();
        Region { tile, open, pixels, counters, touched, depths }
    }

    /// Its tile.
    pub fn tile(&self) -> Rect {
        self.tile
    }

    /// How far it has come: sheets that its parts are past, summed over those that are not at their
    /// end. `None`: it is at its end.
    pub fn depth(&self) -> Option<(usize, i64)> {
        let left = self.open.len();
        (left > 0).then(|| (left, self.open.iter().map(|s| i64::from(s.at)).sum()))
    }

    /// `tile`, as somebody else left it.
    ///
    /// # Errors
    /// In words, where it can't have been left so.
    pub fn resume(
        outlook: &VisibleBricks,
        tile: Rect,
        begun: &Checkpoint,
    ) -> Result<Region, &'static str> {
        let (n, pixels) = (tile.area(), &begun.pixels);
        let last = pixels.last.as_ref().is_none_or(|last| last.len() == n);
        if pixels.a.len() != n || pixels.colour.len() != n || !last {
            return Err("its planes do not have the tile's size");
        }
        if begun.sheets.len() != parts(tile).count() {
            return Err("it does not have as many sheets as its tile has parts");
        }
        let all = outlook.sheets();
        if begun.sheets.iter().flatten().any(|at| !(all.first..=all.end).contains(at)) {
            return Err("its sheets are not the frame's");
        }
        let open = parts(tile).zip(&begun.sheets);
        let cells = Cells::default();
        let strand = |(rect, at): (Rect, &Option<i32>)| Some(Strand { rect, at: (*at)?, cells });
        let open = open.filter_map(strand).collect();
        let pixels = pixels.clone();
        let (counters, touched, depths) = Default::default();
        Ok(Region { tile, open, pixels, counters, touched, depths })
    }

    /// Gives away about `share` of what is left: what it keeps of its tile, what it gives, and how that stands.
    /// `None`: it can't be cut. What is left is told by open pixels and by sheets.
    pub fn split_off(
        &mut self,
        outlook: &VisibleBricks,
        eps: f64,
        share: f64,
    ) -> Option<(Rect, Rect, Checkpoint)> {
        let (tile, all) = (self.tile, outlook.sheets());
        let mut leaves = Leaves::new(tile);
        for strand in &self.open {
            let todo = f64::from((all.end - strand.at).max(1)) / f64::from(all.len().max(1));
            leaves.add(&strand.rect, |i| {
                let shut = eps > 0.0 && (1.0f32 - self.pixels.a[i]) < eps as f32;
                if shut { 0.0 } else { todo }
            });
        }
        let (kept, given) = split_tile(tile, share, |r| leaves.sum(r))?;
        let at = |rect: Rect| {
            let on = self.open.iter().find(|s| !s.rect.intersect(&rect).is_empty());
            on.map(|s| s.at)
        };
        let sheets = parts(given).map(at).collect();
        let begun = Checkpoint { sheets, pixels: self.pixels.crop(tile, given) };
        for strand in &mut self.open {
            let rect = strand.rect.intersect(&kept);
            if rect != strand.rect {
                // They are counted from its corner, and seen again.
                (strand.rect, strand.cells) = (rect, Cells::default());
            }
        }
        self.open.retain(|s| !s.rect.is_empty());
        self.pixels = self.pixels.crop(tile, kept);
        self.tile = kept;
        Some((kept, given, begun))
    }

    /// Goes as far as bricks are here. What it lacks to go farther, by places in the directory and
    /// without repetition: those that begin at the sheets at which its parts stand still, and those
    /// of `ahead` sheets more that are not hidden by what is drawn already. Nothing: it is at its end, or its supply
    /// [stops](BrickSupply::stops) it.
    pub fn advance(
        &mut self,
        frame: &Frame,
        simd: Simd,
        outlook: &VisibleBricks,
        supply: &dyn BrickSupply,
        ahead: u32,
        scratch: &mut Scratch,
    ) -> Vec<u32> {
        loop {
            let lacks = self.go(frame, simd, outlook, supply, ahead, scratch);
            // What was lacked may have come while the list was made.
            if self.open.is_empty() || !lacks.is_empty() || supply.stops() {
                return lacks;
            }
        }
    }

    fn go(
        &mut self,
        frame: &Frame,
        simd: Simd,
        outlook: &VisibleBricks,
        supply: &dyn BrickSupply,
        ahead: u32,
        scratch: &mut Scratch,
    ) -> Vec<u32> {
        let mut lacks = Vec::new();
        let mut open = std::mem::take(&mut self.open);
        let several = open.len() > 1;
        let from = From { frame, simd, outlook, supply, ahead };
        open.retain_mut(|strand| {
            let at = (self.tile, strand.rect, strand.at, strand.cells);
            let io = (&mut self.pixels, &mut self.counters);
            let touched = |place| self.touched.push(place);
            let went = go_through(from, at, scratch, io, touched);
            lacks.extend(went.lacks);
            strand.at = went.stop.unwrap_or(strand.at);
            strand.cells = went.cells;
            if went.stop.is_none() {
                self.depths.push((strand.rect, went.cells));
            }
            went.stop.is_some()
        });
        self.open = open;
        if several {
            // Parts lack the same brick; the first to name it says how urgent it is.
            let mut named = std::collections::BTreeSet::new();
            lacks.retain(|&place| named.insert(place));
        }
        lacks
    }

    /// Ends it, at its end or before.
    pub fn finish(self) -> FinishedRegion {
        let Region { mut pixels, counters, mut touched, depths, .. } = self;
        touched.sort_unstable();
        touched.dedup();
        pixels.last = None;
        FinishedRegion { pixels, counters, touched, depths }
    }
}

/// What is left to do in each leaf of a tile.
struct Leaves {
    tile: Rect,
    left: Vec<f64>,
}

impl Leaves {
    fn new(tile: Rect) -> Leaves {
        let mut leaves = Leaves { tile, left: Vec::new() };
        let [columns, rows] = leaves.of(tile.x1 - 1, tile.y1 - 1).map(|n| n + 1);
        leaves.left.resize(columns * rows, 0.0);
        leaves
    }

    /// Column and row of the leaf that a pixel lies in.
    fn of(&self, x: i32, y: i32) -> [usize; 2] {
        let leaf =
            |at: i32, first: i32| (at / LEAF_EDGE as i32 - first / LEAF_EDGE as i32) as usize;
        [leaf(x, self.tile.x0), leaf(y, self.tile.y0)]
    }

    fn columns(&self) -> usize {
        self.of(self.tile.x1 - 1, self.tile.y0)[0] + 1
    }

    /// Adds what is left of each pixel of a rectangle, by its place in the tile.
    fn add(&mut self, rect: &Rect, todo: impl Fn(usize) -> f64) {
        let (columns, width) = (self.columns(), self.tile.width());
        for y in rect.y0..rect.y1 {
            for x in rect.x0..rect.x1 {
                let i = (y - self.tile.y0) as usize * width + (x - self.tile.x0) as usize;
                let [column, row] = self.of(x, y);
                self.left[row * columns + column] += todo(i);
            }
        }
    }

    /// What is left in a rectangle of whole leaves.
    fn sum(&self, rect: &Rect) -> f64 {
        let columns = self.columns();
        let ([x0, y0], [x1, y1]) = (self.of(rect.x0, rect.y0), self.of(rect.x1 - 1, rect.y1 - 1));
        let rows = self.left.chunks(columns).take(y1 + 1).skip(y0);
        rows.map(|row| row[x0..=x1].iter().sum::<f64>()).sum()
    }
}
