//! Real processes for tests: the program, masters and workers on localhost. A process does not
//! outlive its test, and nothing here sleeps to wait.

#![allow(dead_code, reason = "each test program uses a part of it")]

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::time::Duration;

pub(crate) const SLABCAST: &str = env!("CARGO_BIN_EXE_slabcast");

/// The program in `dir`, without the settings that this machine's user keeps in variables.
pub(crate) fn slabcast(dir: &Path, args: &[&str]) -> Command {
    command(SLABCAST.as_ref(), dir, args)
}

/// A build of the program in `dir`, as [`slabcast`].
pub(crate) fn command(program: &Path, dir: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(program);
    command.args(args).current_dir(dir).stdin(Stdio::null());
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("SLABCAST_")) {
        command.env_remove(name);
    }
    command
}

/// A process that does not outlive its test.
pub(crate) struct Process(pub(crate) Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Process {
    /// Sends a signal by its option of `kill` (`-TERM`).
    pub(crate) fn signal(&self, name: &str) {
        signal(&self.0, name);
    }

    /// Waits for the exit code; `None` if a signal ended the process.
    ///
    /// # Panics
    /// If it still runs after `limit`.
    pub(crate) fn exit_within(&mut self, limit: Duration) -> Option<i32> {
        exit_within(&mut self.0, limit)
    }
}

/// Sends a signal by its option of `kill` (`-TERM`).
pub(crate) fn signal(child: &Child, name: &str) {
    let status = Command::new("kill").args([name, &child.id().to_string()]).status();
    assert!(status.expect("kill is there").success());
}

/// Waits for the exit code of a child; `None` if a signal ended it.
///
/// # Panics
/// If it still runs after `limit`. It is killed then.
pub(crate) fn exit_within(child: &mut Child, limit: Duration) -> Option<i32> {
    let pid = child.id().to_string();
    let (ended, wait) = mpsc::channel::<()>();
    let watchdog = std::thread::spawn(move || {
        let is_late = wait.recv_timeout(limit) == Err(mpsc::RecvTimeoutError::Timeout);
        if is_late {
            let _ = Command::new("kill").args(["-KILL", &pid]).status();
        }
        is_late
    });
    let status = child.wait().expect("a child of this test");
    drop(ended);
    assert!(!watchdog.join().expect("the watchdog does not panic"), "ran longer than {limit:?}");
    status.code()
}

/// Starts a master of `volume` at a free port. Returns it with its address.
pub(crate) fn master(dir: &Path, volume: &str, more: &[&str]) -> (Process, String) {
    master_with(dir, "127.0.0.1:0", &[&["--volume", volume], more].concat())
}

/// Starts a master with these flags that listens at an address. Returns it with its address.
pub(crate) fn master_with(dir: &Path, listen: &str, flags: &[&str]) -> (Process, String) {
    let (master, line) = first_line(dir, &[&["master", "--listen", listen], flags].concat());
    let address = line.strip_prefix("listening on ").expect(&line).to_string();
    (master, address)
}

/// Starts the program with these arguments. Returns the process with the first line of its standard output.
pub(crate) fn first_line(dir: &Path, arguments: &[&str]) -> (Process, String) {
    let mut child = slabcast(dir, arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("the program starts");
    let mut line = String::new();
    let out = child.stdout.take().expect("piped");
    BufReader::new(out).read_line(&mut line).expect("a line");
    (Process(child), line.trim().to_string())
}

/// Starts a worker of a master.
pub(crate) fn worker(dir: &Path, master: &str, name: &str, more: &[&str]) -> Process {
    let args = ["worker", "--master", master, "--name", name];
    let child = slabcast(dir, &[&args[..], more].concat())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the worker starts");
    Process(child)
}
