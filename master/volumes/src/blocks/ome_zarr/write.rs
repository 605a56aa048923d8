//! Writes one level as a Zarr array: chunks of 64^3 in shards of 8 x 8 x 8 chunks.
//!
//! A shard grows slab by slab, 64 planes at a time; its index is written after its last plane.
//! Chunks of zeros are left out. The others are Blosc containers of lz4, with a checksum.

use super::super::survey::SQUARE;
use super::super::{BLOCK_EDGE, block_dims};
use crate::error::{OpenErrorKind, Problem};
use crate::zarr::blosc;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Writer of one level, which takes its chunks in order of z.
pub(crate) struct LevelWriter {
    folder: PathBuf,
    dims: [u32; 3],
    /// The shards of the current layer, x fastest.
    shards: Vec<ShardState>,
    /// Shards along x and y.
    across: [u32; 2],
    layer: u32,
}

/// A shard that is being written.
#[derive(Clone, Default)]
struct ShardState {
    len: u64,
    /// Offset and size of each chunk, x fastest; empty for a shard without chunks.
    index: Vec<(u64, u64)>,
}

/// Offset and size of a chunk that is not there.
const MISSING: (u64, u64) = (u64::MAX, u64::MAX);

/// Returns the shape of a level's chunks: 64 along each axis, or the level's side if that is less.
pub(super) fn chunk_shape(dims: [u32; 3]) -> [u32; 3] {
    dims.map(|n| n.min(BLOCK_EDGE))
}

/// Returns the number of chunks in a shard along each axis.
pub(super) fn shard_chunks(dims: [u32; 3]) -> [u32; 3] {
    block_dims(dims).map(|n| n.min(SQUARE))
}

/// Packs a box of numbers into a stored chunk; `None` if all numbers are zero.
pub(crate) fn packed(
    numbers: Vec<u8>,
    size: usize,
    dims: [u32; 3],
    shape: [u32; 3],
) -> Option<Vec<u8>> {
    if numbers.iter().all(|&b| b == 0) {
        return None;
    }
    let whole = match dims == shape {
        true => numbers,
        false => padded(&numbers, size, dims, shape),
    };
    let mut chunk = blosc::encode(&whole, size);
    let sum = crc32c::crc32c(&chunk);
    chunk.extend(sum.to_le_bytes());
    Some(chunk)
}

/// Returns a chunk with a box of numbers at its start, and zeros elsewhere.
fn padded(numbers: &[u8], size: usize, dims: [u32; 3], shape: [u32; 3]) -> Vec<u8> {
    let [nx, ny, nz] = dims.map(|n| n as usize);
    let [sx, sy, sz] = shape.map(|n| n as usize);
    let mut to = vec![0; sx * sy * sz * size];
    for z in 0..nz {
        for y in 0..ny {
            let (from, at) = ((z * ny + y) * nx * size, (z * sy + y) * sx * size);
            to[at..at + nx * size].copy_from_slice(&numbers[from..from + nx * size]);
        }
    }
    to
}

impl LevelWriter {
    /// Begins an array of `dims` samples in a folder, which is made.
    pub(super) fn new(folder: &Path, dims: [u32; 3]) -> Result<LevelWriter, Problem> {
        std::fs::create_dir_all(folder).map_err(|e| written(folder, &e))?;
        let grid = block_dims(dims);
        let across = [grid[0].div_ceil(SQUARE), grid[1].div_ceil(SQUARE)];
        let shards = vec![ShardState::default(); across[0] as usize * across[1] as usize];
        Ok(LevelWriter { folder: folder.into(), dims, shards, across, layer: 0 })
    }

    pub(crate) fn chunk_shape(&self) -> [u32; 3] {
        chunk_shape(self.dims)
    }

    fn path(&self, at: [u32; 2], layer: u32) -> PathBuf {
        self.folder.join(format!("c/{layer}/{}/{}", at[1], at[0]))
    }

    /// Adds the chunks of one shard that lie in layer `z` of chunks, x fastest.
    pub(crate) fn add(
        &mut self,
        at: [u32; 2],
        z: u32,
        chunks: Vec<Option<Vec<u8>>>,
    ) -> Result<(), Problem> {
        let layer = z / SQUARE;
        if layer != self.layer {
            self.end_layer()?;
            self.layer = layer;
        }
        let grid = block_dims(self.dims);
        let per_shard = shard_chunks(self.dims);
        let width = SQUARE.min(grid[0] - at[0] * SQUARE);
        let path = self.path(at, layer);
        let shard = &mut self.shards[(at[1] * self.across[0] + at[0]) as usize];
        let mut bytes = Vec::with_capacity(chunks.iter().flatten().map(Vec::len).sum());
        for (n, chunk) in (0..).zip(chunks) {
            let Some(chunk) = chunk else { continue };
            if shard.index.is_empty() {
                shard.index = vec![MISSING; per_shard.iter().map(|&n| n as usize).product()];
            }
            let [x, y, z] = [n % width, n / width, z % SQUARE];
            let place = (z * per_shard[1] + y) * per_shard[0] + x;
            let offset = shard.len + bytes.len() as u64;
            shard.index[place as usize] = (offset, chunk.len() as u64);
            bytes.extend(chunk);
        }
        if bytes.is_empty() {
            return Ok(());
        }
        let mut file = appended(&path, shard.len == 0)?;
        file.write_all(&bytes).map_err(|e| written(&path, &e))?;
        shard.len += bytes.len() as u64;
        Ok(())
    }

    /// Writes the indices of a layer's shards.
    fn end_layer(&mut self) -> Result<(), Problem> {
        for i in 0..self.shards.len() {
            let shard = std::mem::take(&mut self.shards[i]);
            if shard.index.is_empty() {
                continue;
            }
            let i = i as u32;
            let path = self.path([i % self.across[0], i / self.across[0]], self.layer);
            let words = shard.index.iter().flat_map(|&(offset, size)| [offset, size]);
            let mut index: Vec<u8> = words.flat_map(u64::to_le_bytes).collect();
            let sum = crc32c::crc32c(&index);
            index.extend(sum.to_le_bytes());
            let mut file = appended(&path, false)?;
            file.write_all(&index).map_err(|e| written(&path, &e))?;
        }
        Ok(())
    }

    /// Ends the array.
    pub(crate) fn finish(mut self) -> Result<(), Problem> {
        self.end_layer()
    }
}

/// Opens a file to append to. With `new`, the file and its folders are made.
fn appended(path: &Path, new: bool) -> Result<File, Problem> {
    if new && let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(|e| written(folder, &e))?;
    }
    let file = OpenOptions::new().append(true).create(new).open(path);
    file.map_err(|e| written(path, &e))
}

/// Returns the error for a file that can't be written.
pub(crate) fn written(path: &Path, e: &std::io::Error) -> Problem {
    Problem::new(
        OpenErrorKind::Unreadable,
        "output",
        format!("{} can't be written ({e})", path.display()),
        "make room, or give another place",
    )
}
