//! A cluster that is not there yet: the scheduler itself, against virtual workers on a virtual
//! clock, with tiles that take as long as a [`Trace`] says.
//!
//! How long will a frame take on 40 machines? A formula knows tiles and bandwidth, and nothing of
//! the order in which leases are given, who waits at a barrier, what is lent ahead, or which copy
//! of a late tile counts. All of that is decided by [`Scheduler`](slabcast_schedule::Scheduler), which is pure: so it decides here
//! too, and only what it can't know is a model:
//!
//! ```text
//!  driver (one thread) -> streams (encode) -> the master's link -> a worker's link -> decode
//!     ^                                                                                 |
//!     |                                                                          render threads
//!  decode <- the master's link <- a worker's link <- encode <--------------------------'
//! ```
//!
//! Each arrow is a queue that serves in order. A link carries so many bytes a second each way, the
//! master's is shared by all; bricks go in batches of 64 KiB, two under way to a worker at once, so
//! that a lease never waits behind many. What a message costs a processor is a constant and a part
//! for each byte ([`Costs`]), measured on the machine that predicts.
//!
//! It refuses to know what is in a picture, and where times come from. It leaves out: lost packets,
//! other traffic, memory that cores share, slow disks, and workers that are lost.

mod cluster;
mod pipe;

pub use cluster::run;

use slabcast_common::occlusion::Rect;
use slabcast_common::stats::FrameStats;
use slabcast_schedule::{Micros, Spans};
use slabcast_trace::Trace;

/// Nanoseconds since the cluster began.
pub type Nanos = u64;

/// What lies between two machines, each way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Link {
    /// Bytes a second that a stream gets through; `None`: as many as there are.
    pub bytes_per_s: Option<f64>,
    /// From one end to the other.
    pub latency_ns: Nanos,
}

impl Link {
    /// No limit and no delay.
    pub const NONE: Link = Link { bytes_per_s: None, latency_ns: 0 };
}

/// What messages cost one end of a link, in nanoseconds of a processor.
///
/// A message in company costs a tenth of one alone (TRANSPORT.md, answer 1): the sleeper is woken for
/// the first, and what lies together is read and written in one call. So waking is charged where
/// somebody slept, and a call where there was none at hand to go along with.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Toll {
    /// A thread that slept begins to work; as long, nothing happens.
    pub woken: f64,
    /// A socket is read from or written to.
    pub call: f64,
    /// A message out, and a byte of it.
    pub send: (f64, f64),
    /// A message in, and a byte of it.
    pub receive: (f64, f64),
    /// A batch of bricks, and a byte of it.
    pub bricks: (f64, f64),
}

/// What messages and decisions cost a processor, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Costs {
    /// Driver: to begin the first frame, which also finds where bricks lie, a brick of it.
    pub first_brick: f64,
    /// Driver: to begin another, a brick of it.
    pub frame_brick: f64,
    /// Driver: to begin a slab, a brick of the frame.
    pub slab_brick: f64,
    /// Driver: to begin a slab, a pixel of the picture.
    pub slab_pixel: f64,
    /// Driver: a lease.
    pub lease: f64,
    /// Driver: a pixel of a lease.
    pub lease_pixel: f64,
    /// Driver: a result.
    pub result: f64,
    /// Driver: a pixel of a result.
    pub result_pixel: f64,
    /// Driver: to see which bricks of a frame that was begun are sent ahead.
    pub ahead: f64,
    /// Driver: anything else that happens.
    pub event: f64,
    /// To send a pixel of a picture to who asked for it: the master's streams, and the client on the
    /// machine of a rehearsal.
    pub deliver: [f64; 2],
    /// Driver: to begin to work after it slept.
    pub driver_woken: f64,
    /// Driver: to take a message from its queue, or to put one into a link's.
    pub driver_message: f64,
    /// The master's streams.
    pub master: Toll,
    /// The master's finishers: a pixel of a picture (hash, encoding).
    pub finish_pixel: f64,
    /// The same in a rehearsal, whose pictures are marked all over.
    pub mark_pixel: f64,
    /// A worker's stream. Its render threads are woken as it is.
    pub worker: Toll,
    /// To pack a byte of finished pixels, and to unpack it.
    pub pack: f64,
    /// See above.
    pub unpack: f64,
    /// A rehearsing worker: to fill the planes of a result, and a pixel of them.
    pub hold: (f64, f64),
    /// A rehearsing worker: how late the system wakes a thread that holds a tile.
    pub late: f64,
}

/// A cluster to be tried.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cluster {
    /// Workers.
    pub workers: u32,
    /// Render threads of each, with a core each.
    pub threads: u32,
    /// Every worker's link, and the master's own.
    pub link: Link,
    /// What messages and decisions cost.
    pub costs: Costs,
    /// Everything on one machine of so many cores, with rendering that takes time but no core: a
    /// rehearsal. `None`: machines of their own, and the master's has a core for each of its threads.
    pub cores: Option<u32>,
    /// Frames that the master has in hand at once.
    pub in_flight: u32,
    /// What rendering times are multiplied with.
    pub stretch: f64,
    /// [`Config::mixed`](slabcast_schedule::Config::mixed).
    pub mixed: bool,
}

/// What became of a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrameOutcome {
    /// When the scheduler began with it: when it was queued, or when the one before was done.
    pub began: Nanos,
    /// When its last pixel was there.
    pub done: Nanos,
    /// When it was hashed and encoded.
    pub delivered: Nanos,
    /// Sum of its rendering.
    pub render: Nanos,
    /// Bytes from the master, bricks left out.
    pub down: u64,
    /// Bytes to the master.
    pub up: u64,
    /// Bytes of bricks.
    pub bricks: u64,
    /// Leases.
    pub leases: u64,
    /// Pieces that were given away.
    pub handed_over: u64,
    /// Messages from the master, and how often some of them left together; bricks left out.
    pub messages_down: u64,
    /// See above.
    pub writes_down: u64,
    /// Messages to the master.
    pub messages_up: u64,
}

/// What the render threads' time went into while frames were delivered steadily ([`Outcome::steady`]): sums
/// over all of them, in nanoseconds. They make up the whole.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Spent {
    /// Tiles.
    pub tiles: Nanos,
    /// A frame's tables, and the look at its blocks of bricks.
    pub tables: Nanos,
    /// Blocks that tiles opened.
    pub blocks: Nanos,
    /// Messages that were read and written on a core that was drawing.
    pub messages: Nanos,
    /// Idle: regions lack bricks.
    pub bricks: Nanos,
    /// Idle: a result is on its way to the master, or a lease back, or the thread wakes.
    pub way: Nanos,
    /// Idle: the master heard, and has nothing that it lends.
    pub dry: Nanos,
    /// The same when all frames have begun: the end of the path.
    pub tail: Nanos,
}

impl Spent {
    /// All of it.
    pub fn all(&self) -> Nanos {
        let Spent { tiles, tables, blocks, messages, bricks, way, dry, tail } = *self;
        tiles + tables + blocks + messages + bricks + way + dry + tail
    }
}

/// What became of all.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outcome {
    /// Frames in the order of the path.
    pub frames: Vec<FrameOutcome>,
    /// Work of the driver.
    pub driver: Nanos,
    /// Work of the master's streams.
    pub streams: Nanos,
    /// Work of the finisher.
    pub finisher: Nanos,
    /// Work of all workers but rendering.
    pub workers: Nanos,
    /// Work up to the first frame's delivery, with all its bricks: driver, streams, finisher, workers.
    pub first: [Nanos; 4],
    /// Work of the driver and of the streams while [`Spent`] was accounted for.
    pub steady: [Nanos; 2],
    /// Where render threads' time went.
    pub spent: Spent,
}

/// Why nothing can be predicted.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unknown {
    /// The scheduler wants a tile that was not measured.
    #[error(
        "frame {frame}: the trace has no tile ({},{}) to ({},{}) of sheets {first} to {end}; measure \
         it again with these flags", tile.x0, tile.y0, tile.x1, tile.y1
    )]
    Tile {
        /// Number of the frame.
        frame: usize,
        /// Its pixels.
        tile: Rect,
        /// First sheet.
        first: i32,
        /// One past the last.
        end: i32,
    },
    /// There are more or fewer frames than jobs.
    #[error("the trace has {have} frames, the path {need}; measure it again with these flags")]
    Frames {
        /// In the trace.
        have: usize,
        /// Of the path.
        need: usize,
    },
    /// The scheduler gave a frame up.
    #[error("frame {frame} failed: {reason}")]
    Failed {
        /// Number of the frame.
        frame: usize,
        /// In its words.
        reason: String,
    },
}

/// Looks on while a simulation runs.
pub trait Stopwatch {
    /// What the scheduler takes of the real machine: nanoseconds since some moment; `None`: nobody
    /// measures.
    fn read(&mut self) -> Option<Nanos>;

    /// A frame is done: its statistics and what happened when, as a master would have them.
    fn done(&mut self, stats: FrameStats, spans: Spans) {
        drop((stats, spans));
    }
}

/// Nobody measures.
pub struct Unmeasured;

impl Stopwatch for Unmeasured {
    fn read(&mut self) -> Option<Nanos> {
        None
    }
}

/// What the scheduler took by kind of work: counts and nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Took {
    /// The first frame, and what beginning it took, in bricks.
    pub first: (u64, Nanos),
    /// Those that were begun after it, likewise.
    pub frames: (u64, Nanos),
    /// Slabs that were begun, in bricks of their frames.
    pub slabs: (u64, Nanos),
    /// Pixels of slabs that were begun.
    pub slab_pixels: u64,
    /// Pixels of results, of which nothing was begun.
    pub results: (u64, Nanos),
    /// Results among them.
    pub result_count: u64,
    /// Leases given with them.
    pub lease_count: u64,
    /// Pixels of those.
    pub lease_pixels: u64,
    /// Frames whose bricks were sent ahead ([`crate`]'s foresight).
    pub ahead: (u64, Nanos),
    /// All else.
    pub others: (u64, Nanos),
}

impl Outcome {
    /// Mean time of a frame from its beginning to its last pixel, in ms; the first is left out, which
    /// also brings the bricks.
    pub fn frame_ms(&self) -> f64 {
        let frames = &self.frames[usize::from(self.frames.len() > 1)..];
        let sum: u64 = frames.iter().map(|f| f.done - f.began).sum();
        sum as f64 / 1e6 / frames.len().max(1) as f64
    }

    /// Work for the frames but the first, in nanoseconds: the master's, and the workers' but rendering.
    pub fn later_work(&self) -> [Nanos; 2] {
        let [driver, streams, finisher, workers] = self.first;
        let master = self.driver + self.streams + self.finisher;
        [master - (driver + streams + finisher), self.workers - workers]
    }

    /// The first frame's time, in ms.
    pub fn first_ms(&self) -> f64 {
        self.frames.first().map_or(0.0, |f| (f.done - f.began) as f64 / 1e6)
    }

    /// Frames that are delivered, one after another, while all the others that a master of so many in flight
    /// has are in the making: from the first's delivery to that of the last one after which another was
    /// begun. To count to the last of all would flatter, since work on those after the first has been done
    /// by then and is not paid for.
    pub fn steady(frames: usize, in_flight: u32) -> usize {
        frames.saturating_sub(in_flight.max(1) as usize)
    }

    /// Milliseconds from one delivered frame to the next.
    pub fn each_ms(&self) -> f64 {
        match &self.frames[..] {
            [first, .., last] => {
                (last.delivered - first.delivered) as f64 / 1e6 / (self.frames.len() - 1) as f64
            }
            [only] => (only.delivered - only.began) as f64 / 1e6,
            [] => 0.0,
        }
    }

    /// The same of the frames that are delivered steadily, if there are any.
    pub fn steady_ms(&self, in_flight: u32) -> f64 {
        match Self::steady(self.frames.len(), in_flight) {
            0 => self.each_ms(),
            n => (self.frames[n].delivered - self.frames[0].delivered) as f64 / 1e6 / n as f64,
        }
    }

    /// Mean of a figure over the frames but the first.
    pub fn mean(&self, of: impl Fn(&FrameOutcome) -> u64) -> f64 {
        let frames = &self.frames[usize::from(self.frames.len() > 1)..];
        frames.iter().map(|f| of(f) as f64).sum::<f64>() / frames.len().max(1) as f64
    }
}

/// One worker's time for the path through the best cut, mean of the frames but the first, in ms.
pub fn alone_ms(trace: &Trace) -> f64 {
    let frames = &trace.frames[usize::from(trace.frames.len() > 1)..];
    frames.iter().map(|f| f.alone_ns as f64).sum::<f64>() / 1e6 / frames.len().max(1) as f64
}

/// The same of the frames that are delivered steadily.
pub fn steadily_alone_ms(trace: &Trace, in_flight: u32) -> f64 {
    match Outcome::steady(trace.frames.len(), in_flight) {
        0 => alone_ms(trace),
        n => trace.frames[1..=n].iter().map(|f| f.alone_ns as f64).sum::<f64>() / 1e6 / n as f64,
    }
}

fn micros(ns: Nanos) -> Micros {
    ns / 1000
}
