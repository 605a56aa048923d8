//! One Zarr array: parses its metadata, and decodes its chunks into a volume.

use super::Placed;
use super::codec::{Codecs, Shard};
use super::json::{self, Json};
use crate::error::{OpenErrorKind, Problem};
use crate::limit::ByteCap;
use crate::numbers::Beside;
use crate::plain::f32_of_half;
use crate::samples::{Endian, Number, reserve};
use crate::source::{Folder, Inside, not_inside};
use crate::wide;
use rayon::prelude::*;
use slabcast_common::volume::{Samples, ValueMap};
use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

/// Most bytes of a decoded chunk. Two (compressed and decoded) stay below the 64 MiB that reading
/// may take beside the voxels.
const CHUNK_MAX_BYTES: u64 = 32 << 20;
/// Most bytes of chunks that all threads decode at once.
const CONCURRENT_MAX_BYTES: u64 = 48 << 20;
/// Most chunk files of a volume. Each is looked for, though none need be there: 3 us for one that
/// is missing, so 3 s. A volume of 2^33 samples has a quarter as many in chunks of 32^3.
const FILES_MAX: u64 = 1 << 20;
/// Most inner chunks of a volume's shards: four for each file, since they cost no look-up.
const INNER_MAX: u64 = 4 * FILES_MAX;
/// Most axes of an array.
const RANK_MAX: usize = 16;

pub(super) fn is_array(root: &Folder, folder: &str) -> bool {
    if root.has(&json::path(folder, ".zarray")) {
        return true;
    }
    let meta = Json::read(root, folder, "zarr.json").ok();
    meta.and_then(|m| m.get("node_type")).is_some_and(|t| t.value == "array")
}

/// An array's metadata.
pub(crate) struct Array {
    /// The opened folder. All chunk files lie in it.
    pub(super) root: Arc<Folder>,
    /// Path of the array in the opened folder.
    pub(super) folder: String,
    pub(super) shape: Vec<u64>,
    /// Names of the axes, if the array gives one for each; an axis without a name has an empty one.
    pub(super) names: Option<Vec<String>>,
    /// Shape of a chunk file, which holds one chunk or a shard.
    pub(super) grid: Vec<u64>,
    /// Type of the samples in memory.
    pub(crate) number: Number,
    /// Name of the samples' type in the file.
    pub(super) kind: &'static str,
    pub(super) endian: Endian,
    /// Sample in place of missing chunks, little-endian.
    pub(super) fill: [u8; 8],
    pub(super) key: ChunkKey,
    pub(super) codecs: Codecs,
    pub(super) shard: Option<Shard>,
}

/// Place of a shard: its bytes in the file, the index of its first sample, and its shape.
struct ShardPlace<'a> {
    at: u64,
    len: u64,
    first: Vec<u64>,
    grid: &'a [u64],
}

/// Rule for the names of chunk files.
pub(super) struct ChunkKey {
    /// First part of the path: `c` in version 3, empty in version 2.
    prefix: &'static str,
    separator: char,
}

impl Array {
    /// Opens the array at a path of the opened folder.
    pub(super) fn open(root: &Arc<Folder>, folder: &str) -> Result<Array, Problem> {
        let read = |name| Json::read(root, folder, name);
        let array = if root.has(&json::path(folder, ".zarray")) {
            Array::version_2(root, folder, &read(".zarray")?)?
        } else {
            Array::version_3(root, folder, &read("zarr.json")?)?
        };
        let (rank, inner) = (array.shape.len(), array.inner());
        if rank == 0 || rank > RANK_MAX || array.grid.len() != rank || inner.len() != rank {
            return Err(Problem::malformed(
                "shape",
                format!("has {rank} axes and chunks of {}", array.grid.len()),
                "write the array again",
            ));
        }
        let mut whole = array.grid.iter().all(|g| *g > 0);
        let (mut outer, mut shard) = (&array.grid, array.shard.as_ref());
        while let Some(Shard { inner, nested, .. }) = shard {
            let divides = |(g, i): (&u64, &u64)| *i > 0 && g.is_multiple_of(*i);
            whole &= inner.len() == rank && outer.iter().zip(inner).all(divides);
            (outer, shard) = (inner, nested.as_deref());
        }
        let bytes = inner.iter().try_fold(array.stored_size(), |n, &s| n.checked_mul(s));
        match bytes {
            Some(bytes) if whole && bytes <= CHUNK_MAX_BYTES => Ok(array),
            Some(_) if !whole => Err(Problem::malformed(
                "chunk_shape",
                format!("{:?} in {:?} is not even", inner, array.grid),
                "write the array again",
            )),
            _ => Err(Problem::new(
                OpenErrorKind::TooLarge,
                "chunk_shape",
                format!(
                    "chunks of {inner:?} take more than the {CHUNK_MAX_BYTES} bytes that are read"
                ),
                "write the array again with smaller chunks, or in shards",
            )),
        }
    }

    /// Returns the size of a sample in a decoded chunk, in bytes.
    fn stored_size(&self) -> u64 {
        if self.kind == HALF { 2 } else { self.number.bytes() }
    }

    /// Returns the shape of the smallest unit that can be decoded: a chunk, or an inner chunk of a
    /// shard.
    pub(super) fn inner(&self) -> &[u64] {
        self.shard.as_ref().map_or(&self.grid, |s| s.innermost())
    }

    fn version_3(root: &Arc<Folder>, folder: &str, meta: &Json) -> Result<Array, Problem> {
        if meta.required("zarr_format")?.value != 3 || meta.required("node_type")?.value != "array"
        {
            return Err(meta.required("node_type")?.bad("an array of Zarr version 3"));
        }
        let grid = meta.required("chunk_grid")?;
        if grid.required("name")?.text()? != "regular" {
            return Err(grid.required("name")?.bad("regular"));
        }
        let grid = grid.required("configuration")?.required("chunk_shape")?.sizes()?;
        let kind = meta.required("data_type")?;
        let (number, name) =
            kind.value.as_str().and_then(number).ok_or_else(|| {
                kind.bad("bool, an integer or float type such as uint8 or float32")
            })?;
        let encoding = meta.required("chunk_key_encoding")?;
        let asked = encoding.get("configuration").and_then(|c| c.get("separator"));
        let (prefix, usual) = match encoding.required("name")?.text()? {
            "default" => ("c", '/'),
            "v2" => ("", '.'),
            _ => return Err(encoding.bad("default or v2")),
        };
        let separator = separator(asked, usual)?;
        let (codecs, shard) = Codecs::version_3(&meta.required("codecs")?, &grid)?;
        Ok(Array {
            root: root.clone(),
            folder: folder.into(),
            shape: meta.required("shape")?.sizes()?,
            names: names(meta.get("dimension_names")).or_else(|| {
                let attributes = meta.get("attributes")?;
                names(attributes.get("_ARRAY_DIMENSIONS"))
            }),
            grid,
            number,
            kind: name,
            endian: codecs.endian,
            fill: stored_fill(fill_bytes(meta.get("fill_value"), number)?, name),
            key: ChunkKey { prefix, separator },
            codecs,
            shard,
        })
    }

    fn version_2(root: &Arc<Folder>, folder: &str, meta: &Json) -> Result<Array, Problem> {
        let kind = meta.required("dtype")?;
        let bad = || kind.bad("an integer or float type such as |u1, <i2 or <f4");
        let text = kind.value.as_str().ok_or_else(bad)?;
        let endian = if text.starts_with('>') { Endian::Big } else { Endian::Little };
        let (number, name) = match text.get(1..).ok_or_else(bad)? {
            "b1" => (Number::U8, BOOL),
            "f2" => (Number::F32, HALF),
            name => Number::from_numpy(name).map(|n| (n, n.name())).ok_or_else(bad)?,
        };
        let grid = meta.required("chunks")?.sizes()?;
        let codecs = Codecs::version_2(meta, endian, grid.len())?;
        // xarray writes the names beside the array.
        let attributes = root.has(&json::path(folder, ".zattrs"));
        let attributes = attributes.then(|| Json::read(root, folder, ".zattrs")).transpose()?;
        Ok(Array {
            root: root.clone(),
            folder: folder.into(),
            shape: meta.required("shape")?.sizes()?,
            names: attributes.and_then(|a| names(a.get("_ARRAY_DIMENSIONS"))),
            grid,
            number,
            kind: name,
            endian,
            fill: stored_fill(fill_bytes(meta.get("fill_value"), number)?, name),
            key: ChunkKey {
                prefix: "",
                separator: separator(meta.get("dimension_separator"), '.')?,
            },
            codecs,
            shard: None,
        })
    }

    /// Checks that reading needs at most [`FILES_MAX`] files and [`INNER_MAX`] inner chunks.
    pub(crate) fn check_counts(&self, placed: &Placed) -> Result<(), Problem> {
        let along = |step: &[u64]| {
            placed.axes.iter().flatten().map(|&a| self.shape[a].div_ceil(step[a])).product::<u64>()
        };
        // All three sizes are at most 2^14.
        let refused = |count: u64, most: u64, what: &str, remedy: &str| {
            Err(Problem::new(
                OpenErrorKind::TooLarge,
                "chunk_shape",
                format!("{count} {what} are more than {most}"),
                remedy,
            ))
        };
        let (files, inner) = (along(&self.grid), along(self.inner()));
        if files > FILES_MAX {
            let remedy = "write the array again with larger chunks, or in shards";
            return refused(files, FILES_MAX, "chunk files", remedy);
        }
        if inner > INNER_MAX {
            return refused(
                inner,
                INNER_MAX,
                "inner chunks",
                "write the array again with larger chunks",
            );
        }
        Ok(())
    }

    /// Returns the grid position of the chunk that holds the volume's first sample.
    fn first_cell(&self, placed: &Placed) -> Vec<u64> {
        placed.at.iter().zip(&self.grid).map(|(at, grid)| at / grid).collect()
    }

    /// Returns the size of the chunk files in bytes, or 0 if the limit of samples does not depend
    /// on it. Stops counting once the limit is reached.
    pub(super) fn stored_bytes(&self, cap: &ByteCap, placed: &Placed) -> u64 {
        let enough = cap.stored_for(placed.bytes(self));
        let mut stored = 0;
        let mut cell = self.first_cell(placed);
        let count =
            |axis: usize| placed.axes[axis].map_or(1, |a| self.shape[a].div_ceil(self.grid[a]));
        let [nx, ny, nz] = [0, 1, 2].map(count);
        let mut cells =
            (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])));
        while stored < enough
            && let Some(at) = cells.next()
        {
            for (axis, n) in placed.axes.iter().zip(at) {
                if let Some(a) = axis {
                    cell[*a] = n;
                }
            }
            let path = json::path(&self.folder, &self.key.path(&cell));
            if let Ok(Inside::File(_, len)) = self.root.find(Path::new(&path)) {
                stored += len;
            }
        }
        stored
    }

    /// Reads the samples along the axes of `placed`; returns codes and their map to numbers.
    /// Numbers that codes round are kept in `beside`.
    pub(super) fn read(
        &self,
        placed: &Placed,
        beside: &Beside,
    ) -> Result<(Samples, ValueMap), Problem> {
        let shifted = |offset| ValueMap { scale: 1.0, offset };
        macro_rules! le {
            ($t:ty) => {
                <$t>::from_le_bytes
            };
        }
        Ok(match self.number {
            Number::U8 => (Samples::U8(self.collect(placed, le!(u8))?), ValueMap::IDENTITY),
            Number::I8 => (Samples::U8(self.collect(placed, |[b]| b ^ 0x80)?), shifted(-128.0)),
            Number::U16 => (Samples::U16(self.collect(placed, le!(u16))?), ValueMap::IDENTITY),
            Number::I16 => {
                let code = |b| u16::from_le_bytes(b) ^ 0x8000;
                (Samples::U16(self.collect(placed, code)?), shifted(-32768.0))
            }
            Number::F32 if self.kind == HALF => {
                let code = |b| f32_of_half(u16::from_le_bytes(b));
                wide::without_fillers(self.collect(placed, code)?, beside)?
            }
            Number::F32 => wide::without_fillers(self.collect(placed, le!(f32))?, beside)?,
            // The range of all samples decides the codes, so they are first collected in their own
            // type.
            Number::U32 => wide::compact_integers(self.collect_pieces(placed, le!(u32))?, beside)?,
            Number::I32 => wide::compact_integers(self.collect_pieces(placed, le!(i32))?, beside)?,
            Number::U64 => wide::compact_integers(self.collect_pieces(placed, le!(u64))?, beside)?,
            Number::I64 => wide::compact_integers(self.collect_pieces(placed, le!(i64))?, beside)?,
            Number::F64 => wide::compact_doubles(self.collect_pieces(placed, le!(f64))?, beside)?,
        })
    }

    /// Returns all samples in one list.
    fn collect<T: Copy + Default + Send + Sync, const N: usize>(
        &self,
        placed: &Placed,
        code: impl Fn([u8; N]) -> T + Sync,
    ) -> Result<Vec<T>, Problem> {
        self.layers(placed, 0..self.layer_count(placed), &code)
    }

    /// Returns all samples in pieces of whole layers, which [`wide`] frees one by one.
    fn collect_pieces<T: Copy + Default + Send + Sync, const N: usize>(
        &self,
        placed: &Placed,
        code: impl Fn([u8; N]) -> T + Sync,
    ) -> Result<Vec<Vec<T>>, Problem> {
        let [nx, ny, _] = placed.dims.map(|n| n as usize);
        let count = self.layer_count(placed);
        let layer = nx * ny * self.depth(placed) * size_of::<T>();
        let step = wide::PIECE_BYTES.div_ceil(layer);
        let starts = (0..count).step_by(step);
        starts.map(|z| self.layers(placed, z..count.min(z + step), &code)).collect()
    }

    /// Decodes some layers of chunks, each layer as a task of its own.
    fn layers<T: Copy + Default + Send + Sync, const N: usize>(
        &self,
        placed: &Placed,
        layers: Range<usize>,
        code: &(impl Fn([u8; N]) -> T + Sync),
    ) -> Result<Vec<T>, Problem> {
        let [nx, ny, nz] = placed.dims.map(|n| n as usize);
        let depth = self.depth(placed);
        let samples = nx * ny * (nz.min(layers.end * depth) - layers.start * depth);
        // Zeros from the system, so that the threads which fill pages also touch them first.
        reserve(&mut Vec::<T>::new(), samples)?;
        let mut out = vec![T::default(); samples];
        let layer = |(z, out): (usize, &mut [T])| self.layer(placed, layers.start + z, out, code);
        // A chunk in memory, compressed and decoded.
        let chunk = 2 * self.inner().iter().product::<u64>() * self.stored_size();
        if chunk * rayon::current_num_threads() as u64 <= CONCURRENT_MAX_BYTES {
            out.par_chunks_mut(nx * ny * depth).enumerate().try_for_each(layer)?;
        } else {
            out.chunks_mut(nx * ny * depth).enumerate().try_for_each(layer)?;
        }
        Ok(out)
    }

    /// Returns the samples along z of a layer. A layer is one chunk deep, or several inner chunks
    /// of a shard, since a shard's index is read for each layer. (A chunk may be deeper than the
    /// array.)
    fn depth(&self, placed: &Placed) -> usize {
        let Some(a) = placed.axes[2] else { return 1 };
        let (inner, grid) = (self.inner()[a], self.grid[a]);
        // A layer must not cross the end of a shard.
        let fits = |n: &u64| (grid / inner).is_multiple_of(*n) && inner.saturating_mul(*n) >= 16;
        let chunks = (1..=64).find(fits).unwrap_or(1);
        inner.saturating_mul(chunks).min(placed.dims[2]) as usize
    }

    fn layer_count(&self, placed: &Placed) -> usize {
        (placed.dims[2] as usize).div_ceil(self.depth(placed))
    }

    /// Decodes the chunks of layer `z` into `out`.
    fn layer<T: Copy, const N: usize>(
        &self,
        placed: &Placed,
        z: usize,
        out: &mut [T],
        code: &impl Fn([u8; N]) -> T,
    ) -> Result<(), Problem> {
        let mut cell = self.first_cell(placed);
        let depth = self.depth(placed) as u64;
        let layer = z as u64 * depth..(z as u64 + 1) * depth;
        if let Some(a) = placed.axes[2] {
            cell[a] = layer.start / self.grid[a];
        }
        let count =
            |axis: usize| placed.axes[axis].map_or(1, |a| self.shape[a].div_ceil(self.grid[a]));
        for y in 0..count(1) {
            for x in 0..count(0) {
                for (axis, n) in [(0, x), (1, y)] {
                    if let Some(a) = placed.axes[axis] {
                        cell[a] = n;
                    }
                }
                self.read_file(placed, &cell, &layer, out, code).map_err(|mut p| {
                    p.field = format!("chunk {} {}", self.key.path(&cell), p.field);
                    p
                })?;
            }
        }
        Ok(())
    }

    /// Decodes the chunk at grid position `cell`, or the inner chunks of its shard that lie in
    /// `layer`.
    fn read_file<T: Copy, const N: usize>(
        &self,
        placed: &Placed,
        cell: &[u64],
        layer: &Range<u64>,
        out: &mut [T],
        code: &impl Fn([u8; N]) -> T,
    ) -> Result<(), Problem> {
        let path = json::path(&self.folder, &self.key.path(cell));
        let first: Vec<u64> = cell.iter().zip(&self.grid).map(|(c, g)| c * g).collect();
        let io = |e: std::io::Error| Problem::io("file", &e);
        let (mut file, len) = match self.root.find(Path::new(&path)).map_err(io)? {
            Inside::File(file, len) => (file, len),
            // A chunk that was never written consists of the fill value.
            Inside::Missing => {
                self.fill(placed, (&first, &self.grid), layer, out, code);
                return Ok(());
            }
            Inside::Out => return Err(not_inside("its file", "file")),
            Inside::Other => {
                return Err(Problem::new(
                    OpenErrorKind::Forbidden,
                    "file",
                    "is a pipe, a folder or a device, and was not read",
                    "get the array again",
                ));
            }
        };
        let Some(shard) = &self.shard else {
            self.copy(placed, &first, &self.decode::<N>(&mut file, len)?, out, code);
            return Ok(());
        };
        let place = ShardPlace { at: 0, len, first, grid: &self.grid };
        self.read_shard(placed, (shard, place), &mut file, layer, out, code)
    }

    /// Decodes a chunk of `len` bytes to numbers in little-endian order.
    fn decode<const N: usize>(&self, from: &mut dyn Read, len: u64) -> Result<Vec<u8>, Problem> {
        let mut decoded = self.codecs.decode(from, len, self.chunk_bytes())?;
        if self.endian == Endian::Big {
            decoded.chunks_exact_mut(N).for_each(<[u8]>::reverse);
        }
        Ok(decoded)
    }

    /// Returns the size of a decoded chunk in bytes.
    fn chunk_bytes(&self) -> usize {
        (self.inner().iter().product::<u64>() * self.stored_size()) as usize
    }

    /// Decodes the chunks of a shard that lie in `layer` into `out`. A shard's chunks may be
    /// shards.
    fn read_shard<T: Copy, const N: usize>(
        &self,
        placed: &Placed,
        (shard, place): (&Shard, ShardPlace<'_>),
        file: &mut std::fs::File,
        layer: &Range<u64>,
        out: &mut [T],
        code: &impl Fn([u8; N]) -> T,
    ) -> Result<(), Problem> {
        let io = |e: std::io::Error| Problem::io("file", &e);
        let ShardPlace { at, len, first, grid } = place;
        let index = shard.index(file, (at, len), grid)?;
        let counts: Vec<u64> = grid.iter().zip(&shard.inner).map(|(g, i)| g / i).collect();
        for (n, (offset, size)) in index.into_iter().enumerate() {
            let mut corner = first.clone();
            let mut rest = n as u64;
            for a in (0..counts.len()).rev() {
                corner[a] += rest % counts[a] * shard.inner[a];
                rest /= counts[a];
            }
            let wanted = (0..corner.len()).all(|a| match placed.axes {
                [.., Some(z)] if z == a => {
                    let end = corner[a] + shard.inner[a];
                    corner[a] < layer.end && layer.start < end && corner[a] < self.shape[a]
                }
                axes if axes.contains(&Some(a)) => corner[a] < self.shape[a],
                _ => (corner[a]..corner[a] + shard.inner[a]).contains(&placed.at[a]),
            });
            if !wanted {
                continue;
            }
            // The mark of an inner chunk that was never written.
            if (offset, size) == (u64::MAX, u64::MAX) {
                self.fill(placed, (&corner, &shard.inner), layer, out, code);
                continue;
            }
            if offset.checked_add(size).is_none_or(|end| end > len) {
                return Err(Problem::new(
                    OpenErrorKind::Damaged,
                    "index",
                    format!("says that inner chunk {n} lies beyond the file's {len} bytes"),
                    "get the array again",
                ));
            }
            if let Some(nested) = &shard.nested {
                let grid = &shard.inner;
                let place = ShardPlace { at: at + offset, len: size, first: corner, grid };
                self.read_shard(placed, (nested, place), file, layer, out, code)?;
                continue;
            }
            file.seek(SeekFrom::Start(at + offset)).map_err(io)?;
            let decoded = self.decode::<N>(&mut (&*file).take(size), size)?;
            self.copy(placed, &corner, &decoded, out, code);
        }
        Ok(())
    }

    /// Puts the fill value in place of a chunk of `shape`, whose first sample has index `first` in
    /// the array, where it lies in `layer`.
    fn fill<T: Copy, const N: usize>(
        &self,
        placed: &Placed,
        (first, shape): (&[u64], &[u64]),
        layer: &Range<u64>,
        out: &mut [T],
        code: &impl Fn([u8; N]) -> T,
    ) {
        let along = |axis: usize| match placed.axes[axis] {
            None => 0..1,
            Some(a) => first[a]..first[a].saturating_add(shape[a]).min(self.shape[a]),
        };
        let [xs, ys, zs] = [0, 1, 2].map(along);
        let [width, height, _] = placed.dims.map(|n| n as usize);
        let value = code(*self.fill.first_chunk().expect("a sample has at most eight bytes"));
        for z in zs.start.max(layer.start)..zs.end.min(layer.end) {
            for y in ys.clone() {
                let row = ((z - layer.start) as usize * height + y as usize) * width;
                out[row + xs.start as usize..row + xs.end.max(xs.start) as usize].fill(value);
            }
        }
    }

    /// Copies a decoded chunk, whose first sample has index `first` in the array, into its layer
    /// `out`.
    fn copy<T: Copy, const N: usize>(
        &self,
        placed: &Placed,
        first: &[u64],
        decoded: &[u8],
        out: &mut [T],
        code: &impl Fn([u8; N]) -> T,
    ) {
        let (decoded, _) = decoded.as_chunks::<N>();
        let strides = self.codecs.strides(self.inner());
        // For each of x, y, z: the chunk's first index, its samples inside the array, and their
        // stride in the chunk.
        let along = |axis: usize| match placed.axes[axis] {
            None => (0, 1, 0),
            Some(a) => {
                let inside = self.shape[a].saturating_sub(first[a]).min(self.inner()[a]);
                (first[a] as usize, inside as usize, strides[a])
            }
        };
        let [(x0, nx, sx), (y0, ny, sy), (z0, nz, sz)] = [along(0), along(1), along(2)];
        // Place in the chunk of the volume's index along the other axes.
        let other = |a: &usize| !placed.axes.contains(&Some(*a));
        let base: usize = (0..strides.len())
            .filter(other)
            .map(|a| (placed.at[a] - first[a]) as usize * strides[a])
            .sum();
        let [width, height, _] = placed.dims.map(|n| n as usize);
        let depth = self.depth(placed);
        for z in 0..nz {
            for y in 0..ny {
                let start = (((z0 + z) % depth) * height + y0 + y) * width + x0;
                let row = &mut out[start..start + nx];
                let from = base + z * sz + y * sy;
                // Mostly samples of a row lie beside each other.
                if sx == 1 {
                    let from = &decoded[from..from + nx];
                    row.iter_mut().zip(from).for_each(|(sample, from)| *sample = code(*from));
                } else {
                    let from = decoded[from..].iter().step_by(sx.max(1));
                    row.iter_mut().zip(from).for_each(|(sample, from)| *sample = code(*from));
                }
            }
        }
    }
}

impl ChunkKey {
    /// Returns the path of the chunk file at grid position `cell`.
    pub(super) fn path(&self, cell: &[u64]) -> String {
        let numbers = cell.iter().map(u64::to_string);
        let prefix = (!self.prefix.is_empty()).then(|| self.prefix.to_string());
        prefix.into_iter().chain(numbers).collect::<Vec<_>>().join(&self.separator.to_string())
    }
}

/// Returns the names of axes in a list of texts and nulls.
fn names(list: Option<Json>) -> Option<Vec<String>> {
    let list = list?;
    let list = list.value.as_array()?;
    Some(list.iter().map(|n| n.as_str().unwrap_or_default().to_string()).collect())
}

fn separator(asked: Option<Json>, usual: char) -> Result<char, Problem> {
    match &asked {
        None => Ok(usual),
        Some(json) => match json.value.as_str() {
            Some("/") => Ok('/'),
            Some(".") => Ok('.'),
            _ => Err(json.bad("/ or .")),
        },
    }
}

/// Names of types that are read as others: truth as bytes, 16-bit floats as 32-bit ones.
const BOOL: &str = "bool";
const HALF: &str = "float16";

/// Returns the type of samples that version 3 calls `name`, and its name.
fn number(name: &str) -> Option<(Number, &'static str)> {
    match name {
        BOOL => Some((Number::U8, BOOL)),
        HALF => Some((Number::F32, HALF)),
        name => Number::named(name).map(|n| (n, n.name())),
    }
}

/// Returns the fill value in the array's stored type: float16 takes two bytes.
fn stored_fill(bytes: [u8; 8], kind: &str) -> [u8; 8] {
    if kind != HALF {
        return bytes;
    }
    let value = f32::from_le_bytes(*bytes.first_chunk().expect("eight bytes"));
    let is_it = |half: &u16| {
        let held = f32_of_half(*half);
        held == value || (held.is_nan() && value.is_nan())
    };
    let half = (0..=u16::MAX).find(is_it).unwrap_or(HALF_NAN);
    let mut stored = [0; 8];
    stored[..2].copy_from_slice(&half.to_le_bytes());
    stored
}

/// A float16 that is NaN.
const HALF_NAN: u16 = 0x7e00;

/// Returns the fill value as little-endian bytes of a sample.
fn fill_bytes(value: Option<Json>, number: Number) -> Result<[u8; 8], Problem> {
    let mut bytes = [0; 8];
    let Some(json) = value else { return Ok(bytes) };
    let text = json.value.as_str();
    let float = match text {
        Some("NaN") => Some(f64::NAN),
        Some("Infinity") => Some(f64::INFINITY),
        Some("-Infinity") => Some(f64::NEG_INFINITY),
        Some(_) => None,
        None => json.value.as_f64().or(json.value.as_bool().map(|b| f64::from(u8::from(b)))),
    };
    let bad = || json.bad(&format!("a value of {}", number.name()));
    let float = float.ok_or_else(bad)?;
    match number.limits() {
        Some((lo, hi)) if !(lo..=hi).contains(&float) => return Err(bad()),
        _ => {}
    }
    macro_rules! put {
        ($x:expr) => {{
            let le = $x.to_le_bytes();
            bytes[..le.len()].copy_from_slice(&le);
        }};
    }
    match number {
        Number::U8 => put!(float as u8),
        Number::I8 => put!(float as i8),
        Number::U16 => put!(float as u16),
        Number::I16 => put!(float as i16),
        Number::U32 => put!(float as u32),
        Number::I32 => put!(float as i32),
        Number::U64 => put!(json.value.as_u64().unwrap_or(float as u64)),
        Number::I64 => put!(json.value.as_i64().unwrap_or(float as i64)),
        Number::F32 => put!(float as f32),
        Number::F64 => put!(float),
    }
    Ok(bytes)
}
