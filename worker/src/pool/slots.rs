//! Scenes and frames as render threads share them; their tables are made by the first thread that needs them.

use slabcast_common::ids::FrameId;
use slabcast_common::leaves::Finish;
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

/// A scene that tiles share; its tables are made by the first thread that needs them.
pub(crate) struct SceneSlot {
    pub(crate) spec: Arc<SceneSpec>,
    scene: OnceLock<Arc<Scene>>,
    /// How deep its last pictures were open, by their size.
    depths: Mutex<BTreeMap<[u32; 2], Arc<ClosingDepths>>>,
    /// Of a rehearsal: parts of pictures that were held.
    pub(crate) parts: Mutex<BTreeSet<[i32; 2]>>,
    /// What the thickness costs is found by; `None` where sheets can't be thinner.
    pair: OnceLock<Option<ThicknessPair>>,
    /// The frame that was drawn first.
    pub(super) first: OnceLock<FrameId>,
}

impl SceneSlot {
    pub(crate) fn new(spec: Arc<SceneSpec>) -> Self {
        let (scene, depths, parts, pair, first) = Default::default();
        SceneSlot { spec, scene, depths, parts, pair, first }
    }
}

/// A frame that tiles share.
pub(crate) struct FrameSlot {
    pub(crate) scene: Arc<SceneSlot>,
    pub(crate) view: View,
    /// What its regions are finished to.
    pub(crate) finish: Option<Finish>,
    /// Of a rehearsal: whether they weigh what they do as they are.
    pub(crate) plain: bool,
    frame: OnceLock<Frame>,
    probe: OnceLock<ErrorProbe>,
    outlook: OnceLock<VisibleBricks>,
    depths: OnceLock<Arc<ClosingDepths>>,
    /// Of a rehearsal: its place in the trace, and when its tables are made.
    pub(crate) rehearsed: OnceLock<Option<usize>>,
    pub(crate) made: OnceLock<Instant>,
    /// Of a rehearsal: blocks of bricks that its tiles opened.
    pub(crate) held: Mutex<BTreeSet<u32>>,
    /// Set when the master ends the frame: tasks of it that have not begun are dropped.
    pub(crate) over: AtomicBool,
}

impl FrameSlot {
    pub(crate) fn new(
        scene: Arc<SceneSlot>,
        view: View,
        finish: Option<Finish>,
        plain: bool,
    ) -> Self {
        let (frame, probe, outlook, depths, rehearsed, made, held, over) = Default::default();
        FrameSlot {
            scene,
            view,
            finish,
            plain,
            frame,
            probe,
            outlook,
            depths,
            rehearsed,
            made,
            held,
            over,
        }
    }

    pub(super) fn get(&self) -> &Frame {
        self.frame.get_or_init(|| {
            let scene = self.scene.scene.get_or_init(|| Arc::new(Scene::new(&self.scene.spec)));
            Frame::new(scene.clone(), self.view)
        })
    }

    /// What it sees of a directory.
    pub(super) fn outlook(&self, directory: &Arc<Directory>) -> &VisibleBricks {
        self.outlook.get_or_init(|| VisibleBricks::new(&self.get().view, directory))
    }

    /// How deep pictures of its scene and size were open.
    pub(super) fn depths(&self) -> &ClosingDepths {
        self.depths.get_or_init(|| {
            let size = self.view.size;
            let mut all = locked(&self.scene.depths);
            all.entry(size).or_insert_with(|| Arc::new(ClosingDepths::new(size))).clone()
        })
    }

    /// What tells how far its pixels are off.
    pub(super) fn probe(&self) -> &ErrorProbe {
        self.probe.get_or_init(|| {
            let pair = self.scene.pair.get_or_init(|| ThicknessPair::new(&self.scene.spec));
            ErrorProbe::new(self.get(), pair.as_ref())
        })
    }
}

pub(crate) fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
