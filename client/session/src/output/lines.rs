//! Text that grows line by line beside the frames: `--stats` and `--trace`.

use super::file::{DiskWait, GrowingFile, beside};
use crate::fail::Fail;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Bytes that are gathered before they are written: some hundred frames' statistics.
const GATHER: usize = 1 << 20;

/// A file of lines that gets its name at the end.
pub struct Kept {
    path: PathBuf,
    file: Option<GrowingFile>,
    gathered: Vec<u8>,
    patience: Arc<DiskWait>,
}

impl Kept {
    fn write(&mut self) -> Result<(), Fail> {
        let mut add = || {
            let file = match &mut self.file {
                Some(file) => file,
                none => none.insert(GrowingFile::new(&self.path)?),
            };
            file.add(&self.gathered, &self.patience)
        };
        add().map_err(|e: std::io::Error| Fail::io(&self.path, "writing", &e))?;
        self.gathered.clear();
        Ok(())
    }
}

/// Lines of `--stats` or `--trace`: a file that gets its name when the run ends, or a pipe or
/// stdout (`-`) that gets them at once.
pub enum Lines {
    /// Nothing is written.
    None,
    /// Standard output; closed once its reader has gone away.
    Stdout {
        /// Whether somebody still reads.
        open: bool,
    },
    /// A pipe or a device.
    Stream(PathBuf, File),
    /// Made with the first line, so that a run that fails before has nothing to clean up.
    Kept(Kept),
}

impl Lines {
    /// Opens the file, pipe or device that a flag names for lines; none without a `path`.
    ///
    /// # Errors
    /// The file can't be made or is one of the inputs.
    pub fn open(
        path: Option<&Path>,
        flag: &str,
        inputs: &[&Path],
        patience: &Arc<DiskWait>,
    ) -> Result<Self, Fail> {
        let Some(path) = path else { return Ok(Lines::None) };
        if path == Path::new("-") {
            return Ok(Lines::Stdout { open: true });
        }
        super::refuse_input(path, flag, inputs)?;
        match std::fs::metadata(path) {
            Ok(meta) if meta.is_dir() => {
                Err(Fail::failed(format!("{}: is a folder; give a file", path.display())))
            }
            Ok(meta) if !meta.is_file() => {
                let file = File::options()
                    .write(true)
                    .open(path)
                    .map_err(|e| Fail::io(path, "opening", &e))?;
                Ok(Lines::Stream(path.into(), file))
            }
            _ => {
                beside(path).map_err(|e| Fail::io(path, "making the file", &e))?;
                let (path, patience) = (path.to_path_buf(), patience.clone());
                Ok(Lines::Kept(Kept { path, file: None, gathered: Vec::new(), patience }))
            }
        }
    }

    /// Writes the text as it is to where lines go.
    ///
    /// # Errors
    /// The text can't be written.
    pub fn put(&mut self, text: &str) -> Result<(), Fail> {
        match self {
            Lines::None | Lines::Stdout { open: false } => Ok(()),
            Lines::Stdout { open } => match crate::fail::say(text) {
                // Whoever read the lines has seen enough; the frames go on.
                Err(e) if e.line().is_none() => {
                    *open = false;
                    Ok(())
                }
                other => other,
            },
            Lines::Stream(path, file) => match file.write_all(text.as_bytes()) {
                Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => {
                    *self = Lines::None;
                    Ok(())
                }
                other => other.map_err(|e| Fail::io(path, "writing", &e)),
            },
            Lines::Kept(kept) => {
                kept.gathered.extend_from_slice(text.as_bytes());
                if kept.gathered.len() >= GATHER { kept.write() } else { Ok(()) }
            }
        }
    }

    /// Returns whether lines go to stdout.
    pub fn on_stdout(&self) -> bool {
        matches!(self, Lines::Stdout { .. })
    }

    /// Returns whether the user wants lines at all, to any place.
    pub fn wanted(&self) -> bool {
        !matches!(self, Lines::None)
    }

    /// Ends the lines and gives a kept file its final name.
    ///
    /// # Errors
    /// The file can't be written.
    pub fn keep(self) -> Result<(), Fail> {
        match self {
            Lines::Kept(mut kept) => {
                kept.write()?;
                let Kept { path, file: Some(file), patience, .. } = kept else { return Ok(()) };
                file.settle(&patience).map_err(|e| Fail::io(&path, "writing", &e))
            }
            _ => Ok(()),
        }
    }
}
