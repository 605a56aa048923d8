//! A brick set as render threads see it: its directory, and the bricks of it that are here.
//!
//! Threads look bricks up while the session puts others in. Each place has a lock, held for one
//! lookup or one insertion, so that threads meet at a lock only where they look up the same brick
//! at once. A thread keeps what it took by a pointer of its own: a brick that is dropped meanwhile
//! is drawn all the same.

use slabcast_common::brick::{Brick, BrickGrid, BrickInfo};
use slabcast_common::ids::BrickId;
use slabcast_render::region::BrickSupply;
use slabcast_render::visibility::Directory;
use std::sync::{Arc, OnceLock, PoisonError, RwLock};

/// See the head of the file.
pub(crate) struct BrickTable {
    grid: BrickGrid,
    bricks: Arc<[BrickInfo]>,
    directory: OnceLock<Arc<Directory>>,
    held: Box<[RwLock<Option<Arc<Brick>>>]>,
}

impl BrickTable {
    pub(crate) fn new(grid: BrickGrid, bricks: Arc<[BrickInfo]>) -> BrickTable {
        let held = bricks.iter().map(|_| RwLock::default()).collect();
        BrickTable { grid, bricks, directory: OnceLock::new(), held }
    }

    /// Whether another table is of the same bricks.
    pub(crate) fn is_like(&self, other: &BrickTable) -> bool {
        self.grid == other.grid && self.bricks == other.bricks
    }

    /// The grid by which the volume is cut into bricks.
    pub(crate) fn grid(&self) -> BrickGrid {
        self.grid
    }

    /// All bricks of the set, here or not, ascending by id.
    pub(crate) fn bricks(&self) -> &[BrickInfo] {
        &self.bricks
    }

    /// The set's bricks, grouped in blocks. The first thread that asks groups them.
    pub(crate) fn directory(&self) -> &Arc<Directory> {
        self.directory.get_or_init(|| Arc::new(Directory::new(self.bricks.clone())))
    }

    /// A brick's index in the directory.
    pub(crate) fn place(&self, id: BrickId) -> Option<u32> {
        self.bricks.binary_search_by_key(&id, |b| b.id).ok().map(|i| i as u32)
    }

    /// Puts a brick in, or takes one out. Returns its place, if the directory has it.
    pub(crate) fn put(&self, id: BrickId, brick: Option<Arc<Brick>>) -> Option<u32> {
        let place = self.place(id)?;
        // No thread panics while it holds the lock.
        let held = &self.held[place as usize];
        *held.write().unwrap_or_else(PoisonError::into_inner) = brick;
        Some(place)
    }
}

impl BrickSupply for BrickTable {
    fn get(&self, place: u32) -> Option<Arc<Brick>> {
        self.held[place as usize].read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn has(&self, place: u32) -> bool {
        self.held[place as usize].read().unwrap_or_else(PoisonError::into_inner).is_some()
    }
}
