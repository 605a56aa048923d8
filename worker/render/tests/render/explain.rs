//! `explain` reports the numbers that the renderer used.

use crate::support::{bricks_of, transfer};
use glam::DVec3;
use slabcast_common::ids::SceneId;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Classify, Compositing, Kernel, Quality, Sums};
use slabcast_common::shade::Shading;
use slabcast_common::transfer::{OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Samples, Volume};
use slabcast_render::judge::reference::FieldReference;
use slabcast_render::oracle::explain::{PixelExplanation, explain};
use slabcast_render::oracle::explain_field::explain_field;
use slabcast_render::oracle::serial;
use slabcast_render::oracle::work_counters::count_work;
use slabcast_render::{Frame, Scene};
use std::sync::Arc;

const SIZE: u32 = 40;

fn onion() -> Volume {
    Volume::from_fn_u8("onion", [20, 18, 22], |i, j, k| {
        let r2 = [(i, 20u32), (j, 18), (k, 22)]
            .map(|(p, n)| (2.0 * f64::from(p) + 1.0) / f64::from(n) - 1.0)
            .iter()
            .map(|x| x * x)
            .sum::<f64>();
        (250.0 * (1.0 - r2.sqrt()).max(0.0)) as u8
    })
}

/// Translucent outside, opaque within, lit: so that pixels shut, some late and some never.
fn lit() -> TransferFunction {
    let colors = vec![[0.0, 0.1, 0.2, 0.9], [90.0, 0.9, 0.4, 0.1], [255.0, 1.0, 0.9, 0.8]];
    let opacities = vec![[0.0, 0.0], [30.0, 0.05], [100.0, 0.2], [140.0, 0.999]];
    let unlit = transfer(colors, opacities, OpacityUnit::AlphaPerVox);
    TransferFunction { shading: Shading::default(), ..unlit }
}

fn spec(volume: &Volume, quality: Quality) -> SceneSpec {
    SceneSpec {
        id: SceneId(1),
        volume: volume.info(Digest32::default()),
        transfer: lit(),
        quality,
        crop: None,
        bricks: Default::default(),
    }
}

fn frame(volume: &Volume, quality: Quality, projection: CameraProjection) -> Frame {
    let spec = spec(volume, quality);
    let camera = Camera {
        to_eye: DVec3::new(0.53, 0.71, 0.36),
        up: DVec3::Z,
        target: DVec3::new(0.3, -0.2, 0.1),
        projection,
    };
    let view = View::new(&volume.lattice, &camera, [SIZE; 2], &quality).unwrap();
    Frame::new(Arc::new(Scene::new(&spec)), view)
}

const PROJECTIONS: [CameraProjection; 3] = [
    CameraProjection::Ortho { height: 30.0 },
    CameraProjection::Persp { fov: 40.0, distance: 40.0 },
    // The eye inside: the near plane clips.
    CameraProjection::Persp { fov: 100.0, distance: 4.0 },
];

/// The middle, the silhouette on both sides, blank corners.
fn places() -> impl Iterator<Item = [u32; 2]> {
    (0..SIZE).step_by(3).flat_map(|x| [[x, SIZE / 2], [x, x], [SIZE - 1 - x / 2, x / 3]])
}

fn qualities() -> Vec<Quality> {
    let mut out = Vec::new();
    for compositing in [Compositing::Linear, Compositing::Constant, Compositing::Paper] {
        for sums in [Sums::I32, Sums::I16, Sums::F32] {
            for (thickness, eps) in [(1.0, 1.0 / 512.0), (0.3, 0.0), (2.5, 0.1)] {
                out.push(Quality { compositing, sums, thickness, eps, ..Quality::before() });
            }
        }
    }
    out
}

#[test]
fn explained_pixel_equals_rendered_pixel_bit_for_bit() {
    let volume = onion();
    let bricks = bricks_of(&volume);
    for quality in qualities() {
        for projection in PROJECTIONS {
            let frame = frame(&volume, quality, projection);
            let picture = serial::render(&frame, &bricks);
            let (mut seen, mut shut) = (0, 0);
            for [x, y] in places() {
                let e = explain(&frame, &bricks, [x, y], 3);
                let want = picture.pixels[(y * SIZE + x) as usize];
                let what = format!("{quality:?} {projection:?} {x},{y}");
                assert_eq!(e.pixel.map(f32::to_bits), want.map(f32::to_bits), "{what}");
                agrees_with_itself(&e, &quality, &what);
                seen += usize::from(want[3] > 0.0);
                shut += usize::from(e.shut_in.is_some());
            }
            assert!(seen > 10 && (shut > 3) == (quality.eps > 0.0), "{seen} seen, {shut} shut");
        }
    }
}

/// A field's pixel is explained with the renderer's numbers, and with values near the exact ones.
#[test]
fn explained_field_equals_rendered_pixel_bit_for_bit() {
    // No voxel is 0: `bricks_of` leaves those out.
    let mut volume = onion();
    if let Samples::U8(samples) = &mut volume.samples {
        samples.iter_mut().for_each(|v| *v = (*v).max(1));
    }
    let bricks = bricks_of(&volume);
    for (sums, thickness) in [(Sums::I32, 0.5), (Sums::I16, 1.0)] {
        for projection in PROJECTIONS {
            let quality = Quality {
                classify: Classify::After,
                kernel: Kernel::Bspline,
                sums,
                thickness,
                ..Quality::before()
            };
            let frame = frame(&volume, quality, projection);
            let (picture, notes) = count_work(&frame, &bricks);
            assert_eq!(picture, serial::render(&frame, &bricks));
            let reference = FieldReference::new(&spec(&volume, quality), frame.view, &bricks);
            let (mut seen, mut shut, mut deep) = (0, 0, 0);
            for [x, y] in places() {
                let e = explain_field(&frame, &bricks, [x, y], 3);
                let i = (y * SIZE + x) as usize;
                let what = format!("{sums:?} {projection:?} {x},{y}");
                assert_eq!(
                    e.pixel.map(f32::to_bits),
                    picture.pixels[i].map(f32::to_bits),
                    "{what}"
                );
                assert_eq!(
                    (notes.shut_in[i], notes.sheets[i] as usize),
                    (e.shut_in, e.planes.len())
                );
                for plane in &e.planes {
                    let exact = reference.value_on_ray([x, y], plane.depth);
                    // Fewer voxels: at the volume's faces, or terms that 16 bits round to nothing.
                    if plane.voxels > 60 {
                        deep += 1;
                        assert!((plane.code - exact).abs() < 0.5, "{what}: {plane:?}, {exact}");
                    }
                    assert!(plane.strongest.len() == plane.voxels.min(3), "{what}");
                    let terms: f64 = plane.strongest.iter().map(|v| v.adds).sum();
                    assert!(terms <= plane.code.abs() + 1.0 || plane.voxels < 60, "{what}");
                }
                seen += usize::from(e.pixel[3] > 0.0);
                shut += usize::from(e.shut_in.is_some());
            }
            let enough = deep > 20 || sums == Sums::I16;
            assert!(seen > 10 && shut > 3 && enough, "{seen} seen, {shut} shut, {deep} deep");
        }
    }
}

#[test]
fn work_counters_match_explained_sheets_and_sections() {
    let volume = onion();
    let bricks = bricks_of(&volume);
    for (sums, projection) in [(Sums::I32, PROJECTIONS[0]), (Sums::F32, PROJECTIONS[1])] {
        let quality = Quality { sums, ..Quality::before() };
        let frame = frame(&volume, quality, projection);
        let (picture, notes) = count_work(&frame, &bricks);
        assert_eq!(picture, serial::render(&frame, &bricks));
        let mut most = 0;
        for [x, y] in places() {
            let e = explain(&frame, &bricks, [x, y], 0);
            let i = (y * SIZE + x) as usize;
            assert_eq!((notes.shut_in[i], notes.sheets[i] as usize), (e.shut_in, e.sheets.len()));
            let listed: usize = e.sheets.iter().map(|s| s.sections).sum();
            most = most.max(listed);
            let noted = notes.sections[i] as usize;
            // Integers round the faintest sections to nothing; they were added all the same.
            assert!(noted >= listed && (sums == Sums::I32 || noted == listed), "{noted} {listed}");
            assert!(e.sheets.first().is_none_or(|s| notes.first.unwrap() <= s.k));
        }
        assert!(most > 100, "{most}");
    }
}

/// Opacity goes on from sheet to sheet, light adds up to the pixel, voxels to their sheet.
#[track_caller]
fn agrees_with_itself(e: &PixelExplanation, quality: &Quality, what: &str) {
    let mut a = 0.0;
    let mut light = [0.0; 3];
    for s in &e.sheets {
        assert_eq!(s.a_before, a, "{what}, sheet {}", s.k);
        assert!(s.a >= a && s.tau >= 0.0, "{what}, sheet {}", s.k);
        a = s.a;
        for c in 0..3 {
            light[c] += s.light[c];
        }
        let listed: f32 = s.strongest.iter().map(|v| v.tau).sum();
        assert!(listed <= s.tau * 1.0001, "{what}, sheet {}: {listed} of {}", s.k, s.tau);
        assert_eq!(s.strongest.len(), s.sections.min(3));
        assert!(s.strongest.windows(2).all(|w| w[0].tau >= w[1].tau));
        assert!(s.bricks >= 1 && s.bricks <= e.bricks);
    }
    assert_eq!(a, e.pixel[3], "{what}");
    for c in 0..3 {
        // Fixed-point steps are exact in f64; the pixel's f32 rounds once.
        assert!((light[c] - f64::from(e.pixel[c])).abs() < 1e-7, "{what}");
    }
    match e.shut_in {
        Some(k) => {
            assert_eq!(e.sheets.last().map(|s| s.k), Some(k), "{what}");
            assert!(1.0 - f64::from(a) < quality.eps, "{what}");
        }
        None => assert_eq!(e.hidden_voxels, 0, "{what}"),
    }
}

/// All of a sheet's voxels together are the sheet.
#[test]
fn explained_sections_sum_to_their_sheet() {
    let volume = onion();
    let bricks = bricks_of(&volume);
    let quality = Quality { sums: Sums::I32, ..Quality::before() };
    for projection in PROJECTIONS {
        let frame = frame(&volume, quality, projection);
        let e = explain(&frame, &bricks, [SIZE / 2, SIZE / 2], usize::MAX);
        assert!(e.sheets.len() > 1);
        for s in &e.sheets {
            assert_eq!(s.strongest.len(), s.sections);
            let tau: f64 = s.strongest.iter().map(|v| f64::from(v.tau)).sum();
            assert!((tau / f64::from(s.tau) - 1.0).abs() < 1e-5, "{projection:?} {}", s.k);
            for v in &s.strongest {
                let [i, j, k] = v.voxel;
                let at = ((k * 18 + j) * 20 + i) as usize;
                assert_eq!(v.code, volume.samples.code(at), "the voxel is the one it says");
                assert!(v.weights.iter().all(|&w| w > 0.0));
            }
        }
    }
}
