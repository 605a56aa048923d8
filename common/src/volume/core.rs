//! The part of a volume's range where its samples are.
//!
//! One hot voxel of 30000 above a body of 0 to 2000, or a disk of -32768 around a CT, leaves the
//! body a few of a histogram's 256 bins, and whoever fits colours to these sees noise. So ends of
//! the range that hold next to nothing, and padding, are cut off, and what is left is counted anew
//! in bins of its own, until little more can be cut. Volumes without such ends, nearly all, have no
//! core: their range will do.

use super::{SampleKind, ValueCore, ValueSummary};

/// Share of the samples that may lie beyond either end: 170 of a scan of 256^3. Fillings of teeth
/// are ten times as many.
const FEW: f64 = 1e-5;

/// A core is of use if it has less than this share of the range; at more, bins are fine enough.
const NARROW: f64 = 0.5;

/// Width of the empty gap above padding, in widths of what lies above the gap. Air of a CT lies one
/// such width below its tissue at most, -32768 at least eight below.
const GAP: usize = 2;

/// Most rounds: each takes a factor of 2 to 256 off the range, f32 has 2^256.
const ROUNDS: usize = 40;

/// Room below the core for what was cut off there, in widths of the core: as a hill of its own,
/// apart from the lowest values.
const ROOM: f64 = 0.1;

/// Finds the core of samples with range and histogram `s`; `None` if the range will do. `count`
/// counts the finite samples between two codes, in the bins of [`bin`]; it is called only if an end
/// of the range holds next to nothing.
pub(super) fn find<E>(
    s: &ValueSummary,
    mut count: impl FnMut(f64, f64) -> Result<Vec<u64>, E>,
) -> Result<Option<ValueCore>, E> {
    if s.kind == SampleKind::U8 {
        return Ok(None);
    }
    let padded = s.map.scale > 0.0;
    let (mut lo, mut hi) = (s.min_code, s.max_code);
    let (mut cut_below, mut histogram) = (false, s.histogram.clone());
    for _ in 0..ROUNDS {
        let negative = padded && s.map.value(lo) < 0.0;
        let (first, last) = trimmed(&histogram, negative);
        let bin = (hi - lo) / 256.0;
        // An end that stays is not computed: beside -3e38 the sum would be 0, not 1000.
        let a = if first == 0 { lo } else { (lo + bin * first as f64).max(s.min_code) };
        let b = if last == 255 { hi } else { (lo + bin * (last + 1) as f64).min(s.max_code) };
        if b - a > NARROW * (hi - lo) || b <= a {
            break;
        }
        cut_below |= first > 0;
        (lo, hi) = (a, b);
        histogram = count(lo, hi)?;
    }
    if hi - lo > NARROW * (s.max_code - s.min_code) {
        return Ok(None);
    }
    if cut_below {
        lo = (lo - ROOM * (hi - lo)).max(s.min_code);
        histogram = count(lo, hi)?;
    }
    Ok((hi > lo).then_some(ValueCore { min_code: lo, max_code: hi, histogram }))
}

/// Returns the first and the last bin that hold more than a few samples, the bin of padding left
/// out.
fn trimmed(histogram: &[u64], negative: bool) -> (usize, usize) {
    let total: u64 = histogram.iter().sum();
    let few = ((total as f64 * FEW) as u64).max(1);
    let mut seen = [0; 2];
    let mut many = |side: usize, b: usize| {
        seen[side] += histogram[b];
        seen[side] > few
    };
    let (first, last) = ((0..256).find(|&b| many(0, b)), (0..256).rev().find(|&b| many(1, b)));
    let (Some(first), Some(last)) = (first, last) else { return (0, 255) };
    if negative && let Some(next) = (first + 1..=last).find(|&b| histogram[b] > 0) {
        let (gap, width) = (next - first - 1, last - next + 1);
        if gap >= GAP * width {
            return (next, last);
        }
    }
    (first, last)
}

/// Returns the bin, 0 to 255, of a finite code among 256 equal bins from `lo` to `hi`. Codes below
/// `lo` are in bin 0, codes above `hi` in bin 255.
#[inline]
pub(super) fn bin(code: f64, lo: f64, hi: f64) -> usize {
    let scale = 256.0 / (hi - lo);
    (((code - lo) * scale).max(0.0) as usize).min(255)
}

/// Counts finite samples in the 256 bins of [`bin`].
pub(super) fn counted(samples: &[f32], lo: f64, hi: f64) -> Vec<u64> {
    let mut histogram = vec![0; 256];
    for &code in samples.iter().filter(|c| c.is_finite()) {
        histogram[bin(f64::from(code), lo, hi)] += 1;
    }
    histogram
}

#[cfg(test)]
mod tests {
    use super::super::{Samples, ValueMap};
    use super::*;

    fn core(values: Vec<f32>) -> Option<ValueCore> {
        ValueSummary::from_samples(&Samples::F32(values), ValueMap::IDENTITY).core
    }

    fn body() -> Vec<f32> {
        (0..60_000).map(|i| (i % 2000) as f32).collect()
    }

    #[test]
    fn usual_volumes_have_no_core() {
        assert_eq!(core(body()), None);
        assert_eq!(core(vec![f32::NAN; 4]), None);
        assert_eq!(core(vec![7.0; 4]), None);
        // Air of a CT, and the padding around its circle.
        let ct = body().into_iter().map(|v| v - 1000.0).chain(vec![-3024.0; 9000]).collect();
        assert_eq!(core(ct), None);
    }

    #[test]
    fn one_hot_voxel_and_padding_lie_beyond_the_core() {
        for far in [
            vec![30_000.0],
            vec![1e30],
            vec![-3e38],
            vec![3e38],
            vec![-32768.0; 20_000],
            vec![-1e30, 1e30],
        ] {
            let found = core([body(), far.clone()].concat()).unwrap_or_else(|| panic!("{far:?}"));
            assert!((-250.0..=1.0).contains(&found.min_code), "{far:?}: {}", found.min_code);
            assert!((1990.0..4000.0).contains(&found.max_code), "{far:?}: {}", found.max_code);
            let counted: u64 = found.histogram.iter().sum();
            assert_eq!(counted, 60_000 + far.len() as u64, "what lies beyond counts at the ends");
        }
    }

    #[test]
    fn many_bright_samples_are_no_outliers() {
        assert_eq!(core([body(), vec![30_000.0; 60]].concat()), None);
    }
}
