//! The listing for fields, plainly: planes of values and derivatives over a whole frame, on one
//! thread.
//!
//! Nothing is culled and nothing is tiled, as in [`serial`](super::serial). It shares two things
//! with the tile renderer: the weights, and the compositing of a pair of planes
//! ([`crate::kernels::composite::field`]).

use crate::kernels::Simd;
use crate::kernels::composite::field::{FieldRule, FieldScene};
use crate::kernels::composite::{LANES, Row};
use crate::kernels::field::{FieldSum, planes_of, weighted};
use crate::primitives::work_counters::WorkCounters;
use crate::scene::Frame;
use slabcast_common::brick::Brick;
use slabcast_common::image::{FrameState, Picture, TilePixels};
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use std::sync::Arc;

/// A voxel: first plane, depth in phases, brick and index in it.
type Voxel = (i32, i32, usize, usize);

/// Renders a frame whose sheets hold planes of a field, in sums of `S`.
pub(super) fn render<S: FieldSum>(
    frame: &Frame,
    bricks: &[Arc<Brick>],
    mut counters: Option<&mut WorkCounters>,
) -> Picture {
    let (Some(rule), Some(scene)) = (&frame.field, &frame.scene.field) else {
        unreachable!("a frame whose sheets hold planes")
    };
    let [w, h] = frame.view.size.map(|n| n as usize);
    let whole = Rect::from_size(frame.view.size);
    let mut voxels: Vec<Voxel> = Vec::new();
    let mut range = SheetRange::default();
    for (b, brick) in bricks.iter().enumerate() {
        let corner = frame.corner(brick.id);
        for (i, &local) in brick.index.iter().enumerate() {
            let z = frame.place(&corner, local).z;
            let (first, count) = frame.sections.span(z);
            range = range.union(SheetRange::new(first, first + count as i32));
            voxels.push((first, z, b, i));
        }
    }
    let mut buckets: Vec<Vec<u32>> = vec![Vec::new(); range.len() as usize];
    for (v, &(first, z, ..)) in voxels.iter().enumerate() {
        for k in first..first + frame.sections.span(z).1 as i32 {
            buckets[(k - range.first) as usize].push(v as u32);
        }
    }
    let mut out =
        TilePixels { a: vec![0.0; whole.area()], colour: vec![[0; 3]; whole.area()], last: None };
    let mut before = vec![[S::default(); 4]; whole.area()];
    let mut here = before.clone();
    let (mut bx, mut by) = (Vec::new(), Vec::new());
    for k in range.first..range.end {
        here.fill([S::default(); 4]);
        for &v in &buckets[(k - range.first) as usize] {
            let (first, z, b, i) = voxels[v as usize];
            let brick = &bricks[b];
            let Some(footprint) = frame.footprints.at(k) else { continue };
            let placed = frame.place(&frame.corner(brick.id), brick.index[i]);
            let at = frame.screen(&placed, k, &footprint);
            let (y0, wy) = S::window(&footprint, 1, at[1], (0, h as i32), &mut by);
            if wy.is_empty() {
                continue;
            }
            let payload = S::payload_of(frame.field_payload(rule, brick, i));
            let plane = planes_of::<S>(&frame.sections, z)[(k - first) as usize];
            let section = weighted::<S>([payload; 4], plane);
            for (y, &wy) in (y0..).zip(wy) {
                let row = weighted::<S>(section, wy);
                let along = frame.along_row(at, y);
                let (x0, wx) = S::window(&footprint, 0, along, (0, w as i32), &mut bx);
                for (x, &wx) in (x0..).zip(wx) {
                    let term = weighted::<S>(row, wx);
                    let pixel = &mut here[y as usize * w + x as usize];
                    *pixel = std::array::from_fn(|c| pixel[c].with(term[c]));
                }
                if let Some(counters) = counters.as_mut() {
                    counters.add_section(Rect::new(x0, y, x0 + wx.len() as i32, y + 1));
                }
            }
        }
        for y in 0..h {
            for x in 0..w {
                let i = y * w + x;
                if here[i][0].value() == 0.0 || frame.rule.is_shut(out.a[i]) {
                    continue;
                }
                close(frame, (rule, scene), [before[i], here[i]], ([x, y], k), i, &mut out);
                if let Some(counters) = counters.as_mut() {
                    counters.add_sheet(i, k, frame.rule.is_shut(out.a[i]));
                }
            }
        }
        std::mem::swap(&mut before, &mut here);
    }
    let mut state = FrameState::new(frame.view.size);
    state.add_slab_tile(whole, &out);
    state.to_picture()
}

/// Adds the segment between two planes of the pixel at column `x` and row `y` to pixel `i` of
/// `out`.
pub(super) fn close<S: FieldSum>(
    frame: &Frame,
    (rule, scene): (&FieldRule, &FieldScene),
    [before, here]: [[S; 4]; 2],
    ([x, y], k): ([usize; 2], i32),
    i: usize,
    out: &mut TilePixels,
) {
    let mut row = Row::default();
    for c in 0..4 {
        (row.before[c][0], row.here[c][0]) = (before[c].value(), here[c].value());
    }
    row.secant[0] = frame.view.secant(x as i32, y as i32);
    row.a[0] = out.a[i];
    let pixels = [[x as i32, y as i32]; LANES];
    let looks = (scene, frame.shader.as_ref());
    rule.close_row(Simd::plain(), looks, &mut row, (&pixels, k), 1);
    out.a[i] = row.a[0];
    for (sum, light) in out.colour[i].iter_mut().zip(&row.light) {
        *sum = sum.wrapping_add(light[0]);
    }
}
