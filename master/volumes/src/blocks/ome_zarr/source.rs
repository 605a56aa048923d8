//! Source of boxes from an OME-Zarr pyramid or a Zarr array.

use super::convert::{Unfinished, blocks_again, facts, guess, infos};
use super::{OnProgress, SIDECAR};
use crate::Hints;
use crate::blocks::coding::{Coding, NumberRange};
use crate::blocks::sidecar::{self, Facts, Identity};
use crate::blocks::survey::{Counter, Survey, count_between};
use crate::blocks::{BLOCK_EDGE, BlockSource, BlockSummaries};
use crate::error::{OpenErrorKind, Problem};
use crate::limit::{ANY_FILE_BYTES, FILE_RATIO};
use crate::samples::reserve;
use crate::zarr::chunks::{LevelReader, Listing, Stamp, below, replaced};
use crate::zarr::{Own, Picture};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use slabcast_common::volume::{Lattice, SampleKind, Samples, ValueMap, VolumeInfo};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::UNIX_EPOCH;

/// Default budget of decoded chunks in bytes; [`OmeZarrSource::with_cache_bytes`] changes it.
const CACHE_BYTES: usize = 64 << 20;
/// Chunks of one box that are decoded at once.
const AT_A_TIME: usize = 32;

/// A pyramid of which chunks are read on request.
///
/// Errors name the chunk's file. If a file was removed, cut off, damaged or replaced since the
/// pyramid was opened, boxes that need it fail; others can still be read.
pub struct OmeZarrSource {
    name: String,
    file_type: String,
    readers: Vec<LevelReader>,
    coding: Coding,
    levels: Vec<VolumeInfo>,
    blocks: Vec<Arc<BlockSummaries>>,
    /// Metadata files, as they were when the pyramid was opened.
    stamps: Vec<(PathBuf, Stamp)>,
    cache: Mutex<ChunkCache>,
}

/// A pyramid whose metadata were read and whose files were listed, before its blocks are known.
struct Opening {
    name: String,
    folder: PathBuf,
    own: Option<Own>,
    readers: Vec<LevelReader>,
    lattices: Vec<Lattice>,
    listing: Arc<Listing>,
    stamps: Vec<(PathBuf, Stamp)>,
    /// Most bytes of samples that the user allows (`--max-bytes`).
    max_bytes: Option<u64>,
}

impl Opening {
    fn new(folder: &Path, hints: &Hints) -> Result<Opening, Problem> {
        let picture = Picture::open(folder)?;
        let listing = Arc::new(Listing::read(folder)?);
        if picture.levels() == 0 {
            return Err(Problem::malformed("datasets", "is empty", "get the picture again"));
        }
        let mut readers = Vec::new();
        for level in 0..picture.levels() {
            let (array, placed) = picture.level(level, &hints.pick)?;
            placed.check()?;
            let reader = LevelReader::new(array, placed, listing.clone());
            check_chunks(&reader)?;
            readers.push(reader);
        }
        let number = readers[0].array().number;
        if readers.iter().any(|r| r.array().number != number) {
            return Err(Problem::unsupported(
                "data_type",
                "is not the same at all levels",
                "write the picture again",
            ));
        }
        let stamps = listing
            .files()
            .filter(|(path, _)| is_metadata(path))
            .map(|(path, stamp)| (below(folder, path), stamp))
            .collect();
        Ok(Opening {
            name: folder.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            folder: folder.into(),
            own: picture.own().cloned(),
            lattices: readers.iter().map(|r| r.placed().lattice).collect(),
            readers,
            listing,
            stamps,
            max_bytes: hints.max_bytes,
        })
    }

    /// Returns the identity of the pyramid: a digest of paths and sizes of all files, their times
    /// of change if `times`, the metadata, and which of several volumes is read.
    fn identity(&self, times: bool) -> Result<Identity, Problem> {
        let mut hash = Sha256::new();
        hash.update(b"slabcast pyramid 1");
        for (path, stamp) in self.listing.files() {
            hash.update((path.len() as u64).to_le_bytes());
            hash.update(path.as_bytes());
            hash.update(stamp.len.to_le_bytes());
            if times {
                let since = stamp.changed.and_then(|t| t.duration_since(UNIX_EPOCH).ok());
                hash.update(since.map_or(0, |t| t.as_nanos()).to_le_bytes());
            }
            if is_metadata(path) {
                let text = std::fs::read(below(&self.folder, path));
                hash.update(text.map_err(|e| Problem::io(path, &e))?);
            }
        }
        // Index of the volume among several.
        for reader in &self.readers {
            reader.placed().at.iter().for_each(|n| hash.update(n.to_le_bytes()));
        }
        Ok(hash.finalize().into())
    }

    fn rescale(&self) -> ValueMap {
        self.own.as_ref().and_then(|own| own.rescale).unwrap_or(ValueMap::IDENTITY)
    }

    /// Calls `each` with the numbers of each slab of 64 planes of a level, in order.
    fn slabs(
        &self,
        level: usize,
        each: &mut dyn FnMut(&[u8]) -> Result<(), Problem>,
    ) -> Result<(), Problem> {
        let [nx, ny, nz] = self.lattices[level].dims;
        for z in (0..nz).step_by(BLOCK_EDGE as usize) {
            let end = (z + BLOCK_EDGE).min(nz);
            each(&numbers(&self.readers[level], [0, 0, z], [nx, ny, end])?)?;
        }
        Ok(())
    }

    /// Checks that files of this size may become so many bytes of samples: missing chunks count as
    /// fill values, so metadata alone can claim any size.
    fn check_size(&self, samples: u64) -> Result<(), Problem> {
        let stored = self.listing.files().map(|(_, stamp)| stamp.len).sum::<u64>();
        let most = self.max_bytes.unwrap_or(ANY_FILE_BYTES.max(stored.saturating_mul(FILE_RATIO)));
        match samples <= most {
            true => Ok(()),
            false => Err(Problem::new(
                OpenErrorKind::TooLarge,
                "shape",
                format!(
                    "{stored} bytes of files become {samples} bytes of samples, and only {most} are \
                     looked at unasked"
                ),
                format!("give --max-bytes {samples} to read it all the same"),
            )),
        }
    }

    /// Surveys all levels; reads all samples.
    fn survey(&self, on_progress: &mut OnProgress<'_>) -> Result<Facts, Problem> {
        let number = self.readers[0].array().number;
        let bytes =
            |l: &Lattice| l.dims.iter().map(|&n| u64::from(n)).product::<u64>() * number.bytes();
        let total = self.lattices.iter().map(bytes).sum::<u64>();
        let first = bytes(&self.lattices[0]);
        self.check_size(total)?;
        let mut done = 0;
        let mut range = NumberRange::new(number);
        if let Some(range) = &mut range {
            self.slabs(0, &mut |bytes| {
                range.add(number, bytes);
                done += bytes.len() as u64;
                on_progress(done, total + first)
            })?;
        }
        let total = total + done;
        let coding = Coding::new(number, self.rescale(), range.as_ref());
        coding.check()?;
        let code_range = range.as_ref().map_or((0.0, 0.0), |range| coding.code_range(range));
        let mut counter = Some(Counter::new(coding.kind(), coding.map(), code_range));
        let mut found = Vec::new();
        for (level, lattice) in self.lattices.iter().enumerate() {
            let form = (coding.map(), coding.kind());
            let mut survey = Survey::new(*lattice, form, guess(code_range), counter.take());
            self.slabs(level, &mut |bytes| {
                let mut codes = Samples::empty(coding.kind());
                coding.encode(bytes, &mut codes);
                survey.slab(&codes, |_, _, _| (), |_, _| Ok(()))?;
                done += bytes.len() as u64;
                on_progress(done, total)
            })?;
            found.push(survey.finish());
        }
        let recount = |lo, hi| {
            let mut histogram = vec![0; 256];
            self.slabs(0, &mut |bytes| {
                let mut codes = Samples::empty(SampleKind::F32);
                coding.encode(bytes, &mut codes);
                count_between(&codes, lo, hi, &mut histogram);
                Ok(())
            })?;
            Ok(histogram)
        };
        let anatomical = self.own.as_ref().is_some_and(|own| own.anatomical);
        let known = (anatomical, self.lattices[0].vox());
        match facts(coding.clone(), known, found, recount)? {
            Ok(facts) => Ok(facts),
            Err(unfinished) => complete(&self.folder, unfinished),
        }
    }
}

/// Returns the number of samples and the spacing along x, y and z of each level of the pyramid in a
/// folder; `None` if it is not a pyramid. Reads only metadata.
pub fn level_sizes(folder: &Path) -> Option<Vec<([u64; 3], [f64; 3])>> {
    if !folder.is_dir() || !crate::zarr::is_node(folder) {
        return None;
    }
    let picture = Picture::open(folder).ok()?;
    let size = |level| {
        let (_, placed) = picture.level(level, &crate::Pick::default()).ok()?;
        Some((placed.dims, placed.lattice.spacing()))
    };
    (0..picture.levels()).map(size).collect()
}

/// Checks that the chunks of a level are few and small enough to be read one by one.
fn check_chunks(reader: &LevelReader) -> Result<(), Problem> {
    reader.array().check_counts(reader.placed())
}

fn is_metadata(path: &str) -> bool {
    let name = path.rsplit('/').next().unwrap_or(path);
    ["zarr.json", ".zarray", ".zattrs", ".zgroup"].contains(&name)
}

/// Returns the identity of a pyramid for a sidecar in its own folder. It has no times of change, so
/// that it holds for a copy of the folder.
pub(super) fn identity_inside(folder: &Path) -> Result<Identity, Problem> {
    Opening::new(folder, &Hints::default())?.identity(false)
}

/// Computes the missing block summaries of a pyramid in a folder; reads all its samples.
pub(super) fn complete(folder: &Path, unfinished: Unfinished) -> Result<Facts, Problem> {
    let opening = Opening::new(folder, &Hints::default())?;
    let blind = unfinished.blind(&opening.lattices);
    let source = OmeZarrSource::with_facts(opening, &blind);
    blocks_again(&source, unfinished)
}

impl OmeZarrSource {
    /// Calls the volume by another name and number type than those of the folder.
    pub(crate) fn named(self, name: &str, file_type: &str) -> OmeZarrSource {
        OmeZarrSource { name: name.into(), file_type: file_type.into(), ..self }
    }

    /// Opens a pyramid or an array in a folder. Block summaries come from the sidecar in its folder
    /// or in `cache`. Without one, a pass reads all samples, calls `on_progress`, and writes a
    /// sidecar into `cache`.
    ///
    /// # Errors
    /// The folder is not a pyramid that can be read, it is damaged, or `on_progress` returned an
    /// error.
    pub fn open(
        folder: &Path,
        hints: &Hints,
        cache: Option<&Path>,
        on_progress: &mut OnProgress<'_>,
    ) -> Result<OmeZarrSource, Problem> {
        let opening = Opening::new(folder, hints)?;
        let inside = folder.join(SIDECAR);
        let known = inside.is_file().then(|| opening.identity(false)).transpose()?;
        let known = known.and_then(|id| Facts::read(&inside, &id, &opening.lattices));
        let facts = match known {
            Some(facts) => facts,
            None => {
                let identity = opening.identity(true)?;
                let beside = cache.map(|cache| sidecar::in_cache(cache, &identity));
                let read = |path: &PathBuf| Facts::read(path, &identity, &opening.lattices);
                match beside.as_ref().and_then(read) {
                    Some(facts) => facts,
                    None => {
                        let facts = opening.survey(on_progress)?;
                        if let Some(path) = &beside {
                            // Without a writable cache the next run surveys the pyramid again.
                            let _ = facts.write(path, &identity);
                        }
                        facts
                    }
                }
            }
        };
        let sound = facts.coding.number == opening.readers[0].array().number
            && facts.coding.rescale == opening.rescale();
        match sound {
            true => Ok(OmeZarrSource::with_facts(opening, &facts)),
            false => Err(Problem::new(
                OpenErrorKind::Damaged,
                SIDECAR,
                "contradicts the picture's metadata",
                "remove it",
            )),
        }
    }

    fn with_facts(opening: Opening, facts: &Facts) -> OmeZarrSource {
        let file_type = match &opening.own {
            Some(own) => own.file_type.clone(),
            None => facts.coding.number.name().into(),
        };
        OmeZarrSource {
            name: opening.name,
            file_type,
            levels: infos(&opening.lattices, facts),
            blocks: facts.levels.iter().map(|level| level.blocks.clone()).collect(),
            readers: opening.readers,
            coding: facts.coding.clone(),
            stamps: opening.stamps,
            cache: Mutex::new(ChunkCache::new(CACHE_BYTES)),
        }
    }

    /// Returns the source with another budget of decoded chunks, in bytes.
    #[must_use]
    pub fn with_cache_bytes(self, bytes: usize) -> OmeZarrSource {
        OmeZarrSource { cache: Mutex::new(ChunkCache::new(bytes)), ..self }
    }

    fn cache(&self) -> std::sync::MutexGuard<'_, ChunkCache> {
        self.cache.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Checks that no metadata file changed since the pyramid was opened.
    fn check_stamps(&self) -> Result<(), Problem> {
        for (path, stamp) in &self.stamps {
            if Stamp::of_path(path).ok() != Some(*stamp) {
                let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                return Err(replaced(&name));
            }
        }
        Ok(())
    }

    /// Returns the codes of a chunk; `None` for one that was never written.
    fn chunk(&self, level: usize, at: [u32; 3]) -> Result<Option<Arc<Samples>>, Problem> {
        let Some(numbers) = self.readers[level].chunk(at)? else { return Ok(None) };
        let mut codes = Samples::empty(self.coding.kind());
        self.coding.encode(&numbers, &mut codes);
        let codes = Arc::new(codes);
        self.cache().put((level, at), codes.clone());
        Ok(Some(codes))
    }
}

impl BlockSource for OmeZarrSource {
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
        let reader = &self.readers[level];
        let dims = self.levels[level].lattice.dims;
        assert!((0..3).all(|a| lo[a] < hi[a] && hi[a] <= dims[a]), "a box inside");
        let mut fill = Samples::empty(self.coding.kind());
        self.coding.encode(reader.fill(), &mut fill);
        let mut out = filled(&fill, lo, hi)?;
        let shape = reader.chunk_shape();
        let mut checked = false;
        for cells in cells(shape, lo, hi).chunks(AT_A_TIME) {
            let cached: Vec<Option<Arc<Samples>>> = {
                let mut cache = self.cache();
                cells.iter().map(|&at| cache.get((level, at))).collect()
            };
            if !checked && cached.iter().any(Option::is_none) {
                self.check_stamps()?;
                checked = true;
            }
            let decode = |(&at, cached): (&[u32; 3], Option<Arc<Samples>>)| match cached {
                Some(codes) => Ok(Some(codes)),
                None => self.chunk(level, at),
            };
            let found: Result<Vec<_>, Problem> = cells.par_iter().zip(cached).map(decode).collect();
            for (&at, codes) in cells.iter().zip(found?) {
                if let Some(codes) = codes {
                    paste(&codes, chunk_box(at, shape, dims), &mut out, (lo, hi));
                }
            }
        }
        Ok(out)
    }

    fn summaries(&self, level: usize) -> Result<Arc<BlockSummaries>, Problem> {
        Ok(self.blocks[level].clone())
    }

    fn memory_bytes(&self) -> u64 {
        let blocks: u64 = self.blocks.iter().map(|level| level.memory_bytes()).sum();
        blocks + self.cache().budget as u64
    }
}

/// Returns the positions of the chunks that a box touches, in chunks.
fn cells(shape: [u32; 3], lo: [u32; 3], hi: [u32; 3]) -> Vec<[u32; 3]> {
    let along = |a: usize| lo[a] / shape[a]..=(hi[a] - 1) / shape[a];
    let mut cells = Vec::new();
    for z in along(2) {
        for y in along(1) {
            cells.extend(along(0).map(|x| [x, y, z]));
        }
    }
    cells
}

/// Returns the part of a chunk's box that lies in the level, from `lo` to `hi` (exclusive).
fn chunk_box(at: [u32; 3], shape: [u32; 3], dims: [u32; 3]) -> ([u32; 3], [u32; 3]) {
    let lo = std::array::from_fn(|a| at[a] * shape[a]);
    (lo, std::array::from_fn(|a| (lo[a] + shape[a]).min(dims[a])))
}

/// Returns the samples of a box that all have one code, the first of `fill`.
fn filled(fill: &Samples, lo: [u32; 3], hi: [u32; 3]) -> Result<Samples, Problem> {
    let count = (0..3).map(|a| (hi[a] - lo[a]) as usize).product();
    macro_rules! of {
        ($v:expr, $kind:path) => {{
            let mut all = Vec::new();
            reserve(&mut all, count)?;
            all.resize(count, $v[0]);
            $kind(all)
        }};
    }
    Ok(match fill {
        Samples::U8(v) => of!(v, Samples::U8),
        Samples::U16(v) => of!(v, Samples::U16),
        Samples::F32(v) => of!(v, Samples::F32),
    })
}

type Box3 = ([u32; 3], [u32; 3]);

/// Copies the intersection of two boxes from one list of samples to another.
pub(crate) fn paste(from: &Samples, from_box: Box3, to: &mut Samples, to_box: Box3) {
    match (from, to) {
        (Samples::U8(from), Samples::U8(to)) => paste_rows(from, from_box, to, to_box, 1),
        (Samples::U16(from), Samples::U16(to)) => paste_rows(from, from_box, to, to_box, 1),
        (Samples::F32(from), Samples::F32(to)) => paste_rows(from, from_box, to, to_box, 1),
        _ => panic!("samples of one type"),
    }
}

/// Copies the intersection of two boxes; a sample has `size` items.
fn paste_rows<T: Copy>(
    from: &[T],
    (from_lo, from_hi): Box3,
    to: &mut [T],
    (to_lo, to_hi): Box3,
    size: usize,
) {
    let lo: [u32; 3] = std::array::from_fn(|a| from_lo[a].max(to_lo[a]));
    let hi: [u32; 3] = std::array::from_fn(|a| from_hi[a].min(to_hi[a]));
    if (0..3).any(|a| lo[a] >= hi[a]) {
        return;
    }
    let place = |origin: [u32; 3], end: [u32; 3], y: u32, z: u32| {
        let side = |a: usize| (end[a] - origin[a]) as usize;
        let row = (z - origin[2]) as usize * side(1) + (y - origin[1]) as usize;
        (row * side(0) + (lo[0] - origin[0]) as usize) * size
    };
    let length = (hi[0] - lo[0]) as usize * size;
    for z in lo[2]..hi[2] {
        for y in lo[1]..hi[1] {
            let (a, b) = (place(from_lo, from_hi, y, z), place(to_lo, to_hi, y, z));
            to[b..b + length].copy_from_slice(&from[a..a + length]);
        }
    }
}

/// Returns the numbers of a box, as little-endian bytes.
fn numbers(reader: &LevelReader, lo: [u32; 3], hi: [u32; 3]) -> Result<Vec<u8>, Problem> {
    let size = reader.array().number.bytes() as usize;
    let dims = reader.placed().dims.map(|n| n as u32);
    let count: usize = (0..3).map(|a| (hi[a] - lo[a]) as usize).product();
    let mut out = Vec::new();
    reserve(&mut out, count * size)?;
    while out.len() < count * size {
        out.extend_from_slice(reader.fill());
    }
    let shape = reader.chunk_shape();
    for cells in cells(shape, lo, hi).chunks(AT_A_TIME) {
        let found: Result<Vec<_>, Problem> = cells.par_iter().map(|&at| reader.chunk(at)).collect();
        for (&at, chunk) in cells.iter().zip(found?) {
            if let Some(chunk) = chunk {
                paste_rows(&chunk, chunk_box(at, shape, dims), &mut out, (lo, hi), size);
            }
        }
    }
    Ok(out)
}

/// Cache of decoded chunks; the least recently used one is dropped first.
struct ChunkCache {
    budget: usize,
    bytes: usize,
    /// Chunks with the time of their last use.
    chunks: HashMap<(usize, [u32; 3]), (Arc<Samples>, u64)>,
    /// Chunks by the time of their last use.
    by_use: BTreeMap<u64, (usize, [u32; 3])>,
    now: u64,
}

fn bytes_of(samples: &Samples) -> usize {
    samples.len() * samples.kind().bytes()
}

impl ChunkCache {
    fn new(budget: usize) -> ChunkCache {
        ChunkCache { budget, bytes: 0, chunks: HashMap::new(), by_use: BTreeMap::new(), now: 0 }
    }

    fn get(&mut self, key: (usize, [u32; 3])) -> Option<Arc<Samples>> {
        let (samples, used) = self.chunks.get_mut(&key)?;
        self.by_use.remove(used);
        self.now += 1;
        *used = self.now;
        self.by_use.insert(self.now, key);
        Some(samples.clone())
    }

    fn put(&mut self, key: (usize, [u32; 3]), samples: Arc<Samples>) {
        let bytes = bytes_of(&samples);
        if bytes > self.budget || self.chunks.contains_key(&key) {
            return;
        }
        while self.bytes + bytes > self.budget
            && let Some((_, oldest)) = self.by_use.pop_first()
        {
            if let Some((old, _)) = self.chunks.remove(&oldest) {
                self.bytes -= bytes_of(&old);
            }
        }
        self.now += 1;
        self.bytes += bytes;
        self.by_use.insert(self.now, key);
        self.chunks.insert(key, (samples, self.now));
    }
}
