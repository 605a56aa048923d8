//! A part of a tile, at most 64x64 pixels: its bricks, its pixels, and the way between both and the
//! tile's planes. Every geometry draws parts.

pub mod brick_feed;

use crate::kernels::pixel_records::STRIDE;
use crate::primitives::sizes::PART;
use crate::scene::{Corner, Frame};
use crate::visibility::open_mask::OpenMask;
use brick_feed::Coming;
use slabcast_common::brick::Brick;
use slabcast_common::image::{RawSums, TilePixels};
use slabcast_common::message::Counters;
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projected, Projection};
use std::sync::Arc;

/// A brick as a frame sees it: what all tiles ask of it, worked out once.
#[derive(Clone, Debug)]
pub struct ProjectedBrick {
    /// The brick.
    pub brick: Arc<Brick>,
    /// Where its voxels may land.
    pub projected: Projected,
    pub(crate) corner: Corner,
}

impl ProjectedBrick {
    /// `brick` in `frame`; `None` if it is off the picture or behind the near plane.
    pub fn new(frame: &Frame, brick: &Arc<Brick>) -> Option<ProjectedBrick> {
        let projected = frame.view.project(&brick.tight_box(&frame.scene.grid))?;
        Some(ProjectedBrick { brick: brick.clone(), projected, corner: frame.corner(brick.id) })
    }

    /// `seen` front to back; those that begin together in ascending id.
    pub fn front_to_back(seen: &[ProjectedBrick]) -> Vec<&ProjectedBrick> {
        // Numbers and places are sorted, not bricks: a third of the time.
        let key = |s: &ProjectedBrick| (s.projected.sheets.first, s.brick.id);
        let mut order: Vec<_> = seen.iter().enumerate().map(|(i, s)| (key(s), i as u32)).collect();
        order.sort_unstable();
        order.into_iter().map(|(_, i)| &seen[i as usize]).collect()
    }
}

/// The tile's pixels, from which a part starts and which it takes farther, and what it counts.
pub type Io<'a> = (&'a mut TilePixels, &'a mut Counters);

/// Where a part's bricks are.
#[derive(Clone, Copy)]
pub enum Among<'a> {
    /// All of the tile's are here.
    Here(&'a [&'a ProjectedBrick]),
    /// They come when they are looked at, if they can be had.
    Coming(&'a Coming<'a>),
}

/// A part of a tile.
pub struct Part<'a> {
    pub(crate) frame: &'a Frame,
    pub(crate) rect: Rect,
    pub(crate) tile: Rect,
    pub(crate) slab: SheetRange,
    pub(crate) among: Among<'a>,
    /// Those of the part that are here, front to back.
    pub(crate) inside: &'a [u32],
}

/// A part's pixels, in rows of [`STRIDE`] whatever the part's width.
pub struct Pixels {
    /// Lengths of rays in a sheet over its thickness.
    pub(crate) secants: Vec<f32>,
    /// The bits of each one's opacity, and three colours.
    pub(crate) all: Vec<[u32; 4]>,
}

impl Default for Pixels {
    fn default() -> Self {
        let n = STRIDE * PART as usize;
        Pixels { secants: vec![1.0; n], all: vec![[0; 4]; n] }
    }
}

impl Part<'_> {
    /// The first sheet that any of its bricks begins at; `None`: it has none.
    pub(crate) fn nearest(&self) -> Option<i32> {
        match self.among {
            Among::Here(_) => (!self.inside.is_empty()).then(|| self.first_sheet(0)),
            Among::Coming(coming) => coming.nearest(),
        }
    }

    /// The first sheet of brick `i` of the part, front to back.
    #[inline(always)]
    pub(crate) fn first_sheet(&self, i: usize) -> i32 {
        match self.among {
            Among::Here(bricks) => bricks[self.inside[i] as usize].projected.sheets.first,
            Among::Coming(coming) => coming.first_sheet(i),
        }
    }

    /// Whether there is a brick `i` of the part that begins at sheet `k` or before. Of those that come,
    /// there are the ones that [came](Part::is_supplied).
    #[inline(always)]
    pub(crate) fn begins(&self, i: usize, k: i32) -> bool {
        match self.among {
            Among::Here(_) => i < self.inside.len() && self.first_sheet(i) <= k,
            Among::Coming(coming) => i < coming.came(),
        }
    }

    /// Brick `i` of the part with its corner. It was [admitted](Part::open_brick).
    #[inline(always)]
    pub(crate) fn brick(&self, i: usize) -> (&Brick, &Corner) {
        match self.among {
            Among::Here(bricks) => {
                let ProjectedBrick { brick, corner, .. } = bricks[self.inside[i] as usize];
                (brick, corner)
            }
            Among::Coming(coming) => coming.brick(i),
        }
    }

    /// Brick `i` of the part, if it is known already.
    #[inline(always)]
    pub(crate) fn peek(&self, i: usize) -> Option<&Brick> {
        match self.among {
            Among::Here(bricks) => Some(&bricks[*self.inside.get(i)? as usize].brick),
            Among::Coming(coming) => (i < coming.came()).then(|| coming.brick(i).0),
        }
    }

    /// Whether sheet `k`, the one behind the last that this was asked of, can be drawn: all bricks that
    /// begin there and may touch an open pixel are here. If not, what is lacked is noted.
    #[inline(always)]
    pub(crate) fn is_supplied(&self, k: i32, open: &OpenMask, counters: &mut Counters) -> bool {
        match self.among {
            Among::Here(_) => true,
            Among::Coming(coming) => coming.is_supplied(k, open, counters),
        }
    }

    /// The part's brick `i`, unless it is culled: all that it may touch is shut.
    #[inline(always)]
    pub(crate) fn open_brick(
        &self,
        i: usize,
        open: &OpenMask,
        counters: &mut Counters,
    ) -> Option<(&Brick, &Corner)> {
        // Of one that came the question was asked when it was looked for.
        if let Among::Here(bricks) = self.among {
            let seen = bricks[self.inside[i] as usize];
            if self.frame.scene.quality.cull && !open.any(&seen.projected.rect) {
                counters.culled += seen.brick.len() as u64;
                return None;
            }
        }
        Some(self.brick(i))
    }

    /// Voxels of the bricks from `i` on; where they come one by one, of those that did not.
    pub(crate) fn voxels_from(&self, i: usize) -> u64 {
        match self.among {
            Among::Here(bricks) => {
                let left = self.inside[i..].iter();
                left.map(|&at| bricks[at as usize].brick.len() as u64).sum()
            }
            Among::Coming(coming) => coming.voxels_left(),
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

    /// Takes the part's pixels out of the tile's; returns which are open.
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

    /// Puts the part's pixels into the tile's.
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

/// Takes the sums of a part's last sheet to where the next sheet's drawing finds them.
///
/// Where a part stops before its slab does, they are wanted though nobody asked for them at first.
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
