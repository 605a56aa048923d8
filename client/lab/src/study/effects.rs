//! Section 5.1 beyond its table: what the size of bricks, the kernel's radius and the size of the
//! picture do, and what culling saves.
//!
//! The paper has sentences for these and no numbers. Bricks are 8 here, and nothing else can be
//! drawn; those of 4 and 16 are *counted*: the volume's voxels are put into boxes of that size, the
//! boxes are projected and culled against the occlusion that was measured behind each slab.

use super::nodes::{later, longest_wait, shares};
use super::paper::{NODES, VOXEL_BYTES};
use super::simulate::{Ask, Bed, Pace};
use crate::plan::clock::cpu_ns;
use serde::Serialize;
use slabcast_common::brick::{Brick, BrickGrid, TightBox};
use slabcast_common::occlusion::{Rect, ShutMap};
use slabcast_common::quality::{Quality, Schedule};
use slabcast_common::view::{Projected, View};
use slabcast_schedule::macrotile;
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::Fail;
use slabcast_session::path_scenes::PathScenes;
use slabcast_trace::FrameTrace;
use std::collections::BTreeMap;
use std::sync::Arc;

/// What a size of bricks comes to, in the middle view in three slabs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Bricks {
    pub(super) edge: u32,
    /// Boxes with a relevant voxel.
    pub(super) boxes: u64,
    /// Those that some slab needs.
    pub(super) needed: u64,
    /// Voxels in them over all relevant ones.
    pub(super) needed_voxels: f64,
    /// Those voxels in the paper's 16 bytes, in MB.
    pub(super) needed_paper_mb: f64,
    /// Voxels that macrotiles of 64 pixels have to look at, for one in a needed box: what lies over
    /// several tiles, or in several slabs, is looked at several times.
    pub(super) looked_at: f64,
    /// The same in macrotiles of 32 pixels.
    pub(super) looked_at_32: f64,
}

/// The relevant voxels in boxes of `edge` (a power of two from 1): tight box and number.
fn boxes(bricks: &[Arc<Brick>], grid: &BrickGrid, edge: u32) -> Vec<(TightBox, u64)> {
    let mut all: BTreeMap<[u32; 3], (TightBox, u64)> = BTreeMap::new();
    for brick in bricks {
        let corner = grid.corner(brick.id);
        for &i in &brick.index {
            let i = u32::from(i);
            let at = [corner[0] + i % 8, corner[1] + i / 8 % 8, corner[2] + i / 64];
            let one = TightBox { lo: at, hi: at };
            let (tight, n) = all.entry(at.map(|x| x / edge)).or_insert((one, 0));
            for a in 0..3 {
                tight.lo[a] = tight.lo[a].min(at[a]);
                tight.hi[a] = tight.hi[a].max(at[a]);
            }
            *n += 1;
        }
    }
    all.into_values().collect()
}

/// Counts bricks of `edge` in a frame that was measured.
fn count(boxes: &[(TightBox, u64)], edge: u32, view: &View, frame: &FrameTrace) -> Bricks {
    let size = view.size;
    let seen: Vec<Option<Projected>> = boxes.iter().map(|b| view.project(&b.0)).collect();
    let mut shut = ShutMap::open(Rect::from_size(size));
    let mut needed = vec![false; boxes.len()];
    let mut looked_at = [0u64; 2];
    for slab in &frame.slabs {
        let mut rects = Vec::new();
        for (i, p) in seen.iter().enumerate() {
            let over = |p: &&Projected| p.sheets.first < slab.end && slab.first < p.sheets.end;
            let Some(p) = p.as_ref().filter(over) else { continue };
            if !shut.all_shut(&p.rect) {
                needed[i] = true;
                rects.push((i, p.rect));
            }
        }
        let only: Vec<Rect> = rects.iter().map(|r| r.1).collect();
        for (sum, tile) in looked_at.iter_mut().zip([64, 32]) {
            let cut = macrotile::cut(size, &only, &shut, true, 0, Some(tile));
            for (i, rect) in &rects {
                let over = |t: &&macrotile::Macrotile| !t.rect.intersect(rect).is_empty();
                *sum += cut.tiles.iter().filter(over).count() as u64 * boxes[*i].1;
            }
        }
        for (i, _) in slab.shut(size).iter().enumerate().filter(|(_, s)| **s) {
            shut.shut(i);
        }
        shut.refresh();
    }
    let all: u64 = boxes.iter().map(|b| b.1).sum();
    let of_needed: u64 = boxes.iter().zip(&needed).filter(|(_, n)| **n).map(|(b, _)| b.1).sum();
    let a_voxel = |n: u64| n as f64 / of_needed.max(1) as f64;
    Bricks {
        edge,
        boxes: boxes.len() as u64,
        needed: needed.iter().filter(|n| **n).count() as u64,
        needed_voxels: of_needed as f64 / all.max(1) as f64,
        needed_paper_mb: (of_needed * VOXEL_BYTES) as f64 / 1e6,
        looked_at: a_voxel(looked_at[0]),
        looked_at_32: a_voxel(looked_at[1]),
    }
}

/// Bricks of 4, 8 and 16 in the middle view of a bed.
pub(super) fn bricks(stage: &PathScenes, bed: &Bed) -> Vec<Bricks> {
    let grid = BrickGrid::new(stage.spec(0).volume.lattice.dims);
    let i = bed.trace.frames.len() / 2;
    [4, 8, 16]
        .into_iter()
        .map(|edge| {
            let boxes = boxes(&stage.bricks, &grid, edge);
            count(&boxes, edge, &bed.jobs[i].view, &bed.trace.frames[i])
        })
        .collect()
}

/// A setting of radius or size: tiles of 64 pixels drawn here, 15 rendering nodes simulated at the
/// paper's pace of the setting that was asked for.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Setting {
    /// `radius 1.5`, `1024x1024`.
    pub(super) name: String,
    /// A frame alone on one core, in ms: drawn here.
    pub(super) alone_ms: f64,
    /// Sum of its macrotiles of 64 pixels, of 32 pixels: drawn here.
    pub(super) tiles_ms: [f64; 2],
    /// Parts of all nodes' time: rendering, messages and bricks, waiting. Simulated.
    pub(super) shares: [f64; 3],
    /// The longest wait of a node over the frame's time. Simulated.
    pub(super) max_wait: f64,
    pub(super) speed_up: f64,
}

impl Setting {
    /// Of a bed; its tiles are stretched as those of the study's own setting.
    pub(super) fn new(name: String, bed: &Bed, stretch: f64) -> Result<Setting, Fail> {
        let frames = later(&bed.trace.frames);
        let n = frames.len().max(1) as f64;
        let tiles_ms = [64, 32].map(|edge| {
            let levels = frames.iter().flat_map(|f| &f.slabs).flat_map(|s| &s.levels);
            let tiles = levels.filter(|l| l.edge == edge).flat_map(|l| &l.tiles);
            tiles.map(|t| t.ns as f64 / 1e6).sum::<f64>() / n
        });
        let ask = Ask { tile: Some(64), ..Ask::of(Schedule::Slab, NODES[4] - 1, Pace::Paper) };
        let told = bed.run_at(&ask, stretch)?;
        let told = later(&told);
        let frame_ms: f64 = told.iter().map(|t| t.0.ms.total).sum();
        let longest: f64 = told.iter().map(longest_wait).sum();
        let alone_ms = bed.alone_ms(Pace::Here);
        Ok(Setting {
            name,
            alone_ms,
            tiles_ms,
            shares: shares(told),
            max_wait: longest / frame_ms.max(1e-9),
            speed_up: alone_ms * stretch * told.len() as f64 / frame_ms.max(1e-9),
        })
    }
}

/// A frame alone on one core with culling and without, in ms; drawn here.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Culling {
    pub(super) with_ms: f64,
    pub(super) without_ms: f64,
}

/// Draws the middle view of `frames` both ways in turn; the shorter of two times each.
pub(super) fn culling(stage: &PathScenes, frames: usize) -> Result<Culling, Fail> {
    let mut best = [f64::INFINITY; 2];
    for _ in 0..2 {
        for (best, cull) in best.iter_mut().zip([true, false]) {
            let frame = stage.frame_with(frames / 2, |q| Quality { cull, ..q })?;
            let began = cpu_ns();
            direct::draw(&frame, &stage.bricks, Cut { tile: 64, ..Cut::on(1) });
            *best = best.min((cpu_ns() - began) as f64 / 1e6);
        }
    }
    Ok(Culling { with_ms: best[0], without_ms: best[1] })
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::ids::BrickId;
    use slabcast_common::volume::Samples;

    #[test]
    fn boxes_of_any_size_hold_every_voxel_once() {
        // A full brick and one with a single voxel beside it.
        let full = Brick::new(BrickId(0), (0..512).collect(), Samples::U8(vec![1; 512]), None);
        let one = Brick::new(BrickId(1), vec![9], Samples::U8(vec![1]), None);
        let bricks = [Arc::new(full), Arc::new(one)];
        let grid = BrickGrid::new([16, 8, 8]);
        let n = |edge| {
            let all = boxes(&bricks, &grid, edge);
            (all.len(), all.iter().map(|b| b.1).sum::<u64>())
        };
        assert_eq!([n(4), n(8), n(16)], [(9, 513), (2, 513), (1, 513)]);
        let fine = boxes(&bricks, &grid, 4);
        assert!(fine.iter().any(|b| b.0 == TightBox { lo: [9, 1, 0], hi: [9, 1, 0] }));
        assert_eq!(boxes(&bricks, &grid, 16)[0].0, TightBox { lo: [0; 3], hi: [9, 7, 7] });
    }
}
