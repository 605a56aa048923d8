//! `slabcast check`: are the pixels exact?
//!
//! A frame's bytes must not depend on who rendered it (DESIGN.md, Pixels are exact). `matrix`
//! renders views over every way to cut and carry the work and compares their hashes with the
//! serial renderer's; `golden` prints hashes that have to be the same on every machine, build
//! and day. This room belongs to the program because only here all crates can be seen.

mod cases;
mod golden;
mod matrix;
mod pairwise;

use crate::fail::Fail;

/// Checks that pixels are exact.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast check matrix --pairwise          every pair of settings at least once: minutes
  slabcast check matrix brain.nii.gz        all of them: an hour
  slabcast check golden --verify tests/golden.txt")]
pub(crate) struct CheckArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum What {
    Matrix(matrix::MatrixArgs),
    Golden(golden::GoldenArgs),
}

/// Runs the command.
pub(crate) fn run(args: &CheckArgs) -> Result<(), Fail> {
    match &args.what {
        What::Matrix(args) => matrix::run(args),
        What::Golden(args) => golden::run(args),
    }
}
