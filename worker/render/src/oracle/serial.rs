//! The paper's listing (section 3), plainly: a whole frame on one thread.
//!
//! Every voxel is transformed and put into every bucket that it overlaps; sheet after sheet is
//! filled over the whole picture and composited. Nothing is culled, nothing is tiled, nothing
//! is kept open but the sheet at hand and the one that the colour rule peeks into. It shares
//! with the tile renderer what a pixel is (profile, sections, the closing of a sheet) and none
//! of how it gets there, and stands as the oracle for its bytes.

use crate::kernels::composite::Sum;
use crate::primitives::footprint::Footprint;
use crate::primitives::work_counters::WorkCounters;
use crate::scene::Frame;
use slabcast_common::brick::Brick;
use slabcast_common::image::{FrameState, Picture, TilePixels};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Sums;
use slabcast_common::slab::SheetRange;
use std::sync::Arc;

/// Renders `frame` from `bricks`, all bricks of its scene in any order. Returns linear
/// premultiplied RGBA. Every other renderer of the crate gives these bytes.
pub fn render(frame: &Frame, bricks: &[Arc<Brick>]) -> Picture {
    render_counting(frame, bricks, None)
}

/// Renders as [`render`] does and counts each pixel's work in `counters`.
pub(crate) fn render_counting(
    frame: &Frame,
    bricks: &[Arc<Brick>],
    counters: Option<&mut WorkCounters>,
) -> Picture {
    if frame.is_field() {
        return match frame.scene.quality.sums {
            Sums::I16 => super::field::render::<i16>(frame, bricks, counters),
            _ => super::field::render::<i32>(frame, bricks, counters),
        };
    }
    match frame.scene.quality.sums {
        Sums::F32 => {
            let add = |to: &mut [[f32; 4]], p: &Section<'_>| {
                floats(p, |pixel, c, v| to[pixel][c] += v);
            };
            render_sums(frame, bricks, counters, add)
        }
        Sums::I16 => render_sums(frame, bricks, counters, fixed),
        // Rounded to nearest, ties to even, and saturating, as the splat loop does.
        Sums::I32 | Sums::Auto => {
            let add = |to: &mut [[i32; 4]], p: &Section<'_>| {
                floats(p, |pixel, c, v| {
                    to[pixel][c] = to[pixel][c].wrapping_add(v.round_ties_even() as i32);
                });
            };
            render_sums(frame, bricks, counters, add)
        }
    }
}

/// One section of one voxel.
struct Section<'a> {
    frame: &'a Frame,
    /// The voxel's depth in phases, and which of its sections this is.
    z: i32,
    section: usize,
    payload: [f32; 4],
    footprint: Footprint<'a>,
    at: [i64; 2],
}

impl Section<'_> {
    /// The rows of pixels that it adds to: the first pixel of each, and the number of pixels.
    fn rows(&self) -> Vec<([i32; 2], usize)> {
        let [w, h] = self.frame.view.size.map(|n| n as i32);
        let (mut bx, mut by) = (Vec::new(), Vec::new());
        let (y0, wy) = self.footprint.weights(1, self.at[1], (0, h), &mut by);
        let rows = (y0..).take(wy.len()).map(|y| {
            let at = self.frame.along_row(self.at, y);
            let (x, wx) = self.footprint.weights(0, at, (0, w), &mut bx);
            ([x, y], wx.len())
        });
        rows.collect()
    }
}

/// `((payload * wz) * wy) * wx` for every pixel and channel.
fn floats(p: &Section<'_>, mut add: impl FnMut(usize, usize, f32)) {
    let [w, h] = p.frame.view.size.map(|n| n as i32);
    let (mut bx, mut by) = (Vec::new(), Vec::new());
    let wz = p.frame.sections.of(p.z).1[p.section];
    let section = p.payload.map(|c| c * wz);
    let (y0, wy) = p.footprint.weights(1, p.at[1], (0, h), &mut by);
    for (y, wy) in (y0..).zip(wy) {
        let (x0, wx) = p.footprint.weights(0, p.frame.along_row(p.at, y), (0, w), &mut bx);
        for (i, wx) in wx.iter().enumerate() {
            let pixel = (y * w + x0) as usize + i;
            for c in 0..4 {
                add(pixel, c, section[c] * wy.get() * wx.get());
            }
        }
    }
}

/// Adds a section in 16-bit fixed point: payload, section, row and contribution are each rounded to
/// nearest.
fn fixed(to: &mut [[i16; 4]], p: &Section<'_>) {
    let times = |a: i32, b: i16| (a * i32::from(b) + 16384) >> 15;
    let [w, h] = p.frame.view.size.map(|n| n as i32);
    let (mut bx, mut by) = (Vec::new(), Vec::new());
    let wz = p.frame.sections.of_fixed(p.z).1[p.section];
    let section = p.payload.map(|c| times((c + 0.5) as i32, wz));
    let (y0, wy) = p.footprint.weights_fixed(1, p.at[1], (0, h), &mut by);
    for (y, &wy) in (y0..).zip(wy) {
        let (x0, wx) = p.footprint.weights_fixed(0, p.frame.along_row(p.at, y), (0, w), &mut bx);
        for (i, &wx) in wx.iter().enumerate() {
            let pixel = (y * w + x0) as usize + i;
            for c in 0..4 {
                let sum = i32::from(to[pixel][c]) + times(times(section[c], wy), wx);
                to[pixel][c] = sum.min(32767) as i16;
            }
        }
    }
}

fn render_sums<S: Sum>(
    frame: &Frame,
    bricks: &[Arc<Brick>],
    mut counters: Option<&mut WorkCounters>,
    add: impl Fn(&mut [[S; 4]], &Section<'_>),
) -> Picture {
    let [w, h] = frame.view.size.map(|n| n as usize);
    let whole = Rect::from_size(frame.view.size);
    let mut voxels = Vec::new();
    let mut range = SheetRange::default();
    for (b, brick) in bricks.iter().enumerate() {
        let corner = frame.corner(brick.id);
        for (i, &local) in brick.index.iter().enumerate() {
            let (first, weights) = frame.sections.of(frame.place(&corner, local).z);
            range = range.union(SheetRange::new(first, first + weights.len() as i32));
            voxels.push((first, brick.id, i as u16, b as u32));
        }
    }
    // Float sums are defined in this order; integers do not care.
    voxels.sort_unstable();
    let mut buckets: Vec<Vec<u32>> = vec![Vec::new(); range.len() as usize];
    for (v, &(first, _, i, b)) in voxels.iter().enumerate() {
        let brick = &bricks[b as usize];
        let placed = frame.place(&frame.corner(brick.id), brick.index[i as usize]);
        let (_, weights) = frame.sections.of(placed.z);
        for k in first..first + weights.len() as i32 {
            buckets[(k - range.first) as usize].push(v as u32);
        }
    }

    let mut pixels =
        TilePixels { a: vec![0.0; whole.area()], colour: vec![[0; 3]; whole.area()], last: None };
    let mut before = vec![[S::default(); 4]; whole.area()];
    let mut here = before.clone();
    let mut peek = before.clone();
    for k in range.first..range.end {
        here.fill([S::default(); 4]);
        peek.fill([S::default(); 4]);
        for &v in &buckets[(k - range.first) as usize] {
            let (first, _, i, b) = voxels[v as usize];
            let brick = &bricks[b as usize];
            let placed = frame.place(&frame.corner(brick.id), brick.index[i as usize]);
            let payload = frame.payload(brick, i as usize, placed.eye);
            if payload[0] <= 0.0 {
                continue;
            }
            let z = placed.z;
            let count = frame.sections.of(z).1.len() as i32;
            // Its section here, and the one behind: a voxel in this bucket begins no later than
            // this sheet, so what it puts into the next one is what the rule may peek at.
            let to = [(k, &mut here), (k + 1, &mut peek)];
            for (sheet, to) in to {
                if sheet - first >= count {
                    continue;
                }
                let Some(footprint) = frame.footprints.at(sheet) else { continue };
                let at = frame.screen(&placed, sheet, &footprint);
                let section = (sheet - first) as usize;
                let part = Section { frame, z, section, payload, footprint, at };
                add(to, &part);
                if let Some(counters) = counters.as_mut().filter(|_| sheet == k) {
                    for ([x, y], n) in part.rows() {
                        counters.add_section(Rect::new(x, y, x + n as i32, y + 1));
                    }
                }
            }
        }
        for y in 0..h {
            for x in 0..w {
                let i = y * w + x;
                let a = &mut pixels.a[i];
                if !frame.rule.is_shut(*a) {
                    let secant = frame.view.secant(x as i32, y as i32);
                    frame.rule.close(before[i], here[i], peek[i], secant, a, &mut pixels.colour[i]);
                    if let Some(counters) = counters.as_mut().filter(|_| here[i][0].value() > 0.0) {
                        counters.add_sheet(i, k, frame.rule.is_shut(*a));
                    }
                }
            }
        }
        std::mem::swap(&mut before, &mut here);
    }
    let mut state = FrameState::new(frame.view.size);
    state.add_slab_tile(whole, &pixels);
    state.to_picture()
}
