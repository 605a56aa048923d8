//! Sheets and slabs along the view direction.
//!
//! Sheet `k` lies between the planes `k d` and `(k + 1) d` behind the target
//! (docs/design/contracts.md), in both projections, whatever the volume. A slab is a run of sheets;
//! its borders are sheet borders, so slabs never change a pixel.

use serde::{Deserialize, Serialize};

/// A half-open run of sheets `[first, end)`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct SheetRange {
    /// Number of the first sheet in the run.
    pub first: i32,
    /// Number of the sheet just behind the run.
    pub end: i32,
}

impl SheetRange {
    /// Returns the run of sheets from `first` up to but without `end`.
    pub fn new(first: i32, end: i32) -> Self {
        SheetRange { first, end }
    }

    /// Returns the number of sheets; 0 if empty.
    pub fn len(self) -> u32 {
        (self.end as i64 - self.first as i64).max(0) as u32
    }

    /// Returns whether the run has no sheet.
    pub fn is_empty(self) -> bool {
        self.end <= self.first
    }

    /// Returns whether both runs share a sheet.
    pub fn overlaps(self, other: SheetRange) -> bool {
        self.first < other.end && other.first < self.end
    }

    /// Returns the smallest run that holds both; an empty one counts as nothing.
    pub fn union(self, other: SheetRange) -> SheetRange {
        if self.is_empty() {
            other
        } else if other.is_empty() {
            self
        } else {
            SheetRange::new(self.first.min(other.first), self.end.max(other.end))
        }
    }

    /// Cuts the run into at most `count` slabs of equal thickness (to a sheet), front to back.
    /// Empty slabs are left out: with fewer sheets than slabs, each slab has one sheet.
    pub fn slabs(self, count: u32) -> Vec<SheetRange> {
        let n = self.len() as u64;
        let count = u64::from(count.max(1));
        (0..count)
            .map(|i| {
                let at = |i: u64| (self.first as i64 + (n * i / count) as i64) as i32;
                SheetRange::new(at(i), at(i + 1))
            })
            .filter(|s| !s.is_empty())
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slabs_tile_the_run_without_gap() {
        for n in 0..40 {
            for count in 1..9 {
                let run = SheetRange::new(-7, -7 + n);
                let slabs = run.slabs(count);
                let mut at = run.first;
                for s in &slabs {
                    assert_eq!(s.first, at);
                    assert!(!s.is_empty());
                    at = s.end;
                }
                assert_eq!(at, run.end);
                assert_eq!(slabs.len() as i32, n.min(count as i32));
            }
        }
    }
}
