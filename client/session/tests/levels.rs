//! Tests of coarser levels of detail against closed forms: opacity, gradients and light are the
//! same at each level.

use glam::DVec3;
use slabcast_common::brick::Brick;
use slabcast_common::ids::SceneId;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::shade::Shading;
use slabcast_common::transfer::{ColorSpace, Domain, NanColour, OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Lattice, Samples, ValueMap, Volume};
use slabcast_render::oracle::serial;
use slabcast_render::{Frame, Scene};
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_volumes::BrickStore;
use slabcast_volumes::blocks::coarser;
use std::sync::Arc;

/// Edge of the volumes in samples of level 0; a multiple of 4, so that levels 1 and 2 halve it
/// without a rest.
const N: u32 = 32;
/// Pixels a vox of level 0.
const SCALE: u32 = 2;

/// Returns an unlit transfer function over values, with `colors` (value, linear RGB) and
/// `opacities` (value, opacity in `unit`).
fn transfer(
    colors: Vec<[f64; 4]>,
    opacities: Vec<[f64; 2]>,
    opacity_unit: OpacityUnit,
) -> TransferFunction {
    TransferFunction {
        version: 1,
        domain: Domain::Value,
        colors,
        opacities,
        color_space: ColorSpace::Linear,
        opacity_unit,
        nan: NanColour::default(),
        gradient_opacity: vec![],
        shading: Shading { on: false, ..Shading::default() },
    }
}

/// Returns levels 0, 1 and 2 of the volume `f(i, j, k)`: 16-bit codes, 0.5 world units a sample at
/// level 0.
fn levels(f: impl Fn(u32, u32, u32) -> u16) -> Vec<Volume> {
    let all = (0..N.pow(3)).map(|n| f(n % N, n / N % N, n / N / N)).collect();
    let lattice = Lattice::from_spacing([N; 3], [0.5; 3]);
    let volume = Volume::new("v", "uint16", false, lattice, Samples::U16(all), ValueMap::IDENTITY);
    std::iter::successors(Some(volume), coarser).take(3).collect()
}

/// Draws a level along z at two pixels a vox of level 0. Returns the linear RGBA of each pixel.
fn draw(
    volume: &Volume,
    finest: &Lattice,
    tf: &TransferFunction,
    quality: Quality,
) -> Vec<[f32; 4]> {
    let info = volume.info(Digest32::default());
    let needs = BrickNeeds::for_transfer(tf, &info, &quality);
    let store = BrickStore::build(volume, info.digest, &needs);
    let brick = |i: &slabcast_common::brick::BrickInfo| store.brick(i.id).expect("it is there");
    let bricks: Vec<Arc<Brick>> = store.infos().iter().map(brick).collect();
    let spec = SceneSpec {
        id: SceneId(1),
        volume: info.clone(),
        transfer: tf.clone(),
        quality,
        crop: None,
        bricks: store.key(),
    };
    let camera = Camera {
        to_eye: DVec3::Z,
        up: DVec3::Y,
        target: -finest.to_centre_of(&info.lattice),
        projection: CameraProjection::Ortho { height: 0.5 * f64::from(N) },
    };
    let view = View::new(&info.lattice, &camera, [SCALE * N; 2], &quality).expect("a camera");
    let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
    serial::render(&frame, &bricks).pixels
}

/// Returns each level's largest difference from `want(x)`, in 1/255, over the pixels whose x and y
/// lie within `from..to`.
fn off(
    levels: &[Volume],
    tf: &TransferFunction,
    quality: Quality,
    (from, to): (u32, u32),
    channel: usize,
    want: impl Fn(f64) -> f64,
) -> Vec<f64> {
    let size = SCALE * N;
    let of = |volume: &Volume| {
        let pixels = draw(volume, &levels[0].lattice, tf, quality);
        let inside = (from..to).flat_map(|y| (from..to).map(move |x| (x, y)));
        let difference = inside.map(|(x, y)| {
            // Position of the pixel's centre in samples of level 0.
            let at = (f64::from(x) + 0.5) / f64::from(SCALE) - 0.5;
            let got = f64::from(pixels[(y * size + x) as usize][channel]);
            255.0 * (got - want(at)).abs()
        });
        difference.fold(0.0, f64::max)
    };
    levels.iter().map(of).collect()
}

fn white() -> Vec<[f64; 4]> {
    vec![[0.0, 1.0, 1.0, 1.0], [65535.0, 1.0, 1.0, 1.0]]
}

fn precise(quality: Quality) -> Quality {
    Quality { eps: 0.0, sums: Sums::I32, ..quality }
}

#[test]
fn constant_cube_has_the_same_opacity_at_each_level() {
    // One other sample, so that there is a range of values; its block of level 2 is left out.
    let cube = levels(|i, j, k| if [i, j, k] == [0; 3] { 0 } else { 1000 });
    let steps = |top| vec![[0.0, 0.0], [400.0, 0.0], [401.0, top], [1000.0, top]];
    let (alpha, depth) = (0.03, f64::from(N));
    let want = 1.0 - libm::pow(1.0 - alpha, depth);
    let extinction = -libm::log1p(-alpha) / 0.5;
    for (opacity, unit) in
        [(alpha, OpacityUnit::AlphaPerVox), (extinction, OpacityUnit::Extinction)]
    {
        let tf = transfer(white(), steps(opacity), unit);
        let off_after = off(&cube, &tf, precise(Quality::default()), (16, 62), 3, |_| want);
        assert!(off_after.iter().all(|&off| off < 0.1), "{unit:?}: {off_after:?}");
        // The Gaussian ripples by 0.6 % and fades at the faces, so the bound is wider.
        let off_before = off(&cube, &tf, precise(Quality::before()), (24, 48), 3, |_| want);
        assert!(off_before.iter().all(|&off| off < 2.0), "{unit:?}: {off_before:?}");
    }
    // Alpha one stays opaque.
    let solid = transfer(white(), steps(1.0), OpacityUnit::AlphaPerVox);
    let open = off(&cube, &solid, precise(Quality::default()), (16, 62), 3, |_| 1.0);
    assert!(open.iter().all(|&off| off < 0.01), "{open:?}");
}

#[test]
fn ramp_has_the_same_opacity_at_each_level() {
    // Means of an even number of samples are whole.
    let ramp = levels(|i, _, _| (64 * i) as u16);
    let top = 64.0 * f64::from(N);
    let tf = transfer(white(), vec![[0.0, 0.0], [top, 0.06]], OpacityUnit::AlphaPerVox);
    let want = |x: f64| 1.0 - libm::pow(1.0 - 0.06 * 64.0 * x / top, f64::from(N));
    let off = off(&ramp, &tf, precise(Quality::default()), (16, 48), 3, want);
    assert!(off.iter().all(|&off| off < 0.2), "{off:?}");
}

#[test]
fn opacity_by_gradient_is_the_same_at_each_level() {
    let ramp = levels(|i, _, _| (64 * i) as u16);
    let top = 64.0 * f64::from(N);
    // The ramp changes by 1/31 of its range over a vox of level 0.
    let share = 1.0 / f64::from(N - 1);
    let mut tf = transfer(white(), vec![[0.0, 0.05], [top, 0.05]], OpacityUnit::AlphaPerVox);
    tf.domain = Domain::Unit;
    tf.opacities = vec![[0.0, 0.05], [1.0, 0.05]];
    tf.colors = vec![[0.0, 1.0, 1.0, 1.0]];
    tf.gradient_opacity = vec![[0.0, 0.0], [2.0 * share, 1.0]];
    let want = 1.0 - libm::pow(1.0 - 0.05, 0.5 * f64::from(N));
    for (quality, from, most) in [(Quality::default(), 16, 1.0), (Quality::before(), 24, 4.0)] {
        let off = off(&ramp, &tf, precise(quality), (from, 64 - from), 3, |_| want);
        assert!(off.iter().all(|&off| off < most), "{:?}: {off:?}", quality.classify);
    }
}

#[test]
fn light_is_the_same_at_each_level() {
    // The gradient is 1/500 of the range over a vox: so flat that shading turns the normal part of
    // the way towards the eye. It also rises towards the eye, so that rounding can't flip its side.
    let ramp = levels(|i, j, k| if [i, j, k] == [0; 3] { 16000 } else { (32 * i + 16 * k) as u16 });
    // The inner half alone is visible: gradients at the volume's faces are one-sided.
    let inner = vec![[0.0, 0.0], [624.0, 0.0], [656.0, 0.05], [848.0, 0.05], [880.0, 0.0]];
    let mut tf = transfer(white(), inner, OpacityUnit::AlphaPerVox);
    tf.shading =
        Shading { on: true, ambient: 0.1, diffuse: 0.8, specular: 0.0, ..Shading::default() };
    let quality = precise(Quality::default());
    let middle = |volume: &Volume| {
        let pixels = draw(volume, &ramp[0].lattice, &tf, quality);
        f64::from(pixels[(SCALE * N * SCALE * N / 2 + SCALE * N / 2) as usize][1]) * 255.0
    };
    let light: Vec<f64> = ramp.iter().map(middle).collect();
    assert!(light.iter().all(|l| (l - light[0]).abs() < 0.5), "{light:?}");
}
