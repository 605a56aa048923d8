//! Rendered pictures against `slabcast_render::judge::analytic`: what is known on paper, within
//! bounds that count roundings.

use crate::support::{bricks_of, transfer};
use glam::DVec3;
use slabcast_common::ids::SceneId;
use slabcast_common::image::{FrameState, Picture, TilePixels};
use slabcast_common::message::SceneSpec;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Compositing, Kernel, Quality, Sums};
use slabcast_common::slab::SheetRange;
use slabcast_common::transfer::{Classifier, OpacityUnit, TransferFunction};
use slabcast_common::view::{Camera, CameraProjection, SUBPIXELS, View};
use slabcast_common::volume::{Digest32, Lattice, Samples, ValueMap, Volume};
use slabcast_render::Simd;
use slabcast_render::judge::analytic::{GaussianBlob, Layer, LayerStack, Profile, Rounding};
use slabcast_render::oracle::serial;
use slabcast_render::tile::{self, Scratch};
use slabcast_render::{Frame, Scene};
use std::sync::Arc;

fn profile() -> Profile {
    Profile::new(0.6, 2.0)
}

fn extinctions(colors: Vec<[f64; 4]>, opacities: Vec<[f64; 2]>) -> TransferFunction {
    transfer(colors, opacities, OpacityUnit::Extinction)
}

/// One scene with an eye that shuts nothing.
struct Shot {
    volume: Volume,
    spec: SceneSpec,
    view: View,
}

impl Shot {
    /// From `to_eye`, z up, `scale` pixels a voxel, 4 voxels of room around `wide`.
    fn new(
        volume: Volume,
        transfer: TransferFunction,
        quality: Quality,
        to_eye: DVec3,
        (wide, scale): (u32, f64),
    ) -> Shot {
        let info = volume.info(Digest32::default());
        let sums = Classifier::new(&transfer, &info, quality.compositing);
        let sums = sums.choose_sums(&Quality { eps: 0.0, ..quality }, &info.lattice).unwrap();
        let quality = Quality { eps: 0.0, sums, ..quality };
        let n = (f64::from(wide + 8) * scale) as u32;
        let projection = CameraProjection::Ortho { height: f64::from(n) / scale };
        let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection };
        let view = View::new(&volume.lattice, &camera, [n, n], &quality).unwrap();
        let spec = SceneSpec {
            id: SceneId(1),
            volume: info,
            transfer,
            quality,
            crop: None,
            bricks: Default::default(),
        };
        Shot { volume, spec, view }
    }

    fn frame(&self) -> Frame {
        Frame::new(Arc::new(Scene::new(&self.spec)), self.view)
    }

    fn picture(&self) -> Picture {
        serial::render(&self.frame(), &bricks_of(&self.volume))
    }

    fn rounding(&self, shift: f64) -> Rounding {
        let c = Classifier::new(&self.spec.transfer, &self.spec.volume, Compositing::Linear);
        let integers = (self.spec.quality.sums == Sums::I32).then(|| c.payload_max());
        Rounding { thickness: self.spec.quality.thickness, integers, shift }
    }

    /// From the middle of the picture, in vox.
    fn offset(&self, x: u32, y: u32, scale: f64) -> [f64; 2] {
        let at = |p: u32, n: u32| (f64::from(p) + 0.5 - f64::from(n) / 2.0) / scale;
        [at(x, self.view.size[0]), at(y, self.view.size[1])]
    }
}

/// A block of equal voxels, `across` wide and high and `deep` layers deep.
fn block(across: u32, deep: u32) -> Volume {
    Volume::from_fn_u8("block", [across, deep, across], |_, _, _| 100)
}

fn stack(across: u32, layers: Vec<Layer>) -> LayerStack {
    let n = across as i32;
    LayerStack { profile: profile(), across: [0..n, 0..n], layers }
}

/// The tent only where no position is rounded: its slope jumps, and what a shift does to it is not
/// bounded by the slope where it was.
#[test]
fn spline_kernel_walls_stay_within_rounding_bounds() {
    let n = 8;
    for (kernel, scale) in [(Kernel::Bspline, 4.0), (Kernel::Bspline, 3.7), (Kernel::Tent, 4.0)] {
        for (sigma, thickness) in [(0.05, 1.0), (2.0, 1.0), (2.0, 0.3), (0.5, 3.5)] {
            let tf = extinctions(vec![[0.0, 1.0, 0.5, 0.25]], vec![[0.0, sigma]]);
            let q = Quality { kernel, thickness, ..Quality::before() };
            let shot = Shot::new(block(n, 6), tf, q, DVec3::Y, (n, scale));
            let scale = f64::from(shot.view.size[1]) / (f64::from(shot.view.size[1]) / scale);
            let layers = vec![Layer { sigma, rgb: [1.0, 0.5, 0.25] }; 6];
            let stack = LayerStack { profile: Profile::from_quality(&q), ..stack(n, layers) };
            let shift = if scale == 4.0 { 0.0 } else { 0.5 / f64::from(SUBPIXELS) / scale };
            let what = format!("{kernel:?}, {sigma} in sheets of {thickness}");
            let most = judge(&shot, &shot.picture(), &stack, scale, shift, &what);
            println!("{what}: {most:.3} of the bound");
            assert!(most > 0.01, "a bound that nothing comes near says nothing: {most}");
        }
    }
}

/// Pixels of `picture` against the stack; the largest share of its bound that an error takes.
fn judge(
    shot: &Shot,
    picture: &Picture,
    stack: &LayerStack,
    scale: f64,
    shift: f64,
    what: &str,
) -> f64 {
    let middle = (f64::from(stack.across[0].end) - 1.0) / 2.0;
    let how = shot.rounding(shift);
    let [w, h] = shot.view.size;
    let mut most = 0.0f64;
    for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
        let [u, v] = shot.offset(x, y, scale);
        let at = [middle - u, middle - v];
        let want = stack.pixel(at);
        let got = picture.pixels[(y * w + x) as usize].map(f64::from);
        let [alpha, colour] = stack.rounding_bound(at, &how);
        for c in 0..4 {
            let (off, bound) = ((got[c] - want[c]).abs(), if c == 3 { alpha } else { colour });
            assert!(off <= bound, "{what}, pixel {x},{y}: {got:?}, want {want:?} within {bound:e}");
            most = most.max(off / bound.max(1e-300));
        }
    }
    most
}

#[test]
fn extinctions_from_faint_to_stiff_stay_within_rounding_bounds() {
    let (n, scale) = (8, 4.0);
    for e in [-9, -6, -3, 0, 3, 6, 9] {
        let sigma = libm::pow(10.0, f64::from(e));
        let tf = extinctions(vec![[0.0, 0.25, 0.5, 1.0]], vec![[0.0, sigma]]);
        let shot = Shot::new(block(n, n), tf, Quality::before(), DVec3::Y, (n, scale));
        assert_eq!(shot.spec.quality.sums == Sums::F32, sigma > 12.0);
        let layer = Layer { sigma, rgb: [0.25, 0.5, 1.0] };
        let stack = stack(n, vec![layer; n as usize]);
        let most = judge(&shot, &shot.picture(), &stack, scale, 0.0, &format!("1e{e}"));
        println!("1e{e}: {most:.3} of the bound");
    }
}

/// Rounded positions are the largest error where voxels miss the subpixels, and have a bound.
#[test]
fn off_grid_wall_stays_within_position_rounding_bound() {
    let (n, scale) = (10, 3.7);
    for sigma in [0.05, 2.0] {
        let tf = extinctions(vec![[0.0, 1.0, 0.5, 0.25]], vec![[0.0, sigma]]);
        let shot = Shot::new(block(n, 6), tf, Quality::before(), DVec3::Y, (n, scale));
        let scale = f64::from(shot.view.size[1]) / (f64::from(shot.view.size[1]) / scale);
        let stack = stack(n, vec![Layer { sigma, rgb: [1.0, 0.5, 0.25] }; 6]);
        let shift = 0.5 / f64::from(SUBPIXELS) / scale;
        let most = judge(&shot, &shot.picture(), &stack, scale, shift, &format!("{sigma}"));
        println!("{sigma}: {most:.3} of the bound");
        assert!(most > 0.05, "a bound that nothing comes near says nothing: {most}");
    }
}

#[test]
fn ten_thousand_layers_of_extinction_1e_minus_6_add_up() {
    let (n, deep, scale) = (2, 10_000, 4.0);
    let sigma = -libm::log1p(-1e-6);
    let tf = extinctions(vec![[0.0, 1.0, 1.0, 1.0]], vec![[0.0, sigma]]);
    let shot = Shot::new(block(n, deep), tf, Quality::before(), DVec3::Y, (n, scale));
    let stack = stack(n, vec![Layer { sigma, rgb: [1.0; 3] }; deep as usize]);
    let most = judge(&shot, &shot.picture(), &stack, scale, 0.0, "layers");
    println!("{most:.3} of the bound");
}

/// Sheets up to a depth hold just what lies in front of it: error functions, not layers.
#[test]
fn partial_slab_has_the_optical_depth_in_front_of_its_border() {
    let (n, scale, d) = (8, 4.0, 0.7);
    let sigma = 0.3;
    let tf = extinctions(vec![[0.0, 1.0, 1.0, 1.0]], vec![[0.0, sigma]]);
    let q = Quality { thickness: d, ..Quality::before() };
    let shot = Shot::new(block(n, n), tf, q, DVec3::Y, (n, scale));
    let stack = stack(n, vec![Layer { sigma, rgb: [1.0; 3] }; n as usize]);
    let (frame, bricks) = (shot.frame(), bricks_of(&shot.volume));
    let whole = Rect::from_size(shot.view.size);
    let how = shot.rounding(0.0);
    for end in [-7, -3, 0, 2, 5] {
        let blank = tile::blank(whole);
        let sheets = SheetRange::new(-20, end);
        let mut scratch = Scratch::default();
        let (pixels, _): (TilePixels, _) =
            tile::render(&frame, Simd::detect(), whole, sheets, &bricks, &blank, &mut scratch);
        let mut state = FrameState::new(shot.view.size);
        state.add_slab_tile(whole, &pixels);
        let picture = state.to_picture();
        for x in 0..shot.view.size[0] {
            let y = shot.view.size[1] / 2;
            let [u, v] = shot.offset(x, y, scale);
            let at = [3.5 - u, 3.5 - v];
            let want = -libm::expm1(-stack.optical_depth(at, f64::from(end) * d));
            let got = f64::from(picture.pixels[(y * shot.view.size[0] + x) as usize][3]);
            let [bound, _] = stack.rounding_bound(at, &how);
            // Depths are rounded to 1/256 of a sheet: half of that of the field at the border.
            let border =
                0.5 * d / 256.0 * 1.01 * sigma * stack.optical_depth(at, 1e9) / (sigma * 8.0);
            assert!((got - want).abs() <= bound + border, "{end}, {x}: {got} {want}");
        }
    }
}

/// A Gaussian from an axis, where sums over voxels are products, and from a side where they are
/// not, and Poisson's formula says how far a smooth field is.
#[test]
fn gaussian_blob_renders_its_line_integrals() {
    let (n, scale, peak) = (36u32, 3.0, 0.2);
    let wide = f64::from(n) / 12.0;
    let centre = (f64::from(n) - 1.0) / 2.0;
    let lattice = Lattice::from_spacing([n; 3], [1.0; 3]);
    let factor = |i: u32| (-(f64::from(i) - centre).powi(2) / (2.0 * wide * wide)).exp();
    let samples = (0..n * n * n)
        .map(|at| (factor(at % n) * factor(at / n % n) * factor(at / n / n)) as f32)
        .collect();
    let volume =
        Volume::new("bell", "f32", false, lattice, Samples::F32(samples), ValueMap::IDENTITY);
    let blob = GaussianBlob { profile: profile(), peak, std: wide, voxels: n };
    for (to_eye, axis) in [(DVec3::Y, true), (DVec3::new(0.53, 0.71, 0.36), false)] {
        let tf = extinctions(vec![[0.0, 1.0, 0.5, 0.25]], vec![[0.0, 0.0], [1.0, peak]]);
        let shot = Shot::new(volume.clone(), tf, Quality::before(), to_eye, (n, scale));
        let picture = shot.picture();
        let shift = 0.5 / f64::from(SUBPIXELS) / scale;
        let how = shot.rounding(shift);
        let [w, h] = shot.view.size;
        let mut most = 0.0f64;
        for (x, y) in (0..w * h).step_by(131).map(|i| (i % w, i / w)) {
            let at = shot.offset(x, y, scale);
            let (tau, aliasing) = if axis {
                (blob.depth_along_axis(at), 0.0)
            } else {
                (blob.depth_from(at), blob.aliasing_bound(at, &shot.view.eye_from_index))
            };
            // Along an axis each voxel may be moved; from a side take the same, at most.
            let moved = blob.position_bound(at, shift) + aliasing;
            let want = -libm::expm1(-tau);
            let got = f64::from(picture.pixels[(y * w + x) as usize][3]);
            let [bound, _] = blob.rounding_bound(tau, moved, &how);
            let off = (got - want).abs();
            assert!(off <= bound, "axis {axis}, {x},{y}: {got}, want {want} within {bound:e}");
            most = most.max(off / bound);
        }
        println!("axis {axis}: {most:.3} of the bound");
    }
}

/// The order of convergence from rendered pictures, against a closed form: a colour ramp through
/// a medium, seen along an axis with voxels on the subpixels, so that no position is rounded.
#[test]
fn pictures_converge_with_sheet_thickness_at_the_order_of_the_colour_rule() {
    let (n, deep, scale) = (9u32, 20u32, 4.0);
    let sigma = 0.29;
    let ramp = |j: u32| f64::from(j) / f64::from(deep - 1);
    let volume = Volume::from_fn_u8("ramp", [n, deep, n], |_, j, _| 10 + 10 * j as u8);
    // The eye is at +y: high j in front.
    let layers = (0..deep).rev().map(|j| Layer { sigma, rgb: [ramp(j), 1.0 - ramp(j), 0.5] });
    let stack = stack(n, layers.collect());
    let error = |compositing, thickness| {
        let tf =
            extinctions(vec![[10.0, 0.0, 1.0, 0.5], [200.0, 1.0, 0.0, 0.5]], vec![[0.0, sigma]]);
        let q = Quality { compositing, thickness, ..Quality::before() };
        let shot = Shot::new(volume.clone(), tf, q, DVec3::Y, (n, scale));
        let picture = shot.picture();
        let w = shot.view.size[0];
        let (mut squares, mut count) = (0.0, 0.0);
        for (x, y) in (20..48).step_by(9).flat_map(|x| (20..48).step_by(9).map(move |y| (x, y))) {
            let [u, v] = shot.offset(x, y, scale);
            let want = stack.pixel([4.0 - u, 4.0 - v]);
            let got = picture.pixels[(y * w + x) as usize];
            for c in 0..3 {
                let off: f64 = (f64::from(got[c]) - want[c]) * 255.0;
                squares += off * off;
                count += 1.0;
            }
        }
        f64::sqrt(squares / count)
    };
    let orders = |rule, from: &[f64]| -> Vec<f64> {
        let errors: Vec<f64> = from.iter().map(|&d| error(rule, d)).collect();
        println!("{rule:?}: {errors:?}");
        errors.windows(2).map(|e| libm::log2(e[0] / e[1])).collect()
    };
    let constant = orders(Compositing::Constant, &[1.0, 0.5, 0.25, 0.125]);
    assert!(constant.iter().all(|o| (1.8..2.2).contains(o)), "constant: {constant:?}");
    // Below 1/4 the steps of the closed form and f32 are as large as linear's error.
    let linear = orders(Compositing::Linear, &[1.0, 0.5, 0.25]);
    assert!(linear.iter().all(|&o| o > 3.0), "linear: {linear:?}");
}
