//! Who holds which brick (paper section 4.4), and what goes to whom next.
//!
//! The paper broadcasts a slab's unoccluded bricks and lets every node cache all it ever got.
//! So does this room, while memory lasts. What it adds is what happens when it does not:
//!
//! - **In order.** Bricks of a set reach a worker in the order in which they were sent, so an
//!   acknowledgement is a count. Broken ones are named, and go again.
//! - **A drop takes a round trip.** `DropBricks` goes by the control link and bricks by their
//!   own. A brick that is dropped and sent again at once could arrive before the drop and be
//!   lost with it, and a lease would wait for it for ever. So a ping follows each drop, and
//!   until its pong the bricks count as resident and are not sent again.
//! - **Broadcast or lazily.** If all that a slab needs fits into a worker's budget, it gets
//!   all, and only bricks the slab doesn't need are evicted, least recently needed first. If
//!   not, it gets the bricks of the tiles it leases, and a lease only when its bricks fit beside
//!   those of its other leases. One lease that is larger than the budget alone goes anyway, and
//!   is counted: the picture comes first.
//!
//! - **On request.** Under the `region` schedule workers ask for what they need, when they need it,
//!   and make room themselves: only they know what their regions stand on. Then this room sends what
//!   was asked for and not sent, notes what they say they forgot, and evicts nothing. What they will
//!   ask for (`foresight`) it sends as well, as far as that fits beside what they have.
//!
//! The measure of memory is a brick's encoded size. A worker's own representation is larger or
//! smaller by its own factor, which it knows when it states its budget.

use slabcast_common::brick::{BrickInfo, BrickSetKey};
use slabcast_common::ids::{BrickId, WorkerId};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use crate::Micros;
use crate::state::worker_map::WorkerMap;

/// What was drawn from in so many rounds before the present one was drawn from lately, while frames overlap: one round
/// is of parts of several. Where none do one is enough.
const LATELY: u64 = 2;

/// Where a brick is, seen from one worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    /// Not there.
    Absent,
    /// Sent, not acknowledged.
    Flying,
    /// There.
    Held,
    /// To be forgotten; not confirmed.
    Leaving,
}

/// One worker's bricks of one set, by their place in the set's list.
#[derive(Debug)]
struct Books {
    place: Vec<Place>,
    /// Leases that need it, until their result is there.
    pins: Vec<u32>,
    /// Whether it stands in the shelf's `wanted`.
    wanted: Vec<bool>,
    flying: VecDeque<u32>,
    held_count: u64,
    held_bytes: u64,
}

impl Books {
    fn new(bricks: usize) -> Self {
        Books {
            place: vec![Place::Absent; bricks],
            pins: vec![0; bricks],
            wanted: vec![false; bricks],
            flying: VecDeque::new(),
            held_count: 0,
            held_bytes: 0,
        }
    }
}

/// Bricks on their way to a worker without a pause.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Flight {
    pub(crate) since: Micros,
    pub(crate) bricks: u64,
    pub(crate) bytes: u64,
}

/// How a worker comes by bricks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    /// It gets all that a slab needs.
    Broadcast,
    /// It gets those of its leases.
    Lazy,
    /// It asks, and makes room itself.
    Asks,
}

/// One worker's memory.
#[derive(Debug)]
struct Shelf {
    budget: u64,
    /// Bytes of all that is flying, held or leaving.
    bytes: u64,
    /// Bytes of what is leaving.
    leaving_bytes: u64,
    /// Bytes of what is pinned.
    pinned_bytes: u64,
    sets: BTreeMap<BrickSetKey, Books>,
    /// Bricks it said it held, of sets not opened yet.
    told: BTreeMap<BrickSetKey, Vec<BrickId>>,
    /// Drops whose pong is outstanding, by the nonce that follows them.
    leaving: VecDeque<(u64, BrickSetKey, Vec<u32>)>,
    /// What is to be sent, in order; of the current set.
    wanted: VecDeque<u32>,
    /// What it asked for and can't be sent before its drop is confirmed, or has to go again.
    owed: Vec<(BrickSetKey, Vec<u32>)>,
    mode: Mode,
    flight: Option<Flight>,
}

/// What the residency asks the scheduler to tell a worker.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Errand {
    /// Forget these, then ping with the nonce.
    Drop { set: BrickSetKey, bricks: Vec<BrickId>, nonce: u64 },
    /// These are on their way.
    Send { set: BrickSetKey, bricks: Vec<BrickId>, bytes: u64, over_budget: bool },
}

/// A set's list of bricks, with when each was needed last.
#[derive(Debug)]
struct Set {
    bricks: Arc<[BrickInfo]>,
    /// Their names alone: one is looked for in a tenth of the memory.
    ids: Vec<BrickId>,
    /// Voxels and bytes of all.
    voxels: u64,
    all_bytes: u64,
    needed: Vec<u64>,
}

/// Who holds which brick.
#[derive(Debug, Default)]
pub(crate) struct Residency {
    sets: BTreeMap<BrickSetKey, Set>,
    shelves: WorkerMap<Shelf>,
    /// Number of slabs so far: the clock of "least recently needed".
    round: u64,
    /// The set that tasks are drawn from.
    current: BrickSetKey,
    /// Bytes that the round's needed bricks take.
    round_bytes: u64,
    /// Whether workers ask for the bricks of the current set.
    asks: bool,
}

impl Set {
    fn new(bricks: &Arc<[BrickInfo]>) -> Self {
        let ids: Vec<BrickId> = bricks.iter().map(|b| b.id).collect();
        assert!(ids.windows(2).all(|w| w[0] < w[1]), "a job's bricks ascend by id");
        let voxels = bricks.iter().map(|b| u64::from(b.voxels)).sum();
        let all_bytes = bricks.iter().map(|b| u64::from(b.bytes)).sum();
        Set { bricks: bricks.clone(), ids, voxels, all_bytes, needed: vec![0; bricks.len()] }
    }

    fn place_of(&self, id: BrickId) -> Option<u32> {
        self.ids.binary_search(&id).ok().map(|i| i as u32)
    }
}

/// Who has which bricks of a set, and which of them were drawn from lately.
pub(crate) struct Shelves<'a> {
    key: BrickSetKey,
    needed: &'a [u64],
    least: u64,
    shelves: &'a WorkerMap<Shelf>,
}

impl<'a> Shelves<'a> {
    /// A worker's; `None`: it has none of the set.
    pub(crate) fn of(&self, worker: WorkerId) -> Option<Shelved<'a>> {
        Some(Shelved(&self.shelves.get(worker)?.sets.get(&self.key)?.place))
    }

    /// Whether a brick was drawn from lately.
    pub(crate) fn is_late(&self, place: u32) -> bool {
        self.needed[place as usize] >= self.least
    }
}

/// What one worker has of it.
#[derive(Clone, Copy)]
pub(crate) struct Shelved<'a>(&'a [Place]);

impl Shelved<'_> {
    /// Whether it neither has a brick nor is sent it.
    pub(crate) fn lacks(self, place: u32) -> bool {
        self.0[place as usize] == Place::Absent
    }
}

impl Residency {
    pub(crate) fn join(
        &mut self,
        worker: WorkerId,
        budget: u64,
        held: Vec<(BrickSetKey, Vec<BrickId>)>,
    ) {
        let shelf = Shelf {
            budget,
            bytes: 0,
            leaving_bytes: 0,
            pinned_bytes: 0,
            sets: BTreeMap::new(),
            told: BTreeMap::new(),
            leaving: VecDeque::new(),
            wanted: VecDeque::new(),
            owed: Vec::new(),
            mode: Mode::Broadcast,
            flight: None,
        };
        let before = self.shelves.insert(worker, shelf);
        assert!(before.is_none(), "worker {worker} joins twice; a WorkerId is never used again");
        let shelf = self.shelves.get_mut(worker).expect("just put in");
        for (key, ids) in held {
            shelf.told.entry(key).or_default().extend(ids);
        }
        let known: Vec<_> =
            shelf.told.keys().filter(|k| self.sets.contains_key(k)).copied().collect();
        for key in known {
            self.believe(worker, key);
        }
        self.settle_mode(worker);
    }

    pub(crate) fn leave(&mut self, worker: WorkerId) {
        self.shelves.remove(worker);
    }

    /// Enters the bricks that a worker brought along into the books of an opened set. Ids the
    /// set does not have are a stranger's mistake and are ignored.
    fn believe(&mut self, worker: WorkerId, key: BrickSetKey) {
        let set = &self.sets[&key];
        let shelf = self.shelves.get_mut(worker).expect("a worker with a shelf");
        let ids = shelf.told.remove(&key).unwrap_or_default();
        let books = shelf.sets.entry(key).or_insert_with(|| Books::new(set.bricks.len()));
        for id in ids {
            let Some(i) = set.place_of(id) else { continue };
            if books.place[i as usize] == Place::Absent {
                books.place[i as usize] = Place::Held;
                books.held_count += 1;
                books.held_bytes += u64::from(set.bricks[i as usize].bytes);
                shelf.bytes += u64::from(set.bricks[i as usize].bytes);
            }
        }
    }

    /// Makes `key` the set that tasks are drawn from. `asks`: workers ask for its bricks; then a set
    /// that is open stays as it is, since frames that overlap share it.
    pub(crate) fn open(&mut self, key: BrickSetKey, bricks: &Arc<[BrickInfo]>, asks: bool) {
        if asks {
            self.round += 1;
            if self.asks && self.current == key && self.sets.contains_key(&key) {
                return;
            }
        }
        self.asks = asks;
        self.rest();
        for shelf in self.shelves.values_mut() {
            // Books without an entry.
            let leaving = &shelf.leaving;
            shelf.sets.retain(|k, b| {
                let empty = b.held_count == 0 && b.flying.is_empty();
                *k == key || !empty || leaving.iter().any(|(_, set, _)| set == k)
            });
        }
        let shelves = &self.shelves;
        self.sets.retain(|k, _| *k == key || shelves.values().any(|s| s.sets.contains_key(k)));
        self.current = key;
        self.round_bytes = 0;
        let set = self.sets.entry(key).or_insert_with(|| Set::new(bricks));
        assert_eq!(set.bricks.len(), bricks.len(), "a set key names one list of bricks");
        for worker in self.shelves.ids().collect::<Vec<_>>() {
            if self.shelves[worker].told.contains_key(&key) {
                self.believe(worker, key);
            }
            self.settle_mode(worker);
        }
    }

    /// Nothing is wanted any more: a frame ended.
    pub(crate) fn rest(&mut self) {
        for shelf in self.shelves.values_mut() {
            shelf.keep_wanted(self.current, |_| false);
        }
    }

    /// Begins a slab that needs these bricks of the current set.
    pub(crate) fn round(&mut self, needed: &[u32]) {
        self.round += 1;
        let set = self.sets.get_mut(&self.current).expect("the current set is open");
        self.round_bytes = 0;
        for &i in needed {
            set.needed[i as usize] = self.round;
            self.round_bytes += u64::from(set.bricks[i as usize].bytes);
        }
        for worker in self.shelves.ids().collect::<Vec<_>>() {
            self.settle_mode(worker);
        }
    }

    /// Decides for the slab whether a worker gets all its bricks, and forgets what it was still
    /// to be sent for the slab before, but for leases it has not given back.
    fn settle_mode(&mut self, worker: WorkerId) {
        let shelf = self.shelves.get_mut(worker).expect("a worker with a shelf");
        shelf.mode = if self.asks {
            Mode::Asks
        } else if self.round_bytes.saturating_add(shelf.pinned_bytes) > shelf.budget {
            Mode::Lazy
        } else {
            Mode::Broadcast
        };
        shelf.keep_wanted(self.current, |pins| pins > 0);
    }

    /// Whether a worker gets only the bricks of its leases.
    pub(crate) fn is_lazy(&self, worker: WorkerId) -> bool {
        self.shelves[worker].mode == Mode::Lazy
    }

    /// Whether a lease's bricks fit beside those of the worker's other leases. Always so for a
    /// worker that gets the whole slab.
    pub(crate) fn fits(&self, worker: WorkerId, lease: &[u32]) -> bool {
        let shelf = &self.shelves[worker];
        if shelf.mode != Mode::Lazy {
            return true;
        }
        let books = shelf.sets.get(&self.current);
        let bricks = &self.sets[&self.current].bricks;
        let more: u64 = lease
            .iter()
            .filter(|&&i| books.is_none_or(|b| b.pins[i as usize] == 0))
            .map(|&i| u64::from(bricks[i as usize].bytes))
            .sum();
        shelf.pinned_bytes + more <= shelf.budget
    }

    /// A lease on these bricks begins.
    pub(crate) fn pin(&mut self, worker: WorkerId, lease: &[u32]) {
        let set = &self.sets[&self.current];
        let shelf = self.shelves.get_mut(worker).expect("a worker with a shelf");
        let books = shelf.sets.entry(self.current).or_insert_with(|| Books::new(set.bricks.len()));
        for &i in lease {
            let pins = &mut books.pins[i as usize];
            *pins += 1;
            if *pins == 1 {
                shelf.pinned_bytes += u64::from(set.bricks[i as usize].bytes);
            }
        }
    }

    /// A lease on these bricks ended.
    pub(crate) fn unpin(&mut self, worker: WorkerId, lease: &[u32]) {
        let set = &self.sets[&self.current];
        let Some(shelf) = self.shelves.get_mut(worker) else { return };
        let books = shelf.sets.get_mut(&self.current).expect("what is pinned has books");
        for &i in lease {
            let pins = &mut books.pins[i as usize];
            *pins -= 1;
            if *pins == 0 {
                shelf.pinned_bytes -= u64::from(set.bricks[i as usize].bytes);
            }
        }
    }

    /// Puts what the worker lacks of these bricks of the current set behind what it is to be
    /// sent.
    pub(crate) fn want(&mut self, worker: WorkerId, bricks: impl IntoIterator<Item = u32>) {
        let set = &self.sets[&self.current];
        let shelf = self.shelves.get_mut(worker).expect("a worker with a shelf");
        let books = shelf.sets.entry(self.current).or_insert_with(|| Books::new(set.bricks.len()));
        for i in bricks {
            let at = i as usize;
            if matches!(books.place[at], Place::Absent | Place::Leaving) && !books.wanted[at] {
                books.wanted[at] = true;
                shelf.wanted.push_back(i);
            }
        }
    }

    /// Sends what can be sent now of what is wanted, and evicts to make room. `nonce` names the
    /// pings that follow drops.
    pub(crate) fn flush(
        &mut self,
        worker: WorkerId,
        now: Micros,
        nonce: &mut dyn FnMut() -> u64,
    ) -> Vec<Errand> {
        let mut errands = Vec::new();
        let key = self.current;
        let Some(shelf) = self.shelves.get_mut(worker) else { return errands };
        pay(&self.sets, shelf, now, &mut errands);
        if shelf.mode == Mode::Lazy {
            // Of a lease that ended without its bricks.
            shelf.keep_wanted(key, |pins| pins > 0);
        }
        if shelf.wanted.is_empty() {
            return errands;
        }
        let bricks = &self.sets[&key].bricks;
        let size = |i: u32| u64::from(bricks[i as usize].bytes);
        let wanted_bytes: u64 = shelf.wanted.iter().map(|&i| size(i)).sum();
        let after = shelf.bytes - shelf.leaving_bytes + wanted_bytes;
        if after > shelf.budget {
            evict(&self.sets, shelf, self.round, after - shelf.budget, nonce, &mut errands);
        }

        let alone = shelf.leaving.is_empty() && shelf.sets.values().all(|b| b.flying.is_empty());
        let books = shelf.sets.get_mut(&key).expect("what is wanted has books");
        let mut send = Vec::new();
        let (mut bytes, mut over_budget) = (0, false);
        let mut stay = VecDeque::new();
        while let Some(i) = shelf.wanted.pop_front() {
            let at = i as usize;
            if matches!(books.place[at], Place::Flying | Place::Held) {
                // The worker asked for it meanwhile.
                books.wanted[at] = false;
                continue;
            }
            let fits = shelf.bytes + size(i) <= shelf.budget;
            // Nothing more can be made room for: a lease larger than the budget.
            let force = !fits && alone && shelf.mode == Mode::Lazy && books.pins[at] > 0;
            if books.place[at] == Place::Leaving || !(fits || force) {
                stay.push_back(i);
                continue;
            }
            over_budget |= force;
            books.place[at] = Place::Flying;
            books.wanted[at] = false;
            books.flying.push_back(i);
            shelf.bytes += size(i);
            bytes += size(i);
            send.push(bricks[at].id);
        }
        shelf.wanted = stay;
        if !send.is_empty() {
            shelf.departs(now, send.len() as u64, bytes);
            errands.push(Errand::Send { set: key, bricks: send, bytes, over_budget });
        }
        errands
    }

    /// The next `count` bricks arrived. Returns the flight, if it was the last of it.
    pub(crate) fn arrived(
        &mut self,
        worker: WorkerId,
        key: BrickSetKey,
        count: u32,
    ) -> Option<Flight> {
        let set = self.sets.get(&key)?;
        let shelf = self.shelves.get_mut(worker)?;
        let books = shelf.sets.get_mut(&key)?;
        for _ in 0..count {
            let Some(i) = books.flying.pop_front() else { break };
            books.place[i as usize] = Place::Held;
            books.held_count += 1;
            books.held_bytes += u64::from(set.bricks[i as usize].bytes);
        }
        shelf.landed()
    }

    /// Whether a worker holds these, as far as is known here, or they are on their way to it or back.
    pub(crate) fn was_sent(&self, worker: WorkerId, key: BrickSetKey, ids: &[BrickId]) -> bool {
        let books = self.shelves.get(worker).and_then(|s| s.sets.get(&key));
        // Of a set that is gone nothing is lacked.
        let (Some(set), Some(books)) = (self.sets.get(&key), books) else { return true };
        let known = |i: u32| books.place[i as usize] != Place::Absent;
        ids.iter().all(|id| set.place_of(*id).is_some_and(known))
    }

    /// These arrived broken and are not counted among those that arrived. They go again.
    pub(crate) fn broken(
        &mut self,
        worker: WorkerId,
        key: BrickSetKey,
        ids: &[BrickId],
    ) -> Option<Flight> {
        let set = self.sets.get(&key)?;
        let shelf = self.shelves.get_mut(worker)?;
        let books = shelf.sets.get_mut(&key)?;
        let mut again = Vec::new();
        for &id in ids {
            let Some(i) = set.place_of(id) else { continue };
            let bytes = u64::from(set.bricks[i as usize].bytes);
            let place = books.place[i as usize];
            if place == Place::Flying {
                books.flying.retain(|&f| f != i);
            } else if let Some(next) = books.flying.pop_front() {
                // The count of the good ones came first, and was taken for this one.
                books.place[next as usize] = Place::Held;
                books.held_count += 1;
                books.held_bytes += u64::from(set.bricks[next as usize].bytes);
            }
            match place {
                Place::Flying => {}
                Place::Held => {
                    books.held_count -= 1;
                    books.held_bytes -= bytes;
                }
                // It goes anyway, or is gone.
                Place::Leaving | Place::Absent => continue,
            }
            books.place[i as usize] = Place::Absent;
            shelf.bytes -= bytes;
            again.push(i);
        }
        if shelf.mode == Mode::Asks {
            owe(&mut shelf.owed, key, again);
        } else if key == self.current {
            // Those that somebody waits for are in front of all others.
            let round = self.round;
            for &i in again.iter().rev() {
                let broadcast = shelf.mode == Mode::Broadcast;
                if books.pins[i as usize] > 0 || (broadcast && set.needed[i as usize] == round) {
                    books.wanted[i as usize] = true;
                    shelf.wanted.push_front(i);
                }
            }
        }
        shelf.landed()
    }

    /// A worker asks for these, or is to have them because it will: what it neither has nor will get
    /// is sent by the next flush. Sets that are not open and ids that a set does not have are left
    /// out.
    pub(crate) fn owe(
        &mut self,
        worker: WorkerId,
        key: BrickSetKey,
        bricks: impl IntoIterator<Item = u32>,
    ) {
        let (Some(set), Some(shelf)) = (self.sets.get(&key), self.shelves.get_mut(worker)) else {
            return;
        };
        shelf.sets.entry(key).or_insert_with(|| Books::new(set.bricks.len()));
        owe(&mut shelf.owed, key, bricks);
    }

    /// Places of these bricks in their set, as far as it has them.
    pub(crate) fn places(&self, key: BrickSetKey, ids: &[BrickId]) -> Vec<u32> {
        let Some(set) = self.sets.get(&key) else { return Vec::new() };
        ids.iter().filter_map(|&id| set.place_of(id)).collect()
    }

    /// Voxels of a set that is open.
    pub(crate) fn voxels(&self, key: BrickSetKey) -> u64 {
        self.sets.get(&key).map_or(0, |set| set.voxels)
    }

    /// How many workers hold a set that is open, each of whose bricks goes to some of them, by their budgets' mean.
    pub(crate) fn workers_for(&self, key: BrickSetKey) -> usize {
        /// A brick at the corner of four workers' tiles goes to all of them.
        const COPIES: u128 = 4;
        let budgets: u128 = self.shelves.values().map(|s| u128::from(s.budget)).sum();
        let bytes = self.sets.get(&key).map_or(0, |set| u128::from(set.all_bytes));
        let shelves = self.shelves.len();
        let workers = (COPIES * bytes * shelves as u128).div_ceil(budgets.max(1));
        usize::try_from(workers).unwrap_or(usize::MAX)
    }

    /// These were drawn from, somewhere. Those that were not lately are added to `fresh`.
    pub(crate) fn touched(&mut self, key: BrickSetKey, places: &[u32], fresh: &mut Vec<u32>) {
        let least = self.least(LATELY);
        let Some(set) = self.sets.get_mut(&key) else { return };
        for &i in places {
            let last = std::mem::replace(&mut set.needed[i as usize], self.round);
            if last < least {
                fresh.push(i);
            }
        }
    }

    /// The first of so many rounds before the present one.
    fn least(&self, rounds: u64) -> u64 {
        self.round.saturating_sub(rounds).max(1)
    }

    /// Who has which bricks of a set, and which were drawn from lately; `None`: the set is not open. `alone`: no frames
    /// overlap.
    pub(crate) fn shelves(&self, key: BrickSetKey, alone: bool) -> Option<Shelves<'_>> {
        let needed = &self.sets.get(&key)?.needed;
        let least = self.least(if alone { 1 } else { LATELY });
        Some(Shelves { key, needed, least, shelves: &self.shelves })
    }

    /// Workers are owed these because they will ask for them. Who has no room for all of its list beside what it has is
    /// owed none: it would have to forget what it needs. Returns who is owed some.
    pub(crate) fn owe_all(
        &mut self,
        key: BrickSetKey,
        lists: Vec<(WorkerId, Vec<u32>)>,
    ) -> Vec<WorkerId> {
        let Some(set) = self.sets.get(&key) else { return Vec::new() };
        let mut owed = Vec::new();
        for (worker, places) in lists {
            let Some(shelf) = self.shelves.get_mut(worker) else { continue };
            let bytes: u64 = places.iter().map(|&i| u64::from(set.bricks[i as usize].bytes)).sum();
            if shelf.bytes.saturating_add(bytes) > shelf.budget {
                continue;
            }
            shelf.sets.entry(key).or_insert_with(|| Books::new(set.bricks.len()));
            owe(&mut shelf.owed, key, places);
            owed.push(worker);
        }
        owed
    }

    /// A worker forgot these. What a lease of its needs goes again.
    pub(crate) fn forgotten(&mut self, worker: WorkerId, key: BrickSetKey, ids: &[BrickId]) {
        let (Some(set), Some(shelf)) = (self.sets.get(&key), self.shelves.get_mut(worker)) else {
            return;
        };
        let Some(books) = shelf.sets.get_mut(&key) else { return };
        for &id in ids {
            let Some(i) = set.place_of(id) else { continue };
            if books.place[i as usize] != Place::Held {
                continue;
            }
            let bytes = u64::from(set.bricks[i as usize].bytes);
            books.place[i as usize] = Place::Absent;
            books.held_count -= 1;
            books.held_bytes -= bytes;
            shelf.bytes -= bytes;
            if books.pins[i as usize] > 0 && key == self.current {
                books.wanted[i as usize] = true;
                shelf.wanted.push_back(i);
            }
        }
    }

    /// All control messages up to the ping `nonce` were read: what left before it is gone.
    pub(crate) fn ponged(&mut self, worker: WorkerId, nonce: u64) {
        let Some(shelf) = self.shelves.get_mut(worker) else { return };
        while shelf.leaving.front().is_some_and(|(n, ..)| *n <= nonce) {
            let (_, key, gone) = shelf.leaving.pop_front().expect("there is a front");
            let books = shelf.sets.get_mut(&key).expect("what leaves has books");
            for i in gone {
                let bytes = u64::from(self.sets[&key].bricks[i as usize].bytes);
                books.place[i as usize] = Place::Absent;
                shelf.bytes -= bytes;
                shelf.leaving_bytes -= bytes;
            }
        }
    }

    /// Bricks and bytes that a worker has of a set.
    pub(crate) fn held_of(&self, worker: WorkerId, key: BrickSetKey) -> (u64, u64) {
        let books = self.shelves.get(worker).and_then(|s| s.sets.get(&key));
        books.map_or((0, 0), |b| (b.held_count, b.held_bytes))
    }

    /// Bricks and bytes that a worker has of all sets.
    pub(crate) fn held(&self, worker: WorkerId) -> (u64, u64) {
        let books = self.shelves.get(worker).into_iter().flat_map(|s| s.sets.values());
        books.fold((0, 0), |(n, b), books| (n + books.held_count, b + books.held_bytes))
    }

    /// The flight to a worker that has not landed.
    pub(crate) fn flight(&self, worker: WorkerId) -> Option<Flight> {
        self.shelves.get(worker).and_then(|s| s.flight)
    }

    /// The flight ends for the statistics of one frame and goes on for the next.
    pub(crate) fn cut_flights(&mut self, now: Micros) -> Vec<(WorkerId, Flight)> {
        let mut cut = Vec::new();
        for (worker, shelf) in self.shelves.iter_mut() {
            if let Some(flight) = &mut shelf.flight {
                cut.push((worker, *flight));
                *flight = Flight { since: now, bricks: 0, bytes: 0 };
            }
        }
        cut
    }
}

impl Shelf {
    /// Keeps of what is wanted (of the set `key`) what has so many pins.
    fn keep_wanted(&mut self, key: BrickSetKey, keep: impl Fn(u32) -> bool) {
        let Some(books) = self.sets.get_mut(&key) else { return };
        self.wanted.retain(|&i| {
            let keep = keep(books.pins[i as usize]);
            books.wanted[i as usize] = keep;
            keep
        });
    }

    /// Bricks leave for the worker.
    fn departs(&mut self, now: Micros, bricks: u64, bytes: u64) {
        let flight = self.flight.get_or_insert(Flight { since: now, bricks: 0, bytes: 0 });
        flight.bricks += bricks;
        flight.bytes += bytes;
    }

    /// The flight, when nothing is on its way any more.
    fn landed(&mut self) -> Option<Flight> {
        if self.sets.values().all(|b| b.flying.is_empty()) { self.flight.take() } else { None }
    }
}

/// Sends what a worker asked for, as far as it neither has it nor will get it. What it is to forget
/// waits until it has.
fn pay(
    sets: &BTreeMap<BrickSetKey, Set>,
    shelf: &mut Shelf,
    now: Micros,
    errands: &mut Vec<Errand>,
) {
    for (key, mut places) in std::mem::take(&mut shelf.owed) {
        // A set may be closed before its last bricks are asked for.
        let (Some(set), Some(books)) = (sets.get(&key), shelf.sets.get_mut(&key)) else { continue };
        let (mut sent, mut bytes) = (Vec::with_capacity(places.len()), 0);
        places.retain(|&i| {
            let place = &mut books.place[i as usize];
            if *place == Place::Absent {
                let info = &set.bricks[i as usize];
                *place = Place::Flying;
                books.flying.push_back(i);
                sent.push(info.id);
                bytes += u64::from(info.bytes);
            }
            *place == Place::Leaving
        });
        if !places.is_empty() {
            owe(&mut shelf.owed, key, places);
        }
        if sent.is_empty() {
            continue;
        }
        shelf.bytes += bytes;
        shelf.departs(now, sent.len() as u64, bytes);
        errands.push(Errand::Send { set: key, bricks: sent, bytes, over_budget: false });
    }
}

/// Notes that a worker is to be sent these, behind all that it is to be sent already.
fn owe(
    owed: &mut Vec<(BrickSetKey, Vec<u32>)>,
    key: BrickSetKey,
    places: impl IntoIterator<Item = u32>,
) {
    match owed.last_mut().filter(|last| last.0 == key) {
        Some(last) => last.1.extend(places),
        None => owed.push((key, places.into_iter().collect())),
    }
}

/// Drops at least `bytes` of what no lease needs, least recently needed first; bricks of this
/// slab only from workers that get theirs lazily.
fn evict(
    sets: &BTreeMap<BrickSetKey, Set>,
    shelf: &mut Shelf,
    round: u64,
    bytes: u64,
    nonce: &mut dyn FnMut() -> u64,
    errands: &mut Vec<Errand>,
) {
    let mut victims = Vec::new();
    for (key, books) in &shelf.sets {
        let needed = &sets[key].needed;
        for (i, place) in books.place.iter().enumerate() {
            let spare = shelf.mode == Mode::Lazy || needed[i] < round;
            if *place == Place::Held && books.pins[i] == 0 && spare {
                victims.push((needed[i], *key, i as u32));
            }
        }
    }
    victims.sort_unstable();
    let mut by_set: BTreeMap<BrickSetKey, Vec<u32>> = BTreeMap::new();
    let mut freed = 0;
    for (_, key, i) in victims {
        if freed >= bytes {
            break;
        }
        freed += u64::from(sets[&key].bricks[i as usize].bytes);
        by_set.entry(key).or_default().push(i);
    }
    for (key, mut gone) in by_set {
        gone.sort_unstable();
        let books = shelf.sets.get_mut(&key).expect("victims have books");
        let bricks = &sets[&key].bricks;
        for &i in &gone {
            let size = u64::from(bricks[i as usize].bytes);
            books.place[i as usize] = Place::Leaving;
            books.held_count -= 1;
            books.held_bytes -= size;
            shelf.leaving_bytes += size;
        }
        let nonce = nonce();
        let names = gone.iter().map(|&i| bricks[i as usize].id).collect();
        shelf.leaving.push_back((nonce, key, gone));
        errands.push(Errand::Drop { set: key, bricks: names, nonce });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::brick::TightBox;

    const W: WorkerId = WorkerId(1);
    const KEY: BrickSetKey = BrickSetKey(slabcast_common::volume::Digest32([3; 32]));

    /// Ten bricks of 100 bytes and one worker.
    fn residency(budget: u64) -> Residency {
        let tight = TightBox { lo: [0; 3], hi: [7; 3] };
        let bricks: Arc<[BrickInfo]> = (0..10)
            .map(|i| BrickInfo { id: BrickId(2 * i), tight, voxels: 9, bytes: 100 })
            .collect();
        let mut r = Residency::default();
        r.join(W, budget, vec![(KEY, vec![BrickId(0), BrickId(0), BrickId(3)])]);
        r.open(KEY, &bricks, false);
        r
    }

    fn flush(r: &mut Residency) -> Vec<Errand> {
        r.flush(W, 5, &mut || 77)
    }

    fn send(ids: &[u32]) -> Errand {
        let bricks = ids.iter().map(|&i| BrickId(i)).collect();
        let bytes = 100 * ids.len() as u64;
        Errand::Send { set: KEY, bricks, bytes, over_budget: false }
    }

    #[test]
    fn what_a_worker_brought_along_is_held_once_and_strange_ids_are_ignored() {
        let mut r = residency(1000);
        assert_eq!(r.held(W), (1, 100));
        r.round(&[0, 1]);
        r.want(W, [0, 1, 1]);
        assert_eq!(flush(&mut r), [send(&[2])]);
        assert!(flush(&mut r).is_empty());
    }

    #[test]
    fn what_is_drawn_from_for_the_first_time_for_long_is_fresh() {
        let mut r = residency(1000);
        let bricks = r.sets[&KEY].bricks.clone();
        let fresh = |r: &mut Residency, places: &[u32]| {
            let mut fresh = Vec::new();
            r.open(KEY, &bricks, true);
            r.touched(KEY, places, &mut fresh);
            fresh
        };
        assert_eq!(fresh(&mut r, &[1, 2, 1]), [1, 2]);
        assert_eq!(fresh(&mut r, &[2, 3]), [3]);
        assert_eq!(fresh(&mut r, &[4]), [4]);
        assert_eq!(
            fresh(&mut r, &[3, 1, 2]),
            [1],
            "of the first round, of which others are too far"
        );
    }

    #[test]
    fn what_a_worker_will_ask_for_is_sent_where_there_is_room_for_it() {
        let mut r = residency(300);
        let bricks = r.sets[&KEY].bricks.clone();
        r.open(KEY, &bricks, true);
        let other = WorkerId(2);
        r.join(other, 1000, Vec::new());
        let list = |places: &[u32]| vec![(W, places.to_vec()), (other, places.to_vec())];
        assert_eq!(r.owe_all(KEY, list(&[1, 2, 3])), [other], "one is held, and three do not fit");
        assert!(flush(&mut r).is_empty());
        assert_eq!(r.flush(other, 5, &mut || 78), [send(&[2, 4, 6])]);
        assert_eq!(r.owe_all(KEY, list(&[2, 4])), [W, other]);
        assert_eq!(flush(&mut r), [send(&[4, 8])]);
        assert_eq!(r.flush(other, 5, &mut || 79), [send(&[8])], "the first is on its way");
    }

    #[test]
    fn broken_bricks_go_again_whether_they_are_named_before_the_count_or_after() {
        for named_first in [true, false] {
            let mut r = residency(1000);
            r.round(&[1, 2, 3]);
            r.want(W, [1, 2, 3]);
            flush(&mut r);
            if named_first {
                assert_eq!(r.broken(W, KEY, &[BrickId(4)]), None);
                assert!(r.arrived(W, KEY, 2).is_some());
            } else {
                assert_eq!(r.arrived(W, KEY, 2), None);
                assert!(r.broken(W, KEY, &[BrickId(4)]).is_some());
            }
            assert_eq!(r.held(W), (3, 300));
            assert_eq!(flush(&mut r), [send(&[4])]);
            assert!(r.arrived(W, KEY, 1).is_some());
            assert_eq!(r.held(W), (4, 400));
        }
    }

    #[test]
    fn a_dropped_brick_is_sent_again_only_after_the_pong() {
        let mut r = residency(300);
        r.round(&[1, 2]);
        r.want(W, [1, 2]);
        assert_eq!(flush(&mut r), [send(&[2, 4])]);
        r.arrived(W, KEY, 2);
        // Least recently needed: brick 0, which was never, then those of the round before.
        r.round(&[2, 3, 4]);
        r.want(W, [3, 4]);
        let drop = |ids: &[u32]| Errand::Drop {
            set: KEY,
            bricks: ids.iter().map(|&i| BrickId(i)).collect(),
            nonce: 77,
        };
        assert_eq!(flush(&mut r), [drop(&[0, 2])], "and no room until they are gone");
        assert!(flush(&mut r).is_empty());
        r.ponged(W, 76);
        assert!(flush(&mut r).is_empty());
        r.ponged(W, 77);
        assert_eq!(flush(&mut r), [send(&[6, 8])]);
    }

    #[test]
    fn so_many_workers_are_needed_as_hold_each_brick_four_times() {
        let mut r = residency(1000);
        let bytes: u64 = r.sets[&KEY].bricks.iter().map(|b| u64::from(b.bytes)).sum();
        let needed = |budget: u64| (4 * bytes).div_ceil(budget) as usize;
        assert_eq!(r.workers_for(KEY), needed(1000));
        r.join(WorkerId(99), 3000, Vec::new());
        assert_eq!(r.workers_for(KEY), needed(2000), "by the mean");
        r.join(WorkerId(98), u64::MAX, Vec::new());
        assert_eq!(r.workers_for(KEY), 1);
        assert!(residency(0).workers_for(KEY) > 1_000);
    }

    #[test]
    fn a_lease_larger_than_the_budget_goes_alone_and_is_counted() {
        let mut r = residency(250);
        r.round(&[1, 2, 3, 4]);
        assert!(r.is_lazy(W));
        assert!(r.fits(W, &[1, 2]) && !r.fits(W, &[1, 2, 3]));
        r.pin(W, &[1, 2, 3]);
        r.want(W, [1, 2, 3]);
        assert!(matches!(&flush(&mut r)[..], [Errand::Drop { .. }, Errand::Send { .. }]));
        r.ponged(W, 77);
        assert_eq!(flush(&mut r), [send(&[4])], "two fit into 250 bytes");
        assert!(flush(&mut r).is_empty(), "what flies may make room yet");
        r.arrived(W, KEY, 2);
        let last = flush(&mut r);
        assert!(matches!(&last[..], [Errand::Send { over_budget: true, .. }]), "{last:?}");
    }
}
