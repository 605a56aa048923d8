//! Colour on stderr: only for a terminal, never with NO_COLOR (no-color.org).

use std::io::IsTerminal;
use std::sync::OnceLock;

/// Whether stderr is a terminal that understands cursor movements.
pub fn terminal() -> bool {
    static IS: OnceLock<bool> = OnceLock::new();
    *IS.get_or_init(|| {
        std::io::stderr().is_terminal() && std::env::var_os("TERM").is_none_or(|t| t != "dumb")
    })
}

/// Whether stderr gets colours.
pub fn colours() -> bool {
    terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty())
}

/// `error:`
pub fn error() -> &'static str {
    if colours() { "\u{1b}[1;31merror:\u{1b}[0m" } else { "error:" }
}

/// `warning:`
pub fn warning() -> &'static str {
    if colours() { "\u{1b}[1;33mwarning:\u{1b}[0m" } else { "warning:" }
}

/// `note:`
pub fn note() -> &'static str {
    if colours() { "\u{1b}[1;36mnote:\u{1b}[0m" } else { "note:" }
}

/// One line, whatever a file's name holds.
pub fn one_line(text: &str) -> String {
    let text: String = text
        .trim()
        .chars()
        .map(|c| match c {
            '\n' | '\t' => ' ',
            c if c.is_control() => '\u{fffd}',
            c => c,
        })
        .collect();
    text
}
