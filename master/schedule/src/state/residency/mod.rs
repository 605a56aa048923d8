//! Residency of bricks: which worker holds which (paper section 4.4), and which it is sent next.
//!
//! The paper broadcasts a slab's unoccluded bricks and lets every node cache all it ever got. So
//! does this room, while memory lasts. It adds what happens when memory does not last:
//!
//! - **In order.** Bricks of a set reach a worker in the order in which they were sent, so an
//!   acknowledgement is a count. Damaged ones are named and sent again.
//! - **A drop takes a round trip.** `DropBricks` travels on the control link and bricks on their
//!   own. A brick that is dropped and sent again at once could arrive before the drop and be lost
//!   with it, and a lease would wait for it for ever. So a ping follows each drop, and until its
//!   pong the bricks count as resident and are not sent again.
//! - **Broadcast or lazily.** If all that a slab needs fits into a worker's budget, the worker gets
//!   all of it, and only bricks that the slab doesn't need are evicted, least recently needed
//!   first. If not, it gets the bricks of the tiles it leases, and a lease only when its bricks fit
//!   beside those of its other leases. A lease that exceeds the budget by itself is sent anyway,
//!   and is counted: the picture comes first.
//! - **On request.** Under the `region` schedule workers ask for the bricks they need and evict by
//!   themselves: only they know which bricks their regions stand on. This room then sends what was
//!   requested and not sent, notes what workers say they evicted, and evicts nothing. Bricks that a
//!   worker is expected to request (`policy::prefetch`) are sent as well, if they fit beside what
//!   it holds.
//!
//! The measure of memory is a brick's encoded size. A worker's own representation is larger or
//! smaller by a factor that it knows when it states its budget.

use slabcast_common::brick::{BrickInfo, BrickSetKey};
use slabcast_common::ids::{BrickId, WorkerId};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

mod books;
#[cfg(test)]
mod tests;

use crate::Micros;
use crate::state::worker_map::WorkerMap;
pub(crate) use books::Transfer;
use books::{BrickState, Mode, Set, SetBooks, WorkerBricks, evict, request, send_requested};

/// Limit: copies of a brick: one at the corner of four workers' tiles is sent to all of them.
const COPIES: u128 = 4;

/// Tuning (rounds, one a frame): a brick used in this many rounds before the present one counts as
/// used lately while frames overlap, since results of several frames mix. Without overlap one round
/// is enough.
const USED_LATELY_ROUNDS: u64 = 2;

/// A message that the residency asks the scheduler to send to a worker.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum ResidencyAction {
    /// Drop these bricks, then ping with the nonce.
    Drop { set: BrickSetKey, bricks: Vec<BrickId>, nonce: u64 },
    /// Send these bricks.
    Send { set: BrickSetKey, bricks: Vec<BrickId>, bytes: u64, over_budget: bool },
}

/// Table of the bricks that each worker holds, for all open sets.
#[derive(Debug, Default)]
pub(crate) struct Residency {
    sets: BTreeMap<BrickSetKey, Set>,
    workers: WorkerMap<WorkerBricks>,
    /// Number of slabs or frames begun: the clock of "least recently needed".
    round: u64,
    /// The set of the frames in flight.
    current: BrickSetKey,
    /// Bytes of the bricks that the current slab needs.
    round_bytes: u64,
    /// Whether workers ask for bricks of the current set (`region` schedule).
    on_request: bool,
}

/// View of one set in [`Residency`]: the bricks that each worker holds, and those used lately.
pub(crate) struct BrickPresence<'a> {
    key: BrickSetKey,
    needed: &'a [u64],
    least: u64,
    workers: &'a WorkerMap<WorkerBricks>,
}

impl<'a> BrickPresence<'a> {
    /// Returns what a worker has; `None` if it has no brick of the set.
    pub(crate) fn of_worker(&self, worker: WorkerId) -> Option<WorkerPresence<'a>> {
        Some(WorkerPresence(&self.workers.get(worker)?.sets.get(&self.key)?.state))
    }

    /// Whether a result of the last rounds was rendered from the brick.
    pub(crate) fn was_used_lately(&self, state: u32) -> bool {
        self.needed[state as usize] >= self.least
    }
}

/// The bricks of one set at one worker.
#[derive(Clone, Copy)]
pub(crate) struct WorkerPresence<'a>(&'a [BrickState]);

impl WorkerPresence<'_> {
    /// Whether the worker neither holds the brick nor is being sent it.
    pub(crate) fn lacks(self, state: u32) -> bool {
        self.0[state as usize] == BrickState::Absent
    }
}

impl Residency {
    pub(crate) fn join(
        &mut self,
        worker: WorkerId,
        budget: u64,
        held: Vec<(BrickSetKey, Vec<BrickId>)>,
    ) {
        let holder = WorkerBricks {
            budget,
            bytes: 0,
            dropping_bytes: 0,
            pinned_bytes: 0,
            sets: BTreeMap::new(),
            announced: BTreeMap::new(),
            dropping: VecDeque::new(),
            wanted: VecDeque::new(),
            requested: Vec::new(),
            mode: Mode::Broadcast,
            transfer: None,
        };
        let before = self.workers.insert(worker, holder);
        assert!(before.is_none(), "worker {worker} joins twice; a WorkerId is never used again");
        let holder = self.workers.get_mut(worker).expect("just put in");
        for (key, ids) in held {
            holder.announced.entry(key).or_default().extend(ids);
        }
        let known: Vec<_> =
            holder.announced.keys().filter(|k| self.sets.contains_key(k)).copied().collect();
        for key in known {
            self.enter_held(worker, key);
        }
        self.settle_mode(worker);
    }

    pub(crate) fn leave(&mut self, worker: WorkerId) {
        self.workers.remove(worker);
    }

    /// Enters the bricks that a worker announced in its hello into the books of an opened set. Ids
    /// that the set does not have are a peer's mistake and are ignored.
    fn enter_held(&mut self, worker: WorkerId, key: BrickSetKey) {
        let set = &self.sets[&key];
        let holder = self.workers.get_mut(worker).expect("a worker with a holder");
        let ids = holder.announced.remove(&key).unwrap_or_default();
        let books = holder.sets.entry(key).or_insert_with(|| SetBooks::new(set.bricks.len()));
        for id in ids {
            let Some(i) = set.index_of(id) else { continue };
            if books.state[i as usize] == BrickState::Absent {
                books.state[i as usize] = BrickState::Held;
                books.held_count += 1;
                books.held_bytes += u64::from(set.bricks[i as usize].bytes);
                holder.bytes += u64::from(set.bricks[i as usize].bytes);
            }
        }
    }

    /// Makes `key` the current set. With `on_request`, workers ask for its bricks, and a set that
    /// is already open stays as it is, since overlapping frames share it. Sets of frames `in_flight`
    /// stay open, although no worker may hold a brick of them yet.
    pub(crate) fn open(
        &mut self,
        key: BrickSetKey,
        bricks: &Arc<[BrickInfo]>,
        on_request: bool,
        in_flight: &BTreeSet<BrickSetKey>,
    ) {
        if on_request {
            self.round += 1;
            if self.on_request && self.current == key && self.sets.contains_key(&key) {
                return;
            }
        }
        self.on_request = on_request;
        self.clear_wanted();
        for holder in self.workers.values_mut() {
            // Sets with no brick held, in flight or being dropped.
            let dropping = &holder.dropping;
            holder.sets.retain(|k, b| {
                let empty = b.held_count == 0 && b.in_flight.is_empty();
                *k == key
                    || in_flight.contains(k)
                    || !empty
                    || dropping.iter().any(|(_, set, _)| set == k)
            });
        }
        let workers = &self.workers;
        self.sets.retain(|k, _| {
            *k == key || in_flight.contains(k) || workers.values().any(|s| s.sets.contains_key(k))
        });
        self.current = key;
        self.round_bytes = 0;
        let set = self.sets.entry(key).or_insert_with(|| Set::new(bricks));
        assert_eq!(set.bricks.len(), bricks.len(), "a set key names one list of bricks");
        for worker in self.workers.ids().collect::<Vec<_>>() {
            if self.workers[worker].announced.contains_key(&key) {
                self.enter_held(worker, key);
            }
            self.settle_mode(worker);
        }
    }

    /// Clears all queues of wanted bricks: a frame ended.
    pub(crate) fn clear_wanted(&mut self) {
        for holder in self.workers.values_mut() {
            holder.keep_wanted(self.current, |_| false);
        }
    }

    /// Begins a slab that needs these bricks of the current set.
    pub(crate) fn begin_slab(&mut self, needed: &[u32]) {
        self.round += 1;
        let set = self.sets.get_mut(&self.current).expect("the current set is open");
        self.round_bytes = 0;
        for &i in needed {
            set.needed[i as usize] = self.round;
            self.round_bytes += u64::from(set.bricks[i as usize].bytes);
        }
        for worker in self.workers.ids().collect::<Vec<_>>() {
            self.settle_mode(worker);
        }
    }

    /// Decides for the slab how a worker gets bricks, and clears what it was still to be sent for
    /// the slab before, except for leases that it has not answered.
    fn settle_mode(&mut self, worker: WorkerId) {
        let holder = self.workers.get_mut(worker).expect("a worker with a holder");
        holder.mode = if self.on_request {
            Mode::OnRequest
        } else if self.round_bytes.saturating_add(holder.pinned_bytes) > holder.budget {
            Mode::Lazy
        } else {
            Mode::Broadcast
        };
        holder.keep_wanted(self.current, |pins| pins > 0);
    }

    /// Whether a worker gets only the bricks of its leases.
    pub(crate) fn is_lazy(&self, worker: WorkerId) -> bool {
        self.workers[worker].mode == Mode::Lazy
    }

    /// Whether a lease's bricks fit beside those of the worker's other leases. Always true for a
    /// worker that gets the whole slab.
    pub(crate) fn fits(&self, worker: WorkerId, lease: &[u32]) -> bool {
        let holder = &self.workers[worker];
        if holder.mode != Mode::Lazy {
            return true;
        }
        let books = holder.sets.get(&self.current);
        let bricks = &self.sets[&self.current].bricks;
        let more: u64 = lease
            .iter()
            .filter(|&&i| books.is_none_or(|b| b.pins[i as usize] == 0))
            .map(|&i| u64::from(bricks[i as usize].bytes))
            .sum();
        holder.pinned_bytes + more <= holder.budget
    }

    /// Pins the bricks of a lease that begins.
    pub(crate) fn pin(&mut self, worker: WorkerId, lease: &[u32]) {
        let set = &self.sets[&self.current];
        let holder = self.workers.get_mut(worker).expect("a worker with a holder");
        let books =
            holder.sets.entry(self.current).or_insert_with(|| SetBooks::new(set.bricks.len()));
        for &i in lease {
            let pins = &mut books.pins[i as usize];
            *pins += 1;
            if *pins == 1 {
                holder.pinned_bytes += u64::from(set.bricks[i as usize].bytes);
            }
        }
    }

    /// Unpins the bricks of a lease that ended.
    pub(crate) fn unpin(&mut self, worker: WorkerId, lease: &[u32]) {
        let set = &self.sets[&self.current];
        let Some(holder) = self.workers.get_mut(worker) else { return };
        let books = holder.sets.get_mut(&self.current).expect("what is pinned has books");
        for &i in lease {
            let pins = &mut books.pins[i as usize];
            *pins -= 1;
            if *pins == 0 {
                holder.pinned_bytes -= u64::from(set.bricks[i as usize].bytes);
            }
        }
    }

    /// Queues the bricks of the current set that the worker lacks.
    pub(crate) fn want(&mut self, worker: WorkerId, bricks: impl IntoIterator<Item = u32>) {
        let set = &self.sets[&self.current];
        let holder = self.workers.get_mut(worker).expect("a worker with a holder");
        let books =
            holder.sets.entry(self.current).or_insert_with(|| SetBooks::new(set.bricks.len()));
        for i in bricks {
            let at = i as usize;
            if matches!(books.state[at], BrickState::Absent | BrickState::Dropping)
                && !books.wanted[at]
            {
                books.wanted[at] = true;
                holder.wanted.push_back(i);
            }
        }
    }

    /// Sends requested and wanted bricks as far as they fit, and evicts to make room. `nonce` makes
    /// the nonces of the pings that follow drops.
    pub(crate) fn flush(
        &mut self,
        worker: WorkerId,
        now: Micros,
        nonce: &mut dyn FnMut() -> u64,
    ) -> Vec<ResidencyAction> {
        let mut actions = Vec::new();
        let key = self.current;
        let Some(holder) = self.workers.get_mut(worker) else { return actions };
        send_requested(&self.sets, holder, now, &mut actions);
        if holder.mode == Mode::Lazy {
            // Leases may have ended before their bricks were sent.
            holder.keep_wanted(key, |pins| pins > 0);
        }
        if holder.wanted.is_empty() {
            return actions;
        }
        let bricks = &self.sets[&key].bricks;
        let size = |i: u32| u64::from(bricks[i as usize].bytes);
        let wanted_bytes: u64 = holder.wanted.iter().map(|&i| size(i)).sum();
        let after = holder.bytes - holder.dropping_bytes + wanted_bytes;
        if after > holder.budget {
            evict(&self.sets, holder, self.round, after - holder.budget, nonce, &mut actions);
        }

        let is_idle =
            holder.dropping.is_empty() && holder.sets.values().all(|b| b.in_flight.is_empty());
        let books = holder.sets.get_mut(&key).expect("what is wanted has books");
        let mut send = Vec::new();
        let (mut bytes, mut over_budget) = (0, false);
        let mut stay = VecDeque::new();
        while let Some(i) = holder.wanted.pop_front() {
            let at = i as usize;
            if matches!(books.state[at], BrickState::InFlight | BrickState::Held) {
                // The worker requested it meanwhile.
                books.wanted[at] = false;
                continue;
            }
            let fits = holder.bytes + size(i) <= holder.budget;
            // No more room can be made: the lease exceeds the budget by itself.
            let force = !fits && is_idle && holder.mode == Mode::Lazy && books.pins[at] > 0;
            if books.state[at] == BrickState::Dropping || !(fits || force) {
                stay.push_back(i);
                continue;
            }
            over_budget |= force;
            books.state[at] = BrickState::InFlight;
            books.wanted[at] = false;
            books.in_flight.push_back(i);
            holder.bytes += size(i);
            bytes += size(i);
            send.push(bricks[at].id);
        }
        holder.wanted = stay;
        if !send.is_empty() {
            holder.departs(now, send.len() as u64, bytes);
            actions.push(ResidencyAction::Send { set: key, bricks: send, bytes, over_budget });
        }
        actions
    }

    /// Marks the next `count` bricks in flight as held. Returns the transfer if these were its
    /// last.
    pub(crate) fn arrived(
        &mut self,
        worker: WorkerId,
        key: BrickSetKey,
        count: u32,
    ) -> Option<Transfer> {
        let set = self.sets.get(&key)?;
        let holder = self.workers.get_mut(worker)?;
        let books = holder.sets.get_mut(&key)?;
        for _ in 0..count {
            let Some(i) = books.in_flight.pop_front() else { break };
            books.state[i as usize] = BrickState::Held;
            books.held_count += 1;
            books.held_bytes += u64::from(set.bricks[i as usize].bytes);
        }
        holder.landed()
    }

    /// Whether each of these bricks is held by the worker, in flight to it or being dropped.
    pub(crate) fn was_sent(&self, worker: WorkerId, key: BrickSetKey, ids: &[BrickId]) -> bool {
        let books = self.workers.get(worker).and_then(|s| s.sets.get(&key));
        // A closed set can't lack bricks.
        let (Some(set), Some(books)) = (self.sets.get(&key), books) else { return true };
        let known = |i: u32| books.state[i as usize] != BrickState::Absent;
        ids.iter().all(|id| set.index_of(*id).is_some_and(known))
    }

    /// Sends bricks again that arrived damaged; they are not among those counted as arrived.
    pub(crate) fn broken(
        &mut self,
        worker: WorkerId,
        key: BrickSetKey,
        ids: &[BrickId],
    ) -> Option<Transfer> {
        let set = self.sets.get(&key)?;
        let holder = self.workers.get_mut(worker)?;
        let books = holder.sets.get_mut(&key)?;
        let mut again = Vec::new();
        for &id in ids {
            let Some(i) = set.index_of(id) else { continue };
            let bytes = u64::from(set.bricks[i as usize].bytes);
            let state = books.state[i as usize];
            if state == BrickState::InFlight {
                books.in_flight.retain(|&f| f != i);
            } else if let Some(next) = books.in_flight.pop_front() {
                // The count of intact bricks came first and was taken for this one.
                books.state[next as usize] = BrickState::Held;
                books.held_count += 1;
                books.held_bytes += u64::from(set.bricks[next as usize].bytes);
            }
            match state {
                BrickState::InFlight => {}
                BrickState::Held => {
                    books.held_count -= 1;
                    books.held_bytes -= bytes;
                }
                // It is on its way out, or gone.
                BrickState::Dropping | BrickState::Absent => continue,
            }
            books.state[i as usize] = BrickState::Absent;
            holder.bytes -= bytes;
            again.push(i);
        }
        if holder.mode == Mode::OnRequest {
            request(&mut holder.requested, key, again);
        } else if key == self.current {
            // Bricks that a lease waits for go first.
            let round = self.round;
            for &i in again.iter().rev() {
                let broadcast = holder.mode == Mode::Broadcast;
                if books.pins[i as usize] > 0 || (broadcast && set.needed[i as usize] == round) {
                    books.wanted[i as usize] = true;
                    holder.wanted.push_front(i);
                }
            }
        }
        holder.landed()
    }

    /// Queues bricks that a worker requests or is expected to request. The next flush sends those
    /// it neither holds nor is being sent. Sets that are not open and ids that a set lacks are
    /// ignored.
    pub(crate) fn request(
        &mut self,
        worker: WorkerId,
        key: BrickSetKey,
        bricks: impl IntoIterator<Item = u32>,
    ) {
        let (Some(set), Some(holder)) = (self.sets.get(&key), self.workers.get_mut(worker)) else {
            return;
        };
        holder.sets.entry(key).or_insert_with(|| SetBooks::new(set.bricks.len()));
        request(&mut holder.requested, key, bricks);
    }

    /// Returns the indices of these bricks in their set's list; ids it lacks are skipped.
    pub(crate) fn indices(&self, key: BrickSetKey, ids: &[BrickId]) -> Vec<u32> {
        let Some(set) = self.sets.get(&key) else { return Vec::new() };
        ids.iter().filter_map(|&id| set.index_of(id)).collect()
    }

    /// Returns the number of voxels of an open set.
    pub(crate) fn voxels(&self, key: BrickSetKey) -> u64 {
        self.sets.get(&key).map_or(0, |set| set.voxels)
    }

    /// Returns the mean number of encoded bytes of the bricks of an open set.
    pub(crate) fn brick_bytes(&self, key: BrickSetKey) -> f64 {
        self.sets.get(&key).map_or(0.0, |set| set.all_bytes as f64 / set.bricks.len().max(1) as f64)
    }

    /// Returns how many workers of mean budget are needed to hold an open set, each brick
    /// [`COPIES`]-fold.
    pub(crate) fn workers_to_hold(&self, key: BrickSetKey) -> usize {
        let budgets: u128 = self.workers.values().map(|s| u128::from(s.budget)).sum();
        let bytes = self.sets.get(&key).map_or(0, |set| u128::from(set.all_bytes));
        let workers = self.workers.len();
        let workers = (COPIES * bytes * workers as u128).div_ceil(budgets.max(1));
        usize::try_from(workers).unwrap_or(usize::MAX)
    }

    /// Notes that a result was rendered from these bricks. Those not used lately are appended to
    /// `newly_used`.
    pub(crate) fn mark_used(
        &mut self,
        key: BrickSetKey,
        indices: &[u32],
        newly_used: &mut Vec<u32>,
    ) {
        let least = self.round_before(USED_LATELY_ROUNDS);
        let Some(set) = self.sets.get_mut(&key) else { return };
        for &i in indices {
            let last = std::mem::replace(&mut set.needed[i as usize], self.round);
            if last < least {
                newly_used.push(i);
            }
        }
    }

    /// Returns the first of `rounds` rounds before the present one.
    fn round_before(&self, rounds: u64) -> u64 {
        self.round.saturating_sub(rounds).max(1)
    }

    /// Returns which worker has which bricks of an open set, and which bricks were used lately.
    /// `sole`: no frames overlap.
    pub(crate) fn presence(&self, key: BrickSetKey, sole: bool) -> Option<BrickPresence<'_>> {
        let needed = &self.sets.get(&key)?.needed;
        let least = self.round_before(if sole { 1 } else { USED_LATELY_ROUNDS });
        Some(BrickPresence { key, needed, least, workers: &self.workers })
    }

    /// Queues bricks that workers are expected to request. A worker without room for all of its
    /// list is sent none of it: it would have to evict what it needs. Returns the workers that are
    /// sent some.
    pub(crate) fn queue_prefetch(
        &mut self,
        key: BrickSetKey,
        lists: Vec<(WorkerId, Vec<u32>)>,
    ) -> Vec<WorkerId> {
        let Some(set) = self.sets.get(&key) else { return Vec::new() };
        let mut requested = Vec::new();
        for (worker, indices) in lists {
            let Some(holder) = self.workers.get_mut(worker) else { continue };
            let bytes: u64 = indices.iter().map(|&i| u64::from(set.bricks[i as usize].bytes)).sum();
            if holder.bytes.saturating_add(bytes) > holder.budget {
                continue;
            }
            holder.sets.entry(key).or_insert_with(|| SetBooks::new(set.bricks.len()));
            request(&mut holder.requested, key, indices);
            requested.push(worker);
        }
        requested
    }

    /// Notes that a worker evicted bricks. Those that a lease needs are sent again.
    pub(crate) fn evicted(&mut self, worker: WorkerId, key: BrickSetKey, ids: &[BrickId]) {
        let (Some(set), Some(holder)) = (self.sets.get(&key), self.workers.get_mut(worker)) else {
            return;
        };
        let Some(books) = holder.sets.get_mut(&key) else { return };
        for &id in ids {
            let Some(i) = set.index_of(id) else { continue };
            if books.state[i as usize] != BrickState::Held {
                continue;
            }
            let bytes = u64::from(set.bricks[i as usize].bytes);
            books.state[i as usize] = BrickState::Absent;
            books.held_count -= 1;
            books.held_bytes -= bytes;
            holder.bytes -= bytes;
            if books.pins[i as usize] > 0 && key == self.current {
                books.wanted[i as usize] = true;
                holder.wanted.push_back(i);
            }
        }
    }

    /// Confirms all drops before the ping `nonce`: the worker has read them.
    pub(crate) fn ponged(&mut self, worker: WorkerId, nonce: u64) {
        let Some(holder) = self.workers.get_mut(worker) else { return };
        while holder.dropping.front().is_some_and(|(n, ..)| *n <= nonce) {
            let (_, key, gone) = holder.dropping.pop_front().expect("there is a front");
            let books = holder.sets.get_mut(&key).expect("what leaves has books");
            for i in gone {
                let bytes = u64::from(self.sets[&key].bricks[i as usize].bytes);
                books.state[i as usize] = BrickState::Absent;
                holder.bytes -= bytes;
                holder.dropping_bytes -= bytes;
            }
        }
    }

    /// Returns the number of bricks of a set that a worker holds, and their bytes.
    pub(crate) fn held_of_set(&self, worker: WorkerId, key: BrickSetKey) -> (u64, u64) {
        let books = self.workers.get(worker).and_then(|s| s.sets.get(&key));
        books.map_or((0, 0), |b| (b.held_count, b.held_bytes))
    }

    /// Returns the number of bricks of all sets that a worker holds, and their bytes.
    pub(crate) fn held(&self, worker: WorkerId) -> (u64, u64) {
        let books = self.workers.get(worker).into_iter().flat_map(|s| s.sets.values());
        books.fold((0, 0), |(n, b), books| (n + books.held_count, b + books.held_bytes))
    }

    /// Returns the transfer to a worker that has not ended.
    pub(crate) fn transfer(&self, worker: WorkerId) -> Option<Transfer> {
        self.workers.get(worker).and_then(|s| s.transfer)
    }

    /// Ends all transfers for the statistics of one frame and begins new ones for the next. Returns
    /// the ended ones.
    pub(crate) fn split_transfers(&mut self, now: Micros) -> Vec<(WorkerId, Transfer)> {
        let mut cut = Vec::new();
        for (worker, holder) in self.workers.iter_mut() {
            if let Some(transfer) = &mut holder.transfer {
                cut.push((worker, *transfer));
                *transfer = Transfer { since: now, bricks: 0, bytes: 0 };
            }
        }
        cut
    }
}
