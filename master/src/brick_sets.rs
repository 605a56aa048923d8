//! Brick sets that the master keeps, the last used last.

use slabcast_common::brick::BrickSetKey;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_volumes::BrickStore;
use std::sync::Arc;

/// Brick sets kept side by side: a change of transfer function and back costs nothing then. More
/// would only fill the master's memory.
const KEPT: usize = 3;

/// The sets.
#[derive(Default)]
pub(crate) struct BrickSets {
    sets: Vec<Arc<BrickStore>>,
}

impl BrickSets {
    /// A set that covers `wanted`.
    pub(crate) fn covering(&self, wanted: &BrickNeeds) -> Option<&Arc<BrickStore>> {
        self.sets.iter().find(|s| s.needs().covers(wanted))
    }

    /// The set with this key.
    pub(crate) fn get(&self, key: BrickSetKey) -> Option<&Arc<BrickStore>> {
        self.sets.iter().find(|s| s.key() == key)
    }

    /// Keeps `store` as the last used set. Drops the least recently used sets beyond [`KEPT`] that
    /// no job needs (`is_needed`).
    pub(crate) fn keep(
        &mut self,
        store: &Arc<BrickStore>,
        is_needed: impl Fn(BrickSetKey) -> bool,
    ) {
        let key = store.key();
        self.sets.retain(|s| s.key() != key);
        self.sets.push(store.clone());
        let mut i = 0;
        while self.sets.len() > KEPT && i < self.sets.len() - 1 {
            if is_needed(self.sets[i].key()) {
                i += 1;
            } else {
                self.sets.remove(i);
            }
        }
    }
}
