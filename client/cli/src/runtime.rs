//! The runtime of every command that has a network or a cluster: two threads that talk, while
//! render threads draw.

use crate::fail::{Fail, reason};
use std::time::Duration;
use tokio::runtime::{Builder, Runtime};

/// Starts it.
pub(crate) fn start() -> Result<Runtime, Fail> {
    Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("slabcast-io")
        .enable_all()
        .build()
        .map_err(|e| Fail::failed(format!("starting threads failed: {}", reason(&e))))
}

/// Ends it. A thread that still encodes, draws or resolves a name must not hold a command up.
pub(crate) fn end(runtime: Runtime) {
    runtime.shutdown_timeout(Duration::from_millis(200));
}
