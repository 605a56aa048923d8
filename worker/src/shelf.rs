//! A brick set as render threads see it: its directory, and those of its bricks that are here.
//!
//! Threads look bricks up while the desk puts others in. A lock is held for one look or one put; what
//! a thread took it keeps by its own pointer, so a brick that is forgotten meanwhile is drawn all the
//! same.

use slabcast_common::brick::{Brick, BrickGrid, BrickInfo};
use slabcast_common::ids::BrickId;
use slabcast_render::outlook::Directory;
use slabcast_render::region::Supply;
use std::sync::{Arc, OnceLock, PoisonError, RwLock};

/// See the head of the file.
pub(crate) struct Shelf {
    grid: BrickGrid,
    bricks: Arc<[BrickInfo]>,
    directory: OnceLock<Arc<Directory>>,
    held: RwLock<Vec<Option<Arc<Brick>>>>,
}

impl Shelf {
    pub(crate) fn new(grid: BrickGrid, bricks: Arc<[BrickInfo]>) -> Shelf {
        let held = RwLock::new(vec![None; bricks.len()]);
        Shelf { grid, bricks, directory: OnceLock::new(), held }
    }

    /// How the volume is cut.
    pub(crate) fn grid(&self) -> BrickGrid {
        self.grid
    }

    /// All bricks of the set, here or not, ascending by id.
    pub(crate) fn bricks(&self) -> &[BrickInfo] {
        &self.bricks
    }

    /// The same in blocks. The first thread that asks puts them into these.
    pub(crate) fn directory(&self) -> &Arc<Directory> {
        self.directory.get_or_init(|| Arc::new(Directory::new(self.bricks.clone())))
    }

    /// A brick's place in the directory.
    pub(crate) fn place(&self, id: BrickId) -> Option<u32> {
        self.bricks.binary_search_by_key(&id, |b| b.id).ok().map(|i| i as u32)
    }

    /// Puts a brick in, or takes one out. Its place, if the directory has it.
    pub(crate) fn put(&self, id: BrickId, brick: Option<Arc<Brick>>) -> Option<u32> {
        let place = self.place(id)?;
        // No thread panics while it holds the lock.
        let mut held = self.held.write().unwrap_or_else(PoisonError::into_inner);
        held[place as usize] = brick;
        Some(place)
    }

    /// Whether a brick is here.
    pub(crate) fn holds(&self, place: u32) -> bool {
        let held = self.held.read().unwrap_or_else(PoisonError::into_inner);
        held[place as usize].is_some()
    }
}

impl Supply for Shelf {
    fn get(&self, place: u32) -> Option<Arc<Brick>> {
        let held = self.held.read().unwrap_or_else(PoisonError::into_inner);
        held[place as usize].clone()
    }
}
