//! Usage errors: a command line that can't be parsed gets one line with the remedy.

use crate::command::command;
use clap::error::ErrorKind;
use slabcast_session::fail::Fail;

/// Ends a command line that clap didn't accept: prints help or version to stdout, or one line about
/// the mistake to stderr. Returns the exit code.
pub(crate) fn not_understood(e: &clap::Error) -> u8 {
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

/// Returns clap's refusal of the command line as one line.
pub(crate) fn understood(e: &clap::Error) -> Fail {
    let typed = std::env::args_os().skip(1).map(|a| a.to_string_lossy().into_owned());
    Fail::usage(one_sentence(&e.to_string(), &typed.collect::<Vec<_>>()))
}

/// Returns clap's paragraphs as one line: what is wrong, its tips, and where to read on.
fn one_sentence(text: &str, typed: &[String]) -> String {
    let mut parts: Vec<String> = Vec::new();
    // If clap prints no usage, the command is found from the words that were typed.
    let program = command();
    let (mut named, mut help) = (&program, "slabcast".to_string());
    for word in typed {
        let Some(inner) = named.find_subcommand(word) else { break };
        named = inner;
        help = format!("{help} {}", inner.get_name());
    }
    help += " --help";
    for line in text.lines().map(str::trim).filter(|l| !l.is_empty()) {
        if let Some(usage) = line.strip_prefix("Usage: ") {
            // `slabcast render [OPTIONS] ...`: the program, whatever it is called here, and the
            // words before the first that is no name.
            let name = |w: &&str| w.chars().all(|c| c.is_ascii_lowercase());
            let mut words = usage.split_whitespace();
            help = words.next().unwrap_or("slabcast").to_string();
            for word in words.take_while(name) {
                help = format!("{help} {word}");
            }
            help += " --help";
        } else if line.starts_with("For more information") || line.starts_with("slabcast ") {
            // Said in fewer words below; and the second form of a usage.
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

#[cfg(test)]
mod tests;
