//! Which blocks hold bricks at all, and which an edit of a transfer function leaves as they are.

use crate::blocks::{BlockSummaries, ValueBins};
use slabcast_common::block_set::{BLOCK_EDGE, BlockSet};
use slabcast_common::brick::BRICK_EDGE;
use slabcast_common::transfer::Support;
use slabcast_scene::brick_needs::BrickNeeds;
use std::sync::Arc;

/// Answers for each block of a level.
pub(super) struct SameBlocks<'a> {
    summaries: &'a BlockSummaries,
    /// Bins of which a code is visible, and whether NaN is.
    visible: (u64, bool),
    /// Bins and NaN that are visible either now or before but not both; `None` if no block stays.
    changed: Option<(u64, bool)>,
    /// Whether values of neighbouring blocks count.
    has_halo: bool,
    /// Blocks that may hold bricks; `None` if all may.
    window: Option<Arc<BlockSet>>,
}

impl<'a> SameBlocks<'a> {
    /// Compares the needs of a new store with those of the store `before`.
    pub(super) fn new(
        summaries: &'a BlockSummaries,
        needs: &BrickNeeds,
        before: Option<&BrickNeeds>,
    ) -> SameBlocks<'a> {
        let alike = |before: &&BrickNeeds| {
            let but_for_blocks = |n: &BrickNeeds| BrickNeeds {
                support: Support::default(),
                window: None,
                ..n.clone()
            };
            but_for_blocks(before) == but_for_blocks(needs)
        };
        let changed = before.filter(alike).map(|before| {
            let bins = changed_bins(&summaries.bins, &before.support, &needs.support);
            (bins, before.support.nan != needs.support.nan)
        });
        SameBlocks {
            summaries,
            visible: (summaries.bins.mask(&needs.support), needs.support.nan),
            changed,
            has_halo: needs.halo > 0,
            window: needs.window.clone(),
        }
    }

    /// Returns whether a block may hold a brick.
    pub(super) fn may_hold(&self, block: usize) -> bool {
        self.window.as_ref().is_none_or(|window| window.contains(block))
            && self.meets(block, self.visible)
    }

    /// Returns whether a block has the same bricks as before.
    pub(super) fn is_same(&self, block: usize) -> bool {
        self.changed.is_some_and(|changed| !self.meets(block, changed))
    }

    /// Returns how many bricks and voxels a block may hold at most: all of its own where it has visible
    /// values itself; else those within the halo of a neighbour that has.
    pub(super) fn most(&self, block: usize, halo: u32) -> (u64, u64) {
        let (bins, nan) = self.visible;
        let here = |i: usize| {
            let summary = &self.summaries.all[i];
            summary.bins & bins != 0 || (nan && summary.nan)
        };
        let bricks = u64::from(BLOCK_EDGE / BRICK_EDGE);
        if here(block) {
            return (bricks.pow(3), u64::from(BLOCK_EDGE).pow(3));
        }
        let [nx, ny, nz] = self.summaries.dims.map(|n| n as usize);
        let at = [block % nx, block / nx % ny, block / nx / ny];
        let mut most = (0, 0);
        let near = |a: usize, n: usize| at[a].saturating_sub(1)..=(at[a] + 1).min(n - 1);
        for z in near(2, nz) {
            for y in near(1, ny) {
                for x in near(0, nx).filter(|&x| here((z * ny + y) * nx + x)) {
                    // Axes along which the neighbour lies beside the block: 1 of a face, 3 of a corner.
                    let beside = [x, y, z].iter().zip(at).filter(|(a, b)| **a != *b).count() as u32;
                    let voxels =
                        u64::from(BLOCK_EDGE).pow(3 - beside) * u64::from(halo).pow(beside);
                    most = (most.0 + bricks.pow(3 - beside), most.1 + voxels);
                }
            }
        }
        most
    }

    /// Returns whether values that decide a block's bricks lie in some bins, or are NaN.
    fn meets(&self, block: usize, (bins, nan): (u64, bool)) -> bool {
        let all = &self.summaries.all;
        let here = |i: usize| all[i].bins & bins != 0 || (nan && all[i].nan);
        if !self.has_halo || here(block) {
            return here(block);
        }
        let [nx, ny, nz] = self.summaries.dims.map(|n| n as usize);
        let [x, y, z] = [block % nx, block / nx % ny, block / nx / ny];
        let near = |at: usize, n: usize| at.saturating_sub(1)..=(at + 1).min(n - 1);
        near(z, nz).any(|z| near(y, ny).any(|y| near(x, nx).any(|x| here((z * ny + y) * nx + x))))
    }
}

/// Returns the bins in which two supports differ. May return more, never fewer.
fn changed_bins(bins: &ValueBins, a: &Support, b: &Support) -> u64 {
    // A code near an edge may be rounded into either bin.
    let slack = bins.width * 1e-6;
    let within = |support: &Support, lo: f64, hi: f64| -> Vec<(f64, f64)> {
        let clipped = support.intervals.iter().map(|&(a, b)| (a.max(lo), b.min(hi)));
        clipped.filter(|(a, b)| a <= b).collect()
    };
    (0..64u32).fold(0, |mask, bin| {
        let edge = |n: u32| bins.first_code + bins.width * f64::from(n);
        let lo = if bin == 0 { f64::NEG_INFINITY } else { edge(bin) - slack };
        let hi = if bin == 63 { f64::INFINITY } else { edge(bin + 1) + slack };
        mask | u64::from(within(a, lo, hi) != within(b, lo, hi)) << bin
    })
}
