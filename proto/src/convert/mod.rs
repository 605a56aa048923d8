//! The only door from wire to types, and back.
//!
//! Outward: `..._to_wire` functions never fail. Inward: `..._from_wire` functions take a
//! stranger's message and give our type or a [`WireError`] that names the field. They look at
//! sizes before they set memory aside, never panic, and check whatever later code relies on
//! (planes of the tile's size, finite matrices, codes inside tables), so that past this door
//! nobody asks again. What only a driver can know it checks itself: that a result has its
//! lease's size ([`check_result`]), that a view's depths fit its volume ([`check_view`]), that ids
//! are known.
//!
//! | stream | up | down |
//! |--|--|--|
//! | Control | [`from_worker_to_wire`], [`from_worker_from_wire`] | [`to_worker_to_wire`], [`to_worker_from_wire`] |
//! | Bricks | [`bricks_open_to_wire`], [`bricks_open_from_wire`] | [`brick_batches_to_wire`], [`Down::Bricks`], [`bricks_from_wire`] |
//! | WatchFrames | - | [`frame_to_wire`], [`notice_to_wire`], [`chunk_from_wire`] |
//! | Render, other | [`path_request_to_wire`], [`path_request_from_wire`] | `job_...`, `volume_...`, `worker_...` |

mod cluster;
mod error;
mod leaves;
mod path;
mod plane;
mod render;
mod scene;

pub use cluster::{
    Bricks, Down, brick_batches_to_wire, bricks_from_wire, bricks_open_from_wire,
    bricks_open_to_wire, check_result, from_worker_from_wire, from_worker_to_wire,
    from_worker_to_wire_as, to_worker_from_wire, to_worker_to_wire,
};
pub use error::WireError;
pub use render::{
    chunk_from_wire, frame_to_wire, job_from_wire, job_to_wire, notice_from_wire, notice_to_wire,
    path_request_from_wire, path_request_to_wire, volume_from_wire, volume_to_wire,
    worker_from_wire, worker_to_wire,
};
pub use scene::{check_view, scene_from_wire, scene_to_wire, view_from_wire, view_to_wire};

use slabcast_common::brick::MAX_BRICKS;
use slabcast_common::ids::BrickId;
use slabcast_common::transfer::TransferFunction;
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

/// A text for people, cut to what the wire takes.
fn reason_to_wire(text: &str) -> String {
    cut(text, MAX_REASON).to_owned()
}

/// As much of a text as fits `most` bytes, whole characters only.
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
    Ok(text)
}

/// A name: not empty, and nothing that could forge a log line.
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

/// A transfer function as JSON; `transfer_json.colors[3]` names a point of it.
fn transfer_from_wire(json: &str) -> Result<TransferFunction, WireError> {
    TransferFunction::from_json(json).map_err(|e| match e.field.as_str() {
        // JSON that can't be read at all.
        "transfer function" => WireError::value("transfer_json", e.problem),
        _ => WireError::from(e).within("transfer_json"),
    })
}

/// A required message.
fn required<T>(field: &str, message: Option<T>) -> Result<T, WireError> {
    message.ok_or_else(|| WireError::missing(field))
}

fn digest_from_wire(field: &str, bytes: &[u8]) -> Result<Digest32, WireError> {
    match bytes.try_into() {
        Ok(digest) => Ok(Digest32(digest)),
        Err(_) => Err(WireError::length(field, bytes.len(), 32)),
    }
}

fn bricks_to_wire(ids: &[BrickId]) -> crate::v1::BrickIds {
    let mut before = 0u32;
    let differences = ids
        .iter()
        .map(|id| {
            let difference = id.0.wrapping_sub(before) as i32;
            before = id.0;
            difference
        })
        .collect();
    crate::v1::BrickIds { differences }
}

/// A list that was left out is empty: that is how protobuf writes an empty message's content.
fn bricks_list_from_wire(
    field: &str,
    list: Option<crate::v1::BrickIds>,
) -> Result<Vec<BrickId>, WireError> {
    let differences = list.unwrap_or_default().differences;
    if differences.len() > MAX_BRICK_LIST {
        return Err(WireError::too_long(field, differences.len(), MAX_BRICK_LIST));
    }
    let mut id = 0u32;
    differences
        .into_iter()
        .map(|d| {
            id = id.wrapping_add(d as u32);
            if u64::from(id) < MAX_BRICKS {
                Ok(BrickId(id))
            } else {
                Err(WireError::value(field, format!("brick {id}; ids are below {MAX_BRICKS}")))
            }
        })
        .collect()
}
