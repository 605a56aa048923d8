//! Files that are whole or not there, and patience with a disk that is full.
//!
//! A file is filled under a hidden name in its folder, synced, and renamed; so its own name always
//! holds all of it, whatever happens (full disk, Ctrl-C, power). A full disk is weather, not an
//! end: hours of rendering wait at the master for somebody to make room ([`DiskWait`]).

use crate::fail::Fail;
use crate::progress;
use crate::terminal::one_line;
use std::fs::{File, Permissions};
use std::io::{BufWriter, Error, ErrorKind, Result, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tempfile::NamedTempFile;

/// A hidden file beside its final name; it is gone when dropped, unless it is persisted.
pub(super) fn hidden(folder: &Path, name: &str) -> Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    let prefix = format!(".{name}.");
    builder.prefix(&prefix).suffix(".tmp");
    #[cfg(unix)]
    // What the umask leaves, as for any file of the user's; the crate's own choice is 0600.
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

/// Time between two attempts on a full disk. A person who deletes something looks at the progress
/// within a second or two; at a tenth of this, nothing is gained and logs of the file system fill.
const TRY_AGAIN: Duration = Duration::from_secs(1);

/// Waits for room on a full disk: warns once and tries again.
#[derive(Debug, Default)]
pub struct DiskWait {
    given_up: AtomicBool,
    waiting: AtomicBool,
}

impl DiskWait {
    /// Ends all waiting: writes to a full disk fail from now on.
    pub fn give_up(&self) {
        self.given_up.store(true, Ordering::SeqCst);
    }

    /// `write`, again and again while there is no room.
    fn until_room(&self, path: &Path, mut write: impl FnMut() -> Result<()>) -> Result<()> {
        loop {
            match write() {
                Err(e) if no_room(&e) && !self.given_up.load(Ordering::SeqCst) => {
                    if !self.waiting.swap(true, Ordering::SeqCst) {
                        progress::warn(&one_line(&format!(
                            "paused: no room to write {} ({}); it goes on by itself when there is \
                             room, Ctrl-C ends it and keeps what is done",
                            path.display(),
                            crate::fail::reason(&e)
                        )));
                    }
                    self.wait();
                }
                other => {
                    if other.is_ok() && self.waiting.swap(false, Ordering::SeqCst) {
                        progress::note("there is room again: going on");
                    }
                    return other;
                }
            }
        }
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

    /// Writes a whole file or none, and waits while the disk is full.
    ///
    /// # Errors
    /// The file can't be written.
    pub fn write_atomic(
        &self,
        path: &Path,
        fill: impl Fn(&mut BufWriter<&File>) -> Result<()>,
    ) -> std::result::Result<(), Fail> {
        self.until_room(path, || whole(path, &fill)).map_err(|e| Fail::io(path, "writing", &e))
    }
}

/// Whether it is the disk, or the user's share of it, that is full.
fn no_room(e: &Error) -> bool {
    matches!(e.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded)
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
        patience.until_room(path, || {
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

    /// Gives the file its name.
    pub(crate) fn settle(self) -> Result<()> {
        settle(self.file, &self.path)
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
    fn a_growing_file_has_its_name_at_the_end() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("g");
        let mut g = GrowingFile::new(&path).unwrap();
        g.add(b"0123", &DiskWait::default()).unwrap();
        g.add(b"45", &DiskWait::default()).unwrap();
        g.patch(1, b"ab").unwrap();
        assert!(!path.exists());
        g.settle().unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"0ab345");
    }
}
