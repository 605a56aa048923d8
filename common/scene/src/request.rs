//! A job as a client submits it.

use crate::path::ViewPath;
use crate::transfer::TransferChoice;
use slabcast_common::image::{Background, PixelEncoding, PixelFormat};
use slabcast_common::quality::{Quality, Work};

/// A job as a client submits it.
#[derive(Clone, Debug, PartialEq)]
pub struct PathRequest {
    /// The client's own name for the request; the same key gives the same job.
    pub client_key: String,
    /// Views of the job, one for each frame.
    pub path: ViewPath,
    /// Colours and opacities of the volume: a preset or a whole transfer function.
    pub transfer: TransferChoice,
    /// Quality of the pictures: all that changes pixels beside volume, views and colours.
    pub quality: Quality,
    /// How the work is cut and scheduled.
    pub work: Work,
    /// Format in which pixels leave the master.
    pub format: PixelFormat,
    /// Background that the volume is composited over.
    pub background: Background,
    /// Whether each frame's statistics come with spans for a trace.
    pub want_trace: bool,
    /// Whether each frame's statistics have the hash of its linear picture. Without it tiles travel
    /// encoded, which takes fewer bytes.
    pub want_hash: bool,
}

impl PathRequest {
    /// Returns the encoding of the job's frames.
    pub fn encoding(&self) -> PixelEncoding {
        PixelEncoding { format: self.format, background: self.background }
    }
}
