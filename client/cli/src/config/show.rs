//! `slabcast config show`: every value and where it comes from.

use super::{Given, LAYERED, Source, Trouble, file, layers, misfit, with_defaults};
use clap::Command;
use slabcast_session::fail::{Fail, say};
use std::ffi::OsString;
use std::fmt::Write;

/// Shows the values of render, master and worker.
///
/// A flag beats a variable of the environment, that beats the file, and that beats the default.
/// The variable of a flag is its name in capitals: SLABCAST_SIZE for --size (SLABCAST_LOG for
/// --log-level, SLABCAST_LOG_FORMAT for --log). The file is TOML, one section a command:
///
///     [render]
///     tf = "bone"
///     size = "1024x1024"
///
///     [worker]
///     master = "node1:7433"
///
/// It is the one that --config or SLABCAST_CONFIG names, or slabcast/slabcast.toml in
/// $XDG_CONFIG_HOME (~/.config). An empty name means none.
#[derive(clap::Args, Clone, Debug)]
#[command(
    verbatim_doc_comment,
    after_help = "\
Examples:
  slabcast config show
  slabcast config show render --frames 36
  SLABCAST_TF=bone slabcast config show render --json"
)]
pub(crate) struct ConfigArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum What {
    /// Prints every value and where it comes from
    #[command(after_help = "\
Examples:
  slabcast config show
  slabcast config show worker
  slabcast config show render --frames 36 --tf bone")]
    Show {
        /// As JSON
        #[arg(long)]
        json: bool,
        /// render, master or worker, and flags as they would be typed
        #[arg(value_name = "COMMAND [FLAGS]", trailing_var_arg = true, allow_hyphen_values = true)]
        line: Vec<OsString>,
    },
}

/// Runs the command.
pub(crate) fn run(
    args: &ConfigArgs,
    config: Option<&std::path::Path>,
    root: &Command,
    understand: impl Fn(&clap::Error) -> Fail,
) -> Result<(), Fail> {
    let What::Show { json, line } = &args.what;
    // Flags after the command belong to it, except --json at the very end, which is meant for
    // `show`.
    let last = line.last().is_some_and(|l| l == "--json");
    let (json, line) = if last { (true, &line[..line.len() - 1]) } else { (*json, &line[..]) };
    let mut all = Vec::new();
    match line.split_first() {
        None => {
            for name in LAYERED {
                all.push((
                    name.to_string(),
                    resolve(root.clone(), name, &[], config, &understand)?,
                ));
            }
        }
        Some((first, flags)) => {
            let name = first.to_string_lossy().into_owned();
            if !LAYERED.contains(&name.as_str()) {
                return Err(Fail::usage(format!(
                    "COMMAND: `{name}` has no layers of values; give {}",
                    LAYERED.join(", ")
                )));
            }
            let given = resolve(root.clone(), &name, flags, config, &understand)?;
            all.push((name, given));
        }
    }
    say(&if json { as_json(&all) } else { as_text(&all) })
}

/// All values of a command, each checked, but none missed.
fn resolve(
    command: Command,
    name: &str,
    flags: &[OsString],
    config: Option<&std::path::Path>,
    understand: &impl Fn(&clap::Error) -> Fail,
) -> Result<Vec<Given>, Fail> {
    let mut line: Vec<OsString> = vec!["slabcast".into(), name.into()];
    if let Some(config) = config {
        line.extend(["--config".into(), config.into()]);
    }
    line.extend(flags.iter().cloned());
    let failed = |t: Trouble| match t {
        Trouble::Clap(e) => understand(&e),
        Trouble::Layer(fail) => fail,
    };
    let (_, given) = layers(&command, &line).map_err(failed)?.expect("a command with layers");
    let loose = with_defaults(command, name, &given, true);
    loose.try_get_matches_from(&line).map_err(|e| failed(misfit(e, &given)))?;
    Ok(given)
}

fn as_text(all: &[(String, Vec<Given>)]) -> String {
    let mut out = String::new();
    let values = all.iter().flat_map(|(_, given)| given);
    let width =
        |f: fn(&Given) -> usize, least| values.clone().map(f).max().unwrap_or(0).clamp(least, 28);
    let keys = width(|g| g.key.len(), 8);
    let wide = width(|g| g.value.as_deref().unwrap_or("-").len(), 8);
    for (n, (name, given)) in all.iter().enumerate() {
        let gap = if n > 0 { "\n" } else { "" };
        // Writing to a string does not fail.
        let _ = writeln!(out, "{gap}[{name}]");
        for g in given {
            let source = match &g.source {
                Source::Flag => "flag".into(),
                Source::Environment(name) => format!("environment, {name}"),
                Source::File(path) => format!("file, {}", path.display()),
                Source::Default => "default".into(),
            };
            let value = g.value.as_deref().unwrap_or("-");
            let _ = writeln!(out, "  {:<keys$}  {value:<wide$}  {source}", g.key);
        }
    }
    if all.iter().flat_map(|(_, g)| g).all(|g| !matches!(g.source, Source::File(_))) {
        let own = file::own().map(|p| format!(", {}", p.display())).unwrap_or_default();
        let _ = writeln!(
            out,
            "\nno value comes from a file; the place for one{own} (see `slabcast config --help`)"
        );
    }
    out
}

fn as_json(all: &[(String, Vec<Given>)]) -> String {
    let one = |g: &Given| {
        let (source, name) = match &g.source {
            Source::Flag => ("flag", None),
            Source::Environment(name) => ("environment", Some(name.clone())),
            Source::File(path) => ("file", Some(path.display().to_string())),
            Source::Default => ("default", None),
        };
        serde_json::json!({"key": g.key, "value": g.value, "source": source, "from": name})
    };
    let commands: serde_json::Map<String, serde_json::Value> =
        all.iter().map(|(name, given)| (name.clone(), given.iter().map(one).collect())).collect();
    format!("{:#}\n", serde_json::Value::Object(commands))
}
