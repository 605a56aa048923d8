//! The `slabcast` program: what is typed, which command that is, and how it ended.
//!
//! [`mod@command`] lists the subcommands; each has a file of its own, but for those of the
//! laboratory ([`lab`], crate `slabcast_lab`). [`config`] lays flags, environment and file over
//! each other, [`usage`] says what is wrong with a command line, [`logging`] begins to log. What
//! renders a request is in `slabcast_session`.
//!
//! This is the only crate that sees all others. It decides nothing about pixels and schedules.
//! Results go to stdout, everything else to stderr; every failure is one line
//! (`slabcast_session::fail`).

mod at_master;
mod cancel;
mod command;
mod compare;
mod completions;
mod config;
mod convert;
mod demo;
mod doctor;
mod help;
mod info;
mod jobs;
mod lab;
mod logging;
mod man;
mod master;
mod master_client;
mod orient;
mod page;
mod page_files;
mod read_dicom;
mod read_hdf5;
mod render;
mod rerender;
mod status;
mod systemd;
mod tf;
mod usage;
mod view;
mod volumes;
mod worker;

use clap::FromArgMatches;
use command::{Cli, Commands, command};
use slabcast_session::fail::Fail;
use slabcast_session::terminal::one_line;
use std::process::ExitCode;

fn main() -> ExitCode {
    std::panic::set_hook(Box::new(on_panic));
    let line: Vec<std::ffi::OsString> = std::env::args_os().collect();
    let cli =
        config::parse(command(), &line).and_then(|matches| Ok(Cli::from_arg_matches(&matches)?));
    let cli = match cli {
        Ok(cli) => cli,
        Err(config::Trouble::Clap(e)) => return ExitCode::from(usage::not_understood(&e)),
        Err(config::Trouble::Layer(fail)) => return ExitCode::from(fail.end()),
    };
    match run(&cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(fail) => ExitCode::from(config::blame(fail).end()),
    }
}

fn run(cli: &Cli) -> Result<(), Fail> {
    let daemon = matches!(cli.command, Commands::Master(_) | Commands::Worker(_));
    logging::begin(&cli.log, if daemon { "info" } else { "warn" })?;
    let config = cli.config.as_deref();
    match &cli.command {
        Commands::Render(args) => render::run(args),
        Commands::Rerender(args) => rerender::run(args),
        Commands::View(args) => view::run(args),
        Commands::Compare(args) => compare::run(args),
        Commands::Info(args) => info::run(args),
        Commands::Convert(args) => convert::run(args),
        Commands::Tf(args) => tf::run(args),
        Commands::Demo(args) => demo::run(args),
        Commands::Master(args) => master::run(args),
        Commands::Worker(args) => worker::run(args),
        Commands::Status(args) => status::run(args),
        Commands::Jobs(args) => jobs::run(args),
        Commands::Cancel(args) => cancel::run(args),
        Commands::Volumes(args) => volumes::list(args),
        Commands::Put(args) => volumes::put(args),
        Commands::Rm(args) => volumes::remove(args),
        Commands::Lab(args) => lab::run(args),
        Commands::Config(args) => config::run(args, config, &command(), usage::understood),
        Commands::Doctor(args) => doctor::run(args, config::path(config, command())),
        Commands::Completions(args) => completions::run(args, command()),
        Commands::Man(args) => man::run(args, command()),
        Commands::Help(args) => help::run(args, command()),
        Commands::ReadDicom(args) => read_dicom::run(args),
        Commands::ReadHdf5(args) => read_hdf5::run(args),
        Commands::OldName(experiment) => experiment.run_by_old_name(),
    }
}

/// A panic is a mistake of ours: one line that says where. Render threads catch theirs and go
/// on with the next tile.
fn on_panic(panic: &std::panic::PanicHookInfo<'_>) {
    let what = panic
        .payload()
        .downcast_ref::<String>()
        .map(String::as_str)
        .or_else(|| panic.payload().downcast_ref::<&str>().copied())
        .unwrap_or("no words");
    let at = panic.location().map(|l| format!("{}:{}", l.file(), l.line())).unwrap_or_default();
    let line = format!("internal: {what} at {at}; this is a mistake in slabcast, please report it");
    if std::thread::current().name() == Some("main") {
        std::process::exit(Fail::failed(line).end().into());
    }
    tracing::error!("{}", one_line(&line));
}
