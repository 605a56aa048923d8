//! Leases: which task of a frame goes to whom, and when (section 4.4; DESIGN.md section 3).
//!
//! ```text
//! slab     every thread gets a task, round robin; then tasks are lent ahead      (choose)
//! region   each worker gets its own, as much as it draws in a while              (choose_own)
//!          threads that are dry get what is others'                              (choose_others)
//! both     who is dry runs twice what outlived its estimate                      (next_outlived)
//! ```
//!
//! Then leases leave, each worker's together, with what their tiles were drawn from before.

use crate::Micros;
use crate::policy::region::Regions;
use crate::state::cluster::Cluster;
use crate::state::frame::{Frame, Lent, Slab, StepContext, carry, finish_of};
use crate::state::task_queue::End;
use slabcast_common::brick::BrickGrid;
use slabcast_common::ids::{BrickId, Epoch, WorkerId};
use slabcast_common::message::{Lease, RegionLease, ToWorker};
use slabcast_common::view::Projected;
use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet};

/// A worker is lent so much ahead of its own, in microseconds a thread: what is known to be short
/// leaves together, and none waits for a lease between two. Others can't take what is lent, so what
/// takes long is lent when it is needed. Of mri256 at 512x512 a simulated frame of 2, 4 and 15
/// workers takes 24.3, 13.4 and 5.3 ms at 1.5 ms, and 23.2, 13.0 and 5.1 at this; threads wait less
/// often, and fewer tiles move.
const HORIZON: f64 = 4_000.0;

/// The same at the end of a frame that is alone and [long](LONG), which is there when the last
/// worker is done: what waits here others can draw. mri256 `peer-semi` at 1536x1536 takes 23.3 and
/// 13.8 ms a frame on 32 and 64 workers at four times as much, and 22.9 and 13.4 at this (`plan`,
/// one in transfer).
const HORIZON_ALONE: f64 = 1_000.0;

/// A frame that is alone is long if each thread has so much to draw of it, in microseconds. In
/// shorter ones most workers have all their leases at once, and each message more is a tenth of a
/// small tile: mri256 `peer-opaque` at 512x512 took 3.5 ms for 3.3 on 8 workers, and 10.7 for 9.9
/// on 2 where that held from the beginning.
const LONG: f64 = 8_000.0;

/// Its end is where so many tiles for each thread wait.
const ENDS: u64 = 2;

/// Who draws by itself is lent so many times as much, and as many more leases: nobody else could
/// take them, and where it has few tiles that lack bricks it has others meanwhile. One worker takes
/// 13.25 ms for a frame of mri256 at 512x512 without, and 12.75 with this (`plan`, one in transfer,
/// no limit; 14.1 and 12.8 at 1 Gbit/s).
const SOLE: u64 = 4;

/// Who draws with few others is lent so many times as much: each has most tiles of its part of the
/// picture to itself, and where a view turns all that it is lent of a frame may lack some bricks.
/// Of two, three and four workers of mri256 at 512x512 and 1 Gbit/s with four frames in transfer
/// threads wait for bricks for 10.4, 1.6 and 3.0 % of their time without, for 4.6, 0.9 and 2.8 with
/// this, and have 95, 158 and 227 frames a second and 98, 176 and 243 (`plan`; two of mouse_skull
/// 154 and 162, of aneurism 151 and 159). Four times as much has two workers draw two frames more;
/// twice as much for 8 or 15 changes nothing beyond noise.
const FEW: u64 = 2;

/// So many are few.
const MOST_FEW: usize = 4;

/// While a worker has so much of that left, and a lease beyond those that its threads draw, it is
/// lent no more: each lending wakes it, which takes as long as a tenth of a small tile, and three
/// tiles in one message are as quickly there as one. At half the horizon a message takes what is
/// drawn in 2 ms, and a latency of one would not leave a thread dry.
const REFILL: f64 = 0.5;

/// Leases that a thread has at most, however short they are: a stranger's clock says how short.
const MOST_AHEAD: u64 = 8;

/// What a thread is lent ahead at most: in microseconds, and in leases.
#[derive(Clone, Copy)]
pub(crate) struct Ahead {
    us: f64,
    /// Of a frame that is alone.
    alone_us: f64,
    leases: u64,
}

impl Ahead {
    pub(crate) fn of(roster: &crate::state::workers::Roster) -> Ahead {
        let workers = roster.active().take(MOST_FEW + 1).count();
        let times = match workers {
            0 | 1 => SOLE,
            2..=MOST_FEW => FEW,
            _ => 1,
        };
        let us = times as f64 * HORIZON;
        let alone_us = if workers <= 1 { us } else { HORIZON_ALONE };
        Ahead { us, alone_us, leases: times * MOST_AHEAD }
    }

    /// Of how much that is left a worker of so many threads is lent no more ([`REFILL`]).
    pub(crate) fn refill(self, threads: u64) -> f64 {
        REFILL * self.us * threads as f64
    }
}

impl Frame {
    /// Lends tasks to free threads, and sends bricks.
    ///
    /// First every thread gets a task, round robin. Then tasks are lent ahead, so that a thread
    /// need not wait for a round trip between two (TRANSPORT.md: two in transfer a thread hide the
    /// latency of 64x64 tiles), but not the last ones, as many as there are threads: those go one
    /// by one to whoever runs dry, since a task that waits behind another on one worker can't be
    /// taken by an idle one. Where another frame comes after, nothing is held back.
    ///
    /// Of regions a worker gets its own, at the end of the last frame as much as [`HORIZON`] says;
    /// those of others only when it is their context, and then only threads that are dry.
    pub(crate) fn dispatch(&mut self, cluster: &mut Cluster, context: StepContext, now: Micros) {
        let by_region = self.by_region();
        let mut leases = match (by_region, context.may_steal) {
            (false, _) => self.choose(cluster, context, now),
            (true, false) => self.choose_own(cluster, context, now),
            (true, true) => self.choose_others(cluster, context, now),
        };
        let pieces = match by_region && context.may_steal && context.is_last_frame {
            true => self.find_pieces(cluster, now),
            false => {
                self.pieces_at = None;
                Vec::new()
            }
        };
        // Nobody's estimate is outlived before the time that was found last.
        let known =
            by_region && context.freed_worker.is_some() && self.outlived.is_some_and(|at| now < at);
        let may_speculate =
            (!by_region || context.may_steal) && !known && cluster.roster.any_idle_thread();
        if !known {
            self.outlived = None;
        }
        while may_speculate && let Some((place, id)) = self.next_outlived(cluster, now) {
            let slab = self.slab.as_mut().expect("as before");
            let epoch = slab.queue.lease_again(place, id, now, &cluster.config);
            let lent = lend(cluster, slab, place, id, epoch, now);
            self.lent.or_default(id).push(lent);
            leases.push((id, place));
        }
        let slab = self.slab.as_mut().expect("as before");

        let changes = cluster.roster.changes();
        let mut newcomers = Vec::new();
        if slab.changes.replace(changes) != Some(changes) {
            let staying = cluster.roster.active().map(|(id, _)| id);
            newcomers.extend(staying.filter(|id| !slab.served.contains(id)));
            let orphaning = slab.regions.as_ref().map(|r| r.orphaning(&cluster.roster));
            slab.orphaned = orphaning.is_some_and(|gone| !gone.is_empty());
        }
        for &id in &newcomers {
            slab.served.insert(id);
            if !cluster.residency.is_lazy(id) {
                cluster.residency.want(id, slab.order.iter().copied());
            }
        }
        let set = self.job.scene.bricks;
        if let Some(regions) = &slab.regions {
            // What a tile was drawn from goes with it. Parts of one were drawn from the same
            // bricks, and stand one after the other.
            let mut seen: (Vec<u32>, Vec<Option<Projected>>) = Default::default();
            for &(id, place) in leases.iter().chain(&self.gained) {
                let tile = slab.cut.tiles[place as usize].rect;
                let Some(bricks) = cluster.history.moving(regions, (place, &tile), id) else {
                    continue;
                };
                // Of a part whose whole tile was drawn then, what lies over the part; of a piece,
                // what lies behind what is drawn of it.
                let (part, job) = (regions.is_told(place), &self.job);
                let begun = slab.queue.tasks[place as usize].begun.as_ref();
                let from = begun.and_then(|begun| begun.sheets.iter().flatten().min());
                if !part {
                    cluster.residency.request(id, set, bricks.iter().copied());
                    continue;
                }
                if seen.0 != bricks {
                    let of = |&i: &u32| job.view.project(&job.bricks[i as usize].tight);
                    seen = (bricks.to_vec(), bricks.iter().map(of).collect());
                }
                let over = |p: &Projected| {
                    let behind = from.is_none_or(|from| p.sheets.end > *from);
                    behind && !p.rect.intersect(&tile).is_empty()
                };
                let bricks =
                    bricks.iter().zip(&seen.1).filter(|(_, p)| p.as_ref().is_some_and(over));
                cluster.residency.request(id, set, bricks.map(|(i, _)| *i));
            }
        }
        let gained = std::mem::take(&mut self.gained);
        let moved = leases.iter().chain(&gained).map(|l| l.0);
        let to_flush: BTreeSet<_> = newcomers.into_iter().chain(moved).collect();
        // Of regions leases go first, lest they wait behind others' bricks: a region asks for what
        // it lacks, and 64 workers that begin a frame are sent up to 19 MB.
        if !by_region {
            for &id in &to_flush {
                carry(cluster, Some(&mut self.ledger), id, now);
            }
        }
        // Each worker's leases of this round, in the order in which it got them.
        let mut count = BTreeMap::new();
        for (id, _) in &leases {
            *count.entry(*id).or_insert(0usize) += 1;
        }
        for (id, place) in leases {
            let left = count.get_mut(&id).expect("counted above");
            let lent = &self.lent[id];
            let lent = &lent[lent.len() - *left];
            *left -= 1;
            if self.told.insert(id) {
                let scene = &self.job.scene;
                let worker = cluster.roster.get_mut(id).expect("it was just lent a task");
                let plain = worker.is_local || !cluster.link_use.packs();
                if worker.scenes.insert(scene.id) {
                    cluster.send(id, ToWorker::Scene(scene.clone()));
                }
                let view = self.job.view;
                let (frame, scene) = (self.job.frame, scene.id);
                let finish = finish_of(&self.job);
                let message = ToWorker::Frame { frame, scene, view, finish, plain };
                cluster.send(id, message);
            }
            let tile = slab.cut.tiles[place as usize].rect;
            if slab.regions.is_some() {
                let worker = cluster.roster.get_mut(id).expect("it was just lent a task");
                if worker.lacks_directory(set) {
                    let (grid, bricks) = (self.job.scene.volume.lattice.dims, &self.job.bricks);
                    let message = ToWorker::Directory {
                        set,
                        grid: BrickGrid::new(grid),
                        first: 0,
                        total: bricks.len() as u32,
                        bricks: bricks.clone(),
                    };
                    cluster.send(id, message);
                }
                let (task, epoch, frame) = (lent.task, lent.epoch, self.job.frame);
                let estimate = self.job.work.estimate;
                let begun = slab.queue.tasks[place as usize].begun.clone();
                let lease = RegionLease { task, epoch, frame, tile, estimate, begun };
                cluster.send(id, ToWorker::Region(lease));
                continue;
            }
            let name = |&i: &u32| -> BrickId { self.job.bricks[i as usize].id };
            let lease = Lease {
                task: lent.task,
                epoch: lent.epoch,
                frame: self.job.frame,
                tile,
                slab: slab.sheets,
                bricks: lent.bricks.iter().map(name).collect(),
                state: self.state.tile_state(tile),
            };
            cluster.send(id, ToWorker::Lease(Box::new(lease)));
        }
        if by_region {
            for id in to_flush {
                carry(cluster, Some(&mut self.ledger), id, now);
            }
        }
        self.ask_for_pieces(cluster, pieces);
    }

    /// A waiting task for one worker goes to it.
    fn give(&mut self, cluster: &mut Cluster, place: u32, id: WorkerId, now: Micros) {
        let slab = self.slab.as_mut().expect("a slab that is dispatched has begun");
        let epoch = slab.queue.lease(place, id, now, &cluster.config);
        let lent = lend(cluster, slab, place, id, epoch, now);
        self.lent.or_default(id).push(lent);
        if let Some(regions) = &mut slab.regions {
            regions.moves(place, id);
        }
    }

    /// The first waiting task among some that a worker may have, if it suits it.
    fn next(
        &self,
        cluster: &Cluster,
        id: WorkerId,
        among: impl Fn(u32) -> bool,
        suits: impl Fn(u32) -> bool,
    ) -> Option<u32> {
        let slab = self.slab.as_ref()?;
        let lent = self.lent.get(id).into_iter().flatten();
        let mine: Vec<u32> = lent.filter_map(|l| slab.queue.place(l.task)).collect();
        slab.queue.next_for(id, &mine, among, |task| could_have(cluster, task, id), suits)
    }

    /// The same among those that are its own.
    fn next_own(&self, cluster: &Cluster, id: WorkerId, own: &[u32]) -> Option<u32> {
        let slab = self.slab.as_ref()?;
        let lent = self.lent.get(id).into_iter().flatten();
        let mine: Vec<u32> = lent.filter_map(|l| slab.queue.place(l.task)).collect();
        slab.queue.next_among(id, &mine, own, |task| could_have(cluster, task, id))
    }

    /// Lends tasks of a slab.
    fn choose(
        &mut self,
        cluster: &mut Cluster,
        context: StepContext,
        now: Micros,
    ) -> Vec<(WorkerId, u32)> {
        let ahead = u64::from(cluster.config.queue_ahead.max(1));
        let all_threads = cluster.roster.threads();
        let mut leases = Vec::new();
        let mut refused = BTreeSet::new();
        while let Some(waiting) = self.waiting() {
            let takers = || cluster.roster.active().filter(|(id, _)| !refused.contains(id));
            let dry = takers()
                .filter(|(_, w)| w.leases < u64::from(w.threads))
                .min_by_key(|(_, w)| w.leases);
            let next = dry.or_else(|| {
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
            // A worker short of memory may have any of the first few that fit.
            let tries = Cell::new(0);
            let slab = self.slab.as_ref().expect("something waits in it");
            let suits = |place| {
                if self.leases(id) == 0 || !cluster.residency.is_lazy(id) {
                    return true;
                }
                tries.set(tries.get() + 1);
                tries.get() <= 16 && cluster.residency.fits(id, &slab.bricks_of(place))
            };
            match self.next(cluster, id, |_| true, suits) {
                Some(place) => {
                    self.give(cluster, place, id, now);
                    leases.push((id, place));
                }
                None => {
                    refused.insert(id);
                }
            }
        }
        leases
    }

    /// How many tasks wait; `None`: none.
    fn waiting(&self) -> Option<u64> {
        let waiting = self.slab.as_ref().map_or(0, |slab| slab.queue.waiting());
        (waiting > 0).then_some(waiting as u64)
    }

    /// How long what a worker was lent of this frame takes it, as far as that is known: infinitely
    /// long, where it is not.
    pub(crate) fn lent_us(&self, id: WorkerId) -> f64 {
        let Some(Slab { queue, regions: Some(regions), .. }) = &self.slab else { return 0.0 };
        let lent = self.lent.get(id).into_iter().flatten();
        let places = lent.filter_map(|l| queue.place(l.task));
        places.map(|place| regions.took(place).unwrap_or(f64::INFINITY)).sum()
    }

    /// Lends each worker tasks that are its own, or whose owner is gone.
    ///
    /// A worker's leases of one event leave together, so all that it is to have ahead goes at once.
    fn choose_own(
        &mut self,
        cluster: &mut Cluster,
        context: StepContext,
        now: Micros,
    ) -> Vec<(WorkerId, u32)> {
        let ahead = u64::from(cluster.config.queue_ahead.max(1));
        let most = Ahead::of(&cluster.roster);
        let mut leases = Vec::new();
        let Some(Slab { queue, regions: Some(regions), changes, orphaned, .. }) = &self.slab else {
            return leases;
        };
        let sated = &cluster.sated;
        let room = |id: WorkerId, w: &crate::state::workers::Worker| {
            w.leases < u64::from(w.threads).saturating_mul(ahead.max(most.leases))
                && sated.binary_search(&id).is_err()
        };
        if queue.waiting() == 0 {
            return leases;
        }
        let orphaning = match context.freed_worker {
            // They have nothing to wait for: all that was theirs was lent, or waits for room.
            Some(_) if *changes == Some(cluster.roster.changes()) && !*orphaned => Vec::new(),
            _ => regions.orphaning(&cluster.roster),
        };
        let all_threads = cluster.roster.threads();
        let (mut takers, orphans): (Vec<(WorkerId, u64)>, bool) = match context.freed_worker {
            // Most of the frames in the making have nothing for it.
            Some(id) if orphaning.is_empty() && !queue.any_waiting(regions.owned(id)) => {
                (Vec::new(), false)
            }
            Some(id) if orphaning.is_empty() => {
                let worker = cluster.roster.get(id).filter(|w| w.is_active() && room(id, w));
                (worker.map(|w| (id, u64::from(w.threads))).into_iter().collect(), false)
            }
            _ => {
                let has_some = |id: WorkerId| queue.any_waiting(regions.owned(id));
                let orphans = orphaning.iter().any(|id| has_some(*id));
                let takers = cluster
                    .roster
                    .active()
                    .filter(|(id, w)| room(*id, w) && (orphans || has_some(*id)))
                    .map(|(id, w)| (id, u64::from(w.threads)))
                    .collect();
                (takers, orphans)
            }
        };
        let is_long = regions.us_a_thread(all_threads) > LONG;
        let mut left = None;
        // All threads have something before any has more.
        for first in [true, false] {
            let mut at = 0;
            while let Some(&(id, threads)) = takers.get(at) {
                at += 1;
                let mut us = self.lent_us(id);
                while let Some(waiting) = self.waiting() {
                    let load = cluster.roster.get(id).map_or(u64::MAX, |w| w.leases);
                    let many = threads.saturating_mul(ahead);
                    let ends = self.alone && context.is_last_frame && waiting <= ENDS * all_threads;
                    let us_ahead = if ends && is_long { most.alone_us } else { most.us };
                    let short = us < us_ahead * threads as f64;
                    let may = if first {
                        load < threads
                    } else if !context.is_last_frame || waiting > all_threads {
                        load < many || short && load < threads.saturating_mul(most.leases)
                    } else {
                        short && load < threads.saturating_mul(most.leases)
                    };
                    if !may {
                        break;
                    }
                    let Some(Slab { regions: Some(regions), .. }) = &self.slab else { break };
                    let next = if orphans {
                        let own = |place| {
                            let owner = regions.owner(place);
                            owner == id || orphaning.contains(&owner)
                        };
                        self.next(cluster, id, own, |_| true)
                    } else {
                        self.next_own(cluster, id, regions.owned(id))
                    };
                    let Some(place) = next else { break };
                    if self.alone && context.is_last_frame {
                        let have = self.split_late(cluster, (place, id), now, &mut left);
                        let staying = cluster.roster.active().filter(|(id, _)| have.contains(id));
                        let new = staying.filter(|(id, _)| takers.iter().all(|t| t.0 != *id));
                        let new: Vec<_> = new.map(|(id, w)| (id, u64::from(w.threads))).collect();
                        takers.extend(new);
                        if !have.is_empty() {
                            continue;
                        }
                    }
                    let Some(Slab { regions: Some(regions), .. }) = &self.slab else { break };
                    us += regions.took(place).unwrap_or(f64::INFINITY);
                    self.give(cluster, place, id, now);
                    leases.push((id, place));
                    if orphans {
                        // It may have been another's.
                        left = None;
                    }
                }
            }
        }
        leases
    }

    /// Lends threads that have nothing to do what others own.
    fn choose_others(
        &mut self,
        cluster: &mut Cluster,
        context: StepContext,
        now: Micros,
    ) -> Vec<(WorkerId, u32)> {
        let mut leases = Vec::new();
        // Owners that are heard are forborne longer, and nobody shorter: the time that was found
        // last is looked at when it has come.
        let known = context.freed_worker.is_some() && self.forborne.is_some_and(|at| now < at);
        if !known {
            self.forborne = None;
        }
        if !cluster.roster.any_idle_thread() {
            return leases;
        }
        let mut refused = BTreeSet::new();
        let mut left = None;
        while self.waiting().is_some() {
            let dry = cluster.roster.active().filter(|(id, _)| !refused.contains(id));
            let dry = dry.filter(|(id, w)| {
                w.has_idle_thread() && context.freed_worker.is_none_or(|only| only == *id)
            });
            let Some((id, _)) = dry.min_by_key(|(_, w)| w.leases) else { break };
            let Some(slab) = &self.slab else { break };
            let Some(regions) = &slab.regions else { break };
            // What workers have left to do when the others look for more.
            let left = left.get_or_insert_with(|| {
                let tasks = slab.queue.tasks.iter().zip(0..);
                let open = tasks.filter(|(t, _)| t.end == End::Open).map(|(_, place)| place);
                regions.left(open, &cluster.roster)
            });
            let suits = |place| {
                let task = &slab.queue.tasks[place as usize];
                task.was_leased()
                    || task.begun.is_some()
                    || regions.is_worth_taking(place, id, left, &cluster.history)
                    || self.until(slab, regions, place) <= now
            };
            match self.next(cluster, id, |_| true, suits) {
                Some(place) => {
                    self.give(cluster, place, id, now);
                    leases.push((id, place));
                }
                None => {
                    refused.insert(id);
                }
            }
        }
        if !known
            && !refused.is_empty()
            && let Some(slab) = &self.slab
            && let Some(regions) = &slab.regions
        {
            let waiting = slab.queue.all_waiting();
            let until = waiting.map(|place| self.until(slab, regions, place)).min();
            self.forborne = until.filter(|at| *at > now);
        }
        leases
    }

    /// Until when an owner keeps a task from those who have nothing to do.
    fn until(&self, slab: &Slab, regions: &Regions, place: u32) -> Micros {
        let (owner, us) = regions.forbearance(place);
        let heard = self.answered.get(owner).copied().unwrap_or(0).max(slab.began);
        heard.saturating_add(us)
    }

    /// A task that outlived its estimate, and a worker with a free thread for it.
    ///
    /// One slow worker holds up a slab: at a tenth of the speed, its first tile lasts as long as
    /// all the others' work. So when threads run dry, what takes more than twice the time that
    /// tasks of its workload take is run twice, and so is what waits behind it on the same worker.
    /// Its own lease stays live: whichever is first counts. The price is at most one task for each
    /// idle thread. Suspects are left out, lest they take two workers at once.
    fn next_outlived(&mut self, cluster: &Cluster, now: Micros) -> Option<(u32, WorkerId)> {
        let slab = self.slab.as_ref()?;
        let idle: Vec<(WorkerId, u64)> = cluster
            .roster
            .active()
            .filter(|(_, w)| w.leases < u64::from(w.threads))
            .map(|(id, w)| (id, w.leases))
            .collect();
        // Some of them wait for pieces.
        let pieces = slab.waits_for_pieces(now);
        if idle.len() <= pieces.len() {
            self.outlived = pieces.into_iter().min();
            return None;
        }
        let pace = self.pace.measure()?;
        let mut late: Vec<(Micros, u32)> = Vec::new();
        for (id, lent) in self.lent.iter() {
            let Some(worker) = cluster.roster.get(id) else { continue };
            let threads = worker.threads as usize;
            let answered = self.answered.get(id).copied().unwrap_or(0);
            let mut heads_late = 0;
            for (i, lent) in lent.iter().enumerate() {
                let open = |&p: &u32| slab.queue.tasks[p as usize].end == End::Open;
                let place = slab.queue.place(lent.task).filter(open);
                let at = match place {
                    _ if i >= threads => heads_late,
                    // It does dead work.
                    None => now,
                    Some(place) => {
                        let est = slab.cut.tiles[place as usize].est;
                        let at = lent.sent.max(answered).saturating_add(pace.patience(est));
                        at.max(slab.waits_for_piece(place))
                    }
                };
                heads_late = at.max(heads_late);
                if let Some(place) = place.filter(|&p| slab.queue.tasks[p as usize].may_speculate())
                {
                    late.push((at, place));
                }
            }
        }
        late.sort_unstable();
        for (at, place) in late {
            let has_it = |id: WorkerId| {
                let lent = self.lent.get(id).into_iter().flatten();
                lent.into_iter().any(|l| l.task == slab.queue.id(place))
            };
            let fits = |id: WorkerId, load: u64| {
                load == 0
                    || !cluster.residency.is_lazy(id)
                    || cluster.residency.fits(id, &slab.bricks_of(place))
            };
            let takers = idle.iter().filter(|(id, load)| !has_it(*id) && fits(*id, *load));
            let Some(&(id, _)) = takers.min_by_key(|(_, load)| *load) else { continue };
            if at > now {
                self.outlived = Some(at);
                return None;
            }
            return Some((place, id));
        }
        None
    }
}

/// Whether somebody else than this worker could draw a task.
fn could_have(cluster: &Cluster, task: &crate::state::task_queue::Task, id: WorkerId) -> bool {
    let refused_it = |id| task.failed.iter().any(|(w, ..)| *w == id);
    cluster.roster.active().any(|(other, _)| other != id && !refused_it(other))
}

/// Puts a lease on the books of workers and bricks.
fn lend(
    cluster: &mut Cluster,
    slab: &Slab,
    place: u32,
    id: WorkerId,
    epoch: Epoch,
    now: Micros,
) -> Lent {
    cluster.roster.add_lease(id);
    let bricks = slab.bricks_of(place);
    if !bricks.is_empty() {
        cluster.residency.pin(id, &bricks);
        cluster.residency.want(id, bricks.iter().copied());
    }
    Lent { task: slab.queue.id(place), epoch, sent: now, bricks }
}
