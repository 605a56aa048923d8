//! Volumes that clients put on a master: pieces in, a file out.
//!
//! Samples go to a file with a temporary name as they come, and through the hash that names the
//! volume. The file gets its name when all samples are there, their digest is the announced one, and
//! they are on disk. Chunks come in order, may come twice, and are answered with what is there, so a
//! client whose connection broke goes on where it was.

use super::stored::{self, Stored};
use super::{VolumeError, sample_bytes, short_name};
use slabcast_common::volume::{Digest32, VolumeHasher};
use slabcast_proto::model::VolumeHeader;
use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::io::Write;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tracing::{info, warn};

/// Uploads in progress at most, of all clients and of one address.
const AT_ONCE: usize = 16;
const AT_ONCE_OF_PEER: usize = 4;

/// An upload that gets nothing for so long is dropped.
const IDLE: Duration = Duration::from_secs(600);

/// File that a master locks.
const LOCK: &str = ".lock";

/// Ending of whole files; their names are digests.
const WHOLE: &str = "volume";
/// Ending of files of uploads in progress.
const PART: &str = "part";
/// Ending of folders with files that are to be read.
const FILES: &str = "files";

/// Folder and quota of uploaded volumes.
#[derive(Clone, Debug)]
pub struct UploadConfig {
    /// Folder for their files; it is made if it is missing.
    pub folder: PathBuf,
    /// Bytes that all of them may take.
    pub quota_bytes: u64,
}

/// State of an upload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Bytes of samples that are there.
    pub received_bytes: u64,
    /// Whether the volume is there.
    pub done: bool,
}

/// A volume that is there now.
pub(super) struct Whole {
    pub(super) stored: Stored,
    /// Address that sent it.
    pub(super) uploader: Option<IpAddr>,
}

/// See the head of the file.
pub(super) struct Uploads {
    config: UploadConfig,
    parts: Mutex<BTreeMap<Digest32, Arc<Mutex<Part>>>>,
    /// Number of the next folder for files.
    folders: AtomicU64,
    /// Keeps other masters away from the folder.
    _lock: File,
}

/// An upload in progress. Its file goes with it, unless it got its name.
struct Part {
    header: VolumeHeader,
    peer: Option<IpAddr>,
    file: File,
    path: PathBuf,
    hasher: Option<VolumeHasher>,
    received: u64,
    total: u64,
    touched: Instant,
}

impl Drop for Part {
    fn drop(&mut self) {
        // After it got its name there is none of this name.
        let _ = std::fs::remove_file(&self.path);
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // No thread panics while it holds one of these locks.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Uploads {
    /// Makes the folder, and clears it of uploads that an earlier master did not finish.
    ///
    /// # Errors
    /// The folder can't be made or read. One line for people.
    pub(super) fn new(config: UploadConfig) -> Result<Uploads, String> {
        let folder = &config.folder;
        let failed = |e: std::io::Error| {
            format!("--uploads {}: {e}; give a folder that this user may write", folder.display())
        };
        std::fs::create_dir_all(folder).map_err(failed)?;
        let lock = File::create(folder.join(LOCK)).map_err(failed)?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let folder = folder.display();
                let taken = "another master uses it; give each a folder of its own";
                return Err(format!("--uploads {folder}: {taken}"));
            }
            // File systems without locks.
            Err(TryLockError::Error(_)) => {}
        }
        for file in std::fs::read_dir(folder).map_err(failed)? {
            let path = file.map_err(failed)?.path();
            if path.extension().is_some_and(|e| e == PART) {
                let _ = std::fs::remove_file(&path);
            }
            if path.extension().is_some_and(|e| e == FILES) {
                let _ = std::fs::remove_dir_all(&path);
            }
        }
        let (parts, folders) = Default::default();
        Ok(Uploads { config, parts, folders, _lock: lock })
    }

    /// Makes an empty folder for files of `bytes` bytes in all. `held_bytes`: of the volumes that are
    /// there. Whoever asked removes it; a master that begins removes what an earlier one left.
    ///
    /// # Errors
    /// There is no place for them.
    pub(super) fn folder_for(&self, bytes: u64, held_bytes: u64) -> Result<PathBuf, VolumeError> {
        let coming: u64 = lock(&self.parts).values().map(|part| lock(part).total).sum();
        let quota = self.config.quota_bytes;
        if held_bytes.saturating_add(coming).saturating_add(bytes) > quota {
            let mib = |bytes: u64| bytes.div_ceil(1 << 20);
            let why = format!(
                "the files take {} MiB, and of the {} MiB for uploaded volumes (--upload-quota) {} MiB \
                 are used; remove a volume",
                mib(bytes),
                quota >> 20,
                mib(held_bytes + coming)
            );
            return Err(VolumeError::NoRoom(why, false));
        }
        let number = self.folders.fetch_add(1, Ordering::Relaxed);
        let path = self.config.folder.join(format!("{}-{number}.{FILES}", std::process::id()));
        std::fs::create_dir(&path).map_err(|e| no_place(&path, &e))?;
        Ok(path)
    }

    /// Returns the volumes that are there, each with its name. Warns of files that are damaged.
    pub(super) fn found(&self) -> Vec<(String, Stored)> {
        let Ok(files) = std::fs::read_dir(&self.config.folder) else { return Vec::new() };
        let paths = files.filter_map(|file| Some(file.ok()?.path()));
        let whole = paths.filter(|path| path.extension().is_some_and(|e| e == WHOLE));
        let found = whole.filter_map(|path| match stored::find(&path) {
            Ok(stored) => Some((stored.header.name.clone(), stored)),
            Err(e) => {
                warn!(file = %path.display(), error = %e, "an uploaded volume can't be read");
                None
            }
        });
        found.collect()
    }

    /// Begins an upload, or finds how far it is. `held_bytes`: of the files that are there.
    ///
    /// # Errors
    /// There is no place for it.
    pub(super) fn begin(
        &self,
        header: VolumeHeader,
        peer: Option<IpAddr>,
        held_bytes: u64,
    ) -> Result<Progress, VolumeError> {
        let (digest, total) = (header.info.digest, sample_bytes(&header.info));
        let mut parts = lock(&self.parts);
        parts.retain(|digest, part| {
            let stays = lock(part).touched.elapsed() < IDLE;
            if !stays {
                info!(volume = short_name(*digest), "an upload that stood still is dropped");
            }
            stays
        });
        if let Some(part) = parts.get(&digest) {
            return Ok(Progress { received_bytes: lock(part).received, done: false });
        }
        let of_peer = parts.values().filter(|part| lock(part).peer == peer).count();
        if parts.len() >= AT_ONCE || of_peer >= AT_ONCE_OF_PEER {
            let why = format!(
                "{} uploads are in progress, {of_peer} of them from your address: as many as the \
                 master takes; wait",
                parts.len()
            );
            return Err(VolumeError::NoRoom(why, true));
        }
        let coming: u64 = parts.values().map(|part| lock(part).total).sum();
        let quota = self.config.quota_bytes;
        if held_bytes.saturating_add(coming).saturating_add(total) > quota {
            let mib = |bytes: u64| bytes.div_ceil(1 << 20);
            let why = format!(
                "`{}` takes {} MiB, and of the {} MiB for uploaded volumes (--upload-quota) {} MiB \
                 are used; remove one (`slabcast rm NAME`)",
                header.name,
                mib(total),
                quota >> 20,
                mib(held_bytes + coming)
            );
            return Err(VolumeError::NoRoom(why, false));
        }
        let path = self.config.folder.join(format!("{digest}.{PART}"));
        let created = File::create(&path).and_then(|mut file| {
            file.write_all(&stored::head(&header))?;
            Ok(file)
        });
        let file = created.map_err(|e| no_place(&path, &e))?;
        let hasher = VolumeHasher::of(&header.info.lattice, &header.info.summary);
        let (received, touched) = (0, Instant::now());
        let hasher = Some(hasher);
        let part = Part { header, peer, file, path, hasher, received, total, touched };
        parts.insert(digest, Arc::new(Mutex::new(part)));
        Ok(Progress { received_bytes: 0, done: false })
    }

    /// Adds a piece. Returns how far the upload is, and the volume with its uploader if it is whole.
    ///
    /// # Errors
    /// There is no such upload; the disk is full; or the samples have another digest. Of an upload that
    /// fails nothing stays.
    pub(super) fn add(
        &self,
        digest: Digest32,
        offset: u64,
        data: &[u8],
    ) -> Result<(Progress, Option<Whole>), VolumeError> {
        let unknown = || {
            let name = short_name(digest);
            VolumeError::NotFound(format!("no upload of {name} is in progress; begin it anew"))
        };
        let part = lock(&self.parts).get(&digest).cloned().ok_or_else(unknown)?;
        let mut part = lock(&part);
        part.touched = Instant::now();
        let end = offset.saturating_add(data.len() as u64);
        if end > part.total {
            let why = format!("chunk: ends at byte {end}, and there are {}", part.total);
            return Err(VolumeError::Choose(why));
        }
        // What is there already, or comes too early, is not written.
        if offset <= part.received && end > part.received {
            let new = &data[(part.received - offset) as usize..];
            if let Err(e) = part.file.write_all(new) {
                lock(&self.parts).remove(&digest);
                return Err(no_place(&part.path, &e));
            }
            part.received = end;
            if let Some(hasher) = &mut part.hasher {
                hasher.update(new);
            }
        }
        let received_bytes = part.received;
        if received_bytes < part.total {
            return Ok((Progress { received_bytes, done: false }, None));
        }
        let whole = self.finish(&mut part, digest);
        lock(&self.parts).remove(&digest);
        let whole = Whole { stored: whole?, uploader: part.peer };
        Ok((Progress { received_bytes, done: true }, Some(whole)))
    }

    fn finish(&self, part: &mut Part, digest: Digest32) -> Result<Stored, VolumeError> {
        let name = &part.header.name;
        if part.hasher.take().map(|hasher| part.header.info.finish(hasher)) != Some(digest) {
            return Err(VolumeError::Damaged(format!(
                "`{name}`: its samples have another digest than was announced; send it again"
            )));
        }
        let path = self.config.folder.join(format!("{digest}.{WHOLE}"));
        let named = part.file.sync_all().and_then(|()| std::fs::rename(&part.path, &path));
        named.and_then(|()| sync_folder(&self.config.folder)).map_err(|e| no_place(&path, &e))?;
        let file_bytes = stored::head(&part.header).len() as u64 + part.total;
        Ok(Stored { path, file_bytes, header: part.header.clone() })
    }
}

/// Writes a folder's names to disk.
fn sync_folder(folder: &Path) -> std::io::Result<()> {
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}

fn no_place(path: &Path, e: &std::io::Error) -> VolumeError {
    let why = format!("writing {} failed: {e}; nothing is kept of the upload", path.display());
    VolumeError::NoRoom(why, false)
}
