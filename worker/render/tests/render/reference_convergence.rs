//! Convergence: thin sheets come to the reference, in the order of the colour rule, and the
//! splatter equals the same sheets in f64.

use crate::reference::{BLACK, JudgedScene, alpha, i32_sums, lattices, oblique, projections};
use slabcast_common::quality::{Compositing, Quality};
use slabcast_common::shade::Shading;
use slabcast_common::transfer::TransferFunction;
use slabcast_common::view::CameraProjection;
use slabcast_common::volume::Volume;
use slabcast_render::judge::reference::{
    ErrorFigures, Reference, SectionPlacement, SheetOptions, stratified,
};

/// Balls in each other, one opaque, in a lit scene.
fn balls(n: u32) -> Volume {
    Volume::from_fn_u8("balls", [n; 3], |i, j, k| {
        let p = [i, j, k].map(|x| (2.0 * f64::from(x) + 1.0) / f64::from(n) - 1.0);
        let r = |c: [f64; 3]| (0..3).map(|a| (p[a] - c[a]).powi(2)).sum::<f64>().sqrt();
        let outer = 60.0 * (0.95 - r([0.0; 3])).clamp(0.0, 0.2) / 0.2;
        let inner = 195.0 * ((0.5 - r([0.2, 0.1, -0.1])) / 0.15).clamp(0.0, 1.0);
        (outer + inner) as u8
    })
}

fn lit() -> TransferFunction {
    let mut tf = alpha(
        vec![[0.0, 0.1, 0.2, 0.9], [80.0, 0.9, 0.4, 0.1], [255.0, 1.0, 0.9, 0.8]],
        vec![[0.0, 0.0], [20.0, 0.02], [60.0, 0.04], [120.0, 0.99], [255.0, 0.9999]],
    );
    tf.shading = Shading::default();
    tf
}

/// Returns the errors of the splatted picture against the reference, over `n` pixels.
fn figures(
    asked: &JudgedScene,
    n: usize,
    judge: impl Fn(&Reference, &[[u32; 2]]) -> Vec<[f64; 4]>,
) -> ErrorFigures {
    let picture = asked.splatted();
    let [w, h] = picture.size;
    let sample = stratified([w, h], n, 5);
    let at = |p: &[u32; 2]| picture.pixels[(p[1] * w + p[0]) as usize];
    let got: Vec<_> = sample.iter().map(at).collect();
    ErrorFigures::compare(&got, &judge(&asked.reference(), &sample), BLACK)
}

/// The limit.
fn limit(reference: &Reference, sample: &[[u32; 2]]) -> Vec<[f64; 4]> {
    reference.pixels(sample)
}

/// Returns the reference's pixels in f64 sheets of the view's thickness.
fn same_sheets(reference: &Reference, sample: &[[u32; 2]]) -> Vec<[f64; 4]> {
    sample.iter().map(|&[x, y]| reference.at_same_thickness(x, y)).collect()
}

#[test]
fn thin_sheets_converge_to_the_reference_in_both_projections() {
    let n = 24;
    for projection in projections(n) {
        let q = Quality { thickness: 1.0 / 16.0, ..i32_sums() };
        let asked = JudgedScene::new(balls(n), lit(), q, oblique(projection), 96);
        let figures = figures(&asked, 512, limit);
        println!("{projection:?}: {figures:?}");
        assert!(figures.n_pixels > 150);
        assert!(figures.rmse < 0.05, "{projection:?}: {figures:?}");
    }
}

#[test]
fn thin_sheets_of_sheared_kernels_converge_to_the_reference() {
    let n = 16;
    for (lattice, projection) in lattices(n).into_iter().zip(projections(n).into_iter().cycle()) {
        let mut volume = balls(n);
        volume.lattice = lattice;
        let q = Quality { thickness: 1.0 / 16.0, ..i32_sums() };
        let asked = JudgedScene::new(volume, lit(), q, oblique(projection), 72);
        let figures = figures(&asked, 400, limit);
        println!("{projection:?}: {figures:?}");
        assert!(figures.n_pixels > 150);
        assert!(figures.rmse < 0.05, "{projection:?}: {figures:?}");
    }
}

/// Each section is drawn in one place, where it truly is smeared: that shows little.
#[test]
fn sheared_kernel_sheets_match_the_same_sheets_in_f64() {
    let n = 16;
    for (lattice, thickness) in
        lattices(n).into_iter().flat_map(|l| [0.5, 1.0, 3.0, 40.0].map(|d| (l, d)))
    {
        for projection in projections(n) {
            let mut volume = balls(n);
            volume.lattice = lattice;
            let q = Quality { thickness, ..i32_sums() };
            let asked = JudgedScene::new(volume, lit(), q, oblique(projection), 64);
            let figures = figures(&asked, 256, same_sheets);
            println!("{:?} {projection:?} {thickness}: {figures:?}", lattice.steps);
            let most = if thickness <= 1.0 { 0.05 } else { 0.8 };
            assert!(figures.rmse < most, "{projection:?} {thickness}: {figures:?}");
        }
    }
}

/// The splatter and the same sheets in f64 differ by rounding alone: in positions (1/256 pixel),
/// depths (1/256 sheet), tables and sums.
#[test]
fn splatter_matches_the_same_sheets_in_f64() {
    let n = 24;
    for projection in projections(n) {
        for compositing in [Compositing::Linear, Compositing::Constant, Compositing::Paper] {
            for thickness in [0.3, 1.0, 2.5] {
                let q = Quality { thickness, compositing, ..i32_sums() };
                let asked = JudgedScene::new(balls(n), lit(), q, oblique(projection), 64);
                let figures = figures(&asked, 512, same_sheets);
                println!("{projection:?} {compositing:?} {thickness}: {figures:?}");
                assert!(
                    figures.rmse < 0.15,
                    "{projection:?} {compositing:?} {thickness}: {figures:?}"
                );
            }
        }
    }
}

/// RMSE of sheets against the limit at 1, 1/2, 1/4 and 1/8 vox, in f64 so that nothing else shows:
/// for linear and for constant colour.
fn errors(projection: CameraProjection, section: SectionPlacement) -> [[f64; 4]; 2] {
    let sample = stratified([64, 64], 400, 3);
    let mut out = [[0.0; 4]; 2];
    for (i, thickness) in [1.0, 0.5, 0.25, 0.125].into_iter().enumerate() {
        let q = Quality { thickness, ..i32_sums() };
        let asked = JudgedScene::new(balls(20), lit(), q, oblique(projection), 64);
        let reference = asked.reference();
        let want = reference.pixels(&sample);
        let how = SheetOptions { section, rounded: false };
        let got: Vec<_> = sample
            .iter()
            .map(|&[x, y]| reference.by_sheets_linear_and_constant(x, y, how))
            .collect();
        for (rule, out) in out.iter_mut().enumerate() {
            let got: Vec<_> = got.iter().map(|p| p[rule].map(|x| x as f32)).collect();
            out[i] = ErrorFigures::compare(&got, &want, BLACK).rmse;
        }
    }
    out
}

fn orders(e: [f64; 4]) -> [f64; 3] {
    [0, 1, 2].map(|i| libm::log2(e[i] / e[i + 1]))
}

#[test]
fn constant_colour_rule_converges_at_second_order_and_linear_faster() {
    for projection in projections(20) {
        let [linear, constant] = errors(projection, SectionPlacement::MidPlane);
        println!("{projection:?}: constant {constant:?}, order {:?}", orders(constant));
        println!("{projection:?}: linear {linear:?}, order {:?}", orders(linear));
        assert!(orders(constant).iter().all(|o| (1.8..2.2).contains(o)), "{constant:?}");
        // In perspective a section's footprint lies at its sheet's mid-plane, which is of second
        // order however colour is treated; in parallel rays nothing hides the fourth.
        let (each, last) = match projection {
            CameraProjection::Ortho { .. } => (3.0, 4.0),
            CameraProjection::Persp { .. } => (1.9, 1.9),
        };
        assert!(orders(linear).iter().all(|&o| o > each), "{projection:?}: {linear:?}");
        assert!(orders(linear)[2] > last, "{projection:?}: {linear:?}");
        assert!((0..4).all(|i| 3.0 * linear[i] < constant[i]), "{linear:?} {constant:?}");
    }
}

/// The mid-plane is the whole reason: with the kernel integrated along the slanted ray in each
/// sheet, a perspective view converges as a parallel one does.
#[test]
fn exact_sections_restore_the_convergence_order_in_perspective() {
    let [_, persp] = projections(20);
    let [linear, _] = errors(persp, SectionPlacement::Exact);
    println!("exact: linear {linear:?}, order {:?}", orders(linear));
    assert!(orders(linear).iter().all(|&o| o > 3.0), "{linear:?}");
    let [middle, _] = errors(persp, SectionPlacement::MidPlane);
    assert!(10.0 * linear[3] < middle[3], "{linear:?} {middle:?}");
}
