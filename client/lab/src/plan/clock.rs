//! The processor time of this thread.
//!
//! The time of a tile is the time it takes on a core. A wall clock would also count the time this
//! thread waits for a core that another program has.

/// Returns the ns that this thread has run on a processor.
#[cfg(unix)]
pub(crate) fn cpu_ns() -> u64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as u64 * 1_000_000_000 + t.tv_nsec as u64
}

/// Returns the ns since the first call, by the wall clock.
#[cfg(not(unix))]
pub(crate) fn cpu_ns() -> u64 {
    static BEGAN: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    BEGAN.get_or_init(std::time::Instant::now).elapsed().as_nanos() as u64
}
