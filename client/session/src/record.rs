//! `--record` and `slabcast replay`: a scheduler's decisions, written down and made again.
//!
//! A record grows under FILE.part and gets its name when its last line is written: a master that
//! is killed leaves FILE.part, which replays as far as it goes.

use crate::fail::{Fail, say};
use crate::progress;
use slabcast_master::record::{Broken, Recorder, Replayed, Written, replay, start};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

/// A record that is being written.
pub(crate) struct Recording {
    path: PathBuf,
    part: PathBuf,
    thread: JoinHandle<std::io::Result<Written>>,
}

/// Whether the record that `--record` asks for may lie there.
pub(crate) fn may(path: &Path, inputs: &[&Path]) -> Result<(), Fail> {
    crate::output::not_an_input(path, "record", inputs)?;
    if path.is_dir() {
        return Err(Fail::failed(format!("{}: is a folder; give a file", path.display())));
    }
    Ok(())
}

/// Begins it.
pub(crate) fn begin(path: &Path) -> Result<(Recorder, Recording), Fail> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = PathBuf::from(part);
    let file = File::create(&part).map_err(|e| Fail::io(&part, "making the file", &e))?;
    let (recorder, thread) = start(file).map_err(|e| {
        Fail::failed(format!("starting the recorder failed: {}", crate::fail::reason(&e)))
    })?;
    Ok((recorder, Recording { path: path.into(), part, thread }))
}

impl Recording {
    /// Waits for the last line and gives the file its name. The master must have ended.
    pub(crate) fn end(self) -> Result<(), Fail> {
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

/// Makes the decisions of a recorded run again, and says whether they are the same.
///
/// Exit code 0 where they are, 1 where one differs or the file is broken; the line is named.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast master --volume brain.nii.gz --record events.log
  slabcast render brain.nii.gz --workers 4 --record events.log
  slabcast replay events.log")]
pub(crate) struct ReplayArgs {
    /// What --record wrote; FILE.part of a master that was killed will do
    file: PathBuf,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Runs `slabcast replay`.
pub(crate) fn run(args: &ReplayArgs) -> Result<(), Fail> {
    let shown = args.file.display().to_string();
    let file = File::open(&args.file).map_err(|e| Fail::io(&args.file, "opening", &e))?;
    // A thread of its own: what the scheduler does not stand of a forged file ends it alone.
    let replaying = std::thread::spawn(move || replay(BufReader::with_capacity(1 << 18, file)));
    let done = match replaying.join() {
        Ok(done) => done,
        Err(_) => {
            return Err(Fail::failed(format!(
                "{shown}: the scheduler can't go on with what it says; no master wrote that"
            )));
        }
    };
    let done = done.map_err(|Broken { line, problem }| {
        Fail::failed(format!("{shown}: line {line}: {problem}"))
    })?;
    let Replayed { events, decisions, frames, program, cut, difference } = &done;
    if args.json {
        let json = serde_json::json!({
            "events": events, "decisions": decisions, "frames": frames, "recorded_by": program,
            "identical": difference.is_none(), "cut": cut,
            "difference": difference.as_ref().map(|d| serde_json::json!({
                "line": d.line, "recorded": d.recorded, "replayed": d.replayed
            })),
        });
        say(&format!("{json}\n"))?;
    }
    if let Some(d) = difference {
        return Err(Fail::failed(format!(
            "{shown}: line {}: after {events} events and {decisions} decisions that are the same, \
             recorded `{}`, replayed `{}`",
            d.line, d.recorded, d.replayed
        )));
    }
    if let Some(why) = cut {
        progress::note(&format!("{shown} ends early: {why}"));
    }
    if !args.json {
        let s = if *frames == 1 { "" } else { "s" };
        say(&format!("{events} events, {decisions} decisions, {frames} frame{s}: identical\n"))?;
    }
    Ok(())
}
