//! Opens volumes of which blocks are read on request, and tells which volumes need that.

use super::ome_zarr::{OmeZarrSource, OnProgress};
use super::raw::RawSource;
use super::{BlockSource, FormulaSource, MemorySource, packed};
use crate::error::{OpenError, Problem};
use crate::{Hints, formula};
use std::path::Path;
use std::sync::Arc;

/// Opens a volume of which blocks are read on request: a Zarr array or an OME-Zarr pyramid, an
/// uncompressed file of raw numbers, NRRD, MetaImage or NIfTI, or a formula.
///
/// The first time, a pass reads all samples and finds digests, counts and block summaries.
/// `on_progress` is called during it. The results are kept in the folder `cache` for later calls.
/// Pyramids that slabcast wrote have them in their own folder and need no pass.
///
/// A packed file is converted into `cache` first where `packed` says so. Notes for people are added to
/// `notes`.
///
/// # Errors
/// The volume has another form and must be converted first; it can't be read or is damaged; or
/// `on_progress` returned an error.
pub fn open_source(
    path: &Path,
    hints: &Hints,
    cache: Option<&Path>,
    packed: Packed,
    notes: &mut Vec<String>,
    on_progress: &mut OnProgress<'_>,
) -> Result<Arc<dyn BlockSource>, OpenError> {
    let shown = path.to_string_lossy();
    open(path, &shown, hints, (cache, packed), notes, on_progress)
        .map_err(|problem| OpenError { file: shown.clone().into_owned(), problem })
}

/// Treatment of files whose samples are packed, so that no part of them can be read by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Packed {
    /// Names the command that converts them.
    Refused,
    /// Converts them to OME-Zarr in the cache, once. It takes minutes for gigabytes.
    Converted,
}

/// Bytes of samples from which a Zarr picture is read by blocks rather than as a whole.
const LARGE_BYTES: u64 = 256 << 20;

/// Returns whether a volume is better read by blocks ([`open_source`]) than as a whole: a Zarr
/// picture with a finest level of more than 256 MiB, or a formula for tests of size.
pub fn is_large(path: &Path, hints: &Hints) -> bool {
    if path.to_string_lossy().starts_with(FormulaSource::PREFIX) {
        return true;
    }
    if !path.is_dir() || !crate::zarr::is_node(path) {
        return false;
    }
    let finest = crate::zarr::Picture::open(path).and_then(|p| p.level(0, &hints.pick));
    finest.is_ok_and(|(array, placed)| placed.bytes(&array) > LARGE_BYTES)
}

fn open(
    path: &Path,
    shown: &str,
    hints: &Hints,
    (cache, packed): (Option<&Path>, Packed),
    notes: &mut Vec<String>,
    on_progress: &mut OnProgress<'_>,
) -> Result<Arc<dyn BlockSource>, Problem> {
    if shown.starts_with(FormulaSource::PREFIX) {
        return Ok(Arc::new(FormulaSource::open(shown)?));
    }
    if shown.starts_with(formula::PREFIX) {
        let volume = Arc::new(formula::open(shown)?);
        let digest = volume.digest();
        return Ok(Arc::new(MemorySource::new(volume, digest)));
    }
    if path.is_dir() && crate::zarr::is_node(path) {
        return Ok(Arc::new(OmeZarrSource::open(path, hints, cache, on_progress)?));
    }
    if let Some(source) = RawSource::open(path, hints, cache, on_progress)? {
        return Ok(Arc::new(source));
    }
    if packed == Packed::Converted
        && packed::may_be_converted(path)
        && let Some(cache) = cache
    {
        let (source, told) = packed::open(path, hints, cache, on_progress)?;
        notes.extend(told);
        return Ok(Arc::new(source));
    }
    Err(Problem::unsupported(
        "content",
        "can't be read block by block: its samples are packed, or in several files",
        "convert it with `slabcast convert FILE OUT.ome.zarr`",
    ))
}
