//! Messages of the socket from the client, as docs/reference/live.md has them.

use serde::Deserialize;
use slabcast_common::image::Background;
use slabcast_scene::document::{DocumentQuality, background, black};
use slabcast_scene::path::{Axis, Crop, Key};
use slabcast_scene::transfer::TransferChoice;

/// Longest message in bytes.
pub(crate) const LONGEST: usize = 64 << 10;

/// The part of each message that says what it is.
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

/// `view`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub(crate) struct View {
    pub(crate) seq: u32,
    pub(crate) camera: Key,
    pub(crate) size: [u32; 2],
    #[serde(default)]
    pub(crate) moving: bool,
}

/// `scene`. What is left out has its default.
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

/// `hello`.
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

/// `open`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Open {
    pub(crate) volume: String,
    #[serde(default)]
    pub(crate) scene: Option<Scene>,
    #[serde(default)]
    pub(crate) view: Option<View>,
}

/// `ack`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Ack {
    pub(crate) seq: u32,
    pub(crate) scene: u32,
    pub(crate) pass: String,
}

/// `fit`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct FitAsk {
    pub(crate) id: u64,
    pub(crate) camera: Key,
}

/// `pick`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct PickAsk {
    pub(crate) id: u64,
    pub(crate) x: u32,
    pub(crate) y: u32,
}

/// `thumbs`.
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

/// `watch`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct WatchAsk {
    pub(crate) of: Vec<String>,
}

/// `jobs_page`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct JobsPage {
    pub(crate) before: String,
    pub(crate) count: usize,
}

/// `cancel_job`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct CancelJob {
    pub(crate) id: u64,
    pub(crate) job: String,
}

/// `remove_volume`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct RemoveVolume {
    pub(crate) id: u64,
    pub(crate) volume: String,
}

/// `ping`.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Ping {
    pub(crate) t: serde_json::Number,
}
