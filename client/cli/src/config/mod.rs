//! Values from flags, the environment and a file: one precedence for `render`, `master` and
//! `worker`.
//!
//! A flag beats a variable of the environment, that beats the file, and that beats the default.
//! Every flag has its variable (`--tiles-per-thread`: SLABCAST_TILES_PER_THREAD) and its key
//! (`tiles-per-thread` under the command's name); aliases of a flag have theirs. The lower three
//! are one thing to clap: what the environment and the file say becomes the default of an argument
//! before the command line is parsed. So each value is checked by the parser of its flag, whoever
//! gave it, and a command's code does not know that there are layers.
//!
//! A flag also silences what it excludes: `--azimuth 30` is not refused because of `frames` in a
//! file. Within one layer such a pair is a mistake and is named.

mod file;
mod show;

pub(crate) use show::{ConfigArgs, run};

use clap::error::{ContextKind, ContextValue};
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Command};
use file::File;
use slabcast_common::spelling::distance;
use slabcast_session::fail::Fail;
use slabcast_session::progress;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::OnceLock;

/// The commands with layers.
pub(crate) const LAYERED: [&str; 3] = ["render", "master", "worker"];

/// Arguments of `render` that exclude each other and say so in words of their own.
const EXCLUDE: [(&str, &str); 3] =
    [("volume", "master"), ("workers", "master"), ("threads", "master")];

/// Variables that are no flag's: the file, and those of deploy/compose.yaml.
const OTHERS: [&str; 7] = [
    "SLABCAST_CACHE",
    "SLABCAST_CONFIG",
    "SLABCAST_DATA",
    "SLABCAST_FILE",
    "SLABCAST_MASTER_LIMIT",
    "SLABCAST_PORT",
    "SLABCAST_WORKER_LIMIT",
];

/// The layer that gives a value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Source {
    Flag,
    /// The variable.
    Environment(String),
    File(PathBuf),
    Default,
}

/// One argument of a command and what it is given.
#[derive(Clone, Debug)]
pub(crate) struct Given {
    /// Clap's name.
    id: String,
    /// The flag without dashes.
    pub(crate) key: String,
    /// The value as text, if there is one.
    pub(crate) value: Option<String>,
    pub(crate) source: Source,
}

/// Why a command line was not taken.
pub(crate) enum Trouble {
    /// Clap's words; help and versions too.
    Clap(clap::Error),
    /// The environment or the file is wrong.
    Layer(Fail),
}

impl From<clap::Error> for Trouble {
    fn from(e: clap::Error) -> Self {
        Trouble::Clap(e)
    }
}

/// Values of the current command from environment and file, for [`blame`].
static GIVEN: OnceLock<Vec<Given>> = OnceLock::new();

/// The matches of a command line, with all layers.
pub(crate) fn parse(command: Command, line: &[OsString]) -> Result<ArgMatches, Trouble> {
    let Some((name, given)) = layers(&command, line)? else {
        return Ok(command.try_get_matches_from(line)?);
    };
    let layered = with_defaults(command, &name, &given, false);
    let matches = layered.try_get_matches_from(line).map_err(|e| misfit(e, &given))?;
    let given = given.into_iter().filter(|g| !matches!(g.source, Source::Flag | Source::Default));
    // A test in this process may parse twice: the first one stays.
    let _ = GIVEN.set(given.collect());
    Ok(matches)
}

/// Adds to a refusal of a flag that was never typed where its value comes from.
pub(crate) fn blame(fail: Fail) -> Fail {
    let said = fail.line().unwrap_or_default();
    let flag = said.strip_prefix("--").and_then(|s| s.split([':', ',', ' ']).next());
    let given = GIVEN.get().into_iter().flatten().find(|g| flag == Some(g.key.as_str()));
    match given {
        Some(g) => {
            let fail = fail.with_note(&format!("; it comes from {}", g.named()));
            if matches!(g.source, Source::File(_)) { fail.of_a_file() } else { fail }
        }
        None => fail,
    }
}

impl Given {
    /// `SLABCAST_TF`, `/home/me/slabcast.toml`.
    fn named(&self) -> String {
        match &self.source {
            Source::Environment(name) => name.clone(),
            Source::File(path) => format!("`{}` in {}", self.key, path.display()),
            Source::Flag | Source::Default => format!("--{}", self.key),
        }
    }
}

/// The file that commands would read, if it is understood; empty for none.
pub(crate) fn path(request: Option<&std::path::Path>, mut root: Command) -> Result<PathBuf, Fail> {
    root.build();
    File::find(request.map(PathBuf::from), &root).map(|file| file.path)
}

/// The variable of a flag.
fn variable(key: &str) -> String {
    match key {
        "log" => "SLABCAST_LOG_FORMAT".into(),
        "log-level" => "SLABCAST_LOG".into(),
        _ => format!("SLABCAST_{}", key.to_ascii_uppercase().replace('-', "_")),
    }
}

/// Arguments that have layers: flags with a long name.
fn layered_args<'a>(root: &'a Command, name: &str) -> Vec<&'a Arg> {
    let of = root.find_subcommand(name).map(|c| c.get_arguments().collect()).unwrap_or_default();
    let of: Vec<&Arg> = of;
    let global = root.get_arguments().filter(|a| a.is_global_set());
    let mut all: Vec<&Arg> = of;
    for arg in global {
        if all.iter().all(|a| a.get_id() != arg.get_id()) {
            all.push(arg);
        }
    }
    all.retain(|a| a.get_long().is_some_and(|l| !["help", "version", "config"].contains(&l)));
    // Which volume of one file is no setting for all, and SLABCAST_VOLUME is a master's file.
    all.retain(|a| a.get_id() != "nth_volume");
    all
}

/// Long names of a flag: its own, then its aliases.
fn names(arg: &Arg) -> impl Iterator<Item = &str> {
    arg.get_long().into_iter().chain(arg.get_all_aliases().unwrap_or_default())
}

/// Returns the command of a line, and the value and layer (flag, variable, file, default) of each
/// of its arguments. `None`: the command takes no values from layers.
fn layers(command: &Command, line: &[OsString]) -> Result<Option<(String, Vec<Given>)>, Trouble> {
    let mut loose = command.clone();
    for name in LAYERED {
        loose = loose.mut_subcommand(name, |c| c.mut_args(|a| a.required(false)));
    }
    let matches = loose.try_get_matches_from(line)?;
    let Some((name, sub)) = matches.subcommand() else { return Ok(None) };
    if !LAYERED.contains(&name) {
        return Ok(None);
    }
    let request = sub.get_one::<PathBuf>("config").cloned();
    given(command, name, sub, request)
        .map(|given| Some((name.to_string(), given)))
        .map_err(Trouble::Layer)
}

fn given(
    command: &Command,
    name: &str,
    matches: &ArgMatches,
    file: Option<PathBuf>,
) -> Result<Vec<Given>, Fail> {
    // Built, so that global arguments and groups are where they belong.
    let mut root = command.clone();
    root.build();
    let file = File::find(file, &root)?;
    misspelt(&root);
    let args = layered_args(&root, name);
    let sub = root.find_subcommand(name).expect("clap found it");
    let typed: Vec<String> = sub
        .get_arguments()
        .map(|a| a.get_id().to_string())
        .filter(|id| matches.value_source(id) == Some(ValueSource::CommandLine))
        .collect();
    let excludes = |a: &Arg, id: &str| {
        let by_clap = |a: &Arg, id: &str| {
            sub.get_arg_conflicts_with(a).iter().any(|other| other.get_id() == id)
        };
        let other = sub.get_arguments().find(|o| o.get_id() == id);
        let pair = (a.get_id().as_str(), id);
        by_clap(a, id)
            || other.is_some_and(|o| by_clap(o, a.get_id().as_str()))
            || name == "render" && EXCLUDE.iter().any(|&(x, y)| pair == (x, y) || pair == (y, x))
    };
    // Upper layers first: each silences what it excludes below.
    let mut taken = typed.clone();
    let mut said: BTreeMap<String, (String, Source)> = BTreeMap::new();
    for layer in 0..2 {
        let mut here: Vec<(&Arg, String, Source)> = Vec::new();
        for &arg in &args {
            let id = arg.get_id().as_str();
            if taken.iter().any(|t| t == id || excludes(arg, t)) {
                continue;
            }
            let found = names(arg).find_map(|key| {
                if layer == 0 {
                    let name = variable(key);
                    let text = std::env::var_os(&name).filter(|v| !v.is_empty());
                    text.map(|v| (v.to_string_lossy().into_owned(), Source::Environment(name)))
                } else {
                    file.value(name, key).map(|v| (v, Source::File(file.path.clone())))
                }
            });
            if let Some((text, source)) = found {
                here.push((arg, text, source));
            }
        }
        for (n, (arg, ..)) in here.iter().enumerate() {
            if let Some((other, ..)) =
                here[..n].iter().find(|(other, ..)| excludes(arg, other.get_id().as_str()))
            {
                let named = |a: &Arg, s: &Source| {
                    Given {
                        id: String::new(),
                        key: a.get_long().unwrap_or_default().into(),
                        value: None,
                        source: s.clone(),
                    }
                    .named()
                };
                let (a, b) = (named(other, &here[n].2), named(arg, &here[n].2));
                let a = if layer == 0 { variable(other.get_long().unwrap_or_default()) } else { a };
                let line = format!("{a} and {b} exclude each other; leave one of them out");
                return Err(if layer == 0 { Fail::usage(line) } else { Fail::failed(line) });
            }
        }
        for (arg, text, source) in here {
            let id = arg.get_id().to_string();
            let text = if matches!(arg.get_action(), ArgAction::SetTrue) {
                yes_or_no(arg, &text, &source)?
            } else {
                text
            };
            taken.push(id.clone());
            said.insert(id, (text, source));
        }
    }
    Ok(args
        .iter()
        .map(|arg| {
            let id = arg.get_id().to_string();
            let typed = typed.contains(&id).then(|| {
                let raw = matches.get_raw(&id).into_iter().flatten();
                let text = raw.map(|v| v.to_string_lossy()).collect::<Vec<_>>().join(" ");
                (if text.is_empty() { "true".into() } else { text }, Source::Flag)
            });
            let default =
                arg.get_default_values().first().map(|v| v.to_string_lossy().into_owned());
            let (value, source) = match typed.or_else(|| said.remove(&id)) {
                Some((value, source)) => (Some(value), source),
                None => (default, Source::Default),
            };
            Given { id, key: arg.get_long().unwrap_or_default().into(), value, source }
        })
        .collect())
}

/// A switch in the environment or the file.
fn yes_or_no(arg: &Arg, text: &str, source: &Source) -> Result<String, Fail> {
    match text.to_ascii_lowercase().as_str() {
        "1" | "true" | "yes" | "on" => Ok("true".into()),
        "0" | "false" | "no" | "off" => Ok("false".into()),
        _ => {
            let key = arg.get_long().unwrap_or_default().to_string();
            let given = Given { id: String::new(), key, value: None, source: source.clone() };
            let line = format!("{}: `{text}` is neither true nor false; give one", given.named());
            Err(if matches!(source, Source::File(_)) {
                Fail::failed(line)
            } else {
                Fail::usage(line)
            })
        }
    }
}

/// The command with the lower layers as defaults; nothing is required where `loose`.
fn with_defaults(root: Command, name: &str, given: &[Given], loose: bool) -> Command {
    let set = |command: Command, given: &Given| {
        let value = given.value.clone().unwrap_or_default();
        let has = command.get_arguments().any(|a| a.get_id() == given.id.as_str());
        if has && matches!(given.source, Source::Environment(_) | Source::File(_)) {
            command.mut_arg(&given.id, |a| a.required(false).default_value(value))
        } else {
            command
        }
    };
    let root = given.iter().fold(root, set);
    root.mut_subcommand(name, |sub| {
        let sub = given.iter().fold(sub, set);
        if loose { sub.mut_args(|a| a.required(false)) } else { sub }
    })
}

/// A value that does not fit its argument: whose it was.
fn misfit(e: clap::Error, given: &[Given]) -> Trouble {
    let Some(ContextValue::String(arg)) = e.get(ContextKind::InvalidArg) else { return e.into() };
    let flag = arg.split([' ', '=']).next().unwrap_or_default().trim_start_matches("--");
    let found = given.iter().find(|g| g.key == flag);
    let Some(g) = found.filter(|g| !matches!(g.source, Source::Flag | Source::Default)) else {
        return e.into();
    };
    let text = e.to_string();
    let first = text.lines().next().unwrap_or_default().trim_start_matches("error: ");
    let (_, why) = first.split_once(": ").unwrap_or(("", ""));
    let more = text.lines().skip(1).map(str::trim).find(|l| l.starts_with('['));
    let why = match (why, more) {
        ("", Some(list)) => format!(
            "give one of {}",
            list.trim_start_matches("[possible values: ").trim_end_matches(']')
        ),
        ("", None) => first.to_string(),
        (why, _) => why.to_string(),
    };
    let value = g.value.as_deref().unwrap_or_default();
    let line = format!("{}: `{value}`: {why}", g.named());
    Trouble::Layer(match g.source {
        Source::File(_) => Fail::failed(line),
        _ => Fail::usage(line),
    })
}

/// The nearest of `names`, if any is near.
fn nearest<'a>(word: &str, names: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    names.map(|n| (distance(word, n), n)).filter(|(d, _)| *d <= 2).min().map(|(_, n)| n)
}

/// Warns of variables that look like ours and are none: a typing error would pass in silence.
fn misspelt(root: &Command) {
    let mut known: Vec<String> = OTHERS.map(String::from).to_vec();
    for name in LAYERED {
        known.extend(layered_args(root, name).into_iter().flat_map(names).map(variable));
    }
    for (name, _) in std::env::vars_os() {
        let Some(name) = name.to_str().filter(|n| n.starts_with("SLABCAST_")) else { continue };
        if !known.iter().any(|k| k == name)
            && let Some(near) = nearest(name, known.iter().map(String::as_str))
        {
            progress::warn(&format!(
                "{name} in the environment means nothing; did you mean {near}?"
            ));
        }
    }
}
