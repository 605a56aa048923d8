//! Lengths and numbers that people read: round ones.

/// Returns 1, 2 or 5 times a power of ten: the largest that is at most `most`.
pub(super) fn round_below(most: f64) -> f64 {
    let ten = libm::pow(10.0, libm::floor(libm::log10(most)));
    // Ten times it may be `most` itself, where the logarithm rounds down.
    [10.0, 5.0, 2.0, 1.0].map(|n| n * ten).into_iter().find(|n| *n <= most).unwrap_or(ten)
}

/// Formats a number with the fewest digits that read back to it, without the noise of its last
/// digits.
pub(super) fn number(x: f64) -> String {
    let short = format!("{x:.3e}").parse::<f64>().unwrap_or(x);
    let size = short.abs();
    if short == 0.0 || (1e-4..1e6).contains(&size) {
        format!("{short}")
    } else {
        format!("{short:e}")
    }
    .replace('-', "\u{2212}")
}

/// Formats a length in mm with the prefix that suits it.
pub(super) fn millimetres(mm: f64) -> String {
    let (scale, unit) = match mm {
        _ if mm >= 9e5 => (1e-6, "km"),
        _ if mm >= 1e3 => (1e-3, "m"),
        _ if mm >= 1e-1 => (1.0, "mm"),
        _ if mm >= 1e-4 => (1e3, "\u{b5}m"),
        _ => (1e6, "nm"),
    };
    format!("{} {unit}", number(mm * scale))
}

/// Returns round numbers between two, 2 to 6 of them, ascending.
pub(super) fn ticks(from: f64, to: f64) -> Vec<f64> {
    let span = to - from;
    if !(span > 0.0 && span.is_finite()) {
        return vec![from];
    }
    let mut step = round_below(span / 3.0);
    if span / step > 6.0 {
        step *= if round_below(step * 2.0) == step * 2.0 { 2.0 } else { 2.5 };
    }
    let first = libm::ceil(from / step - 1e-9);
    let count = libm::floor((to - first * step) / step + 1e-9);
    (0..=count as u32).map(|i| (first + f64::from(i)) * step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bars_are_round() {
        for (most, want) in [(1.0, 1.0), (99.0, 50.0), (100.0, 100.0), (0.37, 0.2), (4.9e-5, 2e-5)]
        {
            assert!((round_below(most) / want - 1.0).abs() < 1e-12, "{most}");
        }
        for (mm, want) in [
            (50.0, "50 mm"),
            (0.05, "50 \u{b5}m"),
            (5e-5, "50 nm"),
            (0.2, "0.2 mm"),
            (2000.0, "2 m"),
            (0.1 + 0.2, "0.3 mm"),
        ] {
            assert_eq!(millimetres(mm), want);
        }
        assert_eq!((number(-1000.0), number(1e-7)), ("\u{2212}1000".into(), "1e\u{2212}7".into()));
    }

    #[test]
    fn ticks_are_few_round_and_inside() {
        assert_eq!(ticks(-1024.0, 3071.0), [-1000.0, 0.0, 1000.0, 2000.0, 3000.0]);
        for (from, to) in [(0.0, 1.0), (28.3, 255.0), (-3e-9, 7e-9), (0.0, 1e30), (5.0, 6.1)] {
            let all = ticks(from, to);
            assert!((2..=7).contains(&all.len()), "{from} {to}: {all:?}");
            let slack = (to - from) * 1e-6;
            assert!(all.iter().all(|t| (from - slack..=to + slack).contains(t)), "{all:?}");
        }
        assert_eq!(ticks(2.0, 2.0), [2.0]);
    }
}
