//! The only door from wire to types, and back.
//!
//! Outward: `..._to_wire` functions never fail. Inward: `..._from_wire` functions take a
//! stranger's message and return our type or a [`WireError`] that names the field. They look at
//! sizes before they set memory aside, never panic, and check whatever later code relies on
//! (planes of the tile's size, finite matrices, codes inside tables), so that past this door
//! nobody asks again. What only a driver can know it checks itself: that a result has its
//! lease's size ([`check_result`]), that a view's depths fit its volume ([`check_view`]), that ids
//! are known.
//!
//! - **Control**, up: [`from_worker_to_wire`], [`from_worker_from_wire`]; down:
//!   [`to_worker_to_wire`], [`to_worker_from_wire`].
//! - **Bricks**, up: [`bricks_open_to_wire`], [`bricks_open_from_wire`]; down: [`BrickBatches`],
//!   [`Down::Bricks`], [`bricks_from_wire`].
//! - **WatchFrames**, down: [`frame_to_wire`], [`frame_failed_to_wire`], [`notice_to_wire`],
//!   [`watch_from_wire`].
//! - Other calls of clients, up: [`submit_to_wire`], [`submit_from_wire`], [`upload_to_wire`],
//!   [`upload_from_wire`]; down: `job_...`, `volume_...`, `worker_...`.

mod cluster;
mod error;
mod fields;
mod numbers;
mod render;

pub use cluster::{
    BrickBatches, Bricks, Compression, Down, bricks_from_wire, bricks_open_from_wire,
    bricks_open_to_wire, check_result, check_view, from_worker_from_wire, from_worker_to_wire,
    from_worker_to_wire_as, scene_from_wire, scene_to_wire, to_worker_from_wire, to_worker_to_wire,
    view_from_wire, view_to_wire,
};
pub use error::WireError;
pub use fields::{local_field, wire_field};
pub use render::{
    MAX_UPLOAD_CHUNK, Page, StatisticsPart, StatisticsParts, frame_failed_to_wire, frame_to_wire,
    framing_from_wire, framing_to_wire, job_from_wire, job_to_wire, notice_to_wire, page_from_wire,
    page_token, submit_from_wire, submit_to_wire, upload_from_wire, upload_to_wire,
    volume_choice_from_wire, volume_choice_to_wire, volume_from_wire, volume_header_from_wire,
    volume_header_to_wire, volume_list_from_wire, volume_list_to_wire, volume_to_wire,
    watch_from_wire, worker_from_wire, worker_to_wire,
};

use slabcast_common::volume::Digest32;

/// Pixels of the largest macrotile, 256 x 256 (`common::quality::Work`).
pub const MAX_TILE_PIXELS: usize = 256 * 256;

/// Most bricks of one list. Two million bricks are a thousand million voxels: more than one
/// task draws. Twice as many would not fit beside a tile's planes in
/// [`MAX_CONTROL_MESSAGE`](crate::MAX_CONTROL_MESSAGE).
pub const MAX_BRICK_LIST: usize = 1 << 21;

/// Longest name (client keys, worker names), in bytes.
pub const MAX_NAME: usize = 200;

/// Longest text for people (reasons, messages), in bytes. Longer ones are cut when they leave.
pub const MAX_REASON: usize = 4096;

/// Makes the two conversions of an enum. A value that is left out (number 0) is `$default`.
macro_rules! enum_conversions {
    ($to:ident, $from:ident, $ours:ty, $wire:ty, $default:expr, { $($a:ident <=> $b:ident),* }) => {
        pub(super) fn $to(value: $ours) -> i32 {
            (match value { $(<$ours>::$a => <$wire>::$b),* }) as i32
        }
        pub(super) fn $from(field: &str, value: i32) -> Result<$ours, WireError> {
            match <$wire>::try_from(value) {
                $(Ok(<$wire>::$b) => Ok(<$ours>::$a),)*
                Ok(<$wire>::Unspecified) => {
                    let default: Option<$ours> = $default;
                    default.ok_or_else(|| WireError::missing(field))
                }
                Err(_) => Err(WireError::unknown(field, value)),
            }
        }
    };
}
use enum_conversions;

/// Cuts a text for people to what the wire takes.
fn reason_to_wire(text: &str) -> String {
    cut(text, MAX_REASON).to_owned()
}

/// Returns as much of a text as fits `most` bytes, whole characters only.
fn cut(text: &str, most: usize) -> &str {
    let mut end = most.min(text.len());
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    &text[..end]
}

fn reason_from_wire(field: &str, text: String) -> Result<String, WireError> {
    if text.len() > MAX_REASON {
        return Err(WireError::too_long(field, text.len(), MAX_REASON));
    }
    // It is printed for people: nothing of it moves a cursor or begins a line.
    Ok(if text.contains(char::is_control) { text.replace(char::is_control, " ") } else { text })
}

/// Checks a name: not empty, and nothing that could forge a log line.
fn name_from_wire(field: &str, text: String) -> Result<String, WireError> {
    if text.is_empty() {
        return Err(WireError::missing(field));
    }
    optional_name_from_wire(field, text)
}

fn optional_name_from_wire(field: &str, text: String) -> Result<String, WireError> {
    if text.len() > MAX_NAME {
        return Err(WireError::too_long(field, text.len(), MAX_NAME));
    }
    if text.chars().any(char::is_control) {
        return Err(WireError::value(field, "has control characters; leave them out"));
    }
    Ok(text)
}

/// Unwraps a required message.
fn required<T>(field: &str, message: Option<T>) -> Result<T, WireError> {
    message.ok_or_else(|| WireError::missing(field))
}

fn digest_from_wire(field: &str, bytes: &[u8]) -> Result<Digest32, WireError> {
    match bytes.try_into() {
        Ok(digest) => Ok(Digest32(digest)),
        Err(_) => Err(WireError::length(field, bytes.len(), 32)),
    }
}
