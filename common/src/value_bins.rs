//! Bins of a volume's values, by which blocks and supports are compared.
//!
//! Blocks note which bins their samples lie in, and what a transfer function shows is rounded
//! outward to whole bins. So an edit of a function within a bin changes no brick, and one beyond it
//! changes those blocks alone that have values there.

use crate::transfer::Support;
use crate::volume::ValueSummary;

/// 64 bins of sample codes, in ascending order. What lies beyond the first or last edge is in the
/// first or last bin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ValueBins {
    /// Code at which the first bin begins.
    pub first_code: f64,
    /// Width of a bin in codes; above zero.
    pub width: f64,
}

impl ValueBins {
    /// Returns bins over the values that nearly all samples have; of colours over the places in
    /// their palette.
    pub fn of(summary: &ValueSummary) -> ValueBins {
        let (lo, hi) = match (&summary.palette, &summary.core) {
            (Some(palette), _) => (0.0, palette.colours().len() as f64),
            (None, Some(core)) => (core.min_code, core.max_code),
            (None, None) => (summary.min_code, summary.max_code),
        };
        let width = (hi - lo) / 64.0;
        ValueBins { first_code: lo, width: if width > 0.0 { width } else { 1.0 } }
    }

    /// Returns the bin of a code that is not NaN, 0 to 63.
    #[inline]
    pub fn bin(&self, code: f64) -> u32 {
        // The conversion saturates, at infinities too.
        ((code - self.first_code) / self.width).clamp(0.0, 63.0) as u32
    }

    /// Returns the bins in which a support has codes.
    pub fn mask(&self, support: &Support) -> u64 {
        support.intervals.iter().fold(0, |mask, &(a, b)| {
            let (first, last) = (self.bin(a), self.bin(b));
            mask | (u64::MAX >> (63 - (last - first))) << first
        })
    }

    /// Returns a support grown to whole bins, so that all supports with ends in the same bins give
    /// one result. Codes beyond the bins are added only if `support` reaches there. An end is not
    /// grown if that would add too many of the samples that `summary` counts (`ADDED_DIVISOR`):
    /// air, above all.
    #[must_use]
    pub fn rounded(&self, support: &Support, summary: &ValueSummary) -> Support {
        let edge = |bin: u32| self.first_code + self.width * f64::from(bin);
        let place = |code: f64| summary.bin(code.clamp(summary.min_code, summary.max_code));
        let count = |range: std::ops::Range<usize>| -> u64 {
            summary.histogram.get(range).map_or(0, |counts| counts.iter().sum())
        };
        let rounded = |&(a, b): &(f64, f64)| {
            let first = a.min(edge(self.bin(a)));
            // Codes at the edge belong to the next bin.
            let end = b.max(edge(self.bin(b) + 1).next_down());
            let stored = count(place(a)..place(b) + 1);
            let fits = |added: u64| added <= stored / ADDED_DIVISOR;
            (
                if fits(count(place(first)..place(a))) { first } else { a },
                if fits(count(place(b) + 1..place(end) + 1)) { end } else { b },
            )
        };
        let all = support.intervals.iter().map(rounded).map(|interval| vec![interval]);
        let none = Support { intervals: Vec::new(), nan: support.nan };
        all.map(|intervals| Support { intervals, nan: false }).fold(none, |a, b| a.union(&b))
    }
}

/// Rounding adds at most the samples that are stored divided by this.
const ADDED_DIVISOR: u64 = 32;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::{SampleKind, ValueMap};

    fn open(a: f64) -> (f64, f64) {
        (a, f64::INFINITY)
    }

    /// Returns bins of four codes, and a summary of 256 codes with `counts(code)` samples each.
    fn bins(counts: impl Fn(usize) -> u64) -> (ValueBins, ValueSummary) {
        let counts: Vec<u64> = (0..256).map(counts).collect();
        let summary = ValueSummary::from_code_counts(SampleKind::U8, &counts, ValueMap::IDENTITY);
        (ValueBins { first_code: 0.0, width: 4.0 }, summary)
    }

    #[test]
    fn supports_with_ends_in_the_same_bins_are_rounded_to_the_same() {
        let (bins, summary) = bins(|_| 1);
        let of = |intervals: &[(f64, f64)]| {
            let support = Support { intervals: intervals.to_vec(), nan: true };
            bins.rounded(&support, &summary)
        };
        assert_eq!(of(&[open(16.0)]), of(&[open(19.9)]));
        assert_ne!(of(&[open(16.0)]), of(&[open(15.9)]));
        assert_eq!(of(&[open(17.0)]).intervals, [open(16.0)]);
        let both = of(&[(17.0, 130.0), (141.0, 255.0)]);
        assert_eq!(both.intervals, [(16.0, 132f64.next_down()), (140.0, 256f64.next_down())]);
        assert!(both.nan && both.contains(131.9) && !both.contains(132.0));
        assert_eq!(of(&[(-9.0, 300.0)]).intervals, [(-9.0, 300.0)], "beyond the bins as it was");
    }

    #[test]
    fn air_is_not_stored_for_the_sake_of_a_bin() {
        let (bins, summary) = bins(|code| if code == 0 { 10_000 } else { 10 });
        let of = |a| {
            let support = Support { intervals: vec![open(a)], nan: false };
            bins.rounded(&support, &summary).intervals
        };
        assert_eq!(of(1.0), [open(1.0)]);
        assert_eq!(of(5.0), [open(4.0)]);
    }
}
