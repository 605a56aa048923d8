//! A part of a tile, at most 64x64 pixels: its bricks, its pixels, and how both come from the tile
//! and go back to it. Every geometry draws parts.

pub mod brick_feed;

use crate::kernels::composite::Row;
use crate::kernels::pixel_records::STRIDE;
use crate::kernels::touched::column_and_row;
use crate::primitives::sizes::PART;
use crate::primitives::work_counters::WorkCounters;
use crate::scene::{Corner, Frame};
use crate::visibility::open_mask::OpenMask;
use brick_feed::ArrivingBricks;
use slabcast_common::brick::Brick;
use slabcast_common::image::{RawSums, TilePixels};
use slabcast_common::message::Counters;
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projected, Projection};
use std::sync::Arc;

/// A brick projected into a frame, once for all tiles.
#[derive(Clone, Debug)]
pub struct ProjectedBrick {
    /// Brick with the voxels to draw.
    pub brick: Arc<Brick>,
    /// Rectangle of pixels and run of sheets that the brick's voxels may touch.
    pub projected: Projected,
    pub(crate) corner: Corner,
}

impl ProjectedBrick {
    /// Projects `brick` into `frame`; `None` if it is off the picture or in front of the near
    /// plane.
    pub fn new(frame: &Frame, brick: &Arc<Brick>) -> Option<ProjectedBrick> {
        let projected = frame.view.project(&brick.tight_box(&frame.scene.grid))?;
        Some(ProjectedBrick { brick: brick.clone(), projected, corner: frame.corner(brick.id) })
    }

    /// Returns `bricks` front to back by first sheet; those that begin at the same sheet in
    /// ascending id.
    pub fn front_to_back(bricks: &[ProjectedBrick]) -> Vec<&ProjectedBrick> {
        // Sorting keys and indices takes a third of the time of sorting bricks.
        let key = |b: &ProjectedBrick| (b.projected.sheets.first, b.brick.id);
        let mut order: Vec<_> =
            bricks.iter().enumerate().map(|(i, b)| (key(b), i as u32)).collect();
        order.sort_unstable();
        order.into_iter().map(|(_, i)| &bricks[i as usize]).collect()
    }
}

/// The pixels of the tile that a part belongs to, read and written, and its voxel counts.
pub type Io<'a> = (&'a mut TilePixels, &'a mut Counters);

/// Source that a part's bricks are drawn from.
#[derive(Clone, Copy)]
pub enum BrickSource<'a> {
    /// All bricks of the tile are held.
    Here(&'a [&'a ProjectedBrick]),
    /// Bricks are taken from a supply when the part comes to their first sheets.
    Arriving(&'a ArrivingBricks<'a>),
}

/// A part of a tile, with the sheets to draw and the bricks to draw them from.
pub struct Part<'a> {
    pub(crate) frame: &'a Frame,
    pub(crate) rect: Rect,
    pub(crate) tile: Rect,
    pub(crate) slab: SheetRange,
    pub(crate) bricks: BrickSource<'a>,
    /// Indices of the bricks of [`BrickSource::Here`] that lie over the part, front to back.
    pub(crate) inside: &'a [u32],
}

/// A part's pixels, in rows of [`STRIDE`] whatever the part's width.
pub struct Pixels {
    /// Length of each pixel's ray within a sheet over the sheet's thickness.
    pub(crate) secants: Vec<f32>,
    /// Bits of each pixel's opacity (f32), then its three colours in fixed point.
    pub(crate) all: Vec<[u32; 4]>,
    /// Counts of the tile's pixels, where somebody asks for them.
    pub(crate) work: Option<WorkCounters>,
}

impl Default for Pixels {
    fn default() -> Self {
        let n = STRIDE * PART as usize;
        Pixels { secants: vec![1.0; n], all: vec![[0; 4]; n], work: None }
    }
}

impl Part<'_> {
    /// The first sheet of brick `i` of the part, front to back.
    #[inline(always)]
    pub(crate) fn first_sheet(&self, i: usize) -> i32 {
        match self.bricks {
            BrickSource::Here(bricks) => bricks[self.inside[i] as usize].projected.sheets.first,
            BrickSource::Arriving(arriving) => arriving.first_sheet(i),
        }
    }

    /// Whether the part has a brick `i` that begins at sheet `k` or before. Arriving bricks count
    /// once they were [supplied](Part::is_supplied).
    #[inline(always)]
    pub(crate) fn begins(&self, i: usize, k: i32) -> bool {
        match self.bricks {
            BrickSource::Here(_) => i < self.inside.len() && self.first_sheet(i) <= k,
            BrickSource::Arriving(arriving) => i < arriving.taken_count(),
        }
    }

    /// Brick `i` of the part with its corner, after [`Part::open_brick`] returned it.
    #[inline(always)]
    pub(crate) fn brick(&self, i: usize) -> (&Brick, &Corner) {
        match self.bricks {
            BrickSource::Here(bricks) => {
                let ProjectedBrick { brick, corner, .. } = bricks[self.inside[i] as usize];
                (brick, corner)
            }
            BrickSource::Arriving(arriving) => arriving.brick(i),
        }
    }

    /// Brick `i` of the part, if there is one yet: to prefetch its memory.
    #[inline(always)]
    pub(crate) fn peek(&self, i: usize) -> Option<&Brick> {
        match self.bricks {
            BrickSource::Here(bricks) => Some(&bricks[*self.inside.get(i)? as usize].brick),
            BrickSource::Arriving(arriving) => {
                (i < arriving.taken_count()).then(|| arriving.brick(i).0)
            }
        }
    }

    /// Whether sheet `k` can be drawn: all bricks that begin there and may touch an open pixel are
    /// held. If not, the missing ones are noted. `k` rises by one from call to call.
    #[inline(always)]
    pub(crate) fn is_supplied(&self, k: i32, open: &OpenMask, counters: &mut Counters) -> bool {
        match self.bricks {
            BrickSource::Here(_) => true,
            BrickSource::Arriving(arriving) => arriving.is_supplied(k, open, counters),
        }
    }

    /// Brick `i` of the part; `None` if it is culled, since all pixels that it may touch are shut.
    #[inline(always)]
    pub(crate) fn open_brick(
        &self,
        i: usize,
        open: &OpenMask,
        counters: &mut Counters,
    ) -> Option<(&Brick, &Corner)> {
        // An arriving brick was tested when it was taken.
        if let BrickSource::Here(bricks) = self.bricks {
            let here = bricks[self.inside[i] as usize];
            if self.frame.scene.quality.cull && !open.any(&here.projected.rect) {
                counters.culled += here.brick.len() as u64;
                return None;
            }
        }
        Some(self.brick(i))
    }

    /// Voxels of the bricks from `i` on; of arriving bricks, of those that were not taken.
    pub(crate) fn voxels_from(&self, i: usize) -> u64 {
        match self.bricks {
            BrickSource::Here(bricks) => {
                let left = self.inside[i..].iter();
                left.map(|&at| bricks[at as usize].brick.len() as u64).sum()
            }
            BrickSource::Arriving(arriving) => arriving.voxels_left(),
        }
    }

    /// Index in the tile's planes of the first pixel of the part's row `y`.
    fn tile_row(&self, y: usize) -> usize {
        (self.rect.y0 - self.tile.y0) as usize * self.tile.width()
            + y * self.tile.width()
            + (self.rect.x0 - self.tile.x0) as usize
    }

    /// Calls `f` with each pixel's column and row in the part and index in the tile.
    pub(crate) fn each_pixel(&self, mut f: impl FnMut(usize, usize, usize)) {
        for y in 0..self.rect.height() {
            let row = self.tile_row(y);
            for x in 0..self.rect.width() {
                f(x, y, row + x);
            }
        }
    }

    /// Counts sheet `k` at the pixels of a row that was closed, given by their places in the part,
    /// as one that was read where it held something. A bit each: those that were open, and those
    /// that are shut now.
    #[cold]
    pub(crate) fn count_sheet(
        &self,
        work: &mut WorkCounters,
        k: i32,
        (row, places): (&Row, &[u32]),
        [open, shut]: [u32; 2],
    ) {
        for (lane, &place) in places.iter().enumerate() {
            // Sections have extinctions, which are no less than zero.
            if open >> lane & 1 == 1 && row.here[0][lane] != 0.0 {
                let [x, y] = column_and_row(place);
                work.add_sheet(self.tile_row(y) + x, k, shut >> lane & 1 == 1);
            }
        }
    }

    /// Loads the part's pixels from the tile's planes; returns which are open.
    pub(crate) fn begin(&self, pixels: &mut Pixels, tile: &TilePixels) -> OpenMask {
        let (w, h) = (self.rect.width(), self.rect.height());
        let mut open = OpenMask::shut(self.rect);
        for y in 0..h {
            let (row, to) = (self.tile_row(y), y * STRIDE);
            let mut bits = 0u64;
            let all = &mut pixels.all[to..to + w];
            for (x, (pixel, a)) in all.iter_mut().zip(&tile.a[row..row + w]).enumerate() {
                *pixel = [a.to_bits(), 0, 0, 0];
                bits |= u64::from(!self.frame.rule.is_shut(*a)) << x;
            }
            open.open_row(y, bits);
            let view = &self.frame.view;
            let (px, py) = (self.rect.x0, self.rect.y0 + y as i32);
            let secants = &mut pixels.secants[to..to + w];
            match view.projection {
                Projection::Ortho { .. } => secants.fill(1.0),
                Projection::Persp { .. } => {
                    for (x, secant) in secants.iter_mut().enumerate() {
                        *secant = view.secant(px + x as i32, py);
                    }
                }
            }
        }
        open
    }

    /// Stores the part's pixels into the tile's planes.
    pub(crate) fn end(&self, pixels: &Pixels, out: &mut TilePixels) {
        let (w, h) = (self.rect.width(), self.rect.height());
        for y in 0..h {
            let (row, from) = (self.tile_row(y), y * STRIDE);
            let (a, colour) = (&mut out.a[row..row + w], &mut out.colour[row..row + w]);
            for (pixel, (a, colour)) in
                pixels.all[from..from + w].iter().zip(a.iter_mut().zip(colour))
            {
                let [opacity, r, g, b] = *pixel;
                *a = f32::from_bits(opacity);
                for (sum, more) in colour.iter_mut().zip([r, g, b]) {
                    *sum = sum.wrapping_add(more);
                }
            }
        }
    }
}

/// Returns the tile's plane for the sums of the last sheet, if the next slab needs them. A part
/// that stopped before its slab's end makes one.
pub fn keep_last<'a>(
    part: &Part<'_>,
    stopped: bool,
    out: &'a mut TilePixels,
) -> Option<&'a mut Vec<RawSums>> {
    if stopped && out.last.is_none() && part.frame.looks_at_neighbours() {
        out.last = Some(vec![[0; 4]; out.a.len()]);
    }
    out.last.as_mut()
}
