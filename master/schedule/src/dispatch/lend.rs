//! Leases: which task of a frame goes to which worker, and when (section 4.4;
//! docs/design/cluster.md section 3).
//!
//! ```text
//! slab     every thread gets a task, round robin; then tasks are lent ahead
//! region   each worker gets its own tiles, as many as it renders in a while
//! both     a silent task is lent to an idle worker too                       (speculate)
//! region   idle threads take other workers' tiles, or pieces of them         (steal)
//! ```
//!
//! Then leases leave, each worker's together, with the bricks that their tiles used before.

use crate::state::brick_orders::send_bricks;
use crate::state::cluster::Cluster;
use crate::state::frame::{FrameCore, StepContext};
use crate::state::region_frame::RegionFrame;
use crate::state::slab_frame::SlabFrame;
use crate::state::task_queue::Task;
use crate::state::workers::{Roster, Worker};
use crate::{FrameJob, Micros};
use slabcast_common::brick::BrickGrid;
use slabcast_common::ids::{BrickId, WorkerId};
use slabcast_common::message::{Lease, RegionLease, ToWorker};
use slabcast_common::view::Projected;
use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet};

/// Limit: leases of a thread, however short their tiles: a peer's clock says how short.
const MAX_LEASES_PER_THREAD: u64 = 32;

/// Limit: waiting tasks that are tried for a worker short of memory.
const MAX_TRIES_TO_FIT: u32 = 16;

/// Amount of work that is lent ahead.
#[derive(Clone, Copy)]
pub(crate) struct LendAhead {
    /// Rendering time for each thread, in microseconds.
    us: f64,
    /// Leases for each thread.
    leases: u64,
}

impl LendAhead {
    pub(crate) fn new(us: f64, roster: &Roster) -> LendAhead {
        // No other worker could steal from the only one, and where it lacks bricks of some tiles it
        // has others meanwhile: one worker takes 12.75 ms for a frame of mri256, and 13.25 if it is
        // lent less.
        let is_only = roster.active().nth(1).is_none();
        LendAhead { us: if is_only { f64::INFINITY } else { us }, leases: MAX_LEASES_PER_THREAD }
    }

    /// Whether a worker with so much rendering time lent is lent no more for now: each lending
    /// wakes it, and three tiles in one message are as quickly there as one. So it is lent again
    /// when half is rendered.
    pub(crate) fn is_enough(self, worker: &Worker, lent_us: f64, queue_ahead: u64) -> bool {
        let threads = u64::from(worker.threads);
        worker.own_leases() >= threads.saturating_mul(queue_ahead.max(2))
            && lent_us >= 0.5 * self.us * threads as f64
    }
}

/// Leases of one step, in the order in which they were given: worker and task.
pub(super) type NewLeases = Vec<(WorkerId, u32)>;

impl FrameCore {
    /// Lends a task to a worker: a waiting one, or a speculative copy.
    pub(super) fn lend(
        &mut self,
        cluster: &mut Cluster,
        place: u32,
        id: WorkerId,
        bricks: Vec<u32>,
        is_copy: bool,
        now: Micros,
    ) {
        cluster.roster.add_lease(id, now, &cluster.config);
        // Copies and pieces too: a worker can tell them from other tasks, and would lie in those.
        let is_audited = self.table.queue.tasks[place as usize].is_audited();
        if !is_audited && cluster.audits(id, self.table.queue.id(place).0) {
            self.table.queue.audit(place);
        }
        if !bricks.is_empty() {
            cluster.residency.pin(id, &bricks);
            cluster.residency.want(id, bricks.iter().copied());
        }
        self.table.lend(place, id, bricks, is_copy, now, &cluster.config);
    }

    /// Returns the first waiting task with `among` and `suits` that a worker may have.
    pub(super) fn next_for(
        &self,
        cluster: &Cluster,
        id: WorkerId,
        among: impl Fn(u32) -> bool,
        suits: impl Fn(u32) -> bool,
    ) -> Option<u32> {
        let mine = || self.table.places(id).collect();
        let may_try = |task: &Task| may_try(cluster, task, id);
        self.table.queue.next_for(mine, among, may_try, suits)
    }

    /// Returns the first waiting task among a worker's own that it may have.
    fn next_own(&self, cluster: &Cluster, id: WorkerId, own: &[u32]) -> Option<u32> {
        let mine = || self.table.places(id).collect();
        let may_try = |task: &Task| may_try(cluster, task, id);
        self.table.queue.next_among(mine, own, may_try)
    }

    /// Sends a worker the scene and the view of the frame, if it was not sent them.
    fn announce(&mut self, cluster: &mut Cluster, id: WorkerId) {
        if !self.announced_to.insert(id) {
            return;
        }
        let scene = &self.job.scene;
        let Some(worker) = cluster.roster.get_mut(id) else { return };
        let plain = worker.is_local || !cluster.link_use.packs_results();
        if worker.scenes.insert(scene.id) {
            cluster.send(id, ToWorker::Scene(scene.clone()));
        }
        let FrameJob { frame, view, client, .. } = *self.job;
        let (scene, finish) = (scene.id, self.finish);
        cluster.send(id, ToWorker::Frame { frame, scene, view, finish, plain, client });
    }

    /// Calls `send` for each new lease, in order, with the index of the lease among the worker's.
    fn send_leases(
        &mut self,
        cluster: &mut Cluster,
        leases: &NewLeases,
        mut send: impl FnMut(&FrameCore, &mut Cluster, WorkerId, u32, usize),
    ) {
        // Each worker's new leases are its last ones.
        let mut count = BTreeMap::new();
        for (id, _) in leases {
            *count.entry(*id).or_insert(0usize) += 1;
        }
        for &(id, place) in leases {
            let Some(left) = count.get_mut(&id) else { continue };
            let index = self.table.lent(id).len() - *left;
            *left -= 1;
            self.announce(cluster, id);
            send(self, cluster, id, place, index);
        }
    }
}

impl SlabFrame {
    /// Lends tasks to free threads, and sends bricks.
    ///
    /// First every thread gets a task, round robin. Then tasks are lent ahead, so that a thread
    /// need not wait for a round trip between two (docs/design/transport.md: two in flight a thread
    /// hide the latency of 64x64 tiles), but not the last ones, as many as there are threads: those
    /// go one by one to whichever worker runs idle, since an idle worker can't take a task that
    /// waits behind another on one worker. Where another frame comes after, nothing is held back.
    pub(crate) fn dispatch(&mut self, cluster: &mut Cluster, context: StepContext, now: Micros) {
        let mut leases = self.choose(cluster, context, now);
        self.core.speculate_at = None;
        while cluster.roster.any_idle_thread()
            && let Some((place, id)) = self.next_silent(cluster, now)
        {
            let bricks = self.bricks_of(place);
            self.core.lend(cluster, place, id, bricks, true, now);
            leases.push((id, place));
        }
        let mut receivers: BTreeSet<WorkerId> = leases.iter().map(|l| l.0).collect();
        let changes = cluster.roster.changes();
        if self.changes.replace(changes) != Some(changes) {
            let active: Vec<_> = cluster.roster.active().map(|(id, _)| id).collect();
            for id in active.into_iter().filter(|id| self.served.insert(*id)) {
                receivers.insert(id);
                if !cluster.residency.is_lazy(id) {
                    cluster.residency.want(id, self.brick_order.iter().copied());
                }
            }
        }
        for &id in &receivers {
            send_bricks(cluster, Some(&mut self.core.ledger), id, now);
        }
        let sheets = self.sheets();
        self.core.send_leases(cluster, &leases, |core, cluster, id, place, index| {
            let lent = &core.table.lent(id)[index];
            let tile = core.table.tile(place);
            let brick_id = |&i: &u32| -> BrickId { core.job.bricks[i as usize].id };
            let lease = Lease {
                task: lent.task,
                epoch: lent.epoch,
                frame: core.job.frame,
                tile,
                slab: sheets,
                bricks: lent.bricks.iter().map(brick_id).collect(),
                state: core.picture.tile_state(tile),
            };
            cluster.send(id, ToWorker::Lease(Box::new(lease)));
        });
    }

    fn next_silent(&mut self, cluster: &Cluster, now: Micros) -> Option<(u32, WorkerId)> {
        let fits = |id: WorkerId, place: u32| {
            !cluster.residency.is_lazy(id) || cluster.residency.fits(id, &self.bricks_of(place))
        };
        let found = self.core.find_silent(cluster, |_| 0, &[], fits, now);
        self.core.speculate_at = found.at;
        found.copy
    }

    /// Lends waiting tasks.
    fn choose(&mut self, cluster: &mut Cluster, context: StepContext, now: Micros) -> NewLeases {
        let ahead = u64::from(cluster.config.queue_ahead.max(1));
        let all_threads = cluster.roster.threads();
        let mut leases = Vec::new();
        let mut refused = BTreeSet::new();
        loop {
            let waiting = self.core.table.queue.waiting() as u64;
            if waiting == 0 {
                break;
            }
            let takers = || cluster.roster.active().filter(|(id, _)| !refused.contains(id));
            let idle = takers().filter(|(_, w)| w.has_idle_thread()).min_by_key(|(_, w)| w.leases);
            let next = idle.or_else(|| {
                // a/b < c/d as a d < c b.
                takers()
                    .filter(|_| !context.is_last_frame || waiting > all_threads)
                    .filter(|(_, w)| w.leases < u64::from(w.threads).saturating_mul(ahead))
                    .reduce(|a, b| {
                        let (x, y) = (u128::from(a.1.leases), u128::from(b.1.leases));
                        let less = y * u128::from(a.1.threads) < x * u128::from(b.1.threads);
                        if less { b } else { a }
                    })
            });
            let Some((id, _)) = next else { break };
            let tries = Cell::new(0);
            let suits = |place| {
                if self.core.leases(id) == 0 || !cluster.residency.is_lazy(id) {
                    return true;
                }
                tries.set(tries.get() + 1);
                tries.get() <= MAX_TRIES_TO_FIT
                    && cluster.residency.fits(id, &self.bricks_of(place))
            };
            match self.core.next_for(cluster, id, |_| true, suits) {
                Some(place) => {
                    let bricks = self.bricks_of(place);
                    self.core.lend(cluster, place, id, bricks, false, now);
                    leases.push((id, place));
                }
                None => {
                    refused.insert(id);
                }
            }
        }
        leases
    }
}

impl RegionFrame {
    /// Lends workers their own tiles, or idle ones what is others' where the context allows.
    pub(crate) fn dispatch(&mut self, cluster: &mut Cluster, context: StepContext, now: Micros) {
        let mut leases = match context.may_steal {
            false => self.lend_own(cluster, context, now),
            true => self.steal_waiting(cluster, context, now),
        };
        let questions = match context.may_steal && context.is_last_frame {
            true => self.find_pieces(cluster, now),
            false => Vec::new(),
        };
        // No task gets silent before the time that was found last.
        let is_known = context.freed_worker.is_some()
            && self.core.speculate_at.is_some_and(|until| now < until);
        if !is_known {
            self.core.speculate_at = None;
        }
        while context.may_steal
            && !is_known
            && cluster.roster.any_idle_thread()
            && let Some((place, id)) = self.next_silent(cluster, now)
        {
            self.core.lend(cluster, place, id, Vec::new(), true, now);
            leases.push((id, place));
        }
        let changes = cluster.roster.changes();
        if self.changes.replace(changes) != Some(changes) {
            self.has_orphans = !self.tiles.missing_owners(&cluster.roster).is_empty();
        }
        self.queue_bricks(cluster, &leases);
        let set = self.core.job.scene.bricks;
        self.core.send_leases(cluster, &leases, |core, cluster, id, place, index| {
            let Some(worker) = cluster.roster.get_mut(id) else { return };
            if worker.lacks_directory(set) {
                let (grid, bricks) = (core.job.scene.volume.lattice.dims, &core.job.bricks);
                let message = ToWorker::Directory {
                    set,
                    grid: BrickGrid::new(grid),
                    first: 0,
                    total: bricks.len() as u32,
                    bricks: bricks.clone(),
                };
                cluster.send(id, message);
            }
            let lent = &core.table.lent(id)[index];
            let (task, epoch, frame) = (lent.task, lent.epoch, core.job.frame);
            let begun = core.table.queue.tasks[place as usize].begun.clone();
            let (tile, estimate) = (core.table.tile(place), core.job.work.estimate);
            let lease = RegionLease { task, epoch, frame, tile, estimate, begun };
            cluster.send(id, ToWorker::Region(lease));
        });
        // Leases go first, lest they wait behind others' bricks: a region asks for what it lacks,
        // and 64 workers that begin a frame are sent up to 19 MB.
        let receivers: BTreeSet<WorkerId> = leases.iter().map(|l| l.0).collect();
        for id in receivers {
            send_bricks(cluster, Some(&mut self.core.ledger), id, now);
        }
        self.ask_for_pieces(cluster, questions);
    }

    fn next_silent(&mut self, cluster: &Cluster, now: Micros) -> Option<(u32, WorkerId)> {
        let questions = self.splits.open_questions(now);
        let asked_until = |place| self.splits.asked_until(place);
        let found = self.core.find_silent(cluster, asked_until, &questions, |_, _| true, now);
        self.core.speculate_at = found.at;
        found.copy
    }

    /// Queues the bricks that new leases' tiles used on other workers in the frame before.
    fn queue_bricks(&self, cluster: &mut Cluster, leases: &NewLeases) {
        let job = &self.core.job;
        let Some(history) = cluster.history.view(self.key) else { return };
        for &(id, place) in leases {
            let tile = self.core.table.tile(place);
            // A piece needs only the bricks behind the sheets of its state.
            let begun = self.core.table.queue.tasks[place as usize].begun.as_ref();
            let first_sheet = begun.and_then(|begun| begun.sheets.iter().flatten().min());
            for (bricks, is_part) in history.bricks_elsewhere(&tile, id) {
                let is_used = |i: &u32| {
                    if !is_part && first_sheet.is_none() {
                        return true;
                    }
                    let projected = job.view.project(&job.bricks[*i as usize].tight);
                    projected.is_some_and(|p: Projected| {
                        first_sheet.is_none_or(|first| p.sheets.end > *first)
                            && !p.rect.intersect(&tile).is_empty()
                    })
                };
                let used = bricks.iter().copied().filter(is_used);
                cluster.residency.request(id, job.scene.bricks, used);
            }
        }
    }

    /// Lends a waiting task, which becomes the worker's own.
    pub(super) fn give(&mut self, cluster: &mut Cluster, place: u32, id: WorkerId, now: Micros) {
        self.core.lend(cluster, place, id, Vec::new(), false, now);
        self.tiles.give(place, id);
    }

    /// Returns the predicted time for a worker's leases of this frame in microseconds; infinite if
    /// any is unknown.
    pub(crate) fn lent_us(&self, id: WorkerId) -> f64 {
        let places = self.core.table.places(id);
        places.map(|place| self.tiles.us(place).unwrap_or(f64::INFINITY)).sum()
    }

    /// Lends each worker tasks that are its own, or whose owner is missing.
    ///
    /// A worker's leases of one event leave together, so all that it is to have ahead goes at once.
    fn lend_own(&mut self, cluster: &mut Cluster, context: StepContext, now: Micros) -> NewLeases {
        let mut leases = Vec::new();
        if self.core.table.queue.waiting() == 0 {
            return leases;
        }
        let queue_ahead = u64::from(cluster.config.queue_ahead.max(1));
        let ahead = LendAhead::new(self.costs.lend_ahead_us(), &cluster.roster);
        let all_threads = cluster.roster.threads();
        let (takers, missing) = self.takers(cluster, context, ahead.leases.max(queue_ahead));
        // At the end of a long sole frame little is lent ahead: others can render what waits here.
        let sole_end = self.core.sole && context.is_last_frame;
        let is_long = self.tiles.us_a_thread(all_threads) > 2.0 * ahead.us;
        let is_only = cluster.roster.active().nth(1).is_none();
        let end_us = if is_only { ahead.us } else { self.costs.round_trip_us };
        // All threads have a task before any has more.
        for first in [true, false] {
            for &(id, threads) in &takers {
                let mut us = self.lent_us(id);
                loop {
                    let waiting = self.core.table.queue.waiting() as u64;
                    if waiting == 0 {
                        break;
                    }
                    let load = cluster.roster.get(id).map_or(u64::MAX, Worker::own_leases);
                    let at_end = sole_end && is_long && waiting <= 2 * all_threads;
                    let ahead_us = if at_end { end_us } else { ahead.us };
                    let is_short = us < ahead_us * threads as f64
                        && load < threads.saturating_mul(ahead.leases);
                    let holds_back = context.is_last_frame && waiting <= all_threads;
                    let may = match first {
                        true => load < threads,
                        false => {
                            is_short || !holds_back && load < threads.saturating_mul(queue_ahead)
                        }
                    };
                    if !may {
                        break;
                    }
                    let next = if missing.is_empty() {
                        self.core.next_own(cluster, id, self.tiles.owned(id))
                    } else {
                        let is_own = |place| {
                            let owner = self.tiles.owner(place);
                            owner == id || missing.contains(&owner)
                        };
                        self.core.next_for(cluster, id, is_own, |_| true)
                    };
                    let Some(place) = next else { break };
                    us += self.tiles.us(place).unwrap_or(f64::INFINITY);
                    self.give(cluster, place, id, now);
                    leases.push((id, place));
                }
            }
        }
        leases
    }

    /// Returns workers that may be lent tasks, with their threads, and owners that are missing and
    /// have waiting tasks.
    fn takers(
        &self,
        cluster: &Cluster,
        context: StepContext,
        leases_a_thread: u64,
    ) -> (Vec<(WorkerId, u64)>, Vec<WorkerId>) {
        let queue = &self.core.table.queue;
        let has_room = |id: WorkerId, w: &Worker| {
            w.own_leases() < u64::from(w.threads).saturating_mul(leases_a_thread)
                && cluster.saturated.binary_search(&id).is_err()
        };
        let has_own = |id: WorkerId| queue.any_waiting(self.tiles.owned(id));
        let mut missing = match context.freed_worker {
            // All that missing owners had is lent, or waits for room.
            Some(_) if self.changes == Some(cluster.roster.changes()) && !self.has_orphans => {
                Vec::new()
            }
            _ => self.tiles.missing_owners(&cluster.roster),
        };
        if let Some(id) = context.freed_worker.filter(|_| missing.is_empty()) {
            let worker = cluster.roster.get(id).filter(|w| w.is_active() && has_room(id, w));
            let taker = worker.filter(|_| has_own(id)).map(|w| (id, u64::from(w.threads)));
            return (taker.into_iter().collect(), missing);
        }
        missing.retain(|id| has_own(*id));
        let active = cluster.roster.active();
        let takers = active
            .filter(|(id, w)| has_room(*id, w) && (!missing.is_empty() || has_own(*id)))
            .map(|(id, w)| (id, u64::from(w.threads)))
            .collect();
        (takers, missing)
    }
}

/// Whether a worker may try a task that workers failed at or that is audited: the likeliest do.
/// These are workers that have not failed at it, and of them those that have drawn something
/// before, since anybody may call himself a new worker.
pub(super) fn may_try(cluster: &Cluster, task: &Task, id: WorkerId) -> bool {
    let rank = |w: &Worker| match task.was_failed_by(&w.identity) {
        true => 0,
        false => 1 + u32::from(w.reputation.has_drawn),
    };
    if let (Some(audit), Some(w)) = (task.audit(), cluster.roster.get(id)) {
        // Who has voted has no other vote, nor has its neighbour if one from elsewhere is there.
        let may = |w: &Worker| !audit.has_vote_of(&w.identity);
        let is_far = |w: &Worker| w.is_trusted || audit.is_elsewhere(&w.identity);
        let is_better = |w: &Worker| may(w) && is_far(w) && !w.is_stuck;
        let waits = || cluster.roster.active().any(|(_, other)| is_better(other));
        if !may(w) || !is_far(w) && waits() {
            return false;
        }
    }
    let mine = cluster.roster.get(id).map_or(0, rank);
    !task.is_choosy() || cluster.roster.active().all(|(_, w)| rank(w) <= mine)
}
