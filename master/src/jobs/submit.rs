//! From a request to a job: everything that is checked and computed before its first frame.
//!
//! A path may have 100,000 views in 76 bytes. They are made one by one as their frames are drawn, so
//! that a job takes what its request takes. Checking it may still take longer than the driver may
//! be away from its heartbeats, so `Plan::new` runs on a thread of the caller's runtime
//! ([`crate::Handle::submit`]) and the driver gets the finished plan.

use super::active::ActiveJob;
use super::{DrawnTile, Job, JobState, JobView, window};
use crate::handle::unix_ms;
use crate::library::{OpenVolume, VolumeError};
use crate::memory::Shares;
use glam::DVec3;
use slabcast_common::ids::{JobId, SceneId};
use slabcast_common::level::LevelChoice;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{InvalidField, Quality};
use slabcast_common::transfer::{Classifier, TransferFunction};
use slabcast_common::view::View;
use slabcast_common::volume::{Digest32, VolumeInfo};
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::levels::quality_at_level;
use slabcast_scene::path::{Framing, Prepared, ViewPath};
use slabcast_scene::presets;
use slabcast_scene::request::{PathRequest, function_bytes};
use slabcast_scene::transfer::TransferChoice;
use slabcast_scene::tween::Tween;
use slabcast_volumes::auto_level::AutoLevel;
use slabcast_volumes::framing::{FramingError, framing_of};
use std::sync::Arc;
use tokio::sync::mpsc;

/// Bytes of the longest `client_key`.
const MAX_KEY_BYTES: usize = 200;

/// Views of a path that are tried before it is accepted, evenly spread over it; views that were
/// given one by one are all tried. A view takes 1 us, so that a path of 100,000 frames would take
/// 0.1 s for a request of 76 bytes. A frame in between that can't be drawn fails its job by name.
const TRIED_VIEWS: usize = 1000;

/// Reason why a request did not become a job.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SubmitError {
    /// A field of the request can't be used.
    #[error(transparent)]
    Refused(#[from] InvalidField),
    /// The volume is not there, or can't be read.
    #[error(transparent)]
    Volume(#[from] VolumeError),
    /// The client's key belongs to another request.
    #[error("client_key: belongs to another request; choose a fresh key")]
    KeyTaken,
    /// The master has as many jobs in progress as it takes, or as much memory in use for them; the
    /// figures, and what to do.
    #[error("{0}")]
    Full(String),
    /// The master is shutting down.
    #[error("the master is shutting down")]
    Gone,
    /// Checking the request panicked: a mistake of this program, with the panic's message.
    #[error("{0}; this is a bug of slabcast")]
    Panicked(String),
}

impl From<FramingError> for SubmitError {
    fn from(error: FramingError) -> SubmitError {
        match error {
            FramingError::Field(field) => SubmitError::Refused(field),
            FramingError::File(problem) => {
                SubmitError::Volume(VolumeError::NotReadable(problem.to_string()))
            }
        }
    }
}

/// A request that was checked, with all that its frames need.
pub(crate) struct Plan {
    pub(crate) request: Arc<PathRequest>,
    pub(crate) wanted: BrickNeeds,
    transfer: TransferFunction,
    quality: Quality,
    tween: Option<Tween>,
    views: Views,
    framing: Option<Framing>,
    /// The level that is drawn.
    volume: VolumeInfo,
    /// Digest of the volume that was asked for.
    asked: Digest32,
    /// Receiver of tiles before their frame is done; `None` for jobs of clients.
    pub(crate) tiles: Option<mpsc::Sender<DrawnTile>>,
}

/// The views of a path, each made when it is asked for.
pub(crate) struct Views {
    request: Arc<PathRequest>,
    /// Quality of the views: the request's, as the volume has it.
    quality: Quality,
    /// The path with the numbers of its framing, if it asked for them.
    framed: Option<Box<ViewPath>>,
    prepared: Prepared,
    /// World vector from the centre of level 0, to which the path is relative, to that of the level
    /// that is drawn.
    to_level: DVec3,
}

impl Views {
    fn path(&self) -> &ViewPath {
        self.framed.as_deref().unwrap_or(&self.request.path)
    }

    /// The number of views.
    pub(crate) fn len(&self) -> u64 {
        self.request.path.frames() as u64
    }

    /// Makes a view of the level `info`.
    ///
    /// # Errors
    /// The field of the camera that can't be used.
    pub(crate) fn view(&self, number: u64, info: &VolumeInfo) -> Result<View, InvalidField> {
        let mut camera = self.prepared.camera(self.path(), number as usize)?;
        camera.target -= self.to_level;
        View::new(&info.lattice, &camera, self.request.path.size, &self.quality)
    }

    /// Tries views: all that were given, else [`TRIED_VIEWS`] of the path. Calls `each` with them.
    fn check(&self, info: &VolumeInfo, mut each: impl FnMut(&View)) -> Result<(), InvalidField> {
        let last = self.len() - 1;
        let tried = if self.path().views.is_empty() {
            self.len().min(TRIED_VIEWS as u64)
        } else {
            self.len()
        };
        (0..tried).try_for_each(|i| {
            let number = if tried > 1 { i * last / (tried - 1) } else { 0 };
            self.view(number, info).map(|view| each(&view))
        })
    }

    fn held_bytes(&self) -> usize {
        let framed = self.framed.as_ref().map_or(0, |_| self.request.held_bytes());
        self.prepared.held_bytes() + framed
    }
}

/// Checks a client's key.
pub(crate) fn check_key(key: &str) -> Result<(), InvalidField> {
    if key.is_empty() || key.len() > MAX_KEY_BYTES {
        let problem = format!("give 1 to {MAX_KEY_BYTES} bytes, new for each request");
        return Err(InvalidField::new("client_key", problem));
    }
    Ok(())
}

impl Plan {
    /// Checks `request` against its volume and works out its views. `open_level` makes a level of the
    /// volume.
    ///
    /// # Errors
    /// The field that can't be used, or there is no memory for the level.
    pub(crate) fn new(
        request: PathRequest,
        open: &OpenVolume,
        open_level: impl FnOnce(u32) -> Result<OpenVolume, VolumeError>,
        shares: &Shares,
    ) -> Result<Plan, SubmitError> {
        let served = &*open.served;
        let asked = &served.info;
        let quality = request.quality.for_volume(&asked.summary);
        quality.check()?;
        request.work.check()?;
        request.path.check()?;
        shares.check(&request)?;
        let transfer: TransferFunction = match &request.transfer {
            TransferChoice::Name(name) => presets::by_name(name, &asked.summary)?,
            TransferChoice::Function(tf) => {
                tf.check()?;
                (**tf).clone()
            }
        };
        let (source, outlines) = (&*open.source, &*served.outlines);
        let framing = framing_of(&request.path, source, outlines, &transfer, served.orientation)?;
        let request = Arc::new(request);
        // The request stays as it came: the same key has to mean the same request.
        let framed = framing.as_ref().map(|f| Box::new(request.path.framed(f)));
        let path = framed.as_deref().unwrap_or(&request.path);
        let prepared = path.prepare(&asked.lattice, served.orientation)?.into_prepared();
        let to_level = DVec3::ZERO;
        let mut views = Views { request: request.clone(), quality, framed, prepared, to_level };
        let mut finest = AutoLevel::new(asked);
        views.check(asked, |view| finest.see(view))?;
        let level = match request.level {
            LevelChoice::At(level) => level,
            LevelChoice::Auto => finest.level_of(open.source.levels()),
        };
        let drawn = if level > asked.level { open_level(level)? } else { open.clone() };
        let info = &drawn.served.info;
        views.to_level = asked.lattice.to_centre_of(&info.lattice);
        if info.level != asked.level {
            views.check(info, |_| ())?;
        }
        // The interpolating spline filters all samples of a level, so a file keeps the other.
        let quality = match drawn.source.whole(drawn.level) {
            Some(_) => quality_at_level(quality, info.level - asked.level),
            None => quality,
        };
        let compositing = quality.compositing;
        let tween = Tween::from_path(&request.path, &asked.summary)?;
        let mut sums = quality.sums;
        for tf in tween.iter().flat_map(Tween::key_functions).chain([&transfer]) {
            let classifier = Classifier::new(tf, info, compositing);
            sums = classifier.choose_sums(&quality, &info.lattice)?;
        }
        let quality = Quality { sums, ..quality };
        let wanted =
            BrickNeeds::for_path(&request.path, &transfer, tween.as_ref(), asked, &quality)?
                .with_kept(request.work.keep)
                .at_centre(views.to_level);
        let wanted = window::fit(wanted, &drawn, shares, |each| {
            (0..views.len()).try_for_each(|number| views.view(number, info).map(|view| each(&view)))
        })?;
        let (volume, asked) = (info.clone(), asked.digest);
        let tiles = None;
        Ok(Plan { request, wanted, transfer, quality, tween, views, framing, volume, asked, tiles })
    }

    /// The job as the table shows it.
    pub(crate) fn entry(&self, id: JobId) -> Job {
        let request = self.request.clone();
        Job::new(
            JobView {
                id,
                client_key: request.client_key.clone(),
                state: JobState::Queued,
                frames_done: 0,
                frames_failed: 0,
                frames_total: self.views.len(),
                tiles: (0, 0),
                slab: (0, 0),
                trouble: None,
                workers: 0,
                size: request.path.size,
                format: request.format,
                framing: self.framing,
                volume: self.asked,
                submitted_unix_ms: unix_ms(),
                finished_unix_ms: 0,
            },
            request,
            self.held_bytes(),
        )
    }

    /// Bytes that the request takes with all that was made of it: in proportion to what was sent,
    /// and not to the number of frames.
    pub(crate) fn held_bytes(&self) -> usize {
        size_of::<ActiveJob>()
            + size_of::<Job>()
            + size_of::<SceneSpec>()
            + self.request.held_bytes()
            + self.views.held_bytes()
            + function_bytes(&self.transfer)
            + self.tween.as_ref().map_or(0, Tween::held_bytes)
            + self.wanted.support.intervals.len() * size_of::<(f64, f64)>()
    }

    /// The job as the driver renders it, from bricks with the needs `bricks`.
    pub(crate) fn activate(self, id: JobId, bricks: BrickNeeds) -> ActiveJob {
        let Plan { request, wanted, transfer, quality, tween, views, volume, tiles, .. } = self;
        let (crop, key) = (wanted.crop, bricks.set_key(volume.digest));
        let scene = SceneSpec { id: SceneId(id.0), volume, transfer, quality, crop, bricks: key };
        let scene = Arc::new(scene);
        ActiveJob { request, scene, tween, bricks, views, next: 0, begun: 0, tiles }
    }

    /// Digest of the level that is drawn.
    pub(crate) fn volume(&self) -> Digest32 {
        self.volume.digest
    }

    /// The sums that frames are drawn with.
    pub(crate) fn quality(&self) -> &Quality {
        &self.quality
    }
}
