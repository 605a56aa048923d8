//! Bricks that a worker holds, by set, and the directories of sets.

use crate::brick_table::Shelf;
use slabcast_common::brick::{Brick, BrickGrid, BrickInfo, BrickSetKey};
use slabcast_common::ids::BrickId;
use slabcast_common::message::DIRECTORIES;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Bricks by set and id. Under the `slab` schedule the master decides what stays and what goes
/// (`DropBricks`), since it decides what is needed; under `region` the worker does, and tells it
/// (`parking`). So both always agree on what is here.
#[derive(Default)]
pub struct BrickCache {
    sets: BTreeMap<BrickSetKey, BTreeMap<BrickId, Arc<Brick>>>,
    /// Bytes of all, as they are encoded.
    encoded: u64,
    /// Sets whose directories are here, the last that came last.
    shelves: VecDeque<(BrickSetKey, Arc<Shelf>)>,
    /// A directory that is still coming.
    coming: Option<Coming>,
}

/// The parts of a directory that came.
struct Coming {
    set: BrickSetKey,
    grid: BrickGrid,
    total: u32,
    bricks: Vec<BrickInfo>,
}

impl BrickCache {
    /// Takes a brick in; a second copy of one replaces the first.
    pub fn put(&mut self, set: BrickSetKey, brick: Arc<Brick>) {
        if let Some(shelf) = self.shelf(set) {
            shelf.put(brick.id, Some(brick.clone()));
        }
        self.encoded += brick.encoded_len() as u64;
        if let Some(before) = self.sets.entry(set).or_default().insert(brick.id, brick) {
            self.encoded -= before.encoded_len() as u64;
        }
    }

    /// A brick, if it is here.
    pub fn get(&self, set: BrickSetKey, id: BrickId) -> Option<&Arc<Brick>> {
        self.sets.get(&set)?.get(&id)
    }

    /// Forgets bricks.
    pub fn remove(&mut self, set: BrickSetKey, ids: &[BrickId]) {
        let shelf = self.shelf(set).cloned();
        if let Some(bricks) = self.sets.get_mut(&set) {
            for id in ids {
                if let Some(brick) = bricks.remove(id) {
                    self.encoded -= brick.encoded_len() as u64;
                }
                if let Some(shelf) = &shelf {
                    shelf.put(*id, None);
                }
            }
            if bricks.is_empty() {
                self.sets.remove(&set);
            }
        }
    }

    /// What is here, for the hello.
    pub fn held(&self) -> Vec<(BrickSetKey, Vec<BrickId>)> {
        self.sets.iter().map(|(key, bricks)| (*key, bricks.keys().copied().collect())).collect()
    }

    /// Number of bricks.
    pub fn len(&self) -> usize {
        self.sets.values().map(BTreeMap::len).sum()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.sets.is_empty()
    }

    /// Bytes they take in memory.
    pub fn bytes(&self) -> usize {
        self.sets.values().flat_map(BTreeMap::values).map(|b| b.bytes_in_memory()).sum()
    }

    /// Bytes that they take encoded: the measure of budgets.
    pub fn encoded_bytes(&self) -> u64 {
        self.encoded
    }

    /// Takes in a part of a directory.
    ///
    /// # Errors
    /// A part that does not go on where the one before ended. The directory is not there then.
    pub(crate) fn directory(
        &mut self,
        set: BrickSetKey,
        grid: BrickGrid,
        (first, total): (u32, u32),
        bricks: Arc<[BrickInfo]>,
    ) -> Result<(), &'static str> {
        let mut coming = match self.coming.take() {
            _ if first == 0 => {
                self.shelves.retain(|(key, _)| *key != set);
                if bricks.len() == total as usize {
                    self.take_up(set, Shelf::new(grid, bricks));
                    return Ok(());
                }
                Coming { set, grid, total, bricks: Vec::new() }
            }
            Some(c) if (c.set, c.grid, c.total) == (set, grid, total) => c,
            _ => return Err("a part of a directory that has no beginning"),
        };
        let follows = coming.bricks.last().zip(bricks.first()).is_none_or(|(a, b)| a.id < b.id);
        if coming.bricks.len() != first as usize || !follows {
            return Err("a part of a directory that does not follow the one before");
        }
        coming.bricks.extend_from_slice(&bricks);
        if coming.bricks.len() == total as usize {
            self.take_up(set, Shelf::new(grid, coming.bricks.into()));
        } else {
            self.coming = Some(coming);
        }
        Ok(())
    }

    fn take_up(&mut self, set: BrickSetKey, shelf: Shelf) {
        for brick in self.sets.get(&set).into_iter().flat_map(BTreeMap::values) {
            shelf.put(brick.id, Some(brick.clone()));
        }
        self.shelves.push_back((set, Arc::new(shelf)));
        if self.shelves.len() > DIRECTORIES {
            self.shelves.pop_front();
        }
    }

    /// A link begins: its master sends directories anew.
    pub(crate) fn forget_directories(&mut self) {
        self.shelves.clear();
        self.coming = None;
    }

    /// A set with its directory, if that is here.
    pub(crate) fn shelf(&self, set: BrickSetKey) -> Option<&Arc<Shelf>> {
        self.shelves.iter().find(|(key, _)| *key == set).map(|(_, shelf)| shelf)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::brick::TightBox;
    use slabcast_common::volume::{Digest32, Samples};
    use slabcast_render::region::BrickSupply;

    const GRID: BrickGrid = BrickGrid { dims: [4, 4, 4] };

    fn key(n: u8) -> BrickSetKey {
        BrickSetKey(Digest32([n; 32]))
    }

    fn infos(ids: &[u32]) -> Arc<[BrickInfo]> {
        let tight = TightBox { lo: [0; 3], hi: [7; 3] };
        ids.iter().map(|&i| BrickInfo { id: BrickId(i), tight, voxels: 1, bytes: 15 }).collect()
    }

    fn brick(id: u32) -> Arc<Brick> {
        Arc::new(Brick::new(BrickId(id), vec![0, 7], Samples::U8(vec![1, 2]), None))
    }

    #[test]
    fn directories_come_in_parts_and_find_what_is_here_and_what_comes() {
        let mut cache = BrickCache::default();
        cache.put(key(1), brick(9));
        assert!(cache.directory(key(1), GRID, (0, 4), infos(&[3, 9])).is_ok());
        assert!(cache.shelf(key(1)).is_none(), "half of it");
        assert!(cache.directory(key(1), GRID, (2, 4), infos(&[11, 30])).is_ok());
        let shelf = cache.shelf(key(1)).expect("all of it").clone();
        let here = || (0..4).map(|i| shelf.has(i)).collect::<Vec<_>>();
        assert_eq!(here(), [false, true, false, false]);
        cache.put(key(1), brick(30));
        cache.put(key(1), brick(31));
        cache.remove(key(1), &[BrickId(9)]);
        assert_eq!(here(), [false, false, false, true]);
        assert_eq!(cache.encoded_bytes(), 2 * brick(1).encoded_len() as u64);
        cache.put(key(1), brick(30));
        assert_eq!(cache.encoded_bytes(), 2 * brick(1).encoded_len() as u64, "once");
    }

    #[test]
    fn parts_that_do_not_follow_are_refused() {
        for (first, ids) in [(1, [11, 30]), (2, [5, 30])] {
            let mut cache = BrickCache::default();
            assert!(cache.directory(key(1), GRID, (0, 4), infos(&[3, 9])).is_ok());
            assert!(cache.directory(key(1), GRID, (first, 4), infos(&ids)).is_err());
            assert!(cache.directory(key(1), GRID, (2, 4), infos(&[11, 30])).is_err());
            assert!(cache.shelf(key(1)).is_none());
        }
    }

    #[test]
    fn the_directories_that_came_last_are_kept() {
        let mut cache = BrickCache::default();
        for n in 0..DIRECTORIES as u8 + 1 {
            assert!(cache.directory(key(n), GRID, (0, 1), infos(&[3])).is_ok());
        }
        assert!(cache.shelf(key(0)).is_none());
        assert!((1..=DIRECTORIES as u8).all(|n| cache.shelf(key(n)).is_some()));
    }
}
