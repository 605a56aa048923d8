//! One pass: from view and scene to a request, its frame, and its tiles.

use crate::blocks::Blocks;
use crate::messages::{Scene, View};
use crate::preview::{RUNGS, SLOW_MS};
use crate::problem::Problem;
use crate::shared::{LIVE_EDGE, LIVE_PIXELS, Shared};
use crate::slot::{Pair, Pass};
use crate::tile::{Codecs, Encoded, encode, encode_parts, encode_rest};
use crate::volume::Shown;
use serde_json::{Value, json};
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{InvalidField, Keep, Quality, Work};
use slabcast_common::stats::{FrameMs, FrameStats};
use slabcast_master::jobs::{DrawnTile, FinishedFrame};
use slabcast_master::library::Viewer;
use slabcast_scene::document::{black, still_path};
use slabcast_scene::path::ViewPath;
use slabcast_scene::request::PathRequest;
use slabcast_scene::values::as_read_from_file;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

/// Most samples of a level whose bricks are all cut while a transfer function is edited, so that an edit
/// which makes other values visible needs no new bricks. 64 Mi samples take some 250 MiB.
const KEPT_SAMPLES: usize = 64 << 20;

/// Returns the finest level with at most [`KEPT_SAMPLES`] samples of a volume with `samples` at level 0.
fn level_kept(samples: usize) -> u32 {
    // Each level has an eighth of the samples of the one before.
    (0..).find(|level| samples >> (3 * level).min(63) <= KEPT_SAMPLES).unwrap_or(0)
}

/// Shortest time between two batches of a still's tiles: each is some frames of a screen, and of a
/// hundred small tiles one large one is made.
const BATCH: Duration = Duration::from_millis(50);

/// Drawn tiles that wait for encoding; later ones are sent when the picture is done. Tiles of 64x64 pixels
/// take 3 MiB.
const TILES_WAITING: usize = 256;

/// Checks the size of a live picture.
///
/// # Errors
/// Names `size`.
pub(crate) fn check_size([w, h]: [u32; 2]) -> Result<(), InvalidField> {
    let pixels = u64::from(w) * u64::from(h);
    if w == 0 || h == 0 || w > LIVE_EDGE || h > LIVE_EDGE || pixels > LIVE_PIXELS {
        let problem = format!(
            "{w}x{h}; give 1 to {LIVE_EDGE} pixels each way, and {} MiPx in all at most",
            LIVE_PIXELS >> 20
        );
        return Err(InvalidField::new("size", problem));
    }
    Ok(())
}

/// Returns the path of a pair.
pub(crate) fn path_of(view: &View, scene: &Scene, size: [u32; 2]) -> ViewPath {
    still_path(&view.camera, size, scene.crop, [scene.up, scene.front])
}

/// Order to draw one pass: its request, and the encodings that the client reads.
pub(crate) struct Order {
    pub(crate) pair: Pair,
    pub(crate) pass: Pass,
    /// How far its pixels may be off the still's, as a share of full scale; NaN if unknown.
    pub(crate) bound: f32,
    pub(crate) request: PathRequest,
    pub(crate) codecs: Codecs,
    /// The frame, if it was drawn before.
    pub(crate) frame: Option<Arc<FinishedFrame>>,
    /// Number of the pass, and where its tiles go that are sent before it is drawn.
    pub(crate) number: u64,
    pub(crate) early: mpsc::Sender<Early>,
}

/// Tiles of a still that is being drawn.
pub(crate) struct Early {
    /// Number of the pass.
    pub(crate) number: u64,
    /// Tiles as they are sent.
    pub(crate) tiles: Vec<bytes::Bytes>,
}

/// Blocks and bytes of a still that were sent before its frame was done.
struct Sent {
    blocks: Blocks,
    bytes: usize,
}

/// Returns the request that draws a pair. `edited`: the scene is being changed.
pub(crate) fn request_of(
    shown: &Shown,
    view: &View,
    scene: &Scene,
    (pass, rung): (Pass, usize),
    edited: bool,
) -> PathRequest {
    let setting = RUNGS[rung];
    let info = shown.info();
    let kept = if edited { level_kept(info.lattice.len()) } else { 0 };
    let level = match shown.is_large {
        true => LevelChoice::Auto,
        false => LevelChoice::At(setting.level.max(kept)),
    };
    let transfer = scene.tf.clone().unwrap_or_else(|| shown.home_tf.clone());
    let keep = Keep { empty: edited && !shown.is_large, ..Keep::default() };
    let usual = Quality::default();
    let quality = Quality { thickness: setting.thickness.unwrap_or(usual.thickness), ..usual };
    let background = match scene.background {
        // Live pictures are opaque.
        Background::Transparent => black(),
        colour @ Background::Colour(_) => colour,
    };
    PathRequest {
        client_key: String::new(),
        volume: shown.choice(),
        level,
        path: path_of(view, scene, setting.size(view.size)),
        transfer: as_read_from_file(transfer, info),
        quality,
        // A still says how far it may be off, which costs up to a quarter of its time.
        work: Work { keep, estimate: pass == Pass::Still, ..Work::default() },
        format: PixelFormat::Rgb8,
        background,
        want_trace: false,
        want_hash: false,
    }
}

/// A pass that was drawn and encoded.
pub(crate) struct Drawn {
    pub(crate) frame: Arc<FinishedFrame>,
    pub(crate) encoded: Encoded,
    /// The message `done`.
    pub(crate) done: Value,
    /// Milliseconds of drawing without those in which bricks came alone; `None` if the frame was there.
    pub(crate) steady_ms: Option<f64>,
}

fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Draws the frame of a request for a live session.
///
/// # Errors
/// The request is refused, or its frame failed.
pub(crate) async fn frame_of(
    shared: &Shared,
    request: &PathRequest,
    session: u64,
    viewer: Viewer,
) -> Result<Arc<FinishedFrame>, Problem> {
    let request = PathRequest { client_key: shared.fresh_key(), ..request.clone() };
    let began = Instant::now();
    let mut drawing = shared.handle.draw(request, session, viewer, None).await?;
    let submitted_ms = ms(began);
    let frame = drawing.finished().await.map_err(|reason| Problem::new("internal", reason))?;
    let scheduled = frame.stats.ms;
    tracing::debug!(session, submitted_ms, whole_ms = ms(began), ?scheduled, "live pass drawn");
    Ok(frame)
}

/// Draws the frame of a still. If that takes longer than [`SLOW_MS`], its tiles are encoded and sent on
/// while others are drawn.
///
/// # Errors
/// The request is refused, its frame failed, or an encoder refuses the pixels.
async fn still_of(
    shared: &Shared,
    order: &Order,
    session: u64,
    viewer: Viewer,
) -> Result<(Arc<FinishedFrame>, Option<Sent>), Problem> {
    let (pair, codecs) = (order.pair, order.codecs);
    let request = PathRequest { client_key: shared.fresh_key(), ..order.request.clone() };
    let size = request.path.size;
    let mut next = tokio::time::Instant::now() + Duration::from_millis(SLOW_MS as u64);
    let (drawn, mut tiles) = mpsc::channel::<DrawnTile>(TILES_WAITING);
    let mut drawing = shared.handle.draw(request, session, viewer, Some(drawn)).await?;
    let mut sent = Sent { blocks: Blocks::new(size), bytes: 0 };
    let (mut came, mut more_come) = (Vec::new(), true);
    loop {
        tokio::select! {
            biased;
            frame = drawing.finished() => {
                let frame = frame.map_err(|reason| Problem::new("internal", reason))?;
                return Ok((frame, sent.blocks.has_sent().then_some(sent)));
            }
            count = tiles.recv_many(&mut came, TILES_WAITING), if more_come => {
                more_come = count > 0;
                for DrawnTile { place, bytes } in came.drain(..) {
                    sent.blocks.add(place, &bytes);
                }
            }
            () = tokio::time::sleep_until(next), if sent.blocks.has_ready() => {
                // Whoever reads slowly gets the rest at the end.
                if let Ok(place) = order.early.try_reserve() {
                    let encode = move || {
                        let is_first = !sent.blocks.has_sent();
                        let parts = sent.blocks.take();
                        let (parts, of) = ((&parts[..], is_first), (pair, Pass::Still));
                        let tiles = encode_parts(sent.blocks.rgb(), size, parts, of, codecs, 0.0)?;
                        sent.bytes += tiles.iter().map(bytes::Bytes::len).sum::<usize>();
                        Ok((sent, tiles))
                    };
                    let tiles;
                    (sent, tiles) = encoding(encode).await?;
                    place.send(Early { number: order.number, tiles });
                }
                next = tokio::time::Instant::now() + BATCH;
            }
        }
    }
}

/// Encodes on a thread for what takes long.
async fn encoding<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, String> + Send + 'static,
) -> Result<T, Problem> {
    let encoded = tokio::task::spawn_blocking(work).await;
    encoded
        .map_err(|e| Problem::new("internal", e.to_string()))?
        .map_err(|e| Problem::new("internal", e))
}

/// Draws and encodes a pass.
///
/// # Errors
/// The request is refused, its frame failed, or an encoder refuses the pixels.
pub(crate) async fn draw(
    shared: Arc<Shared>,
    order: Order,
    session: u64,
    viewer: Viewer,
    asked_at: Instant,
) -> Result<Drawn, Problem> {
    let (pair, pass, codecs) = (order.pair, order.pass, order.codecs);
    let (began, wait) = (Instant::now(), ms(asked_at));
    let was_there = order.frame.is_some();
    let (frame, sent) = match &order.frame {
        Some(frame) => (frame.clone(), None),
        None if pass == Pass::Still => still_of(&shared, &order, session, viewer).await?,
        None => (frame_of(&shared, &order.request, session, viewer).await?, None),
    };
    // Bricks that had to be cut and sent at first say nothing of the next frame. They are cut before its
    // time begins.
    let FrameMs { total, distribute, overlap, .. } = frame.stats.ms;
    let draw_ms = ms(began);
    let steady_ms = (total - (distribute - overlap).max(0.0)).max(0.0);
    let encoding_began = Instant::now();
    let bound = order.bound;
    let pixels = frame.clone();
    let early_bytes = sent.as_ref().map_or(0, |sent| sent.bytes);
    let encode = move || {
        let (rgb, size) = (&pixels.bytes[..], pixels.size);
        match sent.and_then(|sent| sent.blocks.rest(rgb)) {
            Some(parts) => encode_rest(rgb, size, &parts, pair, codecs),
            // Where sent tiles are not true the pass begins anew.
            None => encode(rgb, size, (pair, pass), codecs, bound),
        }
    };
    let encoded = encoding(encode).await?;
    let bytes = early_bytes + encoded.tiles.iter().map(bytes::Bytes::len).sum::<usize>();
    let mut done = json!({
        "type": "done", "seq": pair.seq, "scene": pair.scene, "pass": pass.name(),
        "size": frame.size, "bytes": bytes,
        "ms": {"wait": wait, "draw": draw_ms, "encode": ms(encoding_began), "total": ms(asked_at)},
    });
    if let Some(sha256) = &encoded.sha256 {
        done["sha256"] = sha256.as_str().into();
    }
    tell_statistics(&mut done, &frame.stats);
    Ok(Drawn { frame, encoded, done, steady_ms: (!was_there).then_some(steady_ms) })
}

/// Adds what a page tells of a frame to its `done`.
fn tell_statistics(done: &mut Value, stats: &FrameStats) {
    let error = &stats.error;
    let entry = |bound: Option<f64>, estimate: Option<f64>| match (bound, estimate) {
        (Some(value), Some(_)) => json!({"value": value, "kind": "both"}),
        (Some(value), None) => json!({"value": value, "kind": "bound"}),
        (None, Some(value)) => json!({"value": value, "kind": "estimate"}),
        (None, None) => Value::Null,
    };
    done["view_sha256"] = stats.view_sha256.as_str().into();
    done["level"] = stats.level.map_or(0, |level| level.level).into();
    done["thickness"] = stats.quality.thickness.into();
    done["error"] = json!({
        "thickness": entry(None, error.thickness.estimate),
        "cutoff": entry(error.cutoff.bound, None),
        "quantisation": entry(error.quantisation.bound, None),
        "rounding": entry(error.rounding.bound, error.rounding.estimate),
        "truncation": entry(error.truncation.bound, error.truncation.estimate),
        "ripple": entry(None, error.ripple.estimate),
    });
    done["left_out"] = stats
        .left_out
        .iter()
        .map(|left| {
            json!({"name": left.name, "saved_ms": left.saved_ms, "saved_bytes": left.saved_bytes})
        })
        .collect();
    done["workers"] = stats.workers.len().into();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_bricks_are_kept_of_a_level_that_fits() {
        assert_eq!(level_kept(256 * 256 * 256), 0);
        assert_eq!(level_kept(KEPT_SAMPLES), 0);
        assert_eq!(level_kept(KEPT_SAMPLES + 1), 1);
        assert_eq!(level_kept(512 * 512 * 275), 1);
        assert_eq!(level_kept(2048 * 2048 * 2048), 3);
    }
}
