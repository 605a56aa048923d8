//! Fields up to the volume's faces, against closed forms.

use crate::support::{bricks_of, transfer};
use glam::DVec3;
use slabcast_common::crop::CropBox;
use slabcast_common::ids::SceneId;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Kernel, Quality, Sums};
use slabcast_common::transfer::OpacityUnit;
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, SampleKind, Samples, Volume};
use slabcast_render::judge::reference::FieldReference;
use slabcast_render::oracle::explain_field::explain_field;
use slabcast_render::oracle::serial;
use slabcast_render::{Frame, Scene};
use std::sync::Arc;

/// A constant is constant up to the faces: half a step behind the outermost samples. Values fade
/// there where sums are not divided by the kernel's share inside, and pass what is visible.
#[test]
fn constant_volume_is_drawn_at_full_strength_up_to_its_faces() {
    let (n, alpha) = (12u32, 0.3);
    // One other voxel, in a corner, so that the volume has a range of values.
    let volume = Volume::from_fn_u8("constant", [n; 3], |i, j, k| match [i, j, k] {
        [0, 0, 0] => 20,
        _ => 200,
    });
    let white = vec![[0.0, 1.0, 1.0, 1.0], [255.0, 1.0, 1.0, 1.0]];
    let visible = vec![[0.0, 0.0], [194.0, 0.0], [195.0, alpha], [255.0, alpha]];
    let tf = transfer(white, visible, OpacityUnit::AlphaPerVox);
    // A box that cuts through the middle between samples: the faces are exact, the field goes on.
    let cut = CropBox { lo: DVec3::new(-3.3, -6.0, -2.75), hi: DVec3::new(6.0, 6.0, 1.5) };
    let settings = [(Sums::I16, 1.0), (Sums::I32, 1.0), (Sums::I32, 0.5)];
    for (sums, thickness, crop) in settings
        .into_iter()
        .flat_map(|(sums, thickness)| [(sums, thickness, None), (sums, thickness, Some(cut))])
    {
        let quality = Quality { eps: 0.0, sums, thickness, ..Quality::default() };
        let spec = SceneSpec {
            id: SceneId(1),
            volume: volume.info(Digest32::default()),
            transfer: tf.clone(),
            quality,
            crop,
            bricks: Default::default(),
        };
        let camera = Camera {
            to_eye: DVec3::Z,
            up: DVec3::Y,
            target: DVec3::ZERO,
            projection: CameraProjection::Ortho { height: f64::from(2 * n) },
        };
        // Four pixels a vox, the volume's faces at pixels 24 and 72.
        let view = View::new(&volume.lattice, &camera, [96; 2], &quality).expect("a camera");
        let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
        let picture = serial::render(&frame, &bricks_of(&volume));
        let depth = crop.map_or(f64::from(n), |crop| crop.hi.z - crop.lo.z);
        let want = 1.0 - libm::pow(1.0 - alpha, depth);
        // Ends along x, in pixels: the first inside, and the last.
        let [left, right] = crop.map_or([24, 71], |_| [35, 71]);
        for (x, y, inside) in [
            (48, 48, true),
            (right, 48, true),
            (left, 24, true),
            (71, 71, true),
            (right + 1, 48, false),
            (left - 1, 48, false),
            (48, 23, false),
        ] {
            let got = f64::from(picture.pixels[y * 96 + x][3]);
            let want = if inside { want } else { 0.0 };
            let off = 255.0 * (got - want).abs();
            assert!(off < 0.5, "{sums:?}, {thickness}, {crop:?}: {x},{y} has {got}, want {want}");
        }
    }
}

/// Inside a constant volume the field has no gradient, whichever way the lattice is turned: the sum of
/// weights is known to waves of (3, 2) and (4, 2) cycles, whose slopes would light flat tissue.
/// Thin planes and large pixels per vox make the rounding of positions small.
#[test]
fn constant_volume_turned_by_thirty_degrees_has_no_gradient() {
    let n = 16u32;
    let volume = Volume::from_fn_u8("constant", [n; 3], |i, j, k| match [i, j, k] {
        [0, 0, 0] => 20,
        _ => 200,
    });
    let white = vec![[0.0, 1.0, 1.0, 1.0], [255.0, 1.0, 1.0, 1.0]];
    let visible = vec![[0.0, 0.0], [100.0, 0.0], [101.0, 0.01], [255.0, 0.01]];
    let quality = Quality { eps: 0.0, sums: Sums::I32, thickness: 0.0625, ..Quality::default() };
    let spec = SceneSpec {
        id: SceneId(1),
        volume: volume.info(Digest32::default()),
        transfer: transfer(white, visible, OpacityUnit::AlphaPerVox),
        quality,
        crop: None,
        bricks: Default::default(),
    };
    let camera = Camera {
        to_eye: DVec3::new(0.5, 0.0, 0.75f64.sqrt()),
        up: DVec3::Y,
        target: DVec3::ZERO,
        projection: CameraProjection::Ortho { height: f64::from(n) },
    };
    // 32 pixels a vox: positions are rounded to 1/8192 vox.
    let size = 32 * n;
    let view = View::new(&volume.lattice, &camera, [size; 2], &quality).expect("a camera");
    let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
    let bricks = bricks_of(&volume);
    let (mut looked_at, mut steepest) = (0, 0.0f64);
    for x in [0, 13].map(|x| size / 2 + x) {
        let explained = explain_field(&frame, &bricks, [x, size / 2 + 5], 0);
        for plane in explained.planes.iter().filter(|plane| plane.depth.abs() < 3.0) {
            looked_at += 1;
            steepest = steepest.max(plane.gradient);
            assert!((plane.code - 200.0).abs() < 0.1, "{x}, {}: {}", plane.depth, plane.code);
        }
    }
    // Without waves of more than two cycles it is 0.61 codes per vox.
    assert!(steepest < 0.15, "{steepest}");
    assert_eq!(looked_at, 2 * 96);
}

/// Waves between 18 and 238 on an oblique lattice.
fn waves() -> Volume {
    let mut volume = Volume::from_fn_u8("waves", [22, 20, 24], |i, j, k| {
        let [x, y, z] = [i, j, k].map(f64::from);
        (128.0 + 60.0 * (x * 0.45).sin() + 50.0 * (y * 0.38 + z * 0.3).cos()) as u8
    });
    volume.lattice.steps[0].y = 0.3;
    volume
}

/// Crop, opacity by gradient, light, an oblique lattice: pixels are those of the f64 limit.
#[test]
fn cropped_and_modulated_pictures_approach_the_limit() {
    approach_the_limit(&waves(), Kernel::Bspline);
}

/// Coefficients beyond the smallest and the largest value are drawn as in the f64 limit.
#[test]
fn pictures_of_coefficients_approach_the_limit() {
    let mut volume = waves();
    let all = (0..volume.samples.len()).map(|i| volume.samples.code(i) as f32).collect();
    volume.samples = Samples::F32(all);
    volume.summary.kind = SampleKind::F32;
    (volume.summary.min_code, volume.summary.max_code) = (40.0, 210.0);
    approach_the_limit(&volume, Kernel::Interpolating);
}

/// Draws `volume` in parallel and in perspective views, with planes of 1 and 1/2 vox.
fn approach_the_limit(volume: &Volume, kernel: Kernel) {
    let colours = vec![[0.0, 1.0, 0.2, 0.1], [128.0, 0.8, 0.8, 0.2], [255.0, 0.1, 0.5, 1.0]];
    let visible = vec![[0.0, 0.0], [120.0, 0.0], [150.0, 0.15], [255.0, 0.6]];
    let mut tf = transfer(colours, visible, OpacityUnit::AlphaPerVox);
    tf.shading.on = true;
    tf.gradient_opacity = vec![[0.0, 0.1], [8.0, 0.3], [30.0, 1.0]];
    let crop = CropBox { lo: DVec3::new(-7.2, -8.1, -20.0), hi: DVec3::new(20.0, 6.3, 8.4) };
    for projection in [
        CameraProjection::Ortho { height: 34.0 },
        CameraProjection::Persp { fov: 35.0, distance: 50.0 },
    ] {
        let camera = Camera {
            to_eye: DVec3::new(0.5, 0.8, 0.4),
            up: DVec3::Z,
            target: DVec3::ZERO,
            projection,
        };
        let mut errors = Vec::new();
        for thickness in [1.0, 0.5] {
            let quality =
                Quality { eps: 0.0, sums: Sums::I32, thickness, kernel, ..Quality::default() };
            let spec = SceneSpec {
                id: SceneId(1),
                volume: volume.info(Digest32::default()),
                transfer: tf.clone(),
                quality,
                crop: Some(crop),
                bricks: Default::default(),
            };
            let bricks = bricks_of(volume);
            let view = View::new(&volume.lattice, &camera, [48; 2], &quality).expect("a camera");
            let picture = serial::render(&Frame::new(Arc::new(Scene::new(&spec)), view), &bricks);
            let reference = FieldReference::new(&spec, view, &bricks);
            let (mut sum, mut covered) = (0.0, 0);
            for (i, pixel) in picture.pixels.iter().enumerate() {
                let exact = reference.pixel(i as u32 % 48, i as u32 / 48);
                covered += usize::from(exact[3] > 0.0);
                sum += (0..4).map(|c| (f64::from(pixel[c]) - exact[c]).powi(2)).sum::<f64>();
            }
            assert!(covered > 500, "{covered} pixels show something");
            errors.push(255.0 * (sum / covered as f64 / 4.0).sqrt());
        }
        assert!(errors[1] < 0.7 && errors[1] < 0.7 * errors[0], "{projection:?}: {errors:?} /255");
    }
}
