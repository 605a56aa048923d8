//! Thumbnails: small pictures of presets and of jobs, drawn one by one while nothing else is.

use super::{Outcome, Session, text};
use crate::messages::Thumbs;
use crate::picture::{frame_of, path_of};
use crate::problem::Problem;
use crate::tile::thumb;
use axum::extract::ws::Message;
use serde_json::{Value, json};
use slabcast_common::ids::JobId;
use slabcast_common::image::PixelFormat;
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Keep, Quality, Work};
use slabcast_master::jobs::FinishedFrame;
use slabcast_scene::document::black;
use slabcast_scene::presets;
use slabcast_scene::request::PathRequest;
use slabcast_scene::transfer::TransferChoice;
use tokio::task::AbortHandle;

/// Edges of a thumbnail in pixels.
const EDGES: std::ops::RangeInclusive<u32> = 16..=192;

/// Names of one request.
const MOST_NAMES: usize = 64;

/// A request for thumbnails, and how far it is.
pub(super) struct Wanted {
    ask: Thumbs,
    next: usize,
    failed: Vec<Value>,
}

/// A thumbnail that is being drawn.
pub(super) struct InHand {
    pub(super) id: u32,
    of: String,
    pub(super) task: AbortHandle,
}

/// Checks a request.
fn check(ask: &Thumbs) -> Result<(), Problem> {
    let wrong = |text: String| Err(Problem::new("invalid_field", text));
    if !EDGES.contains(&ask.size) {
        let (least, most) = (EDGES.start(), EDGES.end());
        return wrong(format!("size: {}; give {least} to {most} pixels", ask.size));
    }
    if ask.names.is_empty() || ask.names.len() > MOST_NAMES {
        return wrong(format!("names: {} names; give 1 to {MOST_NAMES}", ask.names.len()));
    }
    if !["presets", "jobs"].contains(&ask.of.as_str()) {
        return wrong(format!("of: `{}`; give presets or jobs", ask.of));
    }
    Ok(())
}

impl Session {
    /// Takes a request. It replaces one of its kind.
    ///
    /// # Errors
    /// The request is wrong in itself.
    pub(super) fn want_thumbs(&mut self, ask: Thumbs) -> Result<(), Problem> {
        check(&ask)?;
        if self.thumb.as_ref().is_some_and(|thumb| thumb.of == ask.of) {
            self.drop_thumb();
        }
        self.thumbs.retain(|wanted| wanted.ask.of != ask.of);
        self.thumbs.push(Wanted { ask, next: 0, failed: Vec::new() });
        Ok(())
    }

    /// Stops the thumbnail that is being drawn; it is begun anew later.
    pub(super) fn drop_thumb(&mut self) {
        if let Some(thumb) = self.thumb.take() {
            thumb.task.abort();
        }
    }

    /// Begins the next thumbnail if nothing else is to be drawn.
    pub(super) fn next_thumb(&mut self) {
        if self.thumb.is_some() || !self.slot.is_at_rest() {
            return;
        }
        let (Some(wanted), Some(shown)) = (self.thumbs.first(), self.shown.clone()) else { return };
        let (ask, index) = (&wanted.ask, wanted.next);
        let (id, size, codecs) = (ask.id, ask.size, self.codecs);
        let name = ask.names[index].clone();
        let (shared, session, viewer) = (self.shared.clone(), self.id, self.viewer);
        let is_of_job = ask.of == "jobs";
        let mut view = self.view.clone();
        view.camera = ask.camera.clone().unwrap_or_else(|| shown.home.clone());
        let request = PathRequest {
            client_key: String::new(),
            volume: shown.choice(),
            level: LevelChoice::Auto,
            path: path_of(&view, &self.scene, [size; 2]),
            transfer: TransferChoice::Name(name.clone()),
            quality: Quality::default(),
            // All presets then draw from the same bricks.
            work: Work { keep: Keep { empty: true, ..Keep::default() }, ..Work::default() },
            format: PixelFormat::Rgb8,
            background: black(),
            want_trace: false,
            want_hash: false,
        };
        let task = self.tasks.spawn(async move {
            let place = (id, index as u32);
            let drawn = async {
                let frame = if is_of_job {
                    job_frame(&shared, &name)?
                } else if presets::NAMES.iter().chain(&presets::MAPS).any(|p| p.0 == name) {
                    frame_of(&shared, &request, session, viewer).await?
                } else {
                    return Err(Problem::field(&presets::unknown_name(&name)));
                };
                let encode = move || {
                    let (rgb, size) = if is_of_job {
                        shrunk(&frame, size)
                    } else {
                        (frame.bytes.to_vec(), frame.size)
                    };
                    thumb(&rgb, size, place, codecs)
                };
                let encoded = tokio::task::spawn_blocking(encode).await;
                encoded
                    .map_err(|e| Problem::new("internal", e.to_string()))?
                    .map_err(|e| Problem::new("internal", e))
            };
            let result = drawn.await.map(Message::Binary).map_err(|problem| problem.problem);
            Outcome::Thumb { id, result }
        });
        self.thumb = Some(InHand { id, of: ask.of.clone(), task });
    }

    /// Takes a thumbnail that was drawn, or not.
    pub(super) fn thumb_drawn(&mut self, id: u32, result: Result<Message, String>) {
        if self.thumb.take_if(|thumb| thumb.id == id).is_none() {
            return;
        }
        let Some(wanted) = self.thumbs.first_mut().filter(|wanted| wanted.ask.id == id) else {
            return;
        };
        let message = match result {
            Ok(message) => Some(message),
            Err(problem) => {
                let name = &wanted.ask.names[wanted.next];
                wanted.failed.push(json!({"name": name, "problem": problem}));
                None
            }
        };
        wanted.next += 1;
        let is_over = wanted.next == wanted.ask.names.len();
        self.send(message);
        if is_over {
            let wanted = self.thumbs.remove(0);
            let done = json!({"type": "thumbs_done", "id": id, "failed": wanted.failed});
            self.send(Some(text(&done)));
        }
    }
}

/// Returns the first kept frame of a job.
fn job_frame(
    shared: &crate::shared::Shared,
    name: &str,
) -> Result<std::sync::Arc<FinishedFrame>, Problem> {
    let number = name.strip_prefix("job-").and_then(|n| n.parse().ok()).map(JobId);
    let gone = || Problem::new("frame_not_kept", format!("{name} has no frame that is kept"));
    number.and_then(|job| shared.handle.kept_frame(job)).ok_or_else(gone)
}

/// Returns a frame as RGB of at most `edge` pixels each way: means of rectangles of its pixels, over
/// black.
fn shrunk(frame: &FinishedFrame, edge: u32) -> (Vec<u8>, [u32; 2]) {
    let [w, h] = frame.size.map(|n| n as usize);
    let k = (f64::from(edge) / w.max(h) as f64).min(1.0);
    let size = [w, h].map(|n| ((n as f64 * k).round() as usize).max(1));
    let step = frame.format.bytes();
    let pixel = |x: usize, y: usize| -> [f64; 3] {
        let bytes = &frame.bytes[(y * w + x) * step..][..step];
        let float =
            |c: usize| f64::from(f32::from_le_bytes(std::array::from_fn(|i| bytes[c * 4 + i])));
        std::array::from_fn(|c| match frame.format {
            PixelFormat::Rgb8 => f64::from(bytes[c]),
            PixelFormat::Rgba8 => f64::from(bytes[c]) * f64::from(bytes[3]) / 255.0,
            // The high bytes.
            PixelFormat::Rgba16 => f64::from(bytes[2 * c + 1]) * f64::from(bytes[7]) / 255.0,
            PixelFormat::Rgba32F => {
                255.0 * slabcast_common::math::srgb_from_linear(float(c).clamp(0.0, 1.0))
            }
        })
    };
    let mut rgb = Vec::with_capacity(size[0] * size[1] * 3);
    for y in 0..size[1] {
        let rows = y * h / size[1]..((y + 1) * h / size[1]).max(y * h / size[1] + 1);
        for x in 0..size[0] {
            let columns = x * w / size[0]..((x + 1) * w / size[0]).max(x * w / size[0] + 1);
            let n = (rows.len() * columns.len()) as f64;
            let mut sum = [0.0; 3];
            for row in rows.clone() {
                for column in columns.clone() {
                    let p = pixel(column, row);
                    (0..3).for_each(|c| sum[c] += p[c]);
                }
            }
            rgb.extend(sum.map(|c| (c / n).round() as u8));
        }
    }
    (rgb, size.map(|n| n as u32))
}
