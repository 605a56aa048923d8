//! `slabcast lab`: the laboratory, one subcommand an experiment.
//!
//! Until version 0.3 each experiment also runs under its old top-level name (`slabcast lab error`),
//! which is hidden and says where it went.

use slabcast_lab::{bench, check, error, explain, plan, replay, report, study};
use slabcast_session::fail::Fail;
use slabcast_session::progress;

/// Experiments: error report study check bench explain plan replay.
///
/// error and explain look at one picture, bench and report at quality against time, plan and study
/// at clusters; check compares pictures with the oracle, replay a recorded run with itself.
#[derive(clap::Args, Clone, Debug)]
#[command(
    about = "error report study check bench explain plan replay",
    disable_help_subcommand = true,
    subcommand_value_name = "COMMAND",
    after_help = "\
Examples:
  slabcast lab error brain.nii.gz                   how far a picture is from the truth
  slabcast lab plan ct.nrrd --workers 1..64         what a cluster would do
  slabcast help lab error                           all of a command's help"
)]
pub(crate) struct LabArgs {
    #[command(subcommand)]
    command: LabCommand,
}

/// One experiment.
#[derive(clap::Subcommand, Clone, Debug)]
pub(crate) enum LabCommand {
    Error(Box<error::ErrorArgs>),
    Report(Box<report::ReportArgs>),
    Study(Box<study::StudyArgs>),
    Check(check::CheckArgs),
    Bench(Box<bench::BenchArgs>),
    Explain(Box<explain::ExplainArgs>),
    Plan(Box<plan::PlanArgs>),
    Replay(replay::ReplayArgs),
}

/// Names of the experiments, which are hidden at the top level.
pub(crate) const NAMES: [&str; 8] =
    ["error", "report", "study", "check", "bench", "explain", "plan", "replay"];

impl LabCommand {
    /// Name of the subcommand.
    fn name(&self) -> &'static str {
        match self {
            LabCommand::Error(_) => "error",
            LabCommand::Report(_) => "report",
            LabCommand::Study(_) => "study",
            LabCommand::Check(_) => "check",
            LabCommand::Bench(_) => "bench",
            LabCommand::Explain(_) => "explain",
            LabCommand::Plan(_) => "plan",
            LabCommand::Replay(_) => "replay",
        }
    }

    /// Runs the experiment.
    pub(crate) fn run(&self) -> Result<(), Fail> {
        match self {
            LabCommand::Error(args) => error::run(args),
            LabCommand::Report(args) => report::run(args),
            LabCommand::Study(args) => study::run(args),
            LabCommand::Check(args) => check::run(args),
            LabCommand::Bench(args) => bench::run(args),
            LabCommand::Explain(args) => explain::run(args),
            LabCommand::Plan(args) => plan::run(args),
            LabCommand::Replay(args) => replay::run(args),
        }
    }

    /// Runs the experiment under its old name, after a notice on stderr.
    pub(crate) fn run_by_old_name(&self) -> Result<(), Fail> {
        let name = self.name();
        progress::say_on_stderr(&format!("slabcast {name} is now slabcast lab {name}"));
        self.run()
    }
}

/// Runs `slabcast lab`.
pub(crate) fn run(args: &LabArgs) -> Result<(), Fail> {
    args.command.run()
}
