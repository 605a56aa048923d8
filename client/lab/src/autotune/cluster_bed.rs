//! A cluster that tries settings: how long a frame takes there, and, where the volume is not here, how
//! far its pictures are from its own finest.
//!
//! What is timed is what a person waits for: frames of the path, one after the other, magnified and made
//! PNGs as they arrive, which takes the same cores where the cluster is in this process.

use super::setting::Setting;
use super::test_bed::{TestBed, VIEWS};
use super::trial::Deviation;
use slabcast_client::Client;
use slabcast_common::image::{Background, Picture, PixelFormat};
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::volume::VolumeInfo;
use slabcast_master::Handle;
use slabcast_render::judge::reference::ErrorFigures;
use slabcast_scene::path::ViewPath;
use slabcast_session::fail::Fail;
use slabcast_session::magnify::magnified;
use slabcast_session::output::{Frame, png};
use slabcast_session::progress::{self, Progress};
use slabcast_session::request::RenderRequest;
use slabcast_session::source::{Source, Update};
use slabcast_session::{embedded, machine, remote, signals};
use std::time::Instant;
use tokio::runtime::Runtime;
use tokio::task::JoinSet;

/// Frames that are timed of a setting, after the first.
const FRAMES: u32 = 4;
/// The same of one whose time is near the budget.
const MORE: u32 = 12;
/// What counts as near: within this factor.
const NEAR: f64 = 1.6;

/// The finest setting, whose pictures are the truth where there is no reference. Sheets twice as thin were
/// 0.019 to 0.034 of 1/255 from the limit (ARCHITECTURE.md), which is mostly rounded positions.
const FINEST: Finest = Finest { thickness: 0.125, eps: 1.0 / 65536.0, off: 0.05 };

struct Finest {
    thickness: f64,
    eps: f64,
    /// RMSE of it in 1/255, which is added to what is found.
    off: f64,
}

/// Whom frames are asked of.
pub enum Connection<'a> {
    /// A master of this process.
    Embedded(&'a Handle),
    /// One behind a network.
    Remote(&'a Client),
}

/// A cluster, and the job that it is to be tried with.
pub struct ClusterRun<'a> {
    /// Runs the connection.
    pub runtime: &'a Runtime,
    /// The master that renders.
    pub wire: Connection<'a>,
    /// The volume, with its digest.
    pub info: VolumeInfo,
    /// What was asked for; it fits the volume.
    pub request: RenderRequest,
    /// What the cluster is, for messages.
    pub crew: String,
}

impl ClusterRun<'_> {
    /// Returns a description of the cluster for messages.
    pub fn crew(&self) -> &str {
        &self.crew
    }

    /// Milliseconds from one frame of the path to the next. Views are far apart, so that a few stand for
    /// all; the first is left out, for which bricks are cut and sent.
    pub fn ms(&self, setting: &Setting) -> Result<f64, Fail> {
        let few = self.each(setting, FRAMES)?;
        let budget = self.request.target.budget.unwrap_or(f64::INFINITY);
        let near = few < NEAR * budget && few * NEAR > budget;
        if near { self.each(setting, MORE) } else { Ok(few) }
    }

    fn each(&self, setting: &Setting, frames: u32) -> Result<f64, Fail> {
        let path = spread(&self.request.path, frames + 1);
        // Floats are what small pictures are sent as.
        let format = if setting.shrink > 1 { PixelFormat::Rgba32F } else { PixelFormat::Rgb8 };
        let written = Some((setting.shrink, self.request.background));
        let mut came: Vec<f64> =
            self.frames(setting, path, format, written)?.iter().map(|f| f.1).collect();
        came.sort_unstable_by(f64::total_cmp);
        let n = came.len() - 1;
        Ok((came[n] - came[0]) * 1e3 / n.max(1) as f64)
    }

    /// The frames of a path at a setting, and when each came, in seconds; or, if they are to be `written`
    /// (so many times larger, over this background), when that would be done.
    fn frames(
        &self,
        setting: &Setting,
        path: ViewPath,
        format: PixelFormat,
        written: Option<(u32, Background)>,
    ) -> Result<Vec<(Frame, f64)>, Fail> {
        let mut request = self.request.clone();
        request.quality = setting.quality;
        request.path = path;
        request.path.size = setting.drawn_size(request.path.size).unwrap_or(request.path.size);
        let message = request.to_message(&self.info, format, false);
        self.runtime.block_on(async {
            let mut source = match &self.wire {
                Connection::Embedded(handle) => embedded::submit(handle, &request, message).await?,
                Connection::Remote(client) => {
                    remote::submit((*client).clone(), &request, message).await?
                }
            };
            let taken = take(&mut source, written).await;
            if taken.is_err() {
                source.cancel.now().await;
            }
            taken
        })
    }
}

async fn take(
    source: &mut Source,
    written: Option<(u32, Background)>,
) -> Result<Vec<(Frame, f64)>, Fail> {
    let (began, mut frames, mut told) = (Instant::now(), Vec::new(), false);
    let mut writing = JoinSet::new();
    loop {
        let update = tokio::select! {
            code = signals::stopped() => return Err(Fail::silent(code)),
            update = source.updates.recv() => update,
        };
        match update {
            None => return Err(Fail::failed("the job ended before its last frame")),
            Some(Err(e)) => return Err(e),
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
                if !step.waiting.is_empty() && !told {
                    progress::note(&step.waiting);
                    told = true;
                }
            }
        }
    }
    frames.extend(writing.join_all().await);
    Ok(frames)
}

/// What writing a frame takes but for the disk.
fn write(frame: &Frame, times: u32, background: Background) {
    let large = (times > 1).then(|| {
        let picture = magnified(frame.picture(), times, 1);
        let bytes = picture.encode(PixelFormat::Rgb8, background).into();
        Frame { size: picture.size, format: PixelFormat::Rgb8, bytes, ..frame.clone() }
    });
    let mut file = Vec::new();
    // Into memory: nothing to fail.
    let _ = png::encode(large.as_ref().unwrap_or(frame), "", &mut file);
    std::hint::black_box(file);
}

/// So many views that stand for a path: a turn's, far apart; of others the first ones.
fn spread(path: &ViewPath, views: u32) -> ViewPath {
    let mut path = path.clone();
    let frames = path.frames().max(1) as u32;
    let first = path.first_frame();
    match &mut path.turntable {
        Some(turn) => {
            turn.start += turn.step * first as f64;
            // A single picture is timed beside others like it.
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

/// A cluster whose volume is not here.
pub struct ClusterBed<'a> {
    through: ClusterRun<'a>,
    base: Setting,
    /// Pictures of the finest setting.
    truths: Vec<(ViewPath, Vec<[f64; 4]>)>,
}

impl<'a> ClusterBed<'a> {
    /// Returns a test bed on a cluster that alone has the volume.
    pub fn new(through: ClusterRun<'a>) -> ClusterBed<'a> {
        let base = Setting::asked(through.request.quality);
        ClusterBed { through, base, truths: Vec::new() }
    }

    fn picture(&self, setting: &Setting, path: &ViewPath) -> Result<Picture, Fail> {
        let frames = self.through.frames(setting, path.clone(), PixelFormat::Rgba32F, None)?;
        let [(frame, _)] = &frames[..] else {
            return Err(Fail::failed(format!("one frame was asked for, {} came", frames.len())));
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
        self.through.request.path.size
    }

    fn crew(&self) -> String {
        self.through.crew.clone()
    }

    fn identity(&self) -> String {
        let ClusterRun { request, info, .. } = &self.through;
        let around = all_around(&request.path);
        format!(
            "judged by its finest pictures: volume {} transfer {:?} path {} quality {:?} background \
             {:?} pixels {} slabcast {}",
            info.digest,
            request.transfer.choice(info),
            serde_json::to_string(&around).unwrap_or_default(),
            request.quality,
            request.background,
            slabcast_common::PIXELS_VERSION,
            env!("CARGO_PKG_VERSION")
        )
    }

    /// Workers come and go.
    fn keeps_times(&self) -> bool {
        false
    }

    fn off(&mut self, setting: &Setting, progress: &mut Progress) -> Result<Deviation, Fail> {
        if self.truths.is_empty() {
            let path = all_around(&self.through.request.path);
            let (views, finest) = (path.frames(), self.finest());
            let n = VIEWS.min(views);
            for i in 0..n {
                progress.phase(&format!("drawing what it should be, view {} of {n}", i + 1));
                let view = path.single_frame(path.first_frame() + (2 * i + 1) * views / (2 * n));
                let picture = self.picture(&finest, &view)?;
                let truth = picture.pixels.iter().map(|p| p.map(f64::from)).collect();
                self.truths.push((view, truth));
            }
            progress.phase("trying settings");
        }
        let mut off = Deviation::default();
        for (view, truth) in &self.truths {
            let picture = self.picture(setting, view)?;
            let figures =
                ErrorFigures::compare(&picture.pixels, truth, self.through.request.background);
            off = off.with(&figures);
        }
        off.rmse = libm::hypot(off.rmse, FINEST.off);
        Ok(Deviation {
            most_999: off.most_999 + 2.0 * FINEST.off,
            max: off.max + 2.0 * FINEST.off,
            ..off
        })
    }

    fn ms(&mut self, setting: &Setting) -> Result<f64, Fail> {
        self.through.ms(setting)
    }
}

/// What stands for a turn: views far apart all around, wherever the turn itself goes, so that what is
/// measured serves any turn of the scene. Other paths stand for themselves.
pub fn all_around(path: &ViewPath) -> ViewPath {
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
    fn few_views_stand_for_a_path() {
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
