use glam::DVec3;
use proptest::prelude::*;
use slabcast_common::ids::BrickId;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Quality;
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::view::{Projection, SUBPIXEL_BITS};
use slabcast_common::volume::{Lattice, Volume};
use slabcast_render::geometry::perspective::*;
use slabcast_render::geometry::sheared;
use slabcast_render::primitives::sizes::PART;
use slabcast_render::scene::Frame;
use slabcast_render::scene::Scene;
use slabcast_render::selftest;
use std::sync::Arc;

proptest! {
    /// Where voxels are looked for is the pixel of their centre and so many around it.
    #[test]
    fn culling_reach_covers_every_section_footprint(
        eye in prop::array::uniform3(-1.0..1.0f64), fov in 10.0..110.0f64,
        distance in 10.0..60.0f64, thickness in prop::sample::select(vec![0.5, 1.0, 1.7]),
        edge in prop::sample::select(vec![64, 150, 300]), which in 0..8u32,
        wide in prop::sample::select(vec![1.0, 1.0, 1.4, 2.5]),
        skew in prop::sample::select(vec![0.0, 0.0, 0.5]), parallel in any::<bool>(),
    ) {
        let mut volume =
            Volume::from_fn_u8("any", [16; 3], |i, j, k| (i + 3 * j + 7 * k) as u8);
        volume.lattice = Lattice::from_spacing([16; 3], [1.0, wide, 1.0]);
        volume.lattice.steps[0].y = skew;
        let quality = Quality { thickness, ..Quality::before() };
        let projection = match parallel {
            false => CameraProjection::Persp { fov, distance },
            true => CameraProjection::Ortho { height: distance },
        };
        let to_eye = DVec3::from_array(eye) + DVec3::splat(1e-3);
        let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection };
        let view = View::new(&volume.lattice, &camera, [edge; 2], &quality).expect("a view");
        let spec = selftest::spec(&volume, quality);
        let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
        let corner = frame.corner(BrickId(which));
        let placed: Vec<_> = (0..512).map(|local| frame.place(&corner, local)).collect();
        let first = |z| frame.sections.first(z);
        let nearest = placed.iter().map(|p| first(p.z)).min().expect("512 of them");
        for (y0, x0) in [0, 64, 128, 192, 256].into_iter().flat_map(|y| [(y, 0), (y, 64), (y, y)]) {
            let part = Rect::new(x0, y0, x0 + PART, y0 + PART)
                .intersect(&Rect::from_size([edge; 2]));
            let lean = sheared::accepts(&frame);
            let near = match parallel {
                false => deep(&frame, &part, nearest).map(|deep| deep.reach),
                true => lean.map(|lean| lean.flat.reach),
            };
            let Some(reach) = near.filter(|_| !part.is_empty()) else { continue };
            for (local, p) in (0..).zip(&placed) {
                let at = match (lean, frame.view.projection) {
                    (Some(lean), _) if parallel => lean.flat.places.at(corner.flat, local).0,
                    (_, Projection::Persp { focal, distance }) => {
                        frame.view.screen(p.eye.x, p.eye.y, focal / (p.eye.z + distance))
                    }
                    _ => unreachable!("a view that is neither"),
                };
                let cell = at.map(|at| at >> SUBPIXEL_BITS);
                let (k, count) = frame.sections.span(p.z);
                for sheet in k..k + count as i32 {
                    let footprint = frame.footprints.at(sheet).expect("none is clipped");
                    let at = frame.screen(p, sheet, &footprint);
                    let y = footprint.extent(1, at[1]);
                    let ends = [y.0, y.1 - 1].map(|y| frame.along_row(at, y));
                    let [a, b] = ends.map(|x| footprint.extent(0, x));
                    let x = (a.0.min(b.0), a.1.max(b.1));
                    if Rect::new(x.0, y.0, x.1, y.1).intersect(&part).is_empty() {
                        continue;
                    }
                    for (axis, (from, to)) in [x, y].into_iter().enumerate() {
                        let (from, to) = (i64::from(from) - cell[axis], i64::from(to) - 1 - cell[axis]);
                        let reach = i64::from(reach[axis]);
                        prop_assert!(-reach <= from && to <= reach, "{from} to {to} of {reach}");
                    }
                }
            }
        }
    }
}
