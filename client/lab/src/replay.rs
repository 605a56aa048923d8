//! `slabcast lab replay`: makes a recorded scheduler's decisions again and compares them.

use slabcast_master::record::{RecordError, ReplaySummary, replay};
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress;
use std::fs::File;
use std::io::BufReader;
use std::path::PathBuf;

/// Makes a recorded run's decisions again and compares.
///
/// Exit code 0 if all decisions are the same, 1 if one differs or the file is broken; the message
/// names the line.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast master --volume brain.nii.gz --record events.log
  slabcast render brain.nii.gz --workers 4 --record events.log
  slabcast lab replay events.log")]
pub struct ReplayArgs {
    /// File that --record wrote, or the FILE.part of a master that was killed
    file: PathBuf,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Runs `slabcast lab replay`: prints the numbers of events and decisions, or JSON with `--json`.
///
/// # Errors
/// The file can't be read, a line of it is no event, or a decision differs from the recorded one.
pub fn run(args: &ReplayArgs) -> Result<(), Fail> {
    let shown = args.file.display().to_string();
    let file = File::open(&args.file).map_err(|e| Fail::io(&args.file, "opening", &e))?;
    // In its own thread, since a forged file may make the scheduler panic.
    let replaying = std::thread::spawn(move || replay(BufReader::with_capacity(1 << 18, file)));
    let done = match replaying.join() {
        Ok(done) => done,
        Err(_) => {
            return Err(Fail::failed(format!(
                "{shown}: the scheduler panicked on it; give an unaltered file that --record wrote"
            )));
        }
    };
    let done = done.map_err(|RecordError { line, problem }| {
        Fail::failed(format!("{shown}: line {line}: {problem}"))
    })?;
    let ReplaySummary { events, decisions, frames, program, cut, difference } = &done;
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
             recorded `{}`, replayed `{}`; slabcast {program} recorded it, and another build may \
             decide otherwise",
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
