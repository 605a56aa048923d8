//! The calls about volumes: describe, list, put and remove.

use crate::Handle;
use crate::library::{Progress, ServedVolume, VolumeError};
use slabcast_proto::convert;
use slabcast_proto::model::{self, UploadPart};
use slabcast_proto::render_v1 as wire;
use slabcast_proto::status::{Reason, invalid_field};
use std::net::IpAddr;
use std::time::Duration;
use tonic::Status;

/// RetryInfo of a master that takes no other upload now.
const BUSY_RETRY: Duration = Duration::from_secs(5);

/// Makes the status of an error with a volume.
pub(super) fn volume_status(error: &VolumeError) -> Status {
    let reason = match error {
        VolumeError::Choose(problem) => return invalid_field("volume", problem),
        VolumeError::Damaged(problem) => return invalid_field("begin.volume.digest", problem),
        VolumeError::NoRoom(why, true) => return Reason::NoRoomForVolume.retry(why, BUSY_RETRY),
        VolumeError::NotFound(_) => Reason::VolumeNotFound,
        VolumeError::NotReadable(_) => Reason::VolumeNotReadable,
        VolumeError::NoRoom(_, false) => Reason::NoRoomForVolume,
        VolumeError::NameTaken(_) => Reason::VolumeNameTaken,
        VolumeError::InUse(_) => Reason::VolumeInUse,
        VolumeError::Refused(_) => Reason::UploadsRefused,
    };
    reason.status(&error.to_string(), &[])
}

fn ending() -> Status {
    Reason::MasterEnding.retry("the master ends", Duration::from_secs(1))
}

/// Answers DescribeVolume.
pub(super) async fn describe(
    handle: &Handle,
    request: wire::DescribeVolumeRequest,
    peer: Option<IpAddr>,
) -> Result<wire::DescribeVolumeResponse, Status> {
    let choice = convert::volume_choice_from_wire(request.volume)?;
    let viewer = handle.viewer(peer);
    let described = handle.reading(move |library| {
        let served = library.describe(&choice, viewer)?;
        let name = library.name_of(served.info.digest, viewer);
        Ok((served, name))
    });
    let (served, name) = described.await.ok_or_else(ending)?.map_err(|e| volume_status(&e))?;
    let ServedVolume { file_type, anatomical, info, orientation, .. } = (*served).clone();
    Ok(convert::volume_to_wire(&model::VolumeDescription {
        name,
        file_type,
        anatomical,
        info,
        orientation,
        pixels_version: slabcast_common::PIXELS_VERSION,
        protocol_version: slabcast_common::PROTOCOL_VERSION,
        now_unix_ms: crate::handle::unix_ms(),
    }))
}

/// Answers ListVolumes.
pub(super) async fn list(
    handle: &Handle,
    request: wire::ListVolumesRequest,
    peer: Option<IpAddr>,
) -> Result<wire::ListVolumesResponse, Status> {
    let wire::ListVolumesRequest { page_size, page_token } = request;
    let wanted = convert::page_from_wire(page_size, &page_token)?;
    let viewer = handle.viewer(peer);
    let listed = handle.looking(move |library| library.list(viewer)).await;
    let listed = listed.ok_or_else(ending)?;
    // Entries are numbered as they come: one that is added between two pages may repeat another.
    let begin = wanted.after.map_or(0, |after| after as usize + 1).min(listed.len());
    let end = (begin + wanted.size).min(listed.len());
    let token =
        if end < listed.len() { convert::page_token(end as u64 - 1) } else { String::new() };
    let list = model::VolumeList {
        volumes: listed[begin..end].to_vec(),
        pixels_version: slabcast_common::PIXELS_VERSION,
        protocol_version: slabcast_common::PROTOCOL_VERSION,
        now_unix_ms: crate::handle::unix_ms(),
    };
    Ok(convert::volume_list_to_wire(&list, token))
}

/// Answers PutVolume.
pub(super) async fn put(
    handle: &Handle,
    request: wire::PutVolumeRequest,
    peer: Option<IpAddr>,
) -> Result<wire::PutVolumeResponse, Status> {
    let part = convert::upload_from_wire(request)?;
    let taken = handle.looking(move |library| match part {
        UploadPart::Begin(header) => library.begin_upload(*header, peer),
        UploadPart::Chunk { digest, offset, data } => library.add_chunk(digest, offset, &data),
    });
    let taken = taken.await.ok_or_else(ending)?;
    let Progress { received_bytes, done } = taken.map_err(|e| volume_status(&e))?;
    Ok(wire::PutVolumeResponse { received_bytes, done })
}

/// Answers RemoveVolume.
pub(super) async fn remove(
    handle: &Handle,
    request: wire::RemoveVolumeRequest,
    peer: Option<IpAddr>,
) -> Result<wire::RemoveVolumeResponse, Status> {
    let (viewer, of_jobs) = (handle.viewer(peer), handle.clone());
    let removed = handle.looking(move |library| {
        library.remove(&request.name, viewer, |digest| of_jobs.is_drawn(digest))
    });
    removed.await.ok_or_else(ending)?.map_err(|e| volume_status(&e))?;
    Ok(wire::RemoveVolumeResponse {})
}
