//! The workers: who is connected, who is silent, whose clock shows what.
//!
//! Every deadline of the crate is in the table below.
//!
//! | Deadline | Set when | After | Then |
//! |---|---|---|---|
//! | next ping | joined, pinged | 0, `heartbeat` | ping again |
//! | ping while it has leases | anything heard, pinged | `unresponsive_after` / 4 | ping again |
//! | unresponsive_after | it has leases; anything heard | `unresponsive_after` | its tasks are lent to others too |
//! | silence | anything heard | `silence` | the worker is lost |
//! | lease (`task_queue`) | task leased | `lease` * 2^attempt | another worker gets it too |
//! | speculation (`speculate`) | task leased | twice its estimate | an idle worker gets a copy |
//! | a task's pause (`task_queue`) | workers failed at it | 0.1 s, doubled, to 2 s | it is lent again |
//! | a worker's pause (`reputation`) | it failed twice or more | 0.25 s, doubled, to 10 s | it is lent tasks again |
//!
//! **Silence is judged on a clock that was watched.** If the driver itself did not run for a while
//! (the process was stopped, the machine slept), every worker looks silent while its messages wait
//! in a socket. So when the time between two events is longer than two heartbeats, which can't
//! happen to a driver that keeps `next_deadline`, the excess is added to everybody's account.

use crate::state::reputation::Reputation;
use crate::state::worker_map::WorkerMap;
use crate::{Config, Micros, WorkerIdentity};
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{FrameId, SceneId, WorkerId};
use slabcast_common::message::DIRECTORIES_KEPT;
use slabcast_common::protocol::MAX_THREADS;
use std::cmp::Reverse;
use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;

/// Limit: drift between two machines' clocks, 100 ppm, twice what quartz is sold with. A fresh
/// sample of an offset replaces the best one when it is no less certain than the best one has
/// become.
const DRIFT: f64 = 100e-6;

/// Limit: pings without a pong while the worker lives on other messages. 1024 heartbeats are a
/// quarter of an hour; a worker that owes more will not answer the oldest.
const MAX_PINGS: usize = 1024;

/// Limit: time in microseconds after which a worker that has leases and returns no result is stuck.
/// Tiles take milliseconds. Without the limit, a worker that only answers pings would hold up every
/// frame in which it could audit a tile.
const STUCK_US: Micros = 5_000_000;

/// Limit: lanes of workers that render overlapping frames in turn.
pub(crate) const LANES: u32 = 2;

/// A worker that joins.
#[derive(Debug, Default)]
pub(crate) struct Newcomer {
    pub(crate) name: String,
    pub(crate) identity: Arc<WorkerIdentity>,
    pub(crate) reputation: Reputation,
    pub(crate) threads: u32,
    pub(crate) is_local: bool,
    pub(crate) is_trusted: bool,
}

/// One worker.
#[derive(Debug)]
pub(crate) struct Worker {
    pub(crate) name: Arc<str>,
    /// Host and name of the worker, which stay the same when it dials again.
    pub(crate) identity: Arc<WorkerIdentity>,
    pub(crate) reputation: Reputation,
    pub(crate) threads: u32,
    /// Whether the worker runs on the master's host.
    pub(crate) is_local: bool,
    /// Whether its pixels are believed without audits.
    pub(crate) is_trusted: bool,
    pub(crate) since: Micros,
    /// The worker drains and takes no more leases.
    pub(crate) leaving: bool,
    /// The worker is outside the active set (`policy::active_set`) and takes no leases for now.
    is_spare: bool,
    /// The worker takes no leases before this time, since it failed again and again.
    paused_until: Option<Micros>,
    /// Scenes that were sent to it.
    pub(crate) scenes: BTreeSet<SceneId>,
    /// Leases of frames in flight that it has not answered.
    pub(crate) leases: u64,
    /// Leases of other clients' frames than the client whose frames are dispatched now
    /// (`Scheduler::dispatch_as`).
    pub(crate) others_leases: u64,
    /// Ended frames that it is told about with the next message.
    pub(crate) over: Vec<FrameId>,
    /// Sets whose directories it keeps, the latest last.
    directories: VecDeque<BrickSetKey>,
    heard: Micros,
    next_ping: Micros,
    /// When it was pinged last, and since when it has leases.
    pinged: Micros,
    busy_since: Micros,
    /// Time at which the worker's last result arrived.
    answered: Micros,
    /// Whether the worker has had leases for [`STUCK_US`] without returning a result. Audits don't wait
    /// for a stuck worker.
    pub(crate) is_stuck: bool,
    /// Whether the worker has leases and sent nothing for `Config::unresponsive_after`. It is lent nothing
    /// then, and other workers may be lent its tasks.
    is_unresponsive: bool,
    /// Pings without a pong, oldest first: nonce and time.
    pings: VecDeque<(u64, Micros)>,
    offset: Option<Offset>,
}

/// Estimate of worker clock minus master clock.
#[derive(Clone, Copy, Debug)]
struct Offset {
    us: i64,
    /// Half the round trip: the offset's uncertainty.
    half_rtt: Micros,
    at: Micros,
}

impl Worker {
    /// Whether the worker lacks a set's directory. Notes that it is sent now.
    pub(crate) fn lacks_directory(&mut self, set: BrickSetKey) -> bool {
        if self.directories.contains(&set) {
            return false;
        }
        self.directories.push_back(set);
        if self.directories.len() > DIRECTORIES_KEPT {
            self.directories.pop_front();
        }
        true
    }

    /// Whether the worker is active: it takes leases.
    pub(crate) fn is_active(&self) -> bool {
        !self.leaving && !self.is_spare && !self.is_unresponsive && self.paused_until.is_none()
    }

    /// Returns the number of leases of the client whose frames are dispatched now.
    pub(crate) fn own_leases(&self) -> u64 {
        self.leases.saturating_sub(self.others_leases)
    }

    /// Since when it owes a sign of life, while it has leases.
    fn quiet_since(&self) -> Micros {
        self.heard.max(self.busy_since)
    }

    /// When it is pinged next.
    fn ping_due(&self, config: &Config) -> Micros {
        if self.leases == 0 || config.unresponsive_after == 0 {
            return self.next_ping;
        }
        let soon =
            self.quiet_since().max(self.pinged).saturating_add(config.unresponsive_after / 4);
        self.next_ping.min(soon)
    }

    /// When others are lent its tasks.
    fn unresponsive_due(&self, config: &Config) -> Micros {
        match self.leases == 0 || config.unresponsive_after == 0 || self.is_unresponsive {
            true => Micros::MAX,
            false => self.quiet_since().saturating_add(config.unresponsive_after),
        }
    }

    /// Whether a render thread has no lease.
    pub(crate) fn has_idle_thread(&self) -> bool {
        self.leases < u64::from(self.threads)
    }

    /// Returns the smallest round trip of the most recent pings in microseconds; `None` before the first pong.
    pub(crate) fn round_trip(&self) -> Option<Micros> {
        Some(2 * self.offset?.half_rtt)
    }

    /// Maps a time on the worker's clock to the master's; `None` before the first pong.
    pub(crate) fn to_master(&self, worker_us: u64) -> Option<Micros> {
        let o = self.offset?;
        Some((worker_us as i128 - i128::from(o.us)).clamp(0, i128::from(Micros::MAX)) as Micros)
    }
}

/// All workers.
#[derive(Debug)]
pub(crate) struct Roster {
    workers: WorkerMap<Worker>,
    next_nonce: u64,
    watched: Option<Micros>,
    /// No ping is due and no worker is silent too long before this time. Hearing a worker moves
    /// that later, which is noticed when the time comes: looking at all workers at each message
    /// would take longest of all.
    quiet_until: Micros,
    /// Render threads of active workers.
    threads: u64,
    /// Workers with an idle thread, inactive ones included.
    idle: usize,
    /// Counts changes of who is active.
    changes: u64,
    /// Most workers that are active.
    limit: usize,
    /// Workers that were heard again after others had their tasks.
    woken: Vec<WorkerId>,
    /// Longest round trip to an active worker in microseconds, by each one's best ping, and whether
    /// most active threads are on the master's host. Each event asks, and both change seldom.
    round_trip_us: Micros,
    is_mostly_local: bool,
}

impl Default for Roster {
    fn default() -> Self {
        Roster {
            workers: WorkerMap::default(),
            next_nonce: 0,
            watched: None,
            quiet_until: 0,
            threads: 0,
            idle: 0,
            changes: 0,
            limit: usize::MAX,
            woken: Vec::new(),
            round_trip_us: 0,
            is_mostly_local: false,
        }
    }
}

impl Roster {
    /// Returns an identity that no linked worker has: `wanted`, or another worker of its machine
    /// that shares its name.
    pub(crate) fn free_identity(&self, wanted: WorkerIdentity) -> Arc<WorkerIdentity> {
        let is_free = |who: &WorkerIdentity| self.workers.values().all(|w| *w.identity != *who);
        let WorkerIdentity { host, name } = &wanted;
        let namesakes =
            (2u32..).map(|n| WorkerIdentity { host: host.clone(), name: format!("{name}#{n}") });
        let found = std::iter::once(wanted.clone()).chain(namesakes).find(is_free);
        Arc::new(found.unwrap_or(wanted))
    }

    pub(crate) fn join(&mut self, id: WorkerId, newcomer: Newcomer, now: Micros) {
        let Newcomer { name, identity, reputation, threads, is_local, is_trusted } = newcomer;
        let worker = Worker {
            name: name.into(),
            identity,
            reputation,
            threads: threads.clamp(1, MAX_THREADS),
            is_local,
            is_trusted,
            since: now,
            leaving: false,
            is_spare: false,
            paused_until: None,
            scenes: BTreeSet::new(),
            leases: 0,
            others_leases: 0,
            over: Vec::new(),
            directories: VecDeque::new(),
            heard: now,
            next_ping: now,
            pinged: now,
            busy_since: now,
            answered: now,
            is_stuck: false,
            is_unresponsive: false,
            pings: VecDeque::new(),
            offset: None,
        };
        self.workers.insert(id, worker);
        self.idle += 1;
        self.changes += 1;
        self.quiet_until = self.quiet_until.min(now);
        self.choose();
        self.survey();
    }

    pub(crate) fn remove(&mut self, id: WorkerId) -> Option<Worker> {
        let worker = self.workers.remove(id)?;
        self.idle -= usize::from(worker.has_idle_thread());
        self.changes += 1;
        self.choose();
        self.survey();
        Some(worker)
    }

    /// Returns the number of workers that are not leaving.
    pub(crate) fn staying(&self) -> usize {
        self.workers.values().filter(|w| !w.leaving).count()
    }

    /// Makes `limit` workers active, and holds the others in reserve. Where all are active,
    /// newcomers are too.
    pub(crate) fn activate(&mut self, limit: usize) {
        let limit = if limit < self.staying() { limit } else { usize::MAX };
        if self.limit != limit {
            self.limit = limit;
            self.choose();
            self.survey();
        }
    }

    /// Whether a worker stays connected outside the active set.
    pub(crate) fn has_in_reserve(&self, id: WorkerId) -> bool {
        self.get(id).is_some_and(|w| !w.leaving && w.is_spare)
    }

    /// Returns the number of workers outside the active set that are not leaving.
    pub(crate) fn in_reserve(&self) -> usize {
        self.workers.values().filter(|w| !w.leaving && w.is_spare).count()
    }

    /// Chooses the active workers: those with most threads, since bricks are sent to each worker
    /// once; of equal ones every second, fourth, eighth pair, so that what was two neighbours'
    /// becomes one's.
    fn choose(&mut self) {
        if self.limit >= self.workers.len() && self.in_reserve() == 0 {
            return;
        }
        let key = |id: WorkerId, w: &Worker| (Reverse(w.threads), (id.0 / 2).reverse_bits(), id);
        let staying = self.workers.iter().filter(|(_, w)| !w.leaving);
        let mut order: Vec<_> = staying.map(|(id, w)| key(id, w)).collect();
        order.sort_unstable();
        for (i, (_, _, id)) in order.into_iter().enumerate() {
            let w = self.workers.get_mut(id).expect("just listed");
            let is_spare = i >= self.limit;
            self.changes += u64::from(std::mem::replace(&mut w.is_spare, is_spare) != is_spare);
        }
    }

    /// Marks a worker as leaving. Returns whether it was not before.
    pub(crate) fn leaves(&mut self, id: WorkerId) -> bool {
        let Some(w) = self.workers.get_mut(id) else { return false };
        let news = !std::mem::replace(&mut w.leaving, true);
        if news {
            self.changes += 1;
            self.choose();
            self.survey();
        }
        news
    }

    /// Lends a worker nothing until a time.
    pub(crate) fn pause(&mut self, id: WorkerId, until: Micros) {
        let Some(w) = self.workers.get_mut(id) else { return };
        w.paused_until = Some(until);
        self.quiet_until = self.quiet_until.min(until);
        self.changes += 1;
        self.survey();
    }

    /// Lets workers whose pause is over take leases again. Returns whether there are any.
    pub(crate) fn end_pauses(&mut self, now: Micros) -> bool {
        let is_over = |w: &&mut Worker| w.paused_until.is_some_and(|until| until <= now);
        let mut over = 0;
        for worker in self.workers.values_mut().filter(is_over) {
            worker.paused_until = None;
            over += 1;
        }
        if over > 0 {
            self.changes += over;
            self.survey();
        }
        over > 0
    }

    /// Counts a lease that is given now.
    pub(crate) fn add_lease(&mut self, id: WorkerId, now: Micros, config: &Config) {
        let Some(w) = self.workers.get_mut(id) else { return };
        let before = w.has_idle_thread();
        if w.leases == 0 {
            w.busy_since = now;
        }
        w.leases += 1;
        self.quiet_until = self.quiet_until.min(w.ping_due(config));
        self.idle -= usize::from(before && !w.has_idle_thread());
    }

    /// Records that a worker returned a result, at `now`.
    pub(crate) fn answered(&mut self, id: WorkerId, now: Micros) {
        let Some(w) = self.workers.get_mut(id) else { return };
        w.answered = now;
        w.is_stuck = false;
    }

    /// Marks workers as stuck that have had leases for [`STUCK_US`] without returning a result.
    pub(crate) fn mark_stuck(&mut self, now: Micros) {
        for (_, w) in self.workers.iter_mut().filter(|(_, w)| w.leases > 0) {
            w.is_stuck |= now >= w.busy_since.max(w.answered).saturating_add(STUCK_US);
        }
    }

    /// Counts `leases` as ended.
    pub(crate) fn end_leases(&mut self, id: WorkerId, leases: u64) {
        let Some(w) = self.workers.get_mut(id) else { return };
        let before = w.has_idle_thread();
        w.leases -= leases;
        self.idle += usize::from(!before && w.has_idle_thread());
    }

    /// Whether any worker has an idle thread, inactive ones included.
    pub(crate) fn any_idle_thread(&self) -> bool {
        self.idle > 0
    }

    /// Returns a number that changes whenever the set of active workers does.
    pub(crate) fn changes(&self) -> u64 {
        self.changes
    }

    pub(crate) fn get(&self, id: WorkerId) -> Option<&Worker> {
        self.workers.get(id)
    }

    pub(crate) fn get_mut(&mut self, id: WorkerId) -> Option<&mut Worker> {
        self.workers.get_mut(id)
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (WorkerId, &Worker)> {
        self.workers.iter()
    }

    pub(crate) fn iter_mut(&mut self) -> impl Iterator<Item = (WorkerId, &mut Worker)> {
        self.workers.iter_mut()
    }

    /// Returns the active workers, by id.
    pub(crate) fn active(&self) -> impl Iterator<Item = (WorkerId, &Worker)> {
        self.iter().filter(|(_, w)| w.is_active())
    }

    /// Returns the active workers of a lane with their threads, by id; `None`: all active workers.
    pub(crate) fn lane(&self, lane: Option<u32>) -> impl Iterator<Item = (WorkerId, u64)> {
        let threads = self.active().map(|(id, w)| (id, u64::from(w.threads)));
        threads.filter(move |(id, _)| {
            lane.is_none_or(|lane| id.0 % u64::from(LANES) == u64::from(lane))
        })
    }

    /// Looks at all active workers: their threads, and how far away they are.
    fn survey(&mut self) {
        self.threads = self.active().map(|(_, w)| u64::from(w.threads)).sum();
        let half = self.active().filter_map(|(_, w)| Some(w.offset?.half_rtt)).max();
        let local = self.active().filter(|(_, w)| w.is_local).map(|(_, w)| u64::from(w.threads));
        self.is_mostly_local = 2 * local.sum::<u64>() > self.threads;
        self.round_trip_us = 2 * half.unwrap_or(0);
    }

    /// Whether most active threads are on the master's host.
    pub(crate) fn is_mostly_local(&self) -> bool {
        self.is_mostly_local
    }

    /// Returns the longest round trip to an active worker in microseconds, by each one's best ping;
    /// 0 before any pong.
    pub(crate) fn round_trip_us(&self) -> f64 {
        self.round_trip_us as f64
    }

    /// Returns the number of render threads of active workers.
    pub(crate) fn threads(&self) -> u64 {
        self.threads
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.workers.is_empty()
    }

    /// Notes that something was heard from a worker.
    pub(crate) fn heard(&mut self, id: WorkerId, now: Micros) {
        let Some(w) = self.workers.get_mut(id) else { return };
        w.heard = w.heard.max(now);
        if std::mem::take(&mut w.is_unresponsive) {
            self.woken.push(id);
            self.changes += 1;
            self.survey();
        }
    }

    /// Takes the workers that were heard again since the last call, after others had their tasks.
    pub(crate) fn take_woken(&mut self) -> Vec<WorkerId> {
        std::mem::take(&mut self.woken)
    }

    /// Returns the workers with leases that were silent for so long that others get their tasks
    /// too, each once.
    pub(crate) fn mark_unresponsive(&mut self, now: Micros, config: &Config) -> Vec<WorkerId> {
        if now < self.quiet_until {
            return Vec::new();
        }
        let mut unresponsive = Vec::new();
        for (id, w) in self.workers.iter_mut().filter(|(_, w)| w.unresponsive_due(config) <= now) {
            w.is_unresponsive = true;
            unresponsive.push(id);
        }
        if !unresponsive.is_empty() {
            self.changes += 1;
            self.survey();
        }
        unresponsive
    }

    /// Notes the time; see the head of this file.
    pub(crate) fn watch(&mut self, now: Micros, config: &Config) {
        if let Some(before) = self.watched {
            let gap = now.saturating_sub(before);
            if gap > 2 * config.heartbeat {
                for w in self.workers.values_mut() {
                    w.heard += gap;
                }
            }
        }
        self.watched = Some(now);
    }

    /// Returns the workers that were silent for too long.
    pub(crate) fn silent(&self, now: Micros, config: &Config) -> Vec<WorkerId> {
        if now < self.quiet_until {
            return Vec::new();
        }
        let late = |w: &Worker| now >= w.heard.saturating_add(config.silence);
        self.iter().filter(|(_, w)| late(w)).map(|(id, _)| id).collect()
    }

    /// Returns the nonce of a ping that is sent to a worker now.
    pub(crate) fn ping(&mut self, id: WorkerId, now: Micros) -> u64 {
        self.next_nonce += 1;
        if let Some(w) = self.workers.get_mut(id) {
            w.pings.push_back((self.next_nonce, now));
            if w.pings.len() > MAX_PINGS {
                w.pings.pop_front();
            }
        }
        self.next_nonce
    }

    /// Returns the pings that are due: worker and nonce.
    pub(crate) fn beat(&mut self, now: Micros, config: &Config) -> Vec<(WorkerId, u64)> {
        if now < self.quiet_until {
            return Vec::new();
        }
        let due = |w: &Worker| w.ping_due(config) <= now;
        let ids: Vec<_> = self.iter().filter(|(_, w)| due(w)).map(|(id, _)| id).collect();
        let beaten = ids
            .into_iter()
            .map(|id| {
                let w = self.workers.get_mut(id).expect("just seen");
                (w.next_ping, w.pinged) = (now + config.heartbeat, now);
                (id, self.ping(id, now))
            })
            .collect();
        let due = |w: &Worker| {
            let due = w.ping_due(config).min(w.heard.saturating_add(config.silence));
            due.min(w.unresponsive_due(config)).min(w.paused_until.unwrap_or(Micros::MAX))
        };
        self.quiet_until = self.workers.values().map(due).min().unwrap_or(0);
        beaten
    }

    /// Takes a pong. Returns whether its ping was ours and not answered before.
    pub(crate) fn pong(&mut self, id: WorkerId, nonce: u64, clock_us: u64, now: Micros) -> bool {
        let Some(w) = self.workers.get_mut(id) else { return false };
        let Some(i) = w.pings.iter().position(|p| p.0 == nonce) else { return false };
        let sent = w.pings[i].1;
        w.pings.drain(..=i);
        let half_rtt = now.saturating_sub(sent) / 2;
        let middle = i128::from(sent) + i128::from(half_rtt);
        let us = (i128::from(clock_us) - middle).clamp(i64::MIN.into(), i64::MAX.into()) as i64;
        let better = w.offset.is_none_or(|best| {
            half_rtt as f64 <= best.half_rtt as f64 + DRIFT * now.saturating_sub(best.at) as f64
        });
        if better {
            w.offset = Some(Offset { us, half_rtt, at: now });
            self.survey();
        }
        true
    }

    /// Returns the next ping or silence, or an earlier time at which to look for them.
    pub(crate) fn next_deadline(&self) -> Option<Micros> {
        (!self.workers.is_empty()).then_some(self.quiet_until)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> Config {
        Config::default()
    }

    fn newcomer(name: &str, threads: u32) -> Newcomer {
        Newcomer { name: name.into(), threads, ..Newcomer::default() }
    }

    #[test]
    fn clock_offset_comes_from_the_shortest_round_trip() {
        let mut r = Roster::default();
        let w = WorkerId(1);
        r.join(w, newcomer("a", 1), 0);
        assert_eq!(r.get(w).unwrap().to_master(5), None);
        assert_eq!(r.get(w).unwrap().round_trip(), None);
        // The worker's clock is 1,000,000 ahead. A slow, lopsided pong first.
        let n = r.ping(w, 100);
        assert!(r.pong(w, n, 1_000_000 + 100, 5100));
        assert_eq!(r.get(w).unwrap().to_master(1_010_000), Some(12_500));
        let n = r.ping(w, 6000);
        assert!(r.pong(w, n, 1_000_000 + 6050, 6100));
        assert_eq!(r.get(w).unwrap().to_master(1_010_000), Some(10_000));
        assert_eq!(r.get(w).unwrap().round_trip(), Some(100));
        let n = r.ping(w, 7000);
        assert!(r.pong(w, n, 1_000_000 + 7000, 9000));
        assert_eq!(r.get(w).unwrap().to_master(1_010_000), Some(10_000));
        assert!(!r.pong(w, n, 0, 9001), "answered twice");
    }

    #[test]
    fn threads_are_those_of_active_workers() {
        let mut r = Roster::default();
        let counted = |r: &Roster| r.active().map(|(_, w)| u64::from(w.threads)).sum::<u64>();
        for (id, threads) in [(1, 3), (2, 0), (3, u32::MAX)] {
            r.join(WorkerId(id), newcomer("a", threads), 0);
        }
        assert_eq!((r.threads(), counted(&r)), (4 + u64::from(MAX_THREADS), r.threads()));
        assert!(r.leaves(WorkerId(3)) && !r.leaves(WorkerId(3)) && !r.leaves(WorkerId(9)));
        assert_eq!((r.threads(), counted(&r)), (4, 4));
        r.remove(WorkerId(3));
        r.remove(WorkerId(1));
        assert!(r.remove(WorkerId(1)).is_none());
        assert_eq!((r.threads(), counted(&r)), (1, 1));
    }

    #[test]
    fn active_set_prefers_large_workers_then_every_second_pair() {
        let mut r = Roster::default();
        for id in 0..16 {
            r.join(WorkerId(id), newcomer("a", 1), 0);
        }
        let drawing = |r: &Roster| r.active().map(|(id, _)| id.0).collect::<Vec<_>>();
        let before = r.changes();
        r.activate(8);
        assert_eq!(drawing(&r), [0, 1, 4, 5, 8, 9, 12, 13]);
        assert_eq!((r.threads(), r.in_reserve()), (8, 8));
        assert_ne!(r.changes(), before);
        assert!(r.has_in_reserve(WorkerId(2)) && !r.has_in_reserve(WorkerId(1)));
        // Somebody is lost, and somebody leaves: others take their places at once.
        r.remove(WorkerId(0));
        r.leaves(WorkerId(4));
        assert_eq!(drawing(&r).len(), 8);
        assert!(!r.has_in_reserve(WorkerId(4)), "who leaves is nobody's reserve");
        r.join(WorkerId(20), newcomer("large", 8), 0);
        assert!(drawing(&r).contains(&20), "it has the most threads: {:?}", drawing(&r));
        let counted = r.active().map(|(_, w)| u64::from(w.threads)).sum::<u64>();
        assert_eq!(r.threads(), counted);
        r.activate(usize::MAX);
        assert_eq!((drawing(&r).len(), r.in_reserve()), (15, 0));
        assert_eq!(r.threads(), 14 + 8);
    }

    #[test]
    fn silence_is_not_blamed_on_workers_after_the_master_slept() {
        let mut r = Roster::default();
        let w = WorkerId(1);
        r.watch(0, &config());
        r.join(w, newcomer("a", 1), 0);
        r.watch(900_000, &config());
        r.watch(60_000_000, &config());
        assert!(r.silent(60_000_000, &config()).is_empty());
        for t in (60_500_000..63_000_000).step_by(500_000) {
            r.watch(t, &config());
        }
        assert_eq!(r.silent(62_100_000, &config()), [w], "and yet silence is silence");
    }
}
