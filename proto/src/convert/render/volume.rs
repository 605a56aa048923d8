//! Answers of DescribeVolume.

use super::shared::{kind_from_wire, kind_to_wire, vec3_from_wire, vec3_to_wire};
use super::{axis_from_wire, axis_to_wire, wire};
use crate::convert::numbers::{SummaryFields, check_lattice, finite, summary_from_fields};
use crate::convert::{MAX_REASON, WireError, digest_from_wire, required};
use crate::model::VolumeDescription;
use bytes::Bytes;
use glam::DVec3;
use slabcast_common::volume::{Lattice, ValueCore, ValueSummary, VolumeInfo};
use slabcast_scene::path::Orientation;

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
    let (up, front) = (axis_from_wire("up", volume.up)?, axis_from_wire("front", volume.front)?);
    let orientation = Orientation::new(Some(required("up", up)?), Some(required("front", front)?))?;
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
    Ok(VolumeInfo { digest: digest_from_wire("digest", &info.digest)?, lattice, summary })
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
