//! Why a file was not opened: one line for a person, with the file, the field and the remedy.

/// What kind of trouble it is, for callers that treat kinds differently.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OpenErrorKind {
    /// Missing, a folder, a pipe or device, or the operating system refused.
    Unreadable,
    /// The content is something else.
    NotAVolume,
    /// A volume file whose fields contradict themselves or its format.
    Malformed,
    /// A proper file of a sort that this version does not read.
    Unsupported,
    /// A header that points at data outside its own folder, or at something that is no file.
    Forbidden,
    /// Beyond this program's limits or this machine's memory.
    TooLarge,
    /// The samples end early, go on too long, or fail their checksum.
    Damaged,
}

/// What is wrong, before anybody said in which file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}", one_line(&format!("{field}: {what}; {remedy}")))]
pub struct Problem {
    /// What kind of trouble.
    pub kind: OpenErrorKind,
    /// Which field of the file, in the words of its format (`content` where it has none).
    pub field: String,
    /// What is wrong with it.
    pub what: String,
    /// What to do.
    pub remedy: String,
}

/// A file that was not opened, and why. It is shown as one line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}: {problem}", one_line(file))]
pub struct OpenError {
    /// The path as it was given.
    pub file: String,
    /// What is wrong.
    pub problem: Problem,
}

impl Problem {
    pub(crate) fn new(
        kind: OpenErrorKind,
        field: impl Into<String>,
        what: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Problem { kind, field: field.into(), what: what.into(), remedy: remedy.into() }
    }

    pub(crate) fn malformed(
        field: impl Into<String>,
        what: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Problem::new(OpenErrorKind::Malformed, field, what, remedy)
    }

    pub(crate) fn unsupported(
        field: impl Into<String>,
        what: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Problem::new(OpenErrorKind::Unsupported, field, what, remedy)
    }

    /// A reader's thread panicked: a mistake of this program, which the file brought out.
    pub(crate) fn panicked(field: impl Into<String>, panic: &(dyn std::any::Any + Send)) -> Self {
        let message = panic
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| panic.downcast_ref::<&str>().copied())
            .unwrap_or("a panic without a message");
        Problem::unsupported(
            field,
            format!("the reader panicked ({message})"),
            "report the file as a bug of slabcast, and convert it with another program",
        )
    }

    pub(crate) fn io(field: impl Into<String>, e: &std::io::Error) -> Self {
        Problem::new(
            OpenErrorKind::Unreadable,
            field,
            format!("reading failed ({e})"),
            "check that the file can be read",
        )
    }
}

/// A stranger's text between quotes, short and without control characters.
pub(crate) fn quoted(text: &str) -> String {
    const SHOWN: usize = 60;
    let mut s: String = text.chars().take(SHOWN).flat_map(char::escape_debug).collect();
    if text.chars().count() > SHOWN {
        s.push_str("...");
    }
    format!("`{s}`")
}

/// Errors are one line even when a file's name is not.
fn one_line(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_is_one_line_whatever_the_name() {
        let e = OpenError {
            file: "evil\nname\u{1b}[31m.nrrd".into(),
            problem: Problem::malformed("sizes", quoted("a\nb"), "give three numbers"),
        };
        let shown = e.to_string();
        assert!(!shown.contains(char::is_control), "{shown:?}");
        assert!(shown.contains("sizes") && shown.ends_with("; give three numbers"), "{shown}");
    }
}
