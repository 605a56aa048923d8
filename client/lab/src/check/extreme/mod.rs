//! Stiff and extreme scenes (docs/design/promises.md, R33 to R35).
//!
//! Each must come out finite, with the same bytes from the serial renderer, from threads and
//! from clusters over both links, and no farther from the truth than its bound. At the same
//! thickness the bound is a pixel's own ([`super::enclose`]); a row shows the pixel that comes
//! nearest to it. What it is of a whole frame is in [`slabcast_common::bounds`].

mod large;
mod scene;
mod stiff;
mod values;

use super::case::{Case, Row};
use super::shot::Shot;
use scene::{
    cutoff_bound, extinction, judge, largest_difference, look, on_lattice, ortho_camera,
    persp_camera, ramp, rough, shaded, shot,
};
use slabcast_common::bounds;
use slabcast_common::brick::TightBox;
use slabcast_common::quality::{Compositing, Quality, Sums, Work};
use slabcast_common::transfer::TransferFunction;
use slabcast_common::volume::Volume;
use slabcast_scene::path::PathView;
use slabcast_session::direct::{self, Cut};
use slabcast_session::embedded::WorkerGroup;

/// Pixels of a case that are judged: one cell in eleven of a picture of 61x47.
const PIXELS: usize = 256;

/// Scenes in which a ray meets thousands of voxels.
const FEW: usize = 8;

/// Returns the cases of the group.
pub(crate) fn cases() -> Vec<Case> {
    let mut all = opacities();
    all.extend(sheets());
    all.extend(cameras());
    all.extend(lattices());
    all.extend(pictures());
    all.extend(values::cases());
    all.extend(settings());
    all.extend(stiff::cases());
    all.extend(large::cases());
    all
}

/// A case that draws one shot and judges it.
fn one(name: impl Into<String>, make: impl Fn() -> Shot + Send + Sync + 'static) -> Case {
    Case::new(name, move |tools| judge(&make(), PIXELS, tools))
}

fn block() -> Volume {
    rough([20, 16, 14])
}

/// Opacities from zero to one.
fn opacities() -> Vec<Case> {
    let mut all = Vec::new();
    for (name, alpha) in
        [("0", 0.0), ("1e-7", 1e-7), ("1/2", 0.5), ("1 - 1e-7", 1.0 - 1e-7), ("1", 1.0)]
    {
        all.push(one(format!("alpha {name}"), move || {
            shot(block(), look(&[[0.0, 0.0], [39.0, 0.0], [40.0, alpha]]))
        }));
    }
    all.push(one("alpha 1, shaded", || {
        shot(block(), shaded(&[[0.0, 0.0], [39.0, 0.0], [40.0, 1.0]]))
    }));
    all.push(one("alpha 1e-3 beside alpha 1", || {
        shot(block(), look(&[[0.0, 1e-3], [150.0, 1e-3], [150.0, 1.0]]))
    }));
    all.push(one("a step on a linear field", || {
        shot(ramp([24, 12, 12], 10), look(&[[0.0, 0.0], [101.0, 0.0], [101.0, 0.999]]))
    }));
    // A ray meets 10^4 layers of three by three voxels.
    all.push(Case::new("alpha 1e-6 over 10^4 voxels", |tools| {
        let volume = ramp([10_000, 3, 3], 1);
        let view = along(&volume, 8.0);
        judge(&Shot { view, size: [9, 7], ..shot(volume, look(&[[0.0, 1e-6]])) }, FEW, tools)
    }));
    for power in [-9, -3, 0, 3, 6, 9] {
        all.push(one(format!("extinction 1e{power} per vox, f32 sums"), move || {
            let sigma = libm::pow(10.0, f64::from(power));
            let s = shot(block(), extinction(&[[0.0, 0.0], [39.0, 0.0], [40.0, sigma]]));
            Shot { quality: Quality { sums: Sums::F32, ..s.quality }, ..s }
        }));
    }
    all.push(one("extinction 1e9 beside 1e-9 per vox", || {
        shot(block(), extinction(&[[0.0, 1e-9], [200.0, 1e-9], [200.0, 1e9]]))
    }));
    all
}

/// Sheets from 1/64 vox to thicker than the volume.
fn sheets() -> Vec<Case> {
    let mut all = Vec::new();
    let stiff = || shot(block(), look(&[[0.0, 0.0], [39.0, 0.0], [40.0, 0.02], [255.0, 0.999]]));
    for (name, thickness) in
        [("1/64", 1.0 / 64.0), ("1/3", 1.0 / 3.0), ("7", 7.0), ("65536", 65536.0)]
    {
        all.push(one(format!("sheets of {name} vox"), move || {
            let s = stiff();
            Shot { quality: Quality { thickness, ..s.quality }, ..s }
        }));
    }
    for compositing in [Compositing::Constant, Compositing::Paper] {
        all.push(one(format!("{compositing:?} compositing").to_lowercase(), move || {
            let s = stiff();
            Shot { quality: Quality { compositing, ..s.quality }, ..s }
        }));
    }
    // 16384 voxels in sheets of 1/64: 2^20 sheets along a ray, and nothing shuts it.
    all.push(Case::new("10^6 sheets", |tools| {
        let volume = ramp([16_384, 1, 1], 1);
        let view = along(&volume, 1.0);
        let s = shot(volume, look(&[[0.0, 1e-3]]));
        let quality = Quality { thickness: 1.0 / 64.0, eps: 0.0, ..s.quality };
        judge(&Shot { view, quality, size: [1, 1], ..s }, 1, tools)
    }));
    all
}

/// Eyes inside, along axes, at the pole, with narrow and wide fields.
fn cameras() -> Vec<Case> {
    let seen = |view: fn(&Volume) -> PathView| {
        move || {
            let volume = block();
            let view = view(&volume);
            Shot { view, ..shot(volume, mixed()) }
        }
    };
    vec![
        one("eye inside", seen(|v| persp_camera(v, [0.1, 0.05, -0.02], [0.4, 0.3, 0.1], 60.0))),
        one(
            "eye at a voxel",
            seen(|v| {
                let mut view = persp_camera(v, [0.0; 3], [0.5, 0.3, 0.2], 60.0);
                view.eye = [9.0, 8.0, 7.0];
                view
            }),
        ),
        one("along +x", seen(|v| ortho_camera(v, [1.0, 0.0, 0.0], UP))),
        one("along -y", seen(|v| ortho_camera(v, [0.0, -1.0, 0.0], UP))),
        one("along +z, up along it too", seen(|v| ortho_camera(v, [0.0, 0.0, 1.0], UP))),
        // The eye of a turntable with an elevation of 90 degrees.
        one("the pole of a turntable", seen(|v| ortho_camera(v, UP, [0.0, -1.0, 0.0]))),
        one(
            "along +z, perspective",
            seen(|v| PathView {
                up: [0.0, 1.0, 0.0],
                ..persp_camera(v, [0.0, 0.0, 2.0], [0.0; 3], 30.0)
            }),
        ),
        // From so far away that the volume fills the picture again.
        one(
            "fov 0.01 degrees",
            seen(|v| persp_camera(v, [3700.0, 4900.0, 2500.0], [0.0; 3], 0.01)),
        ),
        // A vox is a fifth of a pixel at its own distance: all is seen in the middle.
        Case::new("fov 179 degrees", |tools| {
            let volume = block();
            let view = persp_camera(&volume, [0.1, 0.1, 0.05], [0.0; 3], 179.0);
            let s = Shot { view, size: [21, 17], ..shot(volume, mixed()) };
            let quality = Quality { thickness: 0.25, ..s.quality };
            judge(&Shot { quality, ..s }, 21 * 17, tools)
        }),
    ]
}

/// A transfer function with every opacity.
fn mixed() -> TransferFunction {
    look(&[[0.0, 0.0], [39.0, 0.0], [40.0, 0.05], [255.0, 0.9]])
}

const UP: [f64; 3] = [0.0, 0.0, 1.0];

/// Along x, `height` world units of it.
fn along(volume: &Volume, height: f64) -> PathView {
    PathView { height: Some(height), ..ortho_camera(volume, [1.0, 0.0, 0.0], UP) }
}

/// From the default direction, so near that `height` world units fill the picture.
fn near(volume: &Volume, height: f64) -> PathView {
    PathView { height: Some(height), ..ortho_camera(volume, [0.53, 0.71, 0.36], UP) }
}

/// One voxel, a line of them, and spacings and places far from one.
fn lattices() -> Vec<Case> {
    let line = || rough([4096, 1, 1]);
    let mut all = vec![
        one("1x1x1", || shot(rough([1, 1, 1]), mixed())),
        one("4096x1x1", move || {
            let view = near(&line(), 12.0);
            Shot { view, ..shot(line(), look(&[[0.0, 0.9]])) }
        }),
        Case::new("4096x1x1, along it", move |tools| {
            let view = along(&line(), 6.0);
            let s = Shot { view, size: [9, 7], ..shot(line(), look(&[[0.0, 1e-3]])) };
            judge(&s, FEW, tools)
        }),
        one("spacing 1:1:20", || shot(on_lattice(block(), [1.0, 1.0, 20.0], [0.0; 3]), mixed())),
    ];
    for power in [-12, -9, 9, 12] {
        all.push(one(format!("spacing 1e{power}"), move || {
            let s = libm::pow(10.0, f64::from(power));
            shot(on_lattice(block(), [s; 3], [0.0; 3]), mixed())
        }));
    }
    all.push(one("origin at 1e7 voxels", || {
        shot(on_lattice(block(), [1.0; 3], [1e7, -1e7, 1e7]), mixed())
    }));
    all
}

/// One pixel, and one voxel over all of them.
fn pictures() -> Vec<Case> {
    vec![
        one("a picture of 1x1", || Shot { size: [1, 1], ..shot(block(), mixed()) }),
        one("one voxel over the whole picture", || {
            let view = near(&block(), 0.01);
            Shot { view, ..shot(block(), mixed()) }
        }),
    ]
}

/// Settings that must not change the picture by more than a bound.
fn settings() -> Vec<Case> {
    let scene = |eps, sums| {
        let s = shot(block(), look(&[[0.0, 0.0], [39.0, 0.0], [40.0, 0.02], [255.0, 0.999]]));
        Shot { quality: Quality { eps, sums, ..s.quality }, ..s }
    };
    let mut all = Vec::new();
    for (name, eps) in [("1/2", 0.5), ("1/16", 1.0 / 16.0), ("1/4096", 1.0 / 4096.0)] {
        all.push(Case::new(format!("eps {name} against eps 0"), move |tools| {
            let shut = scene(eps, Sums::Auto).ready()?;
            let frame = shut.frame().never_shut();
            let open = direct::draw(&frame, &shut.bricks, Cut::on(tools.threads));
            let left_out = largest_difference(&shut.serial(), &open);
            Ok(vec![Row::new("max that the cut-off leaves out", left_out, cutoff_bound(&shut))])
        }));
    }
    // The bound of a frame's statistics. Floats round too: 15 times half an ulp a contribution
    // and half an ulp for each of at most 300 that a sheet adds, in tau and in colour.
    all.push(Case::new("integer sums against floats", move |_| {
        let [ints, floats] = [scene(0.0, Sums::I32).ready()?, scene(0.0, Sums::F32).ready()?];
        let within = TightBox::whole(ints.spec.volume.lattice.dims);
        let bound = bounds::quantisation(&ints.spec, &ints.view, &within)
            + bounds::quantisation(&floats.spec, &floats.view, &within)
            + 255.0 * 2.0 * 315.0 * 6e-8;
        let apart = largest_difference(&ints.serial(), &floats.serial());
        Ok(vec![Row::new("max of the difference", apart, bound)])
    }));
    all.push(Case::new("1000 slabs", move |tools| {
        let s = scene(1.0 / 512.0, Sums::Auto);
        let s = Shot { quality: Quality { thickness: 1.0 / 64.0, ..s.quality }, ..s };
        let want = s.ready()?.serial().sha256().to_string();
        let work = Work { slabs: 1000, tile: Some(64), ..Work::default() };
        let crew = WorkerGroup { workers: 2, threads: 1 };
        let got = tools.runtime.block_on(s.hash(false, crew, true, work))?;
        let differs = if got == want { 0.0 } else { 1.0 };
        Ok(vec![Row::new("hashes that differ", differs, 0.0)])
    }));
    all
}
