//! The real program, run by tests in folders of their own.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

pub(crate) const SLABCAST: &str = env!("CARGO_BIN_EXE_slabcast");

/// The program in `dir`, without what this machine's user has told it by other ways.
pub(crate) fn slabcast(dir: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(SLABCAST);
    command.args(args).current_dir(dir).stdin(Stdio::null());
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("SLABCAST_")) {
        command.env_remove(name);
    }
    command
}

pub(crate) fn run(dir: &Path, args: &[&str]) -> Output {
    slabcast(dir, args).output().expect("the program starts")
}

/// Runs what has to end well; gives stdout.
#[track_caller]
pub(crate) fn good(dir: &Path, args: &[&str]) -> String {
    let out = run(dir, args);
    assert!(out.status.success(), "slabcast {}\n{}", args.join(" "), text(&out.stderr));
    text(&out.stdout)
}

pub(crate) fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Names in a folder, in order; none where it is not there.
pub(crate) fn names(dir: &Path) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(dir) else { return Vec::new() };
    let mut names: Vec<String> =
        entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// Waits for an end, or fails the test.
pub(crate) fn end(child: &mut Child, within: Duration) -> i32 {
    let until = Instant::now() + within;
    while Instant::now() < until {
        if let Some(status) = child.try_wait().unwrap() {
            return status.code().unwrap_or(-1);
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    let _ = child.kill();
    panic!("still running after {within:?}");
}

pub(crate) fn signal(child: &Child, name: &str) {
    let status = Command::new("kill").args([name, &child.id().to_string()]).status().unwrap();
    assert!(status.success());
}

/// A process that does not outlive its test.
pub(crate) struct Process(pub(crate) Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A master of a volume at a free port, and its address.
pub(crate) fn master(dir: &Path, volume: &str, more: &[&str]) -> (Process, String) {
    let args = ["master", "--listen", "127.0.0.1:0", "--volume", volume];
    let mut child = slabcast(dir, &[&args[..], more].concat())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let address = line.trim().rsplit(' ').next().unwrap().to_string();
    (Process(child), address)
}
