//! The error of a message that can't be read.

use crate::status;
use slabcast_common::quality::InvalidField;

/// Why a stranger's message is refused. Every variant names the field as the `.proto` writes it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// A required field is missing, or a message is of a kind that this version can't know.
    #[error("{field}: missing; it is required")]
    Missing {
        /// Path of the field.
        field: String,
    },
    /// A field must have an exact length.
    #[error("{field}: has {have} entries; give exactly {need}")]
    Length {
        /// Path of the field.
        field: String,
        /// Length of the field (bytes, or entries).
        have: usize,
        /// The only one allowed.
        need: usize,
    },
    /// A field is longer than allowed.
    #[error("{field}: has {have} entries; give at most {most}")]
    TooLong {
        /// Path of the field.
        field: String,
        /// Length of the field (bytes, or entries).
        have: usize,
        /// The largest allowed.
        most: usize,
    },
    /// An enum has a value that this version does not know.
    #[error("{field}: {value} has no meaning in this version")]
    Unknown {
        /// Path of the field.
        field: String,
        /// Number that stands in the message.
        value: i32,
    },
    /// A value can't be used.
    #[error("{field}: {problem}")]
    Value {
        /// Path of the field.
        field: String,
        /// Problem and remedy, for people.
        problem: String,
    },
}

impl WireError {
    pub(crate) fn missing(field: impl Into<String>) -> Self {
        WireError::Missing { field: field.into() }
    }

    pub(crate) fn length(field: impl Into<String>, have: usize, need: usize) -> Self {
        WireError::Length { field: field.into(), have, need }
    }

    pub(crate) fn too_long(field: impl Into<String>, have: usize, most: usize) -> Self {
        WireError::TooLong { field: field.into(), have, most }
    }

    pub(crate) fn unknown(field: impl Into<String>, value: i32) -> Self {
        WireError::Unknown { field: field.into(), value }
    }

    pub(crate) fn value(field: impl Into<String>, problem: impl Into<String>) -> Self {
        WireError::Value { field: field.into(), problem: problem.into() }
    }

    /// Returns the path of the wrong field within its message, as the `.proto` writes it.
    pub fn field(&self) -> &str {
        match self {
            WireError::Missing { field }
            | WireError::Length { field, .. }
            | WireError::TooLong { field, .. }
            | WireError::Unknown { field, .. }
            | WireError::Value { field, .. } => field,
        }
    }

    /// Returns what is wrong with the field, without its path.
    pub fn problem(&self) -> String {
        let text = self.to_string();
        text[self.field().len()..].trim_start_matches(": ").to_owned()
    }

    /// Prefixes the path of the field with that of the message it is in.
    pub(crate) fn within(mut self, outer: &str) -> Self {
        let (WireError::Missing { field }
        | WireError::Length { field, .. }
        | WireError::TooLong { field, .. }
        | WireError::Unknown { field, .. }
        | WireError::Value { field, .. }) = &mut self;
        *field = format!("{outer}.{field}");
        self
    }
}

impl From<InvalidField> for WireError {
    fn from(refused: InvalidField) -> Self {
        WireError::Value { field: refused.field, problem: refused.problem }
    }
}

impl From<WireError> for tonic::Status {
    /// INVALID_ARGUMENT with BadRequest and ErrorInfo, as `render.proto` says.
    fn from(wrong: WireError) -> Self {
        status::invalid_field(wrong.field(), &wrong.problem())
    }
}
