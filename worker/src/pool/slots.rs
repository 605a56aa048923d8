//! Scenes and frames as render threads share them. The first thread that needs a table of one
//! makes it.

use slabcast_common::ids::FrameId;
use slabcast_common::image::PixelEncoding;
use slabcast_common::message::SceneSpec;
use slabcast_common::view::View;
use slabcast_render::judge::error_probe::{ErrorProbe, ThicknessPair};
use slabcast_render::visibility::ClosingDepths;
use slabcast_render::visibility::{Directory, VisibleBricks};
use slabcast_render::{Frame, Scene};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Instant;

/// A scene.
pub(crate) struct SceneSlot {
    pub(crate) spec: Arc<SceneSpec>,
    scene: OnceLock<Arc<Scene>>,
    /// Depths at which pixels of the last pictures closed, by picture size. Prefetch goes by them.
    depths: Mutex<BTreeMap<[u32; 2], Arc<ClosingDepths>>>,
    /// Corners of the picture parts that were rehearsed (rehearsal only).
    pub(crate) parts: Mutex<BTreeSet<[i32; 2]>>,
    /// Two thicknesses whose difference tells the error of sheets; `None` where sheets can't be
    /// thinner.
    pair: OnceLock<Option<ThicknessPair>>,
    /// The frame of which a thread took a region first.
    pub(super) first: OnceLock<FrameId>,
}

impl SceneSlot {
    pub(crate) fn new(spec: Arc<SceneSpec>) -> Self {
        let (scene, depths, parts, pair, first) = Default::default();
        SceneSlot { spec, scene, depths, parts, pair, first }
    }
}

/// A frame.
pub(crate) struct FrameSlot {
    pub(crate) scene: Arc<SceneSlot>,
    pub(crate) view: View,
    /// Format and background for regions that are finished here; `None`: their sums are sent.
    pub(crate) finish: Option<PixelEncoding>,
    /// Whether results are sent as they are, not packed (rehearsal only).
    pub(crate) plain: bool,
    /// Number of the client that asked for the frame. Clients get equal thread time.
    pub(crate) client: u64,
    frame: OnceLock<Frame>,
    probe: OnceLock<ErrorProbe>,
    visible: OnceLock<VisibleBricks>,
    depths: OnceLock<Arc<ClosingDepths>>,
    /// Index of the frame in the trace (rehearsal only).
    pub(crate) rehearsed: OnceLock<Option<usize>>,
    /// When its tables are made (rehearsal only).
    pub(crate) made: OnceLock<Instant>,
    /// Blocks of bricks that its tiles opened (rehearsal only).
    pub(crate) held: Mutex<BTreeSet<u32>>,
    /// Whether the master has ended the frame: its tasks are dropped, regions that are being drawn
    /// at their next sheet.
    pub(crate) has_ended: AtomicBool,
}

impl FrameSlot {
    pub(crate) fn new(
        scene: Arc<SceneSlot>,
        view: View,
        finish: Option<PixelEncoding>,
        plain: bool,
        client: u64,
    ) -> Self {
        let (frame, probe, visible, depths, rehearsed, made, held, has_ended) = Default::default();
        FrameSlot {
            scene,
            view,
            finish,
            plain,
            client,
            frame,
            probe,
            visible,
            depths,
            rehearsed,
            made,
            held,
            has_ended,
        }
    }

    /// The frame's tables.
    pub(super) fn get(&self) -> &Frame {
        self.frame.get_or_init(|| {
            let scene = self.scene.scene.get_or_init(|| Arc::new(Scene::new(&self.scene.spec)));
            Frame::new(scene.clone(), self.view)
        })
    }

    /// The directory's bricks that the frame sees. Each frame has one directory.
    pub(super) fn visible_bricks(&self, directory: &Arc<Directory>) -> &VisibleBricks {
        self.visible.get_or_init(|| VisibleBricks::new(&self.get().view, directory))
    }

    /// Depths at which pixels of this scene's pictures of this size closed.
    pub(super) fn depths(&self) -> &ClosingDepths {
        self.depths.get_or_init(|| {
            let size = self.view.size;
            let mut all = locked(&self.scene.depths);
            all.entry(size).or_insert_with(|| Arc::new(ClosingDepths::new(size))).clone()
        })
    }

    /// The probe that measures errors of the frame's pixels.
    pub(super) fn probe(&self) -> &ErrorProbe {
        self.probe.get_or_init(|| {
            let pair = self.scene.pair.get_or_init(|| ThicknessPair::new(&self.scene.spec));
            ErrorProbe::new(self.get(), pair.as_ref())
        })
    }
}

/// Locks a mutex, also after a panic of another thread.
pub(crate) fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
