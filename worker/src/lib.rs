//! A worker: it caches bricks, draws macrotiles and answers the master.
//!
//! - [`session`] serves one master over one link: leases, bricks and results meet there.
//! - `stalls` has the regions that wait for bricks: which bricks are asked for, which make room.
//! - `pool` is the render threads: plain threads, never tokio's.
//! - [`cache`] is the bricks that the worker holds; they outlive a link, so that a worker which
//!   comes back after its master restarted still has them. `brick_table` is one set of them, as
//!   render threads see it.
//! - [`dial`] is the TCP link, which dials again when it breaks. The embedded link needs none of
//!   it.
//! - [`rehearse`] holds tiles for a recorded time instead of drawing them.
//!
//! A worker never sees the volume, the queue or another worker.
//!
//! # Example
//!
//! A worker of two threads that serves the master at an address until it is told to stop.
//!
//! ```
//! # #[tokio::main]
//! # async fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use slabcast_worker::{Config, Ended, dial};
//!
//! let config = Config {
//!     name: "desk-7".into(),
//!     threads: 2,
//!     memory_budget_bytes: 4 << 30,
//!     simd: slabcast_render::Simd::detect(),
//!     rehearsal: None,
//!     machine: String::new(),
//! };
//! let (stop, stopped) = tokio::sync::watch::channel(false);
//! let worker = tokio::spawn(dial::run(config, "127.0.0.1:7433".into(), stopped));
//! stop.send(true)?;
//! assert_eq!(worker.await??, Ended::Stopped);
//! # Ok(())
//! # }
//! ```

mod brick_table;
pub mod cache;
pub mod dial;
pub mod memory;
mod pool;
pub mod rehearse;
pub mod session;
mod stalls;

pub use cache::BrickCache;
pub use rehearse::Rehearsal;
pub use session::{Config, Ended, Link, run};
