//! The master: it serves volumes and the task queue.
//!
//! - [`handle`] starts a master and is how everybody speaks to it.
//! - `driver` is one thread that owns the scheduler (a pure state machine) and carries out its
//!   actions: messages to workers, bricks to streams, frames to finishers. Everything that happens
//!   reaches it as an event, in one order.
//! - [`admission`] decides which workers are let in and holds their links.
//! - [`jobs`] is the table of view paths and their finished frames, shared with whoever waits for
//!   them; [`jobs::submit`] checks requests.
//! - [`finish`] turns finished sums into pictures, hashes and bytes, on threads beside the driver.
//! - [`library`] has the volumes, by name and digest, and reads them when they are needed.
//! - [`memory`] says what a master may hold.
//! - [`link`] is the driver's end of a link to a worker, and the embedded link without a network.
//! - [`record`] writes down what the scheduler is told and decides, and replays it.
//! - [`serve`] is gRPC: the only part that knows TCP.
//!
//! The master never draws and never multiplies colours; `render` is not among its crates.
//!
//! # Example
//!
//! A master with its gRPC services. Workers join over TCP, or in this process over
//! [`link::embedded`].
//!
//! ```no_run
//! # async fn example(volume: slabcast_common::volume::Volume,
//! #     request: slabcast_scene::request::PathRequest) -> Result<(), Box<dyn std::error::Error>> {
//! use slabcast_scene::path::Orientation;
//! use slabcast_master::{Master, MasterConfig, jobs::WatchItem, serve};
//!
//! let master = Master::start(MasterConfig::new(volume, Orientation::new(None, None)?))?;
//! let listener = tokio::net::TcpListener::bind("127.0.0.1:9140").await?;
//! let (stop, stopped) = tokio::sync::watch::channel(false);
//! let serving = tokio::spawn(serve::serve(master.handle(), listener, stopped));
//! let job = master.handle().submit(request).await?;
//! let mut watch = master.handle().watch(job, 0).ok_or("the job was forgotten")?;
//! while let Some(item) = watch.next().await {
//!     if let WatchItem::Frame(frame) = item {
//!         println!("frame {}: {}", frame.number, frame.stats.pixels_sha256);
//!     }
//! }
//! master.shutdown().await;
//! stop.send(true)?;
//! serving.await??;
//! # Ok(())
//! # }
//! ```

pub mod admission;
mod allowance;
mod brick_sets;
mod driver;
pub mod finish;
mod finishers;
pub mod handle;
mod hooks;
pub mod jobs;
pub mod library;
pub mod link;
pub mod memory;
mod panics;
pub mod record;
pub mod serve;

pub use admission::AttachError;
pub use handle::{Drawing, Handle, Master, MasterConfig};
pub use jobs::submit::SubmitError;
pub use library::{Library, LibraryConfig, ServedVolume};
pub use serve::PeerLimits;
