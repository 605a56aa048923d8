//! Messages from the client over the WebSocket; docs/reference/live.md has units and defaults.

use serde::Deserialize;
use slabcast_common::image::Background;
use slabcast_scene::document::{DocumentQuality, background, black};
use slabcast_scene::path::{Axis, Crop, Key};
use slabcast_scene::transfer::TransferChoice;

/// Longest message in bytes.
pub(crate) const LONGEST: usize = 64 << 10;

/// Fields that every message has or may have: its type and number.
#[derive(Deserialize)]
pub(crate) struct Head {
    #[serde(rename = "type")]
    pub(crate) kind: String,
    /// Number of a request, of a view or of a scene.
    #[serde(default)]
    id: Option<u64>,
    #[serde(default)]
    seq: Option<u64>,
    #[serde(default)]
    rev: Option<u64>,
}

impl Head {
    /// Returns the number that an answer names.
    pub(crate) fn id(&self) -> u64 {
        self.id.or(self.seq).or(self.rev).unwrap_or(0)
    }
}

/// Message `view`: camera, size and whether a hand moves it.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub(crate) struct View {
    pub(crate) seq: u32,
    pub(crate) camera: Key,
    pub(crate) size: [u32; 2],
    #[serde(default)]
    pub(crate) moving: bool,
}

/// Message `scene`: colours, crop, background and quality. Fields left out have their defaults.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub(crate) struct Scene {
    pub(crate) rev: u32,
    #[serde(default)]
    pub(crate) tf: Option<TransferChoice>,
    #[serde(default)]
    pub(crate) crop: Option<Crop>,
    #[serde(default = "black", deserialize_with = "background")]
    pub(crate) background: Background,
    #[serde(default)]
    pub(crate) quality: DocumentQuality,
    #[serde(default)]
    pub(crate) up: Option<Axis>,
    #[serde(default)]
    pub(crate) front: Option<Axis>,
    #[serde(default)]
    pub(crate) moving: bool,
}

impl Scene {
    /// Returns the scene of a master's own first picture.
    pub(crate) fn home(rev: u32) -> Scene {
        Scene {
            rev,
            tf: None,
            crop: None,
            background: black(),
            quality: DocumentQuality::default(),
            up: None,
            front: None,
            moving: false,
        }
    }
}

/// Message `hello`, the first of a session: versions, token, volume, size, codecs.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Hello {
    pub(crate) protocol: [u32; 2],
    #[serde(default)]
    pub(crate) token: Option<String>,
    #[serde(default)]
    pub(crate) volume: Option<String>,
    pub(crate) size: [u32; 2],
    #[serde(default)]
    pub(crate) codecs: Vec<String>,
    #[serde(default)]
    pub(crate) scene: Option<Scene>,
    #[serde(default)]
    pub(crate) view: Option<View>,
    #[serde(default)]
    pub(crate) watch: Vec<String>,
}

/// Message `open`: shows another volume.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Open {
    pub(crate) volume: String,
    #[serde(default)]
    pub(crate) scene: Option<Scene>,
    #[serde(default)]
    pub(crate) view: Option<View>,
}

/// Message `ack`: a pass was painted.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Ack {
    pub(crate) seq: u32,
    pub(crate) scene: u32,
    pub(crate) pass: String,
}

/// Message `fit`: asks for target and height that fill the picture.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct FitAsk {
    pub(crate) id: u64,
    pub(crate) camera: Key,
}

/// Message `pick`: asks which values made a pixel.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct PickAsk {
    pub(crate) id: u64,
    pub(crate) x: u32,
    pub(crate) y: u32,
}

/// Message `thumbs`: asks for thumbnails of presets or jobs.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Thumbs {
    pub(crate) id: u32,
    #[serde(default = "presets")]
    pub(crate) of: String,
    pub(crate) names: Vec<String>,
    pub(crate) size: u32,
    #[serde(default)]
    pub(crate) camera: Option<Key>,
}

fn presets() -> String {
    "presets".into()
}

/// Message `watch`: subscribes to jobs, workers or volumes.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct WatchAsk {
    pub(crate) of: Vec<String>,
}

/// Message `jobs_page`: asks for older jobs.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct JobsPage {
    pub(crate) before: String,
    pub(crate) count: usize,
}

/// Message `cancel_job`: cancels a job.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct CancelJob {
    pub(crate) id: u64,
    pub(crate) job: String,
}

/// Message `remove_volume`: removes a volume from the master.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct RemoveVolume {
    pub(crate) id: u64,
    pub(crate) volume: String,
}

/// Message `ping`: asks for a `pong`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Ping {
    pub(crate) t: serde_json::Number,
}
