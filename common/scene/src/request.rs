//! A job as a client submits it.

use crate::path::{Key, PathView, ViewPath};
use crate::transfer::TransferChoice;
use slabcast_common::image::{Background, PixelEncoding, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Quality, Work};
use slabcast_common::transfer::TransferFunction;
use slabcast_common::volume::Digest32;

/// Which volume of a master is meant.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum VolumeChoice {
    /// The volume that the master was started with, or its only one.
    #[default]
    Default,
    /// The volume of this name.
    Name(String),
    /// The volume with this digest, and never another.
    Digest(Digest32),
}

/// A job as a client submits it.
#[derive(Clone, Debug, PartialEq)]
pub struct PathRequest {
    /// The client's own name for the request; the same key gives the same job.
    pub client_key: String,
    /// Volume that is drawn.
    pub volume: VolumeChoice,
    /// Level of detail of all frames.
    pub level: LevelChoice,
    /// Views of the job, one for each frame.
    pub path: ViewPath,
    /// Colours and opacities of the volume: a preset or a whole transfer function.
    pub transfer: TransferChoice,
    /// Quality of the pictures: all that changes pixels beside volume, views and colours.
    pub quality: Quality,
    /// Schedule and division of the work.
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

    /// Returns the bytes that the request takes in memory: of views, keys, points and functions, in
    /// proportion to what was sent, and not to the number of frames.
    pub fn held_bytes(&self) -> usize {
        let keys = self.path.keyframes.iter().flat_map(|k| &k.keys);
        let of_keys = keys
            .map(|key| size_of::<Key>() + key.tf.as_ref().map_or(0, TransferChoice::held_bytes));
        let eyes = self.path.flythrough.as_ref().map_or(0, |f| f.eyes.len());
        let name = match &self.volume {
            VolumeChoice::Name(name) => name.len(),
            VolumeChoice::Default | VolumeChoice::Digest(_) => 0,
        };
        size_of::<PathRequest>()
            + self.client_key.len()
            + name
            + self.path.views.len() * size_of::<PathView>()
            + of_keys.sum::<usize>()
            + eyes * size_of::<[f64; 3]>()
            + self.transfer.held_bytes()
    }
}

/// Returns the bytes that a transfer function takes in memory.
pub fn function_bytes(tf: &TransferFunction) -> usize {
    size_of::<TransferFunction>()
        + tf.colors.len() * size_of::<[f64; 4]>()
        + (tf.opacities.len() + tf.gradient_opacity.len()) * size_of::<[f64; 2]>()
}
