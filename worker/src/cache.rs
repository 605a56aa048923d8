//! The bricks that a worker holds, by set, and the directories of sets.

use crate::brick_table::BrickTable;
use crate::memory;
use slabcast_common::brick::{Brick, BrickGrid, BrickInfo, BrickSetKey};
use slabcast_common::ids::BrickId;
use slabcast_common::message::DIRECTORIES_KEPT;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// The bricks that a worker holds, by set and id. They outlive a link: a worker that comes back
/// lists them in its hello.
///
/// Under the `slab` schedule the master decides which bricks stay (`DropBricks`), since it decides
/// which are needed; under `region` the worker decides and tells the master (`stalls`). So both
/// always agree on which bricks are here.
#[derive(Default)]
pub struct BrickCache {
    sets: BTreeMap<BrickSetKey, BTreeMap<BrickId, Arc<Brick>>>,
    /// Encoded bytes of all bricks.
    encoded: u64,
    /// Bytes that all bricks take in memory.
    resident: u64,
    /// Bytes of memory that they may take; `None` where the worker has no limit of its own.
    limit: Option<u64>,
    /// Sets whose directories are here, the latest last.
    tables: VecDeque<(BrickSetKey, Arc<BrickTable>)>,
    /// A directory of which more parts are to come.
    coming: Option<Coming>,
}

/// The first parts of a directory.
struct Coming {
    set: BrickSetKey,
    grid: BrickGrid,
    total: u32,
    bricks: Vec<BrickInfo>,
}

/// Bytes of memory that a brick takes beside its own struct and numbers: the counts of its `Arc`, its
/// place in the map, and what the allocator adds to four pieces.
const BESIDE_BYTES: u64 = 16 + 24 + 4 * 16;

fn resident_bytes(brick: &Brick) -> u64 {
    brick.memory_bytes() as u64 + BESIDE_BYTES
}

impl BrickCache {
    /// Returns an empty cache of a worker with `threads` render threads, whose process is to stay
    /// within `limit_bytes` of memory.
    pub fn within(limit_bytes: u64, threads: u32) -> BrickCache {
        let limit = Some(memory::bricks_bytes(limit_bytes, threads));
        BrickCache { limit, ..BrickCache::default() }
    }

    /// Returns the encoded bytes of bricks that may be here now; `None` without a limit.
    pub(crate) fn budget(&self) -> Option<u64> {
        self.limit.map(|limit| memory::encoded_budget(limit, self.encoded, self.resident))
    }

    /// Adds a brick. A second copy of a brick replaces the first.
    pub fn put(&mut self, set: BrickSetKey, brick: Arc<Brick>) {
        if let Some(table) = self.table(set) {
            table.put(brick.id, Some(brick.clone()));
        }
        self.encoded += brick.encoded_len() as u64;
        self.resident += resident_bytes(&brick);
        if let Some(before) = self.sets.entry(set).or_default().insert(brick.id, brick) {
            self.encoded -= before.encoded_len() as u64;
            self.resident -= resident_bytes(&before);
        }
    }

    /// Returns a brick, if it is here.
    pub fn get(&self, set: BrickSetKey, id: BrickId) -> Option<&Arc<Brick>> {
        self.sets.get(&set)?.get(&id)
    }

    /// Drops the bricks of `set` with these ids; ids of bricks that are not here are ignored.
    pub fn remove(&mut self, set: BrickSetKey, ids: &[BrickId]) {
        let table = self.table(set).cloned();
        if let Some(bricks) = self.sets.get_mut(&set) {
            for id in ids {
                if let Some(brick) = bricks.remove(id) {
                    self.encoded -= brick.encoded_len() as u64;
                    self.resident -= resident_bytes(&brick);
                }
                if let Some(table) = &table {
                    table.put(*id, None);
                }
            }
            if bricks.is_empty() {
                self.sets.remove(&set);
            }
        }
    }

    /// Returns the ids of all bricks that are here, by set, ascending: what a hello lists.
    pub fn held(&self) -> Vec<(BrickSetKey, Vec<BrickId>)> {
        self.sets.iter().map(|(key, bricks)| (*key, bricks.keys().copied().collect())).collect()
    }

    /// Returns the number of bricks in the cache, over all sets.
    pub fn len(&self) -> usize {
        self.sets.values().map(BTreeMap::len).sum()
    }

    /// Returns whether the cache holds no brick.
    pub fn is_empty(&self) -> bool {
        self.sets.is_empty()
    }

    /// Returns the bytes that the bricks take in memory.
    pub fn bytes(&self) -> u64 {
        self.resident
    }

    /// Returns the encoded bytes of the bricks, which memory budgets count.
    pub fn encoded_bytes(&self) -> u64 {
        self.encoded
    }

    /// Adds a part of a directory: `bricks` from index `first` on, of `total`.
    ///
    /// # Errors
    /// If the part does not go on where the one before ended. The directory is dropped then.
    pub(crate) fn directory(
        &mut self,
        set: BrickSetKey,
        grid: BrickGrid,
        (first, total): (u32, u32),
        bricks: Arc<[BrickInfo]>,
    ) -> Result<(), &'static str> {
        let mut coming = match self.coming.take() {
            _ if first == 0 => {
                if bricks.len() == total as usize {
                    self.add_table(set, BrickTable::new(grid, bricks));
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
            self.add_table(set, BrickTable::new(grid, coming.bricks.into()));
        } else {
            self.coming = Some(coming);
        }
        Ok(())
    }

    /// Adds a directory as the latest. Directories beyond [`DIRECTORIES_KEPT`] go, but for those that
    /// regions still draw from. If the master sends a directory again that is here, the old one is
    /// kept, so that its regions see new bricks.
    fn add_table(&mut self, set: BrickSetKey, table: BrickTable) {
        if let Some(i) = self.tables.iter().position(|(key, _)| *key == set) {
            let here = self.tables.remove(i).filter(|(_, here)| here.is_like(&table));
            if let Some(here) = here {
                self.tables.push_back(here);
                return;
            }
        }
        for brick in self.sets.get(&set).into_iter().flat_map(BTreeMap::values) {
            table.put(brick.id, Some(brick.clone()));
        }
        self.tables.push_back((set, Arc::new(table)));
        let mut others = self.tables.len().saturating_sub(DIRECTORIES_KEPT);
        self.tables.retain(|(_, table)| {
            let is_other = others > 0;
            others = others.saturating_sub(1);
            !is_other || Arc::strong_count(table) > 1
        });
    }

    /// Drops all directories, since the master of a new link sends them anew.
    pub(crate) fn forget_directories(&mut self) {
        self.tables.clear();
        self.coming = None;
    }

    /// Returns a set with its directory, if the directory is here.
    pub(crate) fn table(&self, set: BrickSetKey) -> Option<&Arc<BrickTable>> {
        self.tables.iter().find(|(key, _)| *key == set).map(|(_, table)| table)
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
    fn directory_in_parts_knows_bricks_that_came_before_and_after_it() {
        let mut cache = BrickCache::default();
        cache.put(key(1), brick(9));
        assert!(cache.directory(key(1), GRID, (0, 4), infos(&[3, 9])).is_ok());
        assert!(cache.table(key(1)).is_none(), "half of it");
        assert!(cache.directory(key(1), GRID, (2, 4), infos(&[11, 30])).is_ok());
        let table = cache.table(key(1)).expect("all of it").clone();
        let here = || (0..4).map(|i| table.has(i)).collect::<Vec<_>>();
        assert_eq!(here(), [false, true, false, false]);
        cache.put(key(1), brick(30));
        cache.put(key(1), brick(31));
        cache.remove(key(1), &[BrickId(9)]);
        assert_eq!(here(), [false, false, false, true]);
        assert_eq!(cache.encoded_bytes(), 2 * brick(1).encoded_len() as u64);
        cache.put(key(1), brick(30));
        assert_eq!(cache.encoded_bytes(), 2 * brick(1).encoded_len() as u64, "once");
        let each = brick(1).memory_bytes() as u64 + BESIDE_BYTES;
        assert_eq!(cache.bytes(), 2 * each, "in memory, with what stands beside");
        cache.remove(key(1), &[BrickId(30), BrickId(31), BrickId(77)]);
        assert_eq!((cache.bytes(), cache.encoded_bytes()), (0, 0));
    }

    #[test]
    fn only_a_cache_with_a_limit_has_a_budget() {
        assert_eq!(BrickCache::default().budget(), None);
        let cache = BrickCache::within(512 << 20, 2);
        let budget = cache.budget().expect("a budget");
        assert!((1 << 20..512 << 20).contains(&budget), "{budget}");
    }

    #[test]
    fn directory_parts_out_of_order_are_refused() {
        for (first, ids) in [(1, [11, 30]), (2, [5, 30])] {
            let mut cache = BrickCache::default();
            assert!(cache.directory(key(1), GRID, (0, 4), infos(&[3, 9])).is_ok());
            assert!(cache.directory(key(1), GRID, (first, 4), infos(&ids)).is_err());
            assert!(cache.directory(key(1), GRID, (2, 4), infos(&[11, 30])).is_err());
            assert!(cache.table(key(1)).is_none());
        }
    }

    #[test]
    fn directory_that_a_region_draws_from_stays_and_gets_its_bricks() {
        let mut cache = BrickCache::default();
        assert!(cache.directory(key(0), GRID, (0, 1), infos(&[3])).is_ok());
        let drawn = cache.table(key(0)).expect("it is here").clone();
        for n in 1..9 {
            assert!(cache.directory(key(n), GRID, (0, 1), infos(&[3])).is_ok());
        }
        assert_eq!(cache.tables.len(), DIRECTORIES_KEPT + 1);
        // To the master it is gone, so it comes again.
        assert!(cache.directory(key(0), GRID, (0, 1), infos(&[3])).is_ok());
        cache.put(key(0), brick(3));
        assert!(drawn.has(0), "the region sees its brick");
        drop(drawn);
        assert!(cache.directory(key(9), GRID, (0, 1), infos(&[3])).is_ok());
        assert_eq!(cache.tables.len(), DIRECTORIES_KEPT, "those that nobody draws from go");
        // Another list under the same key takes its place.
        assert!(cache.directory(key(9), GRID, (0, 1), infos(&[5])).is_ok());
        assert_eq!(cache.table(key(9)).expect("it is here").bricks()[0].id, BrickId(5));
    }

    #[test]
    fn latest_directories_are_kept() {
        let mut cache = BrickCache::default();
        for n in 0..DIRECTORIES_KEPT as u8 + 1 {
            assert!(cache.directory(key(n), GRID, (0, 1), infos(&[3])).is_ok());
        }
        assert!(cache.table(key(0)).is_none());
        assert!((1..=DIRECTORIES_KEPT as u8).all(|n| cache.table(key(n)).is_some()));
    }
}
