//! Render threads. They take ready tasks from one queue and hand results back; they know
//! nothing of links.
//!
//! The queue is in order of frames, since a frame that is late holds up those behind it; in a frame a
//! region that goes on comes before one that begins. Before a thread takes one it looks at those that have come
//! since: what the frames before say that they will need is asked for at once, and is on its way while others are drawn.

use crate::rehearse::Rehearsal;
use crate::shelf::Shelf;
use slabcast_common::brick::{Brick, BrickSetKey};
use slabcast_common::ids::FrameId;
use slabcast_common::image::TilePixels;
use slabcast_common::leaves::{Finish, Leaves};
use slabcast_common::message::{
    Counters, HandedOver, Lease, Pixels, RegionLease, Sampling, SceneSpec,
};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::Lookahead;
use slabcast_common::view::View;
use slabcast_render::Simd;
use slabcast_render::judge::error_probe::{ErrorProbe, ThicknessPair};
use slabcast_render::region::{self, BrickSupply, FinishedRegion, Region};
use slabcast_render::tile::{self, Scratch};
use slabcast_render::visibility::ClosingDepths;
use slabcast_render::visibility::{Directory, VisibleBricks};
use slabcast_render::{Frame, Scene};
use slabcast_trace::Course;
use std::collections::{BTreeMap, BTreeSet};
use std::panic::AssertUnwindSafe;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

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
    first: OnceLock<FrameId>,
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

    fn get(&self) -> &Frame {
        self.frame.get_or_init(|| {
            let scene = self.scene.scene.get_or_init(|| Arc::new(Scene::new(&self.scene.spec)));
            Frame::new(scene.clone(), self.view)
        })
    }

    /// What it sees of a directory.
    fn outlook(&self, directory: &Arc<Directory>) -> &VisibleBricks {
        self.outlook.get_or_init(|| VisibleBricks::new(&self.get().view, directory))
    }

    /// How deep pictures of its scene and size were open.
    fn depths(&self) -> &ClosingDepths {
        self.depths.get_or_init(|| {
            let size = self.view.size;
            let mut all = locked(&self.scene.depths);
            all.entry(size).or_insert_with(|| Arc::new(ClosingDepths::new(size))).clone()
        })
    }

    /// What tells how far its pixels are off.
    fn probe(&self) -> &ErrorProbe {
        self.probe.get_or_init(|| {
            let pair = self.scene.pair.get_or_init(|| ThicknessPair::new(&self.scene.spec));
            ErrorProbe::new(self.get(), pair.as_ref())
        })
    }
}

pub(crate) fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
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

/// How much of what is left of a region is to be given away, in thousandths; 0: none.
#[derive(Default)]
pub(crate) struct Wish(AtomicU32);

impl Wish {
    pub(crate) fn give(&self, share: u32) {
        self.0.store(share.clamp(1, 1000), Ordering::Relaxed);
    }

    pub(crate) fn is_there(&self) -> bool {
        self.0.load(Ordering::Relaxed) > 0
    }

    fn take(&self) -> Option<f64> {
        let share = self.0.swap(0, Ordering::Relaxed);
        (share > 0).then(|| f64::from(share) / 1000.0)
    }
}

/// A shelf, of which a region takes bricks as long as it need not give any of its tile away.
struct Watched<'a>(&'a Shelf, &'a Wish);

impl BrickSupply for Watched<'_> {
    fn get(&self, place: u32) -> Option<Arc<Brick>> {
        self.0.get(place)
    }

    fn has(&self, place: u32) -> bool {
        self.0.has(place)
    }

    fn stops(&self) -> bool {
        self.1.is_there()
    }
}

/// A region on its way.
pub(crate) struct Going {
    pub(crate) lease: RegionLease,
    pub(crate) frame: Arc<FrameSlot>,
    pub(crate) shelf: Arc<Shelf>,
    pub(crate) wish: Arc<Wish>,
    pub(crate) received: Instant,
    /// When it stood still last.
    pub(crate) parked_at: Option<Instant>,
    pub(crate) parked: Duration,
    pub(crate) stalls: u32,
    /// How many sheets it looks ahead since a thread took it.
    pub(crate) ahead: u32,
    /// Time of its drawing so far.
    pub(crate) drawn: Duration,
    /// What is drawn so far; `None` before it began.
    region: Option<Region>,
    /// The same of a rehearsal.
    pub(crate) course: Option<Course>,
    /// Whether what it will need was looked for.
    looked: bool,
}

impl Going {
    pub(crate) fn new(
        lease: RegionLease,
        frame: Arc<FrameSlot>,
        shelf: Arc<Shelf>,
        received: Instant,
    ) -> Going {
        let (wish, parked_at, parked, stalls, ahead) = Default::default();
        let (drawn, region, course, looked) = Default::default();
        Going {
            lease,
            frame,
            shelf,
            wish,
            received,
            parked_at,
            parked,
            stalls,
            ahead,
            drawn,
            region,
            course,
            looked,
        }
    }

    /// Whether no thread has come to it.
    fn begins(&self) -> bool {
        self.region.is_none() && self.course.is_none()
    }
}

/// A region that was drawn to its end.
pub(crate) struct Drawn {
    pub(crate) pixels: Pixels,
    pub(crate) counters: Counters,
    /// Places in the directory of the bricks that it touched, ascending.
    pub(crate) touched: Vec<u32>,
    /// How far some of its pixels are off, where that was asked for.
    pub(crate) sampled: Sampling,
}

/// Where a region came to.
pub(crate) enum Came {
    /// Its frame was over.
    Over,
    /// To its end.
    Done(Box<Drawn>),
    /// To a sheet at which it lacks bricks; whether that is farther than before.
    Lacks(Vec<u32>, bool),
    /// Nowhere.
    Failed(String),
}

/// What became of a region.
pub(crate) struct Gone {
    pub(crate) going: Box<Going>,
    pub(crate) end: Instant,
    pub(crate) thread: u32,
    pub(crate) came: Came,
}

/// What threads take.
pub(crate) enum Task {
    Slab(Ready),
    Region(Box<Going>),
}

/// What they give back.
pub(crate) enum Outcome {
    Slab(Rendered),
    Region(Gone),
    /// A piece of a region that goes on.
    Handed(Box<HandedOver>),
    /// What regions that nobody has begun will need, by frames before: places on a shelf.
    Expected(BrickSetKey, Arc<Shelf>, Vec<u32>),
}

/// Frame, whether it begins, and the order of coming.
type Place = (FrameId, bool, u64);

#[derive(Default)]
struct State {
    tasks: BTreeMap<Place, Task>,
    order: u64,
    /// Regions that were not looked at.
    fresh: usize,
    closed: bool,
    /// Threads with nothing to do.
    idle: u32,
    /// Whether regions stand still.
    parked: bool,
    /// Up to when `waited` is counted.
    since: Option<Instant>,
    waited: Duration,
    /// How many threads there are, when the first region was taken, and how far regions look since.
    threads: u32,
    began: Option<Instant>,
    look: Lookahead,
}

impl State {
    /// Counts the time that threads had nothing to do while regions stood still.
    fn count(&mut self) {
        let now = Instant::now();
        if let Some(since) = self.since.replace(now)
            && self.parked
        {
            let waited = (now - since) * self.idle;
            self.waited += waited;
            self.look.waited(waited.as_nanos() as u64);
        }
    }

    /// How many sheets a region that a thread takes looks ahead.
    fn ahead(&mut self, going: &Going) -> u32 {
        let now = self.began.get_or_insert_with(Instant::now).elapsed().as_nanos() as u64;
        let frame = going.lease.frame;
        let first = *going.frame.scene.first.get_or_init(|| frame) == frame;
        self.look.sheets(now, self.threads, (going.stalls, first))
    }
}

#[derive(Default)]
struct Queue {
    state: Mutex<State>,
    bell: Condvar,
}

/// The threads and their queue. Dropping it lets the threads end after the task at hand.
pub(crate) struct Pool {
    queue: Arc<Queue>,
}

impl Drop for Pool {
    fn drop(&mut self) {
        let mut state = locked(&self.queue.state);
        state.closed = true;
        state.tasks.clear();
        drop(state);
        self.queue.bell.notify_all();
    }
}

impl Pool {
    /// Starts `threads` render threads; results arrive at the receiver. Queue and results are
    /// unbounded, bounded by the leases that the master gives.
    pub(crate) fn start(
        threads: u32,
        simd: Simd,
        rehearsal: Option<&Arc<Rehearsal>>,
    ) -> std::io::Result<(Pool, mpsc::UnboundedReceiver<Outcome>)> {
        let queue = Arc::<Queue>::default();
        locked(&queue.state).threads = threads;
        let pool = Pool { queue: queue.clone() };
        let (out, results) = mpsc::unbounded_channel();
        for thread in 0..threads {
            let (queue, out) = (queue.clone(), out.clone());
            let rehearsal = rehearsal.cloned();
            let work = move || match rehearsal {
                Some(rehearsal) => hold(thread, &rehearsal, &queue, &out),
                None => work(thread, simd, &queue, &out),
            };
            std::thread::Builder::new().name(format!("slabcast-render-{thread}")).spawn(work)?;
        }
        Ok((pool, results))
    }

    pub(crate) fn submit(&self, task: Task) {
        let (frame, begins) = match &task {
            Task::Slab(ready) => (ready.lease.frame, true),
            Task::Region(going) => (going.lease.frame, going.begins()),
        };
        let mut state = locked(&self.queue.state);
        state.fresh += usize::from(matches!(&task, Task::Region(going) if !going.looked));
        state.order += 1;
        let place = (frame, begins, state.order);
        state.tasks.insert(place, task);
        drop(state);
        self.queue.bell.notify_one();
    }

    /// Whether regions stand still now.
    pub(crate) fn parked(&self, parked: bool) {
        let mut state = locked(&self.queue.state);
        if state.parked != parked {
            state.count();
            state.parked = parked;
        }
    }

    /// Time that threads had nothing to do while regions stood still, since this was asked last.
    pub(crate) fn waited(&self) -> Duration {
        let mut state = locked(&self.queue.state);
        state.count();
        std::mem::take(&mut state.waited)
    }
}

/// A region to look at.
struct Look {
    frame: Arc<FrameSlot>,
    shelf: Arc<Shelf>,
    tile: Rect,
}

/// The next task, and which regions have come since; `None`: there will be none.
fn next(queue: &Queue) -> Option<(Task, Vec<Look>)> {
    let mut state = locked(&queue.state);
    loop {
        if state.closed {
            return None;
        }
        let mut looks = Vec::new();
        if state.fresh > 0 {
            state.fresh = 0;
            for task in state.tasks.values_mut() {
                let Task::Region(going) = task else { continue };
                if !std::mem::replace(&mut going.looked, true) && going.lease.begun.is_none() {
                    let (frame, shelf) = (going.frame.clone(), going.shelf.clone());
                    looks.push(Look { frame, shelf, tile: going.lease.tile });
                }
            }
        }
        if let Some((_, mut task)) = state.tasks.pop_first() {
            if let Task::Region(going) = &mut task {
                going.ahead = state.ahead(going);
            }
            return Some((task, looks));
        }
        state.count();
        state.idle += 1;
        state = queue.bell.wait(state).unwrap_or_else(PoisonError::into_inner);
        state.count();
        state.idle -= 1;
    }
}

fn work(thread: u32, simd: Simd, queue: &Queue, out: &mpsc::UnboundedSender<Outcome>) {
    let mut scratch = Scratch::default();
    while let Some((task, looks)) = next(queue) {
        for Look { frame, shelf, tile } in looks {
            let looked = caught(&mut scratch, |_| {
                let outlook = frame.outlook(shelf.directory());
                region::expected_bricks(frame.get(), outlook, &*shelf, tile, frame.depths())
            });
            // Who can't even look at it fails when it is drawn.
            expect(&frame, shelf, looked.unwrap_or_default(), out);
        }
        let outcome = match task {
            Task::Slab(ready) => Outcome::Slab(render(thread, simd, ready, &mut scratch)),
            Task::Region(going) => {
                let give = |piece| drop(out.send(Outcome::Handed(Box::new(piece))));
                Outcome::Region(advance(thread, simd, going, &mut scratch, &give))
            }
        };
        if out.send(outcome).is_err() {
            return;
        }
    }
}

/// Has the desk ask for what a region will need.
fn expect(
    frame: &FrameSlot,
    shelf: Arc<Shelf>,
    places: Vec<u32>,
    out: &mpsc::UnboundedSender<Outcome>,
) {
    if !places.is_empty() {
        // Who is not there any more needs nothing.
        let _ = out.send(Outcome::Expected(frame.scene.spec.bricks, shelf, places));
    }
}

/// A task that is taken so soon was there before the thread was free.
const AT_ONCE: Duration = Duration::from_micros(20);

/// Holds tasks for the time that they took to draw.
fn hold(thread: u32, rehearsal: &Rehearsal, queue: &Queue, out: &mpsc::UnboundedSender<Outcome>) {
    let mut free = Instant::now();
    loop {
        let asked = Instant::now();
        let Some((task, looks)) = next(queue) else { return };
        // Whether it waited for the task, or the task for it.
        let came = Instant::now();
        let from = if came - asked < AT_ONCE { free } else { free.max(came) };
        for Look { frame, shelf, tile } in looks {
            let places = rehearsal.expected(&frame, &shelf, tile);
            expect(&frame, shelf, places, out);
        }
        let outcome = match task {
            Task::Slab(task) => {
                let (mut start, mut end) = (free.max(task.ready), free.max(task.ready));
                let outcome = (!task.frame.over.load(Ordering::Relaxed)).then(|| {
                    let (held, pixels) = rehearsal.task(&task, free)?;
                    (start, end) = (held.start, held.end);
                    Ok((pixels, held.wait()))
                });
                free = end;
                let Ready { lease, received, ready, .. } = task;
                Outcome::Slab(Rendered { lease, received, ready, start, end, thread, outcome })
            }
            Task::Region(mut going) => {
                let over = going.frame.over.load(Ordering::Relaxed);
                // It gives nothing of its tile away.
                going.wish.take();
                let (came, end) = match (!over).then(|| rehearsal.region(&mut going, from)) {
                    None => (Came::Over, from),
                    Some(Err(why)) => (Came::Failed(why), from),
                    Some(Ok(went)) => went,
                };
                free = end;
                Outcome::Region(Gone { going, end, thread, came })
            }
        };
        if out.send(outcome).is_err() {
            return;
        }
    }
}

/// What `work` gives, or in words how the renderer failed; its memory is not used again then.
fn caught<T>(scratch: &mut Scratch, work: impl FnOnce(&mut Scratch) -> T) -> Result<T, String> {
    std::panic::catch_unwind(AssertUnwindSafe(|| work(scratch))).map_err(|panic| {
        *scratch = Scratch::default();
        let text = panic
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| panic.downcast_ref::<&str>().copied())
            .unwrap_or("a panic without words");
        format!("the renderer failed: {text}")
    })
}

fn render(thread: u32, simd: Simd, task: Ready, scratch: &mut Scratch) -> Rendered {
    let Ready { lease, frame, bricks, received, ready } = task;
    let span = tracing::debug_span!(
        "tile", frame = %lease.frame, task = %lease.task, x = lease.tile.x0, y = lease.tile.y0,
        slab = lease.slab.first
    );
    let _in = span.enter();
    let start = Instant::now();
    let (tile, slab, state) = (lease.tile, lease.slab, &lease.state);
    let outcome = (!frame.over.load(Ordering::Relaxed)).then(|| {
        caught(scratch, |scratch| {
            tile::render(frame.get(), simd, tile, slab, &bricks, state, scratch)
        })
    });
    let end = Instant::now();
    tracing::debug!(ms = (end - start).as_secs_f64() * 1e3, "rendered");
    Rendered { lease, received, ready, start, end, thread, outcome }
}

fn advance(
    thread: u32,
    simd: Simd,
    mut going: Box<Going>,
    scratch: &mut Scratch,
    give: &dyn Fn(HandedOver),
) -> Gone {
    let span = tracing::debug_span!(
        "region", frame = %going.lease.frame, task = %going.lease.task, x = going.lease.tile.x0,
        y = going.lease.tile.y0
    );
    let _in = span.enter();
    let came = if going.frame.over.load(Ordering::Relaxed) {
        Came::Over
    } else {
        caught(scratch, |scratch| go(simd, &mut going, scratch, give)).unwrap_or_else(Came::Failed)
    };
    Gone { going, end: Instant::now(), thread, came }
}

fn go(simd: Simd, going: &mut Going, scratch: &mut Scratch, give: &dyn Fn(HandedOver)) -> Came {
    let Going { lease, frame: slot, shelf, wish, drawn, region, ahead, .. } = going;
    let frame = slot.get();
    let outlook = slot.outlook(shelf.directory());
    let start = Instant::now();
    let before = region.as_ref().and_then(Region::depth);
    let on = match region {
        Some(on) => on,
        None => region.insert(match &lease.begun {
            None => Region::new(outlook, lease.tile),
            Some(begun) => match Region::resume(outlook, lease.tile, begun) {
                Ok(on) => on,
                Err(why) => return Came::Failed(format!("what was begun of its tile: {why}")),
            },
        }),
    };
    let supply = Watched(shelf, wish);
    let lacks = loop {
        let lacks = on.advance(frame, simd, outlook, &supply, *ahead, scratch);
        let Some(share) = wish.take().filter(|_| on.depth().is_some()) else { break lacks };
        let eps = frame.scene.quality.eps;
        if let Some((kept, given, begun)) = on.split_off(outlook, eps, share) {
            let (task, epoch) = (lease.task, lease.epoch);
            lease.tile = kept;
            give(HandedOver { task, epoch, kept, given, begun });
        }
    };
    *drawn += start.elapsed();
    tracing::debug!(ms = start.elapsed().as_secs_f64() * 1e3, lacks = lacks.len(), "drawn");
    if !lacks.is_empty() {
        let farther = on.depth() != before;
        return Came::Lacks(lacks, farther);
    }
    match region.take() {
        Some(region) => {
            let begun = Instant::now();
            let done = region.finish();
            done.record_depths(slot.depths());
            let FinishedRegion { pixels, counters, touched, .. } = done;
            let size = [lease.tile.width() as u32, lease.tile.height() as u32];
            let pixels = match &slot.finish {
                Some(finish) => Pixels::Finished(Leaves::of(&pixels, size, finish)),
                None => Pixels::Sums(pixels),
            };
            *drawn += begun.elapsed();
            let mut sampled = Sampling::default();
            // Of what another began, its bricks are not here.
            if lease.estimate && lease.begun.is_none() {
                let bricks = touched.iter().map(|&place| shelf.get(place));
                // One that was forgotten since is not sent again for this.
                let bricks: Option<Vec<_>> = bricks.collect();
                if let Some(bricks) = bricks {
                    sampled = slot.probe().sample(frame, simd, lease.tile, &bricks, scratch);
                }
            }
            Came::Done(Box::new(Drawn { pixels, counters, touched, sampled }))
        }
        None => Came::Over,
    }
}
