//! State of a virtual worker.

use super::BrickOrder;
use crate::Nanos;
use crate::config::WorkerProfile;
use crate::model::{Region, TaskFacts};
use crate::queues::{Cores, Pipe};
use slabcast_common::brick::{BrickInfo, BrickSetKey};
use slabcast_common::ids::{BrickId, Epoch, FrameId, TaskId};
use slabcast_common::lookahead::Lookahead;
use slabcast_common::message::{Lease, RegionLease};
use slabcast_common::occlusion::Rect;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

/// A lease on its way through a worker's stream.
pub(super) enum Lent {
    Slab(Box<Lease>),
    Region(RegionLease),
}

/// A task of a worker: its lease and, for a region, the progress.
pub(super) enum Task<R> {
    Slab(Box<Lease>),
    Region(RegionLease, R),
}

impl<R> Task<R> {
    pub(super) fn frame(&self) -> FrameId {
        match self {
            Task::Slab(l) => l.frame,
            Task::Region(l, _) => l.frame,
        }
    }

    pub(super) fn key(&self) -> (TaskId, Epoch) {
        match self {
            Task::Slab(l) => (l.task, l.epoch),
            Task::Region(l, _) => (l.task, l.epoch),
        }
    }

    pub(super) fn tile(&self) -> Rect {
        match self {
            Task::Slab(l) => l.tile,
            Task::Region(l, _) => l.tile,
        }
    }
}

/// A task that a worker was lent, waiting or running.
pub(super) struct Loan<R> {
    pub(super) task: Task<R>,
    pub(super) facts: TaskFacts,
    pub(super) set: BrickSetKey,
    /// Number of the client that asked for the frame.
    pub(super) client: u64,
    pub(super) received: Nanos,
    /// The order in which threads take tasks.
    pub(super) order: u64,
    /// Whether its bricks were prefetched, as far as the frame before tells.
    pub(super) prefetched: bool,
    /// Sheets that it looks ahead since a thread took it.
    pub(super) ahead_sheets: u32,
    /// Whether a thread has begun it.
    pub(super) begun: bool,
    /// Since when it is stalled, how often it was, and how long in all.
    pub(super) stalled_since: Option<Nanos>,
    pub(super) stalls: u32,
    pub(super) stalled_ns: Nanos,
    /// Places of the bricks that it waits for.
    pub(super) waits: BTreeSet<u32>,
    /// Places of the bricks that it waited for since it last came farther: they are not evicted.
    pub(super) keeps: BTreeSet<u32>,
    /// Time for which threads drew it.
    pub(super) drawn_ns: Nanos,
    /// Rehearsal: when its placeholder pixels are there.
    pub(super) pixels: Nanos,
}

/// A stretch of a thread's time in which it draws one task.
pub(super) struct Run<R> {
    pub(super) loan: Loan<R>,
    pub(super) start: Nanos,
    /// Time before the tile itself: tables, and blocks of bricks.
    pub(super) tables_ns: Nanos,
    pub(super) blocks_ns: Nanos,
    /// Factor on the model's times.
    pub(super) stretch: f64,
    /// Up to when the progress was followed.
    pub(super) followed: Nanos,
    /// Time that messages took of its core.
    pub(super) stolen_ns: Nanos,
    /// Time at which the run gives way to another client; `None` if no client waits.
    pub(super) gives_way: Option<Nanos>,
    /// When it ends, not counting messages meanwhile; `None`: never by itself.
    pub(super) end: Option<Nanos>,
    /// The version of the end that counts.
    pub(super) version: u64,
}

impl<R: Region> Run<R> {
    /// Follows the progress up to now.
    pub(super) fn follow(&mut self, present: &[bool], now: Nanos) {
        if let Task::Region(_, region) = &mut self.loan.task {
            let went = now.saturating_sub(self.followed);
            region.advance(went as f64 / self.stretch, &has(present));
            self.followed += went;
        }
    }
}

/// A thread without a task.
#[derive(Clone, Copy, Default)]
pub(super) struct Idle {
    pub(super) since: Nanos,
    /// When the master was done with the first message of its worker after that, and lent nothing.
    pub(super) heard: Option<Nanos>,
}

pub(super) struct Worker<R> {
    pub(super) profile: WorkerProfile,
    pub(super) leaving: bool,
    /// No message passes to or from it until then.
    pub(super) partitioned_until: Nanos,

    // Its link: each direction, and when the last message of each stream arrives.
    pub(super) down: Pipe,
    pub(super) up: Pipe,
    pub(super) bricks_down: Pipe,
    pub(super) down_arrives: Nanos,
    pub(super) up_arrives: Nanos,
    pub(super) bricks_arrive: Nanos,
    pub(super) brick_orders: VecDeque<(BrickSetKey, BrickOrder, u64)>,
    pub(super) batches_in_flight: usize,
    /// Receives and sends.
    pub(super) io: Cores,
    /// When its last message was read, written, and read by the master.
    pub(super) read: Nanos,
    pub(super) wrote: Nanos,
    pub(super) heard: Nanos,
    /// Time that messages took of a core that a render thread had.
    pub(super) stolen: Nanos,
    /// Whether finished pixels go unpacked.
    pub(super) plain: bool,

    // Its bricks.
    /// Whether it holds a brick, by place in the list of the set.
    pub(super) present: BTreeMap<BrickSetKey, Vec<bool>>,
    pub(super) held_bytes: u64,
    /// Bytes of the bricks that regions asked for, by set and place, and their sum.
    pub(super) asked: BTreeMap<(BrickSetKey, u32), u64>,
    pub(super) asked_bytes: u64,
    /// Whether it was sent a directory, so that it keeps its own memory budget.
    pub(super) has_directory: bool,
    /// Parts of pictures that it drew, whose depths it knows.
    pub(super) drawn: BTreeSet<(BrickSetKey, i32, i32)>,
    /// Look-ahead of its regions, and the first frame that it drew of each set.
    pub(super) lookahead: Lookahead,
    pub(super) first: BTreeMap<BrickSetKey, FrameId>,

    // Its tasks.
    /// Frames that were announced and have not ended.
    pub(super) frames: BTreeSet<FrameId>,
    pub(super) loans: Vec<Loan<R>>,
    /// Thread time that each client had, in microseconds.
    pub(super) spent: BTreeMap<u64, Nanos>,
    pub(super) running: Vec<Option<Run<R>>>,
    pub(super) idle: Vec<Idle>,
    /// When its tables of a frame are made.
    pub(super) tables: BTreeMap<FrameId, Nanos>,
    /// Blocks of bricks that its tiles of a frame opened.
    pub(super) opened: BTreeMap<FrameId, BTreeSet<u32>>,
}

/// Returns whether the brick at a place is present; places beyond the set's list are.
pub(super) fn has(present: &[bool]) -> impl Fn(u32) -> bool {
    |place| present.get(place as usize) != Some(&false)
}

impl<R> Worker<R> {
    pub(super) fn new(
        profile: WorkerProfile,
        sets: &BTreeMap<BrickSetKey, Arc<[BrickInfo]>>,
    ) -> Self {
        let threads = profile.threads as usize;
        Worker {
            leaving: false,
            partitioned_until: 0,
            down: Pipe::new(profile.bytes_per_s),
            up: Pipe::new(profile.bytes_per_s),
            bricks_down: Pipe::new(profile.brick_bytes_per_s),
            down_arrives: 0,
            up_arrives: 0,
            bricks_arrive: 0,
            brick_orders: VecDeque::new(),
            batches_in_flight: 0,
            io: Cores::new(1),
            read: 0,
            wrote: 0,
            heard: 0,
            stolen: 0,
            plain: false,
            present: sets.iter().map(|(set, bricks)| (*set, vec![false; bricks.len()])).collect(),
            held_bytes: 0,
            asked: BTreeMap::new(),
            asked_bytes: 0,
            has_directory: false,
            drawn: BTreeSet::new(),
            lookahead: Lookahead::default(),
            first: BTreeMap::new(),
            frames: BTreeSet::new(),
            loans: Vec::new(),
            spent: BTreeMap::new(),
            running: (0..threads).map(|_| None).collect(),
            idle: vec![Idle::default(); threads],
            tables: BTreeMap::new(),
            opened: BTreeMap::new(),
            profile,
        }
    }

    /// Learns the number of bricks of a set.
    pub(super) fn learn_set(&mut self, set: BrickSetKey, bricks: usize) {
        self.present.insert(set, vec![false; bricks]);
    }

    /// Holds a brick of a set from now on. Returns its place; `None` if it held it before, or the
    /// set has no such brick.
    pub(super) fn hold(
        &mut self,
        set: BrickSetKey,
        bricks: &[BrickInfo],
        id: BrickId,
    ) -> Option<u32> {
        let place = bricks.binary_search_by_key(&id, |b| b.id).ok()?;
        let here = &mut self.present.get_mut(&set)?[place];
        if std::mem::replace(here, true) {
            return None;
        }
        self.held_bytes += u64::from(bricks[place].bytes);
        Some(place as u32)
    }

    /// Forgets a frame and the tasks of it that no thread draws. A brick that only these waited for
    /// may be asked for again.
    pub(super) fn end_frame(&mut self, frame: FrameId) {
        self.frames.remove(&frame);
        self.tables.remove(&frame);
        self.opened.remove(&frame);
        let (ended, others) =
            std::mem::take(&mut self.loans).into_iter().partition(|l| l.task.frame() == frame);
        self.loans = others;
        let ended: Vec<Loan<R>> = ended;
        for loan in ended {
            for place in loan.waits {
                let is_waited_for =
                    self.loans.iter().any(|l| l.set == loan.set && l.waits.contains(&place));
                if !is_waited_for && let Some(bytes) = self.asked.remove(&(loan.set, place)) {
                    self.asked_bytes -= bytes;
                }
            }
        }
    }
}
