use slabcast_common::quality::Kernel;
use slabcast_render::judge::reference::profile::*;

#[test]
fn reference_profile_table_equals_its_formula() {
    for (std, radius) in [(0.6, 2.0), (0.5, 2.0), (0.7, 2.0), (0.3, 1.0), (1.9, 6.1)] {
        let cut = Profile::gaussian(std, radius);
        for p in [cut.clone(), cut.untruncated(11.0)] {
            let Form::Gaussian(g) = p.form else { panic!("a Gaussian") };
            let peak = p.at(0.0);
            let (mut off, mut share) = (0.0f64, 0.0f64);
            for i in 0..100_000 {
                let u = p.radius * (f64::from(i) + 0.37) / 1e5;
                let want = (libm::exp(-u * u * g.steep) - g.edge) * g.per_norm;
                off = off.max((p.at(u) - want).abs() / peak);
                share = share.max((p.at(u) - want).abs() / want);
                assert_eq!(p.at(u), p.at(-u));
            }
            println!("std {std}, radius {}: {off:e} of the peak, {share:e}", p.radius);
            assert!(off < 2e-11 && share < 1e-7, "std {std}: {off:e} {share:e}");
            assert_eq!([p.at(p.radius), p.at(p.radius * 2.0)], [0.0; 2]);
        }
    }
}

#[test]
fn untruncated_gaussian_profile_integrates_to_one() {
    let p = Profile::gaussian(0.6, 2.0).untruncated(11.0);
    assert!((3.6..4.5).contains(&p.radius), "{}", p.radius);
    assert!((p.integral_to(p.radius) - 1.0).abs() < 1e-10);
    let stiff = Profile::gaussian(0.6, 2.0).untruncated(1e9);
    assert!(stiff.radius > p.radius + 1.0);
    assert!(libm::erfc(stiff.radius / (0.6 * 2f64.sqrt())) * 1e9 < 1e-9);
}

#[test]
fn spline_profiles_are_box_convolutions() {
    // The tent is a box of one step with itself; twice more that box make the cubic one.
    let step = 1.7;
    let tent = Profile::new(Kernel::Tent, step / 6f64.sqrt(), step);
    let cubic = Profile::new(Kernel::Bspline, step / 3f64.sqrt(), 2.0 * step);
    let n = 400;
    for i in -50..=50 {
        let u = f64::from(i) * 0.05 * step;
        assert!((tent.at(u) - (1.0 - u.abs() / step).max(0.0) / step).abs() < 1e-15, "{u}");
        // The tent with itself.
        let h = 2.0 * step / f64::from(n);
        let at = |j: i32| -step + (f64::from(j) + 0.5) * h;
        let want: f64 = (0..n).map(|j| tent.at(at(j)) * tent.at(u - at(j)) * h).sum();
        assert!((cubic.at(u) - want).abs() < 1e-5, "{u}: {} {want}", cubic.at(u));
        for p in [&tent, &cubic] {
            let h = 0.2 * step / f64::from(n);
            let at = |j: i32| u + (f64::from(j) + 0.5) * h;
            let (mut sum, mut moment) = (0.0, 0.0);
            for j in 0..n {
                sum += p.at(at(j)) * h;
                moment += p.at(at(j)) * at(j) * h;
            }
            let d = 0.2 * step;
            assert!((p.integral_to(u + d) - p.integral_to(u) - sum).abs() < 1e-6, "{u}");
            assert!((p.moment(u, d) - moment).abs() < 1e-6, "{u}");
            assert!((p.integral_to(p.radius) - 1.0).abs() < 1e-14);
            assert_eq!(p.untruncated(11.0).radius, p.radius);
        }
    }
}

#[test]
fn profile_slope_is_the_derivative_of_the_profile() {
    for kernel in [Kernel::Gaussian, Kernel::Bspline, Kernel::Tent] {
        let p = Profile::new(kernel, 0.6, 2.0);
        let h = 1e-6;
        for i in -230..=230 {
            let u = f64::from(i) * 0.01 + 0.003;
            let [value, slope] = p.with_slope(u);
            let want = (p.at(u + h) - p.at(u - h)) / (2.0 * h);
            assert!((slope - want).abs() < 1e-8, "{kernel:?} {u}: {slope} {want}");
            assert_eq!(value, p.at(u));
        }
    }
}
