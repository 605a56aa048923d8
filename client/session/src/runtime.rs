//! The runtime of every command that has a network or a cluster: a thread or two that talk, while
//! render threads draw.

use crate::fail::{Fail, reason};
use crate::machine::cores;
use slabcast_common::link::stream_threads;
use std::time::Duration;
use tokio::runtime::{Builder, Runtime};

/// Starts the runtime of a command with streams, with [`stream_threads`] for this machine's cores.
pub fn start() -> Result<Runtime, Fail> {
    with_threads(stream_threads(cores()))
}

/// Render threads up to which a worker has one thread for its streams.
const FEW: u32 = 8;

/// Starts it for a worker of so many render threads: as for any command with streams, or with one thread where render
/// threads are few. Another one is woken for each lease that comes, and finds nothing to do: a ping and its pong take a worker
/// 38 us of a Xeon's processors with two and 24 with one (docs/scaling.md).
pub fn start_worker(render_threads: u32) -> Result<Runtime, Fail> {
    if render_threads <= FEW { with_threads(1) } else { start() }
}

/// Starts it for a cluster in this process. Messages are passed on and nothing is encoded: a second
/// thread would be woken for each of them to look for work, and take the render threads' cores.
pub fn start_embedded() -> Result<Runtime, Fail> {
    with_threads(1)
}

fn with_threads(threads: usize) -> Result<Runtime, Fail> {
    Builder::new_multi_thread()
        .worker_threads(threads)
        .thread_name("slabcast-io")
        .enable_all()
        .build()
        .map_err(|e| Fail::failed(format!("starting threads failed: {}", reason(&e))))
}

/// Ends it. A thread that still encodes, draws or resolves a name must not hold a command up.
pub fn end(runtime: Runtime) {
    runtime.shutdown_timeout(Duration::from_millis(200));
}
