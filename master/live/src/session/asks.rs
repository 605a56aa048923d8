//! Requests of a session beside its pictures: fitting, cancelling, removing.

use super::{Outcome, Session, read, text};
use crate::messages::{CancelJob, FitAsk, Head, JobsPage, PickAsk, RemoveVolume};
use crate::pick::{Field, picked};
use crate::picture::path_of;
use crate::problem::Problem;
use crate::volume::{framed, function};
use serde_json::{Value, json};
use slabcast_common::ids::JobId;
use slabcast_common::quality::{InvalidField, Quality};
use slabcast_common::transfer::TransferFunction;
use slabcast_common::view::View;
use slabcast_master::library::OpenVolume;
use slabcast_scene::path::{CropBox, ViewPath};
use slabcast_scene::values::as_read_from_file;

/// Jobs of one page at most.
const MOST_JOBS: usize = 1000;

/// Samples of the level of a file in which a ray is followed, at most: they are read for each pick.
const PICKED_SAMPLES: usize = 1 << 24;

/// Follows the ray of a pixel through a volume; of a file too large for memory through a level of it.
fn pick_in(
    open: &OpenVolume,
    path: &ViewPath,
    tf: &TransferFunction,
    pixel: [u32; 2],
) -> Result<Value, Problem> {
    let asked = &open.served.info;
    let refuse = |e: InvalidField| Problem::field(&e);
    let mut camera = path.camera(0, &asked.lattice, open.served.orientation).map_err(refuse)?;
    let crop = path.crop.as_ref().map(|crop| crop.resolve(&asked.lattice)).transpose();
    let mut crop = crop.map_err(refuse)?;
    let levels = open.source.levels();
    let (level, read);
    let samples = match open.source.whole(open.level) {
        Some(whole) => {
            level = open.level;
            whole.codes()
        }
        None => {
            let is_small =
                |info: &slabcast_common::volume::VolumeInfo| info.lattice.len() <= PICKED_SAMPLES;
            level = levels.iter().position(is_small).unwrap_or(levels.len() - 1);
            let dims = levels[level].lattice.dims;
            read = open
                .source
                .read_box(level, [0; 3], dims)
                .map_err(|e| Problem::new("volume_not_readable", e.to_string()))?;
            &read
        }
    };
    let info = &levels[level];
    let to_level = asked.lattice.to_centre_of(&info.lattice);
    camera.target -= to_level;
    crop = crop.map(|crop| CropBox { lo: crop.lo - to_level, hi: crop.hi - to_level });
    let view = View::new(&info.lattice, &camera, path.size, &Quality::default()).map_err(refuse)?;
    Ok(picked(&Field { info, samples }, &view, tf, crop.as_ref(), pixel))
}

impl Session {
    /// Answers a request. Messages of unknown types are skipped.
    ///
    /// # Errors
    /// The message can't be used.
    pub(super) fn ask(&mut self, head: &Head, message: &str) -> Result<(), Problem> {
        match head.kind.as_str() {
            "fit" => self.fit(read(message)?),
            "pick" => self.pick(&read(message)?),
            "thumbs" => self.want_thumbs(read(message)?),
            "jobs_page" => {
                self.jobs_page(&read(message)?);
                Ok(())
            }
            "cancel_job" => self.cancel_job(&read(message)?),
            "remove_volume" => {
                self.remove_volume(read(message)?);
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Returns the transfer function of the latest scene, in full.
    pub(super) fn transfer(&self) -> Result<TransferFunction, Problem> {
        let Some(shown) = &self.shown else {
            return Err(Problem::new("volume_not_found", "there is no volume yet; put one there"));
        };
        let info = shown.info();
        let choice = self.scene.tf.clone().unwrap_or_else(|| shown.home_tf.clone());
        function(&as_read_from_file(choice, info), info)
    }

    fn fit(&mut self, ask: FitAsk) -> Result<(), Problem> {
        let tf = self.transfer()?;
        let Some(shown) = self.shown.clone() else { return Ok(()) };
        let mut view = self.view.clone();
        view.camera = ask.camera;
        (view.camera.target, view.camera.height) = (None, None);
        let path = path_of(&view, &self.scene, view.size);
        let (shared, viewer, id) = (self.shared.clone(), self.viewer, ask.id);
        self.tasks.spawn(async move {
            let choice = shown.choice();
            let fitted = shared.handle.reading(move |library| {
                let open = library.open(&choice, viewer)?;
                framed(&open, &path, &tf)
            });
            let answer = match fitted.await.ok_or_else(Problem::ending).and_then(|fitted| fitted) {
                Ok(Some(framing)) => json!({
                    "type": "fitted", "id": id, "target": framing.target, "height": framing.height,
                }),
                Ok(None) => {
                    let nothing = "nothing can be seen; let the transfer function or the crop show \
                                   something";
                    Problem::new("nothing_visible", nothing).message("fit", id)
                }
                Err(problem) => problem.message("fit", id),
            };
            Outcome::Say(vec![text(&answer)])
        });
        Ok(())
    }

    fn pick(&mut self, ask: &PickAsk) -> Result<(), Problem> {
        let PickAsk { id, x, y } = *ask;
        let [w, h] = self.view.size;
        if x >= w || y >= h {
            let text = format!("{x}, {y} lies outside of the picture of {w}x{h}");
            return Err(Problem::field(&InvalidField::new("x", text)));
        }
        let tf = self.transfer()?;
        let Some(shown) = self.shown.clone() else { return Ok(()) };
        let path = path_of(&self.view, &self.scene, self.view.size);
        let (shared, viewer) = (self.shared.clone(), self.viewer);
        self.tasks.spawn(async move {
            let choice = shown.choice();
            let found = shared.handle.reading(move |library| {
                let open = library.open(&choice, viewer)?;
                pick_in(&open, &path, &tf, [x, y])
            });
            let answer = match found.await.ok_or_else(Problem::ending).and_then(|found| found) {
                Ok(mut picked) => {
                    picked["type"] = "picked".into();
                    (picked["id"], picked["x"], picked["y"]) = (id.into(), x.into(), y.into());
                    picked
                }
                Err(problem) => problem.message("pick", id),
            };
            Outcome::Say(vec![text(&answer)])
        });
        Ok(())
    }

    /// Sends jobs that are older than one.
    fn jobs_page(&mut self, ask: &JobsPage) {
        let before = ask.before.strip_prefix("job-").and_then(|n| n.parse::<u64>().ok());
        let (shared, viewer) = (self.shared.clone(), self.viewer);
        let count = ask.count.min(MOST_JOBS);
        self.tasks.spawn(async move {
            let watched = ["jobs".to_string()];
            let all = crate::news::look(&shared, viewer, &watched).await;
            let page = all.jobs_before(before.unwrap_or(u64::MAX), count);
            Outcome::Say(page.iter().map(text).collect())
        });
    }

    fn cancel_job(&mut self, ask: &CancelJob) -> Result<(), Problem> {
        let number = ask.job.strip_prefix("job-").and_then(|n| n.parse().ok());
        let unknown = || Problem::new("job_not_found", format!("the master has no {}", ask.job));
        let job = number.map(JobId).ok_or_else(unknown)?;
        let (handle, id, refusal) = (self.shared.handle.clone(), ask.id, unknown());
        self.tasks.spawn(async move {
            let answer = if handle.cancel(job).await || handle.job(job).is_some() {
                json!({"type": "ok", "re": "cancel_job", "id": id})
            } else {
                refusal.message("cancel_job", id)
            };
            Outcome::Say(vec![text(&answer)])
        });
        Ok(())
    }

    fn remove_volume(&mut self, ask: RemoveVolume) {
        let RemoveVolume { id, volume } = ask;
        let (handle, viewer) = (self.shared.handle.clone(), self.viewer);
        self.tasks.spawn(async move {
            let used = handle.clone();
            let removed = handle.looking(move |library| {
                library.remove(&volume, viewer, |digest| used.is_drawn(digest))
            });
            let removed = removed.await.ok_or_else(Problem::ending);
            let answer = match removed.and_then(|removed| Ok(removed?)) {
                Ok(()) => json!({"type": "ok", "re": "remove_volume", "id": id}),
                Err(problem) => problem.message("remove_volume", id),
            };
            Outcome::Say(vec![text(&answer)])
        });
    }
}
