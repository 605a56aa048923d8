//! A folder that is there when files come, and gone if none came.

use super::file::hidden;
use crate::fail::Fail;
use std::path::{Path, PathBuf};

/// A folder for files; folders that were made for it and stay empty are removed when it is
/// dropped.
#[derive(Debug)]
pub struct OutputFolder {
    /// Folders that were missing, outermost first.
    made: Vec<PathBuf>,
}

impl OutputFolder {
    /// Makes the folder and its missing parents, and checks that files can be made in it.
    ///
    /// # Errors
    /// A folder or a file in it can't be made.
    pub fn new(path: &Path) -> Result<OutputFolder, Fail> {
        let mut missing: Vec<&Path> =
            path.ancestors().take_while(|p| !p.as_os_str().is_empty() && !p.exists()).collect();
        missing.reverse();
        // Dropped if the rest fails, which removes the folders.
        let mut own = OutputFolder { made: Vec::new() };
        for dir in missing {
            match std::fs::create_dir(dir) {
                Ok(()) => own.made.push(dir.to_path_buf()),
                // Somebody else was quicker.
                Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(Fail::io(dir, "making the folder", &e)),
            }
        }
        hidden(path, "probe").map_err(|e| Fail::io(path, "making a file in it", &e))?;
        Ok(own)
    }
}

impl Drop for OutputFolder {
    /// Folders that were made and left empty go again.
    fn drop(&mut self) {
        for dir in self.made.iter().rev() {
            if std::fs::remove_dir(dir).is_err() {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn output_folder_is_removed_if_it_stays_empty() {
        let dir = tempfile::tempdir().unwrap();
        let (empty, full) = (dir.path().join("a/b"), dir.path().join("c/d"));
        drop(OutputFolder::new(&empty).unwrap());
        let made = OutputFolder::new(&full).unwrap();
        std::fs::write(full.join("f"), "x").unwrap();
        drop(made);
        assert!(!dir.path().join("a").exists() && full.join("f").exists());
        // A folder that was there before is nobody's to take away.
        let own = dir.path().join("own");
        std::fs::create_dir(&own).unwrap();
        drop(OutputFolder::new(&own).unwrap());
        assert!(own.is_dir());
        let e = OutputFolder::new(&full.join("f")).unwrap_err();
        assert!(e.line().unwrap().contains("making a file in it"), "{e:?}");
    }
}
