//! Failure of a command: an exit code, and one line that names the problem and its remedy.
//!
//! Exit code 2: the command line is wrong. 1: everything else that went wrong. 130 and 143:
//! stopped by Ctrl-C or SIGTERM before the end.

use crate::progress;
use crate::terminal::{self, one_line};
use slabcast_common::quality::InvalidField;
use std::io::{ErrorKind, Write};
use std::path::Path;

/// Why a command failed: an exit code and one line for stderr.
#[derive(Debug)]
pub struct Fail {
    code: u8,
    /// Text for stderr after `error: `; nothing where it was said already.
    line: Option<String>,
}

impl Fail {
    /// Returns a failure of the command line (exit code 2).
    pub fn usage(line: impl Into<String>) -> Self {
        Fail { code: 2, line: Some(line.into()) }
    }

    /// Returns any other failure, of a file, the network or the machine (exit code 1).
    pub fn failed(line: impl Into<String>) -> Self {
        Fail { code: 1, line: Some(line.into()) }
    }

    /// Returns a failure whose line was printed already.
    pub fn silent(code: u8) -> Self {
        Fail { code, line: None }
    }

    /// Returns the refusal of a flag's value (exit code 2).
    pub fn flag(refused: &InvalidField) -> Self {
        Fail::usage(format!("--{}: {}", refused.field, refused.problem))
    }

    /// Returns the refusal of a field of a file (exit code 1). A refusal whose field is `whole`
    /// blames the file as such.
    pub fn field(file: &Path, whole: &str, refused: &InvalidField) -> Self {
        let InvalidField { field, problem } = refused;
        let file = file.display();
        Fail::failed(if field == whole {
            format!("{file}: {problem}")
        } else {
            format!("{file}: {field}: {problem}")
        })
    }

    /// Returns a failure of the operating system while `doing` something with a file, with a
    /// remedy where one is known (exit code 1).
    pub fn io(path: &Path, doing: &str, e: &std::io::Error) -> Self {
        let remedy = match e.kind() {
            ErrorKind::NotFound => "; check the path",
            ErrorKind::PermissionDenied => "; check who may write or read there",
            ErrorKind::StorageFull => "; make room or choose another place with -o",
            ErrorKind::IsADirectory => "; give a file",
            ErrorKind::NotADirectory => "; a part of the path is a file",
            _ => "",
        };
        Fail::failed(format!("{}: {doing} failed: {}{remedy}", path.display(), reason(e)))
    }

    /// Returns the failure with `more` at the end of its line.
    pub fn with_note(self, more: &str) -> Self {
        Fail { line: self.line.map(|l| l + more), ..self }
    }

    /// Returns the failure with exit code 1: a file is to blame, not the command line.
    pub fn of_a_file(self) -> Self {
        Fail { code: 1, ..self }
    }

    /// Returns whether the command line is to blame (exit code 2).
    pub fn is_usage(&self) -> bool {
        self.code == 2
    }

    /// Returns the line without `error: `, unless it was printed already.
    pub fn line(&self) -> Option<&str> {
        self.line.as_deref()
    }

    /// Prints the line to stderr and returns the exit code.
    pub fn end(self) -> u8 {
        if let Some(line) = &self.line {
            progress::say_on_stderr(&format!("{} {}", terminal::error(), one_line(line)));
        }
        self.code
    }
}

/// Returns the system's message in lower case, without its number.
pub fn reason(e: &std::io::Error) -> String {
    let text = e.to_string();
    let text = text.split(" (os error").next().unwrap_or_default();
    let mut chars = text.chars();
    chars.next().map(|c| c.to_lowercase().chain(chars).collect()).unwrap_or_default()
}

/// Writes results to stdout.
///
/// # Errors
/// stdout can't be written. A reader that has gone away (`| head`) ends the command quietly,
/// with code 0.
pub fn say(text: &str) -> Result<(), Fail> {
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes()).and_then(|()| out.flush()).map_err(|e| match e.kind() {
        ErrorKind::BrokenPipe => Fail::silent(0),
        _ => Fail::failed(format!("stdout: writing failed: {}", reason(&e))),
    })
}
