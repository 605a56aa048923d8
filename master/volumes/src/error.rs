//! Errors of opening a file: one line each, with the file, the field and the remedy.

/// Kind of failure, for callers that treat kinds differently.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OpenErrorKind {
    /// The file is missing, is a folder, or the operating system refused to read it.
    Unreadable,
    /// The content is no volume: another kind of file, or empty.
    NotAVolume,
    /// The fields of a volume file contradict each other, its format or the hints.
    Malformed,
    /// The file is sound, but of a variant that this version does not read.
    Unsupported,
    /// A header points outside its own folder, or something is a pipe, socket or device.
    Forbidden,
    /// The volume exceeds a limit of this program or the memory of this machine.
    TooLarge,
    /// The samples end early, go on too long, or fail their checksum.
    Damaged,
}

/// A failure without the name of the file: kind, field, what is wrong, and the remedy.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}", one_line(&format!("{field}: {what}; {remedy}")))]
pub struct Problem {
    /// Kind of failure, by which programs tell failures apart.
    pub kind: OpenErrorKind,
    /// Field of the file, in the words of its format (`content` where it has none).
    pub field: String,
    /// Problem with the field, in words for people.
    pub what: String,
    /// Remedy that is open to the user, in words for people.
    pub remedy: String,
    /// The numbers of a voxel, 3 or 4, if they are colours: why one of them alone is no volume.
    pub(crate) colours: Option<u8>,
}

/// A file that was not opened, and why. `Display` prints one line without control characters.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}: {problem}", one_line(file))]
pub struct OpenError {
    /// Path as the caller gave it.
    pub file: String,
    /// Kind of failure, field, what is wrong, and the remedy.
    pub problem: Problem,
}

/// Remedy for a picture that is one slice of a volume.
pub(crate) const FLAT_REMEDY: &str =
    "give the folder with all slices of the volume, or one file of three axes";

impl Problem {
    pub(crate) fn new(
        kind: OpenErrorKind,
        field: impl Into<String>,
        what: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        let (field, what, remedy) = (field.into(), what.into(), remedy.into());
        Problem { kind, field, what, remedy, colours: None }
    }

    /// Returns the error with which a caller ends a long piece of work that it was asked to stop.
    pub fn stopped() -> Problem {
        Problem::new(OpenErrorKind::Unreadable, "work", "was stopped", "begin again")
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

    /// A file of two axes: a picture of `width` x `height` pixels.
    pub(crate) fn flat(field: impl Into<String>, width: u64, height: u64) -> Self {
        Problem::unsupported(
            field,
            format!("is a 2-D picture of {width} x {height}, not a volume"),
            FLAT_REMEDY,
        )
    }

    /// A panic in a reader's thread, which is a bug of this program.
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

/// Quotes text of a file: at most 60 characters, control characters escaped.
pub(crate) fn quoted(text: &str) -> String {
    const SHOWN: usize = 60;
    let mut s: String = text.chars().take(SHOWN).flat_map(char::escape_debug).collect();
    if text.chars().count() > SHOWN {
        s.push_str("...");
    }
    format!("`{s}`")
}

/// Replaces control characters, so that an error stays one line whatever the file's name.
fn one_line(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn error_is_one_line_even_if_the_file_name_has_newlines() {
        let e = OpenError {
            file: "evil\nname\u{1b}[31m.nrrd".into(),
            problem: Problem::malformed("sizes", quoted("a\nb"), "give three numbers"),
        };
        let shown = e.to_string();
        assert!(!shown.contains(char::is_control), "{shown:?}");
        assert!(shown.contains("sizes") && shown.ends_with("; give three numbers"), "{shown}");
    }
}
