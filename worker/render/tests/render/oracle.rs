//! The tile renderer gives the bytes of the serial one, whatever the cut.
//!
//! Random small volumes with opaque, faint and empty parts; random cameras of both kinds;
//! thin and thick sheets; any tiles, slabs, instruction set, with culling and without.

use crate::support::{bricks_of, infos_of, transfer};
use glam::DVec3;
use proptest::prelude::*;
use slabcast_common::brick::Brick;
use slabcast_common::crop::CropBox;
use slabcast_common::ids::SceneId;
use slabcast_common::image::{FrameState, Picture};
use slabcast_common::math::linear_from_srgb;
use slabcast_common::message::{Counters, SceneSpec};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Classify, Compositing, Kernel, Quality, Sums};
use slabcast_common::shade::{Light, Shading};
use slabcast_common::slab::SheetRange;
use slabcast_common::transfer::{ColorSpace, Domain, OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{ColourValue, Digest32, Lattice, Palette, Samples, ValueMap, Volume};
use slabcast_render::Simd;
use slabcast_render::oracle::serial;
use slabcast_render::oracle::work_counters::count_work;
use slabcast_render::region::{BrickSupply, Region, expected_bricks};
use slabcast_render::tile::{self, Scratch};
use slabcast_render::visibility::ClosingDepths;
use slabcast_render::visibility::{Directory, VisibleBricks};
use slabcast_render::work::{self, WorkCounters};
use slabcast_render::{Frame, Scene};
use std::cell::{Cell, RefCell};
use std::sync::Arc;

fn lit(top: f64, unit: OpacityUnit) -> TransferFunction {
    let colors = vec![[0.0, 0.9, 0.3, 0.1], [255.0, 0.2, 0.8, 1.0]];
    let opacities = vec![[0.0, 0.0], [20.0, 0.002], [60.0, 0.05], [128.0, top], [255.0, top]];
    let (color_space, shading) = (ColorSpace::Srgb, Shading::default());
    TransferFunction { color_space, shading, ..transfer(colors, opacities, unit) }
}

fn tiled(
    frame: &Frame,
    simd: Simd,
    bricks: &[Arc<Brick>],
    edge: i32,
    slabs: &[SheetRange],
) -> (Picture, Counters) {
    let size = frame.view.size;
    let mut counted = Counters::default();
    let mut state = FrameState::new(size);
    let mut scratch = Scratch::default();
    for &slab in slabs {
        for y in (0..size[1] as i32).step_by(edge as usize) {
            for x in (0..size[0] as i32).step_by(edge as usize) {
                let rect = Rect::new(x, y, x + edge, y + edge).intersect(&Rect::from_size(size));
                let from = state.tile_state(rect);
                let (pixels, counters) =
                    tile::render(frame, simd, rect, slab, bricks, &from, &mut scratch);
                state.add_slab_tile(rect, &pixels);
                counted += counters;
            }
        }
        state.end_slab();
    }
    (state.to_picture(), counted)
}

/// A worker's bricks, some of which are not here yet, and some of which go again.
struct Store<'a> {
    bricks: &'a [Arc<Brick>],
    here: RefCell<Vec<bool>>,
    /// Sheets until a region is to stop; none: it is not.
    stop_in: Cell<Option<u64>>,
}

impl BrickSupply for Store<'_> {
    fn get(&self, place: u32) -> Option<Arc<Brick>> {
        let place = place as usize;
        self.here.borrow()[place].then(|| self.bricks[place].clone())
    }

    fn stops(&self) -> bool {
        self.stop_in.set(self.stop_in.get().map(|n| n.saturating_sub(1)));
        self.stop_in.get() == Some(0)
    }
}

/// The frame in regions, of whose bricks a worker holds one in `held_in` at first; one in `lost_in`
/// rounds it forgets half of them. One in `given_in` regions stops and is cut, and one of the
/// pieces is drawn as another worker's. With what was asked for and what was touched.
fn in_regions(
    frame: &Frame,
    simd: Simd,
    bricks: &[Arc<Brick>],
    edge: i32,
    ahead: u32,
    (held_in, lost_in, given_in): (u64, u64, u64),
    seed: u64,
) -> (Picture, Counters, Vec<u32>, Vec<u32>) {
    let mut state = seed | 1;
    let mut once_in = |n: u64| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state.is_multiple_of(n)
    };
    let size = frame.view.size;
    let directory = infos_of(bricks, &frame.scene.grid).into();
    // A brick a block, eight, or more than there are.
    let directory = Directory::with_blocks(directory, 3 + (seed % 3) as u32, 1 << 20);
    let outlook = VisibleBricks::new(&frame.view, &Arc::new(directory));
    let here = RefCell::new(bricks.iter().map(|_| once_in(held_in)).collect());
    let store = Store { bricks, here, stop_in: Cell::new(None) };
    let mut picture = Picture { size, pixels: vec![[0.0; 4]; (size[0] * size[1]) as usize] };
    let mut scratch = Scratch::default();
    let (mut asked, mut touched, mut counted) = (Vec::new(), Vec::new(), Counters::default());
    let mut tiles = Vec::new();
    for y in (0..size[1] as i32).step_by(edge as usize) {
        for x in (0..size[0] as i32).step_by(edge as usize) {
            let rect = Rect::new(x, y, x + edge, y + edge).intersect(&Rect::from_size(size));
            tiles.push((Region::new(&outlook, rect), rect));
        }
    }
    let depths = ClosingDepths::new(size);
    while let Some((mut region, mut rect)) = tiles.pop() {
        store.stop_in.set(once_in(given_in).then(|| 1 + seed % 40));
        loop {
            let lacks = region.advance(frame, simd, &outlook, &store, ahead, &mut scratch);
            if lacks.is_empty() && region.depth().is_none() {
                break;
            }
            if store.stop_in.take() == Some(0) {
                let share = [0.2, 0.5, 0.9][(seed % 3) as usize];
                let eps = frame.scene.quality.eps;
                if let Some((kept, given, begun)) = region.split_off(&outlook, eps, share) {
                    assert_eq!((region.tile(), kept.union(&given)), (kept, rect));
                    assert_eq!(kept.area() + given.area(), rect.area());
                    let other = Region::resume(&outlook, given, &begun).expect("it stands so");
                    assert!(other.depth().is_some() && region.depth().is_some());
                    assert!(Region::resume(&outlook, rect, &begun).is_err());
                    tiles.push((other, given));
                    rect = kept;
                }
            }
            let mut here = store.here.borrow_mut();
            if once_in(lost_in) {
                here.iter_mut().for_each(|h| *h &= once_in(2));
            }
            for &place in &lacks {
                assert!(!std::mem::replace(&mut here[place as usize], true), "it was here");
            }
            asked.extend(lacks);
        }
        let done = region.finish();
        assert!(done.touched.windows(2).all(|p| p[0] < p[1]) && done.pixels.last.is_none());
        done.record_depths(&depths);
        touched.extend(done.touched);
        counted += done.counters;
        done.pixels.write(rect, size, &mut picture.pixels);
    }
    // Who has nothing asks for what he will need before he draws it again, if nothing is hidden for
    // all of it.
    store.here.borrow_mut().fill(false);
    let rest = Rect::new(7, 0, size[0] as i32, size[1] as i32);
    let [again, of_rest] = [Rect::from_size(size), rest].map(|tile| match tile.is_empty() {
        false => expected_bricks(frame, &outlook, &store, tile, &depths),
        true => Vec::new(),
    });
    let cull = frame.scene.quality.cull;
    assert!(cull || touched.iter().all(|place| again.binary_search(place).is_ok()));
    // A brick's border does not count, but of one of which a tile has 6 pixels or fewer all do.
    let narrow = |place: u32| {
        let seen = frame.view.project(&bricks[place as usize].tight_box(&frame.scene.grid));
        let seen = seen.map_or(Rect::default(), |p| p.rect.intersect(&rest));
        seen.width().min(seen.height()) <= 6
    };
    assert!(of_rest.iter().all(|place| again.binary_search(place).is_ok() || narrow(*place)));
    let unknown = ClosingDepths::new(size);
    let nothing = expected_bricks(frame, &outlook, &store, Rect::from_size(size), &unknown);
    assert!(!cull || nothing.is_empty());
    (picture, counted, asked, touched)
}

/// The frame in tiles whose work is counted.
fn with_work(
    frame: &Frame,
    simd: Simd,
    bricks: &[Arc<Brick>],
    edge: i32,
) -> (Picture, WorkCounters) {
    let size = frame.view.size;
    let directory = Directory::new(infos_of(bricks, &frame.scene.grid).into());
    let visible = VisibleBricks::new(&frame.view, &Arc::new(directory));
    let here = RefCell::new(vec![true; bricks.len()]);
    let store = Store { bricks, here, stop_in: Cell::new(None) };
    let mut picture = Picture { size, pixels: vec![[0.0; 4]; (size[0] * size[1]) as usize] };
    let mut all = WorkCounters::new(size.map(|n| n as usize));
    let (mut scratch, mut pixels) = Default::default();
    for y in (0..size[1] as i32).step_by(edge as usize) {
        for x in (0..size[0] as i32).step_by(edge as usize) {
            let rect = Rect::new(x, y, x + edge, y + edge).intersect(&Rect::from_size(size));
            let counted =
                work::draw(frame, &visible, &store, simd, rect, true, &mut scratch, &mut pixels);
            pixels.write(rect, size, &mut picture.pixels);
            all.put(rect, &counted);
        }
    }
    (picture, all)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 120, ..ProptestConfig::default() })]

    #[test]
    fn tiles_slabs_and_regions_equal_the_serial_oracle_bit_for_bit(
        dims in (1u32..22, 1u32..22, 1u32..22),
        seed in any::<u64>(),
        // Half of the views are level, where voxels lie in rows of the picture.
        azimuth in 0.0..6.3f64, tilt in prop_oneof![Just(0.0), -1.5..1.5f64],
        persp in any::<bool>(), distance in 2.0..60.0f64,
        thickness in prop::sample::select(vec![0.25, 0.5, 1.0, 1.0, 1.0, 2.3, 40.0]),
        compositing in prop::sample::select(
            vec![Compositing::Linear, Compositing::Linear, Compositing::Constant, Compositing::Paper]),
        sums in prop::sample::select(vec![Sums::I32, Sums::I32, Sums::I16, Sums::I16, Sums::F32]),
        eps in prop::sample::select(vec![0.0, 1.0 / 512.0, 0.1]),
        top in prop::sample::select(vec![0.05, 0.9, 1.0]),
        size in (1u32..150, 1u32..110),
        edge in prop::sample::select(vec![16i32, 32, 64, 256]),
        cuts in prop::collection::vec(0.0..1.0f64, 0..5),
        spacing in prop::sample::select(vec![1.0, 1.0, 2.5]),
        skew in prop::sample::select(vec![0.0, 0.0, 0.5]),
        // Along z, or along the axis that is unlike the others: then sections lie above each other.
        up in prop::sample::select(vec![DVec3::Z, DVec3::Z, DVec3::Y]),
        zoom in prop::sample::select(vec![0.3, 1.25, 1.25, 6.0]),
        kernel in prop::sample::select(
            vec![Kernel::Gaussian, Kernel::Gaussian, Kernel::Bspline, Kernel::Tent]),
        classify in prop::sample::select(vec![Classify::After, Classify::Before]),
    ) {
        let after = classify == Classify::After;
        let (thickness, compositing, sums) = match after {
            false => (thickness, compositing, sums),
            true => (
                f64::min(thickness, 1.0),
                Compositing::Linear,
                if sums == Sums::F32 { Sums::I32 } else { sums },
            ),
        };
        // Blobs: correlated values, with empty space between.
        let hash = |i: u32, j: u32, k: u32| {
            let mut h = seed ^ (u64::from(i / 3) << 40) ^ (u64::from(j / 3) << 20) ^ u64::from(k / 2);
            h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            (h >> 33) as u8
        };
        let mut v = Volume::from_fn_u8("blobs", [dims.0, dims.1, dims.2], |i, j, k| {
            let h = hash(i, j, k);
            if h < 110 { 0 } else { h.wrapping_add((i * 7 + j * 3 + k) as u8 & 31) }
        });
        v.lattice = Lattice::from_spacing(v.lattice.dims, [1.0, spacing, 1.0]);
        v.lattice.steps[0].y = skew;
        let quality =
            Quality { thickness, eps, classify, compositing, sums, kernel, ..Quality::before() };
        let camera = Camera {
            to_eye: DVec3::new(azimuth.sin(), azimuth.cos(), tilt),
            up,
            target: DVec3::ZERO,
            projection: if persp {
                CameraProjection::Persp { fov: 40.0, distance }
            } else {
                CameraProjection::Ortho { height: zoom * v.lattice.largest_extent() }
            },
        };
        let size = [size.0, size.1];
        let unit = if sums == Sums::F32 { OpacityUnit::Extinction } else { OpacityUnit::AlphaPerVox };
        let view = View::new(&v.lattice, &camera, size, &quality).unwrap();
        let bricks = bricks_of(&v);
        let mut look = lit(top, unit);
        let lights = [Light::Key, Light::Head, Light::Direction([1.0, -0.4, 0.7])];
        look.shading.light = lights[(seed >> 1) as usize % 3];
        if after && seed & 12 == 0 {
            look.gradient_opacity = vec![[0.0, 0.1], [0.05, 0.7], [0.2, 1.0]];
        }
        // The bricks hold all voxels; `before` cuts them to the box.
        let crop = (after && seed & 6 == 0).then(|| CropBox {
            lo: DVec3::new(-2.3, f64::NEG_INFINITY, -3.1),
            hi: DVec3::new(f64::INFINITY, 2.7, 1.9),
        });
        let make = |cull| {
            let spec = SceneSpec {
                id: SceneId(1),
                volume: v.info(Digest32::default()),
                transfer: look.clone(),
                quality: Quality { cull, ..quality },
                crop,
                bricks: Default::default(),
            };
            Frame::new(Arc::new(Scene::new(&spec)), view)
        };
        let frame = make(true);
        let (want, want_work) = count_work(&frame, &bricks);
        prop_assert!(want.pixels.iter().flatten().all(|x| x.is_finite() && (0.0..=1.0001).contains(x)));
        let run = bricks.iter().filter_map(|b| view.project(&b.tight_box(&frame.scene.grid)))
            .fold(SheetRange::default(), |r, p| r.union(p.sheets));
        let mut at: Vec<i32> = cuts.iter()
            .map(|c| run.first + (c * f64::from(run.len())) as i32).collect();
        at.extend([run.first, run.end]);
        at.sort_unstable();
        at.dedup();
        let slabs: Vec<SheetRange> = at.windows(2).map(|w| SheetRange::new(w[0], w[1])).collect();
        let (got, _) = tiled(&frame, Simd::detect(), &bricks, edge, &slabs);
        let off = got.pixels.iter().zip(&want.pixels).position(|(a, b)| a != b);
        let pixel = off.map(|i| (i, got.pixels[i], want.pixels[i]));
        prop_assert!(pixel.is_none(), "{} slabs, {edge} pixel tiles: got, want {pixel:?}", slabs.len());
        let (got, _) = tiled(&make(false), Simd::plain(), &bricks, 64, &[run]);
        prop_assert!(got == want, "without culling");
        let (got, counted) = tiled(&frame, Simd::detect(), &bricks, edge, &[run]);
        prop_assert!(got == want, "in one slab");

        let same = with_work(&frame, Simd::detect(), &bricks, edge) == (want.clone(), want_work.clone());
        prop_assert!(same, "in tiles whose work is counted");
        let same = with_work(&make(false), Simd::plain(), &bricks, 64) == (want.clone(), want_work);
        prop_assert!(same, "counted without culling");

        // All bricks here, none here at first, and coming and going; tiles handed over with what is
        // drawn of them.
        let simd = Simd::detect();
        let never = 1 << 40;
        let worlds = [(1, never, never, 8), (3, never, never, 0), (2, 4, never, 3), (1, never, 1, 0), (2, 4, 2, 3)];
        for (held_in, lost_in, given_in, ahead) in worlds {
            let holds = (held_in, lost_in, given_in);
            let whole = held_in == 1 && given_in == never;
            let (got, counters, asked, touched) =
                in_regions(&frame, simd, &bricks, edge, ahead, holds, seed);
            prop_assert!(got == want, "in regions of {edge} pixels, {holds:?}");
            // Who looks at fewer bricks draws from the same ones.
            let figures = |c: &Counters| [c.tossed, c.splatted];
            prop_assert!(!whole || figures(&counters) == figures(&counted));
            prop_assert!(held_in > 1 || asked.is_empty());
            if ahead == 0 && lost_in == never && given_in == never {
                prop_assert!(asked.iter().all(|a| touched.contains(a)), "asked for in vain");
            }
            let frame = make(false);
            let (got, ..) = in_regions(&frame, Simd::plain(), &bricks, edge, ahead, holds, seed);
            prop_assert!(got == want, "in regions without culling");
        }
    }
}

/// Values of a float volume that nobody sane would draw.
#[test]
fn nan_infinite_and_huge_samples_give_finite_pixels() {
    let wild = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e-42, 3e38, -3e38, 5.0, 0.5];
    let samples: Vec<f32> = (0..1000).map(|i| wild[i * 7 % 8]).collect();
    let lattice = Lattice::from_spacing([10; 3], [1e-9; 3]);
    let v = Volume::new("wild", "float", false, lattice, Samples::F32(samples), ValueMap::IDENTITY);
    let mut tf = lit(1.0, OpacityUnit::AlphaPerVox);
    tf.domain = Domain::Unit;
    tf.opacities = vec![[0.0, 0.3], [1.0, 1.0]];
    tf.nan.opacity = 0.2;
    let quality = Quality { sums: Sums::I32, ..Quality::before() };
    let spec = SceneSpec {
        id: SceneId(1),
        volume: v.info(Digest32::default()),
        transfer: tf,
        quality,
        crop: None,
        bricks: Default::default(),
    };
    let camera = Camera {
        to_eye: DVec3::new(1.0, 2.0, 0.5),
        up: DVec3::Z,
        target: DVec3::ZERO,
        projection: CameraProjection::Ortho { height: 2e-8 },
    };
    let view = View::new(&v.lattice, &camera, [60, 60], &quality).unwrap();
    let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
    let picture = serial::render(&frame, &bricks_of(&v));
    assert!(picture.pixels.iter().flatten().all(|x| x.is_finite()));
    assert!(picture.pixels.iter().any(|p| p[3] > 0.9));
}

/// A ball of red, green, blue and white parts in black. The same values with a transfer function that
/// has these colours are another way to say it.
#[test]
fn colours_of_a_palette_are_drawn_as_a_function_with_the_same_colours_is() {
    let colours: [[u8; 3]; 5] = [[0; 3], [10, 30, 255], [255, 0, 20], [0, 200, 90], [255; 3]];
    let palette: Vec<[u8; 4]> = colours.iter().map(|&[r, g, b]| [r, g, b, 255]).collect();
    let palette = Palette::new(palette, false, ColourValue::Luminance).expect("they ascend");
    let palette = Arc::new(palette);
    let n = 20u32;
    let place = |i: u32, j: u32, k: u32| {
        let d = [i, j, k].map(|x| f64::from(x) - 9.5);
        let inside = d.iter().map(|x| x * x).sum::<f64>() < 64.0;
        if inside { 1 + (i / 4 + j / 4 + k / 4) as u16 % 4 } else { 0 }
    };
    let places: Vec<u16> = (0..n * n * n).map(|at| place(at % n, at / n % n, at / n / n)).collect();
    let lattice = Lattice::from_spacing([n; 3], [1.0; 3]);
    let coloured =
        Volume::coloured("c", "RGB uint8", false, lattice, palette.clone(), places).unwrap();
    let grey =
        Volume::new("g", "uint8", false, lattice, coloured.samples.clone(), ValueMap::IDENTITY);
    for (top, shading) in [(1.0, Shading::default()), (0.2, Shading::default())] {
        let look = TransferFunction {
            color_space: ColorSpace::Srgb,
            shading,
            ..transfer(
                palette
                    .colours()
                    .iter()
                    .map(|&c| {
                        let [r, g, b] = [c[0], c[1], c[2]].map(|x| f64::from(x) / 255.0);
                        [f64::from(palette.value().of(c)), r, g, b]
                    })
                    .collect(),
                vec![[0.0, 0.0], [20.0, top]],
                OpacityUnit::AlphaPerVox,
            )
        };
        // The colours of the function do not count where voxels have their own.
        let other = TransferFunction { colors: vec![[0.0, 0.1, 0.9, 0.4]], ..look.clone() };
        for projection in [
            CameraProjection::Ortho { height: 24.0 },
            CameraProjection::Persp { fov: 40.0, distance: 40.0 },
        ] {
            let camera = Camera {
                to_eye: DVec3::new(0.3, 1.0, 0.4),
                up: DVec3::Z,
                target: DVec3::ZERO,
                projection,
            };
            let draw = |v: &Volume, transfer: &TransferFunction, quality: Quality| {
                let spec = SceneSpec {
                    id: SceneId(1),
                    volume: v.info(Digest32::default()),
                    transfer: transfer.clone(),
                    quality,
                    crop: None,
                    bricks: Default::default(),
                };
                let drawn = quality.for_volume(&spec.volume.summary);
                let view = View::new(&v.lattice, &camera, [70, 60], &drawn).unwrap();
                let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
                let bricks = bricks_of(v);
                let whole = bricks
                    .iter()
                    .filter_map(|b| view.project(&b.tight_box(&frame.scene.grid)))
                    .fold(SheetRange::default(), |r, p| r.union(p.sheets));
                let want = serial::render(&frame, &bricks);
                for (simd, edge) in [(Simd::detect(), 16), (Simd::plain(), 64)] {
                    assert!(tiled(&frame, simd, &bricks, edge, &[whole]).0 == want);
                }
                want
            };
            for sums in [Sums::I16, Sums::I32] {
                let quality = Quality { sums, ..Quality::before() };
                let want = draw(&grey, &look, quality);
                assert!(want.pixels.iter().any(|p| p[0] > 2.0 * p[1] && p[3] > 0.5), "some red");
                assert!(draw(&coloured, &other, quality) == want, "{top} {projection:?} {sums:?}");
                let after = Quality { sums, ..Quality::default() };
                assert!(draw(&coloured, &other, after) == want, "never classified after");
            }
        }
    }
}

/// Colour of an opaque block, unlit: its own.
#[test]
fn opaque_colours_are_seen_as_they_are() {
    let rgb = [200u8, 90, 30];
    let palette = vec![[rgb[0], rgb[1], rgb[2], 255]];
    let palette = Palette::new(palette, false, ColourValue::Luminance).unwrap();
    let lattice = Lattice::from_spacing([16; 3], [1.0; 3]);
    let v = Volume::coloured("c", "RGB uint8", false, lattice, palette.into(), vec![0; 4096]);
    let v = v.unwrap();
    let look = transfer(vec![[0.0; 4]], vec![[0.0, 1.0]], OpacityUnit::AlphaPerVox);
    let quality = Quality { sums: Sums::I32, ..Quality::before() };
    let spec = SceneSpec {
        id: SceneId(1),
        volume: v.info(v.digest()),
        transfer: look,
        quality,
        crop: None,
        bricks: Default::default(),
    };
    let camera = Camera {
        to_eye: DVec3::new(0.2, 1.0, 0.1),
        up: DVec3::Z,
        target: DVec3::ZERO,
        projection: CameraProjection::Ortho { height: 20.0 },
    };
    let view = View::new(&v.lattice, &camera, [41, 41], &quality).unwrap();
    let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
    let picture = serial::render(&frame, &bricks_of(&v));
    let middle = picture.pixels[20 * 41 + 20];
    let want = rgb.map(|c| linear_from_srgb(f64::from(c) / 255.0));
    for c in 0..3 {
        let off = (f64::from(middle[c] / middle[3]) - want[c]).abs();
        assert!(off < 0.5 / 255.0, "channel {c}: {middle:?}, not {want:?}");
    }
    assert!(middle[3] > 0.99);
}
