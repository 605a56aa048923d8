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
//!    is just what the colour rule wants to see ([`crate::kernels::composite`]).
//! 3. **Close** sheet k where it was touched: composite, shut pixels, take them out of the mask.
//!
//! A part is left as soon as all its pixels are shut. Bytes do not depend on any of this: sums
//! are integers (or floats in one order), an open pixel gets every voxel that covers it, and
//! what a shut pixel gets is never read.
//!
//! [`crate::region`] takes a tile through all sheets of a frame while bricks are still arriving: a
//! part then stops before the first sheet with a missing brick, and goes on from there later.
//!
//! Views have geometries ([`crate::geometry`]): `ortho` is far faster and for whole-number sums in
//! orthographic views of cubic lattices, `general` is for every view and every kind of sums, and
//! `field` for planes of a field. `Part::draw` picks the fastest that takes the view.

use crate::geometry::field::{self, RenderField, RenderFieldApart};
use crate::geometry::general::{self, GeneralScratch, Kind, Queues, RenderGeneralField};
use crate::geometry::open_sheets::{self, Store};
use crate::geometry::ortho::{self, RenderOrtho};
use crate::kernels::Simd;
use crate::kernels::field::FieldSum;
use crate::kernels::pixel_records::MOST;
pub use crate::part::ProjectedBrick;
use crate::part::brick_feed::FeedMemory;
use crate::part::{BrickSource, Io, Part, Pixels};
use crate::primitives::sizes::PART;
use crate::primitives::work_counters::WorkCounters;
use crate::scene::{Frame, Scene};
use slabcast_common::brick::Brick;
use slabcast_common::image::{RawSums, TilePixels, TileState};
use slabcast_common::message::Counters;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Sums;
use slabcast_common::slab::SheetRange;
use std::sync::Arc;

/// Memory that a render thread keeps from tile to tile, so that drawing allocates nothing. It holds
/// no state: any scratch will do for any tile.
#[derive(Default)]
pub struct Scratch {
    general: GeneralScratch,
    /// Memory of the fast geometries for 16-bit sums.
    #[doc(hidden)]
    pub shorts: Store<i16>,
    /// Memory of the fast geometries for 32-bit sums.
    #[doc(hidden)]
    pub longs: Store<i32>,
    waiting: Waiting,
    pixels: Pixels,
    /// Indices of the tile's bricks over the part at hand.
    inside: Vec<u32>,
    pub(crate) feed: FeedMemory,
    /// Spare plane for the sums of a last sheet.
    last: Vec<RawSums>,
}

impl Scratch {
    /// Has the sheets of each pixel of the tiles drawn from now on counted in `work`, which has a tile's
    /// size, or no longer. Returns what was counted before.
    pub(crate) fn count_work(&mut self, work: Option<WorkCounters>) -> Option<WorkCounters> {
        std::mem::replace(&mut self.pixels.work, work)
    }
}

/// Memory for voxels that wait for their sheets.
#[derive(Default)]
struct Waiting {
    flat: ortho::Waiting,
    apart: open_sheets::Queues<field::Apart>,
}

/// Renders the sheets of `slab` on `tile` and returns the tile's pixels and the voxels splatted and
/// culled.
///
/// `state` has the tile's opacities in front of the slab. `bricks` are at least all bricks that the
/// tile and slab need, in any order. The result has the opacities behind the slab, the light that
/// the slab adds (linear, premultiplied, fixed point) and, for the linear colour rule, the raw sums
/// of its last sheet.
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
    let projected: Vec<ProjectedBrick> =
        bricks.iter().filter_map(|b| ProjectedBrick::new(frame, b)).collect();
    let sorted = ProjectedBrick::front_to_back(&projected);
    render_projected(frame, simd, tile, slab, &sorted, state, scratch)
}

/// Renders as [`render`] does, from bricks that are projected and sorted
/// [front to back](ProjectedBrick::front_to_back).
///
/// # Panics
/// If the planes of `state` do not have the tile's size.
pub fn render_projected(
    frame: &Frame,
    simd: Simd,
    tile: Rect,
    slab: SheetRange,
    bricks: &[&ProjectedBrick],
    state: &TileState,
    scratch: &mut Scratch,
) -> (TilePixels, Counters) {
    let mut out = TilePixels::default();
    let counted = render_into(frame, simd, tile, slab, bricks, state, scratch, &mut out);
    (out, counted)
}

/// Renders as [`render_projected`] does, into `out`, whose memory is reused: once `scratch` and
/// `out` have grown to a frame's largest tile, drawing allocates nothing (`tests/allocations.rs`).
/// Returns the voxels splatted and culled.
///
/// # Panics
/// If the planes of `state` do not have the tile's size.
pub fn render_into(
    frame: &Frame,
    simd: Simd,
    tile: Rect,
    slab: SheetRange,
    bricks: &[&ProjectedBrick],
    state: &TileState,
    scratch: &mut Scratch,
    out: &mut TilePixels,
) -> Counters {
    assert_eq!(state.a.len(), tile.area(), "one opacity a pixel");
    out.a.clear();
    out.a.extend_from_slice(&state.a);
    out.colour.clear();
    out.colour.resize(tile.area(), [0; 3]);
    if let Some(last) = out.last.take() {
        scratch.last = last;
    }
    if frame.looks_at_neighbours() {
        let mut last = std::mem::take(&mut scratch.last);
        last.clear();
        last.extend_from_slice(state.last.as_deref().unwrap_or_default());
        last.resize(tile.area(), [0; 4]);
        out.last = Some(last);
    }
    let mut counted = Counters::default();
    let counters = &mut counted;
    let mut inside = std::mem::take(&mut scratch.inside);
    for y0 in (tile.y0..tile.y1).step_by(PART as usize) {
        for x0 in (tile.x0..tile.x1).step_by(PART as usize) {
            let rect = Rect::new(x0, y0, x0 + PART, y0 + PART).intersect(&tile);
            inside.clear();
            for (i, b) in bricks.iter().enumerate() {
                let p = &b.projected;
                if p.sheets.overlaps(slab) && !p.rect.intersect(&rect).is_empty() {
                    inside.push(i as u32);
                }
            }
            let bricks = BrickSource::Here(bricks);
            let part = Part { frame, rect, tile, slab, bricks, inside: &inside };
            if inside.is_empty() {
                // The slab's last sheet is empty here.
                if let Some(last) = &mut out.last {
                    part.each_pixel(|_, _, tile| last[tile] = [0; 4]);
                }
                continue;
            }
            part.draw(simd, scratch, (&mut *out, &mut *counters));
        }
    }
    scratch.inside = inside;
    if let Some(last) = out.last.take_if(|l| l.iter().all(|s| *s == [0; 4])) {
        scratch.last = last;
    }
    counted
}

/// Pixels and bytes that every voxel of a frame adds to: the memory traffic of splatting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FootprintCost {
    /// Width and height of a footprint in pixels.
    pub pixels: [usize; 2],
    /// Bytes of sums of one pixel in all sheets that a voxel touches; each is read and written.
    pub bytes: usize,
}

impl Frame {
    /// Returns what each voxel adds to, where that is the same for all voxels: in orthographic
    /// views with whole-number sums whose kernel does not lean.
    pub fn footprint_cost(&self) -> Option<FootprintCost> {
        let Scene { quality, ref classifier, .. } = *self.scene;
        let most = self.sections.most();
        let channel = match quality.sums {
            Sums::F32 => return None,
            Sums::I16 => size_of::<i16>(),
            Sums::I32 | Sums::Auto => size_of::<i32>(),
        };
        if ortho::accepts(self).is_none() || classifier.is_modulated() || most > MOST {
            return None;
        }
        let footprint = self.footprints.at(0)?;
        let [across, down] = [0, 1].map(|axis| footprint.phases(axis).map(|phases| phases.len));
        Some(FootprintCost {
            pixels: [across?, down?],
            bytes: 4 * channel * if most <= 4 { 4 } else { MOST },
        })
    }
}

impl Part<'_> {
    /// Draws the part with the fastest geometry that takes its view.
    pub(crate) fn draw(self, simd: Simd, scratch: &mut Scratch, io: Io<'_>) {
        let Scratch { general, shorts, longs, waiting, pixels, .. } = scratch;
        let GeneralScratch { kinds, queues } = general;
        match self.frame.scene.quality.sums {
            Sums::F32 if !self.frame.is_field() => {
                general::render(&self, &mut kinds.floats, queues, pixels, io);
            }
            Sums::I16 => {
                self.draw_whole(simd, shorts, waiting, (&mut kinds.shorts, queues), pixels, io);
            }
            _ => self.draw_whole(simd, longs, waiting, (&mut kinds.longs, queues), pixels, io),
        }
    }

    /// Draws the part in whole-number sums.
    fn draw_whole<S: FieldSum>(
        self,
        simd: Simd,
        store: &mut Store<S>,
        Waiting { flat: waiting, apart: queues_apart }: &mut Waiting,
        (kind, queues): (&mut Kind<S>, &mut Queues),
        pixels: &mut Pixels,
        io: Io<'_>,
    ) {
        let part = self;
        let (frame, most) = (part.frame, part.frame.sections.most());
        // Waiting voxels carry samples and normals; opacity by gradient needs the brick, which the
        // general geometry looks into.
        let modulated = frame.scene.classifier.is_modulated();
        match ortho::accepts(frame).filter(|_| most <= MOST) {
            Some(view) if frame.is_field() && most <= 4 => {
                simd.run(RenderField::<S, 4> { part, view, store, waiting, pixels, io });
            }
            Some(view) if frame.is_field() => {
                simd.run(RenderField::<S, MOST> { part, view, store, waiting, pixels, io });
            }
            None if frame.is_field() && field::accepts_apart(frame) => {
                let queues = queues_apart;
                if most <= 4 {
                    simd.run(RenderFieldApart::<S, 4> { part, store, queues, pixels, io });
                } else {
                    simd.run(RenderFieldApart::<S, MOST> { part, store, queues, pixels, io });
                }
            }
            None if frame.is_field() => {
                simd.run(RenderGeneralField { part, kind, queues, pixels, io });
            }
            Some(view) if most <= 4 && !modulated => {
                simd.run(RenderOrtho::<S, 4> { part, view, store, waiting, pixels, io });
            }
            Some(view) if !modulated => {
                simd.run(RenderOrtho::<S, MOST> { part, view, store, waiting, pixels, io });
            }
            _ => general::render(&part, kind, queues, pixels, io),
        }
    }
}

/// Returns the state of `tile` in front of the first slab: all opacities zero.
pub fn blank(tile: Rect) -> TileState {
    TileState { a: vec![0.0; tile.area()], last: None::<Vec<RawSums>> }
}
