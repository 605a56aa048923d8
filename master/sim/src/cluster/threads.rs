//! Render threads of a virtual worker: which task they take, how long they draw, what they send.

use super::worker::{Idle, Lent, Loan, Run, Task, has};
use super::{Occurrence, SMALL_BYTES, VirtualCluster, micros};
use crate::Nanos;
use crate::cluster::incidents::Incident;
use crate::cluster::links::state_bytes;
use crate::model::{Region, TaskOutput, TileModel};
use crate::outcome::Observer;
use slabcast_common::ids::{BrickId, Epoch, TaskId, WorkerId};
use slabcast_common::message::{Pixels, RegionCost, RegionSplit, TaskTimes, TileResult};
use slabcast_common::region::{PART_EDGE, parts};
use slabcast_schedule::Event;
use std::collections::BTreeSet;

/// Time that a thread draws a region while another client waits, as in the worker's queue.
const SLICE: Nanos = 20_000_000;

impl<M: TileModel, O: Observer> VirtualCluster<M, O> {
    /// A worker has decoded a lease.
    pub(super) fn take_lease(&mut self, id: WorkerId, lent: Lent) {
        let frame = match &lent {
            Lent::Slab(lease) => lease.frame,
            Lent::Region(lease) => lease.frame,
        };
        if self.workers[&id].leaving || !self.workers[&id].frames.contains(&frame) {
            return;
        }
        let job = self.job(frame);
        let known = match lent {
            Lent::Slab(lease) => {
                self.model.slab_facts(&job, &lease).map(|facts| (facts, Task::Slab(lease)))
            }
            Lent::Region(lease) => self
                .model
                .begin_region(&job, &lease)
                .map(|(facts, region)| (facts, Task::Region(lease, region))),
        };
        let (facts, task) = match known {
            Ok(known) => known,
            Err(error) => {
                self.error.get_or_insert(error);
                return;
            }
        };
        self.order += 1;
        let loan = Loan {
            task,
            facts,
            set: job.scene.bricks,
            client: job.client,
            received: self.now_ns(),
            order: self.order,
            prefetched: false,
            ahead_sheets: 0,
            begun: false,
            stalled_since: None,
            stalls: 0,
            stalled_ns: 0,
            waits: BTreeSet::new(),
            keeps: BTreeSet::new(),
            drawn_ns: 0,
            pixels: 0,
        };
        let client = job.client;
        let w = self.workers.get_mut(&id).expect("it is there");
        w.loans.push(loan);
        let least = w.spent.values().copied().min().unwrap_or(0);
        w.spent.entry(client).or_insert(least);
        for thread in 0..w.running.len() {
            self.cut_run(id, thread, client);
        }
    }

    /// Lets a run give way to a client that waits, at the end of its slice.
    fn cut_run(&mut self, id: WorkerId, thread: usize, client: u64) {
        let now = self.now_ns();
        self.order += 1;
        let version = self.order;
        let w = self.workers.get_mut(&id).expect("it is there");
        let Some(run) = &mut w.running[thread] else { return };
        let is_region = matches!(run.loan.task, Task::Region(..));
        if run.loan.client == client || !is_region || run.gives_way.is_some() {
            return;
        }
        let until = now.max(run.followed + SLICE);
        if run.end.is_some_and(|end| end > until) {
            (run.gives_way, run.end, run.version) = (Some(until), Some(until), version);
            self.later(until, Occurrence::RunEnd { worker: id, thread, version });
        }
    }

    /// Takes the task that a thread draws next: of the client that had least
    /// time and of its oldest frame, tasks that go on before tasks
    /// that begin. A region that lacks bricks at its first sheet stalls at once, and the next one
    /// is tried.
    fn take_task(&mut self, id: WorkerId) -> Option<Loan<M::Region>> {
        let now = self.now_ns();
        self.prefetch(id);
        loop {
            let w = self.workers.get_mut(&id).expect("it is there");
            let is_ready = |l: &Loan<M::Region>| match &l.task {
                Task::Slab(lease) => {
                    let all = &self.sets[&l.set];
                    let place = |b: &BrickId| all.binary_search_by_key(b, |b| b.id).ok();
                    let present = &w.present[&l.set];
                    lease.bricks.iter().all(|b| place(b).is_some_and(|i| present[i]))
                }
                Task::Region(..) => l.waits.is_empty(),
            };
            let ready = (0..w.loans.len()).filter(|&i| is_ready(&w.loans[i]));
            let next = ready.min_by_key(|&i| {
                let l = &w.loans[i];
                (w.spent.get(&l.client), l.task.frame(), !l.begun && l.stalls == 0, l.order)
            })?;
            let mut loan = w.loans.remove(next);
            let (set, frame) = (loan.set, loan.task.frame());
            let is_first = *w.first.entry(set).or_insert(frame) == frame;
            let threads = w.profile.threads;
            loan.ahead_sheets = w.lookahead.sheets(now, threads, loan.stalls, is_first);
            if let Task::Region(_, region) = &mut loan.task {
                region.resume();
                if region.runs_ns(&has(&w.present[&set])) <= 0.0 && !region.is_done() {
                    self.stall(id, loan, false);
                    continue;
                }
            }
            if let Some(since) = loan.stalled_since.take() {
                loan.stalled_ns += now - since;
            }
            return Some(loan);
        }
    }

    /// Free threads begin tasks whose bricks are here. One of them is `awake`: it just ended
    /// another.
    pub(super) fn start_threads(&mut self, id: WorkerId, mut awake: Option<usize>) {
        let wake_ns = self.master.costs.worker.wake_ns;
        loop {
            let w = &self.workers[&id];
            let free = awake.or_else(|| w.running.iter().position(Option::is_none));
            let Some(thread) = free else { return };
            let lacking = w.loans.iter().filter_map(|l| l.stalled_since).min();
            let Some(loan) = self.take_task(id) else { return };
            let mut now = self.now_ns();
            let (task, epoch) = loan.task.key();
            let idle = self.workers[&id].idle[thread];
            let decided = self.decided.remove(&(id, task, epoch));
            if awake.take().is_none() {
                let woken = now + wake_ns as Nanos;
                now = self.machine.as_mut().map_or(woken, |m| m.run(now, wake_ns));
                self.worker_work += wake_ns as Nanos;
                let came = self.now_ns();
                self.was_idle(idle, decided, lacking, came);
                let waited = came - lacking.unwrap_or(came).clamp(idle.since, came);
                self.workers.get_mut(&id).expect("it is there").lookahead.add_idle_ns(waited);
                self.spend(came, now, |t| &mut t.round_trip);
            }
            self.start_run(id, thread, loan, now);
        }
    }

    /// A thread begins a task, or goes on with it.
    fn start_run(&mut self, id: WorkerId, thread: usize, mut loan: Loan<M::Region>, now: Nanos) {
        let frame = loan.task.frame();
        let setup = self.model.setup(&self.frames[&frame].job);
        let mut tables_ns = setup.tables_ns;
        if matches!(loan.task, Task::Region(..)) {
            tables_ns += setup.directory_ns;
        }
        let w = self.workers.get_mut(&id).expect("it is there");
        let mut stretch = w.profile.time_factor;
        let mut blocks_ns = 0;
        if !loan.begun {
            // Its threads share what they looked at.
            let opened = w.opened.entry(frame).or_default();
            let fresh = loan.facts.blocks.iter().filter(|b| opened.insert(**b)).count();
            blocks_ns = (setup.block_ns.saturating_mul(fresh as u64) as f64 * stretch) as Nanos;
        }
        // The first tile of a frame makes its tables; others wait for them.
        let made = *w.tables.entry(frame).or_insert(now + (tables_ns as f64 * stretch) as Nanos);
        let tables_ns = made.saturating_sub(now);
        blocks_ns += w.profile.run_overhead_ns;
        if w.profile.time_jitter > 0.0 {
            stretch *=
                1.0 + w.profile.time_jitter * self.rng.below(1 << 20) as f64 / (1 << 20) as f64;
        }
        let begins = !std::mem::replace(&mut loan.begun, true);
        let start = now + tables_ns + blocks_ns;
        let ns = match &mut loan.task {
            Task::Region(_, region) => region.runs_ns(&has(&w.present[&loan.set])),
            Task::Slab(_) => loan.facts.ns,
        };
        let end = start + (ns * stretch).round() as Nanos;
        let tile = loan.task.tile();
        let (corner, faults) = (Some([tile.x0, tile.y0]), w.profile.faults);
        if begins && let Some(machine) = &mut self.machine {
            let ns = self.master.costs.placeholder.ns(tile.area() as f64);
            self.worker_work += ns as Nanos;
            loan.pixels = machine.run(now, ns);
        }
        self.order += 1;
        let (version, client) = (self.order, loan.client);
        let (is_deadly, hangs) = (faults.deadly_tile == corner, faults.hanging_tile == corner);
        w.running[thread] = Some(Run {
            loan,
            start: now,
            tables_ns,
            blocks_ns,
            stretch,
            followed: start,
            stolen_ns: 0,
            gives_way: None,
            end: (!is_deadly && !hangs).then_some(end),
            version,
        });
        if is_deadly {
            let kill = Occurrence::Incident(Box::new(Incident::Kill(id)));
            self.later(now + (end - now) / 2, kill);
        } else if !hangs {
            self.later(end, Occurrence::RunEnd { worker: id, thread, version });
        }
        if let Some(other) = self.workers[&id].loans.iter().map(|l| l.client).find(|s| *s != client)
        {
            self.cut_run(id, thread, other);
        }
    }

    /// Puts the end of a run where the bricks that are here now let it go.
    pub(super) fn reschedule_run(&mut self, id: WorkerId, thread: usize) {
        self.order += 1;
        let version = self.order;
        let w = self.workers.get_mut(&id).expect("it is there");
        let Some(run) = &mut w.running[thread] else { return };
        let (Task::Region(_, region), Some(old)) = (&mut run.loan.task, run.end) else { return };
        let runs_ns = region.runs_ns(&has(&w.present[&run.loan.set]));
        let end = run.followed + (runs_ns * run.stretch).round() as Nanos;
        let end = run.gives_way.map_or(end, |until| end.min(until));
        if end != old {
            (run.end, run.version) = (Some(end), version);
            self.later(end, Occurrence::RunEnd { worker: id, thread, version });
        }
    }

    /// A run of a thread ends, unless its end was put off.
    pub(super) fn end_run(&mut self, id: WorkerId, thread: usize, version: u64) {
        let now = self.now_ns();
        let w = self.workers.get_mut(&id).expect("it is there");
        let Some(run) = w.running[thread].as_mut().filter(|r| r.version == version) else { return };
        let stolen = std::mem::take(&mut w.stolen);
        if stolen > 0 {
            run.followed += stolen;
            run.end = Some(now + stolen);
            run.stolen_ns += stolen;
            self.spend(now, now + stolen, |t| &mut t.messages);
            self.later(now + stolen, Occurrence::RunEnd { worker: id, thread, version });
            return;
        }
        let ended = self.stop(id, thread);
        self.start_threads(id, Some(thread));
        // The time to send a result is taken from what the thread draws next.
        if let Some(loan) = ended {
            self.send_result(id, thread, loan);
        }
        self.close_if_done(id);
    }

    /// A thread is at a task's end, which is returned, or where the task lacks bricks.
    fn stop(&mut self, id: WorkerId, thread: usize) -> Option<Loan<M::Region>> {
        let now = self.now_ns();
        let w = self.workers.get_mut(&id).expect("it is there");
        let mut run = w.running[thread].take().expect("a run that ends has begun");
        *w.spent.entry(run.loan.client).or_default() += now - run.start;
        let gives_way = run.gives_way.is_some_and(|until| until <= now);
        if gives_way {
            run.follow(&w.present[&run.loan.set], now);
        }
        w.idle[thread] = Idle { since: now, heard: None };
        let tables = run.start + run.tables_ns;
        let blocks = tables + run.blocks_ns;
        self.spend(run.start, tables, |t| &mut t.tables);
        self.spend(tables, blocks, |t| &mut t.blocks);
        let drawn = now - run.stolen_ns;
        self.spend(blocks, drawn, |t| &mut t.tiles);
        let mut loan = run.loan;
        loan.drawn_ns += now - run.start;
        let frame = loan.task.frame();
        self.outcome_of(frame).render += drawn - run.start;
        let w = self.workers.get_mut(&id).expect("it is there");
        if let Task::Region(lease, region) = &mut loan.task {
            if !gives_way {
                region.advance(f64::INFINITY, &has(&w.present[&loan.set]));
            } else if !region.is_done() {
                if w.frames.contains(&frame) {
                    w.loans.push(loan);
                }
                return None;
            }
            if !region.is_done() {
                if w.frames.contains(&frame) && !w.leaving {
                    self.stall(id, loan, true);
                }
                return None;
            }
            let set = loan.set;
            w.drawn.extend(parts(lease.tile).map(|p| (set, p.x0 / PART_EDGE, p.y0 / PART_EDGE)));
        }
        Some(loan)
    }

    /// Sends the result of a task.
    fn send_result(&mut self, id: WorkerId, thread: usize, loan: Loan<M::Region>) {
        let now = self.now_ns();
        let job = self.job(loan.task.frame());
        let (task, epoch) = loan.task.key();
        let w = &self.workers[&id];
        let (is_plain, faults) = (w.plain, w.profile.faults);
        let ahead_us = w.profile.clock_ahead_us;
        let clock = |ns: Nanos| micros(ns) + ahead_us;
        let times = TaskTimes {
            received_us: clock(loan.received),
            ready_us: clock(loan.received + loan.stalled_ns),
            start_us: clock(now - loan.drawn_ns),
            end_us: clock(now),
            thread: thread as u32,
        };
        let is_region = matches!(loan.task, Task::Region(..));
        let mut output = match loan.task {
            Task::Slab(lease) => self.model.draw_slab(&job, &lease),
            Task::Region(lease, region) => self.model.finish_region(&job, &lease, region),
        };
        self.lie(&mut output, &job, faults.lie_one_in);
        if faults.false_one_in > 0 && self.rng.one_in(faults.false_one_in) {
            match &mut output.pixels {
                Pixels::Sums(sums) => sums.colour[0][1] ^= 0x155,
                Pixels::Finished(tile) => tile.max_alpha += 0.25,
            }
        }
        let TaskOutput { pixels, counters, touched } = output;
        // Bytes on the wire, and how many were packed into them.
        let facts = &loan.facts;
        let (bytes, packed) = match (is_region && job.finish.is_some(), is_plain) {
            (true, true) => (facts.plain_bytes, 0),
            (true, false) => (facts.packed_bytes, facts.plain_bytes),
            (false, _) => (facts.packed_bytes, 0),
        };
        let region = is_region.then(|| RegionCost {
            touched,
            stalls: loan.stalls,
            parked_us: micros(loan.stalled_ns),
            ..RegionCost::default()
        });
        let result = Box::new(TileResult {
            task,
            epoch,
            pixels,
            counters,
            times,
            region,
            bytes: Some(bytes.min(u64::from(u32::MAX)) as u32),
        });
        let late_ns = self.machine.as_ref().map_or(0, |_| self.master.costs.late_wake_ns as Nanos);
        let when = loan.pixels.max(now + late_ns);
        if faults.fail_one_in > 0 && self.rng.one_in(faults.fail_one_in) {
            let reason = "no reason".to_string();
            self.up(id, Event::Failed { worker: id, task, epoch, reason }, SMALL_BYTES, when);
            return;
        }
        if faults.duplicate_one_in > 0 && self.rng.one_in(faults.duplicate_one_in) {
            let event = Event::Result { worker: id, result: result.clone() };
            self.up_packed(id, event, bytes, packed, when);
        }
        self.up_packed(id, Event::Result { worker: id, result }, bytes, packed, when);
    }

    /// A worker cuts what is left of a region in two and hands one piece over, as `render::region`
    /// does: by parts that it has not come to, and by sheets of the part that it is at.
    pub(super) fn hand_over(
        &mut self,
        id: WorkerId,
        key: (TaskId, Epoch),
        share: f64,
        when: Nanos,
    ) {
        let w = self.workers.get_mut(&id).expect("it is there");
        let is_it = |l: &Loan<M::Region>| l.task.key() == key;
        let thread = w.running.iter().position(|r| r.as_ref().is_some_and(|r| is_it(&r.loan)));
        let loan = match thread {
            Some(thread) => {
                let Some(run) = &mut w.running[thread] else { return };
                run.follow(&w.present[&run.loan.set], when);
                &mut run.loan
            }
            None => match w.loans.iter_mut().find(|l| is_it(l)) {
                Some(loan) => loan,
                None => return,
            },
        };
        let Task::Region(lease, region) = &mut loan.task else { return };
        // A piece that was handed over and waits is not cut again.
        if lease.begun.is_some() && thread.is_none() {
            return;
        }
        let (frame, tile) = (lease.frame, lease.tile);
        let present = &w.present[&loan.set];
        let job = self.frames[&frame].job.clone();
        let split = self.model.split(&job, region, tile, share, &has(present));
        let Some(split) = split else { return };
        lease.tile = split.kept;
        let part = |bytes: u64| bytes * split.kept.area() as u64 / tile.area() as u64;
        loan.facts.packed_bytes = part(loan.facts.packed_bytes);
        loan.facts.plain_bytes = part(loan.facts.plain_bytes);
        // It may no longer need a brick that it waits for.
        let upcoming = region.upcoming();
        loan.waits.retain(|place| upcoming.binary_search(place).is_ok());
        if let Some(thread) = thread {
            self.reschedule_run(id, thread);
        }
        let (task, epoch) = key;
        self.outcome_of(frame).handed_over += 1;
        self.handed_over += 1;
        let bytes = state_bytes(&split.begun.pixels);
        let (kept, given, begun) = (split.kept, split.given, split.begun);
        let mut piece = Box::new(RegionSplit { task, epoch, kept, given, begun });
        self.lie_about_piece(id, &mut piece);
        self.up(id, Event::HandedOver { worker: id, piece }, bytes, when);
    }
}
