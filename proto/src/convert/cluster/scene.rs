//! Scenes, frames and views: what a worker draws from.

use super::shared::{
    background_from_wire, background_to_wire, format_from_wire, format_to_wire, kind_from_wire,
    kind_to_wire, palette_to_wire, quality_from_wire, quality_to_wire, transfer_from_wire,
    transfer_to_wire, with_palette,
};
use super::{digest_from_wire, required, wire};
use crate::convert::WireError;
use crate::convert::numbers::{
    SummaryFields, check_lattice, finest_vox_from_wire, matrix_from_wire, positive, size_from_wire,
    summary_from_fields, triple_from_wire, vector_from_wire,
};
use bytes::Bytes;
use glam::DVec3;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::crop::CropBox;
use slabcast_common::ids::{FrameId, SceneId};
use slabcast_common::image::PixelEncoding;
use slabcast_common::kernel::Lean;
use slabcast_common::message::{SceneSpec, ToWorker};
use slabcast_common::quality::{Classify, Sums};
use slabcast_common::view::{Projection, View};
use slabcast_common::volume::{Lattice, VolumeInfo};

fn volume_to_wire(info: &VolumeInfo) -> wire::Volume {
    let (l, s) = (&info.lattice, &info.summary);
    wire::Volume {
        digest: Bytes::copy_from_slice(&info.digest.0),
        dims: l.dims.to_vec(),
        steps: l.world_from_index().to_cols_array().to_vec(),
        origin: l.origin.to_array().to_vec(),
        kind: kind_to_wire(s.kind),
        value_scale: Some(s.map.scale),
        value_offset: Some(s.map.offset),
        min_code: Some(s.min_code),
        max_code: Some(s.max_code),
        histogram: s.histogram.clone(),
        nan_samples: s.nan,
        infinite_samples: s.infinite,
        level: info.level,
        finest_vox: if info.level == 0 { 0.0 } else { info.finest_vox },
        palette: s.palette.as_deref().map(palette_to_wire),
    }
}

fn volume_from_wire(info: wire::Volume) -> Result<VolumeInfo, WireError> {
    let Ok(dims) = <[u32; 3]>::try_from(&info.dims[..]) else {
        return Err(WireError::length("dims", info.dims.len(), 3));
    };
    let steps = matrix_from_wire("steps", &info.steps)?;
    let lattice = Lattice {
        dims,
        steps: [steps.x_axis, steps.y_axis, steps.z_axis],
        origin: vector_from_wire("origin", &info.origin)?,
    };
    check_lattice(&lattice, "dims", "dims, steps, origin")?;
    let fields = SummaryFields {
        value_scale: info.value_scale,
        value_offset: info.value_offset,
        min_code: info.min_code,
        max_code: info.max_code,
        histogram: info.histogram,
        nan_samples: info.nan_samples,
        infinite_samples: info.infinite_samples,
    };
    let summary = summary_from_fields(kind_from_wire("kind", info.kind)?, fields)?;
    let summary = with_palette(summary, info.palette)?;
    let finest_vox = finest_vox_from_wire(&lattice, info.level, info.finest_vox)?;
    let (digest, level) = (digest_from_wire("digest", &info.digest)?, info.level);
    Ok(VolumeInfo { digest, lattice, summary, level, finest_vox })
}

/// Converts a scene to its message on the wire.
pub fn scene_to_wire(scene: &SceneSpec) -> wire::Scene {
    wire::Scene {
        scene: scene.id.0,
        volume: Some(volume_to_wire(&scene.volume)),
        transfer: Some(transfer_to_wire(&scene.transfer)),
        quality: Some(quality_to_wire(&scene.quality)),
        crop: scene.crop.iter().flat_map(|c| [c.lo, c.hi]).flat_map(|v| v.to_array()).collect(),
        set: Bytes::copy_from_slice(&scene.bricks.0.0),
    }
}

fn crop_from_wire(ends: &[f64]) -> Result<Option<CropBox>, WireError> {
    if ends.is_empty() {
        return Ok(None);
    }
    let Ok([x0, y0, z0, x1, y1, z1]) = <[f64; 6]>::try_from(ends) else {
        return Err(WireError::length("crop", ends.len(), 6));
    };
    let crop = CropBox { lo: DVec3::new(x0, y0, z0), hi: DVec3::new(x1, y1, z1) };
    if !crop.lo.cmplt(crop.hi).all() {
        return Err(WireError::value("crop", "has an upper end that is not above the lower one"));
    }
    Ok(Some(crop))
}

/// Converts a scene from its message on the wire.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn scene_from_wire(scene: wire::Scene) -> Result<SceneSpec, WireError> {
    let volume =
        volume_from_wire(required("volume", scene.volume)?).map_err(|e| e.within("volume"))?;
    let transfer = transfer_from_wire(required("transfer", scene.transfer)?)
        .map_err(|e| e.within("transfer"))?;
    let quality = quality_from_wire(required("quality", scene.quality)?, Classify::Before)
        .map_err(|e| e.within("quality"))?;
    if quality.sums == Sums::Auto {
        return Err(WireError::value("quality.sums", "is undecided; a scene says which sums"));
    }
    if volume.summary.palette.is_some() && quality.classify == Classify::After {
        return Err(WireError::value(
            "quality.classify",
            "is AFTER; colours are classified before",
        ));
    }
    let bricks = BrickSetKey(digest_from_wire("set", &scene.set)?);
    let crop = crop_from_wire(&scene.crop)?;
    Ok(SceneSpec { id: SceneId(scene.scene), volume, transfer, quality, crop, bricks })
}

/// Writes a frame; results are `uncompressed` or not.
pub(super) fn frame_to_wire(
    (frame, scene): (FrameId, SceneId),
    view: &View,
    encoding: Option<&PixelEncoding>,
    uncompressed: bool,
    client: u64,
) -> wire::Frame {
    let compression =
        if uncompressed { wire::Compression::None } else { wire::Compression::Unspecified };
    wire::Frame {
        frame: frame.0,
        scene: scene.0,
        view: Some(view_to_wire(view)),
        encoding: encoding.map(|encoding| wire::PixelEncoding {
            format: format_to_wire(encoding.format),
            background: Some(background_to_wire(encoding.background)),
        }),
        compression: compression as i32,
        client,
    }
}

pub(super) fn frame_from_wire(frame: wire::Frame) -> Result<ToWorker, WireError> {
    let encoding = |encoding: wire::PixelEncoding| {
        Ok::<_, WireError>(PixelEncoding {
            format: format_from_wire("format", encoding.format)?,
            background: background_from_wire(required("background", encoding.background)?)?,
        })
    };
    Ok(ToWorker::Frame {
        frame: FrameId(frame.frame),
        scene: SceneId(frame.scene),
        view: view_from_wire(required("view", frame.view)?).map_err(|e| e.within("view"))?,
        finish: frame
            .encoding
            .map(|e| encoding(e).map_err(|e| e.within("encoding")))
            .transpose()?,
        // One that this version does not know is a wish that it can't fulfil: LZ4.
        plain: frame.compression == wire::Compression::None as i32,
        client: frame.client,
    })
}

/// Converts a view to its message on the wire.
pub fn view_to_wire(view: &View) -> wire::View {
    wire::View {
        width: view.size[0],
        height: view.size[1],
        eye_from_index: view.eye_from_index.to_cols_array().to_vec(),
        eye_origin: view.eye_origin.to_array().to_vec(),
        eye_from_world: view.eye_from_world.to_cols_array().to_vec(),
        projection: Some(match view.projection {
            Projection::Ortho { scale } => wire::view::Projection::Ortho(wire::Ortho { scale }),
            Projection::Persp { focal, distance } => {
                wire::view::Projection::Persp(wire::Persp { focal, distance })
            }
        }),
        thickness: view.thickness,
        kernel_std: view.kernel_std.to_array().to_vec(),
        kernel_radius: view.kernel_radius.to_array().to_vec(),
        cell: view.cell,
        kernel_lean: view.kernel_lean.to_array().to_vec(),
    }
}

/// Checks that a view's depths fit its scene's volume. A view alone can't tell; whoever knows the
/// lattice MUST call this before the view is drawn (`View::new` has the same rule for cameras).
///
/// # Errors
/// [`WireError`] if the eye is so far away that sheet numbers would not fit 32 bits.
pub fn check_view(lattice: &Lattice, view: &View) -> Result<(), WireError> {
    let m = &view.eye_from_index;
    let reach = [m.x_axis, m.y_axis, m.z_axis]
        .iter()
        .zip(lattice.dims)
        .fold(view.eye_origin.abs(), |sum, (step, n)| sum + step.abs() * f64::from(n));
    // Boxes are grown by 1e-9 of their farthest coordinate (`View::project`); here by twice that.
    let far = reach.z + 2e-9 * (1.0 + reach.max_element()) + view.kernel_radius.z + 1.0;
    let depth = far / view.thickness * f64::from(view.depth_phases());
    // Twice what `View::new` allows, since its box is tighter; phases still fit i32.
    if depth < (1u32 << 31) as f64 - 1e6 {
        Ok(())
    } else {
        Err(WireError::value("frame.view.eye_origin", "is too far from the volume for its sheets"))
    }
}

/// Converts a view from its message on the wire.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn view_from_wire(view: wire::View) -> Result<View, WireError> {
    let projection = match required("projection", view.projection)? {
        wire::view::Projection::Ortho(o) => {
            Projection::Ortho { scale: positive("ortho.scale", o.scale)? }
        }
        wire::view::Projection::Persp(p) => Projection::Persp {
            focal: positive("persp.focal", p.focal)?,
            distance: positive("persp.distance", p.distance)?,
        },
    };
    let positive_vector = |field: &str, numbers: &[f64]| {
        let v = vector_from_wire(field, numbers)?;
        v.to_array().into_iter().try_for_each(|x| positive(field, x).map(drop))?;
        Ok::<_, WireError>(v)
    };
    Ok(View {
        size: size_from_wire(view.width, view.height)?,
        eye_from_index: matrix_from_wire("eye_from_index", &view.eye_from_index)?,
        eye_origin: vector_from_wire("eye_origin", &view.eye_origin)?,
        eye_from_world: matrix_from_wire("eye_from_world", &view.eye_from_world)?,
        projection,
        thickness: positive("thickness", view.thickness)?,
        kernel_std: positive_vector("kernel_std", &view.kernel_std)?,
        kernel_radius: positive_vector("kernel_radius", &view.kernel_radius)?,
        kernel_lean: Lean::from_array(triple_from_wire("kernel_lean", &view.kernel_lean)?),
        cell: positive("cell", view.cell)?,
    })
}
