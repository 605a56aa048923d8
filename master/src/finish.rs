//! From finished sums to a picture, its hash, its bytes and its statistics.
//!
//! This runs on threads of their own beside the driver, so that a frame is hashed and encoded
//! while the next one is rendered. Tiles that come finished are laid into its picture while others
//! of it are drawn.

use crate::jobs::FinishedFrame;
use sha2::{Digest, Sha256};
use slabcast_common::bounds;
use slabcast_common::brick::TightBox;
use slabcast_common::ids::{FrameId, JobId};
use slabcast_common::image::{Encoded, FrameState, Picture, PixelFormat};
use slabcast_common::leaves::{Finish, Leaves, Mosaic};
use slabcast_common::message::{PathRequest, SceneSpec};
use slabcast_common::occlusion::Rect;
use slabcast_common::path::CropBox;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::stats::{BrickStats, ErrorStats, FrameStats, LeftOut};
use slabcast_common::view::{Projection, View};
use slabcast_common::volume::Digest32;
use slabcast_schedule::{Span, Spans};
use slabcast_volumes::BrickStore;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// What finishers do.
pub(crate) enum Chore {
    /// Lays tiles into the picture of a frame of which others are drawn yet.
    Lay(Arc<Laying>),
    /// Makes the frame.
    Finish(FrameId, Box<FrameSums>),
}

/// A picture that finished tiles are laid into as they come.
pub(crate) struct Laying {
    size: [u32; 2],
    finish: Finish,
    coming: Mutex<Vec<(Rect, Leaves)>>,
    /// `None` before it was begun; not by the driver, since that takes as long as it is large.
    picture: Mutex<Option<Mosaic>>,
}

impl Laying {
    pub(crate) fn new(size: [u32; 2], finish: Finish) -> Laying {
        Laying { size, finish, coming: Mutex::default(), picture: Mutex::default() }
    }

    /// Tiles that are to be laid.
    pub(crate) fn add(&self, tiles: Vec<(Rect, Leaves)>) {
        locked(&self.coming).extend(tiles);
    }

    /// Lays those that came so far.
    pub(crate) fn lay(&self) {
        self.lay_into(&mut locked(&self.picture));
    }

    fn lay_into(&self, picture: &mut Option<Mosaic>) {
        // Behind the picture's lock: who ends it finds none that another has taken and not laid.
        let tiles = std::mem::take(&mut *locked(&self.coming));
        picture.get_or_insert_with(|| Mosaic::new(self.size, &self.finish)).lay(&tiles);
    }

    /// The picture, with all that came.
    fn end(&self) -> Mosaic {
        let mut picture = locked(&self.picture);
        self.lay_into(&mut picture);
        picture.take().unwrap_or_else(|| Mosaic::new(self.size, &self.finish))
    }
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Everything that makes a frame.
pub(crate) struct FrameSums {
    pub(crate) job: JobId,
    pub(crate) frame: FrameId,
    pub(crate) request: Arc<PathRequest>,
    pub(crate) scene: Arc<SceneSpec>,
    pub(crate) crop: Option<CropBox>,
    pub(crate) view: View,
    pub(crate) state: Box<FrameState>,
    /// Where tiles that came before are laid.
    pub(crate) laying: Option<Arc<Laying>>,
    pub(crate) stats: Box<FrameStats>,
    pub(crate) spans: Spans,
    /// Where its bricks come from.
    pub(crate) store: Option<Arc<BrickStore>>,
    /// Nobody drew it.
    pub(crate) rehearsed: bool,
}

/// Hash of everything that decides a frame's pixels: volume, cropping box, transfer function,
/// quality, view.
pub fn view_sha256(scene: &SceneSpec, crop: Option<&CropBox>, view: &View) -> Digest32 {
    let mut h = Sha256::new();
    h.update(b"slabcast view 1");
    h.update(slabcast_common::PIXELS_VERSION.to_le_bytes());
    h.update(scene.volume.digest.0);
    h.update(scene.transfer.to_json());
    // Neither changes a byte.
    let quality = Quality { cull: true, grey: true, ..scene.quality };
    h.update(serde_json::to_string(&quality).unwrap_or_default());
    h.update(view.size[0].to_le_bytes());
    h.update(view.size[1].to_le_bytes());
    let projection = match view.projection {
        slabcast_common::view::Projection::Ortho { scale } => [0.0, scale, 0.0],
        slabcast_common::view::Projection::Persp { focal, distance } => [1.0, focal, distance],
    };
    let numbers = view
        .eye_from_index
        .to_cols_array()
        .into_iter()
        .chain(view.eye_origin.to_array())
        .chain(view.eye_from_world.to_cols_array())
        .chain(view.kernel_std.to_array())
        .chain(view.kernel_radius.to_array())
        .chain(view.kernel_lean.to_array())
        .chain(projection)
        .chain([view.thickness, view.cell]);
    for x in numbers {
        h.update(x.to_le_bytes());
    }
    for x in crop.into_iter().flat_map(|c| c.lo.to_array().into_iter().chain(c.hi.to_array())) {
        h.update(x.to_le_bytes());
    }
    Digest32(h.finalize().into())
}

/// The bounds that are known without a reference (DESIGN.md section 5), in 1/255; `within`: where voxels
/// are, `alpha_most`: the largest opacity of a pixel.
fn error(
    stats: &mut ErrorStats,
    scene: &SceneSpec,
    view: &View,
    within: &TightBox,
    alpha_most: f64,
) {
    // Above 255 one says nothing (16-bit sums, whose errors are a thousandth of it).
    let says = |bound: f64| Some(bound).filter(|&bound| bound < 255.0);
    let alpha_most = Some(alpha_most);
    stats.cutoff.bound = Some(bounds::cutoff(&scene.quality));
    stats.quantisation.bound = says(bounds::quantisation(scene, view, within));
    stats.accumulation.bound = Some(bounds::accumulation(view, within));
    stats.rounding.bound = bounds::rounding(scene, view, within, alpha_most).and_then(says);
    stats.truncation.bound = bounds::truncation(scene, view, within, alpha_most).and_then(says);
    // Where solids hide what is behind, few pixels at their edges decide, and a sample misses them.
    if alpha_most.is_some_and(|a| 1.0 - a < scene.quality.eps) {
        stats.truncation.estimate = None;
    }
}

/// What the frame did not need, by name, with the bytes that it saved. Milliseconds are not measured
/// in passing: `slabcast explain` draws with and without.
///
/// Of bricks the bytes are those of one copy: the master's, and each worker's that holds them.
fn left_out(
    store: &BrickStore,
    scene: &SceneSpec,
    view: &View,
    request: &PathRequest,
    bricks: &BrickStats,
) -> Vec<LeftOut> {
    let (wanted, voxels) = (store.wanted(), store.relevant_voxels());
    let all: u64 = scene.volume.lattice.dims.iter().map(|&n| u64::from(n)).product();
    // Of voxels as they are stored, their place and their brick's head included.
    let bytes = |n: u64| (n as f64 * store.bytes() as f64 / voxels.max(1) as f64) as u64;
    let mut list = Vec::new();
    let mut put = |name: &str, saved_bytes: Option<u64>| {
        list.push(LeftOut { name: name.into(), saved_ms: None, saved_bytes });
    };
    if !wanted.keeps_empty() {
        put("empty", Some(bytes(all.saturating_sub(voxels))));
    }
    if bricks.needed < bricks.relevant {
        put("hidden", Some(bytes(voxels.saturating_sub(bricks.needed_voxels))));
    }
    if !wanted.normals {
        put("normals", Some(2 * voxels));
    }
    if !wanted.gradients {
        put("gradients", Some(voxels));
    }
    if matches!(view.projection, Projection::Ortho { .. }) {
        put("scale", None);
        let whole = matches!(scene.quality.sums, Sums::I32 | Sums::Auto);
        let plain = scene.transfer.gradient_opacity.is_empty();
        if scene.quality.grey && whole && plain && scene.transfer.is_grey() {
            put("colour", None);
        }
    }
    if request.format == PixelFormat::Rgb8 {
        put("alpha", Some(view.size.iter().map(|&n| u64::from(n)).product()));
    }
    list
}

/// Stripes over the whole picture: what was not drawn is not to be taken for a picture.
fn marked(size: [u32; 2]) -> Picture {
    let [w, h] = size.map(|n| n as usize);
    let stripe = |i: usize| match (i % w + i / w) / 16 % 2 {
        0 => [1.0, 0.0, 1.0, 1.0],
        _ => [0.0, 0.0, 0.0, 1.0],
    };
    Picture { size, pixels: (0..w * h).map(stripe).collect() }
}

/// Makes the frame.
pub(crate) fn finish(s: FrameSums) -> FinishedFrame {
    let (size, finish) = (s.state.size(), s.request.finish());
    let alpha_most = f64::from(s.state.alpha_most());
    let Encoded { sha256, bytes } = if s.rehearsed {
        Encoded { sha256: None, bytes: marked(size).encode(finish.format, finish.background) }
    } else if let Some(laying) = &s.laying {
        s.state.encode_on(laying.end())
    } else {
        s.state.encode(&finish, s.request.want_hash)
    };
    let mut stats = *s.stats;
    // Frames of a job count from its first; people count those of the path.
    let number = stats.frame;
    stats.frame += s.request.path.first_frame() as u64;
    if let Some(path) = &mut stats.critical_path {
        *path = format!("frame {}: {path}", stats.frame);
    }
    stats.view_sha256 = view_sha256(&s.scene, s.crop.as_ref(), &s.view).to_string();
    stats.pixels_sha256 = sha256.map_or_else(String::new, |hash| hash.to_string());
    if s.rehearsed {
        stats.rehearsed = true;
        stats.pixels_sha256 = "none: rehearsed".into();
    }
    stats.pixels_version = slabcast_common::PIXELS_VERSION;
    let within = s.store.as_ref().and_then(|store| store.extent());
    let within = within.unwrap_or_else(|| TightBox::whole(s.scene.volume.lattice.dims));
    error(&mut stats.error, &s.scene, &s.view, &within, alpha_most);
    stats.left_out = match &s.store {
        Some(store) => left_out(store, &s.scene, &s.view, &s.request, &stats.bricks),
        None => Vec::new(),
    };
    FinishedFrame {
        number,
        size,
        format: finish.format,
        bytes: bytes.into(),
        stats_json: serde_json::to_string(&stats).unwrap_or_default(),
        trace_json: s.request.want_trace.then(|| chrome_trace(&s.spans.to_vec(), s.job, s.frame)),
        stats,
    }
}

/// Spans as an array of Chrome trace events: one process for the master and one a worker, all
/// on the master's clock (microseconds).
fn chrome_trace(spans: &[Span], job: JobId, frame: FrameId) -> String {
    let mut names: Vec<&str> = spans.iter().filter_map(|s| s.worker.as_deref()).collect();
    names.sort_unstable();
    names.dedup();
    let process = |worker: Option<&str>| {
        // Process ids follow the names, so that every frame of a job gives a worker the same.
        worker.map_or(1, |w| {
            let mut h = 0xcbf2_9ce4u32;
            for b in w.bytes() {
                h = (h ^ u32::from(b)).wrapping_mul(0x0100_0193);
            }
            2 + (h >> 8)
        })
    };
    let mut events: Vec<serde_json::Value> = std::iter::once(None)
        .chain(names.iter().copied().map(Some))
        .map(|worker| {
            serde_json::json!({
                "name": "process_name", "ph": "M", "pid": process(worker), "tid": 0,
                "args": { "name": worker.unwrap_or("master") }
            })
        })
        .collect();
    for s in spans {
        let mut args: serde_json::Map<String, serde_json::Value> =
            s.args.iter().map(|(k, v)| ((*k).to_string(), v.clone().into())).collect();
        args.insert("job".into(), job.to_string().into());
        args.insert("frame".into(), frame.to_string().into());
        events.push(serde_json::json!({
            "name": s.name, "cat": s.category, "ph": "X", "ts": s.start,
            "dur": s.end.saturating_sub(s.start), "pid": process(s.worker.as_deref()),
            "tid": s.thread, "args": args
        }));
    }
    serde_json::Value::Array(events).to_string()
}
