//! A virtual cluster: the scheduler itself, against virtual workers and links on a virtual clock.
//!
//! Will a frame take 10 ms on 40 machines, or 100? Is the picture whole when three of them die? A
//! formula knows tiles and bandwidth; it knows nothing of the order in which leases are given, of
//! barriers, of what is lent ahead, or of which copy of a late tile counts. All of that is decided
//! by [`Scheduler`](slabcast_schedule::Scheduler), which is pure: so it decides here too, and only
//! what it can't know is a model:
//!
//! ```text
//!  driver (one thread) -> streams (encode) -> the master's link -> a worker's link -> decode
//!     ^                                                                                 |
//!     |                                                                          render threads
//!  decode <- the master's link <- a worker's link <- encode <--------------------------'
//! ```
//!
//! Each arrow is a queue that serves in order. A link carries so many bytes a second each way, and
//! all share the master's. Bricks go in batches, of which a few are under way to a worker at once,
//! so that a lease never waits behind many.
//!
//! One cluster serves three purposes, by its configuration:
//!
//! - **Prediction** ([`run`]): tiles take what a [`Trace`](slabcast_trace::Trace) recorded, and
//!   messages what [`Costs`] say. Its pictures are blank.
//! - **Rehearsal**: a prediction for one machine ([`Cluster::shared_cores`]), to be compared with a
//!   real one.
//! - **Faults** ([`VirtualCluster`]): workers join, die, lie, stall or run out of memory, by
//!   [`Incident`]s and from a seed. A [`TileModel`] that draws real pixels shows whether pictures
//!   are whole, and [`Audit`] whether the scheduler keeps its promises.
//!
//! The simulation refuses to know what is in a picture, and where times come from. It leaves out
//! lost packets, other traffic, memory that cores share, and slow disks.

mod audit;
mod cluster;
mod config;
mod model;
mod outcome;
mod predict;
mod queues;
mod rng;
mod traced;

pub use audit::Audit;
pub use cluster::{HeldBricks, Incident, VirtualCluster};
pub use config::{Cluster, Costs, Faults, LinearCost, Link, Master, MessageCosts, WorkerProfile};
pub use model::{FrameSetup, Region, Split, TaskFacts, TaskOutput, TileModel};
pub use outcome::{
    DecisionTimes, FrameOutcome, NoObserver, Observer, Outcome, Tally, ThreadTime, Unpredictable,
    Work, one_core_ms, one_core_steady_ms,
};
pub use predict::run;
pub use rng::Rng;

/// Nanoseconds, of a duration or since the cluster began.
pub type Nanos = u64;
