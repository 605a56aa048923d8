//! Provenance of a picture, as JSON inside its file: all that `slabcast rerender` needs beside the
//! volume.
//!
//! Nothing in it says who, where or when: a picture of a patient that is passed on tells the
//! volume's digest and no name, and the same picture made elsewhere has the same bytes.

use super::{Format, Frame, exr, jpg, png, tif};
use crate::fail::Fail;
use crate::figure::Figure;
use crate::request::RenderRequest;
use crate::transfer::Transfer;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use slabcast_common::PIXELS_VERSION;
use slabcast_common::image::Background;
use slabcast_common::level::{LevelChoice, MAX_LEVEL};
use slabcast_common::quality::Quality;
use slabcast_common::stats::FrameStats;
use slabcast_common::transfer::TransferFunction;
use slabcast_common::view::MAX_EDGE;
use slabcast_common::volume::{Digest32, VolumeInfo};
use slabcast_scene::path::{Fit, Framing, Orientation, ViewPath};
use slabcast_scene::request::PathRequest;
use slabcast_scene::tween::Tween;
use std::path::Path;

/// Largest picture that is read: one of 8192x8192 in floats that do not compress.
const MAX_BYTES: u64 = 2 << 30;

/// Everything that decides a picture's bytes, as the picture's file records it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// Format version, 1.
    version: u32,
    /// Version of the program that made the picture.
    pub slabcast: String,
    /// Version of the pixels that the program drew (`PIXELS_VERSION`).
    pub pixels_version: u32,
    /// SHA-256 digest of the volume, in hexadecimal.
    pub volume_sha256: String,
    /// The view, or the whole path of a moving picture.
    pub path: ViewPath,
    /// Name of the preset that the transfer function came from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub preset: Option<String>,
    /// Transfer function of the picture, a preset already fitted to the volume.
    pub transfer: TransferFunction,
    /// Quality of the picture, with the number type of sums that was used.
    pub quality: Quality,
    /// Level of detail that was drawn; 0 = all detail.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub level: u32,
    /// Factor by which the picture's width and height were enlarged after it was drawn; 1 = not at
    /// all.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub magnify: u32,
    background: Ground,
    /// Marks drawn over the picture, and its dots an inch.
    #[serde(default, skip_serializing_if = "Figure::is_empty")]
    pub figure: Figure,
    /// File format of the picture.
    pub format: Format,
    /// Frames a second of a moving picture.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fps: Option<u16>,
    /// Hash of the view and all else that decides the pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    view_sha256: Option<String>,
    /// Hash of the linear picture. Early versions recorded it; a picture that has one is hashed
    /// when it is made again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pixels_sha256: Option<String>,
    /// Hash of the pixels in the file, as bytes of the format that a master sends for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub picture_sha256: Option<String>,
}

fn is_zero(n: &u32) -> bool {
    *n == 0
}

fn one() -> u32 {
    1
}

fn is_one(n: &u32) -> bool {
    *n == 1
}

/// `"transparent"`, or sRGB numbers from 0 to 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
enum Ground {
    Word(String),
    Colour([f64; 3]),
}

impl Provenance {
    /// Returns the request that makes the picture again.
    pub fn request(&self) -> RenderRequest {
        let hash_inside = self.pixels_sha256.is_some();
        let transfer = Transfer::from_function(&self.transfer, self.preset.clone());
        let mut request = RenderRequest::with_defaults(self.path.clone(), transfer);
        request.quality = self.quality;
        request.level = LevelChoice::At(self.level);
        request.magnify = self.magnify;
        request.background = self.background();
        request.hashed = hash_inside;
        request.hash_inside = hash_inside;
        request
    }

    /// Returns the background that the volume is composited over.
    pub fn background(&self) -> Background {
        match self.background {
            Ground::Word(_) => Background::Transparent,
            Ground::Colour(c) => Background::Colour(c),
        }
    }

    /// Returns the provenance as JSON for the file of a picture, still or moving. `frame` gives its
    /// hash.
    pub(super) fn written(mut self, frame: &Frame) -> String {
        // Only for a single frame without a hash of its linear pixels.
        if self.view_sha256.is_some() && self.pixels_sha256.is_none() {
            self.picture_sha256 = Some(Digest32(Sha256::digest(&frame.bytes).into()).to_string());
        }
        serde_json::to_string(&self).expect("numbers and strings can be written")
    }

    /// Returns whether two pictures record the same pixels.
    pub fn same_pixels(&self, other: &Provenance) -> bool {
        let hashes = |p: &Provenance| (p.pixels_sha256.clone(), p.picture_sha256.clone());
        hashes(self) == hashes(other)
    }

    /// Returns the provenance in the bytes of a picture; `path` is for messages.
    ///
    /// # Errors
    /// The picture has none, is damaged, or is of another version.
    pub fn read(path: &Path, bytes: &[u8]) -> Result<Provenance, Fail> {
        let file = path.display();
        let text = if bytes.starts_with(b"\x89PNG") {
            png::provenance(bytes)
        } else if bytes.starts_with(b"\x76\x2f\x31\x01") {
            exr::provenance(bytes)
        } else if bytes.starts_with(b"\xff\xd8") {
            jpg::provenance(bytes)
        } else if bytes.starts_with(b"II*\0") || bytes.starts_with(b"MM\0*") {
            tif::provenance(bytes)
        } else {
            return Err(Fail::failed(format!(
                "{file}: is neither a PNG nor an EXR, TIFF or JPEG; videos and GIFs do not say what \
                 made them"
            )));
        };
        let text = text
            .map_err(|e| Fail::failed(format!("{file}: {e}; the file is damaged")))?
            .ok_or_else(|| {
                Fail::failed(format!(
                    "{file}: does not say what made it; only pictures as slabcast wrote them do \
                     (many programs drop that when they save)"
                ))
            })?;
        let p: Provenance = serde_json::from_str(&text)
            .map_err(|e| Fail::failed(format!("{file}: what made it is not understood: {e}")))?;
        if p.version != 1 {
            return Err(Fail::failed(format!(
                "{file}: says what made it in version {}; this slabcast knows version 1: take the \
                 one that made it, {}",
                p.version, p.slabcast
            )));
        }
        if p.pixels_version != PIXELS_VERSION {
            return Err(Fail::failed(format!(
                "{file}: has pixels of version {}, this slabcast draws those of {PIXELS_VERSION}; \
                 take the one that made it, slabcast {}",
                p.pixels_version, p.slabcast
            )));
        }
        let refused = |e| Fail::field(path, "what made it", &e);
        p.path.check().map_err(refused)?;
        p.transfer.check().map_err(refused)?;
        p.quality.check().map_err(refused)?;
        p.figure.check(p.format == Format::Exr, p.format.has_provenance())?;
        if p.level > MAX_LEVEL {
            return Err(Fail::failed(format!(
                "{file}: level: {} is no level of detail; the file is damaged",
                p.level
            )));
        }
        let fits = |edge: u32| edge.checked_mul(p.magnify).is_some_and(|n| n <= MAX_EDGE);
        if p.magnify == 0 || !p.path.size.into_iter().all(fits) {
            return Err(Fail::failed(format!(
                "{file}: magnify: {} times {}x{} is not a size of a picture; the file is damaged",
                p.magnify, p.path.size[0], p.path.size[1]
            )));
        }
        Ok(p)
    }
}

/// Reads the bytes of a picture's file.
///
/// # Errors
/// The file can't be read or is larger than any picture.
pub fn read(path: &Path) -> Result<Vec<u8>, Fail> {
    let fail = |e: std::io::Error| Fail::io(path, "reading", &e);
    let meta = std::fs::metadata(path).map_err(fail)?;
    if meta.is_dir() {
        return Err(Fail::failed(format!("{}: is a folder; give a picture", path.display())));
    }
    if meta.len() > MAX_BYTES {
        return Err(Fail::failed(format!(
            "{}: has {} bytes, more than any picture of ours",
            path.display(),
            meta.len()
        )));
    }
    std::fs::read(path).map_err(fail)
}

/// Makes the provenance of each frame of a run.
#[derive(Clone)]
pub struct RunProvenance {
    base: Provenance,
    /// With the hash of the linear picture instead of the file's own.
    hash_inside: bool,
}

impl RunProvenance {
    /// Returns the provenance of a run on the volume that `info` describes.
    ///
    /// # Errors
    /// The transfer function doesn't fit the volume.
    pub fn new(
        request: &RenderRequest,
        info: &VolumeInfo,
        orientation: Orientation,
        (format, fps): (Format, Option<u16>),
        figure: &Figure,
    ) -> Result<RunProvenance, Fail> {
        // A field that is new must be thought about here: does it decide pixels?
        let PathRequest {
            client_key: _,
            volume: _,
            // Statistics say which it became.
            level: _,
            path,
            transfer: _,
            quality,
            work: _,
            format: _,
            background,
            want_trace: _,
            want_hash: _,
        } = request.to_message(info, format.pixels(request.background), false);
        let mut path = path;
        if let Some(t) = &mut path.turntable {
            // Another machine may have been told of other axes.
            let front =
                (t.up.is_none() || t.up == Some(orientation.up)).then_some(orientation.front);
            t.front = t.front.or(front);
            t.up = t.up.or(Some(orientation.up));
        }
        if let Some(k) = &mut path.keyframes {
            let front =
                (k.up.is_none() || k.up == Some(orientation.up)).then_some(orientation.front);
            k.front = k.front.or(front);
            k.up = k.up.or(Some(orientation.up));
            // Presets may get better; the picture stays.
            Tween::resolve_presets(k, &info.summary).map_err(|e| request.blame(&e))?;
        }
        if let Some(f) = &mut path.flythrough {
            f.up = f.up.or(Some(orientation.up.vector().to_array()));
        }
        Ok(RunProvenance {
            base: Provenance {
                version: 1,
                slabcast: env!("CARGO_PKG_VERSION").into(),
                pixels_version: PIXELS_VERSION,
                volume_sha256: info.digest.to_string(),
                path,
                preset: request.transfer.preset().map(String::from),
                transfer: request.transfer.function(info).map_err(|e| request.blame(&e))?,
                // Culling changes no byte.
                quality: Quality { cull: true, ..quality },
                level: 0,
                magnify: request.magnify,
                background: match background {
                    Background::Transparent => Ground::Word("transparent".into()),
                    Background::Colour(c) => Ground::Colour(c),
                },
                figure: figure.clone(),
                format,
                fps,
                view_sha256: None,
                pixels_sha256: None,
                picture_sha256: None,
            },
            hash_inside: request.hash_inside,
        })
    }

    /// Returns the provenance of a path that the master gave `framing`: the picture records the
    /// numbers, not how they were found.
    #[must_use]
    pub fn framed(mut self, framing: Option<&Framing>) -> RunProvenance {
        if let Some(framing) = framing {
            self.base.path = self.base.path.framed(framing);
        }
        // Nothing was there to be fitted to, or all was given.
        self.base.path.fit = Fit::Volume;
        self
    }

    /// Returns the path with the numbers of its framing.
    pub fn path(&self) -> &ViewPath {
        &self.base.path
    }

    /// Returns the provenance of the single frame of these statistics.
    pub fn frame(&self, stats: &FrameStats) -> Provenance {
        let mut p = self.whole(stats);
        p.path = p.path.single_frame(stats.frame as usize);
        p.view_sha256 = Some(stats.view_sha256.clone());
        p.pixels_sha256 = self.hash_inside.then(|| stats.pixels_sha256.clone());
        p
    }

    /// Returns the provenance of all frames in one file, with level and sums as the master decided
    /// them.
    pub fn movie(&self, stats: &FrameStats) -> Provenance {
        self.whole(stats)
    }

    /// The level is the same in all frames of a path, and so are the sums.
    fn whole(&self, stats: &FrameStats) -> Provenance {
        let mut p = self.base.clone();
        p.quality.sums = stats.quality.sums;
        p.level = stats.level.map_or(0, |level| level.level);
        p
    }
}
