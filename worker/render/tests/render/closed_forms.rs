//! Pictures of volumes whose answers can be worked out on paper.
//!
//! The kernel turns a block of equal voxels into the field
//! `sigma Sx(x) Sy(y) Sz(z)`, with `S(u)` the sum of the profile over the block's lattice
//! points. Along an orthographic ray down an axis, Sx and Sy stay and Sz integrates: to the
//! number of layers for a whole crossing, to sums of error functions for a part of it. So
//! optical depths are known in closed form, edges included. Scales are chosen so that voxel
//! centres fall on the 1/256 pixel grid: no rounding of positions hides an error here.

use crate::support::{bricks_of, g, sum, transfer};
use glam::DVec3;
use slabcast_common::ids::SceneId;
use slabcast_common::image::Picture;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Compositing, Quality, Sums};
use slabcast_common::transfer::{OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_render::oracle::serial;
use slabcast_render::{Frame, Scene};
use std::sync::Arc;

fn alphas(colors: Vec<[f64; 4]>, opacities: Vec<[f64; 2]>) -> TransferFunction {
    transfer(colors, opacities, OpacityUnit::AlphaPerVox)
}

/// Renders from +y (x to the left, z up) with 4 pixels a voxel.
fn picture(
    volume: &Volume,
    tf: TransferFunction,
    quality: Quality,
    projection: Option<CameraProjection>,
) -> Picture {
    let quality = Quality { sums: Sums::I32, eps: 0.0, ..quality };
    let spec = SceneSpec {
        id: SceneId(1),
        volume: volume.info(Digest32::default()),
        transfer: tf,
        quality,
        crop: None,
        bricks: Default::default(),
    };
    let n = 4 * (volume.lattice.dims[0].max(volume.lattice.dims[2]) + 8);
    let camera = Camera {
        to_eye: DVec3::Y,
        up: DVec3::Z,
        target: DVec3::ZERO,
        projection: projection.unwrap_or(CameraProjection::Ortho { height: f64::from(n) / 4.0 }),
    };
    let view = View::new(&volume.lattice, &camera, [n, n], &quality).unwrap();
    let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
    serial::render(&frame, &bricks_of(volume))
}

/// Index coordinates (i, k) that the centre of pixel (x, y) looks at.
fn looks_at(volume: &Volume, size: u32, x: u32, y: u32) -> (f64, f64) {
    let c = volume.lattice.dims.map(|n| (f64::from(n) - 1.0) / 2.0);
    let at = |p: u32| (f64::from(p) + 0.5 - f64::from(size) / 2.0) / 4.0;
    (c[0] - at(x), c[2] - at(y))
}

#[test]
fn homogeneous_block_has_the_opacity_of_its_optical_depth() {
    let n = 12u32;
    let volume = Volume::from_fn_u8("block", [n, 7, n], |_, _, _| 100);
    for alpha in [1e-6, 0.02, 0.3, 0.999] {
        let tf = alphas(vec![[0.0, 0.25, 0.5, 1.0]], vec![[0.0, alpha]]);
        for thickness in [0.25, 1.0, 2.7] {
            let q = Quality { thickness, ..Quality::before() };
            let p = picture(&volume, tf.clone(), q, None);
            let sigma = -libm::log1p(-alpha);
            for y in 0..p.size[1] {
                for x in 0..p.size[0] {
                    let (i, k) = looks_at(&volume, p.size[0], x, y);
                    let tau = sigma * 7.0 * sum(i, 0..n as i32) * sum(k, 0..n as i32);
                    let want = -libm::expm1(-tau);
                    let got = p.pixels[(y * p.size[0] + x) as usize];
                    let off = (f64::from(got[3]) - want).abs();
                    assert!(
                        off <= 1e-5 * want + 3e-6,
                        "alpha {alpha}, d {thickness}, pixel {x},{y}: {} against {want}",
                        got[3]
                    );
                    for (c, colour) in [0.25, 0.5, 1.0].into_iter().enumerate() {
                        assert!((f64::from(got[c]) - colour * want).abs() < 1e-5);
                    }
                }
            }
        }
    }
}

/// Two walls with a gap wider than the kernel: I = c1 a1 + (1 - a1) c2 a2.
#[test]
fn front_wall_attenuates_back_wall_by_its_opacity() {
    let n = 10u32;
    // The eye is at +y: the wall at high j is in front.
    let volume = Volume::from_fn_u8("walls", [n, 16, n], |_, j, _| match j {
        0..4 => 50,
        11..14 => 200,
        _ => 0,
    });
    for (front, back) in [(0.2, 0.4), (0.9, 0.5), (1.0, 1.0)] {
        let tf = alphas(
            vec![[50.0, 0.0, 0.0, 1.0], [200.0, 1.0, 0.0, 0.0]],
            vec![[0.0, 0.0], [49.0, 0.0], [50.0, back], [199.0, back], [200.0, front]],
        );
        let sigma = |a: f64| (-libm::log1p(-a)).min(16.0 * std::f64::consts::LN_2);
        for compositing in [Compositing::Linear, Compositing::Constant] {
            let q = Quality { compositing, ..Quality::before() };
            let p = picture(&volume, tf.clone(), q, None);
            for y in 0..p.size[1] {
                for x in 0..p.size[0] {
                    let (i, k) = looks_at(&volume, p.size[0], x, y);
                    let lateral = sum(i, 0..n as i32) * sum(k, 0..n as i32);
                    let a1 = -libm::expm1(-sigma(front) * 3.0 * lateral);
                    let a2 = -libm::expm1(-sigma(back) * 4.0 * lateral);
                    let got = p.pixels[(y * p.size[0] + x) as usize].map(f64::from);
                    let want = [a1, 0.0, (1.0 - a1) * a2, 1.0 - (1.0 - a1) * (1.0 - a2)];
                    for c in 0..4 {
                        assert!(
                            (got[c] - want[c]).abs() < 2e-5,
                            "{compositing:?} {front}/{back}, pixel {x},{y}: {got:?}, want {want:?}"
                        );
                    }
                }
            }
        }
    }
}

/// A medium whose colour changes from layer to layer: the field's colour along the ray is
/// sum(c_j g(y - j)) / sum(g(y - j)), and the integral is done here in 4000 steps of f64.
#[test]
fn colour_ramp_is_the_emission_absorption_integral() {
    let (n, depth) = (9u32, 20u32);
    let volume = Volume::from_fn_u8("ramp", [n, depth, n], |_, j, _| 10 + 10 * j as u8);
    let alpha = 0.25f64;
    let tf = alphas(vec![[10.0, 0.0, 0.2, 1.0], [200.0, 1.0, 0.8, 0.0]], vec![[0.0, alpha]]);
    let colour = |j: i32| f64::from(j) * 10.0 / 190.0;
    let sigma = -libm::log1p(-alpha);
    let lateral = sum(4.125, 0..n as i32) * sum(4.125, 0..n as i32);
    let (mut light, mut transmittance) = (0.0, 1.0f64);
    let steps = 4000;
    let h = (f64::from(depth) + 4.0) / f64::from(steps);
    for s in 0..steps {
        // From the eye's side, high j first.
        let y = f64::from(depth) + 1.5 - (f64::from(s) + 0.5) * h;
        let density = sum(y, 0..depth as i32);
        let red: f64 = (0..depth as i32).map(|j| colour(j) * g(y - f64::from(j))).sum();
        let tau = sigma * lateral * density * h;
        if density > 0.0 {
            light += transmittance * (red / density) * -libm::expm1(-tau);
        }
        transmittance *= (-tau).exp();
    }
    let error = |compositing, thickness| {
        let q = Quality { compositing, thickness, ..Quality::before() };
        let p = picture(&volume, tf.clone(), q, None);
        let (x, y) = (p.size[0] / 2 - 1, p.size[1] / 2 - 1);
        let (i, k) = looks_at(&volume, p.size[0], x, y);
        assert!((i - 4.125).abs() < 1e-12 && (k - 4.125).abs() < 1e-12);
        (f64::from(p.pixels[(y * p.size[0] + x) as usize][0]) - light).abs() * 255.0
    };
    for d in [1.0, 0.5, 0.25] {
        let (linear, constant) = (error(Compositing::Linear, d), error(Compositing::Constant, d));
        assert!(linear < 0.05, "linear at {d}: {linear}/255");
        assert!(constant < 1.2 * d * d, "constant at {d}: {constant}/255");
    }
}

/// A body with a red ball towards +x, a green one towards +z and a blue one towards the eye.
#[test]
fn pictures_are_neither_flipped_nor_mirrored() {
    let ball =
        |p: [u32; 3], c: [i32; 3]| (0..3).map(|a| (p[a] as i32 - c[a]).pow(2)).sum::<i32>() <= 9;
    let volume = Volume::from_fn_u8("marker", [31; 3], |i, j, k| {
        let p = [i, j, k];
        if ball(p, [26, 15, 15]) {
            100
        } else if ball(p, [15, 15, 26]) {
            150
        } else if ball(p, [15, 26, 15]) {
            200
        } else {
            0
        }
    });
    let tf = alphas(
        vec![
            [100.0, 1.0, 0.0, 0.0],
            [149.0, 1.0, 0.0, 0.0],
            [150.0, 0.0, 1.0, 0.0],
            [199.0, 0.0, 1.0, 0.0],
            [200.0, 0.0, 0.0, 1.0],
        ],
        vec![[0.0, 0.0], [90.0, 0.0], [100.0, 0.9]],
    );
    let projections = [None, Some(CameraProjection::Persp { fov: 30.0, distance: 80.0 })];
    for projection in projections {
        let p = picture(&volume, tf.clone(), Quality::before(), projection);
        let n = p.size[0] as usize;
        let centroid = |c: usize| {
            let (mut w, mut x, mut y) = (0.0, 0.0, 0.0);
            for (i, px) in p.pixels.iter().enumerate() {
                w += px[c];
                x += px[c] * ((i % n) as f32 + 0.5 - n as f32 / 2.0);
                y += px[c] * ((i / n) as f32 + 0.5 - n as f32 / 2.0);
            }
            (x / w, y / w)
        };
        let (red, green, blue) = (centroid(0), centroid(1), centroid(2));
        // From the front (+y), the object's +x is on the picture's left, as a face's right is.
        assert!(red.0 < -30.0 && red.1.abs() < 1.0, "red at {red:?}");
        assert!(green.1 < -30.0 && green.0.abs() < 1.0, "green at {green:?}");
        assert!(blue.0.abs() < 1.0 && blue.1.abs() < 1.0, "blue at {blue:?}");
    }
}
