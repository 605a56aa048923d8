//! A moving picture in the making: all frames in one file, a pipe, or ffmpeg.

use super::ffmpeg::Encoder;
use super::file::{DiskWait, GrowingFile};
use super::{Format, Frame, Inside, png, y4m};
use crate::fail::Fail;
use std::io::{ErrorKind, Result, Write};
use std::path::{Path, PathBuf};

/// A moving picture in the making.
pub(super) struct Movie {
    format: Format,
    fps: u16,
    /// Colour of what is added to an odd edge, sRGB.
    behind: [u8; 3],
    apng: png::Moving,
    sink: Sink,
    frames: u64,
}

/// Destination of a movie's bytes: a file, ffmpeg, or a pipe.
pub(super) enum Sink {
    /// Not begun: the file is made with the first frame, so that a run that fails before has
    /// nothing to clean up.
    New(PathBuf),
    File(GrowingFile),
    Encoder(Encoder),
    Pipe(Box<dyn Write + Send>, String),
}

impl Movie {
    pub(super) fn new(sink: Sink, format: Format, fps: u16, behind: [u8; 3]) -> Movie {
        Movie { format, fps, behind, apng: png::Moving::new(fps), sink, frames: 0 }
    }

    pub(super) fn add(
        &mut self,
        frame: &Frame,
        inside: &Inside<'_>,
        patience: &DiskWait,
    ) -> Result<()> {
        let piece = match self.format {
            Format::Apng => self.apng.frame(frame, inside)?,
            _ => {
                let mut piece = Vec::new();
                if self.frames == 0 {
                    piece = y4m::head(frame.size, self.fps);
                }
                piece.extend(y4m::frame(frame)?);
                piece
            }
        };
        if let Sink::New(path) = &self.sink {
            self.sink = if self.format.by_ffmpeg() {
                Sink::Encoder(Encoder::start(path, self.format, self.behind)?)
            } else {
                Sink::File(patience.until_taken(path, || GrowingFile::new(path))?)
            };
        }
        match &mut self.sink {
            Sink::New(_) => unreachable!("begun above"),
            Sink::File(file) => file.add(&piece, patience)?,
            Sink::Encoder(encoder) => encoder.add(&piece)?,
            Sink::Pipe(pipe, _) => {
                pipe.write_all(&piece)?;
                pipe.flush()?;
            }
        }
        self.frames += 1;
        Ok(())
    }

    /// Ends it with as many frames as there are; none leave nothing.
    pub(super) fn end(self, patience: &DiskWait) -> Result<()> {
        match self.sink {
            Sink::New(_) | Sink::Pipe(..) => Ok(()),
            Sink::Encoder(encoder) => encoder.end(),
            Sink::File(mut file) => {
                if self.format == Format::Apng {
                    let (tail, (at, patch)) = self.apng.end();
                    file.add(&tail, patience)?;
                    file.patch(at, &patch)?;
                }
                file.settle(patience)
            }
        }
    }

    pub(super) fn path(&self) -> String {
        match &self.sink {
            Sink::New(path) => path.display().to_string(),
            Sink::File(file) => file.path().display().to_string(),
            Sink::Encoder(encoder) => encoder.path().display().to_string(),
            Sink::Pipe(_, name) => name.clone(),
        }
    }

    pub(super) fn fail(name: &str, e: &std::io::Error) -> Fail {
        if e.kind() == ErrorKind::BrokenPipe {
            return Fail::failed(format!("{name}: whoever read the frames has gone away"));
        }
        Fail::io(Path::new(name), "writing", e)
    }
}
