//! A map from tiles of one picture, found by arithmetic.
//!
//! A tile of the quadtree ([`macrotile`](crate::policy::macrotile)) is identified by its level and
//! its column and row there. A tile cut off by the right or bottom border of the picture may also
//! be a tile of a finer level; both are the same key, since they have the same pixels.

use crate::policy::macrotile::{LEAF, LEVELS};
use slabcast_common::occlusion::Rect;

/// A map from the tiles of a picture of one size.
#[derive(Clone, Debug)]
pub(crate) struct TileMap<T> {
    size: [u32; 2],
    /// For each level, row-major: 1 + the tile's index in `values`, or 0. Empty until a tile of the
    /// level is inserted.
    cells: [Vec<u32>; LEVELS],
    values: Vec<T>,
}

impl<T> TileMap<T> {
    pub(crate) fn new(size: [u32; 2]) -> Self {
        TileMap { size, cells: Default::default(), values: Vec::new() }
    }

    /// Returns the finest level that the tile belongs to, and its cell there.
    fn cell(&self, tile: &Rect) -> (usize, usize) {
        let long = (tile.width().max(tile.height()) as u32).max(LEAF).next_power_of_two();
        let level = ((long / LEAF).ilog2() as usize).min(LEVELS - 1);
        let at = |p: i32| p as usize >> (LEAF.ilog2() as usize + level);
        (level, at(tile.y0) * self.columns(level) + at(tile.x0))
    }

    fn columns(&self, level: usize) -> usize {
        self.size[0].div_ceil(LEAF << level) as usize
    }

    pub(crate) fn get(&self, tile: &Rect) -> Option<&T> {
        let (level, cell) = self.cell(tile);
        let place = self.cells[level].get(cell)?.checked_sub(1)?;
        Some(&self.values[place as usize])
    }

    /// Inserts a value, replacing the one before.
    pub(crate) fn insert(&mut self, tile: &Rect, value: T) {
        let (level, cell) = self.cell(tile);
        let cells = self.columns(level) * self.size[1].div_ceil(LEAF << level) as usize;
        if self.cells[level].is_empty() {
            self.cells[level].resize(cells, 0);
        }
        match &mut self.cells[level][cell] {
            0 => {
                self.values.push(value);
                self.cells[level][cell] = self.values.len() as u32;
            }
            place => self.values[*place as usize - 1] = value,
        }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Removes all values.
    pub(crate) fn clear(&mut self) {
        self.values.clear();
        self.cells.iter_mut().for_each(|cells| cells.fill(0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::macrotile::cut_through;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    proptest! {
        /// Tiles of all levels of one picture coexist, each under its own pixels.
        #[test]
        fn tile_map_finds_tiles_by_their_pixels(
            size in (1u32..600, 1u32..600),
            deeds in prop::collection::vec((0usize..LEVELS, any::<prop::sample::Index>(), any::<u16>()), 1..60),
        ) {
            let size = [size.0, size.1];
            let (mut map, mut tree) = (TileMap::new(size), BTreeMap::new());
            let sides = |r: &Rect| [r.x0, r.y0, r.x1, r.y1];
            let cut = |level| cut_through(size, &[Rect::from_size(size)], (1, 1), Some(LEAF << level));
            for (level, which, value) in deeds {
                let cut = cut(level);
                let tile = which.get(&cut.tiles).rect;
                map.insert(&tile, value);
                tree.insert(sides(&tile), value);
            }
            for tile in (0..LEVELS).flat_map(|level| cut(level).tiles) {
                prop_assert_eq!(map.get(&tile.rect), tree.get(&sides(&tile.rect)));
            }
            prop_assert!(!map.is_empty());
            map.clear();
            prop_assert!(map.is_empty());
            prop_assert!(cut(0).tiles.iter().all(|t| map.get(&t.rect).is_none()));
        }
    }
}
