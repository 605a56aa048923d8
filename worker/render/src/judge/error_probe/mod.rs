//! An estimate of a frame's error at a few of its pixels: by sheets of half the thickness and, in
//! `model`, by the model without rounded positions, without truncation and without ripple.
//!
//! A worker does not know the limit of thin sheets, but it can measure how much a pixel changes
//! when sheets become thinner. An error that falls with the power p of the thickness is 1 / (1 -
//! 2^-p) of that change (Richardson extrapolation;
//! [`slabcast_common::stats::THICKNESS_EXTRAPOLATION`]). One pixel in 128 is drawn twice, in
//! blocks, since neighbours share footprints.

mod model;

use self::model::Model;
use crate::kernels::Simd;
use crate::scene::{Frame, Scene};
use crate::tile::{self, Scratch};
use slabcast_common::brick::{Brick, TightBox};
use slabcast_common::image::{COLOUR_UNIT, TilePixels, TileState};
use slabcast_common::message::{ErrorsBySource, SampledError, SceneSpec};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Quality;
use slabcast_common::region::parts;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projected, View};
use std::sync::Arc;

/// Edge of a block in pixels. With a footprint of 3 pixels to each side, a voxel is drawn some
/// three times as often for blocks of 8 as for a tile, and fifty times as often for single pixels.
const BLOCK: i32 = 8;

/// Share of pixels that are drawn again in large pictures: one in this many.
pub const ONE_IN: u32 = 128;

/// Least number of blocks of 8x8 pixels that are drawn again in a small picture. From half as many
/// the estimate was off by more than a factor of two.
pub const AT_LEAST: u32 = 32;

/// Factor of eps, the cut-off, for both pictures: so that their difference is due to thickness
/// alone.
const EPS: f64 = 1.0 / 16.0;

/// A scene at its sheet thickness and at half of it, from which frames of all views are made.
pub struct ThicknessPair([Arc<Scene>; 2]);

impl ThicknessPair {
    /// Prepares both scenes; `None` if sheets of half the thickness are thinner than a quality may
    /// ask for.
    pub fn new(spec: &SceneSpec) -> Option<ThicknessPair> {
        let q = spec.quality;
        let [whole, half] = [1.0, 0.5].map(|times| {
            let quality = Quality { thickness: q.thickness * times, eps: q.eps * EPS, ..q };
            quality.check().ok()?;
            Some(Arc::new(Scene::new(&SceneSpec { quality, ..spec.clone() })))
        });
        Some(ThicknessPair([whole?, half?]))
    }

    /// Prepares `view` at both thicknesses, the whole one first.
    pub fn frames(&self, view: &View) -> [Frame; 2] {
        let ThicknessPair([whole, half]) = self;
        let thin = view.with_thickness_of(&half.quality);
        [Frame::new(whole.clone(), *view), Frame::new(half.clone(), thin)]
    }
}

/// The blocks of `tile` that are drawn again. In a large picture every other part of 64x64 pixels
/// has one of 8x8. A part decides by its position alone, so all workers and any tiling choose the
/// same blocks.
pub fn blocks(tile: Rect, size: [u32; 2]) -> impl Iterator<Item = Rect> {
    parts(tile).flat_map(move |part| blocks_of_part(part, size))
}

fn blocks_of_part(part: Rect, size: [u32; 2]) -> impl Iterator<Item = Rect> {
    let [w, h] = [part.x1 - part.x0, part.y1 - part.y0].map(|n| n / BLOCK);
    let all = (w * h) as u32;
    // A number that only the part decides: all workers and frames agree.
    let mut x =
        (part.x0 as u32).wrapping_mul(0x9e37_79b1) ^ (part.y0 as u32).wrapping_mul(0x85eb_ca6b);
    let mut next = move || {
        x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        x >> 8
    };
    let there = size[0] * size[1] / (BLOCK * BLOCK) as u32;
    let each = (there / AT_LEAST).clamp(1, ONE_IN);
    let n = all / each + u32::from(next() % each < all % each);
    (0..n).map(move |_| {
        let i = (next() % all) as i32;
        let (x0, y0) = (part.x0 + i % w * BLOCK, part.y0 + i / w * BLOCK);
        Rect::new(x0, y0, x0 + BLOCK, y0 + BLOCK)
    })
}

/// Estimates the errors of one frame's pixels. Any number of threads may share it.
pub struct ErrorProbe {
    pair: Option<[Frame; 2]>,
    model: Option<Model>,
}

impl ErrorProbe {
    /// Prepares a probe of `frame`; `pair` is made of the frame's scene. Without `pair` the error
    /// by thickness is not estimated.
    pub fn new(frame: &Frame, pair: Option<&ThicknessPair>) -> ErrorProbe {
        ErrorProbe { pair: pair.map(|p| p.frames(&frame.view)), model: Model::of(frame) }
    }

    /// Returns squared errors, by kind, summed over some pixels of `tile` of `frame`, the frame
    /// that the probe was made for; `bricks` are those that the tile was drawn from.
    pub fn sample(
        &self,
        frame: &Frame,
        simd: Simd,
        tile: Rect,
        bricks: &[Arc<Brick>],
        scratch: &mut Scratch,
    ) -> ErrorsBySource {
        let mut samples = ErrorsBySource::default();
        let seen = |b: &Arc<Brick>| frame.view.project(&b.tight_box(&frame.scene.grid));
        let mut rects: Vec<Option<Projected>> = Vec::new();
        for block in blocks(tile, frame.view.size) {
            if let Some(pair) = &self.pair {
                if rects.is_empty() {
                    rects.extend(bricks.iter().map(seen));
                }
                // In sheets of half the thickness footprints of perspective views may reach a pixel
                // farther.
                let near = Rect::new(block.x0 - 1, block.y0 - 1, block.x1 + 1, block.y1 + 1);
                let over = |p: &Projected| !p.rect.intersect(&near).is_empty();
                let some = bricks.iter().zip(&rects).filter(|(_, p)| p.as_ref().is_some_and(over));
                let some: Vec<Arc<Brick>> = some.map(|(brick, _)| brick.clone()).collect();
                thinner(pair, simd, block, &some, scratch, &mut samples.thickness);
            }
            if let Some(model) = &self.model {
                model.sample(frame, block, bricks, &mut samples);
            }
        }
        samples
    }
}

/// Draws a block at both thicknesses and adds the squared difference of each pixel to `sampled`.
fn thinner(
    frames: &[Frame; 2],
    simd: Simd,
    block: Rect,
    bricks: &[Arc<Brick>],
    scratch: &mut Scratch,
    sampled: &mut SampledError,
) {
    let [coarse, fine] = frames.each_ref().map(|frame| {
        let whole = TightBox { lo: [0; 3], hi: frame.scene.dims.map(|n| n - 1) };
        let sheets = frame.view.project(&whole).map_or_else(SheetRange::default, |p| p.sheets);
        let state = TileState { a: vec![0.0; block.area()], last: None };
        tile::render(frame, simd, block, sheets, bricks, &state, scratch).0
    });
    for i in 0..block.area() {
        let light = |p: &TilePixels, k: usize| f64::from(p.colour[i][k]) * f64::from(COLOUR_UNIT);
        let (a, b) = (f64::from(coarse.a[i]), f64::from(fine.a[i]));
        let colours = (0..3).map(|k| light(&coarse, k) - light(&fine, k));
        let squares = colours.fold((a - b) * (a - b), |sum, off| sum + off * off);
        sampled.add_pixel(a > 0.0 || b > 0.0, squares);
    }
}
