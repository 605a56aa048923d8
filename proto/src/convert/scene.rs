//! Scenes and views: what a worker draws from.

use super::{WireError, digest_from_wire, required, transfer_from_wire};
use crate::v1;
use bytes::Bytes;
use glam::{DMat3, DVec3};
use slabcast_common::brick::{BRICK, BrickSetKey, MAX_BRICKS};
use slabcast_common::ids::SceneId;
use slabcast_common::kernel::Lean;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Compositing, Kernel, Quality, Splat, Sums};
use slabcast_common::view::{MAX_EDGE, Projection, View};
use slabcast_common::volume::{Lattice, SampleKind, ValueMap, ValueSummary, VolumeInfo};

/// Makes the two doors of an enum. What is left out (number 0) is `$default`.
macro_rules! enum_doors {
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
pub(super) use enum_doors;

enum_doors!(kernel_to_wire, kernel_from_wire, Kernel, v1::Kernel, Some(Kernel::Gaussian),
    { Gaussian <=> Gaussian, Bspline <=> Bspline, Tent <=> Tent });
enum_doors!(compositing_to_wire, compositing_from_wire, Compositing, v1::Compositing,
    Some(Compositing::Linear),
    { Linear <=> Linear, Constant <=> Constant, Paper <=> Paper });
enum_doors!(splat_to_wire, splat_from_wire, Splat, v1::Splat, Some(Splat::Direct),
    { Direct <=> Direct, Deposit <=> Deposit });
enum_doors!(sums_to_wire, sums_from_wire, Sums, v1::Sums, Some(Sums::Auto),
    { Auto <=> Auto, I16 <=> I16, I32 <=> I32, F32 <=> F32 });
enum_doors!(kind_to_wire, kind_from_wire, SampleKind, v1::SampleKind, None,
    { U8 <=> U8, U16 <=> U16, F32 <=> F32 });

/// Exactly three finite numbers.
pub(super) fn triple_from_wire(field: &str, numbers: &[f64]) -> Result<[f64; 3], WireError> {
    let Ok(triple) = <[f64; 3]>::try_from(numbers) else {
        return Err(WireError::length(field, numbers.len(), 3));
    };
    finite_all(field, &triple)?;
    Ok(triple)
}

fn vector_from_wire(field: &str, numbers: &[f64]) -> Result<DVec3, WireError> {
    Ok(DVec3::from_array(triple_from_wire(field, numbers)?))
}

fn matrix_from_wire(field: &str, numbers: &[f64]) -> Result<DMat3, WireError> {
    let Ok(columns) = <[f64; 9]>::try_from(numbers) else {
        return Err(WireError::length(field, numbers.len(), 9));
    };
    finite_all(field, &columns)?;
    Ok(DMat3::from_cols_array(&columns))
}

fn finite_all(field: &str, numbers: &[f64]) -> Result<(), WireError> {
    match numbers.iter().all(|x| x.is_finite()) {
        true => Ok(()),
        false => Err(WireError::value(field, "has a number that is not finite")),
    }
}

pub(super) fn finite(field: &str, x: f64) -> Result<f64, WireError> {
    finite_all(field, &[x])?;
    Ok(x)
}

fn positive(field: &str, x: f64) -> Result<f64, WireError> {
    if x.is_finite() && x > 0.0 {
        Ok(x)
    } else {
        Err(WireError::value(field, format!("{x}; it must be finite and above zero")))
    }
}

pub(super) fn size_from_wire(width: u32, height: u32) -> Result<[u32; 2], WireError> {
    for (field, n) in [("width", width), ("height", height)] {
        if n == 0 || n > MAX_EDGE {
            return Err(WireError::value(field, format!("{n} pixels; give 1 to {MAX_EDGE}")));
        }
    }
    Ok([width, height])
}

/// A quality; every field is written.
pub(super) fn quality_to_wire(q: &Quality) -> v1::Quality {
    v1::Quality {
        thickness: Some(q.thickness),
        eps: Some(q.eps),
        kernel: kernel_to_wire(q.kernel),
        std: Some(q.std),
        radius: Some(q.radius),
        compositing: compositing_to_wire(q.compositing),
        splat: splat_to_wire(q.splat),
        sums: sums_to_wire(q.sums),
        cull: Some(q.cull),
        three_colours: !q.grey,
    }
}

/// A quality; what is left out has its default.
pub(super) fn quality_from_wire(q: v1::Quality) -> Result<Quality, WireError> {
    let d = Quality::default();
    let quality = Quality {
        thickness: q.thickness.unwrap_or(d.thickness),
        eps: q.eps.unwrap_or(d.eps),
        kernel: kernel_from_wire("kernel", q.kernel)?,
        std: q.std.unwrap_or(d.std),
        radius: q.radius.unwrap_or(d.radius),
        compositing: compositing_from_wire("compositing", q.compositing)?,
        splat: splat_from_wire("splat", q.splat)?,
        sums: sums_from_wire("sums", q.sums)?,
        cull: q.cull.unwrap_or(d.cull),
        grey: !q.three_colours,
    };
    quality.check()?;
    Ok(quality)
}

pub(super) fn info_to_wire(info: &VolumeInfo) -> v1::VolumeInfo {
    let (l, s) = (&info.lattice, &info.summary);
    v1::VolumeInfo {
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
        nan: s.nan,
        infinite: s.infinite,
    }
}

pub(super) fn info_from_wire(info: v1::VolumeInfo) -> Result<VolumeInfo, WireError> {
    let Ok(dims) = <[u32; 3]>::try_from(&info.dims[..]) else {
        return Err(WireError::length("dims", info.dims.len(), 3));
    };
    let bricks = dims.iter().map(|n| u128::from(n.div_ceil(BRICK))).product::<u128>();
    if bricks > u128::from(MAX_BRICKS) {
        return Err(WireError::value(
            "dims",
            format!("{bricks} bricks; a volume has at most {MAX_BRICKS}"),
        ));
    }
    let steps = matrix_from_wire("steps", &info.steps)?;
    let lattice = Lattice {
        dims,
        steps: [steps.x_axis, steps.y_axis, steps.z_axis],
        origin: vector_from_wire("origin", &info.origin)?,
    };
    // The count of samples, and with it whatever counts them, fits: 2^27 bricks of 512.
    lattice.check().map_err(|problem| WireError::value("dims, steps, origin", problem))?;
    let summary = ValueSummary {
        kind: kind_from_wire("kind", info.kind)?,
        map: ValueMap {
            scale: finite("value_scale", info.value_scale.unwrap_or(1.0))?,
            offset: finite("value_offset", info.value_offset.unwrap_or(0.0))?,
        },
        min_code: finite("min_code", info.min_code.unwrap_or(0.0))?,
        max_code: finite("max_code", info.max_code.unwrap_or(0.0))?,
        histogram: info.histogram,
        nan: info.nan,
        infinite: info.infinite,
    };
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
    Ok(VolumeInfo { digest: digest_from_wire("digest", &info.digest)?, lattice, summary })
}

/// A scene.
pub fn scene_to_wire(scene: &SceneSpec) -> v1::Scene {
    v1::Scene {
        scene: scene.id.0,
        volume: Some(info_to_wire(&scene.volume)),
        transfer_json: scene.transfer.to_json(),
        quality: Some(quality_to_wire(&scene.quality)),
        set: Bytes::copy_from_slice(&scene.bricks.0.0),
    }
}

/// A scene, or the field that is wrong.
pub fn scene_from_wire(scene: v1::Scene) -> Result<SceneSpec, WireError> {
    let volume =
        info_from_wire(required("volume", scene.volume)?).map_err(|e| e.within("volume"))?;
    let transfer = transfer_from_wire(&scene.transfer_json)?;
    let quality =
        quality_from_wire(required("quality", scene.quality)?).map_err(|e| e.within("quality"))?;
    if quality.sums == Sums::Auto {
        return Err(WireError::value("quality.sums", "is undecided; a scene says which sums"));
    }
    let bricks = BrickSetKey(digest_from_wire("set", &scene.set)?);
    Ok(SceneSpec { id: SceneId(scene.scene), volume, transfer, quality, bricks })
}

/// A view.
pub fn view_to_wire(view: &View) -> v1::View {
    v1::View {
        width: view.size[0],
        height: view.size[1],
        eye_from_index: view.eye_from_index.to_cols_array().to_vec(),
        eye_origin: view.eye_origin.to_array().to_vec(),
        eye_from_world: view.eye_from_world.to_cols_array().to_vec(),
        projection: Some(match view.projection {
            Projection::Ortho { scale } => v1::view::Projection::Ortho(v1::Ortho { scale }),
            Projection::Persp { focal, distance } => {
                v1::view::Projection::Persp(v1::Persp { focal, distance })
            }
        }),
        thickness: view.thickness,
        kernel_std: view.kernel_std.to_array().to_vec(),
        kernel_radius: view.kernel_radius.to_array().to_vec(),
        cell: view.cell,
        kernel_lean: view.kernel_lean.to_array().to_vec(),
    }
}

/// Whether a view's depths fit its scene's volume. A view alone can't tell; who knows the lattice
/// MUST ask before the view is drawn (`View::new` has the same rule for cameras).
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

/// A view, or the field that is wrong.
pub fn view_from_wire(view: v1::View) -> Result<View, WireError> {
    let projection = match required("projection", view.projection)? {
        v1::view::Projection::Ortho(o) => {
            Projection::Ortho { scale: positive("ortho.scale", o.scale)? }
        }
        v1::view::Projection::Persp(p) => Projection::Persp {
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
