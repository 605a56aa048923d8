//! Errors of calls: statuses with google.rpc details, written and read.
//!
//! `render.proto` says which details a status has. A master makes statuses with
//! [`invalid_field`], [`Reason::status`] and [`Reason::retry`]; a client takes them apart with
//! [`Details::from_status`], and never reads the message.

use std::collections::BTreeMap;
use std::time::Duration;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// The domain of every ErrorInfo of a master.
pub const DOMAIN: &str = "slabcast";

/// Why a call failed: `ErrorReason` of `render.proto`, and the reasons of `cluster.proto`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// A field is wrong; BadRequest names it.
    InvalidField,
    /// The client key belongs to another request.
    ClientKeyTaken,
    /// The master has all the jobs in progress that it takes.
    TooManyJobs,
    /// The master has all the watches open that it takes.
    TooManyWatchers,
    /// The master knows no such job.
    JobNotFound,
    /// The frame asked for is beyond the job's last.
    FrameBeyondEnd,
    /// The pixels of a frame are gone.
    FrameNotKept,
    /// The master is ending.
    MasterEnding,
    /// The master has no volume of this name or digest.
    VolumeNotFound,
    /// The file of a volume can't be read.
    VolumeNotReadable,
    /// The master has no memory, or no place, for a volume.
    NoRoomForVolume,
    /// Another volume has the name.
    VolumeNameTaken,
    /// A volume can't be removed.
    VolumeInUse,
    /// The master takes no volumes of clients.
    UploadsRefused,
    /// The Bricks stream of a worker's link ended.
    BricksEnded,
    /// A worker's message came out of order.
    OutOfOrder,
    /// A Bricks stream names a session that is over or unknown.
    SessionUnknown,
    /// A worker's first message, or its second connection, did not come in time.
    TooLate,
}

impl Reason {
    /// Every reason.
    const ALL: [Reason; 18] = [
        Reason::InvalidField,
        Reason::ClientKeyTaken,
        Reason::TooManyJobs,
        Reason::TooManyWatchers,
        Reason::JobNotFound,
        Reason::FrameBeyondEnd,
        Reason::FrameNotKept,
        Reason::MasterEnding,
        Reason::VolumeNotFound,
        Reason::VolumeNotReadable,
        Reason::NoRoomForVolume,
        Reason::VolumeNameTaken,
        Reason::VolumeInUse,
        Reason::UploadsRefused,
        Reason::BricksEnded,
        Reason::OutOfOrder,
        Reason::SessionUnknown,
        Reason::TooLate,
    ];

    /// Returns the reason as `ErrorInfo.reason` has it, in capitals (`JOB_NOT_FOUND`).
    pub fn name(self) -> &'static str {
        match self {
            Reason::InvalidField => "INVALID_FIELD",
            Reason::ClientKeyTaken => "CLIENT_KEY_TAKEN",
            Reason::TooManyJobs => "TOO_MANY_JOBS",
            Reason::TooManyWatchers => "TOO_MANY_WATCHERS",
            Reason::JobNotFound => "JOB_NOT_FOUND",
            Reason::FrameBeyondEnd => "FRAME_BEYOND_END",
            Reason::FrameNotKept => "FRAME_NOT_KEPT",
            Reason::MasterEnding => "MASTER_ENDING",
            Reason::VolumeNotFound => "VOLUME_NOT_FOUND",
            Reason::VolumeNotReadable => "VOLUME_NOT_READABLE",
            Reason::NoRoomForVolume => "NO_ROOM_FOR_VOLUME",
            Reason::VolumeNameTaken => "VOLUME_NAME_TAKEN",
            Reason::VolumeInUse => "VOLUME_IN_USE",
            Reason::UploadsRefused => "UPLOADS_REFUSED",
            Reason::BricksEnded => "BRICKS_ENDED",
            Reason::OutOfOrder => "OUT_OF_ORDER",
            Reason::SessionUnknown => "SESSION_UNKNOWN",
            Reason::TooLate => "TOO_LATE",
        }
    }

    /// Returns whether the reason lies in a volume: that it is not there, not readable, not taken or not
    /// removed.
    pub fn is_of_volume(self) -> bool {
        matches!(
            self,
            Reason::VolumeNotFound
                | Reason::VolumeNotReadable
                | Reason::NoRoomForVolume
                | Reason::VolumeNameTaken
                | Reason::VolumeInUse
                | Reason::UploadsRefused
        )
    }

    /// Returns the status code that goes with this reason.
    pub fn code(self) -> Code {
        match self {
            Reason::InvalidField => Code::InvalidArgument,
            Reason::ClientKeyTaken | Reason::VolumeNameTaken => Code::AlreadyExists,
            Reason::TooManyJobs | Reason::TooManyWatchers | Reason::NoRoomForVolume => {
                Code::ResourceExhausted
            }
            Reason::JobNotFound | Reason::VolumeNotFound => Code::NotFound,
            Reason::FrameBeyondEnd => Code::OutOfRange,
            Reason::MasterEnding | Reason::BricksEnded => Code::Unavailable,
            Reason::FrameNotKept
            | Reason::VolumeNotReadable
            | Reason::VolumeInUse
            | Reason::UploadsRefused
            | Reason::OutOfOrder
            | Reason::SessionUnknown
            | Reason::TooLate => Code::FailedPrecondition,
        }
    }

    /// Makes a status with this reason, a message for people, and metadata for programs.
    pub fn status(self, message: &str, metadata: &[(&str, String)]) -> Status {
        Status::with_error_details(self.code(), message, self.details(metadata))
    }

    /// Makes a status with this reason that tells the caller to repeat the call after `delay`.
    pub fn retry(self, message: &str, delay: Duration) -> Status {
        let mut details = self.details(&[]);
        details.set_retry_info(Some(delay));
        Status::with_error_details(self.code(), message, details)
    }

    fn details(self, metadata: &[(&str, String)]) -> ErrorDetails {
        let metadata: std::collections::HashMap<String, String> =
            metadata.iter().map(|(k, v)| ((*k).to_owned(), v.clone())).collect();
        ErrorDetails::with_error_info(self.name(), DOMAIN, metadata)
    }
}

/// Makes INVALID_ARGUMENT for the field at `field` (a path within the request,
/// `path.views.views[3].eye`), of which `problem` says what is wrong and what to do.
pub fn invalid_field(field: &str, problem: &str) -> Status {
    let mut details = Reason::InvalidField.details(&[]);
    details.add_bad_request_violation(field, problem);
    let message = format!("{field}: {problem}");
    Status::with_error_details(Reason::InvalidField.code(), message, details)
}

/// The details of a status, as a client uses them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Details {
    /// Reason of the ErrorInfo; `None` if there is none, of another domain, or newer than this
    /// program.
    pub reason: Option<Reason>,
    /// Metadata of the status's `ErrorInfo`, by key.
    pub metadata: BTreeMap<String, String>,
    /// The first field violation of the BadRequest: path and description.
    pub field: Option<(String, String)>,
    /// Time after which to try again, from the status's `RetryInfo`; `None` if there is none.
    pub retry_after: Option<Duration>,
}

impl Details {
    /// Reads the details of a status. Details that can't be read are left out: they come from a
    /// stranger, and the code and the message are there without them.
    pub fn from_status(status: &Status) -> Details {
        let found = status.get_error_details();
        let info = found.error_info().filter(|info| info.domain == DOMAIN);
        let violation = found.bad_request().and_then(|bad| bad.field_violations.first());
        Details {
            reason: info
                .and_then(|i| Reason::ALL.into_iter().find(|reason| reason.name() == i.reason)),
            metadata: info.map(|i| i.metadata.clone().into_iter().collect()).unwrap_or_default(),
            field: violation.map(|v| (v.field.clone(), v.description.clone())),
            retry_after: found.retry_info().and_then(|retry| retry.retry_delay),
        }
    }

    /// Returns a whole number of the metadata, if it is there and is one.
    pub fn number(&self, key: &str) -> Option<u64> {
        self.metadata.get(key)?.parse().ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render_v1::ErrorReason;

    #[test]
    fn error_details_arrive_as_they_were_written() {
        let status = Reason::FrameNotKept.status("gone", &[("first_kept_frame", "7".into())]);
        assert_eq!((status.code(), status.message()), (Code::FailedPrecondition, "gone"));
        let details = Details::from_status(&status);
        assert_eq!(details.reason, Some(Reason::FrameNotKept));
        assert_eq!(details.number("first_kept_frame"), Some(7));
        assert_eq!((details.field.as_ref(), details.retry_after), (None, None));

        let status = invalid_field("path.width", "0 pixels; give 1 to 8192");
        assert_eq!(status.message(), "path.width: 0 pixels; give 1 to 8192");
        let details = Details::from_status(&status);
        assert_eq!(details.reason, Some(Reason::InvalidField));
        let violation = ("path.width".to_owned(), "0 pixels; give 1 to 8192".to_owned());
        assert_eq!(details.field, Some(violation));

        let delay = Duration::from_millis(1500);
        let details = Details::from_status(&Reason::TooManyJobs.retry("full", delay));
        assert_eq!(details.retry_after, Some(delay));
    }

    #[test]
    fn error_details_of_strangers_are_left_out() {
        let none = Details::default();
        assert_eq!(Details::from_status(&Status::not_found("no")), none);
        let garbage = Status::with_details(Code::NotFound, "no", vec![0xff; 40].into());
        assert_eq!(Details::from_status(&garbage), none);
        let info = ErrorDetails::with_error_info(
            "JOB_NOT_FOUND",
            "example.com",
            [("a".into(), "b".into())],
        );
        assert_eq!(
            Details::from_status(&Status::with_error_details(Code::NotFound, "", info)),
            none
        );
    }

    #[test]
    fn error_reasons_have_the_names_that_render_proto_lists() {
        for number in 1.. {
            let Ok(reason) = ErrorReason::try_from(number) else {
                assert_eq!(number, 15, "reasons of render.proto");
                break;
            };
            let name = reason.as_str_name().trim_start_matches("ERROR_REASON_");
            assert!(Reason::ALL.iter().any(|r| r.name() == name), "{name}");
        }
    }
}
