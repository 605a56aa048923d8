//! Time on a processor.
//!
//! A tile's time is what it takes of a core. While this thread waits for one (other programs run
//! here, too) a clock on the wall goes on, and a thread's own does not.

/// Nanoseconds that this thread has been on a processor.
#[cfg(unix)]
pub(crate) fn cpu_ns() -> u64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as u64 * 1_000_000_000 + t.tv_nsec as u64
}

/// Nanoseconds since the first call.
#[cfg(not(unix))]
pub(crate) fn cpu_ns() -> u64 {
    static BEGAN: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    BEGAN.get_or_init(std::time::Instant::now).elapsed().as_nanos() as u64
}
