//! A child process that is killed when its time is up, and when nobody waits for it any more.

use std::process::{Child, ChildStderr, ChildStdout, Command, ExitStatus};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Longest time that a process may go on after its pipes are closed.
const END: Duration = Duration::from_secs(1);

/// A running child process; dropping it kills and reaps it.
pub(super) struct Watched {
    child: Arc<Mutex<Child>>,
    late: Arc<AtomicBool>,
    /// Dropped to end the watchdog.
    over: Option<Sender<()>>,
    watchdog: Option<JoinHandle<()>>,
}

fn lock(child: &Mutex<Child>) -> MutexGuard<'_, Child> {
    child.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

impl Watched {
    /// Starts a command with piped output, and kills it after `limit` by the wall clock.
    ///
    /// # Errors
    /// The program or the watching thread can't be started.
    pub(super) fn start(
        command: &mut Command,
        limit: Duration,
    ) -> std::io::Result<(Watched, ChildStdout, ChildStderr)> {
        let mut child = command.spawn()?;
        let pipes = child.stdout.take().zip(child.stderr.take());
        let (child, late) = (Arc::new(Mutex::new(child)), Arc::new(AtomicBool::new(false)));
        let (over, ended) = mpsc::channel();
        let mut watched =
            Watched { child: child.clone(), late: late.clone(), over: Some(over), watchdog: None };
        let watch = move || {
            if ended.recv_timeout(limit) == Err(RecvTimeoutError::Timeout) {
                late.store(true, Relaxed);
                // Fails only if it has ended.
                let _ = lock(&child).kill();
            }
        };
        let builder = std::thread::Builder::new().name("slabcast-watch".into());
        watched.watchdog = Some(builder.spawn(watch)?);
        let (stdout, stderr) = pipes.ok_or_else(|| std::io::Error::other("it has no pipes"))?;
        Ok((watched, stdout, stderr))
    }

    /// Waits for the end of a process whose pipes are closed, and kills it if it lingers.
    ///
    /// # Errors
    /// The system call that waits for the process fails.
    pub(super) fn end(&mut self) -> std::io::Result<ExitStatus> {
        let since = Instant::now();
        loop {
            if let Some(status) = lock(&self.child).try_wait()? {
                return Ok(status);
            }
            if since.elapsed() > END {
                let _ = lock(&self.child).kill();
                return lock(&self.child).wait();
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Returns whether the process was killed because its time was up.
    pub(super) fn is_late(&self) -> bool {
        self.late.load(Relaxed)
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        {
            let mut child = lock(&self.child);
            // Both fail only if it has ended already.
            let _ = child.kill();
            let _ = child.wait();
        }
        self.over = None;
        if let Some(watchdog) = self.watchdog.take() {
            let _ = watchdog.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;
    use std::process::Stdio;

    fn start(script: &str, limit: Duration) -> (Watched, ChildStdout, ChildStderr) {
        let mut command = Command::new("sh");
        command.args(["-c", script]).stdin(Stdio::null());
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        Watched::start(&mut command, limit).expect("a shell")
    }

    #[test]
    fn process_that_only_waits_is_killed_when_its_time_is_up() {
        let since = Instant::now();
        let (mut child, mut stdout, _) = start("exec sleep 600", Duration::from_millis(50));
        let mut all = Vec::new();
        stdout.read_to_end(&mut all).unwrap();
        assert!(!child.end().unwrap().success());
        assert!(child.is_late() && all.is_empty());
        assert!(since.elapsed() < Duration::from_secs(60), "{:?}", since.elapsed());
    }

    #[test]
    fn process_that_closes_its_pipes_and_lingers_is_killed() {
        let since = Instant::now();
        let (mut child, mut stdout, mut stderr) =
            start("exec >&- 2>&- sleep 600", Duration::from_secs(600));
        let mut all = String::new();
        stdout.read_to_string(&mut all).unwrap();
        stderr.read_to_string(&mut all).unwrap();
        assert!(!child.end().unwrap().success());
        assert!(!child.is_late());
        assert!(since.elapsed() < Duration::from_secs(60), "{:?}", since.elapsed());
    }

    #[test]
    fn process_that_ends_tells_its_status_and_one_nobody_waits_for_is_killed() {
        let (mut child, ..) = start("exit 3", Duration::from_secs(600));
        assert_eq!(child.end().unwrap().code(), Some(3));
        let since = Instant::now();
        drop(start("exec sleep 600", Duration::from_secs(600)));
        assert!(since.elapsed() < Duration::from_secs(60), "{:?}", since.elapsed());
    }
}
