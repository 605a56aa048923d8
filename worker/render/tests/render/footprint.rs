use proptest::prelude::*;
use slabcast_common::quality::Kernel;
use slabcast_common::quality::Quality;
use slabcast_render::primitives::footprint::*;
use std::sync::Arc;

/// Each kernel, in several widths.
fn profiles() -> Vec<Profile> {
    let gaussians = [(0.6, 2.0), (0.5, 2.0), (0.7, 2.0), (0.4, 1.0), (1.0, 3.0)];
    let mut all: Vec<_> = gaussians.map(|(std, r)| Profile::gaussian(std, r)).to_vec();
    for kernel in [Kernel::Bspline, Kernel::Tent] {
        let [std, radius] = Quality { kernel, ..Quality::before() }.kernel_shape();
        all.extend([1.0, 2.5].map(|step| Profile::new(kernel, std * step, radius * step)));
    }
    all
}

#[test]
fn section_tables_are_cached_across_frames() {
    let shelf = Shelf::default();
    for p in profiles() {
        for (thickness, phases, merged) in [(1.0, 256, true), (1.0, 256, false), (0.5, 512, false)]
        {
            let kept = shelf.sections(&p, thickness, phases, merged);
            assert!(Arc::ptr_eq(&kept, &shelf.sections(&p, thickness, phases, merged)));
            let made = Sections::new(&p, thickness, phases, merged);
            assert_eq!(kept.all(), made.all(), "{p:?} {thickness} {phases} {merged}");
            assert_eq!(kept.all_fixed(), made.all_fixed());
        }
    }
    assert!(shelf.sections.into_inner().expect("no panic").len() <= SECTIONS);
}

#[test]
fn kernel_profile_integrates_to_one_and_ends_at_zero() {
    for p in profiles() {
        let (radius, n) = (p.radius, 20_000);
        let h = 2.0 * radius / f64::from(n);
        let (mut sum, mut square) = (0.0, 0.0);
        for i in 0..n {
            let u = -radius + (f64::from(i) + 0.5) * h;
            assert!((p.integral_to(u - 0.5 * h) - sum).abs() < 1e-7, "{p:?} at {u}");
            sum += p.at(u) * h;
            square += p.at(u) * h * u * u;
        }
        assert!((sum - 1.0).abs() < 1e-7, "{p:?}: {sum}");
        // A Gaussian's is that before it was cut.
        let cut = if p.kernel == Kernel::Gaussian { 0.2 * p.std } else { 1e-7 };
        assert!((square.sqrt() - p.std).abs() < cut, "{p:?}: {square}");
        assert!((p.integral_to(radius) - 1.0).abs() < 1e-12);
        assert!(p.integral_to(-radius).abs() < 1e-12);
        assert!((p.integral_to(0.0) - 0.5).abs() < 1e-12);
        assert!(p.at(radius - 1e-9) < 1e-6);
    }
}

proptest! {
    #[test]
    fn spline_kernels_are_a_partition_of_unity(
        phase in 0.0..1.0f64, step in 0.1..50.0f64, tent in any::<bool>(),
    ) {
        let kernel = if tent { Kernel::Tent } else { Kernel::Bspline };
        let [std, radius] = Quality { kernel, ..Quality::before() }.kernel_shape();
        let p = Profile::new(kernel, std * step, radius * step);
        let at = |k: i32| (f64::from(k) + phase) * step;
        let sum: f64 = (-3..=3).map(|k| p.at(at(k)) * step).sum();
        prop_assert!((sum - 1.0).abs() < 1e-14, "{sum}");
        // And so do their sections, of any thickness.
        let d = step * (0.01 + phase * 3.0);
        let sheet: f64 =
            (-9..=9).map(|k| p.integral_to(at(k) + d) - p.integral_to(at(k))).sum();
        prop_assert!((sheet * step / d - 1.0).abs() < 1e-12, "{sheet}");
    }
}

#[test]
fn merging_slivers_moves_little_light_between_sheets() {
    let [std, radius] = Quality::before().kernel_shape();
    let p = Profile::new(Kernel::Gaussian, std, radius);
    let given = |d: f64, most: f64| Sections::given_away(&p, d, 256, most);
    let opaque = given(1.0, 16.0 * std::f64::consts::LN_2);
    assert!((0.0078..5.0 / 512.0).contains(&opaque), "{opaque}");
    // Most shows where an optical depth of 1 lies in front.
    let one = given(1.0, 1.0);
    assert!((one - 0.0164 * (-1.0f64).exp()).abs() < 1e-4, "{one}");
    assert!(given(1.0, 0.01) < 2e-4);
    assert!(given(0.5, 1.0) < one);
    assert_eq!(given(2.0, 1.0), 0.0, "such sheets are not merged");
}

#[test]
fn section_weights_of_a_voxel_sum_to_one() {
    let all = [Kernel::Gaussian, Kernel::Bspline, Kernel::Tent];
    let all = all.map(|kernel| Quality { kernel, ..Quality::before() });
    let thick = [1.0 / 64.0, 0.25, 1.0, 1.7, 5.0, 300.0];
    for (q, d) in all.iter().flat_map(|q| thick.map(|d| (q, d))) {
        let [std, radius] = q.kernel_shape();
        let p = Profile::new(q.kernel, std, radius);
        let [whole, merged] = [false, true].map(|merged| Sections::new(&p, d, 256, merged));
        for z in [-5000, -257, -256, -1, 0, 1, 77, 255, 256, 9999] {
            for s in [&whole, &merged] {
                let (first, w) = s.of(z);
                let sum: f32 = w.iter().sum();
                assert!((sum - 1.0).abs() < 2e-6, "d {d}, z {z}: {sum}");
                assert_eq!(first, s.first(z));
                assert!(w.len() <= s.most());
            }
            // Exactly the sheets that the support [z - R, z + R] meets.
            let at = f64::from(z) / 256.0;
            let (front, w) = whole.of(z);
            let end = front + w.len() as i32;
            assert_eq!(front, (at - radius / d).floor() as i32);
            assert_eq!(end, (at + radius / d).ceil() as i32);
            // Or those but for slivers.
            let (first, w) = merged.of(z);
            let last = first + w.len() as i32;
            assert!(front <= first && last <= end && end - front - 1 <= last - first);
            let before = p.integral_to((f64::from(first) - at) * d);
            let behind = 1.0 - p.integral_to((f64::from(last) - at) * d);
            assert!(before < SLIVER / 5.0, "d {d}, z {z}: {before}");
            assert!(behind < SLIVER * 4.0, "d {d}, z {z}: {behind}");
        }
    }
}

#[test]
fn merging_slivers_leaves_four_one_vox_sheets_per_voxel() {
    let p = Profile::gaussian(0.6, 2.0);
    let most =
        |merged| [0.25, 0.5, 1.0, 2.0, 40.0].map(|d| Sections::new(&p, d, 256, merged).most());
    assert_eq!(most(false), [17, 9, 5, 3, 2]);
    assert_eq!(most(true), [16, 8, 4, 3, 2]);
}

/// The ripple of the default kernel on a constant field, worked out in docs/design/numerics.md
/// section 4: at most 0.6 % in any direction; here along the lattice and on a diagonal.
#[test]
fn gaussian_kernel_ripple_on_a_constant_field_stays_below_its_bound() {
    let p = Profile::gaussian(0.6, 2.0);
    let mut worst = 0.0f64;
    for i in 0..200 {
        let x = i as f64 / 200.0;
        let sum: f64 = (-4..=4).map(|k| p.at(x + k as f64)).sum();
        worst = worst.max((sum - 1.0).abs());
    }
    assert!(worst < 2e-3, "1-D ripple {worst}");
}
