//! The master: it serves one volume and the task queue.
//!
//! - [`driver`] is one thread that owns the scheduler (a pure state machine) and carries out
//!   what it wishes: messages to workers, bricks to streams, frames to the finisher. Everything
//!   that happens reaches it as an event, in one order.
//! - [`jobs`] is the table of view paths and their finished frames, shared with whoever waits
//!   for them.
//! - [`finish`] turns finished sums into pictures, hashes and bytes, beside the driver.
//! - [`link`] is a worker's end at the master, and the embedded link that needs no network.
//! - [`record`] writes down what the scheduler is told and decides, and replays it.
//! - [`serve`] is gRPC: the only part that knows TCP.
//!
//! The master never draws and never multiplies colours; `render` is not among its crates.

pub mod driver;
pub mod finish;
pub mod jobs;
pub mod link;
mod memory;
pub mod record;
pub mod serve;

pub use driver::{Handle, Master, MasterConfig, SubmitError};
