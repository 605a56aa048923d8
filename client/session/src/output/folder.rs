//! A folder of frames: what may be written there, and what the files are called.

use super::made::OutputFolder;
use crate::fail::Fail;
use std::io::{Read, Seek, SeekFrom};
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
    /// Frames of an earlier run that the new ones replace although none has their name.
    stale: Vec<PathBuf>,
    /// Once it was made.
    made: Option<OutputFolder>,
}

/// Frames that are wanted of a folder.
#[derive(Clone, Debug)]
pub(crate) struct Wanted {
    /// Numbers of the frames.
    pub(crate) frames: Range<u64>,
    /// Whether `frames` is a range of a longer path. Other frames of the path in the folder then
    /// stay.
    pub(crate) part: bool,
    /// Stem and extension of the file names.
    pub(crate) names: (&'static str, &'static str),
}

/// Most folders `slabcast-out-N/` that are looked at.
const MOST_BESIDE: u32 = 10_000;

impl Folder {
    fn new(path: &Path, wanted: &Wanted) -> Folder {
        let digits = (wanted.frames.end.saturating_sub(1)).to_string().len().max(4);
        let (stem, extension) = wanted.names;
        let (path, stale) = (path.to_path_buf(), Vec::new());
        Folder { path, stem, extension, digits, stale, made: None }
    }

    /// Looks at the folder that the user named and refuses frames that are there, unless `force`:
    /// then they go when the folder is made. Writes nothing.
    ///
    /// Frames of the same path that are not wanted now (`--frames 30..60`) stay, which is said.
    pub(crate) fn look(
        path: &Path,
        wanted: &Wanted,
        force: bool,
    ) -> Result<(Folder, Option<String>), Fail> {
        let mut folder = Folder::new(path, wanted);
        let there = folder.frames_there()?;
        let (ours, beyond): (Vec<u64>, Vec<u64>) =
            there.iter().partition(|n| wanted.frames.contains(n));
        let in_the_way = if wanted.part { &ours } else { &there };
        if !in_the_way.is_empty() && !force {
            return Err(Fail::failed(format!(
                "{}: holds {} already; add --force to replace {}, or give another folder with -o",
                path.display(),
                folder.list(in_the_way),
                if in_the_way.len() == 1 { "it" } else { "them" }
            )));
        }
        let mut stay = beyond;
        if !wanted.part {
            let ours = |n: &u64| is_of_slabcast(&folder.file(*n)).unwrap_or(false);
            let (gone, foreign): (Vec<u64>, Vec<u64>) = stay.into_iter().partition(ours);
            stay = foreign;
            folder.stale = gone.iter().map(|&n| folder.file(n)).collect();
        }
        let why = if wanted.part { "" } else { ", not written by slabcast," };
        let note = (!stay.is_empty()).then(|| {
            format!(
                "{} of an earlier run{why} {} in {}",
                folder.list(&stay),
                if stay.len() == 1 { "stays" } else { "stay" },
                folder.shown()
            )
        });
        Ok((folder, note))
    }

    /// Looks at the folder that is taken where the user names none: if it holds frames already,
    /// `NAME-2`, and so on. Says which. With `force` frames are replaced. Writes nothing.
    pub(crate) fn look_for_own(
        path: &Path,
        wanted: &Wanted,
        force: bool,
    ) -> Result<(Folder, Option<String>), Fail> {
        if force {
            return Folder::look(path, wanted, true);
        }
        let name = path.to_string_lossy().trim_end_matches('/').to_string();
        let mut held = None;
        for n in 1..=MOST_BESIDE {
            let beside = if n == 1 { path.into() } else { PathBuf::from(format!("{name}-{n}")) };
            let folder = Folder::new(&beside, wanted);
            let there = folder.frames_there()?;
            if there.iter().any(|n| !wanted.part || wanted.frames.contains(n)) {
                held.get_or_insert(folder.shown());
                continue;
            }
            let note = held.map(|held| {
                let place = folder.shown();
                format!("{held} holds pictures of an earlier run; these go to {place}")
            });
            return Ok((folder, note));
        }
        Err(Fail::failed(format!(
            "{name}-{MOST_BESIDE}: holds pictures, as all before it do; give a folder with -o"
        )))
    }

    /// Numbers of the frames in the folder, ascending.
    fn frames_there(&self) -> Result<Vec<u64>, Fail> {
        let path = &self.path;
        let entries = match std::fs::read_dir(path) {
            Ok(entries) => entries,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
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
                let number = name.to_str()?.strip_prefix(self.stem)?.strip_prefix('_')?;
                let number = number.strip_suffix(self.extension)?.strip_suffix('.')?;
                number.parse().ok().filter(|n| self.name(*n).as_str() == name)
            })
            .collect();
        there.sort_unstable();
        Ok(there)
    }

    /// Makes the folder if it is missing, sees whether files can be made in it (better now than
    /// after the first frame), and removes stale frames.
    pub(crate) fn make(&mut self) -> Result<(), Fail> {
        self.made = Some(OutputFolder::new(&self.path)?);
        for file in self.stale.drain(..) {
            match std::fs::remove_file(&file) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                    return Err(Fail::io(&file, "removing", &e));
                }
                _ => {}
            }
        }
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

/// Returns whether slabcast wrote a picture: the name stands at the beginning of its file, or at
/// the end of a TIFF.
fn is_of_slabcast(path: &Path) -> std::io::Result<bool> {
    const LOOK: u64 = 1 << 16;
    let mut file = std::fs::File::open(path)?;
    let long = file.metadata()?.len();
    for start in [0, long.saturating_sub(LOOK)] {
        let mut bytes = Vec::new();
        file.seek(SeekFrom::Start(start))?;
        Read::by_ref(&mut file).take(LOOK).read_to_end(&mut bytes)?;
        if bytes.windows(9).any(|w| w == b"slabcast ") {
            return Ok(true);
        }
    }
    Ok(false)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(frames: Range<u64>, part: bool) -> Wanted {
        Wanted { frames, part, names: ("frame", "png") }
    }

    /// Files of frames; every second was written by another program.
    fn fill(dir: &Path, numbers: &[u64]) {
        std::fs::create_dir_all(dir).unwrap();
        for (i, n) in numbers.iter().enumerate() {
            let by: &[u8] = if i % 2 == 0 { b"..slabcast 0.1.0" } else { b"..other" };
            std::fs::write(dir.join(format!("frame_{n:04}.png")), by).unwrap();
        }
    }

    #[test]
    fn frames_that_are_there_refuse_before_any_work() {
        let dir = tempfile::tempdir().unwrap();
        fill(dir.path(), &[0, 3, 20]);
        let e = Folder::look(dir.path(), &wanted(0..18, true), false).unwrap_err();
        let said = e.line().unwrap();
        assert!(
            said.contains("frame_0000.png ... frame_0003.png (2 of them)")
                && said.contains("--force"),
            "{said}"
        );
        let (_, stay) = Folder::look(dir.path(), &wanted(0..18, true), true).unwrap();
        assert!(stay.unwrap().starts_with("frame_0020.png of an earlier run stays"));
        // Pictures of another kind are in nobody's way.
        let exr = Wanted { names: ("frame", "exr"), ..wanted(0..18, false) };
        assert!(Folder::look(dir.path(), &exr, false).is_ok());
        // A whole path that is shorter would be mixed with the rest of the longer one.
        fill(&dir.path().join("b"), &[7]);
        assert!(Folder::look(&dir.path().join("b"), &wanted(0..2, false), false).is_err());
    }

    #[test]
    fn force_leaves_no_stale_frame_and_takes_nothing_of_others() {
        let dir = tempfile::tempdir().unwrap();
        fill(dir.path(), &[0, 4, 5, 6, 7]);
        std::fs::write(dir.path().join("notes.txt"), "slabcast ").unwrap();
        std::fs::write(dir.path().join("depth_0009.png"), "slabcast ").unwrap();
        let (mut folder, note) = Folder::look(dir.path(), &wanted(0..2, false), true).unwrap();
        assert!(note.unwrap().contains("not written by slabcast, stay"));
        folder.make().unwrap();
        let mut names: Vec<_> =
            std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        let want = ["depth_0009.png", "frame_0000.png", "frame_0004.png", "frame_0006.png"];
        assert_eq!(names[..4], want);
        assert_eq!(names[4..], ["notes.txt"]);
    }

    #[test]
    fn a_folder_of_ones_own_is_continued_beside() {
        let dir = tempfile::tempdir().unwrap();
        let own = dir.path().join("out/");
        let look = |part, force| {
            let (folder, note) = Folder::look_for_own(&own, &wanted(0..3, part), force).unwrap();
            (folder.path.file_name().unwrap().to_str().unwrap().to_string(), note)
        };
        assert_eq!(look(false, false), ("out".into(), None));
        // Files that are not frames don't count.
        std::fs::create_dir(&own).unwrap();
        std::fs::write(own.join("notes.txt"), "").unwrap();
        assert_eq!(look(false, false), ("out".into(), None));
        fill(&own, &[5]);
        let (name, note) = look(false, false);
        let note = note.unwrap();
        assert!(
            name == "out-2" && note.contains("out/ holds") && note.contains("out-2/"),
            "{note}"
        );
        // Other frames of the same path go beside those that are there.
        assert_eq!(look(true, false).0, "out");
        assert_eq!(look(false, true).0, "out");
        fill(&dir.path().join("out-2"), &[0]);
        assert_eq!(look(false, false).0, "out-3");
    }

    #[test]
    fn a_folder_that_was_made_in_vain_goes_again() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a/b");
        let (mut folder, _) = Folder::look(&path, &wanted(0..1, false), false).unwrap();
        folder.make().unwrap();
        assert!(path.is_dir());
        drop(folder);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }

    #[test]
    fn names_sort_however_many_there_are() {
        let nowhere = Path::new("nowhere-at-all");
        let (folder, _) = Folder::look(nowhere, &wanted(0..100_000, false), false).unwrap();
        assert_eq!(folder.name(7), "frame_00007.png");
        assert_eq!(folder.list(&[2]), "frame_00002.png");
    }
}
