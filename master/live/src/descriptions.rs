//! Descriptions of volumes, which sessions share: one volume in pictures of one size is described once,
//! however many pages show it.

use crate::problem::Problem;
use crate::volume::{Facts, Shown};
use axum::extract::ws::Utf8Bytes;
use slabcast_master::ServedVolume;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Volumes of which the facts are kept: some 0.1 MiB each.
const VOLUMES: usize = 4;
/// Descriptions that are kept: some 0.1 MiB each. Each window size has its own.
const DESCRIPTIONS: usize = 16;

/// A volume as a session shows it, and the message `volume`.
#[derive(Clone)]
pub(crate) struct Described {
    pub(crate) shown: Arc<Shown>,
    pub(crate) message: Utf8Bytes,
}

/// A volume of the library. Equal are those that were described from one reading of its file.
#[derive(Clone)]
pub(crate) struct Reading(Arc<ServedVolume>);

impl PartialEq for Reading {
    fn eq(&self, other: &Reading) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

/// What a description follows from: the volume, the name under which the viewer knows it, and the size
/// of the picture.
#[derive(Clone, PartialEq)]
struct Key {
    of: Reading,
    name: String,
    size: [u32; 2],
}

/// Values that were made lately, the latest first. A value is made once, and who asks meanwhile waits
/// for it.
struct Recent<K, V> {
    most: usize,
    kept: Mutex<VecDeque<(K, Arc<OnceLock<V>>)>>,
}

impl<K: PartialEq, V: Clone> Recent<K, V> {
    fn new(most: usize) -> Self {
        Recent { most, kept: Mutex::default() }
    }

    /// Returns the value of a key; makes it if it is not kept. Blocks while it is made.
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

    /// Forgets values that don't hold.
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
    /// Returns what holds of a volume in pictures of every size; `make` finds it the first time.
    pub(crate) fn facts(&self, of: &Arc<ServedVolume>, make: impl FnOnce() -> Facts) -> Arc<Facts> {
        self.facts.get(Reading(of.clone()), || Arc::new(make()))
    }

    /// Returns the description of a volume under a name, for pictures of `size`; `make` makes it the
    /// first time.
    ///
    /// # Errors
    /// Those of `make`, which is called anew the next time.
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
