//! Messages between client and master (`slabcast.render.v1`).

mod jobs;
mod path;
#[path = "../shared.rs"]
mod shared;
mod statistics;
mod submit;
mod volume;
mod watch;

pub use jobs::{
    Page, job_from_wire, job_to_wire, page_from_wire, page_token, worker_from_wire, worker_to_wire,
};
pub use path::{framing_from_wire, framing_to_wire};
pub use statistics::{StatisticsPart, StatisticsParts};
pub use submit::{submit_from_wire, submit_to_wire};
pub use volume::{
    MAX_UPLOAD_CHUNK, upload_from_wire, upload_to_wire, volume_choice_from_wire,
    volume_choice_to_wire, volume_from_wire, volume_header_from_wire, volume_header_to_wire,
    volume_list_from_wire, volume_list_to_wire, volume_to_wire,
};
pub use watch::{frame_failed_to_wire, frame_to_wire, notice_to_wire, watch_from_wire};

use super::{WireError, enum_conversions};
use crate::render_v1 as wire;
use slabcast_scene::path::Axis;

/// An axis; `None` is the default that the field names.
fn axis_to_wire(axis: Option<Axis>) -> i32 {
    use wire::Axis::*;
    let axis = match axis {
        None => Unspecified,
        Some(Axis { index: 0, negative }) => [PositiveX, NegativeX][usize::from(negative)],
        Some(Axis { index: 1, negative }) => [PositiveY, NegativeY][usize::from(negative)],
        Some(Axis { negative, .. }) => [PositiveZ, NegativeZ][usize::from(negative)],
    };
    axis as i32
}

/// An axis; `None` is the default that the field names.
fn axis_from_wire(field: &str, axis: i32) -> Result<Option<Axis>, WireError> {
    use wire::Axis::*;
    let (index, negative) = match wire::Axis::try_from(axis) {
        Ok(Unspecified) => return Ok(None),
        Ok(PositiveX) => (0, false),
        Ok(NegativeX) => (0, true),
        Ok(PositiveY) => (1, false),
        Ok(NegativeY) => (1, true),
        Ok(PositiveZ) => (2, false),
        Ok(NegativeZ) => (2, true),
        Err(_) => return Err(WireError::unknown(field, axis)),
    };
    Ok(Some(Axis { index, negative }))
}
