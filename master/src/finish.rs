//! From finished sums to a picture, its hash, its bytes and its statistics.
//!
//! This runs on threads beside the driver (`finishers`), so that a frame is hashed and encoded
//! while the next one is rendered. Tiles that come finished are composed into its picture while
//! its other tiles are drawn.

use crate::jobs::{DrawnTile, FinishedFrame};
use sha2::{Digest, Sha256};
use slabcast_common::bounds;
use slabcast_common::brick::TightBox;
use slabcast_common::ids::{FrameId, JobId};
use slabcast_common::image::{
    Encoded, FrameAssembler, FrameState, Picture, PixelEncoding, PixelFormat, SparseTile,
};
use slabcast_common::level::LevelStats;
use slabcast_common::message::SceneSpec;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Classify, Quality};
use slabcast_common::stats::{BrickStats, ErrorStats, FrameStats, LeftOut};
use slabcast_common::view::{Projection, View};
use slabcast_common::volume::Digest32;
use slabcast_scene::request::PathRequest;
use slabcast_schedule::{Span, Spans};
use slabcast_volumes::BrickStore;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::mpsc;

/// A picture that finished tiles are composed into as they come.
pub(crate) struct Assembly {
    size: [u32; 2],
    finish: PixelEncoding,
    /// Tiles that came and are not in the picture yet.
    pending: Mutex<Vec<(Rect, SparseTile)>>,
    /// `None` before the first tile: allocating it takes the longer the larger it is, so the
    /// driver leaves that to a finisher.
    picture: Mutex<Option<FrameAssembler>>,
    /// Receiver of tiles before the picture is done; `None` for jobs of clients.
    tiles: Option<mpsc::Sender<DrawnTile>>,
}

impl Assembly {
    /// Returns an empty picture of `size` (width, height) pixels in the encoding `finish`. `tiles` receives
    /// tiles as they are composed; tiles for which the channel has no room are left out.
    pub(crate) fn new(
        size: [u32; 2],
        finish: PixelEncoding,
        tiles: Option<mpsc::Sender<DrawnTile>>,
    ) -> Assembly {
        Assembly { size, finish, pending: Mutex::default(), picture: Mutex::default(), tiles }
    }

    /// Adds tiles that are to be composed.
    pub(crate) fn add(&self, tiles: Vec<(Rect, SparseTile)>) {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner).extend(tiles);
    }

    /// Composes the tiles that came so far, and sends them to the receiver of tiles.
    ///
    /// # Panics
    /// If an earlier call panicked: its tiles are lost.
    pub(crate) fn compose(&self) {
        let placed = self.compose_into(&mut self.picture());
        self.tell(placed);
    }

    /// Sends tiles to the receiver, each as pixels over the background.
    fn tell(&self, placed: Vec<(Rect, SparseTile)>) {
        let Some(listener) = &self.tiles else { return };
        for (place, leaves) in placed {
            // A full channel holds nothing up: the whole picture comes later.
            let Ok(room) = listener.try_reserve() else { return };
            let size = leaves.size;
            let mut alone = FrameAssembler::new(size, &self.finish);
            alone.place(&[(Rect::from_size(size), leaves)]);
            room.send(DrawnTile { place, bytes: alone.into_bytes() });
        }
    }

    /// Returns the picture with all tiles that came.
    ///
    /// # Panics
    /// If an earlier call panicked: its tiles are lost.
    fn end(&self) -> FrameAssembler {
        let mut picture = self.picture();
        self.compose_into(&mut picture);
        picture.take().unwrap_or_else(|| FrameAssembler::new(self.size, &self.finish))
    }

    fn picture(&self) -> MutexGuard<'_, Option<FrameAssembler>> {
        self.picture.lock().expect("no finisher panicked while it composed this picture")
    }

    /// Composes the tiles that came so far, and returns them.
    fn compose_into(&self, picture: &mut Option<FrameAssembler>) -> Vec<(Rect, SparseTile)> {
        // Taken while the picture is locked, so that whoever ends the picture finds no tile that
        // another thread has taken and not composed.
        let mut pending = self.pending.lock().unwrap_or_else(PoisonError::into_inner);
        let tiles = std::mem::take(&mut *pending);
        drop(pending);
        picture.get_or_insert_with(|| FrameAssembler::new(self.size, &self.finish)).place(&tiles);
        tiles
    }
}

/// Everything that a finisher needs for one frame.
pub(crate) struct FrameSums {
    pub(crate) job: JobId,
    pub(crate) frame: FrameId,
    pub(crate) request: Arc<PathRequest>,
    pub(crate) scene: Arc<SceneSpec>,
    pub(crate) view: View,
    pub(crate) state: Box<FrameState>,
    /// The picture of tiles that came finished, if any did.
    pub(crate) assembly: Option<Arc<Assembly>>,
    pub(crate) stats: Box<FrameStats>,
    pub(crate) spans: Spans,
    /// The brick set that it was drawn from.
    pub(crate) store: Option<Arc<BrickStore>>,
    /// Whether workers rehearsed, so that nobody drew it.
    pub(crate) rehearsed: bool,
}

/// Returns the SHA-256 of everything that decides a frame's pixels: [`PIXELS_VERSION`], the
/// volume's digest, the cropping box (in voxels), transfer function, quality and view.
/// `Quality::cull` changes no pixel and is left out.
///
/// [`PIXELS_VERSION`]: slabcast_common::PIXELS_VERSION
pub fn view_sha256(scene: &SceneSpec, view: &View) -> Digest32 {
    let mut h = Sha256::new();
    h.update(b"slabcast view 1");
    h.update(slabcast_common::PIXELS_VERSION.to_le_bytes());
    h.update(scene.volume.digest.0);
    h.update(scene.transfer.to_json());
    let quality = Quality { cull: true, ..scene.quality };
    h.update(serde_json::to_string(&quality).expect("a quality has no map keys but strings"));
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
    for x in scene.crop.iter().flat_map(|c| c.lo.to_array().into_iter().chain(c.hi.to_array())) {
        h.update(x.to_le_bytes());
    }
    Digest32(h.finalize().into())
}

/// Writes the bounds that are known without a reference (docs/design/model.md section 6) into
/// `stats`, in 1/255. `within`: box of the voxels that are drawn; `max_alpha`: largest opacity of a
/// pixel.
fn error(
    stats: &mut ErrorStats,
    scene: &SceneSpec,
    view: &View,
    within: &TightBox,
    max_alpha: f64,
) {
    // A bound of 255 says nothing (16-bit sums, whose errors are a thousandth of it).
    let says = |bound: f64| Some(bound).filter(|&bound| bound < 255.0);
    let max_alpha = Some(max_alpha);
    stats.cutoff.bound = Some(bounds::cutoff(&scene.quality));
    if scene.quality.classify == Classify::After {
        // The other bounds are of voxels that are classified before they are splatted.
        stats.accumulation.bound = Some(bounds::accumulation(view, within));
        return;
    }
    stats.quantisation.bound = says(bounds::quantisation(scene, view, within));
    stats.accumulation.bound = Some(bounds::accumulation(view, within));
    stats.rounding.bound = bounds::rounding(scene, view, within, max_alpha).and_then(says);
    stats.truncation.bound = bounds::truncation(scene, view, within, max_alpha).and_then(says);
    // If solids hide everything behind them, a few pixels at their edges decide, and a sample
    // misses those.
    if max_alpha.is_some_and(|a| 1.0 - a < scene.quality.eps) {
        stats.truncation.estimate = None;
    }
}

/// Lists what the frame did not need, by name, with the bytes that it saved. Milliseconds are not
/// measured in passing: `slabcast lab explain` draws with and without.
///
/// Bytes of bricks are those of one copy; the master and each worker that needs them save one.
fn left_out(
    store: &BrickStore,
    scene: &SceneSpec,
    view: &View,
    request: &PathRequest,
    bricks: &BrickStats,
) -> Vec<LeftOut> {
    let (wanted, voxels) = (store.needs(), store.relevant_voxels());
    let all: u64 = scene.volume.lattice.dims.iter().map(|&n| u64::from(n)).product();
    // Stored voxels, with their index and their share of the brick's header.
    let bytes = |n: u64| (n as f64 * store.bytes() as f64 / voxels.max(1) as f64) as u64;
    let mut list = Vec::new();
    let mut put = |name: &str, saved_bytes: Option<u64>| {
        list.push(LeftOut { name: name.into(), saved_ms: None, saved_bytes });
    };
    if !wanted.keeps_invisible() {
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
    }
    if request.format == PixelFormat::Rgb8 {
        put("alpha", Some(view.size.iter().map(|&n| u64::from(n)).product()));
    }
    list
}

/// Returns stripes over the whole picture, so that a rehearsal is not taken for a picture.
fn marked(size: [u32; 2]) -> Picture {
    let [w, h] = size.map(|n| n as usize);
    let stripe = |i: usize| match (i % w + i / w) / 16 % 2 {
        0 => [1.0, 0.0, 1.0, 1.0],
        _ => [0.0, 0.0, 0.0, 1.0],
    };
    Picture { size, pixels: (0..w * h).map(stripe).collect() }
}

/// Encodes and hashes a frame, and completes its statistics.
pub(crate) fn finish(s: FrameSums) -> FinishedFrame {
    let (size, finish) = (s.state.size(), s.request.encoding());
    let max_alpha = f64::from(s.state.max_alpha());
    let Encoded { sha256, bytes } = if s.rehearsed {
        Encoded { sha256: None, bytes: marked(size).encode(finish.format, finish.background) }
    } else if let Some(assembly) = &s.assembly {
        s.state.encode_onto(assembly.end())
    } else {
        s.state.encode(&finish, s.request.want_hash)
    };
    let mut stats = *s.stats;
    // The scheduler counts the frames of a job from 0; statistics count those of the whole path.
    let number = stats.frame;
    stats.frame += s.request.path.first_frame() as u64;
    if let Some(path) = &mut stats.critical_path {
        *path = format!("frame {}: {path}", stats.frame);
    }
    stats.view_sha256 = view_sha256(&s.scene, &s.view).to_string();
    stats.pixels_sha256 = sha256.map_or_else(String::new, |hash| hash.to_string());
    if s.rehearsed {
        stats.rehearsed = true;
        stats.pixels_sha256 = "none: rehearsed".into();
    }
    stats.pixels_version = slabcast_common::PIXELS_VERSION;
    stats.level = Some(LevelStats::of(&s.scene.volume, &s.view));
    let within = s.store.as_ref().and_then(|store| store.extent());
    let within = within.unwrap_or_else(|| TightBox::whole(s.scene.volume.lattice.dims));
    error(&mut stats.error, &s.scene, &s.view, &within, max_alpha);
    stats.left_out = match &s.store {
        Some(store) => left_out(store, &s.scene, &s.view, &s.request, &stats.bricks),
        None => Vec::new(),
    };
    FinishedFrame {
        number,
        size,
        format: finish.format,
        bytes: bytes.into(),
        stats_json: serde_json::to_string(&stats).expect("statistics have no map keys but strings"),
        trace_json: s.request.want_trace.then(|| chrome_trace(&s.spans.to_vec(), s.job, s.frame)),
        stats,
    }
}

/// Returns spans as a JSON array of Chrome trace events: one process for the master and one for
/// each worker, all on the master's clock (microseconds).
fn chrome_trace(spans: &[Span], job: JobId, frame: FrameId) -> String {
    let mut names: Vec<&str> = spans.iter().filter_map(|s| s.worker.as_deref()).collect();
    names.sort_unstable();
    names.dedup();
    let process = |worker: Option<&str>| {
        // Process ids are hashes of names, so that a worker has one id in all frames of a job.
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
