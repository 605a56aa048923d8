//! Macrotiles: where a slab is cut, and how much work each piece is (paper section 4.3).
//!
//! A quadtree over the picture with leaves of 16x16 pixels, built bottom-up; a tile is empty, shut
//! or to be rendered. Its workload is the number of its open pixels under at least one needed
//! brick's rectangle.
//!
//! The paper tells neither how the pixels under a union of rectangles are counted nor what it
//! costs. Painting each rectangle costs its area, and a brick magnified over the whole picture
//! makes that bricks x pixels. Here one pass over the rows carries a difference line: a rectangle
//! adds 1 at its left edge when its first row comes and takes it back after its last, and a running
//! sum along the line says how many rectangles lie over each pixel. That is rectangles + pixels, in
//! integers, with one line of memory beside the leaves' counts.

use slabcast_common::occlusion::{Rect, ShutMap};

/// Limit: edge of a quadtree leaf in pixels (the paper's choice).
pub const LEAF: u32 = 16;

/// Limit: levels of the quadtree: 16, 32, 64, 128 and 256 pixels. The paper saw "only around three
/// levels"; a tile of 512 has a state of 5 MiB on the wire, and one render thread would hold up the
/// slab with it.
pub const LEVELS: usize = 5;

/// A macrotile of the quadtree level that was chosen, and its workload (paper section 4.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Macrotile {
    /// Rectangle of the tile's pixels, clipped to the picture.
    pub rect: Rect,
    /// Workload of the tile: number of its open pixels that lie under a needed brick (paper section
    /// 4.3).
    pub est: u64,
}

/// Cut of one slab into macrotiles (paper section 4.3).
#[derive(Clone, Debug, Default)]
pub struct Cut {
    /// Edge of the level's tiles in pixels; of a mixed cut, of the smaller ones.
    pub edge: u32,
    /// Tiles to render, largest workload first; equal ones from the top left.
    pub tiles: Vec<Macrotile>,
    /// Tiles of the level in which no open pixel lies under a needed brick.
    pub empty: u64,
    /// Tiles of the level with no open pixel left.
    pub shut: u64,
    /// For each level from `edge` up, row-major: the first place in `tiles` of a tile in it. Empty
    /// for a cut through all depths, in which nobody looks for one.
    first: Vec<Grid<u32>>,
}

#[derive(Clone, Debug)]
struct Grid<T> {
    columns: usize,
    rows: usize,
    cells: Vec<T>,
}

impl<T: Copy> Grid<T> {
    fn new(columns: usize, rows: usize, value: T) -> Self {
        Grid { columns, rows, cells: vec![value; columns * rows] }
    }

    /// The grid of half as many columns and rows; `join` puts children into their parent.
    fn parent(&self, start: T, join: impl Fn(T, T) -> T) -> Self {
        let mut up = Grid::new(self.columns.div_ceil(2), self.rows.div_ceil(2), start);
        for y in 0..self.rows {
            for x in 0..self.columns {
                let cell = &mut up.cells[y / 2 * up.columns + x / 2];
                *cell = join(*cell, self.cells[y * self.columns + x]);
            }
        }
        up
    }
}

/// Pixels of a quadtree node.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Node {
    /// Under a needed brick.
    covered: u64,
    /// Under a needed brick, and open.
    open: u64,
}

/// Counts covered and open covered pixels of every leaf.
fn leaves(size: [u32; 2], rects: &[Rect], shut: &ShutMap) -> Grid<Node> {
    let [w, h] = size.map(|n| n as usize);
    let leaf = LEAF as usize;
    let mut grid = Grid::new(w.div_ceil(leaf), h.div_ceil(leaf), Node::default());
    // Rectangles by first row, and by the row after their last.
    let mut begins: Vec<u32> = (0..rects.len() as u32).collect();
    begins.sort_by_key(|&i| rects[i as usize].y0);
    let mut ends: Vec<u32> = (0..rects.len() as u32).collect();
    ends.sort_by_key(|&i| rects[i as usize].y1);
    let (mut begin, mut end) = (0, 0);
    let mut line = vec![0i32; w + 1];
    for y in 0..h {
        while begin < begins.len() && rects[begins[begin] as usize].y0 <= y as i32 {
            let r = &rects[begins[begin] as usize];
            line[r.x0 as usize] += 1;
            line[r.x1 as usize] -= 1;
            begin += 1;
        }
        while end < ends.len() && rects[ends[end] as usize].y1 <= y as i32 {
            let r = &rects[ends[end] as usize];
            line[r.x0 as usize] -= 1;
            line[r.x1 as usize] += 1;
            end += 1;
        }
        if begin == end {
            continue;
        }
        let mut over = 0;
        for column in 0..grid.columns {
            let node = &mut grid.cells[y / leaf * grid.columns + column];
            let (x0, x1) = (column * leaf, ((column + 1) * leaf).min(w));
            for x in x0..x1 {
                over += line[x];
                let covered = u64::from(over > 0);
                node.covered += covered;
                node.open += covered & u64::from(!shut.is_shut(y * w + x));
            }
        }
    }
    grid
}

/// Cuts a slab: chooses the coarsest level at which more than `wanted` tiles are to be rendered, or
/// `forced`, and lists its tiles.
///
/// `rects` are those of the needed bricks, inside the picture. With `cull` off, a tile with bricks
/// is rendered even when it is shut.
pub fn cut(
    size: [u32; 2],
    rects: &[Rect],
    shut: &ShutMap,
    cull: bool,
    wanted: u64,
    forced: Option<u32>,
) -> Cut {
    let to_render = |n: &Node| if cull { n.open > 0 } else { n.covered > 0 };
    let tree = tree(leaves(size, rects, shut));
    let level = forced.map(level_of).or_else(|| coarsest(&tree, &to_render, wanted)).unwrap_or(0);
    let mut cut = list(size, &tree[level], level, &to_render, |rect| shut.all_shut(rect));
    cut.index(size);
    cut
}

/// Cuts a slab like [`cut`], then cuts all tiles but the `whole` largest into quarters: the paper's
/// mix of tiles of 64 and 32 pixels (section 5.1), which levels loads and costs more than it gains.
pub fn cut_mixed(
    size: [u32; 2],
    rects: &[Rect],
    shut: &ShutMap,
    cull: bool,
    (wanted, forced): (u64, Option<u32>),
    whole: usize,
) -> Cut {
    let mut coarse = cut(size, rects, shut, cull, wanted, forced);
    if coarse.edge == LEAF || coarse.tiles.len() <= whole {
        return coarse;
    }
    let fine = cut(size, rects, shut, cull, 0, Some(coarse.edge / 2));
    coarse.tiles.truncate(whole);
    let kept: Vec<Rect> = coarse.tiles.iter().map(|t| t.rect).collect();
    let apart = |t: &Macrotile| kept.iter().all(|k| k.intersect(&t.rect).is_empty());
    coarse.tiles.extend(fine.tiles.into_iter().filter(apart));
    coarse.edge = fine.edge;
    coarse.index(size);
    coarse
}

/// Cuts a picture for tasks that go through all depths: nothing is shut, and pixels count as
/// covered by leaves, which costs rectangles + leaves and no look at a pixel. So `rects` may be
/// those of blocks of bricks.
///
/// A tile's size does not change what drawing it takes until it is smaller than a part of 64 pixels
/// (docs/measurements/scaling.md), while each task costs its messages. So the coarsest level is
/// chosen that still gives `many` tiles; one finer than that of 64 pixels only where there would be
/// no more than `wanted`.
pub fn cut_through(
    size: [u32; 2],
    rects: &[Rect],
    (wanted, many): (u64, u64),
    forced: Option<u32>,
) -> Cut {
    let through = Through::new(size, rects);
    through.cut(forced.unwrap_or_else(|| through.edge((wanted, many))))
}

/// The quadtree that [`cut_through`] cuts.
pub(crate) struct Through {
    size: [u32; 2],
    tree: Vec<Grid<Node>>,
}

impl Through {
    pub(crate) fn new(size: [u32; 2], rects: &[Rect]) -> Self {
        Through { size, tree: tree(covered_leaves(size, rects)) }
    }

    /// Returns the number of tiles of `edge` pixels to render.
    pub(crate) fn count(&self, edge: u32) -> usize {
        self.tree[level_of(edge)].cells.iter().filter(|n| n.covered > 0).count()
    }

    /// Returns for each leaf of the picture, row by row, whether it is to be rendered.
    pub(crate) fn leaves(&self) -> impl Iterator<Item = bool> {
        self.tree[0].cells.iter().map(|n| n.covered > 0)
    }

    /// Returns the quarters of a tile, of `half` its edge in pixels, that are to be rendered.
    pub(crate) fn quarters(&self, tile: &Rect, half: u32) -> impl Iterator<Item = Macrotile> {
        let grid = &self.tree[level_of(half)];
        let cell = |p: i32| p as usize / half as usize;
        let (column, row) = (cell(tile.x0), cell(tile.y0));
        let tile = *tile;
        [(0, 0), (1, 0), (0, 1), (1, 1)].into_iter().filter_map(move |(x, y)| {
            let (x0, y0) = (tile.x0 + x * half as i32, tile.y0 + y * half as i32);
            let rect = Rect::new(x0, y0, x0 + half as i32, y0 + half as i32).intersect(&tile);
            if rect.is_empty() {
                return None;
            }
            let node = grid.cells[(row + y as usize) * grid.columns + column + x as usize];
            (node.covered > 0).then_some(Macrotile { rect, est: node.open })
        })
    }

    /// Returns the tiles of a coarse cut, with those that are `split` replaced by their quarters.
    pub(crate) fn mixed(&self, mut coarse: Cut, split: &[bool]) -> Cut {
        if !split.contains(&true) {
            return coarse;
        }
        let half = coarse.edge / 2;
        let tiles = coarse.tiles.iter().zip(split).filter(|(_, split)| **split);
        let parts = tiles.flat_map(|(t, _)| self.quarters(&t.rect, half));
        let mut parts: Vec<Macrotile> = parts.collect();
        parts.sort_by_key(|t| (t.rect.y0, t.rect.x0));
        let mut is_whole = split.iter().map(|split| !split);
        coarse.tiles.retain(|_| is_whole.next().unwrap_or(true));
        coarse.tiles.extend(parts);
        coarse.edge = half;
        coarse.sort();
        coarse
    }

    /// Returns the tiles of `edge` pixels.
    pub(crate) fn cut(&self, edge: u32) -> Cut {
        let level = level_of(edge);
        list(self.size, &self.tree[level], level, &|n| n.covered > 0, |_| false)
    }

    /// Returns the edge in pixels that [`cut_through`] chooses.
    pub(crate) fn edge(&self, (wanted, many): (u64, u64)) -> u32 {
        /// Limit: level of the tiles of 64 pixels that are rendered in one part.
        const PART: usize = 2;
        let coarsest = |wanted| coarsest(&self.tree, &|n| n.covered > 0, wanted);
        let level = coarsest(many)
            .filter(|&level| level >= PART)
            .or_else(|| coarsest(wanted).map(|level| level.min(PART)));
        LEAF << level.unwrap_or(0)
    }
}

/// Builds the levels of the quadtree above its leaves.
fn tree(leaves: Grid<Node>) -> Vec<Grid<Node>> {
    let mut tree = vec![leaves];
    for level in 1..LEVELS {
        let join =
            |a: Node, b: Node| Node { covered: a.covered + b.covered, open: a.open + b.open };
        let up = tree[level - 1].parent(Node::default(), join);
        tree.push(up);
    }
    tree
}

fn level_of(edge: u32) -> usize {
    let level = (0..LEVELS).find(|&l| LEAF << l == edge);
    level.expect("Work::check lets only quadtree levels through")
}

/// Returns the coarsest level at which more than `wanted` tiles are to be rendered.
fn coarsest(tree: &[Grid<Node>], to_render: &impl Fn(&Node) -> bool, wanted: u64) -> Option<usize> {
    let count = |l: usize| tree[l].cells.iter().filter(|n| to_render(n)).count() as u64;
    (0..LEVELS).rev().find(|&l| count(l) > wanted)
}

/// Counts the pixels of leaves that a rectangle overlaps, each leaf as a whole.
fn covered_leaves(size: [u32; 2], rects: &[Rect]) -> Grid<Node> {
    let [columns, rows] = size.map(|n| n.div_ceil(LEAF) as usize);
    // A rectangle adds one to its corner leaf and takes it back behind its last column and row.
    let mut over = Grid::new(columns + 1, rows + 1, 0i64);
    for r in rects {
        let first = |p: i32| (p / LEAF as i32) as usize;
        let end = |p: i32| ((p - 1) / LEAF as i32) as usize + 1;
        let (x0, x1, y0, y1) = (first(r.x0), end(r.x1), first(r.y0), end(r.y1));
        for (x, y, add) in [(x0, y0, 1), (x1, y0, -1), (x0, y1, -1), (x1, y1, 1)] {
            over.cells[y * over.columns + x] += add;
        }
    }
    // Leaves are whole but for those at the right and at the bottom.
    let part = |i: usize, n: u32| u64::from((n - i as u32 * LEAF).min(LEAF));
    let mut grid = Grid::new(columns, rows, Node::default());
    let mut above = vec![0; columns];
    for y in 0..rows {
        let mut run = 0;
        for (x, above) in above.iter_mut().enumerate() {
            run += over.cells[y * over.columns + x];
            *above += run;
            if *above > 0 {
                let pixels = part(x, size[0]) * part(y, size[1]);
                grid.cells[y * columns + x] = Node { covered: pixels, open: pixels };
            }
        }
    }
    grid
}

/// Lists the tiles of one level.
fn list(
    size: [u32; 2],
    grid: &Grid<Node>,
    level: usize,
    to_render: &impl Fn(&Node) -> bool,
    is_shut: impl Fn(&Rect) -> bool,
) -> Cut {
    let edge = LEAF << level;
    let picture = Rect::from_size(size);
    let (mut empty, mut all_shut) = (0, 0);
    let mut tiles = Vec::new();
    for y in 0..grid.rows {
        for x in 0..grid.columns {
            let (x0, y0) = (x as i32 * edge as i32, y as i32 * edge as i32);
            let rect = Rect::new(x0, y0, x0 + edge as i32, y0 + edge as i32).intersect(&picture);
            let node = &grid.cells[y * grid.columns + x];
            if to_render(node) {
                tiles.push(Macrotile { rect, est: node.open });
            } else if is_shut(&rect) {
                all_shut += 1;
            } else {
                empty += 1;
            }
        }
    }
    let mut cut = Cut { edge, tiles, empty, shut: all_shut, first: Vec::new() };
    cut.sort();
    cut
}

impl Cut {
    /// Sorts the tiles by workload, largest first; equal ones keep their order.
    pub fn sort(&mut self) {
        self.tiles.sort_by_key(|t| std::cmp::Reverse(t.est));
    }

    /// Appends parts of a tile.
    pub(crate) fn add(&mut self, parts: Vec<Macrotile>) {
        let long = |t: &Macrotile| t.rect.width().max(t.rect.height()) as u32;
        let edge = parts.iter().map(|t| long(t).next_power_of_two()).max();
        self.edge = edge.unwrap_or(self.edge).clamp(LEAF, self.edge);
        self.tiles.extend(parts);
    }

    /// Returns the edge of a tile: the least level's that it fits.
    pub fn edge_of(&self, rect: &Rect) -> u32 {
        let long = rect.width().max(rect.height()) as u32;
        long.next_power_of_two().max(self.edge)
    }

    /// Indexes the tiles by their position.
    fn index(&mut self, size: [u32; 2]) {
        let [columns, rows] = size.map(|n| n.div_ceil(self.edge) as usize);
        let mut first = vec![Grid::new(columns, rows, u32::MAX)];
        for (place, tile) in self.tiles.iter().enumerate() {
            let cell = |p: i32| p as usize >> self.edge.ilog2();
            for y in cell(tile.rect.y0)..=cell(tile.rect.y1 - 1) {
                for x in cell(tile.rect.x0)..=cell(tile.rect.x1 - 1) {
                    first[0].cells[y * columns + x] = place as u32;
                }
            }
        }
        while first.last().is_some_and(|g| g.cells.len() > 1) {
            let up = first.last().expect("there is one").parent(u32::MAX, u32::min);
            first.push(up);
        }
        self.first = first;
    }

    /// Returns the first index in `tiles` of a tile that `rect` (not empty, inside the picture)
    /// touches. Descends the quadtree and turns back where nothing better can lie below, so a brick
    /// over the whole picture costs one look and not one for every tile. Only for the cut of a
    /// slab.
    pub fn first_in(&self, rect: &Rect) -> Option<u32> {
        let mut best = u32::MAX;
        let top = self.first.len() - 1;
        let mut stack = vec![(top, 0usize, 0usize)];
        while let Some((level, x, y)) = stack.pop() {
            let grid = &self.first[level];
            let here = grid.cells[y * grid.columns + x];
            if here >= best {
                continue;
            }
            let edge = i64::from(self.edge) << level;
            let (x0, y0) = (x as i64 * edge, y as i64 * edge);
            let (rx0, ry0) = (i64::from(rect.x0), i64::from(rect.y0));
            let (rx1, ry1) = (i64::from(rect.x1), i64::from(rect.y1));
            if rx1 <= x0 || ry1 <= y0 || x0 + edge <= rx0 || y0 + edge <= ry0 {
                continue;
            }
            let inside = rx0 <= x0 && ry0 <= y0 && x0 + edge <= rx1 && y0 + edge <= ry1;
            if level == 0 || inside {
                best = here;
                continue;
            }
            let below = &self.first[level - 1];
            for (cx, cy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let (cx, cy) = (2 * x + cx, 2 * y + cy);
                if cx < below.columns && cy < below.rows {
                    stack.push((level - 1, cx, cy));
                }
            }
        }
        (best != u32::MAX).then_some(best)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn workload_of_border_leaves_is_clipped_to_the_picture() {
        for size in [[64, 64], [70, 33], [16, 100], [17, 1]] {
            let picture = Rect::from_size(size);
            let through = Through::new(size, &[picture]);
            let [columns, rows] = size.map(|n| n.div_ceil(LEAF) as usize);
            assert_eq!(through.count(LEAF), columns * rows);
            for edge in [16, 32, 64] {
                let cut = through.cut(edge);
                assert_eq!(cut.tiles.len(), through.count(edge));
                assert!(cut.tiles.iter().all(|t| t.est == t.rect.area() as u64), "{size:?}");
            }
        }
    }
    use proptest::prelude::*;

    fn open(size: [u32; 2]) -> ShutMap {
        ShutMap::open(Rect::from_size(size))
    }

    #[test]
    fn cut_chooses_the_coarsest_level_with_more_tiles_than_wanted() {
        // 512x512, all covered: 4 tiles of 256, 16 of 128, 64 of 64, 256 of 32, 1024 of 16.
        let size = [512, 512];
        let all = [Rect::from_size(size)];
        let edge = |wanted| cut(size, &all, &open(size), true, wanted, None).edge;
        assert_eq!(edge(0), 256);
        assert_eq!(edge(3), 256);
        assert_eq!(edge(4), 128, "more than wanted, not as many");
        assert_eq!(edge(15), 128);
        assert_eq!(edge(16), 64);
        assert_eq!(edge(255), 32);
        assert_eq!(edge(256), 16);
        assert_eq!(edge(100_000), 16, "the leaves, when even they are too few");
        assert_eq!(cut(size, &all, &open(size), true, 0, Some(64)).tiles.len(), 64);
    }

    #[test]
    fn mixed_cut_keeps_the_largest_tiles_whole() {
        // Three tiles of 64: two full, one with a brick of 20 pixels in a corner.
        let size = [256, 64];
        let rects = [Rect::new(0, 0, 128, 64), Rect::new(130, 2, 150, 22)];
        let open = open(size);
        let cut = cut_mixed(size, &rects, &open, true, (0, Some(64)), 1);
        assert_eq!((cut.edge, cut.tiles.len()), (32, 1 + 4 + 1));
        assert_eq!(cut.tiles[0].rect, Rect::new(0, 0, 64, 64));
        assert!(cut.tiles[1..].iter().all(|t| t.rect.width() == 32));
        let edges: Vec<u32> = cut.tiles.iter().map(|t| cut.edge_of(&t.rect)).collect();
        assert_eq!(edges, [64, 32, 32, 32, 32, 32]);
        // Every pixel is found in the tile that has it.
        assert_eq!(cut.first_in(&Rect::new(40, 40, 41, 41)), Some(0));
        assert_eq!(cut.first_in(&Rect::new(140, 10, 150, 20)), Some(5));
        assert_eq!(cut.first_in(&Rect::new(60, 0, 70, 9)), Some(0));
        // Nothing is left to cut.
        assert_eq!(cut_mixed(size, &rects, &open, true, (0, Some(64)), 3).edge, 64);
    }

    #[test]
    fn mixed_cut_covers_each_pixel_once() {
        // Three tiles of 64 in a picture that cuts the last one, and nothing under the second.
        let size = [190, 50];
        let through = Through::new(size, &[Rect::new(0, 0, 60, 50), Rect::new(130, 0, 190, 50)]);
        let coarse = through.cut(64);
        assert_eq!((coarse.tiles.len(), through.cut(32).tiles.len()), (2, 8));
        for (cut, n, edge) in [
            ([false; 2], 2, 64),
            ([true, false], 5, 32),
            ([false, true], 5, 32),
            ([true; 2], 8, 32),
        ] {
            let mixed = through.mixed(coarse.clone(), &cut);
            assert_eq!((mixed.tiles.len(), mixed.edge), (n, edge));
            let mut over = vec![0; 190 * 50];
            for t in &mixed.tiles {
                for y in t.rect.y0..t.rect.y1 {
                    for x in t.rect.x0..t.rect.x1 {
                        over[(y * 190 + x) as usize] += 1;
                    }
                }
            }
            let want = |x: i32| i32::from(!(64..128).contains(&x));
            assert!((0..190 * 50).all(|i| over[i as usize] == want(i % 190)), "{cut:?}");
            assert!(mixed.tiles.is_sorted_by_key(|t| std::cmp::Reverse(t.est)));
        }
    }

    #[test]
    fn cut_skips_empty_and_shut_tiles() {
        // 64x48 in tiles of 16: 4 x 3. One brick over the two left columns of the top row; the
        // first tile of it is shut, and so is one tile without a brick.
        let size = [64, 48];
        let mut shut = open(size);
        for y in 0..16 {
            for x in (0..16).chain(48..64) {
                shut.shut(y * 64 + x);
            }
        }
        shut.refresh();
        let brick = [Rect::new(0, 0, 20, 16)];
        let c = cut(size, &brick, &shut, true, 1000, None);
        let tile = Macrotile { rect: Rect::new(16, 0, 32, 16), est: 4 * 16 };
        assert_eq!((c.edge, c.tiles, c.empty, c.shut), (16, vec![tile], 9, 2));
        let c = cut(size, &brick, &shut, false, 1000, None);
        assert_eq!(c.tiles.len(), 2, "without culling a shut tile with bricks is rendered");
        assert_eq!(c.tiles[1].est, 0);
    }

    #[test]
    fn cut_clips_border_tiles_and_sorts_by_workload() {
        let size = [40, 20];
        let c = cut(size, &[Rect::from_size(size)], &open(size), true, 0, Some(16));
        let got: Vec<_> = c.tiles.iter().map(|t| (t.rect.x0, t.rect.y0, t.est)).collect();
        let want =
            [(0, 0, 256), (16, 0, 256), (32, 0, 128), (0, 16, 64), (16, 16, 64), (32, 16, 32)];
        assert_eq!(got, want);
        assert!(c.tiles.iter().all(|t| t.rect.area() as u64 == t.est));
    }

    #[test]
    fn cut_of_the_largest_picture_takes_one_pass() {
        // A row of leaves in 8192 columns: nothing depends on the number of pixels a brick covers,
        // or on that of its tiles.
        let size = [8192, 64];
        let all = vec![Rect::from_size(size); 20_000];
        let c = cut(size, &all, &open(size), true, 0, Some(16));
        assert_eq!(c.tiles.len(), 512 * 4);
        assert!(all.iter().all(|r| c.first_in(r) == Some(0)));
    }

    #[test]
    fn region_cut_is_as_coarse_as_rendering_allows() {
        let size = [512, 512];
        let all = [Rect::from_size(size)];
        let edge = |wanted, many| cut_through(size, &all, (wanted, many), None).edge;
        assert_eq!(edge(5, 32), 64);
        assert_eq!(edge(2, 3), 256, "few threads, few tiles");
        assert_eq!(edge(40, 256), 64, "64 are not many, but more than wanted");
        assert_eq!(edge(100, 512), 32, "64 are too few");
        assert_eq!(edge(100_000, 1 << 40), 16);
        assert_eq!(cut_through(size, &all, (9, 9), Some(128)).tiles.len(), 16);
        assert!(cut_through(size, &[], (9, 9), None).tiles.is_empty());
    }

    fn rects(w: i32, h: i32) -> impl Strategy<Value = Vec<Rect>> {
        let one = (0..w, 0..h, 1..=w, 1..=h)
            .prop_map(move |(x, y, dx, dy)| Rect::new(x, y, (x + dx).min(w), (y + dy).min(h)));
        prop::collection::vec(one, 0..12)
    }

    proptest! {
        #[test]
        fn cut_workload_equals_counting_pixels(
            (w, h, rects) in (1i32..90, 1i32..70)
                .prop_flat_map(|(w, h)| (Just(w), Just(h), rects(w, h))),
            bits in prop::collection::vec(any::<bool>(), 6300),
            level in 0u32..5, cull in any::<bool>(),
        ) {
            let size = [w as u32, h as u32];
            let mut shut = open(size);
            for i in 0..(w * h) as usize {
                if bits[i] { shut.shut(i); }
            }
            shut.refresh();
            let edge = 16i32 << level;
            let c = cut(size, &rects, &shut, cull, 0, Some(edge as u32));
            let (mut tiles, mut total) = (Vec::new(), 0);
            for y0 in (0..h).step_by(edge as usize) {
                for x0 in (0..w).step_by(edge as usize) {
                    total += 1;
                    let rect = Rect::new(x0, y0, (x0 + edge).min(w), (y0 + edge).min(h));
                    let (mut est, mut covered) = (0, 0);
                    for y in rect.y0..rect.y1 {
                        for x in rect.x0..rect.x1 {
                            let under = rects.iter().any(|r| {
                                r.x0 <= x && x < r.x1 && r.y0 <= y && y < r.y1
                            });
                            covered += u64::from(under);
                            est += u64::from(under && !bits[(y * w + x) as usize]);
                        }
                    }
                    if est > 0 || (!cull && covered > 0) {
                        tiles.push(Macrotile { rect, est });
                    }
                }
            }
            tiles.sort_by_key(|t| std::cmp::Reverse(t.est));
            prop_assert_eq!(&c.tiles, &tiles);
            prop_assert_eq!(c.empty + c.shut + tiles.len() as u64, total);
            // Through all depths a leaf counts as a whole, in rows and columns of any length.
            let through = cut_through(size, &rects, (0, 0), Some(16));
            let leaf = |r: &Rect| {
                let under = |b: &Rect| !b.intersect(r).is_empty();
                rects.iter().any(under).then_some(r.area() as u64)
            };
            let whole = Rect::from_size(size);
            for y0 in (0..h).step_by(16) {
                for x0 in (0..w).step_by(16) {
                    let r = Rect::new(x0, y0, x0 + 16, y0 + 16).intersect(&whole);
                    let got = through.tiles.iter().find(|t| t.rect == r).map(|t| t.est);
                    prop_assert_eq!(got, leaf(&r), "{:?}", r);
                }
            }
            for r in &rects {
                let want = tiles.iter().position(|t| !t.rect.intersect(r).is_empty());
                prop_assert_eq!(c.first_in(r), want.map(|p| p as u32));
            }
        }
    }
}
