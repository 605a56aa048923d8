//! Render threads. They take ready tasks from one queue and hand results back; they know
//! nothing of links.

use crate::rehearse::Rehearsal;
use crossbeam_channel::{Receiver, Sender, unbounded};
use slabcast_common::brick::Brick;
use slabcast_common::image::TilePixels;
use slabcast_common::message::{Counters, Lease, SceneSpec};
use slabcast_common::view::View;
use slabcast_render::splat::Simd;
use slabcast_render::tile::{self, Scratch};
use slabcast_render::{Frame, Scene};
use std::panic::AssertUnwindSafe;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Instant;
use tokio::sync::mpsc;

/// A scene that tiles share; its tables are made by the first thread that needs them.
pub(crate) struct SceneSlot {
    pub(crate) spec: Arc<SceneSpec>,
    scene: OnceLock<Arc<Scene>>,
}

impl SceneSlot {
    pub(crate) fn new(spec: Arc<SceneSpec>) -> Self {
        SceneSlot { spec, scene: OnceLock::new() }
    }
}

/// A frame that tiles share.
pub(crate) struct FrameSlot {
    pub(crate) scene: Arc<SceneSlot>,
    pub(crate) view: View,
    frame: OnceLock<Frame>,
    /// Of a rehearsal: its place in the trace, and when its tables are made.
    pub(crate) rehearsed: OnceLock<Option<usize>>,
    pub(crate) made: OnceLock<Instant>,
    /// Set when the master ends the frame: tasks of it that have not begun are dropped.
    pub(crate) over: AtomicBool,
}

impl FrameSlot {
    pub(crate) fn new(scene: Arc<SceneSlot>, view: View) -> Self {
        FrameSlot {
            scene,
            view,
            frame: OnceLock::new(),
            rehearsed: OnceLock::new(),
            made: OnceLock::new(),
            over: AtomicBool::new(false),
        }
    }

    fn get(&self) -> &Frame {
        self.frame.get_or_init(|| {
            let scene = self.scene.scene.get_or_init(|| Arc::new(Scene::new(&self.scene.spec)));
            Frame::new(scene.clone(), self.view)
        })
    }
}

/// A task whose bricks are all here.
pub(crate) struct Ready {
    pub(crate) lease: Box<Lease>,
    pub(crate) frame: Arc<FrameSlot>,
    pub(crate) bricks: Vec<Arc<Brick>>,
    pub(crate) received: Instant,
    pub(crate) ready: Instant,
}

/// What became of it.
pub(crate) struct Rendered {
    pub(crate) lease: Box<Lease>,
    pub(crate) received: Instant,
    pub(crate) ready: Instant,
    pub(crate) start: Instant,
    pub(crate) end: Instant,
    pub(crate) thread: u32,
    /// `None` when its frame was over before it began.
    pub(crate) outcome: Option<Result<(TilePixels, Counters), String>>,
}

/// The threads and their queue. Dropping it lets the threads end after the task at hand.
pub(crate) struct Pool {
    queue: Sender<Ready>,
}

impl Pool {
    /// Starts `threads` render threads; results arrive at the receiver. Queue and results are
    /// unbounded, bounded by the leases that the master gives.
    pub(crate) fn start(
        threads: u32,
        simd: Simd,
        rehearsal: Option<&Arc<Rehearsal>>,
    ) -> std::io::Result<(Pool, mpsc::UnboundedReceiver<Rendered>)> {
        let (queue, tasks) = unbounded::<Ready>();
        let (out, results) = mpsc::unbounded_channel();
        for thread in 0..threads {
            let (tasks, out) = (tasks.clone(), out.clone());
            let rehearsal = rehearsal.cloned();
            let work = move || match rehearsal {
                Some(rehearsal) => hold(thread, &rehearsal, &tasks, &out),
                None => work(thread, simd, &tasks, &out),
            };
            std::thread::Builder::new().name(format!("slabcast-render-{thread}")).spawn(work)?;
        }
        Ok((Pool { queue }, results))
    }

    pub(crate) fn submit(&self, task: Ready) {
        // Threads end only when this sender does.
        let _ = self.queue.send(task);
    }
}

fn work(thread: u32, simd: Simd, tasks: &Receiver<Ready>, out: &mpsc::UnboundedSender<Rendered>) {
    let mut scratch = Scratch::default();
    for task in tasks {
        let Ready { lease, frame, bricks, received, ready } = task;
        let span = tracing::debug_span!(
            "tile", frame = %lease.frame, task = %lease.task, x = lease.tile.x0, y = lease.tile.y0,
            slab = lease.slab.first
        );
        let _in = span.enter();
        let start = Instant::now();
        let outcome = (!frame.over.load(Ordering::Relaxed)).then(|| {
            std::panic::catch_unwind(AssertUnwindSafe(|| {
                tile::render(
                    frame.get(),
                    simd,
                    lease.tile,
                    lease.slab,
                    &bricks,
                    &lease.state,
                    &mut scratch,
                )
            }))
            .map_err(|panic| {
                scratch = Scratch::default();
                let text = panic
                    .downcast_ref::<String>()
                    .map(String::as_str)
                    .or_else(|| panic.downcast_ref::<&str>().copied())
                    .unwrap_or("a panic without words");
                format!("the renderer failed: {text}")
            })
        });
        let end = Instant::now();
        tracing::debug!(ms = (end - start).as_secs_f64() * 1e3, "rendered");
        let done = Rendered { lease, received, ready, start, end, thread, outcome };
        if out.send(done).is_err() {
            return;
        }
    }
}

/// Holds tasks for the time that they took to draw.
fn hold(
    thread: u32,
    rehearsal: &Rehearsal,
    tasks: &Receiver<Ready>,
    out: &mpsc::UnboundedSender<Rendered>,
) {
    let mut free = Instant::now();
    for task in tasks {
        let (mut start, mut end) = (free.max(task.ready), free.max(task.ready));
        let outcome = (!task.frame.over.load(Ordering::Relaxed)).then(|| {
            let (held, pixels) = rehearsal.task(&task, free)?;
            (start, end) = (held.start, held.end);
            Ok((pixels, held.wait()))
        });
        free = end;
        let Ready { lease, received, ready, .. } = task;
        if out.send(Rendered { lease, received, ready, start, end, thread, outcome }).is_err() {
            return;
        }
    }
}
