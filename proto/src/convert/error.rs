//! Why a stranger's message is refused.

use slabcast_common::quality::Refused;

/// Why a stranger's message is refused. Each names the field as the `.proto` writes it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// A required field is not there, or a message is of a kind that this version can't know.
    #[error("{field}: missing; it is required")]
    Missing {
        /// Which.
        field: String,
    },
    /// A field must have an exact length.
    #[error("{field}: has {have} entries; give exactly {need}")]
    Length {
        /// Which.
        field: String,
        /// Its length (bytes, or numbers).
        have: usize,
        /// The only one allowed.
        need: usize,
    },
    /// A field is longer than allowed.
    #[error("{field}: has {have} entries; give at most {most}")]
    TooLong {
        /// Which.
        field: String,
        /// Its length (bytes, or entries).
        have: usize,
        /// The largest allowed.
        most: usize,
    },
    /// An enum has a number that this version does not know.
    #[error("{field}: {value} has no meaning in this version")]
    Unknown {
        /// Which.
        field: String,
        /// The number.
        value: i32,
    },
    /// A value can't be used.
    #[error("{field}: {problem}")]
    Value {
        /// Which.
        field: String,
        /// What is wrong and what to do.
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

    /// The field that is wrong, as the `.proto` writes it.
    pub fn field(&self) -> &str {
        match self {
            WireError::Missing { field }
            | WireError::Length { field, .. }
            | WireError::TooLong { field, .. }
            | WireError::Unknown { field, .. }
            | WireError::Value { field, .. } => field,
        }
    }

    /// The same, with the field as part of `outer`.
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

impl From<Refused> for WireError {
    fn from(refused: Refused) -> Self {
        WireError::Value { field: refused.field, problem: refused.problem }
    }
}

impl From<WireError> for tonic::Status {
    fn from(wrong: WireError) -> Self {
        tonic::Status::invalid_argument(wrong.to_string())
    }
}
