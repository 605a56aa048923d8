use glam::DVec3;
use proptest::prelude::*;
use slabcast_common::brick::local_position;
use slabcast_common::ids::BrickId;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::view::View;
use slabcast_common::view::{Camera, CameraProjection};
use slabcast_common::volume::{Lattice, Volume};
use slabcast_render::primitives::lattice_rows::*;
use slabcast_render::primitives::sizes::LATTICE_ROWS as ROWS;
use slabcast_render::scene::Frame;
use slabcast_render::scene::Scene;
use slabcast_render::selftest;
use std::sync::Arc;

/// A view of 20x16x24 voxels.
fn frame(to_eye: DVec3, up: DVec3, projection: CameraProjection, sums: Sums, z: f64) -> Frame {
    let mut volume = Volume::from_fn_u8("any", [20, 16, 24], |i, j, k| (i + 3 * j + 7 * k) as u8);
    volume.lattice = Lattice::from_spacing([20, 16, 24], [1.0, 1.0, z]);
    let quality = Quality { sums, ..Quality::before() };
    let camera = Camera { to_eye, up, target: DVec3::ZERO, projection };
    let view = View::new(&volume.lattice, &camera, [100, 90], &quality).expect("a view");
    Frame::new(Arc::new(Scene::new(&selftest::spec(&volume, quality))), view)
}

#[test]
fn lattice_rows_exist_for_level_views_with_wide_enough_rows() {
    let flat = |height| CameraProjection::Ortho { height };
    let (aside, z) = (DVec3::new(1.0, 2.0, 0.0), DVec3::Z);
    let lattice_rows = |to_eye, up, height, sums, spacing| {
        frame(to_eye, up, flat(height), sums, spacing).lattice_rows.map(|s| (s.axis, s.upwards))
    };
    assert_eq!(lattice_rows(aside, z, 40.0, Sums::I16, 1.0), Some((2, true)));
    assert_eq!(lattice_rows(aside, -z, 40.0, Sums::I32, 2.5), Some((2, false)));
    let forward = DVec3::new(0.0, 0.3, 1.0);
    assert_eq!(lattice_rows(forward, DVec3::X, 40.0, Sums::I32, 1.0), Some((0, true)));
    // From above; floats; a pixel for several lattice rows; and a kernel that leans.
    assert_eq!(lattice_rows(aside + z, z, 40.0, Sums::I16, 1.0), None);
    assert_eq!(lattice_rows(aside, z, 40.0, Sums::F32, 1.0), None);
    assert_eq!(lattice_rows(aside, z, 91.0 / CLOSEST, Sums::I16, 1.0), None);
    assert_eq!(lattice_rows(forward, DVec3::X, 40.0, Sums::I32, 2.5), None);
    // In perspective the farthest sheet has them closest.
    let deep = |distance| CameraProjection::Persp { fov: 40.0, distance };
    let of = |distance| frame(aside, z, deep(distance), Sums::I16, 1.0).lattice_rows.is_some();
    assert_eq!([60.0, 140.0, 180.0].map(of), [true, true, false]);
}

proptest! {
    /// A voxel's position down the picture and its index give the same lattice row, and all rows
    /// that reach a part have a tier there.
    #[test]
    fn lattice_row_from_position_equals_lattice_row_from_index(
        azimuth in 0.0..6.3f64, height in 8.0..110.0f64, upside_down in any::<bool>(),
        distance in 30.0..90.0f64, persp in any::<bool>(), which in 0..12u32, y0 in 0..90i32,
    ) {
        let up = if upside_down { -DVec3::Z } else { DVec3::Z };
        let projection = match persp {
            true => CameraProjection::Persp { fov: 40.0, distance },
            false => CameraProjection::Ortho { height },
        };
        let to_eye = DVec3::new(azimuth.sin(), azimuth.cos(), 0.0);
        let frame = frame(to_eye, up, projection, Sums::I32, 1.0);
        let Some(lattice_rows) = &frame.lattice_rows else { return Ok(()) };
        let part = Rect::new(0, y0, 64, 90);
        let corner = frame.corner(BrickId(which));
        let (per, first) = lattice_rows.by_eye();
        for l in (0..512).filter(|&l| (0..3).all(|a| corner.index[a] + local_position(l)[a] < [20, 16, 24][a])) {
            let lattice_row = frame.lattice_row(&corner, l).expect("a level view");
            let placed = frame.place(&corner, l);
            prop_assert_eq!(libm::floor(placed.eye.y * per + first + 0.5) as u32, lattice_row);
            let (k, count) = frame.sections.span(placed.z);
            for k in k..k + count as i32 {
                let f = frame.footprints.at(k).expect("no sheet is clipped");
                let at = frame.screen(&placed, k, &f)[1];
                prop_assert_eq!(at, lattice_rows.at(&frame.view, lattice_row as usize, &f));
                let (from, to) = f.extent(1, at);
                let base = lattice_rows.base(&frame.view, &part, f.scale);
                let rows = lattice_rows.rows(part.height() as i32, f.scale) as i32;
                let tier = lattice_row as i32 - base;
                prop_assert!(from >= part.y1 || to <= part.y0 || (1..rows - 1).contains(&tier));
                prop_assert!(rows as usize <= ROWS);
            }
        }
    }
}
