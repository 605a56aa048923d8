//! `slabcast completions`: what a shell offers after the tabulator key.

use clap::Command;
use slabcast_session::fail::{Fail, say};

/// Prints completions for a shell.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast completions bash > ~/.local/share/bash-completion/completions/slabcast
  slabcast completions fish > ~/.config/fish/completions/slabcast.fish")]
pub(crate) struct CompletionsArgs {
    /// bash, zsh, fish, elvish or powershell
    shell: clap_complete::Shell,
}

/// Prints the script.
pub(crate) fn run(args: &CompletionsArgs, mut root: Command) -> Result<(), Fail> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut root, "slabcast", &mut script);
    say(&String::from_utf8_lossy(&script))
}
