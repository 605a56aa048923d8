//! The workers: who is connected, who is silent, whose clock shows what.
//!
//! Every deadline of the crate is in the table below.
//!
//! | Deadline | Set when | After | Then |
//! |---|---|---|---|
//! | next ping | joined, pinged | 0, `heartbeat` | ping again |
//! | silence | anything heard | `silence` | the worker is lost |
//! | lease (`task_queue`) | task leased | `lease` * 2^attempt | another worker gets it too |
//! | speculation (`speculate`) | task leased | twice its estimate | an idle worker gets a copy |
//!
//! **Silence is judged on a clock that was watched.** If the driver itself did not run for a while
//! (the process was stopped, the machine slept), every worker looks silent while its messages wait
//! in a socket. So when the time between two events is longer than two heartbeats, which can't
//! happen to a driver that keeps `next_deadline`, the excess is added to everybody's account.

use crate::state::worker_map::WorkerMap;
use crate::{Config, Micros};
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

/// Limit: lanes of workers that render overlapping frames in turn.
pub(crate) const LANES: u32 = 2;

/// One worker.
#[derive(Debug)]
pub(crate) struct Worker {
    pub(crate) name: Arc<str>,
    pub(crate) threads: u32,
    /// Whether the worker runs on the master's host.
    pub(crate) is_local: bool,
    pub(crate) since: Micros,
    /// The worker drains and takes no more leases.
    pub(crate) leaving: bool,
    /// The worker is outside the active set (`policy::active_set`) and takes no leases for now.
    is_spare: bool,
    /// Scenes that were sent to it.
    pub(crate) scenes: BTreeSet<SceneId>,
    /// Leases of frames in flight that it has not answered.
    pub(crate) leases: u64,
    /// Ended frames that it is told about with the next message.
    pub(crate) over: Vec<FrameId>,
    /// Sets whose directories it keeps, the latest last.
    directories: VecDeque<BrickSetKey>,
    heard: Micros,
    next_ping: Micros,
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
        !self.leaving && !self.is_spare
    }

    /// Whether a render thread has no lease.
    pub(crate) fn has_idle_thread(&self) -> bool {
        self.leases < u64::from(self.threads)
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
            round_trip_us: 0,
            is_mostly_local: false,
        }
    }
}

impl Roster {
    pub(crate) fn join(
        &mut self,
        id: WorkerId,
        name: String,
        threads: u32,
        is_local: bool,
        now: Micros,
    ) {
        let worker = Worker {
            name: name.into(),
            threads: threads.clamp(1, MAX_THREADS),
            is_local,
            since: now,
            leaving: false,
            is_spare: false,
            scenes: BTreeSet::new(),
            leases: 0,
            over: Vec::new(),
            directories: VecDeque::new(),
            heard: now,
            next_ping: now,
            pings: VecDeque::new(),
            offset: None,
        };
        self.threads += u64::from(worker.threads);
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
        self.threads -= if worker.is_active() { u64::from(worker.threads) } else { 0 };
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
        for (i, (Reverse(threads), _, id)) in order.into_iter().enumerate() {
            let w = self.workers.get_mut(id).expect("just listed");
            let is_spare = i >= self.limit;
            if std::mem::replace(&mut w.is_spare, is_spare) != is_spare {
                let threads = u64::from(threads);
                self.threads =
                    if is_spare { self.threads - threads } else { self.threads + threads };
                self.changes += 1;
            }
        }
    }

    /// Marks a worker as leaving. Returns whether it was not before.
    pub(crate) fn leaves(&mut self, id: WorkerId) -> bool {
        let Some(w) = self.workers.get_mut(id) else { return false };
        let news = !std::mem::replace(&mut w.leaving, true);
        if news {
            self.threads -= if w.is_spare { 0 } else { u64::from(w.threads) };
            self.changes += 1;
            self.choose();
            self.survey();
        }
        news
    }

    /// Counts a lease.
    pub(crate) fn add_lease(&mut self, id: WorkerId) {
        let Some(w) = self.workers.get_mut(id) else { return };
        let before = w.has_idle_thread();
        w.leases += 1;
        self.idle -= usize::from(before && !w.has_idle_thread());
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

    /// Looks at all active workers: how far away they are.
    fn survey(&mut self) {
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
        if let Some(w) = self.workers.get_mut(id) {
            w.heard = w.heard.max(now);
        }
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
        let due = |w: &Worker| w.next_ping <= now;
        let ids: Vec<_> = self.iter().filter(|(_, w)| due(w)).map(|(id, _)| id).collect();
        let beaten = ids
            .into_iter()
            .map(|id| {
                self.workers.get_mut(id).expect("just seen").next_ping = now + config.heartbeat;
                (id, self.ping(id, now))
            })
            .collect();
        let due = |w: &Worker| w.next_ping.min(w.heard.saturating_add(config.silence));
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

    #[test]
    fn clock_offset_comes_from_the_shortest_round_trip() {
        let mut r = Roster::default();
        let w = WorkerId(1);
        r.join(w, "a".into(), 1, false, 0);
        assert_eq!(r.get(w).unwrap().to_master(5), None);
        // The worker's clock is 1,000,000 ahead. A slow, lopsided pong first.
        let n = r.ping(w, 100);
        assert!(r.pong(w, n, 1_000_000 + 100, 5100));
        assert_eq!(r.get(w).unwrap().to_master(1_010_000), Some(12_500));
        let n = r.ping(w, 6000);
        assert!(r.pong(w, n, 1_000_000 + 6050, 6100));
        assert_eq!(r.get(w).unwrap().to_master(1_010_000), Some(10_000));
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
            r.join(WorkerId(id), "a".into(), threads, false, 0);
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
            r.join(WorkerId(id), "a".into(), 1, false, 0);
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
        r.join(WorkerId(20), "large".into(), 8, false, 0);
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
        r.join(w, "a".into(), 1, false, 0);
        r.watch(900_000, &config());
        r.watch(60_000_000, &config());
        assert!(r.silent(60_000_000, &config()).is_empty());
        for t in (60_500_000..63_000_000).step_by(500_000) {
            r.watch(t, &config());
        }
        assert_eq!(r.silent(62_100_000, &config()), [w], "and yet silence is silence");
    }
}
