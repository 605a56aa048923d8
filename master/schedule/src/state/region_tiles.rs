//! Owners and predicted times of the tiles of one frame (`region` schedule).

use crate::state::worker_map::WorkerMap;
use crate::state::workers::Roster;
use slabcast_common::ids::WorkerId;

/// A predicted rendering time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Predicted {
    /// Worker that rendered the tile last.
    pub(crate) worker: WorkerId,
    /// Rendering time by that worker, in microseconds.
    pub(crate) us: f64,
}

/// Owner and predicted time of each tile, by the index of its task.
#[derive(Debug, Default)]
pub(crate) struct RegionTiles {
    owners: Vec<WorkerId>,
    /// Indices of each worker's tiles, ascending where none moved.
    owned: WorkerMap<Vec<u32>>,
    /// `None`: nothing is known of the tile.
    predicted: Vec<Option<Predicted>>,
    /// Sum of all predictions, and the largest, when the frame was cut.
    all_us: f64,
    longest_us: f64,
}

impl RegionTiles {
    /// Makes the tiles of a frame that was cut.
    pub(crate) fn new(owners: Vec<WorkerId>, predicted: Vec<Option<Predicted>>) -> Self {
        let us = || predicted.iter().flatten().map(|p| p.us);
        let (all_us, longest_us) = (us().sum(), us().fold(0.0, f64::max));
        let mut owned = WorkerMap::<Vec<u32>>::default();
        for (&owner, place) in owners.iter().zip(0..) {
            owned.or_default(owner).push(place);
        }
        RegionTiles { owners, owned, predicted, all_us, longest_us }
    }

    /// Returns owners that are gone, leave, or are in reserve.
    pub(crate) fn missing_owners(&self, roster: &Roster) -> Vec<WorkerId> {
        let gone = |id: &WorkerId| roster.get(*id).is_none_or(|w| !w.is_active());
        self.owned.ids().filter(gone).collect()
    }

    /// Returns the owner of a task.
    pub(crate) fn owner(&self, place: u32) -> WorkerId {
        self.owners[place as usize]
    }

    /// Returns the tasks of a worker.
    pub(crate) fn owned(&self, id: WorkerId) -> &[u32] {
        self.owned.get(id).map_or(&[], Vec::as_slice)
    }

    /// Returns the predicted rendering time of a task.
    pub(crate) fn predicted(&self, place: u32) -> Option<Predicted> {
        self.predicted[place as usize]
    }

    /// Returns the predicted rendering time of a task in microseconds.
    pub(crate) fn us(&self, place: u32) -> Option<f64> {
        self.predicted(place).map(|p| p.us)
    }

    /// Returns the predicted rendering time of the frame for each of so many threads.
    pub(crate) fn us_a_thread(&self, threads: u64) -> f64 {
        self.all_us / threads.max(1) as f64
    }

    /// Returns the longest predicted rendering time; infinite where nothing is known.
    pub(crate) fn longest_us(&self) -> f64 {
        if self.all_us > 0.0 { self.longest_us } else { f64::INFINITY }
    }

    /// Returns how long each worker takes for those of the `open` tasks that are its own.
    pub(crate) fn left_us(
        &self,
        open: impl Iterator<Item = u32>,
        roster: &Roster,
    ) -> WorkerMap<f64> {
        let mut left = WorkerMap::default();
        for place in open {
            if let Some(us) = self.us(place) {
                let owner = self.owner(place);
                let threads = roster.get(owner).map_or(1, |w| w.threads);
                *left.or_default(owner) += us / f64::from(threads);
            }
        }
        left
    }

    /// Gives a task to another worker.
    pub(crate) fn give(&mut self, place: u32, worker: WorkerId) {
        let before = std::mem::replace(&mut self.owners[place as usize], worker);
        if before != worker {
            // The owner before stays among those whose loss is looked for.
            self.owned.or_default(before).retain(|p| *p != place);
            self.owned.or_default(worker).push(place);
        }
    }

    /// Notes that a task was split: what the rest of it takes in all, and what the piece takes,
    /// which gets the next index and belongs to `taker`.
    pub(crate) fn split(&mut self, place: u32, kept_us: f64, piece_us: f64, taker: WorkerId) {
        let worker = self.predicted(place).map_or(self.owner(place), |p| p.worker);
        self.predicted[place as usize] = Some(Predicted { worker, us: kept_us });
        let piece = self.owners.len() as u32;
        self.owners.push(taker);
        self.predicted.push(Some(Predicted { worker, us: piece_us }));
        self.owned.or_default(taker).push(piece);
    }
}
