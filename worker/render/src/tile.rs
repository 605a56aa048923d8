//! One macrotile of one slab: what workers run.
//!
//! The tile is cut into parts of at most 64x64 pixels, whose open sheets stay in the cache. In
//! a part, front to back, for each sheet k of the slab:
//!
//! 1. **Admit** the bricks that begin at k: one whose rectangle is all shut is culled; the
//!    voxels of the others are transformed, those whose footprint is all shut are culled, the
//!    rest are tossed into the bucket of their first sheet (paper section 3).
//! 2. **Splat** bucket k: each voxel is tested once more, shaded, and all its sections are added
//!    to the ring of open sheets. So the next sheet is half filled when this one closes, which
//!    is just what the colour rule wants to see ([`crate::sheet`]).
//! 3. **Close** sheet k where it was touched: composite, shut pixels, update the counts.
//!
//! A part is left as soon as all its pixels are shut. Bytes do not depend on any of this: sums
//! are integers (or floats in one order), an open pixel gets every voxel that covers it, and
//! what a shut pixel gets is never read.

use crate::scene::Frame;
use crate::sheet::Sum;
use crate::splat::{Accumulate, Simd, splat};
use glam::DVec3;
use slabcast_common::brick::Brick;
use slabcast_common::image::{RawSums, TilePixels, TileState};
use slabcast_common::message::Counters;
use slabcast_common::occlusion::{Rect, ShutMap};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::Projected;
use std::sync::Arc;

/// Edge of a tile part. 64 gives 8x8 blocks of 8x8 pixels, one bit each in a word, and six open
/// sheets of 64 KiB, which fit a second cache of 512 KiB. At 32 a head takes 12 % more splats
/// (286 k instead of 256 k a frame) for their overlap and no less time (docs/measurements.md);
/// at 128 the blocks would need four words, and the sheets 1.5 MiB.
const PART: i32 = 64;
/// Edge of the blocks by which a sheet's touched pixels are known.
const BLOCK: usize = 8;

/// A voxel waiting in the bucket of its first sheet.
#[derive(Clone, Copy)]
struct Waiting {
    /// Which of the part's bricks.
    brick: u32,
    /// Which voxel of it.
    voxel: u16,
    /// Depth in phases.
    z: i32,
}

/// A brick as a part sees it.
struct PartBrick<'a> {
    brick: &'a Brick,
    corner: DVec3,
    projected: Projected,
}

/// Memory that a render thread keeps from tile to tile.
#[derive(Default)]
pub struct Scratch {
    ints: Ring<i32>,
    floats: Ring<f32>,
    shared: Shared,
}

struct Shared {
    shut: ShutMap,
    buckets: Vec<Vec<Waiting>>,
    carried: Vec<Waiting>,
    secants: Vec<f32>,
    a: Vec<f32>,
    colour: Vec<[u32; 3]>,
    wx: Vec<f32>,
    wy: Vec<f32>,
}

impl Default for Shared {
    fn default() -> Self {
        Shared {
            shut: ShutMap::open(Rect::default()),
            buckets: Vec::new(),
            carried: Vec::new(),
            secants: Vec::new(),
            a: Vec::new(),
            colour: Vec::new(),
            wx: Vec::new(),
            wy: Vec::new(),
        }
    }
}

/// Open sheets: the one before k, k itself, and as many behind as a voxel has sections.
#[derive(Default)]
struct Ring<S> {
    sheets: Vec<Vec<[S; 4]>>,
    /// Touched blocks of each sheet, one bit a block.
    touched: Vec<u64>,
}

impl<S: Sum> Ring<S> {
    fn reset(&mut self, sheets: usize) {
        let n = (PART * PART) as usize;
        if self.sheets.len() < sheets {
            self.sheets.resize_with(sheets, || vec![[S::default(); 4]; n]);
            self.touched.resize(sheets, 0);
        }
        for i in 0..self.sheets.len() {
            self.clear(i);
        }
    }

    /// Empties the touched blocks of slot `i`.
    fn clear(&mut self, i: usize) {
        let mut mask = std::mem::take(&mut self.touched[i]);
        while mask != 0 {
            let b = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            let at = (b / 8 * BLOCK) * PART as usize + b % 8 * BLOCK;
            for y in 0..BLOCK {
                let row = at + y * PART as usize;
                self.sheets[i][row..row + BLOCK].fill([S::default(); 4]);
            }
        }
    }
}

/// Renders the sheets of `slab` on `tile`, from `state`, with `bricks` (ascending id; at least
/// all that the tile and slab need).
///
/// # Panics
/// If the planes of `state` do not have the tile's size.
pub fn render(
    frame: &Frame,
    simd: Simd,
    tile: Rect,
    slab: SheetRange,
    bricks: &[Arc<Brick>],
    state: &TileState,
    scratch: &mut Scratch,
) -> (TilePixels, Counters) {
    assert_eq!(state.a.len(), tile.area(), "one A a pixel");
    let neighbours = frame.looks_at_neighbours();
    let mut out = TilePixels {
        a: state.a.clone(),
        colour: vec![[0; 3]; tile.area()],
        last: neighbours.then(|| vec![[0; 4]; tile.area()]),
    };
    let mut counters = Counters::default();
    let mut seen: Vec<PartBrick<'_>> = bricks
        .iter()
        .filter_map(|b| {
            let projected = frame.view.project(&b.tight(&frame.scene.grid))?;
            let corner = frame.view.corner_in_eye(frame.scene.grid.corner(b.id));
            (projected.sheets.overlaps(slab) && !projected.rect.intersect(&tile).is_empty())
                .then_some(PartBrick { brick: b, corner, projected })
        })
        .collect();
    // Front to back; bricks that begin together stay in ascending id.
    seen.sort_by_key(|b| (b.projected.sheets.first, b.brick.id));
    for y0 in (tile.y0..tile.y1).step_by(PART as usize) {
        for x0 in (tile.x0..tile.x1).step_by(PART as usize) {
            let rect = Rect::new(x0, y0, x0 + PART, y0 + PART).intersect(&tile);
            let inside: Vec<&PartBrick<'_>> =
                seen.iter().filter(|b| !b.projected.rect.intersect(&rect).is_empty()).collect();
            if inside.is_empty() {
                continue;
            }
            let Scratch { ints, floats, shared } = scratch;
            let part = Part { frame, simd, rect, tile, slab, bricks: &inside };
            if frame.scene.float_sums() {
                part.render(floats, shared, state, &mut out, &mut counters);
            } else {
                part.render(ints, shared, state, &mut out, &mut counters);
            }
        }
    }
    if out.last.as_ref().is_some_and(|l| l.iter().all(|s| *s == [0; 4])) {
        out.last = None;
    }
    (out, counters)
}

struct Part<'a> {
    frame: &'a Frame,
    simd: Simd,
    rect: Rect,
    tile: Rect,
    slab: SheetRange,
    bricks: &'a [&'a PartBrick<'a>],
}

impl Part<'_> {
    /// Index in the tile's planes of the first pixel of the part's row `y`.
    fn tile_row(&self, y: usize) -> usize {
        (self.rect.y0 - self.tile.y0) as usize * self.tile.width()
            + y * self.tile.width()
            + (self.rect.x0 - self.tile.x0) as usize
    }

    fn render<S: Accumulate>(
        &self,
        ring: &mut Ring<S>,
        shared: &mut Shared,
        state: &TileState,
        out: &mut TilePixels,
        counters: &mut Counters,
    ) {
        let (w, h) = (self.rect.width(), self.rect.height());
        let stride = PART as usize;
        let slots = self.frame.sections.most() + 1;
        ring.reset(slots);
        let slot = |k: i32| k.rem_euclid(slots as i32) as usize;
        let s = shared;
        s.shut.reset(self.rect);
        s.a.clear();
        s.secants.clear();
        s.colour.clear();
        s.colour.resize(w * h, [0; 3]);
        let mut open = 0usize;
        for y in 0..h {
            let row = self.tile_row(y);
            for x in 0..w {
                let a = state.a[row + x];
                s.a.push(a);
                s.secants
                    .push(self.frame.view.secant(self.rect.x0 + x as i32, self.rect.y0 + y as i32));
                if self.frame.rule.is_shut(a) {
                    s.shut.shut(y * w + x);
                } else {
                    open += 1;
                }
            }
        }
        s.shut.refresh();
        if let Some(last) = &state.last {
            let before = slot(self.slab.first - 1);
            for y in 0..h {
                let row = self.tile_row(y);
                for x in 0..w {
                    ring.sheets[before][y * stride + x] = last[row + x].map(S::from_bits);
                }
            }
            ring.touched[before] = u64::MAX;
        }
        let sheets = self.slab.len() as usize;
        if s.buckets.len() < sheets {
            s.buckets.resize_with(sheets, Vec::new);
        }
        for bucket in &mut s.buckets {
            bucket.clear();
        }
        s.carried.clear();

        let mut next = 0;
        for k in self.slab.first..self.slab.end {
            if open == 0 {
                break;
            }
            while next < self.bricks.len() && self.bricks[next].projected.sheets.first <= k {
                self.admit(next, s, counters);
                next += 1;
            }
            if k == self.slab.first && !s.carried.is_empty() {
                // Voxels that begin before the slab come first, as they do without the cut.
                let mut carried = std::mem::take(&mut s.carried);
                if self.frame.scene.float_sums() {
                    carried.sort_by_key(|v| {
                        (
                            self.frame.sections.first(v.z),
                            self.bricks[v.brick as usize].brick.id,
                            v.voxel,
                        )
                    });
                }
                self.splat_all(&carried, k, ring, slot, s, counters);
                carried.clear();
                s.carried = carried;
            }
            let mut bucket = std::mem::take(&mut s.buckets[(k - self.slab.first) as usize]);
            if self.frame.scene.float_sums() {
                bucket.sort_by_key(|v| (self.bricks[v.brick as usize].brick.id, v.voxel));
            }
            self.splat_all(&bucket, k, ring, slot, s, counters);
            bucket.clear();
            s.buckets[(k - self.slab.first) as usize] = bucket;
            open -= self.close(k, ring, slot, s);
            ring.clear(slot(k - 1));
        }
        // Whatever the part did not come to is hidden.
        counters.culled += self.bricks[next..].iter().map(|b| b.brick.len() as u64).sum::<u64>();
        counters.culled += s.buckets.iter().map(|b| b.len() as u64).sum::<u64>();

        let last_sheet = slot(self.slab.end - 1);
        for y in 0..h {
            let row = self.tile_row(y);
            out.a[row..row + w].copy_from_slice(&s.a[y * w..(y + 1) * w]);
            out.colour[row..row + w].copy_from_slice(&s.colour[y * w..(y + 1) * w]);
            if let Some(last) = &mut out.last {
                for x in 0..w {
                    // Nobody reads a shut pixel's sums; they may be anything, so they are none.
                    if !s.shut.is_shut(y * w + x) && open > 0 {
                        last[row + x] = ring.sheets[last_sheet][y * stride + x].map(S::bits);
                    }
                }
            }
        }
    }

    /// Where a voxel's footprints lie, all sections together.
    #[inline]
    fn extent(&self, eye: DVec3, z: i32) -> Option<Rect> {
        let (first, weights) = self.frame.sections.of(z);
        let last = first + weights.len() as i32 - 1;
        let view = &self.frame.view;
        let at = |k: i32| {
            let f = self.frame.footprints.at(k)?;
            let [x, y] = view.screen(eye.x, eye.y, f.scale);
            let ((x0, x1), (y0, y1)) = (f.extent(0, x), f.extent(1, y));
            Some(Rect::new(x0, y0, x1, y1))
        };
        match view.projection {
            slabcast_common::view::Projection::Ortho { .. } => at(first),
            slabcast_common::view::Projection::Persp { .. } => {
                // Edges move one way with depth, so the first and last visible sections hold
                // the others. An end's rounding may put one a pixel farther out: grow by one.
                let front = (first..=last).find_map(at)?;
                let back = at(last)?;
                let r = front.union(&back);
                Some(Rect::new(r.x0 - 1, r.y0 - 1, r.x1 + 1, r.y1 + 1))
            }
        }
    }

    /// Tests a brick, then its voxels, and tosses what is left into buckets.
    fn admit(&self, which: usize, s: &mut Shared, counters: &mut Counters) {
        let PartBrick { brick, corner, projected } = self.bricks[which];
        let cull = self.frame.scene.quality.cull;
        if cull && s.shut.all_shut(&projected.rect) {
            counters.culled += brick.len() as u64;
            return;
        }
        for (voxel, &local) in brick.index.iter().enumerate() {
            let eye = self.frame.eye(*corner, local);
            let z = self.frame.view.depth_in_phases(eye.z);
            let (first, weights) = self.frame.sections.of(z);
            if first >= self.slab.end || first + (weights.len() as i32) <= self.slab.first {
                continue;
            }
            let Some(extent) = self.extent(eye, z) else { continue };
            if extent.intersect(&self.rect).is_empty() {
                continue;
            }
            if cull && s.shut.all_shut(&extent) {
                counters.culled += 1;
                continue;
            }
            counters.tossed += 1;
            let waiting = Waiting { brick: which as u32, voxel: voxel as u16, z };
            if first < self.slab.first {
                s.carried.push(waiting);
            } else {
                s.buckets[(first - self.slab.first) as usize].push(waiting);
            }
        }
    }

    fn splat_all<S: Accumulate>(
        &self,
        bucket: &[Waiting],
        k: i32,
        ring: &mut Ring<S>,
        slot: impl Fn(i32) -> usize,
        s: &mut Shared,
        counters: &mut Counters,
    ) {
        let frame = self.frame;
        let stride = PART as usize;
        // The sheet behind the slab is filled as far as the colour rule peeks.
        let end = self.slab.end + i32::from(frame.looks_at_neighbours());
        for v in bucket {
            let PartBrick { brick, corner, .. } = self.bricks[v.brick as usize];
            let eye = frame.eye(*corner, brick.index[v.voxel as usize]);
            if frame.scene.quality.cull {
                let hidden = self.extent(eye, v.z).is_none_or(|e| s.shut.all_shut(&e));
                if hidden {
                    counters.culled += 1;
                    continue;
                }
            }
            let payload = frame.payload(brick, v.voxel as usize, eye);
            if payload[0] <= 0.0 {
                continue;
            }
            counters.splatted += 1;
            let (first, weights) = frame.sections.of(v.z);
            for (i, &wz) in weights.iter().enumerate() {
                let sheet = first + i as i32;
                if sheet < k.max(self.slab.first) {
                    continue;
                }
                if sheet >= end {
                    break;
                }
                let Some(f) = frame.footprints.at(sheet) else { continue };
                let [x, y] = frame.view.screen(eye.x, eye.y, f.scale);
                let (x0, wx) = f.weights(0, x, (self.rect.x0, self.rect.x1), &mut s.wx);
                let (y0, wy) = f.weights(1, y, (self.rect.y0, self.rect.y1), &mut s.wy);
                if wx.is_empty() || wy.is_empty() {
                    continue;
                }
                let (x0, y0) = ((x0 - self.rect.x0) as usize, (y0 - self.rect.y0) as usize);
                let at = slot(sheet);
                splat(
                    self.simd,
                    &mut ring.sheets[at],
                    stride,
                    (x0, wx),
                    (y0, wy),
                    payload.map(|p| p * wz),
                );
                let (bx0, bx1) = (x0 / BLOCK, (x0 + wx.len() - 1) / BLOCK);
                let row = (u64::MAX >> (63 - (bx1 - bx0))) << bx0;
                for by in y0 / BLOCK..=(y0 + wy.len() - 1) / BLOCK {
                    ring.touched[at] |= row << (8 * by);
                }
            }
        }
    }

    /// Closes sheet `k` where it was touched; returns how many pixels were shut.
    fn close<S: Accumulate>(
        &self,
        k: i32,
        ring: &Ring<S>,
        slot: impl Fn(i32) -> usize,
        s: &mut Shared,
    ) -> usize {
        let (w, h) = (self.rect.width(), self.rect.height());
        let stride = PART as usize;
        let rule = self.frame.rule;
        let (before, here, behind) =
            (&ring.sheets[slot(k - 1)], &ring.sheets[slot(k)], &ring.sheets[slot(k + 1)]);
        let mut mask = ring.touched[slot(k)];
        let mut shut = 0;
        while mask != 0 {
            let b = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            let (x0, y0) = (b % 8 * BLOCK, b / 8 * BLOCK);
            for y in y0..(y0 + BLOCK).min(h) {
                for x in x0..(x0 + BLOCK).min(w) {
                    let (i, j) = (y * w + x, y * stride + x);
                    if s.shut.is_shut(i) {
                        continue;
                    }
                    let a = &mut s.a[i];
                    rule.close(before[j], here[j], behind[j], s.secants[i], a, &mut s.colour[i]);
                    if rule.is_shut(*a) {
                        s.shut.shut(i);
                        shut += 1;
                    }
                }
            }
        }
        if shut > 0 {
            s.shut.refresh();
        }
        shut
    }
}

/// Planes as they are before the first slab.
pub fn blank(tile: Rect) -> TileState {
    TileState { a: vec![0.0; tile.area()], last: None::<Vec<RawSums>> }
}
