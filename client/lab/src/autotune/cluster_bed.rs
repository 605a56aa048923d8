//! Tries settings on a cluster: frame times, and, where only the cluster has the volume, the error
//! against its own finest pictures.
//!
//! The time is what a user waits for: consecutive frames of the path, magnified and encoded as PNG
//! as they arrive. Where the cluster is in this process, that takes the same cores.

use super::setting::Setting;
use super::test_bed::{TestBed, VIEWS};
use super::trial::Deviation;
use slabcast_client::Client;
use slabcast_common::image::{Background, Picture, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::volume::VolumeInfo;
use slabcast_master::Handle;
use slabcast_render::judge::reference::ErrorFigures;
use slabcast_scene::path::ViewPath;
use slabcast_session::fail::Fail;
use slabcast_session::magnify::magnified;
use slabcast_session::output::{Frame, Inside, png};
use slabcast_session::progress::{self, Progress};
use slabcast_session::request::RenderRequest;
use slabcast_session::source::{Source, Update};
use slabcast_session::{embedded, machine, remote, signals};
use std::time::Instant;
use tokio::runtime::Runtime;
use tokio::task::JoinSet;

/// Frames that are timed of a setting, after the first.
const FRAMES: u32 = 4;
/// Frames that are timed of a setting whose time is near the budget.
const FRAMES_NEAR_BUDGET: u32 = 12;
/// Ratio of a time to the budget, or its inverse, below which the time is near the budget.
const NEAR: f64 = 1.6;

/// The finest setting, whose pictures are the truth where there is no reference. Sheets twice as
/// thin were 0.019 to 0.034 of 1/255 from the limit (ARCHITECTURE.md), mostly by rounded positions.
const FINEST: Finest = Finest { thickness: 0.125, eps: 1.0 / 65536.0, rmse: 0.05 };

struct Finest {
    thickness: f64,
    eps: f64,
    /// RMSE of the finest setting in 1/255, which is added to measured errors.
    rmse: f64,
}

/// The connection to the master that renders the frames.
pub enum Connection<'a> {
    /// A master in this process.
    Embedded(&'a Handle),
    /// A master behind a network.
    Remote(&'a Client),
}

/// A cluster and the job that settings are tried with.
pub struct ClusterRun<'a> {
    /// Runtime that drives the connection to the master.
    pub runtime: &'a Runtime,
    /// Connection to the master that renders the trials.
    pub connection: Connection<'a>,
    /// Lattice, values and digest of the master's volume.
    pub info: VolumeInfo,
    /// The request of the user; it must fit the volume.
    pub request: RenderRequest,
    /// Description of the cluster for messages: `the cluster of HOST:PORT`.
    pub description: String,
}

impl ClusterRun<'_> {
    /// Returns the ms from one frame of the path to the next. Views are far apart, so that a few
    /// stand for all. The first, for which bricks are cut and sent, is left out.
    pub(crate) fn ms(&self, setting: &Setting) -> Result<f64, Fail> {
        let ms = self.interval_ms(setting, FRAMES)?;
        let budget = self.request.target.budget.unwrap_or(f64::INFINITY);
        let near = ms < NEAR * budget && ms * NEAR > budget;
        if near { self.interval_ms(setting, FRAMES_NEAR_BUDGET) } else { Ok(ms) }
    }

    fn interval_ms(&self, setting: &Setting, frames: u32) -> Result<f64, Fail> {
        let path = spread(&self.request.path, frames + 1);
        // Pictures that are magnified here are sent as floats.
        let format = if setting.shrink > 1 { PixelFormat::Rgba32F } else { PixelFormat::Rgb8 };
        let written = Some((setting.shrink, self.request.background));
        let mut came: Vec<f64> = self
            .frames((setting, self.request.level), path, format, written)?
            .iter()
            .map(|f| f.1)
            .collect();
        came.sort_unstable_by(f64::total_cmp);
        let n = came.len() - 1;
        Ok((came[n] - came[0]) * 1e3 / n.max(1) as f64)
    }

    /// Renders a path at a setting and level of detail. Returns each frame and the seconds until it arrived or, with
    /// `written` (magnification, background), until it was encoded.
    fn frames(
        &self,
        (setting, level): (&Setting, LevelChoice),
        path: ViewPath,
        format: PixelFormat,
        written: Option<(u32, Background)>,
    ) -> Result<Vec<(Frame, f64)>, Fail> {
        let mut request = self.request.clone();
        request.quality = setting.quality;
        request.level = level;
        request.path = path;
        request.path.size = setting.drawn_size(request.path.size).unwrap_or(request.path.size);
        let message = request.to_message(&self.info, format, false);
        self.runtime.block_on(async {
            let mut source = match &self.connection {
                Connection::Embedded(handle) => embedded::submit(handle, &request, message).await?,
                Connection::Remote(client) => {
                    remote::submit((*client).clone(), &request, message).await?
                }
            };
            let received = receive(&mut source, written).await;
            if received.is_err() {
                source.cancel.now().await;
            }
            received
        })
    }
}

async fn receive(
    source: &mut Source,
    written: Option<(u32, Background)>,
) -> Result<Vec<(Frame, f64)>, Fail> {
    let (began, mut frames, mut noted) = (Instant::now(), Vec::new(), false);
    let mut writing = JoinSet::new();
    loop {
        let update = tokio::select! {
            code = signals::stopped() => return Err(Fail::silent(code)),
            update = source.updates.recv() => update,
        };
        match update {
            None => return Err(Fail::failed("the job ended before its last frame")),
            Some(Err(e)) => return Err(e),
            Some(Ok(Update::FrameFailed { number, reason })) => {
                return Err(Fail::failed(format!("frame {number} failed: {reason}")));
            }
            Some(Ok(Update::Done)) => break,
            Some(Ok(Update::Frame { frame, .. })) => match written {
                None => frames.push((frame, began.elapsed().as_secs_f64())),
                Some((times, background)) => {
                    writing.spawn_blocking(move || {
                        write(&frame, times, background);
                        (frame, began.elapsed().as_secs_f64())
                    });
                }
            },
            Some(Ok(Update::Step(step))) => {
                if !step.waiting.is_empty() && !noted {
                    progress::note(&step.waiting);
                    noted = true;
                }
            }
        }
    }
    frames.extend(writing.join_all().await);
    Ok(frames)
}

/// Magnifies and encodes a frame as when it is written, without the disk.
fn write(frame: &Frame, times: u32, background: Background) {
    let large = (times > 1).then(|| {
        let picture = magnified(frame.picture(), times, 1);
        let bytes = picture.encode(PixelFormat::Rgb8, background).into();
        Frame { size: picture.size, format: PixelFormat::Rgb8, bytes, ..frame.clone() }
    });
    let mut file = Vec::new();
    // Writing into memory can't fail.
    let _ = png::encode(large.as_ref().unwrap_or(frame), &Inside::default(), &mut file);
    std::hint::black_box(file);
}

/// Returns a path of `views` views that stand for `path`: spread over a turntable, the first ones
/// of any other path.
fn spread(path: &ViewPath, views: u32) -> ViewPath {
    let mut path = path.clone();
    let frames = path.frames().max(1) as u32;
    let first = path.first_frame();
    match &mut path.turntable {
        Some(turn) => {
            turn.start += turn.step * first as f64;
            // A single picture is timed with views next to it.
            let over = turn.step * f64::from(frames - 1);
            turn.step = if over == 0.0 { 1.0 } else { over / f64::from(views - 1) };
            turn.frames = views;
            path.range = None;
        }
        None => {
            let last = first as u32 + views.min(frames) - 1;
            path.range = Some([first as u32, last]);
        }
    }
    path
}

/// A test bed on a cluster that alone has the volume.
pub struct ClusterBed<'a> {
    run: ClusterRun<'a>,
    base: Setting,
    /// Pictures of the finest setting, as premultiplied RGBA.
    truths: Vec<(ViewPath, Vec<[f64; 4]>)>,
}

impl<'a> ClusterBed<'a> {
    /// Returns a test bed that judges and times settings by jobs of the given cluster.
    pub fn new(run: ClusterRun<'a>) -> ClusterBed<'a> {
        let base = Setting::asked(run.request.quality);
        ClusterBed { run, base, truths: Vec::new() }
    }

    fn picture(
        &self,
        (setting, level): (&Setting, LevelChoice),
        path: &ViewPath,
    ) -> Result<Picture, Fail> {
        let frames = self.run.frames((setting, level), path.clone(), PixelFormat::Rgba32F, None)?;
        let [(frame, _)] = &frames[..] else {
            return Err(Fail::failed(format!("one frame was requested, {} arrived", frames.len())));
        };
        Ok(magnified(frame.picture(), setting.shrink, machine::cores() as usize))
    }

    fn finest(&self) -> Setting {
        let base = self.base.quality;
        Setting {
            quality: Quality {
                thickness: FINEST.thickness.min(base.thickness),
                eps: FINEST.eps.min(base.eps),
                sums: Sums::Auto,
                ..base
            },
            ..self.base
        }
    }
}

impl TestBed for ClusterBed<'_> {
    fn base(&self) -> Setting {
        self.base
    }

    fn size(&self) -> [u32; 2] {
        self.run.request.path.size
    }

    fn description(&self) -> String {
        self.run.description.clone()
    }

    fn identity(&self) -> String {
        let ClusterRun { request, info, .. } = &self.run;
        let around = all_around(&request.path);
        format!(
            "judged by its finest pictures: volume {} level {} transfer {:?} path {} quality {:?} background \
             {:?} pixels {} slabcast {}",
            info.digest,
            request.level,
            request.transfer.choice(info),
            serde_json::to_string(&around).unwrap_or_default(),
            request.quality,
            request.background,
            slabcast_common::PIXELS_VERSION,
            env!("CARGO_PKG_VERSION")
        )
    }

    /// Returns false: workers come and go.
    fn keeps_times(&self) -> bool {
        false
    }

    fn deviation(&mut self, setting: &Setting, progress: &mut Progress) -> Result<Deviation, Fail> {
        if self.truths.is_empty() {
            let path = all_around(&self.run.request.path);
            let (views, finest) = (path.frames(), self.finest());
            let n = VIEWS.min(views);
            for i in 0..n {
                progress.phase(&format!("drawing the exact picture, view {} of {n}", i + 1));
                let view = path.single_frame(path.first_frame() + (2 * i + 1) * views / (2 * n));
                // In all detail, whatever level is tried.
                let picture = self.picture((&finest, LevelChoice::At(0)), &view)?;
                let truth = picture.pixels.iter().map(|p| p.map(f64::from)).collect();
                self.truths.push((view, truth));
            }
            progress.phase("trying settings");
        }
        let mut deviation = Deviation::default();
        for (view, truth) in &self.truths {
            let picture = self.picture((setting, self.run.request.level), view)?;
            let figures =
                ErrorFigures::compare(&picture.pixels, truth, self.run.request.background);
            deviation = deviation.worst(&figures);
        }
        deviation.rmse = libm::hypot(deviation.rmse, FINEST.rmse);
        Ok(Deviation {
            most_999: deviation.most_999 + 2.0 * FINEST.rmse,
            max: deviation.max + 2.0 * FINEST.rmse,
            ..deviation
        })
    }

    fn ms(&mut self, setting: &Setting) -> Result<f64, Fail> {
        self.run.ms(setting)
    }
}

/// Returns the path that settings are tried on. For a turntable, [`VIEWS`] views all around, so
/// that measurements serve any turn of the scene; any other path is returned as it is.
pub(crate) fn all_around(path: &ViewPath) -> ViewPath {
    let mut path = path.clone();
    if let Some(turn) = &mut path.turntable {
        (turn.start, turn.step, turn.frames) = (20.0, 71.0, VIEWS as u32);
        path.range = None;
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_scene::path::Turntable;

    #[test]
    fn spread_covers_a_turntable_with_few_views() {
        let turn = |frames, step| {
            let turn = Turntable { frames, step, start: 10.0, ..Turntable::default() };
            ViewPath::from_turntable([64, 64], turn)
        };
        let few = spread(&turn(18, 5.0), 6).turntable.unwrap();
        assert_eq!((few.start, few.step, few.frames), (10.0, 17.0, 6));
        let one = spread(&turn(1, 5.0), 5).turntable.unwrap();
        assert_eq!((one.start, one.step, one.frames), (10.0, 1.0, 5));
        let mut part = turn(18, 5.0);
        part.range = Some([4, 6]);
        let part = spread(&part, 3);
        assert_eq!(part.range, None);
        let part = part.turntable.unwrap();
        assert_eq!((part.start, part.step, part.frames), (30.0, 5.0, 3));
    }
}
