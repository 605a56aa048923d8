//! Reads chunks of an array one by one, at any time after it was opened.
//!
//! The files of an array are listed when it is opened ([`Listing`]). Each file is checked against
//! the list before it is read. So a file that was removed, cut off or replaced is an error; it is
//! not taken for a chunk that was never written.

use super::array::Array;
use super::json;
use super::{Placed, codec};
use crate::error::{OpenErrorKind, Problem, quoted};
use crate::samples::Endian;
use crate::source::{Inside, not_inside};
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

/// Most files of all levels of a picture. A volume of 2^40 samples in shards of 512^3 has 8192.
const FILES_MAX: usize = 1 << 20;
/// Most folders below one another.
const DEPTH_MAX: u32 = 20;
/// Most files that are open at once. Each holds the index of its shard, 8 KiB.
const OPEN_MAX: usize = 128;

/// Length and time of change of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stamp {
    pub(crate) len: u64,
    pub(crate) changed: Option<SystemTime>,
}

impl Stamp {
    fn of(meta: &std::fs::Metadata) -> Stamp {
        Stamp { len: meta.len(), changed: meta.modified().ok() }
    }

    /// Returns the stamp of the file at a path.
    pub(crate) fn of_path(path: &Path) -> std::io::Result<Stamp> {
        std::fs::metadata(path).map(|meta| Stamp::of(&meta))
    }
}

/// The files of a picture, by their path in its folder.
#[derive(Debug, Default)]
pub(crate) struct Listing(BTreeMap<String, Stamp>);

impl Listing {
    /// Lists all files below a folder, except hidden ones.
    ///
    /// # Errors
    /// A folder can't be read, or there are too many files.
    pub(crate) fn read(folder: &Path) -> Result<Listing, Problem> {
        let mut listing = Listing::default();
        listing.add(folder, "", 0)?;
        Ok(listing)
    }

    fn add(&mut self, folder: &Path, path: &str, depth: u32) -> Result<(), Problem> {
        let io = |e: std::io::Error| Problem::io("folder", &e);
        for entry in std::fs::read_dir(folder).map_err(io)? {
            let entry = entry.map_err(io)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            // Zarr's own hidden files have these names.
            if name.starts_with('.') && ![".zarray", ".zattrs", ".zgroup"].contains(&&name[..]) {
                continue;
            }
            let below = json::path(path, &name);
            let meta = std::fs::metadata(entry.path()).map_err(io)?;
            if meta.is_dir() {
                if depth == DEPTH_MAX {
                    return Err(Problem::malformed(
                        "folder",
                        format!("{} has folders within folders beyond all use", quoted(&below)),
                        "give the folder of the picture",
                    ));
                }
                self.add(&entry.path(), &below, depth + 1)?;
            } else {
                self.0.insert(below, Stamp::of(&meta));
            }
            if self.0.len() > FILES_MAX {
                return Err(Problem::new(
                    OpenErrorKind::TooLarge,
                    "folder",
                    format!("has more than {FILES_MAX} files"),
                    "write it again in shards",
                ));
            }
        }
        Ok(())
    }

    /// Iterates over all files.
    pub(crate) fn files(&self) -> impl Iterator<Item = (&str, Stamp)> {
        self.0.iter().map(|(path, stamp)| (path.as_str(), *stamp))
    }
}

/// An open file of chunks.
struct ChunkFile {
    file: File,
    len: u64,
    /// Offset and size of the chunks of a shard.
    index: Option<Vec<(u64, u64)>>,
}

/// Reader of the chunks of one level.
pub(crate) struct LevelReader {
    array: Array,
    placed: Placed,
    listing: Arc<Listing>,
    open: Mutex<HashMap<Vec<u64>, Arc<ChunkFile>>>,
}

impl LevelReader {
    /// Returns a reader of an array whose files are in `listing`.
    pub(crate) fn new(array: Array, placed: Placed, listing: Arc<Listing>) -> LevelReader {
        LevelReader { array, placed, listing, open: Mutex::default() }
    }

    pub(crate) fn array(&self) -> &Array {
        &self.array
    }

    pub(crate) fn placed(&self) -> &Placed {
        &self.placed
    }

    /// Returns the shape of a chunk along x, y and z, in samples; at most the level's.
    pub(crate) fn chunk_shape(&self) -> [u32; 3] {
        let inner = self.array.inner();
        std::array::from_fn(|axis| {
            let side = self.placed.axes[axis].map_or(1, |a| inner[a]);
            side.min(self.placed.dims[axis]) as u32
        })
    }

    /// Returns the fill value, which stands for missing chunks, as little-endian bytes.
    pub(crate) fn fill(&self) -> &[u8] {
        &self.array.fill[..self.array.number.bytes() as usize]
    }

    /// Returns the numbers of the chunk at position `at`, counted in chunks: x fastest,
    /// little-endian, without the part beyond the level's end. `None` for a chunk that was never
    /// written.
    ///
    /// # Errors
    /// The file was removed or replaced, is cut off or damaged.
    pub(crate) fn chunk(&self, at: [u32; 3]) -> Result<Option<Vec<u8>>, Problem> {
        let (array, placed) = (&self.array, &self.placed);
        let inner = array.inner();
        // First index of the chunk along each axis of the array.
        let mut first: Vec<u64> =
            placed.at.iter().zip(inner).map(|(at, size)| at / size * size).collect();
        for (axis, n) in placed.axes.iter().zip(at) {
            if let Some(a) = *axis {
                first[a] = u64::from(n) * inner[a];
            }
        }
        let cell: Vec<u64> = first.iter().zip(&array.grid).map(|(first, g)| first / g).collect();
        let path = json::path(&array.folder, &array.key.path(&cell));
        let Some(&listed) = self.listing.0.get(&path) else { return Ok(None) };
        let name_chunk = |mut p: Problem| {
            p.field = format!("chunk {path} {}", p.field);
            p
        };
        let read = || -> Result<Option<Vec<u8>>, Problem> {
            let file = self.file(&cell, &path, listed)?;
            let (offset, size) = match &file.index {
                None => (0, file.len),
                Some(index) => {
                    let mut place = 0;
                    for a in 0..inner.len() {
                        let count = array.grid[a] / inner[a];
                        place = place * count + first[a] / inner[a] % count;
                    }
                    index[place as usize]
                }
            };
            // The mark of an inner chunk that was never written.
            if (offset, size) == (u64::MAX, u64::MAX) {
                return Ok(None);
            }
            if offset.checked_add(size).is_none_or(|end| end > file.len) {
                return Err(Problem::new(
                    OpenErrorKind::Damaged,
                    "index",
                    format!("says that a chunk lies beyond the file's {} bytes", file.len),
                    "get the array again",
                ));
            }
            let bytes = (inner.iter().product::<u64>() * array.number.bytes()) as usize;
            codec::Codecs::check_len(size, bytes)?;
            let packed = read_at(&file.file, offset, size as usize)?;
            array.codecs.decode_bytes(packed, bytes).map(Some)
        };
        let decoded = read().map_err(name_chunk)?;
        Ok(decoded.map(|decoded| self.ordered(&first, decoded)))
    }

    /// Opens a file of chunks, or returns it from those that are open.
    fn file(&self, cell: &[u64], path: &str, listed: Stamp) -> Result<Arc<ChunkFile>, Problem> {
        let lock = || self.open.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(file) = lock().get(cell) {
            return Ok(file.clone());
        }
        let io = |e: std::io::Error| Problem::io("file", &e);
        let (file, len) = match self.array.root.find(Path::new(path)).map_err(io)? {
            Inside::File(file, len) => (file, len),
            Inside::Missing => {
                return Err(Problem::new(
                    OpenErrorKind::Unreadable,
                    "file",
                    "was there when the picture was opened, and is gone",
                    "put it back, or open the picture again",
                ));
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
        if Stamp::of(&file.metadata().map_err(io)?) != listed {
            return Err(replaced("file"));
        }
        let index = match &self.array.shard {
            None => None,
            Some(shard) => {
                let (start, bytes) = shard.index_place(len, &self.array.grid)?;
                Some(shard.parse_index(read_at(&file, start, bytes as usize)?)?)
            }
        };
        let file = Arc::new(ChunkFile { file, len, index });
        let mut open = lock();
        if open.len() >= OPEN_MAX {
            open.clear();
        }
        open.insert(cell.to_vec(), file.clone());
        Ok(file)
    }

    /// Reorders the numbers of a decoded chunk to x fastest, and drops those beyond the level's
    /// end. `first` is the chunk's first index along each axis of the array.
    fn ordered(&self, first: &[u64], mut decoded: Vec<u8>) -> Vec<u8> {
        let (array, placed) = (&self.array, &self.placed);
        let size = array.number.bytes() as usize;
        if array.endian == Endian::Big {
            decoded.chunks_exact_mut(size).for_each(<[u8]>::reverse);
        }
        let inner = array.inner();
        let strides = array.codecs.strides(inner);
        let along = |axis: usize| match placed.axes[axis] {
            None => (1, 0),
            Some(a) => {
                let inside = array.shape[a].saturating_sub(first[a]).min(inner[a]);
                (inside as usize, strides[a])
            }
        };
        let [(nx, sx), (ny, sy), (nz, sz)] = [along(0), along(1), along(2)];
        let base: usize = (0..strides.len())
            .filter(|a| !placed.axes.contains(&Some(*a)))
            .map(|a| (placed.at[a] - first[a]) as usize * strides[a])
            .sum();
        let plain = base == 0 && (nx == 1 || sx == 1) && (ny == 1 || sy == nx);
        if plain && (nz == 1 || sz == nx * ny) {
            decoded.truncate(nx * ny * nz * size);
            return decoded;
        }
        let mut to = Vec::with_capacity(nx * ny * nz * size);
        for z in 0..nz {
            for y in 0..ny {
                let row = base + z * sz + y * sy;
                if sx == 1 {
                    to.extend_from_slice(&decoded[row * size..(row + nx) * size]);
                    continue;
                }
                for x in 0..nx {
                    let at = (row + x * sx) * size;
                    to.extend_from_slice(&decoded[at..at + size]);
                }
            }
        }
        to
    }
}

/// Returns the error for a file that was replaced.
pub(crate) fn replaced(field: &str) -> Problem {
    Problem::new(
        OpenErrorKind::Damaged,
        field,
        "was replaced or changed since the picture was opened",
        "open the picture again",
    )
}

/// Reads bytes of a file at an offset; the file's own position stays.
pub(crate) fn read_at(file: &File, offset: u64, len: usize) -> Result<Vec<u8>, Problem> {
    let mut bytes = Vec::new();
    crate::samples::reserve(&mut bytes, len)?;
    bytes.resize(len, 0);
    fill_at(file, offset, &mut bytes)?;
    Ok(bytes)
}

/// Fills bytes from a file at an offset; the file's own position stays.
pub(crate) fn fill_at(file: &File, offset: u64, bytes: &mut [u8]) -> Result<(), Problem> {
    #[cfg(unix)]
    let read = std::os::unix::fs::FileExt::read_exact_at(file, bytes, offset);
    #[cfg(not(unix))]
    let read = {
        use std::io::{Read, Seek, SeekFrom};
        // One reader at a time, since all share the file's position.
        static TURN: Mutex<()> = Mutex::new(());
        let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let mut file = file;
        file.seek(SeekFrom::Start(offset)).and_then(|_| file.read_exact(bytes))
    };
    read.map_err(|e| match e.kind() {
        std::io::ErrorKind::UnexpectedEof => Problem::new(
            OpenErrorKind::Damaged,
            "file",
            "was cut off since it was opened",
            "get the whole file, and open it again",
        ),
        _ => Problem::io("file", &e),
    })
}

/// Joins a folder and a path with `/` separators.
pub(crate) fn below(folder: &Path, path: &str) -> PathBuf {
    path.split('/').fold(folder.to_path_buf(), |at, part| at.join(part))
}
