//! Bricks of a virtual worker: arriving, prefetching, stalling for them, making room.
//!
//! The rules are those of the real worker (`slabcast-worker`, `stalls`): a stalled region asks for
//! what it lacks and waits for all of it, each brick is asked for once, and a worker that was sent
//! a directory keeps its own memory budget.

use super::worker::{Loan, Run, Task, has};
use super::{SMALL_BYTES, VirtualCluster};
use crate::model::{Region, TileModel};
use crate::outcome::Observer;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{BrickId, WorkerId};
use slabcast_common::region::{PART_EDGE, parts};
use slabcast_schedule::Event;
use std::collections::{BTreeMap, BTreeSet};

impl<M: TileModel, O: Observer> VirtualCluster<M, O> {
    /// Bricks arrived intact.
    pub(super) fn gain_bricks(&mut self, id: WorkerId, set: BrickSetKey, bricks: &[BrickId]) {
        let Some(infos) = self.sets.get(&set).cloned() else { return };
        self.follow_runs(id, set);
        let w = self.workers.get_mut(&id).expect("it is there");
        for &brick in bricks {
            let place = w.hold(set, &infos, brick);
            let seed = self.seed;
            let place = place.unwrap_or_else(|| panic!("seed {seed}: {brick} comes to {id} again"));
            if let Some(bytes) = w.asked.remove(&(set, place)) {
                w.asked_bytes -= bytes;
            }
            for loan in w.loans.iter_mut().filter(|l| l.set == set) {
                loan.waits.remove(&place);
            }
        }
        self.observer.bricks_held(id, w.held_bytes);
        self.reschedule_runs(id);
    }

    /// The master has bricks dropped.
    pub(super) fn drop_bricks(&mut self, id: WorkerId, set: BrickSetKey, bricks: &[BrickId]) {
        let Some(infos) = self.sets.get(&set).cloned() else { return };
        self.follow_runs(id, set);
        let w = self.workers.get_mut(&id).expect("it is there");
        for brick in bricks {
            let Ok(place) = infos.binary_search_by_key(brick, |b| b.id) else { continue };
            let here = &mut w.present.get_mut(&set).expect("a set of a job")[place];
            if std::mem::take(here) {
                w.held_bytes -= u64::from(infos[place].bytes);
            } else {
                // It may have evicted or lost it while the message came.
                let excused = w.profile.faults.broken_one_in > 0 || w.has_directory;
                assert!(excused, "seed {}: {id} is to drop {brick}, which it lacks", self.seed);
            }
        }
        self.reschedule_runs(id);
    }

    /// Follows running regions of a set up to now, before the bricks that are here change.
    fn follow_runs(&mut self, id: WorkerId, set: BrickSetKey) {
        let now = self.now_ns();
        let w = self.workers.get_mut(&id).expect("it is there");
        let present = &w.present[&set];
        let of_set = |r: &&mut Run<M::Region>| r.loan.set == set;
        w.running.iter_mut().flatten().filter(of_set).for_each(|r| r.follow(present, now));
    }

    pub(super) fn reschedule_runs(&mut self, id: WorkerId) {
        for thread in 0..self.workers[&id].running.len() {
            self.reschedule_run(id, thread);
        }
    }

    /// Prefetches the bricks of regions that nobody has begun, as far as the frame before tells: of
    /// parts of the picture that this worker drew.
    pub(super) fn prefetch(&mut self, id: WorkerId) {
        let w = self.workers.get_mut(&id).expect("it is there");
        let mut wishes: BTreeMap<BrickSetKey, Vec<BrickId>> = BTreeMap::new();
        for loan in w.loans.iter_mut().filter(|l| !l.prefetched) {
            loan.prefetched = true;
            let (Task::Region(lease, _), set) = (&loan.task, loan.set) else { continue };
            if !parts(lease.tile)
                .all(|p| w.drawn.contains(&(set, p.x0 / PART_EDGE, p.y0 / PART_EDGE)))
            {
                continue;
            }
            let infos = &self.sets[&set];
            let present = &w.present[&set];
            for &place in &loan.facts.prefetch {
                let Some(info) = infos.get(place as usize) else { continue };
                let bytes = u64::from(info.bytes);
                if w.held_bytes + w.asked_bytes + bytes > w.profile.memory_budget_bytes {
                    break;
                }
                if !has(present)(place) && !w.asked.contains_key(&(set, place)) {
                    w.asked.insert((set, place), bytes);
                    w.asked_bytes += bytes;
                    wishes.entry(set).or_default().push(info.id);
                }
            }
        }
        wishes.into_iter().for_each(|(set, bricks)| self.want(id, set, bricks));
    }

    /// Asks the master for bricks, if there are any to ask for.
    fn want(&mut self, id: WorkerId, set: BrickSetKey, bricks: Vec<BrickId>) {
        if !bricks.is_empty() {
            self.bricks_wanted += bricks.len() as u64;
            let bytes = SMALL_BYTES + 2 * bricks.len() as u64;
            self.up(id, Event::BricksWanted { worker: id, set, bricks }, bytes, self.now_ns());
        }
    }

    /// A region stalls: the worker makes room, asks for what the region lacks and sets it aside.
    pub(super) fn stall(&mut self, id: WorkerId, mut loan: Loan<M::Region>, farther: bool) {
        let (now, set) = (self.now_ns(), loan.set);
        let infos = self.sets[&set].clone();
        let w = self.workers.get_mut(&id).expect("it is there");
        let missing = match &mut loan.task {
            Task::Region(_, region) => region.missing(&has(&w.present[&set]), loan.ahead_sheets),
            Task::Slab(_) => Vec::new(),
        };
        if farther {
            loan.keeps.clear();
        }
        loan.keeps.extend(missing.iter().copied());
        let mut fresh = Vec::new();
        for &place in &missing {
            let info = &infos[place as usize];
            let bytes = u64::from(info.bytes);
            if w.asked.insert((set, place), bytes).is_none() {
                w.asked_bytes += bytes;
                fresh.push(info.id);
            }
        }
        loan.stalls += 1;
        loan.stalled_since = loan.stalled_since.or(Some(now));
        loan.waits.extend(missing);
        self.order += 1;
        loan.order = self.order;
        w.loans.push(loan);
        self.make_room(id);
        self.want(id, set, fresh);
    }

    /// Evicts bricks until those that are here and those that were asked for fit into the budget,
    /// as far as no region keeps them. Does nothing without regions: the master then keeps the
    /// budget.
    pub(super) fn make_room(&mut self, id: WorkerId) {
        let w = self.workers.get_mut(&id).expect("it is there");
        if !w.loans.iter().any(|l| matches!(l.task, Task::Region(..))) {
            return;
        }
        let budget = w.profile.memory_budget_bytes;
        if w.held_bytes + w.asked_bytes <= budget {
            return;
        }
        let running = w.running.iter().flatten().map(|r| &r.loan);
        let kept: BTreeSet<(BrickSetKey, u32)> = running
            .chain(&w.loans)
            .flat_map(|l| l.keeps.iter().map(|&place| (l.set, place)))
            .collect();
        let mut evicted: BTreeMap<BrickSetKey, Vec<BrickId>> = BTreeMap::new();
        for (set, present) in &mut w.present {
            let infos = &self.sets[set];
            for (place, here) in present.iter_mut().enumerate() {
                if w.held_bytes + w.asked_bytes <= budget {
                    break;
                }
                if *here && !kept.contains(&(*set, place as u32)) {
                    *here = false;
                    w.held_bytes -= u64::from(infos[place].bytes);
                    evicted.entry(*set).or_default().push(infos[place].id);
                }
            }
        }
        let now = self.now_ns();
        for (set, bricks) in evicted {
            let bytes = SMALL_BYTES + 2 * bricks.len() as u64;
            self.up(id, Event::BricksForgotten { worker: id, set, bricks }, bytes, now);
        }
    }
}
