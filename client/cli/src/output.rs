//! Frames on disk: PNGs that are whole or not there.
//!
//! A frame is encoded into a hidden file in its folder, synced, and renamed; so a name
//! `frame_0003.png` always holds a whole picture, whatever happens (full disk, Ctrl-C, power).
//! Encoding runs on threads of its own beside rendering ([`Writer`]).

use crate::fail::Fail;
use slabcast_common::image::PixelFormat;
use std::fs::{File, Permissions};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tokio::task::JoinSet;

/// A finished frame on its way to disk.
#[derive(Clone, Debug)]
pub(crate) struct Frame {
    pub(crate) number: u64,
    pub(crate) size: [u32; 2],
    pub(crate) format: PixelFormat,
    pub(crate) bytes: bytes::Bytes,
    pub(crate) view_sha256: String,
    pub(crate) pixels_sha256: String,
}

/// Where the frames of one run go.
#[derive(Debug)]
pub(crate) struct Folder {
    path: PathBuf,
    /// Digits of a frame's number: at least four, so that names sort.
    digits: usize,
    /// Folders that this run made, outermost first.
    made: Vec<PathBuf>,
}

impl Folder {
    /// Looks at the folder and refuses frames that are there, unless `force`. Writes nothing.
    /// Also says which frames of an earlier run will stay beside the new ones.
    pub(crate) fn look(
        path: &Path,
        frames: u64,
        force: bool,
    ) -> Result<(Folder, Option<String>), Fail> {
        let digits = (frames.saturating_sub(1)).to_string().len().max(4);
        let folder = Folder { path: path.to_path_buf(), digits, made: Vec::new() };
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
                let number = name.to_str()?.strip_prefix("frame_")?.strip_suffix(".png")?;
                number.parse().ok().filter(|n| folder.name(*n).as_str() == name)
            })
            .collect();
        there.sort_unstable();
        let (ours, beyond): (Vec<u64>, Vec<u64>) = there.into_iter().partition(|n| *n < frames);
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
        let mut missing: Vec<PathBuf> = self
            .path
            .ancestors()
            .take_while(|p| !p.as_os_str().is_empty() && !p.exists())
            .map(Path::to_path_buf)
            .collect();
        missing.reverse();
        for dir in missing {
            match std::fs::create_dir(&dir) {
                Ok(()) => self.made.push(dir),
                // Somebody else was quicker.
                Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(Fail::io(&dir, "making the folder", &e)),
            }
        }
        hidden(&self.path, "probe")
            .map(drop)
            .map_err(|e| Fail::io(&self.path, "making a file in it", &e))
    }

    /// A frame's file name.
    fn name(&self, number: u64) -> String {
        format!("frame_{number:0digits$}.png", digits = self.digits)
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

impl Drop for Folder {
    /// Folders that this run made and left empty go again.
    fn drop(&mut self) {
        for dir in self.made.iter().rev() {
            if std::fs::remove_dir(dir).is_err() {
                return;
            }
        }
    }
}

/// A hidden file beside its final name; it is gone when dropped, unless it is persisted.
fn hidden(folder: &Path, name: &str) -> std::io::Result<tempfile::NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    let prefix = format!(".{name}.");
    builder.prefix(&prefix).suffix(".tmp");
    #[cfg(unix)]
    // What the umask leaves, as for any file of the user's; the crate's own choice is 0600.
    builder.permissions(<Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o666));
    builder.tempfile_in(folder)
}

/// A hidden file beside `path`.
fn beside(path: &Path) -> std::io::Result<tempfile::NamedTempFile> {
    let folder = match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    hidden(folder, &path.file_name().unwrap_or_default().to_string_lossy())
}

/// Writes a whole file or none: hidden, synced, renamed.
pub(crate) fn write_atomic(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<&File>) -> std::io::Result<()>,
) -> Result<(), Fail> {
    let fail = |e: &std::io::Error| Fail::io(path, "writing", e);
    let file = beside(path).map_err(|e| fail(&e))?;
    let mut out = BufWriter::with_capacity(1 << 16, file.as_file());
    fill(&mut out).and_then(|()| out.flush()).map_err(|e| fail(&e))?;
    drop(out);
    file.as_file().sync_all().map_err(|e| fail(&e))?;
    file.persist(path).map_err(|e| fail(&e.error))?;
    Ok(())
}

/// Encodes a frame: 8-bit sRGB, with what made it as text.
pub(crate) fn encode_png(frame: &Frame, out: &mut impl Write) -> std::io::Result<()> {
    let mut png = png::Encoder::new(out, frame.size[0], frame.size[1]);
    png.set_color(match frame.format {
        PixelFormat::Rgb8 => png::ColorType::Rgb,
        PixelFormat::Rgba8 => png::ColorType::Rgba,
        other => return Err(std::io::Error::other(format!("{other:?} pixels in an 8-bit PNG"))),
    });
    png.set_depth(png::BitDepth::Eight);
    png.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    // Fast: 0.9 ms for a rendered 512x512 picture of 236 kB, 160 ms for 8192x8192. The next
    // better one (Balanced) takes 23 ms and 2.7 s, for files a fifth to a third smaller: longer
    // than rendering on a good machine.
    png.set_compression(png::Compression::Fast);
    for (key, text) in [
        ("Software", concat!("slabcast ", env!("CARGO_PKG_VERSION"))),
        ("slabcast view_sha256", &frame.view_sha256),
        ("slabcast pixels_sha256", &frame.pixels_sha256),
    ] {
        png.add_text_chunk(key.into(), text.into())?;
    }
    let mut png = png.write_header()?;
    png.write_image_data(&frame.bytes)?;
    png.finish()?;
    Ok(())
}

/// Frames on their way to disk, encoded on blocking threads of the runtime.
pub(crate) struct Writer {
    folder: Arc<Folder>,
    busy: JoinSet<Result<u64, Fail>>,
    written: Vec<u64>,
}

/// Frames that are encoded at once or wait for it. Encoding takes a hundredth of rendering; what
/// takes time is the sync to disk, during which a second one encodes. Each holds a frame's
/// pixels (200 MB at 8192x8192), so not many more.
const AT_ONCE: usize = 2;

impl Writer {
    pub(crate) fn new(folder: Arc<Folder>) -> Self {
        Writer { folder, busy: JoinSet::new(), written: Vec::new() }
    }

    /// Whether another frame may come.
    pub(crate) fn has_room(&self) -> bool {
        self.busy.len() < AT_ONCE
    }

    /// Whether a frame is on its way.
    pub(crate) fn is_busy(&self) -> bool {
        !self.busy.is_empty()
    }

    /// Takes a frame. Call [`Writer::has_room`] first.
    pub(crate) fn put(&mut self, frame: Frame) {
        let folder = self.folder.clone();
        self.busy.spawn_blocking(move || {
            let path = folder.path.join(folder.name(frame.number));
            write_atomic(&path, |out| encode_png(&frame, out))?;
            Ok(frame.number)
        });
    }

    /// Waits for the next frame to be on disk. Pending for ever where none is on its way.
    pub(crate) async fn next_written(&mut self) -> Result<u64, Fail> {
        match self.busy.join_next().await {
            None => std::future::pending().await,
            Some(Ok(done)) => {
                let number = done?;
                self.written.push(number);
                Ok(number)
            }
            Some(Err(e)) => Err(Fail::failed(format!("writing a frame failed: {e}"))),
        }
    }

    /// Waits for all that are on their way; the first failure counts, the others go on.
    pub(crate) async fn drain(&mut self) -> Result<(), Fail> {
        let mut first = Ok(());
        while self.is_busy() {
            if let Err(e) = self.next_written().await
                && first.is_ok()
            {
                first = Err(e);
            }
        }
        first
    }

    /// Frames on disk, ascending.
    pub(crate) fn written(&mut self) -> &[u64] {
        self.written.sort_unstable();
        &self.written
    }
}

/// Text that is written line by line and gets its name only when the run ends: `--stats`,
/// `--trace`. A pipe, a device or stdout (`-`) gets it at once.
pub(crate) enum Lines {
    None,
    Stdout {
        open: bool,
    },
    Stream(PathBuf, File),
    /// Made with the first line, so that a run that fails before has nothing to clean up.
    Kept(PathBuf, Option<BufWriter<tempfile::NamedTempFile>>),
}

impl Lines {
    /// Opens what the flag says; refuses places where no file can be made, and `inputs`.
    pub(crate) fn open(path: Option<&Path>, flag: &str, inputs: &[&Path]) -> Result<Self, Fail> {
        let Some(path) = path else { return Ok(Lines::None) };
        if path == Path::new("-") {
            return Ok(Lines::Stdout { open: true });
        }
        let same = |input: &&Path| matches!((path.canonicalize(), input.canonicalize()), (Ok(a), Ok(b)) if a == b);
        if inputs.iter().any(same) {
            return Err(Fail::usage(format!(
                "--{flag}: {} is an input of this run; give another file",
                path.display()
            )));
        }
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
                Ok(Lines::Kept(path.into(), None))
            }
        }
    }

    /// Adds text as it is.
    pub(crate) fn put(&mut self, text: &str) -> Result<(), Fail> {
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
            Lines::Kept(path, file) => {
                let mut add = || {
                    if file.is_none() {
                        *file = Some(BufWriter::new(beside(path)?));
                    }
                    file.as_mut().map_or(Ok(()), |f| f.write_all(text.as_bytes()))
                };
                add().map_err(|e| Fail::io(path, "writing", &e))
            }
        }
    }

    /// Whether lines go to stdout.
    pub(crate) fn on_stdout(&self) -> bool {
        matches!(self, Lines::Stdout { .. })
    }

    /// Whether lines are wanted.
    pub(crate) fn wanted(&self) -> bool {
        !matches!(self, Lines::None)
    }

    /// Puts the file under its name.
    pub(crate) fn keep(self) -> Result<(), Fail> {
        match self {
            Lines::Kept(path, Some(file)) => {
                let fail = |e: &std::io::Error| Fail::io(&path, "writing", e);
                let file = file.into_inner().map_err(|e| fail(e.error()))?;
                file.as_file().sync_all().map_err(|e| fail(&e))?;
                file.persist(&path).map(drop).map_err(|e| fail(&e.error))
            }
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(number: u64) -> Frame {
        Frame {
            number,
            size: [2, 1],
            format: PixelFormat::Rgb8,
            bytes: vec![1, 2, 3, 4, 5, 6].into(),
            view_sha256: "ab".into(),
            pixels_sha256: "cd".into(),
        }
    }

    #[test]
    fn a_png_holds_the_pixels_and_what_made_them() {
        let mut bytes = Vec::new();
        encode_png(&frame(0), &mut bytes).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(&bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        assert_eq!(pixels, [1, 2, 3, 4, 5, 6]);
        let info = reader.info();
        assert!(info.srgb.is_some());
        let text: Vec<&str> =
            info.uncompressed_latin1_text.iter().map(|t| t.keyword.as_str()).collect();
        assert_eq!(text, ["Software", "slabcast view_sha256", "slabcast pixels_sha256"]);
    }

    #[test]
    fn frames_that_are_there_refuse_before_any_work() {
        let dir = tempfile::tempdir().unwrap();
        for n in [0, 3, 20] {
            std::fs::write(dir.path().join(format!("frame_{n:04}.png")), "x").unwrap();
        }
        let e = Folder::look(dir.path(), 18, false).unwrap_err();
        let said = e.line().unwrap();
        assert!(
            said.contains("frame_0000.png ... frame_0003.png (2 of them)")
                && said.contains("--force"),
            "{said}"
        );
        let (_, stay) = Folder::look(dir.path(), 18, true).unwrap();
        assert!(stay.unwrap().starts_with("frame_0020.png of an earlier run stays"));
    }

    #[test]
    fn a_folder_that_was_made_in_vain_goes_again() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a/b");
        let (mut folder, _) = Folder::look(&path, 1, false).unwrap();
        folder.make().unwrap();
        assert!(path.is_dir());
        drop(folder);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_write_that_fails_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("f.png");
        let e = write_atomic(&path, |_| Err(std::io::Error::other("no more room"))).unwrap_err();
        assert!(e.line().unwrap().contains("f.png"));
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
        write_atomic(&path, |out| out.write_all(b"whole")).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"whole");
    }

    #[test]
    fn names_sort_however_many_there_are() {
        let (folder, _) = Folder::look(Path::new("nowhere-at-all"), 100_000, false).unwrap();
        assert_eq!(folder.name(7), "frame_00007.png");
        assert_eq!(folder.list(&[2]), "frame_00002.png");
    }
}
