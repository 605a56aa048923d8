//! Units of length in files, and distances between samples, some of which may lack a unit.
//!
//! A step without a unit, or with an unknown one, is never counted as millimetres beside steps in
//! micrometres: the volume would be a thousand times too long along one axis.

use crate::error::quoted;

/// Returns the millimetres of a unit of length: its symbol or its name in OME, NGFF or ImageJ.
/// `None` if the unit is no length or unknown.
pub(crate) fn millimetres(unit: &str) -> Option<f64> {
    let unit = unit.trim();
    // Symbols differ by case alone: Mm is 1e9 times mm. Names don't.
    if let Some(mm) = symbol(unit) {
        return Some(mm);
    }
    let name = unit.to_lowercase();
    let name = name.replace("metres", "meter").replace("metre", "meter");
    let name = name.strip_suffix('s').unwrap_or(&name);
    Some(match name {
        "micron" | "um" | "\u{b5}m" | "\u{3bc}m" => 1e-3,
        "angstrom" | "\u{e5}ngstr\u{f6}m" => 1e-7,
        "inch" | "inche" => 25.4,
        "foot" | "feet" => 304.8,
        "yard" => 914.4,
        "mile" => 1_609_344.0,
        "thou" | "mil" => 0.0254,
        "line" => 25.4 / 12.0,
        "point" => 25.4 / 72.0,
        "parsec" => 3.085_677_581_491_367e19,
        "astronomical unit" => 1.495_978_707e14,
        "light year" => 9.460_730_472_580_8e18,
        _ => power(name.strip_suffix("meter")?, &NAMES)?,
    })
}

/// Prefixes of a metre with their powers of ten, by name.
const NAMES: [(&str, i32); 22] = [
    ("", 0),
    ("yotta", 24),
    ("zetta", 21),
    ("exa", 18),
    ("peta", 15),
    ("tera", 12),
    ("giga", 9),
    ("mega", 6),
    ("kilo", 3),
    ("hecto", 2),
    ("deca", 1),
    ("deka", 1),
    ("deci", -1),
    ("centi", -2),
    ("milli", -3),
    ("micro", -6),
    ("nano", -9),
    ("pico", -12),
    ("femto", -15),
    ("atto", -18),
    ("zepto", -21),
    ("yocto", -24),
];

/// Prefixes of a metre with their powers of ten, by symbol.
const SYMBOLS: [(&str, i32); 26] = [
    ("", 0),
    ("Y", 24),
    ("Z", 21),
    ("E", 18),
    ("P", 15),
    ("T", 12),
    ("G", 9),
    ("M", 6),
    ("k", 3),
    ("h", 2),
    ("da", 1),
    ("d", -1),
    ("c", -2),
    ("m", -3),
    ("u", -6),
    ("\u{b5}", -6),
    ("\u{3bc}", -6),
    ("\\u00B5", -6),
    ("\\u00b5", -6),
    ("\\u03BC", -6),
    ("n", -9),
    ("p", -12),
    ("f", -15),
    ("a", -18),
    ("z", -21),
    ("y", -24),
];

/// Returns the millimetres of a metre with a prefix.
fn power(prefix: &str, prefixes: &[(&str, i32)]) -> Option<f64> {
    let (_, power) = prefixes.iter().find(|(p, _)| *p == prefix)?;
    // Parsed, since a decimal literal is rounded once.
    format!("1e{}", power + 3).parse().ok()
}

fn symbol(unit: &str) -> Option<f64> {
    Some(match unit {
        "in" | "\"" => 25.4,
        "ft" => 304.8,
        "yd" => 914.4,
        "mi" => 1_609_344.0,
        "li" => 25.4 / 12.0,
        "pt" => 25.4 / 72.0,
        "\u{c5}" | "\u{212b}" | "A" => 1e-7,
        "ua" | "au" => 1.495_978_707e14,
        "ly" => 9.460_730_472_580_8e18,
        "pc" => 3.085_677_581_491_367e19,
        _ => power(unit.strip_suffix('m')?, &SYMBOLS)?,
    })
}

/// Distance of samples along an axis, as a file gives it.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Step {
    /// Number in the file, positive and finite; `None` if the file has none.
    pub(crate) number: Option<f64>,
    /// Unit in the file; `None` if the file has none.
    pub(crate) unit: Option<String>,
}

/// Returns the distances of samples along x, y and z, and the millimetres of each axis's unit.
///
/// An axis without a known unit takes another axis's unit, or millimetres if no axis has one. A
/// missing step takes another axis's step, or 1. A note tells each of these.
pub(crate) fn steps_in_mm(steps: &[Step; 3], notes: &mut Vec<String>) -> ([f64; 3], [f64; 3]) {
    const NAMES: [&str; 3] = ["x", "y", "z"];
    let known = |a: usize| steps[a].unit.as_deref().and_then(millimetres);
    let other = (0..3).find(|&a| known(a).is_some() && steps[a].number.is_some());
    let mut mm = [1.0; 3];
    let mut borrowed: Vec<(&str, String, String)> = Vec::new();
    for a in 0..3 {
        if let Some(unit) = known(a) {
            mm[a] = unit;
            continue;
        }
        let from = match other {
            Some(b) => {
                mm[a] = mm[b];
                format!("that of {} was taken", NAMES[b])
            }
            None => "mm were taken".into(),
        };
        // Steps of 1 without any unit are those of an index.
        let plain = other.is_none() && steps[a].unit.is_none();
        if steps[a].number.is_some_and(|n| !plain || n != 1.0) {
            let why = match &steps[a].unit {
                Some(unit) => format!("has the unit {}, which is no known length", quoted(unit)),
                None => "has no unit".into(),
            };
            borrowed.push((NAMES[a], why, from));
        }
    }
    for (i, (name, why, from)) in borrowed.iter().enumerate() {
        // One note for axes of one kind.
        if borrowed[..i].iter().any(|b| (&b.1, &b.2) == (why, from)) {
            continue;
        }
        let same = borrowed.iter().filter(|b| (&b.1, &b.2) == (why, from)).map(|b| b.0);
        let same: Vec<&str> = same.collect();
        debug_assert_eq!(same[0], *name, "the first of its kind");
        notes.push(format!("the step along {} {why}; {from}", same.join(", ")));
    }
    let given = (0..3).find(|&a| steps[a].number.is_some());
    let mut out = [1.0; 3];
    for a in 0..3 {
        out[a] = match (steps[a].number, given) {
            (Some(number), _) => number * mm[a],
            (None, None) => 1.0,
            (None, Some(b)) => {
                notes.push(format!(
                    "the file does not say the step along {}; that of {} was taken",
                    NAMES[a], NAMES[b]
                ));
                steps[b].number.expect("it was found") * mm[b]
            }
        };
    }
    (out, mm)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_of_ome_ngff_and_imagej_are_lengths() {
        for (unit, mm) in [
            ("m", 1e3),
            ("dm", 100.0),
            ("cm", 10.0),
            ("mm", 1.0),
            ("\u{b5}m", 1e-3),
            ("\u{3bc}m", 1e-3),
            ("\\u00B5m", 1e-3),
            ("um", 1e-3),
            ("microns", 1e-3),
            ("nm", 1e-6),
            ("pm", 1e-9),
            ("\u{c5}", 1e-7),
            ("km", 1e6),
            ("Mm", 1e9),
            ("dam", 1e4),
            ("in", 25.4),
            ("inch", 25.4),
            ("thou", 0.0254),
            ("pt", 25.4 / 72.0),
            ("decimeter", 100.0),
            ("micrometre", 1e-3),
            ("Micrometers", 1e-3),
            ("millimetres", 1.0),
            ("angstrom", 1e-7),
            ("picometer", 1e-9),
            ("yoctometer", 1e-21),
            ("foot", 304.8),
            ("meter", 1e3),
        ] {
            assert_eq!(millimetres(unit), Some(mm), "{unit}");
        }
        for unit in ["", "pixel", "reference frame", "xm", "second", "s"] {
            assert_eq!(millimetres(unit), None, "{unit}");
        }
    }

    #[test]
    fn step_without_number_or_unit_goes_by_another_axis_and_is_noted() {
        let step =
            |number: Option<f64>, unit: Option<&str>| Step { number, unit: unit.map(String::from) };
        let um = || step(Some(0.5), Some("um"));
        let resolve = |z: Step| {
            let mut notes = Vec::new();
            let (mm, _) = steps_in_mm(&[um(), um(), z], &mut notes);
            (mm, notes.join("\n"))
        };
        assert_eq!(resolve(um()), ([0.5e-3; 3], String::new()));
        for (z, say) in [
            (step(None, None), "does not say the step along z; that of x was taken"),
            (step(Some(0.5), None), "the step along z has no unit; that of x was taken"),
            (step(Some(0.5), Some("pixel")), "z has the unit `pixel`, which is no known length"),
        ] {
            let (mm, notes) = resolve(z);
            assert_eq!(mm, [0.5e-3; 3], "{notes}");
            assert!(notes.contains(say) && notes.lines().count() == 1, "{notes}");
        }
        let mut notes = Vec::new();
        let pixels = [1.0, 1.0, 3.0].map(|n| step(Some(n), Some("pixel")));
        assert_eq!(steps_in_mm(&pixels, &mut notes).0, [1.0, 1.0, 3.0]);
        assert_eq!(notes.len(), 1, "{notes:?}");
        assert!(notes[0].contains("along x, y, z") && notes[0].ends_with("mm were taken"));
    }
}
