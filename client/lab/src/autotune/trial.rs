//! Draws a scene at one setting after another, times it, and has the reference judge it.
//!
//! The truth is the requested picture in the limit of thin sheets, in all detail: with its kernel, its
//! light, at its size, of level 0 whatever level is drawn. A setting that changes the model (another kernel, no light) is judged by that truth
//! like any other, and also by the limit of its own model.

use super::setting::Setting;
use serde::{Deserialize, Serialize};
use slabcast_common::image::Picture;
use slabcast_common::message::{Counters, SceneSpec};
use slabcast_common::quality::{Compositing, Quality, Sums};
use slabcast_common::transfer::Classifier;
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_render::judge::reference::{ErrorFigures, Reference, stratified};
use slabcast_render::{Frame, Scene};
use slabcast_scene::path::Orientation;
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::Fail;
use slabcast_session::magnify::magnified;
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::progress::Progress;
use slabcast_session::request::RenderRequest;
use std::sync::Arc;
use std::time::Instant;

/// Least number of frames that are timed for a median, unless one takes longer than [`LONG_S`].
const FRAMES: usize = 3;
/// Seconds above which a frame is neither repeated for a median nor preceded by one that fills
/// tables, which take milliseconds.
const LONG_S: f64 = 1.0;
/// Largest number of frames that are timed.
const MOST_FRAMES: usize = 51;

/// The exact colours of one view at a sample of its pixels.
pub(crate) struct Truth {
    /// Index of the view on the path.
    pub(crate) view: usize,
    sample: Vec<[u32; 2]>,
    limit: Vec<[f64; 4]>,
}

/// Frame times in ms, from camera set to picture in memory.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Timing {
    /// Median time of a frame, in ms.
    pub(crate) median: f64,
    pub(crate) min: f64,
    pub(crate) max: f64,
    pub(crate) frames: u32,
}

impl Timing {
    /// Returns median, minimum and maximum of some frame times.
    ///
    /// # Panics
    /// If there are none.
    pub(crate) fn from_ms(mut ms: Vec<f64>) -> Timing {
        ms.sort_by(f64::total_cmp);
        let (min, max) = (ms[0], ms[ms.len() - 1]);
        Timing { median: ms[ms.len() / 2], min, max, frames: ms.len() as u32 }
    }
}

/// Errors of some pictures against the truth, in 1/255: the worst view for each figure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Deviation {
    pub(crate) rmse: f64,
    pub(crate) max: f64,
    pub(crate) most_999: f64,
    pub(crate) share_above_1: f64,
    pub(crate) rmse_srgb8: f64,
    /// Number of pixels that are not blank, in all views.
    pub(crate) pixels: usize,
}

impl Deviation {
    /// Returns the worse of each figure.
    pub(super) fn worst(self, f: &ErrorFigures) -> Deviation {
        Deviation {
            rmse: self.rmse.max(f.rmse),
            max: self.max.max(f.max),
            most_999: self.most_999.max(f.most_999),
            share_above_1: self.share_above_1.max(f.share_above_1),
            rmse_srgb8: self.rmse_srgb8.max(f.rmse_srgb8),
            pixels: self.pixels + f.n_pixels,
        }
    }
}

/// Errors of a setting over all judged views.
pub(crate) struct Judged {
    /// Arithmetic that the sheets were added in.
    pub(crate) sums: Sums,
    /// Error against the truth.
    pub(crate) deviation: Deviation,
    /// Error against the limit of its own model, if that is another one.
    pub(crate) own: Option<Deviation>,
    /// Voxel counts of the first judged view.
    pub(crate) counters: Counters,
    /// SHA-256 of the pixels of the first judged view.
    pub(crate) sha256: String,
}

/// Threads and duration of timing a setting.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Effort {
    pub(crate) cut: Cut,
    /// Seconds for which frames are timed, once there are [`FRAMES`].
    pub(crate) seconds: f64,
}

/// Kind of bricks that a setting is drawn from: with normals, by the paper's opacities.
type BrickKind = (bool, bool);

/// One volume and one path, drawn at many settings.
pub struct Trial {
    volume: Arc<Volume>,
    info: VolumeInfo,
    request: RenderRequest,
    orientation: Orientation,
    pub(crate) base: Setting,
    pub(crate) threads: usize,
    scenes_by_kind: Vec<(BrickKind, PathScenes)>,
    /// Scenes of level 0, if another level is drawn and they were needed.
    detailed: Option<PathScenes>,
}

impl Trial {
    /// Cuts the bricks of the request, which must fit `volume`.
    pub(crate) fn new(
        volume: impl Into<Arc<Volume>>,
        info: VolumeInfo,
        request: &RenderRequest,
        orientation: Orientation,
        threads: usize,
    ) -> Result<Trial, Fail> {
        let volume = volume.into();
        let scenes = PathScenes::new(&volume, &info, request, orientation)?;
        let base = Setting::asked(request.quality);
        let kind = brick_kind(&base);
        let request = request.clone();
        Ok(Trial {
            volume,
            info,
            request,
            orientation,
            base,
            threads,
            scenes_by_kind: vec![(kind, scenes)],
            detailed: None,
        })
    }

    /// Returns a text of everything that a setting's figures depend on, except the machine. The
    /// angles of a turntable are not in it: its figures serve any other turn of the scene.
    pub(crate) fn identity(&self) -> String {
        let scenes = &self.scenes_by_kind[0].1;
        let transfer = scenes.spec(0).transfer.to_json();
        let path = &self.request.path;
        let how = match &path.turntable {
            Some(t) => format!(
                "{:?} {:?} {} {} {:?} {:?} {:?}",
                t.projection, t.height, t.fov, t.elevation, path.size, path.crop, self.orientation
            ),
            None => serde_json::to_string(path).unwrap_or_default(),
        };
        format!(
            "volume {} level {} transfer {transfer} path {how} quality {:?} pixels {} slabcast {}",
            self.info.digest,
            scenes.level(),
            self.request.quality,
            slabcast_common::PIXELS_VERSION,
            env!("CARGO_PKG_VERSION")
        )
    }

    /// Returns the size of the pictures in pixels.
    pub(crate) fn size(&self) -> [u32; 2] {
        self.request.path.size
    }

    /// Returns the number of views.
    pub(crate) fn views(&self) -> usize {
        self.request.path.frames()
    }

    /// Returns whether the requested scene is shaded.
    pub(crate) fn is_shaded(&self) -> bool {
        self.scenes_by_kind[0].1.spec(0).transfer.shading.on
    }

    /// Returns the relevant voxels of a setting and the bytes of their bricks as sent.
    pub(crate) fn bricks(&mut self, setting: &Setting) -> Result<(u64, u64), Fail> {
        let bricks = &self.scenes(setting)?.bricks;
        let sum = |f: fn(&slabcast_common::brick::Brick) -> usize| {
            bricks.iter().map(|b| f(b) as u64).sum()
        };
        Ok((
            sum(slabcast_common::brick::Brick::len),
            sum(slabcast_common::brick::Brick::encoded_len),
        ))
    }

    /// Returns the scenes of a setting. Without light the bricks have no normals, and the paper's
    /// opacities may make other voxels relevant.
    fn scenes(&mut self, setting: &Setting) -> Result<&PathScenes, Fail> {
        let wanted = brick_kind(setting);
        let found = self.scenes_by_kind.iter().position(|(g, _)| *g == wanted);
        let place = match found {
            Some(place) => place,
            None => {
                let mut request = self.request.clone();
                if !setting.shaded {
                    request.transfer = request.transfer.unshaded();
                }
                request.quality.compositing = setting.quality.compositing;
                let scenes = PathScenes::new(&self.volume, &self.info, &request, self.orientation)?;
                self.scenes_by_kind.push((wanted, scenes));
                self.scenes_by_kind.len() - 1
            }
        };
        Ok(&self.scenes_by_kind[place].1)
    }

    /// Returns the scenes of level 0 at the setting that was asked for.
    fn detailed_scenes(&mut self, base: &Setting) -> Result<&PathScenes, Fail> {
        let own = self.info.level;
        if self.scenes(base)?.level() == own {
            return self.scenes(base);
        }
        let scenes = match self.detailed.take() {
            Some(scenes) => scenes,
            None => {
                let request = self.request.in_all_detail();
                PathScenes::new(&self.volume, &self.info, &request, self.orientation)?
            }
        };
        Ok(self.detailed.insert(scenes))
    }

    /// Returns the truth of view `view` at a stratified sample of `pixels` of its pixels.
    pub(crate) fn truth(
        &mut self,
        view: usize,
        pixels: usize,
        seed: u64,
        progress: (&mut Progress, usize),
    ) -> Result<Truth, Fail> {
        let (size, threads, base) = (self.size(), self.threads, self.base);
        let sample = stratified(size, pixels, seed);
        let scenes = self.detailed_scenes(&base)?;
        let spec = SceneSpec { quality: base.quality, ..scenes.spec(view) };
        let reference = Reference::new(&spec, scenes.view(view, &base.quality)?, &scenes.bricks);
        let limit = direct::map_pixels(&sample, threads, progress, |[x, y]| reference.pixel(x, y));
        Ok(Truth { view, sample, limit })
    }

    /// Returns the limit of a setting's own model, at the view and pixels of `truth`.
    pub(crate) fn own_truth(&mut self, setting: &Setting, truth: &Truth) -> Result<Truth, Fail> {
        let threads = self.threads;
        let scenes = self.scenes(setting)?;
        let quality = scenes.quality_of_level(setting.quality);
        let spec = SceneSpec { quality, ..scenes.spec(truth.view) };
        let view = scenes.view(truth.view, &quality)?;
        let reference = Reference::new(&spec, view, &scenes.bricks);
        let sample = truth.sample.clone();
        let limit = direct::map_parallel(sample.len(), threads, |i, _: &mut ()| {
            reference.pixel(sample[i][0], sample[i][1])
        });
        Ok(Truth { view: truth.view, sample, limit })
    }

    /// Draws a setting and compares it with `truths`, and with the limits `own` of its own model.
    pub(crate) fn judge(
        &mut self,
        setting: &Setting,
        truths: &[Truth],
        own: Option<&[Truth]>,
    ) -> Result<Judged, Fail> {
        let (threads, background) = (self.threads, self.request.background);
        let mut judged = Judged {
            sums: setting.quality.sums,
            deviation: Deviation::default(),
            own: own.map(|_| Deviation::default()),
            counters: Counters::default(),
            sha256: String::new(),
        };
        for (i, truth) in truths.iter().enumerate() {
            let prepared = self.prepare(setting, truth.view)?;
            let (picture, counters) =
                self.draw(setting, &prepared, truth.view, Cut::on(threads))?;
            if i == 0 {
                judged.sums = prepared.quality.sums;
                (judged.counters, judged.sha256) = (counters, picture.sha256().to_string());
            }
            let width = picture.size[0] as usize;
            let pixel = |p: &[u32; 2]| picture.pixels[p[1] as usize * width + p[0] as usize];
            let got: Vec<_> = truth.sample.iter().map(pixel).collect();
            let figures = |want: &Truth| ErrorFigures::compare(&got, &want.limit, background);
            judged.deviation = judged.deviation.worst(&figures(truth));
            judged.own = judged.own.zip(own).map(|(o, own)| o.worst(&figures(&own[i])));
        }
        Ok(judged)
    }

    /// Times frames at different views of the path. The first, which fills tables, does not count.
    pub(crate) fn time(&mut self, setting: &Setting, effort: Effort) -> Result<Timing, Fail> {
        let views = self.views();
        let mut prepared = self.prepare(setting, 0)?;
        // Far apart, so that few of them stand for all.
        let order: Vec<usize> = (0..views.max(MOST_FRAMES + 1))
            .map(|i| i % views)
            .map(|i| (i * 7 + views / 2) % views)
            .collect();
        let mut ms = Vec::new();
        let began = Instant::now();
        for (n, &i) in order.iter().enumerate().take(MOST_FRAMES + 1) {
            let passed = began.elapsed().as_secs_f64();
            let enough = passed > effort.seconds && ms.len() >= FRAMES;
            if enough || (passed > LONG_S && !ms.is_empty()) {
                break;
            }
            if self.scenes_by_kind[0].1.is_tween() {
                prepared = self.prepare(setting, i)?;
            }
            let start = Instant::now();
            let picture = self.draw(setting, &prepared, i, effort.cut)?;
            let took = start.elapsed().as_secs_f64() * 1e3;
            drop(picture);
            // The first fills tables and caches.
            if n > 0 || took > LONG_S * 1e3 {
                ms.push(took);
            }
        }
        Ok(Timing::from_ms(ms))
    }

    /// Returns the scene of a setting, with the arithmetic of its sums decided.
    fn prepare(&mut self, setting: &Setting, view: usize) -> Result<PreparedScene, Fail> {
        let quality = setting.quality;
        quality.check().map_err(|e| Fail::flag(&e))?;
        let scenes = self.scenes(setting)?;
        let (spec, quality) = (scenes.spec(view), scenes.quality_of_level(quality));
        let classifier = Classifier::new(&spec.transfer, &spec.volume, quality.compositing);
        let sums =
            classifier.choose_sums(&quality, &spec.volume.lattice).map_err(|e| Fail::flag(&e))?;
        let quality = Quality { sums, ..quality };
        Ok(PreparedScene { scene: Arc::new(Scene::new(&SceneSpec { quality, ..spec })), quality })
    }

    /// Draws one view, magnified to full size.
    fn draw(
        &mut self,
        setting: &Setting,
        prepared: &PreparedScene,
        view: usize,
        cut: Cut,
    ) -> Result<(Picture, Counters), Fail> {
        let size = self.size();
        let drawn = setting.drawn_size(size).unwrap_or(size);
        let scenes = self.scenes(setting)?;
        let view = scenes.view_at_size(view, &prepared.quality, drawn)?;
        let frame = Frame::new(prepared.scene.clone(), view);
        let (picture, counters) = direct::draw_counted(&frame, &scenes.bricks, cut);
        let factor = if drawn == size { 1 } else { setting.shrink };
        Ok((magnified(picture, factor, cut.threads), counters))
    }
}

/// A scene that is ready to be drawn at a setting.
struct PreparedScene {
    scene: Arc<Scene>,
    quality: Quality,
}

fn brick_kind(setting: &Setting) -> BrickKind {
    (setting.shaded, setting.quality.compositing == Compositing::Paper)
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_scene::path::{Turntable, ViewPath};

    fn trial(tf: &str) -> Trial {
        let volume = slabcast_session::volume::open("formula:spheres:32".as_ref()).unwrap();
        let path =
            ViewPath::from_turntable([64, 64], Turntable { frames: 3, ..Turntable::default() });
        let mut request = RenderRequest::for_preset(path, tf).unwrap();
        request.quality = Quality::before();
        let info = volume.info(volume.digest());
        Trial::new(volume, info, &request, Orientation::new(None, None).unwrap(), 2).unwrap()
    }

    #[test]
    fn finer_settings_have_smaller_errors() {
        let mut trial = trial("skin");
        let mut progress = Progress::new(true);
        let truth = [trial.truth(1, 512, 1, (&mut progress, 0)).unwrap()];
        let base = trial.base;
        let setting = |thickness, shrink| Setting {
            quality: Quality { thickness, eps: 0.0, ..base.quality },
            shrink,
            ..base
        };
        let mut deviation = |s: Setting| trial.judge(&s, &truth, None).unwrap().deviation;
        let (coarse, fine, small) =
            (deviation(setting(2.0, 1)), deviation(setting(0.5, 1)), deviation(setting(0.5, 2)));
        assert!(fine.rmse < 0.2 && fine.rmse < coarse.rmse / 4.0, "{fine:?} {coarse:?}");
        assert!(small.rmse > 10.0 * fine.rmse && small.rmse < 40.0, "{small:?}");
        assert!(fine.most_999 <= fine.max && fine.pixels > 100);
    }

    #[test]
    fn another_model_is_judged_by_its_own_limit_too() {
        let mut trial = trial("skin");
        let mut progress = Progress::new(true);
        let truth = [trial.truth(0, 256, 1, (&mut progress, 0)).unwrap()];
        let setting = Setting { shaded: false, ..trial.base };
        assert!(!setting.same_model(&trial.base) && trial.is_shaded());
        let own = [trial.own_truth(&setting, &truth[0]).unwrap()];
        let judged = trial.judge(&setting, &truth, Some(&own)).unwrap();
        let own = judged.own.unwrap();
        assert!(own.rmse < 1.0 && judged.deviation.rmse > 5.0, "{own:?} {:?}", judged.deviation);
        let (base, bare) = (trial.base, setting);
        let ((n, bytes), (m, fewer)) = (trial.bricks(&base).unwrap(), trial.bricks(&bare).unwrap());
        assert!(n == m && fewer < bytes, "no normals: {fewer} of {bytes}");
    }

    #[test]
    fn times_are_positive_and_ordered() {
        let mut trial = trial("fog");
        let effort = Effort { cut: Cut::on(1), seconds: 0.0 };
        let base = trial.base;
        let t = trial.time(&base, effort).unwrap();
        assert_eq!(t.frames, FRAMES as u32);
        assert!(t.min > 0.0 && t.min <= t.median && t.median <= t.max);
    }
}
