//! A worker: it caches bricks, renders macrotiles and answers the master.
//!
//! - [`session`] is where everything arrives: leases, bricks, results. It decides what can start.
//! - `stalls` is regions that stand still: what is asked for, what makes room, who goes on.
//! - `pool` is the render threads: plain threads, never tokio's.
//! - [`rehearse`] holds tiles for a recorded time instead of drawing them.
//! - [`cache`] is the bricks it holds; they outlive a link, so a worker that comes back after
//!   its master restarted brings them along; `brick_table` is one set of them, as render threads see it.
//! - [`dial`] is the TCP link and the patience to come back; the embedded link needs none of it.
//!
//! A worker never sees the volume, the queue or another worker.

mod brick_table;
pub mod cache;
pub mod dial;
mod pool;
pub mod rehearse;
pub mod session;
mod stalls;

pub use cache::BrickCache;
pub use rehearse::Rehearsal;
pub use session::{Config, Ended, Link, run};
