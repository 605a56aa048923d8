//! `slabcast jobs`: the jobs that a master remembers.

use crate::master_client::{MasterArg, ask, job_json, job_table};
use slabcast_session::fail::{Fail, say};

/// Lists the jobs that a master remembers, newest first.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast jobs
  slabcast jobs --master node1:7433 --limit 100 --json")]
pub(crate) struct JobsArgs {
    #[command(flatten)]
    master: MasterArg,
    /// At most so many
    #[arg(long, value_name = "N", default_value = "20",
          value_parser = clap::value_parser!(u32).range(1..=1000))]
    limit: u32,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Runs `slabcast jobs`.
pub(crate) fn run(args: &JobsArgs) -> Result<(), Fail> {
    let jobs = ask(&args.master.address, async |client| client.jobs(args.limit as usize).await)?;
    if args.json {
        let jobs: Vec<_> = jobs.iter().map(job_json).collect();
        return say(&format!("{:#}\n", serde_json::Value::Array(jobs)));
    }
    if jobs.is_empty() {
        return say("no jobs yet\n");
    }
    let mut out = String::new();
    job_table(&mut out, &jobs.iter().collect::<Vec<_>>());
    say(&out)
}
