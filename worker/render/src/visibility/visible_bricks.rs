//! The directory of bricks projected into a frame, block by block and only where needed.
//!
//! Projecting every brick of a head takes 9,728 boxes a frame, and most of them lie behind what is
//! drawn in front of them. So bricks are grouped into blocks ([`slabcast_common::blocks`]) once a
//! directory. A frame projects the blocks, a few hundred, and a block's bricks only when a part of
//! the picture reaches the block's first sheet and finds an open pixel under it. The first thread
//! that needs a block projects it for all. A worker of fifteen that draws three parts of forty
//! looks at what lies under these, and nobody looks at what lies inside a solid head.
//!
//! ```text
//! Directory::new                 when the directory arrives, or bricks change
//! VisibleBricks::new             once a frame: blocks front to back, and those over each part
//! VisibleBricks::project_block   when a part needs a block
//! ```
//!
//! Whatever hides a block hides its bricks, since the projection of a box holds those of the boxes
//! in it. A block that begins in front of the near plane, or reaches behind the eye, begins at the
//! nearest sheet there is and is opened when that is reached.

use crate::primitives::sizes::PART;
use slabcast_common::blocks::Blocks;
use slabcast_common::brick::BrickInfo;
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projected, View};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Edge of a block in voxels, as a power of two: four bricks.
///
/// A worker of fifteen that draws its share of mri256 spends 73 us a frame on projection. With
/// blocks of two bricks there are six times as many blocks, most over others' tiles (207 us); with
/// eight it projects 2.7 times as many bricks (128 us). Whole frames take 64.8, 64.6 and 63.3 ms
/// with two, four and eight.
const SHIFT: u32 = 5;

/// Most blocks; beyond this many they become twice as large. They take half a millisecond a frame.
/// Not measured: no volume at hand has as many (1024^3 voxels without air do).
const MOST: usize = 4096;

/// All bricks of a scene, held or not, grouped into blocks. A brick is named by its index in here.
#[derive(Debug)]
pub struct Directory {
    bricks: Arc<[BrickInfo]>,
    blocks: Blocks,
    /// Number of bricks of the fullest block.
    fullest: usize,
    /// Memory of blocks that earlier frames projected, for reuse.
    spare: Mutex<Vec<Vec<VisibleBrick>>>,
}

impl Directory {
    /// Groups `bricks` into blocks of 32 voxels along each axis: a millisecond for ten thousand.
    pub fn new(bricks: Arc<[BrickInfo]>) -> Directory {
        Directory::with_blocks(bricks, SHIFT, MOST)
    }

    /// Groups `bricks` into blocks of `2^shift` voxels along each axis, or of twice as many, and so
    /// on, until there are at most `most` blocks.
    pub fn with_blocks(bricks: Arc<[BrickInfo]>, shift: u32, most: usize) -> Directory {
        let blocks = Blocks::new(&bricks, shift, most);
        let fullest = blocks.all().iter().map(|b| blocks.places(b).len()).max().unwrap_or(0);
        Directory { bricks, blocks, fullest, spare: Mutex::default() }
    }

    /// Returns the bricks in the order in which they were given.
    pub fn bricks(&self) -> &Arc<[BrickInfo]> {
        &self.bricks
    }

    fn spare(&self) -> std::sync::MutexGuard<'_, Vec<Vec<VisibleBrick>>> {
        // No thread panics while it holds the lock.
        self.spare.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A brick projected into a frame, held or not.
#[derive(Clone, Copy, Debug)]
pub(crate) struct VisibleBrick {
    pub(crate) projected: Projected,
    /// Index of the brick in the directory.
    pub(crate) place: u32,
    pub(crate) voxels: u16,
}

/// A block projected into a frame.
#[derive(Debug)]
pub(crate) struct ProjectedBlock {
    pub(crate) projected: Projected,
    pub(crate) voxels: u64,
    /// Index of the block among the directory's.
    block: u32,
    bricks: OnceLock<Vec<VisibleBrick>>,
}

/// Bricks of a [`Directory`] over each part of a frame, front to back. Blocks are
/// projected at once, their bricks when first needed, by any thread.
#[derive(Debug)]
pub struct VisibleBricks {
    directory: Arc<Directory>,
    view: View,
    /// Blocks front to back.
    blocks: Vec<ProjectedBlock>,
    sheets: SheetRange,
    /// Number of parts across the picture.
    columns: usize,
    /// Offsets of each part's entries in `entries`, and the end of the last.
    starts: Vec<usize>,
    /// Indices into `blocks`, front to back in each part.
    entries: Vec<u32>,
}

impl VisibleBricks {
    /// Projects the blocks of `directory` into `view`.
    pub fn new(view: &View, directory: &Arc<Directory>) -> VisibleBricks {
        let view = *view;
        let mut blocks = Vec::with_capacity(directory.blocks.all().len());
        blocks.extend(directory.blocks.all().iter().zip(0..).filter_map(|(b, block)| {
            let projected = view.project(&b.tight)?;
            Some(ProjectedBlock { projected, voxels: b.voxels, block, bricks: OnceLock::new() })
        }));
        blocks.sort_unstable_by_key(|b| (b.projected.sheets.first, b.block));
        let sheets =
            blocks.iter().fold(SheetRange::default(), |all, b| all.union(b.projected.sheets));

        let edge = PART as u32;
        let columns = view.size[0].div_ceil(edge) as usize;
        let parts = columns * view.size[1].div_ceil(edge) as usize;
        let over = |b: &ProjectedBlock| parts_under(b.projected.rect, columns);
        let mut starts = vec![0usize; parts + 1];
        for part in blocks.iter().flat_map(over) {
            starts[part + 1] += 1;
        }
        for i in 0..parts {
            starts[i + 1] += starts[i];
        }
        let mut entries = vec![0u32; starts[parts]];
        let mut next = starts.clone();
        for (block, i) in blocks.iter().zip(0u32..) {
            for part in over(block) {
                entries[next[part]] = i;
                next[part] += 1;
            }
        }
        VisibleBricks {
            directory: directory.clone(),
            view,
            blocks,
            sheets,
            columns,
            starts,
            entries,
        }
    }

    /// Returns the sheets that any brick may touch.
    pub fn sheets(&self) -> SheetRange {
        self.sheets
    }

    /// Returns the number of voxels of the blocks over the parts of `tile`, to compare tiles by;
    /// zero where nothing lies over it.
    pub fn weight(&self, tile: &Rect) -> u64 {
        let parts = parts_under(*tile, self.columns).flat_map(|part| self.of_part(part));
        parts.map(|&i| self.block(i).voxels).sum()
    }

    /// Returns the number of blocks in the picture. Blocks are numbered front to back from zero.
    pub fn block_count(&self) -> u32 {
        self.blocks.len() as u32
    }

    /// Projects the bricks of block number `block`, unless a thread has done so.
    ///
    /// # Panics
    /// If there are not as many blocks.
    pub fn project_block(&self, block: u32) {
        self.bricks(block);
    }

    /// Returns the numbers of the blocks whose bricks were projected, ascending.
    pub fn projected_blocks(&self) -> impl Iterator<Item = u32> {
        let done = self.blocks.iter().zip(0..).filter(|(b, _)| b.bricks.get().is_some());
        done.map(|(_, i)| i)
    }

    /// Returns the number of bricks in the blocks that were projected.
    pub fn projected_bricks(&self) -> usize {
        let blocks = self.directory.blocks.all();
        let done = self.projected_blocks().map(|i| &blocks[self.block(i).block as usize]);
        done.map(|b| self.directory.blocks.places(b).len()).sum()
    }

    /// Numbers of the blocks over the part that holds pixel (x, y), front to back.
    pub(crate) fn over(&self, x: i32, y: i32) -> &[u32] {
        self.of_part((y / PART) as usize * self.columns + (x / PART) as usize)
    }

    fn of_part(&self, part: usize) -> &[u32] {
        &self.entries[self.starts[part]..self.starts[part + 1]]
    }

    pub(crate) fn block(&self, i: u32) -> &ProjectedBlock {
        &self.blocks[i as usize]
    }

    /// The bricks of a block that are in the picture, by index in the directory.
    pub(crate) fn bricks(&self, block: u32) -> &[VisibleBrick] {
        let block = self.block(block);
        block.bricks.get_or_init(|| {
            let directory = &*self.directory;
            let spare = directory.spare().pop();
            let mut bricks = spare.unwrap_or_else(|| Vec::with_capacity(directory.fullest));
            let places = directory.blocks.places(&directory.blocks.all()[block.block as usize]);
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
        spare.extend(self.blocks.iter_mut().filter_map(|b| b.bricks.take()).map(|mut bricks| {
            bricks.clear();
            bricks
        }));
    }
}

/// Indices of the parts that rectangle `r` overlaps, in a picture `columns` parts wide.
fn parts_under(r: Rect, columns: usize) -> impl Iterator<Item = usize> {
    let (x0, x1) = (r.x0 / PART, (r.x1 - 1) / PART);
    (r.y0 / PART..=(r.y1 - 1) / PART)
        .flat_map(move |y| (x0..=x1).map(move |x| y as usize * columns + x as usize))
}
