//! The command line: all subcommands, and the help that groups them.

use crate::lab::{self, LabArgs, LabCommand};
use crate::{
    cancel, compare, completions, config, convert, demo, doctor, help, info, jobs, logging, man,
    master, read_dicom, render, rerender, status, tf, view, volumes, worker,
};
use clap::{Arg, Command, CommandFactory, Parser, Subcommand};
use std::fmt::Write;
use std::path::PathBuf;

/// Renders volume data (CT, MRI, simulations) on CPUs, alone or as a cluster.
#[derive(Parser, Debug)]
#[command(
    name = "slabcast",
    version,
    disable_help_subcommand = true,
    max_term_width = 100,
    subcommand_value_name = "COMMAND",
    help_template = "{about-with-newline}\n{usage-heading} {usage}{after-help}"
)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Commands,
    #[command(flatten)]
    pub(crate) log: logging::LogArgs,
    /// TOML file with values for render, master and worker; see `slabcast config --help`
    #[arg(
        long,
        global = true,
        value_name = "FILE",
        help_heading = "Values",
        hide_short_help = true
    )]
    pub(crate) config: Option<PathBuf>,
}

/// The subcommands; [`GROUPS`] orders them for the help.
#[derive(Subcommand, Debug)]
pub(crate) enum Commands {
    Render(Box<render::RenderArgs>),
    View(Box<view::ViewArgs>),
    Compare(Box<compare::CompareArgs>),
    Rerender(rerender::RerenderArgs),
    Info(info::InfoArgs),
    Convert(convert::ConvertArgs),
    Tf(Box<tf::TfArgs>),
    Demo(demo::DemoArgs),
    Master(Box<master::MasterArgs>),
    Worker(worker::WorkerArgs),
    Status(status::StatusArgs),
    Jobs(jobs::JobsArgs),
    Cancel(cancel::CancelArgs),
    Volumes(volumes::VolumesArgs),
    Put(Box<volumes::PutArgs>),
    Rm(volumes::RmArgs),
    Lab(LabArgs),
    Config(config::ConfigArgs),
    Doctor(doctor::DoctorArgs),
    Completions(completions::CompletionsArgs),
    Man(man::ManArgs),
    Help(help::HelpArgs),
    #[command(hide = true)]
    ReadDicom(read_dicom::DicomArgs),
    /// Experiments by their old names, hidden by [`command`].
    #[command(flatten)]
    OldName(LabCommand),
}

/// Groups of the help and their commands, in its order.
pub(crate) const GROUPS: [(&str, &[&str]); 4] = [
    ("Pictures", &["render", "view", "compare", "rerender", "info", "convert", "tf", "demo"]),
    ("Cluster", &["master", "worker", "status", "jobs", "cancel", "volumes", "put", "rm"]),
    ("Laboratory", &["lab"]),
    ("Setup", &["config", "doctor", "completions", "man", "help"]),
];

/// Commands that the short help only names: it has to fit a screen of 24 lines.
const ALSO: [&str; 8] = ["rerender", "tf", "volumes", "put", "rm", "completions", "man", "help"];

const EXAMPLES: &str = "\
Examples:
  slabcast demo                                  pictures without any file
  slabcast render brain.nii.gz                   36 pictures of a full turn, in slabcast-out/
  slabcast view brain.nii.gz --open              turn and colour it in a browser
  slabcast info brain.nii.gz                     what is in the file
  slabcast master --volumes scans/               a cluster: a master,
  slabcast worker --master 127.0.0.1:7433        workers, here or elsewhere,
  slabcast render knee --master 127.0.0.1:7433   and pictures from it

Each command has its own help: slabcast render -h for one screen, slabcast help render for all.
";

/// Returns the command line, with grouped help and the old names hidden.
pub(crate) fn command() -> Command {
    let mut command = Cli::command();
    for name in lab::NAMES {
        command = command.mut_subcommand(name, |c| c.hide(true));
    }
    let (short, long) = (short_help(&command), long_help(&command));
    command.after_help(short).after_long_help(long)
}

/// First line of a subcommand's description, without a full stop.
fn about(command: &Command) -> String {
    let about = command.get_about().map(ToString::to_string).unwrap_or_default();
    about.lines().next().unwrap_or_default().trim_end_matches('.').to_string()
}

fn find<'a>(command: &'a Command, name: &str) -> &'a Command {
    command
        .find_subcommand(name)
        .unwrap_or_else(|| panic!("`{name}` of the groups is no command: {command:?}"))
}

/// Groups and commands in as many lines as commands: at most 24 lines of 80 columns with all else.
fn short_help(command: &Command) -> String {
    let mut text = String::new();
    for (group, names) in GROUPS {
        let (also, shown): (Vec<&str>, Vec<&str>) =
            names.iter().copied().partition(|name| ALSO.contains(name));
        for (n, name) in shown.iter().enumerate() {
            let group = if n == 0 { group } else { "" };
            // Writing to a string does not fail.
            let _ = writeln!(text, "{group:<11} {name:<12} {}", about(find(command, name)));
        }
        if !also.is_empty() {
            let _ = writeln!(text, "{:<11} also {}", "", also.join(", "));
        }
    }
    text + "\nOptions: --config FILE, --log text|json, --log-level LEVEL, --version, --help\n\
            slabcast COMMAND -h shows the usual flags, slabcast help COMMAND all of them.\n"
}

/// Groups, commands, those of the laboratory too, options and examples.
fn long_help(command: &Command) -> String {
    let mut text = String::new();
    for (group, names) in GROUPS {
        let _ = writeln!(text, "{group}:");
        for name in names {
            let sub = find(command, name);
            let below: Vec<&Command> = sub.get_subcommands().filter(|s| !s.is_hide_set()).collect();
            if *name == "lab" {
                for sub in below {
                    let name = format!("lab {}", sub.get_name());
                    let _ = writeln!(text, "  {name:<13} {}", about(sub));
                }
            } else {
                let _ = writeln!(text, "  {name:<13} {}", about(sub));
            }
        }
        text.push('\n');
    }
    text.push_str("Options:\n");
    let options = command.get_arguments().map(option);
    let fixed = [
        ("-h, --help".to_string(), "Short help; --help: all of it".to_string()),
        ("-V, --version".to_string(), "Version".to_string()),
    ];
    for (flag, help) in options.chain(fixed) {
        let _ =
            writeln!(text, "  {flag:<22} {}", help.replace('\n', "\n                         "));
    }
    text + "\n" + EXAMPLES
}

/// A flag with its value, and what it does.
fn option(arg: &Arg) -> (String, String) {
    // `Arg::to_string` needs a command that is built.
    let values = arg.get_value_names().unwrap_or_default();
    let value = values.first().map(|v| format!(" <{v}>")).unwrap_or_default();
    let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
    (format!("--{}{value}", arg.get_long().unwrap_or_default()), help)
}
