//! `--record`: a scheduler's events and decisions, written to a file that `slabcast lab replay`
//! reads.
//!
//! A record grows under FILE.part and gets its name when its last line is written: a master that
//! is killed leaves FILE.part, which replays as far as it goes.

use crate::fail::Fail;
use crate::progress;
use slabcast_master::record::{self as log, RecordSummary, Recorder};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

/// A record that is being written.
pub struct Recording {
    path: PathBuf,
    part: PathBuf,
    thread: JoinHandle<std::io::Result<RecordSummary>>,
}

/// Checks that `--record` can write to `path`.
///
/// # Errors
/// The path is a folder or one of the run's inputs.
pub fn check_path(path: &Path, inputs: &[&Path]) -> Result<(), Fail> {
    crate::output::refuse_input(path, "record", inputs)?;
    if path.is_dir() {
        return Err(Fail::failed(format!("{}: is a folder; give a file", path.display())));
    }
    Ok(())
}

/// Starts a record; the [`Recorder`] goes to the master.
///
/// # Errors
/// The file or the recorder's thread can't be made.
pub fn start(path: &Path) -> Result<(Recorder, Recording), Fail> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = PathBuf::from(part);
    let file = File::create(&part).map_err(|e| Fail::io(&part, "making the file", &e))?;
    let (recorder, thread) = log::start(file).map_err(|e| {
        Fail::failed(format!("starting the recorder failed: {}", crate::fail::reason(&e)))
    })?;
    Ok((recorder, Recording { path: path.into(), part, thread }))
}

impl Recording {
    /// Waits for the last line and renames the file. The master must have ended.
    ///
    /// # Errors
    /// The record couldn't be written.
    pub fn end(self) -> Result<(), Fail> {
        let Recording { path, part, thread } = self;
        let written = match thread.join() {
            Ok(written) => written.map_err(|e| Fail::io(&part, "writing the record", &e))?,
            Err(_) => return Err(Fail::failed("the thread that writes --record failed")),
        };
        let named = File::open(&part)
            .and_then(|f| f.sync_all())
            .and_then(|()| std::fs::rename(&part, &path));
        named.map_err(|e| Fail::io(&path, "writing the record", &e))?;
        if let Some(why) = written.cut {
            progress::warn(&format!("{} ends early: {why}", path.display()));
        }
        tracing::info!(
            path = %path.display(), events = written.events, decisions = written.decisions,
            "recorded"
        );
        Ok(())
    }
}
