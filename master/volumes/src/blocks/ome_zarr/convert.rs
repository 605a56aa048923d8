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

/// Callback for the progress of a pass over a volume: bytes done and bytes in all. An error ends
/// the work.
pub type OnProgress<'a> = dyn FnMut(u64, u64) -> Result<(), Problem> + 'a;

/// A volume that was written as OME-Zarr.
#[derive(Clone, Debug)]
pub struct Converted {
    /// The levels, the finest first.
    pub levels: Vec<VolumeInfo>,
    /// Choices that the reader made, one sentence each, to show to the user.
    pub notes: Vec<String>,
}

/// Converts a volume of any format to OME-Zarr in the new folder `to`. Samples keep their type and
/// value; each coarser level has means of two samples along each axis. Files with their samples in
/// order are read slice by slice, whatever their size; others are read as a whole first. With
/// `replace`, a Zarr folder at `to` is removed once the new one is complete.
///
/// `on_progress` is called during each pass. Integers of 8 and 16 bits need one pass, other types
/// two, and floats with outliers more.
///
/// # Errors
/// The volume can't be read, `to` exists or can't be written, memory is short, or `on_progress`
/// returned an error. Then nothing is left at `to`.
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

/// Writes planes as OME-Zarr in the new folder `to`; returns the levels, the finest first.
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
        // A rename can't replace a folder with files, so the old one is moved away and removed
        // later.
        let old = builder.tempdir_in(parent).map_err(|e| written(parent, &e))?;
        std::fs::rename(to, old.path().join("old")).map_err(|e| written(to, &e))?;
    }
    std::fs::rename(folder.path(), to).map_err(|e| written(to, &e))?;
    // The folder was renamed to `to`, so it must not be removed as a temporary one.
    let _ = folder.keep();
    Ok(levels)
}

/// Writes all files of a pyramid into a folder: metadata, levels and sidecar.
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
    // The pass guessed other bins, or dropped the sets of codes: all blocks are read again.
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

/// Returns the descriptions of all levels, the finest first.
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

/// Syncs all files of a folder to the disk, so that a folder with its final name is complete even
/// after a power cut.
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

/// Result of the passes over all numbers of a volume.
pub(crate) struct Walked {
    /// Facts, or facts without block summaries if all blocks must be read again.
    pub(crate) facts: Result<Facts, Unfinished>,
}

/// Facts without block summaries: all blocks must be read again.
pub(crate) struct Unfinished {
    pub(crate) coding: Coding,
    pub(crate) summary: ValueSummary,
    pub(crate) digests: Vec<Digest32>,
}

impl Unfinished {
    /// Returns facts with empty block summaries, to open the levels with.
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

/// Makes and surveys the levels of a volume: one pass for the range of its numbers if codes depend
/// on it, one for everything else. `writers`, one for each level, write them.
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

/// Returns the facts of surveyed levels. `recount` counts codes again for
/// [`ValueSummary::find_core`].
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

/// Computes the missing block summaries; reads all blocks of all levels of `source`.
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
