//! The runtime of every command that has a network or a cluster: a thread or two that talk, while
//! render threads draw.

use crate::fail::{Fail, reason};
use crate::machine::cores;
use slabcast_common::link::stream_threads;
use std::time::Duration;
use tokio::runtime::{Builder, Runtime};

/// Starts the runtime of a command with streams: [`stream_threads`] threads for this machine's
/// cores.
///
/// # Errors
/// The system gives no threads.
pub fn start() -> Result<Runtime, Fail> {
    with_threads(stream_threads(cores()))
}

/// Render threads up to which a worker has one thread for its streams.
const FEW: u32 = 8;

/// Starts the runtime of a worker: one thread for its streams up to eight render threads,
/// else as [`start`].
///
/// A second thread wakes for each lease and finds nothing to do: a ping takes a worker 38 us of
/// processors with two threads and 24 with one.
///
/// # Errors
/// The system gives no threads.
pub fn start_worker(render_threads: u32) -> Result<Runtime, Fail> {
    if render_threads <= FEW { with_threads(1) } else { start() }
}

/// Starts the runtime of a cluster in this process: one thread.
///
/// Messages are passed on and nothing is encoded; a second thread would take the render
/// threads' cores.
///
/// # Errors
/// The system gives no threads.
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

/// Ends a runtime within 200 ms, whatever its threads still do.
pub fn end(runtime: Runtime) {
    runtime.shutdown_timeout(Duration::from_millis(200));
}
