//! View paths: what a client asks to see.

use super::shared::{vec3_from_wire, vec3_to_wire};
use super::submit::{choice_from_wire, choice_to_wire};
use super::{axis_from_wire, axis_to_wire, enum_conversions, wire};
use crate::convert::numbers::{finite, size_from_wire};
use crate::convert::{WireError, required};
use slabcast_scene::path::{
    Crop, CropUnit, Easing, Fit, FlyThrough, Framing, Key, KeyFrames, MAX_KEYS, PathView,
    ProjectionKind, Side, Turntable, ViewPath,
};

enum_conversions!(projection_to_wire, projection_from_wire, ProjectionKind, wire::Projection,
    Some(ProjectionKind::Ortho), { Ortho <=> Ortho, Persp <=> Persp });
enum_conversions!(easing_to_wire, easing_from_wire, Easing, wire::Easing, Some(Easing::Smooth),
    { Smooth <=> Smooth, Linear <=> Linear });
enum_conversions!(side_to_wire, side_from_wire, Side, wire::Side, None,
    { Anterior <=> Anterior, Posterior <=> Posterior, Left <=> Left, Right <=> Right,
      Superior <=> Superior, Inferior <=> Inferior });
enum_conversions!(unit_to_wire, unit_from_wire, CropUnit, wire::CropUnit, Some(CropUnit::World),
    { World <=> World, Unit <=> Fraction });
enum_conversions!(fit_to_wire, fit_from_wire, Fit, wire::Fit, Some(Fit::Volume),
    { Volume <=> Volume, Visible <=> Visible });

/// Writes the framing that a path was given.
pub fn framing_to_wire(framing: &Framing) -> wire::Framing {
    wire::Framing { target: Some(vec3_to_wire(framing.target)), height: framing.height }
}

/// Converts the framing that a path was given from its message.
///
/// # Errors
/// [`WireError`] names the field that is missing or not finite.
pub fn framing_from_wire(framing: wire::Framing) -> Result<Framing, WireError> {
    Ok(Framing {
        target: vec3_from_wire("framing.target", required("framing.target", framing.target)?)?,
        height: finite("framing.height", framing.height)?,
    })
}

pub(super) fn path_to_wire(path: &ViewPath) -> wire::ViewPath {
    use wire::view_path::Cameras;
    let cameras = if let Some(t) = &path.turntable {
        Cameras::Turntable(turntable_to_wire(t))
    } else if let Some(k) = &path.keyframes {
        Cameras::Keyframes(wire::KeyFrames {
            frames: k.frames,
            easing: easing_to_wire(k.easing),
            up: axis_to_wire(k.up),
            front: axis_to_wire(k.front),
            keys: k.keys.iter().map(key_to_wire).collect(),
        })
    } else if let Some(f) = &path.flythrough {
        Cameras::Flythrough(wire::FlyThrough {
            frames: f.frames,
            eyes: f.eyes.iter().copied().map(vec3_to_wire).collect(),
            target: f.target.map(vec3_to_wire),
            up: f.up.map(vec3_to_wire),
            fov: f.fov,
            closed: f.closed,
        })
    } else {
        Cameras::Views(wire::Views { views: path.views.iter().map(view_to_wire).collect() })
    };
    wire::ViewPath {
        width: path.size[0],
        height: path.size[1],
        cameras: Some(cameras),
        crop: path.crop.map(|c| {
            let interval = |[from, to]: [Option<f64>; 2]| wire::Interval { from, to };
            wire::Crop {
                unit: unit_to_wire(c.unit),
                x: Some(interval(c.x)),
                y: Some(interval(c.y)),
                z: Some(interval(c.z)),
            }
        }),
        range: path
            .range
            .map(|[first_frame, last_frame]| wire::FrameRange { first_frame, last_frame }),
        fit: if path.fit == Fit::default() { 0 } else { fit_to_wire(path.fit) },
    }
}

pub(super) fn path_from_wire(path: wire::ViewPath) -> Result<ViewPath, WireError> {
    use wire::view_path::Cameras;
    let mut out = ViewPath {
        // Whether its numbers are finite its own check sees.
        crop: path.crop.map(crop_from_wire).transpose().map_err(|e| e.within("crop"))?,
        range: path.range.map(|r| [r.first_frame, r.last_frame]),
        fit: fit_from_wire("fit", path.fit)?,
        ..ViewPath::from_views(size_from_wire(path.width, path.height)?, Vec::new())
    };
    match required("cameras", path.cameras)? {
        Cameras::Views(v) => {
            if v.views.is_empty() {
                return Err(WireError::value("views", "no view; give at least one"));
            }
            let views = v.views.into_iter().enumerate().map(|(i, v)| {
                view_from_wire(v).map_err(|e| e.within(&format!("views.views[{i}]")))
            });
            out.views = views.collect::<Result<_, _>>()?;
        }
        Cameras::Turntable(t) => {
            out.turntable = Some(turntable_from_wire(t).map_err(|e| e.within("turntable"))?);
        }
        Cameras::Keyframes(k) => {
            out.keyframes = Some(keyframes_from_wire(k).map_err(|e| e.within("keyframes"))?);
        }
        Cameras::Flythrough(f) => {
            out.flythrough = Some(flythrough_from_wire(f).map_err(|e| e.within("flythrough"))?);
        }
    }
    out.check().map_err(|e| {
        let path = super::super::wire_field(&e.field, &out);
        WireError::value(path.strip_prefix("path.").unwrap_or(&path), e.problem)
    })?;
    Ok(out)
}

fn crop_from_wire(crop: wire::Crop) -> Result<Crop, WireError> {
    let ends = |i: Option<wire::Interval>| i.map_or([None; 2], |i| [i.from, i.to]);
    Ok(Crop {
        unit: unit_from_wire("unit", crop.unit)?,
        x: ends(crop.x),
        y: ends(crop.y),
        z: ends(crop.z),
    })
}

fn view_to_wire(v: &PathView) -> wire::PathView {
    wire::PathView {
        eye: Some(Box::new(vec3_to_wire(v.eye))),
        target: Some(Box::new(vec3_to_wire(v.target))),
        up: Some(Box::new(vec3_to_wire(v.up))),
        projection: projection_to_wire(v.projection),
        height: v.height,
        fov: v.fov,
    }
}

fn view_from_wire(view: wire::PathView) -> Result<PathView, WireError> {
    let vec3 = |field: &str, v: Option<Box<_>>| vec3_from_wire(field, *required(field, v)?);
    Ok(PathView {
        eye: vec3("eye", view.eye)?,
        target: vec3("target", view.target)?,
        up: vec3("up", view.up)?,
        projection: projection_from_wire("projection", view.projection)?,
        height: view.height.map(|x| finite("height", x)).transpose()?,
        fov: view.fov.map(|x| finite("fov", x)).transpose()?,
    })
}

fn turntable_to_wire(t: &Turntable) -> wire::Turntable {
    wire::Turntable {
        start: Some(t.start),
        step: Some(t.step),
        frames: Some(t.frames),
        elevation: Some(t.elevation),
        height: t.height,
        projection: projection_to_wire(t.projection),
        fov: Some(t.fov),
        up: axis_to_wire(t.up),
        front: axis_to_wire(t.front),
        target: t.target.map(vec3_to_wire),
    }
}

fn turntable_from_wire(t: wire::Turntable) -> Result<Turntable, WireError> {
    let d = Turntable::default();
    Ok(Turntable {
        start: finite("start", t.start.unwrap_or(d.start))?,
        step: finite("step", t.step.unwrap_or(d.step))?,
        frames: t.frames.unwrap_or(d.frames),
        elevation: finite("elevation", t.elevation.unwrap_or(d.elevation))?,
        target: t.target.map(|v| vec3_from_wire("target", v)).transpose()?,
        height: t.height.map(|x| finite("height", x)).transpose()?,
        projection: projection_from_wire("projection", t.projection)?,
        fov: finite("fov", t.fov.unwrap_or(d.fov))?,
        up: axis_from_wire("up", t.up)?,
        front: axis_from_wire("front", t.front)?,
    })
}

fn keyframes_from_wire(k: wire::KeyFrames) -> Result<KeyFrames, WireError> {
    if k.keys.len() > MAX_KEYS {
        return Err(WireError::too_long("keys", k.keys.len(), MAX_KEYS));
    }
    let keys = k
        .keys
        .into_iter()
        .enumerate()
        .map(|(i, key)| key_from_wire(key).map_err(|e| e.within(&format!("keys[{i}]"))));
    Ok(KeyFrames {
        frames: k.frames,
        up: axis_from_wire("up", k.up)?,
        front: axis_from_wire("front", k.front)?,
        easing: easing_from_wire("easing", k.easing)?,
        keys: keys.collect::<Result<_, _>>()?,
    })
}

fn key_to_wire(key: &Key) -> wire::Key {
    use wire::key::Viewpoint;
    let viewpoint = if let Some(side) = key.view {
        Some(Viewpoint::Side(side_to_wire(side)))
    } else if let Some(eye) = key.eye {
        Some(Viewpoint::Eye(vec3_to_wire(eye)))
    } else if key.azimuth.is_some() || key.elevation.is_some() {
        let (azimuth, elevation) = (key.azimuth, key.elevation);
        Some(Viewpoint::Angles(wire::Angles { azimuth, elevation }))
    } else {
        None
    };
    wire::Key {
        frame: key.at,
        viewpoint,
        target: key.target.map(|v| Box::new(vec3_to_wire(v))),
        up: key.up.map(|v| Box::new(vec3_to_wire(v))),
        projection: projection_to_wire(key.projection),
        height: key.height,
        fov: key.fov,
        transfer: key.tf.as_ref().map(|tf| Box::new(choice_to_wire(tf))),
    }
}

fn key_from_wire(key: wire::Key) -> Result<Key, WireError> {
    use wire::key::Viewpoint;
    let number = |field: &str, x: Option<f64>| x.map(|x| finite(field, x)).transpose();
    let vec3 = |field: &str, v: Option<Box<_>>| v.map(|v| vec3_from_wire(field, *v)).transpose();
    let mut out = Key {
        at: number("frame", key.frame)?,
        target: vec3("target", key.target)?,
        up: vec3("up", key.up)?,
        projection: projection_from_wire("projection", key.projection)?,
        height: number("height", key.height)?,
        fov: number("fov", key.fov)?,
        tf: key
            .transfer
            .map_or(Ok(None), |choice| choice_from_wire(*choice))
            .map_err(|e| e.within("transfer"))?,
        ..Key::default()
    };
    match key.viewpoint {
        None => {}
        Some(Viewpoint::Side(side)) => out.view = Some(side_from_wire("side", side)?),
        Some(Viewpoint::Angles(angles)) => {
            out.azimuth = number("angles.azimuth", angles.azimuth)?;
            out.elevation = number("angles.elevation", angles.elevation)?;
        }
        Some(Viewpoint::Eye(eye)) => out.eye = Some(vec3_from_wire("eye", eye)?),
    }
    Ok(out)
}

fn flythrough_from_wire(f: wire::FlyThrough) -> Result<FlyThrough, WireError> {
    let eyes = f.eyes.into_iter().enumerate();
    let eyes = eyes.map(|(i, eye)| vec3_from_wire(&format!("eyes[{i}]"), eye));
    let vec3 = |field: &str, v: Option<wire::Vec3>| v.map(|v| vec3_from_wire(field, v)).transpose();
    Ok(FlyThrough {
        frames: f.frames,
        eyes: eyes.collect::<Result<_, _>>()?,
        target: vec3("target", f.target)?,
        up: vec3("up", f.up)?,
        fov: f.fov.map(|x| finite("fov", x)).transpose()?,
        closed: f.closed,
    })
}
