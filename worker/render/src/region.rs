//! One region of a frame through all its sheets: what workers run under the `region` schedule.
//!
//! A worker knows every brick of the volume by the *directory* (tight boxes, some twenty bytes a
//! brick) and holds some of them. So it can tell by itself which bricks a region needs next, and
//! culling need not wait for slabs: a brick is asked for at the sheet at which it begins, and only
//! if it may touch a pixel that is open there. Whatever hides it is drawn by then.
//!
//! ```text
//! VisibleBricks::new     once a frame: the directory, projected
//! Region::new            a tile before its first sheet
//! expected_bricks        bricks it will probably need, by the previous frame: to prefetch
//! Region::advance        draws to the end, or to the first sheet with a missing brick
//!   .. returns the bricks missing there and a little farther; other regions draw meanwhile
//! Region::advance        draws on from that sheet
//! Region::split_off      work stealing: cuts a piece off, which another worker draws on
//! Region::resume         the piece at that other worker
//! Region::finish         pixels, counters, and the bricks that were drawn
//! ```
//!
//! **Why stopping changes no byte.** A stop is a cut between two slabs, made where it is needed:
//! opacity and the last sheet's raw sums are kept, colour adds up in integers, and voxels that
//! straddle the cut are tossed again ([`crate::tile`]). Where nothing is missing there is no cut,
//! and a region costs what a tile of one slab costs.

use crate::kernels::Simd;
pub use crate::part::brick_feed::BrickSupply;
use crate::part::brick_feed::{ArrivingBricks, FeedMemory};
use crate::part::{BrickSource, Io, Part};
use crate::scene::Frame;
use crate::tile::Scratch;
use crate::visibility::closing_depth::{Cells, ClosingDepths};
use crate::visibility::visible_bricks::{VisibleBrick, VisibleBricks};
use slabcast_common::image::{LEAF_EDGE, TilePixels};
use slabcast_common::message::{Checkpoint, Counters};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::{parts, split_tile};

/// Arguments that all parts of a region are drawn with.
#[derive(Clone, Copy)]
struct DrawContext<'a> {
    frame: &'a Frame,
    simd: Simd,
    visible: &'a VisibleBricks,
    supply: &'a dyn BrickSupply,
    /// Sheets behind the one where a brick is missing in which missing bricks are listed as well.
    ahead: u32,
}

/// Progress of drawing a part.
struct PartProgress {
    /// The sheet before which it stopped; `None` if it was drawn to its end.
    stop: Option<i32>,
    missing: Vec<u32>,
    cells: Cells,
}

/// Draws `part` of `tile` as far as its bricks are held; `took` gets the directory index of each
/// brick that was drawn.
fn draw_part(
    context: DrawContext<'_>,
    tile: Rect,
    part: OpenPart,
    scratch: &mut Scratch,
    io: Io<'_>,
    mut took: impl FnMut(u32),
) -> PartProgress {
    let DrawContext { frame, simd, visible, supply, ahead } = context;
    let OpenPart { rect, next_sheet, cells } = part;
    let mut memory = std::mem::take(&mut scratch.feed);
    let FeedMemory { waiting, taken } = &mut memory;
    let waiting_bricks = std::mem::take(waiting);
    let arriving =
        ArrivingBricks::new(frame, visible, supply, rect, next_sheet, ahead, waiting_bricks, taken);
    arriving.cells.replace(cells);
    if let Some(nearest) = arriving.nearest {
        let mut slab = arriving.slab;
        if next_sheet == visible.sheets().first {
            // Nothing is drawn yet, and nothing lies before the first brick.
            slab.first = nearest.max(next_sheet);
        }
        let bricks = BrickSource::Arriving(&arriving);
        Part { frame, rect, tile, slab, bricks, inside: &[] }.draw(simd, scratch, io);
    }
    let mut cells = arriving.cells.take();
    let (stop, last) = (arriving.stop.get(), arriving.last.get());
    if stop.is_none() && last + 1 < arriving.slab.end {
        // It ended before its last sheet: nothing was open any more.
        cells.shut(last + 1);
    }
    let progress = PartProgress { stop, missing: arriving.missing.take(), cells };
    *waiting = arriving.waiting.into_inner();
    taken.iter().for_each(|t| took(t.place));
    taken.clear();
    scratch.feed = memory;
    progress
}

/// Draws `tile` through all sheets of its frame, into `out`, whose memory is reused: once it and
/// `scratch` have grown, nothing is allocated (`tests/allocations.rs`). Returns the voxel counts.
///
/// # Panics
/// If `supply` lacks a brick that the tile needs.
pub fn draw(
    frame: &Frame,
    visible: &VisibleBricks,
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
    let mut counters = Counters::default();
    let context = DrawContext { frame, simd, visible, supply, ahead: 0 };
    let (next_sheet, cells) = (visible.sheets().first, Cells::default());
    for rect in parts(tile) {
        let part = OpenPart { rect, next_sheet, cells };
        let progress = draw_part(context, tile, part, scratch, (&mut *out, &mut counters), |_| ());
        assert!(progress.stop.is_none(), "a brick is missing");
    }
    counters
}

/// A part of a region that is not drawn to its end.
#[derive(Clone, Copy, Debug)]
struct OpenPart {
    rect: Rect,
    next_sheet: i32,
    /// The sheets at which its cells were shut.
    cells: Cells,
}

/// A tile on its way through all sheets of a frame. Its bricks may arrive while it is drawn.
#[derive(Debug)]
pub struct Region {
    tile: Rect,
    open: Vec<OpenPart>,
    pixels: TilePixels,
    counters: Counters,
    /// Directory indices of bricks that were drawn, with repetitions.
    touched: Vec<u32>,
    /// Sheets at which the cells of finished parts were shut.
    depths: Vec<(Rect, Cells)>,
}

/// Result of a region that is drawn through all depths.
#[derive(Debug)]
pub struct FinishedRegion {
    /// Opacity and light of each pixel of the tile, row-major; without the sums of a last sheet,
    /// since nothing is drawn behind them.
    pub pixels: TilePixels,
    /// Numbers of voxels that were tossed, drawn and culled.
    pub counters: Counters,
    /// Directory indices of the bricks that were drawn, ascending, without repetition.
    pub touched: Vec<u32>,
    depths: Vec<(Rect, Cells)>,
}

impl FinishedRegion {
    /// Records in `depths` the sheets at which the region's cells of 8x8 pixels were shut, from
    /// which [`expected_bricks`] predicts the next frame's bricks.
    pub fn record_depths(&self, depths: &ClosingDepths) {
        self.depths.iter().for_each(|(part, cells)| depths.note(part, cells));
    }
}

/// Returns the bricks to prefetch for `tile`: directory indices, ascending, of bricks that `supply`
/// lacks and that begin in front of the depths at which the previous frame was shut (`depths`). Of
/// pixels that no frame has drawn yet nothing is expected. With culling off these are all missing
/// bricks over the tile.
pub fn expected_bricks(
    frame: &Frame,
    visible: &VisibleBricks,
    supply: &dyn BrickSupply,
    tile: Rect,
    depths: &ClosingDepths,
) -> Vec<u32> {
    let all = !frame.scene.quality.cull;
    let expects = |r: &Rect, first| !r.is_empty() && (all || depths.expects(r, first));
    let mut places = Vec::new();
    for part in parts(tile) {
        let deepest = if all { i32::MAX } else { depths.deepest(&part) };
        for &i in visible.over(part.x0, part.y0) {
            let projected = &visible.block(i).projected;
            if projected.sheets.first > deepest {
                break;
            }
            let rect = projected.rect.intersect(&part);
            if !expects(&rect, projected.sheets.first) {
                continue;
            }
            for &VisibleBrick { projected, place, .. } in visible.bricks(i) {
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

/// Why a region can't be [resumed](Region::resume).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResumeError {
    /// A plane of pixels does not have as many values as the tile has pixels.
    PlaneSize,
    /// There are not as many next sheets as the tile has parts.
    PartCount,
    /// A next sheet lies outside the frame's sheets.
    Sheet,
}

impl std::fmt::Display for ResumeError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            ResumeError::PlaneSize => "its planes do not have the tile's size",
            ResumeError::PartCount => "it does not have as many sheets as its tile has parts",
            ResumeError::Sheet => "its sheets are not the frame's",
        })
    }
}

impl std::error::Error for ResumeError {}

impl Region {
    /// Begins `tile` (pixels of the picture, inside it) before the first sheet.
    pub fn new(visible: &VisibleBricks, tile: Rect) -> Region {
        let (next_sheet, cells) = (visible.sheets().first, Cells::default());
        let open = parts(tile).map(|rect| OpenPart { rect, next_sheet, cells }).collect();
        let n = tile.area();
        let pixels = TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: None };
        let (counters, touched, depths) = Default::default();
        Region { tile, open, pixels, counters, touched, depths }
    }

    /// Returns the region's tile, in pixels of the picture.
    pub fn tile(&self) -> Rect {
        self.tile
    }

    /// Returns how many parts are not at their end, and the sum of their next sheets, which grows
    /// as the region advances; `None` if all parts are at their end.
    pub fn depth(&self) -> Option<(usize, i64)> {
        let left = self.open.len();
        (left > 0).then(|| (left, self.open.iter().map(|part| i64::from(part.next_sheet)).sum()))
    }

    /// Continues `tile` from the state in which another worker gave it away
    /// ([`Region::split_off`]).
    ///
    /// # Errors
    /// [`ResumeError`] if the state does not fit the tile or the frame's sheets.
    pub fn resume(
        visible: &VisibleBricks,
        tile: Rect,
        checkpoint: &Checkpoint,
    ) -> Result<Region, ResumeError> {
        let (n, pixels) = (tile.area(), &checkpoint.pixels);
        let last = pixels.last.as_ref().is_none_or(|last| last.len() == n);
        if pixels.a.len() != n || pixels.colour.len() != n || !last {
            return Err(ResumeError::PlaneSize);
        }
        if checkpoint.sheets.len() != parts(tile).count() {
            return Err(ResumeError::PartCount);
        }
        let all = visible.sheets();
        if checkpoint.sheets.iter().flatten().any(|k| !(all.first..=all.end).contains(k)) {
            return Err(ResumeError::Sheet);
        }
        let cells = Cells::default();
        let part = |(rect, next_sheet): (Rect, &Option<i32>)| {
            Some(OpenPart { rect, next_sheet: (*next_sheet)?, cells })
        };
        let open = parts(tile).zip(&checkpoint.sheets).filter_map(part).collect();
        let pixels = pixels.clone();
        let (counters, touched, depths) = Default::default();
        Ok(Region { tile, open, pixels, counters, touched, depths })
    }

    /// Splits about `share` (0 to 1) of the remaining work off: shrinks the region's tile, and
    /// returns the tile kept, the tile given away and its state. `None` if the tile can't be cut.
    /// Remaining work is counted in open pixels times sheets; `eps` is the transmittance below
    /// which a pixel is shut.
    pub fn split_off(
        &mut self,
        visible: &VisibleBricks,
        eps: f64,
        share: f64,
    ) -> Option<(Rect, Rect, Checkpoint)> {
        let (tile, all) = (self.tile, visible.sheets());
        let mut work = RemainingWork::new(tile);
        for part in &self.open {
            let sheets_left =
                f64::from((all.end - part.next_sheet).max(1)) / f64::from(all.len().max(1));
            work.add(&part.rect, |i| {
                let shut = eps > 0.0 && (1.0f32 - self.pixels.a[i]) < eps as f32;
                if shut { 0.0 } else { sheets_left }
            });
        }
        let (kept, given) = split_tile(tile, share, |r| work.sum(r))?;
        let next_sheet = |rect: Rect| {
            let part = self.open.iter().find(|part| !part.rect.intersect(&rect).is_empty());
            part.map(|part| part.next_sheet)
        };
        let sheets = parts(given).map(next_sheet).collect();
        let checkpoint = Checkpoint { sheets, pixels: self.pixels.crop(tile, given) };
        for part in &mut self.open {
            let rect = part.rect.intersect(&kept);
            if rect != part.rect {
                // Cells are counted from the part's corner; they are looked at again.
                (part.rect, part.cells) = (rect, Cells::default());
            }
        }
        self.open.retain(|part| !part.rect.is_empty());
        self.pixels = self.pixels.crop(tile, kept);
        self.tile = kept;
        Some((kept, given, checkpoint))
    }

    /// Draws as far as bricks are held. Returns the directory indices, without repetition and
    /// nearest first within each part, of the bricks missing to go farther: those that begin at the
    /// sheets at which parts stopped or up to `ahead` sheets behind, and that nothing drawn so far
    /// hides. An empty list means that the region is at its end, or that its supply
    /// [stops](BrickSupply::stops) it.
    pub fn advance(
        &mut self,
        frame: &Frame,
        simd: Simd,
        visible: &VisibleBricks,
        supply: &dyn BrickSupply,
        ahead: u32,
        scratch: &mut Scratch,
    ) -> Vec<u32> {
        loop {
            let missing = self.advance_once(frame, simd, visible, supply, ahead, scratch);
            // Missing bricks may have arrived while the list was made.
            if self.open.is_empty() || !missing.is_empty() || supply.stops() {
                return missing;
            }
        }
    }

    fn advance_once(
        &mut self,
        frame: &Frame,
        simd: Simd,
        visible: &VisibleBricks,
        supply: &dyn BrickSupply,
        ahead: u32,
        scratch: &mut Scratch,
    ) -> Vec<u32> {
        let mut missing = Vec::new();
        let mut open = std::mem::take(&mut self.open);
        let several = open.len() > 1;
        let context = DrawContext { frame, simd, visible, supply, ahead };
        open.retain_mut(|part| {
            let io = (&mut self.pixels, &mut self.counters);
            let took = |place| self.touched.push(place);
            let progress = draw_part(context, self.tile, *part, scratch, io, took);
            missing.extend(progress.missing);
            part.next_sheet = progress.stop.unwrap_or(part.next_sheet);
            part.cells = progress.cells;
            if progress.stop.is_none() {
                self.depths.push((part.rect, progress.cells));
            }
            progress.stop.is_some()
        });
        self.open = open;
        if several {
            // Several parts may lack a brick; the first to name it says how urgent it is.
            let mut named = std::collections::BTreeSet::new();
            missing.retain(|&place| named.insert(place));
        }
        missing
    }

    /// Ends the region, at its end or before, and returns what was drawn.
    pub fn finish(self) -> FinishedRegion {
        let Region { mut pixels, counters, mut touched, depths, .. } = self;
        touched.sort_unstable();
        touched.dedup();
        pixels.last = None;
        FinishedRegion { pixels, counters, touched, depths }
    }
}

/// Remaining work in each leaf (a square of [`LEAF_EDGE`] pixels) of a tile.
struct RemainingWork {
    tile: Rect,
    leaves: Vec<f64>,
}

impl RemainingWork {
    fn new(tile: Rect) -> RemainingWork {
        let mut work = RemainingWork { tile, leaves: Vec::new() };
        let [columns, rows] = work.leaf(tile.x1 - 1, tile.y1 - 1).map(|n| n + 1);
        work.leaves.resize(columns * rows, 0.0);
        work
    }

    /// Column and row of the leaf of pixel (x, y).
    fn leaf(&self, x: i32, y: i32) -> [usize; 2] {
        let leaf =
            |at: i32, first: i32| (at / LEAF_EDGE as i32 - first / LEAF_EDGE as i32) as usize;
        [leaf(x, self.tile.x0), leaf(y, self.tile.y0)]
    }

    fn columns(&self) -> usize {
        self.leaf(self.tile.x1 - 1, self.tile.y0)[0] + 1
    }

    /// Adds the work of each pixel of `rect`, which `work` tells by the pixel's index in the tile.
    fn add(&mut self, rect: &Rect, work: impl Fn(usize) -> f64) {
        let (columns, width) = (self.columns(), self.tile.width());
        for y in rect.y0..rect.y1 {
            for x in rect.x0..rect.x1 {
                let i = (y - self.tile.y0) as usize * width + (x - self.tile.x0) as usize;
                let [column, row] = self.leaf(x, y);
                self.leaves[row * columns + column] += work(i);
            }
        }
    }

    /// The work in a rectangle of whole leaves.
    fn sum(&self, rect: &Rect) -> f64 {
        let columns = self.columns();
        let ([x0, y0], [x1, y1]) =
            (self.leaf(rect.x0, rect.y0), self.leaf(rect.x1 - 1, rect.y1 - 1));
        let rows = self.leaves.chunks(columns).take(y1 + 1).skip(y0);
        rows.map(|row| row[x0..=x1].iter().sum::<f64>()).sum()
    }
}
