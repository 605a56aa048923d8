//! The judge of values that are classified after reconstruction is judged: by closed forms, and by
//! brute force along a ray.

use crate::reference::{JudgedScene, lattices, oblique};
use crate::support::{g, transfer};
use glam::{DMat3, DVec3};
use slabcast_common::brick::{Brick, BrickGrid, local_position};
use slabcast_common::ids::BrickId;
use slabcast_common::quality::{Classify, Compositing, Kernel, Quality};
use slabcast_common::shade::{FILL, KEY, Light, Shading};
use slabcast_common::transfer::{Classifier, OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, Projection, View};
use slabcast_common::volume::{Lattice, Samples, ValueMap, Volume};
use slabcast_render::judge::reference::FieldReference;
use std::sync::Arc;

/// The bricks of a volume with every voxel.
fn all_bricks(volume: &Volume) -> Vec<Arc<Brick>> {
    let [nx, ny, nz] = volume.lattice.dims;
    let grid = BrickGrid::new(volume.lattice.dims);
    let brick = |id: u32| {
        let corner = grid.corner(BrickId(id));
        let mut index = Vec::new();
        let mut values = Samples::empty(volume.samples.kind());
        for l in 0..512u16 {
            let p = local_position(l);
            let [i, j, k] = [0, 1, 2].map(|a| corner[a] + p[a]);
            if i < nx && j < ny && k < nz {
                index.push(l);
                values.push_from(&volume.samples, ((k * ny + j) * nx + i) as usize);
            }
        }
        Arc::new(Brick::new(BrickId(id), index, values, None))
    };
    (0..grid.len() as u32).map(brick).collect()
}

fn judge(asked: &JudgedScene) -> FieldReference {
    FieldReference::new(&asked.spec, asked.view, &all_bricks(&asked.volume))
}

fn after(kernel: Kernel) -> Quality {
    Quality { classify: Classify::After, kernel, ..Quality::before() }
}

fn extinction(colors: Vec<[f64; 4]>, opacities: Vec<[f64; 2]>) -> TransferFunction {
    transfer(colors, opacities, OpacityUnit::Extinction)
}

/// One look for all values.
fn plain(sigma: f64) -> TransferFunction {
    extinction(vec![[0.0, 1.0, 0.5, 0.25]], vec![[0.0, sigma]])
}

fn floats(lattice: Lattice, f: impl Fn(DVec3) -> f64) -> Volume {
    let [nx, ny, nz] = lattice.dims;
    let place = |n: u32| [n % nx, n / nx % ny, n / nx / ny].map(f64::from);
    let samples = (0..nx * ny * nz).map(|n| f(DVec3::from_array(place(n))) as f32).collect();
    Volume::new("formula", "f32", false, lattice, Samples::F32(samples), ValueMap::IDENTITY)
}

fn unit(dims: [u32; 3]) -> Lattice {
    Lattice::from_spacing(dims, [1.0; 3])
}

/// From +y: x to the left, z up.
fn front(projection: CameraProjection) -> Camera {
    Camera { to_eye: DVec3::Y, up: DVec3::Z, target: DVec3::ZERO, projection }
}

const ORTHO: CameraProjection = CameraProjection::Ortho { height: 16.0 };

/// A pixel's ray: a point, a unit direction, and where it begins.
fn ray(view: &View, [x, y]: [u32; 2]) -> (DVec3, DVec3, f64) {
    let at = |p: u32, n: u32| f64::from(p) + 0.5 - f64::from(n) / 2.0;
    let (px, py) = (at(x, view.size[0]), at(y, view.size[1]));
    match view.projection {
        Projection::Ortho { scale } => {
            (DVec3::new(px / scale, py / scale, 0.0), DVec3::Z, f64::NEG_INFINITY)
        }
        Projection::Persp { focal, distance } => {
            let d = DVec3::new(px / focal, py / focal, 1.0);
            (DVec3::new(0.0, 0.0, -distance), d.normalize(), 1e-3 * distance * d.length())
        }
    }
}

/// Returns the distances, in vox along a pixel's ray, at which it enters and leaves the box of
/// voxels: among its intersections with six planes, those that lie in the box.
fn through_box(asked: &JudgedScene, pixel: [u32; 2]) -> Option<(f64, f64)> {
    let (from, along, start) = ray(&asked.view, pixel);
    let m = asked.view.eye_from_index.inverse();
    let (at, step) = (m * (from - asked.view.eye_origin), m * along);
    let ends = asked.volume.lattice.dims.map(f64::from);
    let mut met: Vec<f64> = (0..3)
        .flat_map(|a| [-0.5, ends[a] - 0.5].map(|plane| (plane - at[a]) / step[a]))
        .filter(|&s| {
            let p = at + step * s;
            (0..3).all(|a| p[a] > -0.5 - 1e-9 && p[a] < ends[a] - 0.5 + 1e-9)
        })
        .collect();
    met.sort_by(f64::total_cmp);
    let (enter, leave) = (met.first()?.max(start), *met.last()?);
    (enter < leave).then_some((enter, leave))
}

fn near(got: [f64; 4], want: [f64; 4], within: f64, what: &str) {
    for c in 0..4 {
        assert!((got[c] - want[c]).abs() <= within, "{what}: got {got:?}, want {want:?}");
    }
}

/// Points inside a box of index coordinates, about evenly.
fn points(lo: DVec3, hi: DVec3, n: u32) -> impl Iterator<Item = DVec3> {
    let share = |i: u32, step: f64| (f64::from(i) * step + 0.31).fract();
    (0..n).map(move |i| {
        let t = DVec3::new(share(i, 0.819_172_5), share(i, 0.671_043_6), share(i, 0.549_700_5));
        lo + (hi - lo) * t
    })
}

fn in_eye(view: &View, index: DVec3) -> DVec3 {
    view.eye_origin + view.eye_from_index * index
}

#[test]
fn linear_ramp_comes_back_with_its_gradient() {
    let slope = DVec3::new(3.0, -2.0, 5.0);
    let volume = floats(unit([9, 8, 10]), |p| 40.0 + slope.dot(p));
    for kernel in [Kernel::Bspline, Kernel::Tent, Kernel::Gaussian] {
        let scene = JudgedScene::new(volume.clone(), plain(0.1), after(kernel), front(ORTHO), 32);
        let reference = judge(&scene);
        let turned = scene.view.eye_from_index.inverse().transpose();
        for p in points(DVec3::splat(2.0), DVec3::new(6.0, 5.0, 7.0), 200) {
            // A Gaussian's weights are no partition of one: along an axis it has this mean, and
            // along the eye's axes the mean of a ramp is that along each.
            let mean = |x: f64| {
                let (all, sum) = (-3..15)
                    .map(f64::from)
                    .fold((0.0, 0.0), |(all, sum), i| (all + g(x - i), sum + g(x - i) * i));
                sum / all
            };
            let (mut at, mut change) = (p, DVec3::ONE);
            if kernel == Kernel::Gaussian {
                at = DVec3::from_array(p.to_array().map(mean));
                let h = 1e-5;
                let rise = p.to_array().map(|x| (mean(x + h) - mean(x - h)) / (2.0 * h));
                change = DVec3::from_array(rise);
                assert!((at - p).abs().max_element() < 0.01, "{p}: {at}");
            }
            let eye = in_eye(&scene.view, p);
            let (got, want) = (reference.value_at(eye), 40.0 + slope.dot(at));
            assert!((got - want).abs() < 1e-8, "{kernel:?} {p}: {got}, want {want}");
            let (got, want) = (reference.gradient_at(eye), turned * (slope * change));
            let off = (got - want).length();
            assert!(off < 1e-6, "{kernel:?} {p}: gradient {got}, want {want}");
        }
    }
}

#[test]
fn constant_is_constant_up_to_the_faces() {
    let dims = [9, 5, 7];
    let ends = DVec3::new(8.5, 4.5, 6.5);
    let sides =
        [unit(dims), Lattice { dims, ..lattices(9)[0] }, Lattice { dims, ..lattices(9)[2] }];
    for lattice in sides {
        for kernel in [Kernel::Gaussian, Kernel::Bspline, Kernel::Tent] {
            let volume = floats(lattice, |_| 76.54);
            let scene = JudgedScene::new(volume, plain(0.1), after(kernel), oblique(ORTHO), 8);
            let reference = judge(&scene);
            let corners = (0..8).map(|c| {
                DVec3::from_array([0, 1, 2].map(|a| if c >> a & 1 == 1 { ends[a] } else { -0.5 }))
            });
            for p in points(DVec3::splat(-0.5), ends, 100).chain(corners) {
                let eye = in_eye(&scene.view, p);
                assert_eq!(reference.value_at(eye), f64::from(76.54f32), "{kernel:?} {p}");
                assert_eq!(reference.gradient_at(eye), DVec3::ZERO, "{kernel:?} {p}");
            }
        }
    }
}

#[test]
fn homogeneous_box_has_the_alpha_of_each_rays_length_in_it() {
    // Per world unit.
    let given = 0.3;
    let dims = [10, 6, 9];
    let inside = CameraProjection::Persp { fov: 110.0, distance: 2.0 };
    let outside = CameraProjection::Persp { fov: 50.0, distance: 18.0 };
    let [wide, _, skewed] = lattices(9);
    let mut drawn = 0;
    for (lattice, camera) in [
        (unit(dims), front(ORTHO)),
        (unit(dims), front(outside)),
        (unit(dims), front(inside)),
        (unit(dims), oblique(ORTHO)),
        (unit(dims), oblique(outside)),
        (unit(dims), oblique(inside)),
        (Lattice { dims, ..wide }, oblique(outside)),
        (Lattice { dims, ..skewed }, oblique(ORTHO)),
        (Lattice { dims, ..skewed }, oblique(inside)),
    ] {
        let (volume, sigma) = (floats(lattice, |_| 100.0), given * lattice.vox());
        let quality = after(Kernel::Gaussian);
        let scene = JudgedScene::new(volume, plain(given), quality, camera, 24);
        let reference = judge(&scene);
        for at in (0..24 * 24).step_by(7).map(|i| [i % 24, i / 24]) {
            let length = through_box(&scene, at).map_or(0.0, |(enter, leave)| leave - enter);
            let a = -libm::expm1(-sigma * length);
            drawn += u32::from(a > 0.0);
            let got = reference.pixel(at[0], at[1]);
            near(got, [a, 0.5 * a, 0.25 * a, a], 1e-9, &format!("{camera:?} {at:?}"));
        }
    }
    assert!(drawn > 200, "{drawn} pixels with something to see");
    // From the front what is seen is as wide as the box, and as deep.
    let volume = floats(unit(dims), |_| 100.0);
    let scene = JudgedScene::new(volume, plain(given), after(Kernel::Gaussian), front(ORTHO), 64);
    let reference = judge(&scene);
    let across = (0..64).filter(|&x| reference.pixel(x, 32)[3] > 0.0).count();
    let high = (0..64).filter(|&y| reference.pixel(32, y)[3] > 0.0).count();
    assert_eq!([across, high], [40, 36]);
    near(reference.pixel(32, 32), [1.0, 0.5, 0.25, 1.0].map(|c| c * -libm::expm1(-1.8)), 1e-12, "");
}

/// Values from 10 at the back to 200 in front; cubic splines give lines back.
fn ramp() -> Volume {
    Volume::from_fn_u8("ramp", [12, 20, 12], |_, j, _| 10 + 10 * j as u8)
}

#[test]
fn steps_and_spikes_on_a_ramp_have_their_optical_depth() {
    let persp = CameraProjection::Persp { fov: 12.0, distance: 90.0 };
    let step = |lo: f64, hi: f64, s: f64| vec![[0.0, 0.0], [lo, 0.0], [lo, s], [hi, s], [hi, 0.0]];
    let spike = |at: f64, half: f64, s: f64| vec![[at - half, 0.0], [at, s], [at + half, 0.0]];
    for (opacities, integral) in [
        (step(55.5, 83.3, 0.4), 0.4 * 27.8),
        (step(60.0, 61.0, 9.0), 9.0),
        // A five-hundredth of a vox, between two nodes of most panels.
        (step(60.003, 60.023, 500.0), 10.0),
        (spike(97.123, 0.5, 18.0), 9.0),
        (spike(97.123, 0.01, 900.0), 9.0),
    ] {
        for projection in [ORTHO, persp] {
            let what = format!("{projection:?} {opacities:?}");
            let tf = extinction(vec![[0.0, 1.0, 0.5, 0.25]], opacities.clone());
            let scene = JudgedScene::new(ramp(), tf, after(Kernel::Bspline), front(projection), 40);
            let reference = judge(&scene);
            for at in [[20, 20], [17, 22], [24, 15], [13, 26]] {
                let secant = f64::from(scene.view.secant(at[0] as i32, at[1] as i32));
                let a = -libm::expm1(-integral / 10.0 * secant);
                let got = reference.pixel(at[0], at[1]);
                near(got, [a, 0.5 * a, 0.25 * a, a], 1e-5, &format!("{what} {at:?}"));
            }
        }
    }
}

/// A volume without symmetries, of soft shapes and some noise.
fn shapes(lattice: Lattice) -> Volume {
    let [nx, ny, nz] = lattice.dims;
    let n = lattice.dims.map(f64::from);
    let sample = |at: u32| {
        let p = [at % nx, at / nx % ny, at / nx / ny];
        let q: [f64; 3] = std::array::from_fn(|a| (f64::from(p[a]) + 0.5) / n[a] * 2.0 - 1.0);
        let r = |c: [f64; 3]| (0..3).map(|a| (q[a] - c[a]).powi(2)).sum::<f64>().sqrt();
        let noise = f64::from((p[0] * 7 + p[1] * 13 + p[2] * 29 + p[0] * p[1] * p[2]) % 11);
        let ball = 160.0 * ((0.7 - r([0.1, -0.1, 0.0])) / 0.4).clamp(0.0, 1.0);
        (ball + 60.0 * (0.9 - r([-0.3, 0.2, 0.2])).max(0.0) + noise) as u8
    };
    let samples = Samples::U8((0..nx * ny * nz).map(sample).collect());
    Volume::new("shapes", "uint8", false, lattice, samples, ValueMap::IDENTITY)
}

/// A ramp, a step, and a thin shell.
fn several() -> TransferFunction {
    extinction(
        vec![[0.0, 0.1, 0.2, 0.9], [80.0, 0.9, 0.4, 0.1], [255.0, 1.0, 0.9, 0.8]],
        vec![
            [20.0, 0.0],
            [60.0, 0.1],
            [70.3, 0.1],
            [70.3, 1.2],
            [71.3, 1.2],
            [71.3, 0.05],
            [150.0, 0.3],
            [150.0, 0.8],
        ],
    )
}

fn lit(light: Light) -> TransferFunction {
    TransferFunction {
        shading: Shading { light, specular: 0.3, power: 12.0, ..Shading::default() },
        ..several()
    }
}

/// The formula of light, written down anew; all in eye axes.
fn light_on(
    (shading, view): (&Shading, &View),
    range: f64,
    rgb: [f64; 3],
    [gradient, to_eye]: [DVec3; 2],
) -> [f64; 3] {
    let (to_light, fill) = match shading.light {
        Light::Key => (DVec3::from_array(KEY), FILL),
        Light::Head => (to_eye, 0.0),
        Light::Direction(d) => (view.eye_from_world * DVec3::from_array(d).normalize(), 0.0),
    };
    let side = if gradient.dot(to_eye) >= 0.0 { 1.0 } else { -1.0 };
    let normal = (side * gradient + range / 1020.0 * to_eye).normalize();
    let half = (to_light + to_eye).normalize();
    let [of_light, of_eye] = [to_light, to_eye].map(|d| normal.dot(d).max(0.0));
    let lambert = shading.ambient + shading.diffuse * ((1.0 - fill) * of_light + fill * of_eye);
    let gloss = shading.specular * libm::pow(normal.dot(half).max(0.0), shading.power);
    rgb.map(|c| (c * lambert + gloss).clamp(0.0, 1.0))
}

/// The integral at a pixel by the midpoint rule in many steps. The field is asked for at fewer, and
/// is a line between them.
fn by_brute_force(scene: &JudgedScene, reference: &FieldReference, pixel: [u32; 2]) -> [f64; 4] {
    const PLACES: u32 = 3000;
    const STEPS: u32 = 64;
    let Some((enter, leave)) = through_box(scene, pixel) else { return [0.0; 4] };
    let (from, along, _) = ray(&scene.view, pixel);
    let (tf, info) = (&scene.spec.transfer, &scene.spec.volume);
    let looks = Classifier::new(tf, info, Compositing::Linear);
    let range = info.summary.max_code - info.summary.min_code;
    let wide = (leave - enter) / f64::from(PLACES);
    let place = |i: u32| {
        let at = from + along * (enter + f64::from(i) * wide);
        (reference.value_at(at), reference.gradient_at(at))
    };
    let h = wide / f64::from(STEPS);
    let (mut depth, mut light) = (0.0f64, [0.0; 3]);
    let mut next = place(0);
    for i in 1..=PLACES {
        let last = std::mem::replace(&mut next, place(i));
        for s in 0..STEPS {
            let t = (f64::from(s) + 0.5) / f64::from(STEPS);
            let [sigma, rgb @ ..] = looks.optics_at(last.0 + (next.0 - last.0) * t);
            if sigma == 0.0 {
                continue;
            }
            let rgb = if tf.shading.on {
                let gradient = last.1 + (next.1 - last.1) * t;
                light_on((&tf.shading, &scene.view), range, rgb, [gradient, -along])
            } else {
                rgb
            };
            let seen = (-depth).exp() * -libm::expm1(-sigma * h);
            for c in 0..3 {
                light[c] += rgb[c] * seen;
            }
            depth += sigma * h;
        }
    }
    [light[0], light[1], light[2], -libm::expm1(-depth)]
}

#[test]
fn pixels_equal_brute_force_unlit_and_lit() {
    let persp = CameraProjection::Persp { fov: 40.0, distance: 24.0 };
    let inside = CameraProjection::Persp { fov: 100.0, distance: 3.0 };
    let skewed = lattices(10)[2];
    for (n, (lattice, projection, tf)) in [
        (unit([12, 14, 11]), ORTHO, several()),
        (unit([12, 14, 11]), persp, several()),
        (unit([12, 14, 11]), ORTHO, lit(Light::Head)),
        (unit([12, 14, 11]), ORTHO, lit(Light::Key)),
        (skewed, persp, lit(Light::Key)),
        (unit([12, 14, 11]), inside, lit(Light::Direction([0.4, 0.3, 2.0]))),
        (skewed, persp, lit(Light::Direction([-1.0, 3.0, 2.0]))),
        (skewed, ORTHO, several()),
    ]
    .into_iter()
    .enumerate()
    {
        let quality = after(Kernel::Gaussian);
        let scene = JudgedScene::new(shapes(lattice), tf, quality, oblique(projection), 32);
        let reference = judge(&scene);
        for at in [[16, 16], [21, 14]] {
            let want = by_brute_force(&scene, &reference, at);
            let got = reference.pixel(at[0], at[1]);
            let off = (0..4).fold(0.0, |off, c| f64::max(off, (got[c] - want[c]).abs()));
            println!("scene {n}, {at:?}: {got:?}, off {off:.1e}");
            near(got, want, 1e-4, &format!("scene {n}, {at:?}"));
        }
    }
}

#[test]
fn tighter_tolerances_change_nothing_to_speak_of() {
    let head = Light::Head;
    for projection in [ORTHO, CameraProjection::Persp { fov: 40.0, distance: 24.0 }] {
        let quality = after(Kernel::Gaussian);
        let volume = shapes(unit([16; 3]));
        let scene = JudgedScene::new(volume, lit(head), quality, oblique(projection), 24);
        let (usual, half) = (judge(&scene), judge(&scene).with_tolerance(5e-7));
        let exact = judge(&scene).with_tolerance(1e-8);
        let (mut halved, mut left) = (0.0f64, 0.0f64);
        for [x, y] in (0..24 * 24).step_by(13).map(|i| [i % 24, i / 24]) {
            let [usual, half, exact] = [&usual, &half, &exact].map(|r| r.pixel(x, y));
            for c in 0..4 {
                halved = halved.max((usual[c] - half[c]).abs());
                left = left.max((usual[c] - exact[c]).abs());
            }
        }
        println!("{projection:?}: {halved:.1e} by half the tolerance, {left:.1e} in all");
        assert!(halved < 1e-5 && left < 3e-5, "{halved:e} {left:e}");
    }
}

#[test]
fn lights_on_a_ramp_give_the_formulas_colour() {
    let slope = DVec3::new(3.0, 4.0, -2.0);
    let volume = floats(unit([12, 14, 12]), |p| 60.0 + slope.dot(p));
    let directions = [[0.3, 1.0, -0.7], [1.0, -2.0, 0.5]].map(Light::Direction);
    for light in [Light::Key, Light::Head, directions[0], directions[1]] {
        for projection in [ORTHO, CameraProjection::Persp { fov: 20.0, distance: 50.0 }] {
            let shading =
                Shading { on: true, light, specular: 0.4, power: 7.5, ..Shading::default() };
            // Dark behind the shell, and its ends inside the lattice.
            let opacities = vec![[90.0, 0.0], [90.0, 1.5], [94.0, 1.5], [94.0, 0.0]];
            let tf = extinction(vec![[0.0, 0.6, 0.4, 0.1]], opacities);
            let tf = TransferFunction { shading, ..tf };
            let quality = after(Kernel::Bspline);
            let scene = JudgedScene::new(volume.clone(), tf, quality, front(projection), 32);
            let reference = judge(&scene);
            let summary = &scene.spec.volume.summary;
            for at in [[16, 16], [14, 17], [18, 13]] {
                let (_, along, _) = ray(&scene.view, at);
                let gradient = scene.view.eye_from_index.inverse().transpose() * slope;
                let range = summary.max_code - summary.min_code;
                let of = (&shading, &scene.view);
                let colour = light_on(of, range, [0.6, 0.4, 0.1], [gradient, -along]);
                let a = -libm::expm1(-1.5 * 4.0 / gradient.dot(along).abs());
                let want = [colour[0] * a, colour[1] * a, colour[2] * a, a];
                let got = reference.pixel(at[0], at[1]);
                near(got, want, 3e-6, &format!("{light:?} {projection:?} {at:?}"));
            }
        }
    }
}

#[test]
fn field_linear_in_the_world_has_its_world_gradient_on_any_lattice() {
    let slope = DVec3::new(2.0, -1.0, 1.5);
    let dims = [10, 9, 8];
    let steps = |steps: [[f64; 3]; 3]| Lattice {
        dims,
        steps: steps.map(DVec3::from_array),
        origin: DVec3::ZERO,
    };
    let wide = Lattice::from_spacing(dims, [1.0, 1.0, 3.0]);
    // Leans, but its kernel's axes are those of the lattice from the front.
    let aligned = steps([[1.1, 0.0, 0.0], [0.5, 0.0, 1.3], [-0.4, 1.9, 0.6]]);
    let skewed = lattices(9)[2];
    for (lattice, camera, within) in [
        (wide, front(ORTHO), 1e-9),
        (aligned, front(ORTHO), 1e-9),
        // From a slant the weights' mean is not quite where the point is.
        (wide, oblique(ORTHO), 0.06),
        (Lattice { dims, ..skewed }, oblique(ORTHO), 0.06),
    ] {
        let world = |p: DVec3| lattice.world_from_index() * p;
        let volume = floats(lattice, |p| 50.0 + slope.dot(world(p)));
        // f32 holds the samples to 1e-5 or so: take what it holds.
        let scene = JudgedScene::new(volume, plain(0.1), after(Kernel::Bspline), camera, 8);
        let reference = judge(&scene);
        let vox = lattice.vox();
        let mut most = 0.0f64;
        for p in points(DVec3::splat(3.0), DVec3::new(6.0, 5.0, 4.0), 200) {
            let eye = in_eye(&scene.view, p);
            let got = scene.view.eye_from_world.transpose() * reference.gradient_at(eye) / vox;
            most = most.max((got - slope).length() / slope.length());
            let (f, want) = (reference.value_at(eye), 50.0 + slope.dot(world(p)));
            let off = (f - want).abs() / (slope.length() * vox);
            assert!(off < f64::max(within, 1e-5), "{p}: {f}, want {want}");
        }
        println!("gradients within {most:.1e}");
        assert!(most < f64::max(within, 1e-5), "{lattice:?}: {most:e}");
    }
}

/// All voxels at a point, with a kernel that is a product along axes turned in index space: the
/// third is the eye's depth, the second lies in the plane of the eye's y and z.
#[test]
fn field_is_the_weighted_mean_of_all_voxels() {
    for lattice in [unit([9; 3]), lattices(9)[0], lattices(9)[2]] {
        let quality = after(Kernel::Gaussian);
        let scene = JudgedScene::new(shapes(lattice), several(), quality, oblique(ORTHO), 8);
        let reference = judge(&scene);
        let e = scene.view.eye_from_index;
        let third = e.row(2).normalize();
        let second = (e.row(1) - third * third.dot(e.row(1))).normalize();
        let first = second.cross(third);
        let turn = DMat3::from_cols(first, second, third).transpose();
        for p in points(DVec3::splat(-0.5), DVec3::splat(8.5), 300) {
            let (mut all, mut sum) = (0.0, 0.0);
            for n in 0..729u32 {
                let at = DVec3::from_array([n % 9, n / 9 % 9, n / 81].map(f64::from));
                let w: f64 = (turn * (p - at)).to_array().map(g).iter().product();
                all += w;
                sum += w * scene.volume.samples.code(n as usize);
            }
            let (got, want) = (reference.value_at(in_eye(&scene.view, p)), sum / all);
            assert!((got - want).abs() < 1e-6, "{p}: {got}, want {want}");
            // And its derivative.
            let (eye, h) = (in_eye(&scene.view, p), 1e-5);
            let slope = [DVec3::X, DVec3::Y, DVec3::Z].map(|d| {
                (reference.value_at(eye + d * h) - reference.value_at(eye - d * h)) / (2.0 * h)
            });
            let got = reference.gradient_at(eye);
            // The slope jumps at the end of a kernel.
            let off = (got - DVec3::from_array(slope)).length();
            assert!(off < 1e-3 * (1.0 + got.length()), "{p}: {got}, want {slope:?}");
        }
    }
}

#[test]
fn what_is_not_a_number_is_left_out_and_infinities_are_the_largest() {
    let dims = [12, 10, 11];
    let holes = |p: DVec3| match p.to_array().map(|x| x as u32) {
        [i, _, _] if i < 4 => f64::NAN,
        [i, j, k] if i > 7 && (i + j + k) % 2 == 0 => f64::INFINITY,
        [i, j, k] if (i + j + k) % 5 == 0 => f64::NAN,
        _ => 50.0,
    };
    let ends = |p: DVec3| {
        let x = holes(p);
        // The largest finite value, of a voxel far away.
        if p == DVec3::new(4.0, 0.0, 0.0) || x.is_infinite() { 90.0 } else { x }
    };
    let with = |f: &dyn Fn(DVec3) -> f64| {
        let volume =
            floats(unit(dims), |p| if p == DVec3::new(4.0, 0.0, 0.0) { 90.0 } else { f(p) });
        let quality = after(Kernel::Gaussian);
        judge(&JudgedScene::new(volume, plain(0.2), quality, front(ORTHO), 32))
    };
    let (got, want) = (with(&holes), with(&ends));
    let scene = JudgedScene::new(
        floats(unit(dims), holes),
        plain(0.2),
        after(Kernel::Gaussian),
        front(ORTHO),
        32,
    );
    for p in points(DVec3::splat(-0.5), DVec3::new(11.5, 9.5, 10.5), 300) {
        let eye = in_eye(&scene.view, p);
        let (a, b) = (got.value_at(eye), want.value_at(eye));
        assert!(a == b || a.is_nan() && b.is_nan(), "{p}: {a} {b}");
        assert!(p.x > 2.0 || a.is_nan(), "{p}: {a}");
        assert!(p.x < 4.5 || p.x > 5.5 || p.y < 2.5 || a == 50.0, "{p}: {a}");
    }
    // Seen from the front x goes to the left: nothing where nothing is known.
    assert_eq!(got.pixel(27, 16), [0.0; 4]);
    assert!(got.pixel(14, 16)[3] > 0.8);
}
