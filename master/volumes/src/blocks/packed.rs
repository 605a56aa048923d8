//! A packed file that does not fit into memory, as OME-Zarr in the cache.
//!
//! The file is converted once. Later openings find the picture in the cache by the file's size, time,
//! ends and header. Files whose samples lie in a second file, and folders, are not converted: the cache
//! could not tell when the second file changes.

use super::ome_zarr::{OmeZarrSource, OnProgress, write_pyramid};
use super::planes::Planes;
use super::raw::{describe, ends, stamp};
use crate::error::{OpenErrorKind, Problem};
use crate::{DETACHED_HEADERS, Hints};
use sha2::{Digest, Sha256};
use slabcast_common::volume::Digest32;
use std::path::Path;

/// Bytes of a pyramid for each byte of level 0: the coarser levels add a seventh.
const PYRAMID: f64 = 8.0 / 7.0;

/// Returns whether a packed volume may be kept as OME-Zarr in the cache.
pub(super) fn may_be_converted(path: &Path) -> bool {
    let name = path.to_string_lossy().to_lowercase();
    // `.img` is the other half of an ANALYZE or NIfTI pair.
    let mut of_two_files = DETACHED_HEADERS.iter().chain(&[".img"]);
    path.is_file() && !of_two_files.any(|ending| name.ends_with(ending))
}

/// Opens a packed file by way of its OME-Zarr picture in `cache`, which is made if it is not there.
/// Returns it with notes for people.
///
/// # Errors
/// The file can't be read or is damaged; the cache has no room or can't be written; `on_progress`
/// returned an error.
pub(super) fn open(
    path: &Path,
    hints: &Hints,
    cache: &Path,
    on_progress: &mut OnProgress<'_>,
) -> Result<(OmeZarrSource, Vec<String>), Problem> {
    let planes = Planes::open(path, hints)?;
    let mut hash = Sha256::new();
    hash.update(b"slabcast packed 1");
    let file = std::fs::File::open(path).map_err(|e| Problem::io("file", &e))?;
    ends(&file, stamp(&file)?, &mut hash)?;
    describe(&planes, &mut hash);
    hash.update(format!("{:?} {:?}", hints.pick, hints.dataset));
    let folder = cache.join("volumes");
    let picture = folder.join(format!("{}.ome.zarr", Digest32(hash.finalize().into())));
    let level = Hints { level: hints.level, ..Hints::default() };
    let read = |on_progress: &mut OnProgress<'_>| {
        let source = OmeZarrSource::open(&picture, &level, None, on_progress)?;
        Ok(source.named(&planes.name, &planes.file_type))
    };
    let mut notes = planes.notes.clone();
    if picture.is_dir() {
        if let Ok(source) = read(on_progress) {
            return Ok((source, notes));
        }
        // It was cut short or changed from outside.
        std::fs::remove_dir_all(&picture).map_err(|e| Problem::io("cache", &e))?;
    }
    std::fs::create_dir_all(&folder).map_err(|e| Problem::io("cache", &e))?;
    let samples = planes.lattice.len() as f64 * planes.number.bytes() as f64;
    check_room(&folder, (samples * PYRAMID) as u64)?;
    match write_pyramid(&planes, &picture, false, on_progress) {
        // Another process may have been faster.
        Err(_) if picture.is_dir() => {}
        written => drop(written?),
    }
    notes.push(format!(
        "converted once, into {}; remove that folder to free its space",
        picture.display()
    ));
    Ok((read(on_progress)?, notes))
}

/// Checks that a folder's disk has room for so many bytes. Systems that can't say have room.
fn check_room(folder: &Path, bytes: u64) -> Result<(), Problem> {
    match free_bytes(folder) {
        Some(free) if free < bytes => Err(Problem::new(
            OpenErrorKind::TooLarge,
            "cache",
            format!(
                "it does not fit into memory, and its picture of {} MiB not into {}, which has {} MiB free",
                bytes >> 20,
                folder.display(),
                free >> 20
            ),
            "set SLABCAST_CACHE to a folder of a larger disk",
        )),
        _ => Ok(()),
    }
}

#[cfg(unix)]
fn free_bytes(folder: &Path) -> Option<u64> {
    let disk = rustix::fs::statvfs(folder).ok()?;
    Some(disk.f_bavail.saturating_mul(disk.f_frsize))
}

#[cfg(not(unix))]
fn free_bytes(_folder: &Path) -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn disk_without_room_is_refused_with_figures() {
        let folder = tempfile::tempdir().expect("a folder");
        assert!(check_room(folder.path(), 1).is_ok());
        let e = check_room(folder.path(), u64::MAX).expect_err("no disk has that").to_string();
        assert!(e.contains("MiB free") && e.contains("SLABCAST_CACHE"), "{e}");
    }
}
