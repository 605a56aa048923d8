//! Pictures drawn and pixels judged by this process alone, on several threads: what `error` and
//! `check` compare with each other. No cluster, no scheduler.

use crate::progress::{self, Progress};
use rayon::{ThreadPool, ThreadPoolBuilder};
use slabcast_common::brick::{Brick, BrickInfo};
use slabcast_common::image::{FrameState, Picture, TilePixels};
use slabcast_common::message::Counters;
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_render::Frame;
use slabcast_render::Simd;
use slabcast_render::region::{self, BrickSupply};
use slabcast_render::tile::{self, ProjectedBrick, Scratch};
use slabcast_render::visibility::{Directory, VisibleBricks};
use slabcast_render::work::{self, WorkCounters};
use slabcast_volumes::BrickStore;
use std::collections::BTreeMap;
use std::ops::Deref;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Division of a picture among threads; never changes a byte.
#[derive(Clone, Copy, Debug)]
pub struct Cut {
    /// Number of threads that draw at once.
    pub threads: usize,
    /// Edge of the tiles in pixels; any number.
    pub tile: u32,
    /// Number of slabs; with 1 each tile is drawn through all sheets.
    pub slabs: u32,
}

impl Cut {
    /// Returns a cut into tiles of 128 pixels and one slab.
    pub fn on(threads: usize) -> Cut {
        Cut { threads, tile: 128, slabs: 1 }
    }
}

/// Bricks of a scene by id, with the directory that says where each lies.
#[derive(Clone)]
pub struct Bricks {
    all: Vec<Arc<Brick>>,
    directory: Arc<Directory>,
}

impl Bricks {
    /// Returns all bricks of a store with their directory.
    pub fn from_store(store: &BrickStore) -> Bricks {
        let brick = |i: &BrickInfo| store.brick(i.id).expect("a brick that the store knows");
        let all = store.infos().iter().map(brick).collect();
        Bricks { all, directory: Arc::new(Directory::new(store.infos().clone())) }
    }

    /// Returns the directory of the bricks.
    pub fn directory(&self) -> &Arc<Directory> {
        &self.directory
    }
}

impl Deref for Bricks {
    type Target = [Arc<Brick>];

    fn deref(&self) -> &[Arc<Brick>] {
        &self.all
    }
}

impl BrickSupply for Bricks {
    fn get(&self, place: u32) -> Option<Arc<Brick>> {
        self.all.get(place as usize).cloned()
    }
}

/// Draws a whole frame by the tile renderer; the bytes don't depend on `cut`.
pub fn draw(frame: &Frame, bricks: &Bricks, cut: Cut) -> Picture {
    draw_counted(frame, bricks, cut).0
}

/// Draws a whole frame and returns the renderer's counters with it.
pub fn draw_counted(frame: &Frame, bricks: &Bricks, cut: Cut) -> (Picture, Counters) {
    if cut.slabs > 1 {
        return in_slabs(frame, bricks, cut);
    }
    let draw = |visible: &VisibleBricks, tile, Memory { scratch, pixels }: &mut Memory| {
        region::draw(frame, visible, bricks, Simd::detect(), tile, scratch, pixels)
    };
    let (picture, counted) = through(frame, bricks, cut, draw);
    let mut counters = Counters::default();
    counted.into_iter().for_each(|counted| counters += counted);
    (picture, counters)
}

/// Returns the tiles of a picture with edges of `edge` pixels, row by row.
pub fn tile_rects(whole: Rect, edge: u32) -> impl Iterator<Item = Rect> {
    let (step, edge) = (edge as usize, edge as i32);
    let corners = (0..whole.y1)
        .step_by(step)
        .flat_map(move |y| (0..whole.x1).step_by(step).map(move |x| (x, y)));
    corners.map(move |(x, y)| Rect::new(x, y, x + edge, y + edge).intersect(&whole))
}

/// Draws a whole frame; returns it with the work of each pixel. Sections are counted only if they
/// are asked for.
pub fn draw_with_work(
    frame: &Frame,
    bricks: &Bricks,
    cut: Cut,
    sections: bool,
) -> (Picture, WorkCounters) {
    let draw = |visible: &VisibleBricks, tile, Memory { scratch, pixels }: &mut Memory| {
        let simd = Simd::detect();
        let counted = work::draw(frame, visible, bricks, simd, tile, sections, scratch, pixels);
        (tile, counted)
    };
    let (picture, tiles) = through(frame, bricks, cut, draw);
    let mut all = WorkCounters::new(frame.view.size.map(|n| n as usize));
    tiles.iter().for_each(|(tile, counted)| all.put(*tile, counted));
    (picture, all)
}

/// Draws each tile through all sheets by `draw`, as a cluster's workers do, into the thread's
/// memory. Returns the results in the order in which tiles were drawn.
fn through<T: Send>(
    frame: &Frame,
    bricks: &Bricks,
    cut: Cut,
    draw: impl Fn(&VisibleBricks, Rect, &mut Memory) -> T + Sync,
) -> (Picture, Vec<T>) {
    let whole = Rect::from_size(frame.view.size);
    let edge = cut.tile as i32;
    let outlook = VisibleBricks::new(&frame.view, &bricks.directory);
    // Empty tiles are not drawn; the heaviest come first.
    let weighed = tile_rects(whole, cut.tile).map(|tile| (outlook.weight(&tile), tile));
    let mut tiles: Vec<(u64, Rect)> = weighed.filter(|(weight, _)| *weight > 0).collect();
    tiles.sort_by_key(|&(weight, tile)| (std::cmp::Reverse(weight), tile.y0, tile.x0));
    let mut picture = Picture { size: frame.view.size, pixels: vec![[0.0; 4]; whole.area()] };
    // A row of tiles is a band of the picture; who has drawn a tile writes it there.
    let rows = picture.pixels.chunks_mut((whole.x1 * edge) as usize);
    let bands: Vec<_> = rows.map(Mutex::new).collect();
    let drawn = map_parallel(tiles.len(), cut.threads, |i, Kept(memory): &mut Kept| {
        let (_, tile) = tiles[i];
        let counted = draw(&outlook, tile, memory);
        let band = tile.y0 / edge;
        let in_band = Rect { y0: tile.y0 - band * edge, y1: tile.y1 - band * edge, ..tile };
        let mut rows = bands[band as usize].lock().unwrap_or_else(PoisonError::into_inner);
        memory.pixels.write(in_band, frame.view.size, &mut rows);
        counted
    });
    drop(bands);
    (picture, drawn)
}

/// Slab after slab, as under the paper's schedule.
fn in_slabs(frame: &Frame, bricks: &[Arc<Brick>], cut: Cut) -> (Picture, Counters) {
    let whole = Rect::from_size(frame.view.size);
    let edge = cut.tile as i32;
    let across = (whole.x1 + edge - 1) / edge;
    // In portions, so that threads share the work and a portion is worth taking.
    let portions = bricks.len().div_ceil(PROJECTED);
    let seen = map_parallel(portions, cut.threads, |i, _: &mut ()| {
        let portion = &bricks[i * PROJECTED..bricks.len().min((i + 1) * PROJECTED)];
        portion.iter().filter_map(|b| ProjectedBrick::new(frame, b)).collect::<Vec<_>>()
    });
    let seen: Vec<ProjectedBrick> = seen.into_iter().flatten().collect();
    let mut tiles: Vec<(Rect, Vec<&ProjectedBrick>)> =
        tile_rects(whole, cut.tile).map(|tile| (tile, Vec::new())).collect();
    let mut sheets = SheetRange::default();
    for brick in ProjectedBrick::front_to_back(&seen) {
        let p = &brick.projected;
        sheets = sheets.union(p.sheets);
        for y in p.rect.y0 / edge..=(p.rect.y1 - 1) / edge {
            for x in p.rect.x0 / edge..=(p.rect.x1 - 1) / edge {
                tiles[(y * across + x) as usize].1.push(brick);
            }
        }
    }
    tiles.retain(|(_, bricks)| !bricks.is_empty());
    tiles.sort_by_key(|(tile, bricks)| (std::cmp::Reverse(bricks.len()), tile.y0, tile.x0));
    let simd = Simd::detect();
    let mut counters = Counters::default();
    let mut state = FrameState::new(frame.view.size);
    for slab in sheets.slabs(cut.slabs) {
        let done = map_parallel(tiles.len(), cut.threads, |i, Kept(memory): &mut Kept| {
            let (tile, bricks) = &tiles[i];
            let before = state.tile_state(*tile);
            tile::render_projected(frame, simd, *tile, slab, bricks, &before, &mut memory.scratch)
        });
        for ((tile, _), (pixels, counted)) in tiles.iter().zip(&done) {
            state.add_slab_tile(*tile, pixels);
            counters += *counted;
        }
        state.end_slab();
    }
    (state.to_picture(), counters)
}

/// A thread's buffers.
#[derive(Default)]
struct Memory {
    scratch: Scratch,
    pixels: TilePixels,
}

/// A thread's memory, taken over from a thread of the frame before and left to one of the next: a
/// tile allocates none of it (`worker/render/tests/allocations.rs`).
struct Kept(Memory);

static SPARE: Mutex<Vec<Memory>> = Mutex::new(Vec::new());

impl Default for Kept {
    fn default() -> Self {
        let spare = SPARE.lock().unwrap_or_else(PoisonError::into_inner).pop();
        Kept(spare.unwrap_or_default())
    }
}

impl Drop for Kept {
    fn drop(&mut self) {
        // A panic may have left them half written.
        if !std::thread::panicking() {
            let memory = std::mem::take(&mut self.0);
            SPARE.lock().unwrap_or_else(PoisonError::into_inner).push(memory);
        }
    }
}

/// Bricks that a thread projects at a time: some 0.1 ms.
const PROJECTED: usize = 512;

/// Calls `work` for each index below `n` on `threads` threads and returns the results in order.
/// Each thread has an `S` of its own.
///
/// Must not be called inside `work`.
pub fn map_parallel<S: Default, T: Send>(
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
    let pool = if threads.min(n) > 1 { pool(threads) } else { None };
    let mut all: Vec<(usize, T)> = match pool {
        Some(pool) => pool.broadcast(|_| run()).into_iter().flatten().collect(),
        None => run(),
    };
    all.sort_by_key(|(i, _)| *i);
    all.into_iter().map(|(_, t)| t).collect()
}

/// `threads` threads that live until the process ends, so that no frame waits for its threads to
/// start. `None` where the system gives none.
fn pool(threads: usize) -> Option<Arc<ThreadPool>> {
    static POOLS: Mutex<BTreeMap<usize, Arc<ThreadPool>>> = Mutex::new(BTreeMap::new());
    let mut pools = POOLS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(pool) = pools.get(&threads) {
        return Some(pool.clone());
    }
    let pool = Arc::new(ThreadPoolBuilder::new().num_threads(threads).build().ok()?);
    pools.insert(threads, pool.clone());
    Some(pool)
}

/// Pixels between two looks at the progress, for each thread: a second or so of the slowest.
/// Half as many cost nothing yet; at double the bar stands still for seconds.
const PORTION: usize = 64;

/// Calls `pixel` for each pixel of `sample` on `threads` threads and returns the results in
/// order. The progress advances by pixels; `before` were counted earlier.
pub fn map_pixels<T: Send>(
    sample: &[[u32; 2]],
    threads: usize,
    (progress, before): (&mut Progress, usize),
    pixel: impl Fn([u32; 2]) -> T + Sync,
) -> Vec<T> {
    // Not row by row: blank rows at the top take no time, and the time left would be a guess
    // from them alone.
    let order = scattered(sample.len());
    let mut done: Vec<(usize, T)> = Vec::with_capacity(sample.len());
    for portion in order.chunks(PORTION * threads) {
        done.extend(map_parallel(portion.len(), threads, |i, _: &mut ()| {
            (portion[i], pixel(sample[portion[i]]))
        }));
        let frames = (before + done.len()) as u64;
        progress.step(progress::Step { frames, ..Default::default() });
    }
    done.sort_by_key(|(i, _)| *i);
    done.into_iter().map(|(_, t)| t).collect()
}

/// The numbers below `n`, each once, any run of them spread over the whole: steps of about the
/// golden section.
fn scattered(n: usize) -> Vec<usize> {
    let gcd = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let golden = (n as f64 * 0.618_033_988_75) as usize;
    let step = (golden.max(1)..).find(|&s| gcd(s, n.max(1)) == 1).unwrap_or(1);
    (0..n).scan(0, |at, _| Some(std::mem::replace(at, (*at + step) % n))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn map_parallel_returns_results_in_order() {
        for threads in [1, 2, 7] {
            let got = map_parallel(100, threads, |i, seen: &mut usize| {
                *seen += 1;
                i * i
            });
            assert_eq!(got, (0..100).map(|i| i * i).collect::<Vec<_>>());
        }
        assert!(map_parallel(0, 3, |i, _: &mut ()| i).is_empty());
    }

    #[test]
    fn thread_pool_is_reused_across_frames() {
        let who = || {
            // Each waits for the others, so that all take part.
            let barrier = std::sync::Barrier::new(3);
            let mut who = map_parallel(3, 3, |_, _: &mut ()| {
                barrier.wait();
                std::thread::current().id()
            });
            who.sort_by_key(|id| format!("{id:?}"));
            who
        };
        assert_eq!(who(), who());
    }

    #[test]
    fn map_pixels_scatters_work_and_returns_results_in_order() {
        for n in [0, 1, 2, 5, 97, 1000] {
            let mut order = scattered(n);
            // The first tenth reaches into every third.
            for third in 0..3 {
                let part = third * n / 3..(third + 1) * n / 3;
                assert!(n < 97 || order[..n / 10].iter().any(|i| part.contains(i)), "{n}");
            }
            order.sort_unstable();
            assert_eq!(order, (0..n).collect::<Vec<_>>());
        }
        let sample: Vec<[u32; 2]> = (0..777).map(|i| [i, 2 * i]).collect();
        let mut progress = Progress::new(true);
        let got = map_pixels(&sample, 3, (&mut progress, 0), |p| p);
        assert_eq!(got, sample);
    }
}
