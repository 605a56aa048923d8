//! Scenes without samples and a renderer without splats: a pure function of view, slab, bricks
//! and tile state, with the one property that the schedule relies on. A slab goes on from where
//! the last one stopped, and nothing is drawn where no brick is or where a pixel is shut.

use crate::rng::Rng;
use slabcast_common::brick::{BRICK_EDGE, BrickGrid, BrickInfo, BrickSetKey, TightBox};
use slabcast_common::ids::{BrickId, FrameId, SceneId};
use slabcast_common::image::{
    Background, FrameState, Picture, PixelEncoding, PixelFormat, TilePixels, TileState,
};
use slabcast_common::message::SceneSpec;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Quality, Work};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Camera, CameraProjection, Projected, View};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_scene::presets;
use slabcast_schedule::{FrameJob, is_shut};
use std::collections::BTreeMap;
use std::sync::Arc;

pub(crate) fn key(n: u8) -> BrickSetKey {
    BrickSetKey(Digest32([n; 32]))
}

/// A volume of `dims` in which about `fill` of 8 bricks are relevant.
pub(crate) fn bricks(rng: &mut Rng, dims: [u32; 3], fill: u64) -> Arc<[BrickInfo]> {
    let grid = BrickGrid::new(dims);
    let mut bricks = Vec::new();
    for id in (0..grid.len() as u32).map(BrickId) {
        if rng.below(8) >= fill {
            continue;
        }
        let corner = grid.corner(id);
        let lo: [u32; 3] = std::array::from_fn(|a| corner[a] + rng.below(3) as u32);
        let hi = std::array::from_fn(|a| (corner[a] + BRICK_EDGE - 1).min(dims[a] - 1).max(lo[a]));
        let voxels = 1 + rng.below(512) as u16;
        let tight = TightBox { lo, hi };
        bricks.push(BrickInfo { id, tight, voxels, bytes: 11 + 3 * u32::from(voxels) });
    }
    bricks.into()
}

pub(crate) fn scene(id: u64, set: BrickSetKey, dims: [u32; 3], quality: Quality) -> Arc<SceneSpec> {
    let volume = Volume::from_fn_u8("fake", dims, |i, j, k| (i + j + k) as u8);
    let info = volume.info(Digest32([7; 32]));
    let transfer = presets::by_name("grey", &info.summary).expect("a known name");
    Arc::new(SceneSpec { id: SceneId(id), volume: info, transfer, quality, bricks: set })
}

pub(crate) fn view(rng: &mut Rng, scene: &SceneSpec, size: [u32; 2]) -> View {
    let turn = |rng: &mut Rng| rng.below(2001) as f64 / 1000.0 - 1.0;
    let lattice = &scene.volume.lattice;
    let extent = lattice.largest_extent();
    let projection = if rng.below(3) == 0 {
        CameraProjection::Persp { fov: 40.0, distance: extent * 1.4 }
    } else {
        CameraProjection::Ortho { height: extent * (0.6 + rng.below(100) as f64 / 100.0) }
    };
    let camera = Camera {
        to_eye: [turn(rng), turn(rng), 0.1 + turn(rng).abs()].into(),
        up: [0.1, 1.0, 0.2].into(),
        target: [0.0; 3].into(),
        projection,
    };
    View::new(lattice, &camera, size, &scene.quality).expect("a camera that can be drawn")
}

pub(crate) fn job(
    rng: &mut Rng,
    frame: u64,
    scene: &Arc<SceneSpec>,
    bricks: &Arc<[BrickInfo]>,
    size: [u32; 2],
    work: Work,
) -> Box<FrameJob> {
    let view = view(rng, scene, size);
    let (scene, bricks) = (scene.clone(), bricks.clone());
    // Nobody's dice: seeds stay the stories that they were.
    let finish = [None, Some(PixelFormat::Rgb8), None, Some(PixelFormat::Rgba32F)]
        [(frame % 4) as usize]
        .map(|format| PixelEncoding { format, background: Background::Colour([0.1, 0.7, 0.4]) });
    Box::new(FrameJob { frame: FrameId(frame), number: frame, scene, bricks, view, work, finish })
}

/// Where each brick of a job lands.
pub(crate) fn projections(job: &FrameJob) -> BTreeMap<BrickId, Projected> {
    job.bricks.iter().filter_map(|b| Some((b.id, job.view.project(&b.tight)?))).collect()
}

fn mix(mut x: u64) -> u64 {
    x ^= x >> 31;
    x = x.wrapping_mul(0x7fb5_d329_728e_a185);
    x ^= x >> 27;
    x = x.wrapping_mul(0x81da_def4_bc2d_d44d);
    x ^ (x >> 33)
}

/// Renders a tile of a slab.
pub(crate) fn render(
    projections: &BTreeMap<BrickId, Projected>,
    quality: &Quality,
    tile: Rect,
    slab: SheetRange,
    bricks: &[BrickId],
    state: &TileState,
) -> TilePixels {
    let n = tile.area();
    let mut a = state.a.clone();
    let mut colour = vec![[0u32; 3]; n];
    let mut last = state.last.clone().unwrap_or_else(|| vec![[0; 4]; n]);
    let mut sums = vec![0u32; n];
    for sheet in slab.first..slab.end {
        sums.fill(0);
        let one = SheetRange::new(sheet, sheet + 1);
        for id in bricks {
            let Some(p) = projections.get(id).filter(|p| p.sheets.overlaps(one)) else { continue };
            let r = p.rect.intersect(&tile);
            let h = mix(u64::from(id.0) << 20 | (sheet as u64 & 0xffff)) as u32 & 0xffff;
            for y in r.y0..r.y1 {
                let row = (y - tile.y0) as usize * tile.width();
                for x in r.x0..r.x1 {
                    sums[row + (x - tile.x0) as usize] += h;
                }
            }
        }
        for i in 0..n {
            let s = sums[i];
            if is_shut(a[i], quality.eps) {
                continue;
            }
            if s > 0 {
                let open = 1.0 - a[i];
                let bits = s ^ last[i][0].rotate_left(7);
                for (c, to) in colour[i].iter_mut().enumerate() {
                    *to = to.wrapping_add((bits >> (5 * c)) & 0xfff);
                    *to = to.wrapping_add((open * 4096.0) as u32);
                }
                a[i] += open * ((s % 251) as f32 / 512.0);
            }
            last[i] = [s, s / 3, 0, 0];
        }
    }
    let blank = last.iter().all(|l| *l == [0; 4]);
    TilePixels { a, colour, last: (!blank).then_some(last) }
}

/// The picture of a job, on one thread, plainly: the oracle.
pub(crate) fn serial(job: &FrameJob) -> Picture {
    let p = projections(job);
    let sheets = p.values().fold(SheetRange::default(), |all, p| all.union(p.sheets));
    let all: Vec<_> = job.bricks.iter().map(|b| b.id).collect();
    let whole = Rect::from_size(job.view.size);
    let mut state = FrameState::new(job.view.size);
    let pixels = render(&p, &job.scene.quality, whole, sheets, &all, &state.tile_state(whole));
    state.add_slab_tile(whole, &pixels);
    state.to_picture()
}
