//! The paper's section 4 as a state machine: which brick and which macrotile goes to which worker,
//! and when. It refuses to know sockets, threads, files and what time it is.
//!
//! # How to drive it
//!
//! 1. Make a [`Scheduler`]. Welcome each worker on its link yourself
//!    ([`ToWorker::Welcome`](slabcast_common::message::ToWorker::Welcome) comes before all else),
//!    then hand in [`Event::WorkerJoined`].
//! 2. Turn whatever happens into an [`Event`] and hand it to [`Scheduler::handle`], with a
//!    [`Clock`] that never goes back. Hand in [`Event::WorkerHeard`] for messages that have no
//!    event of their own.
//! 3. After each event take [`Scheduler::next_action`] until it is `None`, and do what it says, in
//!    order for each worker. Control messages and bricks may travel on two links; each keeps its
//!    own order.
//! 4. Sleep until the next message or [`Scheduler::next_deadline`], whichever is first; at the
//!    deadline hand in [`Event::Tick`].
//!
//! A worker that [`Action::Drop`] names, and one that was reported with [`Event::WorkerLost`], is
//! forgotten: close its link, ignore what still comes. When it dials again it is a new worker with
//! a new id.
//!
//! ```text
//! +-------------------------------------------------------------------------------------------+
//! | The law. A frame's bytes follow from its job alone: not from the number of workers, their |
//! | threads, speed or memory, nor from the macrotile level, the slabs, the order of arrival,  |
//! | or who dies when. A frame of which a tile can't be drawn fails whole: none is done with a |
//! | hole in it.                                                                               |
//! +-------------------------------------------------------------------------------------------+
//! ```
//!
//! # Rooms
//!
//! - `state` holds what is known: frames in the making, leases, workers, brick residency.
//! - `policy` decides: where a picture is cut, which worker owns which tile, how many workers draw,
//!   which bricks are prefetched. One cost model predicts when a frame ends.
//! - `dispatch` hands out work: leases, work stealing, speculative copies.
//! - `account` keeps a frame's statistics, critical path and timeline.
//!
//! `slabcast-sim` runs the scheduler against a virtual cluster.

mod account;
mod action;
mod dispatch;
mod event;
mod policy;
mod scheduler;
mod state;

pub use account::spans::Spans;
pub use action::{Action, Span, Totals, WorkerView};
pub use event::{Event, FrameJob, WorkerIdentity};
pub use policy::macrotile;
pub use policy::slab_borders::slab_ranges;
pub use scheduler::Scheduler;
pub use state::frame::is_shut;

/// Microseconds on the master's clock, which never goes back.
pub type Micros = u64;

/// A monotonic clock. The real one lives in the master, a virtual one in tests and simulations.
pub trait Clock {
    /// Microseconds since an arbitrary origin; never less than before.
    fn now(&self) -> Micros;
}

/// Timeouts and limits of a scheduler.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// Interval between two pings of a worker, in microseconds.
    pub heartbeat: Micros,
    /// Silence after which a worker counts as lost, in microseconds.
    pub silence: Micros,
    /// Silence of a worker with leases after which others are lent its tasks too, in microseconds; 0:
    /// never. It is pinged four times as often.
    pub unresponsive_after: Micros,
    /// Deadline of a task's first lease, in microseconds. Each attempt doubles it.
    pub lease: Micros,
    /// Number of different workers that must have failed at a tile before it is given up, and its
    /// frame fails. A worker that is linked and has not failed at it is always asked first
    /// (see `state::task_queue`).
    pub poison_after: u32,
    /// Share of the tiles of workers that are not trusted which another worker draws too, in
    /// millionths, once they have agreed with others `audit_first` times; before, all are.
    pub audit_ppm: u32,
    /// See [`Config::audit_ppm`].
    pub audit_first: u32,
    /// Decides which tiles these are. Secret and random in a master.
    pub audit_seed: u64,
    /// Leases in flight for each render thread, the one it renders included.
    pub queue_ahead: u32,
    /// Cuts mixed tile sizes under the `slab` schedule: each render thread starts with a whole
    /// macrotile, later ones are quarters ([`macrotile::cut_mixed`]). The paper's experiment, which
    /// `slabcast lab study` repeats by simulation (`slabcast-sim`). No master sets it, and records
    /// do not have it.
    pub mixed: bool,
}

impl Default for Config {
    /// - heartbeat 1 s, silence 3 s: docs/design/promises.md R2 allows 3 s to find a partitioned
    ///   worker and no false alarm at twice the load its cores can bear; three pings must go
    ///   unanswered.
    /// - unresponsive_after 1 s: a worker that is stopped holds up a frame for no longer. At half, a machine that
    ///   swaps has its tiles drawn twice; at double, a viewer waits for two seconds.
    /// - lease 60 s: the slowest tile that still is honest work. At half, a 256x256 tile of a large
    ///   volume on a shared core is rendered twice for nothing; at double, a worker that lives but
    ///   hangs holds up a frame for two minutes. Not measured.
    /// - poison after 3: R5.
    /// - audits of 1 % after 16: who lies in a quarter of its tiles is found among the first 16 in 99
    ///   of 100 cases; who lies in 1 % is found by the time it has spoiled a hundred tiles. They cost
    ///   a new worker a quarter of a frame. 500, as proposed, double a job of eight frames.
    /// - two leases a thread: docs/design/transport.md, answer 3.
    fn default() -> Self {
        Config {
            heartbeat: 1_000_000,
            silence: 3_000_000,
            unresponsive_after: 1_000_000,
            lease: 60_000_000,
            poison_after: 3,
            audit_ppm: 10_000,
            audit_first: 16,
            audit_seed: 0,
            queue_ahead: 2,
            mixed: false,
        }
    }
}
