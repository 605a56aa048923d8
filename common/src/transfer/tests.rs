use super::*;
use crate::math::srgb_from_linear;
use crate::quality::Kernel;
use crate::volume::{ColourValue, Digest32, ValueMap, Volume};
use proptest::prelude::*;

fn info(samples: Samples) -> VolumeInfo {
    let n = samples.len() as u32;
    let lattice = Lattice::from_spacing([n, 1, 1], [1.0; 3]);
    Volume::new("t", "t", false, lattice, samples, ValueMap::IDENTITY).info(Digest32::default())
}

fn tf(opacities: Vec<[f64; 2]>) -> TransferFunction {
    TransferFunction {
        version: 1,
        domain: Domain::Value,
        colors: vec![[0.0, 0.0, 0.0, 0.0], [100.0, 1.0, 1.0, 1.0]],
        opacities,
        color_space: ColorSpace::Linear,
        opacity_unit: OpacityUnit::AlphaPerVox,
        nan: NanColour::default(),
        gradient_opacity: vec![],
        shading: Shading::default(),
    }
}

#[test]
fn points_are_clamped_interpolated_and_stepped() {
    let tf = tf(vec![[10.0, 0.0], [20.0, 0.5], [20.0, 0.9], [30.0, 0.0]]);
    let info = info(Samples::U8((0..=255).collect()));
    let c = Classifier::new(&tf, &info, Compositing::Paper);
    let alpha = |v: u8| c.classify(&Samples::U8(vec![v]), 0).sigma;
    assert_eq!(alpha(5), 0.0);
    assert!((alpha(15) - 0.25).abs() < 1e-6);
    assert!((alpha(20) - 0.9).abs() < 1e-6, "the later point holds at the step");
    assert!((alpha(25) - 0.45).abs() < 1e-6);
    assert_eq!(alpha(200), 0.0);
    assert_eq!(c.support().intervals, vec![(11.0, 29.0)]);
    assert!((c.classify(&Samples::U8(vec![50]), 0).rgb[1] - 0.5).abs() < 1e-6);
}

#[test]
fn alpha_one_is_capped_and_extinction_is_not() {
    let mut tf = tf(vec![[0.0, 1.0]]);
    let info = info(Samples::U8(vec![3; 7]));
    let c = Classifier::new(&tf, &info, Compositing::Linear);
    assert_eq!(c.classify(&Samples::U8(vec![3]), 0).sigma, SIGMA_MAX as f32);
    assert!(!c.is_uncapped());
    tf.opacity_unit = OpacityUnit::Extinction;
    tf.opacities = vec![[0.0, 1e6]];
    let c = Classifier::new(&tf, &info, Compositing::Linear);
    assert_eq!(c.classify(&Samples::U8(vec![3]), 0).sigma, 1e6);
    assert!(c.is_uncapped());
    let sums = |sums| c.choose_sums(&Quality { sums, ..Quality::before() }, &info.lattice);
    assert_eq!(sums(Sums::Auto), Ok(Sums::F32));
    assert_eq!(sums(Sums::I32).unwrap_err().field, "sums");
}

#[test]
fn sixteen_bits_are_for_scenes_that_they_round_little_of() {
    // All codes occur; 100 vox from corner to corner.
    let mut info = info(Samples::U8((0..=255).collect()));
    info.lattice = Lattice::from_spacing([58; 3], [2.0; 3]);
    let sums = |points: Vec<[f64; 2]>, quality: Quality| {
        Classifier::new(&tf(points), &info, quality.compositing)
            .choose_sums(&quality, &info.lattice)
    };
    let q = Quality::before();
    let ramp = |top| vec![[0.0, 0.0], [255.0, top]];
    // One opacity: nothing is faint beside it.
    let step = |top| vec![[100.0, 0.0], [100.0, top]];
    assert_eq!(sums(ramp(0.06), q), Ok(Sums::I16));
    assert_eq!(sums(ramp(0.9), q), Ok(Sums::I32));
    assert_eq!(sums(step(0.9), q), Ok(Sums::I16));
    assert_eq!(sums(step(0.9999), q), Ok(Sums::I32));
    // Fog before a solid.
    assert_eq!(
        sums(vec![[50.0, 0.0], [50.0, 0.01], [200.0, 0.01], [200.0, 0.9]], q),
        Ok(Sums::I32)
    );
    // Nearer to the limit: less may be lost.
    for finer in [
        Quality { eps: 0.0, ..q },
        Quality { eps: 1.0 / 65536.0, ..q },
        Quality { thickness: 0.125, ..q },
        Quality { compositing: Compositing::Paper, ..q },
        Quality { kernel: Kernel::Tent, ..q },
        Quality { std: 0.4, ..q },
    ] {
        assert_eq!(sums(ramp(0.06), finer), Ok(Sums::I32), "{finer:?}");
    }
    assert_eq!(sums(ramp(0.9), Quality { eps: 1.0 / 32.0, ..q }), Ok(Sums::I16));
    // An explicit choice is kept.
    assert_eq!(sums(ramp(0.9), Quality { sums: Sums::I16, ..q }), Ok(Sums::I16));
    assert_eq!(sums(ramp(0.06), Quality { sums: Sums::I32, ..q }), Ok(Sums::I32));
}

#[test]
fn float_support_loses_no_voxel() {
    let mut values: Vec<f32> = (-300..300).map(|i| i as f32 * 0.173).collect();
    values.extend([f32::NAN, f32::INFINITY, f32::NEG_INFINITY]);
    let info = info(Samples::F32(values.clone()));
    for points in [
        vec![[-20.0, 0.0], [3.0, 0.4], [9.0, 0.0]],
        vec![[-20.0, 0.3], [3.0, 0.0], [9.0, 0.0], [12.0, 0.2]],
    ] {
        let mut tf = tf(points);
        tf.nan.opacity = 0.5;
        let c = Classifier::new(&tf, &info, Compositing::Linear);
        let support = c.support();
        let samples = Samples::F32(values.clone());
        for (i, &v) in values.iter().enumerate() {
            let look = c.classify(&samples, i);
            assert!(look.sigma.is_finite());
            if look.sigma > 0.0 {
                assert!(support.contains(v as f64), "{v} is visible but not in {support:?}");
            }
        }
        assert!(support.intervals.len() <= 2 && support.covers(&support));
    }
}

fn looks(tf: &TransferFunction) -> Vec<OpticalSample> {
    tf.check().unwrap();
    let volume = info(Samples::U8((0..=255).collect()));
    Classifier::new(tf, &volume, Compositing::Linear).table().to_vec()
}

fn ulps(a: f32, b: f32) -> u32 {
    a.to_bits().abs_diff(b.to_bits())
}

proptest! {
    /// Points and lines are multiples of 1/16, so that every number on them is exact.
    #[test]
    fn a_point_on_a_line_changes_nothing(
        ends in prop::collection::vec((0u32..=16, 0u32..=16, 0u32..=16, 0u32..=16), 2..9),
        which in any::<prop::sample::Index>(), at in 1u32..16,
    ) {
        let x = |i: usize| 16.0 * i as f64;
        let n = |i: u32| f64::from(i) / 16.0;
        let mut tf = tf(vec![]);
        let ends = ends.iter().enumerate();
        tf.colors = ends.clone().map(|(i, e)| [x(i), n(e.0), n(e.1), n(e.2)]).collect();
        tf.opacities = ends.map(|(i, e)| [x(i), n(e.3)]).collect();
        let want = looks(&tf);
        let i = which.index(tf.colors.len() - 1);
        let on = |a: f64, b: f64| a + (b - a) * n(at);
        let [a, b] = [tf.colors[i], tf.colors[i + 1]];
        tf.colors.insert(i + 1, std::array::from_fn(|c| on(a[c], b[c])));
        let [a, b] = [tf.opacities[i], tf.opacities[i + 1]];
        tf.opacities.insert(i + 1, [on(a[0], b[0]), on(a[1], b[1])]);
        prop_assert_eq!(&want, &looks(&tf));
        // A point twice, and points outside with the values that hold there anyway.
        tf.opacities.insert(i + 1, tf.opacities[i + 1]);
        tf.opacities.insert(0, [-3.0, tf.opacities[0][1]]);
        let [_, r, g, b] = tf.colors[tf.colors.len() - 1];
        tf.colors.push([400.0, r, g, b]);
        let got = looks(&tf);
        for (w, g) in want.iter().zip(&got) {
            prop_assert_eq!(w.sigma, g.sigma);
            // A constant is a (1 - t) + a t, which f64 may round.
            prop_assert!((0..3).all(|c| ulps(w.rgb[c], g.rgb[c]) <= 1));
        }
    }

    /// Any numbers: the point is off its line by the last bits of f64, of which f32 sees at
    /// most one step.
    #[test]
    fn a_rounded_point_on_a_line_changes_at_most_a_last_bit(
        (a, b) in (0.0..1.0f64, 0.0..1.0f64), t in 0.01..0.99f64, x in 1.0..200.0f64,
    ) {
        let mut tf = tf(vec![]);
        tf.colors = vec![[0.3, a, b, a], [x + 1.0, b, a, b]];
        tf.opacities = vec![[0.3, a], [x + 1.0, b]];
        let want = looks(&tf);
        let on = |a: f64, b: f64| a + (b - a) * t;
        tf.colors.insert(1, [on(0.3, x + 1.0), on(a, b), on(b, a), on(a, b)]);
        tf.opacities.insert(1, [on(0.3, x + 1.0), on(a, b)]);
        for (w, g) in want.iter().zip(&looks(&tf)) {
            prop_assert!(ulps(w.sigma, g.sigma) <= 1, "{w:?} {g:?}");
            prop_assert!((0..3).all(|c| ulps(w.rgb[c], g.rgb[c]) <= 1), "{w:?} {g:?}");
        }
    }

    /// Pointwise more opacity is nowhere less extinction.
    #[test]
    fn more_opacity_is_more_extinction(
        points in prop::collection::vec((0.0..1.0f64, 0.0..1.0f64), 1..9),
    ) {
        let mut tf = tf(vec![]);
        let points = points.iter().enumerate();
        tf.opacities = points.clone().map(|(i, p)| [30.0 * i as f64, p.0]).collect();
        let less = looks(&tf);
        tf.opacities = points
            .map(|(i, p)| [30.0 * i as f64, (p.0 + p.1 * (1.0 - p.0)).max(p.0)])
            .collect();
        for (l, m) in less.iter().zip(&looks(&tf)) {
            prop_assert!(m.sigma >= l.sigma || ulps(m.sigma, l.sigma) <= 1);
        }
    }
}

/// Colours are decoded where their points are, and lines between them are of linear light. So
/// what lies on a line in linear light changes nothing; the mean of two sRGB numbers is darker
/// than that line.
#[test]
fn lines_between_colours_are_lines_of_light() {
    let mut tf = TransferFunction { color_space: ColorSpace::Srgb, ..tf(vec![[0.0, 0.5]]) };
    tf.colors = vec![[0.0, 0.2, 0.5, 0.0], [128.0, 0.9, 0.6, 1.0]];
    let want = looks(&tf);
    let linear = |x: f64| linear_from_srgb(x);
    let mean = |a: f64, b: f64| srgb_from_linear((linear(a) + linear(b)) / 2.0);
    tf.colors.insert(1, [64.0, mean(0.2, 0.9), mean(0.5, 0.6), mean(0.0, 1.0)]);
    for (w, g) in want.iter().zip(&looks(&tf)) {
        for c in 0..3 {
            assert!((w.rgb[c] - g.rgb[c]).abs() < 1e-6, "{w:?} {g:?}");
        }
    }
    tf.colors[1] = [64.0, 0.55, 0.55, 0.5];
    let got = looks(&tf)[64].rgb[2];
    assert!((want[64].rgb[2] - 0.5).abs() < 1e-6 && (got - 0.214).abs() < 1e-3, "{got}");
}

#[test]
fn gradients_multiply_opacities() {
    let volume = Volume::from_fn_u8("v", [8, 1, 1], |i, _, _| (i * 30) as u8);
    let info = volume.info(Digest32::default());
    let mut tf = tf(vec![[0.0, 0.0], [200.0, 0.8]]);
    // The range is 210 values: no opacity at a gradient of 0, half of it from 52.5 values a vox on.
    tf.gradient_opacity = vec![[0.0, 0.0], [52.5, 0.5]];
    tf.check().unwrap();
    let c = Classifier::new(&tf, &info, Compositing::Linear);
    let values = Samples::U8(vec![100, 100, 100, 0]);
    let brick = Brick::new(crate::ids::BrickId(0), vec![0, 1, 2, 3], values, None);
    // A quarter of the range is half of the root.
    let brick = brick.with_gradients(Some(vec![0, 128, 255, 255]));
    let alpha = |i: usize| -libm::expm1(-f64::from(c.classify_voxel(&brick, i).sigma));
    assert_eq!(alpha(0), 0.0);
    assert!((alpha(1) - 0.2).abs() < 1e-6 && (alpha(2) - 0.2).abs() < 1e-6, "{}", alpha(1));
    assert_eq!(alpha(3), 0.0, "what is invisible stays so");
    assert_eq!(c.classify_voxel(&brick, 1).rgb, c.classify(&brick.values, 1).rgb);
    tf.domain = Domain::Unit;
    tf.gradient_opacity = vec![[0.5, 1.0], [0.25, 1.0]];
    assert_eq!(tf.check().unwrap_err().field, "gradient_opacity[1]");
    tf.gradient_opacity = vec![[0.5, 1.5]];
    assert_eq!(tf.check().unwrap_err().field, "gradient_opacity[0]");
}

#[test]
fn json_round_trip_and_unknown_keys() {
    let tf = tf(vec![[0.0, 0.0], [38.0, 0.0], [64.0, 1.0]]);
    assert_eq!(TransferFunction::from_json(&tf.to_json()).unwrap(), tf);
    let spoiled = tf.to_json().replacen("\"version\"", "\"verzion\"", 1);
    let e = TransferFunction::from_json(&spoiled).unwrap_err().to_string();
    assert!(e.contains("verzion"), "{e}");
    let unsorted = tf.to_json().replacen("[38.0,0.0]", "[-38.0,0.0]", 1);
    let e = TransferFunction::from_json(&unsorted).unwrap_err().to_string();
    assert!(e.contains("opacities[1]"), "{e}");
}

#[test]
fn a_smaller_support_is_covered() {
    let big = Support { intervals: vec![(10.0, 50.0), (60.0, 255.0)], nan: false };
    let small = Support { intervals: vec![(12.0, 20.0), (60.0, 61.0)], nan: false };
    assert!(big.covers(&small) && !small.covers(&big));
    let across = Support { intervals: vec![(45.0, 65.0)], nan: false };
    assert!(!big.covers(&across));
    assert!(big.union(&across).covers(&across) && big.union(&across).covers(&big));
    assert_eq!(big.union(&across).intervals, [(10.0, 255.0)]);
}

fn coloured(colours: Vec<[u8; 4]>, alpha: bool) -> VolumeInfo {
    let value = if alpha { ColourValue::Alpha } else { ColourValue::Luminance };
    let palette = Palette::sorted(colours, alpha, value).unwrap();
    let places: Vec<u16> = (0..palette.colours().len() as u16).collect();
    let lattice = Lattice::from_spacing([places.len() as u32, 1, 1], [1.0; 3]);
    let v = Volume::coloured("c", "RGB uint8", false, lattice, palette.into(), places).unwrap();
    v.info(v.digest())
}

#[test]
fn colours_have_their_own_colour_and_the_opacity_of_their_value() {
    let tf = tf(vec![[20.0, 0.0], [100.0, 0.8]]);
    let (red, green, black) = ([255, 0, 0, 255], [0, 255, 128, 255], [0, 0, 0, 255]);
    let info = coloured(vec![green, red, black], false);
    assert_eq!((info.summary.min_code, info.summary.max_code), (0.0, 165.0));
    assert_eq!(info.summary.code_kind(), SampleKind::U16);
    let c = Classifier::new(&tf, &info, Compositing::Paper);
    let look = |place: u16| c.classify(&Samples::U16(vec![place]), 0);
    assert_eq!((look(0).sigma, look(1).rgb), (0.0, [1.0, 0.0, 0.0]));
    // Red has luminance 77.
    assert!((look(1).sigma - 0.8 * 57.0 / 80.0).abs() < 1e-6);
    assert!((look(2).sigma - 0.8).abs() < 1e-6);
    let half = linear_from_srgb(128.0 / 255.0) as f32;
    assert_eq!(look(2).rgb, [0.0, 1.0, half]);
    assert_eq!(look(3), OpticalSample::default(), "nothing lies beyond the palette");
    assert_eq!(c.classify_bits(65_535), OpticalSample::default());
    assert_eq!(c.support().intervals, [(1.0, 2.0)]);
    assert!(c.choose_sums(&Quality::before(), &info.lattice).is_ok());

    let info = coloured(vec![[9, 9, 9, 0], [200, 9, 9, 60], [9, 9, 200, 255]], true);
    let c = Classifier::new(&tf, &info, Compositing::Paper);
    let sigmas = [0, 1, 2].map(|place| c.classify(&Samples::U16(vec![place]), 0).sigma);
    assert!(sigmas[0] == 0.0 && (sigmas[1] - 0.4).abs() < 1e-6 && (sigmas[2] - 0.8).abs() < 1e-6);
}

#[test]
fn quality_of_colours_is_classified_before_and_keeps_what_was_asked() {
    let colours = coloured(vec![[1, 2, 3, 255]], false).summary;
    assert_eq!(Quality::default().for_volume(&colours), Quality::before());
    let asked = Quality { thickness: 0.25, eps: 0.1, ..Quality::default() };
    let drawn = asked.for_volume(&colours);
    assert_eq!((drawn.thickness, drawn.eps, drawn.kernel), (0.25, 0.1, Kernel::Gaussian));
    assert_eq!(drawn.classify, Classify::Before);
    let grey = info(Samples::U8(vec![1, 2])).summary;
    assert_eq!(asked.for_volume(&grey), asked);
}
