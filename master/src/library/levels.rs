//! Levels of detail of volumes in memory, computed when a job needs them.
//!
//! A level is a volume with a digest of its own. The library remembers its description, so that a
//! job finds its volume by the digest. Its samples stay while memory lasts, as samples of files do,
//! and are computed again when they are needed. One level is computed at a time, by all cores.

use super::{
    Entries, Library, OpenVolume, ServedVolume, Viewer, VolumeError, no_such_digest, sample_bytes,
};
use slabcast_common::volume::{Digest32, Lattice};
use slabcast_scene::request::VolumeChoice;
use slabcast_volumes::blocks::{BlockSource, MemorySource, coarser, halved_lattice};
use std::sync::{Arc, PoisonError};
use tracing::info;

/// A level that was computed from a volume, and its samples while they are in memory.
pub(super) struct Level {
    /// Digest of the volume that it was computed from.
    of: Digest32,
    served: Arc<ServedVolume>,
    source: Option<Arc<dyn BlockSource>>,
    /// Value of the clock when it was used last.
    used: u64,
}

/// Returns the lattices of a volume's levels, from its own on.
fn lattices(lattice: &Lattice) -> impl Iterator<Item = Lattice> {
    std::iter::successors(Some(*lattice), halved_lattice)
}

impl Library {
    /// Returns a level of a volume, or the coarsest if it has fewer levels (colours have one). A
    /// volume that is itself a coarser level gives that level. Levels of a file are taken from it;
    /// others are computed from the volume in memory.
    ///
    /// # Errors
    /// There is no memory for it.
    pub fn level(&self, open: &OpenVolume, level: u32) -> Result<OpenVolume, VolumeError> {
        let of_file = open.source.levels();
        let Some(whole) = open.source.whole(open.level).filter(|_| of_file.len() == 1) else {
            let found = of_file.iter().rposition(|info| info.level <= level);
            let found = found.unwrap_or(0).max(open.level);
            let ServedVolume { name, orientation, .. } = &*open.served;
            return Ok(OpenVolume::of(open.source.clone(), found, name, *orientation));
        };
        let info = &open.served.info;
        if info.summary.palette.is_some() {
            return Ok(open.clone());
        }
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
        let mut coarse = coarser(whole);
        while let Some(fine) = coarse.take_if(|fine| fine.lattice.dims != lattice.dims) {
            coarse = coarser(&fine);
        }
        let Some(coarse) = coarse else { return Ok(open.clone()) };
        let source = Arc::new(MemorySource::of(coarse));
        let ServedVolume { name, orientation, .. } = &*open.served;
        let coarse = OpenVolume::of(source, 0, name, *orientation);
        let (name, dims) = (&open.served.name, lattice.dims);
        info!(volume = name, level, ?dims, digest = %coarse.served.info.digest, "level computed");
        self.lock().put_level(info.digest, &coarse);
        Ok(coarse)
    }

    /// Returns a volume or level by digest; reads or computes it if it is not open.
    ///
    /// # Errors
    /// It is gone, or can't be read.
    pub(crate) fn open_level(&self, digest: Digest32) -> Result<OpenVolume, VolumeError> {
        let level = self.lock().level_of(digest);
        let Some((of, level)) = level else {
            return self.open(&VolumeChoice::Digest(digest), Viewer::own());
        };
        let fine = self.open(&VolumeChoice::Digest(of), Viewer::own())?;
        let open = match fine.source.levels().iter().position(|info| info.digest == digest) {
            Some(found) => {
                let ServedVolume { name, orientation, .. } = &*fine.served;
                OpenVolume::of(fine.source.clone(), found, name, *orientation)
            }
            None => self.level(&fine, level)?,
        };
        if open.served.info.digest == digest { Ok(open) } else { Err(no_such_digest(digest)) }
    }

    /// Drops samples of others until there is memory for a level. What is halved on the way counts:
    /// at most a third more than the first halving.
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
        Some(OpenVolume { served: level.served.clone(), source: level.source.clone()?, level: 0 })
    }

    fn put_level(&mut self, of: Digest32, open: &OpenVolume) {
        self.clock += 1;
        let known: Vec<Digest32> = self.by_name.values().filter_map(super::Entry::digest).collect();
        self.levels.retain(|_, level| known.contains(&level.of));
        let level = Level {
            of,
            served: open.served.clone(),
            source: Some(open.source.clone()),
            used: self.clock,
        };
        self.levels.insert(open.served.info.digest, level);
    }

    /// Returns the volume and the number of the level with this digest; `None` if it is not a
    /// level.
    fn level_of(&self, digest: Digest32) -> Option<(Digest32, u32)> {
        if let Some(level) = self.levels.get(&digest) {
            return Some((level.of, level.served.info.level));
        }
        let of_file = self.by_name.values().filter(|entry| entry.levels.contains(&digest));
        of_file.filter_map(|entry| Some((entry.digest()?, 0))).find(|(of, _)| *of != digest)
    }

    /// Bytes of the samples of levels in memory.
    pub(super) fn level_bytes(&self) -> u64 {
        let held = self.levels.values().filter(|level| level.source.is_some());
        held.map(|level| sample_bytes(&level.served.info)).sum()
    }

    /// Returns the least recently used level, with the time of its last use; `None` if no level is
    /// in memory.
    pub(super) fn oldest_level(&self) -> Option<(u64, Digest32)> {
        let held = self.levels.iter().filter(|(_, level)| level.source.is_some());
        held.map(|(digest, level)| (level.used, *digest)).min()
    }

    /// Drops the samples of a level.
    pub(super) fn drop_level(&mut self, digest: Digest32) {
        if let Some(level) = self.levels.get_mut(&digest) {
            level.source = None;
        }
    }
}
