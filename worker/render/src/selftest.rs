//! A small picture whose hash every worker sends in its hello.
//!
//! The master refuses a worker whose hash differs from `slabcast_common::SELF_TEST_SHA256`, and
//! names both hashes. So a machine, a compiler or a build that rounds differently is found before
//! it spoils a picture.

use crate::kernels::Simd;
use crate::scene::{Frame, Scene};
use crate::tile::{self, Scratch};
use glam::DVec3;
use slabcast_common::brick::{BRICK_EDGE, Brick, BrickGrid};
use slabcast_common::ids::{BrickId, SceneId};
use slabcast_common::image::FrameState;
use slabcast_common::message::SceneSpec;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::shade::{Light, Shading, encode_normal};
use slabcast_common::slab::SheetRange;
use slabcast_common::transfer::{ColorSpace, Domain, NanColour, OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Samples, Volume};
use std::sync::Arc;

/// The self-test's transfer function, over 8-bit values: the preset `peer-vessels`, written out so
/// that the renderer depends on no presets.
fn vessels() -> TransferFunction {
    TransferFunction {
        version: 1,
        domain: Domain::Value,
        colors: vec![
            [0.0, 0.7, 0.1, 0.1],
            [60.0, 0.8, 0.2, 0.15],
            [160.0, 0.95, 0.45, 0.35],
            [255.0, 1.0, 0.9, 0.8],
        ],
        opacities: vec![[0.0, 0.0], [60.0, 0.0], [120.0, 0.8], [255.0, 1.0]],
        color_space: ColorSpace::Srgb,
        opacity_unit: OpacityUnit::AlphaPerVox,
        nan: NanColour::default(),
        gradient_opacity: Vec::new(),
        shading: Shading {
            on: true,
            ambient: 0.2,
            diffuse: 0.7,
            specular: 0.1,
            power: 20.0,
            light: Light::Head,
        },
    }
}

/// Describes `volume` as a scene with the preset `peer-vessels` (three colours, lit). For tests and
/// examples.
pub fn spec(volume: &Volume, quality: Quality) -> SceneSpec {
    SceneSpec {
        id: SceneId(0),
        volume: volume.info(Digest32::default()),
        transfer: vessels(),
        quality,
        crop: None,
        bricks: Default::default(),
    }
}

/// Draws the self-test with instruction set `simd` and returns its SHA-256: a lit ball with a hole,
/// 24 voxels wide, in perspective and orthographic, with integer and float sums, in two slabs.
pub fn run(simd: Simd) -> Digest32 {
    let n = 24u32;
    let volume = Volume::from_fn_u8("selftest", [n; 3], |i, j, k| {
        let d = [i, j, k].map(|x| 2 * x as i32 - (n as i32 - 1));
        let r2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
        let hole = (d[0] - 6) * (d[0] - 6) + d[2] * d[2] < 30;
        if hole { 0 } else { (260 - r2 / 2).clamp(0, 255) as u8 }
    });
    let bricks = bricks_of(&volume);
    let mut hashes = Vec::new();
    let persp = CameraProjection::Persp { fov: 35.0, distance: 50.0 };
    // Orthographic views have kernels of their own.
    let ortho = CameraProjection::Ortho { height: 30.0 };
    let ways = [
        (Sums::I32, persp),
        (Sums::F32, persp),
        (Sums::I16, persp),
        (Sums::I16, ortho),
        (Sums::I32, ortho),
    ];
    for (sums, projection) in ways {
        let quality = Quality { sums, ..Quality::before() };
        let spec = spec(&volume, quality);
        let camera = Camera {
            to_eye: DVec3::new(0.6, 1.0, 0.4),
            up: DVec3::Z,
            target: DVec3::ZERO,
            projection,
        };
        let size = [80, 72];
        let view = View::new(&volume.lattice, &camera, size, &quality).expect("a good view");
        let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
        let mut state = FrameState::new(size);
        let mut scratch = Scratch::default();
        let rect = Rect::from_size(size);
        for slab in [SheetRange::new(-40, 3), SheetRange::new(3, 40)] {
            let from = state.tile_state(rect);
            let (pixels, _) = tile::render(&frame, simd, rect, slab, &bricks, &from, &mut scratch);
            state.add_slab_tile(rect, &pixels);
            state.end_slab();
        }
        hashes.extend(state.to_picture().sha256().0);
    }
    use sha2::{Digest, Sha256};
    Digest32(Sha256::digest(&hashes).into())
}

/// Cuts an 8-bit volume into bricks of all voxels that are not zero, with normals. For tests and
/// examples.
///
/// # Panics
/// If samples are not of 8 bits.
pub fn bricks_of(volume: &Volume) -> Vec<Arc<Brick>> {
    let grid = BrickGrid::new(volume.lattice.dims);
    let Samples::U8(samples) = &volume.samples else { unreachable!("made above") };
    let [nx, ny, _] = volume.lattice.dims.map(|n| n as usize);
    let matrix = volume.gradient_matrix();
    (0..grid.len() as u32)
        .filter_map(|id| {
            let corner = grid.corner(BrickId(id));
            let (mut index, mut values, mut normals) = (Vec::new(), Vec::new(), Vec::new());
            for l in 0..512u16 {
                let p: [u32; 3] = std::array::from_fn(|a| {
                    corner[a] + slabcast_common::brick::local_position(l)[a]
                });
                if (0..3).any(|a| p[a] >= volume.lattice.dims[a]) {
                    continue;
                }
                let code = samples[(p[2] as usize * ny + p[1] as usize) * nx + p[0] as usize];
                if code > 0 {
                    index.push(l);
                    values.push(code);
                    normals.push(encode_normal(volume.gradient(p, &matrix)));
                }
            }
            debug_assert!(corner.iter().all(|c| c % BRICK_EDGE == 0));
            (!index.is_empty()).then(|| {
                Arc::new(Brick::new(BrickId(id), index, Samples::U8(values), Some(normals)))
            })
        })
        .collect()
}
