//! Sources of volumes that are read in boxes, at each level of a pyramid.
//!
//! A [`BlockSource`] gives samples of a volume without holding all of them: code that cuts bricks,
//! frames a path or halves a volume asks for the box that it needs. Level 0 is the volume; each
//! level after it has means of two samples along each axis (`mean`). A level is a volume of its
//! own, with a lattice, a digest and a summary.
//!
//! Blocks of [`BLOCK_EDGE`] samples an edge are the unit of summaries. A summary tells the values
//! of a block without its samples, so that blocks which a transfer function does not show are never
//! read.

#[cfg(feature = "zarr")]
mod cascade;
#[cfg(feature = "zarr")]
mod coding;
mod formula;
mod mean;
mod memory;
#[cfg(feature = "zarr")]
pub mod ome_zarr;
#[cfg(feature = "zarr")]
mod open;
#[cfg(feature = "zarr")]
mod packed;
#[cfg(feature = "zarr")]
mod planes;
#[cfg(feature = "zarr")]
mod raw;
#[cfg(feature = "zarr")]
mod sidecar;
#[cfg(feature = "zarr")]
mod survey;

pub use formula::FormulaSource;
pub use mean::{coarser, halved, halved_lattice, level_lattices};
pub use memory::MemorySource;
pub(crate) use memory::copy_box;
#[cfg(feature = "zarr")]
pub use open::{Packed, is_large, open_source};
#[cfg(feature = "zarr")]
pub use raw::RawSource;

use crate::error::Problem;
use slabcast_common::transfer::Support;
use slabcast_common::volume::{Samples, Volume, VolumeInfo};
use std::sync::Arc;

pub use slabcast_common::block_set::{BLOCK_EDGE, block_dims};
pub use slabcast_common::value_bins::ValueBins;

/// A volume whose samples are read box by box.
///
/// Methods may read files, so call them on threads that may block.
pub trait BlockSource: Send + Sync {
    /// Returns the name for people, without folders.
    fn name(&self) -> &str;

    /// Returns the number type of the samples in the file, for people (`int16`).
    fn file_type(&self) -> &str;

    /// Returns the levels, the finest first; there is at least one. Each has the digest of its own
    /// samples ([`slabcast_common::volume::Volume::digest`]).
    fn levels(&self) -> &[VolumeInfo];

    /// Returns the samples of the box from `lo` to `hi` (exclusive), i fastest.
    ///
    /// # Errors
    /// A file can't be read, or is damaged.
    ///
    /// # Panics
    /// If there is no such level, or the box is empty or reaches out of it.
    fn read_box(&self, level: usize, lo: [u32; 3], hi: [u32; 3]) -> Result<Samples, Problem>;

    /// Returns the block summaries of a level.
    ///
    /// # Errors
    /// A file can't be read, or is damaged.
    ///
    /// # Panics
    /// If there is no such level.
    fn summaries(&self, level: usize) -> Result<Arc<BlockSummaries>, Problem>;

    /// Returns the most bytes of memory that the source may take.
    fn memory_bytes(&self) -> u64;

    /// Returns a level whose samples are all in memory; `None` for other levels.
    fn whole(&self, level: usize) -> Option<&Volume> {
        let _ = level;
        None
    }
}

/// Summary of the values in one block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockSummary {
    /// Bit `b` is set if some sample lies in bin `b` ([`ValueBins`]).
    pub bins: u64,
    /// Whether some sample is NaN.
    pub nan: bool,
}

/// The summaries of all blocks of a level, i fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct BlockSummaries {
    /// Number of blocks along i, j, k.
    pub dims: [u32; 3],
    /// Bins that the summaries refer to.
    pub bins: ValueBins,
    /// A summary for each block.
    pub all: Vec<BlockSummary>,
}

impl BlockSummaries {
    /// Returns the bytes that the summaries take in memory.
    pub fn memory_bytes(&self) -> u64 {
        (self.all.len() * size_of::<BlockSummary>()) as u64
    }
}

impl BlockSummary {
    /// Returns the summary of a block's samples.
    pub fn of(samples: &Samples, bins: &ValueBins) -> BlockSummary {
        fn each<T: Copy + Into<f64>>(samples: &[T], bins: &ValueBins) -> BlockSummary {
            samples.iter().fold(BlockSummary { bins: 0, nan: false }, |all, &code| {
                let code: f64 = code.into();
                if code.is_nan() {
                    return BlockSummary { nan: true, ..all };
                }
                // Infinities count as the nearest finite code, which may be in any bin.
                let seen = if code.is_infinite() { u64::MAX } else { 1 << bins.bin(code) };
                BlockSummary { bins: all.bins | seen, ..all }
            })
        }
        match samples {
            Samples::U8(v) => each(v, bins),
            Samples::U16(v) => each(v, bins),
            Samples::F32(v) => each(v, bins),
        }
    }

    /// Returns whether a block may hold a code of a support whose bins are `mask`
    /// ([`ValueBins::mask`]).
    pub fn meets(&self, mask: u64, support: &Support) -> bool {
        self.bins & mask != 0 || (self.nan && support.nan)
    }
}

/// Computes the block summaries of a level; reads all its samples.
#[cfg(feature = "zarr")]
pub(crate) fn summaries_of(
    source: &dyn BlockSource,
    level: usize,
    bins: ValueBins,
) -> Result<BlockSummaries, Problem> {
    use rayon::prelude::*;
    let size = source.levels()[level].lattice.dims;
    let dims = block_dims(size);
    let count: usize = dims.iter().map(|&n| n as usize).product();
    let of = |i: usize| {
        let [nx, ny, _] = dims.map(|n| n as usize);
        let at = [(i % nx) as u32, (i / nx % ny) as u32, (i / nx / ny) as u32];
        let lo = at.map(|n| n * BLOCK_EDGE);
        let hi = std::array::from_fn(|a| (lo[a] + BLOCK_EDGE).min(size[a]));
        Ok(BlockSummary::of(&source.read_box(level, lo, hi)?, &bins))
    };
    let all: Result<Vec<BlockSummary>, Problem> = (0..count).into_par_iter().map(of).collect();
    Ok(BlockSummaries { dims, bins, all: all? })
}

#[cfg(test)]
mod large_tests;
#[cfg(test)]
mod tests;
