//! Pictures drawn and pixels judged by this process alone, on several threads: what `error` and
//! `check` compare with each other. No cluster, no scheduler.

use crate::progress::{self, Progress};
use slabcast_common::brick::Brick;
use slabcast_common::image::{FrameState, Picture, TilePixels};
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_render::Frame;
use slabcast_render::splat::Simd;
use slabcast_render::tile::{self, Scratch};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// How a picture is cut. Never changes a byte.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cut {
    /// Threads.
    pub(crate) threads: usize,
    /// Edge of the tiles in pixels; any number.
    pub(crate) tile: u32,
    /// Slabs.
    pub(crate) slabs: u32,
}

impl Cut {
    /// One slab, tiles of 128 pixels.
    pub(crate) fn on(threads: usize) -> Cut {
        Cut { threads, tile: 128, slabs: 1 }
    }
}

/// A whole frame by the tile renderer.
pub(crate) fn picture(frame: &Frame, bricks: &[Arc<Brick>], cut: Cut) -> Picture {
    let whole = Rect::of_size(frame.view.size);
    let sheets = bricks
        .iter()
        .filter_map(|b| frame.view.project(&b.tight(&frame.scene.grid)))
        .fold(SheetRange::default(), |r, p| r.union(p.sheets));
    let edge = cut.tile as i32;
    let tiles: Vec<Rect> = (0..whole.y1)
        .step_by(cut.tile as usize)
        .flat_map(|y| {
            let row = (0..whole.x1).step_by(cut.tile as usize);
            row.map(move |x| Rect::new(x, y, x + edge, y + edge).intersect(&whole))
        })
        .collect();
    let mut state = FrameState::new(frame.view.size);
    for slab in sheets.slabs(cut.slabs) {
        let done = shared(tiles.len(), cut.threads, |i, scratch: &mut Scratch| -> TilePixels {
            let before = state.tile(tiles[i]);
            tile::render(frame, Simd::detect(), tiles[i], slab, bricks, &before, scratch).0
        });
        for (tile, pixels) in tiles.iter().zip(&done) {
            state.put(*tile, pixels);
        }
        state.end_slab();
    }
    state.finish()
}

/// `work` for each of `n` items on `threads` threads; results in order. Each thread has an `S`
/// of its own.
pub(crate) fn shared<S: Default, T: Send>(
    n: usize,
    threads: usize,
    work: impl Fn(usize, &mut S) -> T + Sync,
) -> Vec<T> {
    let next = AtomicUsize::new(0);
    let run = || {
        let (mut own, mut done) = (S::default(), Vec::new());
        loop {
            let i = next.fetch_add(1, Ordering::Relaxed);
            if i >= n {
                return done;
            }
            done.push((i, work(i, &mut own)));
        }
    };
    let mut all: Vec<(usize, T)> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..threads.min(n.max(1))).map(|_| scope.spawn(run)).collect();
        let join = |t: std::thread::ScopedJoinHandle<'_, Vec<(usize, T)>>| {
            t.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        };
        threads.into_iter().flat_map(join).collect()
    });
    all.sort_by_key(|(i, _)| *i);
    all.into_iter().map(|(_, t)| t).collect()
}

/// What `pixel` says of each of `sample`, in portions, so that there is something to see
/// meanwhile.
pub(crate) fn judge<T: Send>(
    sample: &[[u32; 2]],
    threads: usize,
    progress: &mut Progress,
    pixel: impl Fn([u32; 2]) -> T + Sync,
) -> Vec<T> {
    let mut done = Vec::with_capacity(sample.len());
    for portion in sample.chunks(256 * threads) {
        done.extend(shared(portion.len(), threads, |i, _: &mut ()| pixel(portion[i])));
        progress.step(progress::Step { frames: done.len() as u64, ..Default::default() });
    }
    done
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_work_comes_back_in_order() {
        for threads in [1, 2, 7] {
            let got = shared(100, threads, |i, seen: &mut usize| {
                *seen += 1;
                i * i
            });
            assert_eq!(got, (0..100).map(|i| i * i).collect::<Vec<_>>());
        }
        assert!(shared(0, 3, |i, _: &mut ()| i).is_empty());
    }
}
