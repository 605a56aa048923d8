//! A map from worker ids, iterated in the order of the ids.
//!
//! The scheduler looks workers up ten times for each message. Ids are handed out in sequence, so a
//! worker is mostly found at the index that its id says, and by binary search if some before it are
//! gone. In trees, looking up workers and tiles ([`tile_map`](crate::state::tile_map)) was a
//! quarter of all that the scheduler did for 64 workers.

use slabcast_common::ids::WorkerId;

/// A map from [`WorkerId`], ordered by id.
#[derive(Clone, Debug)]
pub(crate) struct WorkerMap<T> {
    ids: Vec<WorkerId>,
    /// Values, at the indices of their ids.
    values: Vec<T>,
}

impl<T> Default for WorkerMap<T> {
    fn default() -> Self {
        WorkerMap { ids: Vec::new(), values: Vec::new() }
    }
}

impl<T> WorkerMap<T> {
    /// Returns the index of a worker, or where it would be inserted.
    fn place(&self, id: WorkerId) -> Result<usize, usize> {
        let Some(first) = self.ids.first() else { return Err(0) };
        let guess = usize::try_from(id.0.wrapping_sub(first.0)).unwrap_or(usize::MAX);
        if self.ids.get(guess) == Some(&id) {
            return Ok(guess);
        }
        self.ids.binary_search(&id)
    }

    pub(crate) fn get(&self, id: WorkerId) -> Option<&T> {
        Some(&self.values[self.place(id).ok()?])
    }

    pub(crate) fn get_mut(&mut self, id: WorkerId) -> Option<&mut T> {
        let place = self.place(id).ok()?;
        Some(&mut self.values[place])
    }

    /// Inserts a value and returns the one before.
    pub(crate) fn insert(&mut self, id: WorkerId, value: T) -> Option<T> {
        match self.place(id) {
            Ok(place) => Some(std::mem::replace(&mut self.values[place], value)),
            Err(place) => {
                self.ids.insert(place, id);
                self.values.insert(place, value);
                None
            }
        }
    }

    pub(crate) fn remove(&mut self, id: WorkerId) -> Option<T> {
        let place = self.place(id).ok()?;
        self.ids.remove(place);
        Some(self.values.remove(place))
    }

    /// Returns the worker's value; inserts `make()` first if there is none.
    pub(crate) fn or_insert_with(&mut self, id: WorkerId, make: impl FnOnce() -> T) -> &mut T {
        let place = self.place(id).unwrap_or_else(|place| {
            self.ids.insert(place, id);
            self.values.insert(place, make());
            place
        });
        &mut self.values[place]
    }

    pub(crate) fn or_default(&mut self, id: WorkerId) -> &mut T
    where
        T: Default,
    {
        self.or_insert_with(id, T::default)
    }

    pub(crate) fn len(&self) -> usize {
        self.ids.len()
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    pub(crate) fn ids(&self) -> impl Iterator<Item = WorkerId> {
        self.ids.iter().copied()
    }

    pub(crate) fn values(&self) -> impl Iterator<Item = &T> {
        self.values.iter()
    }

    pub(crate) fn values_mut(&mut self) -> impl Iterator<Item = &mut T> {
        self.values.iter_mut()
    }

    pub(crate) fn into_values(self) -> impl Iterator<Item = T> {
        self.values.into_iter()
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (WorkerId, &T)> {
        self.ids().zip(&self.values)
    }

    pub(crate) fn iter_mut(&mut self) -> impl Iterator<Item = (WorkerId, &mut T)> {
        self.ids.iter().copied().zip(&mut self.values)
    }
}

impl<T> std::ops::Index<WorkerId> for WorkerMap<T> {
    type Output = T;

    fn index(&self, id: WorkerId) -> &T {
        self.get(id).expect("a worker that is known")
    }
}

impl<T> IntoIterator for WorkerMap<T> {
    type Item = (WorkerId, T);
    type IntoIter = std::iter::Zip<std::vec::IntoIter<WorkerId>, std::vec::IntoIter<T>>;

    fn into_iter(self) -> Self::IntoIter {
        self.ids.into_iter().zip(self.values)
    }
}

impl<T> FromIterator<(WorkerId, T)> for WorkerMap<T> {
    fn from_iter<I: IntoIterator<Item = (WorkerId, T)>>(all: I) -> Self {
        let mut map = WorkerMap::default();
        for (id, value) in all {
            map.insert(id, value);
        }
        map
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    proptest! {
        /// Whoever comes and goes in whatever order, it is what a tree of the standard library is.
        #[test]
        fn it_is_an_ordered_map(
            base in prop::sample::select(vec![0u64, 1, 1000, u64::MAX - 40]),
            deeds in prop::collection::vec((0u64..40, 0u8..4, any::<u16>()), 0..200),
        ) {
            let (mut map, mut tree) = (WorkerMap::default(), BTreeMap::new());
            for (id, deed, value) in deeds {
                let id = WorkerId(base + id);
                match deed {
                    0 => prop_assert_eq!(map.insert(id, value), tree.insert(id, value)),
                    1 => prop_assert_eq!(map.remove(id), tree.remove(&id)),
                    2 => *map.or_default(id) = *tree.entry(id).or_default(),
                    _ => prop_assert_eq!(map.get_mut(id), tree.get_mut(&id)),
                }
                prop_assert_eq!(map.get(id), tree.get(&id));
                prop_assert_eq!((map.len(), map.is_empty()), (tree.len(), tree.is_empty()));
            }
            prop_assert!(map.iter().eq(tree.iter().map(|(&id, v)| (id, v))));
            prop_assert!(map.into_iter().eq(tree));
        }
    }
}
