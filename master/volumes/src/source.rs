//! Opens files that are not trusted.
//!
//! Three rules (docs/design/promises.md R13 to R15). Only regular files are opened, so no pipe can
//! block the program. A header can name data only inside its own folder. A size in a header takes
//! no memory before as many bytes were seen.

use crate::error::{OpenErrorKind, Problem};
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek};
use std::path::{Path, PathBuf};

/// Reader under a [`Source`]: a file, or bytes of a test.
pub(crate) trait Stream: Read + Seek + Send {}
impl<T: Read + Seek + Send> Stream for T {}

/// An open file with its length, or the bytes of a test.
pub(crate) struct Source {
    pub(crate) reader: BufReader<Box<dyn Stream>>,
    /// Bytes of the whole file.
    pub(crate) len: u64,
}

/// Enough to recognise a format ([`Source::head`]) with few system calls. Samples are read past the
/// buffer in larger pieces.
const BUFFER_BYTES: usize = 64 << 10;

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
        Ok(Source {
            reader: BufReader::with_capacity(BUFFER_BYTES, Box::new(file)),
            len: meta.len(),
        })
    }

    /// Returns a source of bytes, for tests.
    #[cfg(test)]
    pub(crate) fn from_bytes(bytes: Vec<u8>) -> Source {
        let len = bytes.len() as u64;
        Source {
            reader: BufReader::with_capacity(BUFFER_BYTES, Box::new(std::io::Cursor::new(bytes))),
            len,
        }
    }

    /// Returns the first bytes (up to 64 KiB) without consuming them.
    pub(crate) fn head(&mut self) -> Result<&[u8], Problem> {
        self.reader.fill_buf().map_err(|e| Problem::io("content", &e))
    }
}

/// Returns the path of the file that a header in `folder` calls `name`. Follows links, and refuses
/// a file outside the folder.
pub(crate) fn resolve_in_folder(
    folder: &Path,
    name: &str,
    field: &str,
) -> Result<PathBuf, Problem> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let shown = crate::error::quoted(name);
    let missing = |e: std::io::Error| {
        let what = match e.kind() {
            std::io::ErrorKind::NotFound => format!("{shown} is not there"),
            _ => format!("{shown} can't be found ({e})"),
        };
        Problem::new(OpenErrorKind::Unreadable, field, what, "put the data file beside its header")
    };
    let root = folder.canonicalize().map_err(missing)?;
    let path = root.join(name).canonicalize().map_err(missing)?;
    if !path.starts_with(&root) {
        return Err(Problem::new(
            OpenErrorKind::Forbidden,
            field,
            format!("{shown} lies outside the header's folder"),
            "put the data file beside its header and name it without `..`, links or a root",
        ));
    }
    Ok(path)
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
