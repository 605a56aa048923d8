//! Panics of threads beside the driver, as values.
//!
//! Such a thread works for one job. If it panicked past its work, that job would wait for ever,
//! and with the last finisher gone so would every job after it. So the work is run inside
//! [`caught`], and a panic comes back to the driver as the reason why the job failed.

use std::panic::AssertUnwindSafe;

/// A panic that was caught.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{work} panicked: {message}")]
pub(crate) struct Panicked {
    /// The work that panicked, as a gerund ("cutting bricks").
    pub(crate) work: &'static str,
    /// The panic's message.
    pub(crate) message: String,
}

/// Runs `f`, which does `work`. Whatever `f` holds by reference must be dropped after a panic.
pub(crate) fn caught<T>(work: &'static str, f: impl FnOnce() -> T) -> Result<T, Panicked> {
    std::panic::catch_unwind(AssertUnwindSafe(f)).map_err(|panic| {
        let message = panic
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| panic.downcast_ref::<&str>().copied())
            .unwrap_or("a panic without a message")
            .to_string();
        Panicked { work, message }
    })
}
