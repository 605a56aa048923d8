//! Regions that are stalled for want of bricks: which bricks are asked for, which make room, and
//! which regions go on.
//!
//! A region that missing bricks waits here, and its render thread takes another task. Bricks that
//! several stalled regions lack are asked for once; a region goes on when all that it asked for are
//! here.
//!
//! **Memory.** Under the `region` schedule the worker keeps its own budget: nobody else knows which
//! bricks its regions need. Before bricks are asked for, room is made: least recently drawn first,
//! of any set. Bricks that a stalled region waited for, and that a region which goes on has not
//! passed yet, are *kept*. So a region that comes to the same sheet again waits for more and loses
//! nothing. If all bricks that are here are kept, a region's request is put off until another
//! region ends, except that of the oldest region: it goes over the budget, since the picture comes
//! first, and is counted.
//!
//! This module knows neither threads nor links nor time.

use crate::brick_table::BrickTable;
use crate::cache::BrickCache;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{BrickId, FrameId, TaskId};
use slabcast_render::region::BrickSupply;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A region of a frame. Regions of older frames sort first.
pub(crate) type RegionKey = (FrameId, TaskId);

/// A brick: its set, and its index in the set's directory.
type BrickKey = (BrickSetKey, u32);

/// Divisor of the budget: this part of it is freed beyond what is needed, so that not every request
/// searches all bricks. At twice this, a search frees 3 % of the budget; at half, an eighth of the
/// memory lies idle.
const SPARE_DIVISOR: u64 = 16;

/// Bricks that one region of this worker waits for, by place.
struct RegionNeeds {
    set: BrickSetKey,
    table: Arc<BrickTable>,
    /// Bricks that it has waited for since it last got deeper.
    keeps: BTreeSet<u32>,
    /// Bricks that it waits for; none while it is not stalled.
    missing: BTreeSet<u32>,
    /// Whether all of `missing` were asked for.
    asked: bool,
}

/// A message to the master about bricks. The order of messages matters.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum BrickRequest {
    /// Bricks that were dropped to make room.
    Forgotten(BrickSetKey, Vec<BrickId>),
    /// Bricks that the master must send.
    Wanted(BrickSetKey, Vec<BrickId>),
}

/// See the head of the file.
pub(crate) struct Stalls {
    budget_bytes: u64,
    regions: BTreeMap<RegionKey, RegionNeeds>,
    /// Bricks that were asked for and are not here, with the regions that wait for each.
    requested: BTreeMap<BrickKey, BTreeSet<RegionKey>>,
    /// Encoded bytes of `requested`.
    requested_bytes: u64,
    /// Number of regions that keep a brick.
    kept: BTreeMap<BrickKey, u32>,
    /// Value of `clock` when a brick was drawn last, or arrived, by place.
    last_used: BTreeMap<BrickSetKey, Vec<u64>>,
    clock: u64,
    /// Upper bound of the encoded bytes of the bricks here that no region keeps. A search of all bricks
    /// sets it. It spares the search where it can't make enough room.
    droppable_bytes: u64,
    /// Number of requests that went over the budget.
    pub(crate) over_budget: u64,
}

impl Stalls {
    pub(crate) fn new(budget_bytes: u64) -> Stalls {
        Stalls {
            budget_bytes,
            regions: BTreeMap::new(),
            requested: BTreeMap::new(),
            requested_bytes: 0,
            kept: BTreeMap::new(),
            last_used: BTreeMap::new(),
            clock: 0,
            droppable_bytes: u64::MAX,
            over_budget: 0,
        }
    }

    /// Sets the encoded bytes of bricks that may be here from now on.
    pub(crate) fn set_budget(&mut self, budget_bytes: u64) {
        self.budget_bytes = budget_bytes;
    }

    /// Adds a region, which waits for nothing yet.
    pub(crate) fn add(&mut self, key: RegionKey, set: BrickSetKey, table: Arc<BrickTable>) {
        let (keeps, missing) = Default::default();
        self.regions.insert(key, RegionNeeds { set, table, keeps, missing, asked: true });
    }

    /// Notes that a region lacks the bricks at the places `missing`. `is_deeper`: at a deeper sheet
    /// than when it lacked some before. Returns true if all have come meanwhile, so that the
    /// region goes on, and false if it is stalled.
    pub(crate) fn stall(&mut self, key: RegionKey, missing: &[u32], is_deeper: bool) -> bool {
        let Some(region) = self.regions.get_mut(&key) else { return false };
        let before = if is_deeper { std::mem::take(&mut region.keeps) } else { BTreeSet::new() };
        for &place in missing {
            if region.keeps.insert(place) {
                *self.kept.entry((region.set, place)).or_default() += 1;
            }
            if !region.table.has(place) {
                region.missing.insert(place);
            }
        }
        region.asked = region.missing.is_empty();
        let (set, table, goes_on) = (region.set, region.table.clone(), region.asked);
        self.release(set, &table, before);
        goes_on
    }

    /// Returns the bricks to ask for so that regions which are not begun find them here: those of
    /// `places` that are neither here nor on their way, as far as the budget has room. Nothing is
    /// dropped to make room.
    pub(crate) fn prefetch(
        &mut self,
        set: BrickSetKey,
        table: &BrickTable,
        places: &[u32],
        cache: &BrickCache,
    ) -> Vec<BrickId> {
        let mut ids = Vec::new();
        for &place in places {
            let brick = &table.bricks()[place as usize];
            let after = cache.encoded_bytes() + self.requested_bytes + u64::from(brick.bytes);
            if after > self.budget_bytes {
                break;
            }
            if !table.has(place) && !self.requested.contains_key(&(set, place)) {
                self.requested.insert((set, place), BTreeSet::new());
                self.requested_bytes += u64::from(brick.bytes);
                ids.push(brick.id);
            }
        }
        ids
    }

    /// Whether a region waits for bricks that were asked for.
    pub(crate) fn waits_for_bricks(&self) -> bool {
        self.regions.values().any(|region| region.asked && !region.missing.is_empty())
    }

    /// Ends a region's claim on bricks.
    fn release(
        &mut self,
        set: BrickSetKey,
        table: &BrickTable,
        places: impl IntoIterator<Item = u32>,
    ) {
        for place in places {
            if let Some(n) = self.kept.get_mut(&(set, place)) {
                *n -= 1;
                if *n == 0 {
                    self.kept.remove(&(set, place));
                    self.may_drop(u64::from(table.bricks()[place as usize].bytes));
                }
            }
        }
    }

    /// Notes that at most `bytes` encoded bytes of bricks may be dropped that could not before.
    fn may_drop(&mut self, bytes: u64) {
        self.droppable_bytes = self.droppable_bytes.saturating_add(bytes);
    }

    /// Notes that bricks have come of a set without a directory, from which no region draws.
    pub(crate) fn bricks_without_table(&mut self) {
        self.droppable_bytes = u64::MAX;
    }

    /// Removes a region that is done, failed, or of a frame that has ended. `touched`: places of
    /// the bricks that it drew.
    pub(crate) fn remove(&mut self, key: RegionKey, touched: &[u32]) {
        let Some(region) = self.regions.remove(&key) else { return };
        self.clock += 1;
        let last_used = self.last_used.entry(region.set).or_default();
        last_used.resize(region.table.bricks().len().max(last_used.len()), 0);
        for &place in touched {
            last_used[place as usize] = self.clock;
        }
        for place in region.missing {
            let brick = (region.set, place);
            if let Some(waiting) = self.requested.get_mut(&brick) {
                waiting.remove(&key);
                // No region waits for it. It may arrive all the same, or be asked for again.
                if waiting.is_empty() {
                    self.requested.remove(&brick);
                    self.requested_bytes -= u64::from(region.table.bricks()[place as usize].bytes);
                }
            }
        }
        self.release(region.set, &region.table, region.keeps);
    }

    /// Removes the regions of a frame that were stalled, and returns them.
    pub(crate) fn end_frame(&mut self, frame: FrameId) -> Vec<RegionKey> {
        let range = (frame, TaskId(0))..=(frame, TaskId(u64::MAX));
        let stalled: Vec<RegionKey> = self
            .regions
            .range(range)
            .filter(|(_, s)| !s.missing.is_empty())
            .map(|(key, _)| *key)
            .collect();
        for &key in &stalled {
            self.remove(key, &[]);
        }
        stalled
    }

    /// Notes that a brick has come into its table. Adds the regions that go on now to `on`.
    pub(crate) fn brick_arrived(
        &mut self,
        set: BrickSetKey,
        table: &BrickTable,
        id: BrickId,
        on: &mut Vec<RegionKey>,
    ) {
        let Some(place) = table.place(id) else { return };
        self.clock += 1;
        let last_used = self.last_used.entry(set).or_default();
        last_used.resize(table.bricks().len().max(last_used.len()), 0);
        last_used[place as usize] = self.clock;
        let bytes = u64::from(table.bricks()[place as usize].bytes);
        if self.requested.remove(&(set, place)).is_some() {
            self.requested_bytes -= bytes;
        }
        if !self.kept.contains_key(&(set, place)) {
            self.may_drop(bytes);
        }
        // Regions whose request was put off as well as those that asked.
        for (key, region) in self.regions.iter_mut().filter(|(_, s)| s.set == set) {
            if region.missing.remove(&place) && region.missing.is_empty() {
                region.asked = true;
                on.push(*key);
            }
        }
    }

    /// Asks for the bricks that stalled regions lack, as far as there is room or room can be made.
    /// Returns the messages to the master; bricks that make room are dropped from `cache`.
    pub(crate) fn requests(&mut self, cache: &mut BrickCache) -> Vec<BrickRequest> {
        let mut requests = Vec::new();
        if self.regions.is_empty() {
            // No regions: the schedule is `slab`, and the master keeps this worker's budget.
            return requests;
        }
        // Sets without a directory are not drawn, so their bricks are dropped first.
        let sets = self.last_used.len();
        self.last_used.retain(|set, _| cache.table(*set).is_some());
        if self.last_used.len() < sets {
            self.droppable_bytes = u64::MAX;
        }
        // Bricks that came without being asked for may exceed the budget, too.
        self.make_room(cache, 0, true, &mut requests);
        let oldest = self.regions.keys().next().copied();
        let pending: Vec<RegionKey> =
            self.regions.iter().filter(|(_, s)| !s.asked).map(|(key, _)| *key).collect();
        for key in pending {
            let region = &self.regions[&key];
            let (set, table) = (region.set, region.table.clone());
            let fresh: Vec<u32> = region
                .missing
                .iter()
                .filter(|&&place| !self.requested.contains_key(&(set, place)))
                .copied()
                .collect();
            let bytes: u64 =
                fresh.iter().map(|&i| u64::from(table.bricks()[i as usize].bytes)).sum();
            let urgent = Some(key) == oldest;
            if !self.make_room(cache, bytes, urgent, &mut requests) {
                if !urgent {
                    continue;
                }
                self.over_budget += 1;
            }
            self.requested_bytes += bytes;
            let region = self.regions.get_mut(&key).expect("a pending region is there");
            region.asked = true;
            for &place in &region.missing {
                self.requested.entry((set, place)).or_default().insert(key);
            }
            let ids = fresh.iter().map(|&i| table.bricks()[i as usize].id);
            match requests.last_mut() {
                Some(BrickRequest::Wanted(of, wanted)) if *of == set => wanted.extend(ids),
                _ if fresh.is_empty() => {}
                _ => requests.push(BrickRequest::Wanted(set, ids.collect())),
            }
        }
        requests
    }

    /// Drops bricks that no region keeps until `bytes` more fit into the budget, and returns
    /// whether they do. If they can't fit, nothing is dropped, unless it is urgent.
    fn make_room(
        &mut self,
        cache: &mut BrickCache,
        bytes: u64,
        urgent: bool,
        requests: &mut Vec<BrickRequest>,
    ) -> bool {
        let after = cache.encoded_bytes() + self.requested_bytes + bytes;
        if after <= self.budget_bytes {
            return true;
        }
        let too_few = after.saturating_sub(self.droppable_bytes) > self.budget_bytes;
        if self.droppable_bytes == 0 || (too_few && !urgent) {
            return false;
        }
        let excess = (after - self.budget_bytes) + self.budget_bytes / SPARE_DIVISOR;
        let mut victims: Vec<(u64, BrickSetKey, BrickId, u64)> = Vec::new();
        for (set, ids) in cache.held() {
            let table = cache.table(set);
            let last_used = self.last_used.get(&set);
            for id in ids {
                // Without its directory, no region draws from a set.
                let place = table.and_then(|s| s.place(id));
                if place.is_some_and(|place| self.kept.contains_key(&(set, place))) {
                    continue;
                }
                let last = place.and_then(|p| last_used?.get(p as usize).copied()).unwrap_or(0);
                let size = cache.get(set, id).map_or(0, |b| b.encoded_len() as u64);
                victims.push((last, set, id, size));
            }
        }
        let all: u64 = victims.iter().map(|v| v.3).sum();
        self.droppable_bytes = all;
        if !urgent && after - all.min(after) > self.budget_bytes {
            return false;
        }
        victims.sort_unstable();
        let mut freed = 0;
        let mut gone: BTreeMap<BrickSetKey, Vec<BrickId>> = BTreeMap::new();
        for (_, set, id, size) in victims {
            if freed >= excess {
                break;
            }
            freed += size;
            gone.entry(set).or_default().push(id);
        }
        self.droppable_bytes -= freed;
        for (set, ids) in gone {
            cache.remove(set, &ids);
            requests.push(BrickRequest::Forgotten(set, ids));
        }
        after - freed.min(after) <= self.budget_bytes
    }
}

#[cfg(test)]
mod tests;
