//! Output of a run: pictures in a folder, one picture, a moving one, or video in a pipe.
//!
//! [`Output`] is where and as what, checked before any work; [`Writer`] takes the frames as they
//! come and encodes them on threads of its own beside rendering. `mod@file` keeps the promise that
//! a file is whole or not there.

mod contact;
pub mod exr;
mod ffmpeg;
mod file;
mod folder;
mod format;
mod grid;
mod jpg;
mod lines;
mod made;
mod movie;
pub mod png;
pub mod provenance;
mod tif;
mod y4m;

pub use file::{DiskWait, probe, write_atomic};
pub use format::{Format, free_name, named};
pub use grid::Grid;
pub use lines::Lines;
pub use made::OutputFolder;

use crate::fail::Fail;
use crate::figure::{Figure, Marker};
use crate::magnify::magnified;
use crate::parse;
use crate::request::RenderRequest;
use contact::{Contact, Names};
use folder::{Folder, Wanted};
use movie::{Movie, Sink};
use provenance::Provenance;
use slabcast_common::image::{Background, Picture, PixelFormat};
use slabcast_common::math::{linear_from_srgb, srgb_from_linear};
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

/// Metadata of a picture's file.
#[derive(Clone, Copy, Debug, Default)]
pub struct Inside<'a> {
    /// Provenance as JSON; nothing is written where it is empty.
    pub provenance: &'a str,
    /// Dots an inch on paper, if they were given.
    pub dpi: Option<u32>,
}

/// Largest edge of a view in a grid: six sides are then 3 by 2 of them, within 12288x8192.
const GRID_EDGE: u32 = 4096;

/// Folder for frames where the user names none.
pub const OWN_FOLDER: &str = "slabcast-out/";

/// Target and format of the frames, checked before any work.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Output")]
pub struct OutputArgs {
    /// Folder for frame_0000.png and so on, or one file [default: slabcast-out/]
    ///
    /// A folder is made if missing; beside a slabcast-out/ with pictures slabcast-out-2/ is, and so
    /// on. NAME.png, .tif, .jpg or .exr is one picture: the first view, or a grid of the --views.
    /// NAME.mp4, .webm and .gif (by ffmpeg), .apng or .y4m have all frames; - writes Y4M video to
    /// stdout.
    #[arg(short, long, value_name = "DIR|FILE|-")]
    pub output: Option<PathBuf>,
    /// png, png16, exr, tif, jpg, ... [default: by the name of -o]
    ///
    /// png, png16, exr, tif, jpg, and moving: apng, y4m, mp4, webm, gif. png16 has 16 bits, exr
    /// linear floats and no background. A folder gets png by default.
    #[arg(long, value_name = "FORMAT", hide_possible_values = true, value_enum)]
    pub format: Option<Format>,
    /// Frames a second of a moving picture [default: 30 of mp4 and webm, else 12]
    #[arg(long, value_name = "N", hide_short_help = true,
          value_parser = clap::value_parser!(u16).range(1..=240))]
    pub fps: Option<u16>,
    /// Also all frames, small, on one PNG
    #[arg(long, value_name = "FILE.png", value_parser = parse::png, hide_short_help = true)]
    pub contact_sheet: Option<PathBuf>,
    /// Replace files that are there already
    ///
    /// Of a folder, all frames that slabcast wrote there before.
    #[arg(long)]
    pub force: bool,
    /// Marks over the picture.
    #[command(flatten)]
    pub figure: Figure,
}

impl OutputArgs {
    /// Returns the format that the flags ask for; `None` for a folder without `--format`, a pipe or
    /// stdout.
    ///
    /// # Errors
    /// The name of `-o` ends in no known format.
    pub fn asked(&self) -> Result<Option<Format>, Fail> {
        let named = self.output.as_deref().map_or(Ok(None), named)?;
        Ok(self.format.or(named))
    }

    /// Returns whether `-o` names a file for a single picture.
    ///
    /// # Errors
    /// The name of `-o` ends in no known format.
    pub fn is_one_picture(&self) -> Result<bool, Fail> {
        let named = self.output.as_deref().map_or(Ok(None), named)?;
        Ok(named.is_some() && self.asked()?.is_some_and(|f| !f.moves()))
    }
}

/// Target of the frames.
#[derive(Debug)]
enum Target {
    /// A file each.
    Folder(Folder),
    /// One frame in one file.
    SingleFrame(PathBuf),
    /// All frames side by side in one file.
    Grid(PathBuf),
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
    /// Names of the frames, where they have some.
    names: Names,
    /// Marks over the pictures, and their dots an inch.
    pub figure: Figure,
    background: Background,
    /// Magnification of frames that arrive as small pictures of floats; `None` for others.
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

/// Says what becomes of odd edges in a format that has none.
fn evened(format: Format, [w, h]: [u32; 2]) -> Option<String> {
    let even = [w, h].map(|n| n.next_multiple_of(2));
    let odd = matches!(format, Format::Mp4 | Format::Webm) && even != [w, h];
    odd.then(|| {
        format!(
            "video has even edges: {w}x{h} becomes {}x{}, by a line of the background",
            even[0], even[1]
        )
    })
}

/// Checks that a format can have a background, and the other way round.
fn fits_background(format: Format, background: Background) -> Result<(), Fail> {
    match (format, background) {
        (Format::Jpg, Background::Transparent) => Err(Fail::usage(
            "--background: a JPEG has no transparency; give a colour, or a name that ends in .png",
        )),
        (format, Background::Transparent) if format.moves() && format != Format::Apng => Err(
            Fail::usage("--background: video has no transparency; give a colour, or --format apng"),
        ),
        (Format::Exr, Background::Colour(c)) if c != [0.0; 3] => Err(Fail::usage(
            "--background: an EXR holds the picture before any background; leave it out",
        )),
        _ => Ok(()),
    }
}

impl Output {
    /// Checks the target without writing anything. Also returns a note for the user: about files of
    /// an earlier run, or a folder beside theirs.
    ///
    /// # Errors
    /// A file would be replaced without `--force`, the target doesn't fit the format, or ffmpeg is
    /// needed and missing.
    pub fn look(
        args: &OutputArgs,
        stem: &'static str,
        request: &RenderRequest,
        inputs: &[&Path],
    ) -> Result<(Output, Option<String>), Fail> {
        let path = args.output.as_deref().unwrap_or(Path::new(OWN_FOLDER));
        let shown = path.display();
        let named = named(path)?;
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
        if named.is_some() && !format::ending(path).is_some_and(|ends| format.fits(&ends)) {
            return Err(Fail::usage(format!(
                "--format, -o: {shown} is not a name for {name}; end it in .{}",
                format.extension()
            )));
        }
        let background = request.background;
        fits_background(format, background)?;
        args.figure.check(format == Format::Exr, format.has_provenance())?;
        if let Some(contact) = &args.contact_sheet {
            may_write(contact, "contact-sheet", inputs, args.force)?;
        }
        let (mut stays, names) = (None, Names::of(&request.path));
        let frames = request.frames();
        let count = frames.end - frames.start;
        let target = if stdout {
            Target::Pipe(None)
        } else if pipe {
            Target::Pipe(Some(path.to_path_buf()))
        } else if format.moves() {
            if named.is_none() {
                return Err(Fail::usage(format!(
                    "-o: {name} is one file of all frames; give its name, like -o turn.{name}"
                )));
            }
            if format.by_ffmpeg() && ffmpeg::program().is_none() {
                let command = ffmpeg::command_for_people("turn.y4m", path, format);
                return Err(Fail::failed(format!(
                    "-o: {shown}: ffmpeg makes {name}, and there is none in PATH; install it, or \
                     render to -o turn.y4m and run elsewhere: {command}"
                )));
            }
            may_write(path, "output", inputs, args.force)?;
            stays = evened(format, request.size()).map(|note| format!("{shown}: {note}"));
            Target::Movie(path.to_path_buf())
        } else if named.is_some() {
            let grid = count > 1 && names.all_of(&frames);
            if grid && request.size().iter().any(|edge| *edge > GRID_EDGE) {
                return Err(Fail::usage(format!(
                    "--size: each view of a grid has at most {GRID_EDGE}x{GRID_EDGE} pixels"
                )));
            }
            if grid && !matches!(format, Format::Png | Format::Tif | Format::Jpg) {
                return Err(Fail::usage(format!(
                    "-o: a grid of views has 8 bits, as png, tif or jpg; give one of them, or a \
                     folder for a {name} of each view"
                )));
            }
            if count > 1 && !grid {
                return Err(Fail::usage(format!(
                    "-o: {shown} is one picture, and the path has {count} views; give a folder, \
                     --azimuth or --frames N..N for one view, or turn.mp4 or turn.apng for a moving \
                     picture"
                )));
            }
            may_write(path, "output", inputs, args.force)?;
            let path = path.to_path_buf();
            if grid { Target::Grid(path) } else { Target::SingleFrame(path) }
        } else {
            let part = request.path.range.is_some();
            let wanted = Wanted { frames, part, names: (stem, format.extension()) };
            let (folder, note) = match args.output {
                Some(_) => Folder::look(path, &wanted, args.force),
                None => Folder::look_for_own(path, &wanted, args.force),
            }?;
            stays = note;
            Target::Folder(folder)
        };
        let output = Output {
            target,
            format,
            fps: args.fps.unwrap_or(format.usual_fps()),
            contact: args.contact_sheet.clone(),
            names,
            figure: args.figure.clone(),
            background,
            magnify: None,
        };
        Ok((output, stays))
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

    /// Returns whether frames become one still picture.
    pub fn is_grid(&self) -> bool {
        matches!(self.target, Target::Grid(_))
    }

    /// Returns whether one file has all frames and one provenance.
    pub fn is_whole(&self) -> bool {
        self.format == Format::Apng || self.is_grid()
    }

    /// Returns whether the format has a place for provenance.
    pub fn has_provenance(&self) -> bool {
        self.format.has_provenance()
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
            Target::SingleFrame(path)
            | Target::Grid(path)
            | Target::Movie(path)
            | Target::Pipe(Some(path)) => path.display().to_string(),
            Target::Pipe(None) => "stdout".into(),
        }
    }
}

/// Writes frames, encoded on blocking threads of the runtime.
pub struct Writer {
    output: Arc<Output>,
    marker: Option<Arc<Marker>>,
    movie: Option<Arc<Mutex<Movie>>>,
    grid: Option<Arc<Mutex<Grid>>>,
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
    /// Starts writing `frames` frames, each with the marks of `marker`; opens pipes.
    ///
    /// # Errors
    /// The pipe can't be opened.
    pub fn new(
        output: Arc<Output>,
        frames: u64,
        marker: Option<Marker>,
        patience: Arc<DiskWait>,
    ) -> Result<Self, Fail> {
        let sink = match &output.target {
            Target::Folder(_) | Target::SingleFrame(_) | Target::Grid(_) => None,
            Target::Movie(path) => Some(Sink::New(path.clone())),
            Target::Pipe(None) => Some(Sink::Pipe(Box::new(std::io::stdout()), "stdout".into())),
            Target::Pipe(Some(path)) => {
                let pipe = std::fs::File::options().write(true).open(path);
                let pipe = pipe.map_err(|e| Fail::io(path, "opening", &e))?;
                Some(Sink::Pipe(Box::new(pipe), path.display().to_string()))
            }
        };
        let behind = ffmpeg::bytes_of(output.background);
        let movie = sink
            .map(|sink| Arc::new(Mutex::new(Movie::new(sink, output.format, output.fps, behind))));
        let contact = output
            .contact
            .as_ref()
            .map(|_| Arc::new(Mutex::new(Contact::new(frames, output.names.clone()))));
        let is_grid = matches!(output.target, Target::Grid(_));
        let grid = is_grid.then(|| Arc::new(Mutex::new(Grid::new(None, behind))));
        let (busy, written) = (JoinSet::new(), Vec::new());
        let marker = marker.map(Arc::new);
        Ok(Writer { output, marker, movie, grid, contact, patience, busy, written })
    }

    /// Returns whether [`Writer::put`] may be called.
    pub fn has_room(&self) -> bool {
        // Frames of a moving picture follow each other.
        self.busy.len() < if self.movie.is_some() || self.grid.is_some() { 1 } else { AT_ONCE }
    }

    /// Returns whether a frame is being written.
    pub fn is_busy(&self) -> bool {
        !self.busy.is_empty()
    }

    /// Takes the next frame in order, with its provenance.
    pub fn put(&mut self, frame: Frame, made: Option<Provenance>) {
        let (output, movie, grid) = (self.output.clone(), self.movie.clone(), self.grid.clone());
        let (contact, patience) = (self.contact.clone(), self.patience.clone());
        let marker = self.marker.clone();
        self.busy.spawn_blocking(move || {
            let mut frame = output.full(frame);
            if let Some(marker) = marker {
                frame.bytes = marker
                    .draw(frame.number, frame.size, frame.format, frame.bytes.to_vec())
                    .into();
            }
            let provenance = made.map_or_else(String::new, |made| made.written(&frame));
            if let Some(contact) = contact {
                contact.lock().expect("no thread panics with it").add(&frame);
            }
            let inside = Inside { provenance: &provenance, dpi: output.figure.dpi };
            match (&output.target, movie, grid) {
                (Target::Folder(folder), ..) => {
                    write(&folder.file(frame.number), &frame, &inside, output.format, &patience)?;
                }
                (Target::SingleFrame(path), ..) => {
                    write(path, &frame, &inside, output.format, &patience)?;
                }
                (_, Some(movie), _) => {
                    let mut movie = movie.lock().expect("no thread panics with it");
                    let added = movie.add(&frame, &inside, &patience);
                    added.map_err(|e| Movie::fail(&movie.path(), &e))?;
                }
                (_, _, Some(grid)) => {
                    let number = frame.number;
                    let mut grid = grid.lock().expect("no thread panics with it");
                    grid.made(provenance);
                    grid.add(frame, output.names.get(number).unwrap_or_default());
                    return Ok(number);
                }
                _ => unreachable!("made with the writer"),
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
        let (grid, marker) = (self.grid.take(), self.marker.clone());
        let (output, patience) = (self.output.clone(), self.patience.clone());
        let ended = tokio::task::spawn_blocking(move || {
            if let Some(movie) = movie.and_then(Arc::into_inner) {
                let movie = movie.into_inner().expect("no thread panics with it");
                let name = movie.path();
                movie.end(&patience).map_err(|e| Movie::fail(&name, &e))?;
            }
            if let (Some(grid), Target::Grid(path)) = (grid, &output.target) {
                let mut grid = grid.lock().expect("no thread panics with it");
                let (frame, provenance) = grid.draw(marker.as_deref());
                let inside = Inside { provenance: &provenance, dpi: output.figure.dpi };
                write(path, &frame, &inside, output.format, &patience)?;
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

/// Writes one picture that has no provenance: whole or not there.
///
/// # Errors
/// The file can't be written.
pub fn write_picture(
    path: &Path,
    frame: &Frame,
    dpi: Option<u32>,
    format: Format,
) -> Result<(), Fail> {
    write(path, frame, &Inside { provenance: "", dpi }, format, &DiskWait::default())
}

/// Converts a background to sRGB bytes; without a background to black.
pub fn background_bytes(background: Background) -> [u8; 3] {
    ffmpeg::bytes_of(background)
}

/// Writes one picture: whole or not there.
fn write(
    path: &Path,
    frame: &Frame,
    inside: &Inside<'_>,
    format: Format,
    patience: &DiskWait,
) -> Result<(), Fail> {
    patience.write_atomic(path, |out| match format {
        Format::Exr => exr::encode(frame, inside.provenance, out),
        Format::Tif => tif::encode(frame, inside, out),
        Format::Jpg => jpg::encode(frame, inside, out),
        _ => png::encode(frame, inside, out),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_scene::path::{Turntable, ViewPath};

    /// A frame of two pixels side by side.
    pub(super) fn frame(number: u64, format: PixelFormat, bytes: &[u8]) -> Frame {
        Frame { number, size: [2, 1], format, bytes: bytes.to_vec().into() }
    }

    fn look(output: &str, format: Option<Format>, frames: u32) -> Result<Output, String> {
        let args = OutputArgs {
            output: Some(output.into()),
            format,
            fps: None,
            contact_sheet: None,
            force: false,
            figure: Figure::default(),
        };
        let path = ViewPath::from_turntable([8, 8], Turntable { frames, ..Turntable::default() });
        let request = RenderRequest::for_preset(path, "skin").unwrap();
        Output::look(&args, "frame", &request, &[])
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
            ("a.jpeg", None, 1, Format::Jpg, "a.jpeg"),
            ("a.tif", None, 1, Format::Tif, "a.tif"),
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
            ("a.pdf", None, 1, "no .pdf is written; end the name in .png, .tif"),
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
