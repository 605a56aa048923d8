//! Limits of concurrent sessions: one for the master, and one for each remote address.

use slabcast_master::serve::counted_as;
use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Most concurrent sessions of a master.
pub(crate) const SESSIONS: usize = 64;

/// Close reason when the master is at its limit. WebSocket close reasons have at most 123 bytes.
const ALL_TAKEN: &str = "as many pages are open as this master takes; dial again later";
/// Close reason when a remote address is at its limit.
const SHARE_TAKEN: &str =
    "as many pages are open from your address as this master takes; close some";

/// See the head of the file.
pub(crate) struct Places {
    all: Arc<Semaphore>,
    most_of_peer: usize,
    of_peers: Arc<Mutex<Counts>>,
}

/// Number of sessions of each address with at least one.
type Counts = BTreeMap<IpAddr, usize>;

/// Permit of one session. Dropping it frees the place.
pub(crate) struct Place {
    _one: OwnedSemaphorePermit,
    peer: Option<(IpAddr, Arc<Mutex<Counts>>)>,
}

fn lock(of_peers: &Mutex<Counts>) -> MutexGuard<'_, Counts> {
    // No thread panics while it holds the lock.
    of_peers.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Places {
    /// Returns limits of [`SESSIONS`] in all and `most_of_peer` a remote address. Loopback has no limit of
    /// its own, since all users of a local proxy share that address.
    pub(crate) fn new(most_of_peer: usize) -> Places {
        Places { all: Arc::new(Semaphore::new(SESSIONS)), most_of_peer, of_peers: Arc::default() }
    }

    /// Takes a permit for a session of `peer`.
    ///
    /// # Errors
    /// The close reason, if the master or the address is at its limit.
    pub(crate) fn take(&self, peer: Option<IpAddr>) -> Result<Place, &'static str> {
        let one = self.all.clone().try_acquire_owned().map_err(|_| ALL_TAKEN)?;
        let peer = peer.filter(|ip| !ip.to_canonical().is_loopback()).map(counted_as);
        if let Some(peer) = peer {
            let mut of_peers = lock(&self.of_peers);
            let own = of_peers.entry(peer).or_default();
            if *own >= self.most_of_peer {
                return Err(SHARE_TAKEN);
            }
            *own += 1;
        }
        Ok(Place { _one: one, peer: peer.map(|peer| (peer, self.of_peers.clone())) })
    }

    /// Waits until no session is left.
    pub(crate) async fn all_free(&self) {
        let _ = self.all.acquire_many(SESSIONS as u32).await;
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let Some((peer, of_peers)) = &self.peer else { return };
        let mut of_peers = lock(of_peers);
        if let Some(own) = of_peers.get_mut(peer) {
            *own -= 1;
        }
        of_peers.retain(|_, own| *own > 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ip(text: &str) -> Option<IpAddr> {
        Some(text.parse().expect("an address"))
    }

    #[test]
    fn an_address_gets_its_share_and_this_machine_all() {
        let places = Places::new(2);
        let mut held: Vec<Place> =
            (0..2).map(|_| places.take(ip("10.0.0.1")).expect("a share")).collect();
        assert_eq!(places.take(ip("10.0.0.1")).err(), Some(SHARE_TAKEN));
        assert_eq!(places.take(ip("::ffff:10.0.0.1")).err(), Some(SHARE_TAKEN), "the same");
        held.push(places.take(ip("10.0.0.2")).expect("another's share"));
        held.extend((3..SESSIONS).map(|_| places.take(ip("127.0.0.1")).expect("all others")));
        assert_eq!(places.take(ip("::1")).err(), Some(ALL_TAKEN));
        assert_eq!(places.take(ip("10.0.0.3")).err(), Some(ALL_TAKEN));
        held.remove(0);
        held.push(places.take(ip("10.0.0.1")).expect("one was given back"));
        drop(held);
        assert!(lock(&places.of_peers).is_empty(), "nothing is remembered of who left");
    }

    #[test]
    fn words_fit_a_close_frame() {
        assert!([ALL_TAKEN, SHARE_TAKEN].iter().all(|words| words.len() <= 123));
    }
}
