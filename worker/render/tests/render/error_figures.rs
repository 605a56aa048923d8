use slabcast_common::image::Background;
use slabcast_render::judge::reference::ErrorFigures;

#[test]
fn error_figures_follow_the_contract() {
    let black = Background::Colour([0.0; 3]);
    let got = [[0.0f32; 4], [0.5, 0.5, 0.5, 1.0], [0.0; 4], [1.0, 1.0, 1.0, 1.0]];
    let mut want = got.map(|p| p.map(f64::from));
    assert_eq!(
        ErrorFigures::compare(&got, &want, black),
        ErrorFigures { n_pixels: 2, ..ErrorFigures::default() },
        "blank pixels do not count"
    );
    want[1][0] += 2.0 / 255.0;
    want[2][3] = 0.5 / 255.0;
    let f = ErrorFigures::compare(&got, &want, black);
    assert_eq!(f.n_pixels, 3);
    assert!((f.max - 2.0).abs() < 1e-12 && (f.share_above_1 - 1.0 / 3.0).abs() < 1e-12);
    assert!((f.rmse - (4.25f64 / 12.0).sqrt()).abs() < 1e-12, "{}", f.rmse);
    // Linear 0.5 is level 187.5, rounded to 188; 2/255 more is 189.
    assert!((f.rmse_srgb8 - (1.0f64 / 9.0).sqrt()).abs() < 1e-12, "{}", f.rmse_srgb8);
    let many = vec![[0.0f32, 0.0, 0.0, 1.0]; 2000];
    let mut want = many.iter().map(|p| p.map(f64::from)).collect::<Vec<_>>();
    for (i, p) in want.iter_mut().take(3).enumerate() {
        p[1] += (3 - i) as f64 / 255.0;
    }
    let f = ErrorFigures::compare(&many, &want, black);
    assert!((f.most_999 - 1.0).abs() < 1e-12, "two of two thousand are off by more: {f:?}");
    let spoiled = [[f32::NAN, 0.0, 0.0, 1.0]];
    let f = ErrorFigures::compare(&spoiled, &[[0.0, 0.0, 0.0, 1.0]], black);
    assert_eq!((f.max, f.share_above_1), (f64::INFINITY, 1.0));
}
