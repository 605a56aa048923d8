//! Scenes with pictures in closed form (`slabcast_render::judge::analytic`), each within bounds
//! that count roundings.

use super::case::{Case, Row};
use super::shot::{PreparedShot, Shot, sane};
use slabcast_common::image::Picture;
use slabcast_common::quality::{Compositing, Quality, Sums};
use slabcast_common::shade::Shading;
use slabcast_common::transfer::{
    Classifier, ColorSpace, Domain, NanColour, OpacityUnit, SIGMA_MAX, TransferFunction,
};
use slabcast_common::view::SUBPIXELS;
use slabcast_render::judge::analytic::{GaussianBlob, Layer, LayerStack, Profile, Rounding};
use slabcast_scene::path::{PathView, ProjectionKind};
use slabcast_session::direct::Cut;
use slabcast_session::fail::Fail;
use slabcast_session::volume;
use std::path::Path;
use std::sync::Arc;

/// Returns the cases of the group.
pub(crate) fn cases() -> Vec<Case> {
    let mut all = vec![
        wall(0.02, 4.0),
        wall(0.9, 4.0),
        wall(1.0, 4.0),
        wall(0.9, 3.7),
        two_walls(0.5, 0.9),
        two_walls(1.0, 1.0),
        along_x("ramp of extinction and colour", vec![[0.0, 0.0], [1.0, 0.6]], &|t| 0.6 * t, |t| t),
        along_x(
            "step on a linear field",
            vec![[0.5, 0.05], [0.5, 4.6]],
            &|t| if t < 0.5 { 0.05 } else { 4.6 },
            |t| t,
        ),
        bell(true),
        bell(false),
    ];
    all.extend([-9, -6, -3, 0, 3, 6, 9].map(extinction));
    all.push(layers());
    all
}

/// The default quality's kernel.
fn profile() -> Profile {
    let q = Quality::before();
    Profile::new(q.std, q.radius)
}

fn look(unit: OpacityUnit, colors: Vec<[f64; 4]>, opacities: Vec<[f64; 2]>) -> TransferFunction {
    TransferFunction {
        version: 1,
        domain: Domain::Value,
        colors,
        opacities,
        color_space: ColorSpace::Linear,
        opacity_unit: unit,
        nan: NanColour::default(),
        gradient_opacity: vec![],
        shading: Shading { on: false, ..Shading::default() },
    }
}

/// Returns the extinction per vox of an alpha per vox.
fn sigma(alpha: f64) -> f64 {
    (-libm::log1p(-alpha)).min(SIGMA_MAX)
}

/// A volume by formula from `to_eye`, z up, with `scale` pixels a voxel and 4 voxels of room.
/// Nothing is shut.
fn shot(
    name: &str,
    transfer: TransferFunction,
    quality: Quality,
    to_eye: [f64; 3],
    scale: f64,
) -> Result<Shot, Fail> {
    let volume = volume::open(Path::new(name))?;
    let dims = volume.lattice.dims;
    let centre = dims.map(|n| (f64::from(n) - 1.0) / 2.0);
    // Largest side across the view; the axis that is looked along, if any, does not count.
    let across = (0..3).filter(|&a| to_eye[a] != 1.0).map(|a| dims[a]).max().unwrap_or(1);
    let n = (f64::from(across + 8) * scale) as u32;
    Ok(Shot {
        volume: Arc::new(volume),
        transfer,
        quality: Quality { eps: 0.0, ..quality },
        size: [n, n],
        view: PathView {
            eye: [0, 1, 2].map(|a| centre[a] + 100.0 * to_eye[a]),
            target: centre,
            up: [0.0, 0.0, 1.0],
            projection: ProjectionKind::Ortho,
            height: Some(f64::from(n) / scale),
            fov: None,
        },
        crop: None,
    })
}

/// Returns the largest rounding of a position in vox: half a subpixel, or zero at 4 pixels a voxel,
/// where every voxel falls on a subpixel.
fn shift(scale: f64) -> f64 {
    if scale == 4.0 { 0.0 } else { 0.5 / f64::from(SUBPIXELS) / scale }
}

fn rounding(ready: &PreparedShot, scale: f64) -> Rounding {
    let classifier = Classifier::new(&ready.spec.transfer, &ready.spec.volume, Compositing::Linear);
    let integers = ready.spec.quality.sums == Sums::I32;
    Rounding {
        thickness: ready.spec.quality.thickness,
        integers: integers.then(|| classifier.payload_max()),
        shift: shift(scale),
    }
}

/// The error and the bound, in 1/255, of the pixel that comes nearest to its own bound or exceeds
/// it most.
#[derive(Default)]
struct Nearest {
    error: f64,
    bound: f64,
    share: f64,
}

impl Nearest {
    fn see(&mut self, got: f32, want: f64, bound: f64) {
        let error = (f64::from(got) - want).abs();
        let share = error / bound.max(1e-300);
        // NaN counts as the largest, and stays.
        let level = share == self.share && bound > self.bound;
        if share > self.share || level || share.is_nan() {
            *self = Nearest { error, bound, share };
        }
    }

    fn row(&self, what: &str) -> Row {
        Row::new(what, self.error * 255.0, self.bound * 255.0)
    }
}

/// Compares pixels with a stack's closed form: opacity if `alphas`, colour if `colours`.
fn rows(
    ready: &PreparedShot,
    picture: &Picture,
    stack: &LayerStack,
    scale: f64,
    colours: bool,
    alphas: bool,
) -> Vec<Row> {
    let how = rounding(ready, scale);
    let middle = [0, 1].map(|a| {
        let r = &stack.across[a];
        (f64::from(r.start) + f64::from(r.end) - 1.0) / 2.0
    });
    let varies = stack.layers.iter().any(|l| l.rgb != stack.layers[0].rgb);
    let (mut alpha, mut colour) = (Nearest::default(), Nearest::default());
    let [w, h] = ready.view.size;
    // Every pixel where that is quick; where colours differ each takes a thousand sums.
    let every = if varies && colours { 97 } else { 1 };
    for (x, y) in (0..w * h).step_by(every).map(|i| (i % w, i / w)) {
        let at = |p: u32, n: u32| (f64::from(p) + 0.5 - f64::from(n) / 2.0) / scale;
        let at = [middle[0] - at(x, w), middle[1] - at(y, h)];
        let got = picture.pixels[(y * w + x) as usize];
        let [a, c] = stack.rounding_bound(at, &how);
        if colours {
            let want = stack.pixel(at);
            let thick = if varies {
                // The closed form's own steps are 1/256 vox.
                stack.thickness_bound(at, how.thickness)
                    * (1.0 + (1.0 / 256.0 / how.thickness).powi(2))
            } else {
                0.0
            };
            for ch in 0..3 {
                colour.see(got[ch], want[ch], c + thick);
            }
        }
        if alphas {
            alpha.see(got[3], -libm::expm1(-stack.optical_depth(at, 1e9)), a);
        }
    }
    let mut out = Vec::new();
    if alphas {
        out.push(alpha.row("opacity, nearest to its bound"));
    }
    if colours {
        out.push(colour.row("colour, nearest to its bound"));
    }
    out
}

fn wall(alpha: f64, scale: f64) -> Case {
    Case::new(format!("wall of alpha {alpha}, {scale} pixels a voxel"), move |tools| {
        let tf = look(OpacityUnit::AlphaPerVox, vec![[0.0, 0.25, 0.5, 1.0]], vec![[0.0, alpha]]);
        let shot = shot("formula:full:12x7x12", tf, Quality::before(), [0.0, 1.0, 0.0], scale)?;
        let ready = shot.ready()?;
        let picture = ready.picture(Cut::on(tools.threads));
        let layer = Layer { sigma: sigma(alpha), rgb: [0.25, 0.5, 1.0] };
        let stack =
            LayerStack { profile: profile(), across: [0..12, 0..12], layers: vec![layer; 7] };
        let rows = rows(&ready, &picture, &stack, scale, true, true);
        Ok(rows.into_iter().map(|r| r.with(sane(&picture))).collect())
    })
}

/// 100 in front of 200, farther apart than the kernel reaches.
fn two_walls(front: f64, back: f64) -> Case {
    Case::new(format!("two walls of alpha {front} and {back}"), move |tools| {
        let tf = look(
            OpacityUnit::AlphaPerVox,
            vec![[100.0, 1.0, 0.0, 0.0], [101.0, 0.0, 0.0, 1.0]],
            vec![[99.0, 0.0], [100.0, front], [101.0, back]],
        );
        let shot = shot("formula:two-walls:48", tf, Quality::before(), [0.0, 1.0, 0.0], 4.0)?;
        let ready = shot.ready()?;
        let picture = ready.picture(Cut::on(tools.threads));
        // Layers of the formula along the volume's middle line, from the eye's side.
        let [nx, ny, nz] = shot.volume.lattice.dims.map(|n| n as usize);
        let code = |j: usize| shot.volume.samples.code(nx / 2 + nx * (j + ny * (nz / 2)));
        let layers = (0..ny).rev().map(|j| match code(j) {
            100.0 => Layer { sigma: sigma(front), rgb: [1.0, 0.0, 0.0] },
            200.0 => Layer { sigma: sigma(back), rgb: [0.0, 0.0, 1.0] },
            _ => Layer { sigma: 0.0, rgb: [0.0; 3] },
        });
        let (lo, hi) = (nx as i32 / 8, nx as i32 - nx as i32 / 8);
        let stack =
            LayerStack { profile: profile(), across: [lo..hi, lo..hi], layers: layers.collect() };
        let how = rounding(&ready, 4.0);
        let (mut alpha, mut colour) = (Nearest::default(), Nearest::default());
        let [w, h] = ready.view.size;
        let middle = (nx as f64 - 1.0) / 2.0;
        for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
            let at = |p: u32, n: u32| (f64::from(p) + 0.5 - f64::from(n) / 2.0) / 4.0;
            let at = [middle - at(x, w), middle - at(y, h)];
            // One colour each, and a gap: no integral is needed.
            let all = stack.optical_depth(at, 1e9);
            let first = stack.optical_depth(at, 0.0);
            let a1 = -libm::expm1(-first);
            let a2 = -libm::expm1(-(all - first));
            let got = picture.pixels[(y * w + x) as usize];
            let [a, c] = stack.rounding_bound(at, &how);
            alpha.see(got[3], -libm::expm1(-all), a);
            colour.see(got[0], a1, c);
            colour.see(got[2], (1.0 - a1) * a2, c);
        }
        Ok(vec![
            alpha.row("opacity, nearest to its bound").with(sane(&picture)),
            colour.row("colour, nearest to its bound"),
        ])
    })
}

/// The field is linear along the ray: `of` gives the extinction per vox, `red` the colour, both
/// of x as a share of its range. Opacity has no error of thickness at all; colour is held against
/// what one colour in a sheet may be off by, at vox/32.
fn along_x(
    name: &'static str,
    opacities: Vec<[f64; 2]>,
    of: &(impl Fn(f64) -> f64 + Clone + Send + Sync + 'static),
    red: fn(f64) -> f64,
) -> Case {
    let of = of.clone();
    Case::new(name, move |tools| {
        const DEEP: u32 = 24;
        let mut out = Vec::new();
        for (compositing, thickness) in
            [(Compositing::Linear, 1.0), (Compositing::Constant, 1.0 / 32.0)]
        {
            let mut tf = look(
                OpacityUnit::Extinction,
                vec![[0.0, 0.0, 1.0, 0.5], [1.0, 1.0, 0.0, 0.5]],
                opacities.clone(),
            );
            tf.domain = Domain::Unit;
            let quality = Quality { compositing, thickness, ..Quality::before() };
            let shot = shot("formula:ramp:24x9x9", tf, quality, [1.0, 0.0, 0.0], 4.0)?;
            let ready = shot.ready()?;
            let picture = ready.picture(Cut::on(tools.threads));
            let layers = (0..DEEP).rev().map(|i| {
                let t = f64::from(i) / f64::from(DEEP - 1);
                Layer { sigma: of(t), rgb: [red(t), 1.0 - red(t), 0.5] }
            });
            let stack =
                LayerStack { profile: profile(), across: [0..9, 0..9], layers: layers.collect() };
            let thin = compositing == Compositing::Constant;
            for mut row in rows(&ready, &picture, &stack, 4.0, thin, !thin) {
                row.what = match thin {
                    true => "colour at vox/32, one a sheet".into(),
                    false => "opacity at one vox".into(),
                };
                out.push(row.with(sane(&picture)));
            }
        }
        Ok(out)
    })
}

/// A Gaussian: along an axis a product of sums, from a side a convolution and its aliasing.
fn bell(axis: bool) -> Case {
    const N: u32 = 36;
    const PEAK: f64 = 0.2;
    let name = if axis { "bell along an axis" } else { "bell from a side" };
    Case::new(name, move |tools| {
        let tf = look(
            OpacityUnit::Extinction,
            vec![[0.0, 1.0, 0.5, 0.25]],
            vec![[0.0, 0.0], [1.0, PEAK]],
        );
        let to_eye = if axis { [0.0, 1.0, 0.0] } else { [0.53, 0.71, 0.36] };
        let scale = 3.0;
        let shot = shot("formula:bell:36", tf, Quality::before(), to_eye, scale)?;
        let ready = shot.ready()?;
        let picture = ready.picture(Cut::on(tools.threads));
        let blob =
            GaussianBlob { profile: profile(), peak: PEAK, std: f64::from(N) / 12.0, voxels: N };
        let how = rounding(&ready, scale);
        let [w, h] = ready.view.size;
        let mut alpha = Nearest::default();
        for (x, y) in (0..w * h).step_by(131).map(|i| (i % w, i / w)) {
            let at = |p: u32, n: u32| (f64::from(p) + 0.5 - f64::from(n) / 2.0) / scale;
            let at = [at(x, w), at(y, h)];
            let (tau, aliasing) = if axis {
                (blob.depth_along_axis(at), 0.0)
            } else {
                (blob.depth_from(at), blob.aliasing_bound(at, &ready.view.eye_from_index))
            };
            let moved = blob.position_bound(at, how.shift) + aliasing;
            let got = picture.pixels[(y * w + x) as usize];
            let [a, _] = blob.rounding_bound(tau, moved, &how);
            alpha.see(got[3], -libm::expm1(-tau), a);
        }
        Ok(vec![alpha.row("opacity, nearest to its bound").with(sane(&picture))])
    })
}

/// A block of ten to the `e` per vox.
fn extinction(e: i32) -> Case {
    Case::new(format!("extinction 1e{e}"), move |tools| {
        let sigma = libm::pow(10.0, f64::from(e));
        let tf = look(OpacityUnit::Extinction, vec![[0.0, 0.25, 0.5, 1.0]], vec![[0.0, sigma]]);
        let shot = shot("formula:full:8", tf, Quality::before(), [0.0, 1.0, 0.0], 4.0)?;
        let ready = shot.ready()?;
        let picture = ready.picture(Cut::on(tools.threads));
        let layer = Layer { sigma, rgb: [0.25, 0.5, 1.0] };
        let stack = LayerStack { profile: profile(), across: [0..8, 0..8], layers: vec![layer; 8] };
        let rows = rows(&ready, &picture, &stack, 4.0, true, true);
        Ok(rows.into_iter().map(|r| r.with(sane(&picture))).collect())
    })
}

/// Ten thousand layers of alpha 1e-6.
fn layers() -> Case {
    Case::new("10^4 layers of alpha 1e-6", |tools| {
        let tf = look(OpacityUnit::AlphaPerVox, vec![[0.0, 1.0, 1.0, 1.0]], vec![[0.0, 1e-6]]);
        let shot = shot("formula:full:2x10000x2", tf, Quality::before(), [0.0, 1.0, 0.0], 4.0)?;
        let ready = shot.ready()?;
        let picture = ready.picture(Cut::on(tools.threads));
        let layer = Layer { sigma: sigma(1e-6), rgb: [1.0; 3] };
        let stack =
            LayerStack { profile: profile(), across: [0..2, 0..2], layers: vec![layer; 10_000] };
        let rows = rows(&ready, &picture, &stack, 4.0, true, true);
        Ok(rows.into_iter().map(|r| r.with(sane(&picture))).collect())
    })
}
