//! Configuration of a virtual cluster: links, costs, the master and its workers.

use crate::Nanos;
use slabcast_common::link::FRAMES_IN_FLIGHT;
use slabcast_schedule::{Config, Micros};

/// Link between two machines: its rate and latency, the same each way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Link {
    /// Bytes a second that a stream gets through; `None`: no limit.
    pub bytes_per_s: Option<f64>,
    /// Nanoseconds from one end to the other.
    pub latency_ns: Nanos,
}

impl Link {
    /// A link without limit or delay.
    pub const UNLIMITED: Link = Link { bytes_per_s: None, latency_ns: 0 };
}

/// Processor time that grows with a count of bytes or pixels, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LinearCost {
    /// Nanoseconds of one operation, whatever its size.
    pub fixed_ns: f64,
    /// Nanoseconds that each byte or pixel adds to an operation.
    pub per_unit_ns: f64,
}

impl LinearCost {
    /// Returns the cost of `units` bytes or pixels, in nanoseconds.
    pub fn ns(self, units: f64) -> f64 {
        self.fixed_ns + self.per_unit_ns * units
    }
}

/// Processor time that messages take at one end of a link.
///
/// A message in company costs a tenth of one alone: the sleeper is woken for the first, and
/// messages that wait together are read and written in one call (docs/design/transport.md, answer
/// 1). So waking is charged where a thread slept, and a call where no other message shares it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MessageCosts {
    /// Nanoseconds until a thread that slept begins to work.
    pub wake_ns: f64,
    /// Nanoseconds of a read from or a write to a socket.
    pub call_ns: f64,
    /// Time to send a message, by its bytes.
    pub send: LinearCost,
    /// Time to receive a message, by its bytes.
    pub receive: LinearCost,
    /// Time to send or receive a batch of bricks, by its bytes.
    pub bricks: LinearCost,
}

/// Processor time of messages and decisions, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Costs {
    /// Nanoseconds of the master's driver to begin the first frame, for each brick of it; the
    /// bricks are also sorted then.
    pub first_brick_ns: f64,
    /// Nanoseconds of the master's driver to begin a later frame, for each brick of it.
    pub frame_brick_ns: f64,
    /// Nanoseconds of the master's driver to begin a slab, for each brick of its frame.
    pub slab_brick_ns: f64,
    /// Nanoseconds of the master's driver to begin a slab, for each pixel of the picture.
    pub slab_pixel_ns: f64,
    /// Time of the master's driver to give a lease, by its pixels.
    pub lease: LinearCost,
    /// Time of the master's driver to take a result, by its pixels.
    pub result: LinearCost,
    /// Nanoseconds of the master's driver to look for bricks of a frame to prefetch.
    pub prefetch_ns: f64,
    /// Nanoseconds of the master's driver to handle any other event.
    pub event_ns: f64,
    /// Nanoseconds until the master's driver begins to work after it slept.
    pub driver_wake_ns: f64,
    /// Nanoseconds of the master's driver to take a message from its queue, or to put one into a
    /// link's.
    pub driver_message_ns: f64,
    /// Nanoseconds of the master's streams to send a pixel of a picture to the client.
    pub deliver_pixel_ns: f64,
    /// Nanoseconds of a client on the master's machine to receive a pixel.
    pub client_pixel_ns: f64,
    /// Costs of messages for the master's streams.
    pub master: MessageCosts,
    /// Nanoseconds of the master's finishers to hash and encode a pixel.
    pub finish_pixel_ns: f64,
    /// Nanoseconds of the master's finishers in a rehearsal, which marks pictures all over, for
    /// each pixel.
    pub mark_pixel_ns: f64,
    /// Costs of messages for a worker's stream; to wake one of its render threads costs as much as
    /// to wake the stream.
    pub worker: MessageCosts,
    /// Nanoseconds of a worker to pack a byte of finished pixels.
    pub pack_byte_ns: f64,
    /// Nanoseconds of the master's streams to unpack a byte of finished pixels.
    pub unpack_byte_ns: f64,
    /// Time of a rehearsing worker to fill the planes of a result, by its pixels.
    pub placeholder: LinearCost,
    /// Nanoseconds by which the system wakes a rehearsing worker's thread too late.
    pub late_wake_ns: f64,
}

/// A cluster of equal workers whose times are predicted ([`run`](crate::run)).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cluster {
    /// Number of workers in the cluster.
    pub workers: u32,
    /// Render threads of each worker, with a core each.
    pub threads: u32,
    /// Link of each worker, and the master's own, which all share.
    pub link: Link,
    /// Processor time of messages and decisions.
    pub costs: Costs,
    /// Cores of the one machine on which everything runs in a rehearsal, where rendering takes time
    /// but no core. `None`: machines of their own; the master's has a core for each of its threads.
    pub shared_cores: Option<u32>,
    /// Number of frames that the master has in hand at once.
    pub frames_in_flight: u32,
    /// Factor on the model's rendering times; 1 leaves them.
    pub stretch: f64,
    /// Whether tiles of a frame may have two sizes, as [`Config::mixed`] says.
    pub mixed: bool,
}

/// The master of a virtual cluster, its machine and its link.
#[derive(Clone, Debug)]
pub struct Master {
    /// The master's own link, which all workers share.
    pub link: Link,
    /// Processor time of messages and decisions.
    pub costs: Costs,
    /// Number of cores of the one machine on which everything runs, as [`Cluster::shared_cores`]
    /// says.
    pub shared_cores: Option<u32>,
    /// Number of frames of a queued path that the master has in hand at once.
    pub frames_in_flight: u32,
    /// Settings of the scheduler that the master runs.
    pub scheduler: Config,
    /// Cuts bricks into messages of 1 to 16 bricks at random instead of full ones.
    pub random_batches: bool,
}

impl Default for Master {
    /// A master that takes no time, on a link without limit.
    fn default() -> Self {
        Master {
            link: Link::UNLIMITED,
            costs: Costs::default(),
            shared_cores: None,
            frames_in_flight: FRAMES_IN_FLIGHT as u32,
            scheduler: Config::default(),
            random_batches: false,
        }
    }
}

/// Number of the worker's render threads, with a core each.
#[derive(Clone, Debug)]
pub struct WorkerProfile {
    /// Whether the worker runs on the master's host.
    pub threads: u32,
    /// Whether it runs on the master's host.
    pub is_local: bool,
    /// Factor on the model's rendering times; 1 leaves them.
    pub time_factor: f64,
    /// Largest share by which a run takes longer, at random; 0.1 = up to a tenth.
    pub time_jitter: f64,
    /// Nanoseconds that each run of a task takes besides drawing.
    pub run_overhead_ns: Nanos,
    /// Bytes of bricks that the worker may hold.
    pub memory_budget_bytes: u64,
    /// Bytes a second that the worker's link carries each way; `None`: no limit.
    pub bytes_per_s: Option<f64>,
    /// Least and largest latency of a message, in nanoseconds. Messages of a stream keep their
    /// order.
    pub latency_ns: [Nanos; 2],
    /// Bytes a second at which bricks reach the worker, beside the link's own limit; `None`: no
    /// limit.
    pub brick_bytes_per_s: Option<f64>,
    /// Microseconds by which the worker's clock is ahead of the master's.
    pub clock_ahead_us: Micros,
    /// Name of the worker and of its machine, by which it is known when it comes back; `None`: a
    /// worker that was never there before.
    pub name: Option<&'static str>,
    /// Whether its pixels are believed without audits.
    pub is_trusted: bool,
    /// Faults that the worker has by itself.
    pub faults: Faults,
}

impl Default for WorkerProfile {
    /// One thread at the model's speed, with memory for everything, links without limit and no
    /// faults.
    fn default() -> Self {
        WorkerProfile {
            threads: 1,
            is_local: false,
            time_factor: 1.0,
            time_jitter: 0.0,
            run_overhead_ns: 0,
            memory_budget_bytes: u64::MAX,
            bytes_per_s: None,
            latency_ns: [0; 2],
            brick_bytes_per_s: None,
            clock_ahead_us: 0,
            name: None,
            is_trusted: true,
            faults: Faults::default(),
        }
    }
}

/// Faults of a worker that happen at random or at a tile. A rate of 0 means never.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// Number n for which one result in n is sent twice; 0 = never.
    pub duplicate_one_in: u64,
    /// Number n for which one result, or handed-over piece, in n is malformed; 0 = never.
    pub lie_one_in: u64,
    /// Number n for which the pixels of one result in n are false; 0 = never.
    pub false_one_in: u64,
    /// Number n for which one task in n is refused; 0 = never.
    pub fail_one_in: u64,
    /// Number n for which one brick in n arrives damaged; 0 = never.
    pub broken_one_in: u64,
    /// Upper left corner of tiles that kill the worker while it draws them.
    pub deadly_tile: Option<[i32; 2]>,
    /// Upper left corner of tiles that a thread never ends.
    pub hanging_tile: Option<[i32; 2]>,
    /// Whether incidents that name this worker are skipped.
    pub immune: bool,
}
