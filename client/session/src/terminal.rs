//! Colour on stderr: only for a terminal, never with NO_COLOR (no-color.org).

use std::io::IsTerminal;
use std::sync::OnceLock;

/// Returns whether stderr is a terminal that can move its cursor.
pub fn terminal() -> bool {
    static IS: OnceLock<bool> = OnceLock::new();
    *IS.get_or_init(|| {
        std::io::stderr().is_terminal() && std::env::var_os("TERM").is_none_or(|t| t != "dumb")
    })
}

/// Returns whether stderr gets colours: on a terminal, unless NO_COLOR is set.
pub fn colours() -> bool {
    terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty())
}

/// Returns `error:`, in red where stderr has colours.
pub fn error() -> &'static str {
    if colours() { "\u{1b}[1;31merror:\u{1b}[0m" } else { "error:" }
}

/// Returns `warning:`, in yellow where stderr has colours.
pub fn warning() -> &'static str {
    if colours() { "\u{1b}[1;33mwarning:\u{1b}[0m" } else { "warning:" }
}

/// Returns `note:`, in cyan where stderr has colours.
pub fn note() -> &'static str {
    if colours() { "\u{1b}[1;36mnote:\u{1b}[0m" } else { "note:" }
}

/// Returns `text` trimmed and on one line; control characters become U+FFFD.
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
