//! Transfer functions between transfer functions, for paths whose keys have several.
//!
//! Half-way between two functions, each value has the mean of the two opacities and of the two
//! colours in linear light. Both are piecewise linear, so their mean is too, with the points of
//! both. The ends are the functions themselves, bit for bit.
//!
//! A value that is visible in between is visible at one of the ends: where both opacities are zero,
//! so is every mean of them. So the bricks of a path are those of the union of its functions'
//! supports ([`Tween::key_functions`]), and no frame of it needs a brick more. A voxel that a frame
//! holds and does not see has an extinction of zero and adds nothing: the frame is that of a job of
//! its own, to the byte.

use crate::path::{KeyFrames, ViewPath};
use crate::presets;
use crate::transfer::TransferChoice;
use slabcast_common::math::{linear_from_srgb, srgb_from_linear};
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{InvalidField, Quality, Sums};
use slabcast_common::shade::{Light, Shading};
use slabcast_common::transfer::{
    Classifier, ColorSpace, Domain, NanColour, TransferFunction, interpolate,
};
use slabcast_common::volume::ValueSummary;

/// The transfer functions of a path's frames.
#[derive(Clone, Debug, PartialEq)]
pub struct Tween {
    /// For each key: its frame, the function as written, and the function over file values in
    /// linear light.
    keys: Vec<(f64, TransferFunction, TransferFunction)>,
}

impl Tween {
    /// Returns the functions of a path, or `None` if no key has one. Before the first key with a
    /// function that function holds, behind the last key that one's.
    ///
    /// # Errors
    /// Names the key whose function is wrong or can't be tweened.
    pub fn from_path(
        path: &ViewPath,
        summary: &ValueSummary,
    ) -> Result<Option<Tween>, InvalidField> {
        let Some(mut frames) = path.keyframes.clone() else { return Ok(None) };
        Tween::resolve_presets(&mut frames, summary)?;
        let mut keys = Vec::new();
        for (i, key) in frames.keys.iter().enumerate() {
            let Some(TransferChoice::Function(tf)) = &key.tf else { continue };
            let within = |e: InvalidField| {
                InvalidField::new(format!("keyframes.keys[{i}].tf.{}", e.field), e.problem)
            };
            tf.check().map_err(within)?;
            keys.push((frames.time(i), i, (**tf).clone()));
        }
        let Some((_, _, first)) = keys.first() else { return Ok(None) };
        let unit = first.opacity_unit;
        if let Some((_, i, _)) = keys.iter().find(|(_, _, tf)| tf.opacity_unit != unit) {
            return Err(InvalidField::new(
                format!("keyframes.keys[{i}].tf.opacity_unit"),
                "differs from the one before; give all keys one unit",
            ));
        }
        let keys = keys.into_iter().map(|(at, _, tf)| (at, tf.clone(), plain(&tf, summary)));
        Ok(Some(Tween { keys: keys.collect() }))
    }

    /// Replaces presets' names by their functions, fitted to `summary`.
    ///
    /// # Errors
    /// Names the key whose preset does not exist.
    pub fn resolve_presets(
        keys: &mut KeyFrames,
        summary: &ValueSummary,
    ) -> Result<(), InvalidField> {
        for (i, key) in keys.keys.iter_mut().enumerate() {
            if let Some(TransferChoice::Name(name)) = &key.tf {
                let tf = presets::by_name(name, summary)
                    .map_err(|e| InvalidField::new(format!("keyframes.keys[{i}].tf"), e.problem))?;
                key.tf = Some(TransferChoice::Function(Box::new(tf)));
            }
        }
        Ok(())
    }

    /// Returns the transfer function at `frame`, counted on the whole path; need not be whole.
    pub fn transfer_at(&self, frame: f64) -> TransferFunction {
        let after = self.keys.partition_point(|k| k.0 <= frame);
        let Some(i) = after.checked_sub(1) else { return self.keys[0].1.clone() };
        let (from, exact, a) = &self.keys[i];
        match self.keys.get(after) {
            Some((to, _, b)) if from < &frame => blend(a, b, (frame - from) / (to - from)),
            _ => exact.clone(),
        }
    }

    /// Returns the scene of a frame, on the bricks of `base`, the scene of all frames but for the
    /// function. `sums` is what was asked for; it is decided for each frame. The keys can have it,
    /// and no mean of two keys is less capped than both.
    pub fn scene_at(&self, base: &SceneSpec, sums: Sums, frame: f64) -> SceneSpec {
        let transfer = self.transfer_at(frame);
        let classifier = Classifier::new(&transfer, &base.volume, base.quality.compositing);
        let asked = Quality { sums, ..base.quality };
        let sums =
            classifier.choose_sums(&asked, &base.volume.lattice).unwrap_or(base.quality.sums);
        SceneSpec { transfer, quality: Quality { sums, ..base.quality }, ..base.clone() }
    }

    /// Returns the bytes that the functions take in memory.
    pub fn held_bytes(&self) -> usize {
        self.key_functions().map(crate::request::function_bytes).sum()
    }

    /// Returns functions whose supports together hold the support of every frame.
    pub fn key_functions(&self) -> impl Iterator<Item = &TransferFunction> {
        // Moving a point from shares to file values rounds it: both count.
        self.keys.iter().flat_map(|(_, exact, plain)| [exact, plain])
    }
}

/// Converts a function to file values and linear light.
fn plain(tf: &TransferFunction, summary: &ValueSummary) -> TransferFunction {
    let (lo, hi) = summary.range();
    let x = |x: f64| match tf.domain {
        Domain::Value => x,
        Domain::Unit => lo + x * (hi - lo),
    };
    let c = |c: f64| match tf.color_space {
        ColorSpace::Srgb => linear_from_srgb(c),
        ColorSpace::Linear => c,
    };
    TransferFunction {
        domain: Domain::Value,
        color_space: ColorSpace::Linear,
        colors: tf.colors.iter().map(|p| [x(p[0]), c(p[1]), c(p[2]), c(p[3])]).collect(),
        opacities: tf.opacities.iter().map(|p| [x(p[0]), p[1]]).collect(),
        nan: NanColour { color: tf.nan.color.map(c), opacity: tf.nan.opacity },
        gradient_opacity: tf.gradient_opacity.clone(),
        ..tf.clone()
    }
}

/// Returns the function `t` of the way from one plain function to another.
fn blend(a: &TransferFunction, b: &TransferFunction, t: f64) -> TransferFunction {
    let mix = |x: f64, y: f64| (x * (1.0 - t) + y * t).clamp(x.min(y), x.max(y));
    let nan = NanColour {
        color: std::array::from_fn(|i| mix(a.nan.color[i], b.nan.color[i])),
        opacity: mix(a.nan.opacity, b.nan.opacity),
    };
    let modulated = |tf: &TransferFunction| {
        if tf.gradient_opacity.is_empty() { vec![[0.0, 1.0]] } else { tf.gradient_opacity.clone() }
    };
    let gradient_opacity = if a.gradient_opacity.is_empty() && b.gradient_opacity.is_empty() {
        Vec::new()
    } else {
        lines(&modulated(a), &modulated(b), mix)
    };
    TransferFunction {
        version: 1,
        domain: Domain::Value,
        colors: lines(&a.colors, &b.colors, mix),
        opacities: lines(&a.opacities, &b.opacities, mix),
        color_space: ColorSpace::Linear,
        opacity_unit: a.opacity_unit,
        nan,
        gradient_opacity,
        shading: shading(&a.shading, &b.shading, t),
    }
}

/// Returns the points of both, each at the mean of both. Two points at one x are a step, whose left
/// and right side are blended apart.
fn lines<const N: usize>(
    a: &[[f64; N]],
    b: &[[f64; N]],
    mix: impl Fn(f64, f64) -> f64,
) -> Vec<[f64; N]> {
    let mut xs: Vec<f64> = a.iter().chain(b).map(|p| p[0]).collect();
    xs.sort_by(f64::total_cmp);
    xs.dedup();
    let both = |x: f64, p: [f64; N], q: [f64; N]| -> [f64; N] {
        std::array::from_fn(|i| if i == 0 { x } else { mix(p[i], q[i]) })
    };
    let mut points = Vec::with_capacity(xs.len() + 2);
    for x in xs {
        let (left, right) =
            (both(x, before(a, x), before(b, x)), both(x, interpolate(a, x), interpolate(b, x)));
        if left != right {
            points.push(left);
        }
        points.push(right);
    }
    points
}

/// Returns the value just left of x.
fn before<const N: usize>(points: &[[f64; N]], x: f64) -> [f64; N] {
    match points.iter().position(|p| p[0] == x) {
        // The first of the points at x is the end of the line that comes from the left.
        Some(i) => points[i],
        None => interpolate(points, x),
    }
}

/// Blends two lights. No light at all counts as ambient light alone.
fn shading(a: &Shading, b: &Shading, t: f64) -> Shading {
    if !a.on && !b.on {
        return *a;
    }
    let lit = |s: &Shading| match s.on {
        true => *s,
        false => Shading { ambient: 1.0, diffuse: 0.0, specular: 0.0, ..*s },
    };
    let (p, q) = (lit(a), lit(b));
    let mix = |x: f64, y: f64| x * (1.0 - t) + y * t;
    let unit = |v: [f64; 3]| {
        let v = glam::DVec3::from_array(v);
        v / v.length()
    };
    let light = match (p.light, q.light) {
        (Light::Direction(x), Light::Direction(y)) => {
            let v = unit(x) * (1.0 - t) + unit(y) * t;
            if v.length() > 1e-3 { Light::Direction(v.to_array()) } else { p.light }
        }
        // Between lights of two kinds lies nothing: the nearer key's.
        (x, y) => {
            if t < 0.5 {
                x
            } else {
                y
            }
        }
    };
    Shading {
        on: true,
        ambient: mix(p.ambient, q.ambient),
        diffuse: mix(p.diffuse, q.diffuse),
        specular: mix(p.specular, q.specular),
        power: mix(p.power, q.power),
        light,
    }
}

/// Returns a function's colour points as sRGB numbers, whatever its colour space.
pub fn srgb_colours(tf: &TransferFunction) -> Vec<[f64; 4]> {
    let c = |c: f64| match tf.color_space {
        ColorSpace::Srgb => c,
        ColorSpace::Linear => srgb_from_linear(c),
    };
    tf.colors.iter().map(|p| [p[0], c(p[1]), c(p[2]), c(p[3])]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::path::Key;
    use proptest::prelude::*;
    use slabcast_common::quality::Compositing;
    use slabcast_common::transfer::Classifier;
    use slabcast_common::volume::{Digest32, Samples, Volume, VolumeInfo};

    fn info() -> VolumeInfo {
        Volume::from_fn_u8("v", [256, 1, 1], |i, _, _| i as u8).info(Digest32::default())
    }

    fn path(choices: Vec<TransferChoice>) -> ViewPath {
        let keys = choices.into_iter().map(|tf| Key { tf: Some(tf), ..Key::default() }).collect();
        let frames =
            KeyFrames { frames: 11, easing: Default::default(), up: None, front: None, keys };
        ViewPath { keyframes: Some(frames), ..ViewPath::from_views([8, 8], vec![]) }
    }

    fn names(names: &[&str]) -> ViewPath {
        path(names.iter().map(|n| TransferChoice::Name((*n).into())).collect())
    }

    fn tween(p: &ViewPath) -> Tween {
        Tween::from_path(p, &info().summary).unwrap().unwrap()
    }

    fn classify(tf: &TransferFunction) -> Classifier {
        tf.check().unwrap();
        Classifier::new(tf, &info(), Compositing::Linear)
    }

    #[test]
    fn tween_at_a_key_is_the_keys_function_to_the_bit() {
        let t = tween(&names(&["bone", "peer-semi", "fog"]));
        let named = |n: &str| presets::by_name(n, &info().summary).unwrap();
        assert_eq!(t.transfer_at(0.0), named("bone"));
        assert_eq!(t.transfer_at(5.0), named("peer-semi"));
        assert_eq!(t.transfer_at(10.0), named("fog"));
        assert_eq!(t.transfer_at(99.0), named("fog"));
        assert_ne!(t.transfer_at(1.0), named("bone"));
    }

    #[test]
    fn tween_half_way_has_the_mean_of_opacity_and_light() {
        let t = tween(&names(&["peer-opaque", "peer-vessels"]));
        let [a, m, b] = [0.0, 5.0, 10.0].map(|x| classify(&t.transfer_at(x)));
        for v in 0..=255u8 {
            let at = |c: &Classifier| c.classify(&Samples::U8(vec![v]), 0);
            let alpha = |c: &Classifier| -libm::expm1(-f64::from(at(c).sigma));
            // The cap of opacity one is 2^-16 below it.
            assert!((alpha(&m) - (alpha(&a) + alpha(&b)) / 2.0).abs() < 2e-5, "alpha at {v}");
            for i in 0..3 {
                let want = (at(&a).rgb[i] + at(&b).rgb[i]) / 2.0;
                assert!((at(&m).rgb[i] - want).abs() < 1e-6, "colour at {v}");
            }
        }
    }

    proptest! {
        /// A value that a frame between two keys shows is shown at one of the keys.
        #[test]
        fn tween_supports_lie_in_the_union_of_the_keys(
            a in prop::collection::vec((0u32..64, 0u32..3), 1..6),
            b in prop::collection::vec((0u32..64, 0u32..3), 1..6),
            unit in any::<bool>(), frame in 0.0..10.0f64,
        ) {
            let of = |points: &[(u32, u32)], unit: bool| {
                let mut tf = presets::by_name("fog", &info().summary).unwrap();
                let mut points: Vec<(u32, u32)> = points.to_vec();
                points.sort();
                tf.domain = if unit { Domain::Unit } else { Domain::Value };
                let scale = if unit { 1.0 / 63.0 } else { 4.0 };
                tf.opacities = points.iter().map(|p| [f64::from(p.0) * scale, f64::from(p.1) * 0.3]).collect();
                TransferChoice::Function(Box::new(tf))
            };
            let t = tween(&path(vec![of(&a, unit), of(&b, false)]));
            let seen = classify(&t.transfer_at(frame)).support();
            let union = t.key_functions().map(|tf| classify(tf).support())
                .reduce(|a, b| a.union(&b)).unwrap();
            // By code: runs that touch are two in the union where a frame has one.
            let lost = (0..=255).map(f64::from).find(|&c| seen.contains(c) && !union.contains(c));
            prop_assert!(lost.is_none(), "{lost:?} of {seen:?}, not in {union:?}");
            prop_assert!(union.nan || !seen.nan);
        }
    }

    #[test]
    fn tween_fades_lighting_in() {
        let t = tween(&names(&["fog", "bone"]));
        let (s, d) = (t.transfer_at(5.0).shading, Shading::default());
        let half = [(s.ambient, (1.0 + d.ambient) / 2.0), (s.diffuse, d.diffuse / 2.0)];
        assert!(s.on && half.iter().all(|(got, want)| (got - want).abs() < 1e-12), "{s:?}");
        assert!(!t.transfer_at(0.0).shading.on);
    }

    #[test]
    fn tween_between_lights_of_two_kinds_jumps_half_way() {
        let lights = [Light::Key, Light::Head, Light::Direction([0.0, 0.0, 1.0])];
        for (a, b) in [(0, 1), (1, 2), (2, 0)].map(|(a, b)| (lights[a], lights[b])) {
            let of = |light| Shading { light, ..Shading::default() };
            assert_eq!(shading(&of(a), &of(b), 0.4).light, a);
            assert_eq!(shading(&of(a), &of(b), 0.6).light, b);
            assert_eq!(shading(&of(a), &of(a), 0.3).light, a);
        }
    }

    #[test]
    fn a_path_without_functions_has_no_tween_and_wrong_ones_are_named() {
        let of = |p: &ViewPath| Tween::from_path(p, &info().summary);
        assert_eq!(of(&ViewPath::from_views([8, 8], vec![])), Ok(None));
        let e = of(&names(&["bone", "bonee"])).unwrap_err();
        assert!(e.field == "keyframes.keys[1].tf" && e.problem.contains("`bone`"), "{e}");
    }
}
