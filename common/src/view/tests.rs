use super::*;
use proptest::prelude::*;

fn camera(azimuth: f64, tilt: f64, projection: CameraProjection) -> Camera {
    let (s, c) = (libm::sin(azimuth), libm::cos(azimuth));
    Camera { to_eye: DVec3::new(s, c, tilt), up: DVec3::Z, target: DVec3::ZERO, projection }
}

#[test]
fn floor_and_ceil_equal_the_librarys() {
    let ones = [0.0, -0.0, 0.5, 1.5, 2.5, 1e-300, 2f64.powi(50) + 0.5, 2f64.powi(51), 1e300];
    let near = ones.iter().flat_map(|x| [x.next_down(), *x, x.next_up()]);
    for x in near.flat_map(|x| [x, -x]).chain([f64::INFINITY, f64::NEG_INFINITY]) {
        assert!(floor(x) == libm::floor(x) && ceil(x) == libm::ceil(x), "{x}");
    }
    assert!(floor(f64::NAN).is_nan() && ceil(f64::NAN).is_nan());
}

#[test]
fn rounding_goes_to_the_nearest_integer() {
    assert_eq!(round_i64(-1e15 + 0.25), -1_000_000_000_000_000);
    for (x, want) in [(0.4, 0), (0.6, 1), (-0.6, -1), (1e9 + 0.3, 1_000_000_000), (-7.49, -7)] {
        assert_eq!(round_i32(x), want, "{x}");
        assert_eq!(round_i64(x), i64::from(want), "{x}");
    }
}

#[test]
fn picture_axes_are_right_handed() {
    // Seen from +y (the front), +x must be on the left: right = forward x up = -y x z = -x.
    let l = Lattice::from_spacing([9, 9, 9], [2.0; 3]);
    let c = camera(0.0, 0.0, CameraProjection::Ortho { height: 36.0 });
    let v = View::new(&l, &c, [90, 90], &Quality::before()).unwrap();
    let at = |p: [u32; 3]| {
        let e = v.corner_in_eye(p);
        v.screen(e.x, e.y, v.scale_at(0).unwrap()).map(|s| s as f64 / f64::from(SUBPIXELS))
    };
    assert_eq!(at([4, 4, 4]), [45.0, 45.0]);
    assert_eq!(at([8, 4, 4]), [45.0 - 8.0 * 2.5, 45.0]);
    assert_eq!(at([4, 4, 8]), [45.0, 45.0 - 8.0 * 2.5]);
    assert!(v.corner_in_eye([4, 8, 4]).z < 0.0, "the front is nearer");
}

#[test]
fn views_depend_neither_on_unit_nor_on_origin() {
    let c = camera(0.3, 0.2, CameraProjection::Ortho { height: 36.0 });
    let q = Quality::before();
    let l = Lattice::from_spacing([9, 7, 5], [2.0; 3]);
    let v = View::new(&l, &c, [64, 48], &q).unwrap();
    let far = Lattice { origin: DVec3::splat(2e7), ..l };
    assert_eq!(v, View::new(&far, &c, [64, 48], &q).unwrap());
    let big = Lattice::from_spacing([9, 7, 5], [2.0 * 1048576.0; 3]);
    let cb = Camera { projection: CameraProjection::Ortho { height: 36.0 * 1048576.0 }, ..c };
    assert_eq!(v, View::new(&big, &cb, [64, 48], &q).unwrap());
}

#[test]
fn with_thickness_of_equals_a_view_made_with_that_thickness() {
    let p = CameraProjection::Ortho { height: 36.0 };
    for spacing in [[1.0; 3], [1.0, 1.0, 2.5], [0.3, 1.7, 1.0]] {
        let l = Lattice::from_spacing([9, 7, 5], spacing);
        for tilt in [0.0, 0.7] {
            let of = |q| View::new(&l, &camera(0.3, tilt, p), [64, 48], &q).unwrap();
            let q = Quality::before();
            let other = Quality { thickness: 0.5 * q.thickness, ..q };
            assert_eq!(of(q).with_thickness_of(&other), of(other), "{spacing:?}, tilt {tilt}");
            assert_ne!(of(q), of(other));
        }
    }
    // It is more than the thickness: widths of what leans.
    let l = Lattice::from_spacing([9, 7, 5], [1.0, 1.0, 2.5]);
    let q = Quality::before();
    let leaning = View::new(&l, &camera(0.3, 0.7, p), [64, 48], &q).unwrap();
    let thin = leaning.with_thickness_of(&Quality { thickness: 0.25, ..q });
    assert!(thin.kernel_std.y < leaning.kernel_std.y, "{thin:?}");
}

#[test]
fn undrawable_cameras_are_refused_by_field() {
    let l = Lattice::from_spacing([9, 7, 5], [2.0; 3]);
    let q = Quality::before();
    let good = camera(0.3, 0.2, CameraProjection::Ortho { height: 36.0 });
    let field = |c: Camera, size| View::new(&l, &c, size, &q).unwrap_err().field;
    assert_eq!(field(Camera { to_eye: DVec3::NAN, ..good }, [9, 9]), "eye");
    assert_eq!(field(Camera { up: DVec3::ZERO, ..good }, [9, 9]), "up");
    assert_eq!(field(Camera { target: DVec3::splat(1e12), ..good }, [9, 9]), "target");
    assert_eq!(field(good, [0, 9]), "size");
    assert_eq!(field(good, [9, 1_000_000]), "size");
    let p = CameraProjection::Ortho { height: f64::NAN };
    assert_eq!(field(Camera { projection: p, ..good }, [9, 9]), "height");
    let p = CameraProjection::Persp { fov: 180.0, distance: 9.0 };
    assert_eq!(field(Camera { projection: p, ..good }, [9, 9]), "fov");
    let p = CameraProjection::Persp { fov: 0.01, distance: 1e-4 };
    assert_eq!(field(Camera { projection: p, ..good }, [8192, 8192]), "eye");
}

proptest! {
    /// Every pixel and sheet that a voxel's sections touch lies in its box's projection.
    #[test]
    fn projection_of_a_box_holds_its_voxels(
        azimuth in 0.0..6.3f64, tilt in -2.0..2.0f64, d in 0.02..5.0f64,
        persp in any::<bool>(), near in 1.0..30.0f64, pick in (0u32..8, 0u32..8, 0u32..8),
        corner in (0u32..2, 0u32..2, 0u32..2), aniso in 1.0..4.0f64,
    ) {
        let l = Lattice::from_spacing([16; 3], [1.0, 1.0, aniso]);
        let p = if persp {
            CameraProjection::Persp { fov: 40.0, distance: near }
        } else {
            CameraProjection::Ortho { height: 25.0 }
        };
        let q = Quality { thickness: d, ..Quality::before() };
        let v = View::new(&l, &camera(azimuth, tilt, p), [120, 100], &q).unwrap();
        let base = [corner.0 * 8, corner.1 * 8, corner.2 * 8];
        let boxed = TightBox { lo: base, hi: base.map(|x| x + 7) };
        let projected = v.project(&boxed);
        prop_assert_eq!(v.project_rect(&boxed), projected.map(|p| p.rect));
        let eye = v.corner_in_eye(base) + v.offset_in_eye([pick.0, pick.1, pick.2]);
        let phases = v.depth_phases();
        let zq = f64::from(v.depth_in_phases(eye.z)) / f64::from(phases);
        let reach = v.kernel_radius.z / d;
        for k in libm::floor(zq - reach) as i32..=libm::floor(zq + reach) as i32 {
            let Some(scale) = v.scale_at(k) else { continue };
            let [x, y] = v.screen(eye.x, eye.y, scale).map(|s| s as f64 / f64::from(SUBPIXELS));
            let (rx, ry) = (v.kernel_radius.x * scale, v.kernel_radius.y * scale);
            let first = [libm::ceil(x - rx - 0.5).max(0.0), libm::ceil(y - ry - 0.5).max(0.0)];
            let last = [libm::floor(x + rx - 0.5).min(119.0), libm::floor(y + ry - 0.5).min(99.0)];
            if first[0] > last[0] || first[1] > last[1] { continue }
            let Some(pr) = projected else {
                return Err(TestCaseError::fail("a visible voxel in an invisible box"));
            };
            prop_assert!(pr.sheets.first <= k && k < pr.sheets.end, "sheet {k} of {:?}", pr.sheets);
            prop_assert!(pr.rect.x0 as f64 <= first[0] && last[0] < pr.rect.x1 as f64, "{x}+-{rx} in {:?}", pr.rect);
            prop_assert!(pr.rect.y0 as f64 <= first[1] && last[1] < pr.rect.y1 as f64, "{y}+-{ry} in {:?}", pr.rect);
        }
    }
}

/// Long voxels would lie in thousands of thin sheets, which takes hours and gigabytes.
#[test]
fn steps_that_are_too_unlike_are_refused_with_the_number_of_sheets() {
    let oblique = camera(0.8, 0.5, CameraProjection::Ortho { height: 90.0 });
    let view = |ratio: f64, quality: &Quality| {
        let l = Lattice::from_spacing([64; 3], [1.0, 1.0, 1.0 / ratio]);
        View::new(&l, &oblique, [64, 64], quality)
    };
    assert!(view(100.0, &Quality::default()).is_ok());
    let e = view(10_000.0, &Quality::default()).unwrap_err();
    assert_eq!(e.field, "thickness");
    assert!(e.problem.contains("sheets, and at most 1024 are drawn; resample"), "{}", e.problem);
    // The thinnest sheets on an even lattice stay.
    let thin = Quality { thickness: 1.0 / 64.0, ..Quality::default() };
    assert!(view(1.0, &thin).is_ok());
}
