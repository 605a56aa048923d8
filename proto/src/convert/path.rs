//! View paths (`render.proto`): what a client asks to see.

use super::scene::{enum_doors, finite, size_from_wire, triple_from_wire};
use super::{WireError, name_from_wire, transfer_from_wire};
use crate::v1;
use slabcast_common::path::{
    Axis, Crop, CropUnit, Easing, FlyThrough, Key, KeyFrames, MAX_KEYS, PathView, ProjectionKind,
    Side, Turntable, ViewPath,
};
use slabcast_common::transfer::TransferChoice;

enum_doors!(projection_to_wire, projection_from_wire, ProjectionKind, v1::ProjectionKind,
    Some(ProjectionKind::Ortho), { Ortho <=> Ortho, Persp <=> Persp });
enum_doors!(easing_to_wire, easing_from_wire, Easing, v1::Easing, Some(Easing::Smooth),
    { Smooth <=> Smooth, Linear <=> Linear });
enum_doors!(side_to_wire, side_from_wire, Side, v1::Side, None,
    { Anterior <=> Anterior, Posterior <=> Posterior, Left <=> Left, Right <=> Right,
      Superior <=> Superior, Inferior <=> Inferior });

pub(super) fn path_to_wire(path: &ViewPath) -> v1::ViewPath {
    let view = |v: &PathView| v1::PathView {
        eye: v.eye.to_vec(),
        target: v.target.to_vec(),
        up: v.up.to_vec(),
        projection: projection_to_wire(v.projection),
        height: v.height,
        fov: v.fov,
    };
    v1::ViewPath {
        width: path.size[0],
        height: path.size[1],
        views: path.views.iter().map(view).collect(),
        turntable: path.turntable.map(|t| v1::Turntable {
            start: Some(t.start),
            step: Some(t.step),
            frames: Some(t.frames),
            elevation: Some(t.elevation),
            height: t.height,
            projection: projection_to_wire(t.projection),
            fov: Some(t.fov),
            up: t.up.map(|a| a.to_string()),
            front: t.front.map(|a| a.to_string()),
        }),
        keyframes: path.keyframes.as_ref().map(|k| v1::KeyFrames {
            frames: k.frames,
            easing: easing_to_wire(k.easing),
            up: k.up.map(|a| a.to_string()),
            front: k.front.map(|a| a.to_string()),
            keys: k.keys.iter().map(key_to_wire).collect(),
        }),
        flythrough: path.flythrough.as_ref().map(|f| v1::FlyThrough {
            frames: f.frames,
            eyes: f.eyes.iter().flatten().copied().collect(),
            target: f.target.map_or(Vec::new(), |p| p.to_vec()),
            up: f.up.map_or(Vec::new(), |p| p.to_vec()),
            fov: f.fov,
            closed: f.closed,
        }),
        crop: path.crop.map(|c| v1::Crop {
            unit: c.unit == CropUnit::Unit,
            x_from: c.x[0],
            x_to: c.x[1],
            y_from: c.y[0],
            y_to: c.y[1],
            z_from: c.z[0],
            z_to: c.z[1],
        }),
        first_frame: path.range.map(|r| r[0]),
        last_frame: path.range.map(|r| r[1]),
    }
}

fn key_to_wire(key: &Key) -> v1::Key {
    use v1::key::Transfer;
    let point = |p: Option<[f64; 3]>| p.map_or(Vec::new(), |p| p.to_vec());
    v1::Key {
        at: key.at,
        view: key.view.map_or(v1::Side::Unspecified as i32, side_to_wire),
        azimuth: key.azimuth,
        elevation: key.elevation,
        eye: point(key.eye),
        target: point(key.target),
        up: point(key.up),
        projection: projection_to_wire(key.projection),
        height: key.height,
        fov: key.fov,
        transfer: key.tf.as_ref().map(|tf| match tf {
            TransferChoice::Name(name) => Transfer::TransferName(name.clone()),
            TransferChoice::Function(tf) => Transfer::TransferJson(tf.to_json()),
        }),
    }
}

pub(super) fn path_from_wire(path: v1::ViewPath) -> Result<ViewPath, WireError> {
    let size = size_from_wire(path.width, path.height)?;
    let views = path
        .views
        .iter()
        .enumerate()
        .map(|(i, v)| view_from_wire(v).map_err(|e| e.within(&format!("views[{i}]"))));
    let turntable = path.turntable.map(turntable_from_wire).transpose();
    let keyframes = path.keyframes.map(keyframes_from_wire).transpose();
    let flythrough = path.flythrough.map(flythrough_from_wire).transpose();
    let path = ViewPath {
        // The JSON's version; here the package has it.
        version: 1,
        size,
        views: views.collect::<Result<_, _>>()?,
        turntable: turntable.map_err(|e| e.within("turntable"))?,
        keyframes: keyframes.map_err(|e| e.within("keyframes"))?,
        flythrough: flythrough.map_err(|e| e.within("flythrough"))?,
        // Whether its numbers are finite its own check sees.
        crop: path.crop.map(|c| Crop {
            unit: if c.unit { CropUnit::Unit } else { CropUnit::World },
            x: [c.x_from, c.x_to],
            y: [c.y_from, c.y_to],
            z: [c.z_from, c.z_to],
        }),
        range: match (path.first_frame, path.last_frame) {
            (Some(first), Some(last)) => Some([first, last]),
            (None, None) => None,
            (Some(_), None) => return Err(WireError::missing("last_frame")),
            (None, Some(_)) => return Err(WireError::missing("first_frame")),
        },
    };
    path.check()?;
    Ok(path)
}

fn view_from_wire(view: &v1::PathView) -> Result<PathView, WireError> {
    Ok(PathView {
        eye: triple_from_wire("eye", &view.eye)?,
        target: triple_from_wire("target", &view.target)?,
        up: triple_from_wire("up", &view.up)?,
        projection: projection_from_wire("projection", view.projection)?,
        height: view.height.map(|x| finite("height", x)).transpose()?,
        fov: view.fov.map(|x| finite("fov", x)).transpose()?,
    })
}

pub(super) fn axis_from_wire(field: &str, axis: &str) -> Result<Axis, WireError> {
    if axis.len() > 2 {
        return Err(WireError::value(field, "is not an axis; give x, y or z with + or -"));
    }
    axis.parse().map_err(|problem: String| WireError::value(field, problem))
}

fn turntable_from_wire(t: v1::Turntable) -> Result<Turntable, WireError> {
    let d = Turntable::default();
    let axis =
        |field: &str, axis: Option<String>| axis.map(|a| axis_from_wire(field, &a)).transpose();
    Ok(Turntable {
        start: finite("start", t.start.unwrap_or(d.start))?,
        step: finite("step", t.step.unwrap_or(d.step))?,
        frames: t.frames.unwrap_or(d.frames),
        elevation: finite("elevation", t.elevation.unwrap_or(d.elevation))?,
        height: t.height.map(|x| finite("height", x)).transpose()?,
        projection: projection_from_wire("projection", t.projection)?,
        fov: finite("fov", t.fov.unwrap_or(d.fov))?,
        up: axis("up", t.up)?,
        front: axis("front", t.front)?,
    })
}

fn keyframes_from_wire(k: v1::KeyFrames) -> Result<KeyFrames, WireError> {
    if k.keys.len() > MAX_KEYS {
        return Err(WireError::too_long("keys", k.keys.len(), MAX_KEYS));
    }
    let keys = k
        .keys
        .into_iter()
        .enumerate()
        .map(|(i, key)| key_from_wire(key).map_err(|e| e.within(&format!("keys[{i}]"))));
    let axis =
        |field: &str, axis: Option<String>| axis.map(|a| axis_from_wire(field, &a)).transpose();
    Ok(KeyFrames {
        frames: k.frames,
        up: axis("up", k.up)?,
        front: axis("front", k.front)?,
        easing: easing_from_wire("easing", k.easing)?,
        keys: keys.collect::<Result<_, _>>()?,
    })
}

/// Nothing, or exactly three finite numbers.
fn point_from_wire(field: &str, numbers: &[f64]) -> Result<Option<[f64; 3]>, WireError> {
    if numbers.is_empty() { Ok(None) } else { triple_from_wire(field, numbers).map(Some) }
}

fn key_from_wire(key: v1::Key) -> Result<Key, WireError> {
    use v1::key::Transfer;
    let number = |field: &str, x: Option<f64>| x.map(|x| finite(field, x)).transpose();
    Ok(Key {
        at: number("at", key.at)?,
        view: match key.view {
            0 => None,
            side => Some(side_from_wire("view", side)?),
        },
        azimuth: number("azimuth", key.azimuth)?,
        elevation: number("elevation", key.elevation)?,
        eye: point_from_wire("eye", &key.eye)?,
        target: point_from_wire("target", &key.target)?,
        up: point_from_wire("up", &key.up)?,
        projection: projection_from_wire("projection", key.projection)?,
        height: number("height", key.height)?,
        fov: number("fov", key.fov)?,
        tf: match key.transfer {
            None => None,
            Some(Transfer::TransferName(name)) => {
                Some(TransferChoice::Name(name_from_wire("transfer_name", name)?))
            }
            Some(Transfer::TransferJson(json)) => {
                Some(TransferChoice::Function(Box::new(transfer_from_wire(&json)?)))
            }
        },
    })
}

fn flythrough_from_wire(f: v1::FlyThrough) -> Result<FlyThrough, WireError> {
    let (points, rest) = f.eyes.as_chunks::<3>();
    if !rest.is_empty() {
        return Err(WireError::value("eyes", "has a number too many; give x, y, z of each point"));
    }
    Ok(FlyThrough {
        frames: f.frames,
        eyes: points.to_vec(),
        target: point_from_wire("target", &f.target)?,
        up: point_from_wire("up", &f.up)?,
        fov: f.fov.map(|x| finite("fov", x)).transpose()?,
        closed: f.closed,
    })
}
