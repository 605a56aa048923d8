//! Times of the stages of a frame, each in a scene where it is nearly all of the work:
//!
//! ```text
//! cargo bench -p slabcast-render                    all of them
//! cargo bench -p slabcast-render -- fog             those with this in their name
//! ```
//!
//! Items a second are what the situation is about: voxels tossed, sections added, pixels closed,
//! bricks. Every scene's picture is compared, to the bit, with that of the plain renderer before it
//! is timed.

#[path = "../tests/render/support/mod.rs"]
mod support;

use divan::Bencher;
use divan::counter::ItemsCount;
use glam::DVec3;
use slabcast_common::brick::{Brick, TightBox};
use slabcast_common::ids::SceneId;
use slabcast_common::image::{
    Background, FrameState, LEAF_EDGE, PixelEncoding, PixelFormat, SparseTile, TilePixels,
    TileState,
};
use slabcast_common::message::{Counters, SceneSpec};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Compositing, Quality, Sums};
use slabcast_common::shade::Shading;
use slabcast_common::slab::SheetRange;
use slabcast_common::transfer::{ColorSpace, Domain, NanColour, OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_render::Simd;
use slabcast_render::oracle::serial;
use slabcast_render::tile::{self, ProjectedBrick, Scratch};
use slabcast_render::{Frame, Scene};
use std::sync::Arc;
use std::time::Duration;

fn main() {
    divan::Divan::from_args().max_time(Duration::from_secs(2)).main();
}

/// A scene, its frame and the memory to draw it.
struct Stage {
    frame: Frame,
    bricks: Vec<Arc<Brick>>,
    sheets: SheetRange,
    scratch: Scratch,
}

/// Parameters of a scene; the default is a solid ball, coloured and lit, in an orthographic view.
#[derive(Clone, Copy)]
struct How {
    opacity: f64,
    shaded: bool,
    perspective: bool,
    /// Edge of the picture.
    edge: u32,
    quality: Quality,
}

impl Default for How {
    fn default() -> How {
        let quality = Quality { sums: Sums::I32, ..Quality::before() };
        How { opacity: 0.9, shaded: true, perspective: false, edge: 128, quality }
    }
}

impl How {
    fn volume() -> Volume {
        Volume::from_fn_u8("ball", [72; 3], |i, j, k| {
            let d = [i, j, k].map(|i| f64::from(i) - 35.5);
            let r = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
            if r < 34.0 { (60.0 + 5.0 * r) as u8 } else { 0 }
        })
    }

    fn stage(self) -> Stage {
        let volume = How::volume();
        let colors = vec![[0.0, 0.2, 0.4, 0.9], [255.0, 1.0, 0.8, 0.1]];
        let transfer = TransferFunction {
            version: 1,
            domain: Domain::Value,
            colors,
            opacities: vec![[0.0, 0.0], [50.0, self.opacity]],
            color_space: ColorSpace::Linear,
            opacity_unit: OpacityUnit::AlphaPerVox,
            nan: NanColour::default(),
            gradient_opacity: vec![],
            shading: Shading { on: self.shaded, ..Shading::default() },
        };
        let spec = SceneSpec {
            id: SceneId(1),
            volume: volume.info(Digest32::default()),
            transfer,
            quality: self.quality,
            crop: None,
            bricks: Default::default(),
        };
        let projection = if self.perspective {
            CameraProjection::Persp { fov: 30.0, distance: 170.0 }
        } else {
            CameraProjection::Ortho { height: 90.0 }
        };
        let to_eye = DVec3::new(0.53, 0.71, 0.36);
        let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection };
        let view =
            View::new(&volume.lattice, &camera, [self.edge; 2], &spec.quality).expect("a view");
        let whole = TightBox::whole(volume.lattice.dims);
        let sheets = view.project(&whole).expect("in sight").sheets;
        let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
        Stage { frame, bricks: support::bricks_of(&volume), sheets, scratch: Scratch::default() }
    }
}

impl Stage {
    /// Draws the picture as four tiles; returns their pixels and the voxel counts.
    fn draw(&mut self) -> (Vec<(Rect, TilePixels)>, Counters) {
        let mut counters = Counters::default();
        let half = self.frame.view.size[0] as i32 / 2;
        let tiles = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(x, y)| {
            let rect = Rect::new(x * half, y * half, (x + 1) * half, (y + 1) * half);
            let state = TileState { a: vec![0.0; rect.area()], last: None };
            let (pixels, n) = tile::render(
                &self.frame,
                Simd::detect(),
                rect,
                self.sheets,
                &self.bricks,
                &state,
                &mut self.scratch,
            );
            counters.tossed += n.tossed;
            counters.splatted += n.splatted;
            counters.culled += n.culled;
            (rect, pixels)
        });
        (tiles.into(), counters)
    }

    /// Times drawing, after a comparison of the picture with the serial oracle's.
    fn bench(mut self, bencher: Bencher<'_, '_>, items: impl Fn(Counters) -> u64) {
        let (tiles, counters) = self.draw();
        let mut state = FrameState::new(self.frame.view.size);
        for (rect, pixels) in tiles {
            state.add_slab_tile(rect, &pixels);
        }
        let plain = serial::render(&self.frame, &self.bricks);
        assert_eq!(state.to_picture().sha256(), plain.sha256(), "the plain renderer's picture");
        let items = items(counters);
        assert!(items > 0, "{counters:?}: something to do");
        bencher.counter(ItemsCount::new(items)).bench_local(|| self.draw());
    }
}

/// Nearly all voxels are tossed and never seen: what a hidden voxel costs.
#[divan::bench]
fn toss_solid_ball_with_only_the_skin_visible(bencher: Bencher<'_, '_>) {
    let quality = Quality { cull: true, ..How::default().quality };
    How { quality, ..How::default() }.stage().bench(bencher, |c| c.tossed);
}

/// Every voxel is added, nothing shuts: what a voxel's sections cost.
#[divan::bench]
fn splat_fog_rgb(bencher: Bencher<'_, '_>) {
    How { opacity: 0.004, ..How::default() }.stage().bench(bencher, |c| c.splatted);
}

/// Fog without lighting.
#[divan::bench]
fn splat_fog_unlit(bencher: Bencher<'_, '_>) {
    How { opacity: 0.004, shaded: false, ..How::default() }.stage().bench(bencher, |c| c.splatted);
}

/// Fog in 16-bit sums.
#[divan::bench]
fn splat_fog_16_bit_sums(bencher: Bencher<'_, '_>) {
    let quality = Quality { sums: Sums::I16, ..Quality::before() };
    How { opacity: 0.004, quality, ..How::default() }.stage().bench(bencher, |c| c.splatted);
}

/// Fog in float sums, which are added in one order.
#[divan::bench]
fn splat_fog_float_sums(bencher: Bencher<'_, '_>) {
    let quality = Quality { sums: Sums::F32, ..Quality::before() };
    How { opacity: 0.004, quality, ..How::default() }.stage().bench(bencher, |c| c.splatted);
}

/// Fog in perspective, where footprints have many sizes.
#[divan::bench]
fn splat_fog_perspective(bencher: Bencher<'_, '_>) {
    How { opacity: 0.004, perspective: true, ..How::default() }
        .stage()
        .bench(bencher, |c| c.splatted);
}

/// Five pixels a voxel: closing is what grows. Items are sheets times pixels.
#[divan::bench]
fn composite_magnified_ball(bencher: Bencher<'_, '_>) {
    magnified(Compositing::Linear, bencher);
}

/// Compositing by the constant colour rule.
#[divan::bench]
fn composite_constant_colour_rule(bencher: Bencher<'_, '_>) {
    magnified(Compositing::Constant, bencher);
}

fn magnified(compositing: Compositing, bencher: Bencher<'_, '_>) {
    let quality = Quality { compositing, ..How::default().quality };
    let stage = How { opacity: 0.004, edge: 448, quality, ..How::default() }.stage();
    let pixels = stage.sheets.len() as u64 * 448 * 448;
    stage.bench(bencher, |_| pixels);
}

/// Sheets of a quarter of a vox: a voxel has more sections than a record, and goes the general way.
#[divan::bench]
fn splat_fog_more_sections_than_a_record(bencher: Bencher<'_, '_>) {
    let quality = Quality { thickness: 0.25, ..How::default().quality };
    How { opacity: 0.004, quality, ..How::default() }.stage().bench(bencher, |c| c.splatted);
}

/// Set-up of a frame: bricks are projected and sorted.
#[divan::bench]
fn project_and_sort_bricks(bencher: Bencher<'_, '_>) {
    let stage = How::default().stage();
    let look = || -> Vec<ProjectedBrick> {
        stage.bricks.iter().filter_map(|b| ProjectedBrick::new(&stage.frame, b)).collect()
    };
    let seen = look();
    let order = ProjectedBrick::front_to_back(&seen);
    let firsts = order.iter().map(|s| s.projected.sheets.first);
    assert!(firsts.is_sorted() && seen.len() == stage.bricks.len());
    bencher.counter(ItemsCount::new(seen.len())).bench_local(|| {
        let seen = look();
        ProjectedBrick::front_to_back(&seen).len()
    });
}

/// A tile is converted to bytes of a picture; every fourth leaf of it is empty. Items are pixels.
#[divan::bench(args = [(PixelFormat::Rgb8, [0.0; 3]), (PixelFormat::Rgb8, [1.0; 3]), (PixelFormat::Rgba8, [0.0; 3])])]
fn finish_tile(bencher: Bencher<'_, '_>, (format, background): (PixelFormat, [f64; 3])) {
    const EDGE: usize = 64;
    let mut x = 7u32;
    let mut next = || {
        x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        x >> 4
    };
    let there = |i: usize| !(i % EDGE / LEAF_EDGE + i / EDGE / LEAF_EDGE).is_multiple_of(4);
    let a = (0..EDGE * EDGE).map(|i| if there(i) { 0.5 } else { 0.0 }).collect();
    let colour = |i| if there(i) { [next(), next(), next()] } else { [0; 3] };
    let pixels = TilePixels { a, colour: (0..EDGE * EDGE).map(colour).collect(), last: None };
    let (tile, size) = (Rect::new(0, 0, EDGE as i32, EDGE as i32), [EDGE as u32; 2]);
    let finish = PixelEncoding { format, background: Background::Colour(background) };
    let leaves = || SparseTile::encode(&pixels, size, &finish);
    let (mut sums, mut done) = (FrameState::new(size), FrameState::new(size));
    sums.add_slab_tile(tile, &pixels);
    done.place_encoded(tile, leaves());
    let plain = sums.to_picture().encode(format, finish.background);
    assert!(done.encode(&finish, false).bytes == plain, "the bytes of the finished picture");
    bencher.counter(ItemsCount::new(EDGE * EDGE)).bench_local(leaves);
}

/// Bricks encoded for the wire.
#[divan::bench]
fn encode_bricks(bencher: Bencher<'_, '_>) {
    let bricks = support::bricks_of(&How::volume());
    let mut out = Vec::new();
    for brick in &bricks {
        out.clear();
        brick.encode(&mut out);
        let back = Brick::decode(&out).expect("a brick");
        assert!(back.index == brick.index && back.values == brick.values);
    }
    bencher.counter(ItemsCount::new(bricks.len())).bench_local(|| {
        out.clear();
        for brick in &bricks {
            brick.encode(&mut out);
        }
        out.len()
    });
}

/// Bricks decoded from the wire, checksums included.
#[divan::bench]
fn decode_bricks(bencher: Bencher<'_, '_>) {
    let bricks = support::bricks_of(&How::volume());
    let encoded: Vec<Vec<u8>> = bricks
        .iter()
        .map(|brick| {
            let mut out = Vec::new();
            brick.encode(&mut out);
            out
        })
        .collect();
    let voxels: usize = bricks.iter().map(|b| b.len()).sum();
    let back = || encoded.iter().map(|b| Brick::decode(b).expect("a brick").len()).sum::<usize>();
    assert_eq!(back(), voxels);
    bencher.counter(ItemsCount::new(bricks.len())).bench_local(back);
}
