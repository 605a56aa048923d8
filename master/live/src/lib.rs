//! The page of a master: its files, live pictures over a WebSocket, and calls over HTTP
//! (docs/reference/live.md).
//!
//! - [`serve`] answers connections that the master's listener passes on.
//! - `slot` decides which pass a session draws next, `preview` how coarsely it moves, and `compare` measures
//!   how far a moving picture was off its still; all three are pure.
//! - `session` is one page: it reads, draws, encodes and writes. `picture` draws one pass as a job of
//!   one frame of the master, `tile` encodes it.
//! - `volume` writes the message `volume`, `descriptions` caches it, `gradients` is its histogram of gradient
//!   magnitudes. `news` tells of jobs, workers and volumes.
//! - `address` writes URL fragments of the page.
//! - `places` limits concurrent sessions, `write_limit` is the write timeout of connections.
//! - `guard` knows who may call, `http` and `uploads` have the calls beside the socket, `assets` the page's
//!   files. [`Files`] writes what people keep; the program brings it.
//!
//! Nothing here draws: workers do. Nothing slow runs on the runtime's threads: reading and encoding
//! have threads of their own.

mod address;
mod assets;
mod blocks;
mod compare;
mod descriptions;
mod files;
mod gradients;
mod guard;
mod http;
mod messages;
mod news;
mod pick;
mod picture;
mod places;
mod preview;
mod problem;
mod server;
mod session;
mod shared;
mod slot;
mod tile;
mod uploads;
mod volume;
mod write_limit;

pub use address::{escaped, fragment};
pub use files::{Files, MadeFile, Making, Recipe};
pub use server::serve;
pub use shared::LiveConfig;
pub use volume::Home;
