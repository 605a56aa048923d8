//! The judge is judged: by closed forms, by brute force along a ray, and by the splatter, which
//! must come to the same picture when its sheets are thin.

use crate::support::{RADIUS, STD, bell, bricks_of, g, sum, transfer};
use glam::DVec3;
use slabcast_common::bounds;
use slabcast_common::brick::TightBox;
use slabcast_common::ids::SceneId;
use slabcast_common::image::{Background, Picture};
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Compositing, Kernel, Quality, Sums};
use slabcast_common::transfer::{OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Lattice, Samples, ValueMap, Volume};
use slabcast_render::judge::analytic::{Layer, LayerStack, Profile};
use slabcast_render::judge::reference::{Reference, SheetOptions};
use slabcast_render::oracle::serial;
use slabcast_render::{Frame, Scene};
use std::f64::consts::PI;
use std::sync::Arc;

pub(crate) const BLACK: Background = Background::Colour([0.0; 3]);

pub(crate) fn alpha(colors: Vec<[f64; 4]>, opacities: Vec<[f64; 2]>) -> TransferFunction {
    transfer(colors, opacities, OpacityUnit::AlphaPerVox)
}

/// A scene, its view and its volume, for the reference and for the splatter.
pub(crate) struct JudgedScene {
    pub(crate) spec: SceneSpec,
    pub(crate) view: View,
    pub(crate) volume: Volume,
}

impl JudgedScene {
    pub(crate) fn new(
        volume: Volume,
        tf: TransferFunction,
        quality: Quality,
        camera: Camera,
        n: u32,
    ) -> JudgedScene {
        let quality = Quality { eps: 0.0, ..quality };
        let spec = SceneSpec {
            id: SceneId(1),
            volume: volume.info(Digest32::default()),
            transfer: tf,
            quality,
            crop: None,
            bricks: Default::default(),
        };
        let view = View::new(&volume.lattice, &camera, [n, n], &quality).unwrap();
        JudgedScene { spec, view, volume }
    }

    pub(crate) fn reference(&self) -> Reference {
        Reference::new(&self.spec, self.view, &bricks_of(&self.volume))
    }

    pub(crate) fn splatted(&self) -> Picture {
        let frame = Frame::new(Arc::new(Scene::new(&self.spec)), self.view);
        serial::render(&frame, &bricks_of(&self.volume))
    }
}

pub(crate) fn i32_sums() -> Quality {
    Quality { sums: Sums::I32, ..Quality::before() }
}

/// From +y (x to the left, z up), 4 pixels a voxel.
fn front(volume: &Volume) -> (Camera, u32) {
    let n = 4 * (volume.lattice.dims[0].max(volume.lattice.dims[2]) + 8);
    let projection = CameraProjection::Ortho { height: f64::from(n) / 4.0 };
    (Camera { to_eye: DVec3::Y, up: DVec3::Z, target: DVec3::ZERO, projection }, n)
}

/// Index coordinates (i, k) that the centre of pixel (x, y) looks at from the front.
fn looks_at(volume: &Volume, size: u32, x: u32, y: u32) -> (f64, f64) {
    let c = volume.lattice.dims.map(|n| (f64::from(n) - 1.0) / 2.0);
    let at = |p: u32| (f64::from(p) + 0.5 - f64::from(size) / 2.0) / 4.0;
    (c[0] - at(x), c[2] - at(y))
}

pub(crate) fn oblique(projection: CameraProjection) -> Camera {
    Camera {
        to_eye: DVec3::new(0.53, 0.71, 0.36),
        up: DVec3::Z,
        target: DVec3::new(0.3, -0.2, 0.1),
        projection,
    }
}

/// The integral at a pixel by the midpoint rule in very many steps, with every voxel summed at
/// every step: nothing that the reference has but the formula.
fn by_brute_force(
    asked: &JudgedScene,
    [x, y]: [u32; 2],
    steps: u32,
    look: impl Fn([u32; 3]) -> Option<(f64, [f64; 3])>,
) -> [f64; 4] {
    let view = &asked.view;
    let [nx, ny, nz] = asked.volume.lattice.dims;
    let mut voxels = Vec::new();
    for (i, j, k) in (0..nx * ny * nz).map(|n| (n % nx, n / nx % ny, n / nx / ny)) {
        if let Some(look) = look([i, j, k]) {
            voxels.push((view.corner_in_eye([i, j, k]), look));
        }
    }
    let (px, py) = (
        f64::from(x) + 0.5 - f64::from(view.size[0]) / 2.0,
        f64::from(y) + 0.5 - f64::from(view.size[1]) / 2.0,
    );
    use slabcast_common::view::Projection::{Ortho, Persp};
    // Position on the ray at a distance along it.
    let (origin, direction, from) = match view.projection {
        Ortho { scale } => (DVec3::new(px / scale, py / scale, 0.0), DVec3::Z, -1e9),
        Persp { focal, distance } => {
            let d = DVec3::new(px / focal, py / focal, 1.0);
            let len = d.length();
            (DVec3::new(0.0, 0.0, -distance), d / len, 1e-3 * distance * len)
        }
    };
    let along = |p: DVec3| (p - origin).dot(direction);
    // Those that the ray passes by are left out: the corner of a kernel is 3.47 away.
    voxels.retain(|v| (v.0 - origin - direction * along(v.0)).length() < 3.5);
    if voxels.is_empty() {
        return [0.0; 4];
    }
    let lo = voxels.iter().map(|v| along(v.0) - 3.5).fold(f64::INFINITY, f64::min).max(from);
    let hi = voxels.iter().map(|v| along(v.0) + 3.5).fold(f64::NEG_INFINITY, f64::max);
    let h = (hi - lo) / f64::from(steps);
    let (mut depth, mut light) = (0.0f64, [0.0; 3]);
    for s in 0..steps {
        let p = origin + direction * (lo + (f64::from(s) + 0.5) * h);
        let (mut sigma, mut emission) = (0.0, [0.0; 3]);
        for (at, (s, c)) in &voxels {
            let u = p - *at;
            if u.abs().max_element() >= RADIUS {
                continue;
            }
            let w = s * g(u.x) * g(u.y) * g(u.z);
            sigma += w;
            for ch in 0..3 {
                emission[ch] += w * c[ch];
            }
        }
        let seen = (-(depth + sigma * h * 0.5)).exp() * h;
        for ch in 0..3 {
            light[ch] += emission[ch] * seen;
        }
        depth += sigma * h;
    }
    [light[0], light[1], light[2], 1.0 - (-depth).exp()]
}

#[track_caller]
fn assert_near(got: [f64; 4], want: [f64; 4], within: f64, what: &str) {
    for c in 0..4 {
        assert!((got[c] - want[c]).abs() <= within, "{what}: got {got:?}, want {want:?}");
    }
}

#[test]
fn reference_homogeneous_block_has_the_opacity_of_its_optical_depth() {
    let n = 12u32;
    for a in [1e-9, 0.02, 0.3, 0.999, 1.0] {
        let volume = Volume::from_fn_u8("block", [n, 7, n], |_, _, _| 100);
        let (camera, size) = front(&volume);
        let tf = alpha(vec![[0.0, 0.25, 0.5, 1.0]], vec![[0.0, a]]);
        let asked = JudgedScene::new(volume, tf, i32_sums(), camera, size);
        let reference = asked.reference();
        let sigma = (-libm::log1p(-a)).min(16.0 * std::f64::consts::LN_2);
        for (x, y) in (0..size * size).step_by(7).map(|i| (i % size, i / size)) {
            let (i, k) = looks_at(&asked.volume, size, x, y);
            let tau = sigma * 7.0 * sum(i, 0..n as i32) * sum(k, 0..n as i32);
            let want = -libm::expm1(-tau);
            let want = [0.25 * want, 0.5 * want, want, want];
            assert_near(
                reference.pixel(x, y),
                want,
                1e-6 * want[3],
                &format!("alpha {a}, {x},{y}"),
            );
        }
    }
}

/// Two walls with a gap wider than the kernel: I = c1 a1 + (1 - a1) c2 a2.
#[test]
fn reference_front_wall_attenuates_back_wall_by_its_opacity() {
    let n = 10u32;
    for (front_a, back_a) in [(0.2, 0.4), (0.9, 0.5), (1.0, 1.0)] {
        let volume = Volume::from_fn_u8("walls", [n, 40, n], |_, j, _| match j {
            0..4 => 50,
            35..38 => 200,
            _ => 0,
        });
        let (camera, size) = front(&volume);
        let tf = alpha(
            vec![[50.0, 0.0, 0.0, 1.0], [200.0, 1.0, 0.0, 0.0]],
            vec![[0.0, 0.0], [49.0, 0.0], [50.0, back_a], [199.0, back_a], [200.0, front_a]],
        );
        let asked = JudgedScene::new(volume, tf, i32_sums(), camera, size);
        let reference = asked.reference();
        let sigma = |a: f64| (-libm::log1p(-a)).min(16.0 * std::f64::consts::LN_2);
        for (x, y) in (0..size * size).step_by(7).map(|i| (i % size, i / size)) {
            let (i, k) = looks_at(&asked.volume, size, x, y);
            let lateral = sum(i, 0..n as i32) * sum(k, 0..n as i32);
            let a1 = -libm::expm1(-sigma(front_a) * 3.0 * lateral);
            let a2 = -libm::expm1(-sigma(back_a) * 4.0 * lateral);
            let want = [a1, 0.0, (1.0 - a1) * a2, 1.0 - (1.0 - a1) * (1.0 - a2)];
            assert_near(reference.pixel(x, y), want, 3e-6, &format!("{front_a}/{back_a} {x},{y}"));
        }
    }
}

#[test]
fn reference_colour_ramp_is_the_emission_absorption_integral() {
    let depth = 20u32;
    let volume = Volume::from_fn_u8("ramp", [9, depth, 9], |_, j, _| 10 + 10 * j as u8);
    let (camera, size) = front(&volume);
    for a in [0.01, 0.25, 0.99, 1.0] {
        let tf = alpha(vec![[10.0, 0.0, 0.2, 1.0], [200.0, 1.0, 0.8, 0.0]], vec![[0.0, a]]);
        let asked = JudgedScene::new(volume.clone(), tf, i32_sums(), camera, size);
        let sigma = (-libm::log1p(-a)).min(16.0 * std::f64::consts::LN_2);
        let at = [size / 2 + 3, size / 2 - 1];
        let want = by_brute_force(&asked, at, 20_000, |[_, j, _]| {
            let t = f64::from(j) / 19.0;
            Some((sigma, [t, 0.2 + 0.6 * t, 1.0 - t]))
        });
        assert_near(asked.reference().pixel(at[0], at[1]), want, 1e-6, &format!("alpha {a}"));
    }
}

#[test]
fn reference_single_voxel_weighs_the_profile_across_the_ray() {
    let sigma = 3.0;
    let tf = || transfer(vec![[0.0, 1.0, 0.5, 0.25]], vec![[0.0, sigma]], OpacityUnit::Extinction);
    let one = || Volume::from_fn_u8("one", [1, 1, 1], |_, _, _| 9);
    let n = 33;
    let camera = oblique(CameraProjection::Ortho { height: 6.0 });
    let asked = JudgedScene::new(one(), tf(), i32_sums(), camera, n);
    let reference = asked.reference();
    let eye = asked.view.corner_in_eye([0; 3]);
    for (x, y) in (0..n * n).map(|i| (i % n, i / n)) {
        let at = |p: u32| (f64::from(p) + 0.5 - f64::from(n) / 2.0) * 6.0 / f64::from(n);
        let a = -libm::expm1(-sigma * g(at(x) - eye.x) * g(at(y) - eye.y));
        assert_near(reference.pixel(x, y), [a, 0.5 * a, 0.25 * a, a], 1e-6, &format!("{x},{y}"));
    }
    // Magnified, from near, where rays are far from parallel.
    let camera = oblique(CameraProjection::Persp { fov: 100.0, distance: 2.5 });
    let asked = JudgedScene::new(one(), tf(), i32_sums(), camera, n);
    let reference = asked.reference();
    for at in [[16, 16], [12, 20], [5, 16], [27, 25]] {
        let want = by_brute_force(&asked, at, 40_000, |_| Some((sigma, [1.0, 0.5, 0.25])));
        assert_near(reference.pixel(at[0], at[1]), want, 1e-6, &format!("{at:?}"));
    }
}

/// A Gaussian of deviation S blurred by a kernel of deviation s is one of S^2 + s^2, and its line
/// integral is a Gaussian of the distance from the ray.
#[test]
fn reference_gaussian_blob_has_its_line_integral() {
    let (n, s) = (33, 3.0f64);
    let lattice = Lattice::from_spacing([n; 3], [1.0; 3]);
    let samples = (0..n * n * n)
        .map(|at| {
            let d = [at % n, at / n % n, at / n / n].map(|i| f64::from(i) - f64::from(n - 1) / 2.0);
            let r2: f64 = d.iter().map(|x| x * x).sum();
            (-r2 / (2.0 * s * s)).exp() as f32
        })
        .collect();
    let volume =
        Volume::new("blob", "f32", false, lattice, Samples::F32(samples), ValueMap::IDENTITY);
    let peak = 0.4;
    let tf = transfer(
        vec![[0.0, 1.0, 1.0, 1.0]],
        vec![[0.0, 0.0], [1.0, peak]],
        OpacityUnit::Extinction,
    );
    let camera =
        Camera { target: DVec3::ZERO, ..oblique(CameraProjection::Ortho { height: 20.0 }) };
    let asked = JudgedScene::new(volume, tf, i32_sums(), camera, 40);
    let reference = asked.reference();
    // The kernel's variance, edge and cut included.
    let steps = 100_000;
    let h = 2.0 * RADIUS / f64::from(steps);
    let variance: f64 =
        (0..steps).map(|i| -RADIUS + (f64::from(i) + 0.5) * h).map(|u| u * u * g(u) * h).sum();
    let wide = s * s + variance;
    for (x, y) in [(20, 20), (25, 20), (13, 28), (32, 11)] {
        let at = |p: u32| (f64::from(p) + 0.5 - 20.0) / 2.0;
        let rho2 = at(x) * at(x) + at(y) * at(y);
        let line = peak * (2.0 * PI).sqrt() * s * s * s / wide * (-rho2 / (2.0 * wide)).exp();
        let want = -libm::expm1(-line);
        let got = reference.pixel(x, y);
        // The blob ends with its box, and the kernel's fourth moment is not a Gaussian's.
        assert_near(got, [want; 4], 1e-4, &format!("{x},{y}"));
    }
}

#[test]
fn reference_equals_brute_force_on_oblique_and_perspective_rays() {
    let look = |[i, j, k]: [u32; 3]| {
        let h = (i * 7 + j * 13 + k * 29 + i * j * k) % 11;
        (h > 3).then_some((f64::from(h) * 0.09, [f64::from(i) / 7.0, f64::from(j) / 7.0, 0.5]))
    };
    // Values that tell extinction from colour: one code a voxel.
    let code = |p: [u32; 3]| if look(p).is_some() { 1 + p[0] + 8 * (p[1] + 8 * p[2]) } else { 0 };
    let lattice = Lattice::from_spacing([8; 3], [1.0; 3]);
    let places = || (0..512u32).map(|n| [n % 8, n / 8 % 8, n / 64]);
    let samples = Samples::U16(places().map(|p| code(p) as u16).collect());
    let volume = Volume::new("dice", "u16", false, lattice, samples, ValueMap::IDENTITY);
    let x = |p: [u32; 3]| f64::from(1 + p[0] + 8 * (p[1] + 8 * p[2]));
    let looks = |p: [u32; 3]| look(p).unwrap_or_default();
    let colors = places().map(|p| [x(p), looks(p).1[0], looks(p).1[1], looks(p).1[2]]).collect();
    let opacities = places().map(|p| [x(p), looks(p).0]);
    let opacities = std::iter::once([0.0, 0.0]).chain(opacities).collect();
    let tf = transfer(colors, opacities, OpacityUnit::Extinction);
    for projection in [
        CameraProjection::Ortho { height: 14.0 },
        CameraProjection::Persp { fov: 40.0, distance: 18.0 },
        // The eye inside: the near plane clips.
        CameraProjection::Persp { fov: 120.0, distance: 2.0 },
        CameraProjection::Persp { fov: 60.0, distance: 900.0 },
    ] {
        let asked =
            JudgedScene::new(volume.clone(), tf.clone(), i32_sums(), oblique(projection), 32);
        let reference = asked.reference();
        let exact = asked.reference().with_tolerance(1e-11);
        for at in [[16, 16], [9, 20], [23, 14], [2, 30], [17, 11]] {
            let want = by_brute_force(&asked, at, 20_000, look);
            let got = reference.pixel(at[0], at[1]);
            assert_near(got, want, 1e-6, &format!("{projection:?} {at:?}"));
            let exact = exact.pixel(at[0], at[1]);
            assert_near(got, exact, 3e-7, &format!("tolerance, {projection:?} {at:?}"));
        }
    }
}

/// Lattices that are not cubic: wide along an axis, and of three lengths with no right angle.
pub(crate) fn lattices(n: u32) -> [Lattice; 3] {
    let wide = |spacing| Lattice::from_spacing([n; 3], spacing);
    let mut skewed = wide([1.0; 3]);
    skewed.steps =
        [DVec3::new(1.1, 0.0, 0.1), DVec3::new(0.5, 1.3, 0.0), DVec3::new(-0.4, 0.6, 1.9)];
    [wide([1.0, 1.0, 2.2]), wide([1.6, 1.0, 1.3]), skewed]
}

/// The kernel of a lattice that is not cubic is a ball in index space, looked at from anywhere.
#[test]
fn reference_sheared_kernels_equal_brute_force_in_index_space() {
    let samples = |[i, j, k]: [u32; 3]| (i * 7 + j * 13 + k * 29 + i * j * k) % 11;
    let n = 5;
    let mut volume = Volume::from_fn_u8("dice", [n; 3], |i, j, k| samples([i, j, k]) as u8);
    let (sigma, std) = (0.07, 0.6);
    let tf = transfer(
        vec![[0.0, 0.0, 1.0, 0.5], [10.0, 1.0, 0.0, 0.5]],
        vec![[0.0, 0.0], [10.0, 10.0 * sigma]],
        OpacityUnit::Extinction,
    );
    // The kernel is nothing beyond a radius of 3.6.
    let q = Quality { std, radius: 3.6, ..i32_sums() };
    for lattice in lattices(n) {
        volume.lattice = lattice;
        let vox = lattice.vox();
        for projection in [
            CameraProjection::Ortho { height: 18.0 * vox },
            CameraProjection::Persp { fov: 40.0, distance: 22.0 * vox },
        ] {
            let asked = JudgedScene::new(volume.clone(), tf.clone(), q, oblique(projection), 32);
            let view = &asked.view;
            assert!(!view.kernel_lean.is_none());
            let reference = asked.reference();
            let index_from_eye = view.eye_from_index.inverse();
            for [x, y] in [[16, 16], [9, 20], [20, 12], [17, 11]] {
                use slabcast_common::view::Projection::{Ortho, Persp};
                let [px, py] = [x, y].map(|p: u32| f64::from(p) + 0.5 - 16.0);
                let (at, step) = match view.projection {
                    Ortho { scale } => (DVec3::new(px / scale, py / scale, 0.0), DVec3::Z),
                    Persp { focal, distance } => {
                        let slope = DVec3::new(px / focal, py / focal, 1.0);
                        (DVec3::new(slope.x, slope.y, 0.0) * distance, slope)
                    }
                };
                let (steps, half) = (4000, 20.0);
                let h = 2.0 * half / f64::from(steps);
                let (mut depth, mut light) = (0.0f64, [0.0; 3]);
                for s in 0..steps {
                    let eye = at + step * (-half + (f64::from(s) + 0.5) * h);
                    let index = index_from_eye * (eye - view.eye_origin);
                    let mut sums = [0.0; 4];
                    for v in (0..n * n * n).map(|v| [v % n, v / n % n, v / n / n]) {
                        let off = index - DVec3::from_array(v.map(f64::from));
                        let bell = (-0.5 * off.length_squared() / (std * std)).exp();
                        let value = f64::from(samples(v));
                        let w = sigma * value * bell / (std * (2.0 * PI).sqrt()).powi(3);
                        let colour = [0.1 * value, 1.0 - 0.1 * value, 0.5];
                        sums[0] += w;
                        (0..3).for_each(|c| sums[c + 1] += w * colour[c]);
                    }
                    let along = h * step.length() * vox;
                    let seen = (-(depth + sums[0] * along * 0.5)).exp() * along;
                    (0..3).for_each(|c| light[c] += sums[c + 1] * seen);
                    depth += sums[0] * along;
                }
                let want = [light[0], light[1], light[2], 1.0 - (-depth).exp()];
                let got = reference.pixel(x, y);
                assert!(want[3] > 0.01, "{want:?}");
                assert_near(got, want, 2e-6, &format!("{lattice:?} {projection:?} {x},{y}"));
            }
        }
    }
}

/// Rays that cross a wall at a slant cross more of it: by the secant.
#[test]
fn reference_slanted_ray_is_longer_by_the_secant() {
    let n = 60u32;
    let volume = Volume::from_fn_u8("wall", [n, 4, n], |_, _, _| 1);
    let sigma = 0.1;
    let tf = transfer(vec![[0.0, 1.0, 1.0, 1.0]], vec![[0.0, sigma]], OpacityUnit::Extinction);
    let projection = CameraProjection::Persp { fov: 90.0, distance: 20.0 };
    let camera = Camera { to_eye: DVec3::Y, up: DVec3::Z, target: DVec3::ZERO, projection };
    let asked = JudgedScene::new(volume, tf, i32_sums(), camera, 64);
    let reference = asked.reference();
    for (x, y) in [(32, 32), (60, 32), (5, 9), (63, 63)] {
        let at = |p: u32| (f64::from(p) + 0.5 - 32.0) / 32.0;
        let secant = (1.0 + at(x) * at(x) + at(y) * at(y)).sqrt();
        let want = -libm::expm1(-sigma * 4.0 * secant);
        // The kernel's ripple across is 0.2 %.
        let got = reference.pixel(x, y)[3];
        assert!((got / want - 1.0).abs() < 2e-3, "{x},{y}: {got} against {want}");
    }
}

#[test]
fn reference_handles_extinctions_from_faint_to_stiff() {
    let n = 8u32;
    let volume = Volume::from_fn_u8("block", [n; 3], |_, j, _| 10 + j as u8);
    let (camera, size) = front(&volume);
    for e in [-9, -6, -3, 0, 2, 4, 6, 9] {
        let sigma = libm::pow(10.0, f64::from(e));
        let tf = transfer(
            vec![[10.0, 0.0, 1.0, 0.7], [17.0, 1.0, 0.0, 0.7]],
            vec![[0.0, sigma]],
            OpacityUnit::Extinction,
        );
        let q = Quality { sums: Sums::F32, ..Quality::before() };
        let asked = JudgedScene::new(volume.clone(), tf, q, camera, size);
        let reference = asked.reference();
        for (x, y) in (0..size * size).step_by(37).map(|i| (i % size, i / size)) {
            let (i, k) = looks_at(&asked.volume, size, x, y);
            // f32 looks are the model's: what the classifier made of sigma.
            let s = f64::from(sigma as f32);
            let tau = s * 8.0 * sum(i, 0..n as i32) * sum(k, 0..n as i32);
            let a = -libm::expm1(-tau);
            let got = reference.pixel(x, y);
            assert!((got[3] - a).abs() <= 1e-6 * a, "1e{e} {x},{y}: {got:?}, {a}");
            assert!((got[2] - 0.7 * a).abs() <= 1e-6 * a, "1e{e} {x},{y}: {got:?}, {a}");
            assert!((got[0] + got[1] - a).abs() <= 1e-6 * a, "1e{e} {x},{y}: {got:?}");
            assert!(got[0] >= 0.0 && got[1] >= 0.0, "1e{e} {x},{y}: {got:?}");
        }
        // Stiff: the colour is that of the foremost layer.
        if e >= 6 {
            let middle = reference.pixel(size / 2, size / 2);
            assert!(middle[0] > 1.0 - 1e-3, "1e{e}: {middle:?}");
        }
    }
}

pub(crate) fn projections(n: u32) -> [CameraProjection; 2] {
    let n = f64::from(n);
    [
        CameraProjection::Ortho { height: 1.5 * n },
        CameraProjection::Persp { fov: 40.0, distance: 2.0 * n },
    ]
}

/// Without ripple a constant field is constant: the optical depth of a block is that of its
/// depth, also where the limit ripples. (Its front and back add up to no more and no less, since
/// what one place of the lattice misses before a face, its mirror image has behind it.)
#[test]
fn reference_without_ripple_keeps_a_constant_field_constant() {
    let n = 12u32;
    let volume = Volume::from_fn_u8("block", [n, 7, n], |_, _, _| 100);
    let (camera, size) = front(&volume);
    for (std, ripples) in [(0.6, 1e-3), (0.45, 1e-2)] {
        let tf = alpha(vec![[0.0, 1.0, 1.0, 1.0]], vec![[0.0, 0.3]]);
        let q = Quality { std, ..i32_sums() };
        let asked = JudgedScene::new(volume.clone(), tf, q, camera, size);
        let (limit, level) = (asked.reference(), asked.reference().without_ripple());
        let want = -libm::expm1(-7.0 * -libm::log1p(-0.3));
        let tau = |a: f64| -libm::log1p(-a);
        let mut worst = 0.0f64;
        // Off the edges by the kernel's reach.
        let inside = 4 * 4 + 10..size - 4 * 4 - 10;
        for (x, y) in inside.clone().zip(inside.clone()).step_by(3) {
            let got = level.pixel(x, y + 1 - y % 3);
            assert!((got[3] - want).abs() < 1e-6, "std {std}, {x},{y}: {got:?}, {want}");
            let limit = limit.pixel(x, y + 1 - y % 3)[3];
            worst = worst.max((tau(limit) / tau(want) - 1.0).abs());
        }
        println!("std {std}: the limit ripples by {worst:e}");
        assert!(worst > ripples, "std {std}: nothing to take away, {worst:e}");
    }
}

/// From any side, in both projections: kernel sums divided place by place, against brute force.
#[test]
fn reference_without_ripple_equals_brute_force() {
    let n = 6u32;
    let volume = Volume::from_fn_u8("block", [n; 3], |_, _, _| 100);
    let sigma = 0.2;
    for projection in projections(n) {
        let tf = transfer(vec![[0.0, 1.0, 1.0, 1.0]], vec![[0.0, sigma]], OpacityUnit::Extinction);
        let asked = JudgedScene::new(volume.clone(), tf, i32_sums(), oblique(projection), 24);
        let view = &asked.view;
        let level = asked.reference().without_ripple();
        for [x, y] in [[12, 12], [9, 14], [15, 8]] {
            let (px, py) = (f64::from(x) + 0.5 - 12.0, f64::from(y) + 0.5 - 12.0);
            use slabcast_common::view::Projection::{Ortho, Persp};
            let (at, slope) = match view.projection {
                Ortho { scale } => ([px / scale, py / scale], [0.0; 2]),
                Persp { focal, distance } => {
                    let s = [px / focal, py / focal];
                    (s.map(|s| s * distance), s)
                }
            };
            let secant = (1.0 + slope[0] * slope[0] + slope[1] * slope[1]).sqrt();
            let to_index = view.eye_from_index.inverse();
            let (steps, reach) = (4000, 9.0);
            let mut tau = 0.0;
            for s in 0..steps {
                let z = -reach + (f64::from(s) + 0.5) * 2.0 * reach / f64::from(steps);
                let p = DVec3::new(at[0] + slope[0] * z, at[1] + slope[1] * z, z);
                let near = (to_index * (p - view.eye_origin)).floor();
                let (mut ours, mut all) = (0.0, 0.0);
                for i in 0..9 * 9 * 9 {
                    let step = [i % 9, i / 9 % 9, i / 81].map(|s| f64::from(s) - 4.0);
                    let place = near + DVec3::from_array(step);
                    let u = p - (view.eye_origin + view.eye_from_index * place);
                    let w = g(u.x) * g(u.y) * g(u.z);
                    all += w;
                    let inside =
                        place.min_element() >= 0.0 && place.max_element() <= f64::from(n - 1);
                    ours += if inside { w } else { 0.0 };
                }
                tau += sigma * ours / all * secant * 2.0 * reach / f64::from(steps);
            }
            let want = -libm::expm1(-tau);
            let got = level.pixel(x, y)[3];
            // The sums have kinks where kernels end, which 4000 steps cross at 5e-3 each.
            assert!((got - want).abs() < 1e-5, "{projection:?} {x},{y}: {got}, {want}");
        }
    }
}

/// A voxel with the whole Gaussian weighs that Gaussian across the ray, beyond the radius too.
#[test]
fn reference_without_truncation_makes_a_voxel_a_full_gaussian() {
    let sigma = 3.0;
    let tf = transfer(vec![[0.0, 1.0, 0.5, 0.25]], vec![[0.0, sigma]], OpacityUnit::Extinction);
    let one = Volume::from_fn_u8("one", [1, 1, 1], |_, _, _| 9);
    let n = 33;
    let camera = oblique(CameraProjection::Ortho { height: 8.0 });
    let asked = JudgedScene::new(one, tf, i32_sums(), camera, n);
    let whole = asked.reference().without_truncation();
    let eye = asked.view.corner_in_eye([0; 3]);
    let bell = |u: f64| bell(u) / (STD * (2.0 * PI).sqrt());
    let mut beyond = 0;
    for (x, y) in (0..n * n).map(|i| (i % n, i / n)) {
        let at = |p: u32| (f64::from(p) + 0.5 - f64::from(n) / 2.0) * 8.0 / f64::from(n);
        let (u, v) = (at(x) - eye.x, at(y) - eye.y);
        let a = -libm::expm1(-sigma * bell(u) * bell(v));
        assert_near(whole.pixel(x, y), [a, 0.5 * a, 0.25 * a, a], 1e-6, &format!("{x},{y}"));
        if u.abs() > RADIUS && a > 1e-4 {
            assert_eq!(asked.reference().pixel(x, y)[3], 0.0);
            beyond += 1;
        }
    }
    assert!(beyond > 10, "the tail was looked at: {beyond}");
}

/// Walls under B-splines, against truncated powers.
#[test]
fn reference_spline_kernels_equal_closed_forms() {
    for kernel in [Kernel::Bspline, Kernel::Tent] {
        let quality = Quality { kernel, ..i32_sums() };
        let (n, deep) = (8, 6);
        let volume = Volume::from_fn_u8("wall", [n, deep, n], |_, _, _| 100);
        let (camera, size) = front(&volume);
        let tf = alpha(vec![[0.0, 0.25, 0.5, 1.0]], vec![[0.0, 0.4]]);
        let asked = JudgedScene::new(volume, tf, quality, camera, size);
        let reference = asked.reference();
        let layer = Layer { sigma: -libm::log1p(-0.4), rgb: [0.25, 0.5, 1.0] };
        let stack = LayerStack {
            profile: Profile::from_quality(&quality),
            across: [0..n as i32, 0..n as i32],
            layers: vec![layer; deep as usize],
        };
        for (x, y) in (0..size).step_by(3).flat_map(|x| (0..size).step_by(5).map(move |y| (x, y))) {
            let (u, v) = looks_at(&asked.volume, size, x, y);
            let want = stack.pixel([u, v]);
            let what = format!("{kernel:?} at {x},{y}");
            assert_near(reference.pixel(x, y), want, 1e-7, &what);
            assert_near(reference.at_same_thickness(x, y), want, 1e-7, &what);
            // Nothing is cut off, and along the axes nothing ripples.
            let whole = asked.reference().without_truncation();
            assert_eq!(whole.pixel(x, y), reference.pixel(x, y), "{what}");
        }
        let inside = (size / 2, size / 2);
        let level = asked.reference().without_ripple().pixel(inside.0, inside.1);
        assert_near(level, reference.pixel(inside.0, inside.1), 1e-7, "without ripple");
    }
}

/// Bounds the cost of rounded positions and of the kernel's cut, held against every pixel of scenes
/// that are soft and stiff, even and rough, seen along an axis (walls that rays graze), from
/// anywhere and in perspective.
#[test]
fn model_error_bounds_hold_on_every_pixel() {
    let rough = |i: u32, j: u32, k: u32| {
        let h = (i * 73_856_093) ^ (j * 19_349_663) ^ (k * 83_492_791);
        if h % 7 < 3 { 0 } else { (40 + h % 200) as u8 }
    };
    let scenes: [(&str, Volume); 2] = [
        ("even", Volume::from_fn_u8("even", [9, 11, 10], |_, _, _| 100)),
        ("rough", Volume::from_fn_u8("rough", [9, 11, 10], rough)),
    ];
    let colors = vec![[0.0, 0.1, 0.3, 0.9], [120.0, 0.9, 0.8, 0.1], [255.0, 0.2, 1.0, 0.6]];
    let (mut said, mut widest) = (0, [0.0f64; 2]);
    for (name, volume) in &scenes {
        let axis = front(volume).0;
        let cameras = [
            axis,
            oblique(CameraProjection::Ortho { height: 22.0 }),
            oblique(CameraProjection::Persp { fov: 30.0, distance: 40.0 }),
        ];
        for (c, camera) in cameras.into_iter().enumerate() {
            for (opacity, thickness, compositing) in [
                (0.005, 1.0, Compositing::Linear),
                (0.06, 2.0, Compositing::Linear),
                (0.06, 0.5, Compositing::Constant),
                (0.99, 1.0, Compositing::Linear),
                (1.0, 0.5, Compositing::Linear),
            ] {
                let tf = alpha(colors.clone(), vec![[0.0, 0.0], [40.0, opacity]]);
                let quality = Quality { thickness, compositing, ..i32_sums() };
                let n = 21;
                let asked = JudgedScene::new(volume.clone(), tf, quality, camera, n);
                let reference = asked.reference();
                let whole = asked.reference().without_truncation();
                let rounded = SheetOptions { rounded: true, ..SheetOptions::default() };
                let mut found = [0.0f64; 2];
                let mut most = 0.0f64;
                for (x, y) in (0..n * n).map(|i| (i % n, i / n)) {
                    let sheets = reference.at_same_thickness(x, y);
                    most = most.max(sheets[3]);
                    let pairs = [
                        (sheets, reference.by_sheets(x, y, rounded)),
                        (reference.pixel(x, y), whole.pixel(x, y)),
                    ];
                    for (worst, (a, b)) in found.iter_mut().zip(pairs) {
                        for c in 0..4 {
                            *worst = worst.max((a[c] - b[c]).abs() * 255.0);
                        }
                    }
                }
                let within = TightBox::whole(volume.lattice.dims);
                let (spec, view) = (&asked.spec, &asked.view);
                for max_alpha in [None, Some(most)] {
                    let bounds = [
                        bounds::rounding(spec, view, &within, max_alpha),
                        bounds::truncation(spec, view, &within, max_alpha),
                    ];
                    for (i, (bound, found)) in bounds.into_iter().zip(found).enumerate() {
                        let bound = bound.expect("extinctions");
                        let what = ["rounding", "truncation"][i];
                        let scene = format!("{name} {c} {opacity} {thickness} {compositing:?}");
                        println!("{scene}, {what}: {found:.4} of at most {bound:.4}");
                        // The reference itself is this near to the limit.
                        assert!(found <= bound + 1e-3, "{scene}: {what} {found} above {bound}");
                        if bound < 255.0 && max_alpha.is_some() && opacity < 0.1 {
                            said += 1;
                            widest[i] = widest[i].max(bound / found);
                        }
                    }
                }
            }
        }
    }
    assert!(said >= 30, "they say something of what is translucent: {said} of 36");
    println!("at most {:.0} and {:.0} times the largest error", widest[0], widest[1]);
    // A picture of another compositing has another limit.
    let tf = alpha(colors, vec![[0.0, 0.5]]);
    let paper = Quality { compositing: Compositing::Paper, ..i32_sums() };
    let asked = JudgedScene::new(scenes[0].1.clone(), tf, paper, front(&scenes[0].1).0, 8);
    let within = TightBox::whole(scenes[0].1.lattice.dims);
    assert_eq!(bounds::rounding(&asked.spec, &asked.view, &within, None), None);
    assert_eq!(bounds::truncation(&asked.spec, &asked.view, &within, None), None);
}
