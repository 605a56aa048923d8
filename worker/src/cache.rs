//! Bricks that a worker holds, by set.

use slabcast_common::brick::{Brick, BrickSetKey};
use slabcast_common::ids::BrickId;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Bricks by set and id. What stays and what goes is the master's decision (`DropBricks`), which
/// knows the budget; so both always agree on what is here.
#[derive(Default)]
pub struct BrickCache {
    sets: BTreeMap<BrickSetKey, BTreeMap<BrickId, Arc<Brick>>>,
}

impl BrickCache {
    /// Takes a brick in; a second copy of one replaces the first.
    pub fn put(&mut self, set: BrickSetKey, brick: Arc<Brick>) {
        self.sets.entry(set).or_default().insert(brick.id, brick);
    }

    /// A brick, if it is here.
    pub fn get(&self, set: BrickSetKey, id: BrickId) -> Option<&Arc<Brick>> {
        self.sets.get(&set)?.get(&id)
    }

    /// Forgets bricks.
    pub fn remove(&mut self, set: BrickSetKey, ids: &[BrickId]) {
        if let Some(bricks) = self.sets.get_mut(&set) {
            for id in ids {
                bricks.remove(id);
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
}
