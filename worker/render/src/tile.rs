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
//! Each kind of view has its geometry ([`crate::geometry`]): `general` for every view and every
//! kind of sums; far faster, for whole-number sums, `ortho` for most orthographic views, `sheared`
//! for those whose kernel leans, `perspective` for most perspective views, and `shared_rows` for
//! views with a level camera. `Part::draw` picks the fastest that takes the view.

use crate::geometry::field::{self, RenderField, RenderFieldApart};
use crate::geometry::general::{GeneralScratch, Kind, Queues, RenderGeneral, RenderGeneralField};
use crate::geometry::open_sheets::{self, Store};
use crate::geometry::ortho::{self, RenderOrtho};
use crate::geometry::perspective::{self, Deep, RenderPerspective, RenderPerspectiveSharedRows};
use crate::geometry::shared_rows::{self, RenderSharedRows};
use crate::geometry::sheared::{self, RenderSheared};
use crate::kernels::field::FieldSum;
use crate::kernels::pixel_records::MOST;
use crate::kernels::row_records::Tiered;
use crate::kernels::{Grey, Simd};
pub use crate::part::ProjectedBrick;
use crate::part::brick_feed::FeedMemory;
use crate::part::{BrickSource, Io, Part, Pixels};
use crate::primitives::lattice_rows::LatticeRows;
use crate::primitives::sizes::PART;
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
    /// Memory of the fast geometries, for each number type of sums.
    #[doc(hidden)]
    pub whole: Whole,
    pixels: Pixels,
    /// Indices of the tile's bricks over the part at hand.
    inside: Vec<u32>,
    pub(crate) feed: FeedMemory,
    /// Spare plane for the sums of a last sheet.
    last: Vec<RawSums>,
}

/// Memory of the fast geometries, for each number type of sums.
#[doc(hidden)]
#[derive(Default)]
pub struct Whole {
    /// Memory for 16-bit sums in colour.
    pub shorts: Store<i16>,
    /// Memory for 32-bit sums in colour.
    pub longs: Store<i32>,
    /// Memory for 32-bit sums of scenes whose three colours are one.
    pub greys: Store<Grey>,
    waiting: Waiting,
}

/// Memory for voxels that wait for their sheets.
#[derive(Default)]
struct Waiting {
    flat: ortho::Waiting,
    leaning: sheared::Waiting,
    deep: perspective::Waiting,
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
    /// Width and height of a footprint in pixels; the height is 1 where lattice rows are shared.
    pub pixels: [usize; 2],
    /// Bytes of sums of one pixel in all sheets that a voxel touches; each is read and written.
    pub bytes: usize,
}

impl Frame {
    /// Returns what each voxel adds to, where that is the same for all voxels: in orthographic
    /// views with whole-number sums whose kernel does not lean.
    pub fn footprint_cost(&self) -> Option<FootprintCost> {
        let Scene { quality, ref classifier, .. } = *self.scene;
        let channel = match quality.sums {
            Sums::F32 => return None,
            Sums::I16 => size_of::<i16>(),
            Sums::I32 | Sums::Auto => size_of::<i32>(),
        };
        let most = self.sections.most();
        if ortho::accepts(self).is_none() || classifier.is_modulated() || most > MOST {
            return None;
        }
        let footprint = self.footprints.at(0)?;
        let [across, down] = [0, 1].map(|axis| footprint.phases(axis).map(|phases| phases.len));
        // In a level view to the row of its lattice row alone.
        let down = if self.lattice_rows.is_some() { Some(1) } else { down };
        let channels = if self.has_two_channels() { 2 } else { 4 };
        let sheets = if most <= 4 { 4 } else { MOST };
        Some(FootprintCost { pixels: [across?, down?], bytes: channel * channels * sheets })
    }

    /// Returns whether the frame is drawn with two channels, opacity and grey, instead of four.
    /// This halves the work, and gives the same pixels, where all that shows is grey.
    pub fn has_two_channels(&self) -> bool {
        self.may_have_two_channels() && ortho::accepts(self).is_some()
    }

    /// Whether 32-bit sums of the frame need two channels alone.
    fn may_have_two_channels(&self) -> bool {
        let Scene { grey, quality, ref classifier, .. } = *self.scene;
        let fits = !classifier.is_modulated() && self.sections.most() <= MOST;
        grey && fits && matches!(quality.sums, Sums::I32 | Sums::Auto)
    }
}

impl<'a> Part<'a> {
    /// Draws the part with the fastest geometry that takes its view.
    pub(crate) fn draw(self, simd: Simd, scratch: &mut Scratch, io: Io<'_>) {
        let part = self;
        let Scratch { general, whole, pixels, .. } = scratch;
        let GeneralScratch { kinds, queues } = general;
        if part.frame.is_field() {
            let Whole { shorts, longs, waiting, .. } = whole;
            match part.frame.scene.quality.sums {
                Sums::I16 => {
                    let kind = (&mut kinds.shorts, queues);
                    part.render_field(simd, shorts, waiting, kind, pixels, io);
                }
                _ => {
                    let kind = (&mut kinds.longs, queues);
                    part.render_field(simd, longs, waiting, kind, pixels, io);
                }
            }
            return;
        }
        match part.frame.scene.quality.sums {
            Sums::F32 => {
                let kind = &mut kinds.floats;
                simd.run(RenderGeneral { part, kind, queues, pixels, io });
            }
            Sums::I16 => {
                let (store, waiting) = (&mut whole.shorts, &mut whole.waiting);
                part.render(simd, store, waiting, (&mut kinds.shorts, queues), pixels, io);
            }
            Sums::I32 | Sums::Auto if part.frame.has_two_channels() => {
                let Whole { greys: store, waiting, .. } = whole;
                part.render_grey(simd, store, &mut waiting.flat, pixels, io);
            }
            Sums::I32 | Sums::Auto => {
                if let Some((deep, lattice_rows)) = part.deep_grey() {
                    let (store, waiting) = (&mut whole.greys, &mut whole.waiting.deep);
                    let deep =
                        RenderPerspective::<Grey, 4> { part, deep, store, waiting, pixels, io };
                    return simd.run(RenderPerspectiveSharedRows { deep, lattice_rows });
                }
                let (store, waiting) = (&mut whole.longs, &mut whole.waiting);
                part.render(simd, store, waiting, (&mut kinds.longs, queues), pixels, io);
            }
        }
    }

    /// Draws the part of a frame whose sheets hold planes of a field.
    fn render_field<S: FieldSum>(
        self,
        simd: Simd,
        store: &mut Store<S>,
        waiting: &mut Waiting,
        (kind, queues): (&mut Kind<S>, &mut Queues),
        pixels: &mut Pixels,
        io: Io<'_>,
    ) {
        let part = self;
        let Waiting { flat: waiting, apart, .. } = waiting;
        match (field::accepts(part.frame), part.frame.sections.most()) {
            (Some(view), 0..=4) => {
                simd.run(RenderField::<S, 4> { part, view, store, waiting, pixels, io });
            }
            (Some(view), _) => {
                simd.run(RenderField::<S, MOST> { part, view, store, waiting, pixels, io });
            }
            (None, most) if field::accepts_apart(part.frame) => {
                let queues = apart;
                if most <= 4 {
                    simd.run(RenderFieldApart::<S, 4> { part, store, queues, pixels, io });
                } else {
                    simd.run(RenderFieldApart::<S, MOST> { part, store, queues, pixels, io });
                }
            }
            (None, _) => simd.run(RenderGeneralField { part, kind, queues, pixels, io }),
        }
    }

    /// The perspective view, if it is drawn in two channels: where the camera is level and voxels
    /// have four sheets. Every further kind takes the compiler seconds, and where the camera is not
    /// level records would be added to one by one.
    fn deep_grey(&self) -> Option<(Deep, &'a LatticeRows)> {
        let lattice_rows = self.frame.lattice_rows.as_ref()?;
        let may = self.frame.may_have_two_channels() && self.frame.sections.most() <= 4;
        Some((perspective::accepts(self).filter(|_| may)?, lattice_rows))
    }

    /// Draws the part of a frame that [has two channels](Frame::has_two_channels).
    fn render_grey(
        self,
        simd: Simd,
        store: &mut Store<Grey>,
        waiting: &mut ortho::Waiting,
        pixels: &mut Pixels,
        io: Io<'_>,
    ) {
        let part = self;
        if let Some(view) = shared_rows::accepts(part.frame) {
            if part.frame.sections.most() <= 4 {
                simd.run(RenderSharedRows::<Grey, 4> { part, view, store, waiting, pixels, io });
            } else {
                simd.run(RenderSharedRows::<Grey, MOST> { part, view, store, waiting, pixels, io });
            }
            return;
        }
        let view = ortho::accepts(part.frame).expect("a flat view");
        if part.frame.sections.most() <= 4 {
            simd.run(RenderOrtho::<Grey, 4> { part, view, store, waiting, pixels, io });
        } else {
            simd.run(RenderOrtho::<Grey, MOST> { part, view, store, waiting, pixels, io });
        }
    }

    /// Draws the part in whole-number sums with the fastest geometry that takes its view.
    fn render<S: Tiered>(
        self,
        simd: Simd,
        store: &mut Store<S>,
        waiting: &mut Waiting,
        (kind, queues): (&mut Kind<S>, &mut Queues),
        pixels: &mut Pixels,
        io: Io<'_>,
    ) {
        // Waiting voxels carry samples and normals; opacity by gradient needs the brick, which the
        // general geometry looks into.
        let modulated = self.frame.scene.classifier.is_modulated();
        match self.frame.sections.most() {
            _ if modulated => simd.run(RenderGeneral { part: self, kind, queues, pixels, io }),
            0..=4 => self.render_records::<S, 4>(simd, store, waiting, (kind, queues), pixels, io),
            5..=MOST => {
                self.render_records::<S, MOST>(simd, store, waiting, (kind, queues), pixels, io);
            }
            _ => simd.run(RenderGeneral { part: self, kind, queues, pixels, io }),
        }
    }

    /// Draws as [`Part::render`] does, with records of N sheets.
    fn render_records<S: Tiered, const N: usize>(
        self,
        simd: Simd,
        store: &mut Store<S>,
        waiting: &mut Waiting,
        (kind, queues): (&mut Kind<S>, &mut Queues),
        pixels: &mut Pixels,
        io: Io<'_>,
    ) {
        let part = self;
        if let Some(view) = shared_rows::accepts(part.frame) {
            let waiting = &mut waiting.flat;
            simd.run(RenderSharedRows::<S, N> { part, view, store, waiting, pixels, io });
        } else if let Some(view) = ortho::accepts(part.frame) {
            let waiting = &mut waiting.flat;
            simd.run(RenderOrtho::<S, N> { part, view, store, waiting, pixels, io });
        } else if let Some(lean) = sheared::accepts(part.frame) {
            let waiting = &mut waiting.leaning;
            simd.run(RenderSheared { part, lean, store, waiting, pixels, io });
        } else if let Some(deep) = perspective::accepts(&part) {
            let waiting = &mut waiting.deep;
            let lattice_rows = part.frame.lattice_rows.as_ref();
            let deep = RenderPerspective::<S, N> { part, deep, store, waiting, pixels, io };
            match lattice_rows {
                Some(lattice_rows) => simd.run(RenderPerspectiveSharedRows { deep, lattice_rows }),
                None => simd.run(deep),
            }
        } else {
            simd.run(RenderGeneral { part, kind, queues, pixels, io });
        }
    }
}

/// Returns the state of `tile` in front of the first slab: all opacities zero.
pub fn blank(tile: Rect) -> TileState {
    TileState { a: vec![0.0; tile.area()], last: None::<Vec<RawSums>> }
}
