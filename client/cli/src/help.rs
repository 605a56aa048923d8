//! `slabcast help`: all of a command's help.

use clap::Command;
use slabcast_session::fail::Fail;

/// Shows all of a command's help.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast help render
  slabcast help lab error")]
pub(crate) struct HelpArgs {
    /// The command; none for an overview
    #[arg(value_name = "COMMAND")]
    words: Vec<String>,
}

/// Prints the help of the subcommand of `root` that `args` names.
pub(crate) fn run(args: &HelpArgs, mut root: Command) -> Result<(), Fail> {
    root.build();
    let mut command = &mut root;
    for (n, word) in args.words.iter().enumerate() {
        let before = ["slabcast"].into_iter().chain(args.words[..n].iter().map(String::as_str));
        let before = before.collect::<Vec<_>>().join(" ");
        command = command.find_subcommand_mut(word).ok_or_else(|| {
            Fail::usage(format!("help: there is no `{before} {word}`; see `{before} --help`"))
        })?;
    }
    // A reader that has gone away is silent.
    let _ = command.print_long_help();
    Ok(())
}
