//! Interface to the writer of files that people keep: pictures and movies. This crate draws frames; the
//! program that starts it brings the writer.

use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::volume::VolumeInfo;
use slabcast_master::jobs::FinishedFrame;
use slabcast_scene::document::SceneDocument;
use slabcast_scene::path::{Framing, Orientation};
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use tokio::sync::mpsc;

/// Description of a file to write: scene, format and number of frames.
#[derive(Clone, Debug)]
pub struct Recipe {
    /// Scene of the frames.
    pub document: SceneDocument,
    /// Volume that they show.
    pub info: VolumeInfo,
    /// Axes of the volume.
    pub orientation: Orientation,
    /// Target and height that the path was given, if it asked for them.
    pub framing: Option<Framing>,
    /// Format, in words of docs/reference/live.md.
    pub format: String,
    /// Frames a second of a moving picture.
    pub fps: Option<u16>,
    /// Number of frames.
    pub frames: u64,
}

/// A file that was written.
pub struct MadeFile {
    /// Path of the file.
    pub path: PathBuf,
    /// Name under which a browser saves it.
    pub name: String,
    /// MIME type.
    pub kind: &'static str,
    /// Removes the file when it is dropped.
    pub guard: Box<dyn Send + Sync>,
}

/// A file on its way.
pub type Making = Pin<Box<dyn Future<Output = Result<MadeFile, String>> + Send>>;

/// Writes files of frames.
pub trait Files: Send + Sync {
    /// Returns the formats of movies that can be written here.
    fn movies(&self) -> Vec<&'static str>;

    /// Returns the format of pixels that files of a format take; `None` if there is no such format.
    fn pixels(&self, format: &str, background: Background) -> Option<PixelFormat>;

    /// Writes a file of the frames that come. Runs within a tokio runtime; what is slow has threads of
    /// its own.
    fn make(&self, recipe: Recipe, frames: mpsc::Receiver<Arc<FinishedFrame>>) -> Making;
}
