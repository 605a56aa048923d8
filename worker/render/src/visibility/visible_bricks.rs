//! The directory of bricks as a frame sees it: in blocks, which are opened when they are needed.
//!
//! To project every brick of a head is 9,728 boxes a frame, and most of them lie behind what is drawn
//! before them. So bricks are put into blocks ([`slabcast_common::blocks`]) once a directory; a frame
//! projects those, a few hundred, and a block's bricks only when a part of the picture comes to the
//! block's first sheet and finds a pixel open under it. Whoever comes to it next, on any thread, finds
//! them projected. A worker of fifteen that draws three parts of forty looks at what lies under these,
//! and nobody looks at what lies inside a solid head.
//!
//! ```text
//! Directory::new                 when the directory arrives, or bricks change
//! VisibleBricks::new             once a frame: blocks front to back, and those over each part
//! VisibleBricks::project_block   when a part needs a block
//! ```
//!
//! What hides a block hides its bricks, since the projection of a box holds those of the boxes in it; a
//! block that begins before the near plane, or reaches behind the eye, begins at the nearest sheet there
//! is and is opened when that is come to.

use crate::primitives::sizes::PART;
use slabcast_common::blocks::Blocks;
use slabcast_common::brick::BrickInfo;
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projected, View};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Edge of a block in voxels, as a power of two: four bricks.
///
/// A worker of fifteen that draws its share of mri256 looks for 73 us a frame. With two bricks there are
/// six times as many blocks, most of which are not its own (207 us); with eight it looks at 2.7 times as
/// many bricks (128 us). Whole frames do not care: 64.8, 64.6 and 63.3 ms with two, four and eight.
const SHIFT: u32 = 5;

/// Most blocks, beyond which they are twice as large: half a millisecond a frame. Not measured: no volume
/// at hand has as many (1024^3 voxels without air do).
const MOST: usize = 4096;

/// Bricks, here or not, in blocks.
#[derive(Debug)]
pub struct Directory {
    bricks: Arc<[BrickInfo]>,
    blocks: Blocks,
    /// Bricks of the fullest block.
    fullest: usize,
    /// Memory of blocks that frames before had open: no more than frames at hand had at a time.
    spare: Mutex<Vec<Vec<VisibleBrick>>>,
}

impl Directory {
    /// Puts bricks into blocks: a millisecond for ten thousand.
    pub fn new(bricks: Arc<[BrickInfo]>) -> Directory {
        Directory::with_blocks(bricks, SHIFT, MOST)
    }

    /// The same with blocks of `2^shift` voxels along each axis, or of more, so that there are `most`.
    pub fn with_blocks(bricks: Arc<[BrickInfo]>, shift: u32, most: usize) -> Directory {
        let blocks = Blocks::new(&bricks, shift, most);
        let fullest = blocks.all().iter().map(|b| blocks.places(b).len()).max().unwrap_or(0);
        Directory { bricks, blocks, fullest, spare: Mutex::default() }
    }

    /// The bricks, in the order in which they were given.
    pub fn bricks(&self) -> &Arc<[BrickInfo]> {
        &self.bricks
    }

    fn spare(&self) -> std::sync::MutexGuard<'_, Vec<Vec<VisibleBrick>>> {
        // No thread panics while it holds the lock.
        self.spare.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A brick as a frame sees it, whether it is here or not.
#[derive(Clone, Copy, Debug)]
pub(crate) struct VisibleBrick {
    pub(crate) projected: Projected,
    /// Its place in the directory.
    pub(crate) place: u32,
    pub(crate) voxels: u16,
}

/// A block as a frame sees it.
#[derive(Debug)]
pub(crate) struct ProjectedBlock {
    pub(crate) projected: Projected,
    pub(crate) voxels: u64,
    /// Which of the directory's it is.
    block: u32,
    bricks: OnceLock<Vec<VisibleBrick>>,
}

/// See the head of the file.
#[derive(Debug)]
pub struct VisibleBricks {
    directory: Arc<Directory>,
    view: View,
    /// Blocks front to back.
    seen: Vec<ProjectedBlock>,
    sheets: SheetRange,
    /// Parts in a row of the picture.
    columns: usize,
    /// Where each part's entries begin; one more than there are parts.
    starts: Vec<usize>,
    /// Places in `seen`, front to back in each part.
    entries: Vec<u32>,
}

impl VisibleBricks {
    /// Looks at the blocks of a directory.
    pub fn new(view: &View, directory: &Arc<Directory>) -> VisibleBricks {
        let view = *view;
        let mut seen = Vec::with_capacity(directory.blocks.all().len());
        seen.extend(directory.blocks.all().iter().zip(0..).filter_map(|(b, block)| {
            let projected = view.project(&b.tight)?;
            Some(ProjectedBlock { projected, voxels: b.voxels, block, bricks: OnceLock::new() })
        }));
        seen.sort_unstable_by_key(|s| (s.projected.sheets.first, s.block));
        let sheets =
            seen.iter().fold(SheetRange::default(), |all, s| all.union(s.projected.sheets));

        let edge = PART as u32;
        let columns = view.size[0].div_ceil(edge) as usize;
        let parts = columns * view.size[1].div_ceil(edge) as usize;
        let over = |s: &ProjectedBlock| parts_under(s.projected.rect, columns);
        let mut starts = vec![0usize; parts + 1];
        for part in seen.iter().flat_map(over) {
            starts[part + 1] += 1;
        }
        for i in 0..parts {
            starts[i + 1] += starts[i];
        }
        let mut entries = vec![0u32; starts[parts]];
        let mut next = starts.clone();
        for (s, i) in seen.iter().zip(0u32..) {
            for part in over(s) {
                entries[next[part]] = i;
                next[part] += 1;
            }
        }
        VisibleBricks { directory: directory.clone(), view, seen, sheets, columns, starts, entries }
    }

    /// Sheets that anything may lie in.
    pub fn sheets(&self) -> SheetRange {
        self.sheets
    }

    /// What may lie over a tile, to compare it with others: voxels of its parts' blocks. Zero: nothing.
    pub fn weight(&self, tile: &Rect) -> u64 {
        let parts = parts_under(*tile, self.columns).flat_map(|part| self.of_part(part));
        parts.map(|&i| self.block(i).voxels).sum()
    }

    /// How many blocks it has.
    pub fn block_count(&self) -> u32 {
        self.seen.len() as u32
    }

    /// Looks at a block's bricks; at once if somebody did before. Its number is that of the frame, front
    /// to back.
    pub fn project_block(&self, block: u32) {
        self.bricks(block);
    }

    /// Numbers of the blocks that are open, ascending.
    pub fn projected_blocks(&self) -> impl Iterator<Item = u32> {
        let open = self.seen.iter().zip(0..).filter(|(s, _)| s.bricks.get().is_some());
        open.map(|(_, i)| i)
    }

    /// Bricks of those.
    pub fn projected_bricks(&self) -> usize {
        let blocks = self.directory.blocks.all();
        let opened = self.projected_blocks().map(|i| &blocks[self.block(i).block as usize]);
        opened.map(|b| self.directory.blocks.places(b).len()).sum()
    }

    /// Blocks over the part of the picture that holds the pixel (x, y), front to back.
    pub(crate) fn over(&self, x: i32, y: i32) -> &[u32] {
        self.of_part((y / PART) as usize * self.columns + (x / PART) as usize)
    }

    fn of_part(&self, part: usize) -> &[u32] {
        &self.entries[self.starts[part]..self.starts[part + 1]]
    }

    pub(crate) fn block(&self, i: u32) -> &ProjectedBlock {
        &self.seen[i as usize]
    }

    /// A block's bricks that are not off the picture, by place.
    pub(crate) fn bricks(&self, block: u32) -> &[VisibleBrick] {
        let seen = self.block(block);
        seen.bricks.get_or_init(|| {
            let directory = &*self.directory;
            let spare = directory.spare().pop();
            let mut bricks = spare.unwrap_or_else(|| Vec::with_capacity(directory.fullest));
            let places = directory.blocks.places(&directory.blocks.all()[seen.block as usize]);
            bricks.extend(places.iter().filter_map(|&place| {
                let brick = &directory.bricks[place as usize];
                let projected = self.view.project(&brick.tight)?;
                Some(VisibleBrick { projected, place, voxels: brick.voxels })
            }));
            bricks
        })
    }
}

impl Drop for VisibleBricks {
    fn drop(&mut self) {
        let mut spare = self.directory.spare();
        spare.extend(self.seen.iter_mut().filter_map(|s| s.bricks.take()).map(|mut bricks| {
            bricks.clear();
            bricks
        }));
    }
}

/// The parts of a picture, of so many in a row, that a rectangle in it lies in.
fn parts_under(r: Rect, columns: usize) -> impl Iterator<Item = usize> {
    let (x0, x1) = (r.x0 / PART, (r.x1 - 1) / PART);
    (r.y0 / PART..=(r.y1 - 1) / PART)
        .flat_map(move |y| (x0..=x1).map(move |x| y as usize * columns + x as usize))
}
