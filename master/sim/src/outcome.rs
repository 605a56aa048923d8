//! Outcome of a simulation: frame times, thread time by cause, bytes and messages.

use crate::Nanos;
use slabcast_common::ids::{FrameId, WorkerId};
use slabcast_common::image::FrameState;
use slabcast_common::occlusion::Rect;
use slabcast_common::stats::FrameStats;
use slabcast_schedule::{Action, Event, Micros, Spans};
use slabcast_trace::Trace;

/// Times and traffic of one frame. Moments are nanoseconds since the cluster began.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrameOutcome {
    /// Time at which the scheduler turned to the frame: when it was queued, or when the frame
    /// before was done.
    pub began: Nanos,
    /// Time at which the frame's last pixel arrived at the master.
    pub done: Nanos,
    /// Time at which the frame was hashed and encoded.
    pub delivered: Nanos,
    /// Nanoseconds of drawing the frame, summed over threads.
    pub render: Nanos,
    /// Bytes sent from the master to workers, bricks not included.
    pub down: u64,
    /// Bytes sent from workers to the master.
    pub up: u64,
    /// Bytes of the bricks sent to workers.
    pub bricks: u64,
    /// Number of leases that were given.
    pub leases: u64,
    /// Number of pieces of tiles that idle workers took over.
    pub handed_over: u64,
    /// Number of messages from the master, bricks not included.
    pub messages_down: u64,
    /// Number of writes that carried the master's messages; some messages leave together.
    pub writes_down: u64,
    /// Number of messages to the master.
    pub messages_up: u64,
}

/// Use of the render threads' time while frames were delivered steadily
/// ([`Outcome::steady_frames`]): nanoseconds, summed over all threads. The parts make up the whole.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ThreadTime {
    /// Time of threads that draw tiles.
    pub tiles: Nanos,
    /// Time of threads that make a frame's tables or look at its blocks of bricks.
    pub tables: Nanos,
    /// Time of threads that look at the bricks of blocks that tiles opened.
    pub blocks: Nanos,
    /// Time of reading and writing messages on a core that was drawing.
    pub messages: Nanos,
    /// Idle time of threads whose regions lack bricks.
    pub bricks: Nanos,
    /// Idle time while a result or a lease is under way, or the thread wakes.
    pub round_trip: Nanos,
    /// Idle time while the master knows of it and has no task to lend.
    pub no_work: Nanos,
    /// Idle time when all frames have begun: the end of the path.
    pub path_end: Nanos,
}

impl ThreadTime {
    /// Returns the sum of all parts, in nanoseconds.
    pub fn total(&self) -> Nanos {
        let ThreadTime { tiles, tables, blocks, messages, bricks, round_trip, no_work, path_end } =
            *self;
        tiles + tables + blocks + messages + bricks + round_trip + no_work + path_end
    }
}

/// Processor time of the master and of the workers besides rendering, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Work {
    /// Processor time of the master's driver.
    pub driver: Nanos,
    /// Processor time of the master's streams: reading and writing messages.
    pub streams: Nanos,
    /// Processor time of the master's finishers: hashing and encoding frames.
    pub finishers: Nanos,
    /// Processor time of all workers for everything but rendering.
    pub workers: Nanos,
}

/// Result of the simulation of a path.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outcome {
    /// Frames in the order of the path.
    pub frames: Vec<FrameOutcome>,
    /// Processor time of the whole path.
    pub work: Work,
    /// The part of `work` that was done when the first frame was delivered, which also brought its
    /// bricks.
    pub first_work: Work,
    /// Work of driver and streams while `thread_time` was counted, in nanoseconds.
    pub steady_work: [Nanos; 2],
    /// Use of the render threads' time while frames were delivered steadily.
    pub thread_time: ThreadTime,
}

impl Outcome {
    /// Returns the mean time of a frame from its beginning to its last pixel, in milliseconds. The
    /// first frame, which also brings the bricks, is left out if there are others.
    pub fn frame_ms(&self) -> f64 {
        self.mean(|f| f.done - f.began) / 1e6
    }

    /// Returns the work for all frames but the first, in nanoseconds: the master's, and the
    /// workers' besides rendering.
    pub fn later_work(&self) -> [Nanos; 2] {
        let master = |w: &Work| w.driver + w.streams + w.finishers;
        let (all, first) = (&self.work, &self.first_work);
        [master(all) - master(first), all.workers - first.workers]
    }

    /// Returns the time of the first frame, in milliseconds.
    pub fn first_ms(&self) -> f64 {
        self.frames.first().map_or(0.0, |f| (f.done - f.began) as f64 / 1e6)
    }

    /// Returns how many of `frames` are delivered, one after another, while all others that a
    /// master with so many in flight has are being drawn: from the delivery of the first to that of
    /// the last one after which another was begun.
    ///
    /// To count to the last frame would flatter: work on the last ones is done by the time the
    /// first is delivered, and not paid for.
    pub fn steady_frames(frames: usize, frames_in_flight: u32) -> usize {
        frames.saturating_sub(frames_in_flight.max(1) as usize)
    }

    /// Returns the mean time from one delivered frame to the next, in milliseconds.
    pub fn interval_ms(&self) -> f64 {
        match &self.frames[..] {
            [first, .., last] => {
                (last.delivered - first.delivered) as f64 / 1e6 / (self.frames.len() - 1) as f64
            }
            [only] => (only.delivered - only.began) as f64 / 1e6,
            [] => 0.0,
        }
    }

    /// Returns the mean time from one delivered frame to the next among
    /// [`Outcome::steady_frames`], in milliseconds; among all, if there are none.
    pub fn steady_interval_ms(&self, frames_in_flight: u32) -> f64 {
        match Self::steady_frames(self.frames.len(), frames_in_flight) {
            0 => self.interval_ms(),
            n => (self.frames[n].delivered - self.frames[0].delivered) as f64 / 1e6 / n as f64,
        }
    }

    /// Returns the mean of a figure over all frames but the first, or of the only one.
    pub fn mean(&self, figure: impl Fn(&FrameOutcome) -> u64) -> f64 {
        let frames = &self.frames[usize::from(self.frames.len() > 1)..];
        frames.iter().map(|f| figure(f) as f64).sum::<f64>() / frames.len().max(1) as f64
    }
}

/// Returns the mean time that one core takes for a frame of a path in its best cut, in
/// milliseconds. The first frame is left out if there are others.
pub fn one_core_ms(trace: &Trace) -> f64 {
    let frames = &trace.frames[usize::from(trace.frames.len() > 1)..];
    frames.iter().map(|f| f.alone_ns as f64).sum::<f64>() / 1e6 / frames.len().max(1) as f64
}

/// Returns [`one_core_ms`] of the frames that are delivered steadily ([`Outcome::steady_frames`]).
pub fn one_core_steady_ms(trace: &Trace, frames_in_flight: u32) -> f64 {
    match Outcome::steady_frames(trace.frames.len(), frames_in_flight) {
        0 => one_core_ms(trace),
        n => trace.frames[1..=n].iter().map(|f| f.alone_ns as f64).sum::<f64>() / 1e6 / n as f64,
    }
}

/// Why a path can't be simulated.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unpredictable {
    /// The scheduler wants a tile that was not recorded.
    #[error(
        "frame {frame}: the trace has no tile ({},{}) to ({},{}) of sheets {first} to {end}; measure \
         it again with these flags", tile.x0, tile.y0, tile.x1, tile.y1
    )]
    Tile {
        /// Index of the frame in the path.
        frame: usize,
        /// Pixels of the tile.
        tile: Rect,
        /// First sheet.
        first: i32,
        /// One past the last sheet.
        end: i32,
    },
    /// The trace has more or fewer frames than the path.
    #[error("the trace has {have} frames, the path {need}; measure it again with these flags")]
    Frames {
        /// Number of frames in the trace.
        have: usize,
        /// Number of frames of the path.
        need: usize,
    },
    /// The scheduler gave a frame up.
    #[error("frame {frame} failed: {reason}")]
    Failed {
        /// Index of the frame in the path.
        frame: usize,
        /// The scheduler's reason.
        reason: String,
    },
}

/// Watches a simulation. All methods do nothing unless they are implemented.
pub trait Observer {
    /// Returns the processor time that this thread has used, in nanoseconds since some moment, so
    /// that the scheduler's own decisions are timed; `None`: they are not.
    fn processor_ns(&mut self) -> Option<Nanos> {
        None
    }

    /// An event is about to be handed to the scheduler.
    fn event(&mut self, now: Micros, event: &Event) {
        let _ = (now, event);
    }

    /// An action of the scheduler is about to be carried out. [`Observer::frame_done`] follows for
    /// [`Action::FrameDone`].
    fn action(&mut self, now: Micros, action: &Action) {
        let _ = (now, action);
    }

    /// A frame is complete: its picture, statistics and timeline, as a master would have them.
    fn frame_done(
        &mut self,
        frame: FrameId,
        state: Box<FrameState>,
        stats: FrameStats,
        spans: Spans,
    ) {
        let _ = (frame, state, stats, spans);
    }

    /// A worker holds so many bytes of bricks, after some arrived.
    fn bricks_held(&mut self, worker: WorkerId, bytes: u64) {
        let _ = (worker, bytes);
    }
}

/// An observer that ignores everything it is told.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoObserver;

impl Observer for NoObserver {}

impl<O: Observer + ?Sized> Observer for &mut O {
    fn processor_ns(&mut self) -> Option<Nanos> {
        (**self).processor_ns()
    }

    fn event(&mut self, now: Micros, event: &Event) {
        (**self).event(now, event);
    }

    fn action(&mut self, now: Micros, action: &Action) {
        (**self).action(now, action);
    }

    fn frame_done(
        &mut self,
        frame: FrameId,
        state: Box<FrameState>,
        stats: FrameStats,
        spans: Spans,
    ) {
        (**self).frame_done(frame, state, stats, spans);
    }

    fn bricks_held(&mut self, worker: WorkerId, bytes: u64) {
        (**self).bricks_held(worker, bytes);
    }
}

/// Number of operations of one kind, and the processor time of all of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Number of operations, or of the bricks or pixels they were about.
    pub count: u64,
    /// Nanoseconds of processor time, summed over all the operations.
    pub ns: Nanos,
}

impl Tally {
    pub(crate) fn add(&mut self, count: u64, ns: Nanos) {
        self.count += count;
        self.ns += ns;
    }

    /// Returns the mean nanoseconds of an operation, 0 if there was none.
    pub fn each_ns(self) -> f64 {
        if self.count == 0 { 0.0 } else { self.ns as f64 / self.count as f64 }
    }
}

/// Processor time of the scheduler's decisions by kind, as [`Observer::processor_ns`] measured it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DecisionTimes {
    /// Time to begin the first frame, counted by its bricks.
    pub first_frame: Tally,
    /// Time to begin later frames, counted by their bricks.
    pub frames: Tally,
    /// Time to begin slabs, counted by the bricks of their frames.
    pub slabs: Tally,
    /// Number of pixels of the pictures whose slabs were begun.
    pub slab_pixels: u64,
    /// Time to take results that began no frame or slab, counted by their pixels.
    pub results: Tally,
    /// Number of results that began no frame or slab.
    pub result_count: u64,
    /// Number of leases that were given when results were taken that began no frame or slab.
    pub lease_count: u64,
    /// Number of pixels of the leases that `lease_count` counts.
    pub lease_pixels: u64,
    /// Time to look for bricks to prefetch, counted by the looks.
    pub prefetches: Tally,
    /// Time to handle all other events, counted by the events.
    pub others: Tally,
}
