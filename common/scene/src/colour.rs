//! Interpolation between two colours, in the spaces in which ParaView interpolates.
//!
//! Colours come in and go out as sRGB numbers; what lies between them depends on the space. The
//! formulas are those of VTK's `vtkColorTransferFunction`, white point and rounded constants
//! included, so that a map looks here as it looks there.

use libm::{acos, atan2, cbrt, cos, pow, sin, sqrt};

/// Space in which two colours are interpolated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColourSpace {
    /// sRGB numbers.
    Rgb,
    /// Hue, saturation, value; hue takes the short way round.
    Hsv,
    /// CIELAB.
    Lab,
    /// Moreland's polar form of CIELAB, through white if the two hues are far apart (Diverging
    /// Color Maps, 2009).
    Diverging,
    /// No interpolation: an interval has the colour of its second end.
    Step,
}

/// Returns the colour at `t` (0 to 1) from `a` to `b`, all as sRGB numbers from 0 to 1.
pub fn interpolate_colour(space: ColourSpace, a: [f64; 3], b: [f64; 3], t: f64) -> [f64; 3] {
    let mix = |a: [f64; 3], b: [f64; 3]| -> [f64; 3] {
        std::array::from_fn(|i| a[i] * (1.0 - t) + b[i] * t)
    };
    match space {
        ColourSpace::Rgb => mix(a, b),
        ColourSpace::Step => b,
        ColourSpace::Lab => rgb_from_lab(mix(lab_from_rgb(a), lab_from_rgb(b))),
        ColourSpace::Hsv => {
            let (mut a, mut b) = (hsv_from_rgb(a), hsv_from_rgb(b));
            if a[0] - b[0] > 0.5 {
                a[0] -= 1.0;
            } else if b[0] - a[0] > 0.5 {
                b[0] -= 1.0;
            }
            let [h, s, v] = mix(a, b);
            rgb_from_hsv([if h < 0.0 { h + 1.0 } else { h }, s, v])
        }
        ColourSpace::Diverging => diverging(a, b, t),
    }
}

/// Moreland's map: two saturated colours of different hues meet at white.
fn diverging(a: [f64; 3], b: [f64; 3], mut t: f64) -> [f64; 3] {
    let (mut a, mut b) = (msh_from_lab(lab_from_rgb(a)), msh_from_lab(lab_from_rgb(b)));
    let apart = {
        let d = (a[2] - b[2]).abs();
        if d > std::f64::consts::PI { std::f64::consts::TAU - d } else { d }
    };
    if a[1] > 0.05 && b[1] > 0.05 && apart > std::f64::consts::FRAC_PI_3 {
        let white = a[0].max(b[0]).max(88.0);
        if t < 0.5 {
            b = [white, 0.0, 0.0];
            t *= 2.0;
        } else {
            a = [white, 0.0, 0.0];
            t = 2.0 * t - 1.0;
        }
    }
    // White has no hue of its own; it takes one that keeps equal steps equal.
    if a[1] < 0.05 && b[1] > 0.05 {
        a[2] = hue_of_white(b, a[0]);
    } else if b[1] < 0.05 && a[1] > 0.05 {
        b[2] = hue_of_white(a, b[0]);
    }
    let msh: [f64; 3] = std::array::from_fn(|i| a[i] * (1.0 - t) + b[i] * t);
    rgb_from_lab(lab_from_msh(msh))
}

/// The hue that a colour without saturation and of magnitude `white` is given beside `msh`.
fn hue_of_white(msh: [f64; 3], white: f64) -> f64 {
    let [m, s, h] = msh;
    if m >= white - 0.1 {
        return h;
    }
    let spin = s * sqrt(white * white - m * m) / (m * sin(s));
    if h > -0.3 * std::f64::consts::PI { h + spin } else { h - spin }
}

fn msh_from_lab([l, a, b]: [f64; 3]) -> [f64; 3] {
    let m = sqrt(l * l + a * a + b * b);
    let s = if m > 0.001 { acos((l / m).clamp(-1.0, 1.0)) } else { 0.0 };
    let h = if s > 0.001 { atan2(b, a) } else { 0.0 };
    [m, s, h]
}

fn lab_from_msh([m, s, h]: [f64; 3]) -> [f64; 3] {
    [m * cos(s), m * sin(s) * cos(h), m * sin(s) * sin(h)]
}

/// D65.
const WHITE: [f64; 3] = [0.9505, 1.0, 1.089];

fn lab_from_rgb(rgb: [f64; 3]) -> [f64; 3] {
    let [r, g, b] =
        rgb.map(|c| if c > 0.04045 { pow((c + 0.055) / 1.055, 2.4) } else { c / 12.92 });
    let xyz = [
        r * 0.4124 + g * 0.3576 + b * 0.1805,
        r * 0.2126 + g * 0.7152 + b * 0.0722,
        r * 0.0193 + g * 0.1192 + b * 0.9505,
    ];
    let [x, y, z]: [f64; 3] = std::array::from_fn(|i| {
        let v = xyz[i] / WHITE[i];
        if v > 0.008856 { cbrt(v) } else { 7.787 * v + 16.0 / 116.0 }
    });
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

fn rgb_from_lab([l, a, b]: [f64; 3]) -> [f64; 3] {
    let y = (l + 16.0) / 116.0;
    let f = [a / 500.0 + y, y, y - b / 200.0];
    let [x, y, z]: [f64; 3] = std::array::from_fn(|i| {
        let cube = f[i] * f[i] * f[i];
        WHITE[i] * if cube > 0.008856 { cube } else { (f[i] - 16.0 / 116.0) / 7.787 }
    });
    let linear = [
        x * 3.2406 + y * -1.5372 + z * -0.4986,
        x * -0.9689 + y * 1.8758 + z * 0.0415,
        x * 0.0557 + y * -0.2040 + z * 1.0570,
    ];
    let rgb =
        linear.map(|c| if c > 0.0031308 { 1.055 * pow(c, 1.0 / 2.4) - 0.055 } else { 12.92 * c });
    // A colour that is too bright is darkened as a whole, so that its hue stays.
    let largest = rgb.into_iter().fold(1.0, f64::max);
    rgb.map(|c| (c / largest).max(0.0))
}

fn hsv_from_rgb([r, g, b]: [f64; 3]) -> [f64; 3] {
    let (v, least) = (r.max(g).max(b), r.min(g).min(b));
    let range = v - least;
    if range <= 0.0 {
        return [0.0, 0.0, v];
    }
    let h = if r == v {
        (g - b) / range
    } else if g == v {
        2.0 + (b - r) / range
    } else {
        4.0 + (r - g) / range
    } / 6.0;
    [if h < 0.0 { h + 1.0 } else { h }, range / v, v]
}

fn rgb_from_hsv([h, s, v]: [f64; 3]) -> [f64; 3] {
    let channel = |shift: f64| {
        let k = libm::fmod(shift + h * 6.0, 6.0);
        (v - v * s * k.min(4.0 - k).clamp(0.0, 1.0)).clamp(0.0, 1.0)
    };
    [channel(5.0), channel(3.0), channel(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn near(a: [f64; 3], b: [f64; 3], by: f64) -> bool {
        (0..3).all(|i| (a[i] - b[i]).abs() <= by)
    }

    proptest! {
        #[test]
        fn every_line_ends_at_its_colours(
            a in [0.0..=1.0f64, 0.0..=1.0, 0.0..=1.0], b in [0.0..=1.0f64, 0.0..=1.0, 0.0..=1.0],
            t in 0.0..=1.0f64,
        ) {
            for space in [ColourSpace::Rgb, ColourSpace::Hsv, ColourSpace::Lab, ColourSpace::Diverging] {
                // The rounded matrices are no exact inverses of each other; and a colour that is
                // nearly white is given another's hue, which moves it by ten units of CIELAB at
                // most (a bluish white beside a bluish black by more than 0.06).
                let off = if space == ColourSpace::Diverging { 0.1 } else { 2e-3 };
                prop_assert!(near(interpolate_colour(space, a, b, 0.0), a, off), "{space:?}");
                prop_assert!(near(interpolate_colour(space, a, b, 1.0), b, off), "{space:?}");
                let c = interpolate_colour(space, a, b, t);
                prop_assert!(c.iter().all(|x| (0.0..=1.0).contains(x)), "{space:?}: {c:?}");
            }
            prop_assert_eq!(interpolate_colour(ColourSpace::Step, a, b, t), b);
        }
    }

    #[test]
    fn halfway_between_red_and_blue() {
        let (red, blue) = ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]);
        let at = |space| interpolate_colour(space, red, blue, 0.5).map(|c| (c * 255.0).round());
        assert_eq!(at(ColourSpace::Rgb), [128.0, 0.0, 128.0]);
        assert_eq!(at(ColourSpace::Hsv), [255.0, 0.0, 255.0], "the short way round");
        assert_eq!(at(ColourSpace::Step), [0.0, 0.0, 255.0]);
        let [r, g, b] = interpolate_colour(ColourSpace::Lab, red, blue, 0.5);
        assert!(r > 0.7 && g < 0.2 && b > 0.45, "{r} {g} {b}");
        let white = interpolate_colour(ColourSpace::Diverging, red, blue, 0.5);
        assert!(near(white, [white[0]; 3], 0.01) && white[0] > 0.85, "{white:?}");
    }
}
