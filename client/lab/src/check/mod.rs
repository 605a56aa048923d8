//! `slabcast lab check`: tests of the shipped program against its promises.
//!
//! Without a subcommand: a [`table`] of cases, each with an error, its bound and a verdict. Pixels
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
    after_help = "\
Examples:
  slabcast lab check                            every case of the table: two minutes
  slabcast lab check --group extreme --long     one group, with its long cases
  slabcast lab check --list                     which cases there are
  slabcast lab check matrix --pairwise          every pair of settings at least once: minutes
  slabcast lab check matrix brain.nii.gz        all of them: an hour
  slabcast lab check convergence                how fast thin sheets come to the limit: a minute
  slabcast lab check colour-rule brain.nii.gz   what each rule of compositing buys and costs
  slabcast lab check golden --verify tests/golden.txt"
)]
pub struct CheckArgs {
    #[command(subcommand)]
    what: Option<What>,
    #[command(flatten)]
    table: table::TableArgs,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum What {
    Matrix(matrix::MatrixArgs),
    Golden(golden::GoldenArgs),
    Convergence(Box<convergence::ConvergenceArgs>),
    ColourRule(Box<colour_rule::ColourRuleArgs>),
}

/// Runs the command.
pub fn run(args: &CheckArgs) -> Result<(), Fail> {
    match &args.what {
        None => table::run(&args.table),
        Some(What::Matrix(args)) => matrix::run(args),
        Some(What::Golden(args)) => golden::run(args),
        Some(What::Convergence(args)) => convergence::run(args),
        Some(What::ColourRule(args)) => colour_rule::run(args),
    }
}
