use glam::DMat3;
use glam::DVec3;
use slabcast_render::judge::analytic::*;

const PROFILE: fn() -> Profile = || Profile::new(0.6, 2.0);

#[test]
fn layered_stack_closed_form_equals_numerical_integration() {
    let layers = (0..12)
        .map(|j| Layer { sigma: 0.05 * f64::from(j), rgb: [f64::from(j) / 11.0, 0.5, 1.0] })
        .collect();
    let stack = LayerStack { profile: PROFILE(), across: [0..9, 0..9], layers };
    for at in [[4.1, 3.7], [-0.4, 4.0], [9.3, 8.2]] {
        let lateral = stack.lateral(at);
        let (mut depth, mut light, n) = (0.0f64, 0.0, 100_000);
        let h = 16.0 / f64::from(n);
        for i in 0..n {
            let z = -8.0 + (f64::from(i) + 0.5) * h;
            let (mut sigma, mut red) = (0.0, 0.0);
            for (j, l) in stack.layers.iter().enumerate() {
                let w = l.sigma * stack.profile.at(z - stack.z(j)) * lateral;
                sigma += w;
                red += w * l.rgb[0];
            }
            light += red * h * (-(depth + sigma * h * 0.5)).exp();
            depth += sigma * h;
        }
        let got = stack.pixel(at);
        assert!((got[3] + libm::expm1(-depth)).abs() < 1e-7, "{at:?}");
        assert!((got[0] - light).abs() < 1e-3 / 255.0, "{at:?}: {} {light}", got[0]);
        assert!((got[0] - light).abs() <= stack.thickness_bound(at, STEP) + 1e-7, "{at:?}");
    }
}

#[test]
fn gaussian_blob_closed_form_equals_the_voxel_sum_within_aliasing_bound() {
    let blob = GaussianBlob { profile: PROFILE(), peak: 0.2, std: 4.0, voxels: 48 };
    for (direction, alone) in [
        (DVec3::new(0.53, 0.71, 0.36), true),
        (DVec3::new(0.2, 0.9, -0.5), true),
        (DVec3::Y, false),
    ] {
        let z = direction.normalize();
        let x = z.cross(DVec3::Z).normalize();
        let m = DMat3::from_cols(x, z.cross(x), z).transpose();
        for (px, py) in [(0.0, 0.0), (1.37, -2.9), (6.2, 0.4)] {
            let mut sum = 0.0;
            for (i, j, k) in blob.places().flat_map(|i| {
                blob.places().flat_map(move |j| blob.places().map(move |k| (i, j, k)))
            }) {
                let eye = m * DVec3::new(i, j, k);
                let w = blob.profile.at(px - eye.x) * blob.profile.at(py - eye.y);
                sum += blob.peak * blob.density(i) * blob.density(j) * blob.density(k) * w;
            }
            let smooth = blob.depth_from([px, py]);
            let aliasing = blob.aliasing_bound([px, py], &m);
            println!("{direction}: {sum} {smooth} off {:e} of {aliasing:e}", sum - smooth);
            assert!((sum - smooth).abs() <= aliasing + 1e-6 * smooth, "{direction}, {px},{py}");
            if alone {
                assert!(aliasing < 2e-3 * blob.depth_from([0.0, 0.0]), "{aliasing}");
            } else {
                let exact = blob.depth_along_axis([px, py]);
                assert!((exact - sum).abs() < 1e-9, "{exact} {sum}");
            }
        }
    }
}
