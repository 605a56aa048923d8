//! Bricks of a part that may arrive while it is drawn.
//!
//! A part that runs through all sheets asks, sheet by sheet, for the bricks that begin there and
//! may touch an open pixel (`ArrivingBricks::is_supplied`). Where one is missing the part stops,
//! with a list of what it lacks.

use crate::scene::{Corner, Frame};
use crate::visibility::closing_depth::{Cells, LOOKS};
use crate::visibility::open_mask::OpenMask;
use crate::visibility::visible_bricks::{VisibleBrick, VisibleBricks};
use slabcast_common::brick::Brick;
use slabcast_common::message::Counters;
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::Projected;
use std::cell::{Cell, OnceCell, RefCell};
use std::sync::Arc;

/// A source of bricks, which are named by their index in the scene's
/// [directory](crate::visibility::Directory). Calls come from the thread that draws, and should
/// not block.
pub trait BrickSupply {
    /// Returns the brick at directory index `place`, or `None` if it is not held now.
    fn get(&self, place: u32) -> Option<Arc<Brick>>;

    /// Returns whether the brick at directory index `place` is held now.
    fn has(&self, place: u32) -> bool {
        self.get(place).is_some()
    }

    /// Returns whether a region is to stop before its next sheet although no brick is missing, for
    /// example because its worker is asked to give part of it away. Asked once a sheet.
    fn stops(&self) -> bool {
        false
    }
}

/// A brick that a part holds while it is drawn.
pub(crate) struct TakenBrick {
    brick: Arc<Brick>,
    corner: Corner,
    /// Index of the brick in the directory.
    pub(crate) place: u32,
    first_sheet: i32,
}

/// A list that grows while its items are borrowed. Clearing it keeps its memory.
pub struct AppendList<T> {
    len: Cell<usize>,
    /// Chunks of items: chunk n holds 64 * 2^n items.
    pub chunks: [OnceCell<Vec<OnceCell<T>>>; 26],
}

/// Items of the first chunk. The bricks of a part of a head fill two or three chunks.
const CHUNK: usize = 64;

impl<T> Default for AppendList<T> {
    fn default() -> Self {
        AppendList { len: Cell::new(0), chunks: [const { OnceCell::new() }; 26] }
    }
}

#[expect(clippy::len_without_is_empty, reason = "callers only index it")]
impl<T> AppendList<T> {
    /// Returns the number of items in the list.
    pub fn len(&self) -> usize {
        self.len.get()
    }

    /// Chunk of item `i`, and its index there.
    fn locate(i: usize) -> (usize, usize) {
        let chunk = (i / CHUNK + 1).ilog2() as usize;
        (chunk, i + CHUNK - (CHUNK << chunk))
    }

    /// Appends an item; items that are borrowed stay where they are.
    pub fn push(&self, item: T) {
        let (chunk, slot) = Self::locate(self.len.replace(self.len.get() + 1));
        let chunk = self.chunks[chunk]
            .get_or_init(|| std::iter::repeat_with(OnceCell::new).take(CHUNK << chunk).collect());
        chunk[slot].get_or_init(|| item);
    }

    /// Returns item number `i`, from 0.
    pub fn get(&self, i: usize) -> &T {
        let (chunk, slot) = Self::locate(i);
        let chunk = self.chunks[chunk].get();
        chunk.and_then(|c| c[slot].get()).expect("an index below the length")
    }

    /// Returns the items in the order in which they were appended.
    pub fn iter(&self) -> impl Iterator<Item = &T> {
        (0..self.len()).map(|i| self.get(i))
    }

    /// Removes all items and keeps their memory.
    pub fn clear(&mut self) {
        let used = self.chunks.iter_mut().filter_map(OnceCell::get_mut).flatten();
        used.take(self.len.replace(0)).for_each(|item| *item = OnceCell::new());
    }
}

/// Bricks of opened blocks, in one linked list a sheet at which they begin.
#[derive(Default)]
pub(crate) struct WaitingBricks {
    /// By sheet from the part's first on: the last brick pushed, or [`NONE`].
    heads: Vec<u32>,
    bricks: Vec<WaitingBrick>,
    /// Voxels of the bricks in the lists.
    voxels: u64,
    /// Number of the part's blocks, front to back, that were opened or culled.
    blocks_done: usize,
}

#[derive(Clone, Copy)]
struct WaitingBrick {
    block: u32,
    /// Index of the brick in its block.
    index: u32,
    /// The next brick that begins at the same sheet, or [`NONE`].
    next: u32,
}

const NONE: u32 = u32::MAX;

/// Memory that a render thread keeps from part to part.
#[derive(Default)]
pub struct FeedMemory {
    pub(crate) waiting: WaitingBricks,
    pub(crate) taken: AppendList<TakenBrick>,
}

/// The bricks over a part, taken from a [`BrickSupply`] when the part comes to their first sheets.
pub struct ArrivingBricks<'a> {
    frame: &'a Frame,
    visible: &'a VisibleBricks,
    supply: &'a dyn BrickSupply,
    rect: Rect,
    /// Sheets that are left to draw.
    pub(crate) slab: SheetRange,
    /// Blocks over the part, front to back.
    blocks: &'a [u32],
    pub(crate) waiting: RefCell<WaitingBricks>,
    taken: &'a AppendList<TakenBrick>,
    /// Sheets behind the one where a brick is missing in which missing bricks are listed as well.
    ahead: u32,
    /// The first sheet that could not be drawn.
    pub(crate) stop: Cell<Option<i32>>,
    /// Directory indices of missing bricks, by the sheet at which they begin.
    pub(crate) missing: RefCell<Vec<u32>>,
    /// The first sheet at which any brick begins.
    pub(crate) nearest: Option<i32>,
    pub(crate) cells: RefCell<Cells>,
    /// The last sheet that was asked for.
    pub(crate) last: Cell<i32>,
}

impl<'a> ArrivingBricks<'a> {
    /// The bricks over `rect`, one part, in sheets `from` and behind.
    pub(crate) fn new(
        frame: &'a Frame,
        visible: &'a VisibleBricks,
        supply: &'a dyn BrickSupply,
        rect: Rect,
        from: i32,
        ahead: u32,
        mut waiting: WaitingBricks,
        taken: &'a AppendList<TakenBrick>,
    ) -> ArrivingBricks<'a> {
        let blocks = visible.over(rect.x0, rect.y0);
        let ends = blocks.iter().map(|&i| visible.block(i).projected.sheets.end);
        let slab = SheetRange::new(from, ends.max().unwrap_or(from));
        waiting.heads.clear();
        waiting.heads.resize(slab.len() as usize, NONE);
        waiting.bricks.clear();
        (waiting.voxels, waiting.blocks_done) = (0, 0);
        let (stop, missing, nearest, cells) = Default::default();
        let waiting = RefCell::new(waiting);
        let last = Cell::new(from);
        let mut arriving = ArrivingBricks {
            frame,
            visible,
            supply,
            rect,
            slab,
            blocks,
            waiting,
            taken,
            ahead,
            stop,
            missing,
            nearest,
            cells,
            last,
        };
        arriving.nearest = arriving.find_nearest();
        arriving
    }

    /// Opens blocks until no block that is left can begin before the nearest brick found; the first
    /// sheet of that brick.
    fn find_nearest(&self) -> Option<i32> {
        let waiting = &mut *self.waiting.borrow_mut();
        let mut nearest = i32::MAX;
        while let Some(&i) = self.blocks.get(waiting.blocks_done)
            && self.visible.block(i).projected.sheets.first < nearest
        {
            waiting.blocks_done += 1;
            if self.overlaps(&self.visible.block(i).projected) {
                nearest = nearest.min(self.open_block(i, self.slab.first, waiting));
            }
        }
        (nearest < i32::MAX).then_some(nearest)
    }

    /// Whether a brick or block may lie in the part's pixels and remaining sheets.
    fn overlaps(&self, p: &Projected) -> bool {
        p.sheets.overlaps(self.slab) && !p.rect.intersect(&self.rect).is_empty()
    }

    /// Whether any pixel of `rect` is open, or culling is off.
    fn may_show(&self, rect: &Rect, open: &OpenMask) -> bool {
        !self.frame.scene.quality.cull || open.any(rect)
    }

    fn brick_of(&self, waiting: &WaitingBrick) -> &'a VisibleBrick {
        &self.visible.bricks(waiting.block)[waiting.index as usize]
    }

    /// Puts a block's bricks into the lists of their first sheets, of sheet `k` at the earliest;
    /// the first sheet of any of them.
    fn open_block(&self, block: u32, k: i32, waiting: &mut WaitingBricks) -> i32 {
        let mut nearest = i32::MAX;
        for (brick, index) in self.visible.bricks(block).iter().zip(0..) {
            if !self.overlaps(&brick.projected) {
                continue;
            }
            let first = brick.projected.sheets.first;
            nearest = nearest.min(first);
            let head = &mut waiting.heads[first.max(k).abs_diff(self.slab.first) as usize];
            waiting.bricks.push(WaitingBrick { block, index, next: *head });
            *head = waiting.bricks.len() as u32 - 1;
            waiting.voxels += u64::from(brick.voxels);
        }
        nearest
    }

    /// Voxels of a block that was not opened, in proportion to how much of its rectangle lies over
    /// the part.
    fn voxel_share(&self, block: u32) -> u64 {
        let block = self.visible.block(block);
        if !self.overlaps(&block.projected) {
            return 0;
        }
        let rect = block.projected.rect;
        block.voxels * rect.intersect(&self.rect).area() as u64 / rect.area() as u64
    }

    /// Opens the blocks that begin at sheet `until` or before and may show; the voxels of those
    /// that may not.
    fn open_blocks(&self, until: i32, k: i32, open: &OpenMask, waiting: &mut WaitingBricks) -> u64 {
        let mut culled = 0;
        while let Some(&i) = self.blocks.get(waiting.blocks_done) {
            let projected = &self.visible.block(i).projected;
            if projected.sheets.first > until {
                break;
            }
            waiting.blocks_done += 1;
            if !self.may_show(&projected.rect, open) {
                culled += self.voxel_share(i);
            } else if self.overlaps(projected) {
                self.open_block(i, k, waiting);
            }
        }
        culled
    }

    /// Takes the bricks that begin at sheet `k` and may show; the voxels of the others are counted
    /// as culled. Returns false, and notes what is missing, if one of them is not held or the
    /// supply [stops](BrickSupply::stops) the region. `k` rises by one from call to call.
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
        let mut culled = self.open_blocks(k, k, open, waiting);
        let head = k.abs_diff(self.slab.first) as usize;
        let mut next = waiting.heads[head];
        while let Some(entry) = waiting.bricks.get(next as usize) {
            let here = self.brick_of(entry);
            let voxels = u64::from(here.voxels);
            if !self.may_show(&here.projected.rect, open) {
                culled += voxels;
            } else if let Some(brick) = self.supply.get(here.place) {
                let corner = self.frame.corner(brick.id);
                let (place, first_sheet) = (here.place, here.projected.sheets.first);
                self.taken.push(TakenBrick { brick, corner, place, first_sheet });
            } else {
                self.note_missing(k, open, waiting);
                return false;
            }
            waiting.voxels -= voxels;
            next = entry.next;
        }
        waiting.heads[head] = NONE;
        counters.culled += culled;
        true
    }

    /// Lists what is missing at sheet `k` and in [`ahead`](Self::ahead) sheets more.
    fn note_missing(&self, k: i32, open: &OpenMask, waiting: &mut WaitingBricks) {
        self.stop.set(Some(k));
        let until = k.saturating_add_unsigned(self.ahead).min(self.slab.end - 1);
        self.open_blocks(until, k, open, waiting);
        let mut missing: Vec<(i32, u32)> = Vec::new();
        for k in k..=until {
            let mut next = waiting.heads[k.abs_diff(self.slab.first) as usize];
            while let Some(entry) = waiting.bricks.get(next as usize) {
                let &VisibleBrick { projected, place, .. } = self.brick_of(entry);
                if self.may_show(&projected.rect, open) && !self.supply.has(place) {
                    missing.push((projected.sheets.first, place));
                }
                next = entry.next;
            }
        }
        missing.sort_unstable();
        self.missing.borrow_mut().extend(missing.into_iter().map(|(_, place)| place));
    }

    /// Returns the number of bricks that were taken.
    pub(crate) fn taken_count(&self) -> usize {
        self.taken.len()
    }

    /// First sheet of the `i`th brick that was taken.
    #[inline]
    pub(crate) fn first_sheet(&self, i: usize) -> i32 {
        self.taken.get(i).first_sheet
    }

    /// The `i`th brick that was taken.
    #[inline]
    pub(crate) fn brick(&self, i: usize) -> (&Brick, &Corner) {
        let TakenBrick { brick, corner, .. } = self.taken.get(i);
        (brick, corner)
    }

    /// Voxels of bricks that were neither taken nor culled.
    pub(crate) fn voxels_left(&self) -> u64 {
        let waiting = self.waiting.borrow();
        let blocks = self.blocks[waiting.blocks_done..].iter();
        waiting.voxels + blocks.map(|&i| self.voxel_share(i)).sum::<u64>()
    }
}
