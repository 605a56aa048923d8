//! The paper's listing (section 3), plainly: a whole frame on one thread.
//!
//! Every voxel is transformed and put into every bucket that it overlaps; sheet after sheet is
//! filled over the whole picture and composited. Nothing is culled, nothing is tiled, nothing
//! is kept open but the sheet at hand and the one that the colour rule peeks into. It shares
//! with the tile renderer what a pixel is (profile, sections, the closing of a sheet) and none
//! of how it gets there, and stands as the oracle for its bytes.

use crate::scene::Frame;
use crate::sheet::Sum;
use slabcast_common::brick::Brick;
use slabcast_common::image::{FrameState, Picture, TilePixels};
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use std::sync::Arc;

/// Renders `frame` from all bricks of its scene.
pub fn render(frame: &Frame, bricks: &[Arc<Brick>]) -> Picture {
    if frame.scene.float_sums() {
        render_sums::<f32>(frame, bricks, |sum, v| sum + v)
    } else {
        // Round to nearest, as the splat loop says; saturating, as it is.
        render_sums::<i32>(frame, bricks, |sum, v| sum.wrapping_add((v + 0.5) as i32))
    }
}

fn render_sums<S: Sum>(frame: &Frame, bricks: &[Arc<Brick>], add: impl Fn(S, f32) -> S) -> Picture {
    let [w, h] = frame.view.size.map(|n| n as usize);
    let whole = Rect::of_size(frame.view.size);
    let mut voxels = Vec::new();
    let mut range = SheetRange::default();
    for (b, brick) in bricks.iter().enumerate() {
        let corner = frame.view.corner_in_eye(frame.scene.grid.corner(brick.id));
        for (i, &local) in brick.index.iter().enumerate() {
            let eye = frame.eye(corner, local);
            let z = frame.view.depth_in_phases(eye.z);
            let (first, weights) = frame.sections.of(z);
            range = range.union(SheetRange::new(first, first + weights.len() as i32));
            voxels.push((first, brick.id, i as u16, b as u32));
        }
    }
    // Float sums are defined in this order; integers do not care.
    voxels.sort_unstable();
    let mut buckets: Vec<Vec<u32>> = vec![Vec::new(); range.len() as usize];
    for (v, &(first, _, i, b)) in voxels.iter().enumerate() {
        let brick = &bricks[b as usize];
        let corner = frame.view.corner_in_eye(frame.scene.grid.corner(brick.id));
        let eye = frame.eye(corner, brick.index[i as usize]);
        let (_, weights) = frame.sections.of(frame.view.depth_in_phases(eye.z));
        for k in first..first + weights.len() as i32 {
            buckets[(k - range.first) as usize].push(v as u32);
        }
    }

    let mut pixels =
        TilePixels { a: vec![0.0; whole.area()], colour: vec![[0; 3]; whole.area()], last: None };
    let mut before = vec![[S::default(); 4]; whole.area()];
    let mut here = before.clone();
    let mut peek = before.clone();
    let (mut bx, mut by) = (Vec::new(), Vec::new());
    for k in range.first..range.end {
        here.fill([S::default(); 4]);
        peek.fill([S::default(); 4]);
        for &v in &buckets[(k - range.first) as usize] {
            let (first, _, i, b) = voxels[v as usize];
            let brick = &bricks[b as usize];
            let corner = frame.view.corner_in_eye(frame.scene.grid.corner(brick.id));
            let eye = frame.eye(corner, brick.index[i as usize]);
            let payload = frame.payload(brick, i as usize, eye);
            if payload[0] <= 0.0 {
                continue;
            }
            let (_, weights) = frame.sections.of(frame.view.depth_in_phases(eye.z));
            // Its section here, and the one behind: a voxel in this bucket begins no later than
            // this sheet, so what it puts into the next one is what the rule may peek at.
            for (sheet, to) in [(k, &mut here), (k + 1, &mut peek)] {
                let Some(&wz) = weights.get((sheet - first) as usize) else { continue };
                let Some(f) = frame.footprints.at(sheet) else { continue };
                let [x, y] = frame.view.screen(eye.x, eye.y, f.scale);
                let (x0, wx) = f.weights(0, x, (0, w as i32), &mut bx);
                let (y0, wy) = f.weights(1, y, (0, h as i32), &mut by);
                let section = payload.map(|p| p * wz);
                for (j, &wy) in wy.iter().enumerate() {
                    for (i, &wx) in wx.iter().enumerate() {
                        let pixel = &mut to[(y0 as usize + j) * w + x0 as usize + i];
                        for c in 0..4 {
                            pixel[c] = add(pixel[c], section[c] * wy * wx);
                        }
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
                }
            }
        }
        std::mem::swap(&mut before, &mut here);
    }
    let mut state = FrameState::new(frame.view.size);
    state.put(whole, &pixels);
    state.finish()
}
