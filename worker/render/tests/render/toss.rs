use crate::support::simds;
use glam::DVec3;
use proptest::prelude::*;
use slabcast_common::brick::Brick;
use slabcast_common::ids::BrickId;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Quality;
use slabcast_common::view::{Camera, CameraProjection, Projection};
use slabcast_common::view::{SUBPIXELS, View};
use slabcast_common::volume::Samples;
use slabcast_common::volume::Volume;
use slabcast_render::kernels::Simd;
use slabcast_render::kernels::pixel_records::Splat;
use slabcast_render::kernels::row_records::Shape;
use slabcast_render::kernels::toss::*;
use slabcast_render::primitives::positions::Places;
use slabcast_render::scene::{Frame, Scene};
use slabcast_render::selftest;
use slabcast_render::visibility::open_mask::OpenMask;
use std::sync::Arc;

/// A picture of 64x64 of 16x16x16 voxels, seen from anywhere.
fn frame(to_eye: DVec3, projection: CameraProjection, thickness: f64) -> Frame {
    let volume = Volume::from_fn_u8("any", [16; 3], |i, j, k| (i + 3 * j + 7 * k) as u8);
    let quality = Quality { thickness, ..Quality::before() };
    let spec = selftest::spec(&volume, quality);
    let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection };
    let view = View::new(&volume.lattice, &camera, [64; 2], &quality).expect("a view");
    Frame::new(Arc::new(Scene::new(&spec)), view)
}

/// A brick with some share of its voxels, chosen by `seed`, of one kind of samples.
fn brick(which: u32, share: f64, seed: u64, kind: u8, shaded: bool) -> Brick {
    let hash = |i: u16| (seed ^ u64::from(i)).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
    let there = |i: &u16| (hash(*i) as f64) < share * 4_294_967_296.0;
    let index: Vec<u16> = (0..512).filter(there).collect();
    let values = match kind {
        0 => Samples::U8(index.iter().map(|&i| hash(i) as u8).collect()),
        1 => Samples::U16(index.iter().map(|&i| hash(i) as u16).collect()),
        _ => Samples::F32(index.iter().map(|&i| hash(i) as f32).collect()),
    };
    let normals = shaded.then(|| index.iter().map(|&i| hash(i + 600) as u16).collect());
    Brick::new(BrickId(which), index, values, normals)
}

proptest! {
    #[test]
    fn toss_and_cull_are_identical_on_every_instruction_set(
        eye in prop::array::uniform3(0.1..1.0f64), height in 6.0..60.0f64,
        thickness in prop::sample::select(vec![0.5, 1.0, 2.0]),
        which in 0..8u32, share in 0.0..1.0f64, seed in any::<u64>(),
        kind in 0..3u8, shaded in any::<bool>(), cull in any::<bool>(),
        open in prop::collection::vec((0..64usize, 0..64u32), 0..40),
        begin in -16..16i32, count in 0..24i32,
        reach in prop::array::uniform2(0..9i32), packed in 0..3u8,
    ) {
        let flat = CameraProjection::Ortho { height };
        let frame = frame(DVec3::from_array(eye), flat, thickness);
        let Some(flat) = &frame.flat else { return Ok(()) };
        let brick = brick(which, share, seed, kind, shaded);
        let mut mask = OpenMask::shut(Rect::new(0, 0, 64, 64));
        open.iter().for_each(|&(y, x)| mask.open_row(y, 1 << x));
        mask.grow(flat.reach);
        let footprint = frame.footprints.at(0).expect("sheets that are all drawn");
        let from = Places::from(frame.corner(brick.id).flat, [0; 3]);
        let sieve = Sieve {
            places: FlatBrick { places: &flat.places, from },
            open: &mask,
            cull,
            sections: &frame.sections,
            sheets: [begin, begin + count],
        };
        let phases = [0, 1].map(|axis| footprint.phases(axis).expect("a table"));
        let shape = Shape::new::<i16>(40, phases[0].len.min(63));
        let tier = TierOf { base: -700, per: (1 << TIER_BITS) / (200 + (seed % 3000) as i32) };
        let packing = match packed {
            0 => Packing::Window(&phases),
            1 => Packing::Aside,
            _ => Packing::Tier(&phases[0], shape, &tier),
        };
        let sift = |simd| {
            let mut tossing = Tossing::default();
            let sifted = sieve.sift_ready(simd, &brick, packing, &mut tossing);
            let voxel = |(first, v): (&i32, &Splat)| (*first, v.place, v.rows, v.deep, v.sample);
            (sifted, tossing.ready(sifted.kept).map(voxel).collect::<Vec<_>>())
        };
        let want = sift(Simd::plain());
        prop_assert!(want.0.kept <= want.0.reached && want.0.reached <= brick.len());
        for simd in simds() {
            prop_assert_eq!(&sift(simd), &want, "{}", simd.name());
        }
        // The same brick in perspective.
        let (fov, distance) = (30.0, 30.0 + height);
        let deep = CameraProjection::Persp { fov, distance };
        let frame = self::frame(DVec3::from_array(eye), deep, thickness);
        let Projection::Persp { focal, distance } = frame.view.projection else {
            unreachable!("a perspective view");
        };
        mask.grow(reach);
        let sieve = Sieve {
            places: DeepBrick {
                view: &frame.view,
                offsets: frame.offsets(),
                corner: frame.corner(brick.id).eye.to_array(),
                per_depth: focal * f64::from(SUBPIXELS),
                distance,
                middle: [32.0 * f64::from(SUBPIXELS); 2],
            },
            open: &mask,
            cull,
            sections: &frame.sections,
            sheets: [begin, begin + count],
        };
        let sift = |simd| {
            let mut tossing = Tossing::default();
            let sifted = sieve.sift(simd, &brick, &mut tossing);
            (sifted, tossing.kept(sifted.kept).collect::<Vec<_>>())
        };
        let want = sift(Simd::plain());
        for kept in &want.1 {
            let eye = DVec3::from_array(sieve.places.eye(kept.local));
            let depth = frame.view.depth_in_phases(eye.z);
            prop_assert_eq!(kept.first, frame.sections.first(depth));
            let scale = focal / (eye.z + distance);
            let [x, y] = [eye.x, eye.y].map(|v| (v * scale + 32.0).clamp(0.0, 63.9));
            let cell = [i32::from(kept.cell & 63), i32::from(kept.cell >> 6)];
            // A position is rounded to a subpixel, which may be the next pixel's first.
            let apart = [x, y].into_iter().zip(cell).map(|(at, c)| at - f64::from(c));
            prop_assert!(apart.into_iter().all(|d| (-0.01..1.01).contains(&d)));
        }
        for simd in simds() {
            prop_assert_eq!(&sift(simd), &want, "{}", simd.name());
        }
    }

    #[test]
    fn any_in_rows_equals_testing_each_row(
        set in prop::collection::vec((0..64usize, 0..64u32), 0..20),
        begin in 0..=64usize, end in 0..=64usize, columns in any::<u64>(), shift in 0..64u32,
    ) {
        let mut rows = [0; 64];
        set.iter().for_each(|&(y, x)| rows[y] |= 1u64 << x);
        let (begin, end) = (begin.min(end), end.max(begin));
        let columns = columns >> shift;
        let want = rows[begin..end].iter().any(|row| row & columns != 0);
        for simd in simds() {
            prop_assert_eq!(any_in_rows(simd, &rows, [begin, end], columns), want);
        }
    }
}
