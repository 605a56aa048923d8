//! Opens volumes of which blocks are read on request, and tells which volumes need that.

use super::ome_zarr::{OmeZarrSource, OnProgress};
use super::raw::RawSource;
use super::{BlockSource, FormulaSource, MemorySource};
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
/// # Errors
/// The volume has another form and must be converted first; it can't be read or is damaged; or
/// `on_progress` returned an error.
pub fn open_source(
    path: &Path,
    hints: &Hints,
    cache: Option<&Path>,
    on_progress: &mut OnProgress<'_>,
) -> Result<Arc<dyn BlockSource>, OpenError> {
    let shown = path.to_string_lossy();
    open(path, &shown, hints, cache, on_progress)
        .map_err(|problem| OpenError { file: shown.clone().into_owned(), problem })
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
    cache: Option<&Path>,
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
    match RawSource::open(path, hints, cache, on_progress)? {
        Some(source) => Ok(Arc::new(source)),
        None => Err(Problem::unsupported(
            "content",
            "can't be read block by block: its samples are packed, or in several files",
            "convert it with `slabcast convert FILE OUT.ome.zarr`",
        )),
    }
}
