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
//! 3. **Close** sheet k where it was touched: composite, shut pixels, take them out of the mask.
//!
//! A part is left as soon as all its pixels are shut. Bytes do not depend on any of this: sums
//! are integers (or floats in one order), an open pixel gets every voxel that covers it, and
//! what a shut pixel gets is never read.

use crate::footprint::Footprint;
use crate::mask::{OpenMask, REACH_MOST};
use crate::ring::{self, BLOCK, Planes, Records, Ring, SLOTS, Window};
use crate::scene::Frame;
use crate::sheet::Row;
use crate::splat::{Accumulate, Simd, Tap, Weight, Work};
use glam::DVec3;
use slabcast_common::brick::Brick;
use slabcast_common::image::{RawSums, TilePixels, TileState};
use slabcast_common::message::Counters;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Sums;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projected, Projection, SUBPIXEL_BITS};
use std::sync::Arc;

/// Edge of a tile part. 64 gives 8x8 blocks of 8x8 pixels, one bit each in a word, and six open
/// sheets of 64 KiB, which fit a second cache of 512 KiB. At 32 a head takes 12 % more splats
/// (286 k instead of 256 k a frame) for their overlap and no less time (docs/measurements.md);
/// at 128 the blocks would need four words, and the sheets 1.5 MiB.
const PART: i32 = ring::PART as i32;

/// A voxel waiting in the bucket of its first sheet.
#[derive(Clone, Copy)]
struct Waiting {
    /// Which of the part's bricks.
    brick: u32,
    /// Which voxel of it.
    voxel: u16,
    /// Depth in phases.
    z: i32,
    /// Screen position in subpixels, where all its sections share it (orthographic views).
    x: i32,
    y: i32,
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
    ints: Planes<i32>,
    floats: Planes<f32>,
    shorts: Planes<i16>,
    records: Records,
    taps: [Vec<Tap>; 2],
    units: [Vec<i16>; 2],
    shared: Shared,
}

/// A part's pixels and buckets. Planes have rows of [`PART`] pixels, whatever the part's width.
struct Shared {
    buckets: Vec<Vec<Waiting>>,
    carried: Vec<Waiting>,
    secants: Vec<f32>,
    a: Vec<f32>,
    colour: [Vec<u32>; 3],
}

impl Default for Shared {
    fn default() -> Self {
        let n = (PART * PART) as usize;
        Shared {
            buckets: Vec::new(),
            carried: Vec::new(),
            secants: vec![1.0; n],
            a: vec![0.0; n],
            colour: std::array::from_fn(|_| vec![0; n]),
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
    let mut counted = Counters::default();
    let counters = &mut counted;
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
            let part = Part { frame, rect, tile, slab, bricks: &inside };
            let Scratch { ints, floats, shorts, records, taps, units, shared } = scratch;
            let planes = (state, &mut out, &mut *counters);
            match frame.scene.quality.sums {
                Sums::F32 => {
                    simd.run(RenderPart { part, simd, ring: floats, buffers: taps, shared, planes })
                }
                Sums::I16 if frame.sections.most() < SLOTS && part.flat().is_some() => {
                    simd.run(RenderPart {
                        part,
                        simd,
                        ring: records,
                        buffers: units,
                        shared,
                        planes,
                    });
                }
                Sums::I16 => simd.run(RenderPart {
                    part,
                    simd,
                    ring: shorts,
                    buffers: units,
                    shared,
                    planes,
                }),
                Sums::I32 | Sums::Auto => {
                    simd.run(RenderPart { part, simd, ring: ints, buffers: taps, shared, planes });
                }
            }
        }
    }
    if out.last.as_ref().is_some_and(|l| l.iter().all(|s| *s == [0; 4])) {
        out.last = None;
    }
    (out, counted)
}

struct Part<'a> {
    frame: &'a Frame,
    rect: Rect,
    tile: Rect,
    slab: SheetRange,
    bricks: &'a [&'a PartBrick<'a>],
}

/// A part with what it works on: compiled for each instruction set as a whole.
struct RenderPart<'a, R: Ring> {
    part: Part<'a>,
    simd: Simd,
    ring: &'a mut R,
    buffers: &'a mut [Buffer<R>; 2],
    shared: &'a mut Shared,
    planes: (&'a TileState, &'a mut TilePixels, &'a mut Counters),
}

/// Memory for weights of one axis.
type Buffer<R> = Vec<<<R as Ring>::Sum as Accumulate>::Weight>;

impl<R: Ring> Work for RenderPart<'_, R> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        let RenderPart { part, simd, ring, buffers, shared, planes } = self;
        ring.reset(part.frame.sections.most() + 1, simd);
        part.render(ring, buffers, shared, planes);
    }
}

impl Part<'_> {
    /// Index in the tile's planes of the first pixel of the part's row `y`.
    fn tile_row(&self, y: usize) -> usize {
        (self.rect.y0 - self.tile.y0) as usize * self.tile.width()
            + y * self.tile.width()
            + (self.rect.x0 - self.tile.x0) as usize
    }

    #[inline(always)]
    fn render<R: Ring>(
        &self,
        ring: &mut R,
        buffers: &mut [Buffer<R>; 2],
        s: &mut Shared,
        (state, out, counters): (&TileState, &mut TilePixels, &mut Counters),
    ) {
        let mut open = self.begin(ring, s, state);
        let sheets = self.slab.len() as usize;
        if s.buckets.len() < sheets {
            s.buckets.resize_with(sheets, Vec::new);
        }
        for bucket in &mut s.buckets {
            bucket.clear();
        }
        s.carried.clear();

        let float_sums = self.frame.scene.float_sums();
        let flat = self.flat();
        let reach = flat.as_ref().map(|(_, reach)| *reach);
        if let Some(reach) = reach {
            open.grow(reach);
        }
        let mut next = 0;
        let mut any_open = open.count() > 0;
        for k in self.slab.first..self.slab.end {
            if !any_open {
                break;
            }
            while next < self.bricks.len() && self.bricks[next].projected.sheets.first <= k {
                if !self.admit(next, flat.as_ref(), &open, s, counters) {
                    let brick = self.bricks[next].brick;
                    counters.culled += brick.len() as u64;
                }
                next += 1;
            }
            if k == self.slab.first && !s.carried.is_empty() {
                // Voxels that begin before the slab come first, as they do without the cut.
                let mut carried = std::mem::take(&mut s.carried);
                if float_sums {
                    let sections = &self.frame.sections;
                    let id = |v: &Waiting| self.bricks[v.brick as usize].brick.id;
                    carried.sort_by_key(|v| (sections.first(v.z), id(v), v.voxel));
                }
                self.splat_all(&carried, k, ring, buffers, &open, counters);
                carried.clear();
                s.carried = carried;
            }
            let mut bucket = std::mem::take(&mut s.buckets[(k - self.slab.first) as usize]);
            if float_sums {
                bucket.sort_by_key(|v| (self.bricks[v.brick as usize].brick.id, v.voxel));
            }
            self.splat_all(&bucket, k, ring, buffers, &open, counters);
            bucket.clear();
            s.buckets[(k - self.slab.first) as usize] = bucket;
            if self.close(k, ring, &mut open, s) {
                any_open = open.count() > 0;
                if let Some(reach) = reach {
                    open.grow(reach);
                }
            }
            ring.clear(k - 1);
        }
        // Whatever the part did not come to is hidden.
        counters.culled += self.bricks[next..].iter().map(|b| b.brick.len() as u64).sum::<u64>();
        counters.culled += s.buckets.iter().map(|b| b.len() as u64).sum::<u64>();
        self.end(ring, s, &open, out);
    }

    /// Takes the part's pixels out of the tile's; returns which are open.
    fn begin<R: Ring>(&self, ring: &mut R, s: &mut Shared, state: &TileState) -> OpenMask {
        let (w, h) = (self.rect.width(), self.rect.height());
        let stride = PART as usize;
        let mut open = OpenMask::shut(self.rect);
        for plane in &mut s.colour {
            plane.fill(0);
        }
        for y in 0..h {
            let (row, to) = (self.tile_row(y), y * stride);
            s.a[to..to + w].copy_from_slice(&state.a[row..row + w]);
            for x in 0..w {
                let (px, py) = (self.rect.x0 + x as i32, self.rect.y0 + y as i32);
                s.secants[to + x] = self.frame.view.secant(px, py);
                if !self.frame.rule.is_shut(s.a[to + x]) {
                    open.open(x, y);
                }
            }
        }
        if let Some(last) = &state.last {
            for y in 0..h {
                let row = self.tile_row(y);
                for x in 0..w {
                    ring.put(self.slab.first - 1, y * stride + x, last[row + x]);
                }
            }
        }
        open
    }

    /// Puts the part's pixels into the tile's.
    fn end<R: Ring>(&self, ring: &R, s: &Shared, open: &OpenMask, out: &mut TilePixels) {
        let (w, h) = (self.rect.width(), self.rect.height());
        let stride = PART as usize;
        for y in 0..h {
            let (row, from) = (self.tile_row(y), y * stride);
            out.a[row..row + w].copy_from_slice(&s.a[from..from + w]);
            for x in 0..w {
                out.colour[row + x] = std::array::from_fn(|c| s.colour[c][from + x]);
            }
            if let Some(last) = &mut out.last {
                for x in 0..w {
                    // Nobody reads a shut pixel's sums; they may be anything, so they are none.
                    if open.row(y) >> x & 1 == 1 {
                        last[row + x] = ring.raw(self.slab.end - 1, from + x);
                    }
                }
            }
        }
    }

    /// Where a voxel's footprints lie, all sections together, a pixel more at most.
    #[inline(always)]
    fn extent(&self, eye: DVec3, z: i32) -> Option<Rect> {
        let (first, count) = self.frame.sections.span(z);
        let last = first + count as i32 - 1;
        let view = &self.frame.view;
        let at = |k: i32| {
            let f = self.frame.footprints.at(k)?;
            let [x, y] = view.screen(eye.x, eye.y, f.scale);
            let ((x0, x1), (y0, y1)) = (f.extent(0, x), f.extent(1, y));
            Some(Rect::new(x0, y0, x1, y1))
        };
        match view.projection {
            Projection::Ortho { .. } => at(first),
            Projection::Persp { .. } => {
                // Edges move one way with depth, so the first and last visible sections hold
                // the others. An end's rounding may put one a pixel farther out: grow by one.
                let front = (first..=last).find_map(at)?;
                let back = at(last)?;
                let r = front.union(&back);
                Some(Rect::new(r.x0 - 1, r.y0 - 1, r.x1 + 1, r.y1 + 1))
            }
        }
    }

    /// Tests a brick, then its voxels, and tosses what is left into buckets. Whether the brick
    /// passed.
    #[inline(always)]
    fn admit(
        &self,
        which: usize,
        flat: Option<&(Footprint<'_>, i32)>,
        open: &OpenMask,
        s: &mut Shared,
        counters: &mut Counters,
    ) -> bool {
        let PartBrick { brick, corner, projected } = self.bricks[which];
        let cull = self.frame.scene.quality.cull;
        if cull && !open.any(&projected.rect) {
            return false;
        }
        let view = &self.frame.view;
        let (sections, slab) = (&self.frame.sections, self.slab);
        for (voxel, &local) in brick.index.iter().enumerate() {
            let eye = self.frame.eye(*corner, local);
            let z = view.depth_in_phases(eye.z);
            let (first, count) = sections.span(z);
            if first >= slab.end || first + count as i32 <= slab.first {
                continue;
            }
            let (mut x, mut y) = (0, 0);
            if let Some((f, _)) = flat {
                let at = view.screen(eye.x, eye.y, f.scale);
                // Tables are of footprints of a thousand pixels at most, and this brick is near.
                [x, y] = at.map(|p| p as i32);
                let centre = [x, y].map(|p| p >> SUBPIXEL_BITS);
                let (cx, cy) = (centre[0] - self.rect.x0, centre[1] - self.rect.y0);
                if cull && !open.near(cx, cy) {
                    counters.culled += u64::from(open.reaches(cx, cy));
                    continue;
                }
                if !cull && !open.reaches(cx, cy) {
                    continue;
                }
            } else {
                let Some(extent) = self.extent(eye, z) else { continue };
                let inside = !extent.intersect(&self.rect).is_empty();
                if !inside || cull && !open.any(&extent) {
                    counters.culled += u64::from(inside);
                    continue;
                }
            }
            counters.tossed += 1;
            let waiting = Waiting { brick: which as u32, voxel: voxel as u16, z, x, y };
            if first < slab.first {
                s.carried.push(waiting);
            } else {
                s.buckets[(first - slab.first) as usize].push(waiting);
            }
        }
        true
    }

    /// The footprint that all sections of all voxels share, and its reach in pixels: orthographic
    /// views whose weights are in tables and that masks can be grown by.
    #[inline(always)]
    fn flat(&self) -> Option<(Footprint<'_>, i32)> {
        match self.frame.view.projection {
            Projection::Ortho { .. } => {
                let f = self.frame.footprints.at(0)?;
                let reach = f.reach().filter(|&r| r <= REACH_MOST)?;
                Some((f, reach))
            }
            Projection::Persp { .. } => None,
        }
    }

    #[inline(always)]
    fn splat_all<R: Ring>(
        &self,
        bucket: &[Waiting],
        k: i32,
        ring: &mut R,
        buffers: &mut [Buffer<R>; 2],
        open: &OpenMask,
        counters: &mut Counters,
    ) {
        let frame = self.frame;
        // The sheet behind the slab is filled as far as the colour rule peeks.
        let end = self.slab.end + i32::from(frame.looks_at_neighbours());
        let flat = self.flat();
        for v in bucket {
            let PartBrick { brick, corner, .. } = self.bricks[v.brick as usize];
            let eye = frame.eye(*corner, brick.index[v.voxel as usize]);
            if frame.scene.quality.cull {
                let extent = match &flat {
                    Some((f, _)) => {
                        let (x, y) = (f.extent(0, i64::from(v.x)), f.extent(1, i64::from(v.y)));
                        Some(Rect::new(x.0, y.0, x.1, y.1))
                    }
                    None => self.extent(eye, v.z),
                };
                if extent.is_none_or(|e| !open.any(&e)) {
                    counters.culled += 1;
                    continue;
                }
            }
            let payload = frame.payload(brick, v.voxel as usize, eye);
            if payload[0] <= 0.0 {
                continue;
            }
            counters.splatted += 1;
            let (first, count) = frame.sections.span(v.z);
            let sheets = first.max(k).max(self.slab.first)..(first + count as i32).min(end);
            if let Some((f, _)) = &flat {
                let at = [i64::from(v.x), i64::from(v.y)];
                if let Some(window) = self.window::<R::Sum>(f, at, buffers) {
                    ring.add_all(&frame.sections, v.z, sheets, window, &payload);
                }
            } else {
                for sheet in sheets {
                    let Some(f) = frame.footprints.at(sheet) else { continue };
                    let at = frame.view.screen(eye.x, eye.y, f.scale);
                    if let Some(window) = self.window::<R::Sum>(&f, at, buffers) {
                        let i = (sheet - first) as usize;
                        ring.add(sheet, window, R::Sum::section(&frame.sections, v.z, i, &payload));
                    }
                }
            }
        }
    }

    /// A footprint inside the part, or nothing.
    #[inline(always)]
    fn window<'b, S: Accumulate>(
        &self,
        f: &'b Footprint<'_>,
        [x, y]: [i64; 2],
        [bx, by]: &'b mut [Vec<S::Weight>; 2],
    ) -> Option<Window<'b, S::Weight>> {
        let (x0, wx) = S::Weight::of(f, 0, x, (self.rect.x0, self.rect.x1), bx);
        let (y0, wy) = S::Weight::of(f, 1, y, (self.rect.y0, self.rect.y1), by);
        let inside = !wx.is_empty() && !wy.is_empty();
        let at = |p: i32, origin: i32| (p - origin) as usize;
        inside.then(|| ((at(x0, self.rect.x0), wx), (at(y0, self.rect.y0), wy)))
    }

    /// Closes sheet `k` where it was touched; whether pixels were shut.
    #[inline(always)]
    fn close<R: Ring>(&self, k: i32, ring: &R, open: &mut OpenMask, s: &mut Shared) -> bool {
        let rule = self.frame.rule;
        let mut mask = ring.touched(k);
        let mut any_shut = false;
        let mut row = Row::default();
        while mask != 0 {
            let b = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            let (x0, y0) = (b % 8 * BLOCK, b / 8 * BLOCK);
            for y in y0..y0 + BLOCK {
                let live = open.row(y) >> x0 & 0xff;
                if live == 0 {
                    continue;
                }
                let at = y * PART as usize + x0;
                ring.load(k, at, &mut row);
                row.secant.copy_from_slice(&s.secants[at..at + BLOCK]);
                row.a.copy_from_slice(&s.a[at..at + BLOCK]);
                rule.close_row(&mut row);
                // Shut pixels keep what they have.
                let mut shut = 0u64;
                for i in 0..BLOCK {
                    let is_live = live >> i & 1 == 1;
                    let a = &mut s.a[at + i];
                    *a = if is_live { row.a[i] } else { *a };
                    shut |= u64::from(rule.is_shut(*a)) << i;
                }
                for (plane, light) in s.colour.iter_mut().zip(&row.light) {
                    for i in 0..BLOCK {
                        let add = if live >> i & 1 == 1 { light[i] } else { 0 };
                        plane[at + i] = plane[at + i].wrapping_add(add);
                    }
                }
                if shut & live != 0 {
                    open.close(y, (shut & live) << x0);
                    any_shut = true;
                }
            }
        }
        any_shut
    }
}

/// Planes as they are before the first slab.
pub fn blank(tile: Rect) -> TileState {
    TileState { a: vec![0.0; tile.area()], last: None::<Vec<RawSums>> }
}
