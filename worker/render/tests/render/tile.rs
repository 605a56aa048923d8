use crate::support::simds;
use glam::DVec3;
use slabcast_common::image::TileState;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Classify, Quality, Sums};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::Volume;
use slabcast_render::scene::{Frame, Scene};
use slabcast_render::selftest;
use slabcast_render::tile::*;
use std::sync::Arc;

#[test]
fn footprint_cost_counts_pixels_and_bytes() {
    let volume = Volume::from_fn_u8("any", [16; 3], |i, j, k| (i + 3 * j + 7 * k) as u8);
    // 1.6 pixels a vox: a kernel is 6.4 wide, and so touches seven.
    let flat = CameraProjection::Ortho { height: 40.0 };
    let deep = CameraProjection::Persp { fov: 30.0, distance: 60.0 };
    let adds = |sums, thickness, projection| {
        let quality = Quality { sums, thickness, ..Quality::before() };
        let to_eye = DVec3::new(1.0, 2.0, 0.5);
        let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection };
        let view = View::new(&volume.lattice, &camera, [64; 2], &quality).expect("a view");
        let scene = Scene::new(&selftest::spec(&volume, quality));
        Frame::new(Arc::new(scene), view).footprint_cost()
    };
    let seven = |bytes| Some(FootprintCost { pixels: [7; 2], bytes });
    assert_eq!(adds(Sums::I16, 1.0, flat), seven(32));
    assert_eq!(adds(Sums::I32, 1.0, flat), seven(64));
    assert_eq!(adds(Sums::I16, 0.5, flat), seven(64));
    assert_eq!(adds(Sums::F32, 1.0, flat), None);
    assert_eq!(adds(Sums::I16, 1.0, deep), None);
}

/// Checks records after culled voxels and unreached sheets, too: anything left would be added to
/// another part.
#[test]
fn records_are_empty_between_parts() {
    let volume = Volume::from_fn_u8("ball", [40; 3], |i, j, k| {
        let from_middle = [i, j, k].map(|n| (n as i32 - 20).pow(2)).iter().sum::<i32>();
        if from_middle < 300 { 200 } else { 0 }
    });
    let bricks = selftest::bricks_of(&volume);
    let flat = CameraProjection::Ortho { height: 30.0 };
    for (classify, up, sums, thickness) in [
        (Classify::Before, 0.0, Sums::I16, 1.0),
        (Classify::Before, 0.0, Sums::I32, 0.5),
        (Classify::Before, 0.4, Sums::I16, 0.5),
        (Classify::Before, 0.4, Sums::I32, 1.0),
        (Classify::After, 0.4, Sums::I16, 1.0),
        (Classify::After, 0.4, Sums::I32, 0.5),
    ] {
        let quality = Quality { classify, sums, thickness, ..Quality::before() };
        let to_eye = DVec3::new(1.0, 2.0, up);
        let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection: flat };
        let view = View::new(&volume.lattice, &camera, [200; 2], &quality).expect("a view");
        let scene = Arc::new(Scene::new(&selftest::spec(&volume, quality)));
        let frame = Frame::new(scene, view);
        let mut scratch = Scratch::default();
        let tile = Rect::new(0, 0, 200, 200);
        let all = SheetRange::new(-200, 200);
        let state = TileState { a: vec![0.0; tile.area()], last: None };
        for simd in simds() {
            let (_, counted) = render(&frame, simd, tile, all, &bricks, &state, &mut scratch);
            assert!(counted.splatted > 1000);
            let empty = scratch.shorts.is_empty() && scratch.longs.is_empty();
            assert!(empty, "{classify:?}, {up} from above, {sums:?}, {}", simd.name());
        }
    }
}
