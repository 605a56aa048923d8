//! One region of a frame through all its sheets: what workers run under the `region` schedule.
//!
//! A worker knows every brick of the volume by the *directory* (tight boxes, some twenty bytes a
//! brick) and holds some of them. So it can tell by itself which bricks a region needs next, and
//! culling need not wait for slabs: a brick is asked for at the sheet at which it begins, and only
//! if it may touch a pixel that is open there. What hides it is then drawn already.
//!
//! ```text
//! Outlook::new       the directory as a frame sees it: once a frame
//! Region::new        a tile before its first sheet
//! expected           what it will ask for, if the frame before tells: it can be asked for before the tile is begun
//! Region::advance    to the end, or to the first sheet that lacks a brick
//!   .. names the bricks that it lacks there and a little farther; others render meanwhile
//! Region::advance    from that sheet on
//! Region::hand_over  where it stands: somebody else draws a piece of it from there
//! Region::go_on      that one's, before he draws
//! Region::finish     pixels, counts, and which bricks it touched
//! ```
//!
//! **Why stopping changes no byte.** It is a cut between two slabs, made where it is needed: opacity
//! and the last sheet's raw sums are kept, colour adds up in integers, and voxels that straddle the
//! cut are tossed again ([`crate::tile`]). Where nothing is lacked there is no cut, and a region
//! costs what a tile of one slab costs.

use crate::depths::{Cells, Depths, LOOKS};
use crate::mask::OpenMask;
use crate::outlook::{Outlook, Sight};
use crate::scene::{Corner, Frame};
use crate::splat::Simd;
use crate::tile::{Among, Io, Part, Scratch};
use slabcast_common::brick::Brick;
use slabcast_common::image::TilePixels;
use slabcast_common::leaves::LEAF;
use slabcast_common::message::{Begun, Counters};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::{cut, parts};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::Projected;
use std::cell::{Cell, OnceCell, RefCell};
use std::sync::Arc;

/// Where bricks are had from, by their place in the directory.
pub trait Supply {
    /// A brick, if it is here.
    fn get(&self, place: u32) -> Option<Arc<Brick>>;

    /// Whether it is here.
    fn has(&self, place: u32) -> bool {
        self.get(place).is_some()
    }

    /// Whether regions are to stop before the next sheet, whatever is here.
    fn stops(&self) -> bool {
        false
    }
}

/// A brick that a part took.
pub(crate) struct Taken {
    brick: Arc<Brick>,
    corner: Corner,
    place: u32,
    /// Its first sheet.
    first: i32,
}

/// A list that grows while what is in it is looked at. Its memory stays when it is emptied.
pub(crate) struct Growing<T> {
    len: Cell<usize>,
    /// Each twice as long as the one before.
    chunks: [OnceCell<Vec<OnceCell<T>>>; 26],
}

/// Items of the first chunk: what a part of a head takes fits two or three.
const CHUNK: usize = 64;

impl<T> Default for Growing<T> {
    fn default() -> Self {
        Growing { len: Cell::new(0), chunks: [const { OnceCell::new() }; 26] }
    }
}

impl<T> Growing<T> {
    pub(crate) fn len(&self) -> usize {
        self.len.get()
    }

    /// Chunk of an item, and its place there.
    fn place(i: usize) -> (usize, usize) {
        let chunk = (i / CHUNK + 1).ilog2() as usize;
        (chunk, i + CHUNK - (CHUNK << chunk))
    }

    fn push(&self, item: T) {
        let (chunk, at) = Self::place(self.len.replace(self.len.get() + 1));
        let chunk = self.chunks[chunk]
            .get_or_init(|| std::iter::repeat_with(OnceCell::new).take(CHUNK << chunk).collect());
        chunk[at].get_or_init(|| item);
    }

    fn get(&self, i: usize) -> &T {
        let (chunk, at) = Self::place(i);
        let chunk = self.chunks[chunk].get();
        chunk.and_then(|c| c[at].get()).expect("what is in the list")
    }

    fn iter(&self) -> impl Iterator<Item = &T> {
        (0..self.len()).map(|i| self.get(i))
    }

    fn clear(&mut self) {
        let used = self.chunks.iter_mut().filter_map(OnceCell::get_mut).flatten();
        used.take(self.len.replace(0)).for_each(|item| *item = OnceCell::new());
    }
}

/// What a part has before it, by the sheet at which it begins.
#[derive(Default)]
pub(crate) struct Waiting {
    /// The last brick of each sheet, from the first on.
    heads: Vec<u32>,
    bricks: Vec<Waits>,
    /// Voxels of those that wait.
    voxels: u64,
    /// Blocks of the part that were come to.
    blocks: usize,
}

/// A brick of an open block.
#[derive(Clone, Copy)]
struct Waits {
    block: u32,
    /// Its place in the block.
    brick: u32,
    /// Another that begins at the same sheet.
    next: u32,
}

/// No brick.
const NONE: u32 = u32::MAX;

/// Memory that a thread keeps for parts whose bricks come one by one.
#[derive(Default)]
pub(crate) struct Memory {
    waiting: Waiting,
    taken: Growing<Taken>,
}

/// Bricks of a part that come when they are needed.
pub(crate) struct Coming<'a> {
    frame: &'a Frame,
    outlook: &'a Outlook,
    supply: &'a dyn Supply,
    rect: Rect,
    /// Sheets that are left.
    slab: SheetRange,
    /// Blocks over the part, front to back.
    blocks: &'a [u32],
    waiting: RefCell<Waiting>,
    taken: &'a Growing<Taken>,
    /// How many sheets beyond the one at which something is lacked are looked at, too.
    ahead: u32,
    /// The first sheet that could not be drawn.
    stop: Cell<Option<i32>>,
    /// What was lacked: places in the directory, in order of depth.
    lacks: RefCell<Vec<u32>>,
    /// The first sheet that any brick begins at.
    nearest: Option<i32>,
    /// How deep its cells are open, and the last sheet that was come to.
    cells: RefCell<Cells>,
    last: Cell<i32>,
}

impl<'a> Coming<'a> {
    /// What lies over a part's sheets from `at` on.
    fn new(
        (frame, outlook, supply): (&'a Frame, &'a Outlook, &'a dyn Supply),
        (rect, at, ahead): (Rect, i32, u32),
        mut waiting: Waiting,
        taken: &'a Growing<Taken>,
    ) -> Coming<'a> {
        let blocks = outlook.over(rect.x0, rect.y0);
        let ends = blocks.iter().map(|&i| outlook.block(i).projected.sheets.end);
        let slab = SheetRange::new(at, ends.max().unwrap_or(at));
        waiting.heads.clear();
        waiting.heads.resize(slab.len() as usize, NONE);
        waiting.bricks.clear();
        (waiting.voxels, waiting.blocks) = (0, 0);
        let (stop, lacks, nearest, cells) = Default::default();
        let waiting = RefCell::new(waiting);
        let last = Cell::new(at);
        let mut coming = Coming {
            frame,
            outlook,
            supply,
            rect,
            slab,
            blocks,
            waiting,
            taken,
            ahead,
            stop,
            lacks,
            nearest,
            cells,
            last,
        };
        coming.nearest = coming.find_nearest();
        coming
    }

    /// Opens blocks up to the first brick that is left: what hides a block that begins before it would
    /// have begun before it.
    fn find_nearest(&self) -> Option<i32> {
        let waiting = &mut *self.waiting.borrow_mut();
        let mut nearest = i32::MAX;
        while let Some(&i) = self.blocks.get(waiting.blocks)
            && self.outlook.block(i).projected.sheets.first < nearest
        {
            waiting.blocks += 1;
            if self.is_over(&self.outlook.block(i).projected) {
                nearest = nearest.min(self.open(i, self.slab.first, waiting));
            }
        }
        (nearest < i32::MAX).then_some(nearest)
    }

    /// Whether something may lie in the part's sheets.
    fn is_over(&self, p: &Projected) -> bool {
        p.sheets.overlaps(self.slab) && !p.rect.intersect(&self.rect).is_empty()
    }

    fn passes(&self, rect: &Rect, open: &OpenMask) -> bool {
        !self.frame.scene.quality.cull || open.any(rect)
    }

    fn sight(&self, waits: &Waits) -> &'a Sight {
        &self.outlook.bricks(waits.block)[waits.brick as usize]
    }

    /// Has a block's bricks wait for their first sheets, at `k` soonest; the first of these.
    fn open(&self, block: u32, k: i32, waiting: &mut Waiting) -> i32 {
        let mut nearest = i32::MAX;
        for (sight, brick) in self.outlook.bricks(block).iter().zip(0..) {
            if !self.is_over(&sight.projected) {
                continue;
            }
            let first = sight.projected.sheets.first;
            nearest = nearest.min(first);
            let head = &mut waiting.heads[first.max(k).abs_diff(self.slab.first) as usize];
            waiting.bricks.push(Waits { block, brick, next: *head });
            *head = waiting.bricks.len() as u32 - 1;
            waiting.voxels += u64::from(sight.voxels);
        }
        nearest
    }

    /// Voxels of a block that is not opened, as far as it lies over the part: as its rectangle does.
    fn share(&self, block: u32) -> u64 {
        let seen = self.outlook.block(block);
        if !self.is_over(&seen.projected) {
            return 0;
        }
        let rect = seen.projected.rect;
        seen.voxels * rect.intersect(&self.rect).area() as u64 / rect.area() as u64
    }

    /// Opens the blocks that begin at sheet `until` or before and may touch what is open; voxels of the
    /// others.
    fn look(&self, until: i32, k: i32, open: &OpenMask, waiting: &mut Waiting) -> u64 {
        let mut culled = 0;
        while let Some(&i) = self.blocks.get(waiting.blocks) {
            let projected = &self.outlook.block(i).projected;
            if projected.sheets.first > until {
                break;
            }
            waiting.blocks += 1;
            if !self.passes(&projected.rect, open) {
                culled += self.share(i);
            } else if self.is_over(projected) {
                self.open(i, k, waiting);
            }
        }
        culled
    }

    /// Takes the bricks that begin at sheet `k` and may touch what is open; voxels of the others are
    /// culled. If one is not here, notes what is lacked.
    pub(crate) fn is_supplied(&self, k: i32, open: &OpenMask, counters: &mut Counters) -> bool {
        if self.supply.stops() {
            self.stop.set(Some(k));
            return false;
        }
        self.last.set(k);
        if k % LOOKS == 0 {
            self.cells.borrow_mut().look(k, open);
        }
        let waiting = &mut *self.waiting.borrow_mut();
        let mut culled = self.look(k, k, open, waiting);
        let head = k.abs_diff(self.slab.first) as usize;
        let mut next = waiting.heads[head];
        while let Some(waits) = waiting.bricks.get(next as usize) {
            let sight = self.sight(waits);
            let voxels = u64::from(sight.voxels);
            if !self.passes(&sight.projected.rect, open) {
                culled += voxels;
            } else if let Some(brick) = self.supply.get(sight.place) {
                let corner = self.frame.corner(brick.id);
                let (place, first) = (sight.place, sight.projected.sheets.first);
                self.taken.push(Taken { brick, corner, place, first });
            } else {
                self.note(k, open, waiting);
                return false;
            }
            waiting.voxels -= voxels;
            next = waits.next;
        }
        waiting.heads[head] = NONE;
        counters.culled += culled;
        true
    }

    /// Notes what is lacked at sheet `k` and a little farther.
    fn note(&self, k: i32, open: &OpenMask, waiting: &mut Waiting) {
        self.stop.set(Some(k));
        let until = k.saturating_add_unsigned(self.ahead).min(self.slab.end - 1);
        self.look(until, k, open, waiting);
        let mut lacked: Vec<(i32, u32)> = Vec::new();
        for k in k..=until {
            let mut next = waiting.heads[k.abs_diff(self.slab.first) as usize];
            while let Some(waits) = waiting.bricks.get(next as usize) {
                let &Sight { projected, place, .. } = self.sight(waits);
                if self.passes(&projected.rect, open) && !self.supply.has(place) {
                    lacked.push((projected.sheets.first, place));
                }
                next = waits.next;
            }
        }
        lacked.sort_unstable();
        self.lacks.borrow_mut().extend(lacked.into_iter().map(|(_, place)| place));
    }

    /// The first sheet that any of its bricks begins at; `None`: nothing lies over it.
    pub(crate) fn nearest(&self) -> Option<i32> {
        self.nearest
    }

    /// How many bricks came.
    pub(crate) fn came(&self) -> usize {
        self.taken.len()
    }

    /// The first sheet of one that came.
    #[inline]
    pub(crate) fn first_sheet(&self, i: usize) -> i32 {
        self.taken.get(i).first
    }

    /// One that came.
    pub(crate) fn brick(&self, i: usize) -> (&Brick, &Corner) {
        let Taken { brick, corner, .. } = self.taken.get(i);
        (brick, corner)
    }

    /// Voxels of what was not come to.
    pub(crate) fn voxels_left(&self) -> u64 {
        let waiting = self.waiting.borrow();
        let blocks = self.blocks[waiting.blocks..].iter();
        waiting.voxels + blocks.map(|&i| self.share(i)).sum::<u64>()
    }
}

/// What a part is drawn from.
#[derive(Clone, Copy)]
struct From<'a> {
    frame: &'a Frame,
    simd: Simd,
    outlook: &'a Outlook,
    supply: &'a dyn Supply,
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
    (frame, outlook, supply): (&Frame, &Outlook, &dyn Supply),
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
pub struct Finished {
    /// Its pixels. Sums of a last sheet are not among them: nobody goes on from there.
    pub pixels: TilePixels,
    /// Its voxels.
    pub counters: Counters,
    /// Places in the directory of the bricks that it touched, ascending.
    pub touched: Vec<u32>,
    depths: Vec<(Rect, Cells)>,
}

impl Finished {
    /// Tells the next frame how deep it was open.
    pub fn teach(&self, depths: &Depths) {
        self.depths.iter().for_each(|(part, cells)| depths.note(part, cells));
    }
}

/// What a region that is not begun will ask for, if its frame is as deep as those of `depths`: places in the directory of
/// bricks that are not here, ascending. Nothing of what nobody knows about. Where nothing is culled, it is all that lies over it.
pub fn expected(
    (frame, outlook, supply): (&Frame, &Outlook, &dyn Supply),
    tile: Rect,
    depths: &Depths,
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
            for &Sight { projected, place, .. } in outlook.bricks(i) {
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
    pub fn new(outlook: &Outlook, tile: Rect) -> Region {
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
    pub fn go_on(outlook: &Outlook, tile: Rect, begun: &Begun) -> Result<Region, &'static str> {
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
    pub fn hand_over(
        &mut self,
        outlook: &Outlook,
        eps: f64,
        share: f64,
    ) -> Option<(Rect, Rect, Begun)> {
        let (tile, all) = (self.tile, outlook.sheets());
        let mut leaves = Leaves::new(tile);
        for strand in &self.open {
            let todo = f64::from((all.end - strand.at).max(1)) / f64::from(all.len().max(1));
            leaves.add(&strand.rect, |i| {
                let shut = eps > 0.0 && (1.0f32 - self.pixels.a[i]) < eps as f32;
                if shut { 0.0 } else { todo }
            });
        }
        let (kept, given) = cut(tile, share, |r| leaves.sum(r))?;
        let at = |rect: Rect| {
            let on = self.open.iter().find(|s| !s.rect.intersect(&rect).is_empty());
            on.map(|s| s.at)
        };
        let sheets = parts(given).map(at).collect();
        let begun = Begun { sheets, pixels: self.pixels.piece(tile, given) };
        for strand in &mut self.open {
            let rect = strand.rect.intersect(&kept);
            if rect != strand.rect {
                // They are counted from its corner, and seen again.
                (strand.rect, strand.cells) = (rect, Cells::default());
            }
        }
        self.open.retain(|s| !s.rect.is_empty());
        self.pixels = self.pixels.piece(tile, kept);
        self.tile = kept;
        Some((kept, given, begun))
    }

    /// Goes as far as bricks are here. What it lacks to go farther, by places in the directory and
    /// without repetition: those that begin at the sheets at which its parts stand still, and those
    /// of `ahead` sheets more that are not hidden by what is drawn already. Nothing: it is at its end, or its supply
    /// [stops](Supply::stops) it.
    pub fn advance(
        &mut self,
        frame: &Frame,
        simd: Simd,
        outlook: &Outlook,
        supply: &dyn Supply,
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
        outlook: &Outlook,
        supply: &dyn Supply,
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
    pub fn finish(self) -> Finished {
        let Region { mut pixels, counters, mut touched, depths, .. } = self;
        touched.sort_unstable();
        touched.dedup();
        pixels.last = None;
        Finished { pixels, counters, touched, depths }
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
        let leaf = |at: i32, first: i32| (at / LEAF as i32 - first / LEAF as i32) as usize;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_grows_and_is_emptied_while_its_memory_stays() {
        let mut list = Growing::default();
        for n in [0, 1, 63, 64, 65, 191, 192, 1000, 5] {
            let first = (n > 0).then(|| {
                list.push(7);
                list.get(0)
            });
            (1..n).for_each(|i| list.push(i * 3 + 7));
            assert!(first.is_none_or(|f| *f == 7));
            assert_eq!(list.len(), n);
            assert!(list.iter().copied().eq((0..n).map(|i| i * 3 + 7)));
            list.clear();
            assert_eq!(list.iter().count(), 0);
        }
        assert_eq!(list.chunks.iter().filter(|c| c.get().is_some()).count(), 5);
    }
}
