//! Source of boxes from a volume in memory.

use super::{BLOCK_EDGE, BlockSource, BlockSummaries, BlockSummary, ValueBins, block_dims};
use crate::error::Problem;
use rayon::prelude::*;
use slabcast_common::volume::{Digest32, Samples, Volume, VolumeInfo};
use std::ops::Deref;
use std::sync::{Arc, OnceLock};

/// Source with one level: a volume whose samples are in memory. `V` owns or borrows it.
pub struct MemorySource<V = Arc<Volume>> {
    volume: V,
    level: VolumeInfo,
    summaries: OnceLock<Arc<BlockSummaries>>,
}

impl<V: Deref<Target = Volume>> MemorySource<V> {
    /// Returns a source of one level; `digest` is the volume's.
    pub fn new(volume: V, digest: Digest32) -> MemorySource<V> {
        let level = volume.info(digest);
        MemorySource { volume, level, summaries: OnceLock::new() }
    }
}

impl MemorySource {
    /// Returns a source of a volume, whose digest it computes.
    pub fn of(volume: impl Into<Arc<Volume>>) -> MemorySource {
        let volume = volume.into();
        let digest = volume.digest();
        MemorySource::new(volume, digest)
    }
}

impl<V: Deref<Target = Volume> + Send + Sync> BlockSource for MemorySource<V> {
    fn name(&self) -> &str {
        &self.volume.name
    }

    fn file_type(&self) -> &str {
        &self.volume.file_type
    }

    fn levels(&self) -> &[VolumeInfo] {
        std::slice::from_ref(&self.level)
    }

    fn read_box(&self, level: usize, lo: [u32; 3], hi: [u32; 3]) -> Result<Samples, Problem> {
        assert_eq!(level, 0, "a volume in memory has one level");
        Ok(copy_box(self.volume.codes(), self.volume.lattice.dims, lo, hi))
    }

    fn summaries(&self, level: usize) -> Result<Arc<BlockSummaries>, Problem> {
        assert_eq!(level, 0, "a volume in memory has one level");
        Ok(self.summaries.get_or_init(|| Arc::new(summarise(&self.volume))).clone())
    }

    fn memory_bytes(&self) -> u64 {
        self.volume.memory_bytes()
    }

    fn whole(&self, level: usize) -> Option<&Volume> {
        (level == 0).then_some(&*self.volume)
    }
}

/// Copies the box from `lo` to `hi` (exclusive) out of `dims` samples, i fastest.
///
/// # Panics
/// If the box is empty or reaches out of `dims`.
pub(crate) fn copy_box(samples: &Samples, dims: [u32; 3], lo: [u32; 3], hi: [u32; 3]) -> Samples {
    assert!((0..3).all(|a| lo[a] < hi[a] && hi[a] <= dims[a]), "a box inside");
    fn rows<T: Copy>(all: &[T], dims: [u32; 3], lo: [u32; 3], hi: [u32; 3]) -> Vec<T> {
        let [nx, ny, _] = dims.map(|n| n as usize);
        let size = (0..3).map(|a| (hi[a] - lo[a]) as usize).product();
        let mut to = Vec::with_capacity(size);
        for z in lo[2] as usize..hi[2] as usize {
            for y in lo[1] as usize..hi[1] as usize {
                let row = (z * ny + y) * nx;
                to.extend_from_slice(&all[row + lo[0] as usize..row + hi[0] as usize]);
            }
        }
        to
    }
    match samples {
        Samples::U8(v) => Samples::U8(rows(v, dims, lo, hi)),
        Samples::U16(v) => Samples::U16(rows(v, dims, lo, hi)),
        Samples::F32(v) => Samples::F32(rows(v, dims, lo, hi)),
    }
}

fn summarise(volume: &Volume) -> BlockSummaries {
    let dims = block_dims(volume.lattice.dims);
    let bins = ValueBins::of(&volume.summary);
    let count: usize = dims.iter().map(|&n| n as usize).product();
    let of = |i: usize| {
        let at = [i % dims[0] as usize, i / dims[0] as usize % dims[1] as usize];
        let at = [at[0] as u32, at[1] as u32, (i / dims[0] as usize / dims[1] as usize) as u32];
        let lo = at.map(|n| n * BLOCK_EDGE);
        let hi = std::array::from_fn(|a| (lo[a] + BLOCK_EDGE).min(volume.lattice.dims[a]));
        BlockSummary::of(&copy_box(volume.codes(), volume.lattice.dims, lo, hi), &bins)
    };
    BlockSummaries { dims, bins, all: (0..count).into_par_iter().map(of).collect() }
}
