//! From a request to a job: everything that is checked and computed before its first frame.
//!
//! A path may have 100,000 views. Working them out takes longer than the driver may be away from
//! its heartbeats, so `Plan::new` runs on a thread of the caller's runtime
//! ([`crate::Handle::submit`]) and the driver gets the finished plan.

use super::active::ActiveJob;
use super::{Job, JobState, JobView};
use crate::handle::{ServedVolume, unix_ms};
use crate::memory;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{JobId, SceneId};
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{InvalidField, Quality};
use slabcast_common::transfer::{Classifier, TransferFunction};
use slabcast_common::view::View;
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::path::Framing;
use slabcast_scene::presets;
use slabcast_scene::request::PathRequest;
use slabcast_scene::transfer::TransferChoice;
use slabcast_scene::tween::Tween;
use slabcast_volumes::BrickStore;
use slabcast_volumes::framing::framing;
use std::sync::Arc;

/// Bytes of the longest `client_key`.
const MAX_KEY_BYTES: usize = 200;

/// Reason why a request did not become a job.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SubmitError {
    /// A field of the request can't be used.
    #[error(transparent)]
    Refused(#[from] InvalidField),
    /// The client's key belongs to another request.
    #[error("client_key: belongs to another request; choose a fresh key")]
    KeyTaken,
    /// The master has as many jobs in progress as it takes.
    #[error("the master has as many jobs as it takes; wait, or cancel one")]
    Full,
    /// The master is shutting down.
    #[error("the master is shutting down")]
    Gone,
    /// Checking the request panicked: a mistake of this program, with the panic's message.
    #[error("{0}; this is a bug of slabcast")]
    Panicked(String),
}

/// A request that was checked, with all that its frames need.
pub(crate) struct Plan {
    pub(crate) request: Arc<PathRequest>,
    pub(crate) wanted: BrickNeeds,
    transfer: TransferFunction,
    quality: Quality,
    tween: Option<Tween>,
    views: Vec<View>,
    framing: Option<Framing>,
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
    /// Checks `request` against the volume that is served and works out its views.
    ///
    /// # Errors
    /// The field that can't be used.
    pub(crate) fn new(
        request: PathRequest,
        served: &ServedVolume,
        volume: &Volume,
    ) -> Result<Plan, InvalidField> {
        let info = &served.info;
        request.quality.check()?;
        request.work.check()?;
        request.path.check()?;
        memory::check(request.path.size, request.format)?;
        let transfer: TransferFunction = match &request.transfer {
            TransferChoice::Name(name) => presets::by_name(name, &info.summary)?,
            TransferChoice::Function(tf) => {
                tf.check()?;
                (**tf).clone()
            }
        };
        let framing = framing(&request.path, volume, info, &transfer, served.orientation)?;
        // The request stays as it came: the same key has to mean the same request.
        let path =
            framing.as_ref().map_or_else(|| request.path.clone(), |f| request.path.framed(f));
        let cameras = path.prepare(&info.lattice, served.orientation)?;
        let views = (0..request.path.frames())
            .map(|i| {
                View::new(&info.lattice, &cameras.camera(i)?, request.path.size, &request.quality)
            })
            .collect::<Result<Vec<View>, InvalidField>>()?;
        let compositing = request.quality.compositing;
        let tween = Tween::from_path(&request.path, &info.summary)?;
        let mut sums = request.quality.sums;
        for tf in tween.iter().flat_map(Tween::key_functions).chain([&transfer]) {
            let classifier = Classifier::new(tf, info, compositing);
            sums = classifier.choose_sums(&request.quality, &info.lattice)?;
        }
        let quality = Quality { sums, ..request.quality };
        let wanted =
            BrickNeeds::for_path(&request.path, &transfer, tween.as_ref(), info, &quality)?
                .with_kept(request.work.keep);
        let request = Arc::new(request);
        Ok(Plan { request, wanted, transfer, quality, tween, views, framing })
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
                frames_total: self.views.len() as u64,
                tiles: (0, 0),
                slab: (0, 0),
                workers: 0,
                size: request.path.size,
                format: request.format,
                framing: self.framing,
                submitted_unix_ms: unix_ms(),
                finished_unix_ms: 0,
            },
            request,
        )
    }

    /// The job as the driver renders it. `store`: its bricks, if they are there; else they will
    /// have the key `bricks`.
    pub(crate) fn activate(
        self,
        id: JobId,
        volume: VolumeInfo,
        bricks: BrickSetKey,
        store: Option<Arc<BrickStore>>,
    ) -> ActiveJob {
        let Plan { request, wanted, transfer, quality, tween, views, framing: _ } = self;
        let crop = wanted.crop;
        let scene = SceneSpec { id: SceneId(id.0), volume, transfer, quality, crop, bricks };
        ActiveJob { request, scene: Arc::new(scene), tween, wanted, views, store, next: 0 }
    }

    /// The sums that frames are drawn with.
    pub(crate) fn quality(&self) -> &Quality {
        &self.quality
    }
}
