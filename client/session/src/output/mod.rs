//! Output of a run: pictures in a folder, one picture, a moving one, or video in a pipe.
//!
//! [`Output`] is where and as what, checked before any work; [`Writer`] takes the frames as they
//! come and encodes them on threads of its own beside rendering. `mod@file` keeps the promise that
//! a file is whole or not there.

mod contact;
pub mod exr;
mod file;
mod folder;
mod lines;
mod made;
pub mod png;
pub mod provenance;
mod y4m;

pub use file::{DiskWait, probe, write_atomic};
pub use lines::Lines;
pub use made::OutputFolder;

use crate::fail::Fail;
use crate::magnify::magnified;
use crate::parse;
use contact::Contact;
use file::GrowingFile;
use folder::Folder;
use provenance::Provenance;
use serde::{Deserialize, Serialize};
use slabcast_common::image::{Background, Picture, PixelFormat};
use slabcast_common::math::{linear_from_srgb, srgb_from_linear};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use tokio::task::JoinSet;

/// A finished frame of a path: its number and encoded pixels.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Number of the frame on its whole path.
    pub number: u64,
    /// Width and height of the frame in pixels.
    pub size: [u32; 2],
    /// Format of the pixels in `bytes`.
    pub format: PixelFormat,
    /// Pixels, row-major from the top left, in `format`.
    pub bytes: bytes::Bytes,
}

impl Frame {
    /// Returns the pixels as 8-bit sRGB, over black where they are transparent.
    pub fn rgb8(&self) -> Vec<u8> {
        let over = |c: u8, a: u8| {
            let light = linear_from_srgb(f64::from(c) / 255.0) * f64::from(a) / 255.0;
            (srgb_from_linear(light) * 255.0 + 0.5) as u8
        };
        let b = &self.bytes;
        match self.format {
            PixelFormat::Rgb8 => b.to_vec(),
            PixelFormat::Rgba8 => {
                b.chunks_exact(4).flat_map(|p| [0, 1, 2].map(|c| over(p[c], p[3]))).collect()
            }
            // Little endian: the high bytes.
            PixelFormat::Rgba16 => {
                b.chunks_exact(8).flat_map(|p| [1, 3, 5].map(|c| over(p[c], p[7]))).collect()
            }
            PixelFormat::Rgba32F => {
                self.picture().encode(PixelFormat::Rgb8, Background::Colour([0.0; 3]))
            }
        }
    }

    /// Returns the picture of a frame of floats (`Rgba32F`).
    pub fn picture(&self) -> Picture {
        let float = |p: &[u8], c: usize| f32::from_le_bytes(std::array::from_fn(|i| p[c * 4 + i]));
        let pixels = self.bytes.chunks_exact(16).map(|p| std::array::from_fn(|c| float(p, c)));
        Picture { size: self.size, pixels: pixels.collect() }
    }
}

/// File format in which frames are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// 8-bit PNG
    Png,
    /// 16-bit PNG
    Png16,
    /// OpenEXR: linear premultiplied floats, no background
    Exr,
    /// One moving PNG of all frames
    Apng,
    /// One uncompressed video of all frames (YUV4MPEG2), for ffmpeg and others
    Y4m,
}

impl Format {
    /// Returns the pixel format that a master sends for this file format.
    pub fn pixels(self, background: Background) -> PixelFormat {
        match (self, background) {
            (Format::Png16, _) => PixelFormat::Rgba16,
            (Format::Exr, _) => PixelFormat::Rgba32F,
            (Format::Y4m, _) | (_, Background::Colour(_)) => PixelFormat::Rgb8,
            (_, Background::Transparent) => PixelFormat::Rgba8,
        }
    }

    fn extension(self) -> &'static str {
        match self {
            Format::Png | Format::Png16 => "png",
            Format::Exr => "exr",
            Format::Apng => "apng",
            Format::Y4m => "y4m",
        }
    }

    fn moves(self) -> bool {
        matches!(self, Format::Apng | Format::Y4m)
    }

    fn name(self) -> &'static str {
        if self == Format::Png16 { "png16" } else { self.extension() }
    }
}

/// Target and format of the frames, checked before any work.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Output")]
pub struct OutputArgs {
    /// Folder for frame_0000.png and so on, or one file
    ///
    /// A folder is made if missing. NAME.png or NAME.exr has one frame, NAME.apng or NAME.y4m all
    /// of them; - writes Y4M video to stdout.
    #[arg(short, long, value_name = "DIR|FILE|-", default_value = "slabcast-out/")]
    pub output: PathBuf,
    /// png, png16, exr, apng or y4m [default: by the name of -o]
    ///
    /// png16 has 16 bits, exr linear floats and no background; apng and y4m are one moving picture.
    /// A folder gets png by default.
    #[arg(long, value_name = "FORMAT", hide_possible_values = true, value_enum)]
    pub format: Option<Format>,
    /// Frames a second of a moving picture
    #[arg(long, value_name = "N", default_value = "12", hide_short_help = true,
          value_parser = clap::value_parser!(u16).range(1..=240))]
    pub fps: u16,
    /// Also all frames, small, on one PNG
    #[arg(long, value_name = "FILE.png", value_parser = parse::png, hide_short_help = true)]
    pub contact_sheet: Option<PathBuf>,
    /// Replace files that are there already
    #[arg(long)]
    pub force: bool,
}

/// Target of the frames.
#[derive(Debug)]
enum Target {
    /// A file each.
    Folder(Folder),
    /// One frame in one file.
    SingleFrame(PathBuf),
    /// All frames in one file.
    Movie(PathBuf),
    /// All frames into a pipe; `None` is stdout.
    Pipe(Option<PathBuf>),
}

/// Target and format of the frames, checked before any work.
#[derive(Debug)]
pub struct Output {
    target: Target,
    /// File format in which frames are written.
    pub format: Format,
    fps: u16,
    contact: Option<PathBuf>,
    /// How frames that arrive as small pictures of floats are magnified.
    magnify: Option<Magnify>,
}

/// Factor and background of magnified frames.
#[derive(Clone, Copy, Debug)]
struct Magnify {
    times: u32,
    background: Background,
}

/// Checks that a file to write is none of the inputs.
///
/// # Errors
/// The file is an input; the error names the flag.
pub fn refuse_input(path: &Path, flag: &str, inputs: &[&Path]) -> Result<(), Fail> {
    let same = |input: &&Path| matches!((path.canonicalize(), input.canonicalize()), (Ok(a), Ok(b)) if a == b);
    if inputs.iter().any(same) {
        return Err(Fail::usage(format!(
            "--{flag}: {} is an input of this run; give another file",
            path.display()
        )));
    }
    Ok(())
}

/// Refuses a file that is there, unless `force`, and places where none can be made.
fn may_write(path: &Path, flag: &str, inputs: &[&Path], force: bool) -> Result<(), Fail> {
    refuse_input(path, flag, inputs)?;
    match std::fs::metadata(path) {
        Ok(meta) if meta.is_dir() => {
            Err(Fail::failed(format!("{}: is a folder; give a file", path.display())))
        }
        Ok(_) if !force => Err(Fail::failed(format!(
            "{}: is there already; add --force to replace it, or give another file",
            path.display()
        ))),
        _ => file::beside(path).map(drop).map_err(|e| Fail::io(path, "making the file", &e)),
    }
}

/// Whether a name is that of a pipe or a device.
fn is_pipe(path: &Path) -> bool {
    std::fs::metadata(path).is_ok_and(|m| !m.is_file() && !m.is_dir())
}

/// Refuses names that ask for a format which others write: a folder called `turn.mp4` is a
/// surprise.
fn other_programs(path: &Path, ends: &str) -> Result<(), Fail> {
    const PICTURES: [&str; 9] = ["jpg", "jpeg", "tif", "tiff", "bmp", "gif", "webp", "avif", "ppm"];
    const VIDEOS: [&str; 7] = ["mp4", "m4v", "mov", "avi", "mkv", "webm", "mpg"];
    let shown = path.display();
    if PICTURES.contains(&ends) {
        return Err(Fail::usage(format!(
            "-o: {shown}: no {ends} is written; give a folder or a name that ends in .png, .exr or \
             .apng"
        )));
    }
    if VIDEOS.contains(&ends) {
        return Err(Fail::usage(format!(
            "-o: {shown}: no {ends} is written; pipe frames to an encoder: -o - | ffmpeg -i - \
             {shown}, or give turn.y4m or turn.apng"
        )));
    }
    Ok(())
}

impl Output {
    /// Checks the target without writing anything. Also returns a note about files of an
    /// earlier run that stay beside the new ones.
    ///
    /// # Errors
    /// A file would be replaced without `--force`, or the target doesn't fit the format.
    pub fn look(
        args: &OutputArgs,
        stem: &'static str,
        frames: std::ops::Range<u64>,
        background: Background,
        inputs: &[&Path],
    ) -> Result<(Output, Option<String>), Fail> {
        let path = &args.output;
        let shown = path.display();
        let ends = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
        // A name with a slash at its end is a folder's, and so is that of a folder.
        let folder = path.is_dir() || path.to_string_lossy().ends_with('/');
        let named = match ends.as_deref() {
            _ if folder => None,
            Some("png") => Some(Format::Png),
            Some("exr") => Some(Format::Exr),
            Some("apng") => Some(Format::Apng),
            Some("y4m") => Some(Format::Y4m),
            _ => None,
        };
        if let (None, Some(ends), false) = (named, ends.as_deref(), folder) {
            other_programs(path, ends)?;
        }
        let stdout = path == Path::new("-");
        let pipe = stdout || is_pipe(path);
        let format = args.format.or(named).unwrap_or(if pipe { Format::Y4m } else { Format::Png });
        let name = format.name();
        if pipe && format != Format::Y4m {
            return Err(Fail::usage(format!(
                "--format: {name} does not go into a pipe; leave it out for y4m, or give a file or \
                 folder with -o"
            )));
        }
        let fits = |ends: &str| match format {
            // A moving PNG is a PNG.
            Format::Png16 => ends == "png",
            Format::Apng => ends == "png" || ends == "apng",
            _ => ends == format.extension(),
        };
        if let (Some(_), Some(ends)) = (named, &ends)
            && !fits(ends)
        {
            return Err(Fail::usage(format!(
                "--format, -o: {shown} is not a name for {name}; end it in .{}",
                format.extension()
            )));
        }
        match (format, background) {
            (Format::Y4m, Background::Transparent) => {
                return Err(Fail::usage(
                    "--background: video has no transparency; give a colour, or --format apng",
                ));
            }
            (Format::Exr, Background::Colour(c)) if c != [0.0; 3] => {
                return Err(Fail::usage(
                    "--background: an EXR holds the picture before any background; leave it out",
                ));
            }
            _ => {}
        }
        if let Some(contact) = &args.contact_sheet {
            may_write(contact, "contact-sheet", inputs, args.force)?;
        }
        let mut stays = None;
        let target = if stdout {
            Target::Pipe(None)
        } else if pipe {
            Target::Pipe(Some(path.clone()))
        } else if format.moves() {
            if named.is_none() {
                return Err(Fail::usage(format!(
                    "-o: {name} is one file of all frames; give its name, like -o turn.{name}"
                )));
            }
            may_write(path, "output", inputs, args.force)?;
            Target::Movie(path.clone())
        } else if named.is_some() {
            if frames.end - frames.start > 1 {
                let frames = frames.end - frames.start;
                return Err(Fail::usage(format!(
                    "-o: {shown} is one picture, and the path has {frames} views; give a folder, \
                     --azimuth for one view, or turn.apng or turn.y4m for a moving picture"
                )));
            }
            may_write(path, "output", inputs, args.force)?;
            Target::SingleFrame(path.clone())
        } else {
            let names = (stem, format.extension());
            let (folder, beside) = Folder::look(path, names, frames, args.force)?;
            stays = beside;
            Target::Folder(folder)
        };
        let contact = args.contact_sheet.clone();
        Ok((Output { target, format, fps: args.fps, contact, magnify: None }, stays))
    }

    /// Sets the factor by which frames are magnified and returns the pixel format to ask the
    /// master for.
    pub fn takes(&mut self, times: u32, background: Background) -> PixelFormat {
        self.magnify = (times > 1).then_some(Magnify { times, background });
        if times > 1 { PixelFormat::Rgba32F } else { self.format.pixels(background) }
    }

    /// A frame as it is written.
    fn full(&self, frame: Frame) -> Frame {
        let Some(Magnify { times, background }) = self.magnify else { return frame };
        let large = magnified(frame.picture(), times, 1);
        let format = self.format.pixels(background);
        let bytes = large.encode(format, background).into();
        Frame { number: frame.number, size: large.size, format, bytes }
    }

    /// Returns the frames a second of a moving picture.
    pub fn fps(&self) -> Option<u16> {
        self.format.moves().then_some(self.fps)
    }

    /// Creates the folder.
    ///
    /// # Errors
    /// The folder can't be made.
    pub fn make(&mut self) -> Result<(), Fail> {
        match &mut self.target {
            Target::Folder(folder) => folder.make(),
            _ => Ok(()),
        }
    }

    /// Returns whether frames go to stdout.
    pub fn on_stdout(&self) -> bool {
        matches!(self.target, Target::Pipe(None))
    }

    /// Returns the place of the frames for people.
    fn place(&self) -> String {
        match &self.target {
            Target::Folder(folder) => folder.shown(),
            _ => self.shown(&[]),
        }
    }

    /// Returns the target for people: `slabcast-out/ (frame_0000.png ... frame_0017.png)`,
    /// `turn.y4m`, `stdout`.
    pub fn shown(&self, written: &[u64]) -> String {
        match &self.target {
            Target::Folder(folder) => format!("{} ({})", folder.shown(), folder.list(written)),
            Target::SingleFrame(path) | Target::Movie(path) | Target::Pipe(Some(path)) => {
                path.display().to_string()
            }
            Target::Pipe(None) => "stdout".into(),
        }
    }
}

/// A moving picture in the making.
struct Movie {
    coder: Coder,
    sink: Sink,
    frames: u64,
}

enum Coder {
    Apng(png::Moving),
    Y4m { fps: u16 },
}

enum Sink {
    /// Not begun: the file is made with the first frame, so that a run that fails before has
    /// nothing to clean up.
    New(PathBuf),
    File(GrowingFile),
    Pipe(Box<dyn Write + Send>, String),
}

impl Movie {
    fn add(&mut self, frame: &Frame, provenance: &str, patience: &DiskWait) -> std::io::Result<()> {
        let piece = match &mut self.coder {
            Coder::Apng(moving) => moving.frame(frame, provenance)?,
            Coder::Y4m { fps } => {
                let mut piece = Vec::new();
                if self.frames == 0 {
                    piece = y4m::head(frame.size, *fps);
                }
                piece.extend(y4m::frame(frame)?);
                piece
            }
        };
        if let Sink::New(path) = &self.sink {
            self.sink = Sink::File(patience.until_taken(path, || GrowingFile::new(path))?);
        }
        match &mut self.sink {
            Sink::New(_) => unreachable!("begun above"),
            Sink::File(file) => file.add(&piece, patience)?,
            Sink::Pipe(pipe, _) => {
                pipe.write_all(&piece)?;
                pipe.flush()?;
            }
        }
        self.frames += 1;
        Ok(())
    }

    /// Ends it with as many frames as there are; none leave nothing.
    fn end(self, patience: &DiskWait) -> std::io::Result<()> {
        let Sink::File(mut file) = self.sink else { return Ok(()) };
        if let Coder::Apng(moving) = &self.coder {
            let (tail, (at, patch)) = moving.end();
            file.add(&tail, patience)?;
            file.patch(at, &patch)?;
        }
        file.settle(patience)
    }

    fn path(&self) -> String {
        match &self.sink {
            Sink::New(path) => path.display().to_string(),
            Sink::File(file) => file.path().display().to_string(),
            Sink::Pipe(_, name) => name.clone(),
        }
    }

    fn fail(name: &str, e: &std::io::Error) -> Fail {
        if e.kind() == ErrorKind::BrokenPipe {
            return Fail::failed(format!("{name}: whoever read the frames has gone away"));
        }
        Fail::io(Path::new(name), "writing", e)
    }
}

/// Writes frames, encoded on blocking threads of the runtime.
pub struct Writer {
    output: Arc<Output>,
    movie: Option<Arc<Mutex<Movie>>>,
    contact: Option<Arc<Mutex<Contact>>>,
    patience: Arc<DiskWait>,
    busy: JoinSet<Result<u64, Fail>>,
    written: Vec<u64>,
}

/// Frames that are encoded at once or wait for it. Encoding takes a hundredth of rendering; what
/// takes time is the sync to disk, during which a second one encodes. Each holds a frame's
/// pixels (200 MB at 8192x8192), so not many more.
const AT_ONCE: usize = 2;

impl Writer {
    /// Starts writing `frames` frames; opens pipes.
    ///
    /// # Errors
    /// The pipe can't be opened.
    pub fn new(output: Arc<Output>, frames: u64, patience: Arc<DiskWait>) -> Result<Self, Fail> {
        let coder = || match output.format {
            Format::Apng => Coder::Apng(png::Moving::new(output.fps)),
            _ => Coder::Y4m { fps: output.fps },
        };
        let sink = match &output.target {
            Target::Folder(_) | Target::SingleFrame(_) => None,
            Target::Movie(path) => Some(Sink::New(path.clone())),
            Target::Pipe(None) => Some(Sink::Pipe(Box::new(std::io::stdout()), "stdout".into())),
            Target::Pipe(Some(path)) => {
                let pipe = std::fs::File::options().write(true).open(path);
                let pipe = pipe.map_err(|e| Fail::io(path, "opening", &e))?;
                Some(Sink::Pipe(Box::new(pipe), path.display().to_string()))
            }
        };
        let movie =
            sink.map(|sink| Arc::new(Mutex::new(Movie { coder: coder(), sink, frames: 0 })));
        let contact = output.contact.as_ref().map(|_| Arc::new(Mutex::new(Contact::new(frames))));
        Ok(Writer { output, movie, contact, patience, busy: JoinSet::new(), written: Vec::new() })
    }

    /// Returns whether [`Writer::put`] may be called.
    pub fn has_room(&self) -> bool {
        // Frames of a moving picture follow each other.
        self.busy.len() < if self.movie.is_some() { 1 } else { AT_ONCE }
    }

    /// Returns whether a frame is being written.
    pub fn is_busy(&self) -> bool {
        !self.busy.is_empty()
    }

    /// Takes the next frame in order, with its provenance.
    pub fn put(&mut self, frame: Frame, made: Option<Provenance>) {
        let (output, movie) = (self.output.clone(), self.movie.clone());
        let (contact, patience) = (self.contact.clone(), self.patience.clone());
        self.busy.spawn_blocking(move || {
            let frame = output.full(frame);
            let provenance = made.map_or_else(String::new, |made| made.written(&frame));
            if let Some(contact) = contact {
                contact.lock().expect("no thread panics with it").add(&frame);
            }
            let to = |path: &Path| {
                patience.write_atomic(path, |out| match output.format {
                    Format::Exr => exr::encode(&frame, &provenance, out),
                    _ => png::encode(&frame, &provenance, out),
                })
            };
            match (&output.target, movie) {
                (Target::Folder(folder), _) => to(&folder.file(frame.number))?,
                (Target::SingleFrame(path), _) => to(path)?,
                (_, Some(movie)) => {
                    let mut movie = movie.lock().expect("no thread panics with it");
                    let added = movie.add(&frame, &provenance, &patience);
                    added.map_err(|e| Movie::fail(&movie.path(), &e))?;
                }
                (_, None) => unreachable!("made with the writer"),
            }
            Ok(frame.number)
        });
    }

    /// Waits for the next frame to be on disk and returns its number. Pending for ever if none
    /// is being written.
    ///
    /// # Errors
    /// The frame can't be written.
    pub async fn next_written(&mut self) -> Result<u64, Fail> {
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

    /// Waits for all frames, then finishes the moving picture and the contact sheet with the
    /// frames that there are.
    ///
    /// # Errors
    /// The first failure; other frames are still written.
    pub async fn end(&mut self) -> Result<(), Fail> {
        let mut first = Ok(());
        while self.is_busy() {
            if let Err(e) = self.next_written().await
                && first.is_ok()
            {
                first = Err(e);
            }
        }
        let before = self.written.len();
        let there = self.written().len();
        if first.is_ok() && there < before {
            first = Err(Fail::failed(format!(
                "{}: {} of {before} frames were taken away after they were written; render them \
                 again",
                self.output.place(),
                before - there
            )));
        }
        if self.written.is_empty() {
            return first;
        }
        let (movie, contact) = (self.movie.take(), self.contact.take());
        let (output, patience) = (self.output.clone(), self.patience.clone());
        let ended = tokio::task::spawn_blocking(move || {
            if let Some(movie) = movie.and_then(Arc::into_inner) {
                let movie = movie.into_inner().expect("no thread panics with it");
                let name = movie.path();
                movie.end(&patience).map_err(|e| Movie::fail(&name, &e))?;
            }
            if let (Some(contact), Some(path)) = (contact, &output.contact) {
                let sheet = contact.lock().expect("no thread panics with it").draw();
                patience.write_atomic(path, |out| sheet.png(out, &[]))?;
            }
            Ok(())
        });
        let ended = ended.await;
        first.and(ended.unwrap_or_else(|e| Err(Fail::failed(format!("writing failed: {e}")))))
    }

    /// Returns the numbers of the frames on disk, ascending. Files that somebody took away after
    /// they were written are none of them.
    pub fn written(&mut self) -> &[u64] {
        if let Target::Folder(folder) = &self.output.target {
            self.written.retain(|&number| folder.file(number).exists());
        }
        self.written.sort_unstable();
        &self.written
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A frame of two pixels side by side.
    pub(super) fn frame(number: u64, format: PixelFormat, bytes: &[u8]) -> Frame {
        Frame { number, size: [2, 1], format, bytes: bytes.to_vec().into() }
    }

    fn look(output: &str, format: Option<Format>, frames: u64) -> Result<Output, String> {
        let args = OutputArgs {
            output: output.into(),
            format,
            fps: 12,
            contact_sheet: None,
            force: false,
        };
        Output::look(&args, "frame", 0..frames, Background::Colour([0.0; 3]), &[])
            .map(|(output, _)| output)
            .map_err(|e| e.line().unwrap_or_default().to_string())
    }

    #[test]
    fn names_say_what_frames_become() {
        for (name, format, frames, want, shown) in [
            ("nowhere-at-all/", None, 3, Format::Png, "nowhere-at-all/ (frame_0000.png)"),
            (
                "nowhere-at-all",
                Some(Format::Exr),
                3,
                Format::Exr,
                "nowhere-at-all/ (frame_0000.exr)",
            ),
            ("a.PNG", None, 1, Format::Png, "a.PNG"),
            ("a.png", Some(Format::Png16), 1, Format::Png16, "a.png"),
            ("a.png", Some(Format::Apng), 9, Format::Apng, "a.png"),
            ("a.exr", None, 1, Format::Exr, "a.exr"),
            ("a.y4m", None, 9, Format::Y4m, "a.y4m"),
            ("-", None, 9, Format::Y4m, "stdout"),
        ] {
            let output = look(name, format, frames).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!((output.format, &*output.shown(&[0])), (want, shown), "{name}");
        }
        for (name, format, frames, says) in [
            ("a.png", None, 2, "--azimuth"),
            ("a.png", Some(Format::Exr), 1, ".exr"),
            ("a.exr", Some(Format::Y4m), 1, ".y4m"),
            ("out", Some(Format::Y4m), 1, "-o turn.y4m"),
            ("-", Some(Format::Png), 1, "--format"),
            ("/dev/null", Some(Format::Apng), 1, "--format"),
            ("nowhere-at-all/a.png", None, 1, "nowhere-at-all/a.png"),
        ] {
            let said =
                look(name, format, frames).err().unwrap_or_else(|| panic!("{name} is taken"));
            assert!(said.contains(says), "{name}: {said}");
        }
    }
}
