//! Brick sets that the master holds.
//!
//! A transfer function may need a set of its own, and a stranger may send many functions. So sets
//! are bounded in number and bytes whatever jobs are open, and one is cut at a time. A job whose
//! set is not there waits; a set that makes place for another is cut again when its job's turn
//! comes. A set that a frame in flight draws from stays, and so does one that came just now: else
//! two jobs would take each other's bricks away before either draws a frame.

use slabcast_common::brick::BrickSetKey;
use slabcast_common::volume::Digest32;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_schedule::Micros;
use slabcast_volumes::BrickStore;
use std::sync::Arc;

/// Most brick sets side by side: a change of transfer function and back costs nothing then. A live
/// session has four: all detail and a coarser level for moving, each with all voxels too while its
/// transfer function is edited. With 3 it cut its own sets anew at each rest; more than this would
/// only fill the master's memory.
const KEPT: usize = 8;

/// Microseconds that a set stays at least while a job needs it. Cutting mri256 takes 0.1 s: at half
/// of this, a tenth of the time of four jobs with four functions goes into cutting.
pub(crate) const STAYS: Micros = 2_000_000;

/// A set that is held.
struct Held {
    store: Arc<BrickStore>,
    /// When it was cut.
    since: Micros,
}

/// The sets, the last used last.
pub(crate) struct BrickSets {
    sets: Vec<Held>,
    budget_bytes: u64,
    /// The set that is being cut, and its bytes at most.
    cutting: Option<(BrickSetKey, u64)>,
}

impl BrickSets {
    /// No sets, of which there may be `budget_bytes`.
    pub(crate) fn new(budget_bytes: u64) -> BrickSets {
        BrickSets { sets: Vec::new(), budget_bytes, cutting: None }
    }

    /// A set of the volume with digest `volume` that covers `wanted`.
    pub(crate) fn covering(
        &self,
        volume: Digest32,
        wanted: &BrickNeeds,
    ) -> Option<&Arc<BrickStore>> {
        let is_of_volume = |s: &BrickStore| s.key() == s.needs().set_key(volume);
        let mut stores = self.sets.iter().map(|held| &held.store);
        stores.find(|s| is_of_volume(s) && s.needs().covers(wanted))
    }

    /// The set with this key.
    pub(crate) fn get(&self, key: BrickSetKey) -> Option<&Arc<BrickStore>> {
        self.sets.iter().map(|held| &held.store).find(|s| s.key() == key)
    }

    /// The last used set of the volume with digest `volume`, from which another may take blocks.
    pub(crate) fn latest_of(&self, volume: Digest32) -> Option<Arc<BrickStore>> {
        let is_of_volume = |s: &BrickStore| s.key() == s.needs().set_key(volume);
        let mut stores = self.sets.iter().rev().map(|held| &held.store);
        stores.find(|store| is_of_volume(store)).cloned()
    }

    /// Notes that a set is used now.
    pub(crate) fn used(&mut self, key: BrickSetKey) {
        if let Some(i) = self.sets.iter().position(|held| held.store.key() == key) {
            let held = self.sets.remove(i);
            self.sets.push(held);
        }
    }

    /// Whether a set is being cut.
    pub(crate) fn is_cutting(&self) -> bool {
        self.cutting.is_some()
    }

    /// Makes place for a set of at most `bytes` and notes that it is being cut. False if another is
    /// being cut, or the sets that are held must stay. `must_stay`: a frame is drawn from the set;
    /// `is_needed`: an open job is.
    pub(crate) fn begin_cut(
        &mut self,
        key: BrickSetKey,
        bytes: u64,
        now: Micros,
        must_stay: impl Fn(BrickSetKey) -> bool,
        is_needed: impl Fn(BrickSetKey) -> bool,
    ) -> bool {
        if self.cutting.is_some() {
            return false;
        }
        let may_go = |held: &Held| {
            let key = held.store.key();
            !must_stay(key) && (now >= held.since + STAYS || !is_needed(key))
        };
        let (mut number, mut held_bytes) = (self.sets.len(), self.bytes());
        let fits = |number: usize, held_bytes: u64| {
            number == 0 || (number < KEPT && held_bytes.saturating_add(bytes) <= self.budget_bytes)
        };
        let mut leaving = Vec::new();
        for held in self.sets.iter().filter(|held| may_go(held)) {
            if fits(number, held_bytes) {
                break;
            }
            (number, held_bytes) = (number - 1, held_bytes - held.store.kept_bytes());
            leaving.push(held.store.key());
        }
        if !fits(number, held_bytes) {
            return false;
        }
        self.sets.retain(|held| !leaving.contains(&held.store.key()));
        self.cutting = Some((key, bytes));
        true
    }

    /// Keeps the set that was cut as the last used one.
    pub(crate) fn cut(&mut self, store: Arc<BrickStore>, now: Micros) {
        self.cutting = None;
        self.sets.push(Held { store, since: now });
    }

    /// Notes that a set could not be cut.
    pub(crate) fn cut_failed(&mut self) {
        self.cutting = None;
    }

    /// Forgets a set whose bricks can't be read any more.
    pub(crate) fn forget(&mut self, key: BrickSetKey) {
        self.sets.retain(|held| held.store.key() != key);
    }

    /// Bytes of all sets that are held.
    fn bytes(&self) -> u64 {
        self.sets.iter().map(|held| held.store.kept_bytes()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::transfer::Support;
    use slabcast_common::volume::Volume;

    /// A set of the voxels above `cut`.
    fn set(cut: u8) -> Arc<BrickStore> {
        let volume = Volume::from_fn_u8("v", [8; 3], |i, j, k| (i * 30 + j + k) as u8);
        let support = Support { intervals: vec![(f64::from(cut), 255.0)], nan: false };
        let needs = BrickNeeds { support, ..BrickNeeds::default() };
        Arc::new(BrickStore::build(&volume, volume.digest(), &needs))
    }

    #[test]
    fn sets_are_bounded_in_number_whatever_jobs_are_open() {
        let mut sets = BrickSets::new(u64::MAX);
        for i in 0..24u8 {
            let (store, now) = (set(i), STAYS * Micros::from(i));
            assert!(sets.begin_cut(store.key(), 1, now, |_| false, |_| true), "set {i}");
            assert!(!sets.begin_cut(store.key(), 1, now, |_| false, |_| true), "one at a time");
            sets.cut(store, now);
            assert!(sets.sets.len() <= KEPT);
        }
    }

    #[test]
    fn sets_are_bounded_in_bytes_and_one_may_be_larger() {
        let bytes = set(0).bytes();
        let mut sets = BrickSets::new(bytes + bytes / 2);
        for i in 0..4u8 {
            let store = set(i);
            let now = STAYS * Micros::from(i);
            assert!(sets.begin_cut(store.key(), bytes, now, |_| false, |_| true));
            sets.cut(store, now);
            assert_eq!(sets.sets.len(), 1);
        }
    }

    #[test]
    fn set_of_a_frame_in_flight_and_a_fresh_set_that_is_needed_stay() {
        let stores: Vec<_> = (0..=KEPT as u8).map(set).collect();
        let mut sets = BrickSets::new(u64::MAX);
        for store in &stores[..KEPT] {
            assert!(sets.begin_cut(store.key(), 1, 0, |_| false, |_| true));
            sets.cut(store.clone(), 0);
        }
        let key = stores[KEPT].key();
        assert!(!sets.begin_cut(key, 1, STAYS - 1, |_| false, |_| true), "all are fresh");
        assert!(!sets.begin_cut(key, 1, STAYS, |_| true, |_| true), "all are drawn from");
        let first = stores[0].key();
        sets.used(first);
        assert!(sets.begin_cut(key, 1, 0, |_| false, |key| key == first), "one is nobody's");
        assert!(sets.get(first).is_some() && sets.get(stores[1].key()).is_none());
    }
}
