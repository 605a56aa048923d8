//! A worker: it caches bricks, renders macrotiles and answers the master.
//!
//! - [`desk`] is where everything arrives: leases, bricks, results. It decides what can start.
//! - [`pool`] is the render threads: plain threads, never tokio's.
//! - [`rehearse`] holds tiles for a recorded time instead of drawing them.
//! - [`cache`] is the bricks it holds; they outlive a link, so a worker that comes back after
//!   its master restarted brings them along.
//! - [`dial`] is the TCP link and the patience to come back; the embedded link needs none of it.
//!
//! A worker never sees the volume, the queue or another worker.

pub mod cache;
pub mod desk;
pub mod dial;
pub mod pool;
pub mod rehearse;

pub use cache::BrickCache;
pub use desk::{Config, Ended, Link, run};
pub use rehearse::Rehearsal;
