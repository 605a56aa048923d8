//! Draws a scene in one setting after another, times it, and has the reference judge it.
//!
//! The truth is what was asked for in the limit of thin sheets: with its kernel, its light, at its
//! size. A setting that changes the model (another kernel, no light) is judged by that truth like
//! any other, and beside it by its own.

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

/// Frames that are timed at least, unless they take long. The median of two is none.
const FRAMES: usize = 3;
/// A frame that takes so long is not repeated for its median, nor is one drawn before it to fill
/// tables, which take milliseconds.
const LONG: f64 = 1.0;
/// Frames that are timed at most.
const MOST_FRAMES: usize = 51;

/// What one view should look like, at a sample of its pixels.
pub struct Truth {
    /// Number of the view among those that are wanted.
    pub(crate) view: usize,
    sample: Vec<[u32; 2]>,
    limit: Vec<[f64; 4]>,
}

/// Milliseconds from camera set to picture in memory.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// Median time of a frame, in ms.
    pub(crate) median: f64,
    pub(crate) min: f64,
    pub(crate) max: f64,
    pub(crate) frames: u32,
}

impl Timing {
    /// Of some frames.
    ///
    /// # Panics
    /// If there are none.
    pub(crate) fn of(mut ms: Vec<f64>) -> Timing {
        ms.sort_by(f64::total_cmp);
        let (min, max) = (ms[0], ms[ms.len() - 1]);
        Timing { median: ms[ms.len() / 2], min, max, frames: ms.len() as u32 }
    }
}

/// How far some pictures are from the truth: the worst view of each figure, in 1/255.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Deviation {
    pub(crate) rmse: f64,
    pub(crate) max: f64,
    pub(crate) most_999: f64,
    pub(crate) share_above_1: f64,
    pub(crate) rmse_srgb8: f64,
    /// Pixels that are not blank, in all.
    pub(crate) pixels: usize,
}

impl Deviation {
    /// The worse of each figure.
    pub(super) fn with(self, f: &ErrorFigures) -> Deviation {
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

/// A setting's picture of each judged view.
pub struct Judged {
    /// What sheets added in.
    pub(crate) sums: Sums,
    /// Against the truth.
    pub(crate) off: Deviation,
    /// Against its own limit, where its model is another.
    pub(crate) own: Option<Deviation>,
    /// Voxels of the first judged view.
    pub(crate) counters: Counters,
    /// Of the first judged view.
    pub(crate) sha256: String,
}

/// How its time is measured.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    pub(crate) cut: Cut,
    /// As many frames as fit, after the least.
    pub(crate) seconds: f64,
}

/// What bricks a setting is drawn from.
type Ground = (bool, bool);

/// One volume and path, to be drawn in many ways.
pub struct Trial {
    volume: Arc<Volume>,
    info: VolumeInfo,
    request: RenderRequest,
    orientation: Orientation,
    pub(crate) base: Setting,
    pub(crate) threads: usize,
    grounds: Vec<(Ground, PathScenes)>,
}

impl Trial {
    /// Cuts the bricks of what was asked for; `volume` fits it.
    pub(crate) fn new(
        volume: impl Into<Arc<Volume>>,
        info: VolumeInfo,
        request: &RenderRequest,
        orientation: Orientation,
        threads: usize,
    ) -> Result<Trial, Fail> {
        let volume = volume.into();
        let stage = PathScenes::new(&volume, &info, request, orientation)?;
        let base = Setting::asked(request.quality);
        let ground = ground(&base);
        let request = request.clone();
        Ok(Trial {
            volume,
            info,
            request,
            orientation,
            base,
            threads,
            grounds: vec![(ground, stage)],
        })
    }

    /// All that the figures of a setting hang on but the machine. Where on its path a view of a turn
    /// lies is not in it: a turn's figures serve any other of the same scene.
    pub(crate) fn identity(&self) -> String {
        let stage = &self.grounds[0].1;
        let transfer = stage.spec(0).transfer.to_json();
        let path = &self.request.path;
        let how = match &path.turntable {
            Some(t) => format!(
                "{:?} {:?} {} {} {:?} {:?} {:?}",
                t.projection, t.height, t.fov, t.elevation, path.size, path.crop, self.orientation
            ),
            None => serde_json::to_string(path).unwrap_or_default(),
        };
        format!(
            "volume {} transfer {transfer} path {how} quality {:?} pixels {} slabcast {}",
            self.info.digest,
            self.request.quality,
            slabcast_common::PIXELS_VERSION,
            env!("CARGO_PKG_VERSION")
        )
    }

    /// Size of the pictures.
    pub(crate) fn size(&self) -> [u32; 2] {
        self.request.path.size
    }

    /// Number of views.
    pub(crate) fn views(&self) -> usize {
        self.request.path.frames()
    }

    /// Whether light falls on voxels in what was asked for.
    pub(crate) fn is_shaded(&self) -> bool {
        self.grounds[0].1.spec(0).transfer.shading.on
    }

    /// Relevant voxels, and bytes of their bricks as they are sent, of a setting.
    pub(crate) fn bricks(&mut self, setting: &Setting) -> Result<(u64, u64), Fail> {
        let bricks = &self.stage(setting)?.bricks;
        let of = |f: fn(&slabcast_common::brick::Brick) -> usize| {
            bricks.iter().map(|b| f(b) as u64).sum()
        };
        Ok((of(slabcast_common::brick::Brick::len), of(slabcast_common::brick::Brick::encoded_len)))
    }

    /// The stage of a setting. Without light no normals are cut, and the paper's opacities may
    /// make other voxels relevant.
    fn stage(&mut self, setting: &Setting) -> Result<&PathScenes, Fail> {
        let wanted = ground(setting);
        let found = self.grounds.iter().position(|(g, _)| *g == wanted);
        let place = match found {
            Some(place) => place,
            None => {
                let mut request = self.request.clone();
                if !setting.shaded {
                    request.transfer = request.transfer.unshaded();
                }
                request.quality.compositing = setting.quality.compositing;
                let stage = PathScenes::new(&self.volume, &self.info, &request, self.orientation)?;
                self.grounds.push((wanted, stage));
                self.grounds.len() - 1
            }
        };
        Ok(&self.grounds[place].1)
    }

    /// What view `view` should look like, at `pixels` of its pixels.
    pub(crate) fn truth(
        &mut self,
        view: usize,
        pixels: usize,
        seed: u64,
        progress: (&mut Progress, usize),
    ) -> Result<Truth, Fail> {
        let (size, threads, base) = (self.size(), self.threads, self.base);
        let sample = stratified(size, pixels, seed);
        let stage = self.stage(&base)?;
        let spec = SceneSpec { quality: base.quality, ..stage.spec(view) };
        let reference = Reference::new(&spec, stage.view(view, &base.quality)?, &stage.bricks);
        let limit = direct::map_pixels(&sample, threads, progress, |[x, y]| reference.pixel(x, y));
        Ok(Truth { view, sample, limit })
    }

    /// The same of a setting's own limit.
    pub(crate) fn own_truth(&mut self, setting: &Setting, of: &Truth) -> Result<Truth, Fail> {
        let threads = self.threads;
        let stage = self.stage(setting)?;
        let spec = SceneSpec { quality: setting.quality, ..stage.spec(of.view) };
        let view = stage.view(of.view, &setting.quality)?;
        let reference = Reference::new(&spec, view, &stage.bricks);
        let sample = of.sample.clone();
        let limit = direct::map_parallel(sample.len(), threads, |i, _: &mut ()| {
            reference.pixel(sample[i][0], sample[i][1])
        });
        Ok(Truth { view: of.view, sample, limit })
    }

    /// Draws a setting and compares it with what it should be; `own` are its own limits.
    pub(crate) fn judge(
        &mut self,
        setting: &Setting,
        truths: &[Truth],
        own: Option<&[Truth]>,
    ) -> Result<Judged, Fail> {
        let (threads, background) = (self.threads, self.request.background);
        let mut judged = Judged {
            sums: setting.quality.sums,
            off: Deviation::default(),
            own: own.map(|_| Deviation::default()),
            counters: Counters::default(),
            sha256: String::new(),
        };
        for (i, truth) in truths.iter().enumerate() {
            let way = self.way(setting, truth.view)?;
            let (picture, counters) = self.draw(setting, &way, truth.view, Cut::on(threads))?;
            if i == 0 {
                judged.sums = way.quality.sums;
                (judged.counters, judged.sha256) = (counters, picture.sha256().to_string());
            }
            let width = picture.size[0] as usize;
            let at = |p: &[u32; 2]| picture.pixels[p[1] as usize * width + p[0] as usize];
            let got: Vec<_> = truth.sample.iter().map(at).collect();
            let figures = |want: &Truth| ErrorFigures::compare(&got, &want.limit, background);
            judged.off = judged.off.with(&figures(truth));
            judged.own = judged.own.zip(own).map(|(o, own)| o.with(&figures(&own[i])));
        }
        Ok(judged)
    }

    /// Times frames of different views of the path, none of them the first that is drawn.
    pub(crate) fn time(&mut self, setting: &Setting, effort: Effort) -> Result<Timing, Fail> {
        let views = self.views();
        let mut way = self.way(setting, 0)?;
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
            if enough || (passed > LONG && !ms.is_empty()) {
                break;
            }
            if self.grounds[0].1.is_tween() {
                way = self.way(setting, i)?;
            }
            let start = Instant::now();
            let picture = self.draw(setting, &way, i, effort.cut)?;
            let took = start.elapsed().as_secs_f64() * 1e3;
            drop(picture);
            // The first fills tables and caches.
            if n > 0 || took > LONG * 1e3 {
                ms.push(took);
            }
        }
        Ok(Timing::of(ms))
    }

    /// A scene at a setting, with its sums decided.
    fn way(&mut self, setting: &Setting, view: usize) -> Result<Way, Fail> {
        let quality = setting.quality;
        quality.check().map_err(|e| Fail::flag(&e))?;
        let info = self.info.clone();
        let spec = self.stage(setting)?.spec(view);
        let classifier = Classifier::new(&spec.transfer, &info, quality.compositing);
        let sums = classifier.choose_sums(&quality, &info.lattice).map_err(|e| Fail::flag(&e))?;
        let quality = Quality { sums, ..quality };
        Ok(Way { scene: Arc::new(Scene::new(&SceneSpec { quality, ..spec })), quality })
    }

    /// A picture of full size.
    fn draw(
        &mut self,
        setting: &Setting,
        way: &Way,
        view: usize,
        cut: Cut,
    ) -> Result<(Picture, Counters), Fail> {
        let size = self.size();
        let drawn = setting.drawn_size(size).unwrap_or(size);
        let stage = self.stage(setting)?;
        let view = stage.view_at_size(view, &way.quality, drawn)?;
        let frame = Frame::new(way.scene.clone(), view);
        let (picture, counters) = direct::draw_counted(&frame, &stage.bricks, cut);
        let factor = if drawn == size { 1 } else { setting.shrink };
        Ok((magnified(picture, factor, cut.threads), counters))
    }
}

/// A scene that is ready at a setting.
struct Way {
    scene: Arc<Scene>,
    quality: Quality,
}

fn ground(setting: &Setting) -> Ground {
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
        let request = RenderRequest::for_preset(path, tf).unwrap();
        let info = volume.info(volume.digest());
        Trial::new(volume, info, &request, Orientation::new(None, None).unwrap(), 2).unwrap()
    }

    #[test]
    fn finer_settings_are_nearer_to_the_truth() {
        let mut trial = trial("skin");
        let mut progress = Progress::new(true);
        let truth = [trial.truth(1, 512, 1, (&mut progress, 0)).unwrap()];
        let base = trial.base;
        let at = |thickness, shrink| Setting {
            quality: Quality { thickness, eps: 0.0, ..base.quality },
            shrink,
            ..base
        };
        let mut off = |s: Setting| trial.judge(&s, &truth, None).unwrap().off;
        let (coarse, fine, small) = (off(at(2.0, 1)), off(at(0.5, 1)), off(at(0.5, 2)));
        assert!(fine.rmse < 0.2 && fine.rmse < coarse.rmse / 4.0, "{fine:?} {coarse:?}");
        assert!(small.rmse > 10.0 * fine.rmse && small.rmse < 40.0, "{small:?}");
        assert!(fine.most_999 <= fine.max && fine.pixels > 100);
    }

    #[test]
    fn another_model_has_a_truth_of_its_own() {
        let mut trial = trial("skin");
        let mut progress = Progress::new(true);
        let truth = [trial.truth(0, 256, 1, (&mut progress, 0)).unwrap()];
        let setting = Setting { shaded: false, ..trial.base };
        assert!(!setting.same_model(&trial.base) && trial.is_shaded());
        let own = [trial.own_truth(&setting, &truth[0]).unwrap()];
        let judged = trial.judge(&setting, &truth, Some(&own)).unwrap();
        let own = judged.own.unwrap();
        assert!(own.rmse < 1.0 && judged.off.rmse > 5.0, "{own:?} {:?}", judged.off);
        let (base, bare) = (trial.base, setting);
        let ((n, bytes), (m, fewer)) = (trial.bricks(&base).unwrap(), trial.bricks(&bare).unwrap());
        assert!(n == m && fewer < bytes, "no normals: {fewer} of {bytes}");
    }

    #[test]
    fn times_are_of_frames() {
        let mut trial = trial("fog");
        let effort = Effort { cut: Cut::on(1), seconds: 0.0 };
        let base = trial.base;
        let t = trial.time(&base, effort).unwrap();
        assert_eq!(t.frames, FRAMES as u32);
        assert!(t.min > 0.0 && t.min <= t.median && t.median <= t.max);
    }
}
