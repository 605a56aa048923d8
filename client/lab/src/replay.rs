//! `slabcast lab replay`: makes a recorded scheduler's decisions again and compares them.

use slabcast_master::record::{RecordError, ReplaySummary, replay};
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress;
use std::fs::File;
use std::io::BufReader;
use std::path::PathBuf;

/// Makes a recorded run's decisions again and compares.
///
/// Exit code 0 where they are, 1 where one differs or the file is broken; the line is named.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast master --volume brain.nii.gz --record events.log
  slabcast render brain.nii.gz --workers 4 --record events.log
  slabcast lab replay events.log")]
pub struct ReplayArgs {
    /// What --record wrote; FILE.part of a master that was killed will do
    file: PathBuf,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Runs `slabcast lab replay`.
pub fn run(args: &ReplayArgs) -> Result<(), Fail> {
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
