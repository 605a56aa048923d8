//! Render threads. They take tasks from one queue and hand reports back; they know nothing of
//! links.
//!
//! Clients take turns: the one that had least time of the threads comes next, and a region that
//! takes long gives way between two sheets. A client's tasks are in the order of frames, since a
//! late frame holds up those behind it; in a frame, a region that goes on comes before one that
//! begins. Before a thread draws a task it looks at the
//! regions that came into the queue meanwhile: bricks that they will need, judged by earlier
//! frames, are asked for at once and travel while other tasks are drawn (prefetch).

mod draw;
mod queue;
mod shares;
mod slots;
mod task;

pub(crate) use slots::{FrameSlot, SceneSlot, locked};
pub(crate) use task::{
    DrawnRegion, Progress, RegionReport, RegionTask, Report, SlabReport, SlabTask, SplitRequest,
    Task,
};

use crate::brick_table::BrickTable;
use crate::rehearse::Rehearsal;
use draw::{caught, draw_region, draw_slab};
use queue::{Prefetch, Queue, Turn};
use slabcast_render::Simd;
use slabcast_render::region;
use slabcast_render::tile::Scratch;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

/// The threads and their queue. Dropped, it lets each thread end after the task at hand.
pub(crate) struct Pool {
    queue: Arc<Queue>,
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.queue.close();
    }
}

impl Pool {
    /// Starts `threads` render threads, which send reports to the returned receiver. Queue and
    /// reports are unbounded; the leases that the master gives bound them.
    pub(crate) fn start(
        threads: u32,
        simd: Simd,
        rehearsal: Option<&Arc<Rehearsal>>,
    ) -> std::io::Result<(Pool, mpsc::UnboundedReceiver<Report>)> {
        let queue = Arc::new(Queue::new(threads));
        let pool = Pool { queue: queue.clone() };
        let (reports, receiver) = mpsc::unbounded_channel();
        for thread in 0..threads {
            let (queue, reports) = (queue.clone(), reports.clone());
            let rehearsal = rehearsal.cloned();
            let work = move || match rehearsal {
                Some(rehearsal) => rehearse(thread, &rehearsal, &queue, &reports),
                None => draw(thread, simd, &queue, &reports),
            };
            std::thread::Builder::new().name(format!("slabcast-render-{thread}")).spawn(work)?;
        }
        Ok((pool, receiver))
    }

    /// Queues a task.
    pub(crate) fn submit(&self, task: Task) {
        self.queue.push(task);
    }

    /// Tells whether regions are stalled now.
    pub(crate) fn set_stalled(&self, are_stalled: bool) {
        self.queue.set_stalled(are_stalled);
    }

    /// Returns the time of all threads without a task while regions were stalled, since the last
    /// call.
    pub(crate) fn take_idle(&self) -> Duration {
        self.queue.take_idle()
    }
}

/// A render thread.
fn draw(thread: u32, simd: Simd, queue: &Queue, reports: &mpsc::UnboundedSender<Report>) {
    let mut scratch = Scratch::default();
    while let Some((task, prefetches)) = queue.pop() {
        for Prefetch { frame, table, tile } in prefetches {
            let places = caught(&mut scratch, |_| {
                let visible = frame.visible_bricks(table.directory());
                region::expected_bricks(frame.get(), visible, &*table, tile, frame.depths())
            });
            // A region over which this fails will fail when it is drawn, and say so.
            report_prefetch(&frame, table, places.unwrap_or_default(), reports);
        }
        let turn = Turn::new(queue, task.client());
        let report = match task {
            Task::Slab(task) => Report::Slab(draw_slab(thread, simd, task, &mut scratch)),
            Task::Region(task) => {
                let give = |piece| drop(reports.send(Report::Piece(Box::new(piece))));
                let report = draw_region(thread, simd, task, &mut scratch, &turn, &give);
                if matches!(report.progress, Progress::GaveWay) {
                    queue.push(Task::Region(report.task));
                    turn.end();
                    continue;
                }
                Report::Region(report)
            }
        };
        turn.end();
        if reports.send(report).is_err() {
            return;
        }
    }
}

fn report_prefetch(
    frame: &FrameSlot,
    table: Arc<BrickTable>,
    places: Vec<u32>,
    reports: &mpsc::UnboundedSender<Report>,
) {
    if !places.is_empty() {
        // A session that has ended needs no bricks.
        let _ = reports.send(Report::Prefetch(frame.scene.spec.bricks, table, places));
    }
}

/// A task that is taken within this time was there before the thread was free.
const AT_ONCE: Duration = Duration::from_micros(20);

/// A thread of a rehearsal: it holds each task for the time that it took to draw.
fn rehearse(
    thread: u32,
    rehearsal: &Rehearsal,
    queue: &Queue,
    reports: &mpsc::UnboundedSender<Report>,
) {
    let mut free = Instant::now();
    loop {
        let asked = Instant::now();
        let Some((task, prefetches)) = queue.pop() else { return };
        // Either the task waited for the thread, or the thread for the task.
        let came = Instant::now();
        let begin = if came - asked < AT_ONCE { free } else { free.max(came) };
        let turn = Turn::new(queue, task.client());
        for Prefetch { frame, table, tile } in prefetches {
            let places = rehearsal.expected(&frame, &table, tile);
            report_prefetch(&frame, table, places, reports);
        }
        let report = match task {
            Task::Slab(task) => {
                let (mut start, mut end) = (free.max(task.ready), free.max(task.ready));
                let outcome = (!task.frame.has_ended.load(Ordering::Relaxed)).then(|| {
                    let (held, pixels) = rehearsal.task(&task, free)?;
                    (start, end) = (held.start, held.end);
                    Ok((pixels, held.wait()))
                });
                free = end;
                let SlabTask { lease, received, ready, .. } = task;
                Report::Slab(SlabReport { lease, received, ready, start, end, thread, outcome })
            }
            Task::Region(mut task) => {
                let has_ended = task.frame.has_ended.load(Ordering::Relaxed);
                // A rehearsed region gives nothing away.
                task.split.take();
                let (progress, end) = match (!has_ended).then(|| rehearsal.region(&mut task, begin))
                {
                    None => (Progress::FrameEnded, begin),
                    Some(Err(why)) => (Progress::Failed(why), begin),
                    Some(Ok(done)) => done,
                };
                free = end;
                Report::Region(RegionReport { task, end, thread, progress })
            }
        };
        turn.end();
        if reports.send(report).is_err() {
            return;
        }
    }
}
