//! Numbers, vectors, matrices and sizes, checked; and volumes put together from them.

use super::WireError;
use glam::{DMat3, DVec3};
use slabcast_common::brick::{BRICK_EDGE, MAX_BRICKS};
use slabcast_common::level::MAX_LEVEL;
use slabcast_common::view::MAX_EDGE;
use slabcast_common::volume::{Lattice, SampleKind, ValueMap, ValueSummary};

/// Exactly three finite numbers.
pub(super) fn triple_from_wire(field: &str, numbers: &[f64]) -> Result<[f64; 3], WireError> {
    let Ok(triple) = <[f64; 3]>::try_from(numbers) else {
        return Err(WireError::length(field, numbers.len(), 3));
    };
    finite_all(field, &triple)?;
    Ok(triple)
}

/// Exactly three finite numbers.
pub(super) fn vector_from_wire(field: &str, numbers: &[f64]) -> Result<DVec3, WireError> {
    Ok(DVec3::from_array(triple_from_wire(field, numbers)?))
}

/// Exactly nine finite numbers, by columns.
pub(super) fn matrix_from_wire(field: &str, numbers: &[f64]) -> Result<DMat3, WireError> {
    let Ok(columns) = <[f64; 9]>::try_from(numbers) else {
        return Err(WireError::length(field, numbers.len(), 9));
    };
    finite_all(field, &columns)?;
    Ok(DMat3::from_cols_array(&columns))
}

pub(super) fn finite_all(field: &str, numbers: &[f64]) -> Result<(), WireError> {
    match numbers.iter().all(|x| x.is_finite()) {
        true => Ok(()),
        false => Err(WireError::value(field, "has a number that is not finite")),
    }
}

pub(super) fn finite(field: &str, x: f64) -> Result<f64, WireError> {
    finite_all(field, &[x])?;
    Ok(x)
}

pub(super) fn positive(field: &str, x: f64) -> Result<f64, WireError> {
    if x.is_finite() && x > 0.0 {
        Ok(x)
    } else {
        Err(WireError::value(field, format!("{x}; it must be finite and above zero")))
    }
}

/// Width and height of a picture, in pixels.
pub(super) fn size_from_wire(width: u32, height: u32) -> Result<[u32; 2], WireError> {
    for (field, n) in [("width", width), ("height", height)] {
        if n == 0 || n > MAX_EDGE {
            return Err(WireError::value(field, format!("{n} pixels; give 1 to {MAX_EDGE}")));
        }
    }
    Ok([width, height])
}

/// Checks a lattice whose numbers are finite; errors name `fields`.
pub(super) fn check_lattice(lattice: &Lattice, dims: &str, fields: &str) -> Result<(), WireError> {
    let bricks = lattice.dims.iter().map(|n| u128::from(n.div_ceil(BRICK_EDGE))).product::<u128>();
    if bricks > u128::from(MAX_BRICKS) {
        let problem = format!("{bricks} bricks; a volume has at most {MAX_BRICKS}");
        return Err(WireError::value(dims, problem));
    }
    // The count of samples, and with it whatever counts them, fits: 2^27 bricks of 512.
    lattice.check().map_err(|problem| WireError::value(fields, problem))
}

/// Reads the length of a vox of level 0 of a volume whose `level` has the checked `lattice`.
pub(super) fn finest_vox_from_wire(
    lattice: &Lattice,
    level: u32,
    finest_vox: f64,
) -> Result<f64, WireError> {
    if level > MAX_LEVEL {
        return Err(WireError::value(
            "level",
            format!("{level}; a volume has at most {MAX_LEVEL}"),
        ));
    }
    if level == 0 {
        return Ok(lattice.vox());
    }
    // A level is coarser than level 0, but for the rounding of what a file says.
    let coarseness = lattice.vox() / finest_vox;
    if !(0.999..=1e12).contains(&coarseness) {
        let problem = "is not the smallest spacing of a finer level of this volume";
        return Err(WireError::value("finest_vox", problem));
    }
    Ok(finest_vox)
}

/// Value range and histogram of a volume, as `Volume` has them in both packages of the wire.
pub(super) struct SummaryFields {
    pub(super) value_scale: Option<f64>,
    pub(super) value_offset: Option<f64>,
    pub(super) min_code: Option<f64>,
    pub(super) max_code: Option<f64>,
    pub(super) histogram: Vec<u64>,
    pub(super) nan_samples: u64,
    pub(super) infinite_samples: u64,
}

/// Reads the values of a volume whose samples are of `kind`.
pub(super) fn summary_from_fields(
    kind: SampleKind,
    fields: SummaryFields,
) -> Result<ValueSummary, WireError> {
    let summary = ValueSummary {
        kind,
        map: ValueMap {
            scale: finite("value_scale", fields.value_scale.unwrap_or(1.0))?,
            offset: finite("value_offset", fields.value_offset.unwrap_or(0.0))?,
        },
        min_code: finite("min_code", fields.min_code.unwrap_or(0.0))?,
        max_code: finite("max_code", fields.max_code.unwrap_or(0.0))?,
        histogram: fields.histogram,
        nan: fields.nan_samples,
        infinite: fields.infinite_samples,
        anatomical: false,
        core: None,
        palette: None,
    };
    check_summary(&summary)?;
    Ok(summary)
}

/// Checks the values of a volume.
fn check_summary(summary: &ValueSummary) -> Result<(), WireError> {
    if summary.histogram.len() != 256 {
        return Err(WireError::length("histogram", summary.histogram.len(), 256));
    }
    let counted = summary.histogram.iter().map(|&n| u128::from(n)).sum::<u128>()
        + u128::from(summary.nan)
        + u128::from(summary.infinite);
    if counted > u128::from(u64::MAX) {
        return Err(WireError::value("histogram", "counts more samples than a volume can have"));
    }
    let (lo, hi) = match summary.kind {
        SampleKind::U8 => (0.0, 255.0),
        SampleKind::U16 => (0.0, 65535.0),
        SampleKind::F32 => (f64::from(f32::MIN), f64::from(f32::MAX)),
    };
    for (field, code) in [("min_code", summary.min_code), ("max_code", summary.max_code)] {
        if !(lo..=hi).contains(&code) {
            return Err(WireError::value(field, format!("{code} is not a code of its kind")));
        }
    }
    if summary.min_code > summary.max_code {
        return Err(WireError::value("min_code", "is above max_code"));
    }
    Ok(())
}
