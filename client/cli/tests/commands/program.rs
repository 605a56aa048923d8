//! The real program, run by tests in folders of their own.

#[path = "../../../../tests/support/processes.rs"]
mod processes;

pub(crate) use processes::{Process, master, signal, slabcast, worker};

use std::path::Path;
use std::process::{Child, Output};
use std::time::{Duration, Instant};

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

/// Waits until `done` returns true. Fails the test after a minute.
pub(crate) fn wait_until(what: &str, done: impl Fn() -> bool) {
    let until = Instant::now() + Duration::from_secs(60);
    while !done() {
        assert!(Instant::now() < until, "{what}: not within a minute");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Waits until a file contains `text`. Fails the test after a minute.
pub(crate) fn wait_for_text(file: &Path, text: &str) {
    let until = Instant::now() + Duration::from_secs(60);
    while !std::fs::read_to_string(file).is_ok_and(|t| t.contains(text)) {
        assert!(Instant::now() < until, "{} never contained `{text}`", file.display());
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Waits for the exit code; -1 if a signal ended the child. Fails the test after `within`.
pub(crate) fn end(child: &mut Child, within: Duration) -> i32 {
    processes::exit_within(child, within).unwrap_or(-1)
}
