//! Passes of a session: beginning, queueing of tiles, end.

use super::{Outcome, Queued, Session, text};
use crate::compare::{Picture, largest_difference};
use crate::picture::{self, Drawn, Early, Order, request_of};
use crate::problem::Problem;
use crate::slot::{Pair, Pass};
use crate::volume::Shown;
use axum::extract::ws::Message;
use slabcast_master::jobs::FinishedFrame;
use slabcast_scene::path::ViewPath;
use slabcast_scene::request::PathRequest;
use std::sync::Arc;
use std::time::Instant;
use tokio::task::AbortHandle;

/// Batches of a still's tiles that wait for the session. With none, a pass that was encoded waits with
/// its next batch.
pub(super) const EARLY_BATCHES: usize = 2;

/// Messages in the session's queue beyond which a still in progress sends no tiles: a few batches. A slow
/// client gets larger tiles when the still is done.
pub(super) const EARLY_WAITING: usize = 64;

/// A pass that is being drawn.
pub(super) struct Drawing {
    number: u64,
    pair: Pair,
    pass: Pass,
    rung: usize,
    request: PathRequest,
    task: AbortHandle,
}

impl Session {
    /// Queues tiles of the still that is being drawn; tiles of a dropped still are left out.
    pub(super) fn show_early(&mut self, early: Option<Early>) {
        let Some(Early { number, tiles }) = early else { return };
        let drawing = self.drawing.as_ref().filter(|drawing| drawing.number == number);
        let Some(of) = drawing.map(|drawing| (drawing.pair, drawing.pass)) else { return };
        let tiles = tiles.into_iter().map(Message::Binary);
        self.queue.extend(tiles.map(|message| Queued { message, pass: Some(of) }));
    }

    pub(super) fn drop_pass(&mut self) {
        if let Some(drawing) = self.drawing.take() {
            drawing.task.abort();
            self.slot.dropped(self.shared.now());
        }
    }

    pub(super) fn begin_pass(&mut self, shown: &Arc<Shown>, pair: Pair, pass: Pass) {
        self.drop_thumb();
        let rung = if pass == Pass::Moving { self.preview.choose().0 } else { 0 };
        let edited = self.edited && pass == Pass::Moving;
        let request = request_of(shown, &self.view, &self.scene, (pass, rung), edited);
        let known = self.frame.as_ref().filter(|(of, _)| *of == request);
        let frame = known.map(|(_, frame)| frame.clone());
        self.passes += 1;
        let number = self.passes;
        let (codecs, early) = (self.codecs, self.early.0.clone());
        let request_of_pass = request.clone();
        let bound = if pass == Pass::Moving { self.preview.off(rung) } else { 0.0 };
        let order =
            Order { pair, pass, bound, request: request_of_pass, codecs, frame, number, early };
        let (shared, id, viewer, asked_at) =
            (self.shared.clone(), self.id, self.viewer, self.asked_at);
        let task = self.tasks.spawn(async move {
            let result = picture::draw(shared, order, id, viewer, asked_at).await;
            Outcome::Drawn { number, result: result.map(Box::new) }
        });
        self.slot.begun(pair, pass);
        self.drawing = Some(Drawing { number, pair, pass, rung, request, task });
    }

    pub(super) fn drawn(&mut self, number: u64, result: Result<Box<Drawn>, Problem>) {
        // They were made before.
        while let Ok(early) = self.early.1.try_recv() {
            self.show_early(Some(early));
        }
        let Some(drawing) = self.drawing.take_if(|drawing| drawing.number == number) else {
            return;
        };
        let Drawing { pair, pass, rung, request, .. } = drawing;
        let Drawn { frame, encoded, mut done, steady_ms } = match result {
            Ok(drawn) => *drawn,
            Err(problem) => {
                self.slot.failed();
                self.refuse(&problem, "scene", pair.scene.into());
                return;
            }
        };
        done["threads"] = self.threads.into();
        match (steady_ms, pass) {
            (Some(ms), Pass::Moving) => self.preview.drawn(rung, ms),
            (Some(ms), Pass::Still) => self.preview.still_drawn(ms),
            (None, _) => {}
        }
        match pass {
            Pass::Moving => self.previewed = Some((rung, request, frame)),
            Pass::Still => {
                self.compare(pair.scene, &request, &frame);
                self.frame = Some((request, frame));
            }
        }
        let tiles = encoded.tiles.into_iter().map(Message::Binary);
        let whole = tiles.chain([text(&done)]);
        let of = Some((pair, pass));
        self.queue.extend(whole.map(|message| Queued { message, pass: of }));
        self.slot.delivered();
        self.sent.push_back((pair, pass, Instant::now()));
    }

    /// Starts a comparison of the last moving picture with a still of `request`, if both show the same view.
    fn compare(&mut self, scene: u32, request: &PathRequest, still: &Arc<FinishedFrame>) {
        let Some((rung, _, preview)) = self.previewed.take_if(|(_, of, _)| same_view(of, request))
        else {
            return;
        };
        let still = still.clone();
        self.tasks.spawn(async move {
            let compared = tokio::task::spawn_blocking(move || {
                let preview = Picture { rgb: &preview.bytes, size: preview.size };
                largest_difference(preview, Picture { rgb: &still.bytes, size: still.size })
            });
            Outcome::Compared { scene, rung, off: compared.await.unwrap_or(f32::NAN) }
        });
    }
}

/// Whether two requests show the same volume, view and colours; size and quality may differ.
fn same_view(a: &PathRequest, b: &PathRequest) -> bool {
    let path = ViewPath { size: b.path.size, ..a.path.clone() };
    (&a.volume, &a.transfer, a.background, path)
        == (&b.volume, &b.transfer, b.background, b.path.clone())
}
