//! Files that are whole or not there, and patience with a disk that is full or away.
//!
//! A file is filled under a hidden name in its folder, synced, and renamed; so its own name always
//! holds all of it, whatever happens (full disk, Ctrl-C, power). A full disk is weather, not an
//! end: hours of rendering wait at the master for somebody to make room ([`DiskWait`]). So is a
//! folder that was moved away, unmounted or made read-only: files could be made in it when the run
//! began.

use crate::fail::Fail;
use crate::progress;
use crate::terminal::one_line;
use std::fs::{File, Permissions};
use std::io::{BufWriter, Error, ErrorKind, Result, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tempfile::NamedTempFile;

/// A hidden file beside its final name; it is gone when dropped, unless it is persisted.
pub(super) fn hidden(folder: &Path, name: &str) -> Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    let prefix = format!(".{name}.");
    builder.prefix(&prefix).suffix(".tmp");
    #[cfg(unix)]
    // The umask decides, as for any file of the user; the crate's own choice is 0600.
    builder.permissions(<Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o666));
    builder.tempfile_in(folder)
}

/// A hidden file beside `path`.
pub(super) fn beside(path: &Path) -> Result<NamedTempFile> {
    let folder = match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    hidden(folder, &path.file_name().unwrap_or_default().to_string_lossy())
}

/// Checks that a file can be made beside `path`.
///
/// # Errors
/// The file can't be made.
pub fn probe(path: &Path) -> std::result::Result<(), Fail> {
    beside(path).map(drop).map_err(|e| Fail::io(path, "making the file", &e))
}

/// Gives a filled file its name.
pub(super) fn settle(file: NamedTempFile, path: &Path) -> Result<()> {
    file.as_file().sync_all()?;
    file.persist(path).map(drop).map_err(|e| e.error)
}

/// Writes a whole file or none: hidden, synced, renamed.
fn whole(path: &Path, fill: impl FnOnce(&mut BufWriter<&File>) -> Result<()>) -> Result<()> {
    let file = beside(path)?;
    let mut out = BufWriter::with_capacity(1 << 16, file.as_file());
    fill(&mut out).and_then(|()| out.flush())?;
    drop(out);
    settle(file, path)
}

/// Writes a whole file or none.
///
/// # Errors
/// The file can't be written; a full disk too.
pub fn write_atomic(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<&File>) -> Result<()>,
) -> std::result::Result<(), Fail> {
    whole(path, fill).map_err(|e| Fail::io(path, "writing", &e))
}

/// Time between two attempts on a disk that takes nothing. A person who deletes something looks at
/// the progress within a second or two; at a tenth of this, nothing is gained and logs of the file
/// system fill.
const TRY_AGAIN: Duration = Duration::from_secs(1);

/// Waits for a disk that takes nothing: full, or its folder gone or read-only. Warns once and tries
/// again.
#[derive(Debug, Default)]
pub struct DiskWait {
    given_up: AtomicBool,
    /// Text of the note that ends the wait, such as "the folder is back"; `None` while no thread
    /// waits.
    waiting: Mutex<Option<&'static str>>,
}

impl DiskWait {
    /// Ends all waiting: what can't be written fails from now on.
    pub fn give_up(&self) {
        self.given_up.store(true, Ordering::SeqCst);
    }

    /// Makes an attempt to write, again and again while the disk takes nothing.
    pub(super) fn until_taken<T>(
        &self,
        path: &Path,
        mut write: impl FnMut() -> Result<T>,
    ) -> Result<T> {
        loop {
            let e = match write() {
                Err(e) if !self.given_up.load(Ordering::SeqCst) => e,
                other => {
                    // Whichever thread is first says it, in the words of the one that warned.
                    let over = if other.is_ok() { self.waiting().take() } else { None };
                    if let Some(over) = over {
                        progress::note(&format!("{over}: going on"));
                    }
                    return other;
                }
            };
            let Some([what, until, again]) = weather(&e) else { return Err(e) };
            if self.waiting().replace(again).is_none() {
                progress::warn(&one_line(&format!(
                    "paused: {what} to write {} ({}); it goes on by itself when {until}, Ctrl-C \
                     ends it and keeps what is done",
                    path.display(),
                    crate::fail::reason(&e)
                )));
            }
            self.wait();
        }
    }

    fn waiting(&self) -> MutexGuard<'_, Option<&'static str>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait(&self) {
        let slice = TRY_AGAIN / 20;
        for _ in 0..20 {
            if self.given_up.load(Ordering::SeqCst) {
                return;
            }
            std::thread::sleep(slice);
        }
    }

    /// Writes a whole file or none, and waits while the disk is full, or its folder gone or
    /// read-only.
    ///
    /// # Errors
    /// The file can't be written.
    pub fn write_atomic(
        &self,
        path: &Path,
        fill: impl Fn(&mut BufWriter<&File>) -> Result<()>,
    ) -> std::result::Result<(), Fail> {
        self.until_taken(path, || whole(path, &fill)).map_err(|e| Fail::io(path, "writing", &e))
    }
}

/// Returns what is wrong with a disk where a file could be made before, what will end it, and what
/// to say then; `None` for other errors.
fn weather(e: &Error) -> Option<[&'static str; 3]> {
    Some(match e.kind() {
        // The disk, or the user's share of it.
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
            ["no room", "there is room", "there is room again"]
        }
        ErrorKind::NotFound | ErrorKind::NotADirectory | ErrorKind::StaleNetworkFileHandle => {
            ["the folder is gone", "the folder is back", "the folder is back"]
        }
        ErrorKind::ReadOnlyFilesystem | ErrorKind::PermissionDenied => {
            ["not allowed", "it is allowed", "it is allowed again"]
        }
        _ => return None,
    })
}

/// A file that grows piece by piece and gets its name at the end. A piece is there as a whole or
/// not at all.
#[derive(Debug)]
pub(crate) struct GrowingFile {
    path: PathBuf,
    file: NamedTempFile,
    long: u64,
}

impl GrowingFile {
    pub(crate) fn new(path: &Path) -> Result<Self> {
        Ok(GrowingFile { path: path.to_path_buf(), file: beside(path)?, long: 0 })
    }

    /// Adds a piece; waits where there is no room for it.
    pub(crate) fn add(&mut self, piece: &[u8], patience: &DiskWait) -> Result<()> {
        let GrowingFile { path, file, long } = self;
        patience.until_taken(path, || {
            // Removes what a failed attempt left.
            file.as_file().set_len(*long)?;
            file.seek(SeekFrom::Start(*long))?;
            file.write_all(piece)
        })?;
        self.long += piece.len() as u64;
        Ok(())
    }

    /// Puts other bytes over some that are there.
    pub(crate) fn patch(&mut self, at: u64, bytes: &[u8]) -> Result<()> {
        assert!(at + bytes.len() as u64 <= self.long, "a patch lies inside the file");
        self.file.seek(SeekFrom::Start(at))?;
        self.file.write_all(bytes)
    }

    /// The name that it gets.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Gives the file its name. Waits while its folder is gone or read-only. Where the hidden file
    /// went with the folder, it is written once more, from what is still open.
    pub(crate) fn settle(self, patience: &DiskWait) -> Result<()> {
        let GrowingFile { path, file, .. } = self;
        file.as_file().sync_all()?;
        let mut unnamed = Some(file);
        patience.until_taken(&path, || {
            let file = unnamed.take().expect("put back after each failure");
            let failed = match file.persist(&path) {
                Ok(_) => return Ok(()),
                Err(failed) => failed,
            };
            let open = unnamed.insert(failed.file);
            if open.path().exists() {
                return Err(failed.error);
            }
            let mut copy = beside(&path)?;
            open.as_file_mut().seek(SeekFrom::Start(0))?;
            std::io::copy(open.as_file_mut(), copy.as_file_mut())?;
            settle(copy, &path)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_write_that_fails_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("f.png");
        let e = write_atomic(&path, |_| Err(Error::other("no more room"))).unwrap_err();
        assert!(e.line().unwrap().contains("f.png"));
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
        write_atomic(&path, |out| out.write_all(b"whole")).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"whole");
    }

    #[test]
    fn a_full_disk_is_waited_for_and_given_up_on_when_told() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("f");
        let tries = std::cell::Cell::new(0);
        let full_twice = |out: &mut BufWriter<&File>| {
            tries.set(tries.get() + 1);
            if tries.get() < 3 {
                return Err(ErrorKind::StorageFull.into());
            }
            out.write_all(b"whole")
        };
        DiskWait::default().write_atomic(&path, full_twice).unwrap();
        assert_eq!((tries.get(), std::fs::read(&path).unwrap()), (3, b"whole".to_vec()));
        let patience = DiskWait::default();
        patience.give_up();
        let e = patience.write_atomic(&path, |_| Err(ErrorKind::StorageFull.into())).unwrap_err();
        assert!(e.line().unwrap().contains("make room"), "{e:?}");
    }

    #[test]
    fn a_folder_that_is_gone_is_waited_for() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("out");
        let path = folder.join("f");
        let tries = std::cell::Cell::new(0);
        let back_at_the_second = || {
            tries.set(tries.get() + 1);
            if tries.get() == 2 {
                std::fs::create_dir(&folder).unwrap();
            }
            whole(&path, |out| out.write_all(b"whole"))
        };
        DiskWait::default().until_taken(&path, back_at_the_second).unwrap();
        assert_eq!((tries.get(), std::fs::read(&path).unwrap()), (2, b"whole".to_vec()));
        let patience = DiskWait::default();
        patience.give_up();
        std::fs::remove_dir_all(&folder).unwrap();
        assert!(patience.write_atomic(&path, |out| out.write_all(b"whole")).is_err());
    }

    #[test]
    fn only_a_disk_that_takes_nothing_is_waited_for() {
        for kind in [
            ErrorKind::StorageFull,
            ErrorKind::QuotaExceeded,
            ErrorKind::NotFound,
            ErrorKind::ReadOnlyFilesystem,
            ErrorKind::PermissionDenied,
        ] {
            assert!(weather(&kind.into()).is_some(), "{kind}");
        }
        for kind in [ErrorKind::BrokenPipe, ErrorKind::InvalidInput, ErrorKind::Other] {
            assert!(weather(&kind.into()).is_none(), "{kind}");
            let failed =
                DiskWait::default().until_taken(Path::new("f"), || Err::<(), _>(kind.into()));
            assert_eq!(failed.unwrap_err().kind(), kind);
        }
    }

    #[test]
    fn a_growing_file_whose_folder_went_is_whole_when_the_folder_is_back() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("out");
        std::fs::create_dir(&folder).unwrap();
        let path = folder.join("g");
        let mut g = GrowingFile::new(&path).unwrap();
        g.add(b"0123", &DiskWait::default()).unwrap();
        std::fs::remove_dir_all(&folder).unwrap();
        g.add(b"45", &DiskWait::default()).unwrap();
        std::fs::create_dir(&folder).unwrap();
        g.settle(&DiskWait::default()).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"012345");
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
    }

    #[test]
    fn a_growing_file_has_its_name_at_the_end() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("g");
        let mut g = GrowingFile::new(&path).unwrap();
        g.add(b"0123", &DiskWait::default()).unwrap();
        g.add(b"45", &DiskWait::default()).unwrap();
        g.patch(1, b"ab").unwrap();
        assert!(!path.exists());
        g.settle(&DiskWait::default()).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"0ab345");
    }
}
