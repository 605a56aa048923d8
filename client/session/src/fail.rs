//! How a command ends badly: an exit code and one line that names what and what to do.
//!
//! Exit code 2: the command line is wrong. 1: everything else that went wrong. 130 and 143:
//! stopped by Ctrl-C or SIGTERM before the end.

use crate::progress;
use crate::terminal::{self, one_line};
use slabcast_common::quality::InvalidField;
use std::io::{ErrorKind, Write};
use std::path::Path;

/// The end of a command that did not do what it was asked.
#[derive(Debug)]
pub struct Fail {
    code: u8,
    /// What goes to stderr after `error: `; nothing where it was said already.
    line: Option<String>,
}

impl Fail {
    /// The command line is wrong.
    pub fn usage(line: impl Into<String>) -> Self {
        Fail { code: 2, line: Some(line.into()) }
    }

    /// Something else is wrong: a file, the network, the machine.
    pub fn failed(line: impl Into<String>) -> Self {
        Fail { code: 1, line: Some(line.into()) }
    }

    /// Everything was said.
    pub fn silent(code: u8) -> Self {
        Fail { code, line: None }
    }

    /// A value of a flag is wrong.
    pub fn flag(refused: &InvalidField) -> Self {
        Fail::usage(format!("--{}: {}", refused.field, refused.problem))
    }

    /// A field of a file is wrong. `whole` is what the reader calls the file when no field is
    /// to blame.
    pub fn field(file: &Path, whole: &str, refused: &InvalidField) -> Self {
        let InvalidField { field, problem } = refused;
        let file = file.display();
        Fail::failed(if field == whole {
            format!("{file}: {problem}")
        } else {
            format!("{file}: {field}: {problem}")
        })
    }

    /// The operating system refused something about a file.
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

    /// The same with more said.
    pub fn add(self, more: &str) -> Self {
        Fail { line: self.line.map(|l| l + more), ..self }
    }

    /// The same, but a file is to blame and not the command line.
    pub fn of_a_file(self) -> Self {
        Fail { code: 1, ..self }
    }

    /// The line, for tests and for lines about it.
    pub fn line(&self) -> Option<&str> {
        self.line.as_deref()
    }

    /// Says it and gives the exit code.
    pub fn end(self) -> u8 {
        if let Some(line) = &self.line {
            progress::say_on_stderr(&format!("{} {}", terminal::error(), one_line(line)));
        }
        self.code
    }
}

/// What the system says, in small letters and without its number.
pub fn reason(e: &std::io::Error) -> String {
    let text = e.to_string();
    let text = text.split(" (os error").next().unwrap_or_default();
    let mut chars = text.chars();
    chars.next().map(|c| c.to_lowercase().chain(chars).collect()).unwrap_or_default()
}

/// Writes results to stdout. A reader that has gone away (`| head`) ends the command quietly.
pub fn say(text: &str) -> Result<(), Fail> {
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes()).and_then(|()| out.flush()).map_err(|e| match e.kind() {
        ErrorKind::BrokenPipe => Fail::silent(0),
        _ => Fail::failed(format!("stdout: writing failed: {}", reason(&e))),
    })
}
