//! Volumes: what DescribeVolume and ListVolumes answer, and the parts of an upload.

use super::shared::{
    kind_from_wire, kind_to_wire, palette_to_wire, vec3_from_wire, vec3_to_wire, with_palette,
};
use super::{axis_from_wire, axis_to_wire, enum_conversions, wire};
use crate::convert::numbers::{
    SummaryFields, check_lattice, finest_vox_from_wire, finite, summary_from_fields,
};
use crate::convert::{
    MAX_REASON, WireError, digest_from_wire, name_from_wire, reason_from_wire, reason_to_wire,
    required,
};
use crate::model::{
    UploadPart, VolumeDescription, VolumeEntry, VolumeHeader, VolumeList, VolumeOrigin,
};
use bytes::Bytes;
use glam::DVec3;
use slabcast_common::volume::{Digest32, Lattice, ValueCore, ValueSummary, VolumeInfo};
use slabcast_scene::path::Orientation;
use slabcast_scene::request::VolumeChoice;

/// Most bytes of a chunk of an upload.
pub const MAX_UPLOAD_CHUNK: usize = 2 << 20;

enum_conversions!(origin_to_wire, origin_from_wire, VolumeOrigin, wire::VolumeOrigin, None,
    { Given <=> Given, Folder <=> Folder, Upload <=> Upload });

/// Writes which volume is meant; `None` is the default one.
pub fn volume_choice_to_wire(choice: &VolumeChoice) -> Option<wire::VolumeChoice> {
    use wire::volume_choice::Choice;
    let choice = match choice {
        VolumeChoice::Default => return None,
        VolumeChoice::Name(name) => Choice::Name(name.clone()),
        VolumeChoice::Digest(digest) => Choice::Digest(Bytes::copy_from_slice(&digest.0)),
    };
    Some(wire::VolumeChoice { choice: Some(choice) })
}

/// Reads which volume is meant, of a request's field `volume`.
///
/// # Errors
/// [`WireError`] names `volume.name` or `volume.digest`.
pub fn volume_choice_from_wire(
    choice: Option<wire::VolumeChoice>,
) -> Result<VolumeChoice, WireError> {
    use wire::volume_choice::Choice;
    Ok(match choice.and_then(|c| c.choice) {
        None => VolumeChoice::Default,
        Some(Choice::Name(name)) => VolumeChoice::Name(name_from_wire("volume.name", name)?),
        Some(Choice::Digest(digest)) => {
            VolumeChoice::Digest(digest_from_wire("volume.digest", &digest)?)
        }
    })
}

/// Writes a page of a master's volumes.
pub fn volume_list_to_wire(
    list: &VolumeList,
    next_page_token: String,
) -> wire::ListVolumesResponse {
    wire::ListVolumesResponse {
        volumes: list.volumes.iter().map(volume_entry_to_wire).collect(),
        next_page_token,
        pixels_version: list.pixels_version,
        protocol_version: list.protocol_version,
        current_time: super::jobs::time_to_wire(list.now_unix_ms),
    }
}

/// Reads a page of a master's volumes, and the token of the next.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn volume_list_from_wire(
    list: wire::ListVolumesResponse,
) -> Result<(VolumeList, String), WireError> {
    let volumes = list.volumes.into_iter().map(volume_entry_from_wire).collect::<Result<_, _>>()?;
    let list_of = VolumeList {
        volumes,
        pixels_version: list.pixels_version,
        protocol_version: list.protocol_version,
        now_unix_ms: super::jobs::time_from_wire("current_time", list.current_time)?,
    };
    Ok((list_of, list.next_page_token))
}

/// Writes an entry of a master's list of volumes.
fn volume_entry_to_wire(entry: &VolumeEntry) -> wire::VolumeEntry {
    let read = entry.read.as_ref();
    wire::VolumeEntry {
        name: entry.name.clone(),
        digest: read.map_or_else(Bytes::new, |(digest, ..)| Bytes::copy_from_slice(&digest.0)),
        samples: read.map(|&(_, [i, j, k], _)| wire::GridSize { i, j, k }),
        sample_kind: read.map_or(0, |&(_, _, kind)| kind_to_wire(kind)),
        bytes: entry.bytes,
        origin: origin_to_wire(entry.origin),
        in_memory: entry.in_memory,
        problem: reason_to_wire(&entry.problem),
    }
}

/// Reads an entry of a master's list of volumes.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
fn volume_entry_from_wire(entry: wire::VolumeEntry) -> Result<VolumeEntry, WireError> {
    let read = match &entry.digest[..] {
        [] => None,
        digest => {
            let wire::GridSize { i, j, k } = required("samples", entry.samples)?;
            let kind = kind_from_wire("sample_kind", entry.sample_kind)?;
            Some((digest_from_wire("digest", digest)?, [i, j, k], kind))
        }
    };
    Ok(VolumeEntry {
        name: reason_from_wire("name", entry.name)?,
        read,
        bytes: entry.bytes,
        origin: origin_from_wire("origin", entry.origin)?,
        in_memory: entry.in_memory,
        problem: reason_from_wire("problem", entry.problem)?,
    })
}

/// Writes the header of an upload.
pub fn volume_header_to_wire(header: &VolumeHeader) -> wire::VolumeHeader {
    wire::VolumeHeader {
        name: header.name.clone(),
        file_type: header.file_type.clone(),
        volume: Some(info_to_wire(&header.info)),
        up: axis_to_wire(Some(header.orientation.up)),
        front: axis_to_wire(Some(header.orientation.front)),
    }
}

/// Reads the header of an upload.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn volume_header_from_wire(header: wire::VolumeHeader) -> Result<VolumeHeader, WireError> {
    let name = name_from_wire("name", header.name)?;
    if name.contains(['/', '\\']) || name.starts_with('.') {
        let problem = "has `/`, or begins with `.`; give a name without folders";
        return Err(WireError::value("name", problem));
    }
    Ok(VolumeHeader {
        name,
        file_type: reason_from_wire("file_type", header.file_type)?,
        info: info_from_wire(required("volume", header.volume)?).map_err(|e| e.within("volume"))?,
        orientation: orientation_from_wire(header.up, header.front)?,
    })
}

/// Writes a part of an upload.
pub fn upload_to_wire(part: &UploadPart) -> wire::PutVolumeRequest {
    use wire::put_volume_request::Part;
    let part = match part {
        UploadPart::Begin(header) => Part::Begin(volume_header_to_wire(header)),
        UploadPart::Chunk { digest, offset, data } => Part::Chunk(wire::VolumeChunk {
            digest: Bytes::copy_from_slice(&digest.0),
            offset: *offset,
            data: data.clone(),
        }),
    };
    wire::PutVolumeRequest { part: Some(part) }
}

/// Reads a part of an upload.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn upload_from_wire(request: wire::PutVolumeRequest) -> Result<UploadPart, WireError> {
    use wire::put_volume_request::Part;
    match required("part", request.part)? {
        Part::Begin(header) => {
            let header = volume_header_from_wire(header).map_err(|e| e.within("begin"))?;
            Ok(UploadPart::Begin(Box::new(header)))
        }
        Part::Chunk(wire::VolumeChunk { digest, offset, data }) => {
            if data.len() > MAX_UPLOAD_CHUNK {
                return Err(WireError::too_long("chunk.data", data.len(), MAX_UPLOAD_CHUNK));
            }
            let digest: Digest32 = digest_from_wire("chunk.digest", &digest)?;
            Ok(UploadPart::Chunk { digest, offset, data })
        }
    }
}

fn orientation_from_wire(up: i32, front: i32) -> Result<Orientation, WireError> {
    let (up, front) = (axis_from_wire("up", up)?, axis_from_wire("front", front)?);
    Ok(Orientation::new(Some(required("up", up)?), Some(required("front", front)?))?)
}

/// Converts the volume of a master to the message that clients get.
pub fn volume_to_wire(volume: &VolumeDescription) -> wire::DescribeVolumeResponse {
    wire::DescribeVolumeResponse {
        name: volume.name.clone(),
        file_type: volume.file_type.clone(),
        anatomical: volume.anatomical,
        volume: Some(info_to_wire(&volume.info)),
        up: axis_to_wire(Some(volume.orientation.up)),
        front: axis_to_wire(Some(volume.orientation.front)),
        pixels_version: volume.pixels_version,
        protocol_version: volume.protocol_version,
        current_time: super::jobs::time_to_wire(volume.now_unix_ms),
    }
}

/// Converts the volume of a master from the message that clients get.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn volume_from_wire(
    volume: wire::DescribeVolumeResponse,
) -> Result<VolumeDescription, WireError> {
    // A file's name may be anything that the master's file system allows.
    for (field, text) in [("name", &volume.name), ("file_type", &volume.file_type)] {
        if text.len() > MAX_REASON {
            return Err(WireError::too_long(field, text.len(), MAX_REASON));
        }
    }
    let orientation = orientation_from_wire(volume.up, volume.front)?;
    Ok(VolumeDescription {
        name: volume.name,
        file_type: volume.file_type,
        anatomical: volume.anatomical,
        info: info_from_wire(required("volume", volume.volume)?).map_err(|e| e.within("volume"))?,
        orientation,
        pixels_version: volume.pixels_version,
        protocol_version: volume.protocol_version,
        now_unix_ms: super::jobs::time_from_wire("current_time", volume.current_time)?,
    })
}

fn info_to_wire(info: &VolumeInfo) -> wire::Volume {
    let (l, s) = (&info.lattice, &info.summary);
    let [step_i, step_j, step_k] = l.steps.map(|step| Some(vec3_to_wire(step.to_array())));
    let [i, j, k] = l.dims;
    wire::Volume {
        digest: Bytes::copy_from_slice(&info.digest.0),
        samples: Some(wire::GridSize { i, j, k }),
        step_i,
        step_j,
        step_k,
        origin: Some(vec3_to_wire(l.origin.to_array())),
        sample_kind: kind_to_wire(s.kind),
        value_scale: Some(s.map.scale),
        value_offset: Some(s.map.offset),
        min_code: Some(s.min_code),
        max_code: Some(s.max_code),
        histogram: s.histogram.clone(),
        nan_samples: s.nan,
        infinite_samples: s.infinite,
        anatomical: s.anatomical,
        core: s.core.as_ref().map(|core| wire::ValueCore {
            min_code: core.min_code,
            max_code: core.max_code,
            histogram: core.histogram.clone(),
        }),
        level: info.level,
        finest_vox: if info.level == 0 { 0.0 } else { info.finest_vox },
        palette: s.palette.as_deref().map(palette_to_wire),
    }
}

fn info_from_wire(info: wire::Volume) -> Result<VolumeInfo, WireError> {
    let vec3 = |field: &str, v: Option<wire::Vec3>| {
        vec3_from_wire(field, required(field, v)?).map(DVec3::from_array)
    };
    let wire::GridSize { i, j, k } = required("samples", info.samples)?;
    let lattice = Lattice {
        dims: [i, j, k],
        steps: [
            vec3("step_i", info.step_i)?,
            vec3("step_j", info.step_j)?,
            vec3("step_k", info.step_k)?,
        ],
        origin: vec3("origin", info.origin)?,
    };
    check_lattice(&lattice, "samples", "samples, step_i, step_j, step_k, origin")?;
    let fields = SummaryFields {
        value_scale: info.value_scale,
        value_offset: info.value_offset,
        min_code: info.min_code,
        max_code: info.max_code,
        histogram: info.histogram,
        nan_samples: info.nan_samples,
        infinite_samples: info.infinite_samples,
    };
    let kind = kind_from_wire("sample_kind", info.sample_kind)?;
    let core = info.core.map(core_from_wire).transpose().map_err(|e| e.within("core"))?;
    let summary =
        ValueSummary { anatomical: info.anatomical, core, ..summary_from_fields(kind, fields)? };
    let summary = with_palette(summary, info.palette)?;
    let finest_vox = finest_vox_from_wire(&lattice, info.level, info.finest_vox)?;
    let (digest, level) = (digest_from_wire("digest", &info.digest)?, info.level);
    Ok(VolumeInfo { digest, lattice, summary, level, finest_vox })
}

fn core_from_wire(core: wire::ValueCore) -> Result<ValueCore, WireError> {
    let wire::ValueCore { min_code, max_code, histogram } = core;
    let (min_code, max_code) = (finite("min_code", min_code)?, finite("max_code", max_code)?);
    if min_code >= max_code {
        return Err(WireError::value("max_code", "is not above min_code"));
    }
    if histogram.len() != 256 {
        return Err(WireError::length("histogram", histogram.len(), 256));
    }
    if histogram.iter().try_fold(0u64, |sum, &n| sum.checked_add(n)).is_none() {
        return Err(WireError::value("histogram", "counts more samples than a volume can have"));
    }
    Ok(ValueCore { min_code, max_code, histogram })
}
