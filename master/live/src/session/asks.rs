//! Requests of a session beside its pictures: fitting, cancelling, removing.

use super::{Outcome, Session, read, text};
use crate::messages::{CancelJob, FitAsk, Head, RemoveVolume};
use crate::picture::path_of;
use crate::problem::Problem;
use crate::volume::framed;
use serde_json::json;
use slabcast_common::ids::JobId;
use slabcast_common::transfer::TransferFunction;
use slabcast_scene::presets;
use slabcast_scene::transfer::TransferChoice;
use slabcast_scene::values::as_read_from_file;

impl Session {
    /// Answers a request. Messages of unknown types are skipped.
    ///
    /// # Errors
    /// The message can't be used.
    pub(super) fn ask(&mut self, head: &Head, message: &str) -> Result<(), Problem> {
        match head.kind.as_str() {
            "fit" => self.fit(read(message)?),
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
        match as_read_from_file(choice, info) {
            TransferChoice::Name(name) => {
                presets::by_name(&name, &info.summary).map_err(|e| Problem::field(&e))
            }
            TransferChoice::Function(tf) => {
                tf.check().map_err(|e| Problem::field(&e))?;
                Ok(*tf)
            }
        }
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
