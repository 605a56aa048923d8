//! Bricks of a part that arrive while it is drawn.

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

/// Where bricks are had from, by their place in the directory.
pub trait BrickSupply {
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
    pub(crate) place: u32,
    /// Its first sheet.
    first: i32,
}

/// A list that grows while what is in it is looked at. Its memory stays when it is emptied.
pub struct Growing<T> {
    len: Cell<usize>,
    /// Each twice as long as the one before.
    pub chunks: [OnceCell<Vec<OnceCell<T>>>; 26],
}

/// Items of the first chunk: what a part of a head takes fits two or three.
const CHUNK: usize = 64;

impl<T> Default for Growing<T> {
    fn default() -> Self {
        Growing { len: Cell::new(0), chunks: [const { OnceCell::new() }; 26] }
    }
}

impl<T> Growing<T> {
    pub fn len(&self) -> usize {
        self.len.get()
    }

    /// Chunk of an item, and its place there.
    fn place(i: usize) -> (usize, usize) {
        let chunk = (i / CHUNK + 1).ilog2() as usize;
        (chunk, i + CHUNK - (CHUNK << chunk))
    }

    pub fn push(&self, item: T) {
        let (chunk, at) = Self::place(self.len.replace(self.len.get() + 1));
        let chunk = self.chunks[chunk]
            .get_or_init(|| std::iter::repeat_with(OnceCell::new).take(CHUNK << chunk).collect());
        chunk[at].get_or_init(|| item);
    }

    pub fn get(&self, i: usize) -> &T {
        let (chunk, at) = Self::place(i);
        let chunk = self.chunks[chunk].get();
        chunk.and_then(|c| c[at].get()).expect("what is in the list")
    }

    pub fn iter(&self) -> impl Iterator<Item = &T> {
        (0..self.len()).map(|i| self.get(i))
    }

    pub fn clear(&mut self) {
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
pub struct Memory {
    pub(crate) waiting: Waiting,
    pub(crate) taken: Growing<Taken>,
}

/// Bricks of a part that come when they are needed.
pub struct Coming<'a> {
    frame: &'a Frame,
    outlook: &'a VisibleBricks,
    supply: &'a dyn BrickSupply,
    rect: Rect,
    /// Sheets that are left.
    pub(crate) slab: SheetRange,
    /// Blocks over the part, front to back.
    blocks: &'a [u32],
    pub(crate) waiting: RefCell<Waiting>,
    taken: &'a Growing<Taken>,
    /// How many sheets beyond the one at which something is lacked are looked at, too.
    ahead: u32,
    /// The first sheet that could not be drawn.
    pub(crate) stop: Cell<Option<i32>>,
    /// What was lacked: places in the directory, in order of depth.
    pub(crate) lacks: RefCell<Vec<u32>>,
    /// The first sheet that any brick begins at.
    pub(crate) nearest: Option<i32>,
    /// How deep its cells are open, and the last sheet that was come to.
    pub(crate) cells: RefCell<Cells>,
    pub(crate) last: Cell<i32>,
}

impl<'a> Coming<'a> {
    /// What lies over a part's sheets from `at` on.
    pub(crate) fn new(
        (frame, outlook, supply): (&'a Frame, &'a VisibleBricks, &'a dyn BrickSupply),
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

    fn visible(&self, waits: &Waits) -> &'a VisibleBrick {
        &self.outlook.bricks(waits.block)[waits.brick as usize]
    }

    /// Has a block's bricks wait for their first sheets, at `k` soonest; the first of these.
    fn open(&self, block: u32, k: i32, waiting: &mut Waiting) -> i32 {
        let mut nearest = i32::MAX;
        for (visible, brick) in self.outlook.bricks(block).iter().zip(0..) {
            if !self.is_over(&visible.projected) {
                continue;
            }
            let first = visible.projected.sheets.first;
            nearest = nearest.min(first);
            let head = &mut waiting.heads[first.max(k).abs_diff(self.slab.first) as usize];
            waiting.bricks.push(Waits { block, brick, next: *head });
            *head = waiting.bricks.len() as u32 - 1;
            waiting.voxels += u64::from(visible.voxels);
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
            let visible = self.visible(waits);
            let voxels = u64::from(visible.voxels);
            if !self.passes(&visible.projected.rect, open) {
                culled += voxels;
            } else if let Some(brick) = self.supply.get(visible.place) {
                let corner = self.frame.corner(brick.id);
                let (place, first) = (visible.place, visible.projected.sheets.first);
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
                let &VisibleBrick { projected, place, .. } = self.visible(waits);
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
