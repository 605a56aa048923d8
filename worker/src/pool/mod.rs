//! Render threads. They take ready tasks from one queue and hand results back; they know
//! nothing of links.
//!
//! The queue is in order of frames, since a frame that is late holds up those behind it; in a frame a
//! region that goes on comes before one that begins. Before a thread takes one it looks at those that have come
//! since: what the frames before say that they will need is asked for at once, and is on its way while others are drawn.

mod draw;
mod slots;
mod task;

pub(crate) use slots::{FrameSlot, SceneSlot, locked};
pub(crate) use task::{Came, Drawn, Going, Gone, Outcome, Ready, Rendered, Task, Wish};

use crate::brick_table::Shelf;
use crate::rehearse::Rehearsal;
use draw::{advance, caught, render};
use slabcast_common::ids::FrameId;
use slabcast_common::occlusion::Rect;
use slabcast_common::region::Lookahead;
use slabcast_render::Simd;
use slabcast_render::region;
use slabcast_render::tile::Scratch;
use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

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
