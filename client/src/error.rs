//! What can go wrong between a client and its master, each in one line with its remedy.

use slabcast_proto::convert::MAX_REASON;
use std::error::Error;
use std::time::Duration;
use tonic::{Code, Status};

/// What went wrong, and what to do, in one line.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ClientError {
    /// The address can't be called.
    #[error("`{address}` {problem}")]
    Address {
        /// As it was given.
        address: String,
        /// What is wrong and what to do.
        problem: &'static str,
    },
    /// Nobody answers.
    #[error(
        "no master at {address} ({cause}): start one with `slabcast master`, or check host and port"
    )]
    Connect {
        /// Where.
        address: String,
        /// What the system says.
        cause: String,
    },
    /// The connection broke, or the master is ending or starting.
    #[error("lost the master at {address} ({cause}): the job goes on; call again")]
    Lost {
        /// Where.
        address: String,
        /// What the system or the master says.
        cause: String,
    },
    /// The master stayed away for longer than was allowed.
    #[error(
        "gave up on the master at {address} after {:.1} s ({last}): the job is not cancelled; \
         watch it from frame {next_frame} when the master is back", after.as_secs_f64()
    )]
    GaveUp {
        /// Where.
        address: String,
        /// How long it was waited for.
        after: Duration,
        /// What the last try said.
        last: String,
        /// The first frame that is not whole.
        next_frame: u64,
    },
    /// The master refused a field of the request.
    #[error("refused: {message}")]
    Refused {
        /// The field, what is wrong with it and what to do.
        message: String,
    },
    /// The request is longer than a master takes.
    #[error(
        "the request has {bytes} bytes, at most {most} are taken: submit the path in parts or as a \
         turntable, or give the transfer function fewer points"
    )]
    TooLong {
        /// Its bytes.
        bytes: usize,
        /// The most that are taken.
        most: usize,
    },
    /// The master does not know the job.
    #[error("{message}: list the jobs it knows, or submit the path again (same pixels)")]
    NotFound {
        /// What the master says.
        message: String,
    },
    /// The master said no.
    #[error("{message} ({code:?}): {remedy}")]
    Said {
        /// Its status.
        code: Code,
        /// What the master says.
        message: String,
        /// What to do.
        remedy: &'static str,
    },
    /// The job can't be finished.
    #[error("{job} failed: {reason}")]
    JobFailed {
        /// Which job.
        job: String,
        /// Why, and what to do.
        reason: String,
    },
    /// Somebody cancelled the job.
    #[error("{job} was cancelled: submit the path again to have the rest of it")]
    JobCancelled {
        /// Which job.
        job: String,
    },
    /// The master broke the protocol.
    #[error(
        "{address} does not talk like a slabcast master of this version ({problem}): check the address and both versions"
    )]
    Nonsense {
        /// Where.
        address: String,
        /// What it did.
        problem: String,
    },
}

impl ClientError {
    /// What a status of a call means.
    pub(crate) fn of_status(address: &str, status: &Status) -> ClientError {
        if is_weather(status) {
            let cause = match status.source() {
                Some(source) => root_cause(source),
                None => one_line(status.message()),
            };
            return ClientError::Lost { address: address.to_owned(), cause };
        }
        let message = match one_line(status.message()) {
            empty if empty.is_empty() => status.code().description().to_owned(),
            message => message,
        };
        let remedy = match status.code() {
            Code::InvalidArgument => return ClientError::Refused { message },
            Code::NotFound => return ClientError::NotFound { message },
            Code::Unimplemented => {
                return ClientError::Nonsense { address: address.to_owned(), problem: message };
            }
            Code::AlreadyExists => "the key belongs to another request; choose a fresh one",
            Code::ResourceExhausted => "the master is full; try later, or cancel a job",
            Code::OutOfRange => "ask for less: an earlier frame, or a shorter request",
            Code::FailedPrecondition => "watch from a later frame, or submit the path again",
            Code::DeadlineExceeded | Code::Cancelled => "the master is slow; try again",
            Code::PermissionDenied | Code::Unauthenticated => "ask who runs the master",
            _ => "the master is at fault; report it",
        };
        ClientError::Said { code: status.code(), message, remedy }
    }

    /// Whether the same call may succeed a little later without anybody doing anything.
    pub fn is_passing(&self) -> bool {
        matches!(self, ClientError::Lost { .. } | ClientError::Connect { .. })
    }
}

/// Whether a call ended because of the connection or because the master asks to call again. A
/// status that was made on this side, by a connection that broke, has a source; one that a
/// master sent has none.
pub(crate) fn is_weather(status: &Status) -> bool {
    let sent_by_master = status.source().is_none();
    match status.code() {
        Code::Unavailable => true,
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
