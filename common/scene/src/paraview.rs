//! ParaView's colour maps as JSON: in and out.
//!
//! A file is a list of maps, of which the first is taken: `RGBPoints` (x, r, g, b, and again),
//! `ColorSpace` (how colours are interpolated), `NanColor`, and in `Points` the opacities (x,
//! alpha, midpoint, sharpness, and again). Our functions interpolate linear light and opacity
//! alone. So curves get points until they are nowhere off by more than half an 8-bit step. What is
//! written interpolates sRGB, with points where that would be off. Reading what was written adds no
//! points: after the first, round trips give the same bytes.
//!
//! ParaView's alphas are those of a unit distance that it chooses from the cells' size; here they
//! are of one vox. `Prolab` and `Lab/CIEDE2000` are refused: an iteration defines them.

use crate::colour::{ColourSpace, interpolate_colour};
use serde::Deserialize;
use slabcast_common::math::{linear_from_srgb, srgb_from_linear};
use slabcast_common::quality::InvalidField;
use slabcast_common::shade::Shading;
use slabcast_common::transfer::{
    ColorSpace, Domain, MAX_POINTS, NanColour, OpacityUnit, TransferFunction, interpolate,
};

/// Largest error of a line, in sRGB numbers and alphas: half an 8-bit step.
const OFF: f64 = 0.5 / 255.0;

/// The keys of a colour map that are read. Keys that don't change colours (creators, annotations)
/// may be there.
#[derive(Deserialize)]
#[serde(rename_all = "PascalCase")]
struct Map {
    #[serde(default)]
    name: Option<serde_json::Value>,
    #[serde(default, rename = "RGBPoints")]
    rgb_points: Vec<f64>,
    #[serde(default)]
    points: Vec<f64>,
    #[serde(default)]
    color_space: Option<String>,
    #[serde(default)]
    nan_color: Option<[f64; 3]>,
    #[serde(default)]
    nan_opacity: Option<f64>,
    #[serde(default)]
    use_log_scale: Option<f64>,
    #[serde(default)]
    indexed_colors: Vec<f64>,
}

/// A colour map as it was read.
#[derive(Clone, Debug, PartialEq)]
pub struct ColourMap {
    /// Name of the map as ParaView's file gives it; `None` if it gives none.
    pub name: Option<String>,
    /// Colour points `[x, r, g, b]` over file values, sRGB numbers, for interpolation in linear
    /// light.
    pub colours: Vec<[f64; 4]>,
    /// Opacity points `[x, alpha]`; empty where the file has none.
    pub opacities: Vec<[f64; 2]>,
    /// Colour and opacity of samples that are NaN.
    pub nan: NanColour,
}

/// Returns whether a text looks like ParaView's: a list, or an object with `RGBPoints`.
pub fn looks_like_paraview(text: &str) -> bool {
    text.trim_start().starts_with('[') || text.contains("\"RGBPoints\"")
}

/// Reads the first map of a file.
///
/// # Errors
/// Names the key that can't be used.
pub fn parse(text: &str) -> Result<ColourMap, InvalidField> {
    let whole = |problem: String| InvalidField::new("colour map", problem);
    let value: serde_json::Value =
        serde_json::from_str(text).map_err(|e| whole(format!("not valid: {e}")))?;
    let first = match value {
        serde_json::Value::Array(maps) => maps.into_iter().next(),
        one => Some(one),
    };
    let first = first.ok_or_else(|| whole("is an empty list; give a map".into()))?;
    let map: Map = serde_json::from_value(first).map_err(|e| whole(format!("not valid: {e}")))?;
    if map.use_log_scale.is_some_and(|x| x != 0.0) {
        return Err(InvalidField::new(
            "UseLogScale",
            "a logarithmic scale is not drawn; turn it off",
        ));
    }
    let (points, rest) = map.rgb_points.as_chunks::<4>();
    if points.is_empty() || !rest.is_empty() {
        let problem = if map.indexed_colors.is_empty() {
            format!("{} numbers; give x, r, g, b of each point", map.rgb_points.len())
        } else {
            "is missing: this map has colours for categories (IndexedColors) alone".into()
        };
        return Err(InvalidField::new("RGBPoints", problem));
    }
    let unit = |x: f64| (0.0..=1.0).contains(&x);
    for (i, p) in points.iter().enumerate() {
        if !p[0].is_finite() || !p[1..].iter().all(|&c| unit(c)) {
            return Err(InvalidField::new(
                format!("RGBPoints[{}]", 4 * i),
                "x must be finite and r, g, b in 0 to 1",
            ));
        }
    }
    let mut points = points.to_vec();
    points.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let space = match map.color_space.as_deref() {
        None | Some("RGB") => ColourSpace::Rgb,
        Some("HSV") => ColourSpace::Hsv,
        Some("Lab" | "CIELAB" | "LAB") => ColourSpace::Lab,
        Some("Diverging") => ColourSpace::Diverging,
        Some("Step") => ColourSpace::Step,
        Some(other) => {
            return Err(InvalidField::new(
                "ColorSpace",
                format!("`{other}` is not drawn; give RGB, HSV, Lab, Diverging or Step"),
            ));
        }
    };
    let (opacities, rest) = map.points.as_chunks::<4>();
    if !rest.is_empty() {
        return Err(InvalidField::new(
            "Points",
            "give x, alpha, midpoint, sharpness of each point",
        ));
    }
    for (i, p) in opacities.iter().enumerate() {
        if !p[0].is_finite() || !p[1..].iter().all(|&c| unit(c)) {
            return Err(InvalidField::new(
                format!("Points[{}]", 4 * i),
                "x must be finite and alpha, midpoint, sharpness in 0 to 1",
            ));
        }
    }
    let mut opacities = opacities.to_vec();
    opacities.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let color = map.nan_color.unwrap_or([1.0, 1.0, 0.0]);
    let opacity = map.nan_opacity.unwrap_or(0.0);
    if !color.iter().all(|&c| unit(c)) || !unit(opacity) {
        return Err(InvalidField::new("NanColor, NanOpacity", "must be in 0 to 1"));
    }
    let read = ColourMap {
        name: map.name.and_then(|name| name.as_str().map(String::from)),
        colours: colours(&points, space),
        opacities: alphas(&opacities),
        nan: NanColour { color, opacity },
    };
    if read.colours.len() > MAX_POINTS || read.opacities.len() > MAX_POINTS {
        return Err(whole("has too many points; give fewer".into()));
    }
    Ok(read)
}

impl ColourMap {
    /// Returns the colour map and its opacities as one transfer function.
    ///
    /// # Errors
    /// If the file has no opacities.
    pub fn into_function(self) -> Result<TransferFunction, InvalidField> {
        if self.opacities.is_empty() {
            return Err(InvalidField::new(
                "Points",
                "is missing: the file has colours and no opacities; use it with --colors, beside a \
                 --tf that has opacities",
            ));
        }
        let tf = TransferFunction {
            version: 1,
            domain: Domain::Value,
            colors: self.colours,
            opacities: self.opacities,
            color_space: ColorSpace::Srgb,
            opacity_unit: OpacityUnit::AlphaPerVox,
            nan: self.nan,
            gradient_opacity: Vec::new(),
            shading: Shading::default(),
        };
        tf.check()?;
        Ok(tf)
    }

    /// Returns the colour points with x from 0 at the first point to 1 at the last.
    pub fn unit_colours(&self) -> Vec<[f64; 4]> {
        let (lo, hi) = (self.colours[0][0], self.colours[self.colours.len() - 1][0]);
        let x = |x: f64| if hi > lo { (x - lo) / (hi - lo) } else { 0.0 };
        self.colours.iter().map(|c| [x(c[0]), c[1], c[2], c[3]]).collect()
    }
}

/// Adds points until interpolation in linear light follows that of `space`.
fn colours(points: &[[f64; 4]], space: ColourSpace) -> Vec<[f64; 4]> {
    let mut out = vec![points[0]];
    for pair in points.windows(2) {
        let ([xa, ra, ga, ba], [xb, rb, gb, bb]) = (pair[0], pair[1]);
        let (a, b) = ([ra, ga, ba], [rb, gb, bb]);
        let place = |t: f64, [r, g, b]: [f64; 3]| [xa + (xb - xa) * t, r, g, b];
        if xa == xb {
            out.push(place(0.0, b));
            continue;
        }
        if space == ColourSpace::Step {
            out.extend([place(0.0, b), place(1.0, b)]);
            continue;
        }
        // Lab's matrices are rounded: ends are taken as they are written.
        let at = |t: f64| match t {
            0.0 => a,
            1.0 => b,
            t => interpolate_colour(space, a, b, t),
        };
        curve(&at, (0.0, a), (1.0, b), 0, &mut |t, c| out.push(place(t, c)));
    }
    out
}

/// Appends points behind the first one until interpolation in linear light is near enough to the
/// curve.
fn curve(
    at: &impl Fn(f64) -> [f64; 3],
    (t0, a): (f64, [f64; 3]),
    (t1, b): (f64, [f64; 3]),
    deep: u32,
    out: &mut impl FnMut(f64, [f64; 3]),
) {
    let off = [0.25, 0.5, 0.75].into_iter().any(|t| {
        let want = at(t0 + (t1 - t0) * t);
        let got = line_of_light(a, b, t);
        (0..3).any(|i| (want[i] - got[i]).abs() > OFF)
    });
    // 256 pieces of one line are beyond what 8 bits of a colour can tell apart.
    if !off || deep >= 8 {
        out(t1, b);
        return;
    }
    let middle = (t0 + t1) / 2.0;
    let c = at(middle);
    curve(at, (t0, a), (middle, c), deep + 1, out);
    curve(at, (middle, c), (t1, b), deep + 1, out);
}

/// Interpolates in linear light, in sRGB numbers.
fn line_of_light(a: [f64; 3], b: [f64; 3], t: f64) -> [f64; 3] {
    std::array::from_fn(|i| {
        srgb_from_linear(linear_from_srgb(a[i]) * (1.0 - t) + linear_from_srgb(b[i]) * t)
    })
}

/// Adds points until straight lines follow midpoints and sharpnesses.
fn alphas(points: &[[f64; 4]]) -> Vec<[f64; 2]> {
    let Some(first) = points.first() else { return Vec::new() };
    let mut out = vec![[first[0], first[1]]];
    for pair in points.windows(2) {
        let ([xa, a, midpoint, sharpness], [xb, b, ..]) = (pair[0], pair[1]);
        if (midpoint == 0.5 && sharpness < 0.01) || a == b || xa == xb {
            out.push([xb, b]);
            continue;
        }
        let midpoint = midpoint.clamp(0.00001, 0.99999);
        if sharpness > 0.99 {
            let x = xa + (xb - xa) * midpoint;
            out.extend([[x, a], [x, b], [xb, b]]);
            continue;
        }
        // Pieces on either side of the midpoint, so that it is one of the points.
        const PIECES: usize = 32;
        for i in 1..=2 * PIECES {
            let s = if i <= PIECES {
                midpoint * i as f64 / PIECES as f64
            } else {
                midpoint + (1.0 - midpoint) * (i - PIECES) as f64 / PIECES as f64
            };
            let alpha = if i == 2 * PIECES { b } else { sharp(a, b, midpoint, sharpness, s) };
            out.push([xa + (xb - xa) * s, alpha.clamp(0.0, 1.0)]);
        }
    }
    out
}

/// Evaluates VTK's curve between two opacities (`vtkPiecewiseFunction`).
fn sharp(a: f64, b: f64, midpoint: f64, sharpness: f64, s: f64) -> f64 {
    let s = if s < midpoint {
        0.5 * s / midpoint
    } else {
        0.5 + 0.5 * (s - midpoint) / (1.0 - midpoint)
    };
    if sharpness < 0.01 {
        return a * (1.0 - s) + b * s;
    }
    let power = 1.0 + 10.0 * sharpness;
    let s = if s < 0.5 {
        0.5 * libm::pow(s * 2.0, power)
    } else {
        1.0 - 0.5 * libm::pow((1.0 - s) * 2.0, power)
    };
    let (s2, s3) = (s * s, s * s * s);
    let slope = (1.0 - sharpness) * (b - a);
    let value = a * (2.0 * s3 - 3.0 * s2 + 1.0)
        + b * (3.0 * s2 - 2.0 * s3)
        + slope * (s3 - 2.0 * s2 + s)
        + slope * (s3 - s2);
    value.clamp(a.min(b), a.max(b))
}

/// Returns a transfer function as ParaView reads it: a list of one map called `name`. `range` is
/// the file's smallest and largest value; without it, x of the unit domain stay shares.
///
/// # Errors
/// If its opacities are extinctions or modulated by gradients, which ParaView can't have.
pub fn to_json(
    tf: &TransferFunction,
    name: &str,
    range: Option<(f64, f64)>,
) -> Result<String, InvalidField> {
    if tf.opacity_unit == OpacityUnit::Extinction {
        return Err(InvalidField::new(
            "opacity_unit",
            "ParaView has alphas alone; give alpha_per_vox",
        ));
    }
    if !tf.gradient_opacity.is_empty() {
        return Err(InvalidField::new(
            "gradient_opacity",
            "ParaView's colour maps have none; leave it out",
        ));
    }
    let x = |x: f64| match (tf.domain, range) {
        (Domain::Unit, Some((lo, hi))) => lo + x * (hi - lo),
        _ => x,
    };
    let colours = crate::tween::srgb_colours(tf);
    let mut rgb: Vec<f64> = Vec::new();
    let mut put = |p: f64, c: [f64; 3]| rgb.extend([x(p), c[0], c[1], c[2]]);
    for (i, c) in colours.iter().enumerate() {
        let rgb = [c[1], c[2], c[3]];
        let Some(before) = i.checked_sub(1).map(|i| colours[i]) else {
            put(c[0], rgb);
            continue;
        };
        // Cut into the pieces that reading makes: in each, a line in sRGB numbers is near enough.
        let a = [before[1], before[2], before[3]];
        pieces(a, rgb, &mut |t, c_at| put(before[0] + (c[0] - before[0]) * t, c_at));
    }
    let points: Vec<f64> = tf.opacities.iter().flat_map(|o| [x(o[0]), o[1], 0.5, 0.0]).collect();
    let color = tf.nan.color.map(|c| match tf.color_space {
        ColorSpace::Srgb => c,
        ColorSpace::Linear => srgb_from_linear(c),
    });
    let map = serde_json::json!([{
        "Name": name,
        "ColorSpace": "RGB",
        "NanColor": color,
        "NanOpacity": tf.nan.opacity,
        "RGBPoints": rgb,
        "Points": points,
    }]);
    Ok(format!("{map:#}\n"))
}

/// Appends points behind the first one until interpolation in sRGB follows a line of linear light.
fn pieces(a: [f64; 3], b: [f64; 3], out: &mut impl FnMut(f64, [f64; 3])) {
    fn halve(
        a: [f64; 3],
        b: [f64; 3],
        (t0, t1): (f64, f64),
        deep: u32,
        out: &mut impl FnMut(f64, [f64; 3]),
    ) {
        let at = |t: f64| if t == 1.0 { b } else { line_of_light(a, b, t) };
        let (p, q) = (if t0 == 0.0 { a } else { at(t0) }, at(t1));
        let off = [0.25, 0.5, 0.75].into_iter().any(|t| {
            let want = line_of_light(p, q, t);
            (0..3).any(|i| (want[i] - (p[i] * (1.0 - t) + q[i] * t)).abs() > OFF)
        });
        if !off || deep >= 8 {
            out(t1, q);
            return;
        }
        let middle = (t0 + t1) / 2.0;
        halve(a, b, (t0, middle), deep + 1, out);
        halve(a, b, (middle, t1), deep + 1, out);
    }
    halve(a, b, (0.0, 1.0), 0, out);
}

/// Returns the colour of a function at x, in sRGB numbers.
pub fn colour_at(tf: &TransferFunction, x: f64) -> [f64; 3] {
    let light: Vec<[f64; 4]> = crate::tween::srgb_colours(tf)
        .into_iter()
        .map(|[x, r, g, b]| [x, linear_from_srgb(r), linear_from_srgb(g), linear_from_srgb(b)])
        .collect();
    let [_, r, g, b] = interpolate(&light, x);
    [r, g, b].map(srgb_from_linear)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn map(space: &str, rgb: &[f64], points: &[f64]) -> String {
        serde_json::json!([{ "ColorSpace": space, "Name": "t", "Creator": "somebody",
            "NanColor": [0.1, 0.2, 0.3], "RGBPoints": rgb, "Points": points }])
        .to_string()
    }

    const RGB: [f64; 12] = [-10.0, 0.2, 0.3, 0.8, 5.0, 0.9, 0.9, 0.8, 40.0, 0.7, 0.0, 0.1];
    const OPACITY: [f64; 12] = [-10.0, 0.0, 0.5, 0.0, 0.0, 0.3, 0.5, 0.0, 40.0, 1.0, 0.5, 0.0];

    #[test]
    fn colour_maps_look_as_they_do_in_paraview() {
        for (name, space) in [
            ("RGB", ColourSpace::Rgb),
            ("HSV", ColourSpace::Hsv),
            ("Lab", ColourSpace::Lab),
            ("Diverging", ColourSpace::Diverging),
        ] {
            let tf = parse(&map(name, &RGB, &OPACITY)).unwrap().into_function().unwrap();
            for i in 1..100 {
                let x = -10.0 + 0.5 * f64::from(i);
                let (a, b) = if x < 5.0 { (0, 4) } else { (4, 8) };
                let end = |i: usize| [RGB[i + 1], RGB[i + 2], RGB[i + 3]];
                let want =
                    interpolate_colour(space, end(a), end(b), (x - RGB[a]) / (RGB[b] - RGB[a]));
                let got = colour_at(&tf, x);
                for c in 0..3 {
                    assert!(
                        (want[c] - got[c]).abs() < 2.0 / 255.0,
                        "{name} at {x}: {want:?} {got:?}"
                    );
                }
            }
            assert_eq!(tf.opacities, [[-10.0, 0.0], [0.0, 0.3], [40.0, 1.0]]);
            assert_eq!(tf.nan.color, [0.1, 0.2, 0.3]);
        }
        let step = parse(&map("Step", &RGB, &OPACITY)).unwrap().into_function().unwrap();
        assert_eq!(
            colour_at(&step, 6.0).map(|c| (c * 10.0).round()),
            [7.0, 0.0, 1.0],
            "its second end"
        );
    }

    #[test]
    fn round_trips_give_the_same_bytes_after_the_first() {
        for space in ["RGB", "HSV", "Lab", "Diverging", "Step"] {
            let first = parse(&map(space, &RGB, &OPACITY)).unwrap().into_function().unwrap();
            let text = to_json(&first, "t", None).unwrap();
            let second = parse(&text).unwrap().into_function().unwrap();
            for i in 0..=100 {
                let x = -11.0 + 0.52 * f64::from(i);
                let (a, b) = (colour_at(&first, x), colour_at(&second, x));
                assert!((0..3).all(|c| (a[c] - b[c]).abs() < 1.0 / 255.0), "{space} at {x}");
            }
            assert_eq!(first.opacities, second.opacities);
            assert_eq!(to_json(&second, "t", None).unwrap(), text, "{space}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn functions_survive_a_round_trip_through_paraview(
            colours in prop::collection::vec([0.0..=1.0f64, 0.0..=1.0, 0.0..=1.0], 1..6),
            alphas in prop::collection::vec(0.0..=1.0f64, 1..6), linear in any::<bool>(),
        ) {
            let tf = TransferFunction {
                version: 1,
                domain: Domain::Value,
                colors: colours.iter().enumerate()
                    .map(|(i, c)| [7.0 * i as f64, c[0], c[1], c[2]]).collect(),
                opacities: alphas.iter().enumerate().map(|(i, &a)| [9.0 * i as f64, a]).collect(),
                color_space: if linear { ColorSpace::Linear } else { ColorSpace::Srgb },
                opacity_unit: OpacityUnit::AlphaPerVox,
                nan: NanColour { color: [0.5; 3], opacity: 0.25 },
                gradient_opacity: vec![],
                shading: Shading::default(),
            };
            let back = parse(&to_json(&tf, "ours", None).unwrap()).unwrap().into_function().unwrap();
            prop_assert_eq!(&back.opacities, &tf.opacities);
            for i in 0..80 {
                let (a, b) = (colour_at(&tf, f64::from(i) * 0.5), colour_at(&back, f64::from(i) * 0.5));
                prop_assert!((0..3).all(|c| (a[c] - b[c]).abs() < 1.0 / 255.0), "{a:?} {b:?}");
            }
            prop_assert_eq!(back.nan.opacity, 0.25);
        }
    }

    #[test]
    fn midpoints_and_sharpness_bend_opacities_as_vtk_does() {
        let with = |m: f64, s: f64| {
            let points = [0.0, 0.0, m, s, 10.0, 1.0, 0.5, 0.0];
            parse(&map("RGB", &RGB, &points)).unwrap().opacities
        };
        let at = |p: &[[f64; 2]], x: f64| interpolate(p, x)[1];
        assert!((at(&with(0.2, 0.0), 2.0) - 0.5).abs() < 1e-9, "half at the midpoint");
        let step = with(0.3, 1.0);
        assert_eq!((at(&step, 2.99), at(&step, 3.0)), (0.0, 1.0));
        let s = with(0.5, 0.5);
        assert!(at(&s, 2.0) < 0.1 && (at(&s, 5.0) - 0.5).abs() < 1e-9 && at(&s, 8.0) > 0.9);
        assert!(s.windows(2).all(|w| w[0][1] <= w[1][1]));
    }

    #[test]
    fn files_that_cannot_be_used_name_the_key() {
        let field = |text: &str| parse(text).and_then(ColourMap::into_function).unwrap_err().field;
        assert_eq!(field("[]"), "colour map");
        assert_eq!(field("[{"), "colour map");
        assert_eq!(field(r#"[{"RGBPoints":[0,0,0]}]"#), "RGBPoints");
        assert_eq!(field(r#"[{"RGBPoints":[0,0,0,2]}]"#), "RGBPoints[0]");
        assert_eq!(field(r#"[{"RGBPoints":[0,0,0,1],"Points":[0,1,0.5]}]"#), "Points");
        assert_eq!(field(r#"[{"RGBPoints":[0,0,0,1]}]"#), "Points");
        assert_eq!(field(r#"[{"RGBPoints":[0,0,0,1],"ColorSpace":"Prolab"}]"#), "ColorSpace");
        assert_eq!(field(r#"[{"RGBPoints":[0,0,0,1],"UseLogScale":1}]"#), "UseLogScale");
        assert_eq!(field(r#"[{"IndexedColors":[0,0,0]}]"#), "RGBPoints");
        assert!(
            looks_like_paraview("[{}]")
                && looks_like_paraview(r#"{"RGBPoints":[]}"#)
                && !looks_like_paraview(r#"{"version":1}"#)
        );
    }
}
