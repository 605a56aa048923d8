//! Integration with systemd: what `master` and `worker` report to it (sd_notify), the sockets it
//! listens on, and the time that they have to stop.

use slabcast_master::Handle;
use std::time::Duration;

/// Time that a master or worker has to stop gracefully once it is told to (docs/design/promises.md
/// R29).
pub(crate) const DRAIN: Duration = Duration::from_secs(10);

#[cfg(target_os = "linux")]
fn tell(states: &[sd_notify::NotifyState<'_>]) {
    if let Err(e) = sd_notify::notify(states) {
        tracing::warn!(error = %e, "systemd could not be notified");
    }
}

/// Tells systemd that the process serves, with a status line.
pub(crate) fn ready(status: &str) {
    #[cfg(target_os = "linux")]
    tell(&[sd_notify::NotifyState::Ready, sd_notify::NotifyState::Status(status)]);
    #[cfg(not(target_os = "linux"))]
    let _ = status;
}

/// Tells systemd that the process is about to end.
pub(crate) fn stopping() {
    #[cfg(target_os = "linux")]
    tell(&[sd_notify::NotifyState::Stopping]);
}

/// Answers the watchdog twice in its time. A master answers only while its driver does: a
/// process that breathes but takes no event is to be restarted.
pub(crate) async fn watchdog(handle: Option<Handle>) {
    #[cfg(target_os = "linux")]
    if let Some(within) = sd_notify::watchdog_enabled() {
        let mut beat = tokio::time::interval((within / 2).max(Duration::from_millis(1)));
        loop {
            beat.tick().await;
            if let Some(handle) = &handle
                && tokio::time::timeout(within, handle.workers()).await.is_err()
            {
                continue;
            }
            tell(&[sd_notify::NotifyState::Watchdog]);
        }
    }
    #[cfg(not(target_os = "linux"))]
    let _ = (handle, Duration::ZERO);
}
