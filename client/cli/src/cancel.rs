//! `slabcast cancel`: ends a job before its last frame.

use crate::master_client::{MasterArg, ask};
use slabcast_session::fail::{Fail, say};

/// Cancels a job.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast cancel job-1795837666863
  slabcast cancel job-1795837666863 --master node1:7433")]
pub(crate) struct CancelArgs {
    /// The job, as `slabcast jobs` names it, like job-1795837666863
    job: String,
    #[command(flatten)]
    master: MasterArg,
}

/// Runs `slabcast cancel`.
pub(crate) fn run(args: &CancelArgs) -> Result<(), Fail> {
    let (before, after) = ask(&args.master.address, async |client| {
        let before = client.job(&args.job).await?;
        Ok((before, client.cancel(&args.job).await?))
    })?;
    let frames = format!("{} of {} frames done", after.frames_done, after.frames_total);
    if before.state.is_final() {
        return Err(Fail::failed(format!(
            "{} is over already ({}, {frames}); there is nothing to cancel",
            args.job, after.state
        )));
    }
    say(&format!("{} {}, {frames}\n", args.job, after.state))
}
