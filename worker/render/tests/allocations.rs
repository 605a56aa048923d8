//! Drawing allocates nothing once its memory has grown to the scene.
//!
//! A turn of ten views is drawn by one thread, then drawn again: the second time round every
//! tile finds the memory that it needs. What is made for a frame (its tables, its bricks as it sees
//! them) takes a number of allocations that does not hang on bricks, voxels, tiles or pixels.

#[path = "render/support/mod.rs"]
mod support;

use allocation_counter::measure;
use glam::DVec3;
use slabcast_common::brick::Brick;
use slabcast_common::ids::SceneId;
use slabcast_common::image::{TilePixels, TileState};
use slabcast_common::message::SceneSpec;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Compositing, Quality, Sums};
use slabcast_common::shade::Shading;
use slabcast_common::slab::SheetRange;
use slabcast_common::transfer::{ColorSpace, OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_render::Simd;
use slabcast_render::region::{self, BrickSupply};
use slabcast_render::tile::{self, ProjectedBrick, Scratch};
use slabcast_render::visibility::{Directory, VisibleBricks};
use slabcast_render::{Frame, Scene};
use std::sync::Arc;
use support::{bricks_of, infos_of};

/// Views of a turn.
const VIEWS: u32 = 10;
/// Edge of the pictures, and of their tiles: some have parts that are not full.
const SIZE: u32 = 200;
const TILE: i32 = 96;

/// Most allocations of a frame's own: a table each of sections, offsets, footprints (and what
/// they are made of), the bricks as it sees them and their order.
const FRAME_MOST: u64 = 64;

/// A ball of 40 voxels with a hard skin and a soft inside, so that some of it is culled.
fn ball() -> Volume {
    Volume::from_fn_u8("ball", [40; 3], |i, j, k| {
        let r = [i, j, k].map(|x| (f64::from(x) - 19.5).powi(2)).iter().sum::<f64>().sqrt();
        if r > 18.0 { 0 } else { (40.0 + r * 11.0) as u8 }
    })
}

fn transfer(unit: OpacityUnit) -> TransferFunction {
    let colors = vec![[0.0, 0.9, 0.3, 0.1], [255.0, 0.2, 0.8, 1.0]];
    let opacities = vec![[30.0, 0.0], [150.0, 0.05], [200.0, 0.9], [255.0, 0.9]];
    let (color_space, shading) = (ColorSpace::Srgb, Shading::default());
    TransferFunction { color_space, shading, ..support::transfer(colors, opacities, unit) }
}

/// Every brick is here.
struct All<'a>(&'a [Arc<Brick>]);

impl BrickSupply for All<'_> {
    fn get(&self, place: u32) -> Option<Arc<Brick>> {
        self.0.get(place as usize).cloned()
    }
}

/// Memory that one thread keeps from frame to frame.
struct Kept {
    simd: Simd,
    directory: Arc<Directory>,
    scratch: Scratch,
    pixels: TilePixels,
    blank: Vec<TileState>,
    /// Voxels of tiles with their bricks.
    drawn: u64,
    /// Voxels of tiles through all sheets, which look for theirs.
    through: u64,
}

fn tiles() -> Vec<Rect> {
    let starts = || (0..SIZE as i32).step_by(TILE as usize);
    let whole = Rect::from_size([SIZE; 2]);
    let tile = |x, y| Rect::new(x, y, x + TILE, y + TILE).intersect(&whole);
    starts().flat_map(|y| starts().map(move |x| tile(x, y))).collect()
}

/// Draws one view; how often its making and its drawing allocated.
fn draw(scene: &Arc<Scene>, view: View, bricks: &[Arc<Brick>], kept: &mut Kept) -> [u64; 2] {
    let tiles = tiles();
    kept.blank.resize_with(tiles.len(), || tile::blank(Rect::new(0, 0, 0, 0)));
    for (blank, tile) in kept.blank.iter_mut().zip(&tiles) {
        blank.a.resize(tile.area(), 0.0);
    }
    let mut made = None;
    let making = measure(|| {
        let frame = Frame::new(scene.clone(), view);
        let mut seen = Vec::with_capacity(bricks.len());
        seen.extend(bricks.iter().filter_map(|b| ProjectedBrick::new(&frame, b)));
        made = Some((frame, seen));
    });
    let (frame, seen) = made.expect("it was made");
    let mut order = Vec::new();
    let ordering = measure(|| order = ProjectedBrick::front_to_back(&seen));
    let sheets =
        seen.iter().fold(SheetRange::default(), |range, s| range.union(s.projected.sheets));
    let drawing = measure(|| {
        for (tile, blank) in tiles.iter().zip(&kept.blank) {
            let (scratch, pixels) = (&mut kept.scratch, &mut kept.pixels);
            let counted =
                tile::render_into(&frame, kept.simd, *tile, sheets, &order, blank, scratch, pixels);
            kept.drawn += counted.splatted;
        }
    });
    let mut outlook = None;
    let looking = measure(|| outlook = Some(VisibleBricks::new(&frame.view, &kept.directory)));
    let outlook = outlook.expect("it was made");
    let through = measure(|| {
        for tile in &tiles {
            let (scratch, pixels) = (&mut kept.scratch, &mut kept.pixels);
            let supply = All(bricks);
            kept.through +=
                region::draw(&frame, &outlook, &supply, kept.simd, *tile, scratch, pixels).splatted;
        }
    });
    let made = making.count_total + ordering.count_total + looking.count_total;
    [made, drawing.count_total + through.count_total]
}

#[test]
fn second_turntable_allocates_nothing_while_drawing() {
    let volume = ball();
    let bricks = bricks_of(&volume);
    let rooms = [
        ("flat", false, Sums::I16, Compositing::Linear, OpacityUnit::AlphaPerVox),
        ("flat", false, Sums::I32, Compositing::Linear, OpacityUnit::AlphaPerVox),
        ("deep", true, Sums::I16, Compositing::Linear, OpacityUnit::AlphaPerVox),
        ("deep", true, Sums::I32, Compositing::Linear, OpacityUnit::AlphaPerVox),
        ("general", false, Sums::I32, Compositing::Paper, OpacityUnit::AlphaPerVox),
        ("general", true, Sums::I32, Compositing::Constant, OpacityUnit::AlphaPerVox),
        ("general", false, Sums::F32, Compositing::Linear, OpacityUnit::Extinction),
        ("general", true, Sums::F32, Compositing::Linear, OpacityUnit::Extinction),
    ];
    for (room, persp, sums, compositing, unit) in rooms {
        let quality = Quality { sums, compositing, ..Quality::before() };
        let spec = SceneSpec {
            id: SceneId(1),
            volume: volume.info(Digest32::default()),
            transfer: transfer(unit),
            quality,
            crop: None,
            bricks: Default::default(),
        };
        let scene = Arc::new(Scene::new(&spec));
        let view = |i: u32| {
            let turn = f64::from(i) * 0.11;
            let camera = Camera {
                to_eye: DVec3::new(libm::sin(turn), libm::cos(turn), 0.4),
                up: DVec3::Z,
                target: volume.lattice.centre(),
                projection: match persp {
                    true => CameraProjection::Persp { fov: 30.0, distance: 90.0 },
                    false => CameraProjection::Ortho { height: 50.0 },
                },
            };
            View::new(&volume.lattice, &camera, [SIZE; 2], &quality).expect("a view")
        };
        let mut kept = Kept {
            simd: Simd::detect(),
            scratch: Scratch::default(),
            pixels: TilePixels::default(),
            blank: Vec::new(),
            drawn: 0,
            through: 0,
            directory: Arc::new(Directory::new(infos_of(&bricks, &scene.grid).into())),
        };
        let first: u64 = (0..VIEWS).map(|i| draw(&scene, view(i), &bricks, &mut kept)[1]).sum();
        assert!(first > 0, "{room}: the counter does not count");
        let drawn = std::mem::take(&mut kept.drawn);
        let through = std::mem::take(&mut kept.through);
        assert!(drawn > 0 && through > 0, "{room}: nothing was drawn");
        for i in 0..VIEWS {
            let [made, drawing] = draw(&scene, view(i), &bricks, &mut kept);
            let what = format!("{room}, perspective {persp}, {sums:?}, {compositing:?}, view {i}");
            println!("{what}: {made} to make it, {drawing} to draw it");
            assert_eq!(drawing, 0, "allocations while drawing: {what}");
            assert!(made <= FRAME_MOST, "{made} allocations to make a frame: {what}");
        }
        assert_eq!([kept.drawn, kept.through], [drawn, through], "{room}: the same turn again");
    }
}
