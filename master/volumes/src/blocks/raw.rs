//! Source of boxes from an uncompressed file: raw numbers, NRRD, MetaImage or NIfTI. It has one
//! level.

use super::coding::Coding;
use super::ome_zarr::{OnProgress, blocks_again, infos, walk};
use super::planes::Planes;
use super::sidecar::{self, Facts, Identity};
use super::{BlockSource, BlockSummaries};
use crate::Hints;
use crate::error::Problem;
use crate::samples::Endian;
use crate::zarr::chunks::{fill_at, read_at, replaced};
use sha2::{Digest, Sha256};
use slabcast_common::volume::{Samples, VolumeInfo};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

/// Bytes at each end of a file that its identity is computed from.
const ENDS_BYTES: u64 = 64 << 10;
/// Most bytes that one call reads where the rows of a box lie apart: at 1 GB/s it takes as long as
/// 50 calls.
const SPAN_BYTES: u64 = 64 << 10;

/// An uncompressed file whose boxes are read by their offsets.
pub struct RawSource {
    name: String,
    file_type: String,
    file: File,
    /// Byte of the first sample.
    start: u64,
    endian: Endian,
    coding: Coding,
    levels: Vec<VolumeInfo>,
    blocks: Arc<BlockSummaries>,
    stamp: (u64, Option<SystemTime>),
}

/// Returns the length of a file and when it was changed.
pub(super) fn stamp(file: &File) -> Result<(u64, Option<SystemTime>), Problem> {
    let meta = file.metadata().map_err(|e| Problem::io("file", &e))?;
    Ok((meta.len(), meta.modified().ok()))
}

impl RawSource {
    /// Opens a file; `None` if its samples are compressed or lie in several places. Block summaries
    /// come from the sidecar in `cache`. Without one, a pass reads all samples, calls
    /// `on_progress`, and writes a sidecar into `cache`.
    ///
    /// # Errors
    /// The file can't be read or is damaged; `on_progress` returned an error.
    pub fn open(
        path: &Path,
        hints: &Hints,
        cache: Option<&Path>,
        on_progress: &mut OnProgress<'_>,
    ) -> Result<Option<RawSource>, Problem> {
        let mut planes = Planes::open(path, hints)?;
        let Some((file, start, endian)) = planes.place.take() else { return Ok(None) };
        let stamp = stamp(&file)?;
        let identity = identity(&planes, (&file, start, endian), stamp)?;
        let lattices = [planes.lattice];
        let beside = cache.map(|cache| sidecar::in_cache(cache, &identity));
        let read = |path: &PathBuf| Facts::read(path, &identity, &lattices);
        let source = |facts: &Facts, file: File| RawSource {
            name: planes.name.clone(),
            file_type: planes.file_type.clone(),
            file,
            start,
            endian,
            coding: facts.coding.clone(),
            levels: infos(&lattices, facts),
            blocks: facts.levels[0].blocks.clone(),
            stamp,
        };
        if let Some(facts) = beside.as_ref().and_then(read) {
            return Ok(Some(source(&facts, file)));
        }
        let facts = match walk(&planes, &lattices, None, on_progress)?.facts {
            Ok(facts) => facts,
            Err(unfinished) => {
                let again = file.try_clone().map_err(|e| Problem::io("file", &e))?;
                let blind = unfinished.blind(&lattices);
                blocks_again(&source(&blind, again), unfinished)?
            }
        };
        if let Some(path) = &beside {
            // Without a writable cache the next run surveys the file again.
            let _ = facts.write(path, &identity);
        }
        Ok(Some(source(&facts, file)))
    }

    /// Reads the numbers of a box, as little-endian bytes.
    fn numbers(&self, lo: [u32; 3], hi: [u32; 3]) -> Result<Vec<u8>, Problem> {
        let size = self.coding.number.bytes();
        let [nx, ny, _] = self.levels[0].lattice.dims.map(u64::from);
        let [width, height, _]: [u64; 3] = std::array::from_fn(|a| u64::from(hi[a] - lo[a]));
        let count = width * height * u64::from(hi[2] - lo[2]);
        let mut out = Vec::new();
        crate::samples::reserve(&mut out, (count * size) as usize)?;
        let (row, stride) = (width * size, nx * size);
        // Rows that lie close are read in one call, with the bytes between them.
        let at_once = if stride <= 4 * row { height } else { (SPAN_BYTES / stride).max(1) };
        for z in lo[2]..hi[2] {
            let mut y = u64::from(lo[1]);
            while y < u64::from(hi[1]) {
                let rows = at_once.min(u64::from(hi[1]) - y);
                let first = (u64::from(z) * ny + y) * nx + u64::from(lo[0]);
                let at = self.start + first * size;
                if width == nx || rows == 1 {
                    let old = out.len();
                    out.resize(old + (rows * row) as usize, 0);
                    fill_at(&self.file, at, &mut out[old..])?;
                } else {
                    let span = (rows - 1) * stride + row;
                    let bytes = read_at(&self.file, at, span as usize)?;
                    for r in 0..rows {
                        let from = (r * stride) as usize;
                        out.extend_from_slice(&bytes[from..from + row as usize]);
                    }
                }
                y += rows;
            }
        }
        if self.endian == Endian::Big {
            out.chunks_exact_mut(size as usize).for_each(<[u8]>::reverse);
        }
        Ok(out)
    }
}

impl BlockSource for RawSource {
    fn name(&self) -> &str {
        &self.name
    }

    fn file_type(&self) -> &str {
        &self.file_type
    }

    fn levels(&self) -> &[VolumeInfo] {
        &self.levels
    }

    fn read_box(&self, level: usize, lo: [u32; 3], hi: [u32; 3]) -> Result<Samples, Problem> {
        let dims = self.levels[level].lattice.dims;
        assert!((0..3).all(|a| lo[a] < hi[a] && hi[a] <= dims[a]), "a box inside");
        let numbers = self.numbers(lo, hi)?;
        // Checked after reading: a file replaced meanwhile gives bytes of both files.
        if stamp(&self.file)? != self.stamp {
            return Err(replaced("file"));
        }
        let mut codes = Samples::empty(self.coding.kind());
        self.coding.encode(&numbers, &mut codes);
        Ok(codes)
    }

    fn summaries(&self, level: usize) -> Result<Arc<BlockSummaries>, Problem> {
        assert_eq!(level, 0, "a file of samples has one level");
        Ok(self.blocks.clone())
    }

    fn memory_bytes(&self) -> u64 {
        self.blocks.memory_bytes()
    }
}

/// Returns the identity of a file: a digest of its size, its time of change, both ends, and the
/// facts of its header.
fn identity(
    planes: &Planes,
    (file, start, endian): (&File, u64, Endian),
    (len, changed): (u64, Option<SystemTime>),
) -> Result<Identity, Problem> {
    let mut hash = Sha256::new();
    hash.update(b"slabcast raw 1");
    hash.update(start.to_le_bytes());
    hash.update([u8::from(endian == Endian::Big)]);
    ends(file, (len, changed), &mut hash)?;
    describe(planes, &mut hash);
    Ok(hash.finalize().into())
}

/// Adds a file's length, time and ends to a hash.
///
/// # Errors
/// The file can't be read.
pub(super) fn ends(
    file: &File,
    (len, changed): (u64, Option<SystemTime>),
    hash: &mut Sha256,
) -> Result<(), Problem> {
    let since = changed.and_then(|t| t.duration_since(UNIX_EPOCH).ok());
    hash.update(len.to_le_bytes());
    hash.update(since.map_or(0, |t| t.as_nanos()).to_le_bytes());
    for at in [0, len.saturating_sub(ENDS_BYTES)] {
        hash.update(read_at(file, at, ENDS_BYTES.min(len - at) as usize)?);
    }
    Ok(())
}

/// Adds what a header says to a hash.
pub(super) fn describe(planes: &Planes, hash: &mut Sha256) {
    let (lattice, map) = (planes.lattice, planes.rescale);
    hash.update(planes.number.name());
    hash.update([planes.anatomical.into()]);
    lattice.dims.iter().for_each(|n| hash.update(n.to_le_bytes()));
    let steps = lattice.steps.iter().flat_map(|s| s.to_array());
    let numbers = steps.chain(lattice.origin.to_array()).chain([map.scale, map.offset]);
    numbers.for_each(|x| hash.update(x.to_le_bytes()));
}
