//! From flags and files to a request: views, colours, quality, work.
//!
//! Names are those of the contracts (docs/design/contracts.md). What can be refused without the
//! volume is refused before anything is read or dialled ([`SceneArgs::request`]); what needs the
//! lattice is refused by [`RenderRequest::fit`], which names the flag, or the file and its field.

mod flags;
mod keep;

pub use flags::{
    AxisArgs, OpenedVolume, PictureArgs, QualityArgs, SceneArgs, ThreadArgs, UsualTurn, ViewArgs,
    VolumeSceneArgs, WorkArgs,
};
pub use keep::KeepArgs;

use crate::fail::Fail;
use crate::quality_target::QualityTarget;
use crate::transfer::Transfer;
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{InvalidField, Quality, Work};
use slabcast_common::view::View;
use slabcast_common::volume::VolumeInfo;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::path::{Orientation, ViewPath};
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::tween::Tween;
use std::path::PathBuf;

/// A request as the command line or a picture gives it, before its volume is known.
#[derive(Clone, Debug)]
pub struct RenderRequest {
    /// Views and size, the range of frames applied.
    pub path: ViewPath,
    /// File that the path was read from; `None` if flags made the path.
    pub path_file: Option<PathBuf>,
    /// Axes that were given, if a side of the body was asked for.
    side: Option<AxisArgs>,
    /// Colours and opacities that the user chose: a preset, a map or a file.
    pub transfer: Transfer,
    /// Quality of the pictures: all that changes pixels beside volume, views and colours.
    pub quality: Quality,
    /// Level of detail of the pictures.
    pub level: LevelChoice,
    /// Whether a flag asks for classification after reconstruction, and not the default.
    asks_after: bool,
    /// Error or time that the quality is to be chosen by; empty if the user gave none.
    pub target: QualityTarget,
    /// Factor by which the width and height of drawn pictures are enlarged; 1 = not at all.
    /// Pictures are drawn at the path's size.
    pub magnify: u32,
    /// Schedule and division of the work; never changes a pixel.
    pub work: Work,
    /// Background that the volume is composited over.
    pub background: Background,
    /// Whether statistics carry the hash of the linear picture.
    pub hashed: bool,
    /// Whether pictures carry the hash of the linear picture, as those of early versions did.
    pub hash_inside: bool,
}

impl RenderRequest {
    /// Returns a request for a path under a preset; everything else has its default.
    ///
    /// # Errors
    /// No preset or colour map has that name.
    pub fn for_preset(path: ViewPath, tf: &str) -> Result<Self, Fail> {
        Ok(RenderRequest::with_defaults(path, Transfer::from_name(tf)?))
    }

    /// Returns the request for all detail that there is.
    #[must_use]
    pub fn in_all_detail(&self) -> RenderRequest {
        RenderRequest { level: LevelChoice::default(), ..self.clone() }
    }

    /// Returns the size of the pictures in pixels, magnified.
    pub fn size(&self) -> [u32; 2] {
        self.path.size.map(|n| n * self.magnify)
    }

    /// Returns the numbers of the request's frames on the whole path.
    pub fn frames(&self) -> std::ops::Range<u64> {
        let first = self.path.first_frame() as u64;
        first..first + self.path.frames() as u64
    }

    /// Returns a request for a path under a transfer function; everything else has its default.
    pub fn with_defaults(path: ViewPath, transfer: Transfer) -> Self {
        RenderRequest {
            path,
            path_file: None,
            side: None,
            transfer,
            quality: Quality::default(),
            level: LevelChoice::default(),
            asks_after: false,
            target: QualityTarget::default(),
            magnify: 1,
            work: Work::default(),
            background: Background::Colour([0.0; 3]),
            hashed: true,
            hash_inside: false,
        }
    }

    /// Checks that all of it can be drawn of this volume; `anatomical` says whether the volume's
    /// file has anatomical axes. Voxels with colours of their own take the order of classification
    /// that they need ([`Quality::for_volume`]).
    ///
    /// # Errors
    /// A flag or a field of a file doesn't fit the volume; the error names it.
    pub fn fit(
        &mut self,
        info: &VolumeInfo,
        orientation: Orientation,
        anatomical: bool,
    ) -> Result<(), Fail> {
        if info.summary.palette.is_some() {
            if self.asks_after {
                return Err(Fail::usage(
                    "--classify: the voxels have colours of their own, between which nothing can be \
                     reconstructed; leave it out, or take one of their numbers with --channel",
                ));
            }
            self.quality = self.quality.for_volume(&info.summary);
            self.quality.check().map_err(|e| self.blame(&e))?;
        }
        if let Some(axes) = &self.side {
            let usual = Orientation::for_volume(None, None, &info.summary, anatomical)
                .map_err(|e| Fail::flag(&e))?;
            let given = axes.up.is_some() || axes.front.is_some();
            if anatomical && orientation != usual {
                return Err(Fail::usage(
                    "--view: the volume itself says where anterior and superior are; leave --up and \
                     --front out",
                ));
            }
            if !anatomical && !given && orientation == usual {
                return Err(Fail::usage(
                    "--view: the volume does not say where anterior is; give --up and --front for \
                     superior and anterior, or --azimuth instead",
                ));
            }
        }
        let function = self.transfer.function(info).map_err(|e| self.blame(&e))?;
        let blame = |e| self.blame(&e);
        let tween = Tween::from_path(&self.path, &info.summary).map_err(blame)?;
        BrickNeeds::for_path(&self.path, &function, tween.as_ref(), info, &self.quality)
            .map_err(blame)?;
        let cameras = self.path.prepare(&info.lattice, orientation).map_err(blame)?;
        for i in 0..self.path.frames() {
            let camera = cameras.camera(i).map_err(blame)?;
            View::new(&info.lattice, &camera, self.path.size, &self.quality).map_err(|mut e| {
                if let Some(fail) = self.stretched(&e, info) {
                    return fail;
                }
                // A view speaks of itself; a path has many.
                let n = self.path.first_frame() + i;
                if e.field != "size" && self.path_file.is_some() {
                    if !self.path.views.is_empty() {
                        e.field = format!("views[{n}].{}", e.field);
                    } else if self.path.keyframes.is_some() {
                        e.field = format!("keyframes, frame {n}: {}", e.field);
                    } else if self.path.flythrough.is_some() {
                        e.field = format!("flythrough, frame {n}: {}", e.field);
                    }
                }
                self.blame(&e)
            })?;
        }
        Ok(())
    }

    /// Returns the refusal of a volume whose samples lie so unevenly that no camera fits it; `None`
    /// where a camera that the user gave is to blame.
    fn stretched(&self, refused: &InvalidField, info: &VolumeInfo) -> Option<Fail> {
        let spacing = info.lattice.spacing();
        let small = spacing.into_iter().fold(f64::INFINITY, f64::min);
        let large = spacing.into_iter().fold(0.0, f64::max);
        let given =
            self.path.turntable.is_none_or(|t| t.height.or(t.target.map(|_| 0.0)).is_some())
                && !self.path.wants_framing();
        if refused.field == "thickness" && large >= 10.0 * small {
            return Some(Fail::failed(format!(
                "spacing: samples are {small:e} apart along one axis and {large:e} along another, and \
                 sheets are as thin as the smaller: {}",
                refused.problem
            )));
        }
        if large < 1000.0 * small
            || given
            || !["target", "eye", "height"].contains(&&*refused.field)
        {
            return None;
        }
        Some(Fail::failed(format!(
            "spacing: samples are {small:e} apart along one axis and {large:e} along another, and \
             sheets are as thin as the smaller; correct the spacing, or resample the volume"
        )))
    }

    /// Returns a refusal that names where the user wrote what is refused: a flag, or a field of a
    /// file.
    pub fn blame(&self, refused: &InvalidField) -> Fail {
        const FLAGS: [&str; 26] = [
            "thickness",
            "eps",
            "kernel",
            "std",
            "radius",
            "classify",
            "compositing",
            "splat",
            "sums",
            "cull",
            "slabs",
            "tiles-per-thread",
            "tile",
            "schedule",
            "size",
            "background",
            "tf",
            "start",
            "step",
            "frames",
            "elevation",
            "height",
            "fit",
            "fov",
            "up",
            "front",
        ];
        // Fields of a transfer function's file.
        const TRANSFER: [&str; 8] = [
            "transfer function",
            "domain",
            "colors",
            "opacities",
            "color_space",
            "opacity_unit",
            "gradient_opacity",
            "shading",
        ];
        // A box names its axis.
        if refused.field.starts_with("crop") {
            return Fail::usage(format!("--crop: {}", refused.problem));
        }
        const OF_PATHS: [&str; 10] = [
            "range",
            "size",
            "start",
            "step",
            "frames",
            "elevation",
            "height",
            "fov",
            "up",
            "front",
        ];
        let inner = refused.field.rsplit('.').next().unwrap_or_default();
        let field = match inner {
            "tiles_per_worker" | "tiles-per-worker" => "tiles-per-thread",
            // A turntable's eye is as far as its height and field of view put it.
            "eye" | "target" if self.path.turntable.is_some() => "height",
            field => field,
        };
        if let Some(file) = &self.path_file
            && (["views", "keyframes", "flythrough"].iter().any(|w| refused.field.contains(w))
                || OF_PATHS.contains(&field))
        {
            return Fail::field(file, "view path", refused);
        }
        if TRANSFER.iter().any(|name| refused.field.starts_with(name))
            && let Some(file) = self.transfer.file()
        {
            return Fail::field(file, "transfer function", refused);
        }
        if FLAGS.contains(&field) {
            return Fail::flag(&InvalidField::new(field, &refused.problem));
        }
        Fail::usage(refused.to_string())
    }

    /// Returns the message to a master, with a new client key, for the volume `info` and no other.
    pub fn to_message(
        &self,
        info: &VolumeInfo,
        format: PixelFormat,
        want_trace: bool,
    ) -> PathRequest {
        PathRequest {
            client_key: client_key(),
            volume: VolumeChoice::Digest(info.digest),
            level: self.level,
            path: self.path.clone(),
            transfer: self.transfer.choice(info),
            quality: self.quality,
            work: self.work,
            format,
            background: self.background,
            want_trace,
            want_hash: self.hashed,
        }
    }
}

/// Returns a key that no other request of any client has, made of time, process and a counter.
pub fn client_key() -> String {
    use std::sync::atomic::{AtomicU64, Ordering};
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let now = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |d| d.as_nanos());
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    // The address of a local differs from process to process where ids repeat (containers).
    let here = std::ptr::from_ref(&count) as usize;
    format!("cli-{now:x}-{}-{here:x}-{count}", std::process::id())
}

#[cfg(test)]
mod tests;
