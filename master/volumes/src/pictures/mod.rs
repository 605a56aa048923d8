//! Reader of stacks of PNG and JPEG pictures: the files of a folder, in the order of the numbers in
//! their names, become slices.
//!
//! A picture is read as grey if red, green and blue are equal in every pixel. From other pictures
//! one channel is read. Values are taken as stored: a PNG of one bit holds 0 and 1. Pictures have
//! no spacing; `--spacing` gives it.

pub(crate) mod jpeg;
mod png;

use crate::error::{OpenErrorKind, Problem, quoted};
use crate::samples::{self, DIM_MAX, Endian, Layout, Number, Supply};
use crate::source::{Notes, Source};
use crate::unpack::{copy_on, wrapped};
use crate::{Hints, Opened};
use slabcast_common::volume::Lattice;
use std::collections::VecDeque;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Most bytes of a picture that is decoded whole; room for 4096 x 4096 of 16 bits, and below the
/// 64 MiB that reading may take beside the voxels.
const WHOLE_MAX_BYTES: u64 = 48 << 20;
/// Most bytes of a whole picture in a small file. A larger one needs a byte of the file for each
/// [`WHOLE_RATIO`] of them.
const WHOLE_FREE_BYTES: u64 = 1 << 20;
/// A block of 64 pixels takes six bits of a JPEG at least, unless it is progressive.
const WHOLE_RATIO: u64 = 128;

/// Returns whether the first bytes are PNG.
pub(crate) fn is_png(head: &[u8]) -> bool {
    head.starts_with(b"\x89PNG\r\n\x1a\n")
}

/// Returns whether the first bytes are JPEG.
pub(crate) fn is_jpeg(head: &[u8]) -> bool {
    head.starts_with(b"\xff\xd8\xff")
}

/// Returns width and height of a picture from its first bytes; `None` if these do not hold them.
pub(crate) fn size(head: &[u8]) -> Option<(u32, u32)> {
    if is_jpeg(head) {
        let frame = jpeg::Frame::find(head).ok()?;
        return Some((frame.width.into(), frame.height.into()));
    }
    let word = |at: usize| head.get(at..at + 4)?.try_into().ok().map(u32::from_be_bytes);
    let header = is_png(head) && head.get(12..16) == Some(b"IHDR");
    header.then(|| Some((word(16)?, word(20)?))).flatten()
}

/// Checks that a picture of `bytes` bytes may be decoded whole, out of a file of `len` bytes.
fn check_whole(bytes: u64, len: u64) -> Result<(), Problem> {
    let most = WHOLE_MAX_BYTES.min(WHOLE_FREE_BYTES.max(WHOLE_RATIO.saturating_mul(len)));
    if bytes <= most {
        return Ok(());
    }
    Err(Problem::new(
        OpenErrorKind::TooLarge,
        "picture",
        format!("of {bytes} bytes is more than the {most} that are read at a time"),
        "save it as PNG without interlacing, or as TIFF",
    ))
}

/// Size and type of a picture, the same for all of a stack.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Shape {
    width: u32,
    height: u32,
    number: Number,
}

impl std::fmt::Display for Shape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} x {} {}", self.width, self.height, self.number.name())
    }
}

/// An open picture, whose rows come one after another.
enum Picture {
    Png(Box<png::Png>),
    Jpeg(jpeg::Jpeg),
}

impl Picture {
    /// Opens a file and reads its header.
    fn open(path: &Path, notes: &Notes) -> Result<(Picture, u64), Problem> {
        let mut source = Source::open(path, "file")?;
        source.notes = notes.clone();
        let len = source.len;
        let picture = match is_jpeg(source.head()?) {
            true => Picture::Jpeg(jpeg::Jpeg::open(source)?),
            false => Picture::Png(Box::new(png::Png::open(source)?)),
        };
        let Shape { width, height, number } = picture.shape();
        Layout::new([width.into(), height.into(), 1], number, Endian::Big, "size")?;
        Ok((picture, len))
    }

    fn shape(&self) -> Shape {
        match self {
            Picture::Png(png) => png.shape,
            Picture::Jpeg(jpeg) => jpeg.shape,
        }
    }

    /// Returns the palette that pixels index, if it has a colour that is not grey.
    fn palette(&self) -> Option<&[u8]> {
        match self {
            Picture::Png(png) => png.palette.as_deref(),
            Picture::Jpeg(_) => None,
        }
    }

    /// Returns the count of numbers in a pixel, 1 to 4: grey or three colours, and opacity.
    fn channels(&self) -> u64 {
        match self {
            Picture::Png(png) => png.channels(),
            Picture::Jpeg(jpeg) => jpeg.channels,
        }
    }

    /// Appends the samples of the next rows to `out`, big-endian: of one channel, or their grey
    /// value without `channel`.
    fn rows(&mut self, channel: Option<Channel>, out: &mut Vec<u8>) -> Result<(), Problem> {
        match self {
            Picture::Png(png) => png.row(channel, out),
            Picture::Jpeg(jpeg) => jpeg.all(channel, out),
        }
    }
}

/// Returns the error for a pixel whose red, green and blue differ.
fn colours(channels: usize) -> Problem {
    let problem = Problem::unsupported(
        "picture",
        "is in colours: red, green and blue differ",
        "take one of them with --channel 0 to 2, or save the stack in shades of grey",
    );
    Problem { colours: Some(if channels == 4 { 4 } else { 3 }), ..problem }
}

/// Returns the count of numbers in a pixel that has all channels of two pictures of a stack, `a`
/// and `b` numbers. If one has opacity or colours, the stack has them.
fn together(a: u64, b: u64) -> u64 {
    let is_alpha = a.is_multiple_of(2) || b.is_multiple_of(2);
    if a.max(b) < 3 { a.max(b) } else { 3 + u64::from(is_alpha) }
}

/// Channel that is read from each picture of a stack.
#[derive(Clone, Copy)]
struct Channel {
    index: u64,
    /// Count of numbers in a pixel of the stack: 1 is grey, 2 grey and opacity, 3 colours, 4
    /// colours and opacity.
    of: u64,
}

impl Channel {
    /// Returns the channel's index among the `channels` numbers of one picture's pixels; `None` if
    /// it is the opacity and this picture has none, which counts as opaque.
    fn within(self, channels: usize) -> Option<usize> {
        if self.of.is_multiple_of(2) && self.index == self.of - 1 {
            return channels.is_multiple_of(2).then(|| channels - 1);
        }
        Some(if channels < 3 { 0 } else { self.index as usize })
    }
}

/// Appends one channel of pixels to `out`, or their grey value without a channel. A pixel has
/// `channels` numbers of `size` bytes: grey, grey and opacity, three colours, or colours and
/// opacity. Returns false if a grey value was taken from a pixel that is not opaque.
///
/// # Errors
/// Without a channel: a pixel's red, green and blue differ.
fn push(
    pixels: &[u8],
    (channels, size): (usize, usize),
    channel: Option<Channel>,
    out: &mut Vec<u8>,
) -> Result<bool, Problem> {
    if let Some(channel) = channel {
        let number = channel.within(channels);
        for pixel in pixels.chunks_exact(channels * size) {
            match number {
                Some(i) => out.extend_from_slice(&pixel[i * size..(i + 1) * size]),
                // A picture without opacity is opaque.
                None => out.extend(std::iter::repeat_n(0xff, size)),
            }
        }
        return Ok(true);
    }
    if channels == 1 {
        out.extend_from_slice(pixels);
        return Ok(true);
    }
    let (mut opaque, mut grey) = (true, true);
    for pixel in pixels.chunks_exact(channels * size) {
        let at = |i: usize| &pixel[i * size..(i + 1) * size];
        if channels >= 3 {
            grey &= at(0) == at(1) && at(1) == at(2);
        }
        if channels.is_multiple_of(2) {
            opaque &= at(channels - 1).iter().all(|b| *b == 0xff);
        }
        out.extend_from_slice(at(0));
    }
    if grey { Ok(opaque) } else { Err(colours(channels)) }
}

/// Reads pictures, in the order given, as slices of a volume called `name`. Its samples take at
/// most `cap`.
pub(crate) fn read_files(
    files: Vec<PathBuf>,
    name: &str,
    hints: &Hints,
) -> Result<Opened, Problem> {
    let cap = hints.cap();
    hints.pick.without_channel().choose(&[], "folder")?;
    let count = files.len() as u64;
    if count > DIM_MAX {
        return Err(Problem::new(
            OpenErrorKind::TooLarge,
            "folder",
            format!("{count} pictures are more than {DIM_MAX}"),
            "leave some out",
        ));
    }
    let notes = Notes::default();
    let (mut first, mut total, mut channels) = (None, 0, 1);
    for path in &files {
        let shown = quoted(&path.file_name().unwrap_or_default().to_string_lossy());
        let (picture, len) = Picture::open(path, &notes).map_err(|p| in_file(path, p))?;
        total += len;
        channels = together(channels, picture.channels());
        let (shape, palette) = (picture.shape(), picture.palette().map(<[u8]>::to_vec));
        match &first {
            None => first = Some((shape, palette)),
            Some((first, _)) if shape != *first => return Err(differs(&shown, shape, *first)),
            Some((_, first)) if palette != *first => {
                return Err(Problem::unsupported(
                    shown,
                    "has another palette than the first",
                    "save the stack in shades of grey",
                ));
            }
            Some(_) => {}
        }
    }
    let (shape, _) = first.expect("the caller passes a file");
    // Without `--channel`, pictures with colours are still read if all pixels are grey.
    let of = hints.pick.channel.map(|_| hints.pick.of_pixel(channels, "folder")).transpose()?;
    let channel = of.map(|index| Channel { index, of: channels }).filter(|_| channels > 1);
    let sizes = [shape.width.into(), shape.height.into(), count];
    let layout = Layout::new(sizes, shape.number, Endian::Big, "pictures")?;
    let lattice = Lattice::from_spacing(layout.dims, hints.raw.spacing.unwrap_or([1.0; 3]));
    lattice.check().map_err(|e| Problem::malformed("--spacing", e, "give three lengths"))?;
    let mut stack = Stack {
        current: None,
        files: files.into(),
        shape,
        rows: Vec::new(),
        consumed: 0,
        left: 0,
        channel,
        notes: notes.clone(),
    };
    // Deflate's limit also covers JPEG, where a byte holds at most some hundred pixels.
    let supply = Supply::deflate("pictures", total);
    let (samples, map) = samples::read(&mut stack, supply, &layout, cap).map_err(|p| {
        // The first picture with colours may have no opacity where others have.
        let colours = p.colours.map(|_| channels as u8);
        Problem { colours, ..p }
    })?;
    if hints.raw.spacing.is_none() {
        notes.add("pictures have no spacing; 1 mm was taken (--spacing sets it)");
    }
    let volume = crate::stream::volume(name, shape.number.name(), false, lattice, samples, map);
    Ok(Opened { volume, notes: notes.take() })
}

fn in_file(path: &Path, mut p: Problem) -> Problem {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    p.field = format!("{} {}", quoted(&name), p.field);
    p
}

fn differs(which: &str, shape: Shape, first: Shape) -> Problem {
    Problem::malformed(
        which,
        format!("is {shape}, where the first is {first}"),
        "make all of one size and type, or leave it out",
    )
}

/// Reads the samples of all pictures, one after another.
struct Stack {
    current: Option<(PathBuf, Picture)>,
    /// Files not yet opened.
    files: VecDeque<PathBuf>,
    shape: Shape,
    /// Decoded samples of the current rows, as bytes.
    rows: Vec<u8>,
    /// Bytes of `rows` that were handed out.
    consumed: usize,
    /// Bytes of the current picture that are still to be decoded.
    left: u64,
    /// Channel that is read; `None` for the grey value.
    channel: Option<Channel>,
    notes: Notes,
}

impl Stack {
    /// Decodes the next rows; false at the end.
    fn fill(&mut self) -> Result<bool, Problem> {
        if self.left == 0 {
            let Some(path) = self.files.pop_front() else { return Ok(false) };
            let (picture, _) = Picture::open(&path, &self.notes).map_err(|p| in_file(&path, p))?;
            // The file may have changed since the first pass.
            if picture.shape() != self.shape {
                return Err(differs("a picture", picture.shape(), self.shape));
            }
            let Shape { width, height, number } = self.shape;
            self.left = u64::from(width) * u64::from(height) * number.bytes();
            self.current = Some((path, picture));
        }
        let Some((path, picture)) = &mut self.current else { return Ok(false) };
        self.rows.clear();
        self.consumed = 0;
        picture.rows(self.channel, &mut self.rows).map_err(|p| in_file(path, p))?;
        let came = self.rows.len() as u64;
        if came == 0 || came > self.left {
            let problem = Problem::new(
                OpenErrorKind::Damaged,
                "picture",
                "ends early, or goes on too long",
                "get the whole file",
            );
            return Err(in_file(path, problem));
        }
        self.left -= came;
        Ok(true)
    }
}

impl Read for Stack {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        if self.consumed == self.rows.len() && !self.fill().map_err(wrapped)? {
            return Ok(0);
        }
        Ok(copy_on(&self.rows, &mut self.consumed, buf))
    }
}

/// Reads all samples of one picture, for the mutants of `fuzz.rs`.
#[cfg(test)]
pub(crate) fn one_picture(mut source: Source) -> Result<Vec<u8>, Problem> {
    let mut picture = match is_jpeg(source.head()?) {
        true => Picture::Jpeg(jpeg::Jpeg::open(source)?),
        false => Picture::Png(Box::new(png::Png::open(source)?)),
    };
    let Shape { width, height, number } = picture.shape();
    let need = u64::from(width) * u64::from(height) * number.bytes();
    let (mut rows, mut have) = (Vec::new(), 0);
    while have < need {
        rows.clear();
        picture.rows(None, &mut rows)?;
        if rows.is_empty() {
            return Err(samples::truncated(need, have));
        }
        have += rows.len() as u64;
    }
    Ok(rows)
}

#[cfg(test)]
pub(crate) mod tests;
