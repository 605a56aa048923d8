//! Writes a volume as OME-Zarr with all levels, in one pass over its numbers.

use super::write::{LevelWriter, written};
use super::{SIDECAR, meta, source};
use crate::Hints;
use crate::blocks::cascade::{self, Cascade};
use crate::blocks::coding::{Coding, NumberRange};
use crate::blocks::planes::Planes;
use crate::blocks::sidecar::{Facts, LevelFacts};
use crate::blocks::survey::{Counter, Surveyed, count_between};
use crate::blocks::{BlockSource, BlockSummaries, ValueBins, block_dims, level_lattices};
use crate::error::{OpenError, OpenErrorKind, Problem};
use crate::limit::free_memory;
use crate::zarr::Own;
use slabcast_common::volume::{
    Digest32, Lattice, SampleKind, Samples, ValueMap, ValueSummary, VolumeInfo,
};
use std::path::Path;
use std::sync::Arc;

/// Hears how far a pass over a volume is: bytes done and bytes in all. An error ends the work.
pub type OnProgress<'a> = dyn FnMut(u64, u64) -> Result<(), Problem> + 'a;

/// A volume that was written as OME-Zarr.
#[derive(Clone, Debug)]
pub struct Converted {
    /// The levels, the finest first.
    pub levels: Vec<VolumeInfo>,
    /// Choices that the reader made, one sentence each, to show to the user.
    pub notes: Vec<String>,
}

/// Reads a volume of any format and writes it as OME-Zarr at `to`, a folder that is made. Its samples
/// keep type and value; each coarser level has means of two samples along each axis. Files whose samples
/// lie in order are read slice by slice, whatever their size; others are read as a whole first. With
/// `replace`, a Zarr folder that is at `to` goes when the new one is whole.
///
/// `on_progress` hears about each pass: one for integers of 8 and 16 bits, two for others, and more
/// for floats with values far from all others.
///
/// # Errors
/// The volume can't be read, `to` is there already or can't be written, the memory does not do, or
/// `on_progress` returned an error. Nothing is left at `to` then.
pub fn convert(
    from: &Path,
    to: &Path,
    hints: &Hints,
    replace: bool,
    on_progress: &mut OnProgress<'_>,
) -> Result<Converted, OpenError> {
    let named = |problem| OpenError { file: from.to_string_lossy().into_owned(), problem };
    let mut planes = Planes::open(from, hints).map_err(named)?;
    let notes = std::mem::take(&mut planes.notes);
    let levels = write(&planes, to, replace, on_progress).map_err(named)?;
    Ok(Converted { levels, notes })
}

/// Writes planes as OME-Zarr.
pub(crate) fn write(
    planes: &Planes,
    to: &Path,
    replace: bool,
    on_progress: &mut OnProgress<'_>,
) -> Result<Vec<VolumeInfo>, Problem> {
    let is_free = || match to.symlink_metadata().is_ok() {
        true if !replace || !crate::zarr::is_node(to) => Err(Problem::new(
            OpenErrorKind::Unreadable,
            "output",
            format!("{} is there already", to.display()),
            "give another name, or remove it",
        )),
        there => Ok(!there),
    };
    is_free()?;
    let parent = match to.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let name = to.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut builder = tempfile::Builder::new();
    let prefix = format!(".{name}.");
    builder.prefix(&prefix).suffix(".tmp");
    #[cfg(unix)]
    builder
        .permissions(<std::fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o777));
    let folder = builder.tempdir_in(parent).map_err(|e| written(parent, &e))?;
    let levels = fill(planes, folder.path(), &name, on_progress)?;
    if !is_free()? {
        // Folders can't replace others; the old one goes out of the way, and then for good.
        let old = builder.tempdir_in(parent).map_err(|e| written(parent, &e))?;
        std::fs::rename(to, old.path().join("old")).map_err(|e| written(to, &e))?;
    }
    std::fs::rename(folder.path(), to).map_err(|e| written(to, &e))?;
    // It has another name now.
    let _ = folder.keep();
    Ok(levels)
}

/// Writes all files of a pyramid into a folder.
fn fill(
    planes: &Planes,
    folder: &Path,
    name: &str,
    on_progress: &mut OnProgress<'_>,
) -> Result<Vec<VolumeInfo>, Problem> {
    let lattices = level_lattices(&planes.lattice);
    let own = Own {
        file_type: planes.file_type.clone(),
        anatomical: planes.anatomical,
        rescale: (planes.rescale != ValueMap::IDENTITY).then_some(planes.rescale),
        steps: planes.lattice.steps,
        origin: planes.lattice.origin,
    };
    let mut writers = Vec::new();
    for (level, lattice) in lattices.iter().enumerate() {
        let array = folder.join(level.to_string());
        writers.push(LevelWriter::new(&array, lattice.dims)?);
        put(&array.join("zarr.json"), &meta::array(lattice.dims, planes.number))?;
    }
    put(&folder.join("zarr.json"), &meta::group(name, &lattices, &own))?;
    let walked = walk(planes, &lattices, Some(writers), on_progress)?;
    // Bins that were not known in the pass: blocks are looked at again.
    let facts = match walked.facts {
        Ok(facts) => facts,
        Err(unfinished) => source::complete(folder, unfinished)?,
    };
    let identity = source::identity_inside(folder)?;
    let sidecar = folder.join(SIDECAR);
    facts.write(&sidecar, &identity).map_err(|e| written(&sidecar, &e))?;
    sync(folder).map_err(|e| written(folder, &e))?;
    Ok(infos(&lattices, &facts))
}

/// Returns the levels as others know them.
pub(crate) fn infos(lattices: &[Lattice], facts: &Facts) -> Vec<VolumeInfo> {
    let finest_vox = lattices[0].vox();
    let info = |(level, (lattice, of)): (u32, (&Lattice, &LevelFacts))| VolumeInfo {
        digest: of.digest,
        lattice: *lattice,
        summary: facts.summary.clone(),
        level,
        finest_vox,
    };
    (0..).zip(lattices.iter().zip(&facts.levels)).map(info).collect()
}

fn put(path: &Path, json: &serde_json::Value) -> Result<(), Problem> {
    let text = serde_json::to_vec_pretty(json).map_err(|e| written(path, &e.into()))?;
    std::fs::write(path, text).map_err(|e| written(path, &e))
}

/// Hands all files to the disk, so that a folder with its final name is whole even after a power cut.
fn sync(folder: &Path) -> std::io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        match entry.file_type()?.is_dir() {
            true => sync(&entry.path())?,
            false => std::fs::File::open(entry.path())?.sync_all()?,
        }
    }
    Ok(())
}

/// What a pass over all numbers found.
pub(crate) struct Walked {
    /// Facts; without blocks where a second look is needed.
    pub(crate) facts: Result<Facts, Unfinished>,
}

/// Facts whose blocks have to be looked at again.
pub(crate) struct Unfinished {
    pub(crate) coding: Coding,
    pub(crate) summary: ValueSummary,
    pub(crate) digests: Vec<Digest32>,
}

impl Unfinished {
    /// Returns the facts with blocks of which nothing is known yet.
    pub(crate) fn blind(&self, lattices: &[Lattice]) -> Facts {
        let bins = ValueBins::of(&self.summary);
        let blocks = |lattice: &Lattice| {
            Arc::new(BlockSummaries { dims: block_dims(lattice.dims), bins, all: Vec::new() })
        };
        let levels = self.digests.iter().zip(lattices);
        let levels = levels
            .map(|(&digest, lattice)| LevelFacts { digest, blocks: blocks(lattice) })
            .collect();
        Facts { coding: self.coding.clone(), summary: self.summary.clone(), levels }
    }
}

/// Goes over the numbers of a volume: once for their range if codes depend on it, and once for all
/// else.
pub(crate) fn walk(
    planes: &Planes,
    lattices: &[Lattice],
    writers: Option<Vec<LevelWriter>>,
    on_progress: &mut OnProgress<'_>,
) -> Result<Walked, Problem> {
    let total = planes.bytes();
    let range = range(planes, on_progress)?;
    let coding = Coding::new(planes.number, planes.rescale, range.as_ref());
    coding.check()?;
    let need = cascade::memory_bytes(&lattices[0], &coding, lattices.len() > 1);
    cascade::check_memory(
        need,
        free_memory(),
        "give more memory, or a volume whose slices are smaller",
    )?;
    let code_range = range.as_ref().map_or((0.0, 0.0), |range| coding.code_range(range));
    let counter = Counter::new(coding.kind(), coding.map(), code_range);
    let guess = guess(code_range);
    let mut cascade = Cascade::new(lattices, &coding, guess, counter, writers)?;
    let mut done = 0;
    planes.pass(&mut |bytes| {
        cascade.push(bytes)?;
        done += bytes.len() as u64;
        on_progress(done, total)
    })?;
    let found = cascade.finish()?;
    let recount = |lo, hi| recount(planes, &coding, (lo, hi), on_progress);
    Ok(Walked {
        facts: facts(coding.clone(), (planes.anatomical, lattices[0].vox()), found, recount)?,
    })
}

/// Returns the range of all numbers; `None` for types whose codes do not depend on it.
pub(crate) fn range(
    planes: &Planes,
    on_progress: &mut OnProgress<'_>,
) -> Result<Option<NumberRange>, Problem> {
    let mut range = NumberRange::new(planes.number);
    if let Some(range) = &mut range {
        let mut done = 0;
        planes.pass(&mut |bytes| {
            range.add(planes.number, bytes);
            done += bytes.len() as u64;
            on_progress(done, planes.bytes())
        })?;
    }
    Ok(range)
}

/// Returns the likely bins of floats between two codes.
pub(crate) fn guess((lo, hi): (f64, f64)) -> ValueBins {
    let mut samples = ValueSummary::from_samples(&Samples::F32(Vec::new()), ValueMap::IDENTITY);
    (samples.min_code, samples.max_code) = (lo, hi);
    ValueBins::of(&samples)
}

fn recount(
    planes: &Planes,
    coding: &Coding,
    (lo, hi): (f64, f64),
    on_progress: &mut OnProgress<'_>,
) -> Result<Vec<u64>, Problem> {
    let (mut histogram, mut done) = (vec![0; 256], 0);
    planes.pass(&mut |bytes| {
        let mut codes = Samples::empty(SampleKind::F32);
        coding.encode(bytes, &mut codes);
        count_between(&codes, lo, hi, &mut histogram);
        done += bytes.len() as u64;
        on_progress(done, planes.bytes())
    })?;
    Ok(histogram)
}

/// Returns the facts of levels that were surveyed.
pub(crate) fn facts(
    coding: Coding,
    (anatomical, finest_vox): (bool, f64),
    mut found: Vec<Surveyed>,
    recount: impl FnMut(f64, f64) -> Result<Vec<u64>, Problem>,
) -> Result<Result<Facts, Unfinished>, Problem> {
    let counter = found[0].take_counter().expect("level 0 was counted");
    let summary = counter.summary(coding.map(), anatomical, recount)?;
    let bins = ValueBins::of(&summary);
    let digest = |(level, of): (u32, &Surveyed)| of.digest(level, finest_vox, &summary);
    let digests: Vec<Digest32> = (0..).zip(&found).map(digest).collect();
    let blocks: Option<Vec<_>> = found.iter().map(|level| level.blocks(bins)).collect();
    let Some(blocks) = blocks else {
        return Ok(Err(Unfinished { coding, summary, digests }));
    };
    let level = |(digest, blocks)| LevelFacts { digest, blocks: Arc::new(blocks) };
    let levels = digests.into_iter().zip(blocks).map(level).collect();
    Ok(Ok(Facts { coding, summary, levels }))
}

/// Looks at all blocks of all levels of a source.
pub(crate) fn blocks_again(
    source: &dyn BlockSource,
    unfinished: Unfinished,
) -> Result<Facts, Problem> {
    let Unfinished { coding, summary, digests } = unfinished;
    let bins = ValueBins::of(&summary);
    let mut levels = Vec::new();
    for (level, digest) in digests.into_iter().enumerate() {
        let blocks = Arc::new(crate::blocks::summaries_of(source, level, bins)?);
        levels.push(LevelFacts { digest, blocks });
    }
    Ok(Facts { coding, summary, levels })
}
