//! The `slabcast` program: what is typed, which command that is, and how it ended.
//!
//! - [`render`] makes pictures, by this process alone ([`embedded`]) or by a cluster
//!   ([`remote`]); [`request`] turns flags into a request, [`output`] frames into files,
//!   [`progress`] shows what goes on meanwhile; [`rerender`] makes a picture again from what it
//!   says of itself, and [`show`] draws how it came about.
//! - [`daemon`] is `master` and `worker`; [`doctor`] says whether a machine is fit for them, and
//!   [`demo`] needs no file.
//! - [`plan`] predicts what a cluster would do that is not there.
//! - [`record`] writes a scheduler's decisions down and makes them again.
//! - [`transfer`] is colours and opacities, and [`tf`] writes them down.
//! - [`info`] looks into files, [`convert`] writes them in another format, [`ask`] looks at a running
//!   master.
//! - [`config`] lays flags, environment and file over each other.
//! - [`report`] sweeps the knobs of quality for error against run time; [`front`] measures, and
//!   [`chart`] draws.
//! - [`study`] does the paper's evaluation again.
//! - [`check`] compares pictures with the oracle over every way to make them; [`error`] says how
//!   far one is from the truth, [`explain`] why a pixel is as it is and ([`needs`]) what a scene leaves
//!   out. [`local`] draws for the
//!   first two, [`stage`] has the scenes and views of a path, [`still`] one of them for the last
//!   two.
//!
//! This is the only crate that sees all others. It decides nothing about pixels and schedules.
//! Results go to stdout, everything else to stderr; every failure is one line ([`fail`]).

mod config;
mod convert;
mod demo;
mod doctor;
mod info;
mod logging;
mod master;
mod read_dicom;
mod render;
mod rerender;
mod status;
mod tf;

use clap::error::ErrorKind;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use slabcast_lab::{bench, check, error, explain, plan, replay, report, study};
use slabcast_session::fail::{Fail, say};
use slabcast_session::terminal::one_line;
use std::process::ExitCode;

/// Renders volume data (CT, MRI, simulations) on CPUs, alone or as a cluster.
#[derive(Parser, Debug)]
#[command(
    name = "slabcast",
    version,
    disable_help_subcommand = true,
    max_term_width = 100,
    subcommand_value_name = "COMMAND",
    after_help = "\
Examples:
  slabcast demo                                  pictures without any file
  slabcast render brain.nii.gz                   18 pictures of a turn, in slabcast-out/
  slabcast info brain.nii.gz                     what is in the file
  slabcast master --volume brain.nii.gz          a cluster: a master,
  slabcast worker --master 127.0.0.1:7433        workers, here or elsewhere,
  slabcast render --master 127.0.0.1:7433        and pictures from it

Each command has its own help: slabcast render --help"
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    log: logging::LogArgs,
    /// TOML file with values for render, master and worker; see `slabcast config --help`
    #[arg(long, global = true, value_name = "FILE", help_heading = "Values")]
    config: Option<std::path::PathBuf>,
}

#[derive(Subcommand, Debug)]
enum Command {
    Demo(demo::DemoArgs),
    Render(Box<render::RenderArgs>),
    Rerender(rerender::RerenderArgs),
    Info(info::InfoArgs),
    Tf(Box<tf::TfArgs>),
    Convert(convert::ConvertArgs),
    Master(master::MasterArgs),
    Worker(master::WorkerArgs),
    Status(status::StatusArgs),
    Jobs(status::JobsArgs),
    Cancel(status::CancelArgs),
    Plan(Box<plan::PlanArgs>),
    Replay(replay::ReplayArgs),
    Error(Box<error::ErrorArgs>),
    Explain(Box<explain::ExplainArgs>),
    Bench(Box<bench::BenchArgs>),
    Report(Box<report::ReportArgs>),
    Study(Box<study::StudyArgs>),
    Check(check::CheckArgs),
    Config(config::ConfigArgs),
    Doctor(doctor::DoctorArgs),
    #[command(hide = true)]
    ReadDicom(read_dicom::DicomArgs),
    /// Prints completions for a shell.
    #[command(after_help = "\
Examples:
  slabcast completions bash > ~/.local/share/bash-completion/completions/slabcast
  slabcast completions fish > ~/.config/fish/completions/slabcast.fish")]
    Completions {
        /// bash, zsh, fish, elvish or powershell
        shell: clap_complete::Shell,
    },
    /// Prints the manual page, or writes one for each command into a folder.
    #[command(after_help = "\
Examples:
  slabcast man | man -l -
  slabcast man /usr/local/share/man/man1")]
    Man {
        /// Folder for slabcast.1, slabcast-render.1 and so on
        dir: Option<std::path::PathBuf>,
    },
}

fn main() -> ExitCode {
    std::panic::set_hook(Box::new(on_panic));
    let line: Vec<std::ffi::OsString> = std::env::args_os().collect();
    let cli = config::parse(Cli::command(), &line)
        .and_then(|matches| Ok(Cli::from_arg_matches(&matches)?));
    let cli = match cli {
        Ok(cli) => cli,
        Err(config::Trouble::Clap(e)) => return ExitCode::from(not_understood(&e)),
        Err(config::Trouble::Layer(fail)) => return ExitCode::from(fail.end()),
    };
    match run(&cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(fail) => ExitCode::from(config::blame(fail).end()),
    }
}

fn run(cli: &Cli) -> Result<(), Fail> {
    let daemon = matches!(cli.command, Command::Master(_) | Command::Worker(_));
    logging::begin(&cli.log, if daemon { "info" } else { "warn" })?;
    match &cli.command {
        Command::Demo(args) => demo::run(args),
        Command::Render(args) => render::run(args),
        Command::Rerender(args) => rerender::run(args),
        Command::Info(args) => info::run(args),
        Command::Tf(args) => tf::run(args),
        Command::Convert(args) => convert::run(args),
        Command::Master(args) => master::master(args),
        Command::Worker(args) => master::worker(args),
        Command::Status(args) => status::status(args),
        Command::Jobs(args) => status::jobs(args),
        Command::Cancel(args) => status::cancel(args),
        Command::Plan(args) => plan::run(args),
        Command::Replay(args) => replay::run(args),
        Command::Error(args) => error::run(args),
        Command::Explain(args) => explain::run(args),
        Command::Bench(args) => bench::run(args),
        Command::Report(args) => report::run(args),
        Command::Study(args) => study::run(args),
        Command::Check(args) => check::run(args),
        Command::Doctor(args) => {
            doctor::run(args, config::path(cli.config.as_deref(), Cli::command()))
        }
        Command::Config(args) => config::run::<Cli>(args, cli.config.as_deref(), understood),
        Command::ReadDicom(args) => read_dicom::run(args),
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(*shell, &mut Cli::command(), "slabcast", &mut script);
            say(&String::from_utf8_lossy(&script))
        }
        Command::Man { dir: None } => {
            let mut page = Vec::new();
            clap_mangen::Man::new(Cli::command())
                .render(&mut page)
                .map_err(|e| Fail::failed(e.to_string()))?;
            say(&String::from_utf8_lossy(&page))
        }
        Command::Man { dir: Some(dir) } => clap_mangen::generate_to(Cli::command(), dir)
            .map_err(|e| Fail::io(dir, "writing manual pages", &e)),
    }
}

/// Help and versions go to stdout; what was not understood becomes one line.
fn not_understood(e: &clap::Error) -> u8 {
    match e.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => {
            // Colour follows stdout's own nature; a reader that has gone away is silent.
            let _ = e.print();
            0
        }
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
            let _ = e.print();
            2
        }
        _ => understood(e).end(),
    }
}

/// What clap did not understand, as one line.
fn understood(e: &clap::Error) -> Fail {
    let typed = std::env::args_os().skip(1).map(|a| a.to_string_lossy().into_owned());
    Fail::usage(one_sentence(&e.to_string(), &typed.collect::<Vec<_>>()))
}

/// Clap's paragraphs as one line: what is wrong, its tips, and where to read on.
fn one_sentence(text: &str, typed: &[String]) -> String {
    let mut parts: Vec<String> = Vec::new();
    // Where clap says no usage, the first word tells.
    let mut help = match typed.first() {
        Some(name) if Cli::command().find_subcommand(name).is_some() => {
            format!("slabcast {name} --help")
        }
        _ => "slabcast --help".to_string(),
    };
    for line in text.lines().map(str::trim).filter(|l| !l.is_empty()) {
        if let Some(usage) = line.strip_prefix("Usage: ") {
            // `slabcast render [OPTIONS] ...`: the program, whatever it is called here, and the words before
            // the first that is no name.
            let name = |w: &&str| w.chars().all(|c| c.is_ascii_lowercase());
            let mut words = usage.split_whitespace();
            help = words.next().unwrap_or("slabcast").to_string();
            for word in words.take_while(name) {
                help = format!("{help} {word}");
            }
            help += " --help";
        } else if line.starts_with("For more information") {
            // Said in fewer words below.
        } else if let Some(tip) = line.strip_prefix("tip: ") {
            parts.push(tip.replace('\'', "`"));
        } else {
            let line = line.strip_prefix("error: ").unwrap_or(line);
            let line = line.strip_prefix('[').and_then(|l| l.strip_suffix(']')).unwrap_or(line);
            match parts.last_mut() {
                // The list that a colon announced.
                Some(last) if last.ends_with(':') || last.ends_with('>') => {
                    last.push(' ');
                    last.push_str(line);
                }
                _ => parts.push(line.replace('\'', "`")),
            }
        }
    }
    // Who gives a file alone wants to see it.
    if let Some(word) = typed.first()
        && parts.first().is_some_and(|p| p.starts_with("unrecognized subcommand"))
        && (std::path::Path::new(word).exists() || word.starts_with("formula:"))
    {
        parts.push(format!("to see it, `slabcast render {word}`"));
    }
    format!("{}; see `{help}`", parts.join("; "))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_sound() {
        Cli::command().debug_assert();
    }

    fn says(line: &str) -> String {
        let e = Cli::try_parse_from(line.split_whitespace()).unwrap_err();
        let typed: Vec<String> = line.split_whitespace().skip(1).map(String::from).collect();
        one_sentence(&e.to_string(), &typed)
    }

    #[test]
    fn what_is_not_understood_becomes_one_line() {
        for (line, want) in [
            (
                "slabcast render --elevatoin 3 x",
                "unexpected argument `--elevatoin` found; a similar argument exists: \
                 `--elevation`; see `slabcast render --help`",
            ),
            (
                "slabcast worker",
                "the following required arguments were not provided: --master <HOST:PORT>; see \
                 `slabcast worker --help`",
            ),
            (
                "slabcast render x --eps tiny",
                "invalid value `tiny` for `--eps <E>`: give a number or a fraction, like 0.002 or \
                 1/512; see `slabcast render --help`",
            ),
            (
                "slabcast-0.1 worker",
                "the following required arguments were not provided: --master <HOST:PORT>; see \
                 `slabcast-0.1 worker --help`",
            ),
        ] {
            assert_eq!(says(line), want);
        }
        assert!(!says("slabcast rendr x").contains('\n'));
    }

    /// A command and all below it, each with the words that lead to it.
    fn all(command: &clap::Command, words: &[String], into: &mut Vec<(Vec<String>, String)>) {
        for sub in command.get_subcommands() {
            let words = [words, &[sub.get_name().to_string()]].concat();
            into.push((words.clone(), sub.clone().render_long_help().to_string()));
            all(sub, &words, into);
        }
    }

    /// The words of an example: without variables before it, and without what is piped, redirected
    /// or said behind it.
    fn example(line: &str) -> Option<Vec<String>> {
        let line = line.trim();
        let line = line.split("  ").next()?.split(" | ").next()?.split(" > ").next()?;
        let words = line.split(' ').skip_while(|w| w.starts_with("SLABCAST_") && w.contains('='));
        let words: Vec<String> = words.map(String::from).collect();
        (words.len() > 1 && words[0] == "slabcast").then_some(words)
    }

    #[test]
    fn every_help_has_examples_that_are_understood() {
        let (mut helps, mut count) = (Vec::new(), 0);
        let mut cli = Cli::command().max_term_width(0).term_width(0);
        cli.build();
        all(&cli, &[], &mut helps);
        assert!(helps.len() > 18, "{}", helps.len());
        for (words, help) in helps {
            let name = words.join(" ");
            let (_, after) = help
                .split_once("Examples:")
                .unwrap_or_else(|| panic!("`slabcast {name} --help` has no section Examples"));
            let examples: Vec<_> = after.lines().filter_map(example).collect();
            let own = |e: &Vec<String>| words.iter().all(|w| e.contains(w));
            assert!(examples.iter().any(own), "no example of `slabcast {name}` in its help");
            for line in examples {
                count += 1;
                if let Err(e) = Cli::try_parse_from(&line) {
                    panic!("in the help of `{name}`: `{}`: {e}", line.join(" "));
                }
            }
        }
        assert!(count > 50, "{count} examples");
    }
}
