//! The books of one worker: which bricks it holds, which are in flight, which are being dropped.

use super::ResidencyAction;
use crate::Micros;
use slabcast_common::brick::{BrickInfo, BrickSetKey};
use slabcast_common::ids::BrickId;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// State of one brick at one worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BrickState {
    /// The worker neither holds it nor is being sent it.
    Absent,
    /// Sent, and not acknowledged yet.
    InFlight,
    /// Acknowledged by the worker.
    Held,
    /// The worker was told to drop it and has not confirmed that.
    Dropping,
}

/// One worker's bricks of one set. Vectors are indexed like the set's brick list.
#[derive(Debug)]
pub(super) struct SetBooks {
    pub(super) state: Vec<BrickState>,
    /// Number of leases that need the brick and have no result yet.
    pub(super) pins: Vec<u32>,
    /// Whether the brick is in the worker's `wanted` queue.
    pub(super) wanted: Vec<bool>,
    pub(super) in_flight: VecDeque<u32>,
    pub(super) held_count: u64,
    pub(super) held_bytes: u64,
}

impl SetBooks {
    pub(super) fn new(bricks: usize) -> Self {
        SetBooks {
            state: vec![BrickState::Absent; bricks],
            pins: vec![0; bricks],
            wanted: vec![false; bricks],
            in_flight: VecDeque::new(),
            held_count: 0,
            held_bytes: 0,
        }
    }
}

/// An uninterrupted transfer of bricks to one worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Transfer {
    pub(crate) since: Micros,
    pub(crate) bricks: u64,
    pub(crate) bytes: u64,
}

/// Rule by which bricks are sent to a worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Mode {
    /// The worker is sent every brick that the slab needs.
    Broadcast,
    /// The worker is sent the bricks of its leases only.
    Lazy,
    /// The worker asks for bricks and evicts them itself.
    OnRequest,
}

/// All bricks of one worker, with what it is to be sent. Sizes in encoded bytes.
#[derive(Debug)]
pub(super) struct WorkerBricks {
    pub(super) budget: u64,
    /// Bytes in flight, held or being dropped.
    pub(super) bytes: u64,
    /// Bytes being dropped.
    pub(super) dropping_bytes: u64,
    /// Bytes that a lease needs.
    pub(super) pinned_bytes: u64,
    pub(super) sets: BTreeMap<BrickSetKey, SetBooks>,
    /// Bricks named in the worker's hello, of sets that are not open yet.
    pub(super) announced: BTreeMap<BrickSetKey, Vec<BrickId>>,
    /// Drops without a pong: the nonce of the ping that follows the drop, the set, the bricks.
    pub(super) dropping: VecDeque<(u64, BrickSetKey, Vec<u32>)>,
    /// Bricks of the current set to send, in order.
    pub(super) wanted: VecDeque<u32>,
    /// Bricks asked for that wait for a drop to be confirmed, or that have to be sent again.
    pub(super) requested: Vec<(BrickSetKey, Vec<u32>)>,
    pub(super) mode: Mode,
    pub(super) transfer: Option<Transfer>,
}

/// The bricks of one set.
#[derive(Debug)]
pub(super) struct Set {
    pub(super) bricks: Arc<[BrickInfo]>,
    /// Ids of `bricks` alone: a search touches a tenth of the memory.
    pub(super) ids: Vec<BrickId>,
    /// Voxels of all bricks, and their encoded bytes.
    pub(super) voxels: u64,
    pub(super) all_bytes: u64,
    /// Round in which each brick was needed last.
    pub(super) needed: Vec<u64>,
}

impl Set {
    pub(super) fn new(bricks: &Arc<[BrickInfo]>) -> Self {
        let ids: Vec<BrickId> = bricks.iter().map(|b| b.id).collect();
        assert!(ids.windows(2).all(|w| w[0] < w[1]), "a job's bricks ascend by id");
        let voxels = bricks.iter().map(|b| u64::from(b.voxels)).sum();
        let all_bytes = bricks.iter().map(|b| u64::from(b.bytes)).sum();
        Set { bricks: bricks.clone(), ids, voxels, all_bytes, needed: vec![0; bricks.len()] }
    }

    pub(super) fn index_of(&self, id: BrickId) -> Option<u32> {
        self.ids.binary_search(&id).ok().map(|i| i as u32)
    }
}

impl WorkerBricks {
    /// Keeps the wanted bricks of the set `key` for whose number of pins `keep` is true.
    pub(super) fn keep_wanted(&mut self, key: BrickSetKey, keep: impl Fn(u32) -> bool) {
        let Some(books) = self.sets.get_mut(&key) else { return };
        self.wanted.retain(|&i| {
            let keep = keep(books.pins[i as usize]);
            books.wanted[i as usize] = keep;
            keep
        });
    }

    /// Adds bricks to the transfer to the worker, and begins one if there is none.
    pub(super) fn departs(&mut self, now: Micros, bricks: u64, bytes: u64) {
        let transfer = self.transfer.get_or_insert(Transfer { since: now, bricks: 0, bytes: 0 });
        transfer.bricks += bricks;
        transfer.bytes += bytes;
    }

    /// Ends and returns the transfer once no brick is in flight.
    pub(super) fn landed(&mut self) -> Option<Transfer> {
        if self.sets.values().all(|b| b.in_flight.is_empty()) { self.transfer.take() } else { None }
    }
}

/// Sends the requested bricks that the worker neither holds nor is being sent. A brick that is
/// being dropped stays requested until the drop is confirmed.
pub(super) fn send_requested(
    sets: &BTreeMap<BrickSetKey, Set>,
    holder: &mut WorkerBricks,
    now: Micros,
    actions: &mut Vec<ResidencyAction>,
) {
    for (key, mut indices) in std::mem::take(&mut holder.requested) {
        // A set may be closed while requests for it are in flight.
        let (Some(set), Some(books)) = (sets.get(&key), holder.sets.get_mut(&key)) else {
            continue;
        };
        let (mut sent, mut bytes) = (Vec::with_capacity(indices.len()), 0);
        indices.retain(|&i| {
            let state = &mut books.state[i as usize];
            if *state == BrickState::Absent {
                let info = &set.bricks[i as usize];
                *state = BrickState::InFlight;
                books.in_flight.push_back(i);
                sent.push(info.id);
                bytes += u64::from(info.bytes);
            }
            *state == BrickState::Dropping
        });
        if !indices.is_empty() {
            request(&mut holder.requested, key, indices);
        }
        if sent.is_empty() {
            continue;
        }
        holder.bytes += bytes;
        holder.departs(now, sent.len() as u64, bytes);
        actions.push(ResidencyAction::Send { set: key, bricks: sent, bytes, over_budget: false });
    }
}

/// Appends bricks to a worker's requests.
pub(super) fn request(
    requested: &mut Vec<(BrickSetKey, Vec<u32>)>,
    key: BrickSetKey,
    indices: impl IntoIterator<Item = u32>,
) {
    match requested.last_mut().filter(|last| last.0 == key) {
        Some(last) => last.1.extend(indices),
        None => requested.push((key, indices.into_iter().collect())),
    }
}

/// Drops at least `bytes` of unpinned bricks, least recently needed first. Bricks that the slab
/// needs are dropped only from workers in [`Mode::Lazy`].
pub(super) fn evict(
    sets: &BTreeMap<BrickSetKey, Set>,
    holder: &mut WorkerBricks,
    round: u64,
    bytes: u64,
    nonce: &mut dyn FnMut() -> u64,
    actions: &mut Vec<ResidencyAction>,
) {
    let mut victims = Vec::new();
    for (key, books) in &holder.sets {
        let needed = &sets[key].needed;
        for (i, state) in books.state.iter().enumerate() {
            let spare = holder.mode == Mode::Lazy || needed[i] < round;
            if *state == BrickState::Held && books.pins[i] == 0 && spare {
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
        let books = holder.sets.get_mut(&key).expect("victims have books");
        let bricks = &sets[&key].bricks;
        for &i in &gone {
            let size = u64::from(bricks[i as usize].bytes);
            books.state[i as usize] = BrickState::Dropping;
            books.held_count -= 1;
            books.held_bytes -= size;
            holder.dropping_bytes += size;
        }
        let nonce = nonce();
        let names = gone.iter().map(|&i| bricks[i as usize].id).collect();
        holder.dropping.push_back((nonce, key, gone));
        actions.push(ResidencyAction::Drop { set: key, bricks: names, nonce });
    }
}
