use crate::support::simds;
use glam::DVec3;
use proptest::prelude::*;
use slabcast_common::brick::Brick;
use slabcast_common::ids::BrickId;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Quality;
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::Samples;
use slabcast_common::volume::Volume;
use slabcast_render::kernels::Simd;
use slabcast_render::kernels::pixel_records::Splat;
use slabcast_render::kernels::toss::*;
use slabcast_render::primitives::positions::Places;
use slabcast_render::scene::{Frame, Scene};
use slabcast_render::selftest;
use slabcast_render::visibility::open_mask::OpenMask;
use std::sync::Arc;

/// A picture of 64x64 of 16x16x16 voxels, seen from anywhere.
fn frame(to_eye: DVec3, height: f64, thickness: f64) -> Frame {
    let volume = Volume::from_fn_u8("any", [16; 3], |i, j, k| (i + 3 * j + 7 * k) as u8);
    let quality = Quality { thickness, ..Quality::before() };
    let spec = selftest::spec(&volume, quality);
    let projection = CameraProjection::Ortho { height };
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
    ) {
        let frame = frame(DVec3::from_array(eye), height, thickness);
        let Some(flat) = &frame.flat else { return Ok(()) };
        let brick = brick(which, share, seed, kind, shaded);
        let mut mask = OpenMask::shut(Rect::new(0, 0, 64, 64));
        open.iter().for_each(|&(y, x)| mask.open_row(y, 1 << x));
        mask.grow(flat.reach);
        let footprint = frame.footprints.at(0).expect("sheets that are all drawn");
        let sieve = Sieve {
            places: &flat.places,
            from: Places::from(frame.corner(brick.id).flat, [0; 3]),
            open: &mask,
            cull,
            sections: &frame.sections,
            sheets: [begin, begin + count],
        };
        let phases = [0, 1].map(|axis| footprint.phases(axis).expect("a table"));
        let sift = |simd| {
            let mut tossing = Tossing::default();
            let sifted = sieve.sift(simd, &brick, &phases, &mut tossing);
            let voxel = |(first, v): (&i32, &Splat)| (*first, v.place, v.rows, v.deep, v.sample);
            (sifted, tossing.ready(sifted.kept).map(voxel).collect::<Vec<_>>())
        };
        let want = sift(Simd::plain());
        prop_assert!(want.0.kept <= want.0.reached && want.0.reached <= brick.len());
        for simd in simds() {
            prop_assert_eq!(&sift(simd), &want, "{}", simd.name());
        }
    }
}
