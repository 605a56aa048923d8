//! Fields whose pictures are known on paper.
//!
//! A cubic B-spline reconstructs constants and, along the lattice's axes, linear functions exactly.
//! So a solid block's opacity is that of the chord that a ray cuts from it, and a ramp is what it
//! is inside a cropping box that keeps away from the volume's faces. A turned kernel moves a ramp
//! by up to [`TURNED_RAMP`]. Plates seen edge on are sums of B-splines. Rays and chords are
//! computed here, from the camera's eye, target and height, and share no code with the renderer's
//! cameras.

use crate::check::case::{Case, Row};
use crate::check::shot::{Shot, Tools, sane};
use glam::DVec3;
use slabcast_common::quality::Quality;
use slabcast_common::shade::{Light, Shading};
use slabcast_common::transfer::{ColorSpace, Domain, NanColour, OpacityUnit, TransferFunction};
use slabcast_common::volume::Volume;
use slabcast_scene::path::{Crop, CropUnit, PathView, ProjectionKind};
use slabcast_session::direct::Cut;
use slabcast_session::fail::Fail;
use std::sync::Arc;

/// Largest error of an opacity that depends on a chord alone, in 1/255. Ends of chords have some
/// four roundings of f32 at 40 vox, 1e-5 vox; of a chord of [`GRAZING`] that is 1e-3, of which
/// opacity takes at most 0.37.
const CHORDS: f64 = 0.1;

/// Shortest chord that is judged, in vox: the error of a shorter one is not small beside it.
const GRAZING: f64 = 0.01;

/// Largest error where the value decides: positions are rounded to 1/512 pixel, and a sub-step
/// takes the value as linear. Slopes here are at most 0.25 of the extinction a vox and 4 pixels a
/// vox, so 1/2048 vox changes a pixel by 0.03; sub-steps may cost 0.05. In 1/255.
const VALUES: f64 = 0.1;

/// Bound on the distance by which a turned B-spline moves a ramp, in vox: its first moment has
/// waves with the period of the lattice. 0.054 was the largest seen; the limit of thin sheets has
/// these waves, too.
const TURNED_RAMP: f64 = 0.06;

/// Bound on the light that a lit ramp loses or gains by the waves of [`TURNED_RAMP`], in 1/255:
/// their slope turns the normal by 0.7 degrees.
const TURNED_LIGHT: f64 = 2.0;

/// Steps of the closed forms' own integrals.
const STEPS: u32 = 4000;

/// Returns the cases.
pub(super) fn cases() -> Vec<Case> {
    let mut all: Vec<Case> = [-9, -6, -3, 0, 3, 6, 9].map(block).into();
    all.push(ramp("ramp of extinction and colour", &[[4.0, 0.0], [20.0, 0.3]], false));
    all.push(ramp("step on a ramp", &[[12.0, 0.0], [12.0, 0.4]], false));
    all.push(ramp("ramp, lit", &[[4.0, 0.0], [20.0, 0.3]], true));
    all.extend([1, 2, 3].map(plates));
    all
}

/// Views from which closed forms are drawn: direction to the eye, and projection.
const VIEWS: [(&str, [f64; 3], ProjectionKind); 4] = [
    ("along an axis", [0.0, 1.0, 0.0], ProjectionKind::Ortho),
    ("oblique", [0.75, 1.5, 0.625], ProjectionKind::Ortho),
    ("from the other side", [-0.3, -1.0, -0.4], ProjectionKind::Ortho),
    ("perspective", [0.75, 1.5, 0.625], ProjectionKind::Persp),
];

const SIZE: [u32; 2] = [96, 80];

/// Distance of the eye from the volume's centre, in voxels.
const FAR: f64 = 80.0;

fn shot(
    volume: Volume,
    transfer: TransferFunction,
    view: &(&str, [f64; 3], ProjectionKind),
) -> Shot {
    let centre = volume.lattice.centre();
    let eye = centre + DVec3::from_array(view.1).normalize() * FAR;
    let persp = view.2 == ProjectionKind::Persp;
    Shot {
        volume: Arc::new(volume),
        transfer,
        quality: Quality { eps: 0.0, ..Quality::default() },
        size: SIZE,
        view: PathView {
            eye: eye.to_array(),
            target: centre.to_array(),
            up: [0.0, 0.0, 1.0],
            projection: view.2,
            height: (!persp).then_some(20.0),
            fov: persp.then_some(18.0),
        },
        crop: None,
    }
}

/// The ray of a pixel: a point on it and its unit direction, in world units.
fn ray(shot: &Shot, x: u32, y: u32) -> [DVec3; 2] {
    let view = &shot.view;
    let (eye, target) = (DVec3::from_array(view.eye), DVec3::from_array(view.target));
    let forward = (target - eye).normalize();
    let right = forward.cross(DVec3::from_array(view.up)).normalize();
    let up = right.cross(forward);
    let [w, h] = shot.size.map(f64::from);
    let across = [(f64::from(x) + 0.5 - w / 2.0) / h, (h / 2.0 - f64::from(y) - 0.5) / h];
    match (view.height, view.fov) {
        (Some(height), _) => [eye + (right * across[0] + up * across[1]) * height, forward],
        (None, fov) => {
            let height = 2.0 * libm::tan(fov.unwrap_or(30.0).to_radians() / 2.0);
            let direction = forward + (right * across[0] + up * across[1]) * height;
            [eye, direction.normalize()]
        }
    }
}

/// The part of a ray inside a box, as distances from the ray's point; empty if it misses.
fn chord([from, along]: [DVec3; 2], lo: DVec3, hi: DVec3) -> [f64; 2] {
    let mut ends = [f64::NEG_INFINITY, f64::INFINITY];
    for a in 0..3 {
        if along[a] == 0.0 {
            if from[a] < lo[a] || from[a] > hi[a] {
                return [0.0, 0.0];
            }
            continue;
        }
        let (p, q) = ((lo[a] - from[a]) / along[a], (hi[a] - from[a]) / along[a]);
        ends = [ends[0].max(p.min(q)), ends[1].min(p.max(q))];
    }
    if ends[0] < ends[1] { ends } else { [0.0, 0.0] }
}

fn look(colors: Vec<[f64; 4]>, opacities: &[[f64; 2]]) -> TransferFunction {
    TransferFunction {
        version: 1,
        domain: Domain::Value,
        colors,
        opacities: opacities.to_vec(),
        color_space: ColorSpace::Linear,
        opacity_unit: OpacityUnit::Extinction,
        nan: NanColour::default(),
        gradient_opacity: vec![],
        shading: Shading { on: false, ..Shading::default() },
    }
}

/// Draws `shot` and returns two rows, of opacity and of colour, against `want`, which has the
/// linear premultiplied pixel of a ray, or nothing where it is not judged.
fn compare(
    shot: &Shot,
    tools: &Tools,
    name: &str,
    bound: f64,
    want: impl Fn([DVec3; 2]) -> Option<[f64; 4]>,
) -> Result<Vec<Row>, Fail> {
    let ready = shot.ready()?;
    let picture = ready.picture(Cut::on(tools.threads));
    let (mut alpha, mut colour, mut covered) = (0.0f64, 0.0f64, 0);
    let [w, h] = shot.size;
    for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
        let Some(want) = want(ray(shot, x, y)) else { continue };
        let got = picture.pixels[(y * w + x) as usize];
        covered += u32::from(want[3] > 0.0);
        let off: [f64; 4] = std::array::from_fn(|c| (f64::from(got[c]) - want[c]).abs() * 255.0);
        // `max` would forget what is not a number.
        let keep = |most: f64, off: f64| if off > most || off.is_nan() { off } else { most };
        alpha = keep(alpha, off[3]);
        colour = off[..3].iter().fold(colour, |most, &off| keep(most, off));
    }
    if covered < w * h / 20 {
        return Err(Fail::failed(format!("{name}: there is hardly anything to be seen")));
    }
    Ok(vec![
        Row::new(format!("opacity, {name}"), alpha, bound).with(sane(&picture)),
        Row::new(format!("colour, {name}"), colour, bound),
    ])
}

/// A solid block of ten to the `power` per vox: the chord of every ray.
fn block(power: i32) -> Case {
    Case::new(format!("field: block of extinction 1e{power}"), move |tools| {
        let sigma = libm::pow(10.0, f64::from(power));
        let rgb = [0.25, 0.5, 1.0];
        let mut rows = Vec::new();
        for view in &VIEWS {
            let dims = [12, 9, 11];
            let solid = Volume::from_fn_u8("block", dims, |_, _, _| 200);
            let shot =
                shot(solid, look(vec![[0.0, rgb[0], rgb[1], rgb[2]]], &[[0.0, sigma]]), view);
            let hi = DVec3::from_array(dims.map(|n| f64::from(n) - 0.5));
            rows.extend(compare(&shot, tools, view.0, CHORDS, |ray| {
                let [near, far] = chord(ray, DVec3::splat(-0.5), hi);
                let alpha = -libm::expm1(-sigma * (far - near));
                let judged = far == near || far - near > GRAZING;
                judged.then_some([rgb[0] * alpha, rgb[1] * alpha, rgb[2] * alpha, alpha])
            })?);
        }
        Ok(rows)
    })
}

/// The value is x, cropped to where no face of the volume is near. Blue turns to red with x.
fn ramp(name: &'static str, opacities: &'static [[f64; 2]], lit: bool) -> Case {
    Case::new(format!("field: {name}"), move |tools| {
        let (lo, hi) = (DVec3::new(4.0, 4.0, 4.0), DVec3::new(20.0, 12.0, 11.0));
        let mut rows = Vec::new();
        for view in &VIEWS {
            let ramp = slabcast_session::volume::open("formula:ramp:25x17x16".as_ref())?;
            let colors = vec![[4.0, 0.0, 0.2, 1.0], [20.0, 1.0, 0.2, 0.0]];
            let mut transfer = look(colors, opacities);
            let light = DVec3::new(0.6, 0.7, 0.3);
            if lit {
                let light = Light::Direction(light.to_array());
                transfer.shading = Shading {
                    on: true,
                    light,
                    ambient: 0.1,
                    diffuse: 0.7,
                    specular: 0.0,
                    ..transfer.shading
                };
            }
            let ends = |a: usize| [Some(lo[a]), Some(hi[a])];
            let crop = Crop { unit: CropUnit::World, x: ends(0), y: ends(1), z: ends(2) };
            let shot = Shot { crop: Some(crop), ..shot(ramp, transfer, view) };
            let straight = view.1.iter().filter(|&&x| x != 0.0).count() == 1;
            if lit && straight {
                // The gradient lies across the ray: which side faces the eye is a matter of
                // rounding.
                continue;
            }
            let steepest = slope(opacities);
            let bound = match (straight, lit) {
                (true, _) => VALUES,
                (false, true) => TURNED_LIGHT,
                (false, false) => VALUES + 255.0 * TURNED_RAMP * steepest,
            };
            rows.extend(compare(&shot, tools, view.0, bound, |ray| {
                let ends = chord(ray, lo, hi);
                let share = if lit { lambert(-ray[1], light.normalize()) } else { 1.0 };
                Some(along(ends, |s| {
                    let x = ray[0].x + s * ray[1].x;
                    let t = ((x - 4.0) / 16.0).clamp(0.0, 1.0);
                    (extinction(opacities, x), [t, 0.2, 1.0 - t].map(|c| share * c))
                }))
            })?);
        }
        Ok(rows)
    })
}

/// Returns a bound on the change of a pixel, as a share of full light, if the ramp moves by one
/// vox: by the extinction of a jump, or by the colour, which goes from end to end in 16 vox.
fn slope(points: &[[f64; 2]]) -> f64 {
    let jump = points[0][0] == points[1][0];
    f64::max(if jump { points[1][1] } else { 0.0 }, 1.0 / 16.0)
}

/// The light on a gradient of (1, 0, 0) code a vox, of 24 codes in all, turned towards the eye and
/// by a share of 1/1020 of the codes towards it.
fn lambert(to_eye: DVec3, to_light: DVec3) -> f64 {
    let side = if to_eye.x < 0.0 { -1.0 } else { 1.0 };
    let normal = (DVec3::X * side + to_eye * (24.0 / 1020.0)).normalize();
    0.1 + 0.7 * normal.dot(to_light).max(0.0)
}

/// The extinction at `x` of a transfer function with two points; the second counts at a jump.
fn extinction(points: &[[f64; 2]], x: f64) -> f64 {
    let [[x0, y0], [x1, y1]] = [points[0], points[1]];
    if x >= x1 {
        y1
    } else if x <= x0 {
        y0
    } else {
        y0 + (y1 - y0) * (x - x0) / (x1 - x0)
    }
}

/// Integrates extinction and colour from one distance to the next by midpoints: linear
/// premultiplied RGBA.
fn along(ends: [f64; 2], at: impl Fn(f64) -> (f64, [f64; 3])) -> [f64; 4] {
    let step = (ends[1] - ends[0]) / f64::from(STEPS);
    let (mut rgb, mut depth) = ([0.0; 3], 0.0);
    if step == 0.0 {
        return [0.0; 4];
    }
    for i in 0..STEPS {
        let (sigma, colour) = at(ends[0] + (f64::from(i) + 0.5) * step);
        let seen = libm::exp(-depth) * -libm::expm1(-sigma * step);
        for c in 0..3 {
            rgb[c] += seen * colour[c];
        }
        depth += sigma * step;
    }
    [rgb[0], rgb[1], rgb[2], -libm::expm1(-depth)]
}

/// Plates of 200 seen edge on, `gap` samples of 0 apart: between them a sum of B-splines.
fn plates(gap: u32) -> Case {
    Case::new(format!("field: plates edge on, {gap} vox apart"), move |tools| {
        let value = move |i: u32| if (8..8 + gap).contains(&i) { 0u8 } else { 200 };
        let volume = Volume::from_fn_u8("plates", [24, 17, 16], |i, _, _| value(i));
        let opacities = [[60.0, 0.0], [180.0, 1.0]];
        let transfer = look(vec![[0.0, 0.25, 0.5, 1.0]], &opacities);
        let (lo, hi) = (DVec3::new(4.0, 4.0, 4.0), DVec3::new(20.0, 12.0, 11.0));
        let ends = |a: usize| [Some(lo[a]), Some(hi[a])];
        let crop = Crop { unit: CropUnit::World, x: ends(0), y: ends(1), z: ends(2) };
        let shot = Shot { crop: Some(crop), ..shot(volume, transfer, &VIEWS[0]) };
        compare(&shot, tools, "edge on", VALUES, |ray| {
            let [near, far] = chord(ray, lo, hi);
            let x = ray[0].x;
            let f: f64 = (0..24).map(|i| f64::from(value(i)) * bspline(x - f64::from(i))).sum();
            let alpha = -libm::expm1(-extinction(&opacities, f) * (far - near));
            Some([0.25 * alpha, 0.5 * alpha, alpha, alpha])
        })
    })
}

/// The cubic B-spline of integral one.
fn bspline(x: f64) -> f64 {
    match x.abs() {
        x if x < 1.0 => 2.0 / 3.0 - x * x * (1.0 - x / 2.0),
        x if x < 2.0 => (2.0 - x).powi(3) / 6.0,
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_what_they_are_on_paper() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let tools = Tools { threads: 2, runtime };
        let some = ["extinction 1e0", "step on a ramp", "1 vox apart"];
        let mut judged = 0;
        for case in cases().iter().filter(|c| some.iter().any(|s| c.name.contains(s))) {
            for row in (case.work)(&tools).unwrap() {
                assert!(row.held(), "{}: {row:?}", case.name);
                judged += 1;
            }
        }
        assert_eq!(judged, 18);
    }
}
