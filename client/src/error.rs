//! Errors between a client and its master, each in one line with its remedy.

use slabcast_proto::convert::MAX_REASON;
use slabcast_proto::status::{Details, Reason};
use std::error::Error;
use std::time::Duration;
use tonic::{Code, Status};

/// An error of a call, or of a job; its text is one line with the remedy.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ClientError {
    /// The address can't be called.
    #[error("`{address}` {problem}")]
    Address {
        /// The address as it was given.
        address: String,
        /// Problem and remedy, for people.
        problem: &'static str,
    },
    /// Nobody answers at the address.
    #[error(
        "no master at {address} ({cause}): start one with `slabcast master`, or check host and port"
    )]
    Connect {
        /// The master's address.
        address: String,
        /// Text of the system's error.
        cause: String,
    },
    /// The peer at the address is no slabcast master, or says nothing.
    #[error(
        "no slabcast master at {address} ({problem}): check host and port; a master says at its start \
         where it listens, and no HTTP proxy may stand between"
    )]
    NotAMaster {
        /// The address that was called.
        address: String,
        /// Problem, for people.
        problem: String,
    },
    /// The connection broke, or the master is ending or starting.
    #[error("lost the master at {address} ({cause}): the job goes on; call again")]
    Lost {
        /// The master's address.
        address: String,
        /// Text of the system's error, or of the master's status.
        cause: String,
        /// Time that the master asks to wait before the call is made again.
        retry_after: Option<Duration>,
    },
    /// The master stayed away for longer than was allowed.
    #[error(
        "gave up on the master at {address} after {:.1} s ({last}): the job is not cancelled; \
         watch it from frame {next_frame} when the master is back", after.as_secs_f64()
    )]
    GaveUp {
        /// The master's address.
        address: String,
        /// Time that was spent waiting for it.
        after: Duration,
        /// Text of the last attempt's error.
        last: String,
        /// The first frame that is not whole.
        next_frame: u64,
    },
    /// The master stayed away during an upload.
    #[error(
        "gave up on the master at {address} after {:.1} s ({last}): put the volume again when it is \
         back; it goes on where it was", after.as_secs_f64()
    )]
    UploadStopped {
        /// The master's address.
        address: String,
        /// Time that was spent waiting for it.
        after: Duration,
        /// Text of the last attempt's error.
        last: String,
    },
    /// A field of the request is wrong.
    #[error("refused: {field}: {problem}")]
    InvalidField {
        /// Path of the field within the request, as the `.proto` writes it
        /// (`path.views.views[3].eye`); [`crate::local_field`] gives the name that flags and JSON
        /// files have for it.
        field: String,
        /// Problem and remedy, for people.
        problem: String,
    },
    /// The request is longer than a master takes.
    #[error(
        "the request has {bytes} bytes, at most {most} are taken: submit the path in parts or as a \
         turntable, or give the transfer function fewer points"
    )]
    TooLong {
        /// Bytes of the request.
        bytes: usize,
        /// The most bytes that are taken.
        most: usize,
    },
    /// The master has no such volume, can't read it, or does not take it.
    #[error("{message}")]
    Volume {
        /// Reason of the status.
        reason: Reason,
        /// The master's message, for people, with the remedy.
        message: String,
    },
    /// The master does not know the job.
    #[error("{message}: list the jobs it knows, or submit the path again (same pixels)")]
    NotFound {
        /// The master's message, for people.
        message: String,
    },
    /// The master no longer keeps the pixels of a frame.
    #[error("{message}{}", match first_kept_frame {
        Some(frame) => format!(": or watch from frame {frame}, the first that is kept"),
        None => String::new(),
    })]
    FrameNotKept {
        /// The first frame after it that the master keeps; `None` if it keeps none.
        first_kept_frame: Option<u64>,
        /// The master's message, for people.
        message: String,
    },
    /// The master has as many jobs or watchers as it takes.
    #[error("{message} (ResourceExhausted): the master is full; try later, or cancel a job")]
    Full {
        /// The master's message, for people.
        message: String,
        /// Time that the master asks to wait before the call is made again.
        retry_after: Option<Duration>,
    },
    /// The master answered with another status.
    #[error("{message} ({code:?}): {remedy}")]
    Status {
        /// Code of the status.
        code: Code,
        /// Reason of the status, if the master gave one that this version knows.
        reason: Option<Reason>,
        /// The master's message, for people.
        message: String,
        /// Remedy, for people.
        remedy: &'static str,
    },
    /// The job can't be finished.
    #[error("{job} failed: {reason}")]
    JobFailed {
        /// Id of the job.
        job: String,
        /// The master's reason and remedy, for people.
        reason: String,
    },
    /// The job was cancelled.
    #[error("{job} was cancelled: submit the path again to have the rest of it")]
    JobCancelled {
        /// Id of the job.
        job: String,
    },
    /// The master broke the protocol.
    #[error(
        "{address} does not talk like a slabcast master of this version ({problem}): check the \
         address and both versions"
    )]
    Protocol {
        /// The master's address.
        address: String,
        /// The rule that it broke, for people.
        problem: String,
    },
}

impl ClientError {
    /// Reads the status of a call, by its code and its details.
    pub(crate) fn from_status(address: &str, status: &Status) -> ClientError {
        let details = Details::from_status(status);
        if is_transient(status) {
            let cause = match status.source() {
                Some(source) => root_cause(source),
                None => one_line(status.message()),
            };
            let retry_after = details.retry_after;
            return ClientError::Lost { address: address.to_owned(), cause, retry_after };
        }
        let message = match one_line(status.message()) {
            empty if empty.is_empty() => status.code().description().to_owned(),
            message => message,
        };
        if let Some((field, problem)) = &details.field {
            let (field, problem) = (one_line(field), one_line(problem));
            return ClientError::InvalidField { field, problem };
        }
        if let Some(reason) = details.reason.filter(|r| r.is_of_volume()) {
            return ClientError::Volume { reason, message };
        }
        let remedy = match status.code() {
            Code::NotFound => return ClientError::NotFound { message },
            Code::Unimplemented => {
                return ClientError::Protocol { address: address.to_owned(), problem: message };
            }
            Code::ResourceExhausted => {
                return ClientError::Full { message, retry_after: details.retry_after };
            }
            Code::FailedPrecondition if details.reason == Some(Reason::FrameNotKept) => {
                let first_kept_frame = details.number("first_kept_frame");
                return ClientError::FrameNotKept { first_kept_frame, message };
            }
            Code::InvalidArgument => "change the request",
            Code::AlreadyExists => "the key belongs to another request; choose a fresh one",
            Code::OutOfRange => "ask for less: an earlier frame, or a shorter request",
            Code::FailedPrecondition => "watch from a later frame, or submit the path again",
            Code::DeadlineExceeded | Code::Cancelled => "the master is slow; try again",
            Code::PermissionDenied | Code::Unauthenticated => {
                "the master wants credentials, which this version can't send; ask who runs it"
            }
            _ => "the master is at fault; report it",
        };
        ClientError::Status { code: status.code(), reason: details.reason, message, remedy }
    }

    /// Returns whether the same call may succeed a little later without anybody doing anything.
    pub fn is_passing(&self) -> bool {
        matches!(self, ClientError::Lost { .. } | ClientError::Connect { .. })
    }

    /// Returns how long the master asks to wait before the call is made again, if it does.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            ClientError::Lost { retry_after, .. } | ClientError::Full { retry_after, .. } => {
                *retry_after
            }
            _ => None,
        }
    }
}

/// Whether a call ended because of the connection, or because the master asks to call again. A
/// status that was made on this side, by a connection that broke, has a source; one that a
/// master sent has none.
pub(crate) fn is_transient(status: &Status) -> bool {
    let sent_by_master = status.source().is_none();
    match status.code() {
        // DATA_LOSS: a message was damaged on its way.
        Code::Unavailable | Code::DataLoss => true,
        // Ours: the limit on an answer's time.
        Code::DeadlineExceeded => false,
        _ => !sent_by_master,
    }
}

/// The innermost cause, which is the one that means something ("connection refused").
pub(crate) fn root_cause(mut error: &dyn Error) -> String {
    while let Some(source) = error.source() {
        error = source;
    }
    one_line(&error.to_string())
}

/// A stranger's text, fit for a line of a terminal.
pub(crate) fn one_line(text: &str) -> String {
    text.chars()
        .take(MAX_REASON)
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect::<String>()
        .trim()
        .to_owned()
}
