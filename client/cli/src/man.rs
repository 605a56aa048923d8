//! `slabcast man`: manual pages.

use clap::Command;
use slabcast_session::fail::{Fail, say};
use std::path::PathBuf;

/// Prints the manual page, or writes one for each command.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast man | man -l -
  slabcast man /usr/local/share/man/man1")]
pub(crate) struct ManArgs {
    /// Folder for slabcast.1, slabcast-render.1 and so on
    dir: Option<PathBuf>,
}

/// Prints the page, or writes all.
pub(crate) fn run(args: &ManArgs, root: Command) -> Result<(), Fail> {
    if let Some(dir) = &args.dir {
        return clap_mangen::generate_to(root, dir)
            .map_err(|e| Fail::io(dir, "writing manual pages", &e));
    }
    let mut page = Vec::new();
    let written = clap_mangen::Man::new(root).render(&mut page);
    written.map_err(|e| Fail::failed(e.to_string()))?;
    say(&String::from_utf8_lossy(&page))
}
