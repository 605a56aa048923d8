//! Levels of detail of volumes in memory, computed when a job needs them.
//!
//! A level is a volume with a digest of its own. Its description is remembered, so that a job finds
//! by digest what it is of; its samples stay while memory lasts, like those of files, and are
//! computed again when they are needed. One is computed at a time, by all cores.

use super::{
    Entries, Library, OpenVolume, ServedVolume, Viewer, VolumeError, no_such_digest, sample_bytes,
};
use slabcast_common::volume::{Digest32, Lattice, Volume};
use slabcast_scene::request::VolumeChoice;
use slabcast_volumes::blocks::{coarser, halved_lattice};
use std::sync::{Arc, PoisonError};
use tracing::info;

/// A level of a volume, and its samples if they are in memory.
pub(super) struct Level {
    /// Digest of the volume that it was computed from.
    of: Digest32,
    served: Arc<ServedVolume>,
    samples: Option<Arc<Volume>>,
    /// Value of the clock when it was used last.
    used: u64,
}

/// Returns the lattices of a volume's levels, from its own on.
fn lattices(lattice: &Lattice) -> impl Iterator<Item = Lattice> {
    std::iter::successors(Some(*lattice), halved_lattice)
}

impl Library {
    /// Returns a level of a volume with its samples; of a volume with fewer levels the coarsest, and of
    /// one that is itself a coarser level its own.
    ///
    /// # Errors
    /// There is no memory for it.
    pub fn level(&self, open: &OpenVolume, level: u32) -> Result<OpenVolume, VolumeError> {
        let info = &open.served.info;
        let steps = level.saturating_sub(info.level) as usize;
        let Some(lattice) = lattices(&info.lattice).take(steps + 1).last() else {
            return Ok(open.clone());
        };
        if lattice.dims == info.lattice.dims {
            return Ok(open.clone());
        }
        let held = |entries: &mut Entries| entries.take_level(info.digest, &lattice);
        if let Some(open) = held(&mut self.lock()) {
            return Ok(open);
        }
        // No thread panics while it holds the lock.
        let _reading = self.reading.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(open) = held(&mut self.lock()) {
            return Ok(open);
        }
        self.make_room(open, &lattice)?;
        // Each is halved from the next finer one, of which only the last is kept.
        let mut fine = open.volume.clone();
        while fine.lattice.dims != lattice.dims {
            let Some(coarse) = coarser(&fine) else { break };
            fine = Arc::new(coarse);
        }
        let served = ServedVolume::new(&fine, open.served.orientation, fine.digest());
        let coarse = OpenVolume { served: Arc::new(served), volume: fine };
        let (name, dims) = (&open.served.name, lattice.dims);
        info!(volume = name, level, ?dims, digest = %coarse.served.info.digest, "level computed");
        self.lock().put_level(info.digest, &coarse);
        Ok(coarse)
    }

    /// Returns the samples of a volume or level by digest; reads or computes them if they are not in
    /// memory.
    ///
    /// # Errors
    /// They are gone, or can't be read.
    pub(crate) fn samples(&self, digest: Digest32) -> Result<Arc<Volume>, VolumeError> {
        let level = self.lock().level_of(digest);
        let Some((of, level)) = level else {
            let open = self.open(&VolumeChoice::Digest(digest), Viewer::own())?;
            return Ok(open.volume);
        };
        let fine = self.open(&VolumeChoice::Digest(of), Viewer::own())?;
        let open = self.level(&fine, level)?;
        if open.served.info.digest == digest {
            Ok(open.volume)
        } else {
            Err(no_such_digest(digest))
        }
    }

    /// Drops samples of others until there is memory for a level. What is halved on the way counts: at
    /// most a third more than the first halving.
    fn make_room(&self, open: &OpenVolume, lattice: &Lattice) -> Result<(), VolumeError> {
        let per_sample = open.served.info.summary.kind.bytes() as u64;
        let steps = lattices(&open.served.info.lattice).skip(1);
        let all: u64 = steps
            .take_while(|finer| finer.len() >= lattice.len())
            .map(|finer| finer.len() as u64 * per_sample)
            .sum();
        loop {
            let mut entries = self.lock();
            let room = self.memory_bytes.saturating_sub(entries.held_bytes());
            if all <= room {
                return Ok(());
            }
            if !entries.drop_oldest() {
                return Err(VolumeError::NoRoom(
                    format!(
                        "level: computing it takes {} MiB, and the master has {} MiB for volumes \
                         (--volume-memory); ask for level 0",
                        all.div_ceil(1 << 20),
                        self.memory_bytes >> 20
                    ),
                    false,
                ));
            }
        }
    }
}

impl Entries {
    /// Takes a level whose samples are in memory.
    fn take_level(&mut self, of: Digest32, lattice: &Lattice) -> Option<OpenVolume> {
        self.clock += 1;
        let mut of_volume = self.levels.values_mut().filter(|level| level.of == of);
        let level = of_volume.find(|level| level.served.info.lattice == *lattice)?;
        level.used = self.clock;
        Some(OpenVolume { served: level.served.clone(), volume: level.samples.clone()? })
    }

    fn put_level(&mut self, of: Digest32, open: &OpenVolume) {
        self.clock += 1;
        let known: Vec<Digest32> = self.by_name.values().filter_map(super::Entry::digest).collect();
        self.levels.retain(|_, level| known.contains(&level.of));
        let level = Level {
            of,
            served: open.served.clone(),
            samples: Some(open.volume.clone()),
            used: self.clock,
        };
        self.levels.insert(open.served.info.digest, level);
    }

    /// Returns of which volume a digest is a level, and which level.
    fn level_of(&self, digest: Digest32) -> Option<(Digest32, u32)> {
        self.levels.get(&digest).map(|level| (level.of, level.served.info.level))
    }

    /// Bytes of the samples of levels in memory.
    pub(super) fn level_bytes(&self) -> u64 {
        let held = self.levels.values().filter(|level| level.samples.is_some());
        held.map(|level| sample_bytes(&level.served.info)).sum()
    }

    /// When the level that was unused for longest was used; `None` if none is in memory.
    pub(super) fn oldest_level(&self) -> Option<(u64, Digest32)> {
        let held = self.levels.iter().filter(|(_, level)| level.samples.is_some());
        held.map(|(digest, level)| (level.used, *digest)).min()
    }

    /// Drops the samples of a level.
    pub(super) fn drop_level(&mut self, digest: Digest32) {
        if let Some(level) = self.levels.get_mut(&digest) {
            level.samples = None;
        }
    }
}
