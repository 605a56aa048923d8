//! Fair shares of render threads. Clients get equal thread time, and live clients, whose pictures a person
//! waits for, come before clients with jobs. Pure: callers pass times in.
//!
//! Clients are of two classes, by their number ([`is_live`]). While both have tiles that wait, live
//! ones get [`LIVE_PARTS`] of [`ALL_PARTS`] of the thread time, and jobs the rest: a live frame waits for
//! no job, and a job ends even while a picture is turned all the time. A class alone gets all. Within a class
//! the client with the least time comes first.

use slabcast_common::message::is_live;
use std::collections::BTreeMap;
use std::time::Duration;

/// Tuning (us): time slice: a region draws for so long before it gives way to a client that waits. At 5 ms a region of a
/// frame of 1024x1024 takes 3 % longer beside another; at 100 ms a frame of 16 tiles takes 1.6 s
/// beside one whose tiles take minutes.
pub(super) const SLICE: Duration = Duration::from_millis(20);

/// Tuning (parts of thread time): live clients' parts of all, while jobs have tiles too. With 3 of 4 a
/// picture that takes 16 ms alone takes 21 ms beside a job; with 19 of 20 a job takes 20 times as long.
const LIVE_PARTS: u32 = 9;
const ALL_PARTS: u32 = 10;

/// Tuning (us): thread time by which live clients may be ahead of their parts: a frame or two, so that no
/// slice of a job lies between the tiles of one frame. With none, each frame waits for one.
const AHEAD: Duration = Duration::from_millis(100);

/// Limit: clients without tasks whose time is remembered.
const CLIENTS_KEPT: usize = 64;

/// Thread time of one client.
#[derive(Clone, Copy, Debug, Default)]
struct Share {
    spent: Duration,
    /// Number of threads that draw a task of the client.
    running: u32,
    /// Number of its tasks that wait.
    waiting: usize,
}

impl Share {
    fn is_here(&self) -> bool {
        self.running > 0 || self.waiting > 0
    }

    /// Returns the client's thread time, with one slice for each thread that draws a task of it now.
    fn charged(&self) -> Duration {
        self.spent + SLICE * self.running
    }
}

/// See the head of the file.
#[derive(Debug, Default)]
pub(super) struct Shares {
    /// Clients by number. A new client starts with the least time of all others of its class: it is
    /// served at once, and can't claim the time before it came.
    clients: BTreeMap<u64, Share>,
    /// Thread time of jobs and of live clients since both have tasks, in units of equal worth.
    worth: [Duration; 2],
}

impl Shares {
    /// Returns the worth of a class, with a slice for each thread that draws for it now.
    fn charged_worth(&self, live: bool) -> Duration {
        let running = self.class(live).map(|(_, share)| share.running).sum();
        self.worth[usize::from(live)] + worth_of(live, SLICE * running)
    }

    fn class(&self, live: bool) -> impl Iterator<Item = (u64, Share)> {
        let of = self.clients.iter().filter(move |(client, _)| is_live(**client) == live);
        of.map(|(client, share)| (*client, *share))
    }

    /// Whether a class has tasks that wait.
    fn waits(&self, live: bool) -> bool {
        self.class(live).any(|(_, share)| share.waiting > 0)
    }

    /// Whether live clients come next, where both classes have tasks that wait.
    fn live_is_next(&self) -> bool {
        self.charged_worth(true) <= self.charged_worth(false) + worth_of(true, AHEAD)
    }

    /// Enters a task of a client.
    pub(super) fn push(&mut self, client: u64) {
        if !self.clients.get(&client).is_some_and(Share::is_here) {
            self.enter(client);
        }
        self.clients.entry(client).or_default().waiting += 1;
    }

    /// Enters a client that is about to get tasks.
    fn enter(&mut self, client: u64) {
        let live = is_live(client);
        let has_class = self.class(live).any(|(_, share)| share.is_here());
        if !has_class {
            let others_are_here = self.class(!live).any(|(_, share)| share.is_here());
            let others = self.worth[usize::from(!live)];
            let own = &mut self.worth[usize::from(live)];
            // It is served at once, and can't claim the time before it came.
            *own = if others_are_here { (*own).max(others) } else { Duration::ZERO };
            if !others_are_here {
                self.worth[usize::from(!live)] = Duration::ZERO;
            }
        }
        let here = self.class(live).filter(|(other, share)| *other != client && share.is_here());
        let Some(least) = here.map(|(_, share)| share.charged()).min() else {
            // No other client of its class has tasks, so the time of all starts at zero.
            self.clients.retain(|other, _| is_live(*other) != live);
            self.clients.insert(client, Share::default());
            return;
        };
        self.clients.retain(|other, share| {
            is_live(*other) != live || *other == client || share.is_here() || share.spent > least
        });
        if self.clients.len() >= CLIENTS_KEPT {
            self.clients.retain(|other, share| *other == client || share.is_here());
        }
        let entry = self.clients.entry(client).or_default();
        entry.spent = entry.spent.max(least);
    }

    /// Takes a task: returns its client, and counts a thread for it. `key` decides between equals.
    pub(super) fn take<K: Ord>(&mut self, key: impl Fn(u64) -> K) -> Option<u64> {
        let live = match (self.waits(true), self.waits(false)) {
            (true, true) => self.live_is_next(),
            (live, _) => live,
        };
        let waiting = self.class(live).filter(|(_, share)| share.waiting > 0);
        let (client, _) = waiting.min_by_key(|(client, share)| (share.charged(), key(*client)))?;
        let share = self.clients.get_mut(&client)?;
        share.waiting -= 1;
        share.running += 1;
        Some(client)
    }

    /// Charges a client with `time` of a thread.
    pub(super) fn charge(&mut self, client: u64, time: Duration) {
        if let Some(share) = self.clients.get_mut(&client) {
            share.spent += time;
            let live = is_live(client);
            self.worth[usize::from(live)] += worth_of(live, time);
        }
    }

    /// Whether a region of a client that was charged up to now has to give way to another client.
    pub(super) fn must_yield(&self, client: u64) -> bool {
        let live = is_live(client);
        let Some(own) = self.clients.get(&client) else { return false };
        if self.waits(!live) {
            // Its own slice that runs is no reason to give way.
            let worth = self.worth[usize::from(live)];
            let ahead = worth_of(true, AHEAD);
            let other = self.charged_worth(!live);
            if if live { worth > other + ahead } else { other <= worth + ahead } {
                return true;
            }
        }
        let others = self.class(live).filter(|(other, _)| *other != client);
        let mut waiting = others.filter(|(_, share)| share.waiting > 0);
        waiting.any(|(_, share)| share.charged() < own.spent)
    }

    /// Whether a region of a job has to give way to a live client at once.
    pub(super) fn live_is_due(&self) -> bool {
        self.waits(true) && self.worth[1] <= self.worth[0] + worth_of(true, AHEAD)
    }

    /// Notes that a thread ended or paused a task of a client.
    pub(super) fn ended(&mut self, client: u64) {
        if let Some(share) = self.clients.get_mut(&client) {
            share.running = share.running.saturating_sub(1);
        }
    }

    /// Forgets all.
    pub(super) fn clear(&mut self) {
        *self = Shares::default();
    }
}

/// Returns thread time in units of equal worth: a class's time over its parts.
fn worth_of(live: bool, time: Duration) -> Duration {
    time / if live { LIVE_PARTS } else { ALL_PARTS - LIVE_PARTS }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::message::LIVE_CLIENT;

    const MS: Duration = Duration::from_millis(1);

    /// Runs one thread for `total`, in which each client of `always` always has tasks of 5 ms, and
    /// returns the time of each.
    fn run(always: &[u64], total: Duration) -> Vec<Duration> {
        let mut shares = Shares::default();
        always.iter().for_each(|client| shares.push(*client));
        let mut spent = vec![Duration::ZERO; always.len()];
        let mut now = Duration::ZERO;
        while now < total {
            let client = shares.take(|client| client).expect("a task waits");
            shares.push(client);
            shares.charge(client, 5 * MS);
            shares.ended(client);
            now += 5 * MS;
            let i = always.iter().position(|c| *c == client).expect("one of them");
            spent[i] += 5 * MS;
        }
        spent
    }

    fn part(time: Duration, of: Duration) -> f64 {
        time.as_secs_f64() / of.as_secs_f64()
    }

    #[test]
    fn jobs_keep_a_tenth_however_many_watch_and_sessions_share_the_rest_evenly() {
        let total = 10_000 * MS;
        let live = [LIVE_CLIENT | 1, LIVE_CLIENT | 2, LIVE_CLIENT | 3];
        let spent = run(&[1, live[0], live[1], live[2]], total);
        assert!((part(spent[0], total) - 0.1).abs() < 0.01, "{spent:?}");
        for session in &spent[1..] {
            assert!((part(*session, total) - 0.3).abs() < 0.01, "{spent:?}");
        }
        let spent = run(&[1, 2, 3, live[0]], total);
        assert!((part(spent[3], total) - 0.9).abs() < 0.01, "{spent:?}");
        assert!((part(spent[0], total) - 0.1 / 3.0).abs() < 0.01, "{spent:?}");
    }

    #[test]
    fn class_alone_gets_all_and_jobs_share_evenly_as_before() {
        let total = 1000 * MS;
        assert_eq!(run(&[7], total), [total]);
        let spent = run(&[1, 2], total);
        assert_eq!(spent, [total / 2, total / 2]);
    }

    #[test]
    fn live_frame_is_drawn_at_once_after_any_time_of_a_job() {
        let mut shares = Shares::default();
        let live = LIVE_CLIENT | 5;
        shares.push(1);
        assert_eq!(shares.take(|c| c), Some(1));
        shares.push(1);
        shares.charge(1, 60_000 * MS);
        assert!(!shares.must_yield(1) && !shares.live_is_due());
        shares.push(live);
        assert!(shares.live_is_due() && shares.must_yield(1));
        shares.ended(1);
        shares.push(1);
        // A frame of six tiles on one thread; the job's tile waits for all of them.
        for _ in 0..5 {
            assert_eq!(shares.take(|c| c), Some(live));
            shares.push(live);
            shares.charge(live, 3 * MS);
            assert!(!shares.must_yield(live));
            shares.ended(live);
        }
    }

    #[test]
    fn live_frames_with_pauses_leave_a_tenth_to_jobs() {
        // Ten seconds of one thread; a session asks for 30 ms of work each 33 ms.
        let mut shares = Shares::default();
        let live = LIVE_CLIENT | 5;
        shares.push(1);
        let (mut now, mut due, mut left, mut of_job) = (0u32, 0u32, 0u32, 0u32);
        while now < 10_000 {
            if left == 0 && now >= due {
                (left, due) = (10, now + 33);
                shares.push(live);
            }
            let client = shares.take(|c| c).expect("the job waits");
            if client == live {
                left -= 1;
                if left > 0 {
                    shares.push(live);
                }
            } else {
                shares.push(1);
                of_job += 3;
            }
            shares.charge(client, 3 * MS);
            shares.ended(client);
            now += 3;
        }
        assert!((900..1500).contains(&of_job), "{of_job} ms of 10 s");
    }

    #[test]
    fn live_client_can_not_claim_the_time_before_it_came() {
        let mut shares = Shares::default();
        shares.push(1);
        shares.take(|c| c);
        shares.charge(1, 60_000 * MS);
        shares.ended(1);
        shares.push(1);
        let live = LIVE_CLIENT | 5;
        shares.push(live);
        let mut live_ms = Duration::ZERO;
        for _ in 0..400 {
            let client = shares.take(|c| c).expect("both wait");
            shares.push(client);
            shares.charge(client, 5 * MS);
            shares.ended(client);
            live_ms += if client == live { 5 * MS } else { Duration::ZERO };
        }
        assert!(part(live_ms, 2000 * MS) < 0.92, "{live_ms:?} of 2 s");
    }
}
