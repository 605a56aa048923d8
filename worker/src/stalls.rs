//! Regions that stand still for want of bricks: what is asked for, what makes room, who goes on.
//!
//! A region that lacks bricks is *parked* here, and its render thread takes another. What all parked
//! regions lack is asked for together, each brick once; a region goes on when all that it asked for is
//! here.
//!
//! **Memory.** Under this schedule the worker keeps its own budget: nobody else knows what its regions
//! stand on. Before bricks are asked for, room is made: least recently drawn first, of any set. What a
//! parked region waited for, and a region that goes on has not got past yet, is *kept*. So a region that
//! comes to the same sheet again waits for more and loses nothing. Where all that is here is kept, a
//! region's wish is put off until another ends, except the oldest one's: that goes over the budget,
//! since the picture comes first, and is counted.
//!
//! It refuses to know threads, links and time.

use crate::brick_table::Shelf;
use crate::cache::BrickCache;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{BrickId, FrameId, TaskId};
use slabcast_render::region::BrickSupply;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A region, the older frame's first.
pub(crate) type Who = (FrameId, TaskId);

/// A brick: its set, and its place in the directory.
type Which = (BrickSetKey, u32);

/// Part of the budget that is freed beyond what is needed, as a divisor, so that not every wish looks
/// through all bricks. At twice this each look frees 3 %; at half, an eighth of the memory lies idle.
const SPARE: u64 = 16;

/// A region that the worker has.
struct Stay {
    set: BrickSetKey,
    shelf: Arc<Shelf>,
    /// What it waited for since it last came farther.
    keeps: BTreeSet<u32>,
    /// What it waits for.
    lacks: BTreeSet<u32>,
    /// All of that was asked for.
    asked: bool,
}

/// What is to be said to the master, in this order.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Say {
    Forgotten(BrickSetKey, Vec<BrickId>),
    Wanted(BrickSetKey, Vec<BrickId>),
}

/// See the head of the file.
pub(crate) struct Parking {
    budget: u64,
    stays: BTreeMap<Who, Stay>,
    /// Bricks that were asked for and are not here, with those who wait.
    coming: BTreeMap<Which, BTreeSet<Who>>,
    /// Encoded bytes of those.
    coming_bytes: u64,
    /// How many regions keep a brick.
    kept: BTreeMap<Which, u32>,
    /// When a brick was drawn last, or came.
    drawn: BTreeMap<BrickSetKey, Vec<u64>>,
    clock: u64,
    /// Wishes that went over the budget.
    pub(crate) over_budget: u64,
}

impl Parking {
    pub(crate) fn new(budget: u64) -> Parking {
        Parking {
            budget,
            stays: BTreeMap::new(),
            coming: BTreeMap::new(),
            coming_bytes: 0,
            kept: BTreeMap::new(),
            drawn: BTreeMap::new(),
            clock: 0,
            over_budget: 0,
        }
    }

    /// A region comes.
    pub(crate) fn enter(&mut self, who: Who, set: BrickSetKey, shelf: Arc<Shelf>) {
        let (keeps, lacks) = Default::default();
        self.stays.insert(who, Stay { set, shelf, keeps, lacks, asked: true });
    }

    /// A region lacks bricks (places in its directory). `farther`: it came farther since it last did.
    /// True: they came meanwhile, it goes on. False: it is parked.
    pub(crate) fn park(&mut self, who: Who, lacks: &[u32], farther: bool) -> bool {
        let Some(stay) = self.stays.get_mut(&who) else { return false };
        let before = if farther { std::mem::take(&mut stay.keeps) } else { BTreeSet::new() };
        for &place in lacks {
            if stay.keeps.insert(place) {
                *self.kept.entry((stay.set, place)).or_default() += 1;
            }
            if !stay.shelf.has(place) {
                stay.lacks.insert(place);
            }
        }
        stay.asked = stay.lacks.is_empty();
        let (set, on) = (stay.set, stay.lacks.is_empty());
        self.let_go(set, before);
        on
    }

    /// Regions that are not begun will need these: which of them are to be asked for. Nothing is forgotten for that.
    pub(crate) fn expect(
        &mut self,
        set: BrickSetKey,
        shelf: &Shelf,
        places: &[u32],
        cache: &BrickCache,
    ) -> Vec<BrickId> {
        let mut ids = Vec::new();
        for &place in places {
            let brick = &shelf.bricks()[place as usize];
            let after = cache.encoded_bytes() + self.coming_bytes + u64::from(brick.bytes);
            if after > self.budget {
                break;
            }
            if !shelf.has(place) && !self.coming.contains_key(&(set, place)) {
                self.coming.insert((set, place), BTreeSet::new());
                self.coming_bytes += u64::from(brick.bytes);
                ids.push(brick.id);
            }
        }
        ids
    }

    fn let_go(&mut self, set: BrickSetKey, places: impl IntoIterator<Item = u32>) {
        for place in places {
            if let Some(n) = self.kept.get_mut(&(set, place)) {
                *n -= 1;
                if *n == 0 {
                    self.kept.remove(&(set, place));
                }
            }
        }
    }

    /// A region is at its end, having drawn from these; or its frame is, in whatever way.
    pub(crate) fn leave(&mut self, who: Who, touched: &[u32]) {
        let Some(stay) = self.stays.remove(&who) else { return };
        self.clock += 1;
        let drawn = self.drawn.entry(stay.set).or_default();
        drawn.resize(stay.shelf.bricks().len().max(drawn.len()), 0);
        for &place in touched {
            drawn[place as usize] = self.clock;
        }
        for place in stay.lacks {
            let which = (stay.set, place);
            if let Some(waiting) = self.coming.get_mut(&which) {
                waiting.remove(&who);
                // Nobody waits for it. It may come all the same, or be asked for again.
                if waiting.is_empty() {
                    self.coming.remove(&which);
                    self.coming_bytes -= u64::from(stay.shelf.bricks()[place as usize].bytes);
                }
            }
        }
        self.let_go(stay.set, stay.keeps);
    }

    /// A frame is over: those of its regions that were parked.
    pub(crate) fn end_frame(&mut self, frame: FrameId) -> Vec<Who> {
        let range = (frame, TaskId(0))..=(frame, TaskId(u64::MAX));
        let parked: Vec<Who> = self
            .stays
            .range(range)
            .filter(|(_, s)| !s.lacks.is_empty())
            .map(|(who, _)| *who)
            .collect();
        for &who in &parked {
            self.leave(who, &[]);
        }
        parked
    }

    /// A brick came and is on its shelf. Who goes on now is added to `on`.
    pub(crate) fn came(&mut self, set: BrickSetKey, shelf: &Shelf, id: BrickId, on: &mut Vec<Who>) {
        let Some(place) = shelf.place(id) else { return };
        self.clock += 1;
        let drawn = self.drawn.entry(set).or_default();
        drawn.resize(shelf.bricks().len().max(drawn.len()), 0);
        drawn[place as usize] = self.clock;
        if self.coming.remove(&(set, place)).is_some() {
            self.coming_bytes -= u64::from(shelf.bricks()[place as usize].bytes);
        }
        // Those whose wish was put off as well as those who asked.
        for (who, stay) in self.stays.iter_mut().filter(|(_, s)| s.set == set) {
            if stay.lacks.remove(&place) && stay.lacks.is_empty() {
                stay.asked = true;
                on.push(*who);
            }
        }
    }

    /// Asks for what is lacked, as far as there is room or can be made; forgets what makes it.
    pub(crate) fn ask(&mut self, cache: &mut BrickCache) -> Vec<Say> {
        let mut say = Vec::new();
        if self.stays.is_empty() {
            // The master keeps the budget: under the other schedule, it knows what is needed.
            return say;
        }
        // What came without being asked for may be too much, too.
        self.make_room(cache, 0, true, &mut say);
        let oldest = self.stays.keys().next().copied();
        let wishes: Vec<Who> =
            self.stays.iter().filter(|(_, s)| !s.asked).map(|(who, _)| *who).collect();
        for who in wishes {
            let stay = &self.stays[&who];
            let (set, shelf) = (stay.set, stay.shelf.clone());
            let fresh: Vec<u32> = stay
                .lacks
                .iter()
                .filter(|&&place| !self.coming.contains_key(&(set, place)))
                .copied()
                .collect();
            let bytes: u64 =
                fresh.iter().map(|&i| u64::from(shelf.bricks()[i as usize].bytes)).sum();
            let urgent = Some(who) == oldest;
            if !self.make_room(cache, bytes, urgent, &mut say) {
                if !urgent {
                    continue;
                }
                self.over_budget += 1;
            }
            self.coming_bytes += bytes;
            let stay = self.stays.get_mut(&who).expect("it wishes");
            stay.asked = true;
            for &place in &stay.lacks {
                self.coming.entry((set, place)).or_default().insert(who);
            }
            let ids = fresh.iter().map(|&i| shelf.bricks()[i as usize].id);
            match say.last_mut() {
                Some(Say::Wanted(of, wanted)) if *of == set => wanted.extend(ids),
                _ if fresh.is_empty() => {}
                _ => say.push(Say::Wanted(set, ids.collect())),
            }
        }
        say
    }

    /// Whether so many bytes fit, after forgetting what can be forgotten. Nothing is where that would
    /// be in vain, unless it is urgent.
    fn make_room(
        &mut self,
        cache: &mut BrickCache,
        bytes: u64,
        urgent: bool,
        say: &mut Vec<Say>,
    ) -> bool {
        let after = cache.encoded_bytes() + self.coming_bytes + bytes;
        if after <= self.budget {
            return true;
        }
        let excess = (after - self.budget) + self.budget / SPARE;
        let mut victims: Vec<(u64, BrickSetKey, BrickId, u64)> = Vec::new();
        for (set, ids) in cache.held() {
            let shelf = cache.shelf(set);
            let drawn = self.drawn.get(&set);
            for id in ids {
                // Where there is no directory, no region stands on it.
                let place = shelf.and_then(|s| s.place(id));
                if place.is_some_and(|place| self.kept.contains_key(&(set, place))) {
                    continue;
                }
                let last = place.and_then(|p| drawn?.get(p as usize).copied()).unwrap_or(0);
                let size = cache.get(set, id).map_or(0, |b| b.encoded_len() as u64);
                victims.push((last, set, id, size));
            }
        }
        let all: u64 = victims.iter().map(|v| v.3).sum();
        if !urgent && after - all.min(after) > self.budget {
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
        for (set, ids) in gone {
            cache.remove(set, &ids);
            say.push(Say::Forgotten(set, ids));
        }
        after - freed.min(after) <= self.budget
    }
}

#[cfg(test)]
mod tests;
