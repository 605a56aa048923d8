//! Something about each of some tiles of a picture, found by where the tile lies.
//!
//! A tile of the quadtree ([`macrotile`](crate::policy::macrotile)) is known by its level and its column and row there, so that looking
//! one up is arithmetic. At the right and at the bottom a picture cuts tiles off; what is left may be a tile of a finer level too,
//! and is the same tile then: it has the same pixels.

use crate::policy::macrotile::{LEAF, LEVELS};
use slabcast_common::occlusion::Rect;

/// A map from tiles of a picture of one size.
#[derive(Clone, Debug)]
pub(crate) struct TileMap<T> {
    size: [u32; 2],
    /// For each level, row-major: one more than the tile's place among the values, or 0. Empty while no tile of it is known.
    cells: [Vec<u32>; LEVELS],
    values: Vec<T>,
}

impl<T> TileMap<T> {
    pub(crate) fn new(size: [u32; 2]) -> Self {
        TileMap { size, cells: Default::default(), values: Vec::new() }
    }

    /// The finest level that a tile is one of, and its cell there.
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

    /// Puts a tile's value down, in the place of the one before.
    ///
    /// # Panics
    /// If it is none of the picture's.
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

    /// Forgets all.
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
        /// Tiles of all levels of one picture stand beside each other, each under its own pixels.
        #[test]
        fn a_tile_is_known_by_its_pixels(
            size in (1u32..600, 1u32..600),
            deeds in prop::collection::vec((0usize..LEVELS, any::<prop::sample::Index>(), any::<u16>()), 1..60),
        ) {
            let size = [size.0, size.1];
            let (mut tiled, mut tree) = (TileMap::new(size), BTreeMap::new());
            let sides = |r: &Rect| [r.x0, r.y0, r.x1, r.y1];
            let cut = |level| cut_through(size, &[Rect::of_size(size)], (1, 1), Some(LEAF << level));
            for (level, which, value) in deeds {
                let cut = cut(level);
                let tile = which.get(&cut.tiles).rect;
                tiled.insert(&tile, value);
                tree.insert(sides(&tile), value);
            }
            for tile in (0..LEVELS).flat_map(|level| cut(level).tiles) {
                prop_assert_eq!(tiled.get(&tile.rect), tree.get(&sides(&tile.rect)));
            }
            prop_assert!(!tiled.is_empty());
            tiled.clear();
            prop_assert!(tiled.is_empty());
            prop_assert!(cut(0).tiles.iter().all(|t| tiled.get(&t.rect).is_none()));
        }
    }
}
