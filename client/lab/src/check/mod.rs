//! `slabcast lab check`: tests of the shipped program against its promises.
//!
//! Without a subcommand: a `table` of cases, each with an error, its bound and a verdict. Pixels
//! must not depend on who rendered them: `matrix` renders views over every way to divide and carry
//! the work and compares their hashes with the serial renderer's; `golden` prints hashes that are
//! equal on every machine and build; `convergence` measures how fast pictures converge with thinner
//! sheets; `colour-rule` compares error, popping and time of the compositing rules. The checks are
//! here and not in a lower crate because they need all crates.

mod case;
mod cases;
mod changes;
mod closed;
pub(crate) mod cluster;
mod colour_rule;
mod convergence;
mod enclose;
mod extreme;
mod fields;
mod golden;
mod invariance;
mod invariance_scenes;
mod looks;
mod matrix;
mod pairwise;
mod scenes;
pub(crate) mod shot;
mod table;

use slabcast_session::fail::Fail;

/// Checks that pictures are right, stable and exact.
///
/// Draws stiff, extreme and other telling scenes, alone and by clusters in this process, and
/// prints a table with the error of each (in 1/255, unless it says otherwise), the bound that it
/// must keep, and whether it held.
#[derive(clap::Args, Clone, Debug)]
#[command(
    args_conflicts_with_subcommands = true,
    after_long_help = "\
Examples:
  slabcast lab check                            every case of the table: four minutes
  slabcast lab check --group extreme --long     one group, with its long cases
  slabcast lab check --list                     names of the cases
  slabcast lab check matrix --pairwise          every pair of settings at least once: minutes
  slabcast lab check matrix brain.nii.gz        all of them: an hour
  slabcast lab check convergence                error by thickness of the sheets: a minute
  slabcast lab check colour-rule brain.nii.gz   error and time of each compositing rule
  slabcast lab check golden --verify tests/golden.txt"
)]
pub struct CheckArgs {
    #[command(subcommand)]
    campaign: Option<Campaign>,
    #[command(flatten)]
    table: table::TableArgs,
}

/// A campaign of its own, beside the table of cases.
#[derive(clap::Subcommand, Clone, Debug)]
enum Campaign {
    Matrix(matrix::MatrixArgs),
    Golden(golden::GoldenArgs),
    Convergence(Box<convergence::ConvergenceArgs>),
    ColourRule(Box<colour_rule::ColourRuleArgs>),
}

/// Runs `slabcast lab check`: the table of cases, or the named campaign.
///
/// # Errors
/// The arguments or the volume are refused, a case fails, or the user stopped it.
pub fn run(args: &CheckArgs) -> Result<(), Fail> {
    match &args.campaign {
        None => table::run(&args.table),
        Some(Campaign::Matrix(args)) => matrix::run(args),
        Some(Campaign::Golden(args)) => golden::run(args),
        Some(Campaign::Convergence(args)) => convergence::run(args),
        Some(Campaign::ColourRule(args)) => colour_rule::run(args),
    }
}
