//! Opens files that are not trusted.
//!
//! Three rules (docs/design/promises.md R13 to R15). Only regular files are opened, so no pipe can
//! block the program. What a header names, and what a folder holds, is opened only inside that
//! folder ([`Folder`]). A size in a header takes no memory before as many bytes were seen.

use crate::error::{OpenErrorKind, Problem};
use crate::limit::ByteCap;
use crate::pick::Pick;
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read, Seek};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// Reader under a [`Source`]: a file, or bytes of a test.
pub(crate) trait Stream: Read + Seek + Send {
    /// Returns the file, for reading at places of its own; `None` for anything else.
    fn file(&self) -> Option<File> {
        None
    }
}

impl Stream for File {
    fn file(&self) -> Option<File> {
        self.try_clone().ok()
    }
}

impl Stream for std::io::Cursor<Vec<u8>> {}

/// An open file with its length, or the bytes of a test.
pub(crate) struct Source {
    pub(crate) reader: BufReader<Box<dyn Stream>>,
    /// Bytes of the whole file.
    pub(crate) len: u64,
    /// Most bytes of samples that it may become.
    pub(crate) cap: ByteCap,
    /// Which volume to read, if there are several.
    pub(crate) pick: Pick,
    /// Choices that the reader makes, for the user.
    pub(crate) notes: Notes,
}

/// Notes of a reader, shared by all sources and decoders of one volume.
#[derive(Clone, Debug, Default)]
pub(crate) struct Notes(Arc<Mutex<Vec<String>>>);

impl Notes {
    /// Adds a sentence, if it was not said already.
    pub(crate) fn add(&self, note: impl Into<String>) {
        let (note, mut notes) = (note.into(), self.0.lock().unwrap_or_else(|e| e.into_inner()));
        if !notes.contains(&note) {
            notes.push(note);
        }
    }

    /// Returns all notes, and leaves none.
    pub(crate) fn take(&self) -> Vec<String> {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(|e| e.into_inner()))
    }
}

/// Enough to recognise a format ([`Source::head`]) with few system calls. Samples are read past the
/// buffer in larger pieces.
pub(crate) const BUFFER_BYTES: usize = 64 << 10;

impl Source {
    /// Opens a regular file; refuses a folder, pipe, socket or device without reading it.
    pub(crate) fn open(path: &Path, field: &str) -> Result<Source, Problem> {
        let unreadable = |what: String, remedy: &str| {
            Err(Problem::new(OpenErrorKind::Unreadable, field, what, remedy))
        };
        let refused = |e: std::io::Error| match e.kind() {
            std::io::ErrorKind::NotFound => {
                unreadable("no such file".into(), "check the path's spelling")
            }
            std::io::ErrorKind::PermissionDenied => {
                unreadable("permission denied".into(), "make the file readable for this user")
            }
            _ => unreadable(format!("can't be opened ({e})"), "check the path"),
        };
        // Checked before opening, since opening a pipe waits for its writer, and again after it, in
        // case the file was replaced meanwhile.
        let meta = match std::fs::metadata(path) {
            Ok(meta) => meta,
            Err(e) => return refused(e),
        };
        if meta.is_dir() {
            return unreadable("is a folder".into(), "give a file");
        }
        if !meta.is_file() {
            return Err(Problem::new(
                OpenErrorKind::Forbidden,
                field,
                "is a pipe, socket or device, and was not read",
                "copy its bytes into a file",
            ));
        }
        let file = match File::open(path) {
            Ok(file) => file,
            Err(e) => return refused(e),
        };
        let meta = file.metadata().map_err(|e| Problem::io(field, &e))?;
        if !meta.is_file() {
            return unreadable("changed while it was opened".into(), "try again");
        }
        Ok(Source::from_file(file, meta.len()))
    }

    /// Returns a source of an open regular file of `len` bytes.
    fn from_file(file: File, len: u64) -> Source {
        let reader = BufReader::with_capacity(BUFFER_BYTES, Box::new(file) as Box<dyn Stream>);
        Source {
            reader,
            len,
            cap: ByteCap::default(),
            pick: Pick::default(),
            notes: Notes::default(),
        }
    }

    /// Returns a source of bytes, for tests.
    #[cfg(test)]
    pub(crate) fn from_bytes(bytes: Vec<u8>) -> Source {
        let len = bytes.len() as u64;
        Source {
            reader: BufReader::with_capacity(BUFFER_BYTES, Box::new(std::io::Cursor::new(bytes))),
            len,
            cap: ByteCap::default(),
            pick: Pick::default(),
            notes: Notes::default(),
        }
    }

    /// Returns the first bytes (up to 64 KiB) without consuming them.
    pub(crate) fn head(&mut self) -> Result<&[u8], Problem> {
        self.reader.fill_buf().map_err(|e| Problem::io("content", &e))
    }
}

/// A folder that files are opened in, and never outside.
///
/// The kernel resolves each name beneath the folder where it can (`openat2`, Linux 5.6), so that no
/// link swapped meanwhile leads out. A name that the kernel refuses is resolved once more by its
/// real path: an absolute link that comes back inside is fine. Elsewhere the real path alone
/// decides.
///
/// Nobody learns from an answer whether a file outside exists: all that leads out is
/// [`Inside::Out`], whatever is there.
#[derive(Debug)]
pub(crate) struct Folder {
    path: PathBuf,
    #[cfg(target_os = "linux")]
    handle: std::os::fd::OwnedFd,
}

/// Kind of a name in a [`Folder`].
#[derive(Debug)]
pub(crate) enum Inside {
    /// A regular file, and its length in bytes.
    File(File, u64),
    /// A folder, pipe, socket or device.
    Other,
    /// Nothing.
    Missing,
    /// A name or link that leads out of the folder.
    Out,
}

impl Folder {
    /// Opens a folder; an empty path is the current one. `field` is for messages.
    pub(crate) fn open(path: &Path, field: &str) -> Result<Folder, Problem> {
        let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
        let io = |e: std::io::Error| Problem::io(field, &e);
        let path = path.canonicalize().map_err(io)?;
        Ok(Folder {
            #[cfg(target_os = "linux")]
            handle: File::open(&path).map_err(io)?.into(),
            path,
        })
    }

    /// Opens what is called `name`, a path from this folder.
    ///
    /// # Errors
    /// The system refuses to open a file or folder inside.
    pub(crate) fn find(&self, name: &Path) -> std::io::Result<Inside> {
        // From the folder, so that the kernel takes it for a path beneath.
        let below = name.strip_prefix(&self.path).unwrap_or(name);
        let file = match self.open_beneath(below) {
            Ok(Some(file)) => file,
            Ok(None) => match self.real_path(name) {
                Some(Some(real)) if std::fs::metadata(&real)?.is_file() => File::open(real)?,
                Some(Some(_)) => return Ok(Inside::Other),
                Some(None) => return Ok(Inside::Missing),
                None => return Ok(Inside::Out),
            },
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
                return Ok(Inside::Missing);
            }
            // A socket can't be opened.
            Err(e) if e.raw_os_error() == Some(NO_SUCH_DEVICE) => return Ok(Inside::Other),
            Err(e) => return Err(e),
        };
        let meta = file.metadata()?;
        Ok(match meta.is_file() {
            true => Inside::File(file, meta.len()),
            false => Inside::Other,
        })
    }

    /// Returns the real path of a name inside, `Some(None)` for a name inside that is nothing, and
    /// `None` for one that leads out. A dangling link leads out, wherever it points.
    fn real_path(&self, name: &Path) -> Option<Option<PathBuf>> {
        let whole = self.path.join(name);
        // `there` is the longest part of the path that exists.
        let there = whole.ancestors().find(|step| step.symlink_metadata().is_ok())?;
        let real = there.canonicalize().ok().filter(|real| real.starts_with(&self.path))?;
        Some((there == whole).then_some(real))
    }

    /// Opens a path beneath the folder without waiting for a pipe's writer. `None` if the kernel
    /// says that it leads out, or can't say.
    #[cfg(target_os = "linux")]
    fn open_beneath(&self, name: &Path) -> std::io::Result<Option<File>> {
        use rustix::fs::{Mode, OFlags, ResolveFlags, openat2};
        use rustix::io::Errno;
        let flags = OFlags::RDONLY | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
        let beneath = ResolveFlags::BENEATH | ResolveFlags::NO_MAGICLINKS;
        match openat2(&self.handle, name, flags, Mode::empty(), beneath) {
            Ok(file) => Ok(Some(file.into())),
            // Out; the folder was renamed meanwhile; a kernel or a container without the call.
            Err(Errno::XDEV | Errno::AGAIN | Errno::NOSYS | Errno::PERM) => Ok(None),
            Err(Errno::LOOP | Errno::INVAL | Errno::NAMETOOLONG) => Err(ErrorKind::NotFound.into()),
            Err(e) => Err(e.into()),
        }
    }

    #[cfg(not(target_os = "linux"))]
    fn open_beneath(&self, _name: &Path) -> std::io::Result<Option<File>> {
        Ok(None)
    }

    /// Returns whether something is called `name`, inside or, by a link, outside. What it is,
    /// opening it tells.
    #[cfg(feature = "zarr")]
    pub(crate) fn has(&self, name: &str) -> bool {
        !matches!(self.find(Path::new(name)), Ok(Inside::Missing | Inside::Other))
    }

    /// Opens a file that a header or metadata name. `field` is the header's name for it.
    ///
    /// # Errors
    /// One error for what is missing and for what lies outside, so that no header can ask what
    /// exists elsewhere. Others for a folder, pipe or device, and for what can't be read.
    pub(crate) fn named(&self, name: &str, field: &str) -> Result<Source, Problem> {
        let shown = crate::error::quoted(name);
        match self.find(Path::new(name)).map_err(|e| Problem::io(field, &e))? {
            Inside::File(file, len) => Ok(Source::from_file(file, len)),
            Inside::Missing | Inside::Out => Err(not_inside(&shown, field)),
            Inside::Other => Err(Problem::new(
                OpenErrorKind::Forbidden,
                field,
                format!("{shown} is a folder, pipe, socket or device, and was not read"),
                "copy its bytes into a file",
            )),
        }
    }
}

/// Errno of opening a socket (ENXIO), which has no kind of its own.
const NO_SUCH_DEVICE: i32 = 6;

/// Returns the error for a name that is not in its folder, or leads out of it.
pub(crate) fn not_inside(shown: &str, field: &str) -> Problem {
    Problem::new(
        OpenErrorKind::Forbidden,
        field,
        format!("{shown} is not there, or leads out of the folder"),
        "put the data file beside its header, in the folder, and name it without `..`, links or a root",
    )
}

/// Skips lines and returns their bytes; `None` if the data end before.
pub(crate) fn skip_lines(reader: &mut impl BufRead, lines: u64) -> std::io::Result<Option<u64>> {
    let mut skipped = 0;
    let mut left = lines;
    while left > 0 {
        let chunk = reader.fill_buf()?;
        if chunk.is_empty() {
            return Ok(None);
        }
        let used = match chunk.iter().position(|&b| b == b'\n') {
            Some(newline) => {
                left -= 1;
                newline + 1
            }
            None => chunk.len(),
        };
        reader.consume(used);
        skipped += used as u64;
    }
    Ok(Some(skipped))
}

/// Reads and drops bytes; false if the data end before.
pub(crate) fn skip_bytes(reader: &mut dyn Read, bytes: u64) -> std::io::Result<bool> {
    Ok(std::io::copy(&mut reader.take(bytes), &mut std::io::sink())? == bytes)
}
