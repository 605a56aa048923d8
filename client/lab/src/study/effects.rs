//! Section 5.1 beyond its table: effects of the size of bricks, the radius of the kernel, the size
//! of the picture, and culling.
//!
//! The paper states these without numbers. Only bricks of 8 voxels can be drawn here. Bricks of 4
//! and 16 are *counted*: the voxels are put into boxes of that size, and the boxes are projected
//! and culled against the measured occlusion behind each slab.

use super::nodes::{later, longest_wait, shares};
use super::paper::{NODES, VOXEL_BYTES};
use super::simulate::{MeasuredPath, Pace, SimulatedCluster};
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

/// Counts for one size of bricks, in the middle view with three slabs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Bricks {
    /// Edge of the bricks in voxels.
    pub(super) edge: u32,
    /// Number of boxes with a relevant voxel.
    pub(super) boxes: u64,
    /// Number of boxes that some slab needs.
    pub(super) needed: u64,
    /// Share of the relevant voxels that lie in needed boxes.
    pub(super) needed_voxels: f64,
    /// Size of the needed voxels in MB at the paper's 16 bytes each.
    pub(super) needed_paper_mb: f64,
    /// Voxels that macrotiles of 64 pixels read, for each voxel in a needed box. A box in several
    /// tiles or slabs is read several times.
    pub(super) looked_at: f64,
    /// `looked_at` for macrotiles of 32 pixels.
    pub(super) looked_at_32: f64,
}

/// Sorts relevant voxels into boxes of `edge` voxels, a power of two. Returns the tight box and the
/// number of voxels of each.
fn boxes(bricks: &[Arc<Brick>], grid: &BrickGrid, edge: u32) -> Vec<(TightBox, u64)> {
    let mut all: BTreeMap<[u32; 3], (TightBox, u64)> = BTreeMap::new();
    for brick in bricks {
        let corner = grid.corner(brick.id);
        for &i in &brick.index {
            let i = u32::from(i);
            let voxel = [corner[0] + i % 8, corner[1] + i / 8 % 8, corner[2] + i / 64];
            let one = TightBox { lo: voxel, hi: voxel };
            let (tight, n) = all.entry(voxel.map(|x| x / edge)).or_insert((one, 0));
            for a in 0..3 {
                tight.lo[a] = tight.lo[a].min(voxel[a]);
                tight.hi[a] = tight.hi[a].max(voxel[a]);
            }
            *n += 1;
        }
    }
    all.into_values().collect()
}

/// Counts bricks of `edge` voxels in a measured frame.
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

/// Counts bricks of 4, 8 and 16 voxels in the middle view.
pub(super) fn bricks(scenes: &PathScenes, measured_path: &MeasuredPath) -> Vec<Bricks> {
    let grid = BrickGrid::new(scenes.spec(0).volume.lattice.dims);
    let i = measured_path.trace.frames.len() / 2;
    [4, 8, 16]
        .into_iter()
        .map(|edge| {
            let boxes = boxes(&scenes.bricks, &grid, edge);
            count(&boxes, edge, &measured_path.jobs[i].view, &measured_path.trace.frames[i])
        })
        .collect()
}

/// Results for one radius or picture size: tiles of 64 pixels drawn here, and 15 rendering nodes
/// simulated at the paper's pace of the requested setting.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Setting {
    /// Name such as `radius 1.5` or `1024x1024`.
    pub(super) name: String,
    /// Measured time of a frame on one core, in ms.
    pub(super) alone_ms: f64,
    /// Measured sum of its macrotiles of 64 and of 32 pixels, in ms.
    pub(super) tiles_ms: [f64; 2],
    /// Simulated shares of the nodes' time: rendering, messages and bricks, waiting.
    pub(super) shares: [f64; 3],
    /// Simulated longest wait of a node over the time of the frame.
    pub(super) max_wait: f64,
    pub(super) speed_up: f64,
}

impl Setting {
    /// Simulates the setting, with tile times multiplied by the study's own `stretch`.
    pub(super) fn new(
        name: String,
        measured_path: &MeasuredPath,
        stretch: f64,
    ) -> Result<Setting, Fail> {
        let frames = later(&measured_path.trace.frames);
        let n = frames.len().max(1) as f64;
        let tiles_ms = [64, 32].map(|edge| {
            let levels = frames.iter().flat_map(|f| &f.slabs).flat_map(|s| &s.levels);
            let tiles = levels.filter(|l| l.edge == edge).flat_map(|l| &l.tiles);
            tiles.map(|t| t.ns as f64 / 1e6).sum::<f64>() / n
        });
        let cluster = SimulatedCluster {
            tile: Some(64),
            ..SimulatedCluster::new(Schedule::Slab, NODES[4] - 1, Pace::Paper)
        };
        let reports = measured_path.run_stretched(&cluster, stretch)?;
        let reports = later(&reports);
        let frame_ms: f64 = reports.iter().map(|t| t.0.ms.total).sum();
        let longest: f64 = reports.iter().map(longest_wait).sum();
        let alone_ms = measured_path.alone_ms(Pace::Here);
        Ok(Setting {
            name,
            alone_ms,
            tiles_ms,
            shares: shares(reports),
            max_wait: longest / frame_ms.max(1e-9),
            speed_up: alone_ms * stretch * reports.len() as f64 / frame_ms.max(1e-9),
        })
    }
}

/// Measured time of a frame on one core with culling and without, in ms.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Culling {
    pub(super) with_ms: f64,
    pub(super) without_ms: f64,
}

/// Draws the middle view of `frames` with and without culling in turn; the shorter of two times
/// counts.
pub(super) fn culling(scenes: &PathScenes, frames: usize) -> Result<Culling, Fail> {
    let mut best = [f64::INFINITY; 2];
    for _ in 0..2 {
        for (best, cull) in best.iter_mut().zip([true, false]) {
            let frame = scenes.frame_with(frames / 2, |q| Quality { cull, ..q })?;
            let began = cpu_ns();
            direct::draw(&frame, &scenes.bricks, Cut { tile: 64, ..Cut::on(1) });
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
