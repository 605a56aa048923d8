//! Lights in both orders of classification, against their formula.

use crate::support::{bricks_of, transfer};
use glam::DVec3;
use slabcast_common::ids::SceneId;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Classify, Kernel, Quality};
use slabcast_common::shade::{FILL, KEY, Light, Shading};
use slabcast_common::transfer::{OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_render::judge::reference::Reference;
use slabcast_render::oracle::serial;
use slabcast_render::{Frame, Scene};
use std::sync::Arc;

const BASE: [f64; 3] = [0.6, 0.4, 0.1];

/// The formula of [`Light`] in world axes, on a surface with this normal, turned towards the eye.
fn formula(shading: &Shading, view: &View, [normal, to_eye]: [DVec3; 2]) -> [f64; 3] {
    let (to_light, fill) = match shading.light {
        Light::Key => (view.eye_from_world.transpose() * DVec3::from_array(KEY), FILL),
        Light::Head => (to_eye, 0.0),
        Light::Direction(d) => (DVec3::from_array(d).normalize(), 0.0),
    };
    let cosine = |d: DVec3| normal.dot(d.normalize()).max(0.0);
    let diffuse = (1.0 - fill) * cosine(to_light) + fill * cosine(to_eye);
    let gloss = shading.specular * libm::pow(cosine(to_light + to_eye), shading.power);
    BASE.map(|c| c * (shading.ambient + shading.diffuse * diffuse) + gloss)
}

/// An opaque plane across a ramp has one normal, so one colour. The camera turns, and the key light
/// with it.
#[test]
fn opaque_plane_has_the_colour_of_the_formula_in_both_orders() {
    let slope = DVec3::new(4.0, -12.0, 2.0);
    let volume = Volume::from_fn_u8("ramp", [25; 3], |i, j, k| {
        let from_middle = DVec3::new(i.into(), j.into(), k.into()) - DVec3::splat(12.0);
        // Near the smallest value, above which sums of `after` count: where the kernel's weights
        // ripple, so does what lies far above it, and its normals with it.
        (50.0 + slope.dot(from_middle)).clamp(20.0, 255.0) as u8
    });
    let lights = [Light::Key, Light::Head, Light::Direction([2.0, 1.0, -0.5])];
    let eyes = [[0.2, 1.0, 0.3], [-0.8, 1.0, -0.4], [0.9, 0.7, 0.0]].map(DVec3::from_array);
    for (light, to_eye) in lights.into_iter().flat_map(|light| eyes.map(|eye| (light, eye))) {
        let colors = vec![[0.0, BASE[0], BASE[1], BASE[2]]];
        let opacities = vec![[0.0, 0.0], [44.0, 0.0], [56.0, 1.0]];
        let shading = Shading { light, ambient: 0.1, power: 9.0, ..Shading::default() };
        let tf = transfer(colors, opacities, OpacityUnit::AlphaPerVox);
        let transfer = TransferFunction { shading, ..tf };
        for (classify, kernel) in
            [(Classify::Before, Kernel::Gaussian), (Classify::After, Kernel::Bspline)]
        {
            let quality = Quality { classify, kernel, thickness: 0.5, ..Quality::default() };
            let spec = SceneSpec {
                id: SceneId(1),
                volume: volume.info(Digest32::default()),
                transfer: transfer.clone(),
                quality,
                crop: None,
                bricks: Default::default(),
            };
            let projection = CameraProjection::Ortho { height: 8.0 };
            let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection };
            let view = View::new(&volume.lattice, &camera, [16; 2], &quality).expect("a camera");
            let bricks = bricks_of(&volume);
            let limit = Reference::new(&spec, view, &bricks).pixel(8, 8);
            let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
            let drawn = serial::render(&frame, &bricks).pixels[8 * 16 + 8].map(f64::from);
            let (to_eye, summary) = (to_eye.normalize(), &spec.volume.summary);
            // Normals are rounded to a degree, or turned a little towards the eye and off by the
            // ripple.
            let (turned, within) = match classify {
                Classify::Before => (0.0, 0.012),
                Classify::After => ((summary.max_code - summary.min_code) / 1020.0, 0.02),
            };
            let normal = slope * slope.dot(to_eye).signum() + to_eye * turned;
            let want = formula(&shading, &view, [normal.normalize(), to_eye]);
            for got in [limit, drawn] {
                for c in 0..3 {
                    let off = (got[c] / got[3] - want[c]).abs();
                    assert!(off < within, "{light:?} {to_eye} {classify:?}: {got:?} for {want:?}");
                }
                assert!(got[3] > 0.99, "{got:?}");
            }
        }
    }
}
