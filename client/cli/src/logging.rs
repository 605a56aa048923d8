//! Logs on stderr: text for people and for the journal, JSON for machines.
//!
//! Under systemd (JOURNAL_STREAM) there are no timestamps and no colour, since the journal has
//! its own; each line then begins with its syslog priority (`<4>`), as sd-daemon(3) has it.

use slabcast_session::fail::Fail;
use slabcast_session::{progress, terminal};
use std::io::Write;
use tracing::{Level, Metadata};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::MakeWriter;

/// `--log` and `--log-level`.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Logs")]
pub(crate) struct LogArgs {
    /// Logs on stderr as text or as JSON, one object a line
    #[arg(long, global = true, hide_short_help = true, value_name = "text|json", default_value = "text", value_parser = ["text", "json"])]
    log: String,
    /// off, error, warn, info, debug or trace, or filters such as slabcast_master=debug
    /// [default: info for master and worker, else warn]
    #[arg(long, global = true, value_name = "LEVEL", hide_short_help = true)]
    log_level: Option<String>,
}

/// Expands a level or filter; libraries log one level less than slabcast's crates.
fn filter(text: &str) -> Result<EnvFilter, String> {
    let expanded = match text {
        "off" | "error" | "warn" => text.to_string(),
        "info" => "warn,slabcast=info".into(),
        "debug" => "info,slabcast=debug".into(),
        "trace" => "debug,slabcast=trace".into(),
        other if other.contains('=') => match other.split_once(',') {
            // `info,slabcast_master=debug` begins with a level of ours.
            Some((first, rest)) if !first.contains('=') => {
                return filter(first).and_then(|_| {
                    EnvFilter::try_new(format!("{first},{rest}")).map_err(|e| e.to_string())
                });
            }
            _ => other.to_string(),
        },
        _ => return Err("give off, error, warn, info, debug or trace".into()),
    };
    EnvFilter::try_new(expanded).map_err(|e| e.to_string())
}

/// Begins to log. `default` is the level where none is asked for.
pub(crate) fn begin(args: &LogArgs, default: &str) -> Result<(), Fail> {
    let filter = filter(args.log_level.as_deref().unwrap_or(default))
        .map_err(|e| Fail::usage(format!("--log-level: {e}")))?;
    let journal = std::env::var_os("JOURNAL_STREAM").is_some();
    let json = args.log == "json";
    let lines = Lines { priorities: journal && !json };
    let base = tracing_subscriber::fmt().with_env_filter(filter).with_writer(lines);
    // A second subscriber can only come from a test in this process: the first one stays.
    let _ = match (json, journal) {
        (true, true) => base.json().without_time().try_init(),
        (true, false) => base.json().try_init(),
        (false, true) => base.with_ansi(false).without_time().with_level(false).try_init(),
        (false, false) => base.with_ansi(terminal::colours()).try_init(),
    };
    Ok(())
}

/// Lines that do not tear a progress bar.
struct Lines {
    priorities: bool,
}

struct Line {
    bytes: Vec<u8>,
}

impl Write for Line {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.bytes.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        progress::write_on_stderr(&self.bytes);
    }
}

impl<'a> MakeWriter<'a> for Lines {
    type Writer = Line;

    fn make_writer(&'a self) -> Line {
        Line { bytes: Vec::new() }
    }

    fn make_writer_for(&'a self, meta: &Metadata<'_>) -> Line {
        let priority = match *meta.level() {
            Level::ERROR => "<3>",
            Level::WARN => "<4>",
            Level::INFO => "<6>",
            Level::DEBUG | Level::TRACE => "<7>",
        };
        let bytes = if self.priorities { priority.into() } else { Vec::new() };
        Line { bytes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_words_or_filters() {
        for good in [
            "off",
            "error",
            "warn",
            "info",
            "debug",
            "trace",
            "h2=off",
            "info,slabcast_master=debug",
        ] {
            assert!(filter(good).is_ok(), "{good}");
        }
        for bad in ["", "loud", "slabcast=loud", "loud,h2=info"] {
            assert!(filter(bad).is_err(), "{bad}");
        }
    }
}
