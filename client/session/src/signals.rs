//! Ctrl-C, SIGTERM and SIGHUP.

use crate::fail::Fail;
use crate::progress;
use std::sync::atomic::{AtomicU8, Ordering};
use tokio::sync::Notify;

static CODE: AtomicU8 = AtomicU8::new(0);
static TOLD: Notify = Notify::const_new();

/// Starts to listen; without it signals end the process at once, as ever. A second signal does
/// that all the same: whoever presses Ctrl-C twice means it.
#[cfg(unix)]
pub fn listen() {
    use tokio::signal::unix::{SignalKind, signal};
    let mut kinds = vec![(SignalKind::interrupt(), 130), (SignalKind::terminate(), 143)];
    // `nohup` has it ignored, and that stays.
    if !is_hangup_ignored() {
        kinds.push((SignalKind::hangup(), 129));
    }
    for (kind, code) in kinds {
        // No handler can be had on systems without signals: they keep their own ways.
        let Ok(mut stream) = signal(kind) else { continue };
        tokio::spawn(async move {
            while stream.recv().await.is_some() {
                if CODE.swap(code, Ordering::SeqCst) != 0 {
                    std::process::exit(code.into());
                }
                TOLD.notify_waiters();
            }
        });
    }
}

/// Whether the process was started to outlive its terminal.
#[cfg(unix)]
fn is_hangup_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|m| m & 1 != 0)
}

/// Starts to listen for Ctrl-C, which then no longer ends the process at once; a second one does.
#[cfg(not(unix))]
pub fn listen() {
    tokio::spawn(async {
        while tokio::signal::ctrl_c().await.is_ok() {
            if CODE.swap(130, Ordering::SeqCst) != 0 {
                std::process::exit(130);
            }
            TOLD.notify_waiters();
        }
    });
}

/// Waits until the process is told to stop and returns the exit code for it (128 + signal).
pub async fn stopped() -> u8 {
    loop {
        let told = TOLD.notified();
        match CODE.load(Ordering::SeqCst) {
            0 => told.await,
            code => return code,
        }
    }
}

/// Returns whether the process was told to stop.
pub fn stop_requested() -> bool {
    CODE.load(Ordering::SeqCst) != 0
}

/// Runs `work` on a thread of its own until it ends or the process is told to stop.
///
/// A stop ends the command at once and the thread with it, so `work` must leave nothing half
/// done on disk.
///
/// # Errors
/// Returns those of `work`; a failure with code 130 or 143 after a stop.
pub fn run_unless_stopped<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Fail> + Send + 'static,
) -> Result<T, Fail> {
    watched(work, false)
}

/// Runs `work` on a thread of its own and waits for it also after a stop. `work` asks
/// [`stop_requested`] often, ends early and removes its half-written files.
///
/// # Errors
/// Returns those of `work`; a failure with code 130 or 143 after a stop.
pub fn run_to_end<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Fail> + Send + 'static,
) -> Result<T, Fail> {
    watched(work, true)
}

fn watched<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Fail> + Send + 'static,
    to_its_end: bool,
) -> Result<T, Fail> {
    let failed = |e: std::io::Error| Fail::failed(format!("starting threads failed: {e}"));
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(failed)?;
    runtime.block_on(async {
        listen();
        let (done, mut result) = tokio::sync::oneshot::channel();
        std::thread::Builder::new()
            .name("slabcast-work".into())
            // Nobody waits for the result of a command that was stopped.
            .spawn(move || drop(done.send(work())))
            .map_err(failed)?;
        tokio::select! {
            result = &mut result => result.unwrap_or_else(|_| Err(Fail::silent(1))),
            code = stopped() => {
                if to_its_end {
                    let _ = result.await;
                }
                progress::end();
                Err(Fail::silent(code))
            }
        }
    })
}
