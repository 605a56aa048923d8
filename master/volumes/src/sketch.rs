//! Draws a histogram as one line of bars, for `slabcast info`.

use slabcast_common::volume::ValueSummary;

const BARS: [char; 9] = [' ', '▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

/// Draws a histogram as two lines of text: `width` bars, then the smallest and largest value.
///
/// `width` is clamped to 1 to 256 characters. Heights are logarithms of counts, since air
/// outnumbers a thin object by thousands; a bar with any sample is at least one step high.
pub fn histogram_sketch(summary: &ValueSummary, width: usize) -> String {
    // Bins of 8-bit volumes are codes; those outside the volume's range are left out.
    let (first, last) =
        (summary.bin(summary.min_code), summary.bin(summary.max_code.max(summary.min_code)));
    let last = if summary.max_code > summary.min_code { last.max(first) } else { first };
    let bins = summary.histogram.get(first..=last).unwrap_or_default();
    let width = width.clamp(1, 256);
    let mut counts: Vec<u64> = (0..width)
        .map(|c| {
            let first = c * bins.len() / width;
            let end = ((c + 1) * bins.len() / width).max(first + 1).min(bins.len());
            bins[first.min(end)..end].iter().sum()
        })
        .collect();
    if summary.map.scale < 0.0 {
        counts.reverse();
    }
    let height = |n: u64| libm::log1p(n as f64);
    let tallest = counts.iter().copied().map(height).fold(0.0, f64::max);
    let bars: String = counts
        .iter()
        .map(|&n| match n {
            0 => BARS[0],
            n => BARS[((height(n) / tallest * 8.0).round() as usize).clamp(1, 8)],
        })
        .collect();
    let (lo, hi) = summary.range();
    let (lo, hi) = (number(lo), number(hi));
    let gap = width.saturating_sub(lo.chars().count() + hi.chars().count()).max(1);
    format!("{bars}\n{lo}{}{hi}", " ".repeat(gap))
}

/// Formats a value with at most three decimals, or four significant digits in scientific form.
fn number(x: f64) -> String {
    let size = x.abs();
    if x == 0.0 || (1e-3..1e6).contains(&size) {
        let s = format!("{x:.3}");
        s.trim_end_matches('0').trim_end_matches('.').to_string()
    } else {
        format!("{x:.3e}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::{Samples, ValueMap};

    #[test]
    fn histogram_sketch_shows_rare_values_beside_frequent_ones() {
        let mut v = vec![0u8; 100_000];
        v.extend([200; 30]);
        let s = ValueSummary::from_samples(&Samples::U8(v), ValueMap::IDENTITY);
        let sketch = histogram_sketch(&s, 40);
        let lines: Vec<&str> = sketch.lines().collect();
        assert_eq!(lines.len(), 2);
        assert_eq!(lines[0].chars().count(), 40);
        assert!(lines[0].starts_with('█') && lines[0].ends_with(['▂', '▃']), "{sketch}");
        assert!(lines[1].starts_with("0 ") && lines[1].ends_with(" 200"), "{sketch}");
    }

    #[test]
    fn histogram_sketch_handles_any_width_nan_and_negative_scale() {
        let flipped = ValueMap { scale: -2.0, offset: 1.0 };
        for samples in [
            Samples::U8(vec![7]),
            Samples::U8((0..=255).collect()),
            Samples::U16(vec![3, 9000, 65535]),
            Samples::F32(vec![f32::NAN]),
            Samples::F32(vec![-1e30, f32::INFINITY, 1e30]),
        ] {
            for map in [ValueMap::IDENTITY, flipped] {
                let s = ValueSummary::from_samples(&samples, map);
                for width in [0, 1, 7, 80, 256, 9999] {
                    let sketch = histogram_sketch(&s, width);
                    assert_eq!(sketch.lines().count(), 2, "{sketch}");
                    let bars = sketch.lines().next().unwrap().chars().count();
                    assert_eq!(bars, width.clamp(1, 256));
                }
            }
        }
        // A negative slope reverses the order of values; bars must stand over their values.
        let s = ValueSummary::from_samples(&Samples::U8(vec![0, 0, 0, 9]), flipped);
        assert!(histogram_sketch(&s, 10).starts_with('▄'), "{}", histogram_sketch(&s, 10));
    }
}
