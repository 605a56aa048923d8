//! Cache of the message `volume`: sessions that show one volume at one picture size share one description.

use crate::problem::Problem;
use crate::volume::{Facts, Shown};
use axum::extract::ws::Utf8Bytes;
use slabcast_master::ServedVolume;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Capacity of the cache of size-independent facts, in volumes. An entry takes some 0.1 MiB.
const VOLUMES: usize = 4;
/// Capacity of the cache of descriptions; each window size has its own. An entry takes some 0.1 MiB.
const DESCRIPTIONS: usize = 16;

/// A volume's state for a session, and the message `volume` as JSON text.
#[derive(Clone)]
pub(crate) struct Described {
    pub(crate) shown: Arc<Shown>,
    pub(crate) message: Utf8Bytes,
}

/// Identity of a loaded volume. Equal if both are the same loading of a file; a file that was read anew
/// differs.
#[derive(Clone)]
pub(crate) struct Reading(Arc<ServedVolume>);

impl PartialEq for Reading {
    fn eq(&self, other: &Reading) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

/// Key of a cached description: the volume, its name for this viewer, and the picture's size in pixels.
#[derive(Clone, PartialEq)]
struct Key {
    of: Reading,
    name: String,
    size: [u32; 2],
}

/// LRU cache, the most recently used entry first. Each value is computed once; concurrent callers block until
/// it is there.
struct Recent<K, V> {
    most: usize,
    kept: Mutex<VecDeque<(K, Arc<OnceLock<V>>)>>,
}

impl<K: PartialEq, V: Clone> Recent<K, V> {
    fn new(most: usize) -> Self {
        Recent { most, kept: Mutex::default() }
    }

    /// Returns the cached value of `key`, or computes it with `make`. Blocks meanwhile.
    fn get(&self, key: K, make: impl FnOnce() -> V) -> V {
        let place = {
            // No thread panics while it holds the lock.
            let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
            let at = kept.iter().position(|(of, _)| *of == key);
            let entry = at.and_then(|at| kept.remove(at)).unwrap_or_else(|| (key, Arc::default()));
            let place = entry.1.clone();
            kept.push_front(entry);
            kept.truncate(self.most);
            place
        };
        place.get_or_init(make).clone()
    }

    /// Removes computed values for which `holds` is false.
    fn retain(&self, holds: impl Fn(&V) -> bool) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.retain(|(_, value)| value.get().is_none_or(&holds));
    }
}

/// See the head of the file.
pub(crate) struct Descriptions {
    facts: Recent<Reading, Arc<Facts>>,
    described: Recent<Key, Result<Described, Problem>>,
}

impl Default for Descriptions {
    fn default() -> Descriptions {
        Descriptions { facts: Recent::new(VOLUMES), described: Recent::new(DESCRIPTIONS) }
    }
}

impl Descriptions {
    /// Returns the size-independent facts of a volume, computed by `make` on a cache miss.
    pub(crate) fn facts(&self, of: &Arc<ServedVolume>, make: impl FnOnce() -> Facts) -> Arc<Facts> {
        self.facts.get(Reading(of.clone()), || Arc::new(make()))
    }

    /// Returns the description of a volume named `name`, for pictures of `size` pixels, computed by `make` on
    /// a cache miss.
    ///
    /// # Errors
    /// Errors of `make`. They are not cached: the next call runs `make` again.
    pub(crate) fn get(
        &self,
        of: &Arc<ServedVolume>,
        name: &str,
        size: [u32; 2],
        make: impl FnOnce() -> Result<Described, Problem>,
    ) -> Result<Described, Problem> {
        let key = Key { of: Reading(of.clone()), name: name.to_owned(), size };
        let described = self.described.get(key, make);
        if described.is_err() {
            self.described.retain(Result::is_ok);
        }
        described
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_made_once_and_the_oldest_goes() {
        let recent: Recent<u32, u32> = Recent::new(2);
        assert_eq!(recent.get(1, || 10), 10);
        assert_eq!(recent.get(1, || unreachable!("it is kept")), 10);
        assert_eq!(recent.get(2, || 20), 20);
        assert_eq!(recent.get(1, || unreachable!("it is kept")), 10);
        assert_eq!(recent.get(3, || 30), 30);
        assert_eq!(recent.get(1, || unreachable!("it was used later")), 10);
        assert_eq!(recent.get(2, || 21), 21, "it had to go");
        recent.retain(|value| *value != 21);
        assert_eq!(recent.get(2, || 22), 22, "made anew");
    }

    #[test]
    fn who_comes_meanwhile_waits_for_the_first() {
        let recent: Recent<u32, u32> = Recent::new(2);
        let made = std::sync::atomic::AtomicU32::new(0);
        let barrier = std::sync::Barrier::new(4);
        std::thread::scope(|threads| {
            for _ in 0..4 {
                threads.spawn(|| {
                    barrier.wait();
                    let make = || made.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 7;
                    assert_eq!(recent.get(1, make), 7);
                });
            }
        });
        assert_eq!(made.into_inner(), 1);
    }
}
