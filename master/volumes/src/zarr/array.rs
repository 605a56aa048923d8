//! One Zarr array: parses its metadata, and decodes its chunks into a volume.

use super::Placed;
use super::codec::{Codecs, Shard};
use super::json::{self, Json};
use crate::error::{OpenErrorKind, Problem};
use crate::limit::ByteCap;
use crate::numbers::Beside;
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
    /// The opened folder, which no chunk's file is outside of.
    pub(super) root: Arc<Folder>,
    /// The array's path in it.
    pub(super) folder: String,
    pub(super) shape: Vec<u64>,
    /// Names of the axes, if the array gives one for each; an axis without a name has an empty one.
    pub(super) names: Option<Vec<String>>,
    /// Shape of a chunk file, which holds one chunk or a shard.
    pub(super) grid: Vec<u64>,
    pub(crate) number: Number,
    pub(super) endian: Endian,
    /// Sample in place of missing chunks, little-endian.
    pub(super) fill: [u8; 8],
    pub(super) key: ChunkKey,
    pub(super) codecs: Codecs,
    pub(super) shard: Option<Shard>,
}

/// How chunk files are named.
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
        let whole =
            array.grid.iter().zip(inner).all(|(g, i)| *g > 0 && *i > 0 && g.is_multiple_of(*i));
        let bytes = inner.iter().try_fold(array.number.bytes(), |n, &s| n.checked_mul(s));
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

    /// Returns the shape that is decoded at a time: a chunk, or an inner chunk of a shard.
    pub(super) fn inner(&self) -> &[u64] {
        self.shard.as_ref().map_or(&self.grid, |s| &s.inner)
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
        let number = kind
            .value
            .as_str()
            .and_then(number)
            .ok_or_else(|| kind.bad("an integer or float type such as uint8 or float32"))?;
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
            endian: codecs.endian,
            fill: fill_bytes(meta.get("fill_value"), number)?,
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
        let number = text.get(1..).and_then(Number::from_numpy).ok_or_else(bad)?;
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
            endian,
            fill: fill_bytes(meta.get("fill_value"), number)?,
            key: ChunkKey {
                prefix: "",
                separator: separator(meta.get("dimension_separator"), '.')?,
            },
            codecs,
            shard: None,
        })
    }

    /// Checks the numbers of files and of inner chunks that reading has to look at.
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

    /// Returns the bytes of the chunk files, or 0 where the limit does not depend on them. Counts
    /// only until the limit is met.
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

    /// Reads the samples along the axes of `placed`. What codes do not hold is left `beside`.
    pub(super) fn read(
        &self,
        placed: &Placed,
        beside: &Beside,
    ) -> Result<(Samples, ValueMap), Problem> {
        let shifted = |offset| ValueMap { scale: 1.0, offset };
        macro_rules! le {
            ($t:ty) => {
                |b: &[u8]| <$t>::from_le_bytes(b.try_into().expect("a word"))
            };
        }
        Ok(match self.number {
            Number::U8 => (Samples::U8(self.collect(placed, |b| b[0])?), ValueMap::IDENTITY),
            Number::I8 => (Samples::U8(self.collect(placed, |b| b[0] ^ 0x80)?), shifted(-128.0)),
            Number::U16 => (Samples::U16(self.collect(placed, le!(u16))?), ValueMap::IDENTITY),
            Number::I16 => {
                let code = |b: &[u8]| le!(u16)(b) ^ 0x8000;
                (Samples::U16(self.collect(placed, code)?), shifted(-32768.0))
            }
            Number::F32 => wide::without_fillers(self.collect(placed, le!(f32))?, beside)?,
            // Their range decides the codes, so all are kept in their type first.
            Number::U32 => wide::compact_integers(self.collect_pieces(placed, le!(u32))?, beside)?,
            Number::I32 => wide::compact_integers(self.collect_pieces(placed, le!(i32))?, beside)?,
            Number::U64 => wide::compact_integers(self.collect_pieces(placed, le!(u64))?, beside)?,
            Number::I64 => wide::compact_integers(self.collect_pieces(placed, le!(i64))?, beside)?,
            Number::F64 => wide::compact_doubles(self.collect_pieces(placed, le!(f64))?, beside)?,
        })
    }

    /// Returns all samples in one list.
    fn collect<T: Copy + Send + Sync>(
        &self,
        placed: &Placed,
        code: impl Fn(&[u8]) -> T + Sync,
    ) -> Result<Vec<T>, Problem> {
        self.layers(placed, 0..self.layer_count(placed), &code)
    }

    /// Returns all samples in pieces of whole layers, which [`wide`] frees one by one.
    fn collect_pieces<T: Copy + Send + Sync>(
        &self,
        placed: &Placed,
        code: impl Fn(&[u8]) -> T + Sync,
    ) -> Result<Vec<Vec<T>>, Problem> {
        let [nx, ny, _] = placed.dims.map(|n| n as usize);
        let count = self.layer_count(placed);
        let layer = nx * ny * self.depth(placed) * size_of::<T>();
        let step = wide::PIECE_BYTES.div_ceil(layer);
        let starts = (0..count).step_by(step);
        starts.map(|z| self.layers(placed, z..count.min(z + step), &code)).collect()
    }

    /// Decodes some layers of chunks, each layer as a task of its own.
    fn layers<T: Copy + Send + Sync>(
        &self,
        placed: &Placed,
        layers: Range<usize>,
        code: &(impl Fn(&[u8]) -> T + Sync),
    ) -> Result<Vec<T>, Problem> {
        let size = self.number.bytes() as usize;
        let [nx, ny, nz] = placed.dims.map(|n| n as usize);
        let depth = self.depth(placed);
        let samples = nx * ny * (nz.min(layers.end * depth) - layers.start * depth);
        let mut out = Vec::new();
        reserve(&mut out, samples)?;
        out.resize(samples, code(&self.fill[..size]));
        let layer = |(z, out): (usize, &mut [T])| self.layer(placed, layers.start + z, out, code);
        // A chunk in memory, compressed and decoded.
        let chunk = 2 * self.inner().iter().product::<u64>() * self.number.bytes();
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
    fn layer<T: Copy>(
        &self,
        placed: &Placed,
        z: usize,
        out: &mut [T],
        code: &impl Fn(&[u8]) -> T,
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
    fn read_file<T: Copy>(
        &self,
        placed: &Placed,
        cell: &[u64],
        layer: &Range<u64>,
        out: &mut [T],
        code: &impl Fn(&[u8]) -> T,
    ) -> Result<(), Problem> {
        let path = json::path(&self.folder, &self.key.path(cell));
        let io = |e: std::io::Error| Problem::io("file", &e);
        let (mut file, len) = match self.root.find(Path::new(&path)).map_err(io)? {
            Inside::File(file, len) => (file, len),
            // A chunk that was never written consists of the fill value.
            Inside::Missing => return Ok(()),
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
        let bytes = (self.inner().iter().product::<u64>() * self.number.bytes()) as usize;
        let first: Vec<u64> = cell.iter().zip(&self.grid).map(|(c, g)| c * g).collect();
        let Some(shard) = &self.shard else {
            let decoded = self.codecs.decode(&mut file, len, bytes)?;
            self.copy(placed, &first, decoded, out, code);
            return Ok(());
        };
        let index = shard.index(&mut file, len, &self.grid)?;
        let counts: Vec<u64> = self.grid.iter().zip(&shard.inner).map(|(g, i)| g / i).collect();
        for (n, (offset, size)) in index.into_iter().enumerate() {
            // The mark of an inner chunk that was never written.
            if (offset, size) == (u64::MAX, u64::MAX) {
                continue;
            }
            let mut corner = first.clone();
            let mut rest = n as u64;
            for a in (0..counts.len()).rev() {
                corner[a] += rest % counts[a] * shard.inner[a];
                rest /= counts[a];
            }
            let wanted = (0..corner.len()).all(|a| match placed.axes {
                [.., Some(z)] if z == a => layer.contains(&corner[a]) && corner[a] < self.shape[a],
                axes if axes.contains(&Some(a)) => corner[a] < self.shape[a],
                _ => (corner[a]..corner[a] + shard.inner[a]).contains(&placed.at[a]),
            });
            if !wanted {
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
            file.seek(SeekFrom::Start(offset)).map_err(io)?;
            let decoded = self.codecs.decode(&mut (&file).take(size), size, bytes)?;
            self.copy(placed, &corner, decoded, out, code);
        }
        Ok(())
    }

    /// Copies a decoded chunk, whose first sample has index `first` in the array, into its layer
    /// `out`.
    fn copy<T: Copy>(
        &self,
        placed: &Placed,
        first: &[u64],
        mut decoded: Vec<u8>,
        out: &mut [T],
        code: &impl Fn(&[u8]) -> T,
    ) {
        let size = self.number.bytes() as usize;
        if self.endian == Endian::Big {
            decoded.chunks_exact_mut(size).for_each(<[u8]>::reverse);
        }
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
                let mut offset = (base + z * sz + y * sy) * size;
                for sample in row {
                    *sample = code(&decoded[offset..offset + size]);
                    offset += sx * size;
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

/// Returns the type that version 3 calls `name`.
fn number(name: &str) -> Option<Number> {
    Number::named(name)
}

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
        None => json.value.as_f64(),
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
