//! A folder of frames: what may be written there, and what the files are called.

use super::made::OutputFolder;
use crate::fail::Fail;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Folder for the frames of one run.
#[derive(Debug)]
pub(crate) struct Folder {
    path: PathBuf,
    /// Stem of the file names: `frame`.
    stem: &'static str,
    extension: &'static str,
    /// Digits of a frame's number: at least four, so that names sort.
    digits: usize,
    /// Once it was made.
    made: Option<OutputFolder>,
}

impl Folder {
    /// Looks at the folder and refuses frames that are there, unless `force`. Writes nothing.
    /// Also says which frames of an earlier run will stay beside the new ones.
    pub(crate) fn look(
        path: &Path,
        (stem, extension): (&'static str, &'static str),
        frames: Range<u64>,
        force: bool,
    ) -> Result<(Folder, Option<String>), Fail> {
        let digits = (frames.end.saturating_sub(1)).to_string().len().max(4);
        let folder = Folder { path: path.to_path_buf(), stem, extension, digits, made: None };
        let entries = match std::fs::read_dir(path) {
            Ok(entries) => entries,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok((folder, None)),
            Err(e) if e.kind() == std::io::ErrorKind::NotADirectory => {
                return Err(Fail::failed(format!(
                    "{}: is a file; give a folder with -o",
                    path.display()
                )));
            }
            Err(e) => return Err(Fail::io(path, "reading the folder", &e)),
        };
        let mut there: Vec<u64> = entries
            .filter_map(|e| {
                let name = e.ok()?.file_name();
                let number = name.to_str()?.strip_prefix(stem)?.strip_prefix('_')?;
                let number = number.strip_suffix(extension)?.strip_suffix('.')?;
                number.parse().ok().filter(|n| folder.name(*n).as_str() == name)
            })
            .collect();
        there.sort_unstable();
        let (ours, beyond): (Vec<u64>, Vec<u64>) =
            there.into_iter().partition(|n| frames.contains(n));
        if !ours.is_empty() && !force {
            return Err(Fail::failed(format!(
                "{}: holds {} already; add --force to replace {}, or give another folder with -o",
                path.display(),
                folder.list(&ours),
                if ours.len() == 1 { "it" } else { "them" }
            )));
        }
        let stay = (!beyond.is_empty()).then(|| {
            format!(
                "{} of an earlier run {} in {}",
                folder.list(&beyond),
                if beyond.len() == 1 { "stays" } else { "stay" },
                folder.shown()
            )
        });
        Ok((folder, stay))
    }

    /// Makes the folder if it is missing, and sees whether files can be made in it: better now
    /// than after the first frame.
    pub(crate) fn make(&mut self) -> Result<(), Fail> {
        self.made = Some(OutputFolder::new(&self.path)?);
        Ok(())
    }

    /// A frame's file name.
    fn name(&self, number: u64) -> String {
        let Folder { stem, extension, digits, .. } = self;
        format!("{stem}_{number:0digits$}.{extension}")
    }

    /// A frame's file.
    pub(super) fn file(&self, number: u64) -> PathBuf {
        self.path.join(self.name(number))
    }

    /// The folder as a person reads it, with a slash.
    pub(crate) fn shown(&self) -> String {
        let shown = self.path.display().to_string();
        if shown.ends_with('/') { shown } else { format!("{shown}/") }
    }

    /// `frame_0000.png`, `frame_0000.png ... frame_0017.png`, or with a gap
    /// `frame_0000.png ... frame_0009.png (7 of them)`.
    pub(crate) fn list(&self, numbers: &[u64]) -> String {
        match numbers {
            [] => "no frame".into(),
            [one] => self.name(*one),
            [first, .., last] => {
                let gaps = last - first + 1 != numbers.len() as u64;
                let count = if gaps { format!(" ({} of them)", numbers.len()) } else { "".into() };
                format!("{} ... {}{count}", self.name(*first), self.name(*last))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PNG: (&str, &str) = ("frame", "png");

    #[test]
    fn frames_that_are_there_refuse_before_any_work() {
        let dir = tempfile::tempdir().unwrap();
        for n in [0, 3, 20] {
            std::fs::write(dir.path().join(format!("frame_{n:04}.png")), "x").unwrap();
        }
        let e = Folder::look(dir.path(), PNG, 0..18, false).unwrap_err();
        let said = e.line().unwrap();
        assert!(
            said.contains("frame_0000.png ... frame_0003.png (2 of them)")
                && said.contains("--force"),
            "{said}"
        );
        let (_, stay) = Folder::look(dir.path(), PNG, 0..18, true).unwrap();
        assert!(stay.unwrap().starts_with("frame_0020.png of an earlier run stays"));
        assert!(Folder::look(dir.path(), ("frame", "exr"), 0..18, false).is_ok());
    }

    #[test]
    fn a_folder_that_was_made_in_vain_goes_again() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a/b");
        let (mut folder, _) = Folder::look(&path, PNG, 0..1, false).unwrap();
        folder.make().unwrap();
        assert!(path.is_dir());
        drop(folder);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }

    #[test]
    fn names_sort_however_many_there_are() {
        let (folder, _) =
            Folder::look(Path::new("nowhere-at-all"), PNG, 0..100_000, false).unwrap();
        assert_eq!(folder.name(7), "frame_00007.png");
        assert_eq!(folder.list(&[2]), "frame_00002.png");
    }
}
