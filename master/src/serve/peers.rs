//! Caps of jobs, watchers and connections by client address, and log lines of clients that reach them.
//!
//! Until jobs have owners an address is all that is known of a client. So one address may have a
//! share of each thing that runs out, and the others find the rest free. Clients behind one address
//! (a gateway, or all programs of this machine) share its share: hence shares are half of all, and
//! can be set.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::time::Instant;
use tracing::warn;

/// Caps of jobs, watchers and connections of one client address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerLimits {
    /// Jobs in progress, of 200.
    pub jobs: usize,
    /// Watchers, of 256.
    pub watchers: usize,
    /// Connections, of 4096. A worker takes two.
    pub connections: usize,
    /// Time for a whole request, and for a new connection to have sent one.
    pub patience: Duration,
}

impl Default for PeerLimits {
    /// Half of all jobs and watchers, a quarter of all connections: 512 workers behind one address.
    /// 10 s for a request: one of 4 MiB takes 0.4 s over 100 Mbit/s.
    fn default() -> Self {
        PeerLimits {
            jobs: 100,
            watchers: 128,
            connections: 1024,
            patience: Duration::from_secs(10),
        }
    }
}

/// Shortest time between two lines of one kind in the log: what a stranger does a thousand times a
/// second must not fill a disk.
const LINE_EVERY: Duration = Duration::from_secs(1);

/// Returns the address that limits count by: IPv4 addresses as such, of IPv6 the network of 64 bits
/// that a site gives to one machine.
pub fn counted_as(ip: IpAddr) -> IpAddr {
    match ip.to_canonical() {
        IpAddr::V6(v6) if !v6.is_loopback() => {
            IpAddr::V6(Ipv6Addr::from_bits(v6.to_bits() & !u128::from(u64::MAX)))
        }
        ip => ip,
    }
}

/// How much of something each address has.
#[derive(Default)]
pub(super) struct Counts(Mutex<BTreeMap<IpAddr, usize>>);

impl Counts {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<IpAddr, usize>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes one for an address, unless it has `most`. It is given back when the place is dropped.
    pub(super) fn take(self: &Arc<Self>, ip: IpAddr, most: usize) -> Option<Place> {
        let ip = counted_as(ip);
        let mut counts = self.lock();
        let count = counts.entry(ip).or_insert(0);
        if *count >= most {
            return None;
        }
        *count += 1;
        Some(Place { counts: self.clone(), ip })
    }
}

/// One of what an address has.
pub(super) struct Place {
    counts: Arc<Counts>,
    ip: IpAddr,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut counts = self.counts.lock();
        if let Some(count) = counts.get_mut(&self.ip) {
            *count -= 1;
            if *count == 0 {
                counts.remove(&self.ip);
            }
        }
    }
}

/// Lines of the log of one kind, at most one a second.
#[derive(Default)]
pub(super) struct Rarely(Mutex<(Option<Instant>, u64)>);

impl Rarely {
    /// Says whether to write a line now, and how many were left out before it.
    pub(super) fn now(&self) -> Option<u64> {
        let mut last = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if last.0.is_some_and(|at| at.elapsed() < LINE_EVERY) {
            last.1 += 1;
            return None;
        }
        last.0 = Some(Instant::now());
        Some(std::mem::take(&mut last.1))
    }

    /// Warns of something that an address did.
    pub(super) fn warn(&self, peer: Option<IpAddr>, what: &'static str, why: &str) {
        if let Some(left_out) = self.now() {
            let peer = peer.map_or_else(|| "unknown".into(), |ip| ip.to_string());
            warn!(peer, why, left_out, "{what}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn address_that_has_its_share_gets_no_more_and_others_do() {
        let counts = Arc::<Counts>::default();
        let [a, b] = ["10.0.0.1", "::ffff:10.0.0.2"].map(|ip| ip.parse().expect("an address"));
        let first = counts.take(a, 2).expect("it has none");
        let _second = counts.take(a, 2).expect("it has one");
        assert!(counts.take(a, 2).is_none() && counts.take(b, 2).is_some());
        drop(first);
        assert!(counts.take(a, 2).is_some());
    }

    #[test]
    fn addresses_of_one_machine_count_as_one() {
        let same = |a: &str, b: &str| {
            counted_as(a.parse().expect("an address")) == counted_as(b.parse().expect("an address"))
        };
        assert!(same("2001:db8::1", "2001:db8::ffff:1") && !same("2001:db8::1", "2001:db8:0:1::1"));
        assert!(same("::ffff:1.2.3.4", "1.2.3.4") && !same("::1", "::2"));
    }

    #[tokio::test(start_paused = true)]
    async fn lines_come_once_a_second_and_say_how_many_were_left_out() {
        let rarely = Rarely::default();
        assert_eq!(rarely.now(), Some(0));
        assert_eq!([rarely.now(), rarely.now()], [None; 2]);
        tokio::time::advance(LINE_EVERY).await;
        assert_eq!(rarely.now(), Some(2));
    }
}
