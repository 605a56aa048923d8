//! Finds the slices that a series lacks, by the gaps between those that are there.

use crate::error::quoted;
use crate::samples::DIM_MAX;

/// Returns how many slices are missing after each of sorted slices with these gaps; nothing if none
/// is, or if the gaps don't tell.
///
/// They tell where three of four gaps are alike, and all others are two or more such steps, within a
/// twentieth of one. A scan with two distances (5 mm below, 10 mm above) has no such step: empty slices
/// would stripe it. No more slices are made up than are there.
pub(super) fn missing_after(gaps: &[f64]) -> Vec<u32> {
    let mut sorted = gaps.to_vec();
    sorted.sort_by(f64::total_cmp);
    let step = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    let steps = |gap: &f64| {
        let n = (gap / step).round();
        ((gap / step - n).abs() <= 0.05 && (1.0..=DIM_MAX as f64).contains(&n)).then_some(n as u32)
    };
    let Some(counts) = gaps.iter().map(steps).collect::<Option<Vec<u32>>>() else {
        return Vec::new();
    };
    let alike = counts.iter().filter(|n| **n == 1).count();
    let missing: Vec<u32> = counts.iter().map(|n| n - 1).collect();
    let total: u64 = missing.iter().map(|n| u64::from(*n)).sum();
    let there = gaps.len() as u64 + 1;
    match total > 0 && 4 * alike >= 3 * gaps.len() && total <= there && there + total <= DIM_MAX {
        true => missing,
        false => Vec::new(),
    }
}

/// Returns the note on missing slices of a series whose first slice is at `start` along the normal.
pub(super) fn missing_note(name: &str, gaps: &[f64], missing: &[u32], start: f64) -> String {
    let total: u32 = missing.iter().sum();
    let mut at = start;
    let mut places = Vec::new();
    for (gap, n) in gaps.iter().zip(missing) {
        if *n > 0 && places.len() < 4 {
            places.push(format!("{} and {}", millimetres(at), millimetres(at + gap)));
        }
        at += gap;
    }
    let more = missing.iter().filter(|n| **n > 0).count() - places.len();
    let more = if more > 0 { format!(", and in {more} other places") } else { String::new() };
    format!(
        "{total} slice{} of {} {} missing, between {} mm along their normal{more}; the others keep \
         their places, there is no value in between, and all became float32",
        if total == 1 { "" } else { "s" },
        quoted(name),
        if total == 1 { "is" } else { "are" },
        places.join(", ")
    )
}

/// Returns a length for people: not 300 digits of one that is out of this world.
pub(super) fn millimetres(x: f64) -> String {
    if x < 1e6 { format!("{x:.3}") } else { format!("{x:.3e}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_slices_are_told_only_from_gaps_that_are_whole_steps() {
        for (gaps, want) in [
            (&[1.0, 1.0, 2.0, 1.0][..], &[0, 0, 1, 0][..]),
            (&[2.5, 2.5, 2.5, 2.5, 10.1, 2.5, 2.5], &[0, 0, 0, 0, 3, 0, 0]),
            // None is missing; the rest is no whole step; two distances; more than are there.
            (&[1.0, 1.0, 1.02], &[]),
            (&[1.0, 1.0, 1.0, 1.5], &[]),
            (&[5.0, 5.0, 5.0, 10.0, 10.0, 10.0], &[]),
            (&[1.0, 1.0, 1.0, 60.0], &[]),
            (&[1.0, 1.0, 1.0, 1e300], &[]),
            (&[0.0, 0.0, 0.0, 1.0], &[]),
            (&[1.0, 2.0], &[]),
            (&[], &[]),
        ] {
            assert_eq!(missing_after(gaps), want, "{gaps:?}");
        }
    }

    #[test]
    fn note_names_the_places_of_missing_slices() {
        let gaps = [1.0, 3.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];
        let note = missing_note("CT 7", &gaps, &missing_after(&gaps), -5.0);
        let want = "2 slices of `CT 7` are missing, between -4.000 and -1.000 mm along their \
                    normal; the others keep their places, there is no value in between, and all \
                    became float32";
        assert_eq!(note, want);
    }
}
