//! One pass: from view and scene to a request, its frame, and its tiles.

use crate::messages::{Scene, View};
use crate::preview::{RUNGS, Setting};
use crate::problem::Problem;
use crate::shared::{LIVE_EDGE, LIVE_PIXELS, Shared};
use crate::slot::{Pair, Pass};
use crate::tile::{Codecs, Encoded, encode};
use crate::volume::Shown;
use serde_json::{Value, json};
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{InvalidField, Keep, Quality, Work};
use slabcast_common::stats::{FrameMs, FrameStats};
use slabcast_master::jobs::FinishedFrame;
use slabcast_master::library::Viewer;
use slabcast_scene::document::{black, still_path};
use slabcast_scene::path::ViewPath;
use slabcast_scene::request::PathRequest;
use slabcast_scene::values::as_read_from_file;
use std::sync::Arc;
use std::time::Instant;

/// Samples of a volume of which all bricks are cut while its transfer function is being edited, so
/// that an edit which shows other values cuts none. 64 Mi take some 250 MiB.
const KEPT_SAMPLES: usize = 64 << 20;

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

/// What a pass needs to be drawn.
pub(crate) struct Order {
    pub(crate) pair: Pair,
    pub(crate) pass: Pass,
    pub(crate) request: PathRequest,
    pub(crate) codecs: Codecs,
    /// The frame, if it was drawn before.
    pub(crate) frame: Option<Arc<FinishedFrame>>,
}

/// Returns the request that draws a pair. `edited`: the scene is being changed.
pub(crate) fn request_of(
    shown: &Shown,
    view: &View,
    scene: &Scene,
    (pass, rung): (Pass, usize),
    edited: bool,
) -> PathRequest {
    let Setting { level, divisor } = RUNGS[rung];
    let size = view.size.map(|n| n.div_ceil(divisor).max(1));
    let info = shown.info();
    let level = match (rung, shown.is_large) {
        (0, true) => LevelChoice::Auto,
        _ => LevelChoice::At(level),
    };
    let transfer = scene.tf.clone().unwrap_or_else(|| shown.home_tf.clone());
    let is_small = info.lattice.len() <= KEPT_SAMPLES;
    let keep = Keep { empty: edited && is_small, ..Keep::default() };
    let background = match scene.background {
        // Live pictures are opaque.
        Background::Transparent => black(),
        colour @ Background::Colour(_) => colour,
    };
    PathRequest {
        client_key: String::new(),
        volume: shown.choice(),
        level,
        path: path_of(view, scene, size),
        transfer: as_read_from_file(transfer, info),
        quality: Quality::default(),
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
    let mut drawing = shared.handle.draw(request, session, viewer).await?;
    let submitted_ms = ms(began);
    let frame = drawing.finished().await.map_err(|reason| Problem::new("internal", reason))?;
    let scheduled = frame.stats.ms;
    tracing::debug!(session, submitted_ms, whole_ms = ms(began), ?scheduled, "live pass drawn");
    Ok(frame)
}

/// Draws and encodes a pass.
///
/// # Errors
/// Those of [`frame_of`].
pub(crate) async fn draw(
    shared: Arc<Shared>,
    order: Order,
    session: u64,
    viewer: Viewer,
    asked_at: Instant,
) -> Result<Drawn, Problem> {
    let Order { pair, pass, request, codecs, frame } = order;
    let (began, wait) = (Instant::now(), ms(asked_at));
    let was_there = frame.is_some();
    let frame = match frame {
        Some(frame) => frame,
        None => frame_of(&shared, &request, session, viewer).await?,
    };
    // Bricks that had to be sent at first say nothing of the next frame.
    let FrameMs { distribute, overlap, .. } = frame.stats.ms;
    let draw_ms = ms(began);
    let steady_ms = (draw_ms - (distribute - overlap).max(0.0)).max(0.0);
    let encoding = Instant::now();
    let bound = if pass == Pass::Still { 0.0 } else { f32::NAN };
    let pixels = frame.clone();
    let encode = move || encode(&pixels.bytes, pixels.size, (pair, pass), codecs, bound);
    let encoded = tokio::task::spawn_blocking(encode).await;
    let encoded = encoded
        .map_err(|e| Problem::new("internal", e.to_string()))?
        .map_err(|e| Problem::new("internal", e))?;
    let bytes: usize = encoded.tiles.iter().map(bytes::Bytes::len).sum();
    let mut done = json!({
        "type": "done", "seq": pair.seq, "scene": pair.scene, "pass": pass.name(),
        "size": frame.size, "bytes": bytes,
        "ms": {"wait": wait, "draw": draw_ms, "encode": ms(encoding), "total": ms(asked_at)},
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
